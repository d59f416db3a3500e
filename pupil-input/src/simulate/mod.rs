//! A simulated eye before a simulated tracker: the pupil's light reflex, hippus, blinks, dropouts, sensor noise and the
//! tracker's clock and link, the same for the same seed, with the true diameter beside each sample.
//!
//! What happens is told by a [`Script`]: the built-in ones are `scenarios/*.txt`, and `mock:FILE` reads one from a
//! file. In a blink the diameter collapses with the lids while the tracker goes on giving millimetres, as real ones do,
//! with low confidence; or, if the script says so, it ramps down and is then 0 and lost.

mod eye;
mod script;

use std::f64::consts::TAU;

use holod_calibration::TimeNs;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::{PupilSample, SampleEye};
use eye::{Iris, lid_open};
use script::What;
pub use script::{Script, ScriptError};

/// Seed of the `mock` tracker.
pub const MOCK_SEED: u64 = 1;

/// A built-in scenario by name.
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
    /// The light reflex from dusk to a bright sky.
    Reflex,
    /// A small pupil behind lids that are nearly shut, and a tracker that tells their distance.
    Squint,
}

impl Scenario {
    /// Every scenario, in the order in which messages list them.
    pub const ALL: [Self; 7] =
        [Self::LightSteps, Self::Sweep, Self::Steady, Self::Blinks, Self::Dropouts, Self::Reflex, Self::Squint];

    /// The name used in tracker specs.
    pub const fn name(self) -> &'static str {
        match self {
            Self::LightSteps => "light-steps",
            Self::Sweep => "sweep",
            Self::Steady => "steady",
            Self::Blinks => "blinks",
            Self::Dropouts => "dropouts",
            Self::Reflex => "reflex",
            Self::Squint => "squint",
        }
    }

    /// The scenario of that name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scenario| scenario.name() == name)
    }

    /// The script of the scenario, as its file in `scenarios/` has it.
    pub const fn text(self) -> &'static str {
        match self {
            Self::LightSteps => include_str!("../../scenarios/light-steps.txt"),
            Self::Sweep => include_str!("../../scenarios/sweep.txt"),
            Self::Steady => include_str!("../../scenarios/steady.txt"),
            Self::Blinks => include_str!("../../scenarios/blinks.txt"),
            Self::Dropouts => include_str!("../../scenarios/dropouts.txt"),
            Self::Reflex => include_str!("../../scenarios/reflex.txt"),
            Self::Squint => include_str!("../../scenarios/squint.txt"),
        }
    }

    /// The script of the scenario, ready to be simulated.
    pub fn script(self) -> Script {
        Script::parse(self.name(), self.text()).expect("the built-in scenarios are tested")
    }
}

/// A sample and the truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MockSample {
    /// What the tracker says. `t_sample` is the scenario's own time, from 0; `t_device` and `t_arrival` are what the
    /// simulated clock and link make of it.
    pub sample: PupilSample,
    /// The true diameter of that eye at that time, mm; the mean of the eyes for [`SampleEye::Both`].
    pub truth_mm: f32,
}

/// One of free-running cameras is slower than the other by this share.
const FREE_RUNNING_SLOWER: f64 = 0.003;

/// Samples in order of time, without end unless the script ends.
#[derive(Clone, Debug)]
pub struct MockSource {
    script: Script,
    random: Pcg64Mcg,
    iris: Iris,
    /// Running number of each eye's next sample, in the order of [`Script`]'s eyes.
    ticks: [u64; 2],
    t_last_arrival: TimeNs,
}

impl MockSource {
    /// A built-in scenario from its beginning, with a seed.
    pub fn new(scenario: Scenario, seed: u64) -> Self {
        Self::of(Script { seed, ..scenario.script() })
    }

