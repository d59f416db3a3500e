//! The command line, as clap sees it.

mod pattern;

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};
use holod_calibration::rig::{DEPTH_DPT, Eye, Tracker, WeightsChoice};
use holod_calibration::toml_reader::did_you_mean;
use holod_calibration::{Dioptres, PupilDiameter, Resolution};
use holod_model::scene::Fit;
use holod_pupil_input::UsbIds;
use serde::{Deserialize, Serialize};

pub use crate::page::PageAddress;

pub use self::pattern::{PatternKind, PatternPlace, PatternTarget, ProfileArg};

/// Drives a holographic near-eye display in real time, closed loop with an eye tracker.
///
/// With no subcommand holod runs: tracker in, holograms out. Whatever is not named is built in: a sample scene, a
/// simulated eye tracker, a headless panel and simulated lasers.
#[derive(Parser, Debug)]
#[command(name = "holod", version = env!("HOLOD_VERSION"), args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct Cli {
    /// What to do; `run` when it is left out.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// The options of `run`.
    #[command(flatten)]
    pub run: RunArgs,
}

/// What holod does, where it is not `run`.
#[derive(Subcommand, Debug)]
pub enum Command {
    /// Drive the display until told to stop.
    Run(RunArgs),
    /// Run the whole loop for some seconds on built-in inputs and write pictures of what happened.
    Demo(DemoArgs),
    /// Compute one hologram and its phase patterns.
    Render(RenderArgs),
    /// Show what an eye sees of a hologram at one focus.
    ///
    /// Colours that the rig's panel never shows, or its lasers never light, are black.
    View(ViewArgs),
    /// Say what the rig file means and whether this bench is ready.
    Check(CheckArgs),
    /// Print the drop-in for the service's unit: these options of `run`, and the devices that they and the rig name.
    Unit(UnitArgs),
    /// Time each stage and the frame, beside what the cores compute and their memory moves, and tracker sample to
    /// photons.
    Bench(BenchArgs),
    /// Judge weights by what an eye sees of the panel's levels, on held-out scenes with known thin-lens pictures.
    Evaluate(EvaluateArgs),
    /// Draw a test pattern for the panel, say what is to be seen on the bench, show it.
    #[command(subcommand)]
    Pattern(PatternKind<PatternTarget>),
    /// Make a panel's look-up table (lut_file) of powers that were measured with `holod pattern two-levels`.
    Lut(LutArgs),
    /// Say what the running daemon is doing.
    Status(StatusArgs),
    /// Change what the running daemon does: scene, weights, pupil, eye, patterns, lasers, or read the rig file again.
    Ctl(CtlArgs),
    /// Pack a record of a run with bench, scene, log and facts of this machine into one file, without names of people
    /// or machines; `holod --tracker replay:FILE` shows its frames again.
    Report(ReportArgs),
    /// List trackers, or try one out.
    #[command(subcommand)]
    Tracker(TrackerCommand),
    /// Look into logs of pupil diameters, or convert them.
    #[command(subcommand)]
    Log(LogCommand),
    /// Look at the laser box, try out that it goes dark by itself, or put the lasers out.
    #[command(subcommand)]
    Laser(LaserCommand),
    /// Put the lasers out, also while another holod has their port open.
    ///
    /// A laser box of holod's protocol stays dark until a holod is started anew, as a service that fails is by itself
    /// (`systemctl stop holod` keeps it from that). Lasers without a heartbeat (READYBeam, lasers that take commands in
    /// text) tell nobody: a holod that goes on may light them again. End it first.
    Dark(DarkArgs),
}

/// What a look-up table is made of.
#[derive(Args, Debug, Clone)]
pub struct LutArgs {
    /// CSV, a row `level,power` for each level that was measured: the power of a first order of lines of level 0 and that
    /// level, from 0 to the top level, in any unit.
    #[arg(value_name = "FILE")]
    pub powers: PathBuf,
    /// The table to write, a row `level,phase_rad` for each level of the panel; - is standard output.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Overwrite what is there already.
    #[arg(long)]
    pub force: bool,
    /// The rig: the panel's number of levels, and whether phases rise or fall (phase_sign).
    #[command(flatten)]
    pub rig: RigArgs,
    /// Print what the table says as JSON.
    #[arg(long)]
    pub json: bool,
}

/// What can be done with the laser box.
#[derive(Subcommand, Debug)]
pub enum LaserCommand {
    /// Say who the box is and how it is, without arming it.
    Status(LaserArgs),
    /// Arm the box with no laser lit, fall silent, and see that it goes dark by itself.
    Arm(LaserArgs),
    /// Put the lasers out.
    Dark(DarkArgs),
}

/// Which lasers are put out, and when.
#[derive(Args, Debug, Clone)]
pub struct DarkArgs {
    /// The box or the lasers, by rig file or port.
    #[command(flatten)]
    pub lasers: LaserArgs,
    /// For the service's `ExecStopPost=`: leave them alone after a start that failed before it opened them, since another
    /// holod may drive them.
    #[arg(long)]
    pub after_service: bool,
}

