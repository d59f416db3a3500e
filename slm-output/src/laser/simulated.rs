//! A laser box without lasers, inside this program.

use std::collections::VecDeque;

use holod_calibration::{Colour, PerColour, TimeNs};
use holod_laser_firmware::{Command, Event, Limits, Machine, Refusal, Trigger as BoxTrigger};

use super::program::{ceil_us, colour_of, commands, floor_us, laser_of, nanoseconds};
use super::{BoxEvent, Capability, DarkReason, LaserBox, LaserEdge, LaserError, LaserProgram, LitWindow, Trigger};

/// Events that wait to be fetched at most; later ones are lost and counted.
const EVENTS_MAX: usize = 512;

/// A box of its kind is built for anything that a rig may ask.
const LIMITS: Limits =
    Limits { power_uw: [4_000_000; 3], timeout_us: 10_000_000, lit_us: 1_000_000, jitter_us: 0, sync_input: false };

/// The firmware's state machine on the host's own clock.
///
/// Whenever it is asked, it first lives through all that has happened since it was asked last, in order and with exact
/// times. So a process that stalls finds, when it wakes up, that its box went dark on time. Windows are rounded inwards
/// to whole microseconds, the firmware's unit.
#[derive(Debug)]
pub struct SimulatedLaser {
    machine: Machine,
    events: VecDeque<BoxEvent>,
    events_lost: u64,
}

impl SimulatedLaser {
    /// A box that has just booted: dark, without a program.
    pub fn new(now: TimeNs) -> Self {
        let mut machine = Machine::new(LIMITS, floor_us(now));
        machine.see_inputs(true, true, floor_us(now), &mut |_| ());
        Self { machine, events: VecDeque::with_capacity(EVENTS_MAX), events_lost: 0 }
    }

    /// Whether it may light lasers.
    pub fn is_armed(&self) -> bool {
        self.machine.is_armed()
    }

    /// The laser that is lit.
    pub fn lit(&self) -> Option<Colour> {
        self.machine.lit().map(colour_of)
    }

    /// The next event in order, if any waits.
    pub fn next_event(&mut self) -> Option<BoxEvent> {
        self.events.pop_front()
    }

    /// Events that were lost because nobody fetched them.
    #[cfg(test)]
    fn events_lost(&self) -> u64 {
        self.events_lost
    }

    /// Lives through everything up to `now`. Time never runs backwards here: an earlier `now` changes nothing.
    pub fn advance(&mut self, now: TimeNs) {
        let Self { machine, events, events_lost } = self;
        machine.advance(floor_us(now), &mut |event| push(events, events_lost, event));
    }

    /// Goes dark at `now`.
    pub fn set_dark(&mut self, reason: DarkReason, now: TimeNs) {
        let _always_done = self.obey(&Command::Disarm(reason), now);
    }

    /// Sees that a colour frame began within `error_us` microseconds of `t_sync`.
    pub(super) fn see_frame(&mut self, t_sync: TimeNs, error_us: u32, now: TimeNs) -> Result<(), Refusal> {
        // The frame may have begun within the microsecond that is rounded off.
        let error_us = error_us + u32::from(t_sync.0.rem_euclid(1000) != 0);
        self.obey(&Command::Frame { t: floor_us(t_sync), error_us }, now)
    }

    pub(super) fn take_window(&mut self, window: LitWindow, now: TimeNs) -> Result<(), Refusal> {
        let LitWindow { colour, t_on, t_off } = window;
        self.obey(&Command::Light { laser: laser_of(colour), t_on: ceil_us(t_on), t_off: floor_us(t_off) }, now)
    }

    pub(super) fn obey(&mut self, command: &Command, now: TimeNs) -> Result<(), Refusal> {
        let Self { machine, events, events_lost } = self;
        machine.obey(command, floor_us(now), &mut |event| push(events, events_lost, event)).map(|_| ())
    }
}

fn push(events: &mut VecDeque<BoxEvent>, lost: &mut u64, event: Event) {
    if events.len() < EVENTS_MAX {
        events.push_back(BoxEvent::of(event, nanoseconds));
    } else {
        *lost += 1;
    }
}

impl BoxEvent {
    /// The firmware's event, with its time as the host's.
    pub(super) fn of(event: Event, host_time: impl Fn(holod_laser_firmware::TimeUs) -> TimeNs) -> Self {
        match event {
            Event::Armed { t } => Self::Armed { t: host_time(t) },
            Event::On { t, laser } => Self::Edge(LaserEdge { t: host_time(t), colour: colour_of(laser), on: true }),
            Event::Off { t, laser } => Self::Edge(LaserEdge { t: host_time(t), colour: colour_of(laser), on: false }),
            Event::Dark { t, reason } => Self::Dark { t: host_time(t), reason },
        }
    }
}

fn refused(command: &'static str) -> impl Fn(Refusal) -> LaserError {
    move |refusal| LaserError::Refused { command, refusal }
}

impl LaserBox for SimulatedLaser {
    fn capability(&self) -> Capability {
        Capability { simulated: true, gates_fields: true, has_heartbeat: true, sync_wire: false }
    }

