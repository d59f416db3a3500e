//! Phase in radians to the panel's levels, and back to the phase that the panel shows.
//!
//! The one place that knows the panel's look-up tables, stroke, phase sign and flatness. Nothing else is done to a
//! level: no sRGB curve, no dithering.
//!
//! **Rounding.** Phase lives on a circle, so a phase goes to the level whose phase is nearest *on the circle*. A linear
//! panel of L levels whose stroke is 2π·(L−1)/L has its levels 2π/L apart all the way round, and a phase just below 2π
//! rounds up to level 0. A stroke of exactly 2π makes the top level a second name of level 0; it is then not used.
//!
//! **Other strokes.** Below 2π·(L−1)/L there is a gap on the circle that no level reaches; the panel's `out_of_stroke`
//! says where a phase in it goes, and [`EncodeReport`] counts the pixels whose phase lies farther from every level than
//! half of the widest step elsewhere. Above 2π only the first full turn of levels is used, so that neighbouring pixels
//! differ by as little drive as possible.
//!
//! **Few levels.** A table may name some of the panel's levels only, as irregular as they are and with phases in any
//! order: a phase goes to the nearest of them on the circle, and the others are never sent.
//!
//! **Speed.** A table of 16 entries for each level (4096 for 8 bits) maps phase to level. Each entry holds the best
//! level for the middle of its range, so the level found may be farther from the phase than the nearest one by at most
//! the width of an entry, 2π/(16·L), a sixteenth of a level's step; where levels are 2π/L apart the steps' borders fall
//! on the entries' borders and it is the nearest one. With 16 bits there is one entry for each level.

use std::f32::consts::FRAC_PI_2;
use std::f64::consts::TAU;

use holod_calibration::rig::{LevelPhase, OutOfStroke, Panel, PanelMode, PhaseSign};
use holod_calibration::{Colour, LevelTables, PerColour, Resolution};
use rayon::prelude::*;

use crate::fields::{FrameLayout, LevelsFrame, Strided, SurroundId};

/// Table entries for each level, as far as [`ENTRIES_MAX`] allows.
const ENTRIES_PER_LEVEL: usize = 16;
/// Table entries at most, so that 16 bits number them.
const ENTRIES_MAX: usize = 1 << 16;
/// Marks table entries whose phase no level reaches.
const UNREACHABLE: u32 = LevelTables::UNREACHABLE;
/// Pixels whose table indices are computed together, so that the arithmetic is vectorised apart from the look-ups.
const BLOCK: usize = 256;
/// Adding 1.5·2²³ to a small `f32` leaves its nearest integer, in two's complement, in the low bits of the sum.
const TO_INTEGER: f32 = 12_582_912.0;

/// Why a panel's description cannot be used for encoding.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum LevelsError {
    /// A bit depth that the panel's packing does not carry.
    #[error(
        "panel.bit_depth is {found}, but panel.packing = \"{packing}\" carries {carried} bits: correct one of the two in the rig file"
    )]
    BitDepth {
        found: u8,
        packing: &'static str,
        /// The bits that it carries.
        carried: u8,
    },
    /// Levels that need several channels where each channel of the video carries a field of its own.
    #[error(
        "panel.packing is \"{packing}\" in mode channel-packed; expected gray or gray10, as red, green and blue each carry a field of their own: use mode field-sequential, or 8 bits"
    )]
    PackedDepth { packing: &'static str },
    /// A stroke that is no positive number.
    #[error("the {colour} stroke is {found} rad; expected a positive number: correct panel.stroke of the rig file")]
    Stroke { colour: Colour, found: f64 },
    /// A look-up table with too few entries, or with a level that is out of order or that the panel does not have.
    #[error(
        "the {colour} look-up table has level {found} as its entry {entry}; expected levels that rise, two at least, all below {levels}: write the table again"
    )]
    LutLevel {
        colour: Colour,
        /// Position of the first entry that is wrong, from 0; the number of entries where they are too few.
        entry: usize,
        found: u16,
        /// Levels of the panel.
        levels: usize,
    },
    /// A look-up table that turns round, is flat, or is not finite.
    #[error(
        "the {colour} look-up table is flat, not monotonic or not finite at level {level}: smooth or measure it again"
    )]
    LutShape {
        colour: Colour,
        /// The first level at which it goes wrong.
        level: u16,
    },
    /// A falling look-up table on a panel that is said to rise.
    #[error(
        "the {colour} look-up table falls with the level but panel.phase_sign is positive: set it to negative, or correct the table"
    )]
    LutSign { colour: Colour },
    /// A flatness picture of another size than the panel, or with a value that is not finite.
    #[error(
        "the {colour} flatness has {found} usable values; expected {expected} ({panel}): make it at the panel's own size"
    )]
    Flatness {
        colour: Colour,
        /// Values of the table that are finite.
        found: usize,
        /// Pixels of the panel.
        expected: usize,
        panel: Resolution,
    },
    /// A pattern that does not fit on the panel.
    #[error("the pattern is {pattern} pixels, the panel {panel}: render a pattern that is no larger than the panel")]
    PatternSize { pattern: Resolution, panel: Resolution },
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
    layout: FrameLayout,
    pattern: Resolution,
    /// Whether a pattern's columns run the other way on the panel, and whether its rows do.
    mirrors: [bool; 2],
    colours: [ColourEncoder; 3],
    surround: SurroundId,
}

#[derive(Clone, Debug)]
struct ColourEncoder {
    /// The level of each phase bin.
    table: Vec<u16>,
    /// 1 for each phase bin whose level is not near; none where there is no such bin.
    unreachable: Option<Vec<u8>>,
    /// Phase that each level shows on a flat panel, with its whole turns; not a number where the panel's table leaves
    /// it out.
    phase_of_level_rad: Vec<f32>,
    /// Phase to add at each panel pixel, in table entries, [0, table length).
    flatness_entries: Option<Vec<f32>>,
}

