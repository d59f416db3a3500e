//! Whether a tracker's clock can be right.

use holod_calibration::TimeNs;

use crate::clock::ClockReport;
use crate::counters::{Counter, CounterSnapshot};

/// No crystal is off by so much, nor what a script feeds with sleeps: a wrong rate or unit is.
const ODD_DRIFT_PPM: f64 = 20_000.0;
/// For so long the drift must have been so large.
const ODD_FOR: TimeNs = TimeNs(5_000_000_000);
/// This many resets within [`COUNTED_WITHIN`] are no accidents.
const MANY_RESETS: u64 = 3;
/// Nor are this many leaps; a stream begins with one or two.
const MANY_LEAPS: u64 = 10;
/// Resets and leaps are counted anew after this.
const COUNTED_WITHIN: TimeNs = TimeNs(10_000_000_000);

/// Follows what is found of a tracker's clock, and says once that it cannot be right. Pure: it reads no clock.
#[derive(Clone, Debug, Default)]
pub struct ClockWatch {
    odd_since: Option<TimeNs>,
    /// When resets and leaps began to be counted, and how many there were by then.
    counted: Option<(TimeNs, [u64; 2])>,
    told: bool,
}

impl ClockWatch {
    /// Looks at host time `now` at the newest report and at all counts so far.
    pub fn judge(&mut self, now: TimeNs, report: Option<ClockReport>, counts: &CounterSnapshot) -> Option<String> {
        if self.told {
            return None;
        }
        let odd = report.map(|report| report.drift_ppm).filter(|ppm| ppm.abs() > ODD_DRIFT_PPM);
        self.odd_since = odd.and(self.odd_since.or(Some(now)));
        let [resets, leaps] = [Counter::ClockResets, Counter::ClockLeaps].map(|counter| counts.of(counter));
        let (since, before) = match self.counted {
            Some((since, before)) if now - since < COUNTED_WITHIN => (since, before),
            _ => (now, [resets, leaps]),
        };
        self.counted = Some((since, before));
        let found = match (odd, self.odd_since) {
            (Some(ppm), Some(since)) if now - since >= ODD_FOR => {
                format!(
                    "runs {:.1} % {} against this machine's",
                    ppm.abs() * 1e-4,
                    if ppm > 0.0 { "slow" } else { "fast" }
                )
            }
            _ if resets >= before[0] + MANY_RESETS => "is set anew again and again".to_owned(),
            _ if leaps >= before[1] + MANY_LEAPS => "leaps from sample to sample".to_owned(),
            _ => return None,
        };
        self.told = true;
        Some(format!(
            "the tracker's clock {found}, so that the times of its samples are not to be relied on: are `rate_hz` and the \
             unit of time of its profile those of the tracker?"
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::counters::Counters;

    /// When it is said, in tenths of a second from 0 on, and what.
    fn told(drift_ppm: impl Fn(i64) -> f64, counted: impl Fn(i64) -> [u64; 2]) -> Vec<(i64, String)> {
        let mut watch = ClockWatch::default();
        let judged = (0..600).filter_map(|tenth| {
            let report =
                ClockReport { offset: TimeNs(0), drift_ppm: drift_ppm(tenth), delay_spread: TimeNs(1_000_000) };
            let counters = Counters::new();
            let [resets, leaps] = counted(tenth);
            counters.add(Counter::ClockResets, resets);
            counters.add(Counter::ClockLeaps, leaps);
            Some((tenth, watch.judge(TimeNs(tenth * 100_000_000), Some(report), &counters.snapshot())?))
        });
        judged.collect()
    }

    #[test]
    fn a_clock_that_drifts_as_clocks_do_is_none_to_speak_of() {
        assert_eq!(told(|_| 80.0, |_| [0, 2]), []);
        assert_eq!(told(|_| -8_000.0, |tenth| [u64::from(tenth > 100) + u64::from(tenth > 300), 1]), []);
        // While the line is being found.
        assert_eq!(told(|tenth| if tenth < 40 { 150_000.0 } else { 20.0 }, |_| [0, 0]), []);
        assert_eq!(ClockWatch::default().judge(TimeNs(0), None, &CounterSnapshot::zero()), None);
    }

    #[test]
    fn a_wrong_rate_is_told_once() {
        let slow = told(|_| 166_667.0, |_| [0, 0]);
        assert!(matches!(&slow[..], [(50, text)] if text.contains("16.7 % slow")), "{slow:?}");
        let fast = told(|tenth| if tenth < 30 { 0.0 } else { -50_000.0 }, |_| [0, 0]);
        assert!(matches!(&fast[..], [(80, text)] if text.contains("5.0 % fast")), "{fast:?}");
    }

    #[test]
    fn a_clock_that_is_reset_again_and_again_is_told_once() {
        let reset = told(|_| 0.0, |tenth| [tenth as u64 / 25, 0]);
        assert!(matches!(&reset[..], [(75, text)] if text.contains("again and again")), "{reset:?}");
        assert_eq!(told(|_| 0.0, |tenth| [tenth as u64 / 60, 0]), []);
    }
    #[test]
    fn a_clock_that_leaps_is_told_once() {
        let leaps = told(|_| 0.0, |tenth| [0, tenth as u64 / 3]);
        assert!(matches!(&leaps[..], [(30, text)] if text.contains("leaps from sample to sample")), "{leaps:?}");
        assert_eq!(told(|_| 0.0, |tenth| [0, tenth as u64 / 12]), []);
    }
}
