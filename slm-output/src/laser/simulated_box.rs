//! The other end of the laser box's line: a box without lasers, for a process or thread of its own.
//!
//! It outlives the program that it serves, so its log tells what the lasers did when that program was killed.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use holod_calibration::{Colour, PerColour, TimeNs};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use super::protocol::{ARM_TOKEN, IDENTITY, Line, LineBuffer, SIMULATED, checked, code, colour_of, letter};
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
            Ok(Reply::Identity) => Line::new(format_args!("OK {number} {IDENTITY} {SIMULATED}")),
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
pub fn serve(reader: impl Read, writer: impl Write, mut log: impl Write, clock: impl Fn() -> TimeNs) -> io::Result<()> {
    writeln!(log, "{LOG_HEADER}")?;
    log.flush()?;
    let mut laser = SimulatedBox::new(clock());
    serve_until_hung_up(&mut laser, reader, writer, &mut log, clock)
}

fn serve_until_hung_up(
    laser: &mut SimulatedBox,
    mut reader: impl Read,
    mut writer: impl Write,
    log: &mut impl Write,
    clock: impl Fn() -> TimeNs,
) -> io::Result<()> {
    let mut hung_up = false;
    loop {
        let mut bytes = [0; 256];
        match if hung_up { Err(ErrorKind::WouldBlock.into()) } else { reader.read(&mut bytes) } {
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
        let mut written = Ok(());
        let mut any = false;
        laser.advance(
            clock(),
            |event| {
                any = true;
                if written.is_ok() {
                    written = log_event(log, event);
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

    /// Serves one host after another, for ever; see [`serve`]. The box keeps its program between them.
    ///
    /// # Errors
    /// As [`serve`].
    pub fn serve(&self, mut log: impl Write, clock: impl Fn() -> TimeNs) -> io::Result<()> {
        writeln!(log, "{LOG_HEADER}")?;
        log.flush()?;
        let mut laser = SimulatedBox::new(clock());
        loop {
            serve_until_hung_up(&mut laser, &self.terminal, &self.terminal, &mut log, &clock)?;
            // A terminal that nobody has open looks hung up, too.
            std::thread::sleep(Duration::from_millis(2));
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

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(laser: &mut SimulatedBox, text: &str, now: i64) -> String {
        let mut answers = String::new();
        laser.receive(Line::new(format_args!("{text}")).as_bytes(), TimeNs(now), |line| {
            let line = checked(line.as_bytes().strip_suffix(b"\n").unwrap()).unwrap();
            answers.push_str(line);
        });
        answers
    }

    fn said(laser: &mut SimulatedBox, now: i64) -> (Vec<BoxEvent>, Vec<String>) {
        let (mut events, mut lines) = (Vec::new(), Vec::new());
        laser.advance(
            TimeNs(now),
            |event| events.push(event),
            |line| lines.push(String::from_utf8_lossy(line.as_bytes()).into_owned()),
        );
        (events, lines)
    }

    fn set_up(trigger: &str) -> SimulatedBox {
        let mut laser = SimulatedBox::new(TimeNs(0));
        let lines = [
            format!("SEQ GRB 3000 {trigger}"),
            "FLD 0 400 300".into(),
            "FLD 1 1400 300".into(),
            "FLD 2 2400 300".into(),
            "POW 10 20 30".into(),
            "TMO 10000".into(),
        ];
        for (number, line) in lines.iter().enumerate() {
            assert_eq!(answer(&mut laser, "9 ARM LIGHT", 0), "ERR 9 PROGRAM");
            assert_eq!(answer(&mut laser, &format!("{number} {line}"), 0), format!("OK {number}"));
        }
        laser
    }

    #[test]
    fn it_says_who_it_is_and_how_it_is() {
        let mut laser = set_up("SYNC");
        assert_eq!(answer(&mut laser, "1 ID?", 0), "OK 1 holod-laser-box 1 simulated");
        assert_eq!(answer(&mut laser, "2 STAT?", 0), "OK 2 dark -");
        assert_eq!(answer(&mut laser, "3 ARM LIGHT", 0), "OK 3");
        assert_eq!(answer(&mut laser, "4 SYN 0", 1), "OK 4");
        assert_eq!(answer(&mut laser, "5 STAT?", 1500), "OK 5 armed R");
        assert_eq!(answer(&mut laser, "6 POW 1 1 1", 1500), "ERR 6 ARMED");
        assert_eq!(answer(&mut laser, "7 DISARM shutdown", 1600), "OK 7");
        let (events, lines) = said(&mut laser, 1700);
        assert_eq!(events.last(), Some(&BoxEvent::Dark { t: TimeNs(1600), reason: DarkReason::Shutdown }));
        assert_eq!(lines, Vec::<String>::new());
        assert_eq!(answer(&mut laser, "8 HB", 1800), "ERR 8 DARK");
    }

    #[test]
    fn silence_makes_dark_and_it_says_so() {
        for (trigger, t_dark, reason, word) in
            [("SYNC", 6000, DarkReason::SyncLost, "!SYNCLOST"), ("HOST", 10_000, DarkReason::Heartbeat, "!HBLOST")]
        {
            let mut laser = set_up(trigger);
            answer(&mut laser, "1 ARM LIGHT", 0);
            let (events, lines) = said(&mut laser, 50_000);
            assert_eq!(events.last(), Some(&BoxEvent::Dark { t: TimeNs(t_dark), reason }));
            assert!(lines[0].starts_with(word), "{lines:?}");
        }
    }

    #[test]
    fn any_line_that_it_does_not_understand_makes_dark() {
        let sound = "3 HB";
        let broken = [
            "",
            "HB",
            "3 NONSENSE",
            "3 HB 1",
            "3 LIT X 1 2",
            "3 LIT R 1",
            "3 LIT R -1 5",
            "3 SYN x",
            "3 ARM",
            "3 ARM NOW",
            "x HB",
        ];
        for line in broken {
            let mut laser = set_up("HOST");
            answer(&mut laser, "1 ARM LIGHT", 0);
            assert_eq!(answer(&mut laser, sound, 5), "OK 3");
            assert!(laser.is_armed());
            assert!(answer(&mut laser, line, 10).ends_with("LINE"), "{line}");
            assert!(!laser.is_armed(), "{line}");
            assert!(said(&mut laser, 20).1[0].starts_with("!LINE"));
        }
        let mut laser = set_up("HOST");
        answer(&mut laser, "1 ARM LIGHT", 0);
        laser.receive(b"3 HB*00\n", TimeNs(5), |_| ());
        assert!(!laser.is_armed());
    }

    #[test]
    fn programs_that_are_nonsense_are_refused() {
        let mut laser = set_up("HOST");
        for line in [
            "SEQ RGR 3000 SYNC",
            "SEQ RG 3000 SYNC",
            "SEQ RGB 0 SYNC",
            "SEQ RGB 3000 ME",
            "FLD 3 1 1",
            "FLD 0 1 0",
            "POW 1 2",
            "TMO 0",
        ] {
            assert!(answer(&mut laser, &format!("1 {line}"), 0).ends_with("LINE"), "{line}");
        }
    }

    #[test]
    fn a_log_is_read_as_it_was_written() {
        let events = [
            BoxEvent::Armed { t: TimeNs(5) },
            BoxEvent::Edge(LaserEdge { t: TimeNs(7), colour: Colour::Blue, on: true }),
            BoxEvent::Edge(LaserEdge { t: TimeNs(9), colour: Colour::Blue, on: false }),
            BoxEvent::Dark { t: TimeNs(10), reason: DarkReason::SyncLost },
        ];
        let mut log = format!("{LOG_HEADER}\n").into_bytes();
        for event in events {
            log_event(&mut log, event).unwrap();
        }
        let text = String::from_utf8(log).unwrap();
        assert_eq!(read_log(&text), Ok(events.to_vec()));
        assert_eq!(read_log(&format!("{text}12,on,re")), Ok(events.to_vec()));
        assert_eq!(read_log(&format!("{text}12,on,ultraviolet,\n")), Err(6));
    }
}
