//! The state machine that decides which laser is lit.
//!
//! Pure: it is given commands, edges, inputs and the time, reads no clock and touches no pin. Whenever it is asked, it
//! first lives through all that has happened by itself since it was asked last, in order and with exact times: windows,
//! heartbeat timeout, lost sync. At most one laser is ever lit, by type.

use crate::command::{Answer, Command, Refusal};
use crate::types::{DarkReason, FIELDS_MAX, Laser, Limits, Sequence, State, SyncSeen, TimeUs, Trigger, Window};

/// Colour frames without sync after which the box goes dark.
pub const SYNC_LOST_FRAMES: u32 = 2;
/// Windows that a host may ask for ahead of time.
pub const WINDOWS_WAITING_MAX: usize = 4;
/// How far ahead of time it may ask for them, microseconds.
pub const AHEAD_MAX_US: u32 = 1_000_000;
/// Colour frames that a box takes, microseconds.
pub const PERIOD_US: core::ops::RangeInclusive<u32> = 500..=1_000_000;

/// What happened at a box, at `t` of its clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum Event {
    /// Lasers may be lit from now on.
    Armed { t: TimeUs },
    /// A laser went on.
    On { t: TimeUs, laser: Laser },
    /// A laser went off.
    Off { t: TimeUs, laser: Laser },
    /// All lasers are out until the box is armed again.
    Dark { t: TimeUs, reason: DarkReason },
}

/// A laser, lit from `t_on` to `t_off`.
#[derive(Clone, Copy, Debug)]
struct LitWindow {
    laser: Laser,
    t_on: TimeUs,
    t_off: TimeUs,
}

/// What the host has set.
#[derive(Clone, Copy, Debug)]
struct Settings {
    sequence: Option<(Sequence, u32, Trigger)>,
    windows: [Option<Window>; FIELDS_MAX],
    power_limit_uw: Option<[u32; 3]>,
    power_uw: Option<[u32; 3]>,
    timeout_us: Option<u32>,
}

impl Settings {
    const NONE: Self =
        Self { sequence: None, windows: [None; FIELDS_MAX], power_limit_uw: None, power_uw: None, timeout_us: None };
}

/// A program that has been found sound.
#[derive(Clone, Copy, Debug)]
struct Program {
    sequence: Sequence,
    period_us: u32,
    trigger: Trigger,
    timeout_us: u32,
}

/// What an armed box remembers.
#[derive(Clone, Copy, Debug)]
struct Armed {
    program: Program,
    t_heartbeat: TimeUs,
    /// When sync was last seen, or the box armed.
    t_alive: TimeUs,
    /// Start of the last colour frame, and by how much that may be wrong.
    frame: Option<(TimeUs, u32)>,
}

/// Something that the box does by itself.
#[derive(Clone, Copy, Debug)]
enum Step {
    Off,
    Dark(DarkReason),
    /// The window, and the on edge that its program gives it.
    On(LitWindow, TimeUs),
}

/// A laser box, without its pins and its line.
#[derive(Clone, Debug)]
pub struct Machine {
    limits: Limits,
    now: TimeUs,
    settings: Settings,
    armed: Option<Armed>,
    lit: Option<LitWindow>,
    /// The programmed on edge of the last window lit. It outlives darkness, so that a box that is armed again within a
    /// field does not light that field a second time.
    t_lit: Option<TimeUs>,
    waiting: [Option<LitWindow>; WINDOWS_WAITING_MAX],
    interlock_closed: bool,
    host_present: bool,
    sync: SyncSeen,
    reason: DarkReason,
}

impl Machine {
    /// A box that has just booted: dark, without a program, its interlock taken as open and its host as absent until
    /// [`Self::see_inputs`] says otherwise.
    pub const fn new(limits: Limits, now: TimeUs) -> Self {
        Self {
            limits,
            now,
            settings: Settings::NONE,
            armed: None,
            lit: None,
            t_lit: None,
            waiting: [None; WINDOWS_WAITING_MAX],
            interlock_closed: false,
            host_present: false,
            sync: SyncSeen { count: 0, t_last: None },
            reason: DarkReason::Boot,
        }
    }

    /// Whether it may light lasers.
    pub const fn is_armed(&self) -> bool {
        self.armed.is_some()
    }

    /// The laser that is lit now.
    pub fn lit(&self) -> Option<Laser> {
        self.lit.map(|window| window.laser)
    }

