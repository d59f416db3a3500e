//! Gazepoint's Open Gaze API: lines of XML over TCP.
//!
//! ```text
//! <REC CNT="1484" TIME="5.01366" TIME_TICK="2096547271623" LPMM="4.80" LPMMV="1" RPMM="5.00" RPMMV="1" />
//! ```
//!
//! Lines end in CR LF. A record holds what the client has asked for (`ENABLE_SEND_PUPILMM` for the pupils in mm), in
//! any order; a flag `…V` of 0 says that the figure before it means nothing, though it may look good. `LPMM` and `RPMM`
//! are millimetres, `LPUPILD` and `RPUPILD` the same in metres, `LPD` and `RPD` pixels of the camera. `TIME` is seconds
//! since the start *or the last calibration*, so it falls back; `TIME_TICK` does not, and needs the rate that the
//! server tells for `TIME_TICK_FREQUENCY`. Lines of other kinds (`ACK`, `NACK`, `CAL`, `UPDATE`) are notes. Values may
//! hold entities; figures do not. (Layout: Gazepoint's Open Gaze API document, version 2.)

use holod_calibration::TimeNs;

use super::text::{Line, LineBuffer, number, size, time, trimmed, whole};
use super::{Decoder, WireEvent, WireFault, WireSample};
use crate::SampleEye;

/// Bytes of the longest line that is read; a record with everything is about 1500.
const MAX_LINE_BYTES: usize = 4096;

/// Which of a record's sizes is read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OpenGazeSize {
    /// `LPMM` and `RPMM`, or `LPUPILD` and `RPUPILD` where there are none: millimetres.
    #[default]
    Millimetres,
    /// `LPD` and `RPD`: pixels of the camera.
    Pixels,
}

/// How an Open Gaze server was set up.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OpenGazeSettings {
    /// Which size is read.
    pub size: OpenGazeSize,
    /// Ticks of `TIME_TICK` a second, greater than 0; the time is then read from it. None: from `TIME`.
    pub ticks_per_second: Option<f64>,
}

/// Bytes in, a sample for each eye of each record out.
///
/// A line that fails is searched for the beginning of another record, so that a half record with a whole one behind it
/// costs one record, not two.
#[derive(Clone, Debug)]
pub struct OpenGazeDecoder {
    settings: OpenGazeSettings,
    lines: LineBuffer,
}

impl OpenGazeDecoder {
    /// A decoder for a stream that may be joined in the middle of a line.
    pub fn new(settings: OpenGazeSettings) -> Self {
        Self { settings, lines: LineBuffer::joining(MAX_LINE_BYTES) }
    }
}

impl Decoder for OpenGazeDecoder {
    fn push(&mut self, bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        let Self { settings, lines } = self;
        lines.push(bytes, |line| take_line(settings, line, on_event));
    }

    fn finish(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        let Self { settings, lines } = self;
        lines.finish(|line| take_line(settings, line, on_event));
    }
}

fn take_line(settings: &OpenGazeSettings, line: Line<'_>, on_event: &mut dyn FnMut(WireEvent)) {
    let record = if line.overlong { Err(WireFault::TooLong) } else { read_line(line.bytes) };
    let record = match record {
        Ok(Some(record)) => Some(record),
        Ok(None) => return on_event(WireEvent::Note),
        Err(fault) => {
            on_event(line.rejected(fault));
            let start = line.bytes.windows(5).rposition(|window| window == b"<REC ").filter(|&start| start > 0);
            start.filter(|_| !line.overlong).and_then(|start| read_line(&line.bytes[start..]).ok().flatten())
        }
    };
    if let Some(record) = record {
        record.tell(settings, on_event);
    }
}

/// The attributes of a record that matter here, as text.
#[derive(Clone, Copy, Debug, Default)]
struct Record<'a> {
    counter: Option<&'a [u8]>,
    time_s: Option<&'a [u8]>,
    ticks: Option<&'a [u8]>,
    eyes: [Pupil<'a>; 2],
}

/// Sizes of one eye with their flags.
#[derive(Clone, Copy, Debug, Default)]
struct Pupil<'a> {
    mm: Figure<'a>,
    metres: Figure<'a>,
    pixels: Figure<'a>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Figure<'a> {
    figure: Option<&'a [u8]>,
    flag: Option<&'a [u8]>,
}

