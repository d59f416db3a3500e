//! A log's bytes as they should have been stored: unpacked from gzip and turned from UTF-16 into UTF-8, both told by
//! their first bytes.

use std::io::{self, BufRead, BufReader, Read};

use flate2::bufread::MultiGzDecoder;

/// Bytes read at a time.
const BUFFER_BYTES: usize = 1 << 18;
const GZIP: &[u8] = b"\x1F\x8B";
const UTF8_MARK: &[u8] = b"\xEF\xBB\xBF";
const UTF16_LE_MARK: &[u8] = b"\xFF\xFE";
const UTF16_BE_MARK: &[u8] = b"\xFE\xFF";

/// `source` without gzip, UTF-16 and byte order mark.
///
/// Of a bomb of gzip nothing is kept but the samples in it, and [`LogBuilder`](super::LogBuilder) bounds those.
pub(super) fn plain(source: impl Read + 'static) -> io::Result<Box<dyn BufRead>> {
    let mut reader = BufReader::with_capacity(BUFFER_BYTES, source);
    if reader.fill_buf()?.starts_with(GZIP) {
        text(BufReader::with_capacity(BUFFER_BYTES, MultiGzDecoder::new(reader)))
    } else {
        text(reader)
    }
}

fn text(mut reader: BufReader<impl Read + 'static>) -> io::Result<Box<dyn BufRead>> {
    // A gzip member may begin with fewer bytes than a mark has: what was peeked at is put back in front.
    let mut mark = [0; 3];
    let mut known = 0;
    while known < mark.len() {
        match reader.read(&mut mark[known..]) {
            Ok(0) => break,
            Ok(count) => known += count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    let begins = &mark[..known];
    let (skip, encoding) = if begins.starts_with(UTF8_MARK) {
        (UTF8_MARK.len(), None)
    } else if begins.starts_with(UTF16_LE_MARK) {
        (UTF16_LE_MARK.len(), Some(u16::from_le_bytes as fn([u8; 2]) -> u16))
    } else if begins.starts_with(UTF16_BE_MARK) {
        (UTF16_BE_MARK.len(), Some(u16::from_be_bytes as fn([u8; 2]) -> u16))
    } else {
        (0, None)
    };
    let whole = io::Cursor::new(begins[skip..].to_vec()).chain(reader);
    Ok(match encoding {
        None => Box::new(whole),
        Some(unit) => Box::new(BufReader::with_capacity(
            BUFFER_BYTES,
            Utf16 { source: whole, unit, high: None, text: [0; 4], left: 0..0 },
        )),
    })
}

/// UTF-16 read as UTF-8; half a surrogate pair becomes U+FFFD, a last odd byte nothing.
struct Utf16<R> {
    source: R,
    unit: fn([u8; 2]) -> u16,
    /// The first half of a pair whose second half was no second half, to be given next.
    high: Option<u16>,
    text: [u8; 4],
    /// What of `text` has not been given yet.
    left: std::ops::Range<usize>,
}

impl<R: BufRead> Utf16<R> {
    fn next_unit(&mut self) -> io::Result<Option<u16>> {
        if let Some(unit) = self.high.take() {
            return Ok(Some(unit));
        }
        let mut bytes = [0; 2];
        match self.source.read_exact(&mut bytes) {
            Ok(()) => Ok(Some((self.unit)(bytes))),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn next_char(&mut self) -> io::Result<Option<char>> {
        let Some(first) = self.next_unit()? else { return Ok(None) };
        if !(0xD800..0xDC00).contains(&first) {
            return Ok(Some(char::from_u32(u32::from(first)).unwrap_or(char::REPLACEMENT_CHARACTER)));
        }
        let Some(second) = self.next_unit()? else { return Ok(Some(char::REPLACEMENT_CHARACTER)) };
        let pair = char::decode_utf16([first, second]).next();
        Ok(Some(pair.and_then(Result::ok).unwrap_or_else(|| {
            self.high = Some(second);
            char::REPLACEMENT_CHARACTER
        })))
    }
}

impl<R: BufRead> Read for Utf16<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut used = 0;
        while used < out.len() {
            if self.left.is_empty() {
                let Some(next) = self.next_char()? else { break };
                self.left = 0..next.encode_utf8(&mut self.text).len();
            }
            let count = self.left.len().min(out.len() - used);
            out[used..used + count].copy_from_slice(&self.text[self.left.start..self.left.start + count]);
            self.left.start += count;
            used += count;
        }
        Ok(used)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::GzEncoder;

    use super::*;

    fn read(bytes: Vec<u8>) -> io::Result<String> {
        let mut text = String::new();
        plain(io::Cursor::new(bytes))?.read_to_string(&mut text)?;
        Ok(text)
    }

    fn gzip(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
        encoder.write_all(bytes).expect("a Vec takes all");
        encoder.finish().expect("a Vec takes all")
    }

    fn utf16(text: &str, big: bool) -> Vec<u8> {
        let bytes = |unit: u16| if big { unit.to_be_bytes() } else { unit.to_le_bytes() };
        format!("\u{feff}{text}").encode_utf16().flat_map(bytes).collect()
    }

    #[test]
    fn each_encoding_reads_as_the_same_text() {
        let text = "Time [\u{b5}s]\t\u{1F441}\r\n1,5\n";
        for bytes in
            [text.as_bytes().to_vec(), format!("\u{feff}{text}").into_bytes(), utf16(text, false), utf16(text, true)]
        {
            assert_eq!(read(gzip(&bytes)).expect("reads"), text);
            assert_eq!(read(bytes).expect("reads"), text);
        }
    }

    #[test]
    fn short_and_damaged_inputs_are_read_as_far_as_they_go() {
        for text in ["", "a", "ab"] {
            assert_eq!(read(text.into()).expect("reads"), text);
        }
        // Two halves in the wrong order, a half at the end, an odd byte.
        assert_eq!(
            read(b"\xFF\xFE\x41\xD8a\0\x41\xDCb\0\x41\xD8c".to_vec()).expect("reads"),
            "\u{fffd}a\u{fffd}b\u{fffd}"
        );
        let packed = gzip(b"P1,1,2,L,3,1\n");
        assert!(read(packed[..packed.len() - 4].to_vec()).is_err(), "a cut archive is an error, not a shorter log");
    }

    #[test]
    fn archives_in_a_row_are_one_log() {
        let both = [gzip(b"\xEF"), gzip(b"\xBB\xBFone\n"), gzip(b"two\n")].concat();
        assert_eq!(read(both).expect("reads"), "one\ntwo\n");
    }
}
