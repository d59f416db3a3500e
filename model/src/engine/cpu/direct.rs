//! The `direct` family: the field at the SLM plane as a residual to the amplitude.

use holod_calibration::{Colour, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::{Blocks, grid_size, scale_of};
use super::feature_map::FeatureMap;
use super::field::{Field, UncorrectedField};
use super::stage::{Buffers, Job, MapId, Maps, Shared, Stage, frame_bytes, plane_bytes};
use super::stage_list::StageList;
use super::trunk::Trunk;
use crate::RgbdFrame;
use crate::simd::Products;
use crate::weights::{CONDITIONS, Layer, NetworkConfig};

/// For frames of `resolution`.
pub(super) fn stages(
    config: &NetworkConfig,
    layers: &[Layer],
    resolution: Resolution,
    products: Products,
) -> StageList<BlockMeans> {
    let size = grid_size(config.grid, resolution);
    let mut maps = Maps::new(size, products);
    let input = maps.add(layers[0].in_channels);
    let inputs: Vec<_> = (0..layers[0].in_channels).collect();
    let trunk = Trunk::new(&mut maps, "", layers, config.leaky_slope, input, &inputs);
    StageList::new(maps, BlockMeans { size, amplitude: vec![0.0; 3 * size.pixels()] })
        .then(Encode {
            bytes: frame_bytes(resolution) + plane_bytes(layers[0].in_channels + BlockMeans::PLANES, size),
            scale: scale_of(config.grid),
            input,
        })
        .then_each(trunk.layers)
        .then(Field::new(config.grid, resolution, trunk.output))
}

/// Means of each block of the frame's amplitude.
pub(super) struct BlockMeans {
    size: Resolution,
    /// [3, height, width] of the network's grid.
    amplitude: Vec<f32>,
}

impl Shared for BlockMeans {
    type Input = RgbdFrame;
}

/// Writes the first layer's input, and the amplitude to which the last layer's output is a residual.
struct Encode {
    bytes: u64,
    /// Panel pixels to a sample of the network's grid, each way.
    scale: usize,
    input: MapId,
}

impl Stage<BlockMeans> for Encode {
    fn name(&self) -> &str {
        "encode"
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<BlockMeans>, job: &mut Job<'_, RgbdFrame>) {
        let (input, Job { input: frame, conditions, .. }) = (&mut buffers.maps[self.input], job);
        let (told, blur_scale) = (conditions.told().map(|value| value as f32), conditions.blur_scale() as f32);
        let (pixels, block) = (frame.resolution.pixels(), self.scale * self.scale);
        let blocks = Blocks { frame: frame.resolution, scale: self.scale };
        let (map_width, stride) = (input.width, input.stride);
        input.rows_mut().enumerate().for_each(|(y, row)| {
            for (x, channels) in row[stride..][..map_width * stride].chunks_exact_mut(stride).enumerate() {
                for corner in 0..block {
                    let source = blocks.index(x, y, corner);
                    for colour in 0..3 {
                        channels[colour * block + corner] = frame.amplitude[colour * pixels + source];
                    }
                    let depth = frame.depth_normalised[source] - 0.5;
                    channels[3 * block + corner] = depth;
                    channels[4 * block + corner] = blur_scale * depth;
                }
                channels[5 * block..][..CONDITIONS].copy_from_slice(&told);
            }
        });
        let input = &*input;
        buffers.family.amplitude.par_chunks_exact_mut(map_width).enumerate().for_each(|(row, means)| {
            let (colour, y) = (row / input.height, row % input.height);
            for (x, mean) in means.iter_mut().enumerate() {
                let block = &input.pixel(x, y)[colour * block..][..block];
                *mean = block.iter().sum::<f32>() / block.len() as f32;
            }
        });
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<BlockMeans>, _: &'a Job<'_, RgbdFrame>) -> super::stage::Seen<'a> {
        let channels = 0..5 * self.scale * self.scale + CONDITIONS;
        super::stage::Seen::Inputs(&buffers.maps[self.input], channels.collect())
    }
}

impl UncorrectedField for BlockMeans {
    const PLANES: usize = 3;

    fn write_corrected(&self, residual: &FeatureMap, colour: Colour, field: &mut [Complex32]) {
        let Self { size: Resolution { width, height }, amplitude } = self;
        field.par_chunks_exact_mut(*width).enumerate().for_each(|(y, row)| {
            for (x, value) in row.iter_mut().enumerate() {
                let residual = residual.pixel(x, y);
                let amplitude = amplitude[(colour.index() * height + y) * width + x];
                *value = Complex32::new(amplitude + residual[colour.index()], residual[3 + colour.index()]);
            }
        });
    }
}
