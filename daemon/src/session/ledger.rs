//! Running judgement of the lasers against the fields that were shown.

use std::collections::{BTreeMap, VecDeque};

use holod_calibration::TimeNs;
use holod_slm_output::FieldEvent;
use holod_slm_output::laser::verify::{FieldSpan, verify_edges};
use holod_slm_output::laser::{BoxEvent, LaserEdge};
use serde::Serialize;

use super::laser_watch::BoxLost;

/// Fields that wait before they are judged, so that the edges that belong to them have come.
const WAITING_FIELDS: usize = 600;
/// Findings that are kept word for word.
const KEPT_FINDINGS: usize = 20;
/// Times of going dark that are kept: the first ones, and as many of the newest.
const KEPT_DARK: usize = 10;

/// What the lasers did in the whole run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct LaserSummary {
    /// Fields of frames that were judged, repetitions included.
    pub fields: usize,
    /// Of those, lit by exactly one window of their own colour.
    pub lit: usize,
    /// Of those, meant to stay dark and dark.
    pub dark: usize,
    /// Fields of lasers that are simply on while their box is armed: nobody tells which were lit, and they are not
    /// judged.
    pub not_told: u64,
    /// Windows of which the box heard too late for their beginning, and that it lit in part.
    pub lit_in_part: u64,
    /// Fields that stayed dark, by reason.
    pub dark_by_reason: BTreeMap<&'static str, u64>,
    /// Light where there must be none.
    pub unsafe_findings: usize,
    /// Everything that was not as it should be.
    pub findings_in_all: usize,
    /// The first findings in words.
    pub findings: Vec<String>,
    /// How often the box went dark.
    pub went_dark_in_all: usize,
    /// Times and reasons of going dark, newest last: the first ten and the newest ten.
    pub went_dark: Vec<String>,
    /// That the box was lost, where it was.
    pub box_lost: Option<BoxLost>,
}

/// Collects fields and edges and judges them in batches.
#[derive(Default)]
pub(super) struct LaserLedger {
    fields: VecDeque<FieldSpan>,
    edges: VecDeque<LaserEdge>,
    summary: LaserSummary,
}

impl LaserLedger {
    /// A field is over.
    pub(super) fn field(&mut self, event: &FieldEvent) {
        match event.dark.filter(|_| event.laser_on.is_none()) {
            Some(reason) => *self.summary.dark_by_reason.entry(reason.name()).or_default() += 1,
            None if event.laser_on.is_none() => {
                self.summary.not_told += 1;
                return;
            }
            None => {}
        }
        self.fields.push_back(event.span());
        if self.fields.len() >= 2 * WAITING_FIELDS {
            let until = self.fields[WAITING_FIELDS].t_present;
            self.judge(Some(until));
        }
    }

    /// The laser box spoke.
    pub(super) fn box_event(&mut self, event: &BoxEvent) {
        match event {
            BoxEvent::Edge(edge) => self.edges.push_back(*edge),
            BoxEvent::Armed { .. } => {}
            BoxEvent::Dark { t, reason } => {
                self.summary.went_dark_in_all += 1;
                if self.summary.went_dark.len() == 2 * KEPT_DARK {
                    self.summary.went_dark.remove(KEPT_DARK);
                }
                self.summary.went_dark.push(format!("{} at {} ns", reason.name(), t.0));
            }
        }
    }

    /// Judges what is left.
    pub(super) fn finish(mut self) -> LaserSummary {
        self.judge(None);
        self.summary
    }

    fn judge(&mut self, until: Option<TimeNs>) {
        let before = |t: TimeNs| until.is_none_or(|until| t < until);
        let fields: Vec<FieldSpan> = take_while(&mut self.fields, |field| before(field.t_present));
        let mut edges: Vec<LaserEdge> = take_while(&mut self.edges, |edge| before(edge.t));
        // A window may end where the first field begins that is left for the next batch.
        while edges.last().is_some_and(|edge| edge.on) {
            let Some(next) = self.edges.pop_front() else { break };
            edges.push(next);
        }
        let report = verify_edges(&fields, &edges);
        self.summary.fields += report.fields;
        self.summary.lit += report.lit;
        self.summary.dark += report.dark;
        self.summary.unsafe_findings += report.unsafe_findings().count();
        self.summary.findings_in_all += report.findings.len();
        let room = KEPT_FINDINGS.saturating_sub(self.summary.findings.len());
        self.summary.findings.extend(report.findings.iter().take(room).map(ToString::to_string));
    }
}

