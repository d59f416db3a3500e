//! What pictures are decoded to: linear light, and depth as the file numbers it.

use std::path::Path;

use holod_calibration::Resolution;
use image::metadata::Orientation;

use super::depth::DepthNumbers;
use super::{ClippedColours, SceneError};

/// More pixels than an 8K frame are refused before anything is allocated for them.
pub const MOST_PIXELS: usize = 7680 * 4320;
/// What is read, for errors.
pub(super) const FORMATS: &str = "an 8- or 16-bit PNG, a JPEG or an OpenEXR picture";

/// A colour picture in linear light.
pub(super) struct ColourRaster {
    pub(super) size: Resolution,
    /// How it was turned after it was read.
    pub(super) turned: Orientation,
    /// [3, height, width], 0..=1
    pub(super) linear: Vec<f32>,
    /// Pixels of which some colour was outside that.
    pub(super) clipped: ClippedColours,
    /// Whether one channel of luminance stands for all colours.
    pub(super) is_luminance: bool,
    /// Whether the file names other primaries than Rec. 709's, or a high dynamic range.
    pub(super) has_foreign_primaries: bool,
}

/// A picture of depths, in its file's own numbers.
pub(super) struct DepthRaster {
    pub(super) size: Resolution,
    /// How it was turned after it was read.
    pub(super) turned: Orientation,
    pub(super) numbers: DepthNumbers,
    /// Whether they were found in a channel of luminance.
    pub(super) is_luminance: bool,
}

/// Checks a picture's claimed size before memory is spent on it.
pub(super) fn check_size(path: &Path, width: usize, height: usize) -> Result<Resolution, SceneError> {
    let size = Resolution { width, height };
    if width == 0 || height == 0 || width.checked_mul(height).is_none_or(|pixels| pixels > MOST_PIXELS) {
        return Err(SceneError::Picture {
            path: path.to_owned(),
            found: format!("a picture of {size}"),
            expected: format!("at least one pixel and at most {MOST_PIXELS}, as many as 7680x4320"),
        });
    }
    Ok(size)
}
