//! Neon's gaze stream.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| holod_fuzz::check_stream(holod_pupil_input::fuzzing::neon_decoder, bytes));
