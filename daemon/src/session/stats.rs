//! Medians of what came lately.

use serde::{Deserialize, Serialize};

const WINDOW: usize = 1 << 14;

/// The newest values of a quantity.
#[derive(Clone, Debug, Default)]
pub(super) struct Recent {
    values: Vec<f32>,
    next: usize,
}

/// Median and tail of a quantity, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Half of the values are smaller.
    pub median_ms: f32,
    /// 99 of 100 values are smaller.
    pub p99_ms: f32,
    /// The largest.
    pub max_ms: f32,
}

impl Recent {
    /// Takes note of a value; the oldest is forgotten after 16384.
    pub(super) fn push(&mut self, value_ms: f32) {
        if self.values.len() < WINDOW {
            self.values.push(value_ms);
        } else {
            self.values[self.next] = value_ms;
        }
        self.next = (self.next + 1) % WINDOW;
    }

    /// Nothing where there are no values.
    pub(super) fn spread(&self) -> Option<Spread> {
        let mut sorted = self.values.clone();
        sorted.sort_by(f32::total_cmp);
        let last = sorted.len().checked_sub(1)?;
        let at = |share: f64| sorted[(last as f64 * share).round() as usize];
        Some(Spread { median_ms: at(0.5), p99_ms: at(0.99), max_ms: sorted[last] })
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
        assert_eq!(recent.spread(), Some(Spread { median_ms: 50.0, p99_ms: 99.0, max_ms: 100.0 }));
    }

    #[test]
    fn old_values_are_forgotten() {
        let mut recent = Recent::default();
        recent.push(1e9);
        for _ in 0..WINDOW {
            recent.push(1.0);
        }
        assert_eq!(recent.spread().unwrap().max_ms, 1.0);
        assert_eq!(recent.values.len(), WINDOW);
    }
}
