//! The worst of many errors: a comparison that no value passes by being no number.

/// The largest of `errors`, which are distances; infinite where one is no number.
pub fn worst<T: Into<f64>>(errors: impl IntoIterator<Item = T>) -> f64 {
    let errors = errors.into_iter().map(Into::into);
    errors.fold(0.0, |worst, error| if error.is_nan() { f64::INFINITY } else { f64::max(worst, error) })
}

#[test]
fn the_worst_is_the_largest_or_what_is_no_number() {
    assert_eq!(worst([0.5_f32, 2.0, 1.0]), 2.0);
    assert_eq!(worst([0.5, f64::NAN, 1.0]), f64::INFINITY);
    assert_eq!(worst([1.0, f64::NAN]), f64::INFINITY);
    assert_eq!(worst::<f64>([]), 0.0);
}
