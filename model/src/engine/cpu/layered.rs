//! The `layered` family on the half-band grid: one net says what the objects' surfaces send out, physics carries it to
//! the SLM plane, a second net corrects what arrives.

use std::f64::consts::PI;

use holod_calibration::{Colour, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::depth_layers::DepthLayers;
use super::maps::{BLOCK, FIRST_MAP, MAPS, SCALE, write_maps};
use super::trunk::Trunk;
use crate::RgbdFrame;
use crate::engine::Stage;
use crate::optics::{TransposedFft2d, signed_bin};
use crate::simd::InstructionSet;
use crate::weights::{LAYERED_BLURS, Layer, NetworkConfig};

/// Standard deviations of the blurs, panel pixels.
const SIGMAS_PX: [f64; LAYERED_BLURS] = [1.0, 2.5, 6.0];
/// The blur of the logarithm that the first net sees.
const SEEN_BLUR: usize = 1;
/// log(I + floor) + offset: finite in the dark, around zero for usual pictures.
const LOG_FLOOR: f32 = 0.03;
const LOG_OFFSET: f32 = 1.66;
/// The transport-of-intensity prior: φ = (520 nm / λ)·Σ gain·tanh(4·(½ − D))·blurred log I, from I·∇φ ∝ −∇I.
const PRIOR_GAINS: [f32; LAYERED_BLURS] = [-0.5, -1.0, 0.0];
const REFERENCE_NM: f64 = 520.0;

/// Nothing is allocated after `new`.
pub(super) struct Layered {
    size: Resolution,
    transport_prior: bool,
    /// 520 nm over the wavelength of each colour.
    phase_scale: [f32; 3],
    surface: Trunk,
    correction: Trunk,
    blurs: Blurs,
    /// Means of each block: amplitude [3, height, width] and D − ½ [height, width].
    light: Vec<f32>,
    centred_depth: Vec<f32>,
    /// What the surfaces send out, [3, height, width].
    source: Vec<Complex32>,
    depth_layers: DepthLayers,
}

impl Layered {
    pub(super) fn new(
        config: &NetworkConfig,
        surface: &[Layer],
        correction: &[Layer],
        size @ (width, height): (usize, usize),
        set: InstructionSet,
    ) -> Self {
        let resolution = Resolution { width, height };
        let pixels = resolution.pixels();
        Self {
            size: resolution,
            transport_prior: config.transport_prior,
            phase_scale: config.optics.wavelengths_nm.map(|wavelength_nm| (REFERENCE_NM / wavelength_nm) as f32),
            surface: Trunk::new(surface, config.leaky_slope, size, set),
            correction: Trunk::new(correction, config.leaky_slope, size, set),
            blurs: Blurs::new(resolution),
            light: vec![0.0; 3 * pixels],
            centred_depth: vec![0.0; pixels],
            source: vec![Complex32::ZERO; 3 * pixels],
            depth_layers: DepthLayers::new(config, resolution),
        }
    }

    pub(super) fn stages(&self) -> Vec<Stage> {
        std::iter::once(Stage::plain("encode, blur"))
            .chain(self.surface.stages("surface "))
            .chain([Stage::plain("surface light"), Stage::plain("depth layers")])
            .chain(self.correction.stages("correction "))
            .collect()
    }

    pub(super) fn run_stage(&mut self, index: usize, frame: &RgbdFrame, pupil_mm: f32) {
        let surface_light = 1 + self.surface.len();
        match index {
            0 => self.encode(frame, pupil_mm),
            _ if index < surface_light => self.surface.run_layer(index - 1, pupil_mm),
            _ if index == surface_light => self.light_surfaces(),
            _ if index == surface_light + 1 => self.carry(frame),
            _ => self.correction.run_layer(index - surface_light - 2, pupil_mm),
        }
    }

    /// Writes the maps that both nets see, the means and their blurs.
    fn encode(&mut self, frame: &RgbdFrame, pupil_mm: f32) {
        let columns = self.size.width;
        write_maps(&mut self.surface.input, 0, frame, pupil_mm);
        write_maps(&mut self.correction.input, FIRST_MAP, frame, pupil_mm);

        let Self { surface, blurs, light, centred_depth, .. } = self;
        let maps = &surface.input;
        let mean = |x, y, map: usize| maps.pixel(x, y)[map * BLOCK..][..BLOCK].iter().sum::<f32>() / BLOCK as f32;
        light.par_chunks_exact_mut(columns).enumerate().for_each(|(row, light)| {
            let (colour, y) = (row / maps.height, row % maps.height);
            light.iter_mut().enumerate().for_each(|(x, light)| *light = mean(x, y, colour) + 0.4);
        });
        centred_depth.par_chunks_exact_mut(columns).enumerate().for_each(|(y, row)| {
            row.iter_mut().enumerate().for_each(|(x, depth)| *depth = mean(x, y, 3) / 2.0);
        });
        for colour in Colour::ALL {
            blurs.blur(colour, &light[colour.index() * self.size.pixels()..][..self.size.pixels()]);
        }
        if self.transport_prior {
            let stride = surface.input.stride;
            surface.input.rows_mut().enumerate().for_each(|(y, row)| {
                for (x, channels) in row[stride..][..columns * stride].chunks_exact_mut(stride).enumerate() {
                    for colour in Colour::ALL {
                        let index = y * columns + x;
                        channels[MAPS + colour.index()] = blurs.of(colour, SEEN_BLUR)[index].im + LOG_OFFSET;
                    }
                }
            });
        }
    }

    /// Turns the first net's output into the light of the surfaces.
    fn light_surfaces(&mut self) {
        let Self { size, surface, blurs, light, centred_depth, source, .. } = self;
        let (width, height) = (size.width, size.height);
        let (prior, phase_scale) = (self.transport_prior, self.phase_scale);
        source.par_chunks_exact_mut(width).enumerate().for_each(|(row, source)| {
            let (colour, y) = (Colour::ALL[row / height], row % height);
            for (x, source) in source.iter_mut().enumerate() {
                let index = y * width + x;
                // [3 colours] of: correction, phase, a gate for each blur of the amplitude, one for each of the logarithm
                let out = |channel: usize| surface.output.pixel(x, y)[3 * channel + colour.index()];
                let light = light[row * width + x];
                let mut strength = light + 0.5 * out(0);
                let mut drift = 0.0;
                let sign = (-4.0 * centred_depth[index]).tanh();
                for (blur, gain) in PRIOR_GAINS.into_iter().enumerate() {
                    let blurred = blurs.of(colour, blur)[index];
                    strength += out(2 + blur) * (blurred.re - light);
                    if prior {
                        let gate = gain * sign + out(2 + LAYERED_BLURS + blur);
                        drift += gate * (blurred.im + LOG_OFFSET);
                    }
                }
                *source = Complex32::from_polar(strength, out(1) + phase_scale[colour.index()] * drift);
            }
        });
    }

    /// Carries the light of the surfaces to the SLM plane, where the second net sees it.
    fn carry(&mut self, frame: &RgbdFrame) {
        let Self { correction, source, depth_layers, .. } = self;
        depth_layers.place(frame);
        depth_layers.compose(source);
        correction.input.write_fields(0, &depth_layers.carried);
    }

    /// The predicted field of one colour on the half-band grid.
    pub(super) fn write_field(&self, colour: Colour, field: &mut [Complex32]) {
        let carried = &self.depth_layers.carried[colour.index() * self.size.pixels()..];
        self.correction.output.correct(carried, colour, field);
    }
}

#[cfg(test)]
impl Layered {
    pub(super) fn after(&self, stage: usize) -> super::network::Seen<'_> {
        use super::network::Seen;
        let surface_light = 1 + self.surface.len();
        match stage {
            0 => Seen::Map(&self.surface.input, None),
            _ if stage < surface_light => self.surface.after(stage - 1),
            _ if stage == surface_light => Seen::Light(&self.source),
            _ if stage == surface_light + 1 => Seen::Light(&self.depth_layers.carried),
            _ => self.correction.after(stage - surface_light - 2),
        }
    }
}

