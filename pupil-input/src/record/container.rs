//! The file that holds what a link brought, byte for byte, with the time at which each piece came.
//!
//! All numbers are little-endian. The file begins with
//!
//! | Bytes | |
//! |---|---|
//! | 8 | `HOLOD`, 0x1A, CR, LF |
//! | 4 | version of the format, 1 |
//! | 4 | length of the header, n |
//! | n | the header, TOML: `spec`, `profile`, `profile_toml` where it is a user's own, `hid_descriptor` in hexadecimals for a HID device, `datagrams`, `scale_mm_per_unit` where the run had one (at its start), `holod`, `t_started_ns` (the host's monotonic clock) and `started_unix_ns` (the wall clock at the same moment) |
//! | 4 | CRC-32 of all of these |
//!
//! and goes on with records:
//!
//! | Bytes | |
//! |---|---|
//! | 4 | length of the payload, n, at most 65536 |
//! | 1 | kind |
//! | 8 | time in ns on the host's monotonic clock, not negative and at most 2^60; of bytes, when they were read |
//! | 4 | number of the connection, counted from 1 |
//! | n | payload |
//! | 4 | CRC-32 of the record up to here |
//!
//! | Kind | | Payload |
//! |---|---|---|
//! | 1 | the link was opened | none |
//! | 2 | bytes came: one read of a stream, or one message of a link that has messages | the bytes |
//! | 3 | the link was lost | none |
//! | 4 | pieces found no room on their way to the file | how many, 8 bytes |
//! | 5 | the run ended as it should | none |
//!
//! A file whose last record is not of kind 5 was cut off. Where a record is incomplete, or its checksum is wrong, reading
//! goes on at the next byte from which on one is whole: so damage costs what it hit. Behind a record of kind 5, and from
//! the beginning of another recording on, nothing is read.

use std::io::{self, Read};

use crc::{CRC_32_ISO_HDLC, Crc};
use holod_calibration::TimeNs;
use toml_edit::value;

/// What a recording begins with.
pub(crate) const MAGIC: [u8; 8] = *b"HOLOD\x1a\r\n";
const VERSION: u32 = 1;
/// Longest payload of a record.
pub(crate) const MAX_PAYLOAD_BYTES: usize = 1 << 16;
/// Times of records lie between 0 and this, 36 years after the machine was started; differences of two then stay within
/// i64 whatever a file holds.
const LATEST: TimeNs = TimeNs(1 << 60);
/// Longest header, the text alone.
const MAX_HEADER_BYTES: usize = 1 << 20;
/// A record's bytes before its payload.
pub(crate) const RECORD_HEAD_BYTES: usize = 17;

/// CRC-32 of Ethernet and zip.
pub(crate) fn crc32(bytes: &[u8]) -> u32 {
    static CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
    CRC.checksum(bytes)
}

/// What a record tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Connected = 1,
    Bytes = 2,
    Disconnected = 3,
    Lost = 4,
    End = 5,
}

impl Kind {
    fn from_byte(byte: u8) -> Option<Self> {
        [Self::Connected, Self::Bytes, Self::Disconnected, Self::Lost, Self::End]
            .into_iter()
            .find(|kind| *kind as u8 == byte)
    }
}

/// A record without its payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct RecordHead {
    pub(crate) kind: Kind,
    /// When, on the host's monotonic clock.
    pub(crate) t: TimeNs,
    pub(crate) connection: u32,
}

impl RecordHead {
    /// The bytes of the record up to its payload of `length` bytes.
    pub(crate) fn encode(&self, length: usize) -> [u8; RECORD_HEAD_BYTES] {
        let mut bytes = [0; RECORD_HEAD_BYTES];
        bytes[..4].copy_from_slice(&(length as u32).to_le_bytes());
        bytes[4] = self.kind as u8;
        bytes[5..13].copy_from_slice(&self.t.0.to_le_bytes());
        bytes[13..].copy_from_slice(&self.connection.to_le_bytes());
        bytes
    }