impl PanelEncoder {
    /// An encoder for `panel` of `panel_resolution` pixels, for patterns of `pattern_resolution` pixels, which are
    /// centred on the panel (half a pixel up and left where the difference is odd). What is around them is dark behind
    /// the stop that passes half of the band, as a double-phase pattern of nothing: π/2 where x + y of the pattern,
    /// gone on with, is odd and −π/2 where it is even. Phase 0 would pass the stop whole, and outshine white.
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
        let (found, carried) = (panel.bit_depth, panel.packing.bit_depth());
        if found != carried {
            return Err(LevelsError::BitDepth { found, packing: panel.packing.name(), carried });
        }
        if panel.mode == PanelMode::ChannelPacked && !panel.packing.fits_a_channel() {
            return Err(LevelsError::PackedDepth { packing: panel.packing.name() });
        }
        if pattern_resolution.width > panel_resolution.width || pattern_resolution.height > panel_resolution.height {
            return Err(LevelsError::PatternSize { pattern: pattern_resolution, panel: panel_resolution });
        }
        let of = |colour| ColourEncoder::new(panel, panel_resolution, colour);
        let colours = [of(Colour::Red)?, of(Colour::Green)?, of(Colour::Blue)?];
        Ok(Self {
            layout: FrameLayout::new(panel, panel_resolution),
            pattern: pattern_resolution,
            mirrors: panel.orientation.mirrors(),
            colours,
            surround: SurroundId::new(),
        })
    }

    /// Pixels of the patterns that are encoded.
    pub fn pattern_resolution(&self) -> Resolution {
        self.pattern
    }

    /// Pixels of the panel.
    pub fn panel_resolution(&self) -> Resolution {
        self.layout.resolution
    }

    /// The layout of the frames that are written.
    pub fn layout(&self) -> FrameLayout {
        self.layout
    }

    /// The encoder as plain data.
    pub fn tables(&self) -> LevelTables {
        let (left, top) = self.pattern_origin();
        let of = |colour: Colour| &self.colours[colour.index()];
        LevelTables {
            panel: self.layout.resolution,
            pattern: self.pattern,
            origin: [left, top],
            mirrors: self.mirrors,
            interleaved: self.layout.mode == PanelMode::ChannelPacked,
            field_order: self.layout.field_order,
            levels: PerColour(Colour::ALL.map(|colour| of(colour).levels_and_marks())),
            flatness: PerColour(Colour::ALL.map(|colour| of(colour).flatness_entries.clone())),
        }
    }

    /// Encodes three patterns into `frame`: each phase in radians `[height, width]`, row-major, nominally in [0, 2π);
    /// phases within ±50 turns are wrapped. What is around them is written where the frame does not have it yet from
    /// an earlier pattern. The threads of the rayon pool that this is called in share the rows; called from one of them
    /// it does not allocate.
    ///
    /// # Panics
    /// Where a pattern or the frame has another size than the encoder was made for.
    pub fn encode(&self, phase_rad: PerColour<&[f32]>, frame: &mut LevelsFrame) -> EncodeReport {
        assert_eq!(frame.layout(), self.layout, "a frame has the panel's layout");
        for (_, phase_rad) in phase_rad.iter() {
            assert_eq!(phase_rad.len(), self.pattern.pixels(), "a pattern has one phase for each pixel");
        }
        let has_surround = frame.surround == Some(self.surround);
        let rows = frame.par_rows_mut().map(|mut row| {
            let mut unreachable = [0; 3];
            let y = row.row;
            row.for_each(|colour, mut samples| {
                if !has_surround {
                    self.encode_surround(colour, y, &mut samples);
                }
                unreachable[colour.index()] = self.encode_row(colour, y, phase_rad[colour], &mut samples);
            });
            unreachable
        });
        let unreachable = rows.reduce(|| [0; 3], |one, other| [0, 1, 2].map(|colour| one[colour] + other[colour]));
        frame.surround = Some(self.surround);
        let share = |count| count as f32 / self.pattern.pixels().max(1) as f32;
        EncodeReport { unreachable_share: PerColour(unreachable.map(share)) }
    }

    /// Encodes what `colour` shows around its pattern in row `y` of the panel.
    fn encode_surround(&self, colour: Colour, y: usize, samples: &mut Strided<'_>) {
        let encoder = &self.colours[colour.index()];
        let (left, top) = self.pattern_origin();
        let width = self.layout.resolution.width;
        let first = y * width;
        let [mirrors_x, mirrors_y] = self.mirrors;
        let Resolution { width: pattern_width, height: pattern_height } = self.pattern;
        // Of the pattern's own column and row, gone on with beyond its edges.
        let turned = usize::from(mirrors_x) * (pattern_width + 1) + usize::from(mirrors_y) * (pattern_height + 1);
        let is_odd = |x: usize| (x + left + y + top + turned) % 2 == 1;
        if y < top || y >= top + pattern_height {
            encoder.encode_dark(first, width, is_odd(0), samples);
            return;
        }
        let right = left + pattern_width;
        encoder.encode_dark(first, left, is_odd(0), samples);
        encoder.encode_dark(first + right, width - right, is_odd(right), &mut samples.from(right));
    }

    /// Encodes what `colour` shows of its pattern in row `y` of the panel; returns how many of its pixels are out of
    /// reach.
    fn encode_row(&self, colour: Colour, y: usize, phase_rad: &[f32], samples: &mut Strided<'_>) -> usize {
        let encoder = &self.colours[colour.index()];
        let (left, top) = self.pattern_origin();
        let Resolution { width, height } = self.pattern;
        if y < top || y >= top + height {
            return 0;
        }
        let [mirrors_x, mirrors_y] = self.mirrors;
        let row = if mirrors_y { height - 1 - (y - top) } else { y - top };
        let (phases_rad, first) = (&phase_rad[row * width..][..width], y * self.layout.resolution.width + left);
        match mirrors_x {
            false => encoder.encode_run(first, phases_rad, &mut samples.from(left)),
            true => encoder.encode_mirrored(first, phases_rad, &mut samples.from(left)),
        }
    }

    /// Encodes the flat pattern, phase 0 everywhere, in every colour.
    ///
    /// # Panics
    /// Where the frame has another size than the encoder was made for.
    pub fn encode_flat(&self, frame: &mut LevelsFrame) {
        assert_eq!(frame.layout(), self.layout, "a frame has the panel's layout");
        frame.par_rows_mut().for_each(|mut row| {
            let first = row.row * self.layout.resolution.width;
            row.for_each(|colour, mut samples| {
                self.colours[colour.index()].encode_flat(first, self.layout.resolution.width, &mut samples);
            });
        });
    }

    /// The index of the first of `levels` that the panel, or the table of `colour`, does not have: what phase it shows
    /// is not known.
    pub fn unknown_level(&self, colour: Colour, levels: &[u16]) -> Option<usize> {
        levels.iter().position(|&level| self.phase_of_level(colour, level).is_none())
    }

    /// The phase in [0, 2π) that the panel really shows for `levels` `[panel height, panel width]`, with the panel's
    /// own unflatness (which the flatness picture cancels) taken into account.
    ///
    /// # Panics
    /// Where `levels` has another number of pixels than the panel, or holds a level that the panel, or the table of
    /// `colour`, does not have.
    pub fn decode(&self, colour: Colour, levels: &[u16]) -> Vec<f32> {
        assert_eq!(levels.len(), self.layout.resolution.pixels(), "a field has one level for each panel pixel");
        let encoder = &self.colours[colour.index()];
        (0..levels.len()).map(|pixel| wrapped_f32(encoder.phase_shown(pixel, levels[pixel]))).collect()
    }

    /// As [`Self::decode`], for the part of the panel that carries the pattern: `[pattern height, pattern width]`.
    ///
    /// # Panics
    /// As [`Self::decode`].
    pub fn decode_pattern(&self, colour: Colour, levels: &[u16]) -> Vec<f32> {
        self.of_pattern(&self.decode(colour, levels))
    }

    /// As [`Self::decode_pattern`], with the whole turns of each level's phase: what the liquid crystal does, which
    /// light of another wavelength meets too. The panel's own unflatness is known to a turn only.
    ///
    /// # Panics
    /// As [`Self::decode`].
    pub fn decode_unwrapped(&self, colour: Colour, levels: &[u16]) -> Vec<f32> {
        assert_eq!(levels.len(), self.layout.resolution.pixels(), "a field has one level for each panel pixel");
        let encoder = &self.colours[colour.index()];
        let shown: Vec<f32> =
            levels.iter().enumerate().map(|(pixel, &level)| encoder.phase_shown(pixel, level) as f32).collect();
        self.of_pattern(&shown)
    }

    /// The phase in radians, with its whole turns, that a flat panel shows for each of `phases_rad`, which are wrapped.
    pub fn shown_when_flat(&self, colour: Colour, phases_rad: &[f32]) -> Vec<f32> {
        let encoder = &self.colours[colour.index()];
        let mut levels = vec![0; phases_rad.len()];
        encoder.encode_strided::<1>(phases_rad, None, &mut levels);
        levels.into_iter().map(|level| encoder.phase_of_level_rad[usize::from(level)]).collect()
    }

    /// The phase in radians, with its whole turns, that a flat panel shows at `level`; `None` where the panel, or the
    /// table of `colour`, does not have it.
    pub fn phase_of_level(&self, colour: Colour, level: u16) -> Option<f32> {
        let phase_rad = self.colours[colour.index()].phase_of_level_rad.get(usize::from(level));
        phase_rad.copied().filter(|phase_rad| phase_rad.is_finite())
    }

    /// The part of a panel's values that carries the pattern.
    fn of_pattern(&self, values: &[f32]) -> Vec<f32> {
        let ((left, top), [mirrors_x, mirrors_y]) = (self.pattern_origin(), self.mirrors);
        let Resolution { width, height } = self.pattern;
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let placed = pixels.map(|(x, y)| {
            let column = if mirrors_x { width - 1 - x } else { x };
            let row = if mirrors_y { height - 1 - y } else { y };
            values[(top + row) * self.layout.resolution.width + left + column]
        });
        placed.collect()
    }

    fn pattern_origin(&self) -> (usize, usize) {
        (
            (self.layout.resolution.width - self.pattern.width) / 2,
            (self.layout.resolution.height - self.pattern.height) / 2,
        )
    }
}

