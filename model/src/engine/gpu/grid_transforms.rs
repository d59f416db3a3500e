//! Fourier transforms on the network's grid.

use super::fft::{LineFft, WorkgroupLimits};
use super::plan::{BufferId, Plan};
use super::shared::Shared;
use crate::gpu::GpuError;

/// Transforms of the rows and columns of planes on the network's grid.
pub(super) struct GridTransforms {
    pub(super) rows: LineFft,
    pub(super) columns: LineFft,
    /// Scratch: planes of complex numbers, spectra along x of unitary transforms.
    pub(super) spectra: BufferId,
}

impl GridTransforms {
    /// For up to `planes` planes at a time.
    ///
    /// # Errors
    /// A row or a column does not fit in a workgroup's memory.
    pub(super) fn new(
        plan: &mut Plan,
        shared: &Shared,
        planes: usize,
        limits: WorkgroupLimits,
    ) -> Result<Self, GpuError> {
        let Shared { size, stored, .. } = *shared;
        Ok(Self {
            rows: LineFft::new(plan, size.width, stored, limits)?,
            columns: LineFft::new(plan, size.height, stored, limits)?,
            spectra: stored.complex_buffer(plan, "spectra of the layers", planes * size.pixels()),
        })
    }
}
