//! Lines and tables of text, read with bounded memory however long a line is.

use std::io::{self, BufRead};

use crate::wire::WireFault;

use super::{LogBuilder, LogFault, LogInput, ReplayError};

/// Bytes of the longest line that is read; a longer one is counted as a fault and skipped.
pub(super) const MAX_LINE_BYTES: usize = 1 << 20;
/// Columns of a table that are told apart; later ones are not looked at.
const MAX_COLUMNS: usize = 1 << 14;

/// A stream cut into lines.
pub(super) struct Lines {
    reader: Box<dyn BufRead>,
    line: Vec<u8>,
    /// Of the line read last, from 1.
    pub(super) number: u64,
}

impl Lines {
    pub(super) fn new(reader: Box<dyn BufRead>) -> Self {
        Self { reader, line: Vec::new(), number: 0 }
    }

    /// Reads the next line that is short enough into [`Self::line`]; false at the end. Longer ones are counted.
    pub(super) fn advance(&mut self, log: &mut LogBuilder) -> io::Result<bool> {
        loop {
            self.line.clear();
            self.number += 1;
            let (mut any, mut too_long) = (false, false);
            loop {
                let bytes = match self.reader.fill_buf() {
                    Ok(bytes) => bytes,
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                    Err(error) => return Err(error),
                };
                if bytes.is_empty() {
                    break;
                }
                any = true;
                let end = memchr::memchr(b'\n', bytes);
                let part = &bytes[..end.unwrap_or(bytes.len())];
                too_long |= self.line.len() + part.len() > MAX_LINE_BYTES;
                if !too_long {
                    self.line.extend_from_slice(part);
                }
                let used = part.len() + usize::from(end.is_some());
                self.reader.consume(used);
                if end.is_some() {
                    break;
                }
            }
            if !any {
                return Ok(false);
            }
            if !too_long {
                return Ok(true);
            }
            log.count(LogFault::Wire(WireFault::TooLong));
        }
    }

    /// The line read last, without its ending.
    pub(super) fn line(&self) -> &[u8] {
        self.line.strip_suffix(b"\r").unwrap_or(&self.line)
    }
}

/// Which of tab, semicolon and comma parts the cells of `header`: the most frequent.
pub(super) fn separator(header: &[u8]) -> u8 {
    let count = |separator: u8| memchr::memchr_iter(separator, header).count();
    b"\t;,".iter().copied().max_by_key(|separator| (count(*separator), *separator == b'\t')).unwrap_or(b',')
}

/// `line` cut at `separator`, the cells trimmed and without quotes around them. In a line with quotes, separators between
/// two of them do not count, except in a line of tabs, where quotes are text.
pub(super) fn cells(line: &[u8], separator: u8) -> impl Iterator<Item = &[u8]> {
    let mut rest = Some(line);
    let quoted = separator != b'\t' && memchr::memchr(b'"', line).is_some();
    std::iter::from_fn(move || {
        let line = rest?;
        let end = if quoted {
            let mut within = false;
            line.iter().position(|&byte| {
                within ^= byte == b'"';
                byte == separator && !within
            })
        } else {
            memchr::memchr(separator, line)
        };
        rest = end.map(|end| &line[end + 1..]);
        Some(unquoted(&line[..end.unwrap_or(line.len())]))
    })
}

fn unquoted(cell: &[u8]) -> &[u8] {
    let cell = cell.trim_ascii();
    cell.strip_prefix(b"\"").and_then(|cell| cell.strip_suffix(b"\"")).unwrap_or(cell)
}

/// A table with its names in one line and a row in each line after it.
pub(super) struct Table {
    lines: Lines,
    separator: u8,
    pub(super) names: Vec<String>,
    /// Cells of a row that are looked at.
    width: usize,
    /// Begin and end of each cell of the row, relative to its line.
    cells: Vec<(u32, u32)>,
}

impl Table {
    /// Opens the log and reads up to the first line that `is_header`; None if there is none.
    pub(super) fn open(
        input: &LogInput<'_>,
        log: &mut LogBuilder,
        is_header: impl Fn(&[u8]) -> bool,
    ) -> Result<Option<Self>, ReplayError> {
        let mut lines = Lines::new(input.open()?);
        while lines.advance(log).map_err(|source| input.io(source))? {
            if is_header(lines.line()) {
                let separator = separator(lines.line());
                let name = |cell: &[u8]| String::from_utf8_lossy(cell).into_owned();
                let names: Vec<_> = cells(lines.line(), separator).take(MAX_COLUMNS).map(name).collect();
                let width = names.len();
                return Ok(Some(Self { lines, separator, names, width, cells: Vec::new() }));
            }
        }
        Ok(None)
    }

