//! A laser box that is looked for again when it is lost.
//!
//! Opening a box takes seconds, and even closing a port may wait, so a thread of its own does both. Whoever drives the
//! lasers only hands the lost box over and finds a new one in its place: opened, recognised, dark and programmed, to be
//! armed by the same rules as ever.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use holod_calibration::{Colour, TimeNs};
use rtrb::{Consumer, Producer, RingBuffer};

use super::{BoxEvent, Capability, DarkReason, LaserBox, LaserEdge, LaserError, LaserProgram, LitWindow, MissedLight};

/// How long a box that was not found is left alone.
const RETRY_EVERY: Duration = Duration::from_millis(250);
/// Events that wait between a loss and the next [`LaserBox::poll`].
const EVENTS_MAX: usize = 64;
/// How long the closing of a lost box is waited for that does not go dark by itself: longer than it takes to put three
/// lasers out one after the other, some of which do not answer.
const CLOSE_WAIT: Duration = Duration::from_secs(5);

/// What is wrong with the link to a laser box, for a thread that may wait.
#[derive(Clone, Debug, Default)]
pub struct LaserWatch(Arc<Mutex<Option<String>>>);

impl LaserWatch {
    /// Why the box is lost, or was not found again the last time that it was looked for; nothing while it is there.
    pub fn trouble(&self) -> Option<String> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set(&self, trouble: Option<String>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = trouble;
    }
}

/// A box on its way to the thread that closes it and looks for another.
struct Lost {
    laser: Box<dyn LaserBox>,
    why: LaserError,
    program: Option<LaserProgram>,
}

/// Drives a box that may be lost and found.
pub(super) struct Reconnecting {
    current: Option<Box<dyn LaserBox>>,
    capability: Capability,
    dark_wait: TimeNs,
    program: Option<LaserProgram>,
    /// The box was found again and nothing has gone wrong since: it has its program.
    fresh: bool,
    lit: Option<Colour>,
    armed: bool,
    /// Somebody made a box dark, which holds for those that take its place.
    made_dark: bool,
    events: VecDeque<BoxEvent>,
    lost: Producer<Lost>,
    found: Consumer<Box<dyn LaserBox>>,
    watch: LaserWatch,
    stop: Arc<AtomicBool>,
    seeker: JoinHandle<()>,
}

impl Reconnecting {
    /// Drives `laser`, and one that `open` opens when that is lost.
    ///
    /// # Errors
    /// [`LaserError::Line`] where no thread can be started.
    pub(super) fn new(
        laser: Box<dyn LaserBox>,
        open: impl Fn() -> Result<Box<dyn LaserBox>, LaserError> + Send + 'static,
        clock: fn() -> TimeNs,
    ) -> Result<Self, LaserError> {
        let (lost, lost_consumer) = RingBuffer::new(2);
        let (found_producer, found) = RingBuffer::new(2);
        let (watch, stop) = (LaserWatch::default(), Arc::new(AtomicBool::new(false)));
        let (capability, dark_wait) = (laser.capability(), laser.dark_wait());
        let seeker = Seeker {
            open,
            capability,
            lost: lost_consumer,
            found: found_producer,
            watch: watch.clone(),
            stop: Arc::clone(&stop),
            clock,
        };
        let seeker = std::thread::Builder::new().name("holod-laser-find".into()).spawn(move || seeker.run())?;
        Ok(Self {
            current: Some(laser),
            capability,
            dark_wait,
            program: None,
            fresh: false,
            lit: None,
            armed: false,
            made_dark: false,
            events: VecDeque::with_capacity(EVENTS_MAX),
            lost,
            found,
            watch,
            stop,
            seeker,
        })
    }

    /// Does something with the box that is there; a box that fails at it is lost.
    fn with_box<T>(
        &mut self,
        now: TimeNs,
        act: impl FnOnce(&mut dyn LaserBox) -> Result<T, LaserError>,
    ) -> Result<T, LaserError> {
        let laser = self.current.as_mut().ok_or(LaserError::Lost)?;
        match act(laser.as_mut()) {
            Err(why) if why.means_lost() => {
                self.lose(why, now);
                Err(LaserError::Lost)
            }
            Err(why) => {
                self.fresh = false;
                Err(why)
            }
            Ok(done) => Ok(done),
        }
    }

