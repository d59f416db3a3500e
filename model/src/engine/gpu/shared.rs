//! What the stages of every network share.

use holod_calibration::{PupilDiameter, Resolution};

use super::plan::{BufferId, Plan};
use crate::conditions::Conditions;
use crate::engine::Precision;

/// What every stage may read or write.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shared {
    /// The frame's size, which may be odd.
    pub(crate) resolution: Resolution,
    /// The network's grid: half of that each way, rounded up, or the same.
    pub(crate) size: Resolution,
    /// [4, height, width] at the frame's resolution: amplitudes of red, green and blue, then normalised depth.
    pub(crate) frame: BufferId,
    /// The pupil's diameter in millimetres; then what is told of it and the bench: blur and diffraction.
    pub(crate) pupil: BufferId,
    /// Of fields and their spectra in buffers.
    pub(crate) stored: Precision,
    /// [3, height, width] of complex numbers at the frame's resolution, as `stored`: the hologram.
    pub(crate) field: BufferId,
}

/// What [`Shared::pupil`] holds for a pupil.
pub(super) fn pupil_values(pupil: PupilDiameter, conditions: Conditions) -> [f32; 3] {
    let [blur, fresnel] = conditions.told();
    [pupil.mm(), blur as f32, fresnel as f32]
}

impl Shared {
    pub(crate) fn new(plan: &mut Plan, resolution: Resolution, size: Resolution, stored: Precision) -> Self {
        Self {
            resolution,
            size,
            frame: plan.buffer::<f32>("the frame", 4 * resolution.pixels()),
            pupil: plan.buffer::<[f32; 4]>("the pupil", 1),
            stored,
            field: stored.complex_buffer(plan, "the hologram", 3 * resolution.pixels()),
        }
    }
}

impl Precision {
    /// How buffers of [`Self::complex_buffer`] are read and written, in WGSL.
    pub(crate) fn complex(self) -> &'static str {
        match self {
            Self::Single => include_str!("complex_single.wgsl"),
            Self::Half => include_str!("complex_half.wgsl"),
        }
    }

    /// Memory for `count` complex numbers.
    pub(crate) fn complex_buffer(self, plan: &mut Plan, what: &'static str, count: usize) -> BufferId {
        match self {
            Self::Single => plan.buffer::<[f32; 2]>(what, count),
            Self::Half => plan.buffer::<[u16; 2]>(what, count),
        }
    }
}
