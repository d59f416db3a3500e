//! What the tracker's thread counts.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::gate::{Rejection, Verdict};
use crate::import::LogFault;
use crate::wire::WireFault;

crate::named::named! {
    /// One thing that is counted, beside the reasons for rejection.
    pub enum Counter {
        /// Bytes read from a port.
        Bytes = "bytes",
        /// Samples that were decoded, each eye for itself, before the gate judges them.
        Samples = "samples",
        /// Samples that the gate believed.
        Accepted = "accepted",
        /// Messages that are neither samples nor faults, such as comments.
        Notes = "notes",
        /// Messages whose beginning was missed when a link was opened.
        Partials = "partials",
        /// Times at which running numbers were skipped, and did not come after others.
        SequenceGaps = "sequence_gaps",
        /// Running numbers skipped in all that did not come after others.
        SequenceMissing = "sequence_missing",
        /// Running numbers skipped that came after others.
        SequenceOvertaken = "sequence_overtaken",
        /// Samples whose number and eye had come before.
        SequenceRepeats = "sequence_repeats",
        /// Times at which the running number fell.
        SequenceRestarts = "sequence_restarts",
        /// Times at which the port was opened.
        Connects = "connects",
        /// Times at which the port was lost.
        Disconnects = "disconnects",
        /// Tries to open it again.
        ReconnectAttempts = "reconnect_attempts",
        /// Times at which an open port fell silent.
        Silences = "silences",
        /// Times at which the tracker's clock was reset or stepped.
        ClockResets = "clock_resets",
        /// Times at which the tracker's clock leapt away before anything was known of it.
        ClockLeaps = "clock_leaps",
        /// Times at which a looped log began again.
        Loops = "loops",
        /// Decisions that the tap had no room for.
        DecisionsDropped = "decisions_dropped",
        /// Datagrams of other senders than the one that is followed.
        Strangers = "datagrams_of_others",
    }
}

const COUNTERS: usize = Counter::ALL.len();
const REJECTIONS: usize = Rejection::ALL.len();
const FAULTS: usize = LogFault::NAMES.len();

/// The counters themselves; written by the tracker's thread only. All but the gaps only grow: the missing numbers are
/// all that were skipped.
#[derive(Debug)]
pub(crate) struct Counters {
    counts: [AtomicU64; COUNTERS],
    rejected: [AtomicU64; REJECTIONS],
    faults: [AtomicU64; FAULTS],
}

impl Counters {
    pub(crate) const fn new() -> Self {
        Self {
            counts: [const { AtomicU64::new(0) }; COUNTERS],
            rejected: [const { AtomicU64::new(0) }; REJECTIONS],
            faults: [const { AtomicU64::new(0) }; FAULTS],
        }
    }

    pub(crate) fn add(&self, counter: Counter, count: u64) {
        self.counts[counter as usize].fetch_add(count, Ordering::Relaxed);
    }

    /// A gap that was counted turned out to be none.
    pub(crate) fn fill_gap(&self) {
        self.counts[Counter::SequenceGaps as usize].fetch_sub(1, Ordering::Relaxed);
    }

    pub(crate) fn add_rejected(&self, reason: Rejection) {
        self.rejected[reason.index()].fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn add_fault(&self, fault: LogFault, count: u64) {
        self.faults[fault.index()].fetch_add(count, Ordering::Relaxed);
    }

    pub(crate) fn add_faults(&self, faults: impl Iterator<Item = (&'static str, u64)>) {
        for (counter, (_, count)) in self.faults.iter().zip(faults) {
            counter.fetch_add(count, Ordering::Relaxed);
        }
    }

    pub(crate) fn snapshot(&self) -> CounterSnapshot {
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let mut counts = self.counts.each_ref().map(load);
        // The thread may have counted between the two: their sum is to be what was skipped, which never falls.
        let [missing, overtaken] =
            [Counter::SequenceMissing, Counter::SequenceOvertaken].map(|counter| counter as usize);
        counts[overtaken] = counts[overtaken].min(counts[missing]);
        counts[missing] -= counts[overtaken];
        CounterSnapshot {
            counts,
            rejected: self.rejected.each_ref().map(load),
            faults: self.faults.each_ref().map(load),
        }
    }
}

/// All counts at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CounterSnapshot {
    counts: [u64; COUNTERS],
    rejected: [u64; REJECTIONS],
    faults: [u64; FAULTS],
}

impl CounterSnapshot {
    /// The counts before anything was counted.
    pub const fn zero() -> Self {
        Self { counts: [0; COUNTERS], rejected: [0; REJECTIONS], faults: [0; FAULTS] }
    }

