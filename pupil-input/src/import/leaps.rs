//! Silences of a log that are longer than any of a recording: a clock that was set, or two recordings in one file. What
//! comes behind one is put shortly behind what came before it.

use super::rows::{Blink, Row};
use crate::SampleEye;

/// A longer silence is none of one recording.
const LONGEST_NS: i64 = 600_000_000_000;
/// What is left of it.
const LEFT_NS: i64 = 1_000_000_000;
/// Lines behind a silence that are kept.
const KEPT: usize = 64;
/// How many of them are named.
const TOLD: usize = 5;
/// A log with a longer silence more often than once in this many samples is a sparse one.
const LEAST_ROWS: usize = 8;

/// Where the samples of an eye leap ahead.
#[derive(Debug, Default)]
pub(super) struct Leaps {
    latest_ns: [Option<i64>; 3],
    /// Time and line of the first sample behind a leap.
    found: Vec<(i64, u64)>,
}

impl Leaps {
    /// Takes the next sample of an eye.
    pub(super) fn follow(&mut self, t_ns: i64, line: u64, eye: SampleEye) {
        let latest_ns = self.latest_ns[eye.index()].replace(t_ns);
        let leaps = latest_ns.is_some_and(|latest_ns| t_ns.saturating_sub(latest_ns) > LONGEST_NS);
        if leaps && self.found.len() < KEPT {
            self.found.push((t_ns, line));
        }
    }

    /// Shortens each silence of `rows`, which are in order of time, and tells where; blinks go with the samples.
    pub(super) fn close(&self, rows: &mut [Row], blinks: [&mut Vec<Blink>; 2]) -> Option<String> {
        // Where each begins and ends, before anything is moved.
        let pairs = || rows.windows(2).map(|pair| (pair[0].t_ns, pair[1].t_ns));
        let silences: Vec<_> = pairs().filter(|(from, to)| to.saturating_sub(*from) > LONGEST_NS).collect();
        let (_, first_ns) = *silences.first()?;
        if silences.len() * LEAST_ROWS > rows.len() {
            return None;
        }
        let mut begin = rows.partition_point(|row| row.t_ns < first_ns);
        let mut earlier_ns = 0;
        for (index, (from, to)) in silences.iter().enumerate() {
            earlier_ns += to - from - LEFT_NS;
            let end = silences
                .get(index + 1)
                .map_or(rows.len(), |(_, to)| begin + rows[begin..].partition_point(|row| row.t_ns < *to));
            rows[begin..end].iter_mut().for_each(|row| row.t_ns -= earlier_ns);
            begin = end;
        }
        for blink in blinks.into_iter().flatten() {
            for t in [&mut blink.begins, &mut blink.ends] {
                t.0 = moved(t.0, &silences);
            }
        }
        let line = |to: &i64| self.found.iter().find(|(t_ns, _)| t_ns == to).map(|(_, line)| *line);
        let lines: Vec<_> = silences.iter().filter_map(|(_, to)| line(to)).take(TOLD).map(|l| l.to_string()).collect();
        let count = silences.len();
        let at = match (&lines[..], count) {
            ([], _) => String::new(),
            ([line], 1) => format!(" in line {line}"),
            _ if lines.len() < count => format!(" in lines {} and {} more", lines.join(", "), count - lines.len()),
            _ => format!(" in lines {}", lines.join(", ")),
        };
        let longest_ns = silences.iter().map(|(from, to)| to - from).max().unwrap_or_default();
        Some(format!(
            "the clock leaps ahead{at}, by up to {}: the samples behind each leap were put 1 s behind those before it",
            span_in_words(longest_ns)
        ))
    }
}

/// A time with all silences before it shortened; one within a silence lies in what is left of it.
fn moved(t_ns: i64, silences: &[(i64, i64)]) -> i64 {
    let mut earlier_ns = 0;
    for (from, to) in silences {
        if t_ns < *to {
            let begin = from - earlier_ns;
            return t_ns.saturating_sub(earlier_ns).min(if t_ns > *from { begin + LEFT_NS } else { i64::MAX });
        }
        earlier_ns += to - from - LEFT_NS;
    }
    t_ns.saturating_sub(earlier_ns)
}

