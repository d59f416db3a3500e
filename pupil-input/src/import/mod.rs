//! Logs of pupil diameters, told apart by their content and read into one shape: one file for each format.
//!
//! A log is read in one pass, as a stream: what stays in memory is 24 bytes a sample.

mod bids;
mod core;
pub(crate) mod csv;
mod eyelink;
mod gazepoint;
mod info;
mod lines;
mod neon;
mod pupilext;
pub(crate) mod raw;
mod smi;
mod table;
mod text;
mod tobii;
mod unpack;
mod xdf;

use std::cell::RefCell;
use std::fmt;
use std::fs::File;
use std::io::{self, BufRead, ErrorKind, Read};
use std::ops::AddAssign;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use holod_calibration::TimeNs;

use crate::wire::WireFault;
use crate::{PupilSample, SampleEye};

pub use info::{BlinkCounts, EyeInfo, FaultCount, LogInfo, Range};
use text::Lines;

/// The kinds of log that are known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogFormat {
    /// holod's line protocol.
    Lines,
    /// Pupil Labs Neon, 3D eye states of its cloud.
    NeonEyeStates,
    /// holod's recording of the bytes of a link.
    Raw,
    /// holod's own CSV.
    Csv,
    /// Tobii Pro Lab or Studio.
    Tobii,
    /// Gazepoint Analysis or Control.
    Gazepoint,
    /// PupilEXT.
    PupilExt,
    /// Lab Streaming Layer recordings.
    Xdf,
    /// BIDS eye tracking.
    Bids,
    /// Pupil Labs Neon, eye states as its phone writes them.
    NeonNative,
    /// Pupil Labs Core.
    Core,
    /// SR Research EyeLink.
    EyeLink,
    /// SMI, of BeGaze or the IDF converter.
    Smi,
}

impl LogFormat {
    /// Its name for people.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Lines => "holod line protocol",
            Self::NeonEyeStates => "Pupil Labs Neon 3d_eye_states.csv",
            Self::Raw => "holod recording of a link",
            Self::Csv => "holod CSV",
            Self::Tobii => "Tobii Pro Lab or Studio TSV",
            Self::Gazepoint => "Gazepoint CSV",
            Self::PupilExt => "PupilEXT CSV",
            Self::Xdf => "XDF (Lab Streaming Layer)",
            Self::Bids => "BIDS eye tracking _physio.tsv.gz",
            Self::NeonNative => "Pupil Labs Neon eye_state raw",
            Self::Core => "Pupil Labs Core pupil_positions.csv",
            Self::EyeLink => "EyeLink .asc",
            Self::Smi => "SMI BeGaze text",
        }
    }
}

impl fmt::Display for LogFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What a tracker's figures are, before the rig's scale.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SizeUnit {
    /// Diameters in millimetres.
    #[default]
    Millimetres,
    /// Diameters in pixels of the eye camera.
    Pixels,
    /// Diameters in units of the tracker's own; an area A is given as the diameter 2·√(A/π) of its disc.
    Arbitrary,
}

impl SizeUnit {
    /// Its name for people.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Millimetres => "mm",
            Self::Pixels => "camera pixels",
            Self::Arbitrary => "arbitrary units",
        }
    }
}

