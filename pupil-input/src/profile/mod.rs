//! What is known of a kind of tracker: how its bytes are read, and how it is started and told from others.
//!
//! A profile is a TOML file. `profiles/README.md` in this crate describes every key; the files beside it are shipped.

mod bytes;
mod kinds;
mod parse;

use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::Duration;

use holod_calibration::toml_reader::{Fault, did_you_mean};

use crate::size_unit::{Figures, SizeUnit};
use crate::usb_ids::UsbIds;
use crate::wire::hid_descriptor::DescriptorError;
use crate::wire::{Decoder, Format};

/// A kind of tracker.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    /// The name by which a tracker spec asks for it.
    pub name: String,
    /// One sentence about the tracker, with what of the profile is unverified.
    pub about: String,
    /// What its sizes are before the rig's scale.
    pub unit: SizeUnit,
    /// What one unit on the wire is multiplied by to that; 1 where the profile knows no conversion.
    pub mm_per_unit: f64,
    /// How it is reached through a serial port.
    pub serial: SerialSettings,
    /// How it is found among the HID devices.
    pub hid: HidSettings,
    /// Its address on a network.
    pub network: NetworkSettings,
    /// How its bytes are read.
    pub format: Format,
}

/// How a tracker is reached through a serial port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SerialSettings {
    /// Rate of the line, bits a second.
    pub baud: u32,
    /// The USB devices that it may be; none where its adapter may be any.
    pub usb: Vec<UsbIds>,
    /// What is sent after the port was opened, in this order.
    pub start: Vec<Command>,
    /// What is sent before the port is closed.
    pub stop: Vec<Command>,
}

/// How a tracker is found among the HID devices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HidSettings {
    /// The USB devices that it may be.
    pub usb: Vec<UsbIds>,
    /// The usage page of its collection.
    pub usage_page: Option<u16>,
    /// The usage of its collection.
    pub usage: Option<u16>,
}

/// How a tracker is reached over a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NetworkSettings {
    /// The port where a spec names none.
    pub port: Option<u16>,
    /// What is sent after the connection was made, in this order.
    pub start: Vec<Command>,
    /// What is sent before it is closed.
    pub stop: Vec<Command>,
}

/// Something to say to a tracker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Command {
    /// The bytes that are sent, nothing added.
    pub send: Vec<u8>,
    /// Bytes that its answer holds; None where it gives none.
    pub expect: Option<Vec<u8>>,
    /// How long the answer may take.
    pub within: Duration,
}

/// Why there is no such profile.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum ProfileError {
    /// No profile of that name is shipped.
    #[error("no tracker profile `{name}`; there are {known}; {advice}")]
    Unknown {
        name: String,
        /// The names that there are.
        known: String,
        advice: String,
    },
    /// Its file cannot be read.
    #[error("tracker profile {path}: {reason}; expected a readable TOML file")]
    Unreadable { path: PathBuf, reason: String },
    /// It was read, and some of its keys are wrong or missing.
    #[error("tracker profile {origin}: {}", in_words(.faults))]
    Wrong {
        /// Its name or file.
        origin: String,
        /// At least one fault, in the order of its lines.
        faults: Vec<Fault>,
    },
}

fn in_words(faults: &[Fault]) -> String {
    let count = format!("{} fault{}", faults.len(), if faults.len() == 1 { "" } else { "s" });
    faults.iter().fold(count, |text, fault| format!("{text}\n  {fault}"))
}

/// The profile that a tracker spec means when it names none.
pub const DEFAULT_PROFILE: &str = "holod";

/// Bits a second where neither spec nor profile names any.
pub(crate) const DEFAULT_BAUD: u32 = 115_200;

/// The shipped profiles, sorted by their names.
const FILES: [(&str, &str); 13] = [
    ("asl-eye-trac", include_str!("../../profiles/asl-eye-trac.toml")),
    ("core", include_str!("../../profiles/core.toml")),
    ("example-lines", include_str!("../../profiles/example-lines.toml")),
    ("example-packet", include_str!("../../profiles/example-packet.toml")),
    ("example-usages", include_str!("../../profiles/example-usages.toml")),
    ("holod", include_str!("../../profiles/holod.toml")),
    ("holod-hid", include_str!("../../profiles/holod-hid.toml")),
    ("iscan-etl", include_str!("../../profiles/iscan-etl.toml")),
    ("livetrack", include_str!("../../profiles/livetrack.toml")),
    ("neon", include_str!("../../profiles/neon.toml")),
    ("open-gaze", include_str!("../../profiles/open-gaze.toml")),
    ("pupilext-csv", include_str!("../../profiles/pupilext-csv.toml")),
    ("pupilext-json", include_str!("../../profiles/pupilext-json.toml")),
];

