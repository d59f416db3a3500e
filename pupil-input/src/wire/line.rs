//! holod's line protocol, for microcontrollers and for recordings.
//!
//! One ASCII line a sample:
//!
//! ```text
//! P1,<seq>,<device_us>,<L|R|B>,<diameter_mm>,<confidence 0..1>*<CRC-8, two hex digits>
//! ```
//!
//! ending in LF (CR and CR LF accepted; blanks before it are ignored). The CRC has polynomial 0x07 and initial value 0 and covers the bytes before `*`. A
//! line that starts with `#` is a comment; fields after the confidence are ignored. `seq` counts up by one a line (two
//! eyes of one instant may share a number).

use std::fmt::Write;

use crc::{CRC_8_SMBUS, Crc};
use holod_calibration::TimeNs;

use super::{Decoder, WireEvent, WireFault, WireSample};
use crate::SampleEye;

/// Bytes of the longest line that is read, without its ending.
pub const MAX_LINE_BYTES: usize = 256;

/// The fields of one line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineSample {
    /// Running number, one more in each line; two eyes of one instant may share one.
    pub sequence: u64,
    /// The tracker's clock, microseconds.
    pub device_us: i64,
    /// Which eye it was taken of.
    pub eye: SampleEye,
    /// Diameter, millimetres, finite and not negative.
    pub diameter_mm: f32,
    /// Confidence, 0 to 1; with a diameter of 0, 0 says that the pupil was lost.
    pub confidence: f32,
}

/// Bytes in, lines out; the same lines however the bytes are split.
///
/// A line that fails is searched for the beginning of another (`P1,`), so that a half line with a whole one behind it
/// costs one sample, not two.
#[derive(Clone, Debug)]
pub struct LineDecoder {
    line: [u8; MAX_LINE_BYTES],
    used: usize,
    overlong: bool,
    /// The next line may have lost its beginning.
    first: bool,
}

impl Default for LineDecoder {
    fn default() -> Self {
        Self::new()
    }
}

impl LineDecoder {
    /// A decoder that starts at the beginning of a line.
    pub const fn new() -> Self {
        Self { line: [0; MAX_LINE_BYTES], used: 0, overlong: false, first: false }
    }

    /// A decoder for a stream that may be joined in the middle of a line: the first line, if bad, is
    /// [`WireEvent::Partial`].
    pub const fn joining() -> Self {
        Self { first: true, ..Self::new() }
    }

    fn end_line(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        let joined = std::mem::take(&mut self.first);
        let overlong = std::mem::take(&mut self.overlong);
        let used = std::mem::take(&mut self.used);
        let line = self.line[..used].trim_ascii_end();
        if line.is_empty() {
            return;
        }
        if line[0] == b'#' {
            return on_event(WireEvent::Note);
        }
        let parsed = if overlong { Err(WireFault::TooLong) } else { read_line(line) };
        match parsed {
            Ok((sample, fault)) => {
                if let Some(fault) = fault {
                    on_event(WireEvent::Rejected(fault));
                }
                on_event(WireEvent::Sample(sample.into()));
            }
            Err(fault) => {
                on_event(if joined { WireEvent::Partial } else { WireEvent::Rejected(fault) });
                if !overlong && let Some(sample) = later_sample(line) {
                    on_event(WireEvent::Sample(sample.into()));
                }
            }
        }
    }
}

impl Decoder for LineDecoder {
    fn push(&mut self, bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        for &byte in bytes {
            if matches!(byte, b'\n' | b'\r') {
                self.end_line(on_event);
            } else if self.used < MAX_LINE_BYTES {
                self.line[self.used] = byte;
                self.used += 1;
            } else {
                self.overlong = true;
            }
        }
    }

    fn finish(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        if self.used > 0 {
            self.end_line(on_event);
        }
    }
}

