//! `holod tracker`: which trackers there are, and what one of them sends.

mod list;
mod observed;
mod try_out;

use crate::cli::TrackerCommand;
use crate::failure::Failure;

pub(super) fn tracker(command: &TrackerCommand) -> Result<(), Failure> {
    match command {
        TrackerCommand::List(args) => list::list(args),
        TrackerCommand::Try(args) => try_out::try_out(args),
    }
}