    /// What the box is built for.
    pub const fn limits(&self) -> Limits {
        self.limits
    }

    /// The power of each laser while it is lit, microwatts; 0 while nothing may be lit.
    pub fn power_uw(&self) -> [u32; 3] {
        self.settings.power_uw.filter(|_| self.is_armed()).unwrap_or_default()
    }

    /// What it answers when it is asked for its state.
    pub fn state(&self) -> State {
        State {
            armed: self.is_armed(),
            reason: self.reason,
            lit: self.lit(),
            interlock_closed: self.interlock_closed,
            sync: self.sync,
        }
    }

    /// When it next does something by itself, if nobody says anything before.
    pub fn t_next(&self) -> Option<TimeUs> {
        self.next_step().map(|(t, _)| t)
    }

    /// Lives through everything up to `now` and calls `event` for all that happens. Time never runs backwards here: an
    /// earlier `now` changes nothing.
    pub fn advance(&mut self, now: TimeUs, event: &mut dyn FnMut(Event)) {
        while let Some((t, step)) = self.next_step().filter(|(t, _)| *t <= now) {
            self.now = self.now.max(t);
            match step {
                Step::Off => self.switch_off(self.now, event),
                Step::Dark(reason) => self.go_dark(reason, event),
                Step::On(window, t_programmed) => {
                    self.t_lit = Some(t_programmed);
                    self.switch_on(window, event);
                }
            }
        }
        self.now = self.now.max(now);
    }

    /// Sees its inputs: whether the interlock is closed, and whether a host holds the line.
    pub fn see_inputs(
        &mut self,
        interlock_closed: bool,
        host_present: bool,
        now: TimeUs,
        event: &mut dyn FnMut(Event),
    ) {
        self.advance(now, event);
        self.interlock_closed = interlock_closed;
        self.host_present = host_present;
        if !interlock_closed {
            self.go_dark(DarkReason::Interlock, event);
        } else if !host_present {
            self.go_dark(DarkReason::HangUp, event);
        }
    }

    /// Sees an edge on the sync wire, at `t` of its clock and not later than `now`.
    pub fn see_edge(&mut self, t: TimeUs, now: TimeUs, event: &mut dyn FnMut(Event)) {
        self.advance(now, event);
        self.sync.count = self.sync.count.wrapping_add(1);
        self.sync.t_last = Some(t);
        if self.armed.is_some_and(|armed| armed.program.trigger == Trigger::Sync) {
            self.begin_frame(t, 0, event);
        }
    }

    /// Hears a line that is damaged or no command: dark, whatever it was meant to say.
    pub fn hear_nonsense(&mut self, now: TimeUs, event: &mut dyn FnMut(Event)) {
        self.advance(now, event);
        self.go_dark(DarkReason::Line, event);
    }

