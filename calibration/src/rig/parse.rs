//! From a rig file's text to a [`Rig`].

use std::collections::BTreeSet;
use std::f64::consts::{PI, TAU};
use std::path::Path;

use twox_hash::XxHash3_64;

use super::files::{PICTURE_BYTES_MAX, TEXT_BYTES_MAX, plain_file, read_bytes, read_text, text_of};
use super::flatness::GrayScale;
use super::meaning::is_in_order;
use super::profile::PanelProfile;
use super::reader::{Found, Reader, Section, Span};
use super::{
    Eye, LaserDriver, Lasers, LevelPhase, Model, Orientation, OutOfStroke, Packing, Panel, PanelMode, PhaseSign,
    Provenance, Rig, RigError, SpecReader, TableFile, TextLaserProfile, Tracker, VideoMargins, WeightsChoice, flatness,
    lut,
};
use crate::toml_source::Fault;
use crate::{Colour, Dioptres, DisplayGeometry, Metres, PerColour, PupilDiameter, Resolution, TimeNs};

/// Every key of a rig file, by table.
const LAYOUT: [(&str, &[&str]); 6] = [
    ("", &["name", "panel", "optics", "lasers", "tracker", "model"]),
    (
        "panel",
        &[
            "profile",
            "width_px",
            "height_px",
            "pixel_pitch_um",
            "video_width_px",
            "video_height_px",
            "video_left_px",
            "video_top_px",
            "refresh_hz",
            "mode",
            "field_order",
            "channel_order",
            "frames_per_colour",
            "colour",
            "bit_depth",
            "packing",
            "orientation",
            "phase_sign",
            "stroke_pi",
            "out_of_stroke",
            "settle_ms",
            "lut_file",
            "flatness_file",
            "flatness_2pi_gray",
            "flatness_sign",
        ],
    ),
    (
        "optics",
        &[
            "wavelengths_nm",
            "eyepiece_focal_length_mm",
            "relay_magnification",
            "depth_far_m",
            "depth_far_dpt",
            "depth_near_m",
            "depth_near_dpt",
        ],
    ),
    (
        "lasers",
        &[
            "driver",
            "device",
            "devices",
            "profile",
            "profile_file",
            "sync_wire",
            "full_power_mw",
            "transmission",
            "power_mw",
            "power_limit_mw",
            "head_limit_mw",
            "on_delay_ms",
            "lit_ms",
            "heartbeat_timeout_ms",
            "stall_timeout_ms",
            "gated_by_panel",
            "accept_no_heartbeat",
        ],
    ),
    ("tracker", &["spec", "eye", "scale_mm_per_unit", "fallback_mm", "hold_ms"]),
    ("model", &["network", "weights_file", "gpu", "pupil_step_mm"]),
];

/// Keys that earlier rig files had, with what to do about them.
const RETIRED: [(&str, &str, &str); 1] =
    [("model", "allow_optics_mismatch", "remove it: networks compute with the rig's own optics")];

/// The keys that a panel profile gives.
const PROFILE_KEYS: [&str; 10] = [
    "width_px",
    "height_px",
    "pixel_pitch_um",
    "video_width_px",
    "video_height_px",
    "video_left_px",
    "video_top_px",
    "refresh_hz",
    "bit_depth",
    "packing",
];

const PIXELS: Span = Span::new(64.0, 16384.0, "px");
const MARGIN: Span = Span::new(0.0, 16384.0, "px");
/// What `panel.pixel_pitch_um` may be.
pub const PITCH: Span =
    Span::new(1.0, 50.0, "µm").slips(&[("metres", 1e6), ("millimetres", 1e3), ("nanometres", 1e-3)]);
const REFRESH: Span = Span::new(10.0, 2000.0, "Hz").slips(&[("millihertz", 1e-3)]);
const FRAMES_PER_COLOUR: Span = Span::new(1.0, 8.0, "video frames");
const BIT_DEPTH: Span = Span::new(8.0, 16.0, "bits");
const STROKE: Span = Span::new(0.5, 6.0, "π").slips(&[("radians", 1.0 / PI), ("degrees", 1.0 / 180.0)]);
const GRAY_OF_2PI: Span = Span::new(16.0, 65536.0, "");
const SETTLE: Span = Span::new(0.0, 100.0, "ms").slips(&[("microseconds", 1e-3)]);
/// What each colour's figure in `optics.wavelengths_nm` may be.
pub const WAVELENGTH: Span =
    Span::new(380.0, 780.0, "nm").slips(&[("metres", 1e9), ("micrometres", 1e3), ("ångströms", 0.1)]);
/// What `optics.eyepiece_focal_length_mm` may be.
pub const FOCAL_LENGTH: Span = Span::new(5.0, 500.0, "mm").slips(&[("metres", 1e3), ("micrometres", 1e-3)]);
const MAGNIFICATION: Span = Span::new(0.1, 10.0, "").slips(&[("percent", 1e-2)]);
const DEPTH_M: Span = Span::new(1.0 / DEPTH_DPT.max, 100.0, "m").slips(&[("millimetres", 1e-3)]).or_infinite();
/// What `optics.depth_far_dpt` and `optics.depth_near_dpt` may be.
pub const DEPTH_DPT: Span = Span::new(0.0, 20.0, "dioptres");
/// Below this a volume's two ends look alike to any eye.
const DEPTH_RANGE_MIN_DPT: f64 = 0.1;
const POWER: Span = Span::new(0.0, Lasers::POWER_MAX_MW, "mW").slips(POWER_SLIPS);
const FULL_POWER: Span = Span::new(0.001, 4000.0, "mW").slips(POWER_SLIPS);
/// A laser may give somewhat more than it is told.
const TRANSMISSION: Span = Span::new(1e-4, 1.5, "").slips(&[("percent", 1e-2)]);
/// Lasers are told whole microwatts: less than one is darkness.
const POWER_LIT_MIN_MW: f64 = 0.001;
const POWER_SLIPS: &[(&str, f64)] = &[("microwatts", 1e-3)];
/// How many times below its limit a power still seems to be meant, where it would be that in another unit.
const POWER_BELOW_LIMIT_MAX: f64 = 100.0;
/// What accepts lasers without a heartbeat.
const ACCEPTANCE: &str = "these lasers stay lit when holod dies";
const ON_DELAY: Span = Span::new(0.0, 100.0, "ms");
const LIT: Span = Span::new(0.001, 100.0, "ms").slips(&[("microseconds", 1e-3)]);
const HEARTBEAT: Span = Span::new(5.0, 1000.0, "ms").slips(&[("seconds", 1e3)]);
const STALL: Span = Span::new(10.0, 60_000.0, "ms").slips(&[("seconds", 1e3)]);
pub(super) const SCALE: Span = Span::new(1e-4, 100.0, "mm per unit").slips(&[("metres", 1e3), ("micrometres", 1e-3)]);
const FALLBACK: Span = Span::new(1.0, 9.0, "mm").slips(&[("metres", 1e3), ("micrometres", 1e-3)]);
/// A sample is judged with its successors, so that none is known sooner.
const HOLD: Span = Span::new(150.0, 60_000.0, "ms").slips(&[("seconds", 1e3)]);
const PUPIL_STEP: Span = Span::new(0.0, 1.0, "mm").slips(&[("micrometres", 1e-3)]);
/// By how much a stated stroke may differ from that of a measured table.
const STROKE_TOLERANCE: f64 = 0.02;

