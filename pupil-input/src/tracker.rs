//! A tracker that runs: one thread reads, decodes, gates and filters; others ask for the pupil without waiting.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use holod_calibration::{TimeNs, rig};

use crate::PupilSample;
use crate::clock::{ClockGauge, ClockModel, ClockReport};
use crate::counters::{Counter, CounterSnapshot, Counters};
use crate::estimator::{Decision, EstimateSnapshot, Estimator, EstimatorSettings, PupilEstimate, StreamClock};
use crate::gate::Verdict;
use crate::import::{LogFault, Recording, ReplayError, SizeUnit};
use crate::profile::{DEFAULT_PROFILE, Profile, ProfileError};
use crate::sequence::{SequenceEvent, SequenceTracker};
use crate::simulate::{MockSource, Script, ScriptError};
use crate::source::serial::SerialFeed;
use crate::source::{ByteSource, Feed, ReadEvent, SourceError};
use crate::spec::{DEFAULT_BAUD, ReplaySpeed, TrackerSpec};
use crate::wire::{Decoder, WireEvent, WireSample};

/// The host's monotonic clock: the one place where it is read.
pub fn host_now() -> TimeNs {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    TimeNs(now.tv_sec * 1_000_000_000 + now.tv_nsec)
}

/// Why a tracker could not be started.
#[derive(Debug, thiserror::Error)]
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
    /// Its figures are no millimetres, and nobody said how many millimetres one of them is.
    #[error(
        "tracker `{spec}` gives pupil sizes in {unit}; holod needs millimetres: measure an artificial pupil of known \
         diameter and write tracker.scale_mm_per_unit = (its millimetres / its units) into the rig file"
    )]
    NoScale {
        /// The tracker's spec.
        spec: String,
        /// What it gives.
        unit: &'static str,
    },
    /// The system gave no thread.
    #[error("no thread for the pupil reader: {0}; free memory or raise the limit on threads")]
    Thread(std::io::Error),
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
const SILENCE: TimeNs = TimeNs(500_000_000);
const FIRST_BACK_OFF: Duration = Duration::from_millis(100);
const LONGEST_BACK_OFF: Duration = Duration::from_secs(2);

/// Starts trackers.
#[derive(Debug)]
pub struct Tracker;

impl Tracker {
    /// Opens what `spec` names and starts the thread that reads it. `origin` is the host time at which a log or a mock
    /// begins; a live tracker does not need it.
    ///
    /// # Errors
    /// The path does not exist, is of the wrong kind or does not open; the log is of no known format, empty or unsorted.
    /// What fails later is counted and tried again.
    pub fn start(spec: &TrackerSpec, settings: &rig::Tracker, origin: TimeNs) -> Result<TrackerHandle, TrackerError> {
        let job = Job::open(spec, origin)?;
        if job.unit() != SizeUnit::Millimetres && settings.scale.is_none() {
            return Err(TrackerError::NoScale { spec: spec.to_string(), unit: job.unit().name() });
        }
        let settings = EstimatorSettings::from(settings);
        let (input, output) = triple_buffer::triple_buffer(&EstimateSnapshot::new(settings));
        let (producer, consumer) = rtrb::RingBuffer::new(TAP_DECISIONS);
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
            shared: Arc::clone(&shared),
        };
        let thread = thread::Builder::new()
            .name("pupil-reader".into())
            .spawn(move || worker.run(job))
            .map_err(TrackerError::Thread)?;
        Ok(TrackerHandle {
            reader: EstimateReader { output },
            tap: DecisionTap { consumer },
            control: TrackerControl { shared, thread: Some(thread) },
        })
    }
}

/// A running tracker.
#[derive(Debug)]
pub struct TrackerHandle {
    reader: EstimateReader,
    tap: DecisionTap,
    control: TrackerControl,
}

impl TrackerHandle {
    /// The pupil at host time `t`: wait-free, no allocation.
    pub fn pupil_at(&mut self, t: TimeNs) -> PupilEstimate {
        self.reader.pupil_at(t)
    }

