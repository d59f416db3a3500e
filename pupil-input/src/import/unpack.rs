//! A log's bytes as they should have been stored: unpacked from gzip and turned from UTF-16 into UTF-8, with and
//! without a byte order mark, both told by their first bytes.

use std::cell::Cell;
use std::io::{self, BufRead, BufReader, Read};
use std::rc::Rc;

use flate2::bufread::GzDecoder;

/// Bytes read at a time.
const BUFFER_BYTES: usize = 1 << 18;
const GZIP: &[u8] = b"\x1F\x8B";
const UTF8_MARK: &[u8] = b"\xEF\xBB\xBF";
const UTF16_LE_MARK: &[u8] = b"\xFF\xFE";
const UTF16_BE_MARK: &[u8] = b"\xFE\xFF";

/// Why an archive was not unpacked to its end, if it was not.
pub(super) type Shortened = Rc<Cell<Option<&'static str>>>;

/// `source` without gzip, UTF-16 and byte order mark; of an archive that is not whole what can be unpacked, as `gunzip`
/// does, with a word in `shortened`.
///
/// Of a bomb of gzip nothing is kept but the samples in it, and [`LogBuilder`](super::LogBuilder) bounds those.
pub(super) fn plain(source: impl Read + 'static, shortened: &Shortened) -> io::Result<Box<dyn BufRead>> {
    let mut reader = BufReader::with_capacity(BUFFER_BYTES, source);
    if reader.fill_buf()?.starts_with(GZIP) {
        let member = Some(GzDecoder::new(reader));
        let archive = Archive { member, unpacked: false, shortened: Rc::clone(shortened) };
        text(BufReader::with_capacity(BUFFER_BYTES, archive))
    } else {
        text(reader)
    }
}

/// The members of a gzip archive as one stream.
struct Archive<R: BufRead> {
    /// None at the end.
    member: Option<GzDecoder<R>>,
    /// Whether any byte has been unpacked: before that a cut is an error, afterwards a shorter log.
    unpacked: bool,
    shortened: Shortened,
}

impl<R: BufRead> Read for Archive<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while let Some(member) = &mut self.member {
            match member.read(out) {
                Ok(0) if !out.is_empty() => self.member = self.next_member()?,
                Ok(count) => {
                    self.unpacked = true;
                    return Ok(count);
                }
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof && self.unpacked => {
                    self.shortened.set(Some("the gzip archive is cut off: copy the file again"));
                    self.member = None;
                }
                Err(error) => return Err(error),
            }
        }
        Ok(0)
    }
}

impl<R: BufRead> Archive<R> {
    /// What follows the member that has ended, if it is another.
    fn next_member(&mut self) -> io::Result<Option<GzDecoder<R>>> {
        let Some(mut source) = self.member.take().map(GzDecoder::into_inner) else { return Ok(None) };
        // Archives on tape are filled up with zeros.
        let mut is_padding = false;
        loop {
            let buffer = match source.fill_buf() {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                buffer => buffer?,
            };
            match buffer.iter().position(|byte| *byte != 0) {
                _ if buffer.is_empty() => return Ok(None),
                // The buffer may hold one byte of the next member's two.
                Some(0) if !is_padding && (buffer.starts_with(GZIP) || buffer == &GZIP[..1]) => {
                    return Ok(Some(GzDecoder::new(source)));
                }
                Some(_) => {
                    let behind = "bytes behind the end of the gzip archive are none of it, and were not read";
                    self.shortened.set(Some(behind));
                    return Ok(None);
                }
                None => {
                    is_padding = true;
                    let count = buffer.len();
                    source.consume(count);
                }
            }
        }
    }
}

fn text(mut reader: BufReader<impl Read + 'static>) -> io::Result<Box<dyn BufRead>> {
    // A gzip member may begin with fewer bytes than a mark has: what was peeked at is put back in front.
    let mut mark = [0; UNMARKED_BYTES];
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
    } else if is_unmarked_utf16(begins) {
        (0, Some(u16::from_le_bytes as fn([u8; 2]) -> u16))
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

/// This many bytes tell UTF-16 without a mark: no text has a 0, and no binary log begins with so many of them.
const UNMARKED_BYTES: usize = 8;

/// Whether a log begins with ASCII of two bytes a letter, little-endian.
fn is_unmarked_utf16(begins: &[u8]) -> bool {
    let is_ascii = |unit: &[u8]| matches!(unit, [b'\t' | b'\r' | b'\n' | b' '..=b'~', 0]);
    begins.len() == UNMARKED_BYTES && begins.chunks(2).all(is_ascii)
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
        read_with_word(bytes).map(|(text, _)| text)
    }

    fn read_with_word(bytes: Vec<u8>) -> io::Result<(String, Option<&'static str>)> {
        let (mut text, shortened) = (String::new(), Shortened::default());
        plain(io::Cursor::new(bytes), &shortened)?.read_to_string(&mut text)?;
        Ok((text, shortened.take()))
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
        // Without a mark, where it begins in ASCII.
        let unmarked = |text: &str| utf16(text, false).split_off(2);
        assert_eq!(read(unmarked(text)).expect("reads"), text);
        assert_eq!(read(gzip(&unmarked(text))).expect("reads"), text);
        for other in [&b"T\0i\0m\0e"[..], b"T\0i\0\0\0e\0", b"T\0i\0\x01\0e\0", b"\0T\0i\0m\0e"] {
            assert_eq!(read(other.to_vec()).expect("reads").as_bytes(), other);
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
    }

    #[test]
    fn an_archive_that_is_not_whole_is_unpacked_as_far_as_it_goes_and_said_to_be_so() {
        let text: String = (0..4000).map(|k| format!("P1,{k},{},L,3,1\n", k * k)).collect();
        let packed = gzip(text.as_bytes());
        for cut in [1, 4, 8, 9, packed.len() / 2] {
            let (unpacked, told) = read_with_word(packed[..packed.len() - cut].to_vec()).expect("reads");
            assert!(text.starts_with(&unpacked) && unpacked.len() > text.len() / 3, "{cut}: {}", unpacked.len());
            assert!(told.is_some_and(|told| told.contains("cut off")), "{cut}");
        }
        for (behind, told) in [(&b"\0\0\0\0"[..], false), (b"rubbish", true), (b"\0\0x", true), (b"\x1Fx", true)] {
            let read = read_with_word([&packed, behind].concat());
            match read {
                Ok((unpacked, word)) => assert_eq!((unpacked == text, word.is_some()), (true, told), "{behind:?}"),
                Err(error) => panic!("{behind:?}: {error}"),
            }
        }
        // Of nothing there is no log, and a wrong checksum is no cut.
        assert!(read(packed[..10].to_vec()).is_err());
        let mut wrong = packed.clone();
        let at = wrong.len() - 6;
        wrong[at] ^= 1;
        assert!(read(wrong).is_err());
    }

    #[test]
    fn archives_in_a_row_are_one_log() {
        let both = [gzip(b"\xEF"), gzip(b"\xBB\xBFone\n"), gzip(b"two\n")].concat();
        assert_eq!(read(both).expect("reads"), "one\ntwo\n");
    }
}
