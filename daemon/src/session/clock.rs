//! The clock of a run: the host's, which tests can make jump.

#[cfg(feature = "fault-injection")]
pub(super) use crate::fault::host_now;
#[cfg(not(feature = "fault-injection"))]
pub(super) use holod_calibration::host_now;
