//! What the lines mean: a host's commands, a box's answers and what it says by itself.
//!
//! Everything here can be written and read back, so that host and box share one grammar.

use core::fmt;

use crate::types::{DarkReason, Laser, Limits, Sequence, State, SyncSeen, TimeUs, Trigger, Window};
use crate::{FIELDS_MAX, PROTOCOL_VERSION};

/// How the answer to `ID?` begins, in every version of the protocol.
pub const FAMILY: &str = "holod-laser-box";
/// The name of a box without lasers.
pub const SIMULATED: &str = "simulated";
/// The argument of `ARM`, so that no stray byte arms.
const ARM_TOKEN: &str = "LIGHT";

/// What a host tells a box or asks it, one line each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum Command {
    /// `ID?`: who are you.
    Identify,
    /// `LIM?`: what are you built for.
    Limits,
    /// `NOW?`: what does your clock say.
    Now,
    /// `STAT?`: how are you.
    State,
    /// `SEQ`: the laser of each field, the length of a colour frame, who starts windows. Forgets all other settings.
    Sequence {
        /// The laser of each field.
        sequence: Sequence,
        /// From one colour frame's start to the next, microseconds.
        period_us: u32,
        trigger: Trigger,
    },
    /// `FLD`: one field's window.
    Field {
        /// Position in the sequence.
        field: usize,
        window: Window,
    },
    /// `MAX`: the greatest power that this bench allows each laser, microwatts.
    PowerLimit([u32; 3]),
    /// `POW`: the power of each laser while it is lit, microwatts.
    Power([u32; 3]),
    /// `TMO`: heartbeat timeout, microseconds.
    Timeout(u32),
    /// `ARM`: may light lasers from now on.
    Arm,
    /// `DISARM`: all lasers out.
    Disarm(DarkReason),
    /// `HB`: the host lives and knows what is on the panel.
    Heartbeat,
    /// `FRM`: a colour frame began.
    Frame {
        t: TimeUs,
        /// By how much `t` may be wrong either way, microseconds.
        error_us: u32,
    },
    /// `LIT`: light one window.
    Light { laser: Laser, t_on: TimeUs, t_off: TimeUs },
}

impl Command {
    /// The word that begins it.
    pub const fn word(&self) -> &'static str {
        match self {
            Self::Identify => "ID?",
            Self::Limits => "LIM?",
            Self::Now => "NOW?",
            Self::State => "STAT?",
            Self::Sequence { .. } => "SEQ",
            Self::Field { .. } => "FLD",
            Self::PowerLimit(_) => "MAX",
            Self::Power(_) => "POW",
            Self::Timeout(_) => "TMO",
            Self::Arm => "ARM",
            Self::Disarm(_) => "DISARM",
            Self::Heartbeat => "HB",
            Self::Frame { .. } => "FRM",
            Self::Light { .. } => "LIT",
        }
    }

    /// The number and the command in a line's checked text; nothing where it is no command.
    pub fn parse(text: &str) -> Option<(u32, Self)> {
        let mut words = Words::new(text)?;
        let number = words.number()?;
        let command = match words.next()? {
            "ID?" => Self::Identify,
            "LIM?" => Self::Limits,
            "NOW?" => Self::Now,
            "STAT?" => Self::State,
            "SEQ" => Self::Sequence {
                sequence: Sequence::from_letters(words.next()?)?,
                period_us: words.number()?,
                trigger: Trigger::from_name(words.next()?)?,
            },
            "FLD" => {
                let field: u32 = words.number()?;
                let window = Window { delay_us: words.number()?, width_us: words.number()? };
                Self::Field { field: usize::try_from(field).ok().filter(|&field| field < FIELDS_MAX)?, window }
            }
            "MAX" => Self::PowerLimit([words.number()?, words.number()?, words.number()?]),
            "POW" => Self::Power([words.number()?, words.number()?, words.number()?]),
            "TMO" => Self::Timeout(words.number()?),
            "ARM" if words.next()? == ARM_TOKEN => Self::Arm,
            // A reason of a later version makes dark, too.
            "DISARM" => Self::Disarm(DarkReason::from_name(words.next()?).unwrap_or(DarkReason::Asked)),
            "HB" => Self::Heartbeat,
            "FRM" => Self::Frame { t: words.time()?, error_us: words.number()? },
            "LIT" => {
                let laser = letter(words.next()?)?;
                Self::Light { laser, t_on: words.time()?, t_off: words.time()? }
            }
            _ => return None,
        };
        words.end()?;
        Some((number, command))
    }
}

