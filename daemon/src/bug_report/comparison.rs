//! What came of the frames of a report that were made again, beside what the report says of them.

use std::collections::{BTreeMap, HashMap};

use holod_calibration::Colour;
use holod_slm_output::FieldEvent;
use serde::Serialize;

use super::recorded::RecordedFrame;
use crate::failure::Failure;
use crate::frame_record::FrameRecord;
use crate::record::{RunFacts, hash_text};
use crate::session::{Cue, Observer};

/// Differences that are told one by one.
const TOLD: usize = 10;

/// Compares frames as they are made again with those of a report.
pub struct Comparison {
    /// By their numbers: those that are made again and have not come yet.
    awaited: HashMap<u64, u64>,
    fields: HashMap<u64, Vec<(u8, Colour)>>,
    shown: HashMap<u64, Vec<(u8, Colour)>>,
    outcome: Outcome,
}

/// How the frames of a report came out.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Outcome {
    /// Frames that the report has.
    pub frames_recorded: u64,
    /// Frames whose levels are the same to the byte.
    pub frames_same: u64,
    /// Frames whose levels are others.
    pub frames_different: u64,
    /// The numbers of the first of those.
    pub first_different: Vec<u64>,
    /// Frames that were not reached before the end.
    pub frames_not_reached: u64,
    /// Frames that cannot be made again, by the reason.
    pub frames_not_shown_again: BTreeMap<String, u64>,
    /// Frames that were shown with the same colour fields in the same order.
    pub fields_same: u64,
    /// Frames that were shown with others.
    pub fields_different: u64,
    /// The numbers of the first of those.
    pub first_fields_different: Vec<u64>,
    /// The holod and the engine that made them first.
    pub made_by: [String; 2],
    /// The holod and the engine that made them again.
    pub made_again_by: [String; 2],
}

impl Comparison {
    pub(super) fn new(
        frames: Vec<RecordedFrame>,
        cues: &[Cue],
        not_again: BTreeMap<String, u64>,
        facts: &RunFacts,
    ) -> Self {
        let is_cued = |frame: u64| cues.binary_search_by_key(&frame, |cue| cue.frame).is_ok();
        let outcome = Outcome {
            frames_recorded: frames.len() as u64,
            frames_not_shown_again: not_again,
            made_by: [facts.holod.clone(), facts.engine.clone()],
            ..Outcome::default()
        };
        let (mut awaited, mut fields) = (HashMap::new(), HashMap::new());
        for frame in frames.into_iter().filter(|frame| is_cued(frame.frame)) {
            awaited.extend(frame.made.map(|made| (frame.frame, made.levels_xxh3)));
            fields.insert(frame.frame, frame.fields);
        }
        Self { awaited, fields, shown: HashMap::new(), outcome }
    }

    /// What has come out, of a run with this engine.
    pub fn finish(mut self, engine: &str) -> Outcome {
        self.outcome.frames_not_reached = self.awaited.len() as u64;
        self.outcome.made_again_by = [env!("HOLOD_VERSION").into(), engine.to_owned()];
        let mut shown: Vec<_> = self.shown.into_iter().collect();
        shown.sort_unstable_by_key(|(frame, _)| *frame);
        // A run that ends in the middle of a frame has shown some of its fields.
        let cut_off = [shown.last().map(|(frame, _)| *frame), self.fields.keys().max().copied()];
        for (frame, shown) in shown {
            let Some(recorded) = self.fields.get(&frame) else { continue };
            let is_cut = cut_off.contains(&Some(frame)) && !shown.is_empty() && !recorded.is_empty();
            let same = shown == *recorded || is_cut && (shown.starts_with(recorded) || recorded.starts_with(&shown));
            if same {
                self.outcome.fields_same += 1;
            } else {
                self.outcome.fields_different += 1;
                note(&mut self.outcome.first_fields_different, frame);
            }
        }
        self.outcome
    }
}

