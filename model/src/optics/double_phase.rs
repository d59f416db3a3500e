//! Double phase: a complex field as a checkerboard of two phases.

use std::f32::consts::TAU;

use holod_calibration::{PerColour, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::{ComplexHologram, PhasePattern};
use crate::phase_math::argument;
use crate::simd::{InstructionSet, Simd, Task};

/// Edge of the tiles of which the rms amplitude is taken, in pixels.
pub(crate) const TILE: usize = 32;
/// A pixel is dark below this share of its tile's rms amplitude,
pub(crate) const DARK_SHARE: f32 = 0.5;
/// at least below this amplitude and at most below that one, in units of the amplitude constant.
pub(crate) const LEAST_DARK: f32 = 0.01;
pub(crate) const MOST_DARK: f32 = 0.08;
/// Pixels of a row that are corrected together.
const RUN: usize = 64;
/// Of the binomial filter 1 4 6 4 1, how far it reaches.
pub(crate) const REACH: usize = 2;
pub(crate) const CORRECTION_GAIN: f32 = 2.0;

/// Encodes complex holograms as phase patterns (Hsueh and Sawchuk 1978; Maimone et al. 2017).
///
/// With a field a = c/K, clipped to |a| ≤ 1, and a unit carrier u, the phases are those of u·(s + j·√(1 − s²)) where
/// x + y is odd and of u·(s − j·√(1 − s²)) where it is even, s = Re(a·u*). With u = a/|a| these are arg c ± acos |a|,
/// and the mean of the two phasors is a. Their difference, a checkerboard of u, is stopped in the Fourier plane only as
/// far as u changes slowly from pixel to pixel, but where there is no light, the phase of c is noise. Therefore:
///
/// - The carrier is smooth where it is dark: a block of 4x4 pixels has the phase of its mean, each quarter of it that
///   of its own mean and a little of the block's, each pixel its own and a little of its quarter's. Means are weighted
///   by intensity. A little is as much as a pixel has that is dark beside its surroundings.
/// - What is still wrong in the band is taken from the phasors: the error, a less the phasor, through a binomial
///   filter, is added to the phasor, twice, before its phase is taken. One step of Gerchberg and Saxton's (1972).
///
/// K is fixed, so brightness does not flicker from frame to frame; what exceeds it is clipped and counted. An eye
/// behind the 4f stop sees c/K, so intensities are multiplied by K² to compare.
///
/// The threads that it works on are those of the [`WorkerPool`](crate::WorkerPool) that it is called in, elsewhere
/// rayon's own.
pub struct DoublePhase {
    resolution: Resolution,
    amplitude_constant: f32,
    /// a of one colour after another, `[height, width]`.
    clipped: Vec<Complex32>,
    error: PairErrors,
    /// Sum of intensities of each tile; of each row of tiles, how many samples were clipped.
    tile_power: Vec<f32>,
    clipped_in_tile_row: Vec<u32>,
    set: InstructionSet,
}

/// a less the pair's phasor, real and imaginary parts.
struct PairErrors {
    re: Vec<f32>,
    im: Vec<f32>,
}

/// What one encoding lost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DoublePhaseReport {
    /// Share of each colour's samples whose amplitude exceeded the constant, 0..=1.
    pub clipped_share: PerColour<f32>,
}

impl DoublePhase {
    /// An encoder for one resolution with a fixed amplitude constant K > 0.
    ///
    /// # Panics
    /// Where K is not positive.
    pub fn new(resolution: Resolution, amplitude_constant: f32) -> Self {
        Self::with_instructions(resolution, amplitude_constant, InstructionSet::best())
    }

    fn with_instructions(resolution: Resolution, amplitude_constant: f32, set: InstructionSet) -> Self {
        assert!(amplitude_constant > 0.0, "the amplitude constant is positive");
        let (samples, tile_rows) = (resolution.pixels(), resolution.height.div_ceil(TILE));
        Self {
            resolution,
            amplitude_constant,
            clipped: vec![Complex32::ZERO; samples],
            error: PairErrors { re: vec![0.0; samples], im: vec![0.0; samples] },
            tile_power: vec![0.0; tile_rows * resolution.width.div_ceil(TILE)],
            clipped_in_tile_row: vec![0; tile_rows],
            set,
        }
    }

