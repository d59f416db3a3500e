//! Open Gaze records; the first byte is the set-up.
#![no_main]

use holod_pupil_input::wire::open_gaze::{OpenGazeDecoder, OpenGazeSettings, OpenGazeSize};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Some((&setup, bytes)) = bytes.split_first() else { return };
    let settings = OpenGazeSettings {
        size: if setup & 1 == 0 { OpenGazeSize::Millimetres } else { OpenGazeSize::Pixels },
        ticks_per_second: (setup & 2 != 0).then_some(1e7),
    };
    holod_fuzz::check_stream(|| Box::new(OpenGazeDecoder::new(settings)), bytes);
});