/// Parses `text`; relative paths in it start at the folder of `origin`.
pub(super) fn parse(text: &str, origin: &Path, read_spec: SpecReader<'_>) -> Result<Rig, RigError> {
    let rig = Reader::read(text, |reader, root| read_rig(reader, root, text, origin, read_spec));
    rig.map_err(|faults| RigError { origin: origin.display().to_string(), faults })
}

/// The lasers of a rig file's text, whatever else is wrong with it; none where it does not say them right.
pub(super) fn laser_driver(text: &str, origin: &Path) -> Option<LaserDriver> {
    let mut driver = None;
    let folder = origin.parent().unwrap_or(Path::new(""));
    let _faults = Reader::read(text, |reader, root| {
        let lasers = reader.section(root, "lasers", true);
        driver = read_driver(reader, lasers, folder, &mut Provenance::default());
        Some(())
    });
    driver
}

fn read_rig<'a>(
    reader: &Reader<'a>,
    root: Section<'a>,
    text: &str,
    origin: &Path,
    read_spec: SpecReader<'_>,
) -> Option<Rig> {
    reader.reject_unknown(root, &LAYOUT, &RETIRED);
    let name = match reader.text(root, "name", "a name for logs and reports") {
        Some(name) => name.value.to_owned(),
        None => origin.file_stem().map_or_else(|| "rig".into(), |stem| stem.to_string_lossy().into_owned()),
    };
    // A file that says nothing of the bench is of the built-in one: all of it, since its parts belong together.
    let built_in = !["panel", "optics", "lasers"].into_iter().any(|name| root.has(name))
        && ["tracker", "model"].into_iter().any(|name| root.has(name));
    let [panel, optics, lasers, tracker, model] =
        [("panel", true), ("optics", true), ("lasers", true), ("tracker", false), ("model", false)]
            .map(|(name, required)| reader.section(root, name, required && !built_in));
    for section in [panel, optics, lasers, tracker, model] {
        reader.reject_unknown(section, &LAYOUT, &RETIRED);
    }
    let folder = origin.parent().unwrap_or(Path::new(""));
    let mut provenance =
        Provenance { origin: origin.display().to_string(), text_hash: Some(fnv1a(text)), ..Provenance::default() };

    if built_in {
        let tracker = read_tracker(reader, tracker, &|spec| read_spec(spec, folder));
        let model = read_model(reader, model, folder);
        return Some(Rig { name, tracker: tracker?, model: model?, provenance, ..Rig::default() });
    }
    // Each part is read whatever became of the others, so that one report holds all the faults.
    let profile = read_profile(reader, panel);
    provenance.panel_profile = profile.map(|profile| profile.name);
    let mut panel = panel.with_profile(profile.map(PanelProfile::values));
    if panel.has("profile") && profile.is_none() {
        panel = panel.excusing(&PROFILE_KEYS);
    }
    let pixels = read_pixels(reader, panel);
    let video_margins = read_video_margins(reader, panel, pixels.map(|(resolution, _)| resolution));
    let timing = read_field_timing(reader, panel);
    let levels = read_levels(reader, panel, timing.map(|timing| timing.mode));
    let phase = read_phase(reader, panel, levels, pixels.map(|(resolution, _)| resolution), folder, &mut provenance);
    let optics = read_optics(reader, optics, pixels);
    let lasers = read_lasers(reader, lasers, timing, folder, &mut provenance);
    let tracker = read_tracker(reader, tracker, &|spec| read_spec(spec, folder));
    let model = read_model(reader, model, folder);

    let (timing, (bit_depth, packing), phase) = (timing?, levels?, phase?);
    let (geometry, relay_magnification) = optics?;
    let panel = Panel {
        refresh_hz: timing.refresh_hz,
        mode: timing.mode,
        field_order: timing.field_order,
        channel_order: timing.channel_order,
        frames_per_colour: timing.frames_per_colour,
        settle: milliseconds(timing.settle_ms.value),
        bit_depth,
        packing,
        video_margins: video_margins?,
        orientation: phase.orientation,
        phase_sign: phase.sign,
        stroke_rad: phase.stroke_rad,
        out_of_stroke: phase.out_of_stroke,
        lut: phase.lut,
        flatness_rad: phase.flatness_rad,
    };
    Some(Rig {
        name,
        panel,
        geometry,
        relay_magnification,
        lasers: lasers?,
        tracker: tracker?,
        model: model?,
        provenance,
    })
}

fn read_profile<'a>(reader: &Reader<'a>, panel: Section<'a>) -> Option<&'static PanelProfile> {
    let choices: Vec<_> = PanelProfile::all().iter().map(|profile| (profile.name, profile)).collect();
    Some(reader.choice(panel, "profile", &choices, false)?.value)
}

fn read_pixels<'a>(reader: &Reader<'a>, panel: Section<'a>) -> Option<(Resolution, Metres)> {
    let [width, height] = ["width_px", "height_px"].map(|key| {
        let pixels = reader.required_integer(panel, key, PIXELS)?;
        if pixels.value % 2 == 0 {
            return Some(pixels.value);
        }
        let advice = "leave out the last row or column of the panel".into();
        reader.fault_in(panel, key, pixels.line, &pixels.value.to_string(), "an even number of pixels", advice);
        None
    });
    let pitch_um = reader.required_number(panel, "pixel_pitch_um", PITCH);
    Some((Resolution { width: width?, height: height? }, Metres(pitch_um?.value / 1e6)))
}

fn read_video_margins<'a>(
    reader: &Reader<'a>,
    panel: Section<'a>,
    resolution: Option<Resolution>,
) -> Option<VideoMargins> {
    // Before the panel, and behind it.
    let read = |[size_key, first_key, own_key]: [&'static str; 3], own: Option<usize>| {
        let first = if panel.gives(first_key) { reader.required_integer(panel, first_key, MARGIN)?.value } else { 0 };
        if !panel.gives(size_key) {
            if first == 0 {
                return Some((0, 0));
            }
            let line = reader.line_of_key(panel, first_key);
            let expected = format!("{size_key} beside it, the size of the video frame");
            let advice = format!("add {size_key}, or take {first_key} out");
            reader.fault_in(panel, first_key, line, &format!("{first_key} alone"), &expected, advice);
            return None;
        }
        let size = reader.required_integer(panel, size_key, PIXELS)?;
        let behind = size.value.checked_sub(first + own?);
        if behind.is_none() {
            let least = first + own?;
            let expected = format!("at least {least} px, {own_key} and {first_key} together");
            let advice = match size.line {
                Some(_) => format!("{size_key} is the size of the mode that the panel's video input takes"),
                None => format!("the panel's profile gives {size_key}: give it here, or take the profile out"),
            };
            reader.fault_in(panel, size_key, size.line, &format!("{} px", size.value), &expected, advice);
        }
        Some((first, behind?))
    };
    let columns = read(["video_width_px", "video_left_px", "width_px"], resolution.map(|pixels| pixels.width));
    let rows = read(["video_height_px", "video_top_px", "height_px"], resolution.map(|pixels| pixels.height));
    let ((left, right), (top, bottom)) = (columns?, rows?);
    Some(VideoMargins { left, right, top, bottom })
}

