//! PupilEXT: the CSV of its data recording, parted by comma, semicolon or tab.
//!
//! Names are `diameter_px`, `physicalDiameter_mm`, `confidence` and so on up to version 0.1.2, with `A` or `B` behind
//! the first word where there are two pupils and `Main` or `Sec` where there are two views (`diameterAMain_px`), and
//! later `pupilDiameter_px_R_M` (eye, camera). `A` is the right eye: later versions put R in its place. Of two views
//! the main one counts; a lone pupil without an eye's letter is [`SampleEye::Both`]. The first versions had their units
//! in brackets (`timestamp[ms]`, `diameter[px]`, `physicaldiameter[mm]`, `outline_confidence`), and one pupil only,
//! with `Sec` behind the second view's. (Open-PupilEXT, `eyeDataSerializer`, `pDataTypes` and `dataWriter`.)

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use super::table::{Row, Table, number, time_ns};
use super::text::size;
use crate::SampleEye;
use crate::cells::{cells, separator};
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::PupilExt, recognises, read };

const TIMES: [&str; 2] = ["timestamp_ms", "timestamp[ms]"];
/// Eyes, and what stands for each in the names of earlier and of later versions; other letters of later ones are no
/// eye's.
const PUPILS: [(SampleEye, &str, Option<&str>); 3] =
    [(SampleEye::Both, "", None), (SampleEye::Right, "A", Some("R")), (SampleEye::Left, "B", Some("L"))];

fn recognises(input: &LogInput<'_>) -> bool {
    input.head_lines().next().is_some_and(is_header)
}

fn is_header(line: &[u8]) -> bool {
    let has = |is: &dyn Fn(&[u8]) -> bool| cells(line, separator(line)).any(is);
    let is_size = |name: &[u8]| {
        let begins =
            [&b"diameter"[..], b"physicalDiameter", b"physicaldiameter", b"pupilDiameter", b"pupilPhysicalDiameter"];
        begins.iter().any(|begin| name.starts_with(begin)) && memchr::memchr2(b'_', b'[', name).is_some()
    };
    has(&|name| TIMES.iter().any(|time| name == time.as_bytes())) && has(&is_size)
}

/// The columns of one pupil.
#[derive(Clone, Copy)]
struct Pupil {
    eye: SampleEye,
    physical: Option<usize>,
    undistorted: Option<usize>,
    image: Option<usize>,
    confidence: Option<usize>,
    outline: Option<usize>,
}

impl Pupil {
    fn find(table: &Table, (eye, early, late): (SampleEye, &str, Option<&str>)) -> Option<Self> {
        let is_late = |letter: &str| late.map_or(!matches!(letter, "R" | "L"), |late| letter == late);
        let column = |word: &str, unit: &str| {
            let first = match (early, unit.strip_prefix('_')) {
                ("", Some(unit)) => format!("{}[{unit}]", word.to_lowercase()),
                // `outlineConfidence` was `outline_confidence`.
                ("", None) => word.replace('C', "_c"),
                _ => String::new(),
            };
            let names = [format!("{word}{early}{unit}"), format!("{word}{early}Main{unit}"), first];
            let (first, rest) = word.split_at(1);
            let begin = format!("pupil{}{rest}{unit}_", first.to_uppercase());
            let letter = |name: &str| name.strip_prefix(&begin)?.strip_suffix("_M").map(is_late);
            table.column(|name| names.iter().any(|wanted| name == wanted) || letter(name) == Some(true))
        };
        let pupil = Self {
            eye,
            physical: column("physicalDiameter", "_mm"),
            undistorted: column("undistortedDiameter", "_px"),
            image: column("diameter", "_px"),
            confidence: column("confidence", ""),
            outline: column("outlineConfidence", ""),
        };
        (pupil.physical.is_some() || pupil.image.is_some()).then_some(pupil)
    }

    fn sizes(&self) -> [Option<usize>; 3] {
        [self.physical, self.undistorted, self.image]
    }
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let Some(size) = choose_size(input)? else { return Ok(()) };
    let Some(mut table) = Table::open(input, log, is_header)? else { return Ok(()) };
    let Some(time) = table.column(|name| TIMES.contains(&name)) else { return Ok(()) };
    let pupils = PUPILS.map(|names| Pupil::find(&table, names));
    if size > 0 {
        log.unit = SizeUnit::Pixels;
        log.note("PupilEXT was not calibrated: there is no diameter in millimetres");
    }
    if table
        .column(|name| {
            name.contains("Sec_") || name.contains("Sec[") || name.starts_with("pupil") && name.ends_with("_S")
        })
        .is_some()
    {
        log.note("two cameras looked at each pupil; pixels and confidence are the main one's");
    }
    table.look_for_headers(time);
    // The user's own text.
    if table.column(|name| name == "message").is_some() {
        table.allow_more_cells();
    }
    while let Some(row) = table.next_row(log) {
        let t = match row.cell(time).and_then(|cell| time_ns(cell, 1e6)) {
            Ok(t) => TimeNs(t),
            Err(fault) => {
                log.count(fault);
                continue;
            }
        };
        for pupil in pupils.iter().flatten() {
            let Some(column) = pupil.sizes()[size] else { continue };
            let lost = LogSample { confidence: confidence(&row, pupil), ..LogSample::lost(t, pupil.eye) };
            log.push_sized(figure(&row, column), lost, row.number);
        }
    }
    Ok(())
}

/// Which of [`Pupil::sizes`] the whole log is read from: the first that holds a figure anywhere.
fn choose_size(input: &LogInput<'_>) -> Result<Option<usize>, ReplayError> {
    let mut ignored = LogBuilder::default();
    let Some(mut table) = Table::open(input, &mut ignored, is_header)? else { return Ok(None) };
    let pupils = PUPILS.map(|names| Pupil::find(&table, names));
    let mut best: Option<usize> = None;
    while let Some(row) = table.next_row(&mut ignored) {
        for pupil in pupils.iter().flatten() {
            let holds = |column: Option<usize>| {
                column.is_some_and(|column| figure(&row, column).is_ok_and(|diameter| diameter > 0.0))
            };
            let here = pupil.sizes().into_iter().position(holds);
            best = [best, here].into_iter().flatten().min();
        }
        if best == Some(0) {
            break;
        }
    }
    // No pupil in the whole log: whatever there is, lost throughout.
    let any = || pupils.iter().flatten().find_map(|pupil| pupil.sizes().iter().position(Option::is_some));
    Ok(best.or_else(any))
}

/// -1, 0 or nothing where no pupil was found.
fn figure(row: &Row<'_>, column: usize) -> Result<f64, LogFault> {
    size(row.cell(column)?)
}

/// The detector's confidence, the outline's where the detector has none (-1), 1 without either.
fn confidence(row: &Row<'_>, pupil: &Pupil) -> f32 {
    [pupil.confidence, pupil.outline]
        .into_iter()
        .flatten()
        .filter_map(|column| number(row.cell(column).ok()?).ok())
        .find(|confidence| (0.0..=1.0).contains(confidence))
        .map_or(1.0, |confidence| confidence as f32)
}
