//! Recordings that are written and read again are the same, but for what a format is said to lose.

use std::path::{Path, PathBuf};

use holod_pupil_input::export::{ExportError, write_csv, write_lines};
use holod_pupil_input::{LogFault, LogFormat, PupilSample, Recording, SampleEye, SizeUnit};
use proptest::prelude::*;
use tempfile::TempDir;

const HEADER: &str = "t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n";
const ROWS: &str = "-1500000000,left,3.25,0.9,7.5,1\n1700000000000000001,right,2.7182817,1,,1\n\
                    1700000000005000999,left,0,0.1,0.25,0\n1700000000005000999,both,0.00000011920929,0,,1\n";

fn read(dir: &TempDir, name: &str, content: impl AsRef<[u8]>) -> Recording {
    let path = dir.path().join(name);
    std::fs::write(&path, content).expect("writes");
    Recording::read(&path).expect("reads")
}

fn again(dir: &TempDir, write: impl FnOnce(&Path)) -> (Recording, PathBuf) {
    let path = dir.path().join("again");
    write(&path);
    (Recording::read(&path).expect("reads"), path)
}

/// Bit for bit.
fn bits(sample: &PupilSample) -> (i64, SampleEye, u32, u32, Option<u32>, bool) {
    let PupilSample { t_sample, eye, diameter_mm, confidence, aperture_mm, valid, .. } = *sample;
    (t_sample.0, eye, diameter_mm.to_bits(), confidence.to_bits(), aperture_mm.map(f32::to_bits), valid)
}

fn first_difference(one: &Recording, other: &Recording) -> Option<usize> {
    let (one, other): (Vec<_>, Vec<_>) = (one.samples().collect(), other.samples().collect());
    let differs = |index: &usize| one.get(*index).map(bits) != other.get(*index).map(bits);
    (0..one.len().max(other.len())).find(differs)
}

#[test]
fn csv_reads_as_the_same_samples() {
    let dir = TempDir::new().expect("a folder");
    for unit in ["diameter_mm", "diameter_px", "diameter_arbitrary"] {
        let recording = read(&dir, "log", format!("{HEADER}{ROWS}").replace("diameter_mm", unit));
        assert_eq!((recording.format(), recording.len()), (LogFormat::Csv, 4));
        let (written, path) = again(&dir, |path| write_csv(&recording, path).expect("writes"));
        assert_eq!(written.unit(), recording.unit());
        assert_eq!(first_difference(&recording, &written), None);
        assert_eq!(
            std::fs::read_to_string(path).expect("reads"),
            format!("{HEADER}{ROWS}").replace("diameter_mm", unit)
        );
    }
}

#[test]
fn the_judge_of_sameness_sees_one_wrong_bit() {
    let dir = TempDir::new().expect("a folder");
    let recording = read(&dir, "log", format!("{HEADER}{ROWS}"));
    for (from, to) in [("3.25,", "3.2500002,"), ("001,right", "002,right"), (",7.5,1", ",7.5,0"), ("0.25,0", ",0")] {
        let spoilt = read(&dir, "spoilt", format!("{HEADER}{ROWS}").replacen(from, to, 1));
        assert!(first_difference(&recording, &spoilt).is_some(), "{from}");
    }
    let shorter = read(&dir, "spoilt", format!("{HEADER}{}", &ROWS[..ROWS.len() - 37]));
    assert!(first_difference(&recording, &shorter).is_some());
}

#[test]
fn bad_rows_of_a_csv_are_counted() {
    let dir = TempDir::new().expect("a folder");
    let bad = "x,left,3,1,,1\n1,middle,3,1,,1\n1,left,,1,,1\n1,left,-3,1,,1\n1,left,inf,1,,1\n1,left,3,1.5,,1\n1,left,3,1,,2\n1,left\n2,left,3,1,,1\n1,left,3,1,,1\n";
    let recording = read(&dir, "log", format!("{HEADER}{bad}{ROWS}"));
    let faults = recording.faults();
    assert_eq!(faults.of(LogFault::BadNumber), 2);
    assert_eq!(faults.of(LogFault::Malformed), 3);
    assert_eq!(faults.of(LogFault::Missing), 1);
    assert_eq!(faults.of(LogFault::Negative), 1);
    assert_eq!(faults.of(LogFault::NotFinite), 1);
    // One of the bad ones and the first of the good ones.
    assert_eq!(faults.of(LogFault::Backwards), 2);
    assert_eq!(recording.len(), 4);
}

