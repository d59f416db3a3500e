//! The output's threads: the panel, and the lasers that follow it.
//!
//! | Thread | Does |
//! |---|---|
//! | the caller's frame thread | fills a frame from [`FramePort::acquire`], hands it over with [`FramePort::submit`] |
//! | `holod-panel` | runs the [`Presenter`]; tells the laser thread of each field that came on the panel |
//! | `holod-laser` | asks the [`Interlock`], drives the [`LaserBox`], publishes a [`FieldEvent`] when a field is over |
//!
//! After their start they neither allocate, lock nor log; what they have to say goes through wait-free rings and
//! counters, and where nobody reads a ring its newest entries are dropped and counted.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
use std::thread::{JoinHandle, Thread};
use std::time::Duration;

use holod_calibration::rig::{LaserDriver, Rig};
use holod_calibration::{Colour, TimeNs};
use rtrb::{Consumer, Producer, RingBuffer};

use crate::fields::{FIELDS, FrameLayout, FrameTag, LevelsFrame};
use crate::laser::gate::Gate;
use crate::laser::interlock::{Interlock, Orders};
use crate::laser::verify::FieldSpan;
use crate::laser::{BoxEvent, DarkReason, LaserBox, LaserEdge, LaserError, LaserProgram, SerialBox, SimulatedLaser};
use crate::levels::PanelEncoder;
use crate::pacing::{FramePlan, Pacer, PacingConfig};
use crate::present::{
    FrameSink, FrameSource, HeadlessPanel, PanelTiming, PresentedField, Presenter, Provenance, frame_channel,
};

/// A monotonic clock. The threads read it; nothing below them does.
pub type Clock = fn() -> TimeNs;

/// The system's monotonic clock, which a simulated laser box in another process shares.
pub fn monotonic_now() -> TimeNs {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    TimeNs(now.tv_sec * 1_000_000_000 + now.tv_nsec)
}

/// Fields on their way to the laser thread, and reports on their way to the frame thread.
const SHORT_RING: usize = 256;
/// Events on their way to whoever records them: some 20 s of fields at 180 Hz.
const LONG_RING: usize = 4096;
/// Longest sleep of a thread, so that it sees an order to stop.
const SLEEP_MAX: TimeNs = TimeNs(20_000_000);
/// How long shutdown waits for the lasers' acknowledgement.
const DARK_WAIT: TimeNs = TimeNs(500_000_000);
/// How long a panic waits for it.
const PANIC_WAIT: TimeNs = TimeNs(20_000_000);
/// How long a laser box that failed is left alone.
const RETRY_AFTER: TimeNs = TimeNs(1_000_000_000);

/// What may be chosen about the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutputOptions {
    /// Frames whose presented levels can be kept in memory (see [`FramePort::submit`]).
    pub keep_slots: usize,
    /// Lasers go dark when one frame has stayed on the panel for this long. Not less than a few times the slowest frame.
    pub stall_timeout: TimeNs,
}

impl Default for OutputOptions {
    /// Nothing is kept; 2 s.
    fn default() -> Self {
        Self { keep_slots: 0, stall_timeout: TimeNs(2_000_000_000) }
    }
}

/// Why the output could not be started.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The lasers.
    #[error(transparent)]
    Laser(#[from] LaserError),
    /// A thread could not be started.
    #[error("cannot start a thread: {0}; check the limits on threads and memory")]
    Thread(#[from] std::io::Error),
}

/// One colour field that was on the panel, with what its laser did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldEvent {
    /// The frame shown.
    pub frame_id: u64,
    /// Position in the panel's field order.
    pub field: usize,
    /// Its colour.
    pub colour: Colour,
    /// When the frame was submitted.
    pub t_submit: TimeNs,
    /// The refresh that the frame was made for.
    pub t_desired_present: TimeNs,
    /// When the field came on the panel.
    pub t_present: TimeNs,
    /// When it may first be lit.
    pub t_settled: TimeNs,
    /// When it made way for the next one.
    pub t_end: TimeNs,
    /// Where `t_present` comes from.
    pub provenance: Provenance,
    /// The on edge of its laser, if it was lit.
    pub laser_on: Option<TimeNs>,
    /// The off edge of its laser, if it was lit.
    pub laser_off: Option<TimeNs>,
    /// Why it was not lit, or must not have been.
    pub dark: Option<DarkReason>,
    /// The frame had been shown before: no newer one was there in time.
    pub repeated: bool,
    /// The frame came a refresh or more later than it was made for. Repetitions are not counted again.
    pub deadline_missed: bool,
}

impl FieldEvent {
    /// The field as [`crate::laser::verify::verify_edges`] wants it.
    pub fn span(&self) -> FieldSpan {
        FieldSpan {
            frame_id: self.frame_id,
            field: self.field,
            colour: self.colour,
            t_present: self.t_present,
            t_settled: self.t_settled,
            t_end: self.t_end,
            dark: self.dark,
        }
    }
}

/// What the panel did at the start of a colour frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PresentReport {
    /// The frame shown.
    pub frame_id: u64,
    /// Since when.
    pub t_present: TimeNs,
    /// Where `t_present` comes from.
    pub provenance: Provenance,
    /// The frame had been shown before.
    pub repeated: bool,
}

/// Counters of the output's threads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OutputCounts {
    /// Colour fields of frames that came on the panel.
    pub fields: u64,
    /// Of those, fields of a frame that had been shown before.
    pub repeated: u64,
    /// Fields that were not lit.
    pub dark_fields: u64,
    /// Times that the lasers went dark while they were armed.
    pub went_dark: u64,
    /// Commands that the laser box failed or refused.
    pub box_faults: u64,
    /// Reports and events lost because nobody read them.
    pub lost: u64,
    /// Whether lasers may be lit now.
    pub armed: bool,
}

