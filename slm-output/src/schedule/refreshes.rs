//! Whether a panel's reports of its refreshes can be believed.

use holod_calibration::TimeNs;

use crate::laser::DarkReason;
use crate::present::PresentedRefresh;

/// Reports in a row that must agree before any is believed.
const AGREEING_MIN: u32 = 2;
/// Reports in a row that contradict the panel's clock, after which the clock is taken from the newest.
const STRAYS_MAX: u32 = 2;
/// Share of a believed report's error that moves the phase of the rhythm: one that is a little off must not make the
/// next one, which is a little more off, look right.
const PHASE_GAIN: f64 = 0.2;
/// Share of an interval's error that moves the period.
const PERIOD_GAIN: f64 = 0.02;
/// A panel's period may be learned to differ from the nominal one by this share, and the intervals may on average lie
/// off the learned one by as much: beyond, the fields are not as long as the rig says, and nothing is believed.
pub(super) const PERIOD_TOLERANCE: f64 = 0.005;
/// Share of a new interval's error in their average.
const BIAS_GAIN: f64 = 0.05;
/// Share of a new interval in the rate that is shown to people.
const RATE_GAIN: f64 = 0.05;

/// Compares each report with the ones before it.
///
/// A panel refreshes in a steady rhythm. A report is believed when it lies on that rhythm, as the ones that were
/// believed before made it, to within a tolerance, when the display controller's own count, where there is one, has
/// gone on by that number, when the field that it carries can follow, and when [`AGREEING_MIN`] reports in a row have
/// done so. A report that is early, doubled, of no time, or of a time that runs back, is not; nor are those right after
/// it.
#[derive(Clone, Debug)]
pub(super) struct RefreshJudge {
    nominal_ns: f64,
    tolerance_ns: f64,
    period_ns: f64,
    bias_ns: f64,
    refreshes_per_frame: usize,
    anchor: Option<Anchor>,
    agreeing: u32,
    strays: u32,
    t_before: Option<TimeNs>,
    shown_period_ns: Option<f64>,
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
    /// A judge that has seen nothing; `tolerance` is how far a report may lie off the panel's rhythm.
    pub(super) fn new(refresh_period: TimeNs, tolerance: TimeNs, refreshes_per_frame: usize) -> Self {
        let nominal_ns = refresh_period.0 as f64;
        Self {
            nominal_ns,
            tolerance_ns: tolerance.0 as f64,
            period_ns: nominal_ns,
            bias_ns: 0.0,
            refreshes_per_frame,
            anchor: None,
            agreeing: 0,
            strays: 0,
            t_before: None,
            shown_period_ns: None,
        }
    }

    /// Refreshes a second, as they are reported; 0 until two have come.
    pub(super) fn refresh_hz(&self) -> f64 {
        self.shown_period_ns.map_or(0.0, |period_ns| 1e9 / period_ns)
    }

    /// The panel was lost: its rhythm begins anew.
    pub(super) fn forget(&mut self) {
        let (period, tolerance) = (TimeNs(self.nominal_ns as i64), TimeNs(self.tolerance_ns as i64));
        *self = Self::new(period, tolerance, self.refreshes_per_frame);
    }

