//! The `expected-stack` family: one net lights every depth layer for what an eye should see there, physics carries that
//! light to the SLM plane and feeds back what it lacks, a second net corrects it.

use holod_calibration::{Colour, DisplayGeometry, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::grid_size;
use super::defocus::Defocus;
use super::depth_layers::DepthLayers;
use super::feature_map::FeatureMap;
use super::feedback::LayerFeedback;
use super::field::{Field, UncorrectedField};
use super::input_features::{BLOCK, FIRST_MAP, MAPS, RUN_PX, write_maps};
use super::stage::{Buffers, Job, MapId, Maps, Stage, frame_bytes, plane_bytes};
use super::stage_list::StageList;
use super::trunk::Trunk;
use crate::engine::constants::REFINED_SHARE;
use crate::phase_math::cos_sin_pi;
use crate::simd::{InstructionSet, Simd, Task};
use crate::weights::{Feedback, LIT, Layer, NetworkConfig, OUTPUT_CHANNELS, REFINED};

/// The mask's place among the first net's outputs for a layer.
const MASK: usize = 3;

/// For frames of `resolution`; the layers are those of the first and of the second net.
pub(super) fn stages(
    config: &NetworkConfig,
    bench: &DisplayGeometry,
    [lighting, correction]: [&[Layer]; 2],
    feedback: Feedback,
    resolution: Resolution,
    set: InstructionSet,
) -> StageList<DepthVolume> {
    let size = grid_size(config.grid, resolution);
    let mut maps = Maps::new(size, set);
    let lighting = Trunk::new(&mut maps, "lighting ", lighting, config.leaky_slope);
    let correction = Trunk::new(&mut maps, "correction ", correction, config.leaky_slope);
    let volume = DepthVolume {
        layers: DepthLayers::new(config, bench, size),
        stack: vec![0.0; 3 * config.depth_layers * size.pixels()],
        sum: vec![Complex32::ZERO; size.pixels()],
    };
    let stack_planes = 3 * config.depth_layers;
    let layer_numbers = (BLOCK * size.pixels()) as u64;
    StageList::new(maps, volume)
        .then(Expect {
            bytes: frame_bytes(resolution)
                + layer_numbers
                + plane_bytes(stack_planes + 2 * (MAPS + stack_planes), size),
            defocus: Defocus::new(config, bench, size, set),
            lighting_input: lighting.input,
            correction_input: correction.input,
        })
        .then_each(lighting.layers)
        .then(LightLayers {
            bytes: plane_bytes(
                // The stack is written where it is refined.
                config.lighting_channels() + stack_planes * (1 + usize::from(config.refined_stack)) + OUTPUT_CHANNELS,
                size,
            ),
            output: lighting.output,
            refines: config.refined_stack,
            rows: vec![0.0; config.lighting_channels() * size.pixels()],
            light: vec![Complex32::ZERO; size.pixels()],
        })
        .then(FeedBack {
            // The field before and after, for the net the field and its change, and the stack and what is lacking of
            // it.
            bytes: layer_numbers + plane_bytes(4 * OUTPUT_CHANNELS + 2 * stack_planes, size),
            feedback: LayerFeedback::new(config, bench, feedback, size),
            correction_input: correction.input,
        })
        .then_each(correction.layers)
        .then(Field::new(config.grid, resolution, correction.output))
}

/// What the stages share besides maps.
pub(super) struct DepthVolume {
    layers: DepthLayers,
    /// [layers, 3, height, width]: the amplitudes that an eye should see, once the layers are lit as the first net
    /// corrects them; after the feedback, what is lacking of them.
    stack: Vec<f32>,
    /// Scratch: the transposed spectrum of the light of the layers so far.
    sum: Vec<Complex32>,
}

impl UncorrectedField for DepthVolume {
    const PLANES: usize = OUTPUT_CHANNELS;

    fn write_corrected(&self, residual: &FeatureMap, colour: Colour, field: &mut [Complex32]) {
        residual.correct(&self.layers.carried[colour.index() * field.len()..], colour, field);
    }
}

/// Writes what an eye should see, and with the maps of the frame shows it to both nets.
struct Expect {
    bytes: u64,
    defocus: Defocus,
    lighting_input: MapId,
    correction_input: MapId,
}

impl Stage<DepthVolume> for Expect {
    fn name(&self) -> &str {
        "expected stack"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<DepthVolume>, job: &mut Job<'_>) {
        let Buffers { maps, family: DepthVolume { layers, stack, .. } } = buffers;
        layers.place(job.frame);
        self.defocus.expect(job.frame, layers, job.pupil_mm, stack);
        let pixels = maps.size.pixels();
        for (input, first) in [(self.lighting_input, 0), (self.correction_input, FIRST_MAP)] {
            let map = &mut maps[input];
            write_maps(map, first, job.frame, job.conditions);
            map.write_planes(first + MAPS, stack.chunks_exact(pixels), |amplitude| amplitude - 0.4);
        }
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<DepthVolume>, _: &'a Job<'_>) -> super::stage::Seen<'a> {
        super::stage::Seen::Map(&buffers.maps[self.lighting_input], None)
    }
}

