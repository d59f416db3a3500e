//! From a rig file's text to a [`Rig`].

use std::f64::consts::PI;
use std::path::Path;

use super::files::plain_file;
use super::profile::PanelProfile;
use super::reader::{Found, Reader, Section, Span};
use super::{
    Eye, LaserDriver, Lasers, Model, Panel, PanelMode, PhaseSign, Provenance, Rig, RigError, Tracker, WeightsChoice,
    flatness, lut,
};
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
            "refresh_hz",
            "mode",
            "field_order",
            "bit_depth",
            "phase_sign",
            "stroke_pi",
            "settle_ms",
            "lut_file",
            "flatness_file",
        ],
    ),
    (
        "optics",
        &[
            "wavelengths_nm",
            "eyepiece_focal_length_mm",
            "depth_far_m",
            "depth_far_dpt",
            "depth_near_m",
            "depth_near_dpt",
        ],
    ),
    ("lasers", &["driver", "device", "power_mw", "on_delay_ms", "lit_ms", "heartbeat_timeout_ms"]),
    ("tracker", &["spec", "eye", "scale_mm_per_unit", "fallback_mm", "hold_ms"]),
    ("model", &["network", "weights_file", "allow_optics_mismatch"]),
];

/// The keys that a panel profile gives.
const PROFILE_KEYS: [&str; 5] = ["width_px", "height_px", "pixel_pitch_um", "refresh_hz", "bit_depth"];

const PIXELS: Span = Span::new(64.0, 16384.0, "px");
const PITCH: Span = Span::new(1.0, 50.0, "µm").slips(&[("metres", 1e6), ("millimetres", 1e3), ("nanometres", 1e-3)]);
const REFRESH: Span = Span::new(10.0, 2000.0, "Hz").slips(&[("millihertz", 1e-3)]);
const BIT_DEPTH: Span = Span::new(8.0, 10.0, "bits");
const STROKE: Span = Span::new(0.5, 6.0, "π").slips(&[("radians", 1.0 / PI), ("degrees", 1.0 / 180.0)]);
const SETTLE: Span = Span::new(0.0, 100.0, "ms").slips(&[("microseconds", 1e-3)]);
const WAVELENGTH: Span = Span::new(380.0, 780.0, "nm").slips(&[("metres", 1e9), ("micrometres", 1e3)]);
const FOCAL_LENGTH: Span = Span::new(5.0, 500.0, "mm").slips(&[("metres", 1e3), ("micrometres", 1e-3)]);
const DEPTH_M: Span = Span::new(0.05, f64::INFINITY, "m");
const DEPTH_DPT: Span = Span::new(0.0, 20.0, "dioptres");
/// Below this a volume's two ends look alike to any eye.
const DEPTH_RANGE_MIN_DPT: f64 = 0.1;
const POWER: Span = Span::new(0.0, 500.0, "mW");
const ON_DELAY: Span = Span::new(0.0, 100.0, "ms");
const LIT: Span = Span::new(0.001, 100.0, "ms").slips(&[("microseconds", 1e-3)]);
const HEARTBEAT: Span = Span::new(5.0, 1000.0, "ms").slips(&[("seconds", 1e3)]);
const SCALE: Span = Span::new(1e-4, 100.0, "mm per unit");
const FALLBACK: Span = Span::new(1.0, 9.0, "mm").slips(&[("metres", 1e3), ("micrometres", 1e-3)]);
const HOLD: Span = Span::new(0.0, 60_000.0, "ms");
/// By how much a stated stroke may differ from that of a measured table.
const STROKE_TOLERANCE: f64 = 0.02;

/// Parses `text`; relative paths in it start at the folder of `origin`.
pub(super) fn parse(text: &str, origin: &Path) -> Result<Rig, RigError> {
    let mut reader = Reader::new(text);
    let document = reader.document();
    let rig = document.as_ref().and_then(|document| {
        let root = reader.root(document);
        read_rig(&mut reader, root, text, origin)
    });
    match rig {
        Some(rig) if reader.faults.is_empty() => Ok(rig),
        _ => {
            reader.faults.sort_by_key(|fault| fault.line.unwrap_or(usize::MAX));
            Err(RigError { origin: origin.display().to_string(), faults: reader.faults })
        }
    }
}

