//! Whether a panel's reports of its refreshes can be believed.

use std::ops::RangeInclusive;

use holod_calibration::TimeNs;
use holod_calibration::rig::RATE_TOLERANCE;

use super::gate::WindowClock;
use crate::laser::DarkReason;
use crate::present::PresentedRefresh;

/// Reports in a row that must agree with a rhythm that was believed before one is believed again.
const AGREEING_MIN: u32 = 2;
/// The same where a rhythm begins by which light is timed. Of reports that scatter by many times the tolerance two or
/// three agree by chance, again and again in an hour; nine do not.
const AGREEING_AT_FIRST: u32 = 8;
/// Reports in a row that contradict the panel's clock, after which the clock is taken from the newest.
const STRAYS_MAX: u32 = 2;
/// Share of a believed report's error that moves the phase of the rhythm: one that is a little off must not make the
/// next one, which is a little more off, look right.
const PHASE_GAIN: f64 = 0.2;
/// Share of an interval's error that moves the period.
const PERIOD_GAIN: f64 = 0.02;
/// Share of a new interval's error in their average.
const BIAS_GAIN: f64 = 0.05;
/// Share of a new interval in the rate that is shown to people.
const RATE_GAIN: f64 = 0.05;
/// Intervals in a row of as many periods each, of which the panel itself makes one: reports are missed at random.
const SLOWER_IN_A_ROW: u32 = 30;

/// Compares each report with the ones before it.
///
/// A panel refreshes in a steady rhythm. A report is believed when it lies on that rhythm, as the ones that were
/// believed before made it, to within a tolerance, when the display controller's own count, where there is one, has
/// gone on by that number, when the field that it carries can follow, and when [`AGREEING_AT_FIRST`] reports in a row
/// have done so, or [`AGREEING_MIN`] once a rhythm was believed. A report that is early, doubled, of no time, or of a
/// time that runs back, is not; nor are those right after it.
#[derive(Clone, Debug)]
pub(super) struct RefreshJudge {
    nominal_ns: f64,
    tolerance_ns: f64,
    clock: WindowClock,
    period_ns: f64,
    bias_ns: f64,
    refreshes_per_frame: usize,
    anchor: Option<Anchor>,
    agreeing: u32,
    /// How many in a row are asked for now.
    needed: u32,
    strays: u32,
    t_before: Option<TimeNs>,
    /// The controller's count of the newest report.
    count_before: Option<u64>,
    shown_period_ns: Option<f64>,
    alike: Alike,
    /// The panel was found to run at a part of its rate.
    runs_slower: bool,
}

/// The last intervals between reports that had as many periods of the rate that is shown as each other.
#[derive(Clone, Copy, Debug, Default)]
struct Alike {
    periods: f64,
    in_a_row: u32,
}

/// The newest report that fits, at the time that the rhythm gives it.
#[derive(Clone, Copy, Debug)]
struct Anchor {
    t: TimeNs,
    refresh_count: Option<u64>,
    field: usize,
}

impl Anchor {
    fn of(refresh: &PresentedRefresh, t: TimeNs) -> Self {
        Self { t, refresh_count: refresh.refresh_count, field: refresh.field }
    }
}

impl RefreshJudge {
    /// A judge that has seen nothing; `tolerance` is how far a report may lie off the panel's rhythm, `clock` whether
    /// light is timed by the reports.
    pub(super) fn new(
        refresh_period: TimeNs,
        tolerance: TimeNs,
        refreshes_per_frame: usize,
        clock: WindowClock,
    ) -> Self {
        let nominal_ns = refresh_period.0 as f64;
        Self {
            nominal_ns,
            tolerance_ns: tolerance.0 as f64,
            clock,
            period_ns: nominal_ns,
            bias_ns: 0.0,
            refreshes_per_frame,
            anchor: None,
            agreeing: 0,
            needed: agreeing_at_first(clock),
            strays: 0,
            t_before: None,
            count_before: None,
            shown_period_ns: None,
            alike: Alike::default(),
            runs_slower: false,
        }
    }

    /// Refreshes a second, as they are reported; 0 until two have come.
    pub(super) fn refresh_hz(&self) -> f64 {
        self.shown_period_ns.map_or(0.0, |period_ns| 1e9 / period_ns)
    }

