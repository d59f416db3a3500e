//! Light on planes of the depth volume, and how it goes between them and the SLM plane.

use holod_calibration::{Colour, DisplayGeometry, Metres, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::input_features::sample_pitch;
use crate::optics::{TransposedFft2d, transfer_table};

/// Planes equally far apart, which is equal in dioptres, too.
#[derive(Clone, Copy)]
pub(super) struct PlanePositions {
    pub(super) count: usize,
    /// Where the farthest is imaged, from the SLM plane.
    pub(super) farthest: Metres,
    /// From one to the next nearer one.
    pub(super) step: Metres,
}

impl PlanePositions {
    /// The middles of `count` layers into which the depth volume of `bench` is divided.
    pub(super) fn of_layers(count: usize, bench: &DisplayGeometry) -> Self {
        let far_m = bench.image_distance(bench.depth_far).0;
        let step_m = (bench.image_distance(bench.depth_near).0 - far_m) / count as f64;
        Self { count, farthest: Metres(far_m + step_m / 2.0), step: Metres(step_m) }
    }

    /// `count` planes, of which the first and the last are the ends of the depth volume of `bench`.
    pub(super) fn from_end_to_end(count: usize, bench: &DisplayGeometry) -> Self {
        let farthest = bench.image_distance(bench.depth_far);
        let step_m = (bench.image_distance(bench.depth_near).0 - farthest.0) / (count - 1) as f64;
        Self { count, farthest, step: Metres(step_m) }
    }
}

/// Light of planes far to near, carried by ASM on the half-band grid. Nothing is allocated after `new`.
///
/// Transfer functions are transposed spectra of each colour, over the number of samples.
pub(super) struct PlaneLight {
    pub(super) count: usize,
    size: Resolution,
    /// From one plane to the next nearer one, and from the nearest to the SLM plane.
    step: [Vec<Complex32>; 3],
    back: [Vec<Complex32>; 3],
    fft: TransposedFft2d<f32>,
    /// [3, height, width]: what arrives at the SLM plane.
    pub(super) carried: Vec<Complex32>,
}

impl PlaneLight {
    pub(super) fn new(positions: PlanePositions, bench: &DisplayGeometry, size: Resolution) -> Self {
        let PlanePositions { count, farthest, step } = positions;
        let tables = |u_m: f64| {
            let table = |colour| transfer_table(bench.wavelengths[colour], sample_pitch(bench), size, Metres(u_m));
            Colour::ALL.map(table)
        };
        Self {
            count,
            size,
            step: tables(step.0),
            back: tables(-(farthest.0 + (count - 1) as f64 * step.0)),
            fft: TransposedFft2d::new(size.width, size.height),
            carried: vec![Complex32::ZERO; 3 * size.pixels()],
        }
    }

    /// Adds the light [height, width] that one plane sends out, which is used up, to the transposed spectrum `sum` of
    /// the light of farther ones: Horner's rule, far to near, from zeros on.
    pub(super) fn add_light(&mut self, colour: Colour, light: &mut [Complex32], sum: &mut [Complex32]) {
        self.fft.forward(light);
        let samples = self.size.pixels() as f32;
        let transformed = self.fft.spectrum.par_iter().zip(&self.step[colour.index()]);
        sum.par_iter_mut().zip(transformed).for_each(|(sum, (spectrum, step))| {
            *sum = *sum * (step * samples) + spectrum;
        });
    }

    /// Writes to `field` [height, width] what arrives at the SLM plane of the light of all planes.
    pub(super) fn bring_back(&mut self, colour: Colour, sum: &[Complex32], field: &mut [Complex32]) {
        let summed = sum.par_iter().zip(&self.back[colour.index()]);
        self.fft.spectrum.par_iter_mut().zip(summed).for_each(|(value, (sum, back))| *value = sum * back);
        self.fft.inverse(field);
    }

    /// Writes the transposed spectrum of one colour of the carried field, times `transfer`, to `spectrum`; `scratch` is
    /// [height, width].
    pub(super) fn send(
        &mut self,
        colour: Colour,
        transfer: &[Complex32],
        spectrum: &mut [Complex32],
        scratch: &mut [Complex32],
    ) {
        scratch.copy_from_slice(&self.carried[colour.index() * self.size.pixels()..][..self.size.pixels()]);
        self.fft.forward(scratch);
        let sent = self.fft.spectrum.par_iter().zip(transfer);
        spectrum.par_iter_mut().zip(sent).for_each(|(value, (sent, transfer))| *value = sent * transfer);
    }

    /// Writes the light [height, width] of a transposed `spectrum`, and carries that to the next nearer plane.
    pub(super) fn arrive(&mut self, colour: Colour, spectrum: &mut [Complex32], light: &mut [Complex32]) {
        self.fft.spectrum.copy_from_slice(spectrum);
        self.fft.inverse(light);
        let samples = self.size.pixels() as f32;
        spectrum.par_iter_mut().zip(&self.step[colour.index()]).for_each(|(value, step)| *value *= step * samples);
    }
}