/// What goes into reading one log, apart from the log itself.
pub(crate) struct Importer {
    pub(crate) format: LogFormat,
    /// Whether the log is of this format; looks at content.
    pub(crate) recognises: fn(&LogInput<'_>) -> bool,
    /// Reads all of it into the builder. Single bad lines are counted there; an error is for a log that is wrong as a whole.
    pub(crate) read: fn(&LogInput<'_>, &mut LogBuilder) -> Result<(), ReplayError>,
}

/// In the order in which they are asked; no two recognise the same log.
const IMPORTERS: &[Importer] = &[
    raw::IMPORTER,
    lines::IMPORTER,
    neon::CLOUD,
    neon::NATIVE,
    core::IMPORTER,
    eyelink::IMPORTER,
    smi::IMPORTER,
    csv::IMPORTER,
    xdf::IMPORTER,
    tobii::IMPORTER,
    gazepoint::IMPORTER,
    pupilext::IMPORTER,
    bids::IMPORTER,
];

/// A log file that has not been read yet.
pub(crate) struct LogInput<'a> {
    pub(crate) path: &'a Path,
    /// Its first 64 KiB (all of a shorter one), as [`Self::open`] gives them.
    pub(crate) head: Vec<u8>,
    failure: Failure,
}

/// The first error of any reader of a log.
type Failure = Rc<RefCell<Option<io::Error>>>;

const HEAD_BYTES: u64 = 1 << 16;

impl<'a> LogInput<'a> {
    fn new(path: &'a Path) -> Result<Self, ReplayError> {
        let mut input = Self::at(path);
        let mut head = Vec::new();
        input.open()?.take(HEAD_BYTES).read_to_end(&mut head).map_err(|source| input.io(source))?;
        input.head = head;
        Ok(input)
    }

    /// A file whose beginning nobody looks at.
    pub(crate) fn at(path: &'a Path) -> Self {
        Self { path, head: Vec::new(), failure: Failure::default() }
    }

    /// From its beginning: unpacked if it is gzip, in UTF-8 if it is UTF-16, without a byte order mark.
    ///
    /// Where reading fails the file seems to end, and [`Self::failed`] tells why.
    pub(crate) fn open(&self) -> Result<Box<dyn BufRead>, ReplayError> {
        let reader = File::open(self.path).and_then(unpack::plain).map_err(|source| self.io(source))?;
        Ok(Box::new(Watched { reader, failure: self.failure.clone() }))
    }

    /// Why reading failed, if it did.
    pub(crate) fn failed(&self) -> Result<(), ReplayError> {
        self.failure.take().map_or(Ok(()), |source| Err(self.io(source)))
    }

    /// Its lines from its beginning.
    pub(crate) fn lines(&self) -> Result<Lines, ReplayError> {
        Ok(Lines::new(self.open()?))
    }

    /// Its non-empty first lines, trimmed; the last may be cut off by the end of the head.
    pub(crate) fn head_lines(&self) -> impl Iterator<Item = &[u8]> {
        self.head.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).filter(|line| !line.is_empty())
    }

    pub(crate) fn io(&self, source: io::Error) -> ReplayError {
        ReplayError::Io { path: self.path.into(), source }
    }

    /// An error for what is wrong with the log as a whole.
    pub(crate) fn content(&self, found: impl Into<String>, expected: impl Into<String>) -> ReplayError {
        ReplayError::Content {
            path: self.path.into(),
            at: String::new(),
            found: found.into(),
            expected: expected.into(),
        }
    }
}

/// A reader that ends where reading fails, and keeps why.
struct Watched<R> {
    reader: R,
    failure: Failure,
}

impl<R: BufRead> Read for Watched<R> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut piece = self.fill_buf()?;
        let count = piece.read(into)?;
        self.consume(count);
        Ok(count)
    }
}

impl<R: BufRead> BufRead for Watched<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        while self.failure.borrow().is_none() {
            match self.reader.fill_buf() {
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => *self.failure.borrow_mut() = Some(error),
                // Asked once more, since a piece that is returned from a loop is borrowed for good.
                Ok(_) => return self.reader.fill_buf(),
            }
        }
        Ok(&[])
    }

    fn consume(&mut self, count: usize) {
        self.reader.consume(count);
    }
}

