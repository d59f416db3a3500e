//! The `direct` family on the GPU: the field at the SLM plane as a residual to the amplitude.

use std::sync::Arc;

use super::map::{Format, Map};
use super::plan::{BufferId, Constant, Plan, Shader};
use super::shared::Shared;
use crate::weights::{Grid, NetworkConfig};

/// Pixels of a row that a workgroup does.
const WORKGROUP: usize = 64;

/// Adds the stage `encode`: what the net is told of the frame. Returns its map, in `format`.
pub(super) fn encode(plan: &mut Plan, config: &NetworkConfig, shared: &Shared, format: Format) -> Map {
    let size = shared.size;
    let input = Map::with(format, plan, "what the net reads", (size.width, size.height), config.map_channels());
    let shader = shader(config.grid, shared, &input, "encode");
    plan.stage("encode", 0).dispatch_with(
        shader,
        &[(0, shared.frame), (1, shared.pupil), (2, input.buffer)],
        [size.width.div_ceil(WORKGROUP), size.height, input.groups],
    );
    input
}

/// Adds the first part of the stage `field`: the field on the network's grid, [3, height, width], whose buffer it
/// returns. On the full grid that is the hologram's.
pub(super) fn add_residual(plan: &mut Plan, grid: Grid, shared: &Shared, output: &Map) -> BufferId {
    let size = shared.size;
    let low = match grid {
        Grid::HalfBand => shared.stored.complex_buffer(plan, "the field on the network's grid", 3 * size.pixels()),
        Grid::Full => shared.field,
    };
    let shader = shader(grid, shared, output, "add_residual");
    plan.stage("field", 0).dispatch_with(
        shader,
        &[(0, shared.frame), (2, output.buffer), (3, low)],
        [size.width.div_ceil(WORKGROUP), size.height, 1],
    );
    low
}

fn shader(grid: Grid, shared: &Shared, map: &Map, entry: &'static str) -> Arc<Shader> {
    let scale: usize = match grid {
        Grid::HalfBand => 2,
        Grid::Full => 1,
    };
    let constants: [(&str, Constant); 6] = [
        ("WORKGROUP", WORKGROUP.into()),
        ("FRAME_WIDTH", shared.resolution.width.into()),
        ("FRAME_HEIGHT", shared.resolution.height.into()),
        ("WIDTH", shared.size.width.into()),
        ("HEIGHT", shared.size.height.into()),
        ("SCALE", scale.into()),
    ];
    let source = [&map.declaration("map"), shared.stored.complex(), include_str!("direct.wgsl")].concat();
    Arc::new(Shader::new(format!("direct: {entry}"), &constants, &source, entry))
}
