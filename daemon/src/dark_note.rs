//! A person's wish for dark lasers as a note on disk: a holod that starts after one that failed keeps to it.
//!
//! A service has its note in its state folder, where it stays until lasers are armed again, whatever happens to the
//! service: a restart is not told from a stop. A run by hand has it in its runtime folder, which nobody else looks into,
//! and in the shared folders that take it, and takes it away at its end. Each looks in all of them.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use holod_calibration::rig::LaserDriver;
use twox_hash::XxHash3_64;

use crate::runtime_folder;

/// Names other shared folders than these, with colons between them.
const SHARED_VARIABLE: &str = "HOLOD_DARK_NOTES";
/// The state folder of the service's unit, and the folder for locks on devices, which the unit can see and, on Debian,
/// every user can write to.
const SHARED: &str = "/var/lib/holod:/run/lock";

/// The notes on one rig's lasers. Simulated ones have none.
#[derive(Clone, Debug)]
pub(crate) struct DarkNote {
    /// The ports that it is on, a line each.
    ports: String,
    /// What the names of all notes on them begin with, but for a `holod-` before it.
    stem: String,
    /// The name of this process's own.
    name: String,
    /// Where nobody but this user leaves one.
    own: Option<PathBuf>,
    /// Where others look for one of this process, too.
    shared: Vec<PathBuf>,
    looked_at: Vec<PathBuf>,
    of_service: bool,
}

/// What a look for notes came to.
#[derive(Debug)]
pub(crate) enum Found {
    Nothing,
    Note(PathBuf),
    /// A folder cannot be read: why.
    Unreadable(String),
}

/// What became of a note that was to be left.
#[derive(Debug, Default)]
pub(crate) struct Left {
    /// It lies where a later run of this user, or this service, looks.
    pub(crate) is_there: bool,
    /// And where every holod looks.
    pub(crate) is_for_all: bool,
    /// Why it lies nowhere.
    pub(crate) error: Option<String>,
}

impl DarkNote {
    /// That on the lasers of `driver`.
    pub(crate) fn on(driver: &LaserDriver) -> Self {
        let state = runtime_folder::of_service("STATE_DIRECTORY");
        let of_service = state.is_some();
        let own = state.or_else(runtime_folder::own);
        let shared = std::env::var_os(SHARED_VARIABLE).unwrap_or_else(|| SHARED.into());
        let shared: Vec<_> = std::env::split_paths(&shared).filter(|folder| folder.is_absolute()).collect();
        let runtime = runtime_folder::candidates().into_iter().filter(|folder| runtime_folder::is_own(folder));
        Self::in_folders(own, shared, runtime.collect(), driver, of_service)
    }

    fn in_folders(
        own: Option<PathBuf>,
        shared: Vec<PathBuf>,
        runtime: Vec<PathBuf>,
        driver: &LaserDriver,
        of_service: bool,
    ) -> Self {
        let whole = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let ports: String = driver.paths().iter().map(|path| format!("{}\n", whole(path).display())).collect();
        let stem = format!("dark-{:016x}", XxHash3_64::oneshot(ports.as_bytes()));
        let name =
            if of_service { stem.clone() } else { format!("holod-{stem}-{}", rustix::process::getuid().as_raw()) };
        if ports.is_empty() {
            return Self { ports, stem, name, own: None, shared: vec![], looked_at: vec![], of_service };
        }
        let mut looked_at = Vec::new();
        for folder in own.iter().chain(&shared).chain(&runtime) {
            if !looked_at.contains(folder) {
                looked_at.push(folder.clone());
            }
        }
        Self { ports, stem, name, own, shared, looked_at, of_service }
    }

    /// Looks whether a holod before this one, or another user's, left one.
    pub(crate) fn look(&self) -> Found {
        let (notes, unreadable) = self.notes();
        match (notes.into_iter().next(), unreadable.into_iter().next()) {
            (Some(note), _) => Found::Note(note),
            (None, Some(error)) => Found::Unreadable(error),
            (None, None) => Found::Nothing,
        }
    }

