//! A request for the status page: query, and the headers that its door looks at.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| holod_daemon::page::fuzzing::request(&String::from_utf8_lossy(bytes)));
