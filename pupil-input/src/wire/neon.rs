//! Pupil Labs Neon: the gaze stream of the Companion app, RTP as RTSP interleaves it.
//!
//! The stream holds two kinds of messages: RTSP's own (the answer to `DESCRIBE` with its SDP comes first and names the
//! clock rate; answers to keep-alives come in between), and `$`, channel, length (16 bits), then one RTP or RTCP
//! packet. Datagrams are given the same four bytes, so that the transport makes no difference here.
//!
//! One RTP packet is one instant of both eyes. All numbers are big-endian; its payload is told by its length:
//!
//! | bytes | content |
//! |---|---|
//! | 9 | gaze x, y (f32), worn (u8: 255 or 0) |
//! | 17 | that and a second gaze point |
//! | 65 | gaze, worn, and for each eye, the left one first: pupil diameter in mm, eyeball centre, optical axis (7 × f32) |
//! | 89 | that and for each eye: angles of the upper and the lower lid, aperture between them in mm (3 × f32) |
//!
//! Only the last two hold pupils; the others are [`WireEvent::Note`]s.
//!
//! RTCP's sender reports tie RTP time to Unix time (RFC 3550, 6.4.1): `t_device` is Unix time, as in Neon's own
//! recordings, and `None` until the first report. Reports that disagree by less than [`CLOCK_STEP`] are taken in
//! gently. The phone's own clock, where it was asked, comes in a message of RTSP's form with the header `Time-Echo`, in
//! Unix milliseconds ([`time_message`]); one far from the newest packet's time is another clock, and passed over.
//! `sequence` is RTP's number carried on over its 16 bits; a packet that was overtaken has none, as it leaves
//! no gap.

use std::io::Write;

use holod_calibration::TimeNs;

use super::buffer::Buffer;
use super::{Decoder, WireEvent, WireFault, WireSample};
use crate::SampleEye;

/// Bytes of the longest RTSP message that is read; a Companion's SDP has about 300.
pub(crate) const MAX_TEXT_BYTES: usize = 4096;
/// Bytes of the longest packet. The gaze stream's have 101; after rubbish no more than this can be swallowed.
const MAX_PACKET_BYTES: usize = 256;
/// The phone's clock is off the newest packet's time by this at most, either way, in nanoseconds; one that is further
/// off is another clock.
const CLOCKS_ALIKE: i128 = 500_000_000;
const FRAME_HEADER_BYTES: usize = 4;
const RTP_HEADER_BYTES: usize = 12;
/// Header and sender's part of a sender report.
const REPORT_BYTES: usize = 28;
/// A report that disagrees by more is a step of the phone's clock, or a new stream.
const CLOCK_STEP: i128 = 100_000_000;
/// A packet may be overtaken by as many; one further back is of a restarted stream (RFC 3550, A.1).
const MOST_OVERTAKEN: i16 = 100;
/// Seconds from NTP's origin, 1900, to Unix's.
const UNIX_IN_NTP_S: i64 = 2_208_988_800;

/// RTSP bytes in, samples out; the same samples however the bytes are split.
#[derive(Clone, Debug)]
pub(crate) struct NeonDecoder {
    buffer: Buffer,
    step: Step,
    stream: Stream,
}

/// Whether messages follow each other without a gap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// No message has been found yet, and no rubbish.
    Joining,
    In,
    Out,
}

/// What the front of the held bytes is.
enum Front {
    /// The beginning of a message, or of none: that needs more bytes to tell.
    Unknown,
    /// A packet of this many bytes behind its frame header.
    Packet(usize),
    /// An RTSP message of this many bytes, with its body.
    Text(usize),
    /// The first byte belongs to no message.
    Rubbish,
}

impl Default for NeonDecoder {
    fn default() -> Self {
        Self::new()
    }
}

impl NeonDecoder {
    /// A decoder that waits for the beginning of a message.
    pub(crate) fn new() -> Self {
        Self { buffer: Buffer::new(MAX_TEXT_BYTES), step: Step::Joining, stream: Stream::new() }
    }

