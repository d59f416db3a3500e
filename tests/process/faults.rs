//! Disks, pipes and folders that fail under a run cost the record or the log, and neither frames nor lasers.

use std::ffi::OsStr;
use std::fs;
use std::io::{PipeReader, PipeWriter, Read};
use std::os::fd::AsRawFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use holod_tests::daemon::{Daemon, Ended, NO_BUS, run, wait_until};
use holod_tests::feed::FeedClient;
use holod_tests::tracker::PtyTracker;
use holod_tests::{frames, small_rig};
use rustix::fs::OFlags;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::HOLOD;

const PATIENCE: Duration = Duration::from_secs(60);
/// What every run here is started with: frames so small that a machine that is busy with other work makes many.
pub(crate) const ARGS: [&str; 10] = [
    "--config",
    "rig.toml",
    "--tracker",
    "mock:steady",
    "--resolution",
    "16x16",
    "--weights",
    "fast",
    "--backend",
    "cpu",
];

pub(crate) fn bench() -> tempfile::TempDir {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    folder
}

/// `holod` with `more` by a shell that does `before` first, such as setting limits, and `redirects` its output.
fn by_shell(folder: &Path, before: &str, more: &[&str], redirects: &str) -> Command {
    let words: Vec<_> = [&[HOLOD][..], &ARGS, more].concat().iter().map(|word| format!("'{word}'")).collect();
    let mut command = Command::new("sh");
    command.args(["-c", &format!("{before} exec {} {redirects}", words.join(" "))]);
    command.current_dir(folder).env("XDG_RUNTIME_DIR", folder).env("DBUS_SYSTEM_BUS_ADDRESS", NO_BUS);
    command.stdin(Stdio::null());
    command
}

/// A holod whose output is not read by the bench's own threads.
struct Process(Child);

impl Process {
    fn start(mut command: Command) -> Self {
        Self(command.spawn().expect("it starts"))
    }

    fn terminate(&self) {
        kill_process(Pid::from_raw(self.0.id() as i32).unwrap(), Signal::TERM).unwrap();
    }

    /// Its exit code, where it ends in time.
    fn code(&mut self) -> Option<i32> {
        let mut status = None;
        wait_until(PATIENCE, || {
            status = self.0.try_wait().unwrap();
            status.is_some()
        });
        status.expect("it ends").code()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ended = self.0.kill();
        let _ended = self.0.wait();
    }
}

fn start(folder: &Path, more: &[&str]) -> Daemon {
    let daemon = Daemon::start_with(HOLOD, &[&ARGS, more].concat(), folder, &[("XDG_RUNTIME_DIR", folder)]);
    frames_go_on(folder);
    daemon
}

fn ask(folder: &Path, args: &[&str]) -> Ended {
    Daemon::start_with(HOLOD, args, folder, &[("XDG_RUNTIME_DIR", folder)]).wait(PATIENCE)
}

fn status(folder: &Path) -> Value {
    serde_json::from_str(&ask(folder, &["status", "--json"]).stdout).unwrap_or_default()
}

/// Sees the counter of `holod status` rise, and that lasers are armed.
fn frames_go_on(folder: &Path) {
    let shown = || status(folder)["frames_shown"].as_u64();
    let then = shown().unwrap_or(0) + 20;
    assert!(wait_until(PATIENCE, || shown() > Some(then)), "no frame more than {then}: {}", status(folder));
    assert!(wait_until(PATIENCE, || status(folder)["lasers"] == "armed"), "{}", status(folder));
}

fn until_record_is_lost(folder: &Path) -> String {
    let lost = wait_until(PATIENCE, || status(folder)["record"]["state"] == "lost");
    assert!(lost, "{}", status(folder));
    let text = ask(folder, &["status"]).stdout;
    assert!(text.contains("degraded") && text.contains("\nrecord   lost: "), "{text}");
    status(folder)["record"]["reason"].as_str().expect("a reason").to_owned()
}

