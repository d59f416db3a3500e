//! The rig: everything that is true of one bench, as one validated value.

mod differences;
mod drive;
mod error;
mod files;
mod flatness;
mod lut;
mod meaning;
mod parse;
mod profile;
mod reader;
mod text_laser;

use std::path::{Path, PathBuf};

pub use drive::{LevelPhase, Orientation, OutOfStroke, Packing};
pub use error::RigError;
pub use meaning::{ActiveFile, BlurMeaning, FieldMeaning, LaserMeaning, Meaning, PerColourFigures, TrackerMeaning};
pub use parse::{DEPTH_DPT, FOCAL_LENGTH, PITCH, WAVELENGTH};
pub use profile::PanelProfile;
pub use reader::Span;
pub use text_laser::{Expected, Question, TextLaserProfile};

use serde::{Deserialize, Serialize};

use crate::toml_reader::Fault;
use crate::{Colour, DisplayGeometry, Metres, PerColour, PupilDiameter, Resolution, TimeNs};

/// Reads the `tracker.spec` of a rig file that lies in a folder, where relative paths start: gives it as it is meant, or
/// what is wrong with it, as faults whose key and line are not filled in.
pub type SpecReader<'a> = &'a dyn Fn(&str, &Path) -> Result<String, Vec<Fault>>;

/// One bench, as a rig file describes it or as it is built in.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    /// A name for logs and reports.
    pub name: String,
    /// The spatial light modulator.
    pub panel: Panel,
    /// Wavelengths, eyepiece and depth range, with the panel's resolution and pitch.
    pub geometry: DisplayGeometry,
    /// Size of the panel's image, which the relay puts into the eyepiece's front focal plane, over that of the panel.
    /// The geometry has it: [`DisplayGeometry::eyepiece_focal_length`].
    pub relay_magnification: f64,
    /// The lasers, their powers, and when within a field they are lit.
    pub lasers: Lasers,
    /// The eye tracker and what to do without it.
    pub tracker: Tracker,
    /// The network, and the GPU that computes with it.
    pub model: Model,
    /// Where all this was read.
    pub provenance: Provenance,
}

/// Where a rig's figures come from, for logs and reports.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Provenance {
    /// The rig file as it was named; empty for the built-in rig.
    pub origin: String,
    /// FNV-1a hash of the rig file's text; none of the built-in rig.
    pub text_hash: Option<u64>,
    /// The panel profile that the rig file names.
    pub panel_profile: Option<&'static str>,
    /// The file behind each table of [`Panel::lut`].
    pub lut_files: PerColour<Option<TableFile>>,
    /// The file behind each picture of [`Panel::flatness_rad`].
    pub flatness_files: PerColour<Option<TableFile>>,
    /// The file behind the profile of lasers that take commands in text.
    pub laser_profile_file: Option<PathBuf>,
}

/// A file of measurements that a rig file names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TableFile {
    /// Its path as it was opened: a relative one of the rig file is behind its folder.
    pub path: PathBuf,
    /// XXH3 of 64 bits of its bytes as they were read.
    pub xxh3: u64,
}

impl Provenance {
    /// [`Self::text_hash`] as reports and files state it.
    pub fn hash_text(&self) -> Option<String> {
        self.text_hash.map(|hash| format!("{hash:016x}"))
    }
}

/// A panel's rate may be off the rig's by this share: beyond, its fields are not as long as the rig says.
pub const RATE_TOLERANCE: f64 = 0.005;
/// The report of a refresh may lie off the panel's rhythm by this much whatever the rig says: display controllers stamp
/// to the microsecond, and rounding to whole scan lines is below it. So may the rhythm itself, as it was learned.
pub const REPORT_TOLERANCE_MIN: TimeNs = TimeNs(20_000);

