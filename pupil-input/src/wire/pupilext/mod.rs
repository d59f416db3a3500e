//! PupilEXT's data streaming: CSV rows or JSON objects over a serial port or UDP.
//!
//! One message a frame, text with decimal points, ending in LF. A *view* is what one camera sees of one eye.
//!
//! The rows are read in `csv.rs`, the objects in `json.rs`.
//!
//! A figure of −1 means *not found* (also: no calibration, for millimetres; an algorithm without confidence). (Layouts:
//! Open-PupilEXT, `eyeDataSerializer`, `dataStreamer` and `pDataTypes`.)

mod csv;
mod json;

use holod_calibration::TimeNs;

use super::text::{LineBuffer, size};
use super::{Decoder, WireEvent, WireFault, WireSample};
use crate::SampleEye;
use csv::take_row;
use json::Scanner;

/// Bytes of the longest row that is read.
const MAX_LINE_BYTES: usize = 2048;

/// How messages are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum PupilExtContainer {
    /// Rows with this ASCII character between columns.
    Csv { delimiter: u8 },
    /// JSON objects, one a frame.
    Json,
}

/// Which size is read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PupilExtSize {
    /// `physicalDiameter_mm`; −1 until PupilEXT has been calibrated.
    #[default]
    Millimetres,
    /// `diameter_px`, of the main camera.
    Pixels,
    /// `undistortedDiameter_px`, of the main camera.
    UndistortedPixels,
}

/// Which eyes PupilEXT looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PupilExtEyes {
    /// One: this, or the one that the message names where this is [`SampleEye::Both`].
    One(SampleEye),
    /// Two; its `A` is the right one.
    Two,
}

/// How PupilEXT was set up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PupilExtSettings {
    /// How messages are written.
    pub container: PupilExtContainer,
    /// The eyes it looks at.
    pub eyes: PupilExtEyes,
    /// Whether two cameras look at each eye, so that a message has two views of it.
    pub stereo: bool,
    /// The size that is read.
    pub size: PupilExtSize,
}

impl Default for PupilExtSettings {
    fn default() -> Self {
        Self {
            container: PupilExtContainer::Csv { delimiter: b',' },
            eyes: PupilExtEyes::One(SampleEye::Both),
            stereo: false,
            size: PupilExtSize::Millimetres,
        }
    }
}

/// Bytes in, a sample for each eye of each message out.
#[derive(Clone, Debug)]
pub struct PupilExtDecoder {
    settings: PupilExtSettings,
    reader: Reader,
}

#[derive(Clone, Debug)]
enum Reader {
    Csv { delimiter: u8, lines: LineBuffer },
    Json(Box<Scanner>),
}

impl PupilExtDecoder {
    /// A decoder for a stream that may be joined in the middle of a message.
    pub fn new(settings: PupilExtSettings) -> Self {
        let reader = match settings.container {
            PupilExtContainer::Csv { delimiter } => {
                Reader::Csv { delimiter, lines: LineBuffer::joining(MAX_LINE_BYTES) }
            }
            PupilExtContainer::Json => Reader::Json(Box::new(Scanner::joining())),
        };
        Self { settings, reader }
    }
}

impl Decoder for PupilExtDecoder {
    fn push(&mut self, bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        let settings = &self.settings;
        match &mut self.reader {
            Reader::Csv { delimiter, lines } => lines.push(bytes, |row| take_row(settings, *delimiter, row, on_event)),
            Reader::Json(scanner) => scanner.push(settings, bytes, on_event),
        }
    }

    fn finish(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        let settings = &self.settings;
        match &mut self.reader {
            Reader::Csv { delimiter, lines } => lines.finish(|row| take_row(settings, *delimiter, row, on_event)),
            Reader::Json(scanner) => scanner.end(),
        }
    }
}

/// What a view says, as far as it matters.
#[derive(Clone, Copy, Debug, Default)]
struct View {
    t_device: Option<TimeNs>,
    diameter: Option<f64>,
    /// The main camera's, where the size that is read is another.
    diameter_px: Option<f64>,
    confidence: Option<f64>,
    outline_confidence: Option<f64>,
    fault: Option<WireFault>,
    /// It has one of PupilEXT's fields.
    known: bool,
}

