//! 3x3 convolutions on feature maps, plain and deformable, by one micro-kernel.

use rayon::prelude::*;

use crate::simd::{InstructionSet, Simd, Task};

/// Pixels of a tile: the kernel's weights stay in the first-level cache while they serve one tile.
const TILE_PX: usize = 24;
/// Bands into which the rows of a deformable layer are divided; each has scratch of its own.
const BANDS: usize = 32;
const TAPS: usize = 9;
/// Input channels of a pair.
const PAIR: usize = 2;

/// A feature map [height, width, channels] with a border of one zero pixel.
///
/// Rows are widened to whole tiles, which kernels may overwrite and then clear again; channels are padded with zeros to
/// whole vectors.
pub(super) struct FeatureMap {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Channels of a pixel in memory.
    pub(super) stride: usize,
    row_len: usize,
    data: Vec<f32>,
}

impl FeatureMap {
    pub(super) fn new(width: usize, height: usize, channels: usize, set: InstructionSet) -> Self {
        let stride = channels.next_multiple_of(set.lanes());
        let row_len = (width.next_multiple_of(TILE_PX) + 2) * stride;
        Self { width, height, stride, row_len, data: vec![0.0; (height + 2) * row_len] }
    }

    /// The rows inside the border, each with its border pixels: pixel x begins at (x + 1)·stride.
    pub(super) fn rows_mut(&mut self) -> impl IndexedParallelIterator<Item = &mut [f32]> {
        self.data[self.row_len..].par_chunks_exact_mut(self.row_len).take(self.height)
    }

    /// One channel of row `y`.
    pub(super) fn channel(&self, channel: usize, y: usize) -> impl Iterator<Item = &f32> {
        let begin = (y + 1) * self.row_len + self.stride;
        self.data[begin..][..self.width * self.stride][channel..].iter().step_by(self.stride)
    }

    /// The channels of one pixel.
    pub(super) fn pixel(&self, x: usize, y: usize) -> &[f32] {
        &self.data[(y + 1) * self.row_len + (x + 1) * self.stride..][..self.stride]
    }
}

/// What is done with a sum before it is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Epilogue {
    /// sum
    None,
    /// leaky(sum)
    Leaky,
    /// leaky(½·sum + what the output map holds)
    ResidualLeaky,
}

/// A 3x3 convolution's parameters in the order in which the micro-kernel reads them: for each [`ChannelBlock`]
/// [tap, input channel, channel of the block], or, where it is paired, [tap, pair of input channels, channel of the
/// block, input channel of the pair].
pub(super) struct PackedConv {
    in_stride: usize,
    out_stride: usize,
    /// Input channels, rounded up to whole pairs; a map's stride may have more, all zero.
    inputs: usize,
    /// Output channels, rounded up to whole half vectors.
    outputs: usize,
    weights: Vec<f32>,
    /// What a block's sums begin with, from `block.first` on; a paired one, always the last, takes twice its channels:
    /// the bias of each, and a zero.
    bias: Vec<f32>,
    epilogue: Epilogue,
    leaky_slope: f32,
    set: InstructionSet,
}

impl PackedConv {
    /// Room for a convolution of `in_channels` to `out_channels`; all parameters are zero.
    pub(super) fn new(
        in_channels: usize,
        out_channels: usize,
        epilogue: Epilogue,
        leaky_slope: f32,
        set: InstructionSet,
    ) -> Self {
        let in_stride = in_channels.next_multiple_of(set.lanes());
        let out_stride = out_channels.next_multiple_of(set.lanes());
        let inputs = in_channels.next_multiple_of(PAIR);
        let outputs = out_channels.next_multiple_of(set.lanes() / PAIR);
        Self {
            in_stride,
            out_stride,
            inputs,
            outputs,
            weights: vec![0.0; TAPS * inputs * outputs],
            bias: vec![0.0; PAIR * outputs],
            epilogue,
            leaky_slope,
            set,
        }
    }

