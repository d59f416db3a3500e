//! Lines of text with a fixed set of columns, as most home-made trackers write them.
//!
//! A line ends in LF, CR or both. Columns are counted from 1, or named by a header line: on the wire, or in the
//! profile.

use super::buffer::Beginning;
use super::checksum::{Checksum, ChecksumKind};
use super::field::{Fields, Layout, Message, Raw};
use super::{Decoder, WireEvent, WireFault};
use crate::cells::unquoted;

/// Bytes of the longest line that is read, without its ending.
pub const MAX_LINE_BYTES: usize = 4096;
/// Columns that are told apart; what lies beyond is not read.
pub const MAX_COLUMNS: usize = 128;

const BYTE_ORDER_MARK: &[u8] = b"\xEF\xBB\xBF";

/// How lines are read.
#[derive(Clone, Debug, PartialEq)]
pub struct DelimitedSettings {
    /// What stands between two columns.
    pub separator: Separator,
    /// The fraction of a number begins with a comma.
    pub decimal_comma: bool,
    /// A line that does not begin so is no sample; it is cut off before columns are counted.
    pub prefix: Vec<u8>,
    /// A line that begins so is a comment.
    pub comment: Vec<u8>,
    /// The names of all columns, where the wire need not tell them; a line that holds more is refused.
    pub columns: Vec<String>,
    /// The checksum in two or four hexadecimal digits behind the last `*`, and how many of the line's first bytes it
    /// leaves out.
    pub checksum: Option<(ChecksumKind, usize)>,
    /// In which columns time, eye and pupils stand.
    pub layout: Layout<Column>,
}

/// What stands between two columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Separator {
    /// One of this byte; two in a row have an empty column between them.
    Byte(u8),
    /// Any number of blanks and tabs.
    Whitespace,
}

/// A column of the lines, as a profile names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Column {
    /// By its number, from 1.
    Number(usize),
    /// By its name in the header.
    Name(String),
}

/// Lines in, samples out; the same samples however the bytes are split.
#[derive(Clone, Debug)]
pub struct DelimitedDecoder {
    /// What has come of a line that was cut by the end of a push.
    line: Beginning,
    rows: Rows,
}

/// Whole lines to samples.
#[derive(Clone, Debug)]
struct Rows {
    /// The next line may have lost its beginning.
    first: bool,
    prefix: Vec<u8>,
    comment: Vec<u8>,
    checksum: Option<LineChecksum>,
    columns: Columns,
    fields: Fields<usize>,
}

#[derive(Clone, Debug)]
struct LineChecksum {
    checksum: Checksum,
    digits: usize,
    skip: usize,
}

/// Where the columns of the current line are.
#[derive(Clone, Debug)]
struct Columns {
    separator: Separator,
    point: u8,
    /// The columns that are read; a place in the layout is an index of this.
    wanted: Vec<Column>,
    /// The number, from 0, of each; None until a header has told it.
    numbers: Vec<Option<usize>>,
    /// Columns that a line is split into: all that have names, or those up to the last that is read.
    needed: usize,
    /// Columns that have names, where any has: a line with more has decimal commas, or other columns.
    names: Option<usize>,
    /// Beginning and end of each.
    spans: Box<[(u16, u16); MAX_COLUMNS]>,
    found: usize,
}

impl DelimitedDecoder {
    /// A decoder that starts at the beginning of a line.
    pub fn new(settings: &DelimitedSettings) -> Self {
        let mut wanted: Vec<Column> = Vec::new();
        let layout = settings.layout.map(&mut |column| {
            wanted.iter().position(|known| known == column).unwrap_or_else(|| {
                wanted.push(column.clone());
                wanted.len() - 1
            })
        });
        let number = |column: &Column| match column {
            Column::Number(number) => Some(number.saturating_sub(1)),
            Column::Name(name) => settings.columns.iter().position(|known| known == name),
        };
        let numbers = wanted.iter().map(number).collect();
        let checksum = settings.checksum.map(|(kind, skip)| LineChecksum {
            checksum: Checksum::new(kind),
            digits: kind.width() * 2,
            skip,
        });
        let columns = Columns {
            separator: settings.separator,
            point: if settings.decimal_comma { b',' } else { b'.' },
            wanted,
            numbers,
            needed: 0,
            names: Some(settings.columns.len()).filter(|names| (1..MAX_COLUMNS).contains(names)),
            spans: Box::new([(0, 0); MAX_COLUMNS]),
            found: 0,
        };
        let mut rows = Rows {
            first: false,
            prefix: settings.prefix.clone(),
            comment: settings.comment.clone(),
            checksum,
            columns,
            fields: Fields::new(layout),
        };
        rows.columns.count_needed();
        Self { line: Beginning::new(MAX_LINE_BYTES), rows }
    }