fn read_rig<'a>(reader: &mut Reader<'a>, root: Section<'a>, text: &str, origin: &Path) -> Option<Rig> {
    reader.reject_unknown(root, &LAYOUT);
    let name = match reader.text(root, "name", "a name for logs and reports") {
        Some(name) => name.value.to_owned(),
        None => origin.file_stem().map_or_else(|| "rig".into(), |stem| stem.to_string_lossy().into_owned()),
    };
    let [panel, optics, lasers, tracker, model] =
        [("panel", true), ("optics", true), ("lasers", true), ("tracker", false), ("model", false)]
            .map(|(name, required)| reader.section(root, name, required));
    for section in [panel, optics, lasers, tracker, model] {
        reader.reject_unknown(section, &LAYOUT);
    }
    let folder = origin.parent().unwrap_or(Path::new(""));
    let mut provenance =
        Provenance { origin: origin.display().to_string(), text_hash: Some(fnv1a(text)), ..Provenance::default() };

    // Each part is read whatever became of the others, so that one report holds all the faults.
    let profile = read_profile(reader, panel);
    provenance.panel_profile = profile.map(|profile| profile.name);
    let mut panel = panel.with_profile(profile.map(PanelProfile::values));
    if panel.has("profile") && profile.is_none() {
        panel = panel.excusing(&PROFILE_KEYS);
    }
    let pixels = read_pixels(reader, panel);
    let timing = read_field_timing(reader, panel);
    let phase = read_phase(reader, panel, pixels.map(|(resolution, _)| resolution), folder, &mut provenance);
    let geometry = read_optics(reader, optics, pixels);
    let lasers = read_lasers(reader, lasers, timing);
    let tracker = read_tracker(reader, tracker);
    let model = read_model(reader, model, folder);

    let (timing, phase) = (timing?, phase?);
    let panel = Panel {
        refresh_hz: timing.refresh_hz,
        mode: timing.mode,
        field_order: timing.field_order,
        settle: milliseconds(timing.settle_ms.value),
        bit_depth: phase.bit_depth,
        phase_sign: phase.sign,
        stroke_rad: phase.stroke_rad,
        lut_rad: phase.lut_rad,
        flatness_rad: phase.flatness_rad,
    };
    Some(Rig { name, panel, geometry: geometry?, lasers: lasers?, tracker: tracker?, model: model?, provenance })
}

fn read_profile<'a>(reader: &mut Reader<'a>, panel: Section<'a>) -> Option<&'static PanelProfile> {
    let choices: Vec<_> = PanelProfile::all().iter().map(|profile| (profile.name, profile)).collect();
    Some(reader.choice(panel, "profile", &choices, false)?.value)
}

fn read_pixels<'a>(reader: &mut Reader<'a>, panel: Section<'a>) -> Option<(Resolution, Metres)> {
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

/// The panel as a clock.
#[derive(Clone, Copy)]
struct FieldTiming {
    refresh_hz: f64,
    mode: PanelMode,
    field_order: [Colour; 3],
    settle_ms: Found<f64>,
    field_ms: f64,
}

impl FieldTiming {
    fn describe_field(&self) -> String {
        let mode = self.mode.name();
        format!("{} ms of one field ({} Hz, {mode})", shown(self.field_ms), self.refresh_hz)
    }
}