    /// Counts a sample by what the gate said of it, where no tracker counts.
    pub const fn add(&mut self, verdict: Verdict) {
        self.counts[Counter::Samples as usize] += 1;
        match verdict {
            Verdict::Accepted => self.counts[Counter::Accepted as usize] += 1,
            Verdict::Rejected(reason) => self.rejected[reason.index()] += 1,
        }
    }

    /// How often this was counted since the tracker was started.
    pub const fn of(&self, counter: Counter) -> u64 {
        self.counts[counter as usize]
    }

    /// Samples that the gate rejected for `reason`.
    pub const fn rejected(&self, reason: Rejection) -> u64 {
        self.rejected[reason.index()]
    }

    /// Samples that the gate rejected.
    pub fn rejected_in_all(&self) -> u64 {
        self.rejected.iter().sum()
    }

    /// Lines or cells that held no sample, for `fault`.
    pub const fn fault(&self, fault: LogFault) -> u64 {
        self.faults[fault.index()]
    }

    /// Lines or cells that held no sample.
    pub fn faults_in_all(&self) -> u64 {
        self.faults.iter().sum()
    }

    /// Lost samples that were told beside the faults of their figures: as many as there can be. Of an eye that is not
    /// followed there are faults alone.
    pub(crate) fn lost_beside_faults(&self) -> u64 {
        let of_wires = WireFault::ALL.into_iter().filter(|fault| fault.is_of_a_figure()).map(LogFault::Wire);
        let of_logs = [LogFault::NotFinite, LogFault::Negative, LogFault::BadNumber, LogFault::Missing];
        of_wires.chain(of_logs).map(|fault| self.fault(fault)).sum::<u64>().min(self.rejected(Rejection::Lost))
    }

    /// Samples, lines and cells that were of no use, each counted once.
    pub fn refused_in_all(&self) -> u64 {
        self.rejected_in_all() + self.faults_in_all() - self.lost_beside_faults()
    }

    /// Every name with its count: counters, then `wire_*` and `log_*` faults, then `rejected_*`.
    pub fn entries(&self) -> impl Iterator<Item = (String, u64)> {
        let counts = Counter::ALL.into_iter().map(|counter| (counter.name().to_owned(), self.of(counter)));
        let faults = LogFault::NAMES.into_iter().zip(self.faults).map(|(name, count)| (name.to_owned(), count));
        let rejected =
            Rejection::ALL.into_iter().map(|reason| (format!("rejected_{}", reason.name()), self.rejected(reason)));
        counts.chain(faults).chain(rejected)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn every_count_has_a_name_of_its_own_and_its_own_place() {
        let counters = Counters::new();
        counters.add(Counter::Silences, 3);
        counters.add_rejected(Rejection::Guard);
        counters.add_fault(LogFault::Wire(WireFault::BadChecksum), 2);
        counters.add_fault(LogFault::Backwards, 5);
        let snapshot = counters.snapshot();
        let entries: Vec<_> = snapshot.entries().collect();
        let names: HashSet<_> = entries.iter().map(|(name, _)| name).collect();
        assert_eq!(names.len(), COUNTERS + REJECTIONS + FAULTS);
        let mut counted: Vec<_> = entries.iter().filter(|(_, count)| *count > 0).cloned().collect();
        counted.sort();
        let expected = [("log_backwards", 5), ("rejected_guard", 1), ("silences", 3), ("wire_bad_checksum", 2)];
        assert_eq!(counted, expected.map(|(name, count)| (name.to_owned(), count)));
        assert_eq!(snapshot.refused_in_all(), 8);
        counters.add_rejected(Rejection::Lost);
        counters.add_fault(LogFault::Wire(WireFault::Negative), 1);
        assert_eq!(counters.snapshot().refused_in_all(), 9, "one pupil, lost beside its fault");
        counters.add_rejected(Rejection::Lost);
        counters.add_fault(LogFault::Negative, 1);
        assert_eq!(counters.snapshot().refused_in_all(), 10, "the same of a log");
        for (index, counter) in Counter::ALL.into_iter().enumerate() {
            assert_eq!(counter as usize, index);
        }
        for (index, reason) in Rejection::ALL.into_iter().enumerate() {
            assert_eq!(reason.index(), index);
        }
    }

    #[test]
    fn numbers_that_are_overtaken_are_taken_from_the_missing_ones() {
        let counters = Counters::new();
        let missing_and_overtaken = || {
            let snapshot = counters.snapshot();
            [Counter::SequenceMissing, Counter::SequenceOvertaken].map(|counter| snapshot.of(counter))
        };
        // The snapshot may see a number overtaken before it sees it skipped.
        for (counter, count, expected) in [
            (Counter::SequenceOvertaken, 1, [0, 0]),
            (Counter::SequenceMissing, 7, [6, 1]),
            (Counter::SequenceOvertaken, 2, [4, 3]),
        ] {
            counters.add(counter, count);
            assert_eq!(missing_and_overtaken(), expected);
        }
    }
}
