//! The field on the panel's grid from that on the network's, for `upsample.wgsl`.

use std::f64::consts::PI;

use num_complex::Complex64;

use super::fft::{LineFft, Lines, WorkgroupLimits};
use super::input_features::{InputChannels, PlaneBytes, grid_constants};
use super::map::{GROUP, Map};
use super::plan::{BufferId, Constant, Plan};
use super::shared::Shared;
use crate::gpu::GpuError;
use crate::optics::signed_bin;
use crate::weights::Grid;

/// The share of the second net's output that is added to the field.
const CORRECTION_SHARE: f32 = 0.3;
/// Samples that a thread holds of a row, and of a column.
const ROW_ITEMS: usize = 8;
const COLUMN_ITEMS: usize = 9;

/// A field on the network's grid.
#[derive(Clone, Copy)]
pub(crate) enum Low<'a> {
    /// [3, height, width] of complex numbers.
    Field(BufferId),
    /// What the second net reads, with its channels, and what that gives, of which a share is added.
    Corrected { inputs: &'a Map, channels: InputChannels, correction: &'a Map },
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
    let Shared { resolution: frame, size, stored, .. } = *shared;
    if let Low::Corrected { .. } = low {
        plan.stage("field", 0);
    }
    if grid == Grid::Full {
        return Ok(());
    }
    let rows = LineFft::new(plan, size.width, stored, limits)?.rows(ROW_ITEMS);
    let columns = LineFft::new(plan, size.height, stored, limits)?.columns(COLUMN_ITEMS);
    // Spectra of columns never lie in a buffer, so they are not unitary.
    let (width, height) = (size.width, size.height);
    let quarter_x = plan.table("quarters of a sample", &quarters(width, (width as f64).sqrt()));
    let quarter_y = plan.table("quarters of a sample", &quarters(height, height as f64));
    let small = stored.complex_buffer(plan, "rows of the field", 3 * size.pixels());
    let tall = stored.complex_buffer(plan, "columns of the field", 3 * frame.height * size.width);

    let complex = (2 * stored.bytes() * size.pixels()) as u64;
    let mut constants = grid_constants(frame, size).to_vec();
    let (mut bindings, read, declared, source) = match low {
        Low::Field(field) => (vec![(1, field)], 3 * complex, vec![], include_str!("low_field.wgsl")),
        Low::Corrected { inputs, channels, correction } => {
            let own: [(&str, Constant); 2] =
                [("FIELD_GROUP", (channels.field / GROUP).into()), ("CORRECTION_SHARE", CORRECTION_SHARE.into())];
            constants.extend(own);
            let declared = vec![inputs.declaration("input"), correction.declaration("correction")];
            let groups = [inputs, correction].map(|map| 2 * PlaneBytes::new(shared, map.format).group);
            let bindings = vec![(1, inputs.buffer), (2, correction.buffer)];
            (bindings, groups.iter().sum(), declared, include_str!("low_corrected.wgsl"))
        }
    };
    let files: Vec<_> = declared.iter().map(String::as_str).chain([source, include_str!("upsample.wgsl")]).collect();
    let shader = |lines: &Lines, entry| lines.shader(&format!("upsample: {entry}"), &constants, &files, entry);
    let stage = plan.stages.last_mut().expect("the stage `field`");
    bindings.extend([rows.turns(), (3, small)]);
    let correct = stage.dispatch_with(shader(&rows, "correct"), &bindings, [rows.workgroups(size.height), 1, 1]);
    correct.bytes = Some(read + 3 * complex);
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

/// exp(-j·2π·f/4)/norm at each bin's frequency f in cycles a sample, and zero at the Nyquist bin.
fn quarters(bins: usize, norm: f64) -> Vec<[f32; 2]> {
    let quarter = |bin: usize| {
        if 2 * bin == bins {
            return [0.0; 2];
        }
        let turn = Complex64::cis(-PI / 2.0 * signed_bin(bin, bins) as f64 / bins as f64) / norm;
        [turn.re as f32, turn.im as f32]
    };
    (0..bins).map(quarter).collect()
}
