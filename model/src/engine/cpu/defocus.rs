//! What an eye should see at each depth layer, as far as a picture and its depth tell.

use std::f64::consts::PI;

use holod_calibration::Resolution;
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::Blocks;
use super::depth_layers::DepthLayers;
use super::maps::{BLOCK, SCALE, sample_pitch};
use crate::RgbdFrame;
use crate::optics::{TransposedFft2d, signed_bin};
use crate::weights::NetworkConfig;

/// Entries of the disc's table to a unit of its argument: linear interpolation is then within 5e-7.
const TABLE_DENSITY: f64 = 256.0;
/// The largest argument of that table: beyond it a disc's spectrum is below 1e-5.
const LARGEST_ARGUMENT: f64 = 4096.0;
/// The least share of a white scene's light by which what is seen is divided.
const LEAST_COVER: f32 = 0.02;
/// White with red, and green with blue: real pictures, two to a complex transform.
const PAIRS: usize = 2;

/// Blurs each depth layer by its disc of confusion at the focus on each other one, and divides the sum by that of a white
/// scene. Blur is circular, and no layer hides another. Nothing is allocated after `new`.
pub(super) struct Defocus {
    size: Resolution,
    /// 2·J1(x)/x, the spectrum of a disc, at x·TABLE_DENSITY.
    disc_table: Vec<f32>,
    /// π times the diameter of the disc that blurs a layer's neighbour, samples to a millimetre of pupil.
    argument_per_mm: f64,
    /// The pupil that `discs` is for.
    pupil_mm: f32,
    /// Over the number of samples: spectra, transposed, of the discs between layers that are 0, 1, 2, .. apart.
    discs: Vec<Vec<f32>>,
    /// Whether a layer has a pixel; if so, the spectra of its light, transposed.
    present: Vec<bool>,
    spectra: Vec<[Vec<Complex32>; PAIRS]>,
    seen: [Vec<Complex32>; PAIRS],
    fft: TransposedFft2d<f32>,
}

impl Defocus {
    pub(super) fn new(config: &NetworkConfig, size: Resolution) -> Self {
        let count = config.depth_layers;
        let optics = config.optics.geometry(size);
        let layer_dpt = (optics.depth_near.0 - optics.depth_far.0) / count as f64;
        let sample_rad = sample_pitch(&optics).0 / optics.eyepiece_focal_length.0;
        let argument_per_mm = PI * layer_dpt * 1e-3 / sample_rad;
        // No frequency is higher than half a cycle a sample each way.
        let largest = argument_per_mm * f64::from(config.pupil_range_mm[1]) * count as f64 * 0.5f64.sqrt();
        let disc = |entry: usize| match entry as f64 / TABLE_DENSITY {
            0.0 => 1.0,
            x => (2.0 * libm::j1(x) / x) as f32,
        };
        let plane = || vec![Complex32::ZERO; size.pixels()];
        Self {
            size,
            disc_table: (0..(largest.min(LARGEST_ARGUMENT) * TABLE_DENSITY) as usize + 2).map(disc).collect(),
            argument_per_mm,
            pupil_mm: f32::NAN,
            discs: vec![vec![0.0; size.pixels()]; count],
            present: vec![false; count],
            spectra: (0..count).map(|_| [plane(), plane()]).collect(),
            seen: [plane(), plane()],
            fft: TransposedFft2d::new(size.width, size.height),
        }
    }

    /// Writes the expected amplitudes [layers, 3, height, width] of `frame`, whose depths `layers` has.
    pub(super) fn expect(&mut self, frame: &RgbdFrame, layers: &DepthLayers, pupil_mm: f32, amplitudes: &mut [f32]) {
        self.shape_discs(pupil_mm);
        for layer in layers.numbers() {
            self.transform_layer(frame, layers, layer);
        }
        for (focus, amplitudes) in amplitudes.chunks_exact_mut(3 * self.size.pixels()).enumerate() {
            self.see(focus, amplitudes);
        }
    }

