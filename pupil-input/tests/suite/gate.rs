//! The gate on simulated trackers that blink, lose and misread as real ones do: what is shown stays with the true
//! pupil.

use crate::support::settings;
use holod_calibration::{TimeNs, rig};
use holod_pupil_input::{
    Decision, Estimator, EstimatorSettings, GateSettings, MockSample, MockSource, PupilSample, PupilState, Rejection,
    SampleEye, Scenario, Script, Verdict,
};
use holod_tests::worst;

/// What a viewer would have been shown, from the second second on.
struct Shown {
    /// Greatest distance from the true diameter while samples were followed, mm.
    worst_tracking_mm: f32,
    /// The same while the last good one was held.
    worst_holding_mm: f32,
    /// Share of the samples at whose time the state was tracking.
    tracking: f32,
    holding: u32,
    rejected: [u32; Rejection::ALL.len()],
    /// Raw diameters farther from the truth than half a millimetre.
    spoilt: u32,
}

impl Shown {
    fn of(&self, reason: Rejection) -> u32 {
        self.rejected[reason.index()]
    }
}

/// Plays a script and asks for the pupil now and up to 40 ms ahead at each sample of the left eye (or of the pair).
fn shown(script: Script, settings: EstimatorSettings) -> Shown {
    shown_of(MockSource::of(script), settings)
}

fn shown_of(samples: impl Iterator<Item = MockSample>, settings: EstimatorSettings) -> Shown {
    let mut estimator = Estimator::new(settings);
    let mut shown = Shown {
        worst_tracking_mm: 0.0,
        worst_holding_mm: 0.0,
        tracking: 0.0,
        holding: 0,
        rejected: [0; Rejection::ALL.len()],
        spoilt: 0,
    };
    let (mut tracking, mut asked) = (0, 0);
    for mock in samples {
        let PupilSample { t_sample, eye, diameter_mm, .. } = mock.sample;
        estimator.push(mock.sample, |Decision { verdict, .. }| {
            if let Verdict::Rejected(reason) = verdict {
                shown.rejected[reason.index()] += 1;
            }
        });
        if eye == SampleEye::Right || t_sample < TimeNs::from_seconds(1.0) {
            continue;
        }
        shown.spoilt += u32::from((diameter_mm - mock.truth_mm).abs() > 0.5);
        for ahead_ms in [0, 20, 40] {
            let estimate = estimator.pupil_at(t_sample + TimeNs(ahead_ms * 1_000_000));
            let error_mm = (estimate.pupil.mm() - mock.truth_mm).abs();
            asked += 1;
            match estimate.state {
                PupilState::Tracking => {
                    tracking += 1;
                    shown.worst_tracking_mm = shown.worst_tracking_mm.max(error_mm);
                }
                _ => {
                    shown.holding += 1;
                    shown.worst_holding_mm = shown.worst_holding_mm.max(error_mm);
                }
            }
        }
    }
    shown.tracking = tracking as f32 / asked as f32;
    shown
}

fn script(text: &str) -> Script {
    Script::parse("test", &format!("{text}\nends 40s")).expect("a script")
}

/// One eye's worth of the trackers that the tests are about.
const SMI_LIKE: &str = "rate 60\nblinks zeros\nnoise 0.03mm\nconfidence none\nmissing 1%\n0s pupil 4.5mm\n\
                        1.5s every 6s blink 150ms\n3.51s every 6s blink 260ms\n5.523s every 6s blink 100ms";
const EYELINK_LIKE: &str = "rate 500\nblinks zeros\nnoise 0.008mm\nconfidence none\napart 0.1mm\n0s pupil 4.5mm\n\
                            1.5s every 6s blink 150ms\n3.511s every 6s blink 260ms\n5.523s every 6s blink 100ms";
const CORE_LIKE: &str = "rate 123\nfree-running\nnoise 0.04mm\n0s pupil 4mm\n2s every 5s blink 200ms\n\
                         3s every 7s unsure 0.3 300ms\n3s every 7s reads -0.1mm 150ms\n3.15s every 7s reads 16.66mm 150ms\n\
                         5s every 11s reads 22mm 400ms";

