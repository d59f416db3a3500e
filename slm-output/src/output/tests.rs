//! The panel, the laser thread's work and the real threads together.

mod day;

use std::collections::VecDeque;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64};
use std::time::Duration;

use holod_calibration::rig::{Panel, PanelMode};
use holod_calibration::{Colour, PerColour, Resolution, host_now};
use proptest::prelude::*;
use rtrb::Producer;

use super::panel_thread::PanelNews;
use super::shared::{DARK, NEXT, NOT_YET, dark_because, dark_request_parts};
use super::*;
use crate::fields::{FrameLayout, FrameTag};
use crate::laser::verify::{EdgeReport, Finding, verify_edges};
use crate::laser::{Capability, LaserEdge, LaserProgram, LitWindow, MissedLight, Refusal, SimulatedLaser};
use crate::pacing::Pacer;
use crate::present::{FrameSink, FrameSource, HeadlessPanel, PresentedRefresh, ReportFaults, TimestampSource};

const SIZE: Resolution = Resolution { width: 8, height: 4 };
const MS: i64 = 1_000_000;
/// When the panel begins its first colour frame.
const T_FIRST: TimeNs = TimeNs(10 * MS);

fn scheduler(rig: &Rig, evidence: Evidence) -> FieldScheduler {
    let layout = FrameLayout::new(&rig.panel, SIZE);
    FieldScheduler::new(&rig.panel, layout, &rig.lasers, evidence, WindowClock::Reports, TimeNs(500 * MS)).unwrap()
}

fn rig(mode: PanelMode) -> Rig {
    let rig = Rig::default();
    Rig {
        panel: Panel { mode, refresh_hz: if mode == PanelMode::ChannelPacked { 60.0 } else { 180.0 }, ..rig.panel },
        ..rig
    }
}

fn headless(rig: &Rig, encoder: &PanelEncoder, options: OutputOptions) -> Output {
    let panel = HeadlessPanel::new(&PanelSetup::new(&rig.panel, encoder), host_now(), ReportFaults::NONE);
    let laser = Box::new(SimulatedLaser::new(host_now()));
    Output::start(rig, encoder, Box::new(panel), laser, options, host_now).unwrap()
}

/// The panel and the laser thread's work, in a time of its own.
struct Bench {
    panel: HeadlessPanel,
    sink: FrameSink,
    source: FrameSource,
    news: Producer<PanelNews>,
    laser: LaserThread,
    events: Consumer<FieldEvent>,
    box_events: Consumer<BoxEvent>,
    /// What is made of the panel's reports on their way.
    falsify: fn(PresentedRefresh) -> Option<PresentedRefresh>,
    now: TimeNs,
    /// The next field's nominal start.
    t_field: TimeNs,
    last_frame_id: u64,
    all_events: Vec<FieldEvent>,
    edges: Vec<LaserEdge>,
    darks: Vec<(TimeNs, DarkReason)>,
}

impl Bench {
    fn new(mode: PanelMode) -> Self {
        Self::with_box(mode, Box::new(SimulatedLaser::new(TimeNs(0))))
    }

    fn with_box(mode: PanelMode, laser: Box<dyn LaserBox>) -> Self {
        Self::with_rig(&rig(mode), laser)
    }

    fn with_rig(rig: &Rig, mut laser: Box<dyn LaserBox>) -> Self {
        let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
        let setup = PanelSetup::new(&rig.panel, &encoder);
        let scheduler = scheduler(rig, Evidence::Seen);
        let gate = scheduler.gate();
        let program = scheduler.program(&rig.panel, &rig.lasers).unwrap();
        laser.program(&program, TimeNs(0)).unwrap();
        let gates_fields = laser.capability().gates_fields;
        let (sink, source) = frame_channel(&setup.flat);
        let (news, news_consumer) = RingBuffer::new(NEWS_RING);
        let (event_producer, events) = RingBuffer::new(LONG_RING);
        let (box_producer, box_events) = RingBuffer::new(LONG_RING);
        let laser = LaserThread {
            laser,
            program,
            scheduler,
            news: news_consumer,
            ledger: Ledger::new(gate, gates_fields, event_producer, box_producer),
            faults: RingBuffer::new(SHORT_RING).0,
            t_retry: TimeNs(i64::MIN),
            program_lost: false,
            dark_request: 0,
            asked: None,
            is_unattended: false,
            shared: Arc::default(),
            latency: gate.timing().latency,
            clock: || TimeNs(0),
        };
        let t_open = T_FIRST - gate.timing().frame_period;
        let panel = HeadlessPanel::new(&setup, t_open, ReportFaults::NONE);
        Self {
            panel,
            sink,
            source,
            news,
            laser,
            events,
            box_events,
            falsify: Some,
            now: TimeNs(0),
            t_field: T_FIRST,
            last_frame_id: 0,
            all_events: Vec::new(),
            edges: Vec::new(),
            darks: Vec::new(),
        }
    }

    fn submit(&mut self) {
        self.last_frame_id += 1;
        self.sink.submit(FrameTag {
            frame_id: self.last_frame_id,
            t_submit: self.now,
            t_desired_present: self.now,
            keep: None,
        });
    }

