//! What running numbers say about lost samples.

use crate::SampleEye;

/// What a sequence of running numbers says about lost lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SequenceTracker {
    /// The newest number that has come.
    last: Option<u64>,
    /// The numbers that have come of each eye: bit 0 is the newest one, bit 1 the one right before it.
    came: [u128; 3],
    /// The numbers before it that have not come, of any eye.
    missing: u128,
    /// The newest of the numbers that came again and rose since the last new one, and how many they are.
    again: Option<(u64, u32)>,
}

/// What one running number tells after those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SequenceEvent {
    /// The next one, the first one, or the other eye of an instant.
    InOrder,
    /// This many numbers are missing.
    Gap(u64),
    /// A number that was missing has come after others, as datagrams may.
    Overtaken {
        /// By how much the gaps that there are have grown; a gap is filled, cut short or parted.
        gaps: i8,
    },
    /// A number that has come before with its eye, as of a datagram that a network has doubled.
    Repeat,
    /// The count went backwards: the tracker restarted or its counter wrapped.
    Restart,
}

/// For how many numbers before the last one it is known whether they have come.
const REMEMBERED: u64 = 127;
/// This many numbers in a row that rise, all of which have come before, are a new count of a tracker that had just
/// begun; a network doubles fewer at once.
const RESTART_RISES: u32 = 5;
/// A longer leap of the running number is a new count, not a loss: an hour at 1 kHz.
const LONGEST_GAP: u64 = 3_600_000;

impl SequenceTracker {
    /// A tracker that has seen no number.
    pub(crate) const fn new() -> Self {
        Self { last: None, came: [0; 3], missing: 0, again: None }
    }

    /// One that has seen this alone.
    fn beginning_with(sequence: u64, eye: SampleEye) -> Self {
        let mut begun = Self { last: Some(sequence), ..Self::new() };
        begun.came[eye.index()] = 1;
        begun
    }

    /// Takes the next sample's number.
    pub(crate) fn next(&mut self, sequence: u64, eye: SampleEye) -> SequenceEvent {
        let Some(last) = self.last else {
            *self = Self::beginning_with(sequence, eye);
            return SequenceEvent::InOrder;
        };
        if let Some(back @ 0..=REMEMBERED) = last.checked_sub(sequence) {
            return self.not_new(sequence, eye, back);
        }
        match sequence.checked_sub(last) {
            Some(step @ 1..=LONGEST_GAP) => {
                let shifted = |bits: u128| bits.checked_shl(step as u32).unwrap_or(0);
                // All between the two: neither the new one nor the former newest.
                let between = shifted(1).wrapping_sub(1) & !1;
                self.missing = shifted(self.missing) | between;
                self.came = self.came.map(shifted);
                self.came[eye.index()] |= 1;
                (self.last, self.again) = (Some(sequence), None);
                if step == 1 { SequenceEvent::InOrder } else { SequenceEvent::Gap(step - 1) }
            }
            _ => {
                *self = Self::beginning_with(sequence, eye);
                SequenceEvent::Restart
            }
        }
    }

    /// A number `back` before the newest one: one that was missing, the other eye of one, or one that comes again.
    fn not_new(&mut self, sequence: u64, eye: SampleEye, back: u64) -> SequenceEvent {
        let has = |bits: u128, back: u64| bits.checked_shr(back as u32).is_some_and(|bits| bits & 1 == 1);
        let is_missing = |back: u64| has(self.missing, back);
        let came = self.came.map(|bits| has(bits, back));
        let is_of_other_eye = came.contains(&true) && !came[eye.index()];
        if is_of_other_eye || is_missing(back) {
            let beside = i8::from(is_missing(back.saturating_sub(1))) + i8::from(is_missing(back + 1));
            self.missing &= !(1 << back);
            self.came[eye.index()] |= 1 << back;
            if is_of_other_eye {
                return SequenceEvent::InOrder;
            }
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
        *self = Self::beginning_with(sequence, eye);
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

    #[test]
    fn the_other_eye_of_a_number_is_no_repeat_however_late() {
        use SampleEye::{Left, Right};
        use SequenceEvent::{Gap, InOrder, Overtaken, Repeat};
        let cases = [
            (1, Left, InOrder),
            (2, Left, InOrder),
            (1, Right, InOrder),
            (2, Right, InOrder),
            (1, Right, Repeat),
            (2, Left, Repeat),
            (5, Left, Gap(2)),
            (2, Right, Repeat),
            (4, Right, Overtaken { gaps: 0 }),
            (3, Right, Overtaken { gaps: -1 }),
            (4, Left, InOrder),
            (3, Left, InOrder),
            (5, Right, InOrder),
            (4, Right, Repeat),
        ];
        let mut tracker = SequenceTracker::default();
        for (number, eye, expected) in cases {
            assert_eq!(tracker.next(number, eye), expected, "{number} {eye:?}");
        }
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