    /// Takes in a report.
    ///
    /// # Errors
    /// [`DarkReason::Untrusted`] where it is not believed.
    pub(super) fn judge(&mut self, refresh: &PresentedRefresh) -> Result<(), DarkReason> {
        let t_before = self.t_before.unwrap_or(TimeNs(0));
        self.note_rate(refresh.t_present);
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
                self.anchor = Some(Anchor::of(refresh, refresh.t_present));
            }
            return Err(DarkReason::Untrusted);
        }
        self.strays = 0;
        let t_rhythm = TimeNs(refresh.t_present.0 - ((1.0 - PHASE_GAIN) * error_ns) as i64);
        self.anchor = Some(Anchor::of(refresh, t_rhythm));
        let limits_ns = (1.0 - PERIOD_TOLERANCE) * self.nominal_ns..=(1.0 + PERIOD_TOLERANCE) * self.nominal_ns;
        self.period_ns =
            (self.period_ns + PERIOD_GAIN * error_ns / periods).clamp(*limits_ns.start(), *limits_ns.end());
        self.bias_ns += BIAS_GAIN * (error_ns / periods - self.bias_ns);
        self.agreeing = self.agreeing.saturating_add(1);
        let steady = self.bias_ns.abs() <= PERIOD_TOLERANCE * self.nominal_ns;
        if self.agreeing < AGREEING_MIN || !steady { Err(DarkReason::Untrusted) } else { Ok(()) }
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

    fn note_rate(&mut self, t: TimeNs) {
        if let Some(t_before) = self.t_before.replace(t) {
            let interval_ns = (t.0 - t_before.0) as f64;
            let periods = (interval_ns / self.shown_period_ns.unwrap_or(self.nominal_ns)).round().max(1.0);
            let period_ns = interval_ns / periods;
            if period_ns > 0.1 * self.nominal_ns && period_ns < 10.0 * self.nominal_ns {
                let shown_ns = self.shown_period_ns.get_or_insert(period_ns);
                *shown_ns += RATE_GAIN * (period_ns - *shown_ns);
            }
        }
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
            provenance: TimestampSource::Hardware,
            refresh_count,
        }
    }

    fn judge() -> RefreshJudge {
        RefreshJudge::new(TimeNs(PERIOD), TimeNs(100_000), 1)
    }

    /// Which of the reports at these times are believed.
    fn believed(times: &[i64]) -> Vec<bool> {
        let mut judge = judge();
        times.iter().map(|&t| judge.judge(&report(t, None)).is_ok()).collect()
    }

    #[test]
    fn a_steady_panel_is_believed_from_its_third_report_on() {
        let times: Vec<_> = (1..6).map(|count| count * PERIOD).collect();
        assert_eq!(believed(&times), [false, false, true, true, true]);
        // A panel of 59.94 Hz is one of 60 Hz, one of 50 Hz is not.
        let ntsc: Vec<_> = (1..100).map(|count| count * 16_683_350).collect();
        assert!(believed(&ntsc)[2..].iter().all(|&believed| believed));
        let pal: Vec<_> = (1..100).map(|count| count * 20_000_000).collect();
        assert!(believed(&pal).iter().all(|&believed| !believed));
        // Nor is one of 57 Hz, even where single times are only known to a millisecond.
        let mut judge = RefreshJudge::new(TimeNs(PERIOD), TimeNs(PERIOD / 16), 1);
        let slow = (1..100).map(|count| judge.judge(&report(count * 17_543_860, None)).is_ok());
        assert!(slow.skip(3).all(|believed| !believed));
    }

    #[test]
    fn reports_that_contradict_the_rhythm_are_not_believed() {
        let at = |periods: f64| (periods * PERIOD as f64) as i64;
        // A doubled report, an early one, one of no time, one from the past; each spoils the next one, too.
        for (wrong, name) in [(at(5.25), "doubled"), (at(5.75), "early"), (0, "no time"), (at(2.0), "past")] {
            let times: Vec<_> = (1..=5).map(|count| at(f64::from(count))).collect();
            let times = [times, vec![wrong, at(6.0), at(7.0), at(8.0)]].concat();
            assert_eq!(believed(&times)[4..], [true, false, false, true, true], "{name}");
        }
        // A missing report is no contradiction.
        assert_eq!(believed(&[at(1.0), at(2.0), at(3.0), at(5.0), at(6.0)])[2..], [true; 3]);
        // A rhythm that has really moved is found again.
        let moved: Vec<_> = (1..=5).map(f64::from).chain((0..5).map(|count| 6.4 + f64::from(count))).map(at).collect();
        assert_eq!(believed(&moved)[5..], [false, false, false, true, true]);
    }

    #[test]
    fn the_controllers_count_must_go_on_with_time() {
        let mut judge = judge();
        let mut at = |periods: i64, count: u64| judge.judge(&report(periods * PERIOD, Some(count))).is_ok();
        assert_eq!([at(1, 7), at(2, 8), at(3, 9), at(5, 11)], [false, false, true, true]);
        assert_eq!([at(6, 13), at(7, 13), at(8, 14)], [false, false, true], "a count that jumped");
    }

    #[test]
    fn a_report_that_comes_again_a_whole_period_later_is_told_by_its_field() {
        let mut judge = RefreshJudge::new(TimeNs(PERIOD), TimeNs(100_000), 3);
        let mut at = |periods: i64, field: usize| {
            judge.judge(&PresentedRefresh { field, ..report(periods * PERIOD, None) }).is_ok()
        };
        assert_eq!([at(1, 0), at(2, 1), at(3, 2), at(4, 0)], [false, false, true, true]);
        assert!(!at(5, 0), "the same field again");
        assert_eq!([at(6, 2), at(7, 0)], [false, true], "and the next ones go on from the last that was believed");
        assert!(at(9, 1), "a refresh was dropped");
        assert!(!at(10, 0), "two fields on in one period");
    }

    #[test]
    fn a_report_that_was_overtaken_by_a_later_one_proves_nothing() {
        let mut judge = RefreshJudge::new(TimeNs(PERIOD), TimeNs(130_000), 3);
        let mut at = |periods: f64, field: usize| {
            let t_present = (periods * PERIOD as f64) as i64;
            judge.judge(&PresentedRefresh { field, ..report(t_present, None) }).is_ok()
        };
        // Field 2 is reported early, then a late report of field 1 comes, then field 2 again when field 0 is shown.
        assert_eq!([at(1.0, 0), at(2.8, 2), at(2.0, 1)], [false; 3]);
        assert!(!at(3.995, 2), "it would be the second in a row that agrees");
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
}
