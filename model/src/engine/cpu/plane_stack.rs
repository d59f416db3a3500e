//! Networks whose first net lights planes for what an eye should see there: physics carries that light to the SLM plane
//! and feeds back what it lacks, a second net corrects it.

use holod_calibration::{Colour, DisplayGeometry, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::grid_size;
use super::feature_map::FeatureMap;
use super::feedback::PlaneFeedback;
use super::field::{Field, UncorrectedField};
use super::input_features::{FIRST_MAP, RUN_PX};
use super::plane_light::{PlaneLight, PlanePositions};
use super::stage::{Buffers, Job, MapId, Maps, Shared, Stage, plane_bytes};
use super::stage_list::StageList;
use super::trunk::Trunk;
use crate::engine::constants::REFINED_SHARE;
use crate::phase_math::cos_sin_pi;
use crate::simd::{InstructionSet, Simd, Task};
use crate::weights::{Feedback, LIT, Layer, NetworkConfig, OUTPUT_CHANNELS, REFINED};

/// The mask's place among the first net's outputs for a plane.
const MASK: usize = 3;

/// Where it is known what is to be seen at the planes.
pub(super) trait View: Send + Sync {
    type Input;

    /// The share of a sample that is known to be in focus at a plane.
    fn share_in_focus(&self, plane: usize, sample: usize) -> f32;
}

/// What the stages share besides maps.
pub(super) struct PlaneStack<V> {
    light: PlaneLight,
    /// [planes, 3, height, width]: the amplitudes that an eye should see, once the planes are lit as the first net
    /// corrects them; after the feedback, what is lacking of them.
    pub(super) stack: Vec<f32>,
    /// Scratch: the transposed spectrum of the light of the planes so far.
    sum: Vec<Complex32>,
    pub(super) view: V,
}

impl<V: View> Shared for PlaneStack<V> {
    type Input = V::Input;
}

impl<V: View> UncorrectedField for PlaneStack<V> {
    const PLANES: usize = OUTPUT_CHANNELS;

    fn write_corrected(&self, residual: &FeatureMap, colour: Colour, field: &mut [Complex32]) {
        residual.correct(&self.light.carried[colour.index() * field.len()..], colour, field);
    }
}

/// Such a network for what has `resolution`.
pub(super) struct PlaneNetwork<'a> {
    pub(super) config: &'a NetworkConfig,
    pub(super) bench: &'a DisplayGeometry,
    /// The layers of the first and of the second net.
    pub(super) nets: [&'a [Layer]; 2],
    pub(super) feedback: Feedback,
    pub(super) positions: PlanePositions,
    pub(super) resolution: Resolution,
    pub(super) set: InstructionSet,
}

impl PlaneNetwork<'_> {
    /// Its stages. The first one, which `tell` makes for the inputs of both nets, writes [`PlaneStack::stack`] and what
    /// they are told: the first net from channel 0, the second from [`FIRST_MAP`] on. `view_bytes` are read of `view`
    /// for the feedback.
    pub(super) fn stages<V: View, S: Stage<PlaneStack<V>> + 'static>(
        self,
        view: V,
        view_bytes: u64,
        tell: impl FnOnce([MapId; 2]) -> S,
    ) -> StageList<PlaneStack<V>> {
        let Self { config, bench, nets: [lighting, correction], feedback, positions, resolution, set } = self;
        let size = grid_size(config.grid, resolution);
        let mut maps = Maps::new(size, set);
        let told = lighting[0].in_channels;
        let lights = lighting[lighting.len() - 1].out_channels;
        let lighting = Trunk::new(&mut maps, "lighting ", lighting, config.leaky_slope);
        let correction = Trunk::new(&mut maps, "correction ", correction, config.leaky_slope);
        let stack_planes = 3 * positions.count;
        let shared = PlaneStack {
            light: PlaneLight::new(positions, bench, size),
            stack: vec![0.0; stack_planes * size.pixels()],
            sum: vec![Complex32::ZERO; size.pixels()],
            view,
        };
        StageList::new(maps, shared)
            .then(tell([lighting.input, correction.input]))
            .then_each(lighting.layers)
            .then(LightPlanes {
                // The stack is written where it is refined.
                bytes: plane_bytes(
                    lights + stack_planes * (1 + usize::from(config.refined_stack)) + OUTPUT_CHANNELS,
                    size,
                ),
                output: lighting.output,
                refines: config.refined_stack,
                rows: vec![0.0; lights * size.pixels()],
                light: vec![Complex32::ZERO; size.pixels()],
            })
            .then(FeedBack {
                // The field before and after, for the net the field and its change, and the stack and what is lacking
                // of it.
                bytes: view_bytes + plane_bytes(4 * OUTPUT_CHANNELS + 2 * stack_planes, size),
                feedback: PlaneFeedback::new(feedback.share, positions, bench, size),
                sharpness: feedback.sharpness,
                told,
                correction_input: correction.input,
            })
            .then_each(correction.layers)
            .then(Field::new(config.grid, resolution, correction.output))
    }
}

