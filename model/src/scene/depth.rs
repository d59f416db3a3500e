//! Depth: from a file's numbers to dioptres, without holes.

use holod_calibration::Resolution;

use super::DepthEncoding;

/// A file's depth numbers, row-major, as they are in the file.
pub(super) struct DepthNumbers {
    pub(super) values: Vec<f32>,
    /// The largest number that an integer file can hold; `None` for a floating-point file.
    pub(super) full_scale: Option<f32>,
}

impl DepthNumbers {
    /// Makes of integers that a decoder stretched from `bits` to 8 those of the file.
    pub(super) fn shrink_to(&mut self, bits: u8) {
        let full_scale = f32::from((1_u16 << bits) - 1);
        let stretch = 255.0 / full_scale;
        self.values.iter_mut().for_each(|value| *value /= stretch);
        self.full_scale = Some(full_scale);
    }
}

/// How to read depth numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DepthReading {
    pub(super) encoding: DepthEncoding,
    /// Factor to the encoding's unit; 1 where it is absent, or 1/full scale for normalised integers.
    pub(super) scale: Option<f64>,
    /// The number, before scaling, that means that there is no depth.
    pub(super) missing: Option<f64>,
}

impl DepthReading {
    /// Vergence of each number; NaN where there is none: the declared number, NaN, and lengths that are not positive.
    pub(super) fn dioptres(&self, numbers: &DepthNumbers) -> Vec<f32> {
        numbers.values.iter().copied().map(self.converter(numbers.full_scale)).collect()
    }

    /// What makes a vergence of each number; `full_scale` is the largest one that an integer can be.
    pub(super) fn converter(self, full_scale: Option<f32>) -> impl Fn(f32) -> f32 {
        let Self { encoding, missing, .. } = self;
        let default_scale = match (encoding, full_scale) {
            (DepthEncoding::NormalisedDioptres { .. }, Some(full_scale)) => 1.0 / f64::from(full_scale),
            _ => 1.0,
        };
        let scale = self.scale.unwrap_or(default_scale);
        // What a file of single floats can hold of it: of 0.1 or 1e30 that is another number.
        let missing = missing.map(|number| number as f32);
        let dioptres = move |number: f32| {
            if number.is_nan() || missing == Some(number) {
                return f64::NAN;
            }
            let value = f64::from(number) * scale;
            let reciprocal = |length: f64| if length > 0.0 { 1.0 / length } else { f64::NAN };
            match encoding {
                DepthEncoding::Metres => reciprocal(value),
                DepthEncoding::Millimetres => 1e3 * reciprocal(value),
                DepthEncoding::Dioptres if value >= 0.0 && value.is_finite() => value,
                DepthEncoding::NormalisedDioptres { far_dpt, near_dpt } if value.is_finite() => {
                    far_dpt + value * (near_dpt - far_dpt)
                }
                _ => f64::NAN,
            }
        };
        // A denormal length has an infinite vergence, which is as near as can be.
        move |number| (dioptres(number) as f32).clamp(f32::MIN, f32::MAX)
    }
}

/// Fills every NaN of `dioptres` from the nearest valid pixels to its left, right, top and bottom: with the farthest of
/// them, since holes are mostly background that a nearer edge hides from the depth camera. Pixels that see no valid one
/// are filled in a second pass from those filled in the first. Returns how many were filled, or `None` where nothing
/// is valid.
pub(super) fn fill_missing(dioptres: &mut [f32], resolution: Resolution) -> Option<usize> {
    let missing = dioptres.iter().filter(|value| value.is_nan()).count();
    if missing == dioptres.len() {
        return None;
    }
    let mut left = missing;
    while left > 0 {
        let candidates = farthest_neighbours(dioptres, resolution);
        for (value, candidate) in dioptres.iter_mut().zip(candidates) {
            if value.is_nan() {
                *value = candidate;
            }
        }
        left = dioptres.iter().filter(|value| value.is_nan()).count();
    }
    Some(missing)
}

