//! What an importer fills, and the recording that comes of it.

use std::fmt;
use std::path::Path;

use holod_calibration::{Sorted, TimeNs};

use super::fault::{LogFault, LogFaults, ReplayError};
use super::format::LogFormat;
use super::leaps::Leaps;
use super::parts::{Parts, is_restart};
use super::rows::{Blink, Row};
use crate::size_unit::SizeUnit;
use crate::{PupilSample, SampleEye};

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
    /// False where the log says that the tracker saw no pupil: such a sample tells the gate of a blink, a missing one
    /// does not.
    pub(crate) valid: bool,
}

impl LogSample {
    /// One in which the tracker saw no pupil, of a log without confidence and lids.
    pub(crate) const fn lost(t: TimeNs, eye: SampleEye) -> Self {
        Self { t, eye, diameter: 0.0, confidence: 1.0, aperture_mm: None, valid: false }
    }
}

/// What an importer fills.
#[derive(Debug, Default)]
pub(crate) struct LogBuilder {
    rows: Vec<Row>,
    pub(crate) faults: LogFaults,
    pub(crate) unit: SizeUnit,
    /// The rate that the log's header states.
    pub(crate) stated_rate_hz: Option<f64>,
    blinks: Vec<Blink>,
    /// Blinks of companion files.
    blinks_beside: Vec<Blink>,
    /// The scale of the run that recorded it.
    pub(crate) recorded_scale: Option<f64>,
    /// How the log was read, a sentence each.
    notes: Vec<String>,
    /// What is wrong with it or with how it was read.
    warnings: Vec<String>,
    /// Lines or rows whose time could be read.
    times: u64,
    first_backwards: Option<u64>,
    /// Samples that are lost because their size is none.
    lost_by_faults: usize,
    /// Rows that hold more than the header names, and the line of the first.
    wide: Option<(u64, u64)>,
    /// Lines in which the header came again, and that of one that names other columns.
    headers: LineList,
    other_header: Option<u64>,
    /// The last line, where the file ends within it, and how many malformed ones there were before it.
    unended: Option<(u64, u64)>,
    parts: Parts,
    /// Of each eye: samples behind a fall of the clock, with their lines, until they are enough to be a part.
    fallen: [Vec<(LogSample, u64)>; 3],
    /// Blinks told among those.
    fallen_blinks: Vec<Blink>,
    leaps: Leaps,
}

/// This many samples of an eye in a row are a part of their own; fewer that lie far back are wrong times.
const PART_SAMPLES: usize = 8;
/// By how many samples one eye may be behind the other before the whole log is sorted.
const EYES_OUT_OF_STEP: usize = 64;

/// One sample in so many may go back without a word.
const BACKWARDS_TOLD: u64 = 1000;

/// Samples that are kept: 2.4 GB of them.
const MOST_SAMPLES: usize = 100_000_000;
/// A time beyond this, a hundred years from any origin, is no time; differences of two stay within i64.
pub(super) const GREATEST_NS: u64 = 3_200_000_000_000_000_000;

impl LogBuilder {
    pub(crate) fn count(&mut self, fault: LogFault) {
        self.faults.count(fault);
    }

    /// Takes a sample with its size, which is 0 or less where the pupil is lost. A size that is none is counted, and the
    /// pupil is lost, unless the row ends before it: so the gate does not believe what is beside it either.
    pub(crate) fn push_sized(&mut self, size: Result<f64, LogFault>, lost: LogSample, line: u64) {
        match size {
            Ok(size) => self.push(LogSample { diameter: size as f32, valid: size > 0.0, ..lost }, line),
            Err(fault) => {
                self.count(fault);
                if fault != LogFault::Malformed {
                    self.lost_by_faults += 1;
                    self.push(lost, line);
                }
            }
        }
    }

    /// A row holds more cells than its header names, so that which is of which column is not known.
    pub(crate) fn has_more_cells(&mut self, line: u64) {
        self.count(LogFault::Malformed);
        self.wide.get_or_insert((0, line)).0 += 1;
    }

    /// The header comes again; false where the rows behind it are of other columns, at which reading ends.
    pub(crate) const fn header_again(&mut self, line: u64, is_same: bool) -> bool {
        if is_same {
            self.headers.take(line);
        } else {
            self.other_header = Some(line);
        }
        is_same
    }

