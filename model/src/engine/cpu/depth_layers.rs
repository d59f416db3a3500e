//! Light of surfaces at many depths, composed far to near with occlusion and carried to the SLM plane.

use holod_calibration::{Colour, Metres, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::Blocks;
use super::maps::{BLOCK, SCALE};
use crate::RgbdFrame;
use crate::optics::{TransposedFft2d, transfer_table};
use crate::weights::NetworkConfig;

/// f ← f·(1 − m) + O·m from far to near, by ASM between layers and at last back to the SLM plane; m is the share of a
/// block whose pixels lie in a layer or its next nearer one, so that slanted surfaces show no seams.
pub(super) struct DepthLayers {
    pub(super) count: u8,
    pub(super) size: Resolution,
    /// The depth layer of each pixel of each block, [height, width, 4].
    pub(super) layer_of: Vec<[u8; BLOCK]>,
    /// From one layer to the next nearer one, and from the nearest to the SLM plane; transposed spectra, of each colour,
    /// over the number of samples.
    pub(super) step: [Vec<Complex32>; 3],
    pub(super) back: [Vec<Complex32>; 3],
    pub(super) fft: TransposedFft2d<f32>,
    /// [3, height, width]: what arrives at the SLM plane.
    pub(super) carried: Vec<Complex32>,
}

impl DepthLayers {
    pub(super) fn new(config: &NetworkConfig, size: Resolution) -> Self {
        let optics = config.optics.geometry(size);
        let pitch = Metres(SCALE as f64 * optics.pixel_pitch.0);
        let volume_m = optics.image_distance(optics.depth_near).0 - optics.image_distance(optics.depth_far).0;
        let layer_m = volume_m / config.depth_layers as f64;
        let nearest_m = optics.image_distance(optics.depth_near).0 - layer_m / 2.0;
        let table = |colour, u_m| transfer_table(optics.wavelengths[colour], pitch, size, Metres(u_m));
        Self {
            count: config.depth_layers as u8,
            size,
            layer_of: vec![[0; BLOCK]; size.pixels()],
            step: Colour::ALL.map(|colour| table(colour, layer_m)),
            back: Colour::ALL.map(|colour| table(colour, -nearest_m)),
            fft: TransposedFft2d::new(size.width, size.height),
            carried: vec![Complex32::ZERO; 3 * size.pixels()],
        }
    }

    /// Takes the depths of `frame`.
    pub(super) fn place(&mut self, frame: &RgbdFrame) {
        let blocks = Blocks { frame: frame.resolution, scale: SCALE };
        let (columns, count) = (self.size.width, self.count);
        self.layer_of.par_chunks_exact_mut(columns).enumerate().for_each(|(y, row)| {
            for (x, block) in row.iter_mut().enumerate() {
                for (corner, layer) in block.iter_mut().enumerate() {
                    let depth = frame.depth_normalised[blocks.index(x, y, corner)];
                    // A cast of what lies outside saturates.
                    *layer = ((depth * f32::from(count)) as u8).min(count - 1);
                }
            }
        });
    }

    /// Writes what `source` [3, height, width] sends to the SLM plane to `self.carried`.
    pub(super) fn compose(&mut self, source: &[Complex32]) {
        let Self { count, size, layer_of, step, back, fft, carried } = self;
        let pixels = size.pixels();
        for ((field, source), (step, back)) in
            carried.chunks_exact_mut(pixels).zip(source.chunks_exact(pixels)).zip(step.iter().zip(back.iter()))
        {
            field.fill(Complex32::ZERO);
            for layer in 0..*count {
                if layer > 0 {
                    carry(fft, field, step);
                }
                field.par_iter_mut().zip(source).zip(layer_of.par_iter()).for_each(|((field, source), block)| {
                    let inside = block.iter().filter(|&&of| of == layer || of == layer + 1).count();
                    *field += (source - *field) * (inside as f32 / BLOCK as f32);
                });
            }
            carry(fft, field, back);
        }
    }
}

/// Multiplies the spectrum of `field` by `transfer`.
fn carry(fft: &mut TransposedFft2d<f32>, field: &mut [Complex32], transfer: &[Complex32]) {
    fft.forward(field);
    fft.spectrum.par_iter_mut().zip(transfer).for_each(|(value, transfer)| *value *= transfer);
    fft.inverse(field);
}
