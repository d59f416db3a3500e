//! The `expected-stack` family: planes are lit for what an eye should see at each depth layer.

use holod_calibration::{DisplayGeometry, Resolution};

use super::blocks::{PIXELS_PER_SAMPLE, grid_size};
use super::defocus::Defocus;
use super::depth_layers::DepthLayers;
use super::frame_blocks::FrameBlocks;
use super::input_features::{MAPS, write_inputs};
use super::plane_light::PlanePositions;
use super::plane_stack::{PlaneNetwork, PlaneStack};
use super::stage::{Buffers, Job, MapId, Stage, frame_bytes, plane_bytes};
use super::stage_list::StageList;
use crate::RgbdFrame;
use crate::simd::Products;
use crate::weights::{Feedback, Layer, NetworkConfig};

/// For frames of `resolution`; `nets` are the layers of the first and of the second net.
pub(super) fn stages(
    config: &NetworkConfig,
    bench: &DisplayGeometry,
    nets: [&[Layer]; 2],
    feedback: Feedback,
    resolution: Resolution,
    products: Products,
) -> StageList<PlaneStack<DepthLayers>> {
    let (size, set) = (grid_size(config.grid, resolution), products.set());
    let count = config.depth_layers;
    let layer_numbers = plane_bytes(PIXELS_PER_SAMPLE, size);
    let positions = PlanePositions::of_layers(count, bench);
    let defocus = Defocus::new(config, bench, size, set);
    PlaneNetwork { config, bench, nets, feedback, positions, resolution, products }.stages(
        DepthLayers::new(count, size, set),
        layer_numbers,
        defocus.room(),
        |input| Expect {
            bytes: frame_bytes(resolution) + layer_numbers + plane_bytes(3 * count + MAPS + 3 * count, size),
            frame: FrameBlocks::new(size, set),
            defocus,
            input,
        },
    )
}

/// Writes what an eye should see, and with the maps of the frame shows it to both nets.
struct Expect {
    bytes: u64,
    frame: FrameBlocks,
    defocus: Defocus,
    input: MapId,
}

impl Stage<PlaneStack<DepthLayers>> for Expect {
    fn name(&self) -> &str {
        "expected stack"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<PlaneStack<DepthLayers>>, job: &mut Job<'_, RgbdFrame>) {
        let Buffers { maps, family: PlaneStack { view: layers, stack, room, .. } } = buffers;
        let Self { frame, defocus, input, .. } = self;
        frame.take(job.input);
        layers.place(frame);
        defocus.expect(frame, layers, job.pupil_mm, stack, room);
        let set = maps.set();
        write_inputs(&mut maps[*input], frame, job.conditions, stack, set);
    }

    #[cfg(test)]
    fn seen<'a>(
        &'a self,
        buffers: &'a Buffers<PlaneStack<DepthLayers>>,
        _: &'a Job<'_, RgbdFrame>,
    ) -> super::stage::Seen<'a> {
        let told = MAPS + buffers.family.stack.planes();
        super::stage::Seen::Inputs(&buffers.maps[self.input], (0..told).collect())
    }
}
