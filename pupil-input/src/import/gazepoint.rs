//! Gazepoint Analysis and Control: CSV whose columns bear the names of the Open Gaze protocol.

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::parts::is_restart;
use super::recording::{LogBuilder, LogSample};
use super::rows::Blink;
use super::table::{Row, Table, is_missing, number, time_ns};
use crate::SampleEye;
use crate::cells::{cells, separator};
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Gazepoint, recognises, read };

/// Diameter, its validity, the eye: millimetres, then pixels of the eye camera.
const MILLIMETRES: [(&str, &str, SampleEye); 2] =
    [("LPMM", "LPMMV", SampleEye::Left), ("RPMM", "RPMMV", SampleEye::Right)];
const PIXELS: [(&str, &str, SampleEye); 2] = [("LPD", "LPV", SampleEye::Left), ("RPD", "RPV", SampleEye::Right)];
/// A blink that seems longer is a number that was not set back to 0.
const LONGEST_BLINK_NS: i64 = 10_000_000_000;
/// Rows that show whether the tick clock goes at the rate that it states.
const CLOCK_ROWS: usize = 1000;

fn recognises(input: &LogInput<'_>) -> bool {
    input.head_lines().next().is_some_and(is_header)
}

fn is_header(line: &[u8]) -> bool {
    let has = |is: &dyn Fn(&[u8]) -> bool| cells(line, separator(line)).any(is);
    let has_name = |wanted: &str| has(&|name| name == wanted.as_bytes());
    has(&|name| std::str::from_utf8(name).is_ok_and(is_time))
        && MILLIMETRES.iter().chain(&PIXELS).any(|(diameter, validity, _)| has_name(diameter) && has_name(validity))
}

/// `TIME`, or with the date at which the recording began: `TIME(2020/11/03 12:00:00.000)`.
fn is_time(name: &str) -> bool {
    name == "TIME" || name.starts_with("TIME(") || name == "Time (in secs)"
}

/// Where time is read.
#[derive(Clone, Copy)]
struct Clock {
    column: usize,
    ns_per_unit: f64,
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let Some(clock) = choose_clock(input)? else { return Ok(()) };
    let Some(mut table) = Table::open(input, log, is_header)? else { return Ok(()) };
    let column = |wanted: &str| table.column(|name| name == wanted);
    let in_mm = is_in_mm(input)?;
    if !in_mm {
        log.unit = SizeUnit::Pixels;
        if MILLIMETRES.iter().any(|(diameter, _, _)| column(diameter).is_some()) {
            log.warn(
                "`LPMM` and `RPMM`, the diameters in millimetres, are 0 throughout: sizes are those in pixels of the eye \
                 camera; give the rig a scale",
            );
        }
    }
    let eyes = columns_of(&table, if in_mm { MILLIMETRES } else { PIXELS });
    let mut blinks = Blinks { id: column("BKID"), duration: column("BKDUR"), ..Blinks::default() };
    if let Some(begin) = table.names.iter().find_map(|name| name.strip_prefix("TIME(")?.strip_suffix(')')) {
        log.note(format!("the header says that it began at {}", begin.escape_debug()));
    }

    table.look_for_headers(clock.column);
    // The name of the time may hold the date.
    table.compare_names_by(|one, other| one == other || is_time(one) && is_time(other));
    let read = eyes.iter().flatten().flat_map(|(diameter, validity, _)| [Some(*diameter), *validity]);
    let last = read.chain([Some(clock.column), blinks.id, blinks.duration]).flatten().max();
    // Texts of the user's, which nothing stands around.
    if table.names.iter().rposition(|name| name == "USER" || name.starts_with("AOI")) > last {
        table.allow_more_cells();
    }
    while let Some(row) = table.next_row(log) {
        let t = match row.cell(clock.column).and_then(|cell| time_ns(cell, clock.ns_per_unit)) {
            Ok(t_ns) => TimeNs(t_ns),
            Err(fault) => {
                log.count(fault);
                continue;
            }
        };
        for (diameter, validity, eye) in eyes.into_iter().flatten() {
            log.push_sized(figure(&row, diameter, validity), LogSample::lost(t, eye), row.number);
        }
        blinks.take(&row, t, log);
    }
    blinks.end(log);
    Ok(())
}

/// Column of the diameter, column of its validity, and eye.
type Columns = (usize, Option<usize>, SampleEye);

fn columns_of(table: &Table, names: [(&str, &str, SampleEye); 2]) -> [Option<Columns>; 2] {
    let column = |wanted: &str| table.column(|name| name == wanted);
    names.map(|(diameter, validity, eye)| column(diameter).map(|diameter| (diameter, column(validity), eye)))
}

/// Whether diameters are read in millimetres: where there are such columns, unless they are 0 throughout while pixels
/// are not.
fn is_in_mm(input: &LogInput<'_>) -> Result<bool, ReplayError> {
    let mut ignored = LogBuilder::default();
    let Some(mut table) = Table::open(input, &mut ignored, is_header)? else { return Ok(false) };
    let [mm, px] = [MILLIMETRES, PIXELS].map(|names| columns_of(&table, names));
    if [mm, px].iter().any(|eyes| eyes.iter().all(Option::is_none)) {
        return Ok(mm.iter().any(Option::is_some));
    }
    let mut has_px = false;
    while let Some(row) = table.next_row(&mut ignored) {
        let holds = |eyes: [Option<Columns>; 2]| {
            let is_size = |(diameter, validity, _)| figure(&row, diameter, validity).is_ok_and(|size| size > 0.0);
            eyes.into_iter().flatten().any(is_size)
        };
        if holds(mm) {
            return Ok(true);
        }
        has_px |= holds(px);
    }
    Ok(!has_px)
}

