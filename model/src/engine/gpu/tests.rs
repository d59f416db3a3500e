//! The GPU's stages on Mesa's software device, against their twins on the processor.

use std::f32::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;
use std::time::Duration;

use holod_calibration::{Colour, DisplayGeometry, LevelTables, PerColour, PupilDiameter, Resolution};
use num_complex::{Complex32, Complex64};
use proptest::prelude::*;

use super::conv::Method;
use super::engine::GpuEngine;
use super::fft::WorkgroupLimits;
use super::map::Format;
use super::plan::Plan;
use super::shared::Shared;
use super::trial::Trial;
use super::trunk::Features;
use super::{double_phase, levels};
use crate::engine::cpu::tests::{OTHER_BENCH, frame};
use crate::engine::{CpuEngine, EngineError, Precision, reference};
use crate::gpu::{GpuError, MatrixUnits, test_adapters, test_gpu};
use crate::optics::DoublePhase;
use crate::weights::tests::{self as weights_tests, random_weights};
use crate::weights::{Grid, NetworkConfig};
use crate::worst::worst;
use crate::{ComplexHologram, PhasePattern, RgbdFrame, Weights};

/// Numbers that look random, in 0..1.
fn noise(index: usize, seed: u32) -> f32 {
    let mixed = (index as u32).wrapping_mul(0x9E37_79B9) ^ seed.wrapping_mul(0x85EB_CA6B);
    ((mixed ^ (mixed >> 15)).wrapping_mul(0x2C1B_3C6D) >> 8) as f32 / (1 << 24) as f32
}

/// Bright and dark places, some beyond what can be encoded, some no numbers.
fn hologram(resolution: Resolution, seed: u32) -> ComplexHologram {
    let value = |index: usize| {
        let place = index % resolution.pixels();
        let (x, y) = (place % resolution.width, place / resolution.width);
        match (index + seed as usize) % 331 {
            17 => return Complex32::new(f32::NAN, 0.1),
            18 => return Complex32::new(1e30, 0.0),
            19 => return Complex32::new(0.3, f32::INFINITY),
            _ => {}
        }
        let lit = if (x / 12 + y / 9) % 2 == 0 { 1.3 } else { 0.02 };
        Complex32::from_polar(lit * noise(index, seed), 0.4 * (x as f32 - y as f32) + 0.6 * noise(index, seed + 7))
    };
    ComplexHologram { resolution, field: (0..3 * resolution.pixels()).map(value).collect() }
}

/// Largest distance of two phases on the circle, and how many are farther apart than `tolerance_rad`.
fn phase_error(actual: &[f32], expected: &[f32], tolerance_rad: f32) -> (f32, usize) {
    assert_eq!(actual.len(), expected.len());
    let distances = actual.iter().zip(expected).map(|(a, e)| {
        let distance = (a - e).rem_euclid(TAU);
        if distance.is_nan() { f32::INFINITY } else { distance.min(TAU - distance) }
    });
    distances.fold((0.0, 0), |(worst, count), distance| {
        (f32::max(worst, distance), count + usize::from(distance > tolerance_rad))
    })
}

/// Phases, and each colour's count of clipped samples, on the device.
fn encoded_on_gpu(hologram: &ComplexHologram, constant: f32) -> (Vec<f32>, [u32; 3]) {
    let mut plan = Plan::default();
    let shared = Shared::new(&mut plan, hologram.resolution, hologram.resolution, Precision::Single);
    let clipped = plan.buffer::<u32>("clipped samples", 3);
    let phases = double_phase::encode(&mut plan, &shared, constant, clipped);
    let trial = Trial::new(&plan);
    let parts: Vec<f32> = hologram.field.iter().flat_map(|value| [value.re, value.im]).collect();
    trial.write(shared.field, &parts);
    trial.run();
    let counts = trial.read(clipped);
    (trial.read(phases), [0, 1, 2].map(|colour| counts[colour].to_bits()))
}

