//! Which presentation a completion belongs to, and how far its time is to be believed. No clock is read here.

use holod_calibration::TimeNs;

use super::watch::{Completion, Shown};
use crate::present::TimestampSource;

/// How far after its arrival a completion's time may lie, and how long before: clocks are read at different places.
const AHEAD_MAX: TimeNs = TimeNs(2_000_000);
const BEHIND_MAX: TimeNs = TimeNs(1_000_000_000);

/// When and how a presentation came on the monitor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Presented {
    pub(super) t_present: TimeNs,
    pub(super) timestamp_source: TimestampSource,
    pub(super) refresh_count: Option<u64>,
}

/// What became of the presentation that is on its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// The completion belongs to another presentation, or is the second one of the same.
    NotThis,
    /// It was never shown.
    Skipped,
    /// It is on the monitor.
    Shown(Presented),
}

/// Follows the presentations of one surface, of which one at a time is on its way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Timeline {
    /// Number of the presentation that is on its way, or was last.
    serial: u32,
    refresh_count: u64,
}

impl Timeline {
    /// Begins with the completion of a surface's first presentation.
    pub(super) fn starting_with(first: Completion) -> Self {
        Self { serial: first.serial, refresh_count: first.refresh_count }
    }

    /// The next picture was presented.
    pub(super) fn present(&mut self) {
        self.serial = self.serial.wrapping_add(1);
    }

    /// What `completion`, which came at `now`, says of the presentation that is on its way.
    ///
    /// Only a flip is a time that the display's driver stamped: a copy is done near its time, while the monitor scans,
    /// and where a compositor is at work not even to what is scanned. A time of another clock, or none, is replaced by
    /// the completion's arrival.
    pub(super) fn complete(&mut self, completion: Completion, now: TimeNs) -> Outcome {
        if completion.serial != self.serial {
            return Outcome::NotThis;
        }
        if completion.shown == Shown::Skipped {
            return Outcome::Skipped;
        }
        let age = now - completion.t_present;
        let counts_on = completion.refresh_count > self.refresh_count;
        self.refresh_count = completion.refresh_count;
        if age < TimeNs(-AHEAD_MAX.0) || age > BEHIND_MAX {
            return Outcome::Shown(Presented {
                t_present: now,
                timestamp_source: TimestampSource::Software,
                refresh_count: None,
            });
        }
        let is_stamped = completion.shown == Shown::Flipped && counts_on;
        Outcome::Shown(Presented {
            t_present: completion.t_present,
            timestamp_source: if is_stamped { TimestampSource::Driver } else { TimestampSource::Software },
            refresh_count: counts_on.then_some(completion.refresh_count),
        })
    }
}

/// How long before a refresh its picture is chosen. Learns how early the display server wants it: compositors draw some
/// milliseconds before a refresh, and say nothing of that.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lead {
    period: TimeNs,
    lead: TimeNs,
    misses: u32,
}

/// At first, for the driver and the display server to take the picture; never more than half of a refresh.
const LEAD_FIRST: TimeNs = TimeNs(4_000_000);
/// Part of a refresh by which the lead grows.
const LEAD_STEP: i64 = 8;
/// A missed refresh weighs as much as this many that were met, and this many more misses than that let the lead grow:
/// three in a row do, one in a second does not.
const MISS_WEIGHT: u32 = 8;
const MISSES_MAX: u32 = 2;
/// What the lead has grown by falls by this part with each refresh that was met, so that hiccups at the start do not make
/// every later picture an old one: where all of it was needed, at 60 Hz some three refreshes are missed in 20 s.
const FORGET_LEAD: i64 = 4096;

impl Lead {
    pub(super) fn new(period: TimeNs) -> Self {
        Self { period, lead: Self::first(period), misses: 0 }
    }

    fn first(period: TimeNs) -> TimeNs {
        LEAD_FIRST.min(TimeNs(period.0 / 2))
    }

    /// When to choose the picture of the refresh after the one at `t_refresh`.
    pub(super) fn t_choose(&self, t_refresh: TimeNs) -> TimeNs {
        t_refresh + self.period - self.lead
    }

