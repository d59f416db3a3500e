//! From picture, depth and pupil to the levels that a panel is sent: the one way from a scene to the panel.

mod cpu;

use std::sync::Arc;

use holod_calibration::rig::Rig;
use holod_calibration::{PerColour, PupilDiameter, Resolution};
use holod_model::engine::{EngineError, StageTiming};
use holod_model::optics::PhasePattern;
use holod_model::{ComplexHologram, RgbdFrame, Weights};
use holod_slm_output::{LevelsFrame, PanelEncoder};

use self::cpu::CpuRenderer;
use crate::cli::Backend;
use crate::failure::{Exit, Failure};

/// Makes panel levels of frames of one size for one panel.
pub trait Renderer: Send {
    /// Writes the levels of the hologram of `frame` for an eye with `pupil` to `levels`, which has the panel's layout.
    /// Does not allocate, once some frames have been rendered.
    ///
    /// A pupil outside the range that the weights were trained for is taken as the nearest one inside.
    ///
    /// # Errors
    /// [`EngineError`] for a frame of another size than the renderer was made for, and a pupil that is no positive length.
    ///
    /// # Panics
    /// Where `levels` is not of the panel's size.
    fn render(
        &mut self,
        frame: &Arc<RgbdFrame>,
        pupil: PupilDiameter,
        levels: &mut LevelsFrame,
    ) -> Result<Rendered, EngineError>;

    /// The hologram of the last frame, before double phase.
    fn hologram(&self) -> &ComplexHologram;

    /// Its phases after double phase, before they become levels.
    fn pattern(&self) -> &PhasePattern;

    /// Where the time of the last frame went, in the order in which it went there.
    fn timings(&self) -> &[StageTiming];

    /// How it computes, for people: such as `cpu, avx512, 2 threads`.
    fn description(&self) -> &str;
}

/// What was lost between hologram and levels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rendered {
    /// Share of samples whose amplitude exceeded the double phase's constant, 0..=1.
    pub clipped_share: f32,
    /// Share of each colour's pixels whose phase the panel cannot reach, 0..=1.
    pub unreachable_share: PerColour<f32>,
}

/// A renderer of frames of the pattern's size of `encoder`.
///
/// # Errors
/// The backend is not to be had.
pub fn open(backend: Backend, weights: &Weights, encoder: &Arc<PanelEncoder>) -> Result<Box<dyn Renderer>, Failure> {
    match backend {
        Backend::Auto | Backend::Cpu => Ok(Box::new(CpuRenderer::new(weights, encoder)?)),
        Backend::Gpu => Err(Failure::new(
            Exit::Unavailable,
            "--backend gpu: this version computes on the processor only; use --backend cpu or leave it out",
        )),
    }
}

/// What turns patterns of `resolution` into levels of the rig's panel.
///
/// # Errors
/// The rig contradicts itself, or the patterns do not fit on the panel.
pub fn panel_encoder(rig: &Rig, resolution: Resolution) -> Result<Arc<PanelEncoder>, Failure> {
    PanelEncoder::new(&rig.panel, rig.resolution(), resolution).map(Arc::new).map_err(Failure::because(Exit::Config))
}
