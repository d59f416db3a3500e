//! One run of the whole loop: starts the threads, watches them, takes them down in the right order.

mod frame_loop;
mod keep;
mod laser_watch;
mod ledger;
mod output_watch;
mod rate_watch;
mod scheduling;
mod service;
mod stats;
mod tracker_watch;

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use holod_calibration::rig::Rig;
use holod_calibration::{PupilDiameter, Resolution, TimeNs};
use holod_model::Weights;
use holod_model::engine::EngineError;
use holod_pupil_input::{
    Counter, Decision, DecisionTap, Link, PupilState, RecordFiles, ReplayError, ReplaySpeed, SourceError, Tracker,
    TrackerControl, TrackerError, TrackerOptions, TrackerSpec,
};
use holod_slm_output::laser::{BoxEvent, DarkReason, open_laser};
use holod_slm_output::output::{OutputCounts, OutputError, pacing_config};
use holod_slm_output::present::{PanelSetup, open_panel};
use holod_slm_output::{
    FieldEvent, LevelsFrame, Output, OutputControl, OutputOptions, OutputSpec, Pacer, PanelEncoder,
};
use serde::Serialize;

use self::frame_loop::{FrameLoop, LoopRecord, TrainedPupils};
use self::keep::{KEEP_SLOTS, keep_slot};
use self::laser_watch::LaserBoxWatch;
use self::ledger::LaserLedger;
use self::output_watch::OutputWatch;
use self::rate_watch::RateWatch;
use self::service::Service;
use self::stats::{FrameRate, Recent};
use self::tracker_watch::TrackerWatch;
use crate::cli::Backend;
use crate::failure::{Exit, Failure};
use crate::progress;
use crate::record::{FieldRecord, FrameRecord};
use crate::renderer::{self, Renderer};
use crate::setup::{self, Frames};
use crate::speed;
use crate::status::{Status, StatusFile};

#[cfg(feature = "fault-injection")]
use crate::fault::host_now;
#[cfg(not(feature = "fault-injection"))]
use holod_pupil_input::host_now;

pub use self::ledger::LaserSummary;
pub(crate) use self::service::Signals;
pub use self::stats::Spread;

/// What to run.
pub struct SessionPlan {
    /// The bench.
    pub rig: Rig,
    /// The network.
    pub weights: Weights,
    /// Which engine runs it.
    pub backend: Backend,
    /// What to show.
    pub frames: Frames,
    /// Where to show it.
    pub output: OutputSpec,
    /// Where samples come from.
    pub tracker: TrackerSpec,
    /// Where the tracker's bytes and samples are written down.
    pub record_tracker: Option<RecordFiles>,
    /// Stop after so many frames.
    pub frame_limit: Option<u64>,
    /// Stop after so long.
    pub duration: Option<Duration>,
    /// Keep the levels that the panel showed, the newest for each half millimetre of pupil.
    pub keep_levels: bool,
}

/// Hears of everything in the run, on the control thread.
pub trait Observer {
    /// A frame was made.
    fn frame(&mut self, _record: &FrameRecord) -> Result<(), Failure> {
        Ok(())
    }
    /// A field was shown and is over.
    fn field(&mut self, _event: &FieldEvent) -> Result<(), Failure> {
        Ok(())
    }
    /// The gate decided on a sample.
    fn decision(&mut self, _decision: &Decision) -> Result<(), Failure> {
        Ok(())
    }
    /// About ten times a second.
    fn tick(&mut self) -> Result<(), Failure> {
        Ok(())
    }
}

/// What the run came to.
pub struct SessionReport {
    /// Everything that can be said in numbers.
    pub summary: Summary,
    /// When the run began.
    pub t_origin: TimeNs,
    /// Levels that the panel showed, with the pupil that each frame was made for, narrowest first.
    pub shown: Vec<(PupilDiameter, LevelsFrame)>,
    /// Turns levels back into phase.
    pub encoder: Arc<PanelEncoder>,
}

