//! A network's plan: its stages in their order.

use holod_calibration::{DisplayGeometry, LevelTables, PupilDiameter, Resolution};

use super::expected_stack::ExpectedStack;
use super::fft::WorkgroupLimits;
use super::input_features::InputChannels;
use super::plan::{BufferId, Plan};
use super::shared::Shared;
use super::trunk::{self, Features, Modulated};
use super::upsample::Low;
use super::{direct, double_phase, levels, upsample};
use crate::conditions::{Conditions, TrainedRange};
use crate::engine::EngineError;
use crate::weights::{Family, Grid, Weights};

/// A network with double phase and one panel's levels.
pub(crate) struct NetworkPlan {
    pub(crate) plan: Plan,
    pub(super) shared: Shared,
    trained: TrainedRange,
    bench: DisplayGeometry,
    pub(super) modulated: Vec<Modulated>,
    /// [3, height, width], radians.
    pub(super) phases: BufferId,
    /// The panel's samples, two to 32 bits.
    pub(super) samples: BufferId,
    /// How many samples of each colour were clipped, and how many are out of the panel's reach: zero before a frame.
    pub(super) clipped: BufferId,
    pub(super) unreachable: BufferId,
}

impl NetworkPlan {
    /// On `bench`, for frames of the pattern's size of `tables`, on a device of these limits.
    ///
    /// # Errors
    /// The size is nothing, or too large for that memory; or the weights take focal stacks.
    pub(crate) fn new(
        weights: &Weights,
        bench: &DisplayGeometry,
        tables: &LevelTables,
        features: Features,
        limits: WorkgroupLimits,
    ) -> Result<Self, EngineError> {
        let (resolution, config) = (tables.pattern, &weights.config);
        if resolution.pixels() == 0 {
            return Err(EngineError::Empty { resolution });
        }
        let scale: usize = match config.grid {
            Grid::HalfBand => 2,
            Grid::Full => 1,
        };
        let size = Resolution { width: resolution.width.div_ceil(scale), height: resolution.height.div_ceil(scale) };
        let mut plan = Plan::default();
        let shared = Shared::new(&mut plan, resolution, size, features.format.precision());
        let mut modulated = Vec::new();
        let mut net = |plan: &mut Plan, prefix: &str, layers: &[_], input: &_, channels: Vec<usize>| {
            let (output, more) = trunk::run(plan, prefix, layers, config.leaky_slope, features, input, &channels);
            modulated.extend(more);
            output
        };
        match &weights.family {
            Family::Direct { layers } => {
                let input = direct::encode(&mut plan, config, &shared, features.format);
                let output = net(&mut plan, "", layers, &input, (0..config.map_channels()).collect());
                let low = Low::Field(direct::add_residual(&mut plan, config.grid, &shared, &output));
                upsample::field(&mut plan, &shared, config.grid, low, limits)?;
            }
            Family::ExpectedStack { lighting, correction, feedback } => {
                let channels = InputChannels::new(config.depth_layers, features.format);
                let inputs = channels.map(&mut plan, size);
                let stack = ExpectedStack::expect(&mut plan, config, bench, &shared, &inputs, limits)?;
                let lights = net(&mut plan, "lighting ", lighting, &inputs, channels.lighting());
                stack.light(&mut plan, &lights);
                stack.feed_back(&mut plan, *feedback);
                let residual = net(&mut plan, "correction ", correction, &inputs, channels.correction());
                let low = Low::Corrected { inputs: &inputs, channels, correction: &residual };
                upsample::field(&mut plan, &shared, config.grid, low, limits)?;
            }
            Family::FocalStack { .. } => return Err(EngineError::takes_focal_stacks()),
        }
        let clipped = plan.buffer::<u32>("clipped samples", 3);
        let unreachable = plan.buffer::<u32>("samples out of reach", 3);
        let phases = double_phase::encode(&mut plan, &shared, config.amplitude_constant, clipped);
        let samples = levels::encode(&mut plan, tables, phases, unreachable);
        let (trained, bench) = (config.trained, *bench);
        Ok(Self { plan, shared, trained, bench, modulated, phases, samples, clipped, unreachable })
    }

    /// What the network is told of the bench and a pupil.
    pub(super) fn conditions(&self, pupil: PupilDiameter) -> Conditions {
        Conditions::of(&self.trained, &self.bench, pupil)
    }
}
