//! Trackers that run: on real PTYs that are unplugged, fall silent and send rubbish, and on logs.

use std::io::{Read as _, Write as _};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::time::{Duration, Instant};

use crate::support::{NEON_BLINKS_S, neon_like_csv};
use holod_calibration::{PupilDiameter, TimeNs, rig};
use holod_pupil_input::wire::WireFault;
use holod_pupil_input::wire::line::{LineSample, crc8, encode_line};
use holod_pupil_input::{
    ChangeError, Counter, Link, LogFault, PupilState, Recording, SampleEye, Tracker, TrackerHandle, TrackerOptions,
    TrackerSpec, Verdict, host_now,
};
use serialport::{SerialPort, TTYPort};
use tempfile::TempDir;

/// A tracker at the far end of a PTY. Dropping it unplugs it.
struct Plug {
    tracker: TTYPort,
    /// Kept open, so that the tracker may write before holod reads.
    port: TTYPort,
}

impl Plug {
    fn new() -> Self {
        let (tracker, port) = TTYPort::pair().expect("a PTY");
        Self { tracker, port }
    }

    /// Where holod finds it.
    fn path(&self) -> String {
        self.port.name().expect("a path")
    }

    fn send(&mut self, bytes: &[u8]) {
        self.tracker.write_all(bytes).expect("writes");
    }
}

fn start(spec: &str) -> TrackerHandle {
    let settings = rig::Tracker { eye: rig::Eye::Left, ..rig::Rig::default().tracker };
    Tracker::start(&spec.parse().expect("a spec"), &settings, host_now()).expect("starts")
}

fn refused(spec: &str) -> String {
    let spec: TrackerSpec = spec.parse().expect("a spec");
    Tracker::start(&spec, &rig::Rig::default().tracker, host_now()).expect_err("is refused").to_string()
}

/// Waits until `holds`, for as long as a slow machine may need.
fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < Duration::from_secs(20), "never came: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn line(sequence: u64, diameter_mm: f32) -> String {
    let mut text = String::new();
    let eye = SampleEye::Left;
    encode_line(
        &LineSample { sequence, device_us: sequence as i64 * 5000, eye, diameter_mm, confidence: 1.0 },
        &mut text,
    );
    text
}

/// Sends steady samples at about 200 Hz until `holds`; gives the next sequence number.
fn feed_until(tracker: &mut Plug, first: u64, what: &str, mut holds: impl FnMut() -> bool) -> u64 {
    let mut sequence = first;
    eventually(what, || {
        tracker.send(line(sequence, 4.0).as_bytes());
        sequence += 1;
        holds()
    });
    sequence
}

fn tracks(handle: &mut TrackerHandle) -> bool {
    let estimate = handle.estimate.pupil_at(host_now());
    estimate.state == PupilState::Tracking && (estimate.pupil.mm() - 4.0).abs() < 0.01
}

