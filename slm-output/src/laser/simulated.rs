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
    /// The programmed on edge of the last window lit. It outlives darkness, so that a box that is armed again within a
    /// field does not light that field a second time.
    t_lit: Option<TimeNs>,
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
}

impl SimulatedLaser {
    /// A box that has just booted: dark, without a program.
    pub fn new(now: TimeNs) -> Self {
        Self {
            now,
            program: None,
            armed: None,
            lit: None,
            t_lit: None,
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
                    self.t_lit = Some(t_programmed);
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
            self.armed = Some(Armed { t_heartbeat: self.now, t_alive: self.now, t_sync: None });
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
                let lit_already = self.t_lit.is_some_and(|t_lit| t_programmed < t_lit + half_field);
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
    fn is_simulated(&self) -> bool {
        true
    }

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::laser::FieldWindow;
    use holod_calibration::PerColour;
    use proptest::prelude::*;

    /// Fields of 1000 ns, windows from 400 to 700, a heartbeat timeout of ten frames.
    fn program(trigger: Trigger) -> LaserProgram {
        let window = |field: i64| FieldWindow { delay: TimeNs(1000 * field + 400), width: TimeNs(300) };
        LaserProgram {
            trigger,
            sequence: [Colour::Green, Colour::Red, Colour::Blue],
            windows: [window(0), window(1), window(2)],
            frame_period: TimeNs(3000),
            power_uw: PerColour([100; 3]),
            heartbeat_timeout: TimeNs(30_000),
        }
    }

    fn armed(trigger: Trigger) -> SimulatedLaser {
        let mut laser = SimulatedLaser::new(TimeNs(0));
        laser.set_program(&program(trigger), TimeNs(0)).unwrap();
        laser.set_armed(TimeNs(0)).unwrap();
        laser
    }

    fn events(laser: &mut SimulatedLaser) -> Vec<BoxEvent> {
        std::iter::from_fn(|| laser.next_event()).collect()
    }

    /// (time, colour, on) of the edges among the waiting events.
    fn edges(laser: &mut SimulatedLaser) -> Vec<(i64, Colour, bool)> {
        let edge = |event| match event {
            BoxEvent::Edge(edge) => Some((edge.t.0, edge.colour, edge.on)),
            _ => None,
        };
        events(laser).into_iter().filter_map(edge).collect()
    }

    #[test]
    fn it_boots_dark_and_does_nothing_until_it_is_programmed_and_armed() {
        let mut laser = SimulatedLaser::new(TimeNs(0));
        assert_eq!(laser.set_armed(TimeNs(0)), Err(Refusal::NotProgrammed));
        laser.set_program(&program(Trigger::PanelSync), TimeNs(0)).unwrap();
        assert_eq!(laser.see_sync(TimeNs(0), TimeNs(0)), Err(Refusal::NotArmed));
        assert_eq!(laser.hear_heartbeat(TimeNs(0)), Err(Refusal::NotArmed));
        laser.advance(TimeNs(100_000));
        assert_eq!(events(&mut laser), []);
        laser.set_armed(TimeNs(100_000)).unwrap();
        assert_eq!(laser.set_program(&program(Trigger::Host), TimeNs(100_000)), Err(Refusal::Armed));
    }

    #[test]
    fn sync_lights_each_field_in_its_order_with_exact_times() {
        let mut laser = armed(Trigger::PanelSync);
        laser.see_sync(TimeNs(0), TimeNs(5)).unwrap();
        laser.advance(TimeNs(2999));
        let (g, r, b) = (Colour::Green, Colour::Red, Colour::Blue);
        let expected =
            [(400, g, true), (700, g, false), (1400, r, true), (1700, r, false), (2400, b, true), (2700, b, false)];
        assert_eq!(edges(&mut laser), expected);
    }

    #[test]
    fn a_sync_that_is_told_late_or_jitters_neither_skips_nor_doubles_a_window() {
        let mut laser = armed(Trigger::PanelSync);
        for (t_sync, told) in [(0, 5), (3010, 5500), (5990, 6001), (9000, 11_900)] {
            laser.hear_heartbeat(TimeNs(told)).unwrap();
            laser.see_sync(TimeNs(t_sync), TimeNs(told)).unwrap();
        }
        laser.advance(TimeNs(12_000));
        let ons: Vec<_> = edges(&mut laser).into_iter().filter(|edge| edge.2).map(|edge| edge.0).collect();
        let expected = [400, 1400, 2400, 3400, 4400, 5410, 6390, 7390, 8390, 9390, 10_390, 11_390];
        assert_eq!(ons.len(), expected.len(), "{ons:?}");
        for (on, expected) in ons.iter().zip(expected) {
            assert!((on - expected).abs() <= 20, "{ons:?}");
        }
    }

    #[test]
    fn it_goes_dark_without_sync_for_two_frames() {
        let mut laser = armed(Trigger::PanelSync);
        laser.see_sync(TimeNs(0), TimeNs(0)).unwrap();
        laser.advance(TimeNs(29_000));
        let events = events(&mut laser);
        assert_eq!(events.last(), Some(&BoxEvent::Dark { t: TimeNs(6000), reason: DarkReason::SyncLost }));
        assert_eq!(events.len(), 2 + 2 * 6);
        assert_eq!(laser.see_sync(TimeNs(29_000), TimeNs(29_000)), Err(Refusal::NotArmed));
    }

    #[test]
    fn it_goes_dark_without_heartbeat_in_the_middle_of_a_window_even_if_nobody_looks() {
        let mut laser = armed(Trigger::Host);
        laser.hear_heartbeat(TimeNs(0)).unwrap();
        let window = LitWindow { colour: Colour::Blue, t_on: TimeNs(29_900), t_off: TimeNs(30_200) };
        laser.take_window(window, TimeNs(100)).unwrap();
        laser.advance(TimeNs(5_000_000_000));
        let expected = [
            BoxEvent::Armed { t: TimeNs(0) },
            BoxEvent::Edge(LaserEdge { t: TimeNs(29_900), colour: Colour::Blue, on: true }),
            BoxEvent::Edge(LaserEdge { t: TimeNs(30_000), colour: Colour::Blue, on: false }),
            BoxEvent::Dark { t: TimeNs(30_000), reason: DarkReason::Heartbeat },
        ];
        assert_eq!(events(&mut laser), expected);
        assert!(!laser.is_armed());
    }

    #[test]
    fn dark_is_at_once_and_forgets_what_was_asked() {
        let mut laser = armed(Trigger::Host);
        for t_on in [100, 1000] {
            let window = LitWindow { colour: Colour::Red, t_on: TimeNs(t_on), t_off: TimeNs(t_on + 200) };
            laser.take_window(window, TimeNs(0)).unwrap();
        }
        laser.set_dark(DarkReason::Asked, TimeNs(150));
        assert_eq!(laser.lit(), None);
        laser.set_armed(TimeNs(160)).unwrap();
        laser.advance(TimeNs(2000));
        assert_eq!(edges(&mut laser), [(100, Colour::Red, true), (150, Colour::Red, false)]);
    }

    #[test]
    fn windows_of_the_host_are_cut_to_the_present_and_never_overlap() {
        let mut laser = armed(Trigger::Host);
        let window = |colour, t_on, t_off| LitWindow { colour, t_on: TimeNs(t_on), t_off: TimeNs(t_off) };
        laser.take_window(window(Colour::Red, 100, 400), TimeNs(200)).unwrap();
        assert_eq!(laser.take_window(window(Colour::Green, 399, 600), TimeNs(210)), Err(Refusal::Overlap));
        assert_eq!(laser.take_window(window(Colour::Green, 100, 210), TimeNs(210)), Err(Refusal::Late));
        laser.take_window(window(Colour::Green, 400, 600), TimeNs(220)).unwrap();
        laser.advance(TimeNs(1000));
        let (r, g) = (Colour::Red, Colour::Green);
        assert_eq!(edges(&mut laser), [(200, r, true), (400, r, false), (400, g, true), (600, g, false)]);
        let mut synced = armed(Trigger::PanelSync);
        assert_eq!(synced.take_window(window(Colour::Red, 100, 400), TimeNs(0)), Err(Refusal::Trigger));
    }

    #[test]
    fn a_program_whose_windows_overlap_is_refused() {
        let mut overlapping = program(Trigger::PanelSync);
        overlapping.windows[1].delay = TimeNs(699);
        let mut laser = SimulatedLaser::new(TimeNs(0));
        assert_eq!(laser.set_program(&overlapping, TimeNs(0)), Err(Refusal::Overlap));
        let mut round_the_end = program(Trigger::PanelSync);
        round_the_end.windows[2].width = TimeNs(1001);
        assert_eq!(laser.set_program(&round_the_end, TimeNs(0)), Err(Refusal::Overlap));
    }

    #[derive(Clone, Debug)]
    enum Deed {
        Wait,
        Sync { ago: i64 },
        Light { colour: usize, ahead: i64, width: i64 },
        Heartbeat,
        Dark,
        Arm,
    }

    fn deeds() -> impl Strategy<Value = (i64, Deed)> {
        let deed = prop_oneof![
            Just(Deed::Wait),
            (-100i64..4000).prop_map(|ago| Deed::Sync { ago }),
            (0usize..3, -500i64..3000, -10i64..2000).prop_map(|(colour, ahead, width)| Deed::Light {
                colour,
                ahead,
                width
            }),
            Just(Deed::Heartbeat),
            Just(Deed::Dark),
            Just(Deed::Arm),
        ];
        (0i64..6000, deed)
    }

    proptest! {
        /// Whatever a host does: never two lit, edges in order and in pairs, dark when not armed, and no light later than
        /// the heartbeat timeout after the last heartbeat.
        #[test]
        fn no_host_can_make_it_break_its_rules(host in prop::bool::ANY, deeds in prop::collection::vec(deeds(), 1..120)) {
            let mut laser = armed(if host { Trigger::Host } else { Trigger::PanelSync });
            let mut now = TimeNs(0);
            let mut heartbeats = vec![TimeNs(0)];
            let mut log = Vec::new();
            for (later, deed) in deeds {
                now = now + TimeNs(later);
                let _refused = match deed {
                    Deed::Wait => {
                        laser.advance(now);
                        Ok(())
                    }
                    Deed::Sync { ago } => laser.see_sync(now - TimeNs(ago), now),
                    Deed::Light { colour, ahead, width } => {
                        let t_on = now + TimeNs(ahead);
                        laser.take_window(LitWindow { colour: Colour::ALL[colour], t_on, t_off: t_on + TimeNs(width) }, now)
                    }
                    Deed::Heartbeat => {
                        heartbeats.push(now);
                        laser.hear_heartbeat(now)
                    }
                    Deed::Dark => {
                        laser.set_dark(DarkReason::Asked, now);
                        Ok(())
                    }
                    Deed::Arm => {
                        heartbeats.push(now);
                        laser.set_armed(now)
                    }
                };
                log.extend(events(&mut laser));
            }
            laser.advance(now + TimeNs(1_000_000));
            log.extend(events(&mut laser));
            prop_assert_eq!(laser.lit(), None);

            let mut lit: Option<LaserEdge> = None;
            let mut is_armed = false;
            let mut t_before = TimeNs(0);
            for event in log {
                let t = match event {
                    BoxEvent::Armed { t } => { is_armed = true; t }
                    BoxEvent::Dark { t, .. } => {
                        prop_assert_eq!(lit, None);
                        is_armed = false;
                        t
                    }
                    BoxEvent::Edge(edge) => {
                        prop_assert!(is_armed);
                        if edge.on {
                            prop_assert_eq!(lit, None);
                            lit = Some(edge);
                        } else {
                            let on = lit.take();
                            prop_assert!(on.is_some_and(|on| on.colour == edge.colour && on.t <= edge.t));
                            let heard = heartbeats.iter().any(|&t| t <= edge.t && edge.t.0 - t.0 <= 30_000);
                            prop_assert!(heard, "lit until {:?} without heartbeat", edge.t);
                        }
                        edge.t
                    }
                };
                prop_assert!(t >= t_before);
                t_before = t;
            }
        }
    }
}