    /// Reads the whole messages that are held and keeps the rest.
    fn read_held(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        let held = self.buffer.held();
        let mut at = 0;
        loop {
            let rest = &held[at..];
            match front(rest) {
                Front::Unknown if rest.len() < MAX_TEXT_BYTES => break,
                Front::Packet(length) => {
                    self.step = Step::In;
                    at += FRAME_HEADER_BYTES;
                    self.stream.read_packet(&held[at..at + length], on_event);
                    at += length;
                }
                Front::Text(length) => {
                    self.step = Step::In;
                    match header(&rest[..length], TIME_ECHO).map(str::parse) {
                        Some(Ok(time_ms)) => self.stream.read_time(time_ms).into_iter().for_each(&mut *on_event),
                        Some(Err(_)) => on_event(WireEvent::Rejected(WireFault::BadNumber)),
                        None => self.stream.read_text(&rest[..length]),
                    }
                    at += length;
                }
                Front::Unknown | Front::Rubbish => {
                    match self.step {
                        Step::Joining => on_event(WireEvent::Partial),
                        Step::In => on_event(WireEvent::Rejected(WireFault::OutOfStep)),
                        Step::Out => {}
                    }
                    self.step = Step::Out;
                    at += 1;
                    let rest = &held[at..];
                    at += rest.iter().position(|byte| matches!(byte, b'$' | b'R')).unwrap_or(rest.len());
                }
            }
        }
        self.buffer.drop_front(at);
    }
}

impl Decoder for NeonDecoder {
    fn push(&mut self, mut bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        while !bytes.is_empty() {
            bytes = self.buffer.fill(bytes);
            self.read_held(on_event);
        }
    }

    fn finish(&mut self, _on_event: &mut dyn FnMut(WireEvent)) {
        self.buffer.clear();
    }
}

const TIME_ECHO: &str = "time-echo";

/// Writes a message that tells the phone's clock, in Unix milliseconds; none into a buffer that is too small.
pub(crate) fn time_message(time_ms: u64, buffer: &mut [u8]) -> Option<usize> {
    let room = buffer.len();
    let mut rest = buffer;
    write!(rest, "RTSP/1.0 200 OK\r\n{TIME_ECHO}: {time_ms}\r\n\r\n").ok()?;
    Some(room - rest.len())
}

/// What `bytes` begin with.
fn front(bytes: &[u8]) -> Front {
    const TEXT: &[u8] = b"RTSP/1.";
    match bytes {
        [] => Front::Unknown,
        [b'$', _, high, low, version, ..] => {
            let length = usize::from(u16::from_be_bytes([*high, *low]));
            if !(8..=MAX_PACKET_BYTES).contains(&length) || version >> 6 != 2 {
                Front::Rubbish
            } else if bytes.len() < FRAME_HEADER_BYTES + length {
                Front::Unknown
            } else {
                Front::Packet(length)
            }
        }
        [b'$', ..] => Front::Unknown,
        _ if bytes.starts_with(TEXT) => {
            let Some(head) = bytes.windows(4).position(|window| window == b"\r\n\r\n") else {
                return Front::Unknown;
            };
            let head = head + 4;
            let body = header(&bytes[..head], "content-length").map_or(Some(0), |value| value.parse().ok());
            match body.and_then(|body: usize| head.checked_add(body)) {
                Some(whole) if whole > MAX_TEXT_BYTES => Front::Rubbish,
                Some(whole) if whole <= bytes.len() => Front::Text(whole),
                Some(_) => Front::Unknown,
                None => Front::Rubbish,
            }
        }
        _ if TEXT.starts_with(bytes) => Front::Unknown,
        _ => Front::Rubbish,
    }
}

/// The value of an RTSP or HTTP header; `name` in lower case.
pub(crate) fn header<'a>(head: &'a [u8], name: &str) -> Option<&'a str> {
    head.split(|byte| *byte == b'\n').skip(1).find_map(|line| {
        let (found, value) = std::str::from_utf8(line).ok()?.split_once(':')?;
        found.trim().eq_ignore_ascii_case(name).then(|| value.trim())
    })
}

/// The part of an SDP that is about the gaze stream.
pub(crate) fn gaze_media(sdp: &[u8]) -> &[u8] {
    const MEDIA: &[u8] = b"\nm=application";
    sdp.windows(MEDIA.len()).position(|window| window == MEDIA).map_or(sdp, |begin| &sdp[begin..])
}

/// One RTP stream's clock and numbers.
#[derive(Clone, Copy, Debug)]
struct Stream {
    /// Ticks of RTP time a second, by the SDP.
    clock_rate: Option<u32>,
    source: Option<u32>,
    /// Number of the newest packet, carried on over 16 bits.
    newest: Option<u64>,
    /// The newest RTP time, carried on over 32 bits.
    ticks: Option<i64>,
    anchor: Option<Anchor>,
}

/// One instant in RTP and in Unix time.
#[derive(Clone, Copy, Debug)]
struct Anchor {
    ticks: i64,
    unix_ns: i128,
}

impl Stream {
    const fn new() -> Self {
        Self { clock_rate: None, source: None, newest: None, ticks: None, anchor: None }
    }

