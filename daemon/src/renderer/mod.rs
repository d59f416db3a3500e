//! From picture, depth and pupil to the levels that a panel is sent: the one way from a scene to the panel.

mod cpu;
#[cfg(feature = "gpu")]
mod gpu;

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use holod_calibration::rig::Rig;
use holod_calibration::{DisplayGeometry, PerColour, PupilDiameter, Resolution};
use holod_model::engine::{EngineError, Precision, StageTiming};
use holod_model::gpu::{Adapters, GpuChoice, GpuError};
use holod_model::optics::PhasePattern;
use holod_model::{ComplexHologram, RgbdFrame, Weights};
use holod_slm_output::{LevelsFrame, PanelEncoder};

use self::cpu::CpuRenderer;
use crate::cli::Backend;
use crate::failure::{Exit, Failure};

/// How a processor that plays a GPU is described.
pub(crate) const PLAYS_A_GPU: &str = "a processor that plays a GPU";

/// What a renderer is opened for, which says how long a device that fails is waited for.
#[derive(Clone, Debug)]
pub enum Use {
    /// Frames that a command waits for, as long as they take.
    Command,
    /// The frames of a run. Once `stop` is set nothing more is waited for.
    Loop {
        /// Set when the run is to end.
        stop: Arc<AtomicBool>,
    },
}

/// Makes panel levels of frames of one size for one panel.
pub trait Renderer: Send {
    /// Writes the levels of the hologram of `frame` for an eye with `pupil` to `levels`, which has the panel's layout.
    /// On the processor it does not allocate, once some frames have been rendered; what a GPU's driver does is its own.
    ///
    /// Of a pupil beyond those that the weights were trained for, the network is told the nearest; blur and stop are
    /// its own.
    ///
    /// # Errors
    /// [`EngineError`] for a frame of another size than the renderer was made for, a pupil that is none, and
    /// a device that failed where no other engine could take its place, or the run ended before that.
    ///
    /// # Panics
    /// Where `levels` is not of the panel's size.
    fn render(
        &mut self,
        frame: &Arc<RgbdFrame>,
        pupil: PupilDiameter,
        levels: &mut LevelsFrame,
    ) -> Result<Rendered, EngineError>;

    /// The hologram of the last frame, before double phase. It is brought to the host when it is asked for.
    ///
    /// # Errors
    /// The device that has it failed.
    fn hologram(&mut self) -> Result<&ComplexHologram, EngineError>;

    /// Its phases after double phase, before they become levels; as [`Self::hologram`].
    ///
    /// # Errors
    /// The device that has them failed.
    fn pattern(&mut self) -> Result<&PhasePattern, EngineError>;

    /// Where the time of the last frame went, in the order in which it went there.
    fn timings(&self) -> &[StageTiming];

    /// How many of the processor's threads compute; nothing where a GPU does.
    fn cpu_threads(&self) -> Option<usize>;

    /// The amplitude that double phase takes as 1: that of its weights.
    fn amplitude_constant(&self) -> f32;

    /// How it computes, for people: such as `cpu, avx512, 2 threads`, and why not on a GPU where that was wanted.
    fn description(&self) -> &str;
}

/// What was lost between hologram and levels, and how it was computed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rendered {
    /// Share of each colour's samples whose amplitude exceeded the double phase's constant, 0..=1.
    pub clipped_share: PerColour<f32>,
    /// Share of each colour's pixels whose phase the panel cannot reach, 0..=1.
    pub unreachable_share: PerColour<f32>,
    /// Whether another engine had to take the place of one that failed: its description is another one now.
    pub engine_changed: bool,
}

impl Rendered {
    /// Share of samples that were clipped, of all colours that have some of `light`: [`Rig::light`].
    pub fn clipped_where_lit(&self, light: PerColour<f32>) -> f32 {
        mean_where_lit(self.clipped_share, light)
    }

    /// Share of pixels whose phase the panel cannot reach, of the colour among these that has most.
    pub(crate) fn unreachable_where_lit(&self, light: PerColour<f32>) -> f32 {
        where_lit(self.unreachable_share, light).fold(0.0, f32::max)
    }
}

/// Mean of the shares of the colours that have some of `light`; 0 where none has.
pub(crate) fn mean_where_lit(share: PerColour<f32>, light: PerColour<f32>) -> f32 {
    where_lit(share, light).sum::<f32>() / where_lit(share, light).count().max(1) as f32
}

fn where_lit(share: PerColour<f32>, light: PerColour<f32>) -> impl Iterator<Item = f32> {
    share.0.into_iter().zip(light.0).filter(|(_, light)| *light > 0.0).map(|(share, _)| share)
}

