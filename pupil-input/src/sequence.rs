//! What running numbers say about lost samples.

use crate::SampleEye;

/// What a sequence of running numbers says about lost lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SequenceTracker {
    last: Option<(u64, SampleEye)>,
    /// Numbers before the last one that have not come: bit 0 is the one right before it.
    missing: u128,
    /// The number that came late last, with its eye.
    late: Option<(u64, SampleEye)>,
}

/// What one running number tells after those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SequenceEvent {
    /// The next one, the first one, or the other eye of the same instant.
    InOrder,
    /// This many numbers are missing.
    Gap(u64),
    /// A number that was missing has come after others, as datagrams may.
    Overtaken {
        /// By how much the gaps that there are have grown; a gap is filled, cut short or parted.
        gaps: i8,
    },
    /// The same number of the same eye again.
    Repeat,
    /// The count went backwards: the tracker restarted or its counter wrapped.
    Restart,
}

/// A longer leap of the running number is a new count, not a loss: an hour at 1 kHz.
const LONGEST_GAP: u64 = 3_600_000;

impl SequenceTracker {
    /// A tracker that has seen no number.
    pub(crate) const fn new() -> Self {
        Self { last: None, missing: 0, late: None }
    }

    /// Takes the next sample's number.
    pub(crate) fn next(&mut self, sequence: u64, eye: SampleEye) -> SequenceEvent {
        if let Some((last, _)) = self.last
            && let Some(back) = last.checked_sub(sequence)
            && let Some(event) = self.overtaken(sequence, eye, back)
        {
            return event;
        }
        let Some((last, last_eye)) = self.last.replace((sequence, eye)) else {
            return SequenceEvent::InOrder;
        };
        match sequence.checked_sub(last) {
            Some(0) if eye == last_eye => SequenceEvent::Repeat,
            Some(0) => SequenceEvent::InOrder,
            Some(step @ 1..=LONGEST_GAP) => {
                let passed = u32::try_from(step).ok();
                let shifted = |bits: u128| passed.and_then(|step| bits.checked_shl(step)).unwrap_or(0);
                // All between the two, and nothing at the place of the former last one.
                let between = shifted(1).wrapping_sub(1) >> 1;
                self.missing = shifted(self.missing) | between;
                if step == 1 { SequenceEvent::InOrder } else { SequenceEvent::Gap(step - 1) }
            }
            _ => {
                (self.missing, self.late) = (0, None);
                SequenceEvent::Restart
            }
        }
    }

    /// A number `back` before the last one, if it was missing.
    fn overtaken(&mut self, sequence: u64, eye: SampleEye, back: u64) -> Option<SequenceEvent> {
        if self.late.is_some_and(|(number, other)| number == sequence && other != eye) {
            return Some(SequenceEvent::InOrder);
        }
        let place = u32::try_from(back.checked_sub(1)?).ok()?;
        let is_missing = |place: u32| self.missing.checked_shr(place).is_some_and(|bits| bits & 1 == 1);
        if !is_missing(place) {
            return None;
        }
        let beside = i8::from(place > 0 && is_missing(place - 1)) + i8::from(is_missing(place + 1));
        self.missing &= !(1 << place);
        self.late = Some((sequence, eye));
        Some(SequenceEvent::Overtaken { gaps: beside - 1 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sequence_gaps_repeats_and_restarts_are_told_apart() {
        let mut tracker = SequenceTracker::default();
        let mut next = |sequence, eye| tracker.next(sequence, eye);
        assert_eq!(next(5, SampleEye::Left), SequenceEvent::InOrder);
        assert_eq!(next(5, SampleEye::Right), SequenceEvent::InOrder);
        assert_eq!(next(6, SampleEye::Left), SequenceEvent::InOrder);
        assert_eq!(next(6, SampleEye::Left), SequenceEvent::Repeat);
        assert_eq!(next(10, SampleEye::Left), SequenceEvent::Gap(3));
        assert_eq!(next(0, SampleEye::Left), SequenceEvent::Restart);
        // What came before the restart is not missing after it.
        assert_eq!(next(3, SampleEye::Left), SequenceEvent::Gap(2));
        assert_eq!(next(9_000_000, SampleEye::Left), SequenceEvent::Restart);
        assert_eq!(next(1, SampleEye::Left), SequenceEvent::Restart);
    }

    /// Gaps, numbers missing and restarts after `numbers`.
    fn counts(numbers: impl IntoIterator<Item = u64>) -> (i64, i64, i64) {
        let mut tracker = SequenceTracker::default();
        let (mut gaps, mut missing, mut restarts) = (0, 0, 0);
        for (number, eye) in numbers.into_iter().flat_map(|n| [(n, SampleEye::Left), (n, SampleEye::Right)]) {
            match tracker.next(number, eye) {
                SequenceEvent::Gap(count) => (gaps, missing) = (gaps + 1, missing + count as i64),
                SequenceEvent::Overtaken { gaps: more } => (gaps, missing) = (gaps + i64::from(more), missing - 1),
                SequenceEvent::Restart => restarts += 1,
                SequenceEvent::InOrder | SequenceEvent::Repeat => {}
            }
        }
        (gaps, missing, restarts)
    }

    #[test]
    fn numbers_that_are_overtaken_are_not_missing() {
        assert_eq!(counts([1, 2, 4, 3, 5, 7, 6, 8]), (0, 0, 0));
        // Of a gap of five the middle one comes, then its neighbours; two stay lost.
        assert_eq!(counts([1, 7, 4]), (2, 4, 0));
        assert_eq!(counts([1, 7, 4, 3]), (2, 3, 0));
        assert_eq!(counts([1, 7, 4, 3, 5, 8]), (2, 2, 0));
        // Far back, across a gap that is wider than is remembered, and what was never missing.
        assert_eq!(counts([1, 3].into_iter().chain(4..130).chain([2])), (0, 0, 0));
        assert_eq!(counts([1, 3].into_iter().chain(4..132).chain([2])), (1, 1, 1));
        assert_eq!(counts([1, 200, 72]), (1, 198, 1));
        assert_eq!(counts([1, 200, 74]), (2, 197, 0));
        assert_eq!(counts([1, 2, 3, 2]), (0, 0, 1));
    }
}
