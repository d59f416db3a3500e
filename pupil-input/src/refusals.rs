//! Why nothing that a tracker sends is believed, and what would most likely cure it.

use std::fmt;

use holod_calibration::{Sorted, TimeNs, rig};

use crate::counters::{Counter, CounterSnapshot};
use crate::estimator::Decision;
use crate::gate::{GateSettings, LONGEST_GAP, Rejection, Verdict};
use crate::import::LogFault;
use crate::size_unit::{Figures, SizeUnit};
use crate::wire::WireFault;
use crate::{PupilSample, SampleEye};

/// For so long everything must have been refused before it is said.
const REFUSED_FOR: TimeNs = TimeNs(1_000_000_000);
/// As many messages, refused or of no pupil, must have come before it is said.
const LEAST_MESSAGES: u64 = 5;
/// For so long a tracker may say nothing at all before that is said.
const UNHEARD_FOR: TimeNs = TimeNs(1_800_000_000);
/// The reason where messages come that a tracker's profile passes over, and none with a pupil.
const OTHER_MESSAGES: &str = "notes";
const OTHER_MESSAGES_ADVICE: &str = "is the tracker's pupil measurement switched on (Neon: \"compute eye state\" in the \
                                     Companion; Pupil Core: the 3D detector), and are a profile's `prefix` or report `id` \
                                     those that it sends?";
/// The reason where bytes come, and nothing that could be refused is in them.
const UNREAD_BYTES: &str = "bytes";
const FORM_ADVICE: &str = "is it this tracker's profile and baud rate? (`holod tracker list` names the profiles, \
                           profile=NAME chooses one)";
/// Samples of which the figures are looked at.
const KEPT: usize = 64;
/// Diameters at which an eye is likely to be, in millimetres: narrower than what the gate allows, so that a guess at
/// the unit is seldom wrong.
const LIKELY_MM: std::ops::RangeInclusive<f64> = 1.5..=9.0;
/// No tracker's samples of one eye are nearer to each other, or, while they come, farther apart.
const LIKELY_INTERVAL: std::ops::RangeInclusive<TimeNs> = TimeNs(100_000)..=TimeNs(1_000_000_000);
/// A step of noise alone, millimetres.
const SMALL_STEP_MM: f64 = 0.3;
/// Units that are mistaken for millimetres: their name, and millimetres for one of them.
const MISTAKEN_UNITS: [(&str, f64); 3] = [(MICROMETRES, 1e-3), ("centimetres", 10.0), ("metres", 1e3)];
const MICROMETRES: &str = "micrometres";
const MEASURE: &str = "measure an artificial pupil and set scale_mm_per_unit = its millimetres / the figure that stands \
                       here for it, which of an area A is 2·√(A/π)";

/// That nothing is believed, the most frequent reason, and what to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Messages and samples that were refused in a row, none that was believed between them; 0 where nothing was heard,
    /// or nothing that could be refused.
    pub refused: u64,
    /// The counter's name of the most frequent reason, or of what came and was no sample; nothing where nothing was
    /// heard.
    pub reason: String,
    /// What was found, and the likely cure.
    pub advice: String,
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.refused {
            0 => f.write_str(&self.advice),
            refused => write!(f, "none of {refused} samples is believed, {}: {}", self.reason, self.advice),
        }
    }
}

/// What has changed since the last look.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RefusalChange {
    /// No sample is believed any more, or none ever was, for this reason.
    Refused(Refusal),
    /// A sample was believed after everything had been refused.
    Believed,
}

/// Follows a tracker's decisions and counts, and finds out when everything is refused. Pure: it reads no clock.
#[derive(Clone, Debug)]
pub struct RefusalWatch {
    scale: Scale,
    figures: Figures,
    eye: rig::Eye,
    limits: GateSettings,
    began: TimeNs,
    /// The newest samples that were refused.
    samples: Vec<PupilSample>,
    /// The counts when a sample was believed last.
    believed: Option<CounterSnapshot>,
    /// A sample was believed with these settings.
    proven: bool,
    refused_since: Option<TimeNs>,
    unread: Unread,
    current: Option<Refusal>,
}

/// Millimetres for one of a tracker's figures.
#[derive(Clone, Copy, Debug)]
struct Scale {
    factor: f64,
    /// It is that of a recording, and no settings name another.
    is_recorded: bool,
}

impl Scale {
    fn of(settings: &rig::Tracker, figures: Figures) -> Self {
        let is_recorded = settings.scale.is_none() && figures.recorded_scale.is_some();
        Self { factor: figures.scale(settings).unwrap_or(1.0), is_recorded }
    }

    /// Where it is written.
    const fn place(self) -> &'static str {
        if self.is_recorded { "of the recording" } else { "in the rig file" }
    }
}

/// Bytes without a sample in them.
#[derive(Clone, Copy, Debug, Default)]
struct Unread {
    /// At the last look.
    bytes: u64,
    since: Option<TimeNs>,
    /// Looks at which there were more than at the one before.
    looks: u64,
}

impl Unread {
    fn look(&mut self, now: TimeNs, bytes: u64) {
        if bytes > self.bytes {
            self.bytes = bytes;
            self.since.get_or_insert(now);
            self.looks += 1;
        }
    }

    /// They go on coming: no sample is under way.
    fn is_long(&self, now: TimeNs) -> bool {
        self.looks >= LEAST_MESSAGES && self.since.is_some_and(|since| now - since >= UNHEARD_FOR)
    }
}

impl RefusalWatch {
    /// A watch over a tracker of such figures that was started with `settings` at host time `began`.
    pub fn new(settings: &rig::Tracker, figures: Figures, began: TimeNs) -> Self {
        Self {
            scale: Scale::of(settings, figures),
            figures,
            eye: settings.eye,
            limits: GateSettings::default(),
            began,
            samples: Vec::with_capacity(KEPT),
            believed: None,
            proven: false,
            refused_since: None,
            unread: Unread::default(),
            current: None,
        }
    }

