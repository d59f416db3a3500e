//! holod's own recordings: files of [protocol lines](crate::wire::line).

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use crate::wire::line::LineDecoder;
use crate::wire::{Decoder, WireEvent};

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Lines, recognises, read };

fn recognises(input: &LogInput<'_>) -> bool {
    let first = input.head_lines().find(|line| line[0] != b'#');
    let tag = first.and_then(|line| line.strip_prefix(b"P")?.split(|byte| *byte == b',').next());
    tag.is_some_and(|digits| !digits.is_empty() && digits.iter().all(u8::is_ascii_digit))
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let mut lines = input.lines()?;
    let mut decoder = LineDecoder::new();
    while let Some(line) = lines.next(log) {
        let mut take = |event| match event {
            WireEvent::Sample(sample) => {
                let Some(t) = sample.t_device else { return log.count(LogFault::BadNumber) };
                let (eye, diameter, confidence) = (sample.eye, sample.diameter_mm, sample.confidence);
                log.push(LogSample { t, eye, diameter, confidence, aperture_mm: None, valid: true }, line.number);
            }
            WireEvent::Rejected(fault) => log.count(LogFault::Wire(fault)),
            WireEvent::Note | WireEvent::Partial | WireEvent::Clock(_) => {}
        };
        decoder.push(line.bytes, &mut take);
        decoder.finish(&mut take);
    }
    Ok(())
}
