//! How the output is ended, and made dark.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::{JoinHandle, Thread};
use std::time::Duration;

use holod_calibration::TimeNs;

use super::panel_thread::ring;
use super::shared::{DARK, NEXT, NOT_YET, OutputCounts, Shared, WISH, code_of, dark_because, dark_request_parts};
use super::{Clock, SLEEP_MAX};
use crate::fields::LevelsFrame;
use crate::laser::DarkReason;

/// How long beyond the box's own wait for an acknowledgement shutdown waits for it.
const DARK_MARGIN: TimeNs = TimeNs(50_000_000);
/// Boxes that are asked twice take a second.
const KEEP_DARK_WAIT: TimeNs = TimeNs(2_000_000_000);
/// Whoever asked has an answer before the control socket and the service's watchdog give up.
const KEEP_DARK_WAIT_MAX: TimeNs = TimeNs(4_000_000_000);
/// How long the panel's thread is waited for at the end: a mode may be set once more, a display server may hang.
const PANEL_WAIT: TimeNs = TimeNs(3_000_000_000);
/// How long a panic waits for it.
const PANIC_WAIT: TimeNs = TimeNs(20_000_000);
/// How long a panic's message is waited for.
const PANIC_MESSAGE_WAIT: TimeNs = TimeNs(1_000_000_000);

/// How the output ended.
#[derive(Debug)]
pub struct ShutdownReport {
    /// The laser box acknowledged that it is dark.
    pub lasers_dark: bool,
    /// The flat pattern was on the panel before the threads ended.
    pub flat_presented: bool,
    /// The panel's thread has ended and closed the panel. One that hangs, as where its display server does, is left to
    /// the end of the process.
    pub panel_ended: bool,
    /// Levels of the frames that were shown and kept, by slot; none where the panel's thread has not ended.
    pub kept: Vec<Option<LevelsFrame>>,
    /// Counters at the end.
    pub counts: OutputCounts,
}

#[derive(Debug)]
pub(super) struct Threads {
    pub(super) panel: JoinHandle<Vec<Option<LevelsFrame>>>,
    pub(super) laser: JoinHandle<()>,
}

/// Ends the output; dropped, it ends it too.
#[derive(Debug)]
pub struct OutputControl {
    pub(super) switch: DarkSwitch,
    pub(super) doorbell: Arc<OwnedFd>,
    pub(super) frame_period: TimeNs,
    /// From the display's report of a refresh to the panel's update with it.
    pub(super) latency: TimeNs,
    /// How long the laser box may wait for an acknowledgement.
    pub(super) dark_wait: TimeNs,
    pub(super) threads: Option<Threads>,
    pub(super) clock: Clock,
}

impl OutputControl {
    /// The switch that makes the lasers dark for good.
    pub fn dark_switch(&self) -> DarkSwitch {
        self.switch.clone()
    }

    /// The control goes on: signals and limits are looked at. From the first call on lasers are kept dark, as
    /// [`DarkReason::Unattended`], while the last one is more than 5 s ago. The waits of [`Self::keep_dark`] count as
    /// calls.
    pub fn attend(&self) {
        self.switch.shared.t_attended_ns.store((self.clock)().0, Ordering::Release);
    }

    /// Keeps the lasers dark for the reason `why` until this is taken back with none; then they are lit again by the
    /// rules. Waits for the box, two seconds or as long as its lasers may take, four at most; whether it has
    /// acknowledged. They are kept dark also where it has not.
    pub fn keep_dark(&self, why: Option<DarkReason>) -> bool {
        let request = self.switch.request(|request| dark_because(request + NEXT, why));
        self.wait_for(request)
    }

    /// Keeps the lasers dark as a person has wished, from when it was wished on; waits and answers as
    /// [`Self::keep_dark`], which takes it back.
    pub fn keep_dark_as_wished(&self, wish: DarkWish) -> bool {
        // The laser thread has the request already, and keeps to it.
        self.switch.request(|request| dark_because(request, Some(DarkReason::Asked)));
        let request = wish.request;
        drop(wish);
        self.wait_for(request)
    }

    /// Waits for the box's answer to a request, or a later one; whether it has acknowledged.
    fn wait_for(&self, request: u64) -> bool {
        let t_end = (self.clock)() + KEEP_DARK_WAIT.max(self.dark_wait + DARK_MARGIN).min(KEEP_DARK_WAIT_MAX);
        loop {
            if let Some(acknowledged) = self.switch.answer_to(request) {
                return acknowledged;
            }
            if (self.clock)() > t_end {
                return false;
            }
            if self.switch.shared.t_attended_ns.load(Ordering::Acquire) != 0 {
                self.attend();
            }
            std::thread::sleep(Duration::from_micros(500));
        }
    }

    /// What both threads have counted since the start, and how panel and lasers are now.
    pub fn counts(&self) -> OutputCounts {
        self.switch.shared.counts()
    }

