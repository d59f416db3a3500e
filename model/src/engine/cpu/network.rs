//! One frame through the network, stage by stage, to the field on the panel's grid.

use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};

use super::stage::Job;
use super::stage_list::Stages;
use super::{direct, expected_stack, focal_stack};
use crate::conditions::{Conditions, TrainedRange};
use crate::engine::{EngineError, StageTimings};
use crate::scene::FocalStack;
use crate::simd::Products;
use crate::weights::{Family, Weights};
use crate::{ComplexHologram, RgbdFrame};

/// Everything that one hologram of `I` needs; nothing is allocated after `new`.
pub(super) struct Network<I> {
    trained: TrainedRange,
    bench: DisplayGeometry,
    pub(super) stages: Box<dyn Stages<I>>,
    pub(super) timings: StageTimings,
}

impl Network<RgbdFrame> {
    /// For frames of `resolution`.
    ///
    /// # Errors
    /// [`EngineError::Family`].
    pub(super) fn of_frames(
        weights: &Weights,
        bench: &DisplayGeometry,
        resolution: Resolution,
        products: Products,
    ) -> Result<Self, EngineError> {
        let config = &weights.config;
        let stages: Box<dyn Stages<RgbdFrame>> = match &weights.family {
            Family::Direct { layers } => Box::new(direct::stages(config, layers, resolution, products)),
            Family::ExpectedStack { lighting, correction, feedback } => {
                Box::new(expected_stack::stages(config, bench, [lighting, correction], *feedback, resolution, products))
            }
            Family::FocalStack { .. } => return Err(EngineError::takes_focal_stacks()),
        };
        Ok(Self::new(weights, bench, stages))
    }
}

impl Network<FocalStack> {
    /// For images of `resolution`.
    ///
    /// # Errors
    /// [`EngineError::Family`].
    pub(super) fn of_focal_stacks(
        weights: &Weights,
        bench: &DisplayGeometry,
        resolution: Resolution,
        products: Products,
    ) -> Result<Self, EngineError> {
        let Family::FocalStack { lighting, correction, feedback_share } = &weights.family else {
            return Err(EngineError::takes_frames(weights.config.architecture));
        };
        let nets = [&lighting[..], correction];
        let stages = focal_stack::stages(&weights.config, bench, nets, *feedback_share, resolution, products);
        Ok(Self::new(weights, bench, Box::new(stages)))
    }
}

impl<I> Network<I> {
    fn new(weights: &Weights, bench: &DisplayGeometry, stages: Box<dyn Stages<I>>) -> Self {
        Self { trained: weights.config.trained, bench: *bench, timings: stages.untimed(), stages }
    }

    /// One frame; `input` and `hologram` have the network's resolution.
    pub(super) fn render(&mut self, input: &I, pupil: PupilDiameter, hologram: &mut ComplexHologram) {
        let conditions = self.conditions(pupil);
        self.stages.run(&mut Job { input, pupil_mm: pupil.mm(), conditions, hologram }, &mut self.timings);
    }

    /// What the network is told of the bench and a pupil.
    pub(super) fn conditions(&self, pupil: PupilDiameter) -> Conditions {
        Conditions::of(&self.trained, &self.bench, pupil)
    }
}
