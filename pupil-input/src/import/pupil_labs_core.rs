//! Pupil Labs Core: `pupil_positions.csv` of its player.
//!
//! Both eyes and two kinds of rows interleave: 2-D detection with a diameter in camera pixels, and the 3-D model with
//! `diameter_3d` in millimetres besides. Where there are 3-D rows the 2-D ones tell nothing more and are left out; the
//! log is read twice, to know of which kind each eye has rows. Eye 0 is the right one.

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use super::text::{Header, Picker, number, share, size, time};
use crate::SampleEye;
use crate::cells::separator;
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Core, recognises, read };

/// Columns by their newest names first.
const TIME: [&str; 2] = ["pupil_timestamp", "timestamp"];
const EYE: [&str; 2] = ["eye_id", "id"];

fn recognises(input: &LogInput<'_>) -> bool {
    input.head_lines().next().is_some_and(is_header)
}

fn is_header(line: &[u8]) -> bool {
    let header = Header::of(line, separator(line));
    header.first_of(&TIME).is_some()
        && header.first_of(&EYE).is_some()
        && ["confidence", "norm_pos_x", "diameter"].iter().all(|name| header.has(name))
}

/// What made a row, in the order of trust.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Method {
    /// Pixels of the camera.
    TwoD,
    /// Millimetres, by the model as it was while recording.
    LiveModel,
    /// Millimetres, by a model that was fitted to the whole recording afterwards.
    PostHocModel,
}

const METHODS: [Method; 3] = [Method::TwoD, Method::LiveModel, Method::PostHocModel];

impl Method {
    const fn in_words(self) -> &'static str {
        match self {
            Self::TwoD => "2-D detection",
            Self::LiveModel => "the 3-D model",
            Self::PostHocModel => "the 3-D model that was fitted after the fact",
        }
    }
}

fn method(name: Option<&[u8]>, diameter_mm: Option<&[u8]>) -> Method {
    let name = name.unwrap_or_default();
    let has = |part: &[u8]| memchr::memmem::find(name, part).is_some();
    // The oldest files do not name the method.
    let modelled = has(b"3d") || name.is_empty() && diameter_mm.is_some_and(|cell| !cell.is_empty());
    match (modelled, has(b"post-hoc")) {
        (false, _) => Method::TwoD,
        (true, false) => Method::LiveModel,
        (true, true) => Method::PostHocModel,
    }
}

/// The cells of a row that matter.
struct Row<'l> {
    line: u64,
    t: &'l [u8],
    eye: SampleEye,
    confidence: &'l [u8],
    method: Method,
    /// The cell of the diameter that the method makes.
    diameter: &'l [u8],
}

