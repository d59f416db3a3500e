//! Whose turn it is with each slot of a client's shared memory.
//!
//! A slot belongs to the client until it hands it over, and to holod until it is freed. What goes through the socket is
//! the order of both, so no picture is read while it is written.

use holod_calibration::TimeNs;

use super::message::{Outcome, SLOTS, Wrong};

/// A picture that was taken so little after it was heard of was taken then: its client converts times of another clock.
const CLOCK_TOLERANCE: TimeNs = TimeNs(1_000_000);

/// A picture that waits to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Picture {
    pub(super) slot: usize,
    pub(super) sequence: u64,
    /// When it was taken, or else when it was heard of.
    pub(super) t_taken: TimeNs,
    /// When it was heard of.
    pub(super) t_heard: TimeNs,
}

/// The slots of one client.
#[derive(Debug, Default)]
pub(super) struct Slots {
    held: [bool; SLOTS],
    waiting: Option<Picture>,
    newest_sequence: Option<u64>,
    /// Pictures that the client left out, by their sequences.
    pub(super) left_out: u64,
}

impl Slots {
    /// The client hands a picture over. Returns what is to be freed for it, and why: the one that waited, which it has
    /// overtaken, or itself, where its sequence does not rise.
    ///
    /// # Errors
    /// [`Wrong`] where the slot is none, or is not the client's to hand over.
    pub(super) fn hand_over(
        &mut self,
        slot: u32,
        sequence: u64,
        t_taken: Option<TimeNs>,
        t_heard: TimeNs,
    ) -> Result<Option<(Picture, Outcome)>, Wrong> {
        let slightly_ahead = t_heard..=t_heard + CLOCK_TOLERANCE;
        let t_taken = t_taken.filter(|t_taken| !slightly_ahead.contains(t_taken)).unwrap_or(t_heard);
        let picture = Picture { slot: slot as usize, sequence, t_taken, t_heard };
        match self.held.get_mut(picture.slot) {
            None => {
                let last = SLOTS - 1;
                return Err(Wrong(format!("FRAM: slot {slot} was found, expected 0 to {last}")));
            }
            Some(true) => {
                return Err(Wrong(format!(
                    "FRAM: slot {slot} was found, which has been handed over already; wait for its FREE"
                )));
            }
            Some(held) => *held = true,
        }
        if let Some(newest) = self.newest_sequence {
            if sequence <= newest {
                let why = format!("sequence {sequence} was found after {newest}, expected it to rise");
                return Ok(Some((picture, Outcome::Refused(why))));
            }
            self.left_out = self.left_out.saturating_add(sequence - newest - 1);
        }
        self.newest_sequence = Some(sequence);
        Ok(self.waiting.replace(picture).map(|overtaken| (overtaken, Outcome::Overtaken)))
    }

    /// The newest picture, to be read now and freed then.
    pub(super) fn take(&mut self) -> Option<Picture> {
        self.waiting.take()
    }

    /// Whether a picture waits.
    pub(super) fn has_picture(&self) -> bool {
        self.waiting.is_some()
    }

