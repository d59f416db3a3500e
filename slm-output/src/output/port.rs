//! The frame thread's end of the output.

use holod_calibration::TimeNs;
use rtrb::Consumer;

use crate::fields::{FrameTag, LevelsFrame};
use crate::pacing::{FramePlan, Pacer};
use crate::present::{FrameSink, TimestampSource};

/// What the panel did at the start of a colour frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PresentReport {
    /// Number of the frame that is shown.
    pub frame_id: u64,
    /// Host time of the display's refresh with its first field; it is on the panel a latency later.
    pub t_present: TimeNs,
    /// Where `t_present` comes from.
    pub timestamp_source: TimestampSource,
    /// The frame had been shown before.
    pub repeated: bool,
}

/// The frame thread's end of the output.
#[derive(Debug)]
pub struct FramePort {
    pub(super) sink: FrameSink,
    pub(super) reports: Consumer<PresentReport>,
}

impl FramePort {
    /// The buffer of the next frame, with the levels of some older one in it. Wait-free.
    pub fn acquire(&mut self) -> &mut LevelsFrame {
        self.sink.acquire()
    }

    /// Hands the acquired frame to the panel, which shows it from its next colour frame on unless a newer one comes
    /// before. With `keep`, the panel stores the levels in that slot when they have come on the panel, over what was
    /// there; they are in the [`ShutdownReport`](super::ShutdownReport). Wait-free.
    pub fn submit(&mut self, plan: &FramePlan, keep: Option<usize>, now: TimeNs) {
        self.sink.submit(FrameTag {
            frame_id: plan.frame_id,
            t_submit: now,
            t_desired_present: plan.t_desired_present,
            keep,
        });
    }

    /// Gives `pacer` what the panel has reported since the last call, and calls `report` for each report.
    pub fn feed(&mut self, pacer: &mut Pacer, mut report: impl FnMut(PresentReport)) {
        while let Ok(presented) = self.reports.pop() {
            if presented.repeated {
                pacer.observe_refresh(presented.t_present, presented.timestamp_source);
            } else {
                pacer.report(presented.frame_id, presented.t_present, presented.timestamp_source);
            }
            report(presented);
        }
    }
}
