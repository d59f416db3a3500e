//! UTF-16 text as UTF-8: some Windows programs write their exports so.

use std::io::{self, BufRead, Read};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

/// The byte order that a file's byte order mark tells, if it is one of UTF-16.
pub(super) fn order(begins: &[u8]) -> Option<ByteOrder> {
    match begins {
        // The mark of little-endian UTF-32 begins with that of UTF-16.
        [0xFF, 0xFE, 0, 0, ..] => None,
        [0xFF, 0xFE, ..] => Some(ByteOrder::Little),
        [0xFE, 0xFF, ..] => Some(ByteOrder::Big),
        _ => None,
    }
}

/// Reads UTF-8 out of UTF-16, the byte order mark left out; what is no text becomes U+FFFD.
pub(super) struct Transcoded<R> {
    reader: R,
    order: ByteOrder,
    high: Option<u16>,
    /// Encoded and not yet read.
    ready: [u8; 8],
    from: usize,
    to: usize,
}

impl<R: BufRead> Transcoded<R> {
    pub(super) const fn new(reader: R, order: ByteOrder) -> Self {
        Self { reader, order, high: None, ready: [0; 8], from: 0, to: 0 }
    }

    fn unit(&mut self) -> io::Result<Option<u16>> {
        let mut bytes = [0; 2];
        for byte in &mut bytes {
            let Some(&next) = self.reader.fill_buf()?.first() else { return Ok(None) };
            *byte = next;
            self.reader.consume(1);
        }
        Ok(Some(match self.order {
            ByteOrder::Little => u16::from_le_bytes(bytes),
            ByteOrder::Big => u16::from_be_bytes(bytes),
        }))
    }

    fn put(&mut self, code: char) {
        self.to += code.encode_utf8(&mut self.ready[self.to..]).len();
    }

    /// Makes some bytes ready; none at the end.
    fn encode(&mut self) -> io::Result<()> {
        (self.from, self.to) = (0, 0);
        while self.to == 0 {
            let unit = self.unit()?;
            if let Some(high) = self.high.take() {
                let pair = unit.filter(|unit| (0xDC00..0xE000).contains(unit)).and_then(|low| {
                    char::from_u32(0x1_0000 + ((u32::from(high) - 0xD800) << 10) + (u32::from(low) - 0xDC00))
                });
                self.put(pair.unwrap_or(char::REPLACEMENT_CHARACTER));
                if pair.is_some() {
                    return Ok(());
                }
            }
            match unit {
                None => return Ok(()),
                Some(0xFEFF) => {}
                Some(unit @ 0xD800..0xDC00) => self.high = Some(unit),
                Some(unit) => {
                    self.put(char::from_u32(unit.into()).unwrap_or(char::REPLACEMENT_CHARACTER));
                }
            }
        }
        Ok(())
    }
}

impl<R: BufRead> Read for Transcoded<R> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut count = 0;
        while count < into.len() {
            if self.from == self.to {
                self.encode()?;
                if self.from == self.to {
                    break;
                }
            }
            into[count] = self.ready[self.from];
            self.from += 1;
            count += 1;
        }
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn transcoded(units: &[u16], order: ByteOrder) -> String {
        let bytes: Vec<u8> = match order {
            ByteOrder::Little => units.iter().flat_map(|unit| unit.to_le_bytes()).collect(),
            ByteOrder::Big => units.iter().flat_map(|unit| unit.to_be_bytes()).collect(),
        };
        let mut text = String::new();
        Transcoded::new(&bytes[..], order).read_to_string(&mut text).expect("UTF-8");
        text
    }

    #[test]
    fn a_lone_half_of_a_pair_becomes_a_replacement() {
        assert_eq!(
            transcoded(&[0xFEFF, 0x41, 0xD83D, 0x42, 0xDE00, 0xD83D], ByteOrder::Little),
            "A\u{fffd}B\u{fffd}\u{fffd}"
        );
        assert_eq!(order(b"\xFF\xFEa\0"), Some(ByteOrder::Little));
        assert_eq!(order(b"\xFE\xFF\0a"), Some(ByteOrder::Big));
        assert_eq!(order(b"\xFF\xFE\0\0"), None);
        assert_eq!(order(b"Time"), None);
    }

    proptest! {
        #[test]
        fn what_std_decodes_is_what_is_read(units in proptest::collection::vec(any::<u16>(), 0..40)) {
            prop_assume!(!units.contains(&0xFEFF));
            for order in [ByteOrder::Little, ByteOrder::Big] {
                prop_assert_eq!(transcoded(&units, order), String::from_utf16_lossy(&units));
            }
        }
    }
}