#[test]
fn blinks_of_zeros_never_leak() {
    for (text, least_tracking) in [(SMI_LIKE, 0.80), (EYELINK_LIKE, 0.80)] {
        let shown = shown(script(text), settings(rig::Eye::Left));
        assert!(shown.spoilt > 50 && shown.of(Rejection::Lost) > 50, "the blinks are there");
        assert!(shown.worst_tracking_mm < 0.35, "{text}: {}", shown.worst_tracking_mm);
        assert!(shown.worst_holding_mm < 0.35, "{text}: {}", shown.worst_holding_mm);
        assert!(shown.tracking > least_tracking, "{text}: {}", shown.tracking);
    }
}

/// Every two seconds a lid covers `depth_mm` of the pupil, comes at `mm_per_s`, stays for 80 ms and goes at `mm_per_s`;
/// the tracker says nothing of it.
fn lidded(text: &str, mm_per_s: f64, depth_mm: f64) -> impl Iterator<Item = MockSample> {
    MockSource::of(script(text)).map(move |mut mock| {
        let since_s = (mock.sample.t_sample.seconds() - 1.5).rem_euclid(2.0);
        let comes_s = depth_mm / mm_per_s;
        let covered = (since_s / comes_s).min((2.0 * comes_s + 0.08 - since_s) / comes_s).clamp(0.0, 1.0);
        mock.sample.diameter_mm -= (covered * depth_mm) as f32;
        mock
    })
}

const QUIET: &str = "rate 500\nnoise 0.008mm\nconfidence none\neyes L\n0s pupil 4mm";

#[test]
fn a_slow_lid_of_which_nobody_tells_is_not_followed() {
    for (mm_per_s, depth_mm) in [(12.0, 1.0), (16.0, 1.0), (16.0, 1.5)] {
        let shown = shown_of(lidded(QUIET, mm_per_s, depth_mm), settings(rig::Eye::Left));
        let worst_mm = shown.worst_tracking_mm.max(shown.worst_holding_mm);
        // A part of its way is within what noise explains, and is run on for the wait and the time ahead.
        assert!(worst_mm < 0.6, "{mm_per_s} mm/s, {depth_mm} mm: {worst_mm}");
        assert!(shown.tracking > 0.8, "{mm_per_s} mm/s, {depth_mm} mm: {}", shown.tracking);
    }
}

/// What lies in the noise of one sample is followed for a while, and run on where the eye is lost then.
#[test]
fn samples_of_the_pupil_are_believed_again_soon_after_a_lid_was_followed() {
    let noisy = "rate 1000\nnoise 0.02mm\nconfidence none\neyes L\n0s pupil 4mm";
    for (text, mm_per_s) in [(QUIET, 25.0), (noisy, 16.0), (noisy, 25.0)] {
        let shown = shown_of(lidded(text, mm_per_s, 0.5), settings(rig::Eye::Left));
        // Nineteen dips in 39 s, of 0.1 s each, with guards of 0.08 s.
        assert!(shown.tracking > 0.88, "{mm_per_s} mm/s: {}", shown.tracking);
        let worst_mm = shown.worst_tracking_mm.max(shown.worst_holding_mm);
        assert!(worst_mm < 1.1, "{mm_per_s} mm/s: {worst_mm}");
    }
}

