//! The renderer on the GPU. Where its device fails, that is opened anew; where it fails again and again, or is gone,
//! the processor takes over, so that the display goes on.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use holod_calibration::{DisplayGeometry, PerColour, PupilDiameter, TimeNs, host_now};
use holod_model::engine::{EngineError, GpuEngine, Precision, StageTiming};
use holod_model::gpu::{Adapters, GpuChoice, GpuError};
use holod_model::optics::PhasePattern;
use holod_model::{ComplexHologram, RgbdFrame, Weights};
use holod_slm_output::{LevelsFrame, PanelEncoder};

use super::cpu::CpuRenderer;
use super::{PLAYS_A_GPU, Rendered, Renderer, Use};
use crate::scheduling;

/// An order to end the loop is seen within this time.
const LOOK: Duration = Duration::from_millis(20);

/// How long a run waits for a GPU's work before the processor takes over: less than the service's watchdog waits for a
/// frame (`WatchdogSec=`) with what passes between the last time that it was fed and the hang.
const LOOP_PATIENCE: Duration = Duration::from_secs(5);
/// The same for the first frame of a run or of new weights, which nobody sees yet: a driver may compile shaders only
/// then.
const FIRST_FRAME_PATIENCE: Duration = Duration::from_secs(30);
/// How long a device that failed is left alone before each time that it is opened anew: a card's reset takes seconds.
const PAUSES: [Duration; 3] = [Duration::from_millis(500), Duration::from_secs(1), Duration::from_secs(2)];
/// A device that did not fail for so long may be opened anew as often as at first.
const FORGIVEN_AFTER: TimeNs = TimeNs(3_600_000_000_000);

impl Use {
    /// How long a device's work may take before it hangs, for a renderer's first frame and those after it; where
    /// that is not left to the engine.
    fn patience(&self, adapters: Adapters) -> Option<[Duration; 2]> {
        match (self, adapters) {
            (Self::Loop { .. }, Adapters::Hardware) => Some([FIRST_FRAME_PATIENCE, LOOP_PATIENCE]),
            // A processor that plays a GPU is slow, and does not hang.
            (Self::Command, _) | (_, Adapters::Software) => None,
        }
    }

    /// Lets `pause` go by; false where the run ends before that.
    fn let_pass(&self, pause: Duration) -> bool {
        let t_end = Instant::now() + pause;
        loop {
            if matches!(self, Self::Loop { stop } if stop.load(Ordering::Acquire)) {
                return false;
            }
            let left = t_end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return true;
            }
            std::thread::sleep(left.min(LOOK));
        }
    }
}

pub(super) struct GpuRenderer {
    weights: Weights,
    bench: DisplayGeometry,
    encoder: Arc<PanelEncoder>,
    adapters: Adapters,
    /// The GPU that the rig names.
    named: Option<String>,
    precision: Option<Precision>,
    used_for: Use,
    engine: Engine,
    reopenings: Reopenings,
    description: String,
    /// What has been read back of the last frame; made when it is first asked for.
    hologram: ReadBack<ComplexHologram>,
    pattern: ReadBack<PhasePattern>,
}

enum Engine {
    Gpu(Box<GpuEngine>),
    Cpu(CpuRenderer),
    /// The device failed, and the processor's threads could not be started, or the run ends.
    None(EngineError),
}

/// When a device that failed is opened anew.
#[derive(Default)]
struct Reopenings {
    spent: usize,
    t_fault: Option<TimeNs>,
}

impl Reopenings {
    /// How long to wait before the device is opened anew that failed at `now`, at work or when it was opened; nothing
    /// where it was often enough.
    fn after_fault(&mut self, now: TimeNs) -> Option<Duration> {
        if self.t_fault.is_some_and(|t_fault| now - t_fault >= FORGIVEN_AFTER) {
            self.spent = 0;
        }
        self.t_fault = Some(now);
        let pause = *PAUSES.get(self.spent)?;
        self.spent += 1;
        Some(pause)
    }
}

/// A copy on the host, and whether it is of the last frame.
struct ReadBack<T> {
    copy: Option<T>,
    is_current: bool,
}

