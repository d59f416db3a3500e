//! The host's clock.

use crate::TimeNs;

/// The host's monotonic clock, the one place where it is read: all time points are on it, those of a simulated laser
/// box in another process as well.
pub fn host_now() -> TimeNs {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    TimeNs(now.tv_sec * 1_000_000_000 + now.tv_nsec)
}
