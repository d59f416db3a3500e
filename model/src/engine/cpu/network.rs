//! The network's layers and maps, and one frame through them from top to bottom.

use std::time::{Duration, Instant};

use holod_calibration::{Colour, PupilDiameter, Resolution};
use num_complex::Complex32;
use rayon::prelude::*;

use super::conv::{Epilogue, FeatureMap, PackedConv};
use super::simd::InstructionSet;
use crate::engine::{StageTiming, StageTimings};
use crate::optics::FourierUpsampler;
use crate::weights::{Adjustable, Dense, Grid, Layer, OFFSET_CHANNELS, OUTPUT_CHANNELS, Weights};
use crate::{ComplexHologram, RgbdFrame};

/// Everything that one frame needs; nothing is allocated after `new`.
pub(super) struct Network {
    grid: Grid,
    pupil_range_mm: [f32; 2],
    /// The frame's size, and that rounded up to what the grid needs.
    resolution: Resolution,
    padded: Resolution,
    layers: Vec<CpuLayer>,
    input: FeatureMap,
    features: FeatureMap,
    /// The map between the two convolutions of a residual pair.
    between: FeatureMap,
    output: FeatureMap,
    /// Means of each 2x2 block of the amplitude, [3, height, width] of the network's grid.
    base: Vec<f32>,
    upsampler: Option<FourierUpsampler>,
    /// One colour at `padded`, where that differs from `resolution`.
    uncropped: Vec<Complex32>,
    pub(super) timings: StageTimings,
}

struct CpuLayer {
    conv: PackedConv,
    flop: u64,
    adjustable: Option<CpuAdjustable>,
}

/// The offset prediction of an adjustable deformable layer, modulated for one pupil at a time.
struct CpuAdjustable {
    parameters: Adjustable,
    leaky_slope: f32,
    channels: usize,
    /// The pupil that `conv` is modulated for.
    pupil_mm: f32,
    hidden: [Vec<f32>; 2],
    /// γ [18, channels], then β [18].
    modulation: Vec<f32>,
    conv: PackedConv,
    offsets: FeatureMap,
    scratch: Vec<f32>,
}

impl Network {
    pub(super) fn new(weights: &Weights, resolution: Resolution, set: InstructionSet) -> Self {
        let config = &weights.config;
        let scale = match config.grid {
            Grid::HalfBand => 2,
            Grid::Full => 1,
        };
        let (width, height) = (resolution.width.div_ceil(scale), resolution.height.div_ceil(scale));
        let padded = Resolution { width: scale * width, height: scale * height };
        let map = |channels| FeatureMap::new(width, height, channels, set);
        let layers: Vec<_> = weights
            .layers
            .iter()
            .enumerate()
            .map(|(index, layer)| {
                let epilogue = match index {
                    _ if index + 1 == config.layers => Epilogue::None,
                    _ if index > 0 && index % 2 == 0 => Epilogue::ResidualLeaky,
                    _ => Epilogue::Leaky,
                };
                CpuLayer::new(layer, epilogue, config.leaky_slope, (width, height), set)
            })
            .collect();
        let upsampler = (config.grid == Grid::HalfBand).then(|| FourierUpsampler::new(padded));
        let stages = std::iter::once(StageTiming { name: "encode".into(), duration: Duration::ZERO, flop: 0 })
            .chain(layers.iter().enumerate().map(|(index, layer)| {
                let adjustable = if layer.adjustable.is_some() { " (adjustable)" } else { "" };
                StageTiming { name: format!("layer {index}{adjustable}"), duration: Duration::ZERO, flop: layer.flop }
            }))
            .chain([StageTiming { name: "field".into(), duration: Duration::ZERO, flop: 0 }]);
        Self {
            grid: config.grid,
            pupil_range_mm: config.pupil_range_mm,
            resolution,
            padded,
            timings: StageTimings { stages: stages.collect() },
            layers,
            input: map(config.input_channels()),
            features: map(config.channels),
            between: map(config.channels),
            output: map(OUTPUT_CHANNELS),
            base: vec![0.0; 3 * width * height],
            upsampler,
            uncropped: if padded == resolution { Vec::new() } else { vec![Complex32::ZERO; padded.pixels()] },
        }
    }