/// A renderer of frames of the pattern's size of `encoder`, on the optics of `rig`, and on the GPU that it names, if it
/// names one.
///
/// `Auto` takes a GPU where there is one that will do, else the processor; `Gpu` a GPU, or where there is none a
/// processor that plays one. `GpuHalf` and `CpuHalf` compute in half precision where the device has it; `Auto` does so
/// on a GPU that multiplies matrices, and on a processor that gains by it.
///
/// # Errors
/// The backend is not to be had.
pub fn open(
    backend: Backend,
    weights: &Weights,
    rig: &Rig,
    encoder: &Arc<PanelEncoder>,
    used_for: &Use,
) -> Result<Box<dyn Renderer>, Failure> {
    let bench = &rig.geometry;
    let precision = match backend {
        Backend::Auto => None,
        Backend::Cpu | Backend::Gpu => Some(Precision::Single),
        Backend::CpuHalf | Backend::GpuHalf => Some(Precision::Half),
    };
    let on_cpu = |no_gpu| CpuRenderer::new(weights, bench, encoder, precision.unwrap_or(Precision::Half), no_gpu);
    let on_gpu = |adapters| {
        let choice = GpuChoice { adapters, named: rig.model.gpu.as_deref() };
        on_gpu(weights, bench, encoder, choice, precision, used_for)
    };
    match backend {
        Backend::Cpu | Backend::CpuHalf => Ok(Box::new(on_cpu(None)?)),
        Backend::Auto => match on_gpu(Adapters::Hardware) {
            Ok(renderer) => Ok(renderer),
            // What was named is not to be guessed.
            Err(error @ EngineError::Gpu(_)) if rig.model.gpu.is_some() => Err(failure(error)),
            Err(EngineError::Gpu(error)) => Ok(Box::new(on_cpu(Some(&error))?)),
            Err(other) => Err(failure(other)),
        },
        Backend::Gpu | Backend::GpuHalf => on_gpu(Adapters::Hardware)
            .or_else(|error| match error {
                EngineError::Gpu(GpuError::None { .. } | GpuError::NotNamed { .. }) => on_gpu(Adapters::Software),
                other => Err(other),
            })
            .map_err(|error| {
                if matches!(error, EngineError::Family { .. }) {
                    return failure(error);
                }
                let named = if backend == Backend::GpuHalf { "gpu-half" } else { "gpu" };
                Failure::new(Exit::Unavailable, format!("--backend {named}: {error}"))
            }),
    }
}

/// What is said where a renderer whose frames were to be timed had to take another engine.
pub fn failed_while_timed(renderer: &dyn Renderer) -> Failure {
    let now = renderer.description();
    Failure::new(Exit::Unavailable, format!("the engine failed while it was timed, frames are now computed by {now}"))
}

/// An engine's error with its exit code.
pub fn failure(error: EngineError) -> Failure {
    let exit = if matches!(error, EngineError::Family { .. }) { Exit::Config } else { Exit::Unavailable };
    Failure::because(exit)(error)
}

#[cfg(feature = "gpu")]
fn on_gpu(
    weights: &Weights,
    bench: &DisplayGeometry,
    encoder: &Arc<PanelEncoder>,
    choice: GpuChoice<'_>,
    precision: Option<Precision>,
    used_for: &Use,
) -> Result<Box<dyn Renderer>, EngineError> {
    Ok(Box::new(gpu::GpuRenderer::new(weights, bench, encoder, choice, precision, used_for)?))
}

#[cfg(not(feature = "gpu"))]
fn on_gpu(
    _: &Weights,
    _: &DisplayGeometry,
    _: &Arc<PanelEncoder>,
    _: GpuChoice<'_>,
    _: Option<Precision>,
    _: &Use,
) -> Result<Box<dyn Renderer>, EngineError> {
    Err(GpuError::NotBuilt.into())
}

/// What turns patterns of `resolution` into levels of the rig's panel.
///
/// # Errors
/// The rig contradicts itself, or the patterns do not fit on the panel.
pub fn panel_encoder(rig: &Rig, resolution: Resolution) -> Result<Arc<PanelEncoder>, Failure> {
    PanelEncoder::new(&rig.panel, rig.resolution(), resolution).map(Arc::new).map_err(Failure::because(Exit::Config))
}

/// Above this share of clipped amplitudes a picture is visibly wrong; of the built-in networks' some thousandths are.
const MUCH_CLIPPED: f32 = 0.05;

/// What is wrong with a hologram of which so large a share of all amplitudes was clipped by double phase.
pub fn clipping_fault(clipped_share: f32) -> Option<String> {
    (clipped_share > MUCH_CLIPPED).then(|| {
        format!(
            "{:.0} % of a hologram's amplitudes are above the amplitude_constant of the weights, and were clipped: bright \
             parts are too dark; export the weights with a greater constant, or take others",
            100.0 * clipped_share
        )
    })
}