/// The phase panel as a display.
#[derive(Clone, Debug, PartialEq)]
pub struct Panel {
    /// Video frames a second: colour frames in channel-packed mode, single fields in the other modes.
    pub refresh_hz: f64,
    /// How three colour fields reach the panel.
    pub mode: PanelMode,
    /// The order in which the panel shows the colours.
    pub field_order: [Colour; 3],
    /// The order in which it shows the video's channels, in channel-packed mode.
    pub channel_order: [Colour; 3],
    /// Video frames in a row that show one colour's pattern in field-sequential mode; 1 in the other modes.
    pub frames_per_colour: u8,
    /// Bits of one level: 8, 10 or 16.
    pub bit_depth: u8,
    /// Where these bits travel on the video link.
    pub packing: Packing,
    /// What the video frame has around the panel's own pixels.
    pub video_margins: VideoMargins,
    /// How patterns lie on it; look-up tables and flatness are the panel's own and stay.
    pub orientation: Orientation,
    /// Whether a higher level retards or advances the phase.
    pub phase_sign: PhaseSign,
    /// Phase at the top level of each colour, radians; 2π where a pattern can be shown without loss.
    pub stroke_rad: PerColour<f64>,
    /// What becomes of a phase that a stroke under 2π cannot show.
    pub out_of_stroke: OutOfStroke,
    /// The levels that may be used and their phases, where they were measured; else every level is used and phase is
    /// linear in it. Levels rise. Where all 2^bit_depth are there, the phase rises where `phase_sign` is positive and
    /// falls where it is negative.
    pub lut: PerColour<Option<Vec<LevelPhase>>>,
    /// Phase in radians to add at each panel pixel, row-major, to flatten the panel.
    pub flatness_rad: PerColour<Option<Vec<f32>>>,
    /// Time from the panel's update to a settled phase.
    pub settle: TimeNs,
    /// Time from the display's refresh, as the display reports it, to the panel's update with that refresh's video.
    pub latency: TimeNs,
}

/// Columns and rows of a video frame around the panel's own pixels, for panels that take a larger frame than they show.
/// They carry level 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct VideoMargins {
    /// Columns before the panel's first one.
    pub left: usize,
    /// Columns behind its last one.
    pub right: usize,
    /// Rows above its first one.
    pub top: usize,
    /// Rows below its last one.
    pub bottom: usize,
}

impl VideoMargins {
    /// The video frame's size, around a panel of `resolution`.
    pub const fn around(self, resolution: Resolution) -> Resolution {
        Resolution {
            width: self.left + resolution.width + self.right,
            height: self.top + resolution.height + self.bottom,
        }
    }
}

/// How the three colour fields of a frame are carried to the panel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PanelMode {
    /// In the R, G and B channels of one video frame; the panel's sequencer shows them one after another.
    ChannelPacked,
    /// Each field is a video frame of its own, or several in a row ([`Panel::frames_per_colour`]).
    FieldSequential,
    /// Every video frame shows the pattern of this one colour, for alignment.
    Monochrome(Colour),
}

/// Whether the phase that the panel gives rises or falls with the level: the sign of d(phase)/d(level).
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
    /// Greatest optical power that this bench allows each colour, milliwatts at the panel; not less than `power_mw`.
    /// Where the rig says none, [`Lasers::POWER_MAX_MW`] holds.
    pub power_limit_mw: PerColour<Option<f64>>,
    /// Greatest power that each laser may be told, milliwatts at the laser itself, where the rig says one. One that
    /// loses power on the way to the panel always has it, since it is told more than [`Lasers::power_limit_mw`] bounds.
    pub head_limit_mw: PerColour<Option<f64>>,
    /// From the field's settled phase to the laser's on edge; 0 for lasers that are on while armed, whatever the rig says.
    pub on_delay: TimeNs,
    /// Length of the lit window within a field, or of what is counted of it.
    pub width: TimeNs,
    /// The box goes dark by itself when it has heard nothing for this long.
    pub heartbeat_timeout: TimeNs,
    /// Lasers go dark when one hologram has stayed on the panel for this long without a newer one; where nothing is
    /// said, after some times the frame time that is measured at the start.
    pub stall_timeout: Option<TimeNs>,
    /// The panel's own hardware gates each laser to its own field, so that a box that cannot may have all of them on; in
    /// channel-packed mode, whose fields the panel itself knows.
    pub gated_by_panel: bool,
    /// Whoever wrote the rig file knows that these lasers stay lit when holod dies.
    pub accept_no_heartbeat: bool,
}

/// Which laser box is on the bench.
#[derive(Clone, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum LaserDriver {
    /// No box: a simulated laser that logs its edges.
    Simulated,
    /// A microcontroller that speaks holod's laser protocol on a serial port.
    Serial {
        /// The port, for example `/dev/holod-lasers`.
        path: PathBuf,
        /// The panel's sync output is wired to the box.
        sync_wire: bool,
    },
    /// FISBA READYBeam: power and on or off only, and it stays lit when holod dies.
    ReadyBeam {
        path: PathBuf,
        /// Optical power of each colour at the panel when the box is set to 100 %, milliwatts, rounded to microwatts.
        full_power_uw: PerColour<u32>,
    },
    /// Lasers that take commands in text, one to a port; they stay lit when holod dies.
    Text {
        /// How they are spoken to.
        profile: Box<TextLaserProfile>,
        /// The port of each colour that has a laser.
        paths: PerColour<Option<PathBuf>>,
        /// The share of a laser's power that gets to the panel, billionths.
        transmission_ppb: PerColour<u32>,
    },
}

