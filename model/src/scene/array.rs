//! Pictures that a caller holds as arrays: what files hold, without the files.

use holod_calibration::{Colour, DisplayGeometry, Resolution};

use super::depth::{DepthReading, fill_missing};
use super::{DepthEncoding, FrameReport, ROUNDING, RgbdFrame, clamped, normalised};
use crate::picture::srgb_to_linear;

/// Colours of a picture, [height, width, 3], red first.
#[derive(Clone, Copy, Debug)]
pub enum ArrayColours<'a> {
    /// sRGB of 8 bits.
    Srgb8(&'a [u8]),
    /// sRGB, from 0 to 1.
    SrgbF32(&'a [f32]),
    /// Linear light, from 0 to 1.
    LinearF32(&'a [f32]),
}

/// Depths of a picture, [height, width].
#[derive(Clone, Copy, Debug)]
pub enum ArrayDepths<'a> {
    /// Metres; what is not above 0 is no depth.
    MetresF32(&'a [f32]),
    /// Millimetres; what is not above 0 is no depth.
    MillimetresF32(&'a [f32]),
    /// Millimetres; 0 is no depth.
    MillimetresU16(&'a [u16]),
    /// Dioptres of 0 or more.
    DioptresF32(&'a [f32]),
    /// 0 at the far end of the display's depth range, 1 at its near end, uniform in dioptres; others are clamped.
    NormalisedDioptresF32(&'a [f32]),
}

/// A picture with depth.
#[derive(Clone, Copy, Debug)]
pub struct ArrayPicture<'a> {
    /// Columns and rows, which both arrays have.
    pub resolution: Resolution,
    /// The colour of each pixel.
    pub colours: ArrayColours<'a>,
    /// The depth of each pixel.
    pub depths: ArrayDepths<'a>,
    /// Whether pixels without a depth are filled from their surroundings; else they are an error.
    pub fills_missing: bool,
}

/// Why a picture cannot be shown.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum ArrayError {
    /// An array has another number of values than the picture has.
    #[error("{what}: found {found} values, expected {expected}")]
    Length { what: &'static str, found: usize, expected: usize },
    /// Colour values are none.
    #[error(
        "colours: {count} values are outside 0..=1 or not finite, the first {found} ({colour} in row {row}, column {column}); \
         expected 0 to 1: scale the picture so that white is 1, or clip what is brighter"
    )]
    Colours {
        count: usize,
        /// The first of them.
        found: f32,
        colour: Colour,
        /// Its row, from 0.
        row: usize,
        /// Its column, from 0.
        column: usize,
    },
    /// Pixels have no depth.
    #[error(
        "depths: {count} of {pixels} pixels have none, the first {found} in row {row}, column {column}; expected {expected}: \
         correct them or the unit, or have them filled from their surroundings"
    )]
    Missing {
        count: usize,
        /// Pixels of the whole picture.
        pixels: usize,
        /// The first of them.
        found: f32,
        /// Its row, from 0.
        row: usize,
        /// Its column, from 0.
        column: usize,
        /// What a depth is in this unit.
        expected: &'static str,
    },
    /// No pixel has a depth.
    #[error("depths: found no pixel with a valid one; expected {expected}: look at the unit")]
    NoDepth {
        /// What a depth is in this unit.
        expected: &'static str,
    },
}

impl ArrayPicture<'_> {
    /// The picture as the network reads it, for the depth range of `geometry`.
    ///
    /// # Errors
    /// [`ArrayError`] for arrays of a wrong length and values that are no colours or depths.
    pub fn frame(&self, geometry: &DisplayGeometry) -> Result<(RgbdFrame, FrameReport), ArrayError> {
        let resolution = self.resolution;
        let mut report =
            FrameReport { source: Some(resolution), depth_px: resolution.pixels(), ..FrameReport::default() };
        let amplitude = self.colours.amplitude(resolution)?;
        let depth_normalised = self.depths.normalised(resolution, geometry, self.fills_missing, &mut report)?;
        Ok((RgbdFrame { resolution, amplitude, depth_normalised }, report))
    }
}

