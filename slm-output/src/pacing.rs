//! For which refresh a frame is made, and when to begin it.
//!
//! A pure object in the manner of Monado's compositor pacing: [`Pacer::predict`] says when to wake and what to aim for,
//! [`Pacer::submitted`] is told that the frame went to the panel, [`Pacer::report`] what the panel did with it. It is
//! given every time and never reads a clock, so that a test runs through a day in a second.
//!
//! "Refresh" here is a whole colour frame of the panel, three fields: frames change there and nowhere else.

use holod_calibration::TimeNs;

use crate::present::TimestampSource;

/// Frames that are remembered until the panel reports them.
const SLOTS: usize = 16;
/// Frame times that are remembered, none of them, when the newest frame began, older than [`FORGOTTEN_AFTER`].
const WINDOW: usize = 192;
/// The budget is the longest of fewer than this many, the second longest of fewer than twice as many, else the third
/// longest: one or two hiccups among many frames do not move it. At 60 frames a second that is the 98.4th percentile.
const FRAMES_A_RANK: usize = 10;
const RANK: usize = 3;
/// So many of the last frames say what the next one takes that follows a rest.
const NEWEST: usize = RANK * FRAMES_A_RANK;
/// Of frames that take several refreshes there are few in this time, and a rare long one must not slow all of them for
/// longer: to be late by a refresh costs such a frame less than to wait for it costs all others.
const FORGOTTEN_AFTER: TimeNs = TimeNs(3_200_000_000);
/// Where fewer than [`FRAMES_A_RANK`] frames are remembered, one that took longer than the newest by this factor was a
/// standstill, which says nothing of the next ones; at rest one that took longer than the median by it.
const STANDSTILL_FACTOR: i64 = 4;
/// Share of a refresh's error that moves the phase, and that moves the period, of the panel's clock.
const PHASE_GAIN: f64 = 0.1;
const PERIOD_GAIN: f64 = 0.005;
/// A panel's rate differs from its nominal one by less than this share.
const PERIOD_TOLERANCE: f64 = 0.02;
/// What was learned of how early the panel wants its frames falls by this part with each frame that came in time, so
/// that it is tried again now and then whether less would do: at 60 Hz it costs one late frame in some seconds.
const FORGET_LEAD: i64 = 2048;
/// A report of a frame that was submitted longer ago than this has a wrong time.
const LATENESS_MAX: TimeNs = TimeNs(60_000_000_000);
/// Reports in a row that fit no refresh, after which the panel's clock is taken from the last of them.
const STRAYS_MAX: u32 = 8;

/// What pacing must know of panel and host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PacingConfig {
    /// Nominal time from one colour frame to the next.
    pub refresh_period: TimeNs,
    /// From a colour frame's presentation to the middle of its light.
    pub photon_delay: TimeNs,
    /// From a refresh that the display reports to its presentation on the panel.
    pub latency: TimeNs,
    /// A frame must be submitted this long before the refresh that it is for. Panels that choose their frame earlier
    /// are learned from frames that were in time and came a refresh late: by so much more after each.
    pub submit_margin: TimeNs,
    /// How long a frame takes from waking to submission, until that has been measured.
    pub first_frame_time: TimeNs,
}

/// One frame to be made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FramePlan {
    /// Its number, counting up from 1.
    pub frame_id: u64,
    /// Host time at which its making is to begin.
    pub t_wake: TimeNs,
    /// When it is to come on the panel.
    pub t_desired_present: TimeNs,
    /// When its light reaches the eye.
    pub t_predicted_photon: TimeNs,
}

/// Refreshes from one frame to the next where each keeps its maker busy for so long, its margin included.
pub fn refreshes_for(busy: TimeNs, refresh_period_ns: f64) -> f64 {
    (busy.0 as f64 / refresh_period_ns).ceil().max(1.0)
}

/// Plans frames and learns from what became of them.
#[derive(Clone, Debug)]
pub struct Pacer {
    config: PacingConfig,
    clock: RefreshClock,
    frame_times: FrameTimes,
    slots: [Option<Slot>; SLOTS],
    last_frame_id: u64,
    t_last_desired: Option<TimeNs>,
    /// From the submission of a frame to its refresh.
    lead: TimeNs,
}

#[derive(Clone, Copy, Debug)]
struct Slot {
    frame_id: u64,
    t_wake: TimeNs,
    t_desired_present: TimeNs,
    /// From submission to refresh, as it was planned.
    lead: TimeNs,
    t_submit: Option<TimeNs>,
    reported: bool,
}

impl Pacer {
    /// A pacer that supposes a refresh at `now` until it is told better.
    ///
    /// # Panics
    /// Where the refresh period is not positive.
    pub fn new(config: PacingConfig, now: TimeNs) -> Self {
        assert!(config.refresh_period > TimeNs(0), "a panel refreshes in positive time");
        Self {
            config,
            clock: RefreshClock::new(config.refresh_period, now),
            frame_times: FrameTimes::new(config.first_frame_time),
            slots: [None; SLOTS],
            last_frame_id: 0,
            t_last_desired: None,
            lead: config.submit_margin,
        }
    }

