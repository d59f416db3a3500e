//! A tracker that sends datagrams to this machine, each a message of its own.

use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, UdpSocket};
use std::time::{Duration, Instant};

use super::tcp::{NetworkError, resolve};
use super::{ByteSource, Feed, READ_TIMEOUT, ReadEvent, SourceError};
use crate::profile::Profile;
use crate::spec::HostPort;

/// A sender that was silent for so long may be followed by another.
const SENDER_LASTS: Duration = Duration::from_secs(2);

/// A group is joined again after so long without a datagram: the membership goes with the network interface, and does
/// not come back with it.
const JOINED_AGAIN_AFTER: Duration = Duration::from_secs(5);

/// A port of this machine at which datagrams are received; a multicast address joins its group.
pub(crate) struct UdpFeed {
    address: HostPort,
    profile: String,
    has_commands: bool,
}

impl UdpFeed {
    pub(crate) fn new(address: HostPort, profile: &Profile) -> Self {
        let has_commands = !profile.network.start.is_empty() || !profile.network.stop.is_empty();
        Self { address, profile: profile.name.clone(), has_commands }
    }

    /// With the group that it has joined.
    fn bind(&self) -> Result<(UdpSocket, Option<IpAddr>), NetworkError> {
        let address = resolve(&self.address)?[0];
        let group = Some(address.ip()).filter(IpAddr::is_multicast);
        let bound = match group {
            Some(group) => {
                let all: IpAddr =
                    if group.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
                UdpSocket::bind((all, address.port())).and_then(|socket| join(&socket, group).map(|()| socket))
            }
            None => UdpSocket::bind(address),
        };
        let bound = bound.and_then(|socket| socket.set_read_timeout(Some(READ_TIMEOUT)).map(|()| (socket, group)));
        bound.map_err(|reason| {
            let hint = match reason.kind() {
                ErrorKind::AddrInUse => "another program listens on this port; close it",
                ErrorKind::AddrNotAvailable => {
                    "give an address of this machine, not the tracker's: 0.0.0.0 for all of them"
                }
                ErrorKind::PermissionDenied => "take a port above 1023",
                _ => "check this machine's network",
            };
            NetworkError::Listen { address: self.address.clone(), reason, hint }
        })
    }
}

impl Feed for UdpFeed {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError> {
        if self.has_commands {
            let (address, profile) = (self.address.clone(), self.profile.clone());
            return Err(NetworkError::NobodyToTell { address, profile }.into());
        }
        let (socket, group) = self.bind()?;
        Ok(Box::new(Listener { socket, group, t_quiet: Instant::now(), sender: None, newest: None }))
    }

    fn datagrams(&self) -> bool {
        true
    }
}

struct Listener {
    socket: UdpSocket,
    /// Which it has joined.
    group: Option<IpAddr>,
    /// Since when nothing has come, or when the group was joined again.
    t_quiet: Instant,
    /// Whose datagrams alone are taken, and when the last one with a sample came. Two trackers at once would be mixed
    /// up, and what sends no sample is no tracker.
    sender: Option<(IpAddr, Instant)>,
    /// Who sent the last one that was taken.
    newest: Option<IpAddr>,
}

impl ByteSource for Listener {
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent {
        match self.socket.recv_from(buffer) {
            Ok((count, from)) => {
                self.t_quiet = Instant::now();
                if self.sender.is_some_and(|(ip, last)| ip != from.ip() && last.elapsed() < SENDER_LASTS) {
                    return ReadEvent::Stranger;
                }
                self.newest = Some(from.ip());
                if count == 0 { ReadEvent::Silence } else { ReadEvent::Bytes(count) }
            }
            Err(error) => match error.kind() {
                ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted if self.stays_joined() => {
                    ReadEvent::Silence
                }
                _ => ReadEvent::Gone,
            },
        }
    }

    fn is_followed(&mut self) {
        self.sender = self.newest.map(|ip| (ip, Instant::now()));
    }
}

impl Listener {
    /// Joins its group again where nothing has come for long; false where that fails.
    fn stays_joined(&mut self) -> bool {
        let Some(group) = self.group.filter(|_| self.t_quiet.elapsed() >= JOINED_AGAIN_AFTER) else { return true };
        self.t_quiet = Instant::now();
        let _gone_with_its_interface = leave(&self.socket, group);
        join(&self.socket, group).is_ok()
    }
}

/// On the interface that the route to the group gives.
fn join(socket: &UdpSocket, group: IpAddr) -> io::Result<()> {
    match group {
        IpAddr::V4(group) => socket.join_multicast_v4(&group, &Ipv4Addr::UNSPECIFIED),
        IpAddr::V6(group) => socket.join_multicast_v6(&group, 0),
    }
}

fn leave(socket: &UdpSocket, group: IpAddr) -> io::Result<()> {
    match group {
        IpAddr::V4(group) => socket.leave_multicast_v4(&group, &Ipv4Addr::UNSPECIFIED),
        IpAddr::V6(group) => socket.leave_multicast_v6(&group, 0),
    }
}
