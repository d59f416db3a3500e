//! The firmware on a board of memory: bytes in, gates out.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

use holod_laser_firmware::command::{Answer, Message};
use holod_laser_firmware::line::checked;
use holod_laser_firmware::{
    Command, Controller, DarkReason, Event, Hardware, Laser, Limits, Line, Machine, Refusal, Sequence, State, TimeUs,
    Trigger, Window,
};
use proptest::prelude::*;

const LIMITS: Limits =
    Limits { power_uw: [2000, 1000, 3000], timeout_us: 200_000, lit_us: 8000, jitter_us: 20, sync_input: true };
/// A colour frame of three fields of 1000 µs, each lit from 400 to 700, and a heartbeat timeout of ten frames.
const PERIOD_US: u32 = 3000;
const TIMEOUT_US: u32 = 30_000;

/// What the pins of a board did, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pin {
    Gate(Option<Laser>),
    Power([u32; 3]),
}

#[derive(Debug, Default)]
struct Wires {
    now: u64,
    interlock_open: bool,
    host_absent: bool,
    edges: VecDeque<TimeUs>,
    to_box: VecDeque<u8>,
    from_box: Vec<u8>,
    pins: Vec<Pin>,
}

/// A board whose wires the test holds, too.
#[derive(Clone, Debug, Default)]
struct Board(Rc<RefCell<Wires>>);

impl Hardware for Board {
    fn now(&mut self) -> TimeUs {
        TimeUs(self.0.borrow().now)
    }

    fn sync_edge(&mut self) -> Option<TimeUs> {
        self.0.borrow_mut().edges.pop_front()
    }

    fn interlock_closed(&mut self) -> bool {
        !self.0.borrow().interlock_open
    }

    fn host_present(&mut self) -> bool {
        !self.0.borrow().host_absent
    }

    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        let to_box = &mut self.0.borrow_mut().to_box;
        let count = bytes.len().min(to_box.len());
        for (place, byte) in bytes.iter_mut().zip(to_box.drain(..count)) {
            *place = byte;
        }
        count
    }

    fn send(&mut self, line: &[u8]) {
        self.0.borrow_mut().from_box.extend(line);
    }

    fn set_gate(&mut self, lit: Option<Laser>) {
        self.0.borrow_mut().pins.push(Pin::Gate(lit));
    }

    fn set_power(&mut self, power_uw: [u32; 3]) {
        self.0.borrow_mut().pins.push(Pin::Power(power_uw));
    }

    fn feed_watchdog(&mut self) {}
}

struct Bench {
    wires: Rc<RefCell<Wires>>,
    controller: Controller<Board>,
    events: Vec<Event>,
}

impl Bench {
    fn boot() -> Self {
        let board = Board::default();
        let wires = Rc::clone(&board.0);
        Self { wires, controller: Controller::new(board, "bench", LIMITS), events: Vec::new() }
    }

    /// A box that has been given its program.
    fn programmed(trigger: Trigger) -> Self {
        let mut bench = Self::boot();
        bench.said();
        for command in program(trigger) {
            assert_eq!(bench.ask(Command::Arm), Err(Refusal::NotProgrammed));
            assert!(bench.ask(command).is_ok(), "{command}");
        }
        bench
    }

    fn armed(trigger: Trigger) -> Self {
        let mut bench = Self::programmed(trigger);
        assert!(bench.ask(Command::Arm).is_ok());
        bench.events.clear();
        bench.wires.borrow_mut().pins.clear();
        bench
    }

    fn step(&mut self) {
        let events = &mut self.events;
        self.controller.step(&mut |event| events.push(event));
    }

    /// Runs the box's loop every 10 µs until `t_us`.
    fn run_until(&mut self, t_us: u64) {
        while self.wires.borrow().now < t_us {
            let now = (self.wires.borrow().now + 10).min(t_us);
            self.wires.borrow_mut().now = now;
            self.step();
        }
    }

    fn run_for(&mut self, us: u32) {
        let now = self.wires.borrow().now;
        self.run_until(now + u64::from(us));
    }

    fn send(&mut self, bytes: &[u8]) {
        self.wires.borrow_mut().to_box.extend(bytes);
        while !self.wires.borrow().to_box.is_empty() {
            self.step();
        }
    }

