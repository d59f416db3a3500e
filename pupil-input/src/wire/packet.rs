//! Binary packets with a sync word, as a stream.
//!
//! The sync word may stand in the data, too. So after bytes that belong to no packet, a packet is believed by its
//! checksum or, where it has none, by the sync word of the next one just behind it. As long as packet follows upon
//! packet, each is read as soon as it is whole.

use super::buffer::Buffer;
use super::checksum::{Checksum, ChecksumKind};
use super::field::{Bytes, Field, Fields, Layout, Message, place};
use super::{Decoder, WireEvent, WireFault};

/// Bytes of the longest packet.
pub const MAX_PACKET_BYTES: usize = 4096;

/// How packets are read. Every offset counts from the sync word's first byte.
#[derive(Clone, Debug, PartialEq)]
pub struct PacketSettings {
    /// The bytes that begin a packet, at least one.
    pub sync: Vec<u8>,
    /// How long a packet is.
    pub length: PacketLength,
    /// What holds a packet to be whole.
    pub checksum: Option<PacketChecksum>,
    /// At which bytes time, eye and pupils stand.
    pub layout: Layout<Field>,
}

/// How long a packet is, with sync word and checksum.
#[derive(Clone, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum PacketLength {
    /// Always this many bytes.
    Fixed(usize),
    /// It tells it itself.
    Told {
        field: Field,
        /// What the figure there lacks to the whole length.
        adds: i64,
        /// A packet is at least as long as this.
        least: usize,
        /// And at most as long as this.
        most: usize,
    },
}

/// A packet's checksum: where it stands, and which bytes it covers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PacketChecksum {
    /// What kind of sum it is.
    pub kind: ChecksumKind,
    /// Where it stands; negative where it is counted from the packet's end.
    pub at: i32,
    /// Whether the highest byte of two comes first.
    pub big_endian: bool,
    /// The first byte that it covers.
    pub from: i32,
    /// The first byte behind those that it covers.
    pub to: i32,
}

/// Bytes in, samples out; the same samples however the bytes are split.
#[derive(Clone, Debug)]
pub struct PacketDecoder {
    sync: Vec<u8>,
    length: PacketLength,
    checksum: Option<(Checksum, PacketChecksum)>,
    fields: Fields<Field>,
    buffer: Buffer,
    footing: Footing,
}

/// How the bytes before the next ones were understood.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Footing {
    /// There were none: the stream may begin inside a packet.
    Joining,
    /// They ended with a packet's end.
    Held,
    /// They belong to no packet; that has been told.
    Lost,
}

/// What stands at the beginning of some bytes.
enum Head {
    /// A packet of this length.
    Packet(usize),
    /// No packet, for this reason.
    None(WireFault),
    /// Too few bytes to tell.
    Open,
}

impl PacketDecoder {
    /// A decoder that starts at a packet's first byte.
    pub fn new(settings: &PacketSettings) -> Self {
        let most = match settings.length {
            PacketLength::Fixed(length) => length,
            PacketLength::Told { most, .. } => most,
        };
        Self {
            sync: settings.sync.clone(),
            length: settings.length.clone(),
            checksum: settings.checksum.clone().map(|checksum| (Checksum::new(checksum.kind), checksum)),
            fields: Fields::new(settings.layout.clone()),
            // A packet and the sync word behind it are in sight together.
            buffer: Buffer::new((most + settings.sync.len()).max(2048) * 2),
            footing: Footing::Held,
        }
    }

    /// A decoder for a stream that may be joined in the middle of a packet: what comes before the first whole one is
    /// [`WireEvent::Partial`].
    pub fn joining(settings: &PacketSettings) -> Self {
        Self { footing: Footing::Joining, ..Self::new(settings) }
    }

    /// Reads what the buffer holds, as far as it can be told.
    fn read(&mut self, ended: bool, on_event: &mut dyn FnMut(WireEvent)) {
        let held = self.buffer.held();
        let mut start = 0;
        while start < held.len() {
            let bytes = &held[start..];
            match self.head(bytes, ended) {
                Head::Packet(length) => {
                    let packet = &bytes[..length];
                    if let Err(fault) = self.fields.read(&Bytes(packet), on_event) {
                        on_event(WireEvent::Rejected(fault));
                    }
                    self.footing = Footing::Held;
                    start += length;
                }
                Head::None(fault) => {
                    match self.footing {
                        Footing::Joining => on_event(WireEvent::Partial),
                        Footing::Held => on_event(WireEvent::Rejected(fault)),
                        Footing::Lost => {}
                    }
                    self.footing = Footing::Lost;
                    let next = bytes[1..].iter().position(|byte| *byte == self.sync[0]);
                    start += 1 + next.unwrap_or(bytes.len() - 1);
                }
                Head::Open => break,
            }
        }
        self.buffer.drop_front(start);
    }

