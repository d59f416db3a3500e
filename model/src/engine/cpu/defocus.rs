//! What an eye should see at each depth layer, as far as a picture and its depth tell.

use holod_calibration::{DisplayGeometry, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::Blocks;
use super::depth_layers::DepthLayers;
use super::input_features::{BLOCK, SCALE, sample_pitch};
use crate::RgbdFrame;
use crate::engine::constants::{LEAST_COVER, PAIRS};
use crate::engine::disc::DiscTable;
use crate::optics::{PlanesFft, signed_bin};
use crate::simd::{InstructionSet, Simd, Task};
use crate::weights::{MOST_DEPTH_LAYERS, NetworkConfig};

/// Bins of a spectrum that are blurred together.
const BINS: usize = 16;

/// Blurs each depth layer by its disc of confusion at the focus on each other one, and divides the sum by that of a
/// white scene. Blur is circular, and no layer hides another. Nothing is allocated after `new`.
pub(super) struct Defocus {
    size: Resolution,
    disc: DiscTable,
    /// The pupil that `discs` is for.
    pupil_mm: f32,
    /// [width, layers, height], over the number of samples: spectra of the discs between layers that are 0, 1, 2, ..
    /// apart.
    discs: Vec<f32>,
    /// Whether a layer has a pixel.
    present: Vec<bool>,
    seen: [Vec<Complex32>; PAIRS],
    /// For each layer its light's pairs, and then those seen at the focus on it.
    fft: PlanesFft,
    set: InstructionSet,
}

impl Defocus {
    pub(super) fn new(config: &NetworkConfig, bench: &DisplayGeometry, size: Resolution, set: InstructionSet) -> Self {
        let count = config.depth_layers;
        let sample_rad = sample_pitch(bench).0 / bench.eyepiece_focal_length.0;
        let plane = || vec![Complex32::ZERO; size.pixels()];
        Self {
            size,
            disc: DiscTable::new(bench, count, sample_rad),
            pupil_mm: f32::NAN,
            discs: vec![0.0; count * size.pixels()],
            present: vec![false; count],
            seen: [plane(), plane()],
            fft: PlanesFft::new(size.width, size.height, PAIRS * count),
            set,
        }
    }

    /// Writes the expected amplitudes [layers, 3, height, width] of `frame`, whose depths `layers` has.
    pub(super) fn expect(&mut self, frame: &RgbdFrame, layers: &DepthLayers, pupil_mm: f32, amplitudes: &mut [f32]) {
        self.shape_discs(pupil_mm);
        for layer in layers.numbers() {
            self.take_layer(frame, layers, layer);
        }
        self.blur();
        for (focus, amplitudes) in amplitudes.chunks_exact_mut(3 * self.size.pixels()).enumerate() {
            self.see(focus, amplitudes);
        }
    }

    /// Sets the discs to those of a pupil, unless they are already.
    fn shape_discs(&mut self, pupil_mm: f32) {
        if self.pupil_mm == pupil_mm {
            return;
        }
        let Self { size: Resolution { width, height }, disc, discs, .. } = self;
        let (width, height, norm) = (*width, *height, 1.0 / (*width * *height) as f32);
        let scale = disc.entries_per_mm * f64::from(pupil_mm);
        let count = discs.len() / (width * height);
        discs.par_chunks_exact_mut(count * height).enumerate().for_each(|(kx, discs)| {
            let fx = signed_bin(kx, width) as f64 / width as f64;
            for (apart, values) in discs.chunks_exact_mut(height).enumerate() {
                for (ky, value) in values.iter_mut().enumerate() {
                    let fy = signed_bin(ky, height) as f64 / height as f64;
                    let entry = scale * apart as f64 * (fx * fx + fy * fy).sqrt();
                    let (below, share) = (entry as usize, entry.fract() as f32);
                    *value = match disc.values.get(below..below + 2) {
                        Some(&[low, high]) => norm * (low + share * (high - low)),
                        _ => 0.0,
                    };
                }
            }
        });
        self.pupil_mm = pupil_mm;
    }

    /// Takes what lies in one layer.
    fn take_layer(&mut self, frame: &RgbdFrame, layers: &DepthLayers, layer: u8) {
        let Self { size, present, seen, fft, .. } = self;
        let (width, pixels) = (size.width, frame.resolution.pixels());
        let present = &mut present[usize::from(layer)];
        *present = layers.has_any_in(layer);
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
        for (pair, seen) in seen.iter_mut().enumerate() {
            fft.take(PAIRS * usize::from(layer) + pair, seen);
        }
    }

    /// Turns the layers' light into what is seen at the focus on each.
    fn blur(&mut self) {
        let Self { size, discs, present, fft, set, .. } = self;
        let discs_len = discs.len() / size.width;
        fft.for_each_column(|kx, mut column| {
            let planes = (0..PAIRS * present.len()).filter(|plane| present[plane / PAIRS]);
            planes.for_each(|plane| column.transform(plane));
            let discs = &discs[kx * discs_len..][..discs_len];
            set.run(BlurColumn { values: column.values, discs, present, height: size.height });
            column.transform_back();
        });
    }

    /// Amplitudes [3, height, width] at the focus on one layer.
    fn see(&mut self, focus: usize, amplitudes: &mut [f32]) {
        let Self { size, seen, fft, set, .. } = self;
        for (pair, seen) in seen.iter_mut().enumerate() {
            fft.give(PAIRS * focus + pair, seen);
        }
        let ([white_red, green_blue], width) = (&self.seen, size.width);
        let [red, green, blue] = split_planes(amplitudes, size.pixels()).map(|plane| plane.par_chunks_exact_mut(width));
        let seen = white_red.par_chunks_exact(width).zip(green_blue.par_chunks_exact(width));
        red.zip(green).zip(blue).zip(seen).for_each(|(((red, green), blue), (white_red, green_blue))| {
            set.run(SeenRow { white_red, green_blue, amplitudes: [red, green, blue] });
        });
    }
}

/// One column of all layers' spectra, which become those of what is seen.
struct BlurColumn<'a> {
    /// [layers, pairs, height]
    values: &'a mut [Complex32],
    /// [layers, height]
    discs: &'a [f32],
    present: &'a [bool],
    height: usize,
}

