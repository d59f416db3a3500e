//! Whether a run's record goes on, for all who write it and all who ask.

use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::place::Place;
use crate::failure::{Exit, Failure};
use crate::snapshot::{RecordCondition, RecordState};

/// Whether a record goes on. The first who cannot write gives it up for all.
#[derive(Debug)]
pub struct RecordHealth {
    place: Arc<Place>,
    reason: Mutex<Option<String>>,
    /// Where its folder was at the last look, if not in its place.
    moved_to: Mutex<Option<PathBuf>>,
    rows_lost: AtomicU64,
}

impl RecordHealth {
    /// That of a record in the folder `place`, which goes on.
    pub(super) fn new(place: Arc<Place>) -> Self {
        Self { place, reason: Mutex::new(None), moved_to: Mutex::new(None), rows_lost: AtomicU64::new(0) }
    }

    /// Gives the record up because of `why`, and says so in the log, unless somebody has done that already.
    pub fn give_up(&self, why: &str) {
        let why = self.place.named(why);
        let mut reason = self.reason();
        if reason.is_none() {
            tracing::error!(
                "the record is lost from here on: {why}. Frames and lasers go on without it, and what was written before \
                 can be read; start holod again for a new record"
            );
            *reason = Some(why);
        }
    }

    /// Looks where its folder is, which may take as long as a disk does, and says where that has changed.
    pub(crate) fn look_for_folder(&self) {
        let found = self.place.moved_to();
        let mut moved_to = self.moved_to();
        if *moved_to == found {
            return;
        }
        let path = self.place.path().display();
        match &found {
            Some(now) => tracing::warn!(
                "the record's folder {path} was moved: the record goes on in {}; move it back, and leave a record where \
                 it is until its run is over",
                now.display()
            ),
            None => tracing::info!("the record's folder {path} is back"),
        }
        *moved_to = found;
    }

    /// Whether it was given up.
    pub fn is_lost(&self) -> bool {
        self.reason().is_some()
    }

    /// How the record is now, for the status.
    pub fn state(&self) -> RecordState {
        let reason = self.reason().clone();
        let state = if reason.is_some() { RecordCondition::Lost } else { RecordCondition::Written };
        let folder = self.moved_to().clone().unwrap_or_else(|| self.place.path().to_owned());
        RecordState { folder, state, reason, rows_lost: self.rows_lost() }
    }

    /// What a run ends with whose record was given up, or is not where it was to be.
    ///
    /// # Errors
    /// It was given up, or its folder was moved.
    pub fn judge(&self) -> Result<(), Failure> {
        let path = self.place.path().display();
        let said = match (&*self.reason(), &*self.moved_to()) {
            (None, None) => return Ok(()),
            (Some(why), _) => format!("the record in {path} was lost while the run went on: {why}"),
            (None, Some(now)) => format!(
                "the record's folder {path} was moved to {} while the run went on: what was recorded is there; leave a \
                 record where it is until its run is over",
                now.display()
            ),
        };
        Err(Failure::new(Exit::CannotCreate, said))
    }

    pub(super) fn lose_row(&self) {
        self.rows_lost.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn rows_lost(&self) -> u64 {
        self.rows_lost.load(Ordering::Relaxed)
    }

    fn moved_to(&self) -> MutexGuard<'_, Option<PathBuf>> {
        self.moved_to.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn reason(&self) -> MutexGuard<'_, Option<String>> {
        self.reason.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A file of a record that cannot be written any more, and what to do about it.
pub(super) fn lost(path: &Path, error: &io::Error) -> Failure {
    let cure = match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "make room there, or name another place with --record",
        ErrorKind::FileTooLarge => "raise the limit on a file's size (ulimit -f)",
        ErrorKind::NotFound => "leave a record where it is until its run is over",
        _ => "look after its disk, or name another place with --record",
    };
    Failure::new(Exit::CannotCreate, format!("cannot go on recording into {}: {error}; {cure}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_is_given_up_once_with_the_first_reason_and_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let place = Arc::new(Place::hold(folder.path()).unwrap());
        let health = RecordHealth::new(Arc::clone(&place));
        let [path, frames] = [folder.path().to_owned(), folder.path().join("frames.csv")];
        let [path, frames] = [&path, &frames].map(|path| path.to_str().unwrap());
        assert_eq!(health.state().text(), path);
        assert!(health.judge().is_ok());
        let full = lost(&place.itself().join("frames.csv"), &ErrorKind::StorageFull.into());
        health.give_up(&full.to_string());
        health.give_up("another");
        health.lose_row();
        let state = health.state();
        assert_eq!((state.state, state.rows_lost, health.is_lost()), (RecordCondition::Lost, 1, true));
        for part in ["lost: ", frames, "no storage space", "make room", "1 rows are left out"] {
            assert!(state.text().contains(part), "{part}: {}", state.text());
        }
        let failure = health.judge().unwrap_err();
        assert!(failure.exit == Exit::CannotCreate && failure.to_string().contains("no storage space"), "{failure}");
    }

    #[test]
    fn a_record_whose_folder_was_moved_says_where_it_is_until_it_is_back() {
        let root = tempfile::tempdir().unwrap();
        let root = root.path().canonicalize().unwrap();
        let [path, elsewhere] = ["record", "elsewhere"].map(|name| root.join(name));
        std::fs::create_dir(&path).unwrap();
        let health = RecordHealth::new(Arc::new(Place::hold(&path).unwrap()));
        let looked_for = || {
            health.look_for_folder();
            health.state().folder
        };
        assert_eq!(looked_for(), path);
        std::fs::rename(&path, &elsewhere).unwrap();
        assert_eq!(looked_for(), elsewhere);
        let failure = health.judge().unwrap_err();
        assert!(failure.exit == Exit::CannotCreate && failure.to_string().contains("was moved to"), "{failure}");
        std::fs::rename(&elsewhere, &path).unwrap();
        assert_eq!(looked_for(), path);
        assert!(health.judge().is_ok());
    }
}
