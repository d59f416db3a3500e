//! The field on the panel's grid from that on the network's, for `upsample.wgsl`.

use std::f64::consts::PI;

use num_complex::Complex64;

use super::fft::{LineFft, Lines, WorkgroupLimits};
use super::input_features::grid_constants;
use super::map::Map;
use super::plan::{BufferId, Constant, Plan};
use super::shared::Shared;
use crate::gpu::GpuError;
use crate::optics::signed_bin;
use crate::weights::Grid;

/// The share of the second net's output that is added to the field.
const CORRECTION_SHARE: f32 = 0.3;
/// Samples that a thread holds of a row, and of a column.
const ROW_ITEMS: usize = 4;
const COLUMN_ITEMS: usize = 6;

/// A field on the network's grid.
#[derive(Clone, Copy)]
pub(crate) enum Low<'a> {
    /// [3, height, width]
    Field(BufferId),
    /// The same, and the second net's output, of which a share is added.
    Corrected(BufferId, &'a Map),
}

/// Adds to the stage `field` what brings `low` to the panel's grid. [`Low::Field`] has been written in that stage,
/// which is the plan's last one, and on the full grid is already the hologram.
///
/// # Errors
/// A row or a column of the network's grid does not fit in a workgroup's memory.
pub(crate) fn field(
    plan: &mut Plan,
    shared: &Shared,
    grid: Grid,
    low: Low<'_>,
    limits: WorkgroupLimits,
) -> Result<(), GpuError> {
    let Shared { resolution: frame, size, .. } = *shared;
    if let Low::Corrected(..) = low {
        plan.stage("field", 0);
    }
    if grid == Grid::Full {
        return Ok(());
    }
    let rows = LineFft::new(plan, size.width, limits)?.rows(ROW_ITEMS);
    let columns = LineFft::new(plan, size.height, limits)?.columns(COLUMN_ITEMS);
    let [quarter_x, quarter_y] =
        [size.width, size.height].map(|bins| plan.table("quarters of a sample", &quarters(bins)));
    let small = plan.buffer::<[f32; 2]>("rows of the field", 3 * size.pixels());
    let tall = plan.buffer::<[f32; 2]>("columns of the field", 3 * frame.height * size.width);

    // Where nothing is added its binding is not read.
    let (base, correction, map_constants) = match low {
        Low::Field(field) => (field, field, [("CORRECTION_GROUPS", 1.into()), ("CORRECTION_PITCH", 1.into())]),
        Low::Corrected(base, map) => (base, map.buffer, map.constants(["CORRECTION_GROUPS", "CORRECTION_PITCH"])),
    };
    let own: [(&str, Constant); 2] =
        [("CORRECTS", matches!(low, Low::Corrected(..)).into()), ("CORRECTION_SHARE", CORRECTION_SHARE.into())];
    let constants = [&grid_constants(frame, size)[..], &map_constants, &own].concat();
    let files = [include_str!("upsample.wgsl")];
    let shader = |lines: &Lines, entry| lines.shader(&format!("upsample: {entry}"), &constants, &files, entry);
    let stage = plan.stages.last_mut().expect("the stage `field`");
    stage.dispatch_with(
        shader(&rows, "correct"),
        &[rows.turns(), (1, base), (2, correction), (3, small)],
        [rows.workgroups(size.height), 1, 1],
    );
    stage.dispatch_with(
        shader(&columns, "double_columns"),
        &[columns.turns(), (3, small), (4, tall), (6, quarter_y)],
        [columns.workgroups(size.width), 3, 1],
    );
    stage.dispatch_with(
        shader(&rows, "double_rows"),
        &[rows.turns(), (4, tall), (5, shared.field), (6, quarter_x)],
        [rows.workgroups(frame.height), 3, 1],
    );
    Ok(())
}

/// exp(-j·2π·f/4)/bins at each bin's frequency f in cycles a sample, and zero at the Nyquist bin.
fn quarters(bins: usize) -> Vec<[f32; 2]> {
    let quarter = |bin: usize| {
        if 2 * bin == bins {
            return [0.0; 2];
        }
        let turn = Complex64::cis(-PI / 2.0 * signed_bin(bin, bins) as f64 / bins as f64) / bins as f64;
        [turn.re as f32, turn.im as f32]
    };
    (0..bins).map(quarter).collect()
}
