//! BIDS eye tracking: `<matches>_recording-<label>_physio.tsv[.gz]`, a table without names whose columns are told by
//! the JSON sidecar of the same stem, with blinks in `<matches>_recording-<label>_physioevents.tsv[.gz]`
//! (<https://bids-specification.readthedocs.io>, physiological recordings).
//!
//! Each eye has a file of its own. Whichever is named, the files of the other eyes beside it are read too; a file of
//! both eyes together (`cyclopean`) only where it is the one that is named.

use std::path::{Path, PathBuf};

use holod_calibration::TimeNs;
use serde_json::{Map, Value};

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample, usual_step};
use super::rows::Blink;
use super::size::{ARBITRARY, Measure, Said, Unit};
use super::table::{Row, is_missing, ns_of, ns_per_unit, number, time_ns};
use crate::SampleEye;
use crate::cells::{cells, has_more};
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Bids, recognises, read };

/// What the names of recordings and of their events end in.
const SAMPLES: &str = "physio";
const EVENTS: &str = "physioevents";
/// Bytes of the largest sidecar that is read.
const SIDECAR_BYTES: u64 = 1 << 22;
/// Folders in which a sidecar is looked for: session, subject, dataset and the like.
const FOLDERS_UP: usize = 5;
/// What columns of times are called: `timestamp` by the standard, and what is in use besides.
const TIMES: [&str; 3] = ["timestamp", "timestamps", "time"];
/// Rows that tell how much a unit of the time column is.
const UNIT_ROWS: usize = 1000;

fn recognises(input: &LogInput<'_>) -> bool {
    let Some(line) = input.head_lines().next() else { return false };
    let is_table = cells(line, b'\t').all(|cell| is_missing(cell) || number(cell).is_ok());
    let Some(stem) = Stem::of(input.path, SAMPLES) else {
        // A table of figures under another name, with a sidecar that names its columns.
        let sidecar = || Sidecar::load(&plain_stem(input.path).with_extension("json"));
        return is_table && sidecar().is_ok_and(|sidecar| sidecar.is_some_and(|sidecar| !sidecar.columns().is_empty()));
    };
    is_table
        || stem
            .sidecar()
            .is_ok_and(|sidecar| sidecar.columns().iter().map(|name| name.as_bytes()).eq(cells(line, b'\t')))
}

/// The path without `.tsv` and `.gz`.
fn plain_stem(path: &Path) -> PathBuf {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let name = name.strip_suffix(".gz").unwrap_or(name);
    path.with_file_name(name.strip_suffix(".tsv").unwrap_or(name))
}

/// The parts of a BIDS name: `sub-01_task-x_recording-eye1` and `physio`.
#[derive(Clone)]
struct Stem {
    folder: PathBuf,
    entities: Vec<String>,
    suffix: &'static str,
}

impl Stem {
    fn of(path: &Path, suffix: &'static str) -> Option<Self> {
        let stem = plain_stem(path);
        let entities = stem.file_name()?.to_str()?.strip_suffix(suffix)?.strip_suffix('_')?;
        let entities = entities.split('_').map(str::to_owned).collect();
        Some(Self { folder: path.parent()?.to_owned(), entities, suffix })
    }

    fn file(&self, ending: &str) -> PathBuf {
        self.folder.join(format!("{}_{}.{ending}", self.entities.join("_"), self.suffix))
    }

    /// The table itself, packed or not.
    fn table(&self) -> Option<PathBuf> {
        ["tsv.gz", "tsv"].into_iter().map(|ending| self.file(ending)).find(|path| path.is_file())
    }