    /// The gate's decisions since the last call.
    pub const fn decisions(&mut self) -> &mut DecisionTap {
        &mut self.tap
    }

    /// All counts at this moment.
    pub fn counters(&self) -> CounterSnapshot {
        self.control.counters()
    }

    /// What has been found of the tracker's clock; nothing where its samples carry no time.
    pub fn clock(&self) -> Option<ClockReport> {
        self.control.clock()
    }

    /// How the link is.
    pub fn link(&self) -> Link {
        self.control.link()
    }

    /// Whether a log has been played to its end.
    pub fn finished(&self) -> bool {
        self.control.finished()
    }

    /// Stops the thread and waits for its end.
    pub fn stop(&mut self) {
        self.control.stop();
    }

    /// Its three parts, each for the thread that needs it.
    pub fn split(self) -> (EstimateReader, DecisionTap, TrackerControl) {
        (self.reader, self.tap, self.control)
    }
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

    /// Stops the thread and waits for its end; again is no harm.
    pub fn stop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            // A panic over there has been reported by the panic hook; here it only means that it has ended.
            let _ = thread.join();
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

/// What the thread is to do.
enum Job {
    Live { open: Box<dyn ByteSource>, feed: Box<dyn Feed>, profile: Profile },
    Replay { recording: Box<Recording>, speed: ReplaySpeed, repeat: bool, origin: TimeNs },
    Mock { script: Box<Script>, origin: TimeNs },
}

impl Job {
    fn open(spec: &TrackerSpec, origin: TimeNs) -> Result<Self, TrackerError> {
        match spec {
            TrackerSpec::Path(path) if path.is_file() => Ok(Self::Replay {
                recording: Box::new(Recording::read(path)?),
                speed: ReplaySpeed::Times(1.0),
                repeat: false,
                origin,
            }),
            TrackerSpec::Path(path) => Self::serial(path, None, None),
            TrackerSpec::Serial { path, profile, baud } => Self::serial(path, profile.as_deref(), *baud),
            TrackerSpec::Hid { .. } => unimplemented!("HID"),
            TrackerSpec::Tcp { .. } => unimplemented!("TCP"),
            TrackerSpec::Udp { .. } => unimplemented!("UDP"),
            TrackerSpec::Core(_) => unimplemented!("Core"),
            TrackerSpec::Neon(_) => unimplemented!("Neon"),
            TrackerSpec::Replay { path, speed, repeat } => {
                Ok(Self::Replay { recording: Box::new(Recording::read(path)?), speed: *speed, repeat: *repeat, origin })
            }
            TrackerSpec::Mock(scenario) => Ok(Self::Mock { script: Box::new(scenario.script()), origin }),
            TrackerSpec::MockFile(path) => Ok(Self::Mock { script: Box::new(Script::read(path)?), origin }),
        }
    }

    /// What its sizes are before the rig's scale.
    fn unit(&self) -> SizeUnit {
        match self {
            Self::Live { profile, .. } => profile.unit,
            Self::Replay { recording, .. } => recording.unit(),
            Self::Mock { .. } => SizeUnit::Millimetres,
        }
    }

    fn serial(path: &Path, profile: Option<&str>, baud: Option<u32>) -> Result<Self, TrackerError> {
        let profile = Profile::find(profile.unwrap_or(DEFAULT_PROFILE))?;
        Self::live(Box::new(SerialFeed { path: path.into(), baud: baud.unwrap_or(DEFAULT_BAUD) }), profile)
    }

    fn live(mut feed: Box<dyn Feed>, profile: Profile) -> Result<Self, TrackerError> {
        Ok(Self::Live { open: feed.open()?, feed, profile })
    }
}

/// The thread's own state. After its first sample nothing is allocated.
struct Worker {
    estimator: Estimator,
    clock: StreamClock,
    published: triple_buffer::Input<EstimateSnapshot>,
    tap: rtrb::Producer<Decision>,
    shared: Arc<Shared>,
}

impl Worker {
    fn run(mut self, job: Job) {
        match job {
            Job::Live { open, feed, profile } => self.run_live(open, feed, &profile),
            Job::Replay { recording, speed, repeat, origin } => self.run_replay(&recording, speed, repeat, origin),
            Job::Mock { script, origin } => self.run_mock(*script, origin),
        }
        self.finish();
    }

