//! `holod lut`: a panel's look-up table from powers that were measured on the bench.

use std::f64::consts::PI;
use std::fmt;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use holod_calibration::lut_fit::{self, LevelPower, LutFit};
use holod_calibration::rig::PhaseSign;
use serde::Serialize;

use super::service_facts::files_of;
use crate::cli::LutArgs;
use crate::destination::Destination;
use crate::failure::{Exit, Failure};
use crate::{results, setup};

/// Powers that differ more from the fringe, as a share of its height, leave more than 0.1 rad open on its flanks.
const RESIDUAL_MAX: f64 = 0.03;
/// More light that is always there comes through the hole from elsewhere.
const BACKGROUND_MAX: f64 = 0.2;

/// What the table says.
#[derive(Serialize)]
struct Made {
    #[serde(serialize_with = "crate::results::path_text")]
    file: PathBuf,
    levels: usize,
    /// Multiples of π at the top level.
    stroke_pi: f64,
    /// The levels whose phase is π, 2π and so on.
    turns: Vec<u16>,
    /// Root mean square of measured less fitted powers over the fringe's height.
    residual: f64,
    /// Light that is always there over the fringe's height.
    background: f64,
}

pub(super) fn lut(args: &LutArgs) -> Result<(), Failure> {
    let out = Destination::new(&args.out, "--out", args.force)?;
    out.refuse_json("--out", args.json)?;
    let rig = setup::rig(&args.rig)?;
    out.refuse_inputs("--out", files_of(&rig).into_iter().chain([args.powers.clone()]))?;
    let levels = 1usize << rig.panel.bit_depth;
    let rows = read(&args.powers)?;
    let fault = |why: &dyn fmt::Display| Failure::new(Exit::Data, format!("{}: {why}", args.powers.display()));
    let fit = lut_fit::fit(&rows, levels).map_err(|why| fault(&why))?;
    warn(&fit);
    let sign = match rig.panel.phase_sign {
        PhaseSign::Positive => 1.0,
        PhaseSign::Negative => -1.0,
    };
    let mut text = format!("# By `holod lut` from {}\nlevel,phase_rad\n", results::file_name(&args.powers));
    for (level, phase_rad) in fit.phases_rad.iter().enumerate() {
        // Adding 0 keeps level 0 from being written as -0.
        let _ = writeln!(text, "{level},{:.5}", sign * phase_rad + 0.0);
    }
    out.write(|path| results::save_text(&text, path))?;
    if out.is_stdout() {
        return Ok(());
    }
    let made = Made {
        file: args.out.clone(),
        levels,
        stroke_pi: fit.phases_rad[levels - 1] / PI,
        turns: fit.turns,
        residual: fit.residual,
        background: fit.background,
    };
    if args.json { results::print_json(&made) } else { results::print(&made.to_string()) }
}

fn warn(fit: &LutFit) {
    let percent = |share: f64| format!("{:.1} %", 1e2 * share);
    if fit.residual > RESIDUAL_MAX {
        tracing::warn!(
            "the powers differ from a fringe's by {} of its height (rms): average more readings, keep other light away, and \
             divide by the laser's power where that drifts",
            percent(fit.residual)
        );
    }
    if fit.background > BACKGROUND_MAX {
        tracing::warn!(
            "with level 0 alone there is {} of the fringe's height: a smaller hole, or a shorter period, keeps the middle away",
            percent(fit.background)
        );
    }
}

/// Reads rows `level,power`, with an optional header line and `#` comments.
fn read(path: &Path) -> Result<Vec<LevelPower>, Failure> {
    let named = path.display();
    let text = std::fs::read_to_string(path)
        .map_err(|error| Failure::new(Exit::NoInput, format!("{named}: {error}; name a CSV file of level,power")))?;
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .comment(Some(b'#'))
        .trim(csv::Trim::All)
        .flexible(true)
        .from_reader(text.as_bytes());
    let mut rows = Vec::new();
    for (place, record) in reader.records().enumerate() {
        let record = record.map_err(|error| Failure::new(Exit::Data, format!("{named}: {error}")))?;
        let cells: Vec<&str> = record.iter().collect();
        let row = match cells[..] {
            [level, power] => level.parse().ok().zip(power.parse().ok()),
            _ => None,
        };
        match row {
            Some((level, power)) => rows.push(LevelPower { level, power }),
            None if place == 0 && cells.iter().all(|cell| cell.parse::<f64>().is_err()) => {}
            None => {
                let line = record.position().map_or(0, csv::Position::line);
                let found = cells.join(",");
                let says =
                    format!("{named}: line {line}: found `{found}`, expected a row level,power such as 128,0.731");
                return Err(Failure::new(Exit::Data, says));
            }
        }
    }
    Ok(rows)
}

impl fmt::Display for Made {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let turns: Vec<String> =
            self.turns.iter().enumerate().map(|(turn, level)| format!("{} π at level {level}", turn + 1)).collect();
        write!(
            f,
            "{}: the phase of {} levels, up to {:.3} π; {}; powers within {:.2} % of the fringe's height (rms), {:.1} % always \
             there",
            self.file.display(),
            self.levels,
            self.stroke_pi,
            turns.join(", "),
            1e2 * self.residual,
            1e2 * self.background
        )
    }
}
