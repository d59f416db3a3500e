//! The bytes of a log: unpacked, in UTF-8, and with the reason where reading fails.

use std::cell::RefCell;
use std::fs::File;
use std::io::{self, BufRead, ErrorKind, Read};
use std::path::Path;
use std::rc::Rc;

use super::fault::ReplayError;
use super::text::Lines;
use super::unpack::{self, Shortened};

/// A log file that has not been read yet.
pub(crate) struct LogInput<'a> {
    pub(crate) path: &'a Path,
    /// Its first 64 KiB (all of a shorter one), as [`Self::open`] gives them.
    pub(crate) head: Vec<u8>,
    failure: Failure,
    shortened: Shortened,
}

/// The first error of any reader of a log.
type Failure = Rc<RefCell<Option<io::Error>>>;

const HEAD_BYTES: u64 = 1 << 16;

impl<'a> LogInput<'a> {
    pub(super) fn new(path: &'a Path) -> Result<Self, ReplayError> {
        let mut input = Self::at(path);
        let mut head = Vec::new();
        input.open()?.take(HEAD_BYTES).read_to_end(&mut head).map_err(|source| input.io(source))?;
        input.head = head;
        Ok(input)
    }

    /// A file whose beginning nobody looks at.
    pub(crate) fn at(path: &'a Path) -> Self {
        Self { path, head: Vec::new(), failure: Failure::default(), shortened: Shortened::default() }
    }

    /// From its beginning: unpacked if it is gzip, in UTF-8 if it is UTF-16, without a byte order mark.
    ///
    /// Where reading fails the file seems to end, and [`Self::failed`] tells why.
    pub(crate) fn open(&self) -> Result<Box<dyn BufRead>, ReplayError> {
        let reader = File::open(self.path).and_then(|file| unpack::plain(file, &self.shortened));
        let reader = reader.map_err(|source| self.io(source))?;
        Ok(Box::new(Watched { reader, failure: self.failure.clone() }))
    }

    /// Why reading failed, if it did.
    pub(crate) fn failed(&self) -> Result<(), ReplayError> {
        self.failure.take().map_or(Ok(()), |source| Err(self.io(source)))
    }

    /// Why the archive that it is was not unpacked to its end, if it was not.
    pub(super) fn shortened(&self) -> Option<&'static str> {
        self.shortened.get()
    }

    /// Its lines from its beginning.
    pub(crate) fn lines(&self) -> Result<Lines, ReplayError> {
        Ok(Lines::new(self.open()?))
    }

    /// Its non-empty first lines, trimmed; the last may be cut off by the end of the head.
    pub(crate) fn head_lines(&self) -> impl Iterator<Item = &[u8]> {
        self.head.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).filter(|line| !line.is_empty())
    }

    pub(crate) fn io(&self, source: io::Error) -> ReplayError {
        ReplayError::Io { path: self.path.into(), source }
    }

    /// An error for what is wrong with the log as a whole.
    pub(crate) fn content(&self, found: impl Into<String>, expected: impl Into<String>) -> ReplayError {
        ReplayError::Content {
            path: self.path.into(),
            at: String::new(),
            found: found.into(),
            expected: expected.into(),
        }
    }
}

/// A reader that ends where reading fails, and keeps why.
struct Watched<R> {
    reader: R,
    failure: Failure,
}

impl<R: BufRead> Read for Watched<R> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut piece = self.fill_buf()?;
        let count = piece.read(into)?;
        self.consume(count);
        Ok(count)
    }
}

impl<R: BufRead> BufRead for Watched<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        while self.failure.borrow().is_none() {
            match self.reader.fill_buf() {
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => *self.failure.borrow_mut() = Some(error),
                // Asked once more, since a piece that is returned from a loop is borrowed for good.
                Ok(_) => return self.reader.fill_buf(),
            }
        }
        Ok(&[])
    }

    fn consume(&mut self, count: usize) {
        self.reader.consume(count);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Failing(u8);

    impl Read for Failing {
        fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
            self.0 += 1;
            match self.0 {
                1 => Err(ErrorKind::Interrupted.into()),
                2 => {
                    into[0] = b'x';
                    Ok(1)
                }
                _ => Err(io::Error::other("torn cable")),
            }
        }
    }

    #[test]
    fn a_reader_that_fails_ends_and_its_error_is_kept() {
        let failure = Failure::default();
        let mut watched = Watched { reader: io::BufReader::new(Failing(0)), failure: failure.clone() };
        let mut bytes = Vec::new();
        watched.read_to_end(&mut bytes).expect("ends");
        assert_eq!(bytes, b"x");
        assert_eq!(watched.read(&mut [0; 8]).ok(), Some(0));
        assert_eq!(failure.take().map(|error| error.to_string()), Some("torn cable".into()));
    }
}