    /// The head and the length of its payload; none where it is of no record.
    pub(crate) fn decode(bytes: &[u8]) -> Option<(Self, usize)> {
        let length = u32_at(bytes, 0) as usize;
        let t = TimeNs(i64::from_le_bytes(bytes[5..13].try_into().expect("eight bytes")));
        let possible = length <= MAX_PAYLOAD_BYTES && (TimeNs(0)..=LATEST).contains(&t);
        let kind = Kind::from_byte(bytes[4]).filter(|_| possible)?;
        Some((Self { kind, t, connection: u32_at(bytes, 13) }, length))
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

/// What a recording says of itself.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Header {
    pub(crate) spec: String,
    /// The name of the profile by which it was read.
    pub(crate) profile: String,
    /// The profile itself, where it is none that ships with holod.
    pub(crate) profile_toml: Option<String>,
    /// The report descriptor of a HID device, by which fields are found that the profile names by usage.
    pub(crate) hid_descriptor: Option<Vec<u8>>,
    /// Whether each piece is a message of its own, at whose end the decoder's stream ends.
    pub(crate) datagrams: bool,
    /// Millimetres for one unit of its figures, where the run had a scale at its start.
    pub(crate) scale_mm_per_unit: Option<f64>,
    /// When the run began, on the host's monotonic clock.
    pub(crate) t_started: TimeNs,
    /// The same on the wall clock, ns since 1970.
    pub(crate) started_unix_ns: i64,
}

impl Header {
    /// The beginning of a file.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut text = toml_edit::DocumentMut::new();
        text["spec"] = value(&self.spec);
        text["profile"] = value(&self.profile);
        if let Some(profile_toml) = &self.profile_toml {
            text["profile_toml"] = value(profile_toml);
        }
        if let Some(descriptor) = &self.hid_descriptor {
            text["hid_descriptor"] = value(descriptor.iter().map(|byte| format!("{byte:02x}")).collect::<String>());
        }
        text["datagrams"] = value(self.datagrams);
        if let Some(scale) = self.scale_mm_per_unit {
            text["scale_mm_per_unit"] = value(scale);
        }
        text["holod"] = value(env!("CARGO_PKG_VERSION"));
        text["t_started_ns"] = value(self.t_started.0);
        text["started_unix_ns"] = value(self.started_unix_ns);
        framed(&text.to_string())
    }

    fn parse(text: &str) -> Option<Self> {
        let text: toml_edit::DocumentMut = text.parse().ok()?;
        let string = |key: &str| text.get(key)?.as_str().map(str::to_owned);
        let integer = |key: &str| text.get(key)?.as_integer();
        Some(Self {
            spec: string("spec")?,
            profile: string("profile")?,
            profile_toml: string("profile_toml"),
            hid_descriptor: match text.get("hid_descriptor") {
                None => None,
                Some(item) => Some(bytes_of_hex(item.as_str()?)?),
            },
            datagrams: text.get("datagrams")?.as_bool()?,
            // A scale that is none is no fault of the bytes.
            scale_mm_per_unit: text
                .get("scale_mm_per_unit")
                .and_then(toml_edit::Item::as_float)
                .filter(|scale| scale.is_normal() && *scale > 0.0),
            t_started: TimeNs(integer("t_started_ns")?),
            started_unix_ns: integer("started_unix_ns")?,
        })
    }
}

