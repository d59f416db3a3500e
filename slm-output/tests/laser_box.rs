//! The laser box over a pseudo-terminal: the host's client at one end, the reference firmware at the other.

use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use holod_calibration::rig::{LaserDriver, Lasers, PanelMode, Rig};
use holod_calibration::{Colour, PerColour, Resolution, TimeNs, host_now};
use holod_laser_firmware::Line;
use holod_slm_output::PanelEncoder;
use holod_slm_output::laser::edge_log::{LOG_HEADER, read_log};
use holod_slm_output::laser::simulator::{Faults, SimulatedBox, SimulatedTerminal};
use holod_slm_output::laser::verify::verify_edges;
use holod_slm_output::laser::{
    BoxEvent, DarkReason, LaserBox, LaserEdge, LaserError, LaserProgram, LitWindow, Refusal, SerialBox, SerialOptions,
    make_dark, open_laser,
};
use holod_slm_output::output::{FieldEvent, Output, OutputOptions, pacing_config};
use holod_slm_output::pacing::Pacer;
use holod_slm_output::present::{PanelSetup, open_panel};
use holod_slm_output::schedule::FieldGate;
use proptest::prelude::*;

const MS: i64 = 1_000_000;

/// A clock that is not the host's.
const OTHER_CLOCK: [&str; 4] = ["--clock-offset-us", "987654321", "--clock-drift-ppm", "80"];

/// The simulated box as a process.
struct BoxProcess {
    process: Child,
    port: PathBuf,
    log: PathBuf,
    _folder: tempfile::TempDir,
}

impl BoxProcess {
    fn start(options: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("box.csv");
        let mut process = Command::new(env!("CARGO_BIN_EXE_holod-simulated-laser"))
            .arg(&log)
            .args(options)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut port = Vec::new();
        let output = process.stdout.as_mut().unwrap();
        let mut byte = [0];
        while output.read(&mut byte).unwrap() == 1 && byte != *b"\n" {
            port.push(byte[0]);
        }
        let port = PathBuf::from(String::from_utf8(port).unwrap());
        Self { process, port, log, _folder: folder }
    }

    /// A host that has armed it and closes its port without a last word, as a killed process does.
    fn armed_by_a_host_that_will_not_say_goodbye(&self) -> fs::File {
        let mut port = fs::OpenOptions::new().read(true).write(true).open(&self.port).unwrap();
        for command in [
            "SEQ RGB 30000 HOST",
            "FLD 0 1 1",
            "FLD 1 9 1",
            "FLD 2 99 1",
            "MAX 9 9 9",
            "POW 9 9 9",
            "TMO 500000",
            "ARM LIGHT",
        ] {
            port.write_all(Line::new(format_args!("1 {command}")).unwrap().as_bytes()).unwrap();
        }
        eventually("arming", || matches!(self.events().last(), Some(BoxEvent::Armed { .. })));
        port
    }

    /// Puts a fault into it.
    fn tell(&mut self, command: &str) {
        writeln!(self.process.stdin.as_mut().unwrap(), "{command}").unwrap();
    }

    fn open(&self, options: SerialOptions) -> SerialBox {
        SerialBox::open(&self.port, options, host_now).unwrap()
    }

    /// A host that has armed it.
    fn armed(&self, program: &LaserProgram) -> SerialBox {
        let mut host = self.open(SerialOptions::default());
        host.program(program, host_now()).unwrap();
        host.arm(host_now()).unwrap();
        host
    }

    fn events(&self) -> Vec<BoxEvent> {
        read_log(&fs::read_to_string(&self.log).unwrap()).unwrap()
    }

    /// Waits until the box's log ends with darkness, and reads it.
    fn dark_log(&self) -> Vec<BoxEvent> {
        let mut events = Vec::new();
        eventually("darkness", || {
            events = self.events();
            matches!(events.last(), Some(BoxEvent::Dark { .. }))
        });
        events
    }
}

impl Drop for BoxProcess {
    fn drop(&mut self) {
        // Its standard input ends, and so does it.
        drop(self.process.stdin.take());
        self.process.wait().unwrap();
    }
}

