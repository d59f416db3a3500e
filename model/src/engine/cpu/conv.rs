//! Plain 3x3 convolutions, by Winograd's minimal filtering: F(4x4, 3x3) takes 36 multiplications where the sum over taps
//! takes 144.
//!
//! Six input values of a row or column become six points, the input polynomial's remainders at 0, ±⅝, ±1½ and ∞; products
//! with the weights' points are summed over channels; and four outputs come back of six sums. With these points, of which
//! all factors are exact, the error is 1.7 times that of the sum over taps; with the usual 0, ±1, ±2 and ∞ it is 4 times.

use super::feature_map::{FeatureMap, TILE, WORKERS};
use super::product::{ROWS, Shape, panel_place, panels_len};
use crate::simd::{InstructionSet, Simd, Task};

pub(super) const TAPS: usize = 9;
/// Inputs of a tile each way, and points.
const POINTS: usize = TILE + 2;
/// The finite points are 0, ±NEAR and ±FAR.
const NEAR: f32 = 0.625;
const FAR: f32 = 1.5;
/// Between the rows of a buffer, so that they do not fall on the same lines of a cache.
const ROW_PAD: usize = 16;

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

/// What a layer does with its sums: the bias of each channel of the output map, and the epilogue.
pub(super) struct Activation {
    pub(super) bias: Vec<f32>,
    pub(super) epilogue: Epilogue,
    pub(super) leaky_slope: f32,
}

impl Activation {
    /// Turns a vector of sums, whose bias is given, into what is stored at `place`.
    ///
    /// # Safety
    /// A vector can be loaded from `place` and stored there.
    #[inline(always)]
    pub(super) unsafe fn store<S: Simd>(&self, simd: S, sum: S::Vector, bias: S::Vector, place: *mut f32) {
        let mut sum = simd.add(sum, bias);
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
    in_stride: usize,
    out_stride: usize,
    shape: Shape,
    /// For each point, rows first, a packed product of `shape`.
    weights: Vec<f32>,
    activation: Activation,
    set: InstructionSet,
}

impl PlainConv {
    /// Room for a convolution of `in_channels` to `out_channels`; all parameters are zero.
    pub(super) fn new(
        in_channels: usize,
        out_channels: usize,
        epilogue: Epilogue,
        leaky_slope: f32,
        set: InstructionSet,
    ) -> Self {
        let shape = Shape::new(1, in_channels, out_channels);
        let out_stride = out_channels.next_multiple_of(set.lanes());
        Self {
            in_stride: in_channels.next_multiple_of(set.lanes()),
            out_stride,
            shape,
            weights: vec![0.0; POINTS * POINTS * shape.weights_len()],
            activation: Activation { bias: vec![0.0; out_stride], epilogue, leaky_slope },
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
            self.activation.bias[output] = value;
            for input in 0..in_channels {
                let rows: [[f64; POINTS]; 3] = std::array::from_fn(|row| {
                    weight_points(std::array::from_fn(|column| weight(output, input, 3 * row + column).into()))
                });
                let place = self.shape.place(0, input, output, self.set);
                for column in 0..POINTS {
                    for (row, value) in weight_points(rows.map(|row| row[column])).into_iter().enumerate() {
                        self.weights[(row * POINTS + column) * self.shape.weights_len() + place] = value as f32;
                    }
                }
            }
        }
    }

    /// Runs the convolution over `input` into `output`.
    pub(super) fn run(&self, input: &FeatureMap, scratch: &mut Scratch, output: &mut FeatureMap) {
        debug_assert_eq!((input.stride, output.stride), (self.in_stride, self.out_stride));
        let (width, out_row_len) = (output.width, output.row_len);
        output.for_each_tile_row(&mut scratch.workers, |scratch, y, output_rows| {
            let (rows, row_len) = (&input.rows_from_above(y)[..POINTS * input.row_len], input.row_len);
            self.set.run(TileRow { conv: self, rows, row_len, width, scratch, output_rows, out_row_len });
        });
    }
}

/// G: the weights of three taps in a row or column, at the points.
fn weight_points(taps: [f64; 3]) -> [f64; POINTS] {
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
struct WorkerScratch {
    /// Six rows of the input at its vertical points [point, pixel, channel].
    inputs: Vec<f32>,
    /// Of one vertical point, the panels at each horizontal point, before the products and after.
    points: Vec<f32>,
    products: Vec<f32>,
    /// Six rows of sums at the vertical points, [point, pixel, channel].
    sums: Vec<f32>,
}

impl Scratch {
    /// Enough for each of `layers`.
    pub(super) fn new<'a>(layers: impl Iterator<Item = &'a PlainConv> + Clone) -> Self {
        let most = |len: fn(&PlainConv) -> usize| vec![0.0; layers.clone().map(len).max().unwrap_or(0)];
        let worker = || WorkerScratch {
            inputs: most(|conv| POINTS * conv.inputs_row_len()),
            points: most(|conv| POINTS * conv.shape.inputs_len()),
            products: most(|conv| POINTS * conv.shape.outputs_len()),
            sums: most(|conv| POINTS * conv.sums_row_len()),
        };
        Self { workers: (0..WORKERS).map(|_| worker()).collect() }
    }
}

impl PlainConv {
    fn inputs_row_len(&self) -> usize {
        (ROWS * TILE + 2) * self.in_stride + ROW_PAD
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
            self.transform_columns(simd, x, pixels.div_ceil(TILE));
            for point in 0..POINTS {
                self.multiply(simd, point, pixels.div_ceil(TILE));
            }
            self.finish_columns(simd, x, pixels);
        }
    }
}

