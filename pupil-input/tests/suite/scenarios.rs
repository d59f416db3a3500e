//! The simulated eye and tracker: what a script says, and the physiology behind it.

use holod_calibration::TimeNs;
use holod_pupil_input::{
    ClockModel, MockSample, MockSource, PupilSample, SampleEye, Scenario, Script, Tracker, TrackerSpec, host_now,
};
use holod_tests::worst;

fn play(text: &str) -> Vec<MockSample> {
    MockSource::of(Script::parse("test", text).expect("a script")).collect()
}

fn seconds(scenario: Scenario, seed: u64, seconds: f64) -> Vec<MockSample> {
    MockSource::new(scenario, seed).take_while(|mock| mock.sample.t_sample < TimeNs::from_seconds(seconds)).collect()
}

fn of(samples: &[MockSample], eye: SampleEye) -> impl Iterator<Item = &MockSample> {
    samples.iter().filter(move |mock| mock.sample.eye == eye)
}

fn left(samples: &[MockSample]) -> impl Iterator<Item = &MockSample> {
    of(samples, SampleEye::Left)
}

/// What is told of the left eye between two times, in seconds.
fn within(samples: &[MockSample], from_s: f64, to_s: f64) -> impl Iterator<Item = &PupilSample> {
    left(samples).map(|mock| &mock.sample).filter(move |sample| (from_s..to_s).contains(&sample.t_sample.seconds()))
}

/// The left eye's true diameter at a time.
fn truth(samples: &[MockSample], t_s: f64) -> f32 {
    left(samples).find(|mock| mock.sample.t_sample.seconds() >= t_s).expect("within").truth_mm
}

#[test]
fn a_seed_tells_all() {
    for scenario in Scenario::ALL {
        assert_eq!(seconds(scenario, 1, 10.0), seconds(scenario, 1, 10.0));
        assert_ne!(seconds(scenario, 1, 10.0), seconds(scenario, 2, 10.0), "{}", scenario.name());
        assert!(scenario.text().starts_with("# "), "{} says what it is", scenario.name());
    }
    assert_eq!(play("seed 7\nends 3s"), play("ends 3s\nseed 7"));
    assert_ne!(play("seed 7\nends 3s"), play("ends 3s"));
}

#[test]
fn the_reflex_waits_then_peaks_at_the_physiological_speed() {
    let samples = seconds(Scenario::LightSteps, 3, 4.0);
    // The light comes on at 2 s; hippus moves a little all the while.
    assert!((truth(&samples, 2.18) - truth(&samples, 2.0)).abs() < 0.1);
    assert!(truth(&samples, 2.45) < truth(&samples, 2.18) - 0.5);
    let trace: Vec<_> = left(&samples).map(|mock| (mock.sample.t_sample.seconds(), mock.truth_mm)).collect();
    let fastest = worst(trace.windows(2).map(|w| f64::from(w[0].1 - w[1].1) / (w[1].0 - w[0].0)));
    assert!((4.9..6.1).contains(&fastest), "{fastest}");
}

#[test]
fn light_is_answered_later_the_dimmer_it_is() {
    let onset_s = |luminance: &str| {
        let samples = play(&format!("rate 1000\nhippus 0mm\nends 4s\n0s light 0.01cd\n2s light {luminance}"));
        let before_mm = truth(&samples, 2.0);
        let moved = left(&samples).find(|mock| mock.truth_mm < before_mm - 0.02).expect("answers");
        moved.sample.t_sample.seconds() - 2.0
    };
    let (dim_s, bright_s) = (onset_s("3cd"), onset_s("1000cd"));
    assert!((0.18..0.22).contains(&bright_s), "{bright_s}");
    assert!((bright_s + 0.03..0.30).contains(&dim_s), "{dim_s}");
}

#[test]
fn the_sweep_is_wide() {
    let samples = seconds(Scenario::Sweep, 4, 8.0);
    let truths = || left(&samples).map(|mock| mock.truth_mm);
    let (least, most) = (truths().fold(f32::MAX, f32::min), truths().fold(0.0, f32::max));
    assert!(least < 2.3 && most > 5.8, "{least}..{most}");
    let end = samples.last().expect("samples").truth_mm;
    assert!(end > 5.3, "{end}");
}

