//! The stages of the `expected-stack` family that are no nets: what an eye should see, its light carried to the SLM
//! plane, and what that lacks fed back.

use holod_calibration::DisplayGeometry;

use super::defocus;
use super::depth_layers::DepthLayers;
use super::feedback;
use super::fft::WorkgroupLimits;
use super::grid_transforms::GridTransforms;
use super::map::Map;
use super::plan::{BufferId, Plan};
use super::shared::Shared;
use crate::gpu::GpuError;
use crate::weights::{Feedback, NetworkConfig};

/// What these stages have in common.
pub(crate) struct ExpectedStack<'a> {
    config: &'a NetworkConfig,
    bench: &'a DisplayGeometry,
    shared: Shared,
    grid: GridTransforms,
    layers: DepthLayers,
    /// The depth layers of each block's corners, a byte each, [height, width].
    layer_of: BufferId,
    /// What both nets read.
    inputs: Map,
}

impl<'a> ExpectedStack<'a> {
    /// Adds the stage `expected stack`, which writes the maps of the frame and what an eye should see to the channels
    /// of `inputs` that the first net reads.
    ///
    /// # Errors
    /// A row or a column does not fit in a workgroup's memory.
    pub(crate) fn expect(
        plan: &mut Plan,
        config: &'a NetworkConfig,
        bench: &'a DisplayGeometry,
        shared: &Shared,
        inputs: &Map,
        limits: WorkgroupLimits,
    ) -> Result<Self, GpuError> {
        let count = config.depth_layers;
        let planes = defocus::scratch_planes(count).max(3 * count);
        let grid = GridTransforms::new(plan, shared, planes, limits)?;
        let layers = DepthLayers::new(plan, config, bench, shared, inputs);
        let layer_of = plan.buffer::<u32>("depth layers of the pixels", shared.size.pixels());
        defocus::expect(plan, config, bench, shared, &grid, layer_of, inputs);
        Ok(Self { config, bench, shared: *shared, grid, layers, layer_of, inputs: *inputs })
    }

    /// Adds the stage `light of the layers`; `outputs` is what the first net gives.
    pub(crate) fn light(&self, plan: &mut Plan, outputs: &Map) {
        self.layers.light(plan, self.config, &self.shared, &self.grid, [&self.inputs, outputs]);
    }

