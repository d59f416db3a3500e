//! Output directories that are never seen half written.

use std::fs;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use crate::failure::{Exit, Failure};

/// Files on their way into a directory: written beside it, moved in by rename when all are whole.
pub struct Staging {
    target: PathBuf,
    beside: TempDir,
}

impl Staging {
    /// Prepares to fill `target`, which may exist; its parent is created where it is missing.
    pub fn new(target: &Path) -> Result<Self, Failure> {
        let cannot = |error: std::io::Error| {
            Failure::new(
                Exit::CannotCreate,
                format!(
                    "cannot write into {}: {error}; name a directory that you may write to with --out",
                    target.display()
                ),
            )
        };
        if target.exists() && !target.is_dir() {
            return Err(Failure::new(
                Exit::CannotCreate,
                format!("cannot write into {}: it is a file; name a directory with --out", target.display()),
            ));
        }
        let parent = match target.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        fs::create_dir_all(parent).map_err(cannot)?;
        let beside = tempfile::Builder::new().prefix(".holod-partial-").tempdir_in(parent).map_err(cannot)?;
        Ok(Self { target: target.to_owned(), beside })
    }

    /// Where to write the file that will be called `name`.
    pub fn path(&self, name: &str) -> PathBuf {
        self.beside.path().join(name)
    }

    /// Moves every file into the target.
    pub fn commit(self) -> Result<(), Failure> {
        let cannot = |error: std::io::Error| {
            Failure::new(Exit::CannotCreate, format!("cannot move results into {}: {error}", self.target.display()))
        };
        fs::create_dir_all(&self.target).map_err(cannot)?;
        for entry in fs::read_dir(self.beside.path()).map_err(cannot)? {
            let entry = entry.map_err(cannot)?;
            fs::rename(entry.path(), self.target.join(entry.file_name())).map_err(cannot)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_appears_before_the_commit_and_nothing_stays_beside() {
        let root = tempfile::tempdir().unwrap();
        let target = root.path().join("a/out");
        let abandoned = Staging::new(&target).unwrap();
        fs::write(abandoned.path("x"), "half").unwrap();
        drop(abandoned);
        assert!(!target.exists());

        let staging = Staging::new(&target).unwrap();
        fs::write(staging.path("x"), "whole").unwrap();
        assert!(!target.exists());
        staging.commit().unwrap();
        assert_eq!(fs::read_to_string(target.join("x")).unwrap(), "whole");
        assert_eq!(fs::read_dir(root.path().join("a")).unwrap().count(), 1);
    }

    #[test]
    fn a_file_in_the_place_of_the_directory_is_refused() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("file");
        fs::write(&file, "precious").unwrap();
        let failure = Staging::new(&file).err().unwrap();
        assert_eq!(failure.exit, Exit::CannotCreate);
        assert_eq!(fs::read_to_string(&file).unwrap(), "precious");
    }
}
