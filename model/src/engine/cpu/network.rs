//! One frame through the network, stage by stage, to the field on the panel's grid.

use std::time::{Duration, Instant};

use holod_calibration::{Colour, PupilDiameter, Resolution};
use num_complex::Complex32;

use super::blocks::scale_of;
use super::direct::Direct;
use super::expected_stack::ExpectedStack;
use super::trunk::Trunk;
use crate::engine::{Stage, StageTiming, StageTimings};
use crate::optics::FourierUpsampler;
use crate::simd::InstructionSet;
use crate::weights::{Family, Grid, Weights};
use crate::{ComplexHologram, RgbdFrame};

/// Everything that one frame needs; nothing is allocated after `new`.
pub(super) struct Network {
    pupil_range_mm: [f32; 2],
    /// The frame's size, and that rounded up to what the grid needs.
    resolution: Resolution,
    padded: Resolution,
    pub(super) predictor: Predictor,
    upsampler: Option<FourierUpsampler>,
    /// One colour at `padded`, where that differs from `resolution`.
    uncropped: Vec<Complex32>,
    pub(super) timings: StageTimings,
}

/// A family's way to the field on the network's grid.
pub(super) enum Predictor {
    Direct(Box<Direct>),
    ExpectedStack(Box<ExpectedStack>),
}

impl Predictor {
    fn stages(&self) -> Vec<Stage> {
        match self {
            Self::Direct(direct) => direct.stages(),
            Self::ExpectedStack(expected_stack) => expected_stack.stages(),
        }
    }

    pub(super) fn run_stage(&mut self, index: usize, frame: &RgbdFrame, pupil_mm: f32) {
        match self {
            Self::Direct(direct) => direct.run_stage(index, frame, pupil_mm),
            Self::ExpectedStack(expected_stack) => expected_stack.run_stage(index, frame, pupil_mm),
        }
    }

    fn write_field(&self, colour: Colour, field: &mut [Complex32]) {
        match self {
            Self::Direct(direct) => direct.write_field(colour, field),
            Self::ExpectedStack(expected_stack) => expected_stack.write_field(colour, field),
        }
    }
}

impl Network {
    pub(super) fn new(weights: &Weights, resolution: Resolution, set: InstructionSet) -> Self {
        let config = &weights.config;
        let scale = scale_of(config.grid);
        let size @ (width, height) = (resolution.width.div_ceil(scale), resolution.height.div_ceil(scale));
        let padded = Resolution { width: scale * width, height: scale * height };
        let predictor = match &weights.family {
            Family::Direct { layers } => Predictor::Direct(Box::new(Direct::new(config, layers, size, set))),
            Family::ExpectedStack { lighting, correction, feedback } => {
                let nets = [lighting, correction].map(|layers| Trunk::new(layers, config.leaky_slope, size, set));
                Predictor::ExpectedStack(Box::new(ExpectedStack::new(config, nets, *feedback, size, set)))
            }
        };
        let stages = predictor.stages().into_iter().chain([Stage::plain("field")]);
        let timed = |Stage { name, flop }| StageTiming { name, duration: Duration::ZERO, flop };
        Self {
            pupil_range_mm: config.pupil_range_mm,
            resolution,
            padded,
            timings: StageTimings { stages: stages.map(timed).collect() },
            predictor,
            upsampler: (config.grid == Grid::HalfBand).then(|| FourierUpsampler::new(padded)),
            uncropped: if padded == resolution { Vec::new() } else { vec![Complex32::ZERO; padded.pixels()] },
        }
    }

    /// One frame; `frame` and `hologram` have the network's resolution. Pupils outside the range that the weights were
    /// trained for are taken as the nearest one inside.
    pub(super) fn render(&mut self, frame: &RgbdFrame, pupil: PupilDiameter, hologram: &mut ComplexHologram) {
        let pupil_mm = pupil.mm().clamp(self.pupil_range_mm[0], self.pupil_range_mm[1]);
        let mut stage_begin = Instant::now();
        for index in 0..self.timings.stages.len() {
            if index + 1 < self.timings.stages.len() {
                self.predictor.run_stage(index, frame, pupil_mm);
            } else {
                Colour::ALL.into_iter().for_each(|colour| self.write_field(colour, hologram.plane_mut(colour)));
            }
            let now = Instant::now();
            self.timings.stages[index].duration = now - stage_begin;
            stage_begin = now;
        }
    }

    /// The predicted field of one colour at the frame's resolution.
    fn write_field(&mut self, colour: Colour, plane: &mut [Complex32]) {
        let Some(upsampler) = &mut self.upsampler else { return self.predictor.write_field(colour, plane) };
        self.predictor.write_field(colour, upsampler.input());
        if self.padded == self.resolution {
            return upsampler.upsample(plane);
        }
        upsampler.upsample(&mut self.uncropped);
        let cropped_rows = self.uncropped.chunks_exact(self.padded.width);
        for (row, from) in plane.chunks_exact_mut(self.resolution.width).zip(cropped_rows) {
            row.copy_from_slice(&from[..self.resolution.width]);
        }
    }
}

/// What a stage has just written, for tests that look inside.
#[cfg(test)]
pub(super) enum Seen<'a> {
    /// A layer's map, and the offsets of an adjustable one; or what the first layer reads.
    Map(&'a super::feature_map::FeatureMap, Option<&'a super::feature_map::FeatureMap>),
    /// A field on the network's grid, [3, height, width].
    Light(&'a [Complex32]),
}

#[cfg(test)]
impl Predictor {
    pub(super) fn after(&self, stage: usize) -> Seen<'_> {
        match self {
            Self::Direct(direct) => direct.after(stage),
            Self::ExpectedStack(expected_stack) => expected_stack.after(stage),
        }
    }
}
