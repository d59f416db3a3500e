//! The machine goes to sleep in mid-run, as a logind of the test's own says on a bus of its own.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use holod_calibration::TimeNs;
use holod_pupil_input::host_now;
use holod_tests::daemon::{Daemon, run, wait_until};
use rustix::process::Signal;
use tokio::runtime::Runtime;
use zbus::{Connection, connection, fdo, interface, zvariant};

use crate::HOLOD;
use crate::shutdown::LaserBench;

const PATH: &str = "/org/freedesktop/login1";
const INTERFACE: &str = "org.freedesktop.login1.Manager";
const PATIENCE: Duration = Duration::from_secs(30);

/// A bus of the test's own; ended when it is dropped.
struct Bus {
    daemon: Child,
    address: PathBuf,
}

impl Bus {
    fn start(folder: &Path) -> Self {
        let (socket, config) = (folder.join("bus"), folder.join("bus.xml"));
        let _the_first_one = fs::remove_file(&socket);
        let address = format!("unix:path={}", socket.display());
        let policy = "<allow own=\"*\"/><allow send_destination=\"*\" eavesdrop=\"true\"/><allow eavesdrop=\"true\"/>";
        let text = format!(
            "<busconfig><listen>{address}</listen><auth>EXTERNAL</auth><policy context=\"default\">{policy}</policy></busconfig>"
        );
        fs::write(&config, text).unwrap();
        let mut daemon = Command::new("dbus-daemon")
            .args(["--nofork", "--nopidfile", "--nosyslog", "--print-address", "--config-file"])
            .arg(config)
            .stdout(Stdio::piped())
            .spawn()
            .expect("Debian's package dbus has dbus-daemon");
        let mut printed = String::new();
        BufReader::new(daemon.stdout.take().unwrap()).read_line(&mut printed).unwrap();
        assert!(printed.starts_with(&address), "{printed}");
        Self { daemon, address: address.into() }
    }
}

impl Drop for Bus {
    fn drop(&mut self) {
        let _ = self.daemon.kill();
        let _ = self.daemon.wait();
    }
}

/// What somebody asked logind to refrain from, and until when.
#[derive(Clone, Debug)]
struct Inhibitor {
    what: String,
    mode: String,
    t_released: Option<TimeNs>,
}

/// What logind knows.
#[derive(Clone, Default)]
struct Known {
    prepares: Arc<AtomicBool>,
    refuses: Arc<AtomicBool>,
    inhibitors: Arc<Mutex<Vec<Inhibitor>>>,
}

#[interface(name = "org.freedesktop.login1.Manager")]
impl Known {
    fn inhibit(&self, what: String, who: String, why: String, mode: String) -> fdo::Result<zvariant::OwnedFd> {
        if self.refuses.load(Ordering::Acquire) {
            return Err(fdo::Error::AccessDenied("Permission denied".into()));
        }
        assert!(who == "holod" && !why.is_empty(), "{who}: {why}");
        let (mut reader, writer) = std::io::pipe().unwrap();
        let mut inhibitors = self.inhibitors.lock().unwrap();
        let (index, all) = (inhibitors.len(), Arc::clone(&self.inhibitors));
        inhibitors.push(Inhibitor { what, mode, t_released: None });
        thread::spawn(move || {
            // Until whoever has the other end has closed it.
            let _end = reader.read(&mut [0]);
            all.lock().unwrap()[index].t_released = Some(host_now());
        });
        Ok(OwnedFd::from(writer).into())
    }

    #[zbus(property)]
    fn preparing_for_sleep(&self) -> bool {
        self.prepares.load(Ordering::Acquire)
    }
}

/// A logind that sends nothing to sleep.
struct Logind {
    known: Known,
    bus: Connection,
    runtime: Runtime,
}

impl Logind {
    fn start(bus: &Bus) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let known = Known::default();
        let served = async {
            connection::Builder::address(bus.address.to_str().unwrap())?
                .serve_at(PATH, known.clone())?
                .name("org.freedesktop.login1")?
                .build()
                .await
        };
        let bus = runtime.block_on(served).unwrap();
        Self { known, bus, runtime }
    }

    /// Says that the machine is about to sleep, or is awake again.
    fn prepare(&self, sleeps: bool) -> TimeNs {
        self.known.prepares.store(sleeps, Ordering::Release);
        let t_said = host_now();
        let said = self.bus.emit_signal(None::<&str>, PATH, INTERFACE, "PrepareForSleep", &sleeps);
        self.runtime.block_on(said).unwrap();
        t_said
    }

    fn of_kind(&self, what: &str, mode: &str) -> Vec<Inhibitor> {
        let inhibitors = self.known.inhibitors.lock().unwrap();
        inhibitors.iter().filter(|inhibitor| inhibitor.what == what && inhibitor.mode == mode).cloned().collect()
    }

    fn delays(&self) -> Vec<Inhibitor> {
        self.of_kind("sleep", "delay")
    }

    /// Waits until the machine would wait with its sleep, or no longer would, and would go to sleep when it is idle, or
    /// would not.
    fn await_inhibitors(&self, delays_sleep: bool, blocks_idle: bool) {
        let holds = |of_kind: Vec<Inhibitor>| of_kind.iter().filter(|held| held.t_released.is_none()).count();
        let wanted = (usize::from(delays_sleep), usize::from(blocks_idle));
        let is_so = || (holds(self.delays()), holds(self.of_kind("idle", "block"))) == wanted;
        assert!(wait_until(PATIENCE, is_so), "{wanted:?}: {:?}", self.known.inhibitors.lock().unwrap());
    }

    /// Says that the machine is about to sleep; the lasers of the box are dark before it would.
    fn put_to_sleep(&self, laser_box: &LaserBench) {
        let delays = self.delays().len();
        let t_said = self.prepare(true);
        let released = || self.delays()[delays - 1].t_released;
        assert!(wait_until(PATIENCE, || released().is_some()), "{:?}", self.delays());
        let t_released = released().unwrap();
        // logind waits so long.
        assert!(t_released - t_said < TimeNs(5_000_000_000), "{} s", (t_released - t_said).seconds());
        thread::sleep(Duration::from_millis(500));
        laser_box.assert_dark();
        let last = laser_box.edges().last().copied();
        assert!(last.is_some_and(|last| last.t < t_released), "{last:?}, released at {t_released:?}");
        assert_eq!(self.delays().len(), delays, "not taken again before the machine is awake");
    }
}