    /// The slot is the client's again, who must be told after this.
    pub(super) fn free(&mut self, picture: &Picture) {
        self.held[picture.slot] = false;
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use loom::cell::UnsafeCell;
    use loom::sync::{Arc, Mutex};
    use loom::thread;
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_newest_is_read_and_the_others_come_back() {
        let mut slots = Slots::default();
        assert_eq!(slots.hand_over(0, 5, None, TimeNs(0)), Ok(None));
        let (overtaken, outcome) = slots.hand_over(2, 8, Some(TimeNs(3)), TimeNs(4)).unwrap().unwrap();
        assert_eq!((overtaken.slot, overtaken.sequence, outcome), (0, 5, Outcome::Overtaken));
        slots.free(&overtaken);
        let newest = slots.take().unwrap();
        assert_eq!((newest.slot, newest.sequence, newest.t_taken), (2, 8, TimeNs(3)));
        assert_eq!((slots.take(), slots.left_out), (None, 2));
        assert!(slots.hand_over(2, 9, None, TimeNs(0)).unwrap_err().0.contains("wait for its FREE"));
        assert_eq!(slots.hand_over(0, 9, None, TimeNs(0)), Ok(None));
        assert!(slots.hand_over(3, 10, None, TimeNs(0)).unwrap_err().0.contains("expected 0 to 2"));
    }

    #[test]
    fn a_sequence_that_does_not_rise_is_refused_and_nothing_else() {
        let mut slots = Slots::default();
        slots.hand_over(0, 5, None, TimeNs(0)).unwrap();
        let (refused, outcome) = slots.hand_over(1, 5, None, TimeNs(0)).unwrap().unwrap();
        assert_eq!(refused.slot, 1);
        assert_eq!(outcome, Outcome::Refused("sequence 5 was found after 5, expected it to rise".into()));
        slots.free(&refused);
        assert_eq!(slots.take().unwrap().sequence, 5);
    }

    #[test]
    fn a_picture_is_not_taken_after_it_is_heard_of_but_for_what_clocks_differ_by() {
        let t_heard = TimeNs(5_000_000);
        for (t_taken_ns, expected_ns) in
            [(4_999_999, 4_999_999), (5_000_001, 5_000_000), (6_000_000, 5_000_000), (6_000_001, 6_000_001)]
        {
            let mut slots = Slots::default();
            slots.hand_over(0, 1, Some(TimeNs(t_taken_ns)), t_heard).unwrap();
            let picture = slots.take().unwrap();
            assert_eq!((picture.t_taken, picture.t_heard), (TimeNs(expected_ns), t_heard));
        }
    }

    proptest! {
        /// Whatever a client does, each slot that it hands over is freed once, and no newer picture is passed over.
        #[test]
        fn every_slot_comes_back(orders in prop::collection::vec((0_u32..4, 0_u64..30, any::<bool>()), 0..60)) {
            let mut slots = Slots::default();
            let mut with_holod = [false; SLOTS];
            for (slot, sequence, read) in orders {
                let was_free = with_holod.get(slot as usize) == Some(&false);
                match slots.hand_over(slot, sequence, None, TimeNs(0)) {
                    Ok(freed) => {
                        prop_assert!(was_free);
                        with_holod[slot as usize] = true;
                        if let Some((freed, _)) = freed {
                            prop_assert!(std::mem::take(&mut with_holod[freed.slot]));
                            slots.free(&freed);
                        }
                    }
                    Err(_) => prop_assert!(!was_free),
                }
                if read && let Some(picture) = slots.take() {
                    prop_assert!(std::mem::take(&mut with_holod[picture.slot]));
                    slots.free(&picture);
                }
                prop_assert!(with_holod.iter().filter(|held| **held).count() <= 1, "only the one that waits is kept");
            }
        }
    }

    /// One direction of a socket.
    struct Way<T>(Mutex<VecDeque<T>>);

    impl<T> Way<T> {
        fn new() -> Arc<Self> {
            Arc::new(Self(Mutex::new(VecDeque::new())))
        }

        fn send(&self, message: T) {
            self.0.lock().unwrap().push_back(message);
        }

        fn received(&self) -> Option<T> {
            self.0.lock().unwrap().pop_front()
        }
    }

    /// A client and holod with two words of a picture in each slot. loom runs every order of their steps, and objects
    /// where one writes what the other may be reading. holod hears all that has come before it reads the newest, as it
    /// does.
    fn conversation(waits_for_free: bool) {
        const PICTURES: u64 = 5;
        let memory = Arc::new([(); SLOTS].map(|()| [UnsafeCell::new(0_u64), UnsafeCell::new(0)]));
        let (to_holod, to_client) = (Way::new(), Way::new());
        let client = {
            let (memory, to_holod, to_client) = (Arc::clone(&memory), Arc::clone(&to_holod), Arc::clone(&to_client));
            thread::spawn(move || {
                let mut own: VecDeque<u32> = (0..SLOTS as u32).collect();
                for sequence in 1..=PICTURES {
                    let slot = loop {
                        own.extend(to_client.received());
                        match own.pop_front() {
                            Some(slot) => break slot,
                            None if waits_for_free => thread::yield_now(),
                            None => break 0,
                        }
                    };
                    for word in &memory[slot as usize] {
                        // SAFETY: loom checks that nobody else has the cell meanwhile, which is what is tested.
                        word.with_mut(|word| unsafe { *word = sequence });
                    }
                    to_holod.send((slot, sequence));
                }
            })
        };
        let mut slots = Slots::default();
        let mut seen = 0;
        'turns: while seen < PICTURES {
            while let Some((slot, sequence)) = to_holod.received() {
                // A client that breaks the rules is shown out, but may have written by then.
                let Ok(freed) = slots.hand_over(slot, sequence, None, TimeNs(0)) else { break 'turns };
                if let Some((freed, _)) = freed {
                    slots.free(&freed);
                    to_client.send(freed.slot as u32);
                }
            }
            let Some(picture) = slots.take() else {
                thread::yield_now();
                continue;
            };
            // SAFETY: as above.
            let words = [0, 1].map(|word| memory[picture.slot][word].with(|word| unsafe { *word }));
            assert_eq!(words, [picture.sequence; 2], "a torn picture");
            seen = picture.sequence;
            slots.free(&picture);
            to_client.send(picture.slot as u32);
        }
        client.join().unwrap();
    }

    /// How many there were.
    fn in_every_order(check: impl Fn() + Sync + Send + 'static) -> usize {
        let orders = std::sync::Arc::new(AtomicUsize::new(0));
        let counted = std::sync::Arc::clone(&orders);
        let mut model = loom::model::Builder::new();
        model.preemption_bound = Some(4);
        model.check(move || {
            counted.fetch_add(1, Ordering::Relaxed);
            check();
        });
        orders.load(Ordering::Relaxed)
    }

    #[test]
    fn no_order_of_steps_tears_a_picture() {
        let orders = in_every_order(|| conversation(true));
        assert!(orders > 1000, "{orders} orders are none to speak of");
    }

    #[test]
    #[should_panic(expected = "Causality violation")]
    fn a_client_that_does_not_wait_is_seen_to_tear_one() {
        in_every_order(|| conversation(false));
    }
}
