//! For which refresh a frame is made, and when to begin it.
//!
//! A pure object in the manner of Monado's compositor pacing: [`Pacer::predict`] says when to wake and what to aim for,
//! [`Pacer::mark`] is told what happened to the frame on the host, [`Pacer::report`] what the panel did with it. It is
//! given every time and never reads a clock, so that a test runs through a day in a second.
//!
//! "Refresh" here is a whole colour frame of the panel, three fields: frames change there and nowhere else.

use holod_calibration::TimeNs;

use crate::present::Provenance;

/// Frames that are remembered until the panel reports them.
const SLOTS: usize = 16;
/// Frame times of which the budget is the third longest: a 98.4th percentile that forgets in some seconds, and that one
/// or two hiccups in that time do not move.
const WINDOW: usize = 192;
const RANK: usize = 3;
/// Share of a refresh's error that moves the phase, and that moves the period, of the panel's clock.
const PHASE_GAIN: f64 = 0.1;
const PERIOD_GAIN: f64 = 0.005;
/// A panel's rate differs from its nominal one by less than this share.
const PERIOD_TOLERANCE: f64 = 0.02;
/// Reports in a row that fit no refresh, after which the panel's clock is taken from the last of them.
const STRAYS_MAX: u32 = 8;

/// What pacing must know of panel and host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PacingConfig {
    /// Nominal time from one colour frame to the next.
    pub refresh_period: TimeNs,
    /// From a colour frame's presentation to the middle of its light.
    pub photon_delay: TimeNs,
    /// A frame must be submitted this long before the refresh that it is for.
    pub submit_margin: TimeNs,
    /// How long a frame takes from waking to submission, until that has been measured.
    pub first_frame_time: TimeNs,
}

/// One frame to be made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FramePlan {
    /// Its number, counting up from 1.
    pub frame_id: u64,
    /// When to begin.
    pub t_wake: TimeNs,
    /// The refresh that it is for.
    pub t_desired_present: TimeNs,
    /// When its light reaches the eye.
    pub t_predicted_photon: TimeNs,
}

/// What happens to a frame on the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Point {
    /// The frame thread woke for it.
    WakeUp,
    /// Its hologram is begun.
    RenderBegin,
    /// Its hologram is done.
    RenderEnd,
    /// It was handed to the panel.
    Submit,
}

/// What a present report was worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The frame was shown at the refresh that it was made for, or earlier.
    OnTime,
    /// It was shown this many refreshes late.
    Missed {
        /// At least 1.
        refreshes: u32,
    },
    /// It has no time, or no time that can be, and told nothing.
    Implausible,
    /// The frame is unknown, or was reported before.
    Unknown,
}

/// Counters since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PacingCounts {
    /// Frames planned.
    pub planned: u64,
    /// Frames reported as shown.
    pub presented: u64,
    /// Frames shown later than planned.
    pub missed: u64,
    /// Frames that were submitted and never reported.
    pub unreported: u64,
    /// Frames that were planned and never submitted.
    pub abandoned: u64,
    /// Reports of frames that are unknown or were reported before.
    pub unknown_reports: u64,
    /// Reports without a possible time.
    pub implausible_reports: u64,
    /// Times that the panel's clock was taken anew.
    pub resyncs: u64,
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
    counts: PacingCounts,
}

