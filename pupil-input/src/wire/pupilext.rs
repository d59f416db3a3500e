//! PupilEXT's data streaming: CSV rows or JSON objects over a serial port or UDP.
//!
//! One message a frame, text with decimal points, ending in LF. A *view* is what one camera sees of one eye.
//!
//! **CSV** (no header, no quotes; the delimiter is PupilEXT's setting, `,` by default). Versions up to 0.1.2:
//!
//! ```text
//! [filename,]timestamp_ms,algorithm,diameter_px…,undistortedDiameter_px…,physicalDiameter_mm…,
//!   (width_px,height_px,axisRatio)…,(center_x,center_y)…,angle_deg…,circumference_px…,
//!   (confidence,outlineConfidence)…[,trial,message,temperature_c…]
//! ```
//!
//! where `…` is once for each view, A before B and Main before Sec (`physicalDiameter_mm` once for each eye).
//! `filename` is only in rows as 0.1.1 records them, without `trial` and what follows. Later versions have no
//! algorithm, and the figures stand view by view, right before left:
//!
//! ```text
//! timestamp_ms,(diameter_px,undistortedDiameter_px,physicalDiameter_mm,width_px,height_px,axisRatio,
//!   centerX_px,centerY_px,angle_deg,circumference_px,confidence,outlineConfidence)…,trial,message,temperature_c,temperature_c
//! ```
//!
//! Rows of the two kinds are told apart by the algorithm, which is no number.
//!
//! **JSON** is spread over many lines (or one), and its figures are strings:
//!
//! ```text
//! { "EyeData": { "A": { "Main": { "diameter_px": "41.2", "physicalDiameter_mm": "3.25", "timestamp_ms": "1700000000123", … } } } }
//! ```
//!
//! with `A` and `B` up to 0.1.2, and later `R` and `L` and names such as `pupilDiameter_px`. Each message's brace
//! stands at the beginning of a line and no other does, so that is where reading begins anew after anything bad. The
//! scanner is written by hand: it keeps the few figures that matter and no text, so a message may be of any length.
//!
//! A figure of −1 means *not found* (also: no calibration, for millimetres; an algorithm without confidence). (Layouts:
//! Open-PupilEXT, `eyeDataSerializer`, `dataStreamer` and `pDataTypes`.)

use holod_calibration::TimeNs;

use super::buffer::Beginning;
use super::text::{Line, LineBuffer, number, size, time};
use super::{Decoder, WireEvent, WireFault, WireSample};
use crate::SampleEye;

/// Bytes of the longest row that is read.
const MAX_LINE_BYTES: usize = 2048;
/// Columns of the longest row that is known.
const MAX_COLUMNS: usize = 53;
/// How deep a message of JSON may be nested; PupilEXT's are 4 deep.
const MAX_DEPTH: usize = 8;
/// Bytes of the longest name and figure in JSON that matter.
const MAX_TOKEN_BYTES: usize = 40;

/// How messages are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum PupilExtContainer {
    /// Rows with this ASCII character between columns.
    Csv { delimiter: u8 },
    /// Objects.
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
    /// One: this.
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
    /// Two cameras.
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

/// Where a row has an eye's figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Columns {
    diameter: usize,
    undistorted: usize,
    physical: usize,
    /// And behind it the outline's confidence.
    confidence: usize,
}

/// The columns of eye `eye` (0 or 1) up to version 0.1.2, without a file name.
fn old_columns(settings: &PupilExtSettings, eye: usize) -> Columns {
    let [diameter, undistorted, physical, confidence] = match (settings.eyes, settings.stereo) {
        (PupilExtEyes::One(_), false) => [2, 3, 4, 12],
        (PupilExtEyes::Two, false) => [2 + eye, 4 + eye, 6 + eye, 22 + 2 * eye],
        (PupilExtEyes::One(_), true) => [2, 4, 6, 21],
        (PupilExtEyes::Two, true) => [2 + 2 * eye, 6 + 2 * eye, 10 + eye, 40 + 4 * eye],
    };
    Columns { diameter, undistorted, physical, confidence }
}

/// The columns of eye `eye` of later versions.
fn new_columns(settings: &PupilExtSettings, eye: usize) -> Columns {
    let first = 1 + VIEW_COLUMNS * if settings.stereo { 2 * eye } else { eye };
    Columns { diameter: first, undistorted: first + 1, physical: first + 2, confidence: first + 10 }
}

/// Columns of a view in later versions.
const VIEW_COLUMNS: usize = 12;

