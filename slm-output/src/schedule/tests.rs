//! The scheduler against panels whose reports lie.
//!
//! A true panel is stepped refresh by refresh. What it reports may be late, early, doubled, jittered, or missing, and
//! it may drop refreshes. A laser box of the reference model obeys the scheduler. What was lit is then judged against
//! what was truly on the panel.

use holod_calibration::Resolution;
use holod_calibration::rig::{PanelMode, Rig};
use proptest::prelude::*;

use super::*;
use crate::laser::{BoxEvent, LaserBox, LaserEdge, SimulatedLaser};

const MS: i64 = 1_000_000;

/// One refresh of the true panel, and what it says of itself.
#[derive(Clone, Copy, Debug)]
struct Step {
    /// The panel goes on with its old picture, and says nothing.
    dropped: bool,
    /// The panel refreshes as planned, and says nothing.
    silent: bool,
    /// The reported time is off by this.
    jitter_ns: i64,
    /// The reported time is before the true one by this.
    early_ns: i64,
    /// The report comes this long after the refresh.
    delay_ns: i64,
    /// It is reported again, so much later.
    doubled_ns: Option<i64>,
}

const HONEST: Step =
    Step { dropped: false, silent: false, jitter_ns: 0, early_ns: 0, delay_ns: 50_000, doubled_ns: None };

/// A pattern that truly was on the panel.
#[derive(Clone, Copy, Debug)]
struct Truth {
    colour: Colour,
    t_begin: TimeNs,
    t_end: TimeNs,
}

struct Ran {
    truth: Vec<Truth>,
    edges: Vec<LaserEdge>,
}

fn rig(mode: PanelMode, frames_per_colour: u8) -> Rig {
    let mut rig = Rig::default();
    rig.panel.mode = mode;
    rig.panel.frames_per_colour = frames_per_colour;
    if mode != PanelMode::ChannelPacked {
        rig.panel.refresh_hz = 180.0;
    }
    rig
}

fn scheduler(rig: &Rig, clock: WindowClock) -> FieldScheduler {
    let layout = FrameLayout::new(&rig.panel, Resolution { width: 2, height: 2 });
    FieldScheduler::new(&rig.panel, layout, &rig.lasers, Evidence::Stamped, clock, TimeNs(500 * MS)).unwrap()
}

/// Runs a panel through `steps`; its windows are started by what it reports.
fn run(rig: &Rig, steps: &[Step]) -> Ran {
    run_with(rig, scheduler(rig, WindowClock::Reports), steps)
}

