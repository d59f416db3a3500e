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
    transpose_apart(from, columns, to, rows, rows, columns);
}

/// The same between matrices whose rows begin `from_pitch` and `to_pitch` apart.
fn transpose_apart<T: Copy + Send + Sync>(
    from: &[T],
    from_pitch: usize,
    to: &mut [T],
    to_pitch: usize,
    rows: usize,
    columns: usize,
) {
    to.par_chunks_mut(BLOCK * to_pitch).enumerate().for_each(|(band, to)| {
        let first_column = band * BLOCK;
        let block_columns = BLOCK.min(columns - first_column);
        let from_row = |row: usize| &from[row * from_pitch + first_column..][..block_columns];
        for first_row in (0..rows).step_by(LINE) {
            let to_rows = to.chunks_mut(to_pitch).enumerate();
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

/// Two-dimensional circular transforms of several planes at once, between which something is done with the spectra of
/// all of them, column by column, while these are in the cache.
pub(crate) struct PlanesFft {
    width: usize,
    height: usize,
    planes: usize,
    rows_forward: RowFft<f32>,
    rows_inverse: RowFft<f32>,
    columns_forward: Arc<dyn Fft<f32>>,
    columns_inverse: Arc<dyn Fft<f32>>,
    scratch: Vec<Complex<f32>>,
    /// [width, planes, height]
    columns: Vec<Complex<f32>>,
}

impl PlanesFft {
    pub(crate) fn new(width: usize, height: usize, planes: usize) -> Self {
        let columns_forward = f32::plan(height, FftDirection::Forward);
        let columns_inverse = f32::plan(height, FftDirection::Inverse);
        let scratch_len = columns_forward.get_inplace_scratch_len().max(columns_inverse.get_inplace_scratch_len());
        Self {
            width,
            height,
            planes,
            rows_forward: RowFft::new(width, FftDirection::Forward),
            rows_inverse: RowFft::new(width, FftDirection::Inverse),
            columns_forward,
            columns_inverse,
            scratch: vec![Complex::ZERO; BANDS * scratch_len.max(1)],
            columns: vec![Complex::ZERO; width * planes * height],
        }
    }

    /// Takes plane `index` from `data` [height, width], which is used as scratch.
    pub(crate) fn take(&mut self, index: usize, data: &mut [Complex<f32>]) {
        let Self { width, height, planes, rows_forward, columns, .. } = self;
        rows_forward.process(data);
        transpose_apart(data, *width, &mut columns[index * *height..], *planes * *height, *height, *width);
    }

    /// Writes plane `index` to `data` [height, width].
    pub(crate) fn give(&mut self, index: usize, data: &mut [Complex<f32>]) {
        let Self { width, height, planes, rows_inverse, columns, .. } = self;
        transpose_apart(&columns[index * *height..], *planes * *height, data, *width, *width, *height);
        rows_inverse.process(data);
    }

    /// Runs `work` on each column and its number.
    pub(crate) fn for_each_column(&mut self, work: impl Fn(usize, Column<'_>) + Sync) {
        let Self { width, height, planes, columns_forward, columns_inverse, scratch, columns, .. } = self;
        let (columns_per_band, scratch_len) = (width.div_ceil(BANDS), scratch.len() / BANDS);
        let bands = columns.par_chunks_mut(columns_per_band * *planes * *height);
        bands.zip(scratch.par_chunks_exact_mut(scratch_len)).enumerate().for_each(|(band, (columns, scratch))| {
            let first = band * columns_per_band;
            for (kx, values) in (first..).zip(columns.chunks_exact_mut(*planes * *height)) {
                let [forward, inverse] = [&**columns_forward, &**columns_inverse];
                work(kx, Column { values, forward, inverse, scratch });
            }
        });
    }
}

/// One column of all planes.
pub(crate) struct Column<'a> {
    /// [planes, height]
    pub(crate) values: &'a mut [Complex<f32>],
    forward: &'a dyn Fft<f32>,
    inverse: &'a dyn Fft<f32>,
    scratch: &'a mut [Complex<f32>],
}

impl Column<'_> {
    /// Transforms the column of one plane to its spectrum.
    pub(crate) fn transform(&mut self, plane: usize) {
        let height = self.forward.len();
        self.forward.process_with_scratch(&mut self.values[plane * height..][..height], self.scratch);
    }

    /// Transforms the spectra of all planes back, times height.
    pub(crate) fn transform_back(&mut self) {
        self.inverse.process_with_scratch(self.values, self.scratch);
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
    fn planes_change_places_between_the_transforms_and_only_there() {
        let size @ (width, height) = (11, 6);
        let planes: [Vec<_>; 3] = std::array::from_fn(|plane| {
            let value = |i| Complex::cis((i as f32 + 7.0 * plane as f32).powf(1.7));
            (0..width * height).map(value).collect()
        });
        let mut fft = PlanesFft::new(width, height, 3);
        for (index, plane) in planes.iter().enumerate() {
            fft.take(index, &mut plane.clone());
        }
        let twice_at = 4;
        fft.for_each_column(|kx, mut column| {
            (0..3).for_each(|plane| column.transform(plane));
            column.values.rotate_left(height);
            column.values.iter_mut().for_each(|value| *value *= if kx == twice_at { 2.0 } else { 1.0 });
            column.transform_back();
        });
        let mut spectrum = TransposedFft2d::new(size.0, size.1);
        for (index, plane) in planes.iter().cycle().skip(1).take(3).enumerate() {
            let mut expected = plane.clone();
            spectrum.forward(&mut expected);
            spectrum.spectrum[twice_at * height..][..height].iter_mut().for_each(|value| *value *= 2.0);
            spectrum.inverse(&mut expected);
            let mut found = vec![Complex::ZERO; width * height];
            fft.give(index, &mut found);
            let difference = |found: &[Complex<f32>]| {
                let differences = found.iter().zip(&expected).map(|(a, b)| (a - b).norm());
                worst(differences)
            };
            assert!(difference(&found) < 1e-3, "plane {index}: {}", difference(&found));
            found[17].im += 2e-3;
            assert!(difference(&found) > 1e-3, "the comparison is blind");
        }
    }

    #[test]
    fn signed_bins_put_nyquist_on_the_negative_side() {
        assert_eq!((0..4).map(|bin| signed_bin(bin, 4)).collect::<Vec<_>>(), [0, 1, -2, -1]);
        assert_eq!((0..5).map(|bin| signed_bin(bin, 5)).collect::<Vec<_>>(), [0, 1, 2, -2, -1]);
    }
}
