//! Holograms and pictures on disk. Everything is written beside its place and renamed, so nothing is ever half written.

use std::collections::BTreeMap;
use std::f32::consts::TAU;
use std::fmt;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use holod_calibration::rig::{DEPTH_DPT, FOCAL_LENGTH, PITCH, Provenance, Span, WAVELENGTH};
use holod_calibration::{
    Colour, Dioptres, DisplayGeometry, Metres, PerColour, PupilDiameter, Resolution, write_atomically,
};
use image::{ImageBuffer, ImageFormat, Luma, PixelWithColorType, Rgb};
use num_complex::Complex32;
use safetensors::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};

use crate::conditions::WIDEST_PUPIL;
use crate::picture::srgb8;
use crate::safetensors_file::{self, Tensor};
use crate::whole_file::{self, Unread};
use crate::{ComplexHologram, LinearImage, PhasePattern};

/// The value of the metadata key `format` of a hologram file.
const FORMAT: &str = "holod-hologram-1";
/// The value of the metadata key `rig_hash` of a hologram of the built-in rig, which has no file.
const BUILT_IN_RIG: &str = "built-in";
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
    /// The rig that it was made with; nothing where the file is of a holod that did not say.
    pub rig: Option<RigHash>,
}

/// Which rig a hologram was made with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RigHash {
    /// The built-in bench, which has no file.
    BuiltIn,
    /// That of a file, whose text has this hash in hexadecimal digits.
    File(String),
}

impl RigHash {
    /// That of a rig.
    pub fn of(provenance: &Provenance) -> Self {
        provenance.hash_text().map_or(Self::BuiltIn, Self::File)
    }

    fn parse(text: &str) -> Option<Self> {
        let is_hash = text.len() == 16 && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
        match text {
            BUILT_IN_RIG => Some(Self::BuiltIn),
            _ => is_hash.then(|| Self::File(text.to_owned())),
        }
    }

    fn text(&self) -> &str {
        match self {
            Self::BuiltIn => BUILT_IN_RIG,
            Self::File(hash) => hash,
        }
    }
}

impl fmt::Display for RigHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BuiltIn => f.write_str("the built-in rig"),
            Self::File(hash) => write!(f, "the rig file of hash {hash}"),
        }
    }
}