    /// Sets the parameters: `weight(output, input, tap)`, taps row-major over the kernel, and the bias of each output.
    pub(super) fn fill(
        &mut self,
        in_channels: usize,
        bias: impl ExactSizeIterator<Item = f32>,
        weight: impl Fn(usize, usize, usize) -> f32,
    ) {
        for (output, value) in bias.enumerate() {
            let block = ChannelBlock::of(output, self.outputs, self.set.lanes());
            let (together, channel) = (block.inputs_together, output - block.first);
            self.bias[block.first + channel * together] = value;
            let weights = &mut self.weights[block.first * TAPS * self.inputs..];
            for (tap, input) in (0..TAPS).flat_map(|tap| (0..in_channels).map(move |input| (tap, input))) {
                let row = tap * self.inputs + input;
                let place = (row - row % together) * block.channels + channel * together + row % together;
                weights[place] = weight(output, input, tap);
            }
        }
    }

    /// Runs the convolution over `input` into `output`.
    pub(super) fn run(&self, input: &FeatureMap, output: &mut FeatureMap) {
        debug_assert_eq!((input.stride, output.stride), (self.in_stride, self.out_stride));
        output.rows_mut().enumerate().for_each(|(y, output_row)| {
            let rows = &input.data[y * input.row_len..][..3 * input.row_len];
            self.set.run(PlainRow { conv: self, rows, row_len: input.row_len, width: input.width, output_row });
        });
    }

    /// Scratch for [`Self::run_deformable`].
    pub(super) fn deformable_scratch(&self) -> Vec<f32> {
        vec![0.0; BANDS * TILE_PX * TAPS * self.in_stride]
    }

    /// Runs the convolution over `input` into `output`, each tap k of each pixel being read at its place plus
    /// (`offsets[2k]`, `offsets[2k + 1]`) = (dy, dx) by bilinear interpolation, zero outside.
    pub(super) fn run_deformable(
        &self,
        input: &FeatureMap,
        offsets: &FeatureMap,
        scratch: &mut [f32],
        output: &mut FeatureMap,
    ) {
        debug_assert_eq!((input.stride, output.stride), (self.in_stride, self.out_stride));
        let rows_per_band = output.height.div_ceil(BANDS);
        let (row_len, height) = (output.row_len, output.height);
        output.data[row_len..][..height * row_len]
            .par_chunks_mut(rows_per_band * row_len)
            .zip(scratch.par_chunks_exact_mut(TILE_PX * TAPS * self.in_stride))
            .enumerate()
            .for_each(|(band, (rows, taps))| {
                for (row, output_row) in rows.chunks_exact_mut(row_len).enumerate() {
                    let y = band * rows_per_band + row;
                    self.set.run(DeformableRow { conv: self, input, offsets, y, taps, output_row });
                }
            });
    }
}

/// Output channels that are computed together: two vectors of them, or the rest, in half vectors.
///
/// An odd number of half vectors would leave lanes idle. There each output channel takes two neighbouring lanes, one for
/// the sum over even input channels and one for that over odd ones: 24 channels fill three vectors of 16 lanes, each step
/// takes two inputs, and `add_pairs` joins the two sums at the end. Only a layer's last block is such.
struct ChannelBlock {
    first: usize,
    channels: usize,
    /// [`PAIR`] or 1.
    inputs_together: usize,
}

impl ChannelBlock {
    /// The block in which an output channel falls.
    fn of(output: usize, outputs: usize, lanes: usize) -> Self {
        let first = output - output % (2 * lanes);
        let channels = (2 * lanes).min(outputs - first);
        Self { first, channels, inputs_together: if channels.is_multiple_of(lanes) { 1 } else { PAIR } }
    }
}

/// One row of a plain convolution.
struct PlainRow<'a> {
    conv: &'a PackedConv,
    /// Three rows of the input with their borders.
    rows: &'a [f32],
    row_len: usize,
    width: usize,
    output_row: &'a mut [f32],
}

impl Task for PlainRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { conv, rows, row_len, width, output_row } = self;
        for x in (0..width).step_by(TILE_PX) {
            let source =
                Source { values: &rows[x * conv.in_stride..], row_stride: row_len, pixel_stride: conv.in_stride };
            tile(simd, conv, source, &mut output_row[(x + 1) * conv.out_stride..], (width - x).min(TILE_PX));
        }
        output_row[(width + 1) * conv.out_stride..].fill(0.0);
    }
}

/// One row of a deformable convolution.
struct DeformableRow<'a> {
    conv: &'a PackedConv,
    input: &'a FeatureMap,
    offsets: &'a FeatureMap,
    y: usize,
    /// [pixel of the tile, tap, channel]
    taps: &'a mut [f32],
    output_row: &'a mut [f32],
}

