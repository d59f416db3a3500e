//! Deformable 3x3 convolutions: every tap of every pixel is read at a place of its own.

use super::conv::{Activation, Epilogue, PlainConv, TAPS, WorkerScratch};
use super::feature_map::{FeatureMap, TILE};
use super::product::{ROWS, Shape, integers_scale, panel_place, panels_len};
use super::workers::WORKERS;
use crate::simd::{Products, Simd, Task};
use crate::weights::OFFSET_CHANNELS;

/// A deformable convolution of maps, and the plain one that predicts where it reads.
pub(super) struct DeformableConv {
    /// To [`OFFSET_CHANNELS`]: of each tap dy and dx.
    pub(super) offset_conv: PlainConv,
    in_stride: usize,
    out_stride: usize,
    /// A group for each tap.
    shape: Shape,
    weights: Vec<f32>,
    activation: Activation,
    products: Products,
    workers: Vec<Scratch>,
}

/// What one worker makes of a row of tiles, [`ROWS`] pixels at a time.
struct Scratch {
    offset_conv: WorkerScratch,
    /// Rows of offsets with their borders.
    offsets: Vec<f32>,
    /// The panels of what the pixels read at each tap, and those of their sums.
    taps: Vec<f32>,
    sums: Vec<f32>,
    /// What a pixel reads at each tap [tap, channel], before it is integers.
    values: Vec<f32>,
}

impl DeformableConv {
    /// For maps of `width`: `weight(output, input, tap)`, taps row-major over the kernel, and the bias of each output.
    /// All parameters of the prediction are zero.
    pub(super) fn new(
        in_channels: usize,
        width: usize,
        bias: &[f32],
        weight: impl Fn(usize, usize, usize) -> f32,
        epilogue: Epilogue,
        leaky_slope: f32,
        products: Products,
    ) -> Self {
        let shape = Shape::new(TAPS, in_channels, bias.len(), products);
        let mut weights = vec![0.0; shape.weights_len()];
        let lanes = products.set().lanes();
        let out_stride = bias.len().next_multiple_of(lanes);
        let mut activation = Activation::new(out_stride, epilogue, leaky_slope);
        activation.bias[..bias.len()].copy_from_slice(bias);
        for output in 0..bias.len() {
            let inputs = || (0..TAPS).flat_map(|tap| (0..in_channels).map(move |input| (tap, input)));
            let magnitudes = || inputs().map(|(tap, input)| weight(output, input, tap).abs());
            let scale = shape.weights_scale(magnitudes().fold(0.0, f32::max), magnitudes().sum());
            activation.scale[output] = 1.0 / scale;
            for (tap, input) in inputs() {
                shape.set_weight(&mut weights, [tap, input, output], scale * weight(output, input, tap));
            }
        }
        let offset_conv = PlainConv::new(in_channels, OFFSET_CHANNELS, Epilogue::None, leaky_slope, products);
        let in_stride = in_channels.next_multiple_of(lanes);
        Self {
            in_stride,
            out_stride,
            shape,
            weights,
            activation,
            products,
            workers: (0..WORKERS).map(|_| Scratch::new(shape, &offset_conv, width, in_stride)).collect(),
            offset_conv,
        }
    }

    /// Runs the convolution over `input` into `output`, each tap k of each pixel being read at its place plus its
    /// offset by bilinear interpolation, zero outside.
    pub(super) fn run(&mut self, input: &FeatureMap, output: &mut FeatureMap) {
        let Self { offset_conv, in_stride, out_stride, shape, weights, activation, products, workers } = self;
        debug_assert_eq!((input.stride, output.stride), (*in_stride, *out_stride));
        let row_len = output.row_len;
        output.for_each_tile_row(workers, |scratch, first, rows| {
            let Scratch { offset_conv: offset_scratch, offsets, taps, sums, values } = scratch;
            let (offsets_stride, offsets_row_len) = (offset_conv.out_stride(), offsets.len() / TILE);
            let offsets = &mut offsets[..rows.len() / row_len * offsets_row_len];
            offset_conv.run_tile_row(input, first, offset_scratch, offsets, offsets_row_len);
            let rows = rows.chunks_exact_mut(row_len).zip(offsets.chunks_exact(offsets_row_len));
            for (y, (output_row, offsets)) in (first..).zip(rows) {
                let offsets = &offsets[offsets_stride..];
                let shape = *shape;
                products.run(Row {
                    shape,
                    weights,
                    activation,
                    input,
                    offsets,
                    offsets_stride,
                    y,
                    taps,
                    sums,
                    values,
                    output_row,
                });
            }
        });
    }
}

impl Scratch {
    fn new(shape: Shape, offset_conv: &PlainConv, width: usize, in_stride: usize) -> Self {
        let mut scratch = WorkerScratch::default();
        scratch.fit(offset_conv);
        Self {
            offset_conv: scratch,
            offsets: vec![0.0; TILE * (width + 2) * offset_conv.out_stride()],
            taps: vec![0.0; shape.inputs_len()],
            sums: vec![0.0; shape.outputs_len()],
            values: vec![0.0; TAPS * in_stride],
        }
    }
}

/// One row.
struct Row<'a> {
    shape: Shape,
    weights: &'a [f32],
    activation: &'a Activation,
    input: &'a FeatureMap,
    /// Of each pixel, with what else its vectors hold.
    offsets: &'a [f32],
    offsets_stride: usize,
    y: usize,
    taps: &'a mut [f32],
    sums: &'a mut [f32],
    values: &'a mut [f32],
    /// With its border.
    output_row: &'a mut [f32],
}