    fn lose(&mut self, why: LaserError, now: TimeNs) {
        let Some(mut laser) = self.current.take() else { return };
        // What its model knows up to now is all that will ever be known.
        let _lost_anyway = laser.poll(now, &mut |event| self.note(event));
        self.made_dark |= laser.is_made_dark();
        if let Some(colour) = self.lit {
            self.note(BoxEvent::Edge(LaserEdge { t: now, colour, on: false }));
        }
        if self.armed {
            self.note(BoxEvent::Dark { t: now, reason: DarkReason::BoxFault });
        }
        self.fresh = false;
        // Two boxes cannot be lost before the first has been found again.
        let _never_full = self.lost.push(Lost { laser, why, program: self.program });
        self.seeker.thread().unpark();
    }

    fn note(&mut self, event: BoxEvent) {
        match event {
            BoxEvent::Armed { .. } => self.armed = true,
            BoxEvent::Edge(edge) => self.lit = edge.on.then_some(edge.colour),
            BoxEvent::Dark { .. } => (self.armed, self.lit) = (false, None),
        }
        if self.events.len() < EVENTS_MAX {
            self.events.push_back(event);
        }
    }
}

impl LaserBox for Reconnecting {
    fn capability(&self) -> Capability {
        self.capability
    }

    fn dark_wait(&self) -> TimeNs {
        self.dark_wait
    }

    fn is_made_dark(&self) -> bool {
        self.made_dark || self.current.as_ref().is_some_and(|laser| laser.is_made_dark())
    }

    fn watch(&self) -> Option<LaserWatch> {
        Some(self.watch.clone())
    }

    fn program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), LaserError> {
        if self.fresh && self.program == Some(*program) && self.current.is_some() {
            return Ok(());
        }
        self.program = Some(*program);
        self.with_box(now, |laser| laser.program(program, now))
    }

    fn arm(&mut self, now: TimeNs) -> Result<(), LaserError> {
        if self.made_dark {
            return Err(LaserError::MadeDark);
        }
        self.with_box(now, |laser| laser.arm(now))
    }

    fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        self.with_box(now, |laser| laser.sync(t_sync, now))
    }

    fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        self.with_box(now, |laser| laser.light(window, now))
    }

    fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.with_box(now, |laser| laser.heartbeat(now))
    }

    fn dark(&mut self, reason: DarkReason, now: TimeNs) -> Result<(), LaserError> {
        self.made_dark &= reason != DarkReason::Boot;
        self.with_box(now, |laser| laser.dark(reason, now))
    }

    fn known_until(&self, now: TimeNs) -> TimeNs {
        self.current.as_ref().map_or(now, |laser| laser.known_until(now))
    }

    fn next_missed(&mut self) -> Option<MissedLight> {
        self.current.as_mut()?.next_missed()
    }

    fn poll(&mut self, now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
        if self.current.is_none()
            && let Ok(laser) = self.found.pop()
        {
            self.current = Some(laser);
            self.fresh = true;
        }
        let mut polled = Ok(());
        if let Some(mut laser) = self.current.take() {
            polled = laser.poll(now, &mut |event| self.note(event));
            self.current = Some(laser);
            if let Err(why) = polled {
                polled = self.with_box(now, |_| Err(why));
            }
        }
        while let Some(next) = self.events.pop_front() {
            event(next);
        }
        polled
    }
}

