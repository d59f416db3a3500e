//! The network written out layer by layer in double precision, as plainly as it can be: what engines are judged by.
//!
//! Maps are [channels, height, width].

use std::f64::consts::{PI, TAU};

use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};
use num_complex::Complex64;

use crate::RgbdFrame;
use crate::conditions::Conditions;
use crate::engine::constants::LAYER_SHIFTS;
use crate::scene::FocalStack;
use crate::weights::{Adjustable, Dense, Family, Grid, Layer, NetworkConfig, Weights};

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

    /// The value at a place of the map, and 0 outside it.
    pub(crate) fn at(&self, channel: usize, y: isize, x: isize) -> f64 {
        if y < 0 || x < 0 || y >= self.height as isize || x >= self.width as isize {
            return 0.0;
        }
        self.values[(channel * self.height + y as usize) * self.width + x as usize]
    }

    pub(crate) fn bilinear(&self, channel: usize, y: f64, x: f64) -> f64 {
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
    /// In the order in which they run, under the names that golden files give them.
    pub(crate) stages: Vec<Stage>,
    /// [3, height, width] at the frame's resolution.
    pub(crate) field: Vec<Complex64>,
}

pub(crate) struct Stage {
    pub(crate) name: String,
    pub(crate) value: Value,
}

pub(crate) enum Value {
    /// What a first layer reads.
    Encoded(Map),
    /// A layer's map after its activation, and the offsets of an adjustable one.
    Layer(Map, Option<Map>),
    /// A field on the network's grid, [3, height, width].
    Light(Vec<Complex64>),
}

pub(crate) fn run(weights: &Weights, bench: &DisplayGeometry, frame: &RgbdFrame, pupil: PupilDiameter) -> Trace {
    let conditions = Conditions::of(&weights.config.trained, bench, pupil);
    let pupil_mm = f64::from(pupil.mm());
    let mut stages = Vec::new();
    let low = match &weights.family {
        Family::Direct { layers } => {
            let encoded = encode(weights.config.grid, frame, conditions);
            let residual = trunk(&mut stages, "", layers, weights, encoded, conditions);
            let base = block_means(weights.config.grid, frame);
            add(&base.values.iter().map(|&value| value.into()).collect::<Vec<_>>(), &residual, 1.0)
        }
        Family::ExpectedStack { lighting, correction, feedback } => {
            let maps = encode_for_light(frame, conditions);
            let wanted = expected_stack(weights, bench, frame, [maps.height, maps.width], pupil_mm).map(f64::sqrt);
            let told = concatenate(&[&maps, &wanted.clone().map(|amplitude| amplitude - 0.4)]);
            let positions_m: Vec<f64> =
                (0..weights.config.depth_layers).map(|layer| centre_m(weights, bench, layer)).collect();
            let nets = Nets { lighting, correction, share: feedback.share };
            let weight = |plane: usize, index: usize| {
                1.0 + f64::from(feedback.sharpness) * cover(weights, frame, maps.width, index, plane)
            };
            lit_planes(&mut stages, &nets, weights, bench, &positions_m, [&told, &wanted], pupil, weight)
        }
        Family::FocalStack { .. } => panic!("it is told images: see `run_focal_stack`"),
    };
    let scale = scale_of(weights.config.grid);
    let (rows, columns) = (frame.resolution.height.div_ceil(scale), frame.resolution.width.div_ceil(scale));
    Trace { stages, field: onto_panel(weights.config.grid, frame.resolution, &low, [rows, columns]) }
}

