//! A log like those of a Neon tracker, made from a seed, and the judge of estimates; shared by the tests.

use std::fmt::Write;

use holod_calibration::{TimeNs, rig};
use holod_pupil_input::{Estimator, EstimatorSettings, PupilEstimate, PupilSample, SampleEye};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// First time of the made-up log, on its own clock.
pub(crate) const NEON_BEGINS_NS: i64 = 1_700_000_000_000_000_000;
/// Begin of each made-up blink, after the first time.
pub(crate) const NEON_BLINKS_S: [f64; 2] = [1.5, 3.2];
/// Length of each made-up blink.
pub(crate) const NEON_BLINK_S: f64 = 0.24;

/// A Neon `3d_eye_states.csv` of 5 s at 200 Hz.
///
/// As in real ones: the first samples are frozen repeats; some intervals are two or three times as long; from about 25
/// ms after a blink's begin the left diameter scatters between 1.1 and 2.8 mm from sample to sample and the right one
/// lies quietly at 1.5 to 2.1 mm, until both come back over some 40 ms; only the lid aperture says so.
pub(crate) fn neon_like_csv(seed: u64) -> String {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut csv = String::from(
        "section id,recording id,timestamp [ns],pupil diameter left [mm],pupil diameter right [mm],\
         eyelid aperture left [mm],eyelid aperture right [mm]\n",
    );
    let mut t_ns = NEON_BEGINS_NS;
    for row in 0..1000 {
        let t_s = (t_ns - NEON_BEGINS_NS) as f64 * 1e-9;
        // A triangular deviate: as wide as the real noise, with bounded tails.
        let mut noise = |width: f64| width * (random.random::<f64>() + random.random::<f64>() - 1.0);
        let since_s = NEON_BLINKS_S.into_iter().map(|begin_s| t_s - begin_s).find(|s| (0.0..NEON_BLINK_S).contains(s));
        let shut = since_s.map_or(0.0, |s| ((s - 0.025) / 0.02).min((0.20 - s) / 0.04).clamp(0.0, 1.0));
        let slow = 0.08 * (3.0 * t_s).sin();
        let (open_left, open_right) = (3.72 + slow + noise(0.18), 3.36 + slow + noise(0.24));
        let (shut_left, shut_right) = (1.95 + noise(0.85), 1.8 + noise(0.3));
        let mix = |open: f64, closed: f64| open + shut * (closed - open);
        let lids = since_s.map_or(7.0, |s| 7.0 * (1.0 - s / 0.05).max((s - 0.13) / 0.25).clamp(0.0, 1.0));
        let (left, right) =
            if row < 6 { (3.70, 3.35) } else { (mix(open_left, shut_left), mix(open_right, shut_right)) };
        let (lid_left, lid_right) = (lids + 0.1 * noise(1.0).abs(), lids + 0.1 * noise(1.0).abs());
        writeln!(csv, "0,made-up,{t_ns},{left:.5},{right:.5},{lid_left:.5},{lid_right:.5}")
            .expect("a String takes all");
        t_ns += [5_000_000, 5_000_000, 4_984_000, 5_007_000][row % 4] * if row % 211 == 210 { 3 } else { 1 };
    }
    csv
}

/// Settings for one eye or both, otherwise the built-in bench's.
pub(crate) fn settings(eye: rig::Eye) -> EstimatorSettings {
    EstimatorSettings::from(&rig::Tracker { eye, ..rig::Rig::default().tracker })
}

/// Feeds `samples` and asks for the pupil at each sample's time and up to 40 ms ahead, as a frame loop does, from when
/// the slide from the fallback is over. The time beside an estimate is when it was asked for.
pub(crate) fn estimates(
    samples: impl IntoIterator<Item = PupilSample>,
    settings: EstimatorSettings,
) -> Vec<(TimeNs, PupilEstimate)> {
    let mut estimator = Estimator::new(settings);
    let mut out = Vec::new();
    let mut begins = None;
    for sample in samples {
        let begins = *begins.get_or_insert(sample.t_sample + TimeNs(300_000_000));
        estimator.push(sample, |_| {});
        for ahead_ms in [0, 8, 20, 40] {
            let t = sample.t_sample + TimeNs(ahead_ms * 1_000_000);
            if sample.t_sample >= begins {
                out.push((sample.t_sample, estimator.pupil_at(t)));
            }
        }
    }
    out
}

/// The judge: the first estimate below `least_mm`, if there is one.
pub(crate) fn first_below(estimates: &[(TimeNs, PupilEstimate)], least_mm: f32) -> Option<(TimeNs, f32)> {
    estimates.iter().map(|(t, estimate)| (*t, estimate.pupil.mm())).find(|(_, mm)| *mm < least_mm || mm.is_nan())
}

/// Least raw diameter of an eye.
pub(crate) fn least_raw(samples: &[PupilSample], eye: SampleEye) -> f32 {
    samples.iter().filter(|sample| sample.eye == eye).map(|sample| sample.diameter_mm).fold(f32::MAX, f32::min)
}

/// Root of the mean square; 0 of no values.
pub(crate) fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value * value, count + 1.0));
    (sum / f64::max(count, 1.0)).sqrt()
}
