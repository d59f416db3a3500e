//! What becomes of a record and its folder: where a run does not begin, and where there is an earlier record.

use std::collections::BTreeMap;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use holod_tests::daemon::{Daemon, Ended, run, wait_until};
use holod_tests::tracker::PtyTracker;
use rustix::process::Signal;

use crate::HOLOD;
use crate::faults::{ARGS, bench};

const PATIENCE: Duration = Duration::from_secs(60);
/// A connector that no machine has.
const NO_PANEL: [&str; 2] = ["--output", "drm:DP-99"];

/// What every run here is started with.
fn args() -> Vec<&'static str> {
    [&ARGS[..], &["--record", "record"]].concat()
}

fn record(folder: &Path, more: &[&str]) -> Ended {
    run(HOLOD, &[&args()[..], more].concat(), folder)
}

/// All files in `folder` and below, with what is in them.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for path in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
        match path.is_dir() {
            true => found.extend(contents(&path)),
            false => drop(found.insert(path.clone(), fs::read(path).unwrap())),
        }
    }
    found
}

#[test]
fn a_run_that_does_not_begin_leaves_no_record_and_its_folder_may_be_named_again() {
    let bench = bench();
    let ended = record(bench.path(), &NO_PANEL);
    assert_eq!(ended.status.code(), Some(69), "{}", ended.stderr);
    assert!(!bench.path().join("record").exists());

    fs::create_dir(bench.path().join("record")).unwrap();
    fs::write(bench.path().join("record/notes.txt"), "mine").unwrap();
    let ended = record(bench.path(), &NO_PANEL);
    assert_eq!(ended.status.code(), Some(69), "{}", ended.stderr);
    let left: Vec<_> = fs::read_dir(bench.path().join("record")).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert_eq!(left, [bench.path().join("record/notes.txt")]);
    let ended = record(bench.path(), &["--frames", "5"]);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(bench.path().join("record/samples.csv").exists());
}

#[test]
fn samples_that_are_there_already_are_kept_and_what_overwrites_them_is_said() {
    let bench = bench();
    fs::create_dir(bench.path().join("record")).unwrap();
    fs::write(bench.path().join("record/samples.csv"), "precious").unwrap();
    let tried = ["tracker", "try", "mock:steady", "--duration", "1s", "--record", "record"];
    for args in [&args()[..], &tried] {
        let ended = run(HOLOD, args, bench.path());
        assert_eq!(ended.status.code(), Some(73), "{}", ended.stderr);
        let says = "samples.csv exists already; name another place with --record, or overwrite it with --force";
        assert!(ended.stderr.contains(says), "{}", ended.stderr);
        assert_eq!(fs::read_to_string(bench.path().join("record/samples.csv")).unwrap(), "precious");
    }
}

#[test]
fn a_tracker_that_says_nothing_leaves_no_recording() {
    let bench = bench();
    let _silent = PtyTracker::plug_in(&bench.path().join("ttyTracker")).unwrap();
    let args = ["tracker", "try", "ttyTracker", "--duration", "1s", "--record", "record"];
    let ended = run(HOLOD, &args, bench.path());
    assert_eq!(ended.status.code(), Some(69), "{}", ended.stderr);
    assert!(!bench.path().join("record").exists());
}

#[test]
fn force_takes_no_record_away_for_a_run_that_does_not_begin() {
    let bench = bench();
    let ended = record(bench.path(), &["--frames", "5"]);
    assert!(ended.status.success(), "{}", ended.stderr);
    let path = bench.path().join("record");
    let earlier = contents(&path);
    assert!(earlier.contains_key(&path.join("frames.csv")) && earlier.contains_key(&path.join("samples.csv")));

    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = other.local_addr().unwrap().to_string();
    for trouble in [&["--page", &taken][..], &NO_PANEL, &["--tracker", "no-such-log.csv"]] {
        let ended = run(HOLOD, &[&args()[..2], &args()[4..], trouble, &["--force"]].concat(), bench.path());
        assert!(matches!(ended.status.code(), Some(66 | 69)), "{trouble:?}: {}", ended.stderr);
        assert!(contents(&path) == earlier, "{trouble:?}");
    }
    let _silent = PtyTracker::plug_in(&bench.path().join("ttyTracker")).unwrap();
    for tracker in ["ttyTracker", "no-such-log.csv"] {
        let args = ["tracker", "try", tracker, "--duration", "1s", "--record", "record", "--force"];
        let ended = run(HOLOD, &args, bench.path());
        assert!(matches!(ended.status.code(), Some(66 | 69)), "{tracker}: {}", ended.stderr);
        assert!(contents(&path) == earlier, "{tracker}");
    }

    let ended = record(bench.path(), &["--frames", "5", "--force"]);
    assert!(ended.status.success(), "{}", ended.stderr);
    let new = contents(&path);
    assert!(new[&path.join("frames.csv")] != earlier[&path.join("frames.csv")]);
    assert!(new.keys().all(|path| !path.to_string_lossy().contains(".holod-")), "{:?}", new.keys());
}

