//! A laser box at the other end of a serial line, spoken to by the protocol of `holod-laser-firmware`.

use std::collections::VecDeque;
use std::io::{Read, Write};
use std::path::Path;
use std::time::Duration;

use holod_calibration::{PerColour, TimeNs};
use holod_laser_firmware::command::{Answer, Message, SIMULATED};
use holod_laser_firmware::line::checked;
use holod_laser_firmware::{
    Command, Limits, Line, LineBuffer, PROTOCOL_VERSION, Refusal, State, SyncSeen, TimeUs, Trigger as BoxTrigger,
};

use super::box_clock::{BoxClock, Offset};
use super::line_link::{Arrival, Link, Sharing, open_port};
use super::program::{ceil_us, commands, floor_us, laser_of, nanoseconds, within_limits};
use super::{
    BoxEvent, Capability, DarkReason, LaserBox, LaserError, LaserProgram, LitWindow, MissedLight, SimulatedLaser,
    Trigger,
};

const BAUD: u32 = 115_200;
/// A box that does not answer for this long is at fault. It makes itself dark much sooner.
const ANSWER_WAIT: TimeNs = TimeNs(250_000_000);
/// How long the answer to a question or a setting is waited for, where nothing is lit and a thread may wait.
const SET_UP_WAIT: TimeNs = TimeNs(1_000_000_000);
/// How long the answer to `ARM`, and to each of two `DISARM`, is waited for.
const SWITCH_WAIT: TimeNs = TimeNs(200_000_000);
/// A box may take this long to answer the first line, while its USB wakes up.
const IDENTIFY_WAIT: TimeNs = TimeNs(2_000_000_000);
/// How long an identity is still waited for after a line that is no box's: it may be the end of an answer to somebody
/// else, whose beginning they have read.
const STRANGER_WAIT: TimeNs = TimeNs(500_000_000);
/// A box that is not spoken to otherwise is asked for its time or its state this often, so that a pulled cable is
/// noticed in the dark.
const ASK_TIME_EVERY: TimeNs = TimeNs(250_000_000);
/// Commands that may wait for an answer: a quarter of a second of fields at 1000 Hz.
const UNANSWERED_MAX: usize = 512;
/// Exchanges at the beginning, of which the quickest says best how the clocks go together.
const CLOCK_EXCHANGES: usize = 8;
/// How often darkness is asked for beside a program that reads the same line and may take the answer.
const DARK_TRIES: usize = 40;

/// How an identity is expected to begin, for messages.
const IDENTITY: &str = "holod-laser-box 3";

/// What the rig says of a box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialOptions {
    /// The panel's sync output is wired to the box, which then lights its windows after the wire's own edges.
    pub sync_wire: bool,
    /// Greatest power of each colour, microwatts at the panel.
    pub power_limit_uw: PerColour<u32>,
}

impl Default for SerialOptions {
    /// No wire, and no limit but the box's own.
    fn default() -> Self {
        Self { sync_wire: false, power_limit_uw: PerColour([u32::MAX; 3]) }
    }
}

/// What a box says of itself, without being armed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BoxReport {
    /// Its name; `simulated` where it has no lasers.
    pub name: String,
    /// What it is built for.
    pub limits: Limits,
    /// Armed or dark, what is lit, interlock and sync wire, when it was asked.
    pub state: State,
    /// By how much its time may be mistaken from here, nanoseconds either way.
    pub clock_error_ns: i64,
}