    /// What the box has said since the last call, as texts.
    fn said(&mut self) -> Vec<String> {
        let bytes = std::mem::take(&mut self.wires.borrow_mut().from_box);
        let lines = bytes.split_inclusive(|&byte| byte == b'\n');
        lines.map(|line| checked(line.strip_suffix(b"\n").unwrap()).unwrap().to_owned()).collect()
    }

    /// Sends a command; what the box answers to it.
    fn ask(&mut self, command: Command) -> Result<Option<State>, Refusal> {
        self.said();
        self.send(Line::new(format_args!("7 {command}")).unwrap().as_bytes());
        for text in self.said() {
            match Message::parse(&text).unwrap_or_else(|| panic!("{text:?}")) {
                Message::Done { number: 7, answer: Answer::State { state, .. } } => return Ok(Some(state)),
                Message::Done { number: 7, .. } => return Ok(None),
                Message::Refused { number: 7, refusal } => return Err(refusal),
                _ => {}
            }
        }
        panic!("no answer to {command}");
    }

    fn state(&mut self) -> State {
        self.ask(Command::State).unwrap().unwrap()
    }

    fn edge(&mut self, t_us: u64) {
        self.wires.borrow_mut().edges.push_back(TimeUs(t_us));
        self.step();
    }

    /// (time, laser, on) of the edges so far.
    fn edges(&self) -> Vec<(u64, Laser, bool)> {
        let edge = |event: &Event| match *event {
            Event::On { t, laser } => Some((t.0, laser, true)),
            Event::Off { t, laser } => Some((t.0, laser, false)),
            _ => None,
        };
        self.events.iter().filter_map(edge).collect()
    }
}

fn program(trigger: Trigger) -> Vec<Command> {
    let sequence = Sequence::new([Laser::Green, Laser::Red, Laser::Blue]).unwrap();
    let mut commands = vec![
        Command::Sequence { sequence, period_us: PERIOD_US, trigger },
        Command::PowerLimit([500, 600, 700]),
        Command::Power([10, 20, 30]),
    ];
    if trigger != Trigger::Host {
        commands.extend((0..3).map(|field| Command::Field {
            field,
            window: Window { delay_us: 1000 * field as u32 + 400, width_us: 300 },
        }));
    }
    commands.push(Command::Timeout(TIMEOUT_US));
    commands
}

fn light(laser: Laser, t_on: u64, t_off: u64) -> Command {
    Command::Light { laser, t_on: TimeUs(t_on), t_off: TimeUs(t_off) }
}

fn frame(t: u64, error_us: u32) -> Command {
    Command::Frame { t: TimeUs(t), error_us }
}

const FRAME: [(u64, Laser, bool); 6] = [
    (400, Laser::Green, true),
    (700, Laser::Green, false),
    (1400, Laser::Red, true),
    (1700, Laser::Red, false),
    (2400, Laser::Blue, true),
    (2700, Laser::Blue, false),
];

#[test]
fn it_boots_dark_and_says_so_and_lights_nothing_until_it_is_programmed_and_armed() {
    let mut bench = Bench::boot();
    assert_eq!(bench.wires.borrow().pins, [Pin::Gate(None), Pin::Power([0; 3])]);
    assert_eq!(bench.said(), ["!BOOT"]);
    assert_eq!(bench.state().reason, DarkReason::Boot);
    for command in [Command::Heartbeat, frame(0, 0), light(Laser::Red, 0, 100)] {
        assert_eq!(bench.ask(command), Err(Refusal::NotArmed));
    }
    assert_eq!(bench.ask(Command::Arm), Err(Refusal::NotProgrammed));
    bench.edge(0);
    bench.run_until(50_000);
    assert_eq!((bench.edges(), bench.state().armed), (vec![], false));
}

