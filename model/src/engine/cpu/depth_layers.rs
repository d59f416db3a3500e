//! Layers of the depth volume: which of them each pixel lies in.

use holod_calibration::Resolution;
use rayon::prelude::*;

use super::blocks::PIXELS_PER_SAMPLE;
use super::column_blocks::ColumnBlocks;
use super::frame_blocks::{DEPTH, FrameBlocks};
use super::view::View;
use crate::RgbdFrame;
use crate::engine::constants::LAYER_SHIFTS;
use crate::simd::{InstructionSet, Simd, Task};
use crate::weights::MOST_DEPTH_LAYERS;

// A bit of `present` for each.
const _: () = assert!(MOST_DEPTH_LAYERS <= u64::BITS as usize);

/// Layers equal in dioptres, far to near. Nothing is allocated after `new`.
pub(super) struct DepthLayers {
    count: usize,
    set: InstructionSet,
    /// The number of the layer of each of the pixels behind a sample.
    pub(super) layer_of: ColumnBlocks,
    /// A bit for each layer that anything lies in.
    present: u64,
}

impl DepthLayers {
    pub(super) fn new(count: usize, size: Resolution, set: InstructionSet) -> Self {
        Self { count, set, layer_of: ColumnBlocks::of_reals(PIXELS_PER_SAMPLE, size, set), present: 0 }
    }

    /// Whether anything lies in one layer.
    pub(super) fn has_any_in(&self, layer: usize) -> bool {
        self.present >> layer & 1 == 1
    }

    /// Takes the depths of a frame.
    pub(super) fn place(&mut self, frame: &FrameBlocks) {
        let Self { count, set, layer_of, present } = self;
        let count = *count;
        let placed = layer_of.par_blocks_mut().zip(frame.planes.par_blocks()).map(|(layers, planes)| {
            let mut present = 0;
            set.run(Place { depths: &planes[DEPTH * layers.len()..], count, layers, present: &mut present });
            present
        });
        *present = placed.reduce(|| 0, |a, b| a | b);
    }
}

/// The layers of the pixels behind a block of columns, [pixel, row, column].
struct Place<'a> {
    depths: &'a [f32],
    count: usize,
    layers: &'a mut [f32],
    present: &'a mut u64,
}

impl Task for Place<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { depths, count, layers, present } = self;
        let plane_len = layers.len() / PIXELS_PER_SAMPLE;
        let pixels = layers.chunks_exact_mut(plane_len).zip(depths.chunks_exact(plane_len));
        for ((layers, depths), shift) in pixels.zip(LAYER_SHIFTS) {
            for (layer, depth) in layers.iter_mut().zip(depths) {
                // What lies outside, or is no number, goes to an end.
                let number = (depth * count as f32 + shift).max(0.0).min((count - 1) as f32) as i32;
                *layer = number as f32;
                *present |= 1 << number;
            }
        }
    }
}

impl View for DepthLayers {
    type Input = RgbdFrame;

    #[inline(always)]
    fn share_in_focus<S: Simd>(&self, simd: S, plane: usize, block: usize, y: usize) -> S::Vector {
        let mut share = simd.splat(0.0);
        for pixel in 0..PIXELS_PER_SAMPLE {
            let layer = simd.read(self.layer_of.rows_of_block(block, pixel, y));
            let part = simd.where_equal(layer, simd.splat(plane as f32), simd.splat(1.0 / PIXELS_PER_SAMPLE as f32));
            share = simd.add(share, part);
        }
        share
    }
}