    /// Carries out a command that came at `now`. Its own identity is none of its business: to [`Command::Identify`] it
    /// only says that it is there.
    ///
    /// # Errors
    /// [`Refusal`]; nothing has changed then.
    pub fn obey(
        &mut self,
        command: &Command,
        now: TimeUs,
        event: &mut dyn FnMut(Event),
    ) -> Result<Answer<'static>, Refusal> {
        self.advance(now, event);
        let t = self.now;
        match *command {
            Command::Identify | Command::Now => {}
            Command::Limits => return Ok(Answer::Limits { t, limits: self.limits }),
            Command::State => return Ok(Answer::State { t, state: self.state() }),
            Command::Sequence { .. }
            | Command::Field { .. }
            | Command::PowerLimit(_)
            | Command::Power(_)
            | Command::Timeout(_) => self.set(command)?,
            Command::Arm => self.arm(event)?,
            Command::Disarm(reason) => {
                self.go_dark(reason, event);
                // By hand counts in the dark, too, and keeps it dark until a host says that it begins.
                if matches!(reason, DarkReason::ByHand | DarkReason::Boot) {
                    self.reason = reason;
                }
            }
            Command::Heartbeat => {
                self.armed.as_mut().ok_or(Refusal::NotArmed)?.t_heartbeat = t;
                if self.sync.t_last.is_some() {
                    return Ok(Answer::Sync { t, sync: self.sync });
                }
            }
            Command::Frame { t: t_frame, error_us } => self.frame_told(t_frame, error_us, event)?,
            Command::Light { laser, t_on, t_off } => self.light(LitWindow { laser, t_on, t_off }, event)?,
        }
        Ok(Answer::Done { t })
    }

    fn set(&mut self, command: &Command) -> Result<(), Refusal> {
        if self.is_armed() {
            return Err(Refusal::Armed);
        }
        match *command {
            Command::Sequence { sequence, period_us, trigger } => {
                if !PERIOD_US.contains(&period_us) {
                    return Err(Refusal::Range);
                }
                if trigger == Trigger::Sync && !self.limits.sync_input {
                    return Err(Refusal::Trigger);
                }
                self.settings = Settings { sequence: Some((sequence, period_us, trigger)), ..Settings::NONE };
            }
            Command::Field { field, window } => {
                let place = self.settings.windows.get_mut(field).ok_or(Refusal::Range)?;
                if !(1..=self.limits.lit_us).contains(&window.width_us) || window.delay_us > *PERIOD_US.end() {
                    return Err(Refusal::Range);
                }
                *place = Some(window);
            }
            Command::PowerLimit(limit_uw) => {
                if !within(limit_uw, self.limits.power_uw) {
                    return Err(Refusal::Power);
                }
                self.settings.power_limit_uw = Some(limit_uw);
                self.settings.power_uw = None;
            }
            Command::Power(power_uw) => {
                if !within(power_uw, self.settings.power_limit_uw.ok_or(Refusal::NotProgrammed)?) {
                    return Err(Refusal::Power);
                }
                self.settings.power_uw = Some(power_uw);
            }
            Command::Timeout(timeout_us) => {
                if !(1..=self.limits.timeout_us).contains(&timeout_us) {
                    return Err(Refusal::Range);
                }
                self.settings.timeout_us = Some(timeout_us);
            }
            _ => return Err(Refusal::Malformed),
        }
        Ok(())
    }

    /// What has been set, where it makes a sound program.
    fn program(&self) -> Result<Program, Refusal> {
        let (sequence, period_us, trigger) = self.settings.sequence.ok_or(Refusal::NotProgrammed)?;
        self.settings.power_uw.ok_or(Refusal::NotProgrammed)?;
        let timeout_us = self.settings.timeout_us.ok_or(Refusal::NotProgrammed)?;
        if trigger != Trigger::Host {
            let mut free_us = 0;
            for window in &self.settings.windows[..sequence.lasers().len()] {
                let window = window.ok_or(Refusal::NotProgrammed)?;
                if window.delay_us < free_us {
                    return Err(Refusal::Overlap);
                }
                free_us = window.delay_us + window.width_us;
            }
            if free_us > period_us {
                return Err(Refusal::Overlap);
            }
        }
        Ok(Program { sequence, period_us, trigger, timeout_us })
    }

    fn arm(&mut self, event: &mut dyn FnMut(Event)) -> Result<(), Refusal> {
        if !self.interlock_closed {
            return Err(Refusal::Interlock);
        }
        if !self.host_present {
            return Err(Refusal::HangUp);
        }
        let program = self.program()?;
        if self.armed.is_none() && self.reason == DarkReason::ByHand {
            return Err(Refusal::ByHand);
        }
        if self.armed.is_none() {
            self.armed = Some(Armed { program, t_heartbeat: self.now, t_alive: self.now, frame: None });
            event(Event::Armed { t: self.now });
        }
        Ok(())
    }

    fn frame_told(&mut self, t: TimeUs, error_us: u32, event: &mut dyn FnMut(Event)) -> Result<(), Refusal> {
        let armed = self.armed.ok_or(Refusal::NotArmed)?;
        if armed.program.trigger != Trigger::Frame {
            return Err(Refusal::Trigger);
        }
        // A frame that is announced is a guess.
        if t > self.now.after(error_us) {
            return Err(Refusal::Range);
        }
        self.begin_frame(t, error_us, event);
        Ok(())
    }

    /// A colour frame began: what is still lit belongs to the one before it.
    fn begin_frame(&mut self, t: TimeUs, error_us: u32, event: &mut dyn FnMut(Event)) {
        let Some(armed) = self.armed.as_mut() else { return };
        let period_us = armed.program.period_us;
        if let Some((before, before_error_us)) = armed.frame {
            if t <= before {
                return;
            }
            let tolerance_us = (period_us / 4).saturating_add(error_us).saturating_add(before_error_us);
            if t.after(tolerance_us) < before.after(period_us) {
                return self.go_dark(DarkReason::SyncRate, event);
            }
        }
        armed.frame = Some((t, error_us));
        armed.t_alive = armed.t_alive.max(t.min(self.now));
        self.switch_off(self.now, event);
        self.advance(self.now, event);
    }

    fn light(&mut self, mut window: LitWindow, event: &mut dyn FnMut(Event)) -> Result<(), Refusal> {
        let armed = self.armed.ok_or(Refusal::NotArmed)?;
        if armed.program.trigger != Trigger::Host {
            return Err(Refusal::Trigger);
        }
        if !armed.program.sequence.lasers().contains(&window.laser) {
            return Err(Refusal::Laser);
        }
        window.t_on = window.t_on.max(self.now);
        if window.t_off <= window.t_on {
            return Err(Refusal::Late);
        }
        let too_long = window.t_off > window.t_on.after(self.limits.lit_us);
        if too_long || window.t_on > self.now.after(AHEAD_MAX_US) {
            return Err(Refusal::Range);
        }
        let t_free = self.waiting.iter().flatten().last().or(self.lit.as_ref()).map(|last| last.t_off);
        if t_free.is_some_and(|t_free| window.t_on < t_free) {
            return Err(Refusal::Overlap);
        }
        let place = self.waiting.iter_mut().find(|place| place.is_none()).ok_or(Refusal::Overlap)?;
        *place = Some(window);
        self.advance(self.now, event);
        Ok(())
    }

    /// What happens next by itself, and when. What makes dark comes first among things that happen at once.
    fn next_step(&self) -> Option<(TimeUs, Step)> {
        let armed = self.armed.as_ref()?;
        let program = &armed.program;
        let mut next = (armed.t_heartbeat.after(program.timeout_us), Step::Dark(DarkReason::Heartbeat));
        let mut consider = |t: TimeUs, step: Step| {
            if t < next.0 {
                next = (t, step);
            }
        };
        if program.trigger != Trigger::Host {
            let lost_us = SYNC_LOST_FRAMES * program.period_us;
            consider(armed.t_alive.after(lost_us), Step::Dark(DarkReason::SyncLost));
        }
        if let Some(window) = self.lit {
            consider(window.t_off, Step::Off);
        } else if let Some((window, t_programmed)) = self.next_window(armed) {
            consider(window.t_on, Step::On(window, t_programmed));
        }
        Some(next)
    }

    /// The next window and its programmed on edge.
    fn next_window(&self, armed: &Armed) -> Option<(LitWindow, TimeUs)> {
        let program = &armed.program;
        if program.trigger == Trigger::Host {
            return self.waiting[0].map(|window| (window, window.t_on));
        }
        let (t_frame, error_us) = armed.frame?;
        let lasers = program.sequence.lasers();
        let half_field_us = program.period_us / (2 * lasers.len() as u32);
        for (window, &laser) in self.settings.windows.iter().flatten().zip(lasers) {
            let t_programmed = t_frame.after(window.delay_us);
            let t_on = t_programmed.after(error_us).max(self.now);
            let t_off = t_programmed.after(window.width_us).before(error_us);
            // A frame that is told a little earlier or later than it seemed must not light a window a second time.
            let lit_already = self.t_lit.is_some_and(|t_lit| t_programmed < t_lit.after(half_field_us));
            if t_off > t_on && !lit_already {
                return Some((LitWindow { laser, t_on, t_off }, t_programmed));
            }
        }
        None
    }

    fn switch_on(&mut self, window: LitWindow, event: &mut dyn FnMut(Event)) {
        self.waiting.rotate_left(1);
        self.waiting[WINDOWS_WAITING_MAX - 1] = None;
        self.lit = Some(window);
        event(Event::On { t: window.t_on, laser: window.laser });
    }

    fn switch_off(&mut self, t: TimeUs, event: &mut dyn FnMut(Event)) {
        if let Some(window) = self.lit.take() {
            event(Event::Off { t, laser: window.laser });
        }
    }

    fn go_dark(&mut self, reason: DarkReason, event: &mut dyn FnMut(Event)) {
        self.switch_off(self.now, event);
        self.waiting = [None; WINDOWS_WAITING_MAX];
        if self.armed.take().is_some() {
            self.reason = reason;
            event(Event::Dark { t: self.now, reason });
        }
    }
}

fn within(values: [u32; 3], limits: [u32; 3]) -> bool {
    values.iter().zip(limits).all(|(&value, limit)| value <= limit)
}
