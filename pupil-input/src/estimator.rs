//! From samples to `pupil_at(t)`: gate and filter per eye, eyes combined or chosen, hold, fallback and the slides
//! between.

use holod_calibration::{PupilDiameter, TimeNs, rig};

use crate::filter::{Filter, FilterSettings, Motion};
use crate::gate::{Expected, Gate, GateSettings, Rejection, Verdict};
use crate::{PupilSample, SampleEye};

/// With the default settings the estimate of the present moment is never farther behind a moving pupil than this: the
/// gate's lead, and the filter's rise at the onset of a reflex.
pub const STATED_LAG: TimeNs = TimeNs(50_000_000);

/// A first believed sample this soon after the begin is shown at once: hardly anything was shown before.
const SHOWN_AT_ONCE: TimeNs = TimeNs(500_000_000);
/// Longer than a lid that is slow takes to show as one: where the pupil was, is asked so long before the newest sample,
/// and at most twice as long.
const EARLIER: TimeNs = TimeNs(100_000_000);
/// What was slid to is reached when no more than this is left.
const REACHED_MM: f32 = 0.1;

/// How samples become an estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EstimatorSettings {
    /// Whose samples drive the display.
    pub eye: rig::Eye,
    /// Factor from the tracker's figure to millimetres.
    pub scale: f64,
    /// Diameter to slide to when nothing has been believed for longer than `hold`.
    pub fallback: PupilDiameter,
    /// How long the last good value is held; not shorter than `silence` and what is said there, since samples are not
    /// known sooner.
    pub hold: TimeNs,
    /// Speed of the slide to the fallback, mm/s.
    pub fallback_mm_per_s: f32,
    /// Speed at which a difference between what is shown and what is measured is worked off when samples come back,
    /// mm/s.
    pub return_mm_per_s: f32,
    /// A stream whose last believed sample is older than this, and than the gate's lead and three of the tracker's
    /// usual intervals, is held.
    pub silence: TimeNs,
    /// Over how long the difference between the two eyes is learnt.
    pub eye_offset: TimeNs,
    /// How the better eye is chosen; used for [`rig::Eye::Better`] only.
    pub better: BetterSettings,
    /// Limits of the gate.
    pub gate: GateSettings,
    /// Tuning of the filter.
    pub filter: FilterSettings,
}

/// How the better of two eyes is chosen. A change of eye slides like every other change of what is shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BetterSettings {
    /// Over how long confidences are averaged.
    pub recent: TimeNs,
    /// The other eye's recent confidence must be higher by this.
    pub margin: f32,
    /// For this long neither eye must have been lost or come back; longer than eyes differ at either end of a blink.
    pub settles: TimeNs,
}

impl From<&rig::Tracker> for EstimatorSettings {
    fn from(tracker: &rig::Tracker) -> Self {
        Self {
            eye: tracker.eye,
            scale: tracker.scale.unwrap_or(1.0),
            fallback: tracker.fallback,
            hold: tracker.hold,
            fallback_mm_per_s: 1.3,
            return_mm_per_s: 4.0,
            silence: TimeNs(150_000_000),
            eye_offset: TimeNs(1_000_000_000),
            better: BetterSettings { recent: TimeNs(500_000_000), margin: 0.1, settles: TimeNs(150_000_000) },
            gate: GateSettings::default(),
            filter: FilterSettings::default(),
        }
    }
}

/// What the estimate rests on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PupilState {
    /// The slide from the fallback to fresh samples, farther than a tenth of a millimetre from them.
    Acquiring,
    /// Fresh samples that were believed, as the filter has them.
    Tracking,
    /// The last good value, through a blink or a short loss.
    Holding,
    /// The configured diameter, or the slide to it: nothing has been believed for long, or ever.
    Fallback,
}

impl PupilState {
    /// Every state, in the order of the enum.
    pub const ALL: [Self; 4] = [Self::Acquiring, Self::Tracking, Self::Holding, Self::Fallback];

    /// The name used in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Acquiring => "acquiring",
            Self::Tracking => "tracking",
            Self::Holding => "holding",
            Self::Fallback => "fallback",
        }
    }
}