    /// Both threads wake up at `now` and do what they find.
    fn wake(&mut self, now: TimeNs) {
        self.now = now;
        let Self { panel, source, news, falsify, .. } = self;
        let ticked = panel.tick(now, source, &mut |refresh| {
            if let Some(refresh) = falsify(refresh) {
                news.push(PanelNews::Refresh(refresh)).unwrap();
            }
        });
        assert_eq!(ticked, Ok(()));
        self.laser.step(|| now);
        while let Ok(event) = self.events.pop() {
            self.all_events.push(event);
        }
        while let Ok(event) = self.box_events.pop() {
            match event {
                BoxEvent::Edge(edge) => self.edges.push(edge),
                BoxEvent::Dark { t, reason } => self.darks.push((t, reason)),
                BoxEvent::Armed { .. } => {}
            }
        }
    }

    /// Wakes up at every field, `late` after it, with a new frame for every colour frame.
    fn run(&mut self, until: TimeNs, late: TimeNs) {
        let timing = self.laser.scheduler.gate().timing();
        while self.t_field + late < until {
            if (self.t_field - T_FIRST).0 % timing.frame_period.0 == 0 {
                self.now = self.t_field - TimeNs(MS);
                self.submit();
            }
            self.wake(self.t_field + late);
            self.t_field = self.t_field + timing.field_period;
        }
    }

    fn verdict(&mut self) -> EdgeReport {
        // Everything that was begun is over.
        self.laser.ledger.flush(TimeNs(i64::MAX), &self.laser.shared);
        while let Ok(event) = self.events.pop() {
            self.all_events.push(event);
        }
        let spans: Vec<_> = self.all_events.iter().map(FieldEvent::span).collect();
        verify_edges(&spans, &self.edges)
    }
}

const MODES: [PanelMode; 2] = [PanelMode::ChannelPacked, PanelMode::FieldSequential];

#[test]
fn every_field_is_lit_once_by_its_own_laser() {
    for mode in MODES {
        for late_ns in [0, 100_000, 1_900_000] {
            let mut bench = Bench::new(mode);
            bench.run(TimeNs(1000 * MS), TimeNs(late_ns));
            bench.wake(TimeNs(1000 * MS));
            bench.laser.latch(DarkReason::Shutdown, TimeNs(1000 * MS));
            bench.wake(TimeNs(1001 * MS));
            let report = bench.verdict();
            assert_eq!(report.unsafe_findings().collect::<Vec<_>>(), Vec::<&Finding>::new());
            assert!(report.fields >= 170, "{report:?}");
            // But for the refreshes by which the rhythm is believed.
            let fields_dark = if mode == PanelMode::ChannelPacked { 3 * 9 } else { 9 + 5 };
            assert!(report.lit >= report.fields - fields_dark, "{mode:?} late {late_ns}: {report:?}");
            assert!(bench.all_events.iter().any(|event| !event.repeated && event.laser_on.is_some()));
        }
    }
}

#[test]
fn events_carry_the_edges_of_their_own_field() {
    let mut bench = Bench::new(PanelMode::ChannelPacked);
    bench.run(TimeNs(400 * MS), TimeNs(50_000));
    let lit: Vec<_> = bench.all_events.iter().filter(|event| event.dark.is_none()).collect();
    assert!(lit.len() > 30);
    for event in lit {
        let (on, off) = (event.laser_on.unwrap(), event.laser_off.unwrap());
        // Rounded inwards to the box's microseconds.
        let (late, early) = (on - event.t_present - TimeNs(2_100_000), event.t_present + TimeNs(5_100_000) - off);
        assert!((0..3000).contains(&late.0) && (0..3000).contains(&early.0), "{late:?} {early:?}");
        assert!(on >= event.t_settled && off <= event.t_end);
    }
}

#[test]
fn nothing_is_lit_over_the_flat_pattern_or_before_the_first_frame() {
    let mut bench = Bench::new(PanelMode::ChannelPacked);
    for tick in 0..100 {
        bench.wake(TimeNs(tick * 5 * MS));
    }
    assert_eq!((bench.edges.len(), bench.all_events.len()), (0, 0));
}

#[test]
fn times_that_nobody_saw_light_nothing() {
    for mode in MODES {
        let mut bench = Bench::new(mode);
        bench.falsify = |refresh| Some(PresentedRefresh { timestamp_source: TimestampSource::Estimated, ..refresh });
        bench.run(TimeNs(500 * MS), TimeNs(0));
        assert_eq!(bench.edges, []);
        // Of a real panel, software's word is not enough either.
        let mut bench = Bench::new(mode);
        bench.laser.scheduler = scheduler(&rig(mode), Evidence::Stamped);
        bench.run(TimeNs(500 * MS), TimeNs(0));
        assert_eq!(bench.edges, []);
        let events = &bench.all_events;
        assert!(
            events.len() > 20 && events.iter().all(|event| event.dark == Some(DarkReason::Untrusted)),
            "{}",
            events.len()
        );
        bench.falsify = |refresh| Some(PresentedRefresh { timestamp_source: TimestampSource::Hardware, ..refresh });
        bench.run(TimeNs(1000 * MS), TimeNs(0));
        assert_ne!(bench.edges, []);
    }
}

