//! Products of rows of channels with packed weights, with as many sums as fit the registers.

use crate::simd::{MOST_LANES, Products, Simd};

/// Rows that are multiplied together at most; each kernel's number of rows divides it.
pub(super) const ROWS: usize = 24;
/// Channels are kept in panels [panel, row, channel of the panel] of this many: the distance between rows is then a
/// constant of the kernel. Inputs lie there as words of factors ([`Simd::FACTORS`]).
pub(super) const PANEL: usize = 32;
/// Words of inputs that are taken together.
const PAIR: usize = 2;
/// Integers, where factors are some, are no larger than 16 bits hold, and neither are their products' sums than 32 do.
const LARGEST_FACTOR: f32 = 32_767.0;
const SUMS_BELOW: f32 = 2_147_483_648.0;
/// What is smaller is scaled as if it were this, so that the scale and its reciprocal are numbers.
const SMALLEST: f32 = 1e-30;
/// Output channels are rounded up to a multiple of this.
const OUTPUTS_STEP: usize = 8;

/// The shape of a product: each row has `groups` times `inputs` values, each group in panels of its own.
#[derive(Clone, Copy)]
pub(super) struct Shape {
    groups: usize,
    /// Words of a group's inputs, rounded up to whole pairs; rows have zeros there.
    words: usize,
    /// Rounded up to [`OUTPUTS_STEP`].
    outputs: usize,
    products: Products,
}

impl Shape {
    pub(super) fn new(groups: usize, inputs: usize, outputs: usize, products: Products) -> Self {
        let words = inputs.div_ceil(products.factors()).next_multiple_of(PAIR);
        Self { groups, words, outputs: outputs.next_multiple_of(OUTPUTS_STEP), products }
    }

    /// Words of the packed weights: for each [`Block`] [group, word of inputs, channel of the block], or, where it is
    /// paired, [group, pair of words, channel of the block, word of the pair].
    pub(super) fn weights_len(self) -> usize {
        self.groups * self.words * self.outputs
    }

    /// Writes one input's and output's weight to the packed ones.
    pub(super) fn set_weight(self, weights: &mut [f32], [group, input, output]: [usize; 3], weight: f32) {
        let factors = self.products.factors();
        let block = Block::of(output, self.outputs, self.products.set().lanes());
        let (row, together) = (group * self.words + input / factors, block.words_together);
        let place = block.first * self.groups * self.words
            + (row - row % together) * block.channels
            + (output - block.first) * together
            + row % together;
        self.products.set_factor(&mut weights[place], input % factors, weight);
    }

    /// The largest magnitude of the integers that inputs are scaled to. They have up to four bits more than weights,
    /// since these are scaled by their true magnitudes, and inputs by a bound of theirs.
    pub(super) fn largest_input(self) -> f32 {
        let inputs = (self.groups * self.words * self.products.factors()) as f32;
        (16.0 * SUMS_BELOW / inputs).sqrt().min(LARGEST_FACTOR)
    }

    /// What the weights of an output are multiplied by, of which `largest` is the largest magnitude and `together` what
    /// all magnitudes that are added up come to; 1 where factors are no integers. No sum overflows then.
    pub(super) fn weights_scale(self, largest: f32, together: f32) -> f32 {
        if !self.products.integers() {
            return 1.0;
        }
        let inputs = (self.groups * self.words * self.products.factors()) as f32;
        // Each may be rounded up by a half.
        let most_together = SUMS_BELOW / (self.largest_input() + 1.0) - inputs;
        (most_together / together.max(SMALLEST)).min(LARGEST_FACTOR / largest.max(SMALLEST))
    }

    /// Words of the panels that a product of up to [`ROWS`] rows reads.
    pub(super) fn inputs_len(self) -> usize {
        let factors = self.products.factors();
        self.groups * panels_len(self.words * factors) / factors
    }

    /// Values of the panels that it writes.
    pub(super) fn outputs_len(self) -> usize {
        panels_len(self.outputs)
    }

