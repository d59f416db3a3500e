//! What the tests of network trackers share.

use std::time::{Duration, Instant};

use holod_calibration::rig;
use holod_pupil_input::{PupilState, Tracker, TrackerHandle, TrackerSpec, host_now};

/// Starts a tracker whose left eye drives the display.
pub(crate) fn start(spec: &str) -> TrackerHandle {
    let settings = rig::Tracker { eye: rig::Eye::Left, ..rig::Rig::default().tracker };
    Tracker::start(&spec.parse().expect("a spec"), &settings, host_now()).expect("starts")
}

/// What is said to a user whose tracker does not start.
pub(crate) fn refused(spec: &str) -> String {
    let spec: TrackerSpec = spec.parse().expect("a spec");
    Tracker::start(&spec, &rig::Rig::default().tracker, host_now()).expect_err("is refused").to_string()
}

/// Waits until `holds`, for as long as a slow machine may need.
pub(crate) fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < Duration::from_secs(30), "never came: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Whether a steady pupil of 4 mm is followed.
pub(crate) fn tracks(handle: &mut TrackerHandle) -> bool {
    let estimate = handle.estimate.pupil_at(host_now());
    estimate.state == PupilState::Tracking && (estimate.pupil.mm() - 4.0).abs() < 0.01
}
