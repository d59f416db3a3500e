//! HID reports whose fields the device's own descriptor tells: a byte for the descriptor's length, the descriptor, and
//! reports.
#![no_main]

use holod_pupil_input::Profile;
use holod_pupil_input::wire::Format;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Some((length, rest)) = bytes.split_first() else { return };
    let (descriptor, reports) = rest.split_at(usize::from(*length).min(rest.len()));
    let Format::Usages(settings) = Profile::find("example-usages").expect("it is shipped").format else {
        unreachable!("its fields are named by usage")
    };
    match settings.resolve(descriptor) {
        Ok(settings) => holod_fuzz::check_messages(Format::Report(settings).decoder(), reports),
        Err(error) => drop(std::hint::black_box(error.to_string())),
    }
});
