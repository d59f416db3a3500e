//! Which families of patterns scenes for training and for testing draw from.

use holod_model::scene_shard::SceneKind;

use super::random::Random;
use super::texture::{Pattern, Rgb, Wave};

/// A way to paint a surface, with ranges of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Family {
    Flat,
    Gradient,
    Marks,
    Checker,
    Stripes,
    FineStripes,
    Noise,
    Polygons,
    Dots,
    Bricks,
    Rings,
    Plaid,
    Mosaic,
    Spectral,
    Natural,
    DeadLeaves,
    Wood,
    Marble,
    Weave,
}

/// Families that both kinds may use: no texture to speak of, or print, which the world is full of. Print for testing is
/// coarser by [`TEST_COARSER`].
#[cfg(test)]
pub(super) const SHARED: [Family; 3] = [Family::Flat, Family::Gradient, Family::Marks];

/// Families of training scenes, with their weights.
pub(super) const TRAIN: [(Family, u32); 13] = [
    (Family::Flat, 1),
    (Family::Gradient, 2),
    (Family::Marks, 5),
    (Family::Checker, 2),
    (Family::Stripes, 2),
    (Family::FineStripes, 1),
    (Family::Noise, 4),
    (Family::Polygons, 2),
    (Family::Dots, 2),
    (Family::Bricks, 2),
    (Family::Rings, 1),
    (Family::Plaid, 1),
    (Family::Mosaic, 2),
];

/// Families of test scenes, with their weights: the statistics of natural pictures, and materials.
pub(super) const TEST: [(Family, u32); 9] = [
    (Family::Flat, 1),
    (Family::Gradient, 1),
    (Family::Marks, 4),
    (Family::Spectral, 2),
    (Family::Natural, 5),
    (Family::DeadLeaves, 5),
    (Family::Wood, 2),
    (Family::Marble, 2),
    (Family::Weave, 1),
];

const TEST_COARSER: f32 = 1.3;

/// A random pattern of the families of a kind.
pub(super) fn pattern(random: &mut Random, kind: SceneKind) -> Pattern {
    let families: &[(Family, u32)] = if kind == SceneKind::Test { &TEST } else { &TRAIN };
    let mut place = random.below(families.iter().map(|(_, weight)| weight).sum());
    for &(family, weight) in families {
        if place < weight {
            return make(random, family, kind);
        }
        place -= weight;
    }
    unreachable!("the place is below the sum of the weights")
}

fn make(random: &mut Random, family: Family, kind: SceneKind) -> Pattern {
    let (light, dark) = bright_and_dark(random);
    let (a, b) = if random.chance(0.5) { (light, dark) } else { (dark, light) };
    let seed = random.seed();
    match family {
        Family::Flat => Pattern::Flat(a),
        Family::Gradient => Pattern::Gradient { a, b, length: random.between(30.0, 250.0) },
        Family::Marks => marks(random, kind),
        Family::Checker => Pattern::Checker { a, b, period: random.log_between(2.0, 30.0) },
        Family::Stripes => Pattern::Stripes {
            a,
            b,
            period: random.log_between(4.0, 40.0),
            duty: random.between(0.2, 0.8),
            sine: random.chance(0.35),
        },
        Family::FineStripes => {
            let (black, white) = ([random.between(0.0, 0.04); 3], light.map(|c| c.max(0.8)));
            Pattern::Stripes { a: white, b: black, period: random.log_between(2.0, 7.0), duty: 0.5, sine: false }
        }
        Family::Noise => Pattern::Noise {
            a,
            b,
            scale: random.log_between(6.0, 80.0),
            octaves: 2 + random.below(5),
            contrast: random.between(1.0, 2.5),
            seed,
        },
        Family::Polygons => Pattern::Polygons { ground: b, a, b: light, cell: random.log_between(12.0, 50.0), seed },
        Family::Dots => {
            let radius = random.log_between(0.8, 8.0);
            let cell = radius * random.between(2.6, 7.0);
            let (ground, mark) = if random.chance(0.5) { (dark.map(|c| 0.3 * c), light) } else { (b, a) };
            Pattern::Dots { ground, mark, cell, radius, presence: random.between(0.4, 0.95), seed }
        }
        Family::Bricks => {
            let height = random.log_between(5.0, 24.0);
            let joint = (height * random.between(0.06, 0.15)).max(0.7);
            Pattern::Bricks { brick: a, mortar: b, width: height * random.between(1.0, 3.2), height, joint, seed }
        }
        Family::Rings => Pattern::Rings { a, b, period: random.log_between(3.0, 24.0) },
        Family::Plaid => Pattern::Plaid { a, b, c: colour(random, 0.8), period: random.log_between(8.0, 40.0) },
        Family::Mosaic => {
            Pattern::Mosaic { cell: random.log_between(5.0, 40.0), saturation: random.between(0.2, 0.9), seed }
        }
        Family::Spectral => spectral(random, a, b),
        Family::Natural => {
            let mean = random.log_between(0.12, 0.4);
            Pattern::Natural {
                mean,
                tint: colour(random, 1.0).map(|c| 0.6 + 0.4 * c),
                contrast: random.between(0.5, 1.0),
                chroma: random.between(0.05, 0.25),
                seed,
            }
        }
        Family::DeadLeaves => {
            let hue: Rgb = colour(random, 1.0);
            Pattern::DeadLeaves {
                hue,
                saturation: random.between(0.1, 0.7),
                largest: random.log_between(20.0, 64.0),
                seed,
            }
        }
        Family::Wood => Pattern::Wood { a, b, ring: random.between(6.0, 22.0), warp: random.between(1.0, 4.0), seed },
        Family::Marble => {
            Pattern::Marble { a, b, scale: random.between(15.0, 60.0), warp: random.between(3.0, 9.0), seed }
        }
        Family::Weave => Pattern::Weave { a, b, period: random.between(5.0, 14.0) },
    }
}

