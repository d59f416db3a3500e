//! Plain 3x3 convolutions, by Winograd's minimal filtering: F(4x4, 3x3) takes 36 multiplications where the sum over
//! taps takes 144.
//!
//! Six input values of a row or column become six points, the input polynomial's remainders at 0, ±⅝, ±1½ and ∞;
//! products with the weights' points are summed over channels; and four outputs come back of six sums. With these
//! points, of which all factors are exact, the error is 1.7 times that of the sum over taps; with the usual 0, ±1, ±2
//! and ∞ it is 4 times.

use super::feature_map::{FeatureMap, TILE};
use super::product::{ROWS, Shape, integers_scale, panel_place, panels_len};
use super::workers::WORKERS;
use crate::simd::{MOST_LANES, Products, Simd, Task};

pub(super) const TAPS: usize = 9;
/// Inputs of a tile each way, and points.
const POINTS: usize = TILE + 2;
/// The finite points are 0, ±NEAR and ±FAR.
const NEAR: f32 = 0.625;
const FAR: f32 = 1.5;
/// No input's magnitude grows by more on its way to a point; the near ones have it.
const POINTS_GAIN: f32 = (1.0 + FAR * FAR) * (1.0 + NEAR);
/// Between the rows of a buffer, so that they do not fall on the same lines of a cache.
const ROW_PAD: usize = 16;

/// What is done with a sum before it is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Epilogue {
    /// The sum as it is.
    None,
    /// leaky(sum), with the network's slope
    Leaky,
    /// leaky(½·sum + what the output map holds)
    ResidualLeaky,
}

/// What a layer does with its sums: the bias of each channel of the output map, and the epilogue.
pub(super) struct Activation {
    /// What a channel's sums are multiplied by where its weights are integers: their scale's reciprocal.
    pub(super) scale: Vec<f32>,
    pub(super) bias: Vec<f32>,
    pub(super) epilogue: Epilogue,
    pub(super) leaky_slope: f32,
}

impl Activation {
    /// For `channels` channels, in whole vectors; all biases are zero.
    pub(super) fn new(channels: usize, epilogue: Epilogue, leaky_slope: f32) -> Self {
        Self { scale: vec![1.0; channels], bias: vec![0.0; channels], epilogue, leaky_slope }
    }

    /// The scale and the bias of a vector of channels from `channel` on, whose inputs' scale has the reciprocal `scale`.
    #[inline(always)]
    pub(super) fn of_channels<S: Simd>(&self, simd: S, channel: usize, scale: f32) -> [S::Vector; 2] {
        let bias = simd.read(&self.bias[channel..]);
        let scale = simd.splat(scale);
        [if S::INTEGERS { simd.mul(simd.read(&self.scale[channel..]), scale) } else { scale }, bias]
    }

    /// Turns a vector of sums, whose scale and bias are given, into what is stored at `place`.
    ///
    /// # Safety
    /// A vector can be loaded from `place` and stored there.
    #[inline(always)]
    pub(super) unsafe fn store<S: Simd>(
        &self,
        simd: S,
        sum: S::Vector,
        [scale, bias]: [S::Vector; 2],
        place: *mut f32,
    ) {
        let mut sum = if S::INTEGERS { simd.mul_add(sum, scale, bias) } else { simd.add(sum, bias) };
        // SAFETY: the caller's promise.
        unsafe {
            if self.epilogue == Epilogue::ResidualLeaky {
                sum = simd.mul_add(simd.splat(0.5), sum, simd.load(place));
            }
            if self.epilogue != Epilogue::None {
                sum = simd.max(sum, simd.mul(sum, simd.splat(self.leaky_slope)));
            }
            simd.store(place, sum);
        }
    }
}

/// A plain convolution of maps.
pub(super) struct PlainConv {
    /// Channels of each pixel that are read, in whole vectors.
    in_channels: usize,
    out_stride: usize,
    shape: Shape,
    /// For each point, rows first, a packed product of `shape`.
    weights: Vec<f32>,
    activation: Activation,
    products: Products,
}