#[test]
fn double_phase_is_the_processors() {
    const TOLERANCE_RAD: f32 = 2e-3;
    for (width, height) in [(1, 1), (2, 1), (1, 37), (5, 3), (64, 64), (33, 35), (101, 67), (130, 97)] {
        let hologram = hologram(Resolution { width, height }, 3);
        let mut pattern = PhasePattern::flat(hologram.resolution);
        let report = DoublePhase::new(hologram.resolution, 1.25).encode(&hologram, &mut pattern);
        let (phases_rad, clipped) = encoded_on_gpu(&hologram, 1.25);
        for (count, share) in clipped.into_iter().zip(report.clipped_share.0) {
            let found = count as f32 / hologram.resolution.pixels() as f32;
            assert!((found - share).abs() < 1e-6, "{width}x{height}: {found} of {share}");
        }
        assert!(phases_rad.iter().all(|phase| (0.0..TAU).contains(phase)));
        // Where a corrected phasor is nearly 0 its phase is anything.
        let (worst, count) = phase_error(&phases_rad, &pattern.phase_rad, TOLERANCE_RAD);
        assert!(count <= phases_rad.len() / 2000, "{width}x{height}: {count} phases are off, by up to {worst} rad");
        let mut spoiled = pattern.phase_rad.clone();
        let wrong = 1 + phases_rad.len() / 2000;
        spoiled.iter_mut().take(wrong).for_each(|phase| *phase += 0.01);
        assert!(
            phase_error(&phases_rad, &spoiled, TOLERANCE_RAD).1 > phases_rad.len() / 2000,
            "{width}x{height}: the comparison is blind"
        );
    }
}

/// The samples of `phases_rad` by the definition, and how many are out of reach in each colour.
fn samples(tables: &LevelTables, phases_rad: &[f32]) -> (Vec<u16>, [u32; 3]) {
    let LevelTables { panel, pattern, origin: [left, top], mirrors: [mirror_x, mirror_y], .. } = tables;
    let mut unreachable = [0; 3];
    let samples = (0..3 * panel.pixels()).map(|index| {
        let (position, pixel) = match tables.interleaved {
            true => (index % 3, index / 3),
            false => (index / panel.pixels(), index % panel.pixels()),
        };
        let colour = tables.field_order[position];
        let (x, y) = ((pixel % panel.width).wrapping_sub(*left), (pixel / panel.width).wrapping_sub(*top));
        let x = if *mirror_x { (pattern.width - 1).wrapping_sub(x) } else { x };
        let y = if *mirror_y { (pattern.height - 1).wrapping_sub(y) } else { y };
        let inside = x < pattern.width && y < pattern.height;
        let phase_rad = match inside {
            true => phases_rad[colour.index() * pattern.pixels() + y * pattern.width + x],
            false if x.wrapping_add(y) % 2 == 1 => FRAC_PI_2,
            false => 3.0 * FRAC_PI_2,
        };
        let table = &tables.levels[colour];
        let flat = tables.flatness[colour].as_ref().map_or(0.0, |flatness| flatness[pixel]);
        let entry = phase_rad * (table.len() as f32 / TAU) + flat;
        let level = table[(entry.floor() as i64).rem_euclid(table.len() as i64) as usize];
        unreachable[colour.index()] += u32::from(inside && level >= LevelTables::UNREACHABLE);
        level as u16
    });
    (samples.collect(), unreachable)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn levels_are_those_of_the_tables(
        width in 1usize..40,
        height in 1usize..12,
        around in (0usize..9, 0usize..5),
        interleaved in any::<bool>(),
        mirrors in any::<[bool; 2]>(),
        flat in any::<bool>(),
        seed in 0u32..1000,
    ) {
        const ENTRIES: usize = 4096;
        let pattern = Resolution { width, height };
        let panel = Resolution { width: width + around.0, height: height + around.1 };
        let level = |index: usize| {
            let unreachable = index % 97 == 5;
            (index * 255 / ENTRIES) as u32 | if unreachable { LevelTables::UNREACHABLE } else { 0 }
        };
        let tables = LevelTables {
            panel,
            pattern,
            origin: [around.0 / 2, around.1 / 2],
            mirrors,
            interleaved,
            field_order: [Colour::Blue, Colour::Red, Colour::Green],
            levels: PerColour([0, 5, 11].map(|first| (first..first + ENTRIES).map(level).collect())),
            flatness: PerColour([0, 1, 2].map(|colour| {
                (!flat && colour != 1).then(|| {
                    (0..panel.pixels()).map(|index| ENTRIES as f32 * noise(index, seed + colour)).collect()
                })
            })),
        };
        let phases_rad: Vec<f32> = (0..3 * pattern.pixels()).map(|index| TAU * noise(index, seed)).collect();

        let mut plan = Plan::default();
        let phases = plan.table("phases", &phases_rad);
        let unreachable = plan.buffer::<u32>("samples out of reach", 3);
        let written = levels::encode(&mut plan, &tables, phases, unreachable);
        let trial = Trial::new(&plan);
        trial.run();
        let words = trial.read(written).into_iter().map(f32::to_bits);
        let found: Vec<u16> = words.flat_map(|word| [word as u16, (word >> 16) as u16]).collect();
        let counts = trial.read(unreachable).into_iter().map(f32::to_bits);

        let (expected, expected_counts) = samples(&tables, &phases_rad);
        // A phase on the border of an entry may fall on either side of it.
        let tolerated = 1 + expected.len() / 500;
        let different = |expected: &[u16]| found.iter().zip(expected).filter(|(f, e)| f != e).count();
        prop_assert!(different(&expected) <= tolerated, "{} of {}", different(&expected), expected.len());
        for (count, expected) in counts.zip(expected_counts) {
            prop_assert!(count.abs_diff(expected) <= 1 + expected / 20, "{count} for {expected}");
        }
        let mut spoiled = expected;
        spoiled.iter_mut().for_each(|sample| *sample ^= 1);
        prop_assert!(found.len() < 8 || different(&spoiled) > tolerated, "the comparison is blind");
    }
}

