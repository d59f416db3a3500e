//! What an eye should see at each depth layer, for `defocus.wgsl`.

use holod_calibration::DisplayGeometry;

use super::fft::Lines;
use super::grid_transforms::GridTransforms;
use super::input_features::{InputChannels, grid_constants, plane_bytes, sample_pitch};
use super::map::{GROUP, Map};
use super::plan::{BufferId, Constant, Plan};
use super::shared::Shared;
use crate::engine::constants::{LEAST_COVER, PAIRS};
use crate::engine::disc::DiscTable;
use crate::weights::NetworkConfig;

/// Foci whose spectra a thread holds at once; where there are more layers, these are transformed anew for each so many.
const MOST_FOCI: usize = 8;
/// Samples of each of these that a thread holds.
const BLUR_ITEMS: usize = 4;
/// Samples that a thread holds of the rows of a frame, and of the colours at four foci.
const ROW_ITEMS: usize = 4;

/// Planes of complex numbers on the network's grid that the stage needs as scratch.
pub(super) fn scratch_planes(depth_layers: usize) -> usize {
    let buffers = if depth_layers > MOST_FOCI { 2 } else { 1 };
    buffers * PAIRS * depth_layers
}

/// Adds the stage `expected stack`, which writes the layers of each block's corners, the stack, and to `inputs` the
/// frame's maps and the stack.
#[expect(clippy::too_many_arguments)]
pub(super) fn expect(
    plan: &mut Plan,
    config: &NetworkConfig,
    bench: &DisplayGeometry,
    shared: &Shared,
    grid: &GridTransforms,
    layer_of: BufferId,
    stack: BufferId,
    inputs: &Map,
) {
    let (count, size) = (config.depth_layers, shared.size);
    let disc = DiscTable::new(bench, count, sample_pitch(bench).0 / bench.eyepiece_focal_length.0);
    let disc_table = plan.table("the spectrum of a disc", &disc.values);

    let foci = count.min(MOST_FOCI);
    let first_part = InputChannels::new(count, inputs.format).field;
    let constants: Vec<(&str, Constant)> = grid_constants(shared.resolution, size)
        .into_iter()
        .chain([
            ("LAYERS", count.into()),
            ("PAIRS", PAIRS.into()),
            ("LEAST_COVER", LEAST_COVER.into()),
            ("FOCI", foci.into()),
            ("FIRST_SEEN", (scratch_planes(count) - PAIRS * count).into()),
            ("FIRST_PART_GROUPS", (first_part / GROUP).into()),
            ("DISC_ENTRIES", disc.values.len().into()),
            ("ENTRIES_PER_MM", (disc.entries_per_mm as f32).into()),
        ])
        .collect();
    let declared = inputs.declaration("input");
    let features = include_str!("input_features.wgsl");
    let files = [&declared, include_str!("blocks.wgsl"), features, include_str!("defocus.wgsl")];
    let shader = |lines: &Lines, entry| lines.shader(&format!("defocus: {entry}"), &constants, &files, entry);
    let (rows, columns) = (grid.rows.rows(ROW_ITEMS), grid.columns.columns(BLUR_ITEMS));
    let (row_groups, column_groups) = (rows.workgroups(size.height), columns.workgroups(size.width));
    let [complex, real, group] = plane_bytes(size);
    let (chunks, spectra) = (count.div_ceil(foci), (PAIRS * count) as u64 * complex);
    let frame_bytes = (4 * size_of::<f32>() * shared.resolution.pixels()) as u64;
    let stage = plan.stage("expected stack", 0);
    let take_layers = stage.dispatch_with(
        shader(&rows, "take_layers"),
        &[rows.turns(), (1, shared.frame), (2, shared.pupil), (3, layer_of), (4, grid.spectra), (7, inputs.buffer)],
        [row_groups, 1, 1],
    );
    take_layers.bytes = Some(frame_bytes + real + spectra + 5 * group);
    let blur = stage.dispatch_with(
        shader(&columns, "blur"),
        &[columns.turns(), (2, shared.pupil), (4, grid.spectra), (5, disc_table)],
        [column_groups, PAIRS, chunks],
    );
    blur.bytes = Some((chunks as u64 + 1) * spectra);
    let see = stage.dispatch_with(
        shader(&rows, "see"),
        &[rows.turns(), (2, shared.pupil), (4, grid.spectra), (6, stack), (7, inputs.buffer)],
        [row_groups, 1 + (count - 2).div_ceil(4), 1],
    );
    see.bytes = Some(spectra + 3 * count as u64 * real + (first_part / GROUP - 5) as u64 * group);
}