/// The numbers of a run; `summary.json`.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Why the run ended.
    pub ended_by: String,
    /// How long it ran.
    pub duration_s: f64,
    /// The rig's name.
    pub rig: String,
    /// The scene's name.
    pub scene: String,
    /// The tracker spec.
    pub tracker: String,
    /// How holograms were computed at the end.
    pub engine: String,
    /// Hologram size in pixels.
    pub hologram: String,
    /// Frames that were made.
    pub frames_made: u64,
    /// Of those, frames that came on the panel.
    pub frames_shown: u64,
    /// Colour fields that the panel showed, repetitions included.
    pub fields_shown: u64,
    /// Fields of a frame that had been shown before.
    pub fields_repeated: u64,
    /// Frames that came on the panel a second, over the whole run.
    pub frames_shown_hz: f64,
    /// Frames of all colours that the panel could show in a second.
    pub panel_frames_hz: f64,
    /// What would bring the first of these two nearer to the second, where that is needed.
    pub speed_advice: Option<String>,
    /// Refreshes of the panel a second, as it reported them; 0 where it reported none.
    pub panel_refresh_hz: f64,
    /// Frames that came on the panel later than planned.
    pub deadline_misses: u64,
    /// From waking to the submitted levels.
    pub frame_time: Option<Spread>,
    /// From the newest tracker sample behind a frame to the middle of its first light.
    pub sample_to_photon: Option<Spread>,
    /// Frames by the pupil estimator's state.
    pub frames_by_pupil_state: BTreeMap<&'static str, u64>,
    /// The narrowest and the widest pupil that a frame was made for.
    pub pupil_range_mm: Option<[f32; 2]>,
    /// Frames whose pupil lay outside those that the network was trained for on this bench: it was told the nearest.
    pub frames_beyond_trained_pupils: u64,
    /// Why the tracker's link did not come back, or why nothing that it sent was believed, at the end.
    pub tracker_trouble: Option<String>,
    /// How the tracker's link was at the end.
    pub tracker_link: &'static str,
    /// Samples and log rows that were not believed, for any reason.
    pub samples_rejected: u64,
    /// Counters of the tracker: samples, connections, rejections by reason.
    pub tracker_counts: BTreeMap<String, u64>,
    /// How much slower the tracker's clock ran than the host's, parts per million.
    pub tracker_clock_drift_ppm: Option<f64>,
    /// Pieces of the tracker's bytes and decisions on its samples that the recording lost.
    pub tracker_records_lost: u64,
    /// Largest share of a frame's amplitudes that the double phase clipped.
    pub clipped_share_max: f32,
    /// Largest share of a frame's phases that the panel cannot reach.
    pub unreachable_share_max: f32,
    /// What the lasers did.
    pub lasers: LaserSummary,
    /// The lasers acknowledged darkness before the end.
    pub lasers_dark_at_end: bool,
    /// Why they did not, where they did not: they are left to the box's own heartbeat timeout, if it has one.
    pub lasers_not_dark: Option<String>,
    /// A flat pattern was on the panel at the end.
    pub flat_at_end: bool,
    /// Records that were lost because the control thread was late.
    pub records_lost: u64,
}

const TICK: Duration = Duration::from_millis(10);
const TICKS_PER_REPORT: u32 = 10;
const TICKS_PER_STATUS: u32 = 100;
/// Frame records on their way to the control thread.
const RECORDS: usize = 1024;
/// Lasers go dark when one frame has stayed on the panel for so many frame times, within these limits.
const STALL_FRAMES: i64 = 6;
const STALL_TIMEOUT_MIN: TimeNs = TimeNs(2_000_000_000);
const STALL_TIMEOUT_MAX: TimeNs = TimeNs(10_000_000_000);
/// A first frame that takes longer is not made twice to be timed.
const LONG_FRAME: TimeNs = TimeNs(5_000_000_000);
/// How long the end of a run waits for its last frame to be shown.
const LAST_FRAME_WAIT: TimeNs = TimeNs(1_000_000_000);

/// The daemon's state, as `systemctl status` shows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Dark,
    Running,
    Degraded,
}

