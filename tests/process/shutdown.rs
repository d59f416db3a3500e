//! However the daemon ends, the lasers end dark.

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use holod_calibration::TimeNs;
use holod_pupil_input::host_now;
use holod_slm_output::laser::edge_log::read_log;
use holod_slm_output::laser::simulator::{Faults, SimulatedBox, SimulatedTerminal};
use holod_slm_output::laser::{BoxEvent, DarkReason, LaserEdge};
use holod_tests::daemon::{Daemon, NO_BUS, run, wait_until};
use holod_tests::tracker::PtyTracker;
use holod_tests::{FIELD_ORDER, frames, small_rig};
use rustix::process::Signal;

use crate::{HOLOD, beside_each_other};

/// A laser box on a pseudo-terminal, outside the daemon's process, with a clock of its own, that logs what its lasers
/// do.
pub(crate) struct LaserBench {
    pub(crate) folder: tempfile::TempDir,
    device: PathBuf,
    faults: Arc<Faults>,
}

impl LaserBench {
    pub(crate) fn plug_in() -> Self {
        let folder = holod_tests::new_folder();
        let device = folder.path().join("lasers");
        let rig = small_rig(64, 64, &format!("driver = \"serial\"\ndevice = {device:?}"));
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        let mut bench = Self { folder, device, faults: Arc::default() };
        bench.plug_in_again();
        bench
    }

    /// Another box, whose log takes the place of the first one's, under the same name.
    fn plug_in_again(&mut self) {
        let terminal = SimulatedTerminal::open().unwrap();
        let log = File::create(self.folder.path().join("box.csv")).unwrap();
        let _the_first_time = fs::remove_file(&self.device);
        std::os::unix::fs::symlink(terminal.path(), &self.device).unwrap();
        let mut simulated = SimulatedBox::new(host_now());
        (simulated.clock.offset_us, simulated.clock.drift_ppm) = (77_000_000, -60);
        self.faults = Arc::default();
        let faults = Arc::clone(&self.faults);
        thread::spawn(move || terminal.serve(simulated, log, &faults, host_now));
    }

    /// Its name goes first: that of its terminal may be another test's at once.
    fn unplug(&self) {
        fs::remove_file(&self.device).unwrap();
        self.faults.unplug();
    }

    fn events(&self) -> Vec<BoxEvent> {
        read_log(&fs::read_to_string(self.folder.path().join("box.csv")).unwrap()).unwrap()
    }

    pub(crate) fn edges(&self) -> Vec<LaserEdge> {
        let edge = |event| if let BoxEvent::Edge(edge) = event { Some(edge) } else { None };
        self.events().into_iter().filter_map(edge).collect()
    }

    /// Starts the daemon and waits until its lasers have been lit for a while.
    fn lit_daemon(&self) -> Daemon {
        self.lit_daemon_with(&[])
    }

    /// The same with additional variables in its environment.
    pub(crate) fn lit_daemon_with(&self, environment: &[(&str, &Path)]) -> Daemon {
        let args = ["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64", "--record", "record"];
        let daemon = Daemon::start_with(HOLOD, &args, self.folder.path(), environment);
        let lit = wait_until(Duration::from_secs(30), || self.edges().len() > 60);
        assert!(lit, "the lasers are lit while the daemon runs: {:?}", self.events().last());
        daemon
    }

    /// Starts holod as systemd does for its service: with a state folder that stays, and a runtime folder.
    fn as_service(&self, args: &[&str]) -> Daemon {
        const SERVICE: &str = "SYSTEMD_EXEC_PID=$$ STATE_DIRECTORY=\"$PWD/state\" RUNTIME_DIRECTORY=\"$PWD/runtime\" \
            exec \"$0\" \"$@\"";
        Daemon::start_with("/bin/sh", &[&["-c", SERVICE, HOLOD], args].concat(), self.folder.path(), &[])
    }

    /// A start, which begins with an empty runtime folder.
    fn start_service(&self, rig: &str) -> Daemon {
        let folder = |name: &str| self.folder.path().join(name);
        let _the_first_time = fs::remove_dir_all(folder("runtime"));
        fs::create_dir(folder("runtime")).unwrap();
        fs::create_dir_all(folder("state")).unwrap();
        fs::write(folder("faulty.toml"), "name = 1").unwrap();
        self.as_service(&["--config", rig, "--tracker", "mock:steady", "--resolution", "64x64", "--weights", "small"])
    }

