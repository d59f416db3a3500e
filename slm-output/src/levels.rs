//! Phase in radians to the panel's levels, and back to the phase that the panel shows.
//!
//! The one place that knows the panel's look-up tables, stroke, phase sign and flatness. Nothing else is done to a
//! level: no sRGB curve, no dithering.
//!
//! **Rounding.** Phase lives on a circle, so a phase goes to the level whose phase is nearest *on the circle*. A linear
//! panel of L levels whose stroke is 2π·(L−1)/L has its levels 2π/L apart all the way round, and a phase just below 2π
//! rounds up to level 0. A stroke of exactly 2π makes the top level a second name of level 0; it is then not used.
//!
//! **Other strokes.** Below 2π·(L−1)/L there is a gap on the circle that no level reaches: a phase in it goes to the
//! nearer rim, and [`EncodeReport`] counts the pixels whose phase lies farther from every level than half of the
//! widest step elsewhere. Above 2π only the first full turn of levels is used, so that neighbouring pixels differ by as
//! little drive as possible.
//!
//! **Speed.** A table of 16 entries for each level (4096 for 8 bits) maps phase to level. Each entry holds the best
//! level for the middle of its range, so the level found may be farther from the phase than the nearest one by at most
//! the width of an entry, 2π/(16·L), a sixteenth of a level's step; where levels are 2π/L apart the steps' borders fall
//! on the entries' borders and it is the nearest one.

use std::f64::consts::TAU;

use holod_calibration::rig::{Panel, PhaseSign};
use holod_calibration::{Colour, PerColour, Resolution};

use crate::fields::{FieldMut, LevelsFrame};

/// Table entries for each level.
const ENTRIES_PER_LEVEL: usize = 16;
/// Marks table entries whose phase no level reaches.
const UNREACHABLE: u16 = 1 << 15;
/// Pixels whose table indices are computed together, so that the arithmetic is vectorised apart from the look-ups.
const BLOCK: usize = 256;
/// Adding 1.5·2²³ to a small `f32` leaves its nearest integer, in two's complement, in the low bits of the sum.
const TO_INTEGER: f32 = 12_582_912.0;

/// Why a panel's description cannot be used for encoding.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LevelsError {
    /// A bit depth that no supported panel has.
    #[error("panel.bit_depth is {found}; expected 8 or 10: correct the rig file")]
    BitDepth {
        /// What was found.
        found: u8,
    },
    /// A stroke that is no positive number.
    #[error("the {colour} stroke is {found} rad; expected a positive number: correct panel.stroke of the rig file")]
    Stroke {
        /// Whose stroke.
        colour: Colour,
        /// What was found.
        found: f64,
    },
    /// A look-up table with the wrong number of entries.
    #[error(
        "the {colour} look-up table has {found} entries; expected {expected}, one for each level: measure it again at the panel's bit depth"
    )]
    LutLength {
        /// Whose table.
        colour: Colour,
        /// What was found.
        found: usize,
        /// Levels of the panel.
        expected: usize,
    },
    /// A look-up table that turns round, is flat, or is not finite.
    #[error("the {colour} look-up table is not monotonic at level {level}: smooth or measure it again")]
    LutShape {
        /// Whose table.
        colour: Colour,
        /// The first level at which it goes wrong.
        level: usize,
    },
    /// A falling look-up table on a panel that is said to rise.
    #[error(
        "the {colour} look-up table falls with the level but panel.phase_sign is positive: set it to negative, or correct the table"
    )]
    LutSign {
        /// Whose table.
        colour: Colour,
    },
    /// A flatness picture of another size than the panel, or with a value that is not finite.
    #[error(
        "the {colour} flatness has {found} usable values; expected {expected} ({panel}): make it at the panel's own size"
    )]
    Flatness {
        /// Whose flatness.
        colour: Colour,
        /// Finite values found.
        found: usize,
        /// Pixels of the panel.
        expected: usize,
        /// The panel.
        panel: Resolution,
    },
    /// A pattern that does not fit on the panel.
    #[error("the pattern is {pattern} pixels, the panel {panel}: render a pattern that is no larger than the panel")]
    PatternSize {
        /// The pattern.
        pattern: Resolution,
        /// The panel.
        panel: Resolution,
    },
}