/// What went wrong with a log as a whole.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// It cannot be read.
    #[error("pupil log {path}: {source}; expected a readable file")]
    Io {
        /// The log.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It is a directory or a device.
    #[error("pupil log {path} is {found}; expected a log file{hint}")]
    NotAFile {
        /// The path.
        path: PathBuf,
        /// What it is.
        found: &'static str,
        /// What to do.
        hint: &'static str,
    },
    /// Its beginning is of no known format.
    #[error(
        "pupil log {path}, line 1: found {found}; expected one of: {}; convert the log to one of these",
        known_formats()
    )]
    UnknownFormat {
        /// The log.
        path: PathBuf,
        /// How it begins.
        found: String,
    },
    /// It is of a known format and wrong as a whole.
    #[error("pupil log {path}{at}: found {found}; expected {expected}")]
    Content {
        /// The log.
        path: PathBuf,
        /// `, line 7`, or nothing.
        at: String,
        /// What is there.
        found: String,
        /// What should be there, and what to do.
        expected: String,
    },
    /// Not one sample could be read.
    #[error(
        "pupil log {path} holds no sample: {rejected} of its lines were rejected ({reasons}); expected at least one"
    )]
    Empty {
        /// The log.
        path: PathBuf,
        /// Rejected lines.
        rejected: u64,
        /// How many for which reason.
        reasons: String,
    },
    /// Its times are in no order.
    #[error(
        "pupil log {path} is not in order of time: {backwards} of {rows} times go backwards, the first in line {line}; \
         sort it by time"
    )]
    Unsorted {
        /// The log.
        path: PathBuf,
        /// Times that go backwards.
        backwards: u64,
        /// Times in all.
        rows: u64,
        /// Line of the first.
        line: u64,
    },
}

/// Why a line or a cell of a log was rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum LogFault {
    /// A message of a wire format with this fault.
    Wire(WireFault),
    /// A row that is too short or not text.
    Malformed,
    /// A line longer than any of a log.
    TooLong,
    /// The eye is none that the format knows.
    BadEye,
    /// Time or diameter is not a number.
    BadNumber,
    /// The diameter is missing.
    Missing,
    /// The diameter is NaN or infinite.
    NotFinite,
    /// The diameter is negative.
    Negative,
    /// The time lies before its predecessor's.
    Backwards,
}

/// The names under which faults are counted, in the order of [`LogFault::index`].
pub(crate) const LOG_FAULT_NAMES: [&str; 8 + WireFault::ALL.len()] = {
    let mut names = [""; 8 + WireFault::ALL.len()];
    let mut k = 0;
    while k < WireFault::ALL.len() {
        names[k] = WireFault::ALL[k].name();
        k += 1;
    }
    names[k] = "log_malformed";
    names[k + 1] = "log_bad_number";
    names[k + 2] = "log_missing";
    names[k + 3] = "log_not_finite";
    names[k + 4] = "log_negative";
    names[k + 5] = "log_backwards";
    names[k + 6] = "log_too_long";
    names[k + 7] = "log_bad_eye";
    names
};

impl LogFault {
    pub(crate) const fn index(self) -> usize {
        let lines = WireFault::ALL.len();
        match self {
            Self::Wire(fault) => fault.index(),
            Self::Malformed => lines,
            Self::BadNumber => lines + 1,
            Self::Missing => lines + 2,
            Self::NotFinite => lines + 3,
            Self::Negative => lines + 4,
            Self::Backwards => lines + 5,
            Self::TooLong => lines + 6,
            Self::BadEye => lines + 7,
        }
    }
}

/// How many lines or cells of a log were rejected, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LogFaults([u64; LOG_FAULT_NAMES.len()]);

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
        LOG_FAULT_NAMES.into_iter().zip(self.0)
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

/// One recorded sample, compact.
#[derive(Clone, Copy, Debug)]
struct Row {
    t_ns: i64,
    diameter_mm: f32,
    confidence: f32,
    /// NaN where there is none.
    aperture_mm: f32,
    eye: SampleEye,
    valid: bool,
}

/// A sample for [`LogBuilder::push`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct LogSample {
    pub(crate) t: TimeNs,
    pub(crate) eye: SampleEye,
    /// In the log's unit; means nothing unless `valid`.
    pub(crate) diameter: f32,
    /// 1 where the log has none.
    pub(crate) confidence: f32,
    pub(crate) aperture_mm: Option<f32>,
    /// False where the log says that the tracker saw no pupil: such a sample tells the gate of a blink, a missing one does
    /// not.
    pub(crate) valid: bool,
}

/// A blink that the tracker or its software found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Blink {
    /// The eye; both where the log does not say.
    pub eye: SampleEye,
    /// Its first instant on the log's clock.
    pub begins: TimeNs,
    /// Its last instant on the log's clock.
    pub ends: TimeNs,
}

