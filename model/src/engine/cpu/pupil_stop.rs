//! The eye's pupil as a stop of light.

use holod_calibration::{Colour, DisplayGeometry, Resolution};

use super::input_features::sample_pitch;
use crate::optics::signed_bin;
use crate::simd::{InstructionSet, Simd};

/// The pupil in the Fourier plane of the network's grid: a disc of radius (s/2)/(λ·f).
pub(super) struct PupilStop {
    /// Squares of each colour's radius and of each bin's frequency along rows and along columns, in cycles per metre
    /// squared; the latter up to whole blocks of rows.
    radius_squared: [f64; 3],
    along_rows: Vec<f64>,
    along_columns: Vec<f64>,
    bench: DisplayGeometry,
}

impl PupilStop {
    pub(super) fn new(bench: &DisplayGeometry, size: Resolution, set: InstructionSet) -> Self {
        let squared = |bins: usize, padded: usize| {
            let bin_per_m = 1.0 / (bins as f64 * sample_pitch(bench).0);
            (0..padded).map(move |bin| (signed_bin(bin, bins) as f64 * bin_per_m).powi(2))
        };
        Self {
            radius_squared: [0.0; 3],
            along_rows: squared(size.width, size.width).collect(),
            along_columns: squared(size.height, size.height.next_multiple_of(set.lanes())).collect(),
            bench: *bench,
        }
    }

    /// Takes the diameter of an eye's pupil.
    pub(super) fn set_mm(&mut self, pupil_mm: f32) {
        let focal_length_m = self.bench.eyepiece_focal_length.0;
        self.radius_squared = Colour::ALL
            .map(|colour| (0.5e-3 * f64::from(pupil_mm) / (self.bench.wavelengths[colour].0 * focal_length_m)).powi(2));
    }

    /// Sets what lies outside to 0 in the cells [column] of one colour's spectrum in one block of rows.
    #[inline(always)]
    pub(super) fn stop<S: Simd>(&self, colour: Colour, block: usize, cells: &mut [f32]) {
        let radius_squared = self.radius_squared[colour.index()];
        let along_columns = &self.along_columns[block * S::LANES..][..S::LANES];
        for (along_row, cell) in self.along_rows.iter().zip(cells.chunks_exact_mut(2 * S::LANES)) {
            let (re, im) = cell.split_at_mut(S::LANES);
            for ((re, im), along_column) in re.iter_mut().zip(im).zip(along_columns) {
                let is_outside = along_row + along_column >= radius_squared;
                *re = if is_outside { 0.0 } else { *re };
                *im = if is_outside { 0.0 } else { *im };
            }
        }
    }
}
