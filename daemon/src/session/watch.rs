//! The control thread while a run goes on: takes note of what the other threads say, and tells people.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use holod_calibration::rig::Rig;
use holod_calibration::{Resolution, TimeNs};
use holod_model::engine::EngineError;
use holod_pupil_input::{Counter, DecisionTap, TrackerControl};
use holod_slm_output::laser::{BoxEvent, DarkReason};
use holod_slm_output::output::OutputCounts;
use holod_slm_output::{FieldEvent, OutputControl};

use super::clock::host_now;
use super::desk::Desk;
use super::feed_watch::{FeedSeen, FeedWatch};
use super::frame_loop::LoopRecord;
use super::laser_watch::LaserBoxWatch;
use super::output_watch::OutputWatch;
use super::rate_watch::RateWatch;
use super::service::{Hangups, Service, Signals};
use super::sleep::SleepWatch;
use super::state::{Condition, State};
use super::stats::FrameRate;
use super::tally::Tally;
use super::tracker_watch::TrackerWatch;
use crate::failure::{Exit, Failure};
use crate::frame_state::FrameState;
use crate::observer::Observer;
use crate::record::RecordHealth;
use crate::snapshot::{Figures, Snapshot};
use crate::source::feed::Feed;
use crate::source::scene::SceneFigures;
use crate::status::StatusFile;
use crate::{renderer, setup, speed};

const TICK: Duration = Duration::from_millis(10);
const TICKS_PER_REPORT: u32 = 10;
const TICKS_PER_STATUS: u32 = 100;
/// How long the end of a run waits for its last frame to be shown.
const LAST_FRAME_WAIT: TimeNs = TimeNs(1_000_000_000);
/// A state of the run that follows another line on it sooner than this is logged once it has held for so long: a
/// tracker that pauses or lasers that flicker must not flood the log.
const STATE_EVERY: TimeNs = TimeNs(10_000_000_000);
const STATE_HOLDS: TimeNs = TimeNs(1_000_000_000);

/// The control thread's view of a run.
pub(super) struct Watch<'a> {
    pub(super) rig: Rig,
    pub(super) names: Names,
    /// Frames of a record are made again.
    pub(super) plays: bool,
    pub(super) rings: Rings,
    pub(super) panel: OutputWatch,
    pub(super) laser_box: LaserBoxWatch,
    pub(super) tracker: TrackerControl,
    pub(super) tracker_watch: TrackerWatch,
    pub(super) feed: Option<Feed>,
    pub(super) feed_watch: FeedWatch,
    pub(super) record: Option<Arc<RecordHealth>>,
    pub(super) desk: Desk,
    pub(super) sleep: SleepWatch,
    pub(super) signals: Signals,
    pub(super) hangups: Option<Hangups>,
    pub(super) service: Service,
    pub(super) status: StatusFile,
    pub(super) t_origin: TimeNs,
    pub(super) announced: Announced,
    pub(super) tally: Tally,
    pub(super) frame_rate: FrameRate,
    /// In the last second.
    pub(super) frames_shown_hz: Option<f64>,
    pub(super) observer: &'a mut dyn Observer,
}

/// What the parts of a run are called.
pub(super) struct Names {
    pub(super) scene: String,
    /// Of a scene, and not of a feed.
    pub(super) scene_figures: Option<SceneFigures>,
    pub(super) tracker: String,
    pub(super) panel: String,
    /// How holograms are computed; another engine may take the place of the first.
    pub(super) engine: Arc<Mutex<String>>,
    pub(super) hologram: Resolution,
}