/// Where the laser box is.
#[derive(Args, Debug, Clone)]
pub struct LaserArgs {
    /// The bench whose lasers are meant.
    #[command(flatten)]
    pub rig: RigArgs,
    /// The serial port of a box that speaks holod's laser protocol, in place of a rig file.
    #[arg(long, value_name = "PATH", conflicts_with = "config")]
    pub port: Option<PathBuf>,
}

/// What can be done with trackers.
#[derive(Subcommand, Debug)]
pub enum TrackerCommand {
    /// The profiles that holod knows, and the serial ports and HID devices that are plugged in.
    List(ListArgs),
    /// Print the udev rule that lets holod open a HID device.
    Rule(RuleArgs),
    /// Read a tracker for a while: a live plot, rates, jitter, losses, and each rejection with its reason.
    Try(TryArgs),
}

/// What can be done with logs.
#[derive(Subcommand, Debug)]
pub enum LogCommand {
    /// Say what a log is: format, eyes, rate, gaps, blinks, range, units, rejected lines.
    Info(LogInfoArgs),
    /// Write a log in another format.
    Convert(LogConvertArgs),
}

/// Where the rig comes from.
#[derive(Args, Debug, Clone, Default)]
pub struct RigArgs {
    /// Rig file (TOML) of this bench; the built-in bench when left out.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
}

/// Which network computes the holograms.
#[derive(Args, Debug, Clone, Default)]
pub struct NetworkArgs {
    /// The network's weights: standard, small or fast (built in), or a file that the trainer exported (./small is a
    /// file); what the rig names when left out.
    #[arg(long, value_name = "NAME|FILE", value_parser = parse_weights)]
    pub weights: Option<WeightsChoice>,
}

pub(crate) fn parse_weights(text: &str) -> Result<WeightsChoice, String> {
    if let Some((_, choice)) = WeightsChoice::BUILT_IN.into_iter().find(|(name, _)| *name == text) {
        return Ok(choice);
    }
    // A bare word that is no file is a name that is mistyped.
    if text.contains(['/', '.']) || Path::new(text).exists() {
        return Ok(WeightsChoice::File(text.into()));
    }
    let names = WeightsChoice::BUILT_IN.map(|(name, _)| name);
    let meant = did_you_mean(text, &names).map_or(String::new(), |meant| format!("; {meant}"));
    Err(format!("found `{text}`, neither {} nor a file{meant}", names.join(" nor ")))
}

/// Where pictures with depth come from.
#[derive(Args, Debug, Clone, Default)]
pub struct SceneArgs {
    /// A scene directory with scene.toml, or COLOUR,DEPTH (or one OpenEXR file that holds both); for `run` also feed or
    /// feed:SOCKET, the pictures that other programs hand over.
    #[arg(long, value_name = "PATH")]
    pub scene: Option<String>,
    /// What the depth file's numbers are; required for COLOUR,DEPTH, while a scene.toml names its own: metres,
    /// millimetres, dioptres, or normalised_dioptres:FAR,NEAR (both in dioptres, NEAR more than FAR, which is 0 in the
    /// file; without them normalised_dioptres is over the rig's depth range).
    #[arg(long, value_name = "ENCODING")]
    pub depth_encoding: Option<String>,
    /// How a picture of another size is brought to --resolution.
    #[arg(long, value_enum, default_value_t = FitArg::Native)]
    pub fit: FitArg,
    /// Size of the hologram in panel pixels; when left out the scene's own, and for a feed the panel's.
    #[arg(long, value_name = "WxH", value_parser = parse_resolution)]
    pub resolution: Option<Resolution>,
}

/// How a picture of another size is fitted. Nothing is ever stretched.
#[derive(ValueEnum, Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum FitArg {
    /// Pixel for pixel, centred; a picture larger than the target is refused.
    #[default]
    Native,
    /// Scaled to fit inside, the rest black.
    Contain,
    /// Scaled to cover, the overhang cut off.
    Cover,
    /// Pixel for pixel, centred, the overhang cut off.
    Crop,
}

impl From<FitArg> for Fit {
    fn from(arg: FitArg) -> Self {
        match arg {
            FitArg::Native => Self::Native,
            FitArg::Contain => Self::Contain,
            FitArg::Cover => Self::Cover,
            FitArg::Crop => Self::Crop,
        }
    }
}

impl From<Fit> for FitArg {
    fn from(fit: Fit) -> Self {
        match fit {
            Fit::Native => Self::Native,
            Fit::Contain => Self::Contain,
            Fit::Cover => Self::Cover,
            Fit::Crop => Self::Crop,
        }
    }
}

/// Which engine computes the network.
#[derive(ValueEnum, Serialize, Deserialize, Debug, Clone, Copy, Default, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub enum Backend {
    /// A GPU where there is one that will do, in half precision if it multiplies matrices so; else the processor's
    /// cores, in half precision where that is faster.
    #[default]
    Auto,
    /// Native code on the processor's cores, in single precision.
    Cpu,
    /// The same with what a network's layers multiply in half precision (bfloat16, or with AVX2 integers of 16 bits),
    /// where the processor gains by that: faster, a little less exact.
    CpuHalf,
    /// A GPU by Vulkan, in single precision; where there is none, a processor that plays one, which is slow.
    Gpu,
    /// The same with a network's features in half precision, where the device has that: faster, a little less exact.
    GpuHalf,
}