impl Lasers {
    /// The greatest power that a rig may name, milliwatts at the panel.
    pub const POWER_MAX_MW: f64 = 500.0;

    /// A power in the whole microwatts that lasers are told, never more than it is.
    pub fn whole_uw(power_mw: f64) -> u32 {
        // The product of a figure that is whole may be a little less.
        (power_mw * 1e3 + 1e-6) as u32
    }

    /// The power that no colour exceeds, milliwatts at the panel: the rig's limit, or what holds without one.
    pub fn greatest_power_mw(&self) -> PerColour<f64> {
        self.power_limit_mw.map(|limit_mw| limit_mw.unwrap_or(Self::POWER_MAX_MW))
    }

    /// The power in microwatts that no laser is told more than, of those that are told their own power
    /// ([`LaserDriver::head_power_uw`]): the rig's limit, or without one that at the panel.
    pub fn greatest_head_uw(&self) -> PerColour<u64> {
        let at_panel_mw = self.greatest_power_mw();
        PerColour(
            Colour::ALL
                .map(|colour| u64::from(Self::whole_uw(self.head_limit_mw[colour].unwrap_or(at_panel_mw[colour])))),
        )
    }
}

impl LaserDriver {
    /// The driver's name in a rig file.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Simulated => "simulated",
            Self::Serial { .. } => "serial",
            Self::ReadyBeam { .. } => "ready-beam",
            Self::Text { .. } => "text",
        }
    }

    /// Whether it has a laser of `colour`.
    pub const fn has(&self, colour: Colour) -> bool {
        match self {
            Self::Text { paths, .. } => paths.0[colour.index()].is_some(),
            _ => true,
        }
    }

    /// Whether its lasers are lit for single fields; others are on while they are armed.
    pub const fn gates_fields(&self) -> bool {
        matches!(self, Self::Simulated | Self::Serial { .. })
    }

    /// The power in microwatts that a laser is told so that `power_uw` of it get to the panel, never more; nothing of
    /// drivers that are told the power at the panel.
    pub fn head_power_uw(&self, colour: Colour, power_uw: u32) -> Option<u64> {
        match self {
            Self::Text { transmission_ppb, .. } => {
                Some(u64::from(power_uw) * 1_000_000_000 / u64::from(transmission_ppb[colour].max(1)))
            }
            _ => None,
        }
    }

    /// The ports that it uses.
    pub fn paths(&self) -> Vec<&Path> {
        match self {
            Self::Simulated => Vec::new(),
            Self::Serial { path, .. } | Self::ReadyBeam { path, .. } => vec![path],
            Self::Text { paths, .. } => paths.0.iter().flatten().map(PathBuf::as_path).collect(),
        }
    }

    /// Whether its lasers go dark by themselves when holod dies.
    pub const fn has_heartbeat(&self) -> bool {
        matches!(self, Self::Simulated | Self::Serial { .. })
    }
}

/// `[tracker]`: where pupil diameters come from, and what holds without them.
#[derive(Clone, Debug, PartialEq)]
pub struct Tracker {
    /// Tracker spec as on the command line, where the rig names one.
    pub spec: Option<String>,
    /// Which eye looks into the display.
    pub eye: Eye,
    /// Factor from the tracker's figure to millimetres, where the rig names one; a tracker that gives millimetres needs
    /// none.
    pub scale: Option<f64>,
    /// The diameter to slide to when the tracker has been lost for long.
    pub fallback: PupilDiameter,
    /// How long the last good value is held before the slide begins.
    pub hold: TimeNs,
}

/// Which eye's samples drive the display.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Eye {
    /// The viewer's left eye.
    Left,
    /// The viewer's right eye.
    Right,
    /// The mean of whichever eyes are valid.
    Both,
    /// The eye of which the tracker is surer.
    Better,
}

/// `[model]`: what computes the holograms, and how far the pupil moves before the next one.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Which network computes the holograms.
    pub weights: WeightsChoice,
    /// The GPU that computes them, by a part of its name or its place on the PCI bus; the best one where none is named.
    pub gpu: Option<String>,
    /// [`Rig::pupil_step`], where the rig says one.
    pub pupil_step: Option<Metres>,
}

/// A network's weights by name or by file.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub enum WeightsChoice {
    /// The built-in network of the best quality.
    #[default]
    Standard,
    /// The built-in network of little more than a third of the operations.
    Small,
    /// The built-in network for processors: less than a sixth of the operations.
    Fast,
    /// A file that the trainer exported.
    File(PathBuf),
}