    /// Ends the output in order: lasers dark and acknowledged, flat pattern on the panel, threads joined. The waits for
    /// darkness, the flat pattern and the panel's end are bounded; a box that does not answer is left to its heartbeat
    /// timeout.
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
        let dark_wait = self.dark_wait + DARK_MARGIN;
        wait_for(&|| shared.acknowledged.load(Ordering::Acquire) != NOT_YET, dark_wait);
        shared.flat_wanted.store(true, Ordering::Release);
        ring(&self.doorbell);
        let flat_patience = TimeNs(4 * self.frame_period.0 + SLEEP_MAX.0 + 200_000_000);
        // A panel that is lost shows nothing any more.
        let flat = || shared.flat_shown.load(Ordering::Acquire);
        let flat_presented = wait_for(&|| flat() || shared.panel_lost.load(Ordering::Acquire), flat_patience) && flat();
        if flat_presented {
            std::thread::sleep(Duration::from_nanos(self.latency.0 as u64));
        }
        shared.stop.store(true, Ordering::Release);
        ring(&self.doorbell);
        let (kept, counts) = (Vec::new(), OutputCounts::default());
        let mut report =
            ShutdownReport { lasers_dark: self.switch.is_dark(), flat_presented, panel_ended: true, kept, counts };
        if let Some(Threads { panel, laser }) = self.threads.take() {
            report.panel_ended = wait_for(&|| panel.is_finished(), PANEL_WAIT);
            if report.panel_ended {
                // A panic over there has been reported by the panic hook.
                report.kept = panel.join().unwrap_or_default();
            }
            laser.thread().unpark();
            // It may have been told late.
            report.lasers_dark = laser.join().is_ok() && self.switch.is_dark();
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

/// Makes the lasers dark, for good or as a person wishes, from any thread.
#[derive(Clone, Debug)]
pub struct DarkSwitch {
    pub(super) shared: Arc<Shared>,
    pub(super) laser: Thread,
}

impl DarkSwitch {
    /// A switch that switches nothing, for whoever has no output.
    pub fn of_no_output() -> Self {
        Self { shared: Arc::default(), laser: std::thread::current() }
    }

    /// Asks the laser thread for darkness because a person wishes it. Does not wait; whatever the control of the output
    /// asks for meanwhile, lasers are dark until it has taken the wish over ([`OutputControl::keep_dark_as_wished`]).
    pub fn wish_dark(&self) -> DarkWish {
        let request = self.request(|request| dark_because(request + NEXT + WISH, Some(DarkReason::Asked)));
        DarkWish { switch: self.clone(), request }
    }

    /// Whether the box has acknowledged darkness, once it has answered to this request of [`DarkWish::request`] or to a
    /// later one.
    pub fn answer_to(&self, request: u64) -> Option<bool> {
        let answer = self.shared.dark_answer.load(Ordering::Acquire);
        (answer >> 2 >= request).then_some(answer & 3 == u64::from(DARK))
    }

    /// Changes the request for darkness, of which other threads may have another one; its number.
    fn request(&self, change: impl Fn(u64) -> u64) -> u64 {
        let changed = |request| Some(change(request));
        let before = self.shared.dark_request.fetch_update(Ordering::AcqRel, Ordering::Acquire, changed);
        self.laser.unpark();
        dark_request_parts(change(before.unwrap_or_else(|unchanged| unchanged))).0
    }

    /// Asks the laser thread for darkness; the first reason stays. Does not wait.
    pub fn dark(&self, reason: DarkReason) {
        let _first = self.shared.latch.compare_exchange(0, code_of(Some(reason)), Ordering::AcqRel, Ordering::Acquire);
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
    /// One of which `is_caught` says, on the thread that panics, that it is caught and is an error like any other, does
    /// nothing.
    pub fn install_panic_hook(&self, clock: Clock, is_caught: fn() -> bool) {
        let switch = self.clone();
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if is_caught() {
                return;
            }
            switch.shared.panics.fetch_add(1, Ordering::AcqRel);
            switch.dark(DarkReason::Panic);
            let t_end = clock() + PANIC_WAIT;
            let on_laser_thread = std::thread::current().id() == switch.laser.id();
            while !on_laser_thread && !switch.is_dark() && clock() < t_end {
                std::thread::sleep(Duration::from_micros(200));
            }
            before(info);
            switch.shared.panics.fetch_sub(1, Ordering::AcqRel);
        }));
    }

    /// Waits, for a second at most, until what panicked has said so: whoever ends the program earlier ends the message.
    pub fn wait_for_panic_message(&self, clock: Clock) {
        let t_end = clock() + PANIC_MESSAGE_WAIT;
        while self.shared.panics.load(Ordering::Acquire) > 0 && clock() < t_end {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// A person's wish for darkness. In force until it is taken over; dropped without that, lasers stay dark until the
/// control of the output asks for something else.
#[derive(Debug)]
pub struct DarkWish {
    switch: DarkSwitch,
    request: u64,
}

impl DarkWish {
    /// The number of its request.
    pub const fn request(&self) -> u64 {
        self.request
    }
}

impl Drop for DarkWish {
    fn drop(&mut self) {
        self.switch.shared.dark_request.fetch_sub(WISH, Ordering::AcqRel);
    }
}