impl Backend {
    /// Whether it takes a GPU, at least where there is one.
    pub fn takes_a_gpu(self) -> bool {
        !matches!(self, Self::Cpu | Self::CpuHalf)
    }
}

/// Options of `run`, and of `holod` without a subcommand.
#[derive(Args, Debug, Clone, Default)]
pub struct RunArgs {
    /// The bench that is run; the built-in one without a file.
    #[command(flatten)]
    pub rig: RigArgs,
    /// Weights in place of those that the rig names.
    #[command(flatten)]
    pub network: NetworkArgs,
    /// The eye tracker's spec.
    #[arg(
        long,
        value_name = "SPEC",
        help = "Eye tracker: /dev/ttyUSB0, serial:PATH[,profile=NAME][,baud=N], hid:VID:PID[,profile=NAME], \
                tcp:HOST:PORT,profile=NAME, udp:HOST:PORT,profile=NAME, core[:HOST], neon[:HOST], \
                replay:FILE[,speed=X|max][,loop], a log or report FILE, or mock[:SCENARIO or FILE]; `holod tracker list` names profiles"
    )]
    pub tracker: Option<String>,
    /// What is shown: files, a live feed, or the built-in scene.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// With --scene feed: put the lasers out when no new picture has come for this many seconds, until one comes; the
    /// last picture stays lit when left out.
    #[arg(long, value_name = "SECONDS", value_parser = parse_silence)]
    pub feed_dark_after: Option<Duration>,
    /// Where patterns go, by a spec; the help names those that there are.
    #[arg(
        long,
        value_name = "SPEC",
        default_value = "headless",
        help = "Where patterns go: headless (a virtual panel), drm:CONNECTOR (a graphics card's connector, without a \
                desktop), or window:MONITOR[,allow_primary] (a window that covers a monitor of the desktop)"
    )]
    pub output: String,
    /// Lasers in place of the rig's own, with --output headless: a bench's rig is rehearsed as it is, without its laser
    /// box.
    #[arg(long, value_enum, value_name = "LASERS")]
    pub lasers: Option<LasersInstead>,
    /// Engine for the network.
    #[arg(long, value_enum, default_value_t = Backend::Auto)]
    pub backend: Backend,
    /// Compute for one pupil, in millimetres, whatever the tracker says.
    #[arg(long, value_name = "MM", value_parser = parse_pupil)]
    pub pupil: Option<PupilDiameter>,
    /// Which eye looks into the display: left, right, both or better, in place of the rig's tracker.eye.
    #[arg(long, value_name = "EYE", value_parser = parse_eye)]
    pub eye: Option<Eye>,
    /// Millimetres for one unit of the tracker's figure, in place of the rig's tracker.scale_mm_per_unit.
    #[arg(long, value_name = "MM_PER_UNIT", value_parser = parse_scale)]
    pub scale: Option<f64>,
    /// Stop after this many frames.
    #[arg(long, value_name = "N", conflicts_with = "duration")]
    pub frames: Option<u64>,
    /// Stop after this long, for example 10s or 2m; a log that is replayed and ends sooner ends the run, but not one
    /// that is played by speed=max.
    #[arg(long, value_name = "TIME", value_parser = parse_time)]
    pub duration: Option<Duration>,
    /// Write frames.csv, summary.json, what the tracker sent (tracker.holodraw, samples.csv), what `holod ctl` changed
    /// (orders.jsonl), the log and the bench into this directory, for `holod report`.
    #[arg(long, value_name = "DIR")]
    pub record: Option<PathBuf>,
    /// Record as --record does, into a new directory in this one that is named after the time in UTC: one for each
    /// start, as a service wants it.
    #[arg(long, value_name = "DIR", conflicts_with = "record")]
    pub record_in: Option<PathBuf>,
    /// Overwrite an earlier record; it goes once the first frame is made.
    #[arg(long, requires = "record")]
    pub force: bool,
    /// Where the status page is served, and to whom.
    #[command(flatten)]
    pub page: PageArgs,
    /// Print the summary as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Lasers that may take the place of the rig's.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum LasersInstead {
    /// Nothing is lit; what a laser box would do is computed.
    Simulated,
}

/// Where the status page is served.
#[derive(Args, Debug, Clone, Default)]
pub struct PageArgs {
    /// Serve a status page for browsers, and figures for Prometheus: a port of this machine such as 8420, ADDRESS:PORT
    /// (with --page-token where other machines reach it), or unix:PATH.
    #[arg(long, value_name = "ADDRESS")]
    pub page: Option<PageAddress>,
    /// A file with the token that opens the page, on one line; only you may be able to read it.
    #[arg(long, value_name = "FILE", requires = "page")]
    pub page_token: Option<PathBuf>,
}

