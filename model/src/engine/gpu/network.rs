//! A network's plan: what its stages share, and their order.

use holod_calibration::Resolution;

use super::plan::{BufferId, Plan};

/// What every stage may read or write.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shared {
    /// The frame's size, which may be odd.
    pub(crate) resolution: Resolution,
    /// The network's grid: half of that each way, rounded up, or the same.
    pub(crate) size: Resolution,
    /// [4, height, width] at the frame's resolution: amplitudes of red, green and blue, then normalised depth.
    pub(crate) frame: BufferId,
    /// One number: the pupil's diameter in millimetres, inside the range that the weights were trained for.
    pub(crate) pupil: BufferId,
    /// [3, height, width] of complex numbers at the frame's resolution: the hologram.
    pub(crate) field: BufferId,
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
