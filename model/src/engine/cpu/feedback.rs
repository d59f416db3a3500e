//! What an eye lacks when it focuses on each plane, fed back to the field at the SLM plane.

use holod_calibration::{Colour, DisplayGeometry, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::input_features::sample_pitch;
use super::plane_light::{PlaneLight, PlanePositions};
use crate::engine::constants::FEEDBACK_DARK_POWER;
use crate::optics::{signed_bin, transfer_table};

/// One step of Gerchberg and Saxton (1972) at all planes at once: the field goes through the pupil to every plane,
/// takes the wanted amplitude there with the phase that it has, and the mean of these changes comes back, each with its
/// weight. The planes change one another too; the second net mends that. Nothing is allocated after `new`.
pub(super) struct PlaneFeedback {
    /// The share of the change that the field takes.
    share: f32,
    bench: DisplayGeometry,
    size: Resolution,
    /// From the SLM plane to the farthest plane: transposed spectra of each colour, over the number of samples.
    to_farthest: [Vec<Complex32>; 3],
    /// Transposed spectrum of what reaches the plane at hand.
    reaching: Vec<Complex32>,
    /// The change of the field that would give what is lacking, [3, height, width].
    pub(super) change: Vec<Complex32>,
}

impl PlaneFeedback {
    pub(super) fn new(share: f32, positions: PlanePositions, bench: &DisplayGeometry, size: Resolution) -> Self {
        let table = |colour| transfer_table(bench.wavelengths[colour], sample_pitch(bench), size, positions.farthest);
        Self {
            share,
            bench: *bench,
            size,
            to_farthest: Colour::ALL.map(table),
            reaching: vec![Complex32::ZERO; size.pixels()],
            change: vec![Complex32::ZERO; 3 * size.pixels()],
        }
    }

    /// Changes the field that `light` carried by what it lacks of the amplitudes `stack` [planes, 3, height, width],
    /// which become that lack. `weight` is that of a change at a plane and a sample; `sum` is scratch for a spectrum.
    pub(super) fn run(
        &mut self,
        light: &mut PlaneLight,
        stack: &mut [f32],
        sum: &mut [Complex32],
        pupil_mm: f32,
        weight: impl Fn(usize, usize) -> f32 + Sync,
    ) {
        let Self { share, bench, size, to_farthest, reaching, change } = self;
        let pixels = size.pixels();
        let mean = 1.0 / light.count as f32;
        for colour in Colour::ALL {
            let plane = colour.index() * pixels..(colour.index() + 1) * pixels;
            let pupil = Pupil::new(bench, colour, pupil_mm, *size);
            // Until the last step it holds the light at one plane after another.
            let change = &mut change[plane.clone()];

            light.send(colour, &to_farthest[colour.index()], reaching, change);
            pupil.stop(reaching);
            sum.fill(Complex32::ZERO);
            for (number, stack) in stack.chunks_exact_mut(3 * pixels).enumerate() {
                light.arrive(colour, reaching, change);
                change.par_iter_mut().zip(&mut stack[plane.clone()]).enumerate().for_each(
                    |(sample, (arriving, lack))| {
                        let amplitude = (arriving.norm_sqr() + FEEDBACK_DARK_POWER).sqrt();
                        *lack -= amplitude;
                        *arriving *= weight(number, sample) * *lack / amplitude;
                    },
                );
                light.add_light(colour, change, sum);
            }
            pupil.stop(sum);
            light.bring_back(colour, sum, change);
            light.carried[plane].par_iter_mut().zip(change).for_each(|(field, change)| {
                *change *= mean;
                *field += *change * *share;
            });
        }
    }
}

/// The eye's pupil in the Fourier plane of the network's grid: a disc of radius (s/2)/(λ·f).
struct Pupil {
    radius_per_m: f64,
    /// Cycles per metre from one bin to the next.
    bin_per_m: [f64; 2],
    size: Resolution,
}

impl Pupil {
    fn new(bench: &DisplayGeometry, colour: Colour, pupil_mm: f32, size: Resolution) -> Self {
        Self {
            radius_per_m: 0.5e-3 * f64::from(pupil_mm) / (bench.wavelengths[colour].0 * bench.eyepiece_focal_length.0),
            bin_per_m: [size.width, size.height].map(|bins| 1.0 / (bins as f64 * sample_pitch(bench).0)),
            size,
        }
    }

    /// Sets the transposed `spectrum` to 0 outside the pupil.
    fn stop(&self, spectrum: &mut [Complex32]) {
        let Self { radius_per_m, bin_per_m, size: Resolution { width, height } } = *self;
        let squared = |bin, bins, bin_per_m: f64| (signed_bin(bin, bins) as f64 * bin_per_m).powi(2);
        spectrum.par_chunks_exact_mut(height).enumerate().for_each(|(kx, spectrum)| {
            let fx_squared = squared(kx, width, bin_per_m[0]);
            for (ky, value) in spectrum.iter_mut().enumerate() {
                if fx_squared + squared(ky, height, bin_per_m[1]) >= radius_per_m * radius_per_m {
                    *value = Complex32::ZERO;
                }
            }
        });
    }
}
