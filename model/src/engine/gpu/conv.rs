//! 3x3 convolutions on the GPU, as sums over taps.
//!
//! Layers that read matrices multiply these, in half precision, and sum up in single precision. Of the others those
//! that read or write a map of half precision multiply in half precision, two products at once, and sum up what a few
//! groups of input channels give in single precision; the rest multiply in single precision.

use half::f16;

use super::map::{Format, GROUP, Map, ROWS, TILE};
use super::matrix::{self, TilePacking};
use super::plan::{BufferId, Constant, ENABLE_F16, Plan, Shader};
use super::winograd;
use crate::engine::Precision;
use crate::gpu::MatrixUnits;

pub(super) const TAPS: usize = 9;
/// Threads of a workgroup, along x.
const WORKGROUP: usize = 64;
/// Bytes of parameters that the shaders load at once.
const ELEMENT_BYTES: usize = 64;
/// A thread's rows are those that Winograd's points give.
const _: () = assert!(ROWS + 2 == winograd::POINTS);
/// Groups of input channels whose products are summed in half precision, at most.
const MOST_TRIP_GROUPS: usize = 5;

/// How a layer that multiplies vectors makes its products.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Method {
    /// Each input by each weight.
    Direct,
    /// Half as many, of sums of inputs by sums of weights ([`winograd`]).
    Winograd,
}

impl Method {
    /// A maker's number at PCI.
    pub(super) const NVIDIA: u32 = 0x10de;

    /// Of layers in single precision, on a device of this maker's number at PCI. NVIDIA's devices load weights by the
    /// way of all memory, and four products of one in a thread pay for it; those of others have a way of their own for
    /// what all threads share, and one product is enough.
    pub(crate) fn of_vendor(vendor: u32) -> Self {
        if vendor == Self::NVIDIA { Self::Direct } else { Self::Winograd }
    }

    /// Groups of output channels that a thread holds sums of, at most: with so many a shader has registers left for
    /// what it multiplies.
    fn most_part_groups(self) -> usize {
        match self {
            Self::Direct => 5,
            Self::Winograd => 2,
        }
    }

    /// Weights for each column of the kernel.
    fn column_weights(self) -> usize {
        match self {
            Self::Direct => 3,
            Self::Winograd => winograd::POINTS,
        }
    }
}

impl Precision {
    /// Vectors of parameters in an element.
    pub(super) fn element_vectors(self) -> usize {
        ELEMENT_BYTES / (GROUP * self.bytes())
    }

    /// A buffer of parameters.
    pub(super) fn table(self, plan: &mut Plan, what: &'static str, parameters: &[f32]) -> BufferId {
        match self {
            Self::Single => plan.table(what, parameters),
            Self::Half => {
                let half: Vec<_> = parameters.iter().map(|&value| f16::from_f32(value).to_bits()).collect();
                plan.table(what, &half)
            }
        }
    }
}

/// What is done with a sum before it is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Epilogue {
    /// The sum as it is.
    None,
    /// leaky(sum), with the layer's slope below 0
    Leaky,
    /// leaky(½·sum + what the output map holds)
    ResidualLeaky,
}

/// A convolution's parameters, and what is done with its sums.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ConvLayer<'a> {
    /// [outputs, inputs, 3, 3]
    pub(crate) weight: &'a [f32],
    /// [outputs]
    pub(crate) bias: &'a [f32],
    /// [inputs]: which channel of the map each one is. Channels of the map that are none of them have no weight.
    pub(crate) inputs: &'a [usize],
    pub(crate) epilogue: Epilogue,
    pub(crate) leaky_slope: f32,
}

