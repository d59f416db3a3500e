//! Deformable 3x3 convolutions: every tap of every pixel is read at a place of its own.

use super::conv::{Activation, Epilogue, PlainConv, TAPS, WorkerScratch};
use super::feature_map::{FeatureMap, TILE};
use super::product::{PANEL, ROWS, Shape, integers_scale, panel_place, panels_len};
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

/// What one worker makes of a row of tiles.
struct Scratch {
    offset_conv: WorkerScratch,
    /// Rows of offsets with their borders.
    offsets: Vec<f32>,
    pixels: Pixels,
}

/// What it makes of [`ROWS`] pixels at a time.
struct Pixels {
    /// Where each of the pixels reads, at every tap.
    places: Vec<Places>,
    /// The panels of what they read at each tap, and those of their sums.
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
            let Scratch { offset_conv: offset_scratch, offsets, pixels } = scratch;
            let (offsets_stride, offsets_row_len) = (offset_conv.out_stride(), offsets.len() / TILE);
            let offsets = &mut offsets[..rows.len() / row_len * offsets_row_len];
            offset_conv.run_tile_row(input, first, offset_scratch, offsets, offsets_row_len);
            let rows = rows.chunks_exact_mut(row_len).zip(offsets.chunks_exact(offsets_row_len));
            for (y, (output_row, offsets)) in (first..).zip(rows) {
                let offsets = &offsets[offsets_stride..];
                let shape = *shape;
                products.run(Row { shape, weights, activation, input, offsets, offsets_stride, y, pixels, output_row });
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
            pixels: Pixels {
                places: vec![Places::default(); ROWS],
                taps: vec![0.0; shape.inputs_len()],
                sums: vec![0.0; shape.outputs_len()],
                values: vec![0.0; TAPS * in_stride],
            },
        }
    }
}

/// One row of the output map, of all its channels.
struct Row<'a> {
    shape: Shape,
    weights: &'a [f32],
    activation: &'a Activation,
    input: &'a FeatureMap,
    /// Of each pixel, with what else its vectors hold.
    offsets: &'a [f32],
    offsets_stride: usize,
    y: usize,
    pixels: &'a mut Pixels,
    /// The row of the output map, with the border at its ends.
    output_row: &'a mut [f32],
}

