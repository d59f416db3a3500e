//! Pupil Labs Neon: `3d_eye_states.csv` of its cloud, and `eye_state ps1.raw` as the phone writes it, with the blinks
//! of the file beside either.
//!
//! The layout of the phone's files: one record of 20 little-endian f32 an eye camera frame (14 before eyelids were
//! measured), their times as i64 nanoseconds in the `.time` file, the fields' names in `eye_state.dtype`; each blink an
//! i32 and its begin and end as i64 nanoseconds.

use std::io::Read;
use std::path::Path;

use holod_calibration::{TimeNs, folder_of};

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use super::rows::Blink;
use super::text::{Header, Picker, number, positive_size, time};
use crate::SampleEye;
use crate::cells::separator;

pub(super) const CLOUD: Importer =
    Importer { format: LogFormat::NeonEyeStates, recognises: recognises_cloud, read: read_cloud };
pub(super) const NATIVE: Importer =
    Importer { format: LogFormat::NeonNative, recognises: recognises_native, read: read_native };

const TIME: &str = "timestamp [ns]";
const DIAMETERS: [(&str, &str, SampleEye); 3] = [
    ("pupil diameter left [mm]", "eyelid aperture left [mm]", SampleEye::Left),
    ("pupil diameter right [mm]", "eyelid aperture right [mm]", SampleEye::Right),
    // As the cloud wrote it at first.
    ("pupil diameter [mm]", "eyelid aperture [mm]", SampleEye::Both),
];

fn recognises_cloud(input: &LogInput<'_>) -> bool {
    input.head_lines().next().is_some_and(is_cloud_header)
}

fn is_cloud_header(line: &[u8]) -> bool {
    let header = Header::of(line, separator(line));
    header.has(TIME) && DIAMETERS.iter().any(|(diameter, _, _)| header.has(diameter))
}

fn read_cloud(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let mut lines = input.lines()?;
    let Some(header) = lines.header(log) else { return Ok(()) };
    let [left, right, both] = DIAMETERS.map(|(diameter, _, _)| header.column(diameter));
    let [lid_left, lid_right, lid_both] = DIAMETERS.map(|(_, aperture, _)| header.column(aperture));
    let there = [left, right, both].map(|column| column.is_some());
    let columns = [header.column(TIME), left, right, both, lid_left, lid_right, lid_both];
    let picker = Picker::new(header.separator, columns);

    while let Some(line) = lines.next(log) {
        if line.bytes.is_empty() {
            continue;
        }
        let [t, diameters @ .., lid_left, lid_right, lid_both] = picker.pick(line.bytes);
        if let Some(is_same) = header.again(line.bytes, t, is_cloud_header) {
            if log.header_again(line.number, is_same) {
                continue;
            }
            return Ok(());
        }
        if header.leaves_over(line.bytes) {
            log.has_more_cells(line.number);
            continue;
        }
        let Some(t) = t else {
            log.count(LogFault::Malformed);
            continue;
        };
        let Some(t) = time(t, 9) else {
            log.count(LogFault::BadNumber);
            continue;
        };
        let lids = [lid_left, lid_right, lid_both];
        for (index, (_, _, eye)) in DIAMETERS.into_iter().enumerate().filter(|(index, _)| there[*index]) {
            // Nothing, NaN and 0 are its words for an eye that it does not see.
            let size = diameters[index].map_or(Err(LogFault::Malformed), positive_size);
            let aperture_mm = lids[index].and_then(number).map(|aperture| aperture as f32);
            log.push_sized(size, LogSample { aperture_mm, ..LogSample::lost(t, eye) }, line.number);
        }
    }
    read_cloud_blinks(&input.path.with_file_name("blinks.csv"), log);
    Ok(())
}

