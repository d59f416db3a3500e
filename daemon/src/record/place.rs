//! A record's folder itself, wherever it is moved while its run goes on.

use std::fs::{self, File};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::failure::Failure;

/// A folder that is held on to. Another one may come to its path, which may be another run's record: whatever is
/// written or taken away is so by [`Self::itself`].
#[derive(Debug)]
pub(crate) struct Place {
    path: PathBuf,
    folder: File,
}

impl Place {
    /// The folder that is at `path` now.
    pub(super) fn hold(path: &Path) -> io::Result<Self> {
        Ok(Self { path: path.to_owned(), folder: File::open(path)? })
    }

    /// Where it was when it was taken hold of, as it was named.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// A path to the folder for as long as this lives, wherever it is.
    pub(crate) fn itself(&self) -> PathBuf {
        format!("/proc/self/fd/{}", self.folder.as_raw_fd()).into()
    }

    /// Where it is now, if not at its path; nothing where that cannot be told.
    pub(super) fn moved_to(&self) -> Option<PathBuf> {
        match fs::metadata(&self.path) {
            Ok(found) if is_one(&found, &self.folder.metadata().ok()?) => None,
            Err(error) if error.kind() != io::ErrorKind::NotFound => None,
            _ => fs::read_link(self.itself()).ok(),
        }
    }

    /// A text with the name of the folder in place of [`Self::itself`].
    pub(super) fn named(&self, text: &str) -> String {
        let (itself, path) = (self.itself(), self.path.to_string_lossy());
        let itself = itself.to_string_lossy();
        // What has more digits is another descriptor.
        let parts: Vec<&str> = text.split(&*itself).collect();
        let mut named = parts[0].to_owned();
        for part in &parts[1..] {
            named.push_str(if part.starts_with(|c: char| c.is_ascii_digit()) { &itself } else { &path });
            named.push_str(part);
        }
        named
    }

    /// A failure whose text is [so](Self::named).
    pub(super) fn told(&self, failure: &Failure) -> Failure {
        Failure::new(failure.exit, self.named(&failure.to_string()))
    }

    /// Keeps other runs out for as long as this lives.
    pub(super) fn lock(&self) -> Result<(), fs::TryLockError> {
        self.folder.try_lock()
    }
}

/// Whether an open file is still at its path; one that was deleted or moved away is missing in the record.
pub(super) fn judge_file(file: &File, path: &Path) -> io::Result<()> {
    let own = file.metadata()?;
    let is_there = match fs::metadata(path) {
        Ok(found) => is_one(&found, &own),
        Err(error) => error.kind() != io::ErrorKind::NotFound,
    };
    let missing = || io::Error::new(io::ErrorKind::NotFound, "the file was deleted or moved");
    if is_there { Ok(()) } else { Err(missing()) }
}

fn is_one(a: &fs::Metadata, b: &fs::Metadata) -> bool {
    (a.dev(), a.ino()) == (b.dev(), b.ino())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_reached_wherever_it_is_and_no_other_one_is_taken_for_it() {
        let root = tempfile::tempdir().unwrap();
        let [path, elsewhere] = ["record", "elsewhere"].map(|name| root.path().join(name));
        fs::create_dir(&path).unwrap();
        let place = Place::hold(&path).unwrap();
        let file = File::create(place.itself().join("file")).unwrap();
        assert_eq!(place.moved_to(), None);
        fs::rename(&path, &elsewhere).unwrap();
        for is_another_there in [false, true] {
            assert_eq!(place.moved_to(), Some(elsewhere.canonicalize().unwrap()));
            let name = format!("mine-{is_another_there}");
            fs::write(place.itself().join(&name), "").unwrap();
            assert!(elsewhere.join(&name).exists() && !path.join(&name).exists());
            fs::create_dir_all(&path).unwrap();
        }
        let text = place.named(&format!("{}: full", place.itself().join("file").display()));
        assert_eq!(text, format!("{}: full", path.join("file").display()));
        let others = format!("{}7/file: full", place.itself().display());
        assert_eq!(place.named(&others), others);
        fs::remove_dir(&path).unwrap();
        fs::rename(&elsewhere, &path).unwrap();
        assert_eq!(place.moved_to(), None);

        judge_file(&file, &path.join("file")).unwrap();
        fs::rename(path.join("file"), path.join("old")).unwrap();
        assert!(judge_file(&file, &path.join("file")).is_err());
        fs::write(path.join("file"), "another").unwrap();
        assert!(judge_file(&file, &path.join("file")).unwrap_err().to_string().contains("deleted or moved"));
    }
}
