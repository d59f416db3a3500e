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
    /// The newest of the numbers that came again and rose since the last new one, and how many they are.
    again: Option<(u64, u32)>,
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
    /// A number that has come before, as of a datagram that a network has doubled.
    Repeat,
    /// The count went backwards: the tracker restarted or its counter wrapped.
    Restart,
}

/// Of so many numbers before the last one it is known whether they have come.
const REMEMBERED: u64 = 127;
/// So many numbers in a row that rise, all of which have come before, are a new count of a tracker that had just begun;
/// a network doubles fewer at once.
const RESTART_RISES: u32 = 5;
/// A longer leap of the running number is a new count, not a loss: an hour at 1 kHz.
const LONGEST_GAP: u64 = 3_600_000;

impl SequenceTracker {
    /// A tracker that has seen no number.
    pub(crate) const fn new() -> Self {
        Self { last: None, missing: 0, late: None, again: None }
    }

    /// Takes the next sample's number.
    pub(crate) fn next(&mut self, sequence: u64, eye: SampleEye) -> SequenceEvent {
        let Some((last, last_eye)) = self.last else {
            self.last = Some((sequence, eye));
            return SequenceEvent::InOrder;
        };
        if let Some(back @ 0..=REMEMBERED) = last.checked_sub(sequence) {
            if back == 0 && eye != last_eye {
                self.last = Some((sequence, eye));
                return SequenceEvent::InOrder;
            }
            return self.not_new(sequence, eye, back);
        }
        self.last = Some((sequence, eye));
        self.again = None;
        match sequence.checked_sub(last) {
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

    /// A number `back` before the last one: one that was missing, or one that comes again.
    fn not_new(&mut self, sequence: u64, eye: SampleEye, back: u64) -> SequenceEvent {
        if self.late.is_some_and(|(number, other)| number == sequence && other != eye) {
            return SequenceEvent::InOrder;
        }
        let is_missing = |place: u64| self.missing >> place & 1 == 1;
        if let Some(place) = back.checked_sub(1).filter(|place| is_missing(*place)) {
            let beside = i8::from(place > 0 && is_missing(place - 1)) + i8::from(is_missing(place + 1));
            self.missing &= !(1 << place);
            self.late = Some((sequence, eye));
            return SequenceEvent::Overtaken { gaps: beside - 1 };
        }
        let rises = match self.again {
            Some((newest, rises)) if sequence == newest => rises,
            Some((newest, rises)) if sequence > newest => rises + 1,
            _ => 1,
        };
        if rises < RESTART_RISES {
            self.again = Some((sequence, rises));
            return SequenceEvent::Repeat;
        }
        *self = Self { last: Some((sequence, eye)), ..Self::new() };
        SequenceEvent::Restart
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sequence_gaps_repeats_and_restarts_are_told_apart() {
        let mut tracker = SequenceTracker::default();
        let mut next = |sequence, eye| tracker.next(sequence, eye);
        assert_eq!(next(205, SampleEye::Left), SequenceEvent::InOrder);
        assert_eq!(next(205, SampleEye::Right), SequenceEvent::InOrder);
        assert_eq!(next(206, SampleEye::Left), SequenceEvent::InOrder);
        assert_eq!(next(206, SampleEye::Left), SequenceEvent::Repeat);
        assert_eq!(next(210, SampleEye::Left), SequenceEvent::Gap(3));
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
    }

    #[test]
    fn numbers_that_come_again_are_neither_restarts_nor_losses() {
        assert_eq!(counts([1, 2, 3, 2, 4]), (0, 0, 0));
        assert_eq!(counts((1..=10).chain([8, 11, 12])), (0, 0, 0));
        // A copy of each some numbers later, of four at once, again and again, and beside a loss.
        assert_eq!(counts((10..200).flat_map(|number| [number, number - 3])), (0, 0, 0));
        assert_eq!(counts((10..200).flat_map(|number| [number].into_iter().chain(number - 4..number))), (0, 0, 0));
        assert_eq!(counts((1..=10).chain([8; 40]).chain([11])), (0, 0, 0));
        assert_eq!(counts([1, 2, 5, 2, 1, 6]), (1, 2, 0));
        // As far back as is remembered, and further.
        assert_eq!(counts((1..=200).chain([200 - REMEMBERED, 201])), (0, 0, 0));
        assert_eq!(counts((1..=200).chain([199 - REMEMBERED])), (0, 0, 1));
    }

    #[test]
    fn a_tracker_that_begins_anew_soon_is_found() {
        for begins in [0, 1] {
            for numbers in [8, 20, 128, 129, 1000] {
                let anew = |ends: u64| counts((1..=numbers).chain(begins..ends));
                assert_eq!(anew(begins + u64::from(RESTART_RISES)), (0, 0, 1), "{numbers} from {begins}");
                assert_eq!(anew(3 * numbers), (0, 0, 1), "{numbers} from {begins}");
            }
        }
        // What was missing before is not afterwards, and losses after it count.
        assert_eq!(counts((10..=20).chain([25]).chain(0..8).chain([9, 10])), (2, 5, 1));
    }
}
