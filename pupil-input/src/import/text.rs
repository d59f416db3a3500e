//! Lines, cells and numbers of text logs: in bounded memory whatever a file holds, and without an allocation a line.

use std::io::Read;

use holod_calibration::TimeNs;

use super::fault::LogFault;
use super::recording::LogBuilder;
use crate::cells::{after_cell, first_cell, has_fewer, has_more, separator};

/// A longer line is no line of any log: it is counted as [`LogFault::TooLong`] and never held.
pub(crate) const MAX_LINE_BYTES: usize = 1 << 16;
const BUFFER_BYTES: usize = 4 * MAX_LINE_BYTES;

/// The lines of a log, from its beginning.
pub(crate) struct Lines {
    reader: Box<dyn Read>,
    buffer: Vec<u8>,
    /// What is read and not yet handed out.
    from: usize,
    to: usize,
    ended: bool,
    number: u64,
    /// Separator and number of the columns that each line should have.
    columns: Option<(u8, usize)>,
}

/// One line, without its ending.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Line<'l> {
    /// The line's number in the file, from 1.
    pub(crate) number: u64,
    pub(crate) bytes: &'l [u8],
}

impl Lines {
    pub(super) fn new(reader: Box<dyn Read>) -> Self {
        Self { reader, buffer: vec![0; BUFFER_BYTES], from: 0, to: 0, ended: false, number: 0, columns: None }
    }

    /// The lines from now on are rows of a table: where the file ends within one that has fewer cells than `columns`, it
    /// was cut off there, and that row is counted as malformed and not handed out.
    pub(crate) const fn are_rows(&mut self, separator: u8, columns: usize) {
        self.columns = Some((separator, columns));
    }

    /// The first line that is not blank, which names the columns of the rows to come.
    pub(crate) fn header(&mut self, log: &mut LogBuilder) -> Option<Header> {
        loop {
            let line = self.next(log)?.bytes;
            if !line.trim_ascii().is_empty() {
                let header = Header::of(line, separator(line));
                self.are_rows(header.separator, header.len());
                return Some(header);
            }
        }
    }

    /// The next line, be it empty; overlong ones are counted in `log` and skipped. None at the end, or where reading
    /// failed, which [`Recording::read`](super::Recording::read) tells.
    pub(crate) fn next(&mut self, log: &mut LogBuilder) -> Option<Line<'_>> {
        let mut overlong = false;
        loop {
            let (end, next) = match memchr::memchr(b'\n', &self.buffer[self.from..self.to]) {
                Some(length) => (self.from + length, self.from + length + 1),
                None if !self.ended => {
                    if self.to - self.from > MAX_LINE_BYTES {
                        overlong = true;
                        self.from = self.to;
                    }
                    self.fill();
                    continue;
                }
                None if self.from == self.to && !overlong => return None,
                None => {
                    log.ends_within(self.number + 1);
                    (self.to, self.to)
                }
            };
            let begin = std::mem::replace(&mut self.from, next);
            self.number += 1;
            if std::mem::take(&mut overlong) || end - begin > MAX_LINE_BYTES {
                log.count(LogFault::TooLong);
                continue;
            }
            let bytes = &self.buffer[begin..end];
            if next == end && self.columns.is_some_and(|(separator, columns)| has_fewer(bytes, separator, columns)) {
                log.count(LogFault::Malformed);
                return None;
            }
            let bytes = bytes.strip_suffix(b"\r").unwrap_or(bytes);
            // Where files were put together, each has its own.
            let bytes = bytes.strip_prefix(BYTE_ORDER_MARK).unwrap_or(bytes);
            return Some(Line { number: self.number, bytes });
        }
    }

    fn fill(&mut self) {
        self.buffer.copy_within(self.from..self.to, 0);
        (self.from, self.to) = (0, self.to - self.from);
        match self.reader.read(&mut self.buffer[self.to..]) {
            Ok(0) | Err(_) => self.ended = true,
            Ok(count) => self.to += count,
        }
    }
}