/// Tables of a panel of 8 bits whose levels go evenly round the circle.
fn linear_tables(resolution: Resolution) -> LevelTables {
    const ENTRIES: usize = 4096;
    let table = || (0..ENTRIES).map(|entry| ((entry + 8) / 16 % 256) as u32).collect();
    LevelTables {
        panel: resolution,
        pattern: resolution,
        origin: [0, 0],
        mirrors: [false; 2],
        interleaved: true,
        field_order: Colour::ALL,
        levels: PerColour([table(), table(), table()]),
        flatness: PerColour([None, None, None]),
    }
}

fn engine(weights: &Weights, bench: &DisplayGeometry, resolution: Resolution) -> GpuEngine {
    engine_in(Precision::Single, weights, bench, resolution)
}

fn engine_in(precision: Precision, weights: &Weights, bench: &DisplayGeometry, resolution: Resolution) -> GpuEngine {
    let tables = linear_tables(resolution);
    GpuEngine::open(weights, bench, &tables, test_adapters().into(), Some(precision)).expect("an engine")
}

/// Samples and hologram of a frame.
fn rendered(engine: &mut GpuEngine, frame: &Arc<RgbdFrame>, pupil_mm: f32) -> (Vec<u16>, ComplexHologram) {
    let mut samples = vec![9; 3 * frame.resolution.pixels()];
    engine.render(frame, PupilDiameter::from_mm(pupil_mm), &mut samples).expect("a frame");
    let mut hologram = ComplexHologram::dark(frame.resolution);
    engine.read_hologram(&mut hologram).expect("its hologram");
    (samples, hologram)
}

/// The hologram of a frame by an engine of its own.
pub(in crate::engine) fn hologram_of(
    weights: &Weights,
    bench: &DisplayGeometry,
    frame: &RgbdFrame,
    pupil: PupilDiameter,
) -> ComplexHologram {
    rendered(&mut engine(weights, bench, frame.resolution), &Arc::new(frame.clone()), pupil.mm()).1
}

