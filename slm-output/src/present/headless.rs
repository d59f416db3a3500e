//! A virtual panel: a refresh clock, no glass.

use holod_calibration::TimeNs;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::{FrameSource, PanelFault, PanelSetup, PanelTiming, PresentedRefresh, Presenter, TimestampSource};
use crate::fields::{FrameTag, LevelsFrame};

/// Colour frames that a late tick reports after the fact, of the first and of the last ones that went by.
const CATCH_UP_FRAMES: i64 = 8;

/// What a virtual panel does wrong on purpose, so that a bench can be tried out without one. Shares are of all
/// refreshes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReportFaults {
    /// Its true refresh rate, where that is not the rig's.
    pub refresh_hz: Option<f64>,
    /// Reported times are off by up to this, either way.
    pub jitter: TimeNs,
    /// Share of refreshes that are reported one refresh after they were shown, with the right time.
    pub late: f64,
    /// Share of refreshes whose reported time is a quarter of a refresh before the true one.
    pub early: f64,
    /// Share of refreshes that are reported a second time, a quarter of a refresh later.
    pub doubled: f64,
    /// Share of refreshes at which the panel goes on with the old picture, and which nobody reports.
    pub dropped: f64,
    /// The panel is unplugged this long after the start, and for how long.
    pub unplug: Option<(TimeNs, TimeNs)>,
    /// Seed of all of this.
    pub seed: u64,
}

impl ReportFaults {
    /// A panel that does everything right.
    pub const NONE: Self = Self {
        refresh_hz: None,
        jitter: TimeNs(0),
        late: 0.0,
        early: 0.0,
        doubled: 0.0,
        dropped: 0.0,
        unplug: None,
        seed: 0,
    };
}

/// A panel that shows, refresh after refresh, what a panel in its place would show.
///
/// A pure state machine: time comes in through [`Presenter::tick`], so tests drive it with any clock. A tick that comes
/// late reports the refreshes that have gone by with the times at which they began, since nothing stops a panel from
/// going on with the pattern that it has (after a long stall, only the first and the last eight colour frames of it);
/// a frame is never shown at a refresh before which it was not yet submitted.
#[derive(Debug)]
pub struct HeadlessPanel {
    refresh_period: TimeNs,
    refreshes_per_frame: usize,
    fields_per_refresh: usize,
    t_next: TimeNs,
    /// Position of the next refresh in its colour frame.
    next_refresh: usize,
    refresh_count: u64,
    /// The levels on the panel, and the frame that they are; `None` while they are the flat pattern.
    shown: LevelsFrame,
    frame: Option<FrameTag>,
    repeated: bool,
    flat: LevelsFrame,
    flat_wanted: bool,
    /// The source's current frame waits for the refresh after its submission.
    waiting: bool,
    faults: ReportFaults,
    dice: Pcg32,
    t_unplug: Option<TimeNs>,
    unplugged_for: TimeNs,
    lost: bool,
    withheld: Option<PresentedRefresh>,
}

impl HeadlessPanel {
    /// A panel that begins its first colour frame one colour frame after `now`.
    pub fn new(setup: &PanelSetup, now: TimeNs, faults: ReportFaults) -> Self {
        let timing = PanelTiming::new(&setup.panel);
        let layout = setup.flat.layout();
        let refresh_period = match faults.refresh_hz {
            Some(refresh_hz) => TimeNs::from_seconds(1.0 / refresh_hz),
            None => timing.refresh_period,
        };
        Self {
            refresh_period,
            refreshes_per_frame: layout.refreshes(),
            fields_per_refresh: layout.fields_per_refresh(),
            t_next: now + timing.frame_period,
            next_refresh: 0,
            refresh_count: 0,
            shown: setup.flat.clone(),
            frame: None,
            repeated: false,
            flat: setup.flat.clone(),
            flat_wanted: false,
            waiting: false,
            faults,
            dice: Pcg32::seed_from_u64(faults.seed),
            t_unplug: faults.unplug.map(|(after, _)| now + after),
            unplugged_for: faults.unplug.map_or(TimeNs(0), |(_, length)| length),
            lost: false,
            withheld: None,
        }
    }

