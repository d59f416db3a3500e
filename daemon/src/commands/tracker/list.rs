//! `holod tracker list`: the profiles that holod brings with it, and what is plugged in.

use std::fmt::Write as _;
use std::path::PathBuf;

use holod_pupil_input::{Profile, SizeUnit, hid_devices, serial_ports};
use serde::Serialize;

use crate::cli::ListArgs;
use crate::failure::Failure;
use crate::results;

#[derive(Serialize)]
struct List {
    profiles: Vec<Entry>,
    serial_ports: Vec<Port>,
    hid_devices: Vec<Device>,
    /// Why HID devices cannot be listed.
    #[serde(skip_serializing_if = "Option::is_none")]
    hid_fault: Option<String>,
}

#[derive(Serialize)]
struct Entry {
    name: String,
    wire: &'static str,
    unit: &'static str,
    about: String,
}

#[derive(Serialize)]
struct Port {
    path: PathBuf,
    by_id: Option<PathBuf>,
    usb: Option<Usb>,
    latency_timer_ms: Option<u32>,
}

#[derive(Serialize)]
struct Device {
    path: PathBuf,
    #[serde(flatten)]
    usb: Usb,
}

#[derive(Serialize)]
struct Usb {
    ids: String,
    manufacturer: Option<String>,
    product: Option<String>,
    serial: Option<String>,
}

impl Usb {
    fn in_words(&self) -> String {
        let names = [&self.manufacturer, &self.product, &self.serial].map(|name| name.as_deref().unwrap_or("-"));
        format!("{} {}", self.ids, names.join(", "))
    }
}

pub(super) fn list(args: &ListArgs) -> Result<(), Failure> {
    let list = what_there_is();
    if args.json { results::print_json(&list) } else { results::print(&in_words(&list)) }
}

fn what_there_is() -> List {
    let profiles = Profile::shipped().map(|profile| Entry {
        wire: profile.format.kind(),
        unit: profile.unit.name(),
        name: profile.name,
        about: profile.about,
    });
    let ports = serial_ports().into_iter().map(|port| Port {
        path: port.path,
        by_id: port.by_id,
        usb: port.usb.map(|usb| Usb {
            ids: usb.ids.to_string(),
            manufacturer: usb.manufacturer,
            product: usb.product,
            serial: usb.serial,
        }),
        latency_timer_ms: port.latency_timer_ms,
    });
    let told = |text: String| Some(text).filter(|text| !text.is_empty());
    let (devices, hid_fault) = match hid_devices() {
        Ok(devices) => (devices, None),
        Err(error) => (Vec::new(), Some(error.to_string())),
    };
    let devices = devices.into_iter().map(|device| Device {
        path: device.path,
        usb: Usb {
            ids: device.ids.to_string(),
            manufacturer: None,
            product: told(device.product),
            serial: told(device.serial),
        },
    });
    List { profiles: profiles.collect(), serial_ports: ports.collect(), hid_devices: devices.collect(), hid_fault }
}

fn in_words(list: &List) -> String {
    let mut text = String::from("Profiles, for `profile=NAME` in a tracker spec:\n");
    let mut put = |line: String| writeln!(text, "{line}").expect("a String takes all");
    for Entry { name, wire, unit, about } in &list.profiles {
        let scale = if *unit == SizeUnit::Millimetres.name() { "" } else { " (needs tracker.scale_mm_per_unit)" };
        put(format!("  {name:16} {wire:14} {unit}{scale}\n      {about}"));
    }
    put("A file of your own is named by its path: profile=./my-tracker.toml\n\nSerial ports:".into());
    for port in &list.serial_ports {
        let usb = port.usb.as_ref().map_or("no USB device".to_owned(), Usb::in_words);
        let stable = port.by_id.as_ref().unwrap_or(&port.path).display();
        let held = port.latency_timer_ms.map_or(String::new(), |ms| format!("; holds bytes for up to {ms} ms"));
        put(format!("  {stable}\n      {}, {usb}{held}", port.path.display()));
    }
    if list.serial_ports.is_empty() {
        put("  none".into());
    }
    put("\nHID devices:".into());
    for Device { path, usb } in &list.hid_devices {
        put(format!("  {}\n      {}", path.display(), usb.in_words()));
    }
    match &list.hid_fault {
        Some(fault) => put(format!("  {fault}")),
        None if list.hid_devices.is_empty() => put("  none".into()),
        None => {}
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ports_and_devices_are_listed_beside_the_profiles() {
        let usb = |serial: Option<&str>| Usb {
            ids: "1209:0001".into(),
            manufacturer: None,
            product: Some("Eye tracker".into()),
            serial: serial.map(str::to_owned),
        };
        let mut list = List {
            profiles: Vec::new(),
            serial_ports: vec![Port {
                path: "/dev/ttyUSB0".into(),
                by_id: Some("/dev/serial/by-id/usb-x".into()),
                usb: Some(usb(None)),
                latency_timer_ms: Some(16),
            }],
            hid_devices: vec![Device { path: "/dev/hidraw3".into(), usb: usb(Some("A1")) }],
            hid_fault: None,
        };
        let text = in_words(&list);
        assert!(text.contains("usb-x\n      /dev/ttyUSB0, 1209:0001 -, Eye tracker, -; holds bytes for up to 16 ms"));
        assert!(text.ends_with("HID devices:\n  /dev/hidraw3\n      1209:0001 -, Eye tracker, A1\n"), "{text}");
        let json = serde_json::to_value(&list).expect("JSON");
        assert_eq!(json["hid_devices"][0]["ids"], "1209:0001");
        assert_eq!(json["serial_ports"][0]["path"], "/dev/ttyUSB0");
        (list.serial_ports, list.hid_devices) = (Vec::new(), Vec::new());
        assert!(in_words(&list).ends_with("Serial ports:\n  none\n\nHID devices:\n  none\n"));
    }
}
