//! The renderer on the processor: network, double phase and levels on one set of threads, without a copy of a frame.

use std::sync::Arc;
use std::time::{Duration, Instant};

use holod_calibration::{Colour, DisplayGeometry, PerColour, PupilDiameter, Resolution};
use holod_model::engine::{EngineError, Precision, StageTiming};
use holod_model::gpu::GpuError;
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
    amplitude_constant: f32,
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
    /// `no_gpu` is why the processor has to do it, where it is not what was asked for.
    pub(super) fn new(
        weights: &Weights,
        bench: &DisplayGeometry,
        encoder: &Arc<PanelEncoder>,
        precision: Precision,
        no_gpu: Option<&GpuError>,
    ) -> Result<Self, Failure> {
        let resolution = encoder.pattern_resolution();
        let engine = CpuEngine::new(weights, bench, resolution, precision).map_err(super::failure)?;
        let (hologram, pattern) = (ComplexHologram::dark(resolution), PhasePattern::flat(resolution));
        let pattern_bytes: usize = Colour::ALL.map(|colour| size_of_val(pattern.plane(colour))).iter().sum();
        // What is around the pattern is written once.
        let levels_bytes = Colour::ALL.len() * resolution.pixels() * size_of::<u16>();
        let moved = [size_of_val(&*hologram.field) + pattern_bytes, pattern_bytes + levels_bytes];
        let after_network = AFTER_NETWORK.into_iter().zip(moved).map(|(name, bytes)| StageTiming {
            name: name.to_owned(),
            duration: Duration::ZERO,
            flop: 0,
            bytes: bytes as u64,
        });
        let timings = engine.last_timings().stages.iter().cloned().chain(after_network).collect();
        let instruction_set = engine.instruction_set();
        let nothing = Resolution { width: 0, height: 0 };
        let job = Job {
            engine,
            double_phase: DoublePhase::new(resolution, weights.config().amplitude_constant),
            encoder: Arc::clone(encoder),
            frame: Arc::new(RgbdFrame { resolution: nothing, amplitude: Vec::new(), depth_normalised: Vec::new() }),
            pupil: weights.trained_pupils(bench)[0],
            hologram: ComplexHologram::dark(nothing),
            pattern: PhasePattern::flat(nothing),
            levels: LevelsFrame::new(encoder.layout()),
            rendered: Ok(Rendered::default()),
            durations: Default::default(),
        };
        let pool = WorkerPool::new("holod-cpu", 0, job, Job::run).map_err(Failure::because(Exit::Unavailable))?;
        Ok(Self {
            amplitude_constant: weights.config().amplitude_constant,
            description: match no_gpu {
                None => format!("cpu, {instruction_set}, {} threads", pool.threads()),
                Some(error) => {
                    format!("cpu, {instruction_set}, {} threads, as {}", pool.threads(), error.reason())
                }
            },
            pool,
            hologram,
            pattern,
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
            Rendered { clipped_share, unreachable_share, engine_changed: false }
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
            assert_eq!(levels.layout(), job.levels.layout(), "a renderer is made for one panel");
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

    fn hologram(&mut self) -> Result<&ComplexHologram, EngineError> {
        Ok(&self.hologram)
    }

    fn pattern(&mut self) -> Result<&PhasePattern, EngineError> {
        Ok(&self.pattern)
    }

    fn timings(&self) -> &[StageTiming] {
        &self.timings
    }

    fn cpu_threads(&self) -> Option<usize> {
        Some(self.pool.threads())
    }

    fn amplitude_constant(&self) -> f32 {
        self.amplitude_constant
    }

    fn description(&self) -> &str {
        &self.description
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::rig::Rig;

    use super::*;
    use crate::source::scene;

    const SIZE: Resolution = Resolution { width: 34, height: 22 };
    const PANEL: Resolution = Resolution { width: 40, height: 25 };

    fn encoder() -> Arc<PanelEncoder> {
        Arc::new(PanelEncoder::new(&Rig::default().panel, PANEL, SIZE).unwrap())
    }

    /// The levels of one stage after the other.
    fn stage_by_stage(weights: &Weights, frame: &RgbdFrame, pupil: PupilDiameter) -> LevelsFrame {
        let (mut hologram, mut pattern) = (ComplexHologram::dark(SIZE), PhasePattern::flat(SIZE));
        let mut engine = CpuEngine::new(weights, &DisplayGeometry::DEFAULT, SIZE, Precision::Single).unwrap();
        engine.render(frame, pupil, &mut hologram).unwrap();
        DoublePhase::new(SIZE, weights.config().amplitude_constant).encode(&hologram, &mut pattern);
        let encoder = encoder();
        let mut levels = LevelsFrame::new(encoder.layout());
        encoder.encode(PerColour(Colour::ALL.map(|colour| pattern.plane(colour))), &mut levels);
        levels
    }

    #[test]
    fn levels_are_those_of_the_stages_for_each_pupil_in_whatever_buffer() {
        let weights = Weights::builtin_small();
        let mut renderer =
            CpuRenderer::new(&weights, &DisplayGeometry::DEFAULT, &encoder(), Precision::Single, None).unwrap();
        let frame = Arc::new(scene::sample_frame(SIZE));
        let mut buffers = [(); 2].map(|()| LevelsFrame::new(encoder().layout()));
        let mut shown = Vec::new();
        for (pupil_mm, buffer) in [(2.0, 0), (4.0, 1), (2.0, 0)] {
            let pupil = PupilDiameter::from_mm(pupil_mm);
            renderer.render(&frame, pupil, &mut buffers[buffer]).unwrap();
            assert_eq!(buffers[buffer].samples(), stage_by_stage(&weights, &frame, pupil).samples());
            assert_eq!(renderer.hologram().unwrap().resolution, SIZE);
            shown.push(buffers[buffer].samples().to_vec());
        }
        assert_ne!(shown[0], shown[1], "pupils are told apart");
        let [.., double_phase, panel_levels] = renderer.timings() else { panic!("two stages follow the network") };
        assert_eq!((&*double_phase.name, double_phase.bytes), ("double phase", 3 * (8 + 4) * 34 * 22));
        assert_eq!((&*panel_levels.name, panel_levels.bytes), ("panel levels", 3 * (4 + 2) * 34 * 22));
    }

    #[test]
    fn a_frame_of_another_size_is_refused_and_the_next_one_rendered() {
        let weights = Weights::builtin_small();
        let mut renderer =
            CpuRenderer::new(&weights, &DisplayGeometry::DEFAULT, &encoder(), Precision::Single, None).unwrap();
        let mut levels = LevelsFrame::new(encoder().layout());
        let pupil = PupilDiameter::from_mm(3.0);
        let wrong = Arc::new(scene::sample_frame(PANEL));
        assert!(matches!(renderer.render(&wrong, pupil, &mut levels), Err(EngineError::Resolution { .. })));
        let right = Arc::new(scene::sample_frame(SIZE));
        renderer.render(&right, pupil, &mut levels).unwrap();
        assert_eq!(levels.samples(), stage_by_stage(&weights, &right, pupil).samples());
    }
}
