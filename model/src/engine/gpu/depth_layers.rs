//! The light of the depth layers, and how it goes to the SLM plane, for `light_of_layers.wgsl` and
//! `depth_layers.wgsl`.

use std::sync::Arc;

use holod_calibration::{Colour, DisplayGeometry, Metres};

use super::fft::Lines;
use super::grid_transforms::GridTransforms;
use super::input_features::{plane_bytes, sample_pitch};
use super::map::Map;
use super::plan::{BufferId, Constant, Plan, Shader, Stage};
use super::shared::Shared;
use crate::engine::constants::REFINED_SHARE;
use crate::optics::transfer_table;
use crate::weights::NetworkConfig;

/// Samples that a thread holds of a row, and of a column.
const ROW_ITEMS: usize = 4;
const COLUMN_ITEMS: usize = 6;

/// What carries light between the layers and the SLM plane.
pub(super) struct DepthLayers {
    count: usize,
    /// [3, height, width]: transfer functions from one layer to the next nearer one, and over the number of samples
    /// from the nearest to the SLM plane.
    pub(super) step: BufferId,
    back: BufferId,
    /// [3, height, width]: the spectrum of what the layers' light gives at the SLM plane, over the number of samples.
    pub(super) carried_spectrum: BufferId,
    /// [3, height, width]: what is at the SLM plane.
    pub(super) carried: BufferId,
    /// Of the grid and the optics.
    constants: Vec<(&'static str, Constant)>,
}

impl DepthLayers {
    pub(super) fn new(plan: &mut Plan, config: &NetworkConfig, bench: &DisplayGeometry, shared: &Shared) -> Self {
        let (count, size) = (config.depth_layers, shared.size);
        let far_m = bench.image_distance(bench.depth_far).0;
        let near_m = bench.image_distance(bench.depth_near).0;
        let layer_m = (near_m - far_m) / count as f64;
        let samples = size.pixels() as f32;
        let step = transfer_tables(bench, shared, Metres(layer_m)).map(|[re, im]| [re * samples, im * samples]);
        let step = plan.table("the way to the next layer", &step.collect::<Vec<_>>());
        let back: Vec<_> = transfer_tables(bench, shared, Metres(layer_m / 2.0 - near_m)).collect();
        let pitch_m = sample_pitch(bench).0;
        let radius_per_mm =
            |colour| (0.5e-3 / (bench.wavelengths[colour].0 * bench.eyepiece_focal_length.0) * pitch_m) as f32;
        Self {
            count,
            step,
            back: plan.table("the way to the SLM plane", &back),
            carried_spectrum: plan.buffer::<[f32; 2]>("the carried spectrum", 3 * size.pixels()),
            carried: plan.buffer::<[f32; 2]>("the carried field", 3 * size.pixels()),
            constants: vec![
                ("WIDTH", size.width.into()),
                ("HEIGHT", size.height.into()),
                ("LAYERS", count.into()),
                ("REFINED_SHARE", REFINED_SHARE.into()),
                ("RADIUS_PER_MM_RED", radius_per_mm(Colour::Red).into()),
                ("RADIUS_PER_MM_GREEN", radius_per_mm(Colour::Green).into()),
                ("RADIUS_PER_MM_BLUE", radius_per_mm(Colour::Blue).into()),
            ],
        }
    }

    /// The constants that feedback's shaders need too.
    pub(super) fn constants(&self) -> &[(&'static str, Constant)] {
        &self.constants
    }

    /// Adds the stage `light of the layers`: lights every layer with the `stack`, as far as the first net's `outputs`
    /// correct it, and carries that to the SLM plane.
    pub(super) fn light(
        &self,
        plan: &mut Plan,
        config: &NetworkConfig,
        shared: &Shared,
        grid: &GridTransforms,
        stack: BufferId,
        outputs: &Map,
    ) {
        let own: [(&str, Constant); 2] =
            [("REFINES", config.refined_stack.into()), ("MASK_OFFSET", ((self.count - 1) as f32).ln().into())];
        let constants = [&self.constants[..], &own].concat();
        let declared = outputs.declaration("output");
        let files = [&declared, include_str!("phase_math.wgsl"), include_str!("light_of_layers.wgsl")];
        let rows = grid.rows.rows(ROW_ITEMS);
        let row_groups = rows.workgroups(shared.size.height);
        let [complex, real, group] = plane_bytes(shared.size);
        let (count, planes) = (self.count as u64, 3 * self.count as u64);
        let stage = plan.stage("light of the layers", 0);
        let light = stage.dispatch_with(
            rows.shader("light of the layers", &constants, &files, "light"),
            &[rows.turns(), (1, outputs.buffer), (2, stack), (3, grid.spectra)],
            [row_groups, self.count, 1],
        );
        // Where the stack is refined, the changes are read and it is written.
        let refined = if config.refined_stack { 2 * planes * real } else { 0 };
        light.bytes = Some(count * group + planes * (real + complex) + refined);
        self.bring_back(stage, shared, grid, false);
        let arrive = stage.dispatch_with(
            self.shader(&rows, false, "arrive"),
            &[rows.turns(), (3, grid.spectra), (8, self.carried)],
            [row_groups, 3, 1],
        );
        arrive.bytes = Some(6 * complex);
    }

    /// Adds what carries the light of the layers in `grid.spectra`, along x, to the SLM plane, and through the pupil
    /// where it `stops`.
    pub(super) fn bring_back(&self, stage: &mut Stage, shared: &Shared, grid: &GridTransforms, stops: bool) {
        let columns = grid.columns.columns(COLUMN_ITEMS);
        let [complex, ..] = plane_bytes(shared.size);
        let bring_back = stage.dispatch_with(
            self.shader(&columns, stops, "bring_back"),
            &[
                columns.turns(),
                (3, grid.spectra),
                (4, self.step),
                (5, self.back),
                (6, shared.pupil),
                (7, self.carried_spectrum),
            ],
            [columns.workgroups(shared.size.width), 3, 1],
        );
        // The layers' spectra, two tables, and what is made of them.
        let made = if stops { 3 } else { 6 };
        bring_back.bytes = Some((3 * self.count as u64 + 6 + made) * complex);
    }

    fn shader(&self, lines: &Lines, stops: bool, entry: &'static str) -> Arc<Shader> {
        let files = [include_str!("pupil.wgsl"), include_str!("depth_layers.wgsl")];
        let constants = [&self.constants[..], &[("STOPS", stops.into())]].concat();
        lines.shader(&format!("depth layers: {entry}"), &constants, &files, entry)
    }
}

/// The transfer functions of all colours over the distance `u`, over the number of samples, [3, height, width].
pub(super) fn transfer_tables(bench: &DisplayGeometry, shared: &Shared, u: Metres) -> impl Iterator<Item = [f32; 2]> {
    let size = shared.size;
    Colour::ALL.into_iter().flat_map(move |colour| {
        let transposed = transfer_table(bench.wavelengths[colour], sample_pitch(bench), size, u);
        let place = move |index: usize| index % size.width * size.height + index / size.width;
        (0..size.pixels()).map(move |index| transposed[place(index)]).map(|value| [value.re, value.im])
    })
}
