//! What a tracker was seen to send: running figures of its decisions, pure.

use std::collections::{BTreeMap, VecDeque};

use holod_calibration::{Sorted, TimeNs};
use holod_pupil_input::{Decision, SampleEye, Verdict};
use serde::Serialize;

/// Figures are of the samples of this last while.
const WINDOW: TimeNs = TimeNs(60_000_000_000);
/// No tracker is as fast as this for as long as [`WINDOW`]: 2 kHz.
const MOST_SAMPLES: usize = 120_000;

/// One decision, as plots need it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Mark {
    t_device: TimeNs,
    pub(super) t_sample: TimeNs,
    pub(super) t_arrival: TimeNs,
    pub(super) raw_mm: f32,
    pub(super) verdict: Verdict,
    pub(super) valid: bool,
}

/// The decisions on one eye's samples.
#[derive(Clone, Debug, Default)]
pub(super) struct ObservedEye {
    pub(super) marks: VecDeque<Mark>,
    samples: u64,
    accepted: u64,
    rejected: BTreeMap<&'static str, u64>,
}

/// Spread of a quantity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Quantiles {
    pub(super) p1: f64,
    pub(super) median: f64,
    pub(super) p99: f64,
    pub(super) max: f64,
}

impl Quantiles {
    /// None where there are no values.
    fn of(values: Vec<f64>) -> Option<Self> {
        let sorted = Sorted::new(values)?;
        let [p1, median, p99, max] = [0.01, 0.5, 0.99, 1.0].map(|share| sorted.quantile(share));
        Some(Self { p1, median, p99, max })
    }
}

/// The figures of one eye.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct EyeFigures {
    /// Samples on which the gate has decided.
    pub(super) samples: u64,
    /// Of those, samples that it believed.
    pub(super) accepted: u64,
    /// Of those that it did not: how many for which reason.
    pub(super) rejected: BTreeMap<&'static str, u64>,
    /// Samples a second while they come, over those of the last minute: by the tracker's own clock where it has one.
    pub(super) rate_hz: Option<f64>,
    /// Time between neighbouring samples as the tracker took them.
    pub(super) interval_ms: Option<Quantiles>,
    /// Time between neighbouring samples as they arrived.
    pub(super) arrival_interval_ms: Option<Quantiles>,
    /// From the time at which a sample was taken, as the clock model maps it, to its arrival; the least delay is not
    /// known and counts as none.
    pub(super) delay_ms: Option<Quantiles>,
    /// Diameters as the tracker gave them, scaled to millimetres, where it said that it saw a pupil.
    pub(super) raw_mm: Option<Quantiles>,
    /// Diameters that the gate believed.
    pub(super) believed_mm: Option<Quantiles>,
}

impl ObservedEye {
    fn take(&mut self, decision: &Decision) {
        let sample = &decision.sample;
        self.samples += 1;
        match decision.verdict {
            Verdict::Accepted => self.accepted += 1,
            Verdict::Rejected(reason) => *self.rejected.entry(reason.name()).or_default() += 1,
        }
        let mark = Mark {
            t_device: sample.t_device,
            t_sample: sample.t_sample,
            t_arrival: sample.t_arrival,
            raw_mm: sample.diameter_mm,
            verdict: decision.verdict,
            valid: sample.valid,
        };
        // Rejected samples are decided on before accepted ones that are older.
        let place = self.marks.iter().rposition(|other| other.t_sample <= mark.t_sample).map_or(0, |before| before + 1);
        self.marks.insert(place, mark);
        let newest = self.marks.back().map_or(mark.t_sample, |newest| newest.t_sample);
        while self.marks.len() > MOST_SAMPLES
            || self.marks.front().is_some_and(|oldest| newest - oldest.t_sample > WINDOW)
        {
            self.marks.pop_front();
        }
    }

    fn figures(&self) -> EyeFigures {
        let differences = |time: fn(&Mark) -> TimeNs| {
            let times: Vec<_> = self.marks.iter().map(time).collect();
            Quantiles::of(times.windows(2).map(|pair| (pair[1] - pair[0]).seconds() * 1e3).collect())
        };
        let seen = || self.marks.iter().filter(|mark| mark.valid && mark.raw_mm.is_finite());
        let believed = || seen().filter(|mark| mark.verdict == Verdict::Accepted);
        // Without times of its own, a first read's samples are stamped before the tracker's interval is known.
        let first_read = self.marks.front().map(|mark| mark.t_arrival);
        let timed =
            self.marks.iter().filter(|mark| mark.t_device != mark.t_sample || Some(mark.t_arrival) != first_read);
        let times: Vec<_> = timed.map(|mark| mark.t_device).collect();
        let steps_ms: Vec<_> = times.windows(2).map(|pair| (pair[1] - pair[0]).seconds() * 1e3).collect();
        // Losses and silences are no part of the rate: the mean of the intervals that are not much longer than usual.
        let usual_ms = Quantiles::of(steps_ms.clone()).map_or(0.0, |interval| interval.median);
        let (count, sum_ms) = steps_ms
            .iter()
            .filter(|step| (0.0..=1.5 * usual_ms).contains(*step))
            .fold((0_u32, 0.0), |(count, sum), step| (count + 1, sum + step));
        EyeFigures {
            samples: self.samples,
            accepted: self.accepted,
            rejected: self.rejected.clone(),
            rate_hz: (sum_ms > 0.0).then(|| 1e3 * f64::from(count) / sum_ms),
            interval_ms: differences(|mark| mark.t_sample),
            arrival_interval_ms: differences(|mark| mark.t_arrival),
            delay_ms: Quantiles::of(
                self.marks.iter().map(|mark| (mark.t_arrival - mark.t_sample).seconds() * 1e3).collect(),
            ),
            raw_mm: Quantiles::of(seen().map(|mark| f64::from(mark.raw_mm)).collect()),
            believed_mm: Quantiles::of(believed().map(|mark| f64::from(mark.raw_mm)).collect()),
        }
    }
}

