//! The network on the CPU: channels-last maps, rayon over rows, SIMD chosen at run time.

mod blocks;
mod conv;
mod defocus;
mod deformable;
mod depth_layers;
mod direct;
mod expected_stack;
mod feature_map;
mod feedback;
mod field;
mod input_features;
mod network;
mod peak;
mod product;
mod stage;
mod stage_list;
#[cfg(test)]
pub(super) mod tests;
mod trunk;

use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};

use self::network::Network;
use crate::engine::{EngineError, StageTimings, check_pupil};
use crate::simd::InstructionSet;
use crate::{ComplexHologram, RgbdFrame, Weights};

pub use peak::{fma_peak, stream_bandwidth};

/// The network on the CPU, for frames of one size. It works on the threads of the [`WorkerPool`](crate::WorkerPool)
/// that it is called in, elsewhere on rayon's own.
pub struct CpuEngine {
    network: Network,
    resolution: Resolution,
    set: InstructionSet,
}

impl CpuEngine {
    /// An engine for frames of `resolution`, which may be odd, on the optics of `bench`, whose own resolution does not
    /// matter.
    ///
    /// # Errors
    /// [`EngineError::Empty`].
    pub fn new(weights: &Weights, bench: &DisplayGeometry, resolution: Resolution) -> Result<Self, EngineError> {
        if resolution.pixels() == 0 {
            return Err(EngineError::Empty { resolution });
        }
        let set = InstructionSet::best();
        Ok(Self { network: Network::new(weights, bench, resolution, set), resolution, set })
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
        for (what, found) in [("the frame", frame.resolution), ("the hologram", hologram.resolution)] {
            if found != self.resolution {
                return Err(EngineError::Resolution { what, found, expected: self.resolution });
            }
        }
        check_pupil(pupil)?;
        self.network.render(frame, pupil, hologram);
        Ok(())
    }

    /// Where the time of the last frame went.
    pub fn last_timings(&self) -> &StageTimings {
        &self.network.timings
    }

    /// Which instruction set the kernels use: `avx512`, `avx2` or `portable`.
    pub fn instruction_set(&self) -> &'static str {
        self.set.name()
    }
}