/// Drives a laser box.
///
/// Time points are the host's; a box has a clock of its own. How the two go together is learned from the time in each
/// answer ([`BoxClock`]), windows are cut by what is not known of it, and where nothing is left of one the field stays
/// dark.
///
/// The box does not tell its edges, so the ones reported here are those of a model that does what the box has said it
/// did, at the time at which it did it: what it does if it keeps its rules. So the model is behind by the box's
/// answers, and a window that came too late is lit by neither. Once the box contradicts the model (it went dark, it
/// refuses, it does not answer) that is an event or an error.
#[derive(Debug)]
pub struct SerialBox {
    link: Link,
    received: LineBuffer,
    model: SimulatedLaser,
    name: String,
    options: SerialOptions,
    limits: Limits,
    box_clock: BoxClock,
    wire: Option<WireCheck>,
    made_dark: bool,
    /// Length of the program's narrowest window.
    narrowest: TimeNs,
    last_number: u32,
    t_sent: TimeNs,
    unanswered: [Option<Sent>; UNANSWERED_MAX],
    /// What the box missed of its windows, until it is fetched.
    missed: VecDeque<MissedLight>,
    /// It is told to go dark: what goes wrong with earlier commands no longer matters.
    goes_dark: bool,
    /// The command whose answer is waited for, and the answer.
    awaited: Option<(u32, Option<Result<Answer<'static>, Refusal>>)>,
    clock: fn() -> TimeNs,
}

#[derive(Clone, Copy, Debug)]
struct Sent {
    number: u32,
    command: &'static str,
    t: TimeNs,
    effect: Effect,
}

/// What a command does at the box, for the model to do once the box has done it.
#[derive(Clone, Copy, Debug)]
enum Effect {
    /// Nothing, or its answer is waited for.
    None,
    Heartbeat,
    Frame {
        t: TimeNs,
        error_us: u32,
    },
    Light(LitWindow),
}

impl SerialBox {
    /// Opens the box at `path` and asks who it is before anything else is said.
    ///
    /// # Errors
    /// [`LaserError::Open`], [`LaserError::InUse`], [`LaserError::NotABox`], [`LaserError::Version`],
    /// [`LaserError::NoSyncInput`], [`LaserError::NoAnswer`], [`LaserError::Line`].
    pub fn open(path: &Path, options: SerialOptions, clock: fn() -> TimeNs) -> Result<Self, LaserError> {
        let [reader, writer] = open_port(path, BAUD, Sharing::Alone)?;
        Self::identify(reader, writer, &path.display().to_string(), options, clock)
    }

    /// Makes the box at `path` dark, whoever else has its port open, and waits for the acknowledgement. Darkness comes
    /// first: the box is not asked who it is, and to any other device the words mean nothing. It stays dark until a host
    /// begins anew.
    ///
    /// # Errors
    /// As [`Self::open`], without [`LaserError::InUse`].
    pub fn make_dark(path: &Path, clock: fn() -> TimeNs) -> Result<(), LaserError> {
        let [reader, writer] = open_port(path, BAUD, Sharing::Beside)?;
        let link = Link::new(reader, writer, clock)?;
        // Numbers that the other program does not wait for.
        let first = std::process::id().wrapping_mul(0x1_0000) | 0x8000_0000;
        let mut this = Self::on(link, &path.display().to_string(), SerialOptions::default(), first, clock);
        // No LF comes first: it would make an armed box dark as a line that is no command, and its host would arm it
        // again. Where somebody has left half a line, the first try completes and the second one follows it.
        for _ in 0..DARK_TRIES {
            let number = this.send(&Command::Disarm(DarkReason::ByHand))?;
            this.awaited = Some((number, None));
            let t_end = clock() + TimeNs(50_000_000);
            while clock() < t_end {
                // What else the box has to say is for whoever drives it.
                if let Err(failed @ LaserError::Line(_)) = this.hear(clock()) {
                    return Err(failed);
                }
                if matches!(this.awaited, Some((_, Some(Ok(_))))) {
                    return Ok(());
                }
                std::thread::sleep(Duration::from_micros(200));
            }
            this.unanswered = [None; UNANSWERED_MAX];
        }
        Err(LaserError::NoAnswer { command: "DISARM", waited_ms: 50 * DARK_TRIES as i64 })
    }

    /// Asks the box at `path` how it is; it is not armed and nobody else must be driving it.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn inspect(path: &Path, clock: fn() -> TimeNs) -> Result<BoxReport, LaserError> {
        Self::open(path, SerialOptions::default(), clock)?.report()
    }

    /// How the box is.
    ///
    /// # Errors
    /// [`LaserError::NoAnswer`], [`LaserError::Line`].
    pub fn report(&mut self) -> Result<BoxReport, LaserError> {
        let Answer::State { state, .. } = self.ask(&Command::State, SET_UP_WAIT)? else {
            return Err(LaserError::Refused { command: "STAT?", refusal: Refusal::Malformed });
        };
        let clock_error_ns = self.box_clock.offset_at((self.clock)()).map_or(i64::MAX, Offset::error_ns);
        Ok(BoxReport { name: self.name.clone(), limits: self.limits, state, clock_error_ns })
    }

