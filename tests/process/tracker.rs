//! The daemon on a tracker's pseudo-terminal, in real time.

use std::fs;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use holod_calibration::TimeNs;
use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_pupil_input::{
    GateSettings, MOCK_SEED, MockSource, PupilSample, Recording, STATED_LAG, SampleEye, Scenario, host_now,
};
use holod_tests::daemon::{Daemon, run, wait_until};
use holod_tests::frames::{self, FieldRow};
use holod_tests::tracker::{PtyTracker, TimedLine};
use holod_tests::{FIELD_ORDER, small_rig};
use rustix::process::Signal;

use crate::HOLOD;

/// Lines of the line protocol, as a bridge between a tracker and holod sends them: no lid apertures, full confidence.
fn lines(samples: &[PupilSample]) -> Vec<TimedLine> {
    let first = samples[0].t_sample;
    samples
        .iter()
        .enumerate()
        .map(|(index, sample)| {
            let since = sample.t_sample - first;
            let line = LineSample {
                sequence: index as u64,
                device_us: since.0 / 1000,
                eye: sample.eye,
                diameter_mm: sample.diameter_mm,
                confidence: 1.0,
            };
            let mut text = String::new();
            encode_line(&line, &mut text);
            TimedLine { due: Duration::from_nanos(since.0 as u64), bytes: text.into_bytes() }
        })
        .collect()
}

struct Bench {
    folder: tempfile::TempDir,
    rig: PathBuf,
    link: PathBuf,
    record: PathBuf,
}

impl Bench {
    fn new() -> Self {
        let folder = holod_tests::new_folder();
        let path = |name: &str| folder.path().join(name);
        let (rig, link, record) = (path("rig.toml"), path("ttyTracker"), path("record"));
        fs::write(&rig, small_rig(64, 64, "driver = \"simulated\"")).unwrap();
        Self { folder, rig, link, record }
    }

    fn start(&self, more: &[&str]) -> Daemon {
        let (rig, link, record) = (text(&self.rig), text(&self.link), text(&self.record));
        let mut args = vec!["--config", rig, "--tracker", link, "--resolution", "64x64", "--record", record];
        args.extend_from_slice(more);
        let daemon = Daemon::start(HOLOD, &args, self.folder.path());
        let csv = self.record.join("frames.csv");
        let began =
            wait_until(Duration::from_secs(30), || fs::read_to_string(&csv).is_ok_and(|t| t.lines().count() > 30));
        assert!(began, "the loop runs before the tracker speaks");
        daemon
    }

