//! The rate that the run really reaches, said once it is known.

use holod_calibration::TimeNs;

/// The rate is known well enough to be said once this time has passed and this many frames have been shown since the
/// first.
const WATCHED: TimeNs = TimeNs(3_000_000_000);
const FRAMES: u64 = 2;

/// Waits for the rate of the first seconds.
#[derive(Debug, Default)]
pub(super) struct RateWatch {
    first: Option<(u64, TimeNs)>,
    told: bool,
}

impl RateWatch {
    /// Frames a second since the first one came on the panel; once, when that is known. `frames_shown` have come by
    /// `now`.
    pub(super) fn reached_hz(&mut self, frames_shown: u64, now: TimeNs) -> Option<f64> {
        if frames_shown == 0 || self.told {
            return None;
        }
        let (frames, t) = *self.first.get_or_insert((frames_shown, now));
        self.told = now - t >= WATCHED && frames_shown - frames >= FRAMES;
        self.told.then(|| (frames_shown - frames) as f64 / (now - t).seconds())
    }

    /// What came until now says nothing of the rate: the panel was lost.
    pub(super) fn begin_anew(&mut self) {
        self.first = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_told_once_and_late_enough_to_be_right() {
        let told = |every_ms: i64| {
            let mut watch = RateWatch::default();
            let look = |k: i64| {
                let t_ms = k * 100;
                watch.reached_hz((t_ms / every_ms) as u64, TimeNs(t_ms * 1_000_000)).map(|hz| (t_ms, hz))
            };
            (0..200).filter_map(look).collect::<Vec<_>>()
        };
        let fast = told(20);
        assert!(matches!(fast[..], [(3_100, hz)] if (hz - 50.0).abs() < 0.1), "{fast:?}");
        let mut watch = RateWatch::default();
        for t_ms in [0, 2_000] {
            assert_eq!(watch.reached_hz(1, TimeNs(t_ms * 1_000_000)), None);
        }
        watch.begin_anew();
        let then = [(4_000, 2), (8_000, 202)].map(|(t_ms, frames)| watch.reached_hz(frames, TimeNs(t_ms * 1_000_000)));
        assert_eq!(then, [None, Some(50.0)], "of the time after a panel was lost");
        let slow = told(4_000);
        assert!(matches!(slow[..], [(12_000, hz)] if (hz - 0.25).abs() < 1e-9), "{slow:?}");
    }
}