    /// Writes the phases of `hologram` to `pattern`, both of this encoder's resolution. Does not allocate in a
    /// [`WorkerPool`](crate::WorkerPool).
    ///
    /// A sample that is not finite, or so large that its square is not, is encoded as darkness and counted as clipped.
    pub fn encode(&mut self, hologram: &ComplexHologram, pattern: &mut PhasePattern) -> DoublePhaseReport {
        assert!(
            hologram.resolution == self.resolution && pattern.resolution == self.resolution,
            "hologram {}, pattern {} and encoder {} have one resolution",
            hologram.resolution,
            pattern.resolution,
            self.resolution
        );
        let planes =
            hologram.field.chunks_exact(self.clipped.len()).zip(pattern.phase_rad.chunks_exact_mut(self.clipped.len()));
        let mut clipped_share = PerColour([0.0; 3]);
        for (share, (field, phase_rad)) in clipped_share.0.iter_mut().zip(planes) {
            *share = (self.encode_plane(field, phase_rad) as f64 / field.len() as f64) as f32;
        }
        DoublePhaseReport { clipped_share }
    }

    /// Encodes one colour, and says how many of its samples were clipped.
    fn encode_plane(&mut self, field: &[Complex32], phase_rad: &mut [f32]) -> u64 {
        let Self { clipped, error, tile_power, clipped_in_tile_row, set, .. } = self;
        let Resolution { width, height } = self.resolution;
        let amplitude_scale = 1.0 / self.amplitude_constant;
        let fields = field.par_chunks(TILE * width).zip(clipped.par_chunks_mut(TILE * width));
        let errors = error.re.par_chunks_mut(TILE * width).zip(error.im.par_chunks_mut(TILE * width));
        let tiles = tile_power.par_chunks_exact_mut(width.div_ceil(TILE)).zip(&mut *clipped_in_tile_row);
        fields.zip(errors).zip(tiles).for_each(|(((field, clipped), (error_re, error_im)), (power, count))| {
            power.fill(0.0);
            *count = 0;
            for (field, clipped) in field.chunks_exact(width).zip(clipped.chunks_exact_mut(width)) {
                set.run(ClippedRow { field, clipped, power, count, amplitude_scale });
            }
            let errors = error_re.chunks_mut(4 * width).zip(error_im.chunks_mut(4 * width));
            for (field, (error_re, error_im)) in clipped.chunks(4 * width).zip(errors) {
                set.run(BlockRow { field, error_re, error_im, power, width });
            }
        });
        phase_rad.par_chunks_exact_mut(width).zip(clipped.par_chunks_exact(width)).enumerate().for_each(
            |(y, (phases, field))| {
                let lines = [0, 1, 2, 3, 4].map(|line| mirrored(y + line, height) * width);
                let lines_re = lines.map(|line| &error.re[line..][..width]);
                let lines_im = lines.map(|line| &error.im[line..][..width]);
                set.run(CorrectedRow { field, lines_re, lines_im, phases });
            },
        );
        clipped_in_tile_row.iter().map(|&count| u64::from(count)).sum()
    }
}

/// Where the sample `padded` − [`REACH`] of `count` is, mirrored about the outermost ones, which keeps a checkerboard
/// one. What is farther off than `count` is the nearest.
fn mirrored(padded: usize, count: usize) -> usize {
    let inside = padded.abs_diff(REACH);
    if inside < count { inside } else { (2 * (count - 1)).saturating_sub(inside).min(count - 1) }
}

/// A row of samples: a of c.
struct ClippedRow<'a> {
    field: &'a [Complex32],
    clipped: &'a mut [Complex32],
    /// Of each tile that the row crosses; its intensities are added.
    power: &'a mut [f32],
    /// Grows by the samples whose amplitude exceeds what can be encoded.
    count: &'a mut u32,
    amplitude_scale: f32,
}

