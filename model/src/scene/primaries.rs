//! Whether the colours of a picture are of sRGB's primaries and range, as which they are shown.

use std::io::{self, Read};

/// Red, green, blue and white of Rec. 709, which are sRGB's.
const REC709: [[f32; 2]; 4] = [[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], [0.3127, 0.3290]];
/// X, Y and Z of its red, green and blue, adapted to the white of ICC profiles.
const REC709_ADAPTED: [[f32; 3]; 3] = [[0.4361, 0.2225, 0.0139], [0.3851, 0.7169, 0.0971], [0.1431, 0.0606, 0.7141]];

/// Code points of ITU-T H.273: the primaries of Rec. 709, or none said; and the transfers of high dynamic range, PQ and
/// HLG.
const CODES_OF_REC709: [u8; 2] = [1, 2];
const CODES_OF_HDR: [u8; 2] = [16, 18];

/// Whether red, green, blue and white at these x and y are Rec. 709's, but for what they were rounded by.
pub(super) fn are_rec709(found: [[f32; 2]; 4]) -> bool {
    let pairs = found.as_flattened().iter().zip(REC709.as_flattened());
    pairs.into_iter().all(|(found, expected)| (found - expected).abs() <= 1e-3)
}

/// Whether a PNG or JPEG, whose file brings `bytes` and which has this profile, says that it is of other colours.
///
/// # Errors
/// It cannot be read.
pub(super) fn are_foreign(bytes: impl Read, icc_profile: Option<&[u8]>) -> io::Result<bool> {
    let chunks = PngChunks::read(bytes)?;
    // Of several the first in the order of the PNG standard holds.
    Ok(match (chunks.code_points, icc_profile) {
        (Some([primaries, transfer]), _) => !CODES_OF_REC709.contains(&primaries) || CODES_OF_HDR.contains(&transfer),
        (None, Some(profile)) => is_foreign(profile),
        (None, None) => !chunks.is_srgb && chunks.chromaticities.is_some_and(|found| !are_rec709(found)),
    })
}

/// What a PNG says of its colours in chunks; nothing of another file.
#[derive(Default)]
struct PngChunks {
    /// Of `cICP`: primaries and transfer.
    code_points: Option<[u8; 2]>,
    is_srgb: bool,
    chromaticities: Option<[[f32; 2]; 4]>,
}

impl PngChunks {
    fn read(mut bytes: impl Read) -> io::Result<Self> {
        let mut told = Self::default();
        let mut take = |length: u64| {
            let mut taken = Vec::new();
            (&mut bytes).take(length).read_to_end(&mut taken).map(|_| taken)
        };
        if take(8)? != b"\x89PNG\r\n\x1a\n" {
            return Ok(told);
        }
        while let [l0, l1, l2, l3, name @ ..] = &*take(8)?
            && name != b"IDAT"
        {
            let content = take(u32::from_be_bytes([*l0, *l1, *l2, *l3]).into())?;
            match (name, &*content) {
                (b"cICP", &[primaries, transfer, ..]) => told.code_points = Some([primaries, transfer]),
                (b"sRGB", _) => told.is_srgb = true,
                (b"cHRM", content) if content.len() == 32 => {
                    let (parts, _) = content.as_chunks();
                    let at = |index: usize| u32::from_be_bytes(parts[index]) as f32 / 1e5;
                    // White stands first there.
                    told.chromaticities = Some([1, 2, 3, 0].map(|point| [at(2 * point), at(2 * point + 1)]));
                }
                _ => {}
            }
            take(4)?;
        }
        Ok(told)
    }
}

/// Whether an ICC profile has primaries, and others than sRGB's.
fn is_foreign(profile: &[u8]) -> bool {
    let found = [b"rXYZ", b"gXYZ", b"bXYZ"].map(|tag| xyz(profile, tag));
    let [Some(red), Some(green), Some(blue)] = found else { return false };
    let found = [red, green, blue];
    let mut pairs = found.as_flattened().iter().zip(REC709_ADAPTED.as_flattened());
    pairs.any(|(found, expected)| (found - expected).abs() > 1e-2)
}

/// The colour in the profile's tag of this name.
fn xyz(profile: &[u8], tag: &[u8; 4]) -> Option<[f32; 3]> {
    let word = |at: usize| Some(u32::from_be_bytes(*profile.get(at..)?.first_chunk()?));
    let tags = usize::try_from(word(128)?).ok()?;
    let entries = profile.get(132..)?.chunks_exact(12).take(tags);
    let place = entries.zip(0..).find(|(entry, _)| entry.starts_with(tag)).map(|(_, index)| 132 + 12 * index)?;
    let at = usize::try_from(word(place + 4)?).ok()?;
    // A signature, four bytes of nothing, and three numbers of 16 bits before the point and 16 after it.
    profile.get(at..)?.strip_prefix(b"XYZ ")?;
    let number = |index: usize| Some(word(at.checked_add(8 + 4 * index)?)?.cast_signed() as f32 / 65536.0);
    Some([number(0)?, number(1)?, number(2)?])
}
