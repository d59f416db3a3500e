//! A panel's look-up table from powers that were measured on the bench.
//!
//! **What is measured.** Lines of level 0 and of level n, half a period each, send (2/π)²·sin²(φ(n)/2) of their light
//! into a first order, φ(n) being the phase between the two (J. W. Goodman, *Introduction to Fourier Optics*, 4.4). So
//! the power in that order is P(n) = B + A·sin²(φ(n)/2), where B is light that is always there.
//!
//! **How it is read back.** Where the power turns round, the phase is a whole multiple of π; in between it is at first
//! the arccosine of the power, on the branch between two turns. From there a curve φ(n) whose slope changes little (a
//! discrete smoothing spline; C. H. Reinsch, Numer. Math. 10, 1967) is fitted to the powers themselves by Gauss and
//! Newton's method, and A and B with it: an arccosine alone would bend the curve at the turns, where all noise points
//! to one side. How stiff the curve is, the rows say: as much as lets the others foretell each fifth one best, and at
//! least so much that the phase never runs back.

use std::f64::consts::PI;

/// Fewer rows tell no curve.
pub const ROWS_MIN: usize = 16;
/// A turn counts where the power goes back by this share of its whole range.
const TURN_SHARE: f64 = 0.2;
/// The only turn counts where the last powers lie by this share below it.
const ONLY_TURN_SHARE: f64 = 0.05;
/// A last turn, behind which the power goes back by less, counts where it leaves less than this share of the squares.
const LAST_TURN_SHARE: f64 = 0.8;
/// Powers that differ from a fringe's by more than this share of its height, rms, are none.
const RESIDUAL_MAX: f64 = 0.15;
/// No panel's phase goes farther, in multiples of π; a rig file takes no longer stroke.
const STROKE_MAX_PI: f64 = 6.0;
/// Rounds of fitting amplitude and curve in turn.
const ROUNDS: usize = 8;
/// Stiffnesses that are tried: powers of ten.
const STIFFNESSES: std::ops::RangeInclusive<i32> = 0..=7;
/// Rows that are left out at once, to be foretold by the others.
const FOLDS: usize = 5;

/// The power of a first order while lines of level 0 and of this level are shown, in any unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LevelPower {
    /// The level of the lines between those of level 0.
    pub level: u16,
    /// Optical power in the order, in a unit that is the same for all levels of a sweep.
    pub power: f64,
}

/// What powers say of a panel.
#[derive(Clone, Debug, PartialEq)]
pub struct LutFit {
    /// The phase in radians at each level from 0 up, which rises from 0.
    pub phases_rad: Vec<f64>,
    /// The first levels at which the phase is π, 2π and so on: there the power turns round.
    pub turns: Vec<u16>,
    /// Root mean square of what is left between measured powers and fitted ones, as a share of the fringe's height A.
    pub residual: f64,
    /// The light that is always there, B, as a share of the fringe's height.
    pub background: f64,
}

/// Why powers give no table.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum LutFitError {
    /// Fewer rows than [`ROWS_MIN`].
    #[error("found {found} rows, expected {ROWS_MIN} at least: measure more levels")]
    Rows { found: usize },
    /// The table would have to be guessed at one end.
    #[error("found levels from {first} to {last}, expected all of 0 to {top}, if not each: measure the ends, too")]
    Ends { first: u16, last: u16, top: u16 },
    /// A level twice, or levels that fall.
    #[error("found level {after} after level {before}, expected levels that rise")]
    Order { before: u16, after: u16 },
    /// A power that is none.
    #[error("found the power {power} at level {level}, expected a number")]
    Power { level: u16, power: f64 },
    /// Level 0 beside itself has no lines.
    #[error(
        "the power falls first, down to level {turn}; expected the least power at level 0, where there are no lines: \
         measure a first order of lines of level 0 and each other one (`holod pattern two-levels 0 LEVEL`), not the \
         middle"
    )]
    Falls { turn: u16 },
    /// Less than half a wave.
    #[error(
        "the power never turns round; expected a stroke of more than 1.2 π, below which the height of the fringe is not \
         known, and lines that move the power: look whether the order is the first one and the levels change"
    )]
    NoTurn,
    /// What was measured is no fringe.
    #[error(
        "the phase would run back from level {before} to level {after}: the powers are too noisy or the laser drifted; \
         average more readings, or measure the laser's power beside them and divide"
    )]
    RunsBack { before: u16, after: u16 },
    /// Powers of a meter that is too coarse, or of anything else.
    #[error(
        "the powers are those of no fringe: {found}; look whether the meter resolves a hundredth of the fringe, and \
         average more readings"
    )]
    NoFringe { found: String },
}

