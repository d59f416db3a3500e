//! What the service's unit has, sees and may write, and the files of a rig that it must see.

use std::path::{Path, PathBuf};

use holod_calibration::rig::{Rig, WeightsChoice};
use holod_pupil_input::TrackerSpec;

/// Where the package has the program.
pub(super) const BINARY: &str = "/usr/bin/holod";
/// The rig that the unit itself names.
pub(super) const USUAL_RIG: &str = "/etc/holod/rig.toml";
/// Where the unit lets holod write.
pub(super) const STATE_FOLDER: &str = "/var/lib/holod";
/// What the unit hides (`ProtectHome=`, `PrivateTmp=`).
const HIDDEN_FROM_SERVICE: [&str; 5] = ["/home", "/root", "/run/user", "/tmp", "/var/tmp"];

/// Why the service does not see a file, if it does not: by its name, or by where links and `..` lead from there.
pub(super) fn unseen_by_service(file: &Path) -> Option<String> {
    let shown = file.display();
    let in_one = |path: &Path| HIDDEN_FROM_SERVICE.into_iter().find(|folder| path.starts_with(folder));
    if let Some(folder) = in_one(file) {
        return Some(format!("{shown}; the service does not see {folder}, move it to /etc/holod or /srv"));
    }
    let folder = in_one(&file.canonicalize().ok()?)?;
    Some(format!(
        "{shown}, which leads into {folder}; the service does not see that, put the file itself into /etc/holod or /srv"
    ))
}

/// An absolute path in a machine whose `/` is the folder `root`.
pub(super) fn below(root: &Path, path: &Path) -> PathBuf {
    root.join(path.strip_prefix("/").unwrap_or(path))
}

/// The rig file and those that it names.
pub(super) fn files_of(rig: &Rig) -> Vec<PathBuf> {
    let provenance = &rig.provenance;
    let origin = Some(PathBuf::from(&provenance.origin)).filter(|path| path.is_file());
    let weights = match &rig.model.weights {
        WeightsChoice::File(path) => Some(path.clone()),
        _ => None,
    };
    let tables = provenance.lut_files.0.iter().chain(&provenance.flatness_files.0).flatten();
    let tables = tables.map(|table| table.path.clone());
    let lasers = provenance.laser_profile_file.clone();
    let tracker = rig.tracker.spec.as_ref().and_then(|spec| spec.parse::<TrackerSpec>().ok());
    let tracker = tracker.map(|spec| spec.files()).unwrap_or_default();
    // A file that is named from where the caller stands is elsewhere for the service.
    let files = origin.into_iter().chain(weights).chain(tables).chain(lasers).chain(tracker);
    files.map(|path| std::path::absolute(&path).unwrap_or(path)).collect()
}