fn read_field_timing<'a>(reader: &mut Reader<'a>, panel: Section<'a>) -> Option<FieldTiming> {
    let modes = [PanelMode::ChannelPacked, PanelMode::FieldSequential].map(|mode| (mode.name(), mode));
    let refresh_hz = reader.required_number(panel, "refresh_hz", REFRESH);
    let mode = reader.choice(panel, "mode", &modes, true);
    let field_order = reader.colour_order(panel, "field_order");
    let settle_ms = reader.required_number(panel, "settle_ms", SETTLE);
    let (refresh_hz, mode, settle_ms) = (refresh_hz?.value, mode?.value, settle_ms?);
    let field_ms = 1e3 / (refresh_hz * mode.fields_per_refresh());
    let timing = FieldTiming { refresh_hz, mode, field_order: field_order?, settle_ms, field_ms };
    if settle_ms.value >= field_ms {
        let expected = format!("less than the {}", timing.describe_field());
        let advice = "no phase would ever settle: correct the settle time or lower refresh_hz".into();
        reader.fault_in(panel, "settle_ms", settle_ms.line, &format!("{} ms", settle_ms.value), &expected, advice);
    }
    Some(timing)
}

/// The panel as a phase modulator.
struct Phase {
    bit_depth: u8,
    sign: PhaseSign,
    stroke_rad: PerColour<f64>,
    lut_rad: PerColour<Option<Vec<f64>>>,
    flatness_rad: PerColour<Option<Vec<f32>>>,
}

fn read_phase<'a>(
    reader: &mut Reader<'a>,
    panel: Section<'a>,
    resolution: Option<Resolution>,
    folder: &Path,
    provenance: &mut Provenance,
) -> Option<Phase> {
    let bit_depth = reader.required_integer(panel, "bit_depth", BIT_DEPTH).and_then(|bits| match bits.value {
        8 => Some(8),
        10 => Some(10),
        other => {
            let advice = "holod sends levels of 8 or 10 bits".into();
            reader.fault_in(panel, "bit_depth", bits.line, &other.to_string(), "8 or 10", advice);
            None
        }
    });
    let signs = [("positive", PhaseSign::Positive), ("negative", PhaseSign::Negative)];
    let sign = reader.choice(panel, "phase_sign", &signs, true);
    let lut_paths = reader.texts(panel, "lut_file", "a CSV file's path");
    let needs_stroke = PerColour(lut_paths.0.map(|path| path.is_none()));
    let stroke_pi = reader.numbers(panel, "stroke_pi", STROKE, needs_stroke);
    let flatness_paths = reader.texts(panel, "flatness_file", "a PNG file's path");

    let mut lut_rad = PerColour([const { None }; 3]);
    let mut flatness_rad = PerColour([const { None }; 3]);
    let mut stroke_rad = stroke_pi.map(|stroke| stroke.map(|stroke| stroke.value * PI));
    for colour in Colour::ALL {
        if let (Some(path), Some(bit_depth)) = (lut_paths[colour], bit_depth) {
            let key = format!("lut_file.{colour}");
            let file = folder.join(path.value);
            lut_rad[colour] = reader.of_file(panel, &key, path.line, lut::read(&file, bit_depth));
            if let Some(lut_rad) = &lut_rad[colour] {
                let range_rad = lut_rad[lut_rad.len() - 1] - lut_rad[0];
                check_lut(reader, panel, &key, path.line, range_rad, sign.map(|sign| sign.value), stroke_pi[colour]);
                stroke_rad[colour] = Some(range_rad.abs());
            }
            provenance.lut_files[colour] = Some(file);
        }
        if let (Some(path), Some(resolution)) = (flatness_paths[colour], resolution) {
            let file = folder.join(path.value);
            let read = flatness::read(&file, resolution);
            flatness_rad[colour] = reader.of_file(panel, &format!("flatness_file.{colour}"), path.line, read);
            provenance.flatness_files[colour] = Some(file);
        }
    }
    let stroke_rad = PerColour([stroke_rad.0[0]?, stroke_rad.0[1]?, stroke_rad.0[2]?]);
    Some(Phase { bit_depth: bit_depth?, sign: sign?.value, stroke_rad, lut_rad, flatness_rad })
}