impl<T> ReadBack<T> {
    const NONE: Self = Self { copy: None, is_current: false };

    fn get(
        &mut self,
        make: impl FnOnce() -> T,
        read: impl FnOnce(&mut T) -> Result<(), GpuError>,
    ) -> Result<&T, EngineError> {
        let copy = self.copy.get_or_insert_with(make);
        if !self.is_current {
            read(copy)?;
            self.is_current = true;
        }
        Ok(copy)
    }
}

impl GpuRenderer {
    /// On the best device of `choice`, with features in `precision` where it has that, as
    /// [`GpuEngine::open`].
    ///
    /// # Errors
    /// There is none, or it lacks what the network needs at the pattern's size.
    pub(super) fn new(
        weights: &Weights,
        bench: &DisplayGeometry,
        encoder: &Arc<PanelEncoder>,
        choice: GpuChoice<'_>,
        precision: Option<Precision>,
        used_for: &Use,
    ) -> Result<Self, EngineError> {
        let mut engine = GpuEngine::open(weights, bench, &encoder.tables(), choice, precision)?;
        let GpuChoice { adapters, named } = choice;
        if let Some([first_frame, _]) = used_for.patience(adapters) {
            engine.hangs_after(first_frame);
        }
        Ok(Self {
            description: described(&engine, adapters),
            weights: weights.clone(),
            bench: *bench,
            encoder: Arc::clone(encoder),
            adapters,
            named: named.map(str::to_owned),
            precision,
            used_for: used_for.clone(),
            engine: Engine::Gpu(Box::new(engine)),
            reopenings: Reopenings::default(),
            hologram: ReadBack::NONE,
            pattern: ReadBack::NONE,
        })
    }

    /// Puts another engine in the place of the one whose device failed, or none where the run ends before that.
    fn replace(&mut self, error: &GpuError) {
        tracing::error!("{error}");
        let failed = std::mem::replace(&mut self.engine, Engine::None(EngineError::Gpu(error.clone())));
        if matches!(error, GpuError::Hung { .. }) {
            // To drop it would wait for work that does not end, and the same device would be no better.
            std::mem::forget(failed);
        } else {
            // Its memory is given back before the next one asks for as much.
            drop(failed);
            let tables = self.encoder.tables();
            while let Some(pause) = self.reopenings.after_fault(host_now()) {
                if !self.used_for.let_pass(pause) {
                    return;
                }
                let choice = GpuChoice { adapters: self.adapters, named: self.named.as_deref() };
                match GpuEngine::open(&self.weights, &self.bench, &tables, choice, self.precision) {
                    Ok(mut engine) => {
                        first_frame_is_made(&mut engine, &self.used_for, self.adapters);
                        self.description = described(&engine, self.adapters);
                        tracing::warn!("the GPU was opened again: holograms are computed by {}", self.description);
                        self.engine = Engine::Gpu(Box::new(engine));
                        return;
                    }
                    Err(again) => tracing::error!("the GPU cannot be opened again: {again}"),
                }
            }
        }
        let precision = self.precision.unwrap_or(Precision::Half);
        let (weights, bench, encoder) = (&self.weights, &self.bench, &self.encoder);
        let on_cpu = || CpuRenderer::new(weights, bench, encoder, precision, Some(error));
        let opened = match &self.used_for {
            Use::Command => on_cpu(),
            // As the threads of a run's first renderer.
            Use::Loop { .. } => scheduling::patient(on_cpu),
        };
        match opened {
            Ok(cpu) => {
                self.description = cpu.description().to_owned();
                tracing::warn!("holograms are computed by {}", self.description);
                self.engine = Engine::Cpu(cpu);
            }
            Err(failure) => tracing::error!("the processor cannot take over: {failure}"),
        }
    }

    /// As if the driver had lost the device.
    #[cfg(any(test, feature = "fault-injection"))]
    pub(super) fn lose_device(&self) {
        if let Engine::Gpu(engine) = &self.engine {
            engine.lose_device();
        }
    }
}

