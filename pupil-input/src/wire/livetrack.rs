//! LiveTrack FM and AV of Cambridge Research Systems: ASCII rows over USB-CDC.
//!
//! ```text
//! leftEye; <frame>; <trigger 0|1>; <x>; <y>; <z>; <pupil>;
//! rightEye; <frame>; <trigger 0|1>; <x>; <y>; <z>; <pupil>;
//! ```
//!
//! Each eye's row ends in LF, with a CR on either side of it. The monocular AV may write `Eye` for the label. What
//! stands for the pupil is an area by the one public description and its width and height by the public reader's own
//! table of names, so [`LiveTrackSize`] says it; all are in the camera's units, and mm need a scale from a printed
//! pupil. The tracker answers `$Command` with a line that begins in `$`. (Layout: the LiveTrack reader of the GagLab
//! toolbox, `gaglab_livetrack` and `gaglab_eye_start`.)

use holod_calibration::TimeNs;

use super::text::{Line, LineBuffer, disc_diameter, number, size, trimmed, whole};
use super::{Decoder, WireEvent, WireFault, WireSample};
use crate::SampleEye;

/// Bytes of the longest row that is read.
const MAX_LINE_BYTES: usize = 512;

/// Where a row tells the pupil's size. Columns count from 0, the label.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LiveTrackSize {
    /// Its area, in this column: read as the diameter of the disc of that area.
    Area(usize),
    /// Its diameter, in this column.
    Diameter(usize),
    /// Its width and its height, in these columns: read as the diameter of the disc of that ellipse's area.
    Axes(usize, usize),
}

/// How a LiveTrack was set up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveTrackSettings {
    /// Where the pupil is.
    pub size: LiveTrackSize,
    /// Frames of the camera a second, greater than 0; the frame counter becomes the time by it. None: rows have no
    /// time.
    pub frames_per_second: Option<f64>,
    /// Bits of the frame counter, 1..=63: how far it counts before it wraps.
    pub counter_bits: u32,
    /// The eye of a row that does not say which.
    pub mono_eye: SampleEye,
}

impl Default for LiveTrackSettings {
    fn default() -> Self {
        Self { size: LiveTrackSize::Area(6), frames_per_second: None, counter_bits: 32, mono_eye: SampleEye::Both }
    }
}

/// Bytes in, one sample a row out.
///
/// A row that fails is searched for the beginning of another, so that a half row with a whole one behind it costs one
/// sample, not two.
#[derive(Clone, Debug)]
pub struct LiveTrackDecoder {
    settings: LiveTrackSettings,
    lines: LineBuffer,
    frames: FrameCounter,
}

impl LiveTrackDecoder {
    /// A decoder for a stream that may be joined in the middle of a row.
    pub fn new(settings: LiveTrackSettings) -> Self {
        Self { settings, lines: LineBuffer::joining(MAX_LINE_BYTES), frames: FrameCounter { last: None } }
    }
}

impl Decoder for LiveTrackDecoder {
    fn push(&mut self, bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        let Self { settings, lines, frames } = self;
        lines.push(bytes, |line| take_line(settings, frames, line, on_event));
    }

    fn finish(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        let Self { settings, lines, frames } = self;
        lines.finish(|line| take_line(settings, frames, line, on_event));
    }
}

/// A frame counter that wraps, made one that does not.
#[derive(Clone, Copy, Debug)]
struct FrameCounter {
    /// The last counter and what it stood for.
    last: Option<(u64, i64)>,
}

impl FrameCounter {
    /// Frames since the counter's first zero. The nearer way round is taken, so that one eye's row may be late, and a
    /// restart of the tracker goes back.
    fn unwrap(&mut self, counter: u64, bits: u32) -> i64 {
        let spare = 64 - bits.clamp(1, 63);
        let frame = match self.last {
            // The shifts lose what lies above the counter's bits and extend the sign.
            Some((last, frame)) => frame.saturating_add(((counter.wrapping_sub(last) << spare) as i64) >> spare),
            None => ((counter << spare) >> spare) as i64,
        };
        self.last = Some((counter, frame));
        frame
    }
}

