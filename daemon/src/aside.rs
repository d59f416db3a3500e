//! Work for a thread of its own, so that nobody else waits for a disk, a pipe or a terminal.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// How often the end of a thread is looked for.
const LOOK: Duration = Duration::from_millis(5);

/// Items on their way to the one thread that handles them. Whoever puts one in never waits for that thread.
#[derive(Debug)]
pub(crate) struct Queue<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
}

#[derive(Debug)]
struct State<T> {
    items: VecDeque<T>,
    /// What was taken out last is not done with yet.
    at_work: bool,
    closed: bool,
}

/// When the thread that handles items takes them.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Taking {
    /// As soon as there is one.
    AtOnce,
    /// Once in so long, whatever has come by then.
    Every(Duration),
}

impl<T> Default for Queue<T> {
    fn default() -> Self {
        let state = State { items: VecDeque::new(), at_work: false, closed: false };
        Self { state: Mutex::new(state), changed: Condvar::new() }
    }
}

impl<T> Queue<T> {
    /// Puts an item in where fewer than `most` wait; whether it did.
    pub(crate) fn put(&self, item: T, most: usize) -> bool {
        let mut state = self.state();
        let has_room = state.items.len() < most && !state.closed;
        if has_room {
            state.items.push_back(item);
            self.changed.notify_all();
        }
        has_room
    }

    /// Takes all that is there in place of what is in `taken`, which counts as done with. False once the queue is
    /// closed and nothing is left.
    pub(crate) fn take(&self, taken: &mut VecDeque<T>, taking: Taking) -> bool {
        taken.clear();
        let mut state = self.state();
        state.at_work = false;
        self.changed.notify_all();
        let mut state = match taking {
            Taking::AtOnce => {
                let wait = self.changed.wait_while(state, |state| state.items.is_empty() && !state.closed);
                wait.unwrap_or_else(PoisonError::into_inner)
            }
            Taking::Every(interval) => {
                let wait = self.changed.wait_timeout_while(state, interval, |state| !state.closed);
                wait.unwrap_or_else(PoisonError::into_inner).0
            }
        };
        std::mem::swap(&mut state.items, taken);
        state.at_work = !taken.is_empty();
        state.at_work || !state.closed
    }

    /// Nothing is put in any more.
    pub(crate) fn close(&self) {
        self.state().closed = true;
        self.changed.notify_all();
    }

    /// Waits until all that was put in is done with, `patience` at most; whether it is.
    pub(crate) fn wait_until_done(&self, patience: Duration) -> bool {
        let is_busy = |state: &mut State<T>| state.at_work || !state.items.is_empty();
        let wait = self.changed.wait_timeout_while(self.state(), patience, is_busy);
        !wait.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }

    fn state(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What a thread came to, where it ends within `patience`; else it is left to itself. A panic over there has been told,
/// and brings nothing.
pub(crate) fn join_within<T>(thread: JoinHandle<T>, patience: Duration) -> Option<T> {
    ends_within(&thread, patience).then(|| thread.join().ok()).flatten()
}

/// Waits for a thread's end, for `patience` at most, and tells whether it came.
pub(crate) fn ends_within<T>(thread: &JoinHandle<T>, patience: Duration) -> bool {
    let t_end = Instant::now() + patience;
    while !thread.is_finished() {
        if Instant::now() >= t_end {
            return false;
        }
        thread::sleep(LOOK);
    }
    true
}

/// What `work` comes to on a thread of its own, where it is done within `patience`; else it is left to itself.
///
/// # Errors
/// The system gives no thread.
pub(crate) fn within<T: Send + 'static>(
    patience: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> std::io::Result<Option<T>> {
    let (done, result) = mpsc::channel();
    let work = move || {
        // Whoever asked has gone.
        let _late = done.send(work());
    };
    thread::Builder::new().name("holod-aside".into()).spawn(work)?;
    Ok(result.recv_timeout(patience).ok())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    const LONG: Duration = Duration::from_secs(20);

    #[test]
    fn a_full_queue_refuses_and_keeps_what_it_has_in_order() {
        let queue = Queue::default();
        assert_eq!([1, 2, 3, 4].map(|item| queue.put(item, 3)), [true, true, true, false]);
        assert!(queue.put(5, 4), "another bound for another kind of item");
        let mut taken = VecDeque::new();
        assert!(queue.take(&mut taken, Taking::AtOnce));
        assert_eq!(taken, [1, 2, 3, 5]);
        assert!(!queue.wait_until_done(Duration::ZERO), "what is taken is not done with");
        queue.close();
        assert!(!queue.put(6, 3));
        assert!(!queue.take(&mut taken, Taking::AtOnce));
        assert!(queue.wait_until_done(Duration::ZERO) && taken.is_empty());
    }

    #[test]
    fn items_at_the_end_are_handled_by_either_way_of_taking() {
        for taking in [Taking::AtOnce, Taking::Every(LONG)] {
            let queue = Arc::new(Queue::default());
            let worker = {
                let queue = Arc::clone(&queue);
                thread::spawn(move || {
                    let (mut taken, mut all) = (VecDeque::new(), Vec::new());
                    while queue.take(&mut taken, taking) {
                        all.extend(taken.drain(..));
                    }
                    all
                })
            };
            for item in 0..100 {
                assert!(queue.put(item, 1000));
            }
            queue.close();
            assert!(queue.wait_until_done(LONG));
            assert_eq!(join_within(worker, LONG), Some((0..100).collect()), "{taking:?}");
        }
    }

    #[test]
    fn nobody_waits_longer_than_the_patience() {
        let (_never, wait) = mpsc::channel::<()>();
        let stuck = thread::spawn(move || wait.recv().is_ok());
        assert_eq!(join_within(stuck, Duration::from_millis(20)), None);
        let (_never, wait) = mpsc::channel::<()>();
        assert_eq!(within(Duration::from_millis(20), move || wait.recv().is_ok()).unwrap(), None);
        assert_eq!(within(LONG, || 7).unwrap(), Some(7));
        let queue = Queue::default();
        queue.put(1, 1);
        assert!(!queue.wait_until_done(Duration::from_millis(20)));
    }
}