#[test]
fn a_record_that_is_being_written_is_refused_and_goes_on() {
    let bench = bench();
    let mut daemon = Daemon::start(HOLOD, &args(), bench.path());
    let path = bench.path().join("record/frames.csv");
    let rows = || fs::read_to_string(&path).map_or(0, |text| text.lines().count());
    assert!(wait_until(PATIENCE, || rows() > 10));
    let tried = ["tracker", "try", "mock:steady", "--duration", "1s", "--record", "record", "--force"];
    for args in [&[&args()[..], &["--force"]].concat()[..], &args(), &tried] {
        let ended = run(HOLOD, args, bench.path());
        assert_eq!(ended.status.code(), Some(73), "{}", ended.stderr);
        assert!(ended.stderr.contains("record: another holod records there; end it"), "{}", ended.stderr);
    }
    let before = rows();
    assert!(wait_until(PATIENCE, || rows() > before + 10) && daemon.runs());
    daemon.signal(Signal::TERM);
    let ended = daemon.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(bench.path().join("record/summary.json").exists());
    assert!(record(bench.path(), &["--frames", "5", "--force"]).status.success());
}

#[test]
fn levels_of_ten_bits_are_recorded_whole_with_what_their_hologram_was_made_with() {
    let bench = bench();
    let rig = fs::read_to_string(bench.path().join("rig.toml")).unwrap();
    let rig = rig.replace("channel-packed", "field-sequential").replace("refresh_hz = 60.0", "refresh_hz = 180.0");
    let rig = rig.replace("bit_depth = 8", "bit_depth = 10\npacking = \"red8-blue2\"");
    fs::write(bench.path().join("rig.toml"), rig).unwrap();
    let ended = record(bench.path(), &["--frames", "5", "--pupil", "3"]);
    assert!(ended.status.success(), "{}", ended.stderr);
    let text = fs::read_to_string(bench.path().join("record/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
    let [kept] = &summary["shown_levels"].as_array().unwrap()[..] else { panic!("{summary:#}") };
    assert_eq!(kept["hologram"], serde_json::json!([16, 16]));
    assert_eq!(kept["amplitude_constant"], 1.25, "that of the built-in networks");
    let file = bench.path().join("record").join(kept["file"].as_str().unwrap());
    let image::DynamicImage::ImageRgb16(levels) = image::open(file).unwrap() else { panic!("it has not 16 bits") };
    let highest = levels.pixels().flat_map(|pixel| pixel.0).max().unwrap();
    assert!((900..1024).contains(&highest), "{highest}");
}

#[test]
fn a_bench_is_rehearsed_with_simulated_lasers_in_place_of_its_own() {
    let bench = bench();
    let real = holod_tests::small_rig(64, 64, "driver = \"serial\"\ndevice = \"/dev/holod-none\"\nsync_wire = true");
    fs::write(bench.path().join("rig.toml"), real).unwrap();
    let simulated = ["--lasers", "simulated", "--frames", "60", "--json"];
    let ended = run(HOLOD, &[&ARGS[..], &simulated].concat(), bench.path());
    assert!(ended.status.success(), "{}", ended.stderr);
    let summary: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
    assert!(summary["lasers"]["lit"].as_u64() > Some(60), "{summary:#}");
    let ended = run(HOLOD, &[&ARGS[..], &simulated, &NO_PANEL].concat(), bench.path());
    assert_eq!(ended.status.code(), Some(64), "{}", ended.stderr);
    assert!(ended.stderr.contains("found --output drm:DP-99, expected headless"), "{}", ended.stderr);
}

#[test]
fn a_run_whose_folder_was_moved_goes_on_in_it_and_leaves_the_next_runs_alone() {
    let bench = bench();
    let at = |name: &str| bench.path().join(name);
    let rows = |record: &str| fs::read_to_string(at(record).join("frames.csv")).map_or(0, |text| text.lines().count());
    let order = |daemon: &Daemon, mm: &str| {
        let ended = run(HOLOD, &["ctl", "pupil", mm, "--pid", &daemon.pid().to_string()], bench.path());
        assert!(ended.status.success(), "{}", ended.stderr);
    };
    let first = Daemon::start(HOLOD, &args(), bench.path());
    assert!(wait_until(PATIENCE, || rows("record") > 10));
    fs::rename(at("record"), at("moved")).unwrap();
    let second = Daemon::start(HOLOD, &args(), bench.path());
    assert!(wait_until(PATIENCE, || rows("record") > 10));
    order(&first, "3");
    order(&second, "4");
    second.signal(Signal::TERM);
    let ended = second.wait(PATIENCE);
    assert!(ended.status.success(), "{}", ended.stderr);
    let of_second = contents(&at("record"));
    let before = rows("moved");
    assert!(wait_until(PATIENCE, || rows("moved") > before + 10));
    first.signal(Signal::TERM);
    let ended = first.wait(PATIENCE);
    assert_eq!(ended.status.code(), Some(73), "{}", ended.stderr);
    let last = ended.stderr.lines().last().unwrap();
    assert!(last.contains("record's folder record was moved to /") && last.contains("/moved while"), "{last}");
    assert!(contents(&at("record")) == of_second, "the next run's record is as it was");

    let orders = fs::read_to_string(at("moved/orders.jsonl")).unwrap();
    assert!(orders.lines().count() == 1 && orders.contains("3.0"), "{orders}");
    let names = |record: &str| {
        let files = contents(&at(record)).into_keys().map(|path| path.strip_prefix(at(record)).unwrap().to_owned());
        files.filter(|path| !path.to_string_lossy().contains("shown_pupil_")).collect::<Vec<_>>()
    };
    assert_eq!(names("moved"), names("record"));
    let shown = |path: &PathBuf| path.to_string_lossy().contains("shown_pupil_");
    assert!(contents(&at("moved")).keys().any(shown));
    let packed = run(HOLOD, &["report", "moved", "--out", "report.tar.gz"], bench.path());
    assert!(packed.status.success(), "{}", packed.stderr);
}
