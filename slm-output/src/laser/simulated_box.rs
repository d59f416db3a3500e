//! The other end of the laser box's line: a box without lasers, for a process or thread of its own.
//!
//! It outlives the program that it serves, so its log tells what the lasers did when that program was killed.

use std::io::{self, ErrorKind, Read, Write};
use std::time::Duration;

use holod_calibration::{Colour, PerColour, TimeNs};

use super::protocol::{ARM_TOKEN, IDENTITY, Line, LineBuffer, checked, code, colour_of, letter};
use super::{BoxEvent, DarkReason, FieldWindow, LaserEdge, LaserProgram, LitWindow, Refusal, SimulatedLaser, Trigger};
use crate::fields::FIELDS;

/// A box that obeys lines of [`super::protocol`].
#[derive(Debug)]
pub struct SimulatedBox {
    model: SimulatedLaser,
    received: LineBuffer,
    sequence: Option<([Colour; FIELDS], TimeNs, Trigger)>,
    windows: [Option<FieldWindow>; FIELDS],
    power_uw: Option<PerColour<u32>>,
    heartbeat_timeout: Option<TimeNs>,
}

impl SimulatedBox {
    /// A box that has just booted.
    pub fn new(now: TimeNs) -> Self {
        Self {
            model: SimulatedLaser::new(now),
            received: LineBuffer::default(),
            sequence: None,
            windows: [None; FIELDS],
            power_uw: None,
            heartbeat_timeout: None,
        }
    }

    /// Whether it may light lasers.
    pub fn is_armed(&self) -> bool {
        self.model.is_armed()
    }

    /// Takes in bytes of the line and calls `answer` for each line that it sends back.
    pub fn receive(&mut self, bytes: &[u8], now: TimeNs, mut answer: impl FnMut(Line)) {
        let mut received = std::mem::take(&mut self.received);
        received.feed(bytes, |line| self.obey(line, now, &mut answer));
        self.received = received;
    }

    /// Lives through everything up to `now`: calls `event` for all that happened, and `say` for what it sends by itself.
    pub fn advance(&mut self, now: TimeNs, mut event: impl FnMut(BoxEvent), mut say: impl FnMut(Line)) {
        self.model.advance(now);
        while let Some(next) = self.model.next_event() {
            match next {
                BoxEvent::Dark { reason: DarkReason::Heartbeat, .. } => say(Line::new(format_args!("!HBLOST"))),
                BoxEvent::Dark { reason: DarkReason::SyncLost, .. } => say(Line::new(format_args!("!SYNCLOST"))),
                BoxEvent::Dark { reason: DarkReason::BoxFault, .. } => say(Line::new(format_args!("!LINE"))),
                _ => {}
            }
            event(next);
        }
    }

    fn obey(&mut self, line: &[u8], now: TimeNs, answer: &mut impl FnMut(Line)) {
        let parsed = checked(line).and_then(|text| {
            let (number, command) = text.split_once(' ')?;
            Some((number.parse::<u32>().ok()?, command))
        });
        let Some((number, command)) = parsed else {
            self.model.set_dark(DarkReason::BoxFault, now);
            return answer(Line::new(format_args!("ERR 0 {}", code(Refusal::Malformed))));
        };
        answer(match self.command(command, now) {
            Ok(Reply::Done) => Line::new(format_args!("OK {number}")),
            Ok(Reply::Identity) => Line::new(format_args!("OK {number} {IDENTITY}")),
            Ok(Reply::State) => {
                let state = if self.model.is_armed() { "armed" } else { "dark" };
                Line::new(format_args!("OK {number} {state} {}", self.model.lit().map_or('-', letter)))
            }
            Err(refusal) => {
                if refusal == Refusal::Malformed {
                    self.model.set_dark(DarkReason::BoxFault, now);
                }
                Line::new(format_args!("ERR {number} {}", code(refusal)))
            }
        });
    }

