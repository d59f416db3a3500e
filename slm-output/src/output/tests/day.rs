//! A day of fields in simulated time: pacer, scheduler and the lasers' thread's work, judged by what was truly on the
//! panel and by the box's own edges.
//!
//! In the night the panel is off. Most other minutes are quiet. In each eighth one of them panel, host, box and people
//! do what they should not: flips are missed, reports are lost or lie, threads wake up late or stand still, frames take
//! seconds, panel and box are lost, darkness is asked for, nobody reads the events.

use std::collections::VecDeque;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::*;
use crate::output::shared::{NEXT, dark_because};
use crate::pacing::FramePlan;

const S: i64 = 1_000 * MS;
const MINUTE: i64 = 60 * S;
/// One minute in this many is a bad one; the one after it begins with what is left of it.
const BAD_EVERY: i64 = 8;
/// Faults of a bad minute begin this long before its end, so that the longest is over and made good by then.
const CALM: i64 = 35 * S;
/// In these minutes the panel is switched off.
const NIGHT: std::ops::Range<i64> = 600..1080;
/// How far times may be off that were rounded to the box's microseconds.
const ROUNDING: TimeNs = TimeNs(1_000);

fn day_rig(latency: TimeNs) -> Rig {
    let mut rig = rig(PanelMode::FieldSequential);
    rig.panel.latency = latency;
    // Room at both ends for reports that are off by up to 60 µs.
    rig.lasers.on_delay = TimeNs(250_000);
    rig.lasers.width = TimeNs(2_800_000);
    rig
}

/// What truly was on the panel.
#[derive(Clone, Copy, Debug)]
struct Shown {
    /// `None`: no frame's pattern.
    colour: Option<Colour>,
    t_begin: TimeNs,
    t_end: TimeNs,
    /// When the lasers' thread was told of it.
    t_told: Option<TimeNs>,
}

/// Judges light as it comes, from nothing but panel and edges.
struct Judge {
    settle: TimeNs,
    shown: VecDeque<Shown>,
    lit: Option<(Colour, TimeNs)>,
    /// Light since the last balance was struck.
    light: PerColour<TimeNs>,
    windows: u64,
    faults: Vec<String>,
}

impl Judge {
    fn new(settle: TimeNs) -> Self {
        let shown = VecDeque::with_capacity(1024);
        Self { settle, shown, lit: None, light: PerColour([TimeNs(0); 3]), windows: 0, faults: Vec::new() }
    }

    fn object(&mut self, fault: String) {
        if self.faults.len() < 10 {
            self.faults.push(fault);
        }
    }

    /// The panel goes over to another pattern.
    fn show(&mut self, shown: Shown) {
        if let Some(last) = self.shown.back_mut() {
            last.t_end = last.t_end.min(shown.t_begin);
        }
        if self.shown.len() == 1024 {
            self.shown.pop_front();
        }
        self.shown.push_back(shown);
    }

    fn edge(&mut self, edge: LaserEdge) {
        match (edge.on, self.lit.take()) {
            (true, None) => self.lit = Some((edge.colour, edge.t)),
            (false, Some((colour, t_on))) if colour == edge.colour => self.window(colour, t_on, edge.t),
            (on, lit) => self.object(format!("{edge:?} (on: {on}) while {lit:?} is lit")),
        }
    }

    fn window(&mut self, colour: Colour, t_on: TimeNs, t_off: TimeNs) {
        self.windows += 1;
        self.light[colour] = self.light[colour] + (t_off - t_on);
        let end = self.shown.partition_point(|shown| shown.t_begin < t_off);
        let begin = self.shown.partition_point(|shown| shown.t_end <= t_on);
        let Some(&own) = self.shown.range(begin..end).next() else {
            return self.object(format!("{colour} from {t_on:?} over nothing"));
        };
        if end - begin != 1 || own.colour != Some(colour) || t_off > own.t_end {
            self.object(format!("{colour} from {t_on:?} to {t_off:?} over {own:?} and {} more", end - begin - 1));
        }
        if t_on < own.t_begin + self.settle {
            self.object(format!("{colour} from {t_on:?} over the unsettled {own:?}"));
        }
        if own.t_told.is_none_or(|t_told| t_on + ROUNDING < t_told) {
            self.object(format!("{colour} from {t_on:?} over the unproven {own:?}"));
        }
    }