/// The panel as a clock.
#[derive(Clone, Copy)]
struct FieldTiming {
    refresh_hz: f64,
    mode: PanelMode,
    field_order: [Colour; 3],
    channel_order: [Colour; 3],
    frames_per_colour: u8,
    settle_ms: Found<f64>,
    field_ms: f64,
}

impl FieldTiming {
    fn describe_field(&self) -> String {
        let mode = self.mode.name();
        format!("{} ms of one field ({} Hz, {mode})", shown(self.field_ms), self.refresh_hz)
    }

    /// What a window leaves free at the end of its field.
    fn slack_ms(&self) -> f64 {
        self.mode.window_slack(milliseconds(self.field_ms)).0 as f64 / 1e6
    }

    fn colour_frame_ms(&self) -> f64 {
        let fields = match self.mode {
            PanelMode::ChannelPacked => 3,
            PanelMode::FieldSequential => 3 * u32::from(self.frames_per_colour),
            PanelMode::Monochrome(_) => 1,
        };
        f64::from(fields) * self.field_ms
    }
}

fn read_field_timing<'a>(reader: &Reader<'a>, panel: Section<'a>) -> Option<FieldTiming> {
    let refresh_hz = reader.required_number(panel, "refresh_hz", REFRESH);
    let mode = read_mode(reader, panel);
    let field_order = match mode {
        Some(PanelMode::Monochrome(_)) if !panel.has("field_order") => Some(Colour::ALL),
        _ => reader.colour_order(panel, "field_order"),
    };
    let channel_order = read_channel_order(reader, panel, mode);
    let frames_per_colour = read_frames_per_colour(reader, panel, mode);
    let settle_ms = reader.required_number(panel, "settle_ms", SETTLE);
    let (refresh_hz, mode, settle_ms) = (refresh_hz?.value, mode?, settle_ms?);
    let field_ms = 1e3 / (refresh_hz * mode.fields_per_refresh());
    let (field_order, channel_order, frames_per_colour) = (field_order?, channel_order?, frames_per_colour?);
    let timing = FieldTiming { refresh_hz, mode, field_order, channel_order, frames_per_colour, settle_ms, field_ms };
    if settle_ms.value >= field_ms {
        let expected = format!("less than the {}", timing.describe_field());
        let mut advice = "no phase would ever settle: correct the settle time or lower refresh_hz".to_owned();
        if mode == PanelMode::FieldSequential {
            advice += "; a panel that shows its video a frame later, which settle_ms is not for, cannot be lit field by \
                       field";
        }
        reader.fault_in(panel, "settle_ms", settle_ms.line, &format!("{} ms", settle_ms.value), &expected, advice);
    }
    Some(timing)
}

/// `mode`, with the colour that monochrome mode shows.
fn read_mode<'a>(reader: &Reader<'a>, panel: Section<'a>) -> Option<PanelMode> {
    // Which colour monochrome mode shows, the other key says.
    let modes = [PanelMode::ChannelPacked, PanelMode::FieldSequential, PanelMode::Monochrome(Colour::Red)];
    let mode = reader.choice(panel, "mode", &modes.map(|mode| (mode.name(), mode)), true);
    let monochrome = mode.is_some_and(|mode| matches!(mode.value, PanelMode::Monochrome(_)));
    let colours = Colour::ALL.map(|colour| (colour.name(), colour));
    let colour = reader.choice(panel, "colour", &colours, monochrome);
    match (mode?.value, colour) {
        (PanelMode::Monochrome(_), colour) => Some(PanelMode::Monochrome(colour?.value)),
        (other, Some(colour)) => {
            let found = format!("a single colour in {} mode", other.name());
            let advice = "take colour out, or write mode = \"monochrome\"".into();
            reader.fault_in(panel, "colour", colour.line, &found, "colour in monochrome mode only", advice);
            None
        }
        (mode, None) => Some(mode),
    }
}

fn read_channel_order<'a>(reader: &Reader<'a>, panel: Section<'a>, mode: Option<PanelMode>) -> Option<[Colour; 3]> {
    if !panel.has("channel_order") {
        return Some(Colour::ALL);
    }
    let order = reader.colour_order(panel, "channel_order")?;
    if let Some(mode) = mode.filter(|&mode| mode != PanelMode::ChannelPacked) {
        let found = format!("an order of channels in {} mode", mode.name());
        let expected = "none outside channel-packed mode, where all channels carry one colour";
        let line = reader.line_of_key(panel, "channel_order");
        reader.fault_in(panel, "channel_order", line, &found, expected, "take it out".into());
        return None;
    }
    Some(order)
}

fn read_frames_per_colour<'a>(reader: &Reader<'a>, panel: Section<'a>, mode: Option<PanelMode>) -> Option<u8> {
    if !panel.has("frames_per_colour") {
        return Some(1);
    }
    let frames = reader.required_integer(panel, "frames_per_colour", FRAMES_PER_COLOUR)?;
    if frames.value > 1
        && let Some(mode) = mode.filter(|&mode| mode != PanelMode::FieldSequential)
    {
        let found = format!("{} in {} mode", frames.value, mode.name());
        let advice = "take it out, or write mode = \"field-sequential\"".into();
        reader.fault_in(panel, "frames_per_colour", frames.line, &found, "1 outside field-sequential mode", advice);
        return None;
    }
    u8::try_from(frames.value).ok()
}

/// The bits of a level and where they travel on the video link.
fn read_levels<'a>(reader: &Reader<'a>, panel: Section<'a>, mode: Option<PanelMode>) -> Option<(u8, Packing)> {
    let bits = reader.required_integer(panel, "bit_depth", BIT_DEPTH);
    let packings = Packing::ALL.map(|packing| (packing.name(), packing));
    let packing = reader.choice(panel, "packing", &packings, false);
    let bits = bits?;
    let fitting: Vec<Packing> =
        Packing::ALL.into_iter().filter(|packing| usize::from(packing.bit_depth()) == bits.value).collect();
    let names = fitting.iter().map(|packing| format!("\"{}\"", packing.name())).collect::<Vec<_>>().join(" or ");
    let Some(&first) = fitting.first() else {
        let advice = "holod sends levels of 8, 10 or 16 bits".into();
        reader.fault_in(panel, "bit_depth", bits.line, &bits.value.to_string(), "8, 10 or 16", advice);
        return None;
    };
    let bit_depth = first.bit_depth();
    let line = packing.and_then(|packing| packing.line);
    let packing = match packing {
        Some(packing) if packing.value.bit_depth() == bit_depth => packing.value,
        Some(packing) => {
            let found = format!("\"{}\", which carries {} bits", packing.value.name(), packing.value.bit_depth());
            let expected = format!("{names}, as bit_depth is {bit_depth}");
            let advice = "correct packing or bit_depth: the panel's manual says which bits it reads".into();
            reader.fault_in(panel, "packing", line.or(bits.line), &found, &expected, advice);
            return None;
        }
        None if bit_depth == Packing::Gray.bit_depth() => Packing::Gray,
        // A packing that is there and faulty has been reported.
        None if panel.has("packing") => return None,
        None => {
            let expected = format!("{names}, as bit_depth is {bit_depth}");
            let advice = "add packing to [panel]: the panel's manual says which bits it reads".into();
            reader.fault_in(panel, "packing", bits.line, "nothing", &expected, advice);
            return None;
        }
    };
    if mode == Some(PanelMode::ChannelPacked) && !packing.fits_a_channel() {
        let found = format!("\"{}\" in mode \"{}\"", packing.name(), PanelMode::ChannelPacked.name());
        let advice = format!("write mode = \"{}\", or 8 bits with \"gray\"", PanelMode::FieldSequential.name());
        let expected = "\"gray\" or \"gray10\", as red, green and blue each carry a field of their own";
        reader.fault_in(panel, "packing", line.or(bits.line), &found, expected, advice);
        return None;
    }
    Some((bit_depth, packing))
}

