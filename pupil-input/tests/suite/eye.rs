//! The estimate against the true diameter of a made-up eye.

use crate::support::{rms, settings};
use holod_calibration::{PupilDiameter, TimeNs, rig};
use holod_pupil_input::{
    Decision, Estimator, EstimatorSettings, GateSettings, MockSource, PupilEstimate, PupilSample, PupilState,
    Rejection, STATED_LAG, SampleEye, Scenario, Verdict,
};
use holod_tests::worst;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// (time, true, estimated, state) of the left eye at each of its samples.
fn followed(
    source: MockSource,
    settings: EstimatorSettings,
    seconds: f64,
    ahead: TimeNs,
) -> Vec<(f64, f32, f32, PupilState)> {
    let mut estimator = Estimator::new(settings);
    let mut out = Vec::new();
    for mock in source.take_while(|mock| mock.sample.t_sample < TimeNs::from_seconds(seconds)) {
        estimator.push(mock.sample, |_| {});
        if mock.sample.eye == SampleEye::Left {
            let estimate = estimator.pupil_at(mock.sample.t_sample + ahead);
            out.push((mock.sample.t_sample.seconds(), mock.truth_mm, estimate.pupil.mm(), estimate.state));
        }
    }
    out
}

fn sample(t_ms: i64, eye: SampleEye, diameter_mm: f32) -> PupilSample {
    let t = TimeNs(t_ms * 1_000_000);
    PupilSample {
        t_device: t,
        t_sample: t,
        t_arrival: t,
        eye,
        diameter_mm,
        confidence: 1.0,
        aperture_mm: None,
        sequence: None,
        valid: true,
    }
}