    /// Strikes the balance of a minute: the colours may differ by `most`, and each must have had `least`.
    fn balance(&mut self, least: TimeNs, most: TimeNs) {
        let light = std::mem::replace(&mut self.light, PerColour([TimeNs(0); 3]));
        let (darkest, lightest) = (light.0.into_iter().min(), light.0.into_iter().max());
        let (darkest, lightest) = (darkest.unwrap_or_default(), lightest.unwrap_or_default());
        if lightest - darkest > most {
            self.object(format!("colours differ by more than {most:?}: {light:?}"));
        }
        if darkest < least {
            self.object(format!("a colour has less than {least:?}: {light:?}"));
        }
    }
}

/// A panel of the host's own timing, whose flips can be missed.
struct TruePanel {
    period: TimeNs,
    t_next: TimeNs,
    field: usize,
    frame: Option<FrameTag>,
    waiting: Option<FrameTag>,
    lost: bool,
    /// From its taking a field to its showing it.
    latency: TimeNs,
}

/// What is wrong now and until when.
#[derive(Default)]
struct Trouble {
    /// Of the next refresh.
    missed: bool,
    silent: bool,
    doubled: bool,
    early_ns: i64,
    wakes_late_ns: i64,
    /// Of the next frame.
    frame_takes_ns: i64,
    t_panel_back: Option<TimeNs>,
    t_box_back: Option<TimeNs>,
    t_lit_again: Option<TimeNs>,
    t_read_again: Option<TimeNs>,
    /// Nothing lies again so soon: a panel that always lies cannot be told from one that does not.
    refreshes_since_lie: u32,
}

struct Day {
    layout: FrameLayout,
    random: Pcg64Mcg,
    laser: LaserThread,
    news: Producer<PanelNews>,
    events: Consumer<FieldEvent>,
    box_events: Consumer<BoxEvent>,
    fails: Arc<AtomicBool>,
    panel: TruePanel,
    pacer: Pacer,
    plan: FramePlan,
    t_submit: TimeNs,
    reports: VecDeque<(TimeNs, u64, TimeNs)>,
    judge: Judge,
    trouble: Trouble,
    now: TimeNs,
    /// In this minute.
    armed: i64,
    frames_shown: u64,
    /// In all that time: shown later than planned.
    frames_missed: u64,
    lost_before: u64,
    /// How often darkness was asked for or that was taken back.
    asked: u64,
    /// Edges as they came, where somebody wants them.
    kept: Option<(Vec<Shown>, Vec<LaserEdge>)>,
}

impl Day {
    /// Of a panel of that latency, and a rig that says so.
    fn new(seed: u64, latency: TimeNs) -> Self {
        let rig = day_rig(latency);
        let fails = Arc::new(AtomicBool::new(false));
        let faulty = Intercepted::new(TimeNs(0), Faulty(Arc::clone(&fails)));
        let Bench { laser, news, events, box_events, .. } = Bench::with_rig(&rig, Box::new(faulty));
        let period = laser.scheduler.gate().timing().refresh_period;
        let panel = TruePanel { period, t_next: T_FIRST, field: 0, frame: None, waiting: None, lost: false, latency };
        let mut pacer = Pacer::new(pacing_config(&rig, TimeNs(8 * MS)).unwrap(), TimeNs(0));
        let plan = pacer.predict(TimeNs(0));
        Self {
            judge: Judge::new(rig.panel.settle),
            layout: FrameLayout::new(&rig.panel, SIZE),
            random: Pcg64Mcg::seed_from_u64(seed),
            laser,
            news,
            events,
            box_events,
            fails,
            panel,
            pacer,
            plan,
            t_submit: plan.t_wake + TimeNs(7 * MS),
            reports: VecDeque::new(),
            trouble: Trouble::default(),
            now: TimeNs(0),
            armed: 0,
            frames_shown: 0,
            frames_missed: 0,
            lost_before: 0,
            asked: 0,
            kept: None,
        }
    }