#[test]
fn blinks_collapse_the_measurement_and_not_the_truth() {
    let samples = seconds(Scenario::Blinks, 5, 10.0);
    let least = left(&samples).map(|mock| mock.sample.diameter_mm).fold(f32::MAX, f32::min);
    assert!(least < 2.0, "{least}");
    assert!(left(&samples).all(|mock| mock.truth_mm > 3.7));
    assert!(left(&samples).any(|mock| mock.sample.confidence < 0.2));
    assert!(left(&samples).all(|mock| mock.sample.valid));
}

#[test]
fn blinks_of_zeros_ramp_and_are_lost() {
    let samples = play("rate 500\nblinks zeros\nnoise 0mm\nends 2s\n0s pupil 4.5mm\n1s blink 200ms");
    let lost = || left(&samples).filter(|mock| !mock.sample.valid);
    assert!(lost().all(|mock| mock.sample.diameter_mm == 0.0));
    assert!((40..90).contains(&lost().count()), "{}", lost().count());
    let ramp = within(&samples, 1.0, 1.1).filter(|sample| sample.valid && sample.diameter_mm < 4.0).count();
    assert!((2..12).contains(&ramp), "{ramp}");
    // Half a blink loses nothing here.
    let half = play("blinks zeros\nends 2s\n1s blink 200ms half");
    assert!(half.iter().all(|mock| mock.sample.valid) && half.iter().any(|mock| mock.sample.diameter_mm < 3.6));
}

#[test]
fn dropouts_are_silent_and_times_go_on() {
    let samples = seconds(Scenario::Dropouts, 6, 14.0);
    let times: Vec<_> = left(&samples).map(|mock| mock.sample.t_sample).collect();
    let longest = worst(times.windows(2).map(|w| (w[1] - w[0]).seconds()));
    assert!((2.9..3.1).contains(&longest));
    assert!(times.is_sorted());
}

#[test]
fn each_event_changes_what_it_says_and_nothing_else() {
    let plain = "noise 0mm\naperture 8mm\nconfidence none\nends 3s\n";
    let at = |events: &str, from_s: f64, to_s: f64| -> Vec<PupilSample> {
        within(&play(&format!("{plain}{events}")), from_s, to_s).copied().collect()
    };
    let of_ms = |event: &str| at(event, 1.0, 1.5);
    assert!(of_ms("1s zeros 500ms").iter().all(|s| !s.valid && s.diameter_mm == 0.0));
    assert!(of_ms("1s unsure 0.3 500ms").iter().all(|s| s.confidence == 0.3 && s.diameter_mm > 3.5));
    assert!(of_ms("1s reads 16.7mm 500ms").iter().all(|s| s.diameter_mm == 16.7 && s.confidence == 1.0 && s.valid));
    assert!(of_ms("1s reads -0.1mm 500ms").iter().all(|s| s.diameter_mm == -0.1));
    assert!(of_ms("1s squint 2mm 500ms").iter().all(|s| s.aperture_mm.is_some_and(|mm| (2.0..2.6).contains(&mm))));
    assert!(of_ms("1s lost 500ms").is_empty());
    let jumped = of_ms("1s jump 0.5mm 500ms");
    let unmoved = of_ms("");
    assert!(jumped.iter().zip(&unmoved).all(|(a, b)| (a.diameter_mm - b.diameter_mm - 0.5).abs() < 1e-5));
    let events = "1s zeros 500ms\n1s unsure 0.3 500ms\n1s squint 2mm 500ms\n1s jump 1mm 500ms\n1s reads 9mm 500ms";
    assert_eq!(at(events, 0.0, 1.0), at("", 0.0, 1.0));
    assert_eq!(at(events, 1.5, 3.0), at("", 1.5, 3.0));
    // Again and again.
    let zeros = within(&play("ends 10s\n1s every 2s zeros 100ms"), 0.0, 10.0).filter(|s| !s.valid).count();
    assert!((5 * 20 - 2..=5 * 20 + 2).contains(&zeros), "{zeros}");
}

#[test]
fn eyes_rates_and_gaps_are_as_the_script_says() {
    let both = play("rate 123\nends 10s\nfree-running");
    let (lefts, rights) = (left(&both).count(), of(&both, SampleEye::Right).count());
    assert!((1229..=1231).contains(&lefts) && (1225..=1228).contains(&rights), "{lefts} {rights}");
    assert!(both.is_sorted_by_key(|mock| mock.sample.t_sample));
    assert!(both.windows(2).all(|pair| pair[0].sample.t_sample != pair[1].sample.t_sample));
    assert!(play("eyes B\nends 1s").iter().all(|mock| mock.sample.eye == SampleEye::Both));
    let apart = play("apart 0.4mm\nends 1s");
    let (l, r) = (apart[0], apart[1]);
    assert_eq!((l.sample.eye, r.sample.eye, l.sample.t_sample), (SampleEye::Left, SampleEye::Right, r.sample.t_sample));
    assert!((l.truth_mm - r.truth_mm - 0.4).abs() < 1e-5);
    let missing = play("eyes L\nmissing 10%\nends 50s").len();
    assert!((8800..9200).contains(&missing), "{missing}");
    let grain = play("grain 0.25mm\nends 1s");
    assert!(grain.iter().all(|mock| mock.sample.diameter_mm % 0.25 == 0.0));
}