    /// The sidecars that apply, merged: those nearer to the file, then those with more of its entities, win
    /// (BIDS' principle of inheritance).
    fn sidecar(&self) -> Result<Sidecar, ReplayError> {
        let mut merged: Option<Sidecar> = None;
        for folder in self.folder.ancestors().take(FOLDERS_UP) {
            let mut here: Vec<(usize, PathBuf)> = Vec::new();
            let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
            for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
                let name = entry.file_name();
                let Some(stem) = name.to_str().and_then(|name| name.strip_suffix(".json")) else { continue };
                let Some(entities) = stem.strip_suffix(self.suffix) else { continue };
                let mut entities = entities.split('_').filter(|entity| !entity.is_empty());
                if entities.clone().all(|entity| self.entities.iter().any(|own| own == entity)) {
                    here.push((entities.by_ref().count(), entry.path()));
                }
            }
            here.sort();
            for (_, path) in here.iter().rev() {
                let Some(sidecar) = Sidecar::load(path)? else { continue };
                match &mut merged {
                    None => merged = Some(sidecar),
                    Some(merged) => merged.inherit(sidecar),
                }
            }
            if folder.join("dataset_description.json").is_file() {
                break;
            }
        }
        merged.ok_or_else(|| ReplayError::Content {
            path: self.table().unwrap_or_else(|| self.file("tsv.gz")),
            at: String::new(),
            found: "no sidecar beside it or in the folders above it".into(),
            expected: format!(
                "{}, which names the columns (`Columns`); copy it from the dataset",
                self.file("json").display()
            ),
        })
    }

    /// The same recording of other labels, such as the other eye's.
    fn siblings(&self) -> Vec<Self> {
        let Some(at) = self.entities.iter().position(|entity| entity.starts_with("recording-")) else {
            return Vec::new();
        };
        let ending = |name: &str| name.ends_with(".tsv") || name.ends_with(".tsv.gz");
        let folder = if self.folder.as_os_str().is_empty() { Path::new(".") } else { &self.folder };
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        let stems = entries.filter_map(|entry| {
            let name = entry.file_name();
            let stem = Self::of(&self.folder.join(name.to_str().filter(|name| ending(name))?), self.suffix)?;
            let same = stem.entities.len() == self.entities.len()
                && stem.entities.iter().zip(&self.entities).enumerate().all(|(index, (other, own))| {
                    if index == at { other != own && other.starts_with("recording-") } else { other == own }
                });
            same.then_some(stem)
        });
        let mut stems: Vec<_> = stems.collect();
        stems.sort_by(|one, other| one.entities.cmp(&other.entities));
        stems.dedup_by(|one, other| one.entities == other.entities);
        stems
    }
}

/// What a JSON sidecar says.
#[derive(Clone)]
struct Sidecar {
    path: PathBuf,
    fields: Map<String, Value>,
}

impl Sidecar {
    /// None where there is no such file.
    fn load(path: &Path) -> Result<Option<Self>, ReplayError> {
        use std::io::Read;
        let file = match std::fs::File::open(path) {
            Ok(file) => file,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(ReplayError::Io { path: path.into(), source }),
        };
        let mut text = Vec::new();
        file.take(SIDECAR_BYTES)
            .read_to_end(&mut text)
            .map_err(|source| ReplayError::Io { path: path.into(), source })?;
        let text = text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&text);
        let wrong = |at: String, found: String| ReplayError::Content {
            path: path.into(),
            at,
            found,
            expected: "a JSON object with `Columns` and `SamplingFrequency`".into(),
        };
        match serde_json::from_slice(text) {
            Ok(Value::Object(fields)) => Ok(Some(Self { path: path.into(), fields })),
            Ok(_) => Err(wrong(String::new(), "JSON that is no object".into())),
            Err(error) => Err(wrong(format!(", line {}", error.line()), error.to_string())),
        }
    }

    fn inherit(&mut self, other: Self) {
        for (key, value) in other.fields {
            self.fields.entry(key).or_insert(value);
        }
    }

    fn columns(&self) -> Vec<&str> {
        let columns = self.fields.get("Columns").and_then(Value::as_array);
        columns.into_iter().flatten().map(|name| name.as_str().unwrap_or_default()).collect()
    }

    fn text(&self, key: &str) -> Option<&str> {
        self.fields.get(key).and_then(Value::as_str)
    }

    fn number(&self, key: &str) -> Option<f64> {
        let number = self.fields.get(key)?.as_f64()?;
        number.is_finite().then_some(number)
    }

    /// A text that the sidecar says of a column, such as its `Units`.
    fn of_column(&self, column: &str, key: &str) -> Option<&str> {
        self.fields.get(column)?.get(key)?.as_str()
    }

    fn rate_hz(&self) -> Option<f64> {
        self.number("SamplingFrequency").filter(|rate| (1e-3..=1e6).contains(rate))
    }

    /// The eye that it says, as the standard or as people write it.
    fn stated_eye(&self) -> Option<SampleEye> {
        let letters: String = self.text("RecordedEye")?.chars().filter(|letter| letter.is_alphanumeric()).collect();
        let name = letters.to_lowercase();
        let name = name.strip_suffix("eyes").or_else(|| name.strip_suffix("eye")).unwrap_or(&name);
        Some(match name {
            "left" | "l" => SampleEye::Left,
            "right" | "r" => SampleEye::Right,
            "cyclopean" | "both" | "binocular" => SampleEye::Both,
            _ => return None,
        })
    }

    fn eye(&self) -> SampleEye {
        self.stated_eye().unwrap_or(SampleEye::Both)
    }
}

