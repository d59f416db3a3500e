//! LiveTrack rows; the first byte is the set-up.
#![no_main]

use holod_pupil_input::SampleEye;
use holod_pupil_input::wire::livetrack::{LiveTrackDecoder, LiveTrackSettings, LiveTrackSize};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Some((&setup, bytes)) = bytes.split_first() else { return };
    let settings = LiveTrackSettings {
        size: match setup & 3 {
            0 | 1 => LiveTrackSize::Area(6),
            2 => LiveTrackSize::Diameter(3),
            _ => LiveTrackSize::Axes(6, 7),
        },
        frames_per_second: (setup & 4 == 0).then_some(500.0),
        counter_bits: u32::from(setup >> 2),
        mono_eye: SampleEye::Right,
    };
    holod_fuzz::check_stream(|| Box::new(LiveTrackDecoder::new(settings)), bytes);
});
