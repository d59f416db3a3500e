//! A measured table from a panel's level to the phase that it gives.

use std::f64::consts::PI;
use std::path::Path;

use super::files::{FileFault, read_text};

/// Rows that are quoted when several are wrong.
const ROWS_QUOTED_MAX: usize = 3;
/// No panel's stroke is this large: above it the table is in degrees.
const PHASE_MAX_RAD: f64 = 16.0 * PI;

/// Reads the phase in radians at each of the `2^bit_depth` levels.
///
/// The file is CSV: a row for each level from 0 up, either `level,phase_rad` or `phase_rad` alone, with an optional
/// header line and `#` comments. The phase may rise or fall with the level but not both.
///
/// # Errors
/// [`FileFault`] where the file cannot be read, has a row that is no number, has too few or too many rows, or is not
/// monotonic.
pub(super) fn read(path: &Path, bit_depth: u8) -> Result<Vec<f64>, FileFault> {
    let levels = 1usize << bit_depth;
    let text = read_text(path)?;
    let mut phases_rad = Vec::with_capacity(levels);
    let mut wrong = Vec::new();
    let rows = text.lines().enumerate().map(|(index, row)| (index + 1, row.trim()));
    let rows = rows.filter(|(_, row)| !row.is_empty() && !row.starts_with('#'));
    for (position, (line, row)) in rows.enumerate() {
        let header = position == 0 && row.split(',').all(|cell| cell.trim().parse::<f64>().is_err());
        if header {
            continue;
        }
        match phase_in(row, phases_rad.len()) {
            Ok(phase_rad) => phases_rad.push(phase_rad),
            Err(why) => {
                wrong.push(format!("row {line} `{}` {why}", shortened(row)));
                phases_rad.push(0.0);
            }
        }
    }
    let fault = |found: String, advice: &str| FileFault {
        found: format!("{}: {found}", path.display()),
        expected: format!("a CSV file of {levels} rows `level,phase_rad`, monotonic"),
        advice: advice.into(),
    };
    if !wrong.is_empty() {
        let more = wrong.len().saturating_sub(ROWS_QUOTED_MAX);
        let mut found = wrong[..wrong.len().min(ROWS_QUOTED_MAX)].join(", ");
        if more > 0 {
            found.push_str(&format!(" and {more} rows more"));
        }
        return Err(fault(found, "correct the rows, with a decimal point and phases in radians"));
    }
    if phases_rad.len() != levels {
        let advice = format!("measure the panel at each of its {bit_depth}-bit levels");
        return Err(fault(format!("{} rows", phases_rad.len()), &advice));
    }
    let falls = phases_rad[levels - 1] < phases_rad[0];
    let broken = phases_rad.windows(2).position(|pair| if falls { pair[1] > pair[0] } else { pair[1] < pair[0] });
    if let Some(level) = broken {
        let turn =
            format!("phase {} at level {}, {} at level {}", phases_rad[level], level, phases_rad[level + 1], level + 1);
        return Err(fault(turn, "smooth the measurement or unwrap its phase"));
    }
    Ok(phases_rad)
}

fn phase_in(row: &str, level: usize) -> Result<f64, String> {
    let cells: Vec<&str> = row.split(',').map(str::trim).collect();
    let phase = match cells.as_slice() {
        [phase] => phase,
        [given, phase] if given.parse() == Ok(level) => phase,
        [_, _] => return Err(format!("should be level {level}")),
        _ => return Err("has more than two columns".into()),
    };
    match phase.parse::<f64>() {
        Ok(phase_rad) if phase_rad.is_finite() && phase_rad.abs() <= PHASE_MAX_RAD => Ok(phase_rad),
        Ok(_) => Err("has no phase in radians".into()),
        Err(_) => Err("is not a number".into()),
    }
}

fn shortened(row: &str) -> String {
    row.chars().take(40).collect()
}
