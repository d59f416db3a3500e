//! Lasers: who may be lit, when, and what makes them dark.
//!
//! [`crate::schedule`] decides from what is reported of the panel which laser may be lit; a [`LaserBox`] does it;
//! [`verify`] judges afterwards, from the edges that the box logged, whether the rule was kept.
//!
//! | Box | File |
//! |---|---|
//! | none: the edges are logged | `simulated.rs` |
//! | any that speaks holod's protocol, as `holod-laser-firmware` does | `serial_box.rs`; how its clock goes with the host's: `box_clock.rs`; its line: `line_link.rs` |
//! | FISBA READYBeam | `ready_beam.rs`, on `power_box.rs`; its frames: `mecom.rs` |
//! | lasers that take commands in text | `text_laser.rs`, on `power_box.rs`; their profiles: `calibration/profiles/lasers/` |
//!
//! [`open_laser`] opens the one that the rig names; `reconnect.rs` finds it again when it is lost. Another box is a
//! file here, a variant of [`LaserDriver`](holod_calibration::rig::LaserDriver) and a line in `open.rs`. [`simulator`]
//! is the other end of the protocol's line: the firmware itself, on a pseudo-terminal.

pub mod box_clock;
pub mod edge_log;
mod line_link;
mod mecom;
mod open;
mod power_box;
mod program;
mod ready_beam;
mod reconnect;
mod serial_box;
mod simulated;
pub mod simulator;
mod text_laser;
pub mod verify;

pub use holod_laser_firmware::{DarkReason, Refusal};
pub use open::{make_dark, open_laser, takes};
pub use reconnect::LaserWatch;
pub use serial_box::{BoxReport, SerialBox, SerialOptions};
pub use simulated::SimulatedLaser;

use holod_calibration::{Colour, KEPT_BY_UNIT, PerColour, TimeNs};

use crate::fields::FIELDS;

/// A laser goes on or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaserEdge {
    /// Host time, as near as the box's clock is known.
    pub t: TimeNs,
    /// Which laser it is, by its colour.
    pub colour: Colour,
    /// It goes on; else it goes off.
    pub on: bool,
}

/// One laser, lit from `t_on` to `t_off`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LitWindow {
    /// The laser's colour, which is that of the field.
    pub colour: Colour,
    /// Host time of its on edge.
    pub t_on: TimeNs,
    /// Host time of its off edge.
    pub t_off: TimeNs,
}

/// Light that a box missed because it heard of its window too late.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MissedLight {
    /// What was to be lit.
    pub window: LitWindow,
    /// How much of its beginning stayed dark.
    pub time: TimeNs,
}

impl MissedLight {
    /// Whether nothing of it was lit.
    pub fn is_whole(&self) -> bool {
        self.time >= self.window.t_off - self.window.t_on
    }
}

/// What happened at a laser box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum BoxEvent {
    /// It may light lasers from now on.
    Armed { t: TimeNs },
    /// A laser went on or off.
    Edge(LaserEdge),
    /// All lasers are out until it is armed again.
    Dark { t: TimeNs, reason: DarkReason },
}