    /// All notes on these lasers, and why folders cannot be read.
    fn notes(&self) -> (Vec<PathBuf>, Vec<String>) {
        let (mut notes, mut unreadable) = (Vec::new(), Vec::new());
        for folder in &self.looked_at {
            match names(folder) {
                Ok(names) => {
                    notes.extend(names.into_iter().filter(|name| self.is_on_these(name)).map(|n| folder.join(n)))
                }
                Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {}
                Err(error) => unreadable.push(format!("{}: {error}", folder.display())),
            }
        }
        (notes, unreadable)
    }

    fn is_on_these(&self, name: &str) -> bool {
        let rest = name.strip_prefix("holod-").unwrap_or(name).strip_prefix(&self.stem);
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('-'))
    }

    /// Leaves it wherever it is missing.
    pub(crate) fn leave(&self) -> Left {
        let mut left = Left::default();
        if let Some(own) = &self.own {
            if !self.of_service {
                let _is_made = runtime_folder::make_again(own);
            }
            match self.leave_in(own) {
                Ok(()) => (left.is_there, left.is_for_all) = (true, self.of_service),
                Err(error) => left.error = Some(error),
            }
        }
        if !self.of_service {
            // Which of them takes one depends on the user.
            let in_shared = self.shared.iter().filter(|folder| self.leave_in(folder).is_ok()).count();
            if in_shared > 0 {
                left = Left { is_there: true, is_for_all: true, error: None };
            }
        }
        left
    }

    fn leave_in(&self, folder: &Path) -> Result<(), String> {
        let path = folder.join(&self.name);
        match fs::File::create_new(&path) {
            Ok(mut file) => {
                // That it is there counts; what is in it is for people.
                let _ = file.write_all(self.ports.as_bytes());
                Ok(())
            }
            Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(()),
            Err(error) => Err(format!("{}: {error}", path.display())),
        }
    }

    /// Takes all of them away, those of others, too. Which stay, and how to take them away.
    pub(crate) fn take_away(&self) -> Option<String> {
        let (notes, unreadable) = self.notes();
        let mut stay = Vec::new();
        for note in notes {
            if let Err(error) = fs::remove_file(&note)
                && error.kind() != ErrorKind::NotFound
            {
                stay.push(format!("{error}; take it away with `sudo rm {}`", note.display()));
            }
        }
        stay.extend(unreadable.into_iter().map(|error| format!("{error}; let this user read that folder")));
        (!stay.is_empty()).then(|| stay.join("; "))
    }

    /// Takes its own away at the end of a run by hand, after which its lasers are known to be dark.
    pub(crate) fn take_away_unless_of_service(&self) {
        if !self.of_service {
            for folder in self.own.iter().chain(&self.shared) {
                let _not_there = fs::remove_file(folder.join(&self.name));
            }
        }
    }
}

