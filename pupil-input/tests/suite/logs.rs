//! Logs: recognised by content, read whole or refused with a reason, and held through blinks.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use crate::made_up_logs;
use crate::support::{estimates, first_below, least_raw, neon_like_csv, settings};
use holod_calibration::{TimeNs, rig};
use holod_pupil_input::wire::WireFault;
use holod_pupil_input::wire::line::{LineSample, crc8, encode_line};
use holod_pupil_input::{
    Blink, Estimator, LogFault, LogFormat, LogInfo, PupilSample, PupilState, Recording, ReplayError, SampleEye,
    SizeUnit, Verdict,
};
use holod_tests::shared_data;
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
    assert_eq!(faults.of(LogFault::NotFinite), 1);
    assert_eq!(faults.of(LogFault::Negative), 1);
    // Of both eyes, of which one was lost last.
    assert_eq!(faults.of(LogFault::Backwards), 2);
    assert_eq!(faults.of(LogFault::BadNumber), 2);
    assert_eq!(faults.of(LogFault::Malformed), 2);
    assert_eq!(faults.total(), 8);
    // An empty cell, NaN or no figure with a time is an eye that is lost.
    let (left, right) = (SampleEye::Left, SampleEye::Right);
    let lost = recording.samples().filter(|sample| !sample.valid).map(|sample| (sample.t_sample.0, sample.eye));
    assert_eq!(lost.collect::<Vec<_>>(), [(15, right), (20, left), (20, right), (25, left), (25, right)]);
    let left: Vec<_> = recording.samples().filter(|s| s.valid && s.eye == left).map(|s| s.diameter_mm).collect();
    assert_eq!(left, [3.6, 3.6, 3.5]);
}

/// Logs of 200 Hz with `lost` in the place of a diameter for 0.1 s, one of each format that has cells for it.
fn logs_with(lost: &str) -> [(LogFormat, String); 5] {
    type Row = fn(i64, &str) -> String;
    let (header, row): ([_; 5], [Row; 5]) = (
        [
            "timestamp [ns],pupil diameter left [mm]\n",
            "** TYPE: EDF_FILE\nSTART\t1 \tLEFT\tSAMPLES\nPUPIL\tDIAMETER\n",
            "Time\tType\tTrial\tL Pupil Diameter [mm]\n",
            "pupil_timestamp,world_index,eye_id,confidence,norm_pos_x,norm_pos_y,diameter,method,diameter_3d\n",
            "filename,timestamp_ms,algorithm,diameter_px,undistortedDiameter_px,physicalDiameter_mm\n",
        ],
        [
            |t_ms, mm| format!("{}000000,{mm}\n", t_ms),
            |t_ms, mm| format!("{t_ms}\t  1.0\t  1.0\t {mm}\t...\n"),
            |t_ms, mm| format!("{t_ms}000\tSMP\t1\t{mm}\n"),
            |t_ms, mm| format!("{}.{:03},0,1,0.9,0,0,41,pye3d,{mm}\n", t_ms / 1000, t_ms % 1000),
            |t_ms, mm| format!("x,{t_ms},PuRe,40,41,{mm}\n"),
        ],
    );
    let formats = [LogFormat::NeonEyeStates, LogFormat::EyeLink, LogFormat::Smi, LogFormat::Core, LogFormat::PupilExt];
    std::array::from_fn(|log| {
        let cell = |k: i64| if (100..120).contains(&k) { lost } else { "4.0" };
        let rows: String = (0..300).map(|k| row[log](1000 + 5 * k, cell(k))).collect();
        (formats[log], format!("{}{rows}", header[log]))
    })
}

#[test]
fn what_a_log_says_of_a_lost_eye_is_a_lost_sample_and_guards_its_neighbours() {
    let dir = TempDir::new().expect("a folder");
    let read = |(format, text): (LogFormat, String)| {
        let recording = Recording::read(&written(&dir, "log", text)).expect("reads");
        assert_eq!(recording.format(), format);
        recording
    };
    // What no log says of a lost eye is a fault besides.
    let faults = [("inf", LogFault::NotFinite), ("4.0.1", LogFault::BadNumber), ("#N/A", LogFault::BadNumber)];
    let words = ["nan", "NaN", "-nan", "n/a", "null", "0"];
    for (lost, fault) in
        words.map(|word| (word, None)).into_iter().chain(faults.map(|(cell, fault)| (cell, Some(fault))))
    {
        for log in logs_with(lost) {
            let format = log.0;
            let recording = read(log);
            let faults = recording.faults();
            let expected = if fault.is_some() { 20 } else { 0 };
            assert_eq!((recording.len(), faults.total()), (300, expected), "{format}, {lost}");
            assert_eq!(fault.map_or(0, |fault| faults.of(fault)), expected, "{format}, {lost}");
            let valid: Vec<_> = recording.samples().map(|sample| sample.valid).collect();
            assert!(valid.iter().enumerate().all(|(k, valid)| *valid != (100..120).contains(&k)), "{format}, {lost}");
            let mut rejected = Vec::new();
            let mut estimator = Estimator::new(settings(rig::Eye::Left));
            for sample in recording.samples() {
                estimator.push(PupilSample { diameter_mm: 4.0, eye: SampleEye::Left, ..sample }, |decision| {
                    if decision.verdict != Verdict::Accepted {
                        rejected.push((decision.sample.t_sample - recording.begins()).0 / 5_000_000);
                    }
                });
            }
            rejected.sort_unstable();
            // 20 lost ones, with 30 ms before and 50 ms behind them.
            assert_eq!(rejected, (95..130).collect::<Vec<_>>(), "{format}, {lost}");
        }
    }
}

#[test]
fn a_log_of_nothing_but_faults_holds_no_sample() {
    let dir = TempDir::new().expect("a folder");
    // PupilEXT's has pixels besides.
    for (_, log) in logs_with("4.0").into_iter().filter(|log| log.0 != LogFormat::PupilExt) {
        let log = log.replace("4.0", "#N/A");
        let error = Recording::read(&written(&dir, "log", log)).expect_err("no sample").to_string();
        assert!(error.contains("holds no sample") && error.contains("log_bad_number 300"), "{error}");
    }
}

