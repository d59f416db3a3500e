//! Lines: `TEXT*HH` and LF, HH the CRC-8 of TEXT.

use core::fmt::{self, Write as _};

use crc::{CRC_8_SMBUS, Crc};

/// Longest line without its LF, bytes.
pub const LINE_BYTES_MAX: usize = 120;

/// Polynomial 0x07, initial value 0, not reflected.
const CRC: Crc<u8> = Crc::<u8>::new(&CRC_8_SMBUS);

/// The text of a received line (without LF), where its checksum is right.
pub fn checked(line: &[u8]) -> Option<&str> {
    let line = line.strip_suffix(b"\r").unwrap_or(line);
    let line = core::str::from_utf8(line).ok().filter(|line| line.is_ascii())?;
    let (text, given) = line.rsplit_once('*')?;
    let sound = given.len() == 2 && given.bytes().all(|digit| digit.is_ascii_hexdigit());
    let given = u8::from_str_radix(given, 16).ok().filter(|_| sound)?;
    (given == CRC.checksum(text.as_bytes())).then_some(text)
}

/// A line that is ready to be sent, in fixed memory.
#[derive(Clone, Debug)]
pub struct Line {
    bytes: [u8; LINE_BYTES_MAX + 1],
    length: usize,
}

impl Line {
    /// `text` with its checksum and LF; nothing where that would be longer than [`LINE_BYTES_MAX`].
    pub fn new(text: impl fmt::Display) -> Option<Self> {
        let mut line = Self { bytes: [0; LINE_BYTES_MAX + 1], length: 0 };
        write!(line, "{text}").ok()?;
        let crc = CRC.checksum(line.as_bytes());
        writeln!(line, "*{crc:02X}").ok()?;
        Some(line)
    }

    /// The bytes to send.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }
}

impl fmt::Write for Line {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let end = self.length + text.len();
        self.bytes.get_mut(self.length..end).ok_or(fmt::Error)?.copy_from_slice(text.as_bytes());
        self.length = end;
        Ok(())
    }
}

/// Cuts a byte stream into lines, in fixed memory.
#[derive(Clone, Debug)]
pub struct LineBuffer {
    bytes: [u8; LINE_BYTES_MAX],
    length: usize,
    too_long: bool,
    complete: bool,
}

impl Default for LineBuffer {
    fn default() -> Self {
        Self { bytes: [0; LINE_BYTES_MAX], length: 0, too_long: false, complete: false }
    }
}

impl LineBuffer {
    /// Takes in `byte`; the line that it completes, without its LF. A line that is too long is given as an empty one,
    /// which no checksum fits.
    pub fn push(&mut self, byte: u8) -> Option<&[u8]> {
        if core::mem::take(&mut self.complete) {
            self.length = 0;
            self.too_long = false;
        }
        if byte != b'\n' {
            match self.bytes.get_mut(self.length) {
                Some(place) => {
                    *place = byte;
                    self.length += 1;
                }
                None => self.too_long = true,
            }
            return None;
        }
        self.complete = true;
        Some(if self.too_long { &[] } else { &self.bytes[..self.length] })
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::vec::Vec;

    use super::*;

    #[test]
    fn the_checksum_is_the_one_of_the_catalogue() {
        assert_eq!(CRC.checksum(b"123456789"), 0xF4);
    }

    #[test]
    fn a_line_comes_back_and_any_damaged_bit_is_noticed() {
        let line = Line::new("7 LIT G 123456789 987654321").unwrap();
        let (&end, text) = line.as_bytes().split_last().unwrap();
        assert_eq!(end, b'\n');
        assert_eq!(checked(text), Some("7 LIT G 123456789 987654321"));
        assert_eq!(checked(&[text, b"\r"].concat()), Some("7 LIT G 123456789 987654321"));
        for byte in 0..text.len() {
            for bit in 0..8 {
                let mut damaged = text.to_vec();
                damaged[byte] ^= 1 << bit;
                // A checksum's letter in the other case is the same checksum.
                let same = damaged.eq_ignore_ascii_case(text) && byte + 2 >= text.len();
                assert_eq!(checked(&damaged).is_some(), same, "byte {byte} bit {bit}");
            }
        }
        for line in [&b""[..], b"*", b"7 HB", b"7 HB*", b"7 HB*+1", b"\xff\xfe*00"] {
            assert_eq!(checked(line), None);
        }
    }

    #[test]
    fn the_longest_line_fits_and_no_longer_one() {
        let text = [b'x'; LINE_BYTES_MAX];
        let text = core::str::from_utf8(&text).unwrap();
        let line = Line::new(&text[..LINE_BYTES_MAX - 3]).unwrap();
        let mut buffer = LineBuffer::default();
        let received = line.as_bytes().iter().filter_map(|&byte| buffer.push(byte).map(<[u8]>::to_vec)).next();
        assert_eq!(received.as_deref().and_then(checked), Some(&text[..LINE_BYTES_MAX - 3]));
        assert!(Line::new(&text[..LINE_BYTES_MAX - 2]).is_none());
    }

    #[test]
    fn lines_are_cut_wherever_the_bytes_come_apart() {
        let mut buffer = LineBuffer::default();
        let long = [&[b'x'; 500][..], b"\n"].concat();
        let stream = [&b"one\ntwo\n\nthr"[..], &long, b"four\n"].concat();
        let lines: Vec<_> = stream.iter().filter_map(|&byte| buffer.push(byte).map(<[u8]>::to_vec)).collect();
        assert_eq!(lines, [&b"one"[..], b"two", b"", b"", b"four"]);
    }
}