    /// A decoder for a stream that may be joined in the middle of a line: the first line, unless a checksum holds it to
    /// be whole or it is a header, is [`WireEvent::Partial`].
    pub fn joining(settings: &DelimitedSettings) -> Self {
        let mut decoder = Self::new(settings);
        decoder.rows.first = true;
        decoder
    }

    fn end_kept(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        if self.line.overlong {
            let joined = std::mem::take(&mut self.rows.first);
            on_event(if joined { WireEvent::Partial } else { WireEvent::Rejected(WireFault::TooLong) });
        } else {
            self.rows.take(self.line.bytes(), on_event);
        }
        self.line.clear();
    }
}

impl Decoder for DelimitedDecoder {
    fn push(&mut self, bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        let mut rest = bytes;
        while let Some(end) = rest.iter().position(|byte| matches!(byte, b'\n' | b'\r')) {
            let (piece, behind) = (&rest[..end], &rest[end + 1..]);
            if !self.line.bytes().is_empty() || piece.len() > MAX_LINE_BYTES {
                self.line.push(piece);
                self.end_kept(on_event);
            } else {
                self.rows.take(piece, on_event);
            }
            rest = behind;
        }
        self.line.push(rest);
    }

    fn finish(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        if !self.line.bytes().is_empty() {
            self.end_kept(on_event);
        }
    }

    /// A header stays known.
    fn rejoin(&mut self) -> bool {
        self.line.clear();
        self.rows.first = true;
        true
    }
}

impl Rows {
    fn take(&mut self, line: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        // What Windows' editors put before a text is no part of it.
        let line = line.strip_prefix(BYTE_ORDER_MARK).unwrap_or(line);
        if line.iter().all(u8::is_ascii_whitespace) {
            return;
        }
        let joined = std::mem::take(&mut self.first);
        if !self.comment.is_empty() && line.starts_with(&self.comment) {
            return on_event(WireEvent::Note);
        }
        let Some(row) = line.strip_prefix(&self.prefix[..]) else {
            return on_event(if joined { WireEvent::Partial } else { WireEvent::Note });
        };
        // A header need not carry the checksum.
        if self.columns.begins_header(row) && self.columns.adopt(row) {
            return on_event(WireEvent::Note);
        }
        let row = match &self.checksum {
            None if joined => return on_event(WireEvent::Partial),
            None => row,
            Some(check) => match check.strip(line) {
                Ok(whole) => whole.get(self.prefix.len()..).unwrap_or_default(),
                Err(_) if joined => return on_event(WireEvent::Partial),
                Err(fault) => return on_event(WireEvent::Rejected(fault)),
            },
        };
        let rest = self.columns.split(row, self.columns.needed);
        if self.columns.names.is_some() && self.columns.holds_more(rest) {
            return on_event(WireEvent::Rejected(WireFault::MoreFields));
        }
        if let Err(fault) = self.fields.read(&Row { columns: &self.columns, line: row }, on_event) {
            on_event(WireEvent::Rejected(fault));
        }
    }
}

impl LineChecksum {
    /// The line before its checksum, if that is right.
    fn strip<'a>(&self, line: &'a [u8]) -> Result<&'a [u8], WireFault> {
        let line = line.trim_ascii_end();
        let star = line.len().checked_sub(self.digits + 1).ok_or(WireFault::BadChecksum)?;
        let (body, check) = (&line[..star], &line[star + 1..]);
        let digits = check
            .iter()
            .try_fold(0_u16, |sum, digit| char::from(*digit).to_digit(16).map(|digit| (sum << 4) | digit as u16));
        let sum = self.checksum.of(body.get(self.skip..).ok_or(WireFault::BadChecksum)?);
        if line[star] == b'*' && digits == Some(sum) { Ok(body) } else { Err(WireFault::BadChecksum) }
    }
}

impl Columns {
    fn count_needed(&mut self) {
        let last = self.numbers.iter().flatten().max();
        self.needed = self.names.unwrap_or(0).max(last.map_or(0, |last| last + 1)).min(MAX_COLUMNS);
    }