#[test]
fn a_row_of_more_cells_than_names_is_not_read() {
    let dir = TempDir::new().expect("a folder");
    for (format, text) in logs_with("3,7") {
        if format == LogFormat::EyeLink {
            continue;
        }
        // Of SMI, whose cells are set apart by tabs, a cell more.
        let text = if format == LogFormat::Smi { text.replace("3,7", "3.7\t3.5") } else { text };
        let (recording, info) = info(&written(&dir, "log", text));
        assert_eq!((recording.len(), recording.faults().of(LogFault::Malformed)), (280, 20), "{format}");
        assert!(recording.samples().all(|sample| sample.diameter_mm == 4.0), "{format}");
        let told = "20 rows hold more cells than there are names of columns, the first in line 1";
        assert!(info.notes[0].contains(told) && info.notes[0].contains("decimal commas"), "{:?}", info.notes);
    }
    // What is empty tells nothing, and a text of PupilEXT's user may hold commas.
    let (_, neon) = logs_with("4.0,,\"\"").into_iter().next().expect("logs");
    let row = |k: i64| format!("x,{},PuRe,40,41,3.5,go, now\n", 1000 + 5 * k);
    let header = "filename,timestamp_ms,algorithm,diameter_px,undistortedDiameter_px,physicalDiameter_mm,message\n";
    let pupilext = header.to_owned() + &(0..300).map(row).collect::<String>();
    // So may one of Gazepoint's behind all figures, and a message of Tobii's, which is no row of the eyes.
    let row = |k: i64| format!("1.{:03},4.0,1,go, now\n", 2 * k);
    let gazepoint = "TIME,LPMM,LPMMV,USER\n".to_owned() + &(0..300).map(row).collect::<String>();
    let row = |k: i64| {
        let message = if k % 100 == 0 { format!("{}\tMessage\t\ta\ttab\n", 1000 + 5 * k) } else { String::new() };
        format!("{}\tEye Tracker\t4.0\n{message}", 1000 + 5 * k)
    };
    let tobii = "Recording timestamp [ms]\tSensor\tPupil diameter left [mm]\n".to_owned()
        + &(0..300).map(row).collect::<String>();
    for text in [neon, pupilext, gazepoint, tobii] {
        let (recording, info) = info(&written(&dir, "log", text));
        assert_eq!((recording.len(), recording.faults().total()), (300, 0), "{:?}", info.notes);
    }
    // Nothing else is in it.
    let all = "timestamp [ns],pupil diameter left [mm]\n1000000,3,7\n6000000,3,7\n";
    let error = Recording::read(&written(&dir, "log", all)).expect_err("no sample").to_string();
    assert!(error.contains("log_malformed 2") && error.contains("more cells than there are names"), "{error}");
}

#[test]
fn a_header_that_comes_again_is_none_but_of_other_columns_ends_the_log() {
    type Row = fn(i64) -> String;
    let logs: [(LogFormat, &str, &str, Row); 6] = [
        (
            LogFormat::NeonEyeStates,
            "timestamp [ns],pupil diameter left [mm],pupil diameter right [mm]",
            "timestamp [ns],worn,pupil diameter left [mm],pupil diameter right [mm]",
            |t_ms| format!("{t_ms}000000,3.5,3.6"),
        ),
        (
            LogFormat::Core,
            "pupil_timestamp,eye_id,confidence,norm_pos_x,diameter,method,diameter_3d",
            "eye_id,pupil_timestamp,confidence,norm_pos_x,diameter,method,diameter_3d",
            |t_ms| format!("{}.{:03},1,1,0,40,pye3d,3.5", t_ms / 1000, t_ms % 1000),
        ),
        (
            LogFormat::Smi,
            "Time\tType\tTrial\tL Pupil Diameter [mm]\tR Pupil Diameter [mm]",
            "Time\tType\tTrial\tR Pupil Diameter [mm]\tL Pupil Diameter [mm]",
            |t_ms| format!("{t_ms}000\tSMP\t1\t3.5\t3.6"),
        ),
        (
            LogFormat::Tobii,
            "Recording timestamp [ms]\tSensor\tPupil diameter left [mm]",
            "Recording timestamp [ms]\tSensor\tGaze point X\tPupil diameter left [mm]",
            |t_ms| format!("{t_ms}\tEye Tracker\t3.5"),
        ),
        (
            LogFormat::Gazepoint,
            "TIME(2020/11/03 12:00:00.000),LPMM,LPMMV",
            "TIME(2020/11/03 12:00:00.000),LPMMV,LPMM",
            |t_ms| format!("{}.{:03},3.5,1", t_ms / 1000, t_ms % 1000),
        ),
        (
            LogFormat::PupilExt,
            "filename,timestamp_ms,algorithm,diameter_px,physicalDiameter_mm",
            "filename,timestamp_ms,algorithm,physicalDiameter_mm,diameter_px",
            |t_ms| format!("x,{t_ms},PuRe,40,3.5"),
        ),
    ];
    let dir = TempDir::new().expect("a folder");
    for (format, header, other, row) in logs {
        let part = |from: i64| (from..from + 100).map(|k| row(1000 + 5 * k) + "\n").collect::<String>();
        let joined = |header_again: &str| format!("{header}\n{}{header_again}\n{}", part(0), part(100));
        let alone = Recording::read(&written(&dir, "log", joined("").replace("\n\n", "\n"))).expect("reads");
        assert_eq!(alone.format(), format);
        // Of another recording.
        let again = header.replace("12:00:00", "13:00:00");
        let (recording, info) = info(&written(&dir, "log", joined(&again)));
        assert_eq!((recording.len(), recording.faults().total()), (alone.len(), 0), "{format}");
        assert!(info.notes.iter().any(|note| note.contains("its header comes again in line 102")), "{:?}", info.notes);
        // With marks of byte order, and filled up by a spreadsheet.
        let separator = if header.contains('\t') { '\t' } else { ',' };
        let marked = format!("\u{feff}{}", joined(&format!("\u{feff}{header}{separator}{separator}")));
        let (recording, told) = self::info(&written(&dir, "log", marked));
        assert_eq!((recording.len(), recording.faults().total()), (alone.len(), 0), "{format}: {:?}", told.notes);
        let error = Recording::read(&written(&dir, "log", joined(other))).expect_err("two tables").to_string();
        assert!(error.contains(", line 102: found another header, of other columns"), "{format}: {error}");
    }
}

/// Eye and method of rows of Core's, and at which of its times there is one.
type CoreRows = (&'static str, &'static str, fn(i64) -> bool);

