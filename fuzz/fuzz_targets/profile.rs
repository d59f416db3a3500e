//! A tracker profile in TOML and, behind a zero byte, what its tracker says.
#![no_main]

use holod_pupil_input::Profile;
use holod_pupil_input::wire::Format;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut parts = bytes.splitn(2, |&byte| byte == 0);
    let Ok(text) = std::str::from_utf8(parts.next().unwrap_or_default()) else { return };
    let wire = parts.next().unwrap_or_default();
    match holod_pupil_input::fuzzing::profile(text) {
        Ok(Profile { format: format @ Format::Report(_), .. }) => holod_fuzz::check_messages(format.decoder(), wire),
        Ok(profile) => holod_fuzz::check_stream(|| profile.decoder(), wire),
        Err(error) => drop(std::hint::black_box(error.to_string())),
    }
});
