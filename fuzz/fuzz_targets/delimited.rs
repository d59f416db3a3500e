//! Lines with columns, by the shipped example; `profile` has all other settings.
#![no_main]

use holod_pupil_input::Profile;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let profile = Profile::find("example-lines").expect("it is shipped");
    holod_fuzz::check_stream(|| profile.decoder(), bytes);
});
