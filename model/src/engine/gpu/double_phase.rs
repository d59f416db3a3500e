//! Double phase on the GPU; [`DoublePhase`](crate::optics::DoublePhase) is its twin.

use std::sync::Arc;

use super::plan::{BufferId, Plan, Shader};
use super::shared::Shared;
use crate::optics::double_phase::{CORRECTION_GAIN, DARK_SHARE, LEAST_DARK, MOST_DARK, REACH, TILE};

const SOURCE: &str = concat!(include_str!("phase_math.wgsl"), include_str!("double_phase.wgsl"));
/// Edge of what a workgroup of the entry point `phases` does.
const SIDE: usize = 16;

/// Adds the stage `double phase`: the phases [3, height, width] of the hologram, of which `clipped` counts the samples
/// that exceed `amplitude_constant`. Returns the phases' buffer, radians in [0, 2π).
pub(crate) fn encode(plan: &mut Plan, shared: &Shared, amplitude_constant: f32, clipped: BufferId) -> BufferId {
    let (width, height) = (shared.resolution.width, shared.resolution.height);
    let errors = plan.buffer::<[f32; 2]>("errors of double phase", 3 * shared.resolution.pixels());
    let phases = plan.buffer::<f32>("phases", 3 * shared.resolution.pixels());
    let constants = [
        ("WIDTH", width.into()),
        ("HEIGHT", height.into()),
        ("AMPLITUDE_SCALE", (1.0 / amplitude_constant).into()),
        ("TILE", TILE.into()),
        ("DARK_SHARE", DARK_SHARE.into()),
        ("LEAST_DARK", LEAST_DARK.into()),
        ("MOST_DARK", MOST_DARK.into()),
        ("SIDE", SIDE.into()),
        ("REACH", REACH.into()),
        ("CORRECTION_GAIN", CORRECTION_GAIN.into()),
    ];
    let shader = |entry| Arc::new(Shader::new(format!("double phase: {entry}"), &constants, SOURCE, entry));
    let stage = plan.stage("double phase", 0);
    stage.dispatch_with(
        shader("pair_errors"),
        &[(0, shared.field), (1, errors), (2, clipped)],
        [width.div_ceil(TILE), height.div_ceil(TILE), 3],
    );
    stage.dispatch_with(
        shader("phases"),
        &[(0, shared.field), (1, errors), (3, phases)],
        [width.div_ceil(SIDE), height.div_ceil(SIDE), 3],
    );
    phases
}
