//! What may be overwritten: the same rule for every command.

use std::path::PathBuf;

use holod_calibration::special_file;

use crate::failure::{Exit, Failure};

/// Refuses to overwrite any of `paths`, unless with `force`; devices, pipes and sockets always.
///
/// # Errors
/// One of them is there already.
pub(crate) fn refuse_existing(
    paths: impl IntoIterator<Item = PathBuf>,
    option: &str,
    force: bool,
) -> Result<(), Failure> {
    for path in paths {
        let found = match special_file(&path) {
            Some(found) => format!("is {found}, which no file takes the place of; name another place with {option}"),
            None if !force && path.symlink_metadata().is_ok() => {
                format!("exists already; name another place with {option}, or overwrite it with --force")
            }
            None => continue,
        };
        return Err(Failure::new(Exit::CannotCreate, format!("{} {found}", path.display())));
    }
    Ok(())
}
