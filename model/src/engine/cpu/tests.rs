//! The CPU engine against the double-precision reference, on every instruction set that this machine has.

use holod_calibration::{Dioptres, DisplayGeometry, Metres, PerColour, PupilDiameter, Resolution};
use num_complex::{Complex32, Complex64};
use proptest::prelude::*;

use super::feature_map::FeatureMap;
use super::network::Network;
use super::stage::{Job, Seen};
use super::*;
use crate::conditions::WIDEST_PUPIL;
use crate::engine::reference::{self, Value};
use crate::scene::FocalStack;
use crate::simd::{InstructionSet, Products};
use crate::weights::tests::{self as weights_tests, random_weights};
use crate::weights::{Grid, NetworkConfig};
use crate::worst::worst;

/// Largest difference allowed between a map and its reference, relative to the reference's largest value.
const TOLERANCE: f64 = 2e-5;
/// The same between holograms of benches that are one in pixels: 4.3e-4 was found of random weights, 3.3e-5 of the
/// small built-in ones; of a pitch of 7 µm 0.2.
const SAME_IN_PIXELS: f64 = 2e-3;

pub(in crate::engine) fn frame(resolution: Resolution, seed: u32) -> RgbdFrame {
    let noise = |index: usize| {
        let mixed = (index as u32).wrapping_mul(0x9E37_79B9) ^ seed.wrapping_mul(0x85EB_CA6B);
        f64::from((mixed ^ (mixed >> 15)).wrapping_mul(0x2C1B_3C6D) >> 8) / f64::from(1 << 24)
    };
    RgbdFrame {
        resolution,
        amplitude: (0..3 * resolution.pixels()).map(|index| noise(index) as f32).collect(),
        // A little is outside 0 to 1, and both ends are met exactly.
        depth_normalised: (0..resolution.pixels())
            .map(|index| match index % 7 {
                3 => 1.0,
                5 => 0.0,
                _ => (1.2 * noise(index + 77_777) - 0.1) as f32,
            })
            .collect(),
    }
}

fn largest(values: impl Iterator<Item = f64>) -> f64 {
    worst(values.map(f64::abs))
}

/// Difference of two maps relative to the reference's largest value.
fn map_error(actual: &FeatureMap, expected: &reference::Map) -> f64 {
    let channels: Vec<_> = (0..expected.channels).collect();
    error_of_channels(actual, &channels, expected)
}

/// The error of the channels of a map that are listed, in the order of the expected ones.
fn error_of_channels(actual: &FeatureMap, channels: &[usize], expected: &reference::Map) -> f64 {
    assert_eq!(channels.len(), expected.channels);
    let shape = [expected.channels, expected.height, expected.width];
    let differences = reference::Map::from_fn(shape, |channel, y, x| {
        f64::from(actual.pixel(x, y)[channels[channel]]) - expected.at(channel, y as isize, x as isize)
    });
    largest(differences.values.into_iter()) / largest(expected.values.iter().copied()).max(1e-6)
}

fn light_error(actual: &[Complex32], expected: &[Complex64]) -> f64 {
    assert_eq!(actual.len(), expected.len());
    let difference = |(a, e): (&Complex32, &Complex64)| (Complex64::new(a.re.into(), a.im.into()) - e).norm();
    largest(actual.iter().zip(expected).map(difference)) / largest(expected.iter().map(|value| value.norm()))
}

/// The error of a map after one value of the expected one was changed.
fn error_once_spoiled(map: &FeatureMap, expected: &mut reference::Map) -> f64 {
    spoil(expected);
    map_error(map, expected)
}

fn spoil(expected: &mut reference::Map) {
    let middle = expected.values.len() / 2;
    expected.values[middle] += 1e-3 * largest(expected.values.iter().copied()).max(1e-6);
}

/// What the engine calls a stage of the reference; `first` is the first one's name of a network that lights planes.
fn name_of(stage: &reference::Stage, first: &str) -> String {
    let adjustable = if matches!(stage.value, Value::Layer(_, Some(_))) { " (adjustable)" } else { "" };
    match stage.name.as_str() {
        "encoded" => "encode".into(),
        "lighting.encoded" => first.into(),
        "carried" => "light of the layers".into(),
        "correction.encoded" => "feedback".into(),
        layer_or_field => layer_or_field.replace(['.', '_'], " ") + adjustable,
    }
}