#[test]
fn it_says_who_it_is_what_it_is_built_for_and_how_it_is() {
    let mut bench = Bench::armed(Trigger::Sync);
    bench.send(Line::new("1 ID?").unwrap().as_bytes());
    bench.run_until(500);
    bench.edge(100);
    bench.run_until(600);
    for text in ["2 LIM?", "3 STAT?", "4 NOW?", "5 HB"] {
        bench.send(Line::new(text).unwrap().as_bytes());
    }
    let expected = [
        "OK 1 holod-laser-box 3 bench",
        "OK 2 600 limits 2000 1000 3000 200000 8000 20 sync",
        "OK 3 600 armed boot G closed 1 100",
        "OK 4 600",
        "OK 5 600 1 100",
    ];
    assert_eq!(bench.said(), expected);
}

#[test]
fn each_sync_edge_lights_each_field_once_in_its_order_and_nothing_follows_without_one() {
    let mut bench = Bench::armed(Trigger::Sync);
    bench.edge(0);
    bench.run_until(5900);
    assert_eq!(bench.edges(), FRAME);
    assert!(bench.state().armed);
    bench.run_until(6000);
    assert_eq!(bench.state().reason, DarkReason::SyncLost);
    let gates: Vec<_> = bench.wires.borrow().pins.clone();
    let expected = [Laser::Green, Laser::Red, Laser::Blue].map(|laser| [Pin::Gate(Some(laser)), Pin::Gate(None)]);
    assert_eq!(gates[..6], expected.as_flattened()[..]);
    assert_eq!(gates[6..], [Pin::Gate(None), Pin::Power([0; 3])]);
}

#[test]
fn sync_that_jitters_or_is_told_late_neither_skips_nor_doubles_a_window() {
    let mut bench = Bench::armed(Trigger::Frame);
    for (t_frame, t_told) in [(0, 5), (3010, 3300), (5990, 6001), (9000, 9350)] {
        bench.run_until(t_told);
        bench.ask(Command::Heartbeat).unwrap();
        bench.ask(frame(t_frame, 0)).unwrap();
    }
    bench.run_until(12_000);
    let ons: Vec<_> = bench.edges().into_iter().filter(|edge| edge.2).map(|edge| edge.0).collect();
    assert_eq!(ons, [400, 1400, 2400, 3410, 4410, 5410, 6390, 7390, 8390, 9400, 10_400, 11_400]);
}

#[test]
fn what_is_not_known_of_a_frames_start_is_cut_off_its_windows_at_both_ends() {
    let mut bench = Bench::armed(Trigger::Frame);
    bench.run_until(200);
    bench.ask(frame(100, 90)).unwrap();
    bench.run_until(1200);
    assert_eq!(bench.edges(), [(590, Laser::Green, true), (710, Laser::Green, false)]);
    let mut unsure = Bench::armed(Trigger::Frame);
    unsure.run_until(200);
    unsure.ask(frame(100, 150)).unwrap();
    unsure.run_until(3000);
    assert_eq!(unsure.edges(), []);
    assert_eq!(unsure.ask(frame(3200, 100)), Err(Refusal::Range), "an announced frame");
}

#[test]
fn a_frame_that_begins_early_ends_what_the_frame_before_it_lit() {
    let mut bench = Bench::armed(Trigger::Sync);
    bench.edge(0);
    bench.run_until(2500);
    bench.edge(2500);
    bench.run_until(2800);
    assert_eq!(bench.edges()[4..], [(2400, Laser::Blue, true), (2500, Laser::Blue, false)]);
    assert!(bench.state().armed);
}

#[test]
fn sync_at_twice_the_rate_makes_dark() {
    let mut bench = Bench::armed(Trigger::Sync);
    bench.edge(0);
    bench.run_until(1500);
    bench.said();
    bench.edge(1500);
    assert_eq!(bench.said(), ["!DARK 1500 sync-rate"]);
    assert_eq!(bench.state().reason, DarkReason::SyncRate);
    assert_eq!(bench.edges().last(), Some(&(1500, Laser::Red, false)));
}

