//! `holod log convert`: a log in another format.

use holod_pupil_input::export;

use super::{odd_scale, read};
use crate::cli::{LogConvertArgs, LogFormatArg};
use crate::destination::Destination;
use crate::failure::{Exit, Failure};
use crate::results;

pub(super) fn convert(args: &LogConvertArgs) -> Result<(), Failure> {
    let out = Destination::new(&args.out, "--out", args.force)?;
    if args.to == LogFormatArg::Csv && args.scale.is_some() {
        return Err(Failure::new(Exit::Usage, "--scale is for --to lines: CSV keeps the log's own unit"));
    }
    let recording = read(&args.log)?;
    for note in recording.notes() {
        tracing::info!("{note}");
    }
    if let Some(warning) = odd_scale(&args.log, &recording, args.scale) {
        tracing::warn!("{warning}");
    }
    out.write(|path| {
        let written = match args.to {
            LogFormatArg::Lines => export::write_lines(&recording, args.scale, path),
            LogFormatArg::Csv => export::write_csv(&recording, path),
        };
        written.map_err(|error| {
            let exit = match error {
                export::ExportError::Io { .. } => Exit::CannotCreate,
                _ => Exit::Usage,
            };
            Failure::because(exit)(error)
        })
    })?;
    if args.to == LogFormatArg::Lines && recording.samples().any(|sample| sample.aperture_mm.is_some()) {
        tracing::warn!(
            "the log has lid apertures, by which the gate knows blinks; the line protocol has none: --to csv keeps them"
        );
    }
    let rejected = recording.faults().total();
    if out.is_stdout() {
        return Ok(());
    }
    results::print(&format!(
        "{}: {} samples of {} written to {}; {rejected} lines or cells held none",
        args.log.display(),
        recording.len(),
        recording.format(),
        args.out.display(),
    ))
}
