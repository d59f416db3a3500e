//! `[lasers]`: their powers, and when they are lit.

use std::path::Path;

use super::figures::{milliseconds, shown};
use super::laser_driver::{FULL_POWER, POWER_SLIPS, read_acceptance, read_driver};
use super::timing::FieldTiming;
use crate::rig::reader::Span;
use crate::rig::{LaserDriver, Lasers, PanelMode, Provenance};
use crate::toml_reader::{Found, Section};
use crate::{Colour, PerColour};

const POWER: Span = Span::new(0.0, Lasers::POWER_MAX_MW, "mW").slips(POWER_SLIPS);
/// Lasers are told whole microwatts: less than one is darkness.
const POWER_LIT_MIN_MW: f64 = 0.001;
/// How many times below its limit a power still seems to be meant, where it would be that in another unit.
const POWER_BELOW_LIMIT_MAX: f64 = 100.0;
const ON_DELAY: Span = Span::new(0.0, 100.0, "ms");
const LIT: Span = Span::new(0.001, 100.0, "ms").slips(&[("microseconds", 1e-3)]);
const HEARTBEAT: Span = Span::new(5.0, 1000.0, "ms").slips(&[("seconds", 1e3)]);
const STALL: Span = Span::new(10.0, 60_000.0, "ms").slips(&[("seconds", 1e3)]);

/// The keys of a window, which switches no laser that is on while it is armed.
const WINDOW_KEYS: [&str; 2] = ["on_delay_ms", "lit_ms"];

pub(super) fn read_lasers(
    lasers: &Section<'_>,
    timing: Option<FieldTiming>,
    folder: &Path,
    provenance: &mut Provenance,
) -> Option<Lasers> {
    let driver = read_driver(lasers, folder, provenance);
    let gated_by_panel = lasers.flag("gated_by_panel", false);
    let accept_no_heartbeat = read_acceptance(lasers, driver.as_ref());
    // Of a driver that is faulty these keys alone tell whether it has such lasers.
    let [may_lack_lasers, may_be_on] = match &driver {
        Some(driver) => [true, !driver.gates_fields()],
        None => [lasers.has("devices"), lasers.has("devices") || lasers.has("full_power_mw")],
    };
    let is_there = |colour: Colour| driver.as_ref().map_or(!may_lack_lasers, |driver| driver.has(colour));
    // Of a driver that does not have the key that is a fault already.
    let gated_by_panel = gated_by_panel && may_be_on;
    let lasers = &if may_be_on { lasers.excusing(&WINDOW_KEYS) } else { lasers.clone() };
    let power_mw = lasers.numbers("power_mw", POWER, PerColour(Colour::ALL.map(is_there)));
    let power_limit_mw = lasers.numbers("power_limit_mw", POWER, PerColour([false; 3]));
    check_powers(&power_mw, &power_limit_mw);
    let head_limit_mw = read_head_limits(lasers, driver.as_ref(), &power_mw);
    let on_delay_ms = lasers.required_number("on_delay_ms", ON_DELAY);
    let lit_ms = lasers.required_number("lit_ms", LIT);
    let heartbeat_ms = lasers.required_number("heartbeat_timeout_ms", HEARTBEAT);
    let stall_ms = lasers.number("stall_timeout_ms", STALL);

    if let Some(timing) = timing.filter(|_| gated_by_panel) {
        check_colour_order(lasers, timing);
    }
    check_mode(lasers, timing, driver.as_ref(), gated_by_panel);
    // Where no window switches lasers, what is lit of a field begins when its phase has settled, whatever is written.
    let on_delay_ms = if may_be_on { Some(0.0) } else { on_delay_ms.map(|found| found.value) };
    let whole_field = || Some(lasers.assumed("lit_ms", window_room_ms(timing?, on_delay_ms?).max(LIT.min)));
    let lit_ms = if may_be_on { whole_field() } else { lit_ms };
    if let (Some(timing), Some(on_delay_ms), Some(lit_ms)) = (timing, on_delay_ms, &lit_ms) {
        check_window(lasers, timing, on_delay_ms, lit_ms, may_be_on);
    }
    if let (Some(timing), Some(heartbeat_ms)) = (timing, &heartbeat_ms) {
        check_heartbeat(timing, heartbeat_ms);
    }
    if let (Some(timing), Some(stall_ms)) = (timing, &stall_ms) {
        check_stall(timing, stall_ms);
    }
    let driver = driver?;
    let power_of = |colour: Colour| match &power_mw[colour] {
        Some(power) => Some(power.value),
        None => (!driver.has(colour)).then_some(0.0),
    };
    let power_mw = PerColour([power_of(Colour::Red)?, power_of(Colour::Green)?, power_of(Colour::Blue)?]);
    Some(Lasers {
        driver,
        power_mw,
        power_limit_mw: power_limit_mw.map(|limit| limit.map(|limit| limit.value)),
        head_limit_mw,
        on_delay: milliseconds(on_delay_ms?),
        width: milliseconds(lit_ms?.value),
        heartbeat_timeout: milliseconds(heartbeat_ms?.value),
        stall_timeout: stall_ms.map(|stall| milliseconds(stall.value)),
        gated_by_panel,
        accept_no_heartbeat,
    })
}