/// Ten seconds of Core's at 200 Hz.
fn core_rows(rows: &[CoreRows]) -> String {
    let mut text = String::from("pupil_timestamp,eye_id,confidence,norm_pos_x,diameter,method,diameter_3d\n");
    for k in 0..2000_i64 {
        for (eye, method, there) in rows {
            if there(k) {
                let mm = if method.contains("3d") { "3.5" } else { "" };
                writeln!(text, "{}.{:03},{eye},0.9,0,40,{method},{mm}", k / 200, k % 200 * 5)
                    .expect("a String takes all");
            }
        }
    }
    text
}

#[test]
fn core_keeps_the_best_rows_of_each_eye_and_tells_what_is_lost_by_that() {
    let dir = TempDir::new().expect("a folder");
    let (live, post_hoc) = ("pye3d 0.3.0 real-time", "pye3d 0.3.0 post-hoc");
    let [left, right] = ["1", "0"];
    let read = |rows: &[CoreRows]| {
        let (recording, info) = info(&written(&dir, "log", core_rows(rows)));
        let of = |eye| recording.samples().filter(|sample| sample.eye == eye).count();
        (recording.unit(), [SampleEye::Left, SampleEye::Right].map(of), recording.warnings().join("\n"), info.notes)
    };
    // A model that was fitted afterwards to the right eye alone.
    let (unit, counts, warnings, notes) =
        read(&[(left, live, |_| true), (right, live, |_| true), (right, post_hoc, |_| true)]);
    assert_eq!((unit, counts, warnings.as_str()), (SizeUnit::Millimetres, [2000; 2], ""));
    assert!(notes[0].contains("of the other eye, which has no such rows, of the live model"), "{notes:?}");
    // The left one has no millimetres.
    let (unit, counts, warnings, _) =
        read(&[(left, "2d c++", |_| true), (right, live, |_| true), (right, "2d c++", |_| true)]);
    assert_eq!((unit, counts), (SizeUnit::Millimetres, [0, 2000]));
    assert!(warnings.contains("the left eye is left out: its 2000 rows are of 2-D detection"), "{warnings}");
    // Millimetres come late.
    let (unit, counts, warnings, _) = read(&[(left, "2d c++", |_| true), (left, live, |k| k >= 1800)]);
    assert_eq!((unit, counts), (SizeUnit::Millimetres, [200, 0]));
    assert!(warnings.contains("of the left eye's 10.0 s only 1.0 s were read"), "{warnings}");
    let (_, counts, warnings, _) = read(&[(left, "2d c++", |_| true), (left, live, |k| k >= 20)]);
    assert_eq!((counts, warnings.as_str()), ([1980, 0], ""));
}

#[test]
fn an_eye_that_was_not_found_is_lost_however_its_confidence_is_written() {
    let dir = TempDir::new().expect("a folder");
    let read = |confidence: &str| {
        let header = "pupil_timestamp,eye_id,confidence,norm_pos_x,diameter,method,diameter_3d\n";
        let row = |k: u64| {
            let (confidence, diameter) = if (90..100).contains(&k) { (confidence, "0") } else { ("0.99", "3.5") };
            format!("1.{:03},1,{confidence},0,40,pye3d,{diameter}\n", 5 * k)
        };
        let rows: String = (0..200).map(row).collect();
        let (recording, info) = info(&written(&dir, "log", format!("{header}{rows}")));
        let valid: Vec<_> = recording.samples().map(|sample| (sample.t_sample, sample.valid)).collect();
        (valid, recording.faults().total(), info.eyes[0].lost)
    };
    let lost = read("0");
    assert_eq!(read("-1"), lost);
    assert_eq!((lost.0.len(), lost.1, lost.2), (200, 0, 10));
}

#[test]
fn core_eyes_are_read_as_pandas_writes_them_and_others_are_quoted() {
    let dir = TempDir::new().expect("a folder");
    let log = |rows: [&str; 4]| {
        let header = "pupil_timestamp,eye_id,confidence,norm_pos_x,diameter,method,diameter_3d\n";
        let rows: String = (1..).zip(rows).map(|(k, eye)| format!("1.{k},{eye},0.9,0,40,pye3d,3.5\n")).collect();
        written(&dir, "log", format!("{header}{rows}"))
    };
    let (recording, info) = info(&log(["0.0", "1.0", "0", "1"]));
    let (left, right) = (SampleEye::Left, SampleEye::Right);
    assert_eq!(recording.samples().map(|sample| sample.eye).collect::<Vec<_>>(), [right, left, right, left]);
    assert_eq!((recording.faults().total(), info.notes.len()), (0, 0), "{:?}", info.notes);
    let recording = Recording::read(&log(["1", "left", "0.5", "0"])).expect("reads");
    assert_eq!((recording.len(), recording.faults().of(LogFault::BadEye)), (2, 2));
    let told =
        "2 rows are of neither eye: `eye_id` is `left` in line 3, the first of them; expected 0 for the right eye";
    assert!(recording.warnings()[0].contains(told), "{:?}", recording.notes());
    let error = Recording::read(&log(["x\u{7}"; 4])).expect_err("no sample").to_string();
    assert!(error.contains("log_bad_eye 4") && error.contains("`eye_id` is `x\\u{7}` in line 2"), "{error}");
}

#[test]
fn confidence_in_per_cent_is_not_taken_for_certainty() {
    let header = "pupil_timestamp,eye_id,confidence,norm_pos_x,diameter,method,diameter_3d\n";
    let rows: String =
        (0..100).map(|k| format!("1.{:03},1,{},0,40,pye3d,3.5\n", 5 * k, ["20", "0.9", "1.0000001"][k % 3])).collect();
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", format!("{header}{rows}")));
    assert_eq!((recording.len(), recording.faults().of(LogFault::BadConfidence)), (100, 34));
    let believed: Vec<_> = recording.samples().filter(|sample| sample.valid).map(|sample| sample.confidence).collect();
    assert!(believed.len() == 66 && believed.iter().all(|share| [0.9, 1.0].contains(share)), "{believed:?}");
    assert!(
        info.notes[0].contains("34 samples are taken for lost") && info.notes[0].contains("per cent"),
        "{:?}",
        info.notes
    );
}