/// The pupil at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PupilEstimate {
    /// The diameter to render for.
    pub pupil: PupilDiameter,
    /// What it rests on.
    pub state: PupilState,
    /// When the newest sample was taken that the estimate rests on, one that is believed; nothing in the fallback, which
    /// rests on none.
    pub t_sample: Option<TimeNs>,
    /// That sample's diameter as measured, scaled to millimetres.
    pub raw_mm: Option<f32>,
    /// When the newest sample was taken that came of an eye that drives the display, believed or not.
    pub t_heard: Option<TimeNs>,
    /// Rate of change of `pupil`, mm/s.
    pub velocity_mm_per_s: f32,
}

/// A verdict on a sample, for plots and records.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decision {
    /// The sample, scaled to millimetres.
    pub sample: PupilSample,
    /// What the gate said.
    pub verdict: Verdict,
}

/// All that `pupil_at` needs, frozen after a sample: small, `Copy`, and valid for any later time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EstimateSnapshot {
    /// The combined motion at the last believed sample.
    motion: Option<Motion>,
    /// A bad sample has come since.
    lost: bool,
    /// Difference between what was shown and the motion, and when; worked off at the return speed.
    blend: Blend,
    /// The newest believed sample of the eyes that are combined.
    believed: Option<Measured>,
    t_heard: Option<TimeNs>,
    /// A last believed sample older than this is held.
    silence: TimeNs,
    clock: StreamClock,
    settings: EstimatorSettings,
}

/// A sample as measured, scaled to millimetres.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Measured {
    t: TimeNs,
    diameter_mm: f32,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Blend {
    t: TimeNs,
    excess_mm: f32,
    /// It began at the fallback, or on the way to it.
    acquires: bool,
}

impl Blend {
    const NONE: Self = Self { t: TimeNs(0), excess_mm: 0.0, acquires: false };

    /// What is left of the difference at `t`, with its sign.
    fn left_mm(&self, t: TimeNs, return_mm_per_s: f32) -> f32 {
        let worked_off_mm = return_mm_per_s * (t - self.t).seconds().max(0.0) as f32;
        (self.excess_mm.abs() - worked_off_mm).max(0.0).copysign(self.excess_mm)
    }
}

/// Host time to the stream's time, for logs that are replayed at another speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct StreamClock {
    pub(crate) host: TimeNs,
    pub(crate) stream: TimeNs,
    /// Stream seconds in a host second.
    pub(crate) rate: f64,
}

impl StreamClock {
    /// The stream's time is the host's.
    pub(crate) const LIVE: Self = Self { host: TimeNs(0), stream: TimeNs(0), rate: 1.0 };

    pub(crate) fn to_stream(self, host: TimeNs) -> TimeNs {
        TimeNs(self.stream.0.saturating_add(scaled(host - self.host, self.rate).0))
    }

    pub(crate) fn to_host(self, stream: TimeNs) -> TimeNs {
        TimeNs(self.host.0.saturating_add(scaled(stream - self.stream, 1.0 / self.rate).0))
    }
}

fn scaled(span: TimeNs, factor: f64) -> TimeNs {
    if factor == 1.0 { span } else { TimeNs((span.0 as f64 * factor).round() as i64) }
}

impl EstimateSnapshot {
    /// What is known before any sample.
    pub fn new(settings: EstimatorSettings) -> Self {
        Self {
            motion: None,
            lost: false,
            blend: Blend::NONE,
            believed: None,
            t_heard: None,
            silence: settings.silence,
            clock: StreamClock::LIVE,
            settings,
        }
    }

    /// The pupil at host time `t`, which may lie in the future. Pure: no clock is read, nothing is allocated.
    pub fn pupil_at(&self, t: TimeNs) -> PupilEstimate {
        let shown = self.shown_at(self.clock.to_stream(t));
        let believed = self.believed.filter(|_| shown.state != PupilState::Fallback);
        PupilEstimate {
            pupil: PupilDiameter::from_mm(shown.diameter_mm),
            state: shown.state,
            t_sample: believed.map(|sample| self.clock.to_host(sample.t)),
            raw_mm: believed.map(|sample| sample.diameter_mm),
            t_heard: self.t_heard.map(|t_heard| self.clock.to_host(t_heard)),
            velocity_mm_per_s: shown.velocity_mm_per_s * self.clock.rate as f32,
        }
    }