/// Reads a line; None where it is no record.
fn read_line(line: &[u8]) -> Result<Option<Record<'_>>, WireFault> {
    let line = line.strip_prefix(b"<").and_then(|line| line.strip_suffix(b">")).ok_or(WireFault::Malformed)?;
    let name = line.iter().position(|byte| !byte.is_ascii_uppercase()).unwrap_or(line.len());
    let (name, attributes) = line.split_at(name);
    if name != b"REC" {
        return if name.is_empty() { Err(WireFault::Malformed) } else { Ok(None) };
    }
    let mut rest = trimmed(attributes.strip_suffix(b"/").ok_or(WireFault::Malformed)?);
    let mut record = Record::default();
    while !rest.is_empty() {
        let (name, value, behind) = first_attribute(rest).ok_or(WireFault::Malformed)?;
        rest = behind;
        if let Some(place) = record.place(name) {
            *place = Some(value);
        }
    }
    Ok(Some(record))
}

/// Name and value of the first attribute, and what stands behind it.
fn first_attribute(text: &[u8]) -> Option<(&[u8], &[u8], &[u8])> {
    let equals = text.iter().position(|&byte| byte == b'=')?;
    let name = trimmed(&text[..equals]);
    let value = trimmed(&text[equals + 1..]);
    let (&quote, value) = value.split_first().filter(|(quote, _)| matches!(quote, b'"' | b'\''))?;
    let end = value.iter().position(|&byte| byte == quote)?;
    let is_name = !name.is_empty() && name.iter().all(|byte| byte.is_ascii_alphanumeric() || *byte == b'_');
    is_name.then(|| (name, &value[..end], trimmed(&value[end + 1..])))
}

impl<'a> Record<'a> {
    fn place(&mut self, name: &[u8]) -> Option<&mut Option<&'a [u8]>> {
        match name {
            b"CNT" => return Some(&mut self.counter),
            b"TIME" => return Some(&mut self.time_s),
            b"TIME_TICK" => return Some(&mut self.ticks),
            _ => {}
        }
        let (eye, name) = name.split_first()?;
        let eye = match eye {
            b'L' => &mut self.eyes[0],
            b'R' => &mut self.eyes[1],
            _ => return None,
        };
        Some(match name {
            b"PMM" => &mut eye.mm.figure,
            b"PMMV" => &mut eye.mm.flag,
            b"PUPILD" => &mut eye.metres.figure,
            b"PUPILV" => &mut eye.metres.flag,
            b"PD" => &mut eye.pixels.figure,
            b"PV" => &mut eye.pixels.flag,
            _ => return None,
        })
    }

    fn tell(&self, settings: &OpenGazeSettings, on_event: &mut dyn FnMut(WireEvent)) {
        let common = match self.common(settings) {
            Ok(common) => common,
            Err(fault) => return on_event(WireEvent::Rejected(fault)),
        };
        let mut told = false;
        for (eye, pupil) in [SampleEye::Left, SampleEye::Right].into_iter().zip(&self.eyes) {
            let Some(size) = pupil.size(settings.size) else { continue };
            told = true;
            let (diameter_mm, valid) = match size {
                Ok(figure) => figure,
                Err(fault) => {
                    on_event(WireEvent::Rejected(fault));
                    if !fault.is_of_a_figure() {
                        continue;
                    }
                    (0.0, false)
                }
            };
            on_event(WireEvent::Sample(WireSample { eye, diameter_mm, valid, ..common }));
        }
        if !told {
            on_event(WireEvent::Rejected(WireFault::MissingField));
        }
    }

    /// What the samples of both eyes have in common.
    fn common(&self, settings: &OpenGazeSettings) -> Result<WireSample, WireFault> {
        let t_device = match settings.ticks_per_second {
            // The cast saturates.
            Some(rate) => self.ticks.map(|ticks| Ok(TimeNs((number(ticks)? * 1e9 / rate).round() as i64))),
            None => self.time_s.map(|seconds| time(seconds, 1_000_000_000)),
        };
        Ok(WireSample {
            t_device: t_device.transpose()?,
            eye: SampleEye::Both,
            diameter_mm: 0.0,
            confidence: 1.0,
            aperture_mm: None,
            sequence: self.counter.map(whole).transpose()?,
            valid: false,
        })
    }
}