/// Waits until `holds`, for as long as a slow machine may need.
fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let t_end = host_now() + TimeNs(30_000 * MS);
    while !holds() {
        assert!(host_now() < t_end, "never came: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn edges(events: &[BoxEvent]) -> Vec<LaserEdge> {
    let edge = |event: &BoxEvent| match event {
        BoxEvent::Edge(edge) => Some(*edge),
        _ => None,
    };
    events.iter().filter_map(edge).collect()
}

fn program(rig: &Rig) -> LaserProgram {
    FieldGate::new(&rig.panel, &rig.lasers).unwrap().program(&rig.panel, &rig.lasers).unwrap()
}

fn rig(mode: PanelMode, port: &Path) -> Rig {
    let mut rig = Rig::default();
    rig.panel.mode = mode;
    rig.panel.refresh_hz = if mode == PanelMode::ChannelPacked { 60.0 } else { 100.0 };
    rig.lasers = Lasers { driver: LaserDriver::Serial { path: port.into(), sync_wire: false }, ..rig.lasers };
    rig
}

/// Runs the output until some dozen fields have been lit; hands back what is still running, and the fields so far.
fn run(rig: &Rig) -> (Output, Vec<FieldEvent>) {
    let size = Resolution { width: 4, height: 2 };
    let encoder = PanelEncoder::new(&rig.panel, size, size).unwrap();
    let panel = open_panel(&"headless".parse().unwrap(), &PanelSetup::new(&rig.panel, &encoder), host_now());
    let laser = open_laser(&rig.lasers, host_now).unwrap();
    let options = OutputOptions::default();
    let mut output = Output::start(rig, &encoder, panel.unwrap(), laser, options, host_now).unwrap();
    let mut pacer = Pacer::new(pacing_config(rig, TimeNs(2 * MS)).unwrap(), host_now());
    let mut fields: Vec<FieldEvent> = Vec::new();
    for _ in 0..1000 {
        while let Ok(event) = output.events.pop() {
            fields.push(event);
        }
        if fields.iter().filter(|field| field.laser_on.is_some()).count() >= 60 {
            break;
        }
        output.frames.feed(&mut pacer, |_| ());
        let plan = pacer.predict(host_now());
        std::thread::sleep(Duration::from_nanos((plan.t_wake - host_now()).0.max(0) as u64));
        encoder.encode(PerColour([&[1.0; 8]; 3]), output.frames.acquire());
        let now = host_now();
        output.frames.submit(&plan, None, now);
        pacer.submitted(plan.frame_id, now);
    }
    (output, fields)
}

/// Polls until the client says that the box is dark, and why; errors on the way are left out.
fn dark_reason(host: &mut dyn LaserBox) -> DarkReason {
    let mut dark = None;
    eventually("darkness at the host", || {
        let _on_the_way = host.poll(host_now(), &mut |event| {
            if let BoxEvent::Dark { reason, .. } = event {
                dark.get_or_insert(reason);
            }
        });
        std::thread::sleep(Duration::from_millis(1));
        dark.is_some()
    });
    dark.unwrap()
}

/// The host's trigger, and windows that leave time for a slow machine.
fn host_program() -> LaserProgram {
    LaserProgram { heartbeat_timeout: TimeNs(950 * MS), ..program(&rig(PanelMode::FieldSequential, Path::new("x"))) }
}

#[test]
fn a_whole_run_is_lit_by_a_box_with_another_clock_and_ends_dark_and_acknowledged() {
    for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential] {
        let laser = BoxProcess::start(&OTHER_CLOCK);
        let rig = rig(mode, &laser.port);
        let (output, mut fields) = run(&rig);
        let mut events = output.events;
        let report = output.control.shutdown();
        assert!(report.lasers_dark, "{report:?}");
        let log = laser.dark_log();
        assert!(matches!(log.last(), Some(BoxEvent::Dark { reason: DarkReason::Shutdown, .. })), "{:?}", log.last());
        while let Ok(event) = events.pop() {
            fields.push(event);
        }
        // The box's own log, not the client's model of it.
        let spans: Vec<_> = fields.iter().map(FieldEvent::span).collect();
        let verdict = verify_edges(&spans, &edges(&log));
        assert_eq!(verdict.unsafe_findings().count(), 0, "{verdict:?}");
        assert!(verdict.lit > 0, "{verdict:?}");
    }
}

#[test]
fn a_host_that_falls_silent_leaves_a_box_that_goes_dark_by_its_heartbeat_timeout() {
    let laser = BoxProcess::start(&OTHER_CLOCK);
    let program = LaserProgram { heartbeat_timeout: TimeNs(60 * MS), ..host_program() };
    let mut host = laser.armed(&program);
    host.heartbeat(host_now()).unwrap();
    // Lines are answered in order: with this answer the heartbeat has been heard.
    host.report().unwrap();
    let t_silent = host_now();
    // Neither a word nor a closed line: like a process that hangs.
    std::mem::forget(host);
    let log = laser.dark_log();
    let &BoxEvent::Dark { t, reason } = log.last().unwrap() else { panic!("{log:?}") };
    assert_eq!(reason, DarkReason::Heartbeat);
    assert!(t - t_silent <= program.heartbeat_timeout + TimeNs(2000), "its own time, however late it is looked at");
}

#[test]
fn a_line_that_hangs_up_makes_dark_at_once_where_it_can_be_seen() {
    for (options, reason) in [(&[][..], DarkReason::HangUp), (&["--no-hang-up"], DarkReason::Heartbeat)] {
        let laser = BoxProcess::start(options);
        drop(laser.armed_by_a_host_that_will_not_say_goodbye());
        let log = laser.dark_log();
        assert!(matches!(log.last(), Some(BoxEvent::Dark { reason: found, .. }) if *found == reason), "{log:?}");
    }
}

