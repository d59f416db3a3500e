//! What the end of a service's start has to do with its lasers.
//!
//! The unit's `ExecStopPost=` runs `holod dark --after-service` however a start has ended. After one that never opened
//! the lasers it leaves them alone: another holod may drive them. Two empty files tell:
//!
//! - `lasers-not-opened`, in the service's runtime folder, which systemd takes away after each start: there from the
//!   beginning of a start until it has opened the lasers and is about to drive them;
//! - `lasers-to-put-out`, in its state folder: there from before they are told to go out until they have acknowledged
//!   it. No start makes the first one meanwhile, so that each tries again.
//!
//! Where neither can be made or seen they are put out.

use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::PathBuf;

use crate::failure::{Exit, Failure};
use crate::runtime_folder;

/// The two files of a service.
#[derive(Clone, Debug)]
pub(crate) struct ServiceLasers {
    not_opened: PathBuf,
    to_put_out: PathBuf,
}

impl ServiceLasers {
    /// Those of the service that this process is of; nothing where it is of none.
    pub(crate) fn of_this_process() -> Option<Self> {
        let folder = runtime_folder::of_service;
        Some(Self::in_folders(folder("RUNTIME_DIRECTORY")?, folder("STATE_DIRECTORY")?))
    }

    fn in_folders(runtime: PathBuf, state: PathBuf) -> Self {
        Self { not_opened: runtime.join("lasers-not-opened"), to_put_out: state.join("lasers-to-put-out") }
    }

    /// Notes that the lasers are not open yet, unless an earlier start still owes their darkness.
    pub(crate) fn begin(&self) {
        match self.to_put_out.try_exists() {
            Ok(false) => {
                let _counts_as_opened = File::create(&self.not_opened);
            }
            _ => {
                let _not_there = fs::remove_file(&self.not_opened);
            }
        }
    }

    /// The lasers are open, and will be driven. That they are to be put out is on the disk then.
    ///
    /// # Errors
    /// They would not be put out after this start.
    pub(crate) fn open(&self) -> Result<(), Failure> {
        self.owe_darkness();
        match fs::remove_file(&self.not_opened) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(Failure::new(
                Exit::Unavailable,
                format!(
                    "{}: {error}: while it is there nobody puts the lasers out if this service fails; take it away",
                    self.not_opened.display()
                ),
            )),
            _ => Ok(()),
        }
    }

    /// Whether the start that has ended never opened them.
    pub(crate) fn are_untouched(&self) -> bool {
        self.not_opened.try_exists().unwrap_or(false)
    }

    /// They are to be told to go out.
    pub(crate) fn owe_darkness(&self) {
        let written = File::create(&self.to_put_out).and_then(|file| file.sync_all());
        let folder = self.to_put_out.parent().map_or(Ok(()), |folder| File::open(folder)?.sync_all());
        if let Err(error) = written.and(folder) {
            tracing::warn!(
                "{}: {error}: after a reset of the machine a start that fails early may leave the lasers as they are",
                self.to_put_out.display()
            );
        }
    }

    /// They have acknowledged that they are dark.
    pub(crate) fn are_dark(&self) {
        let _put_out_once_more = fs::remove_file(&self.to_put_out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn service() -> (tempfile::TempDir, ServiceLasers) {
        let root = tempfile::tempdir().unwrap();
        let [runtime, state] = ["runtime", "state"].map(|name| root.path().join(name));
        [&runtime, &state].iter().for_each(|folder| fs::create_dir(folder).unwrap());
        let lasers = ServiceLasers::in_folders(runtime, state);
        (root, lasers)
    }

    #[test]
    fn only_a_start_that_never_opened_its_lasers_leaves_them_alone() {
        let (_root, lasers) = service();
        assert!(!lasers.are_untouched(), "no start that says so");
        lasers.begin();
        assert!(lasers.are_untouched());
        lasers.open().unwrap();
        assert!(!lasers.are_untouched());
        lasers.open().unwrap();
        // The machine was reset, and nothing ran at the end of that start.
        lasers.begin();
        assert!(!lasers.are_untouched());
        lasers.are_dark();
        lasers.begin();
        assert!(lasers.are_untouched());
    }

    #[test]
    fn lasers_that_did_not_acknowledge_are_put_out_after_each_start_until_they_do() {
        let (_root, lasers) = service();
        lasers.begin();
        lasers.owe_darkness();
        lasers.begin();
        assert!(!lasers.are_untouched());
        lasers.are_dark();
        lasers.begin();
        assert!(lasers.are_untouched());
    }

    #[test]
    fn what_cannot_be_told_counts_as_opened() {
        let (root, lasers) = service();
        fs::remove_dir(root.path().join("runtime")).unwrap();
        lasers.begin();
        assert!(!lasers.are_untouched());
        lasers.open().unwrap();
        let (root, lasers) = service();
        fs::remove_dir(root.path().join("state")).unwrap();
        std::os::unix::fs::symlink("state", root.path().join("state")).unwrap();
        lasers.begin();
        assert!(!lasers.are_untouched(), "a state folder that cannot be looked into");
        fs::create_dir(&lasers.not_opened).unwrap();
        assert!(lasers.open().unwrap_err().to_string().contains("lasers-not-opened"));
    }
}
