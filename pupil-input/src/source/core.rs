//! Pupil Labs Core: Pupil Capture's Pupil Remote (ZeroMQ REQ, port 50020) tells the port at which it publishes (SUB).
//!
//! Each read is one published message, without its topic: its map says all. Pupil Remote is asked for Pupil's time twice a
//! second. That shows that Capture is alive where no pupil is published: a tracker that is only silent stays
//! connected, one that answers no more is given up and found again, at whatever port it then publishes.

use std::io;
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use super::server::{OPEN_WITHIN, Server, ServerError, wait};
use super::zmtp::Zmtp;
use super::{ByteSource, Feed, READ_TIMEOUT, ReadEvent, SourceError};
use crate::spec::HostPort;
use crate::wire::core::MAX_MESSAGE_BYTES;

/// All messages about pupils, of both eyes and both detectors.
const SUBSCRIPTION: &[u8] = b"\x01pupil.";
const ASK_EACH: Duration = Duration::from_millis(500);
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
}

struct CoreSource {
    published: Zmtp,
    remote: Zmtp,
    /// When Pupil Remote was asked for the time, or answered.
    asked: Instant,
    answered: Option<Instant>,
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
        Ok(Self { published, remote, asked: Instant::now(), answered: Some(Instant::now()) })
    }

    fn read_by(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<Option<usize>> {
        loop {
            if let Some(message) = self.published.receive()? {
                let count = message.len().min(buffer.len());
                buffer[..count].copy_from_slice(&message[..count]);
                return Ok(Some(count));
            }
            let now = Instant::now();
            if self.remote.receive()?.is_some() {
                self.answered = Some(now);
            }
            match self.answered {
                Some(_) if now - self.asked >= ASK_EACH => {
                    self.remote.request(b"t")?;
                    (self.asked, self.answered) = (now, None);
                }
                None if now - self.asked >= ANSWER_WITHIN => return Err(io::ErrorKind::TimedOut.into()),
                _ => {}
            }
            if now >= deadline {
                return Ok(None);
            }
            wait([self.published.as_fd(), self.remote.as_fd()], deadline)?;
        }
    }
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
