//! The light of the depth layers, and how it goes to the SLM plane, for `light_of_layers.wgsl` and
//! `depth_layers.wgsl`.

use std::sync::Arc;

use holod_calibration::{Colour, DisplayGeometry, Metres, Resolution};

use super::fft::Lines;
use super::grid_transforms::GridTransforms;
use super::input_features::{InputChannels, PlaneBytes, layers_together, sample_pitch};
use super::map::{GROUP, Map};
use super::plan::{BufferId, Constant, Plan, Shader, Stage};
use super::shared::Shared;
use crate::engine::Precision;
use crate::engine::constants::REFINED_SHARE;
use crate::optics::transfer_table;
use crate::weights::NetworkConfig;

/// Samples that a thread holds of a row, and of a column.
const ROW_ITEMS: usize = 8;
const COLUMN_ITEMS: usize = 9;

/// What carries light between the layers and the SLM plane.
pub(super) struct DepthLayers {
    count: usize,
    /// [`transfer_tables`] from one layer to the next nearer one, and from the nearest to the SLM plane.
    pub(super) step: BufferId,
    back: BufferId,
    /// [3, height, width]: the spectrum of what the layers' light gives at the SLM plane, and along x that of its rows.
    pub(super) carried_spectrum: BufferId,
    pub(super) carried_rows: BufferId,
    /// [layers, 3, height, width], where they are refined: the amplitudes that an eye should see.
    pub(super) stack: BufferId,
    /// Of the grid, the optics and the map that both nets read.
    constants: Vec<(&'static str, Constant)>,
}

impl DepthLayers {
    pub(super) fn new(
        plan: &mut Plan,
        config: &NetworkConfig,
        bench: &DisplayGeometry,
        shared: &Shared,
        inputs: &Map,
    ) -> Self {
        let (count, size) = (config.depth_layers, shared.size);
        let far_m = bench.image_distance(bench.depth_far).0;
        let near_m = bench.image_distance(bench.depth_near).0;
        let layer_m = (near_m - far_m) / count as f64;
        let step = transfer_tables(bench, size, Metres(layer_m), 1.0);
        let unitary = (size.height as f64).powf(-0.5);
        let back = transfer_tables(bench, size, Metres(layer_m / 2.0 - near_m), unitary);
        let stack = if config.refined_stack { 3 * count * size.pixels() } else { 0 };
        let pitch_m = sample_pitch(bench).0;
        let radius_per_mm =
            |colour| (0.5e-3 / (bench.wavelengths[colour].0 * bench.eyepiece_focal_length.0) * pitch_m) as f32;
        Self {
            count,
            step: plan.table("the way to the next layer", &step),
            back: plan.table("the way to the SLM plane", &back),
            carried_spectrum: shared.stored.complex_buffer(plan, "the carried spectrum", 3 * size.pixels()),
            carried_rows: shared.stored.complex_buffer(plan, "rows of the carried field", 3 * size.pixels()),
            stack: match inputs.format.precision() {
                Precision::Single => plan.buffer::<f32>("expected amplitudes", stack),
                Precision::Half => plan.buffer::<[u16; 2]>("expected amplitudes", stack.div_ceil(2)),
            },
            constants: vec![
                ("WIDTH", size.width.into()),
                ("HEIGHT", size.height.into()),
                ("LAYERS", count.into()),
                ("LAYERS_TOGETHER", layers_together(count).into()),
                ("STACK_GROUP", (InputChannels::new(count, inputs.format).stack / GROUP).into()),
                ("REFINES", config.refined_stack.into()),
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

    /// Adds the stage `light of the layers`: lights every layer with what `inputs` expects, as far as the first net's
    /// `outputs` correct it, and carries that to the SLM plane.
    pub(super) fn light(
        &self,
        plan: &mut Plan,
        config: &NetworkConfig,
        shared: &Shared,
        grid: &GridTransforms,
        [inputs, outputs]: [&Map; 2],
    ) {
        let own: [(&str, Constant); 1] = [("MASK_OFFSET", ((self.count - 1) as f32).ln().into())];
        let constants = [&self.constants[..], &own].concat();
        let declared = [expected_amplitudes(inputs), outputs.declaration("output")];
        let [expected, outputs_declared] = &declared;
        let files = [expected, outputs_declared, include_str!("phase_math.wgsl"), include_str!("light_of_layers.wgsl")];
        let rows = grid.rows.rows(ROW_ITEMS);
        let row_groups = rows.workgroups(shared.size.height);
        let PlaneBytes { byte, complex, real, group } = PlaneBytes::new(shared, inputs.format);
        let (count, planes) = (self.count as u64, 3 * self.count as u64);
        let stage = plan.stage("light of the layers", 0);
        let light = stage.dispatch_with(
            rows.shader("light of the layers", &constants, &files, "light"),
            &[rows.turns(), (1, outputs.buffer), (2, inputs.buffer), (3, grid.spectra), (4, self.stack)],
            [row_groups, self.count / layers_together(self.count), 1],
        );
        // Where the stack is refined, the changes are read and it is written.
        let given = outputs.format.precision().bytes() as u64;
        let refined = if config.refined_stack { planes * (given * byte + real) } else { 0 };
        light.bytes = Some(4 * count * given * byte + planes.div_ceil(4) * group + planes * complex + refined);
        self.bring_back(stage, shared, grid, self.carried_rows, false);
    }

    /// Adds what carries the light of the layers in `grid.spectra`, along x, to the SLM plane, and through the pupil
    /// where it `stops`; along x, spectra of that go to `arriving`.
    pub(super) fn bring_back(
        &self,
        stage: &mut Stage,
        shared: &Shared,
        grid: &GridTransforms,
        arriving: BufferId,
        stops: bool,
    ) {
        let columns = grid.columns.columns(COLUMN_ITEMS);
        let complex = 2 * (shared.size.pixels() * shared.stored.bytes()) as u64;
        let bring_back = stage.dispatch_with(
            self.shader(&columns, stops, "bring_back"),
            &[
                columns.turns(),
                (3, grid.spectra),
                (4, self.step),
                (5, self.back),
                (6, shared.pupil),
                (7, self.carried_spectrum),
                (8, arriving),
            ],
            [columns.workgroups(shared.size.width), 3, 1],
        );
        // The layers' spectra, two tables, and what is made of them.
        let made = if stops { 3 } else { 6 };
        bring_back.bytes = Some((3 * self.count as u64 + made) * complex + 2 * table_bytes(shared.size));
    }

    fn shader(&self, lines: &Lines, stops: bool, entry: &'static str) -> Arc<Shader> {
        let files =
            [include_str!("pupil.wgsl"), include_str!("transfer_tables.wgsl"), include_str!("depth_layers.wgsl")];
        let constants = [&self.constants[..], &[("STOPS", stops.into())]].concat();
        lines.shader(&format!("depth layers: {entry}"), &constants, &files, entry)
    }
}

/// WGSL for shaders that read what `inputs` expects, or the refined amplitudes.
pub(super) fn expected_amplitudes(inputs: &Map) -> String {
    let amplitude = match inputs.format.precision() {
        Precision::Single => "f32",
        Precision::Half => "f16",
    };
    let declared = inputs.declaration("input");
    format!("{declared}alias Amplitude = {amplitude};\n\n{}", include_str!("expected.wgsl"))
}

/// `scale` times the transfer functions of all colours over the distance `u`, for `transfer_tables.wgsl`.
pub(super) fn transfer_tables(bench: &DisplayGeometry, size: Resolution, u: Metres, scale: f64) -> Vec<[f32; 2]> {
    let scale = (scale * size.pixels() as f64) as f32;
    let of_colour = |colour| {
        let transposed = transfer_table(bench.wavelengths[colour], sample_pitch(bench), size, u);
        let bins = (0..=size.height / 2).flat_map(|y| (0..=size.width / 2).map(move |x| (x, y)));
        bins.map(move |(x, y)| x * size.height + y)
            .map(move |place| [transposed[place].re * scale, transposed[place].im * scale])
    };
    Colour::ALL.into_iter().flat_map(of_colour).collect()
}

/// Bytes of such a table.
pub(super) fn table_bytes(size: Resolution) -> u64 {
    (3 * (size.height / 2 + 1) * (size.width / 2 + 1) * size_of::<[f32; 2]>()) as u64
}
