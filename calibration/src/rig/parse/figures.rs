//! Figures of a rig file as times, and in words.

use crate::TimeNs;

pub(super) fn milliseconds(ms: f64) -> TimeNs {
    TimeNs((ms * 1e6).round() as i64)
}

/// A figure to three decimals, without the zeros at its end.
pub(super) fn shown(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}
