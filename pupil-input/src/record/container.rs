//! The file that holds what a link brought, byte for byte, with the time at which each piece came.
//!
//! All numbers are little-endian. The file begins with
//!
//! | Bytes | |
//! |---|---|
//! | 8 | `HOLOD`, 0x1A, CR, LF |
//! | 4 | version of the format, 1 |
//! | 4 | length of the header, n |
//! | n | the header, TOML: `spec`, `profile`, `profile_toml` where it is a user's own, `hid_descriptor` in hexadecimals for a HID device, `datagrams`, `holod`, `t_started_ns` (the host's monotonic clock) and `started_unix_ns` (the wall clock at the same moment) |
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
//! A file whose last record is not of kind 5 was cut off. A record that is incomplete, or whose checksum is wrong, is
//! where the file was torn; nothing behind it is read.

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
#[derive(Clone, Debug, PartialEq, Eq)]
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
/// the stream broke off; behind it what is in the file and no whole record. Nothing where `recording` begins with no
/// header.
pub fn payloads(recording: &[u8]) -> Option<Vec<u8>> {
    let mut reader = RawReader::new(recording).ok()?;
    let datagrams = reader.header.datagrams;
    let mut brought = Vec::with_capacity(recording.len());
    while let Ok(Some((head, payload))) = reader.next() {
        brought.extend(payload);
        if datagrams || head.kind != Kind::Bytes {
            brought.push(b'\n');
        }
    }
    let behind = match reader.ending {
        Some(Ending::Torn { unread_bytes }) => &recording[recording.len() - unread_bytes as usize..],
        _ => reader.input,
    };
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
    /// As it should.
    Whole,
    /// Between two records.
    CutOff,
    /// Within a record, with so many bytes from there to the end of the file.
    Torn { unread_bytes: u64 },
}

impl Ending {
    /// What is to be told of it, if it is no proper end.
    pub(crate) fn in_words(self) -> Option<String> {
        let lost = "what came in the last second of that run may be lost";
        match self {
            Self::Whole => None,
            Self::CutOff => Some(format!("the recording was cut off; {lost}")),
            Self::Torn { unread_bytes } => {
                Some(format!("the recording is torn: its last {unread_bytes} bytes are no whole record; {lost}"))
            }
        }
    }
}

/// Reads a recording record by record, in constant memory.
pub(crate) struct RawReader<R> {
    input: R,
    header: Header,
    record: Vec<u8>,
    ending: Option<Ending>,
}

impl<R: Read> RawReader<R> {
    /// Reads the header.
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
        let record = Vec::with_capacity(RECORD_HEAD_BYTES + MAX_PAYLOAD_BYTES + 4);
        Ok(Self { input, header, record, ending: None })
    }

    pub(crate) const fn header(&self) -> &Header {
        &self.header
    }

    /// The next record; none at the end, of which [`Self::ending`] then tells. After the first call it allocates
    /// nothing.
    pub(crate) fn next(&mut self) -> io::Result<Option<(RecordHead, &[u8])>> {
        if self.ending.is_some() {
            return Ok(None);
        }
        self.record.clear();
        take(&mut self.input, RECORD_HEAD_BYTES, &mut self.record)?;
        if self.record.is_empty() {
            self.ending = Some(Ending::CutOff);
            return Ok(None);
        }
        let whole = self.record.len() == RECORD_HEAD_BYTES;
        let Some((head, length)) = whole.then(|| RecordHead::decode(&self.record)).flatten() else {
            return self.torn();
        };
        take(&mut self.input, length + 4, &mut self.record)?;
        let end = RECORD_HEAD_BYTES + length;
        if self.record.len() != end + 4 || crc32(&self.record[..end]) != u32_at(&self.record, end) {
            return self.torn();
        }
        if head.kind == Kind::End {
            self.ending = Some(Ending::Whole);
            return Ok(None);
        }
        Ok(Some((head, &self.record[RECORD_HEAD_BYTES..end])))
    }

    /// How it ended, once all of it has been read.
    pub(crate) const fn ending(&self) -> Option<Ending> {
        self.ending
    }

    fn torn(&mut self) -> io::Result<Option<(RecordHead, &[u8])>> {
        let behind = io::copy(&mut self.input, &mut io::sink())?;
        self.ending = Some(Ending::Torn { unread_bytes: self.record.len() as u64 + behind });
        Ok(None)
    }
}

/// Appends `count` bytes, fewer at the end of the input.
fn take(input: &mut impl Read, count: usize, out: &mut Vec<u8>) -> io::Result<()> {
    input.by_ref().take(count as u64).read_to_end(out).map(drop)
}

/// Appends a record.
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
            t_started: TimeNs(-5),
            started_unix_ns: 1_700_000_000_000_000_000,
        }
    }

    type Read = Vec<(RecordHead, Vec<u8>)>;

    fn read(bytes: &[u8]) -> Result<(Read, Ending), HeaderFault> {
        let mut reader = RawReader::new(bytes)?;
        assert_eq!(reader.header(), &header());
        let mut records = Vec::new();
        while let Some((head, payload)) = reader.next().expect("memory reads") {
            records.push((head, payload.to_vec()));
        }
        Ok((records, reader.ending().expect("it has ended")))
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
            prop_assert_eq!(read(&bytes).expect("reads"), (records.clone(), Ending::CutOff));
            bytes.extend(end());
            prop_assert_eq!(read(&bytes).expect("reads"), (records, Ending::Whole));
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
                prop_assert_eq!(read(cut).expect("reads"), (records[..whole].to_vec(), ending));
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
            prop_assert_eq!(read(&bytes).expect("reads"), (records, Ending::Torn { unread_bytes }));
        }

        #[test]
        fn no_wrong_bit_passes(records in prop::collection::vec(any_record(), 1..5), at in any::<prop::sample::Index>(),
                               bit in 0..8_u8) {
            let (mut bytes, ends) = file(&records);
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
            match read(&bytes) {
                Err(_) => prop_assert!(at < ends[0]),
                Ok((read, ending)) => {
                    let before = ends.iter().filter(|end| **end <= at).count() - 1;
                    prop_assert_eq!(&read[..], &records[..before]);
                    let is_torn = matches!(ending, Ending::Torn { .. });
                    prop_assert!(is_torn);
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
            assert!(matches!(read(&bytes), Ok((records, Ending::Torn { .. })) if records.is_empty()), "{t}");
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
