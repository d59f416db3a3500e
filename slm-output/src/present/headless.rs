//! A virtual panel: a perfect refresh clock, no glass.

use holod_calibration::TimeNs;

use super::{FrameSource, PanelTiming, PresentedField, Presenter, Provenance};
use crate::fields::{FIELDS, FrameTag, LevelsFrame};

/// Colour frames that a late tick reports after the fact, of the first and of the last ones that went by.
const CATCH_UP_FRAMES: i64 = 8;

/// A panel whose refreshes lie at exact multiples of its period and which shows, field after field, what a panel in
/// its place would show.
///
/// A pure state machine: time comes in through [`Presenter::tick`], so tests drive it with any clock. A tick that comes
/// late reports the fields that have gone by with the times at which they began, since nothing stops a panel from
/// going on with the pattern that it has (after a long stall, only the first and the last eight colour frames of it);
/// a frame is never shown at a refresh before which it was not yet submitted.
#[derive(Debug)]
pub struct HeadlessPanel {
    timing: PanelTiming,
    t_next: TimeNs,
    next_field: usize,
    /// The levels on the panel, and the frame that they are; `None` while they are the flat pattern.
    shown: LevelsFrame,
    frame: Option<FrameTag>,
    repeated: bool,
    /// The flat pattern until it is wanted, afterwards the last frame shown before it.
    flat_or_last: LevelsFrame,
    flat_wanted: bool,
    flat_shown: bool,
    /// The source's current frame waits for the refresh after its submission.
    waiting: bool,
    kept: Vec<Option<LevelsFrame>>,
    spare: Vec<LevelsFrame>,
}

impl HeadlessPanel {
    /// A panel that shows `flat` and begins its first colour frame at `t_first`. It can keep the levels of
    /// `keep_slots` frames, for which memory is taken now.
    pub fn new(timing: PanelTiming, flat: LevelsFrame, t_first: TimeNs, keep_slots: usize) -> Self {
        Self {
            timing,
            t_next: t_first,
            next_field: 0,
            shown: flat.clone(),
            frame: None,
            repeated: false,
            spare: vec![flat.clone(); keep_slots],
            kept: vec![None; keep_slots],
            flat_or_last: flat,
            flat_wanted: false,
            flat_shown: false,
            waiting: false,
        }
    }

    /// At a colour frame's start, puts what is newest on the panel.
    fn latch(&mut self, t_refresh: TimeNs, frames: &mut FrameSource) {
        if self.flat_wanted {
            if self.frame.take().is_some() {
                // The flat pattern is wanted once and for good: its buffer goes on to hold the last frame.
                std::mem::swap(&mut self.shown, &mut self.flat_or_last);
                self.flat_shown = true;
            }
            return;
        }
        self.repeated = self.frame.is_some();
        self.waiting |= frames.update();
        if !self.waiting || frames.current_mut().tag().t_submit > t_refresh {
            return;
        }
        std::mem::swap(&mut self.shown, frames.current_mut());
        self.waiting = false;
        self.repeated = false;
        self.frame = Some(self.shown.tag());
        self.keep_shown();
    }

    /// Leaves out whole colour frames that went by too long ago for anybody to want to know.
    fn skip_unseen(&mut self, now: TimeNs) {
        let behind = (now.0 - self.t_next.0) / self.timing.frame_period.0;
        let skipped = (behind - CATCH_UP_FRAMES).max(0);
        self.t_next = TimeNs(self.t_next.0 + skipped * self.timing.frame_period.0);
    }

    fn keep_shown(&mut self) {
        let Some(slot) = self.shown.tag().keep.and_then(|slot| self.kept.get_mut(slot)) else { return };
        if let Some(mut buffer) = slot.take().or_else(|| self.spare.pop()) {
            buffer.copy_from(&self.shown);
            *slot = Some(buffer);
        }
    }
}

impl Presenter for HeadlessPanel {
    fn timing(&self) -> PanelTiming {
        self.timing
    }

    fn is_virtual(&self) -> bool {
        true
    }

    fn t_next(&self) -> TimeNs {
        self.t_next
    }