    /// Finds the columns of a line, `most` of them, and gives what is behind them.
    fn split<'l>(&mut self, line: &'l [u8], most: usize) -> &'l [u8] {
        self.found = 0;
        let mut start = 0;
        while self.found < most {
            let rest = &line[start..];
            let (skip, length) = match self.separator {
                Separator::Byte(byte) => (0, rest.iter().position(|found| *found == byte).unwrap_or(rest.len())),
                Separator::Whitespace => {
                    let Some(skip) = rest.iter().position(|byte| !is_blank(*byte)) else { return &[] };
                    let length = rest[skip..].iter().position(|byte| is_blank(*byte));
                    (skip, length.unwrap_or(rest.len() - skip))
                }
            };
            let begin = start + skip;
            let end = begin + length;
            // A line has at most MAX_LINE_BYTES.
            self.spans[self.found] = (begin as u16, end as u16);
            self.found += 1;
            if end == line.len() {
                return &[];
            }
            start = end + 1;
        }
        &line[start..]
    }

    /// Whether what is behind the columns of a line holds anything but separators.
    fn holds_more(&self, rest: &[u8]) -> bool {
        let is_nothing = |byte: &u8| byte.is_ascii_whitespace() || self.separator == Separator::Byte(*byte);
        !rest.iter().all(is_nothing)
    }

    fn cell<'a>(&self, line: &'a [u8], index: usize) -> Option<&'a [u8]> {
        let (begin, end) = *self.spans[..self.found].get(index)?;
        Some(unquoted(&line[usize::from(begin)..usize::from(end)]))
    }

    /// Whether a line may be a header: columns have names, and it begins like none of a number.
    fn begins_header(&self, line: &[u8]) -> bool {
        let letter = |byte: &u8| !matches!(byte, b'0'..=b'9' | b'+' | b'-' | b'.' | b',' | b' ' | b'\t');
        line.first().is_some_and(letter) && self.wanted.iter().any(|column| matches!(column, Column::Name(_)))
    }

    /// Takes a line that names all named columns, each once, for the header, and tells whether it is one.
    fn adopt(&mut self, line: &[u8]) -> bool {
        self.split(line, MAX_COLUMNS);
        let place = |columns: &Self, column: &Column| match column {
            Column::Number(number) => Some(number.saturating_sub(1)),
            Column::Name(name) => columns.named(line, name.as_bytes()),
        };
        if !self.wanted.iter().all(|column| place(self, column).is_some()) {
            return false;
        }
        self.names = Some(self.found).filter(|names| *names < MAX_COLUMNS);
        for index in 0..self.wanted.len() {
            self.numbers[index] = place(self, &self.wanted[index]);
        }
        self.count_needed();
        true
    }

    /// The only column of that name, or else, in capitals or not, the only one.
    fn named(&self, line: &[u8], name: &[u8]) -> Option<usize> {
        let called = |is_name: &dyn Fn(&[u8]) -> bool| {
            let mut found = (0..self.found).filter(|index| self.cell(line, *index).is_some_and(is_name));
            (found.next(), found.next())
        };
        match called(&|cell| cell == name) {
            (None, _) => match called(&|cell| cell.eq_ignore_ascii_case(name)) {
                (only, None) => only,
                _ => None,
            },
            (only, None) => only,
            _ => None,
        }
    }
}

const fn is_blank(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t')
}

/// A line and its columns.
struct Row<'a> {
    columns: &'a Columns,
    line: &'a [u8],
}

impl Row<'_> {
    fn cell(&self, at: usize) -> Option<&[u8]> {
        self.columns.cell(self.line, self.columns.numbers[at]?)
    }
}

impl Message<usize> for Row<'_> {
    fn raw(&self, at: &usize) -> Result<Raw, WireFault> {
        number(self.cell(*at).ok_or(WireFault::MissingField)?, self.columns.point)
    }

    fn has_text(&self, at: &usize, text: &[u8]) -> bool {
        self.cell(*at) == Some(text)
    }
}