    /// The first column whose name `is` the one.
    pub(super) fn column(&self, is: impl Fn(&str) -> bool) -> Option<usize> {
        self.names.iter().position(|name| is(name))
    }

    /// Reads no column behind the last of `columns` from now on.
    pub(super) fn keep_to(&mut self, columns: impl IntoIterator<Item = usize>) {
        self.width = columns.into_iter().max().map_or(0, |last| last + 1);
    }

    /// The next row that is not empty; None at the end.
    pub(super) fn next_row(
        &mut self,
        input: &LogInput<'_>,
        log: &mut LogBuilder,
    ) -> Result<Option<Row<'_>>, ReplayError> {
        loop {
            if !self.lines.advance(log).map_err(|source| input.io(source))? {
                return Ok(None);
            }
            if !self.lines.line().trim_ascii().is_empty() {
                break;
            }
        }
        let line = self.lines.line();
        self.cells.clear();
        let origin = line.as_ptr() as usize;
        self.cells.extend(cells(line, self.separator).take(self.width).map(|cell| {
            let begin = (cell.as_ptr() as usize - origin) as u32;
            (begin, begin + cell.len() as u32)
        }));
        Ok(Some(Row { line, cells: &self.cells, number: self.lines.number }))
    }
}

/// One row of a [`Table`].
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    line: &'a [u8],
    cells: &'a [(u32, u32)],
    /// Of its line, from 1.
    pub(super) number: u64,
}

impl<'a> Row<'a> {
    /// The cell of a column, or that the row ends before it.
    pub(super) fn cell(&self, column: usize) -> Result<&'a [u8], LogFault> {
        let (begin, end) = *self.cells.get(column).ok_or(LogFault::Malformed)?;
        Ok(&self.line[begin as usize..end as usize])
    }
}

/// Whether a cell says that there is no figure.
pub(super) fn is_missing(cell: &[u8]) -> bool {
    cell.is_empty()
        || [&b"n/a"[..], b"na", b"nan", b"null", b"none", b"-"].iter().any(|word| cell.eq_ignore_ascii_case(word))
}

/// A number with a point, or with a comma in its place.
pub(super) fn number(cell: &[u8]) -> Result<f64, LogFault> {
    let mut text = [0; 40];
    let text = text.get_mut(..cell.len()).ok_or(LogFault::BadNumber)?;
    text.copy_from_slice(cell);
    if !cell.contains(&b'.')
        && let Some(comma) = text.iter_mut().find(|byte| **byte == b',')
    {
        *comma = b'.';
    }
    let number: f64 = std::str::from_utf8(text).ok().and_then(|text| text.parse().ok()).ok_or(LogFault::BadNumber)?;
    if number.is_finite() { Ok(number) } else { Err(LogFault::NotFinite) }
}

/// A time in units of `ns_per_unit` nanoseconds, exact to the nanosecond where the cell is a plain decimal number.
pub(super) fn time_ns(cell: &[u8], ns_per_unit: f64) -> Result<i64, LogFault> {
    if cell.is_empty() {
        return Err(LogFault::Missing);
    }
    if ns_per_unit.fract() == 0.0
        && (1.0..=1e12).contains(&ns_per_unit)
        && let Some(ns) = decimal_ns(cell, ns_per_unit as u64)
    {
        return Ok(ns);
    }
    ns_of(number(cell)?, ns_per_unit)
}

/// `units` of `ns_per_unit` nanoseconds as a whole number of nanoseconds.
pub(super) fn ns_of(units: f64, ns_per_unit: f64) -> Result<i64, LogFault> {
    let ns = (units * ns_per_unit).round();
    if ns.abs() < super::GREATEST_NS as f64 { Ok(ns as i64) } else { Err(LogFault::BadNumber) }
}

/// `-123.456` in exact arithmetic, cut off below the nanosecond; None for any other form or too many digits.
fn decimal_ns(cell: &[u8], ns_per_unit: u64) -> Option<i64> {
    let (negative, digits) = match cell {
        [b'-', digits @ ..] => (true, digits),
        digits => (false, digits),
    };
    // Nineteen digits and a point: both products below stay within their types.
    let (mut value, mut scale, mut point, mut count) = (0_u64, 1_u64, false, 0);
    for &byte in digits {
        match byte {
            b'0'..=b'9' if count < 19 => {
                value = value * 10 + u64::from(byte - b'0');
                scale *= if point { 10 } else { 1 };
                count += 1;
            }
            b'.' | b',' if !point => point = true,
            _ => return None,
        }
    }
    if count == 0 {
        return None;
    }
    let ns = if ns_per_unit.is_multiple_of(scale) {
        u128::from(value) * u128::from(ns_per_unit / scale)
    } else {
        u128::from(value) * u128::from(ns_per_unit) / u128::from(scale)
    };
    let ns = i64::try_from(ns).ok()?;
    Some(if negative { -ns } else { ns })
}

