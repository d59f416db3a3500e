//! Which samples are of the pupil, and which of a lid.
//!
//! In a blink a tracker measures what is left of the pupil beside the lid. Some say so (confidence, lid aperture); many
//! send plausible millimetres without a word. So a sample is believed only if
//!
//! 1. its diameter is in range, its confidence is high enough, and the lids (where known) are open: as wide as that eye
//!    holds them open, since in bright light people squint all the time;
//! 2. it did not step from its predecessor, nor move from the oldest sample that waits, faster than a pupil moves,
//!    beyond what the tracker's own noise explains: at a high rate a lid's steps are small, and its speed shows over
//!    the whole wait only;
//! 3. it lies within reach of the estimate, of where the pupil was a while ago, or of what is between: a band that
//!    widens with the time since the last believed sample, so that a dip of a lid is outside for longer than a blink
//!    lasts, and a real change of the pupil is inside soon after. The estimate alone would not do: where it began to
//!    follow a lid and runs on, the pupil itself lies outside;
//! 4. none of this happened within the guard times around it. The leading guard needs the sample's successors, so every
//!    sample waits for [`GateSettings::lead`] before it is believed: that is the gate's whole latency, and because of
//!    it the estimate never starts to follow the onset of a blink.

use holod_calibration::TimeNs;

use crate::PupilSample;

/// Limits of the gate. Diameters are millimetres after the rig's scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GateSettings {
    /// Least diameter of a human pupil.
    pub least_mm: f32,
    /// Greatest diameter of a human pupil.
    pub greatest_mm: f32,
    /// Confidence, 0..=1, that a sample must have at least.
    pub least_confidence: f32,
    /// Lids this far apart are open, however wide the eye opens them at other times.
    pub open_aperture_mm: f32,
    /// Lids nearer than this are closed, however little the eye opens at other times.
    pub closed_aperture_mm: f32,
    /// Between the two, lids nearer than this share of how wide they usually are count as closed.
    pub least_aperture_share: f32,
    /// How soon a narrower opening is taken to be the usual one; much longer than a blink.
    pub aperture_settles: TimeNs,
    /// Fastest change of a pupil, millimetres a second, noise aside.
    pub slew_mm_per_s: f32,
    /// How far from the estimate, or from what it was a while ago, a sample may lie when the last believed one is
    /// fresh.
    pub reach_mm: f32,
    /// How fast that reach widens, millimetres a second.
    pub reach_mm_per_s: f32,
    /// Leading guard: a sample this close before a bad one is not believed. Also the gate's latency.
    pub lead: TimeNs,
    /// Trailing guard: a sample this close after a bad one is not believed.
    pub trail: TimeNs,
    /// A silence longer than this, and than three of the tracker's usual intervals, is a loss with guards on both
    /// sides.
    pub gap: TimeNs,
}

impl Default for GateSettings {
    fn default() -> Self {
        Self {
            least_mm: 1.0,
            greatest_mm: 9.0,
            least_confidence: 0.6,
            open_aperture_mm: 3.5,
            closed_aperture_mm: 1.0,
            least_aperture_share: 0.5,
            aperture_settles: TimeNs(1_500_000_000),
            slew_mm_per_s: 10.0,
            reach_mm: 0.45,
            reach_mm_per_s: 2.0,
            lead: TimeNs(30_000_000),
            trail: TimeNs(50_000_000),
            gap: TimeNs(100_000_000),
        }
    }
}

crate::named::named! {
    /// Why a sample was not believed.
    pub enum Rejection {
        /// Of an eye that does not drive the display.
        OtherEye = "other_eye",
        /// It comes late: its time is before its predecessor's.
        Backwards = "backwards",
        /// Its time is its predecessor's.
        Repeated = "repeated",
        /// The tracker itself says that it sees no pupil.
        Lost = "lost",
        /// Diameter, confidence or aperture is NaN or infinite.
        NotFinite = "not_finite",
        /// The diameter is none of a human pupil.
        OutOfRange = "out_of_range",
        /// The tracker's confidence is low.
        LowConfidence = "low_confidence",
        /// The lids are nearly closed.
        LidsClosed = "lids_closed",
        /// It stepped, or moved since the oldest sample that waits, faster than a pupil moves.
        Slew = "slew",
        /// It is out of reach of the estimate.
        OutOfReach = "out_of_reach",
        /// It is close to a bad sample or to a gap.
        Guard = "guard",
    }
}

/// What the gate says of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It reaches the filter.
    Accepted,
    /// It is left out, for this reason.
    Rejected(Rejection),
}

