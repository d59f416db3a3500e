//! Scenes: RGB-D frames from files, from a caller's arrays, and from programs that hand them over while holod runs.
//!
//! A scene is a directory with a `scene.toml`:
//!
//! ```toml
//! colour = "rgb/{:05}.png"         # 8- or 16-bit PNG, JPEG or OpenEXR; {} or {:05} is the frame's number
//! depth = "depth/{:05}.png"        # where absent the colour file, which must be OpenEXR then
//! depth_encoding = "millimetres"   # metres, millimetres, dioptres, or normalised_dioptres with far_dpt and near_dpt
//! depth_scale = 1.0                # factor from the file's numbers to that unit: where absent 1, of integers in
//!                                  # normalised_dioptres 1 over the largest of the file (1/255 or 1/65535)
//! depth_missing = 0                # the number that means that there is no depth, where there is one
//! first = 0                        # for a sequence: its first number,
//! step = 1                         # the distance of numbers,
//! count = 240                      # how many (all that are there, where absent: none may be missing)
//! fps = 30.0                       # and how many a second, without which it cannot be played
//! ```
//!
//! PNG and JPEG are decoded from sRGB once, and each is turned by its own EXIF orientation; OpenEXR is linear already.
//! NaN, lengths that are not positive, wholly transparent pixels of a PNG and pixels outside the data window of an
//! OpenEXR have no depth and are filled from their surroundings.

mod array;
mod clipped;
mod decoded;
mod depth;
mod description;
mod error;
mod fit;
mod focal_stack;
mod jpeg;
mod live;
mod openexr;
mod primaries;
mod raster;

use std::fmt;
use std::path::{Path, PathBuf};

use holod_calibration::{Dioptres, DisplayGeometry, Resolution};
use serde::{Deserialize, Serialize};

use self::decoded::{ColourRaster, DepthRaster};
use self::description::Description;
use self::fit::Placement;

pub use self::array::{ArrayColours, ArrayDepths, ArrayError, ArrayPicture};
pub use self::clipped::ClippedColours;
pub use self::decoded::MOST_PIXELS;
pub use self::error::SceneError;
pub use self::focal_stack::{FocalStack, FocalStackFiles, FocalStackReport};
pub use self::live::{LiveColour, LiveDepth, LiveError, LiveFormat, LiveReader, LiveReport, MissingDepths};

/// Normalised depths and light this little outside 0..=1 are rounding, not clamping or clipping.
const ROUNDING: f32 = 1e-5;

/// One RGB-D frame as the network reads it.
#[derive(Clone, Debug, PartialEq)]
pub struct RgbdFrame {
    /// Columns and rows of one colour.
    pub resolution: Resolution,
    /// Square root of linear light, 0..=1, [3, height, width].
    pub amplitude: Vec<f32>,
    /// 0 at the far end of the display's depth range and 1 at the near end, uniform in dioptres, [height, width].
    pub depth_normalised: Vec<f32>,
}

impl RgbdFrame {
    /// A black frame at the far end of the depth range.
    pub fn black(resolution: Resolution) -> Self {
        let pixels = resolution.pixels();
        Self { resolution, amplitude: vec![0.0; 3 * pixels], depth_normalised: vec![0.0; pixels] }
    }

    /// A frame without a pixel, which takes the place of another for a while.
    const fn empty() -> Self {
        Self { resolution: Resolution { width: 0, height: 0 }, amplitude: Vec::new(), depth_normalised: Vec::new() }
    }
}

/// What happened to a frame between its files and the network.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameReport {
    /// Size of the colour picture in its file.
    pub source: Option<Resolution>,
    /// Pixels of the depth picture in its file.
    pub depth_px: usize,
    /// Those without a valid depth, which were filled from their surroundings.
    pub depth_missing_px: usize,
    /// Pixels of the source farther than the display shows, set to its far end.
    pub depth_clamped_far_px: usize,
    /// Pixels of the source nearer than the display shows, set to its near end.
    pub depth_clamped_near_px: usize,
    /// The least and the greatest normalised depth of the source's pixels.
    pub depth_range: [f32; 2],
    /// Pixels of the source with colours that were clipped.
    pub colour_clipped: ClippedColours,
    /// Pixels of the frame that the picture does not reach: black, at the far end.
    pub padded_px: usize,
    /// The EXIF orientations of colour and depth, where they differ and the sizes cannot tell whether that is meant.
    pub turned_apart: Option<[u8; 2]>,
    /// Whether the colours' file says that they are of other primaries than those that they are taken for.
    pub has_foreign_primaries: bool,
}