    /// Goes on with other settings from `t` on, from what is shown then; those before are handed back.
    fn change(&mut self, settings: EstimatorSettings, t: TimeNs) -> EstimatorSettings {
        let shown = self.shown_at(t);
        let before = std::mem::replace(&mut self.settings, settings);
        let t_believed = match (shown.state, self.motion) {
            (PupilState::Acquiring | PupilState::Tracking, _) => return before,
            (PupilState::Holding, Some(motion)) => motion.t.max(t - self.hold()),
            // What is not held any more is not held again.
            _ => t - self.hold() - TimeNs(1),
        };
        self.motion = Some(Motion {
            t: t_believed,
            diameter_mm: shown.diameter_mm,
            velocity_mm_per_s: 0.0,
            velocity_lasts: settings.filter.velocity_lasts,
        });
        self.blend = Blend::NONE;
        self.lost = true;
        before
    }

    pub(crate) const fn set_clock(&mut self, clock: StreamClock) {
        self.clock = clock;
    }

    /// How long a believed sample is followed or held.
    fn hold(&self) -> TimeNs {
        self.settings.hold.max(self.silence)
    }

    fn shown_at(&self, t: TimeNs) -> Shown {
        let settings = &self.settings;
        let fallback_mm = settings.fallback.mm();
        let Some(motion) = self.motion else {
            return Shown { diameter_mm: fallback_mm, velocity_mm_per_s: 0.0, state: PupilState::Fallback };
        };
        let hold = self.hold();
        // Samples that were older than `hold` when they became known begin a slide then, not before.
        let slide_begins = (motion.t + hold).max(self.blend.t);
        let followed = self.followed_at(&motion, t.min(slide_begins));
        let age = t - motion.t;
        let (diameter_mm, velocity_mm_per_s, state) = if age > hold {
            let left_mm = fallback_mm - followed.0;
            let slid_mm = settings.fallback_mm_per_s * (t - slide_begins).seconds().max(0.0) as f32;
            let velocity = if slid_mm < left_mm.abs() { settings.fallback_mm_per_s.copysign(left_mm) } else { 0.0 };
            (followed.0 + slid_mm.min(left_mm.abs()).copysign(left_mm), velocity, PupilState::Fallback)
        } else if self.lost || age > self.silence {
            (followed.0, followed.1, PupilState::Holding)
        } else if self.acquires(t, REACHED_MM) {
            (followed.0, followed.1, PupilState::Acquiring)
        } else {
            (followed.0, followed.1, PupilState::Tracking)
        };
        let diameter_mm = diameter_mm.clamp(settings.gate.least_mm, settings.gate.greatest_mm);
        Shown { diameter_mm, velocity_mm_per_s, state }
    }

    /// The motion and what is left of the blend: diameter and velocity.
    fn followed_at(&self, motion: &Motion, t: TimeNs) -> (f32, f32) {
        let motion = motion.at(t);
        let left_mm = self.blend.left_mm(t, self.settings.return_mm_per_s);
        let speed = if left_mm == 0.0 { 0.0 } else { -self.settings.return_mm_per_s.copysign(left_mm) };
        (motion.diameter_mm + left_mm, motion.velocity_mm_per_s + speed)
    }

    /// Whether more than `least_mm` is left at `t` of a slide that began at the fallback.
    fn acquires(&self, t: TimeNs, least_mm: f32) -> bool {
        self.blend.acquires && self.blend.left_mm(t, self.settings.return_mm_per_s).abs() > least_mm
    }
}

struct Shown {
    diameter_mm: f32,
    velocity_mm_per_s: f32,
    state: PupilState,
}

/// One eye: its gate, its filter, and how far it lies from the mean of the eyes.
#[derive(Clone, Debug)]
struct Channel {
    gate: Gate,
    filter: Filter,
    /// The newest sample that the filter has taken.
    believed: Option<Measured>,
    /// The filter's diameter [`EARLIER`] before that sample or longer, and one that comes to be as old.
    earlier: [Option<Measured>; 2],
    /// Added to this eye's diameter to give the mean of the eyes, as learnt while there were two.
    to_mean_mm: f32,
    /// Trusted now: believed at least once, and neither a bad sample nor a long silence since.
    live: bool,
    /// When `live` changed last.
    t_changed: TimeNs,
    t_latest: TimeNs,
    /// Mean of the recent confidences; a sample that is itself bad counts as 0.
    confidence: f32,
}

