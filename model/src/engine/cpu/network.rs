//! One frame through the network, stage by stage, to the field on the panel's grid.

use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};

use super::stage::Job;
use super::stage_list::Stages;
use super::{direct, expected_stack};
use crate::conditions::{Conditions, TrainedRange};
use crate::engine::StageTimings;
use crate::simd::InstructionSet;
use crate::weights::{Family, Weights};
use crate::{ComplexHologram, RgbdFrame};

/// Everything that one frame needs; nothing is allocated after `new`.
pub(super) struct Network {
    trained: TrainedRange,
    bench: DisplayGeometry,
    pub(super) stages: Box<dyn Stages>,
    pub(super) timings: StageTimings,
}

impl Network {
    pub(super) fn new(weights: &Weights, bench: &DisplayGeometry, resolution: Resolution, set: InstructionSet) -> Self {
        let config = &weights.config;
        let stages: Box<dyn Stages> = match &weights.family {
            Family::Direct { layers } => Box::new(direct::stages(config, layers, resolution, set)),
            Family::ExpectedStack { lighting, correction, feedback } => {
                Box::new(expected_stack::stages(config, bench, [lighting, correction], *feedback, resolution, set))
            }
        };
        Self { trained: config.trained, bench: *bench, timings: stages.untimed(), stages }
    }

    /// One frame; `frame` and `hologram` have the network's resolution.
    pub(super) fn render(&mut self, frame: &RgbdFrame, pupil: PupilDiameter, hologram: &mut ComplexHologram) {
        let conditions = self.conditions(pupil);
        self.stages.run(&mut Job { frame, pupil_mm: pupil.mm(), conditions, hologram }, &mut self.timings);
    }

    /// What the network is told of the bench and a pupil.
    pub(super) fn conditions(&self, pupil: PupilDiameter) -> Conditions {
        Conditions::of(&self.trained, &self.bench, pupil)
    }
}
