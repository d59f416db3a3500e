//! Double phase: a complex field as a checkerboard of two phases.

use std::f32::consts::{FRAC_PI_2, TAU};

use holod_calibration::Resolution;
use num_complex::Complex32;
use rayon::prelude::*;

use super::{ComplexHologram, PhasePattern};
use crate::phase_math::{arc_cosine, argument};
use crate::resident::Resident;
use crate::simd::{InstructionSet, Simd, Task};

/// Pixels that are encoded together.
const RUN: usize = 64;

/// Encodes complex holograms as phase patterns (Hsueh and Sawchuk 1978; Maimone et al. 2017).
///
/// With a = min(|c|/K, 1) the phase is arg c + acos a where x + y is odd and arg c − acos a where it is even: the mean
/// of the two phasors is c/K. K is fixed, so brightness does not flicker from frame to frame; what exceeds it is
/// clipped and counted. An eye behind the 4f stop sees c/K, so intensities are multiplied by K² to compare.
///
/// An encoder has a thread pool of its own.
pub struct DoublePhase {
    resident: Resident<Job>,
    resolution: Resolution,
    amplitude_constant: f32,
}

struct Job {
    hologram: ComplexHologram,
    pattern: PhasePattern,
    amplitude_constant: f32,
    /// Weights of the 3-tap blur in each direction (side, centre), where there is one.
    blur: Option<[f32; 2]>,
    clipped_in_row: Vec<u32>,
    set: InstructionSet,
}

/// What one encoding lost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DoublePhaseReport {
    /// Share of samples whose amplitude exceeded the constant, 0..=1.
    pub clipped_share: f32,
}

impl DoublePhase {
    /// An encoder for one resolution with a fixed amplitude constant K > 0.
    ///
    /// # Panics
    ///
    /// Where the system cannot start threads, and where K is not positive.
    pub fn new(resolution: Resolution, amplitude_constant: f32) -> Self {
        assert!(amplitude_constant > 0.0, "the amplitude constant is positive");
        let job = Job {
            hologram: ComplexHologram::dark(resolution),
            pattern: PhasePattern::flat(resolution),
            amplitude_constant,
            blur: None,
            clipped_in_row: vec![0; 3 * resolution.height],
            set: InstructionSet::best(),
        };
        let resident = Resident::new("holod-phase", 0, job, Job::encode).expect("threads can be started");
        Self { resident, resolution, amplitude_constant }
    }

    /// The same encoder with a 3x3 Gaussian of `sigma_px` on the complex field first, against aliasing
    /// (Shi et al. 2021 use 0.7). Pixels outside the field repeat its edge.
    pub fn with_blur(mut self, sigma_px: f32) -> Self {
        self.resident.run(|job| job.blur = Some(blur_taps(sigma_px)), |_| ());
        self
    }

    /// The amplitude that is encoded as 1.
    pub fn amplitude_constant(&self) -> f32 {
        self.amplitude_constant
    }

    /// Writes the phases of `hologram` to `pattern`, both of this encoder's resolution. Does not allocate.
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
        let mut clipped = 0;
        self.resident.run(
            |job| job.hologram.field.copy_from_slice(&hologram.field),
            |job| {
                // The old content, swapped in, is overwritten by the next frame.
                std::mem::swap(&mut pattern.phase_rad, &mut job.pattern.phase_rad);
                clipped = job.clipped_in_row.iter().map(|&clipped| u64::from(clipped)).sum();
            },
        );
        DoublePhaseReport { clipped_share: (clipped as f64 / pattern.phase_rad.len().max(1) as f64) as f32 }
    }
}

impl Job {
    fn encode(&mut self) {
        let Self { hologram: ComplexHologram { resolution, field }, pattern, blur, clipped_in_row, set, .. } = self;
        let Resolution { width, height } = *resolution;
        let amplitude_scale = 1.0 / self.amplitude_constant;
        pattern.phase_rad.par_chunks_exact_mut(width).zip(clipped_in_row).enumerate().for_each(
            |(row, (phases, clipped))| {
                let plane = &field[row / height * width * height..][..width * height];
                let y = row % height;
                *clipped = 0;
                for (run, phases) in phases.chunks_mut(RUN).enumerate() {
                    let first = run * RUN;
                    let mut values = [Complex32::ZERO; RUN];
                    for (x, value) in (first..).zip(&mut values[..phases.len()]) {
                        *value = match *blur {
                            None => plane[y * width + x],
                            Some(taps) => blurred(plane, *resolution, x, y, taps),
                        };
                    }
                    set.run(EncodeRun { values, amplitude_scale, parity: (first + y) % 2, phases, clipped });
                }
            },
        );
    }
}