    /// Talks to the box on `reader` and `writer`; `name` is for messages. Reads return within some tens of
    /// milliseconds, with [`std::io::ErrorKind::WouldBlock`] or [`std::io::ErrorKind::TimedOut`] where nothing is
    /// there.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn identify(
        reader: impl Read + Send + 'static,
        writer: impl Write + Send + 'static,
        name: &str,
        options: SerialOptions,
        clock: fn() -> TimeNs,
    ) -> Result<Self, LaserError> {
        let mut this = Self::on(Link::new(reader, writer, clock)?, name, options, 0, clock);
        // Ends whatever an earlier host left half said; the box answers it with an error of number 0.
        this.link.send(b"\n")?;
        let number = this.send(&Command::Identify)?;
        let (version, box_name) = this.hear_identity(number, name)?;
        if version != PROTOCOL_VERSION {
            return Err(LaserError::Version { path: name.into(), found: version, expected: PROTOCOL_VERSION });
        }
        this.name = box_name;
        this.unanswered = [None; UNANSWERED_MAX];
        if let Answer::Limits { limits, .. } = this.ask(&Command::Limits, SET_UP_WAIT)? {
            this.limits = limits;
        }
        if options.sync_wire && !this.limits.sync_input {
            return Err(LaserError::NoSyncInput);
        }
        for _ in 0..CLOCK_EXCHANGES {
            this.ask(&Command::Now, SET_UP_WAIT)?;
        }
        Ok(this)
    }

    fn on(link: Link, name: &str, options: SerialOptions, first_number: u32, clock: fn() -> TimeNs) -> Self {
        let now = clock();
        Self {
            link,
            received: LineBuffer::default(),
            model: SimulatedLaser::new(now),
            name: name.into(),
            options,
            limits: Limits { power_uw: [0; 3], timeout_us: 0, lit_us: 0, jitter_us: 0, sync_input: false },
            box_clock: BoxClock::default(),
            wire: None,
            made_dark: false,
            narrowest: TimeNs(0),
            last_number: first_number,
            t_sent: now,
            unanswered: [None; UNANSWERED_MAX],
            missed: VecDeque::with_capacity(UNANSWERED_MAX),
            goes_dark: false,
            awaited: None,
            clock,
        }
    }

    /// The version and the name in the answer to the command `number`.
    fn hear_identity(&mut self, number: u32, path: &str) -> Result<(u32, String), LaserError> {
        let mut t_end = (self.clock)() + IDENTIFY_WAIT;
        let mut stranger = None;
        while (self.clock)() < t_end {
            while let Some(arrival) = self.link.next()? {
                let Arrival::Bytes { count, bytes, .. } = arrival else { continue };
                for &byte in &bytes[..count] {
                    let Some(line) = self.received.push(byte) else { continue };
                    match checked(line).and_then(Message::parse) {
                        Some(Message::Done { number: ours, answer: Answer::Identity { version, name } })
                            if ours == number =>
                        {
                            return Ok((version, name.to_owned()));
                        }
                        // What a box still had to say to an earlier host, a killed one say, is no answer to us.
                        Some(_) => {}
                        None => {
                            let text = String::from_utf8_lossy(line).trim_end().to_owned();
                            // The rest of such a line, whose beginning somebody else has read, or a later box's words.
                            let a_boxs = ["!", "OK ", "ERR "].iter().any(|known| text.starts_with(known));
                            if !text.is_empty() && !a_boxs && stranger.is_none() {
                                stranger = Some(text.chars().take(40).collect::<String>());
                                t_end = t_end.min((self.clock)() + STRANGER_WAIT);
                            }
                        }
                    }
                }
            }
            std::thread::sleep(Duration::from_micros(500));
        }
        Err(match stranger {
            Some(found) => LaserError::NotABox { path: path.into(), found, expected: IDENTITY },
            None => LaserError::NoAnswer { command: "ID?", waited_ms: IDENTIFY_WAIT.0 / 1_000_000 },
        })
    }

    fn send(&mut self, command: &Command) -> Result<u32, LaserError> {
        self.send_with(command, Effect::None)
    }

    fn send_with(&mut self, command: &Command, effect: Effect) -> Result<u32, LaserError> {
        let number = self.last_number.wrapping_add(1);
        let t = (self.clock)();
        let place = &mut self.unanswered[number as usize % UNANSWERED_MAX];
        if let Some(oldest) = place
            && !self.goes_dark
        {
            return Err(LaserError::NoAnswer { command: oldest.command, waited_ms: (t.0 - oldest.t.0) / 1_000_000 });
        }
        *place = Some(Sent { number, command: command.word(), t, effect });
        self.last_number = number;
        self.t_sent = t;
        let line = Line::new(format_args!("{number} {command}")).expect("every command fits into a line");
        self.link.send(line.as_bytes())?;
        Ok(number)
    }

    /// Sends and waits for the answer, `patience` at most.
    fn ask(&mut self, command: &Command, patience: TimeNs) -> Result<Answer<'static>, LaserError> {
        let number = self.send(command)?;
        self.awaited = Some((number, None));
        let t_end = (self.clock)() + patience;
        loop {
            let heard = self.hear((self.clock)());
            if let Some((_, Some(answer))) = self.awaited
                && (heard.is_ok() || self.goes_dark)
            {
                self.awaited = None;
                return answer.map_err(|refusal| LaserError::Refused { command: command.word(), refusal });
            }
            heard?;
            if (self.clock)() >= t_end {
                self.awaited = None;
                self.unanswered[number as usize % UNANSWERED_MAX] = None;
                return Err(LaserError::NoAnswer { command: command.word(), waited_ms: patience.0 / 1_000_000 });
            }
            std::thread::sleep(Duration::from_micros(200));
        }
    }

    /// Takes in what the box has said; the first thing in it that is at fault.
    fn hear(&mut self, now: TimeNs) -> Result<(), LaserError> {
        let mut first_fault = Ok(());
        while let Some(arrival) = self.link.next()? {
            let Arrival::Bytes { t, count, bytes } = arrival else { continue };
            for &byte in &bytes[..count] {
                let message = self.received.push(byte).and_then(checked).and_then(Message::parse).map(owned);
                if let Some(message) = message {
                    let understood = self.understand(message, t, now);
                    first_fault = first_fault.and(understood);
                }
            }
        }
        first_fault
    }

    fn understand(&mut self, message: Message<'static>, t_heard: TimeNs, now: TimeNs) -> Result<(), LaserError> {
        match message {
            Message::Done { number, answer } => {
                let Some(sent) = self.take_sent(number) else { return Ok(()) };
                if let Some(t) = answer.t() {
                    self.learn(sent.t, t_heard, t)?;
                }
                self.take_effect(&sent, self.done_at(&answer, sent.t, t_heard))?;
                match answer {
                    Answer::Sync { sync, .. } => self.compare_with_wire(sync, t_heard, now)?,
                    Answer::State { state, .. } if !state.armed => {
                        self.made_dark |= state.reason == DarkReason::ByHand;
                        if self.model.is_armed() {
                            self.model.set_dark(state.reason, now);
                        }
                    }
                    _ => {}
                }
                self.give(number, Ok(answer));
                Ok(())
            }
            Message::Refused { number, refusal } => {
                let Some(sent) = self.take_sent(number) else { return Ok(()) };
                if self.give(number, Err(refusal)) {
                    return Ok(());
                }
                match (refusal, sent.effect) {
                    // A window that came too late stays dark, no more.
                    (Refusal::Late, Effect::Light(window)) => {
                        self.note_missed(window, window.t_off);
                        Ok(())
                    }
                    _ if self.goes_dark => Ok(()),
                    // It went dark by itself and has said so; or somebody else made it dark.
                    (Refusal::NotArmed, _) if !self.model.is_armed() => Ok(()),
                    (Refusal::NotArmed, _) => self.send(&Command::State).map(|_| ()),
                    (refusal, _) => Err(LaserError::Refused { command: sent.command, refusal }),
                }
            }
            Message::Dark { t, reason } => {
                let t_dark = self.host_time(t, t_heard).unwrap_or(t_heard).min(t_heard);
                self.model.set_dark(reason, t_dark);
                Ok(())
            }
            Message::Booted => {
                self.model.set_dark(DarkReason::BoxFault, now);
                self.box_clock.forget();
                Err(LaserError::Reset)
            }
        }
    }

    /// When the box did what it answers to, between sending and hearing.
    fn done_at(&self, answer: &Answer<'_>, t_sent: TimeNs, t_heard: TimeNs) -> TimeNs {
        let done = answer.t().and_then(|t| self.host_time(t, t_heard));
        done.unwrap_or(t_heard).min(t_heard).max(t_sent)
    }

    /// The box's time `t`, of which was heard at `t_heard`, as the host's, where it is known how the two go together.
    fn host_time(&self, t: TimeUs, t_heard: TimeNs) -> Option<TimeNs> {
        self.box_clock.offset_at(t_heard).map(|offset| nanoseconds(t) - TimeNs(offset.middle_ns()))
    }

    /// Has the model do what the box did at `t`.
    fn take_effect(&mut self, sent: &Sent, t: TimeNs) -> Result<(), LaserError> {
        let done = match sent.effect {
            Effect::None => Ok(()),
            Effect::Heartbeat => self.model.obey(&Command::Heartbeat, t),
            Effect::Frame { t: t_frame, error_us } => self.model.see_frame(t_frame, error_us, t),
            Effect::Light(window) => match self.model.take_window(window, t) {
                Ok(()) => {
                    self.note_missed(window, t);
                    Ok(())
                }
                Err(Refusal::Late) => {
                    self.note_missed(window, window.t_off);
                    Ok(())
                }
                refused => refused,
            },
        };
        match done {
            // By its model it went dark before; it is told so, in case that it did not.
            Err(Refusal::NotArmed) => Ok(()),
            Err(_) if self.goes_dark => Ok(()),
            done => done.map_err(refused(sent.command)),
        }
    }

    /// The box missed what of a window was over at `t`.
    fn note_missed(&mut self, window: LitWindow, t: TimeNs) {
        let time = t.min(window.t_off) - window.t_on;
        if time > TimeNs(0) && self.missed.len() < UNANSWERED_MAX {
            self.missed.push_back(MissedLight { window, time });
        }
    }

    fn take_sent(&mut self, number: u32) -> Option<Sent> {
        self.unanswered[number as usize % UNANSWERED_MAX].take_if(|sent| sent.number == number)
    }

    /// Gives the answer to whoever waits for it; whether somebody does.
    fn give(&mut self, number: u32, answer: Result<Answer<'static>, Refusal>) -> bool {
        match &mut self.awaited {
            Some((awaited, place)) if *awaited == number => {
                *place = Some(answer);
                true
            }
            _ => false,
        }
    }

    fn learn(&mut self, t_asked: TimeNs, t_heard: TimeNs, t_box: TimeUs) -> Result<(), LaserError> {
        self.box_clock
            .learn(t_asked, t_heard, t_box)
            .map_err(|apart_ns| LaserError::ClockJump { jump_us: apart_ns / 1000 })
    }

    fn compare_with_wire(&mut self, sync: SyncSeen, t_heard: TimeNs, now: TimeNs) -> Result<(), LaserError> {
        let (Some(wire), Some(offset)) = (&mut self.wire, self.box_clock.offset_at(t_heard)) else { return Ok(()) };
        if wire.agrees(sync, offset) {
            return Ok(());
        }
        self.send(&Command::Disarm(DarkReason::SyncDisagrees))?;
        self.model.set_dark(DarkReason::SyncDisagrees, now);
        Err(LaserError::SyncDisagrees)
    }

    fn require_armed(&self, command: &'static str) -> Result<(), LaserError> {
        if self.model.is_armed() { Ok(()) } else { Err(refused(command)(Refusal::NotArmed)) }
    }

    fn trigger(&self, program: &LaserProgram) -> BoxTrigger {
        match program.trigger {
            Trigger::Host => BoxTrigger::Host,
            Trigger::PanelSync if self.options.sync_wire => BoxTrigger::Sync,
            Trigger::PanelSync => BoxTrigger::Frame,
        }
    }
}

