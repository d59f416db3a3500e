//! Which threads go first: the panel, lasers and tracker before the network's workers.
//!
//! A thread starts with the scheduling of the one that creates it, so parts are created on a short-lived thread that
//! has the wanted one. The tracker's reader raises itself, since the thread that writes its record must not be raised.

use rustix::process::setpriority_process;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

/// Modest on purpose: above every ordinary thread, below the kernel's own.
pub(crate) const REALTIME_PRIORITY: u8 = 10;
const WORKER_NICENESS: i32 = 5;

/// Creates a part whose threads wake at once when it is their time. Without the right to real-time scheduling they run
/// as ordinary threads, and a warning says so.
pub(crate) fn prompt<T: Send>(make: impl FnOnce() -> T + Send) -> T {
    on_thread_with(raise, make)
}

/// Creates a part whose threads give way to ordinary ones.
pub(crate) fn patient<T: Send>(make: impl FnOnce() -> T + Send) -> T {
    let give_way = || {
        if let Err(error) = setpriority_process(None, WORKER_NICENESS) {
            tracing::debug!("the network's threads stay at ordinary priority: {error}");
        }
    };
    on_thread_with(give_way, make)
}

/// Makes the calling thread wake at once when it is its time, as in [`prompt`].
pub(crate) fn raise() {
    let priority = ThreadPriority::Crossplatform(REALTIME_PRIORITY.try_into().expect("a priority below 100"));
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    if let Err(error) = set_thread_priority_and_policy(thread_native_id(), priority, policy) {
        tracing::warn!(
            "panel, laser and tracker threads run at ordinary priority ({error:?}): fields may be late on a busy \
             machine; allow real-time scheduling with LimitRTPRIO=20 in the service or rtprio in limits.conf"
        );
    }
}

fn on_thread_with<T: Send>(prepare: impl FnOnce() + Send, make: impl FnOnce() -> T + Send) -> T {
    let made = std::thread::scope(|scope| {
        scope
            .spawn(|| {
                prepare();
                make()
            })
            .join()
    });
    made.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::process::getpriority_process;

    #[test]
    fn threads_of_a_patient_part_give_way_and_the_caller_does_not() {
        let own = getpriority_process(None).unwrap();
        let child = patient(|| std::thread::spawn(|| getpriority_process(None).unwrap()).join().unwrap());
        assert_eq!(child, WORKER_NICENESS.max(own));
        assert_eq!(getpriority_process(None).unwrap(), own);
    }
}
