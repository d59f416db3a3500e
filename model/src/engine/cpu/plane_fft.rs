//! Two-dimensional circular transforms of several planes at once, between which something is done with samples and with
//! spectra while these are in a worker's cache.
//!
//! Light goes forward through columns and then rows, and back through rows and then columns. So one pass over blocks of
//! columns ends a transform back, does something with samples and begins the next one forward; one over blocks of rows
//! does the same with spectra.

use std::ops::Range;

use holod_calibration::Resolution;

use super::line_fft::{Direction, FftScratch, LineFft, Squares};
use super::workers::{WORKERS, share_out};
use crate::simd::{InstructionSet, Simd};

/// The transforms. Nothing is allocated after `new`.
///
/// What columns were transformed to, [block of columns, plane, row, part, column of the block], with rows up to whole
/// blocks of rows, and what rows were transformed back to, [block of rows, plane, block of columns, row of the block,
/// part, column of the block], lies in room that the user lends ([`Self::room_between`]).
pub(super) struct PlaneFft {
    size: Resolution,
    planes: usize,
    lanes: usize,
    rows: LineFft,
    columns: LineFft,
    workers: Vec<Worker>,
}

/// Buffers of one worker.
struct Worker {
    /// Lines of each plane, either columns of samples or rows of a spectrum: [plane, cell].
    lines: Vec<f32>,
    /// Lines of one plane in the middle of a transform.
    between: Vec<f32>,
    row_scratch: FftScratch,
    column_scratch: FftScratch,
}

impl PlaneFft {
    pub(super) fn new(planes: usize, size: Resolution, set: InstructionSet) -> Self {
        let (Resolution { width, height }, lanes) = (size, set.lanes());
        let (rows, columns) = (LineFft::new(width), LineFft::new(height));
        let worker = |_| Worker {
            lines: vec![0.0; planes * 2 * lanes * width.max(height)],
            between: vec![0.0; 2 * lanes * width.next_multiple_of(lanes).max(height)],
            row_scratch: rows.scratch(lanes),
            column_scratch: columns.scratch(lanes),
        };
        Self { size, planes, lanes, workers: (0..WORKERS).map(worker).collect(), rows, columns }
    }

    /// Values between the halves of transforms.
    pub(super) fn room_between(&self) -> usize {
        let Self { size: Resolution { width, height }, planes, lanes, .. } = *self;
        2 * planes * 2 * width.next_multiple_of(lanes) * height.next_multiple_of(lanes)
    }

    /// Values of the spectra in one block of rows.
    pub(super) fn spectra_len(&self) -> usize {
        self.planes * self.size.width * 2 * self.lanes
    }

    /// Room for spectra of all planes: [block of rows, plane, column, part, row of the block].
    pub(super) fn room_for_spectra(&self) -> Vec<f32> {
        vec![0.0; self.size.height.div_ceil(self.lanes) * self.spectra_len()]
    }

