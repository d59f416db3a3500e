//! Files that are read whole, of which none is too large.

use std::path::Path;
use std::{fs, io};

/// Why a file was not read.
#[derive(Debug)]
pub(crate) enum Unread {
    /// What the system said.
    System(io::Error),
    /// It is no regular file, or too large.
    NoFile { found: String },
}

/// The bytes of a regular file of `most_bytes` or fewer.
pub(crate) fn read(path: &Path, most_bytes: u64) -> Result<Vec<u8>, Unread> {
    // Before it is opened: opening a named pipe would wait.
    let metadata = fs::metadata(path).map_err(Unread::System)?;
    if !metadata.is_file() {
        return Err(Unread::NoFile { found: "no regular file".into() });
    }
    if metadata.len() > most_bytes {
        return Err(Unread::NoFile { found: format!("{} bytes", metadata.len()) });
    }
    fs::read(path).map_err(Unread::System)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_file_or_too_large_is_not_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        fs::write(&path, [7; 9]).unwrap();
        assert_eq!(read(&path, 9).unwrap(), [7; 9]);
        let found = |path: &Path, most_bytes| match read(path, most_bytes) {
            Err(Unread::NoFile { found }) => found,
            other => panic!("{other:?}"),
        };
        assert_eq!(found(&path, 8), "9 bytes");
        assert_eq!(found(folder.path(), 9), "no regular file");
        assert!(matches!(read(&folder.path().join("none"), 9), Err(Unread::System(_))));
    }
}