#[test]
fn a_reflex_is_followed_as_soon_as_before_its_blink_and_after_it() {
    let reflex = "0s light 1cd\n2.5s every 8s light 1000cd\n6.5s every 8s light 1cd";
    for rate in ["rate 200\nnoise 0.05mm", "rate 500\nnoise 0.008mm", "rate 1000\nnoise 0.02mm"] {
        let text = format!("{rate}\nconfidence none\neyes L\n{reflex}");
        let alone = shown(script(&text), settings(rig::Eye::Left));
        assert_eq!((alone.holding, alone.of(Rejection::Slew)), (0, 0), "{rate}");
        assert!(alone.worst_tracking_mm < 0.4, "{rate}: {}", alone.worst_tracking_mm);
        // The constriction begins at 2.68 s; the blink is in the midst of it.
        let blinks = shown(script(&format!("{text}\n2.9s every 8s blink 150ms")), settings(rig::Eye::Left));
        assert!(blinks.of(Rejection::OutOfReach) + blinks.of(Rejection::Slew) > 20, "{rate}: the blinks are there");
        assert!(blinks.tracking > 0.93, "{rate}: {}", blinks.tracking);
        assert!(blinks.worst_holding_mm < 0.8 && blinks.worst_tracking_mm < 0.8, "{rate}: {}", blinks.worst_holding_mm);
    }
}

#[test]
fn the_judge_sees_a_gate_that_lets_all_pass() {
    let mut open = settings(rig::Eye::Left);
    open.gate = GateSettings {
        least_mm: 0.0,
        slew_mm_per_s: 1e6,
        reach_mm: 20.0,
        lead: TimeNs(0),
        trail: TimeNs(0),
        ..open.gate
    };
    for text in [SMI_LIKE, EYELINK_LIKE] {
        let shown = shown(script(text), open);
        assert!(shown.worst_tracking_mm.max(shown.worst_holding_mm) > 0.6, "{text}: {}", shown.worst_tracking_mm);
    }
    let shown = shown_of(lidded(QUIET, 12.0, 1.0), open);
    assert!(shown.worst_tracking_mm > 0.9, "{}", shown.worst_tracking_mm);
}

#[test]
fn low_confidence_and_wrong_eye_models_never_leak() {
    for eye in [rig::Eye::Left, rig::Eye::Better, rig::Eye::Both] {
        let shown = shown(script(CORE_LIKE), settings(eye));
        assert!(shown.of(Rejection::LowConfidence) > 100 && shown.of(Rejection::OutOfRange) > 100);
        // The right pupil is 0.2 mm narrower, and the mean 0.1 mm.
        assert!(shown.worst_tracking_mm < 0.5, "{eye:?}: {}", shown.worst_tracking_mm);
        assert!(shown.worst_holding_mm < 0.5, "{eye:?}: {}", shown.worst_holding_mm);
        assert!(shown.tracking > 0.7, "{eye:?}: {}", shown.tracking);
    }
}

#[test]
fn a_squinting_eye_is_followed_between_its_blinks() {
    let shown = shown(
        Script::parse("squint", &format!("{}\nends 40s", Scenario::Squint.text())).expect("a script"),
        settings(rig::Eye::Left),
    );
    assert!(shown.of(Rejection::LidsClosed) > 200);
    assert!(shown.tracking > 0.80, "{}", shown.tracking);
    assert!(shown.worst_tracking_mm < 0.3 && shown.worst_holding_mm < 0.3);
}

#[test]
fn an_eye_that_begins_to_squint_is_lost_for_a_moment_only() {
    let text = "aperture 8mm\nconfidence none\n0s pupil 2.5mm\n10s squint 2.6mm 20s\n12s every 3s blink 200ms";
    let shown = shown(script(text), settings(rig::Eye::Left));
    assert!(shown.tracking > 0.85, "{}", shown.tracking);
    assert!(shown.worst_tracking_mm < 0.35 && shown.worst_holding_mm < 0.35);
}

#[test]
fn coarse_pixels_are_noise_and_no_steps() {
    let shown = shown(script("noise 0.08mm\ngrain 0.12mm\nconfidence none\n0s pupil 4mm"), settings(rig::Eye::Left));
    assert!(shown.tracking > 0.99, "{}", shown.tracking);
    assert_eq!(shown.holding, 0);
    assert!(shown.worst_tracking_mm < 0.3, "{}", shown.worst_tracking_mm);
}