/// The names of a table's columns.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    pub(crate) separator: u8,
    names: Vec<String>,
}

impl Header {
    /// Reads a header line; cells are trimmed and freed of quotation marks.
    pub(crate) fn of(line: &[u8], separator: u8) -> Self {
        let mut names = Vec::new();
        let mut rest = Some(line);
        while let Some(line) = rest {
            let (name, after) = first_cell(line, separator);
            names.push(String::from_utf8_lossy(name).into_owned());
            rest = after;
        }
        Self { separator, names }
    }

    /// The column of this name.
    pub(crate) fn column(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|candidate| candidate == name)
    }

    /// The column of the first of these names that there is.
    pub(crate) fn first_of(&self, names: &[&str]) -> Option<usize> {
        names.iter().find_map(|name| self.column(name))
    }

    /// How many columns there are.
    pub(crate) const fn len(&self) -> usize {
        self.names.len()
    }

    /// Whether a row holds something behind its last column, so that which cell is of which is not known.
    pub(crate) fn leaves_over(&self, row: &[u8]) -> bool {
        has_more(row, self.separator, self.len())
    }

    /// Whether `line`, whose cell `time` in the column of times was looked at, is no row but a header by `is_header`, as
    /// in files that were put together, and then whether it names the same columns.
    pub(crate) fn again(&self, line: &[u8], time: Option<&[u8]>, is_header: fn(&[u8]) -> bool) -> Option<bool> {
        let is_again = time.is_none_or(is_word) && is_header(line.trim_ascii());
        is_again.then(|| named(&self.names) == named(&Self::of(line, self.separator).names))
    }

    pub(crate) fn has(&self, name: &str) -> bool {
        self.column(name).is_some()
    }
}

/// Names of columns without those at the end that are none, as a spreadsheet fills up lines.
pub(super) fn named(names: &[String]) -> &[String] {
    let last = names.iter().rposition(|name| !name.is_empty());
    &names[..last.map_or(0, |last| last + 1)]
}

/// Whether a cell begins as no number does.
pub(super) fn is_word(cell: &[u8]) -> bool {
    cell.first().is_some_and(u8::is_ascii_alphabetic)
}

/// The cells of some columns, out of rows that may have many more.
#[derive(Clone, Debug)]
pub(crate) struct Picker<const N: usize> {
    separator: u8,
    /// Column and place, in order of columns.
    wanted: Vec<(usize, usize)>,
}

impl<const N: usize> Picker<N> {
    /// Picks `columns`, each into its own place; a place whose column is None stays None.
    pub(crate) fn new(separator: u8, columns: [Option<usize>; N]) -> Self {
        let mut wanted: Vec<_> =
            columns.into_iter().enumerate().filter_map(|(place, column)| Some((column?, place))).collect();
        wanted.sort_unstable();
        Self { separator, wanted }
    }

    /// The cells, trimmed and freed of quotation marks; None where the row ends before the column.
    pub(crate) fn pick<'l>(&self, row: &'l [u8]) -> [Option<&'l [u8]>; N] {
        let mut cells = [None; N];
        let mut rest = Some(row);
        let mut column = 0;
        for &(wanted, place) in &self.wanted {
            while column < wanted {
                rest = rest.and_then(|line| after_cell(line, self.separator));
                column += 1;
            }
            let Some(line) = rest else { break };
            cells[place] = Some(first_cell(line, self.separator).0);
        }
        cells
    }
}

/// A decimal number as it is written: ±`digits`·10^`exponent`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Decimal {
    negative: bool,
    digits: u64,
    exponent: i32,
}