fn take_while<T>(queue: &mut VecDeque<T>, mut wanted: impl FnMut(&T) -> bool) -> Vec<T> {
    let count = queue.iter().take_while(|item| wanted(item)).count();
    queue.drain(..count).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use holod_calibration::Colour;
    use holod_slm_output::TimestampSource;
    use holod_slm_output::laser::DarkReason;

    fn event(index: i64) -> FieldEvent {
        let t = TimeNs(index * 1000);
        FieldEvent {
            frame_id: (index / 3) as u64,
            field: (index % 3) as usize,
            colour: Colour::ALL[(index % 3) as usize],
            t_submit: TimeNs(0),
            t_desired_present: TimeNs(0),
            t_present: t,
            t_settled: t + TimeNs(100),
            t_end: t + TimeNs(1000),
            timestamp_source: TimestampSource::Software,
            laser_on: Some(t + TimeNs(200)),
            laser_off: Some(t + TimeNs(900)),
            dark: None,
            repeated: false,
            deadline_missed: false,
        }
    }

    fn run(fields: i64, mut colour_of: impl FnMut(i64, Colour) -> Colour) -> LaserSummary {
        let mut ledger = LaserLedger::default();
        for index in 0..fields {
            let event = event(index);
            let colour = colour_of(index, event.colour);
            for (t, on) in [(event.laser_on, true), (event.laser_off, false)] {
                ledger.box_event(&BoxEvent::Edge(LaserEdge { t: t.unwrap(), colour, on }));
            }
            ledger.field(&event);
        }
        ledger.finish()
    }

    #[test]
    fn a_window_that_ends_with_its_field_is_judged_with_it_at_a_seam_as_well() {
        let mut ledger = LaserLedger::default();
        for index in 0..5000 {
            let event = FieldEvent { laser_off: Some(event(index).t_end), ..event(index) };
            for (t, on) in [(event.laser_on, true), (event.laser_off, false)] {
                ledger.box_event(&BoxEvent::Edge(LaserEdge { t: t.unwrap(), colour: event.colour, on }));
            }
            ledger.field(&event);
        }
        let summary = ledger.finish();
        assert_eq!((summary.fields, summary.lit, summary.findings), (5000, 5000, vec![]));
    }

    #[test]
    fn fields_of_a_laser_that_tells_no_edges_are_counted_and_not_judged() {
        let mut ledger = LaserLedger::default();
        for index in 0..30 {
            let dark = (index < 3).then_some(DarkReason::SyncLost);
            ledger.field(&FieldEvent { laser_on: None, laser_off: None, dark, ..event(index) });
        }
        let summary = ledger.finish();
        assert_eq!((summary.fields, summary.lit, summary.dark, summary.not_told), (3, 0, 3, 27));
        assert_eq!(summary.dark_by_reason, BTreeMap::from([("sync-lost", 3)]));
        assert_eq!(summary.findings, Vec::<String>::new());
    }

    #[test]
    fn of_many_times_of_going_dark_the_first_and_the_newest_are_kept_and_all_are_counted() {
        let mut ledger = LaserLedger::default();
        for t in 0..61 {
            ledger.box_event(&BoxEvent::Dark { t: TimeNs(t), reason: DarkReason::Stall });
        }
        let summary = ledger.finish();
        let kept: Vec<_> = (0..10).chain(51..61).map(|t| format!("stall at {t} ns")).collect();
        assert_eq!((summary.went_dark_in_all, summary.went_dark), (61, kept));
    }

    #[test]
    fn batches_judge_every_field_once_and_find_nothing_wrong_at_their_seams() {
        let summary = run(5000, |_, colour| colour);
        assert_eq!((summary.fields, summary.lit, summary.findings_in_all), (5000, 5000, 0));
    }

    #[test]
    fn one_wrong_colour_among_thousands_is_found() {
        let summary =
            run(5000, |index, colour| if index == 2500 { Colour::ALL[(colour.index() + 1) % 3] } else { colour });
        assert!(summary.unsafe_findings >= 1);
        assert!(!summary.findings.is_empty());
    }
}
