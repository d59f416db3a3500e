//! What an eye lacks when it focuses on each depth layer, fed back to the field at the SLM plane.

use holod_calibration::{Colour, DisplayGeometry, Metres, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::depth_layers::DepthLayers;
use super::maps::{BLOCK, SCALE};
use crate::optics::{signed_bin, transfer_table};
use crate::weights::{Feedback, NetworkConfig};

/// Keeps the phase of what is dark defined: |a| = sqrt(re² + im² + this).
const DARK: f32 = 1e-6;

/// One step of Gerchberg and Saxton (1972) at all depth layers at once: the field goes through the pupil to every layer,
/// takes the wanted amplitude there with the phase that it has, and the mean of these changes comes back. The layers
/// change one another too; the second net mends that. Nothing is allocated after `new`.
pub(super) struct LayerFeedback {
    parameters: Feedback,
    optics: DisplayGeometry,
    /// From the SLM plane to the farthest layer, as `DepthLayers::step`.
    to_farthest: [Vec<Complex32>; 3],
    /// Transposed spectra: what reaches the layer at hand, and the changes of the layers so far.
    reaching: Vec<Complex32>,
    changes: Vec<Complex32>,
    /// The change of the field that would give what is lacking, [3, height, width].
    pub(super) change: Vec<Complex32>,
}

impl LayerFeedback {
    pub(super) fn new(config: &NetworkConfig, parameters: Feedback, size: Resolution) -> Self {
        let optics = config.optics.geometry(size);
        let far_m = optics.image_distance(optics.depth_far).0;
        let volume_m = optics.image_distance(optics.depth_near).0 - far_m;
        let farthest = Metres(far_m + volume_m / (2 * config.depth_layers) as f64);
        let table = |colour| transfer_table(optics.wavelengths[colour], pitch(&optics), size, farthest);
        let plane = || vec![Complex32::ZERO; size.pixels()];
        Self {
            parameters,
            optics,
            to_farthest: Colour::ALL.map(table),
            reaching: plane(),
            changes: plane(),
            change: vec![Complex32::ZERO; 3 * size.pixels()],
        }
    }

    /// Changes the field that `layers` carried by what it lacks of the amplitudes `stack` [layers, 3, height, width],
    /// which become that lack.
    pub(super) fn run(&mut self, layers: &mut DepthLayers, stack: &mut [f32], pupil_mm: f32) {
        let Self { parameters: Feedback { share, sharpness }, optics, to_farthest, reaching, changes, change } = self;
        let DepthLayers { count, size, layer_of, step, back, fft, carried } = layers;
        let pixels = size.pixels();
        // The tables are over the number of samples.
        let samples = pixels as f32;
        for colour in Colour::ALL {
            let index = colour.index();
            let plane = index * pixels..(index + 1) * pixels;
            let (field, change) = (&mut carried[plane.clone()], &mut change[plane.clone()]);
            let pupil = Pupil::new(optics, colour, pupil_mm, *size);

            change.copy_from_slice(field);
            fft.forward(change);
            reaching.copy_from_slice(&fft.spectrum);
            pupil.stop(reaching, &to_farthest[index]);
            changes.fill(Complex32::ZERO);
            for (layer, stack) in (0..*count).zip(stack.chunks_exact_mut(3 * pixels)) {
                fft.spectrum.copy_from_slice(reaching);
                fft.inverse(change);
                change.par_iter_mut().zip(&mut stack[plane.clone()]).zip(&*layer_of).for_each(
                    |((arriving, lack), block)| {
                        let inside = block.iter().filter(|&&of| of == layer).count() as f32 / BLOCK as f32;
                        let amplitude = (arriving.norm_sqr() + DARK).sqrt();
                        *lack -= amplitude;
                        *arriving *= (1.0 + *sharpness * inside) * *lack / amplitude;
                    },
                );
                fft.forward(change);
                let transformed = fft.spectrum.par_iter().zip(&step[index]);
                changes.par_iter_mut().zip(&mut *reaching).zip(transformed).for_each(
                    |((changes, reaching), (spectrum, step))| {
                        // Horner's rule over the layers; `back` undoes the way to the nearest.
                        let step = step * samples;
                        *changes = *changes * step + spectrum;
                        *reaching *= step;
                    },
                );
            }
            pupil.stop(changes, &back[index]);
            fft.spectrum.copy_from_slice(changes);
            fft.inverse(change);
            let mean = 1.0 / f32::from(*count);
            field.par_iter_mut().zip(change).for_each(|(field, change)| {
                *change *= mean;
                *field += *change * *share;
            });
        }
    }
}

fn pitch(optics: &DisplayGeometry) -> Metres {
    Metres(SCALE as f64 * optics.pixel_pitch.0)
}

/// The eye's pupil in the Fourier plane of the network's grid: a disc of radius (s/2)/(λ·f).
struct Pupil {
    radius_per_m: f64,
    /// Cycles per metre from one bin to the next.
    bin_per_m: [f64; 2],
    size: Resolution,
}

impl Pupil {
    fn new(optics: &DisplayGeometry, colour: Colour, pupil_mm: f32, size: Resolution) -> Self {
        Self {
            radius_per_m: 0.5e-3 * f64::from(pupil_mm)
                / (optics.wavelengths[colour].0 * optics.eyepiece_focal_length.0),
            bin_per_m: [size.width, size.height].map(|bins| 1.0 / (bins as f64 * pitch(optics).0)),
            size,
        }
    }

    /// Multiplies the transposed `spectrum` by `transfer` inside the pupil and sets it to 0 outside.
    fn stop(&self, spectrum: &mut [Complex32], transfer: &[Complex32]) {
        let Self { radius_per_m, bin_per_m, size: Resolution { width, height } } = *self;
        let squared = |bin, bins, bin_per_m: f64| (signed_bin(bin, bins) as f64 * bin_per_m).powi(2);
        spectrum.par_chunks_exact_mut(height).zip(transfer.par_chunks_exact(height)).enumerate().for_each(
            |(kx, (spectrum, transfer))| {
                let fx_squared = squared(kx, width, bin_per_m[0]);
                for (ky, (value, transfer)) in spectrum.iter_mut().zip(transfer).enumerate() {
                    let inside = fx_squared + squared(ky, height, bin_per_m[1]) < radius_per_m * radius_per_m;
                    *value = if inside { *value * transfer } else { Complex32::ZERO };
                }
            },
        );
    }
}
