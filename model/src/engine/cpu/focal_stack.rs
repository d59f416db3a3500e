//! The `focal-stack` family: planes are lit for images of a scene that are focused there.

use holod_calibration::{DisplayGeometry, Resolution};
use rayon::prelude::*;

use super::blocks::{Blocks, PIXELS_PER_SAMPLE, SCALE, grid_size};
use super::plane_light::PlanePositions;
use super::plane_stack::{PlaneNetwork, PlaneStack};
use super::stage::{Buffers, Job, MapId, Stage, plane_bytes};
use super::stage_list::StageList;
use super::view::View;
use crate::scene::FocalStack;
use crate::simd::{Products, Simd};
use crate::weights::{CONDITIONS, Feedback, Layer, NetworkConfig};

/// For images of `resolution`; `nets` are the layers of the first and of the second net.
pub(super) fn stages(
    config: &NetworkConfig,
    bench: &DisplayGeometry,
    nets: [&[Layer]; 2],
    share: f32,
    resolution: Resolution,
    products: Products,
) -> StageList<PlaneStack<FocalImages>> {
    let size = grid_size(config.grid, resolution);
    let images = 3 * config.planes;
    let positions = PlanePositions::from_end_to_end(config.planes, bench);
    let feedback = Feedback { share, sharpness: 0.0 };
    let network = PlaneNetwork { config, bench, nets, feedback, positions, resolution, products };
    network.stages(FocalImages, 0, 0, |input| Tell {
        bytes: plane_bytes(images, resolution) + plane_bytes(images + PIXELS_PER_SAMPLE * images + CONDITIONS, size),
        input,
    })
}

/// Without depth it is not known what is in focus.
pub(super) struct FocalImages;

impl View for FocalImages {
    type Input = FocalStack;

    #[inline(always)]
    fn share_in_focus<S: Simd>(&self, simd: S, _: usize, _: usize, _: usize) -> S::Vector {
        simd.splat(0.0)
    }
}

/// Writes what is to be seen, and shows the images to both nets.
struct Tell {
    bytes: u64,
    input: MapId,
}

impl Stage<PlaneStack<FocalImages>> for Tell {
    fn name(&self) -> &str {
        "focal stack"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<PlaneStack<FocalImages>>, job: &mut Job<'_, FocalStack>) {
        let Buffers { maps, family: PlaneStack { stack, .. } } = buffers;
        let FocalStack { resolution, amplitude, .. } = job.input;
        let blocks = Blocks { frame: *resolution, scale: SCALE };
        stack.fill(|plane, x, y| {
            let image = &amplitude[plane * resolution.pixels()..][..resolution.pixels()];
            let light = (0..PIXELS_PER_SAMPLE).map(|corner| image[blocks.index(x, y, corner)].powi(2));
            (light.sum::<f32>() / PIXELS_PER_SAMPLE as f32).sqrt()
        });
        let width = maps.size.width;
        let told = job.conditions.told().map(|value| value as f32);
        let map = &mut maps[self.input];
        let stride = map.stride;
        map.rows_mut().enumerate().for_each(|(y, row)| {
            for (x, channels) in row[stride..][..width * stride].chunks_exact_mut(stride).enumerate() {
                let (images, rest) = channels.split_at_mut(PIXELS_PER_SAMPLE * amplitude.len() / resolution.pixels());
                let planes = amplitude.chunks_exact(resolution.pixels());
                for (block, plane) in images.chunks_exact_mut(PIXELS_PER_SAMPLE).zip(planes) {
                    for (corner, value) in block.iter_mut().enumerate() {
                        *value = plane[blocks.index(x, y, corner)] - 0.4;
                    }
                }
                rest[..CONDITIONS].copy_from_slice(&told);
            }
        });
    }

    #[cfg(test)]
    fn seen<'a>(
        &'a self,
        buffers: &'a Buffers<PlaneStack<FocalImages>>,
        _: &'a Job<'_, FocalStack>,
    ) -> super::stage::Seen<'a> {
        let told = PIXELS_PER_SAMPLE * buffers.family.stack.planes() + CONDITIONS;
        super::stage::Seen::Inputs(&buffers.maps[self.input], (0..told).collect())
    }
}
