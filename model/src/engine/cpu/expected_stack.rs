//! The `expected-stack` family: planes are lit for what an eye should see at each depth layer.

use holod_calibration::{DisplayGeometry, Resolution};

use super::blocks::grid_size;
use super::defocus::Defocus;
use super::depth_layers::DepthLayers;
use super::input_features::{BLOCK, FIRST_MAP, MAPS, write_maps};
use super::plane_light::PlanePositions;
use super::plane_stack::{PlaneNetwork, PlaneStack, View};
use super::stage::{Buffers, Job, MapId, Stage, frame_bytes, plane_bytes};
use super::stage_list::StageList;
use crate::RgbdFrame;
use crate::simd::InstructionSet;
use crate::weights::{Feedback, Layer, NetworkConfig};

/// For frames of `resolution`; `nets` are the layers of the first and of the second net.
pub(super) fn stages(
    config: &NetworkConfig,
    bench: &DisplayGeometry,
    nets: [&[Layer]; 2],
    feedback: Feedback,
    resolution: Resolution,
    set: InstructionSet,
) -> StageList<PlaneStack<DepthLayers>> {
    let size = grid_size(config.grid, resolution);
    let count = config.depth_layers;
    let layer_numbers = (BLOCK * size.pixels()) as u64;
    let positions = PlanePositions::of_layers(count, bench);
    PlaneNetwork { config, bench, nets, feedback, positions, resolution, set }.stages(
        DepthLayers::new(count, size),
        layer_numbers,
        |inputs| Expect {
            bytes: frame_bytes(resolution) + layer_numbers + plane_bytes(3 * count + 2 * (MAPS + 3 * count), size),
            defocus: Defocus::new(config, bench, size, set),
            inputs,
        },
    )
}

impl View for DepthLayers {
    type Input = RgbdFrame;

    fn share_in_focus(&self, plane: usize, sample: usize) -> f32 {
        self.cover(plane, sample)
    }
}

/// Writes what an eye should see, and with the maps of the frame shows it to both nets.
struct Expect {
    bytes: u64,
    defocus: Defocus,
    inputs: [MapId; 2],
}

impl Stage<PlaneStack<DepthLayers>> for Expect {
    fn name(&self) -> &str {
        "expected stack"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<PlaneStack<DepthLayers>>, job: &mut Job<'_, RgbdFrame>) {
        let Buffers { maps, family: PlaneStack { view: layers, stack, .. } } = buffers;
        layers.place(job.input);
        self.defocus.expect(job.input, layers, job.pupil_mm, stack);
        let pixels = maps.size.pixels();
        for (input, first) in self.inputs.into_iter().zip([0, FIRST_MAP]) {
            let map = &mut maps[input];
            write_maps(map, first, job.input, job.conditions);
            map.write_planes(first + MAPS, stack.chunks_exact(pixels), |amplitude| amplitude - 0.4);
        }
    }

    #[cfg(test)]
    fn seen<'a>(
        &'a self,
        buffers: &'a Buffers<PlaneStack<DepthLayers>>,
        _: &'a Job<'_, RgbdFrame>,
    ) -> super::stage::Seen<'a> {
        super::stage::Seen::Map(&buffers.maps[self.inputs[0]], None)
    }
}
