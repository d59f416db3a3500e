//! holod's line protocol, for microcontrollers and for recordings.
//!
//! One ASCII line a sample:
//!
//! ```text
//! P1,<seq>,<device_us>,<L|R|B>,<diameter_mm>,<confidence 0..1>*<CRC-8, two hex digits>
//! ```
//!
//! ending in LF (CR LF accepted). The CRC has polynomial 0x07 and initial value 0 and covers the bytes before `*`. A line
//! that starts with `#` is a comment; fields after the confidence are ignored. `seq` counts up by one a line (two eyes of
//! one instant may share a number).

use std::fmt::Write;

use crate::SampleEye;

/// Bytes of the longest line that is read, without its ending.
pub const MAX_LINE_BYTES: usize = 256;

/// The fields of one line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineSample {
    /// Running number.
    pub sequence: u64,
    /// The tracker's clock, microseconds.
    pub device_us: i64,
    /// The eye.
    pub eye: SampleEye,
    /// Diameter, millimetres, finite and not negative.
    pub diameter_mm: f32,
    /// Confidence, 0..=1.
    pub confidence: f32,
}

/// Why a line was rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum LineFault {
    /// Longer than [`MAX_LINE_BYTES`].
    TooLong,
    /// Not printable ASCII, or not of the protocol's form.
    Malformed,
    /// `P` and a number that is not 1.
    UnknownVersion,
    /// No `*` with two hex digits at the end, or they do not match.
    BadCrc,
    /// Sequence, time, diameter or confidence is not a number.
    BadNumber,
    /// The eye is none of L, R, B.
    BadEye,
    /// Diameter or confidence is NaN or infinite.
    NotFinite,
    /// The diameter is negative.
    Negative,
    /// The confidence lies outside 0..=1.
    BadConfidence,
}

impl LineFault {
    /// Every reason, in the order of their indices.
    pub const ALL: [Self; 9] = [
        Self::TooLong,
        Self::Malformed,
        Self::UnknownVersion,
        Self::BadCrc,
        Self::BadNumber,
        Self::BadEye,
        Self::NotFinite,
        Self::Negative,
        Self::BadConfidence,
    ];

    /// Its place in [`Self::ALL`].
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The name under which it is counted.
    pub const fn name(self) -> &'static str {
        match self {
            Self::TooLong => "line_too_long",
            Self::Malformed => "line_malformed",
            Self::UnknownVersion => "line_unknown_version",
            Self::BadCrc => "line_bad_crc",
            Self::BadNumber => "line_bad_number",
            Self::BadEye => "line_bad_eye",
            Self::NotFinite => "line_not_finite",
            Self::Negative => "line_negative",
            Self::BadConfidence => "line_bad_confidence",
        }
    }
}

/// What one line turned out to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LineEvent {
    /// A sample.
    Sample(LineSample),
    /// A comment.
    Comment,
    /// A line that is no sample, with the reason.
    Rejected(LineFault),
    /// What was left of a line when reading began in its middle; not a fault.
    Partial,
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
    /// [`LineEvent::Partial`].
    pub const fn joining() -> Self {
        Self { first: true, ..Self::new() }
    }

    /// Takes `bytes` and calls `on_event` for each line that they complete.
    pub fn push(&mut self, bytes: &[u8], mut on_event: impl FnMut(LineEvent)) {
        for &byte in bytes {
            if byte == b'\n' {
                self.end_line(&mut on_event);
            } else if self.used < MAX_LINE_BYTES {
                self.line[self.used] = byte;
                self.used += 1;
            } else {
                self.overlong = true;
            }
        }
    }

    /// Ends a last line that has no line ending, as at the end of a file.
    pub fn finish(&mut self, mut on_event: impl FnMut(LineEvent)) {
        if self.used > 0 {
            self.end_line(&mut on_event);
        }
    }

    fn end_line(&mut self, on_event: &mut impl FnMut(LineEvent)) {
        let joined = std::mem::take(&mut self.first);
        let overlong = std::mem::take(&mut self.overlong);
        let used = std::mem::take(&mut self.used);
        let line = self.line[..used].strip_suffix(b"\r").unwrap_or(&self.line[..used]);
        if line.is_empty() {
            return;
        }
        if line[0] == b'#' {
            return on_event(LineEvent::Comment);
        }
        let parsed = if overlong { Err(LineFault::TooLong) } else { parse_line(line) };
        match parsed {
            Ok(sample) => on_event(LineEvent::Sample(sample)),
            Err(fault) => {
                on_event(if joined { LineEvent::Partial } else { LineEvent::Rejected(fault) });
                if !overlong && let Some(sample) = later_sample(line) {
                    on_event(LineEvent::Sample(sample));
                }
            }
        }
    }
}

