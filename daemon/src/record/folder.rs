//! The folder that a run records into: one run at a time, and a record that is there goes only once another one has
//! taken its place. Until then it waits in a hidden folder beside, whose name says how far that is: what a run that was
//! killed leaves is put right by the next one that records there.

use std::fs::{self, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use super::place::Place;
use super::sources::{self, BENCH};
use super::{FILES, shown_levels};
use crate::failure::{Exit, Failure};
use crate::overwriting::refuse_existing;

/// Part of an earlier record, on its way from its place or back to it.
const MOVING: &str = ".holod-earlier-moving";
/// An earlier record, whole.
pub(crate) const EARLIER: &str = ".holod-earlier";
/// An earlier record whose place another one has taken.
const REPLACED: &str = ".holod-earlier-replaced";

/// A folder that a run records into. Dropping it takes the run's files away again, so that the same folder may be
/// named again, and puts an earlier record back, unless it was told to [keep](Self::keep) them.
#[derive(Debug)]
pub(crate) struct RecordFolder {
    /// Locked while somebody records there.
    place: Arc<Place>,
    /// Nothing was there before.
    is_new: bool,
    /// An earlier record waits for what becomes of this one.
    earlier_waits: bool,
    is_kept: bool,
}

impl RecordFolder {
    /// The folder at `path`, which is created where it is missing. A record that is there is overwritten with `force`
    /// only; other files stay.
    ///
    /// # Errors
    /// A record is there, another process records there, or the folder cannot be written.
    pub(crate) fn claim(path: &Path, force: bool) -> Result<Self, Failure> {
        let cannot = |error: io::Error| refused(path, error, "--record");
        let is_new = !path.exists();
        fs::create_dir_all(path).map_err(cannot)?;
        let place = Place::hold(path).map_err(cannot)?;
        match place.lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let found = format!("cannot record into {}: another holod records there", path.display());
                let what = format!("{found}; end it, or name another directory with --record");
                return Err(Failure::new(Exit::CannotCreate, what));
            }
            Err(TryLockError::Error(error)) => {
                tracing::warn!("{}: cannot find out whether another holod records there: {error}", path.display());
            }
        }
        let itself = place.itself();
        restore(&itself).map_err(cannot)?;
        let earlier = files_of(&itself).map_err(cannot)?;
        refuse_existing(earlier.iter().map(|file| path.join(file)).chain([path.join(BENCH)]), "--record", force)?;
        if !earlier.is_empty() {
            set_aside(&itself).map_err(|error| match restore(&itself) {
                Ok(()) => cannot(error),
                Err(_) => cannot(io::Error::new(error.kind(), format!("{error}; part of it is in {MOVING} there"))),
            })?;
        }
        Ok(Self { place: Arc::new(place), is_new, earlier_waits: !earlier.is_empty(), is_kept: false })
    }

    /// Refuses inputs of a run that are files of the record at `path`, which [`Self::claim`] with `force` would move
    /// away before they are read; a directory that has such a file in it, too.
    ///
    /// # Errors
    /// One of the inputs is.
    pub(crate) fn refuse_as_inputs<'a>(
        path: &Path,
        inputs: impl IntoIterator<Item = (&'a str, PathBuf)>,
    ) -> Result<(), Failure> {
        let of_record: Vec<_> =
            files_of(path).unwrap_or_default().iter().filter_map(|file| path.join(file).canonicalize().ok()).collect();
        for (option, input) in inputs {
            if let Ok(whole) = input.canonicalize()
                && of_record.iter().any(|file| *file == whole || whole.is_dir() && file.parent() == Some(&*whole))
            {
                let what = format!(
                    "{option}: {} is of the record in {}, which --force overwrites; record into another directory, or copy \
                     the file elsewhere and name the copy",
                    input.display(),
                    path.display()
                );
                return Err(Failure::new(Exit::Usage, what));
            }
        }
        Ok(())
    }

    /// A folder of its own in `parent` for a run that starts `now`, whose name is the time.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub(crate) fn claim_new(parent: &Path, now: SystemTime) -> Result<Self, Failure> {
        let cannot = |error: io::Error| refused(parent, error, "--record-in");
        fs::create_dir_all(parent).map_err(cannot)?;
        let time = humantime::format_rfc3339_seconds(now).to_string().replace(':', "-");
        let mut path = parent.join(&time);
        let mut start = 1;
        // Whoever has made it has it: several may start within one second.
        while let Err(error) = fs::create_dir(&path) {
            if error.kind() != io::ErrorKind::AlreadyExists {
                return Err(cannot(error));
            }
            start += 1;
            path = parent.join(format!("{time}-{start}"));
        }
        let mut folder = Self::claim(&path, false)?;
        folder.is_new = true;
        Ok(folder)
    }

    /// Where it was when it was claimed.
    pub(crate) fn path(&self) -> &Path {
        self.place.path()
    }

    pub(super) fn place(&self) -> Arc<Place> {
        Arc::clone(&self.place)
    }

    /// Whether there is an earlier record whose place this one has not taken.
    pub(crate) const fn earlier_waits(&self) -> bool {
        self.earlier_waits
    }

    /// The record is worth keeping; an earlier one goes.
    ///
    /// # Errors
    /// The earlier one cannot be moved, and will be put back.
    pub(crate) fn keep(&mut self) -> Result<(), Failure> {
        if self.earlier_waits {
            let path = self.path().display();
            let [earlier, replaced] = [EARLIER, REPLACED].map(|name| self.place.itself().join(name));
            fs::rename(earlier, &replaced).map_err(|error| {
                let what = format!("cannot take the place of the earlier record in {path}: {error}");
                Failure::new(Exit::CannotCreate, what)
            })?;
            if let Err(error) = fs::remove_dir_all(&replaced) {
                tracing::warn!("the earlier record stays in {path}/{REPLACED}: {error}; take it away");
            }
            self.earlier_waits = false;
        }
        self.is_kept = true;
        Ok(())
    }

    fn give_up(&self) -> io::Result<()> {
        if self.earlier_waits {
            return restore(&self.place.itself());
        }
        remove_files(&self.place.itself())?;
        if self.is_new && self.place.moved_to().is_none() {
            // Fails where something else is in it, which then stays.
            let _ = fs::remove_dir(self.path());
        }
        Ok(())
    }
}

