//! Networks whose first net lights planes for what an eye should see there: physics carries that light to the SLM plane
//! and feeds back what it lacks, a second net corrects it.

use holod_calibration::{Colour, DisplayGeometry, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::grid_size;
use super::column_blocks::{ColumnBlocks, store};
use super::feature_map::FeatureMap;
use super::feedback::PlaneFeedback;
use super::field::{Field, UncorrectedField};
use super::input_features::InputChannels;
use super::plane_fft::Columns;
use super::plane_light::{PlaneLight, PlanePositions};
use super::stage::{Buffers, Job, MapId, Maps, Shared, Stage, plane_bytes};
use super::stage_list::StageList;
use super::trunk::Trunk;
use super::view::View;
use crate::engine::constants::REFINED_SHARE;
use crate::phase_math::{cos_sin_pi, exp};
use crate::simd::{Products, Simd, Task};
use crate::weights::{Feedback, LIT, Layer, NetworkConfig, OUTPUT_CHANNELS, REFINED};

/// The mask's place among the first net's outputs for a plane.
const MASK: usize = 3;

/// What the stages share besides maps.
pub(super) struct PlaneStack<V> {
    light: PlaneLight,
    /// Three colours of each plane: the amplitudes that an eye should see, once the planes are lit as the first net
    /// corrects them; after the feedback, what is lacking of them.
    pub(super) stack: ColumnBlocks,
    /// What one stage needs, and the next one no more.
    pub(super) room: Vec<f32>,
    pub(super) view: V,
}

impl<V: View> Shared for PlaneStack<V> {
    type Input = V::Input;
}

impl<V: View> UncorrectedField for PlaneStack<V> {
    const PLANES: usize = OUTPUT_CHANNELS;

    fn write_corrected(&self, residual: &FeatureMap, colour: Colour, field: &mut [Complex32]) {
        residual.correct(&self.light.carried, colour, field);
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
    pub(super) products: Products,
}

impl PlaneNetwork<'_> {
    /// Its stages. The first one, which `tell` makes for the map that both nets read, writes
    /// [`PlaneStack::stack`] and what they are told, with `room` values of [`PlaneStack::room`]. `view_bytes` are read
    /// of `view` for the feedback.
    pub(super) fn stages<V: View, S: Stage<PlaneStack<V>> + 'static>(
        self,
        view: V,
        view_bytes: u64,
        room: usize,
        tell: impl FnOnce(MapId) -> S,
    ) -> StageList<PlaneStack<V>> {
        let Self { config, bench, nets: [lighting, correction], feedback, positions, resolution, products } = self;
        let (size, set) = (grid_size(config.grid, resolution), products.set());
        let mut maps = Maps::new(size, products);
        let channels = InputChannels::new(lighting[0].in_channels, positions.count, set);
        let input = maps.add(channels.count);
        let lights = lighting[lighting.len() - 1].out_channels;
        let mut net = |prefix, layers, inputs: Vec<usize>| {
            Trunk::new(&mut maps, prefix, layers, config.leaky_slope, input, &inputs)
        };
        let lighting = net("lighting ", lighting, channels.lighting());
        let correction = net("correction ", correction, channels.correction());
        let stack_planes = 3 * positions.count;
        let room = room.max(ColumnBlocks::room_for_reals(maps[lighting.output].stride, size, set));
        let shared = PlaneStack {
            light: PlaneLight::new(positions, bench, size, set),
            stack: ColumnBlocks::of_reals(stack_planes, size, set),
            room: vec![0.0; room],
            view,
        };
        StageList::new(maps, shared)
            .then(tell(input))
            .then_each(lighting.layers)
            .then(LightPlanes {
                // The stack is written where it is refined.
                bytes: plane_bytes(
                    lights + stack_planes * (1 + usize::from(config.refined_stack)) + OUTPUT_CHANNELS,
                    size,
                ),
                output: lighting.output,
                refines: config.refined_stack,
            })
            .then(FeedBack {
                // The field before and after, for the net the field and its change, and the stack and what is lacking
                // of it.
                bytes: view_bytes + plane_bytes(4 * OUTPUT_CHANNELS + 2 * stack_planes, size),
                feedback: PlaneFeedback::new(feedback, positions, bench, size, set),
                input,
                channels,
            })
            .then_each(correction.layers)
            .then(Field::new(config.grid, resolution, correction.output))
    }
}

/// Lights every plane with what is to be seen there, as far as the first net corrects it, through its masks and with
/// its phases, and carries all of it to the SLM plane.
struct LightPlanes {
    bytes: u64,
    /// The map of the first net's outputs.
    output: MapId,
    refines: bool,
}

