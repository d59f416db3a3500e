//! What the operating system and its service manager are told, and tell.

use std::ffi::OsStr;
use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Once};
use std::time::Duration;

use holod_calibration::rig::LaserDriver;
use holod_calibration::{TimeNs, hangup_is_ignored};
use sd_notify::NotifyState;
use signal_hook::SigId;
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGTSTP};

use crate::failure::{Exit, Failure};
use crate::staging::leave_signals_to_a_run;

/// SIGHUPs that ask for the rig file to be read again, for as long as this lives.
pub struct Hangups {
    asked: Arc<AtomicBool>,
    registered: SigId,
}

impl Hangups {
    /// Takes the signal over where holod has no terminal, as under systemd; where it has one, the signal says that the
    /// terminal has gone, and nothing is taken over.
    ///
    /// # Errors
    /// The system refuses.
    pub(crate) fn take_over() -> Result<Option<Self>, Failure> {
        if has_terminal() {
            return Ok(None);
        }
        let asked = Arc::new(AtomicBool::new(false));
        let registered = signal_hook::flag::register(SIGHUP, Arc::clone(&asked));
        let registered = registered.map_err(Failure::because(Exit::Software))?;
        Ok(Some(Self { asked, registered }))
    }

    /// Whether one came since the last call.
    pub(crate) fn asked(&self) -> bool {
        self.asked.swap(false, Ordering::AcqRel)
    }
}

impl Drop for Hangups {
    fn drop(&mut self) {
        signal_hook::low_level::unregister(self.registered);
    }
}

/// Whether there is a controlling terminal. What cannot be found out counts as one: its end ends the run.
fn has_terminal() -> bool {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name, which may hold anything: state, parent, group, session, terminal.
    let terminal = stat.rsplit_once(')').and_then(|(_, fields)| fields.split_whitespace().nth(4));
    terminal != Some("0")
}

/// SIGINT, SIGTERM, SIGQUIT and, where it is not taken over for something else, SIGHUP, as a flag, for as long as this
/// lives.
pub(crate) struct Signals {
    caught: Arc<AtomicUsize>,
    /// The next signal ends the process at once.
    again: Arc<AtomicBool>,
    registered: Vec<SigId>,
    /// What sets that at the first one.
    first: Vec<SigId>,
    /// Those that are taken over.
    signals: Vec<i32>,
    /// Nothing ends the process at once before its lasers are out.
    after_lasers: bool,
    /// SIGTSTP came, which is not obeyed then.
    suspended: Arc<AtomicBool>,
}

