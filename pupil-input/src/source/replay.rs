//! Logs of pupil diameters, told apart by their content.
//!
//! - holod's own recordings: files of [protocol lines](crate::wire::line)
//! - Pupil Labs Neon `3d_eye_states.csv`, with the blinks of a `blinks.csv` beside it
//!
//! Blinks of the companion are kept for plots and tests; they do not reach the gate, since no live tracker knows them.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use holod_calibration::TimeNs;

use crate::wire::line::{LineDecoder, LineEvent, LineFault};
use crate::{PupilSample, SampleEye};

/// The kinds of log that are known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogFormat {
    /// holod's line protocol.
    Lines,
    /// Pupil Labs Neon, 3D eye states.
    NeonEyeStates,
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
        "pupil log {path}, line 1: found {found}; expected lines of holod's protocol (`P1,<seq>,<device_us>,...*<crc>`) or \
         the header of a Pupil Labs Neon 3d_eye_states.csv (`timestamp [ns]` and `pupil diameter left [mm]` or `... right \
         [mm]` among its columns); convert the log to one of these"
    )]
    UnknownFormat {
        /// The log.
        path: PathBuf,
        /// How it begins.
        found: String,
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
    /// A protocol line with this fault.
    Line(LineFault),
    /// A row that is too short or not text.
    Malformed,
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
pub(crate) const LOG_FAULT_NAMES: [&str; 6 + LineFault::ALL.len()] = {
    let mut names = [""; 6 + LineFault::ALL.len()];
    let mut k = 0;
    while k < LineFault::ALL.len() {
        names[k] = LineFault::ALL[k].name();
        k += 1;
    }
    names[k] = "log_malformed";
    names[k + 1] = "log_bad_number";
    names[k + 2] = "log_missing";
    names[k + 3] = "log_not_finite";
    names[k + 4] = "log_negative";
    names[k + 5] = "log_backwards";
    names
};

impl LogFault {
    pub(crate) const fn index(self) -> usize {
        let lines = LineFault::ALL.len();
        match self {
            Self::Line(fault) => fault.index(),
            Self::Malformed => lines,
            Self::BadNumber => lines + 1,
            Self::Missing => lines + 2,
            Self::NotFinite => lines + 3,
            Self::Negative => lines + 4,
            Self::Backwards => lines + 5,
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

    const fn count(&mut self, fault: LogFault) {
        self.0[fault.index()] += 1;
    }
}

/// One recorded sample, compact.
#[derive(Clone, Copy, Debug)]
struct Row {
    t_ns: i64,
    /// NaN where there is none.
    aperture_mm: f32,
    diameter_mm: f32,
    confidence: f32,
    eye: SampleEye,
    sequence: Option<u64>,
}

/// A whole log in memory, in order of time.
#[derive(Clone, Debug)]
pub struct Recording {
    format: LogFormat,
    rows: Vec<Row>,
    blinks: Vec<(TimeNs, TimeNs)>,
    faults: LogFaults,
}

impl Recording {
    /// Reads a log.
    ///
    /// # Errors
    /// It is no readable file, of no known format, without a single sample, or in no order of time. Single bad lines are
    /// counted instead: [`Self::faults`].
    pub fn read(path: &Path) -> Result<Self, ReplayError> {
        let io = |source| ReplayError::Io { path: path.into(), source };
        let kind = std::fs::metadata(path).map_err(io)?.file_type();
        if kind.is_dir() {
            let hint = "; give the file in it, such as 3d_eye_states.csv";
            return Err(ReplayError::NotAFile { path: path.into(), found: "a directory", hint });
        }
        if !kind.is_file() {
            let hint = "; for a live tracker give `serial:PATH`";
            return Err(ReplayError::NotAFile { path: path.into(), found: "a device or pipe", hint });
        }
        let mut bytes = Vec::new();
        File::open(path).and_then(|mut file| file.read_to_end(&mut bytes)).map_err(io)?;
        let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&bytes);

        let format =
            recognise(text).ok_or_else(|| ReplayError::UnknownFormat { path: path.into(), found: beginning(text) })?;
        let mut log = LogReader::default();
        match format {
            LogFormat::Lines => log.read_lines(text),
            LogFormat::NeonEyeStates => log.read_neon(text),
        }
        let LogReader { mut rows, faults, times, first_backwards, .. } = log;
        rows.sort_by_key(|row| row.t_ns);
        let backwards = faults.of(LogFault::Backwards);
        if backwards * 2 > times {
            let line = first_backwards.unwrap_or(0);
            return Err(ReplayError::Unsorted { path: path.into(), backwards, rows: times, line });
        }
        if rows.is_empty() {
            let reasons = faults.entries().filter(|(_, count)| *count > 0);
            let reasons: Vec<_> = reasons.map(|(name, count)| format!("{name} {count}")).collect();
            let reasons = if reasons.is_empty() { "there are no lines".into() } else { reasons.join(", ") };
            return Err(ReplayError::Empty { path: path.into(), rejected: faults.total(), reasons });
        }
        let blinks = match format {
            LogFormat::Lines => Vec::new(),
            LogFormat::NeonEyeStates => read_blinks(&path.with_file_name("blinks.csv")),
        };
        Ok(Self { format, rows, blinks, faults })
    }

    /// The format that was recognised.
    pub const fn format(&self) -> LogFormat {
        self.format
    }

    /// How many samples there are.
    pub const fn len(&self) -> usize {
        self.rows.len()
    }

    /// Never: a log without samples is an error.
    pub const fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Blinks that the companion file tells: begin and end on the log's clock.
    pub fn blinks(&self) -> &[(TimeNs, TimeNs)] {
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
            sequence: row.sequence,
        }
    }

    /// By how much a repetition of the log is later: its length and one usual interval.
    pub(crate) fn period(&self) -> TimeNs {
        let length = self.ends() - self.begins();
        let instants = 1 + self.rows.windows(2).filter(|pair| pair[0].t_ns != pair[1].t_ns).count() as i64;
        length + TimeNs((length.0 / instants.max(1)).max(1_000_000))
    }
}

/// A time beyond this, a hundred years from any origin, is no time; differences of two stay within i64.
const GREATEST_NS: u64 = 3_200_000_000_000_000_000;
const NEON_TIME: &str = "timestamp [ns]";
const NEON_DIAMETERS: [(&str, &str, SampleEye); 2] = [
    ("pupil diameter left [mm]", "eyelid aperture left [mm]", SampleEye::Left),
    ("pupil diameter right [mm]", "eyelid aperture right [mm]", SampleEye::Right),
];

fn recognise(text: &[u8]) -> Option<LogFormat> {
    let lines = || text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).filter(|line| !line.is_empty());
    let first = lines().find(|line| line[0] != b'#')?;
    let tag = first.strip_prefix(b"P").and_then(|rest| rest.split(|byte| *byte == b',').next());
    if tag.is_some_and(|digits| !digits.is_empty() && digits.iter().all(u8::is_ascii_digit)) {
        return Some(LogFormat::Lines);
    }
    let header = std::str::from_utf8(first).ok()?;
    let has = |name: &str| header.split(',').any(|cell| cell.trim().trim_matches('"') == name);
    let is_neon = has(NEON_TIME) && NEON_DIAMETERS.iter().any(|(diameter, _, _)| has(diameter));
    // The header must be the very first line: a CSV has no comments.
    (is_neon && lines().next() == Some(first)).then_some(LogFormat::NeonEyeStates)
}