impl From<LineSample> for WireSample {
    fn from(line: LineSample) -> Self {
        Self {
            t_device: Some(TimeNs(line.device_us.saturating_mul(1000))),
            eye: line.eye,
            diameter_mm: line.diameter_mm,
            confidence: line.confidence,
            aperture_mm: None,
            sequence: Some(line.sequence),
            // What a log says that is lost is written so, since the protocol has no word for it.
            valid: line.diameter_mm > 0.0 || line.confidence > 0.0,
        }
    }
}

/// A whole sample behind a half line.
fn later_sample(line: &[u8]) -> Option<LineSample> {
    let start = line.windows(3).rposition(|window| window == b"P1,").filter(|&start| start > 0)?;
    parse_line(&line[start..]).ok()
}

/// One line without its ending, or the first reason why it is not a sample.
fn parse_line(line: &[u8]) -> Result<LineSample, WireFault> {
    match read_line(line)? {
        (sample, None) => Ok(sample),
        (_, Some(fault)) => Err(fault),
    }
}

/// A whole line; a sample without a size beside the fault of its figures.
fn read_line(line: &[u8]) -> Result<(LineSample, Option<WireFault>), WireFault> {
    if line.len() > MAX_LINE_BYTES {
        return Err(WireFault::TooLong);
    }
    let text = std::str::from_utf8(line)
        .ok()
        .filter(|text| text.bytes().all(|byte| (b' '..=b'~').contains(&byte)))
        .ok_or(WireFault::Malformed)?;
    let version = text.split_once(',').and_then(|(tag, _)| tag.strip_prefix('P')).ok_or(WireFault::Malformed)?;
    if version.is_empty() || !version.bytes().all(|byte| byte.is_ascii_digit()) {
        return Err(WireFault::Malformed);
    }
    if version != "1" {
        return Err(WireFault::UnknownVersion);
    }
    let (body, check) = text.rsplit_once('*').ok_or(WireFault::BadChecksum)?;
    if check.len() != 2 || !check.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return Err(WireFault::BadChecksum);
    }
    if u8::from_str_radix(check, 16) != Ok(crc8(body.as_bytes())) {
        return Err(WireFault::BadChecksum);
    }

    let mut fields = body.split(',').skip(1);
    let mut field = || fields.next().ok_or(WireFault::Malformed);
    let sequence = field()?.parse().map_err(|_| WireFault::BadNumber)?;
    let device_us = field()?.parse().map_err(|_| WireFault::BadNumber)?;
    let eye = field()?;
    let eye = SampleEye::ALL.into_iter().find(|known| eye.chars().eq([known.letter()])).ok_or(WireFault::BadEye)?;
    let diameter_mm: f32 = field()?.parse().map_err(|_| WireFault::BadNumber)?;
    let confidence: f32 = field()?.parse().map_err(|_| WireFault::BadNumber)?;
    let fault = if !diameter_mm.is_finite() || !confidence.is_finite() {
        WireFault::NotFinite
    } else if diameter_mm < 0.0 {
        WireFault::Negative
    } else if (0.0..=1.0).contains(&confidence) {
        return Ok((LineSample { sequence, device_us, eye, diameter_mm, confidence }, None));
    } else {
        return Err(WireFault::BadConfidence);
    };
    Ok((LineSample { sequence, device_us, eye, diameter_mm: 0.0, confidence: 0.0 }, Some(fault)))
}

/// Appends the line that says `sample`, with its LF.
pub fn encode_line(sample: &LineSample, out: &mut String) {
    let start = out.len();
    let LineSample { sequence, device_us, eye, diameter_mm, confidence } = sample;
    write!(out, "P1,{sequence},{device_us},{},{diameter_mm},{confidence}", eye.letter()).expect("a String takes all");
    let check = crc8(&out.as_bytes()[start..]);
    writeln!(out, "*{check:02X}").expect("a String takes all");
}

