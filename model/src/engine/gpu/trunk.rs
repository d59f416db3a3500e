//! A stack of 3x3 layers on the GPU: convolutions in residual pairs, some of them adjustable.

use half::f16;

use super::conv::{self, ConvLayer, Epilogue, Method, Packing};
use super::deformable;
use super::map::{Format, GROUP, Map};
use super::plan::{BufferId, Plan};
use crate::conditions::Conditions;
use crate::engine::Precision;
use crate::engine::modulation::{Modulation, OffsetParameters};
use crate::weights::{Layer, OFFSET_CHANNELS};

/// The offset prediction of an adjustable layer, whose parameters depend on bench and pupil.
pub(super) struct Modulated {
    modulation: Modulation,
    /// The map's channel of each input.
    inputs: Vec<usize>,
    packing: Packing,
    /// Where the device has the parameters, and what it shall have there.
    pub(super) buffer: BufferId,
    parameters: Vec<f32>,
    /// The same in half precision, where the device has them so.
    half: Vec<u16>,
}

impl Modulated {
    /// The parameters for a bench and a pupil, as the device takes them; `None` if it has them.
    pub(super) fn change_to(&mut self, conditions: Conditions) -> Option<&[u8]> {
        let Self { modulation, inputs, packing, parameters, half, .. } = self;
        let OffsetParameters { weight, bias } = modulation.change_to(conditions)?;
        let count = inputs.len();
        packing.fill(parameters, inputs, bias.iter().copied(), |output, input, tap| {
            weight[(output * count + input) * 9 + tap]
        });
        if packing.precision == Precision::Single {
            return Some(bytemuck::cast_slice(parameters));
        }
        for (half, value) in half.iter_mut().zip(parameters.iter()) {
            *half = f16::from_f32(*value).to_bits();
        }
        Some(bytemuck::cast_slice(half))
    }
}

/// How features lie on the device, and how layers that read them multiply.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Features {
    pub(crate) format: Format,
    /// Where products are of vectors in single precision.
    pub(crate) method: Method,
}

/// Adds a stage for each of `layers`, called `{prefix}layer 0` and so on. The first one reads the channels `inputs` of
/// `input`. Returns the last one's map, and what depends on the pupil.
pub(super) fn run(
    plan: &mut Plan,
    prefix: &str,
    layers: &[Layer],
    leaky_slope: f32,
    Features { format, method }: Features,
    input: &Map,
    inputs: &[usize],
) -> (Map, Vec<Modulated>) {
    let size = (input.width, input.height);
    let last = layers.len() - 1;
    let features = Map::with(format, plan, "features", size, layers[0].out_channels);
    let between = Map::with(format, plan, "features between two layers", size, layers[0].out_channels);
    let output = Map::with(format.of_outputs(), plan, "what a net gives", size, layers[last].out_channels);
    let in_order: Vec<usize> = (0..layers[0].out_channels).collect();
    let mut modulated = Vec::new();
    for (index, layer) in layers.iter().enumerate() {
        let (from, channels, to) = match index {
            0 => (input, inputs, &features),
            _ if index == last => (&features, &in_order[..], &output),
            _ if index % 2 == 1 => (&features, &in_order[..], &between),
            _ => (&between, &in_order[..], &features),
        };
        let epilogue = match index {
            _ if index == last => Epilogue::None,
            _ if index > 0 && index % 2 == 0 => Epilogue::ResidualLeaky,
            _ => Epilogue::Leaky,
        };
        let groups = channels.iter().max().map_or(0, |most| most / GROUP + 1);
        let outputs = layer.out_channels + layer.adjustable.as_ref().map_or(0, |_| OFFSET_CHANNELS);
        let adjustable = if layer.adjustable.is_some() { " (adjustable)" } else { "" };
        let name = format!("{prefix}layer {index}{adjustable}");
        plan.stage(&name, (2 * 9 * layer.in_channels * outputs * size.0 * size.1) as u64);
        let conv = ConvLayer { weight: &layer.weight, bias: &layer.bias, inputs: channels, epilogue, leaky_slope };
        let Some(adjustable) = &layer.adjustable else {
            conv::convolve(plan, &name, &conv, method, (from, groups), to);
            continue;
        };
        let offsets = Map::new(plan, "offsets", size, OFFSET_CHANNELS);
        let predicted = ConvLayer {
            weight: &adjustable.offset_weight,
            bias: &adjustable.offset_bias,
            epilogue: Epilogue::None,
            ..conv
        };
        let label = format!("{name}: offsets");
        let (buffer, packing) = conv::convolve(plan, &label, &predicted, method, (from, groups), &offsets);
        modulated.push(Modulated {
            modulation: Modulation::new(adjustable, leaky_slope),
            inputs: channels.to_vec(),
            parameters: vec![0.0; packing.len()],
            half: vec![0; if packing.precision == Precision::Half { packing.len() } else { 0 }],
            packing,
            buffer,
        });
        deformable::convolve(plan, &name, &conv, from, &offsets, to);
    }
    (output, modulated)
}
