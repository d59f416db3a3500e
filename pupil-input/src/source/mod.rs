//! Where bytes come from: one file for each kind of link, behind one trait.

pub(crate) mod commands;
pub(crate) mod hid;
pub(crate) mod neon;
pub(crate) mod pupil_labs_core;
pub(crate) mod serial;
pub(crate) mod server;
pub(crate) mod tcp;
pub(crate) mod udp;
mod zmtp;

use std::time::Duration;

use hid::HidError;
use serial::SerialError;
use server::ServerError;
use tcp::NetworkError;

/// How long one read waits; also how soon a stop is noticed.
pub(crate) const READ_TIMEOUT: Duration = Duration::from_millis(50);

/// No read brings more bytes: the longest datagram there is.
pub(crate) const LONGEST_READ: usize = 1 << 16;

/// What one read brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ReadEvent {
    /// This many bytes: a piece of the stream, or one whole message of a link that has messages.
    Bytes(usize),
    /// Nothing came within [`READ_TIMEOUT`].
    Silence,
    /// A message of a sender that is not followed.
    Stranger,
    /// The link is gone.
    Gone,
}

/// An open link to a tracker.
pub(crate) trait ByteSource: Send {
    /// Waits for bytes, no longer than [`READ_TIMEOUT`]. Without allocation while bytes come, where the link permits.
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent;

    /// A sample was in the bytes that were read last.
    fn is_followed(&mut self) {}
}

/// How a link is opened, and opened again after it was lost.
pub(crate) trait Feed: Send {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError>;

    /// Whether each read is a message that stands for itself: what is incomplete at its end stays so.
    fn datagrams(&self) -> bool {
        false
    }

    /// The report descriptor of the device that was opened last, where it is a HID device.
    fn descriptor(&self) -> Option<&[u8]> {
        None
    }

    /// Why links that do open bring nothing, while that goes on.
    fn trouble(&self) -> Option<String> {
        None
    }

    /// What a user should know of the link although it opens, a sentence each.
    fn warnings(&self) -> Vec<String> {
        Vec::new()
    }
}

/// Why a tracker cannot be reached.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// Why a serial port cannot be used.
    #[error(transparent)]
    Serial(#[from] SerialError),
    /// A TCP or UDP link.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// Why a HID device cannot be used.
    #[error(transparent)]
    Hid(#[from] HidError),
    /// The server of a Pupil Labs tracker.
    #[error(transparent)]
    Server(#[from] ServerError),
}
