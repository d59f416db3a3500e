//! What trackers with a server of their own have in common: how they are connected to, and why they cannot be used.

use std::io::{self, ErrorKind};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;

use crate::spec::HostPort;

/// Why a tracker's server cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum ServerError {
    /// The host's name is not known.
    #[error(
        "{server} at {address}: the host `{}` is not found: {reason}; give its address in numbers (names that end in \
         .local are for the system to find, by avahi with nss-mdns or by systemd-resolved)",
        address.host
    )]
    Host {
        /// What was looked for.
        server: &'static str,
        address: HostPort,
        reason: io::Error,
    },
    /// It does not accept a connection, or breaks it while it is being talked to.
    #[error("{server} at {address} cannot be talked to: {reason}; {hint}")]
    Link {
        /// What was looked for.
        server: &'static str,
        address: HostPort,
        reason: io::Error,
        hint: &'static str,
    },
    /// It answers, and not as expected.
    #[error("{server} at {address} answers {found}; expected {expected}; {hint}")]
    Answer {
        /// What was looked for.
        server: &'static str,
        address: HostPort,
        found: String,
        /// What it should have said.
        expected: &'static str,
        hint: &'static str,
    },
}

/// How long a server may take to be opened, behind the search for its name.
pub(super) const OPEN_WITHIN: Duration = Duration::from_secs(3);
/// Letters of an answer that an error shows.
const SHOWN: usize = 60;

/// A server that is being opened.
#[derive(Clone, Copy)]
pub(super) struct Server<'a> {
    /// What it is, in words.
    pub(super) name: &'static str,
    /// Where the spec says that it is.
    pub(super) address: &'a HostPort,
    /// What to do when it cannot be reached.
    pub(super) hint: &'static str,
    /// When it must be open.
    pub(super) deadline: Instant,
}

impl Server<'_> {
    /// The addresses behind its name. The system decides for how long it searches.
    pub(super) fn resolve(&self) -> Result<Vec<SocketAddr>, ServerError> {
        let HostPort { host, port } = self.address;
        let none = || io::Error::new(ErrorKind::NotFound, "the name has no address");
        (host.as_str(), *port)
            .to_socket_addrs()
            .map(Vec::from_iter)
            .and_then(|found| if found.is_empty() { Err(none()) } else { Ok(found) })
            .map_err(|reason| ServerError::Host { server: self.name, address: self.address.clone(), reason })
    }

    /// Connects to the first address that answers. The stream does not block.
    pub(super) fn connect(&self, addresses: &[SocketAddr]) -> Result<TcpStream, ServerError> {
        let mut reason = io::Error::from(ErrorKind::TimedOut);
        for address in addresses {
            let left = self.deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            let opened = TcpStream::connect_timeout(address, left).and_then(|stream| {
                stream.set_nodelay(true)?;
                stream.set_nonblocking(true)?;
                Ok(stream)
            });
            match opened {
                Ok(stream) => return Ok(stream),
                Err(error) => reason = error,
            }
        }
        Err(self.broken(reason))
    }

    pub(super) fn broken(&self, reason: io::Error) -> ServerError {
        ServerError::Link { server: self.name, address: self.address.clone(), reason, hint: self.hint }
    }

    pub(super) fn unexpected(&self, found: &[u8], expected: &'static str, hint: &'static str) -> ServerError {
        let shown = &found[..found.len().min(SHOWN)];
        let ends = if shown.len() < found.len() { "…" } else { "" };
        let found = format!("`{}{ends}`", shown.escape_ascii());
        ServerError::Answer { server: self.name, address: self.address.clone(), found, expected, hint }
    }
}

/// Waits until one of `sockets` has something to read, or `deadline`.
pub(super) fn wait<const N: usize>(sockets: [BorrowedFd<'_>; N], deadline: Instant) -> io::Result<()> {
    let left = deadline.saturating_duration_since(Instant::now());
    let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
    match poll(&mut sockets.map(|socket| PollFd::from_borrowed_fd(socket, PollFlags::IN)), Some(&left)) {
        Ok(_) | Err(Errno::INTR) => Ok(()),
        Err(error) => Err(error.into()),
    }
}