#[test]
fn lines_read_as_the_same_but_for_what_they_cannot_say() {
    let dir = TempDir::new().expect("a folder");
    let recording = read(&dir, "log", format!("{HEADER}{ROWS}"));
    let (written, _) = again(&dir, |path| write_lines(&recording, None, path).expect("writes"));
    assert_eq!((written.format(), written.len()), (LogFormat::Lines, recording.len()));
    assert_eq!(written.faults().total(), 0);
    for (written, sample) in written.samples().zip(recording.samples()) {
        assert!((written.t_sample - sample.t_sample).0.abs() <= 500, "{written:?}");
        assert_eq!((written.eye, written.diameter_mm), (sample.eye, sample.diameter_mm));
        assert_eq!(written.confidence, if sample.valid { sample.confidence } else { 0.0 });
        // One that is lost without a diameter stays lost.
        assert_eq!((written.valid, written.aperture_mm), (sample.valid, None));
    }
}

#[test]
fn lines_of_another_unit_need_a_scale() {
    let dir = TempDir::new().expect("a folder");
    let recording = read(&dir, "log", format!("{HEADER}{ROWS}").replace("diameter_mm", "diameter_px"));
    let path = dir.path().join("lines");
    let error = write_lines(&recording, None, &path).expect_err("refused");
    assert!(matches!(error, ExportError::NoScale { .. }));
    for told in ["camera pixels", "scale", "CSV"] {
        assert!(error.to_string().contains(told), "{error}");
    }
    for scale in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(write_lines(&recording, Some(scale), &path), Err(ExportError::BadScale { .. })), "{scale}");
    }
    assert!(!path.exists());
    write_lines(&recording, Some(0.5), &path).expect("writes");
    let written = Recording::read(&path).expect("reads");
    assert_eq!(written.unit(), SizeUnit::Millimetres);
    assert_eq!(written.samples().next().map(|sample| sample.diameter_mm), Some(1.625));
}

#[test]
fn what_cannot_be_written_is_an_error_that_names_it() {
    let dir = TempDir::new().expect("a folder");
    let recording = read(&dir, "log", format!("{HEADER}{ROWS}"));
    let nowhere = dir.path().join("no/such/folder/out.csv");
    let error = write_csv(&recording, &nowhere).expect_err("refused").to_string();
    assert!(error.contains("no/such/folder/out.csv"), "{error}");
    assert!(write_csv(&recording, dir.path()).expect_err("refused").to_string().contains("a directory"));
    assert_eq!(std::fs::read_dir(dir.path()).expect("reads").count(), 1, "nothing is left lying about");
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, cases: 100, ..ProptestConfig::default() })]

    #[test]
    fn any_samples_survive_csv(
        rows in proptest::collection::vec(
            (0..1_000_000_000_i64, 0..3_usize, 0.0..20_000.0_f32, 0.0..=1.0_f32, proptest::option::of(-1.0..20.0_f32), any::<bool>()),
            1..60,
        ),
    ) {
        let mut text = String::from(HEADER);
        let mut t_ns = -5_000_000_000_i64;
        for (step_ns, eye, diameter, confidence, aperture, valid) in rows {
            t_ns += step_ns;
            let aperture = aperture.map_or(String::new(), |mm| mm.to_string());
            text += &format!("{t_ns},{},{diameter},{confidence},{aperture},{}\n", SampleEye::ALL[eye], u8::from(valid));
        }
        let dir = TempDir::new().expect("a folder");
        let recording = read(&dir, "log", &text);
        let (written, path) = again(&dir, |path| write_csv(&recording, path).expect("writes"));
        prop_assert_eq!(first_difference(&recording, &written), None);
        prop_assert_eq!(std::fs::read_to_string(path).expect("reads"), text);
    }
}