/// The panel as a phase modulator.
struct Phase {
    orientation: Orientation,
    sign: PhaseSign,
    stroke_rad: PerColour<f64>,
    out_of_stroke: OutOfStroke,
    lut: PerColour<Option<Vec<LevelPhase>>>,
    flatness_rad: PerColour<Option<Vec<f32>>>,
}

fn read_phase<'a>(
    reader: &Reader<'a>,
    panel: Section<'a>,
    levels: Option<(u8, Packing)>,
    resolution: Option<Resolution>,
    folder: &Path,
    provenance: &mut Provenance,
) -> Option<Phase> {
    let signs = [("positive", PhaseSign::Positive), ("negative", PhaseSign::Negative)];
    let sign = reader.choice(panel, "phase_sign", &signs, true);
    let lut_paths = reader.texts(panel, "lut_file", "a CSV file's path");
    let needs_stroke = PerColour(lut_paths.0.map(|path| path.is_none()));
    let stroke_pi = reader.numbers(panel, "stroke_pi", STROKE, needs_stroke);
    let orientations = Orientation::ALL.map(|orientation| (orientation.name(), orientation));
    let orientation = reader.choice(panel, "orientation", &orientations, false);
    let ways = OutOfStroke::ALL.map(|way| (way.name(), way));
    let out_of_stroke = reader.choice(panel, "out_of_stroke", &ways, false);
    let flatness_paths = reader.texts(panel, "flatness_file", "a PNG or BMP file's path");
    let grays_of_2pi = reader.numbers(panel, "flatness_2pi_gray", GRAY_OF_2PI, PerColour([false; 3]));
    let subtracted = read_flatness_sign(reader, panel);

    let mut lut = PerColour([const { None }; 3]);
    let mut flatness_rad = PerColour([const { None }; 3]);
    let mut stroke_rad = stroke_pi.map(|stroke| stroke.map(|stroke| stroke.value * PI));
    for colour in Colour::ALL {
        if let (Some(path), Some((bit_depth, _))) = (lut_paths[colour], levels) {
            let key = format!("lut_file.{colour}");
            let file = folder.join(path.value);
            let read = read_bytes(&file, "text", TEXT_BYTES_MAX).and_then(|bytes| {
                let xxh3 = XxHash3_64::oneshot(&bytes);
                Ok((lut::read(&file, &text_of(bytes, &file)?, bit_depth)?, xxh3))
            });
            let read = reader.of_file(panel, &key, path.line, read);
            let (table, xxh3) = read.unzip();
            lut[colour] = table;
            if let Some(table) = &lut[colour] {
                let range = table_range(table);
                check_lut(reader, panel, &key, path.line, range, sign.map(|sign| sign.value), stroke_pi[colour]);
                stroke_rad[colour] = Some(range.either().abs());
            }
            provenance.lut_files[colour] = xxh3.map(|xxh3| TableFile { path: file, xxh3 });
        }
        if let (Some(path), Some(resolution)) = (flatness_paths[colour], resolution) {
            let file = folder.join(path.value);
            let gray_of_2pi = grays_of_2pi[colour].map(|gray| gray.value);
            let read = read_bytes(&file, "picture", PICTURE_BYTES_MAX).and_then(|bytes| {
                let scale = GrayScale { gray_of_2pi, subtracted };
                Ok((flatness::read(&file, &bytes, resolution, scale)?, XxHash3_64::oneshot(&bytes)))
            });
            let read = reader.of_file(panel, &format!("flatness_file.{colour}"), path.line, read);
            let (picture, xxh3) = read.unzip();
            flatness_rad[colour] = picture;
            provenance.flatness_files[colour] = xxh3.map(|xxh3| TableFile { path: file, xxh3 });
        }
        if let (None, Some(gray)) = (flatness_paths[colour], grays_of_2pi[colour]) {
            let advice = format!("name {colour}'s picture in flatness_file, or take this out");
            let key = format!("flatness_2pi_gray.{colour}");
            reader.fault_in(panel, &key, gray.line, "a gray of no picture", "a flatness_file for it", advice);
        }
    }
    let stroke_rad = PerColour([stroke_rad.0[0]?, stroke_rad.0[1]?, stroke_rad.0[2]?]);
    let out_of_stroke = out_of_stroke.map_or(OutOfStroke::default(), |way| way.value);
    let orientation = orientation.map_or(Orientation::default(), |orientation| orientation.value);
    Some(Phase { orientation, sign: sign?.value, stroke_rad, out_of_stroke, lut, flatness_rad })
}

/// Whether the flatness pictures show what is to be taken off.
fn read_flatness_sign<'a>(reader: &Reader<'a>, panel: Section<'a>) -> bool {
    let signs = [("add", false), ("subtract", true)];
    let sign = reader.choice(panel, "flatness_sign", &signs, false);
    if let Some(sign) = sign.filter(|_| !panel.has("flatness_file")) {
        let advice = "name the pictures in flatness_file, or take this out".into();
        reader.fault_in(panel, "flatness_sign", sign.line, "a sign of no picture", "a flatness_file for it", advice);
    }
    sign.is_some_and(|sign| sign.value)
}

/// By how much the phases of a table differ.
#[derive(Clone, Copy)]
enum TableRange {
    /// The phase rises or falls throughout, by this much from the lowest level to the highest.
    Signed(f64),
    /// The phases come in no order; the lowest and the highest are this far apart.
    Unordered(f64),
}

impl TableRange {
    fn either(self) -> f64 {
        match self {
            Self::Signed(range_rad) | Self::Unordered(range_rad) => range_rad,
        }
    }
}

fn table_range(table: &[LevelPhase]) -> TableRange {
    let phases = || table.iter().map(|entry| entry.phase_rad);
    if is_in_order(table) {
        return TableRange::Signed(table[table.len() - 1].phase_rad - table[0].phase_rad);
    }
    TableRange::Unordered(phases().fold(f64::MIN, f64::max) - phases().fold(f64::MAX, f64::min))
}

