//! A tracker that runs: one thread reads, decodes, gates and filters; others ask for the pupil without waiting.

mod job;
mod rig_spec;
mod worker;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{SystemTime, UNIX_EPOCH};

use holod_calibration::{TimeNs, host_now, rig};

use self::job::Job;
use self::worker::Worker;
use crate::clock::{ClockGauge, ClockReport};
use crate::counters::{CounterSnapshot, Counters};
use crate::estimator::{Decision, EstimateSnapshot, Estimator, EstimatorSettings, PupilEstimate, StreamClock};
use crate::import::ReplayError;
use crate::profile::ProfileError;
use crate::record::{self, Header, RecordError, RecordFiles, RecordStatus, Recorder};
use crate::simulate::ScriptError;
use crate::size_unit::{Figures, SizeUnit};
use crate::source::SourceError;
use crate::spec::TrackerSpec;

/// Why a tracker could not be started.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum TrackerError {
    /// The tracker cannot be reached.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// Its profile cannot be had.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// The log cannot be played.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// The simulated eye's scenario cannot be had.
    #[error(transparent)]
    Script(#[from] ScriptError),
    /// The run cannot be written down.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// Its figures are no millimetres, and nobody said how many millimetres one of them is.
    #[error(
        "tracker `{spec}` gives pupil sizes in {unit}; holod needs millimetres: measure an artificial pupil of known \
         diameter and write tracker.scale_mm_per_unit = (its millimetres / the figure that `holod log info` shows for \
         it, or `holod tracker try --scale 1`: of an area A that is 2·√(A/π)) into the rig file, or give it with --scale"
    )]
    NoScale { spec: String, unit: &'static str },
    /// The profile is for another kind of link.
    #[error("profile `{profile}` is for {link}; a serial port does not bring such messages: write `{instead}`")]
    WrongLink {
        profile: String,
        /// What it is for.
        link: &'static str,
        /// A spec that fits.
        instead: &'static str,
    },
    /// The system gave no thread.
    #[error("no thread for the pupil reader: {0}; free memory or raise the limit on threads")]
    Thread(std::io::Error),
}

/// That `whose` figures are millimetres already, and are multiplied all the same.
pub fn scaled_millimetres(whose: &str, scale: f64) -> String {
    format!(
        "{whose} gives millimetres already, and each is multiplied by scale_mm_per_unit = {scale}; where they are right, \
         take that key out of the rig file, or give --scale 1"
    )
}

fn check_scale(spec: &TrackerSpec, figures: Figures, settings: &rig::Tracker) -> Result<(), TrackerError> {
    match figures.scale(settings) {
        None if figures.unit != SizeUnit::Millimetres => {
            Err(TrackerError::NoScale { spec: spec.to_string(), unit: figures.unit.name() })
        }
        _ => Ok(()),
    }
}

/// That a recording has a scale of its own, and which one is taken.
fn scale_in_words(recorded: f64, given: Option<f64>) -> String {
    match given {
        None => format!("the recording was made with scale_mm_per_unit = {recorded}, and is played with it"),
        Some(given) => {
            format!(
                "the recording was made with scale_mm_per_unit = {recorded}, and is played with {given}, which is given"
            )
        }
    }
}

fn needless_scale(whose: &str, unit: SizeUnit, settings: &rig::Tracker) -> Option<String> {
    let scale = settings.scale.filter(|scale| unit == SizeUnit::Millimetres && *scale != 1.0)?;
    Some(scaled_millimetres(whose, scale))
}

/// How the link to the tracker is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Link {
    /// Samples come, or may come.
    Up,
    /// The port is open and nothing has come for half a second.
    Silent,
    /// The port is gone; it is tried again and again.
    Down,
    /// The log has been played to its end, or the tracker was stopped.
    Finished,
}

impl Link {
    const ALL: [Self; 4] = [Self::Up, Self::Silent, Self::Down, Self::Finished];

    /// The name used in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Up => "up",
            Self::Silent => "silent",
            Self::Down => "down",
            Self::Finished => "finished",
        }
    }
}

/// Decisions that the tap holds: five minutes of two eyes at 100 Hz, or half a minute at 1 kHz.
const TAP_DECISIONS: usize = 1 << 16;

/// Reasons why a link does not come back, on their way to the control thread.
const TROUBLES: usize = 16;

/// Changes of settings on their way to the thread, which looks for them several times a second while it waits for
/// bytes.
const CHANGES: usize = 16;

/// What a tracker is started with beside its spec and the rig's settings.
#[derive(Clone, Debug, Default)]
pub struct TrackerOptions {
    /// Host time at which a log or a mock begins; a live tracker does not need it.
    pub origin: TimeNs,
    /// Where the run is written down.
    pub record: Option<RecordFiles>,
    /// Serial ports that belong to something else, the laser box for one: a tracker is never looked for there.
    pub forbidden: Vec<PathBuf>,
    /// What the thread that reads the tracker does first, such as raising its own priority. The thread that writes the
    /// record does not.
    pub reader_begins: Option<fn()>,
}

