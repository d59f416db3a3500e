//! The tracker's clock mapped onto the host's.
//!
//! A sample cannot arrive before it was taken, and what delays it (USB frames, FTDI's latency timer, the scheduler) only
//! ever adds. So the offset host − device is the *least* of `arrival − device` over the last second. Where the device's
//! clock runs slow, that least lags behind; so the rise from the older half of the window to the newer is carried on. A
//! crystal's drift needs none of that, but a log that a script feeds with sleeps is several per cent slow.

use holod_calibration::TimeNs;

const BUCKETS: usize = 8;
const BUCKET: TimeNs = TimeNs(125_000_000);
/// A device clock that falls by this much has restarted or wrapped.
const RESET_BACKWARDS: TimeNs = TimeNs(1_000_000_000);
/// A delay above the least by this much, for as long as [`RESET_LASTS`], is a step of the device's clock.
const RESET_EXCESS: TimeNs = TimeNs(150_000_000);
const RESET_LASTS: TimeNs = TimeNs(500_000_000);
/// A device clock is followed down to this share slower than the host's.
const GREATEST_RISE: f64 = 0.3;

/// Maps device times to host times; constant memory.
#[derive(Clone, Debug)]
pub struct ClockModel {
    /// The least offset of each bucket of host time.
    least: [Option<Least>; BUCKETS],
    newest: usize,
    bucket_began: TimeNs,
    /// Device time and mapped time of the last sample.
    last: Option<(TimeNs, TimeNs)>,
    excess_since: Option<TimeNs>,
    resets: u64,
}

#[derive(Clone, Copy, Debug)]
struct Least {
    offset_ns: i64,
    arrival: TimeNs,
}

impl Default for ClockModel {
    fn default() -> Self {
        Self::new()
    }
}

impl ClockModel {
    /// A model that knows nothing yet: the first sample is taken to have arrived at once.
    pub const fn new() -> Self {
        Self { least: [None; BUCKETS], newest: 0, bucket_began: TimeNs(0), last: None, excess_since: None, resets: 0 }
    }

    /// Host time at which a sample of device time `device` was taken, given that it arrived at `arrival`; never later
    /// than `arrival`, and in the order of the device times.
    pub fn map(&mut self, device: TimeNs, arrival: TimeNs) -> TimeNs {
        // Device times are untrusted and may lie anywhere in i64.
        let offset_ns = arrival.0.saturating_sub(device.0);
        let fell_back = self.last.is_some_and(|(last, _)| last.0.saturating_sub(device.0) >= RESET_BACKWARDS.0);
        if fell_back || self.stepped(offset_ns, arrival) {
            self.forget();
            self.resets += 1;
        }
        self.note(Least { offset_ns, arrival });
        let offset_ns = self.offset_at(arrival).unwrap_or(offset_ns);
        let mut mapped = TimeNs(device.0.saturating_add(offset_ns));
        if let Some((last_device, last_mapped)) = self.last {
            // A better offset must not put a later sample before an earlier one.
            if device == last_device {
                mapped = last_mapped;
            } else if device > last_device {
                mapped = mapped.max(last_mapped + TimeNs(1));
            }
        }
        let mapped = mapped.min(arrival);
        self.last = Some((device, mapped));
        mapped
    }

    /// Starts anew, as after a reconnect.
    pub fn forget(&mut self) {
        *self = Self { resets: self.resets, ..Self::new() };
    }

    /// How often the device's clock was found to have been reset or stepped.
    pub const fn resets(&self) -> u64 {
        self.resets
    }

    /// The offset without delay at host time `now`.
    fn offset_at(&self, now: TimeNs) -> Option<i64> {
        let half = |from: usize| {
            let buckets = (from..from + BUCKETS / 2).map(|back| self.least[(self.newest + BUCKETS - back) % BUCKETS]);
            buckets.flatten().min_by_key(|least| least.offset_ns)
        };
        let (newer, older) = (half(0), half(BUCKETS / 2));
        let (Some(newer), Some(older)) = (newer, older) else {
            return newer.or(older).map(|least| least.offset_ns);
        };
        let rise_ns = newer.offset_ns.saturating_sub(older.offset_ns);
        if rise_ns <= 0 {
            return Some(newer.offset_ns);
        }
        let rise = (rise_ns as f64 / (newer.arrival - older.arrival).0.max(1) as f64).min(GREATEST_RISE);
        let since_ns = (now - newer.arrival).0.max(0) as f64;
        Some(newer.offset_ns.saturating_add((rise * since_ns) as i64))
    }

    fn stepped(&mut self, offset_ns: i64, arrival: TimeNs) -> bool {
        let excess = self.offset_at(arrival).is_some_and(|least| offset_ns.saturating_sub(least) > RESET_EXCESS.0);
        if !excess {
            self.excess_since = None;
            return false;
        }
        let since = *self.excess_since.get_or_insert(arrival);
        arrival - since >= RESET_LASTS
    }

    fn note(&mut self, least: Least) {
        if self.least.iter().all(Option::is_none) {
            self.bucket_began = least.arrival;
        }
        let passed = ((least.arrival - self.bucket_began).0 / BUCKET.0).max(0);
        for _ in 0..passed.min(BUCKETS as i64) {
            self.newest = (self.newest + 1) % BUCKETS;
            self.least[self.newest] = None;
        }
        self.bucket_began = self.bucket_began + TimeNs(passed * BUCKET.0);
        let slot = &mut self.least[self.newest];
        if slot.is_none_or(|known| least.offset_ns < known.offset_ns) {
            *slot = Some(least);
        }
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
        assert!(errors[100..].iter().all(|&error| (0..=2 * MS).contains(&error)), "{:?}", &errors[100..110]);
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
    fn a_feed_that_is_several_per_cent_slow_is_followed() {
        for per_cent in [2, 10] {
            let device = |k: i64| k * 5 * MS - k * 5 * MS * per_cent / 100;
            let (errors, resets) = errors(4000, device, |k| MS + (k * 7919 % 4) * MS);
            assert!(errors[400..].iter().all(|&error| (-5 * MS..=5 * MS).contains(&error)), "{per_cent} %");
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
        assert!(errors[510] < -300 * MS);
        assert!(errors[720..].iter().all(|&error| error == 2 * MS));
        assert!(resets <= 1);
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

        #[test]
        fn later_samples_map_to_later_times(
            steps in prop::collection::vec((1_000..20_000_000_i64, 0..16_000_000_i64), 1..300),
        ) {
            let mut model = ClockModel::new();
            let mut last = TimeNs(i64::MIN);
            let (mut taken, mut arrival) = (0, 0);
            for (step, delay) in steps {
                taken += step;
                // A port keeps the order.
                arrival = (taken + delay).max(arrival + 1);
                let mapped = model.map(TimeNs(taken), TimeNs(arrival));
                prop_assert!(mapped > last);
                last = mapped;
            }
        }
    }
}
