//! A laser box without lasers as a process or thread of its own: the reference firmware on a pseudo-terminal.
//!
//! It outlives the program that it serves, so its log tells what the lasers did when that program was killed. Its clock
//! is its own, with an offset and a drift, and faults can be put into it.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::time::Duration;

use holod_calibration::TimeNs;
use holod_laser_firmware::command::SIMULATED;
use holod_laser_firmware::{Command, Controller, Event, Hardware, Laser, Limits, Line, TimeUs};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use super::BoxEvent;
use super::edge_log::{LOG_HEADER, write_event};

/// How long the firmware rests where nothing has come.
const REST: Duration = Duration::from_micros(200);

/// A simulated box's clock, in the host's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SimulatedClock {
    /// When the box booted.
    pub t_boot: TimeNs,
    /// What its clock showed then, microseconds.
    pub offset_us: u64,
    /// By how much it runs faster than the host's, parts per million.
    pub drift_ppm: i64,
}

impl SimulatedClock {
    /// A clock that begins at 0 and does not drift.
    pub const fn exact(t_boot: TimeNs) -> Self {
        Self { t_boot, offset_us: 0, drift_ppm: 0 }
    }

    /// What it shows at `host` time.
    pub fn at(&self, host: TimeNs) -> TimeUs {
        let since_ns = i128::from((host.0 - self.t_boot.0).max(0));
        let us = since_ns * i128::from(1_000_000 + self.drift_ppm) / 1_000_000_000;
        TimeUs(self.offset_us + u64::try_from(us).unwrap_or(0))
    }

    /// The host's time at which it begins to show `t`.
    pub fn host_time(&self, t: TimeUs) -> TimeNs {
        let since_us = i128::from(t.0) - i128::from(self.offset_us);
        let ns = since_us * 1_000_000_000 / i128::from(1_000_000 + self.drift_ppm);
        TimeNs(self.t_boot.0 + i64::try_from(ns).unwrap_or(i64::MAX / 2))
    }
}

/// What can be done to a simulated box while it runs, from another thread.
#[derive(Debug)]
pub struct Faults {
    interlock_open: AtomicBool,
    frozen: AtomicBool,
    corrupt_in: AtomicBool,
    corrupt_out: AtomicBool,
    cut: AtomicBool,
    ignores_silence: AtomicBool,
    sync_period_ns: AtomicU64,
    sync_begin_ns: AtomicI64,
    resets: AtomicU64,
    unplugged: AtomicBool,
}

impl Default for Faults {
    /// None; no panel at the sync wire.
    fn default() -> Self {
        Self {
            interlock_open: AtomicBool::new(false),
            frozen: AtomicBool::new(false),
            corrupt_in: AtomicBool::new(false),
            corrupt_out: AtomicBool::new(false),
            cut: AtomicBool::new(false),
            ignores_silence: AtomicBool::new(false),
            sync_period_ns: AtomicU64::new(0),
            sync_begin_ns: AtomicI64::new(0),
            resets: AtomicU64::new(0),
            unplugged: AtomicBool::new(false),
        }
    }
}

impl Faults {
    /// Opens or closes the interlock.
    pub fn set_interlock_open(&self, open: bool) {
        self.interlock_open.store(open, Ordering::Relaxed);
    }

    /// Stops the firmware, or lets it run on. Its watchdog would reset a real board; the log of a frozen box ends.
    pub fn set_frozen(&self, frozen: bool) {
        self.frozen.store(frozen, Ordering::Relaxed);
    }

    /// Damages the next bytes that the box receives.
    pub fn corrupt_received(&self) {
        self.corrupt_in.store(true, Ordering::Relaxed);
    }

    /// Damages the next line that the box sends.
    pub fn corrupt_sent(&self) {
        self.corrupt_out.store(true, Ordering::Relaxed);
    }