/// Judges a measured table against what the rig file says in words.
fn check_lut<'a>(
    reader: &Reader<'a>,
    panel: Section<'a>,
    key: &str,
    line: Option<usize>,
    range: TableRange,
    sign: Option<PhaseSign>,
    stroke_pi: Option<Found<f64>>,
) {
    let range_pi = range.either() / PI;
    if range_pi.abs() < STROKE.min || range_pi.abs() > STROKE.max {
        let expected = format!("a range of {} to {} π", STROKE.min, STROKE.max);
        let found = format!("a table whose phase changes by {} π", shown(range_pi));
        reader.fault_in(
            panel,
            key,
            line,
            &found,
            &expected,
            "give its phases in radians: multiply turns by 2π, multiples of π by π".into(),
        );
        return;
    }
    let found = format!("a table whose phase goes by {} π from the lowest level to the highest", shown(range_pi));
    let is_stroke = |range_pi: f64, stroke_pi: f64| (range_pi.abs() / stroke_pi - 1.0).abs() <= STROKE_TOLERANCE;
    if let Some(stroke) = stroke_pi.filter(|stroke| !is_stroke(range_pi, stroke.value)) {
        let expected = format!("the {} π that stroke_pi states", shown(stroke.value));
        let other_unit = [("multiples of π", PI), ("turns", TAU)]
            .into_iter()
            .find(|(_, unit_rad)| is_stroke(range_pi * unit_rad, stroke.value));
        let advice = match other_unit {
            Some((unit, unit_rad)) => format!("its phases look like {unit}: multiply them by {unit_rad:.5}"),
            None => "take stroke_pi out: the table says it".into(),
        };
        reader.fault_in(panel, key, line, &found, &expected, advice);
    }
    let TableRange::Signed(range_rad) = range else { return };
    let (expected, other) = match sign {
        Some(PhaseSign::Positive) if range_rad < 0.0 => ("a rising table, as phase_sign is \"positive\"", "negative"),
        Some(PhaseSign::Negative) if range_rad > 0.0 => ("a falling table, as phase_sign is \"negative\"", "positive"),
        _ => return,
    };
    let advice = format!("write phase_sign = \"{other}\", or turn the table round");
    reader.fault_in(panel, key, line, &found, expected, advice);
}

fn read_optics<'a>(
    reader: &Reader<'a>,
    optics: Section<'a>,
    pixels: Option<(Resolution, Metres)>,
) -> Option<(DisplayGeometry, f64)> {
    let wavelengths_nm = reader.numbers(optics, "wavelengths_nm", WAVELENGTH, PerColour([true; 3]));
    let focal_length_mm = reader.required_number(optics, "eyepiece_focal_length_mm", FOCAL_LENGTH);
    let magnification = match reader.number(optics, "relay_magnification", MAGNIFICATION) {
        None if !optics.has("relay_magnification") => Some(Found { value: 1.0, line: None }),
        read => read,
    };
    let depth_far = read_depth(reader, optics, ["depth_far_m", "depth_far_dpt"], DisplayGeometry::DEFAULT.depth_far);
    let depth_near =
        read_depth(reader, optics, ["depth_near_m", "depth_near_dpt"], DisplayGeometry::DEFAULT.depth_near);

    if let [Some(red), Some(green), Some(blue)] = wavelengths_nm.0
        && !(red.value > green.value && green.value > blue.value)
    {
        let found = format!("{}, {} and {} nm", red.value, green.value, blue.value);
        let expected = "red longer than green, green longer than blue";
        reader.fault_in(optics, "wavelengths_nm", red.line, &found, expected, "put each under its own colour".into());
    }
    if let (Some(far), Some(near)) = (depth_far, depth_near) {
        let range_dpt = near.value.0 - far.value.0;
        let line = near.line.or(far.line);
        let found = format!("near {} and far {} dioptres", shown(near.value.0), shown(far.value.0));
        if range_dpt < 0.0 {
            let advice = "exchange the near and the far end".into();
            reader.fault_in(optics, "depth_near", line, &found, "the near end nearer than the far end", advice);
        } else if range_dpt < DEPTH_RANGE_MIN_DPT {
            let expected = format!("ends at least {DEPTH_RANGE_MIN_DPT} dioptres apart");
            let advice = "depths are in metres or dioptres: 35 cm is depth_near_m = 0.35".into();
            reader.fault_in(optics, "depth_near", line, &found, &expected, advice);
        }
    }
    let [Some(red), Some(green), Some(blue)] = wavelengths_nm.0 else { return None };
    let (resolution, pixel_pitch) = pixels?;
    let (focal_length_mm, magnification) = (focal_length_mm?.value, magnification?);
    let from_panel_mm = focal_length_mm / magnification.value;
    if !(FOCAL_LENGTH.min..=FOCAL_LENGTH.max).contains(&from_panel_mm) {
        let found = format!("{}, which makes {} mm of the eyepiece", shown(magnification.value), shown(from_panel_mm));
        let expected = format!("from {} to {} mm, seen from the panel", FOCAL_LENGTH.min, FOCAL_LENGTH.max);
        let advice = "write the size of the panel's image over that of the panel".into();
        reader.fault_in(optics, "relay_magnification", magnification.line, &found, &expected, advice);
    }
    let geometry = DisplayGeometry {
        resolution,
        pixel_pitch,
        wavelengths: PerColour([red, green, blue]).map(|wavelength_nm| Metres(wavelength_nm.value / 1e9)),
        eyepiece_focal_length: Metres(from_panel_mm / 1e3),
        depth_far: depth_far?.value,
        depth_near: depth_near?.value,
    };
    Some((geometry, magnification.value))
}

/// One end of the depth range, in metres or in dioptres; `default` where the rig file gives neither.
fn read_depth<'a>(
    reader: &Reader<'a>,
    optics: Section<'a>,
    [key_m, key_dpt]: [&'static str; 2],
    default: Dioptres,
) -> Option<Found<Dioptres>> {
    if !optics.has(key_m) && !optics.has(key_dpt) {
        return Some(Found { value: default, line: None });
    }
    let metres = reader.number(optics, key_m, DEPTH_M);
    let dioptres = reader.number(optics, key_dpt, DEPTH_DPT);
    if optics.has(key_m) && optics.has(key_dpt) {
        let line = dioptres.or(metres).and_then(|depth| depth.line);
        let expected = "the depth once, in metres or in dioptres";
        reader.fault_in(optics, key_dpt, line, &format!("{key_m} as well"), expected, "take one of the two out".into());
    }
    let metres = metres.map(|found| Found { value: Dioptres(1.0 / found.value), line: found.line });
    metres.or(dioptres.map(|found| Found { value: Dioptres(found.value), line: found.line }))
}

