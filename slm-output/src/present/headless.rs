//! A virtual panel: a perfect refresh clock, no glass.

use holod_calibration::TimeNs;

use super::{FrameSource, PanelTiming, PresentedField, Presenter, Provenance};
use crate::fields::{FIELDS, FrameTag, LevelsFrame};

/// Colour frames that a late tick reports after the fact.
const CATCH_UP_FRAMES: i64 = 16;

/// A panel whose refreshes lie at exact multiples of its period and which shows, field after field, what a panel in
/// its place would show.
///
/// A pure state machine: time comes in through [`Presenter::tick`], so tests drive it with any clock. A tick that comes
/// late reports the fields that have gone by with the times at which they began, since nothing stops a panel from
/// going on with the pattern that it has (after a stall of more than 16 colour frames, only the last 16 of them);
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
        while self.t_next <= now {
            if self.next_field == 0 {
                self.skip_unseen(now);
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