    fn run_live(&mut self, open: Box<dyn ByteSource>, mut feed: Box<dyn Feed>, profile: &Profile) {
        let mut link = Some(open);
        let mut stream = LiveStream::new(profile);
        let mut buffer = [0; 4096];
        let mut back_off = FIRST_BACK_OFF;
        let mut last_heard = host_now();
        self.count(Counter::Connects, 1);
        while !self.stopping() {
            let Some(open) = &mut link else {
                if !self.wait_until(host_now() + TimeNs(back_off.as_nanos() as i64)) {
                    return;
                }
                self.count(Counter::ReconnectAttempts, 1);
                back_off = (back_off * 2).min(LONGEST_BACK_OFF);
                link = feed.open().ok();
                if link.is_some() {
                    stream = LiveStream::new(profile);
                    last_heard = host_now();
                    self.count(Counter::Connects, 1);
                    self.set_link(Link::Up);
                }
                continue;
            };
            match open.read(&mut buffer) {
                ReadEvent::Bytes(count) => {
                    let arrival = host_now();
                    last_heard = arrival;
                    back_off = FIRST_BACK_OFF;
                    self.set_link(Link::Up);
                    self.count(Counter::Bytes, count as u64);
                    stream.push(&buffer[..count], arrival, self);
                    self.publish();
                }
                ReadEvent::Silence => {
                    if host_now() - last_heard > SILENCE && self.link() == Link::Up {
                        self.count(Counter::Silences, 1);
                        self.set_link(Link::Silent);
                    }
                }
                ReadEvent::Gone => {
                    link = None;
                    self.count(Counter::Disconnects, 1);
                    self.set_link(Link::Down);
                }
            }
        }
    }

    fn run_replay(&mut self, recording: &Recording, speed: ReplaySpeed, repeat: bool, origin: TimeNs) {
        self.shared.counters.add_faults(recording.faults().entries());
        let begins = recording.begins();
        if let ReplaySpeed::Times(rate) = speed {
            self.clock = StreamClock { host: origin, stream: begins, rate };
        }
        let mut later = TimeNs(0);
        loop {
            for index in 0..recording.len() {
                let mut sample = recording.sample(index);
                sample.t_sample = sample.t_sample + later;
                match speed {
                    ReplaySpeed::Times(_) => {
                        if !self.wait_until(self.clock.to_host(sample.t_sample)) {
                            return;
                        }
                    }
                    // The newest sample is always now.
                    ReplaySpeed::Fastest => {
                        if self.stopping() {
                            return;
                        }
                        self.clock = StreamClock { host: host_now(), stream: sample.t_sample, rate: 1.0 };
                    }
                }
                sample.t_arrival = host_now();
                self.take(sample);
                self.publish();
            }
            if !repeat {
                return;
            }
            later = later + recording.period();
            self.count(Counter::Loops, 1);
        }
    }

    fn run_mock(&mut self, script: Script, origin: TimeNs) {
        self.clock = StreamClock { host: origin, stream: TimeNs(0), rate: 1.0 };
        for mock in MockSource::of(script) {
            let mut sample = mock.sample;
            if !self.wait_until(self.clock.to_host(sample.t_sample)) {
                return;
            }
            sample.t_arrival = host_now();
            self.take(sample);
            self.publish();
        }
    }

    fn take(&mut self, sample: PupilSample) {
        self.count(Counter::Samples, 1);
        let Self { estimator, tap, shared, clock, .. } = self;
        estimator.push(sample, |decision| note(decision, *clock, tap, shared));
    }