fn take_line(
    settings: &LiveTrackSettings,
    frames: &mut FrameCounter,
    line: Line<'_>,
    on_event: &mut dyn FnMut(WireEvent),
) {
    if line.bytes.starts_with(b"$") {
        return on_event(WireEvent::Note);
    }
    let row = if line.overlong { Err(WireFault::TooLong) } else { read_row(settings, line.bytes) };
    let row = match row {
        Ok(row) => Some(row),
        Err(fault) => {
            on_event(line.rejected(fault));
            later_row(line.bytes).filter(|_| !line.overlong).and_then(|later| read_row(settings, later).ok())
        }
    };
    if let Some(row) = row {
        on_event(WireEvent::Sample(row.sample(settings, frames)));
    }
}

/// What a row says.
#[derive(Clone, Copy, Debug)]
struct Row {
    eye: SampleEye,
    counter: u64,
    diameter: f32,
}

impl Row {
    fn sample(self, settings: &LiveTrackSettings, frames: &mut FrameCounter) -> WireSample {
        let frame = frames.unwrap(self.counter, settings.counter_bits);
        WireSample {
            // The cast saturates.
            t_device: settings.frames_per_second.map(|rate| TimeNs((frame as f64 * 1e9 / rate).round() as i64)),
            eye: self.eye,
            diameter_mm: self.diameter,
            confidence: 1.0,
            aperture_mm: None,
            sequence: u64::try_from(frame).ok(),
            valid: self.diameter > 0.0,
        }
    }
}

fn read_row(settings: &LiveTrackSettings, row: &[u8]) -> Result<Row, WireFault> {
    // The row ends in a separator, so what comes behind the last one is no column.
    let row = row.strip_suffix(b";").ok_or(WireFault::TooShort)?;
    let column = |index: usize| row.split(|&byte| byte == b';').nth(index).map(trimmed).ok_or(WireFault::TooShort);
    let eye = match column(0)? {
        b"leftEye" => SampleEye::Left,
        b"rightEye" => SampleEye::Right,
        b"Eye" | b"eye" => settings.mono_eye,
        label if label.iter().all(u8::is_ascii_alphabetic) => return Err(WireFault::BadEye),
        _ => return Err(WireFault::Malformed),
    };
    let counter = whole(column(1)?)?;
    if !matches!(column(2)?, b"0" | b"1") {
        return Err(WireFault::Malformed);
    }
    // A half row with another behind it has a label among its figures.
    row.split(|&byte| byte == b';').skip(3).try_for_each(|figure| match number(figure) {
        Err(WireFault::BadNumber) => Err(WireFault::BadNumber),
        _ => Ok(()),
    })?;
    let figure = |index: usize| match number(column(index)?)? {
        negative if negative < 0.0 => Err(WireFault::Negative),
        figure => Ok(figure),
    };
    let diameter = size(match settings.size {
        LiveTrackSize::Area(area) => disc_diameter(figure(area)?),
        LiveTrackSize::Diameter(diameter) => figure(diameter)?,
        LiveTrackSize::Axes(width, height) => figure(width)?.sqrt() * figure(height)?.sqrt(),
    })?;
    Ok(Row { eye, counter, diameter })
}