/// What encoding one pattern met.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EncodeReport {
    /// Share of each colour's pattern pixels whose phase the panel cannot reach, 0..=1.
    pub unreachable_share: PerColour<f32>,
}

/// Turns phase patterns into one panel's levels, and levels back into the phase shown.
#[derive(Clone, Debug)]
pub struct PanelEncoder {
    panel: Resolution,
    pattern: Resolution,
    colours: [ColourEncoder; 3],
}

#[derive(Clone, Debug)]
struct ColourEncoder {
    /// The level of each phase bin, with [`UNREACHABLE`] set where it is not near.
    table: Vec<u16>,
    /// Phase in [0, 2π) that each level shows on a flat panel.
    phase_of_level_rad: Vec<f32>,
    /// Phase to add at each panel pixel, in table entries, [0, table length).
    flatness_entries: Option<Vec<f32>>,
}

impl PanelEncoder {
    /// An encoder for `panel` of `panel_resolution` pixels, for patterns of `pattern_resolution` pixels, which are
    /// centred on the panel (half a pixel up and left where the difference is odd) within a flat surround of phase 0.
    ///
    /// A look-up table that rises is a magnitude and takes the panel's `phase_sign`; one that falls is signed already
    /// and the panel's `phase_sign` must be negative too.
    ///
    /// # Errors
    /// [`LevelsError`] where the panel's description contradicts itself or the pattern does not fit.
    pub fn new(
        panel: &Panel,
        panel_resolution: Resolution,
        pattern_resolution: Resolution,
    ) -> Result<Self, LevelsError> {
        if !matches!(panel.bit_depth, 8 | 10) {
            return Err(LevelsError::BitDepth { found: panel.bit_depth });
        }
        if pattern_resolution.width > panel_resolution.width || pattern_resolution.height > panel_resolution.height {
            return Err(LevelsError::PatternSize { pattern: pattern_resolution, panel: panel_resolution });
        }
        let of = |colour| ColourEncoder::new(panel, panel_resolution, colour);
        let colours = [of(Colour::Red)?, of(Colour::Green)?, of(Colour::Blue)?];
        Ok(Self { panel: panel_resolution, pattern: pattern_resolution, colours })
    }

    /// Pixels of the patterns that are encoded.
    pub fn pattern_resolution(&self) -> Resolution {
        self.pattern
    }

    /// Pixels of the panel.
    pub fn panel_resolution(&self) -> Resolution {
        self.panel
    }

    /// Encodes three patterns into `frame`: each phase in radians `[height, width]`, row-major, nominally in [0, 2π);
    /// phases within ±100 turns are wrapped. Neither allocates nor locks.
    ///
    /// # Panics
    /// Where a pattern or the frame has another size than the encoder was made for.
    pub fn encode(&self, phase_rad: PerColour<&[f32]>, frame: &mut LevelsFrame) -> EncodeReport {
        let mut report = EncodeReport::default();
        for (colour, phase_rad) in phase_rad.iter() {
            report.unreachable_share[colour] = self.encode_colour(colour, phase_rad, &mut frame.field_mut(colour));
        }
        report
    }

    /// Encodes one colour's pattern into `field`, as [`Self::encode`]; returns the share of pixels out of reach.
    fn encode_colour(&self, colour: Colour, phase_rad: &[f32], field: &mut FieldMut<'_>) -> f32 {
        assert_eq!(phase_rad.len(), self.pattern.pixels(), "a pattern has one phase for each pixel");
        assert_eq!(field.resolution(), self.panel, "a frame has the panel's size");
        let encoder = &self.colours[colour.index()];
        let (left, top) = self.pattern_origin();
        let mut unreachable = 0;
        for row in 0..self.panel.height {
            let row_start = row * self.panel.width;
            if row < top || row >= top + self.pattern.height {
                encoder.encode_flat(row_start, self.panel.width, field);
                continue;
            }
            let pattern_start = (row - top) * self.pattern.width;
            let phases_rad = &phase_rad[pattern_start..pattern_start + self.pattern.width];
            let right = left + self.pattern.width;
            encoder.encode_flat(row_start, left, field);
            unreachable += encoder.encode_run(row_start + left, phases_rad, field);
            encoder.encode_flat(row_start + right, self.panel.width - right, field);
        }
        unreachable as f32 / self.pattern.pixels().max(1) as f32
    }

