//! BIDS recordings, unpacked: the sidecar, the table, the sidecar of the events and their table, cut by zero bytes.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use holod_fuzz::cut_at_zero;
use libfuzzer_sys::fuzz_target;

static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| {
    let folder = holod_fuzz::folder();
    // No sidecar is looked for above it.
    std::fs::write(folder.join("dataset_description.json"), "{}").expect("the file can be written");
    folder
});

fuzz_target!(|bytes: &[u8]| {
    let mut rest = bytes;
    for name in ["physio.json", "physio.tsv", "physioevents.json", "physioevents.tsv"] {
        let (part, behind) = cut_at_zero(rest);
        std::fs::write(FOLDER.join(format!("sub-1_recording-eye1_{name}")), part).expect("the file can be written");
        rest = behind;
    }
    holod_fuzz::check_log(&FOLDER.join("sub-1_recording-eye1_physio.tsv"));
});
