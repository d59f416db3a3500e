//! The output's threads: the panel, and the lasers that follow it.
//!
//! | Thread | Does |
//! |---|---|
//! | the caller's frame thread | fills a frame from [`FramePort::acquire`], hands it over with [`FramePort::submit`] |
//! | `holod-panel` | runs the [`Presenter`]; tells the laser thread of each refresh of the panel |
//! | `holod-laser` | asks the [`FieldScheduler`], drives the [`LaserBox`], publishes a [`FieldEvent`] when a field is over |
//!
//! After their start they neither allocate, lock nor log; what they have to say goes through wait-free rings and
//! counters, and where nobody reads a ring its newest entries are dropped and counted.

mod control;
mod laser_thread;
mod ledger;
mod panel_thread;
mod port;
mod shared;
#[cfg(test)]
mod tests;

pub use self::control::{DarkSwitch, DarkWish, OutputControl, ShutdownReport};
pub use self::ledger::FieldEvent;
pub use self::panel_thread::PanelEvent;
pub use self::port::{FramePort, PresentReport};
pub use self::shared::OutputCounts;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;

use holod_calibration::TimeNs;
use holod_calibration::rig::Rig;
use rtrb::{Consumer, RingBuffer};
use rustix::event::{EventfdFlags, eventfd};

use self::control::Threads;
use self::laser_thread::LaserThread;
use self::ledger::Ledger;
use self::panel_thread::PanelThread;
use self::shared::Shared;
use crate::fields::FrameLayout;
use crate::laser::{BoxEvent, Capability, DarkReason, LaserBox, LaserError, LaserProgram, LaserWatch};
use crate::levels::PanelEncoder;
use crate::pacing::PacingConfig;
use crate::present::{OpenError, PanelLook, PanelSetup, Presenter, Recorder, frame_channel, look};
use crate::schedule::{Evidence, FieldGate, FieldScheduler, WindowClock};

/// A monotonic clock. The threads read it; nothing below them does.
pub type Clock = fn() -> TimeNs;

/// Reports on their way to the frame thread.
const SHORT_RING: usize = 256;
/// Refreshes on their way to the laser thread, where they wait for a panel's latency: 200 of them at the most that a rig
/// may say, 100 ms and 2000 Hz.
const NEWS_RING: usize = 1024;
/// Events on their way to whoever records them: some 20 s of fields at 180 Hz.
const LONG_RING: usize = 4096;
/// Longest sleep of a thread, so that it sees an order to stop.
const SLEEP_MAX: TimeNs = TimeNs(20_000_000);

/// What may be chosen about the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutputOptions {
    /// Frames whose presented levels can be kept in memory (see [`FramePort::submit`]).
    pub keep_slots: usize,
    /// Lasers go dark when one frame has stayed on the panel for this long. Not less than a few times the slowest
    /// frame.
    pub stall_timeout: TimeNs,
    /// Whether somebody may look at what is shown ([`Output::look`]).
    pub look: bool,
}

impl Default for OutputOptions {
    /// Nothing is kept, nobody looks; 2 s.
    fn default() -> Self {
        Self { keep_slots: 0, stall_timeout: TimeNs(2_000_000_000), look: false }
    }
}

