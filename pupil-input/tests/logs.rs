//! Logs: recognised by content, read whole or refused with a reason, and held through blinks.

mod support;

use std::fmt::Write;
use std::path::{Path, PathBuf};

use holod_calibration::{TimeNs, rig};
use holod_pupil_input::wire::WireFault;
use holod_pupil_input::wire::line::{LineSample, crc8, encode_line};
use holod_pupil_input::{Blink, LogFault, LogFormat, PupilSample, PupilState, Recording, ReplayError, SampleEye};
use support::{estimates, first_below, least_raw, neon_like_csv, settings};
use tempfile::TempDir;

fn written(dir: &TempDir, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
    let path = dir.path().join(name);
    std::fs::write(&path, content).expect("writes");
    path
}

fn neon_like() -> Vec<PupilSample> {
    let dir = TempDir::new().expect("a folder");
    let recording = Recording::read(&written(&dir, "anything.txt", neon_like_csv(11))).expect("reads");
    assert_eq!(recording.format(), LogFormat::NeonEyeStates);
    assert_eq!(recording.faults().total(), 0);
    assert_eq!(recording.len(), 2000);
    recording.samples().collect()
}

fn without_apertures(samples: &[PupilSample]) -> Vec<PupilSample> {
    samples.iter().map(|sample| PupilSample { aperture_mm: None, ..*sample }).collect()
}

/// The log as holod would record it: confidence 1 and no aperture.
fn as_lines(samples: &[PupilSample]) -> String {
    let mut text = String::from("# converted\n");
    for (sequence, sample) in samples.iter().enumerate() {
        let device_us = sample.t_device.0 / 1000;
        let line = LineSample {
            sequence: sequence as u64,
            device_us,
            eye: sample.eye,
            diameter_mm: sample.diameter_mm,
            confidence: 1.0,
        };
        encode_line(&line, &mut text);
    }
    text
}

fn held(samples: &[PupilSample], eye: rig::Eye, least_mm: f32) {
    let trace = estimates(samples.iter().copied(), settings(eye));
    assert_eq!(first_below(&trace, least_mm), None, "{eye:?}");
    for (_, estimate) in &trace {
        assert!(estimate.pupil.mm() < 4.3, "{estimate:?}");
    }
    assert!(trace.iter().any(|(_, estimate)| estimate.state == PupilState::Holding));
    let tracking = trace.iter().filter(|(_, estimate)| estimate.state == PupilState::Tracking).count();
    assert!(tracking * 10 > trace.len() * 7, "tracking {tracking} of {}", trace.len());
}

#[test]
fn blinks_are_held_with_and_without_apertures() {
    let samples = neon_like();
    assert!(least_raw(&samples, SampleEye::Left) < 1.4);
    assert!(least_raw(&samples, SampleEye::Right) < 1.8);
    for samples in [samples.clone(), without_apertures(&samples)] {
        held(&samples, rig::Eye::Left, 3.3);
        held(&samples, rig::Eye::Both, 3.0);
        held(&samples, rig::Eye::Right, 3.0);
    }
}

#[test]
fn the_judge_of_held_blinks_sees_one_low_estimate() {
    let mut trace = estimates(neon_like(), settings(rig::Eye::Left));
    let spoilt = trace.len() / 2;
    trace[spoilt].1.pupil = holod_calibration::PupilDiameter::from_mm(2.99);
    assert_eq!(first_below(&trace, 3.0), Some((trace[spoilt].0, 2.99)));
}

#[test]
fn a_recording_in_protocol_lines_plays_as_the_same() {
    let samples = neon_like();
    let dir = TempDir::new().expect("a folder");
    let recording = Recording::read(&written(&dir, "x.csv", as_lines(&samples))).expect("reads");
    assert_eq!(recording.format(), LogFormat::Lines);
    let played: Vec<_> = recording.samples().map(|s| (s.eye, s.diameter_mm, s.t_sample.0 / 1000)).collect();
    let recorded: Vec<_> = samples.iter().map(|s| (s.eye, s.diameter_mm, s.t_sample.0 / 1000)).collect();
    assert_eq!(played, recorded);
    held(&recording.samples().collect::<Vec<_>>(), rig::Eye::Left, 3.3);
}

#[test]
fn each_bad_cell_is_counted_by_its_reason() {
    let header = "timestamp [ns],pupil diameter right [mm],pupil diameter left [mm]\r\n";
    let rows = "10,3.5,3.6\r\n15,NaN,3.6\r\n20,-1,inf\r\n12,3.5,3.6\r\n25,,x\r\n30\r\nsoon,3,3\r\n35,3.4,3.5\r\n";
    let dir = TempDir::new().expect("a folder");
    let recording = Recording::read(&written(&dir, "log.csv", format!("\u{feff}{header}{rows}"))).expect("reads");
    let faults = recording.faults();
    assert_eq!(faults.of(LogFault::NotFinite), 2);
    assert_eq!(faults.of(LogFault::Negative), 1);
    assert_eq!(faults.of(LogFault::Backwards), 1);
    assert_eq!(faults.of(LogFault::Missing), 1);
    assert_eq!(faults.of(LogFault::BadNumber), 2);
    assert_eq!(faults.of(LogFault::Malformed), 2);
    assert_eq!(faults.total(), 9);
    let left: Vec<_> = recording.samples().filter(|s| s.eye == SampleEye::Left).map(|s| s.diameter_mm).collect();
    assert_eq!(left, [3.6, 3.6, 3.5]);
}