    /// Pulls the cable, or plugs it in again: what is sent is lost in both directions, and neither end notices.
    pub fn set_cut(&self, cut: bool) {
        self.cut.store(cut, Ordering::Relaxed);
    }

    /// Lets the firmware take silence for heartbeats, as one without a timeout would.
    pub fn set_ignores_silence(&self, ignores_silence: bool) {
        self.ignores_silence.store(ignores_silence, Ordering::Relaxed);
    }

    /// Resets the box, as its watchdog or a dip of its supply would.
    pub fn reset(&self) {
        self.resets.fetch_add(1, Ordering::Relaxed);
    }

    /// Pulls the box's cable, which is also its supply: [`SimulatedTerminal::serve`] ends.
    pub fn unplug(&self) {
        self.unplugged.store(true, Ordering::Relaxed);
    }

    /// Gives the sync wire an edge every `period` from `t_begin` on; none for a period of 0.
    pub fn set_sync(&self, t_begin: TimeNs, period: TimeNs) {
        self.sync_begin_ns.store(t_begin.0, Ordering::Relaxed);
        self.sync_period_ns.store(u64::try_from(period.0).unwrap_or(0), Ordering::Relaxed);
    }
}

/// What a simulated box is like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SimulatedBox {
    /// Its name; [`SIMULATED`] says that it has no lasers.
    pub name: &'static str,
    /// What it is built for.
    pub limits: Limits,
    /// Its microseconds, which begin and drift as those of a real one.
    pub clock: SimulatedClock,
    /// Whether its line can hang up. Without that a host that goes is silence, no more, as on a bare serial line.
    pub sees_hang_up: bool,
}

impl SimulatedBox {
    /// A box that booted at `t_boot` and is built for whatever a rig may ask, with a sync input.
    pub const fn new(t_boot: TimeNs) -> Self {
        Self {
            name: SIMULATED,
            limits: Limits {
                power_uw: [500_000; 3],
                timeout_us: 1_000_000,
                lit_us: 100_000,
                jitter_us: 0,
                sync_input: true,
            },
            clock: SimulatedClock::exact(t_boot),
            sees_hang_up: true,
        }
    }

    /// Serves one host until its line has hung up and the box is dark, and logs what the lasers do as lines of CSV
    /// under [`LOG_HEADER`], in the host's time.
    ///
    /// `reader` returns within some milliseconds, with [`ErrorKind::WouldBlock`] or [`ErrorKind::TimedOut`] where
    /// nothing is there. Answers that cannot be sent are dropped.
    ///
    /// # Errors
    /// [`io::Error`] where the log cannot be written.
    pub fn serve(
        &self,
        reader: impl Read,
        writer: impl Write,
        mut log: impl Write,
        faults: &Faults,
        now: fn() -> TimeNs,
    ) -> io::Result<()> {
        writeln!(log, "{LOG_HEADER}")?;
        log.flush()?;
        let mut controller = self.boot(reader, writer, faults, now);
        while step(&mut controller, &mut log, faults)? {}
        Ok(())
    }

    fn boot<'a, R: Read, W: Write>(
        &self,
        reader: R,
        writer: W,
        faults: &'a Faults,
        now: fn() -> TimeNs,
    ) -> Controller<Board<'a, R, W>> {
        let board = Board {
            reader,
            writer,
            clock: self.clock,
            now,
            faults,
            sees_hang_up: self.sees_hang_up,
            hung_up: false,
            idle: false,
            in_line: false,
            last_edge: None,
        };
        Controller::new(board, self.name, self.limits)
    }
}

/// The pins, clock and line of a simulated board.
struct Board<'a, R, W> {
    reader: R,
    writer: W,
    clock: SimulatedClock,
    now: fn() -> TimeNs,
    faults: &'a Faults,
    sees_hang_up: bool,
    hung_up: bool,
    idle: bool,
    /// A line has begun and not ended.
    in_line: bool,
    /// Host time of the last sync edge that was handed out.
    last_edge: Option<i64>,
}