/// Judges each colour's power by what a laser can be told and by the bench's own limit.
fn check_powers(power_mw: &PerColour<Option<Found<'_, f64>>>, power_limit_mw: &PerColour<Option<Found<'_, f64>>>) {
    for colour in Colour::ALL {
        if let Some(power) = power_mw[colour].as_ref().filter(|power| Lasers::whole_uw(power.value) == 0)
            && power.value > 0.0
        {
            let found = format!("{} mW", power.value);
            let expected = format!("0, or {POWER_LIT_MIN_MW} mW at least: lasers are told whole microwatts");
            let advice = format!("write {POWER_LIT_MIN_MW} and put a filter before the laser, or 0 to keep it dark");
            power.fault(&found, &expected, advice);
        }
        if let (Some(power), Some(limit)) = (&power_mw[colour], &power_limit_mw[colour])
            && power.value > limit.value
        {
            let expected = format!("{} mW at most, as power_limit_mw says", limit.value);
            let allowed = Span::new(limit.value / POWER_BELOW_LIMIT_MAX, limit.value, "mW").slips(POWER_SLIPS);
            let lower = || "lower it; power_limit_mw is what this bench's optics allow an eye".into();
            let advice = allowed.slip(power.value).unwrap_or_else(lower);
            let found = format!("{} mW", power.value);
            power.fault(&found, &expected, advice);
        }
    }
}

/// Judges whether a panel that gates lasers shows each channel's own colour.
fn check_colour_order(lasers: &Section<'_>, timing: FieldTiming) {
    if timing.mode == PanelMode::ChannelPacked && timing.field_order != timing.channel_order {
        let line = lasers.line_of("gated_by_panel");
        let names = |order: [Colour; 3]| order.map(Colour::name).join(", ");
        let expected = format!("panel.field_order = panel.channel_order, which is {}", names(timing.channel_order));
        let advice = "a panel that lights its own lasers lights each channel's colour: correct either order";
        let found = format!("true with panel.field_order = {}", names(timing.field_order));
        lasers.fault_at("gated_by_panel", line, &found, &expected, advice);
    }
}

/// The longest that a laser can be lit within its field, milliseconds.
fn window_room_ms(timing: FieldTiming, on_delay_ms: f64) -> f64 {
    timing.field_ms - timing.slack_ms() - timing.settle_ms - on_delay_ms
}

/// Judges whether the lit window ends within its field; `may_be_on` of lasers that no window switches.
fn check_window(lasers: &Section<'_>, timing: FieldTiming, on_delay_ms: f64, lit_ms: &Found<'_, f64>, may_be_on: bool) {
    let before_ms = timing.settle_ms + on_delay_ms;
    let end_ms = before_ms + lit_ms.value;
    let room_ms = window_room_ms(timing, on_delay_ms);
    if timing.settle_ms >= timing.field_ms || (end_ms <= timing.field_ms && room_ms >= LIT.min) {
        return;
    }
    let [settle, on_delay, lit] = [timing.settle_ms, on_delay_ms, lit_ms.value].map(shown);
    let found = format!("settle {settle} + on_delay {on_delay} + lit {lit} = {} ms", shown(end_ms));
    let slack = shown(timing.slack_ms());
    let expected = format!("an end within the {}, {slack} ms before its own", timing.describe_field());
    let advice = if room_ms >= LIT.min {
        format!("write lit_ms = {} at most", (room_ms * 1e3).floor() / 1e3)
    } else if may_be_on {
        "lower panel.refresh_hz, or correct panel.settle_ms".into()
    } else {
        "shorten on_delay_ms or lower panel.refresh_hz".into()
    };
    lasers.fault_at("lit_ms", lit_ms.line, &found, &expected, advice);
}

fn check_heartbeat(timing: FieldTiming, heartbeat_ms: &Found<'_, f64>) {
    let least_ms = shown(2.0 * timing.colour_frame_ms());
    if heartbeat_ms.value < least_ms {
        let expected = format!("at least two colour frames, {least_ms} ms");
        let advice = "lengthen it, or the box goes dark between two frames";
        let found = format!("{} ms", heartbeat_ms.value);
        heartbeat_ms.fault(&found, &expected, advice);
    }
}

fn check_stall(timing: FieldTiming, stall_ms: &Found<'_, f64>) {
    let least_ms = shown(timing.colour_frame_ms());
    if stall_ms.value < least_ms {
        let expected = format!("at least one colour frame, {least_ms} ms");
        let advice = "lengthen it, or the last colour of each frame stays dark";
        stall_ms.fault(format!("{} ms", stall_ms.value), &expected, advice);
    }
}

