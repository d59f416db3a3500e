//! What a log holds: rate, gaps, lost samples, range and blinks.
//!
//! # Blinks
//!
//! Two counts: those that the log itself tells, and those found here by one rule for every tracker. For each eye a
//! sample is *shut* where the tracker calls it lost, is less than 0.6 confident of it, or sees the lids less than 0.3
//! of their usual distance apart; and it is *low* where the diameter is below 0.8 of what it was, averaged over the 100
//! ms before: no pupil narrows so fast, but what a lid leaves of it does. A run of shut and low samples lasts from the
//! last good sample before it to the first one after it; two runs are one where the gate's guards, 80 ms, leave nothing
//! between them. A run of 40 to 500 ms is a blink, a longer one a loss, a shorter one a dropout. Where the log has a
//! sign of shut eyes, a run needs a shut sample; one of low samples alone counts only where it has none. An eye that is
//! shut in more than half of its samples is not judged.
//!
//! Two eyes blink together: blinks of the two that overlap or are less than 80 ms apart are one, and where both are
//! judged, a blink of one eye while the other has neither blink nor loss is a wink or a fault, counted apart.

use holod_calibration::TimeNs;
use serde::Serialize;

use super::recording::Recording;
use super::rows::{Blink, Row};
use crate::{GateSettings, SampleEye};

const LEAST_CONFIDENCE: f32 = 0.6;
const SHUT_LIDS: f32 = 0.3;
const LOW: f32 = 0.8;
const AVERAGED_NS: f32 = 100e6;
const SHORTEST_NS: i64 = 40_000_000;
/// A tracker with a longer interval sees some blinks in one sample only.
const SLOW_NS: i64 = 10_000_000;
const LONGEST_NS: i64 = 500_000_000;
/// A silence of at least this, and longer than a gap, ends a run.
const SILENCE_NS: i64 = 100_000_000;
/// Share of shut samples from which on a log is taken to have a sign of them.
const SIGN_SHARE: f64 = 0.001;
const MILLISECOND_S: f32 = 1e-3;
/// An interval of this many usual ones is a gap: more than three, jitter aside.
const GAP_INTERVALS: f32 = 3.5;

/// What a log holds, for people and for programs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LogInfo {
    /// The format that was recognised.
    pub format: &'static str,
    /// What the diameters here are in.
    pub unit: &'static str,
    /// First sample's time on the log's own clock, nanoseconds.
    pub begins_ns: i64,
    /// From the first sample to the last, seconds.
    pub duration_s: f64,
    /// Samples of all eyes.
    pub samples: u64,
    /// The rate that the log's header states, hertz.
    pub stated_rate_hz: Option<f64>,
    /// Each eye that has samples.
    pub eyes: Vec<EyeInfo>,
    /// Blinks of both eyes together.
    pub blinks: BlinkCounts,
    /// How many lines or cells were rejected, by reason; reasons without any are left out.
    pub faults: Vec<FaultCount>,
    /// What a user should know of how the log was read.
    pub notes: Vec<String>,
}

/// How often something was rejected.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct FaultCount {
    /// The reason, under the name by which it is counted.
    pub name: &'static str,
    /// Lines or cells that were rejected for it.
    pub count: u64,
}

/// Blinks of both eyes together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct BlinkCounts {
    /// Those that the log or the file beside it tells; those of two eyes that overlap are one.
    pub told: u64,
    /// Those found: runs of 40 to 500 ms in which the eye is shut by the tracker's own signs, or by a fall of the
    /// diameter that no pupil makes where the tracker has no sign; of both eyes, where both are measured.
    pub found: u64,
    /// Found in one of two eyes only, and not among those above.
    pub found_in_one_eye: u64,
}

