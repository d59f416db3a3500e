//! The folder for what belongs to a run and not to a disk: its status, its sockets.

use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};

/// What keeps a folder that is gone.
pub(crate) const LINGER: &str = "`loginctl enable-linger` keeps it where it goes with a user's last login session";

/// The best folder that this process may write to, made where it is missing; nothing where there is none.
pub(crate) fn own() -> Option<PathBuf> {
    candidates().into_iter().find(|folder| prepare(folder))
}

/// Where such a folder may be, the best place first: the folder that systemd made for it, one in the user's own
/// runtime folder, one of this user's in the folder for temporary files.
pub(crate) fn candidates() -> Vec<PathBuf> {
    let named = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let uid = rustix::process::getuid().as_raw();
    let login = PathBuf::from(format!("/run/user/{uid}"));
    let runtime =
        named("XDG_RUNTIME_DIR").or_else(|| login.is_dir().then_some(login)).map(|folder| folder.join("holod"));
    let temporary = std::env::temp_dir().join(format!("holod-{uid}"));
    named("RUNTIME_DIRECTORY").into_iter().chain(runtime).chain([temporary]).collect()
}

/// The folder that systemd made for the service that this process is, by the variable that names it. Its children inherit
/// the variable, and are no service.
pub(crate) fn of_service(variable: &str) -> Option<PathBuf> {
    let is_service = std::env::var_os("SYSTEMD_EXEC_PID").is_some_and(|pid| *pid == *std::process::id().to_string());
    std::env::var_os(variable).filter(|_| is_service).map(PathBuf::from).filter(|path| path.is_absolute())
}

/// Makes the folder of a run again where it is gone; false where it cannot be, or is somebody else's by now.
pub(crate) fn make_again(folder: &Path) -> bool {
    if is_own(folder) {
        return true;
    }
    let is_made = prepare(folder);
    if is_made {
        tracing::warn!("{} was taken away under this run, and is made again: {LINGER}", folder.display());
    }
    is_made
}

/// Makes a folder that only this user can write to; false where it cannot be, or is somebody else's.
fn prepare(folder: &Path) -> bool {
    std::fs::DirBuilder::new().recursive(true).mode(0o700).create(folder).is_ok() && is_own(folder)
}

/// Whether the folder is there and this user's.
pub(crate) fn is_own(folder: &Path) -> bool {
    std::fs::symlink_metadata(folder)
        .is_ok_and(|metadata| metadata.is_dir() && metadata.uid() == rustix::process::geteuid().as_raw())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_of_ones_own_is_made_and_a_link_is_none() {
        let root = tempfile::tempdir().unwrap();
        let own = root.path().join("own");
        assert!(prepare(&own) && prepare(&own));
        assert_eq!(std::fs::metadata(&own).unwrap().mode() & 0o777, 0o700);
        std::os::unix::fs::symlink(&own, root.path().join("link")).unwrap();
        assert!(!prepare(&root.path().join("link")));
    }
}
