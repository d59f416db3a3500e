//! The beginning of a run: every part is opened, then the frame thread starts.

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use holod_calibration::rig::LaserDriver;
use holod_calibration::{PupilDiameter, TimeNs};
use holod_model::RgbdFrame;
use holod_model::engine::EngineError;
use holod_pupil_input::{ReplaySpeed, Tracker, TrackerHandle, TrackerOptions, TrackerSpec, adapter_delay_warning};
use holod_slm_output::laser::{DarkReason, open_laser};
use holod_slm_output::output::{OutputError, pacing_config};
use holod_slm_output::pacing::PacingConfig;
use holod_slm_output::present::{PanelSetup, open_panel};
use holod_slm_output::{FramePort, LevelsFrame, Output, OutputControl, OutputOptions, Pacer, PanelEncoder};

use super::clock::host_now;
use super::desk::{Changes, Desk};
use super::feed_watch::FeedWatch;
use super::frame_loop::{Change, FrameLoop, LoopRecord, RECORDS};
use super::held_pupil::HeldPupil;
use super::inputs::{Followed, Inputs, Playback, TrainedPupils};
use super::laser_watch::LaserBoxWatch;
use super::output_watch::OutputWatch;
use super::plan::SessionPlan;
use super::recorded_levels::KEEP_SLOTS;
use super::service::{Service, Signals};
use super::sleep::SleepWatch;
use super::stats::FrameRate;
use super::tally::Tally;
use super::tracker_watch::TrackerWatch;
use super::watch::{Announced, Limits, Names, Rings, Watch};
use crate::control::{self, Preparer, Steering};
use crate::dark_note::{DarkNote, Found};
use crate::failure::{Exit, Failure};
use crate::frame_record::FrameOrders;
use crate::observer::{Began, Observer};
use crate::renderer::{self, Renderer, Use};
use crate::service_lasers::ServiceLasers;
use crate::source::{OpenPictures, Pictures};
use crate::status::{self, StatusFile};
use crate::{progress, scheduling, setup, source, speed};

/// Lasers go dark when one frame has stayed on the panel for this many frame times, within these limits.
const STALL_FRAMES: i64 = 6;
const STALL_TIMEOUT_MIN: TimeNs = TimeNs(2_000_000_000);
const STALL_TIMEOUT_MAX: TimeNs = TimeNs(10_000_000_000);
/// Orders that may wait for the next frame, such as a script's.
const CHANGES: usize = 4;
/// A first frame that takes longer is not made twice to be timed.
const LONG_FRAME: TimeNs = TimeNs(5_000_000_000);

/// A run whose threads are at work.
pub(super) struct Session<'a> {
    /// The control thread's view of it.
    pub(super) watch: Watch<'a>,
    /// Ends panel and lasers.
    pub(super) output: OutputControl,
    pub(super) frame_thread: JoinHandle<Result<(), EngineError>>,
    /// Ends the frame thread.
    pub(super) stop: Arc<AtomicBool>,
    /// Frame records that found no room.
    pub(super) records_lost: Arc<AtomicU64>,
    /// When it is over.
    pub(super) limits: Limits,
    /// Turns levels back into phase.
    pub(super) encoder: Arc<PanelEncoder>,
}

/// Starts everything. What has been started is taken down again where a later part cannot be.
/// Where there is a playback, no tracker is opened, and its frames are made.
pub(super) fn build(
    plan: SessionPlan,
    playback: Option<Playback>,
    mut signals: Signals,
    observer: &mut dyn Observer,
) -> Result<Session<'_>, Failure> {
    status::remove_leftovers();
    let service = Service::connect();
    // Its threads keep the priority of whoever calls it first, which must not be the panel's.
    scheduling::patient(rayon::current_num_threads);
    let network = prepare_network(&plan, &service)?;
    let pacing = pacing_config(&plan.rig, network.frame_time).map_err(Failure::because(Exit::Config))?;

    let t_origin = host_now();
    let tracker = open_tracker(&plan, playback.is_some(), t_origin)?;
    let pictures =
        source::open(&plan.pictures, &plan.rig.geometry, t_origin).map_err(Failure::because(Exit::Unavailable))?;
    let options = OutputOptions {
        keep_slots: if plan.keep_levels { KEEP_SLOTS } else { 0 },
        stall_timeout: plan.rig.lasers.stall_timeout.unwrap_or_else(|| stall_timeout(network.frame_time)),
        look: observer.wants_look(),
    };
    let bench = open_bench_dark(&plan, &network.encoder, options, &mut signals)?;

    let parts = Parts { service, signals, network, pacing, t_origin, tracker, pictures, bench };
    parts.start(plan, playback, observer)
}

