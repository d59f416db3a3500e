//! holod's line protocol.
#![no_main]

use holod_pupil_input::wire::line::LineDecoder;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| holod_fuzz::check_stream(|| Box::new(LineDecoder::joining()), bytes));
