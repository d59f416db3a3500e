//! Tables of text whose columns have names, and what their cells hold.

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::input::LogInput;
use super::recording::{GREATEST_NS, LogBuilder};
pub(super) use super::text::is_missing;
use super::text::{self, Lines, is_word, named};
use crate::cells::{cells, has_more, separator};

/// Columns of a table that are told apart; later ones are not looked at.
const MAX_COLUMNS: usize = 1 << 14;

/// A table with its names in one line and a row in each line after it.
pub(super) struct Table {
    lines: Lines,
    separator: u8,
    pub(super) names: Vec<String>,
    /// Cells of a row that are looked at.
    width: usize,
    /// The column of times, in which a row has no word.
    time: Option<usize>,
    is_header: fn(&[u8]) -> bool,
    /// Whether two names are of the same column.
    are_alike: fn(&str, &str) -> bool,
    /// Columns of a row in all, where they are told apart.
    columns: Option<usize>,
    takes_more: bool,
    /// The row read last, its number, and begin and end of each of its cells.
    line: Vec<u8>,
    number: u64,
    cells: Vec<(u32, u32)>,
}

impl Table {
    /// Opens the log and reads up to the first line that `is_header`; None if there is none.
    pub(super) fn open(
        input: &LogInput<'_>,
        log: &mut LogBuilder,
        is_header: fn(&[u8]) -> bool,
    ) -> Result<Option<Self>, ReplayError> {
        let mut lines = input.lines()?;
        let (separator, names) = loop {
            match lines.next(log) {
                None => return Ok(None),
                Some(line) if is_header(line.bytes) => {
                    let separator = separator(line.bytes);
                    break (separator, names(line.bytes, separator).collect::<Vec<_>>());
                }
                Some(_) => {}
            }
        };
        let width = names.len();
        if width < MAX_COLUMNS {
            lines.are_rows(separator, width);
        }
        Ok(Some(Self {
            lines,
            separator,
            names,
            width,
            time: None,
            is_header,
            are_alike: |one, other| one == other,
            line: Vec::new(),
            number: 0,
            columns: (width < MAX_COLUMNS).then_some(width),
            takes_more: false,
            cells: Vec::new(),
        }))
    }

    /// Looks for a header again where a row has a word in the column of times.
    pub(super) const fn look_for_headers(&mut self, time: usize) {
        self.time = Some(time);
    }

    /// Takes names of columns for the same by `are_alike`, where they hold what differs from file to file.
    pub(super) const fn compare_names_by(&mut self, are_alike: fn(&str, &str) -> bool) {
        self.are_alike = are_alike;
    }

    /// Rows may hold more than the header names, as a text of the user's does that has separators; see
    /// [`Row::has_more`].
    pub(super) const fn allow_more_cells(&mut self) {
        self.takes_more = true;
    }

    /// The first column whose name `is` the one.
    pub(super) fn column(&self, is: impl Fn(&str) -> bool) -> Option<usize> {
        self.names.iter().position(|name| is(name))
    }

    /// Reads no column behind the last of `columns` from now on.
    pub(super) fn keep_to(&mut self, columns: impl IntoIterator<Item = usize>) {
        self.width = columns.into_iter().max().map_or(0, |last| last + 1);
    }

    /// The next row that is neither empty nor longer than the header; None at the end, or at a header of other columns.
    pub(super) fn next_row(&mut self, log: &mut LogBuilder) -> Option<Row<'_>> {
        loop {
            let line = self.lines.next(log)?;
            if line.bytes.trim_ascii().is_empty() {
                continue;
            }
            self.line.clear();
            self.line.extend_from_slice(line.bytes);
            self.number = line.number;
            Row::cut(&self.line, self.number, self.separator, self.width, &mut self.cells);
            if self.is_header_again() {
                let again: Vec<_> = names(&self.line, self.separator).collect();
                let (names, again) = (named(&self.names), named(&again));
                let is_same = again.len() == names.len()
                    && names.iter().zip(again).all(|(one, other)| (self.are_alike)(one, other));
                if !log.header_again(self.number, is_same) {
                    return None;
                }
            } else if !self.takes_more && self.row().has_more() {
                log.has_more_cells(self.number);
            } else {
                break;
            }
        }
        Some(self.row())
    }

    /// The row read last.
    fn row(&self) -> Row<'_> {
        let Self { separator, columns, number, .. } = *self;
        Row { line: &self.line, cells: &self.cells, number, separator, columns }
    }

    fn is_header_again(&self) -> bool {
        let row = self.row();
        self.time.is_some_and(|time| row.cell(time).map_or(true, is_word)) && (self.is_header)(&self.line)
    }
}