impl ColourEncoder {
    fn new(panel: &Panel, resolution: Resolution, colour: Colour) -> Result<Self, LevelsError> {
        let signed = signed_phases(panel, colour)?;
        let table = level_table(&signed, panel.bit_depth, panel.out_of_stroke);
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
        let mut phase_of_level_rad = vec![f32::NAN; 1 << panel.bit_depth];
        for LevelPhase { level, phase_rad } in signed {
            phase_of_level_rad[usize::from(level)] = phase_rad as f32;
        }
        let unreachable: Vec<_> = table.iter().map(|entry| (entry / UNREACHABLE) as u8).collect();
        Ok(Self {
            table: table.into_iter().map(|entry| entry as u16).collect(),
            unreachable: unreachable.contains(&1).then_some(unreachable),
            phase_of_level_rad,
            flatness_entries,
        })
    }

    /// The level of each phase bin, with [`UNREACHABLE`] set where it is not near.
    fn levels_and_marks(&self) -> Vec<u32> {
        let mark = |bin: usize| self.unreachable.as_ref().map_or(0, |all| u32::from(all[bin]) * UNREACHABLE);
        self.table.iter().enumerate().map(|(bin, &level)| u32::from(level) | mark(bin)).collect()
    }

    /// Encodes `phases_rad` into the panel pixels from `first` on, of which `samples` are; returns how many are out of
    /// reach.
    fn encode_run(&self, first: usize, phases_rad: &[f32], samples: &mut Strided<'_>) -> usize {
        let flatness = self.flatness_entries.as_ref().map(|all| &all[first..first + phases_rad.len()]);
        match samples.stride {
            1 => self.encode_strided::<1>(phases_rad, flatness, samples.samples),
            _ => self.encode_strided::<{ crate::fields::FIELDS }>(phases_rad, flatness, samples.samples),
        }
    }

    /// As [`Self::encode_run`], the last phase first.
    fn encode_mirrored(&self, first: usize, phases_rad: &[f32], samples: &mut Strided<'_>) -> usize {
        let mut unreachable = 0;
        let mut mirrored = [0.0; BLOCK];
        for (block, phases_rad) in phases_rad.rchunks(BLOCK).enumerate() {
            let (start, run) = (block * BLOCK, &mut mirrored[..phases_rad.len()]);
            run.iter_mut().zip(phases_rad.iter().rev()).for_each(|(to, from)| *to = *from);
            unreachable += self.encode_run(first + start, run, &mut samples.from(start));
        }
        unreachable
    }

