//! What the kernel says through a card's file descriptor and about hotplugs, without taking memory.

use holod_calibration::TimeNs;

use super::timing::FlipStamp;

const HEADER_BYTES: usize = 8;
/// Bytes of a `struct drm_event_vblank`.
const FLIP_BYTES: usize = 32;

/// Calls `flipped` with the controller (CRTC) and the stamp of each page flip in `bytes`, as read from a card. A
/// controller of 0 means that the driver does not name it. Other events are passed over.
pub(crate) fn for_each_flip(mut bytes: &[u8], mut flipped: impl FnMut(u32, FlipStamp)) {
    while bytes.len() >= HEADER_BYTES {
        let word =
            |place: usize| u32::from_ne_bytes([bytes[place], bytes[place + 1], bytes[place + 2], bytes[place + 3]]);
        let (kind, length) = (word(0), word(4) as usize);
        if length < HEADER_BYTES || length > bytes.len() {
            return;
        }
        if kind == drm_ffi::DRM_EVENT_FLIP_COMPLETE && length >= FLIP_BYTES {
            let t = TimeNs(i64::from(word(16)) * 1_000_000_000 + i64::from(word(20)) * 1000);
            flipped(word(28), FlipStamp { sequence: word(24), t });
        }
        bytes = &bytes[length..];
    }
}

/// What a kernel message means for one card.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Uevent {
    /// A connector of it may have changed.
    Changed,
    /// The card is gone.
    Removed,
    /// It is about something else.
    Other,
}

/// Reads one message of the kernel's uevent socket for the card whose node is `/dev/dri/CARD` and its connector.
pub(crate) fn read_uevent(message: &[u8], card: &[u8], connector: u32) -> Uevent {
    let value =
        |key: &[u8]| message.split(|&byte| byte == 0).find_map(|field| field.strip_prefix(key)?.strip_prefix(b"="));
    let node = value(b"DEVNAME").unwrap_or_default();
    if value(b"SUBSYSTEM") != Some(b"drm") || node.strip_prefix(b"dri/").unwrap_or(node) != card {
        return Uevent::Other;
    }
    // Only some drivers say which connector it was.
    let named = value(b"CONNECTOR").and_then(|id| std::str::from_utf8(id).ok()?.parse::<u32>().ok());
    match value(b"ACTION") {
        Some(b"remove") => Uevent::Removed,
        Some(b"change") if named.is_none_or(|id| id == connector) => Uevent::Changed,
        _ => Uevent::Other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn event(kind: u32, words: [u32; 6]) -> Vec<u8> {
        [&[kind, 32][..], &words].concat().iter().flat_map(|word| word.to_ne_bytes()).collect()
    }

    fn flips(bytes: &[u8]) -> Vec<(u32, u32, i64)> {
        let mut flips = Vec::new();
        for_each_flip(bytes, |crtc, stamp| flips.push((crtc, stamp.sequence, stamp.t.0)));
        flips
    }

    #[test]
    fn flips_are_read_and_other_events_passed_over() {
        let vblank = event(1, [0, 0, 1, 2, 3, 4]);
        let flip = event(2, [0xaaaa, 0, 12, 345_678, 99, 41]);
        let bytes = [vblank, flip.clone(), flip[..31].to_vec()].concat();
        assert_eq!(flips(&bytes), [(41, 99, 12_345_678_000)]);
    }

    #[test]
    fn an_event_of_no_length_ends_the_reading() {
        let mut bytes = event(2, [0, 0, 1, 1, 1, 1]);
        bytes[4] = 0;
        assert_eq!(flips(&bytes), []);
    }

    #[test]
    fn only_this_cards_changes_count() {
        let message = |fields: &[&str]| fields.join("\0").into_bytes();
        let hotplug = |node: &str, more: &str| {
            message(&["change@/devices/x/drm/card1", "ACTION=change", "SUBSYSTEM=drm", "HOTPLUG=1", node, more])
        };
        let read = |message: Vec<u8>| read_uevent(&message, b"card1", 77);
        assert_eq!(read(hotplug("DEVNAME=dri/card1", "")), Uevent::Changed);
        assert_eq!(read(hotplug("DEVNAME=/dev/dri/card1", "")), Uevent::Other);
        assert_eq!(read(hotplug("DEVNAME=dri/card1", "CONNECTOR=77")), Uevent::Changed);
        assert_eq!(read(hotplug("DEVNAME=dri/card1", "CONNECTOR=78")), Uevent::Other);
        assert_eq!(read(hotplug("DEVNAME=dri/card10", "")), Uevent::Other);
        assert_eq!(read(message(&["ACTION=remove", "SUBSYSTEM=drm", "DEVNAME=dri/card1"])), Uevent::Removed);
        assert_eq!(read(message(&["ACTION=change", "SUBSYSTEM=usb", "DEVNAME=dri/card1"])), Uevent::Other);
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            for_each_flip(&bytes, |_, _| {});
            read_uevent(&bytes, b"card0", 1);
        }
    }
}