#[test]
fn faults_of_the_box_are_heard_of_by_their_own_names() {
    let cases = [
        ("interlock open", DarkReason::Interlock),
        ("corrupt received", DarkReason::Line),
        ("reset", DarkReason::BoxFault),
        ("freeze 400", DarkReason::Heartbeat),
    ];
    for (fault, reason) in cases {
        let mut laser = BoxProcess::start(&OTHER_CLOCK);
        let program = LaserProgram { heartbeat_timeout: TimeNs(200 * MS), ..host_program() };
        let mut host = laser.armed(&program);
        laser.tell(fault);
        let mut dark = None;
        eventually(fault, || {
            let now = host_now();
            let _refused_once_dark = host.heartbeat(now);
            let _on_the_way = host.poll(now, &mut |event| {
                if let BoxEvent::Dark { reason, .. } = event {
                    dark.get_or_insert(reason);
                }
            });
            std::thread::sleep(Duration::from_millis(5));
            dark.is_some() || (fault.starts_with("freeze") && !laser.events().is_empty())
        });
        if !fault.starts_with("freeze") {
            assert_eq!(dark, Some(reason), "{fault}");
        }
        // Whatever the host knows, the box is dark.
        assert!(laser.dark_log().len() >= 2);
    }
}

#[test]
fn a_box_that_goes_dark_by_itself_is_told_to_have_done_so_when_it_did() {
    let mut laser = BoxProcess::start(&OTHER_CLOCK);
    let mut host = laser.armed(&host_program());
    let mut told = Vec::new();
    let now = host_now();
    let window = LitWindow { colour: Colour::Green, t_on: now + TimeNs(5 * MS), t_off: now + TimeNs(90 * MS) };
    assert_eq!(host.light(window, now).unwrap(), None);
    std::thread::sleep(Duration::from_millis(30));
    host.poll(host_now(), &mut |event| told.push(event)).unwrap();
    laser.tell("interlock open");
    let log = laser.dark_log();
    std::thread::sleep(Duration::from_millis(60));
    host.poll(host_now(), &mut |event| told.push(event)).unwrap();
    let ends = |events: &[BoxEvent]| {
        let off = edges(events).last().filter(|edge| !edge.on).map(|edge| edge.t);
        let dark = events.iter().rev().find_map(|event| match event {
            BoxEvent::Dark { t, reason: DarkReason::Interlock } => Some(*t),
            _ => None,
        });
        [off.expect("a laser that was lit goes out"), dark.expect("the interlock makes dark")]
    };
    for (told, was) in ends(&told).into_iter().zip(ends(&log)) {
        // As well as the clocks are known.
        assert!((told - was).0.abs() < 5 * MS, "{told:?} {was:?}");
    }
}

#[test]
fn a_box_whose_interlock_is_open_is_not_armed() {
    let mut laser = BoxProcess::start(&[]);
    laser.tell("interlock open");
    let mut host = laser.open(SerialOptions::default());
    host.program(&host_program(), host_now()).unwrap();
    eventually("the interlock", || !host.report().unwrap().state.interlock_closed);
    let refused = host.arm(host_now()).unwrap_err();
    assert!(matches!(refused, LaserError::Refused { command: "ARM", refusal: Refusal::Interlock }), "{refused}");
    laser.tell("interlock closed");
    eventually("arming", || host.arm(host_now()).is_ok());
}

#[test]
fn a_second_host_finds_a_box_that_answers() {
    let laser = BoxProcess::start(&[]);
    fs::OpenOptions::new().write(true).open(&laser.port).unwrap().write_all(b"17 POW 1 2").unwrap();
    for _ in 0..2 {
        let mut host = laser.armed(&host_program());
        host.dark(DarkReason::Asked, host_now()).unwrap();
    }
}

#[test]
fn two_programs_do_not_drive_one_box_but_anybody_may_make_it_dark() {
    let laser = BoxProcess::start(&[]);
    let mut host = laser.armed(&LaserProgram { heartbeat_timeout: TimeNs(900 * MS), ..host_program() });
    let in_use = SerialBox::open(&laser.port, SerialOptions::default(), host_now).unwrap_err();
    assert!(matches!(&in_use, LaserError::InUse { path } if laser.port == Path::new(path)), "{in_use}");
    let in_use = SerialBox::inspect(&laser.port, host_now).unwrap_err();
    assert!(matches!(in_use, LaserError::InUse { .. }), "{in_use}");

    // The host's listener goes on reading beside it, as that of a program does whose other threads hang.
    let driver = LaserDriver::Serial { path: laser.port.clone(), sync_wire: false };
    make_dark(&driver, host_now).unwrap();
    let log = laser.dark_log();
    assert!(matches!(log.last(), Some(BoxEvent::Dark { reason: DarkReason::ByHand, .. })), "{log:?}");
    let mut dark = None;
    eventually("the host to notice", || {
        let _refused_once_dark = host.heartbeat(host_now());
        // It may have missed an answer that the other program took.
        let _missed = host.poll(host_now(), &mut |event| {
            if let BoxEvent::Dark { reason, .. } = event {
                dark = Some(reason);
            }
        });
        std::thread::sleep(Duration::from_millis(5));
        dark.is_some()
    });
    assert_eq!(dark, Some(DarkReason::ByHand));
    assert!(matches!(host.arm(host_now()), Err(LaserError::MadeDark)), "nobody arms it against that");
    drop(host);

    let report = SerialBox::inspect(&laser.port, host_now).unwrap();
    assert!(!report.state.armed && report.name == "simulated" && report.state.interlock_closed, "{report:?}");
    assert!(report.clock_error_ns < 100 * MS);
}

