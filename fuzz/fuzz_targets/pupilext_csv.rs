//! PupilEXT's rows; the first byte is the set-up.
#![no_main]

use holod_pupil_input::SampleEye;
use holod_pupil_input::wire::pupilext::{
    PupilExtContainer, PupilExtDecoder, PupilExtEyes, PupilExtSettings, PupilExtSize,
};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Some((&setup, bytes)) = bytes.split_first() else { return };
    let settings = PupilExtSettings {
        container: PupilExtContainer::Csv { delimiter: if setup & 16 == 0 { b',' } else { b';' } },
        eyes: if setup & 1 == 0 { PupilExtEyes::One(SampleEye::Left) } else { PupilExtEyes::Two },
        stereo: setup & 2 != 0,
        size: match setup >> 2 & 3 {
            0 | 1 => PupilExtSize::Millimetres,
            2 => PupilExtSize::Pixels,
            _ => PupilExtSize::UndistortedPixels,
        },
    };
    holod_fuzz::check_stream(|| Box::new(PupilExtDecoder::new(settings)), bytes);
});