/// Judges a measured table against what the rig file says in words.
fn check_lut<'a>(
    reader: &mut Reader<'a>,
    panel: Section<'a>,
    key: &str,
    line: Option<usize>,
    range_rad: f64,
    sign: Option<PhaseSign>,
    stroke_pi: Option<Found<f64>>,
) {
    let range_pi = range_rad / PI;
    if range_pi.abs() < STROKE.min || range_pi.abs() > STROKE.max {
        let expected = format!("a range of {} to {} π", STROKE.min, STROKE.max);
        let found = format!("a table whose phase changes by {} π", shown(range_pi));
        reader.fault_in(
            panel,
            key,
            line,
            &found,
            &expected,
            "give its phases in radians, not unwrapped to turns".into(),
        );
        return;
    }
    let found = format!("a table whose phase goes by {} π from the lowest level to the highest", shown(range_pi));
    if let Some(stroke) = stroke_pi.filter(|stroke| (range_pi.abs() / stroke.value - 1.0).abs() > STROKE_TOLERANCE) {
        let expected = format!("the {} π that stroke_pi states", shown(stroke.value));
        reader.fault_in(panel, key, line, &found, &expected, "take stroke_pi out: the table says it".into());
    }
    let (expected, other) = match sign {
        Some(PhaseSign::Positive) if range_rad < 0.0 => ("a rising table, as phase_sign is \"positive\"", "negative"),
        Some(PhaseSign::Negative) if range_rad > 0.0 => ("a falling table, as phase_sign is \"negative\"", "positive"),
        _ => return,
    };
    let advice = format!("write phase_sign = \"{other}\", or turn the table round");
    reader.fault_in(panel, key, line, &found, expected, advice);
}

fn read_optics<'a>(
    reader: &mut Reader<'a>,
    optics: Section<'a>,
    pixels: Option<(Resolution, Metres)>,
) -> Option<DisplayGeometry> {
    let wavelengths_nm = reader.numbers(optics, "wavelengths_nm", WAVELENGTH, PerColour([true; 3]));
    let focal_length_mm = reader.required_number(optics, "eyepiece_focal_length_mm", FOCAL_LENGTH);
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
            let advice = "depths are in metres or dioptres: 350 mm is depth_near_m = 0.35".into();
            reader.fault_in(optics, "depth_near", line, &found, &expected, advice);
        }
    }
    let [Some(red), Some(green), Some(blue)] = wavelengths_nm.0 else { return None };
    let (resolution, pixel_pitch) = pixels?;
    Some(DisplayGeometry {
        resolution,
        pixel_pitch,
        wavelengths: PerColour([red, green, blue]).map(|wavelength_nm| Metres(wavelength_nm.value / 1e9)),
        eyepiece_focal_length: Metres(focal_length_mm?.value / 1e3),
        depth_far: depth_far?.value,
        depth_near: depth_near?.value,
    })
}

/// One end of the depth range, in metres or in dioptres; `default` where the rig file gives neither.
fn read_depth<'a>(
    reader: &mut Reader<'a>,
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

