//! The renderer on the processor: network, double phase and levels on one set of threads, without a copy of a frame.

use std::sync::Arc;
use std::time::{Duration, Instant};

use holod_calibration::{Colour, PerColour, PupilDiameter, Resolution};
use holod_model::engine::{EngineError, StageTiming};
use holod_model::optics::{DoublePhase, PhasePattern};
use holod_model::{ComplexHologram, CpuEngine, RgbdFrame, Weights, WorkerPool};
use holod_slm_output::{LevelsFrame, PanelEncoder};

use super::{Rendered, Renderer};
use crate::failure::{Exit, Failure};

/// What follows the network.
const AFTER_NETWORK: [&str; 2] = ["double phase", "panel levels"];

pub(super) struct CpuRenderer {
    pool: WorkerPool<Job>,
    hologram: ComplexHologram,
    pattern: PhasePattern,
    timings: Vec<StageTiming>,
    description: String,
}

/// What the threads work on. Buffers that are looked at from outside are swapped in for a frame, and out after it.
struct Job {
    engine: CpuEngine,
    double_phase: DoublePhase,
    encoder: Arc<PanelEncoder>,
    frame: Arc<RgbdFrame>,
    pupil: PupilDiameter,
    hologram: ComplexHologram,
    pattern: PhasePattern,
    levels: LevelsFrame,
    rendered: Result<Rendered, EngineError>,
    /// Of double phase and levels.
    durations: [Duration; AFTER_NETWORK.len()],
}

impl CpuRenderer {
    pub(super) fn new(weights: &Weights, encoder: &Arc<PanelEncoder>) -> Result<Self, Failure> {
        let resolution = encoder.pattern_resolution();
        let engine = CpuEngine::new(weights, resolution).map_err(Failure::because(Exit::Unavailable))?;
        let after_network =
            AFTER_NETWORK.map(|name| StageTiming { name: name.to_owned(), duration: Duration::ZERO, flop: 0 });
        let timings = engine.last_timings().stages.iter().cloned().chain(after_network).collect();
        let instruction_set = engine.instruction_set();
        let nothing = Resolution { width: 0, height: 0 };
        let job = Job {
            engine,
            double_phase: DoublePhase::new(resolution, weights.config().amplitude_constant),
            encoder: Arc::clone(encoder),
            frame: Arc::new(RgbdFrame { resolution: nothing, amplitude: Vec::new(), depth_normalised: Vec::new() }),
            pupil: PupilDiameter::from_mm(weights.config().pupil_range_mm[0]),
            hologram: ComplexHologram::dark(nothing),
            pattern: PhasePattern::flat(nothing),
            levels: LevelsFrame::new(encoder.layout()),
            rendered: Ok(Rendered::default()),
            durations: Default::default(),
        };
        let pool = WorkerPool::new("holod-cpu", 0, job, Job::run).map_err(Failure::because(Exit::Unavailable))?;
        Ok(Self {
            description: format!("cpu, {instruction_set}, {} threads", pool.threads()),
            pool,
            hologram: ComplexHologram::dark(resolution),
            pattern: PhasePattern::flat(resolution),
            timings,
        })
    }
}

impl Job {
    fn run(&mut self) {
        let Self { engine, double_phase, encoder, hologram, pattern, levels, .. } = self;
        self.rendered = engine.render(&self.frame, self.pupil, hologram).map(|()| {
            let began = Instant::now();
            let clipped_share = double_phase.encode(hologram, pattern).clipped_share;
            let encoded = Instant::now();
            let phase_rad = PerColour(Colour::ALL.map(|colour| pattern.plane(colour)));
            let unreachable_share = encoder.encode(phase_rad, levels).unreachable_share;
            self.durations = [encoded - began, encoded.elapsed()];
            Rendered { clipped_share, unreachable_share }
        });
    }

    fn swap(&mut self, hologram: &mut ComplexHologram, pattern: &mut PhasePattern, levels: &mut LevelsFrame) {
        std::mem::swap(&mut self.hologram, hologram);
        std::mem::swap(&mut self.pattern, pattern);
        std::mem::swap(&mut self.levels, levels);
    }
}

impl Renderer for CpuRenderer {
    fn render(
        &mut self,
        frame: &Arc<RgbdFrame>,
        pupil: PupilDiameter,
        levels: &mut LevelsFrame,
    ) -> Result<Rendered, EngineError> {
        let Self { pool, hologram, pattern, timings, .. } = self;
        pool.with(|job| {
            job.swap(hologram, pattern, levels);
            (job.frame, job.pupil) = (Arc::clone(frame), pupil);
        });
        pool.run();
        pool.with(|job| {
            job.swap(hologram, pattern, levels);
            let stages = job.engine.last_timings().stages.iter().map(|stage| stage.duration);
            for (timing, duration) in timings.iter_mut().zip(stages.chain(job.durations)) {
                timing.duration = duration;
            }
            job.rendered.clone()
        })
    }

    fn hologram(&self) -> &ComplexHologram {
        &self.hologram
    }

    fn pattern(&self) -> &PhasePattern {
        &self.pattern
    }

    fn timings(&self) -> &[StageTiming] {
        &self.timings
    }

    fn description(&self) -> &str {
        &self.description
    }
}