impl Signals {
    /// Takes the signals over. A second one while the first is being obeyed ends the process at once: the laser box's
    /// heartbeat makes it dark. For lasers without one there is [`Self::end_after_lasers`].
    pub(crate) fn install(hangups: Option<&Hangups>) -> Result<Self, Failure> {
        let caught = Arc::new(AtomicUsize::new(0));
        let again = Arc::new(AtomicBool::new(false));
        let mut signals = Self {
            caught,
            again,
            registered: Vec::new(),
            first: Vec::new(),
            signals: Vec::new(),
            after_lasers: false,
            suspended: Arc::default(),
        };
        leave_signals_to_a_run(true);
        let ends_on_hangup = hangups.is_none() && !hangup_is_ignored();
        for signal in [SIGINT, SIGTERM, SIGQUIT].into_iter().chain(ends_on_hangup.then_some(SIGHUP)) {
            signals.signals.push(signal);
            let caught = Arc::clone(&signals.caught);
            for registered in [
                signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, Arc::clone(&signals.again)),
                signal_hook::flag::register_usize(signal, caught, signal as usize),
            ] {
                signals.registered.push(registered.map_err(Failure::because(Exit::Software))?);
            }
            let at_first = signal_hook::flag::register(signal, Arc::clone(&signals.again));
            signals.first.push(at_first.map_err(Failure::because(Exit::Software))?);
        }
        Ok(signals)
    }

    /// From now on a second signal ends the process only after [`Self::lasers_are_out`], and SIGTSTP does not suspend
    /// it: lasers that `driver` does not put out by itself would stay lit.
    pub(crate) fn end_after_lasers(&mut self, driver: &LaserDriver) {
        if driver.has_heartbeat() {
            return;
        }
        for id in self.first.drain(..) {
            signal_hook::low_level::unregister(id);
        }
        self.again.store(false, Ordering::Release);
        self.after_lasers = true;
        // Where it cannot be taken over, the process is suspended as ever.
        self.registered.extend(signal_hook::flag::register(SIGTSTP, Arc::clone(&self.suspended)));
    }

    /// Says why the process was not suspended, where somebody wanted it.
    pub(crate) fn tell_of_suspension(&self) {
        if self.suspended.swap(false, Ordering::AcqRel) {
            tracing::warn!(
                "SIGTSTP (Ctrl-Z) is not obeyed: the lasers have no heartbeat and would stay lit; Ctrl-C ends holod"
            );
        }
    }

    /// The way down has begun: says what a second signal does not do.
    pub(crate) fn lasers_go_out(&self) {
        if self.after_lasers && self.caught().is_some() {
            tracing::info!("the lasers have no heartbeat: a second signal ends holod only once they have been put out");
        }
    }

    /// The lasers have been told to go out, as often as they are told at all: a second signal ends the process from now
    /// on.
    pub(crate) fn lasers_are_out(&mut self) {
        if self.after_lasers {
            for &signal in &self.signals {
                // Where it cannot be, signals wait for the end as before.
                self.first.extend(signal_hook::flag::register(signal, Arc::clone(&self.again)));
            }
        }
        if self.caught().is_some() {
            self.again.store(true, Ordering::Release);
        }
    }

    /// The name of the signal that ends the run, where it came.
    pub(crate) fn caught(&self) -> Option<&'static str> {
        match self.caught.load(Ordering::Acquire) as i32 {
            0 => None,
            SIGINT => Some("SIGINT"),
            SIGTERM => Some("SIGTERM"),
            SIGQUIT => Some("SIGQUIT"),
            _ => Some("SIGHUP"),
        }
    }
}

impl Drop for Signals {
    fn drop(&mut self) {
        for id in self.registered.drain(..).chain(self.first.drain(..)) {
            signal_hook::low_level::unregister(id);
        }
        leave_signals_to_a_run(false);
    }
}

/// How long the service manager waits for a part of the start at least, beside its own limit for the whole.
const LONGEST_STEP: Duration = Duration::from_secs(120);

/// The service manager's end of the line; silent where there is none.
pub(super) struct Service {
    watchdog: Option<Watchdog>,
    ready: bool,
}

/// Decides when the service manager's watchdog is fed: only when frames have come on the panel since the last time, or
/// none can because the panel is lost and waited for. A restart would not bring it back.
#[derive(Debug)]
struct Watchdog {
    every: TimeNs,
    t_fed: TimeNs,
    frames_fed: u64,
}

impl Watchdog {
    fn feed_if_due(&mut self, frames_shown: u64, awaits_panel: bool, now: TimeNs) -> bool {
        let due = now - self.t_fed >= self.every && (frames_shown > self.frames_fed || awaits_panel);
        if due {
            (self.t_fed, self.frames_fed) = (now, frames_shown);
        }
        due
    }
}

impl Service {
    /// Looks whether a service manager listens.
    pub(super) fn connect() -> Self {
        let watchdog = sd_notify::watchdog_enabled().map(|limit: Duration| Watchdog {
            every: TimeNs(limit.as_nanos() as i64 / 4),
            t_fed: TimeNs(i64::MIN / 2),
            frames_fed: 0,
        });
        Self { watchdog, ready: false }
    }

    /// A part of the start begins that may take [`LONGEST_STEP`]: compiled shaders, a network's first frame.
    pub(super) fn starting(&self) {
        tell(&[NotifyState::ExtendTimeoutUsec(LONGEST_STEP.as_micros() as u32)]);
    }

