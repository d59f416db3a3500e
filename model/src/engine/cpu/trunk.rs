//! A stack of 3x3 layers: convolutions in residual pairs, some of them adjustable.

use super::conv::{Epilogue, PlainConv};
use super::deformable::DeformableConv;
use super::feature_map::FeatureMap;
use super::stage::{Buffers, Job, MapId, Maps, Shared, Stage, plane_bytes};
use crate::conditions::Conditions;
use crate::engine::modulation::Modulation;
use crate::weights::{Layer, OFFSET_CHANNELS};

/// The layers as stages, and the maps at both ends.
pub(super) struct Trunk {
    pub(super) input: MapId,
    pub(super) layers: Vec<LayerStage>,
    pub(super) output: MapId,
}

impl Trunk {
    /// At least two layers, which weights are checked for when they are read. `prefix` is what the stages' names begin
    /// with.
    pub(super) fn new(maps: &mut Maps, prefix: &str, layers: &[Layer], leaky_slope: f32) -> Self {
        let last = layers.len() - 1;
        let input = maps.add(layers[0].in_channels);
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
            let conv = Conv::new(maps, layer, epilogue, leaky_slope);
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
        Self { input, layers: layers.iter().enumerate().map(stage).collect(), output }
    }
}

/// One layer.
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
                adjustable.offset_conv.run(input, scratch, &mut adjustable.offsets);
                adjustable.conv.run(input, &adjustable.offsets, output);
            }
        }
    }

    #[cfg(test)]
    fn seen<'a>(&'a self, buffers: &'a Buffers<F>, _: &'a Job<'_, F::Input>) -> super::stage::Seen<'a> {
        let offsets = match &self.conv {
            Conv::Plain(_) => None,
            Conv::Adjustable(adjustable) => Some(&adjustable.offsets),
        };
        super::stage::Seen::Map(&buffers.maps[self.to], offsets)
    }
}

enum Conv {
    Plain(PlainConv),
    Adjustable(Box<AdjustableConv>),
}

/// A deformable convolution whose offsets are predicted by a plain one, which is modulated for bench and pupil.
struct AdjustableConv {
    conv: DeformableConv,
    channels: usize,
    modulation: Modulation,
    offset_conv: PlainConv,
    offsets: FeatureMap,
}

impl Conv {
    fn new(maps: &mut Maps, layer: &Layer, epilogue: Epilogue, leaky_slope: f32) -> Self {
        let Layer { in_channels: channels, out_channels, weight, bias, adjustable } = layer;
        let (channels, products) = (*channels, maps.products);
        let weight = |output, input, tap| weight[(output * channels + input) * 9 + tap];
        match adjustable {
            None => {
                let mut conv = PlainConv::new(channels, *out_channels, epilogue, leaky_slope, products);
                conv.fill(channels, bias.iter().copied(), weight);
                maps.scratch.fit(&conv);
                Self::Plain(conv)
            }
            Some(parameters) => {
                let offset_conv = PlainConv::new(channels, OFFSET_CHANNELS, Epilogue::None, leaky_slope, products);
                maps.scratch.fit(&offset_conv);
                Self::Adjustable(Box::new(AdjustableConv {
                    conv: DeformableConv::new(channels, bias, weight, epilogue, leaky_slope, products),
                    channels,
                    modulation: Modulation::new(parameters, leaky_slope),
                    offset_conv,
                    offsets: FeatureMap::new(maps.size.width, maps.size.height, OFFSET_CHANNELS, products.set()),
                }))
            }
        }
    }
}

impl AdjustableConv {
    /// Sets the offset prediction to that for a bench and a pupil, unless it is already.
    fn modulate(&mut self, conditions: Conditions) {
        let Self { channels, modulation, offset_conv, .. } = self;
        if let Some(parameters) = modulation.change_to(conditions) {
            offset_conv.fill(*channels, parameters.bias.iter().copied(), |output, input, tap| {
                parameters.weight[(output * *channels + input) * 9 + tap]
            });
        }
    }
}