/// The largest difference relative to the largest value.
fn field_error(actual: &[Complex32], expected: &[Complex64]) -> f64 {
    assert_eq!(actual.len(), expected.len());
    let largest = expected.iter().map(|value| value.norm()).fold(0.0, f64::max);
    let differences = actual.iter().zip(expected).map(|(a, e)| (Complex64::new(a.re.into(), a.im.into()) - e).norm());
    worst(differences) / largest
}

/// How many levels of a circle of 256 are farther apart than one.
fn levels_apart(actual: &[u16], expected: &[u16]) -> usize {
    assert_eq!(actual.len(), expected.len());
    let apart = |(a, e): (&u16, &u16)| (2..255).contains(&(a.wrapping_sub(*e) & 0xff));
    actual.iter().zip(expected).filter(|&pair| apart(pair)).count()
}

/// Largest difference of a hologram, relative to its largest value.
const FIELD_TOLERANCE: f64 = 5e-5;

/// The whole way on the device on the default bench, against the reference in double precision and the processor's
/// levels.
fn check(weights: &Weights, resolution: Resolution, pupil_mm: f32, seed: u32) {
    check_on(&DisplayGeometry::DEFAULT, weights, resolution, pupil_mm, seed);
}

fn check_on(bench: &DisplayGeometry, weights: &Weights, resolution: Resolution, pupil_mm: f32, seed: u32) {
    check_engine(&mut engine(weights, bench, resolution), bench, weights, resolution, pupil_mm, seed);
}

fn check_engine(
    engine: &mut GpuEngine,
    bench: &DisplayGeometry,
    weights: &Weights,
    resolution: Resolution,
    pupil_mm: f32,
    seed: u32,
) {
    let context = format!("{resolution} at {pupil_mm} mm");
    // What another frame and pupil leave behind must not show.
    rendered(engine, &Arc::new(frame(resolution, seed + 1)), 2.0);
    let frame = Arc::new(frame(resolution, seed));
    let (samples, hologram) = rendered(engine, &frame, pupil_mm);

    let mut expected = reference::run(weights, bench, &frame, PupilDiameter::from_mm(pupil_mm)).field;
    let error = field_error(&hologram.field, &expected);
    assert!(error < FIELD_TOLERANCE, "{context}: {error}");
    let middle = expected.len() / 2;
    expected[middle].im += 1e-3 * expected.iter().map(|value| value.norm()).fold(0.0, f64::max);
    assert!(field_error(&hologram.field, &expected) > FIELD_TOLERANCE, "{context}: the comparison is blind");

    let mut on_cpu = ComplexHologram::dark(resolution);
    CpuEngine::new(weights, bench, resolution, Precision::Single)
        .unwrap()
        .render(&frame, PupilDiameter::from_mm(pupil_mm), &mut on_cpu)
        .unwrap();
    let mut pattern = PhasePattern::flat(resolution);
    DoublePhase::new(resolution, weights.config().amplitude_constant).encode(&on_cpu, &mut pattern);
    let (mut expected, _) = self::samples(&linear_tables(resolution), &pattern.phase_rad);
    let tolerated = expected.len() / 1000;
    let apart = levels_apart(&samples, &expected);
    assert!(apart <= tolerated, "{context}: {apart} of {} levels are more than one apart", samples.len());
    expected.iter_mut().take(tolerated + 1).for_each(|level| *level ^= 0x80);
    assert!(levels_apart(&samples, &expected) > tolerated, "{context}: the comparison of levels is blind");
}

