//! From a rig file's text to a [`Rig`]: a file for each of its tables, of which the panel's is read in three parts.

mod figures;
mod laser_driver;
mod lasers;
mod model;
mod optics;
mod panel;
mod phase;
mod timing;
mod tracker;

use std::path::Path;

use figures::milliseconds;
use laser_driver::read_driver;
use lasers::read_lasers;
use model::read_model;
use optics::read_optics;
pub use optics::{DEPTH_DPT, FOCAL_LENGTH, WAVELENGTH};
pub use panel::PITCH;
use panel::{PROFILE_KEYS, read_pixels, read_profile, read_video_margins};
use phase::{read_levels, read_phase};
use timing::read_field_timing;
pub(super) use tracker::SCALE;
use tracker::read_tracker;

use super::profile::PanelProfile;
use super::{LaserDriver, Panel, Provenance, Rig, RigError, SpecReader};
use crate::toml_reader::{self, Section};

const NAME: &str = "a name for logs and reports";

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
            "latency_ms",
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

/// Parses `text`; relative paths in it start at the folder of `origin`.
pub(super) fn parse(text: &str, origin: &Path, read_spec: SpecReader<'_>) -> Result<Rig, RigError> {
    let rig = toml_reader::read(text, |root| read_rig(root, text, origin, read_spec));
    rig.map_err(|faults| RigError { origin: origin.display().to_string(), faults })
}

/// The lasers of a rig file's text, whatever else is wrong with it; none where it does not say them right.
pub(super) fn laser_driver(text: &str, origin: &Path) -> Option<LaserDriver> {
    let mut driver = None;
    let folder = origin.parent().unwrap_or(Path::new(""));
    let _faults = toml_reader::read(text, |root| {
        let lasers = root.required_section("lasers");
        driver = read_driver(&lasers, folder, &mut Provenance::default());
        Some(())
    });
    driver
}

fn read_rig(root: &Section<'_>, text: &str, origin: &Path, read_spec: SpecReader<'_>) -> Option<Rig> {
    root.check_layout(&LAYOUT, &RETIRED);
    let name = match root.text("name", NAME) {
        Some(name) => {
            if let Some(control) = name.value.chars().find(|character| character.is_control()) {
                name.fault(format!("a text with the control character {control:?}"), NAME, "take that out");
            }
            name.value.to_owned()
        }
        None => origin.file_stem().map_or_else(|| "rig".into(), |stem| stem.to_string_lossy().into_owned()),
    };
    // A file that says nothing of the bench is of the built-in one: all of it, since its parts belong together.
    let built_in = !["panel", "optics", "lasers"].into_iter().any(|name| root.has(name))
        && ["tracker", "model"].into_iter().any(|name| root.has(name));
    let [panel, optics, lasers, tracker, model] =
        [("panel", true), ("optics", true), ("lasers", true), ("tracker", false), ("model", false)].map(
            |(name, required)| if required && !built_in { root.required_section(name) } else { root.section(name) },
        );
    for section in [&panel, &optics, &lasers, &tracker, &model] {
        section.check_layout(&LAYOUT, &RETIRED);
    }
    let folder = origin.parent().unwrap_or(Path::new(""));
    let mut provenance =
        Provenance { origin: origin.display().to_string(), text_hash: Some(fnv1a(text)), ..Provenance::default() };

    if built_in {
        let tracker = read_tracker(&tracker, &|spec| read_spec(spec, folder));
        let model = read_model(&model, folder);
        return Some(Rig { name, tracker: tracker?, model: model?, provenance, ..Rig::default() });
    }
    // Each part is read whatever became of the others, so that one report holds all the faults.
    let profile = read_profile(&panel);
    provenance.panel_profile = profile.map(|profile| profile.name);
    let mut panel = panel.with_behind(profile.map(PanelProfile::values));
    if panel.has("profile") && profile.is_none() {
        panel = panel.excusing(&PROFILE_KEYS);
    }
    let pixels = read_pixels(&panel);
    let video_margins = read_video_margins(&panel, pixels.map(|(resolution, _)| resolution));
    let timing = read_field_timing(&panel);
    let levels = read_levels(&panel, timing.map(|timing| timing.mode));
    let phase = read_phase(&panel, levels, pixels.map(|(resolution, _)| resolution), folder, &mut provenance);
    let optics = read_optics(&optics, pixels);
    let lasers = read_lasers(&lasers, timing, folder, &mut provenance);
    let tracker = read_tracker(&tracker, &|spec| read_spec(spec, folder));
    let model = read_model(&model, folder);

    let (timing, (bit_depth, packing), phase) = (timing?, levels?, phase?);
    let (geometry, relay_magnification) = optics?;
    let panel = Panel {
        refresh_hz: timing.refresh_hz,
        mode: timing.mode,
        field_order: timing.field_order,
        channel_order: timing.channel_order,
        frames_per_colour: timing.frames_per_colour,
        settle: milliseconds(timing.settle_ms),
        latency: milliseconds(timing.latency_ms),
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

/// The 64-bit FNV-1a hash: it tells two rig files apart in a log, and nothing more.
fn fnv1a(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}