    /// Looks for the clock rate: `a=rtpmap:96 com.pupillabs.gaze1/90000`.
    fn read_text(&mut self, message: &[u8]) {
        let rate = gaze_media(message).split(|byte| *byte == b'\n').find_map(|line| {
            let format = std::str::from_utf8(line).ok()?.strip_prefix("a=rtpmap:")?;
            let (_, encoding) = format.split_once(' ')?;
            encoding.trim().split('/').nth(1)?.parse().ok().filter(|rate| *rate > 0)
        });
        if rate.is_some() {
            *self = Self { clock_rate: rate, ..Self::new() };
        }
    }

    /// The phone's clock, where it is the one that packets are timed by.
    fn read_time(&self, time_ms: u64) -> Option<WireEvent> {
        let newest_ns = self.anchor?.unix_ns_at(self.ticks?, self.clock_rate?);
        let unix_ns = i128::from(time_ms) * 1_000_000;
        let is_alike = (unix_ns - newest_ns).abs() <= CLOCKS_ALIKE;
        is_alike.then(|| i64::try_from(unix_ns).ok()).flatten().map(|unix_ns| WireEvent::Clock(TimeNs(unix_ns)))
    }

    fn read_packet(&mut self, packet: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        // RFC 5761: packet types 192 to 223 are RTCP's, whatever the channel.
        let outcome = if matches!(packet[1], 192..=223) {
            self.read_reports(packet).map(|()| None)
        } else {
            self.read_datum(packet)
        };
        match outcome {
            Ok(Some(samples)) => samples.into_iter().for_each(|sample| on_event(WireEvent::Sample(sample))),
            Ok(None) => on_event(WireEvent::Note),
            Err(fault) => on_event(WireEvent::Rejected(fault)),
        }
    }

    /// One RTP packet (RFC 3550, 5.1).
    fn read_datum(&mut self, packet: &[u8]) -> Result<Option<[WireSample; 2]>, WireFault> {
        let header = packet.first_chunk::<RTP_HEADER_BYTES>().ok_or(WireFault::TooShort)?;
        let padded = header[0] & 0x20 != 0;
        let extended = header[0] & 0x10 != 0;
        let contributors = usize::from(header[0] & 0x0f);
        let mut payload = packet.get(RTP_HEADER_BYTES + 4 * contributors..).ok_or(WireFault::TooShort)?;
        if extended {
            let head = payload.first_chunk::<4>().ok_or(WireFault::TooShort)?;
            let words = usize::from(u16::from_be_bytes([head[2], head[3]]));
            payload = payload.get(4 + 4 * words..).ok_or(WireFault::TooShort)?;
        }
        if padded {
            let padding = usize::from(*payload.last().ok_or(WireFault::TooShort)?);
            let kept = payload.len().checked_sub(padding).filter(|_| padding > 0).ok_or(WireFault::Malformed)?;
            payload = &payload[..kept];
        }
        let number = u16::from_be_bytes([header[2], header[3]]);
        let rtp_time = u32::from_be_bytes([header[4], header[5], header[6], header[7]]);
        self.set_source(u32::from_be_bytes([header[8], header[9], header[10], header[11]]));
        let sequence = self.sequence(number);
        let t_device = self.t_device(rtp_time);
        read_payload(payload, t_device, sequence)
    }

    /// A packet of another source begins a new stream, with numbers and a time of its own.
    fn set_source(&mut self, source: u32) {
        if self.source.is_some_and(|known| known != source) {
            *self = Self { clock_rate: self.clock_rate, ..Self::new() };
        }
        self.source = Some(source);
    }

    fn sequence(&mut self, number: u16) -> Option<u64> {
        let Some(newest) = self.newest else {
            self.newest = Some(u64::from(number));
            return self.newest;
        };
        let step = number.wrapping_sub(newest as u16).cast_signed();
        if (-MOST_OVERTAKEN..0).contains(&step) {
            return None;
        }
        // Back by more: the stream began anew, which its falling number tells.
        self.newest = Some(newest.checked_add_signed(i64::from(step)).unwrap_or(u64::from(number)));
        self.newest
    }

    /// RTP time carried on over its 32 bits.
    fn ticks(&mut self, rtp_time: u32) -> i64 {
        let ticks = match self.ticks {
            None => i64::from(rtp_time),
            Some(known) => known.saturating_add(i64::from(rtp_time.wrapping_sub(known as u32).cast_signed())),
        };
        self.ticks = Some(ticks);
        ticks
    }

    fn t_device(&mut self, rtp_time: u32) -> Option<TimeNs> {
        let ticks = self.ticks(rtp_time);
        let unix_ns = self.anchor?.unix_ns_at(ticks, self.clock_rate?);
        Some(TimeNs(unix_ns.clamp(i64::MIN.into(), i64::MAX.into()) as i64))
    }