/// The greatest powers that lasers may be told, none of a driver that is told the power at the panel. A slip in
/// `transmission` raises what a laser is told and leaves `power_mw` as it is, so that only a limit of its own notices it.
fn read_head_limits(
    lasers: &Section<'_>,
    driver: Option<&LaserDriver>,
    power_mw: &PerColour<Option<Found<'_, f64>>>,
) -> PerColour<Option<f64>> {
    const KEY: &str = "head_limit_mw";
    let needs = |colour: Colour| match driver {
        Some(driver @ LaserDriver::Text { transmission_ppb, .. }) => {
            driver.has(colour) && transmission_ppb[colour] < 1_000_000_000
        }
        _ => false,
    };
    let required = PerColour(Colour::ALL.map(|colour| lasers.has(KEY) && needs(colour)));
    let limits_mw = lasers.numbers(KEY, FULL_POWER, required);
    let Some(driver @ LaserDriver::Text { transmission_ppb, .. }) = driver else { return PerColour([None; 3]) };
    let told_mw = |colour: Colour| {
        let told_uw = driver.head_power_uw(colour, Lasers::whole_uw(power_mw[colour].as_ref()?.value))?;
        Some(told_uw as f64 / 1e3)
    };
    let line = lasers.line_of("transmission");
    let needing: Vec<Colour> = Colour::ALL.into_iter().filter(|&colour| needs(colour)).collect();
    if !lasers.has(KEY) && !needing.is_empty() {
        let powers = needing.iter().filter_map(|&colour| Some(format!("{} mW for {colour}", told_mw(colour)?)));
        let powers = powers.collect::<Vec<_>>().join(", ");
        let found =
            if powers.is_empty() { "nothing".into() } else { format!("nothing, and lasers would be told {powers}") };
        let expected = "the greatest power that a laser may be told, which transmission makes more than power_mw; \
                        power_limit_mw is for the panel";
        let limits = needing.iter().map(|colour| format!("{colour} = ...")).collect::<Vec<_>>().join(", ");
        let advice = format!(
            "write head_limit_mw = {{ {limits} }}, in mW at the laser itself: the greatest power that the bench is safe \
             with, whatever is in the laser's way"
        );
        lasers.fault_at(KEY, line, &found, expected, advice);
    }
    for colour in Colour::ALL {
        let Some(limit) = &limits_mw[colour] else { continue };
        if !driver.has(colour) {
            let advice = "name its port in devices, or take this out";
            limit.fault("that of no laser", "a laser of it", advice);
        } else if let Some(told_mw) = told_mw(colour).filter(|told_mw| *told_mw > limit.value) {
            let share = f64::from(transmission_ppb[colour]) / 1e9;
            let found = format!("{told_mw} mW that the laser is told, of which {share} gets to the panel");
            let expected = format!("{} mW at most, as head_limit_mw says", limit.value);
            let (key, advice) = match lasers.has("transmission") {
                true => ("transmission", "correct transmission, as measured at the panel, or lower power_mw"),
                false => ("power_mw", "lower it, or correct head_limit_mw"),
            };
            let line = lasers.line_of(key);
            lasers.fault_at(&format!("{key}.{colour}"), line, &found, &expected, advice);
        }
    }
    limits_mw.map(|limit| limit.map(|limit| limit.value))
}

/// Judges what of `[lasers]` goes with some of the panel's modes only.
fn check_mode(lasers: &Section<'_>, timing: Option<FieldTiming>, driver: Option<&LaserDriver>, gated_by_panel: bool) {
    const BY_PANEL: &str =
        "write gated_by_panel = true where the panel's own hardware gates each laser to its field, or ";
    let Some(mode) = timing.map(|timing| timing.mode) else { return };
    let packed = PanelMode::ChannelPacked.name();
    let is_of_one_colour = matches!(mode, PanelMode::Monochrome(_));
    if let Some(driver) = driver.filter(|driver| !driver.gates_fields() && !is_of_one_colour && !gated_by_panel) {
        let line = lasers.line_of("driver");
        let found =
            format!("\"{}\" in {} mode, whose fields these lasers cannot be switched for", driver.name(), mode.name());
        let by_panel = if mode == PanelMode::ChannelPacked { BY_PANEL } else { "" };
        let advice = format!(
            "{by_panel}show one colour (mode = \"monochrome\"), or light fields with a laser box (driver = \"serial\")"
        );
        lasers.fault_at("driver", line, &found, "lasers that can be lit for single fields", advice);
    }
    if mode == PanelMode::ChannelPacked {
        return;
    }
    let found = format!("true in {} mode", mode.name());
    if mode == PanelMode::FieldSequential && gated_by_panel {
        let line = lasers.line_of("gated_by_panel");
        let expected = format!("false, or mode = \"{packed}\": of a video frame of one colour only holod knows which");
        let advice = "take it out, and light fields with a laser box (driver = \"serial\"), or show one colour \
                      (mode = \"monochrome\")";
        lasers.fault_at("gated_by_panel", line, &found, &expected, advice);
    }
    if matches!(driver, Some(LaserDriver::Serial { sync_wire: true, .. })) {
        let line = lasers.line_of("sync_wire");
        let expected = format!("mode = \"{packed}\", where the wire's edges begin colour frames");
        let advice = "take it out: in this mode holod asks for each window by the panel's reports, and nobody looks at \
                      the wire";
        lasers.fault_at("sync_wire", line, &found, &expected, advice);
    }
}