#[test]
fn samples_are_followed_and_rubbish_is_counted() {
    let mut tracker = Plug::new();
    let mut handle = start(&tracker.path());
    let next = feed_until(&mut tracker, 0, "tracking", || tracks(&mut handle));
    let before = handle.control.counters();
    assert_eq!(before.of(Counter::Connects), 1);
    assert_eq!(before.faults_in_all(), 0);
    let clock = handle.control.clock().expect("lines carry times");
    assert!((TimeNs(0)..host_now()).contains(&clock.offset), "{clock:?}");

    let half = &line(next, 4.0)[..10];
    let rubbish = format!(
        "# hello\r\n{}\nnonsense\n{half}{}{}{}",
        "x".repeat(5000),
        line(next + 1, 4.0),
        line(next + 2, 4.0).replace("4,1", "5,1"),
        line(next + 5, 4.0).replace('\n', "\r\n"),
    );
    // Byte by byte, as a slow port has it.
    for byte in rubbish.as_bytes() {
        tracker.send(&[*byte]);
    }
    feed_until(&mut tracker, next + 6, "tracking through rubbish", || {
        handle.control.counters().of(Counter::Samples) > before.of(Counter::Samples) + 10 && tracks(&mut handle)
    });
    let counters = handle.control.counters();
    assert_eq!(counters.of(Counter::Notes), 1);
    assert_eq!(counters.fault(LogFault::Wire(WireFault::TooLong)), 1);
    assert_eq!(counters.fault(LogFault::Wire(WireFault::Malformed)), 1);
    assert_eq!(counters.fault(LogFault::Wire(WireFault::BadChecksum)), 2);
    assert_eq!(counters.of(Counter::SequenceGaps), 2);
    assert_eq!(counters.of(Counter::SequenceMissing), 4);
    assert_eq!(counters.of(Counter::Disconnects), 0);
    handle.control.stop();
    assert_eq!(handle.control.link(), Link::Finished);

    let mut accepted = 0;
    while let Some(decision) = handle.decisions.pop() {
        accepted += u64::from(decision.verdict == Verdict::Accepted);
    }
    let counters = handle.control.counters();
    assert_eq!(accepted, counters.of(Counter::Accepted));
    assert_eq!(counters.of(Counter::Accepted) + counters.rejected_in_all(), counters.of(Counter::Samples));
}

#[test]
fn a_port_that_is_unplugged_is_opened_again_where_it_comes_back() {
    let dir = TempDir::new().expect("a folder");
    let by_id = dir.path().join("tracker");
    let mut tracker = Plug::new();
    symlink(tracker.path(), &by_id).expect("links");
    let mut handle = start(&format!("serial:{},baud=9600", by_id.display()));
    feed_until(&mut tracker, 0, "tracking", || tracks(&mut handle));

    // First its name: that of its terminal may be another test's at once.
    std::fs::remove_file(&by_id).expect("unlinks");
    drop(tracker);
    eventually("the loss", || handle.control.link() == Link::Down);
    eventually("holding", || handle.estimate.pupil_at(host_now()).state == PupilState::Holding);
    eventually("tries", || handle.control.counters().of(Counter::ReconnectAttempts) >= 2);
    eventually("fallback", || handle.estimate.pupil_at(host_now() + TimeNs::from_seconds(5.0)).pupil.mm() == 3.0);

    // A file or folder in its place is no port.
    std::fs::create_dir(&by_id).expect("a folder");
    let tries = handle.control.counters().of(Counter::ReconnectAttempts);
    eventually("another try", || handle.control.counters().of(Counter::ReconnectAttempts) > tries);
    std::fs::remove_dir(&by_id).expect("removes");

    let mut tracker = Plug::new();
    symlink(tracker.path(), &by_id).expect("links");
    // The tracker restarted: numbers and clock begin anew.
    feed_until(&mut tracker, 0, "tracking again", || tracks(&mut handle));
    let counters = handle.control.counters();
    assert_eq!(counters.of(Counter::Disconnects), 1);
    assert_eq!(counters.of(Counter::Connects), 2);
    assert_eq!(counters.of(Counter::SequenceRestarts), 0);
}

#[test]
fn silence_is_noticed_once_and_ends() {
    let mut tracker = Plug::new();
    let mut handle = start(&tracker.path());
    let next = feed_until(&mut tracker, 0, "tracking", || tracks(&mut handle));
    eventually("silence", || handle.control.link() == Link::Silent);
    let silences = handle.control.counters().of(Counter::Silences);
    assert!(silences >= 1);
    std::thread::sleep(Duration::from_millis(700));
    assert_eq!(handle.control.counters().of(Counter::Silences), silences);
    feed_until(&mut tracker, next, "tracking again", || tracks(&mut handle));
    assert_eq!(handle.control.link(), Link::Up);
}

