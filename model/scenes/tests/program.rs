//! `holod-scenes` as a process.

use std::path::Path;
use std::time::Duration;

use holod_tests::daemon::{Daemon, run, wait_until};
use rustix::process::Signal;

const HOLOD_SCENES: &str = env!("CARGO_BIN_EXE_holod-scenes");

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).map(|entries| entries.flatten().collect()).unwrap_or_else(|_| Vec::new());
    entries.iter().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

#[test]
fn a_signal_leaves_no_file_that_is_half_written() {
    let mut args = vec!["generate", "--out", "scenes", "--seed", "1", "--count", "100000", "--kind", "cards"];
    args.extend(["--size", "64", "--pupils", "2", "--planes", "32", "--rays", "1"]);
    for signal in [Signal::TERM, Signal::INT] {
        let folder = holod_tests::new_folder();
        let scenes = folder.path().join("scenes");
        let running = Daemon::start(HOLOD_SCENES, &args, folder.path());
        assert!(wait_until(Duration::from_secs(60), || names(&scenes).len() > 2), "no scene is written");
        running.signal(signal);
        let ended = running.wait(Duration::from_secs(60));
        assert_eq!(ended.status.code(), Some(128 + signal.as_raw()), "{ended:?}");
        let left = names(&scenes);
        assert!(left.iter().all(|name| name.starts_with("scene_") && name.ends_with(".safetensors")), "{left:?}");
    }
}

#[test]
fn a_sheet_is_a_png_and_overwrites_by_force_only() {
    let folder = holod_tests::new_folder();
    let generate = ["generate", "--out", "scenes", "--seed", "1", "--count", "1", "--size", "32", "--rays", "1"];
    assert!(run(HOLOD_SCENES, &generate, folder.path()).status.success());
    let sheet = |more: &[&str]| run(HOLOD_SCENES, &[&["sheet", "scenes", "--out"], more].concat(), folder.path());
    let nothing = run(HOLOD_SCENES, &["sheet", ".", "--out", "sheet.png"], folder.path());
    assert_eq!(nothing.status.code(), Some(66), "{nothing:?}");
    assert!(nothing.stderr.contains("scene_*.safetensors"), "{nothing:?}");
    let jpeg = sheet(&["sheet.jpg"]);
    assert_eq!(jpeg.status.code(), Some(64), "{jpeg:?}");
    assert!(jpeg.stderr.contains("sheet.jpg") && jpeg.stderr.contains("FILE.png"), "{jpeg:?}");
    assert!(sheet(&["sheet.png"]).status.success());
    let path = folder.path().join("sheet.png");
    let drawn = std::fs::read(&path).unwrap();
    std::fs::write(&path, "precious").unwrap();
    let again = sheet(&["sheet.png"]);
    assert_eq!(again.status.code(), Some(73), "{again:?}");
    assert!(again.stderr.contains("sheet.png") && again.stderr.contains("--force"), "{again:?}");
    assert_eq!(std::fs::read(&path).unwrap(), b"precious");
    assert!(sheet(&["sheet.png", "--force"]).status.success());
    assert_eq!(std::fs::read(&path).unwrap(), drawn);
    let mut left = names(folder.path());
    left.sort();
    assert_eq!(left, ["scenes", "sheet.png"]);
}
