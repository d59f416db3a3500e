//! Boxes that can set a power and switch it, and nothing more: neither do they gate single fields, nor do they go dark
//! by themselves when their host dies.
//!
//! Such devices take milliseconds to answer, so a thread of their own speaks to them. It also puts them out when the
//! laser thread has not been heard of for the heartbeat timeout; a process that is killed leaves them lit.

use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use holod_calibration::rig::Lasers;
use holod_calibration::{Colour, PerColour, TimeNs};
use rtrb::{Consumer, Producer, RingBuffer};
use serialport::TTYPort;

use super::line_link::{Sharing, open_port};
use super::program::power_limit_uw;
use super::{BoxEvent, Capability, DarkReason, LaserBox, LaserError, LaserProgram, LitWindow, Trigger};

/// How often a device is asked whether it is still there and healthy.
const PROBE_EVERY: TimeNs = TimeNs(500_000_000);
/// How long the thread rests where nothing is asked of it.
const REST: Duration = Duration::from_millis(5);
/// How long a program is waited for: some lines to each of three lasers.
const PROGRAM_WAIT: TimeNs = TimeNs(5_000_000_000);
/// How often the lasers are put out at the end where the device does not say that they are.
const LAST_TRIES: usize = 3;
/// How long a device is told to go out beside a program that takes its answers away.
const BESIDE_PATIENCE: TimeNs = TimeNs(8_000_000_000);
/// Between two tries of that; no share of [`PROBE_EVERY`], so that not every try meets the other program's question.
const BESIDE_REST: Duration = Duration::from_millis(37);
/// Orders and reports on their way.
const RING: usize = 64;

/// A device that sets powers and switches lasers; each call waits for its answer.
pub(super) trait PowerDevice: Send + 'static {
    /// Whether it has a laser of `colour`.
    fn has(&self, colour: Colour) -> bool;

    /// Sets the power of each laser for when it is lit, microwatts at the panel. Lights nothing.
    fn set_power(&mut self, power_uw: PerColour<u32>) -> Result<(), LaserError>;

    /// Lights the laser of `colour` or puts it out, and has made sure of it when it returns; one that is not there is
    /// out.
    fn switch(&mut self, colour: Colour, on: bool) -> Result<(), LaserError>;

    /// Lights the lasers of `lit` and puts out all others, and has made sure of both when it returns: out before on, and
    /// all that can be put out is, even where one of them does not obey.
    fn set_lit(&mut self, lit: PerColour<bool>) -> Result<(), LaserError> {
        let mut put_out = Ok(());
        for colour in Colour::ALL.into_iter().filter(|&colour| !lit[colour]) {
            put_out = put_out.and(self.switch(colour, false));
        }
        put_out?;
        Colour::ALL.into_iter().filter(|&colour| lit[colour]).try_for_each(|colour| self.switch(colour, true))
    }

    /// Asks one of the questions whether it is there and healthy, after `asked` of them; whether it was the last one.
    fn probe(&mut self, asked: usize) -> Result<bool, LaserError>;

    /// How long [`Self::set_lit`] may take to put all lasers out, or to fail, after the rest of a [`Self::probe`].
    fn dark_wait(&self) -> TimeNs;
}

pub(super) const NONE_LIT: PerColour<bool> = PerColour([false; 3]);

#[derive(Clone, Copy, Debug)]
enum Order {
    Power { power_uw: PerColour<u32>, timeout: TimeNs },
    Lit(PerColour<bool>),
}

#[derive(Debug)]
enum Report {
    /// The order has been carried out.
    Done(u32),
    /// A device that was lit was put out for want of a heartbeat.
    TimedOut { t: TimeNs },
    /// It failed at the order of that number; 0 where it failed by itself.
    Failed(u32, LaserError),
}

