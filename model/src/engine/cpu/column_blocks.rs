//! Planes of samples in blocks of as many columns as a vector has lanes.
//!
//! So what is done at a place of several planes reads and writes whole vectors, and every block can go to another
//! thread.

use std::ops::DerefMut;

use holod_calibration::Resolution;
use rayon::prelude::*;

use crate::simd::{InstructionSet, Simd};

/// Planes [block, plane, row, part, column of the block]: a real number has one part; a complex one has two, and both
/// of a row are a *cell*. What the last block has beyond the width has no meaning.
pub(super) struct ColumnBlocks<V = Vec<f32>> {
    size: Resolution,
    lanes: usize,
    planes: usize,
    parts: usize,
    values: V,
}

impl ColumnBlocks {
    pub(super) fn of_reals(planes: usize, size: Resolution, set: InstructionSet) -> Self {
        Self::new(planes, 1, size, set)
    }

    pub(super) fn of_cells(planes: usize, size: Resolution, set: InstructionSet) -> Self {
        Self::new(planes, 2, size, set)
    }

    /// Values of this many real planes.
    pub(super) fn room_for_reals(planes: usize, size: Resolution, set: InstructionSet) -> usize {
        values_of(planes, 1, size, set)
    }

    fn new(planes: usize, parts: usize, size: Resolution, set: InstructionSet) -> Self {
        let values = vec![0.0; values_of(planes, parts, size, set)];
        Self { size, lanes: set.lanes(), planes, parts, values }
    }
}

impl<'a> ColumnBlocks<&'a mut [f32]> {
    /// Such planes in the first [`ColumnBlocks::room_for_reals`] values of `room`, as these are.
    pub(super) fn of_reals_in(room: &'a mut [f32], planes: usize, size: Resolution, set: InstructionSet) -> Self {
        let values = &mut room[..ColumnBlocks::room_for_reals(planes, size, set)];
        Self { size, lanes: set.lanes(), planes, parts: 1, values }
    }
}

fn values_of(planes: usize, parts: usize, size: Resolution, set: InstructionSet) -> usize {
    size.width.next_multiple_of(set.lanes()) * planes * size.height * parts
}

impl<V: DerefMut<Target = [f32]>> ColumnBlocks<V> {
    pub(super) fn planes(&self) -> usize {
        self.planes
    }

    pub(super) fn parts(&self) -> usize {
        self.parts
    }

    /// Values of a plane in one block.
    fn plane_len(&self) -> usize {
        self.size.height * self.parts * self.lanes
    }

    fn block_len(&self) -> usize {
        self.planes * self.plane_len()
    }

    /// The blocks from left to right.
    pub(super) fn blocks(&self) -> impl Iterator<Item = &[f32]> + Send {
        self.values.chunks_exact(self.block_len())
    }

    pub(super) fn blocks_mut(&mut self) -> impl Iterator<Item = &mut [f32]> + Send {
        let len = self.block_len();
        self.values.chunks_exact_mut(len)
    }

    /// The blocks for several threads.
    pub(super) fn par_blocks(&self) -> impl IndexedParallelIterator<Item = &[f32]> {
        self.values.par_chunks_exact(self.block_len())
    }

    pub(super) fn par_blocks_mut(&mut self) -> impl IndexedParallelIterator<Item = &mut [f32]> {
        let len = self.block_len();
        self.values.par_chunks_exact_mut(len)
    }

    /// Values of a row of a plane in one block.
    pub(super) fn row_len(&self) -> usize {
        self.parts * self.lanes
    }

    /// The rows from row `y` on of one plane in one block, [row, part, column of the block].
    pub(super) fn rows_of_block(&self, block: usize, plane: usize, y: usize) -> &[f32] {
        let (plane_len, first) = (self.plane_len(), y * self.row_len());
        &self.values[block * self.block_len() + plane * plane_len..][..plane_len][first..]
    }

    /// All complex planes, [plane, height, width].
    #[cfg(test)]
    pub(super) fn to_fields(&self) -> Vec<num_complex::Complex32> {
        assert_eq!(self.parts, 2);
        let Resolution { width, height } = self.size;
        let rows = (0..self.planes).flat_map(|plane| (0..height).map(move |y| (plane, y)));
        rows.flat_map(|(plane, y)| {
            let cells = (0..width.div_ceil(self.lanes)).flat_map(move |block| {
                let (re, im) = self.rows_of_block(block, plane, y)[..self.row_len()].split_at(self.lanes);
                re.iter().zip(im).map(|(re, im)| num_complex::Complex32::new(*re, *im))
            });
            cells.take(width)
        })
        .collect()
    }

    /// Writes `value(plane, x, y)` to real planes.
    pub(super) fn fill(&mut self, value: impl Fn(usize, usize, usize) -> f32 + Sync) {
        assert_eq!(self.parts, 1);
        let (Resolution { width, height }, lanes, planes) = (self.size, self.lanes, self.planes);
        self.values.par_chunks_exact_mut(lanes).enumerate().for_each(|(row, values)| {
            let (y, plane, first) = (row % height, row / height % planes, row / height / planes * lanes);
            for (x, to) in (first..width).zip(values) {
                *to = value(plane, x, y);
            }
        });
    }
}

/// The real parts and the imaginary ones of the first cell.
#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, cells: &[f32]) -> [S::Vector; 2] {
    [simd.read(cells), simd.read(&cells[S::LANES..])]
}

/// Writes the first cell.
#[inline(always)]
pub(super) fn store<S: Simd>(simd: S, cells: &mut [f32], [re, im]: [S::Vector; 2]) {
    simd.write(cells, re);
    simd.write(&mut cells[S::LANES..], im);
}
