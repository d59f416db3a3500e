//! Logs of Tobii, Gazepoint, PupilEXT, BIDS and the Lab Streaming Layer, made here in the layout of real ones.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use flate2::Compression;
use flate2::write::GzEncoder;
use holod_calibration::TimeNs;
use holod_pupil_input::wire::WireFault;
use holod_pupil_input::{Blink, LogFault, LogFormat, LogInfo, Recording, ReplayError, SampleEye, SizeUnit};
use holod_tests::worst;
use proptest::prelude::*;
use tempfile::TempDir;

const MS: i64 = 1_000_000;

fn written(dir: &TempDir, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
    let path = dir.path().join(name);
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("makes folders");
    std::fs::write(&path, content).expect("writes");
    path
}

fn read(content: impl AsRef<[u8]>) -> Recording {
    let dir = TempDir::new().expect("a folder");
    Recording::read(&written(&dir, "log", content)).expect("reads")
}

fn gzip(content: impl AsRef<[u8]>) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(content.as_ref()).expect("a Vec takes all");
    encoder.finish().expect("a Vec takes all")
}

fn utf16(text: &str) -> Vec<u8> {
    format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect()
}

/// Time, eye and diameter of each sample; None where the log says that the pupil was lost.
fn samples(recording: &Recording) -> Vec<(i64, SampleEye, Option<f32>)> {
    recording.samples().map(|s| (s.t_sample.0, s.eye, s.valid.then_some(s.diameter_mm))).collect()
}

fn of_eye(recording: &Recording, eye: SampleEye) -> Vec<(i64, Option<f32>)> {
    samples(recording).into_iter().filter(|row| row.1 == eye).map(|row| (row.0, row.2)).collect()
}

fn noted(recording: &Recording, words: &str) -> bool {
    recording.notes().iter().any(|note| note.contains(words))
}

fn warned(recording: &Recording, words: &str) -> bool {
    recording.warnings().iter().any(|warning| warning.contains(words))
}

use SampleEye::{Both, Left, Right};

// Tobii.

/// A Pro Lab export of 60 Hz: gyroscope and event rows between the eye tracker's, the right eye lost from row 10 to 14,
/// the last rows of another participant.
fn tobii(time: &str, per_ms: f64, unit: &str) -> String {
    let mut text = format!(
        "{time}\tComputer timestamp\tSensor\tParticipant name\tRecording name\tEvent\tEvent value\tGaze point X\t\
         Pupil diameter left{unit}\tPupil diameter right{unit}\tValidity left\tValidity right\tEye movement type\r\n"
    );
    let stamp = |row: i32| (f64::from(row) * 16.667 * per_ms).round();
    writeln!(text, "0\t0\t\tP1\tRec 1\tRecordingStart\tsaid \"go\t\t\t\t\t\t\r").expect("a String takes all");
    for row in 0..50 {
        let (right, validity) = if (10..15).contains(&row) { ("", "Invalid") } else { ("3.50", "Valid") };
        writeln!(
            text,
            "{t}\t{t}\tEye Tracker\tP1\tRec 1\t\t\t960\t{left:.2}\t{right}\tValid\t{validity}\tFixation\r",
            t = stamp(row),
            left = 3.0 + 0.01 * f64::from(row),
        )
        .expect("a String takes all");
        writeln!(text, "{}\t0\tGyroscope\tP1\tRec 1\t\t\t\t\t\t\t\tFixation\r", stamp(row) + 1.0).expect("writes");
    }
    for row in 0..5 {
        writeln!(text, "{}\t0\tEye Tracker\tP2\tRec 1\t\t\t1\t9.0\t9.0\tValid\tValid\tFixation\r", stamp(row))
            .expect("a String takes all");
    }
    text
}

fn judge_tobii(recording: &Recording, step_ns: f64) {
    assert_eq!((recording.format(), recording.unit()), (LogFormat::Tobii, SizeUnit::Millimetres));
    assert_eq!(recording.faults().total(), 0);
    let (left, right) = (of_eye(recording, Left), of_eye(recording, Right));
    assert_eq!((left.len(), right.len()), (50, 50));
    for (row, (left, right)) in left.iter().zip(&right).enumerate() {
        assert!((left.0 as f64 - row as f64 * step_ns).abs() <= 500_500.0, "{row}: {left:?}");
        assert!((left.1.expect("valid") - (3.0 + 0.01 * row as f32)).abs() < 1e-5, "{left:?}");
        assert_eq!(right.1, (!(10..15).contains(&row)).then_some(3.5));
    }
    assert!(noted(recording, "5 rows of others"), "{:?}", recording.notes());
}

#[test]
fn tobii_pro_lab_reads_in_each_of_its_dialects() {
    let step_ns = 16.667e6;
    let us = tobii("Recording timestamp [\u{3bc}s]", 1e3, " [mm]");
    judge_tobii(&read(&us), step_ns);
    judge_tobii(&read(format!("\u{feff}{us}")), step_ns);
    judge_tobii(&read(utf16(&us)), step_ns);
    judge_tobii(&read(gzip(utf16(&us))), step_ns);
    judge_tobii(&read(tobii("Recording timestamp [ms]", 1.0, "")), step_ns);
    // Without a unit the steps tell.
    for (per_ms, told) in [(1.0, "milliseconds"), (1e3, "microseconds")] {
        let recording = read(tobii("Recording timestamp", per_ms, ""));
        judge_tobii(&recording, step_ns);
        assert!(noted(&recording, told), "{:?}", recording.notes());
    }
    // A comma for the point.
    judge_tobii(&read(us.replace("3.", "3,")), step_ns);
    // Saved again with semicolons.
    judge_tobii(&read(us.replace("said \"go", "").replace('\t', ";")), step_ns);
}

#[test]
fn tobii_recordings_without_names_are_put_behind_each_other() {
    let mut text = String::from("Recording timestamp [ms]\tSensor\tPupil diameter left [mm]\tValidity left\n");
    for (rows, mm) in [(600, "3.0"), (900, "5.0"), (100, "4.0")] {
        for row in 0..rows {
            writeln!(text, "{}\tEye Tracker\t{mm}\tValid", 100 + 16 * row).expect("a String takes all");
        }
    }
    let left = of_eye(&read(&text), Left);
    assert_eq!(left.len(), 1600);
    assert!(left.windows(2).all(|pair| pair[0].0 < pair[1].0));
    let changes: Vec<_> = (1..1600)
        .filter(|row| left[*row].1 != left[row - 1].1)
        .map(|row| (row, left[row].0 - left[row - 1].0))
        .collect();
    assert_eq!(changes, [(600, 1000 * MS), (1500, 1000 * MS)]);
    assert!(noted(&read(&text), "begins anew in lines 602, 1502: "), "{:?}", read(&text).notes());
}

#[test]
fn tobii_studio_reads_with_its_names_and_validity_codes() {
    let header = "ParticipantName\tMediaName\tRecordingTimestamp\tGazePointIndex\tPupilLeft\tPupilRight\tValidityLeft\tValidityRight\t\n";
    let rows = "P03\t\t3\t1\t2,80\t2,62\t0\t0\t\nP03\t\t19\t2\t2,81\t-1,00\t1\t4\t\nP03\t\t36\t3\t2,82\t2,6\t2\t3\t\n\
                P03\t\t40\t\t\t\t\t\t\nP03\t\t53\t4\tx\t2,60\t0\t0\t\nP03\t\tsoon\t5\t2,8\t2,6\t0\t0\t\nP03\n";
    let recording = read(format!("{header}{rows}"));
    assert_eq!(
        of_eye(&recording, Left),
        [(3 * MS, Some(2.8)), (19 * MS, Some(2.81)), (36 * MS, None), (53 * MS, None)],
        "{:?}",
        recording.notes()
    );
    assert_eq!(
        of_eye(&recording, Right),
        [(3 * MS, Some(2.62)), (19 * MS, None), (36 * MS, None), (53 * MS, Some(2.6))]
    );
    assert_eq!(recording.faults().of(LogFault::BadNumber), 2);
    assert_eq!(recording.faults().of(LogFault::Malformed), 1);
    assert_eq!(recording.faults().total(), 3);
    assert!(noted(&recording, "2 times an eye is valid and has no diameter"), "{:?}", recording.notes());
}

#[test]
fn tobii_rows_of_events_are_no_lost_pupils_whatever_columns_there_are() {
    let log = |validity: bool, event: &str| {
        let names = if validity { "\tValidity left" } else { "" };
        let mut text = format!("Recording timestamp [ms]\tEvent\tPupil diameter left [mm]{names}\n");
        for row in 0..100 {
            let valid = if validity { "\tValid" } else { "" };
            writeln!(text, "{}\t\t3.1{valid}", 4 * row).expect("a String takes all");
            if row % 10 == 0 {
                let unsaid = if validity { "\t" } else { "" };
                writeln!(text, "{}\t{event}\t{unsaid}", 4 * row + 1).expect("a String takes all");
            }
        }
        read(text)
    };
    for validity in [false, true] {
        let recording = log(validity, "MouseEvent");
        assert_eq!((recording.len(), recording.faults().total()), (100, 0), "{validity}");
        assert!(recording.samples().all(|sample| sample.valid), "{validity}");
        assert!(!noted(&recording, "has no diameter"), "{:?}", recording.notes());
    }
    // Without an event, and without a column of validity, an empty cell is a lost pupil.
    assert_eq!(log(false, "").samples().filter(|sample| !sample.valid).count(), 10);
    assert!(noted(&log(true, ""), "10 times an eye is valid and has no diameter"));
}