    /// The panel was lost: its rhythm begins anew.
    pub(super) fn forget(&mut self) {
        let (period, tolerance) = (TimeNs(self.nominal_ns as i64), TimeNs(self.tolerance_ns as i64));
        *self = Self::new(period, tolerance, self.refreshes_per_frame, self.clock);
    }

    /// Takes in a report.
    ///
    /// # Errors
    /// [`DarkReason::Untrusted`] where it is not believed.
    pub(super) fn judge(&mut self, refresh: &PresentedRefresh) -> Result<(), DarkReason> {
        let t_before = self.t_before.unwrap_or(TimeNs(0));
        self.note_rate(refresh);
        if refresh.t_present <= TimeNs(0) {
            self.agreeing = 0;
            return Err(DarkReason::Untrusted);
        }
        let Some(anchor) = self.anchor else {
            self.anchor = Some(Anchor::of(refresh, refresh.t_present));
            return Err(DarkReason::Untrusted);
        };
        let since_ns = (refresh.t_present.0 - anchor.t.0) as f64;
        let periods = (since_ns / self.period_ns).round();
        let error_ns = since_ns - periods * self.period_ns;
        // What comes after a report of a later time tells nothing of what followed that later time, believed or not.
        let in_order = refresh.t_present > t_before;
        let on_time = in_order && periods >= 1.0 && error_ns.abs() <= self.tolerance_ns;
        if !on_time || !counts_agree(&anchor, refresh, periods) || !self.fields_agree(&anchor, refresh, periods) {
            self.agreeing = 0;
            self.strays += 1;
            if self.strays >= STRAYS_MAX {
                self.strays = 0;
                self.needed = agreeing_at_first(self.clock);
                self.anchor = Some(Anchor::of(refresh, refresh.t_present));
                if in_order && self.clock == WindowClock::Reports {
                    self.begin_at_period((refresh.t_present - t_before).0 as f64);
                }
            }
            return Err(DarkReason::Untrusted);
        }
        self.strays = 0;
        let (phase_gain, period_gain) = self.gains();
        let t_rhythm = TimeNs(refresh.t_present.0 - ((1.0 - phase_gain) * error_ns) as i64);
        self.anchor = Some(Anchor::of(refresh, t_rhythm));
        let limits_ns = self.period_limits_ns();
        self.period_ns =
            (self.period_ns + period_gain * error_ns / periods).clamp(*limits_ns.start(), *limits_ns.end());
        self.bias_ns += BIAS_GAIN * (error_ns / periods - self.bias_ns);
        self.agreeing = self.agreeing.saturating_add(1);
        let steady = self.bias_ns.abs() <= RATE_TOLERANCE * self.nominal_ns;
        if self.agreeing < self.needed || !steady {
            return Err(DarkReason::Untrusted);
        }
        self.needed = AGREEING_MIN;
        Ok(())
    }

    /// Shares of a report's error that move phase and period. Where a rhythm begins they are those of the α-β filter of
    /// growing memory, which makes of n reports, those since the last one that did not agree and the two that made the
    /// clock, their line of least squares: α = 2(2n − 1)/(n(n + 1)) and β = 6/(n(n + 1)).
    fn gains(&self) -> (f64, f64) {
        if self.needed == AGREEING_MIN {
            return (PHASE_GAIN, PERIOD_GAIN);
        }
        let n = f64::from(self.agreeing + 3);
        (2.0 * (2.0 * n - 1.0) / (n * (n + 1.0)), 6.0 / (n * (n + 1.0)))
    }

    /// The clock begins anew with two reports so far apart: where a panel is farther off its nominal rate than the
    /// tolerance of one report, it could be learned from none that is believed.
    fn begin_at_period(&mut self, interval_ns: f64) {
        let period_ns = interval_ns / (interval_ns / self.nominal_ns).round().max(1.0);
        if self.period_limits_ns().contains(&period_ns) {
            self.period_ns = period_ns;
        }
    }