/// A plain number of up to 19 digits with a decimal point or comma; None for everything else, be it a number or not.
fn decimal(text: &[u8]) -> Option<Decimal> {
    let (negative, text) = match text {
        [b'-', rest @ ..] => (true, rest),
        [b'+', rest @ ..] => (false, rest),
        _ => (false, text),
    };
    if text.len() > 20 {
        return None;
    }
    let mut digits: u64 = 0;
    let mut count = 0;
    let mut point = None;
    for &byte in text {
        match byte {
            b'0'..=b'9' => {
                digits = digits.wrapping_mul(10).wrapping_add(u64::from(byte - b'0'));
                count += 1;
            }
            b'.' | b',' if point.is_none() => point = Some(count),
            _ => return None,
        }
    }
    (1..=19).contains(&count).then(|| Decimal { negative, digits, exponent: point.map_or(0, |point| point - count) })
}

/// What [`decimal`] does not read: exponents, very long numbers, `NaN`, `inf`.
fn unusual(text: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(text).ok()?;
    text.parse().or_else(|_| text.replacen(',', ".", 1).parse()).ok()
}

const POWERS: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20,
    1e21, 1e22,
];

/// Reads a number, with a decimal point or comma; the same as parsing it as f64.
pub(crate) fn number(text: &[u8]) -> Option<f64> {
    match decimal(text) {
        // Digits and power are exact, so that their quotient is rounded once.
        Some(Decimal { negative, digits, exponent }) if digits < 1 << 53 => {
            let size = digits as f64 / POWERS[exponent.unsigned_abs() as usize];
            Some(if negative { -size } else { size })
        }
        _ => unusual(text),
    }
}

/// Reads a time in units of 10^-`places` seconds (9 for nanoseconds, 6, 3, 0 for seconds), exactly; None where it is no
/// number or beyond what i64 holds.
pub(crate) fn time(text: &[u8], places: i32) -> Option<TimeNs> {
    let Some(Decimal { negative, digits, exponent }) = decimal(text) else {
        let ns = (unusual(text)? * 10_f64.powi(9 - places)).round();
        return (ns.abs() < 9.2e18).then_some(TimeNs(ns as i64));
    };
    let shift = 9 - places + exponent;
    let ns = if shift >= 0 {
        i128::from(digits) * 10_i128.pow(shift.unsigned_abs())
    } else {
        let unit = 10_i128.pow(shift.unsigned_abs());
        (i128::from(digits) + unit / 2) / unit
    };
    i64::try_from(if negative { -ns } else { ns }).ok().map(TimeNs)
}

/// Whether a cell says that there is no figure.
pub(super) fn is_missing(cell: &[u8]) -> bool {
    cell.is_empty()
        || [&b"n/a"[..], b"na", b"nan", b"null", b"none", b"-"].iter().any(|word| cell.eq_ignore_ascii_case(word))
}

/// The figure of a pupil's size, 0 where the cell says that there is none: it is empty, a word such as `nan` or a sign
/// such as `.`, which loggers write of an eye that the tracker did not see.
pub(super) fn size(cell: &[u8]) -> Result<f64, LogFault> {
    if is_missing(cell) || cell == b"." {
        return Ok(0.0);
    }
    match number(cell) {
        None => Err(LogFault::BadNumber),
        Some(size) if size.is_nan() => Ok(0.0),
        Some(size) if size.is_infinite() => Err(LogFault::NotFinite),
        Some(size) => Ok(size),
    }
}

/// The same where no size is negative.
pub(super) fn positive_size(cell: &[u8]) -> Result<f64, LogFault> {
    size(cell).and_then(|size| if size < 0.0 { Err(LogFault::Negative) } else { Ok(size) })
}

/// A confidence, which is one from 0 to 1: what lies above that by rounding is on it, and one below is that of a pupil
/// which was not found.
pub(super) fn share(confidence: f64) -> Result<f32, LogFault> {
    if confidence <= 1.0 + ROUNDING { Ok(confidence.clamp(0.0, 1.0) as f32) } else { Err(LogFault::BadConfidence) }
}