    /// Writes the products of the first `rows` rows of the panels `inputs`, and possibly of some after them, to the
    /// panels `outputs`.
    #[inline(always)]
    pub(super) fn multiply<S: Simd>(self, simd: S, rows: usize, inputs: &[f32], weights: &[f32], outputs: &mut [f32]) {
        assert!(rows <= ROWS && inputs.len() == self.inputs_len());
        assert!(weights.len() == self.weights_len() && outputs.len() == self.outputs_len());
        for first in (0..self.outputs).step_by(Block::most_channels(S::LANES)) {
            let block = Block::of(first, self.outputs, S::LANES);
            let depth = self.groups * self.words;
            let weights = &weights[first * depth..][..block.channels * depth];
            let outputs = &mut outputs[first / PANEL * ROWS * PANEL + first % PANEL..];
            // Sums, weights and one input fit the registers: 16, or 32 with 16 lanes.
            match (block.channels * block.words_together / S::LANES, block.words_together, S::LANES) {
                (2, 1, 16) => kernel::<S, 2, 1, 8>(simd, self, rows, inputs, weights, outputs),
                (2, 1, _) => kernel::<S, 2, 1, 6>(simd, self, rows, inputs, weights, outputs),
                (_, 1, _) => kernel::<S, 1, 1, 8>(simd, self, rows, inputs, weights, outputs),
                (3, _, _) => kernel::<S, 3, PAIR, 8>(simd, self, rows, inputs, weights, outputs),
                (_, _, _) => kernel::<S, 1, PAIR, 12>(simd, self, rows, inputs, weights, outputs),
            }
        }
    }
}

/// What values are multiplied by to become integers up to `largest`, by the largest magnitude that a lane of
/// `magnitudes` has, and its reciprocal. One of the two is no finite number where one of the lanes is none.
#[inline(always)]
pub(super) fn integers_scale<S: Simd>(simd: S, magnitudes: S::Vector, largest: f32) -> [f32; 2] {
    let mut lanes = [0.0; MOST_LANES];
    simd.write(&mut lanes, magnitudes);
    let mut found = SMALLEST.to_bits();
    for magnitude in lanes {
        found = found.max(magnitude.to_bits());
    }
    let found = f32::from_bits(found);
    [largest / found, found / largest]
}

/// Values of the panels of [`ROWS`] rows of `channels`.
pub(super) const fn panels_len(channels: usize) -> usize {
    channels.div_ceil(PANEL) * ROWS * PANEL
}

/// Where panels have a channel of a row.
#[inline(always)]
pub(super) const fn panel_place(row: usize, channel: usize) -> usize {
    (channel / PANEL * ROWS + row) * PANEL + channel % PANEL
}

/// Output channels that are computed together: two vectors of them, or the rest.
///
/// An odd number of half vectors, which a rest has at 16 lanes only, would leave lanes idle. There each output channel
/// takes two neighbouring lanes, one for the sum over even words and one for that over odd ones: 24 channels fill three
/// vectors of 16 lanes, each step takes two words, and `add_pairs` joins the two sums at the end.
struct Block {
    first: usize,
    channels: usize,
    /// Words that each step takes: [`PAIR`] or 1.
    words_together: usize,
}

impl Block {
    const fn most_channels(lanes: usize) -> usize {
        2 * lanes
    }

    /// The block in which an output channel falls.
    fn of(output: usize, outputs: usize, lanes: usize) -> Self {
        let most = Self::most_channels(lanes);
        let first = output - output % most;
        let channels = most.min(outputs - first);
        Self { first, channels, words_together: if channels.is_multiple_of(lanes) { 1 } else { PAIR } }
    }
}