/// A tracker that must be told to start, and its profile.
fn profile_with_commands(dir: &TempDir) -> String {
    let path = dir.path().join("talks.toml");
    let text = r#"
format = "holod-tracker-1"
name = "talks"
about = "Holod's lines from a device that must be asked."

[wire]
kind = "holod"

[serial]
baud = 115200
start = [{ send = "GO\r", expect = "OK\r", within_ms = 300 }]
stop = [{ send = "HALT\r", expect = "BYE\r", within_ms = 100 }]
"#;
    std::fs::write(&path, text).expect("writes");
    path.display().to_string()
}

/// What the tracker hears until it hears nothing more.
fn heard(tracker: &mut Plug) -> String {
    tracker.tracker.set_timeout(Duration::from_millis(100)).expect("sets");
    let mut bytes = Vec::new();
    let _ = tracker.tracker.read_to_end(&mut bytes);
    String::from_utf8(bytes).expect("text")
}

#[test]
fn a_tracker_is_told_to_start_and_by_a_drop_to_stop() {
    let dir = TempDir::new().expect("a folder");
    let mut tracker = Plug::new();
    let spec = format!("serial:{},profile={}", tracker.path(), profile_with_commands(&dir));
    // It is reset when its port is opened, and hears only the second command.
    let mut ends = tracker.tracker.try_clone_native().expect("clones");
    let boot = std::thread::spawn(move || {
        let mut word = [0; 3];
        for _ in 0..2 {
            ends.set_timeout(Duration::from_secs(20)).expect("sets");
            ends.read_exact(&mut word).expect("hears");
            assert_eq!(&word, b"GO\r");
        }
        ends.write_all(format!("boot\nOK\r{}", line(0, 4.0)).as_bytes()).expect("answers");
    });
    let mut handle = start(&spec);
    boot.join().expect("no panic");
    feed_until(&mut tracker, 1, "tracking", || tracks(&mut handle));
    assert_eq!(handle.control.counters().of(Counter::SequenceMissing), 0, "the first sample came with the answer");
    drop(handle);
    assert_eq!(heard(&mut tracker), "HALT\r".repeat(3), "it never said BYE");
}

#[test]
fn a_laser_box_is_refused_before_a_byte_is_written() {
    let dir = TempDir::new().expect("a folder");
    let mut tracker = Plug::new();
    let settings = rig::Rig::default().tracker;
    let options = TrackerOptions { forbidden: vec![tracker.path().into()], ..TrackerOptions::from(host_now()) };
    let spec = tracker.path().parse().expect("a spec");
    let message = Tracker::start(&spec, &settings, options).expect_err("is refused").to_string();
    assert!(message.contains("nothing was opened"), "{message}");

    let text = "!HBLOST";
    tracker.send(format!("{text}*{:02X}\n", crc8(text.as_bytes())).as_bytes());
    let message = refused(&format!("serial:{},profile={}", tracker.path(), profile_with_commands(&dir)));
    assert!(message.contains("a laser box of holod's") && message.contains("nothing was written"), "{message}");
    assert_eq!(heard(&mut tracker), "");
}

#[test]
fn a_board_that_restarts_when_its_port_is_opened_is_not_called_silent() {
    let mut tracker = Plug::new();
    let mut handle = start(&tracker.path());
    std::thread::sleep(Duration::from_millis(1500));
    assert_eq!((handle.control.link(), handle.control.counters().of(Counter::Silences)), (Link::Up, 0));
    // What it sent before the reset is cut off.
    tracker.send(&line(7, 4.0).as_bytes()[5..]);
    feed_until(&mut tracker, 0, "tracking", || tracks(&mut handle));
    assert_eq!((handle.control.counters().of(Counter::Partials), handle.control.counters().faults_in_all()), (1, 0));
}

#[test]
fn a_port_that_never_speaks_is_called_silent() {
    let tracker = Plug::new();
    let handle = start(&tracker.path());
    eventually("silence", || handle.control.link() == Link::Silent);
}

