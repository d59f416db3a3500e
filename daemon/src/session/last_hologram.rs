//! The last hologram, shown again where a new one would look the same.

use std::sync::Arc;

use holod_calibration::{DisplayGeometry, PupilDiameter};
use holod_model::RgbdFrame;
use holod_model::engine::EngineError;
use holod_slm_output::LevelsFrame;

use crate::renderer::{Rendered, Renderer};

/// Blur that changes by less than this, in panel pixels at the ends of the depth volume, is the same blur: less than
/// what one sees, and more than the noise of good trackers.
const SAME_BLUR_PX: f64 = 0.1;

/// A renderer that computes only what is new.
pub(super) struct LastHologram {
    renderer: Box<dyn Renderer>,
    geometry: DisplayGeometry,
    levels: LevelsFrame,
    made: Option<Made>,
}

/// What the last hologram was made of.
struct Made {
    frame: Arc<RgbdFrame>,
    pupil: PupilDiameter,
    rendered: Rendered,
}

/// Levels that were written, and how they came about.
pub(super) struct Shown {
    /// What the hologram lost.
    pub rendered: Rendered,
    /// The pupil that it was made for.
    pub pupil: PupilDiameter,
}

impl LastHologram {
    /// Of `renderer` on the bench of `geometry`; `levels` has the panel's layout.
    pub(super) fn new(renderer: Box<dyn Renderer>, geometry: DisplayGeometry, levels: LevelsFrame) -> Self {
        Self { renderer, geometry, levels, made: None }
    }

    /// Writes the levels of a hologram of `frame` for `pupil`, or for one that blurs as much, to `levels`.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub(super) fn show(
        &mut self,
        frame: &Arc<RgbdFrame>,
        pupil: PupilDiameter,
        levels: &mut LevelsFrame,
    ) -> Result<Shown, EngineError> {
        if let Some(made) = &self.made
            && Arc::ptr_eq(&made.frame, frame)
            && self.blur_is_the_same(made.pupil, pupil)
        {
            levels.copy_from(&self.levels);
            return Ok(Shown { rendered: Rendered { engine_changed: false, ..made.rendered }, pupil: made.pupil });
        }
        // A failure in between leaves levels of neither.
        self.made = None;
        let rendered = self.renderer.render(frame, pupil, &mut self.levels)?;
        self.made = Some(Made { frame: Arc::clone(frame), pupil, rendered });
        levels.copy_from(&self.levels);
        Ok(Shown { rendered, pupil })
    }

    fn blur_is_the_same(&self, one: PupilDiameter, other: PupilDiameter) -> bool {
        let [one_px, other_px] = [one, other].map(|pupil| self.geometry.largest_coc_px(pupil));
        (one_px - other_px).abs() < SAME_BLUR_PX
    }

    /// How holograms are computed.
    pub(super) fn description(&self) -> &str {
        self.renderer.description()
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::rig::Rig;
    use holod_calibration::{PerColour, Resolution};
    use holod_model::ComplexHologram;
    use holod_model::engine::StageTiming;
    use holod_model::optics::PhasePattern;

    use super::*;
    use crate::{renderer, setup};

    const SIZE: Resolution = Resolution { width: 8, height: 4 };

    /// Writes how often it has rendered.
    struct Counting(u16);

    impl Renderer for Counting {
        fn render(
            &mut self,
            _: &Arc<RgbdFrame>,
            pupil: PupilDiameter,
            levels: &mut LevelsFrame,
        ) -> Result<Rendered, EngineError> {
            if !pupil.mm().is_finite() {
                return Err(EngineError::Pupil { pupil_mm: pupil.mm() });
            }
            self.0 += 1;
            levels.samples_mut().fill(self.0);
            Ok(Rendered { clipped_share: 0.25, unreachable_share: PerColour([0.0; 3]), engine_changed: true })
        }

        fn hologram(&mut self) -> Result<&ComplexHologram, EngineError> {
            unreachable!("nobody looks")
        }

        fn pattern(&mut self) -> Result<&PhasePattern, EngineError> {
            unreachable!("nobody looks")
        }

        fn timings(&self) -> &[StageTiming] {
            &[]
        }

        fn cpu_threads(&self) -> Option<usize> {
            None
        }

        fn description(&self) -> &str {
            "counting"
        }
    }

    #[test]
    fn only_what_is_new_is_computed() {
        let rig = Rig::default();
        let layout = renderer::panel_encoder(&rig, SIZE).unwrap().layout();
        let mut last = LastHologram::new(Box::new(Counting(0)), rig.geometry, LevelsFrame::new(layout));
        let frames = [(); 2].map(|()| Arc::new(setup::sample_frame(SIZE)));
        // The default bench blurs by 14 px more for each millimetre.
        let step_mm = (SAME_BLUR_PX / rig.geometry.largest_coc_px(PupilDiameter::from_mm(1.0))) as f32;
        let mut levels = LevelsFrame::new(layout);
        for (frame, pupil_mm, computed, made_for_mm) in [
            (0, 3.0, 1, 3.0),
            (0, 3.0, 1, 3.0),
            (0, 3.0 + 0.9 * step_mm, 1, 3.0),
            // Small steps do not add up.
            (0, 3.0 + 1.1 * step_mm, 2, 3.0 + 1.1 * step_mm),
            (0, 3.0, 3, 3.0),
            (1, 3.0, 4, 3.0),
            (0, 3.0, 5, 3.0),
        ] {
            levels.samples_mut().fill(999);
            let shown = last.show(&frames[frame], PupilDiameter::from_mm(pupil_mm), &mut levels).unwrap();
            assert!(levels.samples().iter().all(|&sample| sample == computed), "{pupil_mm} mm");
            assert_eq!((shown.pupil.mm(), shown.rendered.clipped_share), (made_for_mm, 0.25));
        }
        assert!(last.show(&frames[0], PupilDiameter::from_mm(f32::NAN), &mut levels).is_err());
        assert!(last.show(&frames[0], PupilDiameter::from_mm(3.0), &mut levels).unwrap().rendered.engine_changed);
        assert_eq!(levels.samples()[0], 6, "after a failure nothing old is shown");
    }
}