/// What `holod demo` takes; its bench is the built-in one.
#[derive(Args, Debug, Clone)]
pub struct DemoArgs {
    /// Weights in place of those of the built-in bench.
    #[command(flatten)]
    pub network: NetworkArgs,
    /// Size of the hologram in panel pixels; when left out 512x512, or what a smaller panel has.
    #[arg(long, value_name = "WxH", value_parser = parse_resolution)]
    pub resolution: Option<Resolution>,
    /// Directory for the pictures; holod-demo when left out, or holod-demo-2 and so on where that is there already.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Overwrite what is there already.
    #[arg(long, requires = "out")]
    pub force: bool,
    /// How long the loop runs.
    #[arg(long, value_name = "TIME", value_parser = parse_time, default_value = "10s")]
    pub duration: Duration,
}

/// What `holod render` takes: a bench, a picture and a pupil, and where the hologram goes.
#[derive(Args, Debug, Clone)]
pub struct RenderArgs {
    /// The bench that the hologram is made for.
    #[command(flatten)]
    pub rig: RigArgs,
    /// Weights in place of those that the rig names.
    #[command(flatten)]
    pub network: NetworkArgs,
    /// The picture that the hologram is made of.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// A directory with a stack.toml, in place of a scene: images of one scene that are focused at several depths, seen
    /// by an eye with one pupil, for the weights of a focal-stack network.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["scene", "depth_encoding", "pupil"])]
    pub focal_stack: Option<PathBuf>,
    /// Pupil diameter for which the hologram is made, in millimetres; a focal stack says its own.
    #[arg(long, value_name = "MM", value_parser = parse_pupil, required_unless_present = "focal_stack")]
    pub pupil: Option<PupilDiameter>,
    /// Engine for the network.
    #[arg(long, value_enum, default_value_t = Backend::Auto)]
    pub backend: Backend,
    /// Directory for field.safetensors, phase_{red,green,blue}.png and report.json. The PNGs are phases from 0 to 65535
    /// for 0 to 2π (65536), as the hologram has them: neither levels of the rig's panel nor turned by its orientation.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Overwrite what is there already.
    #[arg(long)]
    pub force: bool,
    /// Print the report as JSON.
    #[arg(long)]
    pub json: bool,
}

/// What `holod view` takes: a hologram or what to make one of, and the eye that looks at it.
#[derive(Args, Debug, Clone)]
pub struct ViewArgs {
    /// The bench through which the eye looks.
    #[command(flatten)]
    pub rig: RigArgs,
    /// Weights in place of those that the rig names.
    #[command(flatten)]
    pub network: NetworkArgs,
    /// A directory that `holod render` wrote, with the rig for which it did so; without a rig the panel is the built-in
    /// bench's, and pitch, wavelengths and eyepiece are those of the hologram.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["scene", "pupil", "weights", "resolution", "fit", "depth_encoding", "backend"])]
    pub hologram: Option<PathBuf>,
    /// The picture that a hologram is made of and that is looked at.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// Pupil diameter for which the hologram is made, in millimetres.
    #[arg(long, value_name = "MM", value_parser = parse_pupil)]
    pub pupil: Option<PupilDiameter>,
    /// Engine for the network.
    #[arg(long, value_enum, default_value_t = Backend::Auto)]
    pub backend: Backend,
    /// Where the eye focuses, in dioptres: 0 is infinity, 2.857 is 35 cm.
    #[arg(long, value_name = "DPT", value_parser = parse_focus, allow_negative_numbers = true)]
    pub focus: Dioptres,
    /// Diameter of the pupil that looks, in millimetres; the one that the hologram was made for when left out.
    #[arg(long, value_name = "MM", value_parser = parse_pupil)]
    pub eye_pupil: Option<PupilDiameter>,
    /// PNG to write; - is standard output.
    #[arg(long, value_name = "FILE.png")]
    pub out: PathBuf,
    /// Overwrite what is there already.
    #[arg(long)]
    pub force: bool,
    /// Print what was done as JSON.
    #[arg(long)]
    pub json: bool,
}

/// What `holod check` takes: a bench, and what of `run` is to be judged with it.
#[derive(Args, Debug, Clone)]
pub struct CheckArgs {
    /// The bench that is checked.
    #[command(flatten)]
    pub rig: RigArgs,
    /// Weights in place of those that the rig names.
    #[command(flatten)]
    pub network: NetworkArgs,
    /// Eye tracker's spec, as `run` takes it; the rig's own when left out.
    #[arg(long, value_name = "SPEC")]
    pub tracker: Option<String>,
    /// Millimetres for one unit of the tracker's figure, in place of the rig's tracker.scale_mm_per_unit.
    #[arg(long, value_name = "MM_PER_UNIT", value_parser = parse_scale)]
    pub scale: Option<f64>,
    /// Size of the hologram whose frames a second are estimated; that of the built-in scene and the panel's when left
    /// out.
    #[arg(long, value_name = "WxH", value_parser = parse_resolution)]
    pub resolution: Option<Resolution>,
    /// Engine for the network, as `run` takes it: its frames a second are estimated, and a GPU's phases and levels
    /// compared with the processor's.
    #[arg(long, value_enum, default_value_t)]
    pub backend: Backend,
    /// The panel, as `run` takes it: opened, looked at with the flat pattern on it, and closed.
    #[arg(long, value_name = "SPEC")]
    pub output: Option<String>,
    /// Judge rights and files for the service's user, holod, and not for this one.
    #[arg(long)]
    pub service: bool,
    /// Print the findings as JSON.
    #[arg(long)]
    pub json: bool,
}