    /// Frames that are done by `t` are handed over, and the next ones planned.
    fn make_frames(&mut self, t: TimeNs) {
        while self.t_submit <= t {
            let now = self.t_submit;
            let FramePlan { frame_id, t_desired_present, .. } = self.plan;
            self.pacer.submitted(frame_id, now);
            self.panel.waiting = Some(FrameTag { frame_id, t_submit: now, t_desired_present, keep: None });
            while let Some(&(_, id, t_present)) = self.reports.front().filter(|(t_told, ..)| *t_told <= now) {
                self.reports.pop_front();
                self.pacer.report(id, t_present, TimestampSource::Hardware);
            }
            self.plan = self.pacer.predict(now);
            assert_eq!(self.plan.frame_id, frame_id + 1);
            assert!(self.plan.t_wake >= now && self.plan.t_desired_present >= self.plan.t_wake, "{:?}", self.plan);
            let takes_ns = self.random.random_range(6 * MS..8 * MS) + std::mem::take(&mut self.trouble.frame_takes_ns);
            self.t_submit = self.plan.t_wake + TimeNs(self.random.random_range(0..200_000) + takes_ns);
        }
    }

    /// The panel's next refresh; `now` is when the panel's thread finds it.
    fn refresh(&mut self, now: TimeNs) {
        let t_true = self.panel.t_next;
        let t_end = t_true + self.panel.period;
        self.panel.t_next = t_end;
        if std::mem::take(&mut self.trouble.missed) {
            if let Some(last) = self.judge.shown.back_mut() {
                last.t_end = t_end + self.panel.latency;
            }
            return;
        }
        let field = self.panel.field;
        self.panel.field = (field + 1) % 3;
        let new = field == 0 && self.panel.waiting.is_some_and(|tag| tag.t_submit <= t_true);
        if new {
            self.panel.frame = self.panel.waiting.take();
            self.frames_shown += 1;
        }
        let Trouble { silent, doubled, early_ns, refreshes_since_lie, .. } = &mut self.trouble;
        let (silent, doubled, early_ns) = (std::mem::take(silent), std::mem::take(doubled), std::mem::take(early_ns));
        *refreshes_since_lie = if doubled || early_ns > 0 { 0 } else { refreshes_since_lie.saturating_add(1) };
        let colour = self.panel.frame.map(|_| self.layout.colour_of_field(field));
        let latency = self.panel.latency;
        let t_told = (!silent).then_some(now);
        let shown = Shown { colour, t_begin: t_true + latency, t_end: t_end + latency, t_told };
        self.judge.show(shown);
        if let Some((all, _)) = &mut self.kept {
            all.push(shown);
        }
        if silent {
            return;
        }
        let jitter_ns = self.random.random_range(-50_000..=50_000i64);
        // A report does not come before the time that it tells, but for one that lies.
        let t_present = TimeNs(t_true.0 + jitter_ns - early_ns).min(now);
        let refresh = PresentedRefresh {
            frame: self.panel.frame,
            field,
            repeated: !new,
            t_present,
            timestamp_source: TimestampSource::Hardware,
            refresh_count: None,
        };
        let latency = self.laser.latency;
        self.tell(PanelNews::Refresh(refresh.shown_after(latency)));
        if doubled {
            let again = PresentedRefresh { t_present: t_present + TimeNs(100_000), ..refresh };
            self.tell(PanelNews::Refresh(again.shown_after(latency)));
        }
        if new && let Some(tag) = self.panel.frame {
            let late_ns = (t_present + latency - tag.t_desired_present).0;
            self.frames_missed += u64::from(late_ns > 3 * self.panel.period.0 / 2);
            self.reports.push_back((now, tag.frame_id, t_present));
        }
    }

    fn tell(&mut self, news: PanelNews) {
        if self.news.push(news).is_err() {
            crate::output::shared::count(&self.laser.shared.lost);
        }
    }

    /// The lasers' thread wakes up for each refresh that comes on the panel before `t_end`.
    fn wake_lasers(&mut self, t_end: TimeNs) {
        while let Some(t) = self.laser.t_news(self.now).filter(|&t| t > self.now) {
            let t = t + TimeNs(self.random.random_range(20_000..400_000));
            if t >= t_end {
                return;
            }
            self.laser.step(|| t);
            self.now = t;
        }
    }

