//! A person's wish for dark lasers as a note on disk: a holod that starts after one that failed keeps to it.
//!
//! A service has its note in its state folder, where it stays until lasers are armed again, whatever happens to the
//! service: a restart is not told from a stop. A run by hand has it in its runtime folder, and takes it away at its
//! end.

use std::path::{Path, PathBuf};

use holod_calibration::rig::LaserDriver;
use twox_hash::XxHash3_64;

use crate::runtime_folder;

/// The note on one rig's lasers. Simulated ones have none.
#[derive(Clone, Debug)]
pub(crate) struct DarkNote {
    path: Option<PathBuf>,
    /// The ports that it is on, a line each.
    ports: String,
    of_service: bool,
}

impl DarkNote {
    /// That on the lasers of `driver`.
    pub(crate) fn on(driver: &LaserDriver) -> Self {
        match state_folder() {
            Some(folder) => Self::in_folder(Some(folder), driver, true),
            None => Self::in_folder(runtime_folder::own(), driver, false),
        }
    }

    fn in_folder(folder: Option<PathBuf>, driver: &LaserDriver, of_service: bool) -> Self {
        let whole = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let ports: String = driver.paths().iter().map(|path| format!("{}\n", whole(path).display())).collect();
        let name = format!("dark-{:016x}", XxHash3_64::oneshot(ports.as_bytes()));
        let path = folder.filter(|_| !ports.is_empty()).map(|folder| folder.join(name));
        Self { path, ports, of_service }
    }

    /// Whether a holod before this one left it.
    pub(crate) fn is_there(&self) -> bool {
        self.path.as_ref().is_some_and(|path| path.exists())
    }

    /// Leaves it. Whether it is there now.
    pub(crate) fn leave(&self) -> bool {
        let Some(path) = &self.path else { return false };
        if !self.of_service {
            let _is_made = path.parent().is_some_and(runtime_folder::make_again);
        }
        let written = std::fs::write(path, &self.ports);
        if let Err(error) = &written {
            tracing::warn!("a holod that starts after a failure would light the lasers: {}: {error}", path.display());
        }
        written.is_ok()
    }

    /// Takes it away.
    pub(crate) fn take_away(&self) {
        if let Some(path) = &self.path {
            let _not_there = std::fs::remove_file(path);
        }
    }

    /// Takes it away at the end of a run by hand, after which its lasers are known to be dark.
    pub(crate) fn take_away_unless_of_service(&self) {
        if !self.of_service {
            self.take_away();
        }
    }
}

/// The state folder of the service that this process is. Its children inherit the variable, and are no service.
fn state_folder() -> Option<PathBuf> {
    let named = |name: &str| std::env::var_os(name);
    let is_service = named("SYSTEMD_EXEC_PID").is_some_and(|pid| *pid == *std::process::id().to_string());
    named("STATE_DIRECTORY").filter(|_| is_service).map(PathBuf::from).filter(|path| path.is_absolute())
}

#[cfg(test)]
mod tests {
    use holod_calibration::rig::Rig;

    use super::*;

    fn on(folder: &Path, port: &str, of_service: bool) -> DarkNote {
        let driver = LaserDriver::Serial { path: port.into(), sync_wire: false };
        DarkNote::in_folder(Some(folder.to_owned()), &driver, of_service)
    }

    #[test]
    fn a_note_is_on_the_lasers_of_its_ports_alone() {
        let folder = tempfile::tempdir().unwrap();
        let [left, right] =
            ["/dev/serial/by-id/left", &format!("/dev/{}", "r".repeat(300))].map(|port| on(folder.path(), port, false));
        assert!(left.leave() && left.leave());
        assert!(left.is_there() && !right.is_there());
        right.take_away();
        assert!(right.leave() && right.is_there(), "however long the port's name is");
        left.take_away();
        left.take_away();
        assert!(!left.is_there());

        let simulated = DarkNote::in_folder(Some(folder.path().to_owned()), &Rig::default().lasers.driver, false);
        assert!(!simulated.leave() && !simulated.is_there());
        let nowhere = on(Path::new("/proc/no-such-folder"), "/dev/left", true);
        assert!(!nowhere.leave() && !nowhere.is_there());
    }

    #[test]
    fn a_services_note_outlasts_its_end() {
        let folder = tempfile::tempdir().unwrap();
        for of_service in [false, true] {
            let note = on(folder.path(), "/dev/lasers", of_service);
            assert!(note.leave());
            note.take_away_unless_of_service();
            assert_eq!(note.is_there(), of_service);
        }
    }
}
