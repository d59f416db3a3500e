//! A serial port or PTY: opened exclusively, read with a timeout, found again after a replug.
//!
//! Before a byte is written to a port it is asked what it is: by the USB device behind it where there is one that the
//! profile knows, else by listening to it. A port that belongs to something else, the laser box, is never opened.

pub(crate) mod identity;

use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use holod_calibration::{KEPT_BY_UNIT, unit_keeps};
use serialport::{ClearBuffer, SerialPort, TTYPort};

use self::identity::{SerialPortInfo, UsbPort, ports_below, serial_ports};
use super::commands::{CommandError, Dialogue, StartedLink, overhear, receive_from};
use super::{ByteSource, Feed, READ_TIMEOUT, SourceError};
use crate::profile::Profile;
use crate::wire::line::crc8;
use crate::wire::{Format, WireEvent};

/// Why a serial tracker could not be opened.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum SerialError {
    /// There is nothing at the path.
    #[error(
        "tracker port {path} does not exist; {ports}; plug the tracker in, name its port (best by /dev/serial/by-id), or correct the name of the log"
    )]
    Missing {
        path: PathBuf,
        /// The ports there are, in words.
        ports: String,
    },
    /// What is there is no serial port.
    #[error("tracker port {path} is {found}; expected a serial port; {hint}")]
    NotAPort { path: PathBuf, found: &'static str, hint: String },
    /// It is there and does not open.
    #[error("tracker port {path} does not open: {reason}; {hint}")]
    Open { path: PathBuf, reason: String, hint: &'static str },
    /// The port is somebody else's.
    #[error(
        "tracker port {path} is the port {owner} that the rig names for another device, such as its laser box; nothing was \
         opened; name the tracker's own port: {ports}"
    )]
    Forbidden {
        path: PathBuf,
        /// The path by which the rig knows it.
        owner: PathBuf,
        /// The ports there are, in words.
        ports: String,
    },
    /// Another device is plugged in there.
    #[error("tracker port {path} is {found}; expected {expected}; nothing was written to it; {hint}")]
    WrongDevice {
        path: PathBuf,
        found: String,
        /// What should be there.
        expected: String,
        hint: String,
    },
    /// The tracker does not do as it is told.
    #[error(
        "tracker port {path}, profile `{profile}`: {problem}; check the profile, the baud rate and the tracker's power"
    )]
    Command { path: PathBuf, profile: String, problem: Box<CommandError> },
}

/// How long a port is listened to before anything is written to a device that nothing else identifies.
const LISTENS: Duration = Duration::from_millis(300);
/// How long a closing port waits for its last bytes to go out.
const DRAINS: Duration = Duration::from_millis(300);
/// Samples by which another profile's tracker is recognised.
const RECOGNISED_SAMPLES: u32 = 3;

/// A tracker behind a serial port, wherever that turns up.
pub(crate) struct SerialFeed {
    path: PathBuf,
    baud: u32,
    profile: Profile,
    forbidden: Vec<Forbidden>,
    /// Where `/sys` and `/dev` are.
    root: PathBuf,
    /// The USB device that was opened first.
    device: Option<UsbPort>,
    /// Another one that looks like it has been seen.
    shared: bool,
}

/// A port of something else.
struct Forbidden {
    path: PathBuf,
    device: Option<UsbPort>,
}

impl SerialFeed {
    /// `path` with the profile's baud rate unless `baud` says another.
    pub(crate) fn new(path: &Path, baud: Option<u32>, profile: Profile, forbidden: &[PathBuf]) -> Self {
        Self::below(Path::new("/"), path, baud, profile, forbidden)
    }

    fn below(root: &Path, path: &Path, baud: Option<u32>, profile: Profile, forbidden: &[PathBuf]) -> Self {
        let ports = ports_below(root);
        let forbidden = forbidden
            .iter()
            .map(|path| {
                let device = port_at(path, &ports).and_then(|port| port.usb.clone());
                Forbidden { path: path.clone(), device }
            })
            .collect();
        let baud = baud.unwrap_or(profile.serial.baud);
        Self { path: path.into(), baud, profile, forbidden, root: root.into(), device: None, shared: false }
    }