/// Columns up to and with the last confidence.
#[derive(Clone, Copy, Debug)]
struct Widths {
    old: usize,
    new: usize,
}

fn widths(settings: &PupilExtSettings) -> Widths {
    match (settings.eyes, settings.stereo) {
        (PupilExtEyes::One(_), false) => Widths { old: 14, new: 1 + VIEW_COLUMNS },
        (PupilExtEyes::Two, false) => Widths { old: 26, new: 1 + 2 * VIEW_COLUMNS },
        (PupilExtEyes::One(_), true) => Widths { old: 25, new: 1 + 2 * VIEW_COLUMNS },
        (PupilExtEyes::Two, true) => Widths { old: 48, new: 1 + 4 * VIEW_COLUMNS },
    }
}

fn take_row(settings: &PupilExtSettings, delimiter: u8, row: Line<'_>, on_event: &mut dyn FnMut(WireEvent)) {
    if row.bytes.starts_with(b"timestamp_ms") || row.bytes.starts_with(b"filename") {
        return on_event(WireEvent::Note);
    }
    if row.overlong {
        return on_event(row.rejected(WireFault::TooLong));
    }
    let mut columns = [&[][..]; MAX_COLUMNS];
    let mut count = 0;
    for column in row.bytes.split(|&byte| byte == delimiter) {
        if let Some(place) = columns.get_mut(count) {
            *place = column;
        }
        count += 1;
    }
    let columns = &columns[..count.min(MAX_COLUMNS)];
    let is_new = columns.get(1).is_some_and(|second| number(second) != Err(WireFault::BadNumber));
    let Widths { old, new } = widths(settings);
    // A row as 0.1.1 records it is the shortest, and its columns are one later.
    let is_recorded = count == old + 1 && number(columns[2]) == Err(WireFault::BadNumber);
    let (all, first_figure, width) = match (is_recorded, is_new) {
        (true, _) => (&columns[1..], 2, old),
        (false, true) => (columns, 1, new),
        (false, false) => (columns, 2, old),
    };
    let Some(columns) = all.get(..width) else {
        return on_event(row.rejected(WireFault::TooShort));
    };
    let are_figures =
        |columns: &[&[u8]]| columns[first_figure..].iter().all(|figure| number(figure) != Err(WireFault::BadNumber));
    // A half row with another behind it has the other's algorithm among its figures.
    if !are_figures(columns) {
        return on_event(row.rejected(WireFault::BadNumber));
    }
    // Which view would be whose is not known then. A message of the user's may have delimiters, and is no figure.
    let twice = widths(&PupilExtSettings { eyes: PupilExtEyes::Two, ..*settings });
    let twice = if first_figure == 1 { twice.new } else { twice.old };
    if settings.eyes != PupilExtEyes::Two && all.get(..twice).is_some_and(are_figures) {
        return on_event(row.rejected(WireFault::MoreViews));
    }
    let eyes: &[SampleEye] = match settings.eyes {
        PupilExtEyes::One(ref eye) => std::slice::from_ref(eye),
        PupilExtEyes::Two => &[SampleEye::Right, SampleEye::Left],
    };
    for (index, &eye) in eyes.iter().enumerate() {
        let places = if first_figure == 1 { new_columns(settings, index) } else { old_columns(settings, index) };
        match view_of(settings, columns, places).and_then(|view| view.sample(eye)) {
            Ok((sample, fault)) => {
                on_fault(fault, on_event);
                on_event(WireEvent::Sample(sample));
            }
            Err(fault) => on_event(row.rejected(fault)),
        }
    }
}

fn on_fault(fault: Option<WireFault>, on_event: &mut dyn FnMut(WireEvent)) {
    if let Some(fault) = fault {
        on_event(WireEvent::Rejected(fault));
    }
}

fn view_of(settings: &PupilExtSettings, columns: &[&[u8]], places: Columns) -> Result<View, WireFault> {
    let diameter = match settings.size {
        PupilExtSize::Millimetres => places.physical,
        PupilExtSize::Pixels => places.diameter,
        PupilExtSize::UndistortedPixels => places.undistorted,
    };
    Ok(View {
        t_device: Some(time(columns[0], NS_PER_MS)?),
        diameter: Some(number(columns[diameter])?),
        diameter_px: match settings.size {
            PupilExtSize::Millimetres => Some(number(columns[places.diameter])?),
            PupilExtSize::Pixels | PupilExtSize::UndistortedPixels => None,
        },
        confidence: Some(number(columns[places.confidence])?),
        outline_confidence: Some(number(columns[places.confidence + 1])?),
        fault: None,
        known: true,
    })
}

