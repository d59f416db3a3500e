//! The line protocol of a laser box.
//!
//! 115200 baud or a USB CDC port, ASCII. A line is `TEXT*HH` and LF (CR LF is accepted): HH is the CRC-8 of TEXT as two
//! hex digits, polynomial 0x07, initial value 0, as in holod's tracker protocol. At most 120 bytes.
//!
//! The host sends `N WORD ARGUMENTS`, N counting up; the box answers each line, in order, with `OK N …` or
//! `ERR N CODE`, and says by itself `!…` when it went dark.
//!
//! | Word | Arguments | Effect |
//! |---|---|---|
//! | `ID?` | | answers `OK N holod-laser-box 1 NAME`: this protocol, its version, and the box's name, `simulated` where it has no lasers |
//! | `SEQ` | `RGB`, period, `SYNC` or `HOST` | colour of each field, length of a colour frame, who starts windows; forgets `FLD` and `POW` |
//! | `FLD` | field 0..2, delay, width | that field's lit window, from the colour frame's start |
//! | `POW` | red, green, blue | optical power in µW |
//! | `TMO` | time | heartbeat timeout |
//! | `ARM` | `LIGHT` | may light lasers from now on; the argument is there so that no stray byte arms |
//! | `DISARM` | reason | all lasers out, not armed |
//! | `HB` | | heartbeat |
//! | `SYN` | time | a colour frame began (simulated boxes; a real one has a wire to the panel and answers `OK`) |
//! | `LIT` | `R`, `G` or `B`, on, off | lights one window (`HOST` only) |
//! | `STAT?` | | answers `OK N armed` or `dark`, and `R`, `G`, `B` or `-` for the laser that is lit |
//!
//! Times are whole nanoseconds, time points those of the clock that host and box share: the system's monotonic clock for
//! a simulated box.
//!
//! The box boots dark and needs `SEQ`, three `FLD`, `POW`, `TMO` and then `ARM`. It goes dark, and stays so until the next
//! `ARM`, on `DISARM`; on `!HBLOST`, no heartbeat for its timeout; on `!SYNCLOST`, no sync for two colour frames
//! (`SYNC` only); and on `!LINE`, a line that it does not understand while armed.

use std::fmt::{self, Write as _};

use holod_calibration::Colour;

use super::Refusal;

/// Longest line without its LF, bytes.
pub const LINE_BYTES_MAX: usize = 120;
/// How a box of this protocol answers `ID?`.
pub const IDENTITY: &str = "holod-laser-box 1";
/// The name of a box without lasers.
pub const SIMULATED: &str = "simulated";
/// The argument of `ARM`.
pub const ARM_TOKEN: &str = "LIGHT";

/// CRC-8 of `bytes`: polynomial 0x07, initial value 0, not reflected.
pub fn crc8(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |crc, &byte| {
        (0..8).fold(crc ^ byte, |crc: u8, _| if crc & 0x80 != 0 { (crc << 1) ^ 0x07 } else { crc << 1 })
    })
}

/// The text of a received line (without LF), where its checksum is right.
pub fn checked(line: &[u8]) -> Option<&str> {
    let line = line.strip_suffix(b"\r").unwrap_or(line);
    let line = std::str::from_utf8(line).ok().filter(|line| line.is_ascii())?;
    let (text, crc) = line.rsplit_once('*')?;
    let sound = crc.len() == 2 && crc.bytes().all(|digit| digit.is_ascii_hexdigit());
    let given = u8::from_str_radix(crc, 16).ok().filter(|_| sound)?;
    (given == crc8(text.as_bytes())).then_some(text)
}

/// A line under construction, in fixed memory.
#[derive(Clone, Debug)]
pub struct Line {
    bytes: [u8; LINE_BYTES_MAX + 4],
    length: usize,
}

