//! The options of `holod pattern`.

use std::f64::consts::PI;
use std::path::PathBuf;
use std::time::Duration;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Subcommand, ValueEnum};
use holod_calibration::{Colour, Metres};
use holod_slm_output::patterns::{Pattern, Profile};

use super::RigArgs;

/// What is drawn, each kind with its own figures, and where it goes `to`.
#[derive(Subcommand, Debug, Clone)]
pub enum PatternKind<To: Args> {
    /// One level everywhere, as it is: without look-up table and flatness.
    Level {
        /// The level, from 0 to the panel's top one: 255 where it has 8 bits.
        #[arg(value_name = "LEVEL")]
        level: u16,
        /// Where the pattern goes, and in which colours.
        #[command(flatten)]
        to: To,
    },
    /// Upright lines of two levels, as they are: without look-up table and flatness. The light in the first order tells
    /// the phase between the levels (`holod lut`).
    TwoLevels {
        /// The level of the first line, from 0.
        #[arg(value_name = "LEVEL")]
        first: u16,
        /// The level of the next line, from 0.
        #[arg(value_name = "LEVEL")]
        second: u16,
        /// Pixels across one line of each.
        #[arg(long, value_name = "PX", default_value_t = 32)]
        period: usize,
        /// Where the pattern goes, and in which colours.
        #[command(flatten)]
        to: To,
    },
    /// Squares of two phases: with π between them no light is left in the middle.
    Checkerboard {
        /// Pixels across two squares; 2 sends all light beyond the relay's stop.
        #[arg(long, value_name = "PX", default_value_t = 16)]
        period: usize,
        /// Difference of phase between the squares, in multiples of π.
        #[arg(long, value_name = "PI", default_value_t = 1.0)]
        depth: f64,
        /// Where the pattern goes, and in which colours.
        #[command(flatten)]
        to: To,
    },
    /// Parallel lines, which send the light to one side.
    Grating {
        /// Pixels across one line.
        #[arg(long, value_name = "PX", default_value_t = 8.0)]
        period: f64,
        /// Where the first order goes: 0 to the right, 90 up.
        #[arg(long, value_name = "DEGREES", default_value_t = 0.0, allow_negative_numbers = true)]
        angle: f64,
        /// The shape of its lines: how the phase goes within a period.
        #[arg(long, value_enum, default_value_t = ProfileArg::Blazed)]
        profile: ProfileArg,
        /// Largest less smallest phase in multiples of π; what sends most light into the first order when left out.
        #[arg(long, value_name = "PI")]
        depth: Option<f64>,
        /// Where the pattern goes, and in which colours.
        #[command(flatten)]
        to: To,
    },
    /// A lens around the optical axis.
    Lens {
        /// From the panel to the focus; negative for a lens that diverges.
        #[arg(long, value_name = "MM", allow_negative_numbers = true)]
        focal_length: f64,
        /// Its diameter; the largest that does not alias when left out.
        #[arg(long, value_name = "MM")]
        diameter: Option<f64>,
        /// Where the pattern goes, and in which colours.
        #[command(flatten)]
        to: To,
    },
    /// A grid of bright dots on black, for a camera focused at infinity: the middle one is twice as wide, one to the
    /// right of it and one two above it are left out.
    Dots {
        /// Pixels from dot to dot.
        #[arg(long, value_name = "PX", default_value_t = 60)]
        spacing: usize,
        /// A dot's diameter in pixels.
        #[arg(long, value_name = "PX", default_value_t = 16)]
        dot: usize,
        /// Where the pattern goes, and in which colours.
        #[command(flatten)]
        to: To,
    },
    /// Bright lines on black that cross at the optical axis, with a square in the upper right quarter.
    CrossHair {
        /// A line's width in pixels.
        #[arg(long, value_name = "PX", default_value_t = 6)]
        line: usize,
        /// Where the pattern goes, and in which colours.
        #[command(flatten)]
        to: To,
    },
    /// A blaze of another direction in each colour's field: shows which laser lights which field.
    FieldIdentity {
        /// From the axis to the spots, in the eyepiece's focal plane; three quarters of what passes the relay's stop
        /// when left out.
        #[arg(long, value_name = "MM")]
        radius: Option<f64>,
        /// Where the pattern goes, and in which colours.
        #[command(flatten)]
        to: To,
    },
}

impl<To: Args> PatternKind<To> {
    /// Where the pattern goes.
    pub fn target(&self) -> &To {
        match self {
            Self::Level { to, .. }
            | Self::TwoLevels { to, .. }
            | Self::Checkerboard { to, .. }
            | Self::Grating { to, .. }
            | Self::Lens { to, .. }
            | Self::Dots { to, .. }
            | Self::CrossHair { to, .. }
            | Self::FieldIdentity { to, .. } => to,
        }
    }
}

