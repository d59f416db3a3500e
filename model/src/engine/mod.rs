//! Engines run the network on frames.

mod constants;
mod cpu;
mod disc;
#[cfg(test)]
mod golden;
#[cfg(feature = "gpu")]
mod gpu;
mod modulation;
#[cfg(test)]
mod reference;

use std::time::Duration;

use holod_calibration::{PupilDiameter, Resolution};

use crate::conditions::WIDEST_PUPIL;
use crate::gpu::GpuError;
use crate::weights::Architecture;

pub use cpu::{CpuEngine, FocalStackEngine, fma_peak, stream_bandwidth};
#[cfg(feature = "gpu-cost")]
pub use gpu::cost as gpu_cost;
#[cfg(feature = "gpu")]
pub use gpu::{EncodedCounts, GpuEngine};

/// What the layers of a network multiply, which is most of what is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// Numbers of 32 bits, IEEE 754.
    Single,
    /// 16 bits, with sums in 32: two products at once. On a GPU these are half-precision numbers, as which features are
    /// stored as well; on a processor bfloat16s. Where the device has none, single precision takes its place.
    Half,
}

/// A frame that an engine refuses.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum EngineError {
    /// A buffer has another size than the engine was made for.
    #[error("{what} is {found}; this engine was made for {expected}: make one for the other size or fit the frame")]
    Resolution { what: &'static str, found: Resolution, expected: Resolution },
    /// There is nothing to render.
    #[error("frame size {resolution}; expected at least one pixel each way")]
    Empty {
        /// The size asked for.
        resolution: Resolution,
    },
    /// The pupil is not a positive length, or wider than [`WIDEST_PUPIL`].
    #[error("pupil diameter {pupil_mm} mm; expected a positive number up to {widest_mm}", widest_mm = WIDEST_PUPIL.mm())]
    Pupil { pupil_mm: f32 },
    /// The weights are for an engine of other input.
    #[error("weights of a `{found}` network: it takes {takes}; {remedy}")]
    Family { found: Architecture, takes: &'static str, remedy: &'static str },
    /// A focal stack has other images than the network takes.
    #[error(
        "found {}; the network takes {}, uniform over the depth range of the rig: render the scene so; other numbers want a network of theirs (`--planes`)",
        at_focuses(found),
        at_focuses(expected)
    )]
    Focuses { found: Vec<f64>, expected: Vec<f64> },
    /// The device cannot do it, or failed at it.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

impl EngineError {
    fn takes_focal_stacks() -> Self {
        Self::Family {
            found: Architecture::FocalStack,
            takes: "images that are focused at several depths, not a picture and its depth",
            remedy: "hand them over with `holod render --focal-stack`, or take other weights",
        }
    }

    fn takes_frames(found: Architecture) -> Self {
        Self::Family {
            found,
            takes: "a picture and its depth, not a focal stack",
            remedy: "name the weights of a `focal-stack` network, or the scene",
        }
    }
}

fn at_focuses(focus_dpt: &[f64]) -> String {
    let focuses: Vec<String> = focus_dpt.iter().map(|focus_dpt| format!("{focus_dpt:.3}")).collect();
    format!("{} images focused at {} dpt", focuses.len(), focuses.join(", "))
}

/// Refuses what is no pupil.
fn check_pupil(pupil: PupilDiameter) -> Result<(), EngineError> {
    let pupil_mm = pupil.mm();
    if pupil_mm > 0.0 && pupil_mm <= WIDEST_PUPIL.mm() { Ok(()) } else { Err(EngineError::Pupil { pupil_mm }) }
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
    /// Wall-clock time that the stage took of the last frame.
    pub duration: Duration,
    /// Floating-point operations of matrix-like work as its definition has them, two to a multiply-add; 0 for other
    /// stages. Of those of a plain layer Winograd's filtering does with a quarter on a processor, and with half on a GPU.
    pub flop: u64,
    /// The least that its definition moves: each map, plane or field that it is given, read once, and each that it
    /// hands on, written once, without padding. What it makes on the way, parameters and tables do not count. 0 where
    /// it is not known.
    pub bytes: u64,
}
