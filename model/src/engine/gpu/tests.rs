//! The GPU's stages on Mesa's software device, against their twins on the processor.

use std::f32::consts::TAU;

use holod_calibration::{Colour, LevelTables, PerColour, Resolution};
use num_complex::Complex32;
use proptest::prelude::*;

use super::loaded_plan::LoadedPlan;
use super::network::Shared;
use super::plan::Plan;
use super::{double_phase, levels};
use crate::gpu::{Adapters, Gpu};
use crate::optics::DoublePhase;
use crate::{ComplexHologram, PhasePattern};

pub(super) fn gpu() -> Gpu {
    Gpu::open(Adapters::Software).expect("Mesa's software device; install mesa-vulkan-drivers")
}

/// Runs all stages of a plan once.
pub(super) fn run(gpu: &Gpu, loaded: &LoadedPlan) {
    let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    loaded.encode(&mut encoder, |_| None);
    let submission = gpu.queue.submit([encoder.finish()]);
    gpu.wait(submission).expect("the work is done");
}

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

/// Phases and count of clipped samples, on the device.
fn encoded_on(gpu: &Gpu, hologram: &ComplexHologram, constant: f32) -> (Vec<f32>, u32) {
    let mut plan = Plan::default();
    let shared = Shared::new(&mut plan, hologram.resolution, hologram.resolution);
    let clipped = plan.buffer::<u32>("clipped samples", 1);
    let phases = double_phase::encode(&mut plan, &shared, constant, clipped);
    let loaded = LoadedPlan::new(gpu, &plan).unwrap();
    let pairs: Vec<[f32; 2]> = hologram.field.iter().map(|value| [value.re, value.im]).collect();
    gpu.queue.write_buffer(loaded.buffer(shared.field), 0, bytemuck::cast_slice(&pairs));
    run(gpu, &loaded);
    let (mut phases_rad, mut count) = (vec![0.0; pairs.len()], [0]);
    gpu.read(loaded.buffer(phases), &mut phases_rad).unwrap();
    gpu.read(loaded.buffer(clipped), &mut count).unwrap();
    (phases_rad, count[0])
}

#[test]
fn double_phase_is_the_processors() {
    const TOLERANCE_RAD: f32 = 2e-3;
    let gpu = gpu();
    for (width, height) in [(1, 1), (2, 1), (1, 37), (5, 3), (64, 64), (33, 35), (101, 67), (130, 97)] {
        let hologram = hologram(Resolution { width, height }, 3);
        let mut pattern = PhasePattern::flat(hologram.resolution);
        let report = DoublePhase::new(hologram.resolution, 1.25).encode(&hologram, &mut pattern);
        let (phases_rad, clipped) = encoded_on(&gpu, &hologram, 1.25);
        let share = clipped as f32 / phases_rad.len() as f32;
        assert!((share - report.clipped_share).abs() < 1e-6, "{width}x{height}: {share} of {}", report.clipped_share);
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
    let LevelTables { panel, pattern, origin: [left, top], .. } = tables;
    let mut unreachable = [0; 3];
    let samples = (0..3 * panel.pixels()).map(|index| {
        let (position, pixel) = match tables.interleaved {
            true => (index % 3, index / 3),
            false => (index / panel.pixels(), index % panel.pixels()),
        };
        let colour = tables.field_order[position];
        let (x, y) = ((pixel % panel.width).wrapping_sub(*left), (pixel / panel.width).wrapping_sub(*top));
        let inside = x < pattern.width && y < pattern.height;
        let phase_rad =
            if inside { phases_rad[colour.index() * pattern.pixels() + y * pattern.width + x] } else { 0.0 };
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

        let gpu = gpu();
        let mut plan = Plan::default();
        let phases = plan.table("phases", &phases_rad);
        let unreachable = plan.buffer::<u32>("samples out of reach", 3);
        let written = levels::encode(&mut plan, &tables, phases, unreachable);
        let loaded = LoadedPlan::new(&gpu, &plan).unwrap();
        run(&gpu, &loaded);
        let mut words = vec![0u32; (3 * panel.pixels()).div_ceil(2)];
        let mut counts = [0u32; 3];
        gpu.read(loaded.buffer(written), &mut words).unwrap();
        gpu.read(loaded.buffer(unreachable), &mut counts).unwrap();
        let found: Vec<u16> = words.iter().flat_map(|word| [*word as u16, (word >> 16) as u16]).collect();

        let (expected, expected_counts) = samples(&tables, &phases_rad);
        // A phase on the border of an entry may fall on either side of it.
        let tolerated = 1 + expected.len() / 500;
        let different = |expected: &[u16]| found.iter().zip(expected).filter(|(f, e)| f != e).count();
        prop_assert!(different(&expected) <= tolerated, "{} of {}", different(&expected), expected.len());
        for (count, expected) in counts.into_iter().zip(expected_counts) {
            prop_assert!(count.abs_diff(expected) <= 1 + expected / 20, "{counts:?} for {expected_counts:?}");
        }
        let mut spoiled = expected;
        spoiled.iter_mut().for_each(|sample| *sample ^= 1);
        prop_assert!(found.len() < 8 || different(&spoiled) > tolerated, "the comparison is blind");
    }
}