    fn period_limits_ns(&self) -> RangeInclusive<f64> {
        (1.0 - RATE_TOLERANCE) * self.nominal_ns..=(1.0 + RATE_TOLERANCE) * self.nominal_ns
    }

    /// The panel goes on by at least one refresh of a colour frame, and by no more than the time allows; a doubled
    /// report a whole period late is told by that.
    fn fields_agree(&self, anchor: &Anchor, refresh: &PresentedRefresh, periods: f64) -> bool {
        let count = self.refreshes_per_frame;
        if count == 1 || periods >= count as f64 {
            return true;
        }
        let steps = (refresh.field + count - anchor.field % count) % count;
        steps >= 1 && steps as f64 <= periods
    }

    fn note_rate(&mut self, refresh: &PresentedRefresh) {
        let t = refresh.t_present;
        let count_before = std::mem::replace(&mut self.count_before, refresh.refresh_count);
        let Some(t_before) = self.t_before.replace(t) else { return };
        let interval_ns = (t.0 - t_before.0) as f64;
        let counted = count_before.zip(refresh.refresh_count).and_then(|(before, now)| now.checked_sub(before));
        let period_ns = match counted.filter(|&refreshes| refreshes > 0) {
            Some(refreshes) => interval_ns / refreshes as f64,
            None => self.uncounted_period_ns(interval_ns),
        };
        if period_ns > 0.1 * self.nominal_ns && period_ns < 10.0 * self.nominal_ns {
            let shown_ns = self.shown_period_ns.get_or_insert(period_ns);
            *shown_ns += RATE_GAIN * (period_ns - *shown_ns);
        }
    }

    /// The period of a panel that nobody counts the refreshes of, from an interval in which reports may be missing.
    fn uncounted_period_ns(&mut self, interval_ns: f64) -> f64 {
        if self.runs_slower && interval_ns < 1.5 * self.nominal_ns {
            (self.runs_slower, self.shown_period_ns) = (false, None);
        }
        let periods = (interval_ns / self.shown_period_ns.unwrap_or(self.nominal_ns)).round().max(1.0);
        let in_a_row = if periods == self.alike.periods { self.alike.in_a_row + 1 } else { 1 };
        self.alike = Alike { periods, in_a_row };
        if periods > 1.0 && in_a_row >= SLOWER_IN_A_ROW {
            (self.runs_slower, self.shown_period_ns) = (true, None);
            return interval_ns;
        }
        interval_ns / periods
    }
}

/// Where the panel itself times the light, its reports only say that it runs.
const fn agreeing_at_first(clock: WindowClock) -> u32 {
    match clock {
        WindowClock::Reports => AGREEING_AT_FIRST,
        WindowClock::Panel => AGREEING_MIN,
    }
}

