//! A tracker that a TCP connection leads to, such as a Gazepoint's Open Gaze server.

use std::io::{self, ErrorKind, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use rustix::net::sockopt;

use super::commands::{CommandError, Dialogue, StartedLink, receive_from};
use super::{ByteSource, Feed, READ_TIMEOUT, SourceError};
use crate::profile::{NetworkSettings, Profile};
use crate::spec::HostPort;

/// Why a tracker on a network cannot be reached.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum NetworkError {
    /// The host's name is not known.
    #[error("tracker {address}: the host `{}` is not found: {reason}; check its name, or give its address in numbers", address.host)]
    Host {
        /// The tracker's host and port.
        address: HostPort,
        reason: String,
    },
    /// No connection came about.
    #[error("tracker {address} does not accept a connection: {reason}; {hint}")]
    Connect {
        /// The tracker's host and port.
        address: HostPort,
        reason: io::Error,
        hint: &'static str,
    },
    /// Datagrams cannot be received there.
    #[error("tracker {address}: this machine cannot listen there: {reason}; {hint}")]
    Listen {
        /// Address of this machine and port.
        address: HostPort,
        reason: io::Error,
        hint: &'static str,
    },
    /// The tracker does not do as it is told.
    #[error("tracker {address}, profile `{profile}`: {problem}; check the profile and the tracker's settings")]
    Command {
        /// The tracker's host and port.
        address: HostPort,
        profile: String,
        problem: Box<CommandError>,
    },
    /// Datagrams come from anywhere, so there is nobody to be told anything.
    #[error(
        "tracker {address}: profile `{profile}` has commands for the tracker, and with `udp:` nobody is there to send them \
         to; use `tcp:`, or a profile without commands"
    )]
    NobodyToTell {
        /// Address of this machine and port.
        address: HostPort,
        profile: String,
    },
}

/// How long one address of the host may take to answer.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// Addresses of one host that are tried.
const ADDRESSES_TRIED: usize = 4;
/// How long a command may take to go out.
const WRITE_TIMEOUT: Duration = Duration::from_secs(1);
/// A peer that says nothing is asked whether it is there after so long, again after each of these, and so often.
const KEEP_ALIVE: (Duration, Duration, u32) = (Duration::from_secs(2), Duration::from_secs(1), 3);

/// A tracker that is connected to.
pub(crate) struct TcpFeed {
    address: HostPort,
    profile: String,
    settings: NetworkSettings,
}

impl TcpFeed {
    pub(crate) fn new(address: HostPort, profile: &Profile) -> Self {
        Self { address, profile: profile.name.clone(), settings: profile.network.clone() }
    }

    fn connect(&self) -> Result<TcpStream, NetworkError> {
        let mut last = io::Error::from(ErrorKind::AddrNotAvailable);
        for address in resolve(&self.address)?.into_iter().take(ADDRESSES_TRIED) {
            match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT).and_then(prepare) {
                Ok(stream) => return Ok(stream),
                Err(error) => last = error,
            }
        }
        let hint = match last.kind() {
            ErrorKind::ConnectionRefused => "start the tracker's server, and check that it listens on this port",
            ErrorKind::TimedOut => "check the address, the cable and the firewalls between",
            _ => "check the address and this machine's network",
        };
        Err(NetworkError::Connect { address: self.address.clone(), reason: last, hint })
    }
}

/// The addresses behind a name.
pub(super) fn resolve(address: &HostPort) -> Result<Vec<SocketAddr>, NetworkError> {
    let unknown = |reason: String| NetworkError::Host { address: address.clone(), reason };
    let found = (address.host.as_str(), address.port).to_socket_addrs().map_err(|error| unknown(error.to_string()))?;
    let found: Vec<_> = found.collect();
    if found.is_empty() { Err(unknown("it has no address".into())) } else { Ok(found) }
}

fn prepare(stream: TcpStream) -> io::Result<TcpStream> {
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(READ_TIMEOUT))?;
    stream.set_write_timeout(Some(WRITE_TIMEOUT))?;
    let (idle, interval, count) = KEEP_ALIVE;
    sockopt::set_socket_keepalive(&stream, true)?;
    sockopt::set_tcp_keepidle(&stream, idle)?;
    sockopt::set_tcp_keepintvl(&stream, interval)?;
    sockopt::set_tcp_keepcnt(&stream, count)?;
    Ok(stream)
}

impl Feed for TcpFeed {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError> {
        let stream = self.connect()?;
        let NetworkSettings { start, stop, .. } = &self.settings;
        let link = StartedLink::start(stream, start, stop).map_err(|problem| NetworkError::Command {
            address: self.address.clone(),
            profile: self.profile.clone(),
            problem: Box::new(problem),
        })?;
        Ok(Box::new(link))
    }
}

impl Dialogue for TcpStream {
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.write_all(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        receive_from(self, buffer)
    }
}