/// The same of a `focal-stack` network.
pub(crate) fn run_focal_stack(weights: &Weights, bench: &DisplayGeometry, focal: &FocalStack) -> Trace {
    let Family::FocalStack { lighting, correction, feedback_share } = &weights.family else {
        panic!("it is told a frame: see `run`")
    };
    let Resolution { width, height } = focal.resolution;
    let (rows, columns, planes) = (height.div_ceil(2), width.div_ceil(2), focal.focuses.len());
    let at =
        |image: usize, y: usize, x: usize| sample(&focal.amplitude[image * width * height..], focal.resolution, y, x);
    let wanted = Map::from_fn([3 * planes, rows, columns], |image, y, x| {
        let corners = [(0, 0), (0, 1), (1, 0), (1, 1)];
        (corners.iter().map(|(dy, dx)| at(image, 2 * y + dy, 2 * x + dx).powi(2)).sum::<f64>() / 4.0).sqrt()
    });
    let conditions = Conditions::of(&weights.config.trained, bench, focal.pupil);
    let told = Map::from_fn([12 * planes + 2, rows, columns], |channel, y, x| {
        let (image, corner) = (channel / 4, channel % 4);
        match channel.checked_sub(12 * planes) {
            None => at(image, 2 * y + corner / 2, 2 * x + corner % 2) - 0.4,
            Some(condition) => conditions.told()[condition],
        }
    });
    let positions_m: Vec<f64> = (0..planes)
        .map(|plane| {
            let share = plane as f64 / (planes - 1) as f64;
            let dioptres = bench.depth_far.0 + share * (bench.depth_near.0 - bench.depth_far.0);
            bench.eyepiece_focal_length.0.powi(2) * dioptres
        })
        .collect();
    let mut stages = Vec::new();
    let nets = Nets { lighting, correction, share: *feedback_share };
    let weight = |_, _| 1.0;
    let low = lit_planes(&mut stages, &nets, weights, bench, &positions_m, [&told, &wanted], focal.pupil, weight);
    Trace { stages, field: onto_panel(Grid::HalfBand, focal.resolution, &low, [rows, columns]) }
}

/// The layers of a network that lights planes, and the share of the change that the field takes.
struct Nets<'a> {
    lighting: &'a [Layer],
    correction: &'a [Layer],
    share: f32,
}

/// The field of a network that lights planes at `positions_m`: both nets are `told` the one map and the other's
/// amplitudes are `wanted` there; each change has the `weight` of a plane and a sample.
#[allow(clippy::too_many_arguments, reason = "written out as plainly as it can be")]
fn lit_planes(
    stages: &mut Vec<Stage>,
    nets: &Nets<'_>,
    weights: &Weights,
    bench: &DisplayGeometry,
    positions_m: &[f64],
    [told, wanted]: [&Map; 2],
    pupil: PupilDiameter,
    weight: impl Fn(usize, usize) -> f64,
) -> Vec<Complex64> {
    let conditions = Conditions::of(&weights.config.trained, bench, pupil);
    let out = trunk(stages, "lighting.", nets.lighting, weights, told.clone(), conditions);
    let wanted = if weights.config.refined_stack { refined(weights, &out, wanted.clone()) } else { wanted.clone() };
    let carried = light_planes(bench, positions_m, &out, &wanted);
    stages.push(Stage { name: "carried".into(), value: Value::Light(carried.clone()) });
    let (change, lack) = feed_back(bench, positions_m, &carried, &wanted, weight, pupil.mm().into());
    let field: Vec<_> = carried.iter().zip(&change).map(|(f, c)| f + c * f64::from(nets.share)).collect();
    let [real, imaginary] = parts(&field, told);
    let [change_real, change_imaginary] = parts(&change, told);
    let encoded = concatenate(&[&real, &imaginary, told, &change_real, &change_imaginary, &lack]);
    let residual = trunk(stages, "correction.", nets.correction, weights, encoded, conditions);
    add(&field, &residual, 0.3)
}