fn note(told: &mut Vec<u64>, frame: u64) {
    if told.len() < TOLD {
        told.push(frame);
    }
}

impl Observer for Comparison {
    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        let Some(expected) = self.awaited.remove(&record.frame) else { return Ok(()) };
        // A frame without a hash is not the same.
        let found = record.levels_xxh3;
        if found == Some(expected) {
            self.outcome.frames_same += 1;
            return Ok(());
        }
        self.outcome.frames_different += 1;
        if self.outcome.first_different.len() < TOLD {
            let (frame, pupil_mm) = (record.frame, record.pupil.mm());
            let (expected, found) = (hash_text(expected), found.map_or("none".into(), hash_text));
            tracing::warn!(
                "frame {frame}, for a pupil of {pupil_mm} mm, has other levels: {found}, recorded {expected}"
            );
        }
        note(&mut self.outcome.first_different, record.frame);
        Ok(())
    }

    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        if !event.repeated {
            let shown = self.shown.entry(event.frame_id).or_default();
            let field = event.field as u8;
            if shown.iter().all(|(known, _)| *known != field) {
                shown.push((field, event.colour));
            }
        }
        Ok(())
    }
}

impl Outcome {
    /// Whether anything is another one.
    pub const fn differs(&self) -> bool {
        self.frames_different + self.fields_different > 0
    }

