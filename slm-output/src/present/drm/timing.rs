//! When a refresh began, from page-flip events that may be wrong.
//!
//! The kernel stamps a page flip with the time at which the first pixel of the new picture is scanned out and with a
//! counter of refreshes. Most drivers tell the truth. Known to be wrong are: a counter that stays at zero and a time
//! that software took, where a driver has no vertical-blank interrupt; a time of zero; an event that comes before the
//! flip, with a time that is not a refresh's; one event twice; a counter that starts anew; a clock that is not the
//! monotonic one. [`FlipClock`] believes an event only where counter and time agree with the events before it, and says
//! [`TimestampSource::Hardware`] only then.

use holod_calibration::TimeNs;

use crate::present::TimestampSource;

/// Events in a row that must agree with one another before they are believed.
const AGREEING_EVENTS: u32 = 3;
/// Events in a row that may be delivered more than two refreshes after their time, before the clock is held to be
/// another one.
const LATE_EVENTS: u32 = 3;

/// What a page-flip event says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FlipStamp {
    /// The counter of refreshes, as it is; it wraps.
    pub sequence: u32,
    /// Start of scan-out on the monotonic clock.
    pub t: TimeNs,
}

/// What is known of the refresh on which a flip was shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refresh {
    /// Host time at which its scan-out begins: the end of the blank before it.
    pub t_present: TimeNs,
    /// [`TimestampSource::Hardware`] where the event is believed; [`TimestampSource::Estimated`] where it is not but
    /// earlier ones tell the time; [`TimestampSource::Software`] where only the event's arrival is known.
    pub timestamp_source: TimestampSource,
    /// The display controller's counter, widened to 64 bits; `None` where the event is not believed.
    pub refresh_count: Option<u64>,
    /// Refreshes since the previous flip on which the previous picture stayed, where that is known.
    pub missed: u64,
}

/// How often an event was not believed, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FlipFaults {
    /// The counter was zero.
    pub zero_sequence: u64,
    /// The time was zero.
    pub zero_time: u64,
    /// The time was less than half a refresh after the previous one's.
    pub early: u64,
    /// The event had been there before; it was dropped.
    pub doubled: u64,
    /// Counter and time did not agree.
    pub jumped: u64,
    /// The time was not after the previous one's.
    pub backwards: u64,
    /// The time lay further in the future than scan-out can, or always far in the past.
    pub foreign_clock: u64,
}

/// Judges page-flip events. Pure: time comes in as an argument.
#[derive(Debug)]
pub struct FlipClock {
    period: TimeNs,
    lead: TimeNs,
    monotonic: bool,
    /// The last event that was believed.
    trusted: Option<Anchor>,
    /// The last event that was not, and how many before it agree with it.
    candidate: Option<(Anchor, u32)>,
    /// When the last flip was reported as shown.
    t_last: Option<TimeNs>,
    late_in_row: u32,
    faults: FlipFaults,
}

#[derive(Clone, Copy, Debug)]
struct Anchor {
    sequence: u32,
    count: u64,
    t: TimeNs,
}

enum Agreement {
    /// So many refreshes later.
    Agrees(u64),
    Doubled,
    Early,
    Backwards,
    Jumped,
}

impl FlipClock {
    /// A clock for a mode whose refreshes are `period` apart and whose vertical blank takes `blank`. `monotonic` is
    /// whether the driver stamps events by the monotonic clock.
    pub fn new(period: TimeNs, blank: TimeNs, monotonic: bool) -> Self {
        Self {
            period,
            // An event may be delivered as soon as the blank begins, and its time is that of the blank's end.
            lead: TimeNs(blank.0 + period.0 / 16),
            monotonic,
            trusted: None,
            candidate: None,
            t_last: None,
            late_in_row: 0,
            faults: FlipFaults::default(),
        }
    }

    /// How often an event was not believed.
    pub fn faults(&self) -> FlipFaults {
        self.faults
    }