    /// All threads wake up at `now`.
    fn wake(&mut self, now: TimeNs) {
        self.now = now;
        while !self.panel.lost && self.panel.t_next <= now {
            self.make_frames(self.panel.t_next);
            self.refresh(now);
        }
        self.make_frames(now);
        self.laser.step(|| now);
        while let Ok(event) = self.box_events.pop() {
            match event {
                BoxEvent::Edge(edge) => {
                    self.judge.edge(edge);
                    if let Some((_, edges)) = &mut self.kept {
                        edges.push(edge);
                    }
                }
                BoxEvent::Armed { .. } => self.armed += 1,
                BoxEvent::Dark { .. } => {}
            }
        }
        if self.trouble.t_read_again.is_none() {
            while let Ok(event) = self.events.pop() {
                let lit = event.laser_on.zip(event.laser_off);
                let inside = lit.is_none_or(|(on, off)| on >= event.t_settled && off <= event.t_end);
                assert!(inside && (lit.is_some() || event.dark.is_some()), "{event:?}");
            }
        }
    }

    /// What was lost for a while comes back.
    fn end_troubles(&mut self) {
        let now = self.now;
        let over = |t: &mut Option<TimeNs>| t.take_if(|t| *t <= now).is_some();
        if over(&mut self.trouble.t_panel_back) {
            self.panel.lost = false;
            self.laser.shared.panel_lost.store(false, Ordering::Release);
            self.panel.frame = None;
            self.panel.field = 0;
            self.panel.t_next = now + TimeNs(self.random.random_range(1..self.panel.period.0));
        }
        if over(&mut self.trouble.t_box_back) {
            self.fails.store(false, Ordering::Relaxed);
        }
        if over(&mut self.trouble.t_lit_again) {
            self.ask(None);
        }
        over(&mut self.trouble.t_read_again);
    }

    /// A person asks for darkness, or takes that back.
    fn ask(&mut self, why: Option<DarkReason>) {
        self.asked += 1;
        self.laser.shared.dark_request.store(dark_because(self.asked * NEXT, why), Ordering::Release);
    }

    /// One more thing goes wrong.
    fn begin_trouble(&mut self) {
        let now = self.now;
        let kind = self.random.random_range(0..12);
        let random = &mut self.random;
        let mut lasts = |most_ms: i64| TimeNs(random.random_range(MS..most_ms * MS));
        let until = |lasts: TimeNs| Some(now + lasts);
        let lies = self.trouble.refreshes_since_lie > 3;
        match kind {
            0 => self.trouble.missed = true,
            1 => self.trouble.silent = true,
            2 if lies => self.trouble.doubled = true,
            3 if lies => self.trouble.early_ns = lasts(6).0,
            4 | 5 => self.trouble.wakes_late_ns = lasts(6).0,
            6 => {
                let stands = lasts(2_500);
                self.trouble.wakes_late_ns = stands.0;
                self.t_submit = self.t_submit + stands;
            }
            7 => self.trouble.frame_takes_ns = lasts(6_000).0,
            8 if !self.panel.lost => {
                let t_back = now + lasts(3_000);
                self.lose_panel(t_back);
            }
            9 if self.trouble.t_box_back.is_none() => {
                self.trouble.t_box_back = until(lasts(1_500));
                self.fails.store(true, Ordering::Relaxed);
            }
            10 if self.trouble.t_lit_again.is_none() => {
                self.trouble.t_lit_again = until(lasts(3_000));
                self.ask(Some(DarkReason::Asked));
            }
            11 if self.trouble.t_read_again.is_none() => self.trouble.t_read_again = until(lasts(30_000)),
            _ => {}
        }
    }

    fn lose_panel(&mut self, t_back: TimeNs) {
        let now = self.now;
        self.trouble.t_panel_back = Some(t_back);
        self.panel.lost = true;
        self.laser.shared.panel_lost.store(true, Ordering::Release);
        self.tell(PanelNews::Lost);
        // Dark and flat come in the same moment.
        self.laser.step(|| now);
        while self.judge.shown.pop_back_if(|shown| shown.t_begin > now).is_some() {}
        self.judge.show(Shown { colour: None, t_begin: now, t_end: TimeNs(i64::MAX), t_told: None });
    }