#[test]
fn lost_pupils_of_a_recording_in_lines_are_lost() {
    let mut text = String::new();
    for sequence in 0..300 {
        // Lost; a diameter without confidence is unsure, and so is none with some.
        let (diameter_mm, confidence) = match sequence {
            100..120 => (0.0, 0.0),
            200..205 => (3.0, 0.0),
            205..210 => (0.0, 0.1),
            _ => (4.0, 1.0),
        };
        let (device_us, eye) = (5_000 * sequence as i64, SampleEye::Left);
        encode_line(&LineSample { sequence, device_us, eye, diameter_mm, confidence }, &mut text);
    }
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", text));
    let eye = &info.eyes[0];
    assert_eq!((eye.valid, eye.lost, eye.lost_runs, eye.unsure), (280, 20, 1, 10));
    assert_eq!((eye.blinks_found, eye.diameter.map(|range| range.least)), (Some(2), Some(4.0)));
    assert!(recording.samples().all(|sample| sample.valid == (sample.diameter_mm > 0.0 || sample.confidence > 0.0)));
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

    // What is no log itself, with what makes one of it.
    for (content, found, advice) in [
        (&b"SR_RESEARCH_COMBINED_FILE_FORMAT\0\0\x01"[..], "an EyeLink EDF file", "with SR Research's `edf2asc`"),
        (
            // Not packed, so that its log shows.
            b"PK\x03\x04\x14\0\0\0a.csv,timestamp [ns],pupil diameter left [mm]\n0,1000000,3.5\n0,2000000,3.5\n",
            "a zip archive or a workbook",
            "unpack it, or export the sheet as CSV or TSV",
        ),
        (b"time;pupil\n1;2\n", "`time;pupil`", "convert the log to one of these"),
    ] {
        let message = refused(&written(&dir, "log", content)).to_string();
        assert!(message.contains(&format!("found {found};")) && message.ends_with(advice), "{message}");
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
    // Shuffled over 100 s, so that most times fall far.
    let mut shuffled = String::from("timestamp [ns],pupil diameter left [mm]\n");
    for k in 0..10_000_i64 {
        writeln!(shuffled, "{},3.5", k * 7919 % 10_000 * 10_000_000).expect("a String takes all");
    }
    let error = refused(&written(&dir, "shuffled", shuffled));
    assert!(matches!(error, ReplayError::Unsorted { line: 4, .. }), "{error}");
    assert!(error.to_string().contains("each recording into a file of its own"), "{error}");
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

fn info(path: &Path) -> (Recording, LogInfo) {
    let recording = Recording::read(path).expect("reads");
    let info = LogInfo::of(&recording, None);
    (recording, info)
}

/// What a log of [`made_up_logs::diameter_mm`] must be found to hold.
fn assert_truth(info: &LogInfo, eyes: &[&str], rate_hz: f64, unit_mm: f32) {
    assert_eq!(info.eyes.iter().map(|eye| eye.eye).collect::<Vec<_>>(), eyes);
    assert_eq!(info.blinks.found, made_up_logs::BLINKS_S.len() as u64, "{info:?}");
    assert!((info.duration_s - made_up_logs::LENGTH_S).abs() < 0.1, "{info:?}");
    for eye in &info.eyes {
        let found = eye.rate_hz.expect("a rate");
        assert!((found / rate_hz - 1.0).abs() < 0.01, "{found} for {rate_hz}: {eye:?}");
        assert_eq!((eye.gaps, eye.blinks_found), (0, Some(info.blinks.found)), "{eye:?}");
        let range = eye.diameter.expect("a range");
        for (read, expected) in [(range.p1, 3.7), (range.median, 4.0), (range.p99, 4.3)] {
            assert!((read / unit_mm - expected).abs() < 0.05, "{range:?}");
        }
    }
}

#[test]
#[should_panic(expected = "for 123")]
fn the_judge_of_what_a_log_holds_sees_a_wrong_rate() {
    let dir = TempDir::new().expect("a folder");
    let (_, info) = info(&written(&dir, "log", made_up_logs::core(130.0, true)));
    assert_truth(&info, &["left", "right"], 123.0, 1.0);
}

#[test]
fn core_takes_the_3d_rows_of_both_eyes() {
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", made_up_logs::core(123.0, true)));
    assert_eq!((recording.format(), recording.unit()), (LogFormat::Core, SizeUnit::Millimetres));
    assert_truth(&info, &["left", "right"], 123.0, 1.0);
    assert!(recording.begins().0 < 0);
    assert_eq!(recording.faults().total(), 0);
    assert_eq!(info.notes.len(), 1);
    assert!(info.notes[0].contains("2460 rows of 2-D detection are left out"), "{:?}", info.notes);
    // In a blink the model says -0.1 mm, which is lost, and 16 mm with little confidence, which is handed on.
    assert!(info.eyes[0].lost > 20 && info.eyes[0].unsure > 20);
    assert!(recording.samples().any(|sample| sample.valid && sample.diameter_mm > 16.0));
    assert!(recording.samples().all(|sample| !sample.valid || sample.diameter_mm > 0.0));
}

#[test]
fn core_that_is_cut_off_says_so_wherever_it_is_cut() {
    let dir = TempDir::new().expect("a folder");
    for model in [true, false] {
        let whole = made_up_logs::core(123.0, model);
        let last = 1 + whole.trim_end().rfind('\n').expect("lines");
        let notes = |text: &str| info(&written(&dir, "log", text)).1.notes.join("\n");
        assert!(!notes(&whole).contains("cut off"));
        assert!(!notes(whole.trim_end()).contains("cut off"), "a whole last line without its ending is none");
        let row = &whole[last..];
        let comma = |column: usize| row.match_indices(',').nth(column - 1).expect("columns").0;
        // In the time, the confidence, the size in pixels, before the method, and before the size in millimetres.
        for at in [3, comma(3), comma(6) + 2, comma(7), comma(7) + 3, comma(12)] {
            let told = notes(&whole[..last + at]);
            let line = format!("line {}, the last one", whole.lines().count());
            assert!(told.contains(&line) && told.contains("the file is cut off"), "{at} of `{row}`: {told}");
        }
    }
}

#[test]
fn core_without_3d_rows_is_in_pixels() {
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", made_up_logs::core(123.0, false)));
    assert_eq!(recording.unit(), SizeUnit::Pixels);
    assert_truth(&info, &["left", "right"], 123.0, 10.0);
    assert!(info.notes[0].contains("pixels"), "{:?}", info.notes);
}

#[test]
fn core_prefers_the_model_fitted_afterwards_and_reads_older_names() {
    let header = "timestamp,index,id,confidence,norm_pos_x,norm_pos_y,diameter,method,diameter_3d\n";
    let rows = "-1.5,0,0,0.9,0,0,40,2d c++,\n-1.5,0,0,0.9,0,0,41,pye3d 0.3.0 real-time,3.1\n\
                -1.5,0,0,0.9,0,0,41,pye3d 0.3.0 post-hoc,3.2\n-1.4,0,0,0.9,0,0,41,pye3d 0.3.0 real-time,3.3\n\
                -1.4,0,0,0,0,0,41,pye3d 0.3.0 post-hoc,3.4\n-1.3,0,2,0.9,0,0,41,pye3d 0.3.0 post-hoc,3\n\
                -1.3,0,1,high,0,0,41,pye3d 0.3.0 post-hoc,3\n-1.3,0,1,1,0,0,41,pye3d 0.3.0 post-hoc,inf\n\
                -1.2,0,1,1,0,0\n-1.1,0,1,1,0,0,41,pye3d 0.3.0 post-hoc,\n-1.2,0,1,1,0,0,41,pye3d 0.3.0 post-hoc,3\n";
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", format!("{header}{rows}")));
    let read: Vec<_> =
        recording.samples().map(|sample| (sample.t_sample.0, sample.eye, sample.diameter_mm, sample.valid)).collect();
    let expected = [
        (-1_500_000_000, SampleEye::Right, 3.2, true),
        (-1_400_000_000, SampleEye::Right, 0.0, false),
        (-1_300_000_000, SampleEye::Left, 0.0, false),
        (-1_100_000_000, SampleEye::Left, 0.0, false),
    ];
    assert_eq!(read, expected);
    let told = "2 rows of the live model and 1 of 2-D";
    assert!(info.notes.iter().any(|note| note.contains(told)), "{:?}", info.notes);
    let faults: Vec<_> = info.faults.iter().map(|fault| (fault.name, fault.count)).collect();
    let expected =
        [("log_malformed", 1), ("log_bad_number", 1), ("log_not_finite", 1), ("log_backwards", 1), ("log_bad_eye", 1)];
    assert_eq!(faults, expected);
}

#[test]
fn eyelink_areas_and_diameters_are_read_of_one_eye_and_of_two() {
    let dir = TempDir::new().expect("a folder");
    for (rate_hz, eyes, area, named) in [
        (500.0, "LR", true, vec!["left", "right"]),
        (1000.0, "L", true, vec!["left"]),
        (1000.0, "R", false, vec!["right"]),
        (2000.0, "LR", false, vec!["left", "right"]),
    ] {
        let (recording, info) = info(&written(&dir, "log", made_up_logs::eyelink(rate_hz, eyes, area)));
        assert_eq!((recording.format(), recording.unit()), (LogFormat::EyeLink, SizeUnit::Arbitrary));
        assert_truth(&info, &named, rate_hz, 100.0);
        assert_eq!((info.stated_rate_hz, info.blinks.told), (Some(rate_hz), info.blinks.found));
        assert_eq!(recording.faults().total(), 0);
        assert!(info.eyes.iter().all(|eye| eye.lost_runs == 3 && eye.blinks_told == 3), "{info:?}");
        assert!(info.notes[0].contains("scale_mm_per_unit"), "{:?}", info.notes);
    }
}

#[test]
fn eyelink_blocks_keep_their_gap_and_a_clock_that_begins_anew_is_put_behind() {
    let block = |begin: u32, rows: u32| {
        let rows = (0..rows).map(|k| format!("{}\t  1.0\t  1.0\t  314.0\t...\n", begin + k)).collect::<String>();
        format!(
            "START\t{begin} \tRIGHT\tSAMPLES\tEVENTS\nPUPIL\tAREA\nSAMPLES\tGAZE\tRIGHT\tRATE\t1000.00\n\
             MSG\t5 !V\n{rows}SBLINK R {0}\nEND\t{0} \tSAMPLES\n",
            begin + 99
        )
    };
    let text = format!("{}{}{}", block(1000, 100), block(9000, 100), block(200, 100));
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", text));
    let times: Vec<_> = recording.samples().map(|sample| sample.t_sample.0 / 1_000_000).collect();
    assert_eq!((times[99], times[100], times[199], times[200]), (1099, 9000, 9099, 10_099));
    assert_eq!((info.eyes[0].gaps, info.blinks.told, recording.faults().total()), (2, 3, 0));
    assert_eq!(recording.blinks()[2].begins, TimeNs(10_198_000_000));
    let notes = info.notes.join("\n");
    assert!(notes.contains("3 blocks") && notes.contains("anew in line 213: "), "{notes}");
}

#[test]
fn eyelink_exports_of_samples_alone_are_read() {
    let two = "10\t  1.0\t  1.0\t  314.0\t  1.0\t  1.0\t    0.0\t.....\n11\t   .\t   .\t    0.0\t  1.0\t  1.0\t  314.0\t.C...\n";
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "two", two));
    let read: Vec<_> = recording.samples().map(|sample| (sample.eye, sample.valid)).collect();
    let (left, right) = (SampleEye::Left, SampleEye::Right);
    assert_eq!(read, [(left, true), (right, false), (left, false), (right, true)]);
    assert!((recording.samples().next().expect("one").diameter_mm - 19.995).abs() < 0.001);
    assert!(info.notes.iter().any(|note| note.contains("no header names the eyes")));
    // Velocity and resolution of one eye are no second eye, with flags and without.
    for (flags, is_open) in [("\t...", false), ("", true)] {
        let one = format!("10.5\t  1.0\t  1.0\t  314.0\t  0.1\t  0.1\t 40.0\t 41.0{flags}\n");
        let recording = Recording::read(&written(&dir, "one", one)).expect("reads");
        assert_eq!(recording.samples().map(|sample| sample.eye).collect::<Vec<_>>(), [SampleEye::Both]);
        assert_eq!(recording.begins(), TimeNs(10_500_000));
        assert_eq!(recording.notes().iter().any(|note| note.contains("7 figures")), is_open);
    }
    // Where no flags tell: 3 figures of an eye, 2 more of each eye for velocity, 2 for resolution, 1 for the port.
    for (figures, eyes) in [(3, 1), (4, 1), (5, 1), (6, 2), (7, 1), (8, 2), (10, 2), (11, 2), (12, 2), (13, 2)] {
        let line = format!("10{}\n", "\t  41.0".repeat(figures));
        let recording = Recording::read(&written(&dir, "log", line)).expect("reads");
        assert_eq!(recording.len(), eyes, "{figures}");
        let note = format!("the samples have {figures} figures");
        let is_open = recording.notes().iter().any(|told| told.contains(&note));
        assert_eq!(is_open, matches!(figures, 7 | 8), "{figures}: {:?}", recording.notes());
    }
}