impl State {
    const fn name(self) -> &'static str {
        match self {
            Self::Dark => "dark",
            Self::Running => "running",
            Self::Degraded => "degraded",
        }
    }
}

/// Runs until a limit, a signal or a failure ends it; lasers are dark when it returns.
///
/// # Errors
/// What could not be started, or the observer's failure; in both cases everything has been taken down.
pub fn run(plan: SessionPlan, observer: &mut dyn Observer) -> Result<SessionReport, Failure> {
    let signals = Signals::install()?;
    #[cfg(feature = "fault-injection")]
    crate::fault::install()?;
    let resolution = plan.frames.resolution();
    let rig = &plan.rig;
    let encoder = progress::during(&format!("preparing the levels of the panel of {}", rig.resolution()), || {
        renderer::panel_encoder(rig, resolution)
    })?;
    let (renderer, frame_time) = progress::during(&format!("preparing the network for {resolution}"), || {
        let mut renderer =
            scheduling::patient(|| renderer::open(plan.backend, &plan.weights, &rig.geometry, &encoder))?;
        let frame_time = first_frame_time(&mut *renderer, &plan, LevelsFrame::new(encoder.layout()))?;
        Ok::<_, Failure>((renderer, frame_time))
    })?;
    tracing::info!("holograms are computed by {}", renderer.description());
    let engine = Arc::new(Mutex::new(renderer.description().to_owned()));
    let panel_hz = speed::panel_frames_hz(&rig.panel);
    let first_hz = 1.0 / frame_time.seconds();
    let first_frame = format!(
        "a frame takes {:.0} ms, so about {first_hz:.2} frames a second of the panel's {panel_hz:.1}",
        frame_time.seconds() * 1e3
    );
    let advice = speed::advice(first_hz, rig, resolution);
    match &advice {
        None => tracing::info!("{first_frame}"),
        Some(advice) => tracing::warn!("{first_frame}: {advice}"),
    }
    let pacing = pacing_config(rig, frame_time).map_err(Failure::because(Exit::Config))?;
    let t_origin = host_now();
    let tracker_options = TrackerOptions {
        origin: t_origin,
        record: plan.record_tracker.clone(),
        forbidden: setup::ports_of_others(rig),
    };
    let (estimates, tap, tracker) = scheduling::prompt(|| Tracker::start(&plan.tracker, &rig.tracker, tracker_options))
        .map_err(tracker_failure)?
        .split();
    for warning in tracker.warnings() {
        tracing::warn!("{warning}");
    }
    tracing::debug!("tracker `{}` is open, link {}", plan.tracker, tracker.link().name());
    let options = OutputOptions {
        keep_slots: if plan.keep_levels { KEEP_SLOTS } else { 0 },
        stall_timeout: rig.lasers.stall_timeout.unwrap_or_else(|| stall_timeout(frame_time)),
    };
    let output = progress::during("opening panel and lasers", || {
        scheduling::prompt(|| open_output(&plan, &encoder, options)).map_err(Failure::because(Exit::Unavailable))
    })?;
    tracing::debug!("panel `{}` is open; lasers by {:?}", plan.output, rig.lasers.driver);
    output.control.dark_switch().install_panic_hook(host_now, holod_model::gpu::panic_is_caught);

    let stop = Arc::new(AtomicBool::new(false));
    let (record_producer, records) = rtrb::RingBuffer::new(RECORDS);
    let frames = Arc::new(plan.frames);
    let frame_loop = FrameLoop {
        pupil: estimates,
        renderer,
        port: output.frames,
        pacer: Pacer::new(pacing, host_now()),
        frames: Arc::clone(&frames),
        trained: TrainedPupils::of(plan.weights.trained_pupils(&rig.geometry)),
        t_origin,
        records: record_producer,
        records_lost: Arc::new(AtomicU64::new(0)),
        keep_levels: plan.keep_levels,
        limit: plan.frame_limit,
        engine: Arc::clone(&engine),
        stop: Arc::clone(&stop),
    };
    let records_lost = Arc::clone(&frame_loop.records_lost);
    let frame_thread = std::thread::Builder::new()
        .name("holod-frame".into())
        .spawn(move || frame_loop.run())
        .map_err(Failure::because(Exit::Unavailable))?;
    // A log that is played in no time says nothing of when a run is over that was asked to last.
    let is_bounded = plan.frame_limit.is_some() || plan.duration.is_some();
    let replay_ends_run = match &plan.tracker {
        TrackerSpec::Replay { repeat: true, .. } => false,
        TrackerSpec::Replay { speed: ReplaySpeed::Fastest, .. } => !is_bounded,
        TrackerSpec::Replay { .. } => true,
        TrackerSpec::Path(path) => path.is_file(),
        _ => false,
    };

    let mut watch = Watch {
        records,
        events: output.events,
        fields_over: Vec::new(),
        box_events: output.box_events,
        output: OutputWatch::new(output.panel_events, rig.panel.refresh_hz),
        laser_box: LaserBoxWatch::new(output.laser_faults, output.laser_watch),
        tracker_watch: TrackerWatch::new(&rig.tracker, t_origin),
        rate: RateWatch::default(),
        advised: advice.is_some(),
        resolution,
        tap,
        tracker,
        signals,
        service: Service::connect(),
        status: StatusFile::create(),
        rig,
        spec: plan.tracker.to_string(),
        engine: Arc::clone(&engine),
        panel: plan.output.to_string(),
        frame_rate: FrameRate::default(),
        t_origin,
        state: State::Dark,
        told: String::new(),
        tally: Tally::default(),
        observer,
    };
    let limits = Limits { t_origin, frames: plan.frame_limit, duration: plan.duration, replay_ends_run };
    let ended = watch.until_the_end(&limits, &output.control, &frame_thread);

    watch.service.stopping();
    tracing::info!("stopping: {}", ended.as_deref().unwrap_or("a failure"));
    stop.store(true, Ordering::Release);
    let down = output.control.shutdown();
    let frame_loop = frame_thread.join();
    let tracker_link = watch.tracker.link().name();
    watch.tracker.stop();
    let observed = watch.drain();
    watch.laser_box.drain(false);
    let lasers_not_dark = (!down.lasers_dark).then(|| {
        let silent = "the laser box did not acknowledge in time";
        watch.laser_box.trouble().unwrap_or(silent).to_owned()
    });
    watch.tracker_watch.judge(&watch.tracker, host_now());
    let Watch { tracker, tally, tracker_watch, .. } = watch;
    let recorded = tracker.recording();
    if let Some(failure) = recorded.as_ref().and_then(|status| status.failure.as_deref()) {
        tracing::error!("the tracker's recording is not whole: {failure}");
    }
    if let Some(why) = &lasers_not_dark
        && (ended.is_err() || observed.is_err() || !matches!(frame_loop, Ok(Ok(()))))
    {
        tracing::error!("{}", not_dark(why));
    }
    let ended_by = ended?;
    observed?;
    match frame_loop {
        Err(_panic) => return Err(Failure::new(Exit::Software, "the frame loop failed (its message stands above)")),
        Ok(rendered) => rendered.map_err(Failure::because(Exit::Unavailable))?,
    }

    if tally.frames_shown == 0 {
        tracing::warn!("no frame was shown: the run ended before the first one was ready; give it longer");
    }
    let mut shown: Vec<(PupilDiameter, LevelsFrame)> = down
        .kept
        .into_iter()
        .flatten()
        .filter_map(|levels| Some((tally.pupil_of_kept(levels.tag().frame_id)?, levels)))
        .collect();
    shown.sort_by(|(a, _), (b, _)| a.mm().total_cmp(&b.mm()));
    let duration_s = (host_now() - t_origin).seconds();
    let summary = Summary {
        ended_by,
        duration_s,
        rig: plan.rig.name.clone(),
        scene: frames.name.clone(),
        tracker: plan.tracker.to_string(),
        engine: engine.lock().unwrap_or_else(PoisonError::into_inner).clone(),
        hologram: resolution.to_string(),
        frames_made: tally.frames_made,
        frames_shown: tally.frames_shown,
        fields_shown: tally.fields_shown,
        fields_repeated: tally.fields_repeated,
        frames_shown_hz: tally.frames_shown as f64 / duration_s,
        panel_frames_hz: panel_hz,
        speed_advice: tally
            .frame_time
            .spread()
            .and_then(|time| speed::advice(1e3 / f64::from(time.median_ms), &plan.rig, resolution)),
        panel_refresh_hz: down.counts.refresh_hz,
        deadline_misses: tally.deadline_misses,
        frame_time: tally.frame_time.spread(),
        sample_to_photon: tally.sample_to_photon.spread(),
        frames_by_pupil_state: tally.by_state,
        pupil_range_mm: tally.pupil_range_mm,
        frames_beyond_trained_pupils: tally.beyond_trained,
        tracker_trouble: tracker_watch.trouble(),
        tracker_link,
        samples_rejected: tracker.counters().rejected_in_all() + tracker.counters().faults_in_all(),
        tracker_counts: tracker.counters().entries().collect(),
        tracker_clock_drift_ppm: tracker.clock().map(|clock| clock.drift_ppm),
        tracker_records_lost: recorded.as_ref().map_or(0, |status| status.chunks_lost + status.decisions_lost),
        clipped_share_max: tally.clipped_share_max,
        unreachable_share_max: tally.unreachable_share_max,
        lasers: tally.lasers.finish(),
        lasers_dark_at_end: down.lasers_dark,
        lasers_not_dark,
        flat_at_end: down.flat_presented,
        records_lost: down.counts.lost + records_lost.load(Ordering::Relaxed),
    };
    Ok(SessionReport { summary, t_origin, shown, encoder })
}