/// The optics of a bench, as files state them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BenchOptics {
    /// Wavelengths of the red, the green and the blue laser, nanometres.
    pub wavelengths_nm: [f64; 3],
    /// Distance between the centres of neighbouring pixels.
    pub pixel_pitch_um: f64,
    /// Focal length of the eyepiece, over the magnification of the relay before it.
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

    /// The first figure that no rig file may have: what is found, and what is expected.
    fn fault(&self) -> Option<(String, String)> {
        let [red_nm, green_nm, blue_nm] = self.wavelengths_nm;
        let figures: [(&str, f64, Span); 7] = [
            ("wavelengths_nm", red_nm, WAVELENGTH),
            ("wavelengths_nm", green_nm, WAVELENGTH),
            ("wavelengths_nm", blue_nm, WAVELENGTH),
            ("pixel_pitch_um", self.pixel_pitch_um, PITCH),
            ("eyepiece_focal_length_mm", self.eyepiece_focal_length_mm, FOCAL_LENGTH),
            ("depth_far_dpt", self.depth_far_dpt, DEPTH_DPT),
            ("depth_near_dpt", self.depth_near_dpt, DEPTH_DPT),
        ];
        let (key, figure, span) = figures.into_iter().find(|(_, figure, span)| !span.takes(*figure))?;
        Some((format!("{figure} in `{key}` of `optics`"), span.expected()))
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
    /// pupil_mm, amplitude_constant, optics (JSON) and rig_hash (`built-in`, or hexadecimal digits).
    pub fn save(&self, path: &Path) -> Result<(), FileError> {
        let Resolution { width, height } = self.hologram.resolution;
        let bytes: Vec<u8> =
            self.hologram.field.iter().flat_map(|value| [value.re, value.im]).flat_map(f32::to_le_bytes).collect();
        let optics = serde_json::to_string(&self.optics).map_err(|error| FileError::Content {
            path: path.to_owned(),
            found: error.to_string(),
            expected: "optics that JSON can hold".into(),
        })?;
        let mut metadata = BTreeMap::from([
            ("format".to_owned(), FORMAT.to_owned()),
            ("pupil_mm".to_owned(), self.pupil.mm().to_string()),
            ("amplitude_constant".to_owned(), self.amplitude_constant.to_string()),
            ("optics".to_owned(), optics),
        ]);
        metadata.extend(self.rig.as_ref().map(|rig| ("rig_hash".to_owned(), rig.text().to_owned())));
        let field =
            Tensor { name: "field".to_owned(), dtype: Dtype::F32, shape: vec![3, height, width, 2], bytes: &bytes };
        write_atomically(path, |out| safetensors_file::write(out, vec![field], &metadata))
            .map_err(|source| FileError::Io { path: path.to_owned(), source })
    }

    /// Reads what [`Self::save`] wrote.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        let content = |found: String, expected: &str| FileError::Content {
            path: path.to_owned(),
            found,
            expected: format!("{expected}; write the hologram again with `holod render`"),
        };
        let bytes = whole_file::read(path, LARGEST_FILE_BYTES).map_err(|unread| match unread {
            Unread::NoFile { found } => content(found, "a hologram file of at most 1 GiB"),
            Unread::System(source) => FileError::Io { path: path.to_owned(), source },
        })?;
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
        let number = |key: &str, is_taken: &dyn Fn(f32) -> bool, expected: &str| -> Result<f32, FileError> {
            let text = entry(key)?;
            let number = text.parse().ok().filter(|&number| is_taken(number));
            number.ok_or_else(|| content(format!("`{key}` = {text}"), expected))
        };
        if entry("format")? != FORMAT {
            return Err(content(format!("format \"{}\"", entry("format")?), &format!("\"{FORMAT}\"")));
        }
        let optics: BenchOptics = serde_json::from_str(entry("optics")?).map_err(|error| {
            content(format!("`optics` that cannot be used ({error})"), "the hologram's optics as JSON")
        })?;
        if let Some((found, expected)) = optics.fault() {
            return Err(content(found, &expected));
        }
        let widest_mm = WIDEST_PUPIL.mm();
        let is_pupil = |mm| mm > 0.0 && mm <= widest_mm;
        let pupil_mm = number("pupil_mm", &is_pupil, &format!("a diameter above 0 and up to {widest_mm} mm"))?;
        // Double phase multiplies by its reciprocal, which of the smallest numbers is infinite.
        let is_constant = |constant: f32| constant > 0.0 && constant.is_finite() && constant.recip().is_finite();
        let amplitude_constant =
            number("amplitude_constant", &is_constant, "a number above 0 whose reciprocal is finite")?;
        let rig = entries.get("rig_hash").map(|text| {
            let expected = "the hash of a rig file, 16 hexadecimal digits, or `built-in`";
            RigHash::parse(text).ok_or_else(|| content(format!("`rig_hash` = {text}"), expected))
        });
        let rig = rig.transpose()?;

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
        let sample = |bytes: &[u8; 8]| {
            let [a, b, c, d, e, f, g, h] = *bytes;
            Complex32::new(f32::from_le_bytes([a, b, c, d]), f32::from_le_bytes([e, f, g, h]))
        };
        let field: Vec<_> = view.data().as_chunks().0.iter().map(sample).collect();
        if let Some(index) = field.iter().position(|value| !value.is_finite()) {
            return Err(content(format!("{} at index {index} of `field`", field[index]), "finite values"));
        }
        Ok(Self {
            hologram: ComplexHologram { resolution: Resolution { width, height }, field },
            pupil: PupilDiameter::from_mm(pupil_mm),
            optics,
            amplitude_constant,
            rig,
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
            rig: Some(RigHash::File("00c0ffee00c0ffee".into())),
        }
    }

    #[test]
    fn a_hologram_round_trips_and_leaves_nothing_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        // A file of a holod that did not write the rig's hash has none.
        for rig in [hologram().rig, Some(RigHash::BuiltIn), None] {
            let stored = StoredHologram { rig, ..hologram() };
            stored.save(&path).unwrap();
            assert_eq!(StoredHologram::load(&path).unwrap(), stored);
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_no_rig_and_no_eye_could_have_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        let refusal = |spoil: &dyn Fn(&mut StoredHologram)| {
            let mut stored = hologram();
            spoil(&mut stored);
            stored.save(&path).unwrap();
            StoredHologram::load(&path).err().map(|error| error.to_string())
        };
        assert_eq!(refusal(&|_| {}), None);
        type Spoil = fn(&mut StoredHologram);
        let cases: [(Spoil, &str, &str); 11] = [
            (|h| h.optics.pixel_pitch_um = 0.0, "0 in `pixel_pitch_um` of `optics`", "from 1 to 50 µm"),
            (|h| h.optics.eyepiece_focal_length_mm = -40.0, "-40 in `eyepiece_focal_length_mm`", "from 5 to 500 mm"),
            (|h| h.optics.wavelengths_nm[0] = 0.0, "0 in `wavelengths_nm`", "from 380 to 780 nm"),
            (|h| h.optics.wavelengths_nm[2] = 4500.0, "4500 in `wavelengths_nm`", "from 380 to 780 nm"),
            (|h| h.optics.depth_far_dpt = -1.0, "-1 in `depth_far_dpt`", "from 0 to 20 dioptres"),
            (|h| h.optics.depth_near_dpt = 21.0, "21 in `depth_near_dpt`", "from 0 to 20 dioptres"),
            (|h| h.pupil = PupilDiameter::from_mm(1e9), "`pupil_mm` = 1000000000", "above 0 and up to 20 mm"),
            (|h| h.pupil = PupilDiameter::from_mm(0.0), "`pupil_mm` = 0", "above 0 and up to 20 mm"),
            (|h| h.amplitude_constant = 1e-42, "`amplitude_constant` = 0.00", "whose reciprocal is finite"),
            (|h| h.amplitude_constant = f32::INFINITY, "`amplitude_constant` = inf", "whose reciprocal is finite"),
            (|h| h.rig = Some(RigHash::File("c0ffee".into())), "`rig_hash` = c0ffee", "16 hexadecimal digits"),
        ];
        for (spoil, found, expected) in cases {
            let said = refusal(&spoil).unwrap_or_else(|| panic!("{found} is taken"));
            assert!(said.contains(found) && said.contains(expected) && said.contains("holod render"), "{said}");
        }
        let ends: Spoil = |h| {
            h.optics.depth_near_dpt = 20.0;
            h.pupil = WIDEST_PUPIL;
            h.amplitude_constant = 3e-39;
        };
        assert_eq!(refusal(&ends), None, "the ends of the spans are taken");
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
