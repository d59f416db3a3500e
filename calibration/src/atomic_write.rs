//! Files that are written whole or not at all.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

/// Bytes written at a time.
const BUFFER_BYTES: usize = 1 << 16;

/// What is at `path` where it is, or leads to, something that no file may take the place of: a device, a pipe, a
/// socket, or a file that a process has open.
pub fn special_file(path: &Path) -> Option<&'static str> {
    if is_open_file(path) {
        return Some("a file that is open already");
    }
    let kind = fs::metadata(path).ok()?.file_type();
    let kinds = [
        (kind.is_char_device() || kind.is_block_device(), "a device"),
        (kind.is_fifo(), "a pipe"),
        (kind.is_socket(), "a socket"),
    ];
    kinds.into_iter().find(|(is_it, _)| *is_it).map(|(_, name)| name)
}

/// Whether `path` leads by links into a process's table of open files, as `/dev/stdout` does.
fn is_open_file(path: &Path) -> bool {
    /// As many as Linux follows.
    const LINKS_MAX: usize = 40;
    let mut path = path.to_owned();
    for _ in 0..LINKS_MAX {
        let Ok(target) = fs::read_link(&path) else { return false };
        let Ok(folder) = folder_of(&path).canonicalize() else { return false };
        if folder.starts_with("/proc") && folder.ends_with("fd") {
            return true;
        }
        path = folder.join(target);
    }
    false
}

/// The folder in which a path's last part is; `.` for a bare name.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes a file beside its place, and moves it there when it is whole and on the disk: whoever looks sees all of it or
/// what was there before.
///
/// # Errors
/// The path names no file, but a directory, device, pipe or socket, `write` fails, or the system does; what was there
/// before stays then, and nothing beside it.
pub fn write_atomically(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let name = path.file_name().ok_or_else(|| io::Error::other("it names no file"))?;
    if path.is_dir() {
        return Err(io::ErrorKind::IsADirectory.into());
    }
    if let Some(found) = special_file(path) {
        let what = format!("found {found}, expected a file or nothing; name another file");
        return Err(io::Error::new(io::ErrorKind::AlreadyExists, what));
    }
    let mut beside = OsString::from(".");
    beside.push(name);
    beside.push(format!(".{}.part", std::process::id()));
    let beside = path.with_file_name(beside);
    let written = write_synced(&beside, write).and_then(|()| fs::rename(&beside, path));
    if written.is_err() {
        // Whatever is left of it; that it was never there is no second error.
        let _ = fs::remove_file(&beside);
    }
    written?;
    // The file is in its place and whole; that a folder cannot be synced, as on some network disks, does not undo that.
    let _ = File::open(folder_of(path)).and_then(|folder| folder.sync_all());
    Ok(())
}

fn write_synced(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let file = OpenOptions::new().write(true).create(true).truncate(true).open(path)?;
    let mut writer = BufWriter::with_capacity(BUFFER_BYTES, file);
    write(&mut writer)?;
    writer.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_what_was_there_and_nothing_else() {
        let dir = tempfile::TempDir::new().expect("a folder");
        let path = dir.path().join("out.csv");
        write_atomically(&path, |out| out.write_all(b"before")).expect("writes");
        let failed = write_atomically(&path, |out| {
            out.write_all(&[b'x'; 2 * BUFFER_BYTES])?;
            Err(io::Error::other("no room"))
        });
        assert!(failed.expect_err("failed").to_string().contains("no room"));
        assert_eq!(fs::read(&path).expect("reads"), b"before");
        assert_eq!(fs::read_dir(dir.path()).expect("reads").count(), 1);
        write_atomically(&path, |out| out.write_all(b"after")).expect("writes");
        assert_eq!(fs::read(&path).expect("reads"), b"after");
        for nowhere in [dir.path(), &dir.path().join("no/such/folder"), Path::new("/")] {
            assert!(write_atomically(nowhere, |_| Ok(())).is_err(), "{}", nowhere.display());
        }
        assert_eq!(fs::read_dir(dir.path()).expect("reads").count(), 1);
    }

    #[test]
    fn an_open_file_is_not_replaced_by_another() {
        use std::os::fd::AsRawFd;
        let dir = tempfile::TempDir::new().expect("a folder");
        let file = File::create(dir.path().join("redirected")).expect("a file");
        let links = [
            format!("/dev/fd/{}", file.as_raw_fd()),
            format!("/proc/self/fd/{}", file.as_raw_fd()),
            format!("/proc/{}/fd/{}", std::process::id(), file.as_raw_fd()),
        ];
        let link = dir.path().join("link");
        std::os::unix::fs::symlink(&links[0], &link).expect("a link");
        for path in links.iter().map(Path::new).chain([&*link]) {
            assert_eq!(special_file(path), Some("a file that is open already"), "{}", path.display());
        }
        assert_eq!(special_file(&dir.path().join("redirected")), None);
    }

    #[test]
    fn only_a_file_is_replaced() {
        let dir = tempfile::TempDir::new().expect("a folder");
        let at = |name: &str| dir.path().join(name);
        rustix::fs::mkfifoat(rustix::fs::CWD, at("pipe"), rustix::fs::Mode::RUSR).expect("a pipe");
        let _socket = std::os::unix::net::UnixListener::bind(at("socket")).expect("a socket");
        std::os::unix::fs::symlink("/dev/null", at("device")).expect("a link");
        for (name, found) in [("pipe", "a pipe"), ("socket", "a socket"), ("device", "a device")] {
            let refused = write_atomically(&at(name), |_| unreachable!("nothing is written")).expect_err("refused");
            assert!(refused.to_string().contains(&format!("found {found}, expected a file")), "{refused}");
            assert_eq!(special_file(&at(name)), Some(found));
        }
        assert_eq!(fs::read_dir(dir.path()).expect("reads").count(), 3);

        fs::write(at("file"), "before").expect("writes");
        std::os::unix::fs::symlink("file", at("link")).expect("a link");
        assert_eq!((special_file(&at("link")), special_file(&at("absent"))), (None, None));
        write_atomically(&at("link"), |out| out.write_all(b"after")).expect("writes");
        assert_eq!(fs::read(at("link")).expect("reads"), b"after");
        assert_eq!(fs::read(at("file")).expect("reads"), b"before", "the link is replaced, not what it leads to");
    }
}