/// One block of V vectors of sums, of I words together, P rows at a time.
#[inline(always)]
fn kernel<S: Simd, const V: usize, const I: usize, const P: usize>(
    simd: S,
    shape: Shape,
    rows: usize,
    inputs: &[f32],
    weights: &[f32],
    outputs: &mut [f32],
) {
    let Shape { groups, words: group_words, .. } = shape;
    let panel_words = PANEL / S::FACTORS;
    let panels = group_words.div_ceil(panel_words);
    let rows = rows.next_multiple_of(P);
    assert!(rows <= ROWS && group_words.is_multiple_of(I) && inputs.len() == groups * panels * ROWS * panel_words);
    assert!(weights.len() * I == groups * group_words * V * S::LANES);
    assert!(outputs.len() >= (rows - P.min(rows)) * PANEL + (P - 1) * PANEL + V.div_ceil(I) * S::LANES);
    for row in (0..rows).step_by(P) {
        // Bounds checks in this loop would cost more than its arithmetic.
        // SAFETY: the panels hold ROWS rows, of which `row + P - 1` is one, and a panel is read below its width, of
        // which I is a divisor; the weights' rows are walked once, in order, and are as many as words. What is written
        // lies below `outputs.len()`. All was asserted above.
        unsafe {
            let mut sums = [[simd.splat(0.0); V]; P];
            let mut weight_row = weights.as_ptr();
            for panel in 0..groups * panels {
                let from = inputs.as_ptr().add((panel * ROWS + row) * panel_words);
                let used = (group_words - panel % panels * panel_words).min(panel_words);
                let mut from = from;
                let end = from.add(used);
                while from < end {
                    for _ in 0..PAIR / I {
                        let weights: [S::Vector; V] = simd.load_strided(weight_row, S::LANES);
                        weight_row = weight_row.add(V * S::LANES);
                        for (row, sums) in sums.iter_mut().enumerate() {
                            let word = from.add(row * panel_words);
                            let value = if I == PAIR { simd.splat_pair(word) } else { simd.splat(*word) };
                            for (sum, weight) in sums.iter_mut().zip(weights) {
                                *sum = simd.mul_add_factors(value, weight, *sum);
                            }
                        }
                        from = from.add(I);
                    }
                }
            }
            for (index, sums) in sums.into_iter().enumerate() {
                let mut values = sums;
                for (value, sum) in values.iter_mut().zip(sums) {
                    *value = simd.values_of_sums(sum);
                }
                for (vector, sums) in values.chunks(I).enumerate() {
                    let sum = match *sums {
                        [sum] if I == 1 => sum,
                        [sum] => simd.add_pairs(sum, simd.splat(0.0)),
                        [first, second, ..] => simd.add_pairs(first, second),
                        [] => unreachable!("chunks are not empty"),
                    };
                    simd.store(outputs.as_mut_ptr().add((row + index) * PANEL + vector * S::LANES), sum);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::Task;

    /// Multiplies rows of the largest integers with weights that are all `weight`.
    struct Largest<'a> {
        shape: Shape,
        inputs: usize,
        weight: f32,
        output: &'a mut f32,
    }

    impl Task for Largest<'_> {
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            let Self { shape, inputs, weight, output } = self;
            let (mut weights, mut words) = (vec![0.0; shape.weights_len()], vec![0.0; shape.inputs_len()]);
            let mut outputs = vec![0.0; shape.outputs_len()];
            for input in 0..inputs {
                shape.set_weight(&mut weights, [0, input, 0], weight);
                let word = &mut words[panel_place(0, input) / S::FACTORS];
                shape.products.set_factor(word, input % S::FACTORS, shape.largest_input());
            }
            shape.multiply(simd, 1, &words, &weights, &mut outputs);
            *output = outputs[0];
        }
    }

    #[test]
    fn the_largest_sum_of_integers_does_not_overflow_and_little_more_would() {
        for products in Products::available().filter(|products| products.integers()) {
            for inputs in [1, 2, 31, 288, 1000] {
                // Outputs of whole blocks: none has two sums.
                let shape = Shape::new(1, inputs, 32, products);
                let scale = shape.weights_scale(0.7, 0.7 * inputs as f32);
                let sum_of = |weight: f32| {
                    let mut sum = 0.0;
                    products.run(Largest { shape, inputs, weight, output: &mut sum });
                    f64::from(sum)
                };
                let expected = f64::from(shape.largest_input()) * f64::from((0.7 * scale).round()) * inputs as f64;
                let context = format!("{inputs} on {}: {} of {expected}", products.name(), sum_of(0.7 * scale));
                assert!((sum_of(0.7 * scale) - expected).abs() < 1e-3 * expected, "{context}");
                // One or two inputs' weights are bounded by their own 16 bits.
                assert!(inputs < 3 || sum_of(0.77 * scale) < 0.0, "{context}");
            }
        }
    }
}
