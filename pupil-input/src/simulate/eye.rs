//! The simulated eye: iris, hippus and lids.
//!
//! After a change of light the iris waits, constricts at up to 5.5 mm/s and dilates again at up to 1.3 mm/s. Where it
//! settles is Watson and Yellott's (2012) unified formula, for both eyes, their reference age and the field of the
//! default bench's display; for how long it waits is Link and Stark's (1988) latency for a single step, as Pamplona,
//! Oliveira and Baranoski (2009) use it.

use std::f64::consts::TAU;

use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use super::script::{Event, Script, What};

const CONSTRICTION_MM_PER_S: f64 = 5.5;
const DILATION_MM_PER_S: f64 = 1.3;
/// How long the iris takes to reach a speed.
const ACCELERATES_S: f64 = 0.04;
const STEP_S: f64 = 1e-3;
/// The latency to light of which only the settled diameter is given.
const LATENCY_S: f64 = 0.19;
/// 22.0° by 12.4°, in square degrees.
const FIELD_DEG2: f64 = 273.0;
const CD_PER_M2_IN_FOOTLAMBERT: f64 = 3.426;
/// Before anything else is said.
const FIRST_MM: f64 = 4.0;
/// Hippus: slow unrest of a tenth of a millimetre or so; share of the whole amplitude, and frequency in Hz.
const HIPPUS: [(f64, f64); 3] = [(0.48, 0.21), (0.33, 0.47), (0.19, 1.1)];
const LID_CLOSES_S: f64 = 0.045;
const LID_OPENS_S: f64 = 0.10;
/// How far open a half blink leaves the lids.
const HALF_OPEN: f64 = 0.4;

/// Diameter in mm at which the pupil settles under `luminance` cd/m² (Watson and Yellott 2012, equation 21).
pub(super) fn settled_mm(luminance_cd_per_m2: f64) -> f64 {
    let flux = (luminance_cd_per_m2 * FIELD_DEG2 / 846.0).powf(0.41);
    7.75 - 5.75 * flux / (flux + 2.0)
}

/// From a step to this luminance to the beginning of the pupil's answer.
pub(super) fn latency_s(luminance_cd_per_m2: f64) -> f64 {
    (0.253 - 0.014 * (luminance_cd_per_m2 / CD_PER_M2_IN_FOOTLAMBERT).ln()).clamp(0.18, 0.4)
}

/// The iris that both eyes share, advanced in steps of a millisecond.
#[derive(Clone, Debug)]
pub(super) struct Iris {
    hippus: [(f64, f64, f64); 3],
    steps: u64,
    before_mm: f64,
    diameter_mm: f64,
    velocity_mm_per_s: f64,
}

impl Iris {
    pub(super) fn new(script: &Script, random: &mut Pcg64Mcg) -> Self {
        let hippus = HIPPUS.map(|(share, hz)| (share * script.hippus_mm, hz, random.random_range(0.0..TAU)));
        let first_mm = script.starts_mm.unwrap_or_else(|| wanted_mm(&script.events, 0.0));
        Self { hippus, steps: 0, before_mm: first_mm, diameter_mm: first_mm, velocity_mm_per_s: 0.0 }
    }

    /// The mean diameter of the two eyes at `t_s`; times must not decrease.
    pub(super) fn at(&mut self, t_s: f64, events: &[Event]) -> f64 {
        while (self.steps as f64) * STEP_S < t_s {
            self.step(events);
        }
        let ahead = (self.steps as f64 - t_s / STEP_S).clamp(0.0, 1.0);
        let hippus_mm: f64 = self.hippus.iter().map(|(a, f, phase)| a * (TAU * f * t_s + phase).sin()).sum();
        self.diameter_mm + ahead * (self.before_mm - self.diameter_mm) + hippus_mm
    }

    fn step(&mut self, events: &[Event]) {
        let away_mm = wanted_mm(events, self.steps as f64 * STEP_S) - self.diameter_mm;
        let wanted = if away_mm < 0.0 {
            (away_mm / 0.15).max(-CONSTRICTION_MM_PER_S)
        } else {
            (away_mm / 0.4).min(DILATION_MM_PER_S)
        };
        self.velocity_mm_per_s += (wanted - self.velocity_mm_per_s) * STEP_S / ACCELERATES_S;
        self.before_mm = self.diameter_mm;
        self.diameter_mm += self.velocity_mm_per_s * STEP_S;
        self.steps += 1;
    }
}

/// Where the light that the iris answers to at `t_s` lets it settle: the newest light whose latency is over.
fn wanted_mm(events: &[Event], t_s: f64) -> f64 {
    let mut newest = (f64::INFINITY, FIRST_MM);
    for event in events {
        let (latency_s, mm) = match event.what {
            What::Light(luminance) => (latency_s(luminance), settled_mm(luminance)),
            What::Pupil(mm) => (LATENCY_S, mm),
            _ => continue,
        };
        // The eye is used to the light that there is at the beginning.
        if let Some(since_s) = event.since_s((t_s - latency_s).max(0.0))
            && since_s <= newest.0
        {
            newest = (since_s, mm);
        }
    }
    newest.1
}

/// How far the lids are open at `t_s`: 1 open, 0 closed.
pub(super) fn lid_open(events: &[Event], t_s: f64) -> f64 {
    let open = events.iter().filter_map(|event| {
        let What::Blink { lasts_s, half } = event.what else { return None };
        let since_s = event.since_s(t_s)?;
        let closing = 1.0 - since_s / LID_CLOSES_S;
        let opening = (since_s - (lasts_s - LID_OPENS_S)) / LID_OPENS_S;
        Some(closing.max(opening).clamp(if half { HALF_OPEN } else { 0.0 }, 1.0))
    });
    open.fold(1.0, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_settles_the_pupil_where_the_formula_says() {
        // The limits of the formula, and its value worked out by hand: (100·273/846)^0.41 = 4.155.
        assert!((settled_mm(1e-9) - 7.75).abs() < 0.01);
        assert!((settled_mm(1e9) - 2.0).abs() < 0.02);
        assert!((settled_mm(100.0) - (7.75 - 5.75 * 4.155 / 6.155)).abs() < 0.01, "{}", settled_mm(100.0));
    }

    #[test]
    fn brighter_light_is_answered_sooner() {
        assert!((latency_s(3.426) - 0.253).abs() < 1e-9);
        assert!(latency_s(300.0) < 0.2 && latency_s(300.0) > 0.18);
        assert_eq!(latency_s(1e6), 0.18);
    }
}
