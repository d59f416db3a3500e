//! The status page's work gives way to the run's.

use std::f64::consts::TAU;
use std::fs;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::Duration;

use holod_tests::daemon::{Daemon, wait_until};
use holod_tests::small_rig;
use rustix::process::{Signal, getpriority_process};

use crate::HOLOD;

const PATIENCE: Duration = Duration::from_secs(60);
/// Of the threads that compute holograms, and of the one that computes the page's pictures.
const WORKER_NICENESS: i32 = 5;
const EYE_NICENESS: i32 = 15;
/// Policies of the kernel: ordinary, and first in first out.
const SCHED_OTHER: u32 = 0;
const SCHED_FIFO: u32 = 1;

#[derive(Debug, PartialEq)]
struct Thread {
    name: String,
    is_main: bool,
    nice: i32,
    policy: u32,
}

impl Thread {
    /// Of the text of /proc/PID/task/TID/stat, whose fields are counted from 1.
    fn of(stat: &str, pid: u32) -> Self {
        let (id, rest) = stat.split_once(" (").unwrap();
        let (name, rest) = rest.rsplit_once(") ").unwrap();
        let fields: Vec<&str> = rest.split_whitespace().collect();
        let field = |number: usize| fields[number - 3];
        Self {
            name: name.to_owned(),
            is_main: id.parse() == Ok(pid),
            nice: field(19).parse().unwrap(),
            policy: field(41).parse().unwrap(),
        }
    }

    fn all_of(pid: u32) -> Vec<Self> {
        let tasks = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
        // One that has ended meanwhile has no file any more.
        let stats = tasks.filter_map(|task| fs::read_to_string(task.ok()?.path().join("stat")).ok());
        stats.map(|stat| Self::of(&stat, pid)).collect()
    }
}

#[test]
fn fields_of_a_thread_are_told_apart() {
    let stat = "4711 (a b) c) S 1 2 3 0 -1 4194304 5 0 0 0 6 7 0 0 -11 0 9 0 8 0 0 18446744073709551615 0 0 0 0 0 0 0 \
                0 0 0 0 0 -1 1 10 1 0 0 0 0 0 0 0 0 0 0 0";
    let expected = Thread { name: "a b) c".into(), is_main: true, nice: 0, policy: SCHED_FIFO };
    assert_eq!(Thread::of(stat, 4711), expected);
    assert!(!Thread::of(stat, 4712).is_main);
}

/// The first line of the answer.
fn get(socket: &Path, path: &str) -> Option<String> {
    let mut stream = UnixStream::connect(socket).ok()?;
    write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").ok()?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).ok()?;
    String::from_utf8_lossy(&answer).lines().next().map(str::to_owned)
}

