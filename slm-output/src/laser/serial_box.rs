//! A laser box at the other end of a serial line.

use std::io::{self, ErrorKind, Read, Write};
use std::path::Path;
use std::time::Duration;

use holod_calibration::TimeNs;
use serialport::TTYPort;

use super::protocol::{ARM_TOKEN, IDENTITY, Line, LineBuffer, SIMULATED, checked, letter, refusal};
use super::{BoxEvent, DarkReason, LaserBox, LaserError, LaserProgram, LitWindow, Refusal, SimulatedLaser, Trigger};

const BAUD: u32 = 115_200;
/// A box that does not answer for this long is at fault.
const ANSWER_WAIT: TimeNs = TimeNs(100_000_000);
/// A box may take this long to answer the first line, while its USB wakes up.
const IDENTIFY_WAIT: TimeNs = TimeNs(2_000_000_000);
/// Commands that may wait for an answer: half a second of frames.
const UNANSWERED_MAX: usize = 128;

/// Drives a laser box through the lines of [`super::protocol`].
///
/// The box does not tell its edges, so the ones reported here are those of a model that is told the same as the box: what
/// it does if it keeps its rules. Once it contradicts the model (it went dark, it refuses, it does not answer) that is
/// an event or an error.
#[derive(Debug)]
pub struct SerialBox<S: Read + Write> {
    stream: S,
    received: LineBuffer,
    model: SimulatedLaser,
    simulated: bool,
    last_number: u32,
    unanswered: [Option<Sent>; UNANSWERED_MAX],
    clock: fn() -> TimeNs,
}

#[derive(Clone, Copy, Debug)]
struct Sent {
    number: u32,
    command: &'static str,
    t: TimeNs,
}

impl SerialBox<TTYPort> {
    /// Opens the box at `path` and asks who it is before anything else is said.
    ///
    /// # Errors
    /// [`LaserError::Open`], [`LaserError::NotABox`], [`LaserError::NoAnswer`].
    pub fn open(path: &Path, clock: fn() -> TimeNs) -> Result<Self, LaserError> {
        let name = path.display().to_string();
        let port = serialport::new(name.as_str(), BAUD).timeout(Duration::ZERO).open_native();
        let port = port.map_err(|why| LaserError::Open { path: name.clone(), why: why.to_string() })?;
        Self::identify(port, &name, clock)
    }
}

impl<S: Read + Write> SerialBox<S> {
    /// Talks to the box on `stream`, whose reads must return at once, with [`ErrorKind::WouldBlock`] or
    /// [`ErrorKind::TimedOut`] where nothing is there. `name` is for messages.
    ///
    /// # Errors
    /// [`LaserError::NotABox`], [`LaserError::NoAnswer`], [`LaserError::Line`].
    pub fn identify(stream: S, name: &str, clock: fn() -> TimeNs) -> Result<Self, LaserError> {
        let mut this = Self {
            stream,
            received: LineBuffer::default(),
            model: SimulatedLaser::new(clock()),
            simulated: false,
            last_number: 0,
            unanswered: [None; UNANSWERED_MAX],
            clock,
        };
        // Ends whatever an earlier host left half said; the box answers it with an error of number 0.
        this.stream.write_all(b"\n")?;
        let number = this.send("ID?", format_args!("ID?"), clock())?;
        let t_end = clock() + IDENTIFY_WAIT;
        let mut answer = None;
        while answer.is_none() && clock() < t_end {
            this.read_lines(|line| {
                // What a box still had to say to an earlier host, a killed one say, is no answer to us.
                let text = String::from_utf8_lossy(line).trim_end().to_owned();
                let ours = format!("OK {number} {IDENTITY} ");
                if let Some(name) = checked(line).and_then(|text| text.strip_prefix(&ours)) {
                    answer = Some(Ok(name == SIMULATED));
                } else if !text.is_empty() && !["!", "OK ", "ERR "].iter().any(|known| text.starts_with(known)) {
                    answer.get_or_insert(Err(text));
                }
            })?;
            std::thread::sleep(Duration::from_micros(500));
        }
        match answer {
            Some(Ok(simulated)) => {
                this.simulated = simulated;
                this.unanswered = [None; UNANSWERED_MAX];
                Ok(this)
            }
            Some(Err(found)) => Err(LaserError::NotABox {
                path: name.into(),
                found: found.chars().take(40).collect(),
                expected: IDENTITY,
            }),
            None => Err(LaserError::NoAnswer { command: "ID?", waited_ms: IDENTIFY_WAIT.0 / 1_000_000 }),
        }
    }