#[test]
fn windows_of_the_host_are_cut_to_the_present_and_never_overlap() {
    let mut bench = Bench::armed(Trigger::Host);
    bench.run_until(200);
    bench.ask(light(Laser::Red, 100, 400)).unwrap();
    bench.run_until(210);
    assert_eq!(bench.ask(light(Laser::Green, 399, 600)), Err(Refusal::Overlap));
    assert_eq!(bench.ask(light(Laser::Green, 100, 210)), Err(Refusal::Late));
    assert_eq!(bench.ask(light(Laser::Green, 500, 500)), Err(Refusal::Late));
    assert_eq!(bench.ask(light(Laser::Green, 500, 500 + 8001)), Err(Refusal::Range));
    assert_eq!(bench.ask(light(Laser::Green, 2_000_000, 2_000_100)), Err(Refusal::Range));
    for t_on in [400, 600, 800, 1000] {
        bench.ask(light(Laser::Green, t_on, t_on + 100)).unwrap();
    }
    assert_eq!(bench.ask(light(Laser::Blue, 1200, 1300)), Err(Refusal::Overlap), "no room for another");
    bench.run_until(1500);
    let on = |&(_, _, on): &(u64, Laser, bool)| on;
    let times: Vec<_> = bench.edges().into_iter().filter(on).map(|(t, laser, _)| (t, laser)).collect();
    assert_eq!(times, [200, 400, 600, 800, 1000].map(|t| (t, if t == 200 { Laser::Red } else { Laser::Green })));
    assert_eq!(Bench::armed(Trigger::Sync).ask(light(Laser::Red, 100, 400)), Err(Refusal::Trigger));
    assert_eq!(Bench::armed(Trigger::Host).ask(frame(0, 0)), Err(Refusal::Trigger));
}

#[test]
fn a_laser_that_is_not_in_the_sequence_is_not_lit() {
    let mut bench = Bench::programmed(Trigger::Host);
    let sequence = Sequence::new([Laser::Green]).unwrap();
    bench.ask(Command::Sequence { sequence, period_us: 16_667, trigger: Trigger::Host }).unwrap();
    for command in &program(Trigger::Host)[1..] {
        bench.ask(*command).unwrap();
    }
    bench.ask(Command::Arm).unwrap();
    assert_eq!(bench.ask(light(Laser::Red, 100, 400)), Err(Refusal::Laser));
    bench.ask(light(Laser::Green, 100, 400)).unwrap();
}

#[test]
fn the_gate_of_a_laser_without_power_stays_closed() {
    for trigger in [Trigger::Host, Trigger::Sync] {
        let mut bench = Bench::programmed(trigger);
        bench.ask(Command::Power([10, 0, 30])).unwrap();
        bench.ask(Command::Arm).unwrap();
        match trigger {
            Trigger::Host => {
                for (laser, t_on) in [(Laser::Green, 400), (Laser::Red, 1400), (Laser::Blue, 2400)] {
                    bench.ask(light(laser, t_on, t_on + 300)).unwrap();
                }
            }
            _ => bench.edge(0),
        }
        bench.run_until(2800);
        let was_open = |laser: Laser| {
            bench.wires.borrow().pins.iter().any(|pin| matches!(pin, Pin::Gate(Some(lit)) if *lit == laser))
        };
        assert_eq!([Laser::Red, Laser::Green, Laser::Blue].map(was_open), [true, false, true], "{trigger:?}");
    }
}

#[test]
fn programs_that_no_box_can_run_are_refused() {
    let sequence = Sequence::new(Laser::ALL).unwrap();
    let with_field = |field, delay_us, width_us| Command::Field { field, window: Window { delay_us, width_us } };
    let mut bench = Bench::programmed(Trigger::Sync);
    for (command, refusal) in [
        (Command::Sequence { sequence, period_us: 499, trigger: Trigger::Sync }, Refusal::Range),
        (Command::Sequence { sequence, period_us: 1_000_001, trigger: Trigger::Sync }, Refusal::Range),
        (with_field(0, 1, 0), Refusal::Range),
        (with_field(0, 1, 8001), Refusal::Range),
        (with_field(0, 1_000_001, 1), Refusal::Range),
        (Command::PowerLimit([2001, 0, 0]), Refusal::Power),
        (Command::PowerLimit([0, 1001, 0]), Refusal::Power),
        (Command::Power([0, 0, 701]), Refusal::Power),
        (Command::Timeout(0), Refusal::Range),
        (Command::Timeout(200_001), Refusal::Range),
    ] {
        assert_eq!(bench.ask(command), Err(refusal), "{command}");
    }
    assert!(bench.ask(Command::Arm).is_ok(), "a refused command changes nothing");
    for command in program(Trigger::Sync) {
        assert_eq!(bench.ask(command), Err(Refusal::Armed));
    }
    for (field, delay_us, width_us) in [(1, 699, 300), (2, 2400, 601)] {
        let mut bench = Bench::programmed(Trigger::Sync);
        bench.ask(with_field(field, delay_us, width_us)).unwrap();
        assert_eq!(bench.ask(Command::Arm), Err(Refusal::Overlap));
    }
    let mut limited = Bench::programmed(Trigger::Sync);
    limited.ask(Command::PowerLimit([1, 1, 1])).unwrap();
    assert_eq!(limited.ask(Command::Arm), Err(Refusal::NotProgrammed), "a new limit asks for a new power");
    let mut machine = Machine::new(Limits { sync_input: false, ..LIMITS }, TimeUs(0));
    let sync = Command::Sequence { sequence, period_us: 3000, trigger: Trigger::Sync };
    assert_eq!(machine.obey(&sync, TimeUs(0), &mut |_| ()), Err(Refusal::Trigger));
}