/// Drives a [`PowerDevice`] as a [`LaserBox`].
#[derive(Debug)]
pub(super) struct PowerBox {
    has: PerColour<bool>,
    power_limit_uw: PerColour<u32>,
    gated_by_panel: bool,
    dark_wait: TimeNs,
    /// The lasers of the program, once there is one.
    sequence: Option<PerColour<bool>>,
    armed: bool,
    orders: Producer<(u32, Order)>,
    reports: Consumer<Report>,
    last_order: u32,
    /// The order that arms, until it has been carried out.
    arming: Option<u32>,
    /// What has happened and has not been fetched.
    event: Option<BoxEvent>,
    t_heartbeat: Arc<AtomicI64>,
    stop: Arc<AtomicBool>,
    worker: Option<JoinHandle<()>>,
    clock: fn() -> TimeNs,
}

impl PowerBox {
    /// Drives `device`, which has been recognised, as `lasers` says.
    ///
    /// # Errors
    /// [`LaserError::NotAccepted`] where the rig does not accept lasers without a heartbeat; [`LaserError::Line`] where
    /// no thread can be started.
    pub(super) fn new(device: impl PowerDevice, lasers: &Lasers, clock: fn() -> TimeNs) -> Result<Self, LaserError> {
        require_acceptance(lasers)?;
        let (orders, order_consumer) = RingBuffer::new(RING);
        let (report_producer, reports) = RingBuffer::new(RING);
        let t_heartbeat = Arc::new(AtomicI64::new(clock().0));
        let stop = Arc::new(AtomicBool::new(false));
        let has = PerColour(Colour::ALL.map(|colour| device.has(colour)));
        let dark_wait = device.dark_wait();
        let worker = Worker {
            device,
            orders: order_consumer,
            reports: report_producer,
            t_heartbeat: Arc::clone(&t_heartbeat),
            stop: Arc::clone(&stop),
            timeout: lasers.heartbeat_timeout,
            maybe_lit: false,
            t_probe: clock(),
            asked: 0,
            failed: false,
            clock,
        };
        let worker = std::thread::Builder::new().name("holod-laser-dev".into()).spawn(move || worker.run())?;
        Ok(Self {
            has,
            power_limit_uw: power_limit_uw(lasers),
            gated_by_panel: lasers.gated_by_panel,
            dark_wait,
            sequence: None,
            armed: false,
            orders,
            reports,
            last_order: 0,
            arming: None,
            event: None,
            t_heartbeat,
            stop,
            worker: Some(worker),
            clock,
        })
    }

    fn order(&mut self, order: Order) -> Result<u32, LaserError> {
        self.last_order = self.last_order.wrapping_add(1).max(1);
        // Orders come from arming and darkness only; a device that lets 64 of them wait is at fault.
        let full = LaserError::NoAnswer { command: "power and switch", waited_ms: self.dark_wait.0 / 1_000_000 };
        self.orders.push((self.last_order, order)).map_err(|_| full)?;
        if let Some(worker) = &self.worker {
            worker.thread().unpark();
        }
        Ok(self.last_order)
    }

    /// Takes in what the worker has said; whether `awaited` has been carried out. A failure comes with the number of the
    /// order that failed.
    fn hear(&mut self, awaited: u32) -> Result<bool, (u32, LaserError)> {
        let mut done = false;
        while let Ok(report) = self.reports.pop() {
            match report {
                Report::Done(number) => {
                    done |= number == awaited;
                    if self.arming.take_if(|arming| *arming == number).is_some() && self.armed {
                        self.event = Some(BoxEvent::Armed { t: (self.clock)() });
                    }
                }
                Report::TimedOut { t } => self.went_dark(DarkReason::Heartbeat, t),
                Report::Failed(number, error) => {
                    self.went_dark(DarkReason::BoxFault, (self.clock)());
                    return Err((number, error));
                }
            }
        }
        Ok(done)
    }

