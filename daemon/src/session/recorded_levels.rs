//! Which presented frames are kept: for each half millimetre of pupil, the newest.

use holod_calibration::PupilDiameter;

const NARROWEST_MM: f32 = 1.0;
const STEP_MM: f32 = 0.5;

/// Slots for kept frames: pupils from 1 to 7 mm.
pub(super) const KEEP_SLOTS: usize = 12;

/// The slot of a frame that was made for `pupil`.
pub(super) fn keep_slot(pupil: PupilDiameter) -> Option<usize> {
    let step = ((pupil.mm() - NARROWEST_MM) / STEP_MM).floor();
    (step >= 0.0 && step < KEEP_SLOTS as f32).then_some(step as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_are_half_millimetres_from_one_to_seven() {
        let slot = |mm| keep_slot(PupilDiameter::from_mm(mm));
        assert_eq!(
            [slot(0.99), slot(1.0), slot(1.49), slot(1.5), slot(6.99), slot(7.0)],
            [None, Some(0), Some(0), Some(1), Some(11), None]
        );
        assert_eq!(slot(f32::NAN), None);
    }
}