/// The text of a header with all that is around it.
fn framed(text: &str) -> Vec<u8> {
    let mut bytes = MAGIC.to_vec();
    bytes.extend(VERSION.to_le_bytes());
    bytes.extend((text.len() as u32).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend(crc32(&bytes).to_le_bytes());
    bytes
}

/// A recording whose header, TOML, reads as `change` makes it; its records stay as they are. Nothing where `recording`
/// begins with no header, or none would be left of it.
pub fn with_header(recording: &[u8], change: impl FnOnce(&str) -> String) -> Option<Vec<u8>> {
    let before = RawReader::new(recording).ok()?;
    let records = before.input;
    let text = str::from_utf8(&recording[16..recording.len() - records.len() - 4]).ok()?;
    let text = change(text);
    Header::parse(&text)?;
    let mut changed = framed(&text);
    changed.extend(records);
    Some(changed)
}

/// What the link of a recording brought, put together however it was read, with a line's end where a message ended or
/// the stream broke off; behind it what is in the file and no whole record of this recording. Nothing where `recording` begins with no
/// header.
pub fn payloads(recording: &[u8]) -> Option<Vec<u8>> {
    let mut reader = RawReader::new(recording).ok()?;
    let datagrams = reader.header.datagrams;
    let mut brought = Vec::with_capacity(recording.len());
    let mut behind: Vec<u8> = Vec::new();
    let mut from = reader.at as usize;
    while let Ok(Some((head, payload))) = reader.next() {
        brought.extend(payload);
        if datagrams || head.kind != Kind::Bytes {
            brought.push(b'\n');
        }
        let record_bytes = RECORD_HEAD_BYTES + payload.len() + 4;
        let to = reader.at as usize;
        behind.extend(&recording[from..to - record_bytes]);
        from = to;
    }
    let to = reader.at as usize;
    behind.extend(&recording[from..to]);
    behind.extend(&recording[to + reader.end_bytes..]);
    brought.push(b'\n');
    brought.extend(behind);
    Some(brought)
}

fn bytes_of_hex(text: &str) -> Option<Vec<u8>> {
    let pairs = text.as_bytes().chunks(2);
    pairs.map(|pair| u8::from_str_radix(str::from_utf8(pair).ok().filter(|pair| pair.len() == 2)?, 16).ok()).collect()
}

/// Why a file is not read as a recording.
#[derive(Debug)]
pub(crate) enum HeaderFault {
    Io(io::Error),
    /// What was found; a header is what was expected.
    Bad(String),
}

/// How a recording ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ending {
    /// With the record of its end, and nothing behind it.
    Whole,
    /// Between two records, without that of its end.
    CutOff,
    /// Within a record, with this many bytes from there to the end of the file, and no whole record in them.
    Torn { unread_bytes: u64 },
    /// With something of `bytes` bytes behind it, from byte `at` of the file (counted from 0) on.
    Followed { at: u64, bytes: u64 },
}

impl Ending {
    /// What is to be told of it, if it is no proper end.
    fn in_words(self) -> Option<String> {
        let lost = "what came in the last second of that run may be lost";
        match self {
            Self::Whole => None,
            Self::CutOff => Some(format!("the recording was cut off; {lost}")),
            Self::Torn { unread_bytes } if unread_bytes <= LONGEST_RECORD as u64 => {
                Some(format!("the recording is torn: its last {unread_bytes} bytes are no whole record; {lost}"))
            }
            Self::Torn { unread_bytes } => Some(format!(
                "the recording is torn: its last {unread_bytes} bytes hold no whole record, and what came in them is lost"
            )),
            Self::Followed { at, bytes } => Some(format!(
                "behind the recording's end {bytes} more bytes were not read: where they are another recording, \
                 `tail -c +{} FILE > OTHER` makes a file of its own of it",
                at.saturating_add(1)
            )),
        }
    }
}

/// Places in a recording that hold no whole record, with whole ones behind them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Damage {
    places: u64,
    /// Byte of the file at which the first begins, counted from 0.
    at: u64,
    bytes: u64,
    /// Between the records before and behind, in all.
    span: TimeNs,
}

impl Damage {
    fn in_words(self) -> Option<String> {
        let Self { places, at, bytes, span } = self;
        let more = match places {
            0 | 1 => String::new(),
            2 => " and at one more place".into(),
            _ => format!(" and at {} more places", places - 1),
        };
        (places > 0).then(|| {
            format!(
                "the recording is damaged at byte {at}{more}: {bytes} bytes are no whole record and were left out, with \
                 what came within {:.3} s there; what lies behind was read",
                span.seconds()
            )
        })
    }
}

/// A record's bytes at most.
const LONGEST_RECORD: usize = RECORD_HEAD_BYTES + MAX_PAYLOAD_BYTES + 4;
/// Bytes read at a time, at least.
const READ_BYTES: usize = 4096;
/// A search for the next record may sum this many bytes, and as many more as follow for each byte that it passes over:
/// what was made up to look like the beginnings of records does not take hours.
const SUMMED: u64 = 1 << 22;
const SUMMED_PER_BYTE: u64 = 64;

