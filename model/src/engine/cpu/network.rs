//! One frame through the network, stage by stage, to the field on the panel's grid.

use std::time::{Duration, Instant};

use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};

use super::stage::{Buffers, Job, Maps, Stage};
use super::{direct, expected_stack};
use crate::conditions::{Conditions, TrainedRange};
use crate::engine::{StageTiming, StageTimings};
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

/// The stages of a network in the order in which they run, and what they share.
pub(super) struct StageList<F> {
    stages: Vec<Box<dyn Stage<F>>>,
    buffers: Buffers<F>,
}

impl<F> StageList<F> {
    pub(super) fn new(maps: Maps, family: F) -> Self {
        Self { stages: Vec::new(), buffers: Buffers { maps, family } }
    }

    pub(super) fn then(mut self, stage: impl Stage<F> + 'static) -> Self {
        self.stages.push(Box::new(stage));
        self
    }

    pub(super) fn then_each(self, stages: impl IntoIterator<Item = impl Stage<F> + 'static>) -> Self {
        stages.into_iter().fold(self, Self::then)
    }
}

/// A [`StageList`] of some family.
pub(super) trait Stages: Send + Sync {
    /// What the stages are called and cost.
    fn untimed(&self) -> StageTimings;

    /// Renders a frame and writes how long each stage took.
    fn run(&mut self, job: &mut Job<'_>, timings: &mut StageTimings);

    /// Renders a frame and shows what each stage has written, by its name.
    #[cfg(test)]
    fn run_seen(&mut self, job: &mut Job<'_>, look: &mut dyn FnMut(&str, super::stage::Seen<'_>));
}

impl<F: Send + Sync> Stages for StageList<F> {
    fn untimed(&self) -> StageTimings {
        let stages = self.stages.iter().map(|stage| StageTiming {
            name: stage.name().into(),
            duration: Duration::ZERO,
            flop: stage.flop(),
            bytes: stage.bytes(),
        });
        StageTimings { stages: stages.collect() }
    }

    fn run(&mut self, job: &mut Job<'_>, timings: &mut StageTimings) {
        let mut stage_begin = Instant::now();
        for (stage, timing) in self.stages.iter_mut().zip(&mut timings.stages) {
            stage.run(&mut self.buffers, job);
            let now = Instant::now();
            timing.duration = now - stage_begin;
            stage_begin = now;
        }
    }

    #[cfg(test)]
    fn run_seen(&mut self, job: &mut Job<'_>, look: &mut dyn FnMut(&str, super::stage::Seen<'_>)) {
        for stage in &mut self.stages {
            stage.run(&mut self.buffers, job);
            look(stage.name(), stage.seen(&self.buffers, job));
        }
    }
}