#[derive(Clone, Copy, Debug)]
struct Slot {
    frame_id: u64,
    t_wake: TimeNs,
    t_desired_present: TimeNs,
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
            counts: PacingCounts::default(),
        }
    }

    /// Plans the next frame: the first refresh that it can reach and no other frame is for. Where a frame takes longer
    /// than a refresh, it keeps to every n-th.
    pub fn predict(&mut self, now: TimeNs) -> FramePlan {
        let budget = self.budget();
        let reachable = now + budget;
        let mut t_desired_present = self.clock.refresh_at_or_after(reachable);
        if let Some(t_last) = self.t_last_desired {
            let every = (budget.0 as f64 / self.clock.period_ns).ceil().max(1.0);
            let spaced = TimeNs(t_last.0 + (every * self.clock.period_ns).round() as i64);
            // The clock may have moved a little since: the refresh that is meant is the nearest one.
            if spaced > t_desired_present {
                t_desired_present = self.clock.nearest_refresh(spaced);
            }
        }
        let frame_id = self.last_frame_id + 1;
        let t_wake = (t_desired_present - budget).max(now);
        self.last_frame_id = frame_id;
        self.t_last_desired = Some(t_desired_present);
        self.counts.planned += 1;
        self.remember(Slot { frame_id, t_wake, t_desired_present, t_submit: None, reported: false });
        let t_predicted_photon = t_desired_present + self.config.photon_delay;
        FramePlan { frame_id, t_wake, t_desired_present, t_predicted_photon }
    }

    /// Tells what happened to a frame and when. Unknown frames are ignored.
    pub fn mark(&mut self, point: Point, frame_id: u64, when: TimeNs) {
        let Some(slot) = self.slots[slot_index(frame_id)].as_mut().filter(|slot| slot.frame_id == frame_id) else {
            return;
        };
        if point == Point::Submit && slot.t_submit.is_none() {
            slot.t_submit = Some(when);
            self.frame_times.push(TimeNs((when.0 - slot.t_wake.0).max(0)));
        }
    }

    /// The panel says that `frame_id` was first shown at `t_present`. Reports may come late, early, twice, in any order,
    /// or with a time of zero.
    pub fn report(&mut self, frame_id: u64, t_present: TimeNs, provenance: Provenance) -> Outcome {
        let Some(slot) = self.slots[slot_index(frame_id)]
            .as_mut()
            .filter(|slot| slot.frame_id == frame_id && slot.t_submit.is_some() && !slot.reported)
        else {
            self.counts.unknown_reports += 1;
            return Outcome::Unknown;
        };
        // Half a refresh of grace for times taken by software.
        let earliest = TimeNs(slot.t_submit.unwrap_or_default().0 - self.config.refresh_period.0 / 2);
        if t_present <= TimeNs(0) || t_present < earliest {
            self.counts.implausible_reports += 1;
            return Outcome::Implausible;
        }
        slot.reported = true;
        let late_ns = t_present.0 - slot.t_desired_present.0;
        self.counts.presented += 1;
        if provenance != Provenance::Estimated && self.clock.observe(t_present) {
            self.counts.resyncs += 1;
        }
        let refreshes = (late_ns as f64 / self.clock.period_ns).round();
        if refreshes >= 1.0 {
            self.counts.missed += 1;
            return Outcome::Missed { refreshes: refreshes as u32 };
        }
        Outcome::OnTime
    }

    /// The panel refreshed at `t_refresh` with whatever it had: keeps its clock true while frames are rare.
    pub fn observe_refresh(&mut self, t_refresh: TimeNs, provenance: Provenance) {
        if provenance != Provenance::Estimated && t_refresh > TimeNs(0) && self.clock.observe(t_refresh) {
            self.counts.resyncs += 1;
        }
    }

    /// Time that is planned for a frame from waking to its refresh.
    pub fn budget(&self) -> TimeNs {
        self.frame_times.estimate + self.config.submit_margin
    }

    /// Time from one refresh to the next, as observed.
    pub fn refresh_period(&self) -> TimeNs {
        TimeNs(self.clock.period_ns.round() as i64)
    }

    /// Counters since the start.
    pub fn counts(&self) -> PacingCounts {
        self.counts
    }

    fn remember(&mut self, slot: Slot) {
        let evicted = self.slots[slot_index(slot.frame_id)].replace(slot);
        match evicted {
            Some(old) if old.t_submit.is_none() => self.counts.abandoned += 1,
            Some(old) if !old.reported => self.counts.unreported += 1,
            _ => {}
        }
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

    /// Takes in one refresh; whether the clock had to be set anew.
    fn observe(&mut self, t: TimeNs) -> bool {
        if !self.observed {
            self.observed = true;
            self.t_anchor = t;
            self.rest_ns = 0.0;
            return false;
        }
        let since_ns = (t.0 - self.t_anchor.0) as f64 - self.rest_ns;
        let count = (since_ns / self.period_ns).round();
        let error_ns = since_ns - count * self.period_ns;
        if error_ns.abs() > 0.25 * self.period_ns {
            self.strays += 1;
            if self.strays < STRAYS_MAX {
                return false;
            }
            self.strays = 0;
            self.t_anchor = t;
            self.rest_ns = 0.0;
            return true;
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
        false
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

/// The [`RANK`]-th longest of the last [`WINDOW`] frame times.
#[derive(Clone, Copy, Debug)]
struct FrameTimes {
    window: [TimeNs; WINDOW],
    count: usize,
    estimate: TimeNs,
}

impl FrameTimes {
    fn new(first: TimeNs) -> Self {
        Self { window: [TimeNs(0); WINDOW], count: 0, estimate: first }
    }

    fn push(&mut self, time: TimeNs) {
        let place = self.count % WINDOW;
        let evicted = std::mem::replace(&mut self.window[place], time);
        self.count += 1;
        // Only a time at or above the estimate can move it, coming or going.
        if self.count <= RANK
            || time > self.estimate
            || (self.count > WINDOW && evicted >= self.estimate)
            || self.count == 2 * RANK
        {
            self.estimate = self.ranked();
        }
    }

    fn ranked(&self) -> TimeNs {
        let mut longest = [TimeNs(0); RANK];
        for &time in &self.window[..self.count.min(WINDOW)] {
            if time > longest[RANK - 1] {
                longest[RANK - 1] = time;
                longest.sort_unstable_by(|a, b| b.cmp(a));
            }
        }
        // With few frames the longest is the best guess.
        if self.count < 2 * RANK { longest[0] } else { longest[RANK - 1] }
    }
}