    /// The exit code of a start that fails.
    fn service_fails(&self, rig: &str) -> Option<i32> {
        self.start_service(rig).wait(Duration::from_secs(60)).status.code()
    }

    /// A start whose lasers are lit, and then a signal.
    fn service_ends_by(&self, signal: Signal) {
        let lit_before = self.edges().len();
        let service = self.start_service("rig.toml");
        assert!(wait_until(Duration::from_secs(60), || self.edges().len() > lit_before + 10), "lit at first");
        service.signal(signal);
        let _ended = service.wait(Duration::from_secs(20));
    }

    /// What the unit's `ExecStopPost=` says after a start, and whether it succeeds.
    fn after_service(&self) -> (String, bool) {
        let ended = self.as_service(&["dark", "--after-service", "--config", "rig.toml"]).wait(Duration::from_secs(60));
        (format!("{}{}", ended.stdout, ended.stderr), ended.status.success())
    }

    fn assert_left_alone_after_service(&self) {
        let (said, succeeds) = self.after_service();
        assert!(succeeds && said.contains("they are left as they are"), "{said}");
    }

    pub(crate) fn assert_dark(&self) {
        let edges = self.edges();
        for pair in edges.chunks(2) {
            let [on, off] = pair else { panic!("a laser is still lit: {:?}", edges.last()) };
            assert!(on.on && !off.on && on.colour == off.colour, "two lasers at once: {on:?} {off:?}");
        }
    }
}

#[test]
fn a_killed_daemon_leaves_the_laser_box_dark_within_its_heartbeat_timeout() {
    // On a machine that is busy with other work a daemon may have lost its panel's rhythm just before it is killed, and
    // the lasers are dark by that. Only a box that was lit shows that a closed port puts it out, so it is tried again.
    let hung_up = (0..5).any(|_| kill_a_daemon_and_judge_its_lasers() == DarkReason::HangUp);
    assert!(hung_up, "the kernel closes the port of a killed process");
}

/// Why the box is dark after its daemon was killed.
fn kill_a_daemon_and_judge_its_lasers() -> DarkReason {
    let laser_box = LaserBench::plug_in();
    let daemon = laser_box.lit_daemon();
    let t_killed = host_now();
    daemon.signal(Signal::KILL);
    let dark = wait_until(Duration::from_secs(2), || matches!(laser_box.events().last(), Some(BoxEvent::Dark { .. })));
    assert!(dark, "{:?}", laser_box.events().last());
    let Some(BoxEvent::Dark { t, reason }) = laser_box.events().last().copied() else { unreachable!() };
    assert!(t - t_killed < TimeNs(130_000_000), "dark {} ms after the kill", (t - t_killed).seconds() * 1e3);
    laser_box.assert_dark();

    let record = frames::read(&laser_box.folder.path().join("record/frames.csv"));
    let rows = record.expect("a killed daemon leaves whole rows").len();
    assert!(rows > 0);

    let ended = run(HOLOD, &["dark", "--config", "rig.toml"], laser_box.folder.path());
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stdout.contains("acknowledged"));
    reason
}

#[test]
fn signals_end_in_order_with_lasers_dark_and_a_flat_panel() {
    for signal in [Signal::TERM, Signal::INT, Signal::QUIT] {
        let laser_box = LaserBench::plug_in();
        let daemon = laser_box.lit_daemon();
        daemon.signal(signal);
        let ended = daemon.wait(Duration::from_secs(20));
        assert!(ended.status.success(), "{}", ended.stderr);
        assert!(!ended.stderr.contains("sleep"), "that no bus is there is no fault: {}", ended.stderr);
        let last = laser_box.events().last().copied();
        // On a machine that is busy with other work they may have gone dark for another reason just before.
        assert!(matches!(last, Some(BoxEvent::Dark { .. })), "{last:?}");
        laser_box.assert_dark();
        judge_record(&laser_box.folder.path().join("record"));
    }
}