    /// The path to open: the one that was named, or where the same device is now.
    ///
    /// A name alone says nothing: a bare one is handed out to whoever comes first, and links lead to any device that a
    /// rule fits, or that lacks a serial number too.
    fn locate(&mut self, ports: &[SerialPortInfo]) -> Result<PathBuf, SerialError> {
        let Some(device) = &self.device else { return Ok(self.path.clone()) };
        self.shared |= has_twins(device, ports);
        let named = port_at(&self.path, ports);
        let is_ours = |port: &SerialPortInfo| port.usb.as_ref().is_some_and(|usb| usb.is_same(device, self.shared));
        if named.is_some_and(is_ours) {
            return Ok(self.path.clone());
        }
        if let Some(found) = ports.iter().find(|port| is_ours(port) && self.owner(port, ports).is_none()) {
            return Ok(found.path.clone());
        }
        let Some(other) = named.and_then(|port| port.usb.as_ref()) else { return Ok(self.path.clone()) };
        let alike = other.looks_like(device);
        let (found, expected, hint) = if alike {
            let hint = "plug the tracker in there; nothing else tells it from others like it";
            (format!("{other} in USB socket {}", other.socket), format!("the one in socket {}", device.socket), hint)
        } else {
            (other.to_string(), format!("{device} again"), "plug the tracker in")
        };
        Err(SerialError::WrongDevice { path: self.path.clone(), found, expected, hint: hint.into() })
    }

    /// The forbidden port that this one is.
    fn owner(&self, port: &SerialPortInfo, ports: &[SerialPortInfo]) -> Option<&Path> {
        self.owner_of(&port.path, port.usb.as_ref(), ports)
    }

    fn owner_of(&self, path: &Path, usb: Option<&UsbPort>, ports: &[SerialPortInfo]) -> Option<&Path> {
        let node = path.canonicalize().ok();
        let is_its = |forbidden: &&Forbidden| {
            let same_node = node.is_some() && forbidden.path.canonicalize().ok() == node;
            let same_device = usb
                .zip(forbidden.device.as_ref())
                .is_some_and(|(usb, device)| usb.is_same(device, self.shared || has_twins(device, ports)));
            same_node || same_device
        };
        self.forbidden.iter().find(is_its).map(|forbidden| forbidden.path.as_path())
    }

    /// Whether the USB device is one of the profile's; an error if it is another.
    fn check_device(&self, path: &Path, usb: Option<&UsbPort>) -> Result<bool, SerialError> {
        let Profile { name, serial, .. } = &self.profile;
        let Some(usb) = usb.filter(|_| !serial.usb.is_empty()) else { return Ok(false) };
        if serial.usb.contains(&usb.ids) {
            return Ok(true);
        }
        let ids: Vec<_> = serial.usb.iter().map(ToString::to_string).collect();
        Err(SerialError::WrongDevice {
            path: path.into(),
            found: usb.to_string(),
            expected: format!("a tracker of profile `{name}`, {}", ids.join(" or ")),
            hint: format!("name the tracker's port, or put its ids into the profile; {}", ports_in_words(&self.root)),
        })
    }

    fn check_protocol(&self, path: &Path, port: &mut OpenPort) -> Result<(), SerialError> {
        let failed = |error: io::Error| SerialError::Open {
            path: path.into(),
            reason: error.to_string(),
            hint: "check the cable and the tracker's power",
        };
        let heard = overhear(port, LISTENS).map_err(failed)?;
        let Some(found) = recognise(&heard, &self.profile) else { return Ok(()) };
        Err(SerialError::WrongDevice {
            path: path.into(),
            found,
            expected: format!("a tracker of profile `{}`", self.profile.name),
            hint: format!("name the tracker's port or its profile; {}", ports_in_words(&self.root)),
        })
    }
}

