//! ISCAN packets; the first byte is the set-up.
#![no_main]

use holod_pupil_input::SampleEye;
use holod_pupil_input::wire::iscan::{IscanDecoder, IscanPupil, IscanSettings};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Some((&setup, bytes)) = bytes.split_first() else { return };
    let pupil = |eye, word: u8| IscanPupil { eye, word: word.into(), mm_per_count: 0.1 };
    let settings = IscanSettings {
        words: usize::from(setup & 7),
        pupils: vec![pupil(SampleEye::Left, setup >> 3 & 3), pupil(SampleEye::Right, setup >> 5)],
        zero_is_lost: true,
    };
    holod_fuzz::check_stream(|| Box::new(IscanDecoder::new(settings.clone())), bytes);
});
