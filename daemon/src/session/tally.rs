//! Counts frames, fields and latencies while a run goes on, from what the frame loop and the output report.

use std::collections::{HashMap, VecDeque};

use holod_calibration::{PupilDiameter, TimeNs};
use holod_slm_output::{FieldEvent, LevelsFrame};

use super::frame_loop::{LoopRecord, RECORDS};
use super::ledger::LaserLedger;
use super::recorded_levels::KEEP_SLOTS;
use super::stats::Recent;
use super::summary::ShownLevels;
use crate::frame_record::FrameRecord;
use crate::frame_state::FrameState;
use crate::observer::FirstLight;

/// Frames whose fields may still come: all that the ring of records can hold at once, and some more.
const REMEMBERED: usize = RECORDS + 64;

/// Running numbers of a run.
#[derive(Default)]
pub(super) struct Tally {
    recent: VecDeque<LoopRecord>,
    kept: [Option<FrameRecord>; KEEP_SLOTS],
    pub(super) lasers: LaserLedger,
    pub(super) frames_made: u64,
    pub(super) frames_computed: u64,
    pub(super) frames_shown: u64,
    pub(super) fields_shown: u64,
    pub(super) fields_repeated: u64,
    pub(super) deadline_misses: u64,
    newest_made: u64,
    newest_shown: u64,
    newest_lit: u64,
    pub(super) newest_state: Option<FrameState>,
    pub(super) frame_time: Recent,
    pub(super) sample_to_photon: Recent,
    pub(super) picture_to_photon: Recent,
    newest_picture: Option<TimeNs>,
    t_picture_in_hand: Option<TimeNs>,
    t_shown_begun: Option<TimeNs>,
    pub(super) by_state: HashMap<FrameState, u64>,
    pub(super) pupil_range_mm: Option<[f32; 2]>,
    pub(super) beyond_trained: u64,
    pub(super) clipped_share_max: f32,
    pub(super) unreachable_share_max: f32,
}

impl Tally {
    /// A frame was made.
    pub(super) fn frame(&mut self, record: &LoopRecord) {
        let frame = &record.frame;
        self.frames_made += 1;
        self.newest_made = frame.frame;
        self.newest_state = Some(frame.pupil_state);
        *self.by_state.entry(frame.pupil_state).or_default() += 1;
        if frame.is_computed {
            self.frames_computed += 1;
            self.frame_time.push((frame.t_submit - frame.t_wake).seconds() as f32 * 1e3);
        }
        let pupil_mm = frame.pupil.mm();
        self.beyond_trained += u64::from(record.beyond_trained);
        let [narrowest, widest] = self.pupil_range_mm.unwrap_or([pupil_mm; 2]);
        self.pupil_range_mm = Some([narrowest.min(pupil_mm), widest.max(pupil_mm)]);
        self.clipped_share_max = self.clipped_share_max.max(record.clipped_share);
        self.unreachable_share_max = self.unreachable_share_max.max(record.unreachable_share);
        if self.recent.len() == REMEMBERED {
            self.recent.pop_front();
        }
        self.recent.push_back(*record);
    }

    /// A field was shown and is over. What its light is the first of.
    pub(super) fn field(&mut self, event: &FieldEvent) -> Option<FirstLight> {
        self.lasers.field(event);
        self.fields_shown += 1;
        self.fields_repeated += u64::from(event.repeated);
        if event.repeated {
            return None;
        }
        let is_new = event.frame_id != self.newest_shown;
        if is_new {
            self.newest_shown = event.frame_id;
            self.frames_shown += 1;
            self.deadline_misses += u64::from(event.deadline_missed);
        }
        let record = self.recent.iter().find(|record| record.frame.frame == event.frame_id)?;
        let frame = &record.frame;
        if is_new {
            self.t_picture_in_hand = record.t_picture_in_hand;
            self.t_shown_begun = Some(frame.t_wake);
            if let Some(slot) = frame.keep {
                self.kept[slot] = Some(*frame);
            }
        }
        // Its first fields may have stayed dark.
        if event.frame_id == self.newest_lit {
            return None;
        }
        let (on, off) = event.laser_on.zip(event.laser_off)?;
        self.newest_lit = event.frame_id;
        let t = TimeNs(on.0 / 2 + off.0 / 2);
        // A picture that is shown for another pupil is no newer for that.
        let new_picture = frame.picture.t_taken.filter(|_| self.newest_picture != frame.picture.t_taken);
        self.newest_picture = new_picture.or(self.newest_picture);
        let light = FirstLight {
            frame: frame.frame,
            t,
            // What is there already comes sooner than what follows a sample.
            sample_to_photon: frame.t_sample.filter(|_| frame.is_computed).map(|t_sample| t - t_sample),
            picture_to_photon: new_picture.filter(|_| frame.picture.is_live()).map(|t_taken| t - t_taken),
        };
        let milliseconds = |time: TimeNs| time.seconds() as f32 * 1e3;
        self.sample_to_photon.extend(light.sample_to_photon.map(milliseconds));
        self.picture_to_photon.extend(light.picture_to_photon.map(milliseconds));
        Some(light)
    }

