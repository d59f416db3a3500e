//! HID trackers, as far as a machine without one can tell. tests/qemu has the rest, in a guest with a virtual tracker.

use holod_calibration::rig;
use holod_pupil_input::{Tracker, TrackerSpec, host_now};

fn refused(spec: &str) -> String {
    let spec: TrackerSpec = spec.parse().expect("a spec");
    Tracker::start(&spec, &rig::Rig::default().tracker, host_now()).expect_err("is refused").to_string()
}

#[test]
fn a_tracker_that_is_not_plugged_in_is_told_with_what_is() {
    // No device has these ids, which are those of no vendor.
    let message = refused("hid:0000:fffe,profile=holod,serial=none");
    assert!(message.starts_with("no HID device is 0000:fffe with serial=none; there "), "{message}");
    assert!(message.contains("plug the tracker in"), "{message}");
}

#[test]
fn a_device_without_a_profile_is_told_so() {
    let message = refused("hid:0000:fffe");
    assert!(message.contains("no shipped profile is for the HID device 0000:fffe"), "{message}");
    assert!(message.contains("`,profile=NAME`"), "{message}");
    let message = refused("hid:,profile=holod");
    assert!(message.contains("profile `holod` names no HID device; expected `hid:VID:PID,profile=holod`"), "{message}");
}
