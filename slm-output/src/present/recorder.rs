//! Keeps levels that a panel showed.

use std::os::fd::BorrowedFd;

use holod_calibration::TimeNs;

use super::drm::DisplayCheck;
use super::look::LookedAt;
use super::{FrameSource, PanelFault, PresentedRefresh, Presenter};
use crate::fields::{FrameTag, LevelsFrame};

/// Any presenter, with memory for the levels that it showed: each frame whose [`FrameTag::keep`] names a slot is copied
/// there when it comes on the panel, over what was there; and so is one for each [`PanelLook`](super::PanelLook).
pub struct Recorder {
    panel: Box<dyn Presenter>,
    looked_at: Option<LookedAt>,
    kept: Vec<Option<LevelsFrame>>,
    spare: Vec<LevelsFrame>,
}

impl Recorder {
    /// Wraps `panel`. Memory for `slots` frames like `blank` is taken now.
    pub fn new(panel: Box<dyn Presenter>, blank: &LevelsFrame, slots: usize) -> Self {
        Self { panel, looked_at: None, kept: vec![None; slots], spare: vec![blank.clone(); slots] }
    }

    /// The same, where somebody may look at what is shown.
    pub(crate) fn looked_at(self, looked_at: Option<LookedAt>) -> Self {
        Self { looked_at, ..self }
    }

    /// The levels that were shown and kept, by slot.
    pub fn into_kept(self) -> Vec<Option<LevelsFrame>> {
        self.kept
    }

    fn keep(&mut self, tag: FrameTag) {
        let looked_at = self.looked_at.as_mut().filter(|looked_at| looked_at.is_wanted());
        let slot = tag.keep.and_then(|slot| self.kept.get_mut(slot));
        if looked_at.is_none() && slot.is_none() {
            return;
        }
        // A presenter that has gone on to a later frame since cannot say any more what this one was.
        let Some(shown) = self.panel.shown().filter(|shown| shown.tag().frame_id == tag.frame_id) else { return };
        if let Some(looked_at) = looked_at {
            looked_at.show(shown);
        }
        let Some(slot) = slot else { return };
        if let Some(mut buffer) = slot.take().or_else(|| self.spare.pop()) {
            buffer.copy_from(shown);
            *slot = Some(buffer);
        }
    }
}

impl Presenter for Recorder {
    fn is_virtual(&self) -> bool {
        self.panel.is_virtual()
    }

    fn wake_fd(&self) -> Option<BorrowedFd<'_>> {
        self.panel.wake_fd()
    }

    fn t_next(&self) -> TimeNs {
        self.panel.t_next()
    }

    fn tick(
        &mut self,
        now: TimeNs,
        frames: &mut FrameSource,
        presented: &mut dyn FnMut(PresentedRefresh),
    ) -> Result<(), PanelFault> {
        let mut newest = None;
        let ticked = self.panel.tick(now, frames, &mut |refresh| {
            newest = refresh.frame.filter(|_| !refresh.repeated).or(newest);
            presented(refresh);
        });
        if let Some(tag) = newest {
            self.keep(tag);
        }
        ticked
    }

    fn show_flat(&mut self) {
        self.panel.show_flat();
    }

    fn recover(&mut self, now: TimeNs) -> Result<(), PanelFault> {
        self.panel.recover(now)
    }

    fn checks(&self) -> &[DisplayCheck] {
        self.panel.checks()
    }

    fn shown(&self) -> Option<&LevelsFrame> {
        self.panel.shown()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::FrameLayout;
    use crate::present::{HeadlessPanel, PanelLook, PanelSetup, ReportFaults, frame_channel};
    use holod_calibration::rig::Rig;
    use holod_calibration::{Colour, Resolution};

    #[test]
    fn a_look_sees_the_next_new_frame_once() {
        let panel = Rig::default().panel;
        let blank = LevelsFrame::new(FrameLayout::new(&panel, Resolution { width: 2, height: 1 }));
        let (mut sink, mut source) = frame_channel(&blank);
        let setup = PanelSetup { panel, flat: blank.clone() };
        let headless = HeadlessPanel::new(&setup, TimeNs(0), ReportFaults::NONE);
        let (looked_at, mut look) = crate::present::look(&blank);
        let mut recorder = Recorder::new(Box::new(headless), &blank, 0).looked_at(Some(looked_at));
        let mut show = |frame_id: Option<u64>| {
            if let Some(frame_id) = frame_id {
                sink.acquire().field_mut(Colour::Red).write(&[frame_id as u16; 2]);
                let t_submit = recorder.t_next() - TimeNs(1);
                sink.submit(FrameTag { frame_id, t_submit, t_desired_present: t_submit, keep: None });
            }
            recorder.tick(recorder.t_next(), &mut source, &mut |_| {}).unwrap();
        };
        let seen = |look: &mut PanelLook| look.take().map(|frame| (frame.tag().frame_id, frame.samples()[3]));
        show(Some(1));
        assert_eq!(seen(&mut look), None, "nobody asked");
        look.ask();
        show(None);
        assert_eq!(seen(&mut look), None, "a frame that is shown again is none that comes on");
        show(Some(2));
        show(Some(3));
        assert_eq!(seen(&mut look), Some((2, 2)));
        assert_eq!(seen(&mut look), None, "it was taken");
        look.ask();
        show(Some(4));
        assert_eq!(seen(&mut look), Some((4, 4)));
    }

    #[test]
    fn kept_levels_are_those_that_were_shown() {
        let panel = Rig::default().panel;
        let blank = LevelsFrame::new(FrameLayout::new(&panel, Resolution { width: 2, height: 1 }));
        let (mut sink, mut source) = frame_channel(&blank);
        let setup = PanelSetup { panel, flat: blank.clone() };
        let headless = HeadlessPanel::new(&setup, TimeNs(0), ReportFaults::NONE);
        let mut recorder = Recorder::new(Box::new(headless), &blank, 2);
        let mut show = |submitted: &[(u64, usize)]| {
            for &(frame_id, slot) in submitted {
                sink.acquire().field_mut(Colour::Red).write(&[frame_id as u16; 2]);
                let t_submit = recorder.t_next() - TimeNs(1);
                sink.submit(FrameTag { frame_id, t_submit, t_desired_present: t_submit, keep: Some(slot) });
            }
            recorder.tick(recorder.t_next(), &mut source, &mut |_| {}).unwrap();
        };
        show(&[(1, 0)]);
        // Frame 2 is replaced before it is shown, so it is not kept.
        show(&[(2, 1), (3, 0)]);
        show(&[(4, 9)]);
        show(&[]);
        let kept = recorder.into_kept();
        let kept: Vec<_> =
            kept.iter().map(|frame| frame.as_ref().map(|frame| (frame.tag().frame_id, frame.samples()[3]))).collect();
        assert_eq!(kept, [Some((3, 3)), None]);
    }
}