    fn command(&mut self, command: &str, now: TimeNs) -> Result<Reply, Refusal> {
        let mut words = command.split(' ');
        let word = words.next().unwrap_or_default();
        let mut arguments = [""; 3];
        let mut count = 0;
        for argument in words {
            *arguments.get_mut(count).ok_or(Refusal::Malformed)? = argument;
            count += 1;
        }
        let set_up = matches!(word, "SEQ" | "FLD" | "POW" | "TMO");
        if set_up && self.model.is_armed() {
            return Err(Refusal::Armed);
        }
        match (word, &arguments[..count]) {
            ("ID?", []) => return Ok(Reply::Identity),
            ("STAT?", []) => {
                self.model.advance(now);
                return Ok(Reply::State);
            }
            ("SEQ", [letters, period, trigger]) => {
                self.sequence = Some((sequence(letters)?, positive_time(period)?, trigger_of(trigger)?));
                self.windows = [None; FIELDS];
                self.power_uw = None;
            }
            ("FLD", [field, delay, width]) => {
                let field: usize = field.parse().map_err(|_| Refusal::Malformed)?;
                let place = self.windows.get_mut(field).ok_or(Refusal::Malformed)?;
                *place = Some(FieldWindow { delay: time(delay)?, width: positive_time(width)? });
            }
            ("POW", [red, green, blue]) => {
                let power = |text: &str| text.parse::<u32>().map_err(|_| Refusal::Malformed);
                self.power_uw = Some(PerColour([power(red)?, power(green)?, power(blue)?]));
            }
            ("TMO", [timeout]) => self.heartbeat_timeout = Some(positive_time(timeout)?),
            ("ARM", [token]) if *token == ARM_TOKEN => {
                if !self.model.is_armed() {
                    self.model.set_program(&self.program()?, now)?;
                }
                self.model.set_armed(now)?;
            }
            ("DISARM", [reason]) => {
                self.model.set_dark(DarkReason::from_name(reason).unwrap_or(DarkReason::Asked), now);
            }
            ("HB", []) => self.model.hear_heartbeat(now)?,
            ("SYN", [t]) => self.model.see_sync(time(t)?, now)?,
            ("LIT", [colour, t_on, t_off]) => {
                let colour = colour_of(colour).ok_or(Refusal::Malformed)?;
                self.model.take_window(LitWindow { colour, t_on: time(t_on)?, t_off: time(t_off)? }, now)?;
            }
            _ => return Err(Refusal::Malformed),
        }
        Ok(Reply::Done)
    }

    fn program(&self) -> Result<LaserProgram, Refusal> {
        let (sequence, frame_period, trigger) = self.sequence.ok_or(Refusal::NotProgrammed)?;
        let [Some(first), Some(second), Some(third)] = self.windows else { return Err(Refusal::NotProgrammed) };
        Ok(LaserProgram {
            trigger,
            sequence,
            windows: [first, second, third],
            frame_period,
            power_uw: self.power_uw.ok_or(Refusal::NotProgrammed)?,
            heartbeat_timeout: self.heartbeat_timeout.ok_or(Refusal::NotProgrammed)?,
        })
    }
}

enum Reply {
    Done,
    Identity,
    State,
}

fn time(text: &str) -> Result<TimeNs, Refusal> {
    text.parse().ok().filter(|ns| (0..=i64::MAX / 4).contains(ns)).map(TimeNs).ok_or(Refusal::Malformed)
}

fn positive_time(text: &str) -> Result<TimeNs, Refusal> {
    time(text).and_then(|time| if time > TimeNs(0) { Ok(time) } else { Err(Refusal::Malformed) })
}

fn sequence(letters: &str) -> Result<[Colour; FIELDS], Refusal> {
    let mut colours = letters.split("").filter(|letter| !letter.is_empty()).map(colour_of);
    match [colours.next(), colours.next(), colours.next(), colours.next()] {
        [Some(Some(a)), Some(Some(b)), Some(Some(c)), None] if a != b && b != c && a != c => Ok([a, b, c]),
        _ => Err(Refusal::Malformed),
    }
}