/// How the output ended.
#[derive(Debug)]
pub struct ShutdownReport {
    /// The laser box acknowledged that it is dark.
    pub lasers_dark: bool,
    /// The flat pattern was on the panel before the threads ended.
    pub flat_presented: bool,
    /// The last frame that was shown, where the presenter can say.
    pub last_frame: Option<LevelsFrame>,
    /// Levels of the frames that were shown and kept, by slot.
    pub kept: Vec<Option<LevelsFrame>>,
    /// Counters at the end.
    pub counts: OutputCounts,
}

/// The running output, by the threads that hold its parts.
#[derive(Debug)]
pub struct Output {
    /// For the frame thread.
    pub frames: FramePort,
    /// For whoever records: each field that was on the panel, in order, once it is over.
    pub events: Consumer<FieldEvent>,
    /// For whoever records: what the laser box did.
    pub box_events: Consumer<BoxEvent>,
    /// For whoever ends it.
    pub control: OutputControl,
}

impl Output {
    /// Starts on a virtual panel, with the laser box that the rig names. Where that box has real lasers they stay dark:
    /// nothing is on any panel.
    ///
    /// # Errors
    /// [`OutputError`].
    pub fn headless(
        rig: &Rig,
        encoder: &PanelEncoder,
        options: OutputOptions,
        clock: Clock,
    ) -> Result<Self, OutputError> {
        let timing = PanelTiming::new(&rig.panel);
        let presenter =
            HeadlessPanel::new(timing, flat_frame(rig, encoder), clock() + timing.frame_period, options.keep_slots);
        let laser: Box<dyn LaserBox> = match &rig.lasers.driver {
            LaserDriver::Simulated => Box::new(SimulatedLaser::new(clock())),
            LaserDriver::Serial { path } => Box::new(SerialBox::open(path, clock)?),
        };
        Self::start(rig, encoder, Box::new(presenter), laser, options, clock)
    }

    /// Starts on any panel with any laser box.
    ///
    /// # Errors
    /// [`OutputError`] where the rig leaves no time for light, the box refuses its program or a thread does not start.
    pub fn start(
        rig: &Rig,
        encoder: &PanelEncoder,
        presenter: Box<dyn Presenter>,
        mut laser: Box<dyn LaserBox>,
        options: OutputOptions,
        clock: Clock,
    ) -> Result<Self, OutputError> {
        let gate = Gate::new(&rig.panel, &rig.lasers)?;
        let program = gate.program(&rig.panel, &rig.lasers)?;
        laser.dark(DarkReason::Asked, clock())?;
        laser.program(&program, clock())?;
        let interlock = Interlock::new(
            gate,
            program.trigger,
            program.sequence,
            presenter.is_virtual() && laser.is_simulated(),
            options.stall_timeout,
        );

        let (sink, source) = frame_channel(&flat_frame(rig, encoder));
        let (field_producer, field_consumer) = RingBuffer::new(SHORT_RING);
        let (report_producer, report_consumer) = RingBuffer::new(SHORT_RING);
        let (event_producer, event_consumer) = RingBuffer::new(LONG_RING);
        let (box_producer, box_consumer) = RingBuffer::new(LONG_RING);
        let shared = Arc::new(Shared::default());

        let laser_thread = LaserThread {
            laser,
            program,
            interlock,
            gate,
            fields: field_consumer,
            ledger: Ledger::new(gate, event_producer, box_producer),
            t_retry: TimeNs(i64::MIN),
            program_lost: false,
            shared: Arc::clone(&shared),
            clock,
        };
        let laser = std::thread::Builder::new().name("holod-laser".into()).spawn(move || laser_thread.run())?;
        let panel_thread = PanelThread {
            presenter,
            frames: source,
            fields: field_producer,
            reports: report_producer,
            laser: laser.thread().clone(),
            shared: Arc::clone(&shared),
            clock,
        };
        let spawned = std::thread::Builder::new().name("holod-panel".into()).spawn(move || panel_thread.run());
        let panel = match spawned {
            Ok(panel) => panel,
            Err(why) => {
                shared.stop.store(true, Ordering::Release);
                laser.thread().unpark();
                // A panic over there has been reported by the panic hook.
                let _ended = laser.join();
                return Err(why.into());
            }
        };
        Ok(Self {
            frames: FramePort { sink, reports: report_consumer },
            events: event_consumer,
            box_events: box_consumer,
            control: OutputControl {
                switch: DarkSwitch { shared, laser: laser.thread().clone() },
                frame_period: gate.timing().frame_period,
                threads: Some(Threads { panel, laser }),
                clock,
            },
        })
    }
}

/// What a pacer must know to make frames for the output of `rig`.
///
/// # Errors
/// As [`Gate::new`].
pub fn pacing_config(rig: &Rig, first_frame_time: TimeNs) -> Result<PacingConfig, LaserError> {
    let gate = Gate::new(&rig.panel, &rig.lasers)?;
    let timing = gate.timing();
    Ok(PacingConfig {
        refresh_period: timing.frame_period,
        // The middle of the three fields stands for all of them.
        photon_delay: timing.field_period + gate.middle(),
        submit_margin: TimeNs(timing.frame_period.0 / 16),
        first_frame_time,
    })
}

fn flat_frame(rig: &Rig, encoder: &PanelEncoder) -> LevelsFrame {
    let mut flat = LevelsFrame::new(FrameLayout::new(&rig.panel, encoder.panel_resolution()));
    encoder.encode_flat(&mut flat);
    flat
}

/// The frame thread's end of the output.
#[derive(Debug)]
pub struct FramePort {
    sink: FrameSink,
    reports: Consumer<PresentReport>,
}