/// A message without the name in it, which only an identity has.
fn owned(message: Message<'_>) -> Message<'static> {
    match message {
        Message::Done { number, answer } => Message::Done {
            number,
            answer: match answer {
                Answer::Identity { version, .. } => Answer::Identity { version, name: "" },
                Answer::Done { t } => Answer::Done { t },
                Answer::Sync { t, sync } => Answer::Sync { t, sync },
                Answer::Limits { t, limits } => Answer::Limits { t, limits },
                Answer::State { t, state } => Answer::State { t, state },
            },
        },
        Message::Refused { number, refusal } => Message::Refused { number, refusal },
        Message::Booted => Message::Booted,
        Message::Dark { t, reason } => Message::Dark { t, reason },
    }
}

fn refused(command: &'static str) -> impl Fn(Refusal) -> LaserError {
    move |refusal| LaserError::Refused { command, refusal }
}

impl LaserBox for SerialBox {
    fn capability(&self) -> Capability {
        Capability {
            simulated: self.name == SIMULATED,
            gates_fields: true,
            has_heartbeat: true,
            sync_wire: self.options.sync_wire,
        }
    }

    fn is_made_dark(&self) -> bool {
        self.made_dark
    }

    fn program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), LaserError> {
        let limits = self.limits;
        let power_limit_uw = PerColour([0, 1, 2].map(|i| self.options.power_limit_uw.0[i].min(limits.power_uw[i])));
        within_limits(program, &limits)?;
        let trigger = self.trigger(program);
        for command in commands(program, trigger, power_limit_uw, limits.jitter_us)? {
            self.ask(&command, SET_UP_WAIT)?;
            // The model has no wire: it is told of the frames.
            let command = match command {
                Command::Sequence { sequence, period_us, trigger: BoxTrigger::Sync } => {
                    Command::Sequence { sequence, period_us, trigger: BoxTrigger::Frame }
                }
                command => command,
            };
            self.model.obey(&command, now).map_err(refused(command.word()))?;
        }
        self.narrowest = program.windows.iter().map(|window| window.width).min().unwrap_or(TimeNs(0));
        self.wire = (trigger == BoxTrigger::Sync).then(|| WireCheck::new(program.frame_period));
        Ok(())
    }

    fn arm(&mut self, now: TimeNs) -> Result<(), LaserError> {
        if self.made_dark {
            return Err(LaserError::MadeDark);
        }
        let answer = match self.ask(&Command::Arm, SWITCH_WAIT) {
            Err(LaserError::Refused { refusal: Refusal::ByHand, .. }) => {
                self.made_dark = true;
                return Err(LaserError::MadeDark);
            }
            armed => armed?,
        };
        if let Some(wire) = &mut self.wire {
            *wire = WireCheck::new(wire.period);
        }
        let t = self.done_at(&answer, now, (self.clock)().max(now));
        self.model.obey(&Command::Arm, t).map_err(refused("ARM"))
    }

    fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        if let Some(wire) = &mut self.wire {
            wire.frame_began(t_sync);
            return self.model.see_frame(t_sync, 0, now).map(|()| None).map_err(refused("FRM"));
        }
        self.require_armed("FRM")?;
        let Some(offset) = self.box_clock.offset_at(now) else { return Ok(Some(DarkReason::ClockUnsure)) };
        let t = floor_us(t_sync + TimeNs(offset.middle_ns()));
        let error_us = u32::try_from(offset.error_ns() / 1000 + 1).unwrap_or(u32::MAX);
        self.send_with(&Command::Frame { t, error_us }, Effect::Frame { t: t_sync, error_us })?;
        // What is not known of the frame's start is cut off its windows at both ends.
        Ok((2 * i64::from(error_us) * 1000 >= self.narrowest.0).then_some(DarkReason::ClockUnsure))
    }

    fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        self.require_armed("LIT")?;
        // The box may have been waited for since.
        let now = now.max((self.clock)());
        let Some(offset) = self.box_clock.offset_at(now) else { return Ok(Some(DarkReason::ClockUnsure)) };
        // Wherever the truth lies within the bounds, the box lights inside the window.
        let t_on = ceil_us(window.t_on + TimeNs(offset.greatest_ns));
        let t_off = floor_us(window.t_off + TimeNs(offset.least_ns)).before(self.limits.jitter_us);
        if t_off <= t_on {
            return Ok(Some(DarkReason::ClockUnsure));
        }
        // So late it is there at least.
        if t_off <= floor_us(now + TimeNs(offset.least_ns)) {
            return Ok(Some(DarkReason::Late));
        }
        let cut = TimeNs(offset.error_ns());
        let lit = LitWindow { t_on: window.t_on + cut, t_off: window.t_off - cut, ..window };
        self.send_with(&Command::Light { laser: laser_of(window.colour), t_on, t_off }, Effect::Light(lit))?;
        Ok(None)
    }

    fn heartbeat(&mut self, _now: TimeNs) -> Result<(), LaserError> {
        self.require_armed("HB")?;
        self.send_with(&Command::Heartbeat, Effect::Heartbeat).map(drop)
    }

    fn dark(&mut self, reason: DarkReason, now: TimeNs) -> Result<(), LaserError> {
        self.goes_dark = true;
        let mut told = self.ask(&Command::Disarm(reason), SWITCH_WAIT);
        if told.is_err() {
            // The line may have swallowed the first one.
            told = self.ask(&Command::Disarm(reason), SWITCH_WAIT);
        }
        self.goes_dark = false;
        self.unanswered = [None; UNANSWERED_MAX];
        told?;
        self.model.set_dark(reason, (self.clock)().max(now));
        self.made_dark &= reason != DarkReason::Boot;
        Ok(())
    }

    fn known_until(&self, now: TimeNs) -> TimeNs {
        self.unanswered.iter().flatten().map(|sent| sent.t).min().unwrap_or(now).min(now)
    }

    fn next_missed(&mut self) -> Option<MissedLight> {
        self.missed.pop_front()
    }

    fn poll(&mut self, now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError> {
        let heard = self.hear(now);
        let overdue = |sent: &&Sent| now.0 - sent.t.0 > ANSWER_WAIT.0;
        let unheard = self.unanswered.iter().flatten().find(overdue).copied();
        if unheard.is_some() {
            self.unanswered = [None; UNANSWERED_MAX];
        }
        self.model.advance(self.known_until(now));
        let mut box_may_go_on = None;
        while let Some(next) = self.model.next_event() {
            // What the model misses, a frame or a heartbeat, the box itself may not miss yet.
            if let BoxEvent::Dark { reason, .. } = next
                && reason.is_of_box()
            {
                box_may_go_on = Some(reason);
            }
            event(next);
        }
        let told = box_may_go_on.map_or(Ok(()), |reason| self.send(&Command::Disarm(reason)).map(drop));
        if let Some(Sent { command, t, .. }) = unheard {
            return Err(LaserError::NoAnswer { command, waited_ms: (now.0 - t.0) / 1_000_000 });
        }
        heard.and(told)?;
        if now.0 - self.t_sent.0 > ASK_TIME_EVERY.0 {
            // In the dark the question is also whether somebody means it to stay so.
            self.send(if self.model.is_armed() { &Command::Now } else { &Command::State })?;
        }
        Ok(())
    }
}

