//! What can keep a connector from being opened.

use std::io;
use std::path::PathBuf;

use holod_calibration::{KEPT_BY_UNIT, Resolution};

use super::check::DisplayCheck;
use super::find::ConnectorList;

/// Why a panel on a connector was not opened.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum DrmError {
    /// No card with connectors.
    #[error(
        "no display connector at all: {class} lists none. The panel's graphics card needs a kernel driver with mode \
         setting (`ls {class}`)"
    )]
    NoCard {
        /// Where cards are listed.
        class: &'static str,
    },
    /// No connector or monitor of that name.
    #[error(
        "no connector and no monitor is `{asked}`; there is: {there}. Name a connector, a monitor's name or its serial \
         number"
    )]
    NoSuchConnector {
        /// What was asked for.
        asked: String,
        there: ConnectorList,
    },
    /// Several connectors are called so.
    #[error("`{asked}` is more than one: {there}. Add `,card=/dev/dri/cardN`, or name the monitor's serial number")]
    Ambiguous {
        /// What was asked for.
        asked: String,
        /// Those that it may be.
        there: ConnectorList,
    },
    /// Nothing is plugged in.
    #[error("{connector} on {card} is disconnected; there is: {there}. Plug the panel in and switch it on")]
    Disconnected { connector: String, card: PathBuf, there: ConnectorList },
    /// The card's node may not be opened.
    #[error(
        "{card} does not open: permission denied. It belongs to group `{group}` (mode {mode:04o}): add the user that runs \
         holod to it (`usermod -aG {group} USER`; the service's unit has it in SupplementaryGroups), or as root give the \
         card to a group of your own with this line in {RULE_FILE}:\n\
         SUBSYSTEM==\"drm\", KERNEL==\"{kernel}\", GROUP=\"video\", MODE=\"0660\"\n\
         then `udevadm control --reload && udevadm trigger --subsystem-match=drm --action=change`"
    )]
    Permission {
        card: PathBuf,
        group: String,
        mode: u32,
        /// Its name in the kernel.
        kernel: String,
    },
    /// The card's node may not be opened whatever its mode is.
    #[error("{card} does not open: {KEPT_BY_UNIT}")]
    NotAllowed { card: PathBuf },
    /// The seat's manager does not open the card: its node is gone, or it belongs to another seat.
    #[error("the seat's manager does not open {card}: {source}")]
    NotOfSeat { card: PathBuf, source: io::Error },
    /// Another program rules the card.
    #[error(
        "another program is master of {card}: {}. One program at a time may set a card's modes: end it, or give the \
         panel a card of its own", if who.is_empty() { "it cannot be told which (as root it can)".to_owned() } else { who.join(", ") }
    )]
    OtherMaster {
        card: PathBuf,
        /// The programs that have it open, the master first where it is known.
        who: Vec<String>,
    },
    /// The monitor says that it has other pixels.
    #[error(
        "the panel at {connector} has {} by {} pixels, as its EDID says, and the rig says {} by {}. Another panel would \
         scale the pattern: correct the connector or the rig file, with `video_width_px` and `video_height_px` where the \
         panel shows a part of its video frame", found.width, found.height, wanted.width, wanted.height
    )]
    OtherSize {
        connector: String,
        /// The panel's own size.
        found: Resolution,
        wanted: Resolution,
    },
    /// The size and rate are not offered.
    #[error(
        "{connector} offers no mode of {} by {} pixels at {wanted_hz:.3} Hz (within 0.1 %); it offers: {offered}. Correct \
         the rig's `refresh_hz` or the panel's own settings", wanted.width, wanted.height
    )]
    NoSuchMode {
        connector: String,
        wanted: Resolution,
        /// The rig's refresh rate.
        wanted_hz: f64,
        /// Every mode that there is.
        offered: String,
    },
    /// The driver lacks something that is needed.
    #[error("{card} (driver `{driver}`) cannot be used: {lacks}")]
    Unsupported { card: PathBuf, driver: String, lacks: String },
    /// The driver takes the mode, but the picture would not be the one that is sent.
    #[error(
        "{connector} would not show the levels as they are sent: {}. Put it right with the driver's or the panel's own \
         settings",
        list(wrong)
    )]
    NotAsSent { connector: String, wrong: Vec<DisplayCheck> },
    /// The kernel refused something.
    #[error("{what} on {card}: {source}")]
    Refused { what: &'static str, card: PathBuf, source: io::Error },
}

/// Where a rule for the panel's card goes.
pub(crate) const RULE_FILE: &str = "/etc/udev/rules.d/62-holod-panel.rules";

fn list(checks: &[DisplayCheck]) -> String {
    let line = |check: &DisplayCheck| format!("{} is {}, wanted {}", check.name, check.found, check.wanted);
    checks.iter().map(line).collect::<Vec<_>>().join("; ")
}
