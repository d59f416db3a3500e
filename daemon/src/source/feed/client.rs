//! One client of the feed: its socket, its shared memory, and whose turn it is with each slot.

use std::io;
use std::os::fd::OwnedFd;

use holod_calibration::{DisplayGeometry, Resolution, TimeNs};
use holod_model::RgbdFrame;
use holod_model::scene::{Fit, LiveError, LiveFormat, LiveReader, LiveReport};
use memmap2::{MmapOptions, MmapRaw};
use rustix::fs::{FallocateFlags, MemfdFlags, SealFlags, fallocate, fcntl_add_seals, ftruncate, memfd_create};
use rustix::io::Errno;
use rustix::net::{RecvFlags, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, recv, send, sendmsg};

use super::message::{self, LONGEST, Layout, Message, Outcome, SLOTS, Wrong};
use super::slots::{Picture, Slots};
use crate::source::PictureView;
use crate::tally_by::Reason;

/// Messages of one client that are read at once, so that a hasty one leaves time to the others.
const MESSAGES_AT_ONCE: usize = 64;

/// A client that has not said by then what its pictures will be like makes way.
const HELLO_WITHIN: TimeNs = TimeNs(5_000_000_000);

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
    /// Reading from its socket or writing to it failed.
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
    /// When it connected; it has a while to say what it sends.
    t_came: TimeNs,
    /// When a picture of it was taken over last; long ago where none was.
    pub(super) t_last: TimeNs,
    /// Whether a picture of it has been taken.
    pub(super) is_known: bool,
    /// Whether it was said that its depths are bad.
    pub(super) told_depths: bool,
    /// Whether it was said that its colours were clipped.
    pub(super) told_colours: bool,
    /// Whether it was said that its pictures are old when they come.
    pub(super) told_age: bool,
    /// Whether its pictures' field of view was looked at.
    pub(super) told_field_of_view: bool,
    stream: Option<Stream>,
}

/// What there is once a client has said what its pictures are like.
pub(super) struct Stream {
    version: u32,
    format: LiveFormat,
    memory: OwnedFd,
    /// The same, to be read. Nobody looks into it but [`Stream::copy_out`].
    mapped: MmapRaw,
    /// Slots whose memory is there.
    is_allocated: [bool; SLOTS],
    layout: Layout,
    slots: Slots,
    /// How the picture in each slot was taken.
    views: [PictureView; SLOTS],
    reader: LiveReader,
}

