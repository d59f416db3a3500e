//! The parts of the `holod` binary: command line, the frame loop, records and pictures.

mod aside;
pub mod bug_report;
pub mod cli;
pub mod commands;
pub mod control;
pub mod destination;
pub mod evaluation;
pub mod exposure;
pub mod failure;
#[cfg(feature = "fault-injection")]
mod fault;
pub mod local_socket;
pub mod logging;
pub mod machine;
mod memory;
pub mod page;
pub mod pictures;
pub mod progress;
pub mod record;
pub mod renderer;
pub mod results;
pub mod run_text;
pub mod runtime_folder;
pub mod session;
pub mod setup;
pub mod snapshot;
pub mod source;
pub mod speed;
pub mod spread;
pub mod staging;
pub mod status;
mod tally_by;
pub mod terminal;
