//! `holod log`: what logs of pupil diameters hold, and other forms of them.

mod convert;
mod info;

use std::path::Path;

use holod_pupil_input::{Recording, ReplayError, SizeUnit, scaled_millimetres};

use crate::bug_report;
use crate::cli::LogCommand;
use crate::failure::{Exit, Failure};

pub(super) fn log(command: &LogCommand) -> Result<(), Failure> {
    match command {
        LogCommand::Info(args) => info::info(args),
        LogCommand::Convert(args) => convert::convert(args),
    }
}

fn read(path: &Path) -> Result<Recording, Failure> {
    bug_report::refuse_archive(path)?;
    Recording::read(path).map_err(|error| {
        let exit = if matches!(error, ReplayError::Io { .. }) { Exit::NoInput } else { Exit::Data };
        Failure::because(exit)(error)
    })
}

/// That the log is in millimetres already, and is scaled all the same.
fn odd_scale(path: &Path, recording: &Recording, scale: Option<f64>) -> Option<String> {
    let scale = scale.filter(|scale| recording.unit() == SizeUnit::Millimetres && *scale != 1.0)?;
    Some(scaled_millimetres(&format!("pupil log {}", path.display()), scale))
}
