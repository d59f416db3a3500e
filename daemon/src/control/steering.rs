//! What a person changes in the frame loop while it runs: atomics that it looks at once a frame.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use holod_calibration::{Metres, PupilDiameter};

/// The frame loop's switches.
#[derive(Debug, Default)]
pub(crate) struct Steering {
    paused: AtomicBool,
    /// Bits of millimetres; 0 where the tracker is followed.
    fixed_pupil: AtomicU32,
    /// Bits of an `f32` of millimetres.
    pupil_step: AtomicU32,
}

impl Steering {
    /// With a pupil that does not follow the tracker, where one is given, and the step in which it is followed.
    pub(crate) fn new(pupil: Option<PupilDiameter>, step: Metres) -> Self {
        let steering = Self::default();
        steering.fix_pupil(pupil);
        steering.follow_in_steps_of(step);
        steering
    }

    /// Whether the picture stands still.
    pub(crate) fn is_paused(&self) -> bool {
        self.paused.load(Ordering::Relaxed)
    }

    /// Lets the picture stand still, or go on.
    pub(crate) fn pause(&self, paused: bool) {
        self.paused.store(paused, Ordering::Relaxed);
    }

    /// The pupil that is computed for, where it is not the tracker's.
    pub(crate) fn fixed_pupil(&self) -> Option<PupilDiameter> {
        match self.fixed_pupil.load(Ordering::Relaxed) {
            0 => None,
            bits => Some(PupilDiameter::from_mm(f32::from_bits(bits))),
        }
    }

    /// Computes for `pupil`, or follows the tracker.
    pub(crate) fn fix_pupil(&self, pupil: Option<PupilDiameter>) {
        self.fixed_pupil.store(pupil.map_or(0, |pupil| pupil.mm().to_bits()), Ordering::Relaxed);
    }

    /// How far the estimate goes from the pupil of the last hologram before another one is made, in millimetres.
    pub(crate) fn pupil_step_mm(&self) -> f32 {
        f32::from_bits(self.pupil_step.load(Ordering::Relaxed))
    }

    /// Follows the tracker in other steps.
    pub(crate) fn follow_in_steps_of(&self, step: Metres) {
        self.pupil_step.store(((step.0 * 1e3) as f32).to_bits(), Ordering::Relaxed);
    }
}