    /// Takes a sample of line (or record) `line`, at the time that is written there; one that goes back a little
    /// against its own eye is counted and dropped, and where a clock begins anew its samples are put behind those before.
    pub(crate) fn push(&mut self, sample: LogSample, line: u64) {
        let LogSample { t, eye, diameter, valid, .. } = sample;
        if t.0.unsigned_abs() > GREATEST_NS {
            return self.count(LogFault::BadNumber);
        }
        // Not even a finite figure need be one in f32, or once it is in millimetres.
        if valid && !diameter.is_finite() {
            return self.count(LogFault::NotFinite);
        }
        self.times += 1;
        if self.parts.follow(t.0, eye).is_some() {
            self.reject_fallen(eye);
            return self.place(sample, line);
        }
        let fallen = &self.fallen[eye.index()];
        if fallen.iter().any(|(before, _)| is_restart(before.t.0, t.0)) {
            self.reject_fallen(eye);
        }
        let fallen = &mut self.fallen[eye.index()];
        fallen.push((sample, line));
        if fallen.len() == PART_SAMPLES {
            let fallen = std::mem::take(fallen);
            let first_ns = fallen.iter().map(|(sample, _)| sample.t.0).min().unwrap_or(t.0);
            self.parts.enter(first_ns, t.0, fallen[0].1, eye);
            for blink in std::mem::take(&mut self.fallen_blinks) {
                self.blink(blink);
            }
            fallen.into_iter().for_each(|(sample, line)| self.place(sample, line));
        }
    }

    /// What went back and returned was no part.
    fn reject_fallen(&mut self, eye: SampleEye) {
        for (_, line) in std::mem::take(&mut self.fallen[eye.index()]) {
            self.reject_backwards(line);
        }
        if self.fallen.iter().all(Vec::is_empty) {
            self.fallen_blinks.clear();
        }
    }

    fn reject_backwards(&mut self, line: u64) {
        self.first_backwards = Some(self.first_backwards.map_or(line, |first| first.min(line)));
        self.count(LogFault::Backwards);
    }

