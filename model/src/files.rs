//! Holograms and pictures on disk. Everything is written beside its place and renamed, so nothing is ever half written.

use std::collections::BTreeMap;
use std::f32::consts::TAU;
use std::fmt;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use holod_calibration::{
    Colour, Dioptres, DisplayGeometry, Metres, PerColour, PupilDiameter, Resolution, write_atomically,
};
use image::{ImageBuffer, ImageFormat, Luma, PixelWithColorType, Rgb};
use num_complex::Complex32;
use safetensors::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};

use crate::picture::srgb8;
use crate::safetensors_file::{self, Tensor};
use crate::{ComplexHologram, LinearImage, PhasePattern};

/// The value of the metadata key `format` of a hologram file.
const FORMAT: &str = "holod-hologram-1";
/// Larger hologram files are refused: this is more than an 8K frame takes.
const LARGEST_FILE_BYTES: u64 = 1 << 30;

/// A hologram with what one must know to look at it.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredHologram {
    /// The field at the SLM plane.
    pub hologram: ComplexHologram,
    /// The pupil that it was made for.
    pub pupil: PupilDiameter,
    /// The optics that it was made for.
    pub optics: BenchOptics,
    /// Amplitude that double phase maps to 1.
    pub amplitude_constant: f32,
}

/// The optics of a bench, as files state them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BenchOptics {
    /// Red, green, blue.
    pub wavelengths_nm: [f64; 3],
    /// Distance between the centres of neighbouring pixels.
    pub pixel_pitch_um: f64,
    /// Focal length of the eyepiece.
    pub eyepiece_focal_length_mm: f64,
    /// Vergence of normalised depth 0.
    pub depth_far_dpt: f64,
    /// Vergence of normalised depth 1.
    pub depth_near_dpt: f64,
}

impl BenchOptics {
    /// The same optics with a panel of `resolution`.
    pub fn geometry(&self, resolution: Resolution) -> DisplayGeometry {
        DisplayGeometry {
            resolution,
            pixel_pitch: Metres(self.pixel_pitch_um / 1e6),
            wavelengths: PerColour(self.wavelengths_nm.map(|wavelength_nm| Metres(wavelength_nm / 1e9))),
            eyepiece_focal_length: Metres(self.eyepiece_focal_length_mm / 1e3),
            depth_far: Dioptres(self.depth_far_dpt),
            depth_near: Dioptres(self.depth_near_dpt),
        }
    }

    /// The optics of `geometry` in this type's units.
    pub fn of(geometry: &DisplayGeometry) -> Self {
        Self {
            wavelengths_nm: geometry.wavelengths.0.map(|wavelength| as_written(wavelength, 1e9)),
            pixel_pitch_um: as_written(geometry.pixel_pitch, 1e6),
            eyepiece_focal_length_mm: as_written(geometry.eyepiece_focal_length, 1e3),
            depth_far_dpt: geometry.depth_far.0,
            depth_near_dpt: geometry.depth_near.0,
        }
    }

    /// Whether an eye sees the same of a hologram through both: all but the depth range, with which holograms are made
    /// but not looked at, is equal to a millionth.
    pub fn shows_alike(&self, other: &Self) -> bool {
        let figures = |optics: &Self| {
            let [red_nm, green_nm, blue_nm] = optics.wavelengths_nm;
            [red_nm, green_nm, blue_nm, optics.pixel_pitch_um, optics.eyepiece_focal_length_mm]
        };
        figures(self).into_iter().zip(figures(other)).all(|(a, b)| (a - b).abs() <= 1e-6 * b.abs())
    }
}

impl fmt::Display for BenchOptics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [red, green, blue] = self.wavelengths_nm;
        let Self { pixel_pitch_um, eyepiece_focal_length_mm, .. } = self;
        write!(f, "{pixel_pitch_um} µm, f = {eyepiece_focal_length_mm} mm, {red}, {green} and {blue} nm")
    }
}

/// The figure that a rig file gave for a length, in a unit of which there are `per_m` to the metre: divided by that it
/// is the same length, to the last bit.
fn as_written(Metres(length_m): Metres, per_m: f64) -> f64 {
    let figure = length_m * per_m;
    let short = (figure * 1e9).round() / 1e9;
    if short / per_m == length_m { short } else { figure }
}

/// A file that cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum FileError {
    /// Reading or writing failed.
    #[error("{path}: {source}", path = path.display())]
    Io {
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The content is not what it should be.
    #[error("{path}: {found}; expected {expected}", path = path.display())]
    Content { path: PathBuf, found: String, expected: String },
}