/// Runs a stack of layers; its stages are added to `stages`, the last layer's map is returned.
fn trunk(
    stages: &mut Vec<Stage>,
    prefix: &str,
    layers: &[Layer],
    weights: &Weights,
    encoded: Map,
    conditions: Conditions,
) -> Map {
    let slope = f64::from(weights.config.leaky_slope);
    let mut maps = Vec::<Map>::new();
    stages.push(Stage { name: format!("{prefix}encoded"), value: Value::Encoded(encoded.clone()) });
    for (index, layer) in layers.iter().enumerate() {
        let input = maps.last().unwrap_or(&encoded);
        let offsets = layer.adjustable.as_ref().map(|adjustable| predict_offsets(adjustable, input, conditions, slope));
        let sum = convolve(layer, input, offsets.as_ref());
        let output = if index + 1 == layers.len() {
            sum
        } else if index > 0 && index % 2 == 0 {
            let skip = &maps[index - 2];
            Map::from_fn([sum.channels, sum.height, sum.width], |channel, y, x| {
                let (y, x) = (y as isize, x as isize);
                leaky(0.5 * sum.at(channel, y, x) + skip.at(channel, y, x), slope)
            })
        } else {
            sum.map(|value| leaky(value, slope))
        };
        stages.push(Stage { name: format!("{prefix}layer_{index}"), value: Value::Layer(output.clone(), offsets) });
        maps.push(output);
    }
    maps.pop().unwrap()
}

/// base + share·residual, whose channels are three real parts and three imaginary ones.
fn add(base: &[Complex64], residual: &Map, share: f64) -> Vec<Complex64> {
    let (real, imaginary) = residual.values.split_at(base.len());
    let residual = real.iter().zip(imaginary).map(|(&re, &im)| Complex64::new(re, im));
    base.iter().zip(residual).map(|(base, residual)| base + residual * share).collect()
}

/// Real and imaginary parts of a field on the grid of `like`.
fn parts(field: &[Complex64], like: &Map) -> [Map; 2] {
    [|value: &Complex64| value.re, |value: &Complex64| value.im].map(|part| Map {
        channels: 3,
        values: field.iter().map(part).collect(),
        ..*like
    })
}

