//! The pupil that holograms are made for: the last one, until the estimate has moved away from it.
//!
//! A hologram for a pupil that differs by some hundredths of a millimetre looks the same but for its grain, as phases
//! are rounded to the panel's levels: `daemon/doc/pupil-step.md` has the figures. Made for each estimate of an eye that
//! rests, holograms would flicker by that.

use holod_calibration::PupilDiameter;

/// Follows an estimate in steps.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct HeldPupil {
    held: Option<PupilDiameter>,
}

impl HeldPupil {
    /// The pupil for a frame whose estimate is this: the held one, or the estimate itself where that is farther from it
    /// than `step_mm`.
    pub(super) fn follow(&mut self, estimate: PupilDiameter, step_mm: f32) -> PupilDiameter {
        match self.held {
            Some(held) if (estimate.mm() - held.mm()).abs() <= step_mm => held,
            _ => self.take(estimate),
        }
    }

    /// Holds this one, whatever was held before.
    pub(super) fn take(&mut self, pupil: PupilDiameter) -> PupilDiameter {
        self.held = Some(pupil);
        pupil
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_MM: f32 = 0.1;

    fn follow(estimates_mm: &[f32], step_mm: f32) -> Vec<f32> {
        let mut held = HeldPupil::default();
        estimates_mm.iter().map(|&mm| held.follow(PupilDiameter::from_mm(mm), step_mm).mm()).collect()
    }

    fn changes(shown_mm: &[f32]) -> usize {
        shown_mm.windows(2).filter(|pair| pair[0] != pair[1]).count()
    }

    #[test]
    fn what_moves_by_less_than_a_step_is_held_and_what_moves_by_more_is_followed_at_once() {
        let shown = follow(&[3.0, 3.09, 2.91, 3.0, 3.11, 3.02, 5.0, 5.0, 4.95], STEP_MM);
        assert_eq!(shown, [3.0, 3.0, 3.0, 3.0, 3.11, 3.11, 5.0, 5.0, 5.0]);
    }

    #[test]
    fn a_slow_drift_is_never_more_than_a_step_behind() {
        let estimates: Vec<f32> = (0..=2_000).map(|frame| 3.0 + frame as f32 * 1e-3).collect();
        let shown = follow(&estimates, STEP_MM);
        assert!(shown.iter().zip(&estimates).all(|(shown, estimate)| (shown - estimate).abs() <= STEP_MM));
        assert!((18..=20).contains(&changes(&shown)), "{}", changes(&shown));
    }

    #[test]
    fn an_eye_that_rests_keeps_its_hologram_and_without_a_step_each_has_its_own() {
        // A minute at 60 Hz: up to 0.06 mm from the mean, 0.025 mm in the root mean square.
        let noise = |frame: f32| [1.3, 2.9, 0.7].map(|rate| 0.02 * (rate * frame).sin()).iter().sum::<f32>();
        let estimates: Vec<f32> = (0..3_600_i16).map(|frame| 4.0 + noise(f32::from(frame))).collect();
        let steps = [STEP_MM, 0.0].map(|step_mm| changes(&follow(&estimates, step_mm)));
        assert!(steps[0] <= 6 && steps[1] >= 3_500, "{steps:?}");
    }

    #[test]
    fn a_pupil_that_is_taken_is_exact_and_held() {
        let mut held = HeldPupil::default();
        let mm = |pupil_mm| PupilDiameter::from_mm(pupil_mm);
        held.follow(mm(3.0), STEP_MM);
        assert_eq!(held.take(mm(3.05)).mm(), 3.05);
        assert_eq!(held.follow(mm(3.1), STEP_MM).mm(), 3.05);
    }
}