#[test]
fn lasers_that_are_kept_dark_stay_so_until_that_is_taken_back() {
    for (mode, reason) in MODES.into_iter().zip([DarkReason::Asked, DarkReason::NoPicture].into_iter().cycle()) {
        let mut bench = Bench::new(mode);
        bench.run(TimeNs(300 * MS), TimeNs(0));
        bench.laser.shared.dark_request.store(dark_because(NEXT, Some(reason)), Ordering::Release);
        let t_asked = bench.now + TimeNs(MS);
        bench.wake(t_asked);
        let &[(t_dark, told)] = bench.darks.as_slice() else { panic!("{:?}", bench.darks) };
        assert_eq!(told, reason);
        assert!((0..1000).contains(&(t_asked.0 - t_dark.0)), "{t_dark:?} {t_asked:?}");
        let edges = bench.edges.len();
        bench.run(TimeNs(600 * MS), TimeNs(0));
        assert_eq!(bench.edges.len(), edges);
        assert_eq!(bench.all_events.last().unwrap().dark, Some(reason));
        assert_eq!(bench.laser.shared.dark_answer.load(Ordering::Acquire), 1 << 2 | u64::from(DARK));
        bench.laser.shared.dark_request.store(dark_because(2 * NEXT, None), Ordering::Release);
        bench.run(TimeNs(900 * MS), TimeNs(0));
        assert!(bench.edges.len() > edges + 10, "lit again by the rules");
        assert_eq!(bench.verdict().unsafe_findings().collect::<Vec<_>>(), Vec::<&Finding>::new());
    }
}

#[test]
fn a_refresh_that_is_reported_before_its_time_is_not_believed_whatever_the_latency() {
    const LATENCY: TimeNs = TimeNs(3 * MS);
    for mode in MODES {
        let lit = |falsify: fn(PresentedRefresh) -> Option<PresentedRefresh>| {
            let mut late = rig(mode);
            late.panel.latency = LATENCY;
            let mut bench = Bench::with_rig(&late, Box::new(SimulatedLaser::new(TimeNs(0))));
            bench.falsify = falsify;
            bench.run(TimeNs(500 * MS), TimeNs(0));
            bench.edges.len()
        };
        assert!(lit(|refresh| Some(refresh.shown_after(LATENCY))) > 20, "{mode:?}");
        assert_eq!(lit(|refresh| Some(refresh.shown_after(LATENCY + TimeNs(500_000)))), 0, "{mode:?}");
    }
    let none = PresentedRefresh {
        frame: None,
        field: 0,
        repeated: false,
        t_present: TimeNs(0),
        timestamp_source: TimestampSource::Hardware,
        refresh_count: None,
    };
    assert_eq!(none.shown_after(LATENCY), none, "no time stays none");
}

/// The reasons of the dark fields that came on the panel from `from` to `to`, by their number.
fn dark_fields(bench: &Bench, from: TimeNs, to: TimeNs) -> Vec<(DarkReason, usize)> {
    let within = bench.all_events.iter().filter(|event| (from..to).contains(&event.t_present));
    let reasons: Vec<_> = within.filter(|event| event.laser_on.is_none()).filter_map(|event| event.dark).collect();
    let count = |reason| reasons.iter().filter(|found| **found == reason).count();
    DarkReason::ALL.map(|reason| (reason, count(reason))).into_iter().filter(|(_, count)| *count > 0).collect()
}

#[test]
fn a_darkness_that_is_over_is_no_reason_for_later_dark_fields() {
    for is_asked in [false, true] {
        let mut bench = Bench::new(PanelMode::ChannelPacked);
        bench.run(TimeNs(300 * MS), TimeNs(0));
        if is_asked {
            // Between a field's beginning and its light, so that only the box knows why it was not lit.
            let t_asked = bench.t_field + TimeNs(MS);
            bench.run(t_asked, TimeNs(0));
            bench.laser.shared.dark_request.store(dark_because(NEXT, Some(DarkReason::Asked)), Ordering::Release);
            bench.wake(t_asked);
            bench.run(TimeNs(600 * MS), TimeNs(0));
            let dark = dark_fields(&bench, t_asked - TimeNs(MS), TimeNs(590 * MS));
            assert!(matches!(dark[..], [(DarkReason::Asked, count)] if count > 45), "{dark:?}");
            bench.laser.shared.dark_request.store(dark_because(2 * NEXT, None), Ordering::Release);
        }
        // The box is told of each colour frame when its first field has gone by.
        let frame_period = bench.laser.scheduler.gate().timing().frame_period;
        let t_late = T_FIRST + TimeNs(42 * frame_period.0);
        bench.run(t_late, TimeNs(0));
        for _ in 0..20 {
            bench.now = bench.t_field - TimeNs(MS);
            bench.submit();
            bench.wake(bench.t_field + TimeNs(8 * MS));
            bench.t_field = bench.t_field + frame_period;
        }
        let dark = dark_fields(&bench, t_late, bench.t_field - frame_period);
        assert!(matches!(dark[..], [(DarkReason::Late, count)] if count > 10), "asked before: {is_asked}: {dark:?}");
    }
}