impl View {
    /// A sample; a lost one beside the fault, where it is for want of a calibration alone.
    fn sample(&self, eye: SampleEye) -> Result<(WireSample, Option<WireFault>), WireFault> {
        if let Some(fault) = self.fault {
            return Err(fault);
        }
        let t_device = self.t_device.ok_or(WireFault::MissingField)?;
        let diameter = self.diameter.ok_or(WireFault::MissingField)?;
        if diameter < 0.0 && diameter != NOT_FOUND {
            return Err(WireFault::Negative);
        }
        let given = |confidence: Option<f64>| confidence.filter(|&confidence| confidence != NOT_FOUND);
        let confidence = given(self.confidence).or(given(self.outline_confidence)).unwrap_or(1.0);
        if !(0.0..=1.0).contains(&confidence) {
            return Err(WireFault::BadConfidence);
        }
        let is_seen = self.diameter_px.is_some_and(|diameter_px| diameter_px > 0.0);
        let sample = WireSample {
            t_device: Some(t_device),
            eye,
            diameter_mm: size(diameter)?,
            confidence: confidence as f32,
            aperture_mm: None,
            sequence: None,
            valid: diameter > 0.0,
        };
        Ok((sample, (diameter == NOT_FOUND && is_seen).then_some(WireFault::Uncalibrated)))
    }
}

/// PupilEXT's figure for what it has not.
const NOT_FOUND: f64 = -1.0;
const NS_PER_MS: u32 = 1_000_000;

