//! SMI: text exports of BeGaze and of the IDF converter.
//!
//! Lines that begin with `#` come first, then names of columns, then rows of samples (`SMP`) and messages (`MSG`).
//! Columns are set apart by tabs, semicolons or commas, figures may have decimal commas, and 0.00 or `-` is a lost eye.

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::first_recording::FirstRecording;
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::parts::is_restart;
use super::recording::{LogBuilder, LogSample};
use super::rows::Blink;
use super::text::{Header, Lines, Picker, number, positive_size, time};
use crate::SampleEye;
use crate::cells::separator;
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Smi, recognises, read };

/// Names of the columns of one eye.
struct Names {
    eye: SampleEye,
    diameter_mm: [&'static str; 3],
    width_px: [&'static str; 2],
    height_px: [&'static str; 2],
    event: [&'static str; 2],
}

const EYES: [Names; 2] = [
    Names {
        eye: SampleEye::Left,
        diameter_mm: ["L Pupil Diameter [mm]", "L Mapped Diameter [mm]", "Pupil Diameter Left [mm]"],
        width_px: ["L Dia X [px]", "Pupil Size Left X [px]"],
        height_px: ["L Dia Y [px]", "Pupil Size Left Y [px]"],
        event: ["L Event Info", "Category Left"],
    },
    Names {
        eye: SampleEye::Right,
        diameter_mm: ["R Pupil Diameter [mm]", "R Mapped Diameter [mm]", "Pupil Diameter Right [mm]"],
        width_px: ["R Dia X [px]", "Pupil Size Right X [px]"],
        height_px: ["R Dia Y [px]", "Pupil Size Right Y [px]"],
        event: ["R Event Info", "Category Right"],
    },
];

/// Its column of times and their unit as [`time`] wants it.
fn times(header: &Header) -> Option<(usize, i32)> {
    let microseconds = header.column("Time").map(|column| (column, 6));
    microseconds.or_else(|| header.column("RecordingTime [ms]").map(|column| (column, 3)))
}

/// The names of columns, if this line is of them.
fn header_of(line: &[u8]) -> Option<Header> {
    let header = Header::of(line, separator(line));
    let sizes =
        EYES.iter().any(|eye| header.first_of(&eye.diameter_mm).is_some() || header.first_of(&eye.width_px).is_some());
    (sizes && times(&header).is_some() && (header.has("Type") || header.has("Trial"))).then_some(header)
}

fn recognises(input: &LogInput<'_>) -> bool {
    input.head_lines().find(|line| line[0] != b'#').is_some_and(|line| header_of(line).is_some())
}

/// Where one eye's size is: a diameter, or the width and the height of the pupil's picture.
struct SizeColumns {
    size: Option<usize>,
    height: Option<usize>,
}

impl SizeColumns {
    fn of(header: &Header, names: &Names, in_mm: bool) -> Self {
        if in_mm {
            Self { size: header.first_of(&names.diameter_mm), height: None }
        } else {
            Self { size: header.first_of(&names.width_px), height: header.first_of(&names.height_px) }
        }
    }

    /// The diameter that the cells of a row give; nothing of an eye without a column.
    fn diameter(&self, size: Option<&[u8]>, height: Option<&[u8]>) -> Option<Result<f64, LogFault>> {
        self.size?;
        Some(figure(size).and_then(|size| match self.height {
            None => Ok(size),
            // The disc of the area of the ellipse.
            Some(_) => figure(height).map(|height| (size * height).sqrt()),
        }))
    }
}

/// Reads up to the names of the columns; with the number of samples that the lines before them promise.
fn read_head(lines: &mut Lines, log: &mut LogBuilder) -> Option<(Header, Option<f64>)> {
    let mut stated_samples = None;
    loop {
        let line = lines.next(log)?;
        let text = line.bytes.trim_ascii();
        if let Some(rate_hz) = stated(text, b"Sample Rate").filter(|rate_hz| (1.0..=1e5).contains(rate_hz)) {
            log.stated_rate_hz.get_or_insert(rate_hz);
        }
        stated_samples = stated_samples.or_else(|| stated(text, b"Number of Samples"));
        if !text.is_empty() && text[0] != b'#' {
            return header_of(text).map(|header| (header, stated_samples));
        }
    }
}

/// Whether sizes are read in millimetres: where there are such columns, unless they are 0 throughout while pixels are
/// not.
fn is_in_mm(input: &LogInput<'_>) -> Result<bool, ReplayError> {
    let mut ignored = LogBuilder::default();
    let mut lines = input.lines()?;
    let Some((header, _)) = read_head(&mut lines, &mut ignored) else { return Ok(false) };
    let [left_mm, right_mm] = EYES.map(|eye| header.first_of(&eye.diameter_mm));
    let [left_px, right_px] = EYES.map(|eye| header.first_of(&eye.width_px));
    if left_mm.or(right_mm).is_none() || left_px.or(right_px).is_none() {
        return Ok(left_mm.or(right_mm).is_some());
    }
    let picker = Picker::new(header.separator, [header.column("Type"), left_mm, right_mm, left_px, right_px]);
    let mut has_px = false;
    while let Some(line) = lines.next(&mut ignored) {
        let [kind, left_mm, right_mm, left_px, right_px] = picker.pick(line.bytes);
        if kind.is_some_and(|kind| kind != b"SMP") {
            continue;
        }
        let is_size = |cell: Option<&[u8]>| figure(cell).is_ok_and(|size| size > 0.0);
        if is_size(left_mm) || is_size(right_mm) {
            return Ok(true);
        }
        has_px |= is_size(left_px) || is_size(right_px);
    }
    Ok(!has_px)
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let in_mm = is_in_mm(input)?;
    let mut lines = input.lines()?;
    let Some((header, stated_samples)) = read_head(&mut lines, log) else { return Ok(()) };
    let Some((time_column, places)) = times(&header) else { return Ok(()) };
    let [left, right] = EYES.map(|eye| SizeColumns::of(&header, &eye, in_mm));
    let [left_event, right_event] = EYES.map(|eye| header.first_of(&eye.event));
    let columns = [
        Some(time_column),
        header.column("Type"),
        header.column("Participant"),
        left.size,
        left.height,
        right.size,
        right.height,
        left_event,
        right_event,
    ];
    let picker = Picker::new(header.separator, columns);
    let has_type = header.has("Type");

    let mut blinks = [Shut::default(), Shut::default()];
    let mut first = FirstRecording::new(["participant"]);
    let mut rows = 0_u64;
    while let Some(line) = lines.next(log) {
        if line.bytes.is_empty() || line.bytes[0] == b'#' {
            continue;
        }
        let [t, kind, participant, left_size, left_height, right_size, right_height, left_event, right_event] =
            picker.pick(line.bytes);
        if let Some(is_same) = header.again(line.bytes, t, |line| header_of(line).is_some()) {
            if log.header_again(line.number, is_same) {
                continue;
            }
            break;
        }
        if has_type && kind.is_some_and(|kind| kind != b"SMP") {
            continue;
        }
        rows += 1;
        if participant.is_some_and(|participant| !first.has([participant])) {
            continue;
        }
        if header.leaves_over(line.bytes) {
            log.has_more_cells(line.number);
            continue;
        }
        let Some(t) = t else {
            log.count(LogFault::Malformed);
            continue;
        };
        let Some(t) = time(t, places) else {
            log.count(LogFault::BadNumber);
            continue;
        };
        let diameters = [left.diameter(left_size, left_height), right.diameter(right_size, right_height)];
        for (diameter, names) in diameters.into_iter().zip(&EYES) {
            if let Some(diameter) = diameter {
                log.push_sized(diameter, LogSample::lost(t, names.eye), line.number);
            }
        }
        for ((shut, event), names) in blinks.iter_mut().zip([left_event, right_event]).zip(&EYES) {
            shut.note(t, event == Some(b"Blink"), names.eye, log);
        }
    }
    for (shut, names) in blinks.iter_mut().zip(&EYES) {
        shut.end(names.eye, log);
    }
    first.note(log);
    if let Some(stated) = stated_samples.filter(|stated| (rows as f64) < *stated) {
        log.warn(format!(
            "the header promises {stated} samples and there are {rows}: the file is cut off; copy it again"
        ));
    }
    if !in_mm {
        log.unit = SizeUnit::Pixels;
        tell_pixels(&header, log);
    }
    Ok(())
}

fn tell_pixels(header: &Header, log: &mut LogBuilder) {
    let in_pixels = "sizes are in pixels of the eye camera, √(width·height)";
    if EYES.iter().any(|eye| header.first_of(&eye.diameter_mm).is_some()) {
        log.warn(format!(
            "the columns of diameters in millimetres are 0 or empty throughout: {in_pixels}; give the rig a scale"
        ));
    } else {
        log.note(format!("there are no diameters in millimetres: {in_pixels}"));
    }
}

/// The figure of a header line such as `## Sample Rate: 250`.
fn stated(line: &[u8], name: &[u8]) -> Option<f64> {
    let rest = line.strip_prefix(b"##")?.trim_ascii_start().strip_prefix(name)?;
    number(rest.strip_prefix(b":")?.trim_ascii())
}

/// A size, or 0 where the eye is lost.
fn figure(cell: Option<&[u8]>) -> Result<f64, LogFault> {
    positive_size(cell.ok_or(LogFault::Malformed)?)
}

/// A run of rows that say `Blink`.
#[derive(Default)]
struct Shut {
    run: Option<(TimeNs, TimeNs)>,
}

impl Shut {
    fn note(&mut self, t: TimeNs, blinks: bool, eye: SampleEye, log: &mut LogBuilder) {
        if !blinks || self.run.is_some_and(|(_, ends)| is_restart(ends.0, t.0)) {
            self.end(eye, log);
        }
        if !blinks {
            return;
        }
        let begins = self.run.map_or(t, |(begins, _)| begins);
        self.run = Some((begins, t.max(begins)));
    }

    fn end(&mut self, eye: SampleEye, log: &mut LogBuilder) {
        if let Some((begins, ends)) = self.run.take() {
            log.blink(Blink { eye, begins, ends });
        }
    }
}