#[test]
fn a_wrong_eye_model_that_looks_right_is_believed_in_the_end_and_left_again() {
    // Nothing tells 1.2 mm more for four seconds from a pupil that changed unseen.
    let shown = shown(script("confidence none\n0s pupil 4mm\n10s jump 1.2mm 4s"), settings(rig::Eye::Left));
    assert!(shown.worst_tracking_mm > 1.0);
    assert!((0.95..0.98).contains(&shown.tracking), "{}", shown.tracking);
}

#[test]
fn a_loss_is_held_slides_to_the_fallback_and_slides_back() {
    let mut estimator = Estimator::new(settings(rig::Eye::Both));
    let mut states = Vec::new();
    let mut shown: Vec<(i64, f32)> = Vec::new();
    let mut samples = MockSource::of(script("hippus 0mm\n0s pupil 5mm\n5s lost 5s")).map(|mock| mock.sample).peekable();
    for t_ms in 0..15_000 {
        let t = TimeNs(t_ms * 1_000_000);
        while let Some(sample) = samples.next_if(|sample| sample.t_sample <= t) {
            estimator.push(sample, |_| {});
        }
        let estimate = estimator.pupil_at(t);
        shown.push((t_ms, estimate.pupil.mm()));
        if states.last() != Some(&estimate.state) {
            states.push(estimate.state);
        }
    }
    use PupilState::{Acquiring, Fallback, Holding, Tracking};
    assert_eq!(states, [Fallback, Tracking, Holding, Fallback, Acquiring, Tracking]);
    let at = |t_ms: usize| shown[t_ms].1;
    assert!((at(4900) - 5.0).abs() < 0.1 && (at(5900) - 5.0).abs() < 0.1 && (at(9900) - 3.0).abs() < 1e-3);
    assert!((at(14_000) - 5.0).abs() < 0.1);
    // The way back is 4 mm/s, and what the noise of the first samples adds; the first one of all was shown at once.
    let fastest = worst(shown[500..].windows(51).map(|window| (window[50].1 - window[0].1).abs() / 0.05));
    assert!((3.9..6.5).contains(&fastest), "{fastest} mm/s");
}

/// The neighbourhood of two blinks of a real 60 Hz recording: lost samples are 0.00, and their neighbours are low.
#[test]
fn the_low_neighbours_of_lost_samples_are_not_believed() {
    let blinks: [&[f32]; 3] = [
        &[3.16, 0.0, 0.0, 0.0, 2.96, 4.3],
        &[4.35, 2.96, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.96, 3.9],
        &[4.1, 0.0, 3.9],
    ];
    let blinks = blinks.map(|blink| [&[4.5; 90][..], blink].concat());
    let diameters = std::iter::repeat_n([4.5; 90].as_slice(), 1).chain(blinks.iter().map(Vec::as_slice)).flatten();
    // 15.55 to 34.01 ms from sample to sample.
    let intervals_us = [16_700, 15_550, 17_100, 16_700, 34_010, 16_700, 16_650];
    for intervals_us in [&[16_667][..], &intervals_us] {
        let mut estimator = Estimator::new(settings(rig::Eye::Left));
        let (mut t, mut accepted) = (TimeNs(0), 0);
        for (k, &diameter_mm) in diameters.clone().enumerate() {
            t = t + TimeNs(intervals_us[k % intervals_us.len()] * 1000);
            let sample = PupilSample {
                t_device: t,
                t_sample: t,
                t_arrival: t,
                eye: SampleEye::Left,
                diameter_mm,
                confidence: 1.0,
                aperture_mm: None,
                sequence: None,
                valid: diameter_mm > 0.0,
            };
            estimator.push(sample, |decision| {
                if decision.verdict == Verdict::Accepted {
                    accepted += 1;
                    assert!(decision.sample.diameter_mm >= 4.3, "{} mm is believed", decision.sample.diameter_mm);
                }
            });
            let shown_mm = estimator.pupil_at(t).pupil.mm();
            assert!(k < 30 || (4.4..4.6).contains(&shown_mm), "sample {k}: {shown_mm} mm");
        }
        assert!(accepted > 300, "{accepted}");
    }
}