/// A whole sample behind a half line.
fn later_sample(line: &[u8]) -> Option<LineSample> {
    let start = line.windows(3).rposition(|window| window == b"P1,").filter(|&start| start > 0)?;
    parse_line(&line[start..]).ok()
}

/// Reads one line without its ending.
///
/// # Errors
/// The first reason why it is not a sample.
pub fn parse_line(line: &[u8]) -> Result<LineSample, LineFault> {
    if line.len() > MAX_LINE_BYTES {
        return Err(LineFault::TooLong);
    }
    let text = std::str::from_utf8(line)
        .ok()
        .filter(|text| text.bytes().all(|byte| (b' '..=b'~').contains(&byte)))
        .ok_or(LineFault::Malformed)?;
    let version = text.split_once(',').and_then(|(tag, _)| tag.strip_prefix('P')).ok_or(LineFault::Malformed)?;
    if version.is_empty() || !version.bytes().all(|byte| byte.is_ascii_digit()) {
        return Err(LineFault::Malformed);
    }
    if version != "1" {
        return Err(LineFault::UnknownVersion);
    }
    let (body, check) = text.rsplit_once('*').ok_or(LineFault::BadCrc)?;
    if check.len() != 2 || !check.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return Err(LineFault::BadCrc);
    }
    if u8::from_str_radix(check, 16) != Ok(crc8(body.as_bytes())) {
        return Err(LineFault::BadCrc);
    }

    let mut fields = body.split(',').skip(1);
    let mut field = || fields.next().ok_or(LineFault::Malformed);
    let sequence = field()?.parse().map_err(|_| LineFault::BadNumber)?;
    let device_us = field()?.parse().map_err(|_| LineFault::BadNumber)?;
    let eye = match field()? {
        "L" => SampleEye::Left,
        "R" => SampleEye::Right,
        "B" => SampleEye::Both,
        _ => return Err(LineFault::BadEye),
    };
    let diameter_mm: f32 = field()?.parse().map_err(|_| LineFault::BadNumber)?;
    let confidence: f32 = field()?.parse().map_err(|_| LineFault::BadNumber)?;
    if !diameter_mm.is_finite() || !confidence.is_finite() {
        return Err(LineFault::NotFinite);
    }
    if diameter_mm < 0.0 {
        return Err(LineFault::Negative);
    }
    if !(0.0..=1.0).contains(&confidence) {
        return Err(LineFault::BadConfidence);
    }
    Ok(LineSample { sequence, device_us, eye, diameter_mm, confidence })
}

/// Appends the line that says `sample`, with its LF.
pub fn encode_line(sample: &LineSample, out: &mut String) {
    let start = out.len();
    let LineSample { sequence, device_us, eye, diameter_mm, confidence } = sample;
    write!(out, "P1,{sequence},{device_us},{},{diameter_mm},{confidence}", eye.letter()).expect("a String takes all");
    let check = crc8(&out.as_bytes()[start..]);
    writeln!(out, "*{check:02X}").expect("a String takes all");
}

/// CRC-8, polynomial x^8 + x^2 + x + 1, initial value 0, nothing reflected (Koopman's 0x83).
pub fn crc8(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |crc, &byte| {
        (0..8).fold(crc ^ byte, |crc: u8, _| if crc & 0x80 == 0 { crc << 1 } else { (crc << 1) ^ 0x07 })
    })
}

/// What a sequence of running numbers says about lost lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SequenceTracker {
    last: Option<(u64, SampleEye)>,
}

/// What one running number tells after those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SequenceEvent {
    /// The next one, the first one, or the other eye of the same instant.
    InOrder,
    /// This many numbers are missing.
    Gap(u64),
    /// The same number of the same eye again.
    Repeat,
    /// The count went backwards: the tracker restarted or its counter wrapped.
    Restart,
}

/// A longer leap of the running number is a new count, not a loss: an hour at 1 kHz.
const LONGEST_GAP: u64 = 3_600_000;

impl SequenceTracker {
    /// A tracker that has seen no number.
    pub const fn new() -> Self {
        Self { last: None }
    }

    /// Takes the next sample's number.
    pub fn next(&mut self, sequence: u64, eye: SampleEye) -> SequenceEvent {
        let Some((last, last_eye)) = self.last.replace((sequence, eye)) else {
            return SequenceEvent::InOrder;
        };
        match sequence.checked_sub(last) {
            None => SequenceEvent::Restart,
            Some(0) if eye == last_eye => SequenceEvent::Repeat,
            Some(0 | 1) => SequenceEvent::InOrder,
            Some(step) if step > LONGEST_GAP => SequenceEvent::Restart,
            Some(step) => SequenceEvent::Gap(step - 1),
        }
    }
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