/// Every way into darkness, out of every state that may be lit: the laser goes out at once, the power is taken away,
/// the box says why where its host does not know, and nothing lights it again but a new `ARM`.
#[test]
fn every_fault_makes_dark_from_every_armed_state_until_it_is_armed_again() {
    type Fault = (DarkReason, fn(&mut Bench));
    let faults: [Fault; 9] = [
        (DarkReason::Asked, |bench| assert!(bench.ask(Command::Disarm(DarkReason::Asked)).is_ok())),
        (DarkReason::Shutdown, |bench| assert!(bench.ask(Command::Disarm(DarkReason::Shutdown)).is_ok())),
        (DarkReason::Line, |bench| bench.send(b"3 HB*00\n")),
        (DarkReason::Line, |bench| bench.send(Line::new("3 NONSENSE").unwrap().as_bytes())),
        (DarkReason::Line, |bench| bench.send(&[&[b'x'; 300][..], b"\n"].concat())),
        (DarkReason::Interlock, |bench| bench.wires.borrow_mut().interlock_open = true),
        (DarkReason::HangUp, |bench| bench.wires.borrow_mut().host_absent = true),
        (DarkReason::SyncLost, |bench| bench.run_for(2 * PERIOD_US)),
        (DarkReason::Heartbeat, |bench| bench.run_for(TIMEOUT_US)),
    ];
    for (reason, fault) in faults {
        for (trigger, lit) in
            [(Trigger::Sync, false), (Trigger::Sync, true), (Trigger::Host, false), (Trigger::Host, true)]
        {
            // Each trigger loses its own sign of life first.
            if matches!(
                (reason, trigger),
                (DarkReason::SyncLost, Trigger::Host) | (DarkReason::Heartbeat, Trigger::Sync)
            ) {
                continue;
            }
            let mut bench = Bench::armed(trigger);
            if lit {
                match trigger {
                    Trigger::Host => assert!(bench.ask(light(Laser::Green, 400, 700)).is_ok()),
                    _ => bench.edge(0),
                }
                bench.run_until(500);
                assert_eq!(bench.state().lit, Some(Laser::Green));
            }
            let case = format!("{reason} from {trigger:?}, lit: {lit}");
            bench.said();
            fault(&mut bench);
            bench.step();
            let said = bench.said();
            assert_eq!(said.iter().any(|text| text.starts_with("!DARK")), reason.is_of_box(), "{case}: {said:?}");
            let pins = bench.wires.borrow().pins.clone();
            assert_eq!(pins[pins.len() - 2..], [Pin::Gate(None), Pin::Power([0; 3])], "{case}");
            assert!(
                matches!(bench.events.last(), Some(Event::Dark { reason: found, .. }) if *found == reason),
                "{case}"
            );
            let state = bench.state();
            assert_eq!((state.armed, state.lit, state.reason), (false, None, reason), "{case}");

            let edges = bench.edges().len();
            assert_eq!(bench.ask(Command::Heartbeat), Err(Refusal::NotArmed), "{case}");
            let now = bench.wires.borrow().now;
            bench.edge(now);
            bench.run_until(now + 10_000);
            assert_eq!(bench.edges().len(), edges, "{case}: lit again without being armed");
            let rearmed = bench.ask(Command::Arm);
            match reason {
                DarkReason::Interlock => {
                    assert_eq!(rearmed, Err(Refusal::Interlock));
                    bench.wires.borrow_mut().interlock_open = false;
                    assert!(bench.ask(Command::Arm).is_ok());
                }
                DarkReason::HangUp => {
                    assert_eq!(rearmed, Err(Refusal::HangUp));
                    bench.wires.borrow_mut().host_absent = false;
                    assert!(bench.ask(Command::Arm).is_ok());
                }
                _ => assert!(rearmed.is_ok(), "{case}"),
            }
            bench.step();
            bench.run_for(100);
            assert_eq!(bench.edges().len(), edges, "{case}: what was asked before it was dark is forgotten");
            assert_eq!(bench.wires.borrow().pins.last(), Some(&Pin::Power([10, 20, 30])), "{case}");
        }
    }
}