    /// Encodes the flat pattern, phase 0 everywhere, in every colour.
    ///
    /// # Panics
    /// Where the frame has another size than the encoder was made for.
    pub fn encode_flat(&self, frame: &mut LevelsFrame) {
        assert_eq!(frame.layout().resolution, self.panel, "a frame has the panel's size");
        for colour in Colour::ALL {
            self.colours[colour.index()].encode_flat(0, self.panel.pixels(), &mut frame.field_mut(colour));
        }
    }

    /// The phase in [0, 2π) that the panel really shows for `levels` `[panel height, panel width]`, with the panel's
    /// own unflatness (which the flatness picture cancels) taken into account.
    ///
    /// # Panics
    /// Where `levels` has another number of pixels than the panel, or holds a level that the panel does not have.
    pub fn decode(&self, colour: Colour, levels: &[u16]) -> Vec<f32> {
        assert_eq!(levels.len(), self.panel.pixels(), "a field has one level for each panel pixel");
        (0..levels.len()).map(|pixel| self.colours[colour.index()].phase_shown(pixel, levels[pixel])).collect()
    }

    /// As [`Self::decode`], for the part of the panel that carries the pattern: `[pattern height, pattern width]`.
    ///
    /// # Panics
    /// As [`Self::decode`].
    pub fn decode_pattern(&self, colour: Colour, levels: &[u16]) -> Vec<f32> {
        let shown = self.decode(colour, levels);
        let (left, top) = self.pattern_origin();
        let rows = shown.chunks_exact(self.panel.width).skip(top).take(self.pattern.height);
        rows.flat_map(|row| &row[left..left + self.pattern.width]).copied().collect()
    }

    fn pattern_origin(&self) -> (usize, usize) {
        ((self.panel.width - self.pattern.width) / 2, (self.panel.height - self.pattern.height) / 2)
    }
}

impl ColourEncoder {
    fn new(panel: &Panel, resolution: Resolution, colour: Colour) -> Result<Self, LevelsError> {
        let signed_rad = signed_phases(panel, colour)?;
        let table = nearest_level_table(&signed_rad);
        let entries = table.len() as f64;
        let flatness_entries = match &panel.flatness_rad[colour] {
            None => None,
            Some(flatness_rad) => {
                let finite = flatness_rad.iter().filter(|phase| phase.is_finite()).count();
                if flatness_rad.len() != resolution.pixels() || finite != resolution.pixels() {
                    return Err(LevelsError::Flatness {
                        colour,
                        found: finite,
                        expected: resolution.pixels(),
                        panel: resolution,
                    });
                }
                let to_entries = |&phase: &f32| (f64::from(phase).rem_euclid(TAU) / TAU * entries) as f32;
                Some(flatness_rad.iter().map(to_entries).collect())
            }
        };
        let phase_of_level_rad = signed_rad.iter().map(|&phase| wrapped_f32(phase)).collect();
        Ok(Self { table, phase_of_level_rad, flatness_entries })
    }

    /// Encodes `phases_rad` into the panel pixels from `first` on; returns how many are out of reach.
    fn encode_run(&self, first: usize, phases_rad: &[f32], field: &mut FieldMut<'_>) -> usize {
        let stride = field.stride();
        let samples = field.run(first, phases_rad.len());
        let flatness = self.flatness_entries.as_ref().map(|all| &all[first..first + phases_rad.len()]);
        match stride {
            1 => self.encode_strided::<1>(phases_rad, flatness, samples),
            _ => self.encode_strided::<{ crate::fields::FIELDS }>(phases_rad, flatness, samples),
        }
    }

    fn encode_flat(&self, first: usize, count: usize, field: &mut FieldMut<'_>) {
        const ZEROS: [f32; BLOCK] = [0.0; BLOCK];
        for start in (0..count).step_by(BLOCK) {
            self.encode_run(first + start, &ZEROS[..BLOCK.min(count - start)], field);
        }
    }