/// Names in a folder; those that are no text are none of a note.
fn names(folder: &Path) -> std::io::Result<Vec<String>> {
    let names = fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.file_name().into_string().ok()));
    names.filter_map(Result::transpose).collect()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use holod_calibration::rig::Rig;

    use super::*;

    /// Folders of a machine: a service's state, a user's runtime folder, one that everybody can write to.
    struct Machine(tempfile::TempDir);

    impl Machine {
        fn new() -> Self {
            let root = tempfile::tempdir().unwrap();
            ["state", "runtime", "lock"].iter().for_each(|name| fs::create_dir(root.path().join(name)).unwrap());
            Self(root)
        }

        fn at(&self, name: &str) -> PathBuf {
            self.0.path().join(name)
        }

        fn note(&self, driver: &LaserDriver, of_service: bool) -> DarkNote {
            let own = self.at(if of_service { "state" } else { "runtime" });
            // A user can write to the service's folder in no case, which `no-such-folder` stands for.
            let shared = if of_service { vec![] } else { vec![self.at("no-such-folder"), self.at("lock")] };
            let mut note = DarkNote::in_folders(Some(own), shared, vec![], driver, of_service);
            if !note.looked_at.is_empty() {
                note.looked_at = ["state", "runtime", "lock"].map(|name| self.at(name)).into();
            }
            // Of another user, whose runtime folder is not to be seen.
            note.looked_at.retain(|folder| !of_service || *folder != self.at("runtime"));
            note
        }

        fn on(&self, port: &str, of_service: bool) -> DarkNote {
            self.note(&LaserDriver::Serial { path: port.into(), sync_wire: false }, of_service)
        }
    }

    fn is_there(note: &DarkNote) -> bool {
        matches!(note.look(), Found::Note(_))
    }

    #[test]
    fn a_note_is_on_the_lasers_of_its_ports_alone() {
        let machine = Machine::new();
        let [left, right] =
            ["/dev/serial/by-id/left", &format!("/dev/{}", "r".repeat(300))].map(|port| machine.on(port, false));
        assert!(left.leave().is_there && left.leave().is_there);
        assert!(is_there(&left) && matches!(right.look(), Found::Nothing));
        assert_eq!(right.take_away(), None);
        assert!(right.leave().is_there && is_there(&right), "however long the port's name is");
        assert_eq!((left.take_away(), left.take_away()), (None, None));
        assert!(!is_there(&left) && is_there(&right));

        let simulated = machine.note(&Rig::default().lasers.driver, false);
        assert!(!simulated.leave().is_there && matches!(simulated.look(), Found::Nothing));
        let mut nowhere = machine.on("/dev/left", true);
        nowhere.own = Some("/proc/no-such-folder".into());
        let left = nowhere.leave();
        assert!(!left.is_there && left.error.is_some_and(|error| error.starts_with("/proc/no-such-folder/dark-")));
        assert!(!is_there(&nowhere));
    }

    #[test]
    fn a_service_and_a_run_by_hand_see_each_others_note() {
        for of_service in [false, true] {
            let machine = Machine::new();
            let [one, other] = [of_service, !of_service].map(|of_service| machine.on("/dev/lasers", of_service));
            let left = one.leave();
            assert!(left.is_there && left.is_for_all && left.error.is_none(), "{left:?}");
            assert!(is_there(&one) && is_there(&other), "of a service: {of_service}");
            // The end of a run by hand takes away no note of a service.
            other.take_away_unless_of_service();
            assert!(is_there(&one) && is_there(&other));
            // That of the other's runtime folder is seen by its own user alone.
            assert_eq!(other.take_away(), None);
            assert!(!is_there(&other));
        }
    }

    #[test]
    fn a_note_of_an_older_holod_in_the_runtime_folder_is_seen() {
        let machine = Machine::new();
        let note = machine.on("/dev/lasers", false);
        fs::write(machine.at("runtime").join(&note.stem), "").unwrap();
        assert!(is_there(&note) && note.take_away().is_none() && !is_there(&note));
    }

    #[test]
    fn a_note_that_others_cannot_see_is_told_from_one_that_they_can() {
        let machine = Machine::new();
        let mut note = machine.on("/dev/lasers", false);
        note.shared.pop();
        let left = note.leave();
        assert!(left.is_there && !left.is_for_all, "{left:?}");
    }

    #[test]
    fn a_note_is_left_again_where_its_folder_was_taken_away() {
        let machine = Machine::new();
        let note = machine.on("/dev/lasers", false);
        note.leave();
        fs::remove_dir_all(machine.at("runtime")).unwrap();
        note.leave();
        assert!(machine.at("runtime").join(&note.name).exists());
    }

    #[test]
    fn what_cannot_be_read_or_taken_away_is_told() {
        if rustix::process::geteuid().is_root() {
            return;
        }
        let machine = Machine::new();
        let note = machine.on("/dev/lasers", false);
        let lock = |mode| fs::set_permissions(machine.at("lock"), fs::Permissions::from_mode(mode)).unwrap();
        lock(0);
        let (found, stays) = (note.look(), note.take_away());
        lock(0o700);
        let folder = machine.at("lock").display().to_string();
        assert!(matches!(&found, Found::Unreadable(error) if error.starts_with(&folder)), "{found:?}");
        assert!(stays.is_some_and(|stays| stays.starts_with(&folder)));
        note.leave();
        lock(0o500);
        let stays = note.take_away();
        lock(0o700);
        let path = machine.at("lock").join(&note.name).display().to_string();
        assert!(stays.is_some_and(|stays| stays.ends_with(&format!("`sudo rm {path}`"))));
        assert!(is_there(&note));
    }

    #[test]
    fn a_services_note_outlasts_its_end() {
        for of_service in [false, true] {
            let machine = Machine::new();
            let note = machine.on("/dev/lasers", of_service);
            assert!(note.leave().is_there);
            note.take_away_unless_of_service();
            assert_eq!(is_there(&note), of_service);
        }
    }
}