impl FramePort {
    /// The buffer of the next frame, with the levels of some older one in it. Wait-free.
    pub fn acquire(&mut self) -> &mut LevelsFrame {
        self.sink.acquire()
    }

    /// Hands the acquired frame to the panel, which shows it from its next colour frame on unless a newer one comes
    /// before. With `keep`, the panel stores the levels in that slot when they have come on the panel, over what was
    /// there; they are in the [`ShutdownReport`]. Wait-free.
    pub fn submit(&mut self, plan: &FramePlan, keep: Option<usize>, now: TimeNs) {
        self.sink.submit(FrameTag {
            frame_id: plan.frame_id,
            t_submit: now,
            t_desired_present: plan.t_desired_present,
            keep,
        });
    }

    /// Gives `pacer` what the panel has reported since the last call, and calls `report` for each report.
    pub fn feed(&mut self, pacer: &mut Pacer, mut report: impl FnMut(PresentReport)) {
        while let Ok(presented) = self.reports.pop() {
            if presented.repeated {
                pacer.observe_refresh(presented.t_present, presented.provenance);
            } else {
                pacer.report(presented.frame_id, presented.t_present, presented.provenance);
            }
            report(presented);
        }
    }
}

#[derive(Debug)]
struct Threads {
    panel: JoinHandle<Box<dyn Presenter>>,
    laser: JoinHandle<()>,
}

/// Ends the output; dropped, it ends it too.
#[derive(Debug)]
pub struct OutputControl {
    switch: DarkSwitch,
    frame_period: TimeNs,
    threads: Option<Threads>,
    clock: Clock,
}

impl OutputControl {
    /// The switch that makes the lasers dark for good.
    pub fn dark_switch(&self) -> DarkSwitch {
        self.switch.clone()
    }

    /// Counters so far.
    pub fn counts(&self) -> OutputCounts {
        self.switch.shared.counts()
    }

    /// Ends the output in order: lasers dark and acknowledged, flat pattern on the panel, threads joined. The waits for
    /// darkness and for the flat pattern are bounded; a box that does not answer is left to its heartbeat timeout.
    pub fn shutdown(mut self) -> ShutdownReport {
        self.end()
    }

    fn end(&mut self) -> ShutdownReport {
        let shared = &self.switch.shared;
        self.switch.dark(DarkReason::Shutdown);
        let wait_for = |done: &dyn Fn() -> bool, patience: TimeNs| {
            let t_end = (self.clock)() + patience;
            while !done() && (self.clock)() < t_end {
                std::thread::sleep(Duration::from_micros(500));
            }
            done()
        };
        let answered = wait_for(&|| shared.acknowledged.load(Ordering::Acquire) != NOT_YET, DARK_WAIT);
        let lasers_dark = answered && shared.acknowledged.load(Ordering::Acquire) == DARK;
        shared.flat_wanted.store(true, Ordering::Release);
        let flat_patience = TimeNs(4 * self.frame_period.0 + SLEEP_MAX.0 + 200_000_000);
        let flat_presented = wait_for(&|| shared.flat_shown.load(Ordering::Acquire), flat_patience);
        shared.stop.store(true, Ordering::Release);
        let mut report = ShutdownReport {
            lasers_dark,
            flat_presented,
            last_frame: None,
            kept: Vec::new(),
            counts: OutputCounts::default(),
        };
        if let Some(Threads { panel, laser }) = self.threads.take() {
            panel.thread().unpark();
            if let Ok(mut presenter) = panel.join() {
                report.last_frame = presenter.last_frame().cloned();
                report.kept = presenter.take_kept();
            }
            laser.thread().unpark();
            report.lasers_dark &= laser.join().is_ok();
        }
        report.counts = self.counts();
        report
    }
}

impl Drop for OutputControl {
    fn drop(&mut self) {
        if self.threads.is_some() {
            self.end();
        }
    }
}

/// Makes the lasers dark for good, from any thread.
#[derive(Clone, Debug)]
pub struct DarkSwitch {
    shared: Arc<Shared>,
    laser: Thread,
}

impl DarkSwitch {
    /// Asks the laser thread for darkness; the first reason stays. Does not wait.
    pub fn dark(&self, reason: DarkReason) {
        let code = 1 + DarkReason::ALL.iter().position(|&known| known == reason).unwrap_or_default() as u8;
        let _first = self.shared.latch.compare_exchange(0, code, Ordering::AcqRel, Ordering::Acquire);
        self.laser.unpark();
    }

    /// Why the lasers are dark for good, if they are.
    pub fn reason(&self) -> Option<DarkReason> {
        self.shared.latched()
    }

    /// Whether the box has acknowledged.
    pub fn is_dark(&self) -> bool {
        self.shared.acknowledged.load(Ordering::Acquire) == DARK
    }

    /// From now on any panic of the program first makes the lasers dark, and waits a moment for the acknowledgement.
    pub fn install_panic_hook(&self, clock: Clock) {
        let switch = self.clone();
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            switch.dark(DarkReason::Panic);
            let t_end = clock() + PANIC_WAIT;
            let on_laser_thread = std::thread::current().id() == switch.laser.id();
            while !on_laser_thread && !switch.is_dark() && clock() < t_end {
                std::thread::sleep(Duration::from_micros(200));
            }
            before(info);
        }));
    }
}

const NOT_YET: u8 = 0;
const DARK: u8 = 1;
const FAILED: u8 = 2;

/// What the threads share.
#[derive(Debug, Default)]
struct Shared {
    /// 0, or 1 + the index of the reason for which lasers are dark for good.
    latch: AtomicU8,
    /// What the box said to that.
    acknowledged: AtomicU8,
    flat_wanted: AtomicBool,
    flat_shown: AtomicBool,
    stop: AtomicBool,
    armed: AtomicBool,
    fields: AtomicU64,
    repeated: AtomicU64,
    dark_fields: AtomicU64,
    went_dark: AtomicU64,
    box_faults: AtomicU64,
    lost: AtomicU64,
}

