//! The list of a network's stages, and the loop that runs them.

use std::time::{Duration, Instant};

use super::stage::{Buffers, Job, Maps, Shared, Stage};
use crate::engine::{StageTiming, StageTimings};

/// The stages of a network in the order in which they run, and what they share.
pub(super) struct StageList<F: Shared> {
    stages: Vec<Box<dyn Stage<F>>>,
    buffers: Buffers<F>,
}

impl<F: Shared> StageList<F> {
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

/// A [`StageList`] of some family that makes holograms of `I`.
pub(super) trait Stages<I>: Send + Sync {
    /// What the stages are called and cost.
    fn untimed(&self) -> StageTimings;

    /// Renders a frame and writes how long each stage took.
    fn run(&mut self, job: &mut Job<'_, I>, timings: &mut StageTimings);

    /// Renders a frame and shows what each stage has written, by its name.
    #[cfg(test)]
    fn run_seen(&mut self, job: &mut Job<'_, I>, look: &mut dyn FnMut(&str, super::stage::Seen<'_>));
}

impl<F: Shared> Stages<F::Input> for StageList<F> {
    fn untimed(&self) -> StageTimings {
        let stages = self.stages.iter().map(|stage| StageTiming {
            name: stage.name().into(),
            duration: Duration::ZERO,
            flop: stage.flop(),
            bytes: stage.bytes(),
        });
        StageTimings { stages: stages.collect() }
    }

    fn run(&mut self, job: &mut Job<'_, F::Input>, timings: &mut StageTimings) {
        let mut stage_begin = Instant::now();
        for (stage, timing) in self.stages.iter_mut().zip(&mut timings.stages) {
            stage.run(&mut self.buffers, job);
            let now = Instant::now();
            timing.duration = now - stage_begin;
            stage_begin = now;
        }
    }

    #[cfg(test)]
    fn run_seen(&mut self, job: &mut Job<'_, F::Input>, look: &mut dyn FnMut(&str, super::stage::Seen<'_>)) {
        for stage in &mut self.stages {
            stage.run(&mut self.buffers, job);
            look(stage.name(), stage.seen(&self.buffers, job));
        }
    }
}
