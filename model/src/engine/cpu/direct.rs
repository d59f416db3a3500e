//! The `direct` family: the field at the SLM plane as a residual to the amplitude.

use holod_calibration::Colour;
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::{Blocks, scale_of};
use super::trunk::Trunk;
use crate::RgbdFrame;
use crate::engine::Stage;
use crate::simd::InstructionSet;
use crate::weights::{Layer, NetworkConfig};

/// Nothing is allocated after `new`.
pub(super) struct Direct {
    /// Panel pixels to a sample of the network's grid, each way.
    scale: usize,
    trunk: Trunk,
    /// Means of each block of the amplitude, [3, height, width] of the network's grid.
    base: Vec<f32>,
}

impl Direct {
    pub(super) fn new(
        config: &NetworkConfig,
        layers: &[Layer],
        (width, height): (usize, usize),
        set: InstructionSet,
    ) -> Self {
        Self {
            scale: scale_of(config.grid),
            trunk: Trunk::new(layers, config.leaky_slope, (width, height), set),
            base: vec![0.0; 3 * width * height],
        }
    }

    pub(super) fn stages(&self) -> Vec<Stage> {
        std::iter::once(Stage::plain("encode")).chain(self.trunk.stages("")).collect()
    }

    pub(super) fn run_stage(&mut self, index: usize, frame: &RgbdFrame, pupil_mm: f32) {
        match index {
            0 => self.encode(frame, pupil_mm),
            _ => self.trunk.run_layer(index - 1, pupil_mm),
        }
    }

    /// Writes the first layer's input, and the amplitude to which the last layer's output is a residual.
    fn encode(&mut self, frame: &RgbdFrame, pupil_mm: f32) {
        let Self { scale, trunk, base } = self;
        let (pixels, block) = (frame.resolution.pixels(), *scale * *scale);
        let blocks = Blocks { frame: frame.resolution, scale: *scale };
        let (map_width, stride) = (trunk.input.width, trunk.input.stride);
        trunk.input.rows_mut().enumerate().for_each(|(y, row)| {
            for (x, channels) in row[stride..][..map_width * stride].chunks_exact_mut(stride).enumerate() {
                for corner in 0..block {
                    let source = blocks.index(x, y, corner);
                    for colour in 0..3 {
                        channels[colour * block + corner] = frame.amplitude[colour * pixels + source];
                    }
                    let depth = frame.depth_normalised[source] - 0.5;
                    channels[3 * block + corner] = depth;
                    channels[4 * block + corner] = pupil_mm * depth;
                }
                channels[5 * block] = (pupil_mm - 3.0) / 2.0;
            }
        });
        let input = &trunk.input;
        base.par_chunks_exact_mut(map_width).enumerate().for_each(|(row, base)| {
            let (colour, y) = (row / input.height, row % input.height);
            for (x, base) in base.iter_mut().enumerate() {
                let block = &input.pixel(x, y)[colour * block..][..block];
                *base = block.iter().sum::<f32>() / block.len() as f32;
            }
        });
    }

    /// The predicted field of one colour on the network's grid.
    pub(super) fn write_field(&self, colour: Colour, field: &mut [Complex32]) {
        let (output, base) = (&self.trunk.output, &self.base);
        let (width, height) = (output.width, output.height);
        field.par_chunks_exact_mut(width).enumerate().for_each(|(y, row)| {
            for (x, value) in row.iter_mut().enumerate() {
                let residual = output.pixel(x, y);
                let base = base[(colour.index() * height + y) * width + x];
                *value = Complex32::new(base + residual[colour.index()], residual[3 + colour.index()]);
            }
        });
    }
}

#[cfg(test)]
impl Direct {
    pub(super) fn after(&self, stage: usize) -> super::network::Seen<'_> {
        match stage {
            0 => super::network::Seen::Map(&self.trunk.input, None),
            _ => self.trunk.after(stage - 1),
        }
    }
}
