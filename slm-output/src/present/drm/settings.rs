//! What must be true of a connector for levels to reach the panel as they are: set where the driver lets it be set, and
//! read back.

use drm::control::atomic::AtomicModeReq;
use drm::control::property::{self, ValueType};
use drm::control::{AtomicCommitFlags, Device as _, RawResourceHandle};

use super::card::{Card, Pipe};
use super::check::{COLOUR_MODEL, DisplayCheck};
use super::find::SeenConnector;
use super::properties::{PipeProperties, Properties};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum On {
    Connector,
    Crtc,
    Plane,
}

#[derive(Clone, Copy, Debug)]
enum Want {
    /// The enumeration value of this name.
    Named(&'static str),
    Number(u64),
    /// No table: the values pass as they are.
    NoBlob,
    /// The bits of one channel.
    ChannelBits,
}

struct Setting {
    name: &'static str,
    on: On,
    property: &'static str,
    want: Want,
    /// Whether a driver that lacks the property leaves the matter open.
    essential: bool,
}

const fn setting(name: &'static str, on: On, property: &'static str, want: Want, essential: bool) -> Setting {
    Setting { name, on, property, want, essential }
}

/// Every property that can change levels between the buffer and the panel, by the names of the kernel's documentation
/// and of the drivers i915, xe, amdgpu, radeon, nouveau, nvidia-drm and vc4.
const SETTINGS: &[Setting] = &[
    setting("range of RGB", On::Connector, "Broadcast RGB", Want::Named("Full"), true),
    setting(COLOUR_MODEL, On::Connector, "color format", Want::Named("RGB"), false),
    setting(COLOUR_MODEL, On::Connector, "Output format", Want::Named("RGB"), false),
    setting(COLOUR_MODEL, On::Connector, "preferred color format", Want::Named("RGB"), false),
    setting("bits of a channel on the link", On::Connector, "max bpc", Want::ChannelBits, true),
    setting("gamma table", On::Crtc, "GAMMA_LUT", Want::NoBlob, true),
    setting("degamma table", On::Crtc, "DEGAMMA_LUT", Want::NoBlob, false),
    setting("colour matrix", On::Crtc, "CTM", Want::NoBlob, true),
    setting("dithering", On::Connector, "dithering mode", Want::Named("off"), false),
    setting("dithering", On::Connector, "dither", Want::Named("off"), false),
    setting("scaling by the controller", On::Connector, "scaling mode", Want::Named("None"), false),
    setting("underscan", On::Connector, "underscan", Want::Named("off"), false),
    setting("margin", On::Connector, "left margin", Want::Number(0), false),
    setting("margin", On::Connector, "right margin", Want::Number(0), false),
    setting("margin", On::Connector, "top margin", Want::Number(0), false),
    setting("margin", On::Connector, "bottom margin", Want::Number(0), false),
    setting("colour space", On::Connector, "Colorspace", Want::Named("Default"), false),
    setting("high dynamic range", On::Connector, "HDR_OUTPUT_METADATA", Want::NoBlob, false),
    setting("contrast by the backlight", On::Connector, "abm level", Want::Number(0), false),
    setting("state of the link", On::Connector, "link-status", Want::Named("Good"), false),
    setting("variable refresh", On::Crtc, "VRR_ENABLED", Want::Number(0), false),
    setting("sharpening", On::Crtc, "SHARPNESS_STRENGTH", Want::Number(0), false),
    // Bit 0 is no rotation and no reflection.
    setting("rotation", On::Plane, "rotation", Want::Number(1), false),
    setting("opacity", On::Plane, "alpha", Want::Number(0xffff), false),
    setting("blending", On::Plane, "pixel blend mode", Want::Named("None"), false),
];

/// Where a connector's driver says whether the link still carries the mode: it may have trained it anew, to less than
/// that, and shows nothing then until the mode is set once more.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LinkStatus {
    property: property::Handle,
    good: u64,
}

