//! Which monitor is at a connector, to tell when another one is.

use drm::control::{Device as _, property};
use rustix::io::Errno;

use super::card::Card;
use super::properties::Properties;

/// An EDID has 256 blocks of 128 bytes at most.
const EDID_BYTES_MAX: usize = 256 * 128;

/// The monitor that a connector was made ready for, by all that its EDID says.
#[derive(Debug)]
pub(crate) struct Monitor {
    property: property::Handle,
    edid: Vec<u8>,
    /// Memory for another one.
    now: Vec<u8>,
}

impl Monitor {
    /// The one at the connector with `properties`, where its driver has one for EDIDs.
    pub(crate) fn of(card: &Card, properties: &Properties) -> Option<Self> {
        let (info, blob) = properties.find("EDID")?;
        let edid = if *blob == 0 { Some(Vec::new()) } else { card.get_property_blob(*blob).ok() }?;
        Some(Self { property: info.handle(), edid, now: Vec::with_capacity(EDID_BYTES_MAX) })
    }

    /// Whether the connector's `values` are of the same monitor, or say nothing of who it is; `read` reads what the kernel
    /// has by a number, which tells nothing by itself: one that was given up is given again, to another EDID. Takes no
    /// memory.
    pub(crate) fn is_same(
        &mut self,
        values: impl IntoIterator<Item = (u32, u64)>,
        read: impl FnOnce(u64, &mut Vec<u8>) -> Result<(), Errno>,
    ) -> Result<bool, Errno> {
        let edid = u32::from(self.property);
        let blob = values.into_iter().find_map(|(property, value)| (property == edid).then_some(value));
        let Some(blob) = blob.filter(|&blob| blob != 0) else { return Ok(true) };
        read(blob, &mut self.now)?;
        Ok(self.now == self.edid)
    }
}

#[cfg(test)]
mod tests {
    use super::super::edid::tests::block;
    use super::*;
    use holod_calibration::Resolution;

    const EDID: u32 = 7;

    fn monitor(edid: &[u8]) -> Monitor {
        let property = drm::control::from_u32::<property::Handle>(EDID).unwrap();
        Monitor { property, edid: edid.to_vec(), now: Vec::with_capacity(EDID_BYTES_MAX) }
    }

    fn edid(serial: &str) -> Vec<u8> {
        block(Resolution { width: 1920, height: 1080 }, "PLUTO-2.1", serial, 0)
    }

    fn reads(edid: Vec<u8>) -> impl Fn(u64, &mut Vec<u8>) -> Result<(), Errno> {
        move |_, bytes| {
            bytes.clear();
            bytes.extend_from_slice(&edid);
            Ok(())
        }
    }

    fn unread(_: u64, _: &mut Vec<u8>) -> Result<(), Errno> {
        Err(Errno::NOENT)
    }

    #[test]
    fn another_monitor_is_told_from_the_same_one_that_was_read_anew() {
        let mut seen = monitor(&edid("6001"));
        assert_eq!(seen.is_same([(3, 41), (EDID, 41)], reads(edid("6001"))), Ok(true));
        assert_eq!(seen.is_same([(EDID, 41)], reads(edid("6002"))), Ok(false), "by the same number");
        assert_eq!(seen.is_same([(EDID, 42)], unread), Err(Errno::NOENT));
        assert_eq!(seen.is_same([(EDID, 43)], reads(edid("6001"))), Ok(true), "the first one again");
    }

    #[test]
    fn a_monitor_that_does_not_say_who_it_is_is_no_other() {
        let mut seen = monitor(&edid("6001"));
        assert_eq!(seen.is_same([(EDID, 0)], unread), Ok(true));
        assert_eq!(seen.is_same([(3, 41)], unread), Ok(true));
        let mut silent = monitor(&[]);
        assert_eq!(silent.is_same([(EDID, 0)], unread), Ok(true));
        assert_eq!(silent.is_same([(EDID, 41)], reads(edid("6001"))), Ok(false));
    }
}
