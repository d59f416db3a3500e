//! `holod-scenes` as a process.

use std::path::Path;
use std::time::Duration;

use holod_tests::daemon::{Daemon, wait_until};
use rustix::process::Signal;

const HOLOD_SCENES: &str = env!("CARGO_BIN_EXE_holod-scenes");

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).map(|entries| entries.flatten().collect()).unwrap_or_else(|_| Vec::new());
    entries.iter().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

#[test]
fn a_signal_leaves_no_file_that_is_half_written() {
    let folder = holod_tests::new_folder();
    let scenes = folder.path().join("scenes");
    let mut args = vec!["generate", "--out", "scenes", "--seed", "1", "--count", "100000", "--kind", "cards"];
    args.extend(["--size", "64", "--pupils", "2", "--planes", "32", "--rays", "1"]);
    for (number, signal) in [Signal::TERM, Signal::INT].into_iter().enumerate() {
        let running = Daemon::start(HOLOD_SCENES, &args, folder.path());
        let begun = || names(&scenes).len() > number * 2 + 2;
        assert!(wait_until(Duration::from_secs(60), begun), "no scene is written");
        running.signal(signal);
        let ended = running.wait(Duration::from_secs(60));
        assert_eq!(ended.status.code(), Some(128 + signal.as_raw()), "{ended:?}");
        let left = names(&scenes);
        assert!(left.iter().all(|name| name.starts_with("scene_") && name.ends_with(".safetensors")), "{left:?}");
    }
}