/// A long time, such as 3 h or 55.8 years.
pub(crate) fn span_in_words(ns: i64) -> String {
    let s = ns as f64 * 1e-9;
    let units = [("years", 31_557_600.0), ("days", 86_400.0), ("h", 3600.0), ("min", 60.0), ("s", 1.0)];
    let (unit, length) = units.into_iter().find(|(_, length)| s >= *length).unwrap_or(units[4]);
    format!("{:.1} {unit}", s / length)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use holod_calibration::TimeNs;

    use super::super::LogFormat;
    use super::super::recording::{LogBuilder, LogSample, Recording};
    use super::*;

    const S: i64 = 1_000_000_000;

    /// Samples every 10 ms from each of these seconds on, for a second, with a blink told at the end of each.
    fn read(begins_s: &[i64]) -> Recording {
        let mut log = LogBuilder::default();
        let mut line = 0;
        for begin_s in begins_s {
            for k in 0..100 {
                line += 1;
                let t = TimeNs(begin_s * S + k * S / 100);
                let (eye, confidence, valid) = (SampleEye::Left, 1.0, true);
                log.push(LogSample { t, eye, diameter: 3.0, confidence, aperture_mm: None, valid }, line);
            }
            let [begins, ends] = [begin_s * S + S / 2, begin_s * S + 2 * S].map(TimeNs);
            log.blink(Blink { eye: SampleEye::Left, begins, ends });
        }
        log.finish(LogFormat::Lines, Path::new("x")).expect("a recording")
    }

    #[test]
    fn a_clock_that_leaps_ahead_goes_on_a_second_later() {
        let year = 31_557_600;
        let recording = read(&[3, 56 * year, 56 * year + 700, 56 * year + 1000]);
        let begins: Vec<_> = recording.samples().step_by(100).map(|sample| sample.t_sample.0 / (S / 100)).collect();
        assert_eq!(begins, [300, 499, 698, 698 + 30_000]);
        assert_eq!((recording.len(), recording.faults().total()), (400, 0));
        let told = &recording.warnings()[0];
        assert!(told.contains("ahead in lines 101, 201, by up to 56.0 years"), "{told}");
        let blinks: Vec<_> = recording.blinks().iter().map(|blink| (blink.begins.0, blink.ends.0)).collect();
        // Behind its part's samples a blink ends where the next part begins.
        assert_eq!(blinks[0], (3 * S + S / 2, 4 * S + 99 * S / 100));
        assert_eq!(blinks[3].0, recording.samples().nth(350).expect("a sample").t_sample.0);
    }

    #[test]
    fn pauses_and_sparse_logs_stay_as_they_are() {
        for begins_s in [&[0, 500][..], &[0, 590, 1180]] {
            assert_eq!(read(begins_s).notes(), [""; 0], "{begins_s:?}");
        }
        let mut log = LogBuilder::default();
        for k in 0..40 {
            let (t, eye, valid) = (TimeNs(k * 1000 * S), SampleEye::Left, true);
            log.push(LogSample { t, eye, diameter: 3.0, confidence: 1.0, aperture_mm: None, valid }, 1);
        }
        let sparse = log.finish(LogFormat::Lines, Path::new("x")).expect("a recording");
        assert_eq!(sparse.ends(), TimeNs(39_000 * S));
        assert!(sparse.notes().len() == 1 && sparse.notes()[0].contains("no eye tracker's rate"), "{sparse:?}");
    }

    #[test]
    fn a_wrong_time_far_ahead_costs_a_second() {
        let recording = read(&[3, 1_000_000, 4]);
        assert_eq!(recording.len(), 300);
        assert!(recording.ends().0 < 10 * S, "{:?}", recording.ends());
    }

    #[test]
    fn long_times_are_told_in_their_unit() {
        let told = [1, 59 * S, 90 * S, 86_400 * S, 1_760_000_000 * S].map(span_in_words);
        assert_eq!(told, ["0.0 s", "59.0 s", "1.5 min", "1.0 days", "55.8 years"]);
    }
}