/// Reads the phase of each level of a panel with `levels` of them back from a sweep, rows in the order of levels, the
/// first of level 0 and the last of the top level. Which way the phase goes no power tells: it rises here.
///
/// # Errors
/// [`LutFitError`] where the rows are no such sweep.
pub fn fit(rows: &[LevelPower], levels: usize) -> Result<LutFit, LutFitError> {
    check(rows, levels)?;
    let (turns, last) = turns(rows)?;
    let mut curve = Curve::through(rows, &turns);
    // The power may end soon after a turn.
    if last + 1 < rows.len() {
        let more: Vec<usize> = turns.iter().copied().chain([last]).collect();
        let other = Curve::through(rows, &more);
        let is_better = other.left < LAST_TURN_SHARE * curve.left;
        if other.runs_back().is_none() && (is_better || curve.runs_back().is_some()) {
            curve = other;
        }
    }
    if let Some(place) = curve.runs_back() {
        return Err(LutFitError::RunsBack { before: rows[place].level, after: rows[place + 1].level });
    }
    let residual = (curve.left / rows.len() as f64).sqrt() / curve.height;
    let stroke_pi = curve.phases_rad[rows.len() - 1] / PI;
    if let Some(found) = misfit(stroke_pi, residual) {
        return Err(LutFitError::NoFringe { found });
    }
    let phases_rad: Vec<f64> = (0..levels).map(|level| between(rows, &curve.phases_rad, level as u16)).collect();
    let turns = (1..).map(|turn| phases_rad.partition_point(|&phase_rad| phase_rad < f64::from(turn) * PI));
    Ok(LutFit {
        turns: turns.take_while(|&level| level < levels).map(|level| level as u16).collect(),
        phases_rad,
        residual,
        background: curve.floor / curve.height,
    })
}

/// What keeps the nearest fringe from being that of the powers, if anything does.
fn misfit(stroke_pi: f64, residual: f64) -> Option<String> {
    if !(stroke_pi.is_finite() && residual.is_finite()) {
        return Some("none comes near them".into());
    }
    if stroke_pi > STROKE_MAX_PI {
        return Some(format!("the nearest one goes up to {stroke_pi:.3} π, expected {STROKE_MAX_PI} π at most"));
    }
    if residual < 0.0 {
        return Some("the nearest one is upside down".into());
    }
    let [found, most] = [residual, RESIDUAL_MAX].map(|share| 1e2 * share);
    (residual > RESIDUAL_MAX).then(|| {
        format!("they differ from the nearest one's by {found:.1} % of its height (rms), expected {most:.0} % at most")
    })
}

/// A curve of phases, and the fringe that it makes.
struct Curve {
    phases_rad: Vec<f64>,
    floor: f64,
    height: f64,
    /// Squares of what is left of the powers.
    left: f64,
}

impl Curve {
    /// With the power's turns at these rows.
    fn through(rows: &[LevelPower], turns: &[usize]) -> Self {
        let (mut floor, mut height) = first_guess(rows, turns);
        let mut phases_rad: Vec<f64> = Vec::new();
        for _ in 0..ROUNDS {
            let share = |row: usize| (rows[row].power - floor) / height;
            let reading = |row: usize| match phases_rad.get(row) {
                Some(&phase_rad) => PhaseReading::near(phase_rad, share(row)),
                None => PhaseReading::by_branch(share(row), turns.partition_point(|&turn| turn < row)),
            };
            phases_rad = smoothed(rows, &(0..rows.len()).map(reading).collect::<Vec<_>>());
            (floor, height) = floor_and_height(rows, &phases_rad);
        }
        let left = rows.iter().zip(&phases_rad).map(|(row, &phase_rad)| row.power - floor - height * fringe(phase_rad));
        let left = left.map(|left| left * left).sum();
        Self { phases_rad, floor, height, left }
    }

