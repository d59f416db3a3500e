//! holod's own CSV, as [`write_csv`](crate::export::write_csv) writes it.

use holod_calibration::TimeNs;

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use super::table::{Row, Table, number, time_ns};
use crate::SampleEye;
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Csv, recognises, read };

/// The names of the columns; that of the diameter tells its unit.
pub(crate) const fn header(unit: SizeUnit) -> &'static str {
    match unit {
        SizeUnit::Millimetres => "t_ns,eye,diameter_mm,confidence,aperture_mm,valid",
        SizeUnit::Pixels => "t_ns,eye,diameter_px,confidence,aperture_mm,valid",
        SizeUnit::Arbitrary => "t_ns,eye,diameter_arbitrary,confidence,aperture_mm,valid",
    }
}

fn unit(line: &[u8]) -> Option<SizeUnit> {
    [SizeUnit::Millimetres, SizeUnit::Pixels, SizeUnit::Arbitrary]
        .into_iter()
        .find(|unit| line.trim_ascii() == header(*unit).as_bytes())
}

fn recognises(input: &LogInput<'_>) -> bool {
    input.head_lines().next().is_some_and(|line| unit(line).is_some())
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let Some(mut table) = Table::open(input, log, |line| unit(line).is_some())? else { return Ok(()) };
    table.look_for_headers(0);
    log.unit = unit(table.names.join(",").as_bytes()).unwrap_or_default();
    while let Some(row) = table.next_row(log) {
        match sample(&row) {
            Ok(sample) => log.push(sample, row.number),
            Err(fault) => log.count(fault),
        }
    }
    Ok(())
}

fn sample(row: &Row<'_>) -> Result<LogSample, LogFault> {
    let t = TimeNs(time_ns(row.cell(0)?, 1.0)?);
    let eye = SampleEye::named(row.cell(1)?).ok_or(LogFault::Malformed)?;
    let valid = match row.cell(5)? {
        b"1" => true,
        b"0" => false,
        _ => return Err(LogFault::Malformed),
    };
    let figure = |column| -> Result<Option<f32>, LogFault> {
        let cell = row.cell(column)?;
        if cell.is_empty() { Ok(None) } else { number(cell).map(|number| Some(number as f32)) }
    };
    let diameter = figure(2)?;
    if valid && diameter.is_some_and(|diameter| diameter < 0.0) {
        return Err(LogFault::Negative);
    }
    let diameter = if valid { diameter.ok_or(LogFault::Missing)? } else { diameter.unwrap_or(0.0) };
    let confidence = figure(3)?.unwrap_or(1.0);
    if !(0.0..=1.0).contains(&confidence) {
        return Err(LogFault::BadNumber);
    }
    Ok(LogSample { t, eye, diameter, confidence, aperture_mm: figure(4)?, valid })
}
