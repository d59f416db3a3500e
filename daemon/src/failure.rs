//! What ends holod early, with its exit code.

use std::path::Path;
use std::{fmt, io};

/// Exit codes, after BSD's sysexits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// What was compared differs, as `cmp` says it.
    Different = 1,
    /// The command line asks for something that cannot be had.
    Usage = 64,
    /// An input file's content is wrong.
    Data = 65,
    /// An input file is missing or unreadable.
    NoInput = 66,
    /// A device or service is not there.
    Unavailable = 69,
    /// A fault of holod itself.
    Software = 70,
    /// An output cannot be created.
    CannotCreate = 73,
    /// Standard output takes no more.
    Output = 74,
    /// The rig file is wrong.
    Config = 78,
}

/// An error as the user sees it.
#[derive(Debug)]
pub struct Failure {
    /// The process's exit code.
    pub exit: Exit,
    message: String,
}

impl Failure {
    /// A failure that says `message`.
    pub fn new(exit: Exit, message: impl fmt::Display) -> Self {
        Self { exit, message: message.to_string() }
    }

    /// Turns any error into a failure with this exit code: `.map_err(Failure::because(Exit::Data))`.
    pub fn because<E: std::error::Error>(exit: Exit) -> impl Fn(E) -> Self {
        move |error| {
            let mut message = error.to_string();
            let mut source = error.source();
            while let Some(cause) = source {
                let cause_text = cause.to_string();
                if !message.contains(&cause_text) {
                    message.push_str(": ");
                    message.push_str(&cause_text);
                }
                source = cause.source();
            }
            Self { exit, message }
        }
    }
}

/// Whether there is a file at `path`.
///
/// # Errors
/// That cannot be told, as where its folder may not be entered.
pub fn is_file(path: &Path) -> Result<bool, Failure> {
    match path.metadata() {
        Ok(found) => Ok(found.is_file()),
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => Ok(false),
        Err(error) => Err(Failure::new(Exit::NoInput, format!("{}: {error}", path.display()))),
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn a_file_that_cannot_be_looked_at_is_not_taken_for_none() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("file"), "").unwrap();
        assert!(is_file(&at("file")).unwrap());
        for none in ["", "absent", "absent/deeper", "file/deeper"] {
            assert!(!is_file(&at(none)).unwrap(), "{none}");
        }
        // As a folder that may not be entered, which root enters all the same.
        symlink("circle", at("circle")).unwrap();
        let failure = is_file(&at("circle/file")).unwrap_err();
        assert_eq!(failure.exit, Exit::NoInput);
        assert!(failure.to_string().contains("circle/file: Too many levels of symbolic links"), "{failure}");
    }
}