impl Feed for SerialFeed {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError> {
        let ports = ports_below(&self.root);
        let path = self.locate(&ports)?;
        check_kind(&path, &self.root)?;
        let usb = port_at(&path, &ports).and_then(|port| port.usb.as_ref());
        if let Some(owner) = self.owner_of(&path, usb, &ports) {
            let owner = owner.into();
            return Err(SerialError::Forbidden { path, owner, ports: ports_in_words(&self.root) }.into());
        }
        let Profile { name, serial, .. } = &self.profile;
        let has_commands = !serial.start.is_empty() || !serial.stop.is_empty();
        let known = self.check_device(&path, usb)?;
        let mut port = OpenPort::new(&path, self.baud)?;
        if has_commands && !known {
            self.check_protocol(&path, &mut port)?;
        }
        let port = StartedLink::start(port, &serial.start, &serial.stop).map_err(|problem| SerialError::Command {
            path: path.clone(),
            profile: name.clone(),
            problem: Box::new(problem),
        })?;
        if self.device.is_none() {
            self.device = usb.cloned();
            self.shared = usb.is_some_and(|usb| has_twins(usb, &ports));
        }
        Ok(Box::new(port))
    }

    fn warnings(&self) -> Vec<String> {
        let ports = ports_below(&self.root);
        port_at(&self.path, &ports).map_or_else(Vec::new, |port| port_warnings(port, &self.path))
    }
}

/// What a user should know of reading a tracker at the serial port `path`: a name that will change, an adapter that
/// holds bytes back. A sentence each; none where there is no port.
pub fn serial_port_warnings(path: &Path) -> Vec<String> {
    let ports = serial_ports();
    port_at(path, &ports).map_or_else(Vec::new, |port| port_warnings(port, path))
}

/// What a user should know of a serial port `path` of `whose`, "tracker" say, whose adapter holds bytes back.
pub fn adapter_delay_warning(whose: &str, path: &Path) -> Option<String> {
    let ports = serial_ports();
    delay_warning(whose, port_at(path, &ports)?, path)
}

fn delay_warning(whose: &str, port: &SerialPortInfo, path: &Path) -> Option<String> {
    let held_ms = port.latency_timer_ms.filter(|held_ms| *held_ms > LATENCY_TIMER_MAX_MS)?;
    let (shown, name) = (path.display(), port.path.file_name().unwrap_or_default().display());
    Some(format!(
        "the adapter of {whose} port {shown} holds bytes back for up to {held_ms} ms (latency_timer); install \
         deploy/udev/60-holod-latency.rules, or write 1 into /sys/bus/usb-serial/devices/{name}/latency_timer after \
         each replug"
    ))
}

/// What is wrong with reading a tracker at this port by that path.
fn port_warnings(port: &SerialPortInfo, path: &Path) -> Vec<String> {
    let mut warnings = Vec::new();
    let shown = path.display();
    if let Some(by_id) = port.by_id.as_ref().filter(|_| port.path == path) {
        let by_id = by_id.display();
        warnings.push(format!(
            "tracker port {shown} may have another number after a replug or a restart; write {by_id} instead, which stays"
        ));
    }
    warnings.extend(delay_warning("tracker", port, path));
    warnings
}

/// The latency timer's least step is 1 ms.
const LATENCY_TIMER_MAX_MS: u32 = 2;

/// The port that `path` leads to.
fn port_at<'a>(path: &Path, ports: &'a [SerialPortInfo]) -> Option<&'a SerialPortInfo> {
    let node = path.canonicalize().ok()?;
    ports.iter().find(|port| port.path.canonicalize().is_ok_and(|other| other == node))
}

/// Whether more than one of the ports looks like `device`.
fn has_twins(device: &UsbPort, ports: &[SerialPortInfo]) -> bool {
    ports.iter().filter_map(|port| port.usb.as_ref()).filter(|usb| usb.looks_like(device)).count() > 1
}

/// What else than a tracker of `profile` sends such bytes, if that is certain.
fn recognise(heard: &[u8], profile: &Profile) -> Option<String> {
    let shown = &heard[heard.len().saturating_sub(60)..];
    if heard.split(|byte| *byte == b'\n').any(is_laser_box) {
        return Some(format!("a laser box of holod's, which says `{}`", shown.escape_ascii()));
    }
    if samples(heard, profile) > 0 {
        return None;
    }
    let mut others = Profile::shipped().filter(|other| is_telling(&other.format));
    let other = others.find(|other| samples(heard, other) >= RECOGNISED_SAMPLES)?;
    Some(format!("a tracker of profile `{}`, which sends `{}`", other.name, shown.escape_ascii()))
}

/// Whether nothing else reads as this format: bare numbers might be anything's.
const fn is_telling(format: &Format) -> bool {
    matches!(format, Format::Lines | Format::LiveTrack(_) | Format::OpenGaze(_) | Format::PupilExt(_))
}

