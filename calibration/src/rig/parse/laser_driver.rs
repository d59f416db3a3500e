//! What drives the lasers, of `[lasers]`.

use std::collections::BTreeSet;
use std::path::Path;

use crate::rig::files::read_text;
use crate::rig::reader::Span;
use crate::rig::{LaserDriver, Provenance, TextLaserProfile};
use crate::toml_reader::Section;
use crate::{Colour, PerColour};

pub(super) const POWER_SLIPS: &[(&str, f64)] = &[("microwatts", 1e-3)];
pub(super) const FULL_POWER: Span = Span::new(0.001, 4000.0, "mW").slips(POWER_SLIPS);
/// A laser may give somewhat more than it is told.
const TRANSMISSION: Span = Span::new(1e-4, 1.5, "").slips(&[("percent", 1e-2)]);
/// What accepts lasers without a heartbeat.
const ACCEPTANCE: &str = "these lasers stay lit when holod dies";

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

pub(super) fn read_driver(lasers: &Section<'_>, folder: &Path, provenance: &mut Provenance) -> Option<LaserDriver> {
    const PORT: &str = "a serial port's path";
    let drivers: Vec<_> = DRIVERS.iter().map(|driver| (driver.0, driver)).collect();
    let driver = lasers.choice("driver", &drivers, true);
    // Each key is read whatever the driver is, so that all its own faults are reported.
    let device = lasers.text("device", PORT);
    let devices = lasers.texts("devices", PORT);
    let sync_wire = lasers.flag("sync_wire", false);
    let full_power = lasers.numbers("full_power_mw", FULL_POWER, PerColour([lasers.has("full_power_mw"); 3]));
    let transmission = lasers.numbers("transmission", TRANSMISSION, PerColour([false; 3]));
    let profile = read_text_laser(lasers, folder, provenance);
    let driver = driver?;
    let (name, own) = *driver.value;
    let keys: BTreeSet<_> = DRIVERS.iter().flat_map(|(_, keys)| *keys).collect();
    for key in keys {
        if lasers.has(key) && !own.contains(key) {
            let of: Vec<_> = DRIVERS.iter().filter(|(_, keys)| keys.contains(key)).map(|(name, _)| *name).collect();
            let found = format!("a key that the driver \"{name}\" does not have");
            let advice = format!("take {key} out, or write driver = \"{}\"", of.join("\" or \""));
            let line = lasers.line_of(key);
            lasers.fault_at(key, line, &found, "only keys of the chosen driver", advice);
        }
    }
    let missing = |key: &str, expected: &str, example: &str| {
        if !lasers.has(key) {
            let advice = format!("write for example {example}");
            lasers.fault_at(key, driver.line, "nothing", expected, advice);
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
            // A port may have two names, such as one that a udev rule gives it.
            let port = |path: &str| std::fs::canonicalize(path).unwrap_or_else(|_| path.into());
            for (index, colour) in Colour::ALL.into_iter().enumerate() {
                let Some(path) = &devices[colour] else { continue };
                if devices.0[..index].iter().flatten().any(|other| port(other.value) == port(path.value)) {
                    let advice = "give each laser its own port";
                    path.fault("a port named twice", "one laser to a port", advice);
                }
            }
            for colour in Colour::ALL {
                if let (Some(share), None) = (&transmission[colour], &devices[colour]) {
                    let advice = "name its port in devices, or take this out";
                    share.fault("that of no laser", "a laser of it", advice);
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
pub(super) fn read_acceptance(lasers: &Section<'_>, driver: Option<&LaserDriver>) -> bool {
    let expected = format!("the words {ACCEPTANCE:?}");
    let words = lasers.text("accept_no_heartbeat", &expected);
    let accepted = words.as_ref().is_some_and(|words| words.value == ACCEPTANCE);
    let needed = driver.is_some_and(|driver| !driver.has_heartbeat());
    if needed && !accepted {
        let found = words.as_ref().map_or("nothing".into(), |words| format!("{:?}", words.value));
        let advice = format!(
            "these lasers have no heartbeat: they stay lit when holod is killed or the computer hangs. Where the bench is \
             safe with that, write accept_no_heartbeat = {ACCEPTANCE:?}"
        );
        let line = words.and_then(|words| words.line);
        lasers.fault_at("accept_no_heartbeat", line, &found, &expected, advice);
    }
    accepted
}

/// The profile that `profile` or `profile_file` names.
fn read_text_laser(lasers: &Section<'_>, folder: &Path, provenance: &mut Provenance) -> Option<TextLaserProfile> {
    let choices: Vec<_> = TextLaserProfile::names().map(|name| (name, name)).collect();
    let named = lasers.choice("profile", &choices, false);
    let file = lasers.text("profile_file", "a TOML file's path");
    if let (Some(_), Some(file)) = (&named, &file) {
        let advice = "remove profile, or profile_file";
        file.fault("a second profile", "one profile", advice);
    }
    let Some(file) = file else { return TextLaserProfile::named(named?.value).cloned() };
    let path = provenance.laser_profile_file.insert(folder.join(file.value));
    let text = file.of_file(read_text(path))?;
    match TextLaserProfile::parse(&text, path) {
        Ok(profile) => Some(profile),
        Err(error) => {
            for fault in error.faults {
                let place = fault.line.map_or(String::new(), |line| format!(" line {line}"));
                let found = format!("{}{place}, {}: {}", path.display(), fault.key, fault.found);
                file.fault(&found, &fault.expected, fault.advice);
            }
            None
        }
    }
}
