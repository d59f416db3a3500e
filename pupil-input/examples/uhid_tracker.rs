//! A virtual HID tracker, made with the kernel's UHID: plugged in, read, unplugged, and plugged in again at another
//! node.
//!
//! `uhid_tracker [plugs=N] [reports=N] [wrong=KIND]`: for each plug it waits until someone opens the tracker, sends the
//! reports at 1 kHz, and tells on the standard output what it did. KIND makes it lie, so that a test of it can be shown
//! to fail: `missing` leaves a report out, `diameter` adds a millimetre to it.
//!
//! Layouts are those of the kernel's linux/uhid.h: an event is its type, 32 bits, and what belongs to that type.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::thread::sleep;
use std::time::{Duration, Instant};

use holod_pupil_input::wire::hid_descriptor::HOLOD_HID_DESCRIPTOR;

const UHID_DESTROY: u32 = 1;
const UHID_OPEN: u32 = 4;
const UHID_CLOSE: u32 = 5;
const UHID_CREATE2: u32 = 11;
const UHID_INPUT2: u32 = 12;
/// Bytes of the largest event.
const EVENT_BYTES: usize = 4380;
const BUS_USB: u16 = 3;

const TRACKER: (u32, u32) = (0x1209, 0x0001);
/// Another device of the same maker, which takes the tracker's node while that is away.
const DECOY: (u32, u32) = (0x1209, 0x0002);
const PERIOD: Duration = Duration::from_millis(1);

struct Device {
    uhid: File,
}

impl Device {
    fn plug_in((vendor, product): (u32, u32), name: &str, serial: &str) -> io::Result<Self> {
        let mut uhid = File::options().read(true).write(true).open("/dev/uhid")?;
        let mut event = UHID_CREATE2.to_ne_bytes().to_vec();
        for (text, bytes) in [(name, 128), ("", 64), (serial, 64)] {
            let begin = event.len();
            event.extend(text.as_bytes());
            event.resize(begin + bytes, 0);
        }
        event.extend((HOLOD_HID_DESCRIPTOR.len() as u16).to_ne_bytes());
        event.extend(BUS_USB.to_ne_bytes());
        for number in [vendor, product, 0, 0] {
            event.extend(number.to_ne_bytes());
        }
        event.extend(HOLOD_HID_DESCRIPTOR);
        uhid.write_all(&event)?;
        Ok(Self { uhid })
    }

    /// Waits for an event of the kernel.
    fn wait_for(&mut self, kind: u32) -> io::Result<()> {
        let mut event = [0; EVENT_BYTES];
        loop {
            let count = self.uhid.read(&mut event)?;
            if count >= 4 && event[..4] == kind.to_ne_bytes() {
                return Ok(());
            }
        }
    }

    fn send(&mut self, report: &[u8]) -> io::Result<()> {
        let mut event = UHID_INPUT2.to_ne_bytes().to_vec();
        event.extend((report.len() as u16).to_ne_bytes());
        event.extend(report);
        self.uhid.write_all(&event)
    }

    fn unplug(mut self) -> io::Result<()> {
        self.uhid.write_all(&UHID_DESTROY.to_ne_bytes())
    }
}

/// Report `index`: both eyes' diameters rise by a micrometre a report and fall back after a hundred.
fn report(index: u32, added_um: u16) -> Vec<u8> {
    let device_us = index.wrapping_mul(PERIOD.as_micros() as u32);
    let rising_um = (index % 100) as u16;
    let mut report = vec![1];
    report.extend(device_us.to_le_bytes());
    report.extend((index as u16).to_le_bytes());
    for rest_um in [4000, 3500] {
        report.extend((rest_um + rising_um + added_um).to_le_bytes());
        report.extend([CONFIDENT, VALID]);
    }
    report
}

const CONFIDENT: u8 = 255;
const VALID: u8 = 1;

/// The tracker's node in /dev, as sysfs has it.
fn node() -> io::Result<String> {
    let id = format!("HID_ID=0003:{:08X}:{:08X}", TRACKER.0, TRACKER.1);
    for entry in fs::read_dir("/sys/class/hidraw")? {
        let entry = entry?;
        if fs::read_to_string(entry.path().join("device/uevent"))?.lines().any(|line| line == id) {
            return Ok(entry.file_name().to_string_lossy().into_owned());
        }
    }
    Err(io::Error::other("the tracker has no node"))
}

fn main() -> io::Result<()> {
    let (mut plugs, mut reports, mut wrong) = (2, 1000, String::new());
    for argument in std::env::args().skip(1) {
        match argument.split_once('=') {
            Some(("plugs", count)) => plugs = count.parse().map_err(io::Error::other)?,
            Some(("reports", count)) => reports = count.parse().map_err(io::Error::other)?,
            Some(("wrong", kind @ ("missing" | "diameter"))) => wrong = kind.to_owned(),
            _ => return Err(io::Error::other(format!("unknown option `{argument}`"))),
        }
    }
    let missing = if wrong == "missing" { Some(reports / 2) } else { None };
    let added_um = if wrong == "diameter" { 1000 } else { 0 };
    let mut out = io::stdout();
    let mut decoys = Vec::new();
    for plug in 1..=plugs {
        let mut tracker = Device::plug_in(TRACKER, "holod virtual tracker", "V1")?;
        tracker.wait_for(UHID_OPEN)?;
        let node = node()?;
        sleep(Duration::from_millis(100));
        let begun = Instant::now();
        let mut sent = 0;
        for index in 0..reports {
            sleep((PERIOD * index).saturating_sub(begun.elapsed()));
            if Some(index) != missing {
                tracker.send(&report(index, added_um))?;
                sent += 1;
            }
        }
        let took_ms = begun.elapsed().as_millis();
        writeln!(out, r#"{{"plug": {plug}, "node": "{node}", "sent": {sent}, "took_ms": {took_ms}}}"#)?;
        // What the reader has not read when the tracker goes is lost.
        sleep(Duration::from_millis(300));
        if plug == plugs {
            tracker.wait_for(UHID_CLOSE)?;
        }
        tracker.unplug()?;
        sleep(Duration::from_millis(500));
        decoys.push(Device::plug_in(DECOY, "holod virtual decoy", "")?);
    }
    Ok(())
}
