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

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

pub use csv::write_csv;
pub use lines::write_lines;

/// Why a recording could not be written. Nothing has been changed then.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The file cannot be written.
    #[error("cannot write {path}: {source}; expected a path in a folder that can be written to, with room on its disk")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The line protocol is in millimetres and the recording is not.
    #[error(
        "cannot write {path} in holod's line protocol: its diameters are millimetres, and those of the recording are \
         {unit}; measure a printed disc of known diameter with the tracker and give the scale (its millimetres / its \
         {unit}), or write CSV, which keeps the unit"
    )]
    NoScale {
        /// The file.
        path: PathBuf,
        /// The recording's unit.
        unit: &'static str,
    },
    /// The scale is no factor.
    #[error("cannot write {path}: found a scale of {scale}; expected millimetres per unit, a number above 0")]
    BadScale {
        /// The file.
        path: PathBuf,
        /// The scale.
        scale: f64,
    },
}

/// Bytes written at a time.
const BUFFER_BYTES: usize = 1 << 16;

/// Writes a file whole or not at all.
fn atomically(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), ExportError> {
    whole(path, write).map_err(|source| ExportError::Io { path: path.into(), source })
}

fn whole(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let name = path.file_name().ok_or_else(|| io::Error::other("it names no file"))?;
    if path.is_dir() {
        return Err(io::Error::other("it is a directory"));
    }
    let mut beside = OsString::from(".");
    beside.push(name);
    beside.push(format!(".{}.part", std::process::id()));
    let beside = path.with_file_name(beside);
    let written = written(&beside, write).and_then(|()| fs::rename(&beside, path));
    if written.is_err() {
        // Whatever is left of it; that it was never there is no second error.
        let _ = fs::remove_file(&beside);
    }
    written?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // The file is in its place and whole; that a folder cannot be synced, as on some network disks, does not undo that.
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
    Ok(())
}

fn written(beside: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let file = OpenOptions::new().write(true).create(true).truncate(true).open(beside)?;
    let mut writer = BufWriter::with_capacity(BUFFER_BYTES, file);
    write(&mut writer)?;
    writer.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_what_was_there_and_nothing_else() {
        let dir = tempfile::TempDir::new().expect("a folder");
        let path = dir.path().join("out.csv");
        atomically(&path, |out| out.write_all(b"before")).expect("writes");
        let failed = atomically(&path, |out| {
            out.write_all(&[b'x'; 2 * BUFFER_BYTES])?;
            Err(io::Error::other("no room"))
        });
        assert!(failed.expect_err("failed").to_string().contains("no room"));
        assert_eq!(fs::read(&path).expect("reads"), b"before");
        assert_eq!(fs::read_dir(dir.path()).expect("reads").count(), 1);
        atomically(&path, |out| out.write_all(b"after")).expect("writes");
        assert_eq!(fs::read(&path).expect("reads"), b"after");
        for nowhere in [dir.path(), &dir.path().join("no/such/folder"), Path::new("/")] {
            assert!(atomically(nowhere, |_| Ok(())).is_err(), "{}", nowhere.display());
        }
        assert_eq!(fs::read_dir(dir.path()).expect("reads").count(), 1);
    }
}