    fn runs_back(&self) -> Option<usize> {
        self.phases_rad.windows(2).position(|pair| pair[1] <= pair[0])
    }
}

fn check(rows: &[LevelPower], levels: usize) -> Result<(), LutFitError> {
    if rows.len() < ROWS_MIN {
        return Err(LutFitError::Rows { found: rows.len() });
    }
    if let Some(pair) = rows.windows(2).find(|pair| pair[1].level <= pair[0].level) {
        return Err(LutFitError::Order { before: pair[0].level, after: pair[1].level });
    }
    if let Some(row) = rows.iter().find(|row| !row.power.is_finite()) {
        return Err(LutFitError::Power { level: row.level, power: row.power });
    }
    let (first, last, top) = (rows[0].level, rows[rows.len() - 1].level, (levels - 1) as u16);
    if first != 0 || last != top { Err(LutFitError::Ends { first, last, top }) } else { Ok(()) }
}

/// The rows at which the power turns round, a maximum first; and the extreme behind them.
fn turns(rows: &[LevelPower]) -> Result<(Vec<usize>, usize), LutFitError> {
    let powers = || rows.iter().map(|row| row.power);
    let goes_back = TURN_SHARE * (powers().fold(f64::MIN, f64::max) - powers().fold(f64::MAX, f64::min));
    let mut turns = Vec::new();
    let mut rises = true;
    let mut extreme = 0;
    for (row, power) in powers().enumerate() {
        let sign = if rises { 1.0 } else { -1.0 };
        let beyond = sign * (power - rows[extreme].power);
        if beyond > 0.0 {
            extreme = row;
        } else if -beyond > goes_back {
            turns.push(extreme);
            (rises, extreme) = (!rises, row);
        }
    }
    if turns.is_empty() {
        let last = &rows[rows.len() - 3..];
        let fallen = rows[extreme].power - last.iter().map(|row| row.power).sum::<f64>() / last.len() as f64;
        if fallen > ONLY_TURN_SHARE / TURN_SHARE * goes_back {
            turns.push(extreme);
            extreme = rows.len() - 1;
        }
    }
    match turns.first() {
        None => Err(LutFitError::NoTurn),
        // What lies before the maximum is no flank.
        Some(&turn) if rows[turn].power - rows[0].power < goes_back => {
            Err(LutFitError::Falls { turn: rows[turns.get(1).copied().unwrap_or(extreme)].level })
        }
        Some(_) => Ok((turns, extreme)),
    }
}

/// The least power and the fringe's height, of turns that are there.
fn first_guess(rows: &[LevelPower], turns: &[usize]) -> (f64, f64) {
    let mean = |powers: &mut dyn Iterator<Item = f64>| {
        let (sum, count) = powers.fold((0.0, 0.0), |(sum, count), power| (sum + power, count + 1.0));
        sum / count
    };
    let tops = mean(&mut turns.iter().step_by(2).map(|&turn| rows[turn].power));
    let floors =
        mean(&mut std::iter::once(0).chain(turns.iter().skip(1).step_by(2).copied()).map(|row| rows[row].power));
    (floors, tops - floors)
}

fn fringe(phase_rad: f64) -> f64 {
    (0.5 * phase_rad).sin().powi(2)
}

/// The phase at a row's level as its power gives it, and how well: a curve that has φ there misses the power by
/// `slope`·(φ − `phase_rad`), as a share of the fringe's height.
#[derive(Clone, Copy)]
struct PhaseReading {
    phase_rad: f64,
    /// Of the fringe there, per radian; 0 where the power says nothing of the phase.
    slope: f64,
}

impl PhaseReading {
    /// By the arccosine of a share of the light, on the branch from `branch`·π to the next.
    fn by_branch(share: f64, branch: usize) -> Self {
        let rising = (1.0 - 2.0 * share.clamp(0.0, 1.0)).acos();
        let phase_rad = branch as f64 * PI + if branch.is_multiple_of(2) { rising } else { PI - rising };
        Self { phase_rad, slope: 0.5 * phase_rad.sin() }
    }

    /// By the straight line that touches the fringe at `near_rad`.
    fn near(near_rad: f64, share: f64) -> Self {
        let slope = 0.5 * near_rad.sin();
        // At a turn the power says nothing; a wild step there would come to nothing, too.
        let step_rad = if slope.abs() < 1e-3 { 0.0 } else { (share - fringe(near_rad)) / slope };
        Self { phase_rad: near_rad + step_rad, slope }
    }
}

