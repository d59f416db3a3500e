//! A whole box: the state machine between a line and a board's pins.

use crate::command::{Answer, Command, Message, Refusal, identity};
use crate::line::{Line, LineBuffer, checked};
use crate::machine::{Event, Machine};
use crate::types::{Laser, Limits, TimeUs};

/// Bytes that are taken from the line at once.
const CHUNK_BYTES: usize = 64;

/// The pins, the clock and the line of a board. No call may wait.
///
/// A board must be dark without its program: gates pulled to off by a resistor, and off while it is in reset.
pub trait Hardware {
    /// Its clock: microseconds since it booted. Never runs backwards, wraps only after thousands of years, and is
    /// within
    /// 100 parts per million of true time.
    fn now(&mut self) -> TimeUs;

    /// The next edge of the panel's sync output that has not been asked for yet, with the time that was captured at it.
    fn sync_edge(&mut self) -> Option<TimeUs>;

    /// Whether the interlock is closed, so that lasers may be lit.
    fn interlock_closed(&mut self) -> bool;

    /// Whether a host holds the line: USB is configured and data terminal ready is high. A line that cannot say so says
    /// yes; then only the heartbeat timeout notices that the host is gone.
    fn host_present(&mut self) -> bool;

    /// Takes received bytes; how many.
    fn receive(&mut self, bytes: &mut [u8]) -> usize;

    /// Sends a line. What cannot be sent at once may be dropped as a whole line, and nothing waits for it.
    fn send(&mut self, line: &[u8]);

    /// Opens the gate of `lit` and closes all others; closes all of them for `None`. Closes before it opens.
    fn set_gate(&mut self, lit: Option<Laser>);

    /// Sets the power that each laser has while its gate is open, microwatts.
    fn set_power(&mut self, power_uw: [u32; 3]);

    /// Tells the watchdog that the program runs. A board that is not told for some tens of milliseconds resets itself,
    /// which makes it dark.
    fn feed_watchdog(&mut self);
}

/// A box's program on its board: lines in, gates and answers out.
#[derive(Debug)]
pub struct Controller<H> {
    hardware: H,
    machine: Machine,
    received: LineBuffer,
    name: &'static str,
    gate: Option<Laser>,
}

impl<H: Hardware> Controller<H> {
    /// A box that has just booted: closes all gates before anything else, and says on the line that it booted. `name`
    /// is one word of at most 40 letters.
    pub fn new(mut hardware: H, name: &'static str, limits: Limits) -> Self {
        hardware.set_gate(None);
        hardware.set_power([0; 3]);
        let now = hardware.now();
        let mut controller =
            Self { hardware, machine: Machine::new(limits, now), received: LineBuffer::default(), name, gate: None };
        controller.send(Message::Booted);
        controller
    }

    /// What decides when a laser is lit.
    pub fn machine(&self) -> &Machine {
        &self.machine
    }

    /// The board that the program runs on.
    pub fn hardware_mut(&mut self) -> &mut H {
        &mut self.hardware
    }

    /// Does all that is to be done now; to be called again and again, without a pause that is longer than the limits'
    /// `jitter_us`. Calls `log` for all that happens.
    pub fn step(&mut self, log: &mut dyn FnMut(Event)) {
        // What makes dark comes first.
        let (closed, present) = (self.hardware.interlock_closed(), self.hardware.host_present());
        let now = self.hardware.now();
        self.with_machine(log, |machine, event| machine.see_inputs(closed, present, now, event));
        while let Some(t) = self.hardware.sync_edge() {
            let now = self.hardware.now();
            self.with_machine(log, |machine, event| machine.see_edge(t, now, event));
        }

        let mut bytes = [0; CHUNK_BYTES];
        let count = self.hardware.receive(&mut bytes).min(CHUNK_BYTES);
        for &byte in &bytes[..count] {
            let Some(line) = self.received.push(byte) else { continue };
            let command = checked(line).and_then(Command::parse);
            let now = self.hardware.now();
            self.obey(command, now, log);
        }
        let now = self.hardware.now();
        self.with_machine(log, |machine, event| machine.advance(now, event));
        self.hardware.feed_watchdog();
    }

    fn obey(&mut self, command: Option<(u32, Command)>, now: TimeUs, log: &mut dyn FnMut(Event)) {
        let Some((number, command)) = command else {
            self.send(Message::Refused { number: 0, refusal: Refusal::Malformed });
            return self.with_machine(log, |machine, event| machine.hear_nonsense(now, event));
        };
        let mut answer = Err(Refusal::Malformed);
        self.with_machine(log, |machine, event| answer = machine.obey(&command, now, event));
        let answer: Result<Answer<'_>, _> =
            if command == Command::Identify { answer.map(|_| identity(self.name)) } else { answer };
        self.send(match answer {
            Ok(answer) => Message::Done { number, answer },
            Err(refusal) => Message::Refused { number, refusal },
        });
    }

    /// Lets the machine do something, brings the gates to what it says, and sends what it has to say.
    fn with_machine(&mut self, log: &mut dyn FnMut(Event), act: impl FnOnce(&mut Machine, &mut dyn FnMut(Event))) {
        let mut went_dark = None;
        let mut power_changed = false;
        act(&mut self.machine, &mut |event| {
            match event {
                Event::Armed { .. } => power_changed = true,
                Event::Dark { t, reason } => {
                    power_changed = true;
                    went_dark = Some((t, reason)).filter(|(_, reason)| reason.is_of_box());
                }
                Event::On { .. } | Event::Off { .. } => {}
            }
            log(event);
        });
        if power_changed {
            // Closed while the power changes; what the machine lights is opened below.
            self.hardware.set_gate(None);
            self.gate = None;
            self.hardware.set_power(self.machine.power_uw());
        }
        let powers_uw = self.machine.power_uw();
        let lit = self.machine.lit().filter(|laser| powers_uw[laser.index()] > 0);
        if lit != self.gate {
            self.gate = lit;
            self.hardware.set_gate(self.gate);
        }
        if let Some((t, reason)) = went_dark {
            self.send(Message::Dark { t, reason });
        }
    }

    fn send(&mut self, message: Message<'_>) {
        // Only an answer with a name that is too long does not fit, and a box without a name is no box.
        if let Some(line) = Line::new(message) {
            self.hardware.send(line.as_bytes());
        }
    }
}