impl Channel {
    fn new(settings: &EstimatorSettings) -> Self {
        Self {
            gate: Gate::new(settings.gate),
            filter: Filter::new(settings.filter),
            believed: None,
            earlier: [None; 2],
            to_mean_mm: 0.0,
            live: false,
            t_changed: TimeNs(0),
            t_latest: TimeNs(0),
            confidence: 0.0,
        }
    }

    /// Has the filter take a sample that is believed.
    fn believe(&mut self, sample: &PupilSample) {
        let (t, diameter_mm) = (sample.t_sample, sample.diameter_mm);
        self.filter.update(t, diameter_mm, self.gate.noise_mm());
        self.believed = Some(Measured { t, diameter_mm });
        // What comes back from a loss is known anew.
        let [earlier, later] = if self.live { self.earlier } else { [None; 2] };
        if later.is_none_or(|later| t - later.t >= EARLIER) {
            let now = self.filter.motion().map(|motion| Measured { t, diameter_mm: motion.diameter_mm });
            self.earlier = [later.or(earlier), now];
        }
    }

    /// Where this eye's pupil is expected at `t`.
    fn expected(&self, t: TimeNs) -> Option<Expected> {
        let motion = self.filter.motion()?;
        let diameter_mm = motion.at(t).diameter_mm;
        let [earlier, later] = self.earlier;
        let earlier_mm = earlier.or(later).map_or(diameter_mm, |earlier| earlier.diameter_mm);
        Some(Expected { diameter_mm, earlier_mm, t_believed: motion.t })
    }

    fn note_confidence(&mut self, t: TimeNs, confidence: f32, recent: TimeNs) {
        let elapsed_s = (t - self.t_latest).seconds().max(0.0);
        self.t_latest = t;
        self.confidence += (1.0 - (-elapsed_s / recent.seconds()).exp()) as f32 * (confidence - self.confidence);
    }
}

/// Samples in, estimate out. Times come with the samples and with the questions; it reads no clock and, once made,
/// allocates nothing.
#[derive(Clone, Debug)]
pub struct Estimator {
    channels: [Channel; 3],
    /// The channel that is shown where only the better one is.
    chosen: Option<usize>,
    learnt: TimeNs,
    t_learnt: Option<TimeNs>,
    /// Since when the fallback is shown before any sample is believed.
    t_begins: Option<TimeNs>,
    snapshot: EstimateSnapshot,
}

impl Estimator {
    /// An estimator that has seen nothing.
    pub fn new(settings: EstimatorSettings) -> Self {
        Self {
            channels: std::array::from_fn(|_| Channel::new(&settings)),
            chosen: None,
            learnt: TimeNs(0),
            t_learnt: None,
            t_begins: None,
            snapshot: EstimateSnapshot::new(settings),
        }
    }

    /// Says that the estimate is shown from `t` on, in place of the first sample's time: the first diameter that is
    /// believed is shown at once if that is soon after, else slid to.
    pub fn begin(&mut self, t: TimeNs) {
        self.t_begins = Some(t);
    }

    /// Goes on with other settings from `t` on; what is shown does not jump. Where they make something else of the
    /// samples, the eyes are learnt anew: what is shown is held until one is believed again, and slides there. The
    /// slide to another fallback begins from what is shown.
    pub fn change(&mut self, settings: EstimatorSettings, t: TimeNs, on_decision: impl FnMut(Decision)) {
        let before = self.snapshot.change(settings, t);
        let EstimatorSettings { fallback, hold, fallback_mm_per_s, return_mm_per_s, silence, .. } = settings;
        if settings == (EstimatorSettings { fallback, hold, fallback_mm_per_s, return_mm_per_s, silence, ..before }) {
            return;
        }
        self.finish(on_decision);
        self.channels = std::array::from_fn(|_| Channel::new(&settings));
        (self.chosen, self.learnt, self.t_learnt) = (None, TimeNs(0), None);
    }