    /// Gives the next frame this number, where it is above all that were given.
    pub fn number_next(&mut self, frame_id: u64) {
        self.last_frame_id = self.last_frame_id.max(frame_id.saturating_sub(1));
    }

    /// Plans the next frame: the first refresh that it can reach and no other frame is for. Where a frame takes longer
    /// than a refresh, it keeps to every n-th. A frame that was submitted long before the refresh that it was made for
    /// has been shown at an earlier one, and its own is free.
    pub fn predict(&mut self, now: TimeNs) -> FramePlan {
        let budget = self.budget();
        let reachable = now + budget;
        let mut t_desired_present = self.clock.refresh_at_or_after(reachable);
        if let Some(t_last) = self.t_last_desired {
            // While a frame waits for its refresh the next one is made.
            let busy = self.frame_times.estimate + self.config.submit_margin;
            let every = refreshes_for(busy, self.clock.period_ns);
            let space = TimeNs((every * self.clock.period_ns).round() as i64);
            let last = self.slots[slot_index(self.last_frame_id)].filter(|slot| slot.frame_id == self.last_frame_id);
            let t_last = match last.and_then(|slot| slot.t_submit) {
                Some(t_submit) if t_last - now > space => self.clock.refresh_at_or_after(t_submit.min(now)),
                _ => t_last,
            };
            let spaced = t_last + space;
            // The clock may have moved a little since: the refresh that is meant is the nearest one.
            if spaced > t_desired_present {
                t_desired_present = self.clock.nearest_refresh(spaced);
            }
        }
        let frame_id = self.last_frame_id + 1;
        let t_wake = (t_desired_present - budget).max(now);
        self.last_frame_id = frame_id;
        self.t_last_desired = Some(t_desired_present);
        let lead = self.lead;
        self.slots[slot_index(frame_id)] =
            Some(Slot { frame_id, t_wake, t_desired_present, lead, t_submit: None, reported: false });
        let t_desired_present = t_desired_present + self.config.latency;
        let t_predicted_photon = t_desired_present + self.config.photon_delay;
        FramePlan { frame_id, t_wake, t_desired_present, t_predicted_photon }
    }

    /// A frame was handed to the panel. Unknown frames are ignored.
    pub fn submitted(&mut self, frame_id: u64, t_submit: TimeNs) {
        if let Some(t_wake) = self.note_submission(frame_id, t_submit) {
            self.frame_times.push(TimeNs((t_submit.0 - t_wake.0).max(0)), t_submit);
        }
    }

    /// The same of a frame for which there was nothing to be done: it says nothing of the time that frames take.
    pub fn submitted_at_once(&mut self, frame_id: u64, t_submit: TimeNs) {
        self.note_submission(frame_id, t_submit);
        self.frame_times.rest(t_submit);
    }

    /// When it was to begin, at the first submission of a known frame.
    fn note_submission(&mut self, frame_id: u64, t_submit: TimeNs) -> Option<TimeNs> {
        let slot = self.slots[slot_index(frame_id)].as_mut().filter(|slot| slot.frame_id == frame_id)?;
        let is_first = slot.t_submit.is_none();
        slot.t_submit.get_or_insert(t_submit);
        is_first.then_some(slot.t_wake)
    }

    /// The panel says that `frame_id` was first shown at `t_present`. Reports may come late, early, twice, in any
    /// order, with a time of zero or of frames that are unknown; what cannot be is ignored.
    pub fn report(&mut self, frame_id: u64, t_present: TimeNs, timestamp_source: TimestampSource) {
        let Some(slot) = self.slots[slot_index(frame_id)].as_mut().filter(|slot| slot.awaits_report(frame_id)) else {
            return;
        };
        // Half a refresh of grace for times taken by software.
        let after_submit_ns = t_present.0.saturating_sub(slot.t_submit.unwrap_or_default().0);
        let possible = -self.config.refresh_period.0 / 2..LATENESS_MAX.0;
        if t_present <= TimeNs(0) || !possible.contains(&after_submit_ns) {
            return;
        }
        slot.reported = true;
        let slot = *slot;
        if timestamp_source != TimestampSource::Estimated {
            self.clock.observe(t_present);
            self.learn_lead(&slot, t_present);
        }
    }

    fn learn_lead(&mut self, slot: &Slot, t_present: TimeNs) {
        let was_in_time = slot.t_submit.is_some_and(|t_submit| t_submit + slot.lead <= slot.t_desired_present);
        let came_late = 2 * (t_present.0 - slot.t_desired_present.0) > self.config.refresh_period.0;
        if !came_late {
            self.lead.0 -= (self.lead - self.config.submit_margin).0 / FORGET_LEAD;
        } else if was_in_time {
            // Frames that were under way at the time had no more.
            let more = slot.lead + self.config.submit_margin;
            self.lead = self.lead.max(more).min(self.config.refresh_period);
        }
    }