fn open_output(plan: &SessionPlan, encoder: &PanelEncoder, options: OutputOptions) -> Result<Output, OutputError> {
    let rig = &plan.rig;
    let panel = open_panel(&plan.output, &PanelSetup::new(&rig.panel, encoder), host_now())?;
    #[cfg(feature = "fault-injection")]
    let panel = Box::new(crate::fault::FaultyPanel(panel));
    let laser = open_laser(&rig.lasers, host_now)?;
    Output::start(rig, encoder, panel, laser, options, host_now)
}

/// How long a frame takes, measured before anything is shown: the second one, unless the first took very long. A GPU's
/// driver still prepares things while it does the first.
fn first_frame_time(
    renderer: &mut dyn Renderer,
    plan: &SessionPlan,
    mut levels: LevelsFrame,
) -> Result<TimeNs, Failure> {
    let [pupil, _] = plan.weights.trained_pupils(&plan.rig.geometry);
    let mut time = || {
        let began = host_now();
        renderer.render(&plan.frames.frames[0], pupil, &mut levels).map_err(Failure::because(Exit::Unavailable))?;
        Ok(host_now() - began)
    };
    let first = time()?;
    if first > LONG_FRAME { Ok(first) } else { time() }
}

/// What a person must do where a laser box did not acknowledge darkness, for the reason `why`.
pub fn not_dark(why: &str) -> String {
    format!("the lasers did not acknowledge darkness at the end: {why}; look at them, and switch them off by hand")
}