    /// Takes the next sample and calls `on_decision` once for each sample on which the gate has now made up its mind:
    /// an accepted one comes [`GateSettings::lead`] late.
    pub fn push(&mut self, sample: PupilSample, on_decision: impl FnMut(Decision)) {
        self.push_at(sample.t_sample, sample, on_decision);
    }

    /// The same for a sample that is known from `t_known` on, on the stream's clock. What is shown goes on from what
    /// was shown then, however long ago the sample was taken.
    pub fn push_at(&mut self, t_known: TimeNs, sample: PupilSample, mut on_decision: impl FnMut(Decision)) {
        let settings = self.snapshot.settings;
        let sample = PupilSample { diameter_mm: (f64::from(sample.diameter_mm) * settings.scale) as f32, ..sample };
        if !drives(settings.eye, sample.eye) {
            return on_decision(Decision { sample, verdict: Verdict::Rejected(Rejection::OtherEye) });
        }
        let t = sample.t_sample;
        self.t_begins.get_or_insert(t);
        let channel = &mut self.channels[sample.eye.index()];
        let lives_before = channel.live;
        let mut believed = false;
        while let Some(ripe) = channel.gate.ripe(t) {
            channel.believe(&ripe);
            believed = true;
            on_decision(Decision { sample: ripe, verdict: Verdict::Accepted });
        }
        let expected = channel.expected(t);
        let mut fault = None;
        channel.gate.judge(sample, expected, |sample, reason| {
            fault = (reason != Rejection::Guard).then_some(reason).or(fault);
            on_decision(Decision { sample, verdict: Verdict::Rejected(reason) });
        });
        if matches!(fault, Some(Rejection::Backwards | Rejection::Repeated)) {
            return;
        }
        channel.live = (channel.live || believed) && channel.gate.is_open();
        let mut set_changed = channel.live != lives_before;
        if set_changed {
            channel.t_changed = t;
        }
        let confidence = if fault.is_some() { 0.0 } else { sample.confidence.clamp(0.0, 1.0) };
        channel.note_confidence(t, confidence, settings.better.recent);
        set_changed |= self.distrust_silent(sample.eye.index(), t);
        if settings.eye == rig::Eye::Better {
            set_changed |= self.choose(t);
        }
        let channel = &self.channels[sample.eye.index()];
        self.snapshot.silence = settings.silence.max(settings.gate.lead + channel.gate.usual_silence());

        self.snapshot.t_heard = self.snapshot.t_heard.max(Some(t));
        if believed || set_changed {
            self.learn_eye_offsets();
            self.combine(t_known.max(t), set_changed);
        }
    }

    /// The pupil at `t`, on the stream's clock.
    pub fn pupil_at(&self, t: TimeNs) -> PupilEstimate {
        self.snapshot.pupil_at(t)
    }

    /// What [`Self::pupil_at`] rests on, to be handed to another thread.
    pub const fn snapshot(&self) -> EstimateSnapshot {
        self.snapshot
    }

    /// Ends the stream: the samples that still wait for their successors are given up.
    pub fn finish(&mut self, mut on_decision: impl FnMut(Decision)) {
        for channel in &mut self.channels {
            channel.gate.reject_pending(&mut |sample, reason| {
                on_decision(Decision { sample, verdict: Verdict::Rejected(reason) });
            });
            channel.live = false;
        }
        self.snapshot.lost = true;
    }

    /// Trusts no other eye than `heard` of which nothing has come for so long, so that one that stopped coming does not
    /// stand still beside the one that moves; whether there was such an eye.
    fn distrust_silent(&mut self, heard: usize, t: TimeNs) -> bool {
        let settings = &self.snapshot.settings;
        let mut any = false;
        for (_, channel) in self.channels.iter_mut().enumerate().filter(|(index, _)| *index != heard) {
            let silence = settings.silence.max(settings.gate.lead + channel.gate.usual_silence());
            if channel.live && t - channel.t_latest > silence {
                channel.live = false;
                channel.t_changed = t;
                any = true;
            }
        }
        any
    }

