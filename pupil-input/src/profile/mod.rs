//! What is known of a kind of tracker: how its bytes are read, and how it is started and told from others.

use crate::import::SizeUnit;
use crate::wire::Decoder;
use crate::wire::line::LineDecoder;

/// A kind of tracker.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    /// The name by which a tracker spec asks for it.
    pub name: String,
    /// What its sizes are before the rig's scale.
    pub unit: SizeUnit,
}

/// Why there is no such profile.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no tracker profile `{name}`; there are {known}")]
pub struct ProfileError {
    name: String,
    known: String,
}

/// The profile that a tracker spec means when it names none.
pub const DEFAULT_PROFILE: &str = "holod";

impl Profile {
    /// The profile of that name.
    ///
    /// # Errors
    /// There is none; the error names those that there are.
    pub fn find(name: &str) -> Result<Self, ProfileError> {
        if name == DEFAULT_PROFILE {
            return Ok(Self { name: name.into(), unit: SizeUnit::Millimetres });
        }
        Err(ProfileError { name: name.into(), known: DEFAULT_PROFILE.into() })
    }

    /// A decoder for a stream that may be joined in the middle of a message.
    pub fn decoder(&self) -> Box<dyn Decoder> {
        Box::new(LineDecoder::joining())
    }
}
