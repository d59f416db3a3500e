//! The panel's samples on the GPU; `PanelEncoder` of `holod-slm-output` is their twin.

use holod_calibration::{Colour, LevelTables};

use super::plan::{BufferId, Plan, Shader};

/// Threads of a workgroup, and its samples.
const THREADS: usize = 256;
const SAMPLES: usize = 2 * THREADS;
/// Workgroups of a row of the grid.
const ROW: usize = 1 << 15;

/// Adds the stage `panel levels`: the samples of `phases` [3, height, width], two to 32 bits; of each colour
/// `unreachable` counts those that the panel cannot show. Returns the samples' buffer.
pub(crate) fn encode(plan: &mut Plan, tables: &LevelTables, phases: BufferId, unreachable: BufferId) -> BufferId {
    let LevelTables { panel, pattern, origin: [left, top], mirrors: [mirror_x, mirror_y], .. } = tables;
    let LevelTables { interleaved, field_order, levels, flatness, .. } = tables;
    let entries = levels.0[0].len();
    assert!(
        entries.is_power_of_two() && levels.0.iter().all(|table| table.len() == entries),
        "tables of levels are of one size, a power of two"
    );
    let count = 3 * panel.pixels();
    let all_levels: Vec<u32> = levels.0.concat();
    let is_flat = flatness.0.iter().all(Option::is_none);
    let all_flatness: Vec<f32> = match is_flat {
        true => vec![0.0],
        false => {
            let of = |flatness: &Option<Vec<f32>>| flatness.clone().unwrap_or_else(|| vec![0.0; panel.pixels()]);
            flatness.0.iter().flat_map(of).collect()
        }
    };
    let [first, second, third] = field_order.map(Colour::index);
    let constants = [
        ("THREADS", THREADS.into()),
        ("PANEL_WIDTH", panel.width.into()),
        ("PANEL_HEIGHT", panel.height.into()),
        ("WIDTH", pattern.width.into()),
        ("HEIGHT", pattern.height.into()),
        ("LEFT", (*left).into()),
        ("TOP", (*top).into()),
        ("MIRROR_X", (*mirror_x).into()),
        ("MIRROR_Y", (*mirror_y).into()),
        ("INTERLEAVED", (*interleaved).into()),
        ("FIRST", first.into()),
        ("SECOND", second.into()),
        ("THIRD", third.into()),
        ("ENTRIES", entries.into()),
        ("FLATNESS", (!is_flat).into()),
    ];
    let levels = plan.table("levels of phases", &all_levels);
    let flatness = plan.table("flatness", &all_flatness);
    let samples = plan.buffer::<u32>("samples", count.div_ceil(2));
    let groups = count.div_ceil(SAMPLES);
    let shader = Shader::new("panel levels", &constants, include_str!("levels.wgsl"), "levels");
    plan.stage("panel levels", 0).dispatch(
        shader,
        &[phases, levels, flatness, samples, unreachable],
        [groups.min(ROW), groups.div_ceil(ROW), 1],
    );
    samples
}
