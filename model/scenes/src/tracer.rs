//! What traces the rays of thin-lens images.

use std::convert::Infallible;

use holod_calibration::{Dioptres, PupilDiameter};
use holod_model::gpu::GpuError;
#[cfg(feature = "gpu")]
use holod_model::gpu::{Adapters, Gpu};

use super::Scene;
#[cfg(feature = "gpu")]
use super::gpu::{GpuAdder, GpuTracer};
use super::thin_lens::{CpuAdder, Lens, focal_stacks};

/// Where rays are traced: the same rays, so that images agree to rounding.
pub struct Tracer(Kind);

enum Kind {
    Cpu,
    #[cfg(feature = "gpu")]
    Gpu(Box<GpuTracer>),
}

impl Tracer {
    /// One that renders on the cores of the processor.
    pub fn cpu() -> Self {
        Self(Kind::Cpu)
    }

    /// On the best graphics processor that Vulkan shows.
    ///
    /// # Errors
    /// There is none, its driver refuses, or this program was built without the feature `gpu`.
    pub fn gpu() -> Result<Self, GpuError> {
        #[cfg(feature = "gpu")]
        return Self::on(Gpu::open(Adapters::Hardware.into())?);
        #[cfg(not(feature = "gpu"))]
        Err(GpuError::NotBuilt)
    }

    /// On a processor that plays a graphics processor, such as Mesa's llvmpipe: slow, to test the shaders.
    ///
    /// # Errors
    /// As [`Tracer::gpu`].
    pub fn software_gpu() -> Result<Self, GpuError> {
        #[cfg(feature = "gpu")]
        return Self::on(Gpu::open(Adapters::Software.into())?);
        #[cfg(not(feature = "gpu"))]
        Err(GpuError::NotBuilt)
    }

    #[cfg(feature = "gpu")]
    pub(super) fn on(gpu: Gpu) -> Result<Self, GpuError> {
        Ok(Self(Kind::Gpu(Box::new(GpuTracer::new(gpu)?))))
    }

    /// The device's name, or `cpu`.
    pub fn name(&self) -> &str {
        match &self.0 {
            Kind::Cpu => "cpu",
            #[cfg(feature = "gpu")]
            Kind::Gpu(tracer) => tracer.name(),
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
        match &self.0 {
            Kind::Cpu => {
                let traced: Result<u64, Infallible> =
                    focal_stacks(&lens, &mut CpuAdder::new(&lens), pupils, rays, scene.ray_key, finish);
                let Ok(traced) = traced;
                Ok(traced)
            }
            #[cfg(feature = "gpu")]
            Kind::Gpu(tracer) => {
                focal_stacks(&lens, &mut GpuAdder::new(tracer, &lens)?, pupils, rays, scene.ray_key, finish)
            }
        }
    }
}
