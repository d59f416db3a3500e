//! Winograd's F(4, 3): four outputs of a line from six inputs and three weights by six products for twelve.
//!
//! Outputs, inputs and weights are taken as polynomials' coefficients, and products are made of values at six points
//! (A. Lavin and S. Gray, "Fast algorithms for convolutional neural networks", CVPR 2016). Points of ±3/4 and ±3/2 lose
//! less to rounding than the usual ±1 and ±2, three quarters of it in half precision.

use super::plan::Constant;

/// Values that a line's three weights become.
pub(super) const POINTS: usize = 6;
const POINT_A: f32 = 0.75;
const POINT_B: f32 = 1.5;

/// The constants of `winograd.wgsl`.
pub(super) fn constants() -> [(&'static str, Constant); 2] {
    [("POINT_A", POINT_A.into()), ("POINT_B", POINT_B.into())]
}

/// `text` for numbers of the type `number`, after `winograd.wgsl`.
pub(super) fn source(number: &str, text: &str) -> String {
    format!("alias Number = {number};\nalias Vector = vec4<Number>;\n\n{}\n{text}", include_str!("winograd.wgsl"))
}

/// The same with `winograd_rows.wgsl`.
pub(super) fn source_with_rows(number: &str, text: &str) -> String {
    source(number, &[include_str!("winograd_rows.wgsl"), "\n", text].concat())
}

/// Three weights of a line at the points, with the factors by which the outputs are found from products there.
pub(super) fn at_points(weights: [f32; 3]) -> [f32; POINTS] {
    let [first, second, third] = weights;
    let (a, b) = (POINT_A * POINT_A, POINT_B * POINT_B);
    let at = |point: f32, scale: f32| (first + point * second + point * point * third) / scale;
    let (scale_a, scale_b) = (2.0 * a * (a - b), 2.0 * b * (b - a));
    [first / (a * b), at(POINT_A, scale_a), at(-POINT_A, scale_a), at(POINT_B, scale_b), at(-POINT_B, scale_b), third]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four outputs of a line as the shader makes them, here in double precision.
    fn outputs(inputs: [f64; POINTS], weights: [f32; 3]) -> [f64; 4] {
        let (a, b) = (f64::from(POINT_A), f64::from(POINT_B));
        let (square_a, square_b) = (a * a, b * b);
        let [odd_a, odd_b] = [square_b, square_a].map(|square| inputs[3] - square * inputs[1]);
        let [even_a, even_b] = [square_b, square_a].map(|square| inputs[4] - square * inputs[2]);
        let ends = [0, 1].map(|first| {
            square_a * square_b * inputs[first] - (square_a + square_b) * inputs[first + 2] + inputs[first + 4]
        });
        let values = [ends[0], a * odd_a + even_a, even_a - a * odd_a, b * odd_b + even_b, even_b - b * odd_b, ends[1]];
        let mut products = at_points(weights).map(f64::from);
        products.iter_mut().zip(values).for_each(|(product, value)| *product *= value);
        let power = |row: i32| {
            let [first, second, third, fourth] = [a, -a, b, -b].map(|point| point.powi(row));
            first * products[1] + second * products[2] + third * products[3] + fourth * products[4]
        };
        [products[0] + power(0), power(1), power(2), power(3) + products[5]]
    }

    #[test]
    fn four_outputs_are_the_sums_of_three_products_each() {
        let weights = [0.3, -0.7, 0.2_f32];
        let inputs = [0.9, -0.4, 0.1, 0.8, -0.6, 0.5];
        for (row, output) in outputs(inputs, weights).into_iter().enumerate() {
            let expected: f64 = (0..3).map(|tap| f64::from(weights[tap]) * inputs[row + tap]).sum();
            assert!((output - expected).abs() < 1e-6, "row {row}: {output}, expected {expected}");
            let others = outputs(inputs, [0.3, -0.7, 0.21]);
            assert!((others[row] - expected).abs() > 1e-4, "another weight is seen in row {row}");
        }
    }
}
