//! Unix sockets that other programs of this user, or of its group, may connect to.

use std::fs::{self, File, Metadata, Permissions};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use rustix::fs::{FlockOperation, Mode, fchmod, flock};
use rustix::io::Errno;
use rustix::net::sockopt::{Timeout, set_socket_timeout};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, socket_with};

use crate::runtime_folder::{self, make_again};
use crate::staging::folder_of;

/// Connections that wait to be accepted.
const BACKLOG: i32 = 8;
/// Read and write, which is to connect, for user and group.
const MODE: u32 = 0o660;
/// How often whoever listens should see to it that its socket is still there.
pub(crate) const LOOK: Duration = Duration::from_secs(1);
/// How often, and with what rest, a folder is asked for that another holod has for the moment that it takes to listen.
const LOCK_TRIES: u32 = 200;
const LOCK_REST: Duration = Duration::from_millis(5);

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

/// A path on which a process listens, and the socket that it made there.
#[derive(Debug)]
pub(crate) struct SocketPlace {
    path: PathBuf,
    kind: SocketType,
    /// Device and inode of the socket; nothing once it was taken away.
    socket: Mutex<Option<(u64, u64)>>,
}

impl SocketPlace {
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Listens again where nothing is at the path any more, since its folder was cleared or, at the end of a login
    /// session, taken away; a run's own folder is made again. Nothing where something is there, or that folder cannot be
    /// had.
    pub(crate) fn listen_again(&self) -> Option<Result<OwnedFd, SocketError>> {
        let mut socket = self.socket();
        let is_gone = fs::symlink_metadata(&self.path).is_err_and(|error| error.kind() == io::ErrorKind::NotFound);
        let folder = folder_of(&self.path);
        let may_be_used = || !runtime_folder::candidates().iter().any(|own| own == folder) || make_again(folder);
        if socket.is_none() || !is_gone || !may_be_used() {
            return None;
        }
        Some(bind_at(&self.path, self.kind).map(|(listener, bound)| {
            *socket = Some(bound);
            listener
        }))
    }

    /// Takes the socket away, where it is not another one by now.
    pub(crate) fn take_away(&self) {
        let socket = self.socket().take();
        let _alone = alone_in(folder_of(&self.path));
        if socket.is_some() && fs::symlink_metadata(&self.path).ok().map(|found| identity(&found)) == socket {
            let _gone = fs::remove_file(&self.path);
        }
    }

    fn socket(&self) -> MutexGuard<'_, Option<(u64, u64)>> {
        self.socket.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Listens at `path`, without blocking; a socket that a dead process left there is replaced.
///
/// # Errors
/// Something else is there, or the socket cannot be made.
pub(crate) fn listen(path: &Path, kind: SocketType) -> Result<(OwnedFd, SocketPlace), SocketError> {
    let (listener, bound) = bind_at(path, kind)?;
    Ok((listener, SocketPlace { path: path.to_owned(), kind, socket: Mutex::new(Some(bound)) }))
}

/// The same, with the socket's identity.
fn bind_at(path: &Path, kind: SocketType) -> Result<(OwnedFd, (u64, u64)), SocketError> {
    let cannot = |error: io::Error| SocketError::Listen { socket: path.to_owned(), error };
    let new_socket = || {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        socket_with(AddressFamily::UNIX, kind, flags, None).map_err(|error| cannot(error.into()))
    };
    let address = SocketAddrUnix::new(path).map_err(|error| cannot(error.into()))?;
    // Until it listens, another holod would take this socket for a dead one's.
    let _alone = alone_in(folder_of(path));
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
    let bound = fs::symlink_metadata(path).map_err(cannot)?;
    Ok((listener, identity(&bound)))
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

fn identity(found: &Metadata) -> (u64, u64) {
    (found.dev(), found.ino())
}

/// Keeps other holods from the sockets of a folder for as long as it lives. Where the folder cannot be had, since it
/// knows no locks or a stranger holds on to it, nobody is kept away.
fn alone_in(folder: &Path) -> Option<File> {
    let folder = File::open(folder).ok()?;
    for _ in 0..LOCK_TRIES {
        match flock(&folder, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Some(folder),
            Err(Errno::WOULDBLOCK) => thread::sleep(LOCK_REST),
            Err(_) => return None,
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::*;

    #[test]
    fn a_socket_of_the_dead_is_replaced_and_one_of_the_living_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let listen = |kind| listen(&path, kind).map(|(listener, _)| listener);
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
    fn of_holods_that_start_at_once_over_a_dead_ones_socket_one_listens() {
        const HOLODS: usize = 4;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        for round in 0..200 {
            let barrier = Barrier::new(HOLODS);
            let start = || {
                barrier.wait();
                let listening = listen(&path, SocketType::STREAM);
                barrier.wait();
                listening.map(|(listener, _)| {
                    assert!(UnixStream::connect(&path).is_ok(), "round {round}: its socket is another's");
                    listener
                })
            };
            let holods: Vec<_> = thread::scope(|scope| {
                let started: Vec<_> = (0..HOLODS).map(|_| scope.spawn(start)).collect();
                started.into_iter().map(|thread| thread.join().unwrap()).collect()
            });
            assert_eq!(holods.iter().filter(|listening| listening.is_ok()).count(), 1, "round {round}: {holods:?}");
        }
    }

    #[test]
    fn a_socket_whose_folder_was_taken_away_is_made_again_and_anothers_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("folder/socket");
        fs::create_dir(folder.path().join("folder")).unwrap();
        let (_listener, place) = listen(&path, SocketType::STREAM).unwrap();
        assert!(place.listen_again().is_none());
        fs::remove_dir_all(folder.path().join("folder")).unwrap();
        assert!(place.listen_again().unwrap().is_err(), "it is no runtime folder");
        fs::create_dir(folder.path().join("folder")).unwrap();
        let _again = place.listen_again().unwrap().unwrap();
        assert!(UnixStream::connect(&path).is_ok() && place.listen_again().is_none());

        fs::remove_file(&path).unwrap();
        let (_other, others) = listen(&path, SocketType::STREAM).unwrap();
        place.take_away();
        assert!(UnixStream::connect(&path).is_ok());
        others.take_away();
        assert!(!path.exists() && others.listen_again().is_none(), "it has ended");
    }

    #[test]
    fn a_socket_that_lets_nobody_in_is_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let (listener, _place) = listen(&path, SocketType::STREAM).unwrap();
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
