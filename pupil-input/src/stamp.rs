//! The time at which a sample was taken, on the host's clock: by the tracker's own time where the wire has one, else by
//! the samples' places among those that arrived together.

use holod_calibration::TimeNs;

use crate::clock::{ClockModel, ClockReport};
use crate::wire::WireSample;
use crate::{PupilSample, SampleEye};

/// Samples without a time that one read may bring and still be spread; those beyond are stamped with the arrival.
const BATCH: usize = 256;
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
            None if self.batch.len() < BATCH => {
                self.batch.push(wire);
                None
            }
            None => Some(stamped(&wire, arrival, arrival, arrival)),
        }
    }

    /// Ends the bytes that were read at `arrival`: each eye's samples that have no time lie one usual interval apart,
    /// the newest at the arrival.
    pub(crate) fn rest(&mut self, arrival: TimeNs, mut on_sample: impl FnMut(PupilSample)) {
        if self.batch.is_empty() {
            return;
        }
        for eye in SampleEye::ALL {
            let count = self.batch.iter().filter(|wire| wire.eye == eye).count() as i64;
            if count > 0 {
                self.eyes[eye.index()].learn(count, arrival);
            }
        }
        for index in 0..self.batch.len() {
            let wire = self.batch[index];
            let newer = self.batch[index + 1..].iter().filter(|other| other.eye == wire.eye).count() as i64;
            let t = self.eyes[wire.eye.index()].stamp(newer, arrival);
            on_sample(stamped(&wire, t, t, arrival));
        }
        self.batch.clear();
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
    fn more_than_a_batch_loses_nothing() {
        let mut stamper = Stamper::new();
        let arrival = TimeNs(1_000 * MS);
        let at_once = (0..BATCH + 10).filter(|_| stamper.take(wire(SampleEye::Both, None), arrival).is_some()).count();
        let mut rest = 0;
        stamper.rest(arrival, |_| rest += 1);
        assert_eq!((at_once, rest), (10, BATCH));
        stamper.rest(arrival, |_| panic!("nothing is left"));
    }

    #[test]
    fn a_sample_with_a_time_does_not_wait() {
        let mut stamper = Stamper::new();
        let sample = stamper.take(wire(SampleEye::Left, Some(TimeNs(5))), TimeNs(9 * MS)).expect("at once");
        assert_eq!((sample.t_device, sample.t_sample), (TimeNs(5), TimeNs(9 * MS)));
    }
}