/// Reads a number with its fraction behind `point`. Digits beyond the eighteenth do not count.
fn number(cell: &[u8], point: u8) -> Result<Raw, WireFault> {
    const ENOUGH: u64 = 100_000_000_000_000_000;
    let (negative, digits) = match cell {
        [] => return Err(WireFault::MissingField),
        [b'-', rest @ ..] => (true, rest),
        [b'+', rest @ ..] => (false, rest),
        rest => (false, rest),
    };
    let (mut mantissa, mut decimals, mut exponent, mut any) = (0_u64, 0_u32, 0_i32, false);
    let mut in_fraction = false;
    let mut rest = digits.iter();
    while let Some(&byte) = rest.next() {
        match byte {
            b'0'..=b'9' => {
                any = true;
                if mantissa < ENOUGH {
                    mantissa = mantissa * 10 + u64::from(byte - b'0');
                    decimals += u32::from(in_fraction);
                    // Leading zeros of a fraction count too.
                    if decimals > 18 {
                        (mantissa, decimals) = (mantissa / 10, 18);
                    }
                } else {
                    exponent += i32::from(!in_fraction);
                }
            }
            _ if byte == point && !in_fraction => in_fraction = true,
            b'e' | b'E' if any => {
                let power = std::str::from_utf8(rest.as_slice()).ok().and_then(|text| text.parse::<i16>().ok());
                exponent += i32::from(power.ok_or(WireFault::BadNumber)?);
                break;
            }
            _ => return no_digits(digits),
        }
    }
    if !any {
        return Err(WireFault::BadNumber);
    }
    let mantissa = if negative { -(mantissa as i64) } else { mantissa as i64 };
    let plain = Raw::Decimal { mantissa, decimals };
    Ok(if exponent == 0 { plain } else { Raw::Float(plain.number() * 10_f64.powi(exponent)) })
}

