//! What a person changes in the frame loop while it runs: atomics that it looks at once a frame.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use holod_calibration::PupilDiameter;

/// The frame loop's switches.
#[derive(Debug, Default)]
pub(crate) struct Steering {
    paused: AtomicBool,
    /// Bits of millimetres; 0 where the tracker is followed.
    fixed_pupil: AtomicU32,
}

impl Steering {
    /// With a pupil that does not follow the tracker, where one is given.
    pub(crate) fn new(pupil: Option<PupilDiameter>) -> Self {
        let steering = Self::default();
        steering.fix_pupil(pupil);
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
}