/// What an importer fills.
#[derive(Debug, Default)]
pub(crate) struct LogBuilder {
    rows: Vec<Row>,
    pub(crate) faults: LogFaults,
    pub(crate) unit: SizeUnit,
    /// The rate that the log's header states.
    pub(crate) stated_rate_hz: Option<f64>,
    pub(crate) blinks: Vec<Blink>,
    /// What a user should know of how the log was read, a sentence each.
    pub(crate) notes: Vec<String>,
    /// Lines or rows whose time could be read.
    times: u64,
    first_backwards: Option<u64>,
    /// The last line, where the file ends within it, and how many malformed ones there were before it.
    unended: Option<(u64, u64)>,
    /// Of each eye: the cameras of two eyes may run free of each other.
    latest_ns: [Option<i64>; 3],
}

/// By how many samples one eye may be behind the other before the whole log is sorted.
const EYES_OUT_OF_STEP: usize = 64;

/// Samples that are kept: 2.4 GB of them.
const MOST_SAMPLES: usize = 100_000_000;
/// A time beyond this, a hundred years from any origin, is no time; differences of two stay within i64.
const GREATEST_NS: u64 = 3_200_000_000_000_000_000;

impl LogBuilder {
    pub(crate) fn count(&mut self, fault: LogFault) {
        self.faults.count(fault);
    }

    /// Takes a sample of line (or record) `line`; one that goes back in time against its own eye is counted and dropped.
    pub(crate) fn push(&mut self, sample: LogSample, line: u64) {
        let LogSample { t, eye, diameter, confidence, aperture_mm, valid } = sample;
        if t.0.unsigned_abs() > GREATEST_NS {
            return self.count(LogFault::BadNumber);
        }
        // Not even a finite figure need be one in f32, or once it is in millimetres.
        if valid && !diameter.is_finite() {
            return self.count(LogFault::NotFinite);
        }
        self.times += 1;
        if self.rows.len() == MOST_SAMPLES {
            return self.count(LogFault::TooLong);
        }
        let latest = &mut self.latest_ns[eye.index()];
        if latest.is_some_and(|latest| t.0 < latest) {
            self.first_backwards.get_or_insert(line);
            return self.count(LogFault::Backwards);
        }
        *latest = Some(t.0);
        let aperture_mm = aperture_mm.unwrap_or(f32::NAN);
        let row = Row { t_ns: t.0, diameter_mm: diameter, confidence, aperture_mm, eye, valid };
        // The eyes come interleaved, a few samples out of step; what lies farther back is left to one sort at the end.
        let recent = self.rows.len().saturating_sub(EYES_OUT_OF_STEP);
        let behind = self.rows[recent..].iter().rev().take_while(|before| before.t_ns > row.t_ns).count();
        if behind == 0 || behind == EYES_OUT_OF_STEP {
            self.rows.push(row);
        } else {
            self.rows.insert(self.rows.len() - behind, row);
        }
    }

    /// The file ends within line `line`, which is handed out next.
    pub(crate) const fn ends_within(&mut self, line: u64) {
        self.unended = Some((line, self.faults.of(LogFault::Malformed)));
    }

    /// The latest time of any eye.
    pub(crate) fn latest(&self) -> Option<TimeNs> {
        self.latest_ns.into_iter().flatten().max().map(TimeNs)
    }

    /// Tells the user something of how the log was read.
    pub(crate) fn note(&mut self, note: impl Into<String>) {
        self.notes.push(note.into());
    }

    /// Reads a diameter's cell: a finite number that is not negative.
    pub(crate) fn diameter(cell: impl AsRef<[u8]>) -> Result<f32, LogFault> {
        let cell = cell.as_ref();
        if cell.is_empty() {
            return Err(LogFault::Missing);
        }
        let diameter = text::number(cell).ok_or(LogFault::BadNumber)? as f32;
        if !diameter.is_finite() {
            Err(LogFault::NotFinite)
        } else if diameter < 0.0 {
            Err(LogFault::Negative)
        } else {
            Ok(diameter)
        }
    }

