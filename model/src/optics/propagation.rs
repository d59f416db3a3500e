//! Free-space propagation by the band-limited angular spectrum method.

use std::f64::consts::TAU;

use holod_calibration::{Colour, DisplayGeometry, Metres, Resolution};
use num_complex::{Complex32, Complex64};
use rayon::prelude::*;

use super::fft::{TransposedFft2d, signed_bin};

/// Propagates fields of one resolution between parallel planes.
///
/// The transfer function is exp(j·2π·u·(sqrt(1/λ² − fx² − fy²) − 1/λ)) inside 1/λ and 0 outside, without the constant
/// phase of a plane wave. The field is zero-padded to twice its size, and the transfer function is cut where its own
/// samples would alias (Matsushima and Shimobaba 2009), so that nothing wraps round; unless it is
/// [`repeating`](Self::repeating).
pub struct Propagator {
    geometry: DisplayGeometry,
    resolution: Resolution,
    /// The field's size with its padding.
    padded_size: Resolution,
    fft: TransposedFft2d<f32>,
    /// [padded height, padded width]
    padded: Vec<Complex32>,
}

impl Propagator {
    /// For fields of `resolution` with the pitch and wavelengths of `geometry`.
    pub fn new(geometry: &DisplayGeometry, resolution: Resolution) -> Self {
        let padded_size = Resolution { width: 2 * resolution.width, height: 2 * resolution.height };
        Self::with_padding(geometry, resolution, padded_size)
    }

    /// The same where the field goes on beyond its edges as if it were repeated: no padding, no band limit, and what
    /// leaves at one edge comes in at the opposite one.
    pub fn repeating(geometry: &DisplayGeometry, resolution: Resolution) -> Self {
        Self::with_padding(geometry, resolution, resolution)
    }

    fn with_padding(geometry: &DisplayGeometry, resolution: Resolution, padded_size: Resolution) -> Self {
        Self {
            geometry: *geometry,
            resolution,
            padded_size,
            fft: TransposedFft2d::new(padded_size.width, padded_size.height),
            padded: vec![Complex32::ZERO; padded_size.pixels()],
        }
    }

    /// Carries `field` [height, width] of one colour over the distance `u`, towards the images where it is positive.
    pub fn propagate(&mut self, field: &mut [Complex32], colour: Colour, u: Metres) {
        self.pad(|index| field[index]);
        self.filter(colour, u, |_| true);
        let width = self.resolution.width;
        for (row, from) in field.chunks_exact_mut(width).zip(self.padded.chunks_exact(self.padded_size.width)) {
            row.copy_from_slice(&from[..width]);
        }
    }

    /// Fills the padded field: sample `index` of the [height, width] field from `value`, zero outside.
    pub(super) fn pad(&mut self, value: impl Fn(usize) -> Complex32 + Sync) {
        let Resolution { width, height } = self.resolution;
        self.padded.par_chunks_exact_mut(self.padded_size.width).enumerate().for_each(|(y, row)| {
            row.fill(Complex32::ZERO);
            if y < height {
                for (x, sample) in row[..width].iter_mut().enumerate() {
                    *sample = value(y * width + x);
                }
            }
        });
    }

    /// Multiplies the padded field's spectrum by the transfer function where `passes` (of a bin along x and one along
    /// y) and by zero elsewhere.
    pub(super) fn filter(&mut self, colour: Colour, u: Metres, passes: impl Fn([Bin; 2]) -> bool + Sync) {
        let Resolution { width, height } = self.padded_size;
        let pitch_m = self.geometry.pixel_pitch.0;
        let wavelength_m = self.geometry.wavelengths[colour].0;
        let transfer = if self.padded_size == self.resolution {
            Transfer::unlimited(wavelength_m, u.0)
        } else {
            Transfer::new(wavelength_m, u.0, [width as f64 * pitch_m, height as f64 * pitch_m])
        };
        let norm = 1.0 / (width * height) as f64;
        self.fft.forward(&mut self.padded);
        self.fft.spectrum.par_chunks_exact_mut(height).enumerate().for_each(|(kx, column)| {
            let x = Bin::new(signed_bin(kx, width), width, pitch_m);
            // The transfer function is even in fy and so are the stops: each value serves two bins.
            for ky in 0..=height / 2 {
                let y = Bin::new(ky as isize, height, pitch_m);
                let value = if passes([x, y]) { transfer.at(x.per_m, y.per_m) * norm } else { Complex64::ZERO };
                let value = Complex32::new(value.re as f32, value.im as f32);
                column[ky] *= value;
                if ky > 0 && 2 * ky < height {
                    column[height - ky] *= value;
                }
            }
        });
        self.fft.inverse(&mut self.padded);
    }

    /// One row of the field inside the padding.
    pub(super) fn row(&self, y: usize) -> &[Complex32] {
        &self.padded[y * self.padded_size.width..][..self.resolution.width]
    }

    pub(super) fn resolution(&self) -> Resolution {
        self.resolution
    }
}