#[test]
fn what_a_person_put_out_stays_dark_after_a_failure_and_is_lit_after_an_end_in_order() {
    let laser_box = LaserBench::plug_in();
    let holod = |args: &[&str]| run(HOLOD, args, laser_box.folder.path());
    let args = ["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64"];
    let kept_dark = |is_kept: bool| {
        let status = || serde_json::from_str::<serde_json::Value>(&holod(&["ctl", "status"]).stdout).ok();
        let is_so =
            || status().is_some_and(|status| status["lasers_kept_dark"] == is_kept && status["frames_shown"] != 0);
        assert!(wait_until(Duration::from_secs(30), is_so), "{:?}", status());
    };
    let daemon = laser_box.lit_daemon();
    let asked = holod(&["ctl", "lasers", "dark"]);
    assert!(asked.status.success() && asked.stdout.contains("also where holod fails"), "{asked:?}");
    daemon.signal(Signal::KILL);
    drop(daemon);
    let lit_before = laser_box.edges().len();
    let pattern =
        || holod(&["pattern", "level", "40", "--config", "rig.toml", "--output", "headless", "--duration", "1s"]);
    let dark = pattern();
    assert!(dark.status.success() && dark.stderr.contains("the lasers stay dark"), "{dark:?}");
    assert_eq!(laser_box.edges().len(), lit_before, "a pattern is not lit either");

    let daemon = Daemon::start(HOLOD, &args, laser_box.folder.path());
    kept_dark(true);
    thread::sleep(Duration::from_millis(500));
    assert_eq!(laser_box.edges().len(), lit_before, "nothing was lit since");
    assert!(holod(&["ctl", "lasers", "arm"]).status.success());
    assert!(wait_until(Duration::from_secs(30), || laser_box.edges().len() > lit_before), "lit once a person says so");
    assert!(holod(&["ctl", "lasers", "dark"]).status.success());
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert!(ended.status.success() && ended.stderr.contains("the lasers stay dark"), "{}", ended.stderr);

    let lit_before = laser_box.edges().len();
    let daemon = Daemon::start(HOLOD, &args, laser_box.folder.path());
    kept_dark(false);
    assert!(wait_until(Duration::from_secs(30), || laser_box.edges().len() > lit_before), "lit after an end in order");
    daemon.signal(Signal::TERM);
    assert!(daemon.wait(Duration::from_secs(20)).status.success());
    let lit_before = laser_box.edges().len();
    let lit = pattern();
    assert!(lit.status.success() && laser_box.edges().len() > lit_before, "{lit:?}");
}

/// A service and a run by hand have no folder in common but the shared one, and call the port by other names.
#[test]
fn what_a_person_put_out_of_a_service_stays_dark_by_hand_and_the_other_way() {
    const AS_SERVICE: &str = "SYSTEMD_EXEC_PID=$$ STATE_DIRECTORY=\"$PWD/state\" exec \"$0\" \"$@\"";
    let start = |laser_box: &LaserBench, of_service: bool| {
        let folder = laser_box.folder.path();
        let rig = if of_service { "rig.toml" } else { "by-hand.toml" };
        let args = ["--config", rig, "--tracker", "mock:steady", "--resolution", "64x64"];
        let runtime = folder.join(format!("runtime-{of_service}"));
        fs::create_dir_all(&runtime).unwrap();
        let environment =
            [("XDG_RUNTIME_DIR", &*runtime), ("TMPDIR", &*runtime), ("HOLOD_DARK_NOTES", &*folder.join("lock"))];
        if of_service {
            let args = [&["-c", AS_SERVICE, HOLOD], &args[..]].concat();
            Daemon::start_with("/bin/sh", &args, folder, &environment)
        } else {
            Daemon::start_with(HOLOD, &args, folder, &environment)
        }
    };
    for of_service in [false, true] {
        let laser_box = LaserBench::plug_in();
        let folder = laser_box.folder.path();
        ["state", "lock"].iter().for_each(|name| fs::create_dir(folder.join(name)).unwrap());
        let named = laser_box.device.display().to_string();
        std::os::unix::fs::symlink(&named, folder.join("link")).unwrap();
        let rig = fs::read_to_string(folder.join("rig.toml")).unwrap();
        let by_hand = rig.replace(&named, &folder.join("link").display().to_string());
        assert_ne!(by_hand, rig);
        fs::write(folder.join("by-hand.toml"), by_hand).unwrap();
        let first = start(&laser_box, of_service);
        assert!(wait_until(Duration::from_secs(30), || laser_box.edges().len() > 60), "lit at first");
        let runtime = folder.join(format!("runtime-{of_service}"));
        let asked = Daemon::start_with(HOLOD, &["ctl", "lasers", "dark"], folder, &[("XDG_RUNTIME_DIR", &runtime)]);
        let asked = asked.wait(Duration::from_secs(20));
        assert!(asked.status.success(), "{}", asked.stderr);
        first.signal(Signal::KILL);
        drop(first);
        let lit_before = laser_box.edges().len();

        let second = start(&laser_box, !of_service);
        thread::sleep(Duration::from_secs(3));
        second.signal(Signal::TERM);
        let ended = second.wait(Duration::from_secs(20));
        assert!(ended.stderr.contains("the lasers stay dark"), "first a service: {of_service}; {}", ended.stderr);
        assert_eq!(laser_box.edges().len(), lit_before, "nothing was lit since");
    }
}