impl LinkStatus {
    /// That of the connector with `properties`, where its driver has one.
    pub(crate) fn of(properties: &Properties) -> Option<Self> {
        let (info, _) = properties.find("link-status")?;
        Some(Self { property: info.handle(), good: wanted(info, Want::Named("Good"), 0)? })
    }

    /// Whether the connector's `values` say that the link is good, or nothing of it.
    pub(crate) fn is_good(self, values: impl IntoIterator<Item = (u32, u64)>) -> bool {
        let link_status = u32::from(self.property);
        values.into_iter().all(|(property, value)| property != link_status || value == self.good)
    }
}

fn of_part(properties: &PipeProperties, on: On) -> &Properties {
    match on {
        On::Connector => &properties.connector,
        On::Crtc => &properties.crtc,
        On::Plane => &properties.plane,
    }
}

/// A property's value before and after.
#[derive(Clone, Debug)]
pub(crate) struct Change {
    object: RawResourceHandle,
    property: property::Handle,
    new: u64,
    old: u64,
    /// What the old value stood for where it was the number of a table: the kernel frees one that nobody uses.
    old_table: Option<Vec<u8>>,
}

impl Change {
    /// Whether both are of one property of one object.
    pub(crate) fn is_of_the_same(&self, other: &Self) -> bool {
        (self.object, self.property) == (other.object, other.property)
    }
}

fn object(pipe: &Pipe, on: On) -> RawResourceHandle {
    match on {
        On::Connector => pipe.connector.into(),
        On::Crtc => pipe.crtc.into(),
        On::Plane => pipe.plane.into(),
    }
}

/// The value that is wanted, as the property writes it; `None` where it has no such value.
fn wanted(info: &property::Info, want: Want, channel_bits: u8) -> Option<u64> {
    match (want, info.value_type()) {
        (Want::Named(name), ValueType::Enum(values)) => {
            let named = |value: &&property::EnumValue| value.name().to_bytes().eq_ignore_ascii_case(name.as_bytes());
            values.values().1.iter().find(named).map(property::EnumValue::value)
        }
        (Want::ChannelBits, ValueType::UnsignedRange(least, most)) => {
            Some(u64::from(channel_bits).max(*least)).filter(|bits| bits <= most)
        }
        (Want::Number(number), _) => Some(number),
        (Want::NoBlob, _) => Some(0),
        _ => None,
    }
}

fn words(info: &property::Info, want: Want, value: u64) -> String {
    if let (Want::NoBlob, value) = (want, value) {
        return if value == 0 { "none" } else { "one" }.to_owned();
    }
    match info.value_type() {
        ValueType::Enum(values) => values
            .get_value_from_raw_value(value)
            .map_or_else(|| value.to_string(), |value| value.name().to_string_lossy().into_owned()),
        _ => value.to_string(),
    }
}

fn wanted_words(want: Want, channel_bits: u8) -> String {
    match want {
        Want::Named(name) => name.to_owned(),
        Want::Number(number) => number.to_string(),
        Want::NoBlob => "none".to_owned(),
        Want::ChannelBits => channel_bits.to_string(),
    }
}

/// Which properties are to be changed to what.
pub(crate) fn plan(card: &Card, pipe: &Pipe, properties: &PipeProperties, channel_bits: u8) -> Vec<Change> {
    let change = |setting: &Setting| {
        let (info, old) = of_part(properties, setting.on).find(setting.property)?;
        let new = wanted(info, setting.want, channel_bits)?;
        let is_table = matches!(setting.want, Want::NoBlob) && *old != 0;
        let old_table = is_table.then(|| card.get_property_blob(*old).ok()).flatten();
        let (object, property) = (object(pipe, setting.on), info.handle());
        info.mutable().then_some(Change { object, property, new, old: *old, old_table })
    };
    SETTINGS.iter().filter_map(change).collect()
}