impl PlainConv {
    /// Room for a convolution of the first `in_channels` of a map to `out_channels`; all parameters are zero. What fills
    /// the last vector of those channels has to be numbers.
    pub(super) fn new(
        in_channels: usize,
        out_channels: usize,
        epilogue: Epilogue,
        leaky_slope: f32,
        products: Products,
    ) -> Self {
        let shape = Shape::new(1, in_channels, out_channels, products);
        let lanes = products.set().lanes();
        let out_stride = out_channels.next_multiple_of(lanes);
        Self {
            in_channels: in_channels.next_multiple_of(lanes),
            out_stride,
            shape,
            weights: vec![0.0; POINTS * POINTS * shape.weights_len()],
            activation: Activation::new(out_stride, epilogue, leaky_slope),
            products,
        }
    }

    /// Sets the parameters: `weight(output, input, tap)`, taps row-major over the kernel, and the bias of each output.
    /// `inputs` are the channels of the map that the inputs are.
    pub(super) fn fill(
        &mut self,
        inputs: &[usize],
        bias: impl ExactSizeIterator<Item = f32>,
        weight: impl Fn(usize, usize, usize) -> f32,
    ) {
        for (output, value) in bias.enumerate() {
            let points_of = |input| weight_points(|tap| weight(output, input, tap));
            let scale =
                if self.products.integers() { self.weights_scale((0..inputs.len()).map(points_of)) } else { 1.0 };
            self.activation.scale[output] = 1.0 / scale;
            self.activation.bias[output] = value;
            for (input, channel) in inputs.iter().enumerate() {
                let weights = self.weights.chunks_exact_mut(self.shape.weights_len());
                for (weights, value) in weights.zip(points_of(input).as_flattened()) {
                    self.shape.set_weight(weights, [0, *channel, output], scale * *value as f32);
                }
            }
        }
    }

    /// What the weights of an output are multiplied by, given those of each input at the points.
    fn weights_scale(&self, points: impl Iterator<Item = [[f64; POINTS]; POINTS]>) -> f32 {
        let (mut largest, mut together) = (0.0_f64, [0.0; POINTS * POINTS]);
        for points in points {
            for (together, value) in together.iter_mut().zip(points.as_flattened()) {
                largest = largest.max(value.abs());
                *together += value.abs();
            }
        }
        self.shape.weights_scale(largest as f32, together.into_iter().fold(0.0, f64::max) as f32)
    }

    /// Runs the convolution over `input` into `output`.
    pub(super) fn run(&self, input: &FeatureMap, scratch: &mut Scratch, output: &mut FeatureMap) {
        debug_assert!(input.stride >= self.in_channels && output.stride == self.out_stride);
        let out_row_len = output.row_len;
        output.for_each_tile_row(&mut scratch.workers, |scratch, y, output_rows| {
            self.run_tile_row(input, y, scratch, output_rows, out_row_len);
        });
    }

    /// Runs it for one row of tiles, the one from row `y` on, into `output_rows` with their borders.
    pub(super) fn run_tile_row(
        &self,
        input: &FeatureMap,
        y: usize,
        scratch: &mut WorkerScratch,
        output_rows: &mut [f32],
        out_row_len: usize,
    ) {
        let FeatureMap { stride, row_len, width, .. } = *input;
        let rows = &input.rows_from_above(y)[..POINTS * row_len];
        self.products.run(TileRow { conv: self, rows, row_len, stride, width, scratch, output_rows, out_row_len });
    }

    /// What it makes of `input`, of `out_channels`.
    #[cfg(test)]
    pub(super) fn run_anew(&self, input: &FeatureMap, out_channels: usize) -> FeatureMap {
        let mut output = FeatureMap::new(input.width, input.height, out_channels, self.products.set());
        let mut scratch = Scratch::new();
        scratch.fit(self);
        self.run(input, &mut scratch, &mut output);
        output
    }

    /// Channels of a pixel of the output.
    pub(super) fn out_stride(&self) -> usize {
        self.out_stride
    }
}

/// G·g·Gᵀ: the weights of the taps, row-major over the kernel, at the points, rows first.
fn weight_points(weight: impl Fn(usize) -> f32) -> [[f64; POINTS]; POINTS] {
    let rows: [[f64; POINTS]; 3] =
        std::array::from_fn(|row| taps_at_points(std::array::from_fn(|column| weight(3 * row + column).into())));
    let mut points = [[0.0; POINTS]; POINTS];
    for column in 0..POINTS {
        for (points, value) in points.iter_mut().zip(taps_at_points(rows.map(|row| row[column]))) {
            points[column] = value;
        }
    }
    points
}