    /// Runs `work` on each block of columns, from left to right, with one of `items`.
    pub(super) fn for_columns<T: Send>(
        &mut self,
        between: &mut [f32],
        items: impl Iterator<Item = T> + Send,
        work: impl Fn(Columns<'_>, T) + Sync,
    ) {
        let (by_columns, by_rows) = between[..self.room_between()].split_at_mut(self.room_between() / 2);
        let Self { size: Resolution { width, height }, planes, lanes, columns, workers, .. } = self;
        let (tile, blocks) = (*lanes * 2 * *lanes, width.div_ceil(*lanes));
        let plane_len = height.next_multiple_of(*lanes) * 2 * *lanes;
        let chunks = by_columns.chunks_exact_mut(*planes * plane_len);
        share_out(workers, chunks.zip(items).enumerate(), |worker, (block, (to, item))| {
            let Worker { lines, between, column_scratch: scratch, .. } = worker;
            let from = Tiles { values: by_rows, tile, first: block, step: blocks, planes: *planes };
            let lines = &mut lines[..*planes * *height * 2 * *lanes];
            work(Columns(Block { fft: columns, from, to, plane_len, lines, between, scratch }), item);
        });
    }

    /// Runs `work` on each block of rows, from top to bottom, with one of `items`.
    pub(super) fn for_rows<T: Send>(
        &mut self,
        between: &mut [f32],
        items: impl Iterator<Item = T> + Send,
        work: impl Fn(Rows<'_>, T) + Sync,
    ) {
        let (by_columns, by_rows) = between[..self.room_between()].split_at_mut(self.room_between() / 2);
        let Self { size: Resolution { width, height }, planes, lanes, rows, workers, .. } = self;
        let (tile, blocks) = (*lanes * 2 * *lanes, height.div_ceil(*lanes));
        let plane_len = width.next_multiple_of(*lanes) * 2 * *lanes;
        let chunks = by_rows.chunks_exact_mut(*planes * plane_len);
        share_out(workers, chunks.zip(items).enumerate(), |worker, (block, (to, item))| {
            let Worker { lines, between, row_scratch: scratch, .. } = worker;
            let from = Tiles { values: by_columns, tile, first: block, step: blocks, planes: *planes };
            let lines = &mut lines[..*planes * *width * 2 * *lanes];
            work(Rows(Block { fft: rows, from, to, plane_len, lines, between, scratch }), item);
        });
    }
}

/// Squares of as many cells each way as a vector has lanes, one of each block that crosses the one at hand.
struct Tiles<'a> {
    values: &'a [f32],
    /// Values of a tile.
    tile: usize,
    /// Tiles before the first one, and from one plane to the next within one crossing block.
    first: usize,
    step: usize,
    planes: usize,
}

impl<'a> Tiles<'a> {
    fn of_plane(&self, plane: usize) -> impl Iterator<Item = &'a [f32]> {
        let Self { values, tile, first, step, planes } = *self;
        let begin = plane * step + first;
        values.chunks_exact(tile).skip(begin).step_by(planes * step)
    }

    fn squares_of(&self, plane: usize) -> Squares<'a> {
        let Self { values, tile, first, step, planes } = *self;
        Squares { values: &values[(plane * step + first) * tile..], pitch: planes * step * tile }
    }
}

/// Lines of all planes, as many of each as a vector has lanes: a block of columns or of rows.
struct Block<'a> {
    fft: &'a LineFft,
    from: Tiles<'a>,
    to: &'a mut [f32],
    /// Values of one plane in `to`.
    plane_len: usize,
    /// The block's lines of each plane, [plane, cell].
    lines: &'a mut [f32],
    between: &'a mut [f32],
    scratch: &'a mut FftScratch,
}

impl Block<'_> {
    /// The values of one plane in `lines`.
    #[inline(always)]
    fn range(&self, plane: usize) -> Range<usize> {
        let len = self.lines.len() / self.from.planes;
        plane * len..(plane + 1) * len
    }
}

/// A block of columns of all planes.
pub(super) struct Columns<'a>(Block<'a>);

impl Columns<'_> {
    /// The cells of all planes, [plane, row], to be read and written.
    #[inline(always)]
    pub(super) fn all_cells(&mut self) -> &mut [f32] {
        self.0.lines
    }

    /// The cells [row] of one plane.
    #[inline(always)]
    pub(super) fn cells(&mut self, plane: usize) -> &mut [f32] {
        let range = self.0.range(plane);
        &mut self.0.lines[range]
    }

    /// Ends the transform of one plane from its spectrum, and gives the cells [row].
    #[inline(always)]
    pub(super) fn arrive<S: Simd>(&mut self, simd: S, plane: usize) -> &mut [f32] {
        let range = self.0.range(plane);
        let Block { fft, from, lines, between, scratch, .. } = &mut self.0;
        let (lines, between) = (&mut lines[range.clone()], &mut between[..range.len()]);
        if fft.has_passes() {
            fft.transform_squares(simd, Direction::Inverse, from.squares_of(plane), lines, scratch);
            return lines;
        }
        for (to, tile) in between.chunks_mut(from.tile).zip(from.of_plane(plane)) {
            to.copy_from_slice(&tile[..to.len()]);
        }
        fft.transform(simd, Direction::Inverse, between, lines, scratch);
        lines
    }

    /// Begins the transform of the cells of one plane to its spectrum.
    #[inline(always)]
    pub(super) fn send<S: Simd>(&mut self, simd: S, plane: usize) {
        let range = self.0.range(plane);
        let Block { fft, to, plane_len, lines, scratch, .. } = &mut self.0;
        let to = &mut to[plane * *plane_len..][..range.len()];
        fft.transform(simd, Direction::Forward, &lines[range], to, scratch);
    }
}

