//! Row transforms and transposes, from which the two-dimensional transforms of this module are made. Nothing here
//! allocates once it was built.

use std::sync::Arc;

use holod_fft::{Fft, FftDirection, Real};
use num_complex::Complex;
use rayon::prelude::*;

/// Side of the square blocks in which a transpose walks its matrix.
const BLOCK: usize = 32;
/// Rows that are read together, so that what is written of them fills whole lines of the cache.
const LINE: usize = 8;
/// Bands into which the rows of a matrix are divided among threads.
const BANDS: usize = 16;

/// A one-dimensional transform of every row of a matrix, not normalised.
pub(crate) struct RowFft<T: Real> {
    fft: Arc<dyn Fft<T>>,
    scratch: Vec<Complex<T>>,
}

impl<T: Real> RowFft<T> {
    pub(crate) fn new(length: usize, direction: FftDirection) -> Self {
        let fft = T::plan(length, direction);
        let scratch = vec![Complex::new(T::zero(), T::zero()); BANDS * fft.get_inplace_scratch_len().max(1)];
        Self { fft, scratch }
    }

    /// Transforms each row of `matrix`, whose rows have this transform's length, in place.
    pub(crate) fn process(&mut self, matrix: &mut [Complex<T>]) {
        let length = self.fft.len();
        let rows_per_band = (matrix.len() / length).div_ceil(BANDS).max(1);
        let scratch_len = self.scratch.len() / BANDS;
        matrix
            .par_chunks_mut(rows_per_band * length)
            .zip(self.scratch.par_chunks_mut(scratch_len))
            .for_each(|(rows, scratch)| self.fft.process_with_scratch(rows, scratch));
    }
}

/// Writes the transpose of `from` [rows, columns] to `to` [columns, rows].
pub(crate) fn transpose<T: Copy + Send + Sync>(from: &[T], to: &mut [T], rows: usize, columns: usize) {
    debug_assert!(from.len() == rows * columns && to.len() == from.len());
    to.par_chunks_mut(BLOCK * rows).enumerate().for_each(|(band, to)| {
        let first_column = band * BLOCK;
        let block_columns = BLOCK.min(columns - first_column);
        let from_row = |row: usize| &from[row * columns + first_column..][..block_columns];
        for first_row in (0..rows).step_by(LINE) {
            let to_rows = to.chunks_mut(rows).enumerate();
            if rows - first_row < LINE {
                for (offset, to_row) in to_rows {
                    for (row, to) in (first_row..rows).zip(&mut to_row[first_row..rows]) {
                        *to = from_row(row)[offset];
                    }
                }
                continue;
            }
            let block: [&[T]; LINE] = std::array::from_fn(|row| from_row(first_row + row));
            for (offset, to_row) in to_rows {
                for (to, row) in to_row[first_row..][..LINE].iter_mut().zip(block) {
                    *to = row[offset];
                }
            }
        }
    });
}

/// A two-dimensional circular transform that leaves the spectrum transposed, which saves two of four transposes.
pub(crate) struct TransposedFft2d<T: Real> {
    width: usize,
    height: usize,
    rows_forward: RowFft<T>,
    rows_inverse: RowFft<T>,
    columns_forward: RowFft<T>,
    columns_inverse: RowFft<T>,
    /// [width, height]: the transposed spectrum between `forward` and `inverse`.
    pub(crate) spectrum: Vec<Complex<T>>,
}

impl<T: Real> TransposedFft2d<T> {
    pub(crate) fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            rows_forward: RowFft::new(width, FftDirection::Forward),
            rows_inverse: RowFft::new(width, FftDirection::Inverse),
            columns_forward: RowFft::new(height, FftDirection::Forward),
            columns_inverse: RowFft::new(height, FftDirection::Inverse),
            spectrum: vec![Complex::new(T::zero(), T::zero()); width * height],
        }
    }

    /// Transforms `data` [height, width], which is used as scratch, into `self.spectrum` [width, height].
    pub(crate) fn forward(&mut self, data: &mut [Complex<T>]) {
        self.rows_forward.process(data);
        transpose(data, &mut self.spectrum, self.height, self.width);
        self.columns_forward.process(&mut self.spectrum);
    }

    /// Transforms `self.spectrum`, which is used as scratch, back into `data`, times width·height.
    pub(crate) fn inverse(&mut self, data: &mut [Complex<T>]) {
        self.columns_inverse.process(&mut self.spectrum);
        transpose(&self.spectrum, data, self.width, self.height);
        self.rows_inverse.process(data);
    }
}

/// The signed frequency index of bin `bin` among `bins`, in -bins/2..bins/2.
pub(crate) fn signed_bin(bin: usize, bins: usize) -> isize {
    if 2 * bin < bins { bin as isize } else { bin as isize - bins as isize }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::worst::worst;
    use proptest::prelude::*;

    /// The definition of the transform, term by term.
    fn direct_dft(data: &[Complex<f64>], width: usize, height: usize) -> Vec<Complex<f64>> {
        let mut spectrum = vec![Complex::new(0.0, 0.0); width * height];
        for (kx, ky) in (0..width).flat_map(|kx| (0..height).map(move |ky| (kx, ky))) {
            for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
                let cycles = (kx * x) as f64 / width as f64 + (ky * y) as f64 / height as f64;
                spectrum[kx * height + ky] += data[y * width + x] * Complex::cis(-std::f64::consts::TAU * cycles);
            }
        }
        spectrum
    }

    fn largest_difference(a: &[Complex<f64>], b: &[Complex<f64>]) -> f64 {
        worst(a.iter().zip(b).map(|(a, b)| (a - b).norm()))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn the_transform_is_the_dft_and_inverts(width in 1usize..13, height in 1usize..13, seed in 0u64..1000) {
            let data: Vec<_> = (0..width * height)
                .map(|i| Complex::cis((i as f64 + seed as f64).powf(1.7)) * (1.0 + (i % 5) as f64))
                .collect();
            let mut fft = TransposedFft2d::new(width, height);
            let mut work = data.clone();
            fft.forward(&mut work);
            let mut expected = direct_dft(&data, width, height);
            prop_assert!(largest_difference(&fft.spectrum, &expected) < 1e-9);
            expected[0].re += 1e-3;
            prop_assert!(largest_difference(&fft.spectrum, &expected) > 1e-9, "the comparison sees one wrong value");
            fft.inverse(&mut work);
            let scale = (width * height) as f64;
            prop_assert!(work.iter().zip(&data).all(|(a, b)| (a / scale - b).norm() < 1e-9));
        }

        #[test]
        fn a_transpose_moves_every_element(rows in 1usize..80, columns in 1usize..80) {
            let from: Vec<usize> = (0..rows * columns).collect();
            let mut to = vec![usize::MAX; from.len()];
            transpose(&from, &mut to, rows, columns);
            for row in 0..rows {
                for column in 0..columns {
                    prop_assert_eq!(to[column * rows + row], from[row * columns + column]);
                }
            }
        }
    }

    #[test]
    fn signed_bins_put_nyquist_on_the_negative_side() {
        assert_eq!((0..4).map(|bin| signed_bin(bin, 4)).collect::<Vec<_>>(), [0, 1, -2, -1]);
        assert_eq!((0..5).map(|bin| signed_bin(bin, 5)).collect::<Vec<_>>(), [0, 1, 2, -2, -1]);
    }
}