impl Task for ClippedRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { field, clipped, power, count, amplitude_scale } = self;
        let mut inside = 0;
        let (tiles, rest) = clipped.as_chunks_mut::<TILE>();
        let (given, given_rest) = field.as_chunks::<TILE>();
        for ((samples, given), power) in tiles.iter_mut().zip(given).zip(&mut *power) {
            *samples = *given;
            clip(samples, power, &mut inside, amplitude_scale);
        }
        if let ([.., power], 1..) = (power, rest.len()) {
            let mut samples = [Complex32::ZERO; TILE];
            samples[..rest.len()].copy_from_slice(given_rest);
            clip(&mut samples, power, &mut inside, amplitude_scale);
            rest.copy_from_slice(&samples[..rest.len()]);
            // Of what lies beyond the edge nothing was clipped.
            inside -= (TILE - rest.len()) as u32;
        }
        *count += field.len() as u32 - inside;
    }
}

/// Makes c a, adds its intensities to `power`, and to `inside` how many samples were not clipped.
///
/// Every `if` of this and what follows chooses between values that are both computed, so that the compiler makes
/// vectors of the loops.
#[inline(always)]
fn clip(samples: &mut [Complex32; TILE], power: &mut f32, inside: &mut u32, amplitude_scale: f32) {
    let (mut intensity, mut unclipped) = ([0.0; TILE], [0; TILE]);
    for x in 0..TILE {
        samples[x] *= amplitude_scale;
        intensity[x] = samples[x].norm_sqr();
        unclipped[x] = u32::from(intensity[x] <= 1.0);
    }
    let unclipped = unclipped.iter().sum::<u32>();
    if unclipped < TILE as u32 {
        for x in 0..TILE {
            // Neither for NaN, nor where the square overflows.
            let finite = intensity[x] < f32::INFINITY;
            let scale = 1.0 / intensity[x].max(1.0).sqrt();
            samples[x].re = if finite { samples[x].re * scale } else { 0.0 };
            samples[x].im = if finite { samples[x].im * scale } else { 0.0 };
            intensity[x] = if finite { intensity[x].min(1.0) } else { 0.0 };
        }
    }
    *power += intensity.iter().sum::<f32>();
    *inside += unclipped;
}

/// Real and imaginary parts of a tile's samples in a row; beyond the hologram's edge there are zeros.
type Line = [[f32; TILE]; 2];

/// The pairs of four rows, or of what is left of them.
struct BlockRow<'a> {
    /// a, `width` samples a row.
    field: &'a [Complex32],
    /// Become a less the pair's phasor.
    error_re: &'a mut [f32],
    error_im: &'a mut [f32],
    /// Of each tile that the rows cross.
    power: &'a [f32],
    width: usize,
}

impl Task for BlockRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { field, error_re, error_im, power, width } = self;
        for (first, power) in (0..width).step_by(TILE).zip(power) {
            let dark = (DARK_SHARE * (power / (TILE * TILE) as f32).sqrt()).clamp(LEAST_DARK, MOST_DARK);
            let floor = dark * dark * dark;
            let mut lines = [[[0.0; TILE]; 2]; 4];
            for (line, field) in lines.iter_mut().zip(field.chunks_exact(width)) {
                read_line(&field[first..], line);
            }
            let quarters = quarter_carriers(&lines, floor);
            let errors = error_re.chunks_exact_mut(width).zip(error_im.chunks_exact_mut(width));
            for (y, (error_re, error_im)) in errors.enumerate() {
                let pair = pair_errors(&lines[y], &quarters[y / 2], floor, (first + y) % 2);
                write(&pair[0], &mut error_re[first..]);
                write(&pair[1], &mut error_im[first..]);
            }
        }
    }
}

