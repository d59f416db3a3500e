//! The smoothed diameter of one eye: a Kalman filter of position and velocity whose velocity dies away.
//!
//! dx = v dt, dv = −v/τ dt + white acceleration. Between samples and beyond the newest one the position runs on by
//! v·τ·(1 − exp(−Δt/τ)): it extrapolates over the gate's latency and comes to rest where nothing more is heard, so a
//! hold needs no case of its own: a reflex goes on behind a blink. Whether the velocity may have been a lid's is for
//! the gate to judge. What is run on is less than the velocity v where that is small. (The integrated
//! Ornstein-Uhlenbeck model; Singer 1970 has it one derivative higher.)

use holod_calibration::TimeNs;

/// Tuning of the filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilterSettings {
    /// τ: how long a velocity lasts.
    pub velocity_lasts: TimeNs,
    /// Density of the white acceleration, mm/s² per √Hz: the higher, the quicker and the noisier.
    pub agility: f32,
    /// Fastest constriction believed, mm/s.
    pub constriction_mm_per_s: f32,
    /// Fastest dilation believed, mm/s.
    pub dilation_mm_per_s: f32,
    /// A velocity of this, mm/s, is run on beyond the newest sample by half, a slower one by less: small movements of a
    /// resting pupil have turned by then.
    pub steady_mm_per_s: f32,
    /// A filter that has heard nothing for this long starts anew.
    pub forgets: TimeNs,
}

impl Default for FilterSettings {
    fn default() -> Self {
        Self {
            velocity_lasts: TimeNs(200_000_000),
            agility: 5.0,
            constriction_mm_per_s: 7.0,
            dilation_mm_per_s: 4.0,
            steady_mm_per_s: 1.5,
            forgets: TimeNs(150_000_000),
        }
    }
}

/// Position and velocity at a time, and the law by which they go on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Motion {
    pub(crate) t: TimeNs,
    pub(crate) diameter_mm: f32,
    pub(crate) velocity_mm_per_s: f32,
    pub(crate) velocity_lasts: TimeNs,
}

impl Motion {
    /// The same motion at `t`; before its own time it stands still.
    pub(crate) fn at(&self, t: TimeNs) -> Self {
        let elapsed_s = (t - self.t).seconds().max(0.0) as f32;
        let tau_s = self.velocity_lasts.seconds() as f32;
        let decay = (-elapsed_s / tau_s).exp();
        Self {
            t,
            diameter_mm: self.diameter_mm + self.velocity_mm_per_s * tau_s * (1.0 - decay),
            velocity_mm_per_s: self.velocity_mm_per_s * decay,
            velocity_lasts: self.velocity_lasts,
        }
    }
}

/// The filter of one eye.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Filter {
    settings: FilterSettings,
    motion: Option<Motion>,
    /// Covariance [position², position·velocity, velocity²].
    covariance: [f32; 3],
}

impl Filter {
    pub(crate) const fn new(settings: FilterSettings) -> Self {
        Self { settings, motion: None, covariance: [0.0; 3] }
    }

    pub(crate) const fn motion(&self) -> Option<Motion> {
        self.motion
    }

    /// The motion as it is run on beyond the newest sample: by v²/(v² + `steady_mm_per_s`²) of its velocity v.
    pub(crate) fn outlook(&self) -> Option<Motion> {
        self.motion.map(|motion| {
            let (squared, steady) = (motion.velocity_mm_per_s.powi(2), self.settings.steady_mm_per_s.powi(2));
            let share = if squared > 0.0 { squared / (squared + steady) } else { 0.0 };
            Motion { velocity_mm_per_s: share * motion.velocity_mm_per_s, ..motion }
        })
    }

