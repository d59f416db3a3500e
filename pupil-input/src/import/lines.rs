//! holod's own recordings: files of [protocol lines](crate::wire::line).

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use crate::clock::RESTART;
use crate::wire::line::LineDecoder;
use crate::wire::{Decoder, WireEvent, WireSample};

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Lines, recognises, read };

/// Lines of a log in which a whole one of the protocol is looked for: what a board says as it starts, or a terminal
/// program's header, may come first.
const LINES_LOOKED_AT: usize = 64;

fn recognises(input: &LogInput<'_>) -> bool {
    let first = input.head_lines().find(|line| line[0] != b'#');
    let tag = first.and_then(|line| line.strip_prefix(b"P")?.split(|byte| *byte == b',').next());
    tag.is_some_and(|digits| !digits.is_empty() && digits.iter().all(u8::is_ascii_digit))
        || input.head_lines().take(LINES_LOOKED_AT).any(is_checked)
}

/// Whether a line is one of the protocol, with a checksum that is right.
fn is_checked(line: &[u8]) -> bool {
    let mut decoder = LineDecoder::new();
    let mut is_sample = false;
    let mut take = |event| is_sample |= matches!(event, WireEvent::Sample(_));
    if line.starts_with(b"P1,") {
        decoder.push(line, &mut take);
        decoder.finish(&mut take);
    }
    is_sample
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let mut lines = input.lines()?;
    let mut decoder = LineDecoder::new();
    let mut counter = Counter::default();
    while let Some(line) = lines.next(log) {
        let mut take = |event| match event {
            WireEvent::Sample(sample) => {
                let Some(t) = sample.t_device else { return log.count(LogFault::BadNumber) };
                let WireSample { eye, diameter_mm: diameter, confidence, valid, .. } = sample;
                let t = counter.next(t);
                log.push(LogSample { t, eye, diameter, confidence, aperture_mm: None, valid }, line.number);
            }
            WireEvent::Rejected(fault) => log.count(LogFault::Wire(fault)),
            WireEvent::Note | WireEvent::Partial | WireEvent::Clock(_) => {}
        };
        decoder.push(line.bytes, &mut take);
        decoder.finish(&mut take);
    }
    match counter.wraps {
        0 => {}
        1 => log.note("its times are a counter of 32 bits of microseconds, and go on over its wrap"),
        wraps => {
            log.note(format!("its times are a counter of 32 bits of microseconds, and go on over its {wraps} wraps"))
        }
    }
    Ok(())
}

/// A counter of 32 bits of microseconds, such as a microcontroller's `micros()`, begins again at 0 after this.
const WRAP_NS: i64 = (1 << 32) * 1000;
/// The longest pause between samples that is looked for around a wrap; a counter that comes back later than that may as
/// well have been started again.
const WRAP_PAUSE_NS: i64 = 10_000_000_000;

/// Such a counter, made one that goes on.
#[derive(Default)]
struct Counter {
    wraps: u64,
    /// Added to its times.
    later_ns: i64,
    /// As written, of those since the last wrap.
    latest_ns: Option<i64>,
}

impl Counter {
    fn next(&mut self, t: TimeNs) -> TimeNs {
        let t_ns = t.0;
        let latest_ns = self.latest_ns.unwrap_or(t_ns);
        let since_ns = t_ns.saturating_add(WRAP_NS).saturating_sub(latest_ns);
        if t_ns >= 0 && latest_ns < WRAP_NS && (0..=WRAP_PAUSE_NS).contains(&since_ns) {
            self.wraps += 1;
            self.later_ns = self.later_ns.saturating_add(WRAP_NS);
            self.latest_ns = Some(t_ns);
        } else if self.wraps > 0
            && t_ns < WRAP_NS
            && latest_ns.saturating_add(WRAP_NS.saturating_sub(t_ns)) <= RESTART.0
        {
            // The other eye's, from before the wrap.
            return TimeNs(t_ns.saturating_add(self.later_ns - WRAP_NS));
        } else {
            self.latest_ns = Some(latest_ns.max(t_ns));
        }
        TimeNs(t_ns.saturating_add(self.later_ns))
    }
}