/// The first samples of `field`.
#[inline(always)]
fn read_line(field: &[Complex32], line: &mut Line) {
    let [re, im] = line;
    if let Some(field) = field.first_chunk::<TILE>() {
        for x in 0..TILE {
            (re[x], im[x]) = (field[x].re, field[x].im);
        }
    } else {
        for (x, value) in field.iter().enumerate() {
            (re[x], im[x]) = (value.re, value.im);
        }
    }
}

/// As many of `values` as `to` has room for.
#[inline(always)]
fn write<const N: usize>(values: &[f32; N], to: &mut [f32]) {
    if let Some(to) = to.first_chunk_mut::<N>() {
        *to = *values;
    } else {
        to.copy_from_slice(&values[..to.len()]);
    }
}

/// The carriers of the quarters of blocks of 4x4 pixels in four rows, of the upper and of the lower quarters, at each
/// of their columns.
#[inline(always)]
fn quarter_carriers(lines: &[Line; 4], floor: f32) -> [Line; 2] {
    let mut means = [[[0.0; TILE / 2]; 2]; 2];
    for (means, lines) in means.iter_mut().zip(lines.chunks_exact(2)) {
        let mut sums = [[0.0; TILE]; 2];
        for [re, im] in lines {
            for x in 0..TILE {
                let power = re[x] * re[x] + im[x] * im[x];
                sums[0][x] += power * re[x];
                sums[1][x] += power * im[x];
            }
        }
        for x in 0..TILE / 2 {
            means[0][x] = 0.25 * (sums[0][2 * x] + sums[0][2 * x + 1]);
            means[1][x] = 0.25 * (sums[1][2 * x] + sums[1][2 * x + 1]);
        }
    }
    let [[upper_re, upper_im], [lower_re, lower_im]] = &means;
    let mut blocks = [[0.0; TILE / 2]; 2];
    for x in (0..TILE / 2).step_by(2) {
        let re = 0.25 * (upper_re[x] + upper_re[x + 1] + lower_re[x] + lower_re[x + 1]);
        let im = 0.25 * (upper_im[x] + upper_im[x + 1] + lower_im[x] + lower_im[x + 1]);
        let (re, im) = unit(re + 0.125 * (LEAST_DARK * LEAST_DARK * LEAST_DARK), im);
        (blocks[0][x], blocks[0][x + 1]) = (re, re);
        (blocks[1][x], blocks[1][x + 1]) = (im, im);
    }
    let mut carriers = [[[0.0; TILE]; 2]; 2];
    for (carriers, [re, im]) in carriers.iter_mut().zip(&means) {
        for x in 0..TILE / 2 {
            let (re, im) = unit(re[x] + floor * blocks[0][x], im[x] + floor * blocks[1][x]);
            (carriers[0][2 * x], carriers[0][2 * x + 1]) = (re, re);
            (carriers[1][2 * x], carriers[1][2 * x + 1]) = (im, im);
        }
    }
    carriers
}

/// a less the pair's phasor, of samples a of which the first has x + y of that `parity`.
#[inline(always)]
fn pair_errors([re, im]: &Line, quarters: &Line, floor: f32, parity: usize) -> Line {
    let mut errors = [[0.0; TILE]; 2];
    for x in 0..TILE {
        let (re, im) = (re[x], im[x]);
        let power = re * re + im * im;
        let (carrier_re, carrier_im) = (power * re + floor * quarters[0][x], power * im + floor * quarters[1][x]);
        // Of the carrier at its own length, so that one root and one division do.
        let square = (carrier_re * carrier_re + carrier_im * carrier_im).max(1e-30);
        let along = re * carrier_re + im * carrier_im;
        let across = (square - along * along).max(0.0).sqrt();
        let across = if (x + parity) % 2 == 1 { across } else { -across };
        let scale = 1.0 / square;
        errors[0][x] = re - (carrier_re * along - carrier_im * across) * scale;
        errors[1][x] = im - (carrier_re * across + carrier_im * along) * scale;
    }
    errors
}

/// (re, im) at length 1, or shorter where its square underflows.
#[inline(always)]
fn unit(re: f32, im: f32) -> (f32, f32) {
    let scale = 1.0 / (re * re + im * im).max(1e-30).sqrt();
    (re * scale, im * scale)
}

