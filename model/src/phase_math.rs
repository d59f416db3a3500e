//! Angles and exponentials without calls, as vectors or so that loops over them become vector instructions: every `if`
//! chooses between two computed values. Errors stay below 4e-7.

use std::f32::consts::{FRAC_PI_2, PI};

use crate::simd::Simd;

/// Highest power first, of the square of a tangent.
const ARC_TANGENT: [f32; 8] = [
    0.002_866_226,
    -0.016_165_737,
    0.042_909_614,
    -0.075_289_64,
    0.106_562_64,
    -0.142_089,
    0.199_935_51,
    -0.333_331_45,
];

#[inline(always)]
fn polynomial<const N: usize>(coefficients: [f32; N], x: f32) -> f32 {
    coefficients.into_iter().fold(0.0, |sum, coefficient| sum * x + coefficient)
}

/// arg(re + j·im) in [-π, π], and ±0 of 0. Where both parts are below `f32::MIN_POSITIVE` it may be π/4 off.
///
/// The polynomial is Abramowitz and Stegun's 4.4.49, within 2e-8 of the arc tangent of 0..=1.
#[inline(always)]
pub(crate) fn argument(re: f32, im: f32) -> f32 {
    let steep = im.abs() > re.abs();
    let (short, long) = if steep { (re.abs(), im.abs()) } else { (im.abs(), re.abs()) };
    let tangent = short / long.max(f32::MIN_POSITIVE);
    let z = tangent * tangent;
    let angle = tangent + tangent * z * polynomial(ARC_TANGENT, z);
    let angle = if steep { FRAC_PI_2 - angle } else { angle };
    let angle = if re < 0.0 { PI - angle } else { angle };
    angle.copysign(im)
}

/// (cos, sin) of π·`half_turns`, for |half_turns| < 2²²; beyond it they are wrong, and of what is not finite NaN.
///
/// Taylor's series up to the twelfth power within a quarter of a turn, where they are within 6e-8.
#[inline(always)]
pub(crate) fn cos_sin_pi<S: Simd>(simd: S, half_turns: S::Vector) -> [S::Vector; 2] {
    const COSINE: [f32; 6] = [1.0 / 479_001_600.0, -1.0 / 3_628_800.0, 1.0 / 40_320.0, -1.0 / 720.0, 1.0 / 24.0, -0.5];
    const SINE: [f32; 5] = [-1.0 / 39_916_800.0, 1.0 / 362_880.0, -1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0];
    // Adding 1.5·2²³ rounds to an integer.
    let to_integer = simd.splat(12_582_912.0);
    let turned = simd.sub(simd.add(half_turns, to_integer), to_integer);
    let turns = simd.sub(simd.mul_add(simd.splat(0.5), turned, to_integer), to_integer);
    // 0 for an even number of half turns, ±1 for an odd one.
    let odd = simd.neg_mul_add(simd.splat(2.0), turns, turned);
    let sign = simd.neg_mul_add(simd.mul(simd.splat(2.0), odd), odd, simd.splat(1.0));
    let x = simd.mul(simd.sub(half_turns, turned), simd.splat(PI));
    let z = simd.mul(x, x);
    let (mut cosine, mut sine) = (simd.splat(COSINE[0]), simd.splat(SINE[0]));
    for coefficient in &COSINE[1..] {
        cosine = simd.mul_add(cosine, z, simd.splat(*coefficient));
    }
    for coefficient in &SINE[1..] {
        sine = simd.mul_add(sine, z, simd.splat(*coefficient));
    }
    let signed = simd.mul(sign, x);
    [simd.mul(sign, simd.mul_add(cosine, z, simd.splat(1.0))), simd.mul_add(simd.mul(sine, z), signed, signed)]
}

