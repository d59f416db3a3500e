//! Runs that are written down and played again.

use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::time::{Duration, Instant};

use flate2::Compression;
use flate2::write::GzEncoder;
use holod_calibration::{TimeNs, rig};
use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_pupil_input::{
    Counter, Decision, LogFormat, MockSource, RecordFiles, Recording, SampleEye, Scenario, Tracker, TrackerHandle,
    TrackerOptions, host_now,
};
use serialport::{SerialPort, TTYPort};
use tempfile::TempDir;

fn start(spec: &str, record: Option<RecordFiles>) -> TrackerHandle {
    let settings = rig::Tracker { eye: rig::Eye::Both, ..rig::Rig::default().tracker };
    let options = TrackerOptions { record, ..TrackerOptions::from(host_now()) };
    Tracker::start(&spec.parse().expect("a spec"), &settings, options).expect("starts")
}

fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < Duration::from_secs(30), "never came: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Both eyes with blinks, as protocol lines, with rubbish between.
fn lines() -> String {
    let mut text = String::new();
    for mock in MockSource::new(Scenario::Blinks, 5).take(1200) {
        let sample = mock.sample;
        let (sequence, device_us) = (sample.sequence.expect("the mock counts"), sample.t_device.0 / 1000);
        let (eye, diameter_mm, confidence) = (sample.eye, sample.diameter_mm, sample.confidence);
        encode_line(&LineSample { sequence, device_us, eye, diameter_mm, confidence }, &mut text);
        if sequence % 97 == 0 && eye == SampleEye::Left {
            text.push_str("# a comment\nrubbish\n");
        }
    }
    text
}

/// Sends `text` through a PTY in pieces that respect no line, some 3 s of samples in a good second.
fn send(tracker: &mut TTYPort, text: &str, handle: &TrackerHandle) {
    let before = handle.control.counters().of(Counter::Bytes);
    for piece in text.as_bytes().chunks(211) {
        tracker.write_all(piece).expect("writes");
        std::thread::sleep(Duration::from_millis(3));
    }
    eventually("all bytes", || handle.control.counters().of(Counter::Bytes) == before + text.len() as u64);
}

fn decisions(handle: &mut TrackerHandle) -> Vec<Decision> {
    std::iter::from_fn(|| handle.decisions.pop()).collect()
}

/// A run with a reconnect, recorded into `folder`; its decisions.
fn recorded_run(folder: &Path) -> Vec<Decision> {
    let text = lines();
    let (first, second) = text.split_at(text.len() / 2 + 7);
    let link = folder.join("port");
    let plug = || {
        let (tracker, port) = TTYPort::pair().expect("a PTY");
        std::os::unix::fs::symlink(port.name().expect("a path"), &link).expect("links");
        (tracker, port)
    };
    let (mut tracker, port) = plug();
    let mut handle = start(&link.display().to_string(), Some(RecordFiles::in_folder(folder)));
    drop(port);
    send(&mut tracker, first, &handle);
    fs::remove_file(&link).expect("unlinks");
    drop(tracker);
    eventually("the loss", || handle.control.counters().of(Counter::Disconnects) == 1);
    let (mut tracker, port) = plug();
    eventually("the return", || handle.control.counters().of(Counter::Connects) == 2);
    drop(port);
    send(&mut tracker, second, &handle);
    handle.control.stop();
    let status = handle.control.recording().expect("it is recorded");
    assert_eq!((status.chunks_lost, status.decisions_lost, status.failure), (0, 0, None));
    decisions(&mut handle)
}

