//! Neon's recordings with the files beside them, each with its length in two bytes before it: states, blinks, times and
//! the list of the fields, which may be missing.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use holod_fuzz::cut_by_length;
use libfuzzer_sys::fuzz_target;

static FOLDER: LazyLock<PathBuf> = LazyLock::new(holod_fuzz::folder);

fuzz_target!(|bytes: &[u8]| {
    let (states, rest) = cut_by_length(bytes);
    let (blinks, rest) = cut_by_length(rest);
    let (times, dtype) = cut_by_length(rest);
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(FOLDER.join(name), bytes).expect("the file can be written");
        FOLDER.join(name)
    };
    if times.is_empty() {
        write("blinks.csv", blinks);
        holod_fuzz::check_log(&write("3d_eye_states.csv", states));
    } else {
        write("blinks ps1.raw", blinks);
        write("eye_state ps1.time", times);
        if dtype.is_empty() {
            std::fs::remove_file(FOLDER.join("eye_state.dtype")).unwrap_or_default();
        } else {
            write("eye_state.dtype", dtype);
        }
        holod_fuzz::check_log(&write("eye_state ps1.raw", states));
    }
});
