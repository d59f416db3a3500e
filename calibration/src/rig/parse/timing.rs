//! `[panel]` as a clock: which colours it shows, when and for how long.

use super::figures::{milliseconds, shown};
use crate::Colour;
use crate::rig::PanelMode;
use crate::rig::reader::Span;
use crate::toml_reader::Section;

const REFRESH: Span = Span::new(10.0, 2000.0, "Hz").slips(&[("millihertz", 1e-3)]);
const FRAMES_PER_COLOUR: Span = Span::new(1.0, 8.0, "video frames");
const SETTLE: Span = Span::new(0.0, 100.0, "ms").slips(&[("microseconds", 1e-3)]);
const LATENCY: Span = Span::new(0.0, 100.0, "ms").slips(&[("microseconds", 1e-3)]);

/// The panel as a clock.
#[derive(Clone, Copy)]
pub(super) struct FieldTiming {
    pub(super) refresh_hz: f64,
    pub(super) mode: PanelMode,
    pub(super) field_order: [Colour; 3],
    pub(super) channel_order: [Colour; 3],
    pub(super) frames_per_colour: u8,
    pub(super) settle_ms: f64,
    pub(super) latency_ms: f64,
    pub(super) field_ms: f64,
}

impl FieldTiming {
    pub(super) fn describe_field(&self) -> String {
        let mode = self.mode.name();
        format!("{} ms of one field ({} Hz, {mode})", shown(self.field_ms), self.refresh_hz)
    }

    /// What a window leaves free at the end of its field.
    pub(super) fn slack_ms(&self) -> f64 {
        self.mode.window_slack(milliseconds(self.field_ms)).0 as f64 / 1e6
    }

    pub(super) fn colour_frame_ms(&self) -> f64 {
        let fields = match self.mode {
            PanelMode::ChannelPacked => 3,
            PanelMode::FieldSequential => 3 * u32::from(self.frames_per_colour),
            PanelMode::Monochrome(_) => 1,
        };
        f64::from(fields) * self.field_ms
    }
}

pub(super) fn read_field_timing(panel: &Section<'_>) -> Option<FieldTiming> {
    let refresh_hz = panel.required_number("refresh_hz", REFRESH);
    let mode = read_mode(panel);
    let field_order = match mode {
        Some(PanelMode::Monochrome(_)) if !panel.has("field_order") => Some(Colour::ALL),
        _ => panel.colour_order("field_order"),
    };
    let channel_order = read_channel_order(panel, mode);
    let frames_per_colour = read_frames_per_colour(panel, mode);
    let settle_ms = panel.required_number("settle_ms", SETTLE);
    let latency_ms = panel.number("latency_ms", LATENCY).map_or(0.0, |found| found.value);
    let (refresh_hz, mode, settle_ms) = (refresh_hz?.value, mode?, settle_ms?);
    let field_ms = 1e3 / (refresh_hz * mode.fields_per_refresh());
    let (field_order, channel_order, frames_per_colour) = (field_order?, channel_order?, frames_per_colour?);
    let timing = FieldTiming {
        refresh_hz,
        mode,
        field_order,
        channel_order,
        frames_per_colour,
        settle_ms: settle_ms.value,
        latency_ms,
        field_ms,
    };
    if settle_ms.value >= field_ms {
        let expected = format!("less than the {}", timing.describe_field());
        let advice = "no phase would ever settle: correct the settle time or lower refresh_hz; by how much later a panel \
                      shows its video is panel.latency_ms";
        settle_ms.fault(format!("{} ms", settle_ms.value), &expected, advice);
    }
    Some(timing)
}

/// `mode`, with the colour that monochrome mode shows.
fn read_mode(panel: &Section<'_>) -> Option<PanelMode> {
    // Which colour monochrome mode shows, the other key says.
    let modes = [PanelMode::ChannelPacked, PanelMode::FieldSequential, PanelMode::Monochrome(Colour::Red)];
    let mode = panel.choice("mode", &modes.map(|mode| (mode.name(), mode)), true);
    let monochrome = mode.as_ref().is_some_and(|mode| matches!(mode.value, PanelMode::Monochrome(_)));
    let colours = Colour::ALL.map(|colour| (colour.name(), colour));
    let colour = panel.choice("colour", &colours, monochrome);
    match (mode?.value, colour) {
        (PanelMode::Monochrome(_), colour) => Some(PanelMode::Monochrome(colour?.value)),
        (other, Some(colour)) => {
            let found = format!("a single colour in {} mode", other.name());
            let advice = "take colour out, or write mode = \"monochrome\"";
            colour.fault(&found, "colour in monochrome mode only", advice);
            None
        }
        (mode, None) => Some(mode),
    }
}

fn read_channel_order(panel: &Section<'_>, mode: Option<PanelMode>) -> Option<[Colour; 3]> {
    if !panel.has("channel_order") {
        return Some(Colour::ALL);
    }
    let order = panel.colour_order("channel_order")?;
    if let Some(mode) = mode.filter(|&mode| mode != PanelMode::ChannelPacked) {
        let found = format!("an order of channels in {} mode", mode.name());
        let expected = "none outside channel-packed mode, where all channels carry one colour";
        let line = panel.line_of("channel_order");
        panel.fault_at("channel_order", line, &found, expected, "take it out");
        return None;
    }
    Some(order)
}

fn read_frames_per_colour(panel: &Section<'_>, mode: Option<PanelMode>) -> Option<u8> {
    if !panel.has("frames_per_colour") {
        return Some(1);
    }
    let frames = panel.required_integer("frames_per_colour", FRAMES_PER_COLOUR)?;
    if frames.value > 1
        && let Some(mode) = mode.filter(|&mode| mode != PanelMode::FieldSequential)
    {
        let found = format!("{} in {} mode", frames.value, mode.name());
        let advice = "take it out, or write mode = \"field-sequential\"";
        frames.fault(&found, "1 outside field-sequential mode", advice);
        return None;
    }
    u8::try_from(frames.value).ok()
}