/// What is written without digits.
fn no_digits(text: &[u8]) -> Result<Raw, WireFault> {
    if text.eq_ignore_ascii_case(b"nan") {
        Ok(Raw::Float(f64::NAN))
    } else if text.eq_ignore_ascii_case(b"inf") || text.eq_ignore_ascii_case(b"infinity") {
        Ok(Raw::Float(f64::INFINITY))
    } else {
        Err(WireFault::BadNumber)
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::TimeNs;
    use proptest::prelude::*;

    use super::*;
    use crate::SampleEye;
    use crate::profile::Profile;
    use crate::wire::field::{Figure, Literal, PupilAt, SizeKind, SizeRule, TimeAt, Validity};
    use crate::wire::testing::{events_of, split_events};
    use crate::wire::{Crc, Format, WireSample};

    fn figure(column: usize) -> Figure<Column> {
        Figure { at: Column::Number(column), scale: 1.0, offset: 0.0 }
    }

    fn pupil(eye: Option<SampleEye>, column: usize) -> PupilAt<Column> {
        PupilAt { eye, size: figure(column), lost: Vec::new(), confidence: None, aperture: None, valid: None }
    }

    /// `time in ms, left, right`
    fn settings() -> DelimitedSettings {
        DelimitedSettings {
            separator: Separator::Byte(b','),
            decimal_comma: false,
            prefix: Vec::new(),
            comment: b"#".to_vec(),
            columns: Vec::new(),
            checksum: None,
            layout: Layout {
                time: Some(TimeAt { at: Column::Number(1), ns_per_tick: 1e6, wrap_bits: None }),
                sequence: None,
                eye: None,
                pupils: vec![pupil(Some(SampleEye::Left), 2), pupil(Some(SampleEye::Right), 3)],
                size: SizeRule { kind: SizeKind::Diameter, mm_per_unit: 1.0 },
            },
        }
    }

    fn one_eye() -> DelimitedSettings {
        let mut settings = settings();
        settings.layout.pupils.pop();
        settings
    }

    fn decode(settings: &DelimitedSettings, text: &str) -> Vec<WireEvent> {
        events_of(&mut DelimitedDecoder::new(settings), text.as_bytes())
    }

    fn sample(ms: i64, eye: SampleEye, diameter_mm: f32) -> WireEvent {
        WireEvent::Sample(WireSample {
            t_device: Some(TimeNs(ms * 1_000_000)),
            eye,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: None,
            sequence: None,
            valid: true,
        })
    }

    fn left(ms: i64, diameter_mm: f32) -> WireEvent {
        sample(ms, SampleEye::Left, diameter_mm)
    }

    fn right(ms: i64, diameter_mm: f32) -> WireEvent {
        sample(ms, SampleEye::Right, diameter_mm)
    }

    /// The only sample of `text`.
    fn only(settings: &DelimitedSettings, text: &str) -> WireSample {
        match decode(settings, text)[..] {
            [WireEvent::Sample(sample)] => sample,
            ref events => panic!("{text}: {events:?}"),
        }
    }

    #[test]
    fn known_lines_read_as_their_columns() {
        let text = "# a comment\n1000,3.25,4\r\n\r\n 1001 , +3.5e0 ,\"4.125\",more\r1002,3,4";
        let expected = [
            WireEvent::Note,
            left(1000, 3.25),
            right(1000, 4.0),
            left(1001, 3.5),
            right(1001, 4.125),
            left(1002, 3.0),
            right(1002, 4.0),
        ];
        assert_eq!(decode(&settings(), text), expected);
    }

    #[test]
    fn each_fault_has_its_reason() {
        let cases = [
            ("x,3,4\n", vec![WireFault::BadNumber]),
            (",3,4\n", vec![WireFault::MissingField]),
            ("1,-3,4e\n", vec![WireFault::Negative, WireFault::BadNumber]),
            ("1,nan,1e999\n", vec![WireFault::NotFinite, WireFault::NotFinite]),
            ("1\n", vec![WireFault::MissingField, WireFault::MissingField]),
            ("1,,.\n", vec![WireFault::MissingField, WireFault::BadNumber]),
            ("nan,3,4\n", vec![WireFault::NotFinite]),
            ("99999999999999999999,3,4\n", vec![WireFault::BadNumber]),
        ];
        for (text, faults) in cases {
            let expected: Vec<_> = faults.into_iter().map(WireEvent::Rejected).collect();
            let mut events = decode(&settings(), text);
            events.retain(|event| matches!(event, WireEvent::Rejected(_)));
            assert_eq!(events, expected, "{text}");
        }
        let long = format!("1,{}\n1,3,4\n", "3".repeat(MAX_LINE_BYTES));
        assert_eq!(decode(&settings(), &long), [WireEvent::Rejected(WireFault::TooLong), left(1, 3.0), right(1, 4.0)]);
        // One bad eye does not cost the other.
        assert_eq!(decode(&settings(), "1,x,4\n"), [WireEvent::Rejected(WireFault::BadNumber), right(1, 4.0)]);
    }

    #[test]
    fn a_comma_begins_a_fraction_where_it_is_said_to() {
        let settings = DelimitedSettings { decimal_comma: true, separator: Separator::Byte(b';'), ..settings() };
        assert_eq!(decode(&settings, "1,5;3,25;4.5\n")[0], {
            let WireEvent::Sample(mut sample) = left(1, 3.25) else { unreachable!() };
            sample.t_device = Some(TimeNs(1_500_000));
            WireEvent::Sample(sample)
        });
        assert_eq!(decode(&settings, "1;3;4.5\n")[1], WireEvent::Rejected(WireFault::BadNumber));
    }

    #[test]
    fn runs_of_blanks_are_one_separator() {
        let settings = DelimitedSettings { separator: Separator::Whitespace, ..settings() };
        assert_eq!(decode(&settings, "  7 \t 3   4  \n"), [left(7, 3.0), right(7, 4.0)]);
    }

    #[test]
    fn only_lines_with_the_prefix_are_samples() {
        let settings = DelimitedSettings { prefix: b"D:".to_vec(), ..settings() };
        assert_eq!(decode(&settings, "D:7,3,4\nready\n"), [left(7, 3.0), right(7, 4.0), WireEvent::Note]);
    }

    #[test]
    fn a_header_outlives_its_link() {
        let mut settings = one_eye();
        settings.layout.pupils[0].size.at = Column::Name("left".into());
        let mut decoder = DelimitedDecoder::joining(&settings);
        let before = events_of(&mut decoder, b"time,gaze,left\n1000,7,3.5\n1001,7,3.");
        assert_eq!(before[..2], [WireEvent::Note, left(1000, 3.5)]);
        // What was cut off is not joined with what comes, whose beginning was missed.
        assert!(decoder.rejoin());
        assert_eq!(events_of(&mut decoder, b"7,4.5\n1003,7,4.5\n"), [WireEvent::Partial, left(1003, 4.5)]);
        // Without a header nothing is known.
        let unknown = events_of(&mut DelimitedDecoder::new(&settings), b"1003,7,4.5\n");
        assert_eq!(unknown, [WireEvent::Rejected(WireFault::MissingField)]);
        // A tracker that was started anew may have other columns.
        assert!(decoder.rejoin());
        assert_eq!(events_of(&mut decoder, b"time,left\n1004,5\n"), [WireEvent::Note, left(1004, 5.0)]);
    }

    #[test]
    fn columns_are_found_by_the_names_of_a_header() {
        let mut settings = one_eye();
        settings.layout.pupils[0].size.at = Column::Name("left".into());
        let read = decode(&settings, "5,3,4\ntime,right,left\n5,3,4\ntime,left\n6,4\n");
        let unknown = WireEvent::Rejected(WireFault::MissingField);
        assert_eq!(read, [unknown, WireEvent::Note, left(5, 4.0), WireEvent::Note, left(6, 4.0)]);
        // With names in the profile no header need come, and one that comes is no fault.
        settings.columns = ["time", "left"].map(str::to_owned).to_vec();
        assert_eq!(decode(&settings, "5,3\ntime,left\n6,4\n"), [left(5, 3.0), WireEvent::Note, left(6, 4.0)]);
    }

    #[test]
    fn a_row_of_more_cells_than_names_is_refused() {
        let more = WireEvent::Rejected(WireFault::MoreFields);
        // Decimal commas, and a column more.
        let named = DelimitedSettings { columns: ["ms", "left", "right"].map(str::to_owned).to_vec(), ..settings() };
        for row in ["10,3,7,3,4\n", "10,3,75,3,40\n", "10,1,3.7,3.4\n", "10,3.7,3.4,,5\n"] {
            assert_eq!(decode(&named, row), [more], "{row}");
        }
        let both = [left(10, 3.5), right(10, 3.25)];
        for row in ["10,3.5,3.25\n", "10,3.5,3.25,\r\n", "10,3.5,3.25, ,\n"] {
            assert_eq!(decode(&named, row), both, "{row}");
        }
        let blanks = DelimitedSettings { separator: Separator::Whitespace, ..named };
        assert_eq!(decode(&blanks, "10 3.5 3.25 \t\n10 3.5 3.25 1\n"), [both[0], both[1], more]);
        // By the names of a header, of which the last ones are not read; without any, nothing is known.
        let mut by_header = one_eye();
        by_header.layout.pupils[0].size.at = Column::Name("left".into());
        let text = "time,left,x\n10,3.5,1\n10,3,5,1\ntime,left,x,y\n10,3.5,1,1\n";
        assert_eq!(decode(&by_header, text), [WireEvent::Note, left(10, 3.5), more, WireEvent::Note, left(10, 3.5)]);
        assert_eq!(decode(&settings(), "10,3.5,3.25,1\n"), both);
    }

    #[test]
    fn a_header_may_have_a_byte_order_mark_and_capitals_and_names_each_column_once() {
        let mut settings = one_eye();
        settings.layout.time.as_mut().unwrap().at = Column::Name("time".into());
        settings.layout.pupils[0].size.at = Column::Name("left".into());
        for header in ["\u{FEFF}time,left", "Time,LEFT", "LEFT,time,left"] {
            let mut decoder = DelimitedDecoder::joining(&settings);
            let row = if header.starts_with("LEFT") { "9,5,4\n" } else { "5,4\n" };
            let read = events_of(&mut decoder, format!("{header}\n{row}").as_bytes());
            assert_eq!(read, [WireEvent::Note, left(5, 4.0)], "{header}");
        }
        for header in ["time,left,left", "time,Left,LEFT"] {
            let read = events_of(&mut DelimitedDecoder::joining(&settings), format!("{header}\n5,4,3\n").as_bytes());
            assert_eq!(read, [WireEvent::Partial, WireEvent::Rejected(WireFault::MissingField)], "{header}");
        }
    }

    #[test]
    fn what_the_tracker_calls_lost_is_a_sample_that_is_not_valid() {
        let mut settings = one_eye();
        settings.layout.pupils[0].lost = vec![
            Literal::Number(-1.0),
            Literal::Number(f64::NAN),
            Literal::Text(Vec::new()),
            Literal::Text(b"n/a".into()),
        ];
        for lost in ["-1", "-1.00", "nan", "", "n/a", " n/a "] {
            let sample = only(&settings, &format!("1,{lost}\n"));
            assert!(!sample.valid, "{lost}");
        }
        // The canary: what is next to a lost one is none.
        assert!(only(&settings, "1,1\n").valid);
        // A figure that is no size is a fault, and the pupil lost all the same.
        for (figure, fault) in [("-2", WireFault::Negative), ("inf", WireFault::NotFinite)] {
            let [WireEvent::Rejected(found), WireEvent::Sample(sample)] =
                decode(&settings, &format!("1,{figure}\n"))[..]
            else {
                panic!("{figure}")
            };
            assert_eq!((found, sample.valid, sample.t_device), (fault, false, Some(TimeNs(1_000_000))));
        }
        assert_eq!(decode(&settings, "1,na\n"), [WireEvent::Rejected(WireFault::BadNumber)]);
    }

    #[test]
    fn each_validity_rule_holds_and_fails() {
        let text = |text: &str| Literal::Text(text.into());
        let cases = [
            (Validity::Equals(Literal::Number(1.0)), "1.0", "0"),
            (Validity::Equals(text("Valid")), "Valid", "Invalid"),
            (Validity::Differs(Literal::Number(0.0)), "1", "0"),
            (Validity::Differs(text("bad")), "good", "bad"),
            (Validity::AtLeast(0.6), "0.6", "0.59"),
            (Validity::AtMost(1.0), "1", "4"),
            (Validity::AllBits(6), "7", "5"),
            (Validity::NoBits(6), "8", "2"),
        ];
        for (rule, good, bad) in cases {
            let mut settings = one_eye();
            settings.layout.pupils[0].valid = Some((Column::Number(3), rule.clone()));
            assert!(only(&settings, &format!("1,3,{good}\n")).valid, "{rule:?}");
            assert!(!only(&settings, &format!("1,3,{bad}\n")).valid, "{rule:?}");
            let size_of_none = only(&settings, &format!("1,-7,{bad}\n"));
            assert!(!size_of_none.valid, "{rule:?}");
        }
    }

    #[test]
    fn confidence_aperture_sequence_and_eye_are_read() {
        let mut settings = one_eye();
        let layout = &mut settings.layout;
        layout.sequence = Some((Column::Number(3), Some(8)));
        layout.eye = Some((
            Column::Number(4),
            vec![(Literal::Text(b"L".into()), SampleEye::Left), (Literal::Number(1.0), SampleEye::Right)],
        ));
        layout.pupils[0].eye = None;
        layout.pupils[0].confidence = Some(Figure { scale: 0.01, ..figure(5) });
        layout.pupils[0].aperture = Some(Figure { scale: 0.1, ..figure(6) });
        let read = decode(&settings, "1,3,255,L,50,90\n1,3,0,1,100,\n1,3,1,2,1,1\n1,3,1,L,101,1\n");
        let first = WireSample {
            t_device: Some(TimeNs(1_000_000)),
            eye: SampleEye::Left,
            diameter_mm: 3.0,
            confidence: 0.5,
            aperture_mm: Some(9.0),
            sequence: Some(255),
            valid: true,
        };
        let second =
            WireSample { eye: SampleEye::Right, confidence: 1.0, aperture_mm: None, sequence: Some(256), ..first };
        assert_eq!(
            read,
            [
                WireEvent::Sample(first),
                WireEvent::Sample(second),
                WireEvent::Rejected(WireFault::BadEye),
                WireEvent::Rejected(WireFault::BadConfidence),
            ]
        );
    }

    #[test]
    fn a_checksum_is_held_against_the_line() {
        let crc8 = ChecksumKind::Crc(Crc { bits: 8, polynomial: 7, initial: 0, reflected: false, final_xor: 0 });
        let xor = DelimitedSettings { checksum: Some((ChecksumKind::Xor8, 1)), prefix: b"$E,".into(), ..settings() };
        // "E,1,3,4" by exclusive or
        let sum = b"E,1,3,4".iter().fold(0, |sum, byte| sum ^ byte);
        assert_eq!(decode(&xor, &format!("$E,1,3,4*{sum:02x}\n")), [left(1, 3.0), right(1, 4.0)]);
        assert_eq!(
            decode(&xor, "$E,1,3,4*00\n$E,1,3,4\nboot\n"),
            [WireEvent::Rejected(WireFault::BadChecksum), WireEvent::Rejected(WireFault::BadChecksum), WireEvent::Note,]
        );
        let crc = DelimitedSettings { checksum: Some((crc8, 0)), ..settings() };
        let sum = crate::wire::line::crc8(b"1,3,4");
        assert_eq!(decode(&crc, &format!("1,3,4*{sum:02X}\n")), [left(1, 3.0), right(1, 4.0)]);
    }

    #[test]
    fn the_first_line_of_a_joined_stream_is_not_believed() {
        let mut decoder = DelimitedDecoder::joining(&settings());
        // The tail of `1000,3,4` has as many columns as a whole line.
        assert_eq!(
            events_of(&mut decoder, b"00,3,4\n1001,3,4\n"),
            [WireEvent::Partial, left(1001, 3.0), right(1001, 4.0)]
        );
    }

    #[test]
    fn the_shipped_example_reads_what_its_sketch_prints() {
        let profile = Profile::find("example-lines").unwrap();
        let text = b"millis,left_mm,right_mm\r\n4294967295,3.21,3.35\r\n4,0,3.36\r\n";
        let events = events_of(&mut *profile.decoder(), text);
        let [WireEvent::Note, WireEvent::Sample(first), _, WireEvent::Sample(lost), WireEvent::Sample(last)] =
            events[..]
        else {
            panic!("{events:?}")
        };
        assert_eq!((first.diameter_mm, first.t_device), (3.21, Some(TimeNs(4_294_967_295_000_000))));
        assert!(!lost.valid);
        assert_eq!((last.eye, last.diameter_mm), (SampleEye::Right, 3.36));
        // The sketch's clock began again at 0 five milliseconds ago.
        assert_eq!(last.t_device, Some(TimeNs(4_294_967_300_000_000)));
        assert!(matches!(profile.format, Format::Delimited(_)));
    }

    #[test]
    fn numbers_read_as_the_standard_library_reads_them() {
        for text in
            ["0", "-0", "1", "12.5", "-3.25", "1e3", "1.5E-2", "00012", ".5", "5.", "123456789012345678901", "0.1"]
        {
            let ours = number(text.as_bytes(), b'.').unwrap().number();
            let theirs: f64 = text.parse().unwrap();
            assert!((ours - theirs).abs() <= theirs.abs() * 4e-16, "{text}: {ours} {theirs}");
        }
        for text in ["-", "+", ".", "e5", "1e", "1e+-2", "--1", "1 2", "0x10", "1_000", "1.2.3", "1,2"] {
            assert!(number(text.as_bytes(), b'.').is_err(), "{text}");
        }
    }

    fn any_settings() -> impl Strategy<Value = DelimitedSettings> {
        (0..4_u8, any::<bool>(), any::<bool>()).prop_map(|(kind, joined_name, checksum)| {
            let mut settings = settings();
            match kind {
                1 => settings.separator = Separator::Whitespace,
                2 => settings.prefix = b"1".to_vec(),
                3 => (settings.separator, settings.decimal_comma) = (Separator::Byte(b';'), true),
                _ => {}
            }
            if joined_name {
                settings.layout.pupils[1].size.at = Column::Name("a".into());
            }
            settings.checksum = checksum.then_some((ChecksumKind::Xor8, 0));
            settings
        })
    }

    proptest! {
        #[test]
        fn the_split_of_the_bytes_does_not_matter_and_nothing_panics(
            settings in any_settings(),
            pieces in prop::collection::vec(
                prop_oneof![
                    "[0-9]{1,4}[,; ][0-9.,-]{0,9}[,; ][0-9.e]{0,9}\r?\n".prop_map(String::into_bytes),
                    "[a-c,; *\r\n#]{0,12}".prop_map(String::into_bytes),
                    prop::collection::vec(any::<u8>(), 0..60),
                    (4000..9000_usize).prop_map(|long| vec![b'7'; long]),
                ],
                0..12,
            ),
            cuts in prop::collection::vec(1..50_usize, 1..20),
        ) {
            let bytes = pieces.concat();
            let whole = events_of(&mut DelimitedDecoder::joining(&settings), &bytes);
            prop_assert_eq!(split_events(&mut DelimitedDecoder::joining(&settings), &bytes, &cuts), whole);
        }

        #[test]
        fn what_is_written_is_read(rows in prop::collection::vec((0..1_000_000_i64, 0.0_f32..9.0, 0.0_f32..9.0), 0..20)) {
            let text: String = rows.iter().map(|(ms, l, r)| format!("{ms},{l},{r}\n")).collect();
            let expected: Vec<_> = rows.iter().flat_map(|(ms, l, r)| [left(*ms, *l), right(*ms, *r)]).collect();
            prop_assert_eq!(decode(&settings(), &text), expected);
        }

        #[test]
        fn garbage_costs_at_most_the_line_that_it_touches(
            garbage in prop::collection::vec(any::<u8>(), 0..9000),
            rows in prop::collection::vec((0..1_000_000_i64, 0.0_f32..9.0, 0.0_f32..9.0), 2..20),
        ) {
            let text: String = rows.iter().map(|(ms, l, r)| format!("{ms},{l},{r}\n")).collect();
            let events = events_of(&mut DelimitedDecoder::new(&settings()), &[&garbage, text.as_bytes()].concat());
            let expected: Vec<_> = rows[1..].iter().flat_map(|(ms, l, r)| [left(*ms, *l), right(*ms, *r)]).collect();
            prop_assert!(events.ends_with(&expected));
        }
    }
}
