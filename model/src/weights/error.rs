//! What is wrong with weights.

use std::path::PathBuf;

/// The value of the metadata key `format` that this crate reads.
pub(super) const FORMAT: &str = "holod-weights-2";
/// Its value in files for one bench, of networks that were told the pupil in millimetres.
pub(super) const OLD_FORMAT: &str = "holod-weights-1";

/// Weights that cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum WeightsError {
    /// The file cannot be read.
    #[error("weights {path}: {source}; expected a safetensors file that holod's trainer exported", path = path.display())]
    Read {
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The path is a directory or the file is far too large.
    #[error("weights {path}: found {found}; expected a safetensors file of at most 256 MiB", path = path.display())]
    NotAFile { path: PathBuf, found: String },
    /// The bytes are no safetensors file.
    #[error(
        "weights {name}: not a valid safetensors file ({detail}); the file is damaged or of another kind: export or copy it again"
    )]
    Damaged {
        name: String,
        /// What the parser said.
        detail: String,
    },
    /// The metadata does not describe a network that this version runs.
    #[error(
        "weights {name}: metadata `{key}` is {found}; expected {expected}; export the weights with this version's trainer"
    )]
    Metadata {
        name: String,
        /// The metadata key, with a path inside it where it is structured.
        key: String,
        found: String,
        expected: String,
    },
    /// The file is of a format that this version no longer runs.
    #[error(
        "weights {name}: found format \"{OLD_FORMAT}\", of a network for one bench that is told the pupil in millimetres; \
         expected \"{FORMAT}\"; convert it with `python -m holod_training export --source FILE --out NEW`; it then needs a \
         short training: model/training/README.md"
    )]
    OldFormat { name: String },
    /// One tensor is missing or cannot be used.
    #[error("weights {name}: tensor `{tensor}` is {found}; expected {expected}")]
    Tensor { name: String, tensor: String, found: String, expected: String },
}
