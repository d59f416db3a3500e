//! The tracker's clock mapped onto the host's.
//!
//! A sample cannot arrive before it was taken, and what delays it (USB frames, FTDI's latency timer, the scheduler) only
//! ever adds. So the offset host − device is the *least* of `arrival − device` over the last few seconds. The window
//! slides, which also follows the drift of a crystal (100 ppm is 0.2 ms over the window).

use holod_calibration::TimeNs;

const BUCKETS: usize = 8;
const BUCKET: TimeNs = TimeNs(250_000_000);
/// A device clock that falls by this much has restarted or wrapped.
const RESET_BACKWARDS: TimeNs = TimeNs(1_000_000_000);
/// A delay above the least by this much, for as long as [`RESET_LASTS`], is a step of the device's clock.
const RESET_EXCESS: TimeNs = TimeNs(150_000_000);
const RESET_LASTS: TimeNs = TimeNs(500_000_000);

/// Maps device times to host times; constant memory.
#[derive(Clone, Debug)]
pub struct ClockModel {
    /// Least offset seen in each bucket of host time, the newest at `newest`.
    least: [Option<i64>; BUCKETS],
    newest: usize,
    bucket_began: TimeNs,
    last_device: Option<TimeNs>,
    excess_since: Option<TimeNs>,
    resets: u64,
}

impl Default for ClockModel {
    fn default() -> Self {
        Self::new()
    }
}

impl ClockModel {
    /// A model that knows nothing yet: the first sample is taken to have arrived at once.
    pub const fn new() -> Self {
        Self {
            least: [None; BUCKETS],
            newest: 0,
            bucket_began: TimeNs(0),
            last_device: None,
            excess_since: None,
            resets: 0,
        }
    }

    /// Host time at which a sample of device time `device` was taken, given that it arrived at `arrival`; never later
    /// than `arrival`.
    pub fn map(&mut self, device: TimeNs, arrival: TimeNs) -> TimeNs {
        // Device times are untrusted and may lie anywhere in i64.
        let offset = arrival.0.saturating_sub(device.0);
        let fell_back = self.last_device.is_some_and(|last| last.0.saturating_sub(device.0) >= RESET_BACKWARDS.0);
        if fell_back || self.stepped(offset, arrival) {
            self.forget();
            self.resets += 1;
        }
        self.last_device = Some(device);
        self.note(offset, arrival);
        let least = self.least_offset().unwrap_or(offset);
        TimeNs(device.0.saturating_add(least).min(arrival.0))
    }

    /// Starts anew, as after a reconnect.
    pub fn forget(&mut self) {
        *self = Self { resets: self.resets, ..Self::new() };
    }

    /// How often the device's clock was found to have been reset or stepped.
    pub const fn resets(&self) -> u64 {
        self.resets
    }

    fn least_offset(&self) -> Option<i64> {
        self.least.iter().flatten().copied().min()
    }

    fn stepped(&mut self, offset: i64, arrival: TimeNs) -> bool {
        let excess = self.least_offset().is_some_and(|least| offset.saturating_sub(least) > RESET_EXCESS.0);
        if !excess {
            self.excess_since = None;
            return false;
        }
        let since = *self.excess_since.get_or_insert(arrival);
        arrival - since >= RESET_LASTS
    }

    fn note(&mut self, offset: i64, arrival: TimeNs) {
        if self.least.iter().all(Option::is_none) {
            self.bucket_began = arrival;
        }
        let passed = ((arrival - self.bucket_began).0 / BUCKET.0).max(0);
        for _ in 0..passed.min(BUCKETS as i64) {
            self.newest = (self.newest + 1) % BUCKETS;
            self.least[self.newest] = None;
        }
        self.bucket_began = self.bucket_began + TimeNs(passed * BUCKET.0);
        let slot = &mut self.least[self.newest];
        *slot = Some(slot.map_or(offset, |least| least.min(offset)));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: i64 = 1_000_000;

    /// Feeds samples each 5 ms; `delay(k)` and `device(k)` in ns; returns mapped − true times.
    fn errors(count: i64, device: impl Fn(i64) -> i64, delay: impl Fn(i64) -> i64) -> (Vec<i64>, u64) {
        let mut model = ClockModel::new();
        let errors = (0..count)
            .map(|k| {
                let taken = 1_000_000 * MS + k * 5 * MS;
                model.map(TimeNs(device(k)), TimeNs(taken + delay(k))).0 - taken
            })
            .collect();
        (errors, model.resets())
    }

    #[test]
    fn jittered_delays_map_to_the_least_delay() {
        // 1 ms at best, up to 16 ms as an FTDI adapter holds bytes.
        let (errors, resets) = errors(2000, |k| k * 5 * MS, |k| MS + (k * 7919 % 16) * MS);
        assert!(errors[100..].iter().all(|&error| (0..=MS).contains(&error)), "{:?}", &errors[100..110]);
        assert_eq!(resets, 0);
    }

    #[test]
    fn drift_is_followed() {
        // A device clock that runs 100 ppm fast or slow for ten minutes.
        for ppm in [-100, 100] {
            let (errors, resets) = errors(120_000, |k| k * 5 * MS + k * 5 * ppm, |k| MS + (k * 7919 % 4) * MS);
            assert!(errors[400..].iter().all(|&error| (0..2 * MS).contains(&error)));
            assert_eq!(resets, 0);
        }
    }

    #[test]
    fn a_restarted_device_is_mapped_again_at_once() {
        let (errors, resets) = errors(1000, |k| (k % 500) * 5 * MS, |_| 2 * MS);
        assert!(errors.iter().all(|&error| error == 2 * MS));
        assert_eq!(resets, 1);
    }

    #[test]
    fn a_clock_set_back_a_little_is_found_within_a_second() {
        let (errors, resets) = errors(1000, |k| if k < 500 { k * 5 * MS } else { k * 5 * MS - 400 * MS }, |_| 2 * MS);
        assert_eq!(errors[499], 2 * MS);
        assert_eq!(errors[510], -398 * MS);
        assert!(errors[700..].iter().all(|&error| error == 2 * MS));
        assert_eq!(resets, 1);
    }

    #[test]
    fn a_clock_set_forward_never_yields_the_future() {
        let (errors, _) = errors(1000, |k| if k < 500 { k * 5 * MS } else { k * 5 * MS + 90_000 * MS }, |_| 2 * MS);
        assert!(errors.iter().all(|&error| error == 2 * MS));
    }

    proptest! {
        #[test]
        fn never_later_than_arrival_and_never_a_panic(
            times in prop::collection::vec((any::<i64>(), 0..i64::MAX / 4), 1..50),
        ) {
            let mut model = ClockModel::new();
            for (device, arrival) in times {
                prop_assert!(model.map(TimeNs(device), TimeNs(arrival)).0 <= arrival);
            }
        }
    }
}
