//! The rig: everything that is true of one bench, as one validated value.

use std::path::PathBuf;

use crate::{Colour, DisplayGeometry, Metres, PerColour, PupilDiameter, Resolution, TimeNs};

/// One bench.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    /// A name for logs and reports.
    pub name: String,
    /// The spatial light modulator.
    pub panel: Panel,
    /// Wavelengths, eyepiece and depth range, with the panel's resolution and pitch.
    pub geometry: DisplayGeometry,
    /// The light sources.
    pub lasers: Lasers,
    /// The eye tracker and what to do without it.
    pub tracker: Tracker,
    /// The network's weights.
    pub model: Model,
}

/// The phase panel as a display.
#[derive(Clone, Debug, PartialEq)]
pub struct Panel {
    /// Colour frames a second in channel-packed mode; fields a second in field-sequential mode.
    pub refresh_hz: f64,
    /// How three colour fields reach the panel.
    pub mode: PanelMode,
    /// The order in which the panel shows the colours.
    pub field_order: [Colour; 3],
    /// Bits of one level, 8 or 10.
    pub bit_depth: u8,
    /// Whether a higher level retards or advances the phase.
    pub phase_sign: PhaseSign,
    /// Phase at the top level of each colour, radians; 2π where a pattern can be shown without loss.
    pub stroke_rad: PerColour<f64>,
    /// Phase in radians at each level (2^bit_depth entries, monotonic), where it was measured; else it is linear.
    pub lut_rad: PerColour<Option<Vec<f64>>>,
    /// Phase in radians to add at each panel pixel, row-major, to flatten the panel.
    pub flatness_rad: PerColour<Option<Vec<f32>>>,
    /// Time from the panel's update to a settled phase.
    pub settle: TimeNs,
}

/// How the three colour fields of a frame are carried to the panel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PanelMode {
    /// In the R, G and B channels of one video frame; the panel's sequencer shows them one after another.
    ChannelPacked,
    /// Each field is a video frame of its own.
    FieldSequential,
}

/// Sign of d(phase)/d(level).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PhaseSign {
    /// A higher level is a larger phase.
    Positive,
    /// A higher level is a smaller phase.
    Negative,
}

/// The laser box and its timing.
#[derive(Clone, Debug, PartialEq)]
pub struct Lasers {
    /// What drives the lasers.
    pub driver: LaserDriver,
    /// Optical power of each colour while it is lit, milliwatts at the panel.
    pub power_mw: PerColour<f64>,
    /// From the field's settled phase to the laser's on edge.
    pub on_delay: TimeNs,
    /// Length of the lit window within a field.
    pub width: TimeNs,
    /// The box goes dark by itself when it has heard nothing for this long.
    pub heartbeat_timeout: TimeNs,
}

/// Which laser box is on the bench.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LaserDriver {
    /// No box: a simulated laser that logs its edges.
    Simulated,
    /// A microcontroller that speaks holod's laser protocol on a serial port.
    Serial {
        /// The port, for example `/dev/holod-lasers`.
        path: PathBuf,
    },
}

/// The eye tracker.
#[derive(Clone, Debug, PartialEq)]
pub struct Tracker {
    /// Tracker spec as on the command line, where the rig names one.
    pub spec: Option<String>,
    /// Which eye looks into the display.
    pub eye: Eye,
    /// Factor from the tracker's figure to millimetres.
    pub scale: f64,
    /// The diameter to slide to when the tracker has been lost for long.
    pub fallback: PupilDiameter,
    /// How long the last good value is held before the slide begins.
    pub hold: TimeNs,
}

/// Which eye's samples drive the display.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Eye {
    /// The viewer's left eye.
    Left,
    /// The viewer's right eye.
    Right,
    /// The mean of whichever eyes are valid.
    Both,
}

/// The network.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Weights file; the built-in weights where absent.
    pub weights: Option<PathBuf>,
    /// Run weights that were trained for other optics.
    pub allow_optics_mismatch: bool,
}

impl Default for Rig {
    /// The built-in bench: [`DisplayGeometry::DEFAULT`], channel-packed at 60 Hz, 8 bits, 2π stroke, simulated lasers.
    fn default() -> Self {
        Self {
            name: "built-in bench".into(),
            panel: Panel {
                refresh_hz: 60.0,
                mode: PanelMode::ChannelPacked,
                field_order: Colour::ALL,
                bit_depth: 8,
                phase_sign: PhaseSign::Positive,
                stroke_rad: PerColour([std::f64::consts::TAU * 255.0 / 256.0; 3]),
                lut_rad: PerColour([None, None, None]),
                flatness_rad: PerColour([None, None, None]),
                settle: TimeNs(2_000_000),
            },
            geometry: DisplayGeometry::DEFAULT,
            lasers: Lasers {
                driver: LaserDriver::Simulated,
                power_mw: PerColour([1.0; 3]),
                on_delay: TimeNs(100_000),
                width: TimeNs(3_000_000),
                heartbeat_timeout: TimeNs(100_000_000),
            },
            tracker: Tracker {
                spec: None,
                eye: Eye::Both,
                scale: 1.0,
                fallback: PupilDiameter::from_mm(3.0),
                hold: TimeNs(1_000_000_000),
            },
            model: Model { weights: None, allow_optics_mismatch: false },
        }
    }
}

impl Panel {
    /// Time for which one colour field is on the panel.
    pub fn field_period(&self) -> TimeNs {
        let fields_per_refresh = match self.mode {
            PanelMode::ChannelPacked => 3.0,
            PanelMode::FieldSequential => 1.0,
        };
        TimeNs::from_seconds(1.0 / (self.refresh_hz * fields_per_refresh))
    }
}

impl Rig {
    /// Panel pixels.
    pub fn resolution(&self) -> Resolution {
        self.geometry.resolution
    }

    /// Distance between the centres of neighbouring panel pixels.
    pub fn pixel_pitch(&self) -> Metres {
        self.geometry.pixel_pitch
    }
}
