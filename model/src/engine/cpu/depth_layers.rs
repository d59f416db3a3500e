//! Layers of the depth volume: which of them each pixel lies in.

use holod_calibration::Resolution;
use rayon::prelude::*;

use super::blocks::Blocks;
use super::input_features::{BLOCK, SCALE};
use crate::RgbdFrame;

/// Layers equal in dioptres, far to near. Nothing is allocated after `new`.
pub(super) struct DepthLayers {
    count: u8,
    size: Resolution,
    /// The depth layer of each pixel of each block, [height, width, 4].
    layer_of: Vec<[u8; BLOCK]>,
}

impl DepthLayers {
    pub(super) fn new(count: usize, size: Resolution) -> Self {
        Self { count: count as u8, size, layer_of: vec![[0; BLOCK]; size.pixels()] }
    }

    /// The layers' numbers, far to near.
    pub(super) fn numbers(&self) -> std::ops::Range<u8> {
        0..self.count
    }

    /// The share of a block that lies in one layer.
    pub(super) fn cover(&self, layer: usize, block: usize) -> f32 {
        self.layer_of[block].iter().filter(|&&of| usize::from(of) == layer).count() as f32 / BLOCK as f32
    }

    /// Whether anything lies in one layer.
    pub(super) fn has_any_in(&self, layer: u8) -> bool {
        self.layer_of.par_iter().any(|block| block.contains(&layer))
    }

    /// The layers of the corners of each block of row `y`.
    pub(super) fn row(&self, y: usize) -> &[[u8; BLOCK]] {
        &self.layer_of[y * self.size.width..][..self.size.width]
    }

    /// Takes the depths of `frame`.
    pub(super) fn place(&mut self, frame: &RgbdFrame) {
        let blocks = Blocks { frame: frame.resolution, scale: SCALE };
        let (columns, count) = (self.size.width, self.count);
        self.layer_of.par_chunks_exact_mut(columns).enumerate().for_each(|(y, row)| {
            for (x, block) in row.iter_mut().enumerate() {
                for (corner, layer) in block.iter_mut().enumerate() {
                    let depth = frame.depth_normalised[blocks.index(x, y, corner)];
                    // A cast of what lies outside saturates.
                    *layer = ((depth * f32::from(count)) as u8).min(count - 1);
                }
            }
        });
    }
}