impl fmt::Display for Command {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())?;
        match self {
            Self::Identify | Self::Limits | Self::Now | Self::State | Self::Heartbeat => Ok(()),
            Self::Sequence { sequence, period_us, trigger } => write!(f, " {sequence} {period_us} {}", trigger.name()),
            Self::Field { field, window } => write!(f, " {field} {} {}", window.delay_us, window.width_us),
            Self::PowerLimit([red, green, blue]) | Self::Power([red, green, blue]) => {
                write!(f, " {red} {green} {blue}")
            }
            Self::Timeout(timeout_us) => write!(f, " {timeout_us}"),
            Self::Arm => write!(f, " {ARM_TOKEN}"),
            Self::Disarm(reason) => write!(f, " {reason}"),
            Self::Frame { t, error_us } => write!(f, " {} {error_us}", t.0),
            Self::Light { laser, t_on, t_off } => write!(f, " {} {} {}", laser.letter(), t_on.0, t_off.0),
        }
    }
}

/// Why a box does not do what it is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// It lacks a sequence, a window, a power, a power limit or a timeout.
    NotProgrammed,
    /// It is not armed.
    NotArmed,
    /// A program may change only in the dark.
    Armed,
    /// Another laser is or would be lit, or more windows wait than it can remember.
    Overlap,
    /// The window is over, or has no length.
    Late,
    /// The command is for another kind of trigger, or the box lacks the input that the trigger needs.
    Trigger,
    /// The laser is not in the sequence.
    Laser,
    /// A time or length that the box is not built for.
    Range,
    /// More power than the bench or the box allows.
    Power,
    /// Its interlock is open.
    Interlock,
    /// The line's data terminal ready signal is low.
    HangUp,
    /// The line was damaged or no command.
    Malformed,
    /// It was made dark by hand, and no host has begun anew since.
    ByHand,
}

impl Refusal {
    const CODES: [(Self, &'static str, &'static str); 13] = [
        (Self::NotProgrammed, "PROGRAM", "it is not programmed"),
        (Self::NotArmed, "DARK", "it is not armed"),
        (Self::Armed, "ARMED", "it is armed, and takes a program only in the dark"),
        (Self::Overlap, "OVERLAP", "two lasers would be lit at once, or too many windows wait"),
        (Self::Late, "LATE", "the window has gone by"),
        (Self::Trigger, "TRIGGER", "its program has another trigger, or it has no sync input"),
        (Self::Laser, "LASER", "the laser is not in its sequence"),
        (Self::Range, "RANGE", "a time is beyond what it is built for"),
        (Self::Power, "POWER", "the power is above the bench's limit or the box's own"),
        (Self::Interlock, "INTERLOCK", "its interlock is open: close it"),
        (Self::HangUp, "DTR", "the line's data terminal ready signal is low"),
        (Self::Malformed, "LINE", "the line was damaged or is no command"),
        (Self::ByHand, "BY-HAND", "somebody made it dark with `holod dark`"),
    ];

    /// Its code on the line.
    pub fn code(self) -> &'static str {
        Self::CODES[self as usize].1
    }

    /// The refusal of a code; an unknown code is one that we do not understand.
    fn from_code(code: &str) -> Self {
        Self::CODES.into_iter().find(|(_, known, _)| *known == code).map_or(Self::Malformed, |(refusal, ..)| refusal)
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(Self::CODES[*self as usize].2)
    }
}

/// What a box says to a command that it carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum Answer<'a> {
    /// The answer to `ID?`: its name, and what it speaks.
    Identity {
        /// Its version of the protocol.
        version: u32,
        name: &'a str,
    },
    /// It has done it, at `t` of its clock.
    Done { t: TimeUs },
    /// It has heard the heartbeat, and has seen sync edges.
    Sync { t: TimeUs, sync: SyncSeen },
    /// What it is built for.
    Limits { t: TimeUs, limits: Limits },
    /// The answer to `STAT?`.
    State { t: TimeUs, state: State },
}

impl Answer<'_> {
    /// The box's time in it. An identity has none.
    pub const fn t(&self) -> Option<TimeUs> {
        match self {
            Self::Identity { .. } => None,
            Self::Done { t } | Self::Sync { t, .. } | Self::Limits { t, .. } | Self::State { t, .. } => Some(*t),
        }
    }
}

