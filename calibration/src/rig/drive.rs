//! How a panel is driven: which levels it has, how they travel on the video link, and what becomes of a phase that none
//! of them gives.

/// A level of the panel and the phase that it gives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LevelPhase {
    /// The level, below 2^bit_depth.
    pub level: u16,
    /// Its phase in radians, with the panel's sign. Whole turns do not matter, but a table that rises or falls
    /// throughout is taken as unwrapped.
    pub phase_rad: f64,
}

/// Where the bits of a level travel on the video link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Packing {
    /// Eight bits. A video frame that carries one field repeats the level in red, green and blue; one that carries
    /// three has a field in each.
    Gray,
    /// Ten bits, likewise, on a link that has ten in each channel.
    Gray10,
    /// Ten bits, of Meadowlark's HDMI panels: the eight high ones in red, the two low ones in the low bits of blue.
    Red8Blue2,
    /// Ten bits, of Santec's SLM-200 and SLM-300 in DVI mode: three in the high bits of red, three of green, four of
    /// blue, highest first. The 120 Hz models show the low bits in the second half of the refresh: they repeat the high
    /// ones, so that the level stays.
    Red3Green3Blue4,
    /// Sixteen bits: the high byte in red, the low one in green.
    Red8Green8,
}

impl Packing {
    /// Every packing, in the order in which messages list them.
    pub const ALL: [Self; 5] = [Self::Gray, Self::Gray10, Self::Red8Blue2, Self::Red3Green3Blue4, Self::Red8Green8];

    /// The packing's name in a rig file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Gray => "gray",
            Self::Gray10 => "gray10",
            Self::Red8Blue2 => "red8-blue2",
            Self::Red3Green3Blue4 => "red3-green3-blue4",
            Self::Red8Green8 => "red8-green8",
        }
    }

    /// Bits of the levels that it carries.
    pub const fn bit_depth(self) -> u8 {
        match self {
            Self::Gray => 8,
            Self::Gray10 | Self::Red8Blue2 | Self::Red3Green3Blue4 => 10,
            Self::Red8Green8 => 16,
        }
    }

    /// Bits that the link must have in each of red, green and blue.
    pub const fn channel_bits(self) -> u8 {
        match self {
            Self::Gray10 => 10,
            _ => 8,
        }
    }

    /// Whether a single channel carries a whole level, so that the three can carry three fields.
    pub const fn fits_a_channel(self) -> bool {
        self.bit_depth() == self.channel_bits()
    }
}

/// How patterns lie on the panel, so that the eye sees pictures upright behind the relays and mirrors of a bench.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Orientation {
    /// Row 0 of the picture is row 0 of the panel, column 0 its column 0.
    #[default]
    Normal,
    /// Turned by half a turn, as behind a relay of two lenses.
    HalfTurn,
    /// Mirrored left to right.
    MirrorX,
    /// Mirrored top to bottom.
    MirrorY,
}

impl Orientation {
    /// Every orientation, in the order in which messages list them.
    pub const ALL: [Self; 4] = [Self::Normal, Self::HalfTurn, Self::MirrorX, Self::MirrorY];

    /// The name in a rig file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::HalfTurn => "half-turn",
            Self::MirrorX => "mirror-x",
            Self::MirrorY => "mirror-y",
        }
    }

    /// Whether columns run the other way, and whether rows do.
    pub const fn mirrors(self) -> [bool; 2] {
        [matches!(self, Self::HalfTurn | Self::MirrorX), matches!(self, Self::HalfTurn | Self::MirrorY)]
    }
}

/// What becomes of a phase in the gap that a stroke under 2π leaves on the circle.
///
/// The gap lies between the phase of the highest level and that of the lowest one, a whole turn further. A phase within
/// half a step of either goes to it in any case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OutOfStroke {
    /// It goes to the end of the gap that is nearer on the circle: the smallest error for each pixel.
    #[default]
    Nearest,
    /// It stays at the far end of the stroke: a blaze keeps its slope and gets a plateau.
    Clip,
    /// It goes to the beginning of the stroke: a blaze loses its tips.
    Zero,
    /// All phases are multiplied by stroke/2π: a blaze keeps its shape and gets too shallow, and light stays in the
    /// zero order.
    Scale,
}

impl OutOfStroke {
    /// Every way, in the order in which messages list them.
    pub const ALL: [Self; 4] = [Self::Nearest, Self::Clip, Self::Zero, Self::Scale];

    /// The name in a rig file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Nearest => "nearest",
            Self::Clip => "clip",
            Self::Zero => "zero",
            Self::Scale => "scale",
        }
    }

    /// What it does, for a person.
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::Nearest => "go to the nearer end of the stroke",
            Self::Clip => "stay at the stroke's far end",
            Self::Zero => "go to the stroke's beginning",
            Self::Scale => "are avoided: every phase is scaled down to the stroke",
        }
    }
}
