//! What a running holod says of itself: a small JSON file that it writes anew each second and takes away at its end.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use holod_model::files;
use serde::{Deserialize, Serialize};

use crate::failure::{Exit, Failure};
use crate::session::Spread;

/// The state of a run at one moment.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// The process.
    pub pid: u32,
    /// Dark, running or degraded.
    pub state: String,
    /// How long it has run.
    pub uptime_s: f64,
    /// The rig's name.
    pub rig: String,
    /// The tracker spec.
    pub tracker: String,
    /// How the tracker's link is.
    pub tracker_link: String,
    /// Why a lost link does not come back.
    pub tracker_trouble: Option<String>,
    /// What the pupil's estimate rests on.
    pub pupil_state: String,
    /// The pupil that the newest frame was made for.
    pub pupil_mm: Option<f32>,
    /// Frames that were made.
    pub frames_made: u64,
    /// Of those, frames that came on the panel.
    pub frames_shown: u64,
    /// Frames that came on the panel later than planned.
    pub deadline_misses: u64,
    /// From waking to the submitted levels.
    pub frame_time: Option<Spread>,
    /// From the newest tracker sample behind a frame to the middle of its first light.
    pub sample_to_photon: Option<Spread>,
    /// Counters of the tracker: samples, connections, rejections by reason.
    pub tracker_counts: BTreeMap<String, u64>,
}

const NAME: &str = "status.json";
/// The folder that the service's unit asks systemd for.
const SERVICE_FOLDER: &str = "/run/holod";
/// A file older than this was not written by a loop that still turns.
const STALE: Duration = Duration::from_secs(5);

/// Where this process puts its status: the folder that systemd made for it, or one in the user's own runtime folder.
fn own_folder() -> Option<PathBuf> {
    let service = std::env::var_os("RUNTIME_DIRECTORY").map(PathBuf::from);
    service.or_else(|| std::env::var_os("XDG_RUNTIME_DIR").map(|folder| Path::new(&folder).join("holod")))
}

/// The file of a running process. Dropping it takes the file away.
#[derive(Debug)]
pub struct StatusFile {
    path: Option<PathBuf>,
}

impl StatusFile {
    /// The file, in its folder; a process without a runtime folder has none, which is no fault.
    pub fn create() -> Self {
        let path =
            own_folder().filter(|folder| std::fs::create_dir_all(folder).is_ok()).map(|folder| folder.join(NAME));
        Self { path }
    }

    /// Writes the file anew. A disk that refuses is told once.
    pub fn write(&mut self, status: &Status) {
        let Some(path) = &self.path else { return };
        let written = serde_json::to_vec(status)
            .map_err(|error| error.to_string())
            .and_then(|bytes| files::write_atomically(path, &bytes).map_err(|error| error.to_string()));
        if let Err(error) = written {
            tracing::warn!("`holod status` will know nothing of this run: {error}");
            self.path = None;
        }
    }
}

impl Drop for StatusFile {
    fn drop(&mut self) {
        let own = |path: &Path| read(path).is_some_and(|(status, _)| status.pid == std::process::id());
        if let Some(path) = self.path.take().filter(|path| own(path)) {
            let _ = std::fs::remove_file(path);
        }
    }
}

fn read(path: &Path) -> Option<(Status, SystemTime)> {
    let written = std::fs::metadata(path).ok()?.modified().ok()?;
    Some((serde_json::from_slice(&std::fs::read(path).ok()?).ok()?, written))
}

/// The status of the holod that runs as a service, or else of this user's own, and how long ago it was written where that
/// is too long.
///
/// # Errors
/// None runs, or what it says may not be read.
pub fn of_running() -> Result<(Status, Option<Duration>), Failure> {
    let mut folders = vec![PathBuf::from(SERVICE_FOLDER)];
    folders.extend(own_folder());
    of_running_in(&folders)
}

fn of_running_in(folders: &[PathBuf]) -> Result<(Status, Option<Duration>), Failure> {
    for folder in folders {
        let path = folder.join(NAME);
        match std::fs::File::open(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::PermissionDenied => {
                return Err(Failure::new(
                    Exit::NoInput,
                    format!("{}: {error}; ask as root, or as a member of the group `holod`", path.display()),
                ));
            }
            Err(_) => continue,
            Ok(_) => {}
        }
        let Some((status, written)) = read(&path) else { continue };
        if !Path::new("/proc").join(status.pid.to_string()).exists() {
            continue;
        }
        let age = written.elapsed().unwrap_or_default();
        return Ok((status, (age > STALE).then_some(age)));
    }
    let folders: Vec<_> = folders.iter().map(|folder| folder.display().to_string()).collect();
    Err(Failure::new(
        Exit::Unavailable,
        format!(
            "no holod is running that wrote its status to {}; start it with `systemctl start holod` or `holod run`",
            folders.join(" or ")
        ),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status() -> Status {
        Status { pid: std::process::id(), state: "running".into(), tracker: "mock".into(), ..Status::default() }
    }

    #[test]
    fn what_is_written_is_read_and_taken_away_at_the_end() {
        let folder = tempfile::tempdir().unwrap();
        let folders = [folder.path().join("absent"), folder.path().to_owned()];
        assert_eq!(of_running_in(&folders).unwrap_err().exit, Exit::Unavailable);
        let mut file = StatusFile { path: Some(folder.path().join(NAME)) };
        file.write(&status());
        assert_eq!(of_running_in(&folders).unwrap(), (status(), None));
        drop(file);
        assert!(of_running_in(&folders).is_err());
    }

    #[test]
    fn the_file_of_a_dead_or_a_stalled_process_is_told_from_that_of_a_running_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(NAME);
        let folders = [folder.path().to_owned()];
        // No process has this number: the kernel's greatest is 2^22.
        std::fs::write(&path, serde_json::to_vec(&Status { pid: u32::MAX, ..status() }).unwrap()).unwrap();
        assert!(of_running_in(&folders).is_err());
        std::fs::write(&path, serde_json::to_vec(&status()).unwrap()).unwrap();
        let long_ago = SystemTime::now() - Duration::from_secs(60);
        std::fs::File::options().write(true).open(&path).unwrap().set_modified(long_ago).unwrap();
        let (_, age) = of_running_in(&folders).unwrap();
        assert!(age.unwrap() > Duration::from_secs(50));
        std::fs::write(&path, "{").unwrap();
        assert!(of_running_in(&folders).is_err());
    }
}
