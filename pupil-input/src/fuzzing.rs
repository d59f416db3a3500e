//! What the fuzz targets need and nobody else: only there where `--cfg fuzzing` builds them.

use std::path::Path;

use crate::import::raw::RawLog;
use crate::record::{MAGIC, RECORD_HEAD_BYTES, crc32};
use crate::wire::Decoder;
use crate::wire::neon::NeonDecoder;
use crate::wire::pupil_labs_core::CoreDecoder;
use crate::{Profile, ProfileError};

/// The decoder of Pupil Labs Core's messages; each push is one.
pub fn core_decoder() -> Box<dyn Decoder> {
    Box::new(CoreDecoder)
}

/// The decoder of Neon's gaze stream.
pub fn neon_decoder() -> Box<dyn Decoder> {
    Box::new(NeonDecoder::new())
}

/// The profile that a text describes.
///
/// # Errors
/// It is wrong.
pub fn profile(text: &str) -> Result<Profile, ProfileError> {
    Profile::from_toml(text, "fuzzed")
}

/// Sets the checksums of a recording of a link right, as far as its lengths can be followed.
pub fn seal_recording(bytes: &mut [u8]) {
    const HEAD_BYTES: usize = MAGIC.len() + 8;
    let Some(length) = u32_at(bytes, HEAD_BYTES - 4) else { return };
    let mut behind = seal(bytes, HEAD_BYTES.saturating_add(length));
    while let Some(record) = behind {
        let Some(length) = u32_at(record, 0) else { return };
        behind = seal(record, RECORD_HEAD_BYTES.saturating_add(length));
    }
}

fn u32_at(bytes: &[u8], at: usize) -> Option<usize> {
    bytes.get(at..)?.first_chunk().map(|four| u32::from_le_bytes(*four) as usize)
}

/// Writes the checksum of the first `length` bytes behind them, and gives what follows.
fn seal(bytes: &mut [u8], length: usize) -> Option<&mut [u8]> {
    let (summed, rest) = bytes.split_at_mut_checked(length)?;
    let (sum, rest) = rest.split_first_chunk_mut()?;
    *sum = crc32(summed).to_le_bytes();
    Some(rest)
}

/// Opens a recording of a link as for playing it again, and walks through its records.
///
/// # Panics
/// What its first reading told of its span does not hold for its records.
pub fn walk_recording(path: &Path) {
    let Ok(log) = RawLog::open(path) else { return };
    let Ok(mut records) = log.records() else { return };
    let mut first = None;
    while let Ok(Some((head, _))) = records.next() {
        assert_eq!(*first.get_or_insert(head.t), log.begins());
    }
    std::hint::black_box((log.period(), log.warnings(), log.profile().decoder(), log.datagrams()));
}
