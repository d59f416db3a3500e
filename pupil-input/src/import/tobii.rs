//! Tobii Pro Lab and Tobii Studio: the TSV of their data export.
//!
//! Names of columns came and went with versions, with and without a unit behind them (`Recording timestamp [μs]`,
//! `Pupil diameter left [mm]`, Studio's `RecordingTimestamp`, `PupilLeft`): they are compared without case, spaces and
//! unit. Diameters are millimetres, except where the header says pixels. Where the recording's times are whole
//! milliseconds and the tracker's own are there in microseconds, those are taken.

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::first_recording::FirstRecording;
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample, usual_step};
use super::table::{Row, Table, is_missing, ns_per_unit, number, time_ns};
use crate::SampleEye;
use crate::cells::{cells, separator};
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Tobii, recognises, read };

/// Recording times, the finer first; `Timestamp` is that of old versions of Studio.
const TIMES: [&str; 2] = ["recordingtimestamp", "timestamp"];
/// Clocks that may be finer than the recording's.
const FINER_TIMES: [&str; 2] = ["eyetrackertimestamp", "computertimestamp"];
const EYES: [(&[&str], &str, SampleEye); 2] = [
    (&["pupildiameterleft", "pupilleft"], "validityleft", SampleEye::Left),
    (&["pupildiameterright", "pupilright"], "validityright", SampleEye::Right),
];
/// Lines in which the header is looked for: old versions of Studio put some about the recording before it.
const HEADER_WITHIN: usize = 64;
/// Rows whose times tell the unit of a column that does not name it.
const UNIT_ROWS: usize = 1000;
/// Trackers sample between 0.5 and 100 ms, so a usual step above this is of microseconds.
const GREATEST_STEP_MS: f64 = 300.0;

fn recognises(input: &LogInput<'_>) -> bool {
    input.head_lines().take(HEADER_WITHIN).any(is_header)
}

fn is_header(line: &[u8]) -> bool {
    let (mut time, mut old_time, mut pupil, mut validity) = (false, false, false, false);
    for cell in cells(line, separator(line)) {
        let Ok(name) = std::str::from_utf8(cell) else { continue };
        let (name, _) = plain_name(name);
        time |= name == TIMES[0];
        old_time |= name == TIMES[1];
        pupil |= EYES.iter().any(|(names, _, _)| names.contains(&name.as_str()));
        validity |= EYES.iter().any(|(_, validity, _)| name == *validity);
    }
    pupil && (time || old_time && validity)
}

/// `Pupil diameter left [mm]` as `pupildiameterleft` and `mm`.
fn plain_name(name: &str) -> (String, Option<&str>) {
    let (name, unit) = match name.split_once(['[', '(']) {
        Some((name, unit)) => (name, Some(unit.trim_end_matches([']', ')']))),
        None => (name, None),
    };
    (name.chars().filter(|letter| !letter.is_whitespace()).flat_map(char::to_lowercase).collect(), unit)
}

struct Columns {
    time: usize,
    ns_per_unit: Option<f64>,
    sensor: Option<usize>,
    event: Option<usize>,
    /// What tells recordings apart that were exported into one file.
    recording: [Option<usize>; 2],
    eyes: [Option<Eye>; 2],
    /// What the diameters are, by the header; millimetres where it says nothing.
    unit: SizeUnit,
}

#[derive(Clone, Copy)]
struct Eye {
    eye: SampleEye,
    diameter: usize,
    validity: Option<usize>,
}

impl Eye {
    /// Whether a row has neither a diameter nor a word on validity.
    fn is_left_out(&self, row: &Row<'_>) -> bool {
        let is_empty = |column: usize| row.cell(column).is_ok_and(is_missing);
        is_empty(self.diameter) && self.validity.is_none_or(is_empty)
    }
}

