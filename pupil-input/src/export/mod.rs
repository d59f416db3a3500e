//! Recordings written as files that other programs, and holod itself, read.
//!
//! | | keeps | loses |
//! |---|---|---|
//! | [`write_lines`] | eye, diameter in millimetres, confidence | what is finer than 1 µs of time, apertures, blinks; an invalid sample becomes one of confidence 0, which no gate believes |
//! | [`write_csv`] | every sample bit for bit, its unit | blinks, what was rejected; diameters of invalid samples that are no numbers |
//!
//! A file is written beside its place and moved there when it is whole and on the disk: whoever looks sees all of it or
//! what was there before.

mod csv;
mod lines;

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use holod_calibration::write_atomically;

pub use csv::write_csv;
pub use lines::write_lines;

/// Why a recording could not be written. Nothing has been changed then.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum ExportError {
    /// The file cannot be written.
    #[error("cannot write {path}: {source}; expected a path in a folder that can be written to, with room on its disk")]
    Io { path: PathBuf, source: io::Error },
    /// The line protocol is in millimetres and the recording is not.
    #[error(
        "cannot write {path} in holod's line protocol: its diameters are millimetres, and those of the recording are \
         {unit}; measure a printed disc of known diameter with the tracker and give the scale (its millimetres / its \
         {unit}), or write CSV, which keeps the unit"
    )]
    NoScale {
        path: PathBuf,
        /// The unit of the recording's sizes.
        unit: &'static str,
    },
    /// The scale is no factor.
    #[error("cannot write {path}: found a scale of {scale}; expected millimetres per unit, a number above 0")]
    BadScale { path: PathBuf, scale: f64 },
}

impl ExportError {
    /// The same of another path, where what was written is a step on the way to that.
    #[must_use]
    pub fn of(self, path: &Path) -> Self {
        let path = path.to_owned();
        match self {
            Self::Io { source, .. } => Self::Io { path, source },
            Self::NoScale { unit, .. } => Self::NoScale { path, unit },
            Self::BadScale { scale, .. } => Self::BadScale { path, scale },
        }
    }
}

/// Writes a file whole or not at all.
fn atomically(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), ExportError> {
    write_atomically(path, write).map_err(|source| ExportError::Io { path: path.into(), source })
}