fn spectral(random: &mut Random, a: Rgb, b: Rgb) -> Pattern {
    let exponent = random.between(0.9, 1.3);
    let contrast = random.between(0.5, 1.2);
    let mut waves: Vec<Wave> = (0..32)
        .map(|_| {
            let period = random.log_between(3.0, 200.0);
            let (sin, cos) = random.between(0.0, std::f32::consts::TAU).sin_cos();
            let k = std::f32::consts::TAU / period;
            let phase = random.between(0.0, std::f32::consts::TAU);
            Wave { kx: k * cos, ky: k * sin, phase, amplitude: period.powf(exponent - 1.0 + 0.25) }
        })
        .collect();
    let power: f32 = waves.iter().map(|w| 0.5 * w.amplitude * w.amplitude).sum();
    waves.iter_mut().for_each(|w| w.amplitude *= 0.3 * contrast / power.sqrt());
    Pattern::Spectral { a, b, waves }
}

/// Fine marks on a plain ground: text, dots or strokes; dark on bright in half of them.
pub(super) fn marks(random: &mut Random, kind: SceneKind) -> Pattern {
    let light = colour(random, 0.95).map(|c| c.max(0.3));
    let darkness = random.log_between(0.01, 0.1);
    let dark = colour(random, darkness);
    let (ground, mark) = if random.chance(0.5) { (light, dark) } else { (dark, light) };
    let seed = random.seed();
    let coarse = if kind == SceneKind::Test { TEST_COARSER } else { 1.0 };
    match random.below(5) {
        0..=2 => {
            let height = coarse * random.log_between(7.0, 22.0);
            Pattern::Text { ground, mark, height, weight: (height * random.between(0.13, 0.22)).max(1.4), seed }
        }
        3 => {
            let radius = coarse * random.log_between(0.8, 4.0);
            Pattern::Dots { ground, mark, cell: radius * random.between(3.0, 7.0), radius, presence: 0.75, seed }
        }
        _ => {
            let width = coarse * random.log_between(1.2, 4.0);
            Pattern::Ticks { ground, mark, cell: width * random.between(3.0, 6.0), width, seed }
        }
    }
}

/// A random reflectance, of which a third is grey or nearly so.
pub(super) fn colour(random: &mut Random, brightness: f32) -> Rgb {
    let grey = random.chance(0.35);
    let saturation = if grey { random.between(0.0, 0.12) } else { random.between(0.2, 0.95) };
    let hue = random.between(0.0, 6.0);
    [0.0, 4.0, 2.0].map(|offset| {
        let wedge = ((hue + offset) % 6.0 - 3.0).abs() - 1.0;
        (brightness * (1.0 - saturation * (1.0 - wedge.clamp(0.0, 1.0)))).clamp(0.02, 1.0)
    })
}

pub(super) fn bright_and_dark(random: &mut Random) -> (Rgb, Rgb) {
    let brightness = random.between(0.35, 1.0);
    let light = colour(random, brightness);
    let darkness = brightness * random.log_between(0.02, 0.5);
    (light, colour(random, darkness))
}