impl ConvLayer<'_> {
    /// The weight by which `input`, in the order of the weights, is multiplied at `tap` for `output`.
    pub(super) fn weight(&self, output: usize, input: usize, tap: usize) -> f32 {
        self.weight[(output * self.inputs.len() + input) * TAPS + tap]
    }

    /// The constants of `epilogue.wgsl` for the map `output`.
    pub(super) fn epilogue_constants(&self, output: &Map) -> Vec<(&'static str, Constant)> {
        let mut constants = vec![
            ("WIDTH", output.width.into()),
            ("HEIGHT", output.height.into()),
            ("RESIDUAL", (self.epilogue == Epilogue::ResidualLeaky).into()),
            ("LEAKY", (self.epilogue != Epilogue::None).into()),
            ("LEAKY_SLOPE", self.leaky_slope.into()),
        ];
        constants.push(output.block("OUT_BLOCK"));
        constants.extend(output.constants(["OUT_GROUPS", "OUT_PITCH"]));
        constants
    }

    /// `epilogue.wgsl`, `store.wgsl` and `text` for the vectors of two maps.
    pub(super) fn source(&self, input: &Map, output: &Map, text: &str) -> String {
        let epilogue = concat!(include_str!("epilogue.wgsl"), "\n", include_str!("store.wgsl"));
        let directive = if products(input, output) == Precision::Half { ENABLE_F16 } else { "" };
        let [input, output] = [input, output].map(|map| map.format.precision().vector());
        format!("{directive}alias InVector = {input};\nalias OutVector = {output};\n\n{epilogue}\n{text}")
    }

    /// Bytes of `output` that are read and written.
    pub(super) fn output_bytes(&self, output: &Map) -> u64 {
        output.inner_bytes() * if self.epilogue == Epilogue::ResidualLeaky { 2 } else { 1 }
    }

    /// Whether the layer can read the first `input_groups` of `input` and write `output`.
    pub(super) fn check(&self, (input, input_groups): (&Map, usize), output: &Map) {
        assert_eq!((input.width, input.height), (output.width, output.height));
        assert!(input.buffer != output.buffer && input_groups <= input.groups);
        assert!(self.inputs.iter().all(|&channel| channel < input_groups * GROUP));
        assert!(self.bias.len() <= output.groups * GROUP);
        assert_eq!(self.weight.len(), self.bias.len() * self.inputs.len() * TAPS);
    }
}

/// How a layer's parameters lie in their buffer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Packing {
    /// Of the parameters.
    pub(super) precision: Precision,
    layout: Layout,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Layout {
    /// Threads make the output channels in parts of a few whole groups; those beyond the map's groups are zero and not
    /// stored.
    Groups { method: Method, input_groups: usize, parts: usize, part_groups: usize },
    /// Matrices, for each column of the kernel, block of inputs and row of the kernel or point.
    Tiles { input_blocks: usize, column_weights: usize, packing: TilePacking },
}

impl Packing {
    /// For a layer that multiplies vectors in `precision` by `method`, reads the first `input_groups` of a map and
    /// writes a map of `output_groups`.
    pub(crate) fn new(method: Method, precision: Precision, input_groups: usize, output_groups: usize) -> Self {
        let parts = output_groups.div_ceil(method.most_part_groups());
        let part_groups = output_groups.div_ceil(parts);
        Self { precision, layout: Layout::Groups { method, input_groups, parts, part_groups } }
    }

    /// For a layer that multiplies matrices, and reads the first `input_blocks` of a map.
    fn of_tiles(units: MatrixUnits, input_blocks: usize, output_groups: usize) -> Self {
        let method = if matrix::by_points(units) { Method::Winograd } else { Method::Direct };
        let column_weights = method.column_weights();
        let packing = TilePacking::new(units, output_groups, 3 * column_weights * input_blocks);
        Self { precision: Precision::Half, layout: Layout::Tiles { input_blocks, column_weights, packing } }
    }

    /// Numbers in the buffer.
    pub(crate) fn len(&self) -> usize {
        match self.layout {
            Layout::Groups { method, input_groups, parts, part_groups } => {
                self.biases(parts * part_groups) + parts * input_groups * Self::group_len(method, part_groups)
            }
            Layout::Tiles { packing, .. } => packing.len(),
        }
    }

    fn parts(&self) -> usize {
        match self.layout {
            Layout::Groups { parts, .. } => parts,
            Layout::Tiles { packing, .. } => packing.parts,
        }
    }

