//! The part of ZeroMQ that Pupil Capture speaks: ZMTP 3.0 over TCP without authentication (RFC 23), as the side that
//! connects, for a SUB or a REQ socket.
//!
//! This is written here since the crates that there are reserve what memory a peer's frame header asks for (nine bytes
//! end the program), allocate for each message, and hide that a connection was lost.

use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::os::fd::{AsFd, BorrowedFd};
use std::time::Instant;

use super::server::wait;

const GREETING_BYTES: usize = 64;
/// A longer frame is none that was asked for, and the connection is given up.
const LONGEST_FRAME: u64 = 1 << 20;

/// One end of a connection.
pub(super) struct Zmtp {
    stream: TcpStream,
    /// Bytes read and not looked at.
    input: Box<[u8]>,
    begin: usize,
    end: usize,
    state: State,
    /// The message so far: its second part, or its only one.
    content: Vec<u8>,
    part: usize,
}

#[derive(Clone, Copy)]
enum State {
    Header,
    Body { frame: Frame, left: u64 },
}

#[derive(Clone, Copy)]
struct Frame {
    command: bool,
    more: bool,
}

impl Zmtp {
    /// Greets the peer over a new, not blocking connection. The peer must be one of `peers`, socket types.
    ///
    /// # Errors
    /// `InvalidData` where the peer speaks something else.
    pub(super) fn open(
        stream: TcpStream,
        socket_type: &str,
        peers: &[&str],
        content_bytes: usize,
        deadline: Instant,
    ) -> io::Result<Self> {
        let mut zmtp = Self {
            stream,
            input: vec![0; 8192].into(),
            begin: 0,
            end: 0,
            state: State::Header,
            content: Vec::with_capacity(content_bytes),
            part: 0,
        };
        let mut greeting = [0; GREETING_BYTES];
        greeting[0] = 0xff;
        greeting[9] = 0x7f;
        greeting[10] = 3;
        greeting[12..16].copy_from_slice(b"NULL");
        zmtp.stream.write_all(&greeting)?;
        while zmtp.end < GREETING_BYTES {
            zmtp.fill_by(deadline)?;
            let found = &zmtp.input[..zmtp.end.min(10)];
            if found[0] != 0xff || found.get(9).is_some_and(|byte| *byte & 1 == 0) {
                return Err(other(format!("it is no ZeroMQ socket: it begins with `{}`", found.escape_ascii())));
            }
        }
        let (version, mechanism) = (zmtp.input[10], &zmtp.input[12..32]);
        if version < 3 || !mechanism.starts_with(b"NULL\0") {
            let mechanism = mechanism.escape_ascii();
            return Err(other(format!("it wants ZMTP version {version} and `{mechanism}`, not version 3 and NULL")));
        }
        zmtp.begin = GREETING_BYTES;

        let mut ready = b"\x05READY\x0bSocket-Type".to_vec();
        ready.extend((socket_type.len() as u32).to_be_bytes());
        ready.extend(socket_type.as_bytes());
        zmtp.send_frame(4, &ready)?;
        loop {
            match zmtp.next_frame()? {
                Some(frame) if frame.command => break,
                Some(_) => return Err(other("it sends messages before it says that it is ready".into())),
                None => zmtp.fill_by(deadline)?,
            }
        }
        let peer = zmtp.content.strip_prefix(b"\x05READY").and_then(peer_type);
        if peer.is_none_or(|peer| !peers.iter().any(|known| known.as_bytes() == peer)) {
            let found = peer.unwrap_or(&zmtp.content).escape_ascii();
            return Err(other(format!("it is a ZeroMQ socket of type `{found}`, not {}", peers[0])));
        }
        Ok(zmtp)
    }

    /// Sends a message of one part, to a PUB socket: a subscription.
    pub(super) fn send(&mut self, message: &[u8]) -> io::Result<()> {
        self.send_frame(0, message)
    }

    /// Sends a request: an empty part, then its text.
    pub(super) fn request(&mut self, text: &[u8]) -> io::Result<()> {
        self.send_frame(1, b"")?;
        self.send_frame(0, text)
    }