#[test]
fn a_service_that_never_opened_its_lasers_leaves_those_of_a_run_by_hand_lit() {
    let laser_box = LaserBench::plug_in();
    let by_hand = laser_box.lit_daemon();
    assert_eq!(laser_box.service_fails("rig.toml"), Some(69), "the port is in use");
    laser_box.assert_left_alone_after_service();
    assert_eq!(laser_box.service_fails("faulty.toml"), Some(78));
    laser_box.assert_left_alone_after_service();
    let lit_before = laser_box.edges().len();
    assert!(wait_until(Duration::from_secs(30), || laser_box.edges().len() > lit_before + 10), "the first one goes on");
    let made_dark = |event: &BoxEvent| matches!(event, BoxEvent::Dark { reason: DarkReason::ByHand, .. });
    assert!(!laser_box.events().iter().any(made_dark));
    by_hand.signal(Signal::TERM);
    assert!(by_hand.wait(Duration::from_secs(20)).status.success());
}

#[test]
fn a_service_that_opened_its_lasers_has_them_put_out_however_it_ended() {
    let laser_box = LaserBench::plug_in();
    for signal in [Signal::KILL, Signal::ABORT, Signal::TERM] {
        laser_box.service_ends_by(signal);
        let (said, succeeds) = laser_box.after_service();
        assert!(succeeds && said.contains("acknowledged"), "{signal:?}: {said}");
    }
}

#[test]
fn lasers_that_did_not_acknowledge_are_told_again_after_later_starts_of_the_service() {
    let mut laser_box = LaserBench::plug_in();
    laser_box.service_ends_by(Signal::KILL);
    laser_box.unplug();
    assert!(!laser_box.after_service().1);
    assert_eq!(laser_box.service_fails("rig.toml"), Some(69), "there is no port");
    assert!(!laser_box.after_service().1);
    laser_box.plug_in_again();
    assert_eq!(laser_box.service_fails("faulty.toml"), Some(78));
    let (said, succeeds) = laser_box.after_service();
    assert!(succeeds && said.contains("acknowledged"), "{said}");
    assert_eq!(laser_box.service_fails("faulty.toml"), Some(78));
    laser_box.assert_left_alone_after_service();
}

#[test]
fn fields_are_dark_for_what_keeps_the_box_from_being_armed() {
    beside_each_other([("interlock", false), ("by-hand", true)], |(reason, is_by_hand)| {
        let laser_box = LaserBench::plug_in();
        let daemon = laser_box.lit_daemon();
        let holod = |args: &[&str]| run(HOLOD, args, laser_box.folder.path());
        if is_by_hand {
            assert!(holod(&["dark", "--config", "rig.toml"]).status.success());
        } else {
            laser_box.faults.set_interlock_open(true);
        }
        // Longer than fields are looked at before something is said of them.
        thread::sleep(Duration::from_secs(7));
        let status = holod(&["ctl", "status"]);
        let status: serde_json::Value = serde_json::from_str(&status.stdout).unwrap();
        assert!(status.get("unlit").is_some_and(serde_json::Value::is_null), "{status:#}");
        daemon.signal(Signal::TERM);
        daemon.wait(Duration::from_secs(20));
        let summary = fs::read_to_string(laser_box.folder.path().join("record/summary.json")).unwrap();
        let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
        let dark = &summary["lasers"]["dark_by_reason"];
        let count = |reason: &str| dark[reason].as_u64().unwrap_or(0);
        // Before the fault a busy machine may have been late.
        assert!(count(reason) > 300 && count("late") + count("box-fault") < count(reason) / 2, "{dark:#}");
    });
}