    fn finish(&mut self) {
        let Self { estimator, tap, shared, clock, .. } = self;
        estimator.finish(|decision| note(decision, *clock, tap, shared));
        self.publish();
        self.set_link(Link::Finished);
    }

    fn publish(&mut self) {
        let mut snapshot = self.estimator.snapshot();
        snapshot.set_clock(self.clock);
        self.published.write(snapshot);
    }

    /// Waits until host time `t`; false if the tracker is to stop.
    fn wait_until(&self, t: TimeNs) -> bool {
        loop {
            if self.stopping() {
                return false;
            }
            let left = t - host_now();
            if left.0 <= 0 {
                return true;
            }
            thread::park_timeout(Duration::from_nanos(left.0.unsigned_abs()));
        }
    }

    fn stopping(&self) -> bool {
        self.shared.stop.load(Ordering::Acquire)
    }

    fn count(&self, counter: Counter, count: u64) {
        self.shared.counters.add(counter, count);
    }

    fn link(&self) -> Link {
        Link::ALL[usize::from(self.shared.link.load(Ordering::Relaxed))]
    }

    fn set_link(&self, link: Link) {
        self.shared.link.store(link as u8, Ordering::Release);
    }
}

/// Counts a decision and hands it to the tap.
fn note(mut decision: Decision, clock: StreamClock, tap: &mut rtrb::Producer<Decision>, shared: &Shared) {
    match decision.verdict {
        Verdict::Accepted => shared.counters.add(Counter::Accepted, 1),
        Verdict::Rejected(reason) => shared.counters.add_rejected(reason),
    }
    decision.sample.t_sample = clock.to_host(decision.sample.t_sample);
    if tap.push(decision).is_err() {
        shared.counters.add(Counter::DecisionsDropped, 1);
    }
}

/// What one connection has brought: decoder, running numbers, clock.
struct LiveStream {
    decoder: Box<dyn Decoder>,
    sequence: SequenceTracker,
    clock: ClockModel,
}

impl LiveStream {
    fn new(profile: &Profile) -> Self {
        Self { decoder: profile.decoder(), sequence: SequenceTracker::new(), clock: ClockModel::new() }
    }

    fn push(&mut self, bytes: &[u8], arrival: TimeNs, worker: &mut Worker) {
        let Self { decoder, sequence, clock } = self;
        decoder.push(bytes, &mut |event| match event {
            WireEvent::Sample(sample) => {
                let resets = clock.resets();
                if let Some(number) = sample.sequence {
                    worker.count_sequence(sequence.next(number, sample.eye));
                }
                worker.take(to_sample(&sample, arrival, clock));
                worker.count(Counter::ClockResets, clock.resets() - resets);
            }
            WireEvent::Note => worker.count(Counter::Notes, 1),
            WireEvent::Partial => worker.count(Counter::Partials, 1),
            WireEvent::Rejected(fault) => worker.shared.counters.add_fault(LogFault::Wire(fault), 1),
        });
        worker.shared.clock.set(clock.report());
    }
}

impl Worker {
    fn count_sequence(&self, event: SequenceEvent) {
        match event {
            SequenceEvent::InOrder => {}
            SequenceEvent::Gap(missing) => {
                self.count(Counter::SequenceGaps, 1);
                self.count(Counter::SequenceMissing, missing);
            }
            SequenceEvent::Repeat => self.count(Counter::SequenceRepeats, 1),
            SequenceEvent::Restart => self.count(Counter::SequenceRestarts, 1),
        }
    }
}

fn to_sample(wire: &WireSample, arrival: TimeNs, clock: &mut ClockModel) -> PupilSample {
    PupilSample {
        t_device: wire.t_device.unwrap_or(arrival),
        t_sample: wire.t_device.map_or(arrival, |t_device| clock.map(t_device, arrival)),
        t_arrival: arrival,
        eye: wire.eye,
        diameter_mm: wire.diameter_mm,
        confidence: wire.confidence,
        aperture_mm: wire.aperture_mm,
        sequence: wire.sequence,
        valid: wire.valid,
    }
}
