//! Pupil Labs Core's messages, one an input.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|message: &[u8]| holod_fuzz::check_message(holod_pupil_input::fuzzing::core_decoder(), message));