/// Refuses the hologram of the last frame where it is no numbers: double phase would make darkness of it.
///
/// # Errors
/// A value is not finite, or the device that has it failed.
pub fn check_last_hologram(renderer: &mut dyn Renderer) -> Result<(), Failure> {
    check_numbers(renderer.hologram().map_err(Failure::because(Exit::Unavailable))?)
}

/// The same of a hologram at hand.
///
/// # Errors
/// A value is not finite.
pub(crate) fn check_numbers(hologram: &ComplexHologram) -> Result<(), Failure> {
    let no_numbers = hologram.field.iter().filter(|value| !value.is_finite()).count();
    if no_numbers == 0 {
        return Ok(());
    }
    let values = hologram.field.len();
    let what = format!(
        "{no_numbers} of the hologram's {values} values are no finite numbers: the weights diverged in training, or \
         overflow in half precision; try --backend cpu, which computes in single precision, or take other weights"
    );
    Err(Failure::new(Exit::Data, what))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_lost_in_colours_without_light_does_not_count() {
        let (clipped_share, unreachable_share) = (PerColour([0.5, 0.1, 0.3]), PerColour([0.6, 0.1, 0.2]));
        let rendered = Rendered { clipped_share, unreachable_share, engine_changed: false };
        for (light, clipped, unreachable) in [
            ([1.0, 1.0, 1.0], 0.3, 0.6),
            ([0.0, 1.0, 1.0], 0.2, 0.2),
            ([0.0, 1.0, 0.0], 0.1, 0.1),
            ([0.0, 0.0, 0.0], 0.0, 0.0),
        ] {
            let light = PerColour(light);
            assert!((rendered.clipped_where_lit(light) - clipped).abs() < 1e-6, "{light:?}");
            assert_eq!(rendered.unreachable_where_lit(light), unreachable, "{light:?}");
        }
    }

    #[test]
    fn a_hologram_of_no_numbers_is_refused_with_a_cure() {
        let mut hologram = ComplexHologram::dark(Resolution { width: 4, height: 3 });
        check_numbers(&hologram).unwrap();
        hologram.field[7].re = f32::NAN;
        hologram.field[35].im = f32::INFINITY;
        let refused = check_numbers(&hologram).unwrap_err();
        assert_eq!(refused.exit, Exit::Data);
        let says = "2 of the hologram's 36 values are no finite numbers: the weights diverged";
        assert!(refused.to_string().starts_with(says) && refused.to_string().contains("--backend cpu"), "{refused}");
    }
}

/// A renderer whose engines fail on command.
#[cfg(test)]
pub(crate) mod failing {
    use std::collections::VecDeque;
    use std::time::Duration;

    use super::*;

    pub(crate) struct Failing {
        /// Of each of the next frames: how long it takes, and whether its engine fails. Those that follow are like the
        /// last.
        frames: VecDeque<(Duration, bool)>,
        hologram: ComplexHologram,
    }

    impl Failing {
        pub(crate) fn new(frames: &[(Duration, bool)]) -> Self {
            let hologram = ComplexHologram::dark(Resolution { width: 2, height: 2 });
            Self { frames: frames.iter().copied().collect(), hologram }
        }

        /// Whose holograms are no numbers.
        pub(crate) fn diverged() -> Self {
            let mut renderer = Self::new(&[(Duration::ZERO, false)]);
            renderer.hologram.field[5].im = f32::NAN;
            renderer
        }
    }

    impl Renderer for Failing {
        fn render(
            &mut self,
            _: &Arc<RgbdFrame>,
            _: PupilDiameter,
            _: &mut LevelsFrame,
        ) -> Result<Rendered, EngineError> {
            let (takes, engine_changed) = self.frames[0];
            if self.frames.len() > 1 {
                self.frames.pop_front();
            }
            std::thread::sleep(takes);
            Ok(Rendered { engine_changed, ..Rendered::default() })
        }

        fn hologram(&mut self) -> Result<&ComplexHologram, EngineError> {
            Ok(&self.hologram)
        }

        fn pattern(&mut self) -> Result<&PhasePattern, EngineError> {
            unreachable!("nobody asks for it")
        }

        fn timings(&self) -> &[StageTiming] {
            &[]
        }

        fn cpu_threads(&self) -> Option<usize> {
            None
        }

        fn amplitude_constant(&self) -> f32 {
            1.0
        }

        fn description(&self) -> &str {
            "another engine"
        }
    }
}