#[test]
fn a_recorded_run_plays_again_bit_for_bit() {
    let folder = TempDir::new().expect("a folder");
    let live = recorded_run(folder.path());
    assert!(live.len() > 1000, "{}", live.len());
    let raw = folder.path().join("tracker.holodraw");
    let samples = fs::read_to_string(folder.path().join("samples.csv")).expect("reads");
    assert_eq!(samples.lines().count(), live.len() + 1);

    let again = folder.path().join("again.csv");
    let files = RecordFiles { raw: None, samples: Some(again.clone()) };
    let mut handle = start(&format!("replay:{},speed=max", raw.display()), Some(files));
    eventually("the end", || handle.control.finished());
    handle.control.stop();
    assert_eq!(handle.control.warnings(), [""; 0]);
    let counters = handle.control.counters();
    assert_eq!((counters.of(Counter::Connects), counters.of(Counter::Disconnects)), (2, 1));
    assert!(counters.faults_in_all() > 0 && counters.of(Counter::Notes) > 0);
    assert_eq!(fs::read_to_string(&again).expect("reads"), samples);
    // What the tap tells is the same but for its times, which are those of the host that plays.
    let played = decisions(&mut handle);
    assert_eq!(played.len(), live.len());
    for (live, played) in live.iter().zip(&played) {
        let (a, b) = (live.sample, played.sample);
        assert_eq!(live.verdict, played.verdict);
        assert_eq!(a.diameter_mm.to_bits(), b.diameter_mm.to_bits());
        assert_eq!((a.t_device, a.eye, a.sequence, a.valid), (b.t_device, b.eye, b.sequence, b.valid));
        assert_eq!(a.t_arrival - a.t_sample, b.t_arrival - b.t_sample);
    }
}

#[test]
fn a_run_whose_tracker_was_silent_at_first_shows_the_same_again() {
    const MM: f32 = 6.0;
    let folder = TempDir::new().expect("a folder");
    let (mut tracker, port) = TTYPort::pair().expect("a PTY");
    let mut handle = start(&port.name().expect("a path"), Some(RecordFiles::in_folder(folder.path())));
    std::thread::sleep(Duration::from_secs(1));
    for sequence in 0..60_u64 {
        let device_us = sequence as i64 * 5000;
        let mut line = String::new();
        let sample = LineSample { sequence, device_us, eye: SampleEye::Both, diameter_mm: MM, confidence: 1.0 };
        encode_line(&sample, &mut line);
        tracker.write_all(line.as_bytes()).expect("writes");
        std::thread::sleep(Duration::from_millis(5));
    }
    eventually("all samples", || handle.control.counters().of(Counter::Samples) == 60);
    // When the newest sample was taken.
    let shown = |handle: &mut TrackerHandle| {
        handle.control.stop();
        let newest = decisions(handle).last().expect("samples came").sample;
        handle.estimate.pupil_at(newest.t_sample)
    };
    let live = shown(&mut handle);
    assert!((live.pupil.mm() - MM).abs() > 0.5, "it came too late to be shown at once: {live:?}");
    let raw = folder.path().join("tracker.holodraw");
    for speed in ["max", "1"] {
        let mut handle = start(&format!("replay:{},speed={speed}", raw.display()), None);
        eventually("the end", || handle.control.finished());
        let again = shown(&mut handle);
        assert_eq!(again.state, live.state, "{speed}");
        assert!((again.pupil.mm() - live.pupil.mm()).abs() < 1e-3, "{speed}: {again:?}, and live {live:?}");
    }
}

#[test]
fn one_wrong_byte_in_a_recording_is_not_played() {
    let folder = TempDir::new().expect("a folder");
    recorded_run(folder.path());
    let raw = folder.path().join("tracker.holodraw");
    let samples = fs::read_to_string(folder.path().join("samples.csv")).expect("reads");
    let mut bytes = fs::read(&raw).expect("reads");
    let at = bytes.len() / 2;
    bytes[at] ^= 1;
    fs::write(&raw, &bytes).expect("writes");

    let again = folder.path().join("again.csv");
    let files = RecordFiles { raw: None, samples: Some(again.clone()) };
    let mut handle = start(&format!("replay:{},speed=max", raw.display()), Some(files));
    eventually("the end", || handle.control.finished());
    handle.control.stop();
    let [warning] = handle.control.warnings() else { panic!("{:?}", handle.control.warnings()) };
    assert!(warning.contains("the recording is damaged at byte"), "{warning}");
    let played = fs::read_to_string(&again).expect("reads");
    assert_ne!(played, samples);
    // The gate decides on a sample by its successors too, so the last rows before the damage may differ.
    let (played, samples): (Vec<_>, Vec<_>) = (played.lines().collect(), samples.lines().collect());
    let same = played.iter().zip(&samples).take_while(|(a, b)| a == b).count();
    assert!(same > 100, "{same} of {}", played.len());
    let lost = samples.len() - played.len();
    assert!((1..samples.len() / 4).contains(&lost), "what lies behind it is played: {lost} of {}", samples.len());
}