impl Drop for RecordFolder {
    fn drop(&mut self) {
        if self.is_kept {
            return;
        }
        let path = self.path().display();
        match self.give_up() {
            Err(error) if self.earlier_waits => {
                tracing::error!(
                    "cannot put the earlier record in {path} back: {error}; the next run with it tries again"
                );
            }
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                tracing::warn!("files without a frame stay in {path}: {error}; take them away");
            }
            _ => {}
        }
    }
}

fn refused(path: &Path, error: io::Error, option: &str) -> Failure {
    let what = format!("cannot record into {}: {error}; name another directory with {option}", path.display());
    Failure::new(Exit::CannotCreate, what)
}

/// Moves the record in `folder` out of its place.
fn set_aside(folder: &Path) -> io::Result<()> {
    let moving = folder.join(MOVING);
    fs::create_dir(&moving)?;
    move_files(folder, &moving)?;
    fs::rename(moving, folder.join(EARLIER))
}

/// Moves a record that waits in `folder` back to its place, and takes away what was written there meanwhile.
fn restore(folder: &Path) -> io::Result<()> {
    let [moving, earlier, replaced] = [MOVING, EARLIER, REPLACED].map(|name| folder.join(name));
    if replaced.exists() {
        fs::remove_dir_all(replaced)?;
    }
    if earlier.exists() {
        remove_files(folder)?;
        fs::rename(earlier, &moving)?;
    }
    if moving.exists() {
        move_files(&moving, folder)?;
        fs::remove_dir(moving)?;
    }
    Ok(())
}