#[test]
fn lasers_are_dark_while_nobody_is_at_the_control_who_was() {
    for (mode, asked) in MODES.into_iter().zip([None, Some(DarkReason::Asked)]) {
        let mut bench = Bench::new(mode);
        let attend = |bench: &Bench| bench.laser.shared.t_attended_ns.store(bench.now.0, Ordering::Release);
        bench.run(TimeNs(7000 * MS), TimeNs(0));
        assert!(bench.edges.last().unwrap().t > TimeNs(6900 * MS), "nobody has said that he is there");
        attend(&bench);
        bench.run(TimeNs(11_900 * MS), TimeNs(0));
        assert_eq!(bench.darks, []);
        bench.run(TimeNs(14_000 * MS), TimeNs(0));
        let &[(t_dark, DarkReason::Unattended)] = bench.darks.as_slice() else { panic!("{:?}", bench.darks) };
        assert!(t_dark < TimeNs(12_050 * MS) && bench.edges.last().unwrap().t <= t_dark, "{t_dark:?}");
        assert_eq!(bench.all_events.last().unwrap().dark, Some(DarkReason::Unattended));
        // Whoever comes back lights nothing against a person's order of meanwhile.
        bench.laser.shared.dark_request.store(dark_because(NEXT, asked), Ordering::Release);
        bench.run(TimeNs(14_100 * MS), TimeNs(0));
        attend(&bench);
        bench.run(TimeNs(15_000 * MS), TimeNs(0));
        let is_lit = bench.edges.last().unwrap().t > TimeNs(14_900 * MS);
        assert_eq!(is_lit, asked.is_none());
        assert_eq!(bench.all_events.last().unwrap().dark, asked);
    }
}

#[test]
fn a_field_that_the_colour_frame_does_not_have_lights_nothing() {
    for mode in MODES {
        let mut bench = Bench::new(mode);
        bench.falsify = |refresh| Some(PresentedRefresh { field: refresh.field + 3, ..refresh });
        bench.run(TimeNs(500 * MS), TimeNs(0));
        assert_eq!(bench.edges, []);
        let events = &bench.all_events;
        assert!(
            events.len() > 20 && events.iter().all(|event| event.dark == Some(DarkReason::WrongColour)),
            "{}",
            events.len()
        );
    }
}

#[test]
fn a_lost_panel_is_dark_at_once_and_lit_again_when_it_is_back() {
    for mode in MODES {
        let mut bench = Bench::new(mode);
        bench.run(TimeNs(300 * MS), TimeNs(0));
        bench.falsify = |_| None;
        bench.news.push(PanelNews::Lost).unwrap();
        let t_lost = bench.now + TimeNs(MS);
        bench.wake(t_lost);
        // The box's time is in whole microseconds.
        let &[(t_dark, DarkReason::PanelLost)] = bench.darks.as_slice() else { panic!("{:?}", bench.darks) };
        assert!((0..1000).contains(&(t_lost.0 - t_dark.0)), "{t_dark:?} {t_lost:?}");
        let edges = bench.edges.len();
        bench.run(TimeNs(600 * MS), TimeNs(0));
        assert_eq!(bench.edges.len(), edges);
        bench.falsify = Some;
        bench.run(TimeNs(900 * MS), TimeNs(0));
        assert!(bench.edges.len() > edges);
        assert_eq!(bench.verdict().unsafe_findings().count(), 0);
    }
}

#[test]
fn missing_reports_make_dark_and_fields_that_return_make_light() {
    for mode in MODES {
        let mut bench = Bench::new(mode);
        bench.run(TimeNs(500 * MS), TimeNs(0));
        bench.falsify = |_| None;
        let t_lost = bench.now;
        bench.run(TimeNs(900 * MS), TimeNs(0));
        let &(t_dark, _) = bench.darks.last().unwrap();
        let refresh_ms = if mode == PanelMode::ChannelPacked { 17 } else { 6 };
        assert!(t_dark - t_lost <= TimeNs(3 * refresh_ms * MS + 6 * MS), "{mode:?}: {t_dark:?} {t_lost:?}");
        let edges = bench.edges.len();
        assert!(bench.edges.len() > 20 && bench.edges.iter().all(|edge| edge.t <= t_dark), "{}", bench.edges.len());
        bench.falsify = Some;
        bench.run(TimeNs(1200 * MS), TimeNs(0));
        assert!(bench.edges.len() > edges);
    }
}

#[test]
fn a_frame_that_nobody_renews_goes_dark_after_the_stall_timeout() {
    for mode in MODES {
        let mut bench = Bench::new(mode);
        bench.submit();
        for tick in 0..2000 {
            bench.wake(TimeNs(tick * MS));
        }
        let last = bench.edges.last().unwrap();
        assert!(!last.on && last.t > TimeNs(480 * MS) && last.t < TimeNs(540 * MS), "{last:?}");
        assert_eq!(bench.all_events.last().unwrap().dark, Some(DarkReason::Stall));
        assert_eq!(bench.verdict().findings, []);
    }
}

#[test]
fn a_latched_dark_stays_dark() {
    let mut bench = Bench::new(PanelMode::ChannelPacked);
    bench.run(TimeNs(300 * MS), TimeNs(0));
    bench.laser.shared.latch.store(1, Ordering::Release);
    bench.run(TimeNs(305 * MS), TimeNs(0));
    assert_eq!(bench.laser.shared.acknowledged.load(Ordering::Acquire), DARK);
    let edges = bench.edges.len();
    bench.run(TimeNs(2000 * MS), TimeNs(0));
    assert_eq!(bench.edges.len(), edges);
    assert_eq!(bench.verdict().unsafe_findings().count(), 0);
}