#[test]
fn a_run_that_was_killed_keeps_what_had_come() {
    let folder = TempDir::new().expect("a folder");
    let (mut tracker, port) = TTYPort::pair().expect("a PTY");
    let handle = start(&port.name().expect("a path"), Some(RecordFiles::in_folder(folder.path())));
    send(&mut tracker, &lines(), &handle);
    let in_all = handle.control.counters().of(Counter::Samples) as usize;
    // The files as a killed process would leave them: copied while it runs.
    let raw = folder.path().join("tracker.holodraw");
    let copy = folder.path().join("copy.holodraw");
    eventually("the writer", || {
        fs::copy(&raw, &copy).expect("copies");
        Recording::read(&copy).is_ok_and(|log| log.len() == in_all)
    });
    let log = Recording::read(&copy).expect("reads");
    assert_eq!(log.format(), LogFormat::Raw);
    assert!(log.notes().iter().any(|note| note.contains("was cut off")), "{:?}", log.notes());
    assert!(log.faults().total() > 0);

    let bytes = fs::read(&copy).expect("reads");
    fs::write(&copy, &bytes[..bytes.len() - 5]).expect("writes");
    let torn = Recording::read(&copy).expect("reads");
    assert!(torn.notes().iter().any(|note| note.contains("is torn")), "{:?}", torn.notes());
    // The last piece is what one read gave: some lines, or many where the machine is busy.
    assert!(torn.len() < log.len() && torn.len() > log.len() / 2, "{} of {}", torn.len(), log.len());
    drop(handle);
    let whole = Recording::read(&raw).expect("reads");
    assert_eq!(whole.notes().len(), 1, "{:?}", whole.notes());
    assert_eq!(whole.len(), in_all);
}

#[test]
fn a_recording_is_played_with_the_scale_of_its_run() {
    let folder = TempDir::new().expect("a folder");
    let begin = |spec: &str, scale, record| {
        let settings = rig::Tracker { scale, ..rig::Rig::default().tracker };
        let options = TrackerOptions { record: Some(record), ..TrackerOptions::from(host_now()) };
        Tracker::start(&spec.parse().expect("a spec"), &settings, options).expect("starts")
    };
    let (mut tracker, port) = TTYPort::pair().expect("a PTY");
    let port = port.name().expect("a path");
    let mut handle = begin(&port, Some(0.5), RecordFiles::in_folder(folder.path()));
    send(&mut tracker, &lines(), &handle);
    handle.control.stop();
    let samples = fs::read_to_string(folder.path().join("samples.csv")).expect("reads");
    let raw = folder.path().join("tracker.holodraw");
    assert_eq!(Recording::read(&raw).expect("reads").recorded_scale(), Some(0.5));
    for (scale, told) in [(None, "is played with it"), (Some(1.0), "is played with 1")] {
        let again = folder.path().join("again.csv");
        let files = RecordFiles { raw: None, samples: Some(again.clone()) };
        let mut handle = begin(&format!("replay:{},speed=max", raw.display()), scale, files);
        eventually("the end", || handle.control.finished());
        handle.control.stop();
        assert!(handle.control.remarks()[0].contains(told), "{:?}", handle.control.remarks());
        assert_eq!(handle.control.figures().recorded_scale, Some(0.5), "so that a refusal tells the figures that came");
        assert_eq!(fs::read_to_string(&again).expect("reads") == samples, scale.is_none());
        fs::remove_file(again).expect("removes");
    }
    // As a log, which a packed one is.
    let packed = folder.path().join("tracker.holodraw.gz");
    let mut gzip = GzEncoder::new(fs::File::create(&packed).expect("creates"), Compression::fast());
    gzip.write_all(&fs::read(&raw).expect("reads")).expect("packs");
    gzip.finish().expect("packs");
    let files = RecordFiles { raw: None, samples: Some(folder.path().join("packed.csv")) };
    let handle = begin(&format!("replay:{},speed=max", packed.display()), None, files);
    assert_eq!(handle.control.figures().recorded_scale, Some(0.5));
    assert!(handle.control.remarks().iter().any(|remark| remark.contains("is played with it")));
}