/// The decisions on all eyes' samples.
#[derive(Clone, Debug, Default)]
pub(super) struct Observed {
    eyes: [ObservedEye; 3],
}

impl Observed {
    pub(super) fn take(&mut self, decision: &Decision) {
        self.eyes[decision.sample.eye.index()].take(decision);
    }

    /// Eyes of which anything has come.
    pub(super) fn eyes(&self) -> impl Iterator<Item = (SampleEye, &ObservedEye)> {
        SampleEye::ALL.into_iter().zip(&self.eyes).filter(|(_, eye)| eye.samples > 0)
    }

    pub(super) fn figures(&self) -> BTreeMap<String, EyeFigures> {
        self.eyes().map(|(eye, observed)| (eye.to_string(), observed.figures())).collect()
    }

    pub(super) fn accepted(&self) -> u64 {
        self.eyes.iter().map(|eye| eye.accepted).sum()
    }
}

#[cfg(test)]
mod tests {
    use holod_pupil_input::{PupilSample, Rejection};

    use super::*;

    fn decision(t_ms: i64, delay_ms: i64, diameter_mm: f32, verdict: Verdict) -> Decision {
        let (t_sample, t_arrival) = (TimeNs(t_ms * 1_000_000), TimeNs((t_ms + delay_ms) * 1_000_000));
        let sample = PupilSample {
            t_device: t_sample,
            t_sample,
            t_arrival,
            eye: SampleEye::Left,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: None,
            sequence: None,
            valid: diameter_mm > 0.0,
        };
        Decision { sample, verdict }
    }

    #[test]
    fn rate_intervals_and_reasons_are_those_of_the_samples() {
        let mut observed = Observed::default();
        for k in 0..200 {
            let blink = k % 100 == 50;
            let verdict = if blink { Verdict::Rejected(Rejection::Lost) } else { Verdict::Accepted };
            observed.take(&decision(5 * k, if k % 2 == 0 { 1 } else { 3 }, if blink { 0.0 } else { 4.0 }, verdict));
        }
        let figures = &observed.figures()["left"];
        assert_eq!((figures.samples, figures.accepted, figures.rejected["lost"]), (200, 198, 2));
        assert!((figures.rate_hz.unwrap() - 200.0).abs() < 1e-9);
        let interval = figures.interval_ms.unwrap();
        assert!((interval.p1 - 5.0).abs() < 1e-9 && (interval.max - 5.0).abs() < 1e-9);
        let arrival = figures.arrival_interval_ms.unwrap();
        assert!((arrival.p1 - 3.0).abs() < 1e-9 && (arrival.max - 7.0).abs() < 1e-9);
        assert!((figures.delay_ms.unwrap().max - 3.0).abs() < 1e-9);
        assert!((figures.raw_mm.unwrap().p1 - 4.0).abs() < 1e-9, "what the tracker calls lost is no diameter");
        assert_eq!(observed.figures().len(), 1);
    }

    /// 500 Hz for 6 s; the first nine samples come in one read and are mapped too near to each other.
    #[test]
    fn the_rate_is_the_trackers_whatever_came_in_the_first_read() {
        for own_times in [true, false] {
            let mut observed = Observed::default();
            for k in 0..3000 {
                let mut decision = decision(0, 0, 4.0, Verdict::Accepted);
                let t = TimeNs(2_000_000 * k);
                decision.sample.t_arrival = t.max(TimeNs(16_000_000));
                decision.sample.t_sample = if k < 9 { TimeNs(16_000_000 - 1_000_000 * (8 - k)) } else { t };
                let t_device = if own_times { t + TimeNs(77_000_000_000) } else { decision.sample.t_sample };
                decision.sample.t_device = t_device;
                observed.take(&decision);
            }
            let rate_hz = observed.figures()["left"].rate_hz.unwrap();
            assert!((rate_hz - 500.0).abs() < 1e-6, "{own_times}: {rate_hz}");
        }
    }

    #[test]
    fn decisions_out_of_order_are_put_in_order_and_old_ones_forgotten() {
        let mut observed = Observed::default();
        for t_ms in [0, 10, 5, 90_000, 89_990] {
            observed.take(&decision(t_ms, 0, 4.0, Verdict::Accepted));
        }
        let (_, eye) = observed.eyes().next().unwrap();
        let times: Vec<_> = eye.marks.iter().map(|mark| mark.t_sample.0 / 1_000_000).collect();
        assert_eq!(times, [89_990, 90_000]);
        assert_eq!(observed.figures()["left"].samples, 5);
    }
}
