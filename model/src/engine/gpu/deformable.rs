//! Deformable 3x3 convolutions on the GPU: every tap of every pixel is read at a place of its own.
//!
//! Layers that read matrices interpolate in half precision and multiply matrices. Of the others those that read or
//! write a map of half precision interpolate and multiply in half precision, two products at once, and sum up what each
//! tap gives in single precision.

use super::conv::{ConvLayer, TAPS, products};
use super::map::{Format, GROUP, Map, TILE};
use super::matrix::{self, TilePacking};
use super::plan::{Plan, Shader};
use crate::engine::Precision;
use crate::weights::OFFSET_CHANNELS;

/// Threads of a workgroup, along x.
const WORKGROUP: usize = 64;
/// Rows that one thread makes.
const ROWS: usize = 2;
/// Groups of output channels that a thread holds sums of, at most. With all of them in one thread no place is read
/// twice.
const MOST_PART_GROUPS: usize = 8;

/// Adds to the plan's last stage the deformable convolution of `input` into `output`, a map of the same size in another
/// buffer: each tap k of each pixel is read at its place plus (`offsets[2k]`, `offsets[2k + 1]`) = (dy, dx) by bilinear
/// interpolation, zero outside.
pub(crate) fn convolve(plan: &mut Plan, label: &str, layer: &ConvLayer, input: &Map, offsets: &Map, output: &Map) {
    layer.check((input, input.groups), output);
    assert_eq!((offsets.width, offsets.height), (output.width, output.height));
    assert!(offsets.groups >= OFFSET_CHANNELS.div_ceil(GROUP) && offsets.buffer != output.buffer);
    assert_eq!(offsets.format, Format::Single);

    let mut constants = layer.epilogue_constants(output);
    constants.extend([("ROWS", ROWS.into()), input.block("IN_BLOCK")]);
    constants.extend(input.constants(["IN_GROUPS", "IN_PITCH"]));
    constants.extend(offsets.constants(["OFFSET_GROUPS", "OFFSET_PITCH"]));
    let places = include_str!("deformable_places.wgsl");
    let (source, values, precision, parts, columns) = match input.format {
        Format::HalfTiles(units) => {
            let input_blocks = input.groups * GROUP / TILE;
            let packing = TilePacking::new(units, output.groups, TAPS * input_blocks);
            constants.push(("INPUT_BLOCKS", input_blocks.into()));
            let files = [places, include_str!("deformable_matrix.wgsl")];
            let source = matrix::source(output, units, "gathered", ROWS, &files);
            (source, pack_tiles(layer, input_blocks, packing), Precision::Half, packing.parts, TILE)
        }
        Format::Single | Format::Half => {
            let precision = products(input, output);
            let parts = output.groups.div_ceil(MOST_PART_GROUPS);
            let part_groups = output.groups.div_ceil(parts);
            constants.extend([
                ("WORKGROUP", WORKGROUP.into()),
                ("INPUT_GROUPS", input.groups.into()),
                ("PART_GROUPS", part_groups.into()),
            ]);
            let text = match precision {
                Precision::Single => include_str!("deformable.wgsl"),
                Precision::Half => include_str!("deformable_f16.wgsl"),
            };
            let source = layer.source(input, output, &[places, text].concat());
            (source, pack(layer, precision, input.groups, [parts, part_groups]), precision, parts, WORKGROUP)
        }
    };
    constants.push(("PARTS", parts.into()));
    let parameters = precision.table(plan, "a deformable convolution's parameters", &values);
    let shader = Shader::new(label, &constants, &source, "convolve");
    let workgroups = [output.width.div_ceil(columns) * parts, output.height.div_ceil(ROWS), 1];
    let stage = plan.stages.last_mut().expect("a stage was added for the layer");
    let dispatch = stage.dispatch(shader, &[input.buffer, offsets.buffer, parameters, output.buffer], workgroups);
    let parameter_bytes = (values.len() * precision.bytes()) as u64;
    dispatch.bytes = Some(input.inner_bytes() + offsets.inner_bytes() + parameter_bytes + layer.output_bytes(output));
}