/// Lit or dark, whatever its host says meanwhile.
#[test]
fn a_box_that_was_made_dark_by_hand_is_not_armed_until_a_host_begins_anew() {
    for before in [Bench::armed, Bench::programmed] {
        let mut bench = before(Trigger::Host);
        bench.ask(Command::Disarm(DarkReason::ByHand)).unwrap();
        for reason in [DarkReason::Asked, DarkReason::BoxFault, DarkReason::Shutdown] {
            bench.ask(Command::Disarm(reason)).unwrap();
            for command in program(Trigger::Host) {
                bench.ask(command).unwrap();
            }
            assert_eq!(bench.ask(Command::Arm), Err(Refusal::ByHand));
            assert_eq!(bench.state().reason, DarkReason::ByHand);
        }
        bench.ask(Command::Disarm(DarkReason::Boot)).unwrap();
        bench.ask(Command::Arm).unwrap();
        assert!(bench.state().armed);
    }
}

#[test]
fn heartbeats_hold_it_and_their_end_cuts_a_window_even_if_the_box_looks_late() {
    let mut bench = Bench::armed(Trigger::Host);
    for t in [10_000, 35_000] {
        bench.run_until(t);
        bench.ask(Command::Heartbeat).unwrap();
    }
    bench.ask(light(Laser::Blue, 64_900, 65_200)).unwrap();
    // The loop stands still for five seconds.
    bench.wires.borrow_mut().now = 5_000_000;
    bench.step();
    let expected = [
        Event::On { t: TimeUs(64_900), laser: Laser::Blue },
        Event::Off { t: TimeUs(65_000), laser: Laser::Blue },
        Event::Dark { t: TimeUs(65_000), reason: DarkReason::Heartbeat },
    ];
    assert_eq!(bench.events, expected);
    assert!(!bench.wires.borrow().pins.contains(&Pin::Gate(Some(Laser::Blue))), "no gate opens after its time");
    assert_eq!(bench.said(), ["!DARK 65000 heartbeat"]);
}

#[test]
fn a_field_that_has_been_lit_is_not_lit_again_by_arming_in_it() {
    let mut bench = Bench::armed(Trigger::Frame);
    bench.run_until(5);
    bench.ask(frame(0, 0)).unwrap();
    bench.run_until(600);
    bench.ask(Command::Disarm(DarkReason::Asked)).unwrap();
    bench.ask(Command::Arm).unwrap();
    bench.ask(frame(0, 0)).unwrap();
    bench.run_until(2000);
    let expected =
        [(400, Laser::Green, true), (600, Laser::Green, false), (1400, Laser::Red, true), (1700, Laser::Red, false)];
    assert_eq!(bench.edges(), expected);
}

#[derive(Clone, Debug)]
enum Deed {
    Wait,
    Edge { ago: u64 },
    Tell { ago: u64, error_us: u32 },
    Light { laser: usize, ahead: i64, width: i64 },
    Heartbeat,
    Disarm,
    Arm,
    Interlock(bool),
    Host(bool),
    Program(usize),
    Noise(Vec<u8>),
}