    fn place(&mut self, sample: LogSample, line: u64) {
        let LogSample { t, eye, diameter, confidence, aperture_mm, valid } = sample;
        if self.rows.len() == MOST_SAMPLES {
            return self.count(LogFault::TooLong);
        }
        let t_ns = match self.parts.follow(t.0, eye) {
            Some(t_ns) if t_ns.unsigned_abs() > GREATEST_NS => return self.count(LogFault::BadNumber),
            Some(t_ns) if self.parts.advance(t_ns, eye) => t_ns,
            _ => return self.reject_backwards(line),
        };
        self.leaps.follow(t_ns, line, eye);
        let aperture_mm = aperture_mm.unwrap_or(f32::NAN);
        let row = Row { t_ns, diameter_mm: diameter, confidence, aperture_mm, eye, valid };
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
    pub(super) const fn ends_within(&mut self, line: u64) {
        self.unended = Some((line, self.faults.of(LogFault::Malformed)));
    }

    /// The log says that a recording begins at `t`, in line `line`: where that lies before the latest time, its clock
    /// has begun anew.
    pub(crate) fn recording_begins(&mut self, t: TimeNs, line: u64) {
        SampleEye::ALL.into_iter().for_each(|eye| self.reject_fallen(eye));
        self.parts.begins_at(t.0, line);
    }

    /// Takes a blink that is told among the samples, at the times that are written there.
    pub(crate) fn blink(&mut self, blink: Blink) {
        if self.fallen.iter().any(|fallen| !fallen.is_empty()) && self.parts.may_be_later(blink.ends.0) {
            return self.fallen_blinks.push(blink);
        }
        let [begins, ends] = [blink.begins, blink.ends].map(|t| TimeNs(self.parts.in_newest(t.0)));
        self.blinks.push(Blink { begins, ends, ..blink });
    }

    /// Takes a blink of a companion file.
    pub(crate) fn blink_beside(&mut self, blink: Blink) {
        self.blinks_beside.push(blink);
    }

    /// Tells the user how the log was read, as any log of its kind may be.
    pub(crate) fn note(&mut self, note: impl Into<String>) {
        self.notes.push(note.into());
    }

    /// Tells the user what is wrong with the log, or what of it was not read.
    pub(crate) fn warn(&mut self, warning: impl Into<String>) {
        self.warnings.push(warning.into());
    }

    pub(super) fn finish(mut self, format: LogFormat, path: &Path) -> Result<Recording, ReplayError> {
        SampleEye::ALL.into_iter().for_each(|eye| self.reject_fallen(eye));
        if let Some(line) = self.other_header {
            return Err(ReplayError::Content {
                path: path.into(),
                at: format!(", line {line}"),
                found: "another header, of other columns than the first".into(),
                expected: "one table in a file; put that header and the rows behind it into a file of their own".into(),
            });
        }
        if let Some((rows, line)) = self.wide {
            self.warn(format!(
                "{rows} rows hold more cells than there are names of columns, the first in line {line}, and were left out, \
                 since which cell is of which column is not known: was what parts the cells written within one and without \
                 quotation marks, as in decimal commas (3,75 for 3.75), or has a column no name (in a BIDS recording, in \
                 `Columns` of its JSON file)? Export the log again, with decimal points and a name for each column"
            ));
        }
        let unlikely = self.faults.of(LogFault::BadConfidence);
        if unlikely > 0 {
            self.warn(format!(
                "{unlikely} samples are taken for lost, whose confidence lies above 1: is it in per cent? Let what wrote the log \
                 divide it"
            ));
        }
        if self.headers.count > 0 {
            self.note(format!("its header comes again in {}: no row was made of that", self.headers));
        }
        self.judge_backwards(path)?;
        // Where nothing but faults made its samples, it holds none.
        if self.rows.len() <= self.lost_by_faults && self.rows.iter().all(|row| !row.valid) {
            let reasons = self.faults.entries().filter(|(_, count)| *count > 0);
            let reasons: Vec<_> = reasons.map(|(name, count)| format!("{name} {count}")).collect();
            let why = match self.faults.total() {
                0 => "none of its lines is one".into(),
                rejected => format!("{rejected} of its lines were rejected ({})", reasons.join(", ")),
            };
            let why = std::iter::once(why).chain(self.warnings).collect::<Vec<_>>().join("; ");
            return Err(ReplayError::Empty { path: path.into(), why });
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
            self.warn(format!(
                "line {line}, the last one, ends before its columns do: the file is cut off; copy or export it again"
            ));
        }
        // Those of a recording of a link are the host's.
        if format != LogFormat::Raw
            && let Some(doubt) = doubtful_times(&self.rows, self.stated_rate_hz)
        {
            self.warn(doubt);
        }
        self.end_parts();
        if let Some(told) = self.leaps.close(&mut self.rows, [&mut self.blinks, &mut self.blinks_beside]) {
            self.warn(told);
        }
        self.blinks.append(&mut self.blinks_beside);
        self.blinks.sort_by_key(|blink| blink.begins);
        let Self { rows, faults, unit, stated_rate_hz, recorded_scale, blinks, warnings, notes: mut all, .. } = self;
        let warned = warnings.len();
        all.splice(0..0, warnings);
        Ok(Recording { format, unit, rows, blinks, faults, stated_rate_hz, recorded_scale, notes: all, warned })
    }

    /// Refuses a log most of which goes back, and warns of one of which more than a few samples do.
    fn judge_backwards(&mut self, path: &Path) -> Result<(), ReplayError> {
        let Some(line) = self.first_backwards else { return Ok(()) };
        let (backwards, rows) = (self.faults.of(LogFault::Backwards), self.times);
        if backwards * 2 > rows {
            return Err(ReplayError::Unsorted { path: path.into(), backwards, rows, line });
        }
        if backwards * BACKWARDS_TOLD > rows {
            self.warn(format!(
                "{backwards} of {rows} samples are left out, whose times lie before those of the samples ahead of them, the \
                 first in line or sample {line}: were they written in another order than taken, or stamped late? Export \
                 or record them again, in order of time"
            ));
        }
        Ok(())
    }

    /// Warns of where the clock began anew.
    fn end_parts(&mut self) {
        let mut restarts = LineList::default();
        self.parts.restarts().for_each(|line| restarts.take(line));
        if restarts.count == 0 {
            return;
        }
        self.warn(format!(
            "the clock begins anew in {restarts}: each part was put 1 s behind the one before it; to read one alone, put \
             its lines, below the header if there is one, into a file of their own"
        ));
        if !self.blinks_beside.is_empty() {
            self.blinks_beside.clear();
            self.warn("the blinks of the file beside it are left out: it does not say of which part they are");
        }
    }
}

/// Numbers of lines, of which the first are named.
#[derive(Debug, Default)]
struct LineList {
    count: usize,
    named: [u64; 5],
}

impl LineList {
    const fn take(&mut self, line: u64) {
        if self.count < self.named.len() {
            self.named[self.count] = line;
        }
        self.count += 1;
    }
}

impl fmt::Display for LineList {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let named = &self.named[..self.count.min(self.named.len())];
        f.write_str(if self.count == 1 { "line " } else { "lines " })?;
        for (index, line) in named.iter().enumerate() {
            write!(f, "{}{line}", if index == 0 { "" } else { ", " })?;
        }
        let more = self.count - named.len();
        if more > 0 { write!(f, " and {more} more") } else { Ok(()) }
    }
}

