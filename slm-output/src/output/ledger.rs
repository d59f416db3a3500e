//! What was on the panel, with what its lasers did.

use std::collections::VecDeque;

use holod_calibration::{Colour, TimeNs};
use rtrb::Producer;

use super::shared::{Shared, count};
use crate::laser::verify::FieldSpan;
use crate::laser::{BoxEvent, DarkReason, LaserEdge, LitWindow};
use crate::present::TimestampSource;
use crate::schedule::{FieldGate, ShownField};

/// Fields that wait for their edges, and edges that wait for their fields.
const OPEN_MAX: usize = 256;

/// One colour field that was on the panel, with what its laser did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldEvent {
    /// Number of the frame whose pattern it shows.
    pub frame_id: u64,
    /// Position in the panel's field order.
    pub field: usize,
    /// The colour of its pattern and of its laser.
    pub colour: Colour,
    /// When the frame was submitted.
    pub t_submit: TimeNs,
    /// When the frame was to come on the panel.
    pub t_desired_present: TimeNs,
    /// When the field came on the panel.
    pub t_present: TimeNs,
    /// When it may first be lit.
    pub t_settled: TimeNs,
    /// When it made way for the next one.
    pub t_end: TimeNs,
    /// Where `t_present` comes from.
    pub timestamp_source: TimestampSource,
    /// The on edge of its laser, if it was lit and the box tells edges.
    pub laser_on: Option<TimeNs>,
    /// The off edge of its laser, likewise.
    pub laser_off: Option<TimeNs>,
    /// Why it was not lit, or must not have been. Neither this nor an edge: a laser that is simply on while its box is
    /// armed, of which single fields are not known.
    pub dark: Option<DarkReason>,
    /// The frame had been shown before: no newer one was there in time.
    pub repeated: bool,
    /// The frame came a refresh or more later than it was made for. Repetitions are not counted again.
    pub deadline_missed: bool,
}

impl FieldEvent {
    /// The field as [`crate::laser::verify::verify_edges`] wants it.
    pub fn span(&self) -> FieldSpan {
        FieldSpan {
            frame_id: self.frame_id,
            field: self.field,
            colour: self.colour,
            t_present: self.t_present,
            t_settled: self.t_settled,
            t_end: self.t_end,
            dark: self.dark,
        }
    }
}

/// A time in which the box was not armed, and why.
#[derive(Clone, Copy, Debug)]
struct Darkness {
    t_dark: TimeNs,
    t_armed: Option<TimeNs>,
    reason: DarkReason,
}

impl Darkness {
    fn touches(&self, window: &LitWindow) -> bool {
        self.t_dark < window.t_off && self.t_armed.is_none_or(|t_armed| t_armed > window.t_on)
    }
}

/// Puts fields and laser edges together.
pub(super) struct Ledger {
    gate: FieldGate,
    /// Whether the box lights single fields, and tells when.
    gates_fields: bool,
    open: VecDeque<(ShownField, Option<DarkReason>)>,
    edges: VecDeque<LaserEdge>,
    darknesses: VecDeque<Darkness>,
    events: Producer<FieldEvent>,
    box_events: Producer<BoxEvent>,
}

impl Ledger {
    pub(super) fn new(
        gate: FieldGate,
        gates_fields: bool,
        events: Producer<FieldEvent>,
        box_events: Producer<BoxEvent>,
    ) -> Self {
        let open = VecDeque::with_capacity(OPEN_MAX);
        let edges = VecDeque::with_capacity(OPEN_MAX);
        let darknesses = VecDeque::with_capacity(OPEN_MAX);
        Self { gate, gates_fields, open, edges, darknesses, events, box_events }
    }

    pub(super) fn field(&mut self, field: &ShownField, dark: Option<DarkReason>, shared: &Shared) {
        if field.frame.is_none() {
            return;
        }
        count(&shared.fields);
        if field.repeated {
            count(&shared.repeated);
        }
        if self.open.len() == OPEN_MAX {
            count(&shared.lost);
        } else {
            self.open.push_back((*field, dark));
        }
    }