fn on_fault(fault: Option<WireFault>, on_event: &mut dyn FnMut(WireEvent)) {
    if let Some(fault) = fault {
        on_event(WireEvent::Rejected(fault));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn csv(eyes: PupilExtEyes, stereo: bool) -> PupilExtSettings {
        PupilExtSettings { eyes, stereo, ..PupilExtSettings::default() }
    }

    fn json() -> PupilExtSettings {
        PupilExtSettings { container: PupilExtContainer::Json, ..PupilExtSettings::default() }
    }

    fn decode(settings: PupilExtSettings, text: &str) -> Vec<WireEvent> {
        let mut events = Vec::new();
        let mut decoder = PupilExtDecoder::new(settings);
        // What begins the stream may be told as a part of something.
        decoder.push(b"timestamp_ms\n", &mut |_| {});
        decoder.push(b"\n{}\n", &mut |_| {});
        decoder.push(text.as_bytes(), &mut |event| events.push(event));
        decoder.finish(&mut |event| events.push(event));
        events
    }

    fn sample(eye: SampleEye, diameter_mm: f32, confidence: f32) -> WireEvent {
        WireEvent::Sample(WireSample {
            t_device: Some(TimeNs(1_700_000_000_123_000_000)),
            eye,
            diameter_mm,
            confidence,
            aperture_mm: None,
            sequence: None,
            valid: diameter_mm > 0.0,
        })
    }

    /// One view: a pupil of 41.2 px, 41.5 px undistorted, 3.25 mm.
    const FIGURES: &str = "41.2,41.5,3.25,41.2,39.8,1.03518,321.5,240.25,12.5,127.3,0.95,0.875";

    #[test]
    fn known_rows_of_one_eye_read_as_their_fields() {
        let one = csv(PupilExtEyes::One(SampleEye::Left), false);
        let rows = [
            format!("1700000000123,PuRe,{FIGURES},3,no message,36.5\n"),
            format!("1700000000123,,{FIGURES},3,one, with, commas,36.5\r\n"),
            format!("1700000000123,{FIGURES},3,,36.5,-1\n"),
            format!("000017.bmp,1700000000123,ElSe,{FIGURES}\n"),
        ];
        for row in &rows {
            assert_eq!(decode(one, row), [sample(SampleEye::Left, 3.25, 0.95)], "{row}");
            let pixels = PupilExtSettings { size: PupilExtSize::Pixels, ..one };
            assert_eq!(decode(pixels, row), [sample(SampleEye::Left, 41.2, 0.95)], "{row}");
            let undistorted = PupilExtSettings { size: PupilExtSize::UndistortedPixels, ..one };
            assert_eq!(decode(undistorted, row), [sample(SampleEye::Left, 41.5, 0.95)], "{row}");
        }
    }

    #[test]
    fn known_rows_of_two_eyes_and_two_cameras_read_as_their_fields() {
        let two = csv(PupilExtEyes::Two, false);
        let row = "1700000000123,PuRe,41,42,41.5,42.5,3.25,3.5,41,40,1.02,42,40,1.05,1,2,3,4,5,6,127,130,0.9,0.8,0.7,0.6,3,,36\n";
        let expected = [sample(SampleEye::Right, 3.25, 0.9), sample(SampleEye::Left, 3.5, 0.7)];
        assert_eq!(decode(two, row), expected);
        let stereo = csv(PupilExtEyes::Two, true);
        let views = [FIGURES, "0,0,0,0,0,0,0,0,0,0,0,0", "40,40.5,-1,40,39,1,1,2,3,127,-1,-1", FIGURES].join(",");
        let uncalibrated = WireEvent::Rejected(WireFault::Uncalibrated);
        let expected = [sample(SampleEye::Right, 3.25, 0.95), uncalibrated, sample(SampleEye::Left, -1.0, 1.0)];
        assert_eq!(decode(stereo, &format!("1700000000123,{views},3,,36,37\n")), expected);
        let settings = PupilExtSettings { container: PupilExtContainer::Csv { delimiter: b';' }, ..stereo };
        assert_eq!(decode(settings, &format!("1700000000123,{views},3,,36,37\n").replace(',', ";")), expected);
    }

    #[test]
    fn two_eyes_are_not_read_as_one() {
        let one = csv(PupilExtEyes::One(SampleEye::Both), false);
        let old =
            "1700000000123,PuRe,41,42,41.5,42.5,3.25,3.5,41,40,1.02,42,40,1.05,1,2,3,4,5,6,127,130,0.9,0.8,0.7,0.6";
        for row in
            [format!("1700000000123,{FIGURES},{FIGURES},3,,36,37\n"), format!("{old},3,,36\n"), format!("{old}\n")]
        {
            assert_eq!(decode(one, &row), [WireEvent::Rejected(WireFault::MoreViews)], "{row}");
            assert_eq!(decode(csv(PupilExtEyes::Two, false), &row).len(), 2);
        }
        // The message of a row may have commas.
        let row = format!("1700000000123,{FIGURES},3,{},36,37\n", "a,".repeat(20));
        assert_eq!(decode(one, &row), [sample(SampleEye::Both, 3.25, 0.95)]);

        let eyes = |names: &[&str]| {
            message(&names.iter().map(|name| (*name, view("Main", "old", "3.25"))).collect::<Vec<_>>())
        };
        let refused = WireEvent::Rejected(WireFault::MoreViews);
        let first = sample(SampleEye::Both, 3.25, 0.95);
        // Of the first message one eye is told before the other is seen.
        assert_eq!(decode(json(), &eyes(&["A", "B"]).repeat(2)), [first, refused, refused, refused]);
        let alone = format!("{}{}", eyes(&["A", "B"]), eyes(&["A"]).repeat(2));
        assert_eq!(decode(json(), &alone), [first, refused, refused, first]);
    }

    #[test]
    fn two_eyes_in_datagrams_are_not_read_as_one() {
        let both = message(&[("A", view("Main", "old", "3.25")), ("B", view("Main", "old", "6.5"))]);
        let mut decoder = PupilExtDecoder::new(json());
        let mut events = Vec::new();
        for datagram in [&both, &both, &both[..300].to_owned(), &both] {
            decoder.push(datagram.as_bytes(), &mut |event| events.push(event));
            decoder.finish(&mut |event| events.push(event));
        }
        let refused = WireEvent::Rejected(WireFault::MoreViews);
        assert_eq!(events, [&[sample(SampleEye::Both, 3.25, 0.95)][..], &[refused; 5]].concat());
        // Another connection may be to another tracker.
        assert!(!decoder.rejoin());
    }

    #[test]
    fn datagrams_that_are_no_json_are_told_each() {
        let mut decoder = PupilExtDecoder::new(json());
        let mut events = Vec::new();
        for _ in 0..3 {
            decoder.push(b"hello", &mut |event| events.push(event));
            decoder.finish(&mut |event| events.push(event));
        }
        let refused = WireEvent::Rejected(WireFault::OutOfStep);
        assert_eq!(events, [WireEvent::Partial, refused, refused]);
    }

    #[test]
    fn a_pupil_that_is_seen_and_has_no_millimetres_is_uncalibrated() {
        let expected = [WireEvent::Rejected(WireFault::Uncalibrated), sample(SampleEye::Both, -1.0, 0.95)];
        assert_eq!(decode(json(), &message(&[("A", view("Main", "old", "-1"))])), expected);
        assert_eq!(decode(json(), &message(&[("R", view("Main", "new", "-1"))]))[0], expected[0]);
        let one = csv(PupilExtEyes::One(SampleEye::Both), false);
        let row = format!("1700000000123,PuRe,{},3,,36.5\n", FIGURES.replace("3.25", "-1"));
        assert_eq!(decode(one, &row), expected);
        // In pixels nothing is missing.
        let pixels = PupilExtSettings { size: PupilExtSize::Pixels, ..one };
        assert_eq!(decode(pixels, &row), [sample(SampleEye::Both, 41.2, 0.95)]);
    }

    #[test]
    fn each_fault_of_a_row_has_its_reason() {
        let row = |figures: &str| format!("1700000000123,PuRe,{figures},3,,36.5\n");
        let cases = [
            ("9".repeat(3000) + "\n", WireFault::TooLong),
            ("1700000000123,PuRe,41.2,41.5\n".into(), WireFault::TooShort),
            ("hello\n".into(), WireFault::TooShort),
            (row(FIGURES).replace("1700000000123", "noon"), WireFault::BadNumber),
            (row(&FIGURES.replace("3.25", "x")), WireFault::BadNumber),
            (row(&FIGURES.replace("127.3", "")), WireFault::BadNumber),
            (row(&FIGURES.replace("3.25", "nan")), WireFault::NotFinite),
            (row(&FIGURES.replace("3.25", "1e300")), WireFault::NotFinite),
            (row(&FIGURES.replace("3.25", "-2")), WireFault::Negative),
            (row(&FIGURES.replace("0.95", "1.5")), WireFault::BadConfidence),
            (row(&FIGURES.replace("0.95", "-0.5")), WireFault::BadConfidence),
        ];
        for (text, fault) in cases {
            let one = csv(PupilExtEyes::One(SampleEye::Left), false);
            assert_eq!(decode(one, &text), [WireEvent::Rejected(fault)], "{text}");
        }
    }

    #[test]
    fn what_is_not_found_is_lost_and_a_missing_confidence_is_full() {
        let one = csv(PupilExtEyes::One(SampleEye::Left), false);
        let row = format!("1700000000123,PuRe,{}-1,-1,3,,36.5\n", "-1,".repeat(10));
        assert_eq!(decode(one, &row), [sample(SampleEye::Left, -1.0, 1.0)]);
        let row = format!("1700000000123,PuRe,{},3,,36.5\n", FIGURES.replace("0.95", "-1"));
        assert_eq!(decode(one, &row), [sample(SampleEye::Left, 3.25, 0.875)]);
    }

    #[test]
    fn a_half_row_costs_itself_and_one_more() {
        let row = format!("1700000000123,PuRe,{FIGURES},3,,36.5\n");
        let one = csv(PupilExtEyes::One(SampleEye::Left), false);
        let events = decode(one, &format!("{}{row}{row}", &row[..30]));
        assert_eq!(events, [WireEvent::Rejected(WireFault::BadNumber), sample(SampleEye::Left, 3.25, 0.95)]);
    }

    /// A view as PupilEXT writes it, with names and figures replaced.
    fn view(name: &str, names: &str, physical: &str) -> String {
        let (prefix, diameter) = if names == "new" { ("pupil", "D") } else { ("", "d") };
        let upper = if names == "new" { ["C", "O", "P", "U"] } else { ["c", "o", "p", "u"] };
        let [c, o, p, u] = upper;
        format!(
            "            \"{name}\": {{\n                \"algorithm\": \"PuRe\",\n                \
             \"{prefix}{c}onfidence\": \"0.95\",\n                \"{prefix}{diameter}iameter_px\": \"41.2\",\n                \
             \"filename\": \"a \\\"{{b\\\\\",\n                \"{prefix}{o}utlineConfidence\": \"0.875\",\n                \
             \"{prefix}{p}hysicalDiameter_mm\": \"{physical}\",\n                \"timestamp_ms\": \"1700000000123\",\n                \
             \"{prefix}{u}ndistortedDiameter_px\": \"41.5\"\n            }}"
        )
    }

    fn message(eyes: &[(&str, String)]) -> String {
        let eyes: Vec<_> =
            eyes.iter().map(|(eye, views)| format!("        \"{eye}\": {{\n{views}\n        }}")).collect();
        format!("{{\n    \"EyeData\": {{\n{}\n    }}\n}}\n\n", eyes.join(",\n"))
    }

    #[test]
    fn known_objects_read_as_their_fields() {
        let two = PupilExtSettings { eyes: PupilExtEyes::Two, stereo: true, ..json() };
        let text = message(&[
            ("A", format!("{},\n{}", view("Main", "old", "3.25"), view("Sec", "old", "3.25"))),
            ("B", view("Main", "old", "-1")),
        ]);
        let uncalibrated = WireEvent::Rejected(WireFault::Uncalibrated);
        let expected = [sample(SampleEye::Right, 3.25, 0.95), uncalibrated, sample(SampleEye::Left, -1.0, 0.95)];
        assert_eq!(decode(two, &text.repeat(2)), [expected, expected].concat());
        let pixels = PupilExtSettings { size: PupilExtSize::UndistortedPixels, ..two };
        assert_eq!(decode(pixels, &text), [SampleEye::Right, SampleEye::Left].map(|eye| sample(eye, 41.5, 0.95)));
        // Later versions name the eye; a rig that knows better is believed.
        let text = message(&[("L", view("Main", "new", "3.5"))]);
        assert_eq!(decode(json(), &text), [sample(SampleEye::Left, 3.5, 0.95)]);
        let right = PupilExtSettings { eyes: PupilExtEyes::One(SampleEye::Right), ..json() };
        assert_eq!(decode(right, &text), [sample(SampleEye::Right, 3.5, 0.95)]);
    }

    #[test]
    fn flat_objects_in_one_line_and_bare_figures_are_read() {
        let text =
            "{\"timestamp_ms\":1700000000123,\"physicalDiameter_mm\":3.25,\"x\":[1,{\"a\":null},[]],\"confidence\":1}";
        assert_eq!(decode(json(), &format!("{text}\n{text}{text}")), [sample(SampleEye::Both, 3.25, 1.0); 3]);
        assert_eq!(decode(json(), "{\"EyeData\":{}}\n"), [WireEvent::Note]);
    }

    #[test]
    fn each_fault_of_an_object_has_its_reason() {
        let with = |fields: &str| format!("{{\"timestamp_ms\":\"1700000000123\",{fields}}}\n");
        let cases = [
            ("hello\n".into(), WireFault::OutOfStep),
            ("{\"a\" 1}\n".into(), WireFault::Malformed),
            ("{\"a\": 1]\n".into(), WireFault::Malformed),
            ("{\"a\": [1}\n".into(), WireFault::Malformed),
            ("{\"a\": \"\n\"}\n".into(), WireFault::Malformed),
            (format!("{{\"a\":{}\n", "[".repeat(20)), WireFault::Malformed),
            ("{\"physicalDiameter_mm\": 3}\n".into(), WireFault::MissingField),
            (with("\"diameter_px\": 3"), WireFault::MissingField),
            (with("\"physicalDiameter_mm\": null"), WireFault::BadNumber),
            (with("\"physicalDiameter_mm\": {}"), WireFault::MissingField),
            (with(&format!("\"physicalDiameter_mm\": {}", "1".repeat(50))), WireFault::BadNumber),
            (with("\"physicalDiameter_mm\": \"inf\""), WireFault::NotFinite),
            (with("\"physicalDiameter_mm\": -3"), WireFault::Negative),
            (with("\"physicalDiameter_mm\": 3, \"confidence\": 2"), WireFault::BadConfidence),
        ];
        for (text, fault) in cases {
            assert_eq!(decode(json(), &text), [WireEvent::Rejected(fault)], "{text}");
        }
    }

    #[test]
    fn a_cut_object_costs_itself_and_not_its_neighbour() {
        let text = message(&[("A", view("Main", "old", "3.25"))]);
        let good = sample(SampleEye::Both, 3.25, 0.95);
        for cut in [1, 40, 140, 150, 400] {
            let events = decode(json(), &format!("{}\n{text}{text}", &text[..cut]));
            assert_eq!(events, [WireEvent::Rejected(WireFault::Malformed), good, good], "{cut}");
        }
    }

    #[test]
    fn joining_in_the_middle_of_an_object_is_no_fault() {
        let text = message(&[("A", view("Main", "old", "3.25"))]);
        let mut events = Vec::new();
        let mut decoder = PupilExtDecoder::new(json());
        decoder.push(format!("{}{text}", &text[200..]).as_bytes(), &mut |event| events.push(event));
        assert_eq!(events, [WireEvent::Partial, sample(SampleEye::Both, 3.25, 0.95)]);
    }

    #[test]
    fn a_stream_that_is_no_json_is_told_again_and_again() {
        assert_eq!(decode(json(), &"hello\n".repeat(1000)), [WireEvent::Rejected(WireFault::OutOfStep); 3]);
    }
}