    fn encode_flat(&self, first: usize, count: usize, samples: &mut Strided<'_>) {
        self.encode_repeated(&[0.0; BLOCK], first, count, samples);
    }

    /// Double phase of amplitude 0, from a pixel on whose x + y is odd or even.
    fn encode_dark(&self, first: usize, count: usize, is_odd: bool, samples: &mut Strided<'_>) {
        const FROM_EVEN: [f32; BLOCK + 1] = {
            let mut phases_rad = [-FRAC_PI_2; BLOCK + 1];
            let mut x = 1;
            while x <= BLOCK {
                phases_rad[x] = FRAC_PI_2;
                x += 2;
            }
            phases_rad
        };
        let from = usize::from(is_odd);
        self.encode_repeated(&FROM_EVEN[from..from + BLOCK], first, count, samples);
    }

    fn encode_repeated(&self, block_rad: &[f32], first: usize, count: usize, samples: &mut Strided<'_>) {
        for start in (0..count).step_by(block_rad.len()) {
            let run = &block_rad[..block_rad.len().min(count - start)];
            self.encode_run(first + start, run, &mut samples.from(start));
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
            let indices = &indices[..phases_rad.len()];
            let samples = samples[start * STRIDE..].iter_mut().step_by(STRIDE);
            for (sample, &index) in samples.zip(indices) {
                *sample = self.table[usize::from(index)];
            }
            if let Some(marks) = &self.unreachable {
                unreachable += indices.iter().map(|&index| usize::from(marks[usize::from(index)])).sum::<usize>();
            }
        }
        unreachable
    }