/// One at the size of its golden vectors, whose test compiles the same shaders.
#[test]
fn the_built_in_networks_match_the_reference_at_both_ends_of_the_pupil_range() {
    let golden = Resolution { width: 48, height: 32 };
    for (weights, resolution) in [(Weights::builtin(), golden), (Weights::builtin_small(), SIZE)] {
        let mut engine = engine(&weights, &DisplayGeometry::DEFAULT, resolution);
        for pupil_mm in [1.0, 5.0] {
            check_engine(&mut engine, &DisplayGeometry::DEFAULT, &weights, resolution, pupil_mm, 3);
        }
    }
}

/// The makers whose devices multiply each input by each weight are not those of software devices.
#[test]
fn a_network_of_direct_products_matches_the_reference_at_both_ends_of_the_pupil_range() {
    let (weights, bench) = (Weights::builtin_small(), DisplayGeometry::DEFAULT);
    let mut gpu = test_gpu();
    gpu.vendor = Method::NVIDIA;
    let tables = linear_tables(SIZE);
    let mut engine = GpuEngine::on(gpu, &weights, &bench, &tables, Some(Precision::Single)).expect("an engine");
    for pupil_mm in [1.0, 5.0] {
        check_engine(&mut engine, &bench, &weights, SIZE, pupil_mm, 4);
    }
}

/// Of tests that can have any size: the software device compiles every shader for each one, and takes what another test
/// has compiled. Lines of half of it have small factors, whose transforms are compiled soonest; of lines of 9 samples a
/// frequency lies on the edge of a pupil of 1 mm in blue light, and rounding decides.
const SIZE: Resolution = Resolution { width: 39, height: 19 };

#[test]
fn networks_on_another_bench_match_the_reference() {
    let direct = random_weights(NetworkConfig { channels: 12, ..weights_tests::config() }, 5);
    for (weights, pupils_mm) in [(direct, &[2.0][..]), (Weights::builtin_small(), &[1.0, 9.0])] {
        let mut engine = engine(&weights, &OTHER_BENCH, SIZE);
        for &pupil_mm in pupils_mm {
            check_engine(&mut engine, &OTHER_BENCH, &weights, SIZE, pupil_mm, 6);
        }
    }
}

/// The reference would take a minute.
#[test]
fn a_frame_of_256_pixels_each_way_is_the_processors() {
    let (weights, resolution) = (Weights::builtin(), Resolution { width: 256, height: 256 });
    let frame = frame(resolution, 5);
    let mut on_cpu = ComplexHologram::dark(resolution);
    CpuEngine::new(&weights, &DisplayGeometry::DEFAULT, resolution, Precision::Single)
        .unwrap()
        .render(&frame, PupilDiameter::from_mm(3.3), &mut on_cpu)
        .unwrap();
    let mut expected: Vec<Complex64> =
        on_cpu.field.iter().map(|value| Complex64::new(value.re.into(), value.im.into())).collect();
    let found = hologram_of(&weights, &DisplayGeometry::DEFAULT, &frame, PupilDiameter::from_mm(3.3));
    assert!(field_error(&found.field, &expected) < FIELD_TOLERANCE, "{}", field_error(&found.field, &expected));
    expected[777].re += 1e-3;
    assert!(field_error(&found.field, &expected) > FIELD_TOLERANCE, "the comparison is blind");
}

/// The largest error of a hologram whose features are in half precision, over its largest value; most of it is rounding
/// of features that later layers carry on, and an eye sees a hundredth of it.
const HALF_FIELD_TOLERANCE: f64 = 0.05;

#[test]
fn whole_networks_in_half_precision_are_near_the_same_in_single() {
    let frame = Arc::new(frame(SIZE, 4));
    let direct = |grid| random_weights(NetworkConfig { channels: 12, grid, ..weights_tests::config() }, 5);
    let built_in = [Weights::builtin(), Weights::builtin_small(), Weights::builtin_fast()];
    for weights in built_in.into_iter().chain([Grid::HalfBand, Grid::Full].map(direct)) {
        let bench = DisplayGeometry::DEFAULT;
        let mut half = engine_in(Precision::Half, &weights, &bench, frame.resolution);
        assert_eq!(half.precision(), Precision::Half, "the software device has it");
        assert_near_single(&mut half, &weights, &bench, &frame);
    }
}