impl ArrayColours<'_> {
    /// Square root of linear light, [3, height, width].
    fn amplitude(&self, resolution: Resolution) -> Result<Vec<f32>, ArrayError> {
        match *self {
            Self::Srgb8(values) => {
                let table: [f32; 256] = std::array::from_fn(|value| srgb_to_linear(value as f32 / 255.0).sqrt());
                planes(values, resolution, |value| table[usize::from(value)])
            }
            Self::SrgbF32(values) => {
                check_colours(values, resolution)?;
                planes(values, resolution, |value| srgb_to_linear(value.clamp(0.0, 1.0)).sqrt())
            }
            Self::LinearF32(values) => {
                check_colours(values, resolution)?;
                planes(values, resolution, |value| value.clamp(0.0, 1.0).sqrt())
            }
        }
    }
}

fn check_length(what: &'static str, found: usize, expected: usize) -> Result<(), ArrayError> {
    if found == expected { Ok(()) } else { Err(ArrayError::Length { what, found, expected }) }
}

/// Refuses what is no share of white, but for rounding.
fn check_colours(values: &[f32], resolution: Resolution) -> Result<(), ArrayError> {
    let is_none = |value: &f32| !(-ROUNDING..=1.0 + ROUNDING).contains(value);
    let Some(first) = values.iter().position(is_none) else { return Ok(()) };
    let pixel = first / 3;
    Err(ArrayError::Colours {
        count: values.iter().filter(|value| is_none(value)).count(),
        found: values[first],
        colour: Colour::ALL[first % 3],
        row: pixel / resolution.width,
        column: pixel % resolution.width,
    })
}

/// From [height, width, 3] to [3, height, width].
fn planes<T: Copy>(values: &[T], resolution: Resolution, of: impl Fn(T) -> f32) -> Result<Vec<f32>, ArrayError> {
    let pixels = resolution.pixels();
    check_length("colours", values.len(), 3 * pixels)?;
    let mut planes = vec![0.0; 3 * pixels];
    let (red, others) = planes.split_at_mut(pixels);
    let (green, blue) = others.split_at_mut(pixels);
    for (((red, green), blue), rgb) in red.iter_mut().zip(green).zip(blue).zip(values.as_chunks::<3>().0) {
        [*red, *green, *blue] = rgb.map(&of);
    }
    Ok(planes)
}