impl Task for DeformableRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { conv, input, offsets, y, taps, output_row } = self;
        let pixel_len = TAPS * conv.in_stride;
        for x in (0..input.width).step_by(TILE_PX) {
            let pixels = (input.width - x).min(TILE_PX);
            for (index, taps) in taps.chunks_exact_mut(pixel_len).take(pixels).enumerate() {
                let offsets = offsets.pixel(x + index, y);
                for (k, tap) in taps.chunks_exact_mut(conv.in_stride).enumerate() {
                    let tap_y = (y + k / 3) as f32 - 1.0 + offsets[2 * k];
                    let tap_x = (x + index + k % 3) as f32 - 1.0 + offsets[2 * k + 1];
                    sample(simd, input, tap_x, tap_y, tap);
                }
            }
            let source = Source { values: taps, row_stride: 3 * conv.in_stride, pixel_stride: pixel_len };
            tile(simd, conv, source, &mut output_row[(x + 1) * conv.out_stride..], pixels);
        }
        output_row[(input.width + 1) * conv.out_stride..].fill(0.0);
    }
}

/// Reads `map` at (x, y) by bilinear interpolation into `channels`, zero outside.
#[inline(always)]
fn sample<S: Simd>(simd: S, map: &FeatureMap, x: f32, y: f32, channels: &mut [f32]) {
    let (width, height) = (map.width as f32, map.height as f32);
    // NaN is outside too.
    if !(x > -1.0 && x < width && y > -1.0 && y < height) {
        channels.fill(0.0);
        return;
    }
    let (left, top) = (x.floor(), y.floor());
    let (right_share, lower_share) = (x - left, y - top);
    // The border makes all four neighbours readable: left + 1 is in 0..=width.
    let begin = (top + 1.0) as usize * map.row_len + (left + 1.0) as usize * map.stride;
    let upper = &map.data[begin..][..2 * map.stride];
    let lower = &map.data[begin + map.row_len..][..2 * map.stride];
    let share = |value: f32| simd.splat(value);
    let shares = [
        share((1.0 - lower_share) * (1.0 - right_share)),
        share((1.0 - lower_share) * right_share),
        share(lower_share * (1.0 - right_share)),
        share(lower_share * right_share),
    ];
    assert!(channels.len() == map.stride && map.stride.is_multiple_of(S::LANES));
    for channel in (0..map.stride).step_by(S::LANES) {
        // SAFETY: channel + LANES ≤ stride; `upper` and `lower` hold two strides and `channels` one.
        unsafe {
            let upper = upper.as_ptr().add(channel);
            let lower = lower.as_ptr().add(channel);
            let mut sum = simd.mul(shares[0], simd.load(upper));
            sum = simd.mul_add(shares[1], simd.load(upper.add(map.stride)), sum);
            sum = simd.mul_add(shares[2], simd.load(lower), sum);
            sum = simd.mul_add(shares[3], simd.load(lower.add(map.stride)), sum);
            simd.store(channels.as_mut_ptr().add(channel), sum);
        }
    }
}

/// Where the kernel's input lies: the channels of tap k of pixel p begin at
/// p·pixel_stride + (k / 3)·row_stride + (k % 3)·in_stride.
#[derive(Clone, Copy)]
struct Source<'a> {
    values: &'a [f32],
    row_stride: usize,
    pixel_stride: usize,
}

/// Computes all output channels of the first `pixels` pixels of a tile, and possibly of some after them.
#[inline(always)]
fn tile<S: Simd>(simd: S, conv: &PackedConv, source: Source<'_>, output: &mut [f32], pixels: usize) {
    for first in (0..conv.outputs).step_by(2 * S::LANES) {
        let block = ChannelBlock::of(first, conv.outputs, S::LANES);
        let output = &mut output[first..];
        // Sums, weights and one input fit the registers: 16, or 32 with 16 lanes. All counts divide TILE_PX.
        match (block.channels * block.inputs_together / S::LANES, block.inputs_together, S::LANES) {
            (2, 1, 16) => strip::<S, 2, 1, 12>(simd, conv, source, &block, output, pixels),
            (2, 1, _) => strip::<S, 2, 1, 6>(simd, conv, source, &block, output, pixels),
            (_, 1, 16) => strip::<S, 1, 1, 24>(simd, conv, source, &block, output, pixels),
            (_, 1, _) => strip::<S, 1, 1, 12>(simd, conv, source, &block, output, pixels),
            (3, _, 16) => strip::<S, 3, PAIR, 8>(simd, conv, source, &block, output, pixels),
            (3, _, _) => strip::<S, 3, PAIR, 4>(simd, conv, source, &block, output, pixels),
            (_, _, 16) => strip::<S, 1, PAIR, 24>(simd, conv, source, &block, output, pixels),
            (_, _, _) => strip::<S, 1, PAIR, 12>(simd, conv, source, &block, output, pixels),
        }
    }
}

