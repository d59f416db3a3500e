//! Which of the HID devices is the tracker: pure, so that it is tested without any device.

use std::fmt;
use std::path::PathBuf;

use crate::usb_ids::UsbIds;

/// What tells a device from others, however often it is replugged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Identity {
    pub(super) ids: UsbIds,
    /// Its serial number; empty where it has none.
    pub(super) serial: String,
    /// The USB interface; -1 off USB.
    pub(super) interface: i32,
}

/// A device that there is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Candidate {
    pub(super) path: PathBuf,
    pub(super) identity: Identity,
    pub(super) product: String,
    pub(super) bluetooth: bool,
    /// Usage page and usage of each of its top collections.
    pub(super) usages: Vec<(u16, u16)>,
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { ids, serial, .. } = self;
        write!(f, "{ids}")?;
        if serial.is_empty() { Ok(()) } else { write!(f, " serial={serial}") }
    }
}

impl fmt::Display for Candidate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { path, identity: Identity { ids, serial, .. }, product, bluetooth, usages } = self;
        write!(f, "{ids}")?;
        if !product.is_empty() {
            write!(f, " `{product}`")?;
        }
        if !serial.is_empty() {
            write!(f, " serial={serial}")?;
        }
        if let Some((page, usage)) = usages.first() {
            write!(f, " usage {page:04x}:{usage:04x}")?;
        }
        write!(f, " at {}{}", path.display(), if *bluetooth { " (Bluetooth)" } else { "" })
    }
}

/// The devices in words; at most sixteen of them.
pub(super) fn in_words<'a>(candidates: impl IntoIterator<Item = &'a Candidate>) -> String {
    const MOST: usize = 16;
    let names: Vec<_> = candidates.into_iter().map(Candidate::to_string).collect();
    match names.len() {
        0 => "there is no HID device at all".into(),
        count => {
            let more = if count > MOST { format!(" and {} more", count - MOST) } else { String::new() };
            format!("there are {}{more}", names[..count.min(MOST)].join(", "))
        }
    }
}

/// One of some ids, in words.
pub(super) fn either(ids: &[UsbIds]) -> String {
    ids.iter().map(UsbIds::to_string).collect::<Vec<_>>().join(" or ")
}

/// What is looked for; what is None or empty may be anything.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Wanted {
    /// It has one of these, vendor and product.
    pub(crate) ids: Vec<UsbIds>,
    pub(crate) serial: Option<String>,
    pub(crate) usage_page: Option<u16>,
    pub(crate) usage: Option<u16>,
}

impl fmt::Display for Wanted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { ids, serial, usage_page, usage } = self;
        let parts = [
            (!ids.is_empty()).then(|| either(ids)),
            serial.as_ref().map(|serial| format!("serial={serial}")),
            usage_page.map(|page| format!("usage page {page:04x}")),
            usage.map(|usage| format!("usage {usage:04x}")),
        ];
        f.write_str(&parts.into_iter().flatten().collect::<Vec<_>>().join(" with "))
    }
}