/// The phases of a row.
struct CorrectedRow<'a> {
    /// a of the row.
    field: &'a [Complex32],
    /// Real parts of the error two rows above to two rows below.
    lines_re: [&'a [f32]; 2 * REACH + 1],
    lines_im: [&'a [f32]; 2 * REACH + 1],
    phases: &'a mut [f32],
}

impl Task for CorrectedRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { field, lines_re, lines_im, phases } = self;
        for first in (0..phases.len()).step_by(RUN) {
            let (correction_re, correction_im) = (binomial(lines_re, first), binomial(lines_im, first));
            let [error_re, error_im] = [&lines_re[REACH][first..], &lines_im[REACH][first..]];
            let (field, phases) = (&field[first..], &mut phases[first..]);
            if let (Some(field), Some(error_re), Some(error_im)) =
                (field.first_chunk::<RUN>(), error_re.first_chunk::<RUN>(), error_im.first_chunk::<RUN>())
            {
                let mut encoded = [0.0; RUN];
                for x in 0..RUN {
                    let re = field[x].re - error_re[x] + CORRECTION_GAIN * correction_re[x];
                    let im = field[x].im - error_im[x] + CORRECTION_GAIN * correction_im[x];
                    encoded[x] = phase(re, im);
                }
                write(&encoded, phases);
            } else {
                for (x, phase_rad) in phases.iter_mut().enumerate() {
                    let re = field[x].re - error_re[x] + CORRECTION_GAIN * correction_re[x];
                    let im = field[x].im - error_im[x] + CORRECTION_GAIN * correction_im[x];
                    *phase_rad = phase(re, im);
                }
            }
        }
    }
}

/// The middle one of five rows through 1 4 6 4 1 in both directions, at the pixels from `first` on.
#[inline(always)]
fn binomial([a, b, c, d, e]: [&[f32]; 2 * REACH + 1], first: usize) -> [f32; RUN] {
    const AROUND: usize = RUN + 2 * REACH;
    let width = c.len();
    let mut column = [0.0; AROUND];
    let (begin, end) = (first.saturating_sub(REACH), width.min(first + RUN + REACH));
    let inner = begin + REACH - first..end + REACH - first;
    let rows = a[begin..end].iter().zip(&b[begin..end]).zip(&c[begin..end]).zip(&d[begin..end]).zip(&e[begin..end]);
    for (sum, ((((a, b), c), d), e)) in column[inner.clone()].iter_mut().zip(rows) {
        *sum = 0.375 * c + 0.25 * (b + d) + 0.0625 * (a + e);
    }
    for x in (0..inner.start).chain(inner.end..AROUND.min(inner.end + REACH)) {
        column[x] = column[mirrored(first + x, width) + REACH - first];
    }
    let mut passed = [0.0; RUN];
    for x in 0..RUN {
        let (near, far) = (column[x + 1] + column[x + 3], column[x] + column[x + 4]);
        passed[x] = 0.375 * column[x + 2] + 0.25 * near + 0.0625 * far;
    }
    passed
}

