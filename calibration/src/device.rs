//! Why a device's node does not open.

use std::fs::File;
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;
use rustix::io::Errno;

/// What is to be done where [`is_kept_by_unit`].
pub const KEPT_BY_UNIT: &str = "the service's unit does not allow this device, whatever its group and mode are: `holod \
     unit` with the service's options writes its drop-in anew (`holod check --service` says what it lacks); a container \
     must allow it";

/// Whether what opening a device's node came to is the answer of a control group that allows only some devices, as the
/// service's has it: that answers EPERM, where a node's group and mode would answer EACCES.
pub fn is_kept_by_unit(error: &io::Error) -> bool {
    Errno::from_io_error(error) == Some(Errno::PERM)
}

/// The same of the node at `path`, for those whose error does not tell the two answers apart.
pub fn unit_keeps(path: &Path) -> bool {
    let flags = (OFlags::NONBLOCK | OFlags::NOCTTY).bits() as i32;
    let opened = File::options().read(true).write(true).custom_flags(flags).open(path);
    opened.is_err_and(|error| is_kept_by_unit(&error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_units_answer_is_told_from_that_of_a_nodes_mode() {
        assert!(is_kept_by_unit(&Errno::PERM.into()));
        for other in [Errno::ACCESS, Errno::NOENT, Errno::BUSY] {
            assert!(!is_kept_by_unit(&other.into()), "{other}");
        }
        assert!(!is_kept_by_unit(&io::ErrorKind::PermissionDenied.into()));
        assert!(!unit_keeps(Path::new("/dev/null")) && !unit_keeps(Path::new("/dev/no-such-device")));
    }
}
