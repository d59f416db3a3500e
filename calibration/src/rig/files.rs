//! The files that a rig file names.

use std::fs;
use std::path::Path;

use crate::toml_reader::Fault;

/// What is wrong with a file that the rig file names.
pub(super) struct FileFault {
    /// What was found, with the file's name.
    pub(super) found: String,
    /// What it may be.
    pub(super) expected: String,
    /// What to do about it.
    pub(super) advice: String,
}

/// Larger than any text file that belongs to a rig.
pub(super) const TEXT_BYTES_MAX: u64 = 4 << 20;
/// Larger than any picture of a panel.
pub(super) const PICTURE_BYTES_MAX: u64 = 256 << 20;

impl FileFault {
    /// `path` cannot be opened or read.
    pub(super) fn unreadable(path: &Path, why: &std::io::Error) -> Self {
        Self {
            found: format!("{}: {why}", path.display()),
            expected: "a file that can be read".into(),
            advice: "correct the path (a relative one starts at the rig file's folder) or the file's permissions"
                .into(),
        }
    }

    /// The fault as one of the rig file itself.
    pub(super) fn of_rig_file(self) -> Fault {
        Fault { key: String::new(), line: None, found: self.found, expected: self.expected, advice: self.advice }
    }
}

/// Fails unless `path` is a plain file; returns its length in bytes.
pub(super) fn plain_file(path: &Path) -> Result<u64, FileFault> {
    let metadata = fs::metadata(path).map_err(|why| FileFault::unreadable(path, &why))?;
    if metadata.is_file() {
        return Ok(metadata.len());
    }
    let kind = if metadata.is_dir() { "a directory" } else { "no plain file" };
    Err(FileFault {
        found: format!("{}: {kind}", path.display()),
        expected: "a file".into(),
        advice: "name the file itself".into(),
    })
}

/// The bytes of a plain file that is a `kind` of at most `bytes_max`.
pub(super) fn read_bytes(path: &Path, kind: &str, bytes_max: u64) -> Result<Vec<u8>, FileFault> {
    let length = plain_file(path)?;
    if length > bytes_max {
        return Err(FileFault {
            found: format!("{}: {length} bytes", path.display()),
            expected: format!("a {kind} of at most {bytes_max} bytes"),
            advice: "name the right file".into(),
        });
    }
    fs::read(path).map_err(|why| FileFault::unreadable(path, &why))
}

/// The text of a small file, without the byte-order mark that spreadsheets write before it.
pub(super) fn read_text(path: &Path) -> Result<String, FileFault> {
    text_of(read_bytes(path, "text", TEXT_BYTES_MAX)?, path)
}

/// The bytes of the file at `path` as text, without that mark.
pub(super) fn text_of(bytes: Vec<u8>, path: &Path) -> Result<String, FileFault> {
    let mut text = String::from_utf8(bytes).map_err(|why| {
        let valid = why.utf8_error().valid_up_to();
        let line = 1 + why.as_bytes()[..valid].iter().filter(|&&b| b == b'\n').count();
        FileFault {
            found: format!("{}: line {line} is not UTF-8", path.display()),
            expected: "a text in UTF-8".into(),
            advice: "save the file as UTF-8".into(),
        }
    })?;
    if text.starts_with('\u{feff}') {
        text.remove(0);
    }
    Ok(text)
}
