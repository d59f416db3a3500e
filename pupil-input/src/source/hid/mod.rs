//! A HID tracker on the kernel's hidraw: found by what it is, not by the number of its node; read one report at a time.
//!
//! hidapi with its pure Rust back end reads sysfs for the devices there are and `/dev/hidrawN` for the reports, with
//! neither libudev nor libusb. Its read allocates nothing while reports come (a poll and a read); only an error does.

mod rule;
mod select;

use std::fs::File;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use hidapi::{BusType, HidApi, HidDevice, MAX_REPORT_DESCRIPTOR_SIZE};
use holod_calibration::{KEPT_BY_UNIT, is_kept_by_unit};

pub use rule::{RULE_FILE, udev_rule};
pub(crate) use select::Wanted;
use select::{Candidate, Choice, Identity, either, in_words};

use super::{ByteSource, Feed, READ_TIMEOUT, ReadEvent, SourceError};
use crate::profile::{HidSettings, Profile};
use crate::usb_ids::UsbIds;
use crate::wire::hid_descriptor::DescriptorError;

/// Why a HID tracker could not be opened.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum HidError {
    /// No HID device fits what is looked for.
    #[error(
        "no HID device is {wanted}; {found}; plug the tracker in, or correct the ids, the serial number or the profile"
    )]
    Missing {
        /// What was looked for, in words.
        wanted: String,
        /// The devices there are, in words.
        found: String,
    },
    /// More than one device fits, and none of them is the one that was open before.
    #[error("{count} HID devices are {wanted}: {found}; say which one: add `,serial=TEXT` to the tracker's spec")]
    Several {
        count: usize,
        /// What was looked for, in words.
        wanted: String,
        /// Those that fit, in words.
        found: String,
    },
    /// The one that was open is gone, and another is there.
    #[error("the HID device that fits is {found}; expected {expected} again; plug the tracker in, or start holod anew")]
    Another {
        /// What is there, in words.
        found: String,
        /// What was open, in words.
        expected: String,
    },
    /// The user may not open it.
    #[error(
        "HID tracker {ids} at {path} does not open: permission denied; as root write this line to {RULE_FILE}:\n\
         {rule}\n\
         then run `udevadm control --reload && udevadm trigger --subsystem-match=hidraw --action=add`, \
         and be logged in at this machine's screen or in the group `dialout`"
    )]
    Permission {
        /// Its vendor and product.
        ids: UsbIds,
        path: PathBuf,
        /// The udev rule that grants it.
        rule: String,
    },
    /// Its node may not be opened whatever its mode is.
    #[error("HID tracker {ids} at {path} does not open: {KEPT_BY_UNIT}")]
    NotAllowed {
        /// Its vendor and product.
        ids: UsbIds,
        path: PathBuf,
    },
    /// It is there and does not open.
    #[error(
        "HID tracker {ids} at {path} does not open: {reason}; unplug it, plug it in again, and try another USB port"
    )]
    Open {
        /// Its vendor and product.
        ids: UsbIds,
        path: PathBuf,
        reason: String,
    },
    /// No shipped profile is for these ids.
    #[error(
        "no shipped profile is for the HID device {ids}; name one: add `,profile=NAME` to the tracker's spec ({known})"
    )]
    NoProfile {
        ids: UsbIds,
        /// The shipped profiles of HID trackers, in words.
        known: String,
    },
    /// Neither the spec nor the profile says which device it is.
    #[error("profile `{profile}` names no HID device; expected `hid:VID:PID,profile={profile}`")]
    Unnamed { profile: String },
    /// The system does not tell which devices there are.
    #[error("HID devices cannot be listed: {reason}; check that /sys is mounted and the kernel has hidraw")]
    List { reason: String },
    /// It does not have the fields that the profile names.
    #[error("HID tracker {ids}, profile `{profile}`: {fault}")]
    Descriptor {
        /// Its vendor and product.
        ids: UsbIds,
        profile: String,
        #[source]
        fault: DescriptorError,
    },
    /// It came back as something else.
    #[error(
        "HID tracker {ids} at {path} came back with another report descriptor; its reports would be misread: start holod again"
    )]
    Changed {
        /// Its vendor and product.
        ids: UsbIds,
        path: PathBuf,
    },
}

