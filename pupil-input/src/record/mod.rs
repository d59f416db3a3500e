//! A run written down: the bytes of the link with their times of arrival, and the samples with their verdicts.
//!
//! The reader thread puts what it has into rings that were allocated at the start, and never waits: what finds no room
//! is counted and left out, and the file says so. A thread of its own writes. What it has written is handed to the
//! system ten times a second and is on the disk after at most a second, so a crash, of the program or of the machine,
//! costs what came since then and never the file.

mod container;
mod samples;
mod writer;

use std::path::{Path, PathBuf};

pub(crate) use container::{Header, HeaderFault, Kind, MAGIC, RawReader};
#[cfg(fuzzing)]
pub(crate) use container::{RECORD_HEAD_BYTES, crc32};
pub use container::{payloads, with_header};
pub(crate) use samples::SAMPLES_HEADER;
pub(crate) use writer::{ROOM, Recorder, Taps, start};

/// Where a run is written down.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordFiles {
    /// The bytes of the link: `replay:` plays them as if they came again. For links only: a log and the mock have none.
    pub raw: Option<PathBuf>,
    /// Every sample with the gate's verdict, CSV.
    pub samples: Option<PathBuf>,
}

impl RecordFiles {
    /// `tracker.holodraw` and `samples.csv` in `folder`, which must exist.
    pub fn in_folder(folder: &Path) -> Self {
        Self { raw: Some(folder.join("tracker.holodraw")), samples: Some(folder.join("samples.csv")) }
    }
}

/// Why a run cannot be written down.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum RecordError {
    /// The file cannot be made.
    #[error("recording {path}: {source}; {hint}")]
    Create { path: PathBuf, source: std::io::Error, hint: &'static str },
    /// The system gave no thread.
    #[error("no thread for the recording: {0}; free memory or raise the limit on threads")]
    Thread(std::io::Error),
}

/// How the writing goes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordStatus {
    /// Pieces of the link's bytes that found no room.
    pub chunks_lost: u64,
    /// Decisions that found no room.
    pub decisions_lost: u64,
    /// Why nothing is written any more: a full disk, for one.
    pub failure: Option<String>,
}
