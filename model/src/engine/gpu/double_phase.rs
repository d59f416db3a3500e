//! Double phase on the GPU; [`DoublePhase`](crate::optics::DoublePhase) is its twin.

use std::sync::Arc;

use super::plan::{BufferId, Plan, Shader};
use super::shared::Shared;
use crate::optics::double_phase::{CORRECTION_GAIN, DARK_SHARE, LEAST_DARK, MOST_DARK, REACH, TILE};

/// Blocks of 4x4 pixels of a workgroup of the entry point `phases`, with one at each edge that it shares with others.
const BLOCKS_ACROSS: usize = 16;
const BLOCKS_DOWN: usize = 16;
/// Strips of columns that its threads do.
const STRIPS: usize = 4;

/// Adds the stage `double phase`: the phases [3, height, width] of the hologram, of which `clipped` counts the samples
/// that exceed `amplitude_constant`. Returns the phases' buffer, radians in [0, 2π).
pub(crate) fn encode(plan: &mut Plan, shared: &Shared, amplitude_constant: f32, clipped: BufferId) -> BufferId {
    let (width, height) = (shared.resolution.width, shared.resolution.height);
    let tiles = [width.div_ceil(TILE), height.div_ceil(TILE)];
    let powers = plan.buffer::<f32>("powers of tiles", 3 * tiles[0] * tiles[1]);
    let phases = plan.buffer::<f32>("phases", 3 * shared.resolution.pixels());
    let constants = [
        ("WIDTH", width.into()),
        ("HEIGHT", height.into()),
        ("AMPLITUDE_SCALE", (1.0 / amplitude_constant).into()),
        ("TILE", TILE.into()),
        ("DARK_SHARE", DARK_SHARE.into()),
        ("LEAST_DARK", LEAST_DARK.into()),
        ("MOST_DARK", MOST_DARK.into()),
        ("BLOCKS_ACROSS", BLOCKS_ACROSS.into()),
        ("BLOCKS_DOWN", BLOCKS_DOWN.into()),
        ("STRIPS", STRIPS.into()),
        ("REACH", REACH.into()),
        ("CORRECTION_GAIN", CORRECTION_GAIN.into()),
    ];
    let source = [shared.stored.complex(), include_str!("phase_math.wgsl"), include_str!("double_phase.wgsl")].concat();
    let shader = |entry| Arc::new(Shader::new(format!("double phase: {entry}"), &constants, &source, entry));
    let stage = plan.stage("double phase", 0);
    stage.dispatch_with(
        shader("measure_tiles"),
        &[(0, shared.field), (1, powers), (2, clipped)],
        [tiles[0], tiles[1], 3],
    );
    let [across, down] = [BLOCKS_ACROSS, BLOCKS_DOWN].map(|blocks| 4 * (blocks - 2));
    stage.dispatch_with(
        shader("phases"),
        &[(0, shared.field), (1, powers), (3, phases)],
        [width.div_ceil(across), height.div_ceil(down), 3],
    );
    phases
}