    /// Learns from a picture that was chosen for the refresh after the one at `t_before` and came at `t_present`.
    pub(super) fn learn(&mut self, t_before: TimeNs, t_present: TimeNs) {
        if (t_present - t_before).0 < self.period.0 + self.period.0 / 2 {
            self.misses = self.misses.saturating_sub(1);
            self.lead.0 -= (self.lead - Self::first(self.period)).0 / FORGET_LEAD;
            return;
        }
        self.misses += MISS_WEIGHT;
        if self.misses > MISS_WEIGHT * MISSES_MAX {
            self.misses = 0;
            // All of a refresh: the picture is chosen as soon as the one before has come.
            self.lead = (self.lead + TimeNs(self.period.0 / LEAD_STEP)).min(self.period);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn completion(serial: u32, t_ms: i64, refresh_count: u64, shown: Shown) -> Completion {
        Completion { serial, t_present: TimeNs(t_ms * MS), refresh_count, shown }
    }

    /// The first presentation has number 9 and came at refresh 100; number 10 is on its way.
    fn timeline() -> Timeline {
        let mut timeline = Timeline::starting_with(completion(9, 1000, 100, Shown::Flipped));
        timeline.present();
        timeline
    }

    /// A display server that takes pictures until `deadline` before a refresh; the refreshes that are missed of the
    /// last `count` of 200.
    fn missed(deadline: TimeNs, hiccups: usize, count: usize) -> usize {
        let period = TimeNs(16 * MS);
        let mut lead = Lead::new(period);
        let mut t_refresh = TimeNs(0);
        let mut misses = Vec::new();
        for frame in 0..200 {
            let t_next = t_refresh + period;
            let is_hiccup = hiccups > 0 && frame % hiccups == 0;
            let missed = is_hiccup || lead.t_choose(t_refresh) > t_next - deadline;
            let t_present = if missed { t_next + period } else { t_next };
            lead.learn(t_refresh, t_present);
            t_refresh = t_present;
            misses.push(missed);
        }
        misses[200 - count..].iter().filter(|missed| **missed).count()
    }

    #[test]
    fn the_lead_grows_until_refreshes_are_met_and_no_further() {
        for deadline_ms in [0, 3, 7, 11, 15] {
            assert_eq!(missed(TimeNs(deadline_ms * MS), 0, 150), 0, "{deadline_ms}");
        }
        // What no lead meets is missed each time.
        assert_eq!(missed(TimeNs(17 * MS), 0, 150), 150);
    }

    #[test]
    fn a_hiccup_now_and_then_does_not_change_the_lead() {
        let mut lead = Lead::new(TimeNs(16 * MS));
        let before = lead.t_choose(TimeNs(0));
        for frame in 0..600 {
            lead.learn(TimeNs(0), TimeNs(if frame % 20 == 0 { 32 } else { 16 } * MS));
        }
        assert_eq!(lead.t_choose(TimeNs(0)), before);
        assert_eq!(missed(TimeNs(3 * MS), 20, 200), 10);
    }

    #[test]
    fn what_hiccups_at_the_start_have_taught_is_forgotten() {
        let mut lead = Lead::new(TimeNs(16 * MS));
        let at_first = lead.t_choose(TimeNs(0));
        for _ in 0..24 {
            lead.learn(TimeNs(0), TimeNs(32 * MS));
        }
        assert_eq!(lead.t_choose(TimeNs(0)), TimeNs(0), "all of a refresh");
        // Five minutes at 60 Hz.
        for _ in 0..18_000 {
            lead.learn(TimeNs(0), TimeNs(16 * MS));
        }
        assert!(at_first - lead.t_choose(TimeNs(0)) < TimeNs(MS / 2));
    }

    #[test]
    fn a_flip_has_the_drivers_time_and_a_copy_has_not() {
        for (shown, timestamp_source) in
            [(Shown::Flipped, TimestampSource::Driver), (Shown::Copied, TimestampSource::Software)]
        {
            let outcome = timeline().complete(completion(10, 1016, 101, shown), TimeNs(1017 * MS));
            let presented = Presented { t_present: TimeNs(1016 * MS), timestamp_source, refresh_count: Some(101) };
            assert_eq!(outcome, Outcome::Shown(presented));
        }
    }

    #[test]
    fn what_belongs_to_another_presentation_says_nothing_of_this_one() {
        let mut timeline = timeline();
        let now = TimeNs(1017 * MS);
        for serial in [9, 11, 0] {
            assert_eq!(timeline.complete(completion(serial, 1016, 101, Shown::Flipped), now), Outcome::NotThis);
        }
        assert_eq!(timeline.complete(completion(10, 1016, 101, Shown::Skipped), now), Outcome::Skipped);
        timeline.present();
        assert!(matches!(timeline.complete(completion(11, 1016, 101, Shown::Flipped), now), Outcome::Shown(_)));
    }

    #[test]
    fn a_time_of_another_clock_or_a_count_that_stands_is_not_the_drivers() {
        for t_ms in [0, 10, 1020, 1_700_000_000_000] {
            let outcome = timeline().complete(completion(10, t_ms, 101, Shown::Flipped), TimeNs(1017 * MS));
            let arrival = Presented {
                t_present: TimeNs(1017 * MS),
                timestamp_source: TimestampSource::Software,
                refresh_count: None,
            };
            assert_eq!(outcome, Outcome::Shown(arrival), "{t_ms}");
        }
        for count in [100, 0] {
            let outcome = timeline().complete(completion(10, 1016, count, Shown::Flipped), TimeNs(1017 * MS));
            let Outcome::Shown(Presented { timestamp_source, refresh_count, .. }) = outcome else {
                panic!("{outcome:?}")
            };
            assert_eq!((timestamp_source, refresh_count), (TimestampSource::Software, None));
        }
    }
}