#[test]
fn pictures_for_the_page_are_computed_behind_everything_else() {
    let folder = holod_tests::new_folder();
    let socket = folder.path().join("page");
    let page = format!("unix:{}", socket.display());
    let args = [
        "--resolution",
        "64x64",
        "--weights",
        "fast",
        "--backend",
        "cpu",
        "--tracker",
        "mock:sweep",
        "--record",
        "record",
        "--page",
    ];
    let environment = [("XDG_RUNTIME_DIR", folder.path()), ("RAYON_NUM_THREADS", Path::new("3"))];
    let daemon = Daemon::start_with(HOLOD, &[&args[..], &[&page]].concat(), folder.path(), &environment);
    let seen = || get(&socket, "/eye.png").is_some_and(|status| status == "HTTP/1.1 200 OK");
    assert!(wait_until(PATIENCE, seen), "no picture");

    let threads = Thread::all_of(daemon.pid());
    let of_name = |name: &'static str| threads.iter().filter(move |thread| thread.name == name && !thread.is_main);
    // Where this program itself gives way already, so does what it starts.
    let own = getpriority_process(None).unwrap();
    let is_ordinary = |thread: &Thread, nice: i32| thread.policy == SCHED_OTHER && thread.nice == nice.max(own);
    let eyes: Vec<_> = of_name("holod-eye").collect();
    assert_eq!(eyes.len(), 2, "the thread that is asked, and the one that computes: {threads:#?}");
    assert!(eyes.iter().all(|thread| is_ordinary(thread, EYE_NICENESS)), "{eyes:#?}");
    assert!(eyes.iter().all(|thread| !is_ordinary(thread, WORKER_NICENESS)) || own > WORKER_NICENESS);
    // The usual pool's threads have the name of the process.
    let pool: Vec<_> = of_name("holod").collect();
    assert_eq!(pool.len(), 3, "{threads:#?}");
    assert!(pool.iter().all(|thread| is_ordinary(thread, WORKER_NICENESS)), "{pool:#?}");
    assert!(of_name("holod-page").all(|thread| is_ordinary(thread, WORKER_NICENESS)), "{threads:#?}");

    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    let may_be_prompt = !ended.stderr.contains("threads run at ordinary priority");
    for name in ["holod-panel", "holod-laser", "pupil-reader"] {
        let policies: Vec<_> = of_name(name).map(|thread| thread.policy).collect();
        assert_eq!(policies, [if may_be_prompt { SCHED_FIFO } else { SCHED_OTHER }], "{name}: {}", ended.stderr);
    }
    // Those that wait for a disk or a pipe, and the one that makes frames.
    for name in ["pupil-recorder", "holod-record", "holod-status", "holod-log", "holod-frame"] {
        let of_name: Vec<_> = of_name(name).collect();
        assert!(!of_name.is_empty() && of_name.iter().all(|thread| is_ordinary(thread, 0)), "{name}: {threads:#?}");
    }
}

#[test]
fn an_eye_sees_nothing_of_a_level_whose_phase_is_not_known() {
    let folder = holod_tests::new_folder();
    let rows: Vec<String> = (0..64).map(|row| format!("{},{}", 4 * row, f64::from(row) * TAU / 64.0)).collect();
    fs::write(folder.path().join("lut.csv"), format!("level,phase_rad\n{}\n", rows.join("\n"))).unwrap();
    let rig = small_rig(64, 64, "driver = \"simulated\"");
    let table = "lut_file = { green = \"lut.csv\" }\nsettle_ms";
    let rig_with_table = rig.replace("settle_ms", table).replace("green = 1.9921875, ", "");
    assert_ne!(rig, rig_with_table);
    fs::write(folder.path().join("rig.toml"), rig_with_table).unwrap();
    let socket = folder.path().join("page");
    let page = format!("unix:{}", socket.display());
    let args = ["--config", "rig.toml", "--resolution", "64x64", "--weights", "fast", "--backend", "cpu"];
    let more = ["--tracker", "mock:sweep", "--page", &page];
    let environment = [("XDG_RUNTIME_DIR", folder.path())];
    let daemon = Daemon::start_with(HOLOD, &[&args[..], &more].concat(), folder.path(), &environment);
    let sees = |status: &'static str| wait_until(PATIENCE, || get(&socket, "/eye.png").as_deref() == Some(status));
    let (seen, unseen) = ("HTTP/1.1 200 OK", "HTTP/1.1 503 Service Unavailable");
    assert!(sees(seen), "no picture");

    let pid = daemon.pid().to_string();
    let show = |level: &str| {
        let order = ["ctl", "--pid", &pid, "pattern", "level", level];
        // The status, which says where orders go, may be written after the page's first picture.
        let is_shown =
            || Daemon::start_with(HOLOD, &order, folder.path(), &environment).wait(PATIENCE).status.success();
        assert!(wait_until(PATIENCE, is_shown), "level {level} is not shown");
    };
    show("5");
    assert!(sees(unseen), "a level without a phase was seen");
    show("4");
    assert!(sees(seen), "a level with a phase was not seen");

    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
}