impl<R: Read, W: Write> Hardware for Board<'_, R, W> {
    fn now(&mut self) -> TimeUs {
        self.clock.at((self.now)())
    }

    fn sync_edge(&mut self) -> Option<TimeUs> {
        let period_ns = i64::try_from(self.faults.sync_period_ns.load(Ordering::Relaxed)).unwrap_or(0);
        let begin_ns = self.faults.sync_begin_ns.load(Ordering::Relaxed);
        let since_ns = (self.now)().0 - begin_ns;
        if period_ns == 0 || since_ns < 0 {
            return None;
        }
        // A capture register holds the last edge only.
        let edge_ns = begin_ns + since_ns / period_ns * period_ns;
        (self.last_edge.replace(edge_ns) != Some(edge_ns)).then(|| self.clock.at(TimeNs(edge_ns)))
    }

    fn interlock_closed(&mut self) -> bool {
        !self.faults.interlock_open.load(Ordering::Relaxed)
    }

    fn host_present(&mut self) -> bool {
        !(self.hung_up && self.sees_hang_up)
    }

    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        let received = match self.reader.read(bytes) {
            Ok(0) => Err(ErrorKind::BrokenPipe),
            Ok(count) => Ok(count),
            Err(why) => Err(why.kind()),
        };
        self.idle = received.is_err();
        match received {
            Ok(_) if self.faults.cut.load(Ordering::Relaxed) => {
                self.hung_up = false;
                0
            }
            Ok(count) => {
                self.hung_up = false;
                if self.faults.corrupt_in.swap(false, Ordering::Relaxed) {
                    bytes[0] ^= 4;
                }
                self.in_line = bytes[count - 1] != b'\n';
                count
            }
            Err(ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {
                self.hung_up = false;
                let beats = self.faults.ignores_silence.load(Ordering::Relaxed) && !self.in_line;
                if beats { heartbeat_in(bytes) } else { 0 }
            }
            Err(_) => {
                self.hung_up = true;
                0
            }
        }
    }

    fn send(&mut self, line: &[u8]) {
        if self.faults.cut.load(Ordering::Relaxed) {
            return;
        }
        let mut line = line.to_vec();
        if self.faults.corrupt_out.swap(false, Ordering::Relaxed) {
            line[0] ^= 4;
        }
        let _dropped = self.writer.write_all(&line);
    }

    fn set_gate(&mut self, _lit: Option<Laser>) {}

    fn set_power(&mut self, _power_uw: [u32; 3]) {}

    fn feed_watchdog(&mut self) {}
}

/// A heartbeat that no host has sent, where there is room for one. Its answer is to no command of a host's.
fn heartbeat_in(bytes: &mut [u8]) -> usize {
    let line = Line::new(format_args!("0 {}", Command::Heartbeat.word())).expect("it fits into a line");
    let Some(room) = bytes.get_mut(..line.as_bytes().len()) else { return 0 };
    room.copy_from_slice(line.as_bytes());
    room.len()
}

/// One turn of the firmware's loop; false once the line has hung up and the box is dark.
fn step<R: Read, W: Write>(
    controller: &mut Controller<Board<'_, R, W>>,
    log: &mut impl Write,
    faults: &Faults,
) -> io::Result<bool> {
    if faults.frozen.load(Ordering::Relaxed) {
        std::thread::sleep(REST);
        return Ok(true);
    }
    let clock = controller.hardware_mut().clock;
    let mut written = Ok(());
    let mut any = false;
    controller.step(&mut |event: Event| {
        any = true;
        if written.is_ok() {
            written = write_event(log, BoxEvent::of(event, |t| clock.host_time(t)));
        }
    });
    written?;
    if any {
        log.flush()?;
    }
    let board = controller.hardware_mut();
    if board.idle {
        std::thread::sleep(REST);
    }
    Ok(!board.hung_up || controller.machine().is_armed())
}

