//! Pupil Labs Neon: `3d_eye_states.csv` of its cloud, with the blinks of a `blinks.csv` beside it.

use std::path::Path;

use holod_calibration::TimeNs;

use crate::SampleEye;

use super::{Blink, Importer, LogBuilder, LogFault, LogFormat, LogInput, LogSample, ReplayError};

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::NeonEyeStates, recognises, read };

const TIME: &str = "timestamp [ns]";
const DIAMETERS: [(&str, &str, SampleEye); 2] = [
    ("pupil diameter left [mm]", "eyelid aperture left [mm]", SampleEye::Left),
    ("pupil diameter right [mm]", "eyelid aperture right [mm]", SampleEye::Right),
];

fn recognises(input: &LogInput<'_>) -> bool {
    let Some(Ok(header)) = input.head_lines().next().map(std::str::from_utf8) else { return false };
    let has = |name: &str| header.split(',').any(|cell| cell.trim().trim_matches('"') == name);
    has(TIME) && DIAMETERS.iter().any(|(diameter, _, _)| has(diameter))
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let mut csv = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(input.open()?);
    let Ok(header) = csv.byte_headers().cloned() else { return Ok(()) };
    let column = |name: &str| header.iter().position(|cell| cell == name.as_bytes());
    let Some(time) = column(TIME) else { return Ok(()) };
    let eyes =
        DIAMETERS.map(|(diameter, aperture, eye)| column(diameter).map(|diameter| (diameter, column(aperture), eye)));

    let mut record = csv::ByteRecord::new();
    loop {
        match csv.read_byte_record(&mut record) {
            Ok(false) => break,
            Ok(true) => {}
            Err(_) => {
                log.count(LogFault::Malformed);
                continue;
            }
        }
        let cell = |index: usize| record.get(index).and_then(|cell| std::str::from_utf8(cell).ok());
        let line = record.position().map_or(0, csv::Position::line);
        let Some(t_text) = cell(time) else {
            log.count(LogFault::Malformed);
            continue;
        };
        let Ok(t_ns) = t_text.parse() else {
            log.count(LogFault::BadNumber);
            continue;
        };
        for (diameter, aperture, eye) in eyes.into_iter().flatten() {
            match cell(diameter).ok_or(LogFault::Malformed).and_then(LogBuilder::diameter) {
                Err(fault) => log.count(fault),
                Ok(diameter) => {
                    let aperture_mm = aperture.and_then(cell).and_then(|text| text.parse().ok());
                    let sample =
                        LogSample { t: TimeNs(t_ns), eye, diameter, confidence: 1.0, aperture_mm, valid: true };
                    log.push(sample, line);
                }
            }
        }
    }
    log.blinks = read_blinks(&input.path.with_file_name("blinks.csv"));
    Ok(())
}

/// Blinks of a companion file; none where there is none or it cannot be read, since nothing rests on it.
fn read_blinks(path: &Path) -> Vec<Blink> {
    let Ok(mut csv) = csv::Reader::from_path(path) else { return Vec::new() };
    let Ok(header) = csv.headers().cloned() else { return Vec::new() };
    let column = |name: &str| header.iter().position(|cell| cell.trim() == name);
    let Some((begin, end)) = column("start timestamp [ns]").zip(column("end timestamp [ns]")) else {
        return Vec::new();
    };
    let time = |record: &csv::StringRecord, index: usize| record.get(index)?.trim().parse().ok().map(TimeNs);
    let blink = |record: csv::StringRecord| {
        let (begins, ends) = time(&record, begin).zip(time(&record, end))?;
        Some(Blink { eye: SampleEye::Both, begins, ends })
    };
    csv.records().flatten().filter_map(blink).collect()
}