    /// Goes on to `t_end`; where it is `bad`, something goes wrong every now and then.
    fn run(&mut self, t_end: TimeNs, bad: bool) {
        while self.now < t_end {
            self.end_troubles();
            if bad && self.now < t_end - TimeNs(CALM) && self.random.random_bool(0.03) {
                self.begin_trouble();
            }
            let stands_ns = std::mem::take(&mut self.trouble.wakes_late_ns);
            let t = if self.panel.lost { self.now + SLEEP_MAX } else { self.panel.t_next };
            if stands_ns == 0 {
                self.wake_lasers(t);
            }
            let late_ns = self.random.random_range(20_000..400_000) + stands_ns;
            self.wake(t.max(self.now) + TimeNs(late_ns));
        }
    }

    /// Judges the minute that is over.
    fn strike_balance(&mut self, bad: bool) {
        let counts = self.laser.shared.counts();
        let gate = self.laser.scheduler.gate();
        let width = gate.width();
        let whole = MINUTE / gate.timing().frame_period.0;
        let armed = std::mem::take(&mut self.armed);
        let shown = std::mem::take(&mut self.frames_shown);
        let waiting = self.laser.ledger.waiting();
        assert!(waiting <= 512 && self.reports.len() < 64, "{waiting} fields and edges wait, {}", self.reports.len());
        if bad {
            // Each time that it is armed the balance begins anew.
            self.judge.balance(TimeNs(0), TimeNs((2 + armed) * width.0));
            self.lost_before = counts.lost;
            return;
        }
        // A window at either end of the minute, and the box's microseconds.
        self.judge.balance(TimeNs((whole - 3) * (width.0 - 2 * ROUNDING.0)), width + TimeNs(MS / 2));
        assert!(shown as i64 >= whole - 10, "{shown} of {whole} frames");
        assert_eq!((armed, counts.lost), (0, self.lost_before), "{counts:?}");
        assert!(counts.armed && counts.fields >= counts.dark_fields, "{counts:?}");
    }
}

/// A day's minutes.
fn run_minutes(seed: u64, minutes: i64, latency: TimeNs) -> Day {
    let mut day = Day::new(seed, latency);
    // The first second arms.
    day.run(TimeNs(S), false);
    day.judge.balance(TimeNs(0), TimeNs(i64::MAX));
    (day.armed, day.frames_shown) = (0, 0);
    for minute in 0..minutes {
        let t_end = TimeNs(S + (minute + 1) * MINUTE);
        let night = NIGHT.contains(&minute);
        if minute == NIGHT.start {
            day.lose_panel(TimeNs(S + NIGHT.end * MINUTE - CALM));
        }
        let bad = !night && minute % BAD_EVERY == BAD_EVERY - 1;
        let windows = day.judge.windows;
        day.run(t_end, bad);
        day.strike_balance(bad || night);
        let lit = day.judge.windows - windows;
        assert!(!night || lit == 0 || minute == NIGHT.end - 1, "{lit} windows in the night");
        assert!(day.judge.faults.is_empty(), "seed {seed}, minute {minute}: {:#?}", day.judge.faults);
    }
    day
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1, max_shrink_iters: 0, ..ProptestConfig::default() })]

    #[test]
    fn a_day_of_fields_is_lit_safely_and_equally(seed in any::<u64>()) {
        let day = run_minutes(seed, 24 * 60, TimeNs(0));
        let frames = 24 * 3600 * 60;
        prop_assert!(day.plan.frame_id > frames * 9 / 10, "{} frames were planned", day.plan.frame_id);
        prop_assert!(day.frames_missed < frames / 50, "{} frames were missed", day.frames_missed);
        let by_day = frames * (24 * 60 - (NIGHT.end - NIGHT.start) as u64) / (24 * 60);
        prop_assert!(day.judge.windows > 3 * by_day * 9 / 10, "{}", day.judge.windows);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4, max_shrink_iters: 0, ..ProptestConfig::default() })]

    /// Of up to seven refreshes, whole ones or not.
    #[test]
    fn a_panel_that_shows_its_video_later_is_lit_safely_and_equally(
        seed in any::<u64>(),
        latency_ns in 1..40 * MS,
    ) {
        const MINUTES: u64 = 2 * BAD_EVERY as u64;
        let day = run_minutes(seed, MINUTES as i64, TimeNs(latency_ns));
        let frames = MINUTES * 3600;
        prop_assert!(day.frames_missed < frames / 50, "{} frames were missed", day.frames_missed);
        prop_assert!(day.judge.windows > 3 * frames * 9 / 10, "{}", day.judge.windows);
    }
}