#[test]
fn bad_lines_of_a_recording_are_counted_and_skipped() {
    let mut text = as_lines(&neon_like()[..50]);
    let nan = "P1,99,1,L,NaN,1";
    writeln!(text, "{nan}*{:02X}\nP1,5,5,L,3.0,1*00", crc8(nan.as_bytes())).expect("a String takes all");
    // The last line has no ending.
    text.push_str("P1,6");
    let dir = TempDir::new().expect("a folder");
    let recording = Recording::read(&written(&dir, "log", text)).expect("reads");
    assert_eq!(recording.len(), 50);
    assert_eq!(recording.faults().of(LogFault::Wire(WireFault::NotFinite)), 1);
    assert_eq!(recording.faults().of(LogFault::Wire(WireFault::BadChecksum)), 2);
}

#[test]
fn a_log_as_a_whole_is_refused_with_its_reason() {
    let dir = TempDir::new().expect("a folder");
    let refused = |path: &Path| Recording::read(path).expect_err("refused");

    let error = refused(&written(&dir, "3d_eye_states.csv", "time;pupil\u{7}\n1;2\n"));
    assert!(matches!(error, ReplayError::UnknownFormat { .. }));
    let message = error.to_string();
    for told in ["3d_eye_states.csv", "time;pupil\\u{7}", "holod line protocol", "Neon"] {
        assert!(message.contains(told), "{message}");
    }

    assert!(refused(&written(&dir, "empty", "")).to_string().contains("an empty file"));
    assert!(refused(dir.path()).to_string().contains("is a directory"));
    assert!(refused(Path::new("/dev/null")).to_string().contains("device"));
    assert!(refused(&dir.path().join("absent")).to_string().contains("absent"));

    let error = refused(&written(&dir, "lines", "P1,1,2,L,3,1*00\n"));
    assert!(error.to_string().contains("wire_bad_checksum 1"), "{error}");
    let error = refused(&written(&dir, "future", "P2,1,2,L,3,1*00\n"));
    assert!(error.to_string().contains("wire_unknown_version 1"), "{error}");

    let mut unsorted = String::from("timestamp [ns],pupil diameter left [mm]\n");
    (0..100).rev().for_each(|k| writeln!(unsorted, "{k},3.5").expect("a String takes all"));
    let error = refused(&written(&dir, "unsorted", unsorted));
    assert!(matches!(error, ReplayError::Unsorted { backwards: 99, rows: 100, line: 3, .. }), "{error}");
}

#[test]
fn blinks_of_the_companion_are_known_and_do_not_reach_the_samples() {
    let dir = TempDir::new().expect("a folder");
    let blinks = "section id,recording id,blink id,start timestamp [ns],end timestamp [ns],duration [ms]\n\
                  0,x,1,100,200,0\n0,x,2,soon,400,0\n0,x,3,500,600,0\n";
    written(&dir, "blinks.csv", blinks);
    let recording = Recording::read(&written(&dir, "3d_eye_states.csv", neon_like_csv(11))).expect("reads");
    let blink = |begins, ends| Blink { eye: SampleEye::Both, begins: TimeNs(begins), ends: TimeNs(ends) };
    assert_eq!(recording.blinks(), [blink(100, 200), blink(500, 600)]);
    assert!(recording.samples().all(|sample| sample.confidence == 1.0));
}

fn shared_data() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    std::env::var_os("HOLOD_SHARED_DATA").map_or_else(default, PathBuf::from)
}

#[test]
#[ignore = "needs shared data"]
fn shared_data_neon_blinks_are_held() {
    let recording = Recording::read(&shared_data().join("pupil/neon_demo/3d_eye_states.csv")).expect("reads");
    assert_eq!(recording.blinks().len(), 2);
    assert_eq!(recording.faults().total(), 0);
    let samples: Vec<_> = recording.samples().collect();
    assert!(least_raw(&samples, SampleEye::Left) < 1.07);
    let lines = TempDir::new().expect("a folder");
    let lines = Recording::read(&written(&lines, "lines", as_lines(&samples))).expect("reads");
    for samples in [samples.clone(), without_apertures(&samples), lines.samples().collect()] {
        for (eye, least_mm) in [(rig::Eye::Left, 3.0), (rig::Eye::Both, 2.5), (rig::Eye::Right, 2.1)] {
            let trace = estimates(samples.iter().copied(), settings(eye));
            assert_eq!(first_below(&trace, least_mm), None, "{eye:?}");
            for blink in recording.blinks() {
                // The dip of a blink lasts from 40 ms after its begin to about 60 ms before its end.
                let (from, to) = (blink.begins + TimeNs(60_000_000), blink.ends - TimeNs(80_000_000));
                let within = trace.iter().filter(|(t, _)| (from..to).contains(t));
                assert!(within.clone().count() > 50);
                assert!(within.clone().all(|(_, estimate)| estimate.state == PupilState::Holding), "{eye:?}");
            }
        }
    }
}