/// What a log holds of one eye.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EyeInfo {
    /// `left`, `right`, or `both` where the log does not tell the eyes apart.
    pub eye: &'static str,
    /// Samples of this eye, lost ones as well.
    pub samples: u64,
    /// Samples in which the tracker saw a pupil.
    pub valid: u64,
    /// Samples that the tracker calls lost.
    pub lost: u64,
    /// Runs of lost samples.
    pub lost_runs: u64,
    /// The longest of these runs, from its first sample to its last, seconds.
    pub longest_lost_s: f64,
    /// Valid samples with a confidence below 0.6.
    pub unsure: u64,
    /// Samples a second, by the median interval; where all times are whole milliseconds, by the mean of the intervals
    /// within one millisecond of it.
    pub rate_hz: Option<f64>,
    /// Interval between samples, milliseconds: its 1st, 50th and 99th percentile.
    pub interval_ms: Option<[f64; 3]>,
    /// Intervals of more than three usual ones (3.5, so that jitter makes no gap).
    pub gaps: u64,
    /// Their length in all, seconds.
    pub gaps_s: f64,
    /// The longest of them, seconds.
    pub longest_gap_s: f64,
    /// Samples that are missing, by the intervals of one and a half usual ones and more.
    pub missing: u64,
    /// Diameters of valid samples with a confidence of at least 0.6.
    pub diameter: Option<Range>,
    /// Blinks of this eye that the log has.
    pub blinks_told: u64,
    /// Blinks found; None for an eye that is not judged.
    pub blinks_found: Option<u64>,
    /// Runs like blinks but longer than 500 ms.
    pub long_losses: Option<u64>,
}

/// How a quantity is spread.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Range {
    /// The least value; the unit is that of the quantity.
    pub least: f32,
    /// The value that one in a hundred lies below.
    pub p1: f32,
    /// The value that half of all lie below.
    pub median: f32,
    /// The value that 99 in a hundred lie below.
    pub p99: f32,
    /// The greatest value, one outlier being enough.
    pub greatest: f32,
}

impl LogInfo {
    /// Looks through a log; diameters are multiplied by `scale_mm_per_unit` where there is one, and are millimetres
    /// then.
    pub fn of(recording: &Recording, scale_mm_per_unit: Option<f64>) -> Self {
        let mut notes = recording.notes().to_vec();
        let mut eyes = Vec::new();
        let mut runs = Vec::new();
        for eye in SampleEye::ALL {
            let Some((info, found)) = eye_info(recording, eye, scale_mm_per_unit.unwrap_or(1.0) as f32) else {
                continue;
            };
            match found {
                None => notes.push(format!("the {eye} eye is shut or lost in most samples: its blinks are not judged")),
                Some(found) => runs.push(found),
            }
            eyes.push(info);
        }
        let (found, found_in_one_eye) = together(&runs);
        let told = merged(recording.blinks(), 0).len() as u64;
        let faults = recording.faults();
        let entries = faults.entries().filter(|(_, count)| *count > 0);
        Self {
            format: recording.format().name(),
            unit: if scale_mm_per_unit.is_some() { "mm" } else { recording.unit().name() },
            begins_ns: recording.begins().0,
            duration_s: (recording.ends() - recording.begins()).seconds(),
            samples: recording.len() as u64,
            stated_rate_hz: recording.stated_rate_hz(),
            eyes,
            blinks: BlinkCounts { told, found, found_in_one_eye },
            faults: entries.map(|(name, count)| FaultCount { name, count }).collect(),
            notes,
        }
    }
}

/// What the guards of the gate take away between two runs.
fn apart_ns() -> i64 {
    let gate = GateSettings::default();
    (gate.lead + gate.trail).0
}

/// Blinks in order of their begin, those of any eye that overlap or are less than `apart_ns` apart as one.
fn merged(blinks: &[Blink], apart_ns: i64) -> Vec<Blink> {
    let mut all: Vec<Blink> = Vec::new();
    for blink in blinks {
        match all.last_mut() {
            Some(last) if blink.begins.0.saturating_sub(apart_ns) <= last.ends.0 => {
                last.ends = last.ends.max(blink.ends);
                if last.eye != blink.eye {
                    last.eye = SampleEye::Both;
                }
            }
            _ => all.push(*blink),
        }
    }
    all
}