    fn decode(bytes: &[u8]) -> Vec<LineEvent> {
        let mut events = Vec::new();
        let mut decoder = LineDecoder::new();
        decoder.push(bytes, |event| events.push(event));
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
        assert_eq!(decode(encoded(&sample()).as_bytes()), [LineEvent::Sample(sample())]);
        assert_eq!(encoded(&sample()), with_crc("P1,7,1234567,L,3.25,0.9").to_uppercase());
    }

    #[test]
    fn line_endings_comments_and_trailing_fields_are_accepted() {
        let text = format!(
            "# hello\r\n\n{}{}",
            with_crc("P1,7,1234567,L,3.25,0.9,future,*x").replace('\n', "\r\n"),
            encoded(&sample())
        );
        let both = LineEvent::Sample(sample());
        assert_eq!(decode(text.as_bytes()), [LineEvent::Comment, both, both]);
    }

    #[test]
    fn each_fault_has_its_reason() {
        let cases = [
            (format!("P1,{}\n", "9".repeat(300)), LineFault::TooLong),
            ("hello\n".into(), LineFault::Malformed),
            ("P1,\u{e9}\n".into(), LineFault::Malformed),
            ("Px,1,2\n".into(), LineFault::Malformed),
            (with_crc("P1,7,8,L"), LineFault::Malformed),
            (with_crc("P2,7,8,L,3,1"), LineFault::UnknownVersion),
            ("P1,7,8,L,3,1\n".into(), LineFault::BadCrc),
            ("P1,7,8,L,3,1*0\n".into(), LineFault::BadCrc),
            ("P1,7,8,L,3,1*+1\n".into(), LineFault::BadCrc),
            (with_crc("P1,7,8,L,3,1").replace("L,3", "L,4"), LineFault::BadCrc),
            (with_crc("P1,-7,8,L,3,1"), LineFault::BadNumber),
            (with_crc("P1,7,8.5,L,3,1"), LineFault::BadNumber),
            (with_crc("P1,7,8,L,three,1"), LineFault::BadNumber),
            (with_crc("P1,7,8,L,3,"), LineFault::BadNumber),
            (with_crc("P1,7,8,X,3,1"), LineFault::BadEye),
            (with_crc("P1,7,8,L,NaN,1"), LineFault::NotFinite),
            (with_crc("P1,7,8,L,3,inf"), LineFault::NotFinite),
            (with_crc("P1,7,8,L,-1,1"), LineFault::Negative),
            (with_crc("P1,7,8,L,3,1.01"), LineFault::BadConfidence),
            (with_crc("P1,7,8,L,3,-0.5"), LineFault::BadConfidence),
        ];
        for (text, fault) in cases {
            assert_eq!(decode(text.as_bytes()), [LineEvent::Rejected(fault)], "{text}");
        }
    }

    #[test]
    fn a_half_line_costs_itself_and_not_its_neighbour() {
        let half = &encoded(&sample())[..11];
        let text = format!("{half}{}{}", encoded(&sample()), encoded(&sample()));
        let good = LineEvent::Sample(sample());
        assert_eq!(decode(text.as_bytes()), [LineEvent::Rejected(LineFault::BadCrc), good, good]);
    }

    #[test]
    fn joining_in_the_middle_of_a_line_is_no_fault() {
        let mut events = Vec::new();
        let mut decoder = LineDecoder::joining();
        decoder.push(format!("{}{}", &encoded(&sample())[5..], encoded(&sample())).as_bytes(), |e| events.push(e));
        assert_eq!(events, [LineEvent::Partial, LineEvent::Sample(sample())]);
    }

    #[test]
    fn sequence_gaps_repeats_and_restarts_are_told_apart() {
        let mut tracker = SequenceTracker::default();
        let mut next = |sequence, eye| tracker.next(sequence, eye);
        assert_eq!(next(5, SampleEye::Left), SequenceEvent::InOrder);
        assert_eq!(next(5, SampleEye::Right), SequenceEvent::InOrder);
        assert_eq!(next(6, SampleEye::Left), SequenceEvent::InOrder);
        assert_eq!(next(6, SampleEye::Left), SequenceEvent::Repeat);
        assert_eq!(next(10, SampleEye::Left), SequenceEvent::Gap(3));
        assert_eq!(next(0, SampleEye::Left), SequenceEvent::Restart);
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
            let expected: Vec<_> = samples.into_iter().map(LineEvent::Sample).collect();
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
                decoder.push(now, |event| events.push(event));
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
            let samples = decode(&bytes).into_iter().filter(|event| matches!(event, LineEvent::Sample(_))).count();
            prop_assert_eq!(samples, 0);
        }
    }
}