impl Drop for SerialBox {
    /// A last word, in case nobody said it; the box's heartbeat timeout does the rest.
    fn drop(&mut self) {
        self.unanswered = [None; UNANSWERED_MAX];
        let _nobody_listens = self.send(&Command::Disarm(DarkReason::Shutdown));
    }
}

/// Compares the edges on the box's sync wire with the frames that the host knows of. The wire may come at any constant
/// delay, which is learned from the first edge after arming; it must not wander, and no frame may be missing.
///
/// Frames are counted from one comparison to the next, since a panel's period is never quite the rig's: counted from the
/// first one, 59.94 Hz for 60 would be half a frame apart within nine seconds.
#[derive(Clone, Copy, Debug)]
struct WireCheck {
    period: TimeNs,
    /// Start of the last colour frame that the host knows of.
    t_frame: Option<TimeNs>,
    /// From the start of a frame to the edge, at the first comparison.
    delay_ns: Option<i64>,
    /// The last comparison: count of edges, and when the last of them was.
    last: Option<(u32, i64)>,
}

impl WireCheck {
    const fn new(period: TimeNs) -> Self {
        Self { period, t_frame: None, delay_ns: None, last: None }
    }

    fn frame_began(&mut self, t: TimeNs) {
        self.t_frame = Some(t);
    }