/// What the numbers of a depth file mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DepthEncoding {
    /// Metres; infinity is 0 dioptres.
    Metres,
    /// Millimetres; 0 is missing.
    Millimetres,
    /// Dioptres of 0 or more; 0 is infinitely far.
    Dioptres,
    /// 0 at `far_dpt` and 1 at `near_dpt`, uniform in dioptres. Of an integer file the largest integer is 1, unless a
    /// scale says otherwise.
    NormalisedDioptres {
        /// Vergence of the value 0.
        far_dpt: f64,
        /// Vergence of the value 1.
        near_dpt: f64,
    },
}

/// How a picture of another size is brought to the wanted one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fit {
    /// Unscaled and centred; a smaller picture is padded, a larger one is an error.
    #[default]
    Native,
    /// Scaled so that all of it is visible, padded.
    Contain,
    /// Scaled so that it fills the frame, the rest cut off evenly.
    Cover,
    /// Unscaled and centred; what sticks out is cut off, a smaller picture is padded.
    Crop,
}

/// A picture of a scene before it is fitted to the depth range of a bench.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenePicture {
    /// Columns and rows of one colour.
    pub resolution: Resolution,
    /// Linear light, 0..=1, [3, height, width].
    pub linear: Vec<f32>,
    /// Vergence of each pixel, [height, width].
    pub depth_dpt: Vec<f32>,
    /// What happened to it; whether its depths can be shown is not known here.
    pub report: FrameReport,
}

/// A still picture or a sequence of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    description: Description,
}

impl Scene {
    /// Opens a scene as a command line names it: a directory with a `scene.toml`, that file itself, `COLOUR,DEPTH`, or
    /// one OpenEXR file with colour and depth. The latter two need `depth_encoding`; a scene file names its own, and
    /// another one beside it is an error.
    ///
    /// Pictures are read when they are loaded, so a missing or damaged one is reported then.
    pub fn open(spec: &str, depth_encoding: Option<DepthEncoding>) -> Result<Self, SceneError> {
        Ok(Self { description: description::describe(spec, depth_encoding)? })
    }

    /// Frames of the scene, at least one.
    pub fn frames(&self) -> usize {
        self.description.frames
    }

    /// Frames a second, where the scene says so.
    pub fn fps(&self) -> Option<f64> {
        self.description.fps
    }

    /// Frames a second at which the scene is played; none of a still.
    ///
    /// # Errors
    /// It is a sequence that does not say so.
    pub fn playback_fps(&self) -> Result<Option<f64>, SceneError> {
        let Description { path, frames, fps, sequence_line, .. } = &self.description;
        match fps {
            _ if *frames == 1 => Ok(None),
            Some(fps) => Ok(Some(*fps)),
            None => Err(SceneError::Description {
                path: path.clone(),
                line: *sequence_line,
                key: "fps".into(),
                found: format!("none for this sequence of {frames} frames"),
                expected:
                    "how many are shown a second: write, for example, fps = 30.0, or count = 1 for the first alone"
                        .into(),
            }),
        }
    }

    /// Loads frame `index` for the depth range of `geometry`, at `resolution` or, without one, at the picture's own.
    ///
    /// Depth of another size than colour is an error with [`Fit::Native`]; any other fit resamples it to the colour's
    /// size, where their aspect ratios agree to a hundredth.
    pub fn load(
        &self,
        index: usize,
        geometry: &DisplayGeometry,
        resolution: Option<Resolution>,
        fit: Fit,
    ) -> Result<(RgbdFrame, FrameReport), SceneError> {
        let ScenePicture { resolution: size, linear, depth_dpt, mut report } = self.read(index, fit)?;
        let (placement, target) = self.placement(index, size, resolution, fit)?;
        report.padded_px = placement.padded_px();
        let depth_normalised = normalised(&depth_dpt, geometry, &mut report);
        let frame = RgbdFrame {
            resolution: target,
            amplitude: linear
                .chunks_exact(size.pixels())
                .flat_map(|plane| placement.light(plane))
                .map(f32::sqrt)
                .collect(),
            depth_normalised: placement.nearest(&depth_normalised, 0.0),
        };
        Ok((frame, report))
    }

