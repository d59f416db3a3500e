//! The time at which a sample was taken, on the host's clock: by the tracker's own time where the wire has one, else by
//! the samples' places among those that arrived together.

use holod_calibration::TimeNs;

use crate::PupilSample;
use crate::clock::{ClockModel, ClockReport};
use crate::source::LONGEST_READ;
use crate::wire::WireSample;

/// Room for the samples without a time that one read may bring: none is shorter than a byte.
const BATCH: usize = LONGEST_READ;
/// Intervals that are believed between samples of one eye: 10 kHz to 10 Hz.
const LEAST_INTERVAL: TimeNs = TimeNs(100_000);
const GREATEST_INTERVAL: TimeNs = TimeNs(100_000_000);
/// Before anything is known: what a fast tracker has, so that nothing is moved far.
const FIRST_INTERVAL: TimeNs = TimeNs(1_000_000);

/// Stamps the samples of one connection; reads no clock and, once made, allocates nothing.
#[derive(Clone, Debug)]
pub(crate) struct Stamper {
    clock: ClockModel,
    batch: Vec<WireSample>,
    eyes: [Pace; 3],
}

/// How the samples of one eye without a time of their own come.
#[derive(Clone, Copy, Debug, Default)]
struct Pace {
    interval: Option<TimeNs>,
    last_arrival: Option<TimeNs>,
    last_stamp: Option<TimeNs>,
}

impl Stamper {
    pub(crate) fn new() -> Self {
        Self { clock: ClockModel::new(), batch: Vec::with_capacity(BATCH), eyes: [Pace::default(); 3] }
    }

    /// The tracker's clock was read, without a sample.
    pub(crate) fn observe(&mut self, t_device: TimeNs, arrival: TimeNs) {
        self.clock.observe(t_device, arrival);
    }

    pub(crate) const fn resets(&self) -> u64 {
        self.clock.resets()
    }

    pub(crate) const fn leaps(&self) -> u64 {
        self.clock.leaps()
    }

    pub(crate) fn report(&self) -> Option<ClockReport> {
        self.clock.report()
    }

    /// Takes a sample of the bytes that were read at `arrival`. One that has a time comes back at once; one that has
    /// none is kept for [`Self::rest`], which tells how many came together.
    pub(crate) fn take(&mut self, wire: WireSample, arrival: TimeNs) -> Option<PupilSample> {
        match wire.t_device {
            Some(t_device) => Some(stamped(&wire, t_device, self.clock.map(t_device, arrival), arrival)),
            None => {
                self.batch.push(wire);
                None
            }
        }
    }

    /// Ends the bytes that were read at `arrival`: each eye's samples that have no time lie one usual interval apart,
    /// the newest at the arrival.
    pub(crate) fn rest(&mut self, arrival: TimeNs, mut on_sample: impl FnMut(PupilSample)) {
        let mut left = [0; 3];
        for wire in &self.batch {
            left[wire.eye.index()] += 1;
        }
        for (eye, count) in self.eyes.iter_mut().zip(left).filter(|(_, count)| *count > 0) {
            eye.learn(count, arrival);
        }
        for wire in self.batch.drain(..) {
            let newer = &mut left[wire.eye.index()];
            *newer -= 1;
            let t = self.eyes[wire.eye.index()].stamp(*newer, arrival);
            on_sample(stamped(&wire, t, t, arrival));
        }
    }
}

impl Pace {
    /// `count` samples have come since the last ones.
    fn learn(&mut self, count: i64, arrival: TimeNs) {
        let since = self.last_arrival.replace(arrival).map(|last| arrival - last);
        let Some(seen) = since.map(|since| TimeNs(since.0 / count)).filter(|seen| *seen <= GREATEST_INTERVAL) else {
            return;
        };
        let seen = seen.max(LEAST_INTERVAL);
        // The mean of the last eight or so: bursts and gaps of a port even out.
        self.interval = Some(self.interval.map_or(seen, |known| known + TimeNs((seen - known).0 / 8)));
    }