/// What a choice among the devices gave.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Choice<'a> {
    One(&'a Candidate),
    /// Only one fits, and it is another than the one that was open: their serial numbers differ.
    Another(&'a Candidate),
    None,
    Several(Vec<&'a Candidate>),
}

impl Wanted {
    fn fits(&self, candidate: &Candidate) -> bool {
        let Self { ids, serial, usage_page, usage } = self;
        let has_usage = |&(page, id): &(u16, u16)| {
            usage_page.is_none_or(|wanted| wanted == page) && usage.is_none_or(|wanted| wanted == id)
        };
        (ids.is_empty() || ids.contains(&candidate.identity.ids))
            && serial.as_ref().is_none_or(|serial| *serial == candidate.identity.serial)
            && (usage_page.is_none() && usage.is_none() || candidate.usages.iter().any(has_usage))
    }

    /// The device that fits; where several do, the one of them that is `last`.
    pub(super) fn choose<'a>(&self, candidates: &'a [Candidate], last: Option<&Identity>) -> Choice<'a> {
        let fitting: Vec<_> = candidates.iter().filter(|candidate| self.fits(candidate)).collect();
        match fitting[..] {
            [] => Choice::None,
            [only] if last.is_some_and(|last| !last.serial.is_empty() && last.serial != only.identity.serial) => {
                Choice::Another(only)
            }
            [only] => Choice::One(only),
            _ => {
                let mut same = fitting.iter().filter(|candidate| Some(&candidate.identity) == last);
                match (same.next(), same.next()) {
                    (Some(only), None) => Choice::One(only),
                    _ => Choice::Several(fitting),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRACKER: UsbIds = UsbIds { vendor: 0x1209, product: 1 };

    fn device(node: u32, ids: UsbIds, serial: &str, usage: (u16, u16)) -> Candidate {
        Candidate {
            path: format!("/dev/hidraw{node}").into(),
            identity: Identity { ids, serial: serial.into(), interface: -1 },
            product: "thing".into(),
            bluetooth: false,
            usages: vec![(1, 6), usage],
        }
    }

    fn bench() -> Vec<Candidate> {
        vec![
            device(0, UsbIds { vendor: 0x046d, product: 0xc31c }, "", (0x0c, 1)),
            device(1, TRACKER, "A1", (0xff00, 1)),
            device(2, TRACKER, "A2", (0xff00, 1)),
            device(3, UsbIds { vendor: 0x1209, product: 2 }, "", (0xff00, 2)),
        ]
    }

    fn chosen(wanted: &Wanted, last: Option<&Identity>) -> Vec<usize> {
        let bench = bench();
        let place = |candidate: &Candidate| bench.iter().position(|other| other == candidate).expect("of the bench");
        match wanted.choose(&bench, last) {
            Choice::One(one) | Choice::Another(one) => vec![place(one)],
            Choice::None => vec![],
            Choice::Several(several) => several.into_iter().map(place).collect(),
        }
    }

    #[test]
    fn a_device_is_found_by_ids_serial_or_usage() {
        let any = Wanted::default();
        let by = |wanted: Wanted| chosen(&wanted, None);
        assert_eq!(by(Wanted { ids: vec![UsbIds { vendor: 0x1209, product: 2 }], ..any.clone() }), [3]);
        assert_eq!(by(Wanted { ids: vec![TRACKER], ..any.clone() }), [1, 2]);
        assert_eq!(by(Wanted { ids: vec![TRACKER], serial: Some("A2".into()), ..any.clone() }), [2]);
        assert_eq!(by(Wanted { serial: Some("A1".into()), ..any.clone() }), [1]);
        assert_eq!(by(Wanted { usage_page: Some(0xff00), usage: Some(2), ..any.clone() }), [3]);
        assert_eq!(by(Wanted { usage_page: Some(0xff00), ..any.clone() }), [1, 2, 3]);
        // Page and usage must be of one collection: 0001:0006 and ff00:0002 are no ff00:0006.
        assert_eq!(by(Wanted { usage_page: Some(0xff00), usage: Some(6), ..any.clone() }), [0; 0]);
        assert_eq!(by(Wanted { ids: vec![TRACKER], serial: Some("A3".into()), ..any.clone() }), [0; 0]);
        assert_eq!(by(any), [0, 1, 2, 3]);
    }

    #[test]
    fn of_twins_the_one_that_was_open_is_taken_again() {
        let wanted = Wanted { ids: vec![TRACKER], ..Wanted::default() };
        assert_eq!(chosen(&wanted, Some(&bench()[2].identity)), [2]);
        let stranger = Identity { serial: "A3".into(), ..bench()[1].identity.clone() };
        assert_eq!(chosen(&wanted, Some(&stranger)), [1, 2]);
        // Nor is a twin followed that is there alone, nor one without a serial number refused.
        let alone = std::slice::from_ref(&bench()[2]).to_vec();
        assert!(matches!(wanted.choose(&alone, Some(&bench()[1].identity)), Choice::Another(_)));
        assert!(matches!(wanted.choose(&alone, Some(&bench()[2].identity)), Choice::One(_)));
        let nameless = Identity { serial: String::new(), ..bench()[1].identity.clone() };
        assert!(matches!(wanted.choose(&alone, Some(&nameless)), Choice::One(_)));
        // Two that cannot be told apart are never guessed between.
        let twins = [device(1, TRACKER, "", (0xff00, 1)), device(2, TRACKER, "", (0xff00, 1))];
        assert!(matches!(wanted.choose(&twins, Some(&twins[0].identity)), Choice::Several(_)));
    }

    #[test]
    fn devices_and_wishes_are_told_in_words() {
        let wanted = Wanted { ids: vec![TRACKER], serial: Some("A1".into()), usage_page: Some(0xff00), usage: None };
        assert_eq!(wanted.to_string(), "1209:0001 with serial=A1 with usage page ff00");
        assert_eq!(in_words(&[]), "there is no HID device at all");
        assert_eq!(
            in_words(&bench()[..2]),
            "there are 046d:c31c `thing` usage 0001:0006 at /dev/hidraw0, \
             1209:0001 `thing` serial=A1 usage 0001:0006 at /dev/hidraw1"
        );
        let many = vec![bench()[0].clone(); 20];
        assert!(in_words(&many).ends_with(" and 4 more"));
    }
}
