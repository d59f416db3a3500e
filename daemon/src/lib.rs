//! The parts of the `holod` binary: command line, the frame loop, records and pictures.

mod aside;
pub mod bug_report;
pub mod cli;
pub mod commands;
pub mod control;
mod dark_note;
mod destination;
pub mod evaluation;
pub mod exposure;
pub mod failure;
#[cfg(feature = "fault-injection")]
mod fault;
mod local_socket;
pub mod logging;
mod machine;
pub mod made_with;
mod memory;
mod overwriting;
pub mod page;
pub mod pictures;
mod progress;
mod record;
pub mod renderer;
pub mod results;
mod run_text;
mod runtime_folder;
mod service_lasers;
pub mod session;
pub mod setup;
mod snapshot;
pub mod source;
mod speed;
mod spread;
mod staging;
mod status;
mod tally_by;
mod terminal;
