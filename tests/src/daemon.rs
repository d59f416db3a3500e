//! The `holod` binary as a process.

use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

/// The address of a system bus that is not there: tests ask nothing of the machine's own logind.
pub const NO_BUS: &str = "unix:path=/nowhere/system_bus_socket";

/// A running `holod`; killed when it is dropped.
pub struct Daemon {
    child: Child,
    stdout: Option<JoinHandle<String>>,
    stderr: Option<JoinHandle<String>>,
}

/// How a `holod` ended.
#[derive(Debug)]
pub struct Ended {
    /// Exit status.
    pub status: ExitStatus,
    /// All of standard output.
    pub stdout: String,
    /// All of standard error.
    pub stderr: String,
}

impl Daemon {
    /// Starts `binary` with `args` in `folder`.
    ///
    /// # Panics
    /// Where it cannot be started: the test has no subject.
    pub fn start(binary: &str, args: &[&str], folder: &Path) -> Self {
        Self::start_with(binary, args, folder, &[])
    }

    /// The same with additional variables in its environment. Where they do not name one, `folder` is also that for
    /// status and sockets, so that tests know nothing of each other's daemons and leave nothing behind.
    ///
    /// # Panics
    /// Where it cannot be started.
    pub fn start_with(binary: &str, args: &[&str], folder: &Path, environment: &[(&str, &Path)]) -> Self {
        let mut child = Command::new(binary)
            .args(args)
            .env("XDG_RUNTIME_DIR", folder)
            .env("TMPDIR", folder)
            .env("HOLOD_DARK_NOTES", folder)
            .env("DBUS_SYSTEM_BUS_ADDRESS", NO_BUS)
            .env_remove("RUNTIME_DIRECTORY")
            .envs(environment.iter().copied())
            .current_dir(folder)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("holod starts");
        let stdout = child.stdout.take().map(read_to_end);
        let stderr = child.stderr.take().map(read_to_end);
        Self { child, stdout, stderr }
    }

    /// Its process number.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal.
    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.child.id() as i32).expect("a child has a process number");
        kill_process(pid, signal).expect("the child takes signals");
    }

    /// Whether it still runs.
    pub fn runs(&mut self) -> bool {
        self.child.try_wait().expect("a child can be asked").is_none()
    }

    /// Waits for its end.
    ///
    /// # Panics
    /// Where it has not ended within `patience`.
    pub fn wait(mut self, patience: Duration) -> Ended {
        let began = Instant::now();
        while self.runs() {
            assert!(began.elapsed() < patience, "holod has not ended within {patience:?}");
            thread::sleep(Duration::from_millis(10));
        }
        let status = self.child.wait().expect("a child that ended has a status");
        Ended {
            status,
            stdout: self.stdout.take().map(text_of).unwrap_or_default(),
            stderr: self.stderr.take().map(text_of).unwrap_or_default(),
        }
    }
}

/// Reads a pipe from the beginning on, so that a talkative child never waits for its reader.
fn read_to_end(mut pipe: impl Read + Send + 'static) -> JoinHandle<String> {
    thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = pipe.read_to_end(&mut bytes);
        String::from_utf8_lossy(&bytes).into_owned()
    })
}

fn text_of(reader: JoinHandle<String>) -> String {
    reader.join().expect("the reader ends with the pipe")
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Runs `binary` to its end.
pub fn run(binary: &str, args: &[&str], folder: &Path) -> Ended {
    Daemon::start(binary, args, folder).wait(Duration::from_secs(120))
}

/// Waits until `done`, at most `patience`; false where it never came.
pub fn wait_until(patience: Duration, mut done: impl FnMut() -> bool) -> bool {
    let began = Instant::now();
    while began.elapsed() < patience {
        if done() {
            return true;
        }
        thread::sleep(Duration::from_millis(20));
    }
    false
}