/// Who starts a lit window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trigger {
    /// The start of a colour frame, of which the panel's sync wire tells the box, or else the host: the box lights its
    /// programmed windows after it.
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
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum LaserError {
    /// The field ends before its window begins.
    #[error(
        "a field lasts {field_us} µs, but its window begins {delay_us} µs after it and ends {slack_us} µs before the \
         next: shorten panel.settle_ms or lasers.on_delay_ms, or lower panel.refresh_hz"
    )]
    NoRoom {
        /// Length of a field, microseconds.
        field_us: i64,
        /// Settle time and on delay, microseconds.
        delay_us: i64,
        /// What is left free at the field's end, microseconds.
        slack_us: i64,
    },
    /// A laser figure of the rig that no box can take.
    #[error("lasers: {what} is {found}; expected {expected}: correct the rig file")]
    Figure {
        what: &'static str,
        found: String,
        /// What it may be.
        expected: &'static str,
    },
    /// The box cannot be opened.
    #[error(
        "{path}: {why}; expected the serial port of a laser box: check lasers.device, the cable and the port's permissions"
    )]
    Open {
        path: String,
        /// What the system said.
        why: String,
    },
    /// The port may not be opened whatever its mode is.
    #[error("{path} does not open: {KEPT_BY_UNIT}")]
    NotAllowed { path: String },
    /// What answers is no laser box of this protocol.
    #[error(
        "{path}: answered `{found}`; expected `{expected}`: check that lasers.device names the laser box and not another device"
    )]
    NotABox {
        path: String,
        /// The line that it answered.
        found: String,
        /// How a box answers.
        expected: &'static str,
    },
    /// A laser box of another version of the protocol.
    #[error(
        "{path}: a laser box that speaks version {found} of the laser protocol; this holod speaks version {expected}: flash the firmware that came with this holod"
    )]
    Version {
        path: String,
        found: u32,
        /// The version spoken here.
        expected: u32,
    },
    /// Another holod has the port.
    #[error("{path} is in use by another program: end that one first (`holod dark --config RIG` works beside it)")]
    InUse { path: String },
    /// The rig wants the panel's sync wire, which the box cannot take.
    #[error("the laser box has no input for the panel's sync output: take lasers.sync_wire out of the rig file")]
    NoSyncInput,
    /// The edges on its sync wire are not those of the frames that the host knows of.
    #[error("the edges on the laser box's sync wire are not this panel's frames: check where the wire comes from")]
    SyncDisagrees,
    /// The box is not built for what the rig asks of it.
    #[error("the laser box takes {limit} {unit} of {what} at most; the rig asks for {asked}: correct the rig file")]
    BeyondBox {
        what: String,
        limit: f64,
        /// What the rig asks for.
        asked: f64,
        /// Unit of both figures, such as mW.
        unit: &'static str,
    },
    /// A laser would be told more than the rig allows, so that its power gets to the panel.
    #[error(
        "the {colour} laser would be told {told_mw} mW, and the rig allows it {limit_mw}: correct lasers.transmission, or write lasers.head_limit_mw"
    )]
    BeyondHead {
        colour: Colour,
        /// What it would be told, milliwatts.
        told_mw: f64,
        /// The most that it may be told, milliwatts.
        limit_mw: f64,
    },
    /// The box has booted while it was in use.
    #[error("the laser box has reset itself: check its supply and its watchdog")]
    Reset,
    /// The box's clock does not go with the host's.
    #[error(
        "the laser box's clock jumped by {jump_us} µs or more: it has reset itself, the computer was suspended, or NTP \
         corrects this computer's clock fast"
    )]
    ClockJump {
        /// By how much more than drift allows, microseconds.
        jump_us: i64,
    },
    /// The box is lost and is being looked for.
    #[error("the laser box is lost and is being looked for")]
    Lost,
    /// Another kind of box is in the place of the one that was lost.
    #[error("another kind of laser box is in the place of the one that was lost: restart holod to use it")]
    AnotherKind,
    /// The device answered something else than it should.
    #[error("{path}: answered `{found}` to `{sent}`; expected {expected}")]
    Complaint {
        path: String,
        /// What it was told or asked.
        sent: String,
        /// The line that it answered.
        found: String,
        /// What it should have answered.
        expected: String,
    },
    /// The rig does not accept lasers without a heartbeat.
    #[error(
        "these lasers have no heartbeat and stay lit when holod dies: the rig file must accept that with lasers.accept_no_heartbeat"
    )]
    NotAccepted,
    /// The box cannot light one field and not the next.
    #[error(
        "these lasers cannot be switched for single fields: show one colour only (panel.mode = \"monochrome\"), or write lasers.gated_by_panel = true where the panel's own hardware gates them, which it can in mode \"channel-packed\""
    )]
    CannotGate,
    /// The bench has no laser of a colour that is to be shown.
    #[error("there is no {colour} laser on this bench: name its port in lasers.devices, or show other colours")]
    NoLaser { colour: Colour },
    /// Somebody else made the box dark.
    #[error("somebody made the laser box dark with `holod dark`: restart holod to light lasers again")]
    MadeDark,
    /// The line to the box failed.
    #[error("the laser box's line failed: {0}")]
    Line(#[from] std::io::Error),
    /// The box did not acknowledge in time.
    #[error("the laser box did not answer `{command}` within {waited_ms} ms: check its cable and power")]
    NoAnswer {
        command: &'static str,
        /// How long it was waited for.
        waited_ms: i64,
    },
    /// One of several devices did not answer in time.
    #[error("{path}: no answer to `{sent}` within {waited_ms} ms: check its cable and power")]
    NoAnswerTo {
        path: String,
        /// What it was told or asked.
        sent: String,
        /// How long it was waited for.
        waited_ms: i64,
    },
    /// Some of several lasers did not acknowledge that they are out.
    #[error("not known to be dark: {lit}; acknowledged that they are dark: {dark}")]
    NotAllDark {
        /// Which of them, and why.
        lit: String,
        /// The ports of the others.
        dark: String,
    },
    /// The box refused a command.
    #[error("the laser box refused `{command}`: {refusal}")]
    Refused { command: &'static str, refusal: Refusal },
}

impl LaserError {
    /// Why lasers are dark after it.
    pub const fn dark_reason(&self) -> DarkReason {
        match self {
            Self::MadeDark | Self::Refused { refusal: Refusal::ByHand, .. } => DarkReason::ByHand,
            Self::Refused { refusal: Refusal::Interlock, .. } => DarkReason::Interlock,
            Self::SyncDisagrees => DarkReason::SyncDisagrees,
            _ => DarkReason::BoxFault,
        }
    }

    /// Whether the box has to be opened anew after it.
    pub const fn means_lost(&self) -> bool {
        matches!(
            self,
            Self::Line(_)
                | Self::NoAnswer { .. }
                | Self::NoAnswerTo { .. }
                | Self::Reset
                | Self::ClockJump { .. }
                | Self::Complaint { .. }
                | Self::NotABox { .. }
        )
    }
}

/// What a box can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Capability {
    /// It has no lasers. Only such a box is lit over a panel that is not there.
    pub simulated: bool,
    /// It lights each field by itself, at times that it keeps. Otherwise its lasers are simply on while it is armed,
    /// and it reports no edges.
    pub gates_fields: bool,
    /// It goes dark by itself when its host dies.
    pub has_heartbeat: bool,
    /// The panel's sync output is wired to it, and it times its windows by the wire's edges.
    pub sync_wire: bool,
}