impl StoredHologram {
    /// Writes a safetensors file: `field` [3, height, width, 2] (real, imaginary) in F32, and in the metadata format,
    /// pupil_mm, amplitude_constant and optics (JSON).
    pub fn save(&self, path: &Path) -> Result<(), FileError> {
        let Resolution { width, height } = self.hologram.resolution;
        let bytes: Vec<u8> =
            self.hologram.field.iter().flat_map(|value| [value.re, value.im]).flat_map(f32::to_le_bytes).collect();
        let optics = serde_json::to_string(&self.optics).map_err(|error| FileError::Content {
            path: path.to_owned(),
            found: error.to_string(),
            expected: "optics that JSON can hold".into(),
        })?;
        let metadata = BTreeMap::from([
            ("format".to_owned(), FORMAT.to_owned()),
            ("pupil_mm".to_owned(), self.pupil.mm().to_string()),
            ("amplitude_constant".to_owned(), self.amplitude_constant.to_string()),
            ("optics".to_owned(), optics),
        ]);
        let field =
            Tensor { name: "field".to_owned(), dtype: Dtype::F32, shape: vec![3, height, width, 2], bytes: &bytes };
        write_atomically(path, |out| safetensors_file::write(out, vec![field], &metadata))
            .map_err(|source| FileError::Io { path: path.to_owned(), source })
    }

    /// Reads what [`Self::save`] wrote.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        let io = |source| FileError::Io { path: path.to_owned(), source };
        let content = |found: String, expected: &str| FileError::Content {
            path: path.to_owned(),
            found,
            expected: format!("{expected}; write the hologram again with `holod render`"),
        };
        let metadata = std::fs::metadata(path).map_err(io)?;
        if !metadata.is_file() || metadata.len() > LARGEST_FILE_BYTES {
            let found = if metadata.is_file() { format!("{} bytes", metadata.len()) } else { "no regular file".into() };
            return Err(content(found, "a hologram file of at most 1 GiB"));
        }
        let bytes = std::fs::read(path).map_err(io)?;
        let damaged = |error: safetensors::SafeTensorError| content(error.to_string(), "a safetensors file");
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(damaged)?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(damaged)?;

        let entries = header.metadata().clone().unwrap_or_default();
        let entry = |key: &str| {
            entries
                .get(key)
                .map(String::as_str)
                .ok_or_else(|| content(format!("no metadata `{key}`"), "a hologram file"))
        };
        let positive = |key: &str| -> Result<f32, FileError> {
            let text = entry(key)?;
            let number = text.parse().ok().filter(|number: &f32| *number > 0.0 && number.is_finite());
            number.ok_or_else(|| content(format!("`{key}` = {text}"), "a positive number"))
        };
        if entry("format")? != FORMAT {
            return Err(content(format!("format \"{}\"", entry("format")?), &format!("\"{FORMAT}\"")));
        }
        let optics = serde_json::from_str(entry("optics")?).map_err(|error| {
            content(format!("`optics` that cannot be used ({error})"), "the hologram's optics as JSON")
        })?;

        let view = tensors.tensor("field").map_err(|_| content("no tensor `field`".into(), "the field"))?;
        let &[3, height, width, 2] = view.shape() else {
            return Err(content(format!("`field` of shape {:?}", view.shape()), "[3, height, width, 2]"));
        };
        if view.dtype() != Dtype::F32 || width == 0 || height == 0 {
            return Err(content(
                format!("`field` of {:?}, {width}x{height}", view.dtype()),
                "F32 and at least one pixel",
            ));
        }
        let number = |bytes: &[u8; 8]| {
            let [a, b, c, d, e, f, g, h] = *bytes;
            Complex32::new(f32::from_le_bytes([a, b, c, d]), f32::from_le_bytes([e, f, g, h]))
        };
        let field: Vec<_> = view.data().as_chunks().0.iter().map(number).collect();
        if let Some(index) = field.iter().position(|value| !value.is_finite()) {
            return Err(content(format!("{} at index {index} of `field`", field[index]), "finite values"));
        }
        Ok(Self {
            hologram: ComplexHologram { resolution: Resolution { width, height }, field },
            pupil: PupilDiameter::from_mm(positive("pupil_mm")?),
            optics,
            amplitude_constant: positive("amplitude_constant")?,
        })
    }
}

/// Writes a picture as an 8-bit sRGB PNG. What is brighter than white is white.
pub fn save_picture(image: &LinearImage, path: &Path) -> Result<(), FileError> {
    let planes = Colour::ALL.map(|colour| image.plane(colour));
    let width = image.resolution.width;
    save_png(path, image.resolution, |x, y| Rgb(planes.map(|plane| srgb8(plane[y * width + x]))))
}

/// What 2π would be in a PNG that [`save_phase`] writes.
pub const PHASE_LEVELS: u32 = 65536;

/// Writes one colour's phase as a 16-bit grey PNG: level·2π/65536, rounded. It is the hologram's phase, neither a
/// panel's levels nor turned as a panel lies.
pub fn save_phase(pattern: &PhasePattern, colour: Colour, path: &Path) -> Result<(), FileError> {
    let (plane, width) = (pattern.plane(colour), pattern.resolution.width);
    save_png(path, pattern.resolution, |x, y| {
        Luma([((plane[y * width + x] / TAU * PHASE_LEVELS as f32).round() as u32 % PHASE_LEVELS) as u16])
    })
}

fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let io = |source| FileError::Io { path: path.to_owned(), source };
    write_atomically(path, |out| out.write_all(bytes)).map_err(io)
}

fn save_png<P>(path: &Path, size: Resolution, pixel: impl Fn(usize, usize) -> P) -> Result<(), FileError>
where
    P: PixelWithColorType,
    [P::Subpixel]: image::EncodableLayout,
{
    let content = |found: String| FileError::Content {
        path: path.to_owned(),
        found,
        expected: "a picture that PNG can hold".into(),
    };
    let too_large = |_| content(format!("a picture of {size}"));
    let (width, height) =
        (u32::try_from(size.width).map_err(too_large)?, u32::try_from(size.height).map_err(too_large)?);
    let picture = ImageBuffer::from_fn(width, height, |x, y| pixel(x as usize, y as usize));
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png).map_err(|error| content(error.to_string()))?;
    write_bytes(path, bytes.get_ref())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Resolution = Resolution { width: 5, height: 3 };

    fn hologram() -> StoredHologram {
        let field = (0..45).map(|index| Complex32::from_polar(index as f32 / 45.0, index as f32)).collect();
        StoredHologram {
            hologram: ComplexHologram { resolution: SIZE, field },
            pupil: PupilDiameter::from_mm(3.25),
            optics: BenchOptics::of(&DisplayGeometry::DEFAULT),
            amplitude_constant: 1.4,
        }
    }

    #[test]
    fn a_hologram_round_trips_and_leaves_nothing_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        hologram().save(&path).unwrap();
        assert_eq!(StoredHologram::load(&path).unwrap(), hologram());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn optics_come_back_from_a_file_to_the_last_bit() {
        for step in 0..5000_u32 {
            let [pitch_um, length_mm] = [100 + step, 500 + 10 * step].map(|hundredths| f64::from(hundredths) / 100.0);
            let wavelength_nm = f64::from(38_000 + 8 * step) / 100.0;
            let geometry = DisplayGeometry {
                pixel_pitch: Metres(pitch_um / 1e6),
                wavelengths: PerColour([Metres(wavelength_nm / 1e9); 3]),
                eyepiece_focal_length: Metres(length_mm / 1e3),
                ..DisplayGeometry::DEFAULT
            };
            let text = serde_json::to_string(&BenchOptics::of(&geometry)).unwrap();
            let read: BenchOptics = serde_json::from_str(&text).unwrap();
            assert_eq!(read.geometry(geometry.resolution), geometry, "{text}");
            assert_eq!((read.pixel_pitch_um, read.eyepiece_focal_length_mm), (pitch_um, length_mm));
        }
    }

    #[test]
    fn the_same_hologram_is_the_same_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        let saved = |stored: &StoredHologram| {
            stored.save(&path).unwrap();
            std::fs::read(&path).unwrap()
        };
        let first = saved(&hologram());
        for _ in 0..8 {
            assert!(saved(&hologram()) == first);
        }
        assert!(saved(&StoredHologram { amplitude_constant: 1.5, ..hologram() }) != first, "the comparison is blind");
    }

    #[test]
    fn damaged_and_foreign_holograms_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        hologram().save(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for length in [0, 7, 40, whole.len() - 1] {
            std::fs::write(&path, &whole[..length]).unwrap();
            assert!(matches!(StoredHologram::load(&path), Err(FileError::Content { .. })), "{length}");
        }
        let mut infinite = whole.clone();
        let last = infinite.len() - 4;
        infinite[last..].copy_from_slice(&f32::INFINITY.to_le_bytes());
        std::fs::write(&path, infinite).unwrap();
        assert!(StoredHologram::load(&path).unwrap_err().to_string().contains("index 44"));
        assert!(matches!(StoredHologram::load(folder.path()), Err(FileError::Content { .. })));
        assert!(matches!(StoredHologram::load(&folder.path().join("absent")), Err(FileError::Io { .. })));
    }

    #[test]
    fn pictures_are_encoded_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture.png");
        let mut picture = LinearImage::black(SIZE);
        picture.pixels[0] = 0.215_861;
        picture.pixels[15] = 7.0;
        save_picture(&picture, &path).unwrap();
        let read = image::open(&path).unwrap().to_rgb8();
        assert_eq!(
            (read.dimensions(), read.get_pixel(0, 0).0, read.get_pixel(1, 0).0),
            ((5, 3), [128, 255, 0], [0; 3])
        );
    }

    #[test]
    fn phases_are_levels_of_sixteen_bits() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("phase.png");
        let mut pattern = PhasePattern::flat(SIZE);
        pattern.plane_mut(Colour::Blue)[..3].copy_from_slice(&[TAU / 4.0, TAU / 2.0, TAU * 0.999_999]);
        save_phase(&pattern, Colour::Blue, &path).unwrap();
        let read = image::open(&path).unwrap().into_luma16();
        assert_eq!([0, 1, 2, 3].map(|x| read.get_pixel(x, 0).0[0]), [16384, 32768, 0, 0]);
    }
}