/// Why the output could not be started.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The panel cannot be opened.
    #[error(transparent)]
    Panel(#[from] OpenError),
    /// The laser box cannot be opened, refuses its program, or the rig leaves no time for light.
    #[error(transparent)]
    Laser(#[from] LaserError),
    /// A thread could not be started.
    #[error("cannot start a thread: {0}; check the limits on threads and memory")]
    Thread(#[from] std::io::Error),
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
    /// For whoever tells people: the panel was lost or came back.
    pub panel_events: Consumer<PanelEvent>,
    /// Whether lasers are lit by software's times of the panel: of a virtual one, or where the box times its own windows.
    pub takes_software_times: bool,
    /// For whoever tells people: what went wrong with the laser box.
    pub laser_faults: Consumer<LaserError>,
    /// For whoever tells people: why the laser box is lost, where it can be.
    pub laser_watch: Option<LaserWatch>,
    /// For whoever wants to see what is on the panel.
    pub look: Option<PanelLook>,
    /// For whoever ends it.
    pub control: OutputControl,
}

impl Output {
    /// Starts on any panel with any laser box. Over a virtual panel real lasers stay dark: nothing is on any panel.
    ///
    /// # Errors
    /// [`OutputError`] where the rig leaves no time for light, the box refuses its program or a thread does not start.
    pub fn start(
        rig: &Rig,
        encoder: &PanelEncoder,
        panel: Box<dyn Presenter>,
        mut laser: Box<dyn LaserBox>,
        options: OutputOptions,
        clock: Clock,
    ) -> Result<Self, OutputError> {
        let flat = PanelSetup::new(&rig.panel, encoder).flat;
        let Lighting { scheduler, program, takes_software_times } =
            Lighting::of(rig, flat.layout(), panel.is_virtual(), laser.capability(), options.stall_timeout)?;
        laser.dark(DarkReason::Boot, clock())?;
        laser.program(&program, clock())?;

        let (sink, source) = frame_channel(&flat);
        let (news_producer, news_consumer) = RingBuffer::new(NEWS_RING);
        let (report_producer, report_consumer) = RingBuffer::new(SHORT_RING);
        let (event_producer, event_consumer) = RingBuffer::new(LONG_RING);
        let (box_producer, box_consumer) = RingBuffer::new(LONG_RING);
        let (panel_producer, panel_consumer) = RingBuffer::new(SHORT_RING);
        let (fault_producer, fault_consumer) = RingBuffer::new(SHORT_RING);
        let laser_watch = laser.watch();
        let gates_fields = laser.capability().gates_fields;
        let dark_wait = laser.dark_wait();
        let shared = Arc::new(Shared::default());
        let doorbell =
            Arc::new(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK).map_err(std::io::Error::from)?);
        let gate = scheduler.gate();

        let laser_thread = LaserThread {
            laser,
            program,
            scheduler,
            news: news_consumer,
            ledger: Ledger::new(gate, gates_fields, event_producer, box_producer),
            faults: fault_producer,
            t_retry: TimeNs(i64::MIN),
            program_lost: false,
            dark_request: 0,
            asked: None,
            is_unattended: false,
            shared: Arc::clone(&shared),
            latency: gate.timing().latency,
            clock,
        };
        let laser = std::thread::Builder::new().name("holod-laser".into()).spawn(move || laser_thread.run())?;
        let (looked_at, look) = options.look.then(|| look(&flat)).unzip();
        let panel_thread = PanelThread {
            panel: Recorder::new(panel, &flat, options.keep_slots).looked_at(looked_at),
            frames: source,
            news: news_producer,
            reports: report_producer,
            events: panel_producer,
            laser: laser.thread().clone(),
            doorbell: Arc::clone(&doorbell),
            shared: Arc::clone(&shared),
            latency: gate.timing().latency,
            clock,
        };
        let threads = Threads::start_panel(laser, panel_thread)?;
        Ok(Self {
            frames: FramePort { sink, reports: report_consumer },
            events: event_consumer,
            box_events: box_consumer,
            panel_events: panel_consumer,
            takes_software_times,
            laser_faults: fault_consumer,
            laser_watch,
            look,
            control: OutputControl {
                switch: DarkSwitch { shared, laser: threads.laser.thread().clone() },
                doorbell,
                frame_period: gate.timing().frame_period,
                latency: gate.timing().latency,
                dark_wait,
                threads: Some(threads),
                clock,
            },
        })
    }
}

impl Threads {
    /// Starts the panel's thread; where it does not start, the lasers' is ended.
    fn start_panel(laser: JoinHandle<()>, panel: PanelThread) -> Result<Self, OutputError> {
        let shared = Arc::clone(&panel.shared);
        match std::thread::Builder::new().name("holod-panel".into()).spawn(move || panel.run()) {
            Ok(panel) => Ok(Self { panel, laser }),
            Err(why) => {
                shared.stop.store(true, Ordering::Release);
                laser.thread().unpark();
                // A panic over there has been reported by the panic hook.
                let _ended = laser.join();
                Err(why.into())
            }
        }
    }
}

/// When lasers are lit over a panel.
struct Lighting {
    scheduler: FieldScheduler,
    program: LaserProgram,
    takes_software_times: bool,
}

impl Lighting {
    fn of(
        rig: &Rig,
        layout: FrameLayout,
        is_virtual: bool,
        capability: Capability,
        stall_timeout: TimeNs,
    ) -> Result<Self, LaserError> {
        let virtual_bench = is_virtual && capability.simulated;
        // A box with a wire to the panel's sync times its own windows, and in channel-packed mode the panel's own
        // sequence says which colour each of them is for: that frames go by is all that must be known here.
        let window_clock = WindowClock::of(&rig.panel, capability);
        let wired = !is_virtual && capability.sync_wire && window_clock == WindowClock::Panel;
        let evidence = if virtual_bench || wired { Evidence::Seen } else { Evidence::Stamped };
        let scheduler = FieldScheduler::new(&rig.panel, layout, &rig.lasers, evidence, window_clock, stall_timeout)?;
        let program = scheduler.program(&rig.panel, &rig.lasers)?;
        Ok(Self { scheduler, program, takes_software_times: evidence == Evidence::Seen })
    }
}

/// What a pacer must know to make frames for the output of `rig`.
///
/// # Errors
/// As [`FieldGate::new`].
pub fn pacing_config(rig: &Rig, first_frame_time: TimeNs) -> Result<PacingConfig, LaserError> {
    let gate = FieldGate::new(&rig.panel, &rig.lasers)?;
    let timing = gate.timing();
    // The middle of the fields stands for all of them.
    let middle_field_ns = timing.field_period.0 * (timing.fields as i64 - 1) / 2;
    Ok(PacingConfig {
        refresh_period: timing.frame_period,
        photon_delay: TimeNs(middle_field_ns) + gate.middle(),
        latency: timing.latency,
        submit_margin: timing.submit_margin(),
        first_frame_time,
    })
}
