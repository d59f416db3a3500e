//! `kind = "usages"`: HID reports whose fields the device describes.

use holod_calibration::toml_reader::{Found, Section};
use toml_edit::Item;

use super::context::Context;
use super::layout::{Places, read_layout};
use crate::wire::hid_descriptor::Usage;
use crate::wire::usages::{UsageAt, UsageSettings};

pub(super) fn read_usages<'a>(wire: &Section<'a>, context: &Context<'_>) -> Option<UsageSettings> {
    let layout = read_layout(&UsagePlaces, wire, context)?;
    Some(UsageSettings { layout })
}

/// The fields of a HID report, by their usages.
struct UsagePlaces;

impl UsagePlaces {
    fn usage(&self, found: &Found<'_, &Item>) -> Option<Usage> {
        const EXPECTED: &str = "a page and a number in hexadecimals, such as \"ff00:0030\"";
        let text = found.text(EXPECTED)?;
        let usage = text.parse().ok();
        if usage.is_none() {
            found.fault(format!("{text:?}"), EXPECTED, "correct it");
        }
        usage
    }
}

impl<'a> Places<'a> for UsagePlaces {
    type Place = UsageAt;

    fn bare(&self, found: &Found<'a, &'a Item>) -> Option<Option<UsageAt>> {
        let bare = || self.usage(found).map(|usage| UsageAt { usage, collection: None });
        found.value.as_table_like().is_none().then(bare)
    }

    fn read(&self, table: &Section<'a>) -> Option<UsageAt> {
        let usage = table.require("usage", "the field's usage, such as \"ff00:0030\"");
        let usage = usage.and_then(|found| self.usage(&found));
        let collection = match table.get("collection") {
            None => None,
            Some(found) => Some(self.usage(&found)?),
        };
        Some(UsageAt { usage: usage?, collection })
    }

    fn wrap_bits(&self, _: &UsageAt) -> Option<u32> {
        None
    }

    fn texts(&self) -> bool {
        false
    }

    fn same(&self, one: &UsageAt, other: &UsageAt) -> bool {
        one == other
    }
}
