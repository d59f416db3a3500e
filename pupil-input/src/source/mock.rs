//! A made-up eye and tracker: the pupil's light reflex, hippus, blinks, dropouts and sensor noise, the same for the same
//! seed, with the true diameter beside each sample.
//!
//! The reflex waits 0.19 s, constricts at up to 5.5 mm/s and dilates again at up to 1.3 mm/s. In a blink the diameter
//! collapses with the lids while the tracker goes on giving millimetres, as real ones do, with low confidence.

use std::f64::consts::TAU;

use holod_calibration::TimeNs;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::{PupilSample, SampleEye};

/// A scenario by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Scenario {
    /// Light on and off every two seconds, a blink now and then.
    #[default]
    LightSteps,
    /// From 6 mm to 2 mm and back in 8 s, with a blink on the way; again and again.
    Sweep,
    /// Even light: hippus and noise only.
    Steady,
    /// Even light and a blink every 1.5 s, of various lengths.
    Blinks,
    /// Light steps, and a tracker that falls silent for 0.3 s to 3 s.
    Dropouts,
}

impl Scenario {
    /// Every scenario.
    pub const ALL: [Self; 5] = [Self::LightSteps, Self::Sweep, Self::Steady, Self::Blinks, Self::Dropouts];

    /// The name used in tracker specs.
    pub const fn name(self) -> &'static str {
        match self {
            Self::LightSteps => "light-steps",
            Self::Sweep => "sweep",
            Self::Steady => "steady",
            Self::Blinks => "blinks",
            Self::Dropouts => "dropouts",
        }
    }

    /// The scenario of that name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scenario| scenario.name() == name)
    }

    /// The diameter at which the pupil would settle under the light at `t_s`, mm.
    fn settled_mm(self, t_s: f64) -> f64 {
        match self {
            Self::Steady | Self::Blinks => 4.0,
            Self::LightSteps | Self::Dropouts => [5.0, 2.8, 4.4, 3.4][(t_s / 2.0) as usize % 4],
            // Full light for a little over two seconds of every eight.
            Self::Sweep => {
                if (0.8..2.9).contains(&(t_s % 8.0)) {
                    1.9
                } else {
                    6.4
                }
            }
        }
    }

    fn first_mm(self) -> f64 {
        if self == Self::Sweep { 6.0 } else { self.settled_mm(0.0) }
    }

    /// Begin and length of the blink that is nearest behind `t_s`, seconds.
    fn blink(self, t_s: f64) -> Option<(f64, f64)> {
        let (period_s, first_s, lengths_s) = match self {
            Self::Steady => return None,
            Self::LightSteps | Self::Dropouts => (3.5, 3.1, [0.20, 0.25, 0.18]),
            Self::Sweep => (8.0, 5.2, [0.23, 0.20, 0.26]),
            Self::Blinks => (1.5, 1.0, [0.15, 0.24, 0.38]),
        };
        let number = ((t_s - first_s) / period_s).floor();
        (number >= 0.0).then(|| (first_s + number * period_s, lengths_s[number as usize % 3]))
    }

    fn silent(self, t_s: f64) -> bool {
        let spans = [(3.9, 0.3), (6.5, 0.8), (10.0, 3.0)];
        self == Self::Dropouts && spans.iter().any(|(begin, length)| (*begin..begin + length).contains(&(t_s % 16.0)))
    }
}

/// A sample and the truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MockSample {
    /// What the tracker says; all three times are the scenario's own, from 0.
    pub sample: PupilSample,
    /// The true diameter of that eye at that time, mm.
    pub truth_mm: f32,
}

/// Time between a pair of samples.
pub const MOCK_INTERVAL: TimeNs = TimeNs(5_000_000);
const LATENCY_S: f64 = 0.19;
const CONSTRICTION_MM_PER_S: f64 = 5.5;
const DILATION_MM_PER_S: f64 = 1.3;
/// How long the iris takes to reach a speed.
const ACCELERATES_S: f64 = 0.04;
const NOISE_MM: f64 = 0.05;
/// The left pupil is this much wider than the mean, the right one narrower.
const HALF_ANISOCORIA_MM: f64 = 0.1;
const OPEN_APERTURE_MM: f64 = 8.0;
const LID_CLOSES_S: f64 = 0.045;
const LID_OPENS_S: f64 = 0.10;