/// Why there is no stream.
#[derive(Debug, thiserror::Error)]
pub(super) enum StreamError {
    /// The pictures do not fit.
    #[error("HELO: {0}")]
    Format(#[from] LiveError),
    /// There is no memory to share.
    #[error("holod has no memory for these pictures: {0}")]
    Memory(#[from] io::Error),
}

/// Why a picture cannot be taken over.
#[derive(Debug, thiserror::Error)]
pub(super) enum TakeError {
    /// There is no memory for all of it.
    #[error("there is no memory for the picture: {0}")]
    Memory(#[from] io::Error),
    /// It cannot be shown.
    #[error(transparent)]
    Picture(#[from] LiveError),
}

/// A picture's bytes, copied out of the shared memory. The memory is used again for the next one.
#[derive(Debug, Default)]
pub(super) struct Copied {
    bytes: Vec<u8>,
    colour_bytes: usize,
}

impl Copied {
    /// The bytes of the colours, and behind them those of the depths.
    fn parts(&self) -> (&[u8], &[u8]) {
        self.bytes.split_at(self.colour_bytes)
    }
}

impl Stream {
    /// Memory for pictures of `format`, and what makes frames of them, for a client that speaks `version`.
    pub(super) fn open(version: u32, format: LiveFormat, target: &Target) -> Result<Self, StreamError> {
        let reader = LiveReader::new(format, &target.geometry, target.resolution, target.fit)?;
        let layout = Layout::of(&format);
        let memory = shared_memory(layout.bytes()).map_err(io::Error::from)?;
        let mapped = MmapOptions::new().len(layout.bytes()).map_raw_read_only(&memory)?;
        let views = [PictureView::default(); SLOTS];
        let is_allocated = [false; SLOTS];
        Ok(Self { version, format, memory, mapped, is_allocated, layout, slots: Slots::default(), views, reader })
    }

    /// What its pictures are like.
    pub(super) const fn format(&self) -> LiveFormat {
        self.format
    }

    /// How a picture was taken.
    pub(super) const fn view(&self, picture: &Picture) -> PictureView {
        self.views[picture.slot]
    }

    /// The field of view in which an eye sees a whole picture: across and up, degrees.
    pub(super) fn shown_field_of_view_deg(&self, geometry: &DisplayGeometry) -> [f32; 2] {
        let Resolution { width, height } = self.format.resolution;
        [width, height].map(|px| {
            let half = 0.5 * px as f64 * self.reader.scale() * geometry.pixel_angle_rad();
            (2.0 * half.atan()).to_degrees() as f32
        })
    }

    /// What is shared with the client.
    pub(super) const fn memory(&self) -> &OwnedFd {
        &self.memory
    }

    /// Where a picture's colours and its depths begin.
    pub(super) const fn offsets(&self, picture: &Picture) -> [usize; 2] {
        let slot = picture.slot * self.layout.slot_bytes;
        [slot, slot + self.layout.depth_offset]
    }

    /// Copies a picture and says whether it can be shown: all that is done while the client has to wait for its slot.
    pub(super) fn copy_out(&mut self, picture: &Picture, copied: &mut Copied) -> Result<(), TakeError> {
        let Layout { slot_bytes, colour_bytes, depth_bytes, .. } = self.layout;
        if !self.is_allocated[picture.slot] {
            // What its client has not written is not there yet, and there may be no memory for it. Asked for again
            // before each copy it would take half as long as the copy, and a client could still be faster.
            let begin = picture.slot * slot_bytes;
            rustix::io::retry_on_intr(|| {
                fallocate(&self.memory, FallocateFlags::empty(), begin as u64, slot_bytes as u64)
            })
            .map_err(io::Error::from)?;
            self.is_allocated[picture.slot] = true;
        }
        copied.bytes.resize(colour_bytes + depth_bytes, 0);
        copied.colour_bytes = colour_bytes;
        let (colour, depth) = copied.bytes.split_at_mut(colour_bytes);
        let [colour_at, depth_at] = self.offsets(picture);
        self.copy_part(colour, colour_at);
        self.copy_part(depth, depth_at);
        Ok(self.reader.check(depth)?)
    }

    /// Copies what begins at `at` in the shared memory. The kernel would do the same by `pread`, page by page, in three
    /// times the time.
    fn copy_part(&self, part: &mut [u8], at: usize) {
        assert!(at + part.len() <= self.mapped.len(), "within the shared memory");
        // SAFETY: what is read lies within the mapping, which lives as long as `self` and cannot be made shorter (it is
        // sealed). No reference into it is made. A client that breaks the rules may write meanwhile, and then the copy
        // holds some of its old and some of its new bytes: of bytes, and of all that is made of them, every value is
        // allowed. It may also punch holes into it, which only a seal against its own writing would forbid: to read one
        // takes new memory, of zeros, never more than it had given back. Where the machine has none left the kernel
        // ends this process (out of memory, or by SIGBUS), as it may at any new page; nothing undefined is read.
        unsafe { std::ptr::copy_nonoverlapping(self.mapped.as_ptr().add(at), part.as_mut_ptr(), part.len()) }
    }

    /// Makes `frame`, which has the target's size, of a picture that was copied.
    pub(super) fn make(&mut self, copied: &Copied, frame: &mut RgbdFrame) -> Result<LiveReport, LiveError> {
        let (colour, depth) = copied.parts();
        self.reader.make(colour, depth, frame)
    }
}

impl Client {
    /// A client that has connected at host time `now`.
    pub(super) fn new(socket: OwnedFd, number: u64, now: TimeNs) -> Self {
        Self {
            socket,
            name: format!("connection {number}"),
            t_came: now,
            t_last: TimeNs(i64::MIN / 2),
            is_known: false,
            told_depths: false,
            told_colours: false,
            told_age: false,
            told_field_of_view: false,
            stream: None,
        }
    }

    /// Reads what it has sent. Pictures that are overtaken or refused by their numbers are freed, with `note` told of
    /// each.
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
            (Message::Hello { version, format, name }, stream) => {
                let opened = match Stream::open(version, format, target) {
                    Ok(opened) => opened,
                    Err(why) => return Ok(Err(self.show_out(Refusal::Pictures, &why.to_string()))),
                };
                self.name = name;
                let stream = stream.insert(opened);
                Ok(send_ring(&self.socket, stream))
            }
            (Message::Frame { slot, sequence, t_taken, view }, Some(stream)) => {
                if stream.version == 1 && view != PictureView::default() {
                    return Err(Wrong(
                        "FRAM: reserved bytes that are not 0 were found, expected 0 in version 1".into(),
                    ));
                }
                let freed = stream.slots.hand_over(slot, sequence, t_taken, now)?;
                stream.views[slot as usize] = view;
                match freed {
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

    /// Shows it out where it has not said by host time `now` what its pictures will be like.
    pub(super) fn expect_hello(&self, now: TimeNs) -> Result<(), Gone> {
        if self.stream.is_some() || now - self.t_came < HELLO_WITHIN {
            return Ok(());
        }
        let why = format!("nothing was found for {} s, expected HELO", HELLO_WITHIN.seconds());
        Err(self.show_out(Refusal::Protocol, &why))
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

    /// What its pictures go through.
    pub(super) fn stream(&mut self) -> &mut Stream {
        self.stream.as_mut().expect("only a stream has pictures")
    }

    /// Gives a slot back, and says what became of its picture.
    pub(super) fn free(&mut self, picture: &Picture, outcome: &Outcome) -> Result<(), Gone> {
        if let Some(stream) = &mut self.stream {
            stream.slots.free(picture);
        }
        let freed = message::free(picture.slot as u32, picture.sequence, outcome);
        match send(&self.socket, &freed, SendFlags::DONTWAIT | SendFlags::NOSIGNAL) {
            // It has closed, and may have handed over another picture before: its end is read behind that.
            Ok(_) | Err(Errno::PIPE | Errno::CONNRESET) => Ok(()),
            Err(error) => Err(error.into()),
        }
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