/// CRC-8/SMBUS: polynomial x^8 + x^2 + x + 1, initial value 0, nothing reflected (Koopman's 0x83).
pub fn crc8(bytes: &[u8]) -> u8 {
    static CRC: Crc<u8> = Crc::<u8>::new(&CRC_8_SMBUS);
    CRC.checksum(bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn sample() -> LineSample {
        LineSample { sequence: 7, device_us: 1_234_567, eye: SampleEye::Left, diameter_mm: 3.25, confidence: 0.9 }
    }

    fn encoded(sample: &LineSample) -> String {
        let mut text = String::new();
        encode_line(sample, &mut text);
        text
    }

    fn decode(bytes: &[u8]) -> Vec<WireEvent> {
        let mut events = Vec::new();
        let mut decoder = LineDecoder::new();
        decoder.push(bytes, &mut |event| events.push(event));
        events
    }

    /// `fields` with a right CRC.
    fn with_crc(fields: &str) -> String {
        format!("{fields}*{:02x}\n", crc8(fields.as_bytes()))
    }

    #[test]
    fn crc_matches_the_published_check_value() {
        // CRC-8/SMBUS of "123456789" is 0xF4 in the catalogue of parametrised CRC algorithms.
        assert_eq!(crc8(b"123456789"), 0xF4);
    }

    #[test]
    fn a_known_line_reads_as_its_fields() {
        assert_eq!(decode(encoded(&sample()).as_bytes()), [WireEvent::Sample(sample().into())]);
        assert_eq!(encoded(&sample()), with_crc("P1,7,1234567,L,3.25,0.9").to_uppercase());
    }

    #[test]
    fn lines_end_in_cr_too_and_blanks_at_their_end_are_ignored() {
        let line = encoded(&sample());
        let good = WireEvent::Sample(sample().into());
        for ending in ["\r", "\r\n", "  \r\n", "\t\n"] {
            assert_eq!(decode(line.replace('\n', ending).repeat(3).as_bytes()), [good; 3], "{ending:?}");
        }
    }

    #[test]
    fn line_endings_comments_and_trailing_fields_are_accepted() {
        let text = format!(
            "# hello\r\n\n{}{}",
            with_crc("P1,7,1234567,L,3.25,0.9,future,*x").replace('\n', "\r\n"),
            encoded(&sample())
        );
        let both = WireEvent::Sample(sample().into());
        assert_eq!(decode(text.as_bytes()), [WireEvent::Note, both, both]);
    }

    #[test]
    fn each_fault_has_its_reason() {
        let cases = [
            (format!("P1,{}\n", "9".repeat(300)), WireFault::TooLong),
            ("hello\n".into(), WireFault::Malformed),
            ("P1,\u{e9}\n".into(), WireFault::Malformed),
            ("Px,1,2\n".into(), WireFault::Malformed),
            (with_crc("P1,7,8,L"), WireFault::Malformed),
            (with_crc("P2,7,8,L,3,1"), WireFault::UnknownVersion),
            ("P1,7,8,L,3,1\n".into(), WireFault::BadChecksum),
            ("P1,7,8,L,3,1*0\n".into(), WireFault::BadChecksum),
            ("P1,7,8,L,3,1*+1\n".into(), WireFault::BadChecksum),
            (with_crc("P1,7,8,L,3,1").replace("L,3", "L,4"), WireFault::BadChecksum),
            (with_crc("P1,-7,8,L,3,1"), WireFault::BadNumber),
            (with_crc("P1,7,8.5,L,3,1"), WireFault::BadNumber),
            (with_crc("P1,7,8,L,three,1"), WireFault::BadNumber),
            (with_crc("P1,7,8,L,3,"), WireFault::BadNumber),
            (with_crc("P1,7,8,X,3,1"), WireFault::BadEye),
            (with_crc("P1,7,8,L,NaN,1"), WireFault::NotFinite),
            (with_crc("P1,7,8,L,3,inf"), WireFault::NotFinite),
            (with_crc("P1,7,8,L,-1,1"), WireFault::Negative),
            (with_crc("P1,7,8,L,3,1.01"), WireFault::BadConfidence),
            (with_crc("P1,7,8,L,3,-0.5"), WireFault::BadConfidence),
        ];
        let lost = LineSample { sequence: 7, device_us: 8, diameter_mm: 0.0, confidence: 0.0, ..sample() };
        let lost = WireSample { valid: false, ..lost.into() };
        for (text, fault) in cases {
            let mut expected = vec![WireEvent::Rejected(fault)];
            expected.extend(fault.is_of_a_figure().then_some(WireEvent::Sample(lost)));
            assert_eq!(decode(text.as_bytes()), expected, "{text}");
            assert_eq!(parse_line(text.trim_end().as_bytes()), Err(fault), "{text}");
        }
    }

    #[test]
    fn a_half_line_costs_itself_and_not_its_neighbour() {
        let half = &encoded(&sample())[..11];
        let text = format!("{half}{}{}", encoded(&sample()), encoded(&sample()));
        let good = WireEvent::Sample(sample().into());
        assert_eq!(decode(text.as_bytes()), [WireEvent::Rejected(WireFault::BadChecksum), good, good]);
    }

    #[test]
    fn joining_in_the_middle_of_a_line_is_no_fault() {
        let mut events = Vec::new();
        let mut decoder = LineDecoder::joining();
        decoder.push(format!("{}{}", &encoded(&sample())[5..], encoded(&sample())).as_bytes(), &mut |e| events.push(e));
        assert_eq!(events, [WireEvent::Partial, WireEvent::Sample(sample().into())]);
    }

    fn any_sample() -> impl Strategy<Value = LineSample> {
        (any::<u64>(), any::<i64>(), 0..3_usize, 0.0_f32..20.0, 0.0_f32..=1.0).prop_map(
            |(sequence, device_us, eye, diameter_mm, confidence)| LineSample {
                sequence,
                device_us,
                eye: SampleEye::ALL[eye],
                diameter_mm,
                confidence,
            },
        )
    }

    proptest! {
        #[test]
        fn what_is_encoded_is_decoded(samples in prop::collection::vec(any_sample(), 0..20)) {
            let mut text = String::new();
            samples.iter().for_each(|sample| encode_line(sample, &mut text));
            let expected: Vec<_> = samples.into_iter().map(|sample| WireEvent::Sample(sample.into())).collect();
            prop_assert_eq!(decode(text.as_bytes()), expected);
        }

        #[test]
        fn the_split_of_the_bytes_does_not_matter(
            pieces in prop::collection::vec(
                prop_oneof![
                    any_sample().prop_map(|sample| encoded(&sample).into_bytes()),
                    any_sample().prop_map(|sample| encoded(&sample).into_bytes()[..9].to_vec()),
                    prop::collection::vec(any::<u8>(), 0..400),
                ],
                0..12,
            ),
            cuts in prop::collection::vec(1..50_usize, 1..20),
        ) {
            let bytes = pieces.concat();
            let mut events = Vec::new();
            let mut decoder = LineDecoder::new();
            let mut rest = &bytes[..];
            for &cut in cuts.iter().cycle() {
                if rest.is_empty() {
                    break;
                }
                let (now, later) = rest.split_at(cut.min(rest.len()));
                decoder.push(now, &mut |event| events.push(event));
                rest = later;
            }
            prop_assert_eq!(events, decode(&bytes));
        }

        #[test]
        fn no_single_wrong_byte_passes(sample in any_sample(), at in any::<prop::sample::Index>(), flip in 1..=255_u8) {
            let mut bytes = encoded(&sample).into_bytes();
            let at = at.index(bytes.len() - 1);
            bytes[at] ^= flip;
            // The CRC is hexadecimal of either case, and a comment is no sample.
            prop_assume!(!(at >= bytes.len() - 3 && flip == 0x20));
            let samples = decode(&bytes).into_iter().filter(|event| matches!(event, WireEvent::Sample(_))).count();
            prop_assert_eq!(samples, 0);
        }
    }
}