/// Asserts that what an engine in half precision gives is near what the processor gives in single precision, and is not
/// that.
fn assert_near_single(half: &mut GpuEngine, weights: &Weights, bench: &DisplayGeometry, frame: &Arc<RgbdFrame>) {
    let mut on_cpu = CpuEngine::new(weights, bench, frame.resolution, Precision::Single).expect("an engine");
    let mut single = ComplexHologram::dark(frame.resolution);
    for pupil_mm in [1.0, 6.0] {
        on_cpu.render(frame, PupilDiameter::from_mm(pupil_mm), &mut single).expect("a frame");
        let (_, mut found) = rendered(half, frame, pupil_mm);
        let expected: Vec<_> = single.field.iter().map(|v| Complex64::new(v.re.into(), v.im.into())).collect();
        let error = field_error(&found.field, &expected);
        assert!(error > FIELD_TOLERANCE, "{error}: it was computed in single precision");
        assert!(error < HALF_FIELD_TOLERANCE, "{error} at {pupil_mm} mm");
        let largest = expected.iter().map(|value| value.norm()).fold(0.0, f64::max);
        found.field[99].re += (3.0 * HALF_FIELD_TOLERANCE * largest) as f32;
        assert!(field_error(&found.field, &expected) > HALF_FIELD_TOLERANCE, "the comparison is blind");
    }
}

/// With matrices in one network, whose inputs and layers do not fill them.
#[test]
fn a_whole_network_of_matrices_is_near_the_same_in_single_precision() {
    let frame = Arc::new(frame(SIZE, 4));
    let weights = Weights::builtin_fast();
    for units in [matrix_units(), MatrixUnits::ThreadsOfAnySubgroups { in_one: false }] {
        let mut matrices = of_matrices(units, &weights, frame.resolution);
        assert!(matrices.uses_matrix_units(), "it is left to the device");
        assert_near_single(&mut matrices, &weights, &DisplayGeometry::DEFAULT, &frame);
    }
}

/// Those of the device that tests run on, or threads.
fn matrix_units() -> MatrixUnits {
    test_gpu().matrix_units.unwrap_or(MatrixUnits::Threads)
}

/// An engine on the default bench that multiplies matrices on `units`.
fn of_matrices(units: MatrixUnits, weights: &Weights, resolution: Resolution) -> GpuEngine {
    let mut gpu = test_gpu();
    gpu.matrix_units = Some(units);
    let tables = linear_tables(resolution);
    GpuEngine::on(gpu, weights, &DisplayGeometry::DEFAULT, &tables, None).expect("an engine")
}

/// No software device has matrix units: what a card with them would compile is looked at here.
#[test]
fn shaders_for_matrix_units_are_valid() {
    use wgpu::naga;
    let limits = WorkgroupLimits { bytes: 32 << 10, threads: 512 };
    let tables = linear_tables(Resolution { width: 50, height: 34 });
    let valid = |source: &str| -> Result<(), String> {
        let capabilities = naga::valid::Capabilities::all();
        let options = naga::front::wgsl::Options { capabilities, ..naga::front::wgsl::Options::new() };
        let module = naga::front::wgsl::Frontend::new_with_options(options).parse(source);
        let module = module.map_err(|error| error.emit_to_string(source))?;
        let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities);
        validator.validate(&module).map_err(|error| error.emit_to_string(source))?;
        Ok(())
    };
    let mut with_matrices = 0;
    let networks = [Weights::builtin(), Weights::builtin_small(), Weights::builtin_fast()];
    let all_units = [MatrixUnits::Device, MatrixUnits::DeviceOfAnySubgroups];
    for (weights, units) in networks.iter().flat_map(|weights| all_units.map(|units| (weights, units))) {
        let bench = DisplayGeometry::DEFAULT;
        let features = Features { format: Format::HalfTiles(units), method: Method::Winograd };
        let network = super::network::NetworkPlan::new(weights, &bench, &tables, features, limits).expect("a plan");
        for shader in network.plan.stages.iter().flat_map(|stage| &stage.dispatches).map(|dispatch| &dispatch.shader) {
            valid(&shader.source).unwrap_or_else(|error| panic!("{}: {error}", shader.label));
            if shader.source.contains("coopMultiplyAdd") {
                with_matrices += 1;
                let wrong = shader.source.replace("coop_mat16x16<f16, A>", "coop_mat16x16<f16, B>");
                valid(&wrong).expect_err("the matrices' roles matter");
            }
        }
    }
    assert!(with_matrices > 60, "{with_matrices}");
}