/// How the figures of a pupil column become diameters.
#[derive(Clone, Copy)]
struct Size {
    unit: Unit,
    measure: Measure,
    /// Why it may be another, where the sidecar does not say clearly which it is.
    doubt: Option<&'static str>,
}

impl Size {
    fn of(sidecar: &Sidecar, column: &str) -> Self {
        let says = |key| sidecar.of_column(column, key).unwrap_or_default().to_lowercase();
        let unit = Unit::named(&says("Units")).unwrap_or(ARBITRARY);
        let [description, name] = ["Description", "LongName"].map(says);
        let (measure, doubt) = unit.measure(Said::by(&[&column.to_lowercase()]), Said::by(&[&description, &name]));
        Self { unit, measure, doubt }
    }

    fn diameter(self, figure: f64) -> f64 {
        self.unit.factor * self.measure.diameter(figure)
    }
}

/// Whether a tick is one of a clock that counts tens, hundreds or the like of a unit of time.
fn is_power_of_ten(ns: f64) -> bool {
    let power = ns.log10();
    (power - power.round()).abs() < POWER_WITHIN
}

/// How near to a power of ten a tick has to be, by the sampling frequency: 2 %.
const POWER_WITHIN: f64 = 0.0086;

/// One file with what its sidecar says.
struct Part {
    path: PathBuf,
    sidecar: Sidecar,
    time: Option<usize>,
    /// Column, eye and conversion of each pupil.
    pupils: Vec<(usize, SampleEye, Size)>,
}

impl Part {
    fn new(path: PathBuf, sidecar: Sidecar) -> Result<Self, ReplayError> {
        let columns = sidecar.columns();
        let named = |wanted: &str| columns.iter().position(|name| name.eq_ignore_ascii_case(wanted));
        let time = TIMES.into_iter().find_map(named);
        let has = |name: &str, words: &[&str]| words.iter().any(|word| name.contains(word));
        let pupils: Vec<_> = columns
            .iter()
            .enumerate()
            .filter_map(|(index, column)| {
                let name = column.to_lowercase();
                // `pupil_size` by the standard, `pupil_left`, `left_pupil_diameter` and the like in the field.
                let rest = ["pupil", "left", "right", "_", "-", " "]
                    .iter()
                    .fold(name.clone(), |rest, word| rest.replace(word, ""));
                let is_size = has(&rest, &["size", "diam", "area", "radius"]);
                let is_pupil = has(&name, &["pupil"]) && (is_size || rest.is_empty());
                let eye = match name.as_str() {
                    name if has(name, &["left"]) => SampleEye::Left,
                    name if has(name, &["right"]) => SampleEye::Right,
                    _ => sidecar.eye(),
                };
                is_pupil.then(|| (index, eye, Size::of(&sidecar, column)))
            })
            .collect();
        let wrong = |found: &str, expected: &str| ReplayError::Content {
            path: sidecar.path.clone(),
            at: String::new(),
            found: found.into(),
            expected: expected.into(),
        };
        if columns.is_empty() {
            return Err(wrong("no `Columns`", "a list of the table's columns under `Columns`"));
        }
        if pupils.is_empty() {
            let found = format!("the columns {}", columns.join(", "));
            return Err(wrong(&found, "a column `pupil_size` among `Columns`; this recording has no pupils"));
        }
        if time.is_none() && sidecar.rate_hz().is_none() {
            return Err(wrong("neither a `timestamp` column nor `SamplingFrequency`", "one of both"));
        }
        Ok(Self { path, sidecar, time, pupils })
    }

    fn load(stem: &Stem, path: PathBuf) -> Result<Self, ReplayError> {
        Self::new(path, stem.sidecar()?)
    }

    fn eyes(&self) -> impl Iterator<Item = SampleEye> {
        self.pupils.iter().map(|pupil| pupil.1)
    }

