//! A report of what went wrong, in one file: a record of a run, its bench, log and scenes, and facts of the machine,
//! without names of people or machines. The page is `daemon/doc/report.md`.
//!
//! | Part | Does |
//! |---|---|
//! | `pack` | gathers it, and says what was left out |
//! | `scrub` | takes names out of text |
//! | `unpack` | takes a report apart, whoever made it |
//! | `recorded` | reads which frames were made, and of what |
//! | `play` | lets the loop make them again |
//! | `comparison` | compares them |

mod comparison;
#[cfg(fuzzing)]
pub mod fuzzing;
mod pack;
mod play;
mod recorded;
mod scrub;
mod unpack;

use std::io;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

pub use self::comparison::{Comparison, Outcome};
pub use self::pack::{Contents, default_name};
pub use self::play::{Played, prepare};
pub use self::scrub::Scrubber;
pub use self::unpack::{Unpacked, is_archive, refuse_archive, unpack};
use crate::machine::Machine;
use crate::record::content_xxh3;

/// The folder in the archive.
const FOLDER: &str = "holod-report";
/// What the archive says of itself, in [`FOLDER`].
const MANIFEST: &str = "report.json";
/// The folder of the scene with which the run began; that of an order is [`order_folder`].
const SCENE_FOLDER: &str = "scene";

/// Text that is read as a whole to be scrubbed; more of a log is cut off.
const LARGEST_TEXT: u64 = 256 << 20;

/// Which side of a copy failed.
#[derive(Debug)]
enum Copy {
    Read(io::Error),
    Write(io::Error),
}

/// The folder of what an order brought.
fn order_folder(order: u32) -> String {
    format!("order-{order}")
}

/// What a report says of itself; `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Which kind of report.
    pub format: Format,
    /// What `holod --version` says of the holod that packed it.
    pub holod: String,
    /// When: milliseconds since 1970.
    pub packed_unix_ms: u64,
    /// The machine on which it was packed.
    pub machine: Machine,
    /// Every file but this one.
    pub files: Vec<Packed>,
    /// What is not in it, and why.
    pub left_out: Vec<String>,
}

/// The layout of a report, by its name in the manifest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Format {
    /// A gzipped tar archive with the manifest `report.json`.
    #[serde(rename = "holod-report-1")]
    First,
}

impl Manifest {
    /// That of this moment, without files.
    fn now(left_out: Vec<String>) -> Self {
        Self {
            format: Format::First,
            holod: env!("HOLOD_VERSION").into(),
            packed_unix_ms: unix_ms(),
            machine: Machine::this(),
            files: Vec::new(),
            left_out,
        }
    }
}

fn unix_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

/// A file in a report.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Packed {
    /// Its name within the report.
    pub name: String,
    /// Its length in bytes, uncompressed.
    pub bytes: u64,
    /// XXH3 of 64 bits of its content, hexadecimal.
    pub xxh3: String,
}

impl Packed {
    fn of(name: &str, mut content: &[u8]) -> Self {
        let (bytes, xxh3) = content_xxh3(&mut content).expect("memory can be read");
        Self { name: name.to_owned(), bytes, xxh3 }
    }
}