    fn finish(mut self, format: LogFormat, path: &Path) -> Result<Recording, ReplayError> {
        let backwards = self.faults.of(LogFault::Backwards);
        if backwards * 2 > self.times {
            let line = self.first_backwards.unwrap_or(0);
            return Err(ReplayError::Unsorted { path: path.into(), backwards, rows: self.times, line });
        }
        if self.rows.is_empty() {
            let reasons = self.faults.entries().filter(|(_, count)| *count > 0);
            let reasons: Vec<_> = reasons.map(|(name, count)| format!("{name} {count}")).collect();
            let reasons = if reasons.is_empty() { "there are no lines".into() } else { reasons.join(", ") };
            return Err(ReplayError::Empty { path: path.into(), rejected: self.faults.total(), reasons });
        }
        if self.rows.len() == MOST_SAMPLES {
            return Err(ReplayError::Content {
                path: path.into(),
                at: String::new(),
                found: format!("more than {MOST_SAMPLES} samples"),
                expected: "no more, which is a day of one eye at 1 kHz; cut the log into pieces".into(),
            });
        }
        if !self.rows.is_sorted_by_key(|row| row.t_ns) {
            self.rows.sort_by_key(|row| row.t_ns);
        }
        self.rows.shrink_to_fit();
        if let Some((line, malformed)) = self.unended
            && self.faults.of(LogFault::Malformed) > malformed
        {
            self.notes.push(format!(
                "line {line}, the last one, ends before its columns do: the file is cut off; copy or export it again"
            ));
        }
        if let Some(rate_hz) = slow_rate_hz(&self.rows) {
            self.notes.push(format!(
                "{rate_hz:.1} samples a second is no eye tracker's rate: this looks like a table of fixations or of means; \
                 export every sample instead (with Gazepoint: `..._all_gaze.csv`)"
            ));
        }
        self.blinks.sort_by_key(|blink| blink.begins);
        let Self { rows, faults, unit, stated_rate_hz, blinks, notes, .. } = self;
        Ok(Recording { format, unit, rows, blinks, faults, stated_rate_hz, notes })
    }
}

/// A whole log in memory, in order of time.
#[derive(Clone, Debug)]
pub struct Recording {
    format: LogFormat,
    unit: SizeUnit,
    rows: Vec<Row>,
    blinks: Vec<Blink>,
    faults: LogFaults,
    stated_rate_hz: Option<f64>,
    notes: Vec<String>,
}

impl Recording {
    /// Reads a log.
    ///
    /// # Errors
    /// It is no readable file, of no known format, without a single sample, or in no order of time. Single bad lines are
    /// counted instead: [`Self::faults`].
    pub fn read(path: &Path) -> Result<Self, ReplayError> {
        let kind = std::fs::metadata(path).map_err(|source| ReplayError::Io { path: path.into(), source })?.file_type();
        if kind.is_dir() {
            let hint = "; give the file in it, such as 3d_eye_states.csv";
            return Err(ReplayError::NotAFile { path: path.into(), found: "a directory", hint });
        }
        if !kind.is_file() {
            let hint = "; for a live tracker give `serial:PATH`";
            return Err(ReplayError::NotAFile { path: path.into(), found: "a device or pipe", hint });
        }
        let input = LogInput::new(path)?;
        input.failed()?;
        let importer = IMPORTERS
            .iter()
            .find(|importer| (importer.recognises)(&input))
            .ok_or_else(|| ReplayError::UnknownFormat { path: path.into(), found: beginning(&input) })?;
        let mut builder = LogBuilder::default();
        (importer.read)(&input, &mut builder)?;
        input.failed()?;
        builder.finish(importer.format, path)
    }

    /// The format that was recognised.
    pub const fn format(&self) -> LogFormat {
        self.format
    }

    /// What the diameters are, before the rig's scale.
    pub const fn unit(&self) -> SizeUnit {
        self.unit
    }