#[test]
fn tobii_whole_milliseconds_give_way_to_the_trackers_microseconds() {
    // 250 Hz in whole milliseconds, and the tracker's own clock a little off; a gyroscope's row has no tracker's time.
    let log = |finer: &str, at: &dyn Fn(i64) -> String| {
        let mut text = format!("Recording timestamp [ms]\t{finer}\tSensor\tPupil diameter left [mm]\tValidity left\n");
        for row in 0..100 {
            writeln!(text, "{}\t{}\tEye Tracker\t3.1\tValid", row * 3333 / 1000, at(row)).expect("writes");
            writeln!(text, "{}\t\tGyroscope\t\t", row * 3333 / 1000).expect("writes");
        }
        text
    };
    let us = |row: i64| (7_000_000_123 + row * 3333).to_string();
    for name in ["Eyetracker timestamp [\u{3bc}s]", "EyeTrackerTimestamp", "Computer timestamp [\u{3bc}s]"] {
        let recording = read(log(name, &us));
        let left = of_eye(&recording, Left);
        assert_eq!((left[0].0, left[99].0), (7_000_000_123_000, (7_000_000_123 + 99 * 3333) * 1000), "{name}");
        assert!(noted(&recording, "in microseconds"), "{:?}", recording.notes());
    }
    // Not those of a clock that counts something else, stands, or is not there in every row.
    let odd: [&dyn Fn(i64) -> String; 3] =
        [&|row| row.to_string(), &|_| "7".into(), &|row| if row == 50 { String::new() } else { us(row) }];
    for at in odd {
        assert_eq!(of_eye(&read(log("Eyetracker timestamp", at)), Left)[99].0, 329 * MS);
    }
}

#[test]
fn tobii_pixels_are_no_millimetres() {
    let header = "Recording timestamp [ms]\tPupil diameter left [px]\tPupil diameter left [mm]\tValidity left\n";
    let rows = "0\t31.5\t3.1\tValid\n4\t31.6\t3.2\tValid\n";
    assert_eq!(read(format!("{header}{rows}")).unit(), SizeUnit::Millimetres);
    assert_eq!(of_eye(&read(format!("{header}{rows}")), Left)[1].1, Some(3.2));
    let recording = read(format!("{header}{rows}").replace("left [mm]", "of the glasses"));
    assert_eq!((recording.unit(), of_eye(&recording, Left)[1].1), (SizeUnit::Pixels, Some(31.6)));
    assert!(noted(&recording, "pixels"), "{:?}", recording.notes());
}

// Gazepoint.

const GAZEPOINT_EYES: &str = "LPCX,LPCY,LPD,LPS,LPV,RPCX,RPCY,RPD,RPS,RPV";

/// 60 Hz; the left eye lost and blink 7 from row 20 to 25, its length told in row 26; TIME starts again at row 30.
fn gazepoint(millimetres: bool) -> String {
    let more = if millimetres { ",BKID,BKDUR,BKPMIN,LPMM,LPMMV,RPMM,RPMMV" } else { "" };
    let mut text = format!(
        "MEDIA_ID,MEDIA_NAME,CNT,TIME(2020/11/03 12:00:00.000),TIMETICK(f=10000000),FPOGX,FPOGY,{GAZEPOINT_EYES}{more},\r\n"
    );
    for row in 0..60 {
        let (media, time_s) = if row < 30 { (0, row) } else { (1, row - 30) };
        let time_s = f64::from(time_s) / 60.0;
        let tick = 696_216_388_878_i64 + i64::from(row) * 10_000_000 / 60;
        let seen = u8::from(!(20..26).contains(&row));
        write!(
            text,
            "{media},\"a, b\",{row},{time_s:.5},{tick},0.5,0.5,0.4,0.6,{:.3},1.05,{seen},0.6,0.6,18.2,1.06,1",
            if seen == 1 { 18.3 } else { 0.0 }
        )
        .expect("a String takes all");
        if millimetres {
            let (id, lasted_s) = (if seen == 1 { 0 } else { 7 }, if row == 26 { 0.1 } else { 0.0 });
            let left = if seen == 1 { 3.5 } else { 0.0 };
            write!(text, ",{id},{lasted_s:.5},12,{left:.5},{seen},3.56681,1").expect("a String takes all");
        }
        text.push_str(",\r\n");
    }
    text
}

#[test]
fn gazepoint_reads_on_its_tick_clock_with_each_blink_once() {
    let recording = read(gazepoint(true));
    assert_eq!((recording.format(), recording.unit()), (LogFormat::Gazepoint, SizeUnit::Millimetres));
    assert_eq!((recording.faults().total(), recording.len()), (0, 120));
    let tick = |row: i64| (696_216_388_878 + row * 10_000_000 / 60) * 100;
    let left = of_eye(&recording, Left);
    assert_eq!((left[0], left[59]), ((tick(0), Some(3.5)), (tick(59), Some(3.5))));
    assert!((0..60).all(|row| left[row].1.is_none() == (20..26).contains(&row)));
    assert_eq!(of_eye(&recording, Right)[22], (tick(22), Some(3.56681)));
    let blink = Blink { eye: Both, begins: TimeNs(tick(20)), ends: TimeNs(tick(25)) };
    assert_eq!(recording.blinks(), [blink]);
    assert!(noted(&recording, "2020/11/03 12:00:00.000"));
}

#[test]
fn gazepoint_without_millimetres_or_ticks_reads_what_there_is() {
    let recording = read(gazepoint(false));
    assert_eq!((recording.unit(), recording.len()), (SizeUnit::Pixels, 120));
    assert_eq!(of_eye(&recording, Left)[19].1, Some(18.3));
    // A tick clock that stands still is none: then the times that start again go backwards.
    let mut standing = String::new();
    for line in gazepoint(true).lines() {
        let cells: Vec<_> = line.split(',').collect();
        let cells = cells.iter().map(|cell| if cell.starts_with("6962163") { "0" } else { cell });
        standing.extend(cells.flat_map(|cell| [cell, ","]).chain(["\n"]));
    }
    let recording = read(standing);
    assert_eq!(of_eye(&recording, Right)[1].0, 16_670_000);
    assert_eq!(recording.faults().of(LogFault::Backwards), 58);
}

#[test]
fn gazepoint_millimetres_that_are_all_0_give_way_to_pixels() {
    let log = |lpmm: fn(i64) -> u8, lpd: &str| {
        let mut text = String::from("CNT,TIME,LPD,LPV,RPD,RPV,LPMM,LPMMV,RPMM,RPMMV\n");
        for row in 0..100 {
            writeln!(text, "{row},{:.2},{lpd},1,21,1,{},1,0,0", row as f64 * 0.01, lpmm(row))
                .expect("a String takes all");
        }
        read(text)
    };
    let recording = log(|_| 0, "22.5");
    assert_eq!((recording.unit(), recording.len()), (SizeUnit::Pixels, 200));
    assert_eq!((of_eye(&recording, Left)[0].1, of_eye(&recording, Right)[99].1), (Some(22.5), Some(21.0)));
    assert!(warned(&recording, "`LPMM` and `RPMM`, the diameters in millimetres, are 0"), "{:?}", recording.notes());
    // Millimetres that come late are no less what they are.
    let recording = log(|row| if row < 90 { 0 } else { 4 }, "22.5");
    assert_eq!((recording.unit(), of_eye(&recording, Left)[95].1), (SizeUnit::Millimetres, Some(4.0)));
    assert_eq!(recording.warnings(), [""; 0]);
    // Of an eye that was never seen there are no pixels either.
    let recording = read("CNT,TIME,LPD,LPV,LPMM,LPMMV\n0,0.00,0,0,0,0\n1,0.01,0,0,0,0\n");
    assert_eq!((recording.unit(), recording.warnings().len()), (SizeUnit::Millimetres, 0), "{:?}", recording.notes());
}

#[test]
fn gazepoint_media_whose_time_starts_again_are_put_behind_with_their_blinks() {
    let mut text = String::from("MEDIA_ID,CNT,TIME,BKID,BKDUR,LPMM,LPMMV\n");
    for media in 0..7 {
        for row in 0..300_i64 {
            // Each medium ends in a blink that goes on in the next one, and has one soon after its beginning.
            let id = match row {
                0..3 if media > 0 => media,
                5..8 => 100 + media,
                290.. => media + 1,
                _ => 0,
            };
            writeln!(text, "{media},{row},{:.2},{id},0,3.1,1", row as f64 * 0.01).expect("a String takes all");
        }
    }
    let recording = read(text);
    let left = of_eye(&recording, Left);
    assert_eq!((left.len(), left[300].0, left[2099].0), (2100, 3990 * MS, (6 * 3990 + 2990) * MS));
    assert_eq!(recording.faults().total(), 0);
    assert!(noted(&recording, "in lines 302, 602, 902, 1202, 1502 and 1 more: "), "{:?}", recording.notes());
    let within: Vec<_> = recording.blinks().iter().map(|blink| blink.ends.0 - blink.begins.0).collect();
    assert_eq!(within.len(), 7 * 3 - 1);
    assert!(within.iter().all(|lasts| [20 * MS, 90 * MS].contains(lasts)), "{:?}", recording.blinks());
    assert_eq!(recording.blinks()[3].begins, TimeNs((3990 + 50) * MS));
}

#[test]
fn gazepoint_blinks_are_told_by_length_where_there_is_no_number() {
    let mut text = String::from("CNT,TIME,LPMM,LPMMV,BKDUR\n");
    for row in 0..100_i64 {
        // The length stays until row 60 in the first, one row in the second.
        let lasted_s = if (40..60).contains(&row) { "0.2" } else { ["0", "0.15"][usize::from(row == 80)] };
        writeln!(text, "{row},{:.2},3.1,1,{lasted_s}", row as f64 * 0.01).expect("a String takes all");
    }
    let recording = read(text);
    let blink = |from: i64, to: i64| Blink { eye: Both, begins: TimeNs(from * MS), ends: TimeNs(to * MS) };
    assert_eq!(recording.blinks(), [blink(200, 400), blink(650, 800)]);
}

#[test]
fn a_table_of_fixations_is_told_from_one_of_samples() {
    let log = |step_s: f64| {
        let mut text = String::from("MEDIA_ID,CNT,TIME,FPOGX,FPOGD,FPOGID,LPMM,LPMMV,RPMM,RPMMV\n");
        for row in 0..40 {
            writeln!(text, "0,{row},{:.5},0.5,0.3,{row},3.1,1,3.2,1", f64::from(row) * step_s).expect("writes");
        }
        read(text)
    };
    let fixations = log(0.385);
    assert!(noted(&fixations, "2.6 samples a second") && noted(&fixations, "all_gaze"), "{:?}", fixations.notes());
    assert_eq!(log(1.0 / 60.0).notes(), [""; 0]);
}