fn counts_agree(anchor: &Anchor, refresh: &PresentedRefresh, periods: f64) -> bool {
    match (anchor.refresh_count, refresh.refresh_count) {
        (Some(before), Some(after)) => after.checked_sub(before).is_some_and(|count| count as f64 == periods),
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::present::TimestampSource;

    const PERIOD: i64 = 16_666_667;

    fn report(t: i64, refresh_count: Option<u64>) -> PresentedRefresh {
        PresentedRefresh {
            frame: None,
            field: 0,
            repeated: false,
            t_present: TimeNs(t),
            timestamp_source: TimestampSource::Hardware,
            refresh_count,
        }
    }

    fn judge() -> RefreshJudge {
        RefreshJudge::new(TimeNs(PERIOD), TimeNs(100_000), 1, WindowClock::Reports)
    }

    /// Which of the reports at these times are believed.
    fn believed(times: &[i64]) -> Vec<bool> {
        let mut judge = judge();
        times.iter().map(|&t| judge.judge(&report(t, None)).is_ok()).collect()
    }

    #[test]
    fn a_steady_panel_is_believed_from_its_ninth_report_on() {
        let times: Vec<_> = (1..12).map(|count| count * PERIOD).collect();
        assert_eq!(believed(&times), [[false; 8].as_slice(), &[true; 3]].concat());
        // A panel of 59.94 Hz is one of 60 Hz, one of 50 Hz is not.
        let ntsc: Vec<_> = (1..100).map(|count| count * 16_683_350).collect();
        assert!(believed(&ntsc)[8..].iter().all(|&believed| believed));
        let pal: Vec<_> = (1..100).map(|count| count * 20_000_000).collect();
        assert!(believed(&pal).iter().all(|&believed| !believed));
        // Nor is one of 57 Hz, even where single times are only known to a millisecond.
        let mut judge = RefreshJudge::new(TimeNs(PERIOD), TimeNs(PERIOD / 16), 1, WindowClock::Panel);
        let slow = (1..100).map(|count| judge.judge(&report(count * 17_543_860, None)).is_ok());
        assert!(slow.skip(3).all(|believed| !believed));
    }

    /// With the tolerance that the default bench has, which is less than such panels are off in one refresh.
    #[test]
    fn a_panel_within_half_a_percent_of_its_rate_is_believed_whatever_the_tolerance() {
        let believed = |refresh_hz: f64, jitter_ns: i64| -> Vec<bool> {
            let mut judge = RefreshJudge::new(TimeNs(PERIOD), TimeNs(22_000), 1, WindowClock::Reports);
            let at =
                |count: i64| (count as f64 * 1e9 / refresh_hz) as i64 + [0, jitter_ns, -jitter_ns][count as usize % 3];
            (1..400).map(|count| judge.judge(&report(at(count), None)).is_ok()).collect()
        };
        for refresh_hz in [60.0, 59.94, 59.92, 59.9, 59.75, 60.06, 60.29] {
            for jitter_ns in [0, 4000] {
                let believed = believed(refresh_hz, jitter_ns);
                let first = believed.iter().position(|&believed| believed).expect("some time");
                assert!(first < 14, "{refresh_hz} Hz: from report {first} on");
                assert!(believed[first..].iter().all(|&believed| believed), "{refresh_hz} Hz flickers");
            }
        }
        for refresh_hz in [59.5, 60.5, 50.0, 72.0] {
            assert!(!believed(refresh_hz, 0).contains(&true), "{refresh_hz} Hz is no 60 Hz");
        }
    }

    /// A judge that has believed a rhythm, whose newest report came at period 0 of field 0, and what it says of later
    /// ones.
    fn settled(tolerance_ns: i64, refreshes_per_frame: usize) -> impl FnMut(f64, Option<u64>, usize) -> bool {
        const BEGUN: i64 = 60;
        let mut judge =
            RefreshJudge::new(TimeNs(PERIOD), TimeNs(tolerance_ns), refreshes_per_frame, WindowClock::Reports);
        for count in BEGUN / 2..=BEGUN {
            let field = count as usize % refreshes_per_frame;
            let _believed = judge.judge(&PresentedRefresh { field, ..report(count * PERIOD, Some(count as u64)) });
        }
        assert_eq!(judge.agreeing, BEGUN as u32 / 2);
        move |periods, refresh_count, field| {
            let t_present = if periods.is_nan() { 0 } else { ((BEGUN as f64 + periods) * PERIOD as f64) as i64 };
            let refresh_count = refresh_count.map(|count| BEGUN as u64 + count);
            judge.judge(&PresentedRefresh { field, ..report(t_present, refresh_count) }).is_ok()
        }
    }

    #[test]
    fn reports_that_contradict_the_rhythm_are_not_believed() {
        let after = |periods: &[f64]| -> Vec<bool> {
            let mut at = settled(100_000, 1);
            periods.iter().map(|&periods| at(periods, None, 0)).collect()
        };
        // A doubled report, an early one, one of no time, one from the past; each spoils the next one, too.
        for (wrong, name) in [(0.25, "doubled"), (0.75, "early"), (f64::NAN, "no time"), (-3.0, "past")] {
            assert_eq!(after(&[wrong, 1.0, 2.0, 3.0]), [false, false, true, true], "{name}");
        }
        // A missing report is no contradiction.
        assert_eq!(after(&[2.0, 3.0]), [true; 2]);
        // A rhythm that has really moved is found again.
        let moved: Vec<_> = (0..12).map(|count| 1.4 + f64::from(count)).collect();
        assert_eq!(after(&moved), [[false; 9].as_slice(), &[true; 3]].concat());
    }

    /// Where each report is off by itself, some agree with their neighbours by chance.
    #[test]
    fn reports_that_scatter_by_more_than_the_tolerance_are_never_believed() {
        const TOLERANCE_NS: i64 = 22_000;
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / (1u64 << 30) as f64 - 1.0
        };
        let mut believed = |scatter_ns: f64, count: i64| {
            let mut judge = RefreshJudge::new(TimeNs(PERIOD), TimeNs(TOLERANCE_NS), 1, WindowClock::Reports);
            let report = |count| report(count * PERIOD + (scatter_ns * random()) as i64, None);
            (1..count).map(report).filter(|report| judge.judge(report).is_ok()).count()
        };
        for scatter_ns in [1e5, 1.5e5, 2e5, 3e5, 5e5, 1e6] {
            assert_eq!(believed(scatter_ns, 200_000), 0, "{scatter_ns} ns");
        }
        assert!(believed(6e3, 10_000) > 9_900, "those that hardly do are believed");
    }

    #[test]
    fn the_controllers_count_must_go_on_with_time() {
        let mut at = settled(100_000, 1);
        assert_eq!([at(1.0, Some(1), 0), at(3.0, Some(3), 0)], [true, true]);
        assert_eq!(
            [at(4.0, Some(5), 0), at(5.0, Some(5), 0), at(6.0, Some(6), 0)],
            [false, false, true],
            "a count that jumped"
        );
    }

    #[test]
    fn a_report_that_comes_again_a_whole_period_later_is_told_by_its_field() {
        let mut at = settled(100_000, 3);
        assert!(at(1.0, None, 1));
        assert!(!at(2.0, None, 1), "the same field again");
        assert_eq!(
            [at(3.0, None, 0), at(4.0, None, 1)],
            [false, true],
            "and the next ones go on from the last that was believed"
        );
        assert!(at(6.0, None, 2), "a refresh was dropped");
        assert!(!at(7.0, None, 1), "two fields on in one period");
    }

    #[test]
    fn a_report_that_was_overtaken_by_a_later_one_proves_nothing() {
        let mut at = settled(130_000, 3);
        assert!(at(1.0, None, 1));
        // Field 0 is reported early, then a late report of field 2 comes, then field 0 again when field 1 is shown.
        assert!(!at(2.8, None, 0) && !at(2.0, None, 2));
        assert!(!at(3.995, None, 0), "it would be the second in a row that agrees");
    }

    #[test]
    fn the_rate_is_told_as_it_is() {
        let mut judge = judge();
        assert_eq!(judge.refresh_hz(), 0.0);
        for count in 1..200 {
            let _believed = judge.judge(&report(count * 20_000_000, None));
        }
        assert!((judge.refresh_hz() - 50.0).abs() < 1e-6);
    }

    #[test]
    fn a_panel_at_a_part_of_its_rate_is_told_from_one_whose_reports_are_missed() {
        let told_hz = |every: &dyn Fn(i64) -> bool, counted: bool| {
            let mut judge = judge();
            for count in (1..400).filter(|&count| every(count)) {
                let _believed = judge.judge(&report(count * PERIOD, counted.then_some(count as u64)));
            }
            judge.refresh_hz()
        };
        let refresh_hz = |every: &dyn Fn(i64) -> bool| told_hz(every, false);
        assert!((refresh_hz(&|count| count % 2 == 0) - 30.0).abs() < 1e-3);
        assert!((refresh_hz(&|count| count % 3 == 0) - 20.0).abs() < 1e-3);
        // Of each nine in a row three are missed, so that whole runs of intervals have two periods.
        assert!((refresh_hz(&|count| ![1, 3, 5].contains(&(count % 9))) - 60.0).abs() < 1e-3);
        // At its own rate again, also where reports are missed then.
        assert!(refresh_hz(&|count| count > 100 || count % 2 == 0) > 59.9);
        assert!(refresh_hz(&|count| (count > 100 && count % 3 > 0) || count % 2 == 0) > 59.9);
        // Where they are counted it is known how many were missed.
        assert!((told_hz(&|count| count % 2 == 0, true) - 60.0).abs() < 1e-3);
    }
}
