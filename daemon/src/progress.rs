//! Signs of life from work that takes long.

use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

/// Work that is done within this is not spoken of.
const FIRST_WORD: Duration = Duration::from_secs(1);
/// How often it is said that the work goes on.
const NEXT_WORD: Duration = Duration::from_secs(5);

/// Does `work`, and says on the log what it is, once it takes a second, and that it goes on, every five.
pub(crate) fn during<T>(what: &str, work: impl FnOnce() -> T) -> T {
    during_with(what, [FIRST_WORD, NEXT_WORD], |text| tracing::info!("{text}"), work)
}

fn during_with<T>(
    what: &str,
    [first, next]: [Duration; 2],
    say: impl Fn(String) + Send,
    work: impl FnOnce() -> T,
) -> T {
    let began = Instant::now();
    let result = thread::scope(|scope| {
        // Dropped when the work is done, by a panic too.
        let (_working, done) = mpsc::channel::<()>();
        scope.spawn(move || {
            let mut wait = first;
            while done.recv_timeout(wait) == Err(RecvTimeoutError::Timeout) {
                say(match wait == first {
                    true => format!("{what} ..."),
                    false => format!("{what}: {:.0} s so far", began.elapsed().as_secs_f64()),
                });
                wait = next;
            }
        });
        work()
    });
    tracing::debug!("{what}: {:.0} ms", began.elapsed().as_secs_f64() * 1e3);
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPANS: [Duration; 2] = [Duration::from_millis(20), Duration::from_millis(30)];

    fn said(work: impl FnOnce()) -> Vec<String> {
        let (words, heard) = mpsc::channel();
        during_with("sorting", SPANS, move |text| words.send(text).unwrap(), work);
        heard.try_iter().collect()
    }

    #[test]
    fn long_work_is_spoken_of_and_short_work_is_not() {
        assert_eq!(said(|| ()), [""; 0]);
        let said = said(|| thread::sleep(Duration::from_millis(400)));
        assert_eq!(said[0], "sorting ...");
        assert!(said.len() > 2 && said[1..].iter().all(|text| text == "sorting: 0 s so far"), "{said:?}");
    }

    #[test]
    fn work_that_panics_ends_the_words_too() {
        let panicked = std::panic::catch_unwind(|| during_with("sorting", SPANS, |_| (), || panic!("over")));
        assert!(panicked.is_err());
    }
}