/// Lights every plane with what is to be seen there, as far as the first net corrects it, through its masks and with
/// its phases, and carries all of it to the SLM plane.
struct LightPlanes {
    bytes: u64,
    /// The first net's.
    output: MapId,
    refines: bool,
    /// [height, channels, width]: what the first net gives, masks as shares of the light; a copy of its map in which a
    /// channel's row lies together, so that it is read as vectors.
    rows: Vec<f32>,
    /// What one plane sends out in one colour.
    light: Vec<Complex32>,
}

impl<V: View> Stage<PlaneStack<V>> for LightPlanes {
    fn name(&self) -> &str {
        "light of the layers"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<PlaneStack<V>>, _: &mut Job<'_, V::Input>) {
        let Self { output, refines, rows: output_rows, light, .. } = self;
        let Buffers { maps, family: PlaneStack { light: planes, stack, sum, .. } } = buffers;
        let (output, set, width, pixels) = (&maps[*output], maps.set, maps.size.width, maps.size.pixels());
        let (count, channels) = (planes.count, output_rows.len() / pixels);
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
            for (plane, wanted) in stack.chunks_exact_mut(3 * pixels).enumerate() {
                let wanted = wanted[colour.index() * pixels..][..pixels].par_chunks_exact_mut(width);
                let rows = light.par_chunks_exact_mut(width).zip(wanted);
                rows.zip(output_rows.par_chunks_exact(channels * width)).for_each(|((light, wanted), outputs)| {
                    let output = |channel: usize| &outputs[channel * width..][..width];
                    set.run(LightRow {
                        changes: refines.then(|| output(LIT * count + REFINED * plane + colour.index())),
                        masks: output(LIT * plane + MASK),
                        half_turns: output(LIT * plane + colour.index()),
                        wanted,
                        light,
                    });
                });
                planes.add_light(colour, light, sum);
            }
            planes.bring_back(colour, sum, light);
            planes.carried[colour.index() * pixels..][..pixels].copy_from_slice(light);
        }
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<PlaneStack<V>>, _: &'a Job<'_, V::Input>) -> super::stage::Seen<'a> {
        super::stage::Seen::Light(&buffers.family.light.carried)
    }
}

/// What a row of one plane sends out in one colour.
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
    feedback: PlaneFeedback,
    sharpness: f32,
    /// Channels of what both nets are told besides.
    told: usize,
    correction_input: MapId,
}

impl<V: View> Stage<PlaneStack<V>> for FeedBack {
    fn name(&self) -> &str {
        "feedback"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<PlaneStack<V>>, job: &mut Job<'_, V::Input>) {
        let Buffers { maps, family: PlaneStack { light, stack, sum, view } } = buffers;
        let weight = |plane, sample| 1.0 + self.sharpness * view.share_in_focus(plane, sample);
        self.feedback.run(light, stack, sum, job.pupil_mm, weight);
        let pixels = maps.size.pixels();
        let map = &mut maps[self.correction_input];
        map.write_fields(0, &light.carried);
        map.write_fields(FIRST_MAP + self.told, &self.feedback.change);
        let first_lack = FIRST_MAP + self.told + OUTPUT_CHANNELS;
        map.write_planes(first_lack, stack.chunks_exact(pixels), |lack| lack);
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<PlaneStack<V>>, _: &'a Job<'_, V::Input>) -> super::stage::Seen<'a> {
        super::stage::Seen::Map(&buffers.maps[self.correction_input], None)
    }
}