impl Pupil<'_> {
    /// Its diameter and whether the tracker stands by it; None where the record does not have it.
    fn size(&self, kind: OpenGazeSize) -> Option<Result<(f32, bool), WireFault>> {
        let (Figure { figure, flag }, scale) = match kind {
            OpenGazeSize::Millimetres if self.mm.figure.is_some() => (self.mm, 1.0),
            OpenGazeSize::Millimetres => (self.metres, 1000.0),
            OpenGazeSize::Pixels => (self.pixels, 1.0),
        };
        Some(figure?).map(|figure| {
            let valid = match flag.map(trimmed) {
                Some(b"1") | None => true,
                Some(b"0") => false,
                Some(_) => return Err(WireFault::BadNumber),
            };
            let diameter = size(number(figure)? * scale)?;
            if valid && diameter < 0.0 { Err(WireFault::Negative) } else { Ok((diameter, valid && diameter > 0.0)) }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decode_with(settings: OpenGazeSettings, text: &str) -> Vec<WireEvent> {
        let mut events = Vec::new();
        let mut decoder = OpenGazeDecoder::new(settings);
        decoder.push(b"<ACK ID=\"ENABLE_SEND_DATA\" STATE=\"1\" />\r\n", &mut |_| {});
        decoder.push(text.as_bytes(), &mut |event| events.push(event));
        decoder.finish(&mut |event| events.push(event));
        events
    }

    fn decode(text: &str) -> Vec<WireEvent> {
        decode_with(OpenGazeSettings::default(), text)
    }

    fn sample(eye: SampleEye, diameter_mm: f32, valid: bool) -> WireEvent {
        WireEvent::Sample(WireSample {
            t_device: Some(TimeNs(5_013_660_000)),
            eye,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: None,
            sequence: Some(1484),
            valid,
        })
    }

    /// A record as a server sends it that was asked for everything.
    const EVERYTHING: &str = "<REC CNT=\"1484\" TIME=\"5.01366\" TIME_TICK=\"2096547271623\" FPOGX=\"0.48439\" \
        FPOGY=\"0.50313\" FPOGS=\"1891.86768\" FPOGD=\"0.49280\" FPOGID=\"1599\" FPOGV=\"1\" LPCX=\"0.40525\" \
        LPCY=\"0.32822\" LPD=\"15.25\" LPS=\"1.04834\" LPV=\"1\" RPCX=\"0.79375\" RPCY=\"0.54131\" RPD=\"12.5\" \
        RPS=\"1.12750\" RPV=\"0\" LEYEX=\"-0.04796\" LEYEY=\"0.00305\" LEYEZ=\"0.69235\" LPUPILD=\"0.00210\" \
        LPUPILV=\"1\" REYEX=\"0.04321\" REYEY=\"0.00213\" REYEZ=\"0.66543\" RPUPILD=\"0.00240\" RPUPILV=\"1\" \
        KB=\" \" KBS=\"0\" BKID=\"0\" BKDUR=\"0.00000\" BKPMIN=\"6\" LPMM=\"4.75000\" LPMMV=\"1\" RPMM=\"5.16697\" \
        RPMMV=\"0\" DIAL=\"0.77700\" DIALV=\"1\" TTL0=\"-1\" TTLV=\"0\" USER=\"1 &lt;a/&gt; &quot;&#62; > /&gt;\" />\r\n";

    #[test]
    fn a_known_record_reads_as_its_fields() {
        assert_eq!(decode(EVERYTHING), [sample(SampleEye::Left, 4.75, true), sample(SampleEye::Right, 5.16697, false)]);
        let pixels = OpenGazeSettings { size: OpenGazeSize::Pixels, ..OpenGazeSettings::default() };
        assert_eq!(
            decode_with(pixels, EVERYTHING),
            [sample(SampleEye::Left, 15.25, true), sample(SampleEye::Right, 12.5, false)]
        );
    }

    #[test]
    fn ticks_are_read_with_their_rate() {
        let ticks = OpenGazeSettings { ticks_per_second: Some(1e7), ..OpenGazeSettings::default() };
        let events = decode_with(ticks, EVERYTHING);
        assert!(matches!(events[0], WireEvent::Sample(left) if left.t_device == Some(TimeNs(209_654_727_162_300))));
    }

    #[test]
    fn order_quotes_and_blanks_do_not_matter_and_metres_stand_in() {
        let text = "<REC RPMMV = '1'\tRPMM='5.0'  LPUPILD=\"0.0025\" LPUPILV=\"1\" TIME=\"5.01366\" CNT=\"1484\"/>\n";
        assert_eq!(decode(text), [sample(SampleEye::Left, 2.5, true), sample(SampleEye::Right, 5.0, true)]);
    }

    #[test]
    fn other_lines_are_notes() {
        let text = "<ACK ID=\"CALIBRATE_SHOW\" STATE =\"1\" />\r\n<NACK ID=\"X\" />\r\n\r\n\
                    <CAL ID=\"CALIB_START_PT\" PT=\"1\" CALX=\"0.5\" CALY=\"0.5\" />\r\n\
                    <UPDATE ACTIVE_ID=\"1\" MAX_ID=\"2\" >\r\n";
        assert_eq!(decode(text), [WireEvent::Note; 4]);
    }

    #[test]
    fn each_fault_has_its_reason() {
        let cases = [
            (format!("<REC USER=\"{}\" LPMM=\"4\" />\n", "x".repeat(5000)), WireFault::TooLong),
            ("hello\n".into(), WireFault::Malformed),
            ("<>\n".into(), WireFault::Malformed),
            ("<REC LPMM=\"4.8\" >\n".into(), WireFault::Malformed),
            ("<REC LPMM=\"4.8\" \n".into(), WireFault::Malformed),
            ("<REC LPMM=4.8 />\n".into(), WireFault::Malformed),
            ("<REC LPMM=\"4.8 />\n".into(), WireFault::Malformed),
            ("<REC ,=\"4.8\" />\n".into(), WireFault::Malformed),
            ("<REC TIME=\"1\" FPOGX=\"0.5\" />\n".into(), WireFault::MissingField),
            ("<REC />\n".into(), WireFault::MissingField),
            ("<REC LPMM=\"4,8\" />\n".into(), WireFault::BadNumber),
            ("<REC LPMM=\"4.8\" LPMMV=\"yes\" />\n".into(), WireFault::BadNumber),
            ("<REC TIME=\"now\" LPMM=\"4.8\" />\n".into(), WireFault::BadNumber),
            ("<REC CNT=\"-1\" LPMM=\"4.8\" />\n".into(), WireFault::BadNumber),
            ("<REC LPMM=\"nan\" />\n".into(), WireFault::NotFinite),
            ("<REC LPMM=\"-4.8\" LPMMV=\"1\" />\n".into(), WireFault::Negative),
        ];
        for (text, fault) in cases {
            let events = decode(&text);
            assert_eq!(events[0], WireEvent::Rejected(fault), "{text}");
            let lost = matches!(events[1..], [WireEvent::Sample(WireSample { valid: false, .. })]);
            assert_eq!((events.len() > 1, lost), (fault.is_of_a_figure(), fault.is_of_a_figure()), "{text}");
        }
    }

    #[test]
    fn one_eye_that_cannot_be_read_does_not_cost_the_other() {
        let text = "<REC CNT=\"1484\" TIME=\"5.01366\" LPMM=\"?\" LPMMV=\"1\" RPMM=\"0.0\" RPMMV=\"1\" />\n";
        let expected = [WireEvent::Rejected(WireFault::BadNumber), sample(SampleEye::Right, 0.0, false)];
        assert_eq!(decode(text), expected);
    }

    #[test]
    fn a_half_record_costs_itself_and_not_its_neighbour() {
        let events = decode(&format!("{}{EVERYTHING}", &EVERYTHING[..60]));
        assert_eq!(events[0], WireEvent::Rejected(WireFault::Malformed));
        assert_eq!(events[1..], decode(EVERYTHING));
    }

    #[test]
    fn joining_in_the_middle_of_a_record_is_no_fault() {
        let mut events = Vec::new();
        let mut decoder = OpenGazeDecoder::new(OpenGazeSettings::default());
        decoder.push(format!("{}{EVERYTHING}", &EVERYTHING[60..]).as_bytes(), &mut |event| events.push(event));
        assert_eq!(events[0], WireEvent::Partial);
        assert_eq!(events[1..], decode(EVERYTHING));
    }
}
