//! `kind = "report"`: HID reports whose bytes the profile says.

use std::cell::RefCell;

use holod_calibration::toml_reader::Section;

use super::context::Context;
use super::fields::{FieldPlaces, read_endian};
use super::layout::read_layout;
use crate::wire::packet::MAX_PACKET_BYTES;
use crate::wire::report::ReportSettings;

pub(super) fn read_report<'a>(wire: &Section<'a>, context: &Context<'_>) -> Option<ReportSettings> {
    let big_endian = read_endian(wire).unwrap_or(false);
    let id_found = wire.get("id");
    let id = id_found.as_ref().and_then(|found| found.integer(0..=255)).map(|id| id as u8);
    let [exact, least] = ["length", "least_length"]
        .map(|key| wire.integer(key, 1..=MAX_PACKET_BYTES as i64).map(|bytes| bytes as usize));
    if wire.has("length") == wire.has("least_length") {
        let found = if wire.has("length") { "length and least_length" } else { "neither length nor least_length" };
        wire.fault(found, "one of the two", "write length where every report has as many bytes");
    }
    let least = exact.or(least)?;
    let places = FieldPlaces { big_endian, least, taken: RefCell::default() };
    if let Some(found) = &id_found {
        places.take(found, 0, 1, None);
    }
    let layout = read_layout(&places, wire, context)?;
    Some(ReportSettings { id, least, most: exact, layout })
}