    /// Chooses the eye to show at `t`; whether that changed.
    fn choose(&mut self, t: TimeNs) -> bool {
        let BetterSettings { margin, settles, .. } = self.snapshot.settings.better;
        let channels = &self.channels;
        let better = |other: &usize| {
            let Some(chosen) = self.chosen.map(|chosen| &channels[chosen]) else { return true };
            let surer = channels[*other].confidence > chosen.confidence + margin;
            t - channels[*other].t_changed.max(chosen.t_changed) >= settles && (surer || !chosen.live)
        };
        let others = (0..channels.len()).filter(|other| channels[*other].live && Some(*other) != self.chosen);
        let best = others.filter(better).max_by(|a, b| channels[*a].confidence.total_cmp(&channels[*b].confidence));
        let changed = best.is_some();
        self.chosen = best.or(self.chosen);
        changed
    }

    /// While both eyes are live, follows how far each lies from their mean.
    fn learn_eye_offsets(&mut self) {
        let [left, right, _] = &mut self.channels;
        let both = (left.live && right.live).then(|| left.filter.motion().zip(right.filter.motion())).flatten();
        let Some((left_motion, right_motion)) = both else {
            self.t_learnt = None;
            return;
        };
        let t = left_motion.t.max(right_motion.t);
        let Some(before) = self.t_learnt.replace(t) else { return };
        let elapsed = t - before;
        // A plain mean at first, an exponential one once the time constant has passed.
        self.learnt = (self.learnt + elapsed).min(self.snapshot.settings.eye_offset);
        if elapsed.0 <= 0 {
            return;
        }
        let share = (elapsed.seconds() / self.learnt.seconds()).min(1.0) as f32;
        let half_mm = 0.5 * (right_motion.at(t).diameter_mm - left_motion.at(t).diameter_mm);
        left.to_mean_mm += share * (half_mm - left.to_mean_mm);
        right.to_mean_mm += share * (-half_mm - right.to_mean_mm);
    }

    /// Combines the live eyes into one motion; where the set of eyes changed or samples came back, what is shown stays
    /// continuous at `t` and the difference is worked off.
    fn combine(&mut self, t: TimeNs, set_changed: bool) {
        let shown = |index| self.snapshot.settings.eye != rig::Eye::Better || Some(index) == self.chosen;
        let live = || (0..).zip(&self.channels).filter(|(i, eye)| eye.live && shown(*i)).map(|(_, eye)| eye);
        let Some(newest) = live().filter_map(|channel| channel.filter.outlook()).map(|motion| motion.t).max() else {
            self.snapshot.lost = true;
            return;
        };
        let believed = live().filter_map(|channel| channel.believed).max_by_key(|sample| sample.t);
        let alone = live().count() == 1 && self.snapshot.settings.eye == rig::Eye::Both;
        let mut sum = (0.0, 0.0, 0.0_f32);
        for channel in live() {
            if let Some(motion) = channel.filter.outlook() {
                let motion = motion.at(newest);
                let to_mean_mm = if alone { channel.to_mean_mm } else { 0.0 };
                sum = (sum.0 + motion.diameter_mm + to_mean_mm, sum.1 + motion.velocity_mm_per_s, sum.2 + 1.0);
            }
        }
        let motion = Motion {
            t: newest,
            diameter_mm: sum.0 / sum.2,
            velocity_mm_per_s: sum.1 / sum.2,
            velocity_lasts: self.snapshot.settings.filter.velocity_lasts,
        };
        let shown = self.snapshot.shown_at(t);
        if set_changed || !matches!(shown.state, PupilState::Acquiring | PupilState::Tracking) {
            let at_once =
                self.snapshot.motion.is_none() && self.t_begins.is_none_or(|begins| t - begins <= SHOWN_AT_ONCE);
            self.snapshot.blend = if at_once {
                Blend::NONE
            } else {
                let acquires = shown.state == PupilState::Fallback || self.snapshot.acquires(t, 0.0);
                Blend { t, excess_mm: shown.diameter_mm - motion.at(t).diameter_mm, acquires }
            };
        }
        self.snapshot.believed = believed;
        self.snapshot.motion = Some(motion);
        self.snapshot.lost = false;
    }
}

const fn drives(chosen: rig::Eye, eye: SampleEye) -> bool {
    matches!(
        (chosen, eye),
        (rig::Eye::Both | rig::Eye::Better, _)
            | (_, SampleEye::Both)
            | (rig::Eye::Left, SampleEye::Left)
            | (rig::Eye::Right, SampleEye::Right)
    )
}
