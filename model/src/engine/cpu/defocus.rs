//! What an eye should see at each depth layer, as far as a picture and its depth tell.

use holod_calibration::{DisplayGeometry, Resolution};
use rayon::prelude::*;

use super::blocks::PIXELS_PER_SAMPLE;
use super::column_blocks::{ColumnBlocks, load, store};
use super::depth_layers::DepthLayers;
use super::frame_blocks::FrameBlocks;
use super::input_features::sample_pitch;
use super::plane_fft::{Columns, PlaneFft, Rows};
use crate::engine::constants::{LEAST_COVER, PAIRS};
use crate::engine::disc::DiscTable;
use crate::optics::signed_bin;
use crate::simd::{InstructionSet, Simd, Task};
use crate::weights::{MOST_DEPTH_LAYERS, NetworkConfig};

/// Blurs each depth layer by its disc of confusion at the focus on each other one, and divides the sum by that of a
/// white scene. Blur is circular, and no layer hides another. Nothing is allocated after `new`.
pub(super) struct Defocus {
    size: Resolution,
    count: usize,
    disc: DiscTable,
    /// The pupil that `discs` is for.
    pupil_mm: f32,
    /// [block of rows, layers, column up to half of them, row of the block], over the number of samples: spectra of the
    /// discs between layers that are 0, 1, 2, .. apart. Column k beyond half is that of width − k.
    discs: Vec<f32>,
    /// For each layer its light's pairs, and then those seen at the focus on it.
    fft: PlaneFft,
    set: InstructionSet,
}

impl Defocus {
    pub(super) fn new(config: &NetworkConfig, bench: &DisplayGeometry, size: Resolution, set: InstructionSet) -> Self {
        let count = config.depth_layers;
        let sample_rad = sample_pitch(bench).0 / bench.eyepiece_focal_length.0;
        Self {
            size,
            count,
            disc: DiscTable::new(bench, count, sample_rad),
            pupil_mm: f32::NAN,
            discs: vec![0.0; count * (size.width / 2 + 1) * size.height.next_multiple_of(set.lanes())],
            fft: PlaneFft::new(PAIRS * count, size, set),
            set,
        }
    }

    /// Values that [`Self::expect`] needs room for.
    pub(super) fn room(&self) -> usize {
        self.fft.room_between()
    }

    /// Writes the expected amplitudes, three colours of each layer, of `frame`, whose depths `layers` has.
    pub(super) fn expect(
        &mut self,
        frame: &FrameBlocks,
        layers: &DepthLayers,
        pupil_mm: f32,
        amplitudes: &mut ColumnBlocks,
        room: &mut [f32],
    ) {
        self.shape_discs(pupil_mm);
        let Self { size: Resolution { width, .. }, count, discs, fft, set, .. } = self;
        let (width, count, set) = (*width, *count, *set);
        fft.for_columns(room, frame.planes.blocks().zip(layers.layer_of.blocks()), |columns, (frame, layer_of)| {
            set.run(TakeLayers { columns, frame, layers, layer_of, count });
        });
        let discs = discs.chunks_exact(discs.len() / self.size.height.div_ceil(set.lanes()));
        fft.for_rows(room, discs, |rows, discs| set.run(Blur { rows, discs, layers, width, count }));
        fft.for_columns(room, amplitudes.blocks_mut(), |columns, amplitudes| set.run(See { columns, amplitudes }));
    }

    /// Sets the discs to those of a pupil, unless they are already.
    fn shape_discs(&mut self, pupil_mm: f32) {
        if self.pupil_mm == pupil_mm {
            return;
        }
        let Self { size: Resolution { width, height }, count, disc, discs, set, .. } = self;
        let (width, height, lanes, norm) = (*width, *height, set.lanes(), 1.0 / (*width * *height) as f32);
        let scale = disc.entries_per_mm * f64::from(pupil_mm);
        let rows_len = discs.len() / height.div_ceil(lanes);
        discs.par_chunks_exact_mut(rows_len).enumerate().for_each(|(block, discs)| {
            let columns = width / 2 + 1;
            for (kx, lane) in (0..columns).flat_map(|kx| (0..lanes).map(move |lane| (kx, lane))) {
                let fx = signed_bin(kx, width) as f64 / width as f64;
                let fy = signed_bin(block * lanes + lane, height) as f64 / height as f64;
                let entry_of_neighbour = scale * (fx * fx + fy * fy).sqrt();
                for apart in 0..*count {
                    let entry = apart as f64 * entry_of_neighbour;
                    let (below, share) = (entry as usize, entry.fract() as f32);
                    discs[(apart * columns + kx) * lanes + lane] = match disc.values.get(below..below + 2) {
                        Some(&[low, high]) => norm * (low + share * (high - low)),
                        _ => 0.0,
                    };
                }
            }
        });
        self.pupil_mm = pupil_mm;
    }
}

/// The light of each layer in a block of columns leaves as pairs: white with red, and green with blue.
struct TakeLayers<'a> {
    columns: Columns<'a>,
    /// Three amplitudes of the frame, [colour, pixel, row, column of the block].
    frame: &'a [f32],
    layers: &'a DepthLayers,
    /// [pixel, row, column of the block]
    layer_of: &'a [f32],
    count: usize,
}