impl Task for Row<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { shape, weights, activation, input, offsets, offsets_stride, y, taps, sums, values, output_row } =
            self;
        let out_stride = activation.bias.len();
        let group_len = shape.inputs_len() / TAPS;
        assert!(group_len * S::FACTORS >= panels_len(input.stride) && out_stride.is_multiple_of(S::LANES));
        assert!(values.len() == TAPS * input.stride);
        for x in (0..input.width).step_by(ROWS) {
            let pixels = (input.width - x).min(ROWS);
            // What each pixel's sums are multiplied by where they are of integers.
            let mut scales = [1.0; ROWS];
            for (index, x) in (x..x + pixels).enumerate() {
                let offsets = &offsets[x * offsets_stride..][..OFFSET_CHANNELS];
                let both = taps.chunks_exact_mut(group_len).zip(values.chunks_exact_mut(input.stride));
                for (k, (panels, values)) in both.enumerate() {
                    let tap_y = (y + k / 3) as f32 - 1.0 + offsets[2 * k];
                    let tap_x = (x + k % 3) as f32 - 1.0 + offsets[2 * k + 1];
                    sample(simd, input, tap_x, tap_y, index, panels, values);
                }
                if S::INTEGERS {
                    scales[index] = store_integers(simd, shape, values, index, taps);
                }
            }
            shape.multiply(simd, pixels, taps, weights, sums);
            for (index, output) in
                output_row[(x + 1) * out_stride..].chunks_exact_mut(out_stride).take(pixels).enumerate()
            {
                for channel in (0..out_stride).step_by(S::LANES) {
                    let sum = simd.read(&sums[panel_place(index, channel)..]);
                    let scale_and_bias = activation.of_channels(simd, channel, scales[index]);
                    let place = &mut output[channel..][..S::LANES];
                    // SAFETY: the slice has LANES values.
                    unsafe { activation.store(simd, sum, scale_and_bias, place.as_mut_ptr()) };
                }
            }
        }
    }
}

/// Reads `map` at (x, y) by bilinear interpolation, zero outside, into `row` of panels, or into `values` where factors
/// are integers, whose scale is not known yet.
#[inline(always)]
fn sample<S: Simd>(simd: S, map: &FeatureMap, x: f32, y: f32, row: usize, panels: &mut [f32], values: &mut [f32]) {
    let (width, height) = (map.width as f32, map.height as f32);
    assert!(panels.len() * S::FACTORS >= panels_len(map.stride) && row < ROWS && map.stride.is_multiple_of(S::LANES));
    assert!(values.len() == map.stride);
    // NaN is outside too.
    if !(x > -1.0 && x < width && y > -1.0 && y < height) {
        values.fill(0.0);
        for channel in (0..map.stride).step_by(S::LANES) {
            panels[panel_place(row, channel) / S::FACTORS..][..S::LANES / S::FACTORS].fill(0.0);
        }
        return;
    }
    let (left, top) = (x.floor(), y.floor());
    let (right_share, lower_share) = (x - left, y - top);
    // The border makes all four neighbours readable: left + 1 is in 0..=width.
    let rows = &map.rows_from_above((top + 1.0) as usize)[(left + 1.0) as usize * map.stride..];
    let (upper, lower) = (&rows[..2 * map.stride], &rows[map.row_len..][..2 * map.stride]);
    let share = |value: f32| simd.splat(value);
    let shares = [
        share((1.0 - lower_share) * (1.0 - right_share)),
        share((1.0 - lower_share) * right_share),
        share(lower_share * (1.0 - right_share)),
        share(lower_share * right_share),
    ];
    for channel in (0..map.stride).step_by(S::LANES) {
        // SAFETY: channel + LANES ≤ stride; `upper` and `lower` hold two strides, the panels a row of one and `values`
        // one.
        unsafe {
            let upper = upper.as_ptr().add(channel);
            let lower = lower.as_ptr().add(channel);
            let mut sum = simd.mul(shares[0], simd.load(upper));
            sum = simd.mul_add(shares[1], simd.load(upper.add(map.stride)), sum);
            sum = simd.mul_add(shares[2], simd.load(lower), sum);
            sum = simd.mul_add(shares[3], simd.load(lower.add(map.stride)), sum);
            if S::INTEGERS {
                simd.store(values.as_mut_ptr().add(channel), sum);
            } else {
                simd.store_factors(panels.as_mut_ptr().add(panel_place(row, channel) / S::FACTORS), sum);
            }
        }
    }
}

/// Writes a pixel's values [tap, channel] as integers to `row` of the panels of each tap, and returns what its sums are
/// multiplied by.
#[inline(always)]
fn store_integers<S: Simd>(simd: S, shape: Shape, values: &[f32], row: usize, taps: &mut [f32]) -> f32 {
    let (stride, group_len) = (values.len() / TAPS, taps.len() / TAPS);
    assert!(stride.is_multiple_of(S::LANES) && group_len * S::FACTORS >= panels_len(stride) && row < ROWS);
    let [scale, sums_scale] = integers_scale(simd, values, shape.largest_input());
    let scale = simd.splat(scale);
    for (values, panels) in values.chunks_exact(stride).zip(taps.chunks_exact_mut(group_len)) {
        for (channel, vector) in (0..stride).step_by(S::LANES).zip(values.chunks_exact(S::LANES)) {
            let value = simd.mul(simd.read(vector), scale);
            // SAFETY: each group of `taps` holds a row of `stride` channels.
            unsafe { simd.store_factors(panels.as_mut_ptr().add(panel_place(row, channel) / S::FACTORS), value) };
        }
    }
    sums_scale
}
