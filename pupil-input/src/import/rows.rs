//! What a recording is made of.

use holod_calibration::TimeNs;

use crate::SampleEye;

/// One recorded sample, compact.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    pub(super) t_ns: i64,
    pub(super) diameter_mm: f32,
    pub(super) confidence: f32,
    /// NaN where there is none.
    pub(super) aperture_mm: f32,
    pub(super) eye: SampleEye,
    pub(super) valid: bool,
}

/// A blink that the tracker or its software found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Blink {
    /// The eye; both where the log does not say.
    pub eye: SampleEye,
    /// Its first instant on the log's clock.
    pub begins: TimeNs,
    /// Its last instant on the log's clock.
    pub ends: TimeNs,
}
