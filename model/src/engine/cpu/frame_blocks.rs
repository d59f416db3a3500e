//! A frame's pixels beside one another that lie behind the same sample of the half-band grid.

use holod_calibration::Resolution;
use rayon::prelude::*;

use super::blocks::{Blocks, PIXELS_PER_SAMPLE, SCALE};
use super::column_blocks::ColumnBlocks;
use crate::RgbdFrame;
use crate::simd::{InstructionSet, Simd, Task};

/// Planes of a frame: amplitudes and the depth.
const PLANES: usize = 4;
/// Which of them is the depth.
pub(super) const DEPTH: usize = 3;

/// For each plane of the frame four of the grid, one of each pixel behind a sample, as torch's `pixel_unshuffle` has
/// them.
pub(super) struct FrameBlocks {
    pub(super) planes: ColumnBlocks,
    set: InstructionSet,
}

impl FrameBlocks {
    pub(super) fn new(size: Resolution, set: InstructionSet) -> Self {
        Self { planes: ColumnBlocks::of_reals(PLANES * PIXELS_PER_SAMPLE, size, set), set }
    }

    /// Takes the pixels of `frame`.
    pub(super) fn take(&mut self, frame: &RgbdFrame) {
        let set = self.set;
        self.planes.par_blocks_mut().enumerate().for_each(|(block, planes)| {
            set.run(Take { frame, first: block * set.lanes(), planes });
        });
    }
}

/// The pixels behind a block of columns.
struct Take<'a> {
    frame: &'a RgbdFrame,
    /// The block's first column, in samples of the grid.
    first: usize,
    /// [plane, pixel, row, column of the block]
    planes: &'a mut [f32],
}

impl Task for Take<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { frame, first, planes } = self;
        let blocks = Blocks { frame: frame.resolution, scale: SCALE };
        let plane_len = planes.len() / (PLANES * PIXELS_PER_SAMPLE);
        let sources = frame.amplitude.chunks_exact(frame.resolution.pixels()).chain([&frame.depth_normalised[..]]);
        for (source, to) in sources.zip(planes.chunks_exact_mut(PIXELS_PER_SAMPLE * plane_len)) {
            for (pair, to) in to.chunks_exact_mut(SCALE * plane_len).enumerate() {
                let (left, right) = to.split_at_mut(plane_len);
                let rows = left.chunks_exact_mut(S::LANES).zip(right.chunks_exact_mut(S::LANES)).enumerate();
                for (y, (left, right)) in rows {
                    let corners = [SCALE * pair, SCALE * pair + 1];
                    if SCALE * (first + S::LANES) <= frame.resolution.width {
                        let pixels = &source[blocks.index(first, y, corners[0])..][..SCALE * S::LANES];
                        // SAFETY: two vectors lie in `pixels`, and one in each of the others.
                        unsafe {
                            let [low, high] = simd.load_strided(pixels.as_ptr(), S::LANES);
                            let [even, odd] = simd.unzip(low, high);
                            simd.store(left.as_mut_ptr(), even);
                            simd.store(right.as_mut_ptr(), odd);
                        }
                        continue;
                    }
                    for (to, corner) in [left, right].into_iter().zip(corners) {
                        for (x, value) in (first..).zip(to) {
                            *value = source[blocks.index(x, y, corner)];
                        }
                    }
                }
            }
        }
    }
}