    /// The panel refreshed at `t_refresh` with whatever it had: keeps its clock true while frames are rare.
    pub fn observe_refresh(&mut self, t_refresh: TimeNs, timestamp_source: TimestampSource) {
        let possible = t_refresh > TimeNs(0) && t_refresh.0 < i64::MAX / 4;
        if timestamp_source != TimestampSource::Estimated && possible {
            self.clock.observe(t_refresh);
        }
    }

    /// Time that is planned for a frame from waking to its refresh.
    fn budget(&self) -> TimeNs {
        self.frame_times.estimate + self.lead
    }
}

impl Slot {
    fn awaits_report(&self, frame_id: u64) -> bool {
        self.frame_id == frame_id && self.t_submit.is_some() && !self.reported
    }
}

fn slot_index(frame_id: u64) -> usize {
    (frame_id % SLOTS as u64) as usize
}

/// When the panel refreshes: a phase-locked clock.
#[derive(Clone, Copy, Debug)]
struct RefreshClock {
    nominal_ns: f64,
    period_ns: f64,
    /// One refresh, whole nanoseconds and the rest.
    t_anchor: TimeNs,
    rest_ns: f64,
    strays: u32,
    observed: bool,
}

impl RefreshClock {
    fn new(period: TimeNs, now: TimeNs) -> Self {
        let nominal_ns = period.0 as f64;
        Self { nominal_ns, period_ns: nominal_ns, t_anchor: now, rest_ns: 0.0, strays: 0, observed: false }
    }

    /// Takes in one refresh.
    fn observe(&mut self, t: TimeNs) {
        if !self.observed {
            self.observed = true;
            self.t_anchor = t;
            self.rest_ns = 0.0;
            return;
        }
        let since_ns = (t.0 - self.t_anchor.0) as f64 - self.rest_ns;
        let count = (since_ns / self.period_ns).round();
        let error_ns = since_ns - count * self.period_ns;
        if error_ns.abs() > 0.25 * self.period_ns {
            self.strays += 1;
            if self.strays < STRAYS_MAX {
                return;
            }
            self.strays = 0;
            self.t_anchor = t;
            self.rest_ns = 0.0;
            return;
        }
        self.strays = 0;
        if count > 0.0 {
            let tolerance_ns = PERIOD_TOLERANCE * self.nominal_ns;
            let period_ns = self.period_ns + PERIOD_GAIN * error_ns / count.min(100.0);
            self.period_ns = period_ns.clamp(self.nominal_ns - tolerance_ns, self.nominal_ns + tolerance_ns);
        }
        // An old report moves the phase, too, but the anchor only goes forward.
        let advance_ns = self.rest_ns + count.max(0.0) * self.period_ns + PHASE_GAIN * error_ns;
        let whole_ns = advance_ns.floor();
        self.t_anchor = TimeNs(self.t_anchor.0 + whole_ns as i64);
        self.rest_ns = advance_ns - whole_ns;
    }

    fn refresh(&self, count: f64) -> TimeNs {
        TimeNs(self.t_anchor.0 + (self.rest_ns + count * self.period_ns).round() as i64)
    }

    fn count_to(&self, t: TimeNs) -> f64 {
        ((t.0 - self.t_anchor.0) as f64 - self.rest_ns) / self.period_ns
    }

    fn refresh_at_or_after(&self, t: TimeNs) -> TimeNs {
        // A nanosecond of rounding must not cost a refresh.
        self.refresh((self.count_to(t) - 1e-6).ceil())
    }

    fn nearest_refresh(&self, t: TimeNs) -> TimeNs {
        self.refresh(self.count_to(t).round())
    }
}

/// The last frame times, and the budget that they make.
#[derive(Clone, Copy, Debug)]
struct FrameTimes {
    window: [FrameTime; WINDOW],
    count: usize,
    estimate: TimeNs,
}

#[derive(Clone, Copy, Debug)]
struct FrameTime {
    time: TimeNs,
    t_submit: TimeNs,
}

impl FrameTimes {
    fn new(first: TimeNs) -> Self {
        let none = FrameTime { time: TimeNs(0), t_submit: TimeNs(0) };
        Self { window: [none; WINDOW], count: 0, estimate: first }
    }

    /// Frames took no work lately. Once all that is remembered is old, a hiccup among it must not slow them any more,
    /// and the next one that takes work is still to be in time: what they take is the second longest of the newest
    /// ones, or the third longest where they are many, without standstills.
    fn rest(&mut self, now: TimeNs) {
        let known = self.count.min(NEWEST);
        let mut newest = [TimeNs(0); NEWEST];
        for (time, count) in newest.iter_mut().zip(self.count - known..self.count) {
            let frame = &self.window[count % WINDOW];
            if now.0.saturating_sub(frame.t_submit.0) <= FORGOTTEN_AFTER.0 {
                return;
            }
            *time = frame.time;
        }
        let times = &mut newest[..known];
        times.sort_unstable();
        let Some(&median) = times.get(known.saturating_sub(1) / 2) else { return };
        let longest = TimeNs(median.0.saturating_mul(STANDSTILL_FACTOR));
        let usual = times.partition_point(|&time| time <= longest);
        let rank = (usual / FRAMES_A_RANK).clamp(1, RANK - 1);
        self.estimate = times[usual.saturating_sub(rank + 1)];
    }