/// A whole log in memory, in order of time.
#[derive(Clone, Debug)]
pub struct Recording {
    format: LogFormat,
    unit: SizeUnit,
    pub(super) rows: Vec<Row>,
    blinks: Vec<Blink>,
    faults: LogFaults,
    stated_rate_hz: Option<f64>,
    recorded_scale: Option<f64>,
    /// The first `warned` of them are warnings.
    notes: Vec<String>,
    warned: usize,
}

impl Recording {
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

    /// Of a recording of a link: millimetres for one unit of its figures, where the run that recorded it had a scale.
    pub const fn recorded_scale(&self) -> Option<f64> {
        self.recorded_scale
    }

    /// What a user should know of how the log was read: [`Self::warnings`], then [`Self::remarks`].
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// What is wrong with the log, or what of it was not read, a sentence each.
    pub fn warnings(&self) -> &[String] {
        &self.notes[..self.warned]
    }

    /// How the log was read, as any log of its kind may be, a sentence each.
    pub fn remarks(&self) -> &[String] {
        &self.notes[self.warned..]
    }

    /// How many samples there are.
    pub const fn len(&self) -> usize {
        self.rows.len()
    }

    /// Never: a log without samples is an error.
    pub const fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Blinks that the log or a companion file tells, in order of time. They do not reach the gate, since no live
    /// tracker knows them.
    pub fn blinks(&self) -> &[Blink] {
        &self.blinks
    }

    /// How many lines or cells were rejected, by reason.
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

/// Rows of one eye by which its times are judged, at least.
const JUDGED_ROWS: usize = 8;
/// An eye tracker takes a sample at least this often.
const LEAST_RATE_HZ: f64 = 8.0;
/// And at most so often: the fastest take 2000.
const GREATEST_RATE_HZ: f64 = 4000.0;
/// The rate that a log states and that of its times are alike within this.
const LIKE_RATES: std::ops::Range<f64> = 0.8..1.25;
/// They are a power of ten apart within this.
const LIKE_POWERS: std::ops::Range<f64> = 0.9..1.1;

/// What cannot be right with the times of the first eye of `rows`, if anything.
fn doubtful_times(rows: &[Row], stated_rate_hz: Option<f64>) -> Option<String> {
    let Row { eye, t_ns: first_ns, .. } = *rows.first()?;
    // Since the first: as seconds since 1970 they would be rounded to a quarter of a microsecond.
    let of_eye = rows.iter().filter(|row| row.eye == eye);
    let times: Vec<f64> = of_eye.map(|row| row.t_ns.saturating_sub(first_ns) as f64 * 1e-9).collect();
    if times.len() < JUDGED_ROWS {
        return None;
    }
    let standing = times.windows(2).filter(|pair| pair[0] == pair[1]).count();
    if 2 * standing > times.len() {
        return Some(format!(
            "its times do not advance: {standing} of {} samples have that of the one before; were they rounded, as \
             spreadsheets do with long figures, or given in another unit than the column's? Export the log again and \
             leave it as it is",
            times.len()
        ));
    }
    // A clock of whole milliseconds repeats itself at more than 1 kHz.
    let repeats = times.len() as f64 / (times.len() - standing) as f64;
    let rate_hz = repeats / usual_step(&times)?;
    // Of samples that come in bursts the usual step says little.
    let mean_hz = (times.len() - 1) as f64 / (times[times.len() - 1] - times[0]);
    let shown = rate_in_words(rate_hz);
    let is_like = |stated: &f64| [rate_hz, mean_hz].into_iter().any(|rate_hz| LIKE_RATES.contains(&(rate_hz / stated)));
    if let Some(stated) = stated_rate_hz.filter(|stated| *stated > 0.0 && !is_like(stated)) {
        let power = (rate_hz / stated).log10().round();
        let is_power = power != 0.0 && LIKE_POWERS.contains(&(rate_hz / stated / 10_f64.powf(power)));
        let cause = if is_power {
            "a power of ten apart: the unit of time of the one or the other is wrong"
        } else {
            "which is not alike: is it that of this log, and are all samples in it?"
        };
        return Some(format!("it states {stated} samples a second, and its times make {shown}, {cause}"));
    }
    if rate_hz < LEAST_RATE_HZ {
        return Some(format!(
            "{shown} samples a second is no eye tracker's rate: this looks like a table of fixations or of means, or its \
             times are in another unit; export every sample (with Gazepoint: `..._all_gaze.csv`)"
        ));
    }
    (rate_hz.min(mean_hz) > GREATEST_RATE_HZ).then(|| {
        format!("{shown} samples a second is no eye tracker's rate: its times are in another unit than the column's")
    })
}

fn rate_in_words(rate_hz: f64) -> String {
    if rate_hz < 1.0 { format!("{rate_hz:.2e}") } else { format!("{rate_hz:.1}") }
}

/// The usual step of `times`: the median of those that are positive.
pub(super) fn usual_step(times: &[f64]) -> Option<f64> {
    let steps = times.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0);
    Sorted::new(steps).map(|steps| steps.median())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(t_ns: i64, eye: SampleEye) -> LogSample {
        LogSample { t: TimeNs(t_ns), eye, diameter: 3.0, confidence: 1.0, aperture_mm: None, valid: true }
    }

