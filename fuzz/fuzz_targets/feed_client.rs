//! What a client of the live feed sends: its first message, and the bytes of its pictures.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| holod_daemon::source::feed::fuzzing::client(bytes));
