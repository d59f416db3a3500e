//! What running numbers say about lost samples.

use crate::SampleEye;

/// What a sequence of running numbers says about lost lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SequenceTracker {
    last: Option<(u64, SampleEye)>,
}

/// What one running number tells after those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SequenceEvent {
    /// The next one, the first one, or the other eye of the same instant.
    InOrder,
    /// This many numbers are missing.
    Gap(u64),
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
        Self { last: None }
    }

    /// Takes the next sample's number.
    pub(crate) fn next(&mut self, sequence: u64, eye: SampleEye) -> SequenceEvent {
        let Some((last, last_eye)) = self.last.replace((sequence, eye)) else {
            return SequenceEvent::InOrder;
        };
        match sequence.checked_sub(last) {
            None => SequenceEvent::Restart,
            Some(0) if eye == last_eye => SequenceEvent::Repeat,
            Some(0 | 1) => SequenceEvent::InOrder,
            Some(step) if step > LONGEST_GAP => SequenceEvent::Restart,
            Some(step) => SequenceEvent::Gap(step - 1),
        }
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
    }
}