/// A simulated box, with something between it and its host.
struct Intercepted<B> {
    inner: SimulatedLaser,
    between: B,
}

impl<B> Intercepted<B> {
    fn new(t_boot: TimeNs, between: B) -> Self {
        Self { inner: SimulatedLaser::new(t_boot), between }
    }
}

/// What comes between; nothing, but for what it overrides.
trait Between: Send {
    fn capability(&self, capability: Capability) -> Capability {
        capability
    }
    /// When a command that is sent `now` arrives.
    fn arrives(&mut self, _command: &'static str, now: TimeNs) -> Result<TimeNs, LaserError> {
        Ok(now)
    }
    /// What is left of a window.
    fn left_of(&mut self, window: LitWindow) -> Option<LitWindow> {
        Some(window)
    }
    fn next_missed(&mut self) -> Option<MissedLight> {
        None
    }
    /// Before the box is asked what has happened.
    fn polled(&mut self) {}
}

impl<B: Between> LaserBox for Intercepted<B> {
    fn capability(&self) -> Capability {
        self.between.capability(self.inner.capability())
    }
    fn program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), LaserError> {
        self.inner.program(program, self.between.arrives("program", now)?)
    }
    fn arm(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.inner.arm(self.between.arrives("arm", now)?)
    }
    fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        self.inner.sync(t_sync, self.between.arrives("sync", now)?)
    }
    fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        let now = self.between.arrives("light", now)?;
        self.between.left_of(window).map_or(Ok(None), |window| self.inner.light(window, now))
    }
    fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.inner.heartbeat(self.between.arrives("heartbeat", now)?)
    }
    fn dark(&mut self, reason: DarkReason, now: TimeNs) -> Result<(), LaserError> {
        self.inner.dark(reason, self.between.arrives("dark", now)?)
    }
    fn next_missed(&mut self) -> Option<MissedLight> {
        self.between.next_missed()
    }
    fn poll(&mut self, now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
        self.between.polled();
        let tells_edges = self.capability().gates_fields;
        self.inner.poll(now, &mut |happened| {
            if tells_edges || !matches!(happened, BoxEvent::Edge(_)) {
                event(happened);
            }
        })
    }
}

/// A box that fails when it is told so.
struct Faulty(Arc<AtomicBool>);

impl Between for Faulty {
    fn arrives(&mut self, command: &'static str, now: TimeNs) -> Result<TimeNs, LaserError> {
        let refused = LaserError::Refused { command, refusal: Refusal::Malformed };
        if self.0.load(Ordering::Relaxed) { Err(refused) } else { Ok(now) }
    }
}

#[test]
fn a_box_that_fails_goes_dark_by_itself_and_is_tried_again_later() {
    for mode in MODES {
        let fails = Arc::new(AtomicBool::new(false));
        let laser = Intercepted::new(TimeNs(0), Faulty(Arc::clone(&fails)));
        let mut bench = Bench::with_box(mode, Box::new(laser));
        bench.run(TimeNs(300 * MS), TimeNs(0));
        fails.store(true, Ordering::Relaxed);
        let t_failed = bench.now;
        bench.run(TimeNs(800 * MS), TimeNs(0));
        let &(t_dark, _) = bench.darks.last().unwrap();
        assert!(t_dark - t_failed <= TimeNs(100 * MS), "the heartbeat timeout");
        assert!(bench.edges.len() > 20 && bench.edges.iter().all(|edge| edge.t <= t_dark), "{}", bench.edges.len());
        assert!(bench.all_events.last().unwrap().dark.is_some());
        fails.store(false, Ordering::Relaxed);
        bench.run(TimeNs(2500 * MS), TimeNs(0));
        assert!(bench.edges.last().unwrap().t > TimeNs(2400 * MS));
        assert_eq!(bench.verdict().unsafe_findings().count(), 0);
    }
}

/// A panel that goes on whatever the laser thread does: true reports of a new frame's fields, up to a time.
struct Reporter {
    news: Producer<PanelNews>,
    field_period: TimeNs,
    fields: i64,
}

impl Reporter {
    const T_END: TimeNs = TimeNs(4000 * MS);

    fn report(&mut self, now: TimeNs) {
        loop {
            let t_present = T_FIRST + TimeNs(self.fields * self.field_period.0);
            if t_present > now.min(Self::T_END) {
                return;
            }
            let field = self.fields as usize % 3;
            let frame = FrameTag { frame_id: 1 + self.fields as u64 / 3, ..FrameTag::default() };
            let refresh = PresentedRefresh {
                frame: Some(frame),
                field,
                repeated: field > 0,
                t_present,
                timestamp_source: TimestampSource::Software,
                refresh_count: None,
            };
            self.news.push(PanelNews::Refresh(refresh)).expect("the laser thread reads them");
            self.fields += 1;
        }
    }
}

/// A box that answers late, while the panel goes on.
struct Slow {
    now: Arc<AtomicI64>,
    there_and_back: TimeNs,
    reporter: Arc<Mutex<Reporter>>,
    shared: Arc<Shared>,
    /// When somebody orders darkness, and what.
    t_order: TimeNs,
    order: fn(&Shared),
    armed: Arc<AtomicU64>,
    armed_after_order: Arc<AtomicU64>,
}

