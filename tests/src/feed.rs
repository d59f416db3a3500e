//! A client of the live feed, for tests: it says whatever bytes it is told to.

use std::io;
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::pwrite;
use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendFlags, SocketAddrUnix, SocketFlags,
    SocketType, connect, recvmsg, send, socket_with,
};

/// A connection to a feed.
pub struct FeedClient {
    socket: OwnedFd,
    memory: Option<OwnedFd>,
    slot_bytes: u64,
    depth_offset: u64,
}

/// What holod said.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer {
    /// `RING`: the memory came with it.
    Ring,
    /// `FREE`.
    Free {
        /// The slot.
        slot: u32,
        /// The picture's number.
        sequence: u64,
        /// What became of it.
        outcome: u32,
        /// Why it was refused.
        text: String,
    },
    /// `NOPE`.
    Nope(String),
    /// holod closed the connection.
    Closed,
}

/// Of the numbers of `HELO`: RGBA8 pictures of a size, with millimetres (or, as a plane, none).
pub fn hello(width: u32, height: u32, plane_dpt: Option<f32>, name: &str) -> [u8; 64] {
    let mut bytes = [0; 64];
    bytes[..4].copy_from_slice(b"HELO");
    let depth = u32::from(plane_dpt.is_none());
    let plane = plane_dpt.unwrap_or_default().to_bits();
    for (cell, number) in bytes[4..28].chunks_exact_mut(4).zip([1, width, height, 1, depth, plane]) {
        cell.copy_from_slice(&number.to_ne_bytes());
    }
    bytes[32..][..name.len()].copy_from_slice(name.as_bytes());
    bytes
}

impl FeedClient {
    /// Connects.
    ///
    /// # Errors
    /// Nobody listens there.
    pub fn connect(path: &Path) -> io::Result<Self> {
        let socket = socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)?;
        connect(&socket, &SocketAddrUnix::new(path)?)?;
        Ok(Self { socket, memory: None, slot_bytes: 0, depth_offset: 0 })
    }

    /// Sends a message as it is.
    ///
    /// # Errors
    /// The connection is closed.
    pub fn say(&self, bytes: &[u8]) -> io::Result<()> {
        send(&self.socket, bytes, SendFlags::NOSIGNAL)?;
        Ok(())
    }

    /// The next answer.
    ///
    /// # Panics
    /// Where none comes within ten seconds, or it is none that the protocol has.
    pub fn answer(&mut self) -> Answer {
        self.answer_within(Duration::from_secs(10)).expect("holod answers")
    }

    /// The next answer; none where none comes within `patience`.
    ///
    /// # Panics
    /// Where it is none that the protocol has.
    pub fn answer_within(&mut self, patience: Duration) -> Option<Answer> {
        let patience = Timespec { tv_sec: patience.as_secs() as i64, tv_nsec: patience.subsec_nanos().into() };
        let mut waited = [PollFd::new(&self.socket, PollFlags::IN)];
        if poll(&mut waited, Some(&patience)).unwrap() == 0 {
            return None;
        }
        let mut bytes = [0; 1024];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let received =
            recvmsg(&self.socket, &mut [io::IoSliceMut::new(&mut bytes)], &mut control, RecvFlags::CMSG_CLOEXEC);
        let Ok(received) = received else { return Some(Answer::Closed) };
        let bytes = &bytes[..received.bytes];
        let u32_at = |at: usize| u32::from_ne_bytes(bytes[at..at + 4].try_into().unwrap());
        let u64_at = |at: usize| u64::from_ne_bytes(bytes[at..at + 8].try_into().unwrap());
        let text = |from: usize| String::from_utf8(bytes[from..].to_vec()).unwrap();
        Some(match bytes.get(..4) {
            None => Answer::Closed,
            Some(b"RING") => {
                (self.slot_bytes, self.depth_offset) = (u64_at(8), u64_at(32));
                for message in control.drain() {
                    if let RecvAncillaryMessage::ScmRights(mut descriptors) = message {
                        self.memory = descriptors.next();
                    }
                }
                assert!(self.memory.is_some(), "memory comes with RING");
                Answer::Ring
            }
            Some(b"FREE") => Answer::Free { slot: u32_at(4), sequence: u64_at(8), outcome: u32_at(16), text: text(24) },
            Some(b"NOPE") => Answer::Nope(text(4)),
            Some(other) => panic!("{other:?}"),
        })
    }

    /// Writes a picture's bytes into a slot.
    ///
    /// # Panics
    /// Where there is no memory yet, or not enough.
    pub fn write(&self, slot: u32, colour: &[u8], depth: &[u8]) {
        let memory = self.memory.as_ref().expect("HELO was answered");
        let slot = u64::from(slot) * self.slot_bytes;
        for (bytes, at) in [(colour, slot), (depth, slot + self.depth_offset)] {
            assert_eq!(pwrite(memory, bytes, at).unwrap(), bytes.len());
        }
    }

    /// Hands a slot over.
    ///
    /// # Errors
    /// The connection is closed.
    pub fn hand_over(&self, slot: u32, sequence: u64, t_taken_ns: i64) -> io::Result<()> {
        self.hand_over_with(slot, sequence, t_taken_ns, 0, [0.0; 3])
    }

    /// The same with the optional figures of version 2: which are given, the focus in dioptres, the field of view in
    /// degrees.
    ///
    /// # Errors
    /// The connection is closed.
    pub fn hand_over_with(
        &self,
        slot: u32,
        sequence: u64,
        t_taken_ns: i64,
        given: u32,
        figures: [f32; 3],
    ) -> io::Result<()> {
        let mut bytes = [0; 40];
        bytes[..4].copy_from_slice(b"FRAM");
        bytes[4..8].copy_from_slice(&slot.to_ne_bytes());
        bytes[8..16].copy_from_slice(&sequence.to_ne_bytes());
        bytes[16..24].copy_from_slice(&t_taken_ns.to_ne_bytes());
        for (cell, bits) in bytes[24..].chunks_exact_mut(4).zip([given].into_iter().chain(figures.map(f32::to_bits))) {
            cell.copy_from_slice(&bits.to_ne_bytes());
        }
        self.say(&bytes)
    }

    /// The shared memory, to do forbidden things with.
    pub fn memory(&self) -> Option<&OwnedFd> {
        self.memory.as_ref()
    }
}
