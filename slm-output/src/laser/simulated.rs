//! A laser box without lasers.

use std::collections::VecDeque;

use holod_calibration::{Colour, TimeNs};

use super::{BoxEvent, DarkReason, LaserBox, LaserEdge, LaserError, LaserProgram, LitWindow, Refusal, Trigger};
use crate::fields::FIELDS;

/// Events that wait to be fetched at most; later ones are lost and counted.
const EVENTS_MAX: usize = 512;
/// Windows that the host may ask for ahead of time.
const QUEUE_MAX: usize = 4;
/// Panel refreshes without sync after which the box goes dark; until then it goes on in the panel's rhythm.
const SYNC_LOST_FRAMES: i64 = 2;

/// The model of a laser box: a pure state machine that obeys the rules of [`LaserBox`] in its own time.
///
/// Whenever it is asked, it first lives through all that has happened since it was asked last, in order and with exact
/// times: windows, heartbeat timeout, lost sync. So a process that stalls finds, when it wakes up, that its box went
/// dark on time.
#[derive(Debug)]
pub struct SimulatedLaser {
    now: TimeNs,
    program: Option<LaserProgram>,
    armed: Option<Armed>,
    lit: Option<LitWindow>,
    queue: VecDeque<LitWindow>,
    events: VecDeque<BoxEvent>,
    events_lost: u64,
}

/// What an armed box remembers.
#[derive(Clone, Copy, Debug)]
struct Armed {
    t_heartbeat: TimeNs,
    /// When sync was last seen, or the box armed.
    t_alive: TimeNs,
    /// Start of the last colour frame that was reported.
    t_sync: Option<TimeNs>,
    /// The programmed on edge of the last window lit.
    t_lit: Option<TimeNs>,
}

impl SimulatedLaser {
    /// A box that has just booted: dark, without a program.
    pub fn new(now: TimeNs) -> Self {
        Self {
            now,
            program: None,
            armed: None,
            lit: None,
            queue: VecDeque::with_capacity(QUEUE_MAX),
            events: VecDeque::with_capacity(EVENTS_MAX),
            events_lost: 0,
        }
    }

    /// Whether it may light lasers.
    pub fn is_armed(&self) -> bool {
        self.armed.is_some()
    }

    /// The laser that is lit.
    pub fn lit(&self) -> Option<Colour> {
        self.lit.map(|window| window.colour)
    }

    /// The next event in order, if any waits.
    pub fn next_event(&mut self) -> Option<BoxEvent> {
        self.events.pop_front()
    }

    /// Events that were lost because nobody fetched them.
    pub fn events_lost(&self) -> u64 {
        self.events_lost
    }

    /// Lives through everything up to `now`. Time never runs backwards here: an earlier `now` changes nothing.
    pub fn advance(&mut self, now: TimeNs) {
        while let Some((t, step)) = self.next_step() {
            if t > now {
                break;
            }
            self.now = self.now.max(t);
            match step {
                Step::Off => self.switch_off(t),
                Step::Dark(reason) => self.go_dark(reason, t),
                Step::On(window, t_programmed) => {
                    self.switch_on(window);
                    if let Some(armed) = &mut self.armed {
                        armed.t_lit = Some(t_programmed);
                    }
                }
            }
        }
        self.now = self.now.max(now);
    }