    fn encode_strided<const STRIDE: usize>(
        &self,
        phases_rad: &[f32],
        flatness_entries: Option<&[f32]>,
        samples: &mut [u16],
    ) -> usize {
        let entries_per_rad = (self.table.len() as f64 / TAU) as f32;
        let mask = self.table.len() as u32 - 1;
        let mut indices = [0u16; BLOCK];
        let mut unreachable = 0;
        for (block, phases_rad) in phases_rad.chunks(BLOCK).enumerate() {
            let start = block * BLOCK;
            match flatness_entries {
                None => {
                    for (index, &phase) in indices.iter_mut().zip(phases_rad) {
                        *index = entry_index(phase * entries_per_rad, mask);
                    }
                }
                Some(flatness) => {
                    for ((index, &phase), &flat) in indices.iter_mut().zip(phases_rad).zip(&flatness[start..]) {
                        *index = entry_index(phase * entries_per_rad + flat, mask);
                    }
                }
            }
            let samples = samples[start * STRIDE..].iter_mut().step_by(STRIDE);
            for (sample, &index) in samples.zip(&indices[..phases_rad.len()]) {
                let entry = self.table[usize::from(index)];
                unreachable += usize::from(entry / UNREACHABLE);
                *sample = entry % UNREACHABLE;
            }
        }
        unreachable
    }

    fn phase_shown(&self, pixel: usize, level: u16) -> f32 {
        let level_rad = f64::from(self.phase_of_level_rad[usize::from(level)]);
        let entries = self.table.len() as f64;
        let flat_rad = self.flatness_entries.as_ref().map_or(0.0, |flat| f64::from(flat[pixel]) / entries * TAU);
        wrapped_f32(level_rad - flat_rad)
    }
}

/// The table entry that holds a phase given in entries: its floor, wrapped.
#[inline(always)]
fn entry_index(phase_entries: f32, mask: u32) -> u16 {
    (((phase_entries - 0.5) + TO_INTEGER).to_bits() & mask) as u16
}

/// `phase_rad` on [0, 2π), also after rounding to `f32`.
fn wrapped_f32(phase_rad: f64) -> f32 {
    let wrapped = phase_rad.rem_euclid(TAU) as f32;
    if f64::from(wrapped) < TAU { wrapped } else { 0.0 }
}

/// Phase at each level, unwrapped, with the panel's sign.
fn signed_phases(panel: &Panel, colour: Colour) -> Result<Vec<f64>, LevelsError> {
    let levels = 1usize << panel.bit_depth;
    let sign = match panel.phase_sign {
        PhaseSign::Positive => 1.0,
        PhaseSign::Negative => -1.0,
    };
    let Some(lut_rad) = &panel.lut_rad[colour] else {
        let stroke_rad = panel.stroke_rad[colour];
        if !(stroke_rad.is_finite() && stroke_rad > 0.0) {
            return Err(LevelsError::Stroke { colour, found: stroke_rad });
        }
        return Ok((0..levels).map(|level| sign * stroke_rad * level as f64 / (levels - 1) as f64).collect());
    };
    if lut_rad.len() != levels {
        return Err(LevelsError::LutLength { colour, found: lut_rad.len(), expected: levels });
    }
    if let Some(level) = lut_rad.iter().position(|phase| !phase.is_finite()) {
        return Err(LevelsError::LutShape { colour, level });
    }
    let falls = lut_rad[levels - 1] < lut_rad[0];
    let wrong = |pair: &[f64]| if falls { pair[1] > pair[0] } else { pair[1] < pair[0] };
    if let Some(level) = lut_rad.windows(2).position(wrong) {
        return Err(LevelsError::LutShape { colour, level: level + 1 });
    }
    if lut_rad[levels - 1] == lut_rad[0] {
        return Err(LevelsError::LutShape { colour, level: levels - 1 });
    }
    match (falls, panel.phase_sign) {
        (true, PhaseSign::Positive) => Err(LevelsError::LutSign { colour }),
        (true, PhaseSign::Negative) => Ok(lut_rad.clone()),
        (false, _) => Ok(lut_rad.iter().map(|phase| sign * phase).collect()),
    }
}