impl Slow {
    fn wait(&self) -> TimeNs {
        let before = TimeNs(self.now.fetch_add(self.there_and_back.0, Ordering::Relaxed));
        let now = before + self.there_and_back;
        self.reporter.lock().unwrap().report(now);
        if (before..now).contains(&self.t_order) {
            (self.order)(&self.shared);
        }
        now
    }
}

impl Between for Slow {
    fn arrives(&mut self, command: &'static str, now: TimeNs) -> Result<TimeNs, LaserError> {
        match command {
            "arm" => {
                self.armed.fetch_add(1, Ordering::Relaxed);
                if self.now.load(Ordering::Relaxed) > self.t_order.0 {
                    self.armed_after_order.fetch_add(1, Ordering::Relaxed);
                }
                Ok(self.wait())
            }
            "dark" => Ok(self.wait()),
            _ => Ok(now),
        }
    }
}

#[test]
fn a_box_that_answers_more_slowly_than_refreshes_come_is_armed_once_and_not_against_an_order() {
    // The last one comes too late.
    let orders: [fn(&Shared); 3] = [
        |shared| shared.dark_request.store(dark_because(NEXT, Some(DarkReason::Asked)), Ordering::Release),
        |shared| shared.latch.store(1, Ordering::Release),
        |_| unreachable!(),
    ];
    for there_and_back_ms in [4, 12, 20, 40, 180] {
        for (index, order) in orders.into_iter().enumerate() {
            let mut bench = Bench::new(PanelMode::FieldSequential);
            let field_period = bench.laser.scheduler.gate().timing().field_period;
            let (news, reports) = RingBuffer::new(SHORT_RING);
            bench.laser.news = reports;
            let reporter = Arc::new(Mutex::new(Reporter { news, field_period, fields: 0 }));
            let now = Arc::new(AtomicI64::new(0));
            let armed_after_order = Arc::new(AtomicU64::new(0));
            // While the first ARM is waited for.
            let t_order = if index == 2 { TimeNs(i64::MAX) } else { T_FIRST + TimeNs(8 * field_period.0 + 3 * MS) };
            let armed = Arc::new(AtomicU64::new(0));
            let mut laser = Intercepted::new(
                TimeNs(0),
                Slow {
                    now: Arc::clone(&now),
                    there_and_back: TimeNs(there_and_back_ms * MS),
                    reporter: Arc::clone(&reporter),
                    shared: Arc::clone(&bench.laser.shared),
                    t_order,
                    order,
                    armed: Arc::clone(&armed),
                    armed_after_order: Arc::clone(&armed_after_order),
                },
            );
            laser.program(&bench.laser.program, TimeNs(0)).unwrap();
            bench.laser.laser = Box::new(laser);
            let obeyed = |shared: &Shared| {
                let asked = shared.dark_answer.load(Ordering::Acquire) != 0;
                [asked, shared.acknowledged.load(Ordering::Acquire) != NOT_YET, false][index]
            };
            let mut t_obeyed = None;
            // At the end of the reports it goes dark.
            while now.load(Ordering::Relaxed) < Reporter::T_END.0 - 10 * MS {
                let t = TimeNs(now.fetch_add(MS, Ordering::Relaxed) + MS);
                reporter.lock().unwrap().report(t);
                bench.laser.step(|| TimeNs(now.load(Ordering::Relaxed)));
                if obeyed(&bench.laser.shared) {
                    t_obeyed.get_or_insert(TimeNs(now.load(Ordering::Relaxed)));
                }
            }
            let case = format!("{there_and_back_ms} ms there and back");
            assert_eq!(armed.load(Ordering::Relaxed), 1, "{case}");
            assert_eq!(armed_after_order.load(Ordering::Relaxed), 0, "{case}");
            if index == 2 {
                continue;
            }
            let took = t_obeyed.expect("obeyed") - t_order;
            assert!(took <= TimeNs((2 * there_and_back_ms + 2) * MS), "{case}: {took:?}");
        }
    }
}

/// A box that is told of every `each`th window too late, for half of it or for all, and says so only at the next poll.
struct Deaf {
    asked: u64,
    each: u64,
    is_whole: bool,
    answered: VecDeque<MissedLight>,
    missed: VecDeque<MissedLight>,
}

impl Between for Deaf {
    fn left_of(&mut self, window: LitWindow) -> Option<LitWindow> {
        self.asked += 1;
        if !self.asked.is_multiple_of(self.each) {
            return Some(window);
        }
        let whole = window.t_off - window.t_on;
        let time = if self.is_whole { whole } else { TimeNs(whole.0 / 2) };
        self.answered.push_back(MissedLight { window, time });
        (!self.is_whole).then_some(LitWindow { t_on: window.t_on + time, ..window })
    }
    fn next_missed(&mut self) -> Option<MissedLight> {
        self.missed.pop_front()
    }
    fn polled(&mut self) {
        self.missed.append(&mut self.answered);
    }
}