    /// The reports of one RTCP packet (RFC 3550, 6.1).
    fn read_reports(&mut self, mut packet: &[u8]) -> Result<(), WireFault> {
        while !packet.is_empty() {
            let header = packet.first_chunk::<4>().ok_or(WireFault::TooShort)?;
            if header[0] >> 6 != 2 {
                return Err(WireFault::Malformed);
            }
            let length = 4 + 4 * usize::from(u16::from_be_bytes([header[2], header[3]]));
            let (report, rest) = packet.split_at_checked(length).ok_or(WireFault::TooShort)?;
            if header[1] == 200 {
                self.take_report(report.first_chunk().ok_or(WireFault::TooShort)?);
            }
            packet = rest;
        }
        Ok(())
    }

    fn take_report(&mut self, report: &[u8; REPORT_BYTES]) {
        let word = |at: usize| u32::from_be_bytes([report[at], report[at + 1], report[at + 2], report[at + 3]]);
        let (source, seconds, fraction, rtp_time) = (word(4), word(8), word(12), word(16));
        // Zero is said by a sender that has no clock.
        if (seconds, fraction) == (0, 0) || self.source.is_some_and(|known| known != source) {
            return;
        }
        let Some(rate) = self.clock_rate else {
            return;
        };
        // NTP's seconds begin anew in 2036.
        let era = if i64::from(seconds) < UNIX_IN_NTP_S { 1_i64 << 32 } else { 0 };
        let unix_s = i64::from(seconds) + era - UNIX_IN_NTP_S;
        let reported_ns = i128::from(unix_s) * 1_000_000_000 + ((i128::from(fraction) * 1_000_000_000) >> 32);
        let ticks = self.ticks(rtp_time);
        let unix_ns = match self.anchor.map(|anchor| anchor.unix_ns_at(ticks, rate)) {
            Some(expected_ns) if (reported_ns - expected_ns).abs() < CLOCK_STEP => {
                expected_ns + (reported_ns - expected_ns) / 8
            }
            _ => reported_ns,
        };
        self.anchor = Some(Anchor { ticks, unix_ns });
    }
}

impl Anchor {
    fn unix_ns_at(self, ticks: i64, clock_rate: u32) -> i128 {
        self.unix_ns + (i128::from(ticks) - i128::from(self.ticks)) * 1_000_000_000 / i128::from(clock_rate)
    }
}