impl Shared {
    fn counts(&self) -> OutputCounts {
        let get = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        OutputCounts {
            fields: get(&self.fields),
            repeated: get(&self.repeated),
            dark_fields: get(&self.dark_fields),
            went_dark: get(&self.went_dark),
            box_faults: get(&self.box_faults),
            lost: get(&self.lost),
            armed: self.armed.load(Ordering::Relaxed),
        }
    }

    fn latched(&self) -> Option<DarkReason> {
        let code = self.latch.load(Ordering::Acquire);
        DarkReason::ALL.get(usize::from(code).wrapping_sub(1)).copied()
    }
}

fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// The thread of the panel.
struct PanelThread {
    presenter: Box<dyn Presenter>,
    frames: FrameSource,
    fields: Producer<PresentedField>,
    reports: Producer<PresentReport>,
    laser: Thread,
    shared: Arc<Shared>,
    clock: Clock,
}

impl PanelThread {
    fn run(mut self) -> Box<dyn Presenter> {
        while !self.shared.stop.load(Ordering::Acquire) {
            let flat_wanted = self.shared.flat_wanted.load(Ordering::Acquire);
            if flat_wanted {
                self.presenter.show_flat();
            }
            let Self { presenter, frames, fields, reports, laser, shared, clock } = &mut self;
            presenter.tick(clock(), frames, &mut |field| {
                if fields.push(field).is_err() {
                    count(&shared.lost);
                }
                let report = field.frame.filter(|_| field.field == 0).map(|frame| PresentReport {
                    frame_id: frame.frame_id,
                    t_present: field.t_present,
                    provenance: field.provenance,
                    repeated: field.repeated,
                });
                if report.is_some_and(|report| reports.push(report).is_err()) {
                    count(&shared.lost);
                }
                if flat_wanted && field.frame.is_none() {
                    shared.flat_shown.store(true, Ordering::Release);
                }
                laser.unpark();
            });
            let rest = (presenter.t_next() - clock()).min(SLEEP_MAX);
            if rest > TimeNs(0) {
                std::thread::park_timeout(Duration::from_nanos(rest.0 as u64));
            }
        }
        self.presenter
    }
}

/// The thread of the lasers.
struct LaserThread {
    laser: Box<dyn LaserBox>,
    program: LaserProgram,
    interlock: Interlock,
    gate: Gate,
    fields: Consumer<PresentedField>,
    ledger: Ledger,
    /// A box that failed is left alone until then.
    t_retry: TimeNs,
    /// The box failed and may have lost its program.
    program_lost: bool,
    shared: Arc<Shared>,
    clock: Clock,
}

impl LaserThread {
    fn run(mut self) {
        loop {
            let stop = self.shared.stop.load(Ordering::Acquire);
            let clock = self.clock;
            let now = self.step(clock);
            if stop {
                self.ledger.flush(TimeNs(i64::MAX), &self.shared);
                return;
            }
            let t_next = self.interlock.t_watch().map_or(SLEEP_MAX, |t| (t - now).max(TimeNs(0)));
            let rest = t_next.min(self.gate.timing().field_period).min(SLEEP_MAX);
            std::thread::park_timeout(Duration::from_nanos(rest.0 as u64));
        }
    }

    /// Does all that is to be done at the time that `clock` says, which is handed back. The clock is read again for each
    /// field: a field that came since the last reading is not one that was reported before it was shown.
    fn step(&mut self, clock: impl Fn() -> TimeNs) -> TimeNs {
        let now = clock();
        self.poll(now);
        if let Some(reason) = self.shared.latched() {
            self.latch(reason, now);
        }
        while let Ok(field) = self.fields.pop() {
            self.on_field(&field, clock());
        }
        let now = clock();
        let orders = self.interlock.watch(now);
        self.obey(orders, now);
        self.poll(now);
        self.shared.armed.store(self.interlock.is_armed(), Ordering::Relaxed);
        self.ledger.flush(now, &self.shared);
        now
    }

    fn on_field(&mut self, field: &PresentedField, now: TimeNs) {
        let (orders, mut dark) = self.interlock.on_field(field, now);
        if orders.arm && now < self.t_retry {
            self.interlock.box_went_dark();
            dark = Some(DarkReason::BoxFault);
        } else if !self.obey(orders, now) {
            dark = Some(DarkReason::BoxFault);
        }
        self.ledger.field(field, dark, &self.shared);
    }

    /// Does what the interlock says; whether the box did it, too.
    fn obey(&mut self, orders: Orders, now: TimeNs) -> bool {
        let done = self.try_obey(orders, now);
        if done.is_err() {
            self.fault(now);
        }
        done.is_ok()
    }

    fn try_obey(&mut self, orders: Orders, now: TimeNs) -> Result<(), LaserError> {
        if let Some(reason) = orders.dark {
            return self.laser.dark(reason, now);
        }
        if orders.arm {
            if std::mem::take(&mut self.program_lost) {
                self.laser.program(&self.program, now)?;
            }
            self.laser.arm(now)?;
        }
        if orders.heartbeat {
            self.laser.heartbeat(now)?;
        }
        if let Some(t_sync) = orders.sync {
            self.laser.sync(t_sync, now)?;
        }
        orders.light.map_or(Ok(()), |window| self.laser.light(window, now))
    }

    fn fault(&mut self, now: TimeNs) {
        count(&self.shared.box_faults);
        self.interlock.box_went_dark();
        self.program_lost = true;
        self.t_retry = now + RETRY_AFTER;
        if self.laser.dark(DarkReason::BoxFault, now).is_err() {
            count(&self.shared.box_faults);
        }
    }

