//! What traces the rays of thin-lens images.

use std::convert::Infallible;

use holod_calibration::{Dioptres, PupilDiameter};

use super::Scene;
#[cfg(feature = "gpu")]
use super::gpu::{GpuAdder, GpuTracer};
use super::thin_lens::{CpuAdder, Lens, focal_stacks};
use crate::gpu::GpuError;

/// Where rays are traced: the images agree to rounding.
pub enum Tracer {
    /// On the processor.
    Cpu,
    /// On a graphics processor.
    #[cfg(feature = "gpu")]
    Gpu(Box<GpuTracer>),
}

impl Tracer {
    /// The best graphics processor if there is one and its driver takes the shaders, else the processor.
    pub fn fastest() -> Self {
        #[cfg(feature = "gpu")]
        if let Ok(tracer) = crate::gpu::Gpu::open(crate::gpu::Adapters::Hardware).and_then(GpuTracer::new) {
            return Self::Gpu(Box::new(tracer));
        }
        Self::Cpu
    }

    /// Vulkan's best device, be it a processor that plays one.
    ///
    /// # Errors
    /// There is none, its driver refuses, or this program was built without the feature `gpu`.
    pub fn gpu() -> Result<Self, GpuError> {
        #[cfg(feature = "gpu")]
        return Ok(Self::Gpu(Box::new(GpuTracer::new(crate::gpu::Gpu::open(crate::gpu::Adapters::Any)?)?)));
        #[cfg(not(feature = "gpu"))]
        Err(GpuError::NotBuilt)
    }

    /// The device's name, or `cpu`.
    pub fn name(&self) -> &str {
        match self {
            Self::Cpu => "cpu",
            #[cfg(feature = "gpu")]
            Self::Gpu(tracer) => tracer.name(),
        }
    }

    /// The stacks one by one, as [`focal_stacks`] hands them out, and the number of rays.
    pub(super) fn trace(
        &self,
        scene: &Scene,
        pupils: &[PupilDiameter],
        focus: &[Dioptres],
        rays: usize,
        finish: impl FnMut(usize, &[f32], f32),
    ) -> Result<u64, GpuError> {
        let lens = Lens::new(&scene.surfaces, scene.resolution, focus);
        match self {
            Self::Cpu => {
                let traced = focal_stacks(&lens, &mut CpuAdder::new(&lens), pupils, rays, scene.ray_key, finish);
                Ok(traced.unwrap_or_else(|never: Infallible| match never {}))
            }
            #[cfg(feature = "gpu")]
            Self::Gpu(tracer) => {
                focal_stacks(&lens, &mut GpuAdder::new(tracer, &lens)?, pupils, rays, scene.ray_key, finish)
            }
        }
    }
}