    fn went_dark(&mut self, reason: DarkReason, t: TimeNs) {
        if std::mem::take(&mut self.armed) {
            self.event = Some(BoxEvent::Dark { t, reason });
        }
    }

    fn wait_for(&mut self, number: u32, patience: TimeNs, command: &'static str) -> Result<(), (u32, LaserError)> {
        let t_end = (self.clock)() + patience;
        while !self.hear(number)? {
            if (self.clock)() >= t_end {
                return Err((number, LaserError::NoAnswer { command, waited_ms: patience.0 / 1_000_000 }));
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }
}

/// Fails unless the rig accepts, in words, lasers without a heartbeat.
pub(super) fn require_acceptance(lasers: &Lasers) -> Result<(), LaserError> {
    if lasers.accept_no_heartbeat { Ok(()) } else { Err(LaserError::NotAccepted) }
}

/// Puts out the lasers of a device that another program may be speaking to, which takes some of its answers away and
/// puts its own beside them: the device is asked who it is until it says so, and from then on told to go out until it
/// acknowledges that, whatever else it says.
///
/// # Errors
/// The last try's, after some seconds; [`LaserError::Line`] of a line that is not merely full, [`LaserError::Open`] and
/// [`LaserError::NotAllowed`] at once.
pub(super) fn put_out_beside<D>(
    clock: fn() -> TimeNs,
    open: impl Fn() -> Result<D, LaserError>,
    recognise: impl Fn(&mut D) -> Result<(), LaserError>,
    mut put_out: impl FnMut(&mut D) -> Result<(), LaserError>,
) -> Result<(), LaserError> {
    let t_end = clock() + BESIDE_PATIENCE;
    let (mut device, mut recognised) = (None, false);
    let mut attempt = || {
        let device = match &mut device {
            Some(device) => device,
            none => none.insert(open()?),
        };
        if !recognised {
            recognise(device)?;
            recognised = true;
        }
        put_out(device)
    };
    loop {
        match attempt() {
            Ok(()) => return Ok(()),
            Err(last) if clock() >= t_end => return Err(last),
            // There was no room on the line for the word, since the other host talks much.
            Err(LaserError::Line(full)) if full.kind() == ErrorKind::WouldBlock => std::thread::sleep(BESIDE_REST),
            Err(final_one @ (LaserError::Line(_) | LaserError::Open { .. } | LaserError::NotAllowed { .. })) => {
                return Err(final_one);
            }
            Err(_) => std::thread::sleep(BESIDE_REST),
        }
    }
}

/// The lasers that are lit in `program`, of those that a bench `has`: one without power stays off. Of several colours a
/// panel gates the lasers (`gated_by_panel`) only where its own sequencer shows them, in channel-packed mode.
///
/// # Errors
/// [`LaserError::CannotGate`], [`LaserError::NoLaser`].
pub(super) fn colours_lit(
    program: &LaserProgram,
    gated_by_panel: bool,
    has: PerColour<bool>,
) -> Result<PerColour<bool>, LaserError> {
    let is_in = |colour: Colour| program.sequence.contains(&colour);
    let panel_gates = gated_by_panel && program.trigger == Trigger::PanelSync;
    // One that is lit among fields of others would be on in theirs, too.
    if Colour::ALL.into_iter().filter(|&colour| is_in(colour)).count() > 1 && !panel_gates {
        return Err(LaserError::CannotGate);
    }
    let lit = PerColour(Colour::ALL.map(|colour| is_in(colour) && program.power_uw[colour] > 0));
    match Colour::ALL.into_iter().find(|&colour| lit[colour] && !has[colour]) {
        None => Ok(lit),
        Some(colour) => Err(LaserError::NoLaser { colour }),
    }
}

impl LaserBox for PowerBox {
    fn capability(&self) -> Capability {
        Capability { simulated: false, gates_fields: false, has_heartbeat: false, sync_wire: false }
    }

    fn dark_wait(&self) -> TimeNs {
        self.dark_wait
    }

    fn program(&mut self, program: &LaserProgram, _now: TimeNs) -> Result<(), LaserError> {
        let lit = colours_lit(program, self.gated_by_panel, self.has)?;
        for colour in Colour::ALL.into_iter().filter(|&colour| lit[colour]) {
            if program.power_uw[colour] > self.power_limit_uw[colour] {
                let found = format!("{} mW for {colour}", f64::from(program.power_uw[colour]) / 1e3);
                return Err(LaserError::Figure { what: "power_mw", found, expected: "not more than power_limit_mw" });
            }
        }
        self.sequence = None;
        let order = Order::Power { power_uw: program.power_uw, timeout: program.heartbeat_timeout };
        let number = self.order(order)?;
        self.wait_for(number, PROGRAM_WAIT, "power").map_err(|(_, error)| error)?;
        self.sequence = Some(lit);
        Ok(())
    }

    fn arm(&mut self, now: TimeNs) -> Result<(), LaserError> {
        let not_programmed = LaserError::Refused { command: "arm", refusal: super::Refusal::NotProgrammed };
        let lit = self.sequence.ok_or(not_programmed)?;
        self.t_heartbeat.store(now.0, Ordering::Release);
        if !self.armed {
            self.arming = Some(self.order(Order::Lit(lit))?);
            self.armed = true;
        }
        Ok(())
    }

    fn sync(&mut self, _t_sync: TimeNs, _now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        Ok(None)
    }

    fn light(&mut self, _window: LitWindow, _now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        Ok(None)
    }

    fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.t_heartbeat.store(now.0, Ordering::Release);
        Ok(())
    }

    fn dark(&mut self, reason: DarkReason, _now: TimeNs) -> Result<(), LaserError> {
        self.arming = None;
        let number = self.order(Order::Lit(NONE_LIT))?;
        // What was said to earlier orders, a failure say, is no answer to this one.
        let answered = match self.wait_for(number, self.dark_wait, "off") {
            Err((of, _)) if of != number => self.wait_for(number, self.dark_wait, "off"),
            answered => answered,
        };
        if answered.is_ok() {
            self.went_dark(reason, (self.clock)());
        }
        answered.map_err(|(_, error)| error)
    }

    fn poll(&mut self, _now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
        let heard = self.hear(0);
        if let Some(happened) = self.event.take() {
            event(happened);
        }
        heard.map(drop).map_err(|(_, error)| error)
    }
}

impl Drop for PowerBox {
    /// The worker puts the lasers out before it ends.
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(worker) = self.worker.take() {
            worker.thread().unpark();
            // Its panic, if there was one, has been reported by the panic hook.
            let _ended = worker.join();
        }
    }
}