    fn latch(&mut self, reason: DarkReason, now: TimeNs) {
        if self.shared.acknowledged.load(Ordering::Acquire) != NOT_YET {
            return;
        }
        let orders = self.interlock.latch(reason);
        let answer = if self.try_obey(orders, now).is_ok() { DARK } else { FAILED };
        self.shared.acknowledged.store(answer, Ordering::Release);
    }

    fn poll(&mut self, now: TimeNs) {
        let Self { laser, ledger, interlock, shared, .. } = self;
        let polled = laser.poll(now, &mut |event| {
            if matches!(event, BoxEvent::Dark { .. }) {
                interlock.box_went_dark();
                count(&shared.went_dark);
            }
            ledger.box_event(event, shared);
        });
        if polled.is_err() && now >= self.t_retry {
            self.fault(now);
        }
    }
}

/// Puts fields and laser edges together.
struct Ledger {
    gate: Gate,
    open: VecDeque<(PresentedField, Option<DarkReason>)>,
    edges: VecDeque<LaserEdge>,
    last_dark: Option<DarkReason>,
    events: Producer<FieldEvent>,
    box_events: Producer<BoxEvent>,
}

impl Ledger {
    fn new(gate: Gate, events: Producer<FieldEvent>, box_events: Producer<BoxEvent>) -> Self {
        let open = VecDeque::with_capacity(SHORT_RING);
        Self { gate, open, edges: VecDeque::with_capacity(SHORT_RING), last_dark: None, events, box_events }
    }

    fn field(&mut self, field: &PresentedField, dark: Option<DarkReason>, shared: &Shared) {
        if field.frame.is_none() {
            return;
        }
        count(&shared.fields);
        if field.repeated {
            count(&shared.repeated);
        }
        if self.open.len() == SHORT_RING {
            count(&shared.lost);
        } else {
            self.open.push_back((*field, dark));
        }
    }

    fn box_event(&mut self, event: BoxEvent, shared: &Shared) {
        match event {
            BoxEvent::Edge(edge) => {
                if self.edges.len() == SHORT_RING {
                    self.edges.pop_front();
                }
                self.edges.push_back(edge);
            }
            BoxEvent::Dark { reason, .. } => self.last_dark = Some(reason),
            BoxEvent::Armed { .. } => {}
        }
        if self.box_events.push(event).is_err() {
            count(&shared.lost);
        }
    }

    /// Publishes the fields that are over at `now`, when all their edges are known.
    fn flush(&mut self, now: TimeNs, shared: &Shared) {
        while let Some((field, dark)) = self.open.front().copied().filter(|(field, _)| self.gate.t_end(field) <= now) {
            self.open.pop_front();
            let event = self.event(&field, dark);
            if event.laser_on.is_none() {
                count(&shared.dark_fields);
            }
            if self.events.push(event).is_err() {
                count(&shared.lost);
            }
        }
    }

    fn event(&self, field: &PresentedField, dark: Option<DarkReason>) -> FieldEvent {
        let tag = field.frame.unwrap_or_default();
        let t_end = self.gate.t_end(field);
        let own = |edge: &&LaserEdge| edge.colour == field.colour;
        let on = self.edges.iter().filter(own).find(|edge| edge.on && edge.t >= field.t_present && edge.t < t_end);
        let off =
            on.and_then(|on| self.edges.iter().filter(own).find(|edge| !edge.on && edge.t >= on.t && edge.t <= t_end));
        let timing = self.gate.timing();
        let t_frame = TimeNs(field.t_present.0 - field.field as i64 * timing.field_period.0);
        let late_ns = t_frame.0 - tag.t_desired_present.0;
        FieldEvent {
            frame_id: tag.frame_id,
            field: field.field,
            colour: field.colour,
            t_submit: tag.t_submit,
            t_desired_present: tag.t_desired_present,
            t_present: field.t_present,
            t_settled: field.t_present + self.gate.settle(),
            t_end,
            provenance: field.provenance,
            laser_on: on.map(|edge| edge.t),
            laser_off: off.map(|edge| edge.t),
            dark: match (on, dark) {
                (Some(_), reason) => reason.filter(|reason| reason.forbids_light()),
                (None, reason) => reason.or(self.last_dark).or(Some(DarkReason::Late)),
            },
            repeated: field.repeated,
            deadline_missed: !field.repeated && late_ns > timing.frame_period.0 / 2,
        }
    }
}

const _: () = assert!(FIELDS == 3, "three lasers, three fields");

#[cfg(test)]
mod tests {
    use super::*;
    use crate::laser::verify::{EdgeReport, Finding, verify_edges};
    use crate::laser::{LitWindow, Refusal};
    use holod_calibration::rig::{Panel, PanelMode};
    use holod_calibration::{PerColour, Resolution};
    use proptest::prelude::*;

    const SIZE: Resolution = Resolution { width: 8, height: 4 };
    const MS: i64 = 1_000_000;
    /// When the panel begins its first colour frame.
    const T_FIRST: TimeNs = TimeNs(10 * MS);

    fn rig(mode: PanelMode) -> Rig {
        let rig = Rig::default();
        Rig {
            panel: Panel { mode, refresh_hz: if mode == PanelMode::ChannelPacked { 60.0 } else { 180.0 }, ..rig.panel },
            ..rig
        }
    }