/// Another bench, with more diffraction, and depths that do not begin at infinity.
pub(in crate::engine) const OTHER_BENCH: DisplayGeometry = DisplayGeometry {
    resolution: Resolution { width: 640, height: 480 },
    pixel_pitch: Metres(3.74e-6),
    wavelengths: PerColour([Metres(660e-9), Metres(532e-9), Metres(473e-9)]),
    eyepiece_focal_length: Metres(25e-3),
    depth_far: Dioptres(0.25),
    depth_near: Dioptres(3.0),
};

/// Runs a network stage by stage against the reference on the default bench; every comparison must also see one wrong
/// value.
fn check_all_stages(weights: &Weights, resolution: Resolution, pupil_mm: f32, seed: u32, set: InstructionSet) {
    check_on(&DisplayGeometry::DEFAULT, weights, resolution, pupil_mm, seed, set);
}

fn check_on(
    bench: &DisplayGeometry,
    weights: &Weights,
    resolution: Resolution,
    pupil_mm: f32,
    seed: u32,
    set: InstructionSet,
) {
    let [frame, other] = [seed, seed + 1].map(|seed| frame(resolution, seed));
    let pupil = PupilDiameter::from_mm(pupil_mm);
    let network = Network::of_frames(weights, bench, resolution, Products::Single(set)).unwrap();
    let context = format!("{resolution}, {} on {}", weights.config().channels, set.name());
    let reference = reference::run(weights, bench, &frame, pupil);
    check_network(
        &context,
        network,
        reference,
        "expected stack",
        [&frame, &other],
        [pupil, PupilDiameter::from_mm(2.0)],
        resolution,
    );
}

/// Runs a network on the first of two inputs, stage by stage, after the second one.
fn check_network<I>(
    context: &str,
    mut network: Network<I>,
    reference::Trace { mut stages, field }: reference::Trace,
    first: &str,
    [input, other]: [&I; 2],
    [pupil, other_pupil]: [PupilDiameter; 2],
    resolution: Resolution,
) {
    stages.push(reference::Stage { name: "field".into(), value: Value::Light(field.clone()) });
    // The second time round, what the first left in the maps must not show.
    let mut hologram = ComplexHologram::dark(resolution);
    network.render(other, other_pupil, &mut hologram);
    let mut remaining = stages.iter_mut();
    let conditions = network.conditions(pupil);
    let mut job = Job { input, pupil_mm: pupil.mm(), conditions, hologram: &mut hologram };
    network.stages.run_seen(&mut job, &mut |name, seen| {
        let stage = remaining.next().unwrap_or_else(|| panic!("{context}: {name} is not in the reference"));
        assert_eq!(name, name_of(stage, first), "{context}");
        check_stage(&format!("{context}: {name}"), &seen, &mut stage.value);
    });
    assert!(remaining.next().is_none(), "{context}: a stage of the reference is missing");

    hologram.field.fill(Complex32::ZERO);
    network.render(input, pupil, &mut hologram);
    check_stage(&format!("{context}: rendered"), &Seen::Light(hologram.field[..].into()), &mut Value::Light(field));
}

/// Compares what a stage wrote with what it should have written, and again after `expected` was spoiled.
fn check_stage(what: &str, seen: &Seen<'_>, expected: &mut Value) {
    let error = match (seen, &*expected) {
        (Seen::Inputs(map, channels), Value::Encoded(expected)) => error_of_channels(map, channels, expected),
        (Seen::Map(map, offsets), Value::Layer(expected, expected_offsets)) => {
            assert_eq!(offsets.is_some(), expected_offsets.is_some(), "{what}");
            let errors = offsets.iter().zip(expected_offsets).map(|(map, expected)| map_error(map, expected));
            largest(errors.chain([map_error(map, expected)]))
        }
        (Seen::Light(light), Value::Light(expected)) => light_error(light, expected),
        _ => panic!("{what} wrote something else"),
    };
    assert!(error < TOLERANCE, "{what}: {error}");
    let spoiled = match (seen, expected) {
        (Seen::Inputs(map, channels), Value::Encoded(expected)) => {
            spoil(expected);
            error_of_channels(map, channels, expected)
        }
        (Seen::Map(map, offsets), Value::Layer(expected, expected_offsets)) => {
            let offsets = offsets.iter().zip(expected_offsets).map(|(map, expected)| error_once_spoiled(map, expected));
            offsets.fold(error_once_spoiled(map, expected), f64::min)
        }
        (Seen::Light(light), Value::Light(expected)) => {
            let middle = expected.len() / 2;
            expected[middle].im += 1e-3 * largest(expected.iter().map(|value| value.norm()));
            light_error(light, expected)
        }
        _ => unreachable!("the same kinds as above"),
    };
    assert!(spoiled > TOLERANCE, "{what}: the comparison is blind");
}

