//! Counts by a reason, which any thread may add to.

use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::sync::atomic::{AtomicU64, Ordering};

/// One of a few reasons.
pub(crate) trait Reason: Copy + PartialEq + 'static {
    /// Every reason; counts are kept in this order.
    const ALL: &'static [Self];

    /// What it is called in a status and in figures.
    fn name(self) -> &'static str;
}

/// How often there was which reason. A reason that there never was is told as 0.
pub(crate) struct TallyBy<R> {
    counts: Box<[AtomicU64]>,
    by: PhantomData<R>,
}

impl<R: Reason> Default for TallyBy<R> {
    fn default() -> Self {
        Self { counts: R::ALL.iter().map(|_| AtomicU64::new(0)).collect(), by: PhantomData }
    }
}

impl<R: Reason> TallyBy<R> {
    /// Counts one more of this reason.
    pub(crate) fn count(&self, reason: R) {
        let counts = R::ALL.iter().zip(&self.counts);
        for (_, count) in counts.filter(|(known, _)| **known == reason) {
            count.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Each reason by its name, in order.
    pub(crate) fn each(&self) -> impl Iterator<Item = (&'static str, u64)> {
        R::ALL.iter().zip(&self.counts).map(|(reason, count)| (reason.name(), count.load(Ordering::Relaxed)))
    }

    /// The same, to be kept.
    pub(crate) fn map(&self) -> BTreeMap<String, u64> {
        self.each().map(|(name, count)| (name.to_owned(), count)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Copy, PartialEq)]
    enum Weather {
        Rain,
        Snow,
    }

    impl Reason for Weather {
        const ALL: &'static [Self] = &[Self::Rain, Self::Snow];

        fn name(self) -> &'static str {
            match self {
                Self::Rain => "rain",
                Self::Snow => "snow",
            }
        }
    }

    #[test]
    fn each_reason_is_counted_by_itself_and_told_from_the_start() {
        let tally = TallyBy::<Weather>::default();
        tally.count(Weather::Snow);
        tally.count(Weather::Snow);
        assert_eq!(tally.each().collect::<Vec<_>>(), [("rain", 0), ("snow", 2)]);
        tally.count(Weather::Rain);
        assert_eq!(tally.map(), BTreeMap::from([("rain".into(), 1), ("snow".into(), 2)]));
    }
}
