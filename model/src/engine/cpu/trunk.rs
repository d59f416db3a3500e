//! A stack of 3x3 layers: convolutions in residual pairs, some of them adjustable.

use super::conv::{Epilogue, PlainConv};
use super::deformable::DeformableConv;
use super::stage::{Buffers, Job, MapId, Maps, Shared, Stage, plane_bytes};
use crate::conditions::Conditions;
use crate::engine::modulation::Modulation;
use crate::weights::{Layer, OFFSET_CHANNELS};

/// The layers as stages, and the map that the last one writes.
pub(super) struct Trunk {
    pub(super) layers: Vec<LayerStage>,
    pub(super) output: MapId,
}

impl Trunk {
    /// At least two layers, which weights are checked for when they are read. The first one reads the channels `inputs`
    /// of the map `input`, in its weights' order; `prefix` is what the stages' names begin with.
    pub(super) fn new(
        maps: &mut Maps,
        prefix: &str,
        layers: &[Layer],
        leaky_slope: f32,
        input: MapId,
        inputs: &[usize],
    ) -> Self {
        let last = layers.len() - 1;
        let features_of: Vec<_> = (0..layers[0].out_channels).collect();
        // The latter between the two convolutions of a residual pair.
        let [features, between] = maps.handed_on(layers[0].out_channels);
        let output = maps.add(layers[last].out_channels);
        let stage = |(index, layer): (usize, &Layer)| {
            let ([from, to], epilogue) = match index {
                0 => ([input, features], Epilogue::Leaky),
                _ if index == last => ([features, output], Epilogue::None),
                _ if index % 2 == 1 => ([features, between], Epilogue::Leaky),
                _ => ([between, features], Epilogue::ResidualLeaky),
            };
            let inputs = if index == 0 { inputs } else { &features_of };
            let conv = Conv::new(maps, layer, inputs, epilogue, leaky_slope);
            let adjustable = if layer.adjustable.is_some() { " (adjustable)" } else { "" };
            // What is there already is read, too.
            let skipped = if epilogue == Epilogue::ResidualLeaky { layer.out_channels } else { 0 };
            let outputs = layer.out_channels + layer.adjustable.as_ref().map_or(0, |_| OFFSET_CHANNELS);
            LayerStage {
                name: format!("{prefix}layer {index}{adjustable}"),
                flop: (2 * 9 * layer.in_channels * outputs * maps.size.pixels()) as u64,
                bytes: plane_bytes(layer.in_channels + skipped + layer.out_channels, maps.size),
                from,
                to,
                conv,
            }
        };
        Self { layers: layers.iter().enumerate().map(stage).collect(), output }
    }
}

/// One layer of a net, from a map to another.
pub(super) struct LayerStage {
    name: String,
    flop: u64,
    bytes: u64,
    from: MapId,
    to: MapId,
    conv: Conv,
}

impl<F: Shared> Stage<F> for LayerStage {
    fn name(&self) -> &str {
        &self.name
    }

    fn flop(&self) -> u64 {
        self.flop
    }

    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn run(&mut self, buffers: &mut Buffers<F>, job: &mut Job<'_, F::Input>) {
        let (input, output, scratch) = buffers.maps.for_layer(self.from, self.to);
        match &mut self.conv {
            Conv::Plain(conv) => conv.run(input, scratch, output),
            Conv::Adjustable(adjustable) => {
                adjustable.modulate(job.conditions);
                adjustable.conv.run(input, output);
            }
        }
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<F>, _: &'a Job<'_, F::Input>) -> super::stage::Seen<'a> {
        let offsets = match &self.conv {
            Conv::Plain(_) => None,
            // Once more: they are nowhere kept whole.
            Conv::Adjustable(adjustable) => {
                Some(adjustable.conv.offset_conv.run_anew(&buffers.maps[self.from], OFFSET_CHANNELS))
            }
        };
        super::stage::Seen::Map(&buffers.maps[self.to], offsets)
    }
}

enum Conv {
    Plain(PlainConv),
    Adjustable(Box<AdjustableConv>),
}

/// A deformable convolution, the prediction of whose offsets is modulated for bench and pupil.
struct AdjustableConv {
    conv: DeformableConv,
    channels: Vec<usize>,
    modulation: Modulation,
}

impl Conv {
    fn new(maps: &mut Maps, layer: &Layer, inputs: &[usize], epilogue: Epilogue, leaky_slope: f32) -> Self {
        let Layer { in_channels: channels, out_channels, weight, bias, adjustable } = layer;
        let (channels, products) = (*channels, maps.products);
        let weight = |output, input, tap| weight[(output * channels + input) * 9 + tap];
        match adjustable {
            None => {
                let read = inputs.iter().max().map_or(0, |channel| channel + 1);
                let mut conv = PlainConv::new(read, *out_channels, epilogue, leaky_slope, products);
                conv.fill(inputs, bias.iter().copied(), weight);
                maps.scratch.fit(&conv);
                Self::Plain(conv)
            }
            Some(parameters) => {
                let width = maps.size.width;
                Self::Adjustable(Box::new(AdjustableConv {
                    conv: DeformableConv::new(channels, width, bias, weight, epilogue, leaky_slope, products),
                    channels: (0..channels).collect(),
                    modulation: Modulation::new(parameters, leaky_slope),
                }))
            }
        }
    }
}

impl AdjustableConv {
    /// Sets the offset prediction to that for a bench and a pupil, unless it is already.
    fn modulate(&mut self, conditions: Conditions) {
        let Self { channels, modulation, conv } = self;
        if let Some(parameters) = modulation.change_to(conditions) {
            conv.offset_conv.fill(channels, parameters.bias.iter().copied(), |output, input, tap| {
                parameters.weight[(output * channels.len() + input) * 9 + tap]
            });
        }
    }
}