/// What turns a picture and a pupil into the panel's levels.
struct Network {
    encoder: Arc<PanelEncoder>,
    renderer: Box<dyn Renderer>,
    /// How long a frame took, before anything was shown.
    frame_time: TimeNs,
    /// It has been said what would bring more frames a second.
    advised: bool,
    used_for: Use,
    /// Ends the frame thread, and whatever the renderer waits for.
    stop: Arc<AtomicBool>,
}

/// Prepares encoder and engine, makes the first frames, and says how long one takes.
fn prepare_network(plan: &SessionPlan, service: &Service) -> Result<Network, Failure> {
    let (rig, resolution) = (&plan.rig, plan.pictures.resolution());
    let encoder = progress::during(&format!("preparing the levels of the panel of {}", rig.resolution()), || {
        renderer::panel_encoder(rig, resolution)
    })?;
    let stop = Arc::new(AtomicBool::new(false));
    let used_for = Use::Loop { stop: Arc::clone(&stop) };
    let (renderer, frame_time) = progress::during(&format!("preparing the network for {resolution}"), || {
        service.starting();
        let mut renderer =
            scheduling::patient(|| renderer::open(plan.backend, &plan.weights, rig, &encoder, &used_for))?;
        service.starting();
        let [pupil, _] = plan.weights.trained_pupils(&rig.geometry);
        let levels = LevelsFrame::new(encoder.layout());
        let frame_time = first_frame_time(&mut *renderer, &plan.pictures.first_frame(), pupil, levels)?;
        Ok::<_, Failure>((renderer, frame_time))
    })?;
    tracing::info!("holograms are computed by {}", renderer.description());
    let advised = tell_frame_time(plan, frame_time, renderer.description());
    Ok(Network { encoder, renderer, frame_time, advised, used_for, stop })
}

/// Starts the tracker, or none for frames that are made again; says what is to be known of it.
fn open_tracker(plan: &SessionPlan, plays: bool, t_origin: TimeNs) -> Result<TrackerHandle, Failure> {
    let options = TrackerOptions {
        origin: t_origin,
        record: plan.record_tracker.clone(),
        forbidden: plan.ports_of_others.clone(),
        reader_begins: Some(scheduling::raise),
    };
    let handle = if plays {
        TrackerHandle::ended(&plan.rig.tracker)
    } else {
        Tracker::start(&plan.tracker, &plan.rig.tracker, options).map_err(setup::tracker_failure)?
    };
    let tracker = &handle.control;
    for warning in tracker.warnings() {
        tracing::warn!("{warning}");
    }
    for remark in tracker.remarks() {
        tracing::info!("{remark}");
    }
    tracing::debug!("tracker `{}` is open, link {}", plan.tracker, tracker.link().name());
    Ok(handle)
}

/// Panel and lasers, flat and dark.
struct Bench {
    output: Output,
    dark_note: DarkNote,
    /// Whether a note keeps the lasers dark from the beginning.
    found: Found,
    stall_timeout: TimeNs,
}

/// Opens panel and lasers; from here on every end of the process puts the lasers out. They stay dark where a person
/// asked for that of an earlier run.
fn open_bench_dark(
    plan: &SessionPlan,
    encoder: &PanelEncoder,
    options: OutputOptions,
    signals: &mut Signals,
) -> Result<Bench, Failure> {
    let output =
        progress::during("opening panel and lasers", || scheduling::prompt(|| open_output(plan, encoder, options)))?;
    output.control.attend();
    let driver = &plan.rig.lasers.driver;
    let dark_note = DarkNote::on(driver);
    let found = dark_note.look();
    if !matches!(found, Found::Nothing) {
        output.control.keep_dark(Some(DarkReason::Asked));
    }
    let if_unknown = ", or look whether they may be lit: `holod ctl lasers arm`";
    if let Some(why) = found.why_dark("`holod ctl lasers arm` lets them be lit", if_unknown) {
        tracing::warn!("{why}");
    }
    if let LaserDriver::Serial { path, .. } = driver
        && let Some(warning) = adapter_delay_warning("laser", path)
    {
        tracing::warn!("{warning}");
    }
    signals.end_after_lasers(driver);
    tracing::debug!("panel `{}` is open; lasers by {driver:?}", plan.output);
    output
        .control
        .dark_switch()
        .install_panic_hook(host_now, || holod_model::gpu::panic_is_caught() || control::panic_is_caught());
    Ok(Bench { output, dark_note, found, stall_timeout: options.stall_timeout })
}

