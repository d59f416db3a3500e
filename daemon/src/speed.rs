//! How many frames a second there are, how many the panel could show, and what would bring more.

use std::sync::Arc;
use std::time::Instant;

use holod_calibration::rig::{Panel, Rig, WeightsChoice};
use holod_calibration::{PerColour, PupilDiameter, Resolution};
use holod_model::Weights;
use holod_slm_output::{LevelsFrame, PanelEncoder};

use crate::cli::Backend;
use crate::failure::{Exit, Failure};
use crate::{renderer, setup};

/// A display that shows less than this share of the panel's frames is called slow.
const ENOUGH: f64 = 0.9;
/// The side of the frame that is timed.
const TIMED_PX: usize = 256;
/// A side that is advised is a multiple of this, and not less than [`LEAST_SIDE_PX`].
const SIDE_STEP_PX: usize = 16;
const LEAST_SIDE_PX: usize = 64;

/// Frames of all colours that the panel can show in a second.
pub fn panel_frames_hz(panel: &Panel) -> f64 {
    panel.refresh_hz * panel.mode.fields_per_refresh() / panel.fields() as f64
}

/// What would bring `frames_hz` frames of `size` nearer to the panel's; nothing where there are enough.
pub fn advice(frames_hz: f64, rig: &Rig, size: Resolution) -> Option<String> {
    let panel_hz = panel_frames_hz(&rig.panel);
    if frames_hz >= ENOUGH * panel_hz {
        return None;
    }
    let mut cures = Vec::new();
    if rig.model.weights == WeightsChoice::Standard {
        cures.push("--weights small takes about two thirds of the time".to_owned());
    }
    // Time goes with the number of pixels.
    let shrunk = |side: usize| {
        let side = side as f64 * (frames_hz / panel_hz).sqrt();
        (side as usize / SIDE_STEP_PX * SIDE_STEP_PX).max(LEAST_SIDE_PX)
    };
    let small = Resolution { width: shrunk(size.width), height: shrunk(size.height) };
    if small.width < size.width && small.height < size.height {
        cures.push(format!("--resolution {small} (with --fit contain where a scene is named) is about what keeps up"));
    }
    cures.push("more or faster cores help; this version does not compute on a GPU".to_owned());
    Some(cures.join("; "))
}

/// The time of one small frame, from which those of others are estimated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// Size of the frame that was timed.
    pub timed: Resolution,
    seconds: f64,
}

impl Estimate {
    /// Times a small frame on the rig's panel, after one that warms up.
    ///
    /// # Errors
    /// The backend is not to be had, or the rig contradicts itself.
    pub fn of(rig: &Rig, weights: &Weights) -> Result<Self, Failure> {
        let panel = rig.resolution();
        let timed = Resolution { width: TIMED_PX.min(panel.width), height: TIMED_PX.min(panel.height) };
        // A panel of the frame's size: what surrounds the frame would be timed, too, and does not go with its pixels.
        let panel = Panel { flatness_rad: PerColour([None, None, None]), ..rig.panel.clone() };
        let encoder = PanelEncoder::new(&panel, timed, timed).map(Arc::new).map_err(Failure::because(Exit::Config))?;
        let mut renderer = renderer::open(Backend::Auto, weights, &encoder)?;
        let (frame, mut levels) = (Arc::new(setup::sample_frame(timed)), LevelsFrame::new(encoder.layout()));
        let pupil = PupilDiameter::from_mm(weights.config().pupil_range_mm[0]);
        let mut seconds = f64::MAX;
        for _ in 0..2 {
            let began = Instant::now();
            renderer.render(&frame, pupil, &mut levels).map_err(Failure::because(Exit::Software))?;
            seconds = seconds.min(began.elapsed().as_secs_f64());
        }
        Ok(Self { timed, seconds })
    }

    /// Frames of `size` a second: time goes with the number of pixels.
    pub fn frames_hz(&self, size: Resolution) -> f64 {
        self.timed.pixels() as f64 / size.pixels() as f64 / self.seconds
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use holod_calibration::rig::PanelMode;

    const SIZE: Resolution = Resolution { width: 1920, height: 1080 };

    #[test]
    fn a_slow_display_is_told_what_helps_and_a_fast_one_nothing() {
        let mut rig = Rig::default();
        assert_eq!(advice(60.0, &rig, SIZE), None);
        assert_eq!(advice(54.1, &rig, SIZE), None);
        let said = advice(0.6, &rig, SIZE).unwrap();
        // A tenth of each side.
        assert!(
            said.contains("--weights small") && said.contains("--resolution 192x96") && said.contains("GPU"),
            "{said}"
        );
        rig.model.weights = WeightsChoice::Small;
        assert!(!advice(0.6, &rig, SIZE).unwrap().contains("--weights"));
        let least = Resolution { width: 64, height: 64 };
        assert!(!advice(0.6, &rig, least).unwrap().contains("--resolution"));
    }

    #[test]
    fn a_panel_shows_as_many_frames_as_it_has_fields_for() {
        let mut panel = Rig::default().panel;
        assert!((panel_frames_hz(&panel) - 60.0).abs() < 1e-6);
        panel.mode = PanelMode::FieldSequential;
        assert!((panel_frames_hz(&panel) - 20.0).abs() < 1e-6);
        panel.frames_per_colour = 2;
        assert!((panel_frames_hz(&panel) - 10.0).abs() < 1e-6);
    }

    #[test]
    fn the_estimate_goes_with_the_pixels() {
        let estimate = Estimate { timed: Resolution { width: 256, height: 256 }, seconds: 0.25 };
        assert_eq!(estimate.frames_hz(Resolution { width: 256, height: 256 }), 4.0);
        assert_eq!(estimate.frames_hz(Resolution { width: 512, height: 512 }), 1.0);
    }
}
