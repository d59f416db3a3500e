//! Lasers: who may be lit, when, and what makes them dark.
//!
//! [`gate`] cuts the lit windows out of the fields; [`interlock`] decides from what is reported of the panel whether any
//! laser may be lit; a [`LaserBox`] does it, and goes dark by itself when it hears nothing more; [`verify`] judges
//! afterwards, from the edges that the box logged, whether the rule was kept.

pub mod gate;
pub mod interlock;
pub mod protocol;
mod serial_box;
mod simulated;
pub mod simulated_box;
pub mod verify;

pub use serial_box::SerialBox;
pub use simulated::SimulatedLaser;

use std::fmt;

use holod_calibration::{Colour, PerColour, TimeNs};

use crate::fields::FIELDS;

/// A laser goes on or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaserEdge {
    /// When.
    pub t: TimeNs,
    /// Which laser.
    pub colour: Colour,
    /// On or off.
    pub on: bool,
}

/// One laser, lit from `t_on` to `t_off`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LitWindow {
    /// Which laser.
    pub colour: Colour,
    /// Its on edge.
    pub t_on: TimeNs,
    /// Its off edge.
    pub t_off: TimeNs,
}

/// What happened at a laser box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BoxEvent {
    /// It may light lasers from now on.
    Armed {
        /// When.
        t: TimeNs,
    },
    /// A laser went on or off.
    Edge(LaserEdge),
    /// All lasers are out until it is armed again.
    Dark {
        /// When.
        t: TimeNs,
        /// Why.
        reason: DarkReason,
    },
}

/// Why lasers are dark.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum DarkReason {
    /// The box has heard no heartbeat for its timeout.
    Heartbeat,
    /// The box has seen no sync from the panel for two refreshes.
    SyncLost,
    /// No present report for two refreshes.
    MissingReport,
    /// A present report came when its field had gone by.
    Late,
    /// The time of presentation is a guess.
    Untrusted,
    /// The pattern is of another colour than the panel's field.
    WrongColour,
    /// The flat pattern is on the panel.
    Flat,
    /// No new frame for the stall timeout.
    Stall,
    /// The box reported a fault or does not answer.
    BoxFault,
    /// An orderly end.
    Shutdown,
    /// The program panicked.
    Panic,
    /// Somebody asked for it.
    Asked,
}

impl DarkReason {
    /// The name in files, logs and the line protocol.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Heartbeat => "heartbeat",
            Self::SyncLost => "sync-lost",
            Self::MissingReport => "missing-report",
            Self::Late => "late",
            Self::Untrusted => "untrusted",
            Self::WrongColour => "wrong-colour",
            Self::Flat => "flat",
            Self::Stall => "stall",
            Self::BoxFault => "box-fault",
            Self::Shutdown => "shutdown",
            Self::Panic => "panic",
            Self::Asked => "asked",
        }
    }

    /// Every reason.
    pub const ALL: [Self; 12] = [
        Self::Heartbeat,
        Self::SyncLost,
        Self::MissingReport,
        Self::Late,
        Self::Untrusted,
        Self::WrongColour,
        Self::Flat,
        Self::Stall,
        Self::BoxFault,
        Self::Shutdown,
        Self::Panic,
        Self::Asked,
    ];

    /// Whether a field that is dark for this reason must have been dark from its first moment on.
    pub const fn forbids_light(self) -> bool {
        matches!(self, Self::Untrusted | Self::WrongColour)
    }

    /// The reason called `name`.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|reason| reason.name() == name)
    }
}

impl fmt::Display for DarkReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Who starts a lit window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trigger {
    /// The panel's sync: the box lights its programmed windows after each colour frame's start.
    PanelSync,
    /// The host, which asks for each window.
    Host,
}

/// One field's window, counted from the start of its colour frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FieldWindow {
    /// From the colour frame's start to the on edge.
    pub delay: TimeNs,
    /// From the on edge to the off edge.
    pub width: TimeNs,
}

/// All that a box must know before it is armed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LaserProgram {
    /// Who starts a window.
    pub trigger: Trigger,
    /// The colour of each field.
    pub sequence: [Colour; FIELDS],
    /// The window of each field.
    pub windows: [FieldWindow; FIELDS],
    /// From one colour frame's start to the next.
    pub frame_period: TimeNs,
    /// Optical power of each colour while lit, microwatts at the panel.
    pub power_uw: PerColour<u32>,
    /// The box goes dark when it has heard no heartbeat for this long.
    pub heartbeat_timeout: TimeNs,
}

