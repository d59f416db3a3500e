//! What becomes of a record and its folder: where a run does not begin, and where there is an earlier record.

use std::fs;
use std::path::Path;

use holod_tests::daemon::{Ended, run};
use holod_tests::small_rig;

use crate::HOLOD;

/// What every run here is started with.
const ARGS: [&str; 12] = [
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
    "--record",
    "record",
];
/// A connector that no machine has.
const NO_PANEL: [&str; 2] = ["--output", "drm:DP-99"];

fn bench() -> tempfile::TempDir {
    let folder = holod_tests::new_folder();
    fs::write(folder.path().join("rig.toml"), small_rig(64, 64, "driver = \"simulated\"")).unwrap();
    folder
}

fn record(folder: &Path, more: &[&str]) -> Ended {
    run(HOLOD, &[&ARGS, more].concat(), folder)
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
    for args in [&ARGS[..], &tried] {
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
    let _silent = holod_tests::tracker::PtyTracker::plug_in(&bench.path().join("ttyTracker")).unwrap();
    let args = ["tracker", "try", "ttyTracker", "--duration", "1s", "--record", "record"];
    let ended = run(HOLOD, &args, bench.path());
    assert_eq!(ended.status.code(), Some(69), "{}", ended.stderr);
    assert!(!bench.path().join("record").exists());
}
