//! Pupil Labs Core: Pupil Capture's Pupil Remote (ZeroMQ REQ, port 50020) tells the port at which it publishes (SUB).
//!
//! Each read is one published message, without its topic: its map says all. Pupil Remote is asked for Pupil's time four
//! times a second, and its answer given as a message too ([`time_message`]): an answer comes within about a
//! millisecond of the time that it tells, a sample tens of them after the time of its image. The answers also show that
//! Capture is alive where no pupil is published: a tracker that is only silent stays connected, one that answers no
//! more is given up and found again, at whatever port it then publishes.

use std::io;
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use super::server::{OPEN_WITHIN, Server, ServerError, wait};
use super::zmtp::Zmtp;
use super::{ByteSource, Feed, READ_TIMEOUT, ReadEvent, SourceError};
use crate::spec::HostPort;
use crate::wire::pupil_labs_core::{MAX_MESSAGE_BYTES, time_message};

/// All messages about pupils, of both eyes and both detectors.
const SUBSCRIPTION: &[u8] = b"\x01pupil.";
const ASK_EACH: Duration = Duration::from_millis(250);
/// Capture may be busy for a while, as when a camera is plugged in.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);

/// A Pupil Remote by its address.
pub(crate) struct CoreFeed {
    pub(crate) address: HostPort,
}

impl Feed for CoreFeed {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError> {
        Ok(Box::new(CoreSource::open(&self.address)?))
    }

    fn datagrams(&self) -> bool {
        true
    }
}

struct CoreSource {
    published: Zmtp,
    remote: Zmtp,
    /// When Pupil Remote was last asked for the time.
    asked: Instant,
    answered: bool,
    /// Whether something was published since a time was last given: times alone are no sign of a tracker that tracks.
    heard: bool,
}

impl CoreSource {
    fn open(address: &HostPort) -> Result<Self, ServerError> {
        const HINT: &str = "start Pupil Capture, enable its Pupil Remote plugin, and name the port shown there";
        let mut server = Server { name: "Pupil Remote", address, hint: HINT, deadline: Instant::now() };
        let addresses = server.resolve()?;
        server.deadline = Instant::now() + OPEN_WITHIN;
        let stream = server.connect(&addresses)?;
        let host = stream.peer_addr().map_err(|error| server.broken(error))?.ip();
        let broken = |error| server.broken(error);
        let mut remote = Zmtp::open(stream, "REQ", &["REP", "ROUTER"], 256, server.deadline).map_err(broken)?;
        remote.request(b"SUB_PORT").map_err(broken)?;
        let answer = remote.receive_by(server.deadline).map_err(broken)?;
        let port = std::str::from_utf8(answer).ok().and_then(|text| text.trim().parse().ok());
        let port = port.ok_or_else(|| server.unexpected(answer, "a port as the answer to SUB_PORT", HINT))?;

        let published = server.connect(&[SocketAddr::new(host, port)])?;
        // A byte more than is read, so that one too long is known as such.
        let longest = MAX_MESSAGE_BYTES + 1;
        let mut published = Zmtp::open(published, "SUB", &["PUB", "XPUB"], longest, server.deadline).map_err(broken)?;
        published.send(SUBSCRIPTION).map_err(broken)?;
        remote.request(b"t").map_err(broken)?;
        Ok(Self { published, remote, asked: Instant::now(), answered: false, heard: true })
    }

    fn read_by(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<Option<usize>> {
        loop {
            if let Some(answer) = self.remote.receive()? {
                self.answered = true;
                let time_s = std::str::from_utf8(answer).ok().and_then(|text| text.trim().parse().ok());
                if let Some(time_s) = time_s.filter(|time_s: &f64| self.heard && time_s.is_finite()) {
                    self.heard = false;
                    return Ok(Some(give(&time_message(time_s), buffer)));
                }
            }
            let now = Instant::now();
            if self.answered && now - self.asked >= ASK_EACH {
                self.remote.request(b"t")?;
                (self.asked, self.answered) = (now, false);
            } else if !self.answered && now - self.asked >= ANSWER_WITHIN {
                return Err(io::ErrorKind::TimedOut.into());
            }
            if let Some(message) = self.published.receive()? {
                self.heard = true;
                return Ok(Some(give(message, buffer)));
            }
            if now >= deadline {
                return Ok(None);
            }
            wait([self.published.as_fd(), self.remote.as_fd()], deadline)?;
        }
    }
}

fn give(message: &[u8], buffer: &mut [u8]) -> usize {
    let count = message.len().min(buffer.len());
    buffer[..count].copy_from_slice(&message[..count]);
    count
}

impl ByteSource for CoreSource {
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent {
        match self.read_by(buffer, Instant::now() + READ_TIMEOUT) {
            Ok(Some(count)) => ReadEvent::Bytes(count),
            Ok(None) => ReadEvent::Silence,
            Err(_) => ReadEvent::Gone,
        }
    }
}
