//! One client of the feed: its socket, its shared memory, and whose turn it is with each slot.

use std::io;
use std::os::fd::OwnedFd;

use holod_calibration::{DisplayGeometry, Resolution, TimeNs};
use holod_model::RgbdFrame;
use holod_model::scene::{Fit, FrameReport, LiveError, LivePart, LiveReader};
use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create};
use rustix::io::{Errno, pread};
use rustix::net::{RecvFlags, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, recv, send, sendmsg};

use super::message::{self, LONGEST, Layout, Message, Outcome, Wrong};
use super::slots::{Picture, Slots};
use crate::tally_by::Reason;

/// Messages of one client that are read at once, so that a hasty one leaves time to the others.
const MESSAGES_AT_ONCE: usize = 64;

/// What every client's pictures become.
#[derive(Clone, Debug)]
pub(super) struct Target {
    pub(super) geometry: DisplayGeometry,
    pub(super) resolution: Resolution,
    pub(super) fit: Fit,
}

/// Why a client is gone.
#[derive(Debug)]
pub(super) enum Gone {
    /// It closed its end, or died.
    Closed,
    /// It was shown out, and told why.
    Refused(Refusal, String),
}

/// Why a client is shown out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// There are as many clients as there may be.
    Full,
    /// It broke the protocol's rules.
    Protocol,
    /// Its pictures do not fit the hologram, or the memory.
    Pictures,
    /// It does not read what holod sends.
    Deaf,
    /// Its socket failed.
    Socket,
}

impl Reason for Refusal {
    const ALL: &'static [Self] = &[Self::Full, Self::Protocol, Self::Pictures, Self::Deaf, Self::Socket];

    fn name(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Protocol => "protocol",
            Self::Pictures => "pictures",
            Self::Deaf => "deaf",
            Self::Socket => "socket",
        }
    }
}

impl From<Errno> for Gone {
    fn from(error: Errno) -> Self {
        match error {
            Errno::AGAIN => Self::Refused(Refusal::Deaf, "it does not read what holod sends".into()),
            Errno::PIPE | Errno::CONNRESET => Self::Closed,
            other => Self::Refused(Refusal::Socket, format!("its socket: {other}")),
        }
    }
}

/// A client that is connected.
pub(super) struct Client {
    pub(super) socket: OwnedFd,
    pub(super) name: String,
    /// When it handed its last picture over.
    pub(super) t_last: TimeNs,
    /// Whether a picture of it has been taken.
    pub(super) is_known: bool,
    stream: Option<Stream>,
}

/// What there is once a client has said what its pictures are like.
struct Stream {
    memory: OwnedFd,
    layout: Layout,
    slots: Slots,
    reader: LiveReader,
}

impl Client {
    pub(super) fn new(socket: OwnedFd, number: u64) -> Self {
        Self {
            socket,
            name: format!("connection {number}"),
            t_last: TimeNs(i64::MIN / 2),
            is_known: false,
            stream: None,
        }
    }

    /// Reads what it has sent. Pictures that are overtaken or refused by their numbers are freed, with `note` told of each.
    pub(super) fn receive(
        &mut self,
        target: &Target,
        clock: impl Fn() -> TimeNs,
        mut note: impl FnMut(&Outcome),
    ) -> Result<(), Gone> {
        let mut bytes = [0; LONGEST + 1];
        let mut was_reset = false;
        for _ in 0..MESSAGES_AT_ONCE {
            let length = match recv(&self.socket, &mut bytes, RecvFlags::DONTWAIT) {
                // Said once of a client that closed before it had read everything; what it sent before that comes next.
                Err(Errno::CONNRESET) if !std::mem::replace(&mut was_reset, true) => continue,
                // What it handed over before is shown first.
                Ok((0, _)) | Err(Errno::CONNRESET) if self.has_picture() => break,
                Ok((0, _)) => return Err(Gone::Closed),
                Ok((length, _)) => length,
                Err(Errno::AGAIN) => break,
                Err(Errno::INTR) => continue,
                Err(error) => return Err(error.into()),
            };
            let heard =
                Message::parse(&bytes[..length]).and_then(|message| self.hear(message, target, clock(), &mut note));
            heard.map_err(|Wrong(why)| self.show_out(Refusal::Protocol, &why))??;
        }
        Ok(())
    }