    /// The rate that the log's header states, if it does.
    pub const fn stated_rate_hz(&self) -> Option<f64> {
        self.stated_rate_hz
    }

    /// What a user should know of how the log was read.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// How many samples there are.
    pub const fn len(&self) -> usize {
        self.rows.len()
    }

    /// Never: a log without samples is an error.
    pub const fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Blinks that the log or a companion file tells, in order of time. They do not reach the gate, since no live tracker
    /// knows them.
    pub fn blinks(&self) -> &[Blink] {
        &self.blinks
    }

    /// What was rejected.
    pub const fn faults(&self) -> LogFaults {
        self.faults
    }

    /// Time of the first sample on the log's clock.
    pub fn begins(&self) -> TimeNs {
        TimeNs(self.rows[0].t_ns)
    }

    /// Time of the last sample on the log's clock.
    pub fn ends(&self) -> TimeNs {
        TimeNs(self.rows[self.rows.len() - 1].t_ns)
    }

    /// Every sample, its three times the log's own.
    pub fn samples(&self) -> impl Iterator<Item = PupilSample> {
        (0..self.rows.len()).map(|index| self.sample(index))
    }

    pub(crate) fn sample(&self, index: usize) -> PupilSample {
        let row = self.rows[index];
        let t = TimeNs(row.t_ns);
        PupilSample {
            t_device: t,
            t_sample: t,
            t_arrival: t,
            eye: row.eye,
            diameter_mm: row.diameter_mm,
            confidence: row.confidence,
            aperture_mm: (!row.aperture_mm.is_nan()).then_some(row.aperture_mm),
            sequence: None,
            valid: row.valid,
        }
    }

    /// By how much a repetition of the log is later: its length and one usual interval.
    pub(crate) fn period(&self) -> TimeNs {
        let length = self.ends() - self.begins();
        let instants = 1 + self.rows.windows(2).filter(|pair| pair[0].t_ns != pair[1].t_ns).count() as i64;
        length + TimeNs((length.0 / instants.max(1)).max(1_000_000))
    }
}

/// Rows of one eye that must be as far apart as no tracker's samples before that is said.
const SLOW_ROWS: usize = 8;
/// An eye tracker takes a sample at least this often.
const LEAST_RATE_HZ: f64 = 8.0;

/// Samples a second of the first eye of `rows`, by the median interval, where they are fewer than a tracker takes.
fn slow_rate_hz(rows: &[Row]) -> Option<f64> {
    let eye = rows.first()?.eye;
    let times: Vec<f64> = rows.iter().filter(|row| row.eye == eye).map(|row| row.t_ns as f64 * 1e-9).collect();
    let rate_hz = 1.0 / table::usual_step(&times)?;
    (times.len() >= SLOW_ROWS && rate_hz < LEAST_RATE_HZ).then_some(rate_hz)
}

fn known_formats() -> String {
    let names: Vec<_> = IMPORTERS.iter().map(|importer| importer.format.name()).collect();
    names.join(", ")
}

