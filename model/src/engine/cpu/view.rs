//! What is known of where planes of the depth volume are in focus.

use crate::simd::Simd;

/// Where it is known what is to be seen at the planes.
pub(super) trait View: Send + Sync {
    /// What the network makes holograms of.
    type Input;

    /// The share that is known to be in focus at a plane of each sample in row `y` of a block of columns.
    fn share_in_focus<S: Simd>(&self, simd: S, plane: usize, block: usize, y: usize) -> S::Vector;
}
