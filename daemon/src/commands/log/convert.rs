//! `holod log convert`: a log in another format.

use std::path::Path;

use holod_pupil_input::export;

use super::{odd_scale, read};
use crate::cli::{LogConvertArgs, LogFormatArg};
use crate::destination::Destination;
use crate::failure::{Exit, Failure};
use crate::results;

pub(super) fn convert(args: &LogConvertArgs) -> Result<(), Failure> {
    let out = Destination::new(&args.out, "--out", args.force)?;
    out.refuse_inputs("--out", [args.log.clone()])?;
    if args.to == LogFormatArg::Csv && args.scale.is_some() {
        return Err(Failure::new(Exit::Usage, "--scale is for --to lines: CSV keeps the log's own unit"));
    }
    let recording = read(&args.log)?;
    for warning in recording.warnings() {
        tracing::warn!("{warning}");
    }
    for remark in recording.remarks() {
        tracing::info!("{remark}");
    }
    if let Some(warning) = odd_scale(&args.log, &recording, args.scale) {
        tracing::warn!("{warning}");
    }
    if let Some(scale) = recording.recorded_scale().filter(|scale| args.to == LogFormatArg::Csv && *scale != 1.0) {
        tracing::warn!(
            "the run had a scale of {scale} mm per unit, which CSV does not keep: give --scale {scale} wherever it is read, \
             or write --to lines, which are in millimetres of the eye"
        );
    }
    let scale = args.scale.or(recording.recorded_scale());
    out.write(|path| {
        let written = match args.to {
            LogFormatArg::Lines => export::write_lines(&recording, scale, path),
            LogFormatArg::Csv => export::write_csv(&recording, path),
        };
        written.map_err(|error| {
            let exit = match error {
                export::ExportError::Io { .. } => Exit::CannotCreate,
                _ => Exit::Usage,
            };
            // A way to standard output is no file that a person named.
            Failure::because(exit)(if out.is_stdout() { error.of(Path::new("standard output")) } else { error })
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
