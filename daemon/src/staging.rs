//! Output directories that are never seen half written, and folders that are taken away again.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, Once, PoisonError};

pub(crate) use holod_calibration::folder_of;
use holod_calibration::hangup_is_ignored;
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};
use tempfile::TempDir;

use crate::failure::{Exit, Failure};
use crate::overwriting::refuse_existing;

/// Files on their way into a directory: written in a hidden folder on its disk, moved in by rename when all are whole.
/// What is half done when a signal ends the process is taken away first.
pub(crate) struct Staging {
    target: PathBuf,
    partial: TempDir,
    force: bool,
}

impl Staging {
    /// Prepares to fill `target`, which may exist, but holds none of `files` unless with `force`; its parent is created
    /// where it is missing.
    pub(crate) fn new(target: &Path, files: &[&str], force: bool) -> Result<Self, Failure> {
        // Beside a directory that is there one may not be allowed to write, or another disk begins.
        let folder = if target.is_dir() { target } else { folder_of(target) };
        Self::in_folder(folder, target, files, force)
    }

    /// Prepares to write the file `path`, which may exist with `force` only; nothing but its folder is touched, which
    /// is created where it is missing.
    pub(crate) fn of_file(path: &Path, force: bool) -> Result<Self, Failure> {
        let Some(name) = path.file_name().and_then(|name| name.to_str()) else {
            let what = format!("--out {}: expected the name of a file to write", path.display());
            return Err(Failure::new(Exit::CannotCreate, what));
        };
        let folder = folder_of(path);
        Self::in_folder(folder, folder, &[name], force)
    }

    /// Prepares to fill `target` by way of a folder in `folder`, which is on the same disk.
    fn in_folder(folder: &Path, target: &Path, files: &[&str], force: bool) -> Result<Self, Failure> {
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
        if !target.exists() && target.is_symlink() {
            let what = format!(
                "cannot write into {}: it is a link that leads nowhere; make the directory that it names, or name \
                 another one with --out",
                target.display()
            );
            return Err(Failure::new(Exit::CannotCreate, what));
        }
        refuse_existing(files.iter().map(|file| target.join(file)), "--out", force)?;
        fs::create_dir_all(folder).map_err(cannot)?;
        take_away_on_signals();
        let partial = half_done(|folders| {
            let partial = tempfile::Builder::new().prefix(".holod-partial-").tempdir_in(folder)?;
            folders.push(partial.path().to_owned());
            Ok(partial)
        });
        let partial = partial.map_err(cannot)?;
        Ok(Self { target: target.to_owned(), partial, force })
    }

    /// Where to write the file that will be called `name`.
    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.partial.path().join(name)
    }

    /// Moves every file into the target.
    pub(crate) fn commit(self) -> Result<(), Failure> {
        let cannot = |error: std::io::Error| {
            Failure::new(Exit::CannotCreate, format!("cannot move results into {}: {error}", self.target.display()))
        };
        let mut names = Vec::new();
        for entry in fs::read_dir(self.partial.path()).map_err(cannot)? {
            names.push(entry.map_err(cannot)?.file_name());
        }
        // Looked for again: it may have come meanwhile.
        refuse_existing(names.iter().map(|name| self.target.join(name)), "--out", self.force)?;
        if let Some(folder) = names.iter().map(|name| self.target.join(name)).find(|path| path.is_dir()) {
            let what = format!("{}: found a directory in the place of a file: move it away", folder.display());
            return Err(Failure::new(Exit::CannotCreate, what));
        }
        fs::create_dir_all(&self.target).map_err(cannot)?;
        for (moved, name) in names.iter().enumerate() {
            fs::rename(self.partial.path().join(name), self.target.join(name)).map_err(|error| {
                let new: Vec<_> = names[..moved].iter().map(|name| name.to_string_lossy()).collect();
                let new = if new.is_empty() { "none".into() } else { new.join(", ") };
                let (name, target) = (name.display(), self.target.display());
                let what = format!("cannot move {name} into {target}: {error}; of its files these are new: {new}");
                Failure::new(Exit::CannotCreate, what)
            })?;
        }
        Ok(())
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        half_done(|folders| folders.retain(|folder| folder != self.partial.path()));
    }
}