/// Any line from a box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum Message<'a> {
    /// The answer to a command that was carried out.
    Done { number: u32, answer: Answer<'a> },
    /// The answer to one that was not.
    Refused {
        /// The command's number; 0 where the line was damaged.
        number: u32,
        refusal: Refusal,
    },
    /// It has booted: dark, and without settings.
    Booted,
    /// It went dark by itself.
    Dark { t: TimeUs, reason: DarkReason },
}

impl<'a> Message<'a> {
    /// The message in a line's checked text; nothing where it is none.
    pub fn parse(text: &'a str) -> Option<Self> {
        let mut words = Words::new(text)?;
        let message = match words.next()? {
            "OK" => Self::Done { number: words.number()?, answer: answer(&mut words)? },
            "ERR" => Self::Refused { number: words.number()?, refusal: Refusal::from_code(words.next()?) },
            "!BOOT" => Self::Booted,
            // A reason of a later version is a fault to us.
            "!DARK" => Self::Dark {
                t: words.time()?,
                reason: DarkReason::from_name(words.next()?).unwrap_or(DarkReason::BoxFault),
            },
            _ => return None,
        };
        words.end()?;
        Some(message)
    }
}

fn answer<'a>(words: &mut Words<'a>) -> Option<Answer<'a>> {
    let first = words.next()?;
    if first == FAMILY {
        return Some(Answer::Identity { version: words.number()?, name: words.next()? });
    }
    let t = TimeUs(number(first)?);
    let Some(second) = words.next() else { return Some(Answer::Done { t }) };
    match second {
        "armed" | "dark" => {
            // As with `!DARK`.
            let reason = DarkReason::from_name(words.next()?).unwrap_or(DarkReason::BoxFault);
            let lit = match words.next()? {
                "-" => None,
                text => Some(letter(text)?),
            };
            let interlock_closed = match words.next()? {
                "closed" => true,
                "open" => false,
                _ => return None,
            };
            let sync = SyncSeen { count: words.number()?, t_last: optional_time(words.next()?)? };
            Some(Answer::State { t, state: State { armed: second == "armed", reason, lit, interlock_closed, sync } })
        }
        "limits" => {
            let limits = Limits {
                power_uw: [words.number()?, words.number()?, words.number()?],
                timeout_us: words.number()?,
                lit_us: words.number()?,
                jitter_us: words.number()?,
                sync_input: match words.next()? {
                    "sync" => true,
                    "-" => false,
                    _ => return None,
                },
            };
            Some(Answer::Limits { t, limits })
        }
        count => Some(Answer::Sync {
            t,
            sync: SyncSeen { count: number(count)?.try_into().ok()?, t_last: Some(words.time()?) },
        }),
    }
}

impl fmt::Display for Message<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Done { number, answer } => write!(f, "OK {number} {answer}"),
            Self::Refused { number, refusal } => write!(f, "ERR {number} {}", refusal.code()),
            Self::Booted => f.write_str("!BOOT"),
            Self::Dark { t, reason } => write!(f, "!DARK {} {reason}", t.0),
        }
    }
}

impl fmt::Display for Answer<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Identity { version, name } => write!(f, "{FAMILY} {version} {name}"),
            Self::Done { t } => write!(f, "{}", t.0),
            Self::Sync { t, sync } => write!(f, "{} {} {}", t.0, sync.count, OptionalTime(sync.t_last)),
            Self::Limits { t, limits } => {
                let [red, green, blue] = limits.power_uw;
                let sync = if limits.sync_input { "sync" } else { "-" };
                write!(
                    f,
                    "{} limits {red} {green} {blue} {} {} {} {sync}",
                    t.0, limits.timeout_us, limits.lit_us, limits.jitter_us
                )
            }
            Self::State { t, state } => write!(
                f,
                "{} {} {} {} {} {} {}",
                t.0,
                if state.armed { "armed" } else { "dark" },
                state.reason,
                state.lit.map_or('-', Laser::letter),
                if state.interlock_closed { "closed" } else { "open" },
                state.sync.count,
                OptionalTime(state.sync.t_last)
            ),
        }
    }
}

/// The identity of a box of this version.
pub const fn identity(name: &str) -> Answer<'_> {
    Answer::Identity { version: PROTOCOL_VERSION, name }
}

struct OptionalTime(Option<TimeUs>);