fn is_blink(run: &Blink) -> bool {
    (run.ends - run.begins).0 <= LONGEST_NS
}

/// Blinks of both eyes, and of one eye only, out of the runs of each eye that is judged.
fn together(runs: &[Vec<Blink>]) -> (u64, u64) {
    let mut blinks: Vec<_> = runs.iter().flatten().filter(|run| is_blink(run)).copied().collect();
    blinks.sort_by_key(|blink| blink.begins);
    let blinks = merged(&blinks, apart_ns());
    let [first, second] = runs else { return (blinks.len() as u64, 0) };
    let meets = |blink: &Blink, runs: &[Blink]| {
        let after = runs.partition_point(|run| run.begins.0 <= blink.ends.0 + apart_ns());
        runs[..after].last().is_some_and(|run| run.ends.0 >= blink.begins.0 - apart_ns())
    };
    let both = blinks.iter().filter(|blink| meets(blink, first) && meets(blink, second)).count() as u64;
    (both, blinks.len() as u64 - both)
}

/// The figures of one eye and its blinks and longer losses, these None where it is not judged; None in all where it has
/// no sample.
fn eye_info(recording: &Recording, eye: SampleEye, scale: f32) -> Option<(EyeInfo, Option<Vec<Blink>>)> {
    let rows = || recording.rows.iter().filter(|row| row.eye == eye);
    let samples = rows().count() as u64;
    if samples == 0 {
        return None;
    }
    let valid = rows().filter(|row| row.valid).count() as u64;
    let unsure = rows().filter(|row| row.valid && row.confidence < LEAST_CONFIDENCE).count() as u64;
    let (lost_runs, longest_lost) = lost_runs(rows());

    let mut scratch: Vec<f32> = intervals_ns(rows()).map(|ns| (ns as f64 * 1e-9) as f32).collect();
    let interval_s = quantiles(&mut scratch, [0.01, 0.5, 0.99]);
    let usual_s = interval_s.map_or(0.0, |[_, median, _]| median);
    let whole_ms = intervals_ns(rows()).all(|ns| ns % 1_000_000 == 0);
    // A clock of whole milliseconds, if their number alternates, tells the rate by the mean.
    let other = scratch.iter().filter(|s| (*s - usual_s).abs() > 0.5 * MILLISECOND_S).count();
    let usual_exactly_s = if whole_ms && 10 * other > scratch.len() {
        let near = scratch.iter().filter(|s| (*s - usual_s).abs() < 1.5 * MILLISECOND_S);
        let (sum, count) = near.fold((0.0, 0_u64), |(sum, count), s| (sum + f64::from(*s), count + 1));
        sum / count as f64
    } else {
        usual_s.into()
    };
    let rate_hz = (usual_exactly_s > 0.0).then(|| usual_exactly_s.recip());
    let gaps = || scratch.iter().filter(|s| usual_s > 0.0 && **s > GAP_INTERVALS * usual_s);
    let (gap_count, gaps_s) = (gaps().count() as u64, gaps().fold(0.0, |sum, s| sum + f64::from(*s)));
    let longest_gap_s = gaps().copied().fold(0.0, f32::max).into();
    let late = scratch.iter().filter(|s| usual_s > 0.0 && **s > 1.5 * usual_s);
    let missing = late.map(|s| (s / usual_s).round() as u64 - 1).sum();

    scratch.clear();
    scratch.extend(rows().map(|row| row.aperture_mm).filter(|aperture| aperture.is_finite()));
    let apertures_known = 2 * scratch.len() as u64 > samples;
    let shut_lids_mm = quantiles(&mut scratch, [0.5]).map_or(0.0, |[median]| SHUT_LIDS * median);

    scratch.clear();
    scratch.extend(rows().filter(|row| is_sure(row)).map(|row| row.diameter_mm * scale));
    let diameter = quantiles(&mut scratch, [0.0, 0.01, 0.5, 0.99, 1.0])
        .map(|[least, p1, median, p99, greatest]| Range { least, p1, median, p99, greatest });
    drop(scratch);

    let is_shut = |row: &Row| !is_sure(row) || row.aperture_mm < shut_lids_mm;
    let shut = rows().filter(|row| is_shut(row)).count() as u64;
    let has_sign = apertures_known || shut as f64 > SIGN_SHARE * samples as f64;
    let mut finder = BlinkFinder::new(eye, has_sign, usual_s);
    rows().for_each(|row| finder.take(row, is_shut(row)));
    let runs = finder.finish();
    let judged = 2 * shut <= samples;
    let blinks = runs.iter().filter(|run| is_blink(run)).count();

    let info = EyeInfo {
        eye: eye.name(),
        samples,
        valid,
        lost: samples - valid,
        lost_runs,
        longest_lost_s: longest_lost.seconds(),
        unsure,
        rate_hz,
        interval_ms: interval_s.map(|interval_s| interval_s.map(|s| f64::from(s) * 1e3)),
        gaps: gap_count,
        gaps_s,
        longest_gap_s,
        missing,
        diameter,
        blinks_told: recording.blinks().iter().filter(|blink| blink.eye == eye).count() as u64,
        blinks_found: judged.then_some(blinks as u64),
        long_losses: judged.then_some((runs.len() - blinks) as u64),
    };
    Some((info, judged.then_some(runs)))
}

