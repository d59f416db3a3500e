//! Medians of what came lately.

use holod_calibration::{Sorted, TimeNs};

use crate::spread::Spread;

/// The newest values of a quantity, and the largest ever.
#[derive(Clone, Debug, Default)]
pub(super) struct Recent {
    values: Vec<f32>,
    next: usize,
    max_ms: f32,
    count: u64,
}

impl Recent {
    /// Takes note of a value; the oldest is forgotten after [`Spread::NEWEST`].
    pub(super) fn push(&mut self, value_ms: f32) {
        self.max_ms = if self.count == 0 { value_ms } else { self.max_ms.max(value_ms) };
        self.count += 1;
        if self.values.len() < Spread::NEWEST {
            self.values.push(value_ms);
        } else {
            self.values[self.next] = value_ms;
        }
        self.next = (self.next + 1) % Spread::NEWEST;
    }

    /// The same, where there is one.
    pub(super) fn extend(&mut self, value_ms: Option<f32>) {
        if let Some(value_ms) = value_ms {
            self.push(value_ms);
        }
    }

    /// Nothing where there are no values.
    pub(super) fn spread(&self) -> Option<Spread> {
        let sorted = Sorted::new(self.values.iter().copied().map(f64::from))?;
        let [median_ms, p99_ms] = [0.5, 0.99].map(|share| sorted.quantile(share) as f32);
        Some(Spread { median_ms, p99_ms, max_ms: self.max_ms, values: self.count })
    }
}

/// How many frames come on the panel a second, from one look to the next.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct FrameRate {
    before: Option<(u64, TimeNs)>,
}

impl FrameRate {
    /// Frames a second since the last call, of which `frames_shown` there are by `now`; not known at the first call.
    pub(super) fn at(&mut self, frames_shown: u64, now: TimeNs) -> Option<f64> {
        let (frames, t) = self.before.replace((frames_shown, now))?;
        Some((frames_shown - frames) as f64 / (now - t).seconds())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_of_a_known_series() {
        let mut recent = Recent::default();
        assert_eq!(recent.spread(), None);
        for value in (0..=100).rev() {
            recent.push(value as f32);
        }
        assert_eq!(recent.spread(), Some(Spread { median_ms: 50.0, p99_ms: 99.0, max_ms: 100.0, values: 101 }));
    }

    #[test]
    fn the_frame_rate_is_that_since_the_last_look() {
        let mut rate = FrameRate::default();
        let looks = [(0, 0), (60, 1_000), (90, 2_000), (90, 3_000)];
        let rates = looks.map(|(frames, ms)| rate.at(frames, TimeNs(ms * 1_000_000)));
        assert_eq!(rates, [None, Some(60.0), Some(30.0), Some(0.0)]);
    }

    #[test]
    fn old_values_are_forgotten_but_for_the_largest() {
        let mut recent = Recent::default();
        for _ in 0..Spread::NEWEST {
            recent.push(1e9);
        }
        for _ in 0..Spread::NEWEST {
            recent.push(1.0);
        }
        let values = 2 * Spread::NEWEST as u64;
        assert_eq!(recent.spread(), Some(Spread { median_ms: 1.0, p99_ms: 1.0, max_ms: 1e9, values }));
        assert_eq!(recent.values.len(), Spread::NEWEST);
    }
}