#[test]
fn an_unplugged_laser_box_is_named_at_once_and_lit_again_when_it_is_back() {
    let mut laser_box = LaserBench::plug_in();
    let runtime = holod_tests::new_folder();
    let args = ["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64", "--duration", "60s"];
    let environment = [("XDG_RUNTIME_DIR", runtime.path())];
    let daemon = Daemon::start_with(HOLOD, &args, laser_box.folder.path(), &environment);
    assert!(wait_until(Duration::from_secs(30), || laser_box.edges().len() > 60));
    laser_box.unplug();
    let status = || {
        let asked = Daemon::start_with(HOLOD, &["status"], laser_box.folder.path(), &environment);
        asked.wait(Duration::from_secs(20)).stdout
    };
    let named = wait_until(Duration::from_secs(10), || {
        let status = status();
        status.contains("lasers   dark; ") && status.contains("check lasers.device")
    });
    assert!(named, "{}", status());
    laser_box.assert_dark();

    laser_box.plug_in_again();
    assert!(wait_until(Duration::from_secs(20), || laser_box.edges().len() > 60), "{:?}", laser_box.events().last());
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stderr.contains("the laser box is lost, lasers dark: "), "{}", ended.stderr);
    assert!(ended.stderr.contains("the laser box is back"), "{}", ended.stderr);
    assert!(ended.stdout.contains("lasers dark: true"), "{}", ended.stdout);
    let lasers = ended.stdout.lines().find(|line| line.starts_with("lasers    ")).expect("a line on the lasers");
    assert!(lasers.contains("; lasers lost") && lasers.ends_with(", back"), "{lasers}");
    laser_box.assert_dark();
}

#[test]
fn a_pattern_says_once_why_its_laser_box_is_lost_and_that_it_is_back() {
    let mut laser_box = LaserBench::plug_in();
    let args = ["pattern", "field-identity", "--output", "headless", "--config", "rig.toml", "--duration", "60s"];
    let daemon = Daemon::start(HOLOD, &args, laser_box.folder.path());
    assert!(wait_until(Duration::from_secs(30), || laser_box.edges().len() > 60));
    laser_box.unplug();
    thread::sleep(Duration::from_secs(3));
    laser_box.plug_in_again();
    assert!(wait_until(Duration::from_secs(20), || laser_box.edges().len() > 60), "{:?}", laser_box.events().last());
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert!(ended.status.success(), "{}", ended.stderr);
    // Once more at most, where a busy machine has let the box answer late; not each second.
    let told = ended.stderr.matches("the laser box is lost").count();
    assert!((1..=2).contains(&told), "{}", ended.stderr);
    assert!(ended.stderr.contains("check lasers.device"), "{}", ended.stderr);
    assert!(ended.stderr.contains("the laser box is back"), "{}", ended.stderr);
}

