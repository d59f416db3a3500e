//! The parts of a log whose clock begins anew: each is put behind the one before it, on one clock.
//!
//! Eyes may run free of each other, and one may be told after all of the other, so that each falls for itself.

use crate::SampleEye;
use crate::clock::RESTART;

/// What a part is put behind the one before it.
const BETWEEN_NS: i64 = 1_000_000_000;

/// The clock of a log, and how far each eye has come on it.
#[derive(Debug)]
pub(super) struct Parts {
    parts: Vec<Part>,
    eyes: [Eye; 3],
}

#[derive(Debug)]
struct Part {
    /// Added to its times as they are written.
    shift_ns: i64,
    /// The line in which it begins, from 1.
    line: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Eye {
    part: usize,
    /// With its part's shift.
    latest_ns: Option<i64>,
}

impl Default for Parts {
    fn default() -> Self {
        Self { parts: vec![Part { shift_ns: 0, line: 1 }], eyes: [Eye::default(); 3] }
    }
}

/// Whether a clock that stood at `latest_ns` and says `t_ns` has begun anew.
pub(super) const fn is_restart(latest_ns: i64, t_ns: i64) -> bool {
    t_ns < latest_ns.saturating_sub(RESTART.0)
}

impl Parts {
    /// A time as it is written, on the log's one clock; None where it falls so far that the clock may have begun anew.
    pub(super) fn follow(&mut self, t_ns: i64, eye: SampleEye) -> Option<i64> {
        let newest = self.newest();
        if self.eyes[eye.index()].latest_ns.is_none() && self.is_in_step(t_ns, newest) {
            self.eyes[eye.index()].part = newest;
        }
        let Eye { part, latest_ns } = self.eyes[eye.index()];
        let t_ns = self.shifted(t_ns, part);
        (!latest_ns.is_some_and(|latest_ns| is_restart(latest_ns, t_ns))).then_some(t_ns)
    }

    /// Takes a time that [`Self::follow`] gave for the eye's latest; false where it lies before it.
    pub(super) fn advance(&mut self, t_ns: i64, eye: SampleEye) -> bool {
        let latest_ns = &mut self.eyes[eye.index()].latest_ns;
        let is_forward = latest_ns.is_none_or(|latest_ns| t_ns >= latest_ns);
        if is_forward {
            *latest_ns = Some(t_ns);
        }
        is_forward
    }

    /// Leads an eye into the part to which its samples from `first_ns` (in `line`) to `last_ns` belong: one that
    /// another eye is in already, or a new one.
    pub(super) fn enter(&mut self, first_ns: i64, last_ns: i64, line: u64, eye: SampleEye) {
        let Eye { part, latest_ns } = self.eyes[eye.index()];
        let newest = self.newest();
        let next = if self.is_in_step(last_ns, newest) { newest } else { part + 1 };
        let is_behind = |next| latest_ns.is_none_or(|latest_ns| self.shifted(first_ns, next) > latest_ns);
        let joins = next > part && next <= newest && is_behind(next);
        self.eyes[eye.index()].part = if joins { next } else { self.begin(first_ns, line) };
    }

    /// The log says itself that a recording begins at `t_ns`: where that lies before the latest time, it is a new part.
    pub(super) fn begins_at(&mut self, t_ns: i64, line: u64) {
        if self.latest_ns().is_some_and(|latest_ns| self.shifted(t_ns, self.newest()) < latest_ns) {
            let part = self.begin(t_ns, line);
            self.eyes.iter_mut().for_each(|eye| eye.part = part);
        }
    }

    fn begin(&mut self, t_ns: i64, line: u64) -> usize {
        let shift_ns =
            self.latest_ns().map_or(0, |latest_ns| latest_ns.saturating_add(BETWEEN_NS).saturating_sub(t_ns));
        self.parts.push(Part { shift_ns, line });
        self.newest()
    }

    /// A time of the newest part.
    pub(super) fn in_newest(&self, t_ns: i64) -> i64 {
        self.shifted(t_ns, self.newest())
    }

    /// Whether this time, as it is written, may be one of a part that has not been entered yet.
    pub(super) fn may_be_later(&self, t_ns: i64) -> bool {
        self.latest_ns().is_some_and(|latest_ns| is_restart(latest_ns, self.in_newest(t_ns)))
    }

    /// The lines in which the clock begins anew.
    pub(super) fn restarts(&self) -> impl ExactSizeIterator<Item = u64> {
        self.parts[1..].iter().map(|part| part.line)
    }

    fn newest(&self) -> usize {
        self.parts.len() - 1
    }

    fn shifted(&self, t_ns: i64, part: usize) -> i64 {
        t_ns.saturating_add(self.parts[part].shift_ns)
    }

    fn latest_ns(&self) -> Option<i64> {
        self.eyes.iter().filter_map(|eye| eye.latest_ns).max()
    }

    /// Whether eyes that are in this part are at about this time now.
    fn is_in_step(&self, t_ns: i64, part: usize) -> bool {
        let here = self.eyes.iter().filter(|eye| eye.part == part).filter_map(|eye| eye.latest_ns).max();
        here.is_some_and(|here| here.abs_diff(self.shifted(t_ns, part)) <= RESTART.0.unsigned_abs())
    }
}