/// The nanoseconds that `unit` has, if it is a unit of time.
pub(super) fn ns_per_unit(unit: &str) -> Option<f64> {
    let unit = unit.trim().to_lowercase();
    Some(match unit.as_str() {
        "s" | "sec" | "secs" | "second" | "seconds" => 1e9,
        "ms" | "msec" | "millisecond" | "milliseconds" => 1e6,
        // The micro sign and the Greek letter.
        "us" | "\u{b5}s" | "\u{3bc}s" | "usec" | "microsecond" | "microseconds" => 1e3,
        "ns" | "nsec" | "nanosecond" | "nanoseconds" => 1.0,
        _ => return None,
    })
}

/// The usual step of `times`: the median of those that are positive.
pub(super) fn usual_step(times: &[f64]) -> Option<f64> {
    let mut steps: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0).collect();
    steps.sort_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_with_point_or_comma() {
        assert_eq!(number(b"3.25"), Ok(3.25));
        assert_eq!(number(b"3,25"), Ok(3.25));
        assert_eq!(number(b"-1e3"), Ok(-1000.0));
        assert_eq!(number(b"1,000.5"), Err(LogFault::BadNumber));
        assert_eq!(number(b"inf"), Err(LogFault::NotFinite));
        assert_eq!(number(&[b'1'; 41]), Err(LogFault::BadNumber));
        assert_eq!(number(b"3,5\xFF"), Err(LogFault::BadNumber));
    }

    #[test]
    fn times_are_exact_where_doubles_are_not() {
        assert_eq!(time_ns(b"1700000000.123456789", 1e9), Ok(1_700_000_000_123_456_789));
        assert_eq!(time_ns(b"-0,5", 1e6), Ok(-500_000));
        assert_eq!(time_ns(b"696216388878.0", 100.0), Ok(69_621_638_887_800));
        assert_eq!(time_ns(b"1.5e3", 1e6), Ok(1_500_000_000));
        assert_eq!(time_ns(b"3", 1e9 / 3.0), Ok(1_000_000_000));
        assert_eq!(time_ns(b"", 1.0), Err(LogFault::Missing));
        for bad in [&b"-"[..], b".", b"1.2.3", b"x"] {
            assert_eq!(time_ns(bad, 1e9), Err(LogFault::BadNumber), "{bad:?}");
        }
        assert_eq!(time_ns(b"99999999999999999999", 1e9), Err(LogFault::BadNumber));
        assert_eq!(time_ns(b"1e300", 1e9), Err(LogFault::BadNumber));
    }

    #[test]
    fn cells_are_cut_at_the_separator_and_not_within_quotes() {
        let cut = |line: &'static str, separator| -> Vec<_> { cells(line.as_bytes(), separator).collect() };
        assert_eq!(cut("a, \"b,c\" ,,\"d\"\"e\"", b','), [&b"a"[..], b"b,c", b"", b"d\"\"e"]);
        assert_eq!(cut("a\t\"b\tc\"", b'\t'), [&b"a"[..], b"\"b", b"c\""]);
        assert_eq!(cut("\"a;b", b';'), [b"\"a;b"]);
        assert_eq!([separator(b"a,b\tc\td"), separator(b"a;b;c,d"), separator(b"a")], [b'\t', b';', b'\t']);
    }

    #[test]
    fn a_line_of_any_length_costs_bounded_memory() {
        let long = [vec![b'x'; 5 * MAX_LINE_BYTES], b"\nshort\r\n\nlast".to_vec()].concat();
        let mut log = LogBuilder::default();
        let mut lines = Lines::new(Box::new(io::Cursor::new(long)));
        let mut seen = Vec::new();
        while lines.advance(&mut log).expect("reads") {
            seen.push((lines.number, lines.line().to_vec()));
        }
        assert_eq!(seen, [(2, b"short".to_vec()), (3, Vec::new()), (4, b"last".to_vec())]);
        assert_eq!(log.faults.of(LogFault::Wire(WireFault::TooLong)), 1);
        assert!(lines.line.capacity() <= 2 * MAX_LINE_BYTES);
    }
}
