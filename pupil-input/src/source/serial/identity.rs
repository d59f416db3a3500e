//! Which serial ports there are and what is plugged in behind them, as `/sys` and `/dev` tell. The names `ttyUSB0` and
//! `ttyACM0` are handed out anew at each replug; what stays is the USB device's vendor, product and serial number.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use crate::usb_ids::UsbIds;

/// A serial port of this machine, as far as the kernel tells what is behind it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SerialPortInfo {
    /// Its device node, such as `/dev/ttyUSB0`.
    pub path: PathBuf,
    /// The name that stays the same over a replug, in `/dev/serial/by-id`.
    pub by_id: Option<PathBuf>,
    /// What is plugged in, if it is a USB device.
    pub usb: Option<UsbPort>,
    /// Name of the kernel's driver, such as `ftdi_sio`.
    pub driver: Option<String>,
    /// How long the adapter holds bytes back, ms; FTDI's chips have such a timer.
    pub latency_timer_ms: Option<u32>,
}

/// The USB device behind a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UsbPort {
    /// USB vendor and product.
    pub ids: UsbIds,
    /// Serial number, where the maker gave it one.
    pub serial: Option<String>,
    /// The maker's name, where the device gives one.
    pub manufacturer: Option<String>,
    /// The product's name, where the device gives one.
    pub product: Option<String>,
    /// Which of the device's interfaces: adapters with several ports have several.
    pub interface: Option<String>,
    /// The socket that it is plugged into, such as `1-2`.
    pub socket: String,
}

impl UsbPort {
    /// Whether both are one device's same port, by vendor, product and serial number; by the socket too where the
    /// serial number is missing or, since cheap adapters all have the same, `shared`.
    pub(crate) fn is_same(&self, other: &Self, shared: bool) -> bool {
        self.looks_like(other) && (self.serial.is_some() && !shared || self.socket == other.socket)
    }

    /// Whether nothing but the socket tells them apart.
    pub(crate) fn looks_like(&self, other: &Self) -> bool {
        self.ids == other.ids && self.serial == other.serial && self.interface == other.interface
    }
}

impl fmt::Display for UsbPort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.ids)?;
        for name in [&self.manufacturer, &self.product].into_iter().flatten() {
            write!(f, " {name}")?;
        }
        self.serial.as_ref().map_or(Ok(()), |serial| write!(f, " (serial number {serial})"))
    }
}

/// The serial ports of this machine, in the order of their names. Ports that no driver found a device for are left out.
pub fn serial_ports() -> Vec<SerialPortInfo> {
    ports_below(Path::new("/"))
}

/// The same with `/sys` and `/dev` below `root`.
pub(crate) fn ports_below(root: &Path) -> Vec<SerialPortInfo> {
    let links = by_id_links(root);
    let mut names: Vec<_> = entries(&root.join("sys/class/tty")).filter_map(|path| name_of(&path)).collect();
    names.sort_by_key(|name| {
        let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
        (stem.to_owned(), name[stem.len()..].parse::<u64>().unwrap_or(0))
    });
    names.into_iter().filter_map(|name| describe(root, &name, &links)).collect()
}

fn describe(root: &Path, name: &str, links: &[(PathBuf, PathBuf)]) -> Option<SerialPortInfo> {
    let class = root.join("sys/class/tty").join(name);
    let device = fs::canonicalize(class.join("device")).ok()?;
    // Placeholders for ports that a PC might have are devices of the platform; a real one of those is found by plug and
    // play, or has a driver of its own.
    if link_name(&device.join("subsystem")).as_deref() == Some("platform")
        && link_name(&device.join("driver")).is_none_or(|driver| driver == "serial8250")
    {
        return None;
    }
    let path = root.join("dev").join(name);
    let node = fs::canonicalize(&path).ok()?;
    let timers = [
        root.join("sys/bus/usb-serial/devices").join(name).join("latency_timer"),
        class.join("device").join("latency_timer"),
    ];
    Some(SerialPortInfo {
        by_id: links.iter().find(|(_, target)| *target == node).map(|(link, _)| link.clone()),
        usb: usb_of(&device, root),
        driver: link_name(&device.join("driver")),
        latency_timer_ms: timers.iter().find_map(|timer| text_of(timer)?.parse().ok()),
        path,
    })
}