/// From now on a frame takes its usual time; also on a device that is opened again, which is waited for in mid-run.
fn first_frame_is_made(engine: &mut GpuEngine, used_for: &Use, adapters: Adapters) {
    if let Some([_, usual]) = used_for.patience(adapters) {
        engine.hangs_after(usual);
    }
}

fn described(engine: &GpuEngine, adapters: Adapters) -> String {
    let slow = if adapters == Adapters::Software { format!(", {PLAYS_A_GPU}") } else { String::new() };
    let precision = match engine.precision() {
        Precision::Single => "single",
        Precision::Half => "half",
    };
    let units = if engine.uses_matrix_units() { ", matrix units" } else { "" };
    let why = engine.refused_matrices().map_or(String::new(), |why| format!(", as with matrix units {}", why.reason()));
    format!("gpu, {}{units}, {precision} precision{slow}{why}", engine.device())
}

impl Renderer for GpuRenderer {
    fn render(
        &mut self,
        frame: &Arc<RgbdFrame>,
        pupil: PupilDiameter,
        levels: &mut LevelsFrame,
    ) -> Result<Rendered, EngineError> {
        assert_eq!(levels.layout(), self.encoder.layout(), "a renderer is made for one panel");
        #[cfg(feature = "fault-injection")]
        if crate::fault::gpu_is_lost() {
            self.lose_device();
        }
        (self.hologram.is_current, self.pattern.is_current) = (false, false);
        let mut engine_changed = false;
        loop {
            let failed = match &mut self.engine {
                Engine::Gpu(engine) => match engine.render(frame, pupil, levels.samples_mut()) {
                    Ok(counts) => {
                        first_frame_is_made(engine, &self.used_for, self.adapters);
                        let pixels = self.encoder.pattern_resolution().pixels() as f32;
                        return Ok(Rendered {
                            clipped_share: PerColour(counts.clipped.map(|count| count as f32 / pixels)),
                            unreachable_share: PerColour(counts.unreachable.map(|count| count as f32 / pixels)),
                            engine_changed,
                        });
                    }
                    Err(EngineError::Gpu(error)) => error,
                    Err(other) => return Err(other),
                },
                Engine::Cpu(renderer) => {
                    let rendered = renderer.render(frame, pupil, levels)?;
                    return Ok(Rendered { engine_changed, ..rendered });
                }
                Engine::None(error) => return Err(error.clone()),
            };
            self.replace(&failed);
            engine_changed = true;
        }
    }

    fn hologram(&mut self) -> Result<&ComplexHologram, EngineError> {
        let resolution = self.encoder.pattern_resolution();
        match &mut self.engine {
            Engine::Gpu(engine) => {
                self.hologram.get(|| ComplexHologram::dark(resolution), |hologram| engine.read_hologram(hologram))
            }
            Engine::Cpu(renderer) => renderer.hologram(),
            Engine::None(error) => Err(error.clone()),
        }
    }

    fn pattern(&mut self) -> Result<&PhasePattern, EngineError> {
        let resolution = self.encoder.pattern_resolution();
        match &mut self.engine {
            Engine::Gpu(engine) => {
                self.pattern.get(|| PhasePattern::flat(resolution), |pattern| engine.read_pattern(pattern))
            }
            Engine::Cpu(renderer) => renderer.pattern(),
            Engine::None(error) => Err(error.clone()),
        }
    }

    fn timings(&self) -> &[StageTiming] {
        match &self.engine {
            Engine::Gpu(engine) => &engine.last_timings().stages,
            Engine::Cpu(renderer) => renderer.timings(),
            Engine::None(_) => &[],
        }
    }

    fn cpu_threads(&self) -> Option<usize> {
        match &self.engine {
            Engine::Cpu(renderer) => renderer.cpu_threads(),
            Engine::Gpu(_) | Engine::None(_) => None,
        }
    }

    fn amplitude_constant(&self) -> f32 {
        self.weights.config().amplitude_constant
    }