/// The thread that speaks to the device.
struct Worker<D> {
    device: D,
    orders: Consumer<(u32, Order)>,
    reports: Producer<Report>,
    t_heartbeat: Arc<AtomicI64>,
    stop: Arc<AtomicBool>,
    timeout: TimeNs,
    /// Not known to be out.
    maybe_lit: bool,
    t_probe: TimeNs,
    /// Questions of a probe that goes on.
    asked: usize,
    /// It failed and was not heard of since.
    failed: bool,
    clock: fn() -> TimeNs,
}

impl<D: PowerDevice> Worker<D> {
    fn run(mut self) {
        while !self.stop.load(Ordering::Acquire) {
            while let Ok((number, order)) = self.orders.pop() {
                // What comes after it puts them out.
                if matches!(order, Order::Lit(lit) if lit != NONE_LIT) && !self.orders.is_empty() {
                    continue;
                }
                let done = self.obey(order);
                self.report(number, done);
            }
            let now = (self.clock)();
            let silent = now.0 - self.t_heartbeat.load(Ordering::Acquire) > self.timeout.0;
            // Again and again, until the device says that they are out.
            if self.maybe_lit && (silent || self.failed) {
                let put_out = self.set_lit(NONE_LIT);
                match put_out {
                    Ok(()) if silent => drop(self.reports.push(Report::TimedOut { t: (self.clock)() })),
                    Ok(()) => {}
                    Err(_) if self.failed => {}
                    failed => {
                        self.failed = true;
                        self.report(0, failed);
                    }
                }
            }
            // A question at a time: no order waits for all of them.
            if self.asked > 0 || now.0 - self.t_probe.0 > PROBE_EVERY.0 {
                let probed = self.device.probe(self.asked);
                if let Ok(false) = probed {
                    self.asked += 1;
                    continue;
                }
                (self.t_probe, self.asked) = (now, 0);
                let probed = probed.map(drop);
                let news = probed.is_err() && !self.failed;
                self.failed = probed.is_err();
                if news {
                    // Whatever it is, it is not lit any longer than it must be.
                    let _reported_below = self.set_lit(NONE_LIT);
                    self.report(0, probed);
                }
            }
            std::thread::park_timeout(REST);
        }
        // Nobody listens any more, and a line may swallow an order.
        let _put_out = (0..LAST_TRIES).any(|_| self.device.set_lit(NONE_LIT).is_ok());
    }