/// The USB device above a port's own in the tree of devices.
fn usb_of(device: &Path, root: &Path) -> Option<UsbPort> {
    let root = fs::canonicalize(root).ok()?;
    let above = || device.ancestors().take_while(|folder| folder.starts_with(&root));
    let usb = above().find(|folder| folder.join("idVendor").exists())?;
    let id = |name: &str| u16::from_str_radix(&text_of(&usb.join(name))?, 16).ok();
    Some(UsbPort {
        ids: UsbIds { vendor: id("idVendor")?, product: id("idProduct")? },
        serial: text_of(&usb.join("serial")),
        manufacturer: text_of(&usb.join("manufacturer")),
        product: text_of(&usb.join("product")),
        interface: above().find_map(|folder| text_of(&folder.join("bInterfaceNumber"))),
        socket: name_of(usb)?,
    })
}

/// Each link in `/dev/serial/by-id` with what it leads to.
fn by_id_links(root: &Path) -> Vec<(PathBuf, PathBuf)> {
    let mut links: Vec<_> = entries(&root.join("dev/serial/by-id"))
        .filter_map(|link| {
            let target = fs::canonicalize(&link).ok()?;
            Some((link, target))
        })
        .collect();
    links.sort();
    links
}

fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
}

fn name_of(path: &Path) -> Option<String> {
    Some(path.file_name()?.to_str()?.to_owned())
}

fn link_name(link: &Path) -> Option<String> {
    name_of(&fs::read_link(link).ok()?)
}

/// A file of one line; none where it is empty.
fn text_of(path: &Path) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    Some(text.trim().to_owned()).filter(|text| !text.is_empty())
}

/// A made-up `/sys` and `/dev`.
#[cfg(test)]
pub(crate) mod fake {
    use std::os::unix::fs::symlink;

    use tempfile::TempDir;

    use super::*;

    pub(crate) struct FakeSystem {
        pub(crate) root: TempDir,
    }

    impl FakeSystem {
        pub(crate) fn new() -> Self {
            let root = TempDir::new().expect("a folder");
            for folder in ["sys/class/tty", "sys/devices", "sys/drivers/ftdi_sio", "dev/serial/by-id"] {
                fs::create_dir_all(root.path().join(folder)).expect("a folder");
            }
            Self { root }
        }

        pub(crate) fn path(&self) -> &Path {
            self.root.path()
        }

        pub(crate) fn port(&self, name: &str) -> PathBuf {
            self.path().join("dev").join(name)
        }

        pub(crate) fn by_id(&self, name: &str) -> PathBuf {
            self.path().join("dev/serial/by-id").join(name)
        }

        /// Plugs an adapter with an FTDI chip into `socket`; `node` stands for the port. Gives the name of its link.
        pub(crate) fn plug(&self, name: &str, socket: &str, ids: &str, serial: Option<&str>, node: &Path) -> PathBuf {
            let usb = self.path().join("sys/devices").join(socket);
            let port = usb.join(format!("{socket}:1.0")).join(name);
            fs::create_dir_all(&port).expect("a folder");
            let (vendor, product) = ids.split_once(':').expect("ids");
            let write = |path: &Path, text: &str| fs::write(path, format!("{text}\n")).expect("writes");
            write(&usb.join("idVendor"), vendor);
            write(&usb.join("idProduct"), product);
            write(&usb.join("manufacturer"), "Maker");
            write(&usb.join("product"), "Adapter");
            if let Some(serial) = serial {
                write(&usb.join("serial"), serial);
            }
            write(&usb.join(format!("{socket}:1.0/bInterfaceNumber")), "00");
            write(&port.join("latency_timer"), "16");
            symlink("../../../../drivers/ftdi_sio", port.join("driver")).expect("links");
            let class = self.path().join("sys/class/tty").join(name);
            fs::create_dir_all(&class).expect("a folder");
            symlink(&port, class.join("device")).expect("links");
            symlink(node, self.port(name)).expect("links");
            let link = self.by_id(&format!("usb-Maker_Adapter_{}-if00-port0", serial.unwrap_or("none")));
            if !link.is_symlink() {
                symlink(format!("../../{name}"), &link).expect("links");
            }
            link
        }