/// Judges the end of a run whose record was lost because of `cause`.
fn judge_lost(ended: &Ended, cause: &str) {
    assert_eq!(ended.status.code(), Some(73), "{ended:?}");
    let told: Vec<_> = ended.stderr.lines().filter(|line| line.contains("the record is lost from here on")).collect();
    assert!(matches!(told[..], [line] if line.contains(cause) && line.contains("ERROR")), "{}", ended.stderr);
    let last = ended.stderr.lines().last().unwrap();
    assert!(last.starts_with("holod: error: the record in ") && last.contains(cause), "{last}");
    assert!(ended.stdout.contains("\nrecord    lost: ") && ended.stdout.contains("lasers dark: true"), "{ended:?}");
}

#[test]
fn a_record_that_is_deleted_is_given_up_and_frames_go_on() {
    let folder = bench();
    let daemon = start(folder.path(), &["--record", "record", "--page", "127.0.0.1:0"]);
    assert_eq!(status(folder.path())["record"]["state"], "written");
    let samples = folder.path().join("record/samples.csv");
    assert!(wait_until(PATIENCE, || fs::metadata(&samples).is_ok_and(|samples| samples.len() > 1000)));
    fs::remove_dir_all(folder.path().join("record")).unwrap();
    let reason = until_record_is_lost(folder.path());
    assert!(reason.contains("deleted"), "{reason}");
    frames_go_on(folder.path());
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    judge_lost(&ended, "deleted");
}