fn deeds() -> impl Strategy<Value = (u64, Deed)> {
    let deed = prop_oneof![
        2 => Just(Deed::Wait),
        3 => (0u64..1000).prop_map(|ago| Deed::Edge { ago }),
        3 => (0u64..4000, 0u32..200).prop_map(|(ago, error_us)| Deed::Tell { ago, error_us }),
        4 => (0usize..3, -500i64..3000, -10i64..2000)
            .prop_map(|(laser, ahead, width)| Deed::Light { laser, ahead, width }),
        4 => Just(Deed::Heartbeat),
        1 => Just(Deed::Disarm),
        4 => Just(Deed::Arm),
        1 => prop::bool::weighted(0.7).prop_map(Deed::Interlock),
        1 => prop::bool::weighted(0.7).prop_map(Deed::Host),
        1 => (0usize..8).prop_map(Deed::Program),
        1 => prop::collection::vec(any::<u8>(), 0..40).prop_map(Deed::Noise),
    ];
    (0u64..3000, deed)
}

/// What an outsider sees of a box: its events, and what it was told and shown.
#[derive(Default)]
struct Judge {
    events: Vec<Event>,
    /// When a heartbeat or an arming could have been heard.
    heard: Vec<u64>,
    /// Stretches of time in which it must be dark.
    forbidden: Vec<(u64, u64)>,
}

impl Judge {
    /// The first rule that is broken.
    fn fault(&self) -> Option<String> {
        let mut lit: Option<(u64, Laser)> = None;
        let mut armed = false;
        let mut before = 0;
        for event in &self.events {
            let (Event::Armed { t } | Event::On { t, .. } | Event::Off { t, .. } | Event::Dark { t, .. }) = *event;
            if t.0 < before {
                return Some(format!("{event:?} after {before}"));
            }
            before = t.0;
            match *event {
                Event::Armed { .. } if armed => return Some(format!("armed twice: {event:?}")),
                Event::Armed { .. } => armed = true,
                Event::Dark { .. } if !armed || lit.is_some() => return Some(format!("{event:?} while lit: {lit:?}")),
                Event::Dark { .. } => armed = false,
                Event::On { laser, .. } if !armed || lit.is_some() => {
                    return Some(format!("{laser:?} on at {} while armed: {armed}, lit: {lit:?}", t.0));
                }
                Event::On { laser, .. } => lit = Some((t.0, laser)),
                Event::Off { laser, .. } => {
                    let Some((t_on, on)) = lit.take() else { return Some(format!("{event:?} while dark")) };
                    if on != laser || t.0 - t_on > u64::from(LIMITS.lit_us) {
                        return Some(format!("{on:?} on at {t_on}, then {event:?}"));
                    }
                    if !self.heard.iter().any(|&heard| heard <= t_on && t.0 - heard <= u64::from(LIMITS.timeout_us)) {
                        return Some(format!("lit until {} without a heartbeat", t.0));
                    }
                    if let Some(stretch) = self.forbidden.iter().find(|stretch| t_on < stretch.1 && stretch.0 < t.0) {
                        return Some(format!("lit from {t_on} to {} within {stretch:?}", t.0));
                    }
                }
            }
        }
        lit.map(|lit| format!("still lit: {lit:?}"))
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    /// Whatever comes over the line and the wires: never two lasers, edges in order and in pairs, dark when not armed,
    /// while the interlock is open or no host is there, and no light later than the heartbeat timeout after the last
    /// heartbeat; and the gates did what the events say.
    #[test]
    fn nothing_makes_it_break_its_rules(
        trigger in prop::sample::select(vec![Trigger::Sync, Trigger::Frame, Trigger::Host]),
        deeds in prop::collection::vec(deeds(), 1..120),
    ) {
        let mut bench = Bench::programmed(trigger);
        bench.events.clear();
        let mut judge = Judge::default();
        let mut number = 0;
        let mut open_since = None;
        for (later, deed) in deeds {
            let now = bench.wires.borrow().now + later;
            bench.wires.borrow_mut().now = now;
            number += 1;
            let command = match deed {
                Deed::Wait => None,
                Deed::Edge { ago } => {
                    bench.wires.borrow_mut().edges.push_back(TimeUs(now.saturating_sub(ago)));
                    None
                }
                Deed::Tell { ago, error_us } => Some(frame(now.saturating_sub(ago), error_us)),
                Deed::Light { laser, ahead, width } => {
                    let t_on = now.saturating_add_signed(ahead);
                    Some(light(Laser::ALL[laser], t_on, t_on.saturating_add_signed(width)))
                }
                Deed::Heartbeat => {
                    judge.heard.push(now);
                    Some(Command::Heartbeat)
                }
                Deed::Disarm => Some(Command::Disarm(DarkReason::Asked)),
                Deed::Arm => {
                    judge.heard.push(now);
                    Some(Command::Arm)
                }
                Deed::Interlock(closed) => {
                    bench.wires.borrow_mut().interlock_open = !closed;
                    None
                }
                Deed::Host(present) => {
                    bench.wires.borrow_mut().host_absent = !present;
                    None
                }
                Deed::Program(index) => program(trigger).get(index).copied(),
                Deed::Noise(bytes) => {
                    bench.send(&bytes);
                    None
                }
            };
            if let Some(command) = command {
                bench.send(Line::new(format_args!("{number} {command}")).unwrap().as_bytes());
            }
            bench.step();
            let wires = bench.wires.borrow();
            match (wires.interlock_open || wires.host_absent, open_since) {
                (true, None) => open_since = Some(now),
                (false, Some(since)) => {
                    judge.forbidden.push((since, now));
                    open_since = None;
                }
                _ => {}
            }
        }
        let now = bench.wires.borrow().now;
        judge.forbidden.extend(open_since.map(|since| (since, u64::MAX)));
        bench.wires.borrow_mut().now = now + 10_000_000;
        bench.step();
        prop_assert!(!bench.controller.machine().is_armed());
        judge.events = std::mem::take(&mut bench.events);
        prop_assert_eq!(judge.fault(), None);
        let pins = bench.wires.borrow().pins.clone();
        let last_gate = pins.iter().rev().find_map(|pin| if let Pin::Gate(gate) = pin { Some(*gate) } else { None });
        prop_assert_eq!(last_gate, Some(None));
        for power in pins.iter().filter_map(|pin| if let Pin::Power(power) = pin { Some(power) } else { None }) {
            prop_assert!([[0; 3], [10, 20, 30]].contains(power));
        }
    }

    /// Bytes that nobody meant, whole lines among them.
    #[test]
    fn noise_never_lights_a_laser(chunks in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..200), 0..20)) {
        let mut bench = Bench::armed(Trigger::Host);
        for chunk in chunks {
            bench.send(&chunk);
            bench.run_for(500);
        }
        prop_assert_eq!(bench.edges(), vec![]);
    }
}