/// A whole row behind a half one.
fn later_row(line: &[u8]) -> Option<&[u8]> {
    let start = |label: &[u8]| line.windows(label.len()).rposition(|window| window == label);
    let start = start(b"leftEye;").max(start(b"rightEye;")).filter(|&start| start > 0)?;
    Some(&line[start..])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> LiveTrackSettings {
        LiveTrackSettings { frames_per_second: Some(500.0), ..LiveTrackSettings::default() }
    }

    fn decode_with(settings: LiveTrackSettings, bytes: &[u8]) -> Vec<WireEvent> {
        let mut events = Vec::new();
        let mut decoder = LiveTrackDecoder::new(settings);
        decoder.push(b"$Calibrated;\n", &mut |_| {});
        decoder.push(bytes, &mut |event| events.push(event));
        decoder.finish(&mut |event| events.push(event));
        events
    }

    fn decode(text: &str) -> Vec<WireEvent> {
        decode_with(settings(), text.as_bytes())
    }

    fn sample(eye: SampleEye, frame: u64, diameter_mm: f32) -> WireEvent {
        WireEvent::Sample(WireSample {
            t_device: Some(TimeNs(frame as i64 * 2_000_000)),
            eye,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: None,
            sequence: Some(frame),
            valid: diameter_mm > 0.0,
        })
    }

    #[test]
    fn known_rows_read_as_their_fields() {
        // An area of 1256.637 is a disc of 40 across.
        let text = "leftEye;     1500; 0; 12.50; 3.25; 600.00; 1256.637;\n\r\
                    \rrightEye;     1500; 1; 11.50; 3.50; 601.00; 0.000;\n\r";
        let events = decode(text);
        let WireEvent::Sample(left) = events[0] else { panic!("{events:?}") };
        assert!((left.diameter_mm - 40.0).abs() < 1e-4, "{left:?}");
        assert_eq!(sample(SampleEye::Left, 1500, left.diameter_mm), events[0]);
        assert_eq!(events[1..], [sample(SampleEye::Right, 1500, 0.0)]);
    }

    #[test]
    fn width_and_height_make_the_disc_of_the_ellipse() {
        let row = b"Eye; 3; 0; 1.0; 2.0; 3.0; 50.0; 32.0;\r\n";
        let axes = LiveTrackSettings { size: LiveTrackSize::Axes(6, 7), mono_eye: SampleEye::Right, ..settings() };
        assert_eq!(decode_with(axes, row), [sample(SampleEye::Right, 3, 40.0)]);
        let width = LiveTrackSettings { size: LiveTrackSize::Diameter(6), ..settings() };
        assert_eq!(decode_with(width, row), [sample(SampleEye::Both, 3, 50.0)]);
    }

    #[test]
    fn each_fault_has_its_reason() {
        let cases = [
            (format!("leftEye; {}\n", "9".repeat(600)), WireFault::TooLong),
            ("leftEye; 1; 0; 1.0;\n".into(), WireFault::TooShort),
            ("leftEye; 1; 0; 1.0; 2.0; 3.0; 40\n".into(), WireFault::TooShort),
            ("hello;\n".into(), WireFault::BadEye),
            ("\u{e9}; 1;\n".into(), WireFault::Malformed),
            ("leftEye; 1; 2; 1.0; 2.0; 3.0; 40;\n".into(), WireFault::Malformed),
            ("leftEye; one; 0; 1.0; 2.0; 3.0; 40;\n".into(), WireFault::BadNumber),
            ("leftEye; -1; 0; 1.0; 2.0; 3.0; 40;\n".into(), WireFault::BadNumber),
            ("leftEye; 1; 0; 1.0; 2.0; 3.0; forty;\n".into(), WireFault::BadNumber),
            ("leftEye; 1; 0; 1.0; 2.0; 3.0; NaN;\n".into(), WireFault::NotFinite),
            ("leftEye; 1; 0; 1.0; 2.0; 3.0; -40;\n".into(), WireFault::Negative),
        ];
        for (text, fault) in cases {
            assert_eq!(decode(&text), [WireEvent::Rejected(fault)], "{text}");
        }
    }

    #[test]
    fn a_half_row_costs_itself_and_not_its_neighbour() {
        let text = "leftEye; 7; 0; 1.0; 2.leftEye; 8; 0; 1.0; 2.0; 3.0; 0;\n";
        assert_eq!(decode(text), [WireEvent::Rejected(WireFault::BadNumber), sample(SampleEye::Left, 8, 0.0)]);
    }

    #[test]
    fn joining_in_the_middle_of_a_row_is_no_fault() {
        let mut events = Vec::new();
        let mut decoder = LiveTrackDecoder::new(settings());
        decoder.push(b"2.0; 3.0; 5;\nleftEye; 8; 0; 1.0; 2.0; 3.0; 0;\n", &mut |event| events.push(event));
        assert_eq!(events, [WireEvent::Partial, sample(SampleEye::Left, 8, 0.0)]);
    }

    #[test]
    fn the_frame_counter_wraps_and_restarts() {
        let mut frames = FrameCounter { last: None };
        // One eye's row may come late, on either side of the wrap; 17 bits of a counter of 16 are one too many.
        let counters = [65_534, 65_535, 0, 65_535, 0, 1, 65_536 + 2];
        let expected = [65_534, 65_535, 65_536, 65_535, 65_536, 65_537, 65_538];
        assert_eq!(counters.map(|counter| frames.unwrap(counter, 16)), expected);
        let mut frames = FrameCounter { last: None };
        assert_eq!([70_000, 0, 1].map(|counter| frames.unwrap(counter, 32)), [70_000, 0, 1]);
        // A width that no counter has does no harm.
        for bits in [0, 1, 63, 64, 99] {
            let mut frames = FrameCounter { last: None };
            assert!(frames.unwrap(1 << 63, bits) >= 0);
            frames.unwrap(u64::MAX, bits);
        }
    }
}
