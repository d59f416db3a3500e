//! The `expected-stack` family: one net lights every depth layer for what an eye should see there, physics carries that
//! light to the SLM plane and feeds back what it lacks, a second net corrects it.

use std::f32::consts::PI;

use holod_calibration::{Colour, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::defocus::Defocus;
use super::depth_layers::DepthLayers;
use super::feedback::LayerFeedback;
use super::layered::CORRECTION_SHARE;
use super::maps::{MAPS, write_maps};
use super::trunk::Trunk;
use crate::RgbdFrame;
use crate::engine::Stage;
use crate::weights::{Feedback, NetworkConfig, OUTPUT_CHANNELS};

/// The first net's outputs for a layer: the phases of three colours and a mask.
const LIT: usize = 4;
const MASK: usize = 3;
/// Where the second net's input has the maps: after the field.
const FIRST_MAP: usize = OUTPUT_CHANNELS;

/// Nothing is allocated after `new`.
pub(super) struct ExpectedStack {
    size: Resolution,
    layer_count: usize,
    lighting: Trunk,
    correction: Trunk,
    defocus: Defocus,
    layers: DepthLayers,
    feedback: LayerFeedback,
    /// [layers, 3, height, width]: the amplitudes that an eye should see; after the feedback, what is lacking of them.
    stack: Vec<f32>,
    /// Transposed spectrum of the light of the layers so far, at the layer at hand.
    arriving: Vec<Complex32>,
}

impl ExpectedStack {
    pub(super) fn new(
        config: &NetworkConfig,
        [lighting, correction]: [Trunk; 2],
        feedback: Feedback,
        (width, height): (usize, usize),
    ) -> Self {
        let size = Resolution { width, height };
        Self {
            size,
            layer_count: config.depth_layers,
            lighting,
            correction,
            defocus: Defocus::new(config, size),
            layers: DepthLayers::new(config, size),
            feedback: LayerFeedback::new(config, feedback, size),
            stack: vec![0.0; 3 * config.depth_layers * size.pixels()],
            arriving: vec![Complex32::ZERO; size.pixels()],
        }
    }

    pub(super) fn stages(&self) -> Vec<Stage> {
        std::iter::once(Stage::plain("expected stack"))
            .chain(self.lighting.stages("lighting "))
            .chain([Stage::plain("light of the layers"), Stage::plain("feedback")])
            .chain(self.correction.stages("correction "))
            .collect()
    }

    pub(super) fn run_stage(&mut self, index: usize, frame: &RgbdFrame, pupil_mm: f32) {
        let light_layers = 1 + self.lighting.len();
        match index {
            0 => self.expect(frame, pupil_mm),
            _ if index < light_layers => self.lighting.run_layer(index - 1, pupil_mm),
            _ if index == light_layers => self.light_layers(),
            _ if index == light_layers + 1 => self.feed_back(pupil_mm),
            _ => self.correction.run_layer(index - light_layers - 2, pupil_mm),
        }
    }

    /// Writes what an eye should see, and with the maps of the frame shows it to both nets.
    fn expect(&mut self, frame: &RgbdFrame, pupil_mm: f32) {
        let Self { size, lighting, correction, defocus, layers, stack, .. } = self;
        layers.place(frame);
        defocus.expect(frame, layers, pupil_mm, stack);
        let pixels = size.pixels();
        for (map, first) in [(&mut lighting.input, 0), (&mut correction.input, FIRST_MAP)] {
            write_maps(map, first, frame, pupil_mm);
            map.write_planes(first + MAPS, stack.chunks_exact(pixels), |amplitude| amplitude - 0.4);
        }
    }

    /// Lights every layer with what is expected there through the first net's masks, with its phases, and carries all of
    /// it to the SLM plane.
    fn light_layers(&mut self) {
        let Self { size, layer_count, lighting, layers, stack, arriving, .. } = self;
        let DepthLayers { step, back, fft, carried, .. } = layers;
        let (width, pixels) = (size.width, size.pixels());
        let samples = pixels as f32;
        let offset = ((*layer_count - 1) as f32).ln();
        let stride = lighting.output.stride;
        lighting.output.rows_mut().for_each(|row| {
            for channels in row[stride..][..width * stride].chunks_exact_mut(stride) {
                for mask in channels[MASK..].iter_mut().step_by(LIT) {
                    *mask = 1.0 / (1.0 + (offset - *mask).exp());
                }
            }
        });
        for (colour, field) in carried.chunks_exact_mut(pixels).enumerate() {
            arriving.fill(Complex32::ZERO);
            for layer in 0..*layer_count {
                let wanted = &stack[(3 * layer + colour) * pixels..][..pixels];
                field.par_chunks_exact_mut(width).zip(wanted.par_chunks_exact(width)).enumerate().for_each(
                    |(y, (row, wanted))| {
                        for (x, (light, wanted)) in row.iter_mut().zip(wanted).enumerate() {
                            let out = &lighting.output.pixel(x, y)[LIT * layer..][..LIT];
                            *light = Complex32::from_polar(out[MASK] * wanted, PI * out[colour]);
                        }
                    },
                );
                fft.forward(field);
                let transformed = fft.spectrum.par_iter().zip(&step[colour]);
                arriving.par_iter_mut().zip(transformed).for_each(|(arriving, (spectrum, step))| {
                    // Horner's rule over the layers, as in the feedback.
                    *arriving = *arriving * (step * samples) + spectrum;
                });
            }
            let transformed = arriving.par_iter().zip(&back[colour]);
            fft.spectrum.par_iter_mut().zip(transformed).for_each(|(value, (arriving, back))| *value = arriving * back);
            fft.inverse(field);
        }
    }

    /// Feeds back what is lacking, and shows the second net the field, the change and the lack.
    fn feed_back(&mut self, pupil_mm: f32) {
        let Self { size, correction, layers, feedback, stack, .. } = self;
        feedback.run(layers, stack, pupil_mm);
        let (pixels, stack_channels) = (size.pixels(), 3 * self.layer_count);
        let map = &mut correction.input;
        map.write_fields(0, &layers.carried);
        map.write_fields(FIRST_MAP + MAPS + stack_channels, &feedback.change);
        let first_lack = FIRST_MAP + MAPS + stack_channels + OUTPUT_CHANNELS;
        map.write_planes(first_lack, stack.chunks_exact(pixels), |lack| lack);
    }

    /// The predicted field of one colour on the half-band grid.
    pub(super) fn write_field(&self, colour: Colour, field: &mut [Complex32]) {
        let output = &self.correction.output;
        let carried = &self.layers.carried[colour.index() * self.size.pixels()..];
        output.add_residual(carried, CORRECTION_SHARE, colour, field);
    }
}

#[cfg(test)]
impl ExpectedStack {
    pub(super) fn after(&self, stage: usize) -> super::network::Seen<'_> {
        use super::network::Seen;
        let light_layers = 1 + self.lighting.len();
        match stage {
            0 => Seen::Map(&self.lighting.input, None),
            _ if stage < light_layers => self.lighting.after(stage - 1),
            _ if stage == light_layers => Seen::Light(&self.layers.carried),
            _ if stage == light_layers + 1 => Seen::Map(&self.correction.input, None),
            _ => self.correction.after(stage - light_layers - 2),
        }
    }
}