    /// Takes a believed sample of standard deviation `noise_mm`; times must not decrease.
    pub(crate) fn update(&mut self, t: TimeNs, diameter_mm: f32, noise_mm: f32) {
        let noise_variance = noise_mm * noise_mm;
        let Some(motion) = self.motion.filter(|motion| t - motion.t <= self.settings.forgets) else {
            self.motion =
                Some(Motion { t, diameter_mm, velocity_mm_per_s: 0.0, velocity_lasts: self.settings.velocity_lasts });
            self.covariance = [noise_variance, 0.0, 1.0];
            return;
        };

        let dt_s = (t - motion.t).seconds() as f32;
        let tau_s = self.settings.velocity_lasts.seconds() as f32;
        let decay = (-dt_s / tau_s).exp();
        let reach_s = tau_s * (1.0 - decay);
        let density = self.settings.agility * self.settings.agility;
        let [p_xx, p_xv, p_vv] = self.covariance;
        let predicted_xx = p_xx + 2.0 * reach_s * p_xv + reach_s * reach_s * p_vv + density * dt_s * dt_s * dt_s / 3.0;
        let predicted_xv = decay * (p_xv + reach_s * p_vv) + density * dt_s * dt_s / 2.0;
        let predicted_vv = decay * decay * p_vv + density * dt_s;

        let innovation_variance = predicted_xx + noise_variance;
        let gain_x = predicted_xx / innovation_variance;
        let gain_v = predicted_xv / innovation_variance;
        let predicted = motion.at(t);
        let innovation = diameter_mm - predicted.diameter_mm;
        self.motion = Some(Motion {
            diameter_mm: predicted.diameter_mm + gain_x * innovation,
            velocity_mm_per_s: (predicted.velocity_mm_per_s + gain_v * innovation)
                .clamp(-self.settings.constriction_mm_per_s, self.settings.dilation_mm_per_s),
            ..predicted
        });
        self.covariance = [
            (1.0 - gain_x) * predicted_xx,
            (1.0 - gain_x) * predicted_xv,
            (predicted_vv - gain_v * predicted_xv).max(0.0),
        ];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(diameter_mm: impl Fn(f64) -> f32, noise_mm: f32) -> Vec<(f64, f32, f32)> {
        let mut filter = Filter::new(FilterSettings::default());
        (0..400)
            .map(|k| {
                let t = TimeNs(k * 5_000_000);
                filter.update(t, diameter_mm(t.seconds()), noise_mm);
                let motion = filter.motion().expect("has a sample");
                (t.seconds(), motion.diameter_mm, motion.velocity_mm_per_s)
            })
            .collect()
    }

    #[test]
    fn a_still_pupil_is_still() {
        assert!(run(|_| 4.0, 0.06).iter().all(|&(_, x, v)| x == 4.0 && v == 0.0));
    }

    #[test]
    fn a_ramp_is_followed_with_its_velocity() {
        let (t, x, v) = *run(|t| 6.0 - 2.0 * t as f32, 0.06).last().expect("ran");
        assert!((f64::from(x) - (6.0 - 2.0 * t)).abs() < 0.05, "{x} at {t}");
        assert!((v + 2.0).abs() < 0.5, "{v}");
    }

    #[test]
    fn what_is_heard_no_more_comes_to_rest() {
        let motion = Motion {
            t: TimeNs(0),
            diameter_mm: 4.0,
            velocity_mm_per_s: -5.0,
            velocity_lasts: FilterSettings::default().velocity_lasts,
        };
        let rest = motion.at(TimeNs::from_seconds(10.0));
        assert!((rest.diameter_mm - 3.0).abs() < 1e-3);
        assert!(rest.velocity_mm_per_s.abs() < 1e-6);
        assert_eq!(motion.at(TimeNs(-5)).diameter_mm, 4.0);
    }

    #[test]
    fn motion_may_be_advanced_in_one_step_or_in_many() {
        let motion = Motion {
            t: TimeNs(0),
            diameter_mm: 4.0,
            velocity_mm_per_s: 3.0,
            velocity_lasts: FilterSettings::default().velocity_lasts,
        };
        let many = (1..=20).fold(motion, |motion, k| motion.at(TimeNs(k * 7_000_000)));
        let once = motion.at(TimeNs(140_000_000));
        assert!((many.diameter_mm - once.diameter_mm).abs() < 1e-5);
        assert!((many.velocity_mm_per_s - once.velocity_mm_per_s).abs() < 1e-5);
    }
}
