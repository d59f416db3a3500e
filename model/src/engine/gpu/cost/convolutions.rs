//! The convolutions of a network's two nets.

use holod_calibration::Resolution;

use crate::Weights;
use crate::engine::gpu::conv::{ConvLayer, Epilogue, convolve};
use crate::engine::gpu::deformable;
use crate::engine::gpu::map::{GROUP, Map, Precision};
use crate::engine::gpu::plan::Plan;
use crate::weights::{Family, Grid, Layer, OFFSET_CHANNELS};

pub(super) fn plan(weights: &Weights, resolution: Resolution, precision: Precision) -> Plan {
    let mut plan = Plan::default();
    let scale = if weights.config.grid == Grid::HalfBand { 2 } else { 1 };
    let size = (resolution.width.div_ceil(scale), resolution.height.div_ceil(scale));
    let nets: &[(&str, &Vec<Layer>)] = match &weights.family {
        Family::Direct { layers } => &[("", layers)],
        Family::ExpectedStack { lighting, correction, .. } => &[("lighting ", lighting), ("correction ", correction)],
    };
    for (prefix, layers) in nets {
        let map = |plan: &mut Plan, channels| Map::new(plan, "map", size, channels);
        let inputs = map(&mut plan, layers[0].in_channels.next_multiple_of(GROUP));
        let features = Map::with(precision, &mut plan, "features", size, layers[0].out_channels);
        let between = Map::with(precision, &mut plan, "features", size, layers[0].out_channels);
        let outputs = map(&mut plan, layers.last().expect("there are layers").out_channels);
        let offsets = map(&mut plan, OFFSET_CHANNELS);
        for (index, layer) in layers.iter().enumerate() {
            let last = index + 1 == layers.len();
            let (from, to) = match index {
                0 => (&inputs, &features),
                _ if last => (&features, &outputs),
                _ if index % 2 == 1 => (&features, &between),
                _ => (&between, &features),
            };
            let epilogue = match index {
                _ if last => Epilogue::None,
                _ if index > 0 && index % 2 == 0 => Epilogue::ResidualLeaky,
                _ => Epilogue::Leaky,
            };
            let channels: Vec<_> = (0..layer.in_channels).collect();
            let leaky_slope = weights.config.leaky_slope;
            let conv = ConvLayer { weight: &layer.weight, bias: &layer.bias, inputs: &channels, epilogue, leaky_slope };
            let name = format!("{prefix}layer {index}");
            let (outputs, inputs) = (layer.out_channels, layer.in_channels);
            let products = |outputs| (2 * 9 * inputs * outputs * size.0 * size.1) as u64;
            match &layer.adjustable {
                None => {
                    plan.stage(name.as_str(), products(outputs));
                    convolve(&mut plan, &name, &conv, (from, from.groups), to);
                }
                Some(adjustable) => {
                    plan.stage(format!("{name} (adjustable)"), products(outputs + OFFSET_CHANNELS));
                    let offset_conv = ConvLayer {
                        weight: &adjustable.offset_weight,
                        bias: &adjustable.offset_bias,
                        epilogue: Epilogue::None,
                        ..conv
                    };
                    convolve(&mut plan, &format!("{name} offsets"), &offset_conv, (from, from.groups), &offsets);
                    deformable::convolve(&mut plan, &name, &conv, from, &offsets, to);
                }
            }
        }
    }
    plan
}
