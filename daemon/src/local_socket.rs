//! Unix sockets that other programs of this user, or of its group, may connect to.

use std::fs::{self, Permissions};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{Mode, fchmod};
use rustix::io::Errno;
use rustix::net::sockopt::{Timeout, set_socket_timeout};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, socket_with};

/// Connections that wait to be accepted.
const BACKLOG: i32 = 8;
/// Read and write, which is to connect, for user and group.
const MODE: u32 = 0o660;

/// Why nobody can listen at a socket.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum SocketError {
    /// The name is taken.
    #[error("{}: {found}", .socket.display())]
    Taken { socket: PathBuf, found: &'static str },
    /// The socket cannot be made.
    #[error("{}: cannot listen there: {error}", .socket.display())]
    Listen { socket: PathBuf, error: io::Error },
}

/// Listens at `path`, without blocking; a socket that a dead process left there is replaced.
///
/// # Errors
/// Something else is there, or the socket cannot be made.
pub(crate) fn listen(path: &Path, kind: SocketType) -> Result<OwnedFd, SocketError> {
    let cannot = |error: io::Error| SocketError::Listen { socket: path.to_owned(), error };
    let new_socket = || {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        socket_with(AddressFamily::UNIX, kind, flags, None).map_err(|error| cannot(error.into()))
    };
    let address = SocketAddrUnix::new(path).map_err(|error| cannot(error.into()))?;
    if let Ok(found) = fs::symlink_metadata(path) {
        let taken = |found| SocketError::Taken { socket: path.to_owned(), found };
        if !found.file_type().is_socket() {
            return Err(taken("a file that is no socket is there"));
        }
        match connect(new_socket()?, &address) {
            Err(Errno::CONNREFUSED) => fs::remove_file(path).map_err(cannot)?,
            Err(Errno::PROTOTYPE) => return Err(taken("another program's socket is there")),
            _ => return Err(taken("another holod listens there")),
        }
    }
    let listener = new_socket()?;
    // Never open to others, and open to the group whatever the mask says.
    fchmod(&listener, Mode::from_raw_mode(MODE)).map_err(|error| cannot(error.into()))?;
    bind(&listener, &address).map_err(|error| cannot(error.into()))?;
    fs::set_permissions(path, Permissions::from_mode(MODE)).map_err(cannot)?;
    rustix::net::listen(&listener, BACKLOG).map_err(|error| cannot(error.into()))?;
    Ok(listener)
}

/// Connects to a stream socket. One that hangs lets nobody in once enough wait; for that `patience` is waited, and then
/// as long for whatever is sent.
///
/// # Errors
/// Nobody listens there, or lets nobody in.
pub(crate) fn connect_within(path: &Path, patience: Duration) -> io::Result<UnixStream> {
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, SocketFlags::CLOEXEC, None)?;
    set_socket_timeout(&socket, Timeout::Send, Some(patience))?;
    match connect(&socket, &SocketAddrUnix::new(path)?) {
        Err(Errno::AGAIN) => Err(io::Error::new(io::ErrorKind::TimedOut, "it hangs, and lets nobody in")),
        connected => connected.map(|()| socket.into()).map_err(io::Error::from),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_socket_of_the_dead_is_replaced_and_one_of_the_living_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let listen = |kind| listen(&path, kind);
        let dead = listen(SocketType::SEQPACKET).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, MODE);
        let taken = |kind| match listen(kind) {
            Err(SocketError::Taken { found, .. }) => found,
            other => panic!("{other:?}"),
        };
        assert_eq!(taken(SocketType::SEQPACKET), "another holod listens there");
        assert_eq!(taken(SocketType::STREAM), "another program's socket is there");
        drop(dead);
        drop(listen(SocketType::SEQPACKET).unwrap());
        fs::remove_file(&path).unwrap();
        fs::write(&path, "precious").unwrap();
        assert_eq!(taken(SocketType::SEQPACKET), "a file that is no socket is there");
        assert_eq!(fs::read_to_string(&path).unwrap(), "precious");
    }

    #[test]
    fn a_socket_that_lets_nobody_in_is_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let listener = listen(&path, SocketType::STREAM).unwrap();
        let patience = Duration::from_millis(50);
        let waiting: Vec<_> = (0..=BACKLOG).map(|_| connect_within(&path, patience).unwrap()).collect();
        let error = connect_within(&path, patience).unwrap_err();
        assert!(error.to_string().contains("lets nobody in"), "{error}");
        drop((listener, waiting));
        assert_eq!(connect_within(&path, patience).unwrap_err().kind(), io::ErrorKind::ConnectionRefused);
    }

    #[test]
    fn a_path_that_is_too_long_is_said() {
        let path = Path::new("/tmp").join("x".repeat(200));
        let error = listen(&path, SocketType::STREAM).unwrap_err();
        assert!(error.to_string().contains("cannot listen there"), "{error}");
    }
}