#[test]
fn eyelink_exports_of_events_alone_are_refused_with_what_to_do() {
    let dir = TempDir::new().expect("a folder");
    let whole = made_up_logs::eyelink(500.0, "LR", true);
    let is_sample = |line: &&str| line.starts_with(|letter: char| letter.is_ascii_digit());
    let events: String = whole.lines().filter(|line| !is_sample(line)).flat_map(|line| [line, "\n"]).collect();
    let refused = |text: &str| Recording::read(&written(&dir, "log", text)).expect_err("refused").to_string();
    let message = refused(&events);
    assert!(message.contains("run edf2asc without -e") && message.contains("no line that is a sample"), "{message}");
    assert!(Recording::read(&written(&dir, "log", &whole)).is_ok());
    // A header alone tells nothing of how it was exported.
    let message = refused("** TYPE: EDF_FILE BINARY EVENT SAMPLE TAGGED\n");
    assert!(message.contains("holds no sample: none of its lines is one"), "{message}");
}

#[test]
fn eyelink_whole_milliseconds_at_2_khz_and_remote_columns_are_read() {
    let header = "START\t10 \tLEFT\tSAMPLES\nPUPIL\tDIAMETER\nSAMPLES\tGAZE\tLEFT\tRATE\t2000.00\tINPUT\n";
    let rest = "\t  1.0\t  1.0\t  900.0\t 127.0\t 3124.0\t 4567.0\t 650.4\t.............\n";
    let rows: String = (0..8).map(|k| format!("{}{rest}", 10 + k / 2)).collect();
    let dir = TempDir::new().expect("a folder");
    let bad = "14\t  1.0\t  1.0\n15\t  1.0\t  1.0\t  -9.0\n1x\t  1.0\t  1.0\t  9.0\n16\t 1.0\t 1.0\tbig\n";
    let (recording, info) = info(&written(&dir, "log", format!("{header}{rows}{bad}")));
    let times: Vec<_> = recording.samples().map(|sample| sample.t_sample.0 / 500_000).collect();
    assert_eq!(times, [20, 21, 22, 23, 24, 25, 26, 27, 30, 32]);
    assert!(recording.samples().take(8).all(|sample| sample.valid && sample.diameter_mm == 900.0));
    assert!(recording.samples().skip(8).all(|sample| !sample.valid));
    let faults: Vec<_> = info.faults.iter().map(|fault| (fault.name, fault.count)).collect();
    assert_eq!(faults, [("log_malformed", 1), ("log_bad_number", 2), ("log_negative", 1)]);
}