fn is_sure(row: &Row) -> bool {
    row.valid && row.confidence >= LEAST_CONFIDENCE && row.diameter_mm.is_finite()
}

fn intervals_ns<'r>(rows: impl Iterator<Item = &'r Row> + Clone) -> impl Iterator<Item = i64> {
    rows.clone().zip(rows.skip(1)).map(|(before, after)| after.t_ns - before.t_ns)
}

/// How many runs of lost samples there are, and the longest.
fn lost_runs<'r>(rows: impl Iterator<Item = &'r Row>) -> (u64, TimeNs) {
    let (mut runs, mut longest, mut begins) = (0, TimeNs(0), None);
    for row in rows {
        if row.valid {
            begins = None;
        } else {
            runs += u64::from(begins.is_none());
            let begins = *begins.get_or_insert(row.t_ns);
            longest = longest.max(TimeNs(row.t_ns - begins));
        }
    }
    (runs, longest)
}

/// The values that these shares of all lie below; reorders them.
fn quantiles<const N: usize>(values: &mut [f32], shares: [f64; N]) -> Option<[f32; N]> {
    let last = values.len().checked_sub(1)?;
    Some(shares.map(|share| {
        let index = (share * last as f64).round() as usize;
        *values.select_nth_unstable_by(index, f32::total_cmp).1
    }))
}

/// A run of shut and low samples.
#[derive(Clone, Copy, Debug)]
struct Run {
    /// The last good sample before it, its own first one where there is none.
    begins_ns: i64,
    last_ns: i64,
    /// The first good sample after it.
    ends_ns: Option<i64>,
    shut: bool,
}

/// Finds the blinks of one eye by the rule of this module.
#[derive(Clone, Debug)]
struct BlinkFinder {
    eye: SampleEye,
    has_sign: bool,
    silence_ns: i64,
    /// Of runs with a sign: a slow tracker may see a blink in one sample.
    shortest_shut_ns: i64,
    /// Of the diameters of good samples, over the last 100 ms or so.
    average: Option<f32>,
    latest_ns: Option<i64>,
    latest_good_ns: Option<i64>,
    run: Option<Run>,
    /// Blinks and longer losses.
    runs: Vec<Blink>,
}

