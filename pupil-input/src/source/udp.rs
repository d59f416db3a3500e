//! A tracker that sends datagrams to this machine, each a message of its own.

use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use super::tcp::{NetworkError, resolve};
use super::{ByteSource, Feed, READ_TIMEOUT, ReadEvent, SourceError};
use crate::profile::Profile;
use crate::spec::HostPort;

/// A sender that was silent for so long may be followed by another.
const SENDER_LASTS: Duration = Duration::from_secs(2);

/// The newest ports from which samples came, by their number. A sender whose port is still among them when its next
/// sample comes keeps that port, and is followed there alone; others take a new port for each datagram.
const PORTS_REMEMBERED: usize = 8;

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
        Ok(Box::new(Listener { socket, group, t_quiet: Instant::now(), senders: Senders::default() }))
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
    senders: Senders,
}

/// Whose datagrams are taken. Two trackers at once would be mixed up, and what sends no sample is no tracker.
#[derive(Debug, Default)]
struct Senders {
    /// Who sent the last sample, and when it came.
    followed: Option<(SocketAddr, Instant)>,
    /// It sends from one port.
    keeps_port: bool,
    /// Who sent the newest samples, in no order.
    recent: [Option<SocketAddr>; PORTS_REMEMBERED],
    next: usize,
    /// Who sent the last datagram that was taken.
    newest: Option<SocketAddr>,
}

impl Senders {
    /// Whether a datagram that comes now is taken.
    fn takes(&mut self, from: SocketAddr, now: Instant) -> bool {
        let is_other =
            |followed: SocketAddr| followed.ip() != from.ip() || self.keeps_port && followed.port() != from.port();
        let lasts = |last: Instant| now.saturating_duration_since(last) < SENDER_LASTS;
        let is_stranger = self.followed.is_some_and(|(followed, last)| is_other(followed) && lasts(last));
        if !is_stranger {
            self.newest = Some(from);
        }
        !is_stranger
    }

    /// A sample was in the datagram that was taken last.
    fn follow(&mut self, now: Instant) {
        let Some(from) = self.newest else { return };
        let is_known = self.recent.contains(&Some(from));
        if !is_known {
            self.recent[self.next] = Some(from);
            self.next = (self.next + 1) % PORTS_REMEMBERED;
        }
        self.keeps_port = is_known;
        self.followed = Some((from, now));
    }
}

impl ByteSource for Listener {
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent {
        match self.socket.recv_from(buffer) {
            Ok((count, from)) => {
                let now = Instant::now();
                self.t_quiet = now;
                match count {
                    _ if !self.senders.takes(from, now) => ReadEvent::Stranger,
                    0 => ReadEvent::Silence,
                    _ => ReadEvent::Bytes(count),
                }
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
        self.senders.follow(Instant::now());
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Which of datagrams with samples, each 10 ms behind the one before it, are taken.
    fn taken(froms: impl IntoIterator<Item = (u8, u16)>) -> Vec<(u8, u16)> {
        let mut senders = Senders::default();
        let begun = Instant::now();
        let mut taken = Vec::new();
        for (index, from) in (0..).zip(froms) {
            let (now, ip) = (begun + Duration::from_millis(10 * index), Ipv4Addr::new(127, 0, 0, from.0));
            if senders.takes((ip, from.1).into(), now) {
                senders.follow(now);
                taken.push(from);
            }
        }
        taken
    }

    #[test]
    fn of_two_senders_on_one_machine_one_is_followed() {
        let alternate = (0..600).map(|k| (1, 40_000 + k % 2));
        let taken_of = |port| taken(alternate.clone()).iter().filter(|from| from.1 == port).count();
        assert_eq!([taken_of(40_000), taken_of(40_001)], [300, 1]);
        // One that comes later is none either, and takes over once the first one is gone.
        let later = (0..50).map(|_| (1, 7)).chain((0..100).flat_map(|_| [(1, 7), (1, 8)])).chain([(1, 8); 300]);
        let taken = taken(later);
        assert!(
            taken[..150].iter().all(|from| from.1 == 7) && taken[150..].iter().all(|from| from.1 == 8),
            "{taken:?}"
        );
        assert_eq!(taken.len(), 150 + 300 - 198);
    }

    #[test]
    fn a_sender_with_a_new_port_for_each_datagram_is_followed_and_no_other_machine() {
        let froms = || (0..400).map(|k| if k % 4 == 3 { (2, 9) } else { (1, 20_000 + k) });
        assert_eq!(taken(froms()), froms().filter(|from| from.0 == 1).collect::<Vec<_>>());
    }
}