/// What `holod unit` takes: what the service is to run with.
#[derive(Args, Debug, Clone)]
pub struct UnitArgs {
    /// The options of `run` with which the service is to run.
    #[command(flatten)]
    pub run: RunArgs,
}

/// What `holod bench` takes: a bench, and what is measured how often.
#[derive(Args, Debug, Clone)]
pub struct BenchArgs {
    /// The bench for whose panel and network times are measured.
    #[command(flatten)]
    pub rig: RigArgs,
    /// Weights in place of those that the rig names.
    #[command(flatten)]
    pub network: NetworkArgs,
    /// Engine for the network.
    #[arg(long, value_enum, default_value_t = Backend::Auto)]
    pub backend: Backend,
    /// Time instead what a picture of the live feed costs, of this size or 1920x1080: while its client waits (take),
    /// and then (make), beside a copy of its bytes in memory.
    #[arg(long, value_name = "WxH", value_parser = parse_resolution, num_args = 0..=1, default_missing_value = "1920x1080")]
    pub feed: Option<Resolution>,
    /// Size of the hologram, 512x512 unless the panel is smaller.
    #[arg(long, value_name = "WxH", value_parser = parse_resolution)]
    pub resolution: Option<Resolution>,
    /// Frames of which medians and quartiles are taken.
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
    /// How long the loop then runs with a simulated eye and a virtual panel, for the time from tracker sample to
    /// photons;
    /// 0s leaves it out.
    #[arg(long, value_name = "TIME", value_parser = parse_time, default_value = "5s")]
    pub duration: Duration,
    /// Print the figures as JSON.
    #[arg(long)]
    pub json: bool,
}

/// What `holod evaluate` takes: a network, and the scenes by which it is judged.
#[derive(Args, Debug, Clone)]
pub struct EvaluateArgs {
    /// The rig, whose panel the levels are for.
    #[command(flatten)]
    pub rig: RigArgs,
    /// Folder of held-out scenes, as `holod-scenes generate --kind test --pupils 1,2,3,4,5` writes them.
    #[arg(long, value_name = "DIR")]
    pub scenes: PathBuf,
    /// Folder of refocus cards, as `holod-scenes generate --kind cards` writes them.
    #[arg(long, value_name = "DIR")]
    pub cards: Option<PathBuf>,
    /// Folder of bright marks on exact black, as `holod-scenes generate --kind marks` writes them.
    #[arg(long, value_name = "DIR")]
    pub marks: Option<PathBuf>,
    /// The network to judge.
    #[command(flatten)]
    pub network: NetworkArgs,
    /// Engine for the network.
    #[arg(long, value_enum, default_value_t = Backend::Auto)]
    pub backend: Backend,
    /// Pupils to judge, in millimetres, among those of the scenes; all of these when left out.
    #[arg(long, value_name = "MM", value_parser = parse_scene_pupil, num_args = 1.., value_delimiter = ',')]
    pub pupil: Vec<PupilDiameter>,
    /// Judge only the first N scenes.
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub limit: Option<usize>,
    /// Pixels at each edge that are not judged.
    #[arg(long, value_name = "PX", default_value_t = 24)]
    pub border_px: usize,
    /// Print the evaluation as JSON.
    #[arg(long)]
    pub json: bool,
    /// Write evaluation.json and sheet.png into this directory.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Overwrite what is there already.
    #[arg(long, requires = "out")]
    pub force: bool,
}

/// What `holod ctl` takes: which holod is meant, and its order.
#[derive(Args, Debug, Clone)]
pub struct CtlArgs {
    /// Of several that run, the one of this process number.
    #[arg(long, value_name = "PID", global = true)]
    pub pid: Option<u32>,
    /// Its control socket, in place of the one that it wrote into its status.
    #[arg(long, value_name = "SOCKET", global = true, conflicts_with = "pid")]
    pub socket: Option<PathBuf>,
    /// What is to change, or what is asked.
    #[command(subcommand)]
    pub order: CtlOrder,
}