    /// Judges the event `stamp`, which was read at `now` and says that a flip is complete. `None` where it is the event
    /// of an earlier flip once more.
    pub fn judge(&mut self, stamp: FlipStamp, now: TimeNs) -> Option<Refresh> {
        let refresh = self.believe(stamp, now)?;
        self.t_last = Some(refresh.t_present);
        Some(refresh)
    }

    fn believe(&mut self, stamp: FlipStamp, now: TimeNs) -> Option<Refresh> {
        if !self.monotonic {
            return self.by_arrival(now);
        }
        let with_trusted = self.trusted.map(|anchor| (anchor, self.compare(anchor, stamp)));
        if let Some((_, Agreement::Doubled)) = with_trusted {
            self.faults.doubled += 1;
            return None;
        }
        // Of all counts that are zero only the one at which the counter wraps is a count.
        let wraps = matches!(with_trusted, Some((_, Agreement::Agrees(_))));
        if stamp.t.0 == 0 {
            self.faults.zero_time += 1;
            return self.by_arrival(now);
        }
        if stamp.sequence == 0 && !wraps {
            self.faults.zero_sequence += 1;
            return self.by_arrival(now);
        }
        if stamp.t.0 > now.0 + self.lead.0 || self.is_long_ago(stamp.t, now) {
            self.faults.foreign_clock += 1;
            self.trusted = None;
            self.candidate = None;
            return self.by_arrival(now);
        }
        match with_trusted {
            Some((anchor, Agreement::Agrees(refreshes))) => {
                let count = anchor.count + refreshes;
                self.trusted = Some(Anchor { sequence: stamp.sequence, count, t: stamp.t });
                self.candidate = None;
                return Some(Refresh {
                    t_present: stamp.t,
                    timestamp_source: TimestampSource::Hardware,
                    refresh_count: Some(count),
                    missed: refreshes - 1,
                });
            }
            Some((_, Agreement::Early)) => self.faults.early += 1,
            Some((_, Agreement::Backwards)) => self.faults.backwards += 1,
            Some((_, Agreement::Jumped)) => self.faults.jumped += 1,
            Some((_, Agreement::Doubled)) | None => {}
        }
        self.follow_candidate(stamp, now)
    }

    /// An event that does not agree with the trusted ones, or there are none: trusted once enough of its kind agree.
    fn follow_candidate(&mut self, stamp: FlipStamp, now: TimeNs) -> Option<Refresh> {
        let mut anchor = Anchor { sequence: stamp.sequence, count: u64::from(stamp.sequence), t: stamp.t };
        let mut agreeing = 1;
        let mut missed = 0;
        if let Some((candidate, agreeing_before)) = self.candidate {
            match self.compare(candidate, stamp) {
                Agreement::Agrees(refreshes) => {
                    anchor.count = candidate.count + refreshes;
                    agreeing = agreeing_before + 1;
                    missed = refreshes - 1;
                }
                Agreement::Doubled => {
                    self.faults.doubled += 1;
                    return None;
                }
                _ => {}
            }
        }
        if agreeing >= AGREEING_EVENTS {
            self.trusted = Some(anchor);
            self.candidate = None;
            let refresh_count = Some(anchor.count);
            return Some(Refresh {
                t_present: stamp.t,
                timestamp_source: TimestampSource::Hardware,
                refresh_count,
                missed,
            });
        }
        self.candidate = Some((anchor, agreeing));
        let Some(trusted) = self.trusted else { return self.by_arrival(now) };
        // The refresh nearest to the arrival, counted on from those that were believed, and never one that was
        // reported.
        let refreshes = ((now.0 - trusted.t.0 + self.period.0 / 2) / self.period.0).max(1);
        let mut t_present = TimeNs(trusted.t.0 + refreshes * self.period.0);
        if self.t_last.is_some_and(|t_last| t_present <= t_last) {
            t_present = TimeNs(self.t_last.map_or(0, |t_last| t_last.0) + self.period.0);
        }
        Some(Refresh { t_present, timestamp_source: TimestampSource::Estimated, refresh_count: None, missed: 0 })
    }