#[test]
fn light_that_the_box_missed_is_told_and_costs_the_other_colours_as_much() {
    // Of every fourth window each colour loses one in turn, of every third always the same.
    for (each, is_whole) in [(4, false), (4, true), (3, false), (3, true)] {
        let (answered, missed) = (VecDeque::new(), VecDeque::new());
        let laser = Intercepted::new(TimeNs(0), Deaf { asked: 0, each, is_whole, answered, missed });
        let mut bench = Bench::with_box(PanelMode::FieldSequential, Box::new(laser));
        bench.run(TimeNs(4000 * MS), TimeNs(0));
        bench.laser.latch(DarkReason::Shutdown, TimeNs(4000 * MS));
        bench.wake(TimeNs(4001 * MS));
        assert_eq!(bench.verdict().findings, []);
        let dark = |reason| bench.all_events.iter().filter(|event| event.dark == Some(reason)).count();
        let in_part = bench.laser.shared.counts().lit_in_part;
        if is_whole {
            assert!(dark(DarkReason::Late) > 50 && in_part == 0, "{} {in_part}", dark(DarkReason::Late));
        } else {
            assert!(dark(DarkReason::Late) == 0 && in_part > 50, "{} {in_part}", dark(DarkReason::Late));
        }
        let lit_ns = Colour::ALL.map(|colour| {
            let lit = bench.all_events.iter().filter(|event| event.colour == colour);
            lit.filter_map(|event| Some((event.laser_off? - event.laser_on?).0)).sum::<i64>()
        });
        // One colour frame's light, and what one more takes in before a miss is known.
        let spread_ns = lit_ns.iter().max().unwrap() - lit_ns.iter().min().unwrap();
        assert!(spread_ns <= 2 * bench.laser.scheduler.gate().width().0, "{each} {is_whole}: {lit_ns:?}");
    }
}

/// A box that is simply on while it is armed, and tells no edges.
struct Switch;

impl Between for Switch {
    fn capability(&self, capability: Capability) -> Capability {
        Capability { gates_fields: false, ..capability }
    }
    fn left_of(&mut self, _window: LitWindow) -> Option<LitWindow> {
        None
    }
}