/// The tick clock where there is one that goes at its stated rate, since `TIME` starts again with each medium that was
/// shown; `TIME` otherwise.
fn choose_clock(input: &LogInput<'_>) -> Result<Option<Clock>, ReplayError> {
    let mut ignored = LogBuilder::default();
    let Some(mut table) = Table::open(input, &mut ignored, is_header)? else { return Ok(None) };
    let Some(time) = table.column(is_time) else { return Ok(None) };
    let seconds = Clock { column: time, ns_per_unit: 1e9 };
    let ticks = table.names.iter().enumerate().find_map(|(column, name)| {
        let per_second: f64 = name.strip_prefix("TIMETICK(f=")?.strip_suffix(')')?.parse().ok()?;
        (per_second > 0.0).then_some(Clock { column, ns_per_unit: 1e9 / per_second })
    });
    let Some(ticks) = ticks else { return Ok(Some(seconds)) };
    // Steps of both clocks, added up over rows where TIME goes on.
    let (mut by_seconds, mut by_ticks, mut before) = (0_i128, 0_i128, None);
    for _ in 0..CLOCK_ROWS {
        let Some(row) = table.next_row(&mut ignored) else { break };
        let at = |clock: Clock| row.cell(clock.column).and_then(|cell| time_ns(cell, clock.ns_per_unit)).ok();
        let Some(now) = at(seconds).zip(at(ticks)) else { continue };
        if let Some((seconds, ticks)) = before
            && now.0 > seconds
        {
            by_seconds += i128::from(now.0) - i128::from(seconds);
            by_ticks += i128::from(now.1) - i128::from(ticks);
        }
        before = Some(now);
    }
    let agree = by_seconds > 0 && (by_ticks - by_seconds).abs() * 5 < by_seconds;
    Ok(Some(if agree { ticks } else { seconds }))
}

/// A diameter, 0 where the tracker did not see the pupil.
fn figure(row: &Row<'_>, diameter: usize, validity: Option<usize>) -> Result<f64, LogFault> {
    let seen = match validity {
        None => true,
        Some(column) => number(row.cell(column)?)? == 1.0,
    };
    let cell = row.cell(diameter)?;
    if !seen && is_missing(cell) {
        return Ok(0.0);
    }
    if cell.is_empty() {
        return Err(LogFault::Missing);
    }
    let diameter = number(cell)?;
    Ok(if seen { diameter } else { 0.0 })
}

/// Blinks, each once. `BKID` is a blink's number while it lasts and 0 between; `BKDUR` is its length in seconds, comes
/// with its end or after it, and stays for one row or until the next blink; some versions have one of them only.
#[derive(Default)]
struct Blinks {
    id: Option<usize>,
    duration: Option<usize>,
    current: Option<Current>,
    /// Length in the row before.
    duration_ns: i64,
    /// The end of the blink that was told last.
    told_until: Option<TimeNs>,
}

#[derive(Clone, Copy)]
struct Current {
    id: i64,
    begins: TimeNs,
    ends: TimeNs,
    duration_ns: i64,
}

impl Blinks {
    fn take(&mut self, row: &Row<'_>, t: TimeNs, log: &mut LogBuilder) {
        let figure =
            |column: Option<usize>| column.and_then(|column| number(row.cell(column).ok()?).ok()).unwrap_or(0.0);
        let id = figure(self.id) as i64;
        let duration_ns = (figure(self.duration).clamp(0.0, LONGEST_BLINK_NS as f64 * 1e-9) * 1e9) as i64;
        let news_ns = if duration_ns == self.duration_ns { 0 } else { duration_ns };
        self.duration_ns = duration_ns;
        match &mut self.current {
            Some(current) if id == current.id && !is_restart(current.ends.0, t.0) => {
                current.ends = t;
                current.duration_ns = current.duration_ns.max(news_ns);
            }
            _ => {
                self.end(log);
                if id != 0 {
                    self.current = Some(Current { id, begins: t, ends: t, duration_ns: news_ns });
                } else if news_ns > 0 {
                    let begins = TimeNs(t.0.saturating_sub(news_ns));
                    // Unless it is the length of the blink that was just told by its number.
                    if self.told_until.is_none_or(|ends| !(begins..=t).contains(&ends)) {
                        self.tell(begins, t, log);
                    }
                }
            }
        }
    }

    fn end(&mut self, log: &mut LogBuilder) {
        let Some(Current { begins, ends, duration_ns, .. }) = self.current.take() else { return };
        // A blink that one row alone knows, or whose number was never set back, goes by its length.
        let by_rows = (1..=LONGEST_BLINK_NS).contains(&(ends.0.saturating_sub(begins.0)));
        let (begins, ends) =
            if by_rows { (begins, ends) } else { (TimeNs(begins.0.saturating_sub(duration_ns)), begins) };
        self.tell(begins, ends, log);
    }

    fn tell(&mut self, begins: TimeNs, ends: TimeNs, log: &mut LogBuilder) {
        self.told_until = Some(ends);
        log.blink(Blink { eye: SampleEye::Both, begins, ends });
    }
}