/// arg (re + j·im) in [0, 2π).
#[inline(always)]
fn phase(re: f32, im: f32) -> f32 {
    let phase = argument(re, im);
    let phase = if phase < 0.0 { phase + TAU } else { phase };
    if phase >= TAU { 0.0 } else { phase }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::{FRAC_PI_2, FRAC_PI_3};

    use holod_calibration::{Colour, Dioptres, DisplayGeometry, PupilDiameter};
    use num_complex::Complex64;
    use proptest::prelude::*;

    use super::*;
    use crate::optics::{Eye, SimulatedEye};
    use crate::worst::worst;

    const SMALL: Resolution = Resolution { width: 4, height: 3 };

    fn encoded(hologram: &ComplexHologram, constant: f32) -> (PhasePattern, DoublePhaseReport) {
        let mut pattern = PhasePattern::flat(hologram.resolution);
        let report = DoublePhase::new(hologram.resolution, constant).encode(hologram, &mut pattern);
        (pattern, report)
    }

    /// Of a small hologram that is `value` everywhere.
    fn encoded_constant(value: Complex32, constant: f32) -> Vec<f32> {
        let hologram = ComplexHologram { resolution: SMALL, field: vec![value; 3 * SMALL.pixels()] };
        encoded(&hologram, constant).0.phase_rad
    }

    proptest! {
        #[test]
        fn the_mean_of_neighbouring_phasors_is_the_field(amplitude in 0.1f32..1.39, argument in -3.1f32..3.1) {
            let value = Complex32::from_polar(amplitude, argument);
            let phases = encoded_constant(value, 1.4);
            prop_assert!(phases.iter().all(|phase| (0.0..TAU).contains(phase)));
            for (left, right) in [(0, 1), (5, 6), (10, 11)] {
                let mean = (Complex32::cis(phases[left]) + Complex32::cis(phases[right])) * 0.7;
                prop_assert!((mean - value).norm() < 1e-5, "{mean} for {value}");
            }
        }
    }

    #[test]
    fn the_minus_sign_is_where_x_plus_y_is_even() {
        let phases = encoded_constant(Complex32::new(0.5, 0.0), 1.0);
        for (index, &phase) in phases.iter().enumerate() {
            let (x, y) = (index % SMALL.width, index / SMALL.width % SMALL.height);
            let expected = if (x + y) % 2 == 0 { TAU - FRAC_PI_3 } else { FRAC_PI_3 };
            assert!((phase - expected).abs() < 1e-5, "{phase} at ({x}, {y})");
        }
    }

    #[test]
    fn clipping_is_counted_and_what_is_not_finite_is_dark() {
        let one = |value, constant| {
            let mut hologram = ComplexHologram::dark(SMALL);
            hologram.field[6] = value;
            encoded(&hologram, constant)
        };
        let (dark, nothing_clipped) = one(Complex32::ZERO, 1.0);
        assert_eq!(nothing_clipped.clipped_share, PerColour([0.0; 3]));
        assert!((dark.phase_rad[1] - FRAC_PI_2).abs() < 1e-6);
        assert_eq!(one(Complex32::new(1.0, 0.0), 1.0).1.clipped_share, PerColour([0.0; 3]));
        let clipped = one(Complex32::new(0.0, 1.1), 1.0);
        let [red, green, blue] = clipped.1.clipped_share.0;
        assert!((red - 1.0 / 12.0).abs() < 1e-6 && [green, blue] == [0.0; 2], "{red} {green} {blue}");
        assert_eq!(clipped.0, one(Complex32::new(0.0, 1e9), 1.0).0, "what exceeds the constant counts as it");
        assert_ne!(clipped.0, dark);
        for (re, im) in [(f32::NAN, 0.0), (f32::INFINITY, 0.0), (f32::INFINITY, f32::NAN), (1e30, 0.0)] {
            let (pattern, report) = one(Complex32::new(re, im), 1.0);
            assert!(pattern == dark && report.clipped_share[Colour::Red] > 0.0, "{re} {im}");
        }
    }

    /// The phasors whose phases are encoded, by the definition in double precision.
    fn expected_phasors(hologram: &ComplexHologram, constant: f32) -> Vec<Complex64> {
        let Resolution { width, height } = hologram.resolution;
        let unit = |value: Complex64| value / value.norm();
        let planes = hologram.field.chunks(width * height).map(|plane| {
            let a: Vec<Complex64> = plane
                .iter()
                .map(|value| Complex64::new(value.re.into(), value.im.into()) / f64::from(constant))
                .map(|a| a / a.norm().max(1.0))
                .collect();
            // Of the square tile around (x, y); beyond the edges there are zeros.
            let mean = |x: usize, y: usize, size: usize, of: &dyn Fn(Complex64) -> Complex64| {
                let rows = y / size * size..(y / size * size + size).min(height);
                let columns = x / size * size..(x / size * size + size).min(width);
                let samples = rows.flat_map(|y| columns.clone().map(move |x| (x, y)));
                samples.map(|(x, y)| of(a[y * width + x])).sum::<Complex64>() / (size * size) as f64
            };
            let weighted = |a: Complex64| a * a.norm_sqr();
            let pair = |x: usize, y: usize| {
                let power = mean(x, y, 32, &|a| a.norm_sqr().into()).re;
                let floor = (0.5 * power.sqrt()).clamp(0.01, 0.08).powi(3);
                let block = unit(mean(x, y, 4, &weighted) + 0.005f64.powi(3));
                let quarter = unit(mean(x, y, 2, &weighted) + floor * block);
                let carrier = unit(weighted(a[y * width + x]) + floor * quarter);
                let along = (a[y * width + x] * carrier.conj()).re;
                let across = (1.0 - along * along).max(0.0).sqrt();
                carrier * Complex64::new(along, if (x + y).is_multiple_of(2) { -across } else { across })
            };
            let pairs: Vec<_> = (0..width * height).map(|index| pair(index % width, index / width)).collect();
            let taps = [0.0625, 0.25, 0.375, 0.25, 0.0625];
            let at = |index: usize, step: usize, count: usize| mirrored(index + step, count);
            (0..width * height)
                .map(|index| {
                    let mut error = Complex64::ZERO;
                    for (dy, dx) in (0..5).flat_map(|dy| (0..5).map(move |dx| (dy, dx))) {
                        let near = at(index / width, dy, height) * width + at(index % width, dx, width);
                        error += (a[near] - pairs[near]) * (taps[dy] * taps[dx]);
                    }
                    pairs[index] + 2.0 * error
                })
                .collect::<Vec<_>>()
        });
        planes.flatten().collect()
    }

    /// The largest distance of the unit phasors, where the expected one is long enough to have a direction.
    fn worst_phasor(found_rad: &[f32], expected: &[Complex64]) -> f64 {
        assert_eq!(found_rad.len(), expected.len());
        let judged = found_rad.iter().zip(expected).filter(|(_, expected)| expected.norm() > 0.05);
        worst(judged.map(|(&phase, expected)| (Complex64::cis(phase.into()) - expected / expected.norm()).norm()))
    }

    #[test]
    fn tiles_and_runs_follow_the_definition_on_every_instruction_set() {
        for (width, height) in [(2 * RUN + 5, TILE + 7), (RUN + 1, 5), (RUN, 4), (2, 1), (1, 3), (7, 2)] {
            let resolution = Resolution { width, height };
            let mut hologram = ComplexHologram::dark(resolution);
            for (index, value) in hologram.field.iter_mut().enumerate() {
                // From far below what is dark to above the constant; a few columns of noise.
                let amplitude = 1.5 * (0.05 * (index % width) as f32).sin().powi(4);
                let phase = if index % 13 < 4 { (index * index) as f32 * 0.7 } else { index as f32 * 0.07 };
                *value = Complex32::from_polar(amplitude + 0.002, phase);
            }
            let above = hologram.field.iter().filter(|value| f64::from(value.re).hypot(value.im.into()) > 1.3).count();
            let expected = expected_phasors(&hologram, 1.3);
            let with_direction = expected.iter().filter(|phasor| phasor.norm() > 0.05).count();
            assert!(100 * with_direction > 95 * expected.len(), "{with_direction} of {}", expected.len());
            for set in InstructionSet::available() {
                let mut encoder = DoublePhase::with_instructions(resolution, 1.3, set);
                encoder.clipped_in_tile_row.fill(u32::MAX);
                encoder.tile_power.fill(f32::NAN);
                let mut pattern = PhasePattern::flat(resolution);
                let clipped_share = encoder.encode(&hologram, &mut pattern).clipped_share;
                let found = &mut pattern.phase_rad;
                let worst = worst_phasor(found, &expected);
                // At an amplitude of 1 a rounding of 1e-7 turns a phasor by 5e-4.
                assert!(worst < 1e-3, "{worst} of {resolution} on {}", set.name());
                let samples = resolution.pixels() as f64;
                let clipped = clipped_share.0.into_iter().map(f64::from).sum::<f64>() * samples;
                assert_eq!(clipped.round() as usize, above, "on {}", set.name());
                let judged = || (0..expected.len()).filter(|&place| expected[place].norm() > 0.05);
                for place in [judged().next().unwrap(), judged().next_back().unwrap()] {
                    let right = found[place];
                    found[place] += 5e-3;
                    assert!(worst_phasor(found, &expected) > 2e-3, "one wrong phase at {place} is seen");
                    found[place] = right;
                }
            }
        }
    }

    #[test]
    fn a_sample_beyond_the_edge_is_mirrored() {
        let of = |count| (0..count + 2 * REACH).map(|padded| mirrored(padded, count)).collect::<Vec<_>>();
        assert_eq!(of(5), [2, 1, 0, 1, 2, 3, 4, 3, 2]);
        assert_eq!([of(2), of(1)], [vec![0, 1, 0, 1, 0, 0], vec![0, 0, 0, 0, 0]]);
    }

    /// Of a pattern, as an eye sees it: all light over that of `hologram`, and the mean where this is dark.
    fn light_and_dark(pattern: &PhasePattern, hologram: &ComplexHologram) -> (f64, f64) {
        let mut simulated = SimulatedEye::repeating(&DisplayGeometry::DEFAULT, hologram.resolution);
        let eye = Eye { pupil: PupilDiameter::from_mm(3.0), focus: Dioptres(0.0) };
        let (wanted, seen) = (simulated.view_field(hologram, eye), simulated.view(pattern, 1.25, eye));
        let sum = |pixels: &[f32]| pixels.iter().map(|&light| f64::from(light)).sum::<f64>();
        let dark: Vec<f32> = wanted
            .pixels
            .iter()
            .zip(&seen.pixels)
            .filter(|(wanted, _)| **wanted < 1e-3)
            .map(|(_, &seen)| seen)
            .collect();
        assert!(2 * dark.len() > wanted.pixels.len(), "most of the picture is dark");
        (sum(&seen.pixels) / sum(&wanted.pixels), sum(&dark) / dark.len() as f64)
    }

    #[test]
    fn black_stays_black_around_bright_marks() {
        let resolution = Resolution { width: 128, height: 96 };
        let mut hologram = ComplexHologram::dark(resolution);
        for colour in Colour::ALL {
            for (index, value) in hologram.plane_mut(colour).iter_mut().enumerate() {
                let (x, y) = ((index % resolution.width) as f32, (index / resolution.width) as f32);
                // Two dots of unlike phases and a diagonal line, and the noise that a network leaves on black.
                let spot = |dx: f32, dy: f32| (-(dx * dx + dy * dy) / 4.5).exp();
                let line = if (30.0..100.0).contains(&x) { (-(x - y - 10.0).powi(2) / 4.5).exp() } else { 0.0 };
                let noise = Complex32::from_polar(0.004, (index * index % 6151) as f32);
                *value = spot(x - 20.0, y - 60.0) + line + Complex32::I * spot(x - 100.0, y - 20.0) + noise;
            }
        }
        let (light, dark) = light_and_dark(&encoded(&hologram, 1.25).0, &hologram);
        assert!((0.85..1.15).contains(&light) && dark < 5e-4, "{light} of the light, {dark} in the dark");

        let mut plain = PhasePattern::flat(resolution);
        for (index, (phase, value)) in plain.phase_rad.iter_mut().zip(&hologram.field).enumerate() {
            let spread = (value.norm() / 1.25).min(1.0).acos();
            let odd = (index % resolution.width + index / resolution.width) % 2 == 1;
            *phase = value.arg() + if odd { spread } else { -spread };
        }
        let (light, dark) = light_and_dark(&plain, &hologram);
        assert!(light > 1.3 && dark > 5e-3, "the plain pair is not told: {light} of the light, {dark} in the dark");
    }
}