    fn send(&mut self, command: &'static str, text: std::fmt::Arguments<'_>, now: TimeNs) -> Result<u32, LaserError> {
        let number = self.last_number.wrapping_add(1);
        let place = &mut self.unanswered[number as usize % UNANSWERED_MAX];
        if let Some(oldest) = place {
            return Err(LaserError::NoAnswer { command: oldest.command, waited_ms: (now.0 - oldest.t.0) / 1_000_000 });
        }
        *place = Some(Sent { number, command, t: now });
        self.last_number = number;
        self.stream.write_all(Line::new(format_args!("{number} {text}")).as_bytes())?;
        Ok(number)
    }

    /// Sends and waits for the answer.
    fn ask(&mut self, command: &'static str, text: std::fmt::Arguments<'_>, now: TimeNs) -> Result<(), LaserError> {
        let number = self.send(command, text, now)?;
        let t_end = (self.clock)() + ANSWER_WAIT;
        loop {
            self.hear((self.clock)())?;
            if self.unanswered[number as usize % UNANSWERED_MAX].is_none_or(|sent| sent.number != number) {
                return Ok(());
            }
            if (self.clock)() >= t_end {
                return Err(LaserError::NoAnswer { command, waited_ms: ANSWER_WAIT.0 / 1_000_000 });
            }
            std::thread::sleep(Duration::from_micros(200));
        }
    }