/// A box that lights lasers.
///
/// It boots dark, lights nothing until it is armed, is armed only when it is programmed, and goes dark by itself:
/// without heartbeats for its timeout, and, where the panel's sync starts its windows, without sync for two colour
/// frames. Once dark it stays dark until it is armed again. No method waits but [`Self::program`], [`Self::arm`] and
/// [`Self::dark`], which wait for the box's answer for a bounded time.
pub trait LaserBox: Send {
    /// What it can do.
    fn capability(&self) -> Capability;

    /// How long [`Self::dark`] may wait for the acknowledgement.
    fn dark_wait(&self) -> TimeNs {
        TimeNs(450_000_000)
    }

    /// Whether somebody else has made it dark, who is not to be contradicted.
    fn is_made_dark(&self) -> bool {
        false
    }

    /// What tells a thread that may wait why the box is lost, where it can be.
    fn watch(&self) -> Option<LaserWatch> {
        None
    }

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

    /// Says that a colour frame began at `t_sync`. A box with a wire to the panel sees that itself. Why the frame stays
    /// dark all the same, if it does.
    ///
    /// # Errors
    /// As [`Self::program`].
    fn sync(&mut self, t_sync: TimeNs, now: TimeNs) -> Result<Option<DarkReason>, LaserError>;

    /// Lights one window, where the host is the trigger. What has gone by of it is left out. Why it stays dark all the
    /// same, if it does.
    ///
    /// # Errors
    /// As [`Self::program`].
    fn light(&mut self, window: LitWindow, now: TimeNs) -> Result<Option<DarkReason>, LaserError>;

    /// Keeps it from going dark by itself.
    ///
    /// # Errors
    /// As [`Self::program`].
    fn heartbeat(&mut self, now: TimeNs) -> Result<(), LaserError>;

    /// All lasers out, at once, and disarmed. `Ok` is the box's acknowledgement. For [`DarkReason::Boot`], with which a
    /// host begins, a box that was made dark by hand may be armed again.
    ///
    /// # Errors
    /// As [`Self::program`]; the box is then left to its heartbeat timeout.
    fn dark(&mut self, reason: DarkReason, now: TimeNs) -> Result<(), LaserError>;

    /// Until when, of the time up to `now`, [`Self::poll`] has told of everything: of a box that answers late what it
    /// did is known later.
    fn known_until(&self, now: TimeNs) -> TimeNs {
        now
    }

    /// A window of which the box heard too late for all of it; each once.
    fn next_missed(&mut self) -> Option<MissedLight> {
        None
    }

    /// Calls `event` for all that has happened at the box up to `now`, in order. A box that does not tell its edges
    /// reports those of its own model of itself.
    ///
    /// # Errors
    /// As [`Self::program`]; and where an earlier command has gone unanswered.
    fn poll(&mut self, now: TimeNs, event: &mut dyn FnMut(BoxEvent)) -> Result<(), LaserError>;
}