#[test]
fn smi_is_read_whatever_sets_its_columns_apart() {
    let dir = TempDir::new().expect("a folder");
    for (separator, comma) in [(';', false), (';', true), ('\t', false), ('\t', true), (',', false)] {
        let text = made_up_logs::smi(60.0, separator, comma);
        let utf16: Vec<u8> = format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect();
        for bytes in [text.into_bytes(), utf16] {
            let (recording, info) = info(&written(&dir, "log", bytes));
            assert_eq!((recording.format(), recording.unit()), (LogFormat::Smi, SizeUnit::Millimetres));
            assert_truth(&info, &["left", "right"], 60.0, 1.0);
            assert_eq!((info.stated_rate_hz, info.blinks.told), (Some(60.0), 3));
            assert_eq!((recording.faults().total(), info.eyes[0].lost_runs), (0, 3));
        }
    }
}

#[test]
fn smi_in_pixels_gives_the_disc_of_the_ellipse_and_counts_bad_rows() {
    let text = "## [iView]\r\nTime\tType\tTrial\tR Dia X [px]\tR Dia Y [px]\r\n1000\tSMP\t1\t16.00\t25.00\r\n\
                2000\tMSG\t1\t# Message: go\r\n3000\tSMP\t1\t0.00\t0.00\r\n4000\tSMP\t1\t16.00\r\n\
                5000\tSMP\t1\tx\t2\r\nsoon\tSMP\t1\t2\t2\r\n6000\tSMP\t1\t-1\t2\r\n7000\tSMP\t1\tnan\t2\r\n";
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", text));
    let read: Vec<_> = recording.samples().map(|s| (s.t_sample.0, s.eye, s.diameter_mm, s.valid)).collect();
    let (eye, lost) = (SampleEye::Right, false);
    assert_eq!(read[0], (1_000_000, eye, 20.0, true));
    assert_eq!(read[1..], [3_000_000, 5_000_000, 6_000_000, 7_000_000].map(|t_ns| (t_ns, eye, 0.0, lost)));
    assert_eq!(recording.unit(), SizeUnit::Pixels);
    let faults: Vec<_> = info.faults.iter().map(|fault| (fault.name, fault.count)).collect();
    assert_eq!(faults, [("log_malformed", 1), ("log_bad_number", 2), ("log_negative", 1)]);
}

#[test]
fn smi_millimetres_that_are_all_0_give_way_to_pixels() {
    let dir = TempDir::new().expect("a folder");
    let log = |mm: fn(i32) -> &'static str, px: &str| {
        let mut text = String::from("Time\tType\tTrial\tL Dia X [px]\tL Dia Y [px]\tL Pupil Diameter [mm]\n");
        text.push_str("1000\tMSG\t1\t9\t9\t9\n");
        for k in 0..100 {
            writeln!(text, "{}\tSMP\t1\t{px}\t{px}\t{}", 2000 + 4000 * k, mm(k)).expect("a String takes all");
        }
        Recording::read(&written(&dir, "log", text)).expect("reads")
    };
    let first = |recording: &Recording| recording.samples().next().map(|sample| sample.diameter_mm);
    let recording = log(|_| "0.00", "22.5");
    assert_eq!((recording.unit(), recording.len(), first(&recording)), (SizeUnit::Pixels, 100, Some(22.5)));
    let told = "the columns of diameters in millimetres are 0 or empty throughout";
    assert!(recording.warnings().iter().any(|warning| warning.contains(told)), "{:?}", recording.notes());
    // Millimetres that come late are no less what they are; of an eye that was never seen there are no pixels either.
    for recording in [log(|k| if k < 90 { "0.00" } else { "3.5" }, "22.5"), log(|_| "0.00", "0.00")] {
        assert_eq!((recording.unit(), first(&recording)), (SizeUnit::Millimetres, Some(0.0)));
        assert_eq!(recording.warnings(), [""; 0]);
    }
}

