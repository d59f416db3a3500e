//! Faults on command, for the bench that shows that any of them makes the lasers dark.
//!
//! Only in builds with the feature `fault-injection`. `HOLOD_FAULT` names the fault, SIGUSR1 lets it happen. Threads
//! meet it where they read the clock, and the panel's reports where they pass through [`FaultyPanel`].

use std::hint::black_box;
use std::os::fd::BorrowedFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use holod_calibration::TimeNs;
use holod_slm_output::LevelsFrame;
use holod_slm_output::present::{FrameSource, PanelFault, PresentedRefresh, Presenter};
use signal_hook::consts::SIGUSR1;

use crate::failure::{Exit, Failure};

/// What goes wrong, by the name that follows `HOLOD_FAULT=`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// The thread of this name panics.
    Panic(&'static str),
    /// The thread of this name goes on no more.
    Stall(&'static str),
    /// The frame thread takes memory until there is none.
    Memory,
    /// The clock that all threads read is set by this many nanoseconds, ahead where they are positive.
    Clock(i64),
    /// The panel reports no refresh any more.
    NoReports,
    /// The panel reports each refresh twice.
    DoubledReports,
    /// The panel is unplugged.
    Unplug,
    /// The GPU is lost, once.
    GpuLost,
}

const FAULTS: [(&str, Fault); 15] = [
    ("panic-frame", Fault::Panic("holod-frame")),
    ("panic-panel", Fault::Panic("holod-panel")),
    ("panic-laser", Fault::Panic("holod-laser")),
    ("panic-control", Fault::Panic("main")),
    ("stall-frame", Fault::Stall("holod-frame")),
    ("stall-panel", Fault::Stall("holod-panel")),
    ("stall-laser", Fault::Stall("holod-laser")),
    ("stall-control", Fault::Stall("main")),
    ("memory", Fault::Memory),
    ("clock-forward", Fault::Clock(10_000_000_000)),
    ("clock-back", Fault::Clock(-10_000_000_000)),
    ("no-reports", Fault::NoReports),
    ("doubled-reports", Fault::DoubledReports),
    ("unplug", Fault::Unplug),
    ("gpu-lost", Fault::GpuLost),
];

struct Plan {
    fault: Fault,
    triggered: Arc<AtomicBool>,
    /// A thread has panicked: what it still does must not panic again.
    panicked: AtomicBool,
}

static PLAN: OnceLock<Plan> = OnceLock::new();

/// Reads `HOLOD_FAULT` and waits for the signal.
///
/// # Errors
/// The variable names no fault.
pub(crate) fn install() -> Result<(), Failure> {
    let Ok(name) = std::env::var("HOLOD_FAULT") else { return Ok(()) };
    let Some((_, fault)) = FAULTS.iter().find(|(known, _)| *known == name) else {
        let names: Vec<&str> = FAULTS.iter().map(|(name, _)| *name).collect();
        let expected = names.join(", ");
        return Err(Failure::new(Exit::Usage, format!("HOLOD_FAULT: found '{name}', expected one of {expected}")));
    };
    let triggered = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGUSR1, Arc::clone(&triggered)).map_err(Failure::because(Exit::Software))?;
    let _already = PLAN.set(Plan { fault: *fault, triggered, panicked: AtomicBool::new(false) });
    tracing::warn!("a fault is prepared: {name}; SIGUSR1 lets it happen");
    Ok(())
}

/// The fault, once it happens.
fn now_happening() -> Option<Fault> {
    PLAN.get().filter(|plan| plan.triggered.load(Ordering::Acquire)).map(|plan| plan.fault)
}

fn first_panic() -> bool {
    PLAN.get().is_some_and(|plan| !plan.panicked.swap(true, Ordering::AcqRel))
}

/// Whether the GPU is lost now: once it happens, and once only.
#[cfg(feature = "gpu")]
pub(crate) fn gpu_is_lost() -> bool {
    now_happening() == Some(Fault::GpuLost) && first_panic()
}

/// The clock of the run's threads, which is where the fault finds them.
pub(crate) fn host_now() -> TimeNs {
    let now = holod_calibration::host_now();
    let Some(fault) = now_happening() else { return now };
    let this = |name: &str| std::thread::current().name() == Some(name);
    match fault {
        Fault::Panic(name) if this(name) && first_panic() => panic!("the fault that was asked for"),
        Fault::Stall(name) if this(name) => loop {
            std::thread::sleep(Duration::from_secs(3600));
        },
        Fault::Memory if this("holod-frame") => exhaust_memory(),
        Fault::Clock(by_ns) => now + TimeNs(by_ns),
        _ => now,
    }
}

/// Takes memory until the system gives none; the process then aborts, as any Rust program does.
fn exhaust_memory() -> ! {
    use rustix::process::{Resource, Rlimit, setrlimit};
    let limit = Rlimit { current: Some(1 << 20), maximum: Some(1 << 20) };
    let _unlimited = setrlimit(Resource::As, limit);
    let mut taken = Vec::new();
    // Not written to: that would be time spent on pages, before there is any want of memory.
    loop {
        taken.push(black_box(Vec::<u8>::with_capacity(1 << 20)));
    }
}

/// Any panel, with the faults of a panel.
pub(crate) struct FaultyPanel(pub(crate) Box<dyn Presenter>);

impl Presenter for FaultyPanel {
    fn is_virtual(&self) -> bool {
        self.0.is_virtual()
    }

    fn wake_fd(&self) -> Option<BorrowedFd<'_>> {
        self.0.wake_fd()
    }

    fn t_next(&self) -> TimeNs {
        self.0.t_next()
    }

    fn tick(
        &mut self,
        now: TimeNs,
        frames: &mut FrameSource,
        presented: &mut dyn FnMut(PresentedRefresh),
    ) -> Result<(), PanelFault> {
        let fault = now_happening();
        if fault == Some(Fault::Unplug) {
            return Err(PanelFault::Unplugged);
        }
        self.0.tick(now, frames, &mut |refresh| {
            if fault != Some(Fault::NoReports) {
                presented(refresh);
            }
            if fault == Some(Fault::DoubledReports) {
                presented(PresentedRefresh { t_present: refresh.t_present + TimeNs(1_000_000), ..refresh });
            }
        })
    }

    fn show_flat(&mut self) {
        self.0.show_flat();
    }

    fn recover(&mut self, now: TimeNs) -> Result<(), PanelFault> {
        if now_happening() == Some(Fault::Unplug) {
            return Err(PanelFault::Unplugged);
        }
        self.0.recover(now)
    }

    fn shown(&self) -> Option<&LevelsFrame> {
        self.0.shown()
    }
}