    /// At a colour frame's start, puts what is newest on the panel.
    fn latch(&mut self, t_refresh: TimeNs, frames: &mut FrameSource) {
        if self.flat_wanted {
            if self.frame.take().is_some() {
                self.shown.copy_from(&self.flat);
            }
            return;
        }
        self.repeated = self.frame.is_some();
        self.waiting |= frames.update();
        if !self.waiting || frames.current_mut().tag().t_submit > t_refresh {
            return;
        }
        std::mem::swap(&mut self.shown, frames.current_mut());
        self.waiting = false;
        self.repeated = false;
        self.frame = Some(self.shown.tag());
    }

    /// Leaves out whole colour frames that went by too long ago for anybody to want to know.
    fn skip_unseen(&mut self, now: TimeNs) {
        let frame_period_ns = self.refresh_period.0 * self.refreshes_per_frame as i64;
        let behind = (now.0 - self.t_next.0) / frame_period_ns;
        let skipped = (behind - CATCH_UP_FRAMES).max(0);
        self.t_next = TimeNs(self.t_next.0 + skipped * frame_period_ns);
        self.refresh_count += skipped as u64 * self.refreshes_per_frame as u64;
    }

    fn happens(&mut self, share: f64) -> bool {
        share > 0.0 && self.dice.random_bool(share)
    }

    /// Reports a refresh, as truthfully as the faults allow.
    fn report(&mut self, refresh: PresentedRefresh, presented: &mut dyn FnMut(PresentedRefresh)) {
        if let Some(withheld) = self.withheld.take() {
            presented(withheld);
        }
        let quarter = TimeNs(self.refresh_period.0 / 4);
        let mut told = refresh;
        if self.faults.jitter > TimeNs(0) {
            let off_ns = self.dice.random_range(-self.faults.jitter.0..=self.faults.jitter.0);
            told.t_present = refresh.t_present + TimeNs(off_ns);
        }
        if self.happens(self.faults.early) {
            told.t_present = refresh.t_present - quarter;
        }
        if self.happens(self.faults.late) {
            self.withheld = Some(told);
            return;
        }
        presented(told);
        if self.happens(self.faults.doubled) {
            presented(PresentedRefresh { t_present: told.t_present + quarter, ..told });
        }
    }
}

impl Presenter for HeadlessPanel {
    fn is_virtual(&self) -> bool {
        true
    }

    fn t_next(&self) -> TimeNs {
        self.t_next
    }

    fn tick(
        &mut self,
        now: TimeNs,
        frames: &mut FrameSource,
        presented: &mut dyn FnMut(PresentedRefresh),
    ) -> Result<(), PanelFault> {
        let mut frames_begun = 0;
        while self.t_next <= now {
            if self.lost || self.t_unplug.is_some_and(|t_unplug| self.t_next >= t_unplug) {
                self.lost = true;
                self.withheld = None;
                return Err(PanelFault::Unplugged);
            }
            if self.next_refresh == 0 {
                frames_begun += 1;
                if frames_begun == CATCH_UP_FRAMES {
                    self.skip_unseen(now);
                }
            }
            let dropped = self.happens(self.faults.dropped);
            if !dropped {
                if self.next_refresh == 0 {
                    self.latch(self.t_next, frames);
                }
                let refresh = PresentedRefresh {
                    frame: self.frame,
                    field: self.next_refresh * self.fields_per_refresh,
                    repeated: self.repeated && self.frame.is_some(),
                    t_present: self.t_next,
                    timestamp_source: TimestampSource::Software,
                    refresh_count: Some(self.refresh_count),
                };
                self.report(refresh, presented);
                self.next_refresh = (self.next_refresh + 1) % self.refreshes_per_frame;
            }
            self.refresh_count += 1;
            self.t_next = self.t_next + self.refresh_period;
        }
        Ok(())
    }

    fn show_flat(&mut self) {
        self.flat_wanted = true;
    }

    fn recover(&mut self, now: TimeNs) -> Result<(), PanelFault> {
        if self.t_unplug.is_some_and(|t_unplug| now < t_unplug + self.unplugged_for) {
            return Err(PanelFault::Unplugged);
        }
        self.t_unplug = None;
        self.lost = false;
        // Whatever was on the panel is gone, and it begins its refreshes anew.
        self.frame = None;
        self.shown.copy_from(&self.flat);
        self.next_refresh = 0;
        self.t_next = self.t_next.max(now + self.refresh_period);
        Ok(())
    }