/// Adds to `request` what the driver takes of `changes`: all of them, or else one after another.
pub(crate) fn add_accepted(card: &Card, request: &mut AtomicModeReq, changes: &[Change]) {
    let flags = AtomicCommitFlags::TEST_ONLY | AtomicCommitFlags::ALLOW_MODESET;
    let mut whole = request.clone();
    for change in changes {
        whole.add_raw_property(change.object, change.property, change.new);
    }
    if card.atomic_commit(flags, whole.clone()).is_ok() {
        *request = whole;
        return;
    }
    for change in changes {
        let mut tried = request.clone();
        tried.add_raw_property(change.object, change.property, change.new);
        if card.atomic_commit(flags, tried.clone()).is_ok() {
            *request = tried;
        }
    }
}

/// Puts back what [`plan`] changed, as far as the driver lets it: the next user of the connector may not know these
/// properties. Tables are made anew, for as long as the driver uses them.
pub(crate) fn restore(card: &Card, changes: &[Change]) {
    let mut request = AtomicModeReq::new();
    let mut tables = Vec::new();
    let mut back = Vec::new();
    for change in changes.iter().filter(|change| change.old != change.new) {
        let mut old = change.old;
        if let Some(table) = &change.old_table {
            let made = card.create_property_blob(table.as_slice());
            let Ok(made) = made.map(u64::from) else { continue };
            tables.push(made);
            old = made;
        }
        back.push(Change { new: old, old: change.new, old_table: None, ..*change });
    }
    if !back.is_empty() {
        add_accepted(card, &mut request, &back);
        // At the end there is nobody who could do anything about it.
        let _ = card.atomic_commit(AtomicCommitFlags::ALLOW_MODESET, request);
    }
    for table in tables {
        // The driver's own reference to it stays.
        let _ = card.destroy_property_blob(table);
    }
}

/// What the properties of the `seen` connector are now, beside what they must be.
pub(crate) fn read_back(properties: &PipeProperties, channel_bits: u8, seen: &SeenConnector) -> Vec<DisplayCheck> {
    let check = |setting: &Setting| {
        let must = wanted_words(setting.want, channel_bits);
        let name = format!("{} ({})", setting.name, setting.property);
        let Some((info, value)) = of_part(properties, setting.on).find(setting.property) else {
            let silent = || DisplayCheck::unverified(&name, "the driver does not say", must);
            return setting.essential.then(silent);
        };
        let found = words(info, setting.want, *value);
        Some(match wanted(info, setting.want, channel_bits) {
            Some(wanted) => DisplayCheck::equal(&name, found, words(info, setting.want, wanted)),
            // A link of fewer bits would cut the levels.
            None if matches!(setting.want, Want::ChannelBits) => DisplayCheck::equal(&name, found, must),
            // Such as a laptop's panel whose scaler cannot be switched off, and has nothing to do in the panel's own
            // mode.
            None => DisplayCheck::unverified(&name, &format!("{found}, and the driver offers nothing else"), must),
        })
    };
    let mut checks: Vec<_> = SETTINGS.iter().filter_map(check).collect();
    if !checks.iter().any(|check| check.name.starts_with("dithering")) {
        checks.push(DisplayCheck::unverified("dithering", "the driver does not say", "off"));
    }
    if !checks.iter().any(|check| check.name.starts_with(COLOUR_MODEL)) {
        checks.extend(seen.sends_ycbcr_444().then(DisplayCheck::ycbcr_444));
    }
    checks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_links_own_property_says_that_it_is_bad() {
        let handle = |raw| drm::control::from_u32::<property::Handle>(raw).unwrap();
        let status = LinkStatus { property: handle(7), good: 0 };
        assert!(status.is_good([(3, 1), (7, 0)]));
        assert!(status.is_good([(3, 1)]), "a driver that does not say");
        assert!(!status.is_good([(3, 0), (7, 1)]));
    }
}