fn config(grid: Grid, layers: usize, channels: usize, adjustable_layers: Vec<usize>) -> NetworkConfig {
    NetworkConfig { grid, layers, channels, adjustable_layers, modulation_hidden: 8, ..weights_tests::config() }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn every_stage_matches_the_reference(
        width in 1usize..64,
        height in 1usize..10,
        channels in 1usize..40,
        half_band in any::<bool>(),
        adjustable in 1usize..3,
        pupil_mm in 1.0f32..5.0,
        seed in 0u32..1000,
    ) {
        let grid = if half_band { Grid::HalfBand } else { Grid::Full };
        let weights = random_weights(config(grid, 4, channels, vec![adjustable]), u64::from(seed));
        for set in InstructionSet::available() {
            check_all_stages(&weights, Resolution { width, height }, pupil_mm, seed, set);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]
    #[test]
    fn every_stage_of_an_expected_stack_network_matches_the_reference(
        width in 1usize..40,
        height in 1usize..14,
        channels in 1usize..20,
        depth_layers in 2usize..7,
        refined_stack in any::<bool>(),
        pupil_mm in 1.0f32..5.0,
        seed in 0u32..1000,
    ) {
        let config = NetworkConfig { channels, depth_layers, refined_stack, ..weights_tests::expected_stack_config() };
        let weights = random_weights(config, u64::from(seed));
        for set in InstructionSet::available() {
            check_all_stages(&weights, Resolution { width, height }, pupil_mm, seed, set);
        }
    }
}

/// Images for a network with `planes`.
fn focal_stack(resolution: Resolution, planes: usize, pupil_mm: f32, seed: u32) -> FocalStack {
    let bench = DisplayGeometry::DEFAULT;
    FocalStack {
        resolution,
        amplitude: (0..planes).flat_map(|plane| frame(resolution, seed + 31 * plane as u32).amplitude).collect(),
        focuses: (0..planes).map(|plane| bench.depth_at(plane as f64 / (planes - 1) as f64)).collect(),
        pupil: PupilDiameter::from_mm(pupil_mm),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn every_stage_of_a_focal_stack_network_matches_the_reference(
        width in 1usize..40,
        height in 1usize..14,
        channels in 1usize..20,
        planes in 2usize..7,
        pupil_mm in 1.0f32..5.0,
        seed in 0u32..1000,
    ) {
        let config = NetworkConfig { channels, planes, ..weights_tests::focal_stack_config() };
        let (weights, bench) = (random_weights(config, u64::from(seed)), DisplayGeometry::DEFAULT);
        let resolution = Resolution { width, height };
        let inputs = [seed, seed + 1].map(|seed| focal_stack(resolution, planes, pupil_mm, seed));
        for set in InstructionSet::available() {
            let reference = reference::run_focal_stack(&weights, &bench, &inputs[0]);
            let network = Network::of_focal_stacks(&weights, &bench, resolution, Products::Single(set)).unwrap();
            let context = format!("{resolution}, {channels}, {planes} planes on {}", set.name());
            let pupils = [inputs[0].pupil, PupilDiameter::from_mm(2.0)];
            check_network(&context, network, reference, "focal stack", [&inputs[0], &inputs[1]], pupils, resolution);
        }
    }
}

#[test]
fn a_focal_stack_that_the_network_does_not_take_is_refused_in_words() {
    let bench = DisplayGeometry::DEFAULT;
    let size = Resolution { width: 6, height: 4 };
    let weights = random_weights(weights_tests::focal_stack_config(), 3);
    let mut engine = FocalStackEngine::new(&weights, &bench, size, Precision::Single).unwrap();
    let mut hologram = ComplexHologram::dark(size);
    let mut error_of = |stack: &FocalStack| engine.render(stack, &mut hologram).unwrap_err().to_string();
    let right = focal_stack(size, 3, 3.0, 1);
    let error = error_of(&focal_stack(size, 2, 3.0, 1));
    assert!(error.contains("found 2 images focused at 0.000, 2.857 dpt; the network takes 3 images"), "{error}");
    let error = error_of(&FocalStack { focuses: [0.0, 1.0, 2.857].map(Dioptres).to_vec(), ..right.clone() });
    assert!(error.contains("at 0.000, 1.000, 2.857 dpt") && error.contains("0.000, 1.429, 2.857 dpt"), "{error}");
    let error = error_of(&FocalStack { pupil: PupilDiameter::from_mm(0.0), ..right.clone() });
    assert!(error.contains("pupil diameter 0 mm"), "{error}");
    let error = error_of(&focal_stack(Resolution { width: 5, height: 4 }, 3, 3.0, 1));
    assert!(error.contains("the stack is 5x4; this engine was made for 6x4"), "{error}");
    engine.render(&right, &mut hologram).unwrap();

    let takes_images = CpuEngine::new(&weights, &bench, size, Precision::Single).err().unwrap().to_string();
    assert!(takes_images.contains("`focal-stack` network") && takes_images.contains("--focal-stack"), "{takes_images}");
    let takes_frames =
        FocalStackEngine::new(&Weights::builtin_fast(), &bench, size, Precision::Single).err().unwrap().to_string();
    assert!(takes_frames.contains("`expected-stack` network") && takes_frames.contains("its depth"), "{takes_frames}");
}

#[test]
fn as_many_depth_layers_as_can_be_match_the_reference_at_the_widest_pupil() {
    let config = NetworkConfig { channels: 4, depth_layers: 64, ..weights_tests::expected_stack_config() };
    check_all_stages(&random_weights(config, 4), Resolution { width: 12, height: 7 }, 5.0, 4, InstructionSet::best());
}

#[test]
fn blurs_wider_than_the_table_of_the_disc_match_the_reference() {
    let config = NetworkConfig { channels: 4, ..weights_tests::expected_stack_config() };
    let bench =
        DisplayGeometry { pixel_pitch: Metres(1e-6), eyepiece_focal_length: Metres(2.0), ..DisplayGeometry::DEFAULT };
    let size = Resolution { width: 12, height: 7 };
    check_on(&bench, &random_weights(config, 4), size, 5.0, 4, InstructionSet::best());
}

#[test]
fn another_bench_matches_the_reference_from_the_narrowest_pupil_to_the_widest() {
    let direct = random_weights(config(Grid::HalfBand, 4, 8, vec![1]), 5);
    let refined = NetworkConfig { refined_stack: true, ..weights_tests::expected_stack_config() };
    let benches = [OTHER_BENCH, DisplayGeometry { pixel_pitch: Metres(3.74e-6), ..DisplayGeometry::DEFAULT }];
    for weights in [direct, random_weights(refined, 5), Weights::builtin_small()] {
        for (bench, pupil_mm) in benches.iter().zip([[0.5, 8.0], [2.0, WIDEST_PUPIL.mm()]]).flat_map(pairs) {
            check_on(bench, &weights, Resolution { width: 31, height: 18 }, pupil_mm, 6, InstructionSet::best());
        }
    }
}

fn pairs((bench, pupils_mm): (&DisplayGeometry, [f32; 2])) -> [(&DisplayGeometry, f32); 2] {
    pupils_mm.map(|pupil_mm| (bench, pupil_mm))
}

/// Largest difference of two holograms, relative to the largest value of the second.
fn apart(actual: &[Complex32], expected: &[Complex32]) -> f64 {
    let expected: Vec<_> = expected.iter().map(|value| Complex64::new(value.re.into(), value.im.into())).collect();
    light_error(actual, &expected)
}

/// Where blur and diffraction in pixels are the same, all that differs is that light goes at larger angles behind finer
/// pixels.
#[test]
fn the_same_bench_in_pixels_has_the_same_hologram() {
    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
    let resolution = Resolution { width: 64, height: 48 };
    let frame = frame(resolution, 8);
    for weights in [random_weights(weights_tests::expected_stack_config(), 5), Weights::builtin_small()] {
        let hologram = |pitch_um: f64, focal_length_mm: f64| {
            let bench = DisplayGeometry {
                pixel_pitch: Metres(pitch_um * 1e-6),
                eyepiece_focal_length: Metres(focal_length_mm * 1e-3),
                ..BENCH
            };
            let mut hologram = ComplexHologram::dark(resolution);
            let mut engine = CpuEngine::new(&weights, &bench, resolution, Precision::Single).unwrap();
            engine.render(&frame, PupilDiameter::from_mm(3.0), &mut hologram).unwrap();
            hologram.field
        };
        let expected = hologram(8.0, 40.0);
        let same = apart(&hologram(6.4, 32.0), &expected);
        let other = apart(&hologram(7.0, 40.0), &expected);
        assert!(same < SAME_IN_PIXELS, "{same}");
        assert!(other > SAME_IN_PIXELS, "{other}: the comparison is blind");
    }
}

#[test]
fn one_pixel_one_column_and_one_row_match_the_reference() {
    let direct = random_weights(config(Grid::HalfBand, 6, 12, vec![3, 4]), 5);
    let expected_stack = random_weights(weights_tests::expected_stack_config(), 5);
    let refined_stack =
        random_weights(NetworkConfig { refined_stack: true, ..weights_tests::expected_stack_config() }, 5);
    for (width, height) in [(1, 1), (1, 33), (57, 1), (2, 2), (101, 5)] {
        for weights in [&direct, &expected_stack, &refined_stack] {
            for set in InstructionSet::available() {
                check_all_stages(weights, Resolution { width, height }, 3.3, 9, set);
            }
        }
    }
}

#[test]
fn the_built_in_network_matches_the_reference_at_both_ends_of_the_pupil_range() {
    for pupil_mm in [1.0, 5.0] {
        check_all_stages(
            &Weights::builtin(),
            Resolution { width: 34, height: 22 },
            pupil_mm,
            3,
            InstructionSet::best(),
        );
    }
}

#[test]
fn an_engine_renders_as_its_network_does_and_tells_it_the_nearest_pupil() {
    let weights = random_weights(config(Grid::HalfBand, 4, 8, vec![1]), 2);
    let resolution = Resolution { width: 31, height: 18 };
    let mut engine = CpuEngine::new(&weights, &DisplayGeometry::DEFAULT, resolution, Precision::Single).unwrap();
    let frame = frame(resolution, 4);
    let mut hologram = ComplexHologram::dark(resolution);
    for (given_mm, meant_mm) in [(5.0, 5.0), (1.5, 1.5), (9.0, 5.0), (0.2, 1.0)] {
        engine.render(&frame, PupilDiameter::from_mm(given_mm), &mut hologram).unwrap();
        let error = light_error(
            &hologram.field,
            &reference::run(&weights, &DisplayGeometry::DEFAULT, &frame, PupilDiameter::from_mm(meant_mm)).field,
        );
        assert!(error < TOLERANCE, "{given_mm} mm: {error}");
    }
    let (last, timings) = (weights.config().layers - 1, engine.last_timings());
    assert_eq!(timings.stages.len(), last + 3);
    assert_eq!(timings.stages[2].name, "layer 1 (adjustable)");
    assert_eq!(timings.stages[2].flop, 2 * 9 * 8 * (8 + 18) * 16 * 9);
}

#[test]
fn stages_tell_the_least_that_they_move() {
    let resolution = Resolution { width: 31, height: 18 };
    let stages = |config| {
        let engine =
            CpuEngine::new(&random_weights(config, 2), &DisplayGeometry::DEFAULT, resolution, Precision::Single)
                .unwrap();
        engine.last_timings().stages.iter().map(|stage| (stage.name.clone(), stage.bytes)).collect::<Vec<_>>()
    };
    // Picture and depth; planes on the network's grid; what comes out.
    let frame = 4 * 4 * 31 * 18;
    let planes = |count: u64| count * 4 * 16 * 9;
    let hologram = 3 * 8 * 31 * 18;
    let numbers = planes(4);
    let named =
        |stages: &[(&str, u64)]| stages.iter().map(|&(name, bytes)| (name.to_owned(), bytes)).collect::<Vec<_>>();
    assert_eq!(
        stages(config(Grid::HalfBand, 4, 8, vec![1])),
        named(&[
            ("encode", frame + planes(22 + 3)),
            ("layer 0", planes(22 + 8)),
            ("layer 1 (adjustable)", planes(8 + 8)),
            ("layer 2", planes(8 + 8 + 8)),
            ("layer 3", planes(8 + 6)),
            ("field", planes(6 + 3) + hologram),
        ])
    );
    // Five layers of three amplitudes; 4 outputs light each layer, 3 refine it.
    for (refined_stack, lighting, stack) in [(false, 4 * 5, 15), (true, 7 * 5, 15 + 15)] {
        let config = NetworkConfig { refined_stack, channels: 8, ..weights_tests::expected_stack_config() };
        assert_eq!(
            stages(config),
            named(&[
                ("expected stack", frame + numbers + planes(15 + 22 + 15)),
                ("lighting layer 0", planes(22 + 15 + 8)),
                ("lighting layer 1", planes(8 + 8)),
                ("lighting layer 2 (adjustable)", planes(8 + 8 + 8)),
                ("lighting layer 3", planes(8 + lighting)),
                ("light of the layers", planes(lighting + stack + 6)),
                ("feedback", numbers + planes(6 + 15 + 6 + 6 + 6 + 15)),
                ("correction layer 0", planes(6 + 22 + 15 + 6 + 15 + 8)),
                ("correction layer 1", planes(8 + 8)),
                ("correction layer 2", planes(8 + 8 + 8)),
                ("correction layer 3", planes(8 + 6)),
                ("field", planes(6 + 6) + hologram),
            ])
        );
    }
}

#[test]
fn what_is_no_number_at_the_border_leaves_no_trace_in_the_next_frame() {
    // Neither is a multiple of any set's lanes.
    let resolution = Resolution { width: 37, height: 18 };
    for (weights, products) in [random_weights(config(Grid::HalfBand, 4, 8, vec![1]), 2), Weights::builtin_small()]
        .iter()
        .flat_map(|weights| Products::available().map(move |products| (weights, products)))
    {
        let render = |network: &mut Network<RgbdFrame>, frame: &RgbdFrame| {
            let mut hologram = ComplexHologram::dark(resolution);
            network.render(frame, PupilDiameter::from_mm(3.0), &mut hologram);
            hologram.field
        };
        let mut network = Network::of_frames(weights, &DisplayGeometry::DEFAULT, resolution, products).unwrap();
        let clean = render(&mut network, &frame(resolution, 4));
        let spoilers = [(0, f32::NAN), (36, f32::INFINITY), (37 * 18 - 1, f32::NEG_INFINITY)];
        for (pixel, spoiler) in spoilers {
            let context = format!("pixel {pixel} on {}", products.name());
            let mut spoiled = frame(resolution, 4);
            spoiled.amplitude[pixel] = spoiler;
            assert!(render(&mut network, &spoiled).iter().any(|value| !value.is_finite()), "{context} is not seen");
            assert_eq!(render(&mut network, &frame(resolution, 4)), clean, "{context} left a trace");
            let mut spoiled = frame(resolution, 4);
            spoiled.depth_normalised[pixel] = spoiler;
            render(&mut network, &spoiled);
            assert_eq!(render(&mut network, &frame(resolution, 4)), clean, "the depth of {context} left a trace");
        }
    }
}

#[test]
fn wrong_sizes_and_pupils_are_refused() {
    let weights = random_weights(config(Grid::HalfBand, 4, 8, vec![]), 2);
    let (right, wrong) = (Resolution { width: 8, height: 6 }, Resolution { width: 6, height: 8 });
    let mut engine = CpuEngine::new(&weights, &DisplayGeometry::DEFAULT, right, Precision::Single).unwrap();
    let pupil = PupilDiameter::from_mm(3.0);
    let mut render = |frame_size, pupil, hologram_size| {
        engine.render(&frame(frame_size, 0), pupil, &mut ComplexHologram::dark(hologram_size))
    };
    assert!(render(right, pupil, right).is_ok());
    assert!(matches!(render(wrong, pupil, right), Err(EngineError::Resolution { what: "the frame", .. })));
    assert!(matches!(render(right, pupil, wrong), Err(EngineError::Resolution { what: "the hologram", .. })));
    for pupil_mm in [f32::NAN, f32::INFINITY, 0.0, -2.0, 20.1] {
        assert!(matches!(render(right, PupilDiameter::from_mm(pupil_mm), right), Err(EngineError::Pupil { .. })));
    }
    let empty = Resolution { width: 0, height: 4 };
    let none = CpuEngine::new(&weights, &DisplayGeometry::DEFAULT, empty, Precision::Single);
    assert!(matches!(none, Err(EngineError::Empty { .. })));
}

#[test]
fn a_frame_is_the_same_to_the_bit_whatever_was_rendered_before() {
    let resolution = Resolution { width: 37, height: 26 };
    let other = frame(resolution, 4);
    // Some layers have nothing now.
    let mut shown = frame(resolution, 5);
    for (index, depth) in shown.depth_normalised.iter_mut().enumerate() {
        *depth = if index % resolution.width < 20 { 0.7 } else { 0.1 };
    }
    for products in Products::available() {
        let weights = Weights::builtin_fast();
        let mut network = Network::of_frames(&weights, &DisplayGeometry::DEFAULT, resolution, products).unwrap();
        let mut render = |frame, pupil_mm| {
            let mut hologram = ComplexHologram::dark(resolution);
            network.render(frame, PupilDiameter::from_mm(pupil_mm), &mut hologram);
            hologram
        };
        let alone = render(&shown, 3.0);
        let before = render(&other, 5.0);
        assert!(before != alone, "another frame is another hologram");
        assert!(render(&shown, 3.0) == alone, "{}", products.name());
    }
}

/// Largest difference allowed between a hologram in half precision and the same in single precision, over the largest
/// value; an eye sees a hundredth of it.
const HALF_TOLERANCE: f64 = 0.05;

#[test]
fn whole_networks_in_half_precision_are_near_the_same_in_single() {
    let (resolution, bench) = (Resolution { width: 48, height: 32 }, DisplayGeometry::DEFAULT);
    let frame = frame(resolution, 4);
    for weights in [Weights::builtin(), Weights::builtin_small(), Weights::builtin_fast()] {
        let render = |products, pupil_mm| {
            let mut hologram = ComplexHologram::dark(resolution);
            let mut network = Network::of_frames(&weights, &bench, resolution, products).unwrap();
            network.render(&frame, PupilDiameter::from_mm(pupil_mm), &mut hologram);
            hologram.field
        };
        let half = Products::available().filter(|products| products.factors() == 2);
        for (products, pupil_mm) in half.flat_map(|products| [(products, 1.0), (products, 6.0)]) {
            let single = render(Products::Single(InstructionSet::best()), pupil_mm);
            let mut found = render(products, pupil_mm);
            let (error, context) = (apart(&found, &single), format!("{} at {pupil_mm} mm", products.name()));
            assert!(error > 1e-4, "{context}: {error}, so it was computed in single precision");
            assert!(error < HALF_TOLERANCE, "{context}: {error}");
            found[99].re +=
                2.0 * HALF_TOLERANCE as f32 * largest(single.iter().map(|value| value.norm().into())) as f32;
            assert!(apart(&found, &single) > HALF_TOLERANCE, "{context}: the comparison is blind");
        }
    }
}

#[test]
fn half_precision_is_taken_where_it_is_asked_for_and_pays() {
    let (weights, resolution) = (Weights::builtin_fast(), Resolution { width: 8, height: 6 });
    let set = |precision| {
        CpuEngine::new(&weights, &DisplayGeometry::DEFAULT, resolution, precision).unwrap().instruction_set()
    };
    assert_eq!(set(Precision::Single), InstructionSet::best().name());
    let half = Products::half().filter(|_| super::peak::half_pays());
    assert_eq!(set(Precision::Half), half.map_or(InstructionSet::best().name(), Products::name));
}