/// G: the weights of three taps in a row or column, at the points.
fn taps_at_points(taps: [f64; 3]) -> [f64; POINTS] {
    let (near, far) = (f64::from(NEAR), f64::from(FAR));
    let at = |point: f64, norm: f64| (taps[0] + point * (taps[1] + point * taps[2])) / norm;
    let near_norm = 2.0 * near * near * (near * near - far * far);
    let far_norm = 2.0 * far * far * (far * far - near * near);
    [
        at(0.0, near * near * far * far),
        at(near, near_norm),
        at(-near, near_norm),
        at(far, far_norm),
        at(-far, far_norm),
        taps[2],
    ]
}

/// Bᵀ: six inputs in a row or column, at the points.
#[inline(always)]
fn to_points<S: Simd>(simd: S, d: [S::Vector; POINTS]) -> [S::Vector; POINTS] {
    const NEAR_SQUARED: f32 = NEAR * NEAR;
    const FAR_SQUARED: f32 = FAR * FAR;
    let times = |factor: f32, a, b| simd.mul_add(simd.splat(factor), a, b);
    let ends = |first, middle, last| {
        times(NEAR_SQUARED * FAR_SQUARED, first, times(-NEAR_SQUARED - FAR_SQUARED, middle, last))
    };
    let (near_even, near_odd) = (times(-FAR_SQUARED, d[2], d[4]), times(-FAR_SQUARED, d[1], d[3]));
    let (far_even, far_odd) = (times(-NEAR_SQUARED, d[2], d[4]), times(-NEAR_SQUARED, d[1], d[3]));
    [
        ends(d[0], d[2], d[4]),
        times(NEAR, near_odd, near_even),
        times(-NEAR, near_odd, near_even),
        times(FAR, far_odd, far_even),
        times(-FAR, far_odd, far_even),
        ends(d[1], d[3], d[5]),
    ]
}

/// Aᵀ: four outputs in a row or column from the sums at the points.
#[inline(always)]
fn from_points<S: Simd>(simd: S, m: [S::Vector; POINTS]) -> [S::Vector; TILE] {
    let times = |factor: f32, a, b| simd.mul_add(simd.splat(factor), a, b);
    let scaled = |factor: f32, a| simd.mul(simd.splat(factor), a);
    let (near_even, near_odd) = (simd.add(m[1], m[2]), simd.sub(m[1], m[2]));
    let (far_even, far_odd) = (simd.add(m[3], m[4]), simd.sub(m[3], m[4]));
    [
        simd.add(m[0], simd.add(near_even, far_even)),
        times(NEAR, near_odd, scaled(FAR, far_odd)),
        times(NEAR * NEAR, near_even, scaled(FAR * FAR, far_even)),
        times(NEAR * NEAR * NEAR, near_odd, times(FAR * FAR * FAR, far_odd, m[5])),
    ]
}

/// Buffers of the layers of one size of map, one after another; those of one worker stay in its cache.
pub(super) struct Scratch {
    workers: Vec<WorkerScratch>,
}

/// What one worker makes of a strip of up to [`ROWS`] tiles side by side.
#[derive(Default)]
pub(super) struct WorkerScratch {
    /// Six rows of the input at its vertical points [point, pixel, channel].
    inputs: Vec<f32>,
    /// Of each pixel a vector, whose largest value is the largest magnitude of six rows of all its channels.
    magnitudes: Vec<f32>,
    /// Of one vertical point, the panels at each horizontal point, before the products and after.
    points: Vec<f32>,
    products: Vec<f32>,
    /// Six rows of sums at the vertical points, [point, pixel, channel].
    sums: Vec<f32>,
}

impl Scratch {
    /// Room for no layer.
    pub(super) fn new() -> Self {
        Self { workers: (0..WORKERS).map(|_| WorkerScratch::default()).collect() }
    }

    /// Makes room for `layer` too.
    pub(super) fn fit(&mut self, layer: &PlainConv) {
        self.workers.iter_mut().for_each(|worker| worker.fit(layer));
    }
}