    /// Takes in what the box has said.
    fn hear(&mut self, now: TimeNs) -> Result<(), LaserError> {
        let mut first_refusal = None;
        let mut went_dark = None;
        let unanswered = &mut self.unanswered;
        let mut stream_lines = |line: &[u8]| {
            let Some(text) = checked(line) else { return };
            let mut words = text.split(' ');
            match words.next() {
                Some("!HBLOST") => went_dark = Some(DarkReason::Heartbeat),
                Some("!SYNCLOST") => went_dark = Some(DarkReason::SyncLost),
                Some(fault) if fault.starts_with('!') => went_dark = Some(DarkReason::BoxFault),
                Some(verdict @ ("OK" | "ERR")) => {
                    let Some(number) = words.next().and_then(|number| number.parse::<u32>().ok()) else { return };
                    let place = &mut unanswered[number as usize % UNANSWERED_MAX];
                    let Some(sent) = place.filter(|sent| sent.number == number) else { return };
                    *place = None;
                    if verdict == "ERR" {
                        first_refusal.get_or_insert((sent.command, refusal(words.next().unwrap_or_default())));
                    }
                }
                _ => {}
            }
        };
        let mut bytes = [0; 256];
        loop {
            match self.stream.read(&mut bytes) {
                Ok(0) => return Err(io::Error::from(ErrorKind::BrokenPipe).into()),
                Ok(count) => self.received.feed(&bytes[..count], &mut stream_lines),
                Err(why) if matches!(why.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => break,
                Err(why) if why.kind() == ErrorKind::Interrupted => {}
                Err(why) => return Err(why.into()),
            }
        }
        if let Some(reason) = went_dark {
            self.model.set_dark(reason, now);
        }
        match first_refusal {
            // A window that came too late stays dark, no more.
            Some((_, Refusal::Late)) | None => Ok(()),
            Some((command, refusal)) => Err(LaserError::Refused { command, refusal }),
        }
    }

    fn read_lines(&mut self, line: impl FnMut(&[u8])) -> Result<(), LaserError> {
        let mut bytes = [0; 256];
        match self.stream.read(&mut bytes) {
            Ok(0) => Err(io::Error::from(ErrorKind::BrokenPipe).into()),
            Ok(count) => {
                self.received.feed(&bytes[..count], line);
                Ok(())
            }
            Err(why) if matches!(why.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {
                Ok(())
            }
            Err(why) => Err(why.into()),
        }
    }
}

fn refused(command: &'static str) -> impl Fn(Refusal) -> LaserError {
    move |refusal| LaserError::Refused { command, refusal }
}

impl<S: Read + Write + Send> LaserBox for SerialBox<S> {
    fn is_simulated(&self) -> bool {
        self.simulated
    }

    fn program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), LaserError> {
        let [a, b, c] = program.sequence.map(letter);
        let trigger = match program.trigger {
            Trigger::PanelSync => "SYNC",
            Trigger::Host => "HOST",
        };
        self.ask("SEQ", format_args!("SEQ {a}{b}{c} {} {trigger}", program.frame_period.0), now)?;
        for (field, window) in program.windows.iter().enumerate() {
            self.ask("FLD", format_args!("FLD {field} {} {}", window.delay.0, window.width.0), now)?;
        }
        let [red, green, blue] = program.power_uw.0;
        self.ask("POW", format_args!("POW {red} {green} {blue}"), now)?;
        self.ask("TMO", format_args!("TMO {}", program.heartbeat_timeout.0), now)?;
        self.model.set_program(program, now).map_err(refused("SEQ"))
    }

    fn arm(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.ask("ARM", format_args!("ARM {ARM_TOKEN}"), now)?;
        self.model.set_armed(now).map_err(refused("ARM"))
    }

    fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<(), LaserError> {
        self.send("SYN", format_args!("SYN {}", t_sync.0), now)?;
        self.model.see_sync(t_sync, now).map_err(refused("SYN"))
    }

    fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<(), LaserError> {
        let (colour, t_on, t_off) = (letter(window.colour), window.t_on.0, window.t_off.0);
        self.send("LIT", format_args!("LIT {colour} {t_on} {t_off}"), now)?;
        self.model.take_window(window, now).map_err(refused("LIT"))
    }

    fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError> {
        self.send("HB", format_args!("HB"), now)?;
        self.model.hear_heartbeat(now).map_err(refused("HB"))
    }

    fn dark(&mut self, reason: DarkReason, now: TimeNs) -> Result<(), LaserError> {
        // Answers to earlier commands no longer matter.
        self.unanswered = [None; UNANSWERED_MAX];
        match self.ask("DISARM", format_args!("DISARM {reason}"), now) {
            Ok(()) => {}
            // The line may have swallowed the first one.
            Err(_) => self.ask("DISARM", format_args!("DISARM {reason}"), (self.clock)())?,
        }
        self.model.set_dark(reason, (self.clock)().max(now));
        Ok(())
    }

    fn poll(&mut self, now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
        let heard = self.hear(now);
        self.model.advance(now);
        while let Some(next) = self.model.next_event() {
            event(next);
        }
        heard?;
        let overdue = |sent: &&Sent| now.0 - sent.t.0 > ANSWER_WAIT.0;
        match self.unanswered.iter().flatten().find(overdue) {
            None => Ok(()),
            Some(sent) => {
                let error = LaserError::NoAnswer { command: sent.command, waited_ms: (now.0 - sent.t.0) / 1_000_000 };
                self.unanswered = [None; UNANSWERED_MAX];
                Err(error)
            }
        }
    }
}

impl<S: Read + Write> Drop for SerialBox<S> {
    /// A last word, in case nobody said it; the box's heartbeat timeout does the rest.
    fn drop(&mut self) {
        self.unanswered = [None; UNANSWERED_MAX];
        let _nobody_listens = self.send("DISARM", format_args!("DISARM {}", DarkReason::Shutdown), TimeNs(0));
    }
}