#[test]
fn times_that_cannot_be_are_told() {
    let neon = |t: &dyn Fn(u64) -> String, separator: &str| {
        let mut text = "section id,timestamp [ns],pupil diameter left [mm],eyelid aperture left [mm]\n".to_owned();
        for k in 0..400 {
            writeln!(text, "a,{},3.5,9.1", t(k)).expect("writes");
        }
        read(text.replace(',', separator))
    };
    let told = |step_ns: u64| neon(&|k| (1_760_676_790_465_965_534 + k * step_ns).to_string(), ",").notes().to_vec();
    assert_eq!(told(5_000_000), [""; 0]);
    assert!(told(17)[0].contains("its times are in another unit"), "{:?}", told(17));
    let excel = neon(&|_| "1.76068E+18".into(), ",");
    assert!(
        noted(&excel, "its times do not advance: 399 of 400") && noted(&excel, "spreadsheets"),
        "{:?}",
        excel.notes()
    );
    // As a German spreadsheet writes them.
    let semicolons = neon(&|k| (1_760_676_790_465_965_534 + k * 5_000_000).to_string(), ";");
    assert_eq!((semicolons.len(), semicolons.faults().total()), (400, 0));
    assert_eq!(semicolons.samples().next().and_then(|sample| sample.aperture_mm), Some(9.1));
    let smi = |rate: u32| {
        let mut text = format!("## [iView]\n## Sample Rate:\t{rate}\nTime\tType\tTrial\tL Pupil Diameter [mm]\n");
        for k in 0..400 {
            writeln!(text, "{}\tSMP\t1\t3.5", 1_000_000 + k * 4000).expect("writes");
        }
        read(text)
    };
    assert_eq!(smi(250).notes(), [""; 0]);
    assert!(
        noted(&smi(2500), "a power of ten apart") && noted(&smi(60), "which is not alike"),
        "{:?}",
        smi(60).notes()
    );
}

#[test]
fn a_neon_log_that_is_cut_within_its_lids_is_told() {
    let text = "section id,timestamp [ns],pupil diameter left [mm],eyelid aperture left [mm],x\na,1000,3.5,9.1,0\n";
    let cut = read(format!("{text}a,2000,3.5,9"));
    assert!(noted(&cut, "line 3, the last one") && cut.len() == 1, "{:?}", cut.notes());
    assert_eq!(read(format!("{text}a,2000,3.5,9.1,")).notes(), [""; 0]);
}

#[test]
fn a_log_that_is_cut_off_says_so() {
    let whole = gazepoint(true);
    assert!(!noted(&read(&whole), "cut off"));
    let cut = read(&whole[..whole.len() - 40]);
    assert!(noted(&cut, "line 61, the last one") && noted(&cut, "copy"), "{:?}", cut.notes());
    // A whole last line without its ending is none.
    assert!(!noted(&read(whole.trim_end()), "cut off"));
}

// PupilEXT.

const PUPILEXT: &str = "filename,timestamp_ms,algorithm,diameter_px,undistortedDiameter_px,physicalDiameter_mm,width_px,height_px,\
                        axisRatio,center_x,center_y,angle_deg,circumference_px,confidence,outlineConfidence";
const PUPILEXT_STEREO: &str = "filename,timestamp_ms,algorithm,diameterMain_px,diameterSec_px,undistortedDiameterMain_px,undistortedDiameterSec_px,\
                               physicalDiameter_mm,confidenceMain,outlineConfidenceMain,confidenceSec,outlineConfidenceSec";

#[test]
fn pupilext_reads_millimetres_where_it_has_them_and_pixels_where_not() {
    let row = |t: i64, px: &str, flat: &str, mm: &str, confidence: &str, outline: &str| {
        format!("1.bmp,{t},PuRe,{px},{flat},{mm},40,41,0.97,1,2,3,130,{confidence},{outline}\n")
    };
    let t = 1_600_000_000_000;
    let lost = row(t, "-1", "-1", "-1", "-1", "-1");
    let calibrated = format!(
        "{PUPILEXT}\n{lost}{}{}",
        row(t + 8, "40.5", "40.6", "4.25", "0.9", "0.8"),
        row(t + 16, "41", "41", "4.3", "-1", "0.7")
    );
    for text in [calibrated.clone(), calibrated.replace(',', ";").replace('.', ","), calibrated.replace(',', "\t")] {
        let recording = read(text);
        assert_eq!((recording.format(), recording.unit()), (LogFormat::PupilExt, SizeUnit::Millimetres));
        let expected = [(t * MS, Both, None), ((t + 8) * MS, Both, Some(4.25)), ((t + 16) * MS, Both, Some(4.3))];
        assert_eq!(samples(&recording), expected);
        assert_eq!(recording.samples().map(|s| s.confidence).collect::<Vec<_>>(), [1.0, 0.9, 0.7]);
    }
    let plain = format!("{PUPILEXT}\n{lost}{}", row(t + 8, "40.5", "-1", "-1", "0.9", "0.8"));
    let recording = read(plain);
    assert_eq!(recording.unit(), SizeUnit::Pixels);
    assert_eq!(samples(&recording)[1].2, Some(40.5));
    assert!(noted(&recording, "not calibrated"));
}

#[test]
fn pupilext_with_two_views_is_one_pupil_and_with_two_pupils_two() {
    let recording = read(format!(
        "{PUPILEXT_STEREO}\nx,10,PuRe,40,41,-1,-1,4.5,0.9,0.8,0.7,0.6\nx,20,PuRe,-1,41,-1,-1,-1,-1,-1,0.7,0.6\n"
    ));
    assert_eq!(samples(&recording), [(10 * MS, Both, Some(4.5)), (20 * MS, Both, None)]);
    assert_eq!(recording.samples().next().map(|s| s.confidence), Some(0.9));
    assert!(noted(&recording, "two cameras"), "{:?}", recording.notes());
    let two = "filename,timestamp_ms,algorithm,diameterA_px,diameterB_px,undistortedDiameterA_px,undistortedDiameterB_px,physicalDiameterA_mm,physicalDiameterB_mm,confidenceA,confidenceB\n\
               x,10,PuRe,40,41,-1,-1,-1,-1,0.5,0.6\nx,20,PuRe,40\n";
    let recording = read(two);
    assert_eq!(
        samples(&recording),
        [(10 * MS, Right, Some(40.0)), (10 * MS, Left, Some(41.0)), (20 * MS, Right, Some(40.0))]
    );
    assert_eq!(recording.faults().of(LogFault::Malformed), 1);
    // Later versions name the eye and the camera.
    let late = "timestamp_ms;pupilDiameter_px_R_M;pupilUndistortedDiameter_px_R_M;pupilPhysicalDiameter_mm_R_M;pupilConfidence_R_M;\
                pupilOutlineConfidence_R_M;pupilDiameter_px_L_M;pupilPhysicalDiameter_mm_L_M;pupilConfidence_L_M;trial;message\n\
                10;40;41;3.5;0.9;0.8;42;-1;0.7;1;\n";
    let recording = read(late);
    assert_eq!(samples(&recording), [(10 * MS, Right, Some(3.5)), (10 * MS, Left, None)]);
    assert_eq!(recording.samples().map(|s| s.confidence).collect::<Vec<_>>(), [0.9, 0.7]);
    let nobodys = late.replace("_R_", "_U_").replace("_L_", "_x_");
    assert_eq!(samples(&read(nobodys)), [(10 * MS, Both, Some(3.5))]);
}

#[test]
fn pupilext_of_the_first_versions_reads_with_its_brackets() {
    let one = "filename,timestamp[ms],algorithm,diameter[px],physicaldiameter[mm],width[px],height[px],axis_ratio,center_x,center_y,angle[deg],circumference[px],confidence,outline_confidence\n\
               1.bmp,10,PuRe,40.5,4.25,40,41,0.97,1,2,3,130,0.9,0.8\n2.bmp,18,PuRe,41,4.5,40,41,0.97,1,2,3,130,-1,0.7\n";
    let recording = read(one);
    assert_eq!((recording.format(), recording.unit()), (LogFormat::PupilExt, SizeUnit::Millimetres));
    assert_eq!(samples(&recording), [(10 * MS, Both, Some(4.25)), (18 * MS, Both, Some(4.5))]);
    assert_eq!(recording.samples().map(|s| s.confidence).collect::<Vec<_>>(), [0.9, 0.7]);
    let pixels = read(one.replace("4.25", "-1").replace("4.5,", "-1,"));
    assert_eq!((pixels.unit(), samples(&pixels)[1].2), (SizeUnit::Pixels, Some(41.0)));
    let two = "filename,timestamp[ms],algorithm,diameter[px],diameterSec[px],physicaldiameter[mm],confidence,outline_confidence,confidenceSec\nx,10,PuRe,40,44,4.5,0.9,0.8,0.7\n";
    let recording = read(two);
    assert_eq!(samples(&recording), [(10 * MS, Both, Some(4.5))]);
    assert!(noted(&recording, "two cameras"), "{:?}", recording.notes());
}

// BIDS.

const SIDECAR: &str = r#"{
    "Columns": ["timestamp", "x_coordinate", "y_coordinate", "pupil_size"],
    "PhysioType": "eyetrack", "RecordedEye": "right", "SamplingFrequency": 1000,
    "timestamp": {"Units": "ms", "Origin": "System startup"},
    "pupil_size": {"Description": "Diameter as the tracker gives it", "Units": "arbitrary"}
}"#;
const TABLE: &str =
    "7186799\t416.29\t267.39\t4612.0\n7186800\tn/a\tn/a\tn/a\n7186801\t416.2\t269\t0.0\n7186802\t415\t269\t4623\n";
const STEM: &str = "sub-01/func/sub-01_task-search_recording-eye1_physio";

fn bids(files: &[(&str, &[u8])]) -> Result<Recording, ReplayError> {
    let dir = TempDir::new().expect("a folder");
    let paths: Vec<_> = files.iter().map(|(name, content)| written(&dir, name, content)).collect();
    Recording::read(&paths[0])
}