    /// Loads frame `index` as [`Self::load`] does, with depths that are not clamped to any display's range: what lies
    /// beyond infinity, as normalised depths below 0 may, is at infinity. What the picture does not reach is black, at
    /// the far end of `geometry`.
    pub fn picture(
        &self,
        index: usize,
        geometry: &DisplayGeometry,
        resolution: Option<Resolution>,
        fit: Fit,
    ) -> Result<ScenePicture, SceneError> {
        let ScenePicture { resolution: size, linear, mut depth_dpt, mut report } = self.read(index, fit)?;
        let (placement, resolution) = self.placement(index, size, resolution, fit)?;
        for dioptres in &mut depth_dpt {
            *dioptres = dioptres.max(0.0);
        }
        report.padded_px = placement.padded_px();
        let Dioptres(far_dpt) = geometry.depth_far;
        // Never nearer than that by rounding, so that it becomes the end itself.
        let outside_dpt =
            if f64::from(far_dpt as f32) > far_dpt { (far_dpt as f32).next_down() } else { far_dpt as f32 };
        Ok(ScenePicture {
            resolution,
            linear: linear.chunks_exact(size.pixels()).flat_map(|plane| placement.light(plane)).collect(),
            depth_dpt: placement.nearest(&depth_dpt, outside_dpt),
            report,
        })
    }

    /// The scene file, where there is one.
    pub fn file(&self) -> Option<&Path> {
        let path = &self.description.path;
        path.extension().is_some_and(|extension| extension == "toml").then_some(path)
    }

    /// The files of frame `index`: colour and depth, which may be one file.
    pub fn pictures(&self, index: usize) -> [PathBuf; 2] {
        [self.colour_path(index), self.description.depth.path(self.number(index))]
    }

    fn colour_path(&self, index: usize) -> PathBuf {
        self.description.colour.path(self.number(index))
    }

    /// The number of frame `index` in the names of files.
    fn number(&self, index: usize) -> u64 {
        self.description.first + index as u64 * self.description.step
    }

    /// How a picture of `size` comes to the size that is asked for, and that size.
    fn placement(
        &self,
        index: usize,
        size: Resolution,
        resolution: Option<Resolution>,
        fit: Fit,
    ) -> Result<(Placement, Resolution), SceneError> {
        let wanted = resolution.unwrap_or(size);
        let too_large = || SceneError::TooLarge { path: self.colour_path(index), found: size, wanted };
        Ok((Placement::new(size, wanted, fit).ok_or_else(too_large)?, wanted))
    }

    /// Reads frame `index` at the size of its colours.
    fn read(&self, index: usize, fit: Fit) -> Result<ScenePicture, SceneError> {
        let Description { path, frames, .. } = &self.description;
        if index >= *frames {
            return Err(SceneError::NoSuchFrame { path: path.clone(), index, frames: *frames });
        }
        let [colour_path, depth_path] = self.pictures(index);
        if colour_path == depth_path && !raster::is_openexr(&colour_path)? {
            return Err(SceneError::Picture {
                path: colour_path,
                found: "one file for colours and depth that is not OpenEXR".into(),
                expected: "a second file with the depth: name it (`depth` in a scene.toml, or COLOUR,DEPTH)".into(),
            });
        }
        let colour = raster::read_colour(&colour_path)?;
        let depth = raster::read_depth(&depth_path, colour_path != depth_path)?;
        let mut report = FrameReport {
            source: Some(colour.size),
            depth_px: depth.size.pixels(),
            colour_clipped: colour.clipped,
            turned_apart: turned_apart(&colour, &depth),
            has_foreign_primaries: colour.has_foreign_primaries,
            ..FrameReport::default()
        };
        if colour_path == depth_path && colour.is_luminance && depth.is_luminance {
            return Err(SceneError::Picture {
                path: colour_path,
                found: "a channel Y, and nothing else to see or to know depth by".into(),
                expected: "colours and depth: it cannot be both, name the other's file, too (COLOUR,DEPTH)".into(),
            });
        }
        let mut depth_dpt = self.description.depth_reading.dioptres(&depth.numbers);
        report.depth_missing_px =
            depth::fill_missing(&mut depth_dpt, depth.size).ok_or_else(|| SceneError::Picture {
                path: depth_path.clone(),
                found: "no pixel with a valid depth".into(),
                expected:
                    "depth in the encoding that the scene names: look at the encoding, its scale and the missing value"
                        .into(),
            })?;
        if depth.size != colour.size {
            let aspect = |size: Resolution| size.width as f64 / size.height as f64;
            let alike = (aspect(depth.size) / aspect(colour.size) - 1.0).abs() < 0.01;
            let placement = Placement::new(depth.size, colour.size, Fit::Cover).filter(|_| alike && fit != Fit::Native);
            let Some(placement) = placement else {
                return Err(SceneError::SizesDiffer {
                    colour: colour_path,
                    colour_size: colour.size,
                    colour_orientation: colour.turned.to_exif(),
                    depth: depth_path,
                    depth_size: depth.size,
                    depth_orientation: depth.turned.to_exif(),
                });
            };
            depth_dpt = placement.nearest(&depth_dpt, 0.0);
        }
        Ok(ScenePicture { resolution: colour.size, linear: colour.linear, depth_dpt, report })
    }
}