/// B and A by least squares.
fn floor_and_height(rows: &[LevelPower], phases_rad: &[f64]) -> (f64, f64) {
    let count = rows.len() as f64;
    let mean = |of: &dyn Fn(f64, f64) -> f64| {
        rows.iter().zip(phases_rad).map(|(row, &phase_rad)| of(fringe(phase_rad), row.power)).sum::<f64>() / count
    };
    let (share, power) = (mean(&|share, _| share), mean(&|_, power| power));
    let height = mean(&|s, p| (s - share) * (p - power)) / mean(&|s, _| (s - share).powi(2));
    (power - height * share, height)
}

/// A curve through the readings of all rows, as stiff as lets them foretell each other best; 0 at level 0.
fn smoothed(rows: &[LevelPower], readings: &[PhaseReading]) -> Vec<f64> {
    let levels: Vec<f64> = rows.iter().map(|row| f64::from(row.level)).collect();
    let missed = |stiffness: f64| -> f64 {
        let fold = |fold: usize| {
            let is_left_out = |row: usize| row % FOLDS == fold;
            let weighted = |(row, reading): (usize, &PhaseReading)| {
                if is_left_out(row) { PhaseReading { slope: 0.0, ..*reading } } else { *reading }
            };
            let kept: Vec<_> = readings.iter().enumerate().map(weighted).collect();
            let curve = spline(&levels, &kept, stiffness);
            let left_out = (0..rows.len()).filter(|&row| is_left_out(row));
            left_out.map(|row| (readings[row].slope * (curve[row] - readings[row].phase_rad)).powi(2)).sum::<f64>()
        };
        (0..FOLDS).map(fold).sum()
    };
    let best = STIFFNESSES.min_by(|&a, &b| missed(10f64.powi(a)).total_cmp(&missed(10f64.powi(b)))).unwrap_or(0);
    // A liquid crystal's phase never runs back.
    let mut curves = (best..=*STIFFNESSES.end()).map(|power| spline(&levels, readings, 10f64.powi(power)));
    let rises = |curve: &Vec<f64>| curve.is_sorted_by(|a, b| a < b);
    curves.find(rises).unwrap_or_else(|| spline(&levels, readings, 10f64.powi(best)))
}

/// The curve that misses the readings by least, and whose changes of slope have the least squares, `stiffness` times;
/// with φ = 0 at level 0. A matrix of five diagonals. Slopes are of steps of the mean distance between levels.
fn spline(levels: &[f64], readings: &[PhaseReading], stiffness: f64) -> Vec<f64> {
    // Ties level 0 to its phase, and keeps rows without weight solvable.
    const TIE: f64 = 1e9;
    const LEAST: f64 = 1e-9;
    let count = levels.len();
    let step = (levels[count - 1] - levels[0]) / (count - 1) as f64;
    let weight = |reading: &PhaseReading| reading.slope * reading.slope + LEAST;
    let mut diagonals: Vec<[f64; 3]> = readings.iter().map(|reading| [weight(reading), 0.0, 0.0]).collect();
    let mut right: Vec<f64> = readings.iter().map(|reading| weight(reading) * reading.phase_rad).collect();
    diagonals[0][0] += TIE;
    for row in 1..count - 1 {
        let [before, after] = [row - 1, row].map(|at| step / (levels[at + 1] - levels[at]));
        let change = [before, -before - after, after];
        for (first, a) in change.iter().enumerate() {
            for (second, b) in change.iter().enumerate().skip(first) {
                diagonals[row - 1 + first][second - first] += stiffness * a * b;
            }
        }
    }
    // Cholesky: the lower triangle's columns take the place of the matrix's.
    for row in 0..count {
        let root = diagonals[row][0].sqrt();
        diagonals[row] = diagonals[row].map(|value| value / root);
        let [_, one, two] = diagonals[row];
        if row + 1 < count {
            diagonals[row + 1][0] -= one * one;
            diagonals[row + 1][1] -= one * two;
        }
        if row + 2 < count {
            diagonals[row + 2][0] -= two * two;
        }
    }
    for row in 0..count {
        right[row] /= diagonals[row][0];
        for below in 1..=2.min(count - 1 - row) {
            right[row + below] -= diagonals[row][below] * right[row];
        }
    }
    for row in (0..count).rev() {
        for below in 1..=2.min(count - 1 - row) {
            right[row] -= diagonals[row][below] * right[row + below];
        }
        right[row] /= diagonals[row][0];
    }
    right[0] = 0.0;
    right
}