/// A block of rows of all planes' spectra.
pub(super) struct Rows<'a>(Block<'a>);

impl Rows<'_> {
    /// The cells of all planes' spectra, [plane, column], to be read and written.
    #[inline(always)]
    pub(super) fn all_cells(&mut self) -> &mut [f32] {
        self.0.lines
    }

    /// The cells [column] of one plane's spectrum.
    #[inline(always)]
    pub(super) fn cells(&mut self, plane: usize) -> &mut [f32] {
        let range = self.0.range(plane);
        &mut self.0.lines[range]
    }

    /// Ends the transform of one plane to its spectrum, and gives the cells [column].
    #[inline(always)]
    pub(super) fn arrive<S: Simd>(&mut self, simd: S, plane: usize) -> &mut [f32] {
        let range = self.0.range(plane);
        let Block { fft, from, lines, between, scratch, .. } = &mut self.0;
        for (to, tile) in between.chunks_exact_mut(from.tile).zip(from.of_plane(plane)) {
            transpose(simd, tile, to);
        }
        let (lines, between) = (&mut lines[range.clone()], &between[..range.len()]);
        fft.transform(simd, Direction::Forward, between, lines, scratch);
        lines
    }

    /// Begins the transform back of one plane's spectrum.
    #[inline(always)]
    pub(super) fn send<S: Simd>(&mut self, simd: S, plane: usize) {
        let range = self.0.range(plane);
        let Block { fft, from, to, plane_len, lines, between, scratch } = &mut self.0;
        fft.transform(simd, Direction::Inverse, &lines[range.clone()], &mut between[..range.len()], scratch);
        let to = &mut to[plane * *plane_len..][..*plane_len];
        for (to, tile) in to.chunks_exact_mut(from.tile).zip(between.chunks_exact(from.tile)) {
            transpose(simd, tile, to);
        }
    }
}