#[test]
fn clock_and_link_are_mapped_back_to_the_true_times() {
    let script = "eyes L\nrate 500\nends 30s\nahead -12s\ndrift 120ppm\ndelay 2ms\njitter 3ms\nbatch 5ms\n\
                  20s steps -400ms";
    let mut clock = ClockModel::new();
    for MockSample { sample, .. } in play(script) {
        let mapped = clock.map(sample.t_device, sample.t_arrival);
        let error = (mapped - sample.t_sample).0;
        let t_s = sample.t_sample.seconds();
        if t_s > 2.0 && !(20.0..20.2).contains(&t_s) {
            assert!((0..6_000_000).contains(&error), "{t_s} s: {error} ns");
        }
    }
    assert_eq!(clock.resets(), 1);
}

#[test]
fn a_file_is_a_scenario_for_a_tracker() {
    let dir = tempfile::tempdir().expect("a folder");
    let start = |text: &str| {
        let path = dir.path().join("eye.txt");
        std::fs::write(&path, text).expect("writes");
        let spec: TrackerSpec = format!("mock:{}", path.display()).parse().expect("a spec");
        Tracker::start(&spec, &holod_calibration::rig::Rig::default().tracker, host_now())
    };
    let mut handle = start("rate 1000\nends 50ms\n").expect("starts");
    let begun = std::time::Instant::now();
    while !handle.control.finished() {
        assert!(begun.elapsed().as_secs() < 20, "ends");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    assert_eq!(handle.control.counters().of(holod_pupil_input::Counter::Samples), 100);
    handle.control.stop();
    let error = start("rate many\n").expect_err("is refused").to_string();
    assert!(error.contains("eye.txt, line 1: found `many`"), "{error}");
}

#[test]
fn a_scenario_that_falls_silent_has_not_ended() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("lost.txt");
    for (end, ends) in [("", false), ("ends 200ms\n", true)] {
        std::fs::write(&path, format!("100ms lost 100000s\n{end}")).expect("writes");
        let spec: TrackerSpec = format!("mock:{}", path.display()).parse().expect("a spec");
        let began = host_now();
        let mut tracker =
            Tracker::start(&spec, &holod_calibration::rig::Rig::default().tracker, began).expect("starts");
        std::thread::sleep(std::time::Duration::from_millis(150));
        // A machine that is slow may come to look too late.
        let finished = tracker.control.finished();
        assert!(!finished || ends && (host_now() - began).seconds() > 0.2, "ended in the silence");
        std::thread::sleep(std::time::Duration::from_millis(400));
        assert_eq!(tracker.control.finished(), ends);
        tracker.control.stop();
    }
}

#[test]
fn clock_and_link_of_a_script_are_learnt_as_a_real_trackers() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("slow.txt");
    std::fs::write(&path, "ahead 12s\nbatch 40ms\njitter 10ms\n1s steps -5s\nends 3s\n").expect("writes");
    let spec: TrackerSpec = format!("mock:{}", path.display()).parse().expect("a spec");
    let mut tracker =
        Tracker::start(&spec, &holod_calibration::rig::Rig::default().tracker, host_now()).expect("starts");
    let mut late_ms = Vec::new();
    while !tracker.control.finished() {
        std::thread::sleep(std::time::Duration::from_millis(5));
        while let Some(decision) = tracker.decisions.pop() {
            late_ms.push((decision.sample.t_arrival - decision.sample.t_sample).seconds() * 1e3);
        }
    }
    assert!(tracker.control.clock().is_some(), "a clock is learnt");
    assert!(tracker.control.counters().of(holod_pupil_input::Counter::ClockResets) >= 1, "its step is found");
    // The first of a batch has waited for 40 ms, the last for none.
    assert!(late_ms.iter().filter(|late| **late > 25.0).count() > late_ms.len() / 5, "{late_ms:?}");
}