fn read_lasers<'a>(reader: &mut Reader<'a>, lasers: Section<'a>, timing: Option<FieldTiming>) -> Option<Lasers> {
    let driver = read_driver(reader, lasers);
    let power_mw = reader.numbers(lasers, "power_mw", POWER, PerColour([true; 3]));
    let on_delay_ms = reader.required_number(lasers, "on_delay_ms", ON_DELAY);
    let lit_ms = reader.required_number(lasers, "lit_ms", LIT);
    let heartbeat_ms = reader.required_number(lasers, "heartbeat_timeout_ms", HEARTBEAT);

    if let (Some(timing), Some(on_delay_ms), Some(lit_ms)) = (timing, on_delay_ms, lit_ms) {
        let before_ms = timing.settle_ms.value + on_delay_ms.value;
        let end_ms = before_ms + lit_ms.value;
        if timing.settle_ms.value < timing.field_ms && end_ms > timing.field_ms {
            let settle = shown(timing.settle_ms.value);
            let found = format!(
                "settle {settle} + on_delay {} + lit {} = {} ms",
                shown(on_delay_ms.value),
                shown(lit_ms.value),
                shown(end_ms)
            );
            let expected = format!("an end within the {}", timing.describe_field());
            let room_ms = timing.field_ms - before_ms;
            let advice = if room_ms >= LIT.min {
                format!("write lit_ms = {} at most", (room_ms * 1e3).floor() / 1e3)
            } else {
                "shorten on_delay_ms or lower panel.refresh_hz".into()
            };
            reader.fault_in(lasers, "lit_ms", lit_ms.line, &found, &expected, advice);
        }
    }
    if let (Some(timing), Some(heartbeat_ms)) = (timing, heartbeat_ms) {
        let least_ms = 2.0 * 3.0 * timing.field_ms;
        if heartbeat_ms.value < least_ms {
            let expected = format!("at least two colour frames, {} ms", shown(least_ms));
            let advice = "lengthen it, or the box goes dark between two frames".into();
            let found = format!("{} ms", heartbeat_ms.value);
            reader.fault_in(lasers, "heartbeat_timeout_ms", heartbeat_ms.line, &found, &expected, advice);
        }
    }
    let [Some(red), Some(green), Some(blue)] = power_mw.0 else { return None };
    Some(Lasers {
        driver: driver?,
        power_mw: PerColour([red.value, green.value, blue.value]),
        on_delay: milliseconds(on_delay_ms?.value),
        width: milliseconds(lit_ms?.value),
        heartbeat_timeout: milliseconds(heartbeat_ms?.value),
    })
}

fn read_driver<'a>(reader: &mut Reader<'a>, lasers: Section<'a>) -> Option<LaserDriver> {
    const EXPECTED: &str = "a serial port's path";
    let driver = reader.choice(lasers, "driver", &[("simulated", false), ("serial", true)], true);
    let device = reader.text(lasers, "device", EXPECTED);
    let driver = driver?;
    match (driver.value, device) {
        (false, None) => Some(LaserDriver::Simulated),
        (true, Some(device)) => Some(LaserDriver::Serial { path: device.value.into() }),
        (false, Some(device)) => {
            let advice = "write driver = \"serial\", or take device out".into();
            let found = "a device for simulated lasers";
            reader.fault_in(lasers, "device", device.line, found, "no device, or the driver \"serial\"", advice);
            None
        }
        (true, None) => {
            if !lasers.has("device") {
                let advice = "write for example device = \"/dev/holod-lasers\"".into();
                reader.fault_in(lasers, "device", driver.line, "nothing", EXPECTED, advice);
            }
            None
        }
    }
}

fn read_tracker<'a>(reader: &mut Reader<'a>, tracker: Section<'a>) -> Option<Tracker> {
    let default = Rig::default().tracker;
    let spec = reader.text(tracker, "spec", "a tracker spec, as on the command line");
    let eyes = [("left", Eye::Left), ("right", Eye::Right), ("both", Eye::Both), ("better", Eye::Better)];
    let eye = reader.choice(tracker, "eye", &eyes, false);
    let scale = reader.number(tracker, "scale_mm_per_unit", SCALE);
    let fallback_mm = reader.number(tracker, "fallback_mm", FALLBACK);
    let hold_ms = reader.number(tracker, "hold_ms", HOLD);
    Some(Tracker {
        spec: spec.map(|spec| spec.value.into()),
        eye: eye.map_or(default.eye, |eye| eye.value),
        scale: scale.map(|scale| scale.value),
        fallback: fallback_mm.map_or(default.fallback, |mm| PupilDiameter::from_mm(mm.value as f32)),
        hold: hold_ms.map_or(default.hold, |ms| milliseconds(ms.value)),
    })
}

fn read_model<'a>(reader: &mut Reader<'a>, model: Section<'a>, folder: &Path) -> Option<Model> {
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
    let allow_optics_mismatch = reader.flag(model, "allow_optics_mismatch", false);
    let weights = match file.and_then(|file| file.value) {
        Some(file) => WeightsChoice::File(file),
        None => network.map_or(WeightsChoice::Standard, |network| network.value),
    };
    Some(Model { weights, allow_optics_mismatch })
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