impl<V: View> Stage<PlaneStack<V>> for LightPlanes {
    fn name(&self) -> &str {
        "light of the layers"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<PlaneStack<V>>, _: &mut Job<'_, V::Input>) {
        let Self { output, refines, .. } = self;
        let Buffers { maps, family: PlaneStack { light, stack, room, .. } } = buffers;
        let (map, set, count, refines) = (&maps[*output], maps.set(), light.count, *refines);
        // What the first net gives, masks as shares of the light.
        let mut outputs = ColumnBlocks::of_reals_in(room, map.stride, maps.size, set);
        outputs.par_blocks_mut().enumerate().for_each(|(block, outputs)| {
            set.run(TakeOutputs { map, first: block * set.lanes(), outputs, planes: count });
        });
        for plane in 0..count {
            let blocks = outputs.blocks().zip(stack.blocks_mut());
            light.fft.for_columns(&mut light.between, blocks, |columns, (outputs, wanted)| {
                set.run(LightColumns { columns, plane, count, refines, outputs, wanted });
            });
            light.add(plane);
        }
        light.bring_back(None);
        light.keep();
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<PlaneStack<V>>, _: &'a Job<'_, V::Input>) -> super::stage::Seen<'a> {
        super::stage::Seen::Light(buffers.family.light.carried.to_fields().into())
    }
}

/// Takes the first net's outputs in a block of columns.
struct TakeOutputs<'a> {
    map: &'a FeatureMap,
    /// The block's first column, in samples of the grid.
    first: usize,
    /// [channel, row, column of the block]
    outputs: &'a mut [f32],
    planes: usize,
}

impl Task for TakeOutputs<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { map, first, outputs, planes } = self;
        // Eight rows at a time, so that their channels stay in the cache while vector after vector of them is taken,
        // and what is written lies together.
        const ROWS: usize = 8;
        let plane_len = map.height * S::LANES;
        for first_row in (0..map.height).step_by(ROWS) {
            for channel in (0..map.stride).step_by(S::LANES) {
                for y in first_row..(first_row + ROWS).min(map.height) {
                    let pixels = map.pixels_from(first, y);
                    let to = &mut outputs[channel * plane_len + y * S::LANES..];
                    if pixels.len() >= S::LANES * map.stride {
                        assert!(to.len() >= (S::LANES - 1) * plane_len + S::LANES);
                        // SAFETY: a square of channels and pixels lies in both slices: in `pixels` with its last pixel,
                        // in `to` as asserted.
                        unsafe {
                            simd.transpose(pixels.as_ptr().add(channel), to.as_mut_ptr(), [map.stride, plane_len]);
                        }
                        continue;
                    }
                    for (column, pixel) in pixels.chunks_exact(map.stride).enumerate() {
                        for (lane, value) in pixel[channel..][..S::LANES].iter().enumerate() {
                            to[lane * plane_len + column] = *value;
                        }
                    }
                }
            }
        }
        let offset = ((planes - 1) as f32).ln();
        for masks in outputs.chunks_exact_mut(plane_len).take(LIT * planes).skip(MASK).step_by(LIT) {
            masks.iter_mut().for_each(|mask| *mask = 1.0 / (1.0 + exp(offset - *mask)));
        }
    }
}

/// What one plane sends out in a block of columns.
struct LightColumns<'a> {
    columns: Columns<'a>,
    plane: usize,
    count: usize,
    /// Whether the first net adds to the amplitudes, before [`REFINED_SHARE`].
    refines: bool,
    /// [channel, row, column of the block]: masks, and phases over π.
    outputs: &'a [f32],
    /// Three colours of each plane: the amplitudes that an eye should see, which are refined here.
    wanted: &'a mut [f32],
}

impl Task for LightColumns<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { mut columns, plane, count, refines, outputs, wanted } = self;
        for colour in Colour::ALL.map(Colour::index) {
            let cells = columns.cells(colour);
            let len = cells.len() / 2;
            let output = |channel: usize| &outputs[channel * len..][..len];
            let wanted = &mut wanted[(3 * plane + colour) * len..][..len];
            if refines {
                for (wanted, change) in wanted.iter_mut().zip(output(LIT * count + REFINED * plane + colour)) {
                    *wanted = (*wanted + REFINED_SHARE * change).max(0.0);
                }
            }
            let lit = wanted.chunks_exact(S::LANES).zip(output(LIT * plane + MASK).chunks_exact(S::LANES));
            let lit = lit.zip(output(LIT * plane + colour).chunks_exact(S::LANES));
            for (cell, ((wanted, masks), half_turns)) in cells.chunks_exact_mut(2 * S::LANES).zip(lit) {
                let amplitude = simd.mul(simd.read(masks), simd.read(wanted));
                let [cosine, sine] = cos_sin_pi(simd, simd.read(half_turns));
                store(simd, cell, [simd.mul(amplitude, cosine), simd.mul(amplitude, sine)]);
            }
            columns.send(simd, colour);
        }
    }
}

/// Feeds back what is lacking, and shows the second net the field, the change and the lack.
struct FeedBack {
    bytes: u64,
    feedback: PlaneFeedback,
    input: MapId,
    channels: InputChannels,
}

impl<V: View> Stage<PlaneStack<V>> for FeedBack {
    fn name(&self) -> &str {
        "feedback"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<PlaneStack<V>>, job: &mut Job<'_, V::Input>) {
        let Buffers { maps, family: PlaneStack { light, stack, view, .. } } = buffers;
        self.feedback.run(light, stack, view, job.pupil_mm);
        let change = &self.feedback.change;
        maps[self.input].write_planes(self.channels.field, &[&light.carried, change, stack], light.set);
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<PlaneStack<V>>, _: &'a Job<'_, V::Input>) -> super::stage::Seen<'a> {
        super::stage::Seen::Inputs(&buffers.maps[self.input], self.channels.correction())
    }
}