    /// Frames were shown, or cannot be before a lost panel is back: tells readiness after the first, feeds the watchdog.
    pub(super) fn progress(&mut self, frames_shown: u64, awaits_panel: bool, now: TimeNs) {
        if frames_shown > 0 && !self.ready {
            self.ready = tell(&[NotifyState::Ready]);
        }
        if self.watchdog.as_mut().is_some_and(|watchdog| watchdog.feed_if_due(frames_shown, awaits_panel, now)) {
            tell(&[NotifyState::Watchdog]);
        }
    }

    /// One line for `systemctl status`.
    pub(super) fn status(&self, text: &str) {
        tell(&[NotifyState::Status(text)]);
    }

    /// The way down has begun.
    pub(super) fn stopping(&self) {
        tell(&[NotifyState::Stopping]);
    }
}

/// Tells the service manager, and says once where it does not listen. Whether it need not be told again.
fn tell(states: &[NotifyState<'_>]) -> bool {
    static WARNED: Once = Once::new();
    let Some(socket) = std::env::var_os("NOTIFY_SOCKET") else { return true };
    let sent = send(&socket, states);
    if let Err(error) = &sent {
        WARNED.call_once(|| tracing::warn!("the service manager does not listen: {error}"));
    }
    sent.is_ok()
}

/// Sends a datagram that is left out where nobody takes those before: the loop waits for no service manager.
fn send(socket: &OsStr, states: &[NotifyState<'_>]) -> io::Result<()> {
    let address = match socket.as_bytes() {
        [b'@', name @ ..] => SocketAddr::from_abstract_name(name)?,
        path => SocketAddr::from_pathname(Path::new(OsStr::from_bytes(path)))?,
    };
    let text: String = states.iter().map(|state| format!("{state}\n")).collect();
    let sender = UnixDatagram::unbound()?;
    sender.set_nonblocking(true)?;
    sender.send_to_addr(text.as_bytes(), &address).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_watchdog_starves_when_no_new_frame_is_shown() {
        let mut watchdog = Watchdog { every: TimeNs(100), t_fed: TimeNs(0), frames_fed: 0 };
        assert!(!watchdog.feed_if_due(0, false, TimeNs(1_000)));
        assert!(watchdog.feed_if_due(1, false, TimeNs(1_000)));
        assert!(!watchdog.feed_if_due(5, false, TimeNs(1_050)), "not due yet");
        assert!(watchdog.feed_if_due(5, false, TimeNs(1_100)));
        for t in 0..100 {
            assert!(!watchdog.feed_if_due(5, false, TimeNs(2_000 + t * 100)), "a stalled panel does not feed it");
        }
    }

    #[test]
    fn a_lost_panel_that_is_waited_for_feeds_the_watchdog() {
        let mut watchdog = Watchdog { every: TimeNs(100), t_fed: TimeNs(0), frames_fed: 5 };
        assert!(watchdog.feed_if_due(5, true, TimeNs(1_000)));
        assert!(!watchdog.feed_if_due(5, true, TimeNs(1_050)), "not due yet");
        assert!(watchdog.feed_if_due(5, true, TimeNs(1_100)));
        assert!(!watchdog.feed_if_due(5, false, TimeNs(2_000)), "it is back and shows nothing");
    }

    #[test]
    fn a_service_manager_who_takes_nothing_is_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let manager = UnixDatagram::bind(&path).unwrap();
        send(path.as_os_str(), &[NotifyState::Ready, NotifyState::Status("dark")]).unwrap();
        let mut buffer = [0; 256];
        let length = manager.recv(&mut buffer).unwrap();
        assert_eq!(&buffer[..length], b"READY=1\nSTATUS=dark\n");
        // More than any queue of datagrams holds.
        let refused = (0..100_000).find_map(|_| send(path.as_os_str(), &[NotifyState::Watchdog]).err());
        assert_eq!(refused.map(|error| error.kind()), Some(io::ErrorKind::WouldBlock));
    }
}