/// How an unknown file begins, for people.
fn beginning(text: &[u8]) -> String {
    let first = text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).find(|line| !line.is_empty());
    match first {
        None => "an empty file".into(),
        Some(line) => {
            let shown: String = String::from_utf8_lossy(&line[..line.len().min(120)]).escape_debug().collect();
            format!("`{shown}`{}", if line.len() > 120 { "..." } else { "" })
        }
    }
}

#[derive(Default)]
struct LogReader {
    rows: Vec<Row>,
    faults: LogFaults,
    /// Lines or rows whose time could be read.
    times: u64,
    first_backwards: Option<u64>,
    /// Of each eye: the cameras of two eyes may run free of each other.
    latest_ns: [Option<i64>; 3],
}

impl LogReader {
    /// Whether the time of line `line` may follow those before it.
    fn in_order(&mut self, eye: SampleEye, t_ns: i64, line: u64) -> bool {
        if t_ns.unsigned_abs() > GREATEST_NS {
            self.faults.count(LogFault::BadNumber);
            return false;
        }
        self.times += 1;
        let latest = &mut self.latest_ns[eye.index()];
        if latest.is_some_and(|latest| t_ns < latest) {
            self.faults.count(LogFault::Backwards);
            self.first_backwards.get_or_insert(line);
            return false;
        }
        *latest = Some(t_ns);
        true
    }