/// The parameters of `layer` as the shader that multiplies matrices has them.
fn pack_tiles(layer: &ConvLayer, input_blocks: usize, packing: TilePacking) -> Vec<f32> {
    let mut parameters = vec![0.0; packing.len()];
    for (output, bias) in layer.bias.iter().enumerate() {
        parameters[output] = *bias;
        for (input, channel) in layer.inputs.iter().enumerate() {
            for tap in 0..TAPS {
                let step = tap * input_blocks + channel / TILE;
                parameters[packing.place(output, step, *channel)] = layer.weight(output, input, tap);
            }
        }
    }
    parameters
}

/// The parameters of `layer` as the shader has them.
fn pack(layer: &ConvLayer, precision: Precision, input_groups: usize, [parts, part_groups]: [usize; 2]) -> Vec<f32> {
    let elements = |vectors: usize| vectors.next_multiple_of(precision.element_vectors()) * GROUP;
    let (biases, tap_len) = (elements(parts * part_groups), elements(input_groups * GROUP * part_groups));
    let mut parameters = vec![0.0; biases + parts * TAPS * tap_len];
    for (output, bias) in layer.bias.iter().enumerate() {
        parameters[output] = *bias;
        let (part, group) = (output / GROUP / part_groups, output / GROUP % part_groups);
        for (input, channel) in layer.inputs.iter().enumerate() {
            for tap in 0..TAPS {
                let first = biases + (part * TAPS + tap) * tap_len;
                let place = (channel * part_groups + group) * GROUP + output % GROUP;
                parameters[first + place] = layer.weight(output, input, tap);
            }
        }
    }
    parameters
}

#[cfg(test)]
mod tests {
    use super::super::conv::Epilogue;
    use super::super::conv::tests::{SLOPE, all_tiles, finish, judge, noise, value, worse};
    use super::super::trial::Trial;
    use super::*;
    use crate::engine::reference;

    type Offset = fn(usize, usize, usize) -> f32;

    fn skip(channel: usize, y: usize, x: usize) -> f32 {
        3.0 * value(channel + 50, y, x)
    }

    /// A layer of `inputs` to `outputs` channels that reads where `offset` leads.
    #[derive(Clone)]
    struct Case {
        /// Of the input map and of the output map.
        formats: [Format; 2],
        size: (usize, usize),
        inputs: usize,
        outputs: usize,
        epilogue: Epilogue,
        offset: Offset,
    }

    impl Case {
        fn found(&self) -> Vec<f32> {
            let Self { formats, size, inputs, outputs, epilogue, offset } = *self;
            let mut plan = Plan::default();
            let input = Map::with(formats[0], &mut plan, "input", size, inputs);
            let offsets = Map::new(&mut plan, "offsets", size, OFFSET_CHANNELS);
            let output = Map::with(formats[1], &mut plan, "output", size, outputs);
            let weight: Vec<_> = (0..outputs * inputs * TAPS).map(noise).collect();
            let bias: Vec<_> = (0..outputs).map(|output| noise(9_000_000 + output)).collect();
            let channels: Vec<_> = (0..inputs).rev().collect();
            let layer = ConvLayer { weight: &weight, bias: &bias, inputs: &channels, epilogue, leaky_slope: SLOPE };
            plan.stage("layer", 0);
            convolve(&mut plan, "convolution", &layer, &input, &offsets, &output);
            let trial = Trial::new(&plan);
            trial.write(input.buffer, &input.values(value));
            trial.write(offsets.buffer, &offsets.values(|channel, y, x| offset(channel.min(17), y, x)));
            trial.write(
                output.buffer,
                &output.values(|channel, y, x| skip(channel, y, x) * f32::from(channel < outputs)),
            );
            trial.run();
            output.planes(&trial.read(output.buffer), outputs)
        }

        fn expected(&self) -> Vec<f64> {
            let Self { size: (width, height), inputs, outputs, epilogue, offset, .. } = *self;
            let input = reference::Map::from_fn([inputs, height, width], |channel, y, x| value(channel, y, x).into());
            let sum = |output: usize, y: usize, x: usize| {
                let mut sum = f64::from(noise(9_000_000 + output));
                for tap in 0..TAPS {
                    let at_y = (y + tap / 3) as f64 - 1.0 + f64::from(offset(2 * tap, y, x));
                    let at_x = (x + tap % 3) as f64 - 1.0 + f64::from(offset(2 * tap + 1, y, x));
                    if !at_y.is_finite() || !at_x.is_finite() {
                        continue;
                    }
                    for channel in 0..inputs {
                        let weight = f64::from(noise((output * inputs + channel) * TAPS + tap));
                        sum += weight * input.bilinear(inputs - 1 - channel, at_y, at_x);
                    }
                }
                finish(epilogue, sum, skip(output, y, x))
            };
            reference::Map::from_fn([outputs, height, width], sum).values
        }