impl ArrayDepths<'_> {
    const fn expected(&self) -> &'static str {
        match self {
            Self::MetresF32(_) => "metres above 0",
            Self::MillimetresF32(_) | Self::MillimetresU16(_) => "millimetres above 0",
            Self::DioptresF32(_) => "dioptres of 0 or more",
            Self::NormalisedDioptresF32(_) => {
                "finite numbers, 0 the far end of the display's depth range and 1 its near end"
            }
        }
    }

    fn normalised(
        &self,
        resolution: Resolution,
        geometry: &DisplayGeometry,
        fills_missing: bool,
        report: &mut FrameReport,
    ) -> Result<Vec<f32>, ArrayError> {
        let dioptres = |encoding| DepthReading { encoding, scale: None, missing: None }.converter(None);
        let mut depths: Vec<f32> = match *self {
            Self::MetresF32(numbers) => numbers.iter().copied().map(dioptres(DepthEncoding::Metres)).collect(),
            Self::MillimetresF32(numbers) => {
                numbers.iter().copied().map(dioptres(DepthEncoding::Millimetres)).collect()
            }
            Self::MillimetresU16(numbers) => {
                numbers.iter().map(|&mm| f32::from(mm)).map(dioptres(DepthEncoding::Millimetres)).collect()
            }
            Self::DioptresF32(numbers) => numbers.iter().copied().map(dioptres(DepthEncoding::Dioptres)).collect(),
            Self::NormalisedDioptresF32(numbers) => {
                numbers.iter().map(|&number| if number.is_finite() { number } else { f32::NAN }).collect()
            }
        };
        check_length("depths", depths.len(), resolution.pixels())?;
        let missing = if fills_missing { None } else { depths.iter().position(|depth| depth.is_nan()) };
        if let Some(first) = missing {
            return Err(ArrayError::Missing {
                count: depths.iter().filter(|depth| depth.is_nan()).count(),
                pixels: resolution.pixels(),
                found: self.number(first),
                row: first / resolution.width,
                column: first % resolution.width,
                expected: self.expected(),
            });
        }
        report.depth_missing_px =
            fill_missing(&mut depths, resolution).ok_or(ArrayError::NoDepth { expected: self.expected() })?;
        Ok(match self {
            Self::NormalisedDioptresF32(_) => clamped(depths.into_iter(), report),
            _ => normalised(&depths, geometry, report),
        })
    }

    /// The number of pixel `index`, as it was given.
    fn number(&self, index: usize) -> f32 {
        match *self {
            Self::MillimetresU16(numbers) => f32::from(numbers[index]),
            Self::MetresF32(numbers)
            | Self::MillimetresF32(numbers)
            | Self::DioptresF32(numbers)
            | Self::NormalisedDioptresF32(numbers) => numbers[index],
        }
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::Dioptres;

    use super::super::{Fit, Scene};
    use super::*;

    const SIZE: Resolution = Resolution { width: 7, height: 5 };
    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;

    fn srgb8() -> Vec<u8> {
        (0..105_u32).map(|index| (index * 37 % 256) as u8).collect()
    }

    fn depth_mm() -> Vec<u16> {
        (0..35_u16).map(|index| 200 + 211 * index).collect()
    }

    fn frame(colours: ArrayColours<'_>, depths: ArrayDepths<'_>) -> Result<(RgbdFrame, FrameReport), ArrayError> {
        ArrayPicture { resolution: SIZE, colours, depths, fills_missing: false }.frame(&BENCH)
    }

    fn of_depths(depths: ArrayDepths<'_>) -> RgbdFrame {
        frame(ArrayColours::Srgb8(&srgb8()), depths).unwrap().0
    }

    #[test]
    fn arrays_are_read_as_files_are() {
        let folder = tempfile::tempdir().unwrap();
        let (colour, depth) = (folder.path().join("colour.png"), folder.path().join("depth.png"));
        image::RgbImage::from_raw(7, 5, srgb8()).unwrap().save(&colour).unwrap();
        image::ImageBuffer::<image::Luma<u16>, _>::from_raw(7, 5, depth_mm()).unwrap().save(&depth).unwrap();
        let spec = format!("{},{}", colour.display(), depth.display());
        let scene = Scene::open(&spec, Some(DepthEncoding::Millimetres)).unwrap();
        let expected = scene.load(0, &BENCH, None, Fit::Native).unwrap();
        let found = frame(ArrayColours::Srgb8(&srgb8()), ArrayDepths::MillimetresU16(&depth_mm())).unwrap();
        assert_eq!(found, expected);
        assert!(found.1.depth_clamped_near_px > 0, "nothing was clamped: the counts are not compared");

        let picture = scene.picture(0, &BENCH, None, Fit::Native).unwrap();
        let linear: Vec<f32> = (0..105).map(|value| picture.linear[value % 3 * SIZE.pixels() + value / 3]).collect();
        let (again, _) = frame(ArrayColours::LinearF32(&linear), ArrayDepths::DioptresF32(&picture.depth_dpt)).unwrap();
        assert_eq!(again, expected.0);

        let mut wrong = depth_mm();
        wrong[34] += 1;
        assert_ne!(of_depths(ArrayDepths::MillimetresU16(&wrong)), expected.0);
    }

    #[test]
    fn a_fitted_picture_is_the_frame_that_is_fitted() {
        let folder = tempfile::tempdir().unwrap();
        let (colour, depth) = (folder.path().join("colour.png"), folder.path().join("depth.png"));
        image::RgbImage::from_raw(7, 5, srgb8()).unwrap().save(&colour).unwrap();
        image::ImageBuffer::<image::Luma<u16>, _>::from_raw(7, 5, depth_mm()).unwrap().save(&depth).unwrap();
        let scene = Scene::open(&format!("{},{}", colour.display(), depth.display()), Some(DepthEncoding::Millimetres))
            .unwrap();
        let wanted = Resolution { width: 12, height: 12 };
        for far_dpt in [0.0, 0.1, 1.0 / 3.0, 0.7] {
            let bench = DisplayGeometry { depth_far: Dioptres(far_dpt), ..BENCH };
            let (expected, told) = scene.load(0, &bench, Some(wanted), Fit::Contain).unwrap();
            let picture = scene.picture(0, &bench, Some(wanted), Fit::Contain).unwrap();
            assert_eq!(picture.resolution, wanted);
            let linear: Vec<f32> =
                (0..3 * wanted.pixels()).map(|value| picture.linear[value % 3 * wanted.pixels() + value / 3]).collect();
            let arrays = ArrayPicture {
                resolution: wanted,
                colours: ArrayColours::LinearF32(&linear),
                depths: ArrayDepths::DioptresF32(&picture.depth_dpt),
                fills_missing: false,
            };
            let (frame, report) = arrays.frame(&bench).unwrap();
            assert_eq!(frame, expected, "{far_dpt} dpt");
            // What is padded was not clamped. Of the picture's pixels there are more here, since it was enlarged.
            assert_eq!(report.depth_clamped_far_px > 0, told.depth_clamped_far_px > 0, "{far_dpt} dpt");
        }
    }

    #[test]
    fn every_unit_says_the_same_depth() {
        let mm: Vec<f32> = depth_mm().into_iter().map(f32::from).collect();
        let metres: Vec<f32> = mm.iter().map(|mm| mm / 1e3).collect();
        let dioptres: Vec<f32> = mm.iter().map(|mm| 1e3 / mm).collect();
        let expected = of_depths(ArrayDepths::MillimetresU16(&depth_mm())).depth_normalised;
        let normalised = expected.clone();
        for depths in [
            ArrayDepths::MetresF32(&metres),
            ArrayDepths::MillimetresF32(&mm),
            ArrayDepths::DioptresF32(&dioptres),
            ArrayDepths::NormalisedDioptresF32(&normalised),
        ] {
            for (found, expected) in of_depths(depths).depth_normalised.into_iter().zip(&expected) {
                assert!((found - expected).abs() < 1e-6, "{found} for {expected} of {depths:?}");
            }
        }
        let linear: Vec<f32> = srgb8().iter().map(|&value| srgb_to_linear(f32::from(value) / 255.0)).collect();
        let srgb: Vec<f32> = srgb8().iter().map(|&value| f32::from(value) / 255.0).collect();
        let depths = || ArrayDepths::MillimetresU16(&[500; 35]);
        let expected = frame(ArrayColours::Srgb8(&srgb8()), depths()).unwrap();
        assert_eq!(frame(ArrayColours::LinearF32(&linear), depths()).unwrap(), expected);
        assert_eq!(frame(ArrayColours::SrgbF32(&srgb), depths()).unwrap(), expected);
        assert_ne!(frame(ArrayColours::LinearF32(&srgb), depths()).unwrap(), expected);
    }

    #[test]
    fn what_is_no_colour_or_depth_is_told_with_its_place() {
        let depths = ArrayDepths::MetresF32(&[1.0; 35]);
        for wrong in [f32::NAN, f32::INFINITY, -0.01, 1.01, 255.0] {
            let mut values = [0.5; 105];
            values[3 * 9 + 1] = wrong;
            values[104] = wrong;
            for colours in [ArrayColours::LinearF32(&values), ArrayColours::SrgbF32(&values)] {
                let Err(ArrayError::Colours { count: 2, found, colour: Colour::Green, row: 1, column: 2 }) =
                    frame(colours, depths)
                else {
                    panic!("{wrong}");
                };
                assert_eq!(found.to_bits(), wrong.to_bits());
            }
        }
        let colours = [0.5; 105];
        let colours = ArrayColours::LinearF32(&colours);
        let mut numbers = [0.5; 35];
        numbers[8] = -1.0;
        for depths in [
            ArrayDepths::MetresF32(&numbers),
            ArrayDepths::MillimetresF32(&numbers),
            ArrayDepths::DioptresF32(&numbers),
        ] {
            let refused = frame(colours, depths).unwrap_err();
            assert!(matches!(refused, ArrayError::Missing { count: 1, row: 1, column: 1, .. }), "{refused}");
            let picture = ArrayPicture { resolution: SIZE, colours, depths, fills_missing: true };
            let (filled, report) = picture.frame(&BENCH).unwrap();
            assert_eq!((report.depth_missing_px, filled.depth_normalised[8]), (1, filled.depth_normalised[7]));
        }
        let none = ArrayPicture {
            resolution: SIZE,
            colours,
            depths: ArrayDepths::MillimetresU16(&[0; 35]),
            fills_missing: true,
        };
        assert!(matches!(none.frame(&BENCH), Err(ArrayError::NoDepth { .. })));
        let short = frame(colours, ArrayDepths::MetresF32(&[1.0; 34])).unwrap_err();
        assert_eq!(short, ArrayError::Length { what: "depths", found: 34, expected: 35 });
        assert!(frame(ArrayColours::Srgb8(&[0; 104]), depths).is_err());
    }

    #[test]
    fn normalised_depths_outside_the_range_are_clamped_and_counted_as_those_of_files_are() {
        let mut numbers: Vec<f32> = (0..35_u16).map(|index| f32::from(index % 7) / 6.0).collect();
        numbers[8..12].copy_from_slice(&[1.2, 1e30, -0.1, f32::MIN]);
        let frame_of = |numbers: &[f32], fills_missing| {
            let (colours, depths) = (ArrayColours::Srgb8(&[0; 105]), ArrayDepths::NormalisedDioptresF32(numbers));
            ArrayPicture { resolution: SIZE, colours, depths, fills_missing }.frame(&BENCH)
        };
        let from_file = |numbers: &[f32]| {
            let encoding =
                DepthEncoding::NormalisedDioptres { far_dpt: BENCH.depth_far.0, near_dpt: BENCH.depth_near.0 };
            let reading = DepthReading { encoding, scale: None, missing: None };
            let mut dioptres: Vec<f32> = numbers.iter().copied().map(reading.converter(None)).collect();
            let depth_missing_px = fill_missing(&mut dioptres, SIZE).unwrap();
            let mut report = FrameReport { depth_missing_px, ..FrameReport::default() };
            (normalised(&dioptres, &BENCH, &mut report), report)
        };
        let same = |numbers: &[f32], fills_missing| {
            let (frame, report) = frame_of(numbers, fills_missing).unwrap();
            let (depths, expected) = from_file(numbers);
            for (index, (found, expected)) in frame.depth_normalised.iter().zip(depths).enumerate() {
                assert!((found - expected).abs() < 1e-6, "{found} for {expected} of {}", numbers[index]);
            }
            let counts = |report: &FrameReport| {
                [report.depth_missing_px, report.depth_clamped_far_px, report.depth_clamped_near_px]
            };
            assert_eq!(counts(&report), counts(&expected));
            (frame.depth_normalised, counts(&report))
        };
        let (depths, counts) = same(&numbers, false);
        assert_eq!((&depths[8..12], counts), (&[1.0, 1.0, 0.0, 0.0][..], [0, 2, 2]));
        for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            numbers[17] = wrong;
            let refused = frame_of(&numbers, false).unwrap_err();
            assert!(matches!(refused, ArrayError::Missing { count: 1, row: 2, column: 3, .. }), "{wrong}: {refused}");
            assert!(refused.to_string().contains("expected finite numbers"), "{refused}");
            let (depths, counts) = same(&numbers, true);
            // Above it lies what is beyond the far end.
            assert_eq!((depths[17], counts), (0.0, [1, 3, 2]), "{wrong}");
        }
    }
}