    /// Sets the discs to those of a pupil, unless they are already.
    fn shape_discs(&mut self, pupil_mm: f32) {
        if self.pupil_mm == pupil_mm {
            return;
        }
        let Self { size: Resolution { width, height }, disc_table, argument_per_mm, discs, .. } = self;
        let (width, height, norm) = (*width, *height, 1.0 / (*width * *height) as f32);
        for (apart, disc) in discs.iter_mut().enumerate() {
            let scale = *argument_per_mm * f64::from(pupil_mm) * apart as f64 * TABLE_DENSITY;
            disc.par_chunks_exact_mut(height).enumerate().for_each(|(kx, disc)| {
                let fx = signed_bin(kx, width) as f64 / width as f64;
                for (ky, value) in disc.iter_mut().enumerate() {
                    let fy = signed_bin(ky, height) as f64 / height as f64;
                    let entry = scale * (fx * fx + fy * fy).sqrt();
                    let (below, share) = (entry as usize, entry.fract() as f32);
                    *value = match disc_table.get(below..below + 2) {
                        Some(&[low, high]) => norm * (low + share * (high - low)),
                        _ => 0.0,
                    };
                }
            });
        }
        self.pupil_mm = pupil_mm;
    }

    /// The spectra of what lies in one layer.
    fn transform_layer(&mut self, frame: &RgbdFrame, layers: &DepthLayers, layer: u8) {
        let Self { size, present, spectra, seen, fft, .. } = self;
        let (width, pixels) = (size.width, frame.resolution.pixels());
        let present = &mut present[usize::from(layer)];
        *present = layers.cover(layer).any(|cover| cover > 0.0);
        if !*present {
            return;
        }
        let blocks = Blocks { frame: frame.resolution, scale: SCALE };
        let [white_red, green_blue] = seen;
        let rows = white_red.par_chunks_exact_mut(width).zip(green_blue.par_chunks_exact_mut(width));
        rows.enumerate().for_each(|(y, (white_red, green_blue))| {
            let row = white_red.iter_mut().zip(green_blue).zip(layers.row(y)).enumerate();
            for (x, ((white_red, green_blue), layer_of)) in row {
                let mut parts = [0.0f32; 4];
                for corner in (0..BLOCK).filter(|&corner| layer_of[corner] == layer) {
                    let index = blocks.index(x, y, corner);
                    parts[0] += 1.0;
                    for colour in 0..3 {
                        parts[1 + colour] += frame.amplitude[colour * pixels + index].powi(2);
                    }
                }
                let [white, red, green, blue] = parts.map(|part| part / BLOCK as f32);
                *white_red = Complex32::new(white, red);
                *green_blue = Complex32::new(green, blue);
            }
        });
        for (pair, spectrum) in seen.iter_mut().zip(&mut spectra[usize::from(layer)]) {
            fft.forward(pair);
            spectrum.copy_from_slice(&fft.spectrum);
        }
    }

    /// Amplitudes [3, height, width] at the focus on one layer.
    fn see(&mut self, focus: usize, amplitudes: &mut [f32]) {
        let Self { size, discs, present, spectra, seen, fft, .. } = self;
        for (pair, seen) in seen.iter_mut().enumerate() {
            fft.spectrum.par_chunks_exact_mut(size.height).enumerate().for_each(|(kx, sum)| {
                sum.fill(Complex32::ZERO);
                let column = kx * size.height..(kx + 1) * size.height;
                for (layer, spectra) in spectra.iter().enumerate().filter(|&(layer, _)| present[layer]) {
                    let disc = &discs[layer.abs_diff(focus)][column.clone()];
                    for ((sum, value), disc) in sum.iter_mut().zip(&spectra[pair][column.clone()]).zip(disc) {
                        *sum += value * disc;
                    }
                }
            });
            fft.inverse(seen);
        }
        let [white_red, green_blue] = &self.seen;
        let [red, green, blue] = split_planes(amplitudes, size.pixels());
        let colours = red.par_iter_mut().zip(green).zip(blue);
        colours.zip(white_red).zip(green_blue).for_each(|((((red, green), blue), white_red), green_blue)| {
            let amplitude = |light: f32| (light / white_red.re.max(LEAST_COVER)).max(0.0).sqrt();
            *red = amplitude(white_red.im);
            *green = amplitude(green_blue.re);
            *blue = amplitude(green_blue.im);
        });
    }
}

/// The three planes of [3, height, width].
fn split_planes(values: &mut [f32], pixels: usize) -> [&mut [f32]; 3] {
    let (first, rest) = values.split_at_mut(pixels);
    let (second, third) = rest.split_at_mut(pixels);
    [first, second, third]
}
