//! The network written out layer by layer in double precision, as plainly as it can be: what engines are judged by.
//!
//! Maps are [channels, height, width].

use std::f64::consts::TAU;

use holod_calibration::Resolution;
use num_complex::Complex64;

use crate::RgbdFrame;
use crate::weights::{Adjustable, Dense, Grid, Layer, Weights};

#[derive(Clone, Debug)]
pub(crate) struct Map {
    pub(crate) channels: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) values: Vec<f64>,
}

impl Map {
    pub(crate) fn from_fn(
        [channels, height, width]: [usize; 3],
        mut value: impl FnMut(usize, usize, usize) -> f64,
    ) -> Self {
        let mut values = Vec::with_capacity(channels * height * width);
        for channel in 0..channels {
            for y in 0..height {
                for x in 0..width {
                    values.push(value(channel, y, x));
                }
            }
        }
        Self { channels, width, height, values }
    }

    /// Zero outside.
    pub(crate) fn at(&self, channel: usize, y: isize, x: isize) -> f64 {
        if y < 0 || x < 0 || y >= self.height as isize || x >= self.width as isize {
            return 0.0;
        }
        self.values[(channel * self.height + y as usize) * self.width + x as usize]
    }

    fn bilinear(&self, channel: usize, y: f64, x: f64) -> f64 {
        let (top, left) = (y.floor(), x.floor());
        let (lower, right) = (y - top, x - left);
        let at = |dy: isize, dx: isize| self.at(channel, top as isize + dy, left as isize + dx);
        (1.0 - lower) * ((1.0 - right) * at(0, 0) + right * at(0, 1))
            + lower * ((1.0 - right) * at(1, 0) + right * at(1, 1))
    }

    fn map(mut self, f: impl Fn(f64) -> f64) -> Self {
        self.values.iter_mut().for_each(|value| *value = f(*value));
        self
    }
}

fn leaky(value: f64, slope: f64) -> f64 {
    if value >= 0.0 { value } else { slope * value }
}

/// What every stage of one frame gives.
pub(crate) struct Trace {
    pub(crate) encoded: Map,
    /// Each layer's map after its activation.
    pub(crate) layers: Vec<Map>,
    /// The offsets of each adjustable layer.
    pub(crate) offsets: Vec<Option<Map>>,
    /// [3, height, width] at the frame's resolution.
    pub(crate) field: Vec<Complex64>,
}

pub(crate) fn run(weights: &Weights, frame: &RgbdFrame, pupil_mm: f64) -> Trace {
    let slope = f64::from(weights.config.leaky_slope);
    let encoded = encode(weights.config.grid, frame, pupil_mm);
    let (mut layers, mut offsets) = (Vec::<Map>::new(), Vec::new());
    for (index, layer) in weights.layers.iter().enumerate() {
        let input = layers.last().unwrap_or(&encoded);
        let layer_offsets =
            layer.adjustable.as_ref().map(|adjustable| predict_offsets(adjustable, input, pupil_mm, slope));
        let sum = convolve(layer, input, layer_offsets.as_ref());
        let output = if index + 1 == weights.layers.len() {
            sum
        } else if index > 0 && index % 2 == 0 {
            let skip = &layers[index - 2];
            Map::from_fn([sum.channels, sum.height, sum.width], |channel, y, x| {
                let (y, x) = (y as isize, x as isize);
                leaky(0.5 * sum.at(channel, y, x) + skip.at(channel, y, x), slope)
            })
        } else {
            sum.map(|value| leaky(value, slope))
        };
        layers.push(output);
        offsets.push(layer_offsets);
    }
    let field = field(weights.config.grid, frame, &layers[layers.len() - 1]);
    Trace { encoded, layers, offsets, field }
}

/// One sample of the frame; beyond an odd edge the edge again.
fn sample(plane: &[f32], resolution: Resolution, y: usize, x: usize) -> f64 {
    let Resolution { width, height } = resolution;
    f64::from(plane[y.min(height - 1) * width + x.min(width - 1)])
}

fn scale_of(grid: Grid) -> usize {
    match grid {
        Grid::HalfBand => 2,
        Grid::Full => 1,
    }
}

fn encode(grid: Grid, frame: &RgbdFrame, pupil_mm: f64) -> Map {
    let scale = scale_of(grid);
    let Resolution { width, height } = frame.resolution;
    let block = scale * scale;
    Map::from_fn([5 * block + 1, height.div_ceil(scale), width.div_ceil(scale)], |channel, y, x| {
        let (plane, dy, dx) = (channel / block, channel % block / scale, channel % scale);
        let at = |values: &[f32]| sample(values, frame.resolution, scale * y + dy, scale * x + dx);
        match plane {
            0..3 => at(&frame.amplitude[plane * width * height..]),
            3 => at(&frame.depth_normalised) - 0.5,
            4 => pupil_mm * (at(&frame.depth_normalised) - 0.5),
            _ => (pupil_mm - 3.0) / 2.0,
        }
    })
}

