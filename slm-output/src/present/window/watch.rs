//! Between the thread that watches a window (`holod-window`) and the panel thread: a fault, if there is one, and the
//! refreshes that the display server reports. The panel thread's side neither allocates nor waits.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::thread::JoinHandle;

use holod_calibration::TimeNs;
use rtrb::{Consumer, Producer, RingBuffer};
use rustix::event::{EventfdFlags, eventfd};

use super::WindowError;
use super::monitors::Monitor;
use crate::present::{AlterationKind, PanelFault};

/// What a display server says of one presented picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Completion {
    /// Number of the presentation, from 1 for a surface's first.
    pub(super) serial: u32,
    /// When it came on the monitor, on the monotonic clock, as the server has it.
    pub(super) t_present: TimeNs,
    /// The server's count of the monitor's refreshes.
    pub(super) refresh_count: u64,
    /// How it came on the monitor.
    pub(super) shown: Shown,
}

/// How a picture came on a monitor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Shown {
    /// The display controller scans it out from this refresh on, and the driver stamped the time.
    Flipped,
    /// It was copied to what is scanned out, near this time: the copy may be later than the scan.
    Copied,
    /// A newer one took its place.
    Skipped,
}

/// Completions on their way; a reader that is so far behind has more to worry about than the newest ones.
const RING: usize = 64;

#[derive(Debug)]
struct Shared {
    fault: AtomicU8,
    placed: AtomicBool,
    /// Rung when there is something for the panel thread.
    bell: OwnedFd,
    /// Rung when the watcher shall end.
    order: OwnedFd,
}

impl Shared {
    fn tell(&self, fault: PanelFault) {
        let code = 1 + FAULTS.iter().position(|known| *known == fault).unwrap_or(0);
        // The first one is the cause of those that follow.
        let _there_is_one = self.fault.compare_exchange(0, code as u8, Ordering::AcqRel, Ordering::Relaxed);
        ring(&self.bell);
    }
}

/// The faults that a watcher finds.
const FAULTS: [PanelFault; 11] = [
    PanelFault::WindowLost,
    PanelFault::Unplugged,
    PanelFault::ModeRefused,
    PanelFault::Primary,
    PanelFault::Ambiguous,
    PanelFault::Altered(AlterationKind::Scaled),
    PanelFault::Altered(AlterationKind::Transformed),
    PanelFault::Altered(AlterationKind::Interlaced),
    PanelFault::Altered(AlterationKind::GammaRamp),
    PanelFault::Altered(AlterationKind::Mirrored),
    PanelFault::Altered(AlterationKind::Asleep),
];

/// A counter at its limit is rung already.
fn ring(bell: &OwnedFd) {
    let _rung = rustix::io::write(bell, &1u64.to_ne_bytes());
}

/// A window that is watched; its watcher ends with it.
#[derive(Debug)]
pub(super) struct Watched {
    monitor: Monitor,
    completions: Consumer<Completion>,
    reports_completions: bool,
    shared: Arc<Shared>,
    /// The watcher's connection, where it waits for answers on it.
    socket: Option<OwnedFd>,
    thread: Option<JoinHandle<()>>,
}

impl Watched {
    /// Starts the watcher: `watch` runs on a thread of its own and returns what is wrong, or when it is ordered to end.
    /// Where it waits for a display server's answers, its end shuts their `socket`: one that hangs answers never.
    pub(super) fn start(
        monitor: Monitor,
        reports_completions: bool,
        socket: Option<OwnedFd>,
        watch: impl FnOnce(&mut Watcher) -> PanelFault + Send + 'static,
    ) -> Result<Self, WindowError> {
        let descriptor = || eventfd(0, EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC);
        let shared = Arc::new(Shared {
            fault: AtomicU8::new(0),
            placed: AtomicBool::new(false),
            bell: descriptor().map_err(|why| WindowError::System(why.into()))?,
            order: descriptor().map_err(|why| WindowError::System(why.into()))?,
        });
        let (producer, completions) = RingBuffer::new(RING);
        let mut watcher = Watcher { completions: producer, shared: shared.clone() };
        let thread = std::thread::Builder::new()
            .name("holod-window".into())
            .spawn(move || {
                let fault = watch(&mut watcher);
                watcher.shared.tell(fault);
            })
            .map_err(WindowError::System)?;
        Ok(Self { monitor, completions, reports_completions, shared, socket, thread: Some(thread) })
    }

    /// Where the window is.
    pub(super) fn monitor(&self) -> &Monitor {
        &self.monitor
    }

    /// Readable when there is something new.
    pub(super) fn bell(&self) -> BorrowedFd<'_> {
        self.shared.bell.as_fd()
    }

    /// Whether the window has been seen on its monitor.
    pub(super) fn is_placed(&self) -> bool {
        self.shared.placed.load(Ordering::Acquire)
    }

    /// Whether the display server can say when pictures came on the monitor.
    pub(super) fn reports_completions(&self) -> bool {
        self.reports_completions
    }

    /// What is wrong, if anything is. Silences the bell.
    pub(super) fn check(&self) -> Result<(), PanelFault> {
        let _silent_already = rustix::io::read(&self.shared.bell, &mut [0u8; 8]);
        match self.shared.fault.load(Ordering::Acquire) {
            0 => Ok(()),
            code => Err(FAULTS[usize::from(code) - 1]),
        }
    }

    /// The next completion, in order.
    pub(super) fn completion(&mut self) -> Option<Completion> {
        self.completions.pop().ok()
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        ring(&self.shared.order);
        if let Some(socket) = &self.socket {
            // Where it is shut already, nobody waits on it.
            let _shut = rustix::net::shutdown(socket, rustix::net::Shutdown::Both);
        }
        if let Some(thread) = self.thread.take() {
            // A panic over there has been reported by the panic hook.
            let _ended = thread.join();
        }
    }
}

/// The watcher's end. Dropped by a panic, it tells that the window is lost.
pub(super) struct Watcher {
    completions: Producer<Completion>,
    shared: Arc<Shared>,
}

impl Watcher {
    /// Readable when the watcher shall end.
    pub(super) fn order(&self) -> &OwnedFd {
        &self.shared.order
    }

    /// The window is on its monitor.
    pub(super) fn placed(&self) {
        if !self.shared.placed.swap(true, Ordering::AcqRel) {
            ring(&self.shared.bell);
        }
    }

    /// Hands a completion on.
    pub(super) fn completed(&mut self, completion: Completion) {
        let _full = self.completions.push(completion);
        ring(&self.shared.bell);
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        self.shared.tell(PanelFault::WindowLost);
    }
}
