//! Engines run the network on frames.

mod cpu;
#[cfg(test)]
mod golden;
#[cfg(feature = "gpu")]
mod gpu;
mod modulation;
#[cfg(test)]
mod reference;

use std::time::Duration;

use holod_calibration::Resolution;

use crate::gpu::GpuError;

pub use cpu::{CpuEngine, fma_peak, stream_bandwidth};
#[cfg(feature = "gpu-cost")]
pub use gpu::cost as gpu_cost;
#[cfg(feature = "gpu")]
pub use gpu::{EncodedCounts, GpuEngine};

/// A frame that an engine refuses.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EngineError {
    /// A buffer has another size than the engine was made for.
    #[error("{what} is {found}; this engine was made for {expected}: make one for the other size or fit the frame")]
    Resolution {
        /// Which buffer.
        what: &'static str,
        /// Its size.
        found: Resolution,
        /// The engine's size.
        expected: Resolution,
    },
    /// There is nothing to render.
    #[error("frame size {resolution}; expected at least one pixel each way")]
    Empty {
        /// The size asked for.
        resolution: Resolution,
    },
    /// The pupil is not a positive length.
    #[error("pupil diameter {pupil_mm} mm; expected a positive number")]
    Pupil {
        /// What was given.
        pupil_mm: f32,
    },
    /// The device cannot do it, or failed at it.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

/// Where the time of one frame went.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StageTimings {
    /// Stages in the order in which they ran.
    pub stages: Vec<StageTiming>,
}

/// One stage of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct StageTiming {
    /// The stage's name, such as `layer 3`.
    pub name: String,
    /// Wall-clock time.
    pub duration: Duration,
    /// Floating-point operations of matrix-like work as its definition has them, two to a multiply-add; 0 for other
    /// stages. Winograd's filtering does with a quarter of those of a plain layer.
    pub flop: u64,
    /// The least that its definition moves: each map, plane or field that it is given, read once, and each that it hands
    /// on, written once, without padding. What it makes on the way, parameters and tables do not count. 0 where it is not
    /// known.
    pub bytes: u64,
}