/// Reads a recording record by record, in constant memory.
pub(crate) struct RawReader<R> {
    input: R,
    header: Header,
    /// What was read; the next record is looked for from `from` on.
    window: Vec<u8>,
    from: usize,
    /// Byte of the file at which the record that was handed out last ends, counted from 0; at the end of a whole
    /// recording that at which the record that says so begins.
    at: u64,
    /// Length of that record, 0 where there is none.
    end_bytes: usize,
    t_last: Option<TimeNs>,
    damage: Damage,
    ending: Option<Ending>,
}

impl<R: Read> RawReader<R> {
    /// Reads the header; records follow.
    pub(crate) fn new(mut input: R) -> Result<Self, HeaderFault> {
        let mut bytes = Vec::new();
        take(&mut input, 16, &mut bytes).map_err(HeaderFault::Io)?;
        if bytes.len() < 16 || bytes[..8] != MAGIC {
            return Err(HeaderFault::Bad("no beginning of a recording".into()));
        }
        let (version, length) = (u32_at(&bytes, 8), u32_at(&bytes, 12) as usize);
        if version != VERSION {
            return Err(HeaderFault::Bad(format!("version {version} of the format of recordings")));
        }
        if length > MAX_HEADER_BYTES {
            return Err(HeaderFault::Bad(format!("a header of {length} bytes")));
        }
        take(&mut input, length + 4, &mut bytes).map_err(HeaderFault::Io)?;
        let text = bytes.get(16..16 + length).filter(|_| bytes.len() == 20 + length);
        let sound = text.filter(|_| crc32(&bytes[..16 + length]) == u32_at(&bytes, 16 + length));
        let header = sound
            .and_then(|text| Header::parse(std::str::from_utf8(text).ok()?))
            .ok_or_else(|| HeaderFault::Bad("a torn header".into()))?;
        Ok(Self {
            input,
            header,
            window: Vec::with_capacity(LONGEST_RECORD),
            from: 0,
            at: bytes.len() as u64,
            end_bytes: 0,
            t_last: None,
            damage: Damage::default(),
            ending: None,
        })
    }

    pub(crate) const fn header(&self) -> &Header {
        &self.header
    }

    /// The next record; none at the end, of which [`Self::flaws`] then tells. After the first call it allocates
    /// nothing.
    pub(crate) fn next(&mut self) -> io::Result<Option<(RecordHead, &[u8])>> {
        if self.ending.is_some() {
            return Ok(None);
        }
        let (mut skipped, mut summed) = (0, 0);
        let (head, length) = loop {
            if !self.has(RECORD_HEAD_BYTES)? {
                let unread_bytes = skipped + (self.window.len() - self.from) as u64;
                return self.end(if unread_bytes == 0 { Ending::CutOff } else { Ending::Torn { unread_bytes } });
            }
            if self.window[self.from..].starts_with(&MAGIC) {
                self.damaged(skipped, None);
                return self.followed(skipped);
            }
            if let Some((head, length)) = RecordHead::decode(&self.window[self.from..]) {
                let end = RECORD_HEAD_BYTES + length;
                if summed <= SUMMED + SUMMED_PER_BYTE * skipped && self.has(end + 4)? {
                    summed += end as u64;
                    let record = &self.window[self.from..];
                    if crc32(&record[..end]) == u32_at(record, end) {
                        break (head, length);
                    }
                }
            }
            self.from += 1;
            skipped += 1;
        };
        self.damaged(skipped, Some(head.t));
        self.t_last = Some(head.t);
        self.at += skipped;
        let (begin, record_bytes) = (self.from + RECORD_HEAD_BYTES, RECORD_HEAD_BYTES + length + 4);
        self.from += record_bytes;
        if head.kind == Kind::End {
            self.end_bytes = record_bytes;
            return self.followed(record_bytes as u64);
        }
        self.at += record_bytes as u64;
        Ok(Some((head, &self.window[begin..begin + length])))
    }