/// A field of a view that matters, by its name in JSON.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Field {
    Timestamp,
    Size(PupilExtSize),
    Confidence,
    OutlineConfidence,
}

impl Field {
    fn by_name(name: &[u8]) -> Option<Self> {
        Some(match name {
            b"timestamp_ms" => Self::Timestamp,
            b"physicalDiameter_mm" | b"pupilPhysicalDiameter_mm" => Self::Size(PupilExtSize::Millimetres),
            b"diameter_px" | b"pupilDiameter_px" => Self::Size(PupilExtSize::Pixels),
            b"undistortedDiameter_px" | b"pupilUndistortedDiameter_px" => Self::Size(PupilExtSize::UndistortedPixels),
            b"confidence" | b"pupilConfidence" => Self::Confidence,
            b"outlineConfidence" | b"pupilOutlineConfidence" => Self::OutlineConfidence,
            _ => return None,
        })
    }
}

/// A scanner of JSON that keeps only what a view says.
#[derive(Clone, Debug)]
struct Scanner {
    state: State,
    levels: [Level; MAX_DEPTH],
    depth: usize,
    /// The name or the figure in hand.
    token: Beginning,
    at_line_start: bool,
    /// Views of which the message in hand has told.
    told: u32,
    /// The last one told of more than the profile has.
    crowded: bool,
    /// No message has begun yet.
    first: bool,
    /// Bytes in [`State::Lost`] since that was last told.
    lost_bytes: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Between messages.
    Outside,
    /// In bytes of no message, up to a brace at the beginning of a line.
    Lost,
    /// Before a name, or the end of an empty object.
    Name,
    /// Behind a name.
    Colon,
    /// Before a value, or the end of an empty array.
    Value,
    /// Behind a value.
    Comma,
    /// In a string; what it is for, and whether the last byte was a backslash.
    Text { name: bool, escaped: bool },
    /// In a number or a word.
    Word,
}

/// An object or an array that is open.
#[derive(Clone, Copy, Debug, Default)]
struct Level {
    is_array: bool,
    eye: Option<SampleEye>,
    /// Seen by the second camera.
    secondary: bool,
    view: View,
    /// The name of the value that comes next.
    field: Option<Field>,
    /// Where the value that comes next belongs, if it is an object.
    inner_eye: Option<SampleEye>,
    inner_secondary: bool,
}

impl Scanner {
    fn joining() -> Self {
        Self {
            state: State::Outside,
            levels: [Level::default(); MAX_DEPTH],
            depth: 0,
            token: Beginning::new(MAX_TOKEN_BYTES),
            at_line_start: true,
            told: 0,
            crowded: false,
            first: true,
            lost_bytes: 0,
        }
    }

    /// Drops what has come of a message, as at a datagram's end. What is known of the stream stays.
    const fn end(&mut self) {
        (self.state, self.at_line_start) = (State::Outside, true);
    }

    fn push(&mut self, settings: &PupilExtSettings, mut bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        while let Some(&byte) = bytes.first() {
            // What a string holds and the blanks of an indent come in runs.
            let run = match self.state {
                State::Text { escaped: false, .. } => {
                    bytes.iter().position(|byte| matches!(byte, b'"' | b'\\' | b'\n'))
                }
                State::Name | State::Value | State::Comma if !self.at_line_start => {
                    bytes.iter().position(|&byte| byte != b' ')
                }
                _ => Some(0),
            };
            let (run, rest) = bytes.split_at(run.unwrap_or(bytes.len()));
            if run.is_empty() {
                self.take(settings, byte, on_event);
                bytes = &rest[1..];
            } else {
                if matches!(self.state, State::Text { .. }) {
                    self.token.push(run);
                }
                self.at_line_start = false;
                bytes = rest;
            }
        }
    }