    /// The panel and the laser thread's work, in a time of its own.
    struct Bench {
        panel: HeadlessPanel,
        sink: FrameSink,
        source: FrameSource,
        fields: Producer<PresentedField>,
        laser: LaserThread,
        events: Consumer<FieldEvent>,
        box_events: Consumer<BoxEvent>,
        /// What is made of the panel's reports on their way.
        falsify: fn(PresentedField) -> Option<PresentedField>,
        now: TimeNs,
        last_frame_id: u64,
        all_events: Vec<FieldEvent>,
        edges: Vec<LaserEdge>,
        darks: Vec<(TimeNs, DarkReason)>,
    }

    impl Bench {
        fn new(mode: PanelMode) -> Self {
            Self::with_box(mode, Box::new(SimulatedLaser::new(TimeNs(0))))
        }

        fn with_box(mode: PanelMode, mut laser: Box<dyn LaserBox>) -> Self {
            let rig = rig(mode);
            let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
            let flat = flat_frame(&rig, &encoder);
            let gate = Gate::new(&rig.panel, &rig.lasers).unwrap();
            let program = gate.program(&rig.panel, &rig.lasers).unwrap();
            laser.program(&program, TimeNs(0)).unwrap();
            let (sink, source) = frame_channel(&flat);
            let (fields, field_consumer) = RingBuffer::new(SHORT_RING);
            let (event_producer, events) = RingBuffer::new(LONG_RING);
            let (box_producer, box_events) = RingBuffer::new(LONG_RING);
            let stall_timeout = TimeNs(500 * MS);
            let laser = LaserThread {
                laser,
                program,
                interlock: Interlock::new(gate, program.trigger, program.sequence, true, stall_timeout),
                gate,
                fields: field_consumer,
                ledger: Ledger::new(gate, event_producer, box_producer),
                t_retry: TimeNs(i64::MIN),
                program_lost: false,
                shared: Arc::default(),
                clock: || TimeNs(0),
            };
            let panel = HeadlessPanel::new(gate.timing(), flat, T_FIRST, 0);
            Self {
                panel,
                sink,
                source,
                fields,
                laser,
                events,
                box_events,
                falsify: Some,
                now: TimeNs(0),
                last_frame_id: 0,
                all_events: Vec::new(),
                edges: Vec::new(),
                darks: Vec::new(),
            }
        }

        fn submit(&mut self) {
            self.last_frame_id += 1;
            self.sink.submit(FrameTag {
                frame_id: self.last_frame_id,
                t_submit: self.now,
                t_desired_present: self.now,
                keep: None,
            });
        }

        /// Both threads wake up at `now` and do what they find.
        fn wake(&mut self, now: TimeNs) {
            self.now = now;
            let Self { panel, source, fields, falsify, .. } = self;
            panel.tick(now, source, &mut |field| {
                if let Some(field) = falsify(field) {
                    fields.push(field).unwrap();
                }
            });
            self.laser.step(|| now);
            while let Ok(event) = self.events.pop() {
                self.all_events.push(event);
            }
            while let Ok(event) = self.box_events.pop() {
                match event {
                    BoxEvent::Edge(edge) => self.edges.push(edge),
                    BoxEvent::Dark { t, reason } => self.darks.push((t, reason)),
                    BoxEvent::Armed { .. } => {}
                }
            }
        }

        /// Wakes up at every field, `late` after it, with a new frame for every refresh.
        fn run(&mut self, until: TimeNs, late: TimeNs) {
            while self.panel.t_next() + late < until {
                let now = self.panel.t_next() + late;
                if (self.panel.t_next() - T_FIRST).0 % self.panel.timing().frame_period.0 == 0 {
                    self.now = self.panel.t_next() - TimeNs(MS);
                    self.submit();
                }
                self.wake(now);
            }
        }

        fn verdict(&mut self) -> EdgeReport {
            // Everything that was begun is over.
            self.laser.ledger.flush(TimeNs(i64::MAX), &self.laser.shared);
            while let Ok(event) = self.events.pop() {
                self.all_events.push(event);
            }
            let spans: Vec<_> = self.all_events.iter().map(FieldEvent::span).collect();
            verify_edges(&spans, &self.edges)
        }
    }

    const MODES: [PanelMode; 2] = [PanelMode::ChannelPacked, PanelMode::FieldSequential];

    #[test]
    fn every_field_is_lit_once_by_its_own_laser() {
        for mode in MODES {
            for late_ns in [0, 100_000, 1_900_000] {
                let mut bench = Bench::new(mode);
                bench.run(TimeNs(1000 * MS), TimeNs(late_ns));
                bench.wake(TimeNs(1000 * MS));
                bench.laser.latch(DarkReason::Shutdown, TimeNs(1000 * MS));
                bench.wake(TimeNs(1001 * MS));
                let report = bench.verdict();
                assert_eq!(report.unsafe_findings().collect::<Vec<_>>(), Vec::<&Finding>::new());
                assert!(report.fields >= 170, "{report:?}");
                assert!(report.lit >= report.fields - 2, "{mode:?} late {late_ns}: {report:?}");
                assert!(bench.all_events.iter().any(|event| !event.repeated && event.laser_on.is_some()));
            }
        }
    }

    #[test]
    fn events_carry_the_edges_of_their_own_field() {
        let mut bench = Bench::new(PanelMode::ChannelPacked);
        bench.run(TimeNs(300 * MS), TimeNs(50_000));
        for event in bench.all_events.iter().filter(|event| event.dark.is_none()).skip(3) {
            let (on, off) = (event.laser_on.unwrap(), event.laser_off.unwrap());
            assert_eq!((on - event.t_present, off - on), (TimeNs(2_100_000), TimeNs(3 * MS)));
            assert!(on >= event.t_settled && off <= event.t_end);
        }
    }

    #[test]
    fn nothing_is_lit_over_the_flat_pattern_or_before_the_first_frame() {
        let mut bench = Bench::new(PanelMode::ChannelPacked);
        for tick in 0..100 {
            bench.wake(TimeNs(tick * 5 * MS));
        }
        assert_eq!((bench.edges.len(), bench.all_events.len()), (0, 0));
    }

