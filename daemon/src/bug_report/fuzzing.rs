//! The reader of reports, for the fuzzers.

use std::path::Path;

use holod_calibration::rig::Rig;
use tar::Header;

use super::unpack::open;
use super::{play, recorded, unpack};
use crate::record::{BENCH, FRAMES, RIG, RUN, RunFacts};

const BLOCK_BYTES: usize = 512;

/// Sets the checksums of an archive's headers right, which no mutation would guess.
pub fn seal(archive: &mut [u8]) {
    let mut begin = 0;
    while let Some(block) = archive.get_mut(begin..begin + BLOCK_BYTES) {
        let mut header = Header::new_old();
        header.as_mut_bytes().copy_from_slice(block);
        header.set_cksum();
        block.copy_from_slice(header.as_bytes());
        let Some(size) = header.entry_size().ok().and_then(|size| usize::try_from(size).ok()) else { return };
        let Some(next) =
            size.checked_next_multiple_of(BLOCK_BYTES).and_then(|size| size.checked_add(begin + BLOCK_BYTES))
        else {
            return;
        };
        begin = next;
    }
}

/// An archive at `path`, plain or with gzip. It is refused in words, or taken apart and read as far as no engine is
/// needed, also where its files are not those of its listing, for no mutation would guess their hashes.
///
/// # Panics
/// Where something of it leads out of its folder, a refusal has no words, or a frame is read that no eye could have
/// seen.
pub fn report(path: &Path) {
    if let Err(failure) = unpack(path) {
        assert!(!failure.to_string().is_empty());
    }
    let report = match open(path) {
        Ok(report) => report,
        Err(failure) => {
            assert!(!failure.to_string().is_empty());
            return;
        }
    };
    let folder = report.path("").canonicalize().expect("the folder of a report that was taken apart is there");
    for packed in &report.manifest.files {
        // A name that leads out is refused when hashes are compared; what is held is inside.
        let path = report.path(&packed.name);
        if report.holds(&path)
            && let Ok(path) = path.canonicalize()
        {
            assert!(path.starts_with(&folder), "{}", path.display());
        }
    }
    if let Ok(Some(facts)) = report.text(RUN) {
        let _ = std::hint::black_box(serde_json::from_str::<RunFacts>(&facts));
    }
    if play::read_orders(&report).is_ok()
        && let Err(faults) = Rig::load(&report.path(BENCH).join(RIG))
    {
        assert!(!faults.to_string().is_empty());
    }
    match recorded::read(&report.path(FRAMES)) {
        Ok(frames) => {
            assert!(
                frames.is_sorted_by(|one, next| one.frame < next.frame),
                "frames come in the order of their numbers"
            );
            for made in frames.iter().filter_map(|frame| frame.made.as_ref()) {
                assert!((0.1..=20.0).contains(&made.pupil.mm()), "{made:?}");
            }
        }
        Err(failure) => assert!(!failure.to_string().is_empty()),
    }
}