/// For each of `16·L` equal ranges of the circle, the level nearest to its middle among the first turn of levels.
fn nearest_level_table(signed_rad: &[f64]) -> Vec<u16> {
    // Rounding noise of the levels' own arithmetic, so that a stroke of exactly 2π closes on level 0.
    const CLOSES_RAD: f64 = 1e-9;
    let in_first_turn = |level: &usize| (signed_rad[*level] - signed_rad[0]).abs() < TAU - CLOSES_RAD;
    let mut around: Vec<(f64, u16)> = (0..signed_rad.len())
        .filter(in_first_turn)
        .map(|level| (signed_rad[level].rem_euclid(TAU), level as u16))
        .collect();
    around.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    // Equal phases are one place on the circle; the lowest level stands for it.
    around.dedup_by(|later, earlier| later.0 == earlier.0);

    let turn_levels = (0..signed_rad.len()).take_while(in_first_turn).count();
    let widest_step_rad =
        signed_rad[..turn_levels].windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);

    let entries = signed_rad.len() * ENTRIES_PER_LEVEL;
    let entry_rad = TAU / entries as f64;
    let level_near = |entry: usize| {
        let phase_rad = (entry as f64 + 0.5) * entry_rad;
        let above = around.partition_point(|&(level_rad, _)| level_rad < phase_rad);
        let candidates = [around[(above + around.len() - 1) % around.len()], around[above % around.len()]];
        let distances = candidates.map(|(level_rad, _)| circle_distance(phase_rad, level_rad));
        let nearer = usize::from(distances[1] < distances[0]);
        let out_of_reach = distances[nearer] > 0.5 * widest_step_rad + 0.5 * entry_rad;
        candidates[nearer].1 | if out_of_reach { UNREACHABLE } else { 0 }
    };
    (0..entries).map(level_near).collect()
}