    fn hear(
        &mut self,
        message: Message,
        target: &Target,
        now: TimeNs,
        note: &mut impl FnMut(&Outcome),
    ) -> Result<Result<(), Gone>, Wrong> {
        match (message, &mut self.stream) {
            (Message::Hello { .. }, Some(_)) => Err(Wrong("HELO: a second one was found, expected FRAM".into())),
            (Message::Frame { .. }, None) => Err(Wrong("FRAM: was found first, expected HELO".into())),
            (Message::Hello { format, name }, stream) => {
                let layout = Layout::of(&format);
                let fits = LiveReader::new(format, &target.geometry, target.resolution, target.fit)
                    .map_err(|error| format!("HELO: {error}"));
                let opened = fits.and_then(|reader| {
                    let memory = shared_memory(layout.bytes());
                    let memory = memory.map_err(|error| format!("holod has no memory for these pictures: {error}"))?;
                    Ok((reader, memory))
                });
                let (reader, memory) = match opened {
                    Ok(opened) => opened,
                    Err(why) => return Ok(Err(self.show_out(Refusal::Pictures, &why))),
                };
                self.name = name;
                let stream = stream.insert(Stream { memory, layout, slots: Slots::default(), reader });
                Ok(send_ring(&self.socket, stream))
            }
            (Message::Frame { slot, sequence, t_taken }, Some(stream)) => {
                self.t_last = now;
                match stream.slots.hand_over(slot, sequence, t_taken.unwrap_or(now))? {
                    None => Ok(Ok(())),
                    Some((picture, outcome)) => {
                        note(&outcome);
                        match self.free(&picture, &outcome) {
                            // There may be more that it has said before its end.
                            Err(Gone::Closed) => Ok(Ok(())),
                            freed => Ok(freed),
                        }
                    }
                }
            }
        }
    }

    /// Whether a picture of it waits.
    pub(super) fn has_picture(&self) -> bool {
        self.stream.as_ref().is_some_and(|stream| stream.slots.has_picture())
    }

    /// Its newest picture, which must be freed.
    pub(super) fn take(&mut self) -> Option<Picture> {
        self.stream.as_mut()?.slots.take()
    }

    /// Whether its pictures are without depth.
    pub(super) fn sends_planes(&self) -> bool {
        self.stream.as_ref().is_some_and(|stream| stream.layout.depth_bytes == 0)
    }

    /// Pictures that it says it left out.
    pub(super) fn left_out(&self) -> u64 {
        self.stream.as_ref().map_or(0, |stream| stream.slots.left_out)
    }

    /// Reads a picture into `frame`, which has the target's size.
    pub(super) fn read(&mut self, picture: &Picture, frame: &mut RgbdFrame) -> Result<FrameReport, LiveError> {
        let Stream { memory, layout, reader, .. } = self.stream.as_mut().expect("only a stream has pictures");
        let slot = picture.slot * layout.slot_bytes;
        let read_at = |part, bytes: &mut [u8], at: usize| {
            let part = if part == LivePart::Colour { 0 } else { layout.depth_offset };
            read_whole(memory, bytes, slot + part + at)
        };
        reader.read(read_at, frame)
    }

    /// Gives a slot back, and says what became of its picture.
    pub(super) fn free(&mut self, picture: &Picture, outcome: &Outcome) -> Result<(), Gone> {
        if let Some(stream) = &mut self.stream {
            stream.slots.free(picture);
        }
        let freed = message::free(picture.slot as u32, picture.sequence, outcome);
        send(&self.socket, &freed, SendFlags::DONTWAIT | SendFlags::NOSIGNAL)?;
        Ok(())
    }

    /// Tells it why it has to go.
    pub(super) fn show_out(&self, refusal: Refusal, why: &str) -> Gone {
        // It may be gone already, or deaf.
        let _told = send(&self.socket, &message::nope(why), SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
        Gone::Refused(refusal, why.to_owned())
    }
}

/// Memory that nobody can make shorter under a reader.
fn shared_memory(bytes: usize) -> rustix::io::Result<OwnedFd> {
    let memory = memfd_create("holod-feed", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
    ftruncate(&memory, bytes as u64)?;
    fcntl_add_seals(&memory, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)?;
    Ok(memory)
}

fn send_ring(socket: &OwnedFd, stream: &Stream) -> Result<(), Gone> {
    let memory = [std::os::fd::AsFd::as_fd(&stream.memory)];
    let mut space = [std::mem::MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    control.push(SendAncillaryMessage::ScmRights(&memory));
    let ring = stream.layout.ring();
    sendmsg(socket, &[io::IoSlice::new(&ring)], &mut control, SendFlags::DONTWAIT | SendFlags::NOSIGNAL)?;
    Ok(())
}

fn read_whole(memory: &OwnedFd, mut bytes: &mut [u8], mut at: usize) -> io::Result<()> {
    while !bytes.is_empty() {
        match pread(memory, &mut *bytes, at as u64) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(length) => {
                bytes = &mut bytes[length..];
                at += length;
            }
            Err(Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(())
}