    fn head(&self, bytes: &[u8], ended: bool) -> Head {
        let sync = &self.sync[..];
        let seen = bytes.len().min(sync.len());
        if bytes[..seen] != sync[..seen] {
            return Head::None(WireFault::OutOfStep);
        }
        let length = match &self.length {
            PacketLength::Fixed(length) => *length,
            PacketLength::Told { field, adds, least, most } => {
                let Ok(figure) = Bytes(bytes).raw(field) else {
                    return if bytes.len() < *least { Head::Open } else { Head::None(WireFault::TooShort) };
                };
                let length = adds.saturating_add(figure.number() as i64);
                match usize::try_from(length) {
                    Ok(length) if length > *most => return Head::None(WireFault::TooLong),
                    Ok(length) if length >= *least => length,
                    _ => return Head::None(WireFault::TooShort),
                }
            }
        };
        let Some(packet) = bytes.get(..length) else { return Head::Open };
        if let Some((checksum, place)) = &self.checksum {
            let right = place.read(packet).is_some_and(|(sum, covered)| checksum.of(covered) == sum);
            return if right { Head::Packet(length) } else { Head::None(WireFault::BadChecksum) };
        }
        if self.footing == Footing::Held {
            return Head::Packet(length);
        }
        let behind = &bytes[length..];
        let seen = behind.len().min(sync.len());
        match behind[..seen] == sync[..seen] {
            false => Head::None(WireFault::OutOfStep),
            true if seen == sync.len() || (ended && seen == 0) => Head::Packet(length),
            true => Head::Open,
        }
    }
}

impl PacketChecksum {
    /// The sum that a packet carries, and the bytes that it covers.
    fn read<'a>(&self, packet: &'a [u8]) -> Option<(u16, &'a [u8])> {
        let at = place(self.at, packet.len())?;
        let bytes = packet.get(at..at.checked_add(self.kind.width())?)?;
        let sum = match *bytes {
            [low] => u16::from(low),
            [first, second] if self.big_endian => u16::from_be_bytes([first, second]),
            [first, second] => u16::from_le_bytes([first, second]),
            _ => return None,
        };
        let (from, to) = (place(self.from, packet.len())?, place(self.to, packet.len())?);
        Some((sum, packet.get(from..to)?))
    }
}

impl Decoder for PacketDecoder {
    fn push(&mut self, mut bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        while !bytes.is_empty() {
            bytes = self.buffer.fill(bytes);
            self.read(false, on_event);
        }
    }

