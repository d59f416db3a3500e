//! The line to a device, as the laser thread needs it: what arrives is stamped at once by a thread of its own and waits
//! in a ring, so that nobody who drives lasers ever waits for it.

use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsRawFd, BorrowedFd};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use holod_calibration::{TimeNs, unit_keeps};
use rtrb::{Consumer, Producer, RingBuffer};
use serialport::TTYPort;

use super::LaserError;

/// Bytes that one arrival carries at most.
const CHUNK_BYTES: usize = 48;
/// Arrivals that wait: some seconds of a box's answers.
const ARRIVALS: usize = 1024;
/// How long the reader sleeps at most before it sees an order to stop.
const READ_TIMEOUT: Duration = Duration::from_millis(20);

/// Something came over the line.
#[derive(Clone, Copy, Debug)]
pub(super) enum Arrival {
    /// What the other end sent, as much of it as one read brought.
    Bytes {
        /// When they had been read.
        t: TimeNs,
        /// How many of `bytes` count.
        count: usize,
        bytes: [u8; CHUNK_BYTES],
    },
    /// The line failed; nothing comes any more.
    Ended(ErrorKind),
}

/// A line with a thread that listens to it.
pub(super) struct Link {
    writer: Box<dyn Write + Send>,
    arrivals: Consumer<Arrival>,
    ended: Option<ErrorKind>,
    stop: Arc<AtomicBool>,
    listener: Option<JoinHandle<()>>,
}

impl std::fmt::Debug for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Link").field("ended", &self.ended).finish_non_exhaustive()
    }
}

impl Link {
    /// Listens to `reader`, which returns within some tens of milliseconds, with [`ErrorKind::WouldBlock`] or
    /// [`ErrorKind::TimedOut`] where nothing is there. `writer` does not wait.
    ///
    /// # Errors
    /// [`LaserError::Line`] where no thread can be started.
    pub(super) fn new(
        reader: impl Read + Send + 'static,
        writer: impl Write + Send + 'static,
        clock: fn() -> TimeNs,
    ) -> Result<Self, LaserError> {
        let (producer, arrivals) = RingBuffer::new(ARRIVALS);
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let listener = std::thread::Builder::new()
            .name("holod-laser-rx".into())
            .spawn(move || listen(reader, producer, &stopped, clock))?;
        Ok(Self { writer: Box::new(writer), arrivals, ended: None, stop, listener: Some(listener) })
    }

    /// What came next, if anything did.
    ///
    /// # Errors
    /// [`LaserError::Line`] where the line has failed.
    pub(super) fn next(&mut self) -> Result<Option<Arrival>, LaserError> {
        match self.arrivals.pop() {
            Ok(Arrival::Ended(kind)) => self.ended = Some(kind),
            Ok(arrival) => return Ok(Some(arrival)),
            Err(_) => {}
        }
        self.ended.map_or(Ok(None), |kind| Err(io::Error::from(kind).into()))
    }

    /// Sends all of `bytes`.
    ///
    /// # Errors
    /// [`LaserError::Line`].
    pub(super) fn send(&mut self, bytes: &[u8]) -> Result<(), LaserError> {
        Ok(self.writer.write_all(bytes)?)
    }
}

impl Drop for Link {
    /// Waits until the listener has closed the line, so that its port can be opened again.
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(listener) = self.listener.take() {
            // It does nothing that could panic but allocate its stack.
            let _ended = listener.join();
        }
    }
}

fn listen(mut reader: impl Read, mut arrivals: Producer<Arrival>, stop: &AtomicBool, clock: fn() -> TimeNs) {
    while !stop.load(Ordering::Acquire) {
        let mut bytes = [0; CHUNK_BYTES];
        let arrival = match reader.read(&mut bytes) {
            Ok(0) => Arrival::Ended(ErrorKind::BrokenPipe),
            Ok(count) => Arrival::Bytes { t: clock(), count, bytes },
            Err(why) if why.kind() == ErrorKind::WouldBlock => {
                std::thread::sleep(Duration::from_micros(200));
                continue;
            }
            Err(why) if matches!(why.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted) => continue,
            Err(why) => Arrival::Ended(why.kind()),
        };
        // Where the ring is full nobody has listened for seconds; what is lost then is missed as an answer.
        let _full = arrivals.push(arrival);
        if matches!(arrival, Arrival::Ended(_)) {
            return;
        }
    }
}