/// The shorter way round between two phases, 0..=π.
fn circle_distance(a_rad: f64, b_rad: f64) -> f64 {
    let apart = (a_rad - b_rad).rem_euclid(TAU);
    apart.min(TAU - apart)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::FrameLayout;
    use holod_calibration::rig::{PanelMode, Rig};
    use proptest::prelude::*;

    const FULL_STROKE_RAD: f64 = TAU * 255.0 / 256.0;

    fn panel() -> Panel {
        Rig::default().panel
    }

    fn row(pixels: usize) -> Resolution {
        Resolution { width: pixels, height: 1 }
    }

    fn encoded(panel: &Panel, phases_rad: &[f32]) -> (Vec<u16>, f32) {
        let size = row(phases_rad.len());
        let encoder = PanelEncoder::new(panel, size, size).unwrap();
        let mut frame = LevelsFrame::new(FrameLayout::new(panel, size));
        let report = encoder.encode(PerColour([phases_rad; 3]), &mut frame);
        (frame.unpack_colour(Colour::Green).levels, report.unreachable_share[Colour::Green])
    }

    /// The first pixel whose shown phase is farther than `tolerance_rad` from the one asked for.
    fn first_wrong(asked_rad: &[f32], shown_rad: &[f32], tolerance_rad: f64) -> Option<usize> {
        let apart = |(&a, &b): (&f32, &f32)| circle_distance(f64::from(a), f64::from(b)) > tolerance_rad;
        asked_rad.iter().zip(shown_rad).position(apart)
    }

    fn nearest_by_search(panel: &Panel, phase_rad: f64) -> f64 {
        let levels = signed_phases(panel, Colour::Green).unwrap();
        levels.iter().map(|&level_rad| circle_distance(level_rad, phase_rad)).fold(f64::MAX, f64::min)
    }

    #[test]
    fn levels_of_the_default_panel_are_one_256th_of_a_turn_apart() {
        let phases: Vec<f32> = (0..256).map(|level| (TAU * f64::from(level) / 256.0) as f32).collect();
        let (levels, unreachable) = encoded(&panel(), &phases);
        assert_eq!(levels, (0..256).collect::<Vec<u16>>());
        assert_eq!(unreachable, 0.0);
    }

    #[test]
    fn rounding_goes_round_the_circle() {
        let step = TAU / 256.0;
        let phases = [TAU - 0.4 * step, TAU - 0.6 * step, 0.4 * step, 0.6 * step].map(|phase| phase as f32);
        assert_eq!(encoded(&panel(), &phases).0, [0, 255, 0, 1]);
    }

    #[test]
    fn a_stroke_of_a_whole_turn_leaves_its_top_level_unused() {
        let panel = Panel { stroke_rad: PerColour([TAU; 3]), ..panel() };
        let phases: Vec<f32> = (0..5000).map(|part| (TAU * f64::from(part) / 5000.0) as f32).collect();
        let (levels, unreachable) = encoded(&panel, &phases);
        assert_eq!(levels.iter().max(), Some(&254));
        assert_eq!(unreachable, 0.0);
        let half_step = 0.5 * TAU / 255.0;
        assert_eq!(encoded(&panel, &[(TAU - 0.9 * half_step) as f32, (TAU - 1.2 * half_step) as f32]).0, [0, 254]);
    }

    #[test]
    fn a_short_stroke_goes_to_the_nearer_rim_and_says_how_often() {
        let half_turn = Panel { stroke_rad: PerColour([TAU / 2.0; 3]), ..panel() };
        let (levels, unreachable) = encoded(&half_turn, &[0.7, 0.55, 0.8, 0.25].map(|turns: f32| turns * TAU as f32));
        assert_eq!(levels, [255, 255, 0, 128]);
        assert_eq!(unreachable, 0.75);
        let circle: Vec<f32> = (0..8192).map(|part| (TAU * (f64::from(part) + 0.5) / 8192.0) as f32).collect();
        let (_, unreachable) = encoded(&half_turn, &circle);
        assert!((unreachable - 0.5).abs() < 0.01, "{unreachable}");
    }

    #[test]
    fn a_long_stroke_uses_its_first_turn_only() {
        let long = Panel { stroke_rad: PerColour([1.5 * TAU; 3]), ..panel() };
        let circle: Vec<f32> = (0..8192).map(|part| (TAU * (f64::from(part) + 0.5) / 8192.0) as f32).collect();
        let (levels, unreachable) = encoded(&long, &circle);
        assert!(levels.iter().all(|&level| level <= 170));
        assert_eq!(unreachable, 0.0);
    }

    #[test]
    fn phases_outside_the_circle_are_wrapped() {
        let inside = [0.1f32, 3.0, 6.0];
        let outside = [0.1 - TAU as f32, 3.0 + 5.0 * TAU as f32, 6.0 - 7.0 * TAU as f32];
        assert_eq!(encoded(&panel(), &inside).0, encoded(&panel(), &outside).0);
    }

    #[test]
    fn a_negative_sign_turns_the_levels_round() {
        let negative = Panel { phase_sign: PhaseSign::Negative, ..panel() };
        let quarter = [0.25 * TAU as f32];
        assert_eq!(encoded(&panel(), &quarter).0, [64]);
        assert_eq!(encoded(&negative, &quarter).0, [192]);
    }

    #[test]
    fn a_falling_table_is_signed_already() {
        let falling: Vec<f64> = (0..256).map(|level| -FULL_STROKE_RAD * f64::from(level) / 255.0).collect();
        let lut_rad = PerColour([None, Some(falling), None]);
        let negative = Panel { phase_sign: PhaseSign::Negative, lut_rad: lut_rad.clone(), ..panel() };
        assert_eq!(encoded(&negative, &[0.25 * TAU as f32]).0, [192]);
        let positive = Panel { lut_rad, ..panel() };
        let refused = PanelEncoder::new(&positive, row(4), row(4)).unwrap_err();
        assert_eq!(refused, LevelsError::LutSign { colour: Colour::Green });
    }

    #[test]
    fn a_small_pattern_is_centred_in_a_flat_surround() {
        let panel = Panel { mode: PanelMode::FieldSequential, ..panel() };
        let (big, small) = (Resolution { width: 6, height: 5 }, Resolution { width: 3, height: 2 });
        let encoder = PanelEncoder::new(&panel, big, small).unwrap();
        let mut frame = LevelsFrame::new(FrameLayout::new(&panel, big));
        for colour in Colour::ALL {
            frame.field_mut(colour).write(&[99; 30]);
        }
        let half_turn = [TAU as f32 / 2.0; 6];
        encoder.encode(PerColour([&half_turn; 3]), &mut frame);
        let (z, x) = (0, 128);
        let expected =
            [[z, z, z, z, z, z], [z, x, x, x, z, z], [z, x, x, x, z, z], [z, z, z, z, z, z], [z, z, z, z, z, z]];
        let levels = frame.unpack_colour(Colour::Red).levels;
        assert_eq!(levels, expected.concat());
        assert_eq!(first_wrong(&half_turn, &encoder.decode_pattern(Colour::Red, &levels), 1e-6), None);
        encoder.encode_flat(&mut frame);
        assert_eq!(frame.samples(), [0; 90]);
    }

    #[test]
    fn flatness_is_added_before_wrapping_and_taken_off_when_decoded() {
        let flatness = vec![0.75 * TAU as f32, -0.25 * TAU as f32, 0.0];
        let panel = Panel { flatness_rad: PerColour([None, Some(flatness), None]), ..panel() };
        let half_turn = [TAU as f32 / 2.0; 3];
        let (levels, _) = encoded(&panel, &half_turn);
        assert_eq!(levels, [64, 64, 128]);
        let shown = PanelEncoder::new(&panel, row(3), row(3)).unwrap().decode(Colour::Green, &levels);
        assert_eq!(first_wrong(&half_turn, &shown, 1e-6), None);
    }

    #[test]
    fn bad_descriptions_are_refused_with_what_is_wrong() {
        let green = |lut: Vec<f64>| PerColour([None, Some(lut), None]);
        let colour = Colour::Green;
        let mut bent: Vec<f64> = (0..256).map(f64::from).collect();
        bent[100] = 0.0;
        let mut hole = bent.clone();
        hole[7] = f64::NAN;
        let cases = [
            (Panel { bit_depth: 12, ..panel() }, LevelsError::BitDepth { found: 12 }),
            (
                Panel { lut_rad: green(vec![0.0; 255]), ..panel() },
                LevelsError::LutLength { colour, found: 255, expected: 256 },
            ),
            (Panel { lut_rad: green(bent), ..panel() }, LevelsError::LutShape { colour, level: 100 }),
            (Panel { lut_rad: green(hole), ..panel() }, LevelsError::LutShape { colour, level: 7 }),
            (Panel { lut_rad: green(vec![1.0; 256]), ..panel() }, LevelsError::LutShape { colour, level: 255 }),
            (
                Panel { flatness_rad: PerColour([None, Some(vec![0.0; 3]), None]), ..panel() },
                LevelsError::Flatness { colour, found: 3, expected: 4, panel: row(4) },
            ),
            (Panel { stroke_rad: PerColour([1.0, -1.0, 1.0]), ..panel() }, LevelsError::Stroke { colour, found: -1.0 }),
        ];
        for (panel, expected) in cases {
            assert_eq!(PanelEncoder::new(&panel, row(4), row(4)).unwrap_err(), expected);
        }
        let too_big = PanelEncoder::new(&panel(), row(4), row(5)).unwrap_err();
        assert_eq!(too_big, LevelsError::PatternSize { pattern: row(5), panel: row(4) });
    }

    fn panels() -> impl Strategy<Value = Panel> {
        let lut = prop_oneof![
            Just(None),
            (0.3f64..3.0).prop_map(Some), // exponent of a measured, bent response
        ];
        (prop::bool::ANY, prop::bool::ANY, prop::bool::ANY, lut, 0.2f64..1.6).prop_map(
            |(ten_bits, negative, packed, exponent, turns)| {
                let bit_depth = if ten_bits { 10 } else { 8 };
                let top = (1u32 << bit_depth) - 1;
                let bent = exponent.map(|exponent| {
                    (0..=top)
                        .map(|level| 0.3 + turns * TAU * (f64::from(level) / f64::from(top)).powf(exponent))
                        .collect()
                });
                Panel {
                    bit_depth,
                    phase_sign: if negative { PhaseSign::Negative } else { PhaseSign::Positive },
                    mode: if packed { PanelMode::ChannelPacked } else { PanelMode::FieldSequential },
                    stroke_rad: PerColour([turns * TAU; 3]),
                    lut_rad: PerColour([None, bent, None]),
                    ..panel()
                }
            },
        )
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// With any panel, the level shown is the nearest on the circle to within one table entry.
        #[test]
        fn every_phase_goes_to_the_nearest_level(
            panel in panels(), phases in prop::collection::vec(0.0f32..TAU as f32, 1..600),
        ) {
            let levels = encoded(&panel, &phases).0;
            let encoder = PanelEncoder::new(&panel, row(phases.len()), row(phases.len())).unwrap();
            let shown = encoder.decode(Colour::Green, &levels);
            let entry_rad = TAU / (ENTRIES_PER_LEVEL << panel.bit_depth) as f64;
            // In a long stroke a level of the second turn may be nearer: those are left out on purpose.
            let longest = signed_phases(&panel, Colour::Green).unwrap();
            let one_turn = (longest[longest.len() - 1] - longest[0]).abs() < TAU;
            for (&asked, &shown) in phases.iter().zip(&shown).filter(|_| one_turn) {
                let reached = circle_distance(f64::from(asked), f64::from(shown));
                let best = nearest_by_search(&panel, f64::from(asked));
                prop_assert!(reached <= best + entry_rad + 2e-6, "asked {} shown {} best {}", asked, shown, best);
            }
        }

        /// A full-stroke panel shows every phase to within half a step, wherever the pattern sits and whatever the
        /// flatness is.
        #[test]
        fn what_is_encoded_is_shown(
            seed in 0u32..1000, ten_bits in prop::bool::ANY, packed in prop::bool::ANY, negative in prop::bool::ANY,
            width in 1usize..300, height in 1usize..4, more in 0usize..5,
        ) {
            let bit_depth = if ten_bits { 10 } else { 8 };
            let levels = f64::from(1u32 << bit_depth);
            let pattern = Resolution { width, height };
            let size = Resolution { width: width + more, height: height + more };
            let noise = |index: usize| (index as u32).wrapping_mul(2_654_435_761).wrapping_add(seed * 40_503) as f32 / 4.3e9;
            let phases: Vec<f32> = (0..pattern.pixels()).map(|index| noise(index) * TAU as f32).collect();
            let flatness: Vec<f32> = (0..size.pixels()).map(|index| (noise(index + 7) - 0.5) * 40.0).collect();
            let panel = Panel {
                bit_depth,
                mode: if packed { PanelMode::ChannelPacked } else { PanelMode::FieldSequential },
                phase_sign: if negative { PhaseSign::Negative } else { PhaseSign::Positive },
                stroke_rad: PerColour([TAU * (levels - 1.0) / levels; 3]),
                flatness_rad: PerColour([Some(flatness), None, None]),
                ..panel()
            };
            let encoder = PanelEncoder::new(&panel, size, pattern).unwrap();
            let mut frame = LevelsFrame::new(FrameLayout::new(&panel, size));
            let report = encoder.encode(PerColour([&phases; 3]), &mut frame);
            prop_assert_eq!(report, EncodeReport::default());
            let half_step_rad = TAU / levels / 2.0 + 2e-5;
            for colour in Colour::ALL {
                let mut levels = frame.unpack_colour(colour).levels;
                prop_assert_eq!(first_wrong(&phases, &encoder.decode_pattern(colour, &levels), half_step_rad), None);
                // Canary: a first pixel that is two levels off is found.
                let (left, top) = encoder.pattern_origin();
                let first = top * size.width + left;
                levels[first] = (levels[first] + 2) % (1 << bit_depth);
                prop_assert_eq!(first_wrong(&phases, &encoder.decode_pattern(colour, &levels), half_step_rad), Some(0));
            }
        }
    }
}
