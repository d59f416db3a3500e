//! The parts of the `holod` binary: command line, the frame loop, records and pictures.

pub mod cli;
pub mod commands;
pub mod evaluation;
pub mod failure;
pub mod pictures;
pub mod record;
pub mod report;
pub mod session;
pub mod setup;
pub mod staging;
pub mod status;
pub mod terminal;