#[test]
fn a_run_whose_laser_box_does_not_acknowledge_darkness_says_so_and_fails() {
    let laser_box = LaserBench::plug_in();
    let daemon = laser_box.lit_daemon();
    laser_box.unplug();
    thread::sleep(Duration::from_millis(500));
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert_eq!(ended.status.code(), Some(69), "{}", ended.stderr);
    assert!(ended.stdout.contains("lasers dark: false (/"), "{}", ended.stdout);
    assert!(ended.stderr.contains("did not acknowledge darkness"), "{}", ended.stderr);
    let summary = fs::read_to_string(laser_box.folder.path().join("record/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["lasers_dark_at_end"], false);
    assert!(summary["lasers_not_dark"].as_str().unwrap().contains("lasers.device"), "{summary:#}");
    assert_eq!(summary["lasers"]["box_lost"]["is_back"], false, "{summary:#}");
}

#[test]
fn a_laser_box_is_looked_at_tried_out_and_put_out_by_its_port_alone() {
    let laser_box = LaserBench::plug_in();
    let folder = laser_box.folder.path();
    let port = laser_box.device.to_str().unwrap();
    let laser = |args: &[&str]| run(HOLOD, &[args, &["--port", port]].concat(), folder);
    let status = laser(&["laser", "status"]);
    assert!(status.status.success(), "{}", status.stderr);
    for part in ["called simulated", "state      dark", "interlock  closed", "heartbeat timeout up to"] {
        assert!(status.stdout.contains(part), "{part}: {}", status.stdout);
    }
    assert_eq!(laser_box.events(), [], "looking at a box does nothing to it");
    let armed = laser(&["laser", "arm"]);
    assert!(armed.stdout.contains("(heartbeat; its timeout is 100 ms)"), "{} {}", armed.stdout, armed.stderr);
    assert!(matches!(laser_box.events().first(), Some(BoxEvent::Armed { .. })));
    assert_eq!(laser_box.edges(), [], "nothing was lit");
    for words in [&["laser", "dark"][..], &["dark"]] {
        let dark = laser(words);
        assert!(dark.stdout.contains("acknowledged"), "{}", dark.stderr);
    }
    let status = laser(&["laser", "status"]);
    assert!(status.stdout.contains("dark last because of by-hand"), "{}", status.stdout);
    let armed = laser(&["laser", "arm"]);
    assert!(armed.stdout.contains("dark by itself"), "whoever begins anew may arm it: {}", armed.stderr);
    laser_box.faults.set_ignores_silence(true);
    // On a busy machine the simulated box itself may stand still for its timeout.
    let refused = (0..5).map(|_| laser(&["laser", "arm"])).find(|ended| !ended.status.success());
    let refused = refused.expect("a box without a timeout is found");
    assert_eq!(refused.status.code(), Some(69), "{}", refused.stderr);
    assert!(refused.stderr.contains("do not use this box"), "{}", refused.stderr);
    assert!(matches!(laser_box.events().last(), Some(BoxEvent::Dark { reason: DarkReason::Asked, .. })), "and put out");
    laser_box.faults.set_ignores_silence(false);
    let none = run(HOLOD, &["laser", "status", "--port", "/dev/no-such-port"], folder);
    assert_eq!(none.status.code(), Some(69));
    assert!(none.stderr.contains("/dev/no-such-port"), "{}", none.stderr);
    let both = run(HOLOD, &["dark", "--port", "x", "--config", "rig.toml"], folder);
    assert_eq!(both.status.code(), Some(64));
    let neither = run(HOLOD, &["dark"], folder);
    assert_eq!(neither.status.code(), Some(64), "nothing was put out: {}", neither.stdout);
    assert!(neither.stderr.contains("--config RIG"), "{}", neither.stderr);
}

#[test]
fn a_second_holod_on_a_laser_box_is_refused_and_the_first_goes_on() {
    let laser_box = LaserBench::plug_in();
    let mut first = laser_box.lit_daemon();
    let args = ["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64"];
    let second = run(HOLOD, &args, laser_box.folder.path());
    assert_eq!(second.status.code(), Some(69), "{}", second.stderr);
    assert!(second.stderr.contains("lasers is in use by another program"), "{}", second.stderr);
    let lit = laser_box.edges().len();
    assert!(wait_until(Duration::from_secs(20), || laser_box.edges().len() > lit + 60), "the first one's are lit");
    assert!(first.runs());
    first.signal(Signal::TERM);
    assert!(first.wait(Duration::from_secs(20)).status.success());
    laser_box.assert_dark();
}

#[test]
fn an_order_beside_a_daemon_that_hangs_is_soon_given_up_with_what_puts_the_lasers_out() {
    let folder = holod_tests::new_folder();
    let daemon = Daemon::start(HOLOD, &["--tracker", "mock:steady", "--resolution", "64x64"], folder.path());
    let holod = |args: &[&str]| run(HOLOD, args, folder.path());
    assert!(wait_until(Duration::from_secs(30), || holod(&["ctl", "status"]).status.success()));
    daemon.signal(Signal::STOP);
    let t_asked = host_now();
    let asked = holod(&["ctl", "lasers", "dark"]);
    assert!(host_now() - t_asked < TimeNs(30_000_000_000), "long after it could still be answered");
    assert!(!asked.status.success() && asked.stderr.contains("nothing came for 8 s"), "{}", asked.stderr);
    assert!(asked.stderr.contains("`holod dark --config RIG` puts the lasers out"), "{}", asked.stderr);
}

#[test]
fn lasers_are_put_out_beside_a_daemon_that_hangs() {
    let laser_box = LaserBench::plug_in();
    let daemon = laser_box.lit_daemon();
    daemon.signal(Signal::STOP);
    let ended = run(HOLOD, &["dark", "--port", laser_box.device.to_str().unwrap()], laser_box.folder.path());
    daemon.signal(Signal::CONT);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stdout.contains("acknowledged"));
    // It goes on, and its box is dark; what it armed before it was told counts no more.
    let armed = |event: &&BoxEvent| matches!(event, BoxEvent::Armed { .. });
    let times_armed = laser_box.events().iter().filter(armed).count();
    thread::sleep(Duration::from_secs(3));
    assert_eq!(laser_box.events().iter().filter(armed).count(), times_armed, "not armed again");
    laser_box.assert_dark();
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert!(ended.stderr.contains("restart holod to light lasers again"), "{}", ended.stderr);
}

/// A Cobolt laser at `link` that takes its time to answer, and what it was told.
fn slow_cobolt(link: &Path) -> Arc<Mutex<Vec<String>>> {
    let plugged_in = PtyTracker::plug_in(link).unwrap();
    let mut line = plugged_in.line().unwrap();
    let heard = Arc::new(Mutex::new(Vec::new()));
    let its_words = Arc::clone(&heard);
    thread::spawn(move || {
        let _plugged_in = plugged_in;
        for command in BufReader::new(line.try_clone().unwrap()).split(b'\r') {
            let command = String::from_utf8(command.unwrap()).unwrap();
            thread::sleep(Duration::from_millis(100));
            let answer = match command.as_str() {
                "sn?" => "12034",
                "ilk?" | "f?" => "0",
                "gam?" => "1",
                _ => "OK",
            };
            its_words.lock().unwrap().push(command);
            line.write_all(format!("{answer}\r\n").as_bytes()).unwrap();
        }
    });
    heard
}

#[test]
fn a_second_signal_does_not_leave_lasers_without_a_heartbeat_lit() {
    let folder = holod_tests::new_folder();
    let heard = slow_cobolt(&folder.path().join("green"));
    let lasers = "driver = \"text\"\nprofile = \"cobolt\"\ndevices = { green = \"green\" }\n\
                  accept_no_heartbeat = \"these lasers stay lit when holod dies\"";
    let rig = small_rig(64, 64, lasers).replace("\"channel-packed\"", "\"monochrome\"\ncolour = \"green\"");
    fs::write(folder.path().join("rig.toml"), rig).unwrap();
    let args = ["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64"];
    let mut daemon = Daemon::start(HOLOD, &args, folder.path());
    // It is asked how it is from time to time once everything goes on.
    let asked = || heard.lock().unwrap().iter().filter(|words| *words == "f?").count();
    assert!(wait_until(Duration::from_secs(60), || asked() > 3 || !daemon.runs()));
    let asked_before = asked();
    daemon.signal(Signal::TSTP);
    assert!(wait_until(Duration::from_secs(30), || asked() > asked_before + 1), "it was suspended");
    let before = heard.lock().unwrap().len();
    // Two of one kind at once may come as one.
    daemon.signal(Signal::INT);
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert_eq!(ended.status.code(), Some(0), "{}", ended.stderr);
    assert!(heard.lock().unwrap()[before..].iter().any(|words| words == "l0"), "{:?}", heard.lock().unwrap());
    assert!(ended.stderr.contains("a second signal ends holod only once"), "{}", ended.stderr);
    assert!(ended.stderr.contains("SIGTSTP (Ctrl-Z) is not obeyed"), "{}", ended.stderr);
    assert!(ended.stderr.contains("may stay lit while the machine sleeps"), "no bus is there: {}", ended.stderr);
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
    let folder = holod_tests::new_folder();
    let socket = folder.path().join("notify");
    let listener = std::os::unix::net::UnixDatagram::bind(&socket).unwrap();
    listener.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let mut child = std::process::Command::new(HOLOD)
        .args(["--config", "rig.toml", "--tracker", "mock:steady", "--resolution", "64x64", "--duration", "3s"])
        .current_dir(folder.path())
        .env("NOTIFY_SOCKET", &socket)
        .env("DBUS_SYSTEM_BUS_ADDRESS", NO_BUS)
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
    let more_time = told.iter().position(|line| line.contains("EXTEND_TIMEOUT_USEC=120000000"));
    assert!(more_time.is_some_and(|more_time| more_time < ready), "{told:?}");
    let first_food = told.iter().position(|line| line.contains("WATCHDOG=1")).expect("the watchdog is fed");
    assert!(ready <= first_food);
    let food = told.iter().filter(|line| line.contains("WATCHDOG=1")).count();
    assert!((5..=40).contains(&food), "fed {food} times in 3 s at a limit of 0.4 s");
}
