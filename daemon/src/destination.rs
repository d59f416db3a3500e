//! Where one file of results goes, and whether something is there already: the same rule for every command.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use crate::failure::{Exit, Failure};
use crate::results;

/// A file, or standard output where `-` is named.
#[derive(Debug)]
pub(crate) enum Destination {
    /// A file that is written beside its place and renamed.
    File(PathBuf),
    /// The standard output.
    Stdout,
}

impl Destination {
    /// The place that `option` names. What is there already is overwritten with `force` only.
    ///
    /// # Errors
    /// A file is there already, or a directory.
    pub(crate) fn new(path: &Path, option: &str, force: bool) -> Result<Self, Failure> {
        if path == Path::new("-") {
            return Ok(Self::Stdout);
        }
        if path.is_dir() {
            return Err(Failure::new(
                Exit::CannotCreate,
                format!("{option} {}: found a directory, expected the name of a file to write", path.display()),
            ));
        }
        refuse_existing([path.to_owned()], option, force)?;
        Ok(Self::File(path.to_owned()))
    }

    /// Whether results go where reports usually do, so that these must not.
    pub(crate) const fn is_stdout(&self) -> bool {
        matches!(self, Self::Stdout)
    }

    /// Lets `write` write the file.
    ///
    /// # Errors
    /// That of `write`, or standard output takes no more.
    pub(crate) fn write(&self, write: impl FnOnce(&Path) -> Result<(), Failure>) -> Result<(), Failure> {
        match self {
            Self::File(path) => write(path),
            Self::Stdout => {
                let folder = tempfile::tempdir().map_err(Failure::because(Exit::CannotCreate))?;
                let path = folder.path().join("out");
                write(&path)?;
                let copied = File::open(&path).and_then(|mut file| io::copy(&mut file, &mut io::stdout().lock()));
                match copied {
                    Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(results::stdout_failure(&error)),
                    _ => Ok(()),
                }
            }
        }
    }
}

/// Refuses to overwrite any of `paths`, unless with `force`.
///
/// # Errors
/// One of them is there already.
pub(crate) fn refuse_existing(
    paths: impl IntoIterator<Item = PathBuf>,
    option: &str,
    force: bool,
) -> Result<(), Failure> {
    match paths.into_iter().find(|path| !force && path.symlink_metadata().is_ok()) {
        None => Ok(()),
        Some(path) => Err(Failure::new(
            Exit::CannotCreate,
            format!(
                "{} exists already; name another place with {option}, or overwrite it with --force",
                path.display()
            ),
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_there_is_overwritten_by_force_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let put = |text: &'static str, force| {
            let destination = Destination::new(&path, "--out", force)?;
            destination.write(|path| std::fs::write(path, text).map_err(Failure::because(Exit::CannotCreate)))
        };
        put("first", false).unwrap();
        let refused = put("second", false).unwrap_err();
        assert_eq!(refused.exit, Exit::CannotCreate);
        assert!(refused.to_string().contains("a.png exists already") && refused.to_string().contains("--force"));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "first");
        put("third", true).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "third");
        assert!(Destination::new(folder.path(), "--out", true).is_err(), "a directory is no file");
        assert!(Destination::new(Path::new("-"), "--out", false).unwrap().is_stdout());
    }
}
