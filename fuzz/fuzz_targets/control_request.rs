//! A line of JSON on the control socket.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| holod_daemon::control::fuzzing::request(bytes));