    #[test]
    fn times_that_nobody_saw_light_nothing() {
        for mode in MODES {
            let mut bench = Bench::new(mode);
            bench.falsify = |field| Some(PresentedField { provenance: Provenance::Estimated, ..field });
            bench.run(TimeNs(500 * MS), TimeNs(0));
            assert_eq!(bench.edges, []);
            // Of a real panel, software's word is not enough either.
            let mut bench = Bench::new(mode);
            let gate = bench.laser.gate;
            let program = bench.laser.program;
            bench.laser.interlock = Interlock::new(gate, program.trigger, program.sequence, false, TimeNs(500 * MS));
            bench.run(TimeNs(500 * MS), TimeNs(0));
            assert_eq!(bench.edges, []);
            assert!(bench.all_events.iter().all(|event| event.dark == Some(DarkReason::Untrusted)));
            bench.falsify = |field| Some(PresentedField { provenance: Provenance::Hardware, ..field });
            bench.run(TimeNs(1000 * MS), TimeNs(0));
            assert_ne!(bench.edges, []);
        }
    }

    #[test]
    fn a_pattern_of_another_colour_lights_nothing() {
        for mode in MODES {
            let mut bench = Bench::new(mode);
            bench.falsify = |field| Some(PresentedField { colour: Colour::Green, ..field });
            bench.run(TimeNs(500 * MS), TimeNs(0));
            let greens = bench.edges.iter().filter(|edge| edge.colour == Colour::Green).count();
            assert_eq!(greens, bench.edges.len());
            assert!(bench.all_events.iter().filter(|event| event.field != 1).all(|event| event.dark.is_some()));
        }
    }

    #[test]
    fn missing_reports_make_dark_and_fields_that_return_make_light() {
        for mode in MODES {
            let mut bench = Bench::new(mode);
            bench.run(TimeNs(500 * MS), TimeNs(0));
            bench.falsify = |_| None;
            let t_lost = bench.now;
            bench.run(TimeNs(900 * MS), TimeNs(0));
            let &(t_dark, _) = bench.darks.last().unwrap();
            let refresh_ms = if mode == PanelMode::ChannelPacked { 17 } else { 6 };
            assert!(t_dark - t_lost <= TimeNs(3 * refresh_ms * MS + 6 * MS), "{mode:?}: {t_dark:?} {t_lost:?}");
            let edges = bench.edges.len();
            assert!(bench.edges.iter().all(|edge| edge.t <= t_dark));
            bench.falsify = Some;
            bench.run(TimeNs(1200 * MS), TimeNs(0));
            assert!(bench.edges.len() > edges);
        }
    }

    #[test]
    fn a_frame_that_nobody_renews_goes_dark_after_the_stall_timeout() {
        for mode in MODES {
            let mut bench = Bench::new(mode);
            bench.submit();
            for tick in 0..2000 {
                bench.wake(TimeNs(tick * MS));
            }
            let last = bench.edges.last().unwrap();
            assert!(!last.on && last.t > TimeNs(480 * MS) && last.t < TimeNs(540 * MS), "{last:?}");
            assert_eq!(bench.all_events.last().unwrap().dark, Some(DarkReason::Stall));
            assert_eq!(bench.verdict().findings, []);
        }
    }

    #[test]
    fn a_latched_dark_stays_dark() {
        let mut bench = Bench::new(PanelMode::ChannelPacked);
        bench.run(TimeNs(300 * MS), TimeNs(0));
        bench.laser.shared.latch.store(1, Ordering::Release);
        bench.run(TimeNs(305 * MS), TimeNs(0));
        assert_eq!(bench.laser.shared.acknowledged.load(Ordering::Acquire), DARK);
        let edges = bench.edges.len();
        bench.run(TimeNs(2000 * MS), TimeNs(0));
        assert_eq!(bench.edges.len(), edges);
        assert_eq!(bench.verdict().unsafe_findings().count(), 0);
    }

    /// A box that fails when it is told so.
    struct Faulty {
        inner: SimulatedLaser,
        fails: Arc<AtomicBool>,
    }

    impl Faulty {
        fn check(&self) -> Result<(), LaserError> {
            let refused = LaserError::Refused { command: "test", refusal: Refusal::Malformed };
            if self.fails.load(Ordering::Relaxed) { Err(refused) } else { Ok(()) }
        }
    }