/// What can be changed in a running daemon.
#[derive(Subcommand, Debug, Clone)]
pub enum CtlOrder {
    /// Print how the run is at this moment, as JSON.
    Status,
    /// Show another scene, brought to the size of the hologram; or the live feed again.
    Scene {
        /// A scene directory with scene.toml, COLOUR,DEPTH, one OpenEXR file, or feed.
        #[arg(value_name = "PATH")]
        scene: String,
        /// What the depth file's numbers are, as `run` takes it.
        #[arg(long, value_name = "ENCODING")]
        depth_encoding: Option<String>,
        /// How a picture of another size is brought to that of the hologram.
        #[arg(long, value_enum, default_value_t = FitArg::Native)]
        fit: FitArg,
    },
    /// Compute with other weights: standard, small, fast, or a file.
    Weights {
        /// Their name or file.
        #[arg(value_name = "NAME|FILE", value_parser = parse_weights)]
        weights: WeightsChoice,
    },
    /// Let the picture stand still; the pupil is followed.
    Pause,
    /// Let it go on.
    Resume,
    /// Compute for one pupil, whatever the tracker says, or follow the tracker again.
    Pupil {
        /// Its diameter in millimetres, or follow.
        #[arg(value_name = "MM|follow", value_parser = parse_pupil_or_follow)]
        pupil: PupilOrder,
    },
    /// Follow another eye: left, right, both (their mean) or better (the one of which the tracker is surer).
    Eye {
        /// The eye that is followed from now on.
        #[arg(value_name = "EYE", value_parser = parse_eye)]
        eye: Eye,
    },
    /// Read the rig file again. What needs panel, lasers or tracker to be opened anew is refused, and nothing changes.
    Reload,
    /// Show a test pattern in place of holograms.
    #[command(subcommand)]
    Pattern(PatternKind<PatternPlace>),
    /// Show one phase everywhere in place of holograms.
    Flat,
    /// Show holograms again, after a pattern or one phase.
    Hologram,
    /// Keep the lasers dark, or let them be lit by the rules again.
    Lasers {
        /// Whether they stay dark or may be lit.
        #[arg(value_enum)]
        lasers: LasersArg,
    },
    /// End the run in order: lasers dark, flat pattern on the panel.
    Stop,
}

/// The pupil that holograms are computed for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PupilOrder {
    /// The pupil that the tracker makes of its samples.
    Follow,
    /// This diameter, whatever the tracker says.
    Fixed(PupilDiameter),
}

/// What the lasers are to do.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum LasersArg {
    /// Stay dark until `arm`, also where holod fails and is started again.
    Dark,
    /// Be lit by the rules.
    Arm,
}

fn parse_pupil_or_follow(text: &str) -> Result<PupilOrder, String> {
    if text == "follow" { Ok(PupilOrder::Follow) } else { parse_pupil(text).map(PupilOrder::Fixed) }
}

/// What `holod status` takes: which holod is meant.
#[derive(Args, Debug, Clone)]
pub struct StatusArgs {
    /// Of several that run, the one of this process number.
    #[arg(long, value_name = "PID")]
    pub pid: Option<u32>,
    /// Print the status as JSON.
    #[arg(long)]
    pub json: bool,
}