/// The phases of neighbouring pixels of a row.
struct EncodeRun<'a> {
    values: [Complex32; RUN],
    amplitude_scale: f32,
    /// (x + y) % 2 of the first of them.
    parity: usize,
    phases: &'a mut [f32],
    /// Grows by those whose amplitude exceeds what can be encoded.
    clipped: &'a mut u32,
}

impl Task for EncodeRun<'_> {
    /// Every `if` chooses between values that are both computed, so that the compiler makes vectors of the loop.
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { values, amplitude_scale, parity, phases, clipped } = self;
        let mut encoded = [0.0; RUN];
        let mut inside = [0u32; RUN];
        for (index, ((value, phase), inside)) in values.iter().zip(&mut encoded).zip(&mut inside).enumerate() {
            let (re, im) = (value.re * amplitude_scale, value.im * amplitude_scale);
            let amplitude = (re * re + im * im).sqrt();
            // Neither for NaN, nor where the square overflows.
            let finite = amplitude < f32::INFINITY;
            *inside = u32::from(amplitude <= 1.0);
            let carrier = if finite { argument(re, im) } else { 0.0 };
            let spread = if finite { arc_cosine(amplitude.min(1.0)) } else { FRAC_PI_2 };
            *phase = wrapped(if (index + parity) % 2 == 1 { carrier + spread } else { carrier - spread });
        }
        phases.copy_from_slice(&encoded[..phases.len()]);
        *clipped += phases.len() as u32 - inside[..phases.len()].iter().sum::<u32>();
    }
}

/// `phase` in -2π..2π brought into [0, 2π).
#[inline(always)]
fn wrapped(phase: f32) -> f32 {
    let phase = if phase < 0.0 { phase + TAU } else { phase };
    if phase >= TAU { 0.0 } else { phase }
}

/// Weights of a 3-tap Gaussian, (side, centre), which add up to 1.
fn blur_taps(sigma_px: f32) -> [f32; 2] {
    let side = (-0.5 / (sigma_px * sigma_px)).exp();
    [side, 1.0].map(|weight| weight / (1.0 + 2.0 * side))
}