fn read_lasers<'a>(
    reader: &Reader<'a>,
    lasers: Section<'a>,
    timing: Option<FieldTiming>,
    folder: &Path,
    provenance: &mut Provenance,
) -> Option<Lasers> {
    let driver = read_driver(reader, lasers, folder, provenance);
    let gated_by_panel = reader.flag(lasers, "gated_by_panel", false);
    let accept_no_heartbeat = read_acceptance(reader, lasers, driver.as_ref());
    // Of a driver that is faulty these keys alone tell whether it has such lasers.
    let [may_lack_lasers, may_be_on] = match &driver {
        Some(driver) => [true, !driver.gates_fields()],
        None => [lasers.has("devices"), lasers.has("devices") || lasers.has("full_power_mw")],
    };
    let is_there = |colour: Colour| driver.as_ref().map_or(!may_lack_lasers, |driver| driver.has(colour));
    // Of a driver that does not have the key that is a fault already.
    let gated_by_panel = gated_by_panel && may_be_on;
    let lasers = if may_be_on { lasers.excusing(&WINDOW_KEYS) } else { lasers };
    let power_mw = reader.numbers(lasers, "power_mw", POWER, PerColour(Colour::ALL.map(is_there)));
    let power_limit_mw = reader.numbers(lasers, "power_limit_mw", POWER, PerColour([false; 3]));
    for colour in Colour::ALL {
        if let Some(power) = power_mw[colour].as_ref().filter(|power| Lasers::whole_uw(power.value) == 0)
            && power.value > 0.0
        {
            let (found, key) = (format!("{} mW", power.value), format!("power_mw.{colour}"));
            let expected = format!("0, or {POWER_LIT_MIN_MW} mW at least: lasers are told whole microwatts");
            let advice = format!("write {POWER_LIT_MIN_MW} and put a filter before the laser, or 0 to keep it dark");
            reader.fault_in(lasers, &key, power.line, &found, &expected, advice);
        }
        if let (Some(power), Some(limit)) = (power_mw[colour], power_limit_mw[colour])
            && power.value > limit.value
        {
            let expected = format!("{} mW at most, as power_limit_mw says", limit.value);
            let allowed = Span::new(limit.value / POWER_BELOW_LIMIT_MAX, limit.value, "mW").slips(POWER_SLIPS);
            let lower = || "lower it; power_limit_mw is what this bench's optics allow an eye".into();
            let advice = allowed.slip(power.value).unwrap_or_else(lower);
            let found = format!("{} mW", power.value);
            reader.fault_in(lasers, &format!("power_mw.{colour}"), power.line, &found, &expected, advice);
        }
    }
    let head_limit_mw = read_head_limits(reader, lasers, driver.as_ref(), power_mw);
    let on_delay_ms = reader.required_number(lasers, "on_delay_ms", ON_DELAY);
    let lit_ms = reader.required_number(lasers, "lit_ms", LIT);
    let heartbeat_ms = reader.required_number(lasers, "heartbeat_timeout_ms", HEARTBEAT);
    let stall_ms = reader.number(lasers, "stall_timeout_ms", STALL);

    if let Some(timing) = timing.filter(|timing| timing.mode == PanelMode::ChannelPacked)
        && gated_by_panel
        && timing.field_order != timing.channel_order
    {
        let line = reader.line_of_key(lasers, "gated_by_panel");
        let names = |order: [Colour; 3]| order.map(Colour::name).join(", ");
        let expected = format!("panel.field_order = panel.channel_order, which is {}", names(timing.channel_order));
        let advice = "a panel that lights its own lasers lights each channel's colour: correct either order".into();
        let found = format!("true with panel.field_order = {}", names(timing.field_order));
        reader.fault_in(lasers, "gated_by_panel", line, &found, &expected, advice);
    }
    check_mode(reader, lasers, timing, driver.as_ref(), gated_by_panel);
    // Where no window switches lasers, what is lit of a field begins when its phase has settled, whatever is written.
    let windowless = |value: f64| Some(Found { value, line: None });
    let on_delay_ms = if may_be_on { windowless(0.0) } else { on_delay_ms };
    let room_ms = |timing: FieldTiming, on_delay_ms: Found<f64>| {
        timing.field_ms - timing.slack_ms() - timing.settle_ms.value - on_delay_ms.value
    };
    let whole_field = || windowless(room_ms(timing?, on_delay_ms?).max(LIT.min));
    let lit_ms = if may_be_on { whole_field() } else { lit_ms };
    if let (Some(timing), Some(on_delay_ms), Some(lit_ms)) = (timing, on_delay_ms, lit_ms) {
        let before_ms = timing.settle_ms.value + on_delay_ms.value;
        let end_ms = before_ms + lit_ms.value;
        let room_ms = room_ms(timing, on_delay_ms);
        if timing.settle_ms.value < timing.field_ms && (end_ms > timing.field_ms || room_ms < LIT.min) {
            let settle = shown(timing.settle_ms.value);
            let found = format!(
                "settle {settle} + on_delay {} + lit {} = {} ms",
                shown(on_delay_ms.value),
                shown(lit_ms.value),
                shown(end_ms)
            );
            let slack = shown(timing.slack_ms());
            let expected = format!("an end within the {}, {slack} ms before its own", timing.describe_field());
            let advice = if room_ms >= LIT.min {
                format!("write lit_ms = {} at most", (room_ms * 1e3).floor() / 1e3)
            } else if may_be_on {
                "lower panel.refresh_hz, or correct panel.settle_ms".into()
            } else {
                "shorten on_delay_ms or lower panel.refresh_hz".into()
            };
            reader.fault_in(lasers, "lit_ms", lit_ms.line, &found, &expected, advice);
        }
    }
    if let (Some(timing), Some(heartbeat_ms)) = (timing, heartbeat_ms) {
        let least_ms = 2.0 * timing.colour_frame_ms();
        if heartbeat_ms.value < least_ms {
            let expected = format!("at least two colour frames, {} ms", shown(least_ms));
            let advice = "lengthen it, or the box goes dark between two frames".into();
            let found = format!("{} ms", heartbeat_ms.value);
            reader.fault_in(lasers, "heartbeat_timeout_ms", heartbeat_ms.line, &found, &expected, advice);
        }
    }
    let driver = driver?;
    let power_of = |colour: Colour| match power_mw[colour] {
        Some(power) => Some(power.value),
        None => (!driver.has(colour)).then_some(0.0),
    };
    let power_mw = PerColour([power_of(Colour::Red)?, power_of(Colour::Green)?, power_of(Colour::Blue)?]);
    Some(Lasers {
        driver,
        power_mw,
        power_limit_mw: power_limit_mw.map(|limit| limit.map(|limit| limit.value)),
        head_limit_mw,
        on_delay: milliseconds(on_delay_ms?.value),
        width: milliseconds(lit_ms?.value),
        heartbeat_timeout: milliseconds(heartbeat_ms?.value),
        stall_timeout: stall_ms.map(|stall| milliseconds(stall.value)),
        gated_by_panel,
        accept_no_heartbeat,
    })
}

