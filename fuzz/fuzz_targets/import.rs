//! Logs of all formats, by their content alone.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;

static FILE: LazyLock<PathBuf> = LazyLock::new(|| holod_fuzz::folder().join("log"));

fuzz_target!(|log: &[u8]| {
    std::fs::write(&*FILE, log).expect("the file can be written");
    holod_fuzz::check_log(&FILE);
});