#[test]
fn bids_reads_what_its_sidecar_says() {
    let table = format!("{STEM}.tsv.gz");
    let recording = bids(&[(&table, &gzip(TABLE)), (&format!("{STEM}.json"), SIDECAR.as_bytes())]).expect("reads");
    assert_eq!((recording.format(), recording.unit()), (LogFormat::Bids, SizeUnit::Arbitrary));
    assert_eq!(recording.stated_rate_hz(), Some(1000.0));
    let at = |ms: i64| (7_186_799 + ms) * MS;
    let expected =
        [(at(0), Right, Some(4612.0)), (at(1), Right, None), (at(2), Right, None), (at(3), Right, Some(4623.0))];
    assert_eq!(samples(&recording), expected);
    assert_eq!(recording.faults().total(), 0);

    // Not packed; an area; millimetres; another eye; a clock of ticks that the sidecar does not explain.
    let plain = |sidecar: &str, table: &str| {
        bids(&[("x_recording-eye1_physio.tsv", table.as_bytes()), ("x_recording-eye1_physio.json", sidecar.as_bytes())])
    };
    let recording =
        plain(&SIDECAR.replace("Diameter as", "Pupil area as").replace("\"right\"", "\"cyclopean\""), TABLE)
            .expect("reads");
    let area_of = 2.0 * (4612.0_f64 / std::f64::consts::PI).sqrt();
    assert_eq!(samples(&recording)[0], (at(0), Both, Some(area_of as f32)));
    assert!(noted(&recording, "areas were made diameters"));
    let recording = plain(&SIDECAR.replace("arbitrary", "mm").replace("\"ms\"", "\"ns\""), TABLE).expect("reads");
    assert_eq!((recording.unit(), recording.begins()), (SizeUnit::Millimetres, TimeNs(7_186_799)));
    let recording = plain(&SIDECAR.replace("\"ms\"", "\"ticks\"").replace("1000", "250"), TABLE).expect("reads");
    assert_eq!(recording.ends() - recording.begins(), TimeNs(12 * MS));
    assert!(noted(&recording, "the unit `ticks`"), "{:?}", recording.notes());

    // No clock at all: rows at the rate, from the start time on.
    let sidecar = r#"{"Columns": ["pupil_size"], "SamplingFrequency": 500, "StartTime": -1.5, "RecordedEye": "left", "pupil_size": {"Units": "pixels"}}"#;
    let recording = plain(sidecar, "20.5\nn/a\n\n21\nx\n").expect("reads");
    assert_eq!(
        samples(&recording),
        [
            (-1500 * MS, Left, Some(20.5)),
            (-1498 * MS, Left, None),
            (-1496 * MS, Left, Some(21.0)),
            (-1494 * MS, Left, None)
        ]
    );
    assert_eq!(recording.unit(), SizeUnit::Pixels);
    assert_eq!(recording.faults().of(LogFault::BadNumber), 1);

    // Both eyes in one file, in nanoseconds, as some converters write it.
    let sidecar = r#"{"Columns": ["timestamp", "left_pupil_diameter", "right_pupil_diameter"], "RecordedEye": "cyclopean",
        "SamplingFrequency": 200, "timestamp": {"Units": "ns"}, "left_pupil_diameter": {"Units": "mm"}, "right_pupil_diameter": {"Units": "mm"}}"#;
    let recording = plain(sidecar, "1700000000000000001\t3.5\t3.6\n1700000000005000001\t3.5\t3.6\n").expect("reads");
    assert_eq!(
        samples(&recording)[..2],
        [(1_700_000_000_000_000_001, Left, Some(3.5)), (1_700_000_000_000_000_001, Right, Some(3.6))]
    );
}

#[test]
fn bids_areas_are_told_from_diameters_by_unit_then_name_then_description() {
    let (area, noted_area, diameter, noted_diameter) = ((true, false), (true, true), (false, false), (false, true));
    let cases = [
        ("pupil_size", "mm", "Pupil diameter", diameter),
        ("pupil_size", "mm", "Diameter of the ellipse fitted to the dark area", diameter),
        ("pupil_size", "mm", "", diameter),
        ("pupil_size", "mm", "Pupil area", noted_diameter),
        ("pupil_size", "mm^2", "", area),
        ("pupil_size", "mm2", "", area),
        ("pupil_size", "mm \u{b2}", "Pupil size", area),
        ("pupil_size", "mm**2", "Diameter", area),
        ("pupil_area", "mm2", "", area),
        ("pupil_area", "mm", "", noted_area),
        ("pupil_area", "pixels", "", area),
        ("pupil_size", "px2", "", area),
        ("pupil_size", "pixels", "Pupil area", area),
        ("pupil_size", "pixels", "Pupil diameter", diameter),
        ("pupil_size", "pixels", "", noted_diameter),
        ("pupil_area", "arbitrary", "The diameter's square", area),
        ("pupil_diameter", "arbitrary", "of the dark area", diameter),
        ("pupil_size", "arbitrary", "Pupil area as calculated by the eye-tracker", area),
        ("pupil_size", "arbitrary", "Pupil diameter", diameter),
        ("pupil_size", "arbitrary", "Area or diameter, depending on the setting", noted_diameter),
        ("pupil_size", "arbitrary", "", noted_diameter),
        ("pupil_size", "a.u.2", "", noted_diameter),
    ];
    for (column, unit, description, expected) in cases {
        let sidecar = format!(
            r#"{{"Columns": ["timestamp", "{column}"], "SamplingFrequency": 500, "RecordedEye": "left",
                "timestamp": {{"Units": "ms"}}, "{column}": {{"Units": "{unit}", "Description": "{description}"}}}}"#
        );
        let recording = bids(&[("x_physio.tsv", b"0\t9.62\n2\t9.62\n"), ("x_physio.json", sidecar.as_bytes())]);
        let recording = recording.expect("reads");
        let read = recording.samples().next().expect("a sample").diameter_mm;
        let is_area = (read - 3.5).abs() < 0.001;
        assert!(is_area || read == 9.62, "{column}, {unit}, {description}: {read}");
        let found = (is_area, noted(&recording, "x_physio.json: `pupil_"));
        assert_eq!(found, expected, "{column}, {unit}, {description}: {:?}", recording.notes());
        assert_eq!(noted(&recording, "areas were made diameters"), is_area);
        let of_mm = unit.starts_with("mm");
        assert_eq!(recording.unit() == SizeUnit::Millimetres, of_mm, "{unit}: {:?}", recording.unit());
    }
}

#[test]
fn bids_radii_are_told_by_name_or_description() {
    for (column, description, expected_mm, doubted) in [
        ("pupil_radius", "", 3.7, false),
        ("pupil_size", "Radius of the pupil", 3.7, false),
        ("pupil_diameter", "Radius of the pupil", 1.85, true),
        ("pupil_size", "Diameter, from the fitted circle's radius", 1.85, false),
    ] {
        let sidecar = format!(
            r#"{{"Columns": ["timestamp", "{column}"], "SamplingFrequency": 500, "RecordedEye": "left",
                "timestamp": {{"Units": "ms"}}, "{column}": {{"Units": "mm", "Description": "{description}"}}}}"#
        );
        let recording = bids(&[("x_physio.tsv", b"0\t1.85\n2\t1.85\n"), ("x_physio.json", sidecar.as_bytes())]);
        let recording = recording.expect("reads");
        let read_mm = recording.samples().next().expect("a sample").diameter_mm;
        assert!((read_mm - expected_mm).abs() < 1e-6, "{column}, {description}: {read_mm}");
        assert_eq!(!recording.warnings().is_empty(), doubted, "{column}, {description}: {:?}", recording.notes());
    }
}

#[test]
fn bids_rows_of_more_cells_than_columns_are_not_read() {
    // As pandas writes a table with its index.
    let rows: String = (0..50).map(|k| format!("{k}\t{}\t100\t1\t3.7\n", 2 * k)).collect();
    let error = bids(&[("x_physio.tsv", rows.as_bytes()), ("x_physio.json", SIDECAR.as_bytes())]).expect_err("refused");
    let error = error.to_string();
    assert!(
        error.contains("log_malformed 50") && error.contains("has a column no name (in a BIDS recording"),
        "{error}"
    );
}

#[test]
fn bids_times_that_fit_no_unit_by_the_stated_rate_are_told() {
    // Seconds at 1 kHz, with the rate of before a resampling, and of a clock of 10 kHz.
    for (step, told) in [("0.001", true), ("20", false)] {
        let step_of: f64 = step.parse().expect("a number");
        let rows: String = (0..50).map(|k| format!("{:.3}\t3.7\n", f64::from(k) * step_of)).collect();
        let sidecar = r#"{"Columns": ["timestamp", "pupil_size"], "SamplingFrequency": 500, "RecordedEye": "left", "pupil_size": {"Units": "mm"}}"#;
        let recording = bids(&[("x_physio.tsv", rows.as_bytes()), ("x_physio.json", sidecar.as_bytes())]);
        let recording = recording.expect("reads");
        let warned = recording.warnings().join("\n");
        assert_eq!(
            warned.contains("is that frequency right?") && warned.contains(step),
            told,
            "{:?}",
            recording.notes()
        );
    }
}

#[test]
fn bids_times_are_found_by_the_names_that_are_in_use_and_missed_ones_told() {
    // A pause of 5 s behind the third row.
    let table = "100\t3.5\n102\t3.6\n104\t3.7\n5106\t3.8\n";
    let of = |columns: &str, more: &str| {
        let sidecar = format!(
            r#"{{"Columns": [{columns}], "SamplingFrequency": 500, "RecordedEye": "left",
                "pupil_size": {{"Units": "mm", "Description": "Diameter"}}{more}}}"#
        );
        bids(&[("x_physio.tsv", table.as_bytes()), ("x_physio.json", sidecar.as_bytes())]).expect("reads")
    };
    for name in ["timestamp", "Timestamp", "timestamps", "TIME", "time"] {
        let recording = of(&format!("\"{name}\", \"pupil_size\""), &format!(r#", "{name}": {{"Units": "ms"}}"#));
        let times: Vec<_> = of_eye(&recording, Left).iter().map(|row| row.0 / MS).collect();
        assert_eq!(times, [100, 102, 104, 5106], "{name}");
        assert_eq!(recording.warnings(), [""; 0], "{name}");
    }
    for (name, unit, told) in [
        ("clock", "ms", true),
        ("frame_time", "", true),
        ("EyeTime", "ticks", true),
        ("x_coordinate", "pixel", false),
        ("trigger", "", false),
    ] {
        let unit = format!(r#", "{name}": {{"Units": "{unit}"}}"#);
        let recording = of(&format!("\"{name}\", \"pupil_size\""), &unit);
        let times: Vec<_> = of_eye(&recording, Left).iter().map(|row| row.0 / MS).collect();
        assert_eq!(times, [0, 2, 4, 6], "{name}");
        let words = format!("is `{name}` their time?");
        assert_eq!(recording.warnings().iter().any(|warning| warning.contains(&words)), told, "{name}");
        assert_eq!(recording.warnings().is_empty(), !told, "{name}: {:?}", recording.notes());
    }
    // The standard's own name comes first.
    let units = r#", "time": {"Units": "s"}, "timestamp": {"Units": "ms"}"#;
    let sidecar = format!(
        r#"{{"Columns": ["time", "timestamp", "pupil_size"], "SamplingFrequency": 500, "RecordedEye": "left",
            "pupil_size": {{"Units": "mm"}}{units}}}"#
    );
    let table = "0\t100\t3.5\n0\t102\t3.6\n";
    let recording = bids(&[("x_physio.tsv", table.as_bytes()), ("x_physio.json", sidecar.as_bytes())]).expect("reads");
    assert_eq!(recording.begins(), TimeNs(100 * MS));
}