    fn agrees(&mut self, sync: SyncSeen, offset: Offset) -> bool {
        let (Some(t_frame), Some(t_edge)) = (self.t_frame, sync.t_last) else { return true };
        let t_edge_ns = nanoseconds(t_edge).0.saturating_sub(offset.middle_ns());
        let since_frame_ns = t_edge_ns.saturating_sub(t_frame.0);
        let delay_ns = *self.delay_ns.get_or_insert(since_frame_ns);
        let (last_count, t_last_edge_ns) =
            self.last.replace((sync.count, t_edge_ns)).unwrap_or((sync.count, t_edge_ns));
        let half = self.period.0 / 2;
        let wander_ns = since_frame_ns.saturating_sub(delay_ns).saturating_add(half).rem_euclid(self.period.0) - half;
        let tolerance_ns = self.period.0 / 16 + offset.error_ns();
        let frames = t_edge_ns.saturating_sub(t_last_edge_ns).saturating_add(half).div_euclid(self.period.0);
        let edges = i64::from(sync.count.wrapping_sub(last_count));
        wander_ns.abs() <= tolerance_ns && edges == frames
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXACT: Offset = Offset { least_ns: 0, greatest_ns: 0 };
    const PERIOD: TimeNs = TimeNs(16_000_000);

    /// Feeds frames at `frames` (ms) and edges at `edges` (ms), one each in turn; whether they agree all along.
    fn agree(frames: &[i64], edges: &[i64]) -> bool {
        let mut check = WireCheck::new(PERIOD);
        frames.iter().zip(edges).zip(1..).all(|((&frame, &edge), count)| {
            check.frame_began(TimeNs(frame * 1_000_000));
            check.agrees(SyncSeen { count, t_last: Some(TimeUs(edge as u64 * 1000)) }, EXACT)
        })
    }

    /// Whether a panel of `period_us` agrees for ten minutes, heard of once in `every` frames.
    fn agrees_for_ten_minutes(period_us: i64, every: u32) -> bool {
        let mut check = WireCheck::new(PERIOD);
        (1..600_000_000 / period_us as u32).step_by(every as usize).all(|count| {
            let t_us = i64::from(count) * period_us;
            check.frame_began(TimeNs(t_us * 1000));
            check.agrees(SyncSeen { count, t_last: Some(TimeUs(t_us as u64 + 3000)) }, EXACT)
        })
    }

    #[test]
    fn a_panel_whose_period_is_not_quite_the_rigs_agrees_for_as_long_as_it_runs() {
        for off_us in [-16, -1, 0, 1, 16] {
            assert!(agrees_for_ten_minutes(16_000 + off_us, 1), "{off_us} µs");
            assert!(agrees_for_ten_minutes(16_000 + off_us, 60), "{off_us} µs, asked once in 60 frames");
        }
        assert!(!agrees_for_ten_minutes(17_000, 60), "a panel of another rate, asked once in 60 frames");
    }

    #[test]
    fn a_wire_that_comes_at_a_constant_delay_agrees() {
        for delay in [0, 3, 11, 40] {
            assert!(agree(&[16, 32, 48, 64, 80], &[16, 32, 48, 64, 80].map(|t| t + delay)), "{delay}");
        }
        assert!(agree(&[16, 32, 48], &[20, 37, 51]), "jitter of 1 ms");
    }

    #[test]
    fn canary_a_wire_that_wanders_doubles_or_misses_disagrees() {
        assert!(!agree(&[16, 32, 48], &[20, 38, 52]), "2 ms later");
        assert!(!agree(&[16, 32, 48], &[20, 28, 36]), "twice the rate");
        assert!(!agree(&[16, 32, 48], &[20, 52, 84]), "half the rate");
    }
}
