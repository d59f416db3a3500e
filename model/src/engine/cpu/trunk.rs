//! A stack of 3x3 layers: convolutions in residual pairs, some of them adjustable, and the maps between them.

use super::conv::{Epilogue, PlainConv, Scratch};
use super::deformable::DeformableConv;
use super::feature_map::FeatureMap;
use crate::engine::Stage;
use crate::simd::InstructionSet;
use crate::weights::{Adjustable, Dense, Layer, OFFSET_CHANNELS};

/// Nothing is allocated after `new`.
pub(super) struct Trunk {
    layers: Vec<CpuLayer>,
    pub(super) input: FeatureMap,
    features: FeatureMap,
    /// The map between the two convolutions of a residual pair.
    between: FeatureMap,
    pub(super) output: FeatureMap,
    scratch: Scratch,
}

impl Trunk {
    /// For maps of `width` by `height`, of at least two layers: weights are checked when they are read.
    pub(super) fn new(
        layers: &[Layer],
        leaky_slope: f32,
        (width, height): (usize, usize),
        set: InstructionSet,
    ) -> Self {
        let map = |channels| FeatureMap::new(width, height, channels, set);
        let last = layers.len() - 1;
        let epilogue = |index| match index {
            _ if index == last => Epilogue::None,
            _ if index > 0 && index % 2 == 0 => Epilogue::ResidualLeaky,
            _ => Epilogue::Leaky,
        };
        let cpu_layers: Vec<_> = layers
            .iter()
            .enumerate()
            .map(|(index, layer)| CpuLayer::new(layer, epilogue(index), leaky_slope, (width, height), set))
            .collect();
        Self {
            input: map(layers[0].in_channels),
            features: map(layers[0].out_channels),
            between: map(layers[0].out_channels),
            output: map(layers[last].out_channels),
            scratch: Scratch::new(cpu_layers.iter().map(CpuLayer::plain)),
            layers: cpu_layers,
        }
    }

    /// Layers of this trunk.
    pub(super) fn len(&self) -> usize {
        self.layers.len()
    }

    /// What each layer is called and costs.
    pub(super) fn stages(&self, prefix: &str) -> impl Iterator<Item = Stage> {
        self.layers.iter().enumerate().map(move |(index, layer)| {
            let adjustable = if matches!(layer.conv, Conv::Adjustable(_)) { " (adjustable)" } else { "" };
            Stage { name: format!("{prefix}layer {index}{adjustable}"), flop: layer.flop }
        })
    }

    /// One layer from the map that it reads to the map that it writes.
    pub(super) fn run_layer(&mut self, index: usize, pupil_mm: f32) {
        let last = index + 1 == self.layers.len();
        let (layer, scratch) = (&mut self.layers[index], &mut self.scratch);
        match index {
            0 => layer.run(&self.input, pupil_mm, scratch, &mut self.features),
            _ if last => layer.run(&self.features, pupil_mm, scratch, &mut self.output),
            _ if index % 2 == 1 => layer.run(&self.features, pupil_mm, scratch, &mut self.between),
            _ => layer.run(&self.between, pupil_mm, scratch, &mut self.features),
        }
    }

    /// What layer `index` has just written, for tests that look inside.
    #[cfg(test)]
    pub(super) fn after(&self, index: usize) -> super::network::Seen<'_> {
        let map = match index {
            _ if index + 1 == self.layers.len() => &self.output,
            _ if index % 2 == 1 => &self.between,
            _ => &self.features,
        };
        let offsets = match &self.layers[index].conv {
            Conv::Plain(_) => None,
            Conv::Adjustable(adjustable) => Some(&adjustable.offsets),
        };
        super::network::Seen::Map(map, offsets)
    }
}

struct CpuLayer {
    conv: Conv,
    flop: u64,
}

enum Conv {
    Plain(PlainConv),
    Adjustable(Box<CpuAdjustable>),
}

/// An adjustable deformable layer; its offset prediction is modulated for one pupil at a time.
struct CpuAdjustable {
    conv: DeformableConv,
    parameters: Adjustable,
    leaky_slope: f32,
    channels: usize,
    /// The pupil that `offset_conv` is modulated for.
    pupil_mm: f32,
    hidden: [Vec<f32>; 2],
    /// γ [18, channels], then β [18].
    modulation: Vec<f32>,
    offset_conv: PlainConv,
    offsets: FeatureMap,
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
        let (channels, outputs) = (*in_channels, out_channels + adjustable.as_ref().map_or(0, |_| OFFSET_CHANNELS));
        let weight = |output, input, tap| weight[(output * channels + input) * 9 + tap];
        let conv = match adjustable {
            None => {
                let mut conv = PlainConv::new(channels, *out_channels, epilogue, leaky_slope, set);
                conv.fill(channels, bias.iter().copied(), weight);
                Conv::Plain(conv)
            }
            Some(parameters) => Conv::Adjustable(Box::new(CpuAdjustable {
                conv: DeformableConv::new(channels, bias, weight, epilogue, leaky_slope, set),
                leaky_slope,
                channels,
                pupil_mm: f32::NAN,
                hidden: [0, 1].map(|index| vec![0.0; parameters.modulation[index].bias.len()]),
                modulation: vec![0.0; parameters.modulation[2].bias.len()],
                offset_conv: PlainConv::new(channels, OFFSET_CHANNELS, Epilogue::None, leaky_slope, set),
                offsets: FeatureMap::new(width, height, OFFSET_CHANNELS, set),
                parameters: parameters.clone(),
            })),
        };
        Self { conv, flop: (2 * 9 * channels * outputs * width * height) as u64 }
    }

    /// The convolution of which each place is computed alike.
    fn plain(&self) -> &PlainConv {
        match &self.conv {
            Conv::Plain(conv) => conv,
            Conv::Adjustable(adjustable) => &adjustable.offset_conv,
        }
    }

    fn run(&mut self, input: &FeatureMap, pupil_mm: f32, scratch: &mut Scratch, output: &mut FeatureMap) {
        match &mut self.conv {
            Conv::Plain(conv) => conv.run(input, scratch, output),
            Conv::Adjustable(adjustable) => {
                adjustable.modulate(pupil_mm);
                adjustable.offset_conv.run(input, scratch, &mut adjustable.offsets);
                adjustable.conv.run(input, &adjustable.offsets, output);
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
        let Self { parameters, leaky_slope, channels, hidden: [first, second], modulation, offset_conv, .. } = self;
        let [to_first, to_second, to_modulation] = &parameters.modulation;
        let leaky = |values: &mut [f32]| values.iter_mut().for_each(|value| *value = value.max(*value * *leaky_slope));
        to_first.run(&[(pupil_mm - 3.0) / 2.0], first);
        leaky(first);
        to_second.run(first, second);
        leaky(second);
        to_modulation.run(second, modulation);

        let (gamma, beta) = modulation.split_at(OFFSET_CHANNELS * *channels);
        let bias = parameters.offset_bias.iter().zip(beta).map(|(bias, beta)| bias + beta);
        offset_conv.fill(*channels, bias, |output, input, tap| {
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
