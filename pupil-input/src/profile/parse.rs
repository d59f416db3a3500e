//! From a profile's text to a [`Profile`].

use std::cell::Cell;
use std::time::Duration;

use holod_calibration::toml_reader::{self, Fault, Found, Section};

use super::bytes::read_bytes;
use super::kinds::{Context, EYES, read_wire};
use super::{Command, DEFAULT_BAUD, HidSettings, NetworkSettings, Profile, SerialSettings};
use crate::size_unit::SizeUnit;
use crate::usb_ids::UsbIds;
use crate::wire::field::{SizeKind, SizeRule};

/// What a profile's first key must say.
const SCHEMA: &str = "holod-tracker-1";
/// How long a command's answer is waited for where the profile does not say.
const ANSWER_WITHIN_MS: i64 = 1000;

/// Parses a profile, or tells all that is wrong with it, in the order of its lines.
pub(super) fn parse(text: &str) -> Result<Profile, Vec<Fault>> {
    toml_reader::read(text, read)
}

fn read(root: &Section<'_>) -> Option<Profile> {
    if let Some(found) = root.require("format", &format!("\"{SCHEMA}\"")) {
        found.choose(&[(SCHEMA, ())]);
    }
    let name = root.required_text("name", "the profile's name");
    let about = root.get("about").and_then(|found| found.raw_text("one sentence about the tracker")).unwrap_or("");
    let eye = root.get("eye").and_then(|found| Some(found.with(found.choose(&EYES)?)));
    let rate_hz = root.positive("rate_hz").and_then(|rate_hz| Some(root.get("rate_hz")?.with(rate_hz)));
    let size_at = root.get("size").map(|found| found.with(()));
    let (unit, size) = read_size(&root.section("size"));
    let serial = read_serial(&root.section("serial"));
    let hid = read_hid(&root.section("hid"));
    let network = read_network(&root.section("network"));
    let wire = root.require("wire", "the table that says how bytes are read");
    let mm_per_unit = size.mm_per_unit;
    let context = Context { eye, rate_hz, counts_frames: Cell::new(false), size, unit, size_at };
    let wire = wire.and_then(|wire| read_wire(&wire.table(), &context));
    if let Some(rate_hz) = context.rate_hz.as_ref().filter(|_| wire.is_some() && !context.counts_frames.get()) {
        let advice = "take it out, or write unit = \"frames\" where the time counts frames";
        rate_hz.fault(rate_hz.value, "none: no time is made from a frame counter", advice);
    }
    root.finish();
    let (name, about) = (name?.value.to_owned(), about.to_owned());
    let (format, unit) = wire?;
    Some(Profile { name, about, unit, mm_per_unit, serial, hid, network, format })
}

fn read_serial(serial: &Section<'_>) -> SerialSettings {
    let baud = serial.integer("baud", 1..=i64::from(u32::MAX)).map_or(DEFAULT_BAUD, |baud| baud as u32);
    let [start, stop] = ["start", "stop"].map(|key| read_commands(serial, key));
    let settings = SerialSettings { baud, usb: read_usb(serial), start, stop };
    serial.finish();
    settings
}

fn read_hid(hid: &Section<'_>) -> HidSettings {
    let [usage_page, usage] = ["usage_page", "usage"].map(|key| hid.integer(key, 0..=0xFFFF).map(|page| page as u16));
    let settings = HidSettings { usb: read_usb(hid), usage_page, usage };
    hid.finish();
    settings
}

fn read_network(network: &Section<'_>) -> NetworkSettings {
    let port = network.integer("port", 1..=0xFFFF).map(|port| port as u16);
    let [start, stop] = ["start", "stop"].map(|key| read_commands(network, key));
    network.finish();
    NetworkSettings { port, start, stop }
}

fn read_usb(section: &Section<'_>) -> Vec<UsbIds> {
    const EXPECTED: &str = "USB identities such as [\"1209:0001\"]";
    let Some(found) = section.get("usb") else { return Vec::new() };
    let read = |item: Found<'_, toml_edit::Item>| {
        let ids = item.value.as_str().map(str::parse);
        match ids {
            Some(Ok(ids)) => return Some(ids),
            Some(Err(problem)) => item.fault(item.value.to_string().trim(), EXPECTED, problem),
            None => item.fault(item.value.to_string().trim(), EXPECTED, "write each in quotes"),
        }
        None
    };
    found.items(EXPECTED).into_iter().filter_map(read).collect()
}

fn read_commands(section: &Section<'_>, key: &'static str) -> Vec<Command> {
    let Some(found) = section.get(key) else { return Vec::new() };
    let items = found.items("commands such as [{ send = \"Go\\r\", expect = \"OK\", within_ms = 500 }]");
    let read = |item: &Found<'_, toml_edit::Item>| {
        let command = item.with(&item.value).table();
        let send = command.require("send", "the bytes to send").and_then(|send| read_bytes(&send));
        let expect = command.get("expect").and_then(|expect| read_bytes(&expect));
        let within_ms = command.integer("within_ms", 1..=60_000).unwrap_or(ANSWER_WITHIN_MS);
        command.finish();
        Some(Command { send: send?, expect, within: Duration::from_millis(within_ms as u64) })
    };
    items.iter().filter_map(read).collect()
}

fn read_size(size: &Section<'_>) -> (SizeUnit, SizeRule) {
    const KINDS: [(&str, SizeKind); 3] =
        [("diameter", SizeKind::Diameter), ("radius", SizeKind::Radius), ("area", SizeKind::Area)];
    const UNITS: [(&str, SizeUnit); 3] =
        [("mm", SizeUnit::Millimetres), ("pixels", SizeUnit::Pixels), ("arbitrary", SizeUnit::Arbitrary)];
    let kind = size.choice("kind", &KINDS, false).map_or(SizeKind::Diameter, |kind| kind.value);
    let unit = size.choice("unit", &UNITS, false).map_or(SizeUnit::default(), |unit| unit.value);
    let mm_per_unit = size.positive("mm_per_unit");
    if unit == SizeUnit::Millimetres
        && let Some(factor) = mm_per_unit.filter(|factor| *factor != 1.0)
        && let Some(found) = size.get("mm_per_unit")
    {
        let advice = "take it out, or write unit = \"pixels\" or unit = \"arbitrary\"";
        found.fault(factor, "none where the unit is mm", advice);
    }
    size.finish();
    // Where the profile knows the conversion, what it gives is millimetres.
    let given = if mm_per_unit.is_some() { SizeUnit::Millimetres } else { unit };
    (given, SizeRule { kind, mm_per_unit: mm_per_unit.unwrap_or(1.0) })
}