    fn read_lines(&mut self, text: &[u8]) {
        let mut decoder = LineDecoder::new();
        for (line, bytes) in (1..).zip(text.split_inclusive(|byte| *byte == b'\n')) {
            let mut take = |event| match event {
                LineEvent::Sample(sample) => {
                    let Some(t_ns) = sample.device_us.checked_mul(1000) else {
                        return self.faults.count(LogFault::BadNumber);
                    };
                    if self.in_order(sample.eye, t_ns, line) {
                        self.rows.push(Row {
                            t_ns,
                            aperture_mm: f32::NAN,
                            diameter_mm: sample.diameter_mm,
                            confidence: sample.confidence,
                            eye: sample.eye,
                            sequence: Some(sample.sequence),
                        });
                    }
                }
                LineEvent::Rejected(fault) => self.faults.count(LogFault::Line(fault)),
                LineEvent::Comment | LineEvent::Partial => {}
            };
            decoder.push(bytes, &mut take);
            decoder.finish(&mut take);
        }
    }

    fn read_neon(&mut self, text: &[u8]) {
        let mut csv = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(text);
        let Ok(header) = csv.byte_headers().cloned() else { return };
        let column = |name: &str| header.iter().position(|cell| cell == name.as_bytes());
        let Some(time) = column(NEON_TIME) else { return };
        let eyes = NEON_DIAMETERS
            .map(|(diameter, aperture, eye)| column(diameter).map(|diameter| (diameter, column(aperture), eye)));

        let mut record = csv::ByteRecord::new();
        loop {
            match csv.read_byte_record(&mut record) {
                Ok(false) => return,
                Ok(true) => {}
                Err(_) => {
                    self.faults.count(LogFault::Malformed);
                    continue;
                }
            }
            let cell = |index: usize| record.get(index).and_then(|cell| std::str::from_utf8(cell).ok());
            let line = record.position().map_or(0, csv::Position::line);
            let Some(t_text) = cell(time) else {
                self.faults.count(LogFault::Malformed);
                continue;
            };
            let Ok(t_ns) = t_text.parse() else {
                self.faults.count(LogFault::BadNumber);
                continue;
            };
            if !self.in_order(SampleEye::Both, t_ns, line) {
                continue;
            }
            for (diameter, aperture, eye) in eyes.into_iter().flatten() {
                match cell(diameter).ok_or(LogFault::Malformed).and_then(read_diameter) {
                    Err(fault) => self.faults.count(fault),
                    Ok(diameter_mm) => {
                        let aperture_mm = aperture.and_then(cell).and_then(|text| text.parse().ok());
                        let aperture_mm = aperture_mm.unwrap_or(f32::NAN);
                        self.rows.push(Row { t_ns, aperture_mm, diameter_mm, confidence: 1.0, eye, sequence: None });
                    }
                }
            }
        }
    }
}

fn read_diameter(text: &str) -> Result<f32, LogFault> {
    if text.is_empty() {
        return Err(LogFault::Missing);
    }
    let diameter_mm: f32 = text.parse().map_err(|_| LogFault::BadNumber)?;
    if !diameter_mm.is_finite() {
        Err(LogFault::NotFinite)
    } else if diameter_mm < 0.0 {
        Err(LogFault::Negative)
    } else {
        Ok(diameter_mm)
    }
}

/// Blinks of a companion file; none where there is none or it cannot be read, since nothing rests on it.
fn read_blinks(path: &Path) -> Vec<(TimeNs, TimeNs)> {
    let Ok(mut csv) = csv::Reader::from_path(path) else { return Vec::new() };
    let Ok(header) = csv.headers().cloned() else { return Vec::new() };
    let column = |name: &str| header.iter().position(|cell| cell.trim() == name);
    let Some((begin, end)) = column("start timestamp [ns]").zip(column("end timestamp [ns]")) else {
        return Vec::new();
    };
    let time = |record: &csv::StringRecord, index: usize| record.get(index)?.trim().parse().ok().map(TimeNs);
    csv.records().flatten().filter_map(|record| time(&record, begin).zip(time(&record, end))).collect()
}