fn convolve(layer: &Layer, input: &Map, offsets: Option<&Map>) -> Map {
    let inputs = layer.in_channels;
    let taps: Vec<Map> = (0..9)
        .map(|tap| {
            Map::from_fn([inputs, input.height, input.width], |channel, y, x| {
                let (y, x) = (y as isize, x as isize);
                let (tap_y, tap_x) = (y + tap as isize / 3 - 1, x + tap as isize % 3 - 1);
                match offsets {
                    None => input.at(channel, tap_y, tap_x),
                    Some(offsets) => input.bilinear(
                        channel,
                        tap_y as f64 + offsets.at(2 * tap, y, x),
                        tap_x as f64 + offsets.at(2 * tap + 1, y, x),
                    ),
                }
            })
        })
        .collect();
    Map::from_fn([layer.out_channels, input.height, input.width], |output, y, x| {
        let mut sum = f64::from(layer.bias[output]);
        for channel in 0..inputs {
            for (tap, values) in taps.iter().enumerate() {
                let weight = f64::from(layer.weight[(output * inputs + channel) * 9 + tap]);
                sum += weight * values.at(channel, y as isize, x as isize);
            }
        }
        sum
    })
}

fn dense(layer: &Dense, inputs: &[f64]) -> Vec<f64> {
    let row =
        |weights: &[f32]| weights.iter().zip(inputs).map(|(&weight, input)| f64::from(weight) * input).sum::<f64>();
    layer.weight.chunks(layer.inputs).zip(&layer.bias).map(|(weights, &bias)| f64::from(bias) + row(weights)).collect()
}

fn predict_offsets(adjustable: &Adjustable, input: &Map, pupil_mm: f64, slope: f64) -> Map {
    let [first, second, last] = &adjustable.modulation;
    let rectified = |values: Vec<f64>| values.into_iter().map(|value| leaky(value, slope)).collect::<Vec<_>>();
    let hidden = rectified(dense(first, &[(pupil_mm - 3.0) / 2.0]));
    let modulation = dense(last, &rectified(dense(second, &hidden)));
    let (gamma, beta) = modulation.split_at(18 * input.channels);
    Map::from_fn([18, input.height, input.width], |output, y, x| {
        let mut sum = f64::from(adjustable.offset_bias[output]) + beta[output];
        for channel in 0..input.channels {
            let place = output * input.channels + channel;
            for tap in 0..9 {
                let weight = f64::from(adjustable.offset_weight[place * 9 + tap]) * (1.0 + gamma[place]);
                sum += weight * input.at(channel, y as isize + tap as isize / 3 - 1, x as isize + tap as isize % 3 - 1);
            }
        }
        sum
    })
}

fn field(grid: Grid, frame: &RgbdFrame, residual: &Map) -> Vec<Complex64> {
    let scale = scale_of(grid);
    let resolution = frame.resolution;
    let mut field = Vec::new();
    for colour in 0..3 {
        let amplitude = &frame.amplitude[colour * resolution.pixels()..];
        let predicted: Vec<Complex64> = (0..residual.height * residual.width)
            .map(|index| {
                let (y, x) = (index / residual.width, index % residual.width);
                let corners = (0..scale).flat_map(|dy| (0..scale).map(move |dx| (dy, dx)));
                let sum: f64 =
                    corners.map(|(dy, dx)| sample(amplitude, resolution, scale * y + dy, scale * x + dx)).sum();
                let at = |channel| residual.at(channel, y as isize, x as isize);
                Complex64::new(sum / (scale * scale) as f64 + at(colour), at(3 + colour))
            })
            .collect();
        let (rows, columns) = (residual.height, residual.width);
        for (y, x) in (0..resolution.height).flat_map(|y| (0..resolution.width).map(move |x| (y, x))) {
            field.push(match grid {
                Grid::Full => predicted[y * columns + x],
                Grid::HalfBand => {
                    let (along_y, along_x) = (interpolator(rows, y), interpolator(columns, x));
                    let row =
                        |j: usize| (0..columns).map(|i| predicted[j * columns + i] * along_x[i]).sum::<Complex64>();
                    (0..rows).map(|j| row(j) * along_y[j]).sum()
                }
            });
        }
    }
    field
}

/// The weight of each of `samples` samples, which lie at 2i + ½, in the trigonometric interpolation at `position`,
/// without the Nyquist frequency.
fn interpolator(samples: usize, position: usize) -> Vec<f64> {
    (0..samples)
        .map(|i| {
            let distance = position as f64 - (2 * i) as f64 - 0.5;
            let harmonics =
                (1..samples.div_ceil(2)).map(|k| 2.0 * (TAU * k as f64 * distance / (2 * samples) as f64).cos());
            (1.0 + harmonics.sum::<f64>()) / samples as f64
        })
        .collect()
}
