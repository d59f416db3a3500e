//! How bench and pupil change the offset prediction of an adjustable layer.

use crate::conditions::Conditions;
use crate::weights::{Adjustable, Dense, OFFSET_CHANNELS};

/// The offset prediction's parameters W0 ⊙ (1 + γ(c)) and b0 + β(c), for the conditions c of one bench and pupil at a
/// time. Nothing is allocated after `new`.
pub(super) struct Modulation {
    parameters: Adjustable,
    leaky_slope: f32,
    /// What `weight` and `bias` are for, once there is something in them.
    conditions: Option<Conditions>,
    hidden: [Vec<f32>; 2],
    /// γ [18, in], then β [18].
    gamma_beta: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

/// The 3x3 convolution that predicts offsets, for one bench and pupil.
pub(super) struct OffsetParameters<'a> {
    /// [18, in, 3, 3]
    pub(super) weight: &'a [f32],
    /// Of each offset, [18].
    pub(super) bias: &'a [f32],
}

impl Modulation {
    pub(super) fn new(parameters: &Adjustable, leaky_slope: f32) -> Self {
        let [first, second, last] = &parameters.modulation;
        Self {
            leaky_slope,
            conditions: None,
            hidden: [first, second].map(|layer| vec![0.0; layer.bias.len()]),
            gamma_beta: vec![0.0; last.bias.len()],
            weight: vec![0.0; parameters.offset_weight.len()],
            bias: vec![0.0; OFFSET_CHANNELS],
            parameters: parameters.clone(),
        }
    }

    /// The parameters for a bench and a pupil; `None` if they are those that were given last.
    pub(super) fn change_to(&mut self, conditions: Conditions) -> Option<OffsetParameters<'_>> {
        if self.conditions == Some(conditions) {
            return None;
        }
        let Self { parameters, leaky_slope, hidden: [first, second], gamma_beta, weight, bias, .. } = self;
        let [to_first, to_second, to_gamma_beta] = &parameters.modulation;
        let leaky = |values: &mut [f32]| values.iter_mut().for_each(|value| *value = value.max(*value * *leaky_slope));
        to_first.run(&conditions.told().map(|value| value as f32), first);
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
        self.conditions = Some(conditions);
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
    use crate::worst::worst;

    const SLOPE: f32 = 0.1;

    /// For two input channels, with one hidden value each time: h = leaky(2·leaky(blur + 4·fresnel)), γ and β by the
    /// number of their place.
    fn parameters() -> Adjustable {
        let dense =
            |inputs, weight: Vec<f32>, bias: f32| Dense { inputs, bias: vec![bias; weight.len() / inputs], weight };
        let places = OFFSET_CHANNELS * 2;
        Adjustable {
            offset_weight: (0..places * 9).map(|index| index as f32).collect(),
            offset_bias: (0..OFFSET_CHANNELS).map(|output| -(output as f32)).collect(),
            modulation: [
                dense(2, vec![1.0, 4.0], 0.0),
                dense(1, vec![2.0], 0.0),
                dense(1, (0..places + OFFSET_CHANNELS).map(|index| index as f32).collect(), 0.25),
            ],
        }
    }

    /// The largest difference between `found` and what the definition gives for a hidden value.
    fn largest_difference(found: &OffsetParameters<'_>, hidden: f32) -> f64 {
        let of_place = |place: usize| place as f32 * hidden + 0.25;
        let weight = found.weight.iter().enumerate();
        let weight = weight.map(|(index, weight)| weight - index as f32 * (1.0 + of_place(index / 9)));
        let bias = found.bias.iter().enumerate();
        let bias = bias.map(|(output, bias)| bias - (of_place(OFFSET_CHANNELS * 2 + output) - output as f32));
        assert_eq!((weight.len(), bias.len()), (OFFSET_CHANNELS * 2 * 9, OFFSET_CHANNELS));
        worst(weight.chain(bias).map(f32::abs))
    }

    #[test]
    fn parameters_are_given_once_for_each_bench_and_pupil() {
        let mut modulation = Modulation::new(&parameters(), SLOPE);
        for (blur, fresnel, hidden) in [(1.0, 0.0, 2.0), (0.5, 0.0, 1.0), (-1.0, 0.0, -0.02), (1.0, 0.25, 4.0)] {
            let conditions = Conditions { blur, fresnel };
            let found = modulation.change_to(conditions).unwrap();
            assert!(largest_difference(&found, hidden) < 1e-3, "{conditions:?}");
            assert!(largest_difference(&found, hidden + 0.01) > 1e-3, "{conditions:?}: the comparison is blind");
            assert!(modulation.change_to(conditions).is_none(), "{conditions:?}");
        }
    }
}