    fn shown(&self) -> Option<&LevelsFrame> {
        self.frame.map(|_| &self.shown)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::FrameLayout;
    use crate::present::{FrameSink, frame_channel};
    use holod_calibration::rig::{Panel, PanelMode, Rig};
    use holod_calibration::{Colour, Resolution};

    /// The rig's 60 Hz.
    const FRAME: i64 = 16_666_668;

    struct Bench {
        panel: HeadlessPanel,
        sink: FrameSink,
        source: FrameSource,
    }

    impl Bench {
        fn new() -> Self {
            Self::with(Rig::default().panel, ReportFaults::NONE)
        }

        /// The first colour frame begins at time 0.
        fn with(panel: Panel, faults: ReportFaults) -> Self {
            let layout = FrameLayout::new(&panel, Resolution { width: 2, height: 1 });
            let flat = LevelsFrame::new(layout);
            let (sink, source) = frame_channel(&flat);
            let t_start = TimeNs(0) - PanelTiming::new(&panel).frame_period;
            let setup = PanelSetup { panel, flat };
            Self { panel: HeadlessPanel::new(&setup, t_start, faults), sink, source }
        }

        fn submit(&mut self, frame_id: u64, t_submit: i64) {
            for colour in Colour::ALL {
                self.sink.acquire().field_mut(colour).write(&[frame_id as u16; 2]);
            }
            let t_submit = TimeNs(t_submit);
            self.sink.submit(FrameTag { frame_id, t_submit, t_desired_present: t_submit, keep: None });
        }

        fn tick(&mut self, now: i64) -> Vec<PresentedRefresh> {
            let mut refreshes = Vec::new();
            self.panel.tick(TimeNs(now), &mut self.source, &mut |refresh| refreshes.push(refresh)).unwrap();
            refreshes
        }

        /// (frame, time, repeated) of what comes on the panel up to `now`.
        fn shown(&mut self, now: i64) -> Vec<(Option<u64>, i64, bool)> {
            let row =
                |shown: &PresentedRefresh| (shown.frame.map(|tag| tag.frame_id), shown.t_present.0, shown.repeated);
            self.tick(now).iter().map(row).collect()
        }

        fn levels(&self) -> Option<u16> {
            self.panel.shown().map(|frame| frame.samples()[0])
        }
    }

    #[test]
    fn the_newest_frame_is_taken_and_the_old_one_stays_when_nothing_came() {
        let mut bench = Bench::new();
        assert_eq!(bench.shown(0), [(None, 0, false)]);
        assert_eq!(bench.levels(), None);
        bench.submit(1, 10);
        bench.submit(2, 20);
        assert_eq!(bench.shown(FRAME - 1), []);
        assert_eq!(bench.shown(FRAME), [(Some(2), FRAME, false)]);
        assert_eq!(bench.levels(), Some(2));
        assert_eq!(bench.shown(2 * FRAME), [(Some(2), 2 * FRAME, true)]);
        assert_eq!(bench.levels(), Some(2));
        bench.submit(3, 2 * FRAME + 1);
        assert_eq!(bench.shown(3 * FRAME), [(Some(3), 3 * FRAME, false)]);
        assert_eq!(bench.levels(), Some(3));
        assert_eq!(bench.panel.t_next(), TimeNs(4 * FRAME));
    }

    #[test]
    fn a_late_tick_shows_no_frame_before_it_was_submitted() {
        let mut bench = Bench::new();
        bench.submit(1, -5);
        bench.tick(0);
        bench.submit(2, FRAME + 400);
        assert_eq!(bench.shown(2 * FRAME), [(Some(1), FRAME, true), (Some(2), 2 * FRAME, false)]);
        assert_eq!(bench.levels(), Some(2));
    }

    #[test]
    fn frames_change_only_where_a_colour_frame_begins() {
        let panel = Panel { mode: PanelMode::FieldSequential, frames_per_colour: 2, ..Rig::default().panel };
        let mut bench = Bench::with(panel, ReportFaults::NONE);
        let refresh = bench.panel.refresh_period.0;
        bench.submit(1, -5);
        bench.tick(0);
        bench.submit(2, 10);
        let shown = bench.tick(6 * refresh);
        assert_eq!(shown.iter().map(|shown| shown.field).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 0]);
        let ids: Vec<_> = shown.iter().map(|shown| shown.frame.unwrap().frame_id).collect();
        assert_eq!(ids, [1, 1, 1, 1, 1, 2]);
    }

