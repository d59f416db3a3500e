//! What an eye should see at each depth layer, for `defocus.wgsl`.

use holod_calibration::DisplayGeometry;

use super::fft::Lines;
use super::grid_transforms::GridTransforms;
use super::input_features::{InputChannels, PlaneBytes, grid_constants, layers_together, sample_pitch};
use super::map::{GROUP, Map};
use super::plan::{BufferId, Constant, Plan};
use super::shared::Shared;
use crate::engine::Precision;
use crate::engine::constants::{LAYER_SHIFTS, LEAST_COVER, PAIRS};
use crate::engine::disc::DiscTable;
use crate::weights::{CONDITIONS, NetworkConfig};

/// Foci whose spectra a thread holds at once; where there are more layers, these are transformed anew for each so many.
const MOST_FOCI: usize = 8;
/// Pairs of opposite bins that a thread holds of each of [`MOST_FOCI`], and of each of half as many or fewer.
const BLUR_PAIRS: usize = 2;
const BLUR_PAIRS_OF_FEW: usize = 3;
/// The largest radix of a thread that holds so many, but for primes.
const BLUR_RADIX: usize = 12;
/// Samples that a thread holds of the rows of a frame, and of what is seen.
const FRAME_ITEMS: usize = 5;
const ROW_ITEMS: usize = 8;

/// Planes of complex numbers on the network's grid that the stage needs as scratch.
pub(super) fn scratch_planes(depth_layers: usize) -> usize {
    let buffers = if depth_layers > MOST_FOCI { 2 } else { 1 };
    buffers * PAIRS * depth_layers
}

/// Adds the stage `expected stack`, which writes the layers of each block's corners, and to `inputs` what the first net
/// reads.
pub(super) fn expect(
    plan: &mut Plan,
    config: &NetworkConfig,
    bench: &DisplayGeometry,
    shared: &Shared,
    grid: &GridTransforms,
    layer_of: BufferId,
    inputs: &Map,
) {
    let (count, size) = (config.depth_layers, shared.size);
    let disc = DiscTable::new(bench, count, sample_pitch(bench).0 / bench.eyepiece_focal_length.0);
    let disc_table = plan.table("the spectrum of a disc", &disc.values);

    let foci = count.min(MOST_FOCI);
    let blurred = grid.columns.with_radices_up_to(BLUR_RADIX);
    let channels = InputChannels::new(count, inputs.format);
    let constants: Vec<(&str, Constant)> = grid_constants(shared.resolution, size)
        .into_iter()
        .chain([
            ("LAYERS", count.into()),
            ("PAIRS", PAIRS.into()),
            ("LEAST_COVER", LEAST_COVER.into()),
            ("FOCI", foci.into()),
            // Elsewhere up to 3 registers would spill, of 8 layers on RDNA 3.
            ("ASKS_EARLY", (shared.stored == Precision::Half && blurred.largest_radix() <= 10).into()),
            ("FIRST_SEEN", (scratch_planes(count) - PAIRS * count).into()),
            ("LAYERS_TOGETHER", layers_together(count).into()),
            ("STACK_GROUP", (channels.stack / GROUP).into()),
            ("DISC_ENTRIES", disc.values.len().into()),
            ("ENTRIES_PER_MM", (disc.entries_per_mm as f32).into()),
        ])
        .collect();
    let [a, b, c, d] = LAYER_SHIFTS;
    let declared = format!("{}const LAYER_SHIFTS = vec4f({a:?}, {b:?}, {c:?}, {d:?});\n", inputs.declaration("input"));
    let features = include_str!("input_features.wgsl");
    let files = [&declared, include_str!("blocks.wgsl"), features, include_str!("defocus.wgsl")];
    let shader = |lines: &Lines, entry| lines.shader(&format!("defocus: {entry}"), &constants, &files, entry);
    let pairs = if 2 * foci <= MOST_FOCI { BLUR_PAIRS_OF_FEW } else { BLUR_PAIRS };
    let (rows, columns) = (grid.rows.rows(ROW_ITEMS), blurred.mirrored_columns(pairs));
    let frame_rows = grid.rows.rows(FRAME_ITEMS);
    let (row_groups, column_groups) = (rows.workgroups(size.height), columns.workgroups(size.width));
    let PlaneBytes { byte, complex, group, .. } = PlaneBytes::new(shared, inputs.format);
    let (chunks, spectra) = (count.div_ceil(foci), (PAIRS * count) as u64 * complex);
    let stack_groups = (3 * count).div_ceil(GROUP);
    let other_groups = (channels.told + CONDITIONS).div_ceil(GROUP) - stack_groups;
    let frame_bytes = (4 * size_of::<f32>() * shared.resolution.pixels()) as u64;
    let stage = plan.stage("expected stack", 0);
    let take_layers = stage.dispatch_with(
        shader(&frame_rows, "take_layers"),
        &[
            frame_rows.turns(),
            (1, shared.frame),
            (2, shared.pupil),
            (3, layer_of),
            (4, grid.spectra),
            (6, inputs.buffer),
        ],
        [frame_rows.workgroups(size.height), 1, 1],
    );
    take_layers.bytes = Some(frame_bytes + 4 * byte + spectra + other_groups as u64 * group);
    let blur = stage.dispatch_with(
        shader(&columns, "blur"),
        &[columns.turns(), (2, shared.pupil), (4, grid.spectra), (5, disc_table)],
        [column_groups, PAIRS, chunks],
    );
    blur.bytes = Some((chunks as u64 + 1) * spectra);
    let see = stage.dispatch_with(
        shader(&rows, "see"),
        &[rows.turns(), (2, shared.pupil), (4, grid.spectra), (6, inputs.buffer)],
        [row_groups, count / layers_together(count), 1],
    );
    see.bytes = Some(spectra + stack_groups as u64 * group);
}
