//! A fault that is there on purpose: if it is not found, the others would not be found either.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    // Random bytes would take 2^56 tries; the compares must be seen.
    if let [b'h', rest @ ..] = bytes
        && let [b'o', rest @ ..] = rest
        && let [b'l', rest @ ..] = rest
        && let [b'o', rest @ ..] = rest
        && let [b'd', rest @ ..] = rest
    {
        assert!(!rest.starts_with(b"!?"), "the planted fault");
    }
});