/// Samples that a profile finds in the bytes; none if it rejects as many messages.
fn samples(heard: &[u8], profile: &Profile) -> u32 {
    let (mut samples, mut rejected) = (0, 0);
    profile.decoder().push(heard, &mut |event| match event {
        WireEvent::Sample(_) => samples += 1,
        WireEvent::Rejected(_) => rejected += 1,
        WireEvent::Note | WireEvent::Partial | WireEvent::Clock(_) => {}
    });
    if samples > rejected { samples } else { 0 }
}

/// Whether a line is one that holod's laser box says: an answer or an event, with its checksum.
fn is_laser_box(line: &[u8]) -> bool {
    let line = line.trim_ascii_end();
    let Some((text, [b'*', crc @ ..])) = line.split_last_chunk::<3>() else {
        return false;
    };
    let crc = std::str::from_utf8(crc).ok().and_then(|crc| u8::from_str_radix(crc, 16).ok());
    let begins = [&b"OK "[..], b"ERR ", b"!"].into_iter().any(|word| text.starts_with(word));
    begins && crc == Some(crc8(text))
}

struct OpenPort(TTYPort);

impl OpenPort {
    /// Opens `path`, saying what is wrong and what to do about it.
    fn new(path: &Path, baud: u32) -> Result<Self, SerialError> {
        let builder = serialport::new(path.to_string_lossy(), baud).timeout(READ_TIMEOUT);
        TTYPort::open(&builder).map(Self).map_err(|error| {
            let hint = hint(error.kind(), || unit_keeps(path));
            SerialError::Open { path: path.into(), reason: error.to_string(), hint }
        })
    }
}

/// What to do about a port that does not open; `unit_keeps` says whether the service's unit does not allow it.
fn hint(found: serialport::ErrorKind, unit_keeps: impl FnOnce() -> bool) -> &'static str {
    match found {
        serialport::ErrorKind::NoDevice => "is another program using it? close that one first",
        serialport::ErrorKind::Io(ErrorKind::PermissionDenied) if unit_keeps() => KEPT_BY_UNIT,
        serialport::ErrorKind::Io(ErrorKind::PermissionDenied) => {
            "add the user to the port's group (often `dialout`) and log in again"
        }
        _ => "check the path, the cable and the tracker's power",
    }
}

impl Dialogue for OpenPort {
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.0.write_all(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        receive_from(&mut self.0, buffer)
    }
}