#[test]
fn windows_are_inside_what_was_asked_for_whatever_the_clocks_and_dark_where_nothing_is_left() {
    let laser = BoxProcess::start(&OTHER_CLOCK);
    let mut host = laser.armed(&host_program());
    let mut asked = Vec::new();
    for colour in Colour::ALL {
        let now = host_now();
        host.heartbeat(now).unwrap();
        let window = LitWindow { colour, t_on: now + TimeNs(30 * MS), t_off: now + TimeNs(70 * MS) };
        host.light(window, now).unwrap();
        asked.push(window);
        // Too narrow for what is known of the clocks: nobody knows them to 2 µs here.
        host.light(LitWindow { t_on: now + TimeNs(80 * MS), t_off: now + TimeNs(80 * MS + 2000), ..window }, now)
            .unwrap();
        std::thread::sleep(Duration::from_millis(100));
        host.poll(host_now(), &mut |_| ()).unwrap();
    }
    host.dark(DarkReason::Asked, host_now()).unwrap();
    let found = edges(&laser.dark_log());
    assert_eq!(found.len(), 6, "{found:?}");
    for (pair, window) in found.chunks(2).zip(asked) {
        assert_eq!((pair[0].colour, pair[0].on, pair[1].on), (window.colour, true, false));
        assert!(pair[0].t >= window.t_on && pair[1].t <= window.t_off, "{pair:?} {window:?}");
    }
}