fn run_with(rig: &Rig, mut scheduler: FieldScheduler, steps: &[Step]) -> Ran {
    let layout = scheduler.layout;
    let refresh_ns = scheduler.gate.timing().refresh_period.0;
    let mut laser = SimulatedLaser::new(TimeNs(0));
    laser.program(&scheduler.program(&rig.panel, &rig.lasers).unwrap(), TimeNs(0)).unwrap();

    let mut truth: Vec<Truth> = Vec::new();
    let mut reports: Vec<(TimeNs, PresentedRefresh)> = Vec::new();
    let mut field = 0;
    let mut frame_id = 0;
    for (index, step) in steps.iter().enumerate() {
        let t_true = TimeNs(100 * MS + index as i64 * refresh_ns);
        let t_end = t_true + TimeNs(refresh_ns);
        let packed = layout.fields_per_refresh() > 1;
        if step.dropped && !packed {
            if let Some(last) = truth.last_mut() {
                last.t_end = t_end;
            }
            continue;
        }
        // A panel's own sequencer shows each colour anew, of an old picture, too.
        let fields = layout.fields_per_refresh() as i64;
        truth.extend((0..fields).map(|part| Truth {
            colour: layout.colour_of_field(field + part as usize),
            t_begin: t_true + TimeNs(part * refresh_ns / fields),
            t_end: t_true + TimeNs((part + 1) * refresh_ns / fields),
        }));
        if step.dropped {
            continue;
        }
        frame_id += u64::from(field == 0);
        let refresh = PresentedRefresh {
            frame: Some(FrameTag { frame_id, ..FrameTag::default() }),
            field,
            repeated: field > 0,
            t_present: t_true + TimeNs(step.jitter_ns - step.early_ns),
            timestamp_source: TimestampSource::Hardware,
            refresh_count: None,
        };
        let t_told = t_true + TimeNs(step.delay_ns);
        if !step.silent {
            reports.push((t_told, refresh));
        }
        if let Some(later_ns) = step.doubled_ns {
            let again = PresentedRefresh { t_present: refresh.t_present + TimeNs(later_ns), ..refresh };
            reports.push((t_told + TimeNs(later_ns), again));
        }
        field = (field + layout.fields_per_refresh()) % layout.fields();
    }
    reports.sort_by_key(|(t_told, _)| *t_told);

    let mut edges = Vec::new();
    let mut collect = |event: BoxEvent| {
        if let BoxEvent::Edge(edge) = event {
            edges.push(edge);
        }
    };
    let try_obey = |laser: &mut SimulatedLaser, orders: Orders, now: TimeNs| {
        if let Some(reason) = orders.dark {
            laser.dark(reason, now)?;
        }
        if orders.arm {
            laser.arm(now)?;
        }
        if orders.heartbeat {
            laser.heartbeat(now)?;
        }
        if let Some(t_sync) = orders.sync {
            laser.sync(t_sync, now)?;
        }
        orders.light.map_or(Ok(()), |window| laser.light(window, now).map(|_| ()))
    };
    // A box refuses what comes when it has gone dark by itself.
    let obey = |laser: &mut SimulatedLaser, orders: Orders, now: TimeNs| {
        let obeyed: Result<(), LaserError> = try_obey(laser, orders, now);
        if obeyed.is_err() {
            laser.dark(DarkReason::BoxFault, now).unwrap();
        }
        obeyed.is_ok()
    };
    let decide = |scheduler: &mut FieldScheduler, laser: &mut SimulatedLaser, now: TimeNs| {
        while let Some(decision) = scheduler.next_field(now) {
            if !obey(laser, decision.orders, now) {
                scheduler.box_went_dark(DarkReason::Heartbeat);
            }
        }
    };
    let mut t_before = TimeNs(0);
    for (t_told, refresh) in reports {
        // The laser thread wakes up every few milliseconds in between.
        for wake in 1..=32 {
            let now = TimeNs(t_told.0 - (32 - wake) * MS / 2).max(t_before);
            t_before = now;
            laser.poll(now, &mut collect).unwrap();
            decide(&mut scheduler, &mut laser, now);
            let orders = scheduler.watch(now);
            obey(&mut laser, orders, now);
        }
        scheduler.on_refresh(&refresh);
        decide(&mut scheduler, &mut laser, t_told);
        laser.poll(t_told, &mut collect).unwrap();
    }
    laser.poll(TimeNs(i64::MAX / 4), &mut collect).unwrap();
    Ran { truth, edges }
}

/// (colour, on, off) of all windows.
fn windows(edges: &[LaserEdge]) -> Vec<(Colour, TimeNs, TimeNs)> {
    edges.chunks(2).map(|pair| (pair[0].colour, pair[0].t, pair[1].t)).collect()
}

/// What was lit that must not have been.
fn faults(ran: &Ran, settle: TimeNs) -> Vec<String> {
    let mut faults = Vec::new();
    let mut t_free = TimeNs(0);
    for (colour, t_on, t_off) in windows(&ran.edges) {
        if t_on < t_free {
            faults.push(format!("two lasers at {t_on:?}"));
        }
        t_free = t_off;
        for shown in ran.truth.iter().filter(|shown| t_on < shown.t_end && shown.t_begin < t_off) {
            if shown.colour != colour {
                faults.push(format!("{colour} over {shown:?} from {t_on:?} to {t_off:?}"));
            }
        }
        // A pattern may be lit again while the same colour's pattern stays; it settles when it comes.
        let begun = ran.truth.iter().rev().find(|shown| shown.t_begin <= t_on);
        if begun.is_none_or(|shown| t_on < shown.t_begin + settle) {
            faults.push(format!("{colour} unsettled at {t_on:?}"));
        }
    }
    faults
}

#[test]
fn canary_the_judge_sees_light_over_another_colour_and_over_an_unsettled_field() {
    let rig = rig(PanelMode::FieldSequential, 1);
    let ran = run(&rig, &[HONEST; 60]);
    assert_eq!(faults(&ran, rig.panel.settle), Vec::<String>::new());
    assert!(windows(&ran.edges).len() > 50);
    for shift_ns in [-2_200_000, 600_000, 5_555_556] {
        let edges = ran.edges.iter().map(|edge| LaserEdge { t: edge.t + TimeNs(shift_ns), ..*edge }).collect();
        assert_ne!(faults(&Ran { truth: ran.truth.clone(), edges }, rig.panel.settle), Vec::<String>::new());
    }
}

#[test]
fn one_colour_is_lit_at_every_refresh_in_monochrome() {
    let rig = rig(PanelMode::Monochrome(Colour::Green), 1);
    let ran = run(&rig, &[HONEST; 60]);
    assert_eq!(faults(&ran, rig.panel.settle), Vec::<String>::new());
    let lit = windows(&ran.edges);
    assert!(lit.len() >= 51 && lit.iter().all(|(colour, ..)| *colour == Colour::Green), "{}", lit.len());
}