    fn take(&mut self, settings: &PupilExtSettings, byte: u8, on_event: &mut dyn FnMut(WireEvent)) {
        let at_line_start = std::mem::replace(&mut self.at_line_start, byte == b'\n');
        if byte == b'{' && (at_line_start || self.state == State::Outside) {
            if !matches!(self.state, State::Outside | State::Lost) {
                on_event(WireEvent::Rejected(WireFault::Malformed));
            }
            return self.begin();
        }
        let is_blank = matches!(byte, b' ' | b'\t' | b'\r' | b'\n');
        match (self.state, byte) {
            (State::Lost, _) => {
                self.lost_bytes += 1;
                if self.lost_bytes == MAX_LINE_BYTES {
                    self.lose(WireFault::OutOfStep, on_event);
                }
            }
            (State::Outside, _) if is_blank || byte == 0 => {}
            (State::Outside, _) => self.lose(WireFault::OutOfStep, on_event),
            (State::Text { name, escaped: false }, b'"') => self.end_text(settings, name),
            (State::Text { .. }, b'\n') => self.lose(WireFault::Malformed, on_event),
            (State::Text { name, escaped }, _) => {
                self.state = State::Text { name, escaped: byte == b'\\' && !escaped };
                self.token.push(&[byte]);
            }
            (State::Word, b',' | b'}' | b']') => {
                self.end_value(settings);
                self.punctuate(settings, byte, on_event);
            }
            (State::Word, _) if is_blank => self.end_value(settings),
            (State::Word, _) if byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-' | b'+') => {
                self.token.push(&[byte]);
            }
            (State::Word, _) => self.lose(WireFault::Malformed, on_event),
            _ if is_blank => {}
            _ => self.punctuate(settings, byte, on_event),
        }
    }

    /// What is neither blank nor in a string or a word.
    fn punctuate(&mut self, settings: &PupilExtSettings, byte: u8, on_event: &mut dyn FnMut(WireEvent)) {
        let is_array = self.levels[self.depth].is_array;
        match (self.state, byte) {
            (State::Name, b'"') => self.begin_token(State::Text { name: true, escaped: false }),
            (State::Value, b'"') => self.begin_token(State::Text { name: false, escaped: false }),
            (State::Colon, b':') => self.state = State::Value,
            (State::Value, b'{' | b'[') if self.depth + 1 < MAX_DEPTH => self.open(byte == b'['),
            (State::Comma, b',') => self.state = if is_array { State::Value } else { State::Name },
            (State::Name | State::Comma, b'}') if !is_array => self.close(settings, on_event),
            (State::Value | State::Comma, b']') if is_array => self.close(settings, on_event),
            (State::Value, b'-' | b'0'..=b'9' | b'a'..=b'z') => {
                self.begin_token(State::Word);
                self.token.push(&[byte]);
            }
            _ => self.lose(WireFault::Malformed, on_event),
        }
    }

    fn begin(&mut self) {
        self.first = false;
        self.told = 0;
        self.depth = 0;
        self.levels[0] = Level::default();
        self.state = State::Name;
    }

    fn begin_token(&mut self, state: State) {
        self.token.clear();
        self.state = state;
    }

    fn lose(&mut self, fault: WireFault, on_event: &mut dyn FnMut(WireEvent)) {
        on_event(if std::mem::take(&mut self.first) { WireEvent::Partial } else { WireEvent::Rejected(fault) });
        self.state = State::Lost;
        self.lost_bytes = 0;
    }

    fn open(&mut self, is_array: bool) {
        let outer = &self.levels[self.depth];
        let inner = Level {
            is_array,
            eye: outer.inner_eye.or(outer.eye),
            secondary: outer.inner_secondary || outer.secondary,
            ..Level::default()
        };
        self.depth += 1;
        self.levels[self.depth] = inner;
        self.state = if is_array { State::Value } else { State::Name };
    }

    fn close(&mut self, settings: &PupilExtSettings, on_event: &mut dyn FnMut(WireEvent)) {
        let level = self.levels[self.depth];
        if level.view.known && !level.secondary {
            self.told += 1;
            let one = settings.eyes != PupilExtEyes::Two;
            let eye = match settings.eyes {
                PupilExtEyes::One(eye) => level.eye.filter(|_| eye == SampleEye::Both).unwrap_or(eye),
                PupilExtEyes::Two => level.eye.unwrap_or(SampleEye::Both),
            };
            match level.view.sample(eye) {
                _ if one && (self.told > 1 || self.crowded) => on_event(WireEvent::Rejected(WireFault::MoreViews)),
                Ok((sample, fault)) => {
                    on_fault(fault, on_event);
                    on_event(WireEvent::Sample(sample));
                }
                Err(fault) => on_event(WireEvent::Rejected(fault)),
            }
        }
        if self.depth > 0 {
            self.depth -= 1;
            self.state = State::Comma;
        } else {
            self.state = State::Outside;
            self.crowded = self.told > 1;
            if self.told == 0 {
                on_event(WireEvent::Note);
            }
        }
    }

    fn end_text(&mut self, settings: &PupilExtSettings, is_name: bool) {
        if !is_name {
            return self.end_value(settings);
        }
        let two = settings.eyes == PupilExtEyes::Two;
        let name = text_of(&self.token);
        let level = &mut self.levels[self.depth];
        level.field = Field::by_name(name);
        level.inner_secondary = name == b"Sec";
        level.inner_eye = match name {
            b"R" => Some(SampleEye::Right),
            b"L" => Some(SampleEye::Left),
            b"A" if two => Some(SampleEye::Right),
            b"B" if two => Some(SampleEye::Left),
            _ => None,
        };
        self.state = State::Colon;
    }

    fn end_value(&mut self, settings: &PupilExtSettings) {
        self.state = State::Comma;
        let level = &mut self.levels[self.depth];
        let Some(field) = level.field.take() else { return };
        let view = &mut level.view;
        view.known = true;
        let text = text_of(&self.token);
        let mut keep = |place: &mut Option<f64>| match number(text) {
            Ok(figure) => *place = Some(figure),
            Err(fault) => view.fault = Some(fault),
        };
        match field {
            Field::Timestamp => match time(text, NS_PER_MS) {
                Ok(t_device) => view.t_device = Some(t_device),
                Err(fault) => view.fault = Some(fault),
            },
            Field::Size(size) if size == settings.size => keep(&mut view.diameter),
            Field::Size(PupilExtSize::Pixels) if settings.size == PupilExtSize::Millimetres => {
                view.diameter_px = number(text).ok();
            }
            Field::Size(_) => {}
            Field::Confidence => keep(&mut view.confidence),
            Field::OutlineConfidence => keep(&mut view.outline_confidence),
        }
    }
}