/// How an unknown file begins, for people.
fn beginning(input: &LogInput<'_>) -> String {
    match input.head_lines().next() {
        None => "an empty file".into(),
        Some(line) => {
            let shown: String = String::from_utf8_lossy(&line[..line.len().min(120)]).escape_debug().collect();
            format!("`{shown}`{}", if line.len() > 120 { "..." } else { "" })
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    /// How a log of each format begins.
    fn beginnings() -> Vec<(LogFormat, Vec<u8>)> {
        let mut native = Vec::new();
        for record in 0..4 {
            for index in 0..20_u8 {
                let value = match index {
                    0 | 7 => 3.5 + 0.1 * record as f32,
                    5 | 12 => 0.6,
                    6 | 13 => 0.8,
                    4 | 11 => 0.0,
                    _ => f32::from(index),
                };
                native.extend(value.to_le_bytes());
            }
        }
        let text = |format, text: &str| (format, text.as_bytes().to_vec());
        let utf16 = "\u{feff}## [BeGaze]\r\nTime\tType\tTrial\tR Mapped Diameter [mm]\r\n";
        vec![
            text(LogFormat::Lines, "# converted\nP1,1,2,L,3,1*00\n"),
            text(LogFormat::NeonEyeStates, "section id,timestamp [ns],pupil diameter left [mm]\n0,1,3.5\n"),
            (LogFormat::NeonNative, native),
            text(
                LogFormat::Core,
                "pupil_timestamp,world_index,eye_id,confidence,norm_pos_x,norm_pos_y,diameter,method,diameter_3d\n",
            ),
            text(LogFormat::Core, "timestamp,index,id,confidence,norm_pos_x,norm_pos_y,diameter,method\n"),
            text(LogFormat::EyeLink, "** CONVERTED FROM a.edf\n** TYPE: EDF_FILE BINARY EVENT SAMPLE TAGGED\n"),
            text(LogFormat::EyeLink, "MSG\t12 hello\nSTART\t15 \tLEFT\tRIGHT\tSAMPLES\tEVENTS\n"),
            text(LogFormat::EyeLink, "1408660\t  964.3\t  541.5\t  288.0\t...\n"),
            text(LogFormat::EyeLink, "1408660.5\t   .\t   .\t    0.0\n"),
            text(LogFormat::Smi, "## [iView]\n## Sample Rate:\t60\nTime;Type;Trial;L Pupil Diameter [mm]\n"),
            text(LogFormat::Smi, "Time,Type,Trial,L Dia X [px],L Dia Y [px]\n1,SMP,1,20,20\n"),
            text(LogFormat::Smi, "RecordingTime [ms]\tTrial\tPupil Diameter Left [mm]\tCategory Left\n"),
            (LogFormat::Smi, utf16.encode_utf16().flat_map(u16::to_le_bytes).collect()),
            text(LogFormat::Csv, "t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n"),
            text(LogFormat::Xdf, "XDF:\u{1}\u{14}"),
            text(LogFormat::Tobii, "Recording timestamp\tSensor\tPupil diameter left\tValidity left\n"),
            text(LogFormat::Tobii, "System\tx\n\nTimestamp\tPupilLeft\tValidityLeft\n"),
            text(LogFormat::Gazepoint, "MEDIA_ID,TIME(2020/11/03 12:00:00.000),LPD,LPV,LPMM,LPMMV\n"),
            text(LogFormat::PupilExt, "filename,timestamp_ms,algorithm,diameter_px\n"),
            text(LogFormat::PupilExt, "timestamp_ms;pupilDiameter_px_L_M\n"),
        ]
    }

    fn recognised(beginning: &[u8]) -> Vec<LogFormat> {
        let dir = tempfile::TempDir::new().expect("a folder");
        let path = dir.path().join("log");
        std::fs::write(&path, beginning).expect("writes");
        let input = LogInput::new(&path).expect("opens");
        IMPORTERS.iter().filter(|importer| (importer.recognises)(&input)).map(|importer| importer.format).collect()
    }

    #[test]
    fn each_log_is_recognised_by_its_format_alone() {
        for (format, beginning) in beginnings() {
            assert_eq!(recognised(&beginning), [format], "{}", String::from_utf8_lossy(&beginning));
        }
    }

    #[test]
    fn what_only_looks_like_a_log_is_not_recognised() {
        for beginning in [
            "",
            "\n\n",
            "1,2,3\n",
            "1408660\t964.3\t541.5\t288.0\n",
            "timestamp\tx\ty\tpupil\n1\t2\t3\t4\n",
            "Time;Type;Trial;L POR X [px]\n",
            "timestamp,confidence,diameter\n",
            "START\tSAMPLES\n",
            "Pupil,1,2\n",
            "P,1,2\n",
            "Recording timestamp\tSensor\tGaze point X\n",
            "Timestamp\tPupilLeft\n",
            "TIME,LPD\n",
            "timestamp_ms,diameter\n",
            "t_ns,eye,diameter_cm,confidence,aperture_mm,valid\n",
            "XDF",
        ] {
            assert_eq!(recognised(beginning.as_bytes()), [], "{beginning}");
        }
        assert_eq!(recognised(&[0; 800]), []);
    }

    #[test]
    fn a_gzip_that_ends_in_its_middle_is_told() {
        let dir = tempfile::TempDir::new().expect("a folder");
        let path = dir.path().join("log");
        std::fs::write(&path, b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\x03").expect("writes");
        assert!(matches!(Recording::read(&path), Err(ReplayError::Io { .. })));
    }

    #[test]
    fn every_fault_has_a_name_of_its_own() {
        assert_eq!(LOG_FAULT_NAMES.iter().collect::<HashSet<_>>().len(), LOG_FAULT_NAMES.len());
        assert_eq!(LOG_FAULT_NAMES[LogFault::TooLong.index()], "log_too_long");
        assert_eq!(LOG_FAULT_NAMES[LogFault::BadEye.index()], "log_bad_eye");
        assert_eq!(LOG_FAULT_NAMES[LogFault::Malformed.index()], "log_malformed");
    }

    fn sample(t_ns: i64, eye: SampleEye) -> LogSample {
        LogSample { t: TimeNs(t_ns), eye, diameter: 3.0, confidence: 1.0, aperture_mm: None, valid: true }
    }

    fn finished(samples: impl IntoIterator<Item = LogSample>) -> Vec<(i64, SampleEye)> {
        let mut log = LogBuilder::default();
        samples.into_iter().zip(1..).for_each(|(sample, line)| log.push(sample, line));
        let recording = log.finish(LogFormat::Lines, Path::new("x")).expect("a recording");
        recording.samples().map(|sample| (sample.t_sample.0, sample.eye)).collect()
    }

    #[test]
    fn eyes_a_little_or_far_out_of_step_end_in_order_of_time() {
        let at = |t_ns, eye| sample(t_ns, eye);
        for behind in [1, 40, 63, 64, 65, 500] {
            let samples = (0..1000).flat_map(|k| {
                let right = (k >= behind).then(|| at(2 * (k - behind), SampleEye::Right));
                [Some(at(2 * k, SampleEye::Left)), right]
            });
            let finished = finished(samples.flatten());
            assert!(finished.is_sorted_by_key(|(t_ns, _)| *t_ns), "{behind}");
            assert_eq!(finished.len() as i64, 2000 - behind);
        }
        // Samples of one time stay in the order of the log.
        let finished = finished([at(1, SampleEye::Left), at(2, SampleEye::Left), at(1, SampleEye::Right)]);
        assert_eq!(finished, [(1, SampleEye::Left), (1, SampleEye::Right), (2, SampleEye::Left)]);
    }

    #[test]
    fn a_diameter_that_became_infinite_is_rejected() {
        let mut log = LogBuilder::default();
        log.push(LogSample { diameter: 1e39_f64 as f32, ..sample(1, SampleEye::Left) }, 1);
        log.push(LogSample { diameter: f32::INFINITY, valid: false, ..sample(2, SampleEye::Left) }, 2);
        log.push(sample(3, SampleEye::Left), 3);
        assert_eq!((log.faults.of(LogFault::NotFinite), log.faults.total(), log.rows.len()), (1, 1, 2));
    }

    #[test]
    fn a_row_takes_24_bytes() {
        assert_eq!(size_of::<Row>(), 24);
    }

    struct Failing(u8);

    impl Read for Failing {
        fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
            self.0 += 1;
            match self.0 {
                1 => Err(ErrorKind::Interrupted.into()),
                2 => {
                    into[0] = b'x';
                    Ok(1)
                }
                _ => Err(io::Error::other("torn cable")),
            }
        }
    }

    #[test]
    fn a_reader_that_fails_ends_and_its_error_is_kept() {
        let failure = Failure::default();
        let mut watched = Watched { reader: io::BufReader::new(Failing(0)), failure: failure.clone() };
        let mut bytes = Vec::new();
        watched.read_to_end(&mut bytes).expect("ends");
        assert_eq!(bytes, b"x");
        assert_eq!(watched.read(&mut [0; 8]).ok(), Some(0));
        assert_eq!(failure.take().map(|error| error.to_string()), Some("torn cable".into()));
    }
}