    /// Sets the program; see [`LaserBox::program`].
    ///
    /// # Errors
    /// [`Refusal::Armed`]; [`Refusal::Overlap`] where two of its windows overlap; [`Refusal::Late`] for a window without length.
    pub fn set_program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), Refusal> {
        self.advance(now);
        if self.is_armed() {
            return Err(Refusal::Armed);
        }
        let mut t_free = TimeNs(0);
        for window in program.windows {
            if window.width <= TimeNs(0) {
                return Err(Refusal::Late);
            }
            if window.delay < t_free {
                return Err(Refusal::Overlap);
            }
            t_free = window.delay + window.width;
        }
        if t_free > program.frame_period + program.windows[0].delay {
            return Err(Refusal::Overlap);
        }
        self.program = Some(*program);
        Ok(())
    }

    /// Arms; see [`LaserBox::arm`].
    ///
    /// # Errors
    /// [`Refusal::NotProgrammed`].
    pub fn set_armed(&mut self, now: TimeNs) -> Result<(), Refusal> {
        self.advance(now);
        if self.program.is_none() {
            return Err(Refusal::NotProgrammed);
        }
        if self.armed.is_none() {
            self.armed = Some(Armed { t_heartbeat: self.now, t_alive: self.now, t_sync: None, t_lit: None });
            self.push(BoxEvent::Armed { t: self.now });
        }
        Ok(())
    }

    /// Sees the panel's sync; see [`LaserBox::sync`].
    ///
    /// # Errors
    /// [`Refusal::NotArmed`].
    pub fn see_sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<(), Refusal> {
        self.advance(now);
        let armed = self.armed.as_mut().ok_or(Refusal::NotArmed)?;
        if armed.t_sync.is_none_or(|before| t_sync > before) && t_sync <= self.now {
            armed.t_sync = Some(t_sync);
            armed.t_alive = armed.t_alive.max(t_sync);
        }
        Ok(())
    }

    /// Takes a window; see [`LaserBox::light`].
    ///
    /// # Errors
    /// [`Refusal`].
    pub fn take_window(&mut self, mut window: LitWindow, now: TimeNs) -> Result<(), Refusal> {
        self.advance(now);
        if !self.is_armed() {
            return Err(Refusal::NotArmed);
        }
        if self.program.is_some_and(|program| program.trigger != Trigger::Host) {
            return Err(Refusal::Trigger);
        }
        window.t_on = window.t_on.max(self.now);
        if window.t_off <= window.t_on {
            return Err(Refusal::Late);
        }
        let t_free = self.queue.back().or(self.lit.as_ref()).map(|last| last.t_off);
        if t_free.is_some_and(|t_free| window.t_on < t_free) || self.queue.len() == QUEUE_MAX {
            return Err(Refusal::Overlap);
        }
        self.queue.push_back(window);
        self.advance(now);
        Ok(())
    }

    /// Hears a heartbeat; see [`LaserBox::heartbeat`].
    ///
    /// # Errors
    /// [`Refusal::NotArmed`].
    pub fn hear_heartbeat(&mut self, now: TimeNs) -> Result<(), Refusal> {
        self.advance(now);
        let armed = self.armed.as_mut().ok_or(Refusal::NotArmed)?;
        armed.t_heartbeat = self.now;
        Ok(())
    }

    /// Goes dark; see [`LaserBox::dark`].
    pub fn set_dark(&mut self, reason: DarkReason, now: TimeNs) {
        self.advance(now);
        self.go_dark(reason, self.now);
    }

    /// What happens next by itself, and when. What makes dark comes first among things that happen at once.
    fn next_step(&self) -> Option<(TimeNs, Step)> {
        let armed = self.armed?;
        let program = self.program?;
        let mut next = (armed.t_heartbeat + program.heartbeat_timeout, Step::Dark(DarkReason::Heartbeat));
        let mut consider = |t: TimeNs, step: Step| {
            if t < next.0 {
                next = (t, step);
            }
        };
        if program.trigger == Trigger::PanelSync {
            let t_lost = TimeNs(armed.t_alive.0 + SYNC_LOST_FRAMES * program.frame_period.0);
            consider(t_lost, Step::Dark(DarkReason::SyncLost));
        }
        if let Some(window) = self.lit {
            consider(window.t_off, Step::Off);
        } else if let Some((window, t_programmed)) = self.next_window(&armed, &program) {
            consider(window.t_on, Step::On(window, t_programmed));
        }
        Some(next)
    }

    /// The next window and its programmed on edge.
    fn next_window(&self, armed: &Armed, program: &LaserProgram) -> Option<(LitWindow, TimeNs)> {
        if program.trigger == Trigger::Host {
            return self.queue.front().map(|&window| (window, window.t_on));
        }
        let t_sync = armed.t_sync?;
        let half_field = TimeNs(program.frame_period.0 / (2 * FIELDS as i64));
        for frame in 0..SYNC_LOST_FRAMES {
            let t_frame = TimeNs(t_sync.0 + frame * program.frame_period.0);
            for (field, window) in program.windows.iter().enumerate() {
                let t_programmed = t_frame + window.delay;
                let t_off = t_programmed + window.width;
                // A sync that comes a little early or late must not light a window a second time.
                let lit_already = armed.t_lit.is_some_and(|t_lit| t_programmed < t_lit + half_field);
                if t_off > self.now && !lit_already {
                    let t_on = t_programmed.max(self.now);
                    return Some((LitWindow { colour: program.sequence[field], t_on, t_off }, t_programmed));
                }
            }
        }
        None
    }

    fn switch_on(&mut self, window: LitWindow) {
        self.queue.pop_front();
        self.lit = Some(window);
        self.push(BoxEvent::Edge(LaserEdge { t: window.t_on, colour: window.colour, on: true }));
    }

    fn switch_off(&mut self, t: TimeNs) {
        if let Some(window) = self.lit.take() {
            self.push(BoxEvent::Edge(LaserEdge { t, colour: window.colour, on: false }));
        }
    }

    fn go_dark(&mut self, reason: DarkReason, t: TimeNs) {
        self.switch_off(t);
        self.queue.clear();
        if self.armed.take().is_some() {
            self.push(BoxEvent::Dark { t, reason });
        }
    }

    fn push(&mut self, event: BoxEvent) {
        if self.events.len() < EVENTS_MAX {
            self.events.push_back(event);
        } else {
            self.events_lost += 1;
        }
    }
}

/// Something that the box does by itself.
#[derive(Clone, Copy, Debug)]
enum Step {
    Off,
    Dark(DarkReason),
    /// The window, and the on edge that its program gives it.
    On(LitWindow, TimeNs),
}

fn refused(command: &'static str) -> impl Fn(Refusal) -> LaserError {
    move |refusal| LaserError::Refused { command, refusal }
}

impl LaserBox for SimulatedLaser {
    fn program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), LaserError> {
        self.set_program(program, now).map_err(refused("program"))
    }

    fn arm(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.set_armed(now).map_err(refused("arm"))
    }

    fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<(), LaserError> {
        self.see_sync(t_sync, now).map_err(refused("sync"))
    }

    fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<(), LaserError> {
        self.take_window(window, now).map_err(refused("light"))
    }

    fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.hear_heartbeat(now).map_err(refused("heartbeat"))
    }

    fn dark(&mut self, reason: DarkReason, now: TimeNs) -> Result<(), LaserError> {
        self.set_dark(reason, now);
        Ok(())
    }

    fn poll(&mut self, now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
        self.advance(now);
        while let Some(next) = self.next_event() {
            event(next);
        }
        Ok(())
    }
}
