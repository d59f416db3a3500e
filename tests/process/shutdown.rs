//! However the daemon ends, the lasers end dark.

use std::fs::{self, File};
use std::path::Path;
use std::thread;
use std::time::Duration;

use holod_calibration::TimeNs;
use holod_pupil_input::host_now;
use holod_slm_output::laser::simulated_box::{SimulatedTerminal, read_log};
use holod_slm_output::laser::{BoxEvent, DarkReason, LaserEdge};
use holod_tests::daemon::{Daemon, run, wait_until};
use holod_tests::{FIELD_ORDER, frames, small_rig};
use rustix::process::Signal;

const HOLOD: &str = env!("CARGO_BIN_EXE_holod");

/// A laser box on a pseudo-terminal, outside the daemon's process, that logs what its lasers do.
struct Box {
    folder: tempfile::TempDir,
    device: String,
}

impl Box {
    fn plug_in() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let terminal = SimulatedTerminal::open().unwrap();
        let device = terminal.path().to_str().unwrap().to_owned();
        let log = File::create(folder.path().join("box.csv")).unwrap();
        thread::spawn(move || terminal.serve(log, host_now));
        let rig = small_rig(64, 64, &format!("driver = \"serial\"\ndevice = \"{device}\""));
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        Self { folder, device }
    }

    fn events(&self) -> Vec<BoxEvent> {
        read_log(&fs::read_to_string(self.folder.path().join("box.csv")).unwrap()).unwrap()
    }

    fn edges(&self) -> Vec<LaserEdge> {
        let edge = |event| if let BoxEvent::Edge(edge) = event { Some(edge) } else { None };
        self.events().into_iter().filter_map(edge).collect()
    }

    /// Starts the daemon and waits until its lasers have been lit for a while.
    fn lit_daemon(&self) -> Daemon {
        let args = ["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64", "--record", "record"];
        let daemon = Daemon::start(HOLOD, &args, self.folder.path());
        let lit = wait_until(Duration::from_secs(30), || self.edges().len() > 60);
        assert!(lit, "the lasers are lit while the daemon runs: {:?} {}", self.events().last(), self.device);
        daemon
    }

    fn assert_dark(&self) {
        let edges = self.edges();
        for pair in edges.chunks(2) {
            let [on, off] = pair else { panic!("a laser is still lit: {:?}", edges.last()) };
            assert!(on.on && !off.on && on.colour == off.colour, "two lasers at once: {on:?} {off:?}");
        }
    }
}

#[test]
fn a_killed_daemon_leaves_the_laser_box_dark_within_its_heartbeat_timeout() {
    let laser_box = Box::plug_in();
    let daemon = laser_box.lit_daemon();
    let t_killed = host_now();
    daemon.signal(Signal::KILL);
    let dark = wait_until(Duration::from_secs(2), || matches!(laser_box.events().last(), Some(BoxEvent::Dark { .. })));
    assert!(dark, "{:?}", laser_box.events().last());
    let Some(BoxEvent::Dark { t, reason }) = laser_box.events().last().copied() else { unreachable!() };
    // The box sees that the panel's reports end before it misses the heartbeat: either makes it dark.
    assert!(matches!(reason, DarkReason::Heartbeat | DarkReason::SyncLost), "{reason:?}");
    assert!(t - t_killed < TimeNs(130_000_000), "dark {} ms after the kill", (t - t_killed).seconds() * 1e3);
    laser_box.assert_dark();

    let record = frames::read(&laser_box.folder.path().join("record/frames.csv"));
    let rows = record.expect("a killed daemon leaves whole rows").len();
    assert!(rows > 0);

    let ended = run(HOLOD, &["dark", "--config", "rig.toml"], laser_box.folder.path());
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stdout.contains("acknowledged"));
}

#[test]
fn signals_end_in_order_with_lasers_dark_and_a_flat_panel() {
    for signal in [Signal::TERM, Signal::INT] {
        let laser_box = Box::plug_in();
        let daemon = laser_box.lit_daemon();
        daemon.signal(signal);
        let ended = daemon.wait(Duration::from_secs(20));
        assert!(ended.status.success(), "{}", ended.stderr);
        let last = laser_box.events().last().copied();
        assert!(
            matches!(last, Some(BoxEvent::Dark { reason: DarkReason::Shutdown | DarkReason::Asked, .. })),
            "{last:?}"
        );
        laser_box.assert_dark();
        judge_record(&laser_box.folder.path().join("record"));
    }
}

fn judge_record(record: &Path) {
    let rows = frames::read(&record.join("frames.csv")).unwrap();
    assert_eq!(frames::faults(&rows, FIELD_ORDER), Vec::<String>::new());
    let summary = fs::read_to_string(record.join("summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["lasers"]["unsafe_findings"], 0, "{summary:#}");
    assert_eq!(summary["lasers_dark_at_end"], true);
    assert_eq!(summary["flat_at_end"], true);
}

#[test]
fn the_watchdog_is_fed_and_readiness_told_only_once_frames_are_shown() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("notify");
    let listener = std::os::unix::net::UnixDatagram::bind(&socket).unwrap();
    listener.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let mut child = std::process::Command::new(HOLOD)
        .args(["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64", "--duration", "3s"])
        .current_dir(folder.path())
        .env("NOTIFY_SOCKET", &socket)
        .env("WATCHDOG_USEC", "400000")
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let pid = child.id();

    let mut told = Vec::new();
    let mut buffer = [0; 4096];
    while !told.iter().any(|line: &String| line.contains("STOPPING=1")) {
        let length = listener.recv(&mut buffer).expect("holod speaks to its service manager");
        told.push(String::from_utf8_lossy(&buffer[..length]).into_owned());
    }
    assert!(child.wait().unwrap().success(), "process {pid}");
    let ready = told.iter().position(|line| line.contains("READY=1")).expect("readiness is told");
    let first_food = told.iter().position(|line| line.contains("WATCHDOG=1")).expect("the watchdog is fed");
    assert!(ready <= first_food);
    let food = told.iter().filter(|line| line.contains("WATCHDOG=1")).count();
    assert!((5..=40).contains(&food), "fed {food} times in 3 s at a limit of 0.4 s");
}
