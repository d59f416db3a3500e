//! What can be wrong with a scene.

use std::path::PathBuf;

use holod_calibration::Resolution;

use super::DepthEncoding;

/// A scene that cannot be loaded. Each message says which file, line or key it is about, what was found, what was
/// expected and what to do.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum SceneError {
    /// A file or directory cannot be read.
    #[error("scene {path}: {source}; expected {expected}", path = path.display())]
    Read {
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
        /// What should be there.
        expected: &'static str,
    },
    /// The path is of another kind than it should be.
    #[error("scene {path}: found {found}; expected {expected}", path = path.display())]
    Kind {
        path: PathBuf,
        found: String,
        /// What should be there.
        expected: &'static str,
    },
    /// A line of a scene file cannot be used.
    #[error("{path}, line {line}: `{key}`: found {found}; expected {expected}", path = path.display())]
    Description {
        path: PathBuf,
        /// Line of the file, from 1.
        line: usize,
        key: String,
        found: String,
        expected: String,
    },
    /// The depth encoding is not named, or not one of those known.
    #[error(
        "depth encoding: found {found}; expected metres, millimetres, dioptres or normalised_dioptres[:FAR,NEAR] (ends in dioptres, NEAR more than FAR; the rig's depth range where they are left out): give it with --depth-encoding"
    )]
    DepthEncoding { found: String },
    /// A scene file says another encoding than was named beside it.
    #[error(
        "{path}, line {line}: `depth_encoding`: found {own} here and {named} named beside the scene \
         (--depth-encoding); expected one of them: leave out what is named beside it, or change it in this file",
        path = path.display()
    )]
    EncodingsDiffer {
        path: PathBuf,
        /// Line of the file, from 1.
        line: usize,
        /// What the file says.
        own: DepthEncoding,
        /// What was named beside it.
        named: DepthEncoding,
    },
    /// A picture file is damaged, truncated or of a kind that is not read.
    #[error("{path}: {found}; expected {expected}", path = path.display())]
    Picture {
        path: PathBuf,
        found: String,
        /// What was expected and what to do.
        expected: String,
    },
    /// Colour and depth differ in size.
    #[error(
        "{depth} is {depth_size}{} and {colour} is {colour_size}{}; expected one size: export both alike, or ask for a \
         fit (contain, cover or crop), which resamples depth of the same aspect ratio",
        as_turned(*depth_orientation),
        as_turned(*colour_orientation),
        depth = depth.display(),
        colour = colour.display()
    )]
    SizesDiffer {
        colour: PathBuf,
        /// As it is turned.
        colour_size: Resolution,
        /// How it is turned, by EXIF's numbers.
        colour_orientation: u8,
        depth: PathBuf,
        /// As it is turned.
        depth_size: Resolution,
        /// How it is turned, by EXIF's numbers.
        depth_orientation: u8,
    },
    /// The picture is larger than the frame and no fit was asked for.
    #[error("{path} is {found}; expected at most {wanted}: ask for a fit (contain, cover or crop)", path = path.display())]
    TooLarge { path: PathBuf, found: Resolution, wanted: Resolution },
    /// An image of a focal stack would have to be scaled, and the blur in it with it.
    #[error(
        "{path} is {found}; expected a fit to {wanted} that cuts or pads it, as crop does: an image that is scaled has the \
         blur of another pupil than its own",
        path = path.display()
    )]
    BlurScaled { path: PathBuf, found: Resolution, wanted: Resolution },
    /// The sequence has no such frame.
    #[error("scene {path}: found {frames} frames; expected more than {index}", path = path.display())]
    NoSuchFrame {
        path: PathBuf,
        /// The frame asked for.
        index: usize,
        /// How many there are.
        frames: usize,
    },
}

/// What is said of a picture that is not shown as it is stored.
fn as_turned(exif_orientation: u8) -> String {
    if exif_orientation == 1 { String::new() } else { format!(" (turned by its EXIF orientation {exif_orientation})") }
}