/// One block of V vectors of sums, of I input channels together, over a tile, P pixels at a time.
#[inline(always)]
fn strip<S: Simd, const V: usize, const I: usize, const P: usize>(
    simd: S,
    conv: &PackedConv,
    source: Source<'_>,
    block: &ChannelBlock,
    output: &mut [f32],
    pixels: usize,
) {
    let weights = &conv.weights[block.first * TAPS * conv.inputs..][..block.channels * TAPS * conv.inputs];
    let bias = &conv.bias[block.first..][..V * S::LANES];
    for x in (0..pixels).step_by(P) {
        let source = Source { values: &source.values[x * source.pixel_stride..], ..source };
        micro_kernel::<S, V, I, P>(simd, conv, source, weights, bias, &mut output[x * conv.out_stride..]);
    }
}

/// V·LANES / I output channels of P pixels: the sum over all packed weights, then the epilogue.
#[inline(always)]
fn micro_kernel<S: Simd, const V: usize, const I: usize, const P: usize>(
    simd: S,
    conv: &PackedConv,
    source: Source<'_>,
    weights: &[f32],
    bias: &[f32],
    output: &mut [f32],
) {
    let row_len = V * S::LANES;
    assert!(
        conv.inputs.is_multiple_of(I) && weights.len() * I == TAPS * conv.inputs * row_len && bias.len() == row_len
    );
    let reach = (P - 1) * source.pixel_stride + 2 * source.row_stride + 2 * conv.in_stride + conv.inputs;
    let written = (P - 1) * conv.out_stride + V.div_ceil(I) * S::LANES;
    assert!(source.values.len() >= reach && output.len() >= written);

    // Bounds checks in this loop would cost more than its arithmetic.
    // SAFETY: whole vectors are loaded below `bias.len()` and `weights.len()` (its rows are walked once, in order), and
    // loaded and stored below `written`. Inputs are read below `reach`: `inputs` is a multiple of I, so that no pair
    // reaches beyond it. All was asserted above.
    unsafe {
        let mut sums: [[S::Vector; V]; P] =
            [std::array::from_fn(|vector| simd.load(bias.as_ptr().add(vector * S::LANES))); P];
        let mut weight_row = weights.as_ptr();
        for tap in 0..TAPS {
            let begin = source.values.as_ptr().add(tap / 3 * source.row_stride + tap % 3 * conv.in_stride);
            for index in (0..conv.inputs).step_by(I) {
                let weights: [S::Vector; V] =
                    std::array::from_fn(|vector| simd.load(weight_row.add(vector * S::LANES)));
                weight_row = weight_row.add(row_len);
                for (pixel, sums) in sums.iter_mut().enumerate() {
                    let input = begin.add(pixel * source.pixel_stride + index);
                    let value = if I == PAIR { simd.splat_pair(input) } else { simd.splat(*input) };
                    for (sum, weight) in sums.iter_mut().zip(weights) {
                        *sum = simd.mul_add(value, weight, *sum);
                    }
                }
            }
        }
        let (half, slope) = (simd.splat(0.5), simd.splat(conv.leaky_slope));
        for (pixel, sums) in sums.into_iter().enumerate() {
            for (vector, sums) in sums.chunks(I).enumerate() {
                let mut sum = match *sums {
                    [sum] if I == 1 => sum,
                    [sum] => simd.add_pairs(sum, simd.splat(0.0)),
                    [first, second, ..] => simd.add_pairs(first, second),
                    [] => unreachable!("chunks are not empty"),
                };
                let place = output.as_mut_ptr().add(pixel * conv.out_stride + vector * S::LANES);
                if conv.epilogue == Epilogue::ResidualLeaky {
                    sum = simd.mul_add(half, sum, simd.load(place));
                }
                if conv.epilogue != Epilogue::None {
                    sum = simd.max(sum, simd.mul(sum, slope));
                }
                simd.store(place, sum);
            }
        }
    }
}