    fn obey(&mut self, order: Order) -> Result<(), LaserError> {
        match order {
            Order::Power { power_uw, timeout } => {
                self.timeout = timeout;
                self.set_lit(NONE_LIT)?;
                self.device.set_power(power_uw)
            }
            // Until it says that it is well again.
            Order::Lit(lit) if lit != NONE_LIT && self.failed => Err(LaserError::Lost),
            Order::Lit(lit) => self.set_lit(lit),
        }
    }

    fn set_lit(&mut self, lit: PerColour<bool>) -> Result<(), LaserError> {
        let done = self.device.set_lit(lit);
        self.maybe_lit = match &done {
            Ok(()) => lit != NONE_LIT,
            // It may have done half of it.
            Err(_) => lit == NONE_LIT || self.device.set_lit(NONE_LIT).is_err(),
        };
        done
    }

    fn report(&mut self, number: u32, done: Result<(), LaserError>) {
        let report = match done {
            Ok(()) => Report::Done(number),
            Err(error) => Report::Failed(number, error),
        };
        // Where nobody has listened for 64 reports nobody will.
        let _full = self.reports.push(report);
    }
}

/// A port for questions and answers, each of which waits.
#[derive(Debug)]
pub(super) struct Conversation {
    path: PathBuf,
    reader: TTYPort,
    writer: TTYPort,
    clock: fn() -> TimeNs,
}

impl Conversation {
    /// Opens the port at `path`.
    pub(super) fn open(path: &Path, baud: u32, sharing: Sharing, clock: fn() -> TimeNs) -> Result<Self, LaserError> {
        let [reader, mut writer] = open_port(path, baud, sharing)?;
        // This thread may wait for a slow device's buffer.
        let patience = serialport::SerialPort::set_timeout(&mut writer, Duration::from_millis(500));
        patience.map_err(|why| LaserError::Open { path: path.display().to_string(), why: why.to_string() })?;
        Ok(Self { path: path.into(), reader, writer, clock })
    }

    /// The port, for messages.
    pub(super) fn path(&self) -> String {
        self.path.display().to_string()
    }

    /// Sends `bytes`, after whatever has come unasked is thrown away.
    pub(super) fn send(&mut self, bytes: &[u8]) -> Result<(), LaserError> {
        let cleared = serialport::SerialPort::clear(&self.reader, serialport::ClearBuffer::Input);
        cleared.map_err(std::io::Error::from)?;
        Ok(self.writer.write_all(bytes)?)
    }

    /// The end of `patience` from now on.
    pub(super) fn t_end(&self, patience: TimeNs) -> TimeNs {
        (self.clock)() + patience
    }