    fn tick(&mut self, now: TimeNs, frames: &mut FrameSource, presented: &mut dyn FnMut(PresentedField)) {
        let mut frames_begun = 0;
        while self.t_next <= now {
            if self.next_field == 0 {
                frames_begun += 1;
                if frames_begun == CATCH_UP_FRAMES {
                    self.skip_unseen(now);
                }
                self.latch(self.t_next, frames);
            }
            presented(PresentedField {
                frame: self.frame,
                field: self.next_field,
                colour: self.shown.layout().field_order[self.next_field],
                t_present: self.t_next,
                provenance: Provenance::Software,
                repeated: self.repeated && self.frame.is_some(),
            });
            self.next_field = (self.next_field + 1) % FIELDS;
            self.t_next = self.t_next + self.timing.field_period;
        }
    }

    fn show_flat(&mut self) {
        self.flat_wanted = true;
    }

    fn last_frame(&self) -> Option<&LevelsFrame> {
        if self.flat_shown { Some(&self.flat_or_last) } else { self.frame.map(|_| &self.shown) }
    }

    fn take_kept(&mut self) -> Vec<Option<LevelsFrame>> {
        std::mem::take(&mut self.kept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::FrameLayout;
    use crate::present::{FrameSink, frame_channel};
    use holod_calibration::rig::PanelMode;
    use holod_calibration::{Colour, Resolution};

    const FIELD: i64 = 1000;
    const FRAME: i64 = 3 * FIELD;

    struct Bench {
        panel: HeadlessPanel,
        sink: FrameSink,
        source: FrameSource,
    }

    impl Bench {
        /// The first colour frame begins at time 0.
        fn new(keep_slots: usize) -> Self {
            let layout = FrameLayout {
                resolution: Resolution { width: 2, height: 1 },
                mode: PanelMode::ChannelPacked,
                field_order: [Colour::Green, Colour::Red, Colour::Blue],
            };
            let flat = LevelsFrame::new(layout);
            let (sink, source) = frame_channel(&flat);
            let timing = PanelTiming { field_period: TimeNs(FIELD), frame_period: TimeNs(FRAME) };
            Self { panel: HeadlessPanel::new(timing, flat, TimeNs(0), keep_slots), sink, source }
        }

        fn submit(&mut self, frame_id: u64, t_submit: i64, keep: Option<usize>) {
            for colour in Colour::ALL {
                self.sink.acquire().field_mut(colour).write(&[frame_id as u16; 2]);
            }
            let t_submit = TimeNs(t_submit);
            self.sink.submit(FrameTag { frame_id, t_submit, t_desired_present: t_submit, keep });
        }

        fn tick(&mut self, now: i64) -> Vec<PresentedField> {
            let mut fields = Vec::new();
            self.panel.tick(TimeNs(now), &mut self.source, &mut |field| fields.push(field));
            fields
        }

        /// (frame, time, repeated) of what comes on the panel up to `now`.
        fn shown(&mut self, now: i64) -> Vec<(Option<u64>, i64, bool)> {
            let row = |field: &PresentedField| (field.frame.map(|tag| tag.frame_id), field.t_present.0, field.repeated);
            self.tick(now).iter().map(row).collect()
        }

        fn levels(&self) -> Option<u16> {
            self.panel.last_frame().map(|frame| frame.samples()[0])
        }
    }

    #[test]
    fn fields_come_in_the_panels_order_one_period_apart() {
        let mut bench = Bench::new(0);
        bench.submit(1, -5, None);
        let fields = bench.tick(2 * FIELD);
        assert_eq!(
            fields.iter().map(|field| field.colour).collect::<Vec<_>>(),
            [Colour::Green, Colour::Red, Colour::Blue]
        );
        assert_eq!(fields.iter().map(|field| field.field).collect::<Vec<_>>(), [0, 1, 2]);
        assert_eq!(fields.iter().map(|field| field.t_present.0).collect::<Vec<_>>(), [0, FIELD, 2 * FIELD]);
        assert_eq!(bench.panel.t_next(), TimeNs(FRAME));
        assert_eq!(bench.tick(FRAME - 1), []);
    }

    #[test]
    fn the_newest_frame_is_taken_and_the_old_one_stays_when_nothing_came() {
        let mut bench = Bench::new(0);
        assert_eq!(bench.shown(0), [(None, 0, false)]);
        assert_eq!(bench.levels(), None);
        bench.submit(1, 10, None);
        bench.submit(2, 20, None);
        // Nothing changes within a colour frame.
        assert_eq!(bench.shown(2 * FIELD), [(None, FIELD, false), (None, 2 * FIELD, false)]);
        assert_eq!(bench.shown(FRAME), [(Some(2), FRAME, false)]);
        assert_eq!(bench.levels(), Some(2));
        bench.tick(2 * FRAME - 1);
        assert_eq!(bench.shown(2 * FRAME), [(Some(2), 2 * FRAME, true)]);
        assert_eq!(bench.levels(), Some(2));
        bench.submit(3, 2 * FRAME + 1, None);
        bench.tick(3 * FRAME - 1);
        assert_eq!(bench.shown(3 * FRAME), [(Some(3), 3 * FRAME, false)]);
        assert_eq!(bench.levels(), Some(3));
    }

    #[test]
    fn a_late_tick_shows_no_frame_before_it_was_submitted() {
        let mut bench = Bench::new(0);
        bench.submit(1, -5, None);
        bench.tick(0);
        bench.submit(2, FRAME + 400, None);
        let shown = bench.shown(2 * FRAME);
        let starts: Vec<_> = shown.iter().filter(|row| row.1 % FRAME == 0).collect();
        assert_eq!(starts, [&(Some(1), FRAME, true), &(Some(2), 2 * FRAME, false)]);
        assert_eq!(bench.levels(), Some(2));
    }

    #[test]
    fn a_long_stall_is_reported_for_its_two_ends() {
        let mut bench = Bench::new(0);
        bench.submit(1, -5, None);
        bench.tick(0);
        let fields = bench.tick(1_000_000 * FRAME);
        assert!(fields.len() <= 3 * (2 * CATCH_UP_FRAMES as usize + 2), "{}", fields.len());
        let seen = |t: i64| fields.iter().any(|field| field.t_present == TimeNs(t));
        assert!((1..CATCH_UP_FRAMES - 1).all(|frame| seen(frame * FRAME) && seen((1_000_000 - frame) * FRAME)));
        assert_eq!(fields.last().unwrap().t_present, TimeNs(1_000_000 * FRAME));
        assert!(fields.iter().all(|field| field.colour == bench.panel.shown.layout().field_order[field.field]));
    }

    #[test]
    fn kept_levels_are_those_that_were_shown() {
        let mut bench = Bench::new(2);
        bench.submit(1, -5, Some(0));
        bench.tick(0);
        // Frame 2 is replaced before it is shown, so it is not kept.
        bench.submit(2, 10, Some(1));
        bench.submit(3, 20, Some(0));
        bench.tick(FRAME);
        bench.submit(4, FRAME + 1, Some(9));
        bench.tick(2 * FRAME);
        let kept = bench.panel.take_kept();
        let kept: Vec<_> =
            kept.iter().map(|frame| frame.as_ref().map(|frame| (frame.tag().frame_id, frame.samples()[3]))).collect();
        assert_eq!(kept, [Some((3, 3)), None]);
    }

    #[test]
    fn the_flat_pattern_comes_at_the_next_frame_and_stays() {
        let mut bench = Bench::new(0);
        bench.submit(1, -5, None);
        bench.tick(0);
        bench.panel.show_flat();
        bench.submit(2, 10, None);
        assert_eq!(bench.shown(2 * FIELD), [(Some(1), FIELD, false), (Some(1), 2 * FIELD, false)]);
        assert_eq!(bench.shown(FRAME), [(None, FRAME, false)]);
        bench.tick(2 * FRAME - 1);
        assert_eq!(bench.shown(2 * FRAME), [(None, 2 * FRAME, false)]);
        assert_eq!(bench.panel.shown.samples(), [0; 6]);
        assert_eq!(bench.levels(), Some(1), "the last frame can still be looked at");
    }
}
