//! Lines on their way to somewhere that may be slow, full or gone: a pipe that nobody reads, a disk, a journal.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Write};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use tracing::Level;

use super::Line;
use crate::aside::{Queue, Taking};

/// Lines that may wait.
const ROOM: usize = 4096;
/// How long a pipe that takes nothing at once is left alone.
const PIPE_POLL: Duration = Duration::from_millis(10);

/// Takes lines without ever waiting, which a thread of its own writes. Lines that find no room, or that cannot be
/// written, are left out and counted, and that is written once lines go out again.
#[derive(Debug)]
pub(super) struct Outlet {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    lines: Queue<Vec<u8>>,
    /// Of which nothing is written yet.
    left_out: AtomicU64,
    lost: AtomicU64,
    first_error: Mutex<Option<io::Error>>,
}

impl Outlet {
    /// Starts the thread of this name that writes into `out`.
    ///
    /// # Errors
    /// The system gives none.
    pub(super) fn start(name: &str, out: impl Write + Send + 'static) -> io::Result<Self> {
        let shared = Arc::new(Shared {
            lines: Queue::default(),
            left_out: AtomicU64::new(0),
            lost: AtomicU64::new(0),
            first_error: Mutex::new(None),
        });
        let writer = Arc::clone(&shared);
        thread::Builder::new().name(name.into()).spawn(move || writer.write_all(out))?;
        Ok(Self { shared })
    }

    /// Takes a line with its end.
    pub(super) fn put(&self, line: Vec<u8>) {
        if !self.shared.lines.put(line, ROOM) {
            self.shared.lose(1);
        }
    }

    /// Waits until all lines are out, `patience` at most.
    pub(super) fn flush(&self, patience: Duration) {
        self.shared.lines.wait_until_done(patience);
    }

    /// Lines that were left out.
    pub(super) fn lost(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed)
    }

    /// Why a line could not be written, the first time.
    pub(super) fn first_error(&self) -> Option<String> {
        self.shared.first_error.lock().unwrap_or_else(PoisonError::into_inner).as_ref().map(ToString::to_string)
    }
}

impl Drop for Outlet {
    fn drop(&mut self) {
        self.shared.lines.close();
    }
}

impl Shared {
    fn lose(&self, lines: u64) {
        self.left_out.fetch_add(lines, Ordering::Relaxed);
        self.lost.fetch_add(lines, Ordering::Relaxed);
    }

    fn write_all(&self, mut out: impl Write) {
        let mut lines = VecDeque::new();
        while self.lines.take(&mut lines, Taking::AtOnce) {
            for line in lines.drain(..) {
                if let Err(error) = self.tell_lost(&mut out).and_then(|()| write_patiently(&mut out, &line)) {
                    self.lose(1);
                    self.first_error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                }
            }
            // Where it cannot be told now, it is before the next line.
            let _later = self.tell_lost(&mut out);
        }
    }

    fn tell_lost(&self, out: &mut impl Write) -> io::Result<()> {
        let left_out = self.left_out.load(Ordering::Relaxed);
        if left_out == 0 {
            return Ok(());
        }
        let text = format!("{left_out} lines of the log were left out: what reads or stores it took no more");
        write_patiently(out, &Line::now(Level::WARN, text).to_bytes())?;
        self.left_out.fetch_sub(left_out, Ordering::Relaxed);
        Ok(())
    }
}

/// Writes all of `bytes`. Whoever shares a pipe may have set it to take nothing rather than wait.
fn write_patiently(out: &mut impl Write, mut bytes: &[u8]) -> io::Result<()> {
    while !bytes.is_empty() {
        match out.write(bytes) {
            Ok(0) => return Err(ErrorKind::WriteZero.into()),
            Ok(count) => bytes = &bytes[count..],
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) if error.kind() == ErrorKind::WouldBlock => thread::sleep(PIPE_POLL),
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    const LONG: Duration = Duration::from_secs(20);
    const SHORT: Duration = Duration::from_millis(20);

    /// A place that takes one write for each word that it is given: to write, or to fail.
    struct Reluctant {
        words: mpsc::Receiver<bool>,
        taken: Arc<Mutex<Vec<u8>>>,
    }

    impl Write for Reluctant {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            match self.words.recv() {
                Ok(false) => Err(ErrorKind::StorageFull.into()),
                // Whoever gives the words has no more to say: all is taken.
                Ok(true) | Err(_) => self.taken.lock().unwrap().write(bytes),
            }
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    fn outlet() -> (Outlet, mpsc::Sender<bool>, Arc<Mutex<Vec<u8>>>) {
        let (speaker, words) = mpsc::channel();
        let taken = Arc::default();
        let out = Reluctant { words, taken: Arc::clone(&taken) };
        (Outlet::start("test-log", out).unwrap(), speaker, taken)
    }

    fn text(taken: &Mutex<Vec<u8>>) -> String {
        String::from_utf8(taken.lock().unwrap().clone()).unwrap()
    }

    #[test]
    fn a_reader_who_stands_still_costs_lines_and_is_told_so_when_he_goes_on() {
        let (outlet, reader, taken) = outlet();
        let lines = 3 * ROOM as u64;
        for line in 0..lines {
            outlet.put(format!("line {line}\n").into_bytes());
        }
        outlet.flush(SHORT);
        assert_eq!(text(&taken), "", "nobody reads");
        let lost = outlet.lost();
        assert!(lost >= lines - 2 * ROOM as u64 - 1 && lost < lines, "{lost}");
        drop(reader);
        outlet.flush(LONG);
        let text = text(&taken);
        let told =
            text.lines().filter_map(|line| line.split_once("WARN  ")?.1.split_once(" lines of the log were left"));
        assert_eq!(told.map(|(count, _)| count.parse::<u64>().unwrap()).sum::<u64>(), lost, "{}", &text[..500]);
        assert_eq!(text.matches("line ").count() as u64 + lost, lines);
        outlet.put(b"after\n".to_vec());
        outlet.flush(LONG);
        assert!(self::text(&taken).ends_with("after\n"));
        assert_eq!(outlet.first_error(), None);
    }

    #[test]
    fn lines_that_cannot_be_written_are_counted_and_the_next_ones_tried() {
        let (outlet, disk, taken) = outlet();
        // The first line, its count after it, and before the next one the count, which brings that one down, too.
        for word in [false, false, false, false] {
            disk.send(word).unwrap();
        }
        outlet.put(b"first\n".to_vec());
        outlet.flush(LONG);
        outlet.put(b"second\n".to_vec());
        outlet.flush(LONG);
        assert_eq!((text(&taken).as_str(), outlet.lost()), ("", 2));
        assert!(outlet.first_error().unwrap().contains("no storage space"), "{:?}", outlet.first_error());
        drop(disk);
        outlet.put(b"third\n".to_vec());
        outlet.flush(LONG);
        let text = text(&taken);
        assert!(text.contains("2 lines of the log were left out") && text.ends_with("third\n"), "{text}");
    }
}
