//! How a box's clock goes with the host's.

use holod_calibration::TimeNs;
use holod_laser_firmware::TimeUs;

/// By how much the two clocks may run apart: each may be wrong by 100 parts per million, and NTP has the host's run
/// faster or slower by up to 500 while it corrects the wall clock, which the monotonic one goes with.
const DRIFT_PPM: i64 = 1000;

/// What is known of box time minus host time: never a guess, always an interval.
///
/// A box answers with the time at which it carried a command out. That lies between sending and hearing, so one
/// exchange bounds the offset from both sides, within the exchange's round trip. Intervals of many exchanges are cut
/// with each other, each widened by the drift since, so that what stays is the best bound and still always true.
#[derive(Clone, Copy, Debug, Default)]
pub struct BoxClock {
    known: Option<Known>,
}

#[derive(Clone, Copy, Debug)]
struct Known {
    /// When it was learned, on the host's clock.
    t: TimeNs,
    least_ns: i64,
    greatest_ns: i64,
}

/// Box time minus host time at one moment, nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Offset {
    /// Not less than this.
    pub least_ns: i64,
    /// Not more than this.
    pub greatest_ns: i64,
}

impl Offset {
    /// The middle of what it may be.
    pub fn middle_ns(self) -> i64 {
        self.least_ns + (self.greatest_ns - self.least_ns) / 2
    }

    /// By how much the middle may be wrong either way.
    pub fn error_ns(self) -> i64 {
        (self.greatest_ns - self.least_ns + 1) / 2
    }
}

/// By how much the clocks run apart in `time` at most.
fn drift_ns(time: TimeNs) -> i64 {
    time.0.abs() / (1_000_000 / DRIFT_PPM) + 1
}

impl BoxClock {
    /// Learns from one exchange: the box did something at `t_box` of its clock, after the host had begun to ask for it
    /// at `t_asked` and before the host heard of it at `t_heard`.
    ///
    /// # Errors
    /// By how many nanoseconds the clocks have run apart beyond what their drift allows. What was known before is
    /// forgotten then, and this exchange is the first of a new beginning.
    pub fn learn(&mut self, t_asked: TimeNs, t_heard: TimeNs, t_box: TimeUs) -> Result<(), i64> {
        let t_box_ns = i64::try_from(t_box.0).unwrap_or(i64::MAX / 2000).min(i64::MAX / 2000) * 1000;
        let t_asked = t_asked.min(t_heard);
        // The answer is as old as its way at most.
        let drift_ns = drift_ns(t_heard - t_asked);
        let mut offset = Offset {
            least_ns: t_box_ns - t_heard.0 - drift_ns,
            // The box's clock may have been about to tick.
            greatest_ns: t_box_ns + 999 - t_asked.0 + drift_ns,
        };
        let mut jumped = Ok(());
        if let Some(before) = self.offset_at(t_heard) {
            let apart_ns = (offset.least_ns - before.greatest_ns).max(before.least_ns - offset.greatest_ns);
            if apart_ns > 0 {
                jumped = Err(apart_ns);
            } else {
                offset.least_ns = offset.least_ns.max(before.least_ns);
                offset.greatest_ns = offset.greatest_ns.min(before.greatest_ns);
            }
        }
        self.known = Some(Known { t: t_heard, least_ns: offset.least_ns, greatest_ns: offset.greatest_ns });
        jumped
    }

    /// What is known at `now`; nothing before the first exchange.
    pub fn offset_at(&self, now: TimeNs) -> Option<Offset> {
        let known = self.known?;
        let drift_ns = drift_ns(now - known.t);
        Some(Offset { least_ns: known.least_ns - drift_ns, greatest_ns: known.greatest_ns + drift_ns })
    }

    /// Forgets everything: the box has booted.
    pub fn forget(&mut self) {
        self.known = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn one_exchange_bounds_the_offset_by_half_its_round_trip() {
        let mut clock = BoxClock::default();
        assert_eq!(clock.offset_at(TimeNs(0)), None);
        clock.learn(TimeNs(1_000_000), TimeNs(1_400_000), TimeUs(5_000)).unwrap();
        let offset = clock.offset_at(TimeNs(1_400_000)).unwrap();
        // 400 ns of drift on the way, and what integers round off.
        assert_eq!((offset.least_ns, offset.greatest_ns), (3_599_598, 4_001_401));
        assert_eq!((offset.middle_ns(), offset.error_ns()), (3_800_499, 200_902));
        let later = clock.offset_at(TimeNs(1_400_000 + 1_000_000_000)).unwrap();
        assert_eq!(later.error_ns() - offset.error_ns(), 1_000_000, "1 ms a second");
    }

    #[test]
    fn a_clock_that_jumps_is_noticed_and_learned_anew() {
        for jump_us in [-2_000_000i64, -700, 700, 2_000_000] {
            let mut clock = BoxClock::default();
            let t_box = |t: TimeNs| TimeUs((t.0 / 1000 + 5_000_000) as u64);
            let t = TimeNs(1_000_000_000);
            clock.learn(t - TimeNs(200_000), t, t_box(t)).unwrap();
            let t = t + TimeNs(10_000_000);
            clock.learn(t - TimeNs(200_000), t, t_box(t)).unwrap();
            let t = t + TimeNs(10_000_000);
            let jumped = TimeUs(t_box(t).0.saturating_add_signed(jump_us));
            let apart_ns = clock.learn(t - TimeNs(200_000), t, jumped).unwrap_err();
            assert!(apart_ns > 0 && apart_ns <= jump_us.abs() * 1000, "{jump_us} {apart_ns}");
            let offset = clock.offset_at(t).unwrap();
            assert!((offset.middle_ns() - 5_000_000_000 - jump_us * 1000).abs() <= 110_000);
        }
    }

    proptest! {
        /// Whatever the round trips, the ticks and the drift within its bound: the truth always lies in the interval,
        /// the clocks are never taken to have jumped, and the best exchange bounds the error.
        #[test]
        fn the_truth_is_always_inside(
            offset_ms in -1_000i64..1_000_000,
            drift_ppm in -950i64..950,
            exchanges in prop::collection::vec((0i64..20_000_000, 0i64..3_000_000, 0i64..3_000_000), 1..60),
        ) {
            let t_origin = 2_000_000_000_000i64;
            let truth = |t: i64| t + offset_ms * 1_000_000 + (t - t_origin) * drift_ppm / 1_000_000;
            let mut clock = BoxClock::default();
            let mut t = t_origin;
            let mut best = i64::MAX;
            for (pause, there, back) in exchanges {
                let t_asked = t + pause;
                let t_done = t_asked + there;
                t = t_done + back;
                let t_box = TimeUs((truth(t_done) / 1000) as u64);
                prop_assert_eq!(clock.learn(TimeNs(t_asked), TimeNs(t), t_box), Ok(()));
                let offset = clock.offset_at(TimeNs(t)).unwrap();
                let true_ns = truth(t) - t;
                prop_assert!((offset.least_ns..=offset.greatest_ns).contains(&true_ns), "{:?} {}", offset, true_ns);
                best = best.saturating_add((pause + there + back) / 1000 + 2).min((there + back) * 1002 / 2000 + 502);
                prop_assert!(offset.error_ns() <= best, "{} {}", offset.error_ns(), best);
            }
        }
    }
}
