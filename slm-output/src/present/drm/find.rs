//! Which connectors the machine has, from sysfs: without opening a card, which could make this process its master.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use super::edid::Edid;

/// Where the kernel lists cards and connectors.
pub(crate) const SYS_CLASS_DRM: &str = "/sys/class/drm";

/// A connector, as the kernel last saw it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SeenConnector {
    /// The card's device node, for example `/dev/dri/card0`.
    pub card: PathBuf,
    /// The card's driver, for example `amdgpu`, where the kernel says.
    pub driver: Option<String>,
    /// The connector's name, for example `DP-1`.
    pub name: String,
    /// Whether a monitor is at it; `None` where the driver cannot tell.
    pub connected: Option<bool>,
    /// Who the monitor is, where it says so.
    pub edid: Option<Edid>,
}

impl SeenConnector {
    /// Whether the monitor gets YCbCr 4:4:4 in place of RGB: amdgpu, which has no property for it, sends it to each HDMI
    /// monitor that takes it.
    pub(crate) fn sends_ycbcr_444(&self) -> bool {
        let takes_it = self.edid.as_ref().is_some_and(|edid| edid.takes_ycbcr_444);
        self.driver.as_deref() == Some("amdgpu") && self.name.starts_with("HDMI-") && takes_it
    }
}

/// All connectors, for messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConnectorList(pub Vec<SeenConnector>);

/// What was asked for is no connector, or more than one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum NotFound {
    NoCard,
    None(ConnectorList),
    Several(ConnectorList),
}

impl fmt::Display for ConnectorList {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, seen) in self.0.iter().enumerate() {
            let state = match seen.connected {
                Some(true) => "connected",
                Some(false) => "disconnected",
                None => "unknown state",
            };
            write!(f, "{}{} on {}: {state}", if index == 0 { "" } else { "; " }, seen.name, seen.card.display())?;
            if let Some(edid) = &seen.edid {
                write!(f, ", {edid}")?;
            }
        }
        if self.0.is_empty() { f.write_str("no connector at all") } else { Ok(()) }
    }
}

/// Every connector of every card below `class` (usually `/sys/class/drm`), sorted by card and name. Writeback
/// connectors, which are memory and no monitor, are left out.
pub(crate) fn seen_connectors(class: &Path) -> ConnectorList {
    let entries = fs::read_dir(class).into_iter().flatten().flatten();
    let mut seen: Vec<_> = entries
        .filter_map(|entry| {
            let name = entry.file_name().into_string().ok()?;
            let (card, connector) = name.split_once('-')?;
            card.strip_prefix("card")?.parse::<u32>().ok()?;
            (!connector.starts_with("Writeback-")).then(|| read_connector(&entry.path(), card, connector))
        })
        .collect();
    seen.sort_by(|a, b| {
        (a.card.as_os_str().len(), &a.card, &a.name).cmp(&(b.card.as_os_str().len(), &b.card, &b.name))
    });
    ConnectorList(seen)
}

fn read_connector(folder: &Path, card: &str, connector: &str) -> SeenConnector {
    let status = fs::read_to_string(folder.join("status")).unwrap_or_default();
    let driver = fs::read_link(folder.with_file_name(card).join("device/driver")).ok();
    SeenConnector {
        card: Path::new("/dev/dri").join(card),
        driver: driver.and_then(|driver| Some(driver.file_name()?.to_str()?.to_owned())),
        name: connector.to_owned(),
        connected: match status.trim() {
            "connected" => Some(true),
            "disconnected" => Some(false),
            _ => None,
        },
        edid: fs::read(folder.join("edid")).ok().and_then(|bytes| Edid::parse(&bytes)),
    }
}