    impl LaserBox for Faulty {
        fn is_simulated(&self) -> bool {
            true
        }
        fn program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), LaserError> {
            self.check().and_then(|()| self.inner.program(program, now))
        }
        fn arm(&mut self, now: TimeNs) -> Result<(), LaserError> {
            self.check().and_then(|()| self.inner.arm(now))
        }
        fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<(), LaserError> {
            self.check().and_then(|()| self.inner.sync(t_sync, now))
        }
        fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<(), LaserError> {
            self.check().and_then(|()| self.inner.light(window, now))
        }
        fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError> {
            self.check().and_then(|()| self.inner.heartbeat(now))
        }
        fn dark(&mut self, reason: DarkReason, now: TimeNs) -> Result<(), LaserError> {
            self.check().and_then(|()| self.inner.dark(reason, now))
        }
        fn poll(&mut self, now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
            self.inner.poll(now, event)
        }
    }

    #[test]
    fn a_box_that_fails_goes_dark_by_itself_and_is_tried_again_later() {
        for mode in MODES {
            let fails = Arc::new(AtomicBool::new(false));
            let laser = Faulty { inner: SimulatedLaser::new(TimeNs(0)), fails: Arc::clone(&fails) };
            let mut bench = Bench::with_box(mode, Box::new(laser));
            bench.run(TimeNs(300 * MS), TimeNs(0));
            fails.store(true, Ordering::Relaxed);
            let t_failed = bench.now;
            bench.run(TimeNs(800 * MS), TimeNs(0));
            let &(t_dark, _) = bench.darks.last().unwrap();
            assert!(t_dark - t_failed <= TimeNs(100 * MS), "the heartbeat timeout");
            assert!(bench.edges.iter().all(|edge| edge.t <= t_dark));
            assert!(bench.all_events.last().unwrap().dark.is_some());
            fails.store(false, Ordering::Relaxed);
            bench.run(TimeNs(2500 * MS), TimeNs(0));
            assert!(bench.edges.last().unwrap().t > TimeNs(2400 * MS));
            assert_eq!(bench.verdict().unsafe_findings().count(), 0);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(96))]

        /// However late the threads wake up, and whenever frames come, no light goes where it must not, every field
        /// without light has a reason, and when everything stops the box goes dark by itself.
        #[test]
        fn no_jitter_and_no_stall_lights_what_it_must_not(
            packed in prop::bool::ANY,
            wakes in prop::collection::vec((prop_oneof![6 => 1i64..6000, 2 => 6000i64..40_000, 1 => 40_000i64..900_000], 0u8..4), 50..400),
        ) {
            let mut bench = Bench::new(if packed { PanelMode::ChannelPacked } else { PanelMode::FieldSequential });
            let mut now = TimeNs(0);
            for (later_us, frames) in wakes {
                if frames == 0 {
                    bench.now = now;
                    bench.submit();
                }
                now = now + TimeNs(later_us * 1000);
                bench.wake(now);
            }
            // The host hangs for good; only the box's own time goes on.
            let t_hang = now;
            let mut left = Vec::new();
            bench.laser.laser.poll(now + TimeNs(10_000 * MS), &mut |event| left.push(event)).unwrap();
            for event in left {
                match event {
                    BoxEvent::Edge(edge) => {
                        prop_assert!(edge.t - t_hang <= TimeNs(100 * MS));
                        bench.edges.push(edge);
                    }
                    BoxEvent::Dark { t, .. } => prop_assert!(t - t_hang <= TimeNs(100 * MS)),
                    BoxEvent::Armed { .. } => prop_assert!(false),
                }
            }
            // The panel shows on what it has, and a panel would say so.
            let mut fields = Vec::new();
            bench.panel.tick(t_hang + TimeNs(60 * MS), &mut bench.source, &mut |field| fields.push(field));
            for field in fields {
                bench.laser.ledger.field(&field, Some(DarkReason::Heartbeat), &bench.laser.shared);
            }
            let report = bench.verdict();
            prop_assert_eq!(report.findings, vec![], "edges {:?}", bench.edges.len());
        }
    }

    #[test]
    fn the_real_threads_show_light_and_end_in_order() {
        for mode in MODES {
            let rig = rig(mode);
            let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
            let options = OutputOptions { keep_slots: 1, ..OutputOptions::default() };
            let mut output = Output::headless(&rig, &encoder, options, monotonic_now).unwrap();
            let config = pacing_config(&rig, TimeNs(2 * MS)).unwrap();
            let mut pacer = Pacer::new(config, monotonic_now());
            let pattern = vec![1.0f32; SIZE.pixels()];
            let mut last_plan = None;
            let mut reports = 0;
            for frame in 0..30 {
                output.frames.feed(&mut pacer, |_| reports += 1);
                let plan = pacer.predict(monotonic_now());
                let rest = plan.t_wake - monotonic_now();
                std::thread::sleep(Duration::from_nanos(rest.0.max(0) as u64));
                encoder.encode(PerColour([&pattern; 3]), output.frames.acquire());
                let now = monotonic_now();
                output.frames.submit(&plan, Some(0), now);
                pacer.mark(crate::pacing::Point::Submit, plan.frame_id, now);
                last_plan = Some(plan);
                assert_eq!(plan.frame_id, frame + 1);
            }
            let report = output.control.shutdown();
            assert!(report.lasers_dark && report.flat_presented, "{report:?}");
            assert!(reports > 0);
            let kept = report.kept[0].as_ref().unwrap();
            assert_eq!(kept.unpack_colour(Colour::Blue).levels, [41; SIZE.pixels()]);
            assert!(report.last_frame.unwrap().tag().frame_id <= last_plan.unwrap().frame_id);

            let mut events = Vec::new();
            while let Ok(event) = output.events.pop() {
                events.push(event);
            }
            let mut edges = Vec::new();
            let mut t_dark = None;
            while let Ok(event) = output.box_events.pop() {
                match event {
                    BoxEvent::Edge(edge) => edges.push(edge),
                    BoxEvent::Dark { t, .. } => t_dark = Some(t),
                    BoxEvent::Armed { .. } => t_dark = None,
                }
            }
            assert!(t_dark.is_some(), "the box ends dark");
            let spans: Vec<_> = events.iter().map(FieldEvent::span).collect();
            let verdict = verify_edges(&spans, &edges);
            assert_eq!(verdict.findings, [], "{:?}", report.counts);
            assert!(verdict.lit > 0);
            assert_eq!((report.counts.fields, report.counts.lost), (events.len() as u64, 0));
        }
    }

    #[test]
    fn a_control_that_is_dropped_ends_the_output() {
        let rig = rig(PanelMode::ChannelPacked);
        let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
        let output = Output::headless(&rig, &encoder, OutputOptions::default(), monotonic_now).unwrap();
        let switch = output.control.dark_switch();
        drop(output);
        assert!(switch.is_dark());
        assert!(switch.shared.flat_shown.load(Ordering::Acquire));
    }
}