/// A test holds each of them to be right.
static SHIPPED: LazyLock<Vec<Profile>> =
    LazyLock::new(|| FILES.into_iter().filter_map(|(_, text)| parse::parse(text).ok()).collect());

impl Profile {
    /// Whether what is named is a file: what has a `/` or ends in `.toml`.
    pub(crate) fn is_path(name_or_path: &str) -> bool {
        name_or_path.contains('/') || name_or_path.ends_with(".toml")
    }

    /// The shipped profile of that name, or the one in a file, whose path has a `/` or ends in `.toml`.
    ///
    /// # Errors
    /// There is none of that name, or the file is not readable or wrong.
    pub fn find(name_or_path: &str) -> Result<Self, ProfileError> {
        if Self::is_path(name_or_path) {
            return Self::read(Path::new(name_or_path));
        }
        Self::shipped().find(|profile| profile.name == name_or_path).ok_or_else(|| {
            let names = FILES.map(|(name, _)| name);
            let advice = did_you_mean(name_or_path, &names)
                .unwrap_or_else(|| "name one of these, or the path of a profile of your own".into());
            ProfileError::Unknown { name: name_or_path.into(), known: names.join(", "), advice }
        })
    }

    /// Every profile that holod brings with it, by name.
    pub fn shipped() -> impl Iterator<Item = Self> {
        SHIPPED.iter().cloned()
    }

    fn read(path: &Path) -> Result<Self, ProfileError> {
        let text = std::fs::read_to_string(path)
            .map_err(|error| ProfileError::Unreadable { path: path.into(), reason: error.to_string() })?;
        Self::from_toml(&text, &path.display().to_string())
    }

    /// The profile that a text describes; `origin` names it in errors.
    pub(crate) fn from_toml(text: &str, origin: &str) -> Result<Self, ProfileError> {
        parse::parse(text).map_err(|faults| ProfileError::Wrong { origin: origin.into(), faults })
    }

    /// The profile for the HID device with this report descriptor: what it names by usage gets its place.
    ///
    /// # Errors
    /// The descriptor is faulty, or does not have what the profile names.
    pub(crate) fn described(self, descriptor: &[u8]) -> Result<Self, DescriptorError> {
        let format = match self.format {
            Format::Usages(settings) => Format::Report(settings.resolve(descriptor)?),
            format => format,
        };
        Ok(Self { format, ..self })
    }

    /// What its sizes are, and what was made of those on the wire.
    pub(crate) const fn figures(&self) -> Figures {
        Figures { unit: self.unit, mm_per_unit: self.mm_per_unit, recorded_scale: None }
    }

    /// A decoder for a stream that may be joined in the middle of a message.
    pub fn decoder(&self) -> Box<dyn Decoder> {
        self.format.decoder()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_in_the_folder_is_shipped_under_its_name_and_is_right() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/profiles");
        let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let mut names: Vec<_> = files
            .filter(|path| path.extension().is_some_and(|extension| extension == "toml"))
            .map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned())
            .collect();
        names.sort();
        assert_eq!(names, FILES.map(|(name, _)| name));
        for (name, text) in FILES {
            let profile = parse::parse(text).unwrap_or_else(|faults| panic!("{name}: {}", in_words(&faults)));
            assert_eq!(profile.name, name);
            assert_eq!(Profile::find(name), Ok(profile));
        }
    }

    #[test]
    fn a_name_that_is_not_there_is_told_with_those_that_are() {
        let error = Profile::find("holodd").unwrap_err().to_string();
        assert!(error.contains("no tracker profile `holodd`") && error.contains("did you mean `holod`?"), "{error}");
        let error = Profile::find("./none.toml").unwrap_err().to_string();
        assert!(error.starts_with("tracker profile ./none.toml: "), "{error}");
    }
}