    fn input(&self) -> LogInput<'_> {
        LogInput::at(&self.path)
    }

    /// Nanoseconds of one unit of the time column. Where the sidecar gives no unit, or one that is none of time, the
    /// usual step from row to row is one over the sampling frequency.
    fn ns_per_tick(&self, time: usize, log: &mut LogBuilder) -> Result<f64, ReplayError> {
        let name = self.sidecar.columns()[time].to_owned();
        let stated = self.sidecar.of_column(&name, "Units");
        if let Some(ns) = stated.and_then(ns_per_unit) {
            return Ok(ns);
        }
        let input = self.input();
        let mut lines = input.lines()?;
        let mut times = Vec::with_capacity(UNIT_ROWS);
        while times.len() < UNIT_ROWS
            && let Some(line) = lines.next(&mut LogBuilder::default())
        {
            times.extend(cells(line.bytes, b'\t').nth(time).and_then(|cell| number(cell).ok()));
        }
        let step = usual_step(&times).zip(self.sidecar.rate_hz());
        let Some((ticks, rate_hz)) = step else {
            return Err(ReplayError::Content {
                path: self.sidecar.path.clone(),
                at: String::new(),
                found: format!(
                    "no unit of time for `{name}`, and not both two times and a `SamplingFrequency` to find it by"
                ),
                expected: format!("`{name}`: {{\"Units\": \"ms\"}} or another of s, ms, us, ns"),
            });
        };
        let ns = 1e9 / (rate_hz * ticks);
        // A unit of time where it is near one, any rate of ticks otherwise.
        let near = [1e9, 1e6, 1e3, 1.0].into_iter().find(|unit| (0.8..1.25).contains(&(ns / unit)));
        let is_doubtful = stated.is_none() && near.is_none() && !is_power_of_ten(ns);
        let ns = near.unwrap_or(ns);
        let path = self.path.display();
        if is_doubtful {
            // Rounded, as people would write them.
            let (ticks, ns) = (ticks as f32, ns as f32);
            log.warn(format!(
                "{path}: its times have no unit, and by the `SamplingFrequency` of {rate_hz} Hz one is {ns} ns, which is none: \
                 is that frequency right? The usual step of `{name}` is {ticks}; give it its \"Units\", such as \"s\" or \
                 \"ms\""
            ));
        } else {
            let stated = stated.map_or("no unit".into(), |unit| format!("the unit `{}`", unit.escape_debug()));
            log.note(format!(
                "{path}: its times have {stated}; by the sampling frequency of {rate_hz} Hz one is {ns} ns"
            ));
        }
        Ok(ns)
    }

    /// Warns of a sidecar that does not say of which eye a pupil is, and of a column that may hold the times.
    fn tell_doubts(&self, log: &mut LogBuilder) {
        let path = self.sidecar.path.display();
        if self.sidecar.stated_eye().is_none() && self.eyes().any(|eye| eye == SampleEye::Both) {
            let found = self.sidecar.fields.get("RecordedEye");
            let found = found.map_or("no `RecordedEye`".into(), |eye| format!("the `RecordedEye` {eye}"));
            log.warn(format!(
                "{path}: {found}; its pupil is taken for that of both eyes; expected \"left\", \"right\" or \"cyclopean\""
            ));
        }
        let may_be_time = |column: &&str| {
            self.sidecar.of_column(column, "Units").and_then(ns_per_unit).is_some()
                || column.to_lowercase().contains("time")
        };
        if self.time.is_none()
            && let Some(column) = self.sidecar.columns().into_iter().find(may_be_time)
        {
            log.warn(format!(
                "{path}: no column is called `timestamp`, so that rows are taken for one over the `SamplingFrequency` apart, \
                 without pauses; is `{column}` their time? Then call it `timestamp` in `Columns`",
                column = column.escape_debug()
            ));
        }
    }

    fn read(&self, unit: SizeUnit, log: &mut LogBuilder) -> Result<(), ReplayError> {
        self.tell_doubts(log);
        let rate_hz = self.sidecar.rate_hz();
        let ns_per_tick = self.time.map(|time| self.ns_per_tick(time, log)).transpose()?;
        let start_s = self.sidecar.number("StartTime").unwrap_or(0.0);
        let at_row = |row: f64| ns_of(start_s + row / rate_hz.unwrap_or(1.0), 1e9);
        for (column, eye, size) in &self.pupils {
            if size.unit.unit != unit {
                log.warn(format!(
                    "{}: the {eye} eye is left out: `{}` is in {}, and the first eye's pupil in {}; give one unit for both",
                    self.sidecar.path.display(),
                    self.sidecar.columns()[*column].escape_debug(),
                    size.unit.unit.name(),
                    unit.name()
                ));
                continue;
            }
            if size.measure != Measure::Diameter {
                let what = size.measure.plural();
                log.note(format!("{}: the {eye} eye's pupil {what} were made diameters", self.path.display()));
            }
            if let Some(doubt) = size.doubt {
                log.warn(format!(
                    "{}: `{column}` is taken for {}, though {doubt}; give it \"Units\": \"mm\" for diameters or \"mm^2\" \
                     for areas, or a \"Description\" that says diameter or area where its unit is arbitrary",
                    self.sidecar.path.display(),
                    size.measure.plural(),
                    column = self.sidecar.columns()[*column].escape_debug(),
                ));
            }
        }

        let input = self.input();
        let mut lines = input.lines()?;
        let width = 1 + self.pupils.iter().map(|pupil| pupil.0).chain(self.time).max().unwrap_or(0);
        let names = self.sidecar.columns().len();
        let mut bounds = Vec::with_capacity(width);
        let mut rows = 0_u64;
        while let Some(line) = lines.next(log) {
            if line.bytes.trim_ascii().is_empty() {
                continue;
            }
            if rows == 0 && self.is_header(line.bytes) {
                log.note(format!("{}: a line of names was skipped; BIDS has none", self.path.display()));
                continue;
            }
            if has_more(line.bytes, b'\t', names) {
                log.has_more_cells(line.number);
                rows += 1;
                continue;
            }
            let row = Row::cut(line.bytes, line.number, b'\t', width, &mut bounds);
            let t = match (self.time, ns_per_tick) {
                (Some(time), Some(ns)) => row.cell(time).and_then(|cell| match is_missing(cell) {
                    true => Err(LogFault::Missing),
                    false => time_ns(cell, ns),
                }),
                _ => at_row(rows as f64),
            };
            rows += 1;
            let t = match t {
                Ok(t) => TimeNs(t),
                Err(fault) => {
                    log.count(fault);
                    continue;
                }
            };
            for &(column, eye, size) in &self.pupils {
                if size.unit.unit != unit {
                    continue;
                }
                let figure = row.cell(column).and_then(|cell| if is_missing(cell) { Ok(0.0) } else { number(cell) });
                let diameter = figure.map(|figure| size.diameter(figure.max(0.0)));
                log.push_sized(diameter, LogSample::lost(t, eye), row.number);
            }
        }
        self.read_blinks(ns_per_tick, log);
        input.failed()
    }

    fn is_header(&self, line: &[u8]) -> bool {
        self.sidecar.columns().iter().map(|name| name.as_bytes()).eq(cells(line, b'\t'))
    }

    /// Blinks of the events beside it; none where they cannot be read, since nothing rests on them.
    fn read_blinks(&self, ns_per_tick: Option<f64>, log: &mut LogBuilder) {
        let Some(mut events) = Stem::of(&self.path, SAMPLES) else { return };
        events.suffix = EVENTS;
        let Some(path) = events.table() else { return };
        let blinks = events.sidecar().and_then(|sidecar| self.blinks(&path, &sidecar, ns_per_tick));
        match blinks {
            Ok(blinks) => blinks.into_iter().for_each(|blink| log.blink_beside(blink)),
            Err(error) => log.warn(format!("its blinks could not be read: {error}")),
        }
    }

    /// Events that are called blinks; if there are none, those during which the eye was closed (`blink` = 1), such as
    /// the saccades that EyeLink puts around each blink.
    fn blinks(&self, path: &Path, sidecar: &Sidecar, ns_per_tick: Option<f64>) -> Result<Vec<Blink>, ReplayError> {
        let columns = sidecar.columns();
        let column = |wanted: &str| columns.iter().position(|name| name.eq_ignore_ascii_case(wanted));
        let Some(onset) = column("onset") else { return Ok(Vec::new()) };
        let (duration, kind, closed) = (column("duration"), column("trial_type"), column("blink"));
        let stated = |column: &str| sidecar.of_column(column, "Units").and_then(ns_per_unit);
        // Onsets are times of the recording's clock, or rows of it where the source is said to be none.
        let by_row = sidecar.text("OnsetSource") == Some("n/a") || ns_per_tick.is_none();
        let (onset_ns, origin_ns) = match (stated("onset"), by_row, self.sidecar.rate_hz()) {
            (Some(ns), _, _) => (ns, 0),
            (None, true, Some(rate_hz)) => {
                (1e9 / rate_hz, ns_of(self.sidecar.number("StartTime").unwrap_or(0.0), 1e9).unwrap_or(0))
            }
            _ => (ns_per_tick.unwrap_or(1e9), 0),
        };
        // BIDS' durations are seconds; with onsets of the tracker's clock they are given on that clock too.
        let duration_ns = stated("duration").unwrap_or(if by_row { 1e9 } else { onset_ns });

        let input = LogInput::at(path);
        let mut lines = input.lines()?;
        let (mut called, mut shut) = (Vec::new(), Vec::new());
        while let Some(line) = lines.next(&mut LogBuilder::default()) {
            let cell = |column: Option<usize>| column.and_then(|column| cells(line.bytes, b'\t').nth(column));
            let is_called =
                cell(kind).is_some_and(|kind| kind.to_ascii_lowercase().windows(5).any(|word| word == b"blink"));
            let is_shut = cell(closed).is_some_and(|closed| number(closed).is_ok_and(|closed| closed == 1.0));
            if !is_called && !is_shut {
                continue;
            }
            let begins = cell(Some(onset)).and_then(|onset| time_ns(onset, onset_ns).ok());
            let lasts = cell(duration).and_then(|lasts| time_ns(lasts, duration_ns).ok()).filter(|lasts| *lasts >= 0);
            let Some((begins, lasts)) = begins.zip(lasts) else { continue };
            let begins = origin_ns.saturating_add(begins);
            let ends = TimeNs(begins.saturating_add(lasts));
            let blink = Blink { eye: self.sidecar.eye(), begins: TimeNs(begins), ends };
            if is_called { called.push(blink) } else { shut.push(blink) }
        }
        input.failed()?;
        Ok(if called.is_empty() { shut } else { called })
    }
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let Some(stem) = Stem::of(input.path, SAMPLES) else {
        let Some(sidecar) = Sidecar::load(&plain_stem(input.path).with_extension("json"))? else { return Ok(()) };
        return read_parts(&[Part::new(input.path.into(), sidecar)?], log);
    };
    let mut parts = vec![Part::load(&stem, input.path.into())?];
    for sibling in stem.siblings() {
        let Some(path) = sibling.table() else { continue };
        match Part::load(&sibling, path.clone()) {
            Err(error) => log.warn(format!("{} was left out: {error}", path.display())),
            Ok(part) => {
                // A pupil of an eye that is there already, or of both eyes, adds nothing.
                let known: Vec<_> = parts.iter().flat_map(Part::eyes).collect();
                let is_news = |eye| eye != SampleEye::Both && !known.contains(&eye);
                if part.eyes().all(is_news) && !known.contains(&SampleEye::Both) {
                    log.note(format!("{} was read too", path.display()));
                    parts.push(part);
                } else if part.eyes().any(|eye| eye != SampleEye::Both && known.contains(&eye)) {
                    let eyes: Vec<_> = part.eyes().map(SampleEye::name).collect();
                    log.warn(format!(
                        "{} was left out: by its sidecar it is of an eye that was read already ({}); is its `RecordedEye` \
                         right?",
                        path.display(),
                        eyes.join(", ")
                    ));
                } else {
                    let mut both =
                        parts.iter().chain([&part]).filter(|part| part.eyes().any(|eye| eye == SampleEye::Both));
                    let is_meant = both.all(|part| part.sidecar.stated_eye().is_some());
                    let told = format!(
                        "{} was left out: a pupil of both eyes adds nothing to one eye's, nor the other way round",
                        path.display()
                    );
                    if is_meant {
                        log.note(told);
                    } else {
                        log.warn(format!("{told}; give each file's sidecar its `RecordedEye`"));
                    }
                }
            }
        }
    }
    read_parts(&parts, log)
}

fn read_parts(parts: &[Part], log: &mut LogBuilder) -> Result<(), ReplayError> {
    let Some(first) = parts.first() else { return Ok(()) };
    log.unit = first.pupils[0].2.unit.unit;
    log.stated_rate_hz = first.sidecar.rate_hz();
    if let Some(kind) = first.sidecar.text("PhysioType").filter(|kind| *kind != "eyetrack") {
        log.warn(format!("the sidecar's PhysioType is `{}`, not `eyetrack`", kind.escape_debug()));
    }
    for part in parts {
        part.read(log.unit, log)?;
    }
    Ok(())
}