    pub(super) fn box_event(&mut self, event: BoxEvent, shared: &Shared) {
        match event {
            BoxEvent::Edge(edge) => {
                if self.edges.len() == OPEN_MAX {
                    self.edges.pop_front();
                }
                self.edges.push_back(edge);
            }
            BoxEvent::Dark { t, reason } => {
                if self.darknesses.len() == OPEN_MAX {
                    self.darknesses.pop_front();
                }
                self.darknesses.push_back(Darkness { t_dark: t, t_armed: None, reason });
            }
            BoxEvent::Armed { t } => {
                if let Some(last) = self.darknesses.back_mut() {
                    last.t_armed.get_or_insert(t);
                }
            }
        }
        if self.box_events.push(event).is_err() {
            count(&shared.lost);
        }
    }

    /// The box heard of a field's window when it had gone by.
    pub(super) fn came_late(&mut self, window: &LitWindow) {
        let Self { open, gate, .. } = self;
        let is_its = |field: &ShownField| {
            field.colour == window.colour && (field.t_present..gate.t_end(field)).contains(&window.t_on)
        };
        if let Some((_, dark)) = open.iter_mut().find(|(field, _)| is_its(field)) {
            dark.get_or_insert(DarkReason::Late);
        }
    }

    /// Publishes the fields that are over at `now`, when all their edges are known.
    pub(super) fn flush(&mut self, now: TimeNs, shared: &Shared) {
        while let Some((field, dark)) = self.open.front().copied().filter(|(field, _)| self.gate.t_end(field) <= now) {
            self.open.pop_front();
            let event = self.event(&field, dark);
            if event.laser_on.is_none() && event.dark.is_some() {
                count(&shared.dark_fields);
            }
            if self.events.push(event).is_err() {
                count(&shared.lost);
            }
        }
    }

    /// Fields and edges that wait.
    #[cfg(test)]
    pub(super) fn waiting(&self) -> usize {
        self.open.len() + self.edges.len()
    }

    fn event(&self, field: &ShownField, dark: Option<DarkReason>) -> FieldEvent {
        let tag = field.frame.unwrap_or_default();
        let t_end = self.gate.t_end(field);
        let own = |edge: &&LaserEdge| edge.colour == field.colour;
        let on = self.edges.iter().filter(own).find(|edge| edge.on && edge.t >= field.t_present && edge.t < t_end);
        let off =
            on.and_then(|on| self.edges.iter().filter(own).find(|edge| !edge.on && edge.t >= on.t && edge.t <= t_end));
        let timing = self.gate.timing();
        let t_frame = TimeNs(field.t_present.0 - field.field as i64 * timing.field_period.0);
        let late_ns = t_frame.0 - tag.t_desired_present.0;
        FieldEvent {
            frame_id: tag.frame_id,
            field: field.field,
            colour: field.colour,
            t_submit: tag.t_submit,
            t_desired_present: tag.t_desired_present,
            t_present: field.t_present,
            t_settled: field.t_present + self.gate.settle(),
            t_end,
            timestamp_source: field.timestamp_source,
            laser_on: on.map(|edge| edge.t),
            laser_off: off.map(|edge| edge.t),
            dark: match (on, dark) {
                (Some(_), reason) => reason.filter(|reason| reason.forbids_light()),
                (None, reason) if !self.gates_fields => reason,
                (None, reason) => reason.or_else(|| self.why_box_was_dark(field)).or(Some(DarkReason::Late)),
            },
            repeated: field.repeated,
            deadline_missed: !field.repeated && late_ns > timing.frame_period.0 / 2,
        }
    }

    /// Why the box could not light the whole window of `field`, where it could not.
    fn why_box_was_dark(&self, field: &ShownField) -> Option<DarkReason> {
        let window = self.gate.window(field);
        self.darknesses.iter().rev().find(|darkness| darkness.touches(&window)).map(|darkness| darkness.reason)
    }
}
