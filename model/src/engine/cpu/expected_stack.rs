//! The `expected-stack` family: one net lights every depth layer for what an eye should see there, physics carries that
//! light to the SLM plane and feeds back what it lacks, a second net corrects it.

use holod_calibration::{Colour, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::defocus::Defocus;
use super::depth_layers::DepthLayers;
use super::feedback::LayerFeedback;
use super::maps::{FIRST_MAP, MAPS, RUN_PX, write_maps};
use super::trunk::Trunk;
use crate::RgbdFrame;
use crate::engine::Stage;
use crate::phase_math::cos_sin_pi;
use crate::simd::{InstructionSet, Simd, Task};
use crate::weights::{Feedback, LIT, NetworkConfig, OUTPUT_CHANNELS, REFINED};

/// The mask's place among the first net's outputs for a layer.
const MASK: usize = 3;
/// Of the first net's changes, in the amplitudes.
const REFINED_SHARE: f32 = 0.3;

/// Nothing is allocated after `new`.
pub(super) struct ExpectedStack {
    size: Resolution,
    lighting: Trunk,
    correction: Trunk,
    defocus: Defocus,
    layers: DepthLayers,
    feedback: LayerFeedback,
    refines: bool,
    set: InstructionSet,
    /// [layers, 3, height, width]: the amplitudes that an eye should see, once the layers are lit as the first net
    /// corrects them; after the feedback, what is lacking of them.
    stack: Vec<f32>,
    /// [height, channels, width]: what the first net gives, masks as shares of the light; a copy of its map in which a
    /// channel's row lies together, so that it is read as vectors.
    outputs: Vec<f32>,
    /// The light that one layer sends out in one colour, and the transposed spectrum of that of the layers so far.
    light: Vec<Complex32>,
    sum: Vec<Complex32>,
}

impl ExpectedStack {
    pub(super) fn new(
        config: &NetworkConfig,
        [lighting, correction]: [Trunk; 2],
        feedback: Feedback,
        (width, height): (usize, usize),
        set: InstructionSet,
    ) -> Self {
        let size = Resolution { width, height };
        Self {
            size,
            lighting,
            correction,
            defocus: Defocus::new(config, size, set),
            layers: DepthLayers::new(config, size),
            feedback: LayerFeedback::new(config, feedback, size),
            refines: config.refined_stack,
            set,
            stack: vec![0.0; 3 * config.depth_layers * size.pixels()],
            outputs: vec![0.0; config.lighting_channels() * size.pixels()],
            light: vec![Complex32::ZERO; size.pixels()],
            sum: vec![Complex32::ZERO; size.pixels()],
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

    /// Lights every layer with what is expected there, as far as the first net corrects it, through its masks and with
    /// its phases, and carries all of it to the SLM plane.
    fn light_layers(&mut self) {
        let Self { size, lighting, layers, stack, outputs, light, sum, refines, set, .. } = self;
        let (width, pixels) = (size.width, size.pixels());
        let (count, channels) = (layers.numbers().len(), outputs.len() / pixels);
        let offset = ((count - 1) as f32).ln();
        outputs.par_chunks_exact_mut(channels * width).enumerate().for_each(|(y, rows)| {
            for x in (0..width).step_by(RUN_PX) {
                for (channel, row) in rows.chunks_exact_mut(width).enumerate() {
                    let run = row[x..].iter_mut().take(RUN_PX);
                    run.zip(lighting.output.channel(channel, y).skip(x)).for_each(|(to, from)| *to = *from);
                }
            }
            for (channel, row) in rows.chunks_exact_mut(width).enumerate() {
                if channel < LIT * count && channel % LIT == MASK {
                    row.iter_mut().for_each(|mask| *mask = 1.0 / (1.0 + (offset - *mask).exp()));
                }
            }
        });
        for colour in Colour::ALL {
            sum.fill(Complex32::ZERO);
            for (layer, wanted) in stack.chunks_exact_mut(3 * pixels).enumerate() {
                let wanted = wanted[colour.index() * pixels..][..pixels].par_chunks_exact_mut(width);
                let rows = light.par_chunks_exact_mut(width).zip(wanted);
                rows.zip(outputs.par_chunks_exact(channels * width)).for_each(|((light, wanted), outputs)| {
                    let output = |channel: usize| &outputs[channel * width..][..width];
                    set.run(LightRow {
                        changes: refines.then(|| output(LIT * count + REFINED * layer + colour.index())),
                        masks: output(LIT * layer + MASK),
                        half_turns: output(LIT * layer + colour.index()),
                        wanted,
                        light,
                    });
                });
                layers.add_light(colour, light, sum);
            }
            layers.bring_back(colour, sum, light);
            layers.carried[colour.index() * pixels..][..pixels].copy_from_slice(light);
        }
    }

    /// Feeds back what is lacking, and shows the second net the field, the change and the lack.
    fn feed_back(&mut self, pupil_mm: f32) {
        let Self { size, correction, layers, feedback, stack, sum, .. } = self;
        feedback.run(layers, stack, sum, pupil_mm);
        let (pixels, stack_channels) = (size.pixels(), 3 * layers.numbers().len());
        let map = &mut correction.input;
        map.write_fields(0, &layers.carried);
        map.write_fields(FIRST_MAP + MAPS + stack_channels, &feedback.change);
        let first_lack = FIRST_MAP + MAPS + stack_channels + OUTPUT_CHANNELS;
        map.write_planes(first_lack, stack.chunks_exact(pixels), |lack| lack);
    }

    /// The predicted field of one colour on the half-band grid.
    pub(super) fn write_field(&self, colour: Colour, field: &mut [Complex32]) {
        let carried = &self.layers.carried[colour.index() * self.size.pixels()..];
        self.correction.output.correct(carried, colour, field);
    }
}

/// What a row of one layer sends out in one colour.
struct LightRow<'a> {
    /// Where the stack is refined: what the first net adds to the amplitudes, before [`REFINED_SHARE`].
    changes: Option<&'a [f32]>,
    masks: &'a [f32],
    /// Phases over π.
    half_turns: &'a [f32],
    /// The amplitudes that an eye should see, which are refined here.
    wanted: &'a mut [f32],
    light: &'a mut [Complex32],
}

impl Task for LightRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { changes, masks, half_turns, wanted, light } = self;
        if let Some(changes) = changes {
            for (wanted, change) in wanted.iter_mut().zip(changes) {
                *wanted = (*wanted + REFINED_SHARE * change).max(0.0);
            }
        }
        for (((light, wanted), mask), half_turns) in light.iter_mut().zip(wanted).zip(masks).zip(half_turns) {
            let (cosine, sine) = cos_sin_pi(*half_turns);
            let amplitude = mask * *wanted;
            *light = Complex32::new(amplitude * cosine, amplitude * sine);
        }
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