/// Where the estimate expects the pupil.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Expected {
    pub(crate) diameter_mm: f32,
    /// Where the pupil was before a lid that only begins to show could have moved the estimate.
    pub(crate) earlier_mm: f32,
    /// Time of the last believed sample.
    pub(crate) t_believed: TimeNs,
}

/// Samples that may wait at once: 30 ms at 4 kHz.
const PENDING: usize = 128;
/// A step is judged against a predecessor no older than this.
const STEP_WITHIN: TimeNs = TimeNs(50_000_000);

/// The gate of one eye: samples in, verdicts out, some after a delay of [`GateSettings::lead`]. Constant memory.
#[derive(Clone, Debug)]
pub(crate) struct Gate {
    settings: GateSettings,
    pending: [Option<PupilSample>; PENDING],
    oldest: usize,
    waiting: usize,
    previous: Option<(TimeNs, f32)>,
    t_newest: Option<TimeNs>,
    t_bad: Option<TimeNs>,
    step: StepScale,
    interval: Interval,
    lids: Lids,
}

impl Gate {
    pub(crate) fn new(settings: GateSettings) -> Self {
        Self {
            settings,
            pending: [None; PENDING],
            oldest: 0,
            waiting: 0,
            previous: None,
            t_newest: None,
            t_bad: None,
            step: StepScale::default(),
            interval: Interval::default(),
            lids: Lids::default(),
        }
    }

    /// For how long the tracker may usually be silent.
    pub(crate) fn usual_silence(&self) -> TimeNs {
        TimeNs(3 * self.interval.median_ns)
    }

    fn gap(&self) -> TimeNs {
        self.settings.gap.max(self.usual_silence())
    }

    /// The tracker's noise, as the standard deviation of one sample in millimetres.
    pub(crate) fn noise_mm(&self) -> f32 {
        self.step.noise_mm()
    }

    /// Whether the newest sample is fit to be believed, its successors permitting.
    pub(crate) fn is_open(&self) -> bool {
        self.waiting > 0
    }

    /// The next sample that has waited long enough at time `t`, to be taken before the sample of time `t` is judged.
    pub(crate) fn ripe(&mut self, t: TimeNs) -> Option<PupilSample> {
        if self.t_newest.is_some_and(|newest| t <= newest || t - newest > self.gap()) {
            return None;
        }
        let sample = self.pending[self.oldest].filter(|_| self.waiting > 0)?;
        let waited = t - sample.t_sample >= self.settings.lead;
        if !waited && self.waiting < PENDING {
            return None;
        }
        self.pop()
    }

    /// Judges `sample`, given where the pupil is expected; calls `on_rejected` for it or for those waiting, if they are
    /// not to be believed. Diameters are already in scaled millimetres.
    pub(crate) fn judge(
        &mut self,
        sample: PupilSample,
        expected: Option<Expected>,
        mut on_rejected: impl FnMut(PupilSample, Rejection),
    ) {
        let t = sample.t_sample;
        if let Some(newest) = self.t_newest {
            if t <= newest {
                return on_rejected(sample, if t < newest { Rejection::Backwards } else { Rejection::Repeated });
            }
            let gap = self.gap();
            self.interval.note(t - newest);
            if t - newest > gap {
                self.reject_pending(&mut on_rejected);
                self.t_bad = Some(t);
                self.previous = None;
            }
        }
        self.t_newest = Some(t);

        let fault = self.fault_of_itself(&sample).or_else(|| self.fault_among_others(&sample, expected));
        if let Some(fault) = fault {
            self.reject_pending(&mut on_rejected);
            self.t_bad = Some(t);
            return on_rejected(sample, fault);
        }
        if self.t_bad.is_some_and(|bad| t - bad <= self.settings.trail) {
            return on_rejected(sample, Rejection::Guard);
        }
        let free = (self.oldest + self.waiting) % PENDING;
        self.pending[free] = Some(sample);
        self.waiting += 1;
    }

    /// Gives up on the samples that wait, as at the end of a stream.
    pub(crate) fn reject_pending(&mut self, on_rejected: &mut impl FnMut(PupilSample, Rejection)) {
        while let Some(sample) = self.pop() {
            on_rejected(sample, Rejection::Guard);
        }
    }

    fn pop(&mut self) -> Option<PupilSample> {
        if self.waiting == 0 {
            return None;
        }
        let sample = self.pending[self.oldest].take();
        self.oldest = (self.oldest + 1) % PENDING;
        self.waiting -= 1;
        sample
    }

