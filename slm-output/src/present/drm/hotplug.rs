//! The kernel's word that a connector has changed.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::netlink::{KOBJECT_UEVENT, SocketAddrNetlink};
use rustix::net::{AddressFamily, RecvFlags, SocketFlags, SocketType, bind, recv, socket_with};

use super::event::{Uevent, read_uevent};

/// The multicast group of the kernel itself; udev's own is another.
const KERNEL_GROUP: u32 = 1;
/// The kernel's messages are shorter.
const MESSAGE_BYTES: usize = 4096;

/// The socket on which the kernel announces changes of devices.
#[derive(Debug)]
pub(crate) struct Hotplug(OwnedFd);

impl Hotplug {
    pub(crate) fn open() -> Result<Self, Errno> {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = socket_with(AddressFamily::NETLINK, SocketType::DGRAM, flags, Some(KOBJECT_UEVENT))?;
        bind(&socket, &SocketAddrNetlink::new(0, KERNEL_GROUP))?;
        Ok(Self(socket))
    }

    /// What has been said of `connector` on `card`, a node's name such as `card0`, since the last call. Takes no
    /// memory.
    pub(crate) fn news(&self, card: &[u8], connector: u32) -> Uevent {
        let mut news = Uevent::Other;
        let mut message = [0u8; MESSAGE_BYTES];
        loop {
            match recv(&self.0, &mut message, RecvFlags::empty()) {
                Ok((_, length)) => match read_uevent(&message[..length.min(MESSAGE_BYTES)], card, connector) {
                    Uevent::Removed => return Uevent::Removed,
                    Uevent::Changed => news = Uevent::Changed,
                    Uevent::Other => {}
                },
                // Messages were lost: it may have been one of ours.
                Err(Errno::NOBUFS) => news = Uevent::Changed,
                Err(Errno::INTR) => {}
                Err(_) => return news,
            }
        }
    }
}

impl AsFd for Hotplug {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
