//! What the fuzz targets need and nobody else: only there where `--cfg fuzzing` builds them.

use crate::wire::Decoder;
use crate::wire::core::CoreDecoder;
use crate::wire::neon::NeonDecoder;
use crate::{Profile, ProfileError};

/// The decoder of Pupil Labs Core's messages; each push is one.
pub fn core_decoder() -> Box<dyn Decoder> {
    Box::new(CoreDecoder)
}

/// The decoder of Neon's gaze stream.
pub fn neon_decoder() -> Box<dyn Decoder> {
    Box::new(NeonDecoder::new())
}

/// The profile that a text describes.
///
/// # Errors
/// It is wrong.
pub fn profile(text: &str) -> Result<Profile, ProfileError> {
    Profile::from_toml(text, "fuzzed")
}