/// A report that is off by up to 0.9 ms, as software's are.
fn jittered(index: i64) -> Step {
    Step { jitter_ns: index * 421_337 % 1_800_001 - 900_000, delay_ns: MS, ..HONEST }
}

#[test]
fn a_packed_panel_is_lit_after_its_reports_only_where_they_are_true() {
    let rig = rig(PanelMode::ChannelPacked, 1);
    let honest = run(&rig, &[HONEST; 120]);
    assert_eq!(faults(&honest, rig.panel.settle), Vec::<String>::new());
    assert!(windows(&honest.edges).len() > 3 * 110, "{}", windows(&honest.edges).len());
    let steps: Vec<_> = (0..600).map(jittered).collect();
    let ran = run(&rig, &steps);
    assert_eq!(faults(&ran, rig.panel.settle), Vec::<String>::new());
}

#[test]
fn canary_the_judge_sees_that_a_packed_panel_was_lit_by_reports_that_are_believed_too_far() {
    let rig = rig(PanelMode::ChannelPacked, 1);
    // The reports start the windows here, and the scheduler takes it that the panel does.
    let steps: Vec<_> = (0..600).map(jittered).collect();
    let ran = run_with(&rig, scheduler(&rig, WindowClock::Panel), &steps);
    let found = faults(&ran, rig.panel.settle);
    assert!(found.iter().any(|fault| fault.contains("unsettled")), "{} windows", windows(&ran.edges).len());
}

#[test]
fn a_refresh_that_nobody_reports_costs_its_own_light_and_that_of_its_neighbours_in_balance() {
    let rig = rig(PanelMode::FieldSequential, 1);
    let mut steps = vec![HONEST; 300];
    for index in (20..300).step_by(30) {
        steps[index].silent = true;
    }
    let ran = run(&rig, &steps);
    assert_eq!(faults(&ran, rig.panel.settle), Vec::<String>::new());
    let lit = windows(&ran.edges);
    assert!(lit.len() > 240, "{}", lit.len());
    // Over any second (90 colour frames here) the colours differ by one window.
    for second in lit.windows(60) {
        let of = |wanted: Colour| second.iter().filter(|(colour, ..)| *colour == wanted).count();
        let counts = Colour::ALL.map(of);
        assert!(counts.iter().max().unwrap() - counts.iter().min().unwrap() <= 2, "{counts:?}");
    }
}

fn step() -> impl Strategy<Value = Step> {
    let small = -60_000i64..=60_000;
    (
        prop::bool::weighted(0.03),
        prop::bool::weighted(0.03),
        small,
        prop_oneof![12 => Just(0i64), 1 => 0i64..6 * MS],
        prop_oneof![8 => 0i64..1_500_000, 1 => 0i64..20 * MS],
        prop::option::weighted(0.04, 1i64..8 * MS),
    )
        .prop_map(|(dropped, silent, jitter_ns, early_ns, delay_ns, doubled_ns)| Step {
            dropped,
            silent,
            jitter_ns,
            early_ns,
            // A report does not come before the refresh that it is of, but for an early one.
            delay_ns: delay_ns.max(jitter_ns),
            doubled_ns: doubled_ns.filter(|_| !silent),
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// Jitter below the slack that the rig leaves, lies of any size now and then (a panel that lies all the time, and
    /// always by as much, is one whose clock is wrong, which no report can tell): never two lasers, never one over
    /// another colour's or an unsettled pattern.
    #[test]
    fn no_lie_of_the_panel_lights_what_must_stay_dark(
        packed in prop::bool::ANY,
        frames_per_colour in 1u8..3,
        honest in 0usize..20,
        steps in prop::collection::vec(step(), 100..600),
    ) {
        let mode = if packed { PanelMode::ChannelPacked } else { PanelMode::FieldSequential };
        let mut rig = rig(mode, frames_per_colour);
        rig.lasers.on_delay = TimeNs(250_000);
        rig.lasers.width = TimeNs(2_800_000);
        let mut steps = [vec![HONEST; honest], steps].concat();
        for index in 0..steps.len() {
            let lately = steps[index.saturating_sub(3)..index].iter();
            if lately.copied().any(|step| step.early_ns > 0 || step.doubled_ns.is_some()) {
                steps[index] = Step { early_ns: 0, doubled_ns: None, ..steps[index] };
            }
        }
        let ran = run(&rig, &steps);
        prop_assert_eq!(faults(&ran, rig.panel.settle), Vec::<String>::new());
    }
}