    /// The next line that is not empty, without CR and LF; nothing where none is complete at `t_end`.
    pub(super) fn line_until(&mut self, t_end: TimeNs) -> Result<Option<Vec<u8>>, LaserError> {
        const LINE_BYTES_MAX: usize = 1024;
        let mut line = Vec::new();
        while (self.clock)() < t_end {
            let mut byte = [0];
            match self.reader.read(&mut byte) {
                Ok(0) => return Err(std::io::Error::from(ErrorKind::BrokenPipe).into()),
                Ok(_) if matches!(byte[0], b'\r' | b'\n') && line.is_empty() => {}
                Ok(_) if matches!(byte[0], b'\r' | b'\n') => return Ok(Some(line)),
                Ok(_) if line.len() == LINE_BYTES_MAX => return Ok(Some(line)),
                Ok(_) => line.push(byte[0]),
                Err(why) if matches!(why.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock) => {}
                Err(why) if why.kind() == ErrorKind::Interrupted => {}
                Err(why) => return Err(why.into()),
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    /// A device that remembers whether it was lit or put out, and ends its thread when it is put out.
    struct Told(Arc<Mutex<Vec<bool>>>, Arc<AtomicBool>);

    impl PowerDevice for Told {
        fn has(&self, _colour: Colour) -> bool {
            true
        }

        fn set_power(&mut self, _power_uw: PerColour<u32>) -> Result<(), LaserError> {
            Ok(())
        }

        fn switch(&mut self, _colour: Colour, on: bool) -> Result<(), LaserError> {
            self.0.lock().unwrap().push(on);
            self.1.store(!on, Ordering::Release);
            Ok(())
        }

        fn probe(&mut self, _asked: usize) -> Result<bool, LaserError> {
            Ok(true)
        }

        fn dark_wait(&self) -> TimeNs {
            TimeNs(0)
        }
    }

    /// What a device is told of the orders `lit`, numbered from 1 on, and what is reported of them.
    fn obeyed(lit: &[PerColour<bool>], failed: bool) -> (Vec<bool>, Vec<Report>) {
        let (mut orders, order_consumer) = RingBuffer::new(RING);
        let (report_producer, mut reports) = RingBuffer::new(RING);
        let (told, stop) = (Arc::default(), Arc::new(AtomicBool::new(false)));
        for (number, &lit) in (1..).zip(lit) {
            orders.push((number, Order::Lit(lit))).unwrap();
        }
        let worker = Worker {
            device: Told(Arc::clone(&told), Arc::clone(&stop)),
            orders: order_consumer,
            reports: report_producer,
            t_heartbeat: Arc::new(AtomicI64::new(0)),
            stop,
            timeout: TimeNs(1_000_000_000),
            maybe_lit: false,
            t_probe: TimeNs(0),
            asked: 0,
            failed,
            clock: || TimeNs(1),
        };
        worker.run();
        let told = told.lock().unwrap().clone();
        (told, std::iter::from_fn(|| reports.pop().ok()).collect())
    }

    const ALL_LIT: PerColour<bool> = PerColour([true; 3]);

    #[test]
    fn an_order_to_light_that_one_for_darkness_follows_is_left_out() {
        let (told, done) = obeyed(&[ALL_LIT, NONE_LIT, ALL_LIT, NONE_LIT], false);
        assert!(!told.is_empty() && told.iter().all(|on| !on), "{told:?}");
        assert!(matches!(done[..], [Report::Done(2), Report::Done(4)]), "{done:?}");
    }

    #[test]
    fn a_device_that_failed_is_not_lit_until_it_says_that_it_is_well() {
        let (told, done) = obeyed(&[NONE_LIT, ALL_LIT], true);
        assert!(!told.is_empty() && told.iter().all(|on| !on), "{told:?}");
        assert!(matches!(done[..], [Report::Done(1), Report::Failed(2, LaserError::Lost)]), "{done:?}");
    }
}
