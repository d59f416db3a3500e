//! The laser box over a pseudo-terminal: the real serial client at one end, the simulated box at the other.

use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use holod_calibration::rig::{LaserDriver, Lasers, PanelMode, Rig};
use holod_calibration::{PerColour, Resolution, TimeNs};
use holod_slm_output::laser::gate::Gate;
use holod_slm_output::laser::protocol::Line;
use holod_slm_output::laser::simulated_box::{LOG_HEADER, SimulatedBox, SimulatedTerminal, read_log};
use holod_slm_output::laser::verify::verify_edges;
use holod_slm_output::laser::{BoxEvent, DarkReason, LaserBox, LaserEdge, LaserError, LaserProgram, SerialBox};
use holod_slm_output::output::{FieldEvent, Output, OutputOptions, monotonic_now, pacing_config};
use holod_slm_output::pacing::{Pacer, Point};
use holod_slm_output::present::{HeadlessPanel, PanelTiming};
use holod_slm_output::{FrameLayout, LevelsFrame, PanelEncoder};

const MS: i64 = 1_000_000;

/// The simulated box as a process.
struct BoxProcess {
    process: Child,
    port: PathBuf,
    log: PathBuf,
    _folder: tempfile::TempDir,
}

impl BoxProcess {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("box.csv");
        let mut process = Command::new(env!("CARGO_BIN_EXE_holod-simulated-laser"))
            .arg(&log)
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