impl From<TimeNs> for TrackerOptions {
    fn from(origin: TimeNs) -> Self {
        Self { origin, ..Self::default() }
    }
}

/// Why a running tracker does not go on with other settings.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChangeError {
    /// Its figures are no millimetres.
    #[error(
        "tracker.scale_mm_per_unit is missing: the tracker gives pupil sizes in {0}, and one must be said in millimetres"
    )]
    NoScale(&'static str),
    /// Nobody reads samples any more.
    #[error("the tracker's log has been played to its end, or the tracker was stopped: nothing follows it any more")]
    Finished,
    /// The thread has not come to the last change.
    #[error("the tracker's thread has not taken the last change yet: ask again")]
    Busy,
}

/// What checks tracker specs and starts the threads that read trackers.
#[derive(Debug)]
pub struct Tracker;

impl Tracker {
    /// Finds what would keep `spec` from being started, as far as can be told without opening a port, a device or a
    /// connection; a log is read.
    ///
    /// # Errors
    /// The profile, the log or the script is not there or wrong, or the unit wants a scale.
    pub fn examine(spec: &TrackerSpec, settings: &rig::Tracker) -> Result<(), TrackerError> {
        check_scale(spec, Job::figures_unopened(spec)?, settings)
    }

    /// Opens what `spec` names and starts the thread that reads it. In the place of options an origin will do.
    ///
    /// # Errors
    /// The path does not exist, is of the wrong kind or does not open; what is there is another device; the log is of
    /// no known format, empty or unsorted; the recording cannot be made. What fails later is counted and tried again.
    pub fn start(
        spec: &TrackerSpec,
        settings: &rig::Tracker,
        options: impl Into<TrackerOptions>,
    ) -> Result<TrackerHandle, TrackerError> {
        let TrackerOptions { origin, record, forbidden, reader_begins } = options.into();
        let job = Job::open(spec, origin, &forbidden)?;
        let figures = job.figures();
        check_scale(spec, figures, settings)?;
        let mut warnings = job.warnings();
        let mut remarks = job.remarks().to_vec();
        remarks.extend(figures.recorded_scale.map(|recorded| scale_in_words(recorded, settings.scale)));
        warnings.extend(needless_scale(&format!("tracker `{spec}`"), figures.unit, settings));
        let header = job.link().map(|(profile, datagrams)| Header {
            spec: spec.to_string(),
            profile: profile.name.clone(),
            profile_toml: job::own_profile(spec),
            hid_descriptor: job.descriptor().map(<[u8]>::to_vec),
            datagrams,
            scale_mm_per_unit: settings.scale,
            t_started: host_now(),
            started_unix_ns: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as i64),
        });
        if header.is_none() && record.as_ref().is_some_and(|files| files.raw.is_some()) {
            warnings
                .push(format!("tracker `{spec}` is no link, so it has no bytes to record; its samples are recorded"));
        }
        let (taps, recorder) = record.map(|files| record::start(&files, header.as_ref())).transpose()?.unzip();
        let settings = EstimatorSettings::from(&figures.scaled(settings));
        let (input, output) = triple_buffer::triple_buffer(&EstimateSnapshot::new(settings));
        let (producer, consumer) = rtrb::RingBuffer::new(TAP_DECISIONS);
        let (trouble_producer, troubles) = rtrb::RingBuffer::new(TROUBLES);
        let (changes, change_consumer) = rtrb::RingBuffer::new(CHANGES);
        let shared = Arc::new(Shared {
            counters: Counters::new(),
            clock: ClockGauge::new(),
            stop: AtomicBool::new(false),
            link: AtomicU8::new(Link::Up as u8),
        });
        let worker = Worker {
            estimator: Estimator::new(settings),
            clock: StreamClock::LIVE,
            published: input,
            tap: producer,
            troubles: trouble_producer,
            changes: change_consumer,
            record: taps,
            arrivals_of_stream: false,
            tap_is_read: true,
            shared: Arc::clone(&shared),
        };
        let thread = thread::Builder::new()
            .name("pupil-reader".into())
            .spawn(move || {
                if let Some(begin) = reader_begins {
                    begin();
                }
                worker.run(job);
            })
            .map_err(TrackerError::Thread)?;
        Ok(TrackerHandle {
            estimate: EstimateReader { output },
            decisions: DecisionTap { consumer },
            control: TrackerControl {
                shared,
                thread: Some(thread),
                recorder,
                warnings,
                remarks,
                troubles,
                trouble: None,
                changes,
                figures,
            },
        })
    }
}

impl TrackerHandle {
    /// A tracker that brings nothing and has ended, for a run whose pupils are known beforehand.
    pub fn ended(settings: &rig::Tracker) -> Self {
        let (_, output) = triple_buffer::triple_buffer(&EstimateSnapshot::new(settings.into()));
        let (_, consumer) = rtrb::RingBuffer::new(1);
        let (_, troubles) = rtrb::RingBuffer::new(1);
        let (changes, _) = rtrb::RingBuffer::new(1);
        let shared = Arc::new(Shared {
            counters: Counters::new(),
            clock: ClockGauge::new(),
            stop: AtomicBool::new(true),
            link: AtomicU8::new(Link::Finished as u8),
        });
        Self {
            estimate: EstimateReader { output },
            decisions: DecisionTap { consumer },
            control: TrackerControl {
                shared,
                thread: None,
                recorder: None,
                warnings: Vec::new(),
                remarks: Vec::new(),
                troubles,
                trouble: None,
                changes,
                figures: SizeUnit::Millimetres.into(),
            },
        }
    }
}

