//! A tracker on a pseudo-terminal: the daemon opens the one end, the test writes bytes into the other.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

/// One line of a tracker and when it is due.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedLine {
    /// When the line is sent, after the feed begins.
    pub due: Duration,
    /// The line with its ending.
    pub bytes: Vec<u8>,
}

/// A serial tracker that is plugged in while this lives. Its link goes before its terminal does, whose name another
/// test's terminal may have at once.
pub struct PtyTracker {
    master: File,
    // Held open: a pseudo-terminal whose last reader closes loses what was written.
    _slave: OwnedFd,
    device: PathBuf,
    link: PathBuf,
}

impl PtyTracker {
    /// Plugs a tracker in; `link` becomes a symbolic link to its device, as udev makes one.
    pub fn plug_in(link: &Path) -> io::Result<Self> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let device = PathBuf::from(ptsname(&master, Vec::new())?.to_string_lossy().into_owned());
        let slave = rustix::fs::open(&device, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
        let mut raw = tcgetattr(&slave)?;
        raw.make_raw();
        tcsetattr(&slave, OptionalActions::Now, &raw)?;
        if link.is_symlink() {
            fs::remove_file(link)?;
        }
        symlink(&device, link)?;
        Ok(Self { master: File::from(master), _slave: slave, device, link: link.into() })
    }

    /// The device's own path.
    pub fn device(&self) -> &Path {
        &self.device
    }

    /// Its own end of the line, for a device that is spoken to.
    pub fn line(&self) -> io::Result<File> {
        self.master.try_clone()
    }

    /// Sends bytes now.
    pub fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.master.write_all(bytes)
    }

    /// Sends each line when it is due and returns when the last one is out; `began` is the instant of due zero.
    pub fn feed(&mut self, lines: &[TimedLine], began: Instant) -> io::Result<()> {
        for line in lines {
            if let Some(wait) = line.due.checked_sub(began.elapsed()) {
                thread::sleep(wait);
            }
            self.send(&line.bytes)?;
        }
        Ok(())
    }
}

impl Drop for PtyTracker {
    fn drop(&mut self) {
        if fs::read_link(&self.link).is_ok_and(|device| device == self.device) {
            let _taken_away_already = fs::remove_file(&self.link);
        }
    }
}