impl WorkerScratch {
    /// Makes room for `layer` too.
    pub(super) fn fit(&mut self, layer: &PlainConv) {
        let Self { inputs, magnitudes, points, products, sums } = self;
        magnitudes.resize((ROWS * TILE + 2) * MOST_LANES, 0.0);
        for (buffer, row_len) in [
            (inputs, layer.inputs_row_len()),
            (points, layer.shape.inputs_len()),
            (products, layer.shape.outputs_len()),
            (sums, layer.sums_row_len()),
        ] {
            if buffer.len() < POINTS * row_len {
                // Of zeros that nobody has written the system makes memory only when a worker uses it.
                *buffer = vec![0.0; POINTS * row_len];
            }
        }
    }
}

impl PlainConv {
    fn inputs_row_len(&self) -> usize {
        (ROWS * TILE + 2) * self.in_channels + ROW_PAD
    }

    fn sums_row_len(&self) -> usize {
        ROWS * TILE * self.out_stride + ROW_PAD
    }
}

/// One row of tiles.
struct TileRow<'a> {
    conv: &'a PlainConv,
    /// [`POINTS`] rows of the input with their borders.
    rows: &'a [f32],
    row_len: usize,
    /// Channels of a pixel there.
    stride: usize,
    width: usize,
    scratch: &'a mut WorkerScratch,
    /// Up to [`TILE`] rows of the output with their borders.
    output_rows: &'a mut [f32],
    out_row_len: usize,
}

impl Task for TileRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        for x in (0..self.width).step_by(ROWS * TILE) {
            let pixels = (self.width - x).min(ROWS * TILE);
            let scales = self.transform_columns(simd, x, pixels.div_ceil(TILE));
            for point in 0..POINTS {
                self.multiply(simd, point, &scales[..pixels.div_ceil(TILE)]);
            }
            self.finish_columns(simd, x, pixels, &scales);
        }
    }
}