/// A folder for files that are needed for a while; it goes with this, and when a signal ends the process.
pub(crate) struct Temporary(TempDir);

impl Temporary {
    /// A new one in the folder for temporary files.
    ///
    /// # Errors
    /// It cannot be made.
    pub(crate) fn new(prefix: &str) -> std::io::Result<Self> {
        take_away_on_signals();
        half_done(|folders| {
            let folder = tempfile::Builder::new().prefix(prefix).tempdir()?;
            folders.push(folder.path().to_owned());
            Ok(Self(folder))
        })
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        half_done(|folders| folders.retain(|folder| folder != self.0.path()));
    }
}

static HALF_DONE: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());
/// A run obeys signals itself, and puts its lasers out first.
static OBEYED_ELSEWHERE: AtomicBool = AtomicBool::new(false);

fn half_done<T>(with: impl FnOnce(&mut Vec<PathBuf>) -> T) -> T {
    with(&mut HALF_DONE.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Leaves signals to a run, or takes them back from it.
pub(crate) fn leave_signals_to_a_run(left: bool) {
    OBEYED_ELSEWHERE.store(left, Ordering::Release);
}

/// Starts the thread that waits for signals, once. Where there can be none, signals end the process as ever.
fn take_away_on_signals() {
    static STARTED: Once = Once::new();
    STARTED.call_once(|| {
        let hangup = (!hangup_is_ignored()).then_some(SIGHUP);
        let ending = [SIGINT, SIGTERM, SIGQUIT].into_iter().chain(hangup);
        let Ok(mut signals) = signal_hook::iterator::Signals::new(ending) else { return };
        let wait = move || {
            for signal in signals.forever() {
                if !OBEYED_ELSEWHERE.load(Ordering::Acquire) {
                    half_done(|folders| folders.iter().for_each(|folder| remove(folder)));
                    std::process::exit(128 + signal);
                }
            }
        };
        let _ = std::thread::Builder::new().name("holod-signals".into()).spawn(wait);
    });
}

/// Removes a folder into which somebody may still be writing.
fn remove(folder: &Path) {
    for _ in 0..100 {
        if fs::remove_dir_all(folder).is_ok() || !folder.exists() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::MetadataExt;

    use super::*;

    #[test]
    fn nothing_appears_before_the_commit_and_nothing_stays_beside() {
        let root = tempfile::tempdir().unwrap();
        let target = root.path().join("a/out");
        let abandoned = Staging::new(&target, &["x"], false).unwrap();
        fs::write(abandoned.path("x"), "half").unwrap();
        drop(abandoned);
        assert!(!target.exists());

        let staging = Staging::new(&target, &["x"], false).unwrap();
        fs::write(staging.path("x"), "whole").unwrap();
        assert!(!target.exists());
        staging.commit().unwrap();
        assert_eq!(fs::read_to_string(target.join("x")).unwrap(), "whole");
        assert_eq!(fs::read_dir(root.path().join("a")).unwrap().count(), 1);
    }

    #[test]
    fn a_link_that_leads_nowhere_is_refused_at_once() {
        let root = tempfile::tempdir().unwrap();
        let link = root.path().join("out");
        std::os::unix::fs::symlink("nowhere", &link).unwrap();
        let refused = Staging::new(&link, &["x"], true).err().unwrap();
        assert_eq!(refused.exit, Exit::CannotCreate);
        assert!(refused.to_string().contains("is a link that leads nowhere; make the directory"), "{refused}");
        fs::create_dir(root.path().join("nowhere")).unwrap();
        assert!(Staging::new(&link, &["x"], false).is_ok());
    }

    #[test]
    fn what_is_there_is_overwritten_by_force_only() {
        let root = tempfile::tempdir().unwrap();
        let target = root.path().join("out");
        fs::create_dir(&target).unwrap();
        let early = Staging::new(&target, &["x"], false).unwrap();
        fs::write(early.path("x"), "new").unwrap();
        fs::write(target.join("x"), "precious").unwrap();
        assert_eq!(Staging::new(&target, &["x"], false).err().unwrap().exit, Exit::CannotCreate);
        assert_eq!(early.commit().unwrap_err().exit, Exit::CannotCreate, "it has come meanwhile");
        assert_eq!(fs::read_to_string(target.join("x")).unwrap(), "precious");
        assert!(Staging::new(&target, &["y"], false).is_ok(), "other files are in nobody's way");
        let forced = Staging::new(&target, &["x"], true).unwrap();
        fs::write(forced.path("x"), "new").unwrap();
        forced.commit().unwrap();
        assert_eq!(fs::read_to_string(target.join("x")).unwrap(), "new");
    }

    #[test]
    fn a_directory_in_the_place_of_a_file_leaves_all_as_it_was() {
        let root = tempfile::tempdir().unwrap();
        for blocked in ["a", "b", "c"] {
            let target = root.path().join(blocked);
            fs::create_dir_all(target.join(blocked).join("full")).unwrap();
            let names = ["a", "b", "c"];
            names.iter().filter(|name| **name != blocked).for_each(|name| fs::write(target.join(name), "old").unwrap());
            let staging = Staging::new(&target, &names, true).unwrap();
            names.iter().for_each(|name| fs::write(staging.path(name), "new").unwrap());
            let refused = staging.commit().unwrap_err();
            assert_eq!(refused.exit, Exit::CannotCreate);
            let says = format!("{}: found a directory in the place of a file", target.join(blocked).display());
            assert!(refused.to_string().contains(&says), "{refused}");
            for name in names.iter().filter(|name| **name != blocked) {
                assert_eq!(fs::read_to_string(target.join(name)).unwrap(), "old");
            }
        }
    }

    #[test]
    fn a_directory_that_is_there_is_filled_by_way_of_itself_and_one_that_is_not_by_way_of_its_parent() {
        let root = tempfile::tempdir().unwrap();
        let target = root.path().join("out");
        let partial_in = |staging: &Staging| staging.partial.path().parent().unwrap().to_owned();
        assert_eq!(partial_in(&Staging::new(&target, &[], false).unwrap()), root.path());
        fs::create_dir(&target).unwrap();
        let staging = Staging::new(&target, &["x"], false).unwrap();
        assert_eq!(partial_in(&staging), target);
        fs::write(staging.path("x"), "whole").unwrap();
        staging.commit().unwrap();
        let left: Vec<_> = fs::read_dir(&target).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(left, ["x"]);
    }

    #[test]
    fn a_directory_on_another_disk_than_its_parent_is_filled() {
        let Ok(elsewhere) = tempfile::tempdir_in("/dev/shm") else {
            eprintln!("skipped: nothing can be written into /dev/shm");
            return;
        };
        let root = tempfile::tempdir().unwrap();
        if fs::metadata(elsewhere.path()).unwrap().dev() == fs::metadata(root.path()).unwrap().dev() {
            eprintln!("skipped: /dev/shm is no other file system than {}", root.path().display());
            return;
        }
        let target = root.path().join("out");
        std::os::unix::fs::symlink(elsewhere.path(), &target).unwrap();
        let staging = Staging::new(&target, &["x"], false).unwrap();
        fs::write(staging.path("x"), "whole").unwrap();
        staging.commit().unwrap();
        assert_eq!(fs::read_to_string(elsewhere.path().join("x")).unwrap(), "whole");
        assert_eq!(fs::read_dir(elsewhere.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_single_file_needs_no_more_than_its_own_folder() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("there/report");
        let staging = Staging::of_file(&path, false).unwrap();
        fs::write(staging.path("report"), "whole").unwrap();
        let beside = |folder: &Path| fs::read_dir(folder).unwrap().count();
        assert_eq!((beside(root.path()), beside(&root.path().join("there"))), (1, 1), "half done within its folder");
        staging.commit().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "whole");
        assert_eq!(beside(&root.path().join("there")), 1);
        assert_eq!(Staging::of_file(&path, false).err().unwrap().exit, Exit::CannotCreate);
        assert!(Staging::of_file(&path, true).is_ok());
        assert_eq!(Staging::of_file(Path::new("/"), true).err().unwrap().exit, Exit::CannotCreate);
    }

    #[test]
    fn a_file_in_the_place_of_the_directory_is_refused() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("file");
        fs::write(&file, "precious").unwrap();
        let failure = Staging::new(&file, &[], true).err().unwrap();
        assert_eq!(failure.exit, Exit::CannotCreate);
        assert_eq!(fs::read_to_string(&file).unwrap(), "precious");
    }
}