/// The greatest powers that lasers may be told, none of a driver that is told the power at the panel. A slip in
/// `transmission` raises what a laser is told and leaves `power_mw` as it is, so that only a limit of its own notices it.
fn read_head_limits<'a>(
    reader: &Reader<'a>,
    lasers: Section<'a>,
    driver: Option<&LaserDriver>,
    power_mw: PerColour<Option<Found<f64>>>,
) -> PerColour<Option<f64>> {
    const KEY: &str = "head_limit_mw";
    let needs = |colour: Colour| match driver {
        Some(driver @ LaserDriver::Text { transmission_ppb, .. }) => {
            driver.has(colour) && transmission_ppb[colour] < 1_000_000_000
        }
        _ => false,
    };
    let required = PerColour(Colour::ALL.map(|colour| lasers.has(KEY) && needs(colour)));
    let limits_mw = reader.numbers(lasers, KEY, FULL_POWER, required);
    let Some(driver @ LaserDriver::Text { transmission_ppb, .. }) = driver else { return PerColour([None; 3]) };
    let told_mw = |colour: Colour| {
        let told_uw = driver.head_power_uw(colour, Lasers::whole_uw(power_mw[colour]?.value))?;
        Some(told_uw as f64 / 1e3)
    };
    let line = reader.line_of_key(lasers, "transmission");
    let needing: Vec<Colour> = Colour::ALL.into_iter().filter(|&colour| needs(colour)).collect();
    if !lasers.has(KEY) && !needing.is_empty() {
        let told = needing.iter().filter_map(|&colour| Some(format!("{} mW for {colour}", told_mw(colour)?)));
        let told = told.collect::<Vec<_>>().join(", ");
        let found =
            if told.is_empty() { "nothing".into() } else { format!("nothing, and lasers would be told {told}") };
        let expected = "the greatest power that a laser may be told, which transmission makes more than power_mw; \
                        power_limit_mw is for the panel";
        let limits = needing.iter().map(|colour| format!("{colour} = ...")).collect::<Vec<_>>().join(", ");
        let advice = format!(
            "write head_limit_mw = {{ {limits} }}, in mW at the laser itself: the greatest power that the bench is safe \
             with, whatever is in the laser's way"
        );
        reader.fault_in(lasers, KEY, line, &found, expected, advice);
    }
    for colour in Colour::ALL {
        let Some(limit) = limits_mw[colour] else { continue };
        if !driver.has(colour) {
            let (key, advice) = (format!("{KEY}.{colour}"), "name its port in devices, or take this out");
            reader.fault_in(lasers, &key, limit.line, "that of no laser", "a laser of it", advice.into());
        } else if let Some(told_mw) = told_mw(colour).filter(|told_mw| *told_mw > limit.value) {
            let share = f64::from(transmission_ppb[colour]) / 1e9;
            let found = format!("{told_mw} mW that the laser is told, of which {share} gets to the panel");
            let expected = format!("{} mW at most, as head_limit_mw says", limit.value);
            let (key, advice) = match lasers.has("transmission") {
                true => ("transmission", "correct transmission, as measured at the panel, or lower power_mw"),
                false => ("power_mw", "lower it, or correct head_limit_mw"),
            };
            let line = reader.line_of_key(lasers, key);
            reader.fault_in(lasers, &format!("{key}.{colour}"), line, &found, &expected, advice.into());
        }
    }
    limits_mw.map(|limit| limit.map(|limit| limit.value))
}

/// The keys of a window, which switches no laser that is on while it is armed.
const WINDOW_KEYS: [&str; 2] = ["on_delay_ms", "lit_ms"];

/// Judges what of `[lasers]` goes with some of the panel's modes only.
fn check_mode<'a>(
    reader: &Reader<'a>,
    lasers: Section<'a>,
    timing: Option<FieldTiming>,
    driver: Option<&LaserDriver>,
    gated_by_panel: bool,
) {
    const BY_PANEL: &str =
        "write gated_by_panel = true where the panel's own hardware gates each laser to its field, or ";
    let Some(mode) = timing.map(|timing| timing.mode) else { return };
    let packed = PanelMode::ChannelPacked.name();
    let is_of_one_colour = matches!(mode, PanelMode::Monochrome(_));
    if let Some(driver) = driver.filter(|driver| !driver.gates_fields() && !is_of_one_colour && !gated_by_panel) {
        let line = reader.line_of_key(lasers, "driver");
        let found =
            format!("\"{}\" in {} mode, whose fields these lasers cannot be switched for", driver.name(), mode.name());
        let by_panel = if mode == PanelMode::ChannelPacked { BY_PANEL } else { "" };
        let advice = format!(
            "{by_panel}show one colour (mode = \"monochrome\"), or light fields with a laser box (driver = \"serial\")"
        );
        reader.fault_in(lasers, "driver", line, &found, "lasers that can be lit for single fields", advice);
    }
    if mode == PanelMode::ChannelPacked {
        return;
    }
    let found = format!("true in {} mode", mode.name());
    if mode == PanelMode::FieldSequential && gated_by_panel {
        let line = reader.line_of_key(lasers, "gated_by_panel");
        let expected = format!("false, or mode = \"{packed}\": of a video frame of one colour only holod knows which");
        let advice = "take it out, and light fields with a laser box (driver = \"serial\"), or show one colour \
                      (mode = \"monochrome\")";
        reader.fault_in(lasers, "gated_by_panel", line, &found, &expected, advice.into());
    }
    if matches!(driver, Some(LaserDriver::Serial { sync_wire: true, .. })) {
        let line = reader.line_of_key(lasers, "sync_wire");
        let expected = format!("mode = \"{packed}\", where the wire's edges begin colour frames");
        let advice = "take it out: in this mode holod asks for each window by the panel's reports, and nobody looks at \
                      the wire";
        reader.fault_in(lasers, "sync_wire", line, &found, &expected, advice.into());
    }
}

/// The drivers, each with the keys of `[lasers]` that only some of them have.
const DRIVERS: [(&str, &[&str]); 4] = [
    ("simulated", &[]),
    ("serial", &["device", "sync_wire"]),
    ("ready-beam", &["device", "full_power_mw", "gated_by_panel", "accept_no_heartbeat"]),
    (
        "text",
        &[
            "devices",
            "profile",
            "profile_file",
            "transmission",
            "head_limit_mw",
            "gated_by_panel",
            "accept_no_heartbeat",
        ],
    ),
];

fn read_driver<'a>(
    reader: &Reader<'a>,
    lasers: Section<'a>,
    folder: &Path,
    provenance: &mut Provenance,
) -> Option<LaserDriver> {
    const PORT: &str = "a serial port's path";
    let drivers: Vec<_> = DRIVERS.iter().map(|driver| (driver.0, driver)).collect();
    let driver = reader.choice(lasers, "driver", &drivers, true);
    // Each key is read whatever the driver is, so that all its own faults are reported.
    let device = reader.text(lasers, "device", PORT);
    let devices = reader.texts(lasers, "devices", PORT);
    let sync_wire = reader.flag(lasers, "sync_wire", false);
    let full_power = reader.numbers(lasers, "full_power_mw", FULL_POWER, PerColour([lasers.has("full_power_mw"); 3]));
    let transmission = reader.numbers(lasers, "transmission", TRANSMISSION, PerColour([false; 3]));
    let profile = read_text_laser(reader, lasers, folder, provenance);
    let driver = driver?;
    let (name, own) = *driver.value;
    let keys: BTreeSet<_> = DRIVERS.iter().flat_map(|(_, keys)| *keys).collect();
    for key in keys {
        if lasers.has(key) && !own.contains(key) {
            let of: Vec<_> = DRIVERS.iter().filter(|(_, keys)| keys.contains(key)).map(|(name, _)| *name).collect();
            let found = format!("a key that the driver \"{name}\" does not have");
            let advice = format!("take {key} out, or write driver = \"{}\"", of.join("\" or \""));
            let line = reader.line_of_key(lasers, key);
            reader.fault_in(lasers, key, line, &found, "only keys of the chosen driver", advice);
        }
    }
    let missing = |key: &str, expected: &str, example: &str| {
        if !lasers.has(key) {
            let advice = format!("write for example {example}");
            reader.fault_in(lasers, key, driver.line, "nothing", expected, advice);
        }
    };
    match name {
        "simulated" => Some(LaserDriver::Simulated),
        "serial" => {
            missing("device", PORT, "device = \"/dev/holod-lasers\"");
            Some(LaserDriver::Serial { path: device?.value.into(), sync_wire })
        }
        "ready-beam" => {
            missing("device", PORT, "device = \"/dev/holod-lasers\"");
            missing(
                "full_power_mw",
                "each colour's power at the panel at 100 %",
                "full_power_mw = { red = ..., green = ..., blue = ... }, as measured",
            );
            let [Some(red), Some(green), Some(blue)] = full_power.0 else { return None };
            let full_power_uw = PerColour([red, green, blue]).map(|power| (power.value * 1e3).round() as u32);
            Some(LaserDriver::ReadyBeam { path: device?.value.into(), full_power_uw })
        }
        _ => {
            missing("devices", "a serial port for each laser", "devices = { green = \"/dev/holod-green\" }");
            if !lasers.has("profile_file") {
                missing("profile", "how the lasers are spoken to", "profile = \"cobolt\", or profile_file");
            }
            for (index, colour) in Colour::ALL.into_iter().enumerate() {
                let Some(path) = devices[colour] else { continue };
                if devices.0[..index].iter().flatten().any(|other| other.value == path.value) {
                    let advice = "give each laser its own port".into();
                    let key = format!("devices.{colour}");
                    reader.fault_in(lasers, &key, path.line, "a port named twice", "one laser to a port", advice);
                }
            }
            for colour in Colour::ALL {
                if let (Some(share), None) = (transmission[colour], devices[colour]) {
                    let (key, advice) =
                        (format!("transmission.{colour}"), "name its port in devices, or take this out");
                    reader.fault_in(lasers, &key, share.line, "that of no laser", "a laser of it", advice.into());
                }
            }
            let paths = devices.map(|path| path.map(|path| path.value.into()));
            paths.0.iter().any(Option::is_some).then_some(())?;
            let transmission_ppb =
                transmission.map(|share| share.map_or(1e9, |share| share.value * 1e9).round() as u32);
            Some(LaserDriver::Text { profile: Box::new(profile?), paths, transmission_ppb })
        }
    }
}