/// BeGaze's raw data of two participants at 60 Hz: P01 for 20 s of 3 mm, P02 for 35 s of 5 mm.
fn smi_of_two(participants: [&str; 2]) -> String {
    let mut text =
        String::from("RecordingTime [ms]\tTrial\tStimulus\tParticipant\tPupil Diameter Left [mm]\tCategory Left\n");
    for (participant, (seconds, mm)) in participants.into_iter().zip([(20, "3.0"), (35, "5.0")]) {
        for k in 0..60 * seconds {
            let t_ms = 1000.0 + f64::from(k) * 1000.0 / 60.0;
            let (stimulus, blinks) = (k / 300, k + 30 >= 60 * seconds || k < 30);
            let category = if blinks { "Blink" } else { "Fixation" };
            writeln!(text, "{t_ms:.3}\tTrial001\t{stimulus}.jpg\t{participant}\t{mm}\t{category}")
                .expect("a String takes all");
        }
    }
    text
}

#[test]
fn smi_of_two_participants_is_read_as_the_first_alone() {
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", smi_of_two(["P01", "P02"])));
    assert_eq!((recording.len(), recording.faults().total()), (1200, 0));
    assert!(recording.samples().all(|sample| sample.diameter_mm == 3.0));
    let notes = info.notes.join("\n");
    assert!(notes.contains("participant `P01`") && notes.contains("2100 rows of others"), "{notes}");
    assert!(notes.contains("export each into a file of its own"), "{notes}");
}

#[test]
fn smi_that_does_not_name_its_participants_has_a_gap_between_them() {
    let dir = TempDir::new().expect("a folder");
    let (recording, info) = info(&written(&dir, "log", smi_of_two([""; 2])));
    assert_eq!((recording.len(), recording.faults().total(), info.eyes[0].gaps), (3300, 0, 1));
    let samples: Vec<_> = recording.samples().collect();
    assert!(samples[..1200].iter().all(|sample| sample.diameter_mm == 3.0));
    assert!(samples[1200..].iter().all(|sample| sample.diameter_mm == 5.0));
    assert_eq!(samples[1200].t_sample - samples[1199].t_sample, TimeNs(1_000_000_000));
    assert!(info.notes[0].contains("anew in line 1202: "), "{:?}", info.notes);
    // The blinks before and behind the gap are two.
    let ends: Vec<_> = recording.blinks().iter().map(|blink| (blink.begins, blink.ends)).collect();
    let at = |index: usize| samples[index].t_sample;
    assert_eq!(ends, [(at(0), at(29)), (at(1170), at(1199)), (at(1200), at(1229)), (at(3270), at(3299))]);
}

/// Lines of 60 Hz: the times of a counter of `bits` bits of microseconds from `from_us` on.
fn counted(from_us: u64, seconds: u64, diameter_mm: f32, bits: u32) -> String {
    let mut text = String::new();
    for sequence in 0..60 * seconds {
        for (eye, later_us) in [(SampleEye::Left, 0), (SampleEye::Right, 5_000)] {
            // The right eye is two samples behind.
            let late_us = if eye == SampleEye::Right { 2 * 16_667 } else { 0 };
            let t_us = from_us + sequence * 16_667 + later_us - late_us;
            let device_us = (t_us % (1 << bits)) as i64;
            encode_line(&LineSample { sequence, device_us, eye, diameter_mm, confidence: 1.0 }, &mut text);
        }
    }
    text
}

#[test]
fn lines_go_on_over_the_wrap_of_a_32_bit_counter() {
    let dir = TempDir::new().expect("a folder");
    let wrap_us = 1 << 32;
    // The wrap behind the middle, before it, and twice.
    for (before_s, seconds) in [(35, 40), (5, 40), (1, 3)] {
        let from_us = wrap_us - before_s * 1_000_000;
        let path = |bits| written(&dir, &format!("{bits}"), counted(from_us, seconds, 4.0, bits));
        let [(wrapped, of_wrapped), (plain, _)] = [32, 40].map(|bits| info(&path(bits)));
        assert_eq!((wrapped.faults().total(), of_wrapped.eyes[0].gaps), (0, 0));
        let times = |log: &Recording| log.samples().map(|sample| (sample.eye, sample.t_sample)).collect::<Vec<_>>();
        assert_eq!(times(&wrapped), times(&plain));
        assert!(plain.notes().is_empty());
        let notes = wrapped.notes();
        assert!(notes.len() == 1 && notes[0].contains("32 bits") && notes[0].contains("over its wrap"), "{notes:?}");
    }
    // Not after a pause of more than 10 s, nor of a clock that has come further.
    for (from_us, to_us) in
        [(wrap_us - 26_000_000, 100_000), (wrap_us - 10_000_000, 11_000_000), (2 * wrap_us, 100_000)]
    {
        let text = counted(from_us, 15, 3.0, 40) + &counted(to_us, 15, 5.0, 40);
        let (recording, info) = info(&written(&dir, "log", text));
        assert_eq!((recording.faults().total(), info.eyes[0].gaps), (0, 1));
        assert!(info.notes[0].contains("the clock begins anew in line 1801: "), "{:?}", info.notes);
    }
}

#[test]
fn lines_of_a_second_session_are_put_behind_the_first() {
    let dir = TempDir::new().expect("a folder");
    for (first_s, second_s) in [(20, 35), (35, 20), (5, 60)] {
        let text = counted(2_000_000, first_s, 3.0, 40) + &counted(1_000_000, second_s, 5.0, 40);
        let (recording, info) = info(&written(&dir, "log", text));
        assert_eq!((recording.len() as u64, recording.faults().total()), (120 * (first_s + second_s), 0));
        let samples: Vec<_> = recording.samples().collect();
        let second = samples.iter().position(|sample| sample.diameter_mm == 5.0).expect("a second session");
        assert_eq!(second as u64, 120 * first_s);
        assert!(samples[second..].iter().all(|sample| sample.diameter_mm == 5.0));
        assert!((samples[second].t_sample - samples[second - 1].t_sample).0 > 900_000_000);
        assert!(info.eyes.iter().all(|eye| eye.gaps == 1), "{info:?}");
        let line = format!("anew in line {}: ", 120 * first_s + 1);
        assert!(info.notes[0].contains(&line) && info.notes[0].contains("a file of their own"), "{:?}", info.notes);
    }
}

