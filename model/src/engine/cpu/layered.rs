//! The `layered` family on the half-band grid: one net says what the objects' surfaces send out, physics carries it to
//! the SLM plane and may feed back what an eye would miss in focus, a second net corrects what arrives.

use std::f64::consts::PI;

use holod_calibration::{Colour, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::{Blocks, scale_of};
use super::depth_layers::DepthLayers;
use super::focus_feedback::FocusFeedback;
use super::simd::InstructionSet;
use super::trunk::Trunk;
use crate::RgbdFrame;
use crate::engine::Stage;
use crate::optics::{TransposedFft2d, signed_bin};
use crate::weights::{Grid, LAYERED_BLURS, Layer, NetworkConfig};

const SCALE: usize = scale_of(Grid::HalfBand);
/// Panel pixels to a sample of the grid.
pub(super) const BLOCK: usize = SCALE * SCALE;
/// Amplitude, two depth maps, each four times, and the pupil.
const MAPS: usize = 5 * BLOCK + 1;
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
const CORRECTION_SHARE: f32 = 0.3;

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
    feedback: Option<FocusFeedback>,
}

impl Layered {
    pub(super) fn new(
        config: &NetworkConfig,
        surface: &[Layer],
        correction: &[Layer],
        feedback_share: Option<f32>,
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
            feedback: feedback_share.map(|share| FocusFeedback::new(config, share, resolution)),
        }
    }

    pub(super) fn stages(&self) -> Vec<Stage> {
        std::iter::once(Stage::plain("encode, blur"))
            .chain(self.surface.stages("surface "))
            .chain([Stage::plain("surface light"), Stage::plain("depth layers")])
            .chain(self.feedback.as_ref().map(|_| Stage::plain("focus feedback")))
            .chain(self.correction.stages("correction "))
            .collect()
    }

    pub(super) fn run_stage(&mut self, index: usize, frame: &RgbdFrame, pupil_mm: f32) {
        let (surface_light, correction) = self.stages_between();
        match index {
            0 => self.encode(frame, pupil_mm),
            _ if index < surface_light => self.surface.run_layer(index - 1, pupil_mm),
            _ if index == surface_light => self.light_surfaces(),
            _ if index == surface_light + 1 => self.carry(frame),
            _ if index < correction => self.feed_back(pupil_mm),
            _ => self.correction.run_layer(index - correction, pupil_mm),
        }
    }

    /// The stage that follows the first net, and the one with which the second begins.
    fn stages_between(&self) -> (usize, usize) {
        let surface_light = 1 + self.surface.len();
        (surface_light, surface_light + 2 + usize::from(self.feedback.is_some()))
    }

    /// Writes the maps that both nets see, the means and their blurs.
    fn encode(&mut self, frame: &RgbdFrame, pupil_mm: f32) {
        let blocks = Blocks { frame: frame.resolution, scale: SCALE };
        let (columns, pixels) = (self.size.width, frame.resolution.pixels());
        let pupil = (pupil_mm - 2.5) / 2.0;
        for (map, first) in [(&mut self.surface.input, 0), (&mut self.correction.input, 6)] {
            let stride = map.stride;
            map.rows_mut().enumerate().for_each(|(y, row)| {
                for (x, channels) in row[stride..][..columns * stride].chunks_exact_mut(stride).enumerate() {
                    let maps = &mut channels[first..][..MAPS];
                    for corner in 0..BLOCK {
                        let source = blocks.index(x, y, corner);
                        for colour in 0..3 {
                            maps[colour * BLOCK + corner] = frame.amplitude[colour * pixels + source] - 0.4;
                        }
                        let centred = frame.depth_normalised[source] - 0.5;
                        maps[3 * BLOCK + corner] = 2.0 * centred;
                        maps[4 * BLOCK + corner] = centred * pupil_mm;
                    }
                    maps[5 * BLOCK] = pupil;
                }
            });
        }

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
        self.depth_layers.place(frame);
        self.depth_layers.compose(&self.source);
        self.show_field();
    }

    /// Feeds back to the field what an eye would miss in focus, which the second net sees too.
    fn feed_back(&mut self, pupil_mm: f32) {
        let Some(feedback) = &mut self.feedback else { return };
        feedback.run(&mut self.depth_layers, &self.light, pupil_mm);
        self.show_field();
    }

    /// Writes the field at the SLM plane, and what was fed back, for the second net.
    fn show_field(&mut self) {
        let Self { size, correction, depth_layers, .. } = self;
        let feedback = self.feedback.as_ref();
        let (stride, columns, pixels) = (correction.input.stride, size.width, size.pixels());
        let carried = &depth_layers.carried;
        correction.input.rows_mut().enumerate().for_each(|(y, row)| {
            for (x, channels) in row[stride..][..columns * stride].chunks_exact_mut(stride).enumerate() {
                for colour in 0..3 {
                    let index = colour * pixels + y * columns + x;
                    channels[colour] = carried[index].re;
                    channels[3 + colour] = carried[index].im;
                    if let Some(FocusFeedback { change, lack, .. }) = feedback {
                        let channels = &mut channels[6 + MAPS..];
                        channels[colour] = change[index].re;
                        channels[3 + colour] = change[index].im;
                        channels[6 + colour] = lack[index];
                    }
                }
            }
        });
    }

    /// The predicted field of one colour on the half-band grid.
    pub(super) fn write_field(&self, colour: Colour, field: &mut [Complex32]) {
        let output = &self.correction.output;
        let carried = &self.depth_layers.carried[colour.index() * self.size.pixels()..];
        let width = self.size.width;
        field.par_chunks_exact_mut(width).zip(carried.par_chunks_exact(width)).enumerate().for_each(
            |(y, (row, carried))| {
                for (x, (value, carried)) in row.iter_mut().zip(carried).enumerate() {
                    let residual = output.pixel(x, y);
                    let residual = Complex32::new(residual[colour.index()], residual[3 + colour.index()]);
                    *value = carried + residual * CORRECTION_SHARE;
                }
            },
        );
    }
}

#[cfg(test)]
impl Layered {
    pub(super) fn after(&self, stage: usize) -> super::network::Seen<'_> {
        use super::network::Seen;
        let (surface_light, correction) = self.stages_between();
        match stage {
            0 => Seen::Map(&self.surface.input, None),
            _ if stage < surface_light => self.surface.after(stage - 1),
            _ if stage == surface_light => Seen::Light(&self.source),
            _ if stage == surface_light + 1 => Seen::Light(&self.depth_layers.carried),
            _ if stage < correction => Seen::Map(&self.correction.input, None),
            _ => self.correction.after(stage - correction),
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