        pub(crate) fn unplug(&self, name: &str, socket: &str) {
            fs::remove_dir_all(self.path().join("sys/devices").join(socket)).expect("removes");
            fs::remove_dir_all(self.path().join("sys/class/tty").join(name)).expect("removes");
            fs::remove_file(self.port(name)).expect("removes");
            for link in entries(&self.path().join("dev/serial/by-id")) {
                if fs::canonicalize(&link).is_err() {
                    fs::remove_file(link).expect("removes");
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::fake::FakeSystem;
    use super::*;

    #[test]
    fn a_port_is_described_by_what_is_plugged_in() {
        let system = FakeSystem::new();
        assert_eq!(ports_below(system.path()), []);
        let node = system.path().join("node");
        fs::write(&node, "").expect("writes");
        let second = system.path().join("second");
        fs::write(&second, "").expect("writes");
        let by_id = system.plug("ttyUSB10", "1-2.4", "0403:6001", Some("A1"), &node);
        system.plug("ttyUSB9", "1-3", "10c4:ea60", None, &second);
        // A placeholder, a terminal, and a port without a node.
        fs::create_dir_all(system.path().join("sys/class/tty/tty1")).expect("a folder");
        fs::create_dir_all(system.path().join("sys/class/tty/ttyS0/device")).expect("a folder");

        let ports = ports_below(system.path());
        let names: Vec<_> = ports.iter().map(|port| port.path.clone()).collect();
        assert_eq!(names, [system.port("ttyUSB9"), system.port("ttyUSB10")]);
        let usb = UsbPort {
            ids: "0403:6001".parse().expect("ids"),
            serial: Some("A1".into()),
            manufacturer: Some("Maker".into()),
            product: Some("Adapter".into()),
            interface: Some("00".into()),
            socket: "1-2.4".into(),
        };
        assert_eq!(usb.to_string(), "0403:6001 Maker Adapter (serial number A1)");
        assert_eq!(ports[1].usb.as_ref(), Some(&usb));
        assert_eq!(ports[1].by_id, Some(by_id));
        assert_eq!(ports[1].driver.as_deref(), Some("ftdi_sio"));
        assert_eq!(ports[1].latency_timer_ms, Some(16));
        assert_eq!(ports[0].usb.as_ref().expect("USB").serial, None);
        system.unplug("ttyUSB10", "1-2.4");
        assert_eq!(ports_below(system.path()).len(), 1);
    }

    #[test]
    fn devices_are_told_apart_by_number_and_where_there_is_none_by_socket() {
        let device = |serial: Option<&str>, socket: &str| UsbPort {
            ids: "1a86:7523".parse().expect("ids"),
            serial: serial.map(Into::into),
            manufacturer: None,
            product: None,
            interface: None,
            socket: socket.into(),
        };
        let a = device(Some("A"), "1-1");
        assert!(a.is_same(&device(Some("A"), "1-2"), false));
        assert!(!a.is_same(&device(Some("A"), "1-2"), true), "two that look alike");
        assert!(!a.is_same(&device(Some("B"), "1-1"), false));
        assert!(device(None, "1-1").is_same(&device(None, "1-1"), false));
        assert!(!device(None, "1-1").is_same(&device(None, "1-2"), false));
        assert!(!a.is_same(&UsbPort { ids: "1a86:7522".parse().expect("ids"), ..a.clone() }, false));
    }
}