#[test]
fn canary_a_latency_that_the_rig_does_not_tell_lights_other_fields() {
    for refreshes in [1, 2] {
        let mut day = Day::new(1, TimeNs(0));
        day.panel.latency = TimeNs(refreshes * day.panel.period.0);
        day.run(TimeNs(S), false);
        assert!(!day.judge.faults.is_empty(), "{refreshes} refreshes");
    }
}

/// A few good seconds, of which any one thing is then made wrong.
#[test]
fn canary_the_judge_objects_to_a_single_wrong_window() {
    let mut day = Day::new(1, TimeNs(0));
    day.kept = Some(Default::default());
    day.run(TimeNs(4 * S), false);
    let (shown, edges) = day.kept.take().unwrap();
    let least = TimeNs(200 * 2_800_000);
    let most = TimeNs(2_800_000);
    let judged = |spoil: &dyn Fn(&mut Vec<Shown>, &mut Vec<LaserEdge>)| {
        let (mut shown, mut edges) = (shown.clone(), edges.clone());
        spoil(&mut shown, &mut edges);
        let mut judge = Judge::new(day_rig(TimeNs(0)).panel.settle);
        let mut shown = shown.into_iter().peekable();
        for edge in edges {
            while let Some(next) = shown.next_if(|next| next.t_begin <= edge.t) {
                judge.show(next);
            }
            judge.edge(edge);
        }
        judge.balance(least, most);
        judge.faults
    };
    assert_eq!(judged(&|_, _| ()), Vec::<String>::new());
    let on = edges.iter().skip(600).position(|edge| edge.on).unwrap() + 600;
    let moved = |edges: &mut [LaserEdge], by_ns: i64| {
        edges[on..on + 2].iter_mut().for_each(|edge| edge.t = edge.t + TimeNs(by_ns));
    };
    type Spoil<'a> = &'a dyn Fn(&mut Vec<Shown>, &mut Vec<LaserEdge>);
    let spoilt: [(&str, Spoil<'_>); 8] = [
        ("unsettled", &|_, edges| moved(edges, -400_000)),
        ("into the next field", &|_, edges| moved(edges, 800_000)),
        ("another laser", &|_, edges| {
            let other = if edges[on].colour == Colour::Red { Colour::Blue } else { Colour::Red };
            edges[on..on + 2].iter_mut().for_each(|edge| edge.colour = other);
        }),
        ("two at once", &|_, edges| {
            let second = LaserEdge { t: edges[on].t + TimeNs(1000), ..edges[on + 2] };
            edges.insert(on + 1, second);
        }),
        ("never off", &|_, edges| {
            edges.remove(on + 1);
        }),
        ("nobody told of it", &|shown, edges| {
            let lit = shown.iter_mut().rfind(|shown| shown.t_begin < edges[on].t).unwrap();
            lit.t_told = None;
        }),
        ("told of later", &|shown, edges| {
            let lit = shown.iter_mut().rfind(|shown| shown.t_begin < edges[on].t).unwrap();
            lit.t_told = Some(edges[on + 1].t);
        }),
        ("one colour is darker", &|_, edges| {
            let colour = edges[on].colour;
            edges.drain(on..on + 2);
            let next = on + edges[on..].iter().position(|edge| edge.on && edge.colour == colour).unwrap();
            edges.drain(next..next + 2);
        }),
    ];
    for (what, spoil) in spoilt {
        assert_ne!(judged(spoil), Vec::<String>::new(), "{what}");
    }
}
