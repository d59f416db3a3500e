//! A tracker that runs, recorded, allocates nothing for the samples that come. The only test in its crate: it counts
//! the allocations of all threads.

use std::io::Write as _;
use std::time::{Duration, Instant};

use holod_calibration::rig;
use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_pupil_input::{Counter, RecordFiles, SampleEye, Tracker, TrackerHandle, TrackerOptions, host_now};
use holod_tests::counting::{self, Counting};
use serialport::{SerialPort, TTYPort};
use tempfile::TempDir;

#[global_allocator]
static COUNTING: Counting = Counting;

fn send(tracker: &mut TTYPort, lines: &[String], handle: &mut TrackerHandle) {
    for line in lines {
        tracker.write_all(line.as_bytes()).expect("writes");
        std::thread::sleep(Duration::from_micros(500));
        handle.estimate.pupil_at(host_now());
        while handle.decisions.pop().is_some() {}
    }
}

#[test]
fn bytes_of_a_link_become_estimates_and_records_without_allocation() {
    let folder = TempDir::new().expect("a folder");
    let (mut tracker, port) = TTYPort::pair().expect("a PTY");
    let options =
        TrackerOptions { record: Some(RecordFiles::in_folder(folder.path())), ..TrackerOptions::from(host_now()) };
    let spec = port.name().expect("a path").parse().expect("a spec");
    let mut handle = Tracker::start(&spec, &rig::Rig::default().tracker, options).expect("starts");
    let mut lines = Vec::new();
    for sequence in 0..4000 {
        let mut text = String::new();
        let (eye, device_us) = (SampleEye::ALL[sequence as usize % 2], sequence as i64 * 500);
        encode_line(&LineSample { sequence, device_us, eye, diameter_mm: 4.0, confidence: 1.0 }, &mut text);
        lines.push(text);
    }
    let (first, rest) = lines.split_at(1000);
    send(&mut tracker, first, &mut handle);

    let before = counting::elsewhere();
    send(&mut tracker, rest, &mut handle);
    let begun = Instant::now();
    while handle.control.counters().of(Counter::Samples) < 4000 {
        assert!(begun.elapsed() < Duration::from_secs(20), "never came");
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(counting::elsewhere() - before, 0);

    // The count sees other threads.
    std::thread::spawn(|| drop(std::hint::black_box(Box::new(1)))).join().expect("no panic");
    assert!(counting::elsewhere() > before);
}
