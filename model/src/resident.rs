//! A thread pool that is handed work without allocating.
//!
//! Handing work to a rayon pool from outside allocates now and then, which a frame loop must not. So one worker of the
//! pool stays inside it, waits for work and runs it there; the caller waits meanwhile.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

/// A job with all that it works on, which stays with its own thread pool and is run again and again.
pub(crate) struct Resident<J> {
    shared: Arc<Shared<J>>,
    /// Its workers end after `Drop` has told the waiting one to.
    pool: ThreadPool,
}

struct Shared<J> {
    state: Mutex<State<J>>,
    changed: Condvar,
}

struct State<J> {
    order: Order,
    job: J,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Order {
    Wait,
    Run,
    Quit,
}

impl<J: Send + 'static> Resident<J> {
    /// Starts `threads` threads, 0 for as many as there are cores, named `name` and a number, and waits until all run.
    pub(crate) fn new(
        name: &'static str,
        threads: usize,
        job: J,
        run: impl Fn(&mut J) + Send + 'static,
    ) -> Result<Self, ThreadPoolBuildError> {
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(move |index| format!("{name}-{index}"))
            .build()?;
        // A thread allocates while it starts, which on a busy machine may be long after this.
        pool.broadcast(|_| ());
        let state = Mutex::new(State { order: Order::Wait, job });
        let shared = Arc::new(Shared { state, changed: Condvar::new() });
        let for_worker = Arc::clone(&shared);
        pool.spawn(move || for_worker.serve(run));
        Ok(Self { shared, pool })
    }

    /// Prepares the job, has the pool run it and collects what it made. Does not allocate.
    pub(crate) fn run(&mut self, prepare: impl FnOnce(&mut J), collect: impl FnOnce(&mut J)) {
        let mut state = self.shared.lock();
        prepare(&mut state.job);
        state.order = Order::Run;
        self.shared.changed.notify_all();
        let mut state = self
            .shared
            .changed
            .wait_while(state, |state| state.order == Order::Run)
            .unwrap_or_else(PoisonError::into_inner);
        collect(&mut state.job);
    }

    pub(crate) fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }
}

impl<J> Drop for Resident<J> {
    fn drop(&mut self) {
        self.shared.lock().order = Order::Quit;
        self.shared.changed.notify_all();
    }
}

impl<J> Shared<J> {
    /// A job that panicked ends the process, so a poisoned lock only says that a caller's closure did.
    fn lock(&self) -> MutexGuard<'_, State<J>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs the job whenever it is ordered, until told to quit.
    fn serve(&self, run: impl Fn(&mut J)) {
        let mut state = self.lock();
        loop {
            match state.order {
                Order::Wait => state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
                Order::Run => {
                    run(&mut state.job);
                    state.order = Order::Wait;
                    self.changed.notify_all();
                }
                Order::Quit => return,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_runs_once_for_each_order_inside_its_pool() {
        let seen = Vec::<(u32, Option<usize>)>::new();
        let mut resident = Resident::new("test", 2, (0, seen), |(input, seen)| {
            seen.push((*input * 2, rayon::current_thread_index()));
        })
        .unwrap();
        assert_eq!(resident.threads(), 2);
        for input in 1..=3 {
            resident.run(|job| job.0 = input, |job| assert_eq!(job.1.len(), input as usize));
        }
        resident.run(|_| (), |job| assert_eq!(job.1.iter().map(|entry| entry.0).collect::<Vec<_>>(), [2, 4, 6, 6]));
        resident.run(|_| (), |job| assert!(job.1.iter().all(|entry| entry.1.is_some())));
    }
}