impl Eye {
    /// Every choice, by its name in a rig file and on the command line.
    pub const NAMES: [(&'static str, Self); 4] =
        [("left", Self::Left), ("right", Self::Right), ("both", Self::Both), ("better", Self::Better)];

    /// Its name in a rig file and on the command line.
    pub fn name(self) -> &'static str {
        Self::NAMES.into_iter().find(|(_, eye)| *eye == self).map_or("", |(name, _)| name)
    }
}

impl WeightsChoice {
    /// The names of the built-in networks in a rig file and on the command line.
    pub const BUILT_IN: [(&'static str, Self); 3] =
        [("standard", Self::Standard), ("small", Self::Small), ("fast", Self::Fast)];

    /// The name of a built-in one.
    pub fn built_in_name(&self) -> Option<&'static str> {
        Self::BUILT_IN.into_iter().find_map(|(name, choice)| (choice == *self).then_some(name))
    }
}

/// What an eye of normal acuity resolves: one minute of arc, in radians.
const ACUITY_RAD: f64 = std::f64::consts::PI / (180.0 * 60.0);

impl Rig {
    /// Holograms are made for another pupil when the estimate lies farther than this from the one that they were last
    /// made for: by as much as changes the blur between the two ends of the depth range by what an eye resolves, where
    /// the rig says nothing else. With 0 each is made for its own estimate.
    pub fn pupil_step(&self) -> Metres {
        self.model.pupil_step.unwrap_or_else(|| self.geometry.pupil_step_of_blur(ACUITY_RAD))
    }
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
                channel_order: Colour::ALL,
                frames_per_colour: 1,
                bit_depth: 8,
                packing: Packing::Gray,
                video_margins: VideoMargins::default(),
                orientation: Orientation::Normal,
                phase_sign: PhaseSign::Positive,
                stroke_rad: PerColour([std::f64::consts::TAU * 255.0 / 256.0; 3]),
                out_of_stroke: OutOfStroke::Nearest,
                lut: PerColour([None, None, None]),
                flatness_rad: PerColour([None, None, None]),
                settle: TimeNs(2_000_000),
                latency: TimeNs(0),
            },
            geometry: DisplayGeometry::DEFAULT,
            relay_magnification: 1.0,
            lasers: Lasers {
                driver: LaserDriver::Simulated,
                power_mw: PerColour([1.0; 3]),
                power_limit_mw: PerColour([None; 3]),
                head_limit_mw: PerColour([None; 3]),
                on_delay: TimeNs(100_000),
                width: TimeNs(3_000_000),
                heartbeat_timeout: TimeNs(100_000_000),
                stall_timeout: None,
                gated_by_panel: false,
                accept_no_heartbeat: false,
            },
            tracker: Tracker {
                spec: None,
                eye: Eye::Both,
                scale: None,
                fallback: PupilDiameter::from_mm(3.0),
                hold: TimeNs(1_000_000_000),
            },
            model: Model { weights: WeightsChoice::Standard, gpu: None, pupil_step: None },
            provenance: Provenance::default(),
        }
    }
}

impl PanelMode {
    /// The mode's name in a rig file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ChannelPacked => "channel-packed",
            Self::FieldSequential => "field-sequential",
            Self::Monochrome(_) => "monochrome",
        }
    }

    /// Colour fields that the panel shows in one video frame.
    pub const fn fields_per_refresh(self) -> f64 {
        match self {
            Self::ChannelPacked => 3.0,
            Self::FieldSequential | Self::Monochrome(_) => 1.0,
        }
    }

    /// What a laser's window leaves free at the end of its field, which lasts `field_period`: what the fields may be
    /// shorter than the rig's since the report that it follows, and what that report and the panel's rhythm may be off.
    pub fn window_slack(self, field_period: TimeNs) -> TimeNs {
        let drift_ns = self.fields_per_refresh() * field_period.0 as f64 * RATE_TOLERANCE;
        TimeNs(drift_ns.ceil() as i64 + 2 * REPORT_TOLERANCE_MIN.0)
    }
}

impl Panel {
    /// Colour fields from the start of one colour frame to the start of the next.
    pub fn fields(&self) -> usize {
        match self.mode {
            PanelMode::ChannelPacked => self.field_order.len(),
            PanelMode::FieldSequential => self.field_order.len() * usize::from(self.frames_per_colour),
            PanelMode::Monochrome(_) => 1,
        }
    }

    /// The colour of a field, counted from the start of a colour frame; fields beyond its end begin anew.
    pub fn colour_of_field(&self, field: usize) -> Colour {
        match self.mode {
            PanelMode::ChannelPacked => self.field_order[field % 3],
            PanelMode::FieldSequential => self.field_order[field / usize::from(self.frames_per_colour.max(1)) % 3],
            PanelMode::Monochrome(colour) => colour,
        }
    }

