//! Quantiles of measured values.

/// Values in order, at least one.
#[derive(Clone, Debug)]
pub struct Sorted(Vec<f64>);

impl Sorted {
    /// Puts values in order, those that are no numbers last; none of no values.
    pub fn new(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.into_iter().collect();
        values.sort_by(f64::total_cmp);
        (!values.is_empty()).then_some(Self(values))
    }

    /// What this share of the values lies below, 0 being the smallest value and 1 the largest; between two values by
    /// linear interpolation (Hyndman and Fan 1996, type 7).
    pub fn quantile(&self, share: f64) -> f64 {
        let Self(values) = self;
        let place = share.clamp(0.0, 1.0) * (values.len() - 1) as f64;
        let (below, above) = (values[place.floor() as usize], values[place.ceil() as usize]);
        // Infinities have no difference.
        if below == above { below } else { below + (above - below) * place.fract() }
    }

    /// Half of the values are smaller.
    pub fn median(&self) -> f64 {
        self.quantile(0.5)
    }

    /// The largest value; NaN where one of them is.
    pub fn max(&self) -> f64 {
        self.quantile(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_known_series() {
        let of = |values: &[f64]| {
            let sorted = Sorted::new(values.iter().copied()).unwrap();
            [0.0, 0.25, 0.5, 0.75, 1.0].map(|share| sorted.quantile(share))
        };
        assert_eq!(of(&[7.0]), [7.0; 5]);
        assert_eq!(of(&[5.0, 1.0, 4.0, 2.0, 3.0]), [1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(of(&[4.0, 1.0, 3.0, 2.0]), [1.0, 1.75, 2.5, 3.25, 4.0]);
        assert!(Sorted::new([]).is_none());
        assert_eq!(of(&[f64::INFINITY; 2]), [f64::INFINITY; 5]);
        let sorted = Sorted::new([f64::NAN, 1.0]).unwrap();
        assert!(sorted.quantile(0.0) == 1.0 && sorted.max().is_nan() && sorted.quantile(2.0).is_nan());
    }
}