/// A name or a figure; nothing of one that is too long to matter.
fn text_of(token: &Beginning) -> &[u8] {
    if token.overlong { &[] } else { token.bytes() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MODES: [(PupilExtEyes, bool); 4] = [
        (PupilExtEyes::One(SampleEye::Left), false),
        (PupilExtEyes::Two, false),
        (PupilExtEyes::One(SampleEye::Left), true),
        (PupilExtEyes::Two, true),
    ];

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

    /// Names of the columns up to version 0.1.2, built as the format is described.
    fn old_header(views: &[&str], eyes: &[&str]) -> Vec<String> {
        let mut header = vec!["timestamp_ms".to_owned(), "algorithm".to_owned()];
        header.extend(views.iter().map(|view| format!("diameter{view}_px")));
        header.extend(views.iter().map(|view| format!("undistortedDiameter{view}_px")));
        header.extend(eyes.iter().map(|eye| format!("physicalDiameter{eye}_mm")));
        for view in views {
            header.extend([format!("width{view}_px"), format!("height{view}_px"), format!("axisRatio{view}")]);
        }
        header.extend(views.iter().flat_map(|view| [format!("center{view}_x"), format!("center{view}_y")]));
        header.extend(views.iter().map(|view| format!("angle{view}_deg")));
        header.extend(views.iter().map(|view| format!("circumference{view}_px")));
        header.extend(views.iter().flat_map(|view| [format!("confidence{view}"), format!("outlineConfidence{view}")]));
        header
    }

    #[test]
    fn columns_stand_where_the_headers_have_them() {
        let views: [&[&str]; 4] = [&[""], &["A", "B"], &["Main", "Sec"], &["AMain", "ASec", "BMain", "BSec"]];
        let eyes: [&[&str]; 4] = [&[""], &["A", "B"], &[""], &["A", "B"]];
        for (((mode, stereo), views), eyes) in MODES.into_iter().zip(views).zip(eyes) {
            let settings = csv(mode, stereo);
            let header = old_header(views, eyes);
            assert_eq!(widths(&settings).old, header.len());
            let place = |name: String| header.iter().position(|column| *column == name).expect(&name);
            for (index, eye) in eyes.iter().enumerate() {
                let view = if stereo { format!("{eye}Main") } else { (*eye).to_owned() };
                let expected = Columns {
                    diameter: place(format!("diameter{view}_px")),
                    undistorted: place(format!("undistortedDiameter{view}_px")),
                    physical: place(format!("physicalDiameter{eye}_mm")),
                    confidence: place(format!("confidence{view}")),
                };
                assert_eq!(old_columns(&settings, index), expected, "{mode:?} {stereo}");
                assert_eq!(place(format!("outlineConfidence{view}")), expected.confidence + 1);
                assert!(new_columns(&settings, index).confidence + 1 < widths(&settings).new);
            }
        }
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