#[test]
fn a_field_of_a_box_that_tells_no_edges_is_not_said_to_be_dark() {
    for mode in MODES {
        let mut bench = Bench::with_box(mode, Box::new(Intercepted::new(TimeNs(0), Switch)));
        bench.run(TimeNs(1000 * MS), TimeNs(0));
        bench.laser.latch(DarkReason::Shutdown, TimeNs(1000 * MS));
        bench.run(TimeNs(1200 * MS), TimeNs(0));
        bench.wake(TimeNs(1201 * MS));
        let (lit, dark): (Vec<&FieldEvent>, Vec<_>) = bench.all_events.iter().partition(|event| event.dark.is_none());
        assert!(lit.len() > 150 && lit.iter().all(|event| event.laser_on.is_none()), "{}", lit.len());
        assert!(lit.iter().all(|event| event.t_present < TimeNs(1000 * MS)));
        assert!(dark.iter().any(|event| event.dark == Some(DarkReason::Shutdown)));
        assert_eq!(bench.laser.shared.counts().dark_fields, dark.len() as u64);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    /// However late the threads wake up, and whenever frames come, no light goes where it must not, every field
    /// without light has a reason, and when everything stops the box goes dark by itself.
    #[test]
    fn no_jitter_and_no_stall_lights_what_it_must_not(
        packed in prop::bool::ANY,
        wakes in prop::collection::vec((prop_oneof![6 => 1i64..6000, 2 => 6000i64..40_000, 1 => 40_000i64..900_000], 0u8..4), 50..400),
    ) {
        let mut bench = Bench::new(if packed { PanelMode::ChannelPacked } else { PanelMode::FieldSequential });
        let mut now = TimeNs(0);
        for (later_us, frames) in wakes {
            if frames == 0 {
                bench.now = now;
                bench.submit();
            }
            now = now + TimeNs(later_us * 1000);
            bench.wake(now);
        }
        // The host hangs for good; only the box's own time goes on.
        let t_hang = now;
        let mut left = Vec::new();
        bench.laser.laser.poll(now + TimeNs(10_000 * MS), &mut |event| left.push(event)).unwrap();
        for event in left {
            match event {
                BoxEvent::Edge(edge) => {
                    prop_assert!(edge.t - t_hang <= TimeNs(100 * MS));
                    bench.edges.push(edge);
                }
                BoxEvent::Dark { t, .. } => prop_assert!(t - t_hang <= TimeNs(100 * MS)),
                BoxEvent::Armed { .. } => prop_assert!(false),
            }
        }
        // The panel shows on what it has, and a panel would say so.
        let mut fields = Vec::new();
        bench.panel.tick(t_hang + TimeNs(60 * MS), &mut bench.source, &mut |field| fields.push(field)).unwrap();
        let decide = |laser: &mut LaserThread| {
            while let Some(decision) = laser.scheduler.next_field(TimeNs(i64::MAX / 2)) {
                laser.ledger.field(&decision.shown, Some(DarkReason::Heartbeat), &laser.shared);
            }
        };
        decide(&mut bench.laser);
        for refresh in fields {
            bench.laser.scheduler.on_refresh(&refresh);
            decide(&mut bench.laser);
        }
        let report = bench.verdict();
        prop_assert_eq!(report.findings, vec![], "edges {:?}", bench.edges.len());
    }
}

#[test]
fn the_real_threads_show_light_and_end_in_order() {
    for mode in MODES {
        let rig = rig(mode);
        let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
        let options = OutputOptions { keep_slots: 1, ..OutputOptions::default() };
        let mut output = headless(&rig, &encoder, options);
        let config = pacing_config(&rig, TimeNs(2 * MS)).unwrap();
        let mut pacer = Pacer::new(config, host_now());
        let pattern = vec![1.0f32; SIZE.pixels()];
        let mut last_plan = None;
        let mut reports = 0;
        for frame in 0..30 {
            output.frames.feed(&mut pacer, |_| reports += 1);
            let plan = pacer.predict(host_now());
            let rest = plan.t_wake - host_now();
            std::thread::sleep(Duration::from_nanos(rest.0.max(0) as u64));
            encoder.encode(PerColour([&pattern; 3]), output.frames.acquire());
            let now = host_now();
            output.frames.submit(&plan, Some(0), now);
            pacer.submitted(plan.frame_id, now);
            last_plan = Some(plan);
            assert_eq!(plan.frame_id, frame + 1);
        }
        let report = output.control.shutdown();
        assert!(report.lasers_dark && report.flat_presented, "{report:?}");
        assert!(reports > 0);
        let kept = report.kept[0].as_ref().unwrap();
        assert_eq!(kept.unpack_colour(Colour::Blue).levels, [41; SIZE.pixels()]);
        assert!(kept.tag().frame_id <= last_plan.unwrap().frame_id);

        let mut events = Vec::new();
        while let Ok(event) = output.events.pop() {
            events.push(event);
        }
        let mut edges = Vec::new();
        let mut t_dark = None;
        while let Ok(event) = output.box_events.pop() {
            match event {
                BoxEvent::Edge(edge) => edges.push(edge),
                BoxEvent::Dark { t, .. } => t_dark = Some(t),
                BoxEvent::Armed { .. } => t_dark = None,
            }
        }
        assert!(t_dark.is_some(), "the box ends dark");
        let spans: Vec<_> = events.iter().map(FieldEvent::span).collect();
        let verdict = verify_edges(&spans, &edges);
        assert_eq!(verdict.findings, [], "{:?}", report.counts);
        assert!(verdict.lit > 0);
        assert_eq!((report.counts.fields, report.counts.lost), (events.len() as u64, 0));
    }
}

#[test]
fn darkness_that_is_asked_for_is_acknowledged_each_time_or_said_not_to_be() {
    const ASKED: Option<DarkReason> = Some(DarkReason::Asked);
    let rig = rig(PanelMode::ChannelPacked);
    let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
    let output = headless(&rig, &encoder, OutputOptions::default());
    assert!(output.control.keep_dark(ASKED) && output.control.keep_dark(ASKED) && output.control.keep_dark(None));
    // A box that fails is not dark because nothing new is heard of it.
    let panel = HeadlessPanel::new(&PanelSetup::new(&rig.panel, &encoder), host_now(), ReportFaults::NONE);
    let fails = Arc::new(AtomicBool::new(false));
    let laser = Intercepted::new(host_now(), Faulty(Arc::clone(&fails)));
    let options = OutputOptions::default();
    let failing = Output::start(&rig, &encoder, Box::new(panel), Box::new(laser), options, host_now).unwrap();
    fails.store(true, Ordering::Relaxed);
    assert!(!failing.control.keep_dark(ASKED) && !failing.control.keep_dark(ASKED));
    fails.store(false, Ordering::Relaxed);
    assert!(failing.control.keep_dark(ASKED));
}

#[test]
fn a_wish_for_darkness_holds_whatever_the_control_does_until_that_takes_it_back_after_it() {
    let rig = rig(PanelMode::ChannelPacked);
    let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
    let output = headless(&rig, &encoder, OutputOptions::default());
    let switch = output.control.dark_switch();
    let asked_for = || dark_request_parts(switch.shared.dark_request.load(Ordering::Acquire)).1;
    let (first, second) = (switch.wish_dark(), switch.wish_dark());
    let patience = host_now() + TimeNs(20_000 * MS);
    while switch.answer_to(second.request()).is_none() {
        assert!(host_now() < patience, "the laser thread answers");
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(switch.answer_to(first.request()), Some(true), "the box is dark, with nobody at the control");
    // Orders of before the wishes.
    assert!(output.control.keep_dark(None) && output.control.keep_dark(Some(DarkReason::NoPicture)));
    assert_eq!(asked_for(), Some(DarkReason::Asked));
    assert!(output.control.keep_dark_as_wished(first));
    assert!(output.control.keep_dark(None));
    assert_eq!(asked_for(), Some(DarkReason::Asked), "the second wish came after that");
    assert!(output.control.keep_dark_as_wished(second));
    assert_eq!(asked_for(), Some(DarkReason::Asked));
    assert!(output.control.keep_dark(None));
    assert_eq!(asked_for(), None);
}

#[test]
fn a_control_that_is_dropped_ends_the_output() {
    let rig = rig(PanelMode::ChannelPacked);
    let encoder = PanelEncoder::new(&rig.panel, SIZE, SIZE).unwrap();
    let output = headless(&rig, &encoder, OutputOptions::default());
    let switch = output.control.dark_switch();
    drop(output);
    assert!(switch.is_dark());
    assert!(switch.shared.flat_shown.load(Ordering::Acquire));
}