/// The connector whose name is `asked`, or else the one whose monitor is; of `card` only, where one is given.
pub(crate) fn choose(all: ConnectorList, asked: &str, card: Option<&Path>) -> Result<SeenConnector, NotFound> {
    if all.0.is_empty() {
        return Err(NotFound::NoCard);
    }
    let on_card = |seen: &&SeenConnector| card.is_none_or(|card| seen.card == card);
    let by_name = |seen: &&SeenConnector| seen.name.eq_ignore_ascii_case(asked);
    let by_monitor = |seen: &&SeenConnector| seen.edid.as_ref().is_some_and(|edid| edid.is(asked));
    let mut found: Vec<_> = all.0.iter().filter(on_card).filter(by_name).cloned().collect();
    if found.is_empty() {
        found = all.0.iter().filter(on_card).filter(by_monitor).cloned().collect();
    }
    match found.len() {
        0 => Err(NotFound::None(all)),
        1 => Ok(found.remove(0)),
        _ => Err(NotFound::Several(ConnectorList(found))),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::super::edid::tests::{block, block_with_extension};
    use super::*;
    use holod_calibration::Resolution;

    fn put(class: &Path, name: &str, status: &str, edid: &[u8]) {
        fs::create_dir_all(class.join(name)).unwrap();
        fs::write(class.join(name).join("status"), format!("{status}\n")).unwrap();
        fs::write(class.join(name).join("edid"), edid).unwrap();
    }

    fn machine() -> tempfile::TempDir {
        let class = tempfile::tempdir().unwrap();
        let size = Resolution { width: 1920, height: 1080 };
        for folder in ["card0", "card1", "renderD128", "card10"] {
            fs::create_dir(class.path().join(folder)).unwrap();
        }
        put(class.path(), "card0-DP-1", "connected", &block(size, "Desk", "1", 0));
        put(class.path(), "card1-DP-1", "connected", &block(size, "PLUTO", "6001", 0));
        put(class.path(), "card1-HDMI-A-1", "connected", &block(size, "PLUTO", "6002", 0));
        put(class.path(), "card1-HDMI-A-2", "disconnected", &[]);
        put(class.path(), "card10-Writeback-1", "unknown", &[]);
        put(class.path(), "card10-Virtual-1", "unknown", &[]);
        class
    }

    #[test]
    fn connectors_are_listed_with_their_monitors() {
        let class = machine();
        let said = seen_connectors(class.path()).to_string();
        assert_eq!(
            said,
            "DP-1 on /dev/dri/card0: connected, \"Desk\" serial \"1\"; \
             DP-1 on /dev/dri/card1: connected, \"PLUTO\" serial \"6001\"; \
             HDMI-A-1 on /dev/dri/card1: connected, \"PLUTO\" serial \"6002\"; \
             HDMI-A-2 on /dev/dri/card1: disconnected; Virtual-1 on /dev/dri/card10: unknown state"
        );
    }

    #[test]
    fn one_is_chosen_by_name_by_monitor_or_by_serial_number() {
        let class = machine();
        let choose = |asked: &str, card: Option<&str>| {
            choose(seen_connectors(class.path()), asked, card.map(Path::new))
                .map(|seen| format!("{} {}", seen.card.display(), seen.name))
        };
        for asked in ["HDMI-A-1", "hdmi-a-1", "6002", "PLUTO 6002"] {
            assert_eq!(choose(asked, None).unwrap(), "/dev/dri/card1 HDMI-A-1", "{asked}");
        }
        assert_eq!(choose("DP-1", Some("/dev/dri/card1")).unwrap(), "/dev/dri/card1 DP-1");
        assert_eq!(choose("desk", None).unwrap(), "/dev/dri/card0 DP-1");
    }

    #[test]
    fn none_and_several_are_refused_with_what_there_is() {
        let class = machine();
        let all = seen_connectors(class.path());
        let count = |found: Result<SeenConnector, NotFound>| match found.unwrap_err() {
            NotFound::None(list) => (0, list.0.len()),
            NotFound::Several(list) => (2, list.0.len()),
            NotFound::NoCard => (9, 0),
        };
        assert_eq!(count(choose(all.clone(), "DP-3", None)), (0, 5));
        assert_eq!(count(choose(all.clone(), "HDMI-A-1", Some(Path::new("/dev/dri/card0")))), (0, 5));
        assert_eq!(count(choose(all.clone(), "DP-1", None)), (2, 2));
        assert_eq!(count(choose(all, "PLUTO", None)), (2, 2));
        assert_eq!(count(choose(seen_connectors(Path::new("/nowhere")), "DP-1", None)), (9, 0));
    }

    #[test]
    fn only_amdgpu_is_known_to_send_ycbcr_to_an_hdmi_monitor_that_takes_it() {
        const YCBCR_444: u8 = 0x20;
        let class = machine();
        let size = Resolution { width: 1920, height: 1080 };
        for (card, driver) in [("card0", "i915"), ("card1", "amdgpu")] {
            fs::create_dir(class.path().join(card).join("device")).unwrap();
            symlink(format!("../../../bus/pci/drivers/{driver}"), class.path().join(card).join("device/driver"))
                .unwrap();
        }
        for name in ["card0-HDMI-A-1", "card1-DP-1", "card1-HDMI-A-1"] {
            put(class.path(), name, "connected", &block_with_extension(size, YCBCR_444));
        }
        put(class.path(), "card1-HDMI-A-2", "connected", &block_with_extension(size, 0));
        let all = seen_connectors(class.path());
        let sending: Vec<_> = all.0.iter().filter(|seen| seen.sends_ycbcr_444()).map(|seen| &seen.name).collect();
        assert_eq!(sending, ["HDMI-A-1"]);
        assert_eq!(all.0.iter().find(|seen| seen.name == "DP-1").unwrap().driver.as_deref(), Some("i915"));
    }
}