const ROUNDING: f64 = 1e-6;
const BYTE_ORDER_MARK: &[u8] = b"\xEF\xBB\xBF";

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A reader that gives at most `step` bytes at a time.
    struct Dripping {
        bytes: Vec<u8>,
        at: usize,
        step: usize,
    }

    impl Read for Dripping {
        fn read(&mut self, into: &mut [u8]) -> std::io::Result<usize> {
            let count = into.len().min(self.step).min(self.bytes.len() - self.at);
            into[..count].copy_from_slice(&self.bytes[self.at..self.at + count]);
            self.at += count;
            Ok(count)
        }
    }

    fn lines_of(bytes: &[u8], step: usize) -> (Vec<(u64, Vec<u8>)>, u64) {
        let mut log = LogBuilder::default();
        let mut lines = Lines::new(Box::new(Dripping { bytes: bytes.into(), at: 0, step }));
        let mut all = Vec::new();
        while let Some(line) = lines.next(&mut log) {
            all.push((line.number, line.bytes.to_vec()));
        }
        assert!(lines.next(&mut log).is_none());
        (all, log.faults.of(LogFault::TooLong))
    }

    #[test]
    fn lines_come_whole_with_their_numbers_and_overlong_ones_are_counted() {
        let mut text = b"one\r\n\ntwo\n".to_vec();
        text.extend(vec![b'x'; 3 * BUFFER_BYTES]);
        text.extend(b"\nthree\n");
        text.extend(vec![b'y'; MAX_LINE_BYTES]);
        text.extend(b"\nlast");
        let longest = vec![b'y'; MAX_LINE_BYTES];
        let expected: Vec<(u64, Vec<u8>)> = vec![
            (1, b"one".into()),
            (2, b"".into()),
            (3, b"two".into()),
            (5, b"three".into()),
            (6, longest),
            (7, b"last".into()),
        ];
        for step in [7, 4096, usize::MAX] {
            assert_eq!(lines_of(&text, step), (expected.clone(), 1));
        }
        assert_eq!(lines_of(&vec![0; 2 * BUFFER_BYTES], usize::MAX), (vec![], 1));
        assert_eq!(lines_of(b"", 1), (vec![], 0));
    }

    #[test]
    fn a_last_row_that_ends_before_its_columns_is_none() {
        for (last, cut) in
            [("3,4,5", false), ("3,4,", false), ("3,4", true), ("\"3,4\",5", true), ("3", true), ("", false)]
        {
            for end in ["", "\n"] {
                let mut log = LogBuilder::default();
                let text = format!("1,2\n{last}{end}");
                let mut lines = Lines::new(Box::new(std::io::Cursor::new(text.into_bytes())));
                lines.are_rows(b',', 3);
                let mut count = 0;
                while lines.next(&mut log).is_some() {
                    count += 1;
                }
                let cut = cut && end.is_empty();
                let whole = 2 - usize::from(cut || last.is_empty() && end.is_empty());
                assert_eq!((count, log.faults.of(LogFault::Malformed)), (whole, u64::from(cut)), "{last:?}{end:?}");
            }
        }
    }

    #[test]
    fn cells_are_picked_by_column_whatever_their_order_and_quotes() {
        let header = Header::of(b" a ,\"b, c\",d", b',');
        assert_eq!(header, Header { separator: b',', names: ["a", "b, c", "d"].map(String::from).to_vec() });
        assert_eq!(header.first_of(&["x", "d", "a"]), Some(2));
        let picker = Picker::new(b';', [Some(3), None, Some(0), Some(1)]);
        assert_eq!(picker.pick(b"p; \"q\";r;s ;t"), [Some(&b"s"[..]), None, Some(b"p"), Some(b"q")]);
        assert_eq!(picker.pick(b"p;"), [None, None, Some(&b"p"[..]), Some(b"")]);
        assert_eq!(picker.pick(b""), [None, None, Some(&b""[..]), None]);
        assert_eq!(picker.pick(b"\";;;"), [Some(&b""[..]), None, Some(b"\""), Some(b"")]);
    }

    #[test]
    fn times_are_exact_to_the_nanosecond() {
        assert_eq!(time(b"-323801.600000001", 0), Some(TimeNs(-323_801_600_000_001)));
        assert_eq!(time(b"2154556.5", 3), Some(TimeNs(2_154_556_500_000)));
        assert_eq!(time(b"10000000123", 6), Some(TimeNs(10_000_000_123_000)));
        assert_eq!(time(b"1760676790465965534", 9), Some(TimeNs(1_760_676_790_465_965_534)));
        assert_eq!(time(b"0,25", 3), Some(TimeNs(250_000)));
        assert_eq!(time(b"1.23456789e3", 0), Some(TimeNs(1_234_567_890_000)));
        assert_eq!(time(b"8067.36209123456789", 0), Some(TimeNs(8_067_362_091_235)));
        for none in [&b""[..], b"soon", b"1.2.3", b"-", b".", b"NaN", b"1e99", b"99999999999999999999999"] {
            assert_eq!(time(none, 9), None, "{}", String::from_utf8_lossy(none));
        }
    }

    #[test]
    fn numbers_are_read_with_either_decimal_mark() {
        for (text, expected) in
            [("3.5", 3.5), ("-0,25", -0.25), ("+1", 1.0), (".5", 0.5), ("1e-3", 1e-3), ("1,5e2", 150.0)]
        {
            assert_eq!(number(text.as_bytes()), Some(expected), "{text}");
        }
        assert!(number(b"nan").is_some_and(f64::is_nan));
        for none in ["", " ", "-", ".", "1.2.3", "0x10", "3.5mm", "\u{ff}"] {
            assert_eq!(number(none.as_bytes()), None, "{none}");
        }
    }

    #[test]
    fn a_size_is_0_where_the_log_says_that_there_is_none() {
        for none in [&b""[..], b"-", b".", b"nan", b"NaN", b"-nan", b"n/a", b"NA", b"null", b"None", b"0", b"-0.0"] {
            assert_eq!(positive_size(none), Ok(0.0), "{}", String::from_utf8_lossy(none));
        }
        let of = |cell: &str| (size(cell.as_bytes()), positive_size(cell.as_bytes()));
        assert_eq!(of("3,5"), (Ok(3.5), Ok(3.5)));
        assert_eq!(of("-1"), (Ok(-1.0), Err(LogFault::Negative)));
        assert_eq!(of("inf"), (Err(LogFault::NotFinite), Err(LogFault::NotFinite)));
        assert_eq!(of("3.5mm"), (Err(LogFault::BadNumber), Err(LogFault::BadNumber)));
    }

    proptest! {
        #[test]
        fn a_number_is_what_std_reads(value in any::<f64>(), places in 0_usize..18) {
            for text in [value.to_string(), format!("{value:.places$}"), format!("{:.places$}", value % 1e4), format!("{value:e}")] {
                let expected: f64 = text.parse().expect("a number");
                let read = number(text.as_bytes()).expect("a number");
                prop_assert!(read == expected || read.is_nan() && expected.is_nan(), "{} {} {}", text, read, expected);
            }
        }

        #[test]
        fn no_text_makes_the_readers_panic(bytes in proptest::collection::vec(any::<u8>(), 0..60), places in 0..10) {
            let _ = (time(&bytes, places), number(&bytes));
            let header = Header::of(&bytes, b',');
            prop_assert!(!header.names.is_empty());
            let cells = Picker::new(b',', [Some(0), Some(7), Some(2)]).pick(&bytes);
            prop_assert!(cells[0].is_some());
        }

        #[test]
        fn lines_do_not_depend_on_how_they_are_read(
            lines in proptest::collection::vec("[a-c]{0,9}", 0..40), step in 1_usize..20,
        ) {
            let text = lines.join("\n");
            prop_assert_eq!(lines_of(text.as_bytes(), step), lines_of(text.as_bytes(), usize::MAX));
        }
    }
}