impl Task for Row<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { shape, weights, activation, input, offsets, offsets_stride, y, pixels, output_row } = self;
        let Pixels { places, taps, sums, values } = pixels;
        let out_stride = activation.bias.len();
        assert!(out_stride.is_multiple_of(S::LANES));
        for x in (0..input.width).step_by(ROWS) {
            let pixels = (input.width - x).min(ROWS);
            // What each pixel's sums are multiplied by where they are of integers.
            let mut scales = [1.0; ROWS];
            let offsets = offsets[x * offsets_stride..].chunks_exact(offsets_stride).take(pixels);
            for ((x, offsets), places) in (x..).zip(offsets).zip(places.iter_mut()) {
                places.set(simd, input, [x, y], offsets);
            }
            for (index, places) in places.iter().enumerate().take(pixels) {
                let magnitudes = sample(simd, input, places, index, taps, values);
                if S::INTEGERS {
                    let [scale, sums_scale] = integers_scale(simd, magnitudes, shape.largest_input());
                    scales[index] = sums_scale;
                    store_integers(simd, scale, values, index, taps);
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

/// Where the taps of a pixel are read: each between four pixels of a map, counted with its border.
#[derive(Clone, Default)]
struct Places {
    /// Row and column of the upper left one.
    corners: [[u32; MOST_TAPS]; 2],
    /// What the upper left one, the upper right one and the lower ones are worth.
    shares: [[f32; MOST_TAPS]; 4],
}

/// [`TAPS`] in whole vectors of any length.
const MOST_TAPS: usize = TAPS.next_power_of_two();
/// Where the kernel has its taps, from the pixel on.
const ROW_OF: [f32; MOST_TAPS] = [-1.0, -1.0, -1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
const COLUMN_OF: [f32; MOST_TAPS] = [-1.0, 0.0, 1.0, -1.0, 0.0, 1.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];

impl Places {
    /// Those of pixel (x, y), given dy and dx of each tap in whole vectors.
    #[inline(always)]
    fn set<S: Simd>(&mut self, simd: S, map: &FeatureMap, [x, y]: [usize; 2], offsets: &[f32]) {
        let (width, height) = (map.width as f32, map.height as f32);
        // Four pixels of the border: the last one of the row above the first one, the first one of the next row, and
        // those below.
        let outside = [0, (map.row_len / map.stride - 1) as u32];
        let mut offsets_of = [[0.0; MOST_TAPS]; 2];
        for first in (0..MOST_TAPS).step_by(S::LANES) {
            let vector = |at: usize| if at < offsets.len() { simd.read(&offsets[at..]) } else { simd.splat(f32::NAN) };
            let [y, x] = simd.unzip(vector(2 * first), vector(2 * first + S::LANES));
            simd.write(&mut offsets_of[0][first..], y);
            simd.write(&mut offsets_of[1][first..], x);
        }
        let Self { corners, shares } = self;
        for k in 0..MOST_TAPS {
            let y = y as f32 + ROW_OF[k] + offsets_of[0][k];
            let x = x as f32 + COLUMN_OF[k] + offsets_of[1][k];
            // NaN is outside too.
            let inside = (x > -1.0) & (x < width) & (y > -1.0) & (y < height);
            let (top, left) = (if inside { y.floor() } else { 0.0 }, if inside { x.floor() } else { 0.0 });
            let (lower, right) = (if inside { y - top } else { 0.0 }, if inside { x - left } else { 0.0 });
            // SAFETY: both are whole numbers from −1 to the side of a map.
            let corner = unsafe { [top, left].map(|place| (place.to_int_unchecked::<i32>() + 1) as u32) };
            for (corners, (corner, outside)) in corners.iter_mut().zip(corner.into_iter().zip(outside)) {
                corners[k] = if inside { corner } else { outside };
            }
            shares[0][k] = (1.0 - lower) * (1.0 - right);
            shares[1][k] = (1.0 - lower) * right;
            shares[2][k] = lower * (1.0 - right);
            shares[3][k] = lower * right;
        }
    }
}

/// Reads `map` at the places of each tap by bilinear interpolation, zero outside, into `row` of the panels of that tap,
/// or into `values` [tap, channel] where factors are integers, whose scale is not known yet: returns in each lane the
/// largest magnitude then.
#[inline(always)]
fn sample<S: Simd>(
    simd: S,
    map: &FeatureMap,
    places: &Places,
    row: usize,
    taps: &mut [f32],
    values: &mut [f32],
) -> S::Vector {
    let FeatureMap { stride, row_len, .. } = *map;
    let Places { corners, shares } = places;
    let (pixels, group_len) = (map.rows_from_above(0), taps.len() / TAPS);
    assert!(group_len * S::FACTORS >= panels_len(stride) && row < ROWS && stride.is_multiple_of(S::LANES));
    assert!(values.len() == TAPS * stride);
    let mut magnitudes = simd.splat(0.0);
    let both = taps.chunks_exact_mut(group_len).zip(values.chunks_exact_mut(stride));
    for (k, (panels, values)) in both.enumerate() {
        let upper = corners[0][k] as usize * row_len + corners[1][k] as usize * stride;
        assert!(upper + row_len + 2 * stride <= pixels.len());
        let shares = [shares[0][k], shares[1][k], shares[2][k], shares[3][k]];
        for channel in (0..stride).step_by(S::LANES) {
            // SAFETY: channel + LANES ≤ stride; two pixels lie in `pixels` at `upper` and a row after it, as
            // asserted above, the panels hold a row of so many and `values` one.
            unsafe {
                let upper = pixels.as_ptr().add(upper + channel);
                let lower = upper.add(row_len);
                let mut sum = simd.mul(simd.splat(shares[0]), simd.load(upper));
                sum = simd.mul_add(simd.splat(shares[1]), simd.load(upper.add(stride)), sum);
                sum = simd.mul_add(simd.splat(shares[2]), simd.load(lower), sum);
                sum = simd.mul_add(simd.splat(shares[3]), simd.load(lower.add(stride)), sum);
                if S::INTEGERS {
                    magnitudes = simd.larger_magnitude(magnitudes, sum);
                    simd.store(values.as_mut_ptr().add(channel), sum);
                } else {
                    simd.store_factors(panels.as_mut_ptr().add(panel_place(row, channel) / S::FACTORS), sum);
                }
            }
        }
    }
    magnitudes
}

/// Writes a pixel's values [tap, channel], times `scale`, as integers to `row` of the panels of each tap.
#[inline(always)]
fn store_integers<S: Simd>(simd: S, scale: f32, values: &[f32], row: usize, taps: &mut [f32]) {
    let (stride, group_len) = (values.len() / TAPS, taps.len() / TAPS);
    assert!(stride.is_multiple_of(S::LANES) && group_len * S::FACTORS >= panels_len(stride) && row < ROWS);
    let scale = simd.splat(scale);
    for (values, panels) in values.chunks_exact(stride).zip(taps.chunks_exact_mut(group_len)) {
        for (number, values) in values.chunks(PANEL).enumerate() {
            let place = panel_place(row, number * PANEL) / S::FACTORS;
            for (vector, values) in values.chunks_exact(S::LANES).enumerate() {
                let value = simd.mul(simd.read(values), scale);
                // SAFETY: each group of `taps` holds a row of `stride` channels, those of a panel beside one another.
                unsafe { simd.store_factors(panels.as_mut_ptr().add(place + vector * S::LANES / S::FACTORS), value) };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;

    #[test]
    fn taps_far_outside_and_those_that_are_no_number_read_zero() {
        const CHANNELS: usize = 3;
        const BIAS: f32 = 0.75;
        for products in Products::available() {
            // What every sample of a map is, and every offset. No column of the border is one too many.
            let first_output = |sample: f32, offset: f32| {
                let mut map = FeatureMap::new(8, 5, CHANNELS, products.set());
                let (stride, width) = (map.stride, map.width);
                map.rows_mut().for_each(|row| {
                    row[stride..][..width * stride]
                        .chunks_exact_mut(stride)
                        .for_each(|pixel| pixel[..CHANNELS].fill(sample));
                });
                let mut output = FeatureMap::new(8, 5, 1, products.set());
                let weight = |_, _, _| 1.0;
                let mut conv = DeformableConv::new(CHANNELS, 8, &[BIAS], weight, Epilogue::None, 0.1, products);
                conv.offset_conv.fill(&[0, 1, 2], [offset; OFFSET_CHANNELS].into_iter(), |_, _, _| 0.0);
                conv.run(&map, &mut output);
                (0..5).flat_map(|y| (0..8).map(move |x| (x, y))).map(|(x, y)| output.pixel(x, y)[0]).collect::<Vec<_>>()
            };
            for (sample, offset) in [(1.0, 7.0), (1.0, -7.5), (1.0, 1e30), (1.0, f32::NEG_INFINITY), (f32::NAN, 0.0)] {
                let found = first_output(sample, offset);
                assert_eq!(found, [BIAS; 8 * 5], "{} of {sample} at {offset}", products.name());
            }
            assert_ne!(first_output(1.0, 0.5)[0], BIAS, "the comparison is blind");
        }
    }
}
