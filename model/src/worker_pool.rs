//! Threads that work on a frame together, and are handed it without allocating.
//!
//! [`CpuEngine`](crate::CpuEngine), [`DoublePhase`](crate::optics::DoublePhase) and whatever else splits its work by
//! rayon share the threads of the pool that they are called in. Handing work to a rayon pool from outside allocates now
//! and then, which a frame loop must not. So one worker of the pool stays inside it, waits for work and runs it there;
//! the caller waits meanwhile.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use rayon::{ThreadPool, ThreadPoolBuilder};

/// A job with all that it works on, which stays with its own threads and is run again and again.
pub struct WorkerPool<J> {
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
    /// What the job panicked with, for whoever ordered it.
    panic: Option<Box<dyn Any + Send>>,
    job: J,
}

/// Threads could not be started.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("cannot start {threads} threads to compute frames with: {detail}; check the limits on threads and memory")]
pub struct WorkerPoolError {
    /// How many were asked for; 0 for as many as there are cores.
    pub threads: usize,
    /// What the system said.
    pub detail: String,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Order {
    Wait,
    Run,
    Quit,
}

impl<J: Send + 'static> WorkerPool<J> {
    /// Starts `threads` threads, 0 for as many as there are cores, named `name` and a number, and waits until all run.
    ///
    /// # Errors
    /// The threads could not be started.
    pub fn new(
        name: &'static str,
        threads: usize,
        job: J,
        run: impl Fn(&mut J) + Send + 'static,
    ) -> Result<Self, WorkerPoolError> {
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(move |index| format!("{name}-{index}"))
            .build()
            .map_err(|error| WorkerPoolError { threads, detail: error.to_string() })?;
        // A thread allocates while it starts, which on a busy machine may be long after this.
        pool.broadcast(|_| ());
        let state = Mutex::new(State { order: Order::Wait, panic: None, job });
        let shared = Arc::new(Shared { state, changed: Condvar::new() });
        let for_worker = Arc::clone(&shared);
        pool.spawn(move || for_worker.serve(run));
        Ok(Self { shared, pool })
    }

    /// Hands the job out, to give it what it works on and to take what it made. Does not allocate.
    pub fn with<R>(&mut self, look: impl FnOnce(&mut J) -> R) -> R {
        look(&mut self.shared.lock().job)
    }

    /// Has the threads run the job, and waits for them. Does not allocate.
    ///
    /// # Panics
    /// Where the job does, with what it panicked with.
    pub fn run(&mut self) {
        let mut state = self.shared.lock();
        state.order = Order::Run;
        self.shared.changed.notify_all();
        let running = self.shared.changed.wait_while(state, |state| state.order == Order::Run);
        let panic = running.unwrap_or_else(PoisonError::into_inner).panic.take();
        if let Some(panic) = panic {
            resume_unwind(panic);
        }
    }

    /// How many threads there are.
    pub fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }
}

impl<J> Drop for WorkerPool<J> {
    fn drop(&mut self) {
        self.shared.lock().order = Order::Quit;
        self.shared.changed.notify_all();
    }
}

impl<J> Shared<J> {
    /// A job's panic is caught, so a poisoned lock only says that a caller's closure did.
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
                    // Whoever ordered the job unwinds: what it left half done is seen by nobody else.
                    state.panic = catch_unwind(AssertUnwindSafe(|| run(&mut state.job))).err();
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
    fn a_job_that_panics_does_so_where_it_was_ordered() {
        let mut pool = WorkerPool::new("test", 1, 0, |input| assert!(*input != 1, "found {input}")).unwrap();
        pool.with(|job| *job = 1);
        let panic = catch_unwind(AssertUnwindSafe(|| pool.run())).expect_err("it panicked");
        assert_eq!(panic.downcast_ref::<String>().unwrap(), "found 1");
        pool.with(|job| *job = 2);
        pool.run();
    }

    #[test]
    fn a_job_runs_once_for_each_order_inside_its_pool() {
        let seen = Vec::<(u32, Option<usize>)>::new();
        let mut pool = WorkerPool::new("test", 2, (0, seen), |(input, seen)| {
            seen.push((*input * 2, rayon::current_thread_index()));
        })
        .unwrap();
        assert_eq!(pool.threads(), 2);
        for input in 1..=3 {
            pool.with(|job| job.0 = input);
            pool.run();
            assert_eq!(pool.with(|job| job.1.len()), input as usize);
        }
        pool.run();
        let seen = pool.with(|job| job.1.clone());
        assert_eq!(seen.iter().map(|entry| entry.0).collect::<Vec<_>>(), [2, 4, 6, 6]);
        assert!(seen.iter().all(|entry| entry.1.is_some()));
    }
}