/// e to the power of `x`, within 4e-7 of it; of what lies beyond -87 to 87 as at the nearer of these, and of what is no
/// number one that is none.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    // Adding 1.5·2²³ rounds to an integer, and leaves it in the low bits of the sum.
    const TO_INTEGER: f32 = 12_582_912.0;
    let within = if x > 87.0 { 87.0 } else { x };
    let within = if within < -87.0 { -87.0 } else { within };
    let shifted = within * std::f32::consts::LOG2_E + TO_INTEGER;
    let doublings = shifted - TO_INTEGER;
    // The logarithm of 2 in two parts, of which the first has few bits.
    let rest = (within - doublings * 0.693_359_4) + doublings * 2.121_944_4e-4;
    let power = polynomial([1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0], rest);
    let scale = f32::from_bits(shifted.to_bits().wrapping_add(127) << 23);
    power * scale
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::simd::{InstructionSet, MOST_LANES, Task};
    use crate::worst::worst;

    /// The largest difference of `found` from `expected` over `count` places in 0..=1.
    fn largest_difference(count: u32, found: impl Fn(f64) -> f64, expected: impl Fn(f64) -> f64) -> f64 {
        let places = (0..=count).map(|index| f64::from(index) / f64::from(count));
        let differences = places.map(|at| (found(at) - expected(at)).abs());
        worst(differences)
    }

    #[test]
    fn the_argument_is_right_all_round_and_at_any_size() {
        for size in [1e-15, 1e-3, 1.0, 1e15] {
            let place = |turn: f64| {
                let (sine, cosine) = ((turn - 0.5) * TAU * 0.999_999).sin_cos();
                ((size * cosine) as f32, (size * sine) as f32)
            };
            let found = |turn| f64::from(argument(place(turn).0, place(turn).1));
            let expected = |turn| f64::from(place(turn).1).atan2(f64::from(place(turn).0));
            let error = largest_difference(100_000, found, expected);
            assert!(error < 4e-7, "{error} rad at {size}");
        }
        assert_eq!([argument(0.0, 0.0), argument(1.0, 0.0), argument(-1.0, 0.0)], [0.0, 0.0, PI]);
        assert_eq!([argument(0.0, 2.0), argument(0.0, -2.0)], [FRAC_PI_2, -FRAC_PI_2]);
    }

    /// Cosines of half turns, then sines.
    struct CosSin<'a>(&'a [f32], [&'a mut [f32]; 2]);

    impl Task for CosSin<'_> {
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            let Self(half_turns, [cosines, sines]) = self;
            let places = half_turns.chunks_exact(S::LANES);
            let found = cosines.chunks_exact_mut(S::LANES).zip(sines.chunks_exact_mut(S::LANES));
            for (half_turns, (cosine, sine)) in places.zip(found) {
                let found = cos_sin_pi(simd, simd.read(half_turns));
                simd.write(cosine, found[0]);
                simd.write(sine, found[1]);
            }
        }
    }

    #[test]
    fn cosine_and_sine_are_right_over_many_turns_on_every_set() {
        const COUNT: usize = 1 << 17;
        for (set, (begin, turns)) in InstructionSet::available()
            .flat_map(|set| [(-1.0, 2.0), (-40.0, 80.0), (-4.19e6, 8.38e6)].map(|range| (set, range)))
        {
            let place = |index: usize| (begin + turns * index as f64 / (COUNT - 1) as f64) as f32;
            let half_turns: Vec<_> = (0..COUNT).map(place).collect();
            let (mut cosines, mut sines) = (vec![f32::NAN; COUNT], vec![f32::NAN; COUNT]);
            set.run(CosSin(&half_turns, [&mut cosines, &mut sines]));
            let expected = half_turns.iter().map(|half_turns| (f64::from(*half_turns) * TAU / 2.0).sin_cos());
            let error =
                worst(cosines.iter().zip(&sines).zip(expected).map(|((found_cosine, found_sine), (sine, cosine))| {
                    (f64::from(*found_cosine) - cosine).abs().max((f64::from(*found_sine) - sine).abs())
                }));
            assert!(error < 2e-7, "{error} over {turns} half turns on {}", set.name());
        }
        for (set, value) in
            InstructionSet::available().flat_map(|set| [f32::NAN, f32::INFINITY].map(|value| (set, value)))
        {
            let (mut cosines, mut sines) = (vec![0.0; MOST_LANES], vec![0.0; MOST_LANES]);
            set.run(CosSin(&[value; MOST_LANES], [&mut cosines, &mut sines]));
            assert!(cosines.iter().chain(&sines).all(|value| value.is_nan()), "{value} on {}", set.name());
        }
    }

    #[test]
    fn the_exponential_is_right_as_far_as_it_goes() {
        let at = |share: f64| (174.0 * share - 87.0) as f32;
        let relative = |share: f64| f64::from(exp(at(share))) / f64::from(at(share)).exp();
        let error = largest_difference(100_000, relative, |_| 1.0);
        assert!(error < 4e-7, "{error}");
        assert_eq!([exp(-1e30), exp(f32::NEG_INFINITY)], [exp(-87.0); 2]);
        assert_eq!([exp(1e30), exp(f32::INFINITY)], [exp(87.0); 2]);
        assert!(exp(f32::NAN).is_nan() && exp(0.0) == 1.0);
    }

    #[test]
    fn the_comparison_sees_a_small_error_and_what_is_no_number() {
        assert_eq!(largest_difference(10, |at| if at == 0.5 { f64::NAN } else { at }, |at| at), f64::INFINITY);
        assert!(largest_difference(10, |at| if at == 0.5 { at + 1e-6 } else { at }, |at| at) > 4e-7);
    }
}