/// The sum of twelve uniform deviates is all but normal.
fn normal(random: &mut Pcg64Mcg, deviation: f32) -> f32 {
    deviation * ((0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0)
}

/// Pushes one eye's diameters, `interval_ms` apart from `from_ms` on, and gives what was decided.
fn push_all(estimator: &mut Estimator, eye: SampleEye, from_ms: i64, diameters_mm: &[f32]) -> Vec<Decision> {
    let mut decisions = Vec::new();
    for (k, &diameter_mm) in diameters_mm.iter().enumerate() {
        estimator.push(sample(from_ms + 5 * k as i64, eye, diameter_mm), |decision| decisions.push(decision));
    }
    decisions
}

fn at(estimator: &Estimator, t_ms: i64) -> (f32, PupilState) {
    let estimate = estimator.pupil_at(TimeNs(t_ms * 1_000_000));
    (estimate.pupil.mm(), estimate.state)
}

#[test]
fn a_ramp_is_followed_within_the_stated_lag() {
    for speed_mm_per_s in [-5.5_f32, -4.0, 1.3] {
        let truth = |t_ms: i64| 6.0 + speed_mm_per_s * (t_ms - 2000).clamp(0, 500) as f32 * 1e-3;
        // The filter trusts a noisy tracker less; the mean over many runs shows its lag without the noise.
        let runs = 100;
        let mut mean_behind_ms = vec![0.0_f32; 501];
        for seed in 0..runs {
            let mut random = Pcg64Mcg::seed_from_u64(seed);
            let mut estimator = Estimator::new(settings(rig::Eye::Left));
            for (k, mean_ms) in (0..).zip(&mut mean_behind_ms) {
                let t_ms = 5 * k;
                let noisy_mm = truth(t_ms) + normal(&mut random, 0.06);
                estimator.push(sample(t_ms, SampleEye::Left, noisy_mm), |_| {});
                *mean_ms += (at(&estimator, t_ms).0 - truth(t_ms)) / -speed_mm_per_s * 1e3 / runs as f32;
            }
        }
        let worst_from = |t_ms: usize| worst(mean_behind_ms[t_ms / 5..].iter().copied());
        let (worst_ms, later_ms) = (worst_from(2005), worst_from(2205));
        eprintln!(
            "ramp of {speed_mm_per_s} mm/s: {worst_ms:.1} ms behind, {later_ms:.1} ms from 200 ms after its onset"
        );
        assert!(worst_ms > 30.0, "nothing is known before the gate's lead is over: {worst_ms}");
        assert!(worst_ms * 1e-3 < STATED_LAG.seconds(), "{worst_ms}");
        assert!(later_ms < 30.0, "{later_ms}");
    }
}

#[test]
fn the_error_on_a_made_up_eye_is_small() {
    // rms of all, and the worst while tracking, of the estimate for the present moment.
    let limits = [
        (Scenario::Steady, 0.05, 0.15),
        (Scenario::LightSteps, 0.08, 0.60),
        (Scenario::Sweep, 0.09, 0.40),
        (Scenario::Blinks, 0.07, 0.25),
    ];
    for (scenario, rms_mm, worst_mm) in limits {
        for source in [MockSource::new(scenario, 7), MockSource::new(scenario, 7).without_confidence()] {
            let trace = followed(source, settings(rig::Eye::Left), 32.0, TimeNs(0));
            let settled = || trace.iter().filter(|row| row.0 > 1.0);
            let error = rms(settled().map(|row| f64::from(row.2 - row.1)));
            let tracking = settled().filter(|row| row.3 == PupilState::Tracking);
            let greatest = worst(tracking.map(|row| (row.2 - row.1).abs()));
            eprintln!("{:12} rms {error:.3} mm, worst while tracking {greatest:.3} mm", scenario.name());
            assert!(error < rms_mm, "{}: {error}", scenario.name());
            assert!(greatest < worst_mm, "{}: {greatest}", scenario.name());
        }
    }
}

#[test]
fn noise_is_damped() {
    for (rate_hz, greatest_gain) in [(60, 0.7), (200, 0.5), (1000, 0.35)] {
        let noise_mm = 0.06;
        let mut random = Pcg64Mcg::seed_from_u64(9);
        let mut estimator = Estimator::new(settings(rig::Eye::Left));
        let mut errors = Vec::new();
        for k in 0..60 * rate_hz {
            let t = TimeNs(k * 1_000_000_000 / rate_hz);
            let noisy = PupilSample { t_sample: t, ..sample(0, SampleEye::Left, 4.0 + normal(&mut random, noise_mm)) };
            estimator.push(noisy, |_| {});
            if k > rate_hz {
                errors.push(estimator.pupil_at(t).pupil.mm() - 4.0);
            }
        }
        let gain = rms(errors.into_iter().map(f64::from)) / f64::from(noise_mm);
        eprintln!("noise gain at {rate_hz} Hz: {gain:.2}");
        assert!((0.05..greatest_gain).contains(&gain), "{rate_hz} Hz: {gain}");
    }
}

#[test]
fn a_loss_is_held_then_slides_to_the_fallback_and_back() {
    let mut estimator = Estimator::new(settings(rig::Eye::Left));
    assert_eq!(at(&estimator, 0), (3.0, PupilState::Fallback));
    push_all(&mut estimator, SampleEye::Left, 0, &[5.0; 400]);
    assert_eq!(at(&estimator, 2000), (5.0, PupilState::Tracking));
    // The last sample that was believed is of 1.96 s.
    assert_eq!(at(&estimator, 2200), (5.0, PupilState::Holding));
    assert_eq!(at(&estimator, 2950), (5.0, PupilState::Holding));
    let (sliding, state) = at(&estimator, 2965 + 500);
    assert_eq!(state, PupilState::Fallback);
    assert!((sliding - (5.0 - 0.65)).abs() < 0.02, "{sliding}");
    assert_eq!(at(&estimator, 10_000), (3.0, PupilState::Fallback));
    // Back at 10 s: after the guards it slides, no faster than a pupil, to what is measured, and says so.
    let mut shown = vec![at(&estimator, 10_000).0];
    for k in 0..300 {
        let t_ms = 10_000 + 5 * k;
        estimator.push(sample(t_ms, SampleEye::Left, 5.0), |_| {});
        let (mm, state) = at(&estimator, t_ms);
        assert_eq!(state == PupilState::Tracking, mm > 4.91, "{state:?} at {mm} mm, {t_ms} ms");
        shown.push(mm);
    }
    let fastest = worst(shown.windows(2).map(|pair| (pair[1] - pair[0]).abs() / 5e-3));
    assert!(fastest < 5.5, "{fastest} mm/s");
    assert_eq!(at(&estimator, 11_495), (5.0, PupilState::Tracking));
}

/// At the begin nothing was shown that could jump; a tracker that comes later finds a picture for the fallback.
#[test]
fn the_first_diameter_is_shown_at_once_where_nothing_was_shown_before() {
    let mut estimator = Estimator::new(settings(rig::Eye::Left));
    push_all(&mut estimator, SampleEye::Left, 0, &[6.0; 10]);
    let (mm, state) = at(&estimator, 50);
    assert!((mm - 6.0).abs() < 1e-3 && state == PupilState::Tracking, "{mm} {state:?}");

    let mut estimator = Estimator::new(settings(rig::Eye::Left));
    estimator.begin(TimeNs(0));
    push_all(&mut estimator, SampleEye::Left, 5000, &[6.0; 10]);
    let (mm, state) = at(&estimator, 5050);
    assert!(mm < 3.2 && state == PupilState::Acquiring, "{mm} {state:?}");
    push_all(&mut estimator, SampleEye::Left, 5050, &[6.0; 200]);
    assert_eq!(at(&estimator, 6045), (6.0, PupilState::Tracking));
}

#[test]
fn losing_one_of_two_eyes_does_not_jump() {
    let mut estimator = Estimator::new(settings(rig::Eye::Both));
    let (left_mm, right_mm) = (3.72, 3.35);
    let mut shown = Vec::new();
    for k in 0..1200 {
        let t_ms = 5 * k;
        estimator.push(sample(t_ms, SampleEye::Left, left_mm), |_| {});
        // The right eye is lost from the third second to the fourth.
        let lost = (3000..4000).contains(&t_ms);
        estimator.push(sample(t_ms, SampleEye::Right, if lost { 0.0 } else { right_mm }), |_| {});
        if t_ms > 1000 {
            assert_eq!(at(&estimator, t_ms).1, PupilState::Tracking, "{t_ms} ms");
            shown.push(at(&estimator, t_ms).0);
        }
    }
    let mean_mm = 0.5 * (left_mm + right_mm);
    assert!(shown.iter().all(|mm| (mm - mean_mm).abs() < 0.01), "{shown:?}");
}

/// As when one eye's camera is unplugged: no sample says so, they just end.
#[test]
fn an_eye_that_stops_coming_does_not_stand_still_beside_the_other() {
    for (eye, shown_mm) in [(rig::Eye::Both, 4.5), (rig::Eye::Better, 4.0)] {
        let mut estimator = Estimator::new(settings(eye));
        let left_mm = |t_ms: i64| 5.0 - (t_ms - 3000).clamp(0, 1000) as f32 * 1e-3;
        for t_ms in (0..6000).step_by(5) {
            let left = PupilSample { confidence: 0.8, ..sample(t_ms, SampleEye::Left, left_mm(t_ms)) };
            estimator.push(left, |_| {});
            if t_ms < 2000 {
                estimator.push(sample(t_ms, SampleEye::Right, 6.0), |_| {});
            }
        }
        let (mm, state) = at(&estimator, 6000);
        assert_eq!(state, PupilState::Tracking, "{eye:?}");
        assert!((mm - shown_mm).abs() < 0.02, "{eye:?}: {mm}");
    }
}

/// The better of two eyes, each 200 Hz: what is shown at each time, from (time in ms) to (left's and right's diameter
/// and confidence).
fn better_of(eyes: impl Fn(i64) -> [(f32, f32); 2]) -> Vec<(i64, f32, PupilState)> {
    let mut estimator = Estimator::new(settings(rig::Eye::Better));
    let mut shown = Vec::new();
    for k in 0..1600 {
        let t_ms = 5 * k;
        for (eye, (diameter_mm, confidence)) in [SampleEye::Left, SampleEye::Right].into_iter().zip(eyes(t_ms)) {
            estimator.push(PupilSample { confidence, ..sample(t_ms, eye, diameter_mm) }, |_| {});
        }
        let (mm, state) = at(&estimator, t_ms);
        shown.push((t_ms, mm, state));
    }
    shown
}

#[test]
fn the_better_eye_is_shown_and_a_change_of_eye_slides() {
    // The left eye is the surer one, until from 3 s on it is the less sure one by more than the margin.
    let shown = better_of(|t| [(4.0, if t < 3000 { 0.95 } else { 0.7 }), (3.5, 0.85)]);
    let from = |t_ms: i64| shown.iter().filter(move |row| row.0 >= t_ms);
    assert!(from(1000).take_while(|row| row.0 < 3000).all(|row| (row.1 - 4.0).abs() < 1e-3));
    assert!(from(1000).all(|row| row.2 == PupilState::Tracking));
    let changed = from(3000).find(|row| row.1 < 3.99).expect("the eye is changed").0;
    assert!((3100..4500).contains(&changed), "{changed}");
    assert!(from(changed + 200).all(|row| (row.1 - 3.5).abs() < 1e-3));
    let fastest = worst(shown.windows(2).skip(100).map(|pair| (pair[1].1 - pair[0].1).abs() / 5e-3));
    assert!(fastest < 5.5, "{fastest} mm/s");
}

#[test]
fn another_eye_by_order_is_slid_to_and_every_sample_is_decided_upon() {
    let mut estimator = Estimator::new(settings(rig::Eye::Left));
    let (mut shown, mut pushed, mut decided) = (Vec::new(), 0, 0);
    for t_ms in (0..4000).step_by(5) {
        if t_ms == 2000 {
            estimator.change(settings(rig::Eye::Right), TimeNs(t_ms * 1_000_000), |_| decided += 1);
        }
        for (eye, diameter_mm) in [(SampleEye::Left, 4.0), (SampleEye::Right, 3.4)] {
            estimator.push(sample(t_ms, eye, diameter_mm), |_| decided += 1);
            pushed += 1;
        }
        let (mm, state) = at(&estimator, t_ms);
        shown.push((t_ms, mm, state));
    }
    estimator.finish(|_| decided += 1);
    assert_eq!(decided, pushed);
    let from = |t_ms: i64| shown.iter().filter(move |row| row.0 >= t_ms);
    assert!(from(500).take_while(|row| row.0 < 2000).all(|row| (row.1 - 4.0).abs() < 1e-3));
    assert!(from(2300).all(|row| (row.1 - 3.4).abs() < 1e-3 && row.2 == PupilState::Tracking));
    let fastest = worst(shown.windows(2).skip(100).map(|pair| (pair[1].1 - pair[0].1).abs() / 5e-3));
    assert!(fastest < 5.5, "{fastest} mm/s");
}

/// What is shown from a change of hold time and fallback on, in steps of 5 ms: of an eye of 3.5 mm that was there from
/// 0 to 2 s where `believed` says so, with the fallback at 3 mm and held for 1 s before, at 5 mm and for `hold_ms`
/// after.
fn shown_after_a_change(believed: bool, t_change_ms: i64, hold_ms: i64) -> Vec<(f32, PupilState)> {
    let before = settings(rig::Eye::Both);
    let (hold, fallback) = (TimeNs(hold_ms * 1_000_000), PupilDiameter::from_mm(5.0));
    let mut estimator = Estimator::new(before);
    if believed {
        push_all(&mut estimator, SampleEye::Left, 0, &[3.5; 400]);
    }
    let mut shown = vec![at(&estimator, t_change_ms - 5)];
    let t = TimeNs(t_change_ms * 1_000_000);
    estimator.change(EstimatorSettings { hold, fallback, ..before }, t, |decision| {
        panic!("nothing is decided anew: {decision:?}")
    });
    shown.extend((t_change_ms..t_change_ms + 15_000).step_by(5).map(|t_ms| at(&estimator, t_ms)));
    let fastest = worst(shown.windows(2).map(|pair| (pair[1].0 - pair[0].0).abs() / 5e-3));
    assert!(fastest < 5.5, "{fastest} mm/s after {t_change_ms} ms with {hold_ms} ms");
    assert_eq!(shown.last(), Some(&(5.0, PupilState::Fallback)));
    shown
}

#[test]
fn another_hold_time_or_fallback_slides_from_what_is_shown() {
    // While the eye is followed, nothing is seen of it.
    let shown = shown_after_a_change(true, 2000, 100);
    assert!(shown[..10].iter().all(|shown| (shown.0 - 3.5).abs() < 0.01));
    // Held for 0.5 s, and for longer now, or not any more.
    let shown = shown_after_a_change(true, 2500, 4000);
    assert!(shown[..600].iter().all(|shown| (shown.0 - 3.5).abs() < 0.01 && shown.1 == PupilState::Holding));
    let shown = shown_after_a_change(true, 2500, 100);
    assert!(shown[1..].iter().skip(1).all(|shown| shown.1 == PupilState::Fallback));
    // What is at the fallback, or on the way to it, is not held again.
    for (believed, t_change_ms) in [(true, 3100), (true, 8000), (false, 1000)] {
        let shown = shown_after_a_change(believed, t_change_ms, 10_000);
        assert!(shown.iter().all(|shown| shown.1 == PupilState::Fallback), "{t_change_ms}");
    }
}

#[test]
fn eyes_that_are_about_as_sure_are_not_changed_to_and_fro() {
    let sway = |t: i64, phase: f32| 0.85 + 0.08 * (t as f32 * 4e-3 + phase).sin();
    let shown = better_of(|t| [(4.0, sway(t, 0.0)), (3.5, sway(t, 3.0))]);
    let settled: Vec<_> = shown.iter().filter(|row| row.0 >= 1000).map(|row| row.1).collect();
    assert!(settled.iter().all(|mm| (mm - settled[0]).abs() < 1e-3));
}

#[test]
fn the_other_eye_is_shown_when_the_better_one_is_lost_but_not_at_the_end_of_a_blink() {
    // Both blink, the right eye is back 60 ms earlier; later the left eye is lost.
    let shown = better_of(|t| {
        let left_lost = (2000..2300).contains(&t) || t >= 4000;
        [(if left_lost { 0.0 } else { 4.0 }, 0.95), (if (2000..2240).contains(&t) { 0.0 } else { 3.5 }, 0.94)]
    });
    let of = |from: i64, to: i64| shown.iter().filter(move |row| (from..to).contains(&row.0));
    let not_left = of(1000, 4000).find(|row| (row.1 - 4.0).abs() > 1e-3);
    assert_eq!(not_left, None);
    assert!(of(2100, 2300).all(|row| row.2 == PupilState::Holding));
    assert!(of(4400, 8000).all(|row| (row.1 - 3.5).abs() < 1e-3 && row.2 == PupilState::Tracking));
}

#[test]
fn one_eye_alone_is_taken_as_it_is() {
    let mut estimator = Estimator::new(settings(rig::Eye::Both));
    push_all(&mut estimator, SampleEye::Right, 0, &[3.35; 400]);
    assert!((at(&estimator, 2000).0 - 3.35).abs() < 1e-3);
}

#[test]
fn only_the_chosen_eye_counts_and_the_scale_is_applied() {
    let mut settings = settings(rig::Eye::Right);
    settings.scale = 0.5;
    let mut estimator = Estimator::new(settings);
    let other = push_all(&mut estimator, SampleEye::Left, 0, &[4.0]);
    assert_eq!(other[0].verdict, Verdict::Rejected(Rejection::OtherEye));
    push_all(&mut estimator, SampleEye::Right, 5, &[8.0; 400]);
    let estimate = estimator.pupil_at(TimeNs(2_000_000_000));
    assert!((estimate.pupil.mm() - 4.0).abs() < 1e-3);
    assert_eq!(estimate.raw_mm, Some(4.0));
    // What came in the gate's 30 ms is heard, and nothing rests on it yet.
    assert_eq!(estimate.t_sample, Some(TimeNs(1_970_000_000)));
    assert_eq!(estimate.t_heard, Some(TimeNs(2_000_000_000)));
}

/// What is wrong with the samples that estimates of their times are said to rest on, given those that were believed.
fn faults_of_samples(estimates: &[(TimeNs, PupilEstimate)], believed: &[(TimeNs, f32)]) -> Vec<String> {
    let mut faults = Vec::new();
    let mut ages = Vec::new();
    for (now, estimate) in estimates {
        let measured = estimate.t_sample.zip(estimate.raw_mm);
        if measured.is_some() == (estimate.state == PupilState::Fallback) {
            faults.push(format!("{measured:?} in {:?} at {now:?}", estimate.state));
        }
        let Some(measured) = measured else { continue };
        if !believed.contains(&measured) {
            faults.push(format!("{measured:?} at {now:?} was not believed"));
        }
        let age = *now - measured.0;
        if age < GateSettings::default().lead {
            faults.push(format!("{age:?} old at {now:?}"));
        }
        if estimate.state == PupilState::Holding {
            ages.push(age);
        } else if let Some(pair) = std::mem::take(&mut ages).windows(2).find(|pair| pair[0] >= pair[1]) {
            faults.push(format!("{pair:?}: its age does not grow in the blink before {now:?}"));
        }
    }
    faults
}

#[test]
fn the_estimate_rests_on_a_believed_sample_whose_age_grows_through_a_blink() {
    type Spoil = fn(&mut PupilSample);
    let blinks: [Spoil; 4] = [
        |sample| (sample.valid, sample.diameter_mm) = (false, f32::NAN),
        |sample| sample.diameter_mm = 0.0,
        |sample| (sample.diameter_mm, sample.confidence) = (3.0, 0.1),
        |sample| (sample.diameter_mm, sample.aperture_mm) = (2.9, Some(0.2)),
    ];
    for blink in blinks {
        let mut estimator = Estimator::new(settings(rig::Eye::Left));
        let (mut estimates, mut believed) = (Vec::new(), Vec::new());
        for k in 0..1200 {
            // No two neighbours are alike. A blink, and a loss that lasts until the fallback is shown.
            let mut sample = sample(5 * k, SampleEye::Left, 4.0 + 0.001 * (k % 50) as f32);
            let shut = (200..240).contains(&k) || (600..1100).contains(&k);
            if shut {
                blink(&mut sample);
            }
            estimator.push(sample, |decision| {
                if decision.verdict == Verdict::Accepted {
                    believed.push((decision.sample.t_sample, decision.sample.diameter_mm));
                }
            });
            let estimate = estimator.pupil_at(sample.t_sample);
            assert_eq!(estimate.t_heard, Some(sample.t_sample));
            estimates.push((sample.t_sample, estimate));
        }
        assert_eq!(faults_of_samples(&estimates, &believed), Vec::<String>::new());
        let in_state = |state| estimates.iter().filter(move |(_, estimate)| estimate.state == state).count();
        assert!(in_state(PupilState::Holding) > 100 && in_state(PupilState::Fallback) > 100);

        // The judge objects to the newest sample that came, and to one believed sample in the place of an older one.
        let heard: Vec<_> = estimates
            .iter()
            .map(|&(now, estimate)| {
                let t_sample = estimate.t_sample.and(estimate.t_heard);
                (now, PupilEstimate { t_sample, ..estimate })
            })
            .collect();
        let faults = faults_of_samples(&heard, &believed);
        assert!(faults.iter().any(|fault| fault.contains("was not believed")), "{faults:?}");
        assert!(faults.iter().any(|fault| fault.contains("old at")), "{faults:?}");
        let held = estimates.iter().position(|(_, estimate)| estimate.state == PupilState::Holding).expect("held");
        estimates[held].1.t_sample = Some(believed[0].0);
        estimates[held].1.raw_mm = Some(believed[0].1);
        let faults = faults_of_samples(&estimates, &believed);
        assert!(faults.len() == 1 && faults[0].contains("does not grow"), "{faults:?}");
    }
}

#[test]
fn the_sample_is_of_an_eye_that_is_shown() {
    // The left eye is surer, comes 2 ms before the right one, and is lost from 2 s on.
    for (eye, before, after) in [(rig::Eye::Better, 4.0, 3.5), (rig::Eye::Both, 3.5, 3.5), (rig::Eye::Left, 4.0, 4.0)] {
        let mut estimator = Estimator::new(settings(eye));
        let mut raw_mm = Vec::new();
        for k in 0..520 {
            let lost = 5 * k >= 2000;
            let left = PupilSample { valid: !lost, ..sample(5 * k, SampleEye::Left, if lost { 0.0 } else { 4.0 }) };
            estimator.push(left, |_| {});
            let right = PupilSample { confidence: 0.8, ..sample(5 * k + 2, SampleEye::Right, 3.5) };
            estimator.push(right, |_| {});
            raw_mm.push(estimator.pupil_at(TimeNs((5 * k + 2) * 1_000_000)).raw_mm);
        }
        assert!(raw_mm[200..390].iter().all(|mm| *mm == Some(before)), "{eye:?}: {:?}", raw_mm[200]);
        assert!(raw_mm[460..].iter().all(|mm| *mm == Some(after)), "{eye:?}: {:?}", raw_mm[460]);
    }
}

#[test]
fn a_pupil_that_changed_behind_the_lid_is_believed_soon_after() {
    let mut estimator = Estimator::new(settings(rig::Eye::Left));
    push_all(&mut estimator, SampleEye::Left, 0, &[5.0; 200]);
    push_all(&mut estimator, SampleEye::Left, 1000, &[0.5; 50]);
    push_all(&mut estimator, SampleEye::Left, 1250, &[3.8; 200]);
    let (shown, state) = at(&estimator, 2245);
    assert_eq!(state, PupilState::Tracking);
    assert!((shown - 3.8).abs() < 0.05, "{shown}");
}

/// Trackers of other rates, which tell a blink by a dip and then zeros: 4.5 mm, 30 ms down, 0.0 for 120 ms, 60 ms up.
#[test]
fn blinks_are_held_at_any_rate() {
    for rate_hz in [15, 30, 60, 120, 250, 500, 1000, 2000] {
        for phase in 0..4 {
            let mut random = Pcg64Mcg::seed_from_u64(10 + phase);
            let mut estimator = Estimator::new(settings(rig::Eye::Left));
            let mut held = 0;
            for k in 0..6 * rate_hz {
                let t = TimeNs(k * 1_000_000_000 / rate_hz + phase as i64 * 4_000_000);
                let since_s = (t.seconds() - 0.7).rem_euclid(2.0) - 1.0;
                let open = match since_s {
                    s if s < 0.0 => 1.0,
                    s if s < 0.03 => 1.0 - s / 0.03,
                    s if s < 0.15 => 0.0,
                    s => ((s - 0.15) / 0.06).min(1.0),
                };
                let measured_mm = (open as f32) * (4.5 + 0.1 * (random.random::<f32>() - 0.5));
                estimator.push(PupilSample { t_sample: t, ..sample(0, SampleEye::Left, measured_mm) }, |_| {});
                if t.seconds() > 1.0 {
                    for ahead_ms in [0, 20, 40] {
                        let estimate = estimator.pupil_at(t + TimeNs(ahead_ms * 1_000_000));
                        let shown_mm = estimate.pupil.mm();
                        assert!((4.2..4.8).contains(&shown_mm), "{rate_hz} Hz, {} s: {shown_mm}", t.seconds());
                        held += u32::from(estimate.state == PupilState::Holding);
                    }
                }
                // Believed again well before the next blink.
                if (0.6..0.9).contains(&since_s) || (-0.4..0.0).contains(&since_s) && t.seconds() > 1.2 {
                    assert_eq!(estimator.pupil_at(t).state, PupilState::Tracking, "{rate_hz} Hz, {} s", t.seconds());
                }
            }
            assert!(held > 0, "{rate_hz} Hz");
        }
    }
}

#[test]
fn a_long_blink_that_looks_like_a_quiet_small_pupil_is_held() {
    let mut random = Pcg64Mcg::seed_from_u64(14);
    let mut estimator = Estimator::new(settings(rig::Eye::Left));
    for k in 0..600 {
        let t_ms = 5 * k;
        let level_mm = if (1500..1900).contains(&t_ms) { 1.8 } else { 3.2 };
        let measured_mm = level_mm + 0.1 * (random.random::<f32>() - 0.5);
        estimator.push(sample(t_ms, SampleEye::Left, measured_mm), |_| {});
        if t_ms > 500 {
            assert!((3.1..3.3).contains(&at(&estimator, t_ms).0), "{t_ms} ms: {:?}", at(&estimator, t_ms));
        }
    }
    assert_eq!(at(&estimator, 2995).1, PupilState::Tracking);
}

proptest::proptest! {
    #![proptest_config(proptest::test_runner::Config { failure_persistence: None, ..Default::default() })]

    #[test]
    fn any_stream_gives_a_diameter_of_a_pupil_and_one_decision_a_sample(
        rows in proptest::collection::vec((-20_i64..200, 0..3_usize, -2.0_f32..12.0, 0.0_f32..1.0, proptest::bool::ANY), 1..300),
    ) {
        let eye = if rows.len() % 2 == 0 { rig::Eye::Both } else { rig::Eye::Better };
        let mut estimator = Estimator::new(settings(eye));
        let mut decided = 0;
        let mut t_ms = 0;
        for &(step_ms, eye, diameter_mm, confidence, steady) in &rows {
            t_ms += step_ms;
            let diameter_mm = if steady { 4.0 } else if diameter_mm < -1.0 { f32::NAN } else { diameter_mm };
            let confidence = if steady { 1.0 } else { confidence };
            estimator.push(PupilSample { confidence, ..sample(t_ms, SampleEye::ALL[eye], diameter_mm) }, |_| decided += 1);
            for ahead_ms in [-50, 0, 30, 3000] {
                let estimate = estimator.pupil_at(TimeNs((t_ms + ahead_ms) * 1_000_000));
                proptest::prop_assert!((1.0..=9.0).contains(&estimate.pupil.mm()), "{:?}", estimate);
                proptest::prop_assert!(estimate.velocity_mm_per_s.is_finite());
            }
        }
        estimator.finish(|_| decided += 1);
        proptest::prop_assert_eq!(decided, rows.len());
    }
}

#[test]
fn a_sample_is_held_at_least_until_the_next_ones_can_be_known() {
    for interval_ms in [5, 16, 33, 100] {
        for hold_ms in [0, 1, 20] {
            let settings = EstimatorSettings { hold: TimeNs(hold_ms * 1_000_000), ..settings(rig::Eye::Left) };
            let mut estimator = Estimator::new(settings);
            for t_ms in (0..4000).step_by(interval_ms) {
                estimator.push(sample(t_ms, SampleEye::Left, 4.0), |_| {});
                // As the frame loop asks, until just before the next sample; once the tracker's rate is known.
                for ahead_ms in [0, 50, interval_ms as i64 + 49].into_iter().filter(|_| t_ms > 2500) {
                    let (mm, state) = at(&estimator, t_ms + ahead_ms);
                    assert!(
                        state != PupilState::Fallback && (mm - 4.0).abs() < 0.01,
                        "every {interval_ms} ms, held for {hold_ms} ms, {ahead_ms} ms after {t_ms}: {mm} mm, {state:?}"
                    );
                }
            }
            assert_eq!(at(&estimator, 10_000), (3.0, PupilState::Fallback));
        }
    }
}

/// As after the tracker's clock stood or was set back by less than makes a new one of it: for a while samples are taken
/// to be older than they are.
#[test]
fn a_return_with_samples_that_are_old_by_then_slides_from_what_is_shown() {
    for (late_ms, hold_ms) in [(0, 1000), (300, 1000), (400, 1000), (300, 100), (300, 300)] {
        let settings = EstimatorSettings { hold: TimeNs(hold_ms * 1_000_000), ..settings(rig::Eye::Left) };
        // What is older than `hold` slides away while the difference is worked off.
        let fastest_mm_per_s = settings.return_mm_per_s + settings.fallback_mm_per_s + 0.01;
        let mut estimator = Estimator::new(settings);
        let mut push = |from_ms: i64, to_ms: i64, mm: f32, late_ms: i64, shown: &mut Vec<f32>| {
            for t_ms in (from_ms..to_ms).step_by(5) {
                let known = TimeNs((t_ms + late_ms) * 1_000_000);
                let before = estimator.pupil_at(known).pupil.mm();
                estimator.push_at(known, sample(t_ms, SampleEye::Left, mm), |_| {});
                shown.extend([before, estimator.pupil_at(known).pupil.mm()]);
            }
        };
        push(0, 1000, 5.0, 0, &mut Vec::new());
        // A loss in which the pupil has become another one, and is believed again some time after.
        push(1000, 1100, 0.0, 0, &mut Vec::new());
        let mut shown = Vec::new();
        push(1100, 3500, 2.0, late_ms, &mut shown);
        let jumps = shown.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        let greatest_mm = worst(jumps);
        let most_mm = fastest_mm_per_s * 5e-3;
        assert!(
            greatest_mm <= f64::from(most_mm),
            "{late_ms} ms late, held for {hold_ms} ms: {greatest_mm} mm in 5 ms"
        );
    }
}
