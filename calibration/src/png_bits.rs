//! How many bits the greys of a PNG have: decoders stretch fewer than 8 to 8, and do not say so.

use std::io::{self, Read};

/// Bits of each grey of a PNG without colours or palette, 1 to 16; none of any other file.
///
/// # Errors
/// The file cannot be read.
pub fn png_grey_bits(file: impl Read) -> io::Result<Option<u8>> {
    /// A signature, and a chunk with its length, its name, width, height, bits and kind of colours.
    const BYTES: usize = 8 + 4 + 4 + 4 + 4 + 1 + 1;
    let mut header = Vec::new();
    file.take(BYTES as u64).read_to_end(&mut header)?;
    let is_png = header.len() == BYTES && header.starts_with(b"\x89PNG\r\n\x1a\n") && header[12..16] == *b"IHDR";
    // Grey, and grey with alpha.
    Ok((is_png && matches!(header[25], 0 | 4)).then(|| header[24]))
}