/// Everything that has been opened for a run, before its first frame.
struct Parts {
    service: Service,
    signals: Signals,
    network: Network,
    pacing: PacingConfig,
    t_origin: TimeNs,
    tracker: TrackerHandle,
    pictures: OpenPictures,
    bench: Bench,
}

impl Parts {
    /// Starts the frame thread, and hands the rest to the control thread.
    fn start(
        self,
        plan: SessionPlan,
        playback: Option<Playback>,
        observer: &mut dyn Observer,
    ) -> Result<Session<'_>, Failure> {
        let plays = playback.is_some();
        let limits = limits_of(&plan, playback.as_ref(), self.t_origin);
        let preparer = self.preparer(&plan, plays);
        let Self { service, signals, network, pacing, t_origin, tracker, pictures, bench } = self;
        let Bench { output, found, .. } = bench;
        let Network { encoder, renderer, advised, stop, .. } = network;
        let engine = Arc::new(Mutex::new(renderer.description().to_owned()));
        let weights = Arc::clone(&preparer.weights);
        let steering = Arc::new(Steering::new(plan.pupil, plan.rig.pupil_step()));
        let inputs = match playback {
            Some(playback) => Inputs::Recorded(playback),
            None => Inputs::Followed(Followed {
                pupil: tracker.estimate,
                held: HeldPupil::default(),
                pictures: pictures.source,
                steering: Arc::clone(&steering),
            }),
        };
        let pacer = Pacer::new(pacing, host_now());
        let frames = start_frame_thread(&plan, inputs, renderer, output.frames, pacer, &engine, &stop)?;

        let engine_now = engine.lock().unwrap_or_else(PoisonError::into_inner).clone();
        observer.began(&mut Began {
            t_origin,
            rig: plan.rig.clone(),
            encoder: Arc::clone(&encoder),
            engine: engine_now,
            look: output.look,
        });
        let watch = Watch {
            names: names_of(&plan, engine),
            plays,
            rings: Rings {
                records: frames.records,
                fields: output.events,
                fields_over: Vec::new(),
                box_events: output.box_events,
                decisions: tracker.decisions,
            },
            panel: OutputWatch::new(output.panel_events, &plan.rig, output.takes_software_times),
            laser_box: LaserBoxWatch::new(output.laser_faults, output.laser_watch),
            tracker_watch: TrackerWatch::new(&plan.rig.tracker, tracker.control.figures(), t_origin),
            tracker: tracker.control,
            feed: pictures.feed,
            feed_watch: FeedWatch::new(dark_after(&plan.pictures), t_origin),
            record: plan.record,
            desk: Desk::open(
                preparer,
                Changes { steering, sink: pictures.sink, places: frames.places, retired: frames.retired, weights },
                &found,
            ),
            sleep: SleepWatch::begin(&plan.rig.lasers.driver),
            signals,
            hangups: plan.hangups,
            service,
            status: StatusFile::create(),
            t_origin,
            announced: Announced::new(advised),
            tally: Tally::default(),
            frame_rate: FrameRate::default(),
            frames_shown_hz: None,
            rig: plan.rig,
            observer,
        };
        let (frame_thread, records_lost) = (frames.thread, frames.records_lost);
        Ok(Session { watch, output: output.control, frame_thread, stop, records_lost, limits, encoder })
    }

    /// What makes requests ready, for what has been opened.
    fn preparer(&self, plan: &SessionPlan, plays: bool) -> Preparer {
        Preparer {
            rig: plan.rig.clone(),
            rig_again: plan.rig_again.clone(),
            weights: Arc::new(Mutex::new(plan.rig.model.weights.clone())),
            resolution: plan.pictures.resolution(),
            frame: plan.pictures.first_frame(),
            backend: plan.backend,
            used_for: self.network.used_for.clone(),
            encoder: Arc::clone(&self.network.encoder),
            has_feed: self.pictures.feed.is_some(),
            plays,
            stall_timeout: self.bench.stall_timeout,
            lasers: self.bench.output.control.dark_switch(),
            dark_note: self.bench.dark_note.clone(),
        }
    }
}

