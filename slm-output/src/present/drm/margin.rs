//! How long before scan-out the next frame is chosen: late, for a fresh pupil, and never too late.

use holod_calibration::TimeNs;

/// What a thread at normal priority needs beyond what was measured.
const FLOOR: TimeNs = TimeNs(300_000);
/// After a flip came too late, this much earlier; twice as much after each further one.
const FIRST_PENALTY: TimeNs = TimeNs(250_000);
/// A peak and a penalty fall by this part at each flip in time: to a third within a second at 60 Hz.
const FORGET: i64 = 64;

/// Learns from each flip how much time the next one needs. Pure.
#[derive(Debug)]
pub struct CommitMargin {
    period: TimeNs,
    blank: TimeNs,
    /// Longest recent time from waking up to the end of the commit.
    work: TimeNs,
    /// Longest recent time from the time asked for to waking up.
    lateness: TimeNs,
    penalty: TimeNs,
}

impl CommitMargin {
    /// A margin for a mode whose refreshes are `period` apart and whose vertical blank takes `blank`.
    pub fn new(period: TimeNs, blank: TimeNs) -> Self {
        Self { period, blank, work: TimeNs(0), lateness: TimeNs(0), penalty: TimeNs(0) }
    }

    /// When to choose the frame for the scan-out that begins at `t_present`. The controller takes the new picture at
    /// the begin of the blank before it. At most three quarters of a refresh before that.
    pub fn t_choose(&self, t_present: TimeNs) -> TimeNs {
        let margin = FLOOR.0 + self.work.0 + self.lateness.0 + self.penalty.0;
        TimeNs(t_present.0 - self.blank.0 - margin.min(self.period.0 * 3 / 4))
    }

    /// Learns from one flip: when it was due, when work on it began and when it was handed to the kernel.
    pub fn learn(&mut self, t_due: TimeNs, t_begin: TimeNs, t_end: TimeNs) {
        let peak = |peak: TimeNs, new: i64| TimeNs(new.clamp(peak.0 - peak.0 / FORGET, self.period.0 / 2));
        self.work = peak(self.work, (t_end.0 - t_begin.0).min(self.period.0 / 2));
        self.lateness = peak(self.lateness, (t_begin.0 - t_due.0).clamp(0, self.period.0 / 4));
        self.penalty.0 -= self.penalty.0 / FORGET;
    }

    /// The last flip came a refresh later than it was meant for.
    pub fn missed(&mut self) {
        self.penalty = TimeNs((2 * self.penalty.0).clamp(FIRST_PENALTY.0, self.period.0 / 2));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PERIOD: TimeNs = TimeNs(16_666_667);
    const BLANK: TimeNs = TimeNs(666_667);

    fn before_latch(margin: &CommitMargin) -> i64 {
        -BLANK.0 - margin.t_choose(TimeNs(0)).0
    }

    #[test]
    fn the_margin_follows_the_work_and_the_wake_up() {
        let mut margin = CommitMargin::new(PERIOD, BLANK);
        assert_eq!(before_latch(&margin), FLOOR.0);
        margin.learn(TimeNs(0), TimeNs(100_000), TimeNs(900_000));
        assert_eq!(before_latch(&margin), FLOOR.0 + 100_000 + 800_000);
        for _ in 0..1000 {
            margin.learn(TimeNs(0), TimeNs(10_000), TimeNs(210_000));
        }
        assert!(before_latch(&margin) < FLOOR.0 + 220_000, "{}", before_latch(&margin));
    }

    #[test]
    fn a_missed_refresh_makes_it_earlier_for_a_while() {
        let mut margin = CommitMargin::new(PERIOD, BLANK);
        margin.missed();
        margin.missed();
        assert_eq!(before_latch(&margin), FLOOR.0 + 2 * FIRST_PENALTY.0);
        for _ in 0..1000 {
            margin.learn(TimeNs(0), TimeNs(0), TimeNs(0));
        }
        assert!(before_latch(&margin) < FLOOR.0 + 100, "{}", before_latch(&margin));
    }

    proptest! {
        #[test]
        fn it_is_never_after_the_latch_nor_in_an_earlier_refresh(
            flips in proptest::collection::vec((-1_000_000i64..50_000_000, 0i64..50_000_000, any::<bool>()), 0..60),
        ) {
            let mut margin = CommitMargin::new(PERIOD, BLANK);
            for (late, work, missed) in flips {
                margin.learn(TimeNs(0), TimeNs(late), TimeNs(late + work));
                if missed {
                    margin.missed();
                }
                prop_assert!((FLOOR.0..=PERIOD.0 * 3 / 4).contains(&before_latch(&margin)));
            }
        }
    }
}
