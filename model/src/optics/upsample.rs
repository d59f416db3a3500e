//! Fourier upsampling by 2: from the half-band grid to the panel's, in real time.

use holod_calibration::Resolution;
use holod_fft::FftDirection;
use num_complex::Complex32;
use rayon::prelude::*;

use super::fft::{RowFft, signed_bin, transpose};

/// Upsamples one colour at a time from [height/2, width/2] to [height, width].
///
/// Sample (i, j) of the small grid lies at the centre of its 2x2 block, at (2i + ½, 2j + ½) of the large one, so the
/// spectrum is turned by exp(-j·2π·(fx + fy)/2), fx and fy in cycles per large pixel, and the samples stay where they
/// are. The result holds nothing at |fx| or |fy| ≥ ¼: the small grid's Nyquist bins are dropped. Zeros are never
/// transformed: the columns of the large spectrum that hold nothing are skipped.
pub(crate) struct FourierUpsampler {
    large: Resolution,
    small_rows: RowFft<f32>,
    small_columns: RowFft<f32>,
    large_columns: RowFft<f32>,
    large_rows: RowFft<f32>,
    /// Factor of each bin of the small grid: shift and normalisation, zero at Nyquist.
    factor_x: Vec<Complex32>,
    factor_y: Vec<Complex32>,
    /// [height/2, width/2], then [width/2, height/2]
    small: Vec<Complex32>,
    small_transposed: Vec<Complex32>,
    /// [width/2, height], then [height, width/2]
    tall: Vec<Complex32>,
    tall_transposed: Vec<Complex32>,
}

impl FourierUpsampler {
    /// For a large grid of even width and height.
    pub(crate) fn new(large: Resolution) -> Self {
        let (width, height) = (large.width / 2, large.height / 2);
        Self {
            large,
            small_rows: RowFft::new(width, FftDirection::Forward),
            small_columns: RowFft::new(height, FftDirection::Forward),
            large_columns: RowFft::new(large.height, FftDirection::Inverse),
            large_rows: RowFft::new(large.width, FftDirection::Inverse),
            factor_x: factors(width),
            factor_y: factors(height),
            small: vec![Complex32::ZERO; width * height],
            small_transposed: vec![Complex32::ZERO; width * height],
            tall: vec![Complex32::ZERO; width * large.height],
            tall_transposed: vec![Complex32::ZERO; width * large.height],
        }
    }

    /// Where the caller writes the small grid, row-major [height/2, width/2].
    pub(crate) fn input(&mut self) -> &mut [Complex32] {
        &mut self.small
    }

    /// Writes the upsampled input to `output` [height, width].
    pub(crate) fn upsample(&mut self, output: &mut [Complex32]) {
        let Resolution { width, height } = self.large;
        let (small_width, small_height) = (width / 2, height / 2);
        self.small_rows.process(&mut self.small);
        transpose(&self.small, &mut self.small_transposed, small_height, small_width);
        self.small_columns.process(&mut self.small_transposed);

        let (factor_x, factor_y) = (&self.factor_x, &self.factor_y);
        self.tall
            .par_chunks_exact_mut(height)
            .zip(self.small_transposed.par_chunks_exact(small_height))
            .enumerate()
            .for_each(|(kx, (tall, small))| {
                spread(small, tall, |ky, value| value * (factor_x[kx] * factor_y[ky]));
            });
        self.large_columns.process(&mut self.tall);
        transpose(&self.tall, &mut self.tall_transposed, small_width, height);
        output
            .par_chunks_exact_mut(width)
            .zip(self.tall_transposed.par_chunks_exact(small_width))
            .for_each(|(output, tall)| spread(tall, output, |_, value| value));
        self.large_rows.process(output);
    }
}

/// Writes a spectrum of n bins into one of 2n, the bins between being zero.
fn spread(small: &[Complex32], large: &mut [Complex32], value: impl Fn(usize, Complex32) -> Complex32) {
    let bins = small.len();
    let positive = bins.div_ceil(2);
    large[positive..bins + positive].fill(Complex32::ZERO);
    for bin in 0..positive {
        large[bin] = value(bin, small[bin]);
    }
    for bin in positive..bins {
        large[bins + bin] = value(bin, small[bin]);
    }
}

