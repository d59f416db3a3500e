//! HID reports, by holod's reference report; `profile` has all other settings.
#![no_main]

use holod_pupil_input::Profile;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let profile = Profile::find("holod-hid").expect("it is shipped");
    holod_fuzz::check_messages(profile.decoder(), bytes);
});