#[test]
fn a_replay_that_waits_for_long_says_so() {
    let folder = TempDir::new().expect("a folder");
    let path = folder.path().join("log.csv");
    let rows =
        |from: i64| (0..50).map(move |k| format!("{},left,3.5,1,,1\n", from + k * 10_000_000)).collect::<String>();
    let header = "t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n";
    fs::write(&path, format!("{header}{}{}", rows(0), rows(60_000_000_000))).expect("writes");
    let mut handle = start(&path.display().to_string(), None);
    eventually("the word", || handle.control.trouble().is_some_and(|told| told.contains("59.5 s away")));
    assert_eq!(handle.control.counters().of(Counter::Samples), 50);
    // Longer than any pause of a recording, it is passed over.
    fs::write(&path, format!("{header}{}{}", rows(0), rows(86_400_000_000_000))).expect("writes");
    let mut handle = start(&path.display().to_string(), None);
    eventually("the end", || handle.control.finished());
    assert_eq!((handle.control.counters().of(Counter::Samples), handle.control.trouble()), (100, None));
    assert!(handle.control.warnings()[0].contains("leaps ahead in line 52"), "{:?}", handle.control.warnings());
}

#[test]
fn nothing_is_overwritten_and_what_cannot_be_made_is_told() {
    let folder = TempDir::new().expect("a folder");
    let settings = rig::Rig::default().tracker;
    let refused = |files: RecordFiles| {
        let options = TrackerOptions { record: Some(files), ..TrackerOptions::from(host_now()) };
        Tracker::start(&"mock:steady".parse().expect("a spec"), &settings, options).expect_err("refused").to_string()
    };
    let path = folder.path().join("samples.csv");
    fs::write(&path, "mine").expect("writes");
    let message = refused(RecordFiles { raw: None, samples: Some(path.clone()) });
    assert!(message.contains("nothing is overwritten"), "{message}");
    assert_eq!(fs::read_to_string(&path).expect("reads"), "mine");
    let message = refused(RecordFiles { raw: None, samples: Some(folder.path().join("none/samples.csv")) });
    assert!(message.contains("make the folder first"), "{message}");
}

#[test]
fn the_mock_has_samples_and_no_bytes() {
    let folder = TempDir::new().expect("a folder");
    let mut handle = start("mock:steady", Some(RecordFiles::in_folder(folder.path())));
    assert!(handle.control.warnings()[0].contains("no bytes to record"), "{:?}", handle.control.warnings());
    eventually("samples", || handle.control.counters().of(Counter::Accepted) > 50);
    handle.control.stop();
    let samples = fs::read_to_string(folder.path().join("samples.csv")).expect("reads");
    assert_eq!(samples.lines().count() as u64, 1 + handle.control.counters().of(Counter::Samples));
    assert!(!folder.path().join("tracker.holodraw").exists());
}

#[test]
fn a_full_disk_is_told_and_the_run_goes_on() {
    let files = RecordFiles { raw: None, samples: Some("/dev/full".into()) };
    let options = TrackerOptions { record: Some(files), ..TrackerOptions::from(host_now()) };
    let refused = Tracker::start(&"mock:steady".parse().expect("a spec"), &rig::Rig::default().tracker, options);
    assert!(refused.expect_err("a device is there already").to_string().contains("/dev/full"));
}

#[test]
fn a_recording_without_bytes_says_so() {
    let folder = TempDir::new().expect("a folder");
    let (_tracker, port) = TTYPort::pair().expect("a PTY");
    start(&port.name().expect("a path"), Some(RecordFiles::in_folder(folder.path()))).control.stop();
    let raw = folder.path().join("tracker.holodraw");
    let spec = format!("replay:{}", raw.display()).parse().expect("a spec");
    let error = Tracker::start(&spec, &rig::Rig::default().tracker, TimeNs(0)).expect_err("empty").to_string();
    assert!(error.contains("no bytes came"), "{error}");
}