#[test]
fn canary_the_judge_objects_to_each_broken_rule() {
    let (red, green) = (Laser::Red, Laser::Green);
    let on = |t, laser| Event::On { t: TimeUs(t), laser };
    let off = |t, laser| Event::Off { t: TimeUs(t), laser };
    let armed = Event::Armed { t: TimeUs(0) };
    let dark = Event::Dark { t: TimeUs(900), reason: DarkReason::Asked };
    let judge =
        |events: &[Event]| Judge { events: events.to_vec(), heard: vec![0], forbidden: vec![(2000, 3000)] }.fault();
    assert_eq!(judge(&[armed, on(10, red), off(20, red), on(20, green), off(30, green), dark]), None);
    for events in [
        &[on(10, red), off(20, red)][..],
        &[armed, on(10, red)],
        &[armed, on(10, red), on(15, green), off(20, red), off(30, green)],
        &[armed, on(10, red), off(20, green)],
        &[armed, off(20, red)],
        &[armed, on(30, red), off(20, red)],
        &[armed, on(10, red), dark],
        &[armed, dark, on(1000, red), off(1100, red)],
        &[armed, armed],
        &[armed, on(10, red), off(9000, red)],
        &[armed, on(300_000, red), off(300_100, red)],
        &[armed, on(1999, red), off(2001, red)],
    ] {
        assert!(judge(events).is_some(), "{events:?}");
    }
}