impl TileRow<'_> {
    /// Brings the columns of the strip that begins at pixel `x` to their points, and returns for each tile, where factors
    /// are integers, what its points are multiplied by to be some and what its sums are multiplied by then.
    #[inline(always)]
    fn transform_columns<S: Simd>(&mut self, simd: S, x: usize, tiles: usize) -> [[f32; 2]; ROWS] {
        let Self { conv, rows, row_len, stride, ref mut scratch, .. } = *self;
        let &PlainConv { in_channels, shape, .. } = conv;
        let WorkerScratch { inputs, magnitudes, .. } = &mut **scratch;
        let (pixels, to_row_len) = (tiles * TILE + 2, conv.inputs_row_len());
        let (from, to) = (&rows[x * stride..], &mut inputs[..POINTS * to_row_len]);
        assert!(tiles <= ROWS && in_channels.is_multiple_of(S::LANES) && to_row_len >= pixels * in_channels);
        assert!(from.len() >= (POINTS - 1) * row_len + (pixels - 1) * stride + in_channels);
        for (pixel, to_magnitudes) in magnitudes.chunks_exact_mut(S::LANES).enumerate().take(pixels) {
            let mut magnitude = simd.splat(0.0);
            for channel in (0..in_channels).step_by(S::LANES) {
                // SAFETY: `channel` and the LANES values after it are readable of this pixel in each of six rows of
                // `from`, and writable in each of `to`.
                unsafe {
                    let values = simd.load_strided(from.as_ptr().add(pixel * stride + channel), row_len);
                    if S::INTEGERS {
                        for value in values {
                            magnitude = simd.larger_magnitude(magnitude, value);
                        }
                    }
                    let place = to.as_mut_ptr().add(pixel * in_channels + channel);
                    for (point, value) in to_points(simd, values).into_iter().enumerate() {
                        simd.store(place.add(point * to_row_len), value);
                    }
                }
            }
            if S::INTEGERS {
                simd.write(to_magnitudes, magnitude);
            }
        }
        let mut scales = [[1.0; 2]; ROWS];
        if S::INTEGERS {
            let largest = shape.largest_input() / (POINTS_GAIN * POINTS_GAIN);
            for (tile, scales) in scales.iter_mut().enumerate().take(tiles) {
                let mut magnitude = simd.splat(0.0);
                for pixel in magnitudes.chunks_exact(S::LANES).skip(tile * TILE).take(POINTS) {
                    magnitude = simd.larger_magnitude(magnitude, simd.read(pixel));
                }
                *scales = integers_scale(simd, magnitude, largest);
            }
        }
        scales
    }

    /// Brings the rows at one vertical point to their points, multiplies, and brings the products to pixels.
    #[inline(always)]
    fn multiply<S: Simd>(&mut self, simd: S, point: usize, scales: &[[f32; 2]]) {
        let Self { conv, scratch: WorkerScratch { inputs, points, products, sums, .. }, .. } = self;
        let tiles = scales.len();
        let PlainConv { in_channels, out_stride, shape, .. } = **conv;
        let (points_len, products_len, weights_len) = (shape.inputs_len(), shape.outputs_len(), shape.weights_len());
        let from = &inputs[point * conv.inputs_row_len()..][..conv.inputs_row_len()];
        let points = &mut points[..POINTS * points_len];
        assert!(
            from.len() >= (tiles * TILE + 2) * in_channels && tiles <= ROWS && in_channels.is_multiple_of(S::LANES)
        );
        assert!(points_len * S::FACTORS >= panels_len(in_channels));
        for (tile, [scale, _]) in scales.iter().enumerate() {
            let scale = simd.splat(*scale);
            for channel in (0..in_channels).step_by(S::LANES) {
                // SAFETY: a tile's six pixels lie in `from`, and its row of the channel's panel in each point's panels.
                unsafe {
                    let pixel = from.as_ptr().add(tile * TILE * in_channels + channel);
                    let values = simd.load_strided(pixel, in_channels);
                    let place = points.as_mut_ptr().add(panel_place(tile, channel) / S::FACTORS);
                    for (point, mut value) in to_points(simd, values).into_iter().enumerate() {
                        if S::INTEGERS {
                            value = simd.mul(value, scale);
                        }
                        simd.store_factors(place.add(point * points_len), value);
                    }
                }
            }
        }

        let weights = conv.weights[point * POINTS * weights_len..].chunks_exact(weights_len);
        let products = &mut products[..POINTS * products_len];
        for ((points, products), weights) in
            points.chunks_exact(points_len).zip(products.chunks_exact_mut(products_len)).zip(weights)
        {
            shape.multiply(simd, tiles, points, weights, products);
        }

        let to = &mut sums[point * conv.sums_row_len()..][..conv.sums_row_len()];
        assert!(to.len() >= tiles * TILE * out_stride && out_stride.is_multiple_of(S::LANES));
        assert!(products_len >= panels_len(out_stride));
        for tile in 0..tiles {
            for channel in (0..out_stride).step_by(S::LANES) {
                // SAFETY: as above, from each point's panels to a tile's four pixels in `to`.
                unsafe {
                    let place = products.as_ptr().add(panel_place(tile, channel));
                    let values = simd.load_strided(place, products_len);
                    let pixel = to.as_mut_ptr().add(tile * TILE * out_stride + channel);
                    for (column, value) in from_points(simd, values).into_iter().enumerate() {
                        simd.store(pixel.add(column * out_stride), value);
                    }
                }
            }
        }
    }

    /// Brings the columns of sums to rows of the output, from pixel `x` on.
    #[inline(always)]
    fn finish_columns<S: Simd>(&mut self, simd: S, x: usize, pixels: usize, scales: &[[f32; 2]; ROWS]) {
        let Self { conv, scratch, output_rows, out_row_len, .. } = self;
        let PlainConv { out_stride, ref activation, .. } = **conv;
        let (from, from_row_len) = (&scratch.sums[..POINTS * conv.sums_row_len()], conv.sums_row_len());
        let rows = output_rows.len() / *out_row_len;
        let to = &mut output_rows[(x + 1) * out_stride..];
        assert!(rows <= TILE && to.len() >= (rows - 1) * *out_row_len + pixels * out_stride);
        assert!(from_row_len >= pixels * out_stride && activation.bias.len() == out_stride);
        assert!(out_stride.is_multiple_of(S::LANES));
        for pixel in 0..pixels {
            let [_, scale] = scales[pixel / TILE];
            for channel in (0..out_stride).step_by(S::LANES) {
                let place = pixel * out_stride + channel;
                // SAFETY: `place` and the LANES values after it lie in each of six rows of `from` and of `rows` of
                // `to`; `channel` likewise in the bias.
                unsafe {
                    let values = simd.load_strided(from.as_ptr().add(place), from_row_len);
                    let scale_and_bias = activation.of_channels(simd, channel, scale);
                    for (row, value) in from_points(simd, values).into_iter().enumerate().take(rows) {
                        activation.store(simd, value, scale_and_bias, to.as_mut_ptr().add(row * *out_row_len + place));
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rayon::iter::ParallelIterator;

    use super::*;
    use crate::worst::worst;

    /// Largest error allowed, over the output's root mean square: a quarter of what stages of whole networks may have,
    /// which are judged by their largest value.
    const TOLERANCE: f64 = 2e-5;
    /// The same of bfloat16s, which have 8 bits, and of integers.
    const HALF_TOLERANCE: f64 = 0.15;
    const INTEGERS_TOLERANCE: f64 = 0.05;
    /// Between sets whose points differ in the last bit, so that few of them are rounded the other way.
    const ROUNDED_ALIKE: f64 = 1e-2;
    const SLOPE: f32 = 0.1;

    fn noise(index: usize) -> f32 {
        let mixed = (index as u32 ^ 0x5bd1_e995).wrapping_mul(0x9e37_79b9);
        ((mixed ^ (mixed >> 15)).wrapping_mul(0x2c1b_3c6d) >> 8) as f32 / (1 << 23) as f32 - 1.0
    }

    fn weight(output: usize, input: usize, tap: usize) -> f32 {
        noise((output * 100 + input) * TAPS + tap)
    }

    fn value(x: usize, y: usize, channel: usize) -> f32 {
        noise(1_000_000 + (y * 300 + x) * 100 + channel)
    }

    /// A layer of `inputs` to `outputs` channels with the maps that it reads and writes, both filled.
    fn layer(
        [width, height, inputs, outputs]: [usize; 4],
        epilogue: Epilogue,
        products: Products,
    ) -> (PlainConv, FeatureMap, FeatureMap) {
        let mut conv = PlainConv::new(inputs, outputs, epilogue, SLOPE, products);
        let channels: Vec<_> = (0..inputs).collect();
        conv.fill(&channels, (0..outputs).map(|output| noise(output + 9_000_000)), weight);
        let map = |channels: usize| {
            let mut map = FeatureMap::new(width, height, channels, products.set());
            for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
                let pixel = pixel_mut(&mut map, x, y);
                pixel.iter_mut().take(channels).enumerate().for_each(|(channel, to)| *to = value(x, y, channel));
            }
            map
        };
        (conv, map(inputs), map(outputs))
    }

    fn pixel_mut(map: &mut FeatureMap, x: usize, y: usize) -> &mut [f32] {
        let stride = map.stride;
        let row = map.rows_mut().collect::<Vec<_>>().remove(y);
        &mut row[(x + 1) * stride..][..stride]
    }

    fn run(conv: &PlainConv, input: &FeatureMap, output: &mut FeatureMap) {
        let mut scratch = Scratch::new();
        scratch.fit(conv);
        conv.run(input, &mut scratch, output);
    }

    /// The sum over taps in double precision.
    fn expected([width, height, inputs, _]: [usize; 4], epilogue: Epilogue, [x, y, output]: [usize; 3]) -> f64 {
        let mut sum = f64::from(noise(output + 9_000_000));
        for (tap, input) in (0..TAPS).flat_map(|tap| (0..inputs).map(move |input| (tap, input))) {
            let (x, y) = ((x + tap % 3).wrapping_sub(1), (y + tap / 3).wrapping_sub(1));
            if x < width && y < height {
                sum += f64::from(weight(output, input, tap)) * f64::from(value(x, y, input));
            }
        }
        if epilogue == Epilogue::ResidualLeaky {
            sum = 0.5 * sum + f64::from(value(x, y, output));
        }
        if epilogue == Epilogue::None || sum >= 0.0 { sum } else { f64::from(SLOPE) * sum }
    }

    /// What a layer gives, row by row.
    fn outputs(size @ [width, height, _, outputs]: [usize; 4], epilogue: Epilogue, products: Products) -> Vec<f64> {
        let (conv, input, mut output) = layer(size, epilogue, products);
        run(&conv, &input, &mut output);
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        pixels.flat_map(|(x, y)| output.pixel(x, y)[..outputs].to_vec()).map(f64::from).collect()
    }

    /// Asserts that values are as expected, over these' root mean square, and that one wrong value would be seen.
    fn assert_near(context: &str, mut found: Vec<f64>, wanted: &[f64], tolerance: f64) {
        let rms = (wanted.iter().map(|value| value * value).sum::<f64>() / wanted.len() as f64).sqrt();
        let largest_error = |found: &[f64]| worst(found.iter().zip(wanted).map(|(f, wanted)| (f - wanted).abs() / rms));
        assert_eq!(found.len(), wanted.len());
        assert!(largest_error(&found) < tolerance, "{context}: {}", largest_error(&found));
        found[0] += 2.0 * tolerance * rms;
        assert!(largest_error(&found) > tolerance, "{context}: the comparison is blind");
    }

    const SIZES: [[usize; 4]; 6] =
        [[1, 1, 1, 1], [9, 5, 24, 24], [13, 6, 32, 32], [101, 3, 45, 56], [97, 4, 82, 32], [6, 10, 33, 6]];

    #[test]
    fn a_layer_is_the_sum_over_taps_at_every_size_and_width_of_channels() {
        for (products, size) in Products::available().flat_map(|products| SIZES.map(|size| (products, size))) {
            for epilogue in [Epilogue::None, Epilogue::Leaky, Epilogue::ResidualLeaky] {
                let [width, height, _, channels] = size;
                let places = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
                let wanted: Vec<f64> = places
                    .flat_map(|(x, y)| (0..channels).map(move |channel| expected(size, epilogue, [x, y, channel])))
                    .collect();
                let context = format!("{size:?} {epilogue:?} on {}", products.name());
                let tolerance = match (products.factors(), products.integers()) {
                    (1, _) => TOLERANCE,
                    (_, false) => HALF_TOLERANCE,
                    (_, true) => INTEGERS_TOLERANCE,
                };
                assert_near(&context, outputs(size, epilogue, products), &wanted, tolerance);
            }
        }
    }

    /// Whichever way factors lie in vectors, and whatever multiplies them, they are rounded alike.
    #[test]
    fn layers_in_half_precision_are_the_same_on_all_sets() {
        for (size, integers) in SIZES.into_iter().flat_map(|size| [(size, false), (size, true)]) {
            let is_alike = |products: &Products| products.factors() == 2 && products.integers() == integers;
            let mut half = Products::available().filter(is_alike);
            let wanted = outputs(size, Epilogue::Leaky, half.next().expect("one of plain Rust"));
            for products in half {
                let context = format!("{size:?} on {}", products.name());
                assert_near(&context, outputs(size, Epilogue::Leaky, products), &wanted, ROUNDED_ALIKE);
            }
        }
    }

    #[test]
    fn what_is_no_number_stays_in_its_tiles_and_in_its_frame() {
        let size @ [width, height, _, outputs] = [19, 14, 24, 24];
        let spoilers = |products| [f32::NAN, f32::INFINITY].map(|spoiler| (products, spoiler));
        for (products, spoiler) in Products::available().flat_map(spoilers) {
            let (conv, mut input, mut output) = layer(size, Epilogue::Leaky, products);
            run(&conv, &input, &mut output);
            let values = |map: &FeatureMap, x, y| map.pixel(x, y)[..outputs].to_vec();
            let all = |map: &FeatureMap| -> Vec<_> {
                (0..width * height).flat_map(|index| values(map, index % width, index / width)).collect()
            };
            let clean = all(&output);
            for (x, y) in [(0, 0), (18, 13), (7, 8), (11, 3)] {
                let before = pixel_mut(&mut input, x, y)[5];
                pixel_mut(&mut input, x, y)[5] = spoiler;
                run(&conv, &input, &mut output);
                for (place, (value, clean)) in all(&output).into_iter().zip(&clean).enumerate() {
                    let (at_x, at_y) = (place / outputs % width, place / outputs / width);
                    let reads =
                        |at: usize, from: usize| (at / TILE * TILE..at / TILE * TILE + POINTS).contains(&(from + 1));
                    if at_x.abs_diff(x) <= 1 && at_y.abs_diff(y) <= 1 {
                        assert!(!value.is_finite(), "({at_x}, {at_y}) hides what ({x}, {y}) is");
                    } else if !(reads(at_x, x) && reads(at_y, y)) {
                        assert_eq!(value, *clean, "({at_x}, {at_y}) shows what ({x}, {y}) is");
                    }
                }
                pixel_mut(&mut input, x, y)[5] = before;
                run(&conv, &input, &mut output);
                assert_eq!(all(&output), clean, "({x}, {y}) left a trace");
            }
        }
    }
}