/// Samples of both eyes at 200 Hz, without end.
#[derive(Clone, Debug)]
pub struct MockSource {
    scenario: Scenario,
    apertures: bool,
    confidences: bool,
    random: Pcg64Mcg,
    hippus: [(f64, f64, f64); 3],
    diameter_mm: f64,
    velocity_mm_per_s: f64,
    tick: u64,
    right: Option<MockSample>,
}

impl MockSource {
    /// The scenario from its beginning. The tracker tells confidence but no lid aperture.
    pub fn new(scenario: Scenario, seed: u64) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        // Hippus: slow unrest of a tenth of a millimetre or so.
        let hippus = [(0.05, 0.21), (0.035, 0.47), (0.02, 1.1)]
            .map(|(amplitude_mm, frequency_hz)| (amplitude_mm, frequency_hz, random.random_range(0.0..TAU)));
        Self {
            scenario,
            apertures: false,
            confidences: true,
            random,
            hippus,
            diameter_mm: scenario.first_mm(),
            velocity_mm_per_s: 0.0,
            tick: 0,
            right: None,
        }
    }

    /// The same with a tracker that tells lid apertures.
    #[must_use]
    pub const fn with_apertures(mut self) -> Self {
        self.apertures = true;
        self
    }

    /// The same with a tracker that is always sure of itself.
    #[must_use]
    pub const fn without_confidence(mut self) -> Self {
        self.confidences = false;
        self
    }

    /// Advances the pupil by one interval in steps of a millisecond.
    fn advance(&mut self) {
        let step_s = 1e-3;
        let began_s = self.tick as f64 * MOCK_INTERVAL.seconds();
        for step in 0..MOCK_INTERVAL.0 / 1_000_000 {
            let t_s = began_s + step as f64 * step_s;
            let settled_mm = self.scenario.settled_mm((t_s - LATENCY_S).max(0.0));
            let away_mm = settled_mm - self.diameter_mm;
            let wanted = if away_mm < 0.0 {
                (away_mm / 0.15).max(-CONSTRICTION_MM_PER_S)
            } else {
                (away_mm / 0.4).min(DILATION_MM_PER_S)
            };
            self.velocity_mm_per_s += (wanted - self.velocity_mm_per_s) * step_s / ACCELERATES_S;
            self.diameter_mm += self.velocity_mm_per_s * step_s;
        }
    }

    fn pair(&mut self) -> [MockSample; 2] {
        let t = TimeNs(self.tick as i64 * MOCK_INTERVAL.0);
        let t_s = t.seconds();
        let hippus_mm: f64 = self.hippus.iter().map(|(a, f, phase)| a * (TAU * f * t_s + phase).sin()).sum();
        let open = self.lid_open(t_s);
        [(SampleEye::Left, HALF_ANISOCORIA_MM), (SampleEye::Right, -HALF_ANISOCORIA_MM)].map(|(eye, offset_mm)| {
            let truth_mm = self.diameter_mm + hippus_mm + offset_mm;
            // Under a lid the fit has little to hold on to: it follows the slit and scatters.
            let fitted_mm = truth_mm * (0.45 + 0.55 * (open / 0.7).min(1.0));
            let scatter_mm = NOISE_MM + 0.35 * (1.0 - (open / 0.5).min(1.0));
            let measured_mm = (fitted_mm + scatter_mm * self.normal()).max(0.1);
            let noise = 0.03 * self.normal().abs();
            let sure = if self.confidences { (open * 1.6).min(1.0) - noise } else { 1.0 };
            let aperture_mm = OPEN_APERTURE_MM * open + 0.1 * self.normal().abs();
            MockSample {
                sample: PupilSample {
                    t_device: t,
                    t_sample: t,
                    t_arrival: t,
                    eye,
                    diameter_mm: measured_mm as f32,
                    confidence: sure.clamp(0.0, 1.0) as f32,
                    aperture_mm: self.apertures.then_some(aperture_mm as f32),
                    sequence: Some(self.tick),
                    valid: true,
                },
                truth_mm: truth_mm as f32,
            }
        })
    }

    /// 1 open, 0 closed.
    fn lid_open(&self, t_s: f64) -> f64 {
        let Some((begin_s, length_s)) = self.scenario.blink(t_s) else { return 1.0 };
        let since_s = t_s - begin_s;
        let closing = 1.0 - since_s / LID_CLOSES_S;
        let opening = (since_s - (length_s - LID_OPENS_S)) / LID_OPENS_S;
        closing.max(opening).clamp(0.0, 1.0)
    }

    /// A normal deviate (Box and Muller 1958).
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.random.random::<f64>()).ln()).sqrt();
        radius * (TAU * self.random.random::<f64>()).cos()
    }
}

