//! A measured table from a panel's levels to the phases that they give.

use std::f64::consts::PI;
use std::path::Path;

use super::LevelPhase;
use super::files::FileFault;

/// Rows that are quoted when several are wrong.
const ROWS_QUOTED_MAX: usize = 3;
/// No panel's stroke is this large: above it the table is in degrees.
const PHASE_MAX_RAD: f64 = 16.0 * PI;
/// A table of this many levels or more, the first 2^k, is that of a panel with k bits.
const OTHER_DEPTH_MIN: usize = 64;
/// A table of some levels whose steps back are no more than this share of those forward is one in order, measured with
/// some noise: in no order the two are about the same.
const NOISE_SHARE_MAX: f64 = 0.6;
/// The same of a table of few rows, whose steps are larger than noise, so that one back is soon an order of its own.
const FEW_ROWS_NOISE_SHARE_MAX: f64 = 0.05;
/// Tables of fewer rows have few.
const FEW_ROWS: usize = 16;
/// A panel of one level shows nothing.
const LEVELS_MIN: usize = 2;

/// The phase in radians at levels of a panel that has `2^bit_depth` of them, by the `text` of the file at `path`.
///
/// It is CSV, with an optional header line and `#` comments, in one of two forms:
/// - every level: a row for each from 0 up, `level,phase_rad` or `phase_rad` alone. The phase may rise or fall with the
///   level but not both.
/// - some levels, for a panel with few and irregular ones: a row `level,phase_rad` for each that may be used, the
///   levels rising, the phases in any order. Phases that are in order but for steps back are noise, and a fault:
///   in any order neither the sign nor the first turn of several can be told.
///
/// # Errors
/// [`FileFault`] where it has a row that is no number or out of order, has too few or too many
/// rows, names every level and is not monotonic, or names some and is nearly so.
pub(super) fn read(path: &Path, text: &str, bit_depth: u8) -> Result<Vec<LevelPhase>, FileFault> {
    let levels = 1usize << bit_depth;
    let mut table: Vec<LevelPhase> = Vec::new();
    let mut all_named = true;
    let mut wrong = Vec::new();
    let rows = text.lines().enumerate().map(|(index, row)| (index + 1, row.trim()));
    let rows = rows.filter(|(_, row)| !row.is_empty() && !row.starts_with('#'));
    for (position, (line, row)) in rows.enumerate() {
        let header = position == 0 && row.split(',').all(|cell| cell.trim().parse::<f64>().is_err());
        if header {
            continue;
        }
        let next = table.last().map_or(0, |last| usize::from(last.level) + 1);
        let read = level_and_phase(row, next, levels);
        let (level, phase_rad) = read.unwrap_or_else(|why| {
            wrong.push(format!("row {line} `{}` {why}", shortened(row)));
            (None, 0.0)
        });
        all_named &= level.is_some();
        let level = level.unwrap_or(next).min(levels - 1);
        table.push(LevelPhase { level: level as u16, phase_rad });
    }
    let fault = |found: String, advice: &str| FileFault {
        found: format!("{}: {found}", path.display()),
        expected: format!(
            "a CSV file of {levels} rows `level,phase_rad`, monotonic, or of the levels that may be used"
        ),
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
    let complete = table.len() == levels;
    let last = usize::from(table.last().map_or(0, |last| last.level));
    // A panel with few levels has none of a lower depth; a rest of a table that was cut short is no power of two.
    let is_of_another_depth =
        last + 1 == table.len() && table.len().is_power_of_two() && table.len() >= OTHER_DEPTH_MIN;
    if !complete && is_of_another_depth {
        let found = format!("the levels 0 to {last} and none above, a table of {} bits", table.len().ilog2());
        let advice = format!("measure the panel at its {bit_depth}-bit levels, or correct bit_depth");
        return Err(fault(found, &advice));
    }
    if !complete && (!all_named || table.len() < LEVELS_MIN) {
        let advice = format!("measure the panel at each of its {bit_depth}-bit levels, or name the level in each row");
        return Err(fault(format!("{} rows", table.len()), &advice));
    }
    let falls = table[table.len() - 1].phase_rad < table[0].phase_rad;
    let turns_round = |pair: &[LevelPhase]| {
        if falls { pair[1].phase_rad > pair[0].phase_rad } else { pair[1].phase_rad < pair[0].phase_rad }
    };
    let steps_back = || table.windows(2).filter(|pair| turns_round(pair));
    let length_rad = |pair: &[LevelPhase]| (pair[1].phase_rad - pair[0].phase_rad).abs();
    let back_rad: f64 = steps_back().map(length_rad).sum();
    let forward_rad = table.windows(2).map(length_rad).sum::<f64>() - back_rad;
    let noise_share_max = if table.len() < FEW_ROWS { FEW_ROWS_NOISE_SHARE_MAX } else { NOISE_SHARE_MAX };
    if let Some(broken) = steps_back().next().filter(|_| complete || back_rad <= noise_share_max * forward_rad) {
        let [before, after] =
            [broken[0], broken[1]].map(|LevelPhase { level, phase_rad }| format!("phase {phase_rad} at level {level}"));
        let back = steps_back().count();
        let more = if back > 1 { format!(", the first of {back} rows that step back") } else { String::new() };
        let advice = match (complete, back) {
            (true, _) => "smooth the measurement or unwrap its phase; ".to_owned(),
            (false, 1) => format!("smooth the measurement, or leave out level {}; ", broken[1].level),
            (false, _) => "smooth the measurement; ".to_owned(),
        };
        return Err(fault(
            format!("{before}, {after}{more}"),
            &(advice + "`holod lut` makes a smooth table from measured powers"),
        ));
    }
    Ok(table)
}

/// The level where the row names it, and the phase. `next` is the lowest level that may come.
fn level_and_phase(row: &str, next: usize, levels: usize) -> Result<(Option<usize>, f64), String> {
    let cells: Vec<&str> = row.split(',').map(str::trim).collect();
    let (level, phase) = match cells.as_slice() {
        [phase] => (None, phase),
        [level, phase] => (Some(level.parse::<usize>().map_err(|_| "has no level")?), phase),
        _ => return Err("has more than two columns".into()),
    };
    match level {
        Some(level) if level >= levels => return Err(format!("has no level of 0 to {}", levels - 1)),
        Some(level) if level < next => return Err(format!("should be level {next} or higher")),
        None if next >= levels => return Err(format!("is one more than the panel's {levels} levels")),
        _ => {}
    }
    match phase.parse::<f64>() {
        Ok(phase_rad) if phase_rad.is_finite() && phase_rad.abs() <= PHASE_MAX_RAD => Ok((level, phase_rad)),
        Ok(_) => Err("has no phase in radians".into()),
        Err(_) => Err("is not a number".into()),
    }
}

fn shortened(row: &str) -> String {
    row.chars().take(40).collect()
}