        fn new(size: (usize, usize), inputs: usize, outputs: usize, epilogue: Epilogue, offset: Offset) -> Self {
            Self { formats: [Format::Single; 2], size, inputs, outputs, epilogue, offset }
        }

        fn check(&self) {
            let Self { formats, size, inputs, outputs, epilogue, .. } = *self;
            judge(worse(formats), &self.found(), &self.expected())
                .unwrap_or_else(|error| panic!("{formats:?}, {size:?}, {inputs} to {outputs}, {epilogue:?}: {error}"));
        }
    }

    /// Up to three pixels, some of them whole or half ones.
    fn moderate(channel: usize, y: usize, x: usize) -> f32 {
        let offset = 3.0 * value(channel, y, x + 7);
        if (x + channel).is_multiple_of(3) { (2.0 * offset).round() / 2.0 } else { offset }
    }

    /// Onto the border, over it, and nowhere.
    fn wild(channel: usize, y: usize, x: usize) -> f32 {
        match (channel + 3 * x + 5 * y) % 7 {
            0 => f32::NAN,
            1 => f32::INFINITY,
            2 => -1e30,
            3 => -(x as f32) - 0.25,
            4 => 40.0 * value(channel, y, x),
            5 => 1.0,
            _ => -2.0,
        }
    }

    #[test]
    fn sums_are_right_for_both_networks_layers() {
        for (channels, epilogue) in
            [(32, Epilogue::ResidualLeaky), (24, Epilogue::ResidualLeaky), (24, Epilogue::Leaky)]
        {
            Case::new((37, 11), channels, channels, epilogue, moderate).check();
        }
    }

    #[test]
    fn sums_are_right_for_odd_sizes_and_channels_and_all_places() {
        for offset in [moderate as Offset, wild] {
            for size in [(1, 1), (1, 33), (33, 1), (64, 2), (65, 3)] {
                Case::new(size, 5, 7, Epilogue::None, offset).check();
            }
            Case::new((9, 7), 21, 40, Epilogue::Leaky, offset).check();
        }
    }

    /// Between maps of both precisions; an odd number of groups does not fill its elements.
    #[test]
    fn sums_are_right_in_half_precision() {
        let (single, half) = (Format::Single, Format::Half);
        for (formats, offset) in [([half, half], wild as Offset), ([single, half], moderate), ([half, single], wild)] {
            Case { formats, ..Case::new((65, 3), 5, 12, Epilogue::ResidualLeaky, offset) }.check();
        }
    }

    /// With blocks that the layer does not fill, and rows of workgroups that end below the map.
    #[test]
    fn sums_of_products_of_matrices_are_right() {
        for tiles in all_tiles() {
            for (output, size, inputs, outputs, offset) in [
                (tiles, (33, 5), 32, 32, wild as Offset),
                (tiles, (16, 2), 5, 7, moderate),
                (Format::Single, (1, 1), 24, 40, moderate),
            ] {
                let formats = [tiles, output];
                Case { formats, ..Case::new(size, inputs, outputs, Epilogue::ResidualLeaky, offset) }.check();
            }
        }
    }

    /// Canary: one offset that is a little off is not right.
    #[test]
    fn a_wrong_offset_is_seen() {
        let case = Case::new((9, 7), 5, 7, Epilogue::None, moderate);
        let expected = case.expected();
        judge(Precision::Single, &case.found(), &expected).expect("the same offsets");
        let offset = |channel, y, x| moderate(channel, y, x) + if (channel, y, x) == (4, 3, 2) { 1e-3 } else { 0.0 };
        judge(Precision::Single, &Case { offset, ..case }.found(), &expected).expect_err("one other offset");
    }
}
