//! One measurement of a pupil.

use std::fmt;

use holod_calibration::TimeNs;

crate::named::named! {
    /// Which eye a sample was taken of.
    pub enum SampleEye {
        /// The viewer's left eye.
        Left = "left",
        /// The viewer's right eye.
        Right = "right",
        /// Both: the tracker gives one figure for the pair.
        Both = "both",
    }
}

impl SampleEye {
    /// The eye of this name.
    pub(crate) fn named(name: &[u8]) -> Option<Self> {
        Self::ALL.into_iter().find(|eye| eye.name().as_bytes() == name)
    }

    /// The letter that stands for it on the wire.
    pub const fn letter(self) -> char {
        match self {
            Self::Left => 'L',
            Self::Right => 'R',
            Self::Both => 'B',
        }
    }
}

impl fmt::Display for SampleEye {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A pupil diameter as the tracker gave it, with the three times that matter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PupilSample {
    /// When it was taken, on the tracker's own clock; its origin means nothing to the host.
    pub t_device: TimeNs,
    /// When it was taken, on the stream's clock: the host's monotonic clock for a live tracker
    /// ([`ClockModel`](crate::ClockModel) maps it), the log's own time for a log.
    pub t_sample: TimeNs,
    /// When its bytes were read, on the host's monotonic clock.
    pub t_arrival: TimeNs,
    /// Which eye it was taken of.
    pub eye: SampleEye,
    /// Diameter in millimetres as given, before the rig's scale.
    pub diameter_mm: f32,
    /// The tracker's confidence, 0..=1; 1 where it gives none.
    pub confidence: f32,
    /// Distance between the lids in millimetres, from trackers that measure it.
    pub aperture_mm: Option<f32>,
    /// The tracker's running number, where it has one.
    pub sequence: Option<u64>,
    /// False where the tracker itself says that it sees no pupil; the diameter then means nothing.
    pub valid: bool,
}
