//! The parts of the `holod` binary: command line, configuration, the frame loop, records and pictures.

pub mod cli;
pub mod failure;
pub mod pictures;
pub mod record;
pub mod staging;
