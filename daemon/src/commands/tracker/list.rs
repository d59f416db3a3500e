//! `holod tracker list`: the profiles that holod brings with it.

use std::fmt::Write as _;

use holod_pupil_input::{Profile, SizeUnit, serial_ports};
use serde::Serialize;

use crate::cli::ListArgs;
use crate::failure::Failure;
use crate::results;

#[derive(Serialize)]
struct Entry {
    name: String,
    wire: &'static str,
    unit: &'static str,
    about: String,
}

pub(super) fn list(args: &ListArgs) -> Result<(), Failure> {
    let entries: Vec<Entry> = Profile::shipped()
        .map(|profile| Entry {
            wire: profile.format.kind(),
            unit: profile.unit.name(),
            name: profile.name,
            about: profile.about,
        })
        .collect();
    if args.json {
        return results::print_json(&entries);
    }
    let mut text = String::from("Profiles, for `profile=NAME` in a tracker spec:\n");
    for Entry { name, wire, unit, about } in &entries {
        let scale = if *unit == SizeUnit::Millimetres.name() { "" } else { " (needs tracker.scale_mm_per_unit)" };
        writeln!(text, "  {name:16} {wire:14} {unit}{scale}\n      {about}").expect("a String takes all");
    }
    text.push_str("A file of your own is named by its path: profile=./my-tracker.toml\n\nSerial ports:\n");
    for port in serial_ports() {
        let usb = port.usb.as_ref().map_or("no USB device".to_owned(), |usb| {
            let names = [&usb.manufacturer, &usb.product, &usb.serial].map(|name| name.as_deref().unwrap_or("-"));
            format!("{} {}", usb.ids, names.join(", "))
        });
        let stable = port.by_id.as_ref().unwrap_or(&port.path).display();
        let held = port.latency_timer_ms.map_or(String::new(), |ms| format!("; holds bytes for up to {ms} ms"));
        writeln!(text, "  {stable}\n      {}, {usb}{held}", port.path.display()).expect("a String takes all");
    }
    if serial_ports().is_empty() {
        text.push_str("  none\n");
    }
    results::print(&text)
}