/// The names in a header.
fn names(line: &[u8], separator: u8) -> impl Iterator<Item = String> {
    cells(line, separator).take(MAX_COLUMNS).map(|cell| String::from_utf8_lossy(cell).into_owned())
}

/// One row of a [`Table`].
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    line: &'a [u8],
    cells: &'a [(u32, u32)],
    /// Of its line, from 1.
    pub(super) number: u64,
    separator: u8,
    /// As many as the header names, where that is known.
    columns: Option<usize>,
}

impl<'a> Row<'a> {
    /// Cuts a line into its first `width` cells.
    pub(super) fn cut(line: &'a [u8], number: u64, separator: u8, width: usize, into: &'a mut Vec<(u32, u32)>) -> Self {
        let origin = line.as_ptr() as usize;
        into.clear();
        into.extend(cells(line, separator).take(width).map(|cell| {
            let begin = (cell.as_ptr() as usize - origin) as u32;
            (begin, begin + cell.len() as u32)
        }));
        Self { line, cells: into, number, separator, columns: None }
    }

    /// Whether it holds more than the header names, so that which cell is of which column is not known.
    pub(super) fn has_more(&self) -> bool {
        self.columns.is_some_and(|columns| has_more(self.line, self.separator, columns))
    }

    /// The cell of a column, or that the row ends before it.
    pub(super) fn cell(&self, column: usize) -> Result<&'a [u8], LogFault> {
        let (begin, end) = *self.cells.get(column).ok_or(LogFault::Malformed)?;
        Ok(&self.line[begin as usize..end as usize])
    }
}

/// A finite number with a decimal point or comma.
pub(super) fn number(cell: &[u8]) -> Result<f64, LogFault> {
    let number = text::number(cell).ok_or(LogFault::BadNumber)?;
    if number.is_finite() { Ok(number) } else { Err(LogFault::NotFinite) }
}

/// A time in units of `ns_per_unit` nanoseconds, exact to the nanosecond where that is a power of ten.
pub(super) fn time_ns(cell: &[u8], ns_per_unit: f64) -> Result<i64, LogFault> {
    if cell.is_empty() {
        return Err(LogFault::Missing);
    }
    match (0..=9).find(|places| 10_f64.powi(9 - places) == ns_per_unit) {
        Some(places) => match text::time(cell, places) {
            Some(TimeNs(ns)) if ns.unsigned_abs() < GREATEST_NS => Ok(ns),
            _ => Err(LogFault::BadNumber),
        },
        None => ns_of(number(cell)?, ns_per_unit),
    }
}

/// `units` of `ns_per_unit` nanoseconds as a whole number of nanoseconds.
pub(super) fn ns_of(units: f64, ns_per_unit: f64) -> Result<i64, LogFault> {
    let ns = (units * ns_per_unit).round();
    if ns.abs() < GREATEST_NS as f64 { Ok(ns as i64) } else { Err(LogFault::BadNumber) }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_exact_where_doubles_are_not() {
        assert_eq!(time_ns(b"1700000000.123456789", 1e9), Ok(1_700_000_000_123_456_789));
        assert_eq!(time_ns(b"-0,5", 1e6), Ok(-500_000));
        assert_eq!(time_ns(b"696216388878.0", 100.0), Ok(69_621_638_887_800));
        assert_eq!(time_ns(b"1.5e3", 1e6), Ok(1_500_000_000));
        assert_eq!(time_ns(b"3", 1e9 / 3.0), Ok(1_000_000_000));
        assert_eq!(time_ns(b"", 1.0), Err(LogFault::Missing));
        assert_eq!(time_ns(b"inf", 1e9 / 3.0), Err(LogFault::NotFinite));
        for bad in [&b"-"[..], b".", b"1.2.3", b"x"] {
            assert_eq!(time_ns(bad, 1e9), Err(LogFault::BadNumber), "{bad:?}");
        }
        assert_eq!(time_ns(b"99999999999999999999", 1e9), Err(LogFault::BadNumber));
        assert_eq!(time_ns(b"1e300", 1e9), Err(LogFault::BadNumber));
    }
}