/// Lights every layer with what is expected there, as far as the first net corrects it, through its masks and with its
/// phases, and carries all of it to the SLM plane.
struct LightLayers {
    bytes: u64,
    /// The first net's.
    output: MapId,
    refines: bool,
    /// [height, channels, width]: what the first net gives, masks as shares of the light; a copy of its map in which a
    /// channel's row lies together, so that it is read as vectors.
    rows: Vec<f32>,
    /// What one layer sends out in one colour.
    light: Vec<Complex32>,
}

impl Stage<DepthVolume> for LightLayers {
    fn name(&self) -> &str {
        "light of the layers"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<DepthVolume>, _: &mut Job<'_>) {
        let Self { output, refines, rows: output_rows, light, .. } = self;
        let Buffers { maps, family: DepthVolume { layers, stack, sum } } = buffers;
        let (output, set, width, pixels) = (&maps[*output], maps.set, maps.size.width, maps.size.pixels());
        let (count, channels) = (layers.numbers().len(), output_rows.len() / pixels);
        let offset = ((count - 1) as f32).ln();
        output_rows.par_chunks_exact_mut(channels * width).enumerate().for_each(|(y, rows)| {
            for x in (0..width).step_by(RUN_PX) {
                for (channel, row) in rows.chunks_exact_mut(width).enumerate() {
                    let run = row[x..].iter_mut().take(RUN_PX);
                    run.zip(output.channel(channel, y).skip(x)).for_each(|(to, from)| *to = *from);
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
                rows.zip(output_rows.par_chunks_exact(channels * width)).for_each(|((light, wanted), outputs)| {
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

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<DepthVolume>, _: &'a Job<'_>) -> super::stage::Seen<'a> {
        super::stage::Seen::Light(&buffers.family.layers.carried)
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

/// Feeds back what is lacking, and shows the second net the field, the change and the lack.
struct FeedBack {
    bytes: u64,
    feedback: LayerFeedback,
    correction_input: MapId,
}

impl Stage<DepthVolume> for FeedBack {
    fn name(&self) -> &str {
        "feedback"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<DepthVolume>, job: &mut Job<'_>) {
        let Buffers { maps, family: DepthVolume { layers, stack, sum } } = buffers;
        self.feedback.run(layers, stack, sum, job.pupil_mm);
        let (pixels, stack_channels) = (maps.size.pixels(), 3 * layers.numbers().len());
        let map = &mut maps[self.correction_input];
        map.write_fields(0, &layers.carried);
        map.write_fields(FIRST_MAP + MAPS + stack_channels, &self.feedback.change);
        let first_lack = FIRST_MAP + MAPS + stack_channels + OUTPUT_CHANNELS;
        map.write_planes(first_lack, stack.chunks_exact(pixels), |lack| lack);
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<DepthVolume>, _: &'a Job<'_>) -> super::stage::Seen<'a> {
        super::stage::Seen::Map(&buffers.maps[self.correction_input], None)
    }
}