/// The shipped profile of the trackers with these ids.
pub(crate) fn profile_of(ids: Option<UsbIds>) -> Result<Profile, HidError> {
    let ids = ids.ok_or_else(|| HidError::Unnamed { profile: "NAME".into() })?;
    Profile::shipped().find(|profile| profile.hid.usb.contains(&ids)).ok_or_else(|| {
        let named = Profile::shipped().filter(|profile| !profile.hid.usb.is_empty());
        let known: Vec<_> =
            named.map(|profile| format!("{} is for {}", profile.name, either(&profile.hid.usb))).collect();
        HidError::NoProfile { ids, known: known.join(", ") }
    })
}

impl Wanted {
    /// What the spec names, and for the rest what the profile does.
    pub(crate) fn new(ids: Option<UsbIds>, serial: Option<&str>, profile: &Profile) -> Result<Self, HidError> {
        let HidSettings { usb, usage_page, usage } = &profile.hid;
        let ids = ids.map_or_else(|| usb.clone(), |ids| vec![ids]);
        if ids.is_empty() && serial.is_none() && usage_page.is_none() && usage.is_none() {
            return Err(HidError::Unnamed { profile: profile.name.clone() });
        }
        Ok(Self { ids, serial: serial.map(str::to_owned), usage_page: *usage_page, usage: *usage })
    }
}

/// A device by what it is, opened where it is now.
pub(crate) struct HidFeed {
    wanted: Wanted,
    /// The device that was open last, which is preferred to its twins.
    last: Option<(Identity, Vec<u8>)>,
}

impl HidFeed {
    pub(crate) const fn new(wanted: Wanted) -> Self {
        Self { wanted, last: None }
    }

    /// The profile for the device that was opened last.
    pub(crate) fn describe(&self, profile: Profile) -> Result<Profile, HidError> {
        let Some((Identity { ids, .. }, descriptor)) = &self.last else { return Ok(profile) };
        let name = profile.name.clone();
        profile.described(descriptor).map_err(|fault| HidError::Descriptor { ids: *ids, profile: name, fault })
    }

    fn connect(&mut self) -> Result<HidSource, HidError> {
        let api = HidApi::new().map_err(|error| HidError::List { reason: error.to_string() })?;
        let candidates = candidates(&api);
        let last = self.last.as_ref().map(|(identity, _)| identity);
        let candidate = match self.wanted.choose(&candidates, last) {
            Choice::One(candidate) => candidate,
            Choice::Another(candidate) => {
                let expected = last.map(Identity::to_string).unwrap_or_default();
                return Err(HidError::Another { found: candidate.to_string(), expected });
            }
            Choice::None => {
                return Err(HidError::Missing { wanted: self.wanted.to_string(), found: in_words(&candidates) });
            }
            Choice::Several(fitting) => {
                let found = in_words(fitting.iter().copied());
                return Err(HidError::Several { count: fitting.len(), wanted: self.wanted.to_string(), found });
            }
        };
        let Candidate { path, identity: Identity { ids, .. }, .. } = candidate;
        let device = open(&api, path, *ids)?;
        let mut descriptor = vec![0; MAX_REPORT_DESCRIPTOR_SIZE];
        let length = device.get_report_descriptor(&mut descriptor).map_err(|error| HidError::Open {
            ids: *ids,
            path: path.clone(),
            reason: error.to_string(),
        })?;
        descriptor.truncate(length);
        match &self.last {
            Some((_, before)) if *before != descriptor => Err(HidError::Changed { ids: *ids, path: path.clone() }),
            _ => {
                self.last = Some((candidate.identity.clone(), descriptor));
                Ok(HidSource { device })
            }
        }
    }
}

impl Feed for HidFeed {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError> {
        Ok(Box::new(self.connect()?))
    }

    fn datagrams(&self) -> bool {
        true
    }

    fn descriptor(&self) -> Option<&[u8]> {
        self.last.as_ref().map(|(_, descriptor)| &descriptor[..])
    }
}

struct HidSource {
    device: HidDevice,
}

