//! A report of what went wrong, as somebody sends it: as it is, and with the checksums of its headers set right.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;

static FILE: LazyLock<PathBuf> = LazyLock::new(|| holod_fuzz::folder().join("bug-report"));

fuzz_target!(|bytes: &[u8]| {
    std::fs::write(&*FILE, bytes).expect("the file can be written");
    holod_daemon::bug_report::fuzzing::report(&FILE);
    let mut bytes = bytes.to_vec();
    holod_daemon::bug_report::fuzzing::seal(&mut bytes);
    std::fs::write(&*FILE, bytes).expect("the file can be written");
    holod_daemon::bug_report::fuzzing::report(&FILE);
});