    fn description(&self) -> &str {
        &self.description
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use holod_calibration::Resolution;
    use holod_calibration::rig::Rig;

    use super::*;
    use crate::source::scene;

    const SIZE: Resolution = Resolution { width: 34, height: 22 };
    const PANEL: Resolution = Resolution { width: 41, height: 25 };

    fn renderer(encoder: &Arc<PanelEncoder>) -> GpuRenderer {
        renderer_for(&Use::Command, encoder)
    }

    fn renderer_for(used_for: &Use, encoder: &Arc<PanelEncoder>) -> GpuRenderer {
        let (weights, bench) = (Weights::builtin_small(), DisplayGeometry::DEFAULT);
        GpuRenderer::new(&weights, &bench, encoder, Adapters::Software.into(), Some(Precision::Single), used_for)
            .expect("Mesa's software device; install mesa-vulkan-drivers")
    }

    /// Samples that are more than one level of 256 apart on the circle.
    fn apart(one: &LevelsFrame, other: &LevelsFrame) -> usize {
        let pairs = one.samples().iter().zip(other.samples());
        pairs.filter(|(one, other)| (2..255).contains(&(one.wrapping_sub(**other) & 0xff))).count()
    }

    #[test]
    fn levels_are_the_processors_whatever_becomes_of_the_device() {
        let encoder = Arc::new(PanelEncoder::new(&Rig::default().panel, PANEL, SIZE).unwrap());
        let pupil = PupilDiameter::from_mm(3.0);
        let frame = Arc::new(scene::sample_frame(SIZE));
        let levels = || LevelsFrame::new(encoder.layout());
        let (mut expected, mut flat) = (levels(), levels());
        let mut cpu =
            CpuRenderer::new(&Weights::builtin_small(), &DisplayGeometry::DEFAULT, &encoder, Precision::Single, None)
                .unwrap();
        let on_cpu = cpu.render(&frame, pupil, &mut expected).unwrap();
        encoder.encode_flat(&mut flat);
        assert!(apart(&expected, &flat) > 100, "the comparison is blind");

        let mut gpu = renderer(&encoder);
        let mut render = |gpu: &mut GpuRenderer| {
            let mut found = levels();
            let rendered = gpu.render(&frame, pupil, &mut found).unwrap();
            assert!(apart(&found, &expected) <= 2, "{} levels by {}", apart(&found, &expected), gpu.description());
            let of_white = |rendered: &Rendered| rendered.clipped_where_lit(PerColour([1.0; 3]));
            assert!((of_white(&rendered) - of_white(&on_cpu)).abs() < 2e-3);
            let (hologram, of_cpu) = (gpu.hologram().unwrap(), cpu.hologram().unwrap());
            assert_eq!(hologram.field.len(), of_cpu.field.len());
            let close = |spoiled: f32| {
                let pairs = hologram.field.iter().zip(&of_cpu.field).enumerate();
                let errors = pairs.map(|(i, (a, b))| (a - b).norm() + if i == 3 { spoiled } else { 0.0 });
                errors.max_by(f32::total_cmp).is_some_and(|error| error < 1e-4)
            };
            assert!(close(0.0), "another hologram by {}", gpu.description());
            assert!(!close(1e-3) && !close(f32::NAN), "the comparison is blind");
            assert_eq!(gpu.pattern().unwrap().resolution, SIZE);
            rendered.engine_changed
        };
        assert!(!render(&mut gpu) && gpu.description().starts_with("gpu, "));
        gpu.lose_device();
        assert!(render(&mut gpu) && gpu.description().starts_with("gpu, "), "{}", gpu.description());
        assert!(!render(&mut gpu));
        gpu.reopenings.spent = PAUSES.len();
        gpu.lose_device();
        assert!(render(&mut gpu) && gpu.description().starts_with("cpu, "), "{}", gpu.description());
        assert!(gpu.description().contains("failed") && !render(&mut gpu));
    }

    #[test]
    fn a_run_waits_less_for_a_gpu_than_its_watchdog_does() {
        let run = Use::Loop { stop: Arc::default() };
        let [first, patience] = run.patience(Adapters::Hardware).unwrap();
        assert!(first > patience && first < Duration::from_secs(90), "the start's own limit");
        let service = include_str!("../../../deploy/systemd/holod.service");
        let watchdog_s = service.lines().find_map(|line| line.strip_prefix("WatchdogSec=")).unwrap();
        let watchdog = Duration::from_secs(watchdog_s.parse().unwrap());
        // It is fed four times in its time.
        let left = |patience: Duration| watchdog.checked_sub(watchdog / 4 + patience).unwrap_or_default();
        assert!(left(patience) >= Duration::from_secs(2), "{:?} for the processor's first frame", left(patience));
        assert_eq!(left(Duration::from_secs(120)), Duration::ZERO, "the comparison is blind");
        assert_eq!(run.patience(Adapters::Software), None);
        assert_eq!(Use::Command.patience(Adapters::Hardware), None);
    }

    #[test]
    fn a_device_is_opened_again_after_longer_and_longer_and_anew_after_an_hour() {
        let hour = TimeNs(3_600_000_000_000);
        let mut reopenings = Reopenings::default();
        let mut pauses_ms = |times: &[TimeNs]| -> Vec<Option<u128>> {
            times.iter().map(|&t| reopenings.after_fault(t).map(|pause| pause.as_millis())).collect()
        };
        // In one outage, however the openings fail.
        let t = TimeNs(7);
        assert_eq!(pauses_ms(&[t, t + TimeNs(9), t + TimeNs(30)]), [Some(500), Some(1000), Some(2000)]);
        let t_last = hour;
        assert_eq!(pauses_ms(&[t_last - TimeNs(1), t_last]), [None, None]);
        // An hour after the last fault, not after the first.
        assert_eq!(pauses_ms(&[t_last + hour - TimeNs(1)]), [None]);
        let t_well = t_last + hour - TimeNs(1) + hour;
        assert_eq!(pauses_ms(&[t_well, t_well + TimeNs(1)]), [Some(500), Some(1000)]);
    }

    #[test]
    fn the_end_of_a_run_waits_for_no_device() {
        let encoder = Arc::new(PanelEncoder::new(&Rig::default().panel, PANEL, SIZE).unwrap());
        let stop = Arc::new(AtomicBool::new(false));
        let mut gpu = renderer_for(&Use::Loop { stop: Arc::clone(&stop) }, &encoder);
        let (frame, mut levels) = (Arc::new(scene::sample_frame(SIZE)), LevelsFrame::new(encoder.layout()));
        let mut render = |gpu: &mut GpuRenderer| gpu.render(&frame, PupilDiameter::from_mm(3.0), &mut levels);
        gpu.lose_device();
        assert!(render(&mut gpu).unwrap().engine_changed, "it is waited for while the run goes on");
        stop.store(true, std::sync::atomic::Ordering::Release);
        gpu.lose_device();
        assert!(matches!(render(&mut gpu), Err(EngineError::Gpu(GpuError::Failed { .. }))));
        assert!(matches!(gpu.engine, Engine::None(_)));
    }

    #[test]
    fn a_device_that_hangs_is_left_to_itself_and_the_processor_takes_over() {
        let encoder = Arc::new(PanelEncoder::new(&Rig::default().panel, PANEL, SIZE).unwrap());
        let mut gpu = renderer(&encoder);
        gpu.replace(&GpuError::Hung { name: "a card".into(), waited: Duration::from_secs(5) });
        assert!(matches!(gpu.engine, Engine::Cpu(_)) && gpu.description().contains("5 s"), "{}", gpu.description());
        let (frame, mut levels) = (Arc::new(scene::sample_frame(SIZE)), LevelsFrame::new(encoder.layout()));
        gpu.render(&frame, PupilDiameter::from_mm(3.0), &mut levels).unwrap();
    }

    #[test]
    fn a_frame_of_another_size_is_refused_and_is_no_fault_of_the_device() {
        let encoder = Arc::new(PanelEncoder::new(&Rig::default().panel, PANEL, SIZE).unwrap());
        let mut gpu = renderer(&encoder);
        let wrong = Arc::new(scene::sample_frame(PANEL));
        let mut levels = LevelsFrame::new(encoder.layout());
        let refused = gpu.render(&wrong, PupilDiameter::from_mm(3.0), &mut levels);
        assert!(matches!(refused, Err(EngineError::Resolution { .. })));
        assert!(matches!(gpu.engine, Engine::Gpu(_)));
    }
}