/// The 3x3 separable blur of `plane` at (x, y).
fn blurred(plane: &[Complex32], resolution: Resolution, x: usize, y: usize, [side, centre]: [f32; 2]) -> Complex32 {
    let Resolution { width, height } = resolution;
    let columns = [(x.saturating_sub(1), side), (x, centre), ((x + 1).min(width - 1), side)];
    let rows = [(y.saturating_sub(1), side), (y, centre), ((y + 1).min(height - 1), side)];
    let mut sum = Complex32::ZERO;
    for (row, row_weight) in rows {
        for (column, column_weight) in columns {
            sum += plane[row * width + column] * (row_weight * column_weight);
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encode_one(value: Complex32, x: usize, y: usize, constant: f32) -> (f32, DoublePhaseReport) {
        let resolution = Resolution { width: 4, height: 3 };
        let mut hologram = ComplexHologram::dark(resolution);
        hologram.field[y * 4 + x] = value;
        let mut pattern = PhasePattern::flat(resolution);
        let report = DoublePhase::new(resolution, constant).encode(&hologram, &mut pattern);
        (pattern.phase_rad[y * 4 + x], report)
    }

    proptest! {
        #[test]
        fn the_mean_of_neighbouring_phasors_is_the_field(amplitude in 0.0f32..1.4, argument in -3.1f32..3.1) {
            let value = Complex32::from_polar(amplitude, argument);
            let (even, _) = encode_one(value, 1, 1, 1.4);
            let (odd, _) = encode_one(value, 2, 1, 1.4);
            prop_assert!((0.0..TAU).contains(&even) && (0.0..TAU).contains(&odd));
            let mean = (Complex32::cis(even) + Complex32::cis(odd)) * 0.7;
            prop_assert!((mean - value).norm() < 2e-6, "{mean} for {value}");
        }
    }

    #[test]
    fn the_minus_sign_is_where_x_plus_y_is_even() {
        let half = Complex32::new(0.5, 0.0);
        let third_turn = std::f32::consts::FRAC_PI_3;
        assert!((encode_one(half, 0, 0, 1.0).0 - (TAU - third_turn)).abs() < 1e-6);
        assert!((encode_one(half, 1, 0, 1.0).0 - third_turn).abs() < 1e-6);
    }

    #[test]
    fn clipping_is_counted_and_what_is_not_finite_is_dark() {
        assert_eq!(encode_one(Complex32::new(1.0, 0.0), 0, 0, 1.0).1.clipped_share, 0.0);
        assert!((encode_one(Complex32::new(1.1, 0.0), 0, 0, 1.0).1.clipped_share - 1.0 / 36.0).abs() < 1e-6);
        for (re, im) in [(f32::NAN, 0.0), (f32::INFINITY, 0.0), (f32::INFINITY, f32::NAN), (1e30, 0.0)] {
            let (phase, report) = encode_one(Complex32::new(re, im), 1, 0, 1.0);
            assert!((phase - FRAC_PI_2).abs() < 1e-6 && report.clipped_share > 0.0, "{re} {im}");
        }
    }

    /// The largest distance between phasors, as `job` encodes them and by the formula in double precision.
    fn worst_phasor(job: &Job, spoiled: Option<usize>) -> f64 {
        let ComplexHologram { resolution, field } = &job.hologram;
        let Resolution { width, height } = *resolution;
        let mut worst = 0.0f64;
        for (index, &phase) in job.pattern.phase_rad.iter().enumerate() {
            let (x, y) = (index % width, index / width % height);
            let plane = &field[index / resolution.pixels() * resolution.pixels()..][..resolution.pixels()];
            let value = match job.blur {
                None => plane[y * width + x],
                Some(taps) => blurred(plane, *resolution, x, y, taps),
            };
            let amplitude = f64::from(value.re).hypot(value.im.into()) / f64::from(job.amplitude_constant);
            let spread = if (x + y) % 2 == 1 { amplitude.min(1.0).acos() } else { -amplitude.min(1.0).acos() };
            let mut expected = f64::from(value.im).atan2(value.re.into()) + spread;
            if spoiled == Some(index) {
                expected += 1e-3;
            }
            let distance = (num_complex::Complex64::cis(phase.into()) - num_complex::Complex64::cis(expected)).norm();
            worst = if distance.is_nan() { f64::INFINITY } else { worst.max(distance) };
        }
        worst
    }

    #[test]
    fn rows_of_several_runs_follow_the_formula_on_every_instruction_set() {
        let resolution = Resolution { width: 2 * RUN + 5, height: 3 };
        let mut hologram = ComplexHologram::dark(resolution);
        for (index, value) in hologram.field.iter_mut().enumerate() {
            // The argument of darkness may be anything. Of 0.05, 0.25, .. 1.45 the last exceeds the constant.
            *value = Complex32::from_polar((index % 8) as f32 * 0.2 + 0.05, index as f32 * 0.7);
        }
        let above = hologram
            .field
            .chunks(resolution.width)
            .map(|row| row.iter().filter(|value| f64::from(value.re).hypot(value.im.into()) > 1.3).count() as u32);
        let above: Vec<u32> = above.collect();
        for (set, blur) in InstructionSet::available().flat_map(|set| [(set, None), (set, Some(blur_taps(0.7)))]) {
            let mut job = Job {
                hologram: hologram.clone(),
                pattern: PhasePattern::flat(resolution),
                amplitude_constant: 1.3,
                blur,
                clipped_in_row: vec![u32::MAX; 3 * resolution.height],
                set,
            };
            job.encode();
            // At an amplitude of 1 a rounding of 1e-7 moves the arc cosine by 5e-4; none lies that near.
            let worst = worst_phasor(&job, None);
            assert!(worst < 1e-5, "{worst} on {} with blur {blur:?}", set.name());
            for place in [0, RUN, 2 * RUN + 4, job.pattern.phase_rad.len() - 1] {
                assert!(worst_phasor(&job, Some(place)) > 1e-4, "one wrong phase at {place} is seen");
            }
            if blur.is_none() {
                assert_eq!(job.clipped_in_row, above, "on {}", set.name());
            }
        }
    }

    #[test]
    fn the_blur_keeps_a_constant_and_spreads_a_point() {
        let resolution = Resolution { width: 5, height: 5 };
        let plane = vec![Complex32::new(0.3, 0.1); 25];
        let [side, centre] = blur_taps(0.7);
        for (x, y) in [(0, 0), (4, 4), (2, 3)] {
            assert!((blurred(&plane, resolution, x, y, [side, centre]) - plane[0]).norm() < 1e-6);
        }
        let mut point = vec![Complex32::ZERO; 25];
        point[12] = Complex32::ONE;
        assert!((blurred(&point, resolution, 1, 2, [side, centre]).re - side * centre).abs() < 1e-7);
        assert!((side / centre - (-0.5f32 / 0.49).exp()).abs() < 1e-6);
    }
}