#[test]
fn sizes_that_are_tiny_narrow_or_prime_match_the_reference() {
    let expected_stack = random_weights(weights_tests::expected_stack_config(), 5);
    let refined = NetworkConfig { refined_stack: true, ..weights_tests::expected_stack_config() };
    let refined = random_weights(refined, 5);
    let direct = random_weights(NetworkConfig { channels: 12, ..weights_tests::config() }, 5);
    for (weights, width, height) in
        [(&expected_stack, 1, 1), (&direct, 1, 1), (&refined, 1, 33), (&direct, 37, 5), (&expected_stack, 34, 38)]
    {
        check(weights, Resolution { width, height }, 3.3, 9);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(3))]
    #[test]
    fn networks_of_any_shape_match_the_reference(
        width in 1usize..60,
        height in 1usize..14,
        channels in 1usize..40,
        depth_layers in 2usize..7,
        family in 0usize..4,
        pupil_mm in 1.0f32..5.0,
        seed in 0u32..1000,
    ) {
        let config = match family {
            0 => NetworkConfig { channels, depth_layers, ..weights_tests::expected_stack_config() },
            1 => NetworkConfig { channels, depth_layers, refined_stack: true, ..weights_tests::expected_stack_config() },
            2 => NetworkConfig { channels, ..weights_tests::config() },
            _ => NetworkConfig { channels, grid: Grid::Full, ..weights_tests::config() },
        };
        check(&random_weights(config, u64::from(seed)), Resolution { width, height }, pupil_mm, seed);
    }
}

#[test]
fn of_pupils_beyond_the_trained_ones_the_nearest_is_told_and_a_frame_is_the_same_each_time() {
    // All that the pupil changes of this family is what it is told.
    let weights = random_weights(weights_tests::config(), 2);
    let mut engine = engine(&weights, &DisplayGeometry::DEFAULT, SIZE);
    let frame = Arc::new(frame(SIZE, 4));
    let first = rendered(&mut engine, &frame, 5.0);
    for (given_mm, same) in [(1.5, false), (9.0, true), (0.2, false), (5.0, true)] {
        assert_eq!(rendered(&mut engine, &frame, given_mm) == first, same, "{given_mm} mm");
    }
    assert_eq!(rendered(&mut engine, &frame, 0.2), rendered(&mut engine, &frame, 1.0));
    let names: Vec<&str> = engine.last_timings().stages.iter().map(|stage| stage.name.as_str()).collect();
    assert_eq!((names[0], names[names.len() - 1]), ("encode", "panel levels"));
}

