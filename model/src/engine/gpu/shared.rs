//! What the stages of every network share.

use holod_calibration::{PupilDiameter, Resolution};

use super::plan::{BufferId, Plan};
use crate::conditions::Conditions;

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
    /// [3, height, width] of complex numbers at the frame's resolution: the hologram.
    pub(crate) field: BufferId,
}

/// What [`Shared::pupil`] holds for a pupil.
pub(super) fn pupil_values(pupil: PupilDiameter, conditions: Conditions) -> [f32; 3] {
    let [blur, fresnel] = conditions.told();
    [pupil.mm(), blur as f32, fresnel as f32]
}

impl Shared {
    pub(crate) fn new(plan: &mut Plan, resolution: Resolution, size: Resolution) -> Self {
        Self {
            resolution,
            size,
            frame: plan.buffer::<f32>("the frame", 4 * resolution.pixels()),
            pupil: plan.buffer::<[f32; 4]>("the pupil", 1),
            field: plan.buffer::<[f32; 2]>("the hologram", 3 * resolution.pixels()),
        }
    }
}