    fn finished(samples: impl IntoIterator<Item = LogSample>) -> Vec<(i64, SampleEye)> {
        read(samples).samples().map(|sample| (sample.t_sample.0, sample.eye)).collect()
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

    const MS: i64 = 1_000_000;

    /// Samples every 10 ms.
    fn part(from_ms: i64, count: i64, eye: SampleEye) -> impl Iterator<Item = LogSample> {
        (0..count).map(move |k| sample((from_ms + 10 * k) * MS, eye))
    }

    fn read(samples: impl IntoIterator<Item = LogSample>) -> Recording {
        let mut log = LogBuilder::default();
        samples.into_iter().zip(1..).for_each(|(sample, line)| log.push(sample, line));
        log.finish(LogFormat::Lines, Path::new("x")).expect("a recording")
    }

    fn times_ms(recording: &Recording, eye: SampleEye) -> Vec<i64> {
        recording.samples().filter(|sample| sample.eye == eye).map(|sample| sample.t_sample.0 / MS).collect()
    }

    #[test]
    fn a_clock_that_begins_anew_is_put_behind_with_both_eyes_in_step() {
        let (left, right) = (SampleEye::Left, SampleEye::Right);
        let together =
            |from_ms, count| part(from_ms, count, left).zip(part(from_ms, count, right)).flat_map(|(l, r)| [l, r]);
        // The second part is shorter, as long, longer than the first.
        for count in [30, 300, 900] {
            let recording = read(together(500, 300).chain(together(100, count)));
            let expected: Vec<_> = (0..300).map(|k| 500 + 10 * k).chain((0..count).map(|k| 4490 + 10 * k)).collect();
            assert_eq!([left, right].map(|eye| times_ms(&recording, eye)), [expected.clone(), expected]);
            assert_eq!(recording.faults().total(), 0);
            let notes = recording.notes();
            assert!(notes.len() == 1 && notes[0].contains("anew in line 601: "), "{notes:?}");
        }
        // An eye that is in no part but the second, and one that is not in the second.
        let right_alone = read(part(500, 300, left).chain(part(100, 300, left)).chain(part(3090, 9, right)));
        assert_eq!(times_ms(&right_alone, right)[0], 4490 + 2990);
        let three = read(
            part(500, 300, left).chain(part(500, 300, right)).chain(part(100, 300, left)).chain(together(50, 300)),
        );
        assert_eq!(
            [left, right].map(|eye| times_ms(&three, eye).last().copied()),
            [Some(4490 + 2990 + 1000 + 2990); 2]
        );
        assert_eq!(three.faults().total(), 0);
    }

    #[test]
    fn eyes_that_are_told_one_after_the_other_have_the_same_parts() {
        let (left, right) = (SampleEye::Left, SampleEye::Right);
        let eye = |eye| part(500, 300, eye).chain(part(100, 400, eye));
        let recording = read(eye(left).chain(eye(right)));
        assert_eq!(times_ms(&recording, left), times_ms(&recording, right));
        assert!(recording.notes()[0].contains("in line 301: "), "{:?}", recording.notes());
        let one = read(part(0, 400, left).chain(part(0, 400, right)));
        assert_eq!((times_ms(&one, right)[0], one.notes()), (0, &[][..]));
        // The other eye's first part lasts longer than the gap is: its second one is another.
        let recording = read(eye(left).chain(part(500, 900, right)).chain(part(100, 400, right)));
        assert_eq!((times_ms(&recording, right).len(), recording.faults().total()), (1300, 0));
    }

    #[test]
    fn samples_that_go_back_and_return_are_no_part() {
        let eye = SampleEye::Left;
        let stray = |t_ms: i64| sample(t_ms * MS, eye);
        for strays in [&[3990][..], &[0], &[2000, 2010], &[1100, 0, 1100, 0, 1100, 0, 1100, 0, 1100, 0]] {
            let samples = part(0, 400, eye).chain(strays.iter().map(|t| stray(*t - 10))).chain(part(4000, 400, eye));
            let recording = read(samples);
            assert_eq!(times_ms(&recording, eye), (0..800).map(|k| 10 * k).collect::<Vec<_>>(), "{strays:?}");
            assert_eq!(recording.faults().of(LogFault::Backwards), strays.len() as u64);
            let told = format!("{} of {} samples are left out", strays.len(), 800 + strays.len());
            let notes = recording.notes();
            assert!(
                notes.len() == 1 && notes[0].contains(&told) && notes[0].contains("line or sample 401"),
                "{notes:?}"
            );
        }
        // Too few for a part, at the end.
        let recording = read(part(0, 400, eye).chain(part(0, 7, eye)));
        assert_eq!((recording.len(), recording.faults().of(LogFault::Backwards)), (400, 7));
    }

    #[test]
    fn samples_that_go_back_are_told_where_they_are_more_than_one_in_a_thousand() {
        let (left, right) = (SampleEye::Left, SampleEye::Right);
        let stray = [sample(1, left)];
        let of = |count| read(part(0, count, left).chain(stray));
        let told = |recording: Recording| (recording.faults().of(LogFault::Backwards), recording.warnings().len());
        assert_eq!([999, 998].map(|count| told(of(count))), [(1, 0), (1, 1)]);
        // The first line of either eye, whichever is known to be wrong first.
        let rights = part(0, 20, right).chain([sample(180 * MS, right)]).chain(part(200, 9, right));
        let recording = read(part(0, 400, left).chain(part(0, 7, left)).chain(rights));
        assert!(recording.warnings()[0].contains("8 of 437 samples"), "{:?}", recording.notes());
        assert!(recording.warnings()[0].contains("the first in line or sample 401"), "{:?}", recording.notes());
    }

    #[test]
    fn blinks_go_with_their_part() {
        let eye = SampleEye::Left;
        let blink = |begins: i64, ends: i64| Blink { eye, begins: TimeNs(begins * MS), ends: TimeNs(ends * MS) };
        let mut log = LogBuilder::default();
        part(0, 400, eye).for_each(|sample| log.push(sample, 1));
        part(0, 4, eye).for_each(|sample| log.push(sample, 2));
        // One of the part before, and two of the part that is not sure yet and then is.
        log.blink(blink(3900, 3990));
        log.blink(blink(10, 20));
        part(40, 100, eye).for_each(|sample| log.push(sample, 3));
        log.blink(blink(500, 600));
        log.blink_beside(blink(1, 2));
        let recording = log.finish(LogFormat::Lines, Path::new("x")).expect("a recording");
        assert_eq!(recording.blinks(), [blink(3900, 3990), blink(5000, 5010), blink(5490, 5590)]);
        assert!(recording.notes()[0].contains("line 2: ") && recording.notes()[1].contains("left out"));
    }

    #[test]
    fn times_as_far_apart_as_a_log_can_hold_do_not_overflow() {
        let far = GREATEST_NS as i64;
        let mut log = LogBuilder::default();
        for part in [far, -far, far, -far] {
            (0..20).for_each(|k| log.push(sample(part - part.signum() * k, SampleEye::Left), 1));
            (0..20).for_each(|k| log.push(sample(part - part.signum() * (20 - k), SampleEye::Left), 1));
            log.recording_begins(TimeNs(-part), 2);
            log.blink(Blink { eye: SampleEye::Left, begins: TimeNs(i64::MIN), ends: TimeNs(i64::MAX) });
        }
        let recording = log.finish(LogFormat::Lines, Path::new("x")).expect("a recording");
        assert!(recording.samples().all(|sample| sample.t_sample.0.unsigned_abs() <= GREATEST_NS));
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
}