    /// Waits until the box's log ends with darkness, and reads it.
    fn dark_log(&self) -> Vec<BoxEvent> {
        let mut events = Vec::new();
        eventually("darkness", || {
            events = read_log(&fs::read_to_string(&self.log).unwrap()).unwrap();
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
    let t_end = monotonic_now() + TimeNs(30_000 * MS);
    while !holds() {
        assert!(monotonic_now() < t_end, "never came: {what}");
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
    Gate::new(&rig.panel, &rig.lasers).unwrap().program(&rig.panel, &rig.lasers).unwrap()
}

fn rig(mode: PanelMode, port: &Path) -> Rig {
    let mut rig = Rig::default();
    rig.panel.mode = mode;
    rig.panel.refresh_hz = if mode == PanelMode::ChannelPacked { 60.0 } else { 100.0 };
    rig.lasers = Lasers { driver: LaserDriver::Serial { path: port.into() }, ..rig.lasers };
    rig
}

/// Runs the output until some dozen fields have been lit; hands back what is still running, and the fields so far.
fn run(rig: &Rig) -> (Output, Vec<FieldEvent>) {
    let size = Resolution { width: 4, height: 2 };
    let encoder = PanelEncoder::new(&rig.panel, size, size).unwrap();
    let mut output = Output::headless(rig, &encoder, OutputOptions::default(), monotonic_now).unwrap();
    let mut pacer = Pacer::new(pacing_config(rig, TimeNs(2 * MS)).unwrap(), monotonic_now());
    let mut fields: Vec<FieldEvent> = Vec::new();
    for _ in 0..1000 {
        while let Ok(event) = output.events.pop() {
            fields.push(event);
        }
        if fields.iter().filter(|field| field.laser_on.is_some()).count() >= 60 {
            break;
        }
        output.frames.feed(&mut pacer, |_| ());
        let plan = pacer.predict(monotonic_now());
        std::thread::sleep(Duration::from_nanos((plan.t_wake - monotonic_now()).0.max(0) as u64));
        encoder.encode(PerColour([&[1.0; 8]; 3]), output.frames.acquire());
        let now = monotonic_now();
        output.frames.submit(&plan, None, now);
        pacer.mark(Point::Submit, plan.frame_id, now);
    }
    (output, fields)
}

#[test]
fn a_whole_run_is_lit_by_the_box_and_ends_dark_and_acknowledged() {
    for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential] {
        let laser = BoxProcess::start();
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
    let laser = BoxProcess::start();
    let mut rig = rig(PanelMode::FieldSequential, &laser.port);
    rig.lasers.heartbeat_timeout = TimeNs(60 * MS);
    let mut host = SerialBox::open(&laser.port, monotonic_now).unwrap();
    host.program(&program(&rig), monotonic_now()).unwrap();
    host.arm(monotonic_now()).unwrap();
    host.heartbeat(monotonic_now()).unwrap();
    // Lines are answered in order: with this answer the heartbeat has been heard.
    host.arm(monotonic_now()).unwrap();
    let t_silent = monotonic_now();
    // Neither a word nor a closed line: like a killed process whose port somebody else holds.
    std::mem::forget(host);
    let log = laser.dark_log();
    let &BoxEvent::Dark { t, reason } = log.last().unwrap() else { panic!("{log:?}") };
    assert_eq!(reason, DarkReason::Heartbeat);
    assert!(t - t_silent <= rig.lasers.heartbeat_timeout, "its own time, however late it is looked at");
}

#[test]
fn a_second_host_finds_a_box_that_answers() {
    let laser = BoxProcess::start();
    let rig = rig(PanelMode::ChannelPacked, &laser.port);
    fs::OpenOptions::new().write(true).open(&laser.port).unwrap().write_all(b"17 POW 1 2").unwrap();
    for _ in 0..2 {
        let mut host = SerialBox::open(&laser.port, monotonic_now).unwrap();
        host.program(&program(&rig), monotonic_now()).unwrap();
        host.arm(monotonic_now()).unwrap();
        host.dark(DarkReason::Asked, monotonic_now()).unwrap();
    }
}

/// A box that gives itself out for one with lasers.
fn real_box(stream: UnixStream) {
    let mut simulated = SimulatedBox::new(monotonic_now());
    let mut bytes = [0; 256];
    while let Ok(count @ 1..) = (&stream).read(&mut bytes) {
        simulated.receive(&bytes[..count], monotonic_now(), |line| {
            let text = String::from_utf8_lossy(line.as_bytes()).into_owned();
            let text = text.split('*').next().unwrap().replace(" simulated", " bench-4");
            let _gone = (&stream).write_all(Line::new(format_args!("{text}")).as_bytes());
        });
    }
}

#[test]
fn real_lasers_stay_dark_over_a_virtual_panel() {
    let (host, far) = UnixStream::pair().unwrap();
    host.set_nonblocking(true).unwrap();
    let served = std::thread::spawn(move || real_box(far));
    let laser = SerialBox::identify(host, "bench", monotonic_now).unwrap();
    assert!(!laser.is_simulated());
    let rig = Rig::default();
    let size = Resolution { width: 4, height: 2 };
    let encoder = PanelEncoder::new(&rig.panel, size, size).unwrap();
    let timing = PanelTiming::new(&rig.panel);
    let flat = LevelsFrame::new(FrameLayout::new(&rig.panel, size));
    let panel = HeadlessPanel::new(timing, flat, monotonic_now(), 0);
    let options = OutputOptions::default();
    let mut output = Output::start(&rig, &encoder, Box::new(panel), Box::new(laser), options, monotonic_now).unwrap();
    let plan = Pacer::new(pacing_config(&rig, TimeNs(MS)).unwrap(), monotonic_now()).predict(monotonic_now());
    output.frames.submit(&plan, None, monotonic_now());
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
fn a_port_that_is_no_laser_box_is_refused_by_name() {
    let nothing = SerialBox::open(Path::new("/dev/no-such-port"), monotonic_now).unwrap_err();
    assert!(matches!(&nothing, LaserError::Open { path, .. } if path == "/dev/no-such-port"), "{nothing}");
    let (host, mut tracker) = UnixStream::pair().unwrap();
    host.set_nonblocking(true).unwrap();
    tracker.write_all(b"P1,1,1000,L,3.1,0.9*00\n").unwrap();
    let wrong = SerialBox::identify(host, "/dev/ttyUSB0", monotonic_now).unwrap_err();
    assert!(
        matches!(&wrong, LaserError::NotABox { path, found, .. } if path == "/dev/ttyUSB0" && found.starts_with("P1"))
    );
}

/// What a bad wire does with what is written to it.
const SOUND: u8 = 0;
const DAMAGES: u8 = 1;
const SWALLOWS: u8 = 2;

/// A wire that can go bad.
struct BadWire<'a>(UnixStream, &'a AtomicU8);

impl Read for BadWire<'_> {
    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        self.0.read(bytes)
    }
}

impl Write for BadWire<'_> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let mut sent = bytes.to_vec();
        match self.1.load(Ordering::Relaxed) {
            SWALLOWS => sent.clear(),
            DAMAGES => sent[0] ^= 4,
            _ => {}
        }
        self.0.write_all(&sent).map(|()| bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

fn box_on_a_bad_wire() -> (UnixStream, std::thread::JoinHandle<Vec<u8>>) {
    let (host, far) = UnixStream::pair().unwrap();
    host.set_nonblocking(true).unwrap();
    far.set_nonblocking(true).unwrap();
    let serve = move || {
        let mut log = Vec::new();
        holod_slm_output::laser::simulated_box::serve(&far, &far, &mut log, monotonic_now).unwrap();
        log
    };
    (host, std::thread::spawn(serve))
}

#[test]
fn a_damaged_line_makes_the_box_dark_and_the_host_hears_of_it() {
    let (stream, served) = box_on_a_bad_wire();
    let wire = AtomicU8::new(SOUND);
    let rig = Rig::default();
    let mut host = SerialBox::identify(BadWire(stream, &wire), "wire", monotonic_now).unwrap();
    host.program(&program(&rig), monotonic_now()).unwrap();
    host.arm(monotonic_now()).unwrap();
    wire.store(DAMAGES, Ordering::Relaxed);
    host.heartbeat(monotonic_now()).unwrap();
    wire.store(SOUND, Ordering::Relaxed);
    let mut dark = None;
    eventually("the box's word", || {
        // The unanswered heartbeat may become an error first; the box's own word comes all the same.
        let _unanswered = host.poll(monotonic_now(), &mut |event| {
            if let BoxEvent::Dark { reason, .. } = event {
                dark = Some(reason);
            }
        });
        dark.is_some()
    });
    assert!(matches!(dark, Some(DarkReason::BoxFault | DarkReason::SyncLost)), "{dark:?}");
    drop(host);
    let log = String::from_utf8(served.join().unwrap()).unwrap();
    assert!(log.starts_with(LOG_HEADER));
    assert!(log.contains("box-fault") || log.contains("sync-lost"), "{log}");
}

#[test]
fn a_box_that_does_not_answer_is_an_error_and_never_an_acknowledgement() {
    let (stream, served) = box_on_a_bad_wire();
    let wire = AtomicU8::new(SOUND);
    let mut host = SerialBox::identify(BadWire(stream, &wire), "wire", monotonic_now).unwrap();
    host.program(&program(&Rig::default()), monotonic_now()).unwrap();
    wire.store(SWALLOWS, Ordering::Relaxed);
    let unheard = host.dark(DarkReason::Shutdown, monotonic_now()).unwrap_err();
    assert!(matches!(unheard, LaserError::NoAnswer { command: "DISARM", .. }), "{unheard}");
    let unheard = host.arm(monotonic_now()).unwrap_err();
    assert!(matches!(unheard, LaserError::NoAnswer { command: "ARM", .. }), "{unheard}");
    drop(host);
    served.join().unwrap();
}

#[test]
fn a_terminal_with_nobody_at_it_is_quiet() {
    let terminal = SimulatedTerminal::open().unwrap();
    let mut port = fs::OpenOptions::new().read(true).write(true).open(terminal.path()).unwrap();
    rustix::fs::fcntl_setfl(&port, rustix::fs::OFlags::NONBLOCK).unwrap();
    let mut bytes = [0; 8];
    assert_eq!(port.read(&mut bytes).unwrap_err().kind(), ErrorKind::WouldBlock);
}