    /// What is wrong with the recording, for people, once all of it has been read.
    pub(crate) fn flaws(&self) -> impl Iterator<Item = String> + use<R> {
        [self.damage.in_words(), self.ending.and_then(Ending::in_words)].into_iter().flatten()
    }

    /// Whether the window holds `count` bytes from `from` on; reads what is missing, up to the longest record.
    fn has(&mut self, count: usize) -> io::Result<bool> {
        if self.window.len() - self.from < count {
            self.window.drain(..self.from);
            self.from = 0;
            let room = LONGEST_RECORD - self.window.len();
            take(&mut self.input, count.max(READ_BYTES).min(room), &mut self.window)?;
        }
        Ok(self.window.len() - self.from >= count)
    }

    /// `bytes` bytes behind the record that was read last are no record; the next one is of `t_next`.
    fn damaged(&mut self, bytes: u64, t_next: Option<TimeNs>) {
        if bytes == 0 {
            return;
        }
        if self.damage.places == 0 {
            self.damage.at = self.at;
        }
        self.damage.places += 1;
        self.damage.bytes += bytes;
        if let Some((last, next)) = self.t_last.zip(t_next) {
            self.damage.span = self.damage.span + (next - last).max(TimeNs(0));
        }
    }

    /// The recording ends `passed` bytes on, and the file may not.
    fn followed(&mut self, passed: u64) -> io::Result<Option<(RecordHead, &[u8])>> {
        let bytes = (self.window.len() - self.from) as u64 + io::copy(&mut self.input, &mut io::sink())?;
        self.end(if bytes == 0 { Ending::Whole } else { Ending::Followed { at: self.at + passed, bytes } })
    }

    fn end(&mut self, ending: Ending) -> io::Result<Option<(RecordHead, &[u8])>> {
        self.ending = Some(ending);
        Ok(None)
    }
}

/// Appends `count` bytes, fewer at the end of the input.
fn take(input: &mut impl Read, count: usize, out: &mut Vec<u8>) -> io::Result<()> {
    input.by_ref().take(count as u64).read_to_end(out).map(drop)
}

