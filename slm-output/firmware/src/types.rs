//! The values that a box and its host speak about.

use core::fmt::{self, Write as _};

/// A time point of the box's own clock: microseconds since it booted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct TimeUs(pub u64);

impl TimeUs {
    /// The time `span_us` microseconds later, the last one at most.
    #[must_use]
    pub const fn after(self, span_us: u32) -> Self {
        Self(self.0.saturating_add(span_us as u64))
    }

    /// `span_us` microseconds earlier; the clock's zero at the earliest.
    #[must_use]
    pub const fn before(self, span_us: u32) -> Self {
        Self(self.0.saturating_sub(span_us as u64))
    }
}

/// One of the three lasers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Laser {
    /// The red one, R on the line.
    Red,
    /// The green one, G on the line.
    Green,
    /// The blue one, B on the line.
    Blue,
}

impl Laser {
    /// All lasers, in the order in which figures for each of them are given.
    pub const ALL: [Self; 3] = [Self::Red, Self::Green, Self::Blue];

    /// Its place in [`Self::ALL`], and of its figure among three.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// Its letter on the line.
    pub const fn letter(self) -> char {
        ['R', 'G', 'B'][self as usize]
    }

    /// The laser of a letter.
    pub fn from_letter(letter: char) -> Option<Self> {
        Self::ALL.into_iter().find(|laser| laser.letter() == letter)
    }
}

/// Who starts a lit window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trigger {
    /// An edge on the wire from the panel's sync output: the programmed windows of one colour frame follow it.
    Sync,
    /// The host, which says when each colour frame began; the programmed windows follow.
    Frame,
    /// The host, which asks for each window.
    Host,
}

impl Trigger {
    const NAMES: [(Self, &'static str); 3] = [(Self::Sync, "SYNC"), (Self::Frame, "FRAME"), (Self::Host, "HOST")];

    /// Its name on the line.
    pub fn name(self) -> &'static str {
        Self::NAMES[self as usize].1
    }

    /// The trigger of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::NAMES.into_iter().find(|(_, known)| *known == name).map(|(trigger, _)| trigger)
    }
}

/// A field's lit window, counted from the start of its colour frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// From the colour frame's start to the on edge, microseconds.
    pub delay_us: u32,
    /// From the on edge to the off edge, microseconds.
    pub width_us: u32,
}

/// Most fields that a colour frame may have.
pub const FIELDS_MAX: usize = 24;

/// The laser of each field of a colour frame, in the order in which the panel shows the fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sequence {
    lasers: [Laser; FIELDS_MAX],
    count: usize,
}

impl Sequence {
    /// The sequence of one to [`FIELDS_MAX`] lasers; nothing for another number of them.
    pub fn new(lasers: impl IntoIterator<Item = Laser>) -> Option<Self> {
        let mut sequence = Self { lasers: [Laser::Red; FIELDS_MAX], count: 0 };
        for laser in lasers {
            *sequence.lasers.get_mut(sequence.count)? = laser;
            sequence.count += 1;
        }
        (sequence.count > 0).then_some(sequence)
    }

    /// The sequence of the letters in `text`.
    pub fn from_letters(text: &str) -> Option<Self> {
        if !text.chars().all(|letter| Laser::from_letter(letter).is_some()) {
            return None;
        }
        Self::new(text.chars().filter_map(Laser::from_letter))
    }

    /// The lasers in the order in which their fields follow one another.
    pub fn lasers(&self) -> &[Laser] {
        &self.lasers[..self.count]
    }
}

impl fmt::Display for Sequence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.lasers().iter().try_for_each(|laser| f.write_char(laser.letter()))
    }
}

/// What a box is built for. No program and no host can go beyond it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Greatest optical power of each laser, microwatts.
    pub power_uw: [u32; 3],
    /// Longest heartbeat timeout, microseconds.
    pub timeout_us: u32,
    /// Longest single lit window, microseconds.
    pub lit_us: u32,
    /// By how much a gate may switch later than it should, microseconds.
    pub jitter_us: u32,
    /// Whether it has an input for the panel's sync output.
    pub sync_input: bool,
}