/// Circular Gaussian blurs of amplitude and of the logarithm of intensity, two at a time: the real and the imaginary
/// part of one field.
struct Blurs {
    fft: TransposedFft2d<f32>,
    /// [width, height], kept while one inverse transform after another uses up its copy.
    spectrum: Vec<Complex32>,
    /// exp(−2π²σ²f²) of each bin, along x and along y; the latter over width·height.
    along_x: [Vec<f32>; LAYERED_BLURS],
    along_y: [Vec<f32>; LAYERED_BLURS],
    /// For each colour and blur [height, width]: amplitude + j·log(amplitude² + floor).
    blurred: [[Vec<Complex32>; LAYERED_BLURS]; 3],
}

impl Blurs {
    fn new(size: Resolution) -> Self {
        let gaussian = |bins: usize, norm: f64| {
            SIGMAS_PX.map(|sigma_px| {
                let sigma = sigma_px / SCALE as f64;
                let at = |bin| signed_bin(bin, bins) as f64 / bins as f64;
                (0..bins).map(|bin| (norm * (-2.0 * (PI * sigma * at(bin)).powi(2)).exp()) as f32).collect()
            })
        };
        let plane = || vec![Complex32::ZERO; size.pixels()];
        Self {
            fft: TransposedFft2d::new(size.width, size.height),
            spectrum: plane(),
            along_x: gaussian(size.width, 1.0),
            along_y: gaussian(size.height, 1.0 / size.pixels() as f64),
            blurred: Colour::ALL.map(|_| SIGMAS_PX.map(|_| plane())),
        }
    }

    /// Blurs one colour's amplitude `light` [height, width] and its logarithm.
    fn blur(&mut self, colour: Colour, light: &[f32]) {
        let Self { fft, spectrum, along_x, along_y, blurred } = self;
        let blurred = &mut blurred[colour.index()];
        blurred[0].par_iter_mut().zip(light).for_each(|(value, &light)| {
            *value = Complex32::new(light, (light * light + LOG_FLOOR).ln());
        });
        fft.forward(&mut blurred[0]);
        spectrum.copy_from_slice(&fft.spectrum);
        for ((blurred, along_x), along_y) in blurred.iter_mut().zip(along_x).zip(along_y) {
            let rows = spectrum.par_chunks_exact(along_y.len());
            fft.spectrum.par_chunks_exact_mut(along_y.len()).zip(rows).zip(&*along_x).for_each(
                |((to, from), along_x)| {
                    for ((to, from), along_y) in to.iter_mut().zip(from).zip(&*along_y) {
                        *to = from * (along_x * along_y);
                    }
                },
            );
            fft.inverse(blurred);
        }
    }

    fn of(&self, colour: Colour, blur: usize) -> &[Complex32] {
        &self.blurred[colour.index()][blur]
    }
}