/// Two recordings of one row, 3.5 mm and 3 mm, whose sidecars say `eyes` as JSON, or nothing of the eye.
fn bids_of_eyes(eyes: [Option<&str>; 2]) -> Recording {
    let [first, second] = eyes.map(|eye| {
        let eye = eye.map_or(String::new(), |eye| format!(r#""RecordedEye": {eye},"#));
        format!(
            r#"{{"Columns": ["timestamp", "pupil_diameter"], "SamplingFrequency": 500, {eye}
                "timestamp": {{"Units": "ms"}}, "pupil_diameter": {{"Units": "mm"}}}}"#
        )
    });
    bids(&[
        ("x_recording-eye1_physio.tsv", b"0\t3.5\n"),
        ("x_recording-eye1_physio.json", first.as_bytes()),
        ("x_recording-eye2_physio.tsv", b"0\t3.0\n"),
        ("x_recording-eye2_physio.json", second.as_bytes()),
    ])
    .expect("reads")
}

#[test]
fn bids_eyes_are_understood_as_people_write_them() {
    for (left, right) in
        [("L", "R"), ("l", "r"), ("Left", "Right Eye"), ("left eye", "right-eye"), ("LEFT_EYE", "rightEye")]
    {
        let recording = bids_of_eyes([Some(&format!("{left:?}")), Some(&format!("{right:?}"))]);
        assert_eq!(samples(&recording), [(0, Left, Some(3.5)), (0, Right, Some(3.0))], "{left}, {right}");
        assert_eq!(recording.warnings(), [""; 0], "{left}, {right}");
    }
    // Of both eyes together, as the standard has it: the other file adds nothing, and that is no fault.
    for both in ["cyclopean", "Both", "both eyes", "binocular"] {
        let recording = bids_of_eyes([Some(&format!("{both:?}")), Some("\"left\"")]);
        assert_eq!(samples(&recording), [(0, Both, Some(3.5))], "{both}");
        assert_eq!(recording.warnings(), [""; 0], "{both}");
        assert!(noted(&recording, "recording-eye2_physio.tsv was left out"), "{:?}", recording.notes());
    }
}

#[test]
fn a_bids_sidecar_that_does_not_say_which_eye_is_told_with_the_file_that_is_left_out_by_that() {
    let left_out = "x_recording-eye2_physio.tsv was left out";
    for (eyes, found) in [
        ([None, None], "eye1_physio.json: no `RecordedEye`"),
        ([Some("\"dominant\""), None], "eye1_physio.json: the `RecordedEye` \"dominant\""),
        ([Some("[\"left\"]"), Some("\"right\"")], "eye1_physio.json: the `RecordedEye` [\"left\"]"),
    ] {
        let recording = bids_of_eyes(eyes);
        assert_eq!(samples(&recording), [(0, Both, Some(3.5))], "{eyes:?}");
        assert!(warned(&recording, found) && warned(&recording, left_out), "{eyes:?}: {:?}", recording.notes());
    }
    let recording = bids_of_eyes([Some("\"left\""), None]);
    assert_eq!(samples(&recording), [(0, Left, Some(3.5))]);
    assert!(warned(&recording, left_out), "{:?}", recording.notes());
    // Where the columns say of which eye they are, nothing is missing.
    let sidecar = r#"{"Columns": ["timestamp", "pupil_left", "pupil_right"], "SamplingFrequency": 500,
        "timestamp": {"Units": "ms"}, "pupil_left": {"Units": "mm"}, "pupil_right": {"Units": "mm"}}"#;
    let recording = bids(&[("x_physio.tsv", b"0\t3.5\t3.6\n"), ("x_physio.json", sidecar.as_bytes())]);
    assert_eq!(recording.expect("reads").warnings(), [""; 0]);
}

#[test]
fn a_bids_eye_that_is_left_out_is_told() {
    let sidecar = |eye: &str, unit: &str| {
        format!(
            r#"{{"Columns": ["timestamp", "pupil_diameter"], "SamplingFrequency": 500, "RecordedEye": "{eye}",
                "timestamp": {{"Units": "ms"}}, "pupil_diameter": {{"Units": "{unit}"}}}}"#
        )
    };
    for (eye, unit, told) in [
        ("right", "pixels", "the right eye is left out: `pupil_diameter` is in camera pixels"),
        (
            "left",
            "mm",
            "recording-eye2_physio.tsv was left out: by its sidecar it is of an eye that was read already (left)",
        ),
        ("right", "mm", ""),
    ] {
        let [first, second] = [sidecar("left", "mm"), sidecar(eye, unit)];
        let recording = bids(&[
            ("x_recording-eye1_physio.tsv", b"0\t3.5\n2\t3.5\n"),
            ("x_recording-eye1_physio.json", first.as_bytes()),
            ("x_recording-eye2_physio.tsv", b"0\t3.5\n2\t3.5\n"),
            ("x_recording-eye2_physio.json", second.as_bytes()),
        ]);
        let recording = recording.expect("reads");
        let warned = recording.warnings().join("\n");
        assert!(warned.contains(told) && warned.is_empty() == told.is_empty(), "{warned}");
        assert_eq!(recording.len(), if told.is_empty() { 4 } else { 2 });
    }
}