/// exp(-j·2π·f/2)/bins at each bin's frequency f = k/(2·bins), and zero at the Nyquist bin.
fn factors(bins: usize) -> Vec<Complex32> {
    (0..bins)
        .map(|bin| {
            if 2 * bin == bins {
                return Complex32::ZERO;
            }
            let frequency = signed_bin(bin, bins) as f64 / (2 * bins) as f64;
            let factor = num_complex::Complex64::cis(-std::f64::consts::PI * frequency) / bins as f64;
            Complex32::new(factor.re as f32, factor.im as f32)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::worst::worst;
    use num_complex::Complex64;
    use proptest::prelude::*;

    /// The trigonometric interpolation of the small grid, written out term by term in double precision.
    fn interpolated(small: &[Complex32], width: usize, height: usize, x: usize, y: usize) -> Complex64 {
        let mut sum = Complex64::ZERO;
        for (ky, kx) in (0..height).flat_map(|ky| (0..width).map(move |kx| (ky, kx))) {
            if 2 * kx == width || 2 * ky == height {
                continue;
            }
            let mut bin = Complex64::ZERO;
            for (j, i) in (0..height).flat_map(|j| (0..width).map(move |i| (j, i))) {
                let cycles = (kx * i) as f64 / width as f64 + (ky * j) as f64 / height as f64;
                let sample = small[j * width + i];
                bin += Complex64::new(sample.re.into(), sample.im.into())
                    * Complex64::cis(-std::f64::consts::TAU * cycles);
            }
            let cycles = signed_bin(kx, width) as f64 * (x as f64 - 0.5) / (2 * width) as f64
                + signed_bin(ky, height) as f64 * (y as f64 - 0.5) / (2 * height) as f64;
            sum += bin * Complex64::cis(std::f64::consts::TAU * cycles);
        }
        sum / (width * height) as f64
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn it_is_the_trigonometric_interpolation(width in 1usize..8, height in 1usize..8, seed in 0u32..1000) {
            let mut upsampler = FourierUpsampler::new(Resolution { width: 2 * width, height: 2 * height });
            let small: Vec<_> = (0..width * height)
                .map(|i| Complex32::new(((i as f32 + seed as f32) * 1.3).sin(), ((i * i) as f32 + 0.3 * seed as f32).cos()))
                .collect();
            let mut output = vec![Complex32::new(9.0, 9.0); 4 * width * height];
            // Twice, so that what one frame leaves behind would show in the next.
            for _ in 0..2 {
                upsampler.input().copy_from_slice(&small);
                upsampler.upsample(&mut output);
            }
            let places = (0..2 * height).flat_map(|y| (0..2 * width).map(move |x| (y, x)));
            let expected: Vec<_> = places.map(|(y, x)| interpolated(&small, width, height, x, y)).collect();
            let largest_error = |output: &[Complex32]| {
                let pairs = output.iter().zip(&expected);
                worst(pairs.map(|(actual, expected)| (Complex64::new(actual.re.into(), actual.im.into()) - expected).norm()))
            };
            prop_assert!(largest_error(&output) < 1e-5, "{}", largest_error(&output));
            output[seed as usize % (4 * width * height)] += 1e-3;
            prop_assert!(largest_error(&output) > 1e-5, "the comparison is blind");
        }
    }

    #[test]
    fn a_constant_keeps_its_amplitude() {
        let mut upsampler = FourierUpsampler::new(Resolution { width: 12, height: 8 });
        upsampler.input().fill(Complex32::new(0.7, -0.2));
        let mut output = vec![Complex32::ZERO; 96];
        upsampler.upsample(&mut output);
        assert!(output.iter().all(|value| (value - Complex32::new(0.7, -0.2)).norm() < 1e-6));
    }
}