    /// One frame; `frame` and `hologram` have the network's resolution. Pupils outside the range that the weights were
    /// trained for are taken as the nearest one inside.
    pub(super) fn render(&mut self, frame: &RgbdFrame, pupil: PupilDiameter, hologram: &mut ComplexHologram) {
        let pupil_mm = pupil.mm().clamp(self.pupil_range_mm[0], self.pupil_range_mm[1]);
        let mut stage = StageClock { begin: Instant::now(), next: 0 };

        self.encode(frame, pupil_mm);
        stage.end(&mut self.timings);

        for index in 0..self.layers.len() {
            self.run_layer(index, pupil_mm);
            stage.end(&mut self.timings);
        }

        for colour in Colour::ALL {
            self.write_field(colour, hologram.plane_mut(colour));
        }
        stage.end(&mut self.timings);
    }

    /// One layer from the map that it reads to the map that it writes.
    pub(super) fn run_layer(&mut self, index: usize, pupil_mm: f32) {
        let last = index + 1 == self.layers.len();
        let layer = &mut self.layers[index];
        match index {
            0 => layer.run(&self.input, pupil_mm, &mut self.features),
            _ if last => layer.run(&self.features, pupil_mm, &mut self.output),
            _ if index % 2 == 1 => layer.run(&self.features, pupil_mm, &mut self.between),
            _ => layer.run(&self.between, pupil_mm, &mut self.features),
        }
    }