fn trigger_of(text: &str) -> Result<Trigger, Refusal> {
    match text {
        "SYNC" => Ok(Trigger::PanelSync),
        "HOST" => Ok(Trigger::Host),
        _ => Err(Refusal::Malformed),
    }
}

/// First line of a log.
pub const LOG_HEADER: &str = "t_ns,event,colour,reason";

/// Serves one host until its line hangs up and the box has gone dark by itself, and logs what the lasers do as lines of
/// CSV under [`LOG_HEADER`].
///
/// `reader` returns within some milliseconds, with [`ErrorKind::WouldBlock`] or [`ErrorKind::TimedOut`] where nothing is
/// there. A hung-up line is silence, no more: what makes dark then is the heartbeat timeout, as on a wire that cannot
/// hang up. Answers that cannot be sent are dropped.
///
/// # Errors
/// [`io::Error`] where the log cannot be written.
pub fn serve(
    mut reader: impl Read,
    mut writer: impl Write,
    mut log: impl Write,
    clock: impl Fn() -> TimeNs,
) -> io::Result<()> {
    let mut laser = SimulatedBox::new(clock());
    let mut hung_up = false;
    writeln!(log, "{LOG_HEADER}")?;
    log.flush()?;
    loop {
        let mut bytes = [0; 256];
        if !hung_up {
            match reader.read(&mut bytes) {
                Ok(0) => hung_up = true,
                Ok(count) => laser.receive(&bytes[..count], clock(), |line| {
                    let _dropped = writer.write_all(line.as_bytes());
                }),
                Err(why) if matches!(why.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                    std::thread::sleep(Duration::from_micros(200));
                }
                Err(why) if why.kind() == ErrorKind::Interrupted => {}
                Err(_) => hung_up = true,
            }
        } else {
            std::thread::sleep(Duration::from_millis(1));
        }
        let mut written = Ok(());
        let mut any = false;
        laser.advance(
            clock(),
            |event| {
                any = true;
                if written.is_ok() {
                    written = log_event(&mut log, event);
                }
            },
            |line| {
                let _dropped = writer.write_all(line.as_bytes());
            },
        );
        written?;
        if any {
            log.flush()?;
        }
        if hung_up && !laser.is_armed() {
            return Ok(());
        }
    }
}

fn log_event(log: &mut impl Write, event: BoxEvent) -> io::Result<()> {
    match event {
        BoxEvent::Armed { t } => writeln!(log, "{},armed,,", t.0),
        BoxEvent::Edge(LaserEdge { t, colour, on }) => {
            writeln!(log, "{},{},{colour},", t.0, if on { "on" } else { "off" })
        }
        BoxEvent::Dark { t, reason } => writeln!(log, "{},dark,,{reason}", t.0),
    }
}

/// Reads a log as [`serve`] writes it; a last line that was cut off is left out.
///
/// # Errors
/// The number (from 1) of the first line that is no line of a log.
pub fn read_log(text: &str) -> Result<Vec<BoxEvent>, usize> {
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let lines = whole.lines().enumerate().filter(|(_, line)| *line != LOG_HEADER);
    lines.map(|(index, line)| read_event(line).ok_or(index + 1)).collect()
}

fn read_event(line: &str) -> Option<BoxEvent> {
    let mut cells = line.split(',');
    let t = TimeNs(cells.next()?.parse().ok()?);
    let (event, colour, reason) = (cells.next()?, cells.next()?, cells.next()?);
    let colour = || Colour::ALL.into_iter().find(|known| known.name() == colour);
    match event {
        "armed" => Some(BoxEvent::Armed { t }),
        "on" | "off" => Some(BoxEvent::Edge(LaserEdge { t, colour: colour()?, on: event == "on" })),
        "dark" => Some(BoxEvent::Dark { t, reason: DarkReason::from_name(reason)? }),
        _ => None,
    }
}