/// One place of a spectrum along one axis.
#[derive(Clone, Copy)]
pub(super) struct Bin {
    /// Its frequency in cycles per metre.
    pub(super) per_m: f64,
    /// Whether that is below a quarter of a cycle per pixel, which no rounding decides.
    pub(super) in_half_band: bool,
}

impl Bin {
    fn new(signed: isize, bins: usize, pitch_m: f64) -> Self {
        Self { per_m: signed as f64 / (bins as f64 * pitch_m), in_half_band: 4 * signed.unsigned_abs() < bins }
    }
}

/// The transfer function over the distance `u` for fields that repeat beyond their edges, on a grid of `size` samples
/// `pitch` apart: transposed, [width, height], as [`TransposedFft2d`] holds spectra, and divided by width·height, so
/// that a transform there and back keeps amplitudes.
pub(crate) fn transfer_table(wavelength: Metres, pitch: Metres, size: Resolution, u: Metres) -> Vec<Complex32> {
    let Resolution { width, height } = size;
    let transfer = Transfer::unlimited(wavelength.0, u.0);
    let norm = 1.0 / (width * height) as f64;
    let frequency = |bin, bins| signed_bin(bin, bins) as f64 / (bins as f64 * pitch.0);
    (0..width)
        .flat_map(|kx| (0..height).map(move |ky| (kx, ky)))
        .map(|(kx, ky)| {
            let value = transfer.at(frequency(kx, width), frequency(ky, height)) * norm;
            Complex32::new(value.re as f32, value.im as f32)
        })
        .collect()
}

/// The band-limited transfer function of one wavelength and distance.
struct Transfer {
    inverse_wavelength: f64,
    u_m: f64,
    /// Highest |fx| and |fy| at which the function's phase is still sampled finely enough.
    limits: [f64; 2],
}

impl Transfer {
    /// `extents_m` are width and height of the padded field.
    fn new(wavelength_m: f64, u_m: f64, extents_m: [f64; 2]) -> Self {
        let limits = extents_m.map(|extent_m| 1.0 / (wavelength_m * (2.0 * u_m / extent_m).hypot(1.0)));
        Self { limits, ..Self::unlimited(wavelength_m, u_m) }
    }

    fn unlimited(wavelength_m: f64, u_m: f64) -> Self {
        Self { inverse_wavelength: 1.0 / wavelength_m, u_m, limits: [f64::INFINITY; 2] }
    }