    fn finish(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        self.read(true, on_event);
        self.buffer.clear();
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::TimeNs;
    use proptest::prelude::*;

    use super::*;
    use crate::SampleEye;
    use crate::profile::Profile;
    use crate::wire::field::{Figure, Literal, NumberType, PupilAt, SizeKind, SizeRule, TimeAt};
    use crate::wire::testing::{events_of, split_events};
    use crate::wire::{Crc, Format, WireSample};

    const CRC16: ChecksumKind =
        ChecksumKind::Crc(Crc { bits: 16, polynomial: 0x1021, initial: 0xFFFF, reflected: false, final_xor: 0 });

    const fn field(at: i32, kind: NumberType) -> Field {
        Field { at, kind, big_endian: false, shift: 0, mask: None }
    }

    /// Sync AA 55, a counter, a diameter in micrometres; no checksum.
    fn plain() -> PacketSettings {
        PacketSettings {
            sync: vec![0xAA, 0x55],
            length: PacketLength::Fixed(6),
            checksum: None,
            layout: Layout {
                time: Some(TimeAt { at: field(2, NumberType::U16), ns_per_tick: 1e6, wrap_bits: Some(16) }),
                sequence: None,
                eye: None,
                pupils: vec![PupilAt {
                    eye: Some(SampleEye::Left),
                    size: Figure { at: field(4, NumberType::U16), scale: 0.001, offset: 0.0 },
                    lost: vec![Literal::Number(0.0)],
                    confidence: None,
                    aperture: None,
                    valid: None,
                }],
                size: SizeRule { kind: SizeKind::Diameter, mm_per_unit: 1.0 },
            },
        }
    }

    /// The same with its length behind the sync word and a CRC at the end.
    fn told() -> PacketSettings {
        let mut settings = plain();
        settings.length = PacketLength::Told { field: field(2, NumberType::U8), adds: 5, least: 9, most: 20 };
        settings.checksum = Some(PacketChecksum { kind: CRC16, at: -2, big_endian: true, from: 0, to: -2 });
        settings.layout.time.as_mut().unwrap().at = field(3, NumberType::U16);
        settings.layout.pupils[0].size.at = field(5, NumberType::U16);
        settings
    }

    fn plain_packet(ms: u16, micrometres: u16) -> Vec<u8> {
        [&[0xAA, 0x55][..], &ms.to_le_bytes(), &micrometres.to_le_bytes()].concat()
    }

    fn told_packet(ms: u16, micrometres: u16, more: &[u8]) -> Vec<u8> {
        let length = [0xAA, 0x55, 4 + more.len() as u8];
        let body = [&length[..], &ms.to_le_bytes(), &micrometres.to_le_bytes(), more].concat();
        let sum = Checksum::new(CRC16).of(&body);
        [&body[..], &sum.to_be_bytes()].concat()
    }

    fn sample(ms: i64, diameter_mm: f32) -> WireEvent {
        WireEvent::Sample(WireSample {
            t_device: Some(TimeNs(ms * 1_000_000)),
            eye: SampleEye::Left,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: None,
            sequence: None,
            valid: diameter_mm > 0.0,
        })
    }

    fn decode(settings: &PacketSettings, bytes: &[u8]) -> Vec<WireEvent> {
        events_of(&mut PacketDecoder::new(settings), bytes)
    }

    #[test]
    fn known_packets_read_as_their_fields() {
        let bytes = [0xAA, 0x55, 0xE8, 0x03, 0xB2, 0x0C, 0xAA, 0x55, 0xE9, 0x03, 0x00, 0x00];
        assert_eq!(decode(&plain(), &bytes), [sample(1000, 3.25), sample(1001, 0.0)]);
        let bytes = [told_packet(65535, 3250, b""), told_packet(0, 3000, b"\xAA\x55more")].concat();
        assert_eq!(decode(&told(), &bytes), [sample(65535, 3.25), sample(65536, 3.0)]);
    }

    #[test]
    fn a_packet_in_step_is_told_with_its_last_byte() {
        let mut decoder = PacketDecoder::joining(&plain());
        let mut events = Vec::new();
        decoder.push(&[plain_packet(1, 3000), plain_packet(2, 3000)].concat(), &mut |event| events.push(event));
        // The first is held to be one by the sync word of the second.
        assert_eq!(events, [sample(1, 3.0), sample(2, 3.0)]);
        decoder.push(&plain_packet(3, 3000), &mut |event| events.push(event));
        assert_eq!(events.len(), 3);
    }

    #[test]
    fn each_fault_has_its_reason() {
        let packet = told_packet(1, 3000, b"");
        let mut wrong = packet.clone();
        wrong[4] ^= 1;
        let after = |bytes: &[u8]| decode(&told(), &[bytes, &packet].concat());
        let lost = |fault| [WireEvent::Rejected(fault), sample(1, 3.0)];
        assert_eq!(after(&wrong), lost(WireFault::BadChecksum));
        assert_eq!(after(b"rubbish"), lost(WireFault::OutOfStep));
        assert_eq!(after(&[0xAA, 0x55, 16]), lost(WireFault::TooLong));
        assert_eq!(after(&[0xAA, 0x55, 3]), lost(WireFault::TooShort));
        // What is cut off at the end is no fault.
        assert_eq!(decode(&told(), &packet[..8]), []);
    }

    #[test]
    fn the_sync_word_in_the_data_misleads_nobody() {
        // A stream that is joined just before a diameter that looks like the sync word.
        let packets: Vec<_> = (0..5).flat_map(|ms| plain_packet(ms, if ms == 0 { 0x55AA } else { 3000 })).collect();
        let events = events_of(&mut PacketDecoder::joining(&plain()), &packets[3..]);
        assert_eq!(events[0], WireEvent::Partial);
        assert_eq!(events[1..], [sample(1, 3.0), sample(2, 3.0), sample(3, 3.0), sample(4, 3.0)]);
    }

    #[test]
    fn the_shipped_examples_read_their_bytes() {
        let decoded = |name: &str, bytes: &[u8]| events_of(&mut *Profile::find(name).unwrap().decoder(), bytes);
        let body = [0xAA, 0x55, 9, 0, 0x40, 0x42, 0x0F, 0, 0xB2, 0x0C, 0, 0, 255, 51];
        let sum = Checksum::new(CRC16).of(&body);
        let events = decoded("example-packet", &[&body[..], &sum.to_le_bytes()].concat());
        let first = WireSample {
            t_device: Some(TimeNs(1_000_000_000)),
            eye: SampleEye::Left,
            diameter_mm: 3.25,
            confidence: 1.0,
            aperture_mm: None,
            sequence: Some(9),
            valid: true,
        };
        let second = WireSample { eye: SampleEye::Right, diameter_mm: 0.0, confidence: 0.2, valid: false, ..first };
        assert_eq!(events, [WireEvent::Sample(first), WireEvent::Sample(second)]);

        // Its count passes 0, and is anew where the time falls.
        let numbered = |number: u16, time_us: u32| {
            let body = [&[0xAA, 0x55][..], &number.to_le_bytes(), &time_us.to_le_bytes(), &body[8..]].concat();
            let sum = Checksum::new(CRC16).of(&body);
            [&body[..], &sum.to_le_bytes()].concat()
        };
        for (time_us, expected) in [(65_000_000, 65_538), (3_000, 2)] {
            let events = decoded("example-packet", &[numbered(65_000, 64_000_000), numbered(2, time_us)].concat());
            assert!(matches!(events[2], WireEvent::Sample(sample) if sample.sequence == Some(expected)), "{events:?}");
        }

        let frame = |number: u8| [0xFA, 0, 0, 0, 1, number, 0x10, 0, 0, 0, 0, 0];
        let events = decoded("asl-eye-trac", &[frame(0), frame(1)].concat());
        let [WireEvent::Sample(first), WireEvent::Sample(second)] = events[..] else { panic!("{events:?}") };
        assert_eq!((first.eye, first.diameter_mm, first.sequence), (SampleEye::Both, 4096.0, Some(256)));
        let step_ns = second.t_device.unwrap().0 - first.t_device.unwrap().0;
        assert!((step_ns - 16_666_667).abs() <= 1, "{step_ns}");
        assert!(matches!(Profile::find("asl-eye-trac").unwrap().format, Format::Packet(_)));
    }

    fn any_settings() -> impl Strategy<Value = PacketSettings> {
        prop_oneof![Just(plain()), Just(told())]
    }

    proptest! {
        #[test]
        fn the_split_of_the_bytes_does_not_matter_and_nothing_panics(
            settings in any_settings(),
            pieces in prop::collection::vec(
                prop_oneof![
                    (any::<u16>(), 0..9000_u16).prop_map(|(ms, size)| plain_packet(ms, size)),
                    (any::<u16>(), 0..9000_u16, any::<[u8; 3]>()).prop_map(|(ms, size, more)| told_packet(ms, size, &more)),
                    Just(vec![0xAA, 0x55]),
                    prop::collection::vec(any::<u8>(), 0..60),
                    (0..9000_usize).prop_map(|long| vec![0xAA; long]),
                ],
                0..12,
            ),
            cuts in prop::collection::vec(1..50_usize, 1..20),
        ) {
            let bytes = pieces.concat();
            let whole = events_of(&mut PacketDecoder::joining(&settings), &bytes);
            prop_assert_eq!(split_events(&mut PacketDecoder::joining(&settings), &bytes, &cuts), whole);
        }

        #[test]
        fn after_garbage_at_most_two_packets_are_lost(
            garbage in prop::collection::vec(any::<u8>(), 0..200),
            rows in prop::collection::vec((any::<u16>(), 1..9000_u16), 4..20),
            before in any::<bool>(),
        ) {
            // A clock that is monotonic, so that it unwraps in one way whichever packet is the first.
            let rows: Vec<_> = rows.into_iter().enumerate().map(|(ms, (_, size))| (ms as u16 + 10, size)).collect();
            let expected: Vec<_> =
                rows.iter().map(|(ms, size)| sample(i64::from(*ms), (f64::from(*size) * 0.001) as f32)).collect();
            let lead_in = if before { plain_packet(9, 3000) } else { Vec::new() };
            let packets: Vec<_> = rows.iter().flat_map(|(ms, size)| plain_packet(*ms, *size)).collect();
            let events = events_of(&mut PacketDecoder::joining(&plain()), &[&lead_in, &garbage, &packets[..]].concat());
            prop_assert!(events.ends_with(&expected[2..]), "{:?}", events);

            let lead_in = if before { told_packet(9, 3000, b"") } else { Vec::new() };
            let packets: Vec<_> = rows.iter().flat_map(|(ms, size)| told_packet(*ms, *size, b"")).collect();
            let events = events_of(&mut PacketDecoder::joining(&told()), &[&lead_in, &garbage, &packets[..]].concat());
            prop_assert!(events.ends_with(&expected[2..]), "{:?}", events);
        }

        #[test]
        fn no_single_wrong_byte_passes_the_checksum(
            ms in any::<u16>(), size in 1..9000_u16, at in 0..9_usize, flip in 1..=255_u8,
        ) {
            let mut packet = told_packet(ms, size, b"");
            packet[at] ^= flip;
            let passed = decode(&told(), &packet).iter().any(|event| matches!(event, WireEvent::Sample(_)));
            prop_assert!(!passed);
        }
    }
}