/// Exchanges rows and columns of a tile.
#[inline(always)]
fn transpose<S: Simd>(simd: S, from: &[f32], to: &mut [f32]) {
    let cell = 2 * S::LANES;
    assert!(from.len() == S::LANES * cell && to.len() == from.len());
    for part in [0, S::LANES] {
        // SAFETY: LANES rows of LANES values, a cell apart, lie in both slices, as asserted above.
        unsafe { simd.transpose(from.as_ptr().add(part), to.as_mut_ptr().add(part), [cell; 2]) };
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex32;

    use super::*;
    use crate::engine::cpu::column_blocks::ColumnBlocks;
    use crate::optics::TransposedFft2d;
    use crate::simd::Task;
    use crate::worst::worst;

    const PLANES: usize = 3;

    /// Sends planes; takes the spectrum of each from the next one, of which it doubles one column; takes what arrives.
    enum Step<'a> {
        Send(Columns<'a>, &'a [f32]),
        Exchange(Rows<'a>, usize),
        Take(Columns<'a>, &'a mut [f32]),
    }

    impl Task for Step<'_> {
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            match self {
                Self::Send(mut columns, from) => {
                    columns.all_cells().copy_from_slice(from);
                    (0..PLANES).for_each(|plane| columns.send(simd, plane));
                }
                Self::Exchange(mut rows, doubled) => {
                    for plane in 0..PLANES {
                        let cells = rows.arrive(simd, plane);
                        cells[doubled * 2 * S::LANES..][..2 * S::LANES].iter_mut().for_each(|value| *value *= 2.0);
                    }
                    let len = rows.cells(0).len();
                    rows.all_cells().rotate_left(len);
                    (0..PLANES).for_each(|plane| rows.send(simd, plane));
                }
                Self::Take(mut columns, to) => {
                    for (plane, to) in to.chunks_exact_mut(to.len() / PLANES).enumerate() {
                        to.copy_from_slice(columns.arrive(simd, plane));
                    }
                }
            }
        }
    }

    /// Planes of noise, as blocks, which have no numbers beyond the width, and as they are.
    fn planes(size: Resolution, set: InstructionSet, seed: f32) -> (ColumnBlocks, Vec<Vec<Complex32>>) {
        let value = |plane: usize, index: usize| Complex32::cis((index as f32 + 7.0 * plane as f32 + seed).powf(1.3));
        let fields: Vec<Vec<_>> =
            (0..PLANES).map(|plane| (0..size.pixels()).map(|index| value(plane, index)).collect()).collect();
        let mut blocks = ColumnBlocks::of_cells(PLANES, size, set);
        let lanes = set.lanes();
        for (block, values) in blocks.blocks_mut().enumerate() {
            for (row, cell) in values.chunks_exact_mut(2 * lanes).enumerate() {
                let (plane, y) = (row / size.height, row % size.height);
                cell.fill(f32::NAN);
                for lane in 0..lanes.min(size.width - block * lanes) {
                    let value = fields[plane][y * size.width + block * lanes + lane];
                    (cell[lane], cell[lanes + lane]) = (value.re, value.im);
                }
            }
        }
        (blocks, fields)
    }

    #[test]
    fn planes_change_places_between_the_transforms_and_only_there() {
        for (width, height) in [(1, 1), (11, 6), (16, 32), (37, 17), (5, 53), (20, 108)] {
            for set in InstructionSet::available() {
                let (size, doubled) = (Resolution { width, height }, width / 3);
                let (from, fields) = planes(size, set, 0.3);
                let mut to = ColumnBlocks::of_cells(PLANES, size, set);
                let mut fft = PlaneFft::new(PLANES, size, set);
                let between = &mut vec![f32::NAN; fft.room_between() + 3];
                // What the first planes leave behind must not show in the second.
                for from in [&planes(size, set, 5.3).0, &from] {
                    fft.for_columns(between, from.blocks(), |columns, from| set.run(Step::Send(columns, from)));
                    let doubled = std::iter::repeat(doubled);
                    fft.for_rows(between, doubled, |rows, doubled| set.run(Step::Exchange(rows, doubled)));
                    fft.for_columns(between, to.blocks_mut(), |columns, to| set.run(Step::Take(columns, to)));
                }

                let mut slow = TransposedFft2d::new(width, height);
                let expected = fields.iter().cycle().skip(1).take(PLANES).flat_map(|field| {
                    let mut field = field.clone();
                    slow.forward(&mut field);
                    slow.spectrum[doubled * height..][..height].iter_mut().for_each(|value| *value *= 2.0);
                    slow.inverse(&mut field);
                    field
                });
                let expected: Vec<_> = expected.collect();
                let mut found = to.to_fields();
                let error = |found: &[Complex32]| {
                    worst(found.iter().zip(&expected).map(|(a, b)| (a - b).norm() / size.pixels() as f32))
                };
                let context = format!("{size} on {}", set.name());
                assert!(found.len() == expected.len() && error(&found) < 1e-5, "{context}: {}", error(&found));
                found[size.pixels() / 2].im += 2e-5 * size.pixels() as f32;
                assert!(error(&found) > 1e-5, "{context}: the comparison is blind");
            }
        }
    }
}