/// Blinks of a companion file; none where there is none or it cannot be read, since nothing rests on it.
fn read_cloud_blinks(path: &Path, log: &mut LogBuilder) {
    if !path.is_file() {
        return;
    }
    let opened = LogInput::new(path).and_then(|input| input.lines());
    let Ok(mut lines) = opened else {
        return log.warn("blinks.csv beside the log cannot be read");
    };
    // Its faults are its own, not the log's.
    let mut faults = LogBuilder::default();
    let header = lines.next(&mut faults).map(|line| Header::of(line.bytes, separator(line.bytes)));
    let Some(header) = header else { return };
    let columns = ["start timestamp [ns]", "end timestamp [ns]"].map(|name| header.column(name));
    if columns.contains(&None) {
        return log.warn("blinks.csv beside the log lacks the columns of begin and end");
    }
    let picker = Picker::new(header.separator, columns);
    let mut unread = 0;
    while let Some(line) = lines.next(&mut faults) {
        let [begins, ends] = picker.pick(line.bytes).map(|cell| cell.and_then(|cell| time(cell, 9)));
        match begins.zip(ends) {
            Some((begins, ends)) if begins <= ends => log.blink_beside(Blink { eye: SampleEye::Both, begins, ends }),
            _ if line.bytes.is_empty() => {}
            _ => unread += 1,
        }
    }
    if unread > 0 {
        log.warn(format!("{unread} rows of blinks.csv beside the log are no blinks"));
    }
}

/// Floats of a record, with eyelids and before there were any.
const RECORD_FLOATS: [usize; 2] = [20, 14];

/// Where in a record the figures are, as indices of its floats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Layout {
    floats: usize,
    /// Of the left eye and of the right one.
    diameters: [Option<usize>; 2],
    apertures: [Option<usize>; 2],
}

impl Layout {
    const fn usual(floats: usize) -> Self {
        let apertures = if floats == 20 { [Some(16), Some(19)] } else { [None, None] };
        Self { floats, diameters: [Some(0), Some(7)], apertures }
    }

    /// Reads `eye_state.dtype`: a list of pairs of a field's name and its type, in quotation marks.
    fn of_dtype(text: &str) -> Option<Self> {
        let quoted: Vec<_> = text.split(['\'', '"']).skip(1).step_by(2).collect();
        if quoted.is_empty() || quoted.len() % 2 != 0 {
            return None;
        }
        let fields: Vec<_> = quoted.chunks_exact(2).collect();
        if !fields.iter().all(|field| matches!(field[1], "<f4" | "f4" | "float32")) {
            return None;
        }
        let find = |what: &str| fields.iter().position(|field| field[0].replace(' ', "_").starts_with(what));
        let layout = Self {
            floats: fields.len(),
            diameters: ["pupil_diameter_left", "pupil_diameter_right"].map(find),
            apertures: ["eyelid_aperture_left", "eyelid_aperture_right"].map(find),
        };
        (layout.diameters != [None, None]).then_some(layout)
    }
}

/// The records have no mark, but each holds two optical axes of length 1 at known places.
fn recognises_native(input: &LogInput<'_>) -> bool {
    record_floats(&input.head).is_some()
}

fn record_floats(head: &[u8]) -> Option<usize> {
    RECORD_FLOATS.into_iter().find(|floats| {
        let records = head.chunks_exact(4 * floats).take(16);
        let looked_at = records.len();
        let alike = records.filter(|record| looks_like_eye_state(record)).count();
        alike > 0 && 2 * alike > looked_at
    })
}

fn looks_like_eye_state(record: &[u8]) -> bool {
    let axis_length = |first: usize| (first..first + 3).map(|index| float(record, index).powi(2)).sum::<f32>();
    let diameter = |index: usize| (0.0..20.0).contains(&float(record, index));
    let axis = |first: usize| (axis_length(first) - 1.0).abs() < 0.02;
    diameter(0) && axis(4) && diameter(7) && axis(11)
}