/// Appends a record with its check sum to `out`.
pub(crate) fn encode_record(head: &RecordHead, payload: &[u8], out: &mut Vec<u8>) {
    let begins = out.len();
    out.extend(head.encode(payload.len()));
    out.extend(payload);
    out.extend(crc32(&out[begins..]).to_le_bytes());
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::SampleEye;
    use crate::import::Recording;
    use crate::import::raw::RawLog;
    use crate::wire::hid_descriptor::HOLOD_HID_DESCRIPTOR;

    fn header() -> Header {
        Header {
            spec: "serial:/dev/\"odd\"\nname".into(),
            profile: "holod".into(),
            profile_toml: Some("name = '''x'''\n".into()),
            hid_descriptor: Some(vec![0x05, 0xFF, 0x00]),
            datagrams: true,
            scale_mm_per_unit: Some(0.001),
            t_started: TimeNs(-5),
            started_unix_ns: 1_700_000_000_000_000_000,
        }
    }

    type Read = Vec<(RecordHead, Vec<u8>)>;
    const NONE: Damage = Damage { places: 0, at: 0, bytes: 0, span: TimeNs(0) };

    fn read(bytes: &[u8]) -> Result<(Read, Ending, Damage), HeaderFault> {
        let mut reader = RawReader::new(bytes)?;
        assert_eq!(reader.header(), &header());
        let mut records = Vec::new();
        while let Some((head, payload)) = reader.next().expect("memory reads") {
            records.push((head, payload.to_vec()));
        }
        Ok((records, reader.ending.expect("it has ended"), reader.damage))
    }

    #[test]
    fn a_header_is_changed_and_the_records_stay() {
        let records = vec![(RecordHead { kind: Kind::Bytes, t: TimeNs(3), connection: 1 }, b"odd".to_vec())];
        let (bytes, _) = file(&records);
        let changed = with_header(&bytes, |text| text.replace("odd", "even")).expect("a header");
        let mut reader = RawReader::new(&changed[..]).expect("a header");
        assert_eq!(reader.header().spec, "serial:/dev/\"even\"\nname");
        assert_eq!(reader.next().expect("memory reads").map(|(_, payload)| payload.to_vec()), Some(b"odd".to_vec()));
        assert!(with_header(&bytes, |_| "spec = 3".into()).is_none(), "no header is left");
        assert!(with_header(&bytes[..40], str::to_owned).is_none(), "it is torn");
    }

    #[test]
    fn what_a_link_brought_is_put_together_and_what_is_torn_stands_behind() {
        let record = |kind, payload: &[u8]| (RecordHead { kind, t: TimeNs(3), connection: 1 }, payload.to_vec());
        let records = [
            record(Kind::Connected, b""),
            record(Kind::Bytes, b"an"),
            record(Kind::Bytes, b"na"),
            record(Kind::Disconnected, b""),
            record(Kind::Bytes, b"x"),
        ];
        let file = |datagrams| {
            let mut bytes = Header { datagrams, ..header() }.encode();
            records.iter().for_each(|(head, payload)| encode_record(head, payload, &mut bytes));
            bytes
        };
        let brought = |bytes: &[u8]| payloads(bytes).map(|brought| String::from_utf8_lossy(&brought).into_owned());
        assert_eq!(brought(&file(false)).as_deref(), Some("\nanna\nx\n"));
        assert_eq!(brought(&file(true)).as_deref(), Some("\nan\nna\n\nx\n\n"));
        assert_eq!(brought(&[&file(false)[..], b"torn"].concat()).as_deref(), Some("\nanna\nx\ntorn"));
        assert_eq!(brought(&[&file(false)[..], &end(), b"more"].concat()).as_deref(), Some("\nanna\nx\nmore"));
        assert_eq!(brought(&file(false)[..40]), None);
    }

    fn any_record() -> impl Strategy<Value = (RecordHead, Vec<u8>)> {
        let kinds = [Kind::Connected, Kind::Bytes, Kind::Disconnected, Kind::Lost];
        (prop::sample::select(kinds.to_vec()), 0..=LATEST.0, any::<u32>(), prop::collection::vec(any::<u8>(), 0..60))
            .prop_map(|(kind, t, connection, payload)| (RecordHead { kind, t: TimeNs(t), connection }, payload))
    }

    /// A file and where each of its records ends.
    fn file(records: &Read) -> (Vec<u8>, Vec<usize>) {
        let mut bytes = header().encode();
        let mut ends = vec![bytes.len()];
        for (head, payload) in records {
            encode_record(head, payload, &mut bytes);
            ends.push(bytes.len());
        }
        (bytes, ends)
    }

    fn end() -> Vec<u8> {
        let mut bytes = Vec::new();
        encode_record(&RecordHead { kind: Kind::End, t: TimeNs(9), connection: 1 }, &[], &mut bytes);
        bytes
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(records in prop::collection::vec(any_record(), 0..12)) {
            let (mut bytes, _) = file(&records);
            prop_assert_eq!(read(&bytes).expect("reads"), (records.clone(), Ending::CutOff, NONE));
            bytes.extend(end());
            prop_assert_eq!(read(&bytes).expect("reads"), (records, Ending::Whole, NONE));
        }

        /// What a killed process leaves: a file that ends anywhere.
        #[test]
        fn a_file_cut_anywhere_keeps_every_whole_record(records in prop::collection::vec(any_record(), 1..6)) {
            let (bytes, ends) = file(&records);
            for length in 0..bytes.len() {
                let cut = &bytes[..length];
                if length < ends[0] {
                    prop_assert!(matches!(read(cut), Err(HeaderFault::Bad(_))));
                    continue;
                }
                let whole = ends.iter().filter(|end| **end <= length).count() - 1;
                let unread_bytes = (length - ends[whole]) as u64;
                let ending = if unread_bytes == 0 { Ending::CutOff } else { Ending::Torn { unread_bytes } };
                prop_assert_eq!(read(cut).expect("reads"), (records[..whole].to_vec(), ending, NONE));
            }
        }

        /// What a power cut may leave: blocks that were never written.
        #[test]
        fn a_tail_of_zeros_or_rubbish_is_no_record(
            records in prop::collection::vec(any_record(), 0..6),
            zeros in any::<bool>(),
            tail in prop::collection::vec(any::<u8>(), 1..100),
        ) {
            let (mut bytes, _) = file(&records);
            let unread_bytes = tail.len() as u64;
            if zeros { bytes.resize(bytes.len() + tail.len(), 0) } else { bytes.extend(tail) }
            prop_assert_eq!(read(&bytes).expect("reads"), (records, Ending::Torn { unread_bytes }, NONE));
        }

        #[test]
        fn no_wrong_bit_passes_and_what_lies_behind_it_is_read(
            records in prop::collection::vec(any_record(), 1..5), at in any::<prop::sample::Index>(), bit in 0..8_u8,
        ) {
            let (mut bytes, ends) = file(&records);
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
            match read(&bytes) {
                Err(_) => prop_assert!(at < ends[0]),
                Ok((read, ending, damage)) => {
                    let hit = ends.iter().filter(|end| **end <= at).count() - 1;
                    prop_assert_eq!(&read[..], &[&records[..hit], &records[hit + 1..]].concat());
                    let bytes = (ends[hit + 1] - ends[hit]) as u64;
                    if hit + 1 == records.len() {
                        prop_assert_eq!((ending, damage), (Ending::Torn { unread_bytes: bytes }, NONE));
                    } else {
                        prop_assert_eq!(ending, Ending::CutOff);
                        prop_assert_eq!((damage.places, damage.at, damage.bytes), (1, ends[hit] as u64, bytes));
                    }
                }
            }
        }

        #[test]
        fn rubbish_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..200), begins in any::<bool>()) {
            let bytes = if begins { [&MAGIC[..], &[1, 0, 0, 0], &bytes].concat() } else { bytes };
            prop_assert!(matches!(RawReader::new(&bytes[..]), Err(HeaderFault::Bad(_))));
        }
    }

    #[test]
    fn a_time_that_no_clock_shows_is_no_record() {
        for t in [i64::MIN, -1, LATEST.0 + 1, i64::MAX] {
            let head = RecordHead { kind: Kind::Bytes, t: TimeNs(t), connection: 1 };
            let (bytes, _) = file(&vec![(head, b"x".to_vec())]);
            assert!(matches!(read(&bytes), Ok((records, Ending::Torn { .. }, NONE)) if records.is_empty()), "{t}");
        }
    }

    #[test]
    fn damage_is_told_with_what_it_costs_and_where_it_is() {
        let record = |ms: i64| {
            (RecordHead { kind: Kind::Bytes, t: TimeNs(ms * 1_000_000), connection: 1 }, vec![7; 40 + ms as usize])
        };
        let records: Vec<_> = (0..2000).map(record).collect();
        let (mut bytes, ends) = file(&records);
        bytes.extend(end());
        // The length of one, so that what follows seems to be its payload, and two others.
        bytes[ends[3] + 1] = 0xFF;
        bytes[ends[700] + 30] ^= 1;
        bytes[ends[701] + 30] ^= 1;
        let mut reader = RawReader::new(&bytes[..]).expect("a header");
        let mut read = 0;
        while reader.next().expect("memory reads").is_some() {
            read += 1;
        }
        let told: Vec<_> = reader.flaws().collect();
        assert_eq!((read, told.len()), (1997, 1), "{told:?}");
        let left_out = (ends[4] - ends[3]) + (ends[702] - ends[700]);
        let at = format!("damaged at byte {} and at one more place: {left_out} bytes", ends[3]);
        assert!(told[0].contains(&at) && told[0].contains("within 0.005 s"), "{told:?}");
        let brought = payloads(&bytes).expect("a header");
        let hit = &bytes[ends[3]..ends[4]];
        assert!(brought.windows(hit.len()).any(|piece| piece == hit), "a report sees what is in no record, too");
    }

    #[test]
    fn another_recording_behind_is_not_read_as_this_one() {
        let record = |t: i64| (RecordHead { kind: Kind::Bytes, t: TimeNs(t), connection: 1 }, b"abc".to_vec());
        let (cut_off, _) = file(&vec![record(1), record(2)]);
        let whole = [&cut_off[..], &end()].concat();
        for (first, torn) in [(&whole, 0), (&cut_off, 0), (&cut_off, 5)] {
            let bytes = [&first[..], &b"torn!"[..torn], &whole].concat();
            let (read, ending, damage) = read(&bytes).expect("reads");
            let behind = Ending::Followed { at: (first.len() + torn) as u64, bytes: whole.len() as u64 };
            assert_eq!((read.len(), ending, damage.bytes), (2, behind, torn as u64));
        }
    }

    #[test]
    fn what_is_made_up_to_look_like_records_is_passed_over() {
        // Each fifth byte seems to begin a record of the greatest length: to sum up each of them would take an hour.
        let bytes = [header().encode(), b"\xFF\xFF\x00\x00\x01".repeat(400_000)].concat();
        let (read, ending, _) = read(&bytes).expect("reads");
        assert_eq!((read.len(), ending), (0, Ending::Torn { unread_bytes: 2_000_000 }));
    }

    #[test]
    fn a_scale_that_is_none_is_none() {
        for (scale, read) in [("0.05", Some(0.05)), ("-1.0", None), ("0.0", None), ("inf", None), ("\"x\"", None)] {
            let text = Header { scale_mm_per_unit: Some(2.0), ..header() }.encode();
            let bytes = with_header(&text, |text| text.replace("= 2.0", &format!("= {scale}"))).expect("a header");
            assert_eq!(RawReader::new(&bytes[..]).expect("a header").header().scale_mm_per_unit, read, "{scale}");
        }
    }

    #[test]
    fn another_version_is_named() {
        let mut bytes = header().encode();
        bytes[8] = 7;
        assert!(matches!(read(&bytes), Err(HeaderFault::Bad(found)) if found.contains("version 7")));
    }

    /// Report 1 of `holod-hid`: 1 s, number 7, left 3.25 mm seen, right not.
    const REPORT: [u8; 15] = [1, 0x40, 0x42, 0x0F, 0, 7, 0, 0xB2, 0x0C, 255, 1, 0, 0, 0, 0];

    #[test]
    fn a_recording_by_usage_is_read_by_the_descriptor_in_it() {
        let file = |hid_descriptor| {
            let header = Header {
                spec: "hid:1209:0001,profile=example-usages".into(),
                profile: "example-usages".into(),
                profile_toml: None,
                hid_descriptor,
                datagrams: true,
                scale_mm_per_unit: None,
                t_started: TimeNs(0),
                started_unix_ns: 0,
            };
            let mut bytes = header.encode();
            for (kind, payload) in [(Kind::Connected, &[][..]), (Kind::Bytes, &REPORT), (Kind::End, &[])] {
                encode_record(&RecordHead { kind, t: TimeNs(5), connection: 0 }, payload, &mut bytes);
            }
            let file = tempfile::NamedTempFile::new().expect("a file");
            std::fs::write(file.path(), bytes).expect("writes");
            file
        };
        let described = file(Some(HOLOD_HID_DESCRIPTOR.to_vec()));
        let recording = Recording::read(described.path()).expect("reads");
        let samples: Vec<_> = recording.samples().collect();
        assert_eq!(samples.len(), 2);
        assert_eq!((samples[0].eye, samples[0].diameter_mm, samples[0].valid), (SampleEye::Left, 3.25, true));
        assert_eq!((samples[1].eye, samples[1].valid), (SampleEye::Right, false));
        assert!(RawLog::open(described.path()).is_ok());

        let message = Recording::read(file(Some(vec![0xC0])).path()).expect_err("is refused").to_string();
        assert!(message.contains("the report descriptor is faulty at byte 0"), "{message}");
        assert!(Recording::read(file(None).path()).is_err(), "without a descriptor there are no samples");
    }
}