#[test]
fn bids_sidecars_are_inherited_and_the_nearer_wins() {
    let table = format!("{STEM}.tsv");
    let recording = bids(&[
        (&table, TABLE.as_bytes()),
        ("dataset_description.json", b"{}"),
        ("task-search_recording-eye1_physio.json", SIDECAR.as_bytes()),
        ("task-other_recording-eye1_physio.json", b"not even JSON"),
        ("sub-01/sub-01_recording-eye1_physio.json", br#"{"RecordedEye": "left"}"#),
    ]);
    assert_eq!(of_eye(&recording.expect("reads"), Left).len(), 4);

    let message = bids(&[(&table, TABLE.as_bytes())]).expect_err("refused").to_string();
    assert!(message.contains(&format!("{STEM}.json")) && message.contains("Columns"), "{message}");
    let message = bids(&[(&table, TABLE.as_bytes()), (&format!("{STEM}.json"), b"{\n\"Columns\": [")])
        .expect_err("refused")
        .to_string();
    assert!(message.contains("line 2"), "{message}");
    let gaze = SIDECAR.replace(", \"pupil_size\"]", "]");
    let message = bids(&[(&table, TABLE.as_bytes()), (&format!("{STEM}.json"), gaze.as_bytes())])
        .expect_err("refused")
        .to_string();
    assert!(message.contains("no pupils"), "{message}");
}

#[test]
fn bids_reads_the_other_eye_and_the_blinks_of_both() {
    let left = SIDECAR.replace("\"right\"", "\"left\"");
    let eye2 = STEM.replace("eye1", "eye2");
    let eye3 = STEM.replace("eye1", "eye3");
    let events = r#"{"Columns": ["onset", "duration", "trial_type", "blink", "message"], "OnsetSource": "timestamp"}"#;
    let called = "7186700\tn/a\tn/a\tn/a\t\"RECCFG\"\n7186800\t2\tblink\tn/a\tn/a\n7186799\t3\tsaccade\t1\tn/a\n";
    let shut = "7186799\t2\tsaccade\t1\tn/a\n7186900\t2\tsaccade\t0\tn/a\n";
    let recording = bids(&[
        (&format!("{STEM}.tsv.gz"), &gzip(TABLE)),
        (&format!("{STEM}.json"), SIDECAR.as_bytes()),
        (&format!("{STEM}events.tsv.gz"), &gzip(called)),
        (&format!("{STEM}events.json"), events.as_bytes()),
        (&format!("{eye2}.tsv.gz"), &gzip(TABLE.replace("4612", "4000"))),
        (&format!("{eye2}.json"), left.as_bytes()),
        (&format!("{eye2}events.tsv.gz"), &gzip(shut)),
        (&format!("{eye2}events.json"), events.as_bytes()),
        (&format!("{eye3}.tsv.gz"), &gzip(TABLE)),
        (&format!("{eye3}.json"), SIDECAR.replace("\"right\"", "\"cyclopean\"").as_bytes()),
    ])
    .expect("reads");
    let at = |ms: i64| TimeNs((7_186_799 + ms) * MS);
    assert_eq!(of_eye(&recording, Right)[0], (at(0).0, Some(4612.0)));
    assert_eq!(of_eye(&recording, Left)[0], (at(0).0, Some(4000.0)));
    assert_eq!(recording.len(), 8);
    let blink = |eye, begins, ends| Blink { eye, begins: at(begins), ends: at(ends) };
    assert_eq!(recording.blinks(), [blink(Left, 0, 2), blink(Right, 1, 3)]);
    assert!(noted(&recording, "eye2_physio.tsv.gz was read too"), "{:?}", recording.notes());

    // Onsets that are rows.
    let rows = r#"{"Columns": ["onset", "duration", "trial_type"], "OnsetSource": "n/a"}"#;
    let sidecar = r#"{"Columns": ["pupil_size"], "SamplingFrequency": 500, "StartTime": 10, "RecordedEye": "left"}"#;
    let recording = bids(&[
        ("x_physio.tsv", b"1\n2\n3\n"),
        ("x_physio.json", sidecar.as_bytes()),
        ("x_physioevents.tsv", b"1\t0.004\tBlink\n"),
        ("x_physioevents.json", rows.as_bytes()),
    ])
    .expect("reads");
    assert_eq!(recording.blinks(), [Blink { eye: Left, begins: TimeNs(10_002 * MS), ends: TimeNs(10_006 * MS) }]);
}

// The Lab Streaming Layer.

fn chunk(tag: u16, content: &[u8]) -> Vec<u8> {
    let length = content.len() as u64 + 2;
    let head = match u8::try_from(length) {
        Ok(length) => vec![1, length],
        Err(_) if length < 70_000 => [&[4][..], &(length as u32).to_le_bytes()].concat(),
        Err(_) => [&[8][..], &length.to_le_bytes()].concat(),
    };
    [&head, &tag.to_le_bytes()[..], content].concat()
}

fn stream_header(id: u32, name: &str, kind: &str, rate_hz: f64, format: &str, channels: &[[&str; 4]]) -> Vec<u8> {
    let mut xml = format!(
        "<?xml version=\"1.0\"?><info><name>{name}</name><type>{kind}</type><channel_count>{}</channel_count>\
         <nominal_srate>{rate_hz}</nominal_srate><channel_format>{format}</channel_format><desc><channels>",
        channels.len()
    );
    for [label, eye, kind, unit] in channels {
        write!(xml, "<channel><label>{label}</label><eye>{eye}</eye><type>{kind}</type><unit>{unit}</unit></channel>")
            .expect("a String takes all");
    }
    xml.push_str("</channels></desc></info>");
    chunk(2, &[&id.to_le_bytes()[..], xml.as_bytes()].concat())
}

/// Samples of doubles; those without a time have theirs left out.
fn doubles(id: u32, rows: &[(Option<f64>, &[f64])]) -> Vec<u8> {
    let mut content = [&id.to_le_bytes()[..], &[4], &(rows.len() as u32).to_le_bytes()].concat();
    for (t_s, figures) in rows {
        match t_s {
            None => content.push(0),
            Some(t_s) => content.extend([8].into_iter().chain(t_s.to_le_bytes())),
        }
        content.extend(figures.iter().flat_map(|figure| figure.to_le_bytes()));
    }
    chunk(3, &content)
}

fn offset(id: u32, at_s: f64, offset_s: f64) -> Vec<u8> {
    chunk(4, &[&id.to_le_bytes()[..], &at_s.to_le_bytes(), &offset_s.to_le_bytes()].concat())
}

const BOUNDARY: [u8; 16] =
    [0x43, 0xA5, 0x46, 0xDC, 0xCB, 0xF5, 0x41, 0x0F, 0xB3, 0x0E, 0xD5, 0x46, 0x73, 0x83, 0xCB, 0xE4];

fn xdf(chunks: &[Vec<u8>]) -> Vec<u8> {
    let header = chunk(1, b"<?xml version=\"1.0\"?><info><version>1.0</version></info>");
    [b"XDF:".to_vec(), header, chunks.concat()].concat()
}

const RELAY: [[&str; 4]; 7] = [
    ["confidence", "both", "Confidence", "normalized"],
    ["norm_pos_x", "both", "ScreenX", "normalized"],
    ["norm_pos_y", "both", "ScreenY", "normalized"],
    ["diameter0_2d", "right", "Diameter", "pixels"],
    ["diameter1_2d", "left", "Diameter", "pixels"],
    ["diameter0_3d", "right", "Diameter", "mm"],
    ["diameter1_3d", "left", "Diameter", "mm"],
];

fn relay() -> Vec<Vec<u8>> {
    let nan = f64::NAN;
    let right = |t, mm, confidence| (Some(t), [confidence, 0.5, 0.5, 40.0, nan, mm, nan]);
    let left = |t, mm, confidence| (Some(t), [confidence, 0.5, 0.5, nan, 41.0, nan, mm]);
    let rows = [right(10.0, 3.5, 0.9), left(10.004, 3.25, 0.8), right(10.008, 3.5, 0.0), left(10.012, nan, 0.8)];
    let rows: Vec<(Option<f64>, &[f64])> = rows.iter().map(|(t_s, row)| (*t_s, &row[..])).collect();
    vec![
        stream_header(1, "pupil_capture", "Gaze", 0.0, "double64", &RELAY),
        stream_header(2, "pupil_capture_pupillometry_only", "Gaze", 0.0, "double64", &RELAY),
        stream_header(3, "Markers", "Markers", 0.0, "string", &[["", "", "", ""]]),
        chunk(3, &[&3_u32.to_le_bytes()[..], &[1, 1, 0, 1, 5], b"hello"].concat()),
        doubles(2, &rows),
        doubles(1, &[(Some(10.0), &[1.0, 0.0, 0.0, 1.0, 1.0, 9.0, 9.0])]),
        chunk(5, &BOUNDARY),
        chunk(6, &[&2_u32.to_le_bytes()[..], b"<info><sample_count>4</sample_count></info>"].concat()),
    ]
}

#[test]
fn xdf_of_pupil_capture_reads_each_eye_in_its_turn() {
    let recording = read(xdf(&relay()));
    assert_eq!((recording.format(), recording.unit()), (LogFormat::Xdf, SizeUnit::Millimetres));
    let s = |t_ms: i64| (10_000 + t_ms) * MS;
    assert_eq!(samples(&recording), [(s(0), Right, Some(3.5)), (s(4), Left, Some(3.25)), (s(8), Right, Some(3.5))]);
    assert_eq!(recording.samples().map(|s| s.confidence).collect::<Vec<_>>(), [0.9, 0.8, 0.0]);
    assert!(noted(&recording, "`pupil_capture_pupillometry_only` of type `Gaze`: right, left"));
    assert!(
        noted(&recording, "other streams: `pupil_capture` of type `Gaze`, `Markers` of type `Markers`"),
        "{:?}",
        recording.notes()
    );
    assert_eq!(samples(&read(gzip(xdf(&relay())))), samples(&recording));
    // The stream of gaze repeats those pupils.
    assert_eq!(recording.warnings(), [""; 0]);
}

#[test]
fn xdf_takes_the_stream_of_most_samples_and_tells_which_it_leaves_out() {
    let tracker = |id: u32, unit: &str, count: u32, size: f64| {
        let pupils = [["left_pupil_diameter", "", "", unit], ["right_pupil_diameter", "", "", unit]];
        let figures = [size, size];
        let rows: Vec<_> = (0..count).map(|k| (Some(1.0 + 0.01 * f64::from(k)), &figures[..])).collect();
        let header = stream_header(id, "Tobii", "Gaze", 100.0, "double64", &pupils);
        if count == 0 { header } else { [header, doubles(id, &rows)].concat() }
    };
    for (units, counts, expected, told) in [
        (["mm", "mm"], [0, 50], (50, 4.0), ""),
        (["mm", "mm"], [50, 0], (50, 3.0), ""),
        (["mm", "mm"], [20, 50], (50, 4.0), "with pupils in 20 samples"),
        (["mm", "mm"], [50, 20], (50, 3.0), "with pupils in 20 samples"),
        (["mm", "mm"], [50, 50], (50, 3.0), "with pupils in 50 samples"),
        (["mm", "px"], [0, 50], (50, 4.0), ""),
        (["px", "mm"], [50, 20], (20, 4.0), "with pupils in 50 samples"),
    ] {
        let recording = read(xdf(&[tracker(1, units[0], counts[0], 3.0), tracker(2, units[1], counts[1], 4.0)]));
        let left = of_eye(&recording, Left);
        assert_eq!((left.len(), left[0].1), (expected.0, Some(expected.1)), "{units:?}, {counts:?}");
        assert_eq!(recording.warnings().len(), usize::from(!told.is_empty()), "{:?}", recording.notes());
        assert!(recording.warnings().iter().all(|warning| warning.contains(told)), "{:?}", recording.notes());
    }
    let dir = TempDir::new().expect("a folder");
    let empty = written(&dir, "log", xdf(&[tracker(1, "mm", 0, 3.0), tracker(2, "px", 0, 4.0)]));
    let message = Recording::read(&empty).expect_err("no sample").to_string();
    assert!(message.contains("no sample in the streams that have pupils (`Tobii` of type `Gaze`"), "{message}");
}

#[test]
fn xdf_pupils_that_their_tracker_calls_invalid_are_lost() {
    let of = |labels: [&str; 2], values: [f64; 3]| {
        let channels = [[labels[0], "", "", "mm"], [labels[1], "", "", "mm"], ["left_pupil_validity", "", "", ""]];
        let figures = values.map(|value| [3.5, 3.0, value]);
        let rows: Vec<_> = (0..3_u8).map(|k| (Some(f64::from(k)), &figures[usize::from(k)][..])).collect();
        read(xdf(&[stream_header(7, "Tobii", "Gaze", 0.0, "double64", &channels), doubles(7, &rows)]))
    };
    let names = ["left_pupil_diameter", "right_pupil_diameter"];
    let valid =
        |recording: &Recording, eye| -> Vec<_> { of_eye(recording, eye).iter().map(|row| row.1.is_some()).collect() };
    for (lost, values) in [(1, [1.0, 0.0, 1.0]), (2, [1.0, 1.0, f64::NAN])] {
        let recording = of(names, values);
        assert_eq!(valid(&recording, Left), [0, 1, 2].map(|row| row != lost));
        assert_eq!((valid(&recording, Right), recording.warnings()), (vec![true; 3], &[][..]));
    }
    // Codes of which 0 says that the eye was found; a channel that nobody fills in.
    for (values, told) in [
        ([0.0, 4.0, 0.0], "`left_pupil_validity` of `Tobii` of type `Gaze` is not used: it holds 4"),
        ([1.0, 0.5, 0.0], "it holds 0.5"),
        ([0.0, 0.0, 0.0], "it is 0 throughout"),
    ] {
        let recording = of(names, values);
        assert_eq!(valid(&recording, Left), [true; 3], "{values:?}");
        assert!(warned(&recording, told), "{:?}", recording.notes());
    }
}

#[test]
fn xdf_apertures_of_the_lids_are_read_where_they_have_a_unit_of_length() {
    for (label, unit, figure, expected) in [
        ("EyelidApertureLeft", "mm", 9.0, Some(9.0)),
        ("eyelid aperture left", "cm", 0.75, Some(7.5)),
        ("EyelidApertureLeft", "mm", f64::NAN, None),
        ("EyelidApertureLeft", "", 9.0, None),
        ("EyelidApertureLeft", "px", 9.0, None),
        ("EyelidApertureRight", "mm", 9.0, None),
    ] {
        let channels = [["PupilDiameterLeft", "", "", "mm"], [label, "", "", unit]];
        let rows = [(Some(1.0), &[3.5, figure][..])];
        let recording = read(xdf(&[stream_header(7, "Neon", "Gaze", 0.0, "double64", &channels), doubles(7, &rows)]));
        let apertures: Vec<_> = recording.samples().map(|sample| sample.aperture_mm).collect();
        assert_eq!(apertures, [expected], "{label}, {unit}, {figure}");
    }
}

#[test]
fn xdf_samples_of_a_stated_rate_whose_stamps_jitter_back_are_kept_in_their_order() {
    // Chunks of 20 samples at 1 kHz, of which each second one is stamped too early by `early_s`.
    let of = |rate_hz: f64, early_s: f64| {
        let mut chunks =
            vec![stream_header(7, "EyeLink", "Gaze", rate_hz, "double64", &[["left_pupil_diameter", "", "", "mm"]])];
        for chunk in 0..100_u32 {
            let figures: Vec<_> = (0..20).map(|k| [3.0 + 1e-4 * f64::from(20 * chunk + k)]).collect();
            let first_s = 100.0 + 0.02 * f64::from(chunk) - if chunk % 2 == 1 { early_s } else { 0.0 };
            let stamp = |k: usize| Some(first_s + 1e-3 * k as f64);
            let rows: Vec<_> = figures.iter().enumerate().map(|(k, figure)| (stamp(k), &figure[..])).collect();
            chunks.push(doubles(7, &rows));
        }
        read(xdf(&chunks))
    };
    let recording = of(1000.0, 0.0053);
    assert_eq!((recording.len(), recording.faults().total()), (2000, 0), "{:?}", recording.notes());
    let left = of_eye(&recording, Left);
    assert!(left.windows(2).all(|pair| pair[0].0 < pair[1].0 && pair[0].1 < pair[1].1));
    // The latest is 4.3 ms ahead; each is put 0.1 ms behind the one before it until its own stamp is later: five of 50.
    assert!(
        recording.remarks().iter().any(|note| note.contains("250 samples of `EyeLink`")),
        "{:?}",
        recording.notes()
    );
    assert_eq!(recording.warnings(), [""; 0]);
    let in_order = of(1000.0, 0.0);
    assert!(!noted(&in_order, "0.1 ms"), "{:?}", in_order.notes());
    // Without a rate they are dropped and told.
    let recording = of(0.0, 0.0053);
    assert_eq!(recording.faults().of(LogFault::Backwards), 250);
    assert!(warned(&recording, "250 of 2000 samples are left out"), "{:?}", recording.notes());
    // No machine is busy for that long: nothing is squeezed in behind a stamp that is wrong.
    let recording = of(1000.0, 0.2);
    assert!(!noted(&recording, "0.1 ms") && warned(&recording, "are left out"), "{:?}", recording.notes());
    // A clock that falls by a second and more has begun anew.
    let recording = of(1000.0, 2.0);
    assert!(warned(&recording, "begins anew"), "{:?}", recording.notes());
}

#[test]
fn xdf_figures_are_what_unit_and_label_say() {
    let area = std::f64::consts::PI * 1.5 * 1.5;
    let cases = [
        (["LeftPupilSize", "left", "PupilSize", "mm^2"], area, SizeUnit::Millimetres, ""),
        (["LeftPupilSize", "left", "PupilSize", "mm\u{b2}"], area, SizeUnit::Millimetres, ""),
        (["LeftPupilArea", "left", "PupilArea", "mm^2"], area, SizeUnit::Millimetres, ""),
        (["LeftPupilSize", "left", "PupilSize", "px^2"], area, SizeUnit::Pixels, ""),
        (["LeftPupilSize", "left", "PupilSize", "mm"], 3.0, SizeUnit::Millimetres, ""),
        (["LeftPupilSize", "left", "PupilSize", "cm"], 0.3, SizeUnit::Millimetres, ""),
        (["LeftPupilSize", "left", "PupilSize", "\u{b5}m"], 3000.0, SizeUnit::Millimetres, ""),
        (["LeftPupilRadius", "left", "PupilRadius", "mm"], 1.5, SizeUnit::Millimetres, ""),
        (
            ["LeftPupilSize", "left", "PupilSize", ""],
            3.0,
            SizeUnit::Arbitrary,
            "the channel `LeftPupilSize` of `tracker` of type `Gaze` is taken for diameters, though neither",
        ),
        (["LeftPupilSize", "left", "PupilSize", "px"], 3.0, SizeUnit::Pixels, "is taken for diameters, though neither"),
        (["LeftPupilDiameter", "left", "Diameter", "a.u."], 3.0, SizeUnit::Arbitrary, ""),
        (
            ["LeftPupilArea", "left", "PupilArea", "mm"],
            area,
            SizeUnit::Millimetres,
            "is taken for areas, though its name",
        ),
    ];
    for (channel, figure, unit, told) in cases {
        let rows = [(Some(1.0), &[figure][..]), (Some(1.01), &[figure][..])];
        let recording =
            read(xdf(&[stream_header(7, "tracker", "Gaze", 0.0, "double64", &[channel]), doubles(7, &rows)]));
        let read_as = recording.samples().next().expect("a sample").diameter_mm;
        assert!((read_as - 3.0).abs() < 1e-5, "{channel:?}: {read_as}");
        assert_eq!(recording.unit(), unit, "{channel:?}");
        let warned = recording.warnings().join("\n");
        assert!(warned.contains(told) && warned.is_empty() == told.is_empty(), "{channel:?}: {warned}");
    }
    // A length in units of area is neither.
    let channels =
        [["LeftPupilDiameter", "left", "Diameter", "mm^2"], ["RightPupilDiameter", "right", "Diameter", "mm"]];
    let rows = [(Some(1.0), &[area, 3.0][..])];
    let recording = read(xdf(&[stream_header(7, "tracker", "Gaze", 0.0, "double64", &channels), doubles(7, &rows)]));
    assert_eq!(samples(&recording), [(1000 * MS, Right, Some(3.0))]);
    assert!(recording.warnings()[0].contains("`LeftPupilDiameter`"), "{:?}", recording.notes());
}

#[test]
fn xdf_eyes_are_told_by_a_labels_last_letter_and_twins_without_one_are_told() {
    let rows = [(Some(1.0), &[3.0, 3.5][..])];
    let of = |labels: [&str; 2]| {
        let channels = labels.map(|label| [label, "", "Diameter", "mm"]);
        read(xdf(&[stream_header(7, "tracker", "Gaze", 0.0, "double64", &channels), doubles(7, &rows)]))
    };
    let recording = of(["PupilDiameterL", "PupilDiameterR"]);
    assert_eq!(samples(&recording), [(1000 * MS, Left, Some(3.0)), (1000 * MS, Right, Some(3.5))]);
    let recording = of(["Pupil diameter one", "Pupil diameter other"]);
    assert_eq!(samples(&recording), [(1000 * MS, Both, Some(3.0))]);
    let told = "the channel `Pupil diameter other` of `tracker` of type `Gaze` was left out";
    assert!(recording.warnings()[0].contains(told), "{:?}", recording.notes());
}

#[test]
fn xdf_confidence_in_per_cent_is_divided_where_it_says_so_and_refused_where_it_does_not() {
    for (unit, figure, expected) in [
        ("percent", 20.0, Some(0.2)),
        ("%", 100.0, Some(1.0)),
        ("", 0.25, Some(0.25)),
        ("", 20.0, None),
        ("%", 130.0, None),
    ] {
        let channels =
            [["LeftPupilDiameter", "left", "Diameter", "mm"], ["LeftConfidence", "left", "Confidence", unit]];
        let rows = [(Some(1.0), &[3.0, 0.0][..]), (Some(1.01), &[3.0, figure][..])];
        let recording =
            read(xdf(&[stream_header(7, "tracker", "Gaze", 0.0, "double64", &channels), doubles(7, &rows)]));
        let second = recording.samples().nth(1).expect("a sample");
        assert_eq!(second.valid.then_some(second.confidence), expected, "{figure} {unit}");
        assert_eq!(recording.faults().of(LogFault::BadConfidence), u64::from(expected.is_none()));
    }
}

#[test]
fn xdf_times_are_completed_and_put_on_the_recorders_clock() {
    // Radii and areas of floats at 100 Hz, the left lost in the second sample; one late packet among the offsets.
    let channels = [
        ["pupilWidth", "right", "DiameterX", "m"],
        ["L pupil", "", "Radius", "meters"],
        ["right_pupil_area", "right", "Area", "px"],
        ["R pupil", "right", "Radius", "meters"],
    ];
    let row = |left: f32, right: f32| {
        [9.0, left, 1.0, right].iter().flat_map(|figure| figure.to_le_bytes()).collect::<Vec<_>>()
    };
    let mut content = [&7_u32.to_le_bytes()[..], &[1, 3, 8], &100.0_f64.to_le_bytes()].concat();
    content.extend([row(0.0015, 0.002), vec![0], row(f32::NAN, 0.002), vec![0], row(0.0016, -1.0)].concat());
    let mut chunks = vec![stream_header(7, "tracker", "Eye", 100.0, "float32", &channels)];
    for k in 0..20 {
        let at_s = 50.0 + 5.0 * f64::from(k);
        chunks.push(offset(7, at_s, 1000.0 + 1e-4 * (at_s - 100.0) + if k == 5 { 0.5 } else { 0.0 }));
    }
    chunks.push(chunk(3, &content));
    let recording = read(xdf(&chunks));
    assert_eq!(recording.stated_rate_hz(), Some(100.0));
    let expected = [
        (0, Left, Some(3.0)),
        (0, Right, Some(4.0)),
        (10, Left, None),
        (10, Right, Some(4.0)),
        (20, Left, Some(3.2)),
        (20, Right, None),
    ];
    for (sample, expected) in samples(&recording).iter().zip(expected) {
        let t_ns = 1_100_000 * MS + expected.0 * MS;
        assert!((sample.0 - t_ns).abs() < 10_000, "{} us off", (sample.0 - t_ns) / 1000);
        assert_eq!((sample.1, sample.2.map(|mm| (mm * 1e4).round() / 1e4)), (expected.1, expected.2));
    }
    assert_eq!(recording.len(), 6);
}

/// 200 s of 10 Hz: a tracker whose clock says `clock_s` at each second of the recorder's, which begins at 10,000; offsets
/// every 5 s but those that `left_out` says, each of them late by what `late_s` says.
fn xdf_of_a_clock(
    clock_s: impl Fn(f64) -> f64,
    left_out: impl Fn(f64) -> bool,
    late_s: impl Fn(f64) -> f64,
) -> Recording {
    let mut chunks = vec![stream_header(7, "tracker", "Eye", 10.0, "double64", &[["pupil", "left", "Diameter", "mm"]])];
    for k in 0..40 {
        let since_s = 2.0 + 5.0 * f64::from(k);
        if !left_out(since_s) {
            // As LabRecorder does: the time is the recorder's less the offset.
            let offset_s = 10_000.0 + since_s - clock_s(since_s) + late_s(since_s);
            chunks.push(offset(7, 10_000.0 + since_s - offset_s, offset_s));
        }
    }
    for k in 0..2000 {
        let since_s = 0.1 * f64::from(k);
        chunks.push(doubles(7, &[(Some(clock_s(since_s)), &[3.0 + 0.0001 * f64::from(k)])]));
    }
    read(xdf(&chunks))
}

/// The greatest error of the times of [`xdf_of_a_clock`], of those samples that were read, seconds.
fn worst_time_s(recording: &Recording) -> f64 {
    let error_s = |sample: (i64, Option<f32>)| {
        let k = ((f64::from(sample.1.expect("seen")) - 3.0) * 1e4).round();
        (sample.0 as f64 * 1e-9 - 10_000.0 - 0.1 * k).abs()
    };
    worst(of_eye(recording, Left).into_iter().map(error_s))
}

#[test]
fn xdf_goes_on_where_the_clock_of_a_tracker_is_set() {
    let part = |since_s: f64, ends_s: &[f64], begins_s: &[f64]| {
        let part = ends_s.iter().filter(|end_s| since_s >= **end_s).count();
        begins_s[part] + since_s * (1.0 + 2e-5)
    };
    // Started again; again while its times are the same once more; set forward; back by a little; three times.
    let cases: [(&[f64], &[f64]); 5] = [
        (&[93.0], &[5000.0, -90.0]),
        (&[93.0], &[30.0, -70.0]),
        (&[93.0], &[30.0, 730.0]),
        (&[93.0], &[5000.0, 4997.0]),
        (&[53.0, 104.0, 158.0], &[5000.0, -50.0, 700.0, -150.0]),
    ];
    for (ends_s, begins_s) in cases {
        let clock_s = |since_s| part(since_s, ends_s, begins_s);
        let recording = xdf_of_a_clock(clock_s, |_| false, |_| 0.0);
        assert_eq!((recording.len(), recording.faults().total()), (2000, 0), "{begins_s:?}: {:?}", recording.notes());
        assert!(worst_time_s(&recording) < 1e-3, "{begins_s:?}: {}", worst_time_s(&recording));
        let times = if ends_s.len() == 1 { "once".to_owned() } else { format!("{} times", ends_s.len()) };
        assert!(noted(&recording, &format!("started again {times} in")), "{:?}", recording.notes());
        // The judge sees that the offsets of a part are not there.
        let blind = xdf_of_a_clock(clock_s, |since_s| since_s > ends_s[0], |_| 0.0);
        assert!(worst_time_s(&blind) > 0.5, "{begins_s:?}: {}", worst_time_s(&blind));
    }
    // A clock that nobody set, with packets that were late, the first one and the last one too.
    let late_s = |since_s: f64| match since_s as u32 {
        2 | 52 | 122 | 197 => 0.7,
        127 => -0.7,
        _ => 0.0,
    };
    let steady = xdf_of_a_clock(|since_s| part(since_s, &[], &[30.0]), |_| false, late_s);
    assert!(worst_time_s(&steady) < 1e-3, "{}", worst_time_s(&steady));
    assert!(!noted(&steady, "started again"), "{:?}", steady.notes());
}

#[test]
fn xdf_that_is_damaged_reads_on_behind_the_next_boundary() {
    let chunks = relay();
    let mut damaged = chunks[..4].to_vec();
    damaged.push(vec![3, 0, 0, 0, 9, 9]);
    damaged.push(chunk(5, &BOUNDARY));
    // A chunk that says more samples than it holds.
    damaged.push(chunk(3, &[&2_u32.to_le_bytes()[..], &[1, 200, 8, 0, 0]].concat()));
    damaged.push(chunks[4].clone());
    let whole = xdf(&damaged);
    let recording = read(&whole);
    assert_eq!(recording.len(), 3);
    assert_eq!(recording.faults().of(LogFault::Wire(WireFault::OutOfStep)), 1);
    assert_eq!(recording.faults().of(LogFault::Wire(WireFault::TooShort)), 1);
    // Cut off within the last sample.
    let recording = read(&whole[..whole.len() - 70]);
    assert_eq!(recording.len(), 2);
    assert_eq!(recording.faults().of(LogFault::Wire(WireFault::TooShort)), 2);

    let refused = |content: Vec<u8>| {
        let dir = TempDir::new().expect("a folder");
        Recording::read(&written(&dir, "log", content)).expect_err("refused").to_string()
    };
    let message = refused(xdf(&chunks[2..4]));
    assert!(message.contains("no pupil among 1 streams (`Markers`"), "{message}");
    assert!(refused(xdf(&[])).contains("no pupil among 0 streams"));
    // Nesting as deep as a header may be.
    let deep = [&9_u32.to_le_bytes()[..], "<a>".repeat(1 << 19).as_bytes()].concat();
    assert!(refused(xdf(&[chunk(2, &deep)])).contains("no pupil"));
}

// All of them.

#[test]
fn a_line_without_end_is_read_past() {
    let long = "x".repeat(3 << 20);
    let recording =
        read(tobii("Recording timestamp [ms]", 1.0, "").replacen("0\t0\t\tP1", &format!("{long}\t0\t\tP1"), 1));
    assert_eq!(recording.faults().of(LogFault::TooLong), 1);
    assert_eq!(of_eye(&recording, Left).len(), 50);
}

/// Whatever is done to a log, or to the files beside it, it is read or refused.
fn survives(content: &[u8], sidecar: &str, times: Option<&[u8]>) {
    let dir = TempDir::new().expect("a folder");
    let path = written(&dir, "x_recording-eye1_physio.tsv", content);
    written(&dir, "x_recording-eye1_physio.json", sidecar);
    if let Some(times) = times {
        written(&dir, "x_recording-eye1_physio.time", times);
    }
    if let Ok(recording) = Recording::read(Path::new(&path)) {
        assert!(!recording.is_empty());
        let info = LogInfo::of(&recording, None);
        assert_eq!(info.eyes.iter().map(|eye| eye.samples).sum::<u64>(), recording.len() as u64);
        assert!(recording.samples().is_sorted_by_key(|sample| sample.t_sample));
        for sample in recording.samples().filter(|sample| sample.valid) {
            assert!(sample.diameter_mm.is_finite() && sample.diameter_mm >= 0.0, "{sample:?}");
            assert!((0.0..=1.0).contains(&sample.confidence), "{sample:?}");
        }
    }
}

/// A short log of each format.
static EXAMPLES: LazyLock<Vec<Vec<u8>>> = LazyLock::new(|| {
    let mut examples = crate::logs::examples();
    examples.extend([
        tobii("Recording timestamp", 1.0, "").into_bytes(),
        utf16(&tobii("Recording timestamp [ms]", 1.0, "")),
        gazepoint(true).into_bytes(),
        format!("{PUPILEXT}\n{}", "x,10,PuRe,40,41,4.5,40,41,0.9,1,2,3,130,0.9,0.8\n".repeat(9)).into_bytes(),
        TABLE.into(),
        gzip(TABLE),
        xdf(&relay()),
        b"t_ns,eye,diameter_mm,confidence,aperture_mm,valid\n1,left,3.5,1,,1\n2,left,,0,7.5,0\n".to_vec(),
    ]);
    examples
});

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, cases: 800, ..ProptestConfig::default() })]

    #[test]
    fn a_mutated_log_of_any_format_is_read_or_refused(
        which in any::<proptest::sample::Index>(),
        edits in proptest::collection::vec((any::<proptest::sample::Index>(), any::<u8>(), 0..7_u8), 0..12),
        cut in any::<proptest::sample::Index>(),
        cuts in proptest::bool::weighted(0.3),
        timed in any::<bool>(),
    ) {
        let mut content = which.get(&EXAMPLES).clone();
        for (index, byte, kind) in &edits {
            let (at, many) = (index.index(content.len()), usize::from(*byte));
            match kind {
                0 => content[at] = *byte,
                1 => content.insert(at, *byte),
                2 => content[at] ^= 1 << (byte % 8),
                3 => drop(content.drain(at..(at + many).min(content.len() - 1).max(at))),
                4 => drop(content.splice(at..at, *b"9999999999999999999")),
                5 => drop(content.splice(at..at, *b"-1e309\t.\t;,;\n\0nan")),
                _ => drop(content.splice(at..at, b"\n".repeat(many % 4))),
            }
        }
        if cuts {
            content.truncate(cut.index(content.len()));
        }
        survives(&content, SIDECAR, timed.then(|| &content[..content.len() / 80 * 8]));
    }

    #[test]
    fn a_mutated_sidecar_is_used_or_refused(at in any::<proptest::sample::Index>(), byte in any::<u8>()) {
        let mut sidecar = SIDECAR.as_bytes().to_vec();
        let at = at.index(sidecar.len());
        sidecar[at] = byte;
        survives(TABLE.as_bytes(), &String::from_utf8_lossy(&sidecar), None);
    }
}