    /// Biases of so many groups of outputs, filled up to whole elements.
    fn biases(&self, groups: usize) -> usize {
        groups.next_multiple_of(self.precision.element_vectors()) * GROUP
    }

    /// Weights of one part of `part_groups` for one group of inputs.
    fn group_len(method: Method, part_groups: usize) -> usize {
        3 * method.column_weights() * GROUP * part_groups * GROUP
    }

    /// The place of the weight by which `input`, a channel of the map, is multiplied for `output`: that of a column of
    /// the kernel and of a row of it or, by [`Method::Winograd`], a point.
    fn place(&self, output: usize, input: usize, column: usize, row: usize) -> usize {
        match self.layout {
            Layout::Groups { method, input_groups, parts, part_groups } => {
                let (group, lane) = (output / GROUP, output % GROUP);
                let (part, group) = (group / part_groups, group % part_groups);
                let before = (part * input_groups + input / GROUP) * Self::group_len(method, part_groups);
                let first = self.biases(parts * part_groups) + before;
                let channel = (column * method.column_weights() + row) * GROUP + input % GROUP;
                first + (channel * part_groups + group) * GROUP + lane
            }
            Layout::Tiles { input_blocks, column_weights, packing } => {
                packing.place(output, (column * input_blocks + input / TILE) * column_weights + row, input)
            }
        }
    }

    /// Writes the parameters of a layer to `parameters`, of [`Self::len`] zeros or of the same layer at other values:
    /// the bias of each output, and `weight(output, input, tap)`, taps row-major over the kernel, for those of the
    /// map's channels that `inputs` lists.
    pub(crate) fn fill(
        &self,
        parameters: &mut [f32],
        inputs: &[usize],
        bias: impl ExactSizeIterator<Item = f32>,
        weight: impl Fn(usize, usize, usize) -> f32,
    ) {
        for (output, value) in bias.enumerate() {
            parameters[output] = value;
            for (input, channel) in inputs.iter().enumerate() {
                for column in 0..3 {
                    let weights = [0, 1, 2].map(|row| weight(output, input, row * 3 + column));
                    let mut put = |row, weight| parameters[self.place(output, *channel, column, row)] = weight;
                    match self.layout {
                        Layout::Groups { method: Method::Winograd, .. }
                        | Layout::Tiles { column_weights: winograd::POINTS, .. } => {
                            winograd::at_points(weights).into_iter().enumerate().for_each(|(point, at)| put(point, at));
                        }
                        _ => weights.into_iter().enumerate().for_each(|(row, weight)| put(row, weight)),
                    }
                }
            }
        }
    }

    /// The parameters of `layer`.
    pub(crate) fn pack(&self, layer: &ConvLayer) -> Vec<f32> {
        let mut parameters = vec![0.0; self.len()];
        let weight = |output, input, tap| layer.weight(output, input, tap);
        self.fill(&mut parameters, layer.inputs, layer.bias.iter().copied(), weight);
        parameters
    }
}

/// In which precision a layer between these maps multiplies, where it does not multiply matrices.
pub(super) fn products(input: &Map, output: &Map) -> Precision {
    let half = [input, output].iter().any(|map| map.format.precision() == Precision::Half);
    if half { Precision::Half } else { Precision::Single }
}

