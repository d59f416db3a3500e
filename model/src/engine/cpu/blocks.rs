//! The panel's pixels behind one sample of the network's grid.

use holod_calibration::Resolution;

use crate::weights::Grid;

/// Panel pixels to a sample of the half-band grid, each way.
pub(super) const SCALE: usize = scale_of(Grid::HalfBand);
/// Panel pixels to a sample, both ways.
pub(super) const PIXELS_PER_SAMPLE: usize = SCALE * SCALE;

/// Panel pixels to a sample of `grid`, each way.
pub(super) const fn scale_of(grid: Grid) -> usize {
    match grid {
        Grid::HalfBand => 2,
        Grid::Full => 1,
    }
}

/// Samples of `grid` on a panel of `resolution`, which may be odd.
pub(super) const fn grid_size(grid: Grid, resolution: Resolution) -> Resolution {
    let Resolution { width, height } = resolution;
    Resolution { width: width.div_ceil(scale_of(grid)), height: height.div_ceil(scale_of(grid)) }
}

/// Squares of `scale` by `scale` pixels of a frame; one of odd size repeats its edge.
#[derive(Clone, Copy)]
pub(super) struct Blocks {
    pub(super) frame: Resolution,
    pub(super) scale: usize,
}

impl Blocks {
    /// Where the frame has pixel `corner` of block (x, y), counted along rows: torch's order within a pixel_unshuffle.
    pub(super) fn index(self, x: usize, y: usize, corner: usize) -> usize {
        let Self { frame: Resolution { width, height }, scale } = self;
        let row = (scale * y + corner / scale).min(height - 1);
        row * width + (scale * x + corner % scale).min(width - 1)
    }
}
