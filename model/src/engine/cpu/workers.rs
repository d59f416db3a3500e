//! How a stage's work is shared among threads.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

/// More threads than this share no stage whose workers have buffers of their own.
pub(super) const WORKERS: usize = 32;

/// Runs `work` on each of `items`: every worker takes one after another, so that none waits for a slower one.
pub(super) fn share_out<W: Send, T: Send>(
    workers: &mut [W],
    items: impl Iterator<Item = T> + Send,
    work: impl Fn(&mut W, T) + Sync,
) {
    let remaining = Mutex::new(items);
    let next = || remaining.lock().unwrap_or_else(PoisonError::into_inner).next();
    workers.par_iter_mut().for_each(|worker| {
        while let Some(item) = next() {
            work(worker, item);
        }
    });
}