    /// When the feed's picture was taken over that the frame loop had in hand for what the panel shows.
    pub(super) const fn t_picture_in_hand(&self) -> Option<TimeNs> {
        self.t_picture_in_hand
    }

    /// When the frame was begun that the panel shows.
    pub(super) const fn t_shown_begun(&self) -> Option<TimeNs> {
        self.t_shown_begun
    }

    /// The pupil that the newest frame was made for.
    pub(super) fn newest_pupil(&self) -> Option<PupilDiameter> {
        self.recent.back().map(|record| record.frame.pupil)
    }

    /// Whether the newest frame has come on the panel.
    pub(super) fn newest_frame_shown(&self) -> bool {
        self.newest_shown == self.newest_made
    }

    /// Levels that were kept, with what their frame was made for.
    pub(super) fn shown_levels(&self, levels: LevelsFrame) -> Option<ShownLevels> {
        let frame = self.kept.iter().flatten().find(|kept| kept.frame == levels.tag().frame_id)?;
        Some(ShownLevels { pupil: frame.pupil, amplitude_constant: frame.amplitude_constant, levels })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::{LIVE_WITHIN, PictureTag};
    use holod_calibration::Colour;
    use holod_slm_output::TimestampSource;
    use holod_slm_output::laser::DarkReason;

    fn record(frame: u64) -> LoopRecord {
        let pupil = PupilDiameter::from_mm(3.0);
        let frame = FrameRecord { t_sample: Some(TimeNs(1_000)), ..FrameRecord::of_pupil(frame, pupil) };
        LoopRecord { frame, t_picture_in_hand: None, beyond_trained: false, clipped_share: 0.0, unreachable_share: 0.0 }
    }

    fn field(frame_id: u64, field: usize, is_lit: bool) -> FieldEvent {
        let t_present = TimeNs(frame_id as i64 * 30_000 + field as i64 * 10_000);
        FieldEvent {
            frame_id,
            field,
            colour: Colour::ALL[field],
            t_submit: TimeNs(0),
            t_desired_present: TimeNs(0),
            t_present,
            t_settled: t_present,
            t_end: t_present + TimeNs(10_000),
            timestamp_source: TimestampSource::Software,
            laser_on: is_lit.then_some(t_present + TimeNs(2_000)),
            laser_off: is_lit.then_some(t_present + TimeNs(8_000)),
            dark: (!is_lit).then_some(DarkReason::Late),
            repeated: false,
            deadline_missed: false,
        }
    }

    #[test]
    fn a_frames_first_light_is_its_first_lit_fields_and_is_told_once() {
        let mut tally = Tally::default();
        let mut first_light = |frame, lit: [bool; 3]| {
            tally.frame(&record(frame));
            [0, 1, 2].map(|index| tally.field(&field(frame, index, lit[index])).map(|light| light.t.0))
        };
        assert_eq!(first_light(1, [true; 3]), [Some(35_000), None, None]);
        assert_eq!(first_light(2, [false, true, true]), [None, Some(75_000), None]);
        assert_eq!(first_light(3, [false; 3]), [None; 3]);
        assert_eq!((tally.frames_shown, tally.fields_shown), (3, 9));
    }

    #[test]
    fn a_picture_that_was_old_when_it_came_counts_for_no_latency() {
        let mut tally = Tally::default();
        let mut latency = |frame: u64, age: TimeNs| {
            let t_came = TimeNs(60_000_000_000 + frame as i64);
            let mut record = record(frame);
            record.frame.picture =
                PictureTag { t_taken: Some(t_came - age), t_came: Some(t_came), ..PictureTag::default() };
            tally.frame(&record);
            tally.field(&field(frame, 0, true)).unwrap().picture_to_photon.is_some()
        };
        assert_eq!([1, 2].map(|frame| latency(frame, LIVE_WITHIN)), [true; 2]);
        assert!(!latency(3, LIVE_WITHIN + TimeNs(1)));
        assert!(latency(4, TimeNs(0)));
    }
}