impl Task for TakeLayers<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut columns, frame, layers, layer_of, count } = self;
        let plane_len = layer_of.len() / PIXELS_PER_SAMPLE;
        for (y, row) in (0..plane_len).step_by(S::LANES).enumerate() {
            let zero = simd.splat(0.0);
            // Of each pixel behind the samples its layer, 1 and its powers, which are shares of the sample's.
            let mut pixels = [(zero, [zero; 1 + 3]); PIXELS_PER_SAMPLE];
            for (pixel, (layer, parts)) in pixels.iter_mut().enumerate() {
                *layer = simd.read(&layer_of[pixel * plane_len + row..]);
                let share = simd.splat(1.0 / PIXELS_PER_SAMPLE as f32);
                parts[0] = share;
                for (colour, power) in parts[1..].iter_mut().enumerate() {
                    let amplitude = simd.read(&frame[(colour * PIXELS_PER_SAMPLE + pixel) * plane_len + row..]);
                    *power = simd.mul(simd.mul(amplitude, amplitude), share);
                }
            }
            for layer in (0..count).filter(|&layer| layers.has_any_in(layer)) {
                let mut sums = [zero; 1 + 3];
                for (layer_of, parts) in pixels {
                    for (sum, part) in sums.iter_mut().zip(parts) {
                        *sum = simd.add(*sum, simd.where_equal(layer_of, simd.splat(layer as f32), part));
                    }
                }
                let [white, red, green, blue] = sums;
                for (pair, cell) in [[white, red], [green, blue]].into_iter().enumerate() {
                    store(simd, &mut columns.cells(PAIRS * layer + pair)[y * 2 * S::LANES..], cell);
                }
            }
        }
        for layer in (0..count).filter(|&layer| layers.has_any_in(layer)) {
            for pair in 0..PAIRS {
                columns.send(simd, PAIRS * layer + pair);
            }
        }
    }
}

/// The spectra of all layers in a block of rows become those of what is seen at the focus on each.
struct Blur<'a> {
    rows: Rows<'a>,
    /// [layers, column up to half of them, row of the block]
    discs: &'a [f32],
    layers: &'a DepthLayers,
    width: usize,
    count: usize,
}

impl Task for Blur<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut rows, discs, layers, width, count } = self;
        for layer in (0..count).filter(|&layer| layers.has_any_in(layer)) {
            for pair in 0..PAIRS {
                rows.arrive(simd, PAIRS * layer + pair);
            }
        }
        let cells = rows.all_cells();
        let (plane_len, columns) = (width * 2 * S::LANES, width / 2 + 1);
        assert!(cells.len() >= PAIRS * count * plane_len && discs.len() == count * columns * S::LANES);
        let mut seen = [[simd.splat(0.0); 2]; MOST_DEPTH_LAYERS];
        for (pair, kx) in (0..PAIRS).flat_map(|pair| (0..width).map(move |kx| (pair, kx))) {
            let place = |layer: usize| (PAIRS * layer + pair) * plane_len + kx * 2 * S::LANES;
            let disc = |apart: usize| (apart * columns + kx.min(width - kx)) * S::LANES;
            for (focus, seen) in seen.iter_mut().enumerate().take(count) {
                let mut sum = [simd.splat(0.0); 2];
                for layer in (0..count).filter(|&layer| layers.has_any_in(layer)) {
                    // SAFETY: a cell lies at each `place` of `count` layers and `width` columns, and a vector at each
                    // `disc`, as asserted above.
                    unsafe {
                        let disc = simd.load(discs.as_ptr().add(disc(layer.abs_diff(focus))));
                        let cell = cells.as_ptr().add(place(layer));
                        sum[0] = simd.mul_add(simd.load(cell), disc, sum[0]);
                        sum[1] = simd.mul_add(simd.load(cell.add(S::LANES)), disc, sum[1]);
                    }
                }
                *seen = sum;
            }
            for (focus, [re, im]) in seen.into_iter().enumerate().take(count) {
                // SAFETY: as above.
                unsafe {
                    let cell = cells.as_mut_ptr().add(place(focus));
                    simd.store(cell, re);
                    simd.store(cell.add(S::LANES), im);
                }
            }
        }
        for plane in 0..PAIRS * count {
            rows.send(simd, plane);
        }
    }
}

/// What is seen at each focus arrives in a block of columns.
struct See<'a> {
    columns: Columns<'a>,
    /// Three colours of each layer.
    amplitudes: &'a mut [f32],
}

impl Task for See<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut columns, amplitudes } = self;
        let plane_len = columns.cells(0).len() / 2;
        for (focus, amplitudes) in amplitudes.chunks_exact_mut(3 * plane_len).enumerate() {
            for pair in 0..PAIRS {
                columns.arrive(simd, PAIRS * focus + pair);
            }
            let (red, others) = amplitudes.split_at_mut(plane_len);
            let (green, blue) = others.split_at_mut(plane_len);
            let colours = red.chunks_exact_mut(S::LANES).zip(green.chunks_exact_mut(S::LANES));
            let colours = colours.zip(blue.chunks_exact_mut(S::LANES));
            let pairs = &columns.all_cells()[PAIRS * focus * 2 * plane_len..][..PAIRS * 2 * plane_len];
            let (white_red, green_blue) = pairs.split_at(2 * plane_len);
            let cells = white_red.chunks_exact(2 * S::LANES).zip(green_blue.chunks_exact(2 * S::LANES));
            for (((red, green), blue), (white_red, green_blue)) in colours.zip(cells) {
                let ([white, seen_red], [seen_green, seen_blue]) = (load(simd, white_red), load(simd, green_blue));
                let white = simd.max(white, simd.splat(LEAST_COVER));
                for (amplitude, light) in [(red, seen_red), (green, seen_green), (blue, seen_blue)] {
                    simd.write(amplitude, simd.sqrt(simd.max(simd.div(light, white), simd.splat(0.0))));
                }
            }
        }
    }
}