fn are_lit_again(laser_box: &LaserBench) -> bool {
    let lit_before = laser_box.edges().len();
    wait_until(PATIENCE, || laser_box.edges().len() > lit_before + 60)
}

#[test]
fn lasers_are_dark_before_the_machine_sleeps_and_lit_once_it_is_awake() {
    let laser_box = LaserBench::plug_in();
    let folder = laser_box.folder.path();
    let bus = Bus::start(folder);
    let logind = Logind::start(&bus);
    let daemon = laser_box.lit_daemon_with(&[("DBUS_SYSTEM_BUS_ADDRESS", &bus.address)]);
    let ctl = |args: &[&str]| {
        let asked = run(HOLOD, &[&["ctl", "lasers"], args].concat(), folder);
        assert!(asked.status.success(), "{}", asked.stderr);
        asked.stdout
    };
    logind.await_inhibitors(true, true);
    logind.put_to_sleep(&laser_box);
    logind.prepare(false);
    assert!(are_lit_again(&laser_box));
    logind.await_inhibitors(true, true);

    // That the machine is awake goes unsaid.
    logind.put_to_sleep(&laser_box);
    assert!(ctl(&["arm"]).contains("once the machine has slept"));
    logind.known.prepares.store(false, Ordering::Release);
    assert!(are_lit_again(&laser_box));
    logind.await_inhibitors(true, true);

    ctl(&["dark"]);
    logind.await_inhibitors(true, false);
    logind.put_to_sleep(&laser_box);
    let lit_before = laser_box.edges().len();
    logind.prepare(false);
    logind.await_inhibitors(true, false);
    thread::sleep(Duration::from_millis(500));
    assert_eq!(laser_box.edges().len(), lit_before, "what a person put out stays dark");
    ctl(&["arm"]);
    assert!(are_lit_again(&laser_box));
    logind.await_inhibitors(true, true);

    drop((logind, bus));
    assert!(are_lit_again(&laser_box), "a run goes on without a bus");
    let bus = Bus::start(folder);
    let logind = Logind::start(&bus);
    logind.await_inhibitors(true, true);
    logind.put_to_sleep(&laser_box);
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert!(ended.status.success(), "{}", ended.stderr);
    for (line, times) in [
        ("lasers dark: the machine is about to sleep", 4),
        ("of sleep: lasers are lit by the rules", 2),
        ("of sleep: lasers stay dark (asked)", 1),
        ("logind does not wait for dark lasers any more", 1),
        ("lasers are put out before the machine sleeps", 1),
    ] {
        assert_eq!(ended.stderr.matches(line).count(), times, "{line}: {}", ended.stderr);
    }
    let summary = fs::read_to_string(folder.join("record/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert!(summary["lasers"]["went_dark"].to_string().contains("sleep at "), "{summary:#}");
}

#[test]
fn lasers_over_a_pattern_are_dark_before_the_machine_sleeps() {
    let laser_box = LaserBench::plug_in();
    let bus = Bus::start(laser_box.folder.path());
    let logind = Logind::start(&bus);
    let args = ["pattern", "field-identity", "--output", "headless", "--config", "rig.toml", "--duration", "60s"];
    let environment = [("DBUS_SYSTEM_BUS_ADDRESS", &*bus.address)];
    let daemon = Daemon::start_with(HOLOD, &args, laser_box.folder.path(), &environment);
    assert!(are_lit_again(&laser_box));
    logind.await_inhibitors(true, true);
    logind.put_to_sleep(&laser_box);
    logind.prepare(false);
    assert!(are_lit_again(&laser_box));
    logind.await_inhibitors(true, true);
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert!(ended.status.success(), "{}", ended.stderr);
}

#[test]
fn lasers_are_put_out_also_where_logind_does_not_wait_for_them() {
    let laser_box = LaserBench::plug_in();
    let bus = Bus::start(laser_box.folder.path());
    let logind = Logind::start(&bus);
    logind.known.refuses.store(true, Ordering::Release);
    let daemon = laser_box.lit_daemon_with(&[("DBUS_SYSTEM_BUS_ADDRESS", &bus.address)]);
    logind.prepare(true);
    let is_dark = || {
        let lit_before = laser_box.edges().len();
        thread::sleep(Duration::from_millis(500));
        laser_box.edges().len() == lit_before
    };
    assert!(wait_until(PATIENCE, is_dark));
    logind.prepare(false);
    assert!(are_lit_again(&laser_box));
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(Duration::from_secs(20));
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(!ended.stderr.contains("logind"), "the box has a heartbeat: {}", ended.stderr);
}
