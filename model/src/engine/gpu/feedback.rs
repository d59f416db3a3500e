//! What an eye lacks when it focuses on each depth layer, fed back to the field at the SLM plane, for `feedback.wgsl`.

use holod_calibration::{DisplayGeometry, Metres};

use super::depth_layers::{DepthLayers, transfer_tables};
use super::fft::Lines;
use super::grid_transforms::GridTransforms;
use super::input_features::{InputChannels, plane_bytes};
use super::map::{GROUP, Map};
use super::plan::{BufferId, Constant, Plan};
use super::shared::Shared;
use crate::engine::constants::FEEDBACK_DARK_POWER;
use crate::weights::{Feedback, NetworkConfig};

/// Samples that a thread holds of a row, and of a column.
const ROW_ITEMS: usize = 4;
const COLUMN_ITEMS: usize = 6;

/// Adds the stage `feedback`: changes the carried field by what it lacks of the amplitudes `stack`, and writes the
/// field, its change and the lack to `inputs`.
#[expect(clippy::too_many_arguments)]
pub(super) fn feed_back(
    plan: &mut Plan,
    config: &NetworkConfig,
    bench: &DisplayGeometry,
    Feedback { share, sharpness }: Feedback,
    shared: &Shared,
    grid: &GridTransforms,
    layers: &DepthLayers,
    [layer_of, stack]: [BufferId; 2],
    inputs: &Map,
) {
    let (count, size) = (config.depth_layers, shared.size);
    let far_m = bench.image_distance(bench.depth_far).0;
    let volume_m = bench.image_distance(bench.depth_near).0 - far_m;
    let farthest = Metres(far_m + volume_m / (2 * count) as f64);
    let samples = size.pixels() as f32;
    // The carried spectrum is already over the number of samples.
    let to_farthest: Vec<_> =
        transfer_tables(bench, shared, farthest).map(|[re, im]| [re * samples, im * samples]).collect();
    let to_farthest = plan.table("the way to the farthest layer", &to_farthest);

    let channels = InputChannels::new(count, inputs.format);
    let own: [(&str, Constant); 6] = [
        ("DARK_POWER", FEEDBACK_DARK_POWER.into()),
        ("SHARE", share.into()),
        ("SHARPNESS", sharpness.into()),
        ("FIELD_GROUP", (channels.field / GROUP).into()),
        ("LACK_GROUP", (channels.lack / GROUP).into()),
        ("INPUT_GROUPS", inputs.groups.into()),
    ];
    let constants = [layers.constants(), &own].concat();
    let declared = inputs.declaration("input");
    let files = [&declared, include_str!("pupil.wgsl"), include_str!("feedback.wgsl")];
    let shader = |lines: &Lines, entry| lines.shader(&format!("feedback: {entry}"), &constants, &files, entry);
    let (rows, columns) = (grid.rows.rows(ROW_ITEMS), grid.columns.columns(COLUMN_ITEMS));
    let row_groups = rows.workgroups(size.height);
    let [complex, real, group] = plane_bytes(size);
    let (planes, batches) = (3 * count as u64, count.div_ceil(4));
    let stage = plan.stage("feedback", 0);
    let send = stage.dispatch_with(
        shader(&columns, "send"),
        &[
            columns.turns(),
            (1, shared.pupil),
            (2, layers.carried_spectrum),
            (3, to_farthest),
            (4, layers.step),
            (5, grid.spectra),
        ],
        [columns.workgroups(size.width), 3, 1],
    );
    send.bytes = Some((9 + planes) * complex);
    let compare = stage.dispatch_with(
        shader(&rows, "compare"),
        &[rows.turns(), (5, grid.spectra), (6, stack), (7, layer_of), (9, inputs.buffer)],
        [row_groups, batches, 1],
    );
    let lack_groups = (inputs.groups - channels.lack / GROUP) as u64;
    compare.bytes = Some(2 * planes * complex + (planes + batches as u64) * real + lack_groups * group);
    layers.bring_back(stage, shared, grid, true);
    let change = stage.dispatch_with(
        shader(&rows, "change"),
        &[rows.turns(), (5, grid.spectra), (8, layers.carried), (9, inputs.buffer)],
        [row_groups, 1, 1],
    );
    change.bytes = Some(9 * complex + 3 * group);
}
