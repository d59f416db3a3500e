//! `holod tracker`: which trackers there are, and what one of them sends.

mod list;
mod observed;
mod try_out;

use holod_pupil_input::udev_rule;

use crate::cli::TrackerCommand;
use crate::failure::Failure;
use crate::results;

pub(super) fn tracker(command: &TrackerCommand) -> Result<(), Failure> {
    match command {
        TrackerCommand::List(args) => list::list(args),
        TrackerCommand::Rule(args) => results::print(udev_rule(args.ids).trim_end()),
        TrackerCommand::Try(args) => try_out::try_out(args),
    }
}