impl Names {
    fn engine(&self) -> String {
        self.engine.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// What the other threads say.
pub(super) struct Rings {
    pub(super) records: rtrb::Consumer<LoopRecord>,
    pub(super) fields: rtrb::Consumer<FieldEvent>,
    pub(super) fields_over: Vec<FieldEvent>,
    pub(super) box_events: rtrb::Consumer<BoxEvent>,
    pub(super) decisions: DecisionTap,
}

/// What has been said to people.
#[derive(Default)]
pub(super) struct Announced {
    /// What would bring more frames a second has been said.
    advised: bool,
    /// So has, of the weights in use, that much of a hologram is clipped.
    pub(super) clipped: bool,
    rate: RateWatch,
    state: State,
    text: String,
    text_since: TimeNs,
    logged: Option<(String, TimeNs)>,
    armed: bool,
}

impl Announced {
    pub(super) fn new(advised: bool) -> Self {
        Self { advised, ..Self::default() }
    }

    /// Logs how the run is where that has changed; whether it does.
    fn log_state(&mut self, now: TimeNs) -> bool {
        let is_due = self.logged.as_ref().is_none_or(|(logged, t_logged)| {
            *logged != self.text && (now - *t_logged >= STATE_EVERY || now - self.text_since >= STATE_HOLDS)
        });
        if is_due {
            tracing::info!("{}", self.text);
            self.logged = Some((self.text.clone(), now));
        }
        is_due
    }
}

/// When a run is over.
pub(super) struct Limits {
    pub(super) t_origin: TimeNs,
    pub(super) frames: Option<u64>,
    /// What has ended a run that made them all.
    pub(super) frames_over: &'static str,
    pub(super) duration: Option<Duration>,
    pub(super) replay_ends_run: bool,
}

impl Watch<'_> {
    /// Watches until something ends the run, and says what.
    pub(super) fn until_the_end(
        &mut self,
        limits: &Limits,
        output: &OutputControl,
        frame_thread: &JoinHandle<Result<(), EngineError>>,
    ) -> Result<String, Failure> {
        let mut t_give_up = None;
        let mut ticks = 0_u32;
        loop {
            std::thread::sleep(TICK);
            output.attend();
            let now = host_now();
            self.drain()?;
            if self.obey(output)? {
                return Ok("holod ctl stop".to_owned());
            }
            self.judge_feed(output, now);
            self.judge_sleep(output);
            if self.hangups.as_ref().is_some_and(Hangups::asked) {
                self.desk.reload();
            }
            let awaits_panel = self.panel.lost().is_some_and(|fault| fault.is_recoverable());
            self.service.progress(self.tally.frames_shown, awaits_panel, now);
            ticks = ticks.wrapping_add(1);
            if ticks.is_multiple_of(TICKS_PER_REPORT) {
                self.report(&output.counts(), now)?;
            }
            if ticks.is_multiple_of(TICKS_PER_STATUS) {
                self.frames_shown_hz = self.frame_rate.at(self.tally.frames_shown, now);
                self.write_status(&output.counts(), now);
                self.desk.keep_note();
            }
            self.signals.tell_of_suspension();
            if let Some(signal) = self.signals.caught() {
                return Ok(signal.to_owned());
            }
            if let Some(ended) = self.over(limits, now) {
                return Ok(ended.to_owned());
            }
            let switch = output.dark_switch();
            if switch.reason() == Some(DarkReason::Panic) {
                switch.wait_for_panic_message(host_now);
                return Err(Failure::new(Exit::Software, "a thread failed (its message stands above)"));
            }
            if let Some(fault) = self.panel.lost().filter(|fault| !fault.is_recoverable()) {
                return Err(Failure::new(Exit::Unavailable, format!("the panel: {fault}")));
            }
            if frame_thread.is_finished() {
                // What it said last, between the look at its ring above and its end.
                self.drain()?;
                let t_end = *t_give_up.get_or_insert(now + LAST_FRAME_WAIT);
                let is_whole = limits.frames.is_some_and(|frames| self.tally.frames_made >= frames);
                if !is_whole {
                    return Ok("the engine's failure".to_owned());
                }
                if self.tally.newest_frame_shown() || now >= t_end {
                    return Ok(limits.frames_over.to_owned());
                }
            }
        }
    }

    /// Puts the lasers out where the feed gives no pictures any more, and lets them be lit where it does again.
    pub(super) fn judge_feed(&mut self, output: &OutputControl, now: TimeNs) {
        let Some(feed) = &self.feed else { return };
        let pulse = feed.pulse();
        let seen = FeedSeen {
            is_live: pulse.is_live,
            is_paused: self.desk.is_paused(),
            has_pattern: self.desk.pattern().is_some(),
            t_newest: pulse.t_newest,
            t_in_hand: self.tally.t_picture_in_hand(),
            t_begun: self.tally.t_shown_begun(),
        };
        if !self.feed_watch.judge(seen, now) {
            return;
        }
        let acknowledged = output.keep_dark(self.dark_wish());
        if !self.feed_watch.keeps_dark() {
            let what = if seen.is_live && !seen.has_pattern { "gives pictures again" } else { "is not shown any more" };
            tracing::info!("the live feed {what}: lasers are lit by the rules");
        } else if acknowledged {
            tracing::warn!("{}", self.feed_trouble().unwrap_or_default());
        } else {
            tracing::error!(
                "{}, but the laser box did not acknowledge darkness: look at the lasers, and switch them off by hand",
                self.feed_trouble().unwrap_or_default()
            );
        }
        self.write_status(&output.counts(), now);
    }

    /// Puts the lasers out before the machine sleeps, and lets them be lit once it is awake.
    fn judge_sleep(&mut self, output: &OutputControl) {
        self.sleep.may_be_lit(self.dark_wish().is_none());
        if self.sleep.look() {
            let wish = self.dark_wish();
            self.sleep.told(wish, output.keep_dark(wish));
        }
    }

    /// Why lasers are to be kept dark, where they are: what a person asks for comes first.
    pub(super) fn dark_wish(&self) -> Option<DarkReason> {
        let feed = self.feed_watch.keeps_dark().then_some(DarkReason::NoPicture);
        self.desk.keeps_dark().then_some(DarkReason::Asked).or(self.sleep.keeps_dark()).or(feed)
    }

    /// Why the feed keeps lasers dark, where it does.
    fn feed_trouble(&self) -> Option<String> {
        let dark_after_s = self.feed_watch.dark_after().filter(|_| self.feed_watch.keeps_dark())?.seconds();
        let shown = self.feed.as_ref().and_then(Feed::shown);
        let whose = shown.map_or("the live feed".to_owned(), |name| format!("the feed's client `{name}`"));
        Some(format!("lasers dark: {whose} has given no new picture for {dark_after_s} s (--feed-dark-after)"))
    }

    /// Which limit has been reached.
    fn over(&self, limits: &Limits, now: TimeNs) -> Option<&'static str> {
        let lasted =
            |duration: Duration| (now - limits.t_origin).0 >= i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX);
        if limits.duration.is_some_and(lasted) {
            return Some("the asked duration");
        }
        let replayed = limits.replay_ends_run && self.tracker.finished() && self.tally.frames_shown > 0;
        replayed.then_some("the end of the pupil log")
    }

    /// Takes note of everything that the other threads have said.
    ///
    /// A frame's record is written before the frame is submitted, so the records of all fields that are taken first are
    /// there when records are taken next.
    pub(super) fn drain(&mut self) -> Result<(), Failure> {
        let Rings { records, fields, fields_over, box_events, decisions } = &mut self.rings;
        while let Ok(event) = fields.pop() {
            fields_over.push(event);
        }
        while let Ok(record) = records.pop() {
            self.tally.frame(&record);
            if !self.announced.clipped
                && let Some(fault) = renderer::clipping_fault(record.clipped_share)
            {
                self.announced.clipped = true;
                tracing::warn!("{fault}");
            }
            tracing::trace!("{:?}", record.frame);
            self.observer.frame(&record.frame)?;
        }
        while let Ok(event) = box_events.pop() {
            self.tally.lasers.box_event(&event);
            if let BoxEvent::Dark { t, reason } = event {
                self.panel.went_dark(t, reason);
            }
        }
        self.panel.drain();
        for event in fields_over.drain(..) {
            if let Some(warning) = self.panel.judge_field(&event) {
                tracing::warn!("{warning}");
            }
            if let Some(light) = self.tally.field(&event) {
                self.observer.first_light(&light);
            }
            self.observer.field(&event)?;
        }
        while let Some(decision) = decisions.pop() {
            self.tracker_watch.note(&decision);
            tracing::trace!("{decision:?}");
            self.observer.decision(&decision)?;
        }
        Ok(())
    }

    /// What is looked at ten times a second.
    fn report(&mut self, output: &OutputCounts, now: TimeNs) -> Result<(), Failure> {
        let is_new = self.tell_state(output, now);
        if is_new | (std::mem::replace(&mut self.announced.armed, output.armed) != output.armed) {
            self.write_status(output, now);
        }
        self.tell_rate(now);
        self.tracker_watch.look(&mut self.tracker, now);
        self.judge_recording();
        if let Some(warning) = self.panel.judge_rate(output.refresh_hz, now) {
            tracing::warn!("{warning}");
        }
        self.laser_box.drain(output.armed, now);
        self.desk.tidy();
        self.observer.tick()
    }

    /// Gives the record up where the tracker's part of it cannot be written any more.
    pub(super) fn judge_recording(&self) {
        let failure = self.tracker.recording().and_then(|recording| recording.failure);
        if let (Some(record), Some(failure)) = (&self.record, failure) {
            record.give_up(&format!("cannot go on {failure}"));
        }
    }

    /// Says how the run is, where that has changed; whether it has.
    fn tell_state(&mut self, output: &OutputCounts, now: TimeNs) -> bool {
        let condition = Condition {
            is_lit: output.armed && self.tally.frames_shown > 0 && self.panel.unlit().is_none(),
            plays: self.plays,
            link: self.tracker.link(),
            pupil: self.tally.newest_state,
            record_lost: self.record.as_ref().is_some_and(|record| record.is_lost()),
        };
        self.announced.state = condition.state();
        let text = condition.text();
        let is_new = text != self.announced.text;
        if is_new {
            self.service.status(&text);
            (self.announced.text, self.announced.text_since) = (text, now);
        }
        self.announced.log_state(now);
        is_new
    }

    /// Says once how many frames a second are really reached.
    fn tell_rate(&mut self, now: TimeNs) {
        if self.panel.lost().is_some() {
            self.announced.rate.begin_anew();
            return;
        }
        let Some(reached_hz) = self.announced.rate.reached_hz(self.tally.frames_shown, now) else { return };
        let panel_hz = speed::panel_frames_hz(&self.rig.panel);
        let reached = format!("{reached_hz:.2} frames a second are shown, of the panel's {panel_hz:.1}");
        match self.speed_advice().filter(|_| !self.announced.advised) {
            None => tracing::info!("{reached}"),
            Some(advice) => tracing::warn!("{reached}: {advice}"),
        }
    }

    /// What would bring more frames a second, where the time that they take is too long.
    fn speed_advice(&self) -> Option<String> {
        let frame_time = TimeNs::from_seconds(f64::from(self.tally.frame_time.spread()?.median_ms) / 1e3);
        let frames_hz = speed::shown_hz(frame_time, &self.rig.panel);
        speed::advice(frames_hz, &self.names.engine(), &self.rig, self.names.hologram)
    }

    pub(super) fn write_status(&mut self, output: &OutputCounts, now: TimeNs) {
        let snapshot = self.snapshot(output, now);
        self.status.write(&snapshot, now);
        self.observer.snapshot(&snapshot);
        let counters = self.tracker.counters();
        tracing::debug!(
            "{}; {} samples, {} rejected",
            snapshot.in_short(),
            counters.of(Counter::Samples),
            counters.rejected_in_all()
        );
    }

    /// What can be said of the run now.
    pub(super) fn snapshot(&self, output: &OutputCounts, now: TimeNs) -> Snapshot {
        Snapshot {
            pid: std::process::id(),
            state: self.announced.state.name().to_owned(),
            uptime_s: (now - self.t_origin).seconds(),
            control: self.desk.socket(),
            orders_refused: self.desk.refused(),
            eye: self.rig.tracker.eye.name().to_owned(),
            paused: self.desk.is_paused(),
            lasers_kept_dark: self.desk.keeps_dark(),
            pattern: self.desk.pattern().map(str::to_owned),
            frames_shown_hz: self.frames_shown_hz,
            pupil_state: self.tally.newest_state.map_or("", FrameState::name).to_owned(),
            pupil_mm: self.tally.newest_pupil().map(|pupil| pupil.mm()),
            panel: self.names.panel.clone(),
            panel_trouble: self.panel.lost().map(|fault| fault.to_string()),
            lasers: if output.armed { "armed" } else { "dark" }.to_owned(),
            lasers_trouble: self.laser_box.trouble().map(str::to_owned),
            unlit: self.panel.unlit(),
            feed_trouble: self.feed_trouble(),
            figures: self.figures(output, now),
        }
    }

    /// What holds of the run now, and at its end.
    pub(super) fn figures(&self, output: &OutputCounts, now: TimeNs) -> Figures {
        let Self { tally, names, .. } = self;
        let frame_time = tally.frame_time.spread();
        Figures {
            rig: self.rig.name.clone(),
            scene: names.scene.clone(),
            scene_figures: names.scene_figures,
            weights: setup::weights_name(&self.rig.model.weights),
            tracker: names.tracker.clone(),
            engine: names.engine(),
            hologram: names.hologram.to_string(),
            frames_made: tally.frames_made,
            frames_computed: tally.frames_computed,
            frames_shown: tally.frames_shown,
            deadline_misses: tally.deadline_misses,
            panel_frames_hz: speed::panel_frames_hz(&self.rig.panel),
            panel_refresh_hz: output.refresh_hz,
            speed_advice: self.speed_advice(),
            frame_time,
            sample_to_photon: tally.sample_to_photon.spread(),
            picture_to_photon: tally.picture_to_photon.spread(),
            tracker_link: self.tracker.link().name().to_owned(),
            tracker_trouble: self.tracker_watch.trouble(),
            tracker_counts: self.tracker.counters().entries().collect(),
            feed: self.feed.as_ref().map(|feed| feed.status(now)),
            record: self.record.as_ref().map(|record| record.state()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At how many of the times, ten a second for a minute, a state is logged that changes every `changes` of them.
    fn logged(changes: usize) -> usize {
        let mut announced = Announced::new(false);
        let times = (0..600).filter(|look| {
            let now = TimeNs(*look as i64 * 100_000_000);
            if look % changes == 0 {
                (announced.text, announced.text_since) = (format!("state {}", look / changes % 2), now);
            }
            announced.log_state(now)
        });
        times.count()
    }

    #[test]
    fn states_that_hold_are_logged_at_once_and_those_that_flicker_now_and_then() {
        assert_eq!(logged(600), 1);
        assert_eq!(logged(150), 4);
        assert_eq!(logged(20), 30, "each once it has held for a second");
        assert!((4..=7).contains(&logged(3)), "{}", logged(3));
    }
}
