//! What is wrong with a log: as a whole, or with one line of it.

use std::ops::AddAssign;
use std::path::PathBuf;

use crate::wire::WireFault;

/// What went wrong with a log as a whole.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum ReplayError {
    /// It cannot be read.
    #[error("pupil log {path}: {source}; expected a readable file")]
    Io { path: PathBuf, source: std::io::Error },
    /// It is a directory or a device.
    #[error("pupil log {path} is {found}; expected a log file{hint}")]
    NotAFile { path: PathBuf, found: &'static str, hint: &'static str },
    /// Its beginning is of no known format.
    #[error("pupil log {path}, line 1: found {found}; expected one of: {formats}; {advice}")]
    UnknownFormat { path: PathBuf, found: String, formats: String, advice: &'static str },
    /// It is of a known format and wrong as a whole.
    #[error("pupil log {path}{at}: found {found}; expected {expected}")]
    Content {
        path: PathBuf,
        /// `, line 7`, or nothing.
        at: String,
        found: String,
        /// What should be there, and what to do.
        expected: String,
    },
    /// Not one sample could be read.
    #[error("pupil log {path} holds no sample: {why}; expected at least one")]
    Empty {
        path: PathBuf,
        /// What there is in its place.
        why: String,
    },
    /// Its times are in no order.
    #[error(
        "pupil log {path} is not in order of time: {backwards} of {rows} times go backwards, the first in line {line}; \
         expected samples in the order in which they were taken; export it again, each recording into a file of its own \
         (to sort it by time would mix recordings)"
    )]
    Unsorted {
        path: PathBuf,
        /// Times that go backwards.
        backwards: u64,
        /// All times of the log.
        rows: u64,
        /// Line of the first.
        line: u64,
    },
}

crate::named::named! {
    /// Why a line or a cell of a log was rejected.
    pub enum LogFault {
        /// A message of a wire format with this fault.
        Wire(WireFault),
        /// A row that is too short or too long, or not text.
        Malformed = "log_malformed",
        /// Time or diameter is not a number.
        BadNumber = "log_bad_number",
        /// The diameter is missing.
        Missing = "log_missing",
        /// The diameter is NaN or infinite.
        NotFinite = "log_not_finite",
        /// The diameter is negative.
        Negative = "log_negative",
        /// The time lies before its predecessor's.
        Backwards = "log_backwards",
        /// A line longer than any of a log.
        TooLong = "log_too_long",
        /// The eye is none that the format knows.
        BadEye = "log_bad_eye",
        /// The confidence lies outside 0 to 1.
        BadConfidence = "log_bad_confidence",
    }
}

/// How many lines or cells of a log were rejected, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LogFaults([u64; LogFault::NAMES.len()]);

impl LogFaults {
    /// How many were rejected for `fault`.
    pub const fn of(&self, fault: LogFault) -> u64 {
        self.0[fault.index()]
    }

    /// How many were rejected in all.
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }

    /// Each reason's name and count.
    pub fn entries(&self) -> impl Iterator<Item = (&'static str, u64)> {
        LogFault::NAMES.into_iter().zip(self.0)
    }

    pub(crate) const fn count(&mut self, fault: LogFault) {
        self.0[fault.index()] += 1;
    }
}

impl AddAssign for LogFaults {
    fn add_assign(&mut self, other: Self) {
        for (count, more) in self.0.iter_mut().zip(other.0) {
            *count += more;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn every_fault_has_a_name_of_its_own() {
        assert_eq!(LogFault::NAMES.iter().collect::<HashSet<_>>().len(), LogFault::NAMES.len());
        assert_eq!(LogFault::NAMES[LogFault::TooLong.index()], "log_too_long");
        assert_eq!(LogFault::NAMES[LogFault::BadEye.index()], "log_bad_eye");
        assert_eq!(LogFault::NAMES[LogFault::Malformed.index()], "log_malformed");
    }
}
