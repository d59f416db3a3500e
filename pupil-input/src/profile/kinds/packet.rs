//! `kind = "packet"`: binary packets behind a sync word.

use std::cell::RefCell;

use holod_calibration::toml_reader::Section;

use super::checksum::read_checksum_kind;
use super::context::Context;
use super::fields::{FieldPlaces, read_endian};
use super::layout::read_layout;
use crate::profile::bytes::read_bytes;
use crate::wire::packet::{MAX_PACKET_BYTES, PacketChecksum, PacketLength, PacketSettings};

/// Bytes of the longest sync word.
const SYNC_MAX: usize = 16;

pub(super) fn read_packet<'a>(wire: &Section<'a>, context: &Context<'_>) -> Option<PacketSettings> {
    const SYNC: &str = "the bytes that begin a packet, 1 to 16";
    let big_endian = read_endian(wire).unwrap_or(false);
    let sync_found = wire.require("sync", SYNC)?;
    let sync = read_bytes(&sync_found)?;
    if sync.is_empty() || sync.len() > SYNC_MAX {
        sync_found.fault(format!("{} bytes", sync.len()), SYNC, "correct it");
        return None;
    }
    let found = wire.require("length", "the packet's bytes, or the table of the field that tells them")?;
    let longest = MAX_PACKET_BYTES as i64;
    let shortest = sync.len() as i64 + 1;
    let (least, told) = if found.value.as_table_like().is_some() {
        let table = found.table();
        let [least, most] = ["least", "most"].map(|key| {
            let bound = table.require(key, "bytes of a whole packet");
            bound.and_then(|bound| bound.integer(shortest..=longest))
        });
        (least? as usize, Some((table, most?)))
    } else {
        (found.integer(shortest..=longest)? as usize, None)
    };
    let places = FieldPlaces { big_endian, least, taken: RefCell::default() };
    places.take(&sync_found, 0, sync.len(), None);
    let length = match told {
        None => Some(PacketLength::Fixed(least)),
        Some((table, most)) => {
            let adds = table.integer("adds", -longest..=longest).unwrap_or(0);
            let field = places.field(&table);
            if most < least as i64 {
                table.fault(
                    &format!("least {least}, most {most}"),
                    "least no greater than most",
                    "correct one of them",
                );
            }
            if field.as_ref().is_some_and(|field| field.at < 0 || field.kind.is_float()) {
                table.fault(
                    "a length that is far behind or no whole number",
                    "a whole number from the packet's beginning",
                    "correct `at` or `type`",
                );
            }
            table.finish();
            field.map(|field| PacketLength::Told { field, adds, least, most: most as usize })
        }
    };
    let checksum = read_packet_checksum(wire, &places);
    let layout = read_layout(&places, wire, context);
    Some(PacketSettings { sync, length: length?, checksum, layout: layout? })
}

fn read_packet_checksum(wire: &Section<'_>, places: &FieldPlaces) -> Option<PacketChecksum> {
    let table = wire.get("checksum")?.table();
    let kind = table.require("kind", "a kind of checksum").and_then(|kind| read_checksum_kind(&table, &kind));
    let big_endian = read_endian(&table).unwrap_or(places.big_endian);
    let bound = |key| {
        let found = table.get(key)?;
        let range = -(places.least as i64)..=places.least as i64;
        found.integer(range).map(|at| at as i32)
    };
    let (at, from, to) = (bound("at"), bound("from"), bound("to"));
    let (Some(at), Some(kind)) = (at, kind) else {
        if at.is_none() && !table.has("at") {
            table.missing("at", "the checksum's first byte, from 0; negative from the packet's end");
        }
        return None;
    };
    let place = table.get("at")?;
    places.take(&place, at, kind.width(), None);
    let (from, to) = (from.unwrap_or(0), to.unwrap_or(at));
    let within = |at: i32| if at < 0 { places.least as i64 + i64::from(at) } else { i64::from(at) };
    let covers_itself = within(from) < within(at) + kind.width() as i64 && within(at) < within(to);
    if within(from) >= within(to) || covers_itself {
        let found = format!("bytes {} to {} under the checksum at byte {}", within(from), within(to) - 1, within(at));
        table.fault(&found, "a range with at least one byte, and without the checksum", "correct from, to or at");
    }
    table.finish();
    Some(PacketChecksum { kind, at, big_endian, from, to })
}