    /// A script from its beginning.
    pub fn of(script: Script) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(script.seed);
        let iris = Iris::new(&script, &mut random);
        Self { script, random, iris, ticks: [0; 2], t_last_arrival: TimeNs(i64::MIN) }
    }

    /// The same with a tracker that is always sure of itself.
    #[must_use]
    pub const fn without_confidence(mut self) -> Self {
        self.script.confidence_told = false;
        self
    }

    /// When the `index`th eye's next sample is taken, in seconds.
    fn next_s(&self, index: usize) -> f64 {
        let period_s = 1.0 / self.script.rate_hz;
        if index == 1 && self.script.free_running {
            (self.ticks[index] as f64 + 0.4) * period_s * (1.0 + FREE_RUNNING_SLOWER)
        } else {
            self.ticks[index] as f64 * period_s
        }
    }

    fn measure(&mut self, eye: SampleEye, t_s: f64, sequence: u64) -> MockSample {
        let Self { script, random, iris, .. } = self;
        let offset_mm = match eye {
            SampleEye::Left => 0.5 * script.apart_mm,
            SampleEye::Right => -0.5 * script.apart_mm,
            SampleEye::Both => 0.0,
        };
        let truth_mm = iris.at(t_s, &script.events) + offset_mm;
        let open = lid_open(&script.events, t_s);
        let mut normal = || normal(random);
        let (mut measured_mm, mut valid) = if script.zeros_in_blinks {
            // The lid reaches the pupil when it is not yet half closed, and soon little is left of it.
            let seen = ((open - 0.25) / 0.35).clamp(0.0, 1.0);
            let noisy_mm = truth_mm + script.noise_mm * normal();
            if seen < 0.1 { (0.0, false) } else { (noisy_mm * seen.sqrt(), true) }
        } else {
            // Under a lid the fit has little to hold on to: it follows the slit and scatters.
            let fitted_mm = truth_mm * (0.45 + 0.55 * (open / 0.7).min(1.0));
            let scatter_mm = script.noise_mm + 0.35 * (1.0 - (open / 0.5).min(1.0));
            ((fitted_mm + scatter_mm * normal()).max(0.1), true)
        };
        let noise = 0.03 * normal().abs();
        let mut confidence = if script.confidence_told { (open * 1.6).min(1.0) - noise } else { 1.0 };
        let lids = 0.1 * normal().abs();
        let mut aperture_mm = script.aperture_mm.map(|open_mm| open_mm * open + lids);
        for event in &script.events {
            let within = |lasts_s: f64| event.since_s(t_s).is_some_and(|since_s| since_s < lasts_s);
            match event.what {
                What::Squint { aperture_mm: greatest_mm, lasts_s } if within(lasts_s) => {
                    aperture_mm = aperture_mm.map(|aperture_mm| aperture_mm.min(greatest_mm * open + lids));
                }
                What::Zeros { lasts_s } if within(lasts_s) => (measured_mm, valid) = (0.0, false),
                What::Unsure { confidence: unsure, lasts_s } if within(lasts_s) => confidence = unsure,
                What::Reads { diameter_mm, lasts_s } if within(lasts_s) => measured_mm = diameter_mm,
                What::Jump { by_mm, lasts_s } if within(lasts_s) => measured_mm += by_mm,
                _ => {}
            }
        }
        if script.grain_mm > 0.0 {
            measured_mm = (measured_mm / script.grain_mm).round() * script.grain_mm;
        }
        let t_sample = TimeNs::from_seconds(t_s);
        MockSample {
            sample: PupilSample {
                t_device: device_time(script, t_s),
                t_sample,
                t_arrival: self.arrival(t_s).max(t_sample),
                eye,
                diameter_mm: measured_mm as f32,
                confidence: confidence.clamp(0.0, 1.0) as f32,
                aperture_mm: aperture_mm.map(|aperture_mm| aperture_mm as f32),
                sequence: Some(sequence),
                valid,
            },
            truth_mm: truth_mm as f32,
        }
    }

    /// When a sample of `t_s` arrives; samples keep their order.
    fn arrival(&mut self, t_s: f64) -> TimeNs {
        let Script { delay_s, jitter_s, batch_s, .. } = self.script;
        let leaves_s = if batch_s > 0.0 { ((t_s / batch_s).floor() + 1.0) * batch_s } else { t_s };
        let jitter_s = if jitter_s > 0.0 { jitter_s * self.random.random::<f64>() } else { 0.0 };
        self.t_last_arrival = self.t_last_arrival.max(TimeNs::from_seconds(leaves_s + delay_s + jitter_s));
        self.t_last_arrival
    }

    fn silent(&self, t_s: f64) -> bool {
        self.script.events.iter().any(|event| match event.what {
            What::Lost { lasts_s } => event.since_s(t_s).is_some_and(|since_s| since_s < lasts_s),
            _ => false,
        })
    }
}

impl Iterator for MockSource {
    type Item = MockSample;

    /// None at the script's end, or where it is silent for more than an hour on end.
    fn next(&mut self) -> Option<MockSample> {
        let mut silent_from_s = None;
        loop {
            let eyes = self.script.eyes.len();
            let index = usize::from(eyes == 2 && self.next_s(1) < self.next_s(0));
            let (t_s, sequence) = (self.next_s(index), self.ticks[index]);
            if t_s >= self.script.ends_s || t_s - *silent_from_s.get_or_insert(t_s) > LONGEST_SILENCE_S {
                return None;
            }
            self.ticks[index] += 1;
            let missing = self.script.missing > 0.0 && self.random.random::<f64>() < self.script.missing;
            if !missing && !self.silent(t_s) {
                return Some(self.measure(self.script.eyes[index], t_s, sequence));
            }
        }
    }
}

/// A tracker that is silent for longer will not speak again.
const LONGEST_SILENCE_S: f64 = 3600.0;

/// What the tracker's clock says at `t_s`.
fn device_time(script: &Script, t_s: f64) -> TimeNs {
    let steps = script.events.iter().map(|event| match event.what {
        What::Steps(by_s) => by_s * event.times(t_s),
        _ => 0.0,
    });
    TimeNs::from_seconds(t_s + script.ahead_s + script.drift * t_s + steps.sum::<f64>())
}

/// A normal deviate (Box and Muller 1958).
fn normal(random: &mut Pcg64Mcg) -> f64 {
    let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
    radius * (TAU * random.random::<f64>()).cos()
}