/// Why lasers could not be driven.
#[derive(Debug, thiserror::Error)]
pub enum LaserError {
    /// The field ends before its window begins.
    #[error(
        "a field lasts {field_us} µs but its window begins {delay_us} µs after it: shorten panel.settle or lasers.on_delay, or lower panel.refresh"
    )]
    NoRoom {
        /// Length of a field, microseconds.
        field_us: i64,
        /// Settle time and on delay, microseconds.
        delay_us: i64,
    },
    /// A laser figure of the rig that no box can take.
    #[error("lasers: {what} is {found}; expected {expected}: correct the rig file")]
    Figure {
        /// Which figure.
        what: &'static str,
        /// What it is.
        found: String,
        /// What it may be.
        expected: &'static str,
    },
    /// The box cannot be opened.
    #[error(
        "{path}: {why}; expected the serial port of a laser box: check lasers.device, the cable and the port's permissions"
    )]
    Open {
        /// The port.
        path: String,
        /// What the system said.
        why: String,
    },
    /// What answers is no laser box of this protocol.
    #[error(
        "{path}: answered `{found}`; expected `{expected}`: check that lasers.device names the laser box and not another device"
    )]
    NotABox {
        /// The port.
        path: String,
        /// What it answered.
        found: String,
        /// How a box answers.
        expected: &'static str,
    },
    /// The line to the box failed.
    #[error("the laser box's line failed: {0}")]
    Line(#[from] std::io::Error),
    /// The box did not acknowledge in time.
    #[error("the laser box did not answer `{command}` within {waited_ms} ms: check its cable and power")]
    NoAnswer {
        /// The command's word.
        command: &'static str,
        /// How long it was waited for.
        waited_ms: i64,
    },
    /// The box refused a command.
    #[error("the laser box refused `{command}`: {refusal}")]
    Refused {
        /// The command's word.
        command: &'static str,
        /// Its reason.
        refusal: Refusal,
    },
}

/// Why a box does not do what it is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// It lacks a sequence, a window or a power.
    #[error("it is not programmed")]
    NotProgrammed,
    /// It is not armed.
    #[error("it is not armed")]
    NotArmed,
    /// A program may change only in the dark.
    #[error("it is armed")]
    Armed,
    /// Another laser is or would be lit.
    #[error("two lasers would be lit at once")]
    Overlap,
    /// The window is over, or has no length.
    #[error("the window has gone by")]
    Late,
    /// The window is for the other kind of trigger.
    #[error("the program has another trigger")]
    Trigger,
    /// The line was damaged or no command.
    #[error("the line was not understood")]
    Malformed,
}

/// A box that lights lasers.
///
/// It boots dark, lights nothing until it is armed, is armed only when it is programmed, and goes dark by itself:
/// without heartbeats for its timeout, and, where the panel's sync starts its windows, without sync for two refreshes.
/// Once dark it stays dark until it is armed again. No method waits but [`Self::program`], [`Self::arm`] and
/// [`Self::dark`], which wait for the box's answer for a bounded time.
pub trait LaserBox: Send {
    /// Whether it has no lasers. Only such a box is lit over a panel that is not there.
    fn is_simulated(&self) -> bool;

    /// Sets sequence, windows and powers; only in the dark.
    ///
    /// # Errors
    /// [`LaserError`] where the box refuses or cannot be reached.
    fn program(&mut self, program: &LaserProgram, now: TimeNs) -> Result<(), LaserError>;

    /// Lets it light lasers.
    ///
    /// # Errors
    /// As [`Self::program`].
    fn arm(&mut self, now: TimeNs) -> Result<(), LaserError>;

    /// Says that a colour frame began at `t_sync`. A box with a wire to the panel sees that itself.
    ///
    /// # Errors
    /// As [`Self::program`].
    fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<(), LaserError>;

    /// Lights one window, where the host is the trigger. What has gone by of it is left out.
    ///
    /// # Errors
    /// As [`Self::program`].
    fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<(), LaserError>;

    /// Keeps it from going dark by itself.
    ///
    /// # Errors
    /// As [`Self::program`].
    fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError>;

    /// All lasers out, at once, and disarmed. `Ok` is the box's acknowledgement.
    ///
    /// # Errors
    /// As [`Self::program`]; the box is then left to its heartbeat timeout.
    fn dark(&mut self, reason: DarkReason, now: TimeNs) -> Result<(), LaserError>;

    /// Calls `event` for all that has happened at the box up to `now`, in order. A box that does not tell its edges
    /// reports those of its own model of itself.
    ///
    /// # Errors
    /// As [`Self::program`]; and where an earlier command has gone unanswered.
    fn poll(&mut self, now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError>;
}