impl Iterator for MockSource {
    type Item = MockSample;

    fn next(&mut self) -> Option<MockSample> {
        if let Some(right) = self.right.take() {
            return Some(right);
        }
        loop {
            let [left, right] = self.pair();
            self.advance();
            self.tick += 1;
            if !self.scenario.silent(left.sample.t_sample.seconds()) {
                self.right = Some(right);
                return Some(left);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seconds(scenario: Scenario, seed: u64, seconds: f64) -> Vec<MockSample> {
        MockSource::new(scenario, seed)
            .take_while(|mock| mock.sample.t_sample < TimeNs::from_seconds(seconds))
            .collect()
    }

    fn left(samples: &[MockSample]) -> impl Iterator<Item = &MockSample> {
        samples.iter().filter(|mock| mock.sample.eye == SampleEye::Left)
    }

    #[test]
    fn a_seed_tells_all() {
        assert_eq!(seconds(Scenario::LightSteps, 1, 10.0), seconds(Scenario::LightSteps, 1, 10.0));
        assert_ne!(seconds(Scenario::LightSteps, 1, 10.0), seconds(Scenario::LightSteps, 2, 10.0));
    }

    #[test]
    fn the_reflex_waits_then_peaks_at_the_physiological_speed() {
        let samples = seconds(Scenario::LightSteps, 3, 4.0);
        let truth: Vec<_> = left(&samples).map(|mock| (mock.sample.t_sample.seconds(), mock.truth_mm)).collect();
        let at = |t_s: f64| truth.iter().find(|(t, _)| *t >= t_s).expect("within").1;
        // The light comes on at 2 s; hippus moves a little all the while.
        assert!((at(2.18) - at(2.0)).abs() < 0.1);
        assert!(at(2.45) < at(2.18) - 0.5);
        let fastest = truth.windows(2).map(|w| f64::from(w[1].1 - w[0].1) / (w[1].0 - w[0].0)).fold(0.0, f64::min);
        assert!((-6.1..-4.9).contains(&fastest), "{fastest}");
    }

    #[test]
    fn the_sweep_is_wide() {
        let samples = seconds(Scenario::Sweep, 4, 8.0);
        let (least, most) =
            left(&samples).fold((f32::MAX, 0.0_f32), |(a, b), mock| (a.min(mock.truth_mm), b.max(mock.truth_mm)));
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
    }

    #[test]
    fn dropouts_are_silent_and_times_go_on() {
        let samples = seconds(Scenario::Dropouts, 6, 14.0);
        let times: Vec<_> = left(&samples).map(|mock| mock.sample.t_sample).collect();
        let longest = times.windows(2).map(|w| (w[1] - w[0]).seconds()).fold(0.0, f64::max);
        assert!((2.9..3.1).contains(&longest));
        assert!(times.is_sorted());
    }
}