    /// The tracker goes on with other settings, at these counts: what was refused before says nothing of them.
    pub fn change(&mut self, settings: &rig::Tracker, counts: &CounterSnapshot) {
        (self.scale, self.eye) = (Scale::of(settings, self.figures), settings.eye);
        self.samples.clear();
        self.believed = Some(*counts);
        self.proven = false;
        self.refused_since = None;
        self.unread = Unread { bytes: counts.of(Counter::Bytes), ..Unread::default() };
        self.current = None;
    }

    /// Takes note of a decision.
    pub fn note(&mut self, decision: &Decision) {
        // What is wrong with the eye that is followed, the other one's samples do not tell.
        if !matches!(decision.verdict, Verdict::Accepted | Verdict::Rejected(Rejection::OtherEye)) {
            if self.samples.len() == KEPT {
                self.samples.remove(0);
            }
            self.samples.push(decision.sample);
        }
    }

    /// What stands in the way now, as it was found; nothing while samples are believed.
    pub const fn current(&self) -> Option<&Refusal> {
        self.current.as_ref()
    }

    /// Looks at the counts of host time `now`; `over` where no sample comes any more. Tells each change once.
    pub fn judge(&mut self, now: TimeNs, counts: &CounterSnapshot, over: bool) -> Option<RefusalChange> {
        let before = *self.believed.get_or_insert_with(CounterSnapshot::zero);
        if counts.of(Counter::Accepted) > before.of(Counter::Accepted) {
            self.believed = Some(*counts);
            self.proven = true;
            self.refused_since = None;
            self.unread = Unread { bytes: counts.of(Counter::Bytes), ..Unread::default() };
            self.samples.clear();
            return self.current.take().map(|_| RefusalChange::Believed);
        }
        // What was said once holds until a sample is believed; that nothing was heard, until something is.
        if self.current.as_ref().is_some_and(|current| current.refused > 0 || counts.of(Counter::Bytes) == 0) {
            return None;
        }
        let refusal = self.refusal(now, counts, &before, over)?;
        self.current = Some(refusal.clone());
        Some(RefusalChange::Refused(refusal))
    }

    fn refusal(
        &mut self,
        now: TimeNs,
        counts: &CounterSnapshot,
        before: &CounterSnapshot,
        over: bool,
    ) -> Option<Refusal> {
        let faults = WireFault::ALL.into_iter().map(|fault| {
            let of = |counts: &CounterSnapshot| counts.fault(LogFault::Wire(fault));
            (Cause::Wire(fault), of(counts) - of(before))
        });
        let of_reason = |counts: &CounterSnapshot, reason| match reason {
            Rejection::Lost => counts.rejected(reason) - counts.lost_beside_faults(),
            _ => counts.rejected(reason),
        };
        let rejections = Rejection::ALL
            .into_iter()
            .map(|reason| (Cause::Gate(reason), of_reason(counts, reason).saturating_sub(of_reason(before, reason))));
        let causes: Vec<_> = faults.chain(rejections).filter(|(_, count)| *count > 0).collect();
        let refused: u64 = causes.iter().map(|(_, count)| count).sum();
        let samples = counts.of(Counter::Samples) - before.of(Counter::Samples);
        self.unread.look(now, counts.of(Counter::Bytes));
        let is_unread = samples == 0 && self.unread.is_long(now);
        if refused == 0 {
            return self.nothing_read(now, counts, before, over);
        }
        let since = *self.refused_since.get_or_insert(now);
        if !over && !is_unread && (now - since < REFUSED_FOR || refused < LEAST_MESSAGES) {
            return None;
        }
        // A sample beside a bad one is refused, too, and says nothing of the reason; nor does a time that came twice.
        // Nor does the other eye, where there are samples of the one that is followed.
        let is_followed =
            |(cause, _): &(Cause, u64)| matches!(cause, Cause::Gate(reason) if *reason != Rejection::OtherEye);
        let follows = causes.iter().any(is_followed);
        let weight = |cause: &Cause| match cause {
            Cause::Gate(Rejection::OtherEye) if follows => 0,
            Cause::Gate(Rejection::Guard | Rejection::Repeated) => 1,
            _ => 2,
        };
        // A followed eye whose every message is faulty is as frequent as the other one.
        let likely = |(cause, count): &(Cause, u64)| match cause {
            Cause::Gate(Rejection::OtherEye) => (weight(cause), count / 2),
            _ => (weight(cause), *count),
        };
        let (cause, _) = causes.into_iter().max_by_key(likely)?;
        // Once a tracker has worked, an eye that is shut or away for a while is no fault of its settings; some send
        // nothing of it meanwhile.
        let worked = before.of(Counter::Accepted) > 0;
        if worked && cause.is_of_the_viewer() || self.proven && cause == Cause::Gate(Rejection::OtherEye) {
            return None;
        }
        Some(Refusal { refused, reason: cause.name(), advice: self.advice(cause) })
    }

    /// What stands in the way where nothing was refused: other messages, bytes that are none, or silence.
    fn nothing_read(
        &mut self,
        now: TimeNs,
        counts: &CounterSnapshot,
        before: &CounterSnapshot,
        over: bool,
    ) -> Option<Refusal> {
        let since_before = |counter| counts.of(counter) - before.of(counter);
        let [samples, messages, bytes] = [Counter::Samples, Counter::Notes, Counter::Bytes].map(since_before);
        let is_known = |reason: &str| self.current.as_ref().is_some_and(|current| current.reason == reason);
        let is_all = over && before.of(Counter::Accepted) == 0;
        if messages > 0 && samples == 0 {
            let since = *self.refused_since.get_or_insert(now);
            let is_long = messages >= LEAST_MESSAGES && now - since >= REFUSED_FOR;
            return ((over || is_long) && !is_known(OTHER_MESSAGES)).then(|| Refusal {
                refused: 0,
                reason: OTHER_MESSAGES.into(),
                advice: format!("{messages} messages came, and none of them is of a pupil: {OTHER_MESSAGES_ADVICE}"),
            });
        }
        if bytes > 0 && samples == 0 && (self.unread.is_long(now) || is_all) {
            return (!is_known(UNREAD_BYTES)).then(|| Refusal {
                refused: 0,
                reason: UNREAD_BYTES.into(),
                advice: format!("{bytes} bytes came, and no sample was in them: {FORM_ADVICE}"),
            });
        }
        let unheard = counts.of(Counter::Connects) > 0 && counts.of(Counter::Bytes) == 0;
        (unheard && self.current.is_none() && now - self.began >= UNHEARD_FOR).then(|| Refusal {
            refused: 0,
            reason: String::new(),
            advice: "nothing has been heard of the tracker: is it switched on, and does it send without being asked?"
                .into(),
        })
    }

