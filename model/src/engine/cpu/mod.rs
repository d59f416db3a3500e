//! The network on the CPU: channels-last maps, planes in blocks of columns, rayon over rows or blocks, SIMD chosen at
//! run time.

mod blocks;
mod column_blocks;
mod conv;
mod defocus;
mod deformable;
mod depth_layers;
mod direct;
mod expected_stack;
mod feature_map;
mod feedback;
mod field;
mod focal_stack;
mod frame_blocks;
mod input_features;
mod line_fft;
mod network;
mod peak;
mod plane_fft;
mod plane_light;
mod plane_stack;
mod product;
mod pupil_stop;
mod stage;
mod stage_list;
#[cfg(test)]
pub(super) mod tests;
mod trunk;
mod view;
mod workers;

use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution};

use self::network::Network;
use crate::conditions::SAME_FOCUS_DPT;
use crate::engine::{EngineError, Precision, StageTimings, check_pupil};
use crate::scene::FocalStack;
use crate::simd::{InstructionSet, Products};
use crate::weights::{Architecture, NetworkConfig};
use crate::{ComplexHologram, RgbdFrame, Weights};

use self::peak::half_pays;

pub use peak::{fma_peak, stream_bandwidth};

/// The network on the CPU, for frames of one size. It works on the threads of the [`WorkerPool`](crate::WorkerPool)
/// that it is called in, elsewhere on rayon's own.
pub struct CpuEngine {
    network: Network<RgbdFrame>,
    resolution: Resolution,
    products: Products,
}

impl CpuEngine {
    /// An engine for frames of `resolution`, which may be odd, on the optics of `bench`, whose own resolution does not
    /// matter, in `precision` where the processor gains by that.
    ///
    /// # Errors
    /// [`EngineError::Empty`], and [`EngineError::Family`] for weights that take focal stacks.
    pub fn new(
        weights: &Weights,
        bench: &DisplayGeometry,
        resolution: Resolution,
        precision: Precision,
    ) -> Result<Self, EngineError> {
        check_not_empty(resolution)?;
        let products = products_in(precision);
        Ok(Self { network: Network::of_frames(weights, bench, resolution, products)?, resolution, products })
    }

    /// Writes the hologram of `frame` for an eye with `pupil` to `hologram`. Does not allocate in a
    /// [`WorkerPool`](crate::WorkerPool).
    ///
    /// Of a pupil beyond those that the weights were trained for, the network is told the nearest; blur and stop are
    /// its own.
    ///
    /// # Errors
    /// [`EngineError`] for buffers of another size than the engine's, and a pupil that is none.
    pub fn render(
        &mut self,
        frame: &RgbdFrame,
        pupil: PupilDiameter,
        hologram: &mut ComplexHologram,
    ) -> Result<(), EngineError> {
        check_sizes(self.resolution, [("the frame", frame.resolution), ("the hologram", hologram.resolution)])?;
        check_pupil(pupil)?;
        self.network.render(frame, pupil, hologram);
        Ok(())
    }

    /// Where the time of the last frame went.
    pub fn last_timings(&self) -> &StageTimings {
        &self.network.timings
    }

    /// Which instruction set the kernels use, and its precision where it is half: `avx512 in half precision`, `avx512`,
    /// `avx2` or `portable`.
    pub fn instruction_set(&self) -> &'static str {
        self.products.name()
    }
}

/// A `focal-stack` network on the CPU, for images of one size.
pub struct FocalStackEngine {
    network: Network<FocalStack>,
    focuses: Vec<Dioptres>,
    resolution: Resolution,
    products: Products,
}

impl FocalStackEngine {
    /// An engine for images of `resolution`, which may be odd, on the optics of `bench`, whose own resolution does not
    /// matter, in `precision` where the processor gains by that.
    ///
    /// # Errors
    /// [`EngineError::Empty`], and [`EngineError::Family`] for weights that take a picture with depth.
    pub fn new(
        weights: &Weights,
        bench: &DisplayGeometry,
        resolution: Resolution,
        precision: Precision,
    ) -> Result<Self, EngineError> {
        check_not_empty(resolution)?;
        let products = products_in(precision);
        let network = Network::of_focal_stacks(weights, bench, resolution, products)?;
        let focuses = Self::focuses(weights, bench)?;
        Ok(Self { network, focuses, resolution, products })
    }

    /// Where the images that `weights` take on `bench` are focused, far to near.
    ///
    /// # Errors
    /// [`EngineError::Family`] for weights that take a picture with depth.
    pub fn focuses(weights: &Weights, bench: &DisplayGeometry) -> Result<Vec<Dioptres>, EngineError> {
        let &NetworkConfig { architecture, planes, .. } = &weights.config;
        if architecture != Architecture::FocalStack {
            return Err(EngineError::takes_frames(architecture));
        }
        Ok((0..planes).map(|plane| bench.depth_at(plane as f64 / (planes - 1) as f64)).collect())
    }

    /// Whether `weights` take images at `found` on `bench`, before these are read.
    ///
    /// # Errors
    /// [`EngineError::Family`], and [`EngineError::Focuses`] for another number of images or other focuses.
    pub fn check(weights: &Weights, bench: &DisplayGeometry, found: &[Dioptres]) -> Result<(), EngineError> {
        check_focuses(found, &Self::focuses(weights, bench)?)
    }

    /// Writes the hologram of `stack`, for an eye with the pupil that it was made for, to `hologram`.
    ///
    /// # Errors
    /// As [`Self::check`] and [`CpuEngine::render`] have them.
    pub fn render(&mut self, stack: &FocalStack, hologram: &mut ComplexHologram) -> Result<(), EngineError> {
        check_sizes(self.resolution, [("the stack", stack.resolution), ("the hologram", hologram.resolution)])?;
        check_pupil(stack.pupil)?;
        check_focuses(&stack.focuses, &self.focuses)?;
        assert_eq!(stack.amplitude.len(), 3 * stack.focuses.len() * stack.resolution.pixels(), "one image a focus");
        self.network.render(stack, stack.pupil, hologram);
        Ok(())
    }

    /// Which instruction set the kernels use, by the names of [`CpuEngine::instruction_set`].
    pub fn instruction_set(&self) -> &'static str {
        self.products.name()
    }
}

/// The best that the processor has: in half precision only where that is asked for and is faster.
fn products_in(precision: Precision) -> Products {
    let half = if precision == Precision::Half { Products::half().filter(|_| half_pays()) } else { None };
    half.unwrap_or(Products::Single(InstructionSet::best()))
}

fn check_not_empty(resolution: Resolution) -> Result<(), EngineError> {
    if resolution.pixels() == 0 { Err(EngineError::Empty { resolution }) } else { Ok(()) }
}

fn check_sizes(expected: Resolution, sizes: [(&'static str, Resolution); 2]) -> Result<(), EngineError> {
    match sizes.into_iter().find(|(_, found)| *found != expected) {
        Some((what, found)) => Err(EngineError::Resolution { what, found, expected }),
        None => Ok(()),
    }
}

fn check_focuses(found: &[Dioptres], expected: &[Dioptres]) -> Result<(), EngineError> {
    let is_near = |(found, expected): (&Dioptres, &Dioptres)| (found.0 - expected.0).abs() <= SAME_FOCUS_DPT;
    if found.len() == expected.len() && found.iter().zip(expected).all(is_near) {
        return Ok(());
    }
    let told = |focuses: &[Dioptres]| focuses.iter().map(|focus| focus.0).collect();
    Err(EngineError::Focuses { found: told(found), expected: told(expected) })
}