/// The frame thread at work, and the control thread's ways to it.
struct FrameThread {
    thread: JoinHandle<Result<(), EngineError>>,
    records: rtrb::Consumer<LoopRecord>,
    records_lost: Arc<AtomicU64>,
    places: rtrb::Producer<(u32, Change)>,
    retired: rtrb::Consumer<Change>,
}

fn start_frame_thread(
    plan: &SessionPlan,
    inputs: Inputs,
    renderer: Box<dyn Renderer>,
    port: FramePort,
    pacer: Pacer,
    engine: &Arc<Mutex<String>>,
    stop: &Arc<AtomicBool>,
) -> Result<FrameThread, Failure> {
    let records_lost = Arc::new(AtomicU64::new(0));
    let (record_producer, records) = rtrb::RingBuffer::new(RECORDS);
    let (places, changes) = rtrb::RingBuffer::new(CHANGES);
    // Beside these, one that the loop has in hand, and one that is sent since the retired ones were last taken.
    let (retired_producer, retired) = rtrb::RingBuffer::new(CHANGES + 2);
    let frame_loop = FrameLoop {
        inputs,
        renderer,
        port,
        pacer,
        light: plan.rig.light(),
        trained: TrainedPupils::of(plan.weights.trained_pupils(&plan.rig.geometry)),
        pattern: None,
        orders: FrameOrders::default(),
        changes,
        retired: retired_producer,
        records: record_producer,
        records_lost: Arc::clone(&records_lost),
        keep_levels: plan.keep_levels,
        hash_levels: plan.hash_levels,
        submitted: 0,
        shown: 0,
        made: None,
        engines_failed: 0,
        limit: plan.frame_limit,
        engine: Arc::clone(engine),
        stop: Arc::clone(stop),
    };
    let thread = std::thread::Builder::new()
        .name("holod-frame".into())
        .spawn(move || frame_loop.run())
        .map_err(Failure::because(Exit::Unavailable))?;
    Ok(FrameThread { thread, records, records_lost, places, retired })
}

fn limits_of(plan: &SessionPlan, playback: Option<&Playback>, t_origin: TimeNs) -> Limits {
    let is_all = playback.is_some_and(|playback| plan.frame_limit == Some(playback.frames()));
    Limits {
        t_origin,
        frames: plan.frame_limit,
        frames_over: if is_all { "the end of the report" } else { "the asked number of frames" },
        duration: plan.duration,
        replay_ends_run: playback.is_none() && replay_ends_run(plan),
    }
}

fn names_of(plan: &SessionPlan, engine: Arc<Mutex<String>>) -> Names {
    Names {
        scene: plan.pictures.name().to_owned(),
        scene_figures: plan.pictures.figures(),
        tracker: plan.tracker.to_string(),
        panel: plan.output.to_string(),
        engine,
        hologram: plan.pictures.resolution(),
    }
}

fn dark_after(pictures: &Pictures) -> Option<TimeNs> {
    match pictures {
        Pictures::Feed(feed) => feed.dark_after,
        Pictures::Scene(_) => None,
    }
}

/// Says how many frames a second are to be expected. Whether it has said what would bring more.
fn tell_frame_time(plan: &SessionPlan, frame_time: TimeNs, engine: &str) -> bool {
    let panel_hz = speed::panel_frames_hz(&plan.rig.panel);
    let frames_hz = speed::shown_hz(frame_time, &plan.rig.panel);
    let first_frame = format!(
        "a frame takes {:.0} ms, so about {frames_hz:.2} frames a second of the panel's {panel_hz:.1}",
        frame_time.seconds() * 1e3
    );
    let advice = speed::advice(frames_hz, engine, &plan.rig, plan.pictures.resolution());
    match &advice {
        None => tracing::info!("{first_frame}"),
        Some(advice) => tracing::warn!("{first_frame}: {advice}"),
    }
    advice.is_some()
}