    fn advice(&self, cause: Cause) -> String {
        match cause {
            Cause::Wire(fault) => wire_advice(fault),
            Cause::Gate(reason) => self.gate_advice(reason),
        }
    }

    fn gate_advice(&self, reason: Rejection) -> String {
        let newest = |figure: fn(&PupilSample) -> f64| median(self.samples.iter().map(figure));
        match reason {
            Rejection::OutOfRange => self.range_advice(),
            Rejection::Lost => {
                "the tracker says that it sees no pupil: is an eye before its camera, lit and in focus?".into()
            }
            Rejection::NotFinite => {
                "the tracker sends NaN or infinity in the place of a figure: does it see the pupil, and \
                                     is it calibrated?"
                    .into()
            }
            Rejection::LowConfidence => format!(
                "the tracker's confidence is {:.2}, and {} is needed: set up its camera and its pupil detection anew; \
                 where it counts confidence in another way, give a profile that says how",
                newest(|sample| f64::from(sample.confidence)).unwrap_or(f64::NAN),
                self.limits.least_confidence
            ),
            Rejection::LidsClosed => format!(
                "the lids are {:.2} mm apart: is the eye open, and is the aperture in millimetres?",
                newest(|sample| sample.aperture_mm.map_or(f64::NAN, f64::from)).unwrap_or(f64::NAN)
            ),
            Rejection::OtherEye => {
                let eye = if self.eye == rig::Eye::Left { "right" } else { "left" };
                format!(
                    "its samples are of the {eye} eye, and this run follows the {}: give --eye {eye} or `holod ctl eye \
                     {eye}`, or set tracker.eye = \"{eye}\" in the rig file",
                    self.eye.name()
                )
            }
            Rejection::Backwards | Rejection::Repeated | Rejection::Guard | Rejection::Slew | Rejection::OutOfReach => {
                self.motion_advice(reason)
            }
        }
    }

    /// Diameters that are none: most often another unit.
    fn range_advice(&self) -> String {
        let figures = self.samples.iter().filter(|sample| sample.valid && sample.diameter_mm.is_finite());
        let Some(mm) = median(figures.map(|sample| f64::from(sample.diameter_mm))) else {
            return "the figures are no diameters of a pupil".into();
        };
        let figure = mm / self.scale.factor;
        let shown = significant(figure);
        let (least_mm, greatest_mm) = (self.limits.least_mm, self.limits.greatest_mm);
        if self.proven {
            let raw = figure / self.figures.mm_per_unit;
            let of_raw =
                if raw == mm { String::new() } else { format!(", which the tracker sends as {}", significant(raw)) };
            return format!(
                "{} mm{of_raw}: no pupil's diameter ({least_mm} to {greatest_mm} mm), though samples were believed before: \
                 does the tracker see the pupil?",
                significant(mm)
            );
        }
        if figure == 0.0 {
            return "the tracker sends 0: does it see the pupil?".into();
        }
        let Figures { unit, mm_per_unit, .. } = self.figures;
        if mm_per_unit != 1.0 {
            return self.profile_advice(figure / mm_per_unit, mm);
        }
        // Any figure may be a right one.
        if unit != SizeUnit::Millimetres {
            let made = match self.scale.factor {
                1.0 => String::new(),
                scale => format!(", nor are {} mm, which scale_mm_per_unit = {scale} makes of it", significant(mm)),
            };
            return format!(
                "{shown} in {}: no pupil's millimetres ({least_mm} to {greatest_mm}){made}; {MEASURE}",
                unit.name()
            );
        }
        if self.scale.factor != 1.0 && LIKELY_MM.contains(&figure) {
            let (of_recording, cure) = if self.scale.is_recorded {
                (" of the recording", "set scale_mm_per_unit = 1 in the rig file")
            } else {
                ("", "take that key out of the rig file")
            };
            return format!(
                "{shown}: looks like millimetres, which scale_mm_per_unit = {}{of_recording} makes {} mm; {cure}, or give \
                 --scale 1",
                self.scale.factor,
                significant(mm)
            );
        }
        // The figure as it came, or, where a scale that was measured has slipped, after the scale.
        let slips = [1.0, self.scale.factor].map(|scale| MISTAKEN_UNITS.map(|(unit, factor)| (unit, scale * factor)));
        if let Some((unit, scale)) = slips.concat().into_iter().find(|(_, scale)| LIKELY_MM.contains(&(figure * scale)))
        {
            let else_ = match unit {
                MICROMETRES => format!("; an EyeLink's own units look like this, too: for those {MEASURE}"),
                _ => String::new(),
            };
            return format!(
                "{shown}: looks like {unit}; if it is, scale_mm_per_unit = {scale} in the rig file, or --scale \
                 {scale}{else_}",
                scale = significant(scale)
            );
        }
        format!(
            "{shown}: no pupil's millimetres ({least_mm} to {greatest_mm}), and no other unit of length; if it is camera \
             pixels or the tracker's own unit, {MEASURE}"
        )
    }