/// Moves the files of the record in `from`.
fn move_files(from: &Path, to: &Path) -> io::Result<()> {
    for file in files_of(from)? {
        if from.join(&file).symlink_metadata()?.is_dir() {
            let what = format!("{} is a directory, expected a file of a record", file.display());
            return Err(io::Error::new(io::ErrorKind::IsADirectory, what));
        }
        if file.starts_with(BENCH) {
            fs::create_dir_all(to.join(BENCH))?;
        }
        fs::rename(from.join(&file), to.join(&file))?;
    }
    // Fails where something else is in it, which then stays.
    let _ = fs::remove_dir(from.join(BENCH));
    Ok(())
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
    use std::collections::BTreeSet;
    use std::sync::Barrier;
    use std::thread;
    use std::time::Duration;

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
        RecordFolder::claim(folder.path(), true).unwrap().keep().unwrap();
        assert!(holds_none(folder.path(), &OF_RECORD) && holds(folder.path(), &OTHERS, "others"));
    }

    #[test]
    fn each_start_has_a_record_of_its_own_though_they_are_at_one_time() {
        const STARTS: usize = 8;
        let root = tempfile::tempdir().unwrap();
        let parent = root.path().join("all");
        let now = SystemTime::UNIX_EPOCH + Duration::from_millis(1_000_000_000_700);
        let barrier = Barrier::new(STARTS);
        let start = || {
            barrier.wait();
            RecordFolder::claim_new(&parent, now).unwrap()
        };
        let claimed: Vec<_> = thread::scope(|scope| {
            let started: Vec<_> = (0..STARTS).map(|_| scope.spawn(start)).collect();
            started.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        let paths: BTreeSet<_> = claimed.iter().map(|folder| folder.path().to_owned()).collect();
        let numbered = (2..=STARTS).map(|start| format!("2001-09-09T01-46-40Z-{start}"));
        let expected = std::iter::once("2001-09-09T01-46-40Z".to_owned()).chain(numbered);
        assert_eq!(paths, expected.map(|name| parent.join(name)).collect());
        drop(claimed);
        assert!(paths.iter().all(|path| !path.exists()), "none made a frame");

        put(root.path(), &["file"], "mine");
        let failure = RecordFolder::claim_new(&root.path().join("file"), now).unwrap_err();
        assert!(failure.to_string().contains("name another directory with --record-in"), "{failure}");
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
        kept.keep().unwrap();
        drop(kept);
        assert!(holds(&new, &OF_RECORD, "new"));
    }

    #[test]
    fn an_earlier_record_is_back_unless_another_one_has_taken_its_place() {
        let folder = tempfile::tempdir().unwrap();
        put(folder.path(), &OF_RECORD, "old");
        put(folder.path(), &OTHERS, "others");
        let names = || {
            let mut names: Vec<_> =
                fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
            names.sort();
            names
        };
        let before = names();
        for written in [&OF_RECORD[..], &[]] {
            let given_up = RecordFolder::claim(folder.path(), true).unwrap();
            assert!(given_up.earlier_waits() && holds_none(folder.path(), &OF_RECORD));
            put(folder.path(), written, "new");
            drop(given_up);
            assert!(holds(folder.path(), &OF_RECORD, "old") && holds(folder.path(), &OTHERS, "others"));
            assert_eq!(names(), before);
        }
        let mut kept = RecordFolder::claim(folder.path(), true).unwrap();
        put(folder.path(), &OF_RECORD, "new");
        kept.keep().unwrap();
        assert!(!kept.earlier_waits());
        drop(kept);
        assert!(holds(folder.path(), &OF_RECORD, "new") && holds(folder.path(), &OTHERS, "others"));
        assert_eq!(names(), before);
    }

    #[test]
    fn what_a_run_that_was_killed_leaves_is_put_right() {
        let claim = |folder: &Path| RecordFolder::claim(folder, false).unwrap_err();
        let [some, others] = [&OF_RECORD[..3], &OF_RECORD[3..]];
        // While the earlier record was moved, either way; while the run began; while the earlier record was deleted.
        for (hidden, hidden_files, in_place, stays) in [
            (MOVING, some, (others, "old"), "old"),
            (EARLIER, &OF_RECORD[..], (some, "new"), "old"),
            (REPLACED, some, (&OF_RECORD[..], "new"), "new"),
        ] {
            let folder = tempfile::tempdir().unwrap();
            put(&folder.path().join(hidden), hidden_files, "old");
            put(folder.path(), in_place.0, in_place.1);
            assert!(claim(folder.path()).to_string().contains("exists already"), "{hidden}");
            assert!(holds(folder.path(), &OF_RECORD, stays), "{hidden}");
            assert!(!folder.path().join(hidden).exists(), "{hidden}");
        }
    }

    #[test]
    fn a_directory_with_the_name_of_a_file_is_left_and_told() {
        let folder = tempfile::tempdir().unwrap();
        put(folder.path(), &OF_RECORD, "old");
        fs::create_dir(folder.path().join("log.txt")).unwrap();
        let failure = RecordFolder::claim(folder.path(), true).unwrap_err();
        assert!(failure.to_string().contains("log.txt is a directory"), "{failure}");
        assert!(holds(folder.path(), &OF_RECORD, "old") && folder.path().join("log.txt").is_dir());
        assert!(!folder.path().join(MOVING).exists());
    }

    #[test]
    fn files_of_the_record_that_goes_are_no_inputs() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("rec");
        put(&folder, &OF_RECORD, "old");
        put(&folder, &["scene/scene.toml", "own.toml"], "mine");
        let judge = |name: &str| RecordFolder::refuse_as_inputs(&folder, [("--tracker", folder.join(name))]);
        for name in ["tracker.holodraw", "samples.csv", "bench/rig.toml", "bench", "scene/../bench/rig.toml"] {
            let failure = judge(name).unwrap_err();
            assert_eq!(failure.exit, Exit::Usage, "{name}");
            assert!(failure.to_string().contains("which --force overwrites; record into another"), "{failure}");
        }
        for name in ["own.toml", "scene", "missing", ".."] {
            judge(name).unwrap();
        }
    }

    #[test]
    fn a_folder_that_was_moved_is_put_right_where_it_is_and_what_came_to_its_path_stays() {
        let root = tempfile::tempdir().unwrap();
        let [path, elsewhere] = ["record", "elsewhere"].map(|name| root.path().join(name));
        for is_deleted in [false, true] {
            let given_up = RecordFolder::claim(&path, false).unwrap();
            put(&path, &OF_RECORD, "mine");
            if is_deleted {
                fs::remove_dir_all(&path).unwrap()
            } else {
                fs::rename(&path, &elsewhere).unwrap()
            }
            let mut other = RecordFolder::claim(&path, false).unwrap();
            put(&path, &OF_RECORD, "another's");
            drop(given_up);
            assert!(holds(&path, &OF_RECORD, "another's") && holds_none(&elsewhere, &OF_RECORD));
            other.keep().unwrap();
            fs::remove_dir_all(&path).unwrap();
        }
        // An earlier record goes, and comes back, in its own folder.
        for is_kept in [false, true] {
            let _cleared = fs::remove_dir_all(&elsewhere);
            put(&path, &OF_RECORD, "earlier");
            let mut folder = RecordFolder::claim(&path, true).unwrap();
            fs::rename(&path, &elsewhere).unwrap();
            put(&elsewhere, &OF_RECORD, "mine");
            put(&path.join(EARLIER), &OF_RECORD, "another's");
            if is_kept {
                folder.keep().unwrap();
            }
            drop(folder);
            assert!(holds(&path.join(EARLIER), &OF_RECORD, "another's"));
            assert!(holds(&elsewhere, &OF_RECORD, if is_kept { "mine" } else { "earlier" }));
            assert!(!elsewhere.join(EARLIER).exists());
            fs::remove_dir_all(&path).unwrap();
        }
    }

    #[test]
    fn one_at_a_time_records_into_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let first = RecordFolder::claim(folder.path(), false).unwrap();
        put(folder.path(), &OF_RECORD, "new");
        for force in [false, true] {
            let failure = RecordFolder::claim(folder.path(), force).unwrap_err();
            assert_eq!(failure.exit, Exit::CannotCreate);
            assert!(failure.to_string().contains("another holod records there; end it"), "{failure}");
        }
        assert!(holds(folder.path(), &OF_RECORD, "new"));
        drop(first);
        RecordFolder::claim(folder.path(), false).unwrap();
    }
}