    /// Writes the first layer's input, and the amplitude to which the last layer's output is a residual.
    pub(super) fn encode(&mut self, frame: &RgbdFrame, pupil_mm: f32) {
        let scale = if self.grid == Grid::HalfBand { 2 } else { 1 };
        let (Resolution { width, height }, pixels) = (self.resolution, self.resolution.pixels());
        let block = scale * scale;
        let (map_width, stride) = (self.input.width, self.input.stride);
        self.input.rows_mut().enumerate().for_each(|(y, row)| {
            for (x, channels) in row[stride..][..map_width * stride].chunks_exact_mut(stride).enumerate() {
                // torch's pixel_unshuffle order: channel, then dy, then dx. A frame of odd size repeats its edge.
                for corner in 0..block {
                    let source_y = (scale * y + corner / scale).min(height - 1);
                    let source_x = (scale * x + corner % scale).min(width - 1);
                    let source = source_y * width + source_x;
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
        let input = &self.input;
        self.base.par_chunks_exact_mut(map_width).enumerate().for_each(|(row, base)| {
            let (colour, y) = (row / input.height, row % input.height);
            for (x, base) in base.iter_mut().enumerate() {
                let block = &input.pixel(x, y)[colour * block..][..block];
                *base = block.iter().sum::<f32>() / block.len() as f32;
            }
        });
    }

    /// The predicted field of one colour at the frame's resolution.
    fn write_field(&mut self, colour: Colour, plane: &mut [Complex32]) {
        let (output, base) = (&self.output, &self.base);
        let (width, height) = (output.width, output.height);
        let predict = |field: &mut [Complex32]| {
            field.par_chunks_exact_mut(width).enumerate().for_each(|(y, row)| {
                for (x, value) in row.iter_mut().enumerate() {
                    let residual = output.pixel(x, y);
                    let base = base[(colour.index() * height + y) * width + x];
                    *value = Complex32::new(base + residual[colour.index()], residual[3 + colour.index()]);
                }
            });
        };
        let Some(upsampler) = &mut self.upsampler else { return predict(plane) };
        predict(upsampler.input());
        if self.padded == self.resolution {
            return upsampler.upsample(plane);
        }
        upsampler.upsample(&mut self.uncropped);
        let cropped_rows = self.uncropped.chunks_exact(self.padded.width);
        for (row, from) in plane.chunks_exact_mut(self.resolution.width).zip(cropped_rows) {
            row.copy_from_slice(&from[..self.resolution.width]);
        }
    }

    /// The map that layer `index` has just written, for tests that look inside.
    #[cfg(test)]
    pub(super) fn map_after(&self, index: usize) -> &FeatureMap {
        match index {
            _ if index + 1 == self.layers.len() => &self.output,
            _ if index % 2 == 1 => &self.between,
            _ => &self.features,
        }
    }

    /// The offsets that layer `index` has just predicted, for tests that look inside.
    #[cfg(test)]
    pub(super) fn offsets_of(&self, index: usize) -> Option<&FeatureMap> {
        self.layers[index].adjustable.as_ref().map(|adjustable| &adjustable.offsets)
    }
}

/// Measures one stage after another.
struct StageClock {
    begin: Instant,
    next: usize,
}

impl StageClock {
    fn end(&mut self, timings: &mut StageTimings) {
        let now = Instant::now();
        timings.stages[self.next].duration = now - self.begin;
        self.begin = now;
        self.next += 1;
    }
}

impl CpuLayer {
    fn new(
        layer: &Layer,
        epilogue: Epilogue,
        leaky_slope: f32,
        (width, height): (usize, usize),
        set: InstructionSet,
    ) -> Self {
        let Layer { in_channels, out_channels, weight, bias, adjustable } = layer;
        let mut conv = PackedConv::new(*in_channels, *out_channels, epilogue, leaky_slope, set);
        conv.fill(*in_channels, bias.iter().copied(), |output, input, tap| {
            weight[(output * in_channels + input) * 9 + tap]
        });
        let outputs = out_channels + adjustable.as_ref().map_or(0, |_| OFFSET_CHANNELS);
        Self {
            flop: (2 * 9 * in_channels * outputs * width * height) as u64,
            adjustable: adjustable.as_ref().map(|parameters| CpuAdjustable {
                leaky_slope,
                channels: *in_channels,
                pupil_mm: f32::NAN,
                hidden: [0, 1].map(|index| vec![0.0; parameters.modulation[index].bias.len()]),
                modulation: vec![0.0; parameters.modulation[2].bias.len()],
                conv: PackedConv::new(*in_channels, OFFSET_CHANNELS, Epilogue::None, leaky_slope, set),
                offsets: FeatureMap::new(width, height, OFFSET_CHANNELS, set),
                scratch: conv.deformable_scratch(),
                parameters: parameters.clone(),
            }),
            conv,
        }
    }

    fn run(&mut self, input: &FeatureMap, pupil_mm: f32, output: &mut FeatureMap) {
        match &mut self.adjustable {
            None => self.conv.run(input, output),
            Some(adjustable) => {
                adjustable.modulate(pupil_mm);
                adjustable.conv.run(input, &mut adjustable.offsets);
                self.conv.run_deformable(input, &adjustable.offsets, &mut adjustable.scratch, output);
            }
        }
    }
}

impl CpuAdjustable {
    /// Sets the offset prediction's parameters to W0 ⊙ (1 + γ(s)) and b0 + β(s), unless they are already.
    fn modulate(&mut self, pupil_mm: f32) {
        if self.pupil_mm == pupil_mm {
            return;
        }
        let Self { parameters, leaky_slope, channels, hidden: [first, second], modulation, conv, .. } = self;
        let [to_first, to_second, to_modulation] = &parameters.modulation;
        let leaky = |values: &mut [f32]| values.iter_mut().for_each(|value| *value = value.max(*value * *leaky_slope));
        to_first.run(&[(pupil_mm - 3.0) / 2.0], first);
        leaky(first);
        to_second.run(first, second);
        leaky(second);
        to_modulation.run(second, modulation);

        let (gamma, beta) = modulation.split_at(OFFSET_CHANNELS * *channels);
        let bias = parameters.offset_bias.iter().zip(beta).map(|(bias, beta)| bias + beta);
        conv.fill(*channels, bias, |output, input, tap| {
            let place = output * *channels + input;
            parameters.offset_weight[place * 9 + tap] * (1.0 + gamma[place])
        });
        self.pupil_mm = pupil_mm;
    }
}

impl Dense {
    fn run(&self, inputs: &[f32], outputs: &mut [f32]) {
        for ((output, weights), bias) in outputs.iter_mut().zip(self.weight.chunks_exact(self.inputs)).zip(&self.bias) {
            *output = bias + weights.iter().zip(inputs).map(|(weight, input)| weight * input).sum::<f32>();
        }
    }
}