    fn push(&mut self, time: TimeNs, t_submit: TimeNs) {
        self.window[self.count % WINDOW] = FrameTime { time, t_submit };
        self.count += 1;
        let t_begin = t_submit.0.saturating_sub(time.0);
        let standstill_ns = time.0.saturating_mul(STANDSTILL_FACTOR);
        let mut longest = [TimeNs(0); RANK];
        let mut longest_of_few = time;
        let mut known = 0;
        for frame in &self.window[..self.count.min(WINDOW)] {
            if t_begin.saturating_sub(frame.t_submit.0) > FORGOTTEN_AFTER.0 {
                continue;
            }
            known += 1;
            if frame.time.0 <= standstill_ns {
                longest_of_few = longest_of_few.max(frame.time);
            }
            if frame.time > longest[RANK - 1] {
                longest[RANK - 1] = frame.time;
                longest.sort_unstable_by(|a, b| b.cmp(a));
            }
        }
        let rank = (known / FRAMES_A_RANK).min(RANK - 1);
        self.estimate = if rank == 0 { longest_of_few } else { longest[rank] };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;
    use std::collections::VecDeque;

    const MS: i64 = 1_000_000;
    const REFRESH: TimeNs = TimeNs(16_666_668);
    const HICCUPS: f64 = 0.03;

    fn config() -> PacingConfig {
        PacingConfig {
            refresh_period: REFRESH,
            photon_delay: TimeNs(9 * MS),
            latency: TimeNs(0),
            submit_margin: TimeNs(MS),
            first_frame_time: TimeNs(10 * MS),
        }
    }

    #[test]
    fn a_panel_that_is_late_moves_what_is_shown_and_not_what_is_done() {
        let latency = TimeNs(25 * MS);
        let mut pacers = [config(), PacingConfig { latency, ..config() }].map(|config| Pacer::new(config, TimeNs(0)));
        for frame in 0..50 {
            let now = TimeNs(frame * 20 * MS);
            let [plan, late] = pacers.each_mut().map(|pacer| pacer.predict(now));
            assert_eq!(late.t_wake, plan.t_wake);
            assert_eq!(late.t_desired_present, plan.t_desired_present + latency);
            assert_eq!(late.t_predicted_photon, plan.t_predicted_photon + latency);
            for pacer in &mut pacers {
                pacer.submitted(plan.frame_id, plan.t_wake + TimeNs(5 * MS));
                // The display reports its own refresh.
                pacer.report(plan.frame_id, plan.t_desired_present, TimestampSource::Hardware);
            }
        }
    }

    /// A host and a panel that run by themselves: what really happens while a pacer plans.
    struct Bench {
        /// The panel's true period, of which it is told only the nominal one.
        period_ns: f64,
        /// Render time and its jitter.
        render_ns: i64,
        jitter_ns: i64,
        /// This share of frames takes so much longer: [`HICCUPS`].
        hiccup_ns: i64,
        /// From a presentation to its report.
        report_delay_ns: i64,
        /// From the choice of a frame to its presentation.
        lead_ns: i64,
        random: Pcg64Mcg,
    }

    /// Whether a frame was shown at least half a refresh after the one that it was made for.
    fn is_late(plan: &FramePlan, t_present: TimeNs) -> bool {
        2 * (t_present - plan.t_desired_present).0 > REFRESH.0
    }

    #[derive(Debug, Default, PartialEq)]
    struct Ran {
        frames: u64,
        missed: u64,
        /// Refreshes between one frame and the next, by their count; the last bin holds all that are more.
        spacing: [u64; 5],
        /// Mean time from waking to presentation.
        latency_ms: f64,
        /// Reports of frames that were forgotten before.
        forgotten: u64,
    }

    impl Bench {
        fn new(period_ns: f64, render_ms: f64, jitter_ms: f64) -> Self {
            Self {
                period_ns,
                render_ns: (render_ms * 1e6) as i64,
                jitter_ns: (jitter_ms * 1e6) as i64,
                hiccup_ns: 0,
                report_delay_ns: 300_000,
                lead_ns: 0,
                random: Pcg64Mcg::seed_from_u64(7),
            }
        }

        fn run(&mut self, hours: f64) -> Ran {
            // The panel's refreshes have nothing to do with the time at which the host begins.
            let t_first_ns = 5.3e6;
            let mut pacer = Pacer::new(config(), TimeNs(0));
            let mut reports: VecDeque<(FramePlan, TimeNs)> = VecDeque::new();
            let mut ran = Ran::default();
            let mut now = TimeNs(1000);
            let mut last_refresh = 0i64;
            let t_end = TimeNs((hours * 3600e9) as i64);
            let mut latency_ns = 0.0;
            while now < t_end {
                while let Some(&(plan, t_present)) = reports.front()
                    && t_present.0 + self.report_delay_ns <= now.0
                {
                    reports.pop_front();
                    ran.missed += u64::from(is_late(&plan, t_present));
                    let slot = pacer.slots[slot_index(plan.frame_id)];
                    ran.forgotten += u64::from(!slot.is_some_and(|slot| slot.awaits_report(plan.frame_id)));
                    pacer.report(plan.frame_id, t_present, TimestampSource::Hardware);
                }
                let plan = pacer.predict(now);
                assert!(plan.t_wake >= now && plan.t_desired_present > plan.t_wake);
                let t_wake = plan.t_wake + TimeNs(self.random.random_range(0..200_000));
                let mut render_ns = self.render_ns + self.random.random_range(0..=self.jitter_ns);
                if self.hiccup_ns > 0 && self.random.random_bool(HICCUPS) {
                    render_ns += self.hiccup_ns;
                }
                now = t_wake + TimeNs(render_ns);
                pacer.submitted(plan.frame_id, now);
                let refresh = (((now.0 + self.lead_ns) as f64 - t_first_ns) / self.period_ns).ceil();
                let t_present = TimeNs((t_first_ns + refresh * self.period_ns) as i64);
                reports.push_back((plan, t_present));
                let since = (refresh as i64 - last_refresh).clamp(0, 4) as usize;
                if ran.frames > 0 {
                    ran.spacing[since] += 1;
                }
                last_refresh = refresh as i64;
                latency_ns += (t_present - t_wake).0 as f64;
                ran.frames += 1;
            }
            ran.latency_ms = latency_ns / 1e6 / ran.frames as f64;
            ran
        }
    }

    #[test]
    fn a_day_of_frames_hits_every_refresh() {
        let ran = Bench::new(REFRESH.0 as f64, 6.0, 2.0).run(24.0);
        let refreshes = 24.0 * 3600e9 / REFRESH.0 as f64;
        assert!((ran.frames as f64) > 0.999 * refreshes, "{ran:?}");
        assert!((ran.spacing[1] as f64) > 0.999 * ran.frames as f64, "{ran:?}");
        assert!((ran.missed as f64) < 0.001 * ran.frames as f64, "{ran:?}");
        // Waking is as late as it can be: the longest render time, the margin and little more.
        assert!(ran.latency_ms < 9.6, "{ran:?}");
    }

    #[test]
    fn a_panel_that_is_faster_or_slower_than_it_says_is_followed() {
        for share in [0.985, 0.999, 1.001, 1.015] {
            let ran = Bench::new(REFRESH.0 as f64 * share, 6.0, 2.0).run(1.0);
            assert!((ran.spacing[1] as f64) > 0.99 * ran.frames as f64, "{share}: {ran:?}");
            assert!((ran.missed as f64) < 0.01 * ran.frames as f64, "{share}: {ran:?}");
        }
    }

    /// A display server that draws some milliseconds before a refresh, or a card that is told before the blank.
    #[test]
    fn a_panel_that_chooses_its_frames_early_gets_them_earlier() {
        for (lead_ms, report_delay_ms, render_ms) in
            [(2, 0, 5.0), (4, 0, 5.0), (4, 100, 5.0), (7, 0, 5.0), (4, 0, 14.0), (9, 0, 1.5), (12, 0, 1.5)]
        {
            let mut bench = Bench::new(REFRESH.0 as f64, render_ms, 0.5);
            (bench.lead_ns, bench.report_delay_ns) = (lead_ms * MS, 300_000 + report_delay_ms * MS);
            let ran = bench.run(1.0);
            assert!(ran.missed > 0, "it is learned from misses");
            assert!((ran.missed as f64) < 0.01 * ran.frames as f64, "{lead_ms} ms: {ran:?}");
            assert!((ran.spacing[1] as f64) > 0.98 * ran.frames as f64, "{lead_ms} ms: {ran:?}");
            // Render time with its jitter, the lead and what is tried above it.
            assert!(ran.latency_ms < render_ms + 0.7 + lead_ms as f64 + 1.5, "{lead_ms} ms: {ran:?}");
        }
    }

    #[test]
    fn late_reports_do_no_harm() {
        let mut bench = Bench::new(REFRESH.0 as f64 * 1.002, 6.0, 2.0);
        bench.report_delay_ns = 100 * MS;
        let ran = bench.run(1.0);
        assert!((ran.spacing[1] as f64) > 0.99 * ran.frames as f64, "{ran:?}");
        assert_eq!(ran.forgotten, 0, "{ran:?}");
        // Canary: more frames than are remembered.
        bench.report_delay_ns = 20 * REFRESH.0;
        assert!(bench.run(0.01).forgotten > 0);
    }

    #[test]
    fn slow_frames_aim_at_every_second_refresh_and_very_slow_ones_at_every_fourth() {
        for (render_ms, every) in [(20.0, 2), (52.0, 4)] {
            let ran = Bench::new(REFRESH.0 as f64, render_ms, 2.0).run(1.0);
            assert!((ran.spacing[every] as f64) > 0.999 * ran.frames as f64, "{render_ms} ms: {ran:?}");
            assert!((ran.missed as f64) < 0.005 * ran.frames as f64, "{render_ms} ms: {ran:?}");
        }
    }

    /// Frames of 90 ms fit into six refreshes. A few that need nine are shown late; they do not make nine of every six.
    #[test]
    fn rare_long_frames_do_not_slow_the_many_slow_ones() {
        let mut bench = Bench::new(REFRESH.0 as f64, 88.0, 4.0);
        bench.hiccup_ns = 50 * MS;
        let ran = bench.run(1.0);
        let refreshes = 3600e9 / REFRESH.0 as f64;
        assert!(refreshes / (ran.frames as f64) < 6.4, "{ran:?}");
        let late = ran.missed as f64 / ran.frames as f64;
        assert!((0.01..HICCUPS).contains(&late), "{ran:?}");
    }

    /// The refreshes from the submission of each frame to that of the next, where frame `long` takes `long_ms` and all
    /// others 8 ms.
    fn spacings(long: u64, long_ms: i64) -> Vec<i64> {
        let mut pacer = Pacer::new(config(), TimeNs(0));
        let (mut now, mut submitted) = (TimeNs(1000), Vec::new());
        for _ in 0..400 {
            let plan = pacer.predict(now);
            let takes_ms = if plan.frame_id == long { long_ms } else { 8 };
            now = plan.t_wake + TimeNs(takes_ms * MS);
            pacer.submitted(plan.frame_id, now);
            let refresh = (now.0 as f64 / REFRESH.0 as f64).ceil() as i64;
            submitted.push(refresh);
            // Shown at the next refresh, whatever refresh it was made for.
            pacer.report(plan.frame_id, TimeNs(refresh * REFRESH.0), TimestampSource::Hardware);
        }
        submitted.windows(2).map(|pair| pair[1] - pair[0]).collect()
    }

    /// A machine that stood still, or the first frame of a device that had to get ready.
    #[test]
    fn a_frame_that_takes_seconds_costs_its_own_time_and_no_more() {
        for long in [1, 2, 5, 15, 100] {
            for long_ms in [100, 1000, 2900, 3050, 3150, 3250, 4000, 30_000] {
                let spacings = spacings(long, long_ms);
                // The last part of a refresh, and the one that is lost to a plan made for the next such frame.
                let stood = 2 + long_ms * MS / REFRESH.0;
                let lost: i64 = spacings.iter().map(|spacing| spacing - 1).sum();
                assert!(lost <= stood, "frame {long} of {long_ms} ms costs {lost} refreshes: {spacings:?}");
            }
        }
        assert!(spacings(0, 0).iter().all(|spacing| *spacing == 1));
    }

    #[test]
    fn frames_that_take_seconds_each_are_planned_for_as_long() {
        for render_ms in [3000.0, 5000.0] {
            let ran = Bench::new(REFRESH.0 as f64, render_ms, 30.0).run(3.0);
            assert!((ran.missed as f64) < 0.5 * ran.frames as f64, "{render_ms} ms: {ran:?}");
            assert!((3.0 * 3600e3 / ran.frames as f64) < render_ms + 60.0, "{render_ms} ms: {ran:?}");
        }
    }

    /// Canary for the benches above: a pacer whose frames take longer than planned is seen to miss.
    #[test]
    fn canary_frames_that_take_longer_than_planned_are_missed() {
        let mut bench = Bench::new(REFRESH.0 as f64, 6.0, 0.0);
        bench.hiccup_ns = 17 * MS;
        let ran = bench.run(0.1);
        let late = ran.missed as f64 / ran.frames as f64;
        assert!((0.3 * HICCUPS..3.0 * HICCUPS).contains(&late), "{ran:?}");
    }

    #[test]
    fn useless_reports_change_no_plan() {
        let mut pacer = Pacer::new(config(), TimeNs(0));
        let plan = pacer.predict(TimeNs(MS));
        let (id, good) = (plan.frame_id, plan.t_desired_present + TimeNs(MS));
        let next = |pacer: &Pacer| pacer.clone().predict(TimeNs(300 * MS));
        let before = next(&pacer);
        pacer.report(id, good, TimestampSource::Hardware);
        assert_eq!(next(&pacer), before, "not submitted");
        pacer.submitted(id, plan.t_wake + TimeNs(5 * MS));
        let before = next(&pacer);
        for (frame_id, t_present) in
            [(id + 1, good), (id, TimeNs(0)), (id, TimeNs(i64::MAX)), (id, plan.t_wake - REFRESH)]
        {
            pacer.report(frame_id, t_present, TimestampSource::Hardware);
            assert_eq!(next(&pacer), before, "frame {frame_id} at {t_present:?}");
        }
        pacer.report(id, good, TimestampSource::Hardware);
        let after = next(&pacer);
        assert_ne!(after, before, "a report that can be is taken in");
        pacer.report(id, good + TimeNs(2 * MS), TimestampSource::Hardware);
        assert_eq!(next(&pacer), after, "reported before");
    }

    #[test]
    fn frames_that_took_no_work_change_no_budget_and_come_no_oftener() {
        let mut pacer = Pacer::new(PacingConfig { first_frame_time: TimeNs(40 * MS), ..config() }, TimeNs(0));
        let budget = pacer.budget();
        let mut now = TimeNs(MS);
        let mut planned = Vec::new();
        for _ in 0..100 {
            let plan = pacer.predict(now);
            now = plan.t_wake + TimeNs(MS / 10);
            pacer.submitted_at_once(plan.frame_id, now);
            planned.push(plan.t_desired_present);
        }
        assert_eq!(pacer.budget(), budget);
        // 41 ms are three refreshes.
        assert!(planned.windows(2).all(|pair| pair[1] - pair[0] == TimeNs(3 * REFRESH.0)), "{planned:?}");
        pacer.submitted(pacer.last_frame_id, now + TimeNs(200 * MS));
        assert_eq!(pacer.budget(), budget, "it was submitted already");
        let plan = pacer.predict(now);
        pacer.submitted(plan.frame_id, plan.t_wake + TimeNs(3 * MS));
        assert_eq!(pacer.budget(), TimeNs(4 * MS), "a frame that was computed tells its time");
    }

    #[test]
    fn a_hiccup_before_frames_that_take_no_work_is_forgotten_in_time() {
        let mut pacer = Pacer::new(config(), TimeNs(0));
        let mut now = TimeNs(MS);
        for time_ms in [5, 6, 5, 40] {
            let plan = pacer.predict(now);
            now = plan.t_wake + TimeNs(time_ms * MS);
            pacer.submitted(plan.frame_id, now);
        }
        let t_hiccup = now;
        assert_eq!(pacer.budget(), TimeNs(41 * MS));
        let mut frames = 0;
        while pacer.budget() == TimeNs(41 * MS) && frames < 1000 {
            let plan = pacer.predict(now);
            now = plan.t_wake.max(now) + TimeNs(MS / 10);
            pacer.submitted_at_once(plan.frame_id, now);
            frames += 1;
        }
        assert!((TimeNs(0)..TimeNs(2 * REFRESH.0)).contains(&(now - t_hiccup - FORGOTTEN_AFTER)), "{now:?}");
        assert!((60..70).contains(&frames), "every third refresh: {frames}");
        assert_eq!(pacer.budget(), TimeNs(6 * MS), "the second longest without the standstill");
    }

    /// From 8 to 14 ms each, as often the one as the other.
    #[test]
    fn the_first_frame_after_a_rest_comes_in_time() {
        let mut pacer = Pacer::new(config(), TimeNs(0));
        let mut random = Pcg64Mcg::seed_from_u64(4);
        let (mut now, mut late) = (TimeNs(MS), 0);
        for _ in 0..200 {
            for number in 0..12 {
                let plan = pacer.predict(now);
                now = plan.t_wake + TimeNs(random.random_range(8 * MS..14 * MS));
                pacer.submitted(plan.frame_id, now);
                late += u32::from(number == 0 && now + config().submit_margin > plan.t_desired_present);
            }
            let t_rested = now + FORGOTTEN_AFTER + TimeNs(500 * MS);
            while now < t_rested {
                let plan = pacer.predict(now);
                now = plan.t_wake + TimeNs(MS / 10);
                pacer.submitted_at_once(plan.frame_id, now);
            }
        }
        assert!((5..30).contains(&late), "{late} of 200");
    }

    #[test]
    fn a_rest_leaves_out_standstills_and_the_longest_of_the_others() {
        let after = |times_ms: &[i64]| {
            let mut times = FrameTimes::new(TimeNs(MS));
            for (number, time_ms) in (1..).zip(times_ms) {
                times.push(TimeNs(time_ms * MS), TimeNs(number * 20 * MS));
            }
            times.rest(TimeNs(60_000 * MS));
            times.estimate.0 / MS
        };
        assert_eq!(after(&[]), 1, "nothing is known but what was given");
        assert_eq!(after(&[7]), 7);
        assert_eq!(after(&[7, 9]), 7);
        assert_eq!(after(&[5, 6, 19, 5]), 6, "less than a standstill");
        assert_eq!(after(&[5, 6, 400, 7]), 6);
        let mut many = vec![50; 200];
        many.extend([5; 26]);
        many.extend([300, 8, 7, 6]);
        assert_eq!(after(&many), 6, "of the newest alone");
    }

    #[test]
    fn a_guess_does_not_move_the_clock() {
        let mut pacer = Pacer::new(config(), TimeNs(0));
        let before = pacer.clone().predict(TimeNs(MS));
        pacer.observe_refresh(TimeNs(7 * MS), TimestampSource::Estimated);
        assert_eq!(pacer.clone().predict(TimeNs(MS)), before);
        pacer.observe_refresh(TimeNs(7 * MS), TimestampSource::External);
        assert_ne!(pacer.predict(TimeNs(MS)), before);
    }

    #[test]
    fn a_panel_that_jumps_is_found_again() {
        let mut pacer = Pacer::new(config(), TimeNs(0));
        pacer.observe_refresh(TimeNs(MS), TimestampSource::Hardware);
        for refresh in 1..=8 {
            pacer.observe_refresh(TimeNs(9 * MS + refresh * REFRESH.0), TimestampSource::Hardware);
        }
        let plan = pacer.predict(TimeNs(200 * MS));
        let phase = (plan.t_desired_present.0 - 9 * MS).rem_euclid(REFRESH.0);
        assert!(!(1000..REFRESH.0 - 1000).contains(&phase), "{phase}");
    }

    #[test]
    fn light_is_predicted_after_presentation() {
        let plan = Pacer::new(config(), TimeNs(0)).predict(TimeNs(MS));
        assert_eq!(plan.t_predicted_photon - plan.t_desired_present, TimeNs(9 * MS));
    }

    #[derive(Clone, Debug)]
    enum Step {
        Predict { later_ns: i64 },
        Mark { back: u64, later_ns: i64 },
        Report { back: u64, t_ns: i64, timestamp_source: TimestampSource },
        Refresh { t_ns: i64 },
    }

    fn steps() -> impl Strategy<Value = Step> {
        let odd_times =
            prop_oneof![Just(0), Just(-1), Just(i64::MAX), Just(i64::MIN), 0i64..2_000_000_000, any::<i64>()];
        let timestamp_source = prop_oneof![
            Just(TimestampSource::Hardware),
            Just(TimestampSource::Software),
            Just(TimestampSource::Estimated)
        ];
        prop_oneof![
            4 => (0i64..40 * MS).prop_map(|later_ns| Step::Predict { later_ns }),
            4 => (0u64..20, 0i64..60 * MS).prop_map(|(back, later_ns)| Step::Mark { back, later_ns }),
            4 => (0u64..20, odd_times.clone(), timestamp_source)
                .prop_map(|(back, t_ns, timestamp_source)| Step::Report { back, t_ns, timestamp_source }),
            1 => odd_times.prop_map(|t_ns| Step::Refresh { t_ns }),
        ]
    }

    proptest! {
        /// Whatever it is told, a pacer plans forward: frames are numbered without a gap, never for a refresh that
        /// another frame still waits for, never in the past.
        #[test]
        fn plans_go_forward_whatever_is_reported(steps in prop::collection::vec(steps(), 1..200)) {
            let mut pacer = Pacer::new(config(), TimeNs(0));
            let mut now = TimeNs(0);
            let mut last: Option<FramePlan> = None;
            let mut last_submitted = false;
            for step in steps {
                match step {
                    Step::Predict { later_ns } => {
                        now = now + TimeNs(later_ns);
                        let plan = pacer.predict(now);
                        prop_assert!(plan.t_wake >= now);
                        prop_assert!(plan.t_desired_present >= plan.t_wake);
                        prop_assert_eq!(plan.frame_id, last.map_or(1, |last| last.frame_id + 1));
                        if let Some(last) = last {
                            let forward = plan.t_desired_present > last.t_desired_present;
                            // One that was submitted early enough has been shown before its refresh.
                            let freed = last_submitted && last.t_desired_present > now;
                            prop_assert!(forward || freed);
                        }
                        (last, last_submitted) = (Some(plan), false);
                    }
                    Step::Mark { back, later_ns } => {
                        let id = last.map_or(0, |last| last.frame_id).wrapping_sub(back);
                        pacer.submitted(id, now + TimeNs(later_ns));
                        last_submitted |= last.is_some() && back == 0;
                    }
                    Step::Report { back, t_ns, timestamp_source } => {
                        let id = last.map_or(0, |last| last.frame_id).wrapping_sub(back);
                        pacer.report(id, TimeNs(t_ns), timestamp_source);
                    }
                    Step::Refresh { t_ns } => pacer.observe_refresh(TimeNs(t_ns), TimestampSource::Hardware),
                }
            }
        }

        /// Against every time sorted: frames as fast as the window is long, slow ones, pauses, and times that go back.
        #[test]
        fn the_estimate_is_ranked_among_what_is_not_forgotten(
            frames in prop_oneof![Just(5i64), Just(20), Just(300), Just(4000)]
                .prop_flat_map(|longest_gap_ms| prop::collection::vec((0i64..50, -2i64..longest_gap_ms), 1..900)),
        ) {
            let mut kept = FrameTimes::new(TimeNs(1));
            let mut pushed = Vec::new();
            let mut now = TimeNs(0);
            for (time, later_ms) in frames {
                now = now + TimeNs(later_ms * MS);
                pushed.push((now, TimeNs(time)));
                kept.push(TimeNs(time), now);
                let recent = &pushed[pushed.len().saturating_sub(WINDOW)..];
                let began = now.0 - time;
                let mut times: Vec<_> =
                    recent.iter().filter(|(when, _)| began - when.0 <= 3_200 * MS).map(|&(_, time)| time).collect();
                times.sort_unstable_by(|a, b| b.cmp(a));
                let rank = match times.len() {
                    0..10 => times.iter().filter(|longer| longer.0 > 4 * time).count(),
                    10..20 => 1,
                    _ => 2,
                };
                prop_assert_eq!(kept.estimate, times[rank]);
            }
        }
    }
}