#[test]
fn what_is_no_number_leaves_no_trace_in_the_next_frame() {
    let direct = random_weights(NetworkConfig { channels: 12, ..weights_tests::config() }, 2);
    let on_default = |weights: &Weights| engine(weights, &DisplayGeometry::DEFAULT, SIZE);
    for mut engine in [
        on_default(&direct),
        on_default(&Weights::builtin_small()),
        of_matrices(matrix_units(), &direct, SIZE),
        of_matrices(matrix_units(), &Weights::builtin_fast(), SIZE),
    ] {
        let given = |spoil: &dyn Fn(&mut RgbdFrame)| {
            let mut frame = frame(SIZE, 4);
            spoil(&mut frame);
            Arc::new(frame)
        };
        let clean = rendered(&mut engine, &given(&|_| ()), 3.0);
        for (pixel, spoiler) in [(0, f32::NAN), (30, f32::INFINITY), (SIZE.pixels() - 1, f32::NEG_INFINITY)] {
            let spoilt = rendered(&mut engine, &given(&|frame| frame.amplitude[pixel] = spoiler), 3.0);
            assert_ne!(spoilt.0, clean.0, "pixel {pixel} is not seen");
            assert_eq!(rendered(&mut engine, &given(&|_| ()), 3.0), clean, "pixel {pixel} left a trace");
            rendered(&mut engine, &given(&|frame| frame.depth_normalised[pixel] = spoiler), 3.0);
            assert_eq!(rendered(&mut engine, &given(&|_| ()), 3.0), clean, "the depth of pixel {pixel} left a trace");
        }
    }
}

#[test]
fn wrong_sizes_and_pupils_are_refused_and_a_lost_device_is_told() {
    let weights = random_weights(weights_tests::config(), 2);
    let resolution = Resolution { width: 8, height: 6 };
    let mut engine = engine(&weights, &DisplayGeometry::DEFAULT, resolution);
    let mut samples = vec![0; 3 * resolution.pixels()];
    let pupil = PupilDiameter::from_mm(3.0);
    let wrong = Arc::new(frame(Resolution { width: 6, height: 8 }, 0));
    assert!(matches!(engine.render(&wrong, pupil, &mut samples), Err(EngineError::Resolution { .. })));
    let right = Arc::new(frame(resolution, 0));
    for pupil_mm in [f32::NAN, f32::INFINITY, 0.0, -2.0, 20.1] {
        let refused = engine.render(&right, PupilDiameter::from_mm(pupil_mm), &mut samples);
        assert!(matches!(refused, Err(EngineError::Pupil { .. })));
    }
    engine.render(&right, pupil, &mut samples).unwrap();
    engine.lose_device();
    let lost = engine.render(&right, pupil, &mut samples);
    assert!(matches!(lost, Err(EngineError::Gpu(GpuError::Failed { .. }))), "{lost:?}");

    let nothing = linear_tables(Resolution { width: 0, height: 4 });
    let refused = GpuEngine::open(&weights, &DisplayGeometry::DEFAULT, &nothing, test_adapters().into(), None);
    assert!(matches!(refused.err(), Some(EngineError::Empty { .. })));
}

#[test]
fn a_device_is_waited_for_as_long_as_was_said() {
    let (weights, resolution) = (random_weights(weights_tests::config(), 5), Resolution { width: 64, height: 64 });
    let mut engine = engine(&weights, &DisplayGeometry::DEFAULT, resolution);
    let mut samples = vec![0; 3 * resolution.pixels()];
    let (frame, pupil) = (Arc::new(frame(resolution, 0)), PupilDiameter::from_mm(3.0));
    engine.hangs_after(Duration::from_nanos(1));
    let hung = engine.render(&frame, pupil, &mut samples);
    assert!(matches!(hung, Err(EngineError::Gpu(GpuError::Hung { .. }))), "{hung:?}");
    // Dropped, it waits for its work.
}

#[test]
fn a_size_whose_lines_do_not_fit_on_the_device_is_told_before_anything_is_made() {
    let resolution = Resolution { width: 40_000, height: 2 };
    let limits = WorkgroupLimits { bytes: 16 << 10, threads: 256 };
    let (weights, bench) = (Weights::builtin_small(), DisplayGeometry::DEFAULT);
    let features = Features { format: Format::Single, method: Method::Winograd };
    let tables = linear_tables(resolution);
    let refused = super::network::NetworkPlan::new(&weights, &bench, &tables, features, limits);
    let text = refused.err().expect("no workgroup holds such a line").to_string();
    assert!(text.contains("20000") && text.contains("16384") && text.contains("--backend cpu"), "{text}");
}