impl BlinkFinder {
    fn new(eye: SampleEye, has_sign: bool, usual_s: f32) -> Self {
        let usual_ns = (usual_s * 1e9) as i64;
        Self {
            eye,
            has_sign,
            silence_ns: SILENCE_NS.max((GAP_INTERVALS * usual_s * 1e9) as i64),
            shortest_shut_ns: if usual_ns > SLOW_NS {
                SHORTEST_NS.min(usual_ns.saturating_mul(3) / 2)
            } else {
                SHORTEST_NS
            },
            average: None,
            latest_ns: None,
            latest_good_ns: None,
            run: None,
            runs: Vec::new(),
        }
    }

    fn take(&mut self, row: &Row, shut: bool) {
        let t_ns = row.t_ns;
        let since_ns = self.latest_ns.map_or(0, |latest| t_ns - latest);
        self.latest_ns = Some(t_ns);
        if since_ns > self.silence_ns {
            self.end_run();
            self.average = None;
            self.latest_good_ns = None;
        }
        // A new level that has lasted longer than any blink is the eye's own.
        let settled = self.run.is_some_and(|run| run.ends_ns.is_none() && t_ns - run.begins_ns > LONGEST_NS);
        if settled && !shut {
            self.average = None;
        }
        let low = !shut && self.average.is_some_and(|average| row.diameter_mm < LOW * average);
        if shut || low {
            let run = self.run.get_or_insert(Run {
                begins_ns: self.latest_good_ns.unwrap_or(t_ns),
                last_ns: t_ns,
                ends_ns: None,
                shut,
            });
            run.last_ns = t_ns;
            run.ends_ns = None;
            run.shut |= shut;
            return;
        }
        if let Some(run) = &mut self.run {
            let ends_ns = *run.ends_ns.get_or_insert(t_ns);
            if t_ns - ends_ns >= apart_ns() {
                self.end_run();
            }
        }
        self.latest_good_ns = Some(t_ns);
        // A step of the average is bounded, so that one wild figure does not move it.
        let average = *self.average.get_or_insert(row.diameter_mm);
        let step = (row.diameter_mm - average).clamp(-0.25 * average.abs(), 0.25 * average.abs());
        self.average = Some(average + step * (since_ns as f32 / AVERAGED_NS).min(1.0));
    }

    fn end_run(&mut self) {
        let Some(run) = self.run.take().filter(|run| run.shut || !self.has_sign) else { return };
        let ends_ns = run.ends_ns.unwrap_or(run.last_ns);
        let shortest_ns = if run.shut { self.shortest_shut_ns } else { SHORTEST_NS };
        if ends_ns - run.begins_ns >= shortest_ns {
            self.runs.push(Blink { eye: self.eye, begins: TimeNs(run.begins_ns), ends: TimeNs(ends_ns) });
        }
    }