impl Drop for Reconnecting {
    /// A box that was lost may still have lasers lit: one that does not go dark by itself is put out while it is
    /// closed, and a program that ended before would leave it lit. The search for another is not waited for.
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.seeker.thread().unpark();
        let t_end = Instant::now() + CLOSE_WAIT;
        while !self.capability.has_heartbeat && !self.seeker.is_finished() && Instant::now() < t_end {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// The thread that closes lost boxes and looks for them again.
struct Seeker<F> {
    open: F,
    capability: Capability,
    lost: Consumer<Lost>,
    found: Producer<Box<dyn LaserBox>>,
    watch: LaserWatch,
    stop: Arc<AtomicBool>,
    clock: fn() -> TimeNs,
}

impl<F: Fn() -> Result<Box<dyn LaserBox>, LaserError>> Seeker<F> {
    fn run(mut self) {
        loop {
            let Ok(Lost { laser, why, program }) = self.lost.pop() else {
                if self.stop.load(Ordering::Acquire) {
                    return;
                }
                std::thread::park();
                continue;
            };
            self.watch.set(Some(why.to_string()));
            drop(laser);
            while !self.stop.load(Ordering::Acquire) {
                match self.find(program.as_ref()) {
                    Ok(laser) => {
                        // The last one was popped before this one was lost.
                        let _never_full = self.found.push(laser);
                        self.watch.set(None);
                        break;
                    }
                    Err(why) => self.watch.set(Some(why.to_string())),
                }
                std::thread::park_timeout(RETRY_EVERY);
            }
        }
    }

    fn find(&self, program: Option<&LaserProgram>) -> Result<Box<dyn LaserBox>, LaserError> {
        let mut laser = (self.open)()?;
        // What the rules made of the first one holds for its successors: real lasers never take a simulated box's
        // place.
        if laser.capability() != self.capability {
            return Err(LaserError::AnotherKind);
        }
        laser.dark(DarkReason::Asked, (self.clock)())?;
        if let Some(program) = program {
            laser.program(program, (self.clock)())?;
        }
        Ok(laser)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A box that does not answer, and takes a while to be put out when it is closed.
    struct Mute {
        has_heartbeat: bool,
        put_out: Arc<AtomicBool>,
    }

    impl LaserBox for Mute {
        fn capability(&self) -> Capability {
            Capability { simulated: false, gates_fields: false, has_heartbeat: self.has_heartbeat, sync_wire: false }
        }

        fn program(&mut self, _program: &LaserProgram, _now: TimeNs) -> Result<(), LaserError> {
            Ok(())
        }

        fn arm(&mut self, _now: TimeNs) -> Result<(), LaserError> {
            Ok(())
        }

        fn sync(&mut self, _t_sync: TimeNs, _now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
            Ok(None)
        }

        fn light(&mut self, _window: LitWindow, _now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
            Ok(None)
        }

        fn heartbeat(&mut self, _now: TimeNs) -> Result<(), LaserError> {
            Ok(())
        }

        fn dark(&mut self, _reason: DarkReason, _now: TimeNs) -> Result<(), LaserError> {
            Err(LaserError::NoAnswer { command: "off", waited_ms: 450 })
        }

        fn poll(&mut self, _now: TimeNs, _event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
            Ok(())
        }
    }

    impl Drop for Mute {
        fn drop(&mut self) {
            std::thread::sleep(Duration::from_millis(300));
            self.put_out.store(true, Ordering::Release);
        }
    }

    /// Whether a box that did not answer to the last order was put out before the run's end.
    fn is_put_out_before_the_end(has_heartbeat: bool) -> bool {
        let put_out = Arc::new(AtomicBool::new(false));
        let mute = Mute { has_heartbeat, put_out: Arc::clone(&put_out) };
        let mut laser = Reconnecting::new(Box::new(mute), || Err(LaserError::Lost), || TimeNs(0)).unwrap();
        assert!(matches!(laser.dark(DarkReason::Shutdown, TimeNs(0)), Err(LaserError::Lost)));
        drop(laser);
        put_out.load(Ordering::Acquire)
    }

    #[test]
    fn a_lost_box_that_does_not_go_dark_by_itself_is_waited_for_and_one_that_does_is_not() {
        assert!(is_put_out_before_the_end(false));
        assert!(!is_put_out_before_the_end(true));
    }
}