/// Whether the rig file accepts, in words, lasers that stay lit when holod dies.
fn read_acceptance<'a>(reader: &Reader<'a>, lasers: Section<'a>, driver: Option<&LaserDriver>) -> bool {
    let expected = format!("the words {ACCEPTANCE:?}");
    let words = reader.text(lasers, "accept_no_heartbeat", &expected);
    let accepted = words.is_some_and(|words| words.value == ACCEPTANCE);
    let needed = driver.is_some_and(|driver| !driver.has_heartbeat());
    if needed && !accepted {
        let found = words.map_or("nothing".into(), |words| format!("{:?}", words.value));
        let advice = format!(
            "these lasers have no heartbeat: they stay lit when holod is killed or the computer hangs. Where the bench is \
             safe with that, write accept_no_heartbeat = {ACCEPTANCE:?}"
        );
        let line = words.and_then(|words| words.line);
        reader.fault_in(lasers, "accept_no_heartbeat", line, &found, &expected, advice);
    }
    accepted
}

/// The profile that `profile` or `profile_file` names.
fn read_text_laser<'a>(
    reader: &Reader<'a>,
    lasers: Section<'a>,
    folder: &Path,
    provenance: &mut Provenance,
) -> Option<TextLaserProfile> {
    let choices: Vec<_> = TextLaserProfile::names().map(|name| (name, name)).collect();
    let named = reader.choice(lasers, "profile", &choices, false);
    let file = reader.text(lasers, "profile_file", "a TOML file's path");
    if let (Some(_), Some(file)) = (named, file) {
        let advice = "remove profile, or profile_file".into();
        reader.fault_in(lasers, "profile_file", file.line, "a second profile", "one profile", advice);
    }
    let Some(file) = file else { return TextLaserProfile::named(named?.value).cloned() };
    let path = provenance.laser_profile_file.insert(folder.join(file.value));
    let text = reader.of_file(lasers, "profile_file", file.line, read_text(path))?;
    match TextLaserProfile::parse(&text, path) {
        Ok(profile) => Some(profile),
        Err(error) => {
            for fault in error.faults {
                let place = fault.line.map_or(String::new(), |line| format!(" line {line}"));
                let found = format!("{}{place}, {}: {}", path.display(), fault.key, fault.found);
                reader.fault_in(lasers, "profile_file", file.line, &found, &fault.expected, fault.advice);
            }
            None
        }
    }
}

fn read_tracker<'a>(
    reader: &Reader<'a>,
    tracker: Section<'a>,
    read_spec: &dyn Fn(&str) -> Result<String, Vec<Fault>>,
) -> Option<Tracker> {
    let default = Rig::default().tracker;
    let spec = reader.text(tracker, "spec", "a tracker spec, as on the command line").and_then(|spec| {
        let read = read_spec(spec.value);
        read.map_err(|faults| {
            for fault in faults {
                reader.fault_in(tracker, "spec", spec.line, &fault.found, &fault.expected, fault.advice);
            }
        })
        .ok()
    });
    let eye = reader.choice(tracker, "eye", &Eye::NAMES, false);
    let scale = reader.number(tracker, "scale_mm_per_unit", SCALE);
    let fallback_mm = reader.number(tracker, "fallback_mm", FALLBACK);
    let hold_ms = reader.number(tracker, "hold_ms", HOLD);
    Some(Tracker {
        spec,
        eye: eye.map_or(default.eye, |eye| eye.value),
        scale: scale.map(|scale| scale.value),
        fallback: fallback_mm.map_or(default.fallback, |mm| PupilDiameter::from_mm(mm.value as f32)),
        hold: hold_ms.map_or(default.hold, |ms| milliseconds(ms.value)),
    })
}

fn read_model<'a>(reader: &Reader<'a>, model: Section<'a>, folder: &Path) -> Option<Model> {
    let network = reader.choice(model, "network", &WeightsChoice::BUILT_IN, false);
    let file = reader.text(model, "weights_file", "a safetensors file's path").map(|path| {
        let file = folder.join(path.value);
        let there = plain_file(&file).map(|_| file);
        Found { value: reader.of_file(model, "weights_file", path.line, there), line: path.line }
    });
    if let (Some(_), Some(file)) = (&network, &file) {
        let expected = "either a built-in network or a weights file";
        let advice = "remove network, or weights_file".into();
        reader.fault_in(model, "weights_file", file.line, "a second network", expected, advice);
    }
    let weights = match file.and_then(|file| file.value) {
        Some(file) => WeightsChoice::File(file),
        None => network.map_or(WeightsChoice::Standard, |network| network.value),
    };
    let gpu = reader.text(model, "gpu", "a part of a GPU's name, or its place on the PCI bus");
    let step_mm = reader.number(model, "pupil_step_mm", PUPIL_STEP);
    Some(Model {
        weights,
        gpu: gpu.map(|gpu| gpu.value.to_owned()),
        pupil_step: step_mm.map(|mm| Metres(mm.value / 1e3)),
    })
}

fn milliseconds(ms: f64) -> TimeNs {
    TimeNs((ms * 1e6).round() as i64)
}

/// A figure to three decimals, without the zeros at its end.
fn shown(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}

/// The 64-bit FNV-1a hash: it tells two rig files apart in a log, and nothing more.
fn fnv1a(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}