fn concatenate(maps: &[&Map]) -> Map {
    Map {
        channels: maps.iter().map(|map| map.channels).sum(),
        values: maps.iter().flat_map(|map| map.values.iter().copied()).collect(),
        ..*maps[0]
    }
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

fn encode(grid: Grid, frame: &RgbdFrame, conditions: Conditions) -> Map {
    let scale = scale_of(grid);
    let Resolution { width, height } = frame.resolution;
    let block = scale * scale;
    Map::from_fn([5 * block + 2, height.div_ceil(scale), width.div_ceil(scale)], |channel, y, x| {
        let (plane, dy, dx) = (channel / block, channel % block / scale, channel % scale);
        let at = |values: &[f32]| sample(values, frame.resolution, scale * y + dy, scale * x + dx);
        match plane {
            0..3 => at(&frame.amplitude[plane * width * height..]),
            3 => at(&frame.depth_normalised) - 0.5,
            4 => conditions.blur_scale() * (at(&frame.depth_normalised) - 0.5),
            _ => conditions.told()[channel - 5 * block],
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

fn predict_offsets(adjustable: &Adjustable, input: &Map, conditions: Conditions, slope: f64) -> Map {
    let [first, second, last] = &adjustable.modulation;
    let rectified = |values: Vec<f64>| values.into_iter().map(|value| leaky(value, slope)).collect::<Vec<_>>();
    let hidden = rectified(dense(first, &conditions.told()));
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

/// Means of the amplitude over what becomes one sample of the grid.
fn block_means(grid: Grid, frame: &RgbdFrame) -> Map {
    let scale = scale_of(grid);
    let Resolution { width, height } = frame.resolution;
    Map::from_fn([3, height.div_ceil(scale), width.div_ceil(scale)], |colour, y, x| {
        let corners = (0..scale).flat_map(|dy| (0..scale).map(move |dx| (scale * y + dy, scale * x + dx)));
        let plane = &frame.amplitude[colour * width * height..];
        corners.map(|(y, x)| sample(plane, frame.resolution, y, x)).sum::<f64>() / (scale * scale) as f64
    })
}

/// What both nets of `expected-stack` are told of a frame, centred around zero.
fn encode_for_light(frame: &RgbdFrame, conditions: Conditions) -> Map {
    let mut maps = encode(Grid::HalfBand, frame, conditions);
    let plane = maps.width * maps.height;
    for (channel, values) in maps.values.chunks_exact_mut(plane).enumerate() {
        for value in values {
            *value = match channel {
                0..12 => *value - 0.4,
                12..16 => 2.0 * *value,
                _ => *value,
            };
        }
    }
    maps
}

/// Where the middle of a depth layer is imaged, metres from the SLM plane.
fn centre_m(weights: &Weights, bench: &DisplayGeometry, layer: usize) -> f64 {
    let share = (layer as f64 + 0.5) / weights.config.depth_layers as f64;
    let dioptres = bench.depth_far.0 + share * (bench.depth_near.0 - bench.depth_far.0);
    bench.eyepiece_focal_length.0.powi(2) * dioptres
}

/// The depth layer of a pixel; beyond an odd edge the edge again.
fn layer_of(weights: &Weights, frame: &RgbdFrame, y: usize, x: usize) -> usize {
    let Resolution { width, height } = frame.resolution;
    let count = weights.config.depth_layers;
    let depth = frame.depth_normalised[y.min(height - 1) * width + x.min(width - 1)];
    ((depth * count as f32 + LAYER_SHIFTS[y % 2 * 2 + x % 2]) as usize).min(count - 1)
}

/// The share of block `index` whose pixels lie in `layer`.
fn cover(weights: &Weights, frame: &RgbdFrame, columns: usize, index: usize, layer: usize) -> f64 {
    let (y, x) = (2 * (index / columns), 2 * (index % columns));
    let corners = [(y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)];
    corners.iter().filter(|&&(y, x)| layer_of(weights, frame, y, x) == layer).count() as f64 / 4.0
}

/// The angular spectrum transfer function of one colour over the distance `u_m`, at cycles per sample of the grid.
fn transfer(bench: &DisplayGeometry, colour: usize, u_m: f64, [fx, fy]: [f64; 2]) -> Complex64 {
    let per_m = 1.0 / bench.wavelengths.0[colour].0;
    let [fx, fy] = [fx, fy].map(|f| f / (2.0 * bench.pixel_pitch.0));
    let squared = per_m * per_m - fx * fx - fy * fy;
    if squared > 0.0 { Complex64::cis(TAU * u_m * (squared.sqrt() - per_m)) } else { Complex64::ZERO }
}

/// What an eye should see at each depth layer as far as the picture and its depth tell: intensities, colours within
/// layers. Each layer is blurred by its disc of confusion; the sum is over that of a white scene.
fn expected_stack(
    weights: &Weights,
    bench: &DisplayGeometry,
    frame: &RgbdFrame,
    size: [usize; 2],
    pupil_mm: f64,
) -> Map {
    let NetworkConfig { depth_layers: count, .. } = &weights.config;
    let [rows, columns] = size;
    let Resolution { width, height } = frame.resolution;
    // White and three colours of each layer.
    let part = |layer: usize, channel: usize| -> Vec<Complex64> {
        let sample = |index: usize| {
            let (y, x) = (2 * (index / columns), 2 * (index % columns));
            let corners = [(y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)].into_iter();
            let light = corners.filter(|&(y, x)| layer_of(weights, frame, y, x) == layer).map(|(y, x)| match channel {
                0 => 1.0,
                _ => sample(&frame.amplitude[(channel - 1) * width * height..], frame.resolution, y, x).powi(2),
            });
            Complex64::from(light.sum::<f64>() / 4.0)
        };
        (0..rows * columns).map(sample).collect()
    };
    let layer_dpt = (bench.depth_near.0 - bench.depth_far.0) / *count as f64;
    let pixel_rad = bench.pixel_pitch.0 / bench.eyepiece_focal_length.0;
    let mut seen = vec![vec![0.0; rows * columns]; 4 * count];
    for (layer, channel) in (0..*count).flat_map(|layer| (0..4).map(move |channel| (layer, channel))) {
        let part = part(layer, channel);
        for focus in 0..*count {
            let blur_dpt = layer.abs_diff(focus) as f64 * layer_dpt;
            let diameter_samples = blur_dpt * pupil_mm * 1e-3 / pixel_rad / 2.0;
            let blurred = filtered(&part, size, |fx, fy| {
                let x = (PI * diameter_samples * fx.hypot(fy)).max(1e-3);
                Complex64::from(2.0 * libm::j1(x) / x)
            });
            seen[4 * focus + channel].iter_mut().zip(blurred).for_each(|(sum, value)| *sum += value.re);
        }
    }
    Map::from_fn([3 * count, rows, columns], |channel, y, x| {
        let at = |plane: usize| seen[plane][y * columns + x];
        let (focus, colour) = (channel / 3, channel % 3);
        (at(4 * focus + 1 + colour) / at(4 * focus).max(0.02)).max(0.0)
    })
}

/// The wanted amplitudes with the first net's changes of them.
fn refined(weights: &Weights, out: &Map, wanted: Map) -> Map {
    let changes = out.values[4 * weights.config.depth_layers * out.width * out.height..].iter();
    let values = wanted.values.iter().zip(changes).map(|(wanted, change)| (wanted + 0.3 * change).max(0.0)).collect();
    Map { values, ..wanted }
}

/// The field at the SLM plane when the wanted amplitudes light planes at `positions_m` through the first net's masks,
/// with its phases.
fn light_planes(bench: &DisplayGeometry, positions_m: &[f64], out: &Map, wanted: &Map) -> Vec<Complex64> {
    let (count, size, pixels) = (positions_m.len(), [out.height, out.width], out.height * out.width);
    let offset = ((count - 1) as f64).ln();
    let mut field = vec![Complex64::ZERO; 3 * pixels];
    for (number, colour) in (0..count).flat_map(|plane| (0..3).map(move |colour| (plane, colour))) {
        let plane = |map: &Map, channel: usize| map.values[channel * pixels..][..pixels].to_vec();
        let (phase, mask) = (plane(out, 4 * number + colour), plane(out, 4 * number + 3));
        let light =
            plane(wanted, 3 * number + colour).into_iter().zip(phase).zip(mask).map(|((wanted, phase), mask)| {
                Complex64::from_polar(wanted, PI * phase) / (1.0 + (offset - mask).exp())
            });
        let u_m = positions_m[number];
        let carried = filtered(&light.collect::<Vec<_>>(), size, |fx, fy| transfer(bench, colour, -u_m, [fx, fy]));
        field[colour * pixels..].iter_mut().zip(carried).for_each(|(sum, value)| *sum += value);
    }
    field
}

/// The mean over the planes of the changes of the field at the SLM plane that would give an eye what it lacks of
/// the wanted amplitudes there, and these lacks.
fn feed_back(
    bench: &DisplayGeometry,
    positions_m: &[f64],
    carried: &[Complex64],
    wanted: &Map,
    weight: impl Fn(usize, usize) -> f64,
    pupil_mm: f64,
) -> (Vec<Complex64>, Map) {
    let (count, size) = (positions_m.len(), [wanted.height, wanted.width]);
    let pixels = wanted.height * wanted.width;
    let mut change = vec![Complex64::ZERO; carried.len()];
    let mut lack = wanted.clone();
    for (number, colour) in (0..count).flat_map(|number| (0..3).map(move |colour| (number, colour))) {
        let plane = colour * pixels..(colour + 1) * pixels;
        let per_mm = 1e-3 / (bench.wavelengths.0[colour].0 * bench.eyepiece_focal_length.0);
        let through = |field: &[Complex64], u_m: f64| {
            filtered(field, size, |fx, fy| {
                let per_m = fx.hypot(fy) / (2.0 * bench.pixel_pitch.0);
                if per_m < 0.5 * pupil_mm * per_mm { transfer(bench, colour, u_m, [fx, fy]) } else { Complex64::ZERO }
            })
        };
        let u_m = positions_m[number];
        let mut arriving = through(&carried[plane.clone()], u_m);
        let lack = &mut lack.values[(3 * number + colour) * pixels..][..pixels];
        for (index, (arriving, lack)) in arriving.iter_mut().zip(lack).enumerate() {
            let amplitude = (arriving.norm_sqr() + 1e-6).sqrt();
            *lack -= amplitude;
            *arriving *= weight(number, index) * *lack / amplitude;
        }
        for (change, back) in change[plane].iter_mut().zip(through(&arriving, -u_m)) {
            *change += back / count as f64;
        }
    }
    (change, lack)
}

/// Multiplies the spectrum of `light` [rows, columns] by `factor`(fx, fy), in cycles per sample; by the definition of
/// the transform, rows first.
fn filtered(
    light: &[Complex64],
    [rows, columns]: [usize; 2],
    factor: impl Fn(f64, f64) -> Complex64,
) -> Vec<Complex64> {
    let signed = |bin: usize, bins: usize| {
        let bin = bin as f64;
        if 2.0 * bin < bins as f64 { bin / bins as f64 } else { bin / bins as f64 - 1.0 }
    };
    let transform = |values: &[Complex64], sign: f64| -> Vec<Complex64> {
        let turns = |bins: usize| -> Vec<Complex64> {
            (0..bins).map(|turn| Complex64::cis(sign * TAU * turn as f64 / bins as f64)).collect()
        };
        let (turns_x, turns_y) = (turns(columns), turns(rows));
        let along_rows: Vec<_> = (0..rows * columns)
            .map(|i| {
                let row = values[i / columns * columns..][..columns].iter().enumerate();
                row.map(|(x, value)| value * turns_x[(i % columns) * x % columns]).sum::<Complex64>()
            })
            .collect();
        (0..rows * columns)
            .map(|i| {
                let column = along_rows[i % columns..].iter().step_by(columns).enumerate();
                let sum: Complex64 = column.map(|(y, value)| value * turns_y[(i / columns) * y % rows]).sum();
                sum / ((rows * columns) as f64).sqrt()
            })
            .collect()
    };
    let mut spectrum = transform(light, -1.0);
    for (index, value) in spectrum.iter_mut().enumerate() {
        *value *= factor(signed(index % columns, columns), signed(index / columns, rows));
    }
    transform(&spectrum, 1.0)
}

/// The field [3, rows, columns] of the network's grid at the panel's resolution.
fn onto_panel(grid: Grid, resolution: Resolution, low: &[Complex64], [rows, columns]: [usize; 2]) -> Vec<Complex64> {
    if grid == Grid::Full {
        return low.to_vec();
    }
    let interpolators =
        |samples: usize, pixels: usize| (0..pixels).map(move |pixel| interpolator(samples, pixel)).collect::<Vec<_>>();
    let (along_x, along_y) = (interpolators(columns, resolution.width), interpolators(rows, resolution.height));
    let weighted = |values: &[Complex64], weights: &[f64]| -> Complex64 {
        values.iter().zip(weights).map(|(value, weight)| value * weight).sum()
    };
    let mut field = Vec::new();
    for predicted in low.chunks_exact(rows * columns) {
        // Of each of the panel's columns, what it has at the rows of the network's grid.
        let column = |weights: &Vec<f64>| predicted.chunks_exact(columns).map(|row| weighted(row, weights)).collect();
        let tall: Vec<Vec<Complex64>> = along_x.iter().map(column).collect();
        field.extend(along_y.iter().flat_map(|weights| tall.iter().map(|column| weighted(column, weights))));
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
