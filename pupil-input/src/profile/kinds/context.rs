//! What every kind of message is read with.

use std::cell::Cell;

use holod_calibration::toml_reader::Found;

use crate::SampleEye;
use crate::size_unit::SizeUnit;
use crate::wire::field::SizeRule;

/// The eyes, as profiles name them.
pub(in crate::profile) const EYES: [(&str, SampleEye); 3] = {
    let [left, right, both] = SampleEye::ALL;
    [(left.name(), left), (right.name(), right), (both.name(), both)]
};

/// The tables that describe a pupil, by key: an eye's own, and that of a pupil whose eye is said elsewhere.
pub(super) const PUPILS: [(&str, Option<SampleEye>); 4] = {
    let [left, right, both] = EYES;
    [(left.0, Some(left.1)), (right.0, Some(right.1)), (both.0, Some(both.1)), ("pupil", None)]
};

/// What the rest of the profile says about the figures on the wire.
pub(in crate::profile) struct Context<'a> {
    pub(in crate::profile) eye: Option<Found<'a, SampleEye>>,
    pub(in crate::profile) rate_hz: Option<Found<'a, f64>>,
    /// A frame counter is made a time by it.
    pub(in crate::profile) counts_frames: Cell<bool>,
    pub(in crate::profile) size: SizeRule,
    pub(in crate::profile) unit: SizeUnit,
    /// Where the file has its `[size]`; none without one.
    pub(in crate::profile) size_at: Option<Found<'a, ()>>,
}

impl Context<'_> {
    /// Frames a second, for what counts them.
    pub(super) fn frames_per_second(&self) -> Option<f64> {
        self.counts_frames.set(true);
        self.rate_hz.as_ref().map(|rate_hz| rate_hz.value)
    }
}