fn stall_timeout(frame_time: TimeNs) -> TimeNs {
    TimeNs(STALL_FRAMES * frame_time.0).clamp(STALL_TIMEOUT_MIN, STALL_TIMEOUT_MAX)
}

/// When a run is over.
struct Limits {
    t_origin: TimeNs,
    frames: Option<u64>,
    duration: Option<Duration>,
    replay_ends_run: bool,
}

/// The control thread's view of a run.
struct Watch<'a> {
    records: rtrb::Consumer<LoopRecord>,
    events: rtrb::Consumer<FieldEvent>,
    fields_over: Vec<FieldEvent>,
    box_events: rtrb::Consumer<BoxEvent>,
    output: OutputWatch,
    laser_box: LaserBoxWatch,
    tracker_watch: TrackerWatch,
    rate: RateWatch,
    /// What would bring more frames a second has been said.
    advised: bool,
    resolution: Resolution,
    tap: DecisionTap,
    tracker: TrackerControl,
    signals: Signals,
    service: Service,
    status: StatusFile,
    rig: &'a Rig,
    spec: String,
    engine: Arc<Mutex<String>>,
    panel: String,
    frame_rate: FrameRate,
    t_origin: TimeNs,
    state: State,
    /// What was said last of the states.
    told: String,
    tally: Tally,
    observer: &'a mut dyn Observer,
}

