//! Means over scenes, and how sure they are.

use std::f64::consts::{FRAC_2_PI, FRAC_PI_2};

use serde::Serialize;

/// A mean over scenes with its 95 % confidence interval: Student's t over the scenes, which it takes for independent
/// and the figure for normally distributed among them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// The mean over scenes, in the unit of the figure.
    pub mean: f64,
    /// Half of the interval's width; nothing for fewer than two scenes.
    pub ci95_half_width: Option<f64>,
    /// Scenes that have the figure.
    pub scenes: usize,
}

const CONFIDENCE: f64 = 0.95;

impl Estimate {
    /// The estimate from one figure of each scene; nothing for none.
    pub fn of(figures: &[f64]) -> Option<Self> {
        let scenes = figures.len();
        if scenes == 0 {
            return None;
        }
        let mean = figures.iter().sum::<f64>() / scenes as f64;
        let ci95_half_width = (scenes > 1).then(|| {
            let freedom = scenes - 1;
            let variance = figures.iter().map(|figure| (figure - mean).powi(2)).sum::<f64>() / freedom as f64;
            two_sided_t(freedom) * (variance / scenes as f64).sqrt()
        });
        Some(Self { mean, ci95_half_width, scenes })
    }
}

/// The t below whose absolute value 95 % of Student's distribution with `freedom` degrees of freedom lie.
fn two_sided_t(freedom: usize) -> f64 {
    let (mut low, mut high) = (0.0, FRAC_PI_2);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if share_within(middle, freedom) < CONFIDENCE { low = middle } else { high = middle }
    }
    low.tan() * (freedom as f64).sqrt()
}

/// Share of Student's distribution within ±√freedom·tan(angle) (Abramowitz and Stegun 26.7.3 and 26.7.4).
fn share_within(angle: f64, freedom: usize) -> f64 {
    let (sine, cosine) = angle.sin_cos();
    // Σ of cosᵏ with the products of (k−1)/k, over k = 0, 2, … or 1, 3, … below `freedom`.
    let series = |first: usize| {
        let mut term = cosine.powi(first as i32);
        let mut sum = 0.0;
        for power in (first..freedom.saturating_sub(1)).step_by(2) {
            sum += term;
            term *= cosine * cosine * (power + 1) as f64 / (power + 2) as f64;
        }
        sum
    };
    if freedom.is_multiple_of(2) { sine * series(0) } else { FRAC_2_PI * (angle + sine * series(1)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn students_t_is_that_of_the_tables() {
        for (freedom, expected) in
            [(1, 12.7062), (2, 4.30265), (3, 3.18245), (4, 2.77645), (9, 2.26216), (15, 2.13145), (99, 1.98422)]
        {
            let found = two_sided_t(freedom);
            assert!((found - expected).abs() < 1e-4, "{freedom}: {found} for {expected}");
        }
    }

    #[test]
    fn an_interval_is_that_of_a_worked_example() {
        // Mean 29, standard deviation 1, n = 3: half width 4.30265/√3.
        let estimate = Estimate::of(&[28.0, 29.0, 30.0]).unwrap();
        assert_eq!((estimate.mean, estimate.scenes), (29.0, 3));
        assert!((estimate.ci95_half_width.unwrap() - 2.48414).abs() < 1e-4);
        assert_eq!(Estimate::of(&[28.0]).unwrap().ci95_half_width, None);
        assert_eq!(Estimate::of(&[]), None);
    }
}