    #[test]
    fn a_long_stall_is_reported_for_its_two_ends() {
        let mut bench = Bench::new();
        bench.submit(1, -5);
        bench.tick(0);
        let shown = bench.tick(1_000_000 * FRAME);
        assert!(shown.len() <= 2 * CATCH_UP_FRAMES as usize + 2, "{}", shown.len());
        let seen = |t: i64| shown.iter().any(|shown| shown.t_present == TimeNs(t));
        assert!((1..CATCH_UP_FRAMES - 1).all(|frame| seen(frame * FRAME) && seen((1_000_000 - frame) * FRAME)));
        assert_eq!(shown.last().unwrap().t_present, TimeNs(1_000_000 * FRAME));
        assert_eq!(shown.last().unwrap().refresh_count, Some(1_000_000));
    }

    #[test]
    fn the_flat_pattern_comes_at_the_next_frame_and_stays() {
        let mut bench = Bench::new();
        bench.submit(1, -5);
        bench.tick(0);
        bench.panel.show_flat();
        bench.submit(2, 10);
        assert_eq!(bench.shown(FRAME), [(None, FRAME, false)]);
        assert_eq!(bench.shown(2 * FRAME), [(None, 2 * FRAME, false)]);
        assert_eq!(bench.panel.shown.samples(), [0; 6]);
        assert_eq!(bench.levels(), None);
    }

    #[test]
    fn faults_come_as_often_as_they_are_asked_for() {
        let faults = |faults: ReportFaults| {
            let mut bench = Bench::with(Rig::default().panel, faults);
            bench.submit(1, -5);
            (1..2000).flat_map(|frame| bench.tick(frame * FRAME)).collect::<Vec<_>>()
        };
        let off = |shown: &PresentedRefresh| {
            let nearest = (shown.t_present.0 + FRAME / 2).div_euclid(FRAME) * FRAME;
            shown.t_present.0 - nearest
        };
        let none = ReportFaults::NONE;
        assert!(faults(none).iter().all(|shown| off(shown) == 0));
        let jittered = faults(ReportFaults { jitter: TimeNs(1000), ..none });
        assert!(jittered.iter().all(|shown| off(shown).abs() <= 1000));
        assert!(jittered.iter().any(|shown| off(shown) > 900) && jittered.iter().any(|shown| off(shown) < -900));
        let early = faults(ReportFaults { early: 0.1, ..none });
        let count = early.iter().filter(|shown| off(shown) == -FRAME / 4).count();
        assert!((120..280).contains(&count), "{count}");
        let doubled = faults(ReportFaults { doubled: 0.1, ..none }).len();
        assert!((2120..2280).contains(&doubled), "{doubled}");
        let dropped = faults(ReportFaults { dropped: 0.1, ..none }).len();
        assert!((1720..1880).contains(&dropped), "{dropped}");
        let mut bench = Bench::with(Rig::default().panel, ReportFaults { late: 1.0, ..none });
        assert_eq!(bench.shown(0), []);
        assert_eq!(bench.shown(FRAME), [(None, 0, false)], "one refresh after it was shown");
    }

    #[test]
    fn an_unplugged_panel_says_so_and_comes_back_flat() {
        let unplug = Some((TimeNs(3 * FRAME), TimeNs(10 * FRAME)));
        let mut bench = Bench::with(Rig::default().panel, ReportFaults { unplug, ..ReportFaults::NONE });
        bench.submit(1, -5);
        bench.tick(FRAME);
        let fault = |bench: &mut Bench, now| bench.panel.tick(TimeNs(now), &mut bench.source, &mut |_| {});
        assert_eq!(fault(&mut bench, 2 * FRAME), Err(PanelFault::Unplugged));
        assert_eq!(fault(&mut bench, 3 * FRAME), Err(PanelFault::Unplugged));
        assert_eq!(bench.panel.recover(TimeNs(4 * FRAME)), Err(PanelFault::Unplugged));
        assert_eq!(bench.panel.recover(TimeNs(20 * FRAME)), Ok(()));
        bench.submit(2, 20 * FRAME);
        assert_eq!(bench.shown(21 * FRAME), [(Some(2), 21 * FRAME, false)]);
    }
}