    fn stop(&self, daemon: Daemon) -> (Vec<FieldRow>, serde_json::Value) {
        daemon.signal(Signal::TERM);
        let ended = daemon.wait(Duration::from_secs(20));
        assert!(ended.status.success(), "{}", ended.stderr);
        let rows = frames::read(&self.record.join("frames.csv")).unwrap();
        let summary = fs::read_to_string(self.record.join("summary.json")).unwrap();
        (rows, serde_json::from_str(&summary).unwrap())
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Judges what every run must show, and that nobody's laser was lit over another's field.
fn judge(rows: &[FieldRow], summary: &serde_json::Value) {
    assert_eq!(frames::faults(rows, FIELD_ORDER), Vec::<String>::new());
    let unlit = frames::unlit(rows);
    assert!(unlit * 50 <= rows.len(), "{unlit} of {} fields were not lit: {summary:#}", rows.len());
    assert_eq!(summary["lasers"]["unsafe_findings"], 0, "{summary:#}");
    assert_eq!(summary["lasers_dark_at_end"], true);
    assert_eq!(summary["flat_at_end"], true);
    let missed =
        rows.iter().filter(|row| row.deadline_missed).map(|row| row.frame).collect::<std::collections::BTreeSet<_>>();
    assert_eq!(summary["deadline_misses"], missed.len());
    assert_eq!(summary["records_lost"], 0);
    assert_eq!(steps(rows).faults, Vec::<String>::new());
}

/// An arc minute of blur on the depth range of [`small_rig`], millimetres of pupil.
const PUPIL_STEP_MM: f64 = 0.101_811;

/// How holograms followed the estimate: those that were made for another pupil than the one before, and what is not by
/// the rule.
struct Steps {
    count: usize,
    faults: Vec<String>,
}

fn steps(rows: &[FieldRow]) -> Steps {
    let mut steps = Steps { count: 0, faults: Vec::new() };
    let mut before: Option<&FieldRow> = None;
    for row in rows {
        let Some(estimate_mm) = row.pupil_estimate_mm else { continue };
        let is_new = before.is_none_or(|before| before.pupil_mm != row.pupil_mm);
        // Of a frame between them that was never shown nothing is known here.
        let is_next = before.is_some_and(|before| before.frame + 1 == row.frame);
        let moved_mm = before.map(|before| (estimate_mm - before.pupil_mm).abs());
        steps.count += usize::from(is_new && before.is_some());
        let is_held = (estimate_mm - row.pupil_mm).abs() <= PUPIL_STEP_MM;
        let is_exact = !is_new || !is_next || estimate_mm == row.pupil_mm;
        // In the fallback, which has no noise, each is made for its own.
        let is_due = !is_new || !is_next || row.pupil_state == "fallback" || moved_mm > Some(PUPIL_STEP_MM);
        if !(is_held && is_exact && is_due) {
            steps.faults.push(format!("frame {}: {} mm for an estimate of {estimate_mm}", row.frame, row.pupil_mm));
        }
        before = Some(row);
    }
    steps
}

#[test]
fn an_eye_that_rests_keeps_its_hologram_and_a_reflex_is_followed_at_once() {
    let record = |more: &str| {
        let folder = holod_tests::new_folder();
        let rig = format!("{}[model]\nnetwork = \"fast\"\n{more}", small_rig(64, 64, "driver = \"simulated\""));
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        let eye = "rate 200\nnoise 0.05mm\nhippus 0mm\n0s pupil 4mm\n4s pupil 2.5mm\n";
        fs::write(folder.path().join("eye.txt"), eye).unwrap();
        let args = ["--config", "rig.toml", "--tracker", "mock:eye.txt", "--resolution", "64x64", "--record", "record"];
        let ended = run(HOLOD, &[&args[..], &["--duration", "7s"]].concat(), folder.path());
        assert!(ended.status.success(), "{}", ended.stderr);
        let rows = frames::read(&folder.path().join("record/frames.csv")).unwrap();
        let t_first = TimeNs(rows[0].t_present_ns);
        let part = |from_s: i64, to_s: i64| -> Vec<FieldRow> {
            let within = |row: &&FieldRow| (from_s..to_s).contains(&((row.t_present_ns - t_first.0) / 1_000_000_000));
            rows.iter().filter(within).cloned().collect()
        };
        [part(1, 4), part(4, 6), rows]
    };
    let patterns = |rows: &[FieldRow]| {
        let mut hashes: Vec<_> = rows.iter().map(|row| &row.levels_xxh3).collect();
        hashes.dedup();
        hashes.len()
    };
    let frames = |rows: &[FieldRow]| {
        let mut frames: Vec<_> = rows.iter().map(|row| row.frame).collect();
        frames.dedup();
        frames.len()
    };
    let [rests, reacts, all] = record("");
    assert_eq!(steps(&all).faults, Vec::<String>::new());
    // Each hologram is of its pupil: another one only with that.
    assert_eq!(patterns(&all), steps(&all).count + 1);
    assert!(patterns(&rests) * 6 <= frames(&rests), "{} of {}", patterns(&rests), frames(&rests));
    // 1.5 mm in steps of a tenth at least.
    assert!(steps(&reacts).count >= 5, "{}", steps(&reacts).count);
    let last_mm = all[all.len() - 1].pupil_mm;
    assert!((last_mm - 2.5).abs() < 0.3, "{last_mm} mm");

    let [rests, _, all] = record("pupil_step_mm = 0\n");
    assert!(all.iter().all(|row| row.pupil_estimate_mm.is_none_or(|estimate_mm| estimate_mm == row.pupil_mm)));
    assert!(patterns(&rests) * 2 > frames(&rests), "{} of {}", patterns(&rests), frames(&rests));
    let judged = steps(&all);
    assert!(judged.faults.len() > 20, "the judge must object to holograms that follow the noise");
}

/// The largest and the median error of what the pupil is estimated to be when frames are seen, over those that were shown when they were meant to be
/// (a frame that stays on the panel because the machine is slow says nothing about the estimate): the distance to the
/// nearest of the eye's diameters between the filter's stated lag before the frame's light and that light. `delay`
/// shifts the eye, for a canary.
fn errors(rows: &[FieldRow], t_first: TimeNs, delay: TimeNs, truth_mm: impl Fn(TimeNs) -> Option<f64>) -> (f64, f64) {
    let first_shown = |index: usize| index == 0 || rows[index - 1].frame != rows[index].frame;
    let mut errors: Vec<f64> = rows
        .iter()
        .enumerate()
        .filter(|(index, row)| first_shown(*index) && !row.deadline_missed)
        .filter_map(|(_, row)| {
            let t = TimeNs(row.laser_on_ns?) - t_first - delay;
            let lagged = (0..=STATED_LAG.0 / 5_000_000).filter_map(|step| truth_mm(t - TimeNs(step * 5_000_000)));
            let estimate_mm = row.pupil_estimate_mm?;
            lagged.map(|truth| (estimate_mm - truth).abs()).min_by(f64::total_cmp)
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    assert!(errors.len() > 30, "{} frames to judge", errors.len());
    (errors[errors.len() - 1], errors[errors.len() / 2])
}

#[test]
fn the_display_follows_the_eye_and_holds_through_blinks() {
    let bench = Bench::new();
    let mut tracker = PtyTracker::plug_in(&bench.link).unwrap();
    let daemon = bench.start(&[]);
    let eye: Vec<_> = MockSource::new(Scenario::LightSteps, MOCK_SEED)
        .without_confidence()
        .take_while(|sample| sample.sample.t_sample < TimeNs(8_000_000_000))
        .filter(|sample| sample.sample.eye == SampleEye::Left)
        .collect();
    let samples: Vec<PupilSample> = eye.iter().map(|sample| sample.sample).collect();
    let t_first = host_now();
    tracker.feed(&lines(&samples), Instant::now()).unwrap();
    let (rows, summary) = bench.stop(daemon);
    judge(&rows, &summary);

    let raw_lowest = samples.iter().map(|sample| sample.diameter_mm).fold(f32::MAX, f32::min);
    let true_lowest = eye.iter().map(|sample| sample.truth_mm).fold(f32::MAX, f32::min);
    assert!(
        raw_lowest < true_lowest - 0.8,
        "the test's blinks must show in the raw samples: {raw_lowest} {true_lowest}"
    );
    let after_start = TimeNs(500_000_000);
    let truth = |t: TimeNs| {
        let index = usize::try_from(t.0 / 5_000_000).ok()?;
        (t > after_start).then(|| eye.get(index).map(|sample| f64::from(sample.truth_mm)))?
    };
    let (worst_mm, median_mm) = errors(&rows, t_first, TimeNs(0), truth);
    assert!(median_mm < 0.1, "median error {median_mm} mm");
    assert!(worst_mm < 0.6, "worst error {worst_mm} mm: a blink or a light step was not followed");
    let (_, canary_mm) = errors(&rows, t_first, TimeNs(-600_000_000), truth);
    assert!(canary_mm > 2.0 * median_mm, "the judge must object to an eye that is 0.6 s off: {canary_mm}");
    let blinked = rows.iter().filter(|row| row.pupil_state == "holding").count();
    assert!(blinked > 20, "blinks are held: {blinked} fields");

    // How long before its light the sample was taken that a field's pupil rests on: longer through a blink.
    let ages = |state: &str| -> Vec<TimeNs> {
        let rows = rows.iter().filter(|row| row.pupil_state == state);
        let mut ages: Vec<_> = rows.filter_map(|row| Some(TimeNs(row.laser_on_ns? - row.t_sample_ns?))).collect();
        ages.sort();
        ages
    };
    let [tracked, held] = ["tracking", "holding"].map(ages);
    let lead = GateSettings::default().lead;
    let young = |ages: &[TimeNs], newer: TimeNs| ages.iter().filter(|age| **age - newer < lead).count();
    assert_eq!(young(&tracked, TimeNs(0)) + young(&held, TimeNs(0)), 0, "a sample that cannot be believed yet");
    assert!(young(&tracked, TimeNs(300_000_000)) > 0, "the judge must object to samples that are newer");
    let [tracked_median, held_longest] = [tracked[tracked.len() / 2], held[held.len() - 1]];
    assert!(held_longest - tracked_median > TimeNs(80_000_000), "{held_longest:?} {tracked_median:?}");
}

#[test]
fn samples_that_are_all_refused_are_told_with_their_cure() {
    type Spoil = fn(&mut LineSample);
    let cases: [(Spoil, &str); 3] = [
        (|line| line.diameter_mm *= 1000.0, "looks like micrometres; if it is, scale_mm_per_unit = 0.001"),
        (|line| line.diameter_mm *= 0.1, "looks like centimetres; if it is, scale_mm_per_unit = 10"),
        (|line| line.device_us /= 1000, "such as milliseconds in the place of microseconds"),
    ];
    for (spoil, cure) in cases {
        let bench = Bench::new();
        let mut tracker = PtyTracker::plug_in(&bench.link).unwrap();
        let daemon = bench.start(&[]);
        let lines: Vec<_> = (0..600_i64)
            .map(|k| {
                let mut line = LineSample {
                    sequence: k as u64,
                    device_us: k * 5000,
                    eye: SampleEye::Left,
                    diameter_mm: 3.5,
                    confidence: 1.0,
                };
                spoil(&mut line);
                let mut text = String::new();
                encode_line(&line, &mut text);
                TimedLine { due: Duration::from_millis(5 * k as u64), bytes: text.into_bytes() }
            })
            .collect();
        tracker.feed(&lines, Instant::now()).unwrap();
        daemon.signal(Signal::TERM);
        let ended = daemon.wait(Duration::from_secs(20));
        assert_eq!(ended.stderr.matches(cure).count(), 1, "{cure}: {}", ended.stderr);
        let summary = fs::read_to_string(bench.record.join("summary.json")).unwrap();
        let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
        assert!(summary["tracker_trouble"].as_str().unwrap().contains(cure), "{summary:#}");
        assert!(ended.stdout.contains(cure), "{}", ended.stdout);
    }
}

#[test]
fn unplugging_garbage_and_silence_are_survived_and_counted() {
    let bench = Bench::new();
    let mut tracker = PtyTracker::plug_in(&bench.link).unwrap();
    let mut daemon = bench.start(&[]);
    let steady: Vec<PupilSample> = MockSource::new(Scenario::Steady, MOCK_SEED)
        .take_while(|sample| sample.sample.t_sample < TimeNs(1_500_000_000))
        .filter(|sample| sample.sample.eye == SampleEye::Left)
        .map(|sample| sample.sample)
        .collect();
    let lines = lines(&steady);
    tracker.feed(&lines, Instant::now()).unwrap();
    tracker.send(b"P1,half a li").unwrap();
    tracker.send(&[0xff; 4096]).unwrap();
    tracker.send(b"\nP1,9,9,L,-3.0,1.0*00\nP1,9,9,L,nan,1.0*00\n").unwrap();
    thread::sleep(Duration::from_millis(1800));
    drop(tracker);
    thread::sleep(Duration::from_millis(1200));
    assert!(daemon.runs(), "an unplugged tracker is no reason to end");
    let mut tracker = PtyTracker::plug_in(&bench.link).unwrap();
    thread::sleep(Duration::from_millis(2500));
    tracker.feed(&lines, Instant::now()).unwrap();
    let (rows, summary) = bench.stop(daemon);
    judge(&rows, &summary);

    let mut expected = ["tracking", "holding", "fallback", "tracking"].into_iter().peekable();
    for row in &rows {
        expected.next_if_eq(&row.pupil_state.as_str());
    }
    assert_eq!(expected.next(), None, "the state that never came: {summary:#}");
    let count = |name: &str| summary["tracker_counts"][name].as_u64().unwrap_or_else(|| panic!("{name}: {summary:#}"));
    assert!(count("disconnects") >= 1);
    assert!(count("connects") >= 2);
    assert!(count("silences") >= 1);
    assert!(count("wire_too_long") + count("wire_malformed") >= 1);
    assert!(count("wire_bad_checksum") >= 2);
    assert!(rows.iter().all(|row| (2.5..5.5).contains(&row.pupil_mm)), "garbage never reaches the display");
}

#[test]
#[ignore = "needs shared data"]
fn shared_data_neon_recording_through_a_port_holds_through_both_blinks() {
    let log = holod_tests::shared_data().join("pupil/neon_demo/3d_eye_states.csv");
    let recording = Recording::read(&log).unwrap();
    let samples: Vec<PupilSample> = recording.samples().filter(|sample| sample.eye == SampleEye::Left).collect();
    let bench = Bench::new();
    let mut tracker = PtyTracker::plug_in(&bench.link).unwrap();
    let daemon = bench.start(&[]);
    let t_first = host_now();
    tracker.feed(&lines(&samples), Instant::now()).unwrap();
    let (rows, summary) = bench.stop(daemon);
    judge(&rows, &summary);

    let during: Vec<&FieldRow> =
        rows.iter().filter(|row| row.t_present_ns > t_first.0 + 500_000_000 && row.pupil_state != "fallback").collect();
    let lowest = during.iter().map(|row| row.pupil_mm).fold(f64::MAX, f64::min);
    let raw_lowest = samples.iter().map(|sample| sample.diameter_mm).fold(f32::MAX, f32::min);
    assert!(raw_lowest < 2.9, "the raw samples fall in the blinks: {raw_lowest}");
    let believed_lowest = during.iter().filter_map(|row| row.pupil_raw_mm).fold(f64::MAX, f64::min);
    assert!(believed_lowest >= 3.0, "a frame rests on a sample of {believed_lowest} mm");
    assert!(lowest >= 3.0, "the estimate fell to {lowest} mm");
    let start = samples[0].t_sample;
    let open = |t: TimeNs| {
        let blinks = recording.blinks();
        let guard = TimeNs(250_000_000);
        let near_blink = blinks.iter().any(|blink| t > blink.begins - guard && t < blink.ends + guard);
        (!near_blink).then_some(())
    };
    let truth = |t: TimeNs| {
        let at = start + t;
        open(at)?;
        if t < TimeNs(500_000_000) {
            return None;
        }
        // The median of a tenth of a second stands for the truth.
        let mut near: Vec<f32> = samples
            .iter()
            .filter(|sample| (sample.t_sample - at).0.abs() < 50_000_000)
            .map(|sample| sample.diameter_mm)
            .collect();
        near.sort_by(f32::total_cmp);
        near.get(near.len() / 2).copied().map(f64::from)
    };
    let (worst_mm, median_mm) = errors(&rows, t_first, TimeNs(0), truth);
    assert!(median_mm < 0.08, "median error {median_mm} mm");
    assert!(worst_mm < 0.6, "worst error {worst_mm} mm");
}
