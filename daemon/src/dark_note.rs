//! A person's wish for dark lasers as a note in the run's folder: a holod that starts after one that failed keeps to it,
//! and so does a service that is restarted. Its folder goes when it is stopped (`RuntimeDirectoryPreserve=restart`).

use std::path::{Path, PathBuf};

use holod_calibration::rig::LaserDriver;

use crate::runtime_folder;

/// The note on one rig's lasers. Simulated ones have none, nor has a run without a folder, which nobody can ask.
#[derive(Clone, Debug)]
pub(crate) struct DarkNote(Option<PathBuf>);

/// Where systemd says the folder of a service.
const OF_SERVICE: &str = "RUNTIME_DIRECTORY";

impl DarkNote {
    /// That on the lasers of `driver`.
    pub(crate) fn on(driver: &LaserDriver) -> Self {
        Self::in_folder(runtime_folder::own(), driver)
    }

    fn in_folder(folder: Option<PathBuf>, driver: &LaserDriver) -> Self {
        let ports: Vec<_> = driver.paths().iter().map(|path| path.to_string_lossy().replace('/', "-")).collect();
        if ports.is_empty() {
            return Self(None);
        }
        Self(folder.map(|folder| folder.join(format!("dark{}", ports.concat()))))
    }

    /// Whether a holod before this one left it.
    pub(crate) fn is_there(&self) -> bool {
        self.0.as_ref().is_some_and(|path| path.exists())
    }

    /// Leaves it.
    pub(crate) fn leave(&self) {
        let Some(path) = &self.0 else { return };
        let _is_made = path.parent().is_some_and(runtime_folder::make_again);
        if let Err(error) = std::fs::write(path, "") {
            tracing::warn!(
                "a holod that starts after this one has failed would light the lasers: {}: {error}",
                path.display()
            );
        }
    }

    /// Takes it away at an end that is no failure, unless systemd does.
    pub(crate) fn ends_in_order(&self) {
        let of_service = std::env::var_os(OF_SERVICE).map(PathBuf::from);
        if self.0.as_deref().and_then(Path::parent) != of_service.as_deref() {
            self.take_away();
        }
    }

    /// Takes it away.
    pub(crate) fn take_away(&self) {
        if let Some(path) = &self.0 {
            let _not_there = std::fs::remove_file(path);
        }
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::rig::Rig;

    use super::*;

    #[test]
    fn a_note_is_on_the_lasers_of_its_ports_alone() {
        let folder = tempfile::tempdir().unwrap();
        let serial = |path: &str| {
            let driver = LaserDriver::Serial { path: path.into(), sync_wire: false };
            DarkNote::in_folder(Some(folder.path().to_owned()), &driver)
        };
        let [left, right] = ["/dev/serial/by-id/left", "/dev/serial/by-id/right"].map(serial);
        left.leave();
        left.leave();
        assert!(left.is_there() && !right.is_there());
        right.take_away();
        assert!(left.is_there());
        left.take_away();
        left.take_away();
        assert!(!left.is_there());

        let simulated = DarkNote::in_folder(Some(folder.path().to_owned()), &Rig::default().lasers.driver);
        simulated.leave();
        assert!(!simulated.is_there() && folder.path().read_dir().unwrap().next().is_none());
    }
}