/// What `holod report` takes: a recording, or none, and the archive's place.
#[derive(Args, Debug, Clone)]
pub struct ReportArgs {
    /// What `holod run --record` wrote; without it, facts of this machine and the status of a holod that runs.
    #[arg(value_name = "DIR")]
    pub record: Option<PathBuf>,
    /// The file to write; - is standard output. holod-report-TIME.tar.gz when left out.
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Overwrite what is there already.
    #[arg(long)]
    pub force: bool,
    /// Leave out the pictures of the scene: then its frames cannot be shown again.
    #[arg(long, requires = "record")]
    pub without_scene: bool,
    /// Print what is in it as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Options of `tracker list`.
#[derive(Args, Debug, Clone)]
pub struct ListArgs {
    /// Print the list as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Options of `tracker rule`.
#[derive(Args, Debug, Clone)]
pub struct RuleArgs {
    /// USB vendor and product, hexadecimal, as lsusb shows them.
    #[arg(value_name = "VID:PID")]
    pub ids: UsbIds,
}

/// Options of `tracker try`.
#[derive(Args, Debug, Clone)]
pub struct TryArgs {
    /// The tracker, as after `--tracker`; the rig's own when left out.
    #[arg(value_name = "SPEC")]
    pub spec: Option<String>,
    /// The bench whose tracker is tried out.
    #[command(flatten)]
    pub rig: RigArgs,
    /// How long it is read, for example 10s or 2m.
    #[arg(long, value_name = "TIME", value_parser = parse_time, default_value = "10s")]
    pub duration: Duration,
    /// Millimetres for one unit of the tracker's figure, in place of the rig's tracker.scale_mm_per_unit.
    #[arg(long, value_name = "MM_PER_UNIT", value_parser = parse_scale)]
    pub scale: Option<f64>,
    /// Record the link's bytes (tracker.holodraw) and every sample (samples.csv) into this directory; `replay:` plays
    /// the first.
    #[arg(long, value_name = "DIR")]
    pub record: Option<PathBuf>,
    /// Overwrite an earlier record; it goes once something is heard.
    #[arg(long, requires = "record")]
    pub force: bool,
    /// Print what was found as JSON, and show nothing meanwhile.
    #[arg(long)]
    pub json: bool,
}

/// Options of `log info`.
#[derive(Args, Debug, Clone)]
pub struct LogInfoArgs {
    /// The log; its format is recognised by its content.
    #[arg(value_name = "FILE")]
    pub log: PathBuf,
    /// Millimetres for one unit of the log's figure, where it is not in millimetres.
    #[arg(long, value_name = "MM_PER_UNIT", value_parser = parse_scale)]
    pub scale: Option<f64>,
    /// Write a plot of raw, rejected and believed samples as SVG; - is standard output. Without millimetres it shows
    /// the raw samples in the log's own unit.
    #[arg(long, value_name = "FILE.svg")]
    pub plot: Option<PathBuf>,
    /// Overwrite the plot where it is there already.
    #[arg(long, requires = "plot")]
    pub force: bool,
    /// Print what was found as JSON.
    #[arg(long)]
    pub json: bool,
}

/// The formats that logs are written in.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogFormatArg {
    /// holod's line protocol; millimetres only.
    Lines,
    /// A table with a header, in the log's own unit.
    Csv,
}

/// Options of `log convert`.
#[derive(Args, Debug, Clone)]
pub struct LogConvertArgs {
    /// The log; its format is recognised by its content.
    #[arg(value_name = "FILE")]
    pub log: PathBuf,
    /// The format to write.
    #[arg(long, value_enum)]
    pub to: LogFormatArg,
    /// The file to write; - is standard output.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Overwrite what is there already.
    #[arg(long)]
    pub force: bool,
    /// Millimetres for one unit of the log's figure, where it is not in millimetres; for lines only.
    #[arg(long, value_name = "MM_PER_UNIT", value_parser = parse_scale)]
    pub scale: Option<f64>,
}

fn parse_eye(text: &str) -> Result<Eye, String> {
    let named = Eye::NAMES.into_iter().find(|(name, _)| *name == text);
    named.map(|(_, eye)| eye).ok_or_else(|| format!("found '{text}', expected left, right, both or better"))
}

fn parse_scale(text: &str) -> Result<f64, String> {
    let scale =
        text.parse().map_err(|_| format!("found '{text}', expected millimetres for one unit, such as 0.0125"))?;
    Tracker::scale_fault(scale).map_or(Ok(scale), |fault| Err(format!("found '{text}', {fault}")))
}

/// A time with its unit, or in seconds.
fn parse_time(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    let time = seconds.or_else(|| humantime::parse_duration(text).ok());
    time.ok_or_else(|| format!("found '{text}', expected a time such as 10s or 2m, or a number of seconds"))
}

fn parse_silence(text: &str) -> Result<Duration, String> {
    let allowed = Duration::from_millis(100)..=Duration::from_secs(3600);
    let silence = parse_time(text).ok().filter(|silence| allowed.contains(silence));
    silence.ok_or_else(|| format!("found '{text}', expected seconds without a picture, 0.1 to 3600"))
}

fn parse_count(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|&count| count > 0).ok_or_else(|| format!("found '{text}', expected a number above 0"))
}

fn parse_resolution(text: &str) -> Result<Resolution, String> {
    let wrong = || format!("found '{text}', expected WIDTHxHEIGHT in pixels such as 1920x1080");
    let (width, height) = text.split_once('x').ok_or_else(wrong)?;
    let side = |s: &str| s.parse::<usize>().map_err(|_| wrong());
    let resolution = Resolution { width: side(width)?, height: side(height)? };
    let allowed = 16..=8192;
    if allowed.contains(&resolution.width) && allowed.contains(&resolution.height) {
        Ok(resolution)
    } else {
        Err(format!("found '{text}', expected a width and a height of 16 to 8192 pixels"))
    }
}

fn parse_pupil(text: &str) -> Result<PupilDiameter, String> {
    human_pupil(parse_mm(text)?)
}

/// A pupil of scenes, which may be wider than a human one for benches of little blur.
fn parse_scene_pupil(text: &str) -> Result<PupilDiameter, String> {
    let mm = parse_mm(text)?;
    if mm > 0.0 && mm.is_finite() {
        Ok(PupilDiameter::from_mm(mm))
    } else {
        Err(format!("found {mm} mm, expected a diameter above 0 mm"))
    }
}

fn parse_mm(text: &str) -> Result<f32, String> {
    text.parse().map_err(|_| format!("found '{text}', expected a diameter in millimetres such as 3.5"))
}

/// A pupil that a human eye can have; what is outside is most often another unit.
///
/// # Errors
/// What was found, and the range, in millimetres.
pub fn human_pupil(mm: f32) -> Result<PupilDiameter, String> {
    if (0.5..=9.0).contains(&mm) {
        Ok(PupilDiameter::from_mm(mm))
    } else {
        Err(format!("found {mm} mm, expected a human pupil of 0.5 to 9 mm"))
    }
}

fn parse_focus(text: &str) -> Result<Dioptres, String> {
    let dpt: f64 =
        text.parse().map_err(|_| format!("found '{text}', expected dioptres such as 2.5 (0 is infinity)"))?;
    focus_of_an_eye(dpt)
}

