//! Objects, spread over many lines (or one), whose figures are strings:
//!
//! ```text
//! { "EyeData": { "A": { "Main": { "diameter_px": "41.2", "physicalDiameter_mm": "3.25", "timestamp_ms": "1700000000123", … } } } }
//! ```
//!
//! with `A` and `B` up to 0.1.2, and later `R` and `L` and names such as `pupilDiameter_px`. Each message's brace
//! stands at the beginning of a line and no other does, so that is where reading begins anew after anything bad. The
//! scanner is written by hand: it keeps the few figures that matter and no text, so a message may be of any length.

use super::{MAX_LINE_BYTES, NS_PER_MS, PupilExtEyes, PupilExtSettings, PupilExtSize, View, on_fault};
use crate::SampleEye;
use crate::wire::buffer::Beginning;
use crate::wire::text::{number, time};
use crate::wire::{WireEvent, WireFault};

/// How deep a message of JSON may be nested; PupilEXT's are 4 deep.
const MAX_DEPTH: usize = 8;
/// Bytes of the longest name and figure in JSON that matter.
const MAX_TOKEN_BYTES: usize = 40;

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
pub(super) struct Scanner {
    state: State,
    levels: [Level; MAX_DEPTH],
    depth: usize,
    /// The name or the figure in hand.
    token: Beginning,
    at_line_start: bool,
    /// Views of the main cameras in the message in hand, so far.
    views: u32,
    /// The last message had more of them than one.
    crowded: bool,
    /// No message has begun yet.
    first: bool,
    /// Bytes in [`State::Lost`] since that was last reported.
    lost_bytes: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Between two messages, or before the first.
    Outside,
    /// In bytes of no message, up to a brace at the beginning of a line.
    Lost,
    /// Before a name, or the end of an empty object.
    Name,
    /// Behind a name, before its colon.
    Colon,
    /// Before a value, or the end of an empty array.
    Value,
    /// Behind a value, before a comma or the end of what it is in.
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
    pub(super) fn joining() -> Self {
        Self {
            state: State::Outside,
            levels: [Level::default(); MAX_DEPTH],
            depth: 0,
            token: Beginning::new(MAX_TOKEN_BYTES),
            at_line_start: true,
            views: 0,
            crowded: false,
            first: true,
            lost_bytes: 0,
        }
    }

    /// Drops what has come of a message, as at a datagram's end. What is known of the stream stays.
    pub(super) const fn end(&mut self) {
        (self.state, self.at_line_start) = (State::Outside, true);
    }

    pub(super) fn push(&mut self, settings: &PupilExtSettings, mut bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
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
        self.views = 0;
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
            self.views += 1;
            let one = settings.eyes != PupilExtEyes::Two;
            let eye = match settings.eyes {
                PupilExtEyes::One(eye) => level.eye.filter(|_| eye == SampleEye::Both).unwrap_or(eye),
                PupilExtEyes::Two => level.eye.unwrap_or(SampleEye::Both),
            };
            match level.view.sample(eye) {
                _ if one && (self.views > 1 || self.crowded) => on_event(WireEvent::Rejected(WireFault::MoreViews)),
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
            self.crowded = self.views > 1;
            if self.views == 0 {
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
