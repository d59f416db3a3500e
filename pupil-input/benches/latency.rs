//! How long a sample takes from the tracker's end of a PTY to an estimate that knows it, at 1 kHz, beside the least
//! that a program can do: a thread that reads the PTY and stores what came.
//!
//! `cargo bench -p holod-pupil-input --bench latency`

#![allow(clippy::print_stdout, reason = "the figures are its output")]

use std::io::{Read as _, Write as _};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use holod_calibration::rig;
use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_pupil_input::{RecordFiles, SampleEye, Tracker, TrackerHandle, TrackerOptions, host_now};
use serialport::{SerialPort, TTYPort};
use tempfile::TempDir;

const INTERVAL: Duration = Duration::from_millis(1);
const SAMPLES: u64 = 10_000;
/// The first of them, which are not counted: caches and the clock model are cold.
const WARM_UP: u64 = 1000;

fn line(sequence: u64) -> (String, f32) {
    // Each diameter differs from its predecessor's.
    let diameter_mm = 4.0 + (sequence % 64) as f32 / 256.0;
    let (eye, device_us) = (SampleEye::Left, sequence as i64 * 1000);
    let mut text = String::new();
    encode_line(&LineSample { sequence, device_us, eye, diameter_mm, confidence: 1.0 }, &mut text);
    (text, diameter_mm)
}

/// Writes a line each millisecond and waits until `seen` says that it has arrived; the times that took, in order.
fn measure(tracker: &mut TTYPort, mut seen: impl FnMut(u64, f32) -> bool) -> Vec<Duration> {
    let mut latencies = Vec::new();
    let begun = Instant::now();
    for sequence in 0..SAMPLES {
        let (text, diameter_mm) = line(sequence);
        let due = INTERVAL * sequence as u32;
        std::thread::sleep(due.saturating_sub(begun.elapsed()));
        let written = Instant::now();
        tracker.write_all(text.as_bytes()).expect("writes");
        while !seen(text.len() as u64, diameter_mm) {
            assert!(written.elapsed() < Duration::from_secs(5), "a sample never came");
            std::hint::spin_loop();
        }
        if sequence >= WARM_UP {
            latencies.push(written.elapsed());
        }
    }
    latencies.sort();
    latencies
}

fn print(name: &str, latencies: &[Duration]) {
    let at = |share: f64| latencies[((latencies.len() - 1) as f64 * share) as usize].as_secs_f64() * 1e6;
    println!("{name:40} p50 {:7.1}   p99 {:7.1}   max {:8.1} us", at(0.5), at(0.99), at(1.0));
}

fn holod(record: Option<RecordFiles>) -> Vec<Duration> {
    let (mut tracker, port) = TTYPort::pair().expect("a PTY");
    let spec = port.name().expect("a path").parse().expect("a spec");
    let settings = rig::Tracker { eye: rig::Eye::Left, ..rig::Rig::default().tracker };
    let options = TrackerOptions { record, ..TrackerOptions::from(host_now()) };
    let mut handle: TrackerHandle = Tracker::start(&spec, &settings, options).expect("starts");
    let mut before = None;
    measure(&mut tracker, |_, _| {
        let t_heard = handle.estimate.pupil_at(host_now()).t_heard;
        t_heard > std::mem::replace(&mut before, t_heard)
    })
}

fn bare() -> Vec<Duration> {
    let (mut tracker, mut port) = TTYPort::pair().expect("a PTY");
    port.set_timeout(Duration::from_millis(50)).expect("sets");
    let count = Arc::new(AtomicU64::new(0));
    let counted = Arc::clone(&count);
    // Ends with an error when the other end is dropped.
    let reader = std::thread::spawn(move || {
        let mut buffer = [0; 4096];
        loop {
            match port.read(&mut buffer) {
                Ok(bytes) => counted.fetch_add(bytes as u64, Ordering::Release),
                Err(error) if error.kind() == std::io::ErrorKind::TimedOut => continue,
                Err(_) => return,
            };
        }
    });
    let mut sent = 0;
    let mut last = f32::NAN;
    let latencies = measure(&mut tracker, |bytes, diameter_mm| {
        if diameter_mm != last {
            (sent, last) = (sent + bytes, diameter_mm);
        }
        count.load(Ordering::Acquire) >= sent
    });
    drop(tracker);
    reader.join().expect("no panic");
    latencies
}

fn main() {
    let folder = TempDir::new().expect("a folder");
    println!("write at the tracker's end of a PTY -> seen, {} samples at 1 kHz", SAMPLES - WARM_UP);
    for _ in 0..2 {
        print("bare PTY read in a thread", &bare());
        print("holod: published estimate", &holod(None));
    }
    print("holod: published estimate, recording", &holod(Some(RecordFiles::in_folder(folder.path()))));
}