/// For each pixel the smallest vergence among the nearest valid pixels in the four directions; NaN where there is none.
fn farthest_neighbours(dioptres: &[f32], resolution: Resolution) -> Vec<f32> {
    let Resolution { width, height } = resolution;
    let mut farthest = vec![f32::NAN; dioptres.len()];
    let mut sweep = |line: &mut dyn Iterator<Item = usize>| {
        let mut last = f32::NAN;
        for index in line {
            if dioptres[index].is_nan() {
                farthest[index] = farthest[index].min(last);
            } else {
                last = dioptres[index];
            }
        }
    };
    for y in 0..height {
        sweep(&mut (0..width).map(|x| y * width + x));
        sweep(&mut (0..width).rev().map(|x| y * width + x));
    }
    for x in 0..width {
        sweep(&mut (0..height).map(|y| y * width + x));
        sweep(&mut (0..height).rev().map(|y| y * width + x));
    }
    farthest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(
        encoding: DepthEncoding,
        scale: Option<f64>,
        missing: Option<f64>,
        full_scale: Option<f32>,
        number: f32,
    ) -> f32 {
        let numbers = DepthNumbers { values: vec![number], full_scale };
        DepthReading { encoding, scale, missing }.dioptres(&numbers)[0]
    }

    #[test]
    fn every_encoding_becomes_dioptres() {
        let normalised = DepthEncoding::NormalisedDioptres { far_dpt: 0.5, near_dpt: 2.5 };
        for (encoding, scale, full_scale, number, expected) in [
            (DepthEncoding::Metres, None, None, 0.5, 2.0),
            (DepthEncoding::Metres, None, None, f32::INFINITY, 0.0),
            (DepthEncoding::Metres, Some(1e-3), Some(65535.0), 500.0, 2.0),
            (DepthEncoding::Millimetres, None, Some(65535.0), 2000.0, 0.5),
            (DepthEncoding::Millimetres, Some(0.2), Some(65535.0), 5000.0, 1.0),
            (DepthEncoding::Dioptres, None, None, 1.25, 1.25),
            (DepthEncoding::Dioptres, None, None, 0.0, 0.0),
            (normalised, None, Some(255.0), 0.0, 0.5),
            (normalised, None, Some(255.0), 255.0, 2.5),
            (normalised, None, None, 0.5, 1.5),
            // A scale is that from the file's numbers, whatever they are.
            (normalised, Some(1.0 / 255.0), Some(255.0), 255.0, 2.5),
            (normalised, Some(1.0 / 1023.0), Some(65535.0), 1023.0, 2.5),
            (normalised, Some(1.0), Some(255.0), 1.0, 2.5),
        ] {
            let actual = read(encoding, scale, None, full_scale, number);
            assert!((actual - expected).abs() < 1e-5, "{encoding:?} {number}: {actual}");
        }
    }

    #[test]
    fn what_cannot_be_a_depth_is_missing() {
        for (encoding, number) in [
            (DepthEncoding::Metres, 0.0),
            (DepthEncoding::Metres, -1.0),
            (DepthEncoding::Metres, f32::NAN),
            (DepthEncoding::Metres, f32::NEG_INFINITY),
            (DepthEncoding::Millimetres, 0.0),
            (DepthEncoding::Dioptres, -0.1),
            (DepthEncoding::Dioptres, f32::INFINITY),
        ] {
            assert!(read(encoding, None, None, None, number).is_nan(), "{encoding:?} {number}");
        }
        assert!(read(DepthEncoding::Dioptres, None, Some(7.0), None, 7.0).is_nan());
        assert!(!read(DepthEncoding::Dioptres, None, Some(7.0), None, 7.5).is_nan());
    }

    #[test]
    fn a_missing_number_that_single_floats_cannot_hold_is_the_nearest_that_they_can() {
        for missing in [1e30, 0.1, 3.4028235e38, -9999.9] {
            let read = |number| read(DepthEncoding::Metres, None, Some(missing), None, number);
            assert!(read(missing as f32).is_nan(), "{missing}");
            assert!(!read((missing as f32).abs() * 0.999).is_nan(), "{missing}");
        }
    }

    #[test]
    fn holes_take_the_farther_side_and_are_counted() {
        let hole = f32::NAN;
        let mut row = [2.0, hole, hole, 0.5, hole];
        assert_eq!(fill_missing(&mut row, Resolution { width: 5, height: 1 }), Some(3));
        assert_eq!(row, [2.0, 0.5, 0.5, 0.5, 0.5]);

        let mut corner = [hole, hole, hole, hole, hole, hole, hole, hole, 1.5];
        assert_eq!(fill_missing(&mut corner, Resolution { width: 3, height: 3 }), Some(8));
        assert_eq!(corner, [1.5; 9]);

        assert_eq!(fill_missing(&mut [hole; 4], Resolution { width: 2, height: 2 }), None);
        assert_eq!(fill_missing(&mut [1.0; 4], Resolution { width: 2, height: 2 }), Some(0));
    }
}