impl Columns {
    fn of(table: &Table) -> Option<Self> {
        let column = |wanted: &str| table.column(|name| plain_name(name).0 == wanted);
        let times = table.names.iter().enumerate().filter_map(|(index, name)| {
            let (name, unit) = plain_name(name);
            let rank = TIMES.iter().position(|time| *time == name)?;
            let ns_per_unit = unit.and_then(ns_per_unit);
            Some((rank, ns_per_unit.unwrap_or(f64::MAX), index, ns_per_unit))
        });
        let (_, _, time, ns_per_unit) = times.min_by(|one, other| {
            (one.0, one.1).partial_cmp(&(other.0, other.1)).unwrap_or(std::cmp::Ordering::Equal)
        })?;
        // An export may have both units, in either order.
        let in_pixels = |name: &str| plain_name(name).1.is_some_and(|unit| unit.trim().eq_ignore_ascii_case("px"));
        let sizes = |pixels: bool| {
            EYES.map(|(names, validity, eye)| {
                let of = |wanted: &str, name: &str| plain_name(name).0 == wanted && in_pixels(name) == pixels;
                let diameter = names.iter().find_map(|wanted| table.column(|name| of(wanted, name)))?;
                Some(Eye { eye, diameter, validity: column(validity) })
            })
        };
        let (eyes, unit) = match sizes(false) {
            [None, None] => (sizes(true), SizeUnit::Pixels),
            eyes => (eyes, SizeUnit::Millimetres),
        };
        let recording = [column("recordingname"), column("participantname")];
        Some(Self { time, ns_per_unit, sensor: column("sensor"), event: column("event"), recording, eyes, unit })
    }

    /// Whether the row is of the eye tracker: other sensors and events have rows of their own.
    fn is_of_eyes(&self, row: &Row<'_>) -> bool {
        match self.sensor {
            Some(sensor) => row.cell(sensor).is_ok_and(|sensor| {
                let named =
                    |word: &[u8]| sensor.get(..word.len()).is_some_and(|begin| begin.eq_ignore_ascii_case(word));
                named(b"eye")
            }),
            None => true,
        }
    }
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let ns_per_unit = match open(input, &mut LogBuilder::default())? {
        None => return Ok(()),
        Some((_, columns)) if columns.ns_per_unit.is_some() => columns.ns_per_unit.unwrap_or(1e6),
        Some((table, columns)) => {
            let us = is_in_microseconds(table, &columns);
            let unit = if us { "microseconds" } else { "milliseconds" };
            log.note(format!(
                "the times have no unit; they are taken for {unit}, after the usual step from sample to sample"
            ));
            if us { 1e3 } else { 1e6 }
        }
    };
    let finer = match open(input, &mut LogBuilder::default())? {
        Some((table, columns)) if ns_per_unit >= 1e6 => finer_clock(table, &columns, ns_per_unit),
        _ => None,
    };
    let Some((mut table, mut columns)) = open(input, log)? else { return Ok(()) };
    log.unit = columns.unit;
    if columns.unit == SizeUnit::Pixels {
        log.note("the header says that the diameters are pixels of the eye camera");
    }
    let ns_per_unit = match finer {
        None => ns_per_unit,
        Some(column) => {
            log.note(format!("times are those of `{}`, in microseconds", table.names[column].escape_debug()));
            columns.time = column;
            1e3
        }
    };

    let mut first = FirstRecording::new(["recording", "participant"]);
    let mut unmeasured = 0_u64;
    while let Some(row) = table.next_row(log) {
        if !columns.is_of_eyes(&row) {
            continue;
        }
        if row.has_more() {
            log.has_more_cells(row.number);
            continue;
        }
        let recording = columns.recording.map(|column| column.and_then(|column| row.cell(column).ok()).unwrap_or(b""));
        if !first.has(recording) {
            continue;
        }
        let t = match row.cell(columns.time).and_then(|cell| time_ns(cell, ns_per_unit)) {
            Ok(t) => TimeNs(t),
            Err(fault) => {
                log.count(fault);
                continue;
            }
        };
        let is_event = columns.sensor.is_none()
            && columns.event.and_then(|event| row.cell(event).ok()).is_some_and(|event| !is_missing(event));
        for eye in columns.eyes.iter().flatten() {
            // An event's own row tells nothing of the eyes.
            if is_event && eye.is_left_out(&row) {
                continue;
            }
            match figure(&row, eye).transpose() {
                Some(size) => log.push_sized(size, LogSample::lost(t, eye.eye), row.number),
                None => unmeasured += 1,
            }
        }
    }
    if unmeasured > 0 {
        log.warn(format!(
            "{unmeasured} times an eye is valid and has no diameter: some trackers measure pupils at a lower rate than gaze"
        ));
    }
    first.note(log);
    Ok(())
}