/// A focus that an eye can have, with glasses or without, as near as a rig may show anything.
///
/// # Errors
/// What was found, and the range, in dioptres.
pub fn focus_of_an_eye(dpt: f64) -> Result<Dioptres, String> {
    let nearest_dpt = DEPTH_DPT.max;
    if (-1.0..=nearest_dpt).contains(&dpt) {
        Ok(Dioptres(dpt))
    } else {
        Err(format!("found {dpt} dpt, expected -1 to {nearest_dpt} dioptres (0 is infinity, 2.857 is 35 cm)"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;
    use holod_calibration::rig::Rig;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn options_with_no_subcommand_belong_to_run() {
        let cli = Cli::try_parse_from(["holod", "--tracker", "/dev/ttyUSB0", "--duration", "2s"]).unwrap();
        assert!(cli.command.is_none());
        assert_eq!(cli.run.tracker.as_deref(), Some("/dev/ttyUSB0"));
        assert_eq!(cli.run.duration, Some(Duration::from_secs(2)));
    }

    #[test]
    fn a_run_records_into_one_folder() {
        assert!(Cli::try_parse_from(["holod", "--record", "here", "--record-in", "there"]).is_err());
    }

    #[test]
    fn a_mistyped_network_is_told_from_a_file() {
        assert_eq!(parse_weights("small"), Ok(WeightsChoice::Small));
        assert_eq!(parse_weights("./smal"), Ok(WeightsChoice::File("./smal".into())));
        assert_eq!(parse_weights("x.safetensors"), Ok(WeightsChoice::File("x.safetensors".into())));
        assert!(parse_weights("smal").unwrap_err().contains("did you mean `small`?"));
        assert!(parse_weights("standart").unwrap_err().contains("did you mean `standard`?"));
        assert!(!parse_weights("xyz").unwrap_err().contains("did you mean"));
    }

    #[test]
    fn several_pupils_are_named_one_after_another_or_with_commas() {
        for pupils in [&["--pupil", "2,4.5"][..], &["--pupil", "2", "4.5"], &["--pupil", "2", "--pupil", "4.5"]] {
            let line = ["holod", "evaluate", "--scenes", "s"].iter().chain(pupils);
            let Some(Command::Evaluate(args)) = Cli::try_parse_from(line).unwrap().command else { panic!() };
            assert_eq!(args.pupil, [2.0, 4.5].map(PupilDiameter::from_mm));
        }
    }

    #[test]
    fn values_out_of_range_are_refused() {
        for bad in ["12", "-1", "nan", "3mm", ""] {
            assert!(parse_pupil(bad).is_err(), "{bad}");
        }
        for bad in ["1920", "0x0", "1920x", "x", "99999x2", "8x8"] {
            assert!(parse_resolution(bad).is_err(), "{bad}");
        }
        for bad in ["0", "-1", "all", ""] {
            assert!(parse_count(bad).is_err(), "{bad}");
        }
        for bad in ["0", "0.09", "99ms", "3601", "2h", "nan", "2 parsecs", "-1", ""] {
            assert!(parse_silence(bad).is_err(), "{bad}");
        }
        for bad in ["nan", "inf", "-1", "1e300", "s", "2 parsecs", ""] {
            assert!(parse_time(bad).unwrap_err().contains(bad), "{bad}");
        }
        let millis =
            |text| (parse_time(text).map(|time| time.as_millis()), parse_silence(text).map(|time| time.as_millis()));
        for (text, ms) in [("2", 2000), ("2s", 2000), ("0.5", 500), ("500ms", 500), ("1m", 60_000)] {
            assert_eq!(millis(text), (Ok(ms), Ok(ms)), "{text}");
        }
        assert_eq!(parse_silence("0.5"), Ok(Duration::from_millis(500)));
        // As the rig's scale_mm_per_unit.
        for bad in ["0", "-1", "nan", "inf", "9.9e-5", "100.1", "wide", ""] {
            assert!(parse_scale(bad).is_err(), "{bad}");
            let rig = format!("[tracker]\nscale_mm_per_unit = {bad}\n");
            assert!(Rig::parse(&rig, Path::new("rig.toml")).is_err(), "{bad}");
        }
        assert_eq!([parse_scale("0.0001"), parse_scale("100")], [Ok(1e-4), Ok(100.0)]);
        let fault = "expected a number from 0.0001 to 100 mm per unit; 125 looks like micrometres: write 0.125";
        assert!(parse_scale("125").unwrap_err().contains(fault), "{:?}", parse_scale("125"));
        for bad in ["inf", "nan", "near", "40", "20.1", "-1.1"] {
            assert!(parse_focus(bad).is_err(), "{bad}");
        }
        // Whatever depth a rig may have.
        for (text, focus_dpt) in [("20", DEPTH_DPT.max), ("10.5", 10.5), ("0", DEPTH_DPT.min), ("-1", -1.0)] {
            assert_eq!(parse_focus(text), Ok(Dioptres(focus_dpt)), "{text}");
        }
        assert_eq!(parse_resolution("640x480").unwrap(), Resolution { width: 640, height: 480 });
    }
}
