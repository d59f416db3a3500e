//! The udev rule that lets a user read a tracker's hidraw node, which only root may by default.

use crate::usb_ids::UsbIds;

/// Where the rule belongs. Its number lies before 73-seat-late.rules, which is what acts on `uaccess`.
pub const RULE_FILE: &str = "/etc/udev/rules.d/61-holod-tracker-hid.rules";

/// The rule, one line without its end: whoever sits at the machine and the group `dialout` may read the tracker.
///
/// The kernel names a HID device `BUS:VID:PID.N` in upper-case hexadecimals, over USB as over Bluetooth.
pub fn udev_rule(ids: UsbIds) -> String {
    let UsbIds { vendor, product } = ids;
    format!(
        "SUBSYSTEM==\"hidraw\", KERNELS==\"????:{vendor:04X}:{product:04X}.*\", \
         GROUP=\"dialout\", MODE=\"0660\", TAG+=\"uaccess\""
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rule_names_the_device_as_the_kernel_does() {
        assert_eq!(
            udev_rule(UsbIds { vendor: 0x12ab, product: 0x1 }),
            r#"SUBSYSTEM=="hidraw", KERNELS=="????:12AB:0001.*", GROUP="dialout", MODE="0660", TAG+="uaccess""#
        );
    }

    #[test]
    fn the_file_to_install_has_the_rule_of_the_shipped_tracker() {
        let file = include_str!("../../../../deploy/udev/61-holod-tracker-hid.rules");
        let rule = udev_rule(UsbIds { vendor: 0x1209, product: 0x0001 });
        assert_eq!(file.lines().filter(|line| !line.starts_with('#') && !line.is_empty()).collect::<Vec<_>>(), [rule]);
    }
}