/// Hands out every row; lines that are none are counted.
fn each_row(
    input: &LogInput<'_>,
    log: &mut LogBuilder,
    mut take: impl FnMut(&mut LogBuilder, &Row<'_>),
) -> Result<(), ReplayError> {
    let mut lines = input.lines()?;
    let Some(header) = lines.header(log) else { return Ok(()) };
    let columns = [
        header.first_of(&TIME),
        header.first_of(&EYE),
        header.column("confidence"),
        header.column("diameter"),
        header.column("method"),
        header.column("diameter_3d"),
    ];
    let picker = Picker::new(header.separator, columns);
    let mut of_neither: Option<(u64, String)> = None;
    while let Some(line) = lines.next(log) {
        if line.bytes.is_empty() {
            continue;
        }
        let cells = picker.pick(line.bytes);
        let [t, eye, confidence, diameter_px, name, diameter_mm] = cells;
        if let Some(is_same) = header.again(line.bytes, t, is_header) {
            if log.header_again(line.number, is_same) {
                continue;
            }
            break;
        }
        if header.leaves_over(line.bytes) {
            log.has_more_cells(line.number);
            continue;
        }
        // Whatever it is, a row that ends before its columns do is none.
        let is_cut_off = columns.iter().zip(cells).any(|(column, cell)| column.is_some() && cell.is_none());
        let (Some(t), Some(eye), Some(confidence), Some(diameter_px), false) =
            (t, eye, confidence, diameter_px, is_cut_off)
        else {
            log.count(LogFault::Malformed);
            continue;
        };
        let Some(eye) = eye_of(eye) else {
            log.count(LogFault::BadEye);
            of_neither.get_or_insert_with(|| (line.number, String::from_utf8_lossy(eye).escape_debug().to_string()));
            continue;
        };
        let method = method(name, diameter_mm);
        let diameter = if method == Method::TwoD { diameter_px } else { diameter_mm.unwrap_or_default() };
        take(log, &Row { line: line.number, t, eye, confidence, method, diameter });
    }
    if let Some((line, found)) = of_neither {
        log.warn(format!(
            "{} rows are of neither eye: `eye_id` is `{found}` in line {line}, the first of them; expected 0 for the right \
             eye or 1 for the left one; export the log again",
            log.faults.of(LogFault::BadEye)
        ));
    }
    Ok(())
}

/// pandas makes 0.0 of 0 where a cell of the column was empty.
fn eye_of(cell: &[u8]) -> Option<SampleEye> {
    match number(cell)? {
        0.0 => Some(SampleEye::Right),
        1.0 => Some(SampleEye::Left),
        _ => None,
    }
}

/// How many rows there are, and from when to when.
#[derive(Clone, Copy, Debug, Default)]
struct Extent {
    rows: u64,
    within: Option<(TimeNs, TimeNs)>,
}

impl Extent {
    fn take(&mut self, t: TimeNs) {
        self.rows += 1;
        self.within = Some(self.within.map_or((t, t), |(first, last)| (first.min(t), last.max(t))));
    }

    fn and(self, other: Self) -> Self {
        let ends = self.within.into_iter().chain(other.within);
        let within = ends.reduce(|one, other| (one.0.min(other.0), one.1.max(other.1)));
        Self { rows: self.rows + other.rows, within }
    }

    fn length_s(self) -> f64 {
        self.within.map_or(0.0, |(first, last)| last.seconds() - first.seconds())
    }
}

/// A choice of rows that leaves out more than this of an eye's time is told.
const GREATEST_LOSS: f64 = 0.1;

/// What there is of each eye by each method.
#[derive(Debug, Default)]
struct Survey([[Extent; 3]; 3]);

impl Survey {
    fn of(input: &LogInput<'_>) -> Result<Self, ReplayError> {
        let mut survey = Self::default();
        each_row(input, &mut LogBuilder::default(), |_, row| {
            if let Some(t) = time(row.t, 0) {
                survey.0[row.eye.index()][row.method as usize].take(t);
            }
        })?;
        Ok(survey)
    }

    fn rows(&self, method: Method) -> u64 {
        self.0.iter().map(|eye| eye[method as usize].rows).sum()
    }

    fn is_in_millimetres(&self) -> bool {
        self.rows(Method::LiveModel) + self.rows(Method::PostHocModel) > 0
    }

    /// The best method that an eye has; where one eye has millimetres, pixels are none.
    fn chosen(&self, eye: SampleEye) -> Option<Method> {
        let of_eye = &self.0[eye.index()];
        let best = METHODS.into_iter().rev().find(|method| of_eye[*method as usize].rows > 0)?;
        (best != Method::TwoD || !self.is_in_millimetres()).then_some(best)
    }

    fn tell(&self, log: &mut LogBuilder) {
        let [two_d, live, post_hoc] = METHODS.map(|method| self.rows(method));
        let chosen = [SampleEye::Left, SampleEye::Right].map(|eye| self.chosen(eye));
        let has = |method: Method| chosen.contains(&Some(method));
        match (has(Method::PostHocModel), has(Method::LiveModel)) {
            (true, true) => log.note(
                "diameters of the one eye are those of the 3-D model that was fitted after the fact, and those of the other \
                 eye, which has no such rows, of the live model",
            ),
            (true, false) if two_d + live > 0 => log.note(format!(
                "diameters are those of the 3-D model that was fitted after the fact, {post_hoc} rows; {live} rows of the \
                 live model and {two_d} of 2-D detection are left out"
            )),
            (false, true) if two_d > 0 => log.note(format!(
                "diameters are those of the 3-D model, {live} rows; {two_d} rows of 2-D detection are left out"
            )),
            (false, false) => log.note(
                "there are only rows of 2-D detection: diameters are in pixels of the eye cameras; to have millimetres, \
                 run the 3-D detector after the fact in Pupil Player, or give the rig a scale",
            ),
            _ => {}
        }
        for eye in [SampleEye::Left, SampleEye::Right] {
            let of_eye = self.0[eye.index()];
            let all = of_eye.into_iter().fold(Extent::default(), Extent::and);
            let all_s = all.length_s();
            match self.chosen(eye) {
                None if all.rows > 0 => log.warn(format!(
                    "the {eye} eye is left out: its {} rows are of 2-D detection, in pixels, and the other eye's are in \
                     millimetres; run the 3-D detector of both eyes in Pupil Player and export again",
                    all.rows
                )),
                Some(method) if of_eye[method as usize].length_s() < (1.0 - GREATEST_LOSS) * all_s => log.warn(format!(
                    "of the {eye} eye's {all_s:.1} s only {:.1} s were read, in which it has rows of {}; run the 3-D \
                     detector over the whole recording in Pupil Player and export again",
                    of_eye[method as usize].length_s(),
                    method.in_words()
                )),
                _ => {}
            }
        }
    }
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let survey = Survey::of(input)?;
    if !survey.is_in_millimetres() {
        log.unit = SizeUnit::Pixels;
    }
    let chosen = SampleEye::ALL.map(|eye| survey.chosen(eye));
    each_row(input, log, |log, row| {
        if chosen[row.eye.index()] == Some(row.method)
            && let Err(fault) = take(row, log)
        {
            log.count(fault);
        }
    })?;
    survey.tell(log);
    Ok(())
}

/// A model that was not fitted says 0, a negative diameter, NaN or nothing, and confidence 0 says that there is no pupil:
/// such samples are lost. A model fitted badly says 16 mm; that is handed on for the gate to judge.
fn take(row: &Row<'_>, log: &mut LogBuilder) -> Result<(), LogFault> {
    let t = time(row.t, 0).ok_or(LogFault::BadNumber)?;
    let confidence = number(row.confidence).filter(|confidence| confidence.is_finite()).ok_or(LogFault::BadNumber)?;
    let lost = LogSample::lost(t, row.eye);
    match share(confidence) {
        Ok(confidence) => {
            let size = size(row.diameter).map(|size| if confidence > 0.0 { size } else { 0.0 });
            log.push_sized(size, LogSample { confidence, ..lost }, row.line);
        }
        Err(fault) => log.push_sized(Err(fault), lost, row.line),
    }
    Ok(())
}