impl ByteSource for HidSource {
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent {
        match self.device.read_timeout(buffer, READ_TIMEOUT.as_millis() as i32) {
            Ok(0) => ReadEvent::Silence,
            Ok(count) => ReadEvent::Bytes(count),
            Err(hidapi::HidError::IoError { error }) if error.kind() == ErrorKind::Interrupted => ReadEvent::Silence,
            Err(_) => ReadEvent::Gone,
        }
    }
}

/// A HID device that is plugged in, as far as it tells which it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HidDeviceInfo {
    /// Its device node, such as `/dev/hidraw0`.
    pub path: PathBuf,
    /// USB vendor and product.
    pub ids: UsbIds,
    /// Serial number; empty where the maker gave it none.
    pub serial: String,
    /// The product's name, as the device gives it.
    pub product: String,
}

/// The HID devices of this machine, keyboards and mice too.
///
/// # Errors
/// [`HidError::List`].
pub fn hid_devices() -> Result<Vec<HidDeviceInfo>, HidError> {
    let api = HidApi::new().map_err(|error| HidError::List { reason: error.to_string() })?;
    let devices = candidates(&api).into_iter().map(|candidate| {
        let Candidate { path, identity: Identity { ids, serial, .. }, product, .. } = candidate;
        HidDeviceInfo { path, ids, serial, product }
    });
    Ok(devices.collect())
}

/// The devices there are; one that has several usages is one device.
fn candidates(api: &HidApi) -> Vec<Candidate> {
    let mut candidates: Vec<Candidate> = Vec::new();
    for device in api.device_list() {
        let path = PathBuf::from(device.path().to_string_lossy().into_owned());
        let usage = (device.usage_page(), device.usage());
        match candidates.iter_mut().find(|candidate| candidate.path == path) {
            Some(candidate) => candidate.usages.push(usage),
            None => candidates.push(Candidate {
                path,
                identity: Identity {
                    ids: UsbIds { vendor: device.vendor_id(), product: device.product_id() },
                    serial: device.serial_number().unwrap_or_default().to_owned(),
                    interface: device.interface_number(),
                },
                product: device.product_string().unwrap_or_default().trim().to_owned(),
                bluetooth: matches!(device.bus_type(), BusType::Bluetooth),
                usages: vec![usage],
            }),
        }
    }
    candidates.sort_by(|a, b| a.path.cmp(&b.path));
    candidates
}

/// Opens a node. hidapi words what the system said and drops its kind, so a refusal is asked for once more.
fn open(api: &HidApi, path: &Path, ids: UsbIds) -> Result<HidDevice, HidError> {
    let said = match std::ffi::CString::new(path.as_os_str().as_encoded_bytes()) {
        Ok(name) => match api.open_path(&name) {
            Ok(device) => return Ok(device),
            Err(error) => error.to_string(),
        },
        Err(error) => error.to_string(),
    };
    let again = File::options().read(true).write(true).open(path).map(drop);
    Err(not_opened(path, ids, again, said))
}

/// What it means that a node does not open, which hidapi `said`, and opening it `again` came to.
fn not_opened(path: &Path, ids: UsbIds, again: io::Result<()>, said: String) -> HidError {
    let path = path.into();
    match again {
        Err(error) if is_kept_by_unit(&error) => HidError::NotAllowed { ids, path },
        Err(error) if error.kind() == ErrorKind::PermissionDenied => {
            HidError::Permission { ids, path, rule: udev_rule(ids) }
        }
        _ => HidError::Open { ids, path, reason: said },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_that_the_unit_keeps_is_told_from_one_without_a_rule() {
        let ids = UsbIds { vendor: 0x1209, product: 1 };
        let says = |errno: i32| {
            let again = Err(io::Error::from_raw_os_error(errno));
            not_opened(Path::new("/dev/hidraw7"), ids, again, "it says no".to_owned()).to_string()
        };
        let [not_permitted, access, no_device] = [1, 13, 19].map(says);
        assert!(not_permitted.contains("/dev/hidraw7 does not open: the service's unit"), "{not_permitted}");
        assert!(access.contains("permission denied; as root write this line"), "{access}");
        assert!(no_device.contains("does not open: it says no"), "{no_device}");
    }
}