/// A pseudo-terminal with a simulated box behind it.
#[derive(Debug)]
pub struct SimulatedTerminal {
    terminal: File,
    path: PathBuf,
}

impl SimulatedTerminal {
    /// Opens a new one.
    ///
    /// # Errors
    /// [`io::Error`] where the system has none.
    pub fn open() -> io::Result<Self> {
        let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&terminal)?;
        unlockpt(&terminal)?;
        let name = ptsname(&terminal, Vec::new())?;
        let path = PathBuf::from(OsString::from_vec(name.into_bytes()));
        // Without echo from the first byte on, whatever the host sets later.
        let mut attributes = tcgetattr(&terminal)?;
        attributes.make_raw();
        tcsetattr(&terminal, OptionalActions::Now, &attributes)?;
        rustix::fs::fcntl_setfl(&terminal, rustix::fs::OFlags::NONBLOCK)?;
        Ok(Self { terminal: File::from(terminal), path })
    }

    /// The path that a host opens.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Serves one host after another until it is unplugged, and logs as [`SimulatedBox::serve`] does. The box keeps its
    /// program between hosts; a reset takes it away.
    ///
    /// # Errors
    /// [`io::Error`] where the log cannot be written.
    pub fn serve(
        self,
        simulated: SimulatedBox,
        mut log: impl Write,
        faults: &Faults,
        now: fn() -> TimeNs,
    ) -> io::Result<()> {
        writeln!(log, "{LOG_HEADER}")?;
        log.flush()?;
        let mut resets = faults.resets.load(Ordering::Relaxed);
        let mut controller = simulated.boot(&self.terminal, &self.terminal, faults, now);
        while !faults.unplugged.load(Ordering::Relaxed) {
            if !step(&mut controller, &mut log, faults)? {
                // A terminal that nobody has open looks hung up, too.
                std::thread::sleep(Duration::from_millis(2));
            }
            if faults.resets.load(Ordering::Relaxed) != resets {
                resets = faults.resets.load(Ordering::Relaxed);
                log_power_cut(&controller, now(), &mut log)?;
                let clock = SimulatedClock { t_boot: now(), offset_us: 0, ..simulated.clock };
                controller = SimulatedBox { clock, ..simulated }.boot(&self.terminal, &self.terminal, faults, now);
            }
        }
        log_power_cut(&controller, now(), &mut log)
    }
}

/// Without its program or its supply a board's gates are closed by its resistors.
fn log_power_cut<R: Read, W: Write>(
    controller: &Controller<Board<'_, R, W>>,
    t: TimeNs,
    log: &mut impl Write,
) -> io::Result<()> {
    let machine = controller.machine();
    if let Some(laser) = machine.lit() {
        let off = Event::Off { t: TimeUs(0), laser };
        write_event(log, BoxEvent::of(off, |_| t))?;
    }
    if machine.is_armed() {
        write_event(log, BoxEvent::Dark { t, reason: super::DarkReason::Boot })?;
    }
    log.flush()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_with_offset_and_drift_comes_back() {
        for (offset_us, drift_ppm) in [(0, 0), (5_000_000_000, 80), (7, -80)] {
            let clock = SimulatedClock { t_boot: TimeNs(1_000_000_123), offset_us, drift_ppm };
            for host in [1_000_000_123i64, 1_000_001_999, 5_000_000_000_000] {
                let t = clock.at(TimeNs(host));
                let back = clock.host_time(t);
                assert!((0..=1001).contains(&(host - back.0)), "{host} {back:?}");
                assert_eq!(clock.at(TimeNs(back.0 + 1)), t);
            }
        }
        let fast = SimulatedClock { t_boot: TimeNs(0), offset_us: 10, drift_ppm: 100 };
        assert_eq!(fast.at(TimeNs(1_000_000_000)), TimeUs(1_000_110));
    }
}