    /// The phase that `level` shows at `pixel`, with its whole turns.
    fn phase_shown(&self, pixel: usize, level: u16) -> f64 {
        let level_rad = f64::from(self.phase_of_level_rad[usize::from(level)]);
        assert!(level_rad.is_finite(), "level {level} is not in the panel's table");
        let entries = self.table.len() as f64;
        let flat_rad = self.flatness_entries.as_ref().map_or(0.0, |flat| f64::from(flat[pixel]) / entries * TAU);
        level_rad - flat_rad
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

/// The levels that may be used, rising, with the phase at each and the panel's sign; unwrapped where the levels are all
/// there.
fn signed_phases(panel: &Panel, colour: Colour) -> Result<Vec<LevelPhase>, LevelsError> {
    let levels = 1usize << panel.bit_depth;
    let sign = match panel.phase_sign {
        PhaseSign::Positive => 1.0,
        PhaseSign::Negative => -1.0,
    };
    let Some(lut) = &panel.lut[colour] else {
        let stroke_rad = panel.stroke_rad[colour];
        if !(stroke_rad.is_finite() && stroke_rad > 0.0) {
            return Err(LevelsError::Stroke { colour, found: stroke_rad });
        }
        let phase_rad = |level| sign * stroke_rad * level as f64 / (levels - 1) as f64;
        return Ok((0..levels).map(|level| LevelPhase { level: level as u16, phase_rad: phase_rad(level) }).collect());
    };
    let wrong_level = |entry: usize| {
        let found = lut.get(entry).or(lut.last()).map_or(0, |last| last.level);
        LevelsError::LutLevel { colour, entry, found, levels }
    };
    if lut.len() < 2 {
        return Err(wrong_level(lut.len()));
    }
    if let Some(entry) = lut.iter().position(|entry| usize::from(entry.level) >= levels) {
        return Err(wrong_level(entry));
    }
    if let Some(before) = lut.windows(2).position(|pair| pair[1].level <= pair[0].level) {
        return Err(wrong_level(before + 1));
    }
    if let Some(entry) = lut.iter().find(|entry| !entry.phase_rad.is_finite()) {
        return Err(LevelsError::LutShape { colour, level: entry.level });
    }
    let [first, last] = [lut[0], lut[lut.len() - 1]];
    if lut.iter().all(|entry| entry.phase_rad == first.phase_rad) {
        return Err(LevelsError::LutShape { colour, level: last.level });
    }
    let falls = last.phase_rad < first.phase_rad;
    let turns_round = |pair: &[LevelPhase]| {
        if falls { pair[1].phase_rad > pair[0].phase_rad } else { pair[1].phase_rad < pair[0].phase_rad }
    };
    if let Some(before) = lut.windows(2).position(turns_round) {
        if lut.len() == levels {
            return Err(LevelsError::LutShape { colour, level: lut[before + 1].level });
        }
        // Levels in no order: their phases stand as they are.
        return Ok(lut.clone());
    }
    match (falls, panel.phase_sign) {
        (true, PhaseSign::Positive) => Err(LevelsError::LutSign { colour }),
        (true, PhaseSign::Negative) => Ok(lut.clone()),
        (false, _) => Ok(lut.iter().map(|&entry| LevelPhase { phase_rad: sign * entry.phase_rad, ..entry }).collect()),
    }
}

/// The levels on the circle, in the order in which one meets them from the beginning of the stroke on.
struct Arc {
    /// Phase at the beginning.
    start_rad: f64,
    /// The sense of going round: 1 or −1.
    sense: f64,
    /// How far round each level is, rising from 0, below 2π; and the level.
    levels: Vec<(f64, u16)>,
}

impl Arc {
    fn of(signed: &[LevelPhase]) -> Self {
        // Rounding noise of the levels' own arithmetic, so that a stroke of exactly 2π closes on level 0.
        const CLOSES_RAD: f64 = 1e-9;
        let phases = || signed.iter().map(|entry| entry.phase_rad);
        let rises = phases().is_sorted();
        let mut arc = if rises || phases().is_sorted_by(|a, b| a >= b) {
            let start_rad = signed[0].phase_rad;
            let from_start = signed.iter().map(|entry| ((entry.phase_rad - start_rad).abs(), entry.level));
            let levels = from_start.take_while(|(round_rad, _)| *round_rad < TAU - CLOSES_RAD).collect();
            Self { start_rad, sense: if rises { 1.0 } else { -1.0 }, levels }
        } else {
            let mut levels: Vec<_> =
                signed.iter().map(|entry| (entry.phase_rad.rem_euclid(TAU), entry.level)).collect();
            levels.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            let gap_before = |index: usize| {
                let before = levels[(index + levels.len() - 1) % levels.len()].0;
                if index == 0 { levels[0].0 + TAU - before } else { levels[index].0 - before }
            };
            let widest = |best: usize, next: usize| if gap_before(next) > gap_before(best) { next } else { best };
            let first = (0..levels.len()).fold(0, widest);
            let start_rad = levels[first].0;
            levels.rotate_left(first);
            let levels =
                levels.into_iter().map(|(phase, level)| ((phase - start_rad).rem_euclid(TAU), level)).collect();
            Self { start_rad, sense: 1.0, levels }
        };
        // Equal phases are one place on the circle; the lowest level stands for it.
        arc.levels.dedup_by(|later, earlier| later.0 == earlier.0);
        arc
    }

    /// How far round the last level is.
    fn length_rad(&self) -> f64 {
        self.levels[self.levels.len() - 1].0
    }

    fn widest_step_rad(&self) -> f64 {
        self.levels.windows(2).map(|pair| pair[1].0 - pair[0].0).fold(0.0, f64::max)
    }

    /// The level that is nearest on the circle to the place `round_rad`, in 0..2π, and its distance.
    fn nearest(&self, round_rad: f64) -> (u16, f64) {
        let above = self.levels.partition_point(|&(level_rad, _)| level_rad < round_rad);
        let candidates = [(above + self.levels.len() - 1) % self.levels.len(), above % self.levels.len()];
        let [before, after] =
            candidates.map(|index| (self.levels[index].1, circle_distance(round_rad, self.levels[index].0)));
        if after.1 < before.1 { after } else { before }
    }
}

/// For each of the equal ranges of the circle, the level for its middle, and whether that is out of reach.
fn level_table(signed: &[LevelPhase], bit_depth: u8, out_of_stroke: OutOfStroke) -> Vec<u32> {
    let arc = Arc::of(signed);
    let entries = (ENTRIES_PER_LEVEL << bit_depth).min(ENTRIES_MAX);
    let entry_rad = TAU / entries as f64;
    let reach_rad = 0.5 * (arc.widest_step_rad() + entry_rad);
    let (length_rad, last) = (arc.length_rad(), arc.levels[arc.levels.len() - 1].1);
    let has_gap = TAU - length_rad > 2.0 * reach_rad;
    let level_of = |entry: usize| {
        let phase_rad = (entry as f64 + 0.5) * entry_rad;
        let round_rad = (arc.sense * (phase_rad - arc.start_rad)).rem_euclid(TAU);
        let (nearest, distance_rad) = arc.nearest(round_rad);
        let is_scaled = out_of_stroke == OutOfStroke::Scale && has_gap;
        let out_of_reach = distance_rad > reach_rad && !is_scaled;
        let level = match out_of_stroke {
            OutOfStroke::Scale if is_scaled => arc.nearest(round_rad * length_rad / TAU).0,
            OutOfStroke::Clip if out_of_reach => last,
            OutOfStroke::Zero if out_of_reach => arc.levels[0].1,
            _ => nearest,
        };
        u32::from(level) | if out_of_reach { UNREACHABLE } else { 0 }
    };
    (0..entries).map(level_of).collect()
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
    use holod_calibration::rig::{Orientation, Packing, Rig};
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
        levels.iter().map(|entry| circle_distance(entry.phase_rad, phase_rad)).fold(f64::MAX, f64::min)
    }

    /// A table for green with a phase for each level from 0 up.
    fn green_lut(phases_rad: &[f64]) -> PerColour<Option<Vec<LevelPhase>>> {
        let entries = phases_rad.iter().enumerate();
        let table = entries.map(|(level, &phase_rad)| LevelPhase { level: level as u16, phase_rad }).collect();
        PerColour([None, Some(table), None])
    }

    /// Seven levels of 256 as irregularly spaced as those of a panel of piston mirrors.
    fn few_levels() -> Vec<LevelPhase> {
        let turns = [(3, 0.0), (40, 0.01), (77, 0.10), (90, 0.31), (130, 0.36), (200, 0.62), (255, 0.81)];
        turns.map(|(level, turns)| LevelPhase { level, phase_rad: turns * TAU }).to_vec()
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
    fn phases_out_of_stroke_go_where_the_rig_says() {
        // A stroke of 0.75 turns over 256 levels: 0.9 turns is nearer to the beginning, 0.85 to the far end.
        let turns = [0.31, 0.74, 0.85, 0.9, 0.9999].map(|turns: f32| turns * TAU as f32);
        let level = |turns: f64| (turns / 0.75 * 255.0).round() as u16;
        let (asked, near_end) = (level(0.31), level(0.74));
        for (out_of_stroke, negative, expected) in [
            (OutOfStroke::Nearest, false, [asked, near_end, 255, 0, 0]),
            (OutOfStroke::Clip, false, [asked, near_end, 255, 255, 0]),
            (OutOfStroke::Zero, false, [asked, near_end, 0, 0, 0]),
            (OutOfStroke::Scale, false, [level(0.2325), level(0.555), level(0.6375), level(0.675), 255]),
            // The levels run the other way: 0.69, 0.26, 0.15, 0.1 and 0.0001 turns round are 0.31, 0.74, 0.85, 0.9 and
            // 0.9999.
            (OutOfStroke::Clip, true, [level(0.69), level(0.26), level(0.15), level(0.1), 0]),
        ] {
            let panel = Panel {
                stroke_rad: PerColour([0.75 * TAU; 3]),
                out_of_stroke,
                phase_sign: if negative { PhaseSign::Negative } else { PhaseSign::Positive },
                ..panel()
            };
            let (levels, unreachable) = encoded(&panel, &turns);
            assert_eq!(levels, expected, "{out_of_stroke:?}");
            // Where every phase is scaled none is out of reach.
            let all_are_reached = negative || out_of_stroke == OutOfStroke::Scale;
            assert_eq!(unreachable, if all_are_reached { 0.0 } else { 0.4 }, "{out_of_stroke:?}");
        }
        let beyond = [0.2, 0.1].map(|turns: f32| turns * TAU as f32);
        let panel = Panel {
            stroke_rad: PerColour([0.75 * TAU; 3]),
            out_of_stroke: OutOfStroke::Clip,
            phase_sign: PhaseSign::Negative,
            ..panel()
        };
        assert_eq!(encoded(&panel, &beyond), (vec![255, 255], 1.0));
    }

    #[test]
    fn a_stroke_without_a_gap_is_never_changed() {
        let circle: Vec<f32> = (0..3000).map(|part| (TAU * f64::from(part) / 3000.0) as f32).collect();
        for stroke_rad in [FULL_STROKE_RAD, TAU, 1.4 * TAU] {
            let plain = Panel { stroke_rad: PerColour([stroke_rad; 3]), ..panel() };
            let expected = encoded(&plain, &circle);
            for out_of_stroke in OutOfStroke::ALL {
                assert_eq!(encoded(&Panel { out_of_stroke, ..plain.clone() }, &circle), expected, "{out_of_stroke:?}");
            }
        }
    }

    #[test]
    fn few_irregular_levels_are_chosen_by_their_phase() {
        let panel = Panel { lut: PerColour([None, Some(few_levels()), None]), ..panel() };
        let phases = [0.0, 0.05, 0.06, 0.2, 0.5, 0.71, 0.72, 0.95].map(|turns: f32| turns * TAU as f32);
        let (levels, unreachable) = encoded(&panel, &phases);
        assert_eq!(levels, [3, 40, 77, 77, 200, 200, 255, 3]);
        assert_eq!(unreachable, 0.0);
        let shown = PanelEncoder::new(&panel, row(8), row(8)).unwrap().decode(Colour::Green, &levels);
        let expected = [0.0, 0.01, 0.1, 0.1, 0.62, 0.62, 0.81, 0.0].map(|turns: f32| turns * TAU as f32);
        assert_eq!(first_wrong(&expected, &shown, 1e-6), None);
    }

    #[test]
    fn levels_in_no_order_are_chosen_all_the_same() {
        let rising = few_levels();
        let mut shuffled = rising.clone();
        for (index, entry) in shuffled.iter_mut().enumerate() {
            // A permutation of the phases, each moved by whole turns.
            let turns = rising[index * 3 % rising.len()].phase_rad / TAU + (index % 3) as f64 - 1.0;
            entry.phase_rad = turns * TAU;
        }
        let panel_of = |table| Panel { lut: PerColour([None, Some(table), None]), ..panel() };
        let circle: Vec<f32> = (0..2000).map(|part| (TAU * (f64::from(part) + 0.5) / 2000.0) as f32).collect();
        let shown = |panel: &Panel| {
            let levels = encoded(panel, &circle).0;
            let encoder = PanelEncoder::new(panel, row(2000), row(2000)).unwrap();
            encoder.decode(Colour::Green, &levels)
        };
        let (ordered, unordered) = (shown(&panel_of(rising)), shown(&panel_of(shuffled)));
        assert_eq!(first_wrong(&ordered, &unordered, 1e-5), None);
    }

    #[test]
    fn levels_outside_the_table_are_found() {
        let panel = Panel { lut: PerColour([None, Some(few_levels()), None]), ..panel() };
        let encoder = PanelEncoder::new(&panel, row(1), row(1)).unwrap();
        assert_eq!(encoder.unknown_level(Colour::Green, &[3, 40, 77, 200, 255]), None);
        assert_eq!(encoder.unknown_level(Colour::Green, &[3, 40, 5, 200]), Some(2));
        assert_eq!(encoder.unknown_level(Colour::Red, &[5, 255]), None);
        assert_eq!(encoder.unknown_level(Colour::Red, &[5, 256]), Some(1));
    }

    #[test]
    #[should_panic(expected = "level 5 is not in the panel's table")]
    fn a_level_outside_the_table_has_no_phase() {
        let panel = Panel { lut: PerColour([None, Some(few_levels()), None]), ..panel() };
        PanelEncoder::new(&panel, row(1), row(1)).unwrap().decode(Colour::Green, &[5]);
    }

    #[test]
    fn sixteen_bits_are_as_fine_as_their_table() {
        let levels = 65536.0;
        let panel = Panel {
            bit_depth: 16,
            packing: Packing::Red8Green8,
            mode: PanelMode::FieldSequential,
            stroke_rad: PerColour([TAU * (levels - 1.0) / levels; 3]),
            ..panel()
        };
        let phases: Vec<f32> = (0..5000).map(|part| (TAU * f64::from(part) / 5000.0) as f32).collect();
        let (levels_sent, unreachable) = encoded(&panel, &phases);
        assert_eq!(unreachable, 0.0);
        let size = row(phases.len());
        let shown = PanelEncoder::new(&panel, size, size).unwrap().decode(Colour::Green, &levels_sent);
        assert_eq!(first_wrong(&phases, &shown, TAU / levels + 2e-6), None);
        assert_eq!(levels_sent.iter().max(), Some(&65522));
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
        let lut = green_lut(&falling);
        let negative = Panel { phase_sign: PhaseSign::Negative, lut: lut.clone(), ..panel() };
        assert_eq!(encoded(&negative, &[0.25 * TAU as f32]).0, [192]);
        let positive = Panel { lut, ..panel() };
        let refused = PanelEncoder::new(&positive, row(4), row(4)).unwrap_err();
        assert_eq!(refused, LevelsError::LutSign { colour: Colour::Green });
    }

    #[test]
    fn a_small_pattern_is_centred_in_a_dark_surround() {
        let panel = Panel { mode: PanelMode::FieldSequential, ..panel() };
        let (big, small) = (Resolution { width: 6, height: 5 }, Resolution { width: 3, height: 2 });
        let encoder = PanelEncoder::new(&panel, big, small).unwrap();
        let mut frame = LevelsFrame::new(FrameLayout::new(&panel, big));
        for colour in Colour::ALL {
            frame.field_mut(colour).write(&[99; 30]);
        }
        let half_turn = [TAU as f32 / 2.0; 6];
        encoder.encode(PerColour([&half_turn; 3]), &mut frame);
        // Pixel (0, 0) of the pattern is even, and so has -π/2 beside it where x + y is even.
        let (o, e, x) = (64, 192, 128);
        let expected =
            [[e, o, e, o, e, o], [o, x, x, x, o, e], [e, x, x, x, e, o], [o, e, o, e, o, e], [e, o, e, o, e, o]];
        let levels = frame.unpack_colour(Colour::Red).levels;
        assert_eq!(levels, expected.concat());
        assert_eq!(first_wrong(&half_turn, &encoder.decode_pattern(Colour::Red, &levels), 1e-6), None);
        encoder.encode_flat(&mut frame);
        assert_eq!(frame.samples(), [0; 90]);
    }

    #[test]
    fn a_surround_is_written_once_and_again_after_anything_else_was() {
        let (big, small, row) = (
            Resolution { width: 6, height: 5 },
            Resolution { width: 3, height: 2 },
            Resolution { width: 5, height: 1 },
        );
        let of = |pattern| PanelEncoder::new(&panel(), big, pattern).unwrap();
        let (encoder, other) = (of(small), of(row));
        let encode = |encoder: &PanelEncoder, frame: &mut LevelsFrame, phase_rad: f32| {
            let pattern = vec![phase_rad; encoder.pattern_resolution().pixels()];
            encoder.encode(PerColour([&pattern; 3]), frame);
        };
        let fresh = |encoder, phase_rad| {
            let mut frame = LevelsFrame::new(FrameLayout::new(&panel(), big));
            encode(encoder, &mut frame, phase_rad);
            frame
        };
        let mut frame = fresh(&encoder, 1.0);
        // The frame cannot see this change, and so its surround shows that it was not written again.
        let first = frame.samples()[0];
        frame.write_unseen(0, 77);
        encode(&encoder, &mut frame, 2.0);
        assert_eq!(frame.samples()[0], 77);
        frame.write_unseen(0, first);
        assert_eq!(frame, fresh(&encoder, 2.0));

        let overwrites: [&dyn Fn(&mut LevelsFrame); 5] = [
            &|frame| encode(&other, frame, 3.0),
            &|frame| encoder.encode_flat(frame),
            &|frame| frame.samples_mut().fill(77),
            &|frame| frame.field_mut(Colour::Blue).write(&[77; 30]),
            &|frame| frame.copy_from(&LevelsFrame::new(FrameLayout::new(&panel(), big))),
        ];
        for (number, overwrite) in overwrites.into_iter().enumerate() {
            let mut frame = fresh(&encoder, 1.0);
            overwrite(&mut frame);
            encode(&encoder, &mut frame, 2.0);
            assert_eq!(frame, fresh(&encoder, 2.0), "after overwrite {number}");
        }
    }

    fn on_panel(orientation: Orientation, size: Resolution, pattern: Resolution, phase_rad: &[f32]) -> Vec<u16> {
        let flatness = (0..size.pixels()).map(|pixel| 0.01 * pixel as f32).collect();
        let panel = Panel {
            mode: PanelMode::FieldSequential,
            orientation,
            flatness_rad: PerColour([None, Some(flatness), None]),
            ..panel()
        };
        let encoder = PanelEncoder::new(&panel, size, pattern).unwrap();
        let mut frame = LevelsFrame::new(FrameLayout::new(&panel, size));
        encoder.encode(PerColour([phase_rad; 3]), &mut frame);
        let green = frame.unpack_colour(Colour::Green).levels;
        assert!(
            first_wrong(phase_rad, &encoder.decode_pattern(Colour::Green, &green), 0.013).is_none(),
            "{orientation:?}"
        );
        frame.unpack_colour(Colour::Red).levels
    }

    #[test]
    fn a_pattern_lies_as_the_rig_says_and_the_flatness_stays() {
        // Wider than a block.
        let (size, pattern) =
            (Resolution { width: 2 * BLOCK + 9, height: 5 }, Resolution { width: BLOCK + 6, height: 2 });
        let level = |x: usize, y: usize| (3 * x + 100 * y) % 256;
        let (xs, ys) = (|x| pattern.width - 1 - x, |y| pattern.height - 1 - y);
        let phase_rad: Vec<f32> = (0..pattern.pixels())
            .map(|pixel| (level(pixel % pattern.width, pixel / pattern.width) as f64 / 256.0 * TAU) as f32)
            .collect();
        let (left, top) = ((size.width - pattern.width) / 2, (size.height - pattern.height) / 2);
        for orientation in Orientation::ALL {
            let levels = on_panel(orientation, size, pattern, &phase_rad);
            for (x, y) in (0..pattern.height).flat_map(|y| (0..pattern.width).map(move |x| (x, y))) {
                let expected = match orientation {
                    Orientation::Normal => level(x, y),
                    Orientation::HalfTurn => level(xs(x), ys(y)),
                    Orientation::MirrorX => level(xs(x), y),
                    Orientation::MirrorY => level(x, ys(y)),
                };
                let found = levels[(top + y) * size.width + left + x];
                assert_eq!(usize::from(found), expected, "{orientation:?} {x} {y}");
            }
        }
    }

    #[test]
    fn the_darkness_around_goes_on_with_that_of_a_pattern_however_it_lies() {
        for (width, height) in [(6, 4), (7, 4), (6, 3), (7, 3)] {
            let (size, pattern) = (Resolution { width: 12, height: 9 }, Resolution { width, height });
            let is_odd = |pixel: usize| (pixel % width + pixel / width) % 2 == 1;
            let phase_rad: Vec<f32> =
                (0..pattern.pixels()).map(|pixel| if is_odd(pixel) { FRAC_PI_2 } else { 3.0 * FRAC_PI_2 }).collect();
            for orientation in Orientation::ALL {
                let levels = on_panel(orientation, size, pattern, &phase_rad);
                let other = |one: u16| if one == 64 { 192 } else { 64 };
                for (pixel, &found) in levels.iter().enumerate() {
                    let (x, y) = (pixel % size.width, pixel / size.width);
                    let expected = if (x + y) % 2 == 0 { levels[0] } else { other(levels[0]) };
                    assert_eq!(found, expected, "{width}x{height} {orientation:?} {x} {y}");
                }
            }
        }
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
    fn whole_turns_are_kept_where_they_are_asked_for() {
        let flatness = vec![0.0, 0.25 * TAU as f32, 0.0];
        let panel = Panel {
            stroke_rad: PerColour([1.5 * TAU; 3]),
            phase_sign: PhaseSign::Negative,
            flatness_rad: PerColour([None, Some(flatness), None]),
            ..panel()
        };
        let encoder = PanelEncoder::new(&panel, row(3), row(3)).unwrap();
        let levels = [0, 170, 255];
        let turns = |phases_rad: Vec<f32>| -> Vec<f64> {
            phases_rad.into_iter().map(|phase_rad| f64::from(phase_rad) / TAU).collect()
        };
        let unwrapped = turns(encoder.decode_unwrapped(Colour::Green, &levels));
        for (turns, expected) in unwrapped.iter().zip([0.0, -1.25, -1.5]) {
            assert!((turns - expected).abs() < 1e-6, "{unwrapped:?}");
        }
        let wrapped = turns(encoder.decode(Colour::Green, &levels));
        for (turns, expected) in wrapped.iter().zip([0.0, 0.75, 0.5]) {
            assert!((turns - expected).abs() < 1e-6, "{wrapped:?}");
        }
    }

    #[test]
    fn bad_descriptions_are_refused_with_what_is_wrong() {
        let colour = Colour::Green;
        let mut bent: Vec<f64> = (0..256).map(f64::from).collect();
        bent[100] = 0.0;
        let mut hole = bent.clone();
        hole[7] = f64::NAN;
        let few = |levels: &[u16]| {
            let table = levels.iter().map(|&level| LevelPhase { level, phase_rad: f64::from(level) }).collect();
            Panel { lut: PerColour([None, Some(table), None]), ..panel() }
        };
        let wrong_level = |entry, found| LevelsError::LutLevel { colour, entry, found, levels: 256 };
        let cases = [
            (Panel { bit_depth: 12, ..panel() }, LevelsError::BitDepth { found: 12, packing: "gray", carried: 8 }),
            (
                Panel { bit_depth: 10, packing: Packing::Red8Green8, ..panel() },
                LevelsError::BitDepth { found: 10, packing: "red8-green8", carried: 16 },
            ),
            (
                Panel { bit_depth: 10, packing: Packing::Red8Blue2, ..panel() },
                LevelsError::PackedDepth { packing: "red8-blue2" },
            ),
            (few(&[]), wrong_level(0, 0)),
            (few(&[9]), wrong_level(1, 9)),
            (few(&[1, 256, 300]), wrong_level(1, 256)),
            (few(&[1, 7, 7]), wrong_level(2, 7)),
            (few(&[1, 7, 6]), wrong_level(2, 6)),
            (Panel { lut: green_lut(&bent), ..panel() }, LevelsError::LutShape { colour, level: 100 }),
            (Panel { lut: green_lut(&hole), ..panel() }, LevelsError::LutShape { colour, level: 7 }),
            (Panel { lut: green_lut(&[1.0; 256]), ..panel() }, LevelsError::LutShape { colour, level: 255 }),
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
                let top = if ten_bits { 1023 } else { 255 };
                let bent = exponent.map(|exponent| -> Vec<f64> {
                    let share = |level| f64::from(level) / f64::from(top);
                    (0..=top).map(|level| 0.3 + turns * TAU * share(level).powf(exponent)).collect()
                });
                Panel {
                    phase_sign: if negative { PhaseSign::Negative } else { PhaseSign::Positive },
                    stroke_rad: PerColour([turns * TAU; 3]),
                    lut: bent.map_or(PerColour([None, None, None]), |bent| green_lut(&bent)),
                    ..driven(ten_bits, packed)
                }
            },
        )
    }

    /// The default panel with ten bits, or with eight in either mode.
    fn driven(ten_bits: bool, packed: bool) -> Panel {
        match (ten_bits, packed) {
            (true, _) => {
                Panel { bit_depth: 10, packing: Packing::Red3Green3Blue4, mode: PanelMode::FieldSequential, ..panel() }
            }
            (false, true) => panel(),
            (false, false) => Panel { mode: PanelMode::FieldSequential, ..panel() },
        }
    }

    /// Tables of 2 to 40 levels at phases of any kind.
    fn few_level_panels() -> impl Strategy<Value = Panel> {
        let table = prop::collection::btree_map(0u16..256, -7.0f64..7.0, 2..40);
        table.prop_map(|table| {
            let table = table.into_iter().map(|(level, phase_rad)| LevelPhase { level, phase_rad }).collect();
            Panel { phase_sign: PhaseSign::Negative, lut: PerColour([None, Some(table), None]), ..panel() }
        })
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
            let one_turn = (longest[longest.len() - 1].phase_rad - longest[0].phase_rad).abs() < TAU;
            for (&asked, &shown) in phases.iter().zip(&shown).filter(|_| one_turn) {
                let reached = circle_distance(f64::from(asked), f64::from(shown));
                let best = nearest_by_search(&panel, f64::from(asked));
                prop_assert!(reached <= best + entry_rad + 2e-6, "asked {} shown {} best {}", asked, shown, best);
            }
        }

        /// The same with few levels: only those of the table are sent, and the nearest of them.
        #[test]
        fn every_phase_goes_to_the_nearest_of_few_levels(
            panel in few_level_panels(), phases in prop::collection::vec(0.0f32..TAU as f32, 1..600),
        ) {
            let signed = signed_phases(&panel, Colour::Green).unwrap();
            let turns = signed[signed.len() - 1].phase_rad - signed[0].phase_rad;
            let monotonic = signed.is_sorted_by(|a, b| (b.phase_rad - a.phase_rad) * turns >= 0.0);
            prop_assume!(!monotonic || turns.abs() < TAU);
            let levels = encoded(&panel, &phases).0;
            let shown = PanelEncoder::new(&panel, row(phases.len()), row(phases.len())).unwrap()
                .decode(Colour::Green, &levels);
            let entry_rad = TAU / (ENTRIES_PER_LEVEL << panel.bit_depth) as f64;
            for (&asked, &shown) in phases.iter().zip(&shown) {
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
                phase_sign: if negative { PhaseSign::Negative } else { PhaseSign::Positive },
                stroke_rad: PerColour([TAU * (levels - 1.0) / levels; 3]),
                flatness_rad: PerColour([Some(flatness), None, None]),
                ..driven(ten_bits, packed)
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