impl TileRow<'_> {
    /// Brings the columns of the strip that begins at pixel `x` to their points.
    #[inline(always)]
    fn transform_columns<S: Simd>(&mut self, simd: S, x: usize, tiles: usize) {
        let Self { conv, rows, row_len, scratch, .. } = self;
        let len = (tiles * TILE + 2) * conv.in_stride;
        let to_row_len = conv.inputs_row_len();
        let (from, to) = (&rows[x * conv.in_stride..], &mut scratch.inputs[..POINTS * to_row_len]);
        assert!(from.len() >= (POINTS - 1) * *row_len + len && to_row_len >= len && len.is_multiple_of(S::LANES));
        for place in (0..len).step_by(S::LANES) {
            // SAFETY: `len` is a multiple of LANES; so much is readable in each of six rows of `from`, and writable in
            // each of `to`.
            unsafe {
                let values = std::array::from_fn(|row| simd.load(from.as_ptr().add(row * *row_len + place)));
                for (point, value) in to_points(simd, values).into_iter().enumerate() {
                    simd.store(to.as_mut_ptr().add(point * to_row_len + place), value);
                }
            }
        }
    }

    /// Brings the rows at one vertical point to their points, multiplies, and brings the products to pixels.
    #[inline(always)]
    fn multiply<S: Simd>(&mut self, simd: S, point: usize, tiles: usize) {
        let Self { conv, scratch: WorkerScratch { inputs, points, products, sums }, .. } = self;
        let PlainConv { in_stride, out_stride, shape, .. } = **conv;
        let (points_len, products_len, weights_len) = (shape.inputs_len(), shape.outputs_len(), shape.weights_len());
        let from = &inputs[point * conv.inputs_row_len()..][..conv.inputs_row_len()];
        let points = &mut points[..POINTS * points_len];
        assert!(from.len() >= (tiles * TILE + 2) * in_stride && tiles <= ROWS && in_stride.is_multiple_of(S::LANES));
        assert!(points_len >= panels_len(in_stride));
        for channel in (0..in_stride).step_by(S::LANES) {
            for tile in 0..tiles {
                // SAFETY: a tile's six pixels lie in `from`, and its row of the channel's panel in each point's panels.
                unsafe {
                    let pixel = from.as_ptr().add(tile * TILE * in_stride + channel);
                    let values = std::array::from_fn(|column| simd.load(pixel.add(column * in_stride)));
                    let place = points.as_mut_ptr().add(panel_place(tile, channel));
                    for (point, value) in to_points(simd, values).into_iter().enumerate() {
                        simd.store(place.add(point * points_len), value);
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
        for channel in (0..out_stride).step_by(S::LANES) {
            for tile in 0..tiles {
                // SAFETY: as above, from each point's panels to a tile's four pixels in `to`.
                unsafe {
                    let place = products.as_ptr().add(panel_place(tile, channel));
                    let values = std::array::from_fn(|point| simd.load(place.add(point * products_len)));
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
    fn finish_columns<S: Simd>(&mut self, simd: S, x: usize, pixels: usize) {
        let Self { conv, scratch, output_rows, out_row_len, .. } = self;
        let PlainConv { out_stride, ref activation, .. } = **conv;
        let (from, from_row_len) = (&scratch.sums[..POINTS * conv.sums_row_len()], conv.sums_row_len());
        let rows = output_rows.len() / *out_row_len;
        let to = &mut output_rows[(x + 1) * out_stride..];
        assert!(rows <= TILE && to.len() >= (rows - 1) * *out_row_len + pixels * out_stride);
        assert!(from_row_len >= pixels * out_stride && activation.bias.len() == out_stride);
        assert!(out_stride.is_multiple_of(S::LANES));
        for pixel in 0..pixels {
            for channel in (0..out_stride).step_by(S::LANES) {
                let place = pixel * out_stride + channel;
                // SAFETY: `place` and the LANES values after it lie in each of six rows of `from` and of `rows` of `to`;
                // `channel` likewise in the bias.
                unsafe {
                    let values = std::array::from_fn(|row| simd.load(from.as_ptr().add(row * from_row_len + place)));
                    let bias = simd.load(activation.bias.as_ptr().add(channel));
                    for (row, value) in from_points(simd, values).into_iter().enumerate().take(rows) {
                        activation.store(simd, value, bias, to.as_mut_ptr().add(row * *out_row_len + place));
                    }
                }
            }
        }
    }
}