    fn finish(mut self) -> Vec<Blink> {
        self.end_run();
        self.runs
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::format::LogFormat;
    use crate::import::recording::{GREATEST_NS, LogBuilder, LogSample};

    /// 20 s at 200 Hz of 4 units; `at` makes of the time in milliseconds diameter, confidence, aperture and validity.
    fn info(at: impl Fn(i64) -> (f32, f32, Option<f32>, bool)) -> LogInfo {
        let mut log = LogBuilder::default();
        for t_ms in (0..20_000).step_by(5) {
            let (diameter, confidence, aperture_mm, valid) = at(t_ms);
            let t = TimeNs(t_ms * 1_000_000);
            log.push(LogSample { t, eye: SampleEye::Left, diameter, confidence, aperture_mm, valid }, 1);
        }
        LogInfo::of(&log.finish(LogFormat::Lines, std::path::Path::new("x")).expect("a recording"), None)
    }

    /// Lost from each begin for each length, in milliseconds.
    fn lost(runs: &[(i64, i64)]) -> (Option<u64>, Option<u64>) {
        let within = |t_ms: i64| runs.iter().any(|(begin, length)| (*begin..begin + length).contains(&t_ms));
        let info = info(|t_ms| (4.0, 1.0, None, !within(t_ms)));
        assert_eq!(info.eyes[0].blinks_found.unwrap_or(0), info.blinks.found);
        (info.eyes[0].blinks_found, info.eyes[0].long_losses)
    }

    #[test]
    fn a_lost_run_is_a_blink_by_its_length() {
        // From the good sample before to the good one after it is an interval longer than its samples.
        assert_eq!(lost(&[(1000, 30)]), (Some(0), Some(0)));
        assert_eq!(lost(&[(1000, 35)]), (Some(1), Some(0)));
        assert_eq!(lost(&[(1000, 495)]), (Some(1), Some(0)));
        assert_eq!(lost(&[(1000, 500)]), (Some(0), Some(1)));
        assert_eq!(lost(&[(1000, 100), (3000, 100), (3240, 100)]), (Some(3), Some(0)));
        assert_eq!(lost(&[(1000, 100), (3000, 100), (3175, 100)]), (Some(2), Some(0)));
        assert_eq!(lost(&[(0, 100), (19_900, 100)]), (Some(2), Some(0)));
        assert_eq!(lost(&[(0, 10_100)]), (None, None));
    }

    #[test]
    fn a_log_of_two_samples_as_far_apart_as_a_log_can_hold_has_its_summary() {
        let mut log = LogBuilder::default();
        for t in [-(GREATEST_NS as i64), GREATEST_NS as i64] {
            let (eye, t) = (SampleEye::Left, TimeNs(t));
            log.push(LogSample { t, eye, diameter: 4.0, confidence: 0.2, aperture_mm: None, valid: true }, 1);
        }
        let info = LogInfo::of(&log.finish(LogFormat::Lines, std::path::Path::new("x")).expect("a recording"), None);
        assert_eq!((info.eyes[0].unsure, info.eyes[0].blinks_found), (2, None));
        let hz = 1e9 / (2 * GREATEST_NS) as f64;
        assert!(
            info.eyes[0].rate_hz.is_some_and(|rate_hz| (rate_hz / hz - 1.0).abs() < 1e-6),
            "{:?}",
            info.eyes[0].rate_hz
        );
    }

    #[test]
    fn lids_that_shut_are_a_blink_and_lids_that_narrow_are_not() {
        let lids = |t_ms: i64| match t_ms {
            1000..1100 => 0.1,
            5000..9000 => 2.5,
            9100..9200 => 1.0,
            _ => 7.0,
        };
        let info = info(|t_ms| (4.0, 1.0, Some(lids(t_ms)), true));
        assert_eq!((info.blinks.found, info.eyes[0].long_losses), (2, Some(0)));
    }

    #[test]
    fn without_any_sign_a_dip_is_a_blink_and_a_light_reflex_is_not() {
        let dip = |t_ms: i64| if (1000..1120).contains(&t_ms) { 2.0 } else { 4.0 };
        // From 6 mm by 5.5 mm/s to 3 mm.
        let reflex = |t_ms: i64| if t_ms < 1000 { 6.0 } else { (6.0 - 5.5e-3 * (t_ms - 1000) as f32).max(3.0) };
        let step = |t_ms: i64| if t_ms < 1000 { 6.0 } else { 3.0 };
        assert_eq!(info(|t_ms| (dip(t_ms), 1.0, None, true)).blinks.found, 1);
        assert_eq!(info(|t_ms| (reflex(t_ms), 1.0, None, true)).blinks.found, 0);
        let info_of_step = info(|t_ms| (step(t_ms), 1.0, None, true));
        assert_eq!((info_of_step.blinks.found, info_of_step.eyes[0].long_losses), (0, Some(1)));
        // With a sign, a dip alone is none.
        let with_sign = |t_ms: i64| (dip(t_ms), if (5000..5100).contains(&t_ms) { 0.2 } else { 1.0 }, None, true);
        let found = info(with_sign);
        assert_eq!((found.blinks.found, found.eyes[0].unsure), (1, 20));
    }

    #[test]
    fn low_neighbours_lengthen_a_short_loss_into_a_blink() {
        let at = |t_ms: i64| match t_ms {
            1000..1015 => (2.0, 1.0, None, true),
            1015..1020 => (0.0, 1.0, None, false),
            1020..1035 => (2.5, 1.0, None, true),
            2000..2005 => (0.0, 1.0, None, false),
            _ => (4.0, 1.0, None, true),
        };
        let info = info(at);
        assert_eq!((info.blinks.found, info.eyes[0].lost, info.eyes[0].lost_runs), (1, 2, 2));
        assert_eq!(info.eyes[0].diameter.map(|range| (range.least, range.p1, range.greatest)), Some((2.0, 4.0, 4.0)));
    }

    #[test]
    fn blinks_of_two_eyes_are_one_where_they_meet() {
        let blink = |eye, begins, ends| Blink { eye, begins: TimeNs(begins), ends: TimeNs(ends) };
        let (left, right, both) = (SampleEye::Left, SampleEye::Right, SampleEye::Both);
        let all = [blink(left, 0, 10), blink(right, 5, 12), blink(left, 20, 30), blink(left, 34, 35)];
        assert_eq!(merged(&all, 5), [blink(both, 0, 12), blink(left, 20, 35)]);
        assert_eq!(merged(&all, 0), [blink(both, 0, 12), blink(left, 20, 30), blink(left, 34, 35)]);
    }

    #[test]
    fn a_blink_of_one_eye_is_none_of_both_unless_the_other_is_not_judged() {
        let run = |begins_ms: i64, ends_ms: i64| Blink {
            eye: SampleEye::Left,
            begins: TimeNs(begins_ms * 1_000_000),
            ends: TimeNs(ends_ms * 1_000_000),
        };
        let left = vec![run(0, 100), run(1000, 1100), run(2000, 2100), run(5000, 5600)];
        let right = vec![run(170, 250), run(1190, 1250), run(1900, 2500), run(7000, 7600)];
        assert_eq!(together(&[left.clone(), right]), (2, 2));
        assert_eq!(together(&[left]), (3, 0));
        assert_eq!(together(&[]), (0, 0));
    }

    #[test]
    fn rate_gaps_and_missing_samples_are_told() {
        let mut log = LogBuilder::default();
        let mut t_ms = 0;
        for k in 0..1000 {
            let (t, eye) = (TimeNs(t_ms * 1_000_000), SampleEye::Right);
            log.push(LogSample { t, eye, diameter: 3.0, confidence: 1.0, aperture_mm: None, valid: true }, 1);
            // 8, 8 and 9 ms: 120 Hz in whole milliseconds; two samples missing once, and one gap of 0.1 s.
            t_ms += match k {
                300 => 25,
                600 => 100,
                _ => [8, 8, 9][k % 3],
            };
        }
        let recording = log.finish(LogFormat::Lines, std::path::Path::new("x")).expect("a recording");
        let info = LogInfo::of(&recording, Some(0.5));
        let eye = &info.eyes[0];
        assert_eq!((eye.eye, eye.samples, eye.gaps, eye.missing), ("right", 1000, 1, 2 + 12));
        assert!((eye.rate_hz.expect("a rate") - 120.0).abs() < 0.02, "{eye:?}");
        assert!((eye.gaps_s - 0.1).abs() < 1e-6 && eye.longest_gap_s == eye.gaps_s);
        assert_eq!((info.unit, eye.diameter.map(|range| range.median)), ("mm", Some(1.5)));
    }
}