/// The edges on the sync wire since the box booted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SyncSeen {
    /// How many; it wraps round.
    pub count: u32,
    /// When the last one came, by the box's clock; none before the first.
    pub t_last: Option<TimeUs>,
}

/// How a box is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct State {
    /// Whether it may light lasers.
    pub armed: bool,
    /// Why it was dark last.
    pub reason: DarkReason,
    /// The laser that is lit.
    pub lit: Option<Laser>,
    /// Whether its interlock is closed, so that it may be armed.
    pub interlock_closed: bool,
    /// What it saw on the sync wire.
    pub sync: SyncSeen,
}

macro_rules! dark_reasons {
    ($($variant:ident, $name:literal, $meaning:literal;)*) => {
        /// Why lasers are dark: a box's reasons and its host's.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum DarkReason {
            $(#[doc = $meaning] $variant,)*
        }

        impl DarkReason {
            /// Every reason, in the order in which they are counted.
            pub const ALL: [Self; [$($name),*].len()] = [$(Self::$variant),*];

            /// The name in files, logs and on the line.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }

            /// What it means for a person at the bench, and what to look at.
            pub const fn meaning(self) -> &'static str {
                match self {
                    $(Self::$variant => $meaning,)*
                }
            }
        }
    };
}

dark_reasons! {
    Boot, "boot", "the box has just booted or reset itself";
    Heartbeat, "heartbeat", "the box heard nothing from holod for its timeout";
    SyncLost, "sync-lost", "the box heard of no colour frame's start for two of them: check the sync cable where there is one; else the machine, the panel's reports or the line to the box are late";
    SyncRate, "sync-rate", "a colour frame began much earlier than the panel's rate allows: check the panel's mode, and the sync cable where there is one";
    Interlock, "interlock", "the box's interlock is open";
    Line, "line", "the box was sent a line that it does not understand: check the cable";
    HangUp, "hang-up", "the line to the box was closed";
    MissingReport, "missing-report", "the panel reported no refresh in time";
    Late, "late", "the report of a field, or the order to light it, came when it had gone by: the machine, the panel's reports or the line to the box are too slow";
    Untrusted, "untrusted", "the panel's reports contradict each other, or their times are guesses";
    WrongColour, "wrong-colour", "the panel reported a field that its colour frame does not have";
    Flat, "flat", "the flat pattern is on the panel";
    Stall, "stall", "no new frame came for too long";
    BoxFault, "box-fault", "the box reported a fault or does not answer: check its cable and power";
    ClockUnsure, "clock-unsure", "how the box's clock goes with the computer's is not known well enough for the window";
    SyncDisagrees, "sync-disagrees", "the edges on the box's sync wire are not those of the frames that holod knows of";
    PanelLost, "panel-lost", "the panel is gone";
    Balance, "balance", "another colour has been lit for less time";
    NoPicture, "no-picture", "the live feed has given no new picture for the time of --feed-dark-after";
    Sleep, "sleep", "the machine is about to sleep, or has just woken";
    Unattended, "unattended", "holod's control thread stood still for 5 s and obeyed no signal meanwhile; where it still does, end holod with SIGKILL";
    Shutdown, "shutdown", "an orderly end";
    Panic, "panic", "a thread of holod failed";
    Asked, "asked", "as asked";
    ByHand, "by-hand", "somebody put the lasers out with `holod dark`: restart holod to light them again";
}

impl DarkReason {
    /// The reason called `name`.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|reason| reason.name() == name)
    }

    /// Whether a field that is dark for this reason must have been dark from its first moment on.
    pub const fn forbids_light(self) -> bool {
        matches!(self, Self::Untrusted | Self::WrongColour)
    }

    /// Whether a box goes dark for it by itself, without being told by its host.
    pub const fn is_of_box(self) -> bool {
        matches!(self, Self::Heartbeat | Self::SyncLost | Self::SyncRate | Self::Interlock | Self::Line | Self::HangUp)
    }
}

impl fmt::Display for DarkReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
