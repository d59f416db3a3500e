//! What an eye lacks when it focuses on each depth layer, fed back to the field at the SLM plane, for `feedback.wgsl`.

use holod_calibration::{DisplayGeometry, Metres};

use super::depth_layers::{DepthLayers, expected_amplitudes, table_bytes, transfer_tables};
use super::fft::Lines;
use super::grid_transforms::GridTransforms;
use super::input_features::{InputChannels, PlaneBytes, layers_together};
use super::map::{GROUP, Map};
use super::plan::{BufferId, Constant, Plan};
use super::shared::Shared;
use crate::engine::constants::FEEDBACK_DARK_POWER;
use crate::weights::{Feedback, NetworkConfig};

/// Samples that a thread holds of a row, and of a column.
const ROW_ITEMS: usize = 8;
const COLUMN_ITEMS: usize = 9;
/// The largest radix of a thread that compares so many.
const COMPARE_RADIX: usize = 15;
/// Samples of a row that a thread holds of all colours of two fields.
const CHANGE_ITEMS: usize = 6;

/// Adds the stage `feedback`: writes to `inputs` the carried field with a share of its change by what it lacks of the
/// amplitudes that an eye should see, that change, and the lack.
#[expect(clippy::too_many_arguments)]
pub(super) fn feed_back(
    plan: &mut Plan,
    config: &NetworkConfig,
    bench: &DisplayGeometry,
    Feedback { share, sharpness }: Feedback,
    shared: &Shared,
    grid: &GridTransforms,
    layers: &DepthLayers,
    layer_of: BufferId,
    inputs: &Map,
) {
    let (count, size) = (config.depth_layers, shared.size);
    let far_m = bench.image_distance(bench.depth_far).0;
    let volume_m = bench.image_distance(bench.depth_near).0 - far_m;
    let farthest = Metres(far_m + volume_m / (2 * count) as f64);
    let to_farthest = transfer_tables(bench, size, farthest, (size.height as f64).powf(-0.5));
    let to_farthest = plan.table("the way to the farthest layer", &to_farthest);
    let changed_rows = shared.stored.complex_buffer(plan, "rows of the field's change", 3 * size.pixels());

    let channels = InputChannels::new(count, inputs.format);
    let own: [(&str, Constant); 5] = [
        ("DARK_POWER", FEEDBACK_DARK_POWER.into()),
        ("SHARE", share.into()),
        ("SHARPNESS", sharpness.into()),
        ("FIELD_GROUP", (channels.field / GROUP).into()),
        ("LACK_GROUP", (channels.lack / GROUP).into()),
    ];
    let constants = [layers.constants(), &own].concat();
    let expected = expected_amplitudes(inputs);
    let files =
        [&expected, include_str!("pupil.wgsl"), include_str!("transfer_tables.wgsl"), include_str!("feedback.wgsl")];
    let shader = |lines: &Lines, entry| lines.shader(&format!("feedback: {entry}"), &constants, &files, entry);
    let columns = grid.columns.columns(COLUMN_ITEMS);
    let compared_rows = grid.rows.with_radices_up_to(COMPARE_RADIX).rows(ROW_ITEMS);
    let change_rows = grid.rows.rows(CHANGE_ITEMS);
    let PlaneBytes { byte, complex, real, group } = PlaneBytes::new(shared, inputs.format);
    let (planes, batches) = (3 * count as u64, count / layers_together(count));
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
    send.bytes = Some((3 + planes) * complex + 2 * table_bytes(size));
    let compare = stage.dispatch_with(
        shader(&compared_rows, "compare"),
        &[compared_rows.turns(), (5, grid.spectra), (6, layers.stack), (7, layer_of), (10, inputs.buffer)],
        [compared_rows.workgroups(size.height), batches, 1],
    );
    let lacking = planes.div_ceil(4) * group;
    let wanted = if config.refined_stack { planes * real } else { lacking };
    compare.bytes = Some(2 * planes * complex + 4 * batches as u64 * byte + wanted + lacking);
    layers.bring_back(stage, shared, grid, changed_rows, true);
    let change = stage.dispatch_with(
        shader(&change_rows, "change"),
        &[change_rows.turns(), (8, layers.carried_rows), (9, changed_rows), (10, inputs.buffer)],
        [change_rows.workgroups(size.height), 1, 1],
    );
    change.bytes = Some(6 * complex + 3 * group);
}
