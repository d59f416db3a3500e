//! What the output's threads share: orders, acknowledgements and counters, all of them atomic.

use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU8, AtomicU64, Ordering};

use holod_calibration::TimeNs;

use crate::laser::DarkReason;

/// How long the control of the output may not be heard of before lasers are kept dark. It does not wait for so long.
const UNATTENDED_AFTER: TimeNs = TimeNs(5_000_000_000);

/// Counters of the output's threads.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OutputCounts {
    /// Colour fields of frames that came on the panel.
    pub fields: u64,
    /// Of those, fields of a frame that had been shown before.
    pub repeated: u64,
    /// Fields that were not lit.
    pub dark_fields: u64,
    /// Windows of which the laser box heard too late for their beginning, and that it lit in part.
    pub lit_in_part: u64,
    /// Times that the lasers went dark while they were armed.
    pub went_dark: u64,
    /// Commands that the laser box failed or refused.
    pub box_faults: u64,
    /// Reports and events lost because nobody read them.
    pub lost: u64,
    /// Refreshes a second, as the panel reports them; 0 until it has.
    pub refresh_hz: f64,
    /// Whether the panel is lost.
    pub panel_lost: bool,
    /// Whether lasers may be lit now.
    pub armed: bool,
}

pub(super) const NOT_YET: u8 = 0;
pub(super) const DARK: u8 = 1;
pub(super) const FAILED: u8 = 2;

/// What the threads share.
#[derive(Debug, Default)]
pub(super) struct Shared {
    /// 0, or 1 + the index of the reason for which lasers are dark for good.
    pub(super) latch: AtomicU8,
    /// What the box said to that.
    pub(super) acknowledged: AtomicU8,
    /// A request for darkness, or to take it back ([`dark_request_parts`]), with the wishes for darkness that the
    /// control of the output has not taken over.
    pub(super) dark_request: AtomicU64,
    /// The number of the request that has been obeyed, and the box's answer in the two lowest bits.
    pub(super) dark_answer: AtomicU64,
    /// When the control of the output was last there; 0 until it has first said so.
    pub(super) t_attended_ns: AtomicI64,
    /// Panics whose messages have not been written yet.
    pub(super) panics: AtomicU64,
    pub(super) flat_wanted: AtomicBool,
    pub(super) flat_shown: AtomicBool,
    pub(super) stop: AtomicBool,
    pub(super) armed: AtomicBool,
    /// The panel is lost, or never came back.
    pub(super) panel_lost: AtomicBool,
    /// Refreshes that the panel reports, thousandths a second.
    pub(super) refresh_millihz: AtomicU64,
    pub(super) fields: AtomicU64,
    pub(super) repeated: AtomicU64,
    pub(super) dark_fields: AtomicU64,
    pub(super) lit_in_part: AtomicU64,
    pub(super) went_dark: AtomicU64,
    pub(super) box_faults: AtomicU64,
    pub(super) lost: AtomicU64,
}

impl Shared {
    pub(super) fn counts(&self) -> OutputCounts {
        let get = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        OutputCounts {
            fields: get(&self.fields),
            repeated: get(&self.repeated),
            dark_fields: get(&self.dark_fields),
            lit_in_part: get(&self.lit_in_part),
            went_dark: get(&self.went_dark),
            box_faults: get(&self.box_faults),
            lost: get(&self.lost),
            refresh_hz: get(&self.refresh_millihz) as f64 / 1e3,
            panel_lost: self.panel_lost.load(Ordering::Relaxed),
            armed: self.armed.load(Ordering::Relaxed),
        }
    }

    /// Whether signals and limits that ask for darkness find somebody who obeys them, where anybody ever did.
    pub(super) fn is_attended(&self, now: TimeNs) -> bool {
        let t_attended_ns = self.t_attended_ns.load(Ordering::Acquire);
        t_attended_ns == 0 || now.0 - t_attended_ns <= UNATTENDED_AFTER.0
    }

    pub(super) fn latched(&self) -> Option<DarkReason> {
        reason_of(self.latch.load(Ordering::Acquire))
    }
}

/// 1 + the reason's index, or 0.
pub(super) fn code_of(reason: Option<DarkReason>) -> u8 {
    let index = |reason| DarkReason::ALL.iter().position(|&known| known == reason);
    reason.and_then(index).map_or(0, |index| 1 + index as u8)
}

fn reason_of(code: u8) -> Option<DarkReason> {
    DarkReason::ALL.get(usize::from(code).wrapping_sub(1)).copied()
}

/// In a request for darkness: from one number to the next, and one wish more. Below them is why, as [`code_of`].
pub(super) const NEXT: u64 = 1 << 32;
pub(super) const WISH: u64 = 1 << 8;

/// A request as it was, but for the reason.
pub(super) fn dark_because(request: u64, why: Option<DarkReason>) -> u64 {
    request & !(WISH - 1) | u64::from(code_of(why))
}

/// The number of a request, and why it asks for darkness, where it does: a person's wish comes first.
pub(super) fn dark_request_parts(request: u64) -> (u64, Option<DarkReason>) {
    let has_wishes = request % NEXT >= WISH;
    (request / NEXT, if has_wishes { Some(DarkReason::Asked) } else { reason_of(request as u8) })
}

pub(super) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}