/// With millimetres and multiples of π as metres and radians.
impl<To: Args> From<&PatternKind<To>> for Pattern {
    fn from(kind: &PatternKind<To>) -> Self {
        let metres = |mm: f64| Metres(mm / 1e3);
        match *kind {
            PatternKind::Level { level, .. } => Self::Level { level },
            PatternKind::TwoLevels { first, second, period, .. } => {
                Self::TwoLevels { levels: [first, second], period_px: period }
            }
            PatternKind::Checkerboard { period, depth, .. } => {
                Self::Checkerboard { period_px: period, depth_rad: depth * PI }
            }
            PatternKind::Grating { period, angle, profile, depth, .. } => Self::Grating {
                period_px: period,
                angle_deg: angle,
                profile: profile.into(),
                depth_rad: depth.map(|depth| depth * PI),
            },
            PatternKind::Lens { focal_length, diameter, .. } => {
                Self::Lens { focal_length: metres(focal_length), diameter: diameter.map(metres) }
            }
            PatternKind::Dots { spacing, dot, .. } => Self::Dots { spacing_px: spacing, diameter_px: dot },
            PatternKind::CrossHair { line, .. } => Self::CrossHair { line_px: line },
            PatternKind::FieldIdentity { radius, .. } => Self::FieldIdentity { radius: radius.map(metres) },
        }
    }
}

/// Where a pattern is on the panel.
#[derive(Args, Debug, Clone)]
pub struct PatternPlace {
    /// Colours that have the pattern, the others are flat; all of them when left out. `holod pattern` keeps the lasers of
    /// the others dark, a run (`holod ctl pattern`) lights them.
    #[arg(long, value_parser = colour(), value_name = "COLOUR", num_args = 1.., value_delimiter = ',')]
    pub colour: Vec<Colour>,
    /// The optical axis in pixels from the panel's centre, right and up: the middle of lens, dots and cross-hair.
    #[arg(long, value_name = "X,Y", default_value = "0,0", value_parser = parse_axis, allow_hyphen_values = true)]
    pub axis: [f64; 2],
}

/// Where a pattern goes.
#[derive(Args, Debug, Clone)]
pub struct PatternTarget {
    /// The bench whose panel shows it.
    #[command(flatten)]
    pub rig: RigArgs,
    /// Its axis, and the colours that have it.
    #[command(flatten)]
    pub place: PatternPlace,
    /// PNG of what travels to the panel; where the fields travel one after another, one for each (FILE-1-red.png and
    /// so on).
    #[arg(long, value_name = "FILE.png")]
    pub out: Option<PathBuf>,
    /// Overwrite files that are there already.
    #[arg(long)]
    pub force: bool,
    /// Show it, as after `run --output`, with each field's own laser lit, of the colours that have the pattern.
    #[arg(long, value_name = "SPEC")]
    pub output: Option<String>,
    /// Show it for so long, for example 10s; until a signal comes when left out.
    #[arg(long, value_name = "TIME", value_parser = super::parse_time, requires = "output")]
    pub duration: Option<Duration>,
    /// Show it with every laser dark.
    #[arg(long, requires = "output")]
    pub dark: bool,
    /// Print what is to be seen as JSON.
    #[arg(long)]
    pub json: bool,
}

/// The shape of a grating's lines.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProfileArg {
    /// Two phases, half a period each.
    Binary,
    /// A phase that rises evenly over the period.
    Blazed,
    /// A phase that follows a sine.
    Sinusoidal,
}

impl From<ProfileArg> for Profile {
    fn from(profile: ProfileArg) -> Self {
        match profile {
            ProfileArg::Binary => Self::Binary,
            ProfileArg::Blazed => Self::Blazed,
            ProfileArg::Sinusoidal => Self::Sinusoidal,
        }
    }
}

fn colour() -> impl TypedValueParser<Value = Colour> {
    PossibleValuesParser::new(Colour::ALL.map(Colour::name)).map(|name| {
        let named = Colour::ALL.into_iter().find(|colour| colour.name() == name);
        named.expect("the parser takes these names alone")
    })
}

fn parse_axis(text: &str) -> Result<[f64; 2], String> {
    let place = |text: &str| text.trim().parse().ok().filter(|place_px: &f64| place_px.is_finite());
    let axis_px = text.split_once(',').and_then(|(x, y)| Some([place(x)?, place(y)?]));
    axis_px
        .ok_or_else(|| format!("found '{text}', expected pixels right and up from the panel's centre such as 12,-3.5"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Cli, Command};
    use clap::Parser;

    fn parsed(line: &str) -> Result<PatternKind<PatternTarget>, clap::Error> {
        let cli = Cli::try_parse_from(line.split_whitespace())?;
        let Some(Command::Pattern(kind)) = cli.command else { panic!("{line}") };
        Ok(kind)
    }

    #[test]
    fn places_and_angles_may_be_negative() {
        let PatternKind::Grating { angle, to, .. } =
            parsed("holod pattern grating --angle -30 --axis -3,4.5 --colour red,blue").unwrap()
        else {
            panic!()
        };
        assert_eq!(
            (angle, to.place.axis, to.place.colour.as_slice()),
            (-30.0, [-3.0, 4.5], &[Colour::Red, Colour::Blue][..])
        );
        let lens = Pattern::from(&parsed("holod pattern lens --focal-length -20 --diameter 2").unwrap());
        assert_eq!(lens, Pattern::Lens { focal_length: Metres(-0.02), diameter: Some(Metres(0.002)) });
    }

    #[test]
    fn what_makes_no_sense_is_refused() {
        for line in [
            "holod pattern",
            "holod pattern stripes",
            "holod pattern level",
            "holod pattern level 70000",
            "holod pattern lens",
            "holod pattern dots --axis 3",
            "holod pattern dots --axis nan,0",
            "holod pattern dots --duration 3s",
            "holod pattern dots --dark",
            "holod pattern dots --colour violet",
        ] {
            assert!(parsed(line).is_err(), "{line}");
        }
    }
}