#[test]
fn smi_with_fewer_samples_than_its_header_promises_says_so() {
    let dir = TempDir::new().expect("a folder");
    let rows = "1000\tSMP\t3.1\n5000\tSMP\t3.2\n9000\tMSG\tend\n";
    let notes = |promised: u32| {
        let header =
            format!("## Sample Rate:\t250\n## Number of Samples:\t{promised}\nTime\tType\tL Pupil Diameter [mm]\n");
        info(&written(&dir, "log", format!("{header}{rows}"))).1.notes
    };
    assert_eq!(notes(2), [""; 0]);
    assert!(notes(3)[0].contains("promises 3 samples and there are 2"), "{:?}", notes(3));
}

#[test]
fn neon_in_parts_names_the_other_ones() {
    let dir = TempDir::new().expect("a folder");
    let (states, times) = made_up_logs::neon_native(200.0);
    for part in [1, 2] {
        written(&dir, &format!("eye_state ps{part}.raw"), &states);
        written(&dir, &format!("eye_state ps{part}.time"), &times);
    }
    let (recording, info) = info(&dir.path().join("eye_state ps2.raw"));
    assert!(!recording.format().name().contains("ps1"), "{}", recording.format());
    assert!(info.notes.iter().any(|note| note.contains("one part") && note.contains("eye_state ps1.raw")), "{info:?}");
}

#[test]
fn neon_of_the_phone_is_read_with_its_companions() {
    let dir = TempDir::new().expect("a folder");
    let (states, times) = made_up_logs::neon_native(200.0);
    let path = written(&dir, "eye_state ps1.raw", &states);
    let refused = || Recording::read(&path).expect_err("refused").to_string();
    assert!(refused().contains("no file `eye_state ps1.time`"), "{}", refused());
    written(&dir, "eye_state ps1.time", &times[8..]);
    assert!(refused().contains("2000 records of 80 bytes and 15992 bytes in"), "{}", refused());

    written(&dir, "eye_state ps1.time", &times);
    let mut blink = 4_i32.to_le_bytes().to_vec();
    blink.extend([5_i64, 9].into_iter().flat_map(i64::to_le_bytes));
    written(&dir, "blinks ps1.raw", [&blink[..], &blink[..7]].concat());
    let (recording, info) = info(&path);
    assert_eq!(recording.format(), LogFormat::NeonNative);
    assert_truth(&info, &["left", "right"], 200.0, 1.0);
    assert_eq!(recording.blinks(), [Blink { eye: SampleEye::Both, begins: TimeNs(5), ends: TimeNs(9) }]);
    assert!(recording.samples().any(|sample| sample.aperture_mm.is_some_and(|lids| lids < 1.0)));
    assert_eq!(recording.faults().total(), 0);

    // Under another name it is not its own blinks, nor are they anybody's.
    let renamed = written(&dir, "alice.raw", &states);
    written(&dir, "alice.time", &times);
    let alice = Recording::read(&renamed).expect("reads");
    assert_eq!((alice.len(), alice.blinks()), (recording.len(), &[][..]));
    assert!(!alice.notes().iter().any(|note| note.contains("blinks")), "{:?}", alice.notes());

    written(&dir, "eye_state.dtype", "[('pupil_diameter_left_mm', 'float64')]");
    assert!(refused().contains("`eye_state.dtype` of another form"), "{}", refused());
    let names: Vec<_> = (0..20)
        .map(|k| match k {
            0 => "('pupil_diameter_left_mm', 'float32')".into(),
            19 => "('eyelid_aperture_right_mm', '<f4')".into(),
            _ => format!("('field_{k}', '<f4')"),
        })
        .collect();
    written(&dir, "eye_state.dtype", format!("[{}]", names.join(", ")));
    let recording = Recording::read(&path).expect("reads");
    assert!(recording.samples().all(|sample| sample.eye == SampleEye::Left && sample.aperture_mm.is_none()));
}

/// An example of each format, short enough to be spoilt often.
pub(crate) fn examples() -> Vec<Vec<u8>> {
    let short = |text: String| text.into_bytes()[..2500].to_vec();
    let (states, _) = made_up_logs::neon_native(200.0);
    vec![
        short(neon_like_csv(3)),
        short(as_lines(&neon_like()[..80])),
        short(made_up_logs::core(123.0, true)),
        short(made_up_logs::eyelink(500.0, "LR", true)),
        short(made_up_logs::smi(60.0, ';', true)),
        states[..1600].to_vec(),
    ]
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

#[test]
#[ignore = "needs shared data"]
fn shared_data_logs_hold_what_is_known_of_them() {
    let known = [
        ("neon_demo/3d_eye_states.csv", vec!["left", "right"], 200.0, 2, 2),
        ("eyelink_small/eyelink_binocular_example.asc", vec!["left", "right"], 1000.0, 1, 1),
    ];
    for (name, eyes, rate_hz, told, found) in known {
        let (recording, info) = info(&shared_data().join("pupil").join(name));
        assert_eq!(recording.faults().total(), 0, "{name}");
        assert_eq!(info.eyes.iter().map(|eye| eye.eye).collect::<Vec<_>>(), eyes, "{name}");
        assert_eq!((info.blinks.told, info.blinks.found), (told, found), "{name}");
        for eye in &info.eyes {
            assert!((eye.rate_hz.expect("a rate") / rate_hz - 1.0).abs() < 0.005, "{name}: {eye:?}");
            assert!(eye.blinks_found >= Some(found), "{name}: {eye:?}");
        }
    }
    // At 7.4 s the lids of the right eye are told to be shut for 60 ms while the left eye is wide open.
    let (_, neon) = info(&shared_data().join("pupil/neon_demo/3d_eye_states.csv"));
    assert_eq!(neon.blinks.found_in_one_eye, 1);
    // These have a few samples of each block only.
    for (name, stated_hz) in [("monocular", 1000.0), ("monocular_2khz", 2000.0)] {
        let (recording, info) = info(&shared_data().join(format!("pupil/eyelink_small/eyelink_{name}_example.asc")));
        assert_eq!((info.stated_rate_hz, recording.len(), recording.faults().total()), (Some(stated_hz), 16, 0));
        assert_eq!((info.eyes[0].eye, info.eyes[0].lost, info.blinks.told), ("left", 0, 0));
        let range = info.eyes[0].diameter.expect("a range");
        // Areas of 617 to 798.
        assert!(range.least > 27.9 && range.greatest < 32.0, "{range:?}");
    }
}
