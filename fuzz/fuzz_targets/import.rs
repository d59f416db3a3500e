//! Logs of all formats, from a file in the folder for temporary files.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use holod_pupil_input::Recording;
use libfuzzer_sys::fuzz_target;

static FILE: LazyLock<PathBuf> =
    LazyLock::new(|| std::env::temp_dir().join(format!("holod-fuzz-import-{}", std::process::id())));

fuzz_target!(|log: &[u8]| {
    std::fs::write(&*FILE, log).expect("the file can be written");
    match Recording::read(&FILE) {
        Ok(recording) => {
            let mut last = recording.begins();
            for sample in recording.samples() {
                assert!(sample.t_sample >= last, "{sample:?} behind {last:?}");
                assert!(!sample.valid || (sample.diameter_mm.is_finite() && sample.diameter_mm >= 0.0), "{sample:?}");
                last = sample.t_sample;
            }
            assert_eq!(recording.samples().count(), recording.len());
            assert!(last <= recording.ends());
        }
        Err(error) => drop(std::hint::black_box(error.to_string())),
    }
    std::fs::remove_file(&*FILE).expect("the file can be removed");
});