#[test]
fn a_box_on_the_panels_wire_lights_after_its_edges_and_a_wire_that_disagrees_makes_dark() {
    let mut laser = BoxProcess::start(&OTHER_CLOCK);
    let rig = rig(PanelMode::ChannelPacked, &laser.port);
    let program = LaserProgram { heartbeat_timeout: TimeNs(950 * MS), ..program(&rig) };
    let without = SerialOptions::default();
    let mut host = laser.open(SerialOptions { sync_wire: true, ..without });
    host.program(&program, host_now()).unwrap();
    laser.tell("sync 60");
    eventually("an edge", || host.report().unwrap().state.sync.count > 2);
    // What this host believes of the panel: frames at the same rate, in a phase of their own.
    let t_first = host_now();
    let frame = |index: i64| TimeNs(t_first.0 + index * program.frame_period.0);
    host.arm(host_now()).unwrap();
    let mut dark = None;
    let run = |host: &mut SerialBox, until: &dyn Fn(i64) -> bool, dark: &mut Option<DarkReason>| {
        for index in 0.. {
            if dark.is_some() || until(index) {
                return;
            }
            let now = host_now();
            let known = (now.0 - t_first.0) / program.frame_period.0;
            let _once_dark = host.heartbeat(now);
            let _once_dark = host.sync(frame(known), now);
            let mut late = false;
            // A box on a busy machine may be slow to answer.
            let _slow = host.poll(now, &mut |event| {
                // A busy machine may tell the host's own model of a frame too late.
                match event {
                    BoxEvent::Dark { reason: DarkReason::SyncLost, .. } => late = true,
                    BoxEvent::Dark { reason, .. } => *dark = Some(reason),
                    _ => {}
                }
            });
            if late {
                let _once_dark = host.arm(now);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    run(&mut host, &|index| index == 60, &mut dark);
    assert_eq!(dark, None, "{:?}", laser.events().last());
    assert!(edges(&laser.events()).len() > 20);
    // Another panel on the wire: 2 ms a frame slower.
    laser.tell("sync 53");
    run(&mut host, &|index| index == 6000, &mut dark);
    assert!(matches!(dark, Some(DarkReason::SyncDisagrees | DarkReason::SyncRate)), "{dark:?}");
    let log = laser.dark_log();
    drop(host);

    let mut host = laser.open(SerialOptions { sync_wire: true, ..without });
    host.program(&program, host_now()).unwrap();
    laser.tell("sync 0");
    host.arm(host_now()).unwrap();
    assert_eq!(dark_reason(&mut host), DarkReason::SyncLost);
    assert!(laser.dark_log().len() > log.len());
}

/// The panel's reports end, and its wire goes on.
#[test]
fn a_box_on_the_panels_wire_is_told_to_go_dark_where_the_panels_reports_end() {
    let mut laser = BoxProcess::start(&[]);
    let rig = rig(PanelMode::ChannelPacked, &laser.port);
    let program = LaserProgram { heartbeat_timeout: TimeNs(950 * MS), ..program(&rig) };
    let mut host = laser.open(SerialOptions { sync_wire: true, ..SerialOptions::default() });
    host.program(&program, host_now()).unwrap();
    laser.tell("sync 60");
    eventually("an edge", || host.report().unwrap().state.sync.count > 2);
    host.arm(host_now()).unwrap();
    // On a busy machine the host's own model may have missed the frames already.
    let _once_dark = host.heartbeat(host_now());
    let _once_dark = host.sync(host_now(), host_now());
    assert_eq!(dark_reason(&mut host), DarkReason::SyncLost, "two refreshes without a report");
    let log = laser.dark_log();
    assert!(matches!(log.last(), Some(BoxEvent::Dark { reason: DarkReason::SyncLost, .. })), "{log:?}");
}

/// A box that says of itself what `lie` makes of it.
fn lying_box(stream: UnixStream, lie: fn(&str) -> String) {
    struct Liar(UnixStream, fn(&str) -> String);
    impl Write for Liar {
        fn write(&mut self, line: &[u8]) -> std::io::Result<usize> {
            let text = String::from_utf8_lossy(line).into_owned();
            let text = self.1(text.split('*').next().unwrap());
            self.0.write_all(Line::new(text).unwrap().as_bytes())?;
            Ok(line.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    stream.set_nonblocking(true).unwrap();
    let liar = Liar(stream.try_clone().unwrap(), lie);
    SimulatedBox::new(host_now()).serve(stream, liar, std::io::sink(), &Faults::default(), host_now).unwrap();
}

/// The host's end of a line to it.
fn line_to(far: impl FnOnce(UnixStream) + Send + 'static) -> (UnixStream, UnixStream, std::thread::JoinHandle<()>) {
    let (host, other) = UnixStream::pair().unwrap();
    host.set_nonblocking(true).unwrap();
    (host.try_clone().unwrap(), host, std::thread::spawn(move || far(other)))
}

fn identify(reader: UnixStream, writer: UnixStream, name: &str) -> Result<SerialBox, LaserError> {
    SerialBox::identify(reader, writer, name, SerialOptions::default(), host_now)
}

#[test]
fn real_lasers_stay_dark_over_a_virtual_panel() {
    let (reader, writer, served) = line_to(|far| lying_box(far, |text| text.replace(" simulated", " bench-4")));
    let laser = identify(reader, writer, "bench").unwrap();
    assert!(!laser.capability().simulated);
    let rig = Rig::default();
    let size = Resolution { width: 4, height: 2 };
    let encoder = PanelEncoder::new(&rig.panel, size, size).unwrap();
    let setup = PanelSetup::new(&rig.panel, &encoder);
    let panel = open_panel(&"headless".parse().unwrap(), &setup, host_now()).unwrap();
    let options = OutputOptions::default();
    let mut output = Output::start(&rig, &encoder, panel, Box::new(laser), options, host_now).unwrap();
    let plan = Pacer::new(pacing_config(&rig, TimeNs(MS)).unwrap(), host_now()).predict(host_now());
    output.frames.submit(&plan, None, host_now());
    let mut dark = 0;
    eventually("twenty dark fields", || {
        while let Ok(field) = output.events.pop() {
            assert_eq!((field.laser_on, field.dark), (None, Some(DarkReason::Untrusted)));
            dark += 1;
        }
        dark >= 20
    });
    output.control.shutdown();
    assert!(output.box_events.pop().is_err(), "never armed");
    served.join().unwrap();
}

#[test]
fn a_box_of_another_version_is_refused_and_both_versions_named() {
    let (reader, writer, served) =
        line_to(|far| lying_box(far, |text| text.replace("holod-laser-box 3", "holod-laser-box 2")));
    let other = identify(reader, writer, "/dev/ttyACM0").unwrap_err();
    assert!(matches!(&other, LaserError::Version { found: 2, expected: 3, .. }), "{other}");
    let text = other.to_string();
    assert!(text.contains("/dev/ttyACM0") && text.contains("version 2") && text.contains("version 3"), "{text}");
    served.join().unwrap();
}

#[test]
fn a_port_that_is_no_laser_box_is_refused_by_name() {
    let nothing = SerialBox::open(Path::new("/dev/no-such-port"), SerialOptions::default(), host_now).unwrap_err();
    assert!(matches!(&nothing, LaserError::Open { path, .. } if path == "/dev/no-such-port"), "{nothing}");
    let (reader, writer, tracker) = line_to(|mut far| {
        far.write_all(b"P1,1,1000,L,3.1,0.9*00\n").unwrap();
        let mut heard = Vec::new();
        far.read_to_end(&mut heard).unwrap();
        assert_eq!(heard[0], b'\n');
        assert!(heard[1..].starts_with(b"1 ID?*"), "nothing but a question: {:?}", String::from_utf8_lossy(&heard));
        assert_eq!(heard.iter().filter(|&&byte| byte == b'\n').count(), 3, "and a DISARM at the end");
    });
    let wrong = identify(reader, writer, "/dev/ttyUSB0").unwrap_err();
    assert!(
        matches!(&wrong, LaserError::NotABox { path, found, .. } if path == "/dev/ttyUSB0" && found.starts_with("P1"))
    );
    tracker.join().unwrap();
}

#[test]
fn powers_beyond_the_rigs_limit_or_the_boxs_own_never_reach_it() {
    let laser = BoxProcess::start(&[]);
    let power_limit_uw = PerColour([1000, 500, 1000]);
    let mut host = laser.open(SerialOptions { power_limit_uw, ..SerialOptions::default() });
    let strong = LaserProgram { power_uw: PerColour([1000, 501, 1]), ..host_program() };
    let refused = host.program(&strong, host_now()).unwrap_err();
    assert!(matches!(refused, LaserError::Figure { what: "power_mw", .. }), "{refused}");
    host.program(&LaserProgram { power_uw: power_limit_uw, ..strong }, host_now()).unwrap();
    drop(host);
    let mut host = laser.open(SerialOptions::default());
    let stronger = LaserProgram { power_uw: PerColour([1, 1, 600_000]), ..host_program() };
    let refused = host.program(&stronger, host_now()).unwrap_err();
    assert_eq!(
        refused.to_string(),
        "the laser box takes 500 mW of blue power at most; the rig asks for 600: correct the rig file"
    );
    host.program(&LaserProgram { power_uw: PerColour([1, 1, 500_000]), ..host_program() }, host_now()).unwrap();
}

#[test]
fn a_box_that_was_unplugged_is_found_again_under_the_same_name() {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("lasers");
    let plug_in = |laser: &BoxProcess| {
        let _the_old_one = fs::remove_file(&link);
        std::os::unix::fs::symlink(&laser.port, &link).unwrap();
    };
    let first = BoxProcess::start(&OTHER_CLOCK);
    plug_in(&first);
    let rig = rig(PanelMode::FieldSequential, &link);
    let mut laser = open_laser(&rig.lasers, host_now).unwrap();
    let watch = laser.watch().unwrap();
    laser.program(&host_program(), host_now()).unwrap();
    laser.arm(host_now()).unwrap();
    assert_eq!(watch.trouble(), None);

    // First its name: that of its terminal may be another test's at once.
    fs::remove_file(&link).unwrap();
    drop(first);
    let t_pulled = host_now();
    assert_eq!(dark_reason(laser.as_mut()), DarkReason::BoxFault);
    assert!(host_now() - t_pulled < TimeNs(10_000 * MS));
    eventually("its name", || watch.trouble().is_some_and(|trouble| trouble.contains("lasers.device")));
    // Nobody waits for it meanwhile.
    let t_asked = host_now();
    for _ in 0..100 {
        assert!(matches!(laser.arm(host_now()), Err(LaserError::Lost)));
        assert!(matches!(laser.dark(DarkReason::Shutdown, host_now()), Err(LaserError::Lost)), "no acknowledgement");
        laser.poll(host_now(), &mut |event| panic!("{event:?}")).unwrap();
    }
    // Waiting for an answer would take ten seconds and more.
    assert!(host_now() - t_asked < TimeNs(5000 * MS));

    let second = BoxProcess::start(&["--clock-offset-us", "5"]);
    plug_in(&second);
    eventually("the box", || {
        laser.poll(host_now(), &mut |event| panic!("{event:?}")).unwrap();
        laser.arm(host_now()).is_ok()
    });
    assert_eq!(watch.trouble(), None);
    eventually("its own log", || matches!(second.events().last(), Some(BoxEvent::Armed { .. })));
    let now = host_now();
    laser
        .light(LitWindow { colour: Colour::Red, t_on: now + TimeNs(20 * MS), t_off: now + TimeNs(60 * MS) }, now)
        .unwrap();
    eventually("light", || edges(&second.events()).len() == 2);
    laser.dark(DarkReason::Shutdown, host_now()).unwrap();
}

/// Somebody makes dark what is dark, as while the panel is lost; the box is looked for again meanwhile or not.
#[test]
fn a_box_that_is_made_dark_in_the_dark_is_lit_again_only_by_a_host_that_begins() {
    for reopened in [false, true] {
        let laser = BoxProcess::start(&[]);
        let mut host = laser.open(SerialOptions::default());
        host.program(&host_program(), host_now()).unwrap();
        let driver = LaserDriver::Serial { path: laser.port.clone(), sync_wire: false };
        make_dark(&driver, host_now).unwrap();
        if reopened {
            drop(host);
            host = laser.open(SerialOptions::default());
            host.dark(DarkReason::Asked, host_now()).unwrap();
            host.program(&host_program(), host_now()).unwrap();
        } else {
            // Whatever answer the other program took, the box is asked again.
            eventually("the host to be told", || {
                let _missed = host.poll(host_now(), &mut |_| ());
                std::thread::sleep(Duration::from_millis(5));
                host.is_made_dark()
            });
        }
        assert!(matches!(host.arm(host_now()), Err(LaserError::MadeDark)));
        assert_eq!(laser.events(), []);
        host.dark(DarkReason::Boot, host_now()).unwrap();
        host.arm(host_now()).unwrap();
    }
}

#[test]
fn a_box_that_was_made_dark_stays_dark_when_it_is_plugged_in_anew_or_resets_itself() {
    for reset in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("lasers");
        let mut first = BoxProcess::start(&[]);
        std::os::unix::fs::symlink(&first.port, &link).unwrap();
        let rig = rig(PanelMode::FieldSequential, &link);
        let mut laser = open_laser(&rig.lasers, host_now).unwrap();
        let watch = laser.watch().unwrap();
        laser.program(&host_program(), host_now()).unwrap();
        laser.arm(host_now()).unwrap();
        make_dark(&rig.lasers.driver, host_now).unwrap();
        // As for each field that is shown.
        eventually("the host to notice", || {
            let _refused_once_dark = laser.heartbeat(host_now());
            let _missed = laser.poll(host_now(), &mut |_| ());
            std::thread::sleep(Duration::from_millis(5));
            matches!(laser.arm(host_now()), Err(LaserError::MadeDark))
        });

        let second = BoxProcess::start(&[]);
        if reset {
            first.tell("reset");
        } else {
            fs::remove_file(&link).unwrap();
            std::os::unix::fs::symlink(&second.port, &link).unwrap();
            drop(first);
        }
        eventually("its loss", || matches!(laser.poll(host_now(), &mut |_| ()), Err(LaserError::Lost)));
        eventually("the box", || watch.trouble().is_none());
        for _ in 0..20 {
            laser.poll(host_now(), &mut |_| ()).unwrap();
            let refused = laser.arm(host_now());
            assert!(matches!(refused, Err(LaserError::MadeDark)), "reset: {reset}: {refused:?}");
        }
    }
}

#[test]
fn real_lasers_do_not_take_the_place_of_a_simulated_box() {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("lasers");
    let first = BoxProcess::start(&[]);
    std::os::unix::fs::symlink(&first.port, &link).unwrap();
    let rig = rig(PanelMode::FieldSequential, &link);
    let mut laser = open_laser(&rig.lasers, host_now).unwrap();
    laser.program(&host_program(), host_now()).unwrap();
    fs::remove_file(&link).unwrap();
    drop(first);
    let real = BoxProcess::start(&["--name", "bench-4"]);
    std::os::unix::fs::symlink(&real.port, &link).unwrap();
    let watch = laser.watch().unwrap();
    eventually("refusal", || {
        let _lost = laser.poll(host_now(), &mut |_| ());
        watch.trouble().is_some_and(|trouble| trouble.contains("another kind"))
    });
    assert!(laser.arm(host_now()).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// The firmware behind its terminal hears anything: it lights nothing, never ends, and answers the next host.
    #[test]
    fn random_bytes_on_the_terminal_light_nothing(
        chunks in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..300), 1..12),
        armed in prop::bool::ANY,
    ) {
        let laser = BoxProcess::start(&[]);
        if armed {
            drop(laser.armed_by_a_host_that_will_not_say_goodbye());
        }
        let mut port = fs::OpenOptions::new().write(true).open(&laser.port).unwrap();
        for chunk in &chunks {
            port.write_all(chunk).unwrap();
        }
        drop(port);
        let mut host = laser.open(SerialOptions::default());
        prop_assert!(!host.report().unwrap().state.armed);
        prop_assert_eq!(edges(&laser.events()), vec![]);
        host.program(&host_program(), host_now()).unwrap();
        host.arm(host_now()).unwrap();
    }
}

/// What a bad wire does with what is written to it.
const SOUND: u8 = 0;
const DAMAGES: u8 = 1;
const SWALLOWS: u8 = 2;
/// Until something is sent while it is sound again.
const HOLDS_UP: u8 = 3;

/// A wire that can go bad, and what it holds up.
struct BadWire(UnixStream, Arc<AtomicU8>, Vec<u8>);

impl Write for BadWire {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let mut sent = [self.2.as_slice(), bytes].concat();
        self.2.clear();
        match self.1.load(Ordering::Relaxed) {
            SWALLOWS => sent.clear(),
            DAMAGES => sent[0] ^= 4,
            HOLDS_UP => std::mem::swap(&mut sent, &mut self.2),
            _ => {}
        }
        self.0.write_all(&sent).map(|()| bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

/// A host on a wire that can go bad, and the log of the box behind it.
fn host_on_a_bad_wire() -> (SerialBox, Arc<AtomicU8>, std::thread::JoinHandle<Vec<u8>>) {
    let (host, far) = UnixStream::pair().unwrap();
    host.set_nonblocking(true).unwrap();
    far.set_nonblocking(true).unwrap();
    let serve = move || {
        let mut log = Vec::new();
        let simulated = SimulatedBox::new(host_now());
        simulated.serve(&far, &far, &mut log, &Faults::default(), host_now).unwrap();
        log
    };
    let served = std::thread::spawn(serve);
    let state = Arc::new(AtomicU8::new(SOUND));
    let wire = BadWire(host.try_clone().unwrap(), Arc::clone(&state), Vec::new());
    let host = SerialBox::identify(host, wire, "wire", SerialOptions::default(), host_now).unwrap();
    (host, state, served)
}

#[test]
fn a_damaged_line_makes_the_box_dark_and_the_host_hears_of_it() {
    let (mut host, wire, served) = host_on_a_bad_wire();
    host.program(&host_program(), host_now()).unwrap();
    host.arm(host_now()).unwrap();
    wire.store(DAMAGES, Ordering::Relaxed);
    host.heartbeat(host_now()).unwrap();
    wire.store(SOUND, Ordering::Relaxed);
    // The unanswered heartbeat may become an error first; the box's own word comes all the same.
    assert_eq!(dark_reason(&mut host), DarkReason::Line);
    drop(host);
    let log = String::from_utf8(served.join().unwrap()).unwrap();
    assert!(log.starts_with(LOG_HEADER) && log.contains("dark,,line"), "{log}");
}

#[test]
fn a_box_that_does_not_answer_is_an_error_and_never_an_acknowledgement() {
    let (mut host, wire, served) = host_on_a_bad_wire();
    host.program(&host_program(), host_now()).unwrap();
    wire.store(SWALLOWS, Ordering::Relaxed);
    let unheard = host.dark(DarkReason::Shutdown, host_now()).unwrap_err();
    assert!(matches!(unheard, LaserError::NoAnswer { command: "DISARM", .. }), "{unheard}");
    let unheard = host.arm(host_now()).unwrap_err();
    assert!(matches!(unheard, LaserError::NoAnswer { command: "ARM", .. }), "{unheard}");
    drop(host);
    served.join().unwrap();
}

#[test]
fn a_window_of_which_the_box_hears_late_is_told_as_the_box_lit_it() {
    let (mut host, wire, served) = host_on_a_bad_wire();
    host.program(&host_program(), host_now()).unwrap();
    host.arm(host_now()).unwrap();
    let mut told = Vec::new();
    let mut missed = Vec::new();
    let mut asked = Vec::new();
    for (colour, after_ms) in [(Colour::Red, 20), (Colour::Green, 140)] {
        let now = host_now();
        let window = LitWindow { colour, t_on: now + TimeNs(5 * MS), t_off: now + TimeNs(after_ms * MS) };
        wire.store(HOLDS_UP, Ordering::Relaxed);
        assert_eq!(host.light(window, now).unwrap(), None);
        asked.push(window);
        std::thread::sleep(Duration::from_millis(50));
        host.poll(host_now(), &mut |event| told.push(event)).unwrap();
        assert_eq!(edges(&told), [], "nobody knows yet");
        assert!(host.known_until(host_now()) <= window.t_on, "and that is said");
        wire.store(SOUND, Ordering::Relaxed);
        host.heartbeat(host_now()).unwrap();
        eventually("what was missed", || {
            host.poll(host_now(), &mut |event| told.push(event)).unwrap();
            missed.extend(host.next_missed());
            std::thread::sleep(Duration::from_millis(1));
            missed.len() == asked.len()
        });
    }
    std::thread::sleep(Duration::from_millis(300));
    host.dark(DarkReason::Asked, host_now()).unwrap();
    host.poll(host_now(), &mut |event| told.push(event)).unwrap();
    drop(host);
    let log = read_log(&String::from_utf8(served.join().unwrap()).unwrap()).unwrap();
    let (told, lit) = (edges(&told), edges(&log));
    assert!(missed[0].is_whole() && !missed[1].is_whole(), "{missed:?}");
    assert!(missed[1].time > TimeNs(40 * MS), "{missed:?}");
    assert_eq!(told.len(), 2, "the first window stayed dark: {told:?}");
    for (told, lit) in told.iter().zip(&lit) {
        assert_eq!((told.colour, told.on), (Colour::Green, lit.on));
        // As well as the clocks are known.
        assert!((told.t - lit.t).0.abs() < 5 * MS, "{told:?} {lit:?}");
    }
}

#[test]
fn a_terminal_with_nobody_at_it_is_quiet() {
    let terminal = SimulatedTerminal::open().unwrap();
    let mut port = fs::OpenOptions::new().read(true).write(true).open(terminal.path()).unwrap();
    rustix::fs::fcntl_setfl(&port, rustix::fs::OFlags::NONBLOCK).unwrap();
    let mut bytes = [0; 8];
    assert_eq!(port.read(&mut bytes).unwrap_err().kind(), ErrorKind::WouldBlock);
}