    /// Time for which one colour field is on the panel.
    pub fn field_period(&self) -> TimeNs {
        TimeNs::from_seconds(1.0 / (self.refresh_hz * self.mode.fields_per_refresh()))
    }
}

/// Leaves a tracker's spec to whoever opens the tracker.
const AS_WRITTEN: SpecReader<'_> = &|spec, _| Ok(spec.to_owned());

impl Tracker {
    /// Says what is wrong with a factor from the tracker's figure to millimetres, where a rig file's `scale_mm_per_unit`
    /// could not be it: what is expected, and what to do.
    pub fn scale_fault(scale: f64) -> Option<String> {
        parse::SCALE.fault(scale)
    }
}

impl Rig {
    /// The built-in bench as a rig file; it parses to [`Rig::default`].
    pub const BUILT_IN_TOML: &str = include_str!("built-in.toml");

    /// Reads and validates the rig file at `path`, and the files that it names.
    ///
    /// # Errors
    /// [`RigError`] with every fault of the file: one that is missing, no file, or not UTF-8; whatever
    /// [`Rig::parse`] finds.
    pub fn load(path: &Path) -> Result<Self, RigError> {
        Self::load_with(path, AS_WRITTEN)
    }

    /// The same, with the tracker's spec as `read_spec` reads it, whose faults are faults of the file.
    ///
    /// # Errors
    /// As [`Rig::load`], and what `read_spec` finds.
    pub fn load_with(path: &Path, read_spec: SpecReader<'_>) -> Result<Self, RigError> {
        let text = files::read_text(path)
            .map_err(|fault| RigError { origin: path.display().to_string(), faults: vec![fault.of_rig_file()] })?;
        parse::parse(&text, path, read_spec)
    }

    /// The lasers of the rig file at `path`, even where something else is wrong in it or in a file that it names: that
    /// keeps no laser from being put out. None where the file does not say them right, as [`Rig::load`] then tells.
    pub fn laser_driver(path: &Path) -> Option<LaserDriver> {
        parse::laser_driver(&files::read_text(path).ok()?, path)
    }

    /// Validates a rig file's text. Relative paths in it start at the folder of `origin`, and the files there are
    /// read.
    ///
    /// # Errors
    /// [`RigError`] with every fault: no TOML, duplicate, unknown, misplaced and missing keys, wrong types, figures
    /// out of range or at odds with each other, and faulty files. Where the text is no TOML, only that is reported.
    pub fn parse(text: &str, origin: &Path) -> Result<Self, RigError> {
        parse::parse(text, origin, AS_WRITTEN)
    }

    /// What the rig's figures mean, for a person who checks a bench.
    pub fn meaning(&self) -> Meaning {
        Meaning::of(self)
    }

    /// Each colour's light relative to that at which white is white: 1, and 0 of a colour that the panel's mode never
    /// shows or whose laser is not there or has no power.
    pub fn light(&self) -> PerColour<f32> {
        PerColour(Colour::ALL.map(|colour| {
            let is_shown = !matches!(self.panel.mode, PanelMode::Monochrome(only) if only != colour);
            let is_lit = self.lasers.driver.has(colour) && self.lasers.power_mw[colour] > 0.0;
            if is_shown && is_lit { 1.0 } else { 0.0 }
        }))
    }

    /// The colour for which the stop of the 4f relay, one for all colours, is set: the longest wavelength of the lasers
    /// that are there and have power, whatever the panel's mode shows of them now; set for another one it would cut
    /// into the half band of this one. Of all wavelengths where there is no such laser.
    pub fn stop_colour(&self) -> Colour {
        let is_lit = |colour: &Colour| self.lasers.driver.has(*colour) && self.lasers.power_mw[*colour] > 0.0;
        let is_shorter = |one: &Colour, other: &Colour| {
            let [one, other] = [one, other].map(|colour| self.geometry.wavelengths[*colour].0);
            other.total_cmp(&one)
        };
        let longest_lit = Colour::ALL.into_iter().filter(is_lit).min_by(is_shorter);
        longest_lit.or(Colour::ALL.into_iter().min_by(is_shorter)).unwrap_or(Colour::Red)
    }

    /// Columns and rows of panel pixels, without the margins of the video frame.
    pub fn resolution(&self) -> Resolution {
        self.geometry.resolution
    }

    /// Distance between the centres of neighbouring panel pixels.
    pub fn pixel_pitch(&self) -> Metres {
        self.geometry.pixel_pitch
    }
}