impl Watch<'_> {
    /// Watches until something ends the run, and says what.
    fn until_the_end(
        &mut self,
        limits: &Limits,
        output: &OutputControl,
        frame_thread: &JoinHandle<Result<(), EngineError>>,
    ) -> Result<String, Failure> {
        let mut t_give_up = None;
        let mut ticks = 0_u32;
        loop {
            std::thread::sleep(TICK);
            let now = host_now();
            self.drain()?;
            self.service.progress(self.tally.frames_shown, now);
            ticks = ticks.wrapping_add(1);
            if ticks.is_multiple_of(TICKS_PER_REPORT) {
                self.tell_state(output);
                self.tell_rate(now);
                self.tracker_watch.look(&mut self.tracker, now)?;
                self.output.judge_rate(&output.counts(), now);
                self.laser_box.drain(output.counts().armed);
                self.observer.tick()?;
            }
            if ticks.is_multiple_of(TICKS_PER_STATUS) {
                let status = self.status_at(now, &output.counts());
                self.status.write(&status);
                tracing::debug!(
                    "{}: {} frames made, {} shown, {:.1} a second; pupil {:?} mm, {}; {} samples, {} rejected; lasers {}",
                    status.state,
                    status.frames_made,
                    status.frames_shown,
                    status.frames_shown_hz,
                    status.pupil_mm,
                    status.pupil_state,
                    self.tracker.counters().of(Counter::Samples),
                    self.tracker.counters().rejected_in_all(),
                    status.lasers
                );
            }
            if let Some(signal) = self.signals.caught() {
                return Ok(signal.to_owned());
            }
            if limits.duration.is_some_and(|duration| {
                (now - limits.t_origin).0 >= i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
            }) {
                return Ok("the asked duration".to_owned());
            }
            if limits.replay_ends_run && self.tracker.finished() && self.tally.frames_shown > 0 {
                return Ok("the end of the pupil log".to_owned());
            }
            if output.dark_switch().reason() == Some(DarkReason::Panic) {
                return Err(Failure::new(Exit::Software, "a thread failed (its message stands above)"));
            }
            if let Some(fault) = self.output.lost().filter(|fault| !fault.is_recoverable()) {
                return Err(Failure::new(Exit::Unavailable, format!("the panel: {fault}")));
            }
            if frame_thread.is_finished() {
                let t_end = *t_give_up.get_or_insert(now + LAST_FRAME_WAIT);
                let is_whole = limits.frames.is_some_and(|frames| self.tally.frames_made >= frames);
                if !is_whole {
                    return Ok("the engine's failure".to_owned());
                }
                if self.tally.newest_frame_shown() || now >= t_end {
                    return Ok("the asked number of frames".to_owned());
                }
            }
        }
    }

    /// Takes note of everything that the other threads have said.
    ///
    /// A frame's record is written before the frame is submitted, so the records of all fields that are taken first are
    /// there when records are taken next.
    fn drain(&mut self) -> Result<(), Failure> {
        while let Ok(event) = self.events.pop() {
            self.fields_over.push(event);
        }
        while let Ok(record) = self.records.pop() {
            self.tally.frame(&record);
            tracing::trace!("{:?}", record.frame);
            self.observer.frame(&record.frame)?;
        }
        while let Ok(event) = self.box_events.pop() {
            self.tally.lasers.box_event(&event);
            if let BoxEvent::Dark { t, reason } = event {
                self.output.went_dark(t, reason);
            }
        }
        self.output.drain();
        for event in self.fields_over.drain(..) {
            self.tally.field(&event);
            self.observer.field(&event)?;
        }
        while let Some(decision) = self.tap.pop() {
            self.tracker_watch.note(&decision);
            tracing::trace!("{decision:?}");
            self.observer.decision(&decision)?;
        }
        Ok(())
    }

    fn tell_state(&mut self, output: &OutputControl) {
        let lit = output.counts().armed && self.tally.frames_shown > 0;
        let link = self.tracker.link();
        let follows = link == Link::Up && self.tally.newest_state != PupilState::Fallback.name();
        let state = match (lit, follows) {
            (false, _) => State::Dark,
            (true, false) => State::Degraded,
            (true, true) => State::Running,
        };
        self.state = state;
        // A blink is no news; what the pupil falls back to is.
        let pupil = match self.tally.newest_state {
            "" => "not known yet",
            fallback if fallback == PupilState::Fallback.name() => fallback,
            _ => "followed",
        };
        let text = format!("{}: tracker {}, pupil {pupil}", state.name(), link.name());
        if text != self.told {
            tracing::info!("{text}");
            self.service.status(&text);
            self.told = text;
        }
    }

    /// Says once how many frames a second are really reached.
    fn tell_rate(&mut self, now: TimeNs) {
        let Some(reached_hz) = self.rate.reached_hz(self.tally.frames_shown, now) else { return };
        let panel_hz = speed::panel_frames_hz(&self.rig.panel);
        let reached = format!("{reached_hz:.2} frames a second are shown, of the panel's {panel_hz:.1}");
        match speed::advice(reached_hz, self.rig, self.resolution).filter(|_| !self.advised) {
            None => tracing::info!("{reached}"),
            Some(advice) => tracing::warn!("{reached}: {advice}"),
        }
    }
}

