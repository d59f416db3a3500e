//! The thread of the panel.

use std::os::fd::{AsFd, OwnedFd};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::Thread;

use holod_calibration::TimeNs;
use rtrb::Producer;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::port::PresentReport;
use super::shared::{Shared, count};
use super::{Clock, SLEEP_MAX};
use crate::fields::LevelsFrame;
use crate::present::{FrameSource, PanelFault, PresentedRefresh, Presenter, Recorder};

/// How often a lost panel is tried again.
const RECOVER_EVERY: TimeNs = TimeNs(250_000_000);

/// From the panel's thread to the lasers'.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PanelNews {
    /// A refresh came on the panel, or will after the panel's latency.
    Refresh(PresentedRefresh),
    /// The panel is lost.
    Lost,
}

/// What happened to the panel, for whoever tells people.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum PanelEvent {
    /// It was lost, and is tried again where the fault is recoverable.
    Lost { t: TimeNs, fault: PanelFault },
    /// It shows frames again, after a loss that was told.
    Back { t: TimeNs },
}

pub(super) struct PanelThread {
    pub(super) panel: Recorder,
    pub(super) frames: FrameSource,
    pub(super) news: Producer<PanelNews>,
    pub(super) reports: Producer<PresentReport>,
    pub(super) events: Producer<PanelEvent>,
    pub(super) laser: Thread,
    /// Rung when there is an order for this thread.
    pub(super) doorbell: Arc<OwnedFd>,
    pub(super) shared: Arc<Shared>,
    /// From a refresh that the display reports to the panel's update with it.
    pub(super) latency: TimeNs,
    pub(super) clock: Clock,
}

impl PanelThread {
    /// Runs until it is told to stop and closes the panel; the levels that were kept.
    pub(super) fn run(mut self) -> Vec<Option<LevelsFrame>> {
        let mut lost = None;
        while !self.shared.stop.load(Ordering::Acquire) {
            if self.shared.flat_wanted.load(Ordering::Acquire) {
                self.panel.show_flat();
            }
            lost = match lost {
                None => self.tick().err().map(|fault| self.lose(fault)),
                Some(lost) => self.recover(lost),
            };
            let t_next = lost.map_or_else(|| self.panel.t_next(), |lost: Lost| lost.t_retry);
            self.sleep_until(t_next, lost.is_none());
        }
        // The panel is closed in this thread: a display server that hangs may keep it from that.
        self.panel.into_kept()
    }

    fn tick(&mut self) -> Result<(), PanelFault> {
        let Self { panel, frames, news, reports, laser, shared, latency, clock, .. } = self;
        let flat_wanted = shared.flat_wanted.load(Ordering::Acquire);
        panel.tick(clock(), frames, &mut |refresh| {
            if news.push(PanelNews::Refresh(refresh.shown_after(*latency))).is_err() {
                count(&shared.lost);
            }
            let report = refresh.frame.filter(|_| refresh.field == 0).map(|frame| PresentReport {
                frame_id: frame.frame_id,
                t_present: refresh.t_present,
                timestamp_source: refresh.timestamp_source,
                repeated: refresh.repeated,
            });
            if report.is_some_and(|report| reports.push(report).is_err()) {
                count(&shared.lost);
            }
            if flat_wanted && refresh.frame.is_none() {
                shared.flat_shown.store(true, Ordering::Release);
            }
            laser.unpark();
        })
    }

    fn lose(&mut self, fault: PanelFault) -> Lost {
        self.shared.panel_lost.store(true, Ordering::Release);
        if self.news.push(PanelNews::Lost).is_err() {
            count(&self.shared.lost);
        }
        self.laser.unpark();
        let now = (self.clock)();
        self.tell(PanelEvent::Lost { t: now, fault });
        Lost { fault, t_retry: now + RECOVER_EVERY }
    }

    /// Tries to get the panel back; what is left of the loss.
    fn recover(&mut self, lost: Lost) -> Option<Lost> {
        let now = (self.clock)();
        if !lost.fault.is_recoverable() || now < lost.t_retry {
            let t_retry = if lost.fault.is_recoverable() { lost.t_retry } else { now + RECOVER_EVERY };
            return Some(Lost { t_retry, ..lost });
        }
        match self.panel.recover(now) {
            Ok(()) => {
                self.shared.panel_lost.store(false, Ordering::Release);
                self.tell(PanelEvent::Back { t: now });
                None
            }
            Err(fault) => {
                if fault != lost.fault {
                    self.tell(PanelEvent::Lost { t: now, fault });
                }
                Some(Lost { fault, t_retry: now + RECOVER_EVERY })
            }
        }
    }

    fn tell(&mut self, event: PanelEvent) {
        if self.events.push(event).is_err() {
            count(&self.shared.lost);
        }
    }

    /// Sleeps until `t`, an order, or, where the panel is there, its own event.
    fn sleep_until(&self, t: TimeNs, panel_there: bool) {
        let rest_ns = (t - (self.clock)()).min(SLEEP_MAX).0.max(0);
        let timeout = Timespec { tv_sec: rest_ns / 1_000_000_000, tv_nsec: rest_ns % 1_000_000_000 };
        let doorbell = PollFd::from_borrowed_fd(self.doorbell.as_fd(), PollFlags::IN);
        // An interrupted wait is a short one.
        let _woken = match self.panel.wake_fd().filter(|_| panel_there) {
            Some(panel) => {
                poll(&mut [doorbell, PollFd::from_borrowed_fd(panel, PollFlags::IN)], Some(&timeout)).unwrap_or(0)
            }
            None => poll(&mut [doorbell], Some(&timeout)).unwrap_or(0),
        };
        let mut rings = [0; 8];
        let _nobody_rang = rustix::io::read(&self.doorbell, &mut rings);
    }
}

#[derive(Clone, Copy)]
struct Lost {
    fault: PanelFault,
    t_retry: TimeNs,
}

/// Wakes the panel's thread.
pub(super) fn ring(doorbell: &OwnedFd) {
    // A counter that is full has woken it already.
    let _full = rustix::io::write(doorbell, &1u64.to_ne_bytes());
}