    fn fault_of_itself(&mut self, sample: &PupilSample) -> Option<Rejection> {
        let limits = &self.settings;
        let shut = sample.aperture_mm.is_some_and(|aperture_mm| self.lids.shut(sample.t_sample, aperture_mm, limits));
        let finite = sample.diameter_mm.is_finite()
            && sample.confidence.is_finite()
            && sample.aperture_mm.is_none_or(f32::is_finite);
        if !sample.valid {
            Some(Rejection::Lost)
        } else if !finite {
            Some(Rejection::NotFinite)
        } else if sample.confidence < limits.least_confidence {
            Some(Rejection::LowConfidence)
        } else if shut {
            Some(Rejection::LidsClosed)
        } else if !(limits.least_mm..=limits.greatest_mm).contains(&sample.diameter_mm) {
            Some(Rejection::OutOfRange)
        } else {
            None
        }
    }

    fn fault_among_others(&mut self, sample: &PupilSample, expected: Option<Expected>) -> Option<Rejection> {
        let t = sample.t_sample;
        let previous = self.previous.replace((t, sample.diameter_mm)).filter(|(then, _)| t - *then <= STEP_WITHIN);
        let noise = self.step.allowance_mm();
        if let Some((then, diameter_mm)) = previous {
            let step = (sample.diameter_mm - diameter_mm).abs();
            self.step.note(step);
            if step > noise + self.settings.slew_mm_per_s * (t - then).seconds() as f32 {
                return Some(Rejection::Slew);
            }
        }
        // Of neighbours the step has been judged.
        if let Some(oldest) = self.pending[self.oldest].filter(|_| self.waiting > 1) {
            let (elapsed, moved) = (t - oldest.t_sample, (sample.diameter_mm - oldest.diameter_mm).abs());
            let allowed = self.step.noise_alone_mm() + self.settings.slew_mm_per_s * elapsed.seconds() as f32;
            if 2 * elapsed.0 >= self.settings.lead.0 && moved > allowed {
                return Some(Rejection::Slew);
            }
        }
        let expected = expected?;
        let reach = self.settings.reach_mm.max(noise)
            + self.settings.reach_mm_per_s * (t - expected.t_believed).seconds() as f32;
        let nearest_mm = sample
            .diameter_mm
            .clamp(expected.diameter_mm.min(expected.earlier_mm), expected.diameter_mm.max(expected.earlier_mm));
        ((sample.diameter_mm - nearest_mm).abs() > reach).then_some(Rejection::OutOfReach)
    }
}

/// How wide an eye holds its lids: rises at once, falls slowly.
#[derive(Clone, Copy, Debug, Default)]
struct Lids {
    open_mm: f32,
    t: Option<TimeNs>,
}

/// A silence says nothing of the lids.
const LIDS_SILENCE: TimeNs = TimeNs(100_000_000);

impl Lids {
    /// Notes the aperture of time `t`; tells whether the lids are too near.
    fn shut(&mut self, t: TimeNs, aperture_mm: f32, limits: &GateSettings) -> bool {
        if aperture_mm.is_finite() {
            let elapsed = self.t.replace(t).map_or(TimeNs(0), |before| (t - before).min(LIDS_SILENCE));
            let keeps = (-elapsed.seconds() / limits.aperture_settles.seconds()).exp() as f32;
            // What is beyond this bound changes no verdict, and an outlier is soon forgotten.
            let widest_mm = limits.open_aperture_mm / limits.least_aperture_share;
            self.open_mm = (aperture_mm + keeps * (self.open_mm - aperture_mm)).max(aperture_mm).min(widest_mm);
        }
        let least_mm = limits.least_aperture_share * self.open_mm;
        aperture_mm < least_mm.clamp(limits.closed_aperture_mm, limits.open_aperture_mm)
    }
}

/// A running median of the steps between neighbouring samples: the tracker's own noise, whatever its rate. A median, so
/// that blinks do not widen it.
#[derive(Clone, Copy, Debug)]
struct StepScale {
    median_mm: f32,
}

impl Default for StepScale {
    fn default() -> Self {
        Self { median_mm: 0.05 }
    }
}

impl StepScale {
    /// A sign-following median: moves by a fixed share towards each step.
    fn note(&mut self, step_mm: f32) {
        // A frozen repeat tells nothing about noise.
        if step_mm > 0.0 {
            let factor = if step_mm > self.median_mm { 1.01 } else { 1.0 / 1.01 };
            self.median_mm = (self.median_mm * factor).clamp(0.002, 0.25);
        }
    }

    /// A distance between two samples that noise alone all but never makes: about six times the median step, which for
    /// normal noise is its four-sigma point.
    fn noise_alone_mm(self) -> f32 {
        (6.0 * self.median_mm).clamp(0.05, 0.9)
    }