/// Adds to the plan's last stage the convolution of the first `input_groups` of `input` into `output`, a map of the
/// same size in another buffer; by `method` where it multiplies vectors in single precision, and by
/// [`Method::Winograd`] where it does so in half precision. Gives the buffer of the parameters, and how they lie there.
pub(crate) fn convolve(
    plan: &mut Plan,
    label: &str,
    layer: &ConvLayer,
    method: Method,
    (input, input_groups): (&Map, usize),
    output: &Map,
) -> (BufferId, Packing) {
    layer.check((input, input_groups), output);
    let precision = products(input, output);
    let method = if precision == Precision::Half { Method::Winograd } else { method };
    let input_blocks = input_groups.div_ceil(TILE / GROUP);
    let packing = match input.format {
        Format::HalfTiles(units) => Packing::of_tiles(units, input_blocks, output.groups),
        Format::Single | Format::Half => Packing::new(method, precision, input_groups, output.groups),
    };
    let parameters = packing.precision.table(plan, "a convolution's parameters", &packing.pack(layer));
    let mut constants = layer.epilogue_constants(output);
    constants.push(("PARTS", packing.parts().into()));
    constants.extend(input.constants(["IN_GROUPS", "IN_PITCH"]));
    let (source, rows, columns) = match (input.format, packing.layout) {
        (Format::HalfTiles(units), _) => {
            let rows = matrix::rows(units);
            constants.extend([("INPUT_BLOCKS", input_blocks.into()), input.block("IN_BLOCK")]);
            let source = if matrix::by_points(units) {
                constants.extend(winograd::constants());
                let text = winograd::source("f16", include_str!("conv_matrix_winograd.wgsl"));
                matrix::source(output, units, "points", rows, &[&text])
            } else {
                matrix::source(output, units, "input", rows, &[include_str!("conv_matrix.wgsl")])
            };
            (source, rows, TILE)
        }
        (_, Layout::Groups { part_groups, .. }) => {
            constants.extend([
                ("WORKGROUP", WORKGROUP.into()),
                ("INPUT_GROUPS", input_groups.into()),
                ("PART_GROUPS", part_groups.into()),
            ]);
            if method == Method::Winograd {
                constants.extend(winograd::constants());
            }
            let text = match (method, precision) {
                (Method::Direct, _) => include_str!("conv.wgsl").to_owned(),
                (Method::Winograd, Precision::Single) => {
                    winograd::source_with_rows("f32", include_str!("conv_winograd.wgsl"))
                }
                (Method::Winograd, Precision::Half) => {
                    let fits = (1..=MOST_TRIP_GROUPS).rev().find(|groups| input_groups.is_multiple_of(*groups));
                    constants.push(("TRIP", fits.expect("each number is a multiple of one").into()));
                    winograd::source_with_rows("f16", include_str!("conv_winograd_f16.wgsl"))
                }
            };
            (layer.source(input, output, &text), ROWS, WORKGROUP)
        }
        (_, Layout::Tiles { .. }) => unreachable!("only maps of tiles have such parameters"),
    };
    constants.push(("ROWS", rows.into()));
    let shader = Shader::new(label, &constants, &source, "convolve");
    let workgroups = [output.width.div_ceil(columns) * packing.parts(), output.height.div_ceil(rows), 1];
    let stage = plan.stages.last_mut().expect("a stage was added for the layer");
    let dispatch = stage.dispatch(shader, &[input.buffer, parameters, output.buffer], workgroups);
    let input_bytes = input.inner_bytes() / input.groups as u64 * input_groups as u64;
    let parameter_bytes = (packing.len() * packing.precision.bytes()) as u64;
    dispatch.bytes = Some(input_bytes + parameter_bytes + layer.output_bytes(output));
    (parameters, packing)
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::OnceLock;

    use super::super::trial::Trial;
    use super::*;
    use crate::engine::reference;
    use crate::gpu::test_gpu;

    /// Largest error allowed, over the output's root mean square: of sums in single precision, and of products and sums
    /// in half precision.
    const TOLERANCE: f64 = 1e-5;
    const HALF_TOLERANCE: f64 = 1e-2;
    /// Of the sums at points, which are larger than the outputs, of up to 48 products in half precision.
    const WINOGRAD_HALF_TOLERANCE: f64 = 2.5e-2;
    pub(in super::super) const SLOPE: f32 = 0.1;

    /// In −1..1.
    pub(in super::super) fn noise(index: usize) -> f32 {
        let mixed = (index as u32 ^ 0x5bd1_e995).wrapping_mul(0x9e37_79b9);
        ((mixed ^ (mixed >> 15)).wrapping_mul(0x2c1b_3c6d) >> 8) as f32 / (1 << 23) as f32 - 1.0
    }

    pub(in super::super) fn value(channel: usize, y: usize, x: usize) -> f32 {
        noise(1_000_000 + (y * 300 + x) * 100 + channel)
    }

    fn skip(channel: usize, y: usize, x: usize) -> f32 {
        3.0 * value(channel + 50, y, x)
    }

    /// Whether both are alike.
    pub(in super::super) fn judge(precision: Precision, found: &[f32], expected: &[f64]) -> Result<(), String> {
        let tolerance = match precision {
            Precision::Single => TOLERANCE,
            Precision::Half => HALF_TOLERANCE,
        };
        judge_within(tolerance, found, expected)
    }

    fn judge_within(tolerance: f64, found: &[f32], expected: &[f64]) -> Result<(), String> {
        assert_eq!(found.len(), expected.len());
        let rms = (expected.iter().map(|value| value * value).sum::<f64>() / expected.len() as f64).sqrt();
        for (place, (found, expected)) in found.iter().zip(expected).enumerate() {
            // NaN is not near.
            let near = (f64::from(*found) - expected).abs() <= tolerance * rms;
            if !near {
                return Err(format!("value {place} is {found}; expected {expected}, of which the rms is {rms}"));
            }
        }
        Ok(())
    }

    /// Of the maps' precisions the lower.
    pub(in super::super) fn worse(formats: [Format; 2]) -> Precision {
        let half = formats.iter().any(|format| format.precision() == Precision::Half);
        if half { Precision::Half } else { Precision::Single }
    }

    pub(in super::super) fn finish(epilogue: Epilogue, sum: f64, skip: f32) -> f64 {
        let leaky = |value: f64| value.max(value * f64::from(SLOPE));
        match epilogue {
            Epilogue::None => sum,
            Epilogue::Leaky => leaky(sum),
            Epilogue::ResidualLeaky => leaky(0.5 * sum + f64::from(skip)),
        }
    }

    /// Matrices for the units of the device that tests run on, or for threads.
    pub(in super::super) fn tiles() -> Format {
        static UNITS: OnceLock<MatrixUnits> = OnceLock::new();
        Format::HalfTiles(*UNITS.get_or_init(|| test_gpu().matrix_units.unwrap_or(MatrixUnits::Threads)))
    }

    /// The same and, for threads alone, those of a device that chooses between sizes of subgroups.
    pub(in super::super) fn all_tiles() -> [Format; 3] {
        let of_threads = |in_one| Format::HalfTiles(MatrixUnits::ThreadsOfAnySubgroups { in_one });
        [tiles(), of_threads(false), of_threads(true)]
    }

    /// A layer of `outputs` that reads `inputs`, channels of the first groups of a wider map.
    #[derive(Clone)]
    struct Case {
        method: Method,
        /// Of the input map and of the output map.
        formats: [Format; 2],
        size: (usize, usize),
        inputs: Vec<usize>,
        input_groups: usize,
        outputs: usize,
        epilogue: Epilogue,
    }

    impl Case {
        fn new(size: (usize, usize), inputs: usize, outputs: usize, epilogue: Epilogue) -> Self {
            Self {
                method: Method::Winograd,
                formats: [Format::Single; 2],
                size,
                inputs: (0..inputs).collect(),
                input_groups: inputs.div_ceil(GROUP),
                outputs,
                epilogue,
            }
        }

        fn found(&self) -> Vec<f32> {
            let Self { method, formats, size, ref inputs, input_groups, outputs, epilogue } = *self;
            let mut plan = Plan::default();
            let input = Map::with(formats[0], &mut plan, "input", size, (input_groups + 1) * GROUP);
            let output = Map::with(formats[1], &mut plan, "output", size, outputs);
            let weight: Vec<_> = (0..outputs * inputs.len() * TAPS).map(noise).collect();
            let bias: Vec<_> = (0..outputs).map(|output| noise(9_000_000 + output)).collect();
            let layer = ConvLayer { weight: &weight, bias: &bias, inputs, epilogue, leaky_slope: SLOPE };
            plan.stage("layer", 0);
            convolve(&mut plan, "convolution", &layer, method, (&input, input_groups), &output);
            let trial = Trial::new(&plan);
            // What no layer reads is not finite.
            let read = input_groups.next_multiple_of(formats[0].block_groups()) * GROUP;
            let shown = |channel, y, x| if channel < read { value(channel, y, x) } else { f32::NAN };
            trial.write(input.buffer, &input.values(shown));
            trial.write(
                output.buffer,
                &output.values(|channel, y, x| skip(channel, y, x) * f32::from(channel < outputs)),
            );
            trial.run();
            output.planes(&trial.read(output.buffer), outputs)
        }

        fn expected(&self) -> Vec<f64> {
            let Self { size: (width, height), ref inputs, outputs, epilogue, .. } = *self;
            let shape = [inputs.len(), height, width];
            let input = reference::Map::from_fn(shape, |channel, y, x| value(inputs[channel], y, x).into());
            let sum = |output: usize, y: usize, x: usize| {
                let mut sum = f64::from(noise(9_000_000 + output));
                for (channel, tap) in (0..inputs.len()).flat_map(|channel| (0..TAPS).map(move |tap| (channel, tap))) {
                    let weight = f64::from(noise((output * inputs.len() + channel) * TAPS + tap));
                    let (y, x) = ((y + tap / 3) as isize - 1, (x + tap % 3) as isize - 1);
                    sum += weight * input.at(channel, y, x);
                }
                finish(epilogue, sum, skip(output, y, x))
            };
            reference::Map::from_fn([outputs, height, width], sum).values
        }

        fn judge(&self, found: &[f32], expected: &[f64]) -> Result<(), String> {
            match (worse(self.formats), self.formats[0]) {
                (Precision::Half, Format::Single | Format::Half) => {
                    judge_within(WINOGRAD_HALF_TOLERANCE, found, expected)
                }
                (Precision::Half, Format::HalfTiles(units)) if matrix::by_points(units) => {
                    judge_within(WINOGRAD_HALF_TOLERANCE, found, expected)
                }
                (precision, _) => judge(precision, found, expected),
            }
        }

        fn check(&self) {
            let Self { method, formats, size, ref inputs, outputs, epilogue, .. } = *self;
            self.judge(&self.found(), &self.expected()).unwrap_or_else(|error| {
                panic!("{method:?}, {formats:?}, {size:?}, {} to {outputs}, {epilogue:?}: {error}", inputs.len())
            });
        }
    }

    #[test]
    fn sums_are_right_for_all_layers_of_both_networks() {
        for (inputs, outputs, epilogue) in [
            (32, 32, Epilogue::Leaky),
            (32, 32, Epilogue::ResidualLeaky),
            (32, 6, Epilogue::None),
            (32, 18, Epilogue::None),
            (24, 24, Epilogue::Leaky),
            (24, 24, Epilogue::ResidualLeaky),
            (24, 6, Epilogue::None),
            (24, 18, Epilogue::None),
        ] {
            Case::new((37, 11), inputs, outputs, epilogue).check();
        }
    }

    #[test]
    fn sums_of_direct_products_are_right() {
        for (size, inputs, outputs, epilogue) in [
            ((37, 11), 32, 32, Epilogue::Leaky),
            ((65, 5), 5, 7, Epilogue::ResidualLeaky),
            ((63, 3), 24, 18, Epilogue::None),
            ((1, 1), 4, 24, Epilogue::None),
        ] {
            Case { method: Method::Direct, ..Case::new(size, inputs, outputs, epilogue) }.check();
        }
    }

    #[test]
    fn sums_are_right_for_sizes_around_those_of_workgroups() {
        for size in [(1, 1), (1, 33), (33, 1), (64, 4), (65, 5), (63, 3), (129, 2)] {
            Case::new(size, 5, 7, Epilogue::ResidualLeaky).check();
        }
    }

    /// Between maps of both precisions, with two to five groups to a trip of the loop, and a last part that the map does
    /// not fill.
    #[test]
    fn sums_are_right_in_half_precision() {
        let (single, half) = (Format::Single, Format::Half);
        for formats in [[half, half], [single, half], [half, single]] {
            for (size, inputs, outputs) in
                [((65, 5), 5, 7), ((9, 7), 9, 24), ((33, 3), 84, 32), ((17, 5), 32, 18), ((9, 5), 40, 8)]
            {
                Case { formats, ..Case::new(size, inputs, outputs, Epilogue::ResidualLeaky) }.check();
            }
        }
        Case { formats: [half, half], ..Case::new((1, 1), 4, 4, Epilogue::Leaky) }.check();
    }

    /// With blocks that the layer does not fill, parts that it does not, and rows of workgroups that end below the map.
    #[test]
    fn sums_of_products_of_matrices_are_right() {
        for tiles in all_tiles() {
            for (output, size, inputs, outputs, epilogue) in [
                (tiles, (33, 5), 32, 32, Epilogue::Leaky),
                (tiles, (33, 7), 32, 32, Epilogue::ResidualLeaky),
                (Format::Single, (17, 1), 24, 18, Epilogue::None),
                (tiles, (31, 3), 84, 34, Epilogue::Leaky),
                (Format::Half, (18, 4), 17, 10, Epilogue::None),
                (Format::Single, (1, 1), 5, 7, Epilogue::ResidualLeaky),
            ] {
                Case { formats: [tiles, output], ..Case::new(size, inputs, outputs, epilogue) }.check();
            }
        }
    }

    #[test]
    fn sums_are_right_for_few_and_for_many_channels() {
        for (inputs, outputs) in [(1, 1), (4, 4), (21, 56), (84, 32)] {
            Case::new((9, 7), inputs, outputs, Epilogue::Leaky).check();
        }
    }

    /// As a first layer does, whose weights have another order of channels than the map, and not all of them.
    #[test]
    fn inputs_are_found_where_the_map_has_them() {
        let inputs: Vec<_> = (48..84).chain(0..45).collect();
        let case = Case::new((13, 9), inputs.len(), 32, Epilogue::Leaky);
        Case { inputs, input_groups: 21, ..case }.check();
    }

    #[test]
    fn parameters_are_replaced_in_place() {
        for method in [Method::Direct, Method::Winograd] {
            let packing = Packing::new(method, Precision::Single, 2, 5);
            let bias = |factor: f32| (0..18).map(move |output| factor * noise(output));
            let mut parameters = vec![0.0; packing.len()];
            packing.fill(&mut parameters, &[0, 5], bias(1.0), |output, input, tap| noise(100 + output + input + tap));
            packing.fill(&mut parameters, &[0, 5], bias(2.0), |output, input, tap| noise(output + input + tap));
            let weight: Vec<_> =
                (0..18 * 2 * TAPS).map(|place| noise(place / 18 + place / TAPS % 2 + place % TAPS)).collect();
            let bias: Vec<_> = bias(2.0).collect();
            let layer = ConvLayer {
                weight: &weight,
                bias: &bias,
                inputs: &[0, 5],
                epilogue: Epilogue::None,
                leaky_slope: SLOPE,
            };
            assert_eq!(parameters, packing.pack(&layer));
        }
    }

    /// Canary: what is a little off, or not finite, is not right.
    #[test]
    fn a_wrong_value_is_seen() {
        let case = Case::new((9, 7), 5, 7, Epilogue::ResidualLeaky);
        let expected = case.expected();
        let (direct, winograd) = (Method::Direct, Method::Winograd);
        for (method, format, little) in [
            (direct, Format::Single, 1e-3),
            (winograd, Format::Single, 1e-3),
            (winograd, Format::Half, 0.1),
            (winograd, tiles(), 0.1),
            (winograd, all_tiles()[1], 0.1),
        ] {
            let case = Case { method, formats: [format; 2], ..case.clone() };
            let right = case.found();
            case.judge(&right, &expected).expect("what is right");
            for wrong in [little, f32::NAN] {
                let mut found = right.clone();
                found[100] += wrong;
                case.judge(&found, &expected).expect_err("one wrong value");
            }
            let plain = Case { epilogue: Epilogue::Leaky, ..case };
            plain.judge(&plain.found(), &expected).expect_err("another epilogue");
        }
    }
}
