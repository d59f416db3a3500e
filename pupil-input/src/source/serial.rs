//! A serial port or PTY: opened exclusively, read with a timeout.

use serialport::TTYPort;
use std::io::{ErrorKind, Read};
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};

use super::{ByteSource, Feed, READ_TIMEOUT, ReadEvent, SourceError};

/// Why a serial tracker could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum SerialError {
    /// There is nothing at the path.
    #[error(
        "tracker port {path} does not exist; {ports}; plug the tracker in, name its port (best by /dev/serial/by-id), or correct the name of the log"
    )]
    Missing {
        /// The path.
        path: PathBuf,
        /// The ports there are, in words.
        ports: String,
    },
    /// What is there is no serial port.
    #[error("tracker port {path} is {found}; expected a serial port; {hint}")]
    NotAPort {
        /// The path.
        path: PathBuf,
        /// What it is.
        found: &'static str,
        /// What to do.
        hint: String,
    },
    /// It is there and does not open.
    #[error("tracker port {path} does not open: {reason}; {hint}")]
    Open {
        /// The path.
        path: PathBuf,
        /// Why.
        reason: String,
        /// What to do.
        hint: &'static str,
    },
}

/// A port by its path.
pub(crate) struct SerialFeed {
    pub(crate) path: PathBuf,
    pub(crate) baud: u32,
}

impl Feed for SerialFeed {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError> {
        Ok(Box::new(SerialSource::open(&self.path, self.baud)?))
    }
}

struct SerialSource {
    port: TTYPort,
}

impl SerialSource {
    /// Opens `path`, saying what is wrong and what to do about it.
    fn open(path: &Path, baud: u32) -> Result<Self, SerialError> {
        check_kind(path)?;
        let builder = serialport::new(path.to_string_lossy(), baud).timeout(READ_TIMEOUT);
        match TTYPort::open(&builder) {
            Ok(port) => Ok(Self { port }),
            Err(error) => {
                let hint = match error.kind() {
                    serialport::ErrorKind::NoDevice => "is another program using it? close that one first",
                    serialport::ErrorKind::Io(ErrorKind::PermissionDenied) => {
                        "add the user to the port's group (often `dialout`) and log in again"
                    }
                    _ => "check the path, the cable and the tracker's power",
                };
                Err(SerialError::Open { path: path.into(), reason: error.to_string(), hint })
            }
        }
    }
}

impl ByteSource for SerialSource {
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent {
        match self.port.read(buffer) {
            // End of file: some drivers tell an unplugged device in this way, at once and for ever.
            Ok(0) => ReadEvent::Gone,
            Ok(count) => ReadEvent::Bytes(count),
            Err(error) => match error.kind() {
                ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted => ReadEvent::Silence,
                _ => ReadEvent::Gone,
            },
        }
    }
}

fn check_kind(path: &Path) -> Result<(), SerialError> {
    let kind = match std::fs::metadata(path) {
        Ok(metadata) => metadata.file_type(),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            return Err(SerialError::Missing { path: path.into(), ports: ports_in_words() });
        }
        Err(error) => {
            let hint = "check that each folder on the way may be entered";
            return Err(SerialError::Open { path: path.into(), reason: error.to_string(), hint });
        }
    };
    let not_a_port = |found, hint: String| Err(SerialError::NotAPort { path: path.into(), found, hint });
    if kind.is_dir() {
        not_a_port("a directory", format!("name one port in it; {}", ports_in_words()))
    } else if kind.is_file() {
        not_a_port("a regular file", format!("to play a log say `replay:{}`", path.display()))
    } else if !kind.is_char_device() {
        not_a_port("no character device", ports_in_words())
    } else {
        Ok(())
    }
}

fn ports_in_words() -> String {
    let ports = serialport::available_ports().unwrap_or_default();
    if ports.is_empty() {
        "no serial port is plugged in".into()
    } else {
        let names: Vec<_> = ports.into_iter().map(|port| port.port_name).collect();
        format!("there are {}", names.join(", "))
    }
}