    /// Diameters that the profile has made millimetres of `raw`, and the rig `mm`.
    fn profile_advice(&self, raw: f64, mm: f64) -> String {
        let (shown, factor) = (significant(raw), self.figures.mm_per_unit);
        if LIKELY_MM.contains(&raw) {
            return format!(
                "{shown}: looks like millimetres, which mm_per_unit = {factor} in the profile's [size] makes {} mm; take \
                 that key out, and write unit = \"mm\"",
                significant(raw * factor)
            );
        }
        let scaled = match self.scale.factor {
            1.0 => String::new(),
            scale => format!(" and scale_mm_per_unit = {scale} {}", self.scale.place()),
        };
        format!(
            "{shown}: mm_per_unit = {factor} in the profile's [size]{scaled} makes {} mm of it, which is no pupil's ({} to \
             {}); measure an artificial pupil and set mm_per_unit = its millimetres / the figure that stands here for it",
            significant(mm),
            self.limits.least_mm,
            self.limits.greatest_mm
        )
    }

    /// Figures or times that jump, or are too few.
    fn motion_advice(&self, reason: Rejection) -> String {
        let steps = |step: fn(&PupilSample, &PupilSample) -> f64| {
            let pairs = SampleEye::ALL.into_iter().flat_map(|eye| {
                let of_eye: Vec<_> = self.samples.iter().filter(|sample| sample.eye == eye).collect();
                of_eye.windows(2).map(|pair| step(pair[0], pair[1])).collect::<Vec<_>>()
            });
            median(pairs)
        };
        let taken = steps(|before, after| (after.t_device.0.saturating_sub(before.t_device.0)).abs() as f64);
        let arrived = steps(|before, after| (after.t_arrival.0.saturating_sub(before.t_arrival.0)).abs() as f64);
        let [interval, arrived] = [taken, arrived].map(|ns| ns.map(|ns| TimeNs(ns as i64)));
        let is_few = |apart: &TimeNs| *apart > LONGEST_GAP;
        let few = arrived.filter(is_few).or(interval.filter(is_few).filter(|apart| LIKELY_INTERVAL.contains(apart)));
        let jump_mm = steps(|before, after| f64::from((after.diameter_mm - before.diameter_mm).abs()));
        if let Some(apart) = few.filter(|_| reason == Rejection::Guard) {
            let rate_hz = 1.0 / apart.seconds();
            return format!("{rate_hz:.1} samples a second are too few: a live tracker gives 5 or more");
        }
        match (interval, jump_mm) {
            (Some(TimeNs(0)), _) => "its times do not advance: does the tracker's clock run?".into(),
            (Some(interval), _) if !LIKELY_INTERVAL.contains(&interval) => format!(
                "its times advance by {} from sample to sample, as no tracker's do: they look like another unit than the \
                 one that is expected, such as milliseconds in the place of microseconds; correct the sender, or the \
                 profile's unit of time",
                span(interval)
            ),
            (_, Some(jump_mm)) if reason != Rejection::Guard || jump_mm > SMALL_STEP_MM => format!(
                "the figures jump by {jump_mm:.2} mm from one to the next, as no pupil does: are they a pupil's diameter, \
                 of one eye?"
            ),
            (_, Some(_)) => {
                "each lies beside a silence or a sample that is refused: does the link lose samples, or bring \
                             them in bursts?"
                    .into()
            }
            (_, None) => "too few have come to tell more".into(),
        }
    }
}

/// Why a message or a sample was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cause {
    Wire(WireFault),
    Gate(Rejection),
}

impl Cause {
    fn name(self) -> String {
        match self {
            Self::Wire(fault) => fault.name().to_owned(),
            Self::Gate(reason) => format!("rejected_{}", reason.name()),
        }
    }

    /// Whether shut eyes, or a viewer who is not there, do this.
    const fn is_of_the_viewer(self) -> bool {
        matches!(
            self,
            Self::Gate(
                Rejection::Lost
                    | Rejection::LowConfidence
                    | Rejection::LidsClosed
                    | Rejection::NotFinite
                    | Rejection::Guard
                    | Rejection::Slew
                    | Rejection::OutOfReach
            ) | Self::Wire(WireFault::NotFinite | WireFault::Negative | WireFault::Uncalibrated)
        )
    }
}

fn wire_advice(fault: WireFault) -> String {
    match fault {
        WireFault::BadChecksum => "no message has the checksum that its profile expects: compare how the sender computes it \
                                   (holod's lines: CRC-8, polynomial 0x07, initial value 0, two hexadecimal digits, over \
                                   the bytes before `*`), or lower the baud rate if the line is noisy"
            .into(),
        WireFault::NotFinite => {
            "the tracker sends NaN or infinity in the place of a figure: does it see the pupil, and is it calibrated?".into()
        }
        WireFault::Negative => "the tracker sends negative diameters: does it see the pupil, and is this its profile?".into(),
        WireFault::BadConfidence => {
            "the confidence is not between 0 and 1: let the sender divide it, or give a profile that does; where the sender \
             writes decimal commas (3,75 for 3.75), let it write points"
                .into()
        }
        WireFault::MissingField => {
            "messages lack a figure that the profile reads: is it this tracker's profile? Where it names columns, are they \
             those of the tracker's header line, and is each there once? Where that line is sent at the tracker's start \
             alone, restart the tracker, or write `columns = [...]` in the profile"
                .into()
        }
        WireFault::Uncalibrated => {
            "the tracker sees the pupil and gives no millimetres: calibrate it, or \
             take a copy of its profile with size = \"pixels\" and set scale_mm_per_unit"
                .into()
        }
        WireFault::MoreFields => {
            "lines hold more figures than the tracker's header, or `columns = [...]` of its profile, has names: where the \
             sender writes decimal commas (3,75 for 3.75), let it write points, or part its columns by another sign; else \
             name all of its columns in the profile"
                .into()
        }
        WireFault::MoreViews => {
            "it sends figures of more eyes or cameras than the profile has: take a copy of the profile with eyes = \"two\" \
             and no eye at the top, or with stereo = true, and name it (profile=./FILE.toml)"
                .into()
        }
        WireFault::BadEye => "the eye is named otherwise than the profile expects: is this the tracker's profile?".into(),
        _ => format!("no message is of the form that the profile expects: {FORM_ADVICE}"),
    }
}

