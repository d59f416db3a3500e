//! Descriptors of HID reports.
#![no_main]

use holod_pupil_input::wire::hid_descriptor::{MAX_FIELDS, input_fields};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|descriptor: &[u8]| {
    for field in input_fields(descriptor).into_iter().flatten().take(MAX_FIELDS) {
        std::hint::black_box((field.kind(), field.linear()));
    }
});