fn open(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<Option<(Table, Columns)>, ReplayError> {
    let Some(mut table) = Table::open(input, log, is_header)? else { return Ok(None) };
    let Some(columns) = Columns::of(&table) else { return Ok(None) };
    let eyes = columns.eyes.iter().flatten().flat_map(|eye| [Some(eye.diameter), eye.validity]);
    table.look_for_headers(columns.time);
    // A message may hold tabs; rows of the eyes are looked at when they are known.
    table.allow_more_cells();
    let others = [Some(columns.time), columns.sensor, columns.event];
    let finer = FINER_TIMES.map(|wanted| table.column(|name| plain_name(name).0 == wanted));
    table.keep_to(eyes.chain(others).chain(columns.recording).chain(finer).flatten());
    Ok(Some((table, columns)))
}

/// The column of a clock that counts microseconds, beside one of `ns_per_unit` nanoseconds: it advances with that one,
/// and each of the first rows with a pupil has it.
fn finer_clock(mut table: Table, columns: &Columns, ns_per_unit: f64) -> Option<usize> {
    let candidates = FINER_TIMES.map(|wanted| table.column(|name| plain_name(name).0 == wanted));
    let mut times = Vec::with_capacity(UNIT_ROWS);
    while times.len() < UNIT_ROWS {
        let Some(row) = table.next_row(&mut LogBuilder::default()) else { break };
        if columns.is_of_eyes(&row)
            && columns.eyes.iter().flatten().any(|eye| row.cell(eye.diameter).is_ok_and(|cell| !is_missing(cell)))
        {
            let at = |column: usize| row.cell(column).and_then(number).ok();
            times.push((at(columns.time), candidates.map(|column| column.and_then(at))));
        }
    }
    let (first, last) = times.first().zip(times.last())?;
    let by_recording_ns = (last.0? - first.0?) * ns_per_unit;
    candidates.into_iter().enumerate().find_map(|(index, column)| {
        let whole = times.windows(2).all(|pair| pair[0].1[index].zip(pair[1].1[index]).is_some_and(|(a, b)| b > a));
        let by_candidate_ns = (last.1[index]? - first.1[index]?) * 1e3;
        (whole && (by_candidate_ns / by_recording_ns - 1.0).abs() < 0.02).then_some(column?)
    })
}

/// Whether the first times are microseconds rather than milliseconds.
fn is_in_microseconds(mut table: Table, columns: &Columns) -> bool {
    let mut times = Vec::with_capacity(UNIT_ROWS);
    while times.len() < UNIT_ROWS {
        let Some(row) = table.next_row(&mut LogBuilder::default()) else { break };
        let measured = |eye: &Eye| row.cell(eye.diameter).is_ok_and(|cell| !is_missing(cell));
        if columns.is_of_eyes(&row) && columns.eyes.iter().flatten().any(measured) {
            times.extend(row.cell(columns.time).and_then(number));
        }
    }
    usual_step(&times).is_some_and(|step| step > GREATEST_STEP_MS)
}

/// The diameter of an eye, 0 where the tracker did not see it; None where it was not measured.
///
/// Pro Lab says `Valid` or `Invalid`; Studio gives 0 (sure) to 4 (not found) and advises to use 0 and 1.
fn figure(row: &Row<'_>, eye: &Eye) -> Result<Option<f64>, LogFault> {
    let validity = match eye.validity {
        None => None,
        Some(column) => match row.cell(column)? {
            cell if is_missing(cell) => None,
            cell if cell.eq_ignore_ascii_case(b"valid") => Some(true),
            cell if cell.eq_ignore_ascii_case(b"invalid") => Some(false),
            cell => Some(number(cell)? < 2.0),
        },
    };
    let cell = row.cell(eye.diameter)?;
    if is_missing(cell) {
        // Without a word on validity an empty cell is the only sign of a lost pupil.
        let lost = validity == Some(false) || eye.validity.is_none();
        return Ok(lost.then_some(0.0));
    }
    let diameter = number(cell)?;
    Ok(Some(if validity == Some(false) { 0.0 } else { diameter }))
}