    fn at(&self, fx: f64, fy: f64) -> Complex64 {
        let axial_squared = self.inverse_wavelength * self.inverse_wavelength - fx * fx - fy * fy;
        if axial_squared <= 0.0 || fx.abs() > self.limits[0] || fy.abs() > self.limits[1] {
            return Complex64::ZERO;
        }
        // sqrt(a² − b) − a written without cancellation.
        let lag = -(fx * fx + fy * fy) / (axial_squared.sqrt() + self.inverse_wavelength);
        Complex64::cis(TAU * self.u_m * lag)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::worst::worst;
    use holod_calibration::PerColour;

    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;

    /// A Gaussian beam's paraxial field at distance u from its waist w0, without exp(jku) (Siegman, Lasers, ch. 17).
    fn gaussian_beam(wavelength_m: f64, waist_m: f64, u_m: f64, x_m: f64, y_m: f64) -> Complex64 {
        let q = Complex64::new(0.0, std::f64::consts::PI * waist_m * waist_m / wavelength_m);
        let ratio = q / (q - u_m);
        let r_squared = x_m * x_m + y_m * y_m;
        let exponent = Complex64::i() * std::f64::consts::PI * r_squared / (wavelength_m * (u_m - q));
        ratio * exponent.exp()
    }

    fn largest_error(actual: &[Complex32], expected: &[Complex64]) -> f64 {
        worst(actual.iter().zip(expected).map(|(a, e)| (Complex64::new(a.re.into(), a.im.into()) - e).norm()))
    }

    fn sampled_beam(resolution: Resolution, colour: Colour, u_m: f64) -> Vec<Complex64> {
        let pitch_m = BENCH.pixel_pitch.0;
        (0..resolution.pixels())
            .map(|index| {
                let x_m = ((index % resolution.width) as f64 - 90.0) * pitch_m;
                let y_m = ((index / resolution.width) as f64 - 101.5) * pitch_m;
                gaussian_beam(BENCH.wavelengths[colour].0, 100e-6, u_m, x_m, y_m)
            })
            .collect()
    }

    #[test]
    fn a_gaussian_beam_propagates_as_its_closed_form_says() {
        let resolution = Resolution { width: 180, height: 204 };
        let mut propagator = Propagator::new(&BENCH, resolution);
        for (colour, u_m) in [(Colour::Red, 4.5e-3), (Colour::Green, 30e-3), (Colour::Blue, -12e-3)] {
            let narrow = |value: Complex64| Complex32::new(value.re as f32, value.im as f32);
            let mut field: Vec<_> = sampled_beam(resolution, colour, 0.0).into_iter().map(narrow).collect();
            propagator.propagate(&mut field, colour, Metres(u_m));
            let mut expected = sampled_beam(resolution, colour, u_m);
            let error = largest_error(&field, &expected);
            assert!(error < 2e-4, "{colour} over {u_m} m: {error}");
            assert!((gaussian_beam(BENCH.wavelengths[colour].0, 100e-6, u_m, 0.0, 0.0).norm() - 1.0).abs() > 1e-3);
            expected[17].re += 1e-3;
            assert!(largest_error(&field, &expected) > 2e-4, "the comparison sees one wrong value");
        }
    }

    #[test]
    fn a_slit_in_the_far_field_is_a_sinc() {
        // Fraunhofer: N = (w/2)²/(λu) = 0.05 for w = 80 µm and u = 61.5 mm in green.
        let geometry = DisplayGeometry { wavelengths: PerColour([Metres(520e-9); 3]), ..BENCH };
        let resolution = Resolution { width: 640, height: 48 };
        let (slit_px, u_m) = (10.0, 61.5e-3);
        let mut propagator = Propagator::new(&geometry, resolution);
        let centre = 319.5;
        let mut field: Vec<_> = (0..resolution.pixels())
            .map(|index| {
                let inside = ((index % 640) as f64 - centre).abs() < slit_px / 2.0;
                Complex32::new(if inside { 1.0 } else { 0.0 }, 0.0)
            })
            .collect();
        propagator.propagate(&mut field, Colour::Green, Metres(u_m));
        let row: Vec<f64> = field[24 * 640..][..640].iter().map(|value| f64::from(value.norm_sqr())).collect();
        let peak = row[319];
        let zero_px = 520e-9 * u_m / (slit_px * 8e-6) / 8e-6;
        for (x, intensity) in row.iter().enumerate().take(320 + 90).skip(319 - 90) {
            let argument = std::f64::consts::PI * (x as f64 - centre) / zero_px;
            let expected = if argument == 0.0 { 1.0 } else { (argument.sin() / argument).powi(2) };
            assert!((intensity / peak - expected).abs() < 0.03, "{x}: {} for {expected}", intensity / peak);
        }
    }

    #[test]
    fn nothing_wraps_round_the_edge() {
        let resolution = Resolution { width: 64, height: 64 };
        let mut propagator = Propagator::new(&BENCH, resolution);
        let mut field = vec![Complex32::ZERO; 64 * 64];
        for y in 20..44 {
            field[y * 64 + 62] = Complex32::ONE;
        }
        propagator.propagate(&mut field, Colour::Green, Metres(2e-3));
        let left: f32 =
            (0..64).flat_map(|y| (0..16).map(move |x| (x, y))).map(|(x, y)| field[y * 64 + x].norm_sqr()).sum();
        let right: f32 =
            (0..64).flat_map(|y| (48..64).map(move |x| (x, y))).map(|(x, y)| field[y * 64 + x].norm_sqr()).sum();
        assert!(left < 1e-3 * right, "{left} against {right}");
    }

    #[test]
    fn a_repeating_field_wraps_round_and_keeps_its_energy() {
        let resolution = Resolution { width: 64, height: 48 };
        let spot = |centre_x: isize| -> Vec<Complex32> {
            let at = |index: usize| {
                let x = (index as isize % 64 - centre_x + 32).rem_euclid(64) - 32;
                let y = index as isize / 64 - 24;
                Complex32::new((-(x * x + y * y) as f32 / 18.0).exp(), 0.0)
            };
            (0..resolution.pixels()).map(at).collect()
        };
        let mut propagator = Propagator::repeating(&BENCH, resolution);
        let mut spread = |centre_x| {
            let mut field = spot(centre_x);
            propagator.propagate(&mut field, Colour::Red, Metres(4e-3));
            field
        };
        let (middle, edge) = (spread(32), spread(0));
        for (index, value) in edge.iter().enumerate() {
            let shifted = index / 64 * 64 + (index % 64 + 32) % 64;
            assert!((middle[shifted] - value).norm() < 1e-5, "{index}");
        }
        let energy = |field: &[Complex32]| field.iter().map(|value| f64::from(value.norm_sqr())).sum::<f64>();
        assert!((energy(&edge) / energy(&spot(0)) - 1.0).abs() < 1e-5);
        assert!(middle[24 * 64 + 32].norm() < 0.9, "it did spread");
    }

    #[test]
    fn there_and_back_is_where_one_started() {
        let resolution = Resolution { width: 96, height: 80 };
        let mut propagator = Propagator::new(&BENCH, resolution);
        let start: Vec<_> = (0..96 * 80)
            .map(|index| {
                let (x, y) = ((index % 96) as f32 - 47.0, (index / 96) as f32 - 40.0);
                Complex32::from_polar((-(x * x + y * y) / 200.0).exp(), 0.05 * x)
            })
            .collect();
        let mut field = start.clone();
        propagator.propagate(&mut field, Colour::Red, Metres(3e-3));
        let from_start = |field: &[Complex32]| worst(field.iter().zip(&start).map(|(a, b)| (a - b).norm()));
        let moved = from_start(&field);
        propagator.propagate(&mut field, Colour::Red, Metres(-3e-3));
        let error = from_start(&field);
        assert!(moved > 0.05 && error < 1e-3, "moved {moved}, error {error}");
    }
}