    /// A few lines for people.
    pub fn text(&self) -> String {
        let not_again: u64 = self.frames_not_shown_again.values().sum();
        let first = |frames: &[u64]| {
            let numbers: Vec<_> = frames.iter().map(u64::to_string).collect();
            if numbers.is_empty() { String::new() } else { format!(" (first: {})", numbers.join(", ")) }
        };
        let mut text = format!(
            "report    {} frames: {} the same to the byte, {} different{}, {not_again} not shown again, {} not reached",
            self.frames_recorded,
            self.frames_same,
            self.frames_different,
            first(&self.first_different),
            self.frames_not_reached,
        );
        for (why, count) in &self.frames_not_shown_again {
            text.push_str(&format!("\n          {count} not shown again: {why}"));
        }
        text.push_str(&format!(
            "\n          fields: of {} frames in the same order and colours, of {} in others{}",
            self.fields_same,
            self.fields_different,
            first(&self.first_fields_different)
        ));
        let [[holod, engine], [holod_now, engine_now]] = [&self.made_by, &self.made_again_by];
        // Why it is not a GPU may follow.
        let same_engine = engine.starts_with(engine_now.as_str()) || engine_now.starts_with(engine.as_str());
        if holod != holod_now || !same_engine {
            let hint = if self.differs() { ": another version or engine may round in another way" } else { "" };
            text.push_str(&format!(
                "\n          made by holod {holod}, {engine}; made again by holod {holod_now}, {engine_now}{hint}"
            ));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::{PupilDiameter, TimeNs};
    use holod_pupil_input::PupilState;
    use holod_slm_output::TimestampSource;

    use super::*;
    use crate::bug_report::recorded::Made;
    use crate::cli::Backend;
    use crate::frame_record::FrameOrders;
    use crate::frame_state::FrameState;
    use crate::record::SceneSource;

    const COLOURS: [(u8, Colour); 3] = [(0, Colour::Green), (1, Colour::Red), (2, Colour::Blue)];

    fn made(levels_xxh3: u64) -> Made {
        Made {
            pupil: PupilDiameter::from_mm(3.0),
            pupil_state: FrameState::Estimated(PupilState::Tracking),
            t_wake: TimeNs(1),
            picture: 0,
            is_live: false,
            orders: FrameOrders::default(),
            levels_xxh3,
        }
    }

    fn comparison() -> Comparison {
        let frame = |frame| RecordedFrame { frame, made: Some(made(100 + frame)), fields: COLOURS.to_vec() };
        let frames: Vec<_> = [2, 3, 5].map(frame).into();
        let cue = |recorded: &RecordedFrame| Cue {
            frame: recorded.frame,
            pupil: PupilDiameter::from_mm(3.0),
            pupil_state: FrameState::Estimated(PupilState::Tracking),
            picture: 0,
            number: 0,
            engine: 0,
            pattern: None,
            orders: FrameOrders::default(),
        };
        let cues: Vec<_> = frames.iter().map(cue).collect();
        let facts = RunFacts {
            holod: env!("HOLOD_VERSION").into(),
            started_unix_ms: 0,
            t_origin_ns: 0,
            scene: SceneSource::BuiltIn,
            hologram: [64, 64],
            tracker: String::new(),
            scale_mm_per_unit: None,
            panel: String::new(),
            backend: Backend::Auto,
            engine: "cpu, 2 threads, as there is no GPU".into(),
            machine: crate::machine::Machine::default(),
        };
        Comparison::new(frames, &cues, BTreeMap::from([("a reason".to_owned(), 4)]), &facts)
    }

    fn record(frame: u64, levels_xxh3: Option<u64>) -> FrameRecord {
        FrameRecord { levels_xxh3, ..FrameRecord::of_pupil(frame, PupilDiameter::from_mm(3.0)) }
    }

    fn field(frame_id: u64, (field, colour): (u8, Colour)) -> FieldEvent {
        FieldEvent {
            frame_id,
            field: field.into(),
            colour,
            t_submit: TimeNs(0),
            t_desired_present: TimeNs(0),
            t_present: TimeNs(1),
            t_settled: TimeNs(2),
            t_end: TimeNs(3),
            timestamp_source: TimestampSource::Software,
            laser_on: None,
            laser_off: None,
            dark: None,
            repeated: false,
            deadline_missed: false,
        }
    }

    fn outcome(frames: &[(u64, Option<u64>)], fields: &[(u64, (u8, Colour))]) -> Outcome {
        let mut comparison = comparison();
        for (frame, hash) in frames {
            comparison.frame(&record(*frame, *hash)).unwrap();
        }
        for (frame, shown) in fields {
            comparison.field(&field(*frame, *shown)).unwrap();
        }
        comparison.finish("cpu, 2 threads")
    }

    #[test]
    fn frames_that_are_the_same_are_counted_and_no_others() {
        let fields: Vec<_> = [2, 3].into_iter().flat_map(|frame| COLOURS.map(|shown| (frame, shown))).collect();
        let same = outcome(&[(2, Some(102)), (3, Some(103))], &fields);
        assert_eq!((same.frames_same, same.frames_different, same.frames_not_reached), (2, 0, 1));
        assert_eq!((same.fields_same, same.fields_different, same.differs()), (2, 0, false));
        assert!(!same.text().contains("made again by"), "why it is no GPU makes no other engine: {}", same.text());
        assert!(same.text().contains("4 not shown again: a reason"));

        let one = outcome(&[(2, Some(102)), (3, Some(104)), (9, Some(1))], &[]);
        assert_eq!((one.frames_same, one.frames_different, one.first_different), (1, 1, vec![3]));
        let unknown = outcome(&[(2, None)], &[]);
        assert_eq!((unknown.frames_same, unknown.frames_different), (0, 1));
    }

    #[test]
    fn fields_in_another_order_or_colour_are_found() {
        let [green, red, blue] = COLOURS;
        let differs = |fields: [(u8, Colour); 3]| outcome(&[], &fields.map(|shown| (5, shown))).first_fields_different;
        assert_eq!(differs([green, red, blue]), [0_u64; 0]);
        assert_eq!(differs([green, blue, red]), [5]);
        assert_eq!(differs([green, red, (2, Colour::Red)]), [5]);
        let cut_off = outcome(&[], &[(5, green), (5, red)]);
        assert_eq!((cut_off.fields_same, cut_off.fields_different), (1, 0));
        let nothing_in_common = outcome(&[], &[(5, (7, Colour::Red))]);
        assert_eq!((nothing_in_common.fields_same, nothing_in_common.fields_different), (0, 1));
    }
}