    /// Adds the stage `feedback`, which writes the other channels of what the nets read.
    pub(crate) fn feed_back(&self, plan: &mut Plan, feedback: Feedback) {
        let Self { config, bench, shared, grid, layers, layer_of, inputs } = self;
        feedback::feed_back(plan, config, bench, feedback, shared, grid, layers, *layer_of, inputs);
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::{Metres, PupilDiameter, Resolution};
    use holod_fft::{FftDirection, Real};
    use num_complex::Complex64;
    use proptest::prelude::*;

    use super::super::input_features::InputChannels;
    use super::super::map::{Format, GROUP};
    use super::super::shared::pupil_values;
    use super::super::trial::{Trial, complex, largest_difference};
    use super::super::upsample::{self, Low};
    use super::*;
    use crate::RgbdFrame;
    use crate::conditions::{Conditions, TrainedRange};
    use crate::engine::cpu::tests::OTHER_BENCH;
    use crate::engine::reference::{self, Trace, Value};
    use crate::gpu::MatrixUnits;
    use crate::weights::tests::{expected_stack_config, random_weights};
    use crate::weights::{Family, Grid, Weights};

    const LIMITS: WorkgroupLimits = WorkgroupLimits { bytes: 32 << 10, threads: 512 };
    /// Largest difference allowed from the reference, relative to the reference's largest value. Where a field is nearly
    /// dark single precision tells its phase less well: 2.3e-5 was seen.
    const TOLERANCE: f64 = 5e-5;
    /// The same where fields, spectra and maps are in half precision.
    const HALF_TOLERANCE: f64 = 1.5e-2;

    /// All stages but the nets, whose maps are written from outside.
    struct Stages {
        trial: Trial,
        trained: TrainedRange,
        bench: DisplayGeometry,
        shared: Shared,
        channels: InputChannels,
        inputs: Map,
        outputs: Map,
        correction: Map,
        carried_rows: BufferId,
    }

    impl Stages {
        fn new(
            weights: &Weights,
            bench: &DisplayGeometry,
            resolution: Resolution,
            limits: WorkgroupLimits,
            format: Format,
        ) -> Self {
            let Family::ExpectedStack { feedback, .. } = weights.family else { panic!("weights of another family") };
            let (config, plan) = (&weights.config, &mut Plan::default());
            let size = Resolution { width: resolution.width.div_ceil(2), height: resolution.height.div_ceil(2) };
            let shared = Shared::new(plan, resolution, size, format.precision());
            let channels = InputChannels::new(config.depth_layers, format);
            let inputs = channels.map(plan, size);
            let net = |plan: &mut Plan, what, channels| {
                Map::with(format.of_outputs(), plan, what, (size.width, size.height), channels)
            };
            let stages = ExpectedStack::expect(plan, config, bench, &shared, &inputs, limits).expect("it fits");
            let outputs = net(plan, "the first net's", config.lighting_channels());
            stages.light(plan, &outputs);
            stages.feed_back(plan, feedback);
            let correction = net(plan, "the second net's", 6);
            let low = Low::Corrected { inputs: &inputs, channels, correction: &correction };
            upsample::field(plan, &shared, Grid::HalfBand, low, limits).expect("it fits");
            let carried_rows = stages.layers.carried_rows;
            let (trained, bench) = (config.trained, *bench);
            Self {
                trial: Trial::new(plan),
                trained,
                bench,
                shared,
                channels,
                inputs,
                outputs,
                correction,
                carried_rows,
            }
        }

        fn show(&self, frame: &RgbdFrame, pupil_mm: f32) {
            let planes = [&frame.amplitude[..], &frame.depth_normalised].concat();
            self.trial.write(self.shared.frame, &planes);
            let pupil = PupilDiameter::from_mm(pupil_mm);
            let conditions = Conditions::of(&self.trained, &self.bench, pupil);
            self.trial.write(self.shared.pupil, &pupil_values(pupil, conditions));
        }

        /// Channels of the nets' map, each zero where nothing is told in it.
        fn told(&self, channels: &[usize]) -> Vec<Complex64> {
            let all = self.inputs.groups * GROUP;
            let planes = self.inputs.planes(&self.trial.read(self.inputs.buffer), all);
            let pixels = self.shared.size.pixels();
            let plane = |channel: usize| &planes[channel * pixels..][..pixels];
            let used = self.channels.correction();
            let mut padding = (0..all).filter(|channel| !used.contains(channel));
            assert!(padding.all(|channel| plane(channel).iter().all(|&value| value == 0.0)), "padding is not zero");
            channels.iter().flat_map(|&channel| plane(channel)).map(|&value| f64::from(value).into()).collect()
        }

        /// Writes what a net gives.
        fn give(&self, map: &Map, given: &reference::Map) {
            let value = |channel: usize, y: usize, x: usize| match channel < given.channels {
                true => given.at(channel, y as isize, x as isize) as f32,
                false => 0.0,
            };
            self.trial.write(map.buffer, &map.values(value));
        }

        fn complex(&self, buffer: BufferId) -> Vec<Complex64> {
            complex(self.shared.stored, &self.trial.read(buffer))
        }

        /// The field at the SLM plane, from spectra along x of unitary transforms.
        fn carried(&self) -> Vec<Complex64> {
            let width = self.shared.size.width;
            let mut rows = self.complex(self.carried_rows);
            rows.iter_mut().for_each(|value| *value /= (width as f64).sqrt());
            let fft = f64::plan(width, FftDirection::Inverse);
            rows.chunks_exact_mut(width).for_each(|row| fft.process(row));
            rows
        }

        /// The hologram, when the nets give what `trace` has.
        fn run(&self, frame: &RgbdFrame, pupil_mm: f32, trace: &Trace) -> Vec<Complex64> {
            self.show(frame, pupil_mm);
            self.trial.run_stage("expected stack");
            self.give(&self.outputs, given(trace, "lighting.layer_"));
            self.trial.run_stage("light of the layers");
            self.trial.run_stage("feedback");
            self.give(&self.correction, given(trace, "correction.layer_"));
            self.trial.run_stage("field");
            self.complex(self.shared.field)
        }
    }

    /// The last map whose name begins so.
    fn given<'a>(trace: &'a Trace, name: &str) -> &'a reference::Map {
        let map = |stage: &'a reference::Stage| match &stage.value {
            Value::Encoded(map) | Value::Layer(map, _) if stage.name.starts_with(name) => Some(map),
            _ => None,
        };
        trace.stages.iter().rev().find_map(map).expect("a stage of that name")
    }

    fn frame(resolution: Resolution, seed: u32) -> RgbdFrame {
        let noise = |index: usize| {
            let mixed = (index as u32).wrapping_mul(0x9E37_79B9) ^ seed.wrapping_mul(0x85EB_CA6B);
            f64::from((mixed ^ (mixed >> 15)).wrapping_mul(0x2C1B_3C6D) >> 8) / f64::from(1 << 24)
        };
        // A little is outside 0 to 1, and both ends are met exactly.
        let depth = |index: usize| match index % 7 {
            3 => 1.0,
            5 => 0.0,
            _ => (1.2 * noise(index + 77_777) - 0.1) as f32,
        };
        RgbdFrame {
            resolution,
            amplitude: (0..3 * resolution.pixels()).map(|index| noise(index) as f32).collect(),
            depth_normalised: (0..resolution.pixels()).map(depth).collect(),
        }
    }

    /// Asserts that `found` is `expected`, and that one wrong value would have been seen.
    fn assert_is(what: &str, tolerance: f64, found: &[Complex64], mut expected: Vec<Complex64>) {
        let error = largest_difference(found, &expected);
        assert!(error < tolerance, "{what}: {error}");
        let middle = expected.len() / 2;
        expected[middle].re += 20.0 * tolerance * expected.iter().map(|value| value.norm()).fold(1e-6, f64::max);
        assert!(largest_difference(found, &expected) > tolerance, "{what}: the comparison is blind");
    }

    fn check(weights: &Weights, resolution: Resolution, pupil_mm: f32, seed: u32) {
        check_on(&DisplayGeometry::DEFAULT, LIMITS, Format::Single, weights, resolution, pupil_mm, seed);
    }

    fn check_on(
        bench: &DisplayGeometry,
        limits: WorkgroupLimits,
        format: Format,
        weights: &Weights,
        resolution: Resolution,
        pupil_mm: f32,
        seed: u32,
    ) {
        let shown = frame(resolution, seed);
        let trace = reference::run(weights, bench, &shown, PupilDiameter::from_mm(pupil_mm));
        let tolerance = if format == Format::Single { TOLERANCE } else { HALF_TOLERANCE };
        let stages = Stages::new(weights, bench, resolution, limits, format);
        let context = |what: &str| format!("{resolution}, {} layers: {what}", weights.config.depth_layers);
        let real = |map: &reference::Map| map.values.iter().map(|&value| value.into()).collect::<Vec<Complex64>>();

        // The second time round, what the first left behind must not show.
        stages.run(&frame(resolution, seed + 1), 2.0, &trace);
        stages.show(&shown, pupil_mm);
        stages.trial.run_stage("expected stack");
        let encoded = given(&trace, "lighting.encoded");
        assert_is(&context("expected stack"), tolerance, &stages.told(&stages.channels.lighting()), real(encoded));
        stages.give(&stages.outputs, given(&trace, "lighting.layer_"));
        stages.trial.run_stage("light of the layers");
        let carried = trace.stages.iter().find_map(|stage| match &stage.value {
            Value::Light(light) if stage.name == "carried" => Some(light.clone()),
            _ => None,
        });
        assert_is(&context("light"), tolerance, &stages.carried(), carried.expect("a carried field"));
        stages.trial.run_stage("feedback");
        let encoded = given(&trace, "correction.encoded");
        assert_is(&context("feedback"), tolerance, &stages.told(&stages.channels.correction()), real(encoded));
        stages.give(&stages.correction, given(&trace, "correction.layer_"));
        stages.trial.run_stage("field");
        assert_is(&context("field"), tolerance, &stages.complex(stages.shared.field), trace.field);
    }

    fn config(depth_layers: usize, refined_stack: bool) -> NetworkConfig {
        NetworkConfig { channels: 4, depth_layers, refined_stack, ..expected_stack_config() }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(3))]
        #[test]
        fn every_stage_matches_the_reference(
            width in 1usize..40,
            height in 1usize..30,
            depth_layers in 2usize..7,
            refined_stack in any::<bool>(),
            pupil_mm in 1.0f32..5.0,
            seed in 0u32..1000,
        ) {
            let weights = random_weights(config(depth_layers, refined_stack), u64::from(seed));
            check(&weights, Resolution { width, height }, pupil_mm, seed);
        }
    }

    #[test]
    fn every_stage_in_half_precision_is_near_the_reference() {
        let bench = &DisplayGeometry::DEFAULT;
        for (format, depth_layers, refined_stack, width, height) in [
            (Format::Half, 4, true, 33, 26),
            (Format::Half, 5, false, 286, 9),
            (Format::Half, 9, true, 17, 12),
            (Format::HalfTiles(MatrixUnits::Threads), 6, true, 19, 34),
            (Format::HalfTiles(MatrixUnits::ThreadsOfAnySubgroups { in_one: true }), 3, true, 21, 14),
        ] {
            let weights = random_weights(config(depth_layers, refined_stack), 3);
            check_on(bench, LIMITS, format, &weights, Resolution { width, height }, 3.3, 5);
        }
    }

    #[test]
    fn long_lines_and_several_workgroups_match_the_reference() {
        let weights = random_weights(config(2, false), 6);
        // Rows of 11 and 13, and columns by chirps.
        check(&weights, Resolution { width: 286, height: 34 }, 4.1, 2);
        let little = WorkgroupLimits { bytes: 150 * 8, threads: 128 };
        // In so little memory a workgroup has one line, as it has of a long one.
        check_on(
            &DisplayGeometry::DEFAULT,
            little,
            Format::Single,
            &weights,
            Resolution { width: 299, height: 5 },
            4.1,
            2,
        );
    }

    #[test]
    fn as_many_depth_layers_as_can_be_match_the_reference_at_the_widest_pupil() {
        for depth_layers in [8, 9, 64] {
            check(&random_weights(config(depth_layers, true), 4), Resolution { width: 12, height: 7 }, 5.0, 4);
        }
    }

    #[test]
    fn blurs_wider_than_the_table_of_the_disc_match_the_reference() {
        let bench = DisplayGeometry {
            pixel_pitch: Metres(1e-6),
            eyepiece_focal_length: Metres(2.0),
            ..DisplayGeometry::DEFAULT
        };
        let size = Resolution { width: 12, height: 7 };
        check_on(&bench, LIMITS, Format::Single, &random_weights(config(5, false), 4), size, 5.0, 4);
    }

    #[test]
    fn another_bench_matches_the_reference() {
        for (depth_layers, pupil_mm) in [(2, 0.5), (6, 20.0)] {
            let weights = random_weights(config(depth_layers, true), 7);
            check_on(&OTHER_BENCH, LIMITS, Format::Single, &weights, Resolution { width: 31, height: 18 }, pupil_mm, 4);
        }
    }

    #[test]
    fn what_is_no_number_leaves_no_trace_in_the_next_frame() {
        let resolution = Resolution { width: 31, height: 18 };
        let weights = random_weights(config(5, true), 2);
        let stages = Stages::new(&weights, &DisplayGeometry::DEFAULT, resolution, LIMITS, Format::Single);
        let trace =
            reference::run(&weights, &DisplayGeometry::DEFAULT, &frame(resolution, 4), PupilDiameter::from_mm(3.0));
        let clean = stages.run(&frame(resolution, 4), 3.0, &trace);
        assert!(clean.iter().all(|value| value.is_finite()));
        for (pixel, spoiler) in [(0, f32::NAN), (30, f32::INFINITY), (31 * 18 - 1, f32::NEG_INFINITY)] {
            let mut spoiled = frame(resolution, 4);
            spoiled.amplitude[pixel] = spoiler;
            stages.run(&spoiled, 3.0, &trace);
            let told = stages.told(&stages.channels.lighting());
            assert!(told.iter().any(|value| !value.is_finite()), "pixel {pixel} is not seen");
            assert_eq!(stages.run(&frame(resolution, 4), 3.0, &trace), clean, "pixel {pixel} left a trace");
            let mut spoiled = frame(resolution, 4);
            spoiled.depth_normalised[pixel] = spoiler;
            stages.run(&spoiled, 3.0, &trace);
            assert_eq!(
                stages.run(&frame(resolution, 4), 3.0, &trace),
                clean,
                "the depth of pixel {pixel} left a trace"
            );
        }
    }
}
