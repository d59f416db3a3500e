//! Where bytes come from: one file for each kind of link, behind one trait.

pub(crate) mod serial;

use std::time::Duration;

use serial::SerialError;

/// How long one read waits; also how soon a stop is noticed.
pub(crate) const READ_TIMEOUT: Duration = Duration::from_millis(50);

/// What one read brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ReadEvent {
    /// This many bytes: a piece of the stream, or one whole message of a link that has messages.
    Bytes(usize),
    /// Nothing within [`READ_TIMEOUT`].
    Silence,
    /// The link is gone.
    Gone,
}

/// An open link to a tracker.
pub(crate) trait ByteSource: Send {
    /// Waits for bytes, no longer than [`READ_TIMEOUT`]. Without allocation while bytes come, where the link permits.
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent;
}

/// How a link is opened, and opened again after it was lost.
pub(crate) trait Feed: Send {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError>;
}

/// Why a tracker cannot be reached.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// A serial port.
    #[error(transparent)]
    Serial(#[from] SerialError),
}