/// A running tracker, in three parts: each for the thread that needs it.
#[derive(Debug)]
pub struct TrackerHandle {
    /// For the frame thread.
    pub estimate: EstimateReader,
    /// For whoever records or shows what was believed.
    pub decisions: DecisionTap,
    /// For the control thread. Dropping it stops the tracker.
    pub control: TrackerControl,
}

/// The frame thread's part: the newest estimate.
#[derive(Debug)]
pub struct EstimateReader {
    output: triple_buffer::Output<EstimateSnapshot>,
}

impl EstimateReader {
    /// The pupil at host time `t`: wait-free, no allocation.
    pub fn pupil_at(&mut self, t: TimeNs) -> PupilEstimate {
        self.output.read().pupil_at(t)
    }
}

/// The recorder's part: every decision of the gate, in a bounded ring. What finds no room is counted and dropped.
#[derive(Debug)]
pub struct DecisionTap {
    consumer: rtrb::Consumer<Decision>,
}

impl DecisionTap {
    /// The next decision; its `t_sample` is on the host's clock.
    pub fn pop(&mut self) -> Option<Decision> {
        self.consumer.pop().ok()
    }
}

/// The control thread's part. Dropping it stops the tracker.
#[derive(Debug)]
pub struct TrackerControl {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    recorder: Option<Recorder>,
    warnings: Vec<String>,
    remarks: Vec<String>,
    troubles: rtrb::Consumer<String>,
    trouble: Option<String>,
    changes: rtrb::Producer<EstimatorSettings>,
    figures: Figures,
}

impl TrackerControl {
    /// All counts at this moment.
    pub fn counters(&self) -> CounterSnapshot {
        self.shared.counters.snapshot()
    }

    /// What has been found of the tracker's clock; nothing where its samples carry no time.
    pub fn clock(&self) -> Option<ClockReport> {
        self.shared.clock.get()
    }

    /// How the link is.
    pub fn link(&self) -> Link {
        Link::ALL[usize::from(self.shared.link.load(Ordering::Acquire))]
    }

    /// Whether a log has been played to its end.
    pub fn finished(&self) -> bool {
        self.link() == Link::Finished
    }

    /// What its sizes are before the rig's scale.
    pub const fn figures(&self) -> Figures {
        self.figures
    }

    /// What a user should know of the tracker although it runs, found at its start: a port that will change its name,
    /// an adapter that holds bytes back, a recording that is torn. A sentence each.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// How a log was read, as any of its kind may be. A sentence each.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// Why a link that was lost does not come back, why a log brings nothing for long, or why nothing comes of one that is up, while it is so.
    pub fn trouble(&mut self) -> Option<&str> {
        while let Ok(text) = self.troubles.pop() {
            self.trouble = Some(text).filter(|text| !text.is_empty());
        }
        self.trouble.as_deref()
    }

    /// Goes on with another eye, scale, fallback or hold time, from the next sample on ([`Estimator::change`]); what
    /// the settings say of the spec is not looked at. What a user should know of it comes back.
    ///
    /// # Errors
    /// [`ChangeError`]; nothing has changed then.
    pub fn change(&mut self, settings: &rig::Tracker) -> Result<Option<String>, ChangeError> {
        let unit = self.figures.unit;
        if unit != SizeUnit::Millimetres && self.figures.scale(settings).is_none() {
            return Err(ChangeError::NoScale(unit.name()));
        }
        if self.finished() {
            return Err(ChangeError::Finished);
        }
        self.changes.push((&self.figures.scaled(settings)).into()).map_err(|_| ChangeError::Busy)?;
        if let Some(thread) = &self.thread {
            thread.thread().unpark();
        }
        Ok(needless_scale("the tracker", unit, settings))
    }

    /// A change waits for the thread: what is counted is still decided by the settings before it.
    pub fn is_changing(&self) -> bool {
        !self.finished() && self.changes.slots() < self.changes.buffer().capacity()
    }

    /// How the recording goes, where there is one.
    pub fn recording(&self) -> Option<RecordStatus> {
        self.recorder.as_ref().map(Recorder::status)
    }

    /// Stops the thread and waits for its end, and for that of the recording; again is no harm.
    pub fn stop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            // A panic over there has been reported by the panic hook; here it only means that it has ended.
            let _ = thread.join();
        }
        if let Some(recorder) = &mut self.recorder {
            recorder.finish();
        }
    }
}

impl Drop for TrackerControl {
    fn drop(&mut self) {
        self.stop();
    }
}

#[derive(Debug)]
struct Shared {
    counters: Counters,
    clock: ClockGauge,
    stop: AtomicBool,
    link: AtomicU8,
}