/// Samples of the left and the right eye, or `None` for a payload without pupils.
fn read_payload(
    payload: &[u8],
    t_device: Option<TimeNs>,
    sequence: Option<u64>,
) -> Result<Option<[WireSample; 2]>, WireFault> {
    match payload.len() {
        65 | 89 => {}
        9 | 17 => return Ok(None),
        0..65 => return Err(WireFault::TooShort),
        _ => return Err(WireFault::UnknownVersion),
    }
    let worn = payload[8] != 0;
    let float = |at: usize| {
        let bytes = payload.get(at..at + 4)?;
        Some(f32::from_be_bytes(bytes.try_into().expect("four bytes")))
    };
    let eye = |eye, diameter_at, aperture_at| {
        let diameter_mm = float(diameter_at).expect("within each length");
        WireSample {
            t_device,
            eye,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: float(aperture_at).filter(|aperture_mm| aperture_mm.is_finite()),
            sequence,
            valid: worn && diameter_mm.is_finite() && diameter_mm > 0.0,
        }
    };
    Ok(Some([eye(SampleEye::Left, 9, 73), eye(SampleEye::Right, 37, 85)]))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SOURCE: u32 = 0xfeed_0001;
    /// 1 s of RTP time.
    const RATE: u32 = 90_000;
    /// 2026-11-21, in Unix and in NTP seconds.
    const UNIX_S: i64 = 1_795_219_200;
    const NTP_S: u32 = (UNIX_S + UNIX_IN_NTP_S) as u32;

    fn framed(channel: u8, packet: &[u8]) -> Vec<u8> {
        let mut bytes = vec![b'$', channel];
        bytes.extend(u16::try_from(packet.len()).expect("a short packet").to_be_bytes());
        bytes.extend(packet);
        bytes
    }

    fn rtp(number: u16, rtp_time: u32, payload: &[u8]) -> Vec<u8> {
        let mut packet = vec![0x80, 96];
        packet.extend(number.to_be_bytes());
        packet.extend(rtp_time.to_be_bytes());
        packet.extend(SOURCE.to_be_bytes());
        packet.extend(payload);
        packet
    }

    /// A sender report with the source description that follows it in each RTCP packet.
    fn report(ntp_s: u32, fraction: u32, rtp_time: u32) -> Vec<u8> {
        let mut packet = vec![0x80, 200, 0, 6];
        for word in [SOURCE, ntp_s, fraction, rtp_time, 1000, 89_000] {
            packet.extend(word.to_be_bytes());
        }
        packet.extend([0x81, 202, 0, 2]);
        packet.extend(SOURCE.to_be_bytes());
        packet.extend([1, 1, b'n', 0]);
        packet
    }

    /// Payload of 89 bytes, or its first 65, 17 or 9 of another meaning.
    fn payload(length: usize, worn: u8, left_mm: f32, right_mm: f32) -> Vec<u8> {
        let mut bytes = Vec::new();
        let float = |bytes: &mut Vec<u8>, value: f32| bytes.extend(value.to_be_bytes());
        float(&mut bytes, 812.5);
        float(&mut bytes, 601.25);
        bytes.push(worn);
        for diameter_mm in [left_mm, right_mm] {
            for value in [diameter_mm, -31.0, 12.5, -40.0, 0.1, -0.2, 0.97] {
                float(&mut bytes, value);
            }
        }
        for aperture_mm in [10.5, 11.25] {
            for value in [0.6, -0.4, aperture_mm] {
                float(&mut bytes, value);
            }
        }
        assert_eq!(bytes.len(), 89);
        bytes.truncate(length);
        bytes
    }

    fn describe(rate: u32) -> Vec<u8> {
        let sdp = format!(
            "v=0\r\no=- 0 0 IN IP4 192.168.1.20\r\ns=Unnamed\r\nt=0 0\r\nm=application 5006 RTP/AVP 96\r\n\
             a=rtpmap:96 com.pupillabs.gaze1/{rate}\r\na=control:trackID=0\r\n"
        );
        format!(
            "RTSP/1.0 200 OK\r\nCSeq: 2\r\nContent-Type: application/sdp\r\nContent-Length: {}\r\n\r\n{sdp}",
            sdp.len()
        )
        .into_bytes()
    }

    fn decode_pieces<'a>(pieces: impl IntoIterator<Item = &'a [u8]>) -> Vec<WireEvent> {
        let mut events = Vec::new();
        let mut decoder = NeonDecoder::new();
        pieces.into_iter().for_each(|piece| decoder.push(piece, &mut |event| events.push(event)));
        events
    }

    fn decode(bytes: &[u8]) -> Vec<WireEvent> {
        decode_pieces([bytes])
    }

    fn samples(events: &[WireEvent]) -> Vec<WireSample> {
        events
            .iter()
            .filter_map(|event| match event {
                WireEvent::Sample(sample) => Some(*sample),
                _ => None,
            })
            .collect()
    }

    /// The left eye's samples of a stream that begins with an SDP.
    fn left(packets: &[Vec<u8>]) -> Vec<WireSample> {
        let mut bytes = describe(RATE);
        packets.iter().for_each(|packet| bytes.extend(framed(0, packet)));
        samples(&decode(&bytes)).into_iter().filter(|sample| sample.eye == SampleEye::Left).collect()
    }

    fn datum(number: u16, rtp_time: u32) -> Vec<u8> {
        rtp(number, rtp_time, &payload(89, 255, 3.5, 4.25))
    }

    fn sample(eye: SampleEye) -> WireSample {
        let (diameter_mm, aperture_mm) = if eye == SampleEye::Left { (3.5, 10.5) } else { (4.25, 11.25) };
        WireSample {
            t_device: None,
            eye,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: Some(aperture_mm),
            sequence: Some(7),
            valid: true,
        }
    }

    #[test]
    fn each_payload_is_told_by_its_length() {
        let of_length = |length| decode(&framed(0, &rtp(7, 0, &payload(length, 255, 3.5, 4.25))));
        let [left, right] = [sample(SampleEye::Left), sample(SampleEye::Right)];
        assert_eq!(of_length(89), [WireEvent::Sample(left), WireEvent::Sample(right)]);
        assert_ne!(of_length(89), [WireEvent::Sample(right), WireEvent::Sample(left)]);
        let without = |sample| WireEvent::Sample(WireSample { aperture_mm: None, ..sample });
        assert_eq!(of_length(65), [without(left), without(right)]);
        assert_eq!(of_length(9), [WireEvent::Note]);
        assert_eq!(of_length(17), [WireEvent::Note]);
        for length in [0, 1, 8, 10, 64] {
            assert_eq!(of_length(length), [WireEvent::Rejected(WireFault::TooShort)], "{length} bytes");
        }
        for length in [66, 88] {
            assert_eq!(of_length(length), [WireEvent::Rejected(WireFault::UnknownVersion)], "{length} bytes");
        }
        let mut longer = payload(89, 255, 3.5, 4.25);
        longer.extend([0; 4]);
        assert_eq!(decode(&framed(0, &rtp(7, 0, &longer))), [WireEvent::Rejected(WireFault::UnknownVersion)]);
    }

    #[test]
    fn glasses_not_worn_and_pupils_not_found_are_lost() {
        let valid = |worn, left_mm, right_mm| {
            let events = decode(&framed(0, &rtp(7, 0, &payload(65, worn, left_mm, right_mm))));
            <[WireSample; 2]>::try_from(samples(&events)).expect("two").map(|sample| sample.valid)
        };
        assert_eq!(valid(255, 3.5, 4.25), [true, true]);
        assert_eq!(valid(0, 3.5, 4.25), [false, false]);
        assert_eq!(valid(255, f32::NAN, 4.25), [false, true]);
        assert_eq!(valid(255, 3.5, 0.0), [true, false]);
        assert_eq!(valid(255, f32::INFINITY, -1.0), [false, false]);
    }

    #[test]
    fn reports_make_rtp_time_unix_time() {
        let half = 1 << 31;
        let samples = left(&[datum(1, 9_000), report(NTP_S, half, 45_000), datum(2, 45_000), datum(3, 45_450)]);
        let times: Vec<_> = samples.iter().map(|sample| sample.t_device).collect();
        let begun = UNIX_S * 1_000_000_000 + 500_000_000;
        assert_eq!(times, [None, Some(TimeNs(begun)), Some(TimeNs(begun + 5_000_000))]);
        // Without a clock rate RTP time is no time.
        let bytes = [framed(1, &report(NTP_S, 0, 0)), framed(0, &datum(1, 0))].concat();
        assert!(self::samples(&decode(&bytes)).iter().all(|sample| sample.t_device.is_none()));
    }

    #[test]
    fn reports_that_wander_are_taken_in_gently_and_steps_at_once() {
        let ms = |ms: u32| ((u64::from(ms) << 32) / 1000) as u32;
        let time = |reports: &[Vec<u8>]| {
            let last = *left(&[reports, &[datum(1, 900_000)]].concat()).last().expect("a sample");
            last.t_device.expect("a time").0 - (UNIX_S + 10) * 1_000_000_000
        };
        let first = report(NTP_S, 0, 0);
        assert_eq!(time(std::slice::from_ref(&first)), 0);
        let near = |found: i64, expected: i64| assert!((found - expected).abs() < 10, "{found} is not {expected}");
        near(time(&[first.clone(), report(NTP_S + 5, ms(8), 450_000)]), 1_000_000);
        near(time(&[first.clone(), report(NTP_S + 5, ms(500), 450_000)]), 500_000_000);
        near(time(&[first.clone(), report(NTP_S + 1, 0, 450_000)]), -4_000_000_000);
        // A sender without a clock says zero; another source's report is not this one's.
        near(time(&[first.clone(), report(0, 0, 450_000)]), 0);
        let mut foreign = report(NTP_S + 50, 0, 450_000);
        foreign[4] ^= 1;
        let known = [datum(0, 0), first, foreign];
        near(time(&known), 0);
    }

    #[test]
    fn ntp_begins_anew_in_2036() {
        let unix_s = (1_i64 << 32) - UNIX_IN_NTP_S;
        let samples = left(&[report(0, 1 << 31, 0), datum(1, 0)]);
        assert_eq!(samples[0].t_device, Some(TimeNs(unix_s * 1_000_000_000 + 500_000_000)));
    }

    #[test]
    fn the_phones_clock_is_read_once_it_is_known_to_be_that_of_the_packets() {
        let clock = |time_ms: i64| {
            let mut message = [0; 64];
            let count = time_message(time_ms as u64, &mut message).expect("room");
            message[..count].to_vec()
        };
        let now_ms = UNIX_S * 1000 + 40;
        let mut bytes = [clock(now_ms), describe(RATE), clock(now_ms)].concat();
        assert_eq!(decode(&bytes), [], "no packet has a time yet");
        bytes.extend([framed(1, &report(NTP_S, 0, 0)), framed(0, &datum(1, 0))].concat());
        // Another clock, and this one.
        bytes.extend(
            [clock(now_ms - 3_600_000), clock(now_ms), b"RTSP/1.0 200 OK\r\nTime-Echo: x\r\n\r\n".to_vec()].concat(),
        );
        let [WireEvent::Note, WireEvent::Sample(_), WireEvent::Sample(_), clock_ms, bad] = decode(&bytes)[..] else {
            panic!("{:?}", decode(&bytes))
        };
        assert_eq!(clock_ms, WireEvent::Clock(TimeNs(now_ms * 1_000_000)));
        assert_eq!(bad, WireEvent::Rejected(WireFault::BadNumber));
        assert_eq!(time_message(1, &mut [0; 16]), None);
    }

    #[test]
    fn numbers_and_times_go_on_over_their_wrap() {
        let samples = left(&[
            report(NTP_S, 0, u32::MAX - 449),
            datum(65_534, u32::MAX - 449),
            datum(65_535, 0),
            datum(0, 450),
            datum(3, 1_800),
        ]);
        let seen: Vec<_> = samples
            .iter()
            .map(|sample| (sample.sequence, sample.t_device.expect("a time").0 - UNIX_S * 1_000_000_000))
            .collect();
        let ms = 1_000_000;
        assert_eq!(seen, [(Some(65_534), 0), (Some(65_535), 5 * ms), (Some(65_536), 10 * ms), (Some(65_539), 25 * ms)]);
    }

    #[test]
    fn overtaken_packets_have_no_number_and_their_own_time() {
        let packets =
            [report(NTP_S, 0, 0), datum(10, 0), datum(12, 900), datum(11, 450), datum(12, 900), datum(13, 1350)];
        let seen: Vec<_> = left(&packets)
            .iter()
            .map(|sample| (sample.sequence, (sample.t_device.expect("a time").0 - UNIX_S * 1_000_000_000) / 1_000_000))
            .collect();
        assert_eq!(seen, [(Some(10), 0), (Some(12), 10), (None, 5), (Some(12), 10), (Some(13), 15)]);
        // Back by more than can be overtaken: the sender began anew.
        let again: Vec<_> = left(&[datum(5000, 0), datum(3, 0)]).iter().map(|sample| sample.sequence).collect();
        assert_eq!(again, [Some(5000), Some(3)]);
    }

    #[test]
    fn another_source_is_another_stream() {
        let mut other = datum(50, 77);
        other[8] ^= 1;
        let samples = left(&[report(NTP_S, 0, 0), datum(9, 450), other]);
        assert_eq!(samples[0].t_device, Some(TimeNs(UNIX_S * 1_000_000_000 + 5_000_000)));
        assert_eq!((samples[1].sequence, samples[1].t_device), (Some(50), None));
    }

    #[test]
    fn rtp_extras_are_passed_over() {
        let mut packet = vec![0xb2, 96, 0, 7, 0, 0, 0, 0];
        packet.extend(SOURCE.to_be_bytes());
        packet.extend([0; 8]);
        packet.extend([0xbe, 0xde, 0, 1, 1, 2, 3, 4]);
        packet.extend(payload(89, 255, 3.5, 4.25));
        packet.extend([0, 0, 0, 4]);
        assert_eq!(decode(&framed(0, &packet))[0], WireEvent::Sample(sample(SampleEye::Left)));
        let padding = packet.len() - 1;
        for wrong in [0, 255] {
            packet[padding] = wrong;
            assert_eq!(decode(&framed(0, &packet)), [WireEvent::Rejected(WireFault::Malformed)]);
        }
    }

    #[test]
    fn bad_reports_are_counted() {
        let mut wrong_version = report(NTP_S, 0, 0);
        wrong_version[28] = 0x41;
        assert_eq!(decode(&framed(1, &wrong_version)), [WireEvent::Rejected(WireFault::Malformed)]);
        assert_eq!(decode(&framed(1, &report(NTP_S, 0, 0)[..20])), [WireEvent::Rejected(WireFault::TooShort)]);
        assert_eq!(decode(&framed(1, &report(NTP_S, 0, 0))), [WireEvent::Note]);
    }

    #[test]
    fn an_answer_thrown_into_the_stream_costs_one_packet() {
        // A Companion was seen to send an answer between a frame's header and its packet.
        let packets: Vec<_> = (1..6).map(|number| framed(0, &datum(number, 0))).collect();
        let (head, body) = packets[1].split_at(4);
        let answer: &[u8] = b"RTSP/1.0 400 Bad Request\r\nServer: x\r\nCSeq: 5\r\n\r\n";
        let bytes = [&describe(RATE), &packets[0], head, answer, body, &packets[2], &packets[3]].map(<[u8]>::to_vec);
        let events = decode(&bytes.concat());
        let numbers: Vec<_> = samples(&events).iter().map(|sample| sample.sequence).collect();
        assert_eq!(numbers, [1, 1, 3, 3, 4, 4].map(Some));
        let faults = events.iter().filter(|event| matches!(event, WireEvent::Rejected(_))).count();
        assert_eq!(faults, 2, "the header and the packet behind the answer");
    }

    #[test]
    fn joining_in_the_middle_is_no_fault() {
        let packets = [framed(0, &datum(1, 0))[20..].to_vec(), framed(0, &datum(7, 0))].concat();
        let events = decode(&packets);
        assert_eq!(events[0], WireEvent::Partial);
        assert_eq!(samples(&events), [sample(SampleEye::Left), sample(SampleEye::Right)]);
        assert_eq!(events.len(), 3);
    }

    #[test]
    fn endless_messages_end() {
        let mut decoder = NeonDecoder::new();
        let mut events = Vec::new();
        let mut push = |bytes: &[u8]| decoder.push(bytes, &mut |event| events.push(event));
        push(b"RTSP/1.0 200 OK\r\n");
        (0..1000).for_each(|_| push(b"header: value\r\n"));
        push(b"RTSP/1.0 200 OK\r\nContent-Length: 18446744073709551615\r\n\r\n");
        push(b"RTSP/1.0 200 OK\r\nContent-Length: many\r\n\r\n");
        push(&framed(0, &datum(7, 0)));
        assert_eq!(samples(&events), [sample(SampleEye::Left), sample(SampleEye::Right)]);
    }

    fn any_piece() -> impl Strategy<Value = Vec<u8>> {
        prop_oneof![
            4 => (any::<u16>(), any::<u32>(), prop::sample::select(vec![9, 17, 65, 88, 89]))
                .prop_map(|(number, time, length)| framed(0, &rtp(number, time, &payload(length, 255, 3.5, 4.25)))),
            2 => (any::<u32>(), any::<u32>(), any::<u32>())
                .prop_map(|(seconds, fraction, time)| framed(1, &report(seconds, fraction, time))),
            1 => any::<u32>().prop_map(describe),
            1 => prop::collection::vec(any::<u8>(), 0..300),
            1 => (any::<u8>(), prop::collection::vec(any::<u8>(), 0..300)).prop_map(|(c, packet)| framed(c, &packet)),
            1 => Just(b"RTSP/1.0 200 OK\r\nCSeq: 9\r\n\r\n".to_vec()),
        ]
    }

    proptest! {
        #[test]
        fn the_split_of_the_bytes_does_not_matter(
            pieces in prop::collection::vec(any_piece(), 0..12),
            cuts in prop::collection::vec(1..200_usize, 1..20),
        ) {
            let bytes = pieces.concat();
            let mut split = Vec::new();
            let mut rest = &bytes[..];
            for &cut in cuts.iter().cycle() {
                if rest.is_empty() {
                    break;
                }
                let (now, later) = rest.split_at(cut.min(rest.len()));
                split.push(now);
                rest = later;
            }
            prop_assert_eq!(format!("{:?}", decode_pieces(split)), format!("{:?}", decode(&bytes)));
        }

        #[test]
        fn rubbish_costs_at_most_two_packets(
            rubbish in prop::collection::vec(any::<u8>(), 0..600),
            cut in 0..101_usize,
        ) {
            let packets: Vec<_> = (1..6).map(|number| framed(0, &datum(number, 0))).collect();
            let bytes = [&packets[0][..], &packets[1][..cut], &rubbish, &packets[2], &packets[3], &packets[4]].concat();
            let numbers: Vec<_> = samples(&decode(&bytes)).iter().map(|sample| sample.sequence).collect();
            prop_assert!(numbers.ends_with(&[Some(5), Some(5)]), "{:?}", numbers);
        }

        #[test]
        fn what_a_packet_holds_is_what_is_read(
            number in any::<u16>(),
            time in any::<u32>(),
            diameters in (0.1_f32..10.0, 0.1_f32..10.0),
        ) {
            let packets = framed(0, &rtp(number, time, &payload(89, 255, diameters.0, diameters.1)));
            let found = samples(&decode(&packets));
            prop_assert_eq!(found.len(), 2);
            prop_assert_eq!((found[0].diameter_mm, found[1].diameter_mm), diameters);
            prop_assert_eq!(found[0].sequence, Some(u64::from(number)));
        }

        #[test]
        fn times_stay_in_step_over_any_wrap(begin in any::<u32>(), steps in prop::collection::vec(1..200_000_u32, 1..60)) {
            let mut packets = vec![report(NTP_S, 0, begin)];
            let (mut ticks, mut expected) = (0_i64, Vec::new());
            for (number, step) in steps.into_iter().enumerate() {
                ticks += i64::from(step);
                packets.push(datum(number as u16, begin.wrapping_add(ticks as u32)));
                expected.push(UNIX_S * 1_000_000_000 + ticks * 1_000_000_000 / i64::from(RATE));
            }
            let times: Vec<_> = left(&packets).iter().map(|sample| sample.t_device.expect("a time").0).collect();
            prop_assert_eq!(times, expected);
        }
    }
}