    /// The same for neighbours, of which a quiet tracker makes a coarse step now and then.
    fn allowance_mm(self) -> f32 {
        self.noise_alone_mm().max(0.3)
    }

    /// For normal noise the median absolute step is 0.6745·√2 of one sample's standard deviation.
    fn noise_mm(self) -> f32 {
        (self.median_mm / 0.954).clamp(0.01, 0.25)
    }
}

/// Of the slowest tracker that is followed: 6 Hz.
const LONGEST_INTERVAL: TimeNs = TimeNs(160_000_000);
/// Where all samples are farther apart than this, none is believed.
pub(crate) const LONGEST_GAP: TimeNs = TimeNs(3 * LONGEST_INTERVAL.0);

/// A running median of the time between samples, from 1 kHz to 6 Hz, so that a slow tracker is not taken for a lost
/// one.
#[derive(Clone, Copy, Debug)]
struct Interval {
    median_ns: i64,
}

impl Default for Interval {
    fn default() -> Self {
        Self { median_ns: 20_000_000 }
    }
}

impl Interval {
    fn note(&mut self, interval: TimeNs) {
        let tenth = self.median_ns / 10;
        self.median_ns += if interval.0 > self.median_ns { tenth } else { -tenth };
        self.median_ns = self.median_ns.clamp(1_000_000, LONGEST_INTERVAL.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SampleEye;

    fn sample(t_ms: i64, diameter_mm: f32) -> PupilSample {
        PupilSample {
            t_device: TimeNs(0),
            t_sample: TimeNs(t_ms * 1_000_000),
            t_arrival: TimeNs(0),
            eye: SampleEye::Left,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: None,
            sequence: None,
            valid: true,
        }
    }

    /// Feeds samples; expects the estimate to be the last believed sample. Gives (time in ms, verdict) in time order.
    fn verdicts(samples: &[PupilSample]) -> Vec<(i64, Verdict)> {
        let mut gate = Gate::new(GateSettings::default());
        let mut expected = None;
        let mut out = Vec::new();
        for &sample in samples {
            while let Some(ripe) = gate.ripe(sample.t_sample) {
                let diameter_mm = ripe.diameter_mm;
                expected = Some(Expected { diameter_mm, earlier_mm: diameter_mm, t_believed: ripe.t_sample });
                out.push((ripe.t_sample.0 / 1_000_000, Verdict::Accepted));
            }
            gate.judge(sample, expected, |sample, reason| {
                out.push((sample.t_sample.0 / 1_000_000, Verdict::Rejected(reason)));
            });
        }
        out.sort_by_key(|(t, _)| *t);
        out
    }

    fn steady(t_ms: impl Iterator<Item = i64>) -> Vec<PupilSample> {
        t_ms.map(|t| sample(t, 4.0)).collect()
    }

    #[test]
    fn a_bad_sample_takes_its_neighbours_with_it() {
        type Spoil = fn(&mut PupilSample);
        let spoil: [(Spoil, Rejection); 7] = [
            (|s| s.valid = false, Rejection::Lost),
            (|s| s.diameter_mm = f32::NAN, Rejection::NotFinite),
            (|s| s.diameter_mm = 0.5, Rejection::OutOfRange),
            (|s| s.diameter_mm = 16.7, Rejection::OutOfRange),
            (|s| s.confidence = 0.2, Rejection::LowConfidence),
            (|s| s.aperture_mm = Some(0.9), Rejection::LidsClosed),
            (|s| s.diameter_mm = 3.0, Rejection::Slew),
        ];
        for (spoil, reason) in spoil {
            let mut samples = steady((0..80).map(|k| 5 * k));
            spoil(&mut samples[40]);
            let verdicts = verdicts(&samples);
            let at = |t_ms: i64| verdicts.iter().find(|(t, _)| *t == t_ms).expect("judged").1;
            assert_eq!(at(200), Verdict::Rejected(reason));
            assert_eq!(at(165), Verdict::Accepted);
            assert_eq!(at(175), Verdict::Rejected(Rejection::Guard));
            assert_eq!(at(245), Verdict::Rejected(Rejection::Guard));
            assert_eq!(at(265), Verdict::Accepted);
        }
    }

    #[test]
    fn a_low_level_is_out_of_reach_until_longer_than_a_blink() {
        // Drops by 1.5 mm and stays: a quiet lid, or a true change missed.
        let samples: Vec<_> = (0..300).map(|k| sample(5 * k, if k < 100 { 4.0 } else { 2.5 })).collect();
        let verdicts = verdicts(&samples);
        let again = verdicts.iter().find(|(t, v)| *t > 500 && *v == Verdict::Accepted).expect("believed in the end").0;
        assert!((800..1100).contains(&again), "believed again {again} ms");
    }

    /// The times in ms of the samples that are rejected because of the lids: 200 Hz, steady, with these apertures.
    fn shut(aperture_mm: impl Fn(i64) -> f32) -> Vec<i64> {
        let samples = (0..2000).map(|k| PupilSample { aperture_mm: Some(aperture_mm(5 * k)), ..sample(5 * k, 2.4) });
        let closed = Verdict::Rejected(Rejection::LidsClosed);
        let verdicts = verdicts(&samples.collect::<Vec<_>>());
        verdicts.into_iter().filter(|(_, verdict)| *verdict == closed).map(|(t, _)| t).collect()
    }

    #[test]
    fn lids_are_judged_by_how_wide_that_eye_opens() {
        // Wide open, with a blink of 0.2 s that passes 3.0 mm on its way.
        let blink = |t: i64, open_mm: f32| if (5000..5200).contains(&t) { 0.2 } else { open_mm };
        assert_eq!(shut(|t| if t == 4995 || t == 5200 { 3.0 } else { blink(t, 7.0) }).len(), 42);
        // A squint, in and out of blinks, from the first sample on.
        assert_eq!(
            shut(|t| blink(t, 3.0 + 0.5 * (t as f32 * 0.01).sin())),
            (5000..5200).step_by(5).collect::<Vec<_>>()
        );
        // The recording begins with closed lids.
        assert_eq!(shut(|t| if t < 1000 { 0.0 } else { 2.6 }).last(), Some(&995));
    }

    #[test]
    fn a_squint_that_begins_is_believed_within_a_second() {
        let rejected = shut(|t| if t < 4000 { 7.0 } else { 2.6 });
        assert_eq!(rejected.first(), Some(&4000));
        assert!((4300..5000).contains(rejected.last().expect("some")), "{:?}", rejected.last());
        // An outlier costs nothing beyond that.
        let rejected = shut(|t| if t == 4000 { 1e30 } else { 2.6 });
        assert!((4300..5000).contains(rejected.last().expect("some")), "{:?}", rejected.last());
    }

    #[test]
    fn eyes_closed_for_long_are_closed_all_the_while() {
        assert_eq!(shut(|t| if t < 1000 { 7.0 } else { 0.6 }).len(), 1800);
    }

    #[test]
    fn a_gap_is_guarded_on_both_sides() {
        let samples = steady((0..20).map(|k| 5 * k).chain((60..100).map(|k| 5 * k)));
        let verdicts = verdicts(&samples);
        let rejected: Vec<_> = verdicts.iter().filter(|(_, v)| *v != Verdict::Accepted).map(|(t, _)| *t).collect();
        assert_eq!(rejected.first(), Some(&70));
        assert_eq!(rejected.last(), Some(&350));
    }

    #[test]
    fn a_slow_tracker_is_not_a_lost_one() {
        let verdicts = verdicts(&steady((0..100).map(|k| 105 * k)));
        assert!(verdicts.iter().skip(30).all(|(_, v)| *v == Verdict::Accepted));
        assert_eq!(verdicts.len(), 99);
    }

    #[test]
    fn a_time_that_does_not_advance_is_rejected_alone() {
        let mut samples = steady((0..40).map(|k| 5 * k));
        samples[20].t_sample = samples[18].t_sample;
        samples[30].t_sample = samples[29].t_sample;
        let rejected: Vec<_> = verdicts(&samples).into_iter().filter(|(_, v)| *v != Verdict::Accepted).collect();
        let expected = [(90, Rejection::Backwards), (145, Rejection::Repeated)];
        assert_eq!(rejected, expected.map(|(t, reason)| (t, Verdict::Rejected(reason))));
    }

    #[test]
    fn frozen_repeats_and_the_fastest_reflex_pass() {
        // 8 frozen samples, then 5.5 mm/s down.
        let samples: Vec<_> = (0..100).map(|k| sample(5 * k, 6.0 - 0.0275 * (k - 8).max(0) as f32)).collect();
        assert!(verdicts(&samples).iter().all(|(_, v)| *v == Verdict::Accepted));
    }

    #[test]
    fn more_samples_than_fit_are_believed_early_not_lost() {
        let samples: Vec<_> = (0..20_000)
            .map(|k| {
                let mut sample = sample(0, 4.0);
                sample.t_sample = TimeNs(k * 50_000);
                sample
            })
            .collect();
        let accepted = verdicts(&samples).len();
        assert!(accepted >= 20_000 - PENDING, "{accepted}");
    }
}