impl fmt::Display for OptionalTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(t) => write!(f, "{}", t.0),
            None => f.write_str("-"),
        }
    }
}

fn optional_time(text: &str) -> Option<Option<TimeUs>> {
    if text == "-" { Some(None) } else { number(text).map(|t| Some(TimeUs(t))) }
}

fn letter(text: &str) -> Option<Laser> {
    let mut letters = text.chars();
    let laser = Laser::from_letter(letters.next()?)?;
    letters.next().is_none().then_some(laser)
}

/// Digits only: no sign, no space.
fn number(text: &str) -> Option<u64> {
    text.bytes().all(|byte| byte.is_ascii_digit()).then(|| text.parse().ok())?
}

/// The words of a line, which single spaces part.
struct Words<'a>(core::str::Split<'a, char>);

impl<'a> Words<'a> {
    fn new(text: &'a str) -> Option<Self> {
        (!text.is_empty()).then(|| Self(text.split(' ')))
    }

    fn next(&mut self) -> Option<&'a str> {
        self.0.next()
    }

    fn number(&mut self) -> Option<u32> {
        number(self.next()?)?.try_into().ok()
    }

    fn time(&mut self) -> Option<TimeUs> {
        number(self.next()?).map(TimeUs)
    }

    fn end(mut self) -> Option<()> {
        self.next().is_none().then_some(())
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::string::ToString;
    use std::vec;

    use proptest::prelude::*;

    use super::*;
    use crate::line::{Line, LineBuffer, checked};

    fn lasers() -> impl Strategy<Value = Laser> {
        prop::sample::select(Laser::ALL.to_vec())
    }

    fn times() -> impl Strategy<Value = TimeUs> {
        prop_oneof![any::<u64>(), 0u64..5_000_000].prop_map(TimeUs)
    }

    fn reasons() -> impl Strategy<Value = DarkReason> {
        prop::sample::select(DarkReason::ALL.to_vec())
    }

    fn commands() -> impl Strategy<Value = Command> {
        let triggers = prop::sample::select(vec![Trigger::Sync, Trigger::Frame, Trigger::Host]);
        let sequences = prop::collection::vec(lasers(), 1..=FIELDS_MAX);
        prop_oneof![
            Just(Command::Identify),
            Just(Command::Limits),
            Just(Command::Now),
            Just(Command::State),
            (sequences, any::<u32>(), triggers).prop_map(|(lasers, period_us, trigger)| Command::Sequence {
                sequence: Sequence::new(lasers).unwrap(),
                period_us,
                trigger
            }),
            (0..FIELDS_MAX, any::<u32>(), any::<u32>()).prop_map(|(field, delay_us, width_us)| Command::Field {
                field,
                window: Window { delay_us, width_us }
            }),
            any::<[u32; 3]>().prop_map(Command::PowerLimit),
            any::<[u32; 3]>().prop_map(Command::Power),
            any::<u32>().prop_map(Command::Timeout),
            Just(Command::Arm),
            reasons().prop_map(Command::Disarm),
            Just(Command::Heartbeat),
            (times(), any::<u32>()).prop_map(|(t, error_us)| Command::Frame { t, error_us }),
            (lasers(), times(), times()).prop_map(|(laser, t_on, t_off)| Command::Light { laser, t_on, t_off }),
        ]
    }

    fn syncs() -> impl Strategy<Value = SyncSeen> {
        (any::<u32>(), prop::option::of(times())).prop_map(|(count, t_last)| SyncSeen { count, t_last })
    }

    fn answers() -> impl Strategy<Value = Answer<'static>> {
        let limits = (any::<[u32; 3]>(), any::<u32>(), any::<u32>(), any::<u32>(), any::<bool>()).prop_map(
            |(power_uw, timeout_us, lit_us, jitter_us, sync_input)| Limits {
                power_uw,
                timeout_us,
                lit_us,
                jitter_us,
                sync_input,
            },
        );
        let states = (any::<bool>(), reasons(), prop::option::of(lasers()), any::<bool>(), syncs()).prop_map(
            |(armed, reason, lit, interlock_closed, sync)| State { armed, reason, lit, interlock_closed, sync },
        );
        prop_oneof![
            any::<u32>().prop_map(|version| Answer::Identity { version, name: SIMULATED }),
            times().prop_map(|t| Answer::Done { t }),
            (times(), any::<u32>(), times())
                .prop_map(|(t, count, edge)| Answer::Sync { t, sync: SyncSeen { count, t_last: Some(edge) } }),
            (times(), limits).prop_map(|(t, limits)| Answer::Limits { t, limits }),
            (times(), states).prop_map(|(t, state)| Answer::State { t, state }),
        ]
    }

    fn messages() -> impl Strategy<Value = Message<'static>> {
        let refusals = prop::sample::select(Refusal::CODES.map(|(refusal, ..)| refusal).to_vec());
        prop_oneof![
            (any::<u32>(), answers()).prop_map(|(number, answer)| Message::Done { number, answer }),
            (any::<u32>(), refusals).prop_map(|(number, refusal)| Message::Refused { number, refusal }),
            Just(Message::Booted),
            (times(), reasons()).prop_map(|(t, reason)| Message::Dark { t, reason }),
        ]
    }

    proptest! {
        #[test]
        fn every_command_fits_into_a_line_and_comes_back(number in any::<u32>(), command in commands()) {
            let line = Line::new(format_args!("{number} {command}")).expect("it fits");
            let text = checked(line.as_bytes().strip_suffix(b"\n").unwrap()).unwrap();
            prop_assert_eq!(Command::parse(text), Some((number, command)));
            prop_assert!(text.split(' ').nth(1) == Some(command.word()));
        }

        #[test]
        fn every_message_fits_into_a_line_and_comes_back(message in messages()) {
            let line = Line::new(message).expect("it fits");
            let text = checked(line.as_bytes().strip_suffix(b"\n").unwrap()).unwrap();
            prop_assert_eq!(Message::parse(text), Some(message));
        }

        #[test]
        fn no_text_is_too_odd_to_be_read(text in "[ -~]{0,40}") {
            let _any = (Command::parse(&text), Message::parse(&text));
            let mut buffer = LineBuffer::default();
            for byte in text.bytes() {
                prop_assert!(buffer.push(byte).is_none());
            }
        }
    }

    #[test]
    fn what_is_no_command_is_not_taken_for_one() {
        for text in [
            "",
            " ",
            "HB",
            "3 NONSENSE",
            "3 HB 1",
            "3  HB",
            " 3 HB",
            "3 HB ",
            "3 LIT X 1 2",
            "3 LIT R 1",
            "3 LIT R -1 5",
            "3 LIT R +1 5",
            "3 LIT RG 1 5",
            "3 FRM x 0",
            "3 FRM 1",
            "3 ARM",
            "3 ARM NOW",
            "3 DISARM",
            "x HB",
            "+3 HB",
            "4294967296 HB",
            "3 SEQ RGX 3000 SYNC",
            "3 SEQ  3000 SYNC",
            "3 SEQ RGB 3000 ME",
            "3 SEQ RGBRGBRGBRGBRGBRGBRGBRGBR 3000 SYNC",
            "3 FLD 24 1 1",
            "3 FLD 0 1",
            "3 POW 1 2",
            "3 POW 1 2 3 4",
            "3 LIT R 18446744073709551616 1",
            "3 TMO 4294967296",
        ] {
            assert_eq!(Command::parse(text), None, "{text:?}");
        }
        assert_eq!(Command::parse("3 DISARM whatever"), Some((3, Command::Disarm(DarkReason::Asked))));
        let state = Message::parse("OK 3 70 dark overheated - closed 0 -");
        let is_fault = |state: State| state.reason == DarkReason::BoxFault;
        assert!(
            matches!(state, Some(Message::Done { answer: Answer::State { state, .. }, .. }) if is_fault(state)),
            "a box with reasons of its own is a box all the same: {state:?}"
        );
        for text in ["", "OK", "OK 1", "OK x 5", "OK 1 5 armed", "OK 1 -", "ERR 1", "!DARK", "!NONSENSE", "P1,1,2"] {
            assert_eq!(Message::parse(text), None, "{text:?}");
        }
    }

    #[test]
    fn codes_and_names_stand_at_their_own_places() {
        for (refusal, code, words) in Refusal::CODES {
            assert_eq!(
                (refusal.code(), Refusal::from_code(code), refusal.to_string().as_str()),
                (code, refusal, words)
            );
        }
        for trigger in [Trigger::Sync, Trigger::Frame, Trigger::Host] {
            assert_eq!(Trigger::from_name(trigger.name()), Some(trigger));
        }
    }
}