#[test]
fn stopping_does_not_wait_for_the_tracker() {
    let tracker = Plug::new();
    let mut handle = start(&tracker.path());
    handle.control.stop();
    assert!(handle.control.finished());
    // The port is free again.
    start(&tracker.path()).control.stop();
    // So it is in the middle of a log that has hours to go.
    let dir = TempDir::new().expect("a folder");
    let log = dir.path().join("log");
    std::fs::write(&log, line(0, 4.0) + &line(3_600_000, 4.0)).expect("writes");
    start(&log.display().to_string()).control.stop();
}

#[test]
fn what_is_no_port_is_refused_with_what_to_do() {
    let dir = TempDir::new().expect("a folder");
    let message = refused("/dev/holod-no-such-port");
    assert!(message.contains("/dev/holod-no-such-port does not exist"), "{message}");
    assert!(message.contains("port"), "{message}");
    let message = refused(&dir.path().display().to_string());
    assert!(message.contains("is a directory; expected a serial port"), "{message}");
    let file = dir.path().join("log.csv");
    std::fs::write(&file, "x").expect("writes");
    let message = refused(&format!("serial:{}", file.display()));
    assert!(message.contains("is a regular file"), "{message}");
    assert!(message.contains(&format!("replay:{}", file.display())), "{message}");
    let message = refused("/dev/null");
    assert!(message.contains("/dev/null does not open"), "{message}");
    let message = refused(&file.display().to_string());
    assert!(message.contains("found `x`"), "{message}");

    let tracker = Plug::new();
    let _first = start(&tracker.path());
    let message = refused(&tracker.path());
    assert!(message.contains("another program"), "{message}");
}

/// A running tracker takes another eye and another fallback while its link is silent, too.
#[test]
fn a_running_tracker_goes_on_with_other_settings() {
    let mut tracker = Plug::new();
    let TrackerHandle { estimate: mut pupil, mut control, .. } = start(&tracker.path());
    let settings = rig::Tracker { eye: rig::Eye::Left, ..rig::Rig::default().tracker };
    let fallback_5 = rig::Tracker { fallback: PupilDiameter::from_mm(5.0), ..settings.clone() };
    control.change(&fallback_5).expect("is taken");
    eventually("the change to be taken", || !control.is_changing());
    // No faster than an eye could.
    eventually("the other fallback", || pupil.pupil_at(host_now()).pupil.mm() == 5.0);

    control.change(&rig::Tracker { eye: rig::Eye::Right, ..settings }).expect("is taken");
    let mut sequence = 0;
    eventually("the right eye", || {
        let mut text = String::new();
        for (eye, diameter_mm) in [(SampleEye::Left, 4.0), (SampleEye::Right, 3.4)] {
            let device_us = sequence as i64 * 2500;
            encode_line(&LineSample { sequence, device_us, eye, diameter_mm, confidence: 1.0 }, &mut text);
            sequence += 1;
        }
        tracker.send(text.as_bytes());
        let estimate = pupil.pupil_at(host_now());
        estimate.state == PupilState::Tracking && (estimate.pupil.mm() - 3.4).abs() < 0.05
    });
    control.stop();
    assert_eq!(control.change(&fallback_5), Err(ChangeError::Finished));
}