impl Watch<'_> {
    fn status_at(&mut self, now: TimeNs, output: &OutputCounts) -> Status {
        let frames_hz = self.frame_rate.at(self.tally.frames_shown, now);
        let tally = &self.tally;
        Status {
            pid: std::process::id(),
            state: self.state.name().to_owned(),
            uptime_s: (now - self.t_origin).seconds(),
            rig: self.rig.name.clone(),
            tracker: self.spec.clone(),
            tracker_link: self.tracker.link().name().to_owned(),
            tracker_trouble: self.tracker_watch.trouble(),
            pupil_state: tally.newest_state.to_owned(),
            pupil_mm: tally.recent.back().map(|frame| frame.pupil.mm()),
            engine: self.engine.lock().unwrap_or_else(PoisonError::into_inner).clone(),
            panel: self.panel.clone(),
            panel_trouble: self.output.lost().map(|fault| fault.to_string()),
            panel_refresh_hz: output.refresh_hz,
            lasers: if output.armed { "armed" } else { "dark" }.to_owned(),
            lasers_trouble: self.laser_box.trouble().map(str::to_owned),
            frames_made: tally.frames_made,
            frames_shown: tally.frames_shown,
            frames_shown_hz: frames_hz,
            panel_frames_hz: speed::panel_frames_hz(&self.rig.panel),
            speed_advice: tally
                .frame_time
                .spread()
                .and_then(|time| speed::advice(1e3 / f64::from(time.median_ms), self.rig, self.resolution)),
            deadline_misses: tally.deadline_misses,
            frame_time: tally.frame_time.spread(),
            sample_to_photon: tally.sample_to_photon.spread(),
            tracker_counts: self.tracker.counters().entries().collect(),
        }
    }
}

/// Frames whose fields may still come: all that the ring of records can hold at once, and some more.
const REMEMBERED: usize = RECORDS + 64;