/// Who else may have the port open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sharing {
    /// Nobody who means to drive the box.
    Alone,
    /// Whoever does: a program that hangs must not keep others from making dark.
    Beside,
}

/// Opens a serial port, raw, 8N1.
///
/// The port is never left exclusive to this process (`TIOCEXCL`), which would keep a second process from making the box
/// dark while this one hangs. An advisory lock tells two programs apart that both mean to drive it.
///
/// # Errors
/// [`LaserError::Open`], [`LaserError::NotAllowed`], [`LaserError::InUse`].
pub(super) fn open_port(path: &Path, baud: u32, sharing: Sharing) -> Result<[TTYPort; 2], LaserError> {
    let name = path.display().to_string();
    let failed = |why| not_opened(path, &why, || unit_keeps(path));
    let builder = serialport::new(name.as_str(), baud).timeout(Duration::ZERO);
    let mut writer = builder.exclusive(sharing == Sharing::Alone).open_native().map_err(failed)?;
    if sharing == Sharing::Alone {
        // Keeps a shared lock, beside which nobody gets an exclusive one.
        writer.set_exclusive(false).map_err(failed)?;
    }
    never_wait(&writer).map_err(|why| LaserError::Open { path: name.clone(), why: why.to_string() })?;
    let mut reader = writer.try_clone_native().map_err(failed)?;
    serialport::SerialPort::set_timeout(&mut reader, READ_TIMEOUT).map_err(failed)?;
    Ok([reader, writer])
}

/// What it means that the port at `path` does not open; `unit_keeps` says whether the service's unit does not allow it.
fn not_opened(path: &Path, why: &serialport::Error, unit_keeps: impl FnOnce() -> bool) -> LaserError {
    let name = path.display().to_string();
    match why.kind() {
        serialport::ErrorKind::NoDevice if path.exists() => LaserError::InUse { path: name },
        serialport::ErrorKind::Io(ErrorKind::ResourceBusy) => LaserError::InUse { path: name },
        serialport::ErrorKind::Io(ErrorKind::PermissionDenied) if unit_keeps() => LaserError::NotAllowed { path: name },
        _ => LaserError::Open { path: name, why: why.to_string() },
    }
}

/// Makes reads of a port whose bytes another program has just taken return at once. Its clones do the same.
fn never_wait(port: &TTYPort) -> io::Result<()> {
    // SAFETY: the port stays open, and so its descriptor valid, for as long as it is borrowed here.
    let port = unsafe { BorrowedFd::borrow_raw(port.as_raw_fd()) };
    let flags = rustix::fs::fcntl_getfl(port)?;
    Ok(rustix::fs::fcntl_setfl(port, flags | rustix::fs::OFlags::NONBLOCK)?)
}

#[cfg(test)]
mod tests {
    use holod_calibration::is_kept_by_unit;

    use super::*;

    #[test]
    fn a_port_that_the_unit_keeps_is_told_from_one_of_another_group() {
        let says = |errno: i32| {
            let error = io::Error::from_raw_os_error(errno);
            let why = serialport::Error::new(serialport::ErrorKind::Io(error.kind()), error.to_string());
            not_opened(Path::new("/dev/null"), &why, || is_kept_by_unit(&error)).to_string()
        };
        let [not_permitted, access, busy] = [1, 13, 16].map(says);
        assert!(not_permitted.starts_with("/dev/null does not open: the service's unit"), "{not_permitted}");
        assert!(access.ends_with("the cable and the port's permissions"), "{access}");
        assert!(busy.contains("in use by another program"), "{busy}");
    }
}