/// Plays a Neon-like log in real time, as protocol lines of confidence 1, through a PTY.
#[test]
fn blinks_are_held_on_a_pty_that_tells_only_diameters() {
    let dir = TempDir::new().expect("a folder");
    let log = dir.path().join("log.csv");
    std::fs::write(&log, neon_like_csv(12)).expect("writes");
    let recording = Recording::read(&log).expect("reads");
    let mut tracker = Plug::new();
    let mut handle = start(&tracker.path());

    let begun = host_now();
    let first = recording.begins();
    let mut held_in = [false; NEON_BLINKS_S.len()];
    for (sequence, sample) in recording.samples().filter(|sample| sample.eye == SampleEye::Left).enumerate() {
        let since = sample.t_sample - first;
        let due = begun + since - host_now();
        std::thread::sleep(Duration::from_nanos(due.0.max(0).unsigned_abs()));
        let mut text = String::new();
        let device_us = since.0 / 1000;
        let diameter_mm = sample.diameter_mm;
        let eye = SampleEye::Left;
        encode_line(&LineSample { sequence: sequence as u64, device_us, eye, diameter_mm, confidence: 1.0 }, &mut text);
        tracker.send(text.as_bytes());
        if since > TimeNs::from_seconds(0.6) {
            for ahead_ms in [0, 20, 40] {
                let estimate = handle.estimate.pupil_at(host_now() + TimeNs(ahead_ms * 1_000_000));
                assert!((3.0..4.3).contains(&estimate.pupil.mm()), "{estimate:?} at {} s", since.seconds());
                for (held, begin_s) in held_in.iter_mut().zip(NEON_BLINKS_S) {
                    let within = (begin_s + 0.1..begin_s + 0.2).contains(&since.seconds());
                    *held |= within && estimate.state == PupilState::Holding;
                }
            }
        }
    }
    assert_eq!(held_in, [true; 2]);
}

fn play(path: &Path, options: &str) -> TrackerHandle {
    start(&format!("replay:{}{options}", path.display()))
}

#[test]
fn a_log_ends_in_the_fallback() {
    let dir = TempDir::new().expect("a folder");
    let log = dir.path().join("log.csv");
    std::fs::write(&log, neon_like_csv(13)).expect("writes");
    for options in [",speed=20", ",speed=max"] {
        let begins = host_now();
        let mut handle = play(&log, options);
        eventually("the end", || handle.control.finished());
        let counters = handle.control.counters();
        assert_eq!(counters.of(Counter::Samples), 2000);
        assert_eq!(counters.of(Counter::Accepted) + counters.rejected_in_all(), 2000);
        assert_eq!(counters.rejected(holod_pupil_input::Rejection::OtherEye), 1000);
        assert!(counters.of(Counter::Accepted) > 800, "{options}: {}", counters.of(Counter::Accepted));
        let later = handle.estimate.pupil_at(host_now() + TimeNs::from_seconds(30.0));
        assert_eq!((later.state, later.pupil.mm()), (PupilState::Fallback, 3.0));
        if options == ",speed=max" {
            // However long ago that was, it was no fallback when it began.
            let held = handle.estimate.pupil_at(begins);
            assert!(held.raw_mm.is_some_and(|raw_mm| (3.3..4.2).contains(&raw_mm)));
        }
        let mut last = TimeNs(i64::MIN);
        while let Some(decision) = handle.decisions.pop() {
            last = last.max(decision.sample.t_sample);
        }
        assert!(last <= host_now(), "decisions are on the host's clock");
    }
}

#[test]
fn a_looped_log_goes_on() {
    let dir = TempDir::new().expect("a folder");
    let log = dir.path().join("log");
    std::fs::write(&log, (0..200).map(|k| line(k, 4.0)).collect::<String>()).expect("writes");
    let mut handle = play(&log, ",speed=50,loop");
    eventually("three loops", || handle.control.counters().of(Counter::Loops) >= 3);
    eventually("tracking", || tracks(&mut handle));
    let counters = handle.control.counters();
    assert_eq!(counters.rejected_in_all(), 0, "the seam is no step");
    assert!(!handle.control.finished());
}

#[test]
fn the_mock_runs_and_is_followed() {
    let mut handle = start("mock:steady");
    eventually("tracking", || {
        let estimate = handle.estimate.pupil_at(host_now());
        estimate.state == PupilState::Tracking && (3.7..4.4).contains(&estimate.pupil.mm())
    });
    let TrackerHandle { estimate: mut reader, decisions: mut tap, mut control } = handle;
    eventually("tracking in parts", || reader.pupil_at(host_now()).state == PupilState::Tracking);
    assert!(tap.pop().is_some());
    assert_eq!(control.link(), Link::Up);
    control.stop();
    assert!(control.finished());
}