/// Running numbers of a run.
#[derive(Default)]
struct Tally {
    recent: VecDeque<FrameRecord>,
    kept: [Option<(u64, PupilDiameter)>; KEEP_SLOTS],
    lasers: LaserLedger,
    frames_made: u64,
    frames_shown: u64,
    fields_shown: u64,
    fields_repeated: u64,
    deadline_misses: u64,
    newest_made: u64,
    newest_shown: u64,
    newest_state: &'static str,
    frame_time: Recent,
    sample_to_photon: Recent,
    by_state: BTreeMap<&'static str, u64>,
    pupil_range_mm: Option<[f32; 2]>,
    beyond_trained: u64,
    clipped_share_max: f32,
    unreachable_share_max: f32,
}

impl Tally {
    fn frame(&mut self, record: &LoopRecord) {
        let frame = &record.frame;
        self.frames_made += 1;
        self.newest_made = frame.frame;
        self.newest_state = frame.pupil_state;
        *self.by_state.entry(frame.pupil_state).or_default() += 1;
        self.frame_time.push((frame.t_submit - frame.t_wake).seconds() as f32 * 1e3);
        let pupil_mm = frame.pupil.mm();
        self.beyond_trained += u64::from(record.beyond_trained);
        let [narrowest, widest] = self.pupil_range_mm.unwrap_or([pupil_mm; 2]);
        self.pupil_range_mm = Some([narrowest.min(pupil_mm), widest.max(pupil_mm)]);
        self.clipped_share_max = self.clipped_share_max.max(record.clipped_share);
        self.unreachable_share_max = self.unreachable_share_max.max(record.unreachable_share);
        if self.recent.len() == REMEMBERED {
            self.recent.pop_front();
        }
        self.recent.push_back(*frame);
    }

    fn field(&mut self, event: &FieldEvent) {
        self.lasers.field(event);
        self.fields_shown += 1;
        self.fields_repeated += u64::from(event.repeated);
        if event.repeated || event.frame_id == self.newest_shown {
            return;
        }
        self.newest_shown = event.frame_id;
        self.frames_shown += 1;
        self.deadline_misses += u64::from(event.deadline_missed);
        let Some(frame) = self.recent.iter().find(|frame| frame.frame == event.frame_id) else { return };
        if let Some(slot) = keep_slot(frame.pupil) {
            self.kept[slot] = Some((frame.frame, frame.pupil));
        }
        if let (Some(t_sample), Some(on), Some(off)) = (frame.t_sample, event.laser_on, event.laser_off) {
            let middle = TimeNs(on.0 / 2 + off.0 / 2);
            self.sample_to_photon.push((middle - t_sample).seconds() as f32 * 1e3);
        }
    }

    fn newest_frame_shown(&self) -> bool {
        self.newest_shown == self.newest_made
    }

    fn pupil_of_kept(&self, frame: u64) -> Option<PupilDiameter> {
        self.kept.iter().flatten().find(|(kept, _)| *kept == frame).map(|(_, pupil)| *pupil)
    }
}

/// The exit code of a tracker that cannot be started.
pub(crate) fn tracker_failure(error: TrackerError) -> Failure {
    let exit = match &error {
        TrackerError::Source(SourceError::Serial(_)) => Exit::NoInput,
        TrackerError::Source(_) => Exit::Unavailable,
        TrackerError::Profile(_) | TrackerError::WrongLink { .. } => Exit::Usage,
        TrackerError::Replay(ReplayError::Io { .. }) => Exit::NoInput,
        TrackerError::Replay(_) => Exit::Data,
        TrackerError::Script(_) => Exit::Data,
        TrackerError::Record(_) => Exit::CannotCreate,
        TrackerError::NoScale { .. } => Exit::Config,
        TrackerError::Thread(_) => Exit::Unavailable,
    };
    Failure::because(exit)(error)
}

impl FieldRecord {
    /// The row of a field that was shown.
    pub fn of(event: &FieldEvent) -> Self {
        Self {
            frame: event.frame_id,
            field: event.field as u8,
            colour: event.colour,
            t_present: event.t_present,
            provenance: event.provenance.name(),
            laser_window: event.laser_on.zip(event.laser_off),
            deadline_missed: event.deadline_missed && !event.repeated,
        }
    }
}
