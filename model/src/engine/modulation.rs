//! How the pupil changes the offset prediction of an adjustable layer.

use crate::weights::{Adjustable, Dense, OFFSET_CHANNELS};

/// The offset prediction's parameters W0 ⊙ (1 + γ(s)) and b0 + β(s), for one pupil s at a time. Nothing is allocated
/// after `new`.
pub(super) struct Modulation {
    parameters: Adjustable,
    leaky_slope: f32,
    /// The pupil that `weight` and `bias` are for.
    pupil_mm: f32,
    hidden: [Vec<f32>; 2],
    /// γ [18, in], then β [18].
    gamma_beta: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

/// The 3x3 convolution that predicts offsets, for one pupil.
pub(super) struct OffsetParameters<'a> {
    /// [18, in, 3, 3]
    pub(super) weight: &'a [f32],
    /// [18]
    pub(super) bias: &'a [f32],
}

impl Modulation {
    pub(super) fn new(parameters: &Adjustable, leaky_slope: f32) -> Self {
        let [first, second, last] = &parameters.modulation;
        Self {
            leaky_slope,
            pupil_mm: f32::NAN,
            hidden: [first, second].map(|layer| vec![0.0; layer.bias.len()]),
            gamma_beta: vec![0.0; last.bias.len()],
            weight: vec![0.0; parameters.offset_weight.len()],
            bias: vec![0.0; OFFSET_CHANNELS],
            parameters: parameters.clone(),
        }
    }

    /// The parameters for a pupil; `None` if they are those that were given last.
    pub(super) fn change_to(&mut self, pupil_mm: f32) -> Option<OffsetParameters<'_>> {
        if self.pupil_mm == pupil_mm {
            return None;
        }
        let Self { parameters, leaky_slope, hidden: [first, second], gamma_beta, weight, bias, .. } = self;
        let [to_first, to_second, to_gamma_beta] = &parameters.modulation;
        let leaky = |values: &mut [f32]| values.iter_mut().for_each(|value| *value = value.max(*value * *leaky_slope));
        to_first.run(&[(pupil_mm - 3.0) / 2.0], first);
        leaky(first);
        to_second.run(first, second);
        leaky(second);
        to_gamma_beta.run(second, gamma_beta);

        let (gamma, beta) = gamma_beta.split_at(gamma_beta.len() - OFFSET_CHANNELS);
        let kernels = weight.as_chunks_mut::<9>().0.iter_mut().zip(parameters.offset_weight.as_chunks::<9>().0);
        for ((kernel, unmodulated), gamma) in kernels.zip(gamma) {
            *kernel = unmodulated.map(|weight| weight * (1.0 + gamma));
        }
        for ((bias, unmodulated), beta) in bias.iter_mut().zip(&parameters.offset_bias).zip(beta) {
            *bias = unmodulated + beta;
        }
        self.pupil_mm = pupil_mm;
        Some(OffsetParameters { weight: &self.weight, bias: &self.bias })
    }
}

impl Dense {
    fn run(&self, inputs: &[f32], outputs: &mut [f32]) {
        for ((output, weights), bias) in outputs.iter_mut().zip(self.weight.chunks_exact(self.inputs)).zip(&self.bias) {
            *output = bias + weights.iter().zip(inputs).map(|(weight, input)| weight * input).sum::<f32>();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SLOPE: f32 = 0.1;

    /// For two input channels, with one hidden value each time: s' = (s − 3)/2, h = leaky(2·leaky(s')), γ and β by the
    /// number of their place.
    fn parameters() -> Adjustable {
        let dense = |inputs, weight: Vec<f32>, bias: f32| Dense { inputs, bias: vec![bias; weight.len()], weight };
        let places = OFFSET_CHANNELS * 2;
        Adjustable {
            offset_weight: (0..places * 9).map(|index| index as f32).collect(),
            offset_bias: (0..OFFSET_CHANNELS).map(|output| -(output as f32)).collect(),
            modulation: [
                dense(1, vec![1.0], 0.0),
                dense(1, vec![2.0], 0.0),
                dense(1, (0..places + OFFSET_CHANNELS).map(|index| index as f32).collect(), 0.25),
            ],
        }
    }

    /// The largest difference between `found` and what the definition gives for a hidden value.
    fn largest_difference(found: &OffsetParameters<'_>, hidden: f32) -> f32 {
        let of_place = |place: usize| place as f32 * hidden + 0.25;
        let weight = found.weight.iter().enumerate();
        let weight = weight.map(|(index, weight)| weight - index as f32 * (1.0 + of_place(index / 9)));
        let bias = found.bias.iter().enumerate();
        let bias = bias.map(|(output, bias)| bias - (of_place(OFFSET_CHANNELS * 2 + output) - output as f32));
        assert_eq!((weight.len(), bias.len()), (OFFSET_CHANNELS * 2 * 9, OFFSET_CHANNELS));
        weight.chain(bias).fold(0.0, |largest, difference| largest.max(difference.abs()))
    }

    #[test]
    fn parameters_are_given_once_for_each_pupil() {
        let mut modulation = Modulation::new(&parameters(), SLOPE);
        for (pupil_mm, hidden) in [(5.0, 2.0), (4.0, 1.0), (1.0, -0.02), (5.0, 2.0)] {
            let found = modulation.change_to(pupil_mm).unwrap();
            assert!(largest_difference(&found, hidden) < 1e-3, "{pupil_mm} mm");
            assert!(largest_difference(&found, hidden + 0.01) > 1e-3, "{pupil_mm} mm: the comparison is blind");
            assert!(modulation.change_to(pupil_mm).is_none(), "{pupil_mm} mm");
        }
    }
}