/// A minute of two eyes at 500 Hz in holod's own CSV: more than any ring holds.
fn long_log(folder: &Path) -> usize {
    let mut text = String::new();
    let count = 60_000;
    for k in 0..count {
        let line = LineSample {
            sequence: k / 2,
            device_us: (k / 2 * 2000) as i64,
            eye: if k % 2 == 0 { SampleEye::Left } else { SampleEye::Right },
            diameter_mm: 4.0,
            confidence: 1.0,
        };
        encode_line(&line, &mut text);
    }
    fs::write(folder.join("long.lines"), text).expect("writes");
    count as usize
}

#[test]
fn a_log_that_is_played_as_fast_as_it_can_be_is_recorded_whole() {
    let folder = TempDir::new().expect("a folder");
    let count = long_log(folder.path());
    let files = RecordFiles { raw: None, samples: Some(folder.path().join("samples.csv")) };
    let spec = format!("replay:{},speed=max", folder.path().join("long.lines").display());
    let mut handle = start(&spec, Some(files));
    let mut taken = 0;
    eventually("the end", || {
        taken += decisions(&mut handle).len();
        handle.control.finished()
    });
    handle.control.stop();
    taken += decisions(&mut handle).len();
    let status = handle.control.recording().expect("records");
    assert_eq!((status.decisions_lost, status.failure), (0, None));
    assert_eq!(fs::read_to_string(folder.path().join("samples.csv")).expect("reads").lines().count(), count + 1);
    assert_eq!(taken, count, "the tap has them all, too");
}

#[test]
fn a_tap_that_nobody_reads_stops_no_log() {
    let folder = TempDir::new().expect("a folder");
    long_log(folder.path());
    let path = folder.path().join("long.lines");
    let text = fs::read_to_string(&path).expect("reads");
    // Twice as long, so that the tap is full before its end.
    let later = |line: &str| line.split(',').nth(2).and_then(|us| us.parse::<i64>().ok()).map(|us| us + 120_000_000);
    let again = text.lines().filter_map(|line| {
        let eye = if line.contains(",L,") { SampleEye::Left } else { SampleEye::Right };
        let mut text = String::new();
        let line = LineSample { sequence: 0, device_us: later(line)?, eye, diameter_mm: 4.0, confidence: 1.0 };
        encode_line(&line, &mut text);
        Some(text)
    });
    let again: String = again.collect();
    fs::write(&path, text.clone() + &again).expect("writes");
    let handle = start(&format!("replay:{},speed=max", path.display()), None);
    eventually("the end", || handle.control.finished());
    assert_eq!(handle.control.counters().of(Counter::Samples), 120_000);
    assert!(handle.control.counters().of(Counter::DecisionsDropped) > 0);
}

#[test]
fn files_that_are_deleted_under_a_recording_are_noticed_while_it_runs() {
    let folder = TempDir::new().expect("a folder");
    let record = folder.path().join("record");
    fs::create_dir(&record).expect("makes");
    let handle = start("mock", Some(RecordFiles::in_folder(&record)));
    eventually("samples", || handle.control.counters().of(Counter::Samples) > 10);
    assert_eq!(handle.control.recording().expect("records").failure, None);
    fs::remove_dir_all(&record).expect("deletes");
    eventually("the failure", || handle.control.recording().expect("records").failure.is_some());
    let failure = handle.control.recording().expect("records").failure.expect("a failure");
    assert!(failure.contains("samples.csv") && failure.contains("deleted"), "{failure}");
}

#[test]
fn a_scale_on_millimetres_is_warned_of() {
    let warnings = |scale: Option<f64>| {
        let settings = rig::Tracker { scale, ..rig::Rig::default().tracker };
        let handle = Tracker::start(&"mock".parse().expect("a spec"), &settings, host_now()).expect("starts");
        handle.control.warnings().join("; ")
    };
    assert!(warnings(Some(0.0125)).contains("millimetres already") && warnings(Some(0.0125)).contains("0.0125"));
    assert_eq!([warnings(None), warnings(Some(1.0))], ["", ""]);
}