fn median(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    Sorted::new(values.into_iter().filter(|value| value.is_finite())).map(|sorted| sorted.median())
}

/// Four significant digits, without zeros behind them.
fn significant(value: f64) -> f64 {
    format!("{value:.3e}").parse().unwrap_or(value)
}

fn span(t: TimeNs) -> String {
    let (unit, ns) = [("s", 1e9), ("ms", 1e6), ("µs", 1e3), ("ns", 1.0)]
        .into_iter()
        .find(|(_, ns)| t.0 as f64 >= *ns)
        .unwrap_or(("ns", 1.0));
    format!("{} {unit}", significant(t.0 as f64 / ns))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::counters::Counters;
    use crate::estimator::{Estimator, EstimatorSettings};

    const MS: i64 = 1_000_000;
    const MILLIMETRES: Figures = Figures { unit: SizeUnit::Millimetres, mm_per_unit: 1.0, recorded_scale: None };

    fn settings() -> rig::Tracker {
        rig::Rig::default().tracker
    }

    fn sample(k: i64) -> PupilSample {
        let t = TimeNs(k * 5 * MS);
        PupilSample {
            t_device: t,
            t_sample: t,
            t_arrival: t,
            eye: SampleEye::Left,
            diameter_mm: 3.5,
            confidence: 1.0,
            aperture_mm: None,
            sequence: None,
            valid: true,
        }
    }

    /// Sends `count` samples at 200 Hz through gate and watch and looks ten times a second, as the daemon does; what
    /// was told, and when.
    fn told(settings: &rig::Tracker, count: i64, of: impl Fn(i64) -> PupilSample) -> Vec<(TimeNs, RefusalChange)> {
        told_of(settings, MILLIMETRES, count, of)
    }

    fn told_of(
        settings: &rig::Tracker,
        figures: Figures,
        count: i64,
        of: impl Fn(i64) -> PupilSample,
    ) -> Vec<(TimeNs, RefusalChange)> {
        let counters = Counters::new();
        let mut estimator = Estimator::new(EstimatorSettings::from(&figures.scaled(settings)));
        let mut watch = RefusalWatch::new(settings, figures, TimeNs(0));
        let mut told = Vec::new();
        for k in 0..count {
            counters.add(Counter::Samples, 1);
            estimator.push(of(k), |decision: Decision| {
                match decision.verdict {
                    Verdict::Accepted => counters.add(Counter::Accepted, 1),
                    Verdict::Rejected(reason) => counters.add_rejected(reason),
                }
                watch.note(&decision);
            });
            let now = TimeNs(k * 5 * MS);
            if k % 20 == 0 {
                told.extend(watch.judge(now, &counters.snapshot(), false).map(|change| (now, change)));
            }
        }
        told
    }

    /// What is said of samples that are all refused, once and within two seconds.
    fn advice(settings: &rig::Tracker, of: impl Fn(i64) -> PupilSample) -> String {
        advice_of(settings, MILLIMETRES, of)
    }

    fn advice_of(settings: &rig::Tracker, figures: Figures, of: impl Fn(i64) -> PupilSample) -> String {
        let told = told_of(settings, figures, 2000, of);
        let [(t, RefusalChange::Refused(refusal))] = &told[..] else { panic!("told once: {told:?}") };
        assert!(*t <= TimeNs(2_000 * MS), "{t:?}");
        refusal.to_string()
    }

    #[test]
    fn other_settings_are_judged_anew() {
        let counters = Counters::new();
        let of_scale = |scale| rig::Tracker { scale: Some(scale), ..settings() };
        let mut watch = RefusalWatch::new(&of_scale(100.0), MILLIMETRES, TimeNs(0));
        let mut said = Vec::new();
        for k in 0..80_i64 {
            let scale = if k < 40 { 100.0 } else { 50.0 };
            if k == 40 {
                watch.change(&of_scale(scale), &counters.snapshot());
                assert_eq!(watch.current(), None);
            }
            counters.add_rejected(Rejection::OutOfRange);
            let sample = PupilSample { diameter_mm: 3.5 * scale as f32, ..sample(k) };
            watch.note(&Decision { sample, verdict: Verdict::Rejected(Rejection::OutOfRange) });
            if let Some(RefusalChange::Refused(refusal)) =
                watch.judge(TimeNs(k * 100 * MS), &counters.snapshot(), false)
            {
                said.push(refusal.to_string());
            }
        }
        let [before, after] = &said[..] else { panic!("each is told once: {said:?}") };
        assert!(before.contains("scale_mm_per_unit = 100 makes 350 mm"), "{before}");
        assert!(after.contains("scale_mm_per_unit = 50 makes 175 mm"), "{after}");
    }

    #[test]
    fn samples_that_are_believed_are_no_matter() {
        assert_eq!(told(&settings(), 2000, sample), []);
        // A blink of half a second, with the eye lost, and a pause of three seconds.
        let lost = |k: i64| PupilSample { valid: !(400..500).contains(&k) && !(800..1400).contains(&k), ..sample(k) };
        assert_eq!(told(&settings(), 2000, lost), []);
    }

    #[test]
    fn each_unit_that_is_mistaken_for_millimetres_is_named_with_its_scale() {
        let cases = [
            (3500.0, None, "3500: looks like micrometres; if it is, scale_mm_per_unit = 0.001"),
            (3500.0, None, "--scale 0.001; an EyeLink's own units look like this, too"),
            (0.35, None, "0.35: looks like centimetres; if it is, scale_mm_per_unit = 10 "),
            (0.0035, None, "0.0035: looks like metres; if it is, scale_mm_per_unit = 1000 "),
            (3.5, Some(0.0125), "3.5: looks like millimetres, which scale_mm_per_unit = 0.0125 makes 0.04375 mm"),
            (3500.0, Some(2.0), "3500: looks like micrometres; if it is, scale_mm_per_unit = 0.001"),
            (70.0, Some(50.0), "70: looks like micrometres; if it is, scale_mm_per_unit = 0.05"),
            (41.3, None, "41.3: no pupil's millimetres"),
            (0.0, None, "sends 0"),
        ];
        for (figure, scale, expected) in cases {
            let settings = rig::Tracker { scale, ..settings() };
            let said = advice(&settings, |k| PupilSample { diameter_mm: figure, ..sample(k) });
            assert!(said.contains(expected) && said.contains("rejected_out_of_range"), "{said}");
        }
    }

    #[test]
    fn no_unit_of_length_is_guessed_of_what_is_none() {
        let arbitrary = Figures { unit: SizeUnit::Arbitrary, ..MILLIMETRES };
        let known = Figures { mm_per_unit: 0.05, ..MILLIMETRES };
        let cases = [
            (arbitrary, 3303.0, 1.0, "3303 in arbitrary units: no pupil's millimetres (1 to 9); measure an artificial"),
            (arbitrary, 3303.0, 0.01, "nor are 33.03 mm, which scale_mm_per_unit = 0.01 makes of it; measure"),
            (arbitrary, 0.35, 1.0, "0.35 in arbitrary units"),
            (
                known,
                0.2,
                1.0,
                "4: looks like millimetres, which mm_per_unit = 0.05 in the profile's [size] makes 0.2 mm",
            ),
            (known, 20.0, 1.0, "400: mm_per_unit = 0.05 in the profile's [size] makes 20 mm of it"),
            (known, 20.0, 2.0, "[size] and scale_mm_per_unit = 2 in the rig file makes 40 mm"),
        ];
        for (figures, figure, scale, expected) in cases {
            let settings = rig::Tracker { scale: Some(scale), ..settings() };
            let said = advice_of(&settings, figures, |k| PupilSample { diameter_mm: figure, ..sample(k) });
            assert!(said.contains(expected) && !said.contains("metres;"), "{said}");
        }
    }

    #[test]
    fn the_scale_of_a_recording_is_taken_out_of_the_figures_that_are_told() {
        let pixels = Figures { unit: SizeUnit::Pixels, mm_per_unit: 1.0, recorded_scale: Some(0.05) };
        let cases = [
            (pixels, 300.0, None, "300 in camera pixels: no pupil's millimetres (1 to 9), nor are 15 mm, which"),
            (pixels, 300.0, Some(0.1), "300 in camera pixels: no pupil's millimetres (1 to 9), nor are 30 mm, which"),
            (
                Figures { unit: SizeUnit::Millimetres, ..pixels },
                3.5,
                None,
                "3.5: looks like millimetres, which scale_mm_per_unit = 0.05 of the recording makes 0.175 mm; set \
                 scale_mm_per_unit = 1 in the rig file, or give --scale 1",
            ),
            (
                Figures { mm_per_unit: 2.0, ..pixels },
                300.0,
                None,
                "[size] and scale_mm_per_unit = 0.05 of the recording",
            ),
        ];
        for (figures, figure, scale, expected) in cases {
            let settings = rig::Tracker { scale, ..settings() };
            let said = advice_of(&settings, figures, |k| PupilSample { diameter_mm: figure, ..sample(k) });
            assert!(said.contains(expected), "{said}");
        }
        // Other settings, which name no scale either.
        let mut watch = RefusalWatch::new(&rig::Tracker { scale: Some(0.1), ..settings() }, pixels, TimeNs(0));
        watch.change(&settings(), &CounterSnapshot::zero());
        let counters = Counters::new();
        counters.add_rejected(Rejection::OutOfRange);
        let sample = PupilSample { diameter_mm: 15.0, ..sample(0) };
        watch.note(&Decision { sample, verdict: Verdict::Rejected(Rejection::OutOfRange) });
        let said = watch.judge(TimeNs(0), &counters.snapshot(), true);
        let Some(RefusalChange::Refused(refusal)) = said else { panic!("{said:?}") };
        assert!(refusal.advice.starts_with("300 in camera pixels"), "{refusal}");
    }

    #[test]
    fn samples_that_are_too_few_are_told_so() {
        let sparse = |apart_ms: i64| {
            move |k: i64| {
                let t = TimeNs(k * apart_ms * MS);
                PupilSample { t_device: t, t_sample: t, t_arrival: t, ..sample(k) }
            }
        };
        for (apart_ms, expected) in [(500, "2.0 samples a second are too few"), (2000, "0.5 samples a second")] {
            let said = advice(&settings(), sparse(apart_ms));
            assert!(said.contains(expected), "{said}");
        }
        // The clock of a tracker that is kept up by its link says nothing of it.
        let late = |k: i64| PupilSample { t_device: sample(k).t_device, ..sparse(600)(k) };
        let said = advice(&settings(), late);
        assert!(said.contains("1.7 samples a second are too few"), "{said}");
        // One of each eye.
        let counters = Counters::new();
        let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
        for eye in [SampleEye::Left, SampleEye::Right] {
            counters.add_rejected(Rejection::Guard);
            let sample = PupilSample { eye, ..sample(0) };
            watch.note(&Decision { sample, verdict: Verdict::Rejected(Rejection::Guard) });
        }
        let said = watch.judge(TimeNs(0), &counters.snapshot(), true);
        assert!(
            matches!(&said, Some(RefusalChange::Refused(refusal)) if refusal.advice == "too few have come to tell more"),
            "{said:?}"
        );
    }

    #[test]
    fn bytes_without_a_message_are_told_once() {
        let counters = Counters::new();
        let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
        counters.add(Counter::Connects, 1);
        counters.add(Counter::Partials, 1);
        let mut told = Vec::new();
        for tenth in 1..40 {
            counters.add(Counter::Bytes, 90);
            told.extend(
                watch.judge(TimeNs(tenth * 100 * MS), &counters.snapshot(), false).map(|change| (tenth, change)),
            );
        }
        let [(19, RefusalChange::Refused(refusal))] = &told[..] else { panic!("{told:?}") };
        assert!(refusal.to_string().starts_with("1710 bytes came, and no sample was in them"), "{refusal}");
        counters.add(Counter::Samples, 5);
        counters.add(Counter::Accepted, 5);
        assert_eq!(watch.judge(TimeNs(5_000 * MS), &counters.snapshot(), false), Some(RefusalChange::Believed));
        // The beginning of a line, and then silence: the link tells that.
        counters.add(Counter::Bytes, 9);
        for tenth in 51..90 {
            assert_eq!(watch.judge(TimeNs(tenth * 100 * MS), &counters.snapshot(), false), None);
        }
        assert_eq!(watch.judge(TimeNs(9_000 * MS), &counters.snapshot(), true), None, "the log's last line is cut off");
    }

    #[test]
    fn one_fault_and_then_bytes_alone_are_told_as_the_fault() {
        let counters = Counters::new();
        let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
        counters.add_fault(LogFault::Wire(WireFault::OutOfStep), 1);
        let mut told = Vec::new();
        for tenth in 1..40 {
            counters.add(Counter::Bytes, 90);
            told.extend(watch.judge(TimeNs(tenth * 100 * MS), &counters.snapshot(), false));
        }
        let [RefusalChange::Refused(refusal)] = &told[..] else { panic!("{told:?}") };
        assert_eq!((refusal.refused, refusal.reason.as_str()), (1, "wire_out_of_step"));
    }

    #[test]
    fn a_log_of_bytes_without_a_sample_is_told_at_its_end() {
        let counters = Counters::new();
        let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
        counters.add(Counter::Bytes, 90);
        assert!(watch.judge(TimeNs(0), &counters.snapshot(), true).is_some());
    }

    /// As [`told`] of a tracker of two eyes, of which the rig follows the left one.
    fn told_of_two_eyes(count: i64, left: impl Fn(i64) -> PupilSample) -> Vec<RefusalChange> {
        let settings = rig::Tracker { eye: rig::Eye::Left, ..settings() };
        let of = |k: i64| PupilSample {
            t_sample: sample(k / 2).t_sample,
            t_device: sample(k / 2).t_device,
            ..if k % 2 == 0 { left(k / 2) } else { PupilSample { eye: SampleEye::Right, ..sample(k) } }
        };
        told(&settings, count, of).into_iter().map(|(_, change)| change).collect()
    }

    #[test]
    fn an_eye_that_is_shut_is_not_taken_for_the_wrong_one() {
        // Shut from the beginning: the camera sees none.
        let said = told_of_two_eyes(2000, |k| PupilSample { valid: false, ..sample(k) });
        let [RefusalChange::Refused(refusal)] = &said[..] else { panic!("{said:?}") };
        assert!(refusal.reason == "rejected_lost" && refusal.advice.contains("sees no pupil"), "{refusal}");
        // Unsure, beside an eye that is not: the figures are those of the one that is followed.
        let said = told_of_two_eyes(2000, |k| PupilSample { confidence: 0.3, ..sample(k) });
        let [RefusalChange::Refused(refusal)] = &said[..] else { panic!("{said:?}") };
        assert!(refusal.advice.contains("confidence is 0.30"), "{refusal}");
        // Shut for three seconds in a run that had worked; some trackers send the other eye alone then.
        let shut = 400..1000;
        let said = told_of_two_eyes(3000, |k| PupilSample { valid: !shut.contains(&k), ..sample(k) });
        assert_eq!(said, []);
        let gone = |k| if shut.contains(&k) { PupilSample { eye: SampleEye::Right, ..sample(k) } } else { sample(k) };
        assert_eq!(told_of_two_eyes(3000, gone), []);
    }

    #[test]
    fn faults_of_the_followed_eye_are_told_before_the_other_eye() {
        for (faults, expected) in [(40, "wire_missing_field"), (3, "rejected_other_eye")] {
            let counters = Counters::new();
            let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
            counters.add_fault(LogFault::Wire(WireFault::MissingField), faults);
            (0..41).for_each(|_| counters.add_rejected(Rejection::OtherEye));
            let said = watch.judge(TimeNs(0), &counters.snapshot(), true);
            assert!(matches!(&said, Some(RefusalChange::Refused(refusal)) if refusal.reason == expected), "{said:?}");
        }
    }

    #[test]
    fn no_unit_is_guessed_once_samples_were_believed() {
        let collapsed = |k: i64| PupilSample { diameter_mm: if k < 800 { 3.6 } else { 0.5 }, ..sample(k) };
        let said = told(&settings(), 1400, collapsed);
        let [(_, RefusalChange::Refused(refusal))] = &said[..] else { panic!("{said:?}") };
        assert!(refusal.advice.starts_with("0.5 mm: no pupil's diameter (1 to 9 mm)"), "{refusal}");
        assert!(!refusal.advice.contains("scale"), "{refusal}");
        let scaled = rig::Tracker { scale: Some(0.5), ..settings() };
        let said = told(&scaled, 1400, collapsed);
        let [(_, RefusalChange::Refused(refusal))] = &said[..] else { panic!("{said:?}") };
        assert!(
            refusal.advice.starts_with("0.25 mm, which the tracker sends as 0.5: no pupil's diameter (1 to 9 mm)"),
            "{refusal}"
        );
    }

    #[test]
    fn each_other_reason_is_named_with_its_cure() {
        type Spoil = fn(i64, &mut PupilSample);
        let cases: [(Spoil, &str); 8] = [
            (|_, s| s.diameter_mm = f32::NAN, "NaN"),
            (|_, s| s.valid = false, "sees no pupil"),
            (|_, s| s.confidence = 0.3, "confidence is 0.30"),
            (|_, s| s.aperture_mm = Some(0.4), "lids are 0.40 mm apart"),
            (|_, s| s.eye = SampleEye::Right, "this run follows the left: give --eye right or `holod ctl eye right`"),
            // A clock that seems to stand is found to have been reset again and again.
            (|k, s| (s.t_device, s.t_sample) = (TimeNs(5_000 * k), TimeNs(k / 60 * 300 * MS + k % 60)), "5 µs"),
            (|k, s| (s.t_device, s.t_sample) = (TimeNs(5_000 * MS * k), TimeNs(5_000 * MS * k)), "5 s"),
            (|k, s| s.diameter_mm = if k % 2 == 0 { 2.0 } else { 6.0 }, "jump by 4.00 mm"),
        ];
        for (spoil, expected) in cases {
            let settings = rig::Tracker { eye: rig::Eye::Left, ..settings() };
            let said = advice(&settings, |k| {
                let mut sample = sample(k);
                spoil(k, &mut sample);
                sample
            });
            assert!(said.contains(expected), "{expected}: {said}");
        }
    }

    #[test]
    fn messages_that_are_no_samples_are_told_with_their_fault() {
        for (fault, expected) in [
            (WireFault::BadChecksum, "CRC-8"),
            (WireFault::Malformed, "profile and baud"),
            (WireFault::NotFinite, "NaN"),
            (WireFault::MoreViews, "eyes = \"two\""),
            (WireFault::MoreFields, "decimal commas"),
        ] {
            let counters = Counters::new();
            let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
            counters.add(Counter::Connects, 1);
            counters.add(Counter::Bytes, 30);
            counters.add_fault(LogFault::Wire(fault), 4);
            assert_eq!(watch.judge(TimeNs(0), &counters.snapshot(), false), None);
            assert_eq!(watch.judge(TimeNs(1_500 * MS), &counters.snapshot(), false), None, "too few to tell");
            counters.add_fault(LogFault::Wire(fault), 40);
            let said = watch.judge(TimeNs(1_500 * MS), &counters.snapshot(), false);
            let Some(RefusalChange::Refused(refusal)) = said else { panic!("{said:?}") };
            assert_eq!((refusal.refused, refusal.reason.as_str()), (44, fault.name()));
            assert!(refusal.to_string().contains(expected), "{refusal}");
            // And once a sample is believed, that.
            counters.add(Counter::Accepted, 1);
            let said = watch.judge(TimeNs(1_600 * MS), &counters.snapshot(), false);
            assert_eq!(said, Some(RefusalChange::Believed));
            assert_eq!(watch.current(), None);
        }
    }

    #[test]
    fn a_figure_that_is_none_is_told_as_its_fault_and_counted_once() {
        let counters = Counters::new();
        let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
        assert_eq!(watch.judge(TimeNs(0), &counters.snapshot(), false), None);
        for _ in 0..40 {
            counters.add(Counter::Samples, 1);
            counters.add_fault(LogFault::Wire(WireFault::Negative), 1);
            counters.add_rejected(Rejection::Lost);
        }
        let said = watch.judge(TimeNs(1_500 * MS), &counters.snapshot(), true);
        let Some(RefusalChange::Refused(refusal)) = said else { panic!("{said:?}") };
        assert_eq!((refusal.refused, refusal.reason.as_str()), (40, "wire_negative"));
    }

    #[test]
    fn silence_is_told_and_what_is_heard_after_it() {
        let counters = Counters::new();
        let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
        counters.add(Counter::Connects, 1);
        assert_eq!(watch.judge(TimeNs(1_000 * MS), &counters.snapshot(), false), None);
        let said = watch.judge(TimeNs(2_000 * MS), &counters.snapshot(), false);
        assert!(
            matches!(said, Some(RefusalChange::Refused(refusal)) if refusal.to_string().contains("nothing has been heard"))
        );
        assert_eq!(watch.judge(TimeNs(3_000 * MS), &counters.snapshot(), false), None);
        counters.add(Counter::Bytes, 300);
        counters.add_fault(LogFault::Wire(WireFault::BadChecksum), 40);
        assert_eq!(watch.judge(TimeNs(4_000 * MS), &counters.snapshot(), false), None);
        let said = watch.judge(TimeNs(5_000 * MS), &counters.snapshot(), false);
        assert!(matches!(said, Some(RefusalChange::Refused(refusal)) if refusal.reason == "wire_bad_checksum"));
    }

    #[test]
    fn messages_that_are_of_no_pupil_are_told_once() {
        let counters = Counters::new();
        let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
        counters.add(Counter::Connects, 1);
        let mut told = Vec::new();
        for tenth in 1..40 {
            counters.add(Counter::Bytes, 90);
            counters.add(Counter::Notes, 10);
            told.extend(
                watch.judge(TimeNs(tenth * 100 * MS), &counters.snapshot(), false).map(|change| (tenth, change)),
            );
        }
        let [(11, RefusalChange::Refused(refusal))] = &told[..] else { panic!("{told:?}") };
        assert!(
            refusal.to_string().starts_with("110 messages came") && refusal.advice.contains("eye state"),
            "{refusal}"
        );
        // Among samples such messages are nothing to tell.
        counters.add(Counter::Samples, 5);
        counters.add(Counter::Accepted, 5);
        assert_eq!(watch.judge(TimeNs(5_000 * MS), &counters.snapshot(), false), Some(RefusalChange::Believed));
        for tenth in 51..90 {
            counters.add(Counter::Notes, 10);
            counters.add(Counter::Samples, 5);
            counters.add(Counter::Accepted, 5);
            assert_eq!(watch.judge(TimeNs(tenth * 100 * MS), &counters.snapshot(), false), None);
        }
    }

    #[test]
    fn a_log_that_has_ended_is_judged_at_once() {
        let counters = Counters::new();
        let mut watch = RefusalWatch::new(&settings(), MILLIMETRES, TimeNs(0));
        counters.add_rejected(Rejection::Lost);
        assert!(watch.judge(TimeNs(0), &counters.snapshot(), true).is_some());
    }
}