    /// Few and short messages are sent, so that the system's buffer has room for each; else the peer does not read.
    fn send_frame(&mut self, flags: u8, body: &[u8]) -> io::Result<()> {
        let mut frame = [0; 2 + 255];
        frame[0] = flags;
        frame[1] = u8::try_from(body.len()).map_err(|_| ErrorKind::InvalidInput)?;
        frame[2..][..body.len()].copy_from_slice(body);
        self.stream.write_all(&frame[..2 + body.len()])
    }

    /// The next message that has come: of several parts the second one, cut to the bytes that were asked for.
    pub(super) fn receive(&mut self) -> io::Result<Option<&[u8]>> {
        // Once, so that a peer that sends more and more does not keep the caller.
        let mut filled = false;
        loop {
            match self.next_frame()? {
                Some(frame) if frame.command => {}
                Some(frame) if frame.more => self.part += 1,
                Some(_) => {
                    self.part = 0;
                    return Ok(Some(&self.content));
                }
                None if !filled && self.fill()? => filled = true,
                None => return Ok(None),
            }
        }
    }

    /// As [`Self::receive`], but waits.
    pub(super) fn receive_by(&mut self, deadline: Instant) -> io::Result<&[u8]> {
        while self.receive()?.is_none() {
            self.fill_by(deadline)?;
        }
        Ok(&self.content)
    }

    /// The next whole frame among the bytes read.
    fn next_frame(&mut self) -> io::Result<Option<Frame>> {
        loop {
            let bytes = &self.input[self.begin..self.end];
            match &mut self.state {
                State::Header => {
                    let (flags, left, used) = match bytes {
                        [flags, length, ..] if flags & 2 == 0 => (*flags, u64::from(*length), 2),
                        [flags, length @ ..] if flags & 2 != 0 && length.len() >= 8 => {
                            (*flags, u64::from_be_bytes(length[..8].try_into().expect("eight bytes")), 9)
                        }
                        _ => return Ok(None),
                    };
                    if left > LONGEST_FRAME || flags & !7 != 0 {
                        return Err(other(format!("it sends a frame of {left} bytes and flags {flags:#x}")));
                    }
                    self.begin += used;
                    let frame = Frame { command: flags & 4 != 0, more: flags & 1 != 0 };
                    if frame.command || self.part < 2 {
                        self.content.clear();
                    }
                    self.state = State::Body { frame, left };
                }
                State::Body { frame, left } => {
                    let now = bytes.len().min(usize::try_from(*left).unwrap_or(usize::MAX));
                    if frame.command || self.part < 2 {
                        let room = self.content.capacity() - self.content.len();
                        self.content.extend_from_slice(&bytes[..now.min(room)]);
                    }
                    self.begin += now;
                    *left -= now as u64;
                    if *left > 0 {
                        return Ok(None);
                    }
                    let frame = *frame;
                    self.state = State::Header;
                    return Ok(Some(frame));
                }
            }
        }
    }

    /// Reads what has come; false if nothing has.
    fn fill(&mut self) -> io::Result<bool> {
        self.input.copy_within(self.begin..self.end, 0);
        (self.begin, self.end) = (0, self.end - self.begin);
        match self.stream.read(&mut self.input[self.end..]) {
            Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
            Ok(count) => {
                self.end += count;
                Ok(true)
            }
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(false),
            Err(error) => Err(error),
        }
    }

    fn fill_by(&mut self, deadline: Instant) -> io::Result<()> {
        while !self.fill()? {
            if Instant::now() >= deadline {
                return Err(ErrorKind::TimedOut.into());
            }
            wait([self.stream.as_fd()], deadline)?;
        }
        Ok(())
    }
}

impl AsFd for Zmtp {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.stream.as_fd()
    }
}

/// The socket type among the properties of a READY command: each a name behind its length (8 bits), and a value (32).
fn peer_type(mut properties: &[u8]) -> Option<&[u8]> {
    loop {
        let (&length, rest) = properties.split_first()?;
        let (name, rest) = rest.split_at_checked(usize::from(length))?;
        let (length, rest) = rest.split_first_chunk()?;
        let (value, rest) = rest.split_at_checked(usize::try_from(u32::from_be_bytes(*length)).ok()?)?;
        if name.eq_ignore_ascii_case(b"Socket-Type") {
            return Some(value);
        }
        properties = rest;
    }
}

fn other(problem: String) -> io::Error {
    io::Error::new(ErrorKind::InvalidData, problem)
}