impl Drop for OpenPort {
    /// Waits until the last command is on its way, but not half a minute, as closing does, for a device that takes no
    /// more bytes.
    fn drop(&mut self) {
        let begun = Instant::now();
        while self.0.bytes_to_write().is_ok_and(|left| left > 0) {
            if begun.elapsed() > DRAINS {
                let _ = self.0.clear(ClearBuffer::Output);
                return;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

fn check_kind(path: &Path, root: &Path) -> Result<(), SerialError> {
    let kind = match std::fs::metadata(path) {
        Ok(metadata) => metadata.file_type(),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            return Err(SerialError::Missing { path: path.into(), ports: ports_in_words(root) });
        }
        Err(error) => {
            let hint = "check that each folder on the way may be entered";
            return Err(SerialError::Open { path: path.into(), reason: error.to_string(), hint });
        }
    };
    let not_a_port = |found, hint: String| Err(SerialError::NotAPort { path: path.into(), found, hint });
    if kind.is_dir() {
        not_a_port("a directory", format!("name one port in it; {}", ports_in_words(root)))
    } else if kind.is_file() {
        not_a_port("a regular file", format!("to play a log say `replay:{}`", path.display()))
    } else if !kind.is_char_device() {
        not_a_port("no character device", ports_in_words(root))
    } else {
        Ok(())
    }
}

fn ports_in_words(root: &Path) -> String {
    let ports = ports_below(root);
    if ports.is_empty() {
        return "no serial port is plugged in".into();
    }
    let names = ports.iter().map(|port| {
        let path = port.by_id.as_ref().unwrap_or(&port.path).display();
        port.usb.as_ref().map_or_else(|| path.to_string(), |usb| format!("{path}, {usb}"))
    });
    format!("there are {}", names.collect::<Vec<_>>().join("; "))
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use holod_calibration::is_kept_by_unit;

    use super::identity::fake::FakeSystem;
    use super::*;
    use crate::SampleEye;
    use crate::source::ReadEvent;
    use crate::wire::line::{LineSample, encode_line};

    const FTDI: &str = "0403:6001";

    /// A PTY: the tracker's end, and where the other one is.
    fn pty() -> (TTYPort, TTYPort, PathBuf) {
        let (tracker, port) = TTYPort::pair().expect("a PTY");
        let node = port.name().expect("a path").into();
        (tracker, port, node)
    }

    #[test]
    fn a_port_that_the_unit_keeps_is_told_from_one_of_another_group() {
        let says = |errno: i32| {
            let error = io::Error::from_raw_os_error(errno);
            hint(serialport::ErrorKind::Io(error.kind()), || is_kept_by_unit(&error))
        };
        let [not_permitted, access, no_entry] = [1, 13, 2].map(says);
        assert!(not_permitted.contains("`holod unit`") && access.contains("`dialout`"), "{not_permitted}; {access}");
        assert!(no_entry.contains("the cable"), "{no_entry}");
    }

    fn feed(system: &FakeSystem, path: &Path, profile: Profile, forbidden: &[PathBuf]) -> SerialFeed {
        SerialFeed::below(system.path(), path, None, profile, forbidden)
    }

    fn holod() -> Profile {
        Profile::find("holod").expect("it is shipped")
    }

    /// A tracker that is told to start, in these USB devices.
    fn talks(usb: &str) -> Profile {
        let text = format!(
            "format = \"holod-tracker-1\"\nname = \"talks\"\nabout = \"Talks.\"\n[wire]\nkind = \"holod\"\n[serial]\n\
             baud = 115200\nusb = [{usb}]\nstart = [{{ send = \"GO\\r\", expect = \"OK\", within_ms = 50 }}]\n\
             stop = [{{ send = \"HALT\\r\" }}]\n"
        );
        Profile::from_toml(&text, "test").expect("a profile")
    }

    fn error(feed: &mut SerialFeed) -> String {
        feed.open().err().expect("is refused").to_string()
    }

    fn send(tracker: &mut TTYPort, bytes: &[u8]) {
        tracker.write_all(bytes).expect("writes");
    }

    fn heard(tracker: &mut TTYPort) -> Vec<u8> {
        tracker.set_timeout(Duration::from_millis(200)).expect("sets");
        let mut bytes = Vec::new();
        // Ends at the timeout, or with an error once the other end is closed.
        let _ = tracker.read_to_end(&mut bytes);
        bytes
    }

    fn boxed(text: &str) -> Vec<u8> {
        format!("{text}*{:02X}\n", crc8(text.as_bytes())).into_bytes()
    }

    fn lines(count: u64) -> String {
        let mut text = String::new();
        for sequence in 0..count {
            let (eye, device_us) = (SampleEye::Both, sequence as i64 * 5000);
            encode_line(&LineSample { sequence, device_us, eye, diameter_mm: 4.0, confidence: 1.0 }, &mut text);
        }
        text
    }

    #[test]
    fn a_device_is_found_again_under_another_name_and_no_other_in_its_place() {
        let system = FakeSystem::new();
        let (first, port, node) = pty();
        system.plug("ttyUSB0", "1-1", FTDI, Some("A1"), &node);
        let mut feed = feed(&system, &system.port("ttyUSB0"), holod(), &[]);
        drop(port);
        drop(feed.open().expect("opens"));
        system.unplug("ttyUSB0", "1-1");
        drop(first);
        assert!(error(&mut feed).contains("does not exist"));

        // Another adapter takes the name.
        let (_stranger, _port, other) = pty();
        system.plug("ttyUSB0", "1-1", FTDI, Some("B2"), &other);
        let message = error(&mut feed);
        assert!(
            message.contains("(serial number B2); expected 0403:6001 Maker Adapter (serial number A1)"),
            "{message}"
        );

        let (mut tracker, port, node) = pty();
        system.plug("ttyUSB7", "1-3", FTDI, Some("A1"), &node);
        drop(port);
        let mut link = feed.open().expect("opens where it is now");
        send(&mut tracker, b"x");
        assert_eq!(link.read(&mut [0; 8]), ReadEvent::Bytes(1));
    }

    #[test]
    fn adapters_without_a_number_are_told_apart_by_their_socket() {
        for serial in [None, Some("0001")] {
            let system = FakeSystem::new();
            let (_tracker, port, node) = pty();
            let (_laser, _laser_port, laser) = pty();
            system.plug("ttyUSB0", "1-1", "10c4:ea60", serial, &node);
            system.plug("ttyUSB1", "1-2", "10c4:ea60", serial, &laser);
            let mut feed = feed(&system, &system.port("ttyUSB0"), holod(), &[system.port("ttyUSB1")]);
            drop(port);
            drop(feed.open().expect("opens"));
            system.unplug("ttyUSB0", "1-1");
            system.unplug("ttyUSB1", "1-2");
            // They come back, the laser box under the tracker's name.
            system.plug("ttyUSB0", "1-2", "10c4:ea60", serial, &laser);
            let message = error(&mut feed);
            assert!(message.contains("nothing was"), "{message}");
            system.plug("ttyUSB5", "1-1", "10c4:ea60", serial, &node);
            assert_eq!(feed.locate(&ports_below(system.path())).expect("found"), system.port("ttyUSB5"));
        }
    }

    #[test]
    fn a_link_that_leads_to_another_device_is_not_followed() {
        for serial in [None, Some("0001")] {
            let system = FakeSystem::new();
            let (mut tracker, port, node) = pty();
            let (mut other, other_port, other_node) = pty();
            let by_id = system.plug("ttyUSB0", "1-1", "1a86:7523", serial, &node);
            assert_eq!(system.plug("ttyUSB1", "1-2", "1a86:7523", serial, &other_node), by_id);
            let mut feed = feed(&system, &by_id, talks("\"1a86:7523\""), &[]);
            send(&mut tracker, b"OK");
            drop(port);
            drop(feed.open().expect("opens"));
            system.unplug("ttyUSB0", "1-1");
            std::os::unix::fs::symlink("../../ttyUSB1", &by_id).expect("links");
            drop(other_port);
            let message = error(&mut feed);
            let expected = "in USB socket 1-2; expected the one in socket 1-1; nothing was written to it";
            assert!(message.contains(expected), "{message}");
            assert_eq!(heard(&mut other), b"");
            // It is back, and the link still leads to the other.
            system.plug("ttyUSB5", "1-1", "1a86:7523", serial, &node);
            let found = feed.locate(&ports_below(system.path())).expect("found");
            assert_eq!(found, system.port("ttyUSB5"));
        }
    }

    #[test]
    fn the_laser_box_is_never_opened() {
        let system = FakeSystem::new();
        let (mut laser, _port, node) = pty();
        let by_id = system.plug("ttyUSB1", "1-2", FTDI, Some("L"), &node);
        for forbidden in [by_id.clone(), system.port("ttyUSB1"), node.clone()] {
            for named in [&by_id, &system.port("ttyUSB1"), &node] {
                let message = error(&mut feed(&system, named, holod(), std::slice::from_ref(&forbidden)));
                assert!(message.contains("for another device, such as its laser box; nothing was opened"), "{message}");
            }
        }
        let mut own = feed(&system, &by_id, talks(""), std::slice::from_ref(&by_id));
        error(&mut own);
        assert_eq!(heard(&mut laser), b"");
    }

    #[test]
    fn nothing_is_written_to_another_device() {
        let system = FakeSystem::new();
        let (mut tracker, port, node) = pty();
        let path = system.port("ttyUSB0");
        system.plug("ttyUSB0", "1-1", FTDI, Some("A1"), &node);
        let message = error(&mut feed(&system, &path, talks("\"1209:0001\""), &[]));
        assert!(
            message.contains(
                "0403:6001 Maker Adapter (serial number A1); expected a tracker of profile `talks`, 1209:0001"
            ),
            "{message}"
        );

        // Nor is one opened that is only listened to: that resets some boards.
        let listens = Profile::from_toml(
            "format = \"holod-tracker-1\"\nname = \"listens\"\nabout = \"Listens.\"\n[wire]\nkind = \"holod\"\n\
             [serial]\nusb = [\"1209:0001\"]\n",
            "test",
        );
        let message = error(&mut feed(&system, &path, listens.expect("a profile"), &[]));
        assert!(message.contains("expected a tracker of profile `listens`, 1209:0001"), "{message}");

        // An adapter that may be any: what it says tells.
        for (says, told) in [
            (boxed("OK 7 holod-laser-box 1 bench"), "a laser box of holod's"),
            (boxed("!HBLOST"), "a laser box of holod's"),
        ] {
            send(&mut tracker, &[&b"9*00\n"[..], &says].concat());
            let message = error(&mut feed(&system, &path, talks(""), &[]));
            assert!(message.contains(told) && message.contains("nothing was written"), "{message}");
        }
        assert_eq!(heard(&mut tracker), b"");
        drop(port);
    }

    #[test]
    fn other_protocols_are_recognised_and_the_own_one_is_not_refused() {
        let profile = |name: &str| Profile::find(name).expect("it is shipped");
        let told = recognise(lines(5).as_bytes(), &profile("livetrack")).expect("recognised");
        assert!(told.starts_with("a tracker of profile `holod`, which sends `"), "{told}");
        let gaze = "<REC TIME=\"1.5\" LPMM=\"4.8\" LPMMV=\"1\" RPMM=\"4.9\" RPMMV=\"1\" />\r\n".repeat(4);
        let told = recognise(gaze.as_bytes(), &profile("livetrack")).expect("recognised");
        assert!(told.contains("`open-gaze`"), "{told}");
        assert_eq!(recognise(gaze.as_bytes(), &profile("open-gaze")), None);
        assert_eq!(recognise(lines(5).as_bytes(), &talks("")), None);
        for heard in [&b""[..], b"Booting...\r\nready\r\n> \r\n", &boxed("HELLO"), lines(2).as_bytes()] {
            assert_eq!(recognise(heard, &profile("livetrack")), None);
        }
        assert!(is_laser_box(boxed("ERR 3 RANGE").trim_ascii_end()));
        assert!(!is_laser_box(b"ERR 3 RANGE*00"));
        assert!(!is_laser_box("!\u{e9}*é".as_bytes()));
    }

    #[test]
    fn it_is_told_to_start_and_on_its_way_out_to_stop() {
        let system = FakeSystem::new();
        let (mut tracker, port, node) = pty();
        system.plug("ttyUSB0", "1-1", FTDI, Some("A1"), &node);
        let mut feed = feed(&system, &system.port("ttyUSB0"), talks("\"0403:6001\""), &[]);
        let message = error(&mut feed);
        assert!(
            message.contains("`GO\\r` was sent 3 times and answered by nothing; expected `OK` within 50ms"),
            "{message}"
        );
        assert_eq!(heard(&mut tracker), b"GO\rGO\rGO\rHALT\r");
        // The answer to the first try is there already.
        send(&mut tracker, b"OKstream");
        let mut link = feed.open().expect("opens");
        let mut buffer = [0; 16];
        assert_eq!(link.read(&mut buffer), ReadEvent::Bytes(6));
        assert_eq!(&buffer[..6], b"stream");
        drop(link);
        assert_eq!(heard(&mut tracker), b"GO\rHALT\r");
        drop(port);
    }

    #[test]
    fn a_name_that_changes_and_a_slow_adapter_are_warned_about() {
        let system = FakeSystem::new();
        let (_tracker, _port, node) = pty();
        let by_id = system.plug("ttyUSB0", "1-1", FTDI, Some("A1"), &node);
        let warnings = feed(&system, &system.port("ttyUSB0"), holod(), &[]).warnings();
        assert_eq!(warnings.len(), 2, "{warnings:?}");
        assert!(warnings[0].contains(&format!("write {} instead", by_id.display())), "{}", warnings[0]);
        assert!(warnings[1].contains("up to 16 ms"), "{}", warnings[1]);
        assert!(warnings[1].contains("deploy/udev/60-holod-latency.rules"), "{}", warnings[1]);
        assert_eq!(feed(&system, &by_id, holod(), &[]).warnings().len(), 1);
        let timer = system.path().join("sys/devices/1-1/1-1:1.0/ttyUSB0/latency_timer");
        std::fs::write(timer, "1\n").expect("writes");
        assert_eq!(feed(&system, &by_id, holod(), &[]).warnings(), [""; 0]);
    }
}
