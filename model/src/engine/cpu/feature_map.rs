//! Maps between layers: channels last, with a border.

use rayon::prelude::*;

use super::workers::share_out;
use crate::simd::InstructionSet;

/// Side of the squares of pixels that a layer computes together.
pub(super) const TILE: usize = 4;
/// Rows of a band: those of one block of columns lie together in the cache.
pub(super) const BAND: usize = 16;

/// A feature map [height, width, channels] with a border of zeros: one pixel before, and after as many as fill the last
/// tile and one more. Nothing but zeros is ever written there.
///
/// Channels are padded with zeros to whole vectors.
pub(super) struct FeatureMap {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Channels of a pixel in memory.
    pub(super) stride: usize,
    pub(super) row_len: usize,
    data: Vec<f32>,
}

impl FeatureMap {
    pub(super) fn new(width: usize, height: usize, channels: usize, set: InstructionSet) -> Self {
        let stride = channels.next_multiple_of(set.lanes());
        let row_len = (width.next_multiple_of(TILE) + 2) * stride;
        Self { width, height, stride, row_len, data: vec![0.0; (height.next_multiple_of(TILE) + 2) * row_len] }
    }

    /// The rows inside the border, each with its border pixels: pixel x begins at (x + 1)·stride.
    pub(super) fn rows_mut(&mut self) -> impl IndexedParallelIterator<Item = &mut [f32]> {
        self.data[self.row_len..].par_chunks_exact_mut(self.row_len).take(self.height)
    }

    /// The same, [`BAND`] rows together, the last time perhaps fewer: so what lies in blocks of columns is read row after
    /// row of a block.
    pub(super) fn bands_mut(&mut self) -> impl IndexedParallelIterator<Item = &mut [f32]> {
        self.data[self.row_len..][..self.height * self.row_len].par_chunks_mut(BAND * self.row_len)
    }

    /// Runs `work(scratch, y, rows)` for each row of tiles, the last one perhaps with fewer than [`TILE`] rows, from
    /// `y` on and as [`Self::rows_mut`] has them. Each worker takes one after another, with its own of the scratches.
    pub(super) fn for_each_tile_row<T: Send>(
        &mut self,
        scratches: &mut [T],
        work: impl Fn(&mut T, usize, &mut [f32]) + Sync,
    ) {
        let rows = self.data[self.row_len..][..self.height * self.row_len].chunks_mut(TILE * self.row_len);
        let rows_from = (0..self.height).step_by(TILE);
        share_out(scratches, rows_from.zip(rows), |scratch, (y, rows)| work(scratch, y, rows));
    }

    /// The rows from the one above row `y` on; row `y` is one row further, with its border pixels.
    pub(super) fn rows_from_above(&self, y: usize) -> &[f32] {
        &self.data[y * self.row_len..]
    }

    /// The channels of pixel (x, y) and of what lies after it, with the border and further rows.
    pub(super) fn pixels_from(&self, x: usize, y: usize) -> &[f32] {
        &self.data[(y + 1) * self.row_len + (x + 1) * self.stride..]
    }

    /// The channels of one pixel.
    pub(super) fn pixel(&self, x: usize, y: usize) -> &[f32] {
        &self.data[(y + 1) * self.row_len + (x + 1) * self.stride..][..self.stride]
    }
}