    fn program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), LaserError> {
        let trigger = match program.trigger {
            Trigger::PanelSync => BoxTrigger::Frame,
            Trigger::Host => BoxTrigger::Host,
        };
        for command in commands(program, trigger, PerColour(LIMITS.power_uw), 0)? {
            self.obey(&command, now).map_err(refused(command.word()))?;
        }
        Ok(())
    }

    fn arm(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.obey(&Command::Arm, now).map_err(refused("ARM"))
    }

    fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        self.see_frame(t_sync, 0, now).map(|()| None).map_err(refused("FRM"))
    }

    fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        match self.take_window(window, now) {
            Ok(()) => Ok(None),
            Err(Refusal::Late) => Ok(Some(DarkReason::Late)),
            Err(refusal) => Err(LaserError::Refused { command: "LIT", refusal }),
        }
    }

    fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.obey(&Command::Heartbeat, now).map_err(refused("HB"))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::laser::FieldWindow;

    /// Fields of 1000 µs, windows from 400 to 700 and a little, a heartbeat timeout of ten frames.
    fn program(trigger: Trigger) -> LaserProgram {
        let window = |field: i64| FieldWindow { delay: TimeNs(1_000_000 * field + 399_001), width: TimeNs(301_500) };
        LaserProgram {
            trigger,
            sequence: [Colour::Green, Colour::Red, Colour::Blue],
            windows: [window(0), window(1), window(2)],
            frame_period: TimeNs(3_000_000),
            power_uw: PerColour([100; 3]),
            heartbeat_timeout: TimeNs(30_000_000),
        }
    }

    fn armed(trigger: Trigger) -> SimulatedLaser {
        let mut laser = SimulatedLaser::new(TimeNs(0));
        laser.program(&program(trigger), TimeNs(0)).unwrap();
        laser.arm(TimeNs(0)).unwrap();
        laser
    }

    fn events(laser: &mut SimulatedLaser, now: TimeNs) -> Vec<BoxEvent> {
        let mut events = Vec::new();
        laser.poll(now, &mut |event| events.push(event)).unwrap();
        events
    }

    /// (time, colour, on) of the edges up to `now`.
    fn edges(laser: &mut SimulatedLaser, now: TimeNs) -> Vec<(i64, Colour, bool)> {
        let edge = |event| match event {
            BoxEvent::Edge(edge) => Some((edge.t.0, edge.colour, edge.on)),
            _ => None,
        };
        events(laser, now).into_iter().filter_map(edge).collect()
    }

    #[test]
    fn windows_are_rounded_inwards() {
        let mut laser = armed(Trigger::PanelSync);
        laser.sync(TimeNs(0), TimeNs(5)).unwrap();
        let (g, r, b) = (Colour::Green, Colour::Red, Colour::Blue);
        let expected = [
            (400_000, g, true),
            (700_000, g, false),
            (1_400_000, r, true),
            (1_700_000, r, false),
            (2_400_000, b, true),
            (2_700_000, b, false),
        ];
        assert_eq!(edges(&mut laser, TimeNs(2_999_999)), expected);
        // A frame that began inside a microsecond.
        laser.sync(TimeNs(3_000_001), TimeNs(3_000_002)).unwrap();
        let found = edges(&mut laser, TimeNs(3_900_000));
        assert_eq!(found, [(3_401_000, g, true), (3_699_000, g, false)]);
        let mut host = armed(Trigger::Host);
        let window = LitWindow { colour: r, t_on: TimeNs(100_001), t_off: TimeNs(199_999) };
        host.light(window, TimeNs(0)).unwrap();
        assert_eq!(edges(&mut host, TimeNs(300_000)), [(101_000, r, true), (199_000, r, false)]);
    }

    #[test]
    fn a_process_that_stalls_finds_that_it_went_dark_on_time() {
        let mut laser = armed(Trigger::Host);
        let window = LitWindow { colour: Colour::Blue, t_on: TimeNs(29_900_000), t_off: TimeNs(30_200_000) };
        laser.light(window, TimeNs(100)).unwrap();
        let expected = [
            BoxEvent::Armed { t: TimeNs(0) },
            BoxEvent::Edge(LaserEdge { t: TimeNs(29_900_000), colour: Colour::Blue, on: true }),
            BoxEvent::Edge(LaserEdge { t: TimeNs(30_000_000), colour: Colour::Blue, on: false }),
            BoxEvent::Dark { t: TimeNs(30_000_000), reason: DarkReason::Heartbeat },
        ];
        assert_eq!(events(&mut laser, TimeNs(5_000_000_000)), expected);
        assert_eq!((laser.is_armed(), laser.lit(), laser.events_lost()), (false, None, 0));
    }

    #[test]
    fn programs_that_no_line_can_carry_are_refused() {
        let mut laser = SimulatedLaser::new(TimeNs(0));
        let narrow = FieldWindow { delay: TimeNs(400_001), width: TimeNs(1500) };
        let mut nothing_lit = program(Trigger::Host);
        nothing_lit.windows[1] = FieldWindow { delay: TimeNs(1_000_000) + narrow.delay, width: narrow.width };
        let refused = laser.program(&nothing_lit, TimeNs(0)).unwrap_err();
        assert!(matches!(refused, LaserError::Figure { what: "width", .. }), "{refused}");
        let strong = LaserProgram { power_uw: PerColour([1, 4_000_001, 1]), ..program(Trigger::Host) };
        let refused = laser.program(&strong, TimeNs(0)).unwrap_err();
        assert!(matches!(refused, LaserError::Figure { what: "power_mw", .. }), "{refused}");
        let overlapping = FieldWindow { delay: TimeNs(699_000), width: TimeNs(300_000) };
        let mut overlap = program(Trigger::PanelSync);
        overlap.windows[1] = overlapping;
        laser.program(&overlap, TimeNs(0)).unwrap();
        let refused = laser.arm(TimeNs(0)).unwrap_err();
        assert!(matches!(refused, LaserError::Refused { command: "ARM", refusal: Refusal::Overlap }), "{refused}");
    }
}