/// The phase at `level`, on the straight line between the rows around it.
fn between(rows: &[LevelPower], phases_rad: &[f64], level: u16) -> f64 {
    let above = rows.partition_point(|row| row.level < level);
    if rows[above].level == level {
        return phases_rad[above];
    }
    let share = f64::from(level - rows[above - 1].level) / f64::from(rows[above].level - rows[above - 1].level);
    phases_rad[above - 1] + share * (phases_rad[above] - phases_rad[above - 1])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers without a pattern, even over −1 to 1 (a linear congruence; Knuth's MMIX constants).
    struct Noise(u64);

    impl Noise {
        fn next(&mut self) -> f64 {
            self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (self.0 >> 32) as f64 / f64::from(u32::MAX) * 2.0 - 1.0
        }
    }

    /// A liquid crystal's curve, steep in the middle, up to `stroke_pi`.
    fn crystal(level: f64, stroke_pi: f64) -> f64 {
        let share = level / 255.0;
        stroke_pi
            * PI
            * (share + 0.08 * (2.0 * PI * share).sin() * (1.0 - share) - 0.06 * share * (1.0 - share)).max(0.0)
    }

    fn swept(stroke_pi: f64, every: usize, noise: f64, seed: u64) -> Vec<LevelPower> {
        let mut random = Noise(seed);
        let levels = (0..255u16).step_by(every).chain([255]);
        let power = |level: u16| 0.3 + 4.0 * (fringe(crystal(f64::from(level), stroke_pi)) + noise * random.next());
        let powers: Vec<f64> = levels.clone().map(power).collect();
        levels.zip(powers).map(|(level, power)| LevelPower { level, power }).collect()
    }

    /// Root mean square and greatest difference from the curve, in radians.
    fn off_by(fit: &LutFit, stroke_pi: f64) -> [f64; 2] {
        let off = |(level, phase_rad): (usize, &f64)| (phase_rad - crystal(level as f64, stroke_pi)).abs();
        let all: Vec<f64> = fit.phases_rad.iter().enumerate().map(off).collect();
        let rms = (all.iter().map(|off| off * off).sum::<f64>() / all.len() as f64).sqrt();
        [rms, all.into_iter().fold(0.0, f64::max)]
    }

    #[test]
    fn a_sweep_gives_back_the_panels_curve() {
        for (stroke_pi, every, noise, [rms_rad, most_rad]) in [
            (2.0, 1, 0.0, [2e-3, 1e-2]),
            (2.0, 1, 0.01, [0.03, 0.08]),
            (1.6, 1, 0.01, [0.03, 0.08]),
            (1.2, 2, 0.01, [0.03, 0.08]),
            (2.3, 4, 0.01, [0.03, 0.08]),
            (3.7, 2, 0.01, [0.03, 0.08]),
            (2.2, 1, 0.03, [0.06, 0.2]),
        ] {
            for seed in 1..=8 {
                let case = format!("{stroke_pi} π, each {every}, noise {noise}, seed {seed}");
                let fit = fit(&swept(stroke_pi, every, noise, seed), 256).unwrap_or_else(|why| panic!("{case}: {why}"));
                let off = off_by(&fit, stroke_pi);
                assert!(off[0] < rms_rad && off[1] < most_rad, "{case}: {off:?}");
                let turns = fit.turns.len() as f64;
                assert!((stroke_pi - 1.0..=stroke_pi).contains(&turns), "{case}: {:?}", fit.turns);
                assert!((fit.residual - noise / 3f64.sqrt()).abs() < 0.25 * noise + 2e-3, "{case}: {}", fit.residual);
                assert!((fit.background - 0.075).abs() < 0.03, "{case}: {}", fit.background);
                assert!(fit.phases_rad.is_sorted_by(|a, b| a < b) && fit.phases_rad[0] == 0.0, "{case}");
            }
        }
    }

    #[test]
    fn what_keeps_a_fringe_from_being_the_powers_own_is_told() {
        for (stroke_pi, residual, says) in [
            (f64::NAN, 0.1, "none comes near them"),
            (2.0, f64::INFINITY, "none comes near them"),
            (6.5, 0.01, "up to 6.500 π, expected 6 π at most"),
            (2.0, -0.03, "upside down"),
            (2.0, 0.153, "by 15.3 % of its height (rms), expected 15 % at most"),
        ] {
            let told = misfit(stroke_pi, residual);
            assert!(told.as_ref().is_some_and(|told| told.contains(says)), "{stroke_pi} π, {residual}: {told:?}");
        }
        assert_eq!(misfit(STROKE_MAX_PI, RESIDUAL_MAX), None);
    }

    #[test]
    fn the_comparison_objects_to_another_curve() {
        let mut fit = fit(&swept(2.0, 1, 0.0, 7), 256).unwrap();
        assert!(off_by(&fit, 2.0)[1] < 1e-2);
        fit.phases_rad[100] += 0.1;
        assert!(off_by(&fit, 2.0)[1] > 0.09);
    }

    #[test]
    fn each_fault_of_a_sweep_is_told() {
        let sound = swept(2.0, 1, 0.0, 7);
        let refused = |rows: &[LevelPower], levels: usize| fit(rows, levels).unwrap_err();
        assert_eq!(refused(&sound[..15], 256), LutFitError::Rows { found: 15 });
        assert_eq!(refused(&sound[..200], 256), LutFitError::Ends { first: 0, last: 199, top: 255 });
        assert_eq!(refused(&sound[1..], 256), LutFitError::Ends { first: 1, last: 255, top: 255 });
        assert_eq!(refused(&sound, 1024), LutFitError::Ends { first: 0, last: 255, top: 1023 });
        let mut twice = sound.clone();
        twice[30].level = 29;
        assert_eq!(refused(&twice, 256), LutFitError::Order { before: 29, after: 29 });
        let mut none = sound.clone();
        none[4].power = f64::NAN;
        assert!(matches!(refused(&none, 256), LutFitError::Power { level: 4, .. }));
        for too_little_pi in [0.8, 1.12] {
            assert_eq!(refused(&swept(too_little_pi, 1, 0.0, 7), 256), LutFitError::NoTurn, "{too_little_pi} π");
        }
        assert!(fit(&swept(1.2, 8, 0.0, 7), 256).is_ok());
        let dark: Vec<_> = sound.iter().map(|row| LevelPower { power: 0.0, ..*row }).collect();
        assert_eq!(refused(&dark, 256), LutFitError::NoTurn);
        let middle: Vec<_> = sound.iter().map(|row| LevelPower { power: 5.0 - row.power, ..*row }).collect();
        assert!(matches!(refused(&middle, 256), LutFitError::Falls { turn: 100..150 }));
    }

    #[test]
    fn noise_alone_is_no_table() {
        for seed in 1..=20 {
            let mut random = Noise(seed);
            let rows: Vec<_> = (0..=255).map(|level| LevelPower { level, power: random.next() }).collect();
            assert!(fit(&rows, 256).is_err(), "seed {seed}");
        }
    }

    /// Through two powers a curve can be laid that is steep without end.
    #[test]
    fn powers_of_a_meter_too_coarse_are_no_table() {
        let read_as = |step: f64| {
            let power = |row: LevelPower| LevelPower { power: (row.power / step).round() * step, ..row };
            fit(&swept(2.0, 1, 0.0, 7).into_iter().map(power).collect::<Vec<_>>(), 256)
        };
        assert!(matches!(read_as(4.0), Err(LutFitError::NoFringe { .. })), "{:?}", read_as(4.0));
        assert!(off_by(&read_as(0.2).unwrap(), 2.0)[0] < 0.1);
        let sine = |level: u16| (1.2 * (PI * f64::from(level) / 255.0).sin().powi(2)).round();
        let rows: Vec<_> = (0..=255).map(|level| LevelPower { level, power: sine(level) }).collect();
        assert!(matches!(fit(&rows, 256), Err(LutFitError::NoFringe { .. })), "{:?}", fit(&rows, 256));
    }
}