    /// The time of a sample with `newer` ones behind it; later than that of the sample before.
    fn stamp(&mut self, newer: i64, arrival: TimeNs) -> TimeNs {
        let interval = self.interval.unwrap_or(FIRST_INTERVAL);
        let t = TimeNs(arrival.0.saturating_sub(interval.0.saturating_mul(newer)));
        let t = self.last_stamp.map_or(t, |last| t.max(last + TimeNs(1))).min(arrival);
        self.last_stamp = Some(t);
        t
    }
}

fn stamped(wire: &WireSample, t_device: TimeNs, t_sample: TimeNs, arrival: TimeNs) -> PupilSample {
    PupilSample {
        t_device,
        t_sample,
        t_arrival: arrival,
        eye: wire.eye,
        diameter_mm: wire.diameter_mm,
        confidence: wire.confidence,
        aperture_mm: wire.aperture_mm,
        sequence: wire.sequence,
        valid: wire.valid,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SampleEye;

    const MS: i64 = 1_000_000;

    fn wire(eye: SampleEye, t_device: Option<TimeNs>) -> WireSample {
        WireSample { t_device, eye, diameter_mm: 4.0, confidence: 1.0, aperture_mm: None, sequence: None, valid: true }
    }

    /// Stamps of `count` samples of both eyes in each of `reads` reads, `every_ms` apart.
    fn stamps(reads: i64, count: usize, every_ms: i64) -> Vec<(i64, PupilSample)> {
        let mut stamper = Stamper::new();
        let mut samples = Vec::new();
        for read in 1..=reads {
            let arrival = TimeNs(read * every_ms * MS);
            for _ in 0..count {
                for eye in [SampleEye::Left, SampleEye::Right] {
                    assert_eq!(stamper.take(wire(eye, None), arrival), None);
                }
            }
            stamper.rest(arrival, |sample| samples.push((arrival.0, sample)));
        }
        samples
    }

    #[test]
    fn samples_that_arrive_together_are_spread_over_the_time_since_the_last_ones() {
        // 250 Hz behind an adapter that holds bytes for 16 ms and more: four at a time, all but one of which were one
        // instant before.
        let samples = stamps(100, 4, 16);
        let left: Vec<_> = samples.iter().filter(|(_, sample)| sample.eye == SampleEye::Left).collect();
        assert_eq!(left.len(), 400);
        let steps: Vec<_> = left.windows(2).skip(40).map(|pair| (pair[1].1.t_sample - pair[0].1.t_sample).0).collect();
        assert!(steps.iter().all(|step| (3 * MS..5 * MS).contains(step)), "{steps:?}");
        assert!(samples.iter().all(|(arrival, sample)| sample.t_sample.0 <= *arrival));
    }

    #[test]
    fn one_at_a_time_is_stamped_with_its_arrival() {
        assert!(stamps(50, 1, 5).iter().all(|(arrival, sample)| sample.t_sample.0 == *arrival));
    }

    #[test]
    fn a_long_stall_is_made_up_in_order() {
        let mut stamper = Stamper::new();
        let mut samples = Vec::new();
        // 250 Hz, one at a time, and then twenty seconds in one read.
        for (t_ms, count) in (4..=4_000).step_by(4).map(|t_ms| (t_ms, 1)).chain([(24_000, 5_000)]) {
            let arrival = TimeNs(t_ms * MS);
            for _ in 0..count {
                let wire = WireSample { sequence: Some(samples.len() as u64), ..wire(SampleEye::Both, None) };
                assert_eq!(stamper.take(wire, arrival), None);
            }
            stamper.rest(arrival, |sample| samples.push(sample));
        }
        assert_eq!(samples.len(), 6_000);
        for pair in samples.windows(2) {
            assert_eq!((pair[1].t_sample - pair[0].t_sample).0, 4 * MS, "{pair:?}");
        }
        stamper.rest(TimeNs(24_000 * MS), |_| panic!("nothing is left"));
    }

    #[test]
    fn a_sample_with_a_time_does_not_wait() {
        let mut stamper = Stamper::new();
        let sample = stamper.take(wire(SampleEye::Left, Some(TimeNs(5))), TimeNs(9 * MS)).expect("at once");
        assert_eq!((sample.t_device, sample.t_sample), (TimeNs(5), TimeNs(9 * MS)));
    }
}
