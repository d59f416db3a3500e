//! `[panel]`: its pixels, and what the video frame has around them.

use crate::rig::VideoMargins;
use crate::rig::profile::PanelProfile;
use crate::rig::reader::Span;
use crate::toml_reader::Section;
use crate::{Metres, Resolution};

/// The keys that a panel profile gives.
pub(super) const PROFILE_KEYS: [&str; 10] = [
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

pub(super) fn read_profile(panel: &Section<'_>) -> Option<&'static PanelProfile> {
    let choices: Vec<_> = PanelProfile::all().iter().map(|profile| (profile.name, profile)).collect();
    Some(panel.choice("profile", &choices, false)?.value)
}

pub(super) fn read_pixels(panel: &Section<'_>) -> Option<(Resolution, Metres)> {
    let [width, height] = ["width_px", "height_px"].map(|key| {
        let pixels = panel.required_integer(key, PIXELS)?;
        if pixels.value % 2 == 0 {
            return Some(pixels.value);
        }
        let advice = "leave out the last row or column of the panel";
        pixels.fault(pixels.value, "an even number of pixels", advice);
        None
    });
    let pitch_um = panel.required_number("pixel_pitch_um", PITCH);
    Some((Resolution { width: width?, height: height? }, Metres(pitch_um?.value / 1e6)))
}

pub(super) fn read_video_margins(panel: &Section<'_>, resolution: Option<Resolution>) -> Option<VideoMargins> {
    // Before the panel, and behind it.
    let read = |[size_key, first_key, own_key]: [&'static str; 3], own: Option<usize>| {
        let first = if panel.gives(first_key) { panel.required_integer(first_key, MARGIN)?.value } else { 0 };
        if !panel.gives(size_key) {
            if first == 0 {
                return Some((0, 0));
            }
            let line = panel.line_of(first_key);
            let expected = format!("{size_key} beside it, the size of the video frame");
            let advice = format!("add {size_key}, or take {first_key} out");
            panel.fault_at(first_key, line, &format!("{first_key} alone"), &expected, advice);
            return None;
        }
        let size = panel.required_integer(size_key, PIXELS)?;
        let behind = size.value.checked_sub(first + own?);
        if behind.is_none() {
            let least = first + own?;
            let expected = format!("at least {least} px, {own_key} and {first_key} together");
            let advice = match size.line {
                Some(_) => format!("{size_key} is the size of the mode that the panel's video input takes"),
                None => format!("the panel's profile gives {size_key}: give it here, or take the profile out"),
            };
            panel.fault_at(size_key, size.line, &format!("{} px", size.value), &expected, advice);
        }
        Some((first, behind?))
    };
    let columns = read(["video_width_px", "video_left_px", "width_px"], resolution.map(|pixels| pixels.width));
    let rows = read(["video_height_px", "video_top_px", "height_px"], resolution.map(|pixels| pixels.height));
    let ((left, right), (top, bottom)) = (columns?, rows?);
    Some(VideoMargins { left, right, top, bottom })
}