fn float(record: &[u8], index: usize) -> f32 {
    record.get(4 * index..4 * index + 4).map_or(f32::NAN, |b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn read_native(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let layout = native_layout(input, log)?;
    let times_path = input.path.with_extension("time");
    let times_name = name_of(&times_path);
    let length = |path: &Path| std::fs::metadata(path).map(|metadata| metadata.len());
    let times_bytes = length(&times_path).map_err(|_| {
        let expected = format!("`{times_name}` of the same recording beside it: it holds the times of the records");
        input.content(format!("no file `{times_name}`"), expected)
    })?;
    let record_bytes = 4 * layout.floats;
    let records = length(input.path).map_err(|source| input.io(source))? / record_bytes as u64;
    if times_bytes != 8 * records {
        let found = format!("{records} records of {record_bytes} bytes and {times_bytes} bytes in `{times_name}`");
        let expected = format!("{} bytes there, 8 for each record; copy both files again", 8 * records);
        return Err(input.content(found, expected));
    }

    let times_input = LogInput::new(&times_path)?;
    let (mut states, mut times) = (input.open()?, times_input.open()?);
    let mut record = vec![0; record_bytes];
    let mut t = [0; 8];
    for number in 1..=records {
        if states.read_exact(&mut record).is_err() || times.read_exact(&mut t).is_err() {
            break;
        }
        let t = TimeNs(i64::from_le_bytes(t));
        for (index, eye) in [SampleEye::Left, SampleEye::Right].into_iter().enumerate() {
            let Some(diameter) = layout.diameters[index].map(|at| float(&record, at)) else { continue };
            let aperture_mm = layout.apertures[index].map(|at| float(&record, at)).filter(|lid| lid.is_finite());
            // NaN and 0 are its words for an eye that it does not see.
            let size = match diameter {
                diameter if diameter.is_infinite() => Err(LogFault::NotFinite),
                diameter if diameter < 0.0 => Err(LogFault::Negative),
                diameter => Ok(f64::from(if diameter > 0.0 { diameter } else { 0.0 })),
            };
            log.push_sized(size, LogSample { aperture_mm, ..LogSample::lost(t, eye) }, number);
        }
    }
    times_input.failed()?;
    let mut cut_off = [0; 1];
    if states.read(&mut cut_off).is_ok_and(|count| count > 0) {
        log.warn("the file ends within a record: it is cut off; copy it again");
        log.count(LogFault::Malformed);
    }
    let parts = other_parts(input.path);
    if !parts.is_empty() {
        log.note(format!("this is one part of its recording; beside it lie {}", parts.join(", ")));
    }
    read_native_blinks(input.path, log);
    Ok(())
}

/// The other parts of a recording that the phone cut: `eye_state ps2.raw` beside `eye_state ps1.raw`.
fn other_parts(path: &Path) -> Vec<String> {
    let own = name_of(path);
    let Some((begin, _)) = own.split_once(" ps") else { return Vec::new() };
    let folder = folder_of(path);
    let is_part = |name: &String| {
        let rest = name.strip_prefix(begin).and_then(|rest| rest.strip_prefix(" ps")?.strip_suffix(".raw"));
        *name != own
            && rest.is_some_and(|number| !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit()))
    };
    let names = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut parts: Vec<_> =
        names.map(|entry| entry.file_name().to_string_lossy().into_owned()).filter(is_part).collect();
    parts.sort();
    parts
}

/// As `eye_state.dtype` says; as usual where there is none.
fn native_layout(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<Layout, ReplayError> {
    let stem = input.path.file_stem().unwrap_or_default().to_string_lossy();
    let path = input.path.with_file_name(format!("{}.dtype", stem.split(" ps").next().unwrap_or_default()));
    let name = name_of(&path);
    let mut text = String::new();
    match std::fs::File::open(&path) {
        Err(_) => {
            log.note(format!("there is no `{name}` beside the log: its fields are taken to be the usual ones"));
            Ok(Layout::usual(record_floats(&input.head).unwrap_or(RECORD_FLOATS[0])))
        }
        Ok(file) => {
            let read = file.take(1 << 16).read_to_string(&mut text).ok();
            read.and_then(|_| Layout::of_dtype(&text)).ok_or_else(|| {
                let expected = "pairs of a name and `float32`, with `pupil_diameter_left_mm` or its right twin among \
                                them; copy the file again, or move it away to read the usual fields";
                input.content(format!("a `{name}` of another form"), expected)
            })
        }
    }
}

/// Bytes of a blink: type, begin, end.
const BLINK_BYTES: usize = 20;

fn read_native_blinks(path: &Path, log: &mut LogBuilder) {
    let own = name_of(path);
    let name = own.replacen("eye_state", "blinks", 1);
    let beside = path.with_file_name(&name);
    // A file that was given another name has none.
    if name == own || !beside.is_file() {
        return;
    }
    let Ok(mut blinks) = LogInput::new(&beside).and_then(|input| input.open()) else {
        return log.warn(format!("`{name}` beside the log cannot be read"));
    };
    let mut record = [0; BLINK_BYTES];
    let mut unread = 0;
    while blinks.read_exact(&mut record).is_ok() {
        let at = |from: usize| TimeNs(i64::from_le_bytes(std::array::from_fn(|index| record[from + index])));
        let (begins, ends) = (at(4), at(12));
        if begins <= ends {
            log.blink_beside(Blink { eye: SampleEye::Both, begins, ends });
        } else {
            unread += 1;
        }
    }
    if unread > 0 {
        log.warn(format!("{unread} records of `{name}` beside the log are no blinks"));
    }
}