/// The EXIF orientations, where they differ and sizes that agree say nothing of that: a quarter turn of a picture that is
/// not square was made of the other's pixels, too.
fn turned_apart(colour: &ColourRaster, depth: &DepthRaster) -> Option<[u8; 2]> {
    let turns = [colour.turned, depth.turned];
    let [of_colour, of_depth] = turns.map(|turned| turned.to_exif());
    // From 5 on width and height change places.
    let keeps_size = colour.size.width == colour.size.height || (of_colour < 5) == (of_depth < 5);
    (of_colour != of_depth && keeps_size).then_some([of_colour, of_depth])
}

/// The place of each depth in the range of `geometry`, clamped to it; counts what was clamped.
fn normalised(depth_dpt: &[f32], geometry: &DisplayGeometry, report: &mut FrameReport) -> Vec<f32> {
    let normalise = |&depth_dpt: &f32| geometry.normalised_depth(Dioptres(depth_dpt.into())) as f32;
    clamped(depth_dpt.iter().map(normalise), report)
}

/// Normalised depths clamped to the display's range; counts those that were outside, and notes how far they reach.
fn clamped(depths: impl Iterator<Item = f32>, report: &mut FrameReport) -> Vec<f32> {
    let mut depths: Vec<f32> = depths.collect();
    clamp(&mut depths, report);
    depths
}

/// What [`clamped`] does, in place.
fn clamp(depths: &mut [f32], report: &mut FrameReport) {
    let [mut least, mut greatest] = [f32::MAX, f32::MIN];
    for depth in depths {
        report.depth_clamped_far_px += usize::from(*depth < -ROUNDING);
        report.depth_clamped_near_px += usize::from(*depth > 1.0 + ROUNDING);
        *depth = depth.clamp(0.0, 1.0);
        least = least.min(*depth);
        greatest = greatest.max(*depth);
    }
    report.depth_range = [least, greatest];
}

impl DepthEncoding {
    /// Reads `metres`, `millimetres`, `dioptres` or `normalised_dioptres[:FAR_DPT,NEAR_DPT]` as on a command line;
    /// without its two ends the latter spans the depth range of `geometry`.
    pub fn parse(text: &str, geometry: &DisplayGeometry) -> Result<Self, SceneError> {
        let unknown = || SceneError::DepthEncoding { found: format!("\"{text}\"") };
        match text {
            "metres" => Ok(Self::Metres),
            "millimetres" => Ok(Self::Millimetres),
            "dioptres" => Ok(Self::Dioptres),
            "normalised_dioptres" => {
                Ok(Self::NormalisedDioptres { far_dpt: geometry.depth_far.0, near_dpt: geometry.depth_near.0 })
            }
            _ => {
                let bounds = text.strip_prefix("normalised_dioptres:").ok_or_else(unknown)?;
                let (far, near) = bounds.split_once(',').ok_or_else(unknown)?;
                let number = |text: &str| text.trim().parse::<f64>().map_err(|_| unknown());
                let (far_dpt, near_dpt) = (number(far)?, number(near)?);
                if !(far_dpt >= 0.0 && near_dpt >= 0.0 && far_dpt.is_finite() && near_dpt.is_finite()) {
                    return Err(unknown());
                }
                if near_dpt <= far_dpt {
                    let found =
                        format!("\"{text}\", whose second end, the near one, has no more dioptres than the first");
                    return Err(SceneError::DepthEncoding { found });
                }
                Ok(Self::NormalisedDioptres { far_dpt, near_dpt })
            }
        }
    }
}

/// As on a command line.
impl fmt::Display for DepthEncoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Metres => f.write_str("metres"),
            Self::Millimetres => f.write_str("millimetres"),
            Self::Dioptres => f.write_str("dioptres"),
            Self::NormalisedDioptres { far_dpt, near_dpt } => write!(f, "normalised_dioptres:{far_dpt},{near_dpt}"),
        }
    }
}

#[cfg(test)]
mod tests;