#[test]
fn files_of_a_record_that_go_missing_are_told_and_no_order_takes_anothers_line() {
    let folder = bench();
    let at = |name: &str| folder.path().join("record").join(name);
    let daemon = start(folder.path(), &["--record", "record"]);
    fs::remove_file(at("log.txt")).unwrap();
    fs::remove_dir_all(at("bench")).unwrap();
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    judge_lost(&ended, "it lacks record/log.txt, record/bench/rig.toml; leave a record as it is");
    let summary: Value = serde_json::from_slice(&fs::read(at("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["record"]["state"], "lost", "{summary:#}");

    let daemon = start(folder.path(), &["--record", "record", "--force"]);
    let pupil = |mm: &str| assert!(ask(folder.path(), &["ctl", "pupil", mm]).status.success());
    pupil("3");
    assert!(wait_until(PATIENCE, || at("orders.jsonl").exists()));
    fs::remove_file(at("orders.jsonl")).unwrap();
    pupil("4");
    let reason = until_record_is_lost(folder.path());
    assert!(reason.contains("record/orders.jsonl: the file was deleted or moved"), "{reason}");
    assert!(!at("orders.jsonl").exists());
    daemon.signal(Signal::TERM);
    judge_lost(&daemon.wait(PATIENCE), "orders.jsonl");
}

#[test]
fn a_record_that_grows_beyond_the_users_limit_is_given_up_and_can_be_read() {
    let folder = bench();
    // In blocks of 512 or 1024 bytes, by the shell: some seconds of rows.
    let mut command = by_shell(folder.path(), "ulimit -f 128;", &["--record", "record"], "2>log");
    command.stdout(Stdio::null());
    let mut holod = Process::start(command);
    frames_go_on(folder.path());
    let reason = until_record_is_lost(folder.path());
    assert!(reason.contains("File too large") && reason.contains("ulimit -f"), "{reason}");
    frames_go_on(folder.path());
    holod.terminate();
    assert_eq!(holod.code(), Some(73));
    let log = fs::read_to_string(folder.path().join("log")).unwrap();
    assert!(log.contains("the record is lost from here on"), "{log}");
    judge_what_is_left(folder.path());
}

/// What was written before the record was given up can be read.
fn judge_what_is_left(folder: &Path) {
    let rows = fs::read_to_string(folder.join("record/frames.csv")).unwrap();
    // The last row may be cut off.
    let whole = &rows[..=rows.rfind('\n').unwrap()];
    fs::write(folder.join("whole.csv"), whole).unwrap();
    let rows = frames::read(&folder.join("whole.csv")).unwrap();
    assert!(rows.len() > 60 && frames::faults(&rows, holod_tests::FIELD_ORDER).is_empty(), "{} rows", rows.len());
    let samples = fs::read_to_string(folder.join("record/samples.csv")).unwrap();
    let mut cells = samples[..samples.rfind('\n').unwrap()].lines().map(|row| row.split(',').count());
    let columns = cells.next().unwrap();
    assert!(samples.lines().count() > 100 && cells.all(|count| count == columns));
    let packed = run(HOLOD, &["report", "record", "--out", "report.tar.gz"], folder);
    assert!(packed.status.success(), "{packed:?}");
    let again = run(HOLOD, &["--tracker", "replay:report.tar.gz", "--frames", "20", "--json"], folder);
    let again_json: Value = serde_json::from_str(&again.stdout).unwrap_or_else(|_| panic!("{again:?}"));
    assert_eq!(again_json["report"]["frames_different"], 0, "{again_json}");
}

#[test]
fn levels_that_the_disk_does_not_take_at_the_end_are_told_in_the_record() {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(512, 512, "driver = \"simulated\"")).unwrap();
    let more = ["--resolution", "512x512", "--frames", "2", "--record", "record"];
    let args = [&ARGS[..4], &ARGS[6..], &more].concat();
    let words = args.join(" ");
    // Larger than all that is written while the run goes on, and smaller than its levels.
    let limited = ["-c", &format!("ulimit -f 300; exec {HOLOD} {words}")];
    let ended = Daemon::start_with("sh", &limited, folder.path(), &[("XDG_RUNTIME_DIR", folder.path())]).wait(PATIENCE);
    judge_lost(&ended, "cannot finish it: record/shown_pupil_");
    let record = folder.path().join("record");
    let log = fs::read_to_string(record.join("log.txt")).unwrap();
    assert!(log.contains("the record is lost from here on: cannot finish it"), "{log}");
    let summary: Value = serde_json::from_slice(&fs::read(record.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["record"]["state"], "lost", "{summary:#}");
    let parts = fs::read_dir(&record).unwrap().filter(|entry| {
        let name = entry.as_ref().unwrap().file_name().into_string().unwrap();
        name.contains("shown_pupil_") || name.ends_with(".part")
    });
    assert_eq!(parts.count(), 0, "what is there is whole");
}

#[test]
fn a_run_in_folders_whose_names_are_no_text_is_reached_and_its_record_is_whole() {
    let folder = holod_tests::new_folder();
    let bench = folder.path().join(OsStr::from_bytes(b"m\xfcller"));
    fs::create_dir(&bench).unwrap();
    fs::write(bench.join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    let mut holod = Process::start(by_shell(&bench, "", &[], "--record \"$(printf 'k\\344se')\" >out 2>err"));
    frames_go_on(&bench);
    assert_eq!(status(&bench)["record"]["folder"], "k\u{fffd}se");
    let stopped = ask(&bench, &["ctl", "stop"]);
    assert!(stopped.status.success(), "{stopped:?}");
    assert_eq!(holod.code(), Some(0), "{}", fs::read_to_string(bench.join("err")).unwrap());
    let record = bench.join(OsStr::from_bytes(b"k\xe4se"));
    let summary: Value = serde_json::from_slice(&fs::read(record.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["record"]["state"], "written", "{summary:#}");
    assert!(record.join("run.json").exists());
}

#[test]
fn a_disk_that_is_full_costs_the_record_and_no_frame() {
    let folder = bench();
    fs::create_dir(folder.path().join("disk")).unwrap();
    // A disk of its own, in a mount namespace that only this holod sees.
    let words: Vec<_> = [&[HOLOD][..], &ARGS, &["--record", "disk/record"]].concat();
    let fill = "head -c 256k /dev/zero >disk/other";
    let mount = format!("mount -t tmpfs -o size=512k none disk && {fill} && exec {}", words.join(" "));
    // As root, or else as root of a namespace of its own.
    let can_mount = |namespaces: &[&str]| {
        let tried = Command::new("unshare").args(namespaces).args(["mount", "-t", "tmpfs", "none", "/mnt"]).status();
        tried.is_ok_and(|status| status.success())
    };
    let namespaces = [vec!["--mount"], vec!["--mount", "--map-root-user"]];
    let namespaces = namespaces.iter().find(|namespaces| can_mount(namespaces));
    let namespaces = namespaces.expect("this test needs root, or user namespaces");
    let args = [&namespaces[..], &["sh", "-c", &mount]].concat();
    let daemon = Daemon::start_with("unshare", &args, folder.path(), &[("XDG_RUNTIME_DIR", folder.path())]);
    frames_go_on(folder.path());
    let reason = until_record_is_lost(folder.path());
    assert!(["No space left", "disk/record", "make room"].iter().all(|part| reason.contains(part)), "{reason}");
    // Somebody makes room before the end.
    let root = format!("/proc/{}/root", daemon.pid());
    let root = Path::new(&root).join(folder.path().strip_prefix("/").unwrap());
    let opened = fs::File::open(root.join("disk")).unwrap();
    let disk = PathBuf::from(format!("/proc/{}/fd/{}", std::process::id(), opened.as_raw_fd()));
    fs::remove_file(disk.join("other")).unwrap();
    frames_go_on(folder.path());
    daemon.signal(Signal::TERM);
    judge_lost(&daemon.wait(PATIENCE), "No space left");
    // Out of a disk that only this open folder keeps.
    let copied = Command::new("cp").arg("-r").arg(disk.join("record")).arg(folder.path()).status().unwrap();
    assert!(copied.success());
    judge_what_is_left(folder.path());
}

#[test]
fn a_runtime_folder_that_is_taken_away_is_made_again_and_the_run_is_reached_in_it() {
    let folder = bench();
    let page = folder.path().join("holod/page");
    let address = format!("unix:{}", page.display());
    let daemon = start(folder.path(), &["--scene", "feed", "--page", &address]);
    for taken_away in ["holod", "holod/feed", "holod/page"] {
        let path = folder.path().join(taken_away);
        let pause = ask(folder.path(), &["ctl", "pause"]);
        assert!(pause.status.success(), "{pause:?}");
        // Moved away first: the run may put a file into the folder while it is emptied.
        let taken = folder.path().join("taken");
        fs::rename(&path, &taken).unwrap();
        if taken.is_dir() { fs::remove_dir_all(&taken) } else { fs::remove_file(&taken) }.unwrap();
        assert!(wait_until(PATIENCE, || path.exists()), "{taken_away}");
        let answers = || ask(folder.path(), &["ctl", "resume"]).status.success();
        assert!(wait_until(PATIENCE, answers), "{:?}", ask(folder.path(), &["ctl", "resume"]));
        frames_go_on(folder.path());
        let connects = || FeedClient::connect(&folder.path().join("holod/feed")).is_ok();
        assert!(wait_until(PATIENCE, connects), "{taken_away}");
        assert!(wait_until(PATIENCE, || UnixStream::connect(&page).is_ok()), "{taken_away}: the page");
    }
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{ended:?}");
    let told = "was taken away under this run, and is made again: `loginctl enable-linger` keeps it";
    assert!(ended.stderr.contains(told), "{}", ended.stderr);
    assert_eq!(fs::read_dir(folder.path().join("holod")).unwrap().count(), 0, "all of it goes at the end");
}

/// A pipe that is full, and that nobody reads.
fn full_pipe() -> (PipeReader, PipeWriter) {
    let (reader, writer) = std::io::pipe().unwrap();
    let flags = rustix::fs::fcntl_getfl(&writer).unwrap();
    rustix::fs::fcntl_setfl(&writer, flags | OFlags::NONBLOCK).unwrap();
    while rustix::io::write(&writer, &[b'x'; 4096]).is_ok() {}
    rustix::fs::fcntl_setfl(&writer, flags).unwrap();
    (reader, writer)
}

#[test]
fn a_log_that_nobody_reads_holds_nothing_up_and_says_so_once_somebody_does() {
    let folder = bench();
    let (mut reader, writer) = full_pipe();
    let mut command = by_shell(folder.path(), "", &["--record", "record"], "");
    command.env("HOLOD_LOG", "trace").stdout(Stdio::null()).stderr(writer);
    let mut holod = Process::start(command);
    // The pipe's other writing end went with the command.
    frames_go_on(folder.path());
    let answered = (0..10).filter(|_| ask(folder.path(), &["ctl", "status"]).status.success()).count();
    assert_eq!(answered, 10, "control requests are answered");
    // Until more has been said than may wait.
    let log = folder.path().join("record/log.txt");
    let said = || fs::read_to_string(&log).map_or(0, |log| log.lines().count());
    assert!(wait_until(PATIENCE, || said() > 10_000), "{}", said());
    frames_go_on(folder.path());
    let text = thread::spawn(move || {
        let mut text = Vec::new();
        reader.read_to_end(&mut text).unwrap();
        String::from_utf8_lossy(&text).into_owned()
    });
    frames_go_on(folder.path());
    holod.terminate();
    assert_eq!(holod.code(), Some(0));
    let text = text.join().unwrap();
    assert!(text.contains("lines of the log were left out"), "{}", text.len());
    assert!(text.contains("stopping: SIGTERM"), "the end is told");
    let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap();
    assert_eq!(frames::faults(&rows, holod_tests::FIELD_ORDER), Vec::<String>::new());
}

#[test]
fn a_run_whose_log_is_never_read_ends_when_it_is_asked_to() {
    let folder = bench();
    let (_reader, writer) = full_pipe();
    let mut command = by_shell(folder.path(), "", &[], "");
    command.stdout(Stdio::null()).stderr(writer);
    let mut holod = Process::start(command);
    frames_go_on(folder.path());
    holod.terminate();
    assert_eq!(holod.code(), Some(0));
}

#[test]
fn a_log_that_is_closed_and_an_output_that_is_closed_end_no_run() {
    // From the beginning; a reader that goes away; a disk that is full.
    for (redirects, code) in [("2>&- >&-", 0), ("2>/dev/full >/dev/full", 74), ("2>/dev/full >/dev/null", 0)] {
        let folder = bench();
        let mut holod = Process::start(by_shell(folder.path(), "", &["--record", "record"], redirects));
        frames_go_on(folder.path());
        holod.terminate();
        assert_eq!(holod.code(), Some(code), "{redirects}");
        assert!(folder.path().join("record/summary.json").exists());
    }
}

#[test]
fn a_summary_that_nobody_reads_is_told_and_fails_the_run() {
    for (stdout_gone, stderr_gone) in [(true, false), (true, true), (false, true)] {
        let folder = bench();
        let mut command = by_shell(folder.path(), "", &[], "");
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut holod = Process::start(command);
        let (mut stdout, mut stderr) = (holod.0.stdout.take(), holod.0.stderr.take());
        if stdout_gone {
            stdout = None;
        }
        if stderr_gone {
            stderr = None;
        }
        frames_go_on(folder.path());
        holod.terminate();
        assert_eq!(holod.code(), Some(if stdout_gone { 74 } else { 0 }), "stderr gone: {stderr_gone}");
        let mut text = String::new();
        stderr.map(|mut stderr| stderr.read_to_string(&mut text)).transpose().unwrap();
        if stdout_gone && !stderr_gone {
            assert!(text.contains("holod: error: cannot write to standard output: Broken pipe"), "{text}");
        }
        assert!(!text.contains("panicked"), "{text}");
        drop(stdout);
    }
}

#[test]
fn a_second_holod_on_a_tracker_is_refused_and_the_first_goes_on() {
    let folder = bench();
    let link = folder.path().join("ttyTracker");
    let _tracker = PtyTracker::plug_in(&link).unwrap();
    let args = ARGS.map(|arg| if arg == "mock:steady" { "ttyTracker" } else { arg });
    let environment = [("XDG_RUNTIME_DIR", folder.path())];
    let mut first = Daemon::start_with(HOLOD, &args, folder.path(), &environment);
    frames_go_on(folder.path());
    let second = Daemon::start_with(HOLOD, &args, folder.path(), &environment).wait(PATIENCE);
    assert_eq!(second.status.code(), Some(66), "{second:?}");
    assert!(second.stderr.contains("ttyTracker") && second.stderr.contains("another program"), "{}", second.stderr);
    assert!(first.runs());
    frames_go_on(folder.path());
    first.signal(Signal::TERM);
    assert!(first.wait(PATIENCE).status.success());
}

#[test]
fn a_holod_that_stands_still_is_not_said_to_run() {
    let folder = bench();
    let daemon = Daemon::start_with(HOLOD, &ARGS, folder.path(), &[("XDG_RUNTIME_DIR", folder.path())]);
    frames_go_on(folder.path());
    let text = ask(folder.path(), &["status"]);
    assert!(text.status.success() && text.stdout.contains(", up for "), "{text:?}");
    assert_eq!(status(folder.path())["stale_s"], Value::Null);
    daemon.signal(Signal::STOP);
    assert!(wait_until(PATIENCE, || status(folder.path())["stale_s"].as_f64() > Some(5.0)));
    for args in [&["status", "--json"][..], &["status"]] {
        let told = ask(folder.path(), args);
        assert_eq!(told.status.code(), Some(69), "{told:?}");
        assert!(told.stdout.contains("running") && told.stderr.contains("its loop does not turn"), "{told:?}");
    }
    daemon.signal(Signal::CONT);
    assert!(wait_until(PATIENCE, || ask(folder.path(), &["status"]).status.success()));
    daemon.signal(Signal::TERM);
    daemon.wait(PATIENCE);
}

/// Gives a program a wall clock of its own, which a file sets.
fn faked_wall_clock() -> PathBuf {
    let folders = fs::read_dir("/usr/lib").unwrap();
    let libraries = folders.map(|folder| folder.unwrap().path().join("faketime/libfaketimeMT.so.1"));
    libraries.into_iter().find(|library| library.exists()).expect("this test needs Debian's package `libfaketime`")
}

#[test]
fn a_wall_clock_that_is_set_is_seen_in_the_log_and_nowhere_else() {
    let folder = bench();
    let by = folder.path().join("by");
    let set = |offset: &str| {
        fs::write(folder.path().join("by.new"), offset).unwrap();
        fs::rename(folder.path().join("by.new"), &by).unwrap();
    };
    set("+0d");
    let library = faked_wall_clock();
    let environment = [
        ("XDG_RUNTIME_DIR", folder.path()),
        ("LD_PRELOAD", &library),
        ("FAKETIME_TIMESTAMP_FILE", &by),
        ("FAKETIME_NO_CACHE", Path::new("1")),
        ("FAKETIME_DONT_FAKE_MONOTONIC", Path::new("1")),
    ];
    let args = [&ARGS[..], &["--record", "record"]].concat();
    let daemon = Daemon::start_with(HOLOD, &args, folder.path(), &environment);
    frames_go_on(folder.path());
    for offset in ["-30d", "+30d", "+0d"] {
        set(offset);
        let told = ask(folder.path(), &["ctl", "pupil", "4"]);
        assert!(told.status.success(), "{told:?}");
        frames_go_on(folder.path());
        let text = ask(folder.path(), &["status"]);
        assert!(text.stdout.starts_with("running") && !text.stderr.contains("its loop does not turn"), "{text:?}");
    }
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{ended:?}");
    let log = fs::read_to_string(folder.path().join("record/log.txt")).unwrap();
    let days: Vec<_> = log.lines().filter(|line| line.contains("asked for")).map(|line| &line[..10]).collect();
    assert!(matches!(days[..], [early, late, now] if early < now && now < late), "the clock is set: {log}");
    let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap();
    assert_eq!(frames::faults(&rows, holod_tests::FIELD_ORDER), Vec::<String>::new());
}
