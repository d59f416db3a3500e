//! What an importer fills, and the recording that comes of it.

use std::path::Path;

use holod_calibration::{Sorted, TimeNs};

use super::fault::{LogFault, LogFaults, ReplayError};
use super::format::LogFormat;
use crate::size_unit::SizeUnit;
use crate::{PupilSample, SampleEye};

/// One recorded sample, compact.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    pub(super) t_ns: i64,
    pub(super) diameter_mm: f32,
    pub(super) confidence: f32,
    /// NaN where there is none.
    pub(super) aperture_mm: f32,
    pub(super) eye: SampleEye,
    pub(super) valid: bool,
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
    /// False where the log says that the tracker saw no pupil: such a sample tells the gate of a blink, a missing one
    /// does not.
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
pub(super) const GREATEST_NS: u64 = 3_200_000_000_000_000_000;

impl LogBuilder {
    pub(crate) fn count(&mut self, fault: LogFault) {
        self.faults.count(fault);
    }

    /// Takes a sample of line (or record) `line`; one that goes back in time against its own eye is counted and
    /// dropped.
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

    pub(super) fn finish(mut self, format: LogFormat, path: &Path) -> Result<Recording, ReplayError> {
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
    pub(super) rows: Vec<Row>,
    blinks: Vec<Blink>,
    faults: LogFaults,
    stated_rate_hz: Option<f64>,
    notes: Vec<String>,
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

    /// Blinks that the log or a companion file tells, in order of time. They do not reach the gate, since no live
    /// tracker knows them.
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
    let rate_hz = 1.0 / usual_step(&times)?;
    (times.len() >= SLOW_ROWS && rate_hz < LEAST_RATE_HZ).then_some(rate_hz)
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
}