impl Line {
    /// `text` with checksum and LF.
    ///
    /// # Panics
    /// Where `text` is longer than [`LINE_BYTES_MAX`] less the checksum, which no line of the protocol is.
    pub fn new(text: fmt::Arguments<'_>) -> Self {
        let mut line = Self { bytes: [0; LINE_BYTES_MAX + 4], length: 0 };
        line.write_fmt(text).expect("a protocol line fits");
        let crc = crc8(line.as_bytes());
        writeln!(line, "*{crc:02X}").expect("a protocol line fits");
        line
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
}

impl Default for LineBuffer {
    fn default() -> Self {
        Self { bytes: [0; LINE_BYTES_MAX], length: 0, too_long: false }
    }
}

impl LineBuffer {
    /// Takes in `bytes` and calls `line` for each line that they complete, without its LF; a line that is too long is
    /// given as an empty one, which no checksum fits.
    pub fn feed(&mut self, bytes: &[u8], mut line: impl FnMut(&[u8])) {
        for &byte in bytes {
            if byte == b'\n' {
                line(if self.too_long { &[] } else { &self.bytes[..self.length] });
                self.length = 0;
                self.too_long = false;
            } else if self.length < LINE_BYTES_MAX {
                self.bytes[self.length] = byte;
                self.length += 1;
            } else {
                self.too_long = true;
            }
        }
    }
}

/// The letter of a colour.
pub fn letter(colour: Colour) -> char {
    match colour {
        Colour::Red => 'R',
        Colour::Green => 'G',
        Colour::Blue => 'B',
    }
}

/// The colour of a letter.
pub fn colour_of(text: &str) -> Option<Colour> {
    let mut letters = text.chars();
    let first = letters.next().filter(|_| letters.as_str().is_empty())?;
    Colour::ALL.into_iter().find(|&colour| letter(colour) == first)
}

const CODES: [(Refusal, &str); 7] = [
    (Refusal::NotProgrammed, "PROGRAM"),
    (Refusal::NotArmed, "DARK"),
    (Refusal::Armed, "ARMED"),
    (Refusal::Overlap, "OVERLAP"),
    (Refusal::Late, "LATE"),
    (Refusal::Trigger, "TRIGGER"),
    (Refusal::Malformed, "LINE"),
];

/// The code of a refusal.
pub fn code(refusal: Refusal) -> &'static str {
    CODES.iter().find(|(known, _)| *known == refusal).map_or("LINE", |(_, code)| code)
}

/// The refusal of a code; an unknown code is a line not understood, by us.
pub fn refusal(code: &str) -> Refusal {
    CODES.iter().find(|(_, known)| *known == code).map_or(Refusal::Malformed, |(refusal, _)| *refusal)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_the_one_of_the_catalogue() {
        assert_eq!(crc8(b"123456789"), 0xF4);
    }

    #[test]
    fn a_line_comes_back_and_any_damaged_bit_is_noticed() {
        let line = Line::new(format_args!("7 LIT G {} {}", 123_456_789, 987_654_321));
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
    fn lines_are_cut_wherever_the_bytes_come_apart() {
        let mut buffer = LineBuffer::default();
        let mut lines: Vec<Vec<u8>> = Vec::new();
        for bytes in [&b"on"[..], b"e\ntwo\n", b"", b"\nthr"] {
            buffer.feed(bytes, |line| lines.push(line.to_vec()));
        }
        buffer.feed(&[b'x'; 500], |line| lines.push(line.to_vec()));
        buffer.feed(b"\nfour\n", |line| lines.push(line.to_vec()));
        assert_eq!(lines, [&b"one"[..], b"two", b"", b"", b"four"]);
    }

    #[test]
    fn refusals_and_colours_come_back() {
        for (known, text) in CODES {
            assert_eq!(refusal(code(known)), known);
            assert_eq!(code(known), text);
        }
        for colour in Colour::ALL {
            assert_eq!(colour_of(&letter(colour).to_string()), Some(colour));
        }
        assert_eq!(colour_of("RG"), None);
        assert_eq!(colour_of(""), None);
    }
}
