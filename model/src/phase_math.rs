//! Angles without calls: every `if` chooses between two computed values, so that loops over them become vector
//! instructions. Errors stay below 4e-7.

use std::f32::consts::{FRAC_PI_2, PI};

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

/// (cos, sin) of π·`half_turns`, for |half_turns| < 2²⁰; beyond it they are wrong, and of what is not finite NaN.
///
/// Taylor's series up to the ninth power within an eighth of a turn, where they are within 3e-8.
#[inline(always)]
pub(crate) fn cos_sin_pi(half_turns: f32) -> (f32, f32) {
    // Adding 1.5·2²³ rounds to an integer, the number of quarter turns, and leaves it in the low bits of the sum.
    const TO_INTEGER: f32 = 12_582_912.0;
    let shifted = 2.0 * half_turns + TO_INTEGER;
    let quarter = shifted.to_bits();
    let x = (half_turns - 0.5 * (shifted - TO_INTEGER)) * PI;
    let z = x * x;
    let sine = x + x * z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362_880.0))));
    let cosine = 1.0 + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40_320.0))));
    let (cosine, sine) = if quarter & 1 == 1 { (-sine, cosine) } else { (cosine, sine) };
    if quarter & 2 == 2 { (-cosine, -sine) } else { (cosine, sine) }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
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

    #[test]
    fn cosine_and_sine_are_right_over_many_turns() {
        for (begin, turns) in [(-1.0, 2.0), (-40.0, 80.0), (-1e6, 2e6)] {
            let at = |share: f64| (begin + turns * share) as f32;
            let angle = |share| f64::from(at(share)) * TAU / 2.0;
            let cosine =
                largest_difference(100_000, |share| f64::from(cos_sin_pi(at(share)).0), |share| angle(share).cos());
            let sine =
                largest_difference(100_000, |share| f64::from(cos_sin_pi(at(share)).1), |share| angle(share).sin());
            assert!(cosine < 2e-7 && sine < 2e-7, "{cosine} {sine} over {turns} half turns");
        }
    }

    #[test]
    fn the_comparison_sees_a_small_error_and_what_is_no_number() {
        assert_eq!(largest_difference(10, |at| if at == 0.5 { f64::NAN } else { at }, |at| at), f64::INFINITY);
        assert!(largest_difference(10, |at| if at == 0.5 { at + 1e-6 } else { at }, |at| at) > 4e-7);
    }
}
