//! holod's recordings of a link, their checksums set right, for no mutation would guess them; `import` has wrong ones.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;

static FILE: LazyLock<PathBuf> = LazyLock::new(|| holod_fuzz::folder().join("recording"));

fuzz_target!(|bytes: &[u8]| {
    let mut bytes = bytes.to_vec();
    holod_pupil_input::fuzzing::seal_recording(&mut bytes);
    std::fs::write(&*FILE, bytes).expect("the file can be written");
    holod_fuzz::check_log(&FILE);
    holod_pupil_input::fuzzing::walk_recording(&FILE);
});
