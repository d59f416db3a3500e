//! The folder that a run records into.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::sources::{self, BENCH};
use super::{FILES, shown_levels};
use crate::destination::refuse_existing;
use crate::failure::{Exit, Failure};

/// A folder that a run records into. Dropping it takes the run's files away again, so that the same folder may be
/// named again, unless it was told to [keep](Self::keep) them.
#[derive(Debug)]
pub(crate) struct RecordFolder {
    path: PathBuf,
    /// Nothing was there before.
    is_new: bool,
    is_kept: bool,
}

impl RecordFolder {
    /// The folder at `path`, which is created where it is missing. A record that is there is overwritten with `force`
    /// only; other files stay.
    ///
    /// # Errors
    /// A record is there, or the folder cannot be written.
    pub(crate) fn claim(path: &Path, force: bool) -> Result<Self, Failure> {
        let cannot = |error: io::Error| {
            let what = format!("cannot record into {}: {error}; name another directory with --record", path.display());
            Failure::new(Exit::CannotCreate, what)
        };
        let is_new = !path.exists();
        fs::create_dir_all(path).map_err(cannot)?;
        let earlier = files_of(path).map_err(cannot)?;
        refuse_existing(earlier.iter().map(|file| path.join(file)).chain([path.join(BENCH)]), "--record", force)?;
        remove_files(path).map_err(cannot)?;
        Ok(Self { path: path.to_owned(), is_new, is_kept: false })
    }

    /// Where it is.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The record is worth keeping.
    pub(crate) fn keep(&mut self) {
        self.is_kept = true;
    }

    fn give_up(&self) -> io::Result<()> {
        remove_files(&self.path)?;
        if self.is_new {
            // Fails where something else is in it, which then stays.
            let _ = fs::remove_dir(&self.path);
        }
        Ok(())
    }
}

impl Drop for RecordFolder {
    fn drop(&mut self) {
        if !self.is_kept
            && let Err(error) = self.give_up()
            && error.kind() != io::ErrorKind::NotFound
        {
            tracing::warn!("files without a frame stay in {}: {error}; take them away", self.path.display());
        }
    }
}

/// The files of the record in `folder`, by their paths in it.
fn files_of(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files: Vec<_> = FILES.iter().map(PathBuf::from).collect();
    files.extend(shown_levels(folder)?.into_iter().map(PathBuf::from));
    files.extend(sources::names_of_bench(folder)?.into_iter().map(|name| Path::new(BENCH).join(name)));
    files.retain(|file| folder.join(file).symlink_metadata().is_ok());
    Ok(files)
}

/// Takes the record out of `folder`; what somebody else has put there stays.
fn remove_files(folder: &Path) -> io::Result<()> {
    for file in files_of(folder)? {
        fs::remove_file(folder.join(file))?;
    }
    // Fails where something else is in it, which then stays.
    let _ = fs::remove_dir(folder.join(BENCH));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One of each kind of a record's files, and others.
    const OF_RECORD: [&str; 6] = [
        "frames.csv",
        "samples.csv",
        "tracker.holodraw",
        "summary.json",
        "bench/rig.toml",
        "shown_pupil_3.00mm_frame_000001.png",
    ];
    const OTHERS: [&str; 3] = ["notes.txt", "shown.png", "bench/notes.txt"];

    fn put(folder: &Path, names: &[&str], text: &str) {
        for name in names {
            let path = folder.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
    }

    fn holds(folder: &Path, names: &[&str], text: &str) -> bool {
        names.iter().all(|name| fs::read_to_string(folder.join(name)).is_ok_and(|found| found == text))
    }

    fn holds_none(folder: &Path, names: &[&str]) -> bool {
        names.iter().all(|name| !folder.join(name).exists())
    }

    #[test]
    fn each_file_of_a_record_is_overwritten_by_force_only() {
        for name in OF_RECORD.into_iter().chain(["bench/notes.txt"]) {
            let folder = tempfile::tempdir().unwrap();
            put(folder.path(), &[name], "old");
            let failure = RecordFolder::claim(folder.path(), false).unwrap_err();
            assert_eq!(failure.exit, Exit::CannotCreate, "{name}");
            assert!(failure.to_string().contains("overwrite it with --force"), "{failure}");
            assert!(holds(folder.path(), &[name], "old"), "{name}");
        }
        let folder = tempfile::tempdir().unwrap();
        put(folder.path(), &OF_RECORD, "old");
        put(folder.path(), &OTHERS, "others");
        RecordFolder::claim(folder.path(), true).unwrap().keep();
        assert!(holds_none(folder.path(), &OF_RECORD) && holds(folder.path(), &OTHERS, "others"));
    }

    #[test]
    fn what_is_not_kept_is_taken_away_with_a_folder_that_was_not_there() {
        let root = tempfile::tempdir().unwrap();
        let (new, there) = (root.path().join("a/new"), root.path().join("there"));
        put(&there, &OTHERS[..2], "others");
        for path in [&new, &there] {
            let _given_up = RecordFolder::claim(path, false).unwrap();
            put(path, &OF_RECORD, "new");
        }
        assert!(!new.exists());
        assert!(holds_none(&there, &OF_RECORD) && !there.join(BENCH).exists() && holds(&there, &OTHERS[..2], "others"));

        let mut kept = RecordFolder::claim(&new, false).unwrap();
        put(&new, &OF_RECORD, "new");
        kept.keep();
        drop(kept);
        assert!(holds(&new, &OF_RECORD, "new"));
    }
}