/// A log that is played in no time says nothing of when a run is over that was asked to last.
fn replay_ends_run(plan: &SessionPlan) -> bool {
    let is_bounded = plan.frame_limit.is_some() || plan.duration.is_some();
    match &plan.tracker {
        TrackerSpec::Replay { repeat: true, .. } => false,
        TrackerSpec::Replay { speed: ReplaySpeed::Fastest, .. } => !is_bounded,
        TrackerSpec::Replay { .. } => true,
        TrackerSpec::Path(path) => path.is_file(),
        _ => false,
    }
}

fn open_output(plan: &SessionPlan, encoder: &PanelEncoder, options: OutputOptions) -> Result<Output, Failure> {
    let rig = &plan.rig;
    let unavailable = Failure::because::<OutputError>(Exit::Unavailable);
    let panel = open_panel(&plan.output, &PanelSetup::new(&rig.panel, encoder), host_now());
    let panel = panel.map_err(|error| unavailable(error.into()))?;
    setup::warn_of_link(&*panel);
    #[cfg(feature = "fault-injection")]
    let panel = Box::new(crate::fault::FaultyPanel(panel));
    let laser = open_laser(&rig.lasers, host_now).map_err(|error| unavailable(error.into()))?;
    ServiceLasers::of_this_process().map_or(Ok(()), |service| service.open())?;
    Output::start(rig, encoder, panel, laser, options, host_now).map_err(unavailable)
}

/// How long a frame takes, measured before anything is shown: the second one, unless the first took very long. A GPU's
/// driver still prepares things while it does the first. One in which an engine failed tells the time of that. A hologram
/// that is no numbers is refused.
fn first_frame_time(
    renderer: &mut dyn Renderer,
    frame: &Arc<RgbdFrame>,
    pupil: PupilDiameter,
    mut levels: LevelsFrame,
) -> Result<TimeNs, Failure> {
    let mut time = || {
        let began = host_now();
        let rendered = renderer.render(frame, pupil, &mut levels).map_err(Failure::because(Exit::Unavailable))?;
        Ok::<_, Failure>((host_now() - began, rendered.engine_changed))
    };
    let (mut taken, mut engine_failed) = time()?;
    if taken <= LONG_FRAME && !engine_failed {
        (taken, engine_failed) = time()?;
    }
    while engine_failed {
        (taken, engine_failed) = time()?;
    }
    renderer::check_last_hologram(renderer)?;
    Ok(taken)
}

fn stall_timeout(frame_time: TimeNs) -> TimeNs {
    TimeNs(STALL_FRAMES * frame_time.0).clamp(STALL_TIMEOUT_MIN, STALL_TIMEOUT_MAX)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use holod_calibration::Resolution;
    use holod_calibration::rig::Rig;

    use super::*;
    use crate::renderer::failing::Failing;

    #[test]
    fn a_frame_in_which_an_engine_fails_tells_no_frame_time_and_one_of_no_numbers_is_refused() {
        let size = Resolution { width: 8, height: 8 };
        let encoder = renderer::panel_encoder(&Rig::default(), size).unwrap();
        let (slow, quick) = (Duration::from_millis(200), Duration::ZERO);
        let frame_time = |frames: &[(Duration, bool)]| {
            let mut renderer = Failing::new(frames);
            let (frame, levels) = (Arc::new(RgbdFrame::black(size)), LevelsFrame::new(encoder.layout()));
            first_frame_time(&mut renderer, &frame, PupilDiameter::from_mm(3.0), levels).unwrap()
        };
        assert!(frame_time(&[(quick, false), (slow, false)]) >= TimeNs(200_000_000), "the second frame's");
        for frames in [
            &[(slow, false), (quick, false)][..],
            &[(slow, true), (quick, false)],
            &[(quick, false), (slow, true), (quick, false)],
            &[(slow, true), (slow, true), (quick, false)],
        ] {
            assert!(frame_time(frames) < TimeNs(200_000_000), "{frames:?}");
        }
        let (frame, levels) = (Arc::new(RgbdFrame::black(size)), LevelsFrame::new(encoder.layout()));
        let refused = first_frame_time(&mut Failing::diverged(), &frame, PupilDiameter::from_mm(3.0), levels);
        assert_eq!(refused.unwrap_err().exit, Exit::Data);
    }
}
