//! Layers of the depth volume: which of them each pixel lies in, and how light goes between them and the SLM plane.

use holod_calibration::{Colour, DisplayGeometry, Metres, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::Blocks;
use super::input_features::{BLOCK, SCALE, sample_pitch};
use crate::RgbdFrame;
use crate::optics::{TransposedFft2d, transfer_table};
use crate::weights::NetworkConfig;

/// Layers equal in dioptres, far to near, by ASM on the half-band grid. Nothing is allocated after `new`.
///
/// Transfer functions are transposed spectra of each colour, over the number of samples.
pub(super) struct DepthLayers {
    count: u8,
    size: Resolution,
    /// The depth layer of each pixel of each block, [height, width, 4].
    layer_of: Vec<[u8; BLOCK]>,
    /// From one layer to the next nearer one, and from the nearest to the SLM plane.
    step: [Vec<Complex32>; 3],
    back: [Vec<Complex32>; 3],
    fft: TransposedFft2d<f32>,
    /// [3, height, width]: what arrives at the SLM plane.
    pub(super) carried: Vec<Complex32>,
}

impl DepthLayers {
    pub(super) fn new(config: &NetworkConfig, bench: &DisplayGeometry, size: Resolution) -> Self {
        let far_m = bench.image_distance(bench.depth_far).0;
        let near_m = bench.image_distance(bench.depth_near).0;
        let layer_m = (near_m - far_m) / config.depth_layers as f64;
        let tables = |u_m: f64| {
            let table = |colour| transfer_table(bench.wavelengths[colour], sample_pitch(bench), size, Metres(u_m));
            Colour::ALL.map(table)
        };
        Self {
            count: config.depth_layers as u8,
            size,
            layer_of: vec![[0; BLOCK]; size.pixels()],
            step: tables(layer_m),
            back: tables(layer_m / 2.0 - near_m),
            fft: TransposedFft2d::new(size.width, size.height),
            carried: vec![Complex32::ZERO; 3 * size.pixels()],
        }
    }

    /// The layers' numbers, far to near.
    pub(super) fn numbers(&self) -> std::ops::Range<u8> {
        0..self.count
    }

    /// Each block's share in one layer, [height, width].
    pub(super) fn cover(&self, layer: u8) -> impl IndexedParallelIterator<Item = f32> {
        let share = move |block: &[u8; BLOCK]| block.iter().filter(|&&of| of == layer).count() as f32 / BLOCK as f32;
        self.layer_of.par_iter().map(share)
    }

    /// The layers of the corners of each block of row `y`.
    pub(super) fn row(&self, y: usize) -> &[[u8; BLOCK]] {
        &self.layer_of[y * self.size.width..][..self.size.width]
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

    /// Adds the light [height, width] that one layer sends out, which is used up, to the transposed spectrum `sum` of
    /// the light of farther ones: Horner's rule, far to near, from zeros on.
    pub(super) fn add_light(&mut self, colour: Colour, light: &mut [Complex32], sum: &mut [Complex32]) {
        self.fft.forward(light);
        let samples = self.size.pixels() as f32;
        let transformed = self.fft.spectrum.par_iter().zip(&self.step[colour.index()]);
        sum.par_iter_mut().zip(transformed).for_each(|(sum, (spectrum, step))| {
            *sum = *sum * (step * samples) + spectrum;
        });
    }

    /// Writes to `field` [height, width] what arrives at the SLM plane of the light of all layers.
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

    /// Writes the light [height, width] of a transposed `spectrum`, and carries that to the next nearer layer.
    pub(super) fn arrive(&mut self, colour: Colour, spectrum: &mut [Complex32], light: &mut [Complex32]) {
        self.fft.spectrum.copy_from_slice(spectrum);
        self.fft.inverse(light);
        let samples = self.size.pixels() as f32;
        spectrum.par_iter_mut().zip(&self.step[colour.index()]).for_each(|(value, step)| *value *= step * samples);
    }
}