impl Task for BlurColumn<'_> {
    #[inline(always)]
    fn run<S: Simd>(mut self, _: S) {
        let mut seen = [[Complex32::ZERO; BINS]; MOST_DEPTH_LAYERS];
        let in_whole_blocks = self.height - self.height % BINS;
        for pair in 0..PAIRS {
            for bin in (0..in_whole_blocks).step_by(BINS) {
                self.blur::<BINS>(pair, bin, &mut seen);
            }
            for bin in in_whole_blocks..self.height {
                self.blur::<1>(pair, bin, &mut seen);
            }
        }
    }
}

impl BlurColumn<'_> {
    /// N bins from `bin` on; `seen` is scratch.
    #[inline(always)]
    fn blur<const N: usize>(&mut self, pair: usize, bin: usize, seen: &mut [[Complex32; BINS]]) {
        let Self { values, discs, present, height } = self;
        let place = |layer: usize| (layer * PAIRS + pair) * *height + bin;
        for (focus, seen) in seen.iter_mut().enumerate().take(present.len()) {
            let mut sum = [Complex32::ZERO; N];
            for layer in (0..present.len()).filter(|&layer| present[layer]) {
                let disc = &discs[layer.abs_diff(focus) * *height + bin..][..N];
                for ((sum, value), disc) in sum.iter_mut().zip(&values[place(layer)..][..N]).zip(disc) {
                    *sum += value * disc;
                }
            }
            seen[..N].copy_from_slice(&sum);
        }
        for (focus, seen) in seen.iter().enumerate().take(present.len()) {
            values[place(focus)..][..N].copy_from_slice(&seen[..N]);
        }
    }
}

/// One row of the amplitudes seen, of all colours.
struct SeenRow<'a> {
    white_red: &'a [Complex32],
    green_blue: &'a [Complex32],
    amplitudes: [&'a mut [f32]; 3],
}

impl Task for SeenRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { white_red, green_blue, amplitudes: [red, green, blue] } = self;
        let colours = red.iter_mut().zip(green).zip(blue);
        for (((red, green), blue), (white_red, green_blue)) in colours.zip(white_red.iter().zip(green_blue)) {
            let amplitude = |light: f32| (light / white_red.re.max(LEAST_COVER)).max(0.0).sqrt();
            *red = amplitude(white_red.im);
            *green = amplitude(green_blue.re);
            *blue = amplitude(green_blue.im);
        }
    }
}

/// The three planes of [3, height, width].
fn split_planes(values: &mut [f32], pixels: usize) -> [&mut [f32]; 3] {
    let (first, rest) = values.split_at_mut(pixels);
    let (second, third) = rest.split_at_mut(pixels);
    [first, second, third]
}
