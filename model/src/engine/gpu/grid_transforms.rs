//! Fourier transforms on the network's grid.

use holod_calibration::Resolution;

use super::fft::{LineFft, WorkgroupLimits};
use super::plan::{BufferId, Plan};
use crate::gpu::GpuError;

/// Transforms of the rows and columns of planes on the network's grid.
pub(super) struct GridTransforms {
    pub(super) rows: LineFft,
    pub(super) columns: LineFft,
    /// Scratch: planes of complex numbers.
    pub(super) spectra: BufferId,
}

impl GridTransforms {
    /// For up to `planes` planes of `size` at a time.
    ///
    /// # Errors
    /// A row or a column does not fit in a workgroup's memory.
    pub(super) fn new(
        plan: &mut Plan,
        size: Resolution,
        planes: usize,
        limits: WorkgroupLimits,
    ) -> Result<Self, GpuError> {
        Ok(Self {
            rows: LineFft::new(plan, size.width, limits)?,
            columns: LineFft::new(plan, size.height, limits)?,
            spectra: plan.buffer::<[f32; 2]>("spectra of the layers", planes * size.pixels()),
        })
    }
}
