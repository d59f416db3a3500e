//! The results of commands: text or JSON on standard output, JSON and pictures in files.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use holod_calibration::write_atomically;
use image::DynamicImage;
use serde::{Serialize, Serializer};

use crate::failure::{Exit, Failure};
use crate::logging;

/// Prints lines on standard output, after what was said on standard error before. A reader that has gone away is no
/// failure.
///
/// # Errors
/// Standard output cannot be written.
pub fn print(text: &str) -> Result<(), Failure> {
    match write_stdout(text) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(stdout_failure(&error)),
        _ => Ok(()),
    }
}

/// The same, of what nobody can ask for a second time: a reader that has gone away is a failure, too.
///
/// # Errors
/// Standard output cannot be written.
pub fn print_once(text: &str) -> Result<(), Failure> {
    write_stdout(text).map_err(|error| stdout_failure(&error))
}

fn write_stdout(text: &str) -> io::Result<()> {
    logging::flush();
    let mut stdout = io::stdout().lock();
    writeln!(stdout, "{text}").and_then(|()| stdout.flush())
}

/// Standard output takes no more.
pub fn stdout_failure(error: &io::Error) -> Failure {
    Failure::new(Exit::Output, format!("cannot write to standard output: {error}"))
}

/// Prints a value as JSON.
pub fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    print(&to_json(value)?)
}

/// Saves a value as JSON.
pub fn save_json(value: &impl Serialize, path: &Path) -> Result<(), Failure> {
    let text = to_json(value)? + "\n";
    save(text.as_bytes(), path)
}

/// Saves a picture as PNG.
pub fn save_png(picture: impl Into<DynamicImage>, path: &Path) -> Result<(), Failure> {
    let mut bytes = io::Cursor::new(Vec::new());
    picture
        .into()
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|error| Failure::new(Exit::Software, format!("{}: {error}", path.display())))?;
    save(bytes.get_ref(), path)
}

/// Saves text as it is.
pub fn save_text(text: &str, path: &Path) -> Result<(), Failure> {
    save(text.as_bytes(), path)
}

fn save(bytes: &[u8], path: &Path) -> Result<(), Failure> {
    let cannot = |error| Failure::new(Exit::CannotCreate, format!("{}: {error}", path.display()));
    write_atomically(path, |out| out.write_all(bytes)).map_err(cannot)
}

/// The last part of a path, whatever bytes are in it.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Writes a path as text, whatever bytes are in it: JSON knows no others.
pub(crate) fn path_text<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    path.to_string_lossy().serialize(serializer)
}

/// The same of a path where there is one.
pub(crate) fn optional_path_text<S: Serializer>(path: &Option<PathBuf>, serializer: S) -> Result<S::Ok, S::Error> {
    path.as_ref().map(|path| path.to_string_lossy()).serialize(serializer)
}

/// The same of several.
pub(crate) fn paths_text<S: Serializer>(paths: &[PathBuf], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(paths.iter().map(|path| path.to_string_lossy()))
}

/// A value as JSON.
///
/// # Errors
/// It has no such form.
pub fn to_json(value: &impl Serialize) -> Result<String, Failure> {
    serde_json::to_string_pretty(value).map_err(Failure::because(Exit::Software))
}