    /// What is known where the event's own figures are worth nothing: that it came. A second one within half a refresh
    /// is none of its own.
    fn by_arrival(&mut self, now: TimeNs) -> Option<Refresh> {
        if self.t_last.is_some_and(|t_last| (now.0 - t_last.0).abs() < self.period.0 / 2) {
            self.faults.doubled += 1;
            return None;
        }
        Some(Refresh { t_present: now, timestamp_source: TimestampSource::Software, refresh_count: None, missed: 0 })
    }

    /// Now and then an event waits long for its reader; where all do, their clock is another one.
    fn is_long_ago(&mut self, t: TimeNs, now: TimeNs) -> bool {
        if t.0 + 2 * self.period.0 >= now.0 {
            self.late_in_row = 0;
            return false;
        }
        self.late_in_row += 1;
        self.late_in_row > LATE_EVENTS
    }

    fn compare(&self, anchor: Anchor, stamp: FlipStamp) -> Agreement {
        let refreshes = i64::from(stamp.sequence.wrapping_sub(anchor.sequence));
        let elapsed = stamp.t.0.saturating_sub(anchor.t.0);
        if refreshes == 0 && elapsed.abs() < self.period.0 / 2 {
            return Agreement::Doubled;
        }
        if elapsed <= 0 {
            return Agreement::Backwards;
        }
        // Stamps scatter, and a panel's clock is a little off its nominal rate.
        let expected = refreshes.saturating_mul(self.period.0);
        let tolerance = self.period.0 / 16 + expected / 1000;
        if refreshes > 0 && (elapsed - expected).abs() <= tolerance {
            return Agreement::Agrees(refreshes as u64);
        }
        if elapsed < self.period.0 / 2 { Agreement::Early } else { Agreement::Jumped }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PERIOD: i64 = 16_666_667;
    const BLANK: i64 = 666_667;
    const START: i64 = 5_000_000_000;

    fn clock() -> FlipClock {
        FlipClock::new(TimeNs(PERIOD), TimeNs(BLANK), true)
    }

    fn truth(refresh: i64) -> TimeNs {
        TimeNs(START + refresh * PERIOD)
    }

    /// The event of the refresh `refresh` after the first, whose counter is `first`, told at the begin of its blank.
    fn event(first: u32, refresh: i64) -> (FlipStamp, TimeNs) {
        let stamp = FlipStamp { sequence: first.wrapping_add(refresh as u32), t: truth(refresh) };
        (stamp, TimeNs(stamp.t.0 - BLANK + 40_000))
    }

    /// A clock that believes refreshes up to `last`.
    fn locked(first: u32, last: i64) -> FlipClock {
        let mut clock = clock();
        for refresh in 0..=last {
            let (stamp, now) = event(first, refresh);
            clock.judge(stamp, now).unwrap();
        }
        clock
    }

    #[test]
    fn three_events_that_agree_are_believed() {
        let mut clock = clock();
        let timestamp_sources: Vec<_> = (0..4)
            .map(|refresh| {
                let (stamp, now) = event(7, refresh);
                clock.judge(stamp, now).unwrap().timestamp_source
            })
            .collect();
        use TimestampSource::{Hardware, Software};
        assert_eq!(timestamp_sources, [Software, Software, Hardware, Hardware]);
        assert_eq!(clock.faults(), FlipFaults::default());
    }

    #[test]
    fn a_zero_counter_is_software_time_but_a_wrap_is_not() {
        let mut unsupported = clock();
        for refresh in 0..20 {
            let now = truth(refresh);
            let seen = unsupported.judge(FlipStamp { sequence: 0, t: now }, now).unwrap();
            assert_eq!(
                seen,
                Refresh { t_present: now, timestamp_source: TimestampSource::Software, refresh_count: None, missed: 0 }
            );
        }
        assert_eq!(unsupported.faults().zero_sequence, 20);
        let mut wrapping = locked(u32::MAX - 2, 2);
        let (stamp, now) = event(u32::MAX - 2, 3);
        assert_eq!(stamp.sequence, 0);
        let seen = wrapping.judge(stamp, now).unwrap();
        assert_eq!(
            (seen.timestamp_source, seen.refresh_count),
            (TimestampSource::Hardware, Some(u64::from(u32::MAX) + 1))
        );
    }

    #[test]
    fn a_clock_that_is_not_the_monotonic_one_is_never_believed() {
        let mut flagged = FlipClock::new(TimeNs(PERIOD), TimeNs(BLANK), false);
        let mut ahead = clock();
        let mut behind = clock();
        for refresh in 0..50 {
            let (stamp, now) = event(9, refresh);
            assert_eq!(flagged.judge(stamp, now).unwrap().timestamp_source, TimestampSource::Software);
            let wall = FlipStamp { t: TimeNs(stamp.t.0 + 1_700_000_000_000_000_000), ..stamp };
            assert_eq!(ahead.judge(wall, now).unwrap().timestamp_source, TimestampSource::Software);
            let old = FlipStamp { t: TimeNs(stamp.t.0 - 1_000_000_000), ..stamp };
            let seen = behind.judge(old, now).unwrap();
            assert!(
                refresh < i64::from(LATE_EVENTS) || seen.timestamp_source == TimestampSource::Software,
                "{refresh}"
            );
        }
        assert_eq!(ahead.faults().foreign_clock, 50);
    }

    #[test]
    fn a_reader_that_was_stopped_does_not_make_the_clock_foreign() {
        let mut clock = locked(7, 10);
        let (stamp, now) = event(7, 11);
        let seen = clock.judge(stamp, TimeNs(now.0 + 3_000_000_000)).unwrap();
        assert_eq!((seen.timestamp_source, seen.t_present), (TimestampSource::Hardware, truth(11)));
    }

    #[test]
    fn a_counter_that_starts_anew_is_believed_again_after_three() {
        let mut clock = locked(700, 5);
        let seen: Vec<_> = (6..10)
            .map(|refresh| {
                let stamp = FlipStamp { sequence: refresh as u32 - 5, t: truth(refresh) };
                clock.judge(stamp, truth(refresh)).unwrap()
            })
            .collect();
        use TimestampSource::{Estimated, Hardware};
        let timestamp_sources = seen.iter().map(|refresh| refresh.timestamp_source).collect::<Vec<_>>();
        assert_eq!(timestamp_sources, [Estimated, Estimated, Hardware, Hardware]);
        assert!(seen.iter().zip(6..).all(|(refresh, n)| refresh.t_present == truth(n)), "{seen:?}");
        assert_eq!(clock.faults().jumped, 3);
    }

    #[test]
    fn an_early_event_is_placed_at_the_refresh_that_it_was_for() {
        let mut clock = locked(7, 5);
        let early = FlipStamp { sequence: 7 + 6, t: TimeNs(truth(5).0 + 1_500_000) };
        let seen = clock.judge(early, TimeNs(truth(5).0 + 1_600_000)).unwrap();
        assert_eq!((seen.timestamp_source, seen.t_present), (TimestampSource::Estimated, truth(6)));
        assert_eq!(clock.faults().early, 1);
        let (stamp, now) = event(7, 7);
        let seen = clock.judge(stamp, now).unwrap();
        assert_eq!((seen.timestamp_source, seen.t_present), (TimestampSource::Hardware, truth(7)));
    }

    /// What a driver may do to one event.
    #[derive(Clone, Copy, Debug)]
    enum Lie {
        ZeroSequence,
        ZeroTime,
        Early(i64),
        Doubled,
        CounterJump(u32),
        Backwards(i64),
        Future(i64),
    }

    fn lies() -> impl Strategy<Value = Lie> {
        prop_oneof![
            Just(Lie::ZeroSequence),
            Just(Lie::ZeroTime),
            (PERIOD / 8..PERIOD).prop_map(Lie::Early),
            Just(Lie::Doubled),
            (5u32..u32::MAX / 2).prop_map(Lie::CounterJump),
            (PERIOD + 1..1_000_000_000i64).prop_map(Lie::Backwards),
            (2 * PERIOD..1_000_000_000_000i64).prop_map(Lie::Future),
        ]
    }

    /// For each flip: refreshes since the previous one, scatter of its stamp and of its reading, and a lie.
    fn flips(lies: impl Strategy<Value = Option<Lie>>) -> impl Strategy<Value = Vec<(i64, i64, i64, Option<Lie>)>> {
        let flip = (prop_oneof![8 => Just(1i64), 1 => 2i64..5], -50_000i64..50_000, 0i64..3_000_000, lies);
        proptest::collection::vec(flip, 1..120)
    }

    proptest! {
        #[test]
        fn the_truth_is_believed_to_the_nanosecond(first in any::<u32>(), flips in flips(Just(None))) {
            let (mut clock, mut refresh) = (clock(), 0);
            for (index, (step, scatter, delay, _)) in flips.into_iter().enumerate() {
                refresh += step;
                let (mut stamp, now) = event(first, refresh);
                stamp.t.0 += scatter;
                let seen = clock.judge(stamp, TimeNs(now.0 + delay)).unwrap();
                // A counter of zero at the very start is not believed yet.
                if index >= 3 {
                    prop_assert_eq!(seen.timestamp_source, TimestampSource::Hardware);
                    prop_assert_eq!(seen.t_present, stamp.t);
                    prop_assert_eq!(seen.missed, step as u64 - 1);
                    prop_assert_eq!(seen.refresh_count.map(|count| count as u32), Some(stamp.sequence));
                }
            }
            prop_assert_eq!(clock.faults().jumped + clock.faults().early + clock.faults().doubled, 0);
        }

        /// Two lies in a row never have the same rhythm here, or they would be a truth that nothing contradicts.
        #[test]
        fn nothing_false_is_called_hardware(first in 1u32..1_000_000, flips in flips(proptest::option::weighted(0.3, lies()))) {
            let (mut clock, mut refresh, mut lied) = (clock(), 0, 0);
            let (mut t_last, mut count_last) = (TimeNs(0), 0);
            for (step, scatter, delay, lie) in flips {
                refresh += step;
                let (mut stamp, mut now) = event(first, refresh);
                stamp.t.0 += scatter;
                now.0 += delay;
                let honest = stamp;
                // Not more than one lie in three, so that the truth is told apart from it.
                let lie = lie.filter(|_| lied == 0);
                lied = if lie.is_some() { 2 } else { (lied - 1).max(0) };
                match lie {
                    Some(Lie::ZeroSequence) => stamp.sequence = 0,
                    Some(Lie::ZeroTime) => stamp.t = TimeNs(0),
                    Some(Lie::Early(by)) => {
                        stamp.t.0 -= by;
                        now.0 -= by;
                    }
                    Some(Lie::CounterJump(by)) => stamp.sequence = stamp.sequence.wrapping_add(by),
                    Some(Lie::Backwards(by)) => stamp.t.0 -= by,
                    Some(Lie::Future(by)) => stamp.t.0 += by,
                    Some(Lie::Doubled) | None => {}
                }
                let mut seen = vec![clock.judge(stamp, now)];
                if matches!(lie, Some(Lie::Doubled)) {
                    seen.push(clock.judge(stamp, TimeNs(now.0 + 10_000)));
                    prop_assert_eq!(seen[1], None);
                }
                for refresh in seen.into_iter().flatten() {
                    if refresh.timestamp_source == TimestampSource::Hardware {
                        prop_assert_eq!(refresh.t_present, honest.t);
                        prop_assert_eq!(refresh.refresh_count.map(|count| count as u32), Some(honest.sequence));
                        prop_assert!(refresh.t_present > t_last && refresh.refresh_count > Some(count_last));
                        (t_last, count_last) = (refresh.t_present, refresh.refresh_count.unwrap());
                    }
                }
            }
        }

        #[test]
        fn no_event_whatever_makes_it_panic(
            events in proptest::collection::vec((any::<u32>(), -1i64..i64::MAX / 4, 0i64..i64::MAX / 4), 0..50),
        ) {
            let mut clock = clock();
            for (sequence, t, now) in events {
                clock.judge(FlipStamp { sequence, t: TimeNs(t) }, TimeNs(now));
            }
        }
    }
}
