//! The part of a profile that says how bytes are read.

use std::cell::RefCell;

use holod_calibration::toml_source::did_you_mean;
use toml_edit::Item;

use super::parse::EYES;
use super::reader::{Found, Reader, Section};
use super::vendor::{read_iscan, read_livetrack, read_open_gaze, read_pupilext};
use crate::SampleEye;
use crate::import::SizeUnit;
use crate::wire::delimited::{Column, DelimitedSettings, MAX_COLUMNS, Separator};
use crate::wire::field::{Field, Figure, Layout, Literal, NumberType, PupilAt, SizeRule, TimeAt, Validity};
use crate::wire::hid_descriptor::Usage;
use crate::wire::packet::{MAX_PACKET_BYTES, PacketChecksum, PacketLength, PacketSettings};
use crate::wire::report::ReportSettings;
use crate::wire::usages::{UsageAt, UsageSettings};
use crate::wire::{ChecksumKind, Crc, Format};

/// What the rest of the profile says about the figures on the wire.
pub(super) struct Context {
    pub(super) eye: Option<Found<SampleEye>>,
    pub(super) rate_hz: Option<f64>,
    pub(super) size: SizeRule,
    pub(super) unit: SizeUnit,
    /// Where `[size]` is.
    pub(super) size_at: Option<Found<()>>,
}

const KINDS: [&str; 11] =
    ["holod", "delimited", "packet", "report", "usages", "iscan", "livetrack", "open-gaze", "pupilext", "core", "neon"];
/// Bytes of the longest sync word.
const SYNC_MAX: usize = 16;

/// The format, and what its sizes are before the rig's scale.
pub(super) fn read_wire<'a>(wire: &Section<'a>, context: &Context) -> Option<(Format, SizeUnit)> {
    let expected = format!("one of \"{}\"", KINDS.join("\", \""));
    let kind = wire.require("kind", &expected)?;
    let name = wire.reader().text(&kind, &expected)?;
    let configurable = ["delimited", "packet", "report", "usages", "iscan"].contains(&name);
    let read = match name {
        "holod" => Some((Format::Lines, SizeUnit::Millimetres)),
        "delimited" => read_delimited(wire, context).map(|settings| (Format::Delimited(settings), context.unit)),
        "packet" => read_packet(wire, context).map(|settings| (Format::Packet(settings), context.unit)),
        "report" => read_report(wire, context).map(|settings| (Format::Report(settings), context.unit)),
        "usages" => {
            let places = UsagePlaces { reader: wire.reader() };
            let layout = read_layout(&places, wire, context);
            layout.map(|layout| (Format::Usages(UsageSettings { layout }), context.unit))
        }
        "iscan" => read_iscan(wire, context).map(|settings| (Format::Iscan(settings), context.unit)),
        "livetrack" => read_livetrack(wire, context),
        "core" => Some((Format::CoreMsgpack, SizeUnit::Millimetres)),
        "neon" => Some((Format::NeonRtp, SizeUnit::Millimetres)),
        "open-gaze" => Some(read_open_gaze(wire, context)),
        "pupilext" => Some(read_pupilext(wire, context)),
        unknown => {
            let advice = did_you_mean(unknown, &KINDS).unwrap_or("choose one".into());
            wire.reader().fault(&kind, format!("\"{unknown}\""), &expected, advice);
            return None;
        }
    };
    if let Some(size) = context.size_at.as_ref().filter(|_| !configurable) {
        let advice = "take it out; the rig's tracker.scale_mm_per_unit is for sizes that are no millimetres";
        wire.reader().fault(size, "a table", &format!("none for \"{name}\": its sizes are known"), advice);
    }
    // Where it is none, keys may not have been asked for.
    if read.is_some() {
        wire.finish();
    }
    read
}

/// How the places of a kind of message are written.
trait Places<'a> {
    type Place: Clone;

    /// The place that an item is in itself; None where it is a table that tells it.
    fn bare(&self, found: &Found<&'a Item>) -> Option<Option<Self::Place>>;

    /// The place that the keys of a table tell.
    fn read(&self, table: &Section<'a>) -> Option<Self::Place>;

    /// After how many bits a counter in this place begins again, by its type alone.
    fn wrap_bits(&self, place: &Self::Place) -> Option<u32>;

    /// Whether texts can stand there.
    fn texts(&self) -> bool;

    fn same(&self, one: &Self::Place, other: &Self::Place) -> bool;
}

/// An item: its place, and what else its table says, which `more` reads.
fn read_item<'a, P: Places<'a>, T>(
    places: &P,
    section: &Section<'a>,
    key: &'static str,
    more: impl FnOnce(&Section<'a>, P::Place) -> Option<T>,
) -> Option<T> {
    let found = section.get(key)?;
    let reader = section.reader();
    if let Some(place) = places.bare(&found) {
        return more(&reader.empty(&found), place?);
    }
    let table = reader.table(&found);
    if !table.is_there() {
        return None;
    }
    let item = places.read(&table).and_then(|place| more(&table, place));
    // Without a place, the table's other keys were not asked for.
    if item.is_some() {
        table.finish();
    }
    item
}

fn read_figure<'a, P: Places<'a>>(places: &P, section: &Section<'a>, key: &'static str) -> Option<Figure<P::Place>> {
    read_item(places, section, key, |table, at| {
        let scale = table.finite("scale").unwrap_or(1.0);
        let full = table.positive("full").unwrap_or(1.0);
        let offset = table.finite("offset").unwrap_or(0.0);
        Some(Figure { at, scale: scale / full, offset })
    })
}

fn read_layout<'a, P: Places<'a>>(places: &P, wire: &Section<'a>, context: &Context) -> Option<Layout<P::Place>> {
    let wrap = |table: &Section<'a>, at: &P::Place| {
        table.integer("wrap_bits", 1..=62).map(|bits| bits as u32).or_else(|| places.wrap_bits(at))
    };
    let time = read_item(places, wire, "time", |table, at| {
        let wrap_bits = wrap(table, &at);
        Some(TimeAt { ns_per_tick: read_tick(table, context)?, at, wrap_bits })
    });
    let sequence = read_item(places, wire, "sequence", |table, at| {
        let wrap_bits = wrap(table, &at);
        Some((at, wrap_bits))
    });
    let eye = read_item(places, wire, "eye", |table, at| {
        let eyes = EYES
            .into_iter()
            .flat_map(|(key, eye)| read_literals(places, table, key).into_iter().map(move |literal| (literal, eye)));
        let eyes: Vec<_> = eyes.collect();
        if eyes.is_empty() {
            table.fault("no eye", "what stands for each eye", "add for example left = \"L\", right = \"R\"");
        }
        Some((at, eyes))
    });
    let mut pupils = Vec::new();
    for (key, own_eye) in EYES.map(|(key, eye)| (key, Some(eye))).into_iter().chain([("pupil", None)]) {
        let table = wire.section(key);
        if !table.is_there() {
            continue;
        }
        let told = wire.has("eye");
        if own_eye.is_none() && !told && context.eye.is_none() {
            const EXPECTED: &str = "an eye: `eye = \"left\"` at the top of the file, or [wire.eye]";
            table.fault("no word on its eye", EXPECTED, "or name the table after its eye, as [wire.left]");
        }
        let eye = own_eye.or(context.eye.as_ref().filter(|_| !told).map(|eye| eye.value));
        let pupil = read_pupil(places, &table, eye);
        table.finish();
        if let Some(pupil) = pupil {
            let twin = pupils.iter().any(|other: &PupilAt<_>| places.same(&other.size.at, &pupil.size.at));
            if twin {
                let advice = "give each pupil a size of its own";
                table.fault("the size of another pupil", "one size for one pupil", advice);
            }
            pupils.push(pupil);
        }
    }
    let keys = ["left", "right", "both", "pupil"];
    if !keys.into_iter().any(|key| wire.has(key)) {
        let expected = "at least one of [wire.left], [wire.right], [wire.both], [wire.pupil]";
        wire.fault("no pupil", expected, "add for example [wire.left] with the place of its size");
    }
    if let Some(found) = context.eye.as_ref().filter(|_| !wire.has("pupil") || wire.has("eye")) {
        wire.reader().fault(found, found.value, "no eye here: the wire tells it", "take it out");
    }
    Some(Layout { time, sequence, eye, pupils, size: context.size })
}

/// Nanoseconds of one unit of a time.
fn read_tick(table: &Section<'_>, context: &Context) -> Option<f64> {
    const UNITS: [(&str, Option<f64>); 5] =
        [("s", Some(1e9)), ("ms", Some(1e6)), ("us", Some(1e3)), ("ns", Some(1.0)), ("frames", None)];
    if let Some(tick_ns) = table.positive("tick_ns") {
        if table.has("unit") {
            table.fault("unit and tick_ns", "one of the two", "take one out");
        }
        return Some(tick_ns);
    }
    let unit = table.require("unit", "the time's unit, or tick_ns")?;
    if let Some(ns) = table.reader().choose(&unit, &UNITS)? {
        return Some(ns);
    }
    if context.rate_hz.is_none() {
        table.reader().fault(
            &unit,
            "\"frames\" and no rate_hz",
            "how many frames a second has",
            "add rate_hz = 60.0 to the top of the file",
        );
    }
    Some(1e9 / context.rate_hz?)
}

fn read_pupil<'a, P: Places<'a>>(places: &P, table: &Section<'a>, eye: Option<SampleEye>) -> Option<PupilAt<P::Place>> {
    table.require("size", "the place of the pupil's size");
    let size = read_figure(places, table, "size");
    let lost = read_literals(places, table, "lost");
    let confidence = read_figure(places, table, "confidence");
    let aperture = read_figure(places, table, "aperture");
    let valid = read_item(places, table, "valid", |table, at| {
        let mut rules = Vec::new();
        for key in ["equals", "differs"] {
            if let Some(literal) = table.get(key).and_then(|found| read_literal(places, table.reader(), &found)) {
                rules.push(if key == "equals" { Validity::Equals(literal) } else { Validity::Differs(literal) });
            }
        }
        rules.extend(table.finite("at_least").map(Validity::AtLeast));
        rules.extend(table.finite("at_most").map(Validity::AtMost));
        rules.extend(table.integer("all_bits", 1..=i64::MAX).map(|bits| Validity::AllBits(bits as u64)));
        rules.extend(table.integer("no_bits", 1..=i64::MAX).map(|bits| Validity::NoBits(bits as u64)));
        if rules.len() != 1 {
            let expected = "one rule: equals, differs, at_least, at_most, all_bits or no_bits";
            table.fault(
                &format!("{} rules", rules.len()),
                expected,
                "say when the pupil is seen, for example equals = 1",
            );
        }
        Some((at, rules.pop()?))
    });
    Some(PupilAt { eye, size: size?, lost, confidence, aperture, valid })
}

/// One literal, or an array of them.
fn read_literals<'a, P: Places<'a>>(places: &P, table: &Section<'a>, key: &'static str) -> Vec<Literal> {
    let Some(found) = table.get(key) else { return Vec::new() };
    let reader = table.reader();
    if found.value.is_array() {
        let items = reader.items(&found, "figures in brackets");
        items.iter().filter_map(|item| read_literal(places, reader, &item.with(&item.value))).collect()
    } else {
        read_literal(places, reader, &found).into_iter().collect()
    }
}

fn read_literal<'a, P: Places<'a>>(places: &P, reader: &Reader<'_>, found: &Found<&Item>) -> Option<Literal> {
    match found.value.as_str() {
        Some(text) if places.texts() => Some(Literal::Text(text.as_bytes().to_vec())),
        Some(text) => {
            reader.fault(found, format!("{text:?}"), "a number: this wire has no texts", "take the quotes away");
            None
        }
        None => reader.number(found, "a number or a text").map(Literal::Number),
    }
}

struct ColumnPlaces<'r, 'a> {
    reader: &'r Reader<'a>,
    /// The names that the profile gives.
    columns: Vec<String>,
}

impl ColumnPlaces<'_, '_> {
    fn column(&self, found: &Found<&Item>) -> Option<Column> {
        const EXPECTED: &str = "a column: its number from 1, or its name in quotes";
        let Some(name) = found.value.as_str() else {
            return match found.value.as_integer() {
                Some(_) => {
                    self.reader.integer(found, 1..=MAX_COLUMNS as i64).map(|number| Column::Number(number as usize))
                }
                None => {
                    self.reader.fault(found, found.value.to_string().trim(), EXPECTED, "correct it");
                    None
                }
            };
        };
        if !self.columns.is_empty() && !self.columns.iter().any(|known| known == name) {
            let names: Vec<_> = self.columns.iter().map(String::as_str).collect();
            let expected = format!("one of wire.columns: {}", names.join(", "));
            self.reader.fault(
                found,
                format!("{name:?}"),
                &expected,
                did_you_mean(name, &names).unwrap_or("correct it".into()),
            );
            return None;
        }
        Some(Column::Name(name.into()))
    }
}

impl<'a> Places<'a> for ColumnPlaces<'_, 'a> {
    type Place = Column;

    fn bare(&self, found: &Found<&'a Item>) -> Option<Option<Column>> {
        found.value.as_table_like().is_none().then(|| self.column(found))
    }

    fn read(&self, table: &Section<'a>) -> Option<Column> {
        self.column(&table.require("column", "a column: its number from 1, or its name in quotes")?)
    }

    fn wrap_bits(&self, _: &Column) -> Option<u32> {
        None
    }

    fn texts(&self) -> bool {
        true
    }

    fn same(&self, one: &Column, other: &Column) -> bool {
        one == other
    }
}

fn read_delimited<'a>(wire: &Section<'a>, context: &Context) -> Option<DelimitedSettings> {
    let reader = wire.reader();
    let decimal_comma = wire.flag("decimal_comma");
    let separator = match wire.get("separator") {
        None => Some(Separator::Byte(b',')),
        Some(found) => read_separator(reader, &found),
    };
    if let (Some(Separator::Byte(b',')), true) = (separator, decimal_comma) {
        let advice = "write separator = \";\" or whatever stands between the columns";
        wire.fault("a comma in numbers and between columns", "two different characters", advice);
    }
    let line_part = |key| {
        let found = wire.get(key)?;
        let bytes = reader.bytes(&found)?;
        if bytes.len() > 64 || bytes.iter().any(|byte| matches!(byte, b'\r' | b'\n')) {
            reader.fault(&found, format!("{} bytes", bytes.len()), "up to 64 bytes without a line's end", "correct it");
        }
        Some(bytes)
    };
    let (prefix, comment) = (line_part("prefix").unwrap_or_default(), line_part("comment").unwrap_or(b"#".to_vec()));
    let columns = wire.get("columns").map_or(Vec::new(), |found| {
        const EXPECTED: &str = "the columns' names, each once, such as [\"time\", \"left_mm\"]";
        let items = reader.items(&found, EXPECTED);
        let names: Vec<_> = items.iter().filter_map(|item| item.value.as_str().map(str::to_owned)).collect();
        let twice = (1..names.len()).any(|index| names[..index].contains(&names[index]));
        if names.len() != items.len() || names.len() > MAX_COLUMNS || twice {
            reader.fault(&found, found.value.to_string().trim(), EXPECTED, "correct it");
        }
        names
    });
    let checksum = wire.get("checksum").and_then(|found| {
        let table = if found.value.is_str() { reader.empty(&found) } else { reader.table(&found) };
        let kind = if found.value.is_str() { Some(found.clone()) } else { table.require("kind", "a kind of checksum") };
        let kind = read_checksum_kind(&table, &kind?);
        let skip = table.integer("skip", 0..=64).unwrap_or(0) as usize;
        table.finish();
        Some((kind?, skip))
    });
    let layout = read_layout(&ColumnPlaces { reader, columns: columns.clone() }, wire, context);
    Some(DelimitedSettings {
        separator: separator?,
        decimal_comma,
        prefix,
        comment,
        columns,
        checksum,
        layout: layout?,
    })
}

fn read_separator<'a>(reader: &Reader<'a>, found: &Found<&'a Item>) -> Option<Separator> {
    const EXPECTED: &str = "one character such as \";\", or \"whitespace\"";
    let text = reader.text(found, EXPECTED)?;
    match *text.as_bytes() {
        [byte] if byte.is_ascii() && !byte.is_ascii_alphanumeric() && !b"-+.\"\r\n".contains(&byte) => {
            Some(Separator::Byte(byte))
        }
        _ if text == "whitespace" => Some(Separator::Whitespace),
        _ => {
            reader.fault(found, format!("{text:?}"), EXPECTED, "no letter, digit, sign, point, quote or line's end");
            None
        }
    }
}

/// The kind that `found` names, with the parameters of a cyclic redundancy check from `table`.
fn read_checksum_kind<'a>(table: &Section<'a>, found: &Found<&'a Item>) -> Option<ChecksumKind> {
    let crc = |bits, polynomial, initial, reflected| {
        ChecksumKind::Crc(Crc { bits, polynomial, initial, reflected, final_xor: 0 })
    };
    let kinds = [
        ("sum8", ChecksumKind::Sum8),
        ("xor8", ChecksumKind::Xor8),
        ("crc8", crc(8, 0x07, 0, false)),
        ("crc16-ccitt", crc(16, 0x1021, 0xFFFF, false)),
        ("crc16-modbus", crc(16, 0x8005, 0xFFFF, true)),
    ];
    let ChecksumKind::Crc(crc) = table.reader().choose(found, &kinds)? else {
        return table.reader().choose(found, &kinds);
    };
    let register = 0..=(1_i64 << crc.bits) - 1;
    let [polynomial, initial, final_xor] = ["polynomial", "initial", "final_xor"]
        .map(|key| table.integer(key, register.clone()).map(|value| value as u16));
    Some(ChecksumKind::Crc(Crc {
        bits: crc.bits,
        polynomial: polynomial.unwrap_or(crc.polynomial),
        initial: initial.unwrap_or(crc.initial),
        reflected: if table.has("reflected") { table.flag("reflected") } else { crc.reflected },
        final_xor: final_xor.unwrap_or(0),
    }))
}

/// The places of a binary message, with what has been found to stand where.
struct FieldPlaces<'r, 'a> {
    reader: &'r Reader<'a>,
    big_endian: bool,
    /// Bytes that every message has.
    least: usize,
    taken: RefCell<Vec<Taken>>,
}

/// Bytes of a message that mean something.
#[derive(Clone)]
struct Taken {
    from: usize,
    to: usize,
    /// None for what is no field of the layout: nothing may share its bytes.
    field: Option<Field>,
    what: String,
}

impl FieldPlaces<'_, '_> {
    /// Takes the bytes from `at` for `what`; a fault where they lie outside the message or are taken already. Two fields may
    /// be the same number, of which each has its bits.
    fn take(&self, found: &Found<impl Sized>, at: i32, bytes: usize, field: Option<&Field>) {
        let reader = self.reader;
        let from = if at < 0 { self.least as i64 + i64::from(at) } else { i64::from(at) };
        let to = from + bytes as i64;
        if from < 0 || to > self.least as i64 {
            let expected = format!("all of its {bytes} bytes within the {} of a message", self.least);
            reader.fault(found, format!("byte {at}"), &expected, "correct the place, the type or the length");
            return;
        }
        let (from, to) = (from as usize, to as usize);
        let mut taken = self.taken.borrow_mut();
        let same_number = |other: &Taken| {
            let number = |field: &Field| (field.kind, field.big_endian);
            (other.from, other.to) == (from, to)
                && other.field.as_ref().zip(field).is_some_and(|(other, field)| number(other) == number(field))
        };
        if let Some(other) = taken.iter().find(|other| other.from < to && from < other.to && !same_number(other)) {
            let there = format!("bytes {from} to {}, which {} has", to - 1, other.what);
            reader.fault(found, there, "bytes of its own", "correct the place or the type of one of them");
        }
        taken.push(Taken { from, to, field: field.cloned(), what: found.key.clone() });
    }

    fn field(&self, table: &Section<'_>) -> Option<Field> {
        const TYPES: [(&str, NumberType); 9] = [
            ("u8", NumberType::U8),
            ("i8", NumberType::I8),
            ("u16", NumberType::U16),
            ("i16", NumberType::I16),
            ("u32", NumberType::U32),
            ("i32", NumberType::I32),
            ("u64", NumberType::U64),
            ("f32", NumberType::F32),
            ("f64", NumberType::F64),
        ];
        let reader = table.reader();
        let found = table.require("at", "the field's first byte, from 0; negative from the message's end");
        let most = MAX_PACKET_BYTES as i64;
        let at = found.as_ref().and_then(|found| reader.integer(found, -most..=most));
        let kind = table.require("type", "the field's type, such as \"u16\"");
        let kind = kind.and_then(|kind| reader.choose(&kind, &TYPES));
        let big_endian = read_endian(table).unwrap_or(self.big_endian);
        let shift = table.get("shift");
        let mask = table.get("mask");
        let (found, at, kind) = (found?, at? as i32, kind?);
        let bits = kind.bytes() as i64 * 8;
        for item in [&shift, &mask].into_iter().flatten().filter(|_| kind.is_float()) {
            reader.fault(item, "bits of a number with a fraction", "a whole number's type", "take it out");
        }
        let shift = shift.and_then(|shift| reader.integer(&shift, 0..=bits - 1)).unwrap_or(0) as u32;
        let widest = if bits < 63 { (1 << bits) - 1 } else { i64::MAX };
        let mask = mask.and_then(|mask| reader.integer(&mask, 1..=widest)).map(|mask| mask as u64);
        let field = Field { at, kind, big_endian, shift, mask };
        self.take(&found, at, kind.bytes(), Some(&field));
        Some(field)
    }
}

fn read_endian(table: &Section<'_>) -> Option<bool> {
    table.choice("endian", &[("little", false), ("big", true)])
}

impl<'a> Places<'a> for FieldPlaces<'_, 'a> {
    type Place = Field;

    fn bare(&self, _: &Found<&'a Item>) -> Option<Option<Field>> {
        None
    }

    fn read(&self, table: &Section<'a>) -> Option<Field> {
        self.field(table)
    }

    fn wrap_bits(&self, field: &Field) -> Option<u32> {
        let counts = matches!(field.kind, NumberType::U8 | NumberType::U16 | NumberType::U32);
        (counts || field.mask.is_some()).then(|| field.bits())
    }

    fn texts(&self) -> bool {
        false
    }

    fn same(&self, one: &Field, other: &Field) -> bool {
        (one.at, one.shift, one.mask) == (other.at, other.shift, other.mask)
    }
}

fn read_packet<'a>(wire: &Section<'a>, context: &Context) -> Option<PacketSettings> {
    const SYNC: &str = "the bytes that begin a packet, 1 to 16";
    let reader = wire.reader();
    let big_endian = read_endian(wire).unwrap_or(false);
    let sync_found = wire.require("sync", SYNC)?;
    let sync = reader.bytes(&sync_found)?;
    if sync.is_empty() || sync.len() > SYNC_MAX {
        reader.fault(&sync_found, format!("{} bytes", sync.len()), SYNC, "correct it");
        return None;
    }
    let found = wire.require("length", "the packet's bytes, or the table of the field that tells them")?;
    let longest = MAX_PACKET_BYTES as i64;
    let shortest = sync.len() as i64 + 1;
    let (least, told) = if found.value.as_table_like().is_some() {
        let table = reader.table(&found);
        let [least, most] = ["least", "most"].map(|key| {
            let bound = table.require(key, "bytes of a whole packet");
            bound.and_then(|bound| reader.integer(&bound, shortest..=longest))
        });
        (least? as usize, Some((table, most?)))
    } else {
        (reader.integer(&found, shortest..=longest)? as usize, None)
    };
    let places = FieldPlaces { reader, big_endian, least, taken: RefCell::default() };
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

fn read_packet_checksum(wire: &Section<'_>, places: &FieldPlaces<'_, '_>) -> Option<PacketChecksum> {
    let reader = wire.reader();
    let table = reader.table(&wire.get("checksum")?);
    let kind = table.require("kind", "a kind of checksum").and_then(|kind| read_checksum_kind(&table, &kind));
    let big_endian = read_endian(&table).unwrap_or(places.big_endian);
    let bound = |key| {
        let found = table.get(key)?;
        let range = -(places.least as i64)..=places.least as i64;
        reader.integer(&found, range).map(|at| at as i32)
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

fn read_report<'a>(wire: &Section<'a>, context: &Context) -> Option<ReportSettings> {
    let reader = wire.reader();
    let big_endian = read_endian(wire).unwrap_or(false);
    let id_found = wire.get("id");
    let id = id_found.as_ref().and_then(|found| reader.integer(found, 0..=255)).map(|id| id as u8);
    let [exact, least] = ["length", "least_length"]
        .map(|key| wire.integer(key, 1..=MAX_PACKET_BYTES as i64).map(|bytes| bytes as usize));
    if wire.has("length") == wire.has("least_length") {
        let found = if wire.has("length") { "length and least_length" } else { "neither length nor least_length" };
        wire.fault(found, "one of the two", "write length where every report has as many bytes");
    }
    let least = exact.or(least)?;
    let places = FieldPlaces { reader, big_endian, least, taken: RefCell::default() };
    if let Some(found) = &id_found {
        places.take(found, 0, 1, None);
    }
    let layout = read_layout(&places, wire, context)?;
    Some(ReportSettings { id, least, most: exact, layout })
}

/// The fields of a HID report, by their usages.
struct UsagePlaces<'r, 'a> {
    reader: &'r Reader<'a>,
}

impl UsagePlaces<'_, '_> {
    fn usage(&self, found: &Found<&Item>) -> Option<Usage> {
        const EXPECTED: &str = "a page and a number in hexadecimals, such as \"ff00:0030\"";
        let text = self.reader.text(found, EXPECTED)?;
        let usage = text.parse().ok();
        if usage.is_none() {
            self.reader.fault(found, format!("{text:?}"), EXPECTED, "correct it");
        }
        usage
    }
}

impl<'a> Places<'a> for UsagePlaces<'_, 'a> {
    type Place = UsageAt;

    fn bare(&self, found: &Found<&'a Item>) -> Option<Option<UsageAt>> {
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

#[cfg(test)]
mod tests {
    use crate::profile::parse::parse;
    use crate::wire::Format;
    use crate::wire::delimited::{Column, Separator};
    use crate::wire::field::{Field, Literal, NumberType, SizeKind, Validity};
    use crate::wire::packet::PacketLength;
    use crate::wire::{ChecksumKind, Crc};

    const LINES: &str = "format = \"holod-tracker-1\"\nname = \"x\"\n[wire]\nkind = \"delimited\"\n";
    const PACKET: &str = "format = \"holod-tracker-1\"\nname = \"x\"\n[wire]\nkind = \"packet\"\n";
    const REPORT: &str = "format = \"holod-tracker-1\"\nname = \"x\"\n[wire]\nkind = \"report\"\n";

    /// What is wrong with `keys` behind `head`.
    fn faults(head: &str, keys: &str) -> String {
        let faults = parse(&format!("{head}{keys}")).err().unwrap_or_default();
        faults.iter().map(|fault| format!("{fault}\n")).collect()
    }

    #[test]
    fn each_mistake_is_told_with_its_line_and_key() {
        let size = "left = { size = 1 }\n";
        let packet = "sync = [1, 2]\nlength = 8\n";
        let pupil = "left = { size = { at = 2, type = \"u16\" } }\n";
        let cases: &[(&str, &str, &str)] = &[
            ("", "format = 1 = 2", "line 1: found `format = 1 = 2`; expected TOML"),
            (
                "",
                "name = \"x\"",
                "format: found nothing; expected \"holod-tracker-1\"; add format to the top of the file",
            ),
            (
                "",
                "format = \"holod-tracker-2\"",
                "line 1, format: found \"holod-tracker-2\"; expected one of \"holod-tracker-1\"",
            ),
            ("", "format = \"holod-tracker-1\"\n[wire]\nkind = \"holod\"", "name: found nothing"),
            ("", "wires = 1", "line 1, wires: found an unknown key"),
            ("", "wires = 1", "did you mean `wire`?"),
            ("", "eye = \"middle\"", "line 1, eye: found \"middle\"; expected one of \"left\", \"right\", \"both\""),
            ("", "rate_hz = 0", "line 1, rate_hz: found 0; expected a number above 0"),
            (
                "",
                "rate_hz = \"60\"",
                "line 1, rate_hz: found a string \"60\"; expected a number above 0; write a plain number",
            ),
            ("", "about = 3", "line 1, about: found an integer 3"),
            ("", "serial = 3", "line 1, serial: found an integer 3; expected a table"),
            ("", "[serial]\nbaud = 0", "line 2, serial.baud: found 0; expected a whole number from 1"),
            (
                "",
                "[serial]\nparity = 0",
                "line 2, serial.parity: found an unknown key; expected one of baud, start, stop, usb",
            ),
            ("", "[serial]\nusb = [\"12\"]", "line 2, serial.usb[0]: found \"12\""),
            ("", "[serial]\nusb = \"1209:0001\"", "line 2, serial.usb: found a string"),
            ("", "[serial]\nstart = [{ expect = \"x\" }]", "line 2, serial.start[0].send: found nothing"),
            ("", "[serial]\nstart = [{ send = 'x\\y' }]", "`\\y` is no escape"),
            ("", "[serial]\nstart = [{ send = 'x\\x4' }]", "lacks its two hexadecimal digits"),
            ("", "[serial]\nstart = [{ send = \"\u{3c0}\" }]", "is no single byte"),
            ("", "[serial]\nstart = [{ send = [256] }]", "serial.start[0].send: found an array [256]; expected bytes"),
            ("", "[serial]\nstart = [{ send = \"x\", within_ms = 0 }]", "serial.start[0].within_ms: found 0"),
            ("", "[serial]\nstart = [{ send = \"x\", expects = \"y\" }]", "did you mean `expect`?"),
            ("", "[hid]\nusage_page = 65536", "line 2, hid.usage_page: found 65536"),
            ("", "[network]\nport = 0", "line 2, network.port: found 0"),
            (
                "",
                "[size]\nunit = \"inch\"",
                "line 2, size.unit: found \"inch\"; expected one of \"mm\", \"pixels\", \"arbitrary\"",
            ),
            ("", "[size]\nkind = \"diametre\"", "did you mean `diameter`?"),
            ("", "[size]\nmm_per_unit = -1", "line 2, size.mm_per_unit: found -1"),
            ("", "name = \"x\"", "wire: found nothing"),
            (
                "",
                "[wire]\nkind = \"packets\"",
                "line 2, wire.kind: found \"packets\"; expected one of \"holod\", \"delimited\"",
            ),
            ("", "[wire]\nkind = \"packets\"", "did you mean `packet`?"),
            ("", "[wire]\nkind = \"holod\"\nsync = 1", "line 3, wire.sync: found an unknown key"),
            // Lines.
            (LINES, "", "line 3, wire: found no pupil"),
            (LINES, "left = {}", "line 5, wire.left.size: found nothing"),
            (LINES, "left = { size = 0 }", "line 5, wire.left.size: found 0; expected a whole number from 1 to 128"),
            (LINES, "left = { size = 1.5 }", "line 5, wire.left.size: found 1.5; expected a column"),
            (LINES, "left = { size = {} }", "wire.left.size.column: found nothing"),
            (LINES, "left = { size = 1, shape = 2 }", "wire.left.shape: found an unknown key"),
            (LINES, "left = { size = { column = 1, scala = 2 } }", "did you mean `scale`?"),
            (LINES, "left = { size = 1 }\nright = { size = 1 }", "line 6, wire.right: found the size of another pupil"),
            (LINES, "pupil = { size = 1 }", "line 5, wire.pupil: found no word on its eye"),
            (LINES, "pupil = { size = 1 }\neye = { column = 2 }", "line 6, wire.eye: found no eye"),
            (LINES, "left = { size = 1, valid = { column = 2 } }", "wire.left.valid: found 0 rules; expected one rule"),
            (LINES, "left = { size = 1, valid = { column = 2, equals = 1, at_least = 2 } }", "found 2 rules"),
            (LINES, "left = { size = 1, valid = { column = 2, all_bits = 0 } }", "valid.all_bits: found 0"),
            (LINES, "left = { size = 1, lost = [true] }", "wire.left.lost[0]: found a boolean true"),
            (LINES, "left = { size = 1, confidence = { column = 2, full = 0 } }", "confidence.full: found 0"),
            (LINES, "left = { size = { column = 1, scale = inf } }", "size.scale: found inf"),
            (LINES, "left = { size = 1 }\ntime = 2", "line 6, wire.time.unit: found nothing"),
            (LINES, "left = { size = 1 }\ntime = { column = 2, unit = \"h\" }", "wire.time.unit: found \"h\""),
            (LINES, "left = { size = 1 }\ntime = { column = 2, unit = \"frames\" }", "found \"frames\" and no rate_hz"),
            (LINES, "left = { size = 1 }\ntime = { column = 2, unit = \"s\", tick_ns = 5 }", "found unit and tick_ns"),
            (LINES, "left = { size = 1 }\ntime = { column = 2, unit = \"s\", wrap_bits = 63 }", "wrap_bits: found 63"),
            (LINES, "left = { size = 1 }\nseparator = \"ab\"", "line 6, wire.separator: found \"ab\""),
            (LINES, "left = { size = 1 }\nseparator = \".\"", "wire.separator: found \".\""),
            (LINES, "left = { size = 1 }\ndecimal_comma = true", "found a comma in numbers and between columns"),
            (
                LINES,
                "left = { size = 1 }\ndecimal_comma = 1",
                "wire.decimal_comma: found an integer 1; expected true or false",
            ),
            (LINES, "left = { size = 1 }\nprefix = \"a\\n\"", "wire.prefix: found 2 bytes"),
            (LINES, "left = { size = 1 }\ncolumns = [\"a\", \"a\"]", "wire.columns: found"),
            (LINES, "left = { size = \"pupill\" }\ncolumns = [\"pupil\"]", "did you mean `pupil`?"),
            (LINES, "left = { size = 1 }\nchecksum = \"crc\"", "wire.checksum: found \"crc\""),
            (
                LINES,
                "left = { size = 1 }\nchecksum = { kind = \"crc8\", polynomial = 256 }",
                "checksum.polynomial: found 256",
            ),
            (
                LINES,
                "left = { size = 1 }\nchecksum = { kind = \"xor8\", polynomial = 7 }",
                "checksum.polynomial: found an unknown key",
            ),
            (LINES, "left = { size = 1 }\nsync = 1", "line 6, wire.sync: found an unknown key"),
            // Packets.
            (PACKET, "length = 8\n", "line 3, wire.sync: found nothing"),
            (PACKET, "sync = []\nlength = 8\n", "line 5, wire.sync: found 0 bytes"),
            (PACKET, "sync = [1, 2]\n", "wire.length: found nothing"),
            (PACKET, "sync = [1, 2]\nlength = 2\n", "line 6, wire.length: found 2; expected a whole number from 3"),
            (PACKET, "sync = [1, 2]\nlength = { at = 2, type = \"u8\" }\n", "wire.length.least: found nothing"),
            (
                PACKET,
                "sync = [1, 2]\nlength = { at = 2, type = \"u8\", least = 9, most = 8 }\n",
                "found least 9, most 8",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = { at = -2, type = \"u8\", least = 8, most = 8 }\n",
                "found a length that is far behind",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = 2 }\n",
                "wire.left.size: found an integer 2; expected a table",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { type = \"u8\" } }\n",
                "wire.left.size.at: found nothing",
            ),
            (PACKET, "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2 } }\n", "wire.left.size.type: found nothing"),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u24\" } }\n",
                "size.type: found \"u24\"",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { at = 7, type = \"u16\" } }\n",
                "line 7, wire.left.size.at: found byte 7; expected all of its 2 bytes within the 8",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { at = -1, type = \"u16\" } }\n",
                "size.at: found byte -1",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { at = 1, type = \"u16\" } }\n",
                "found bytes 1 to 2, which wire.sync has",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"f32\", mask = 1 } }\n",
                "size.mask: found bits of a number with a fraction",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u8\", mask = 256 } }\n",
                "size.mask: found 256",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u8\", shift = 8 } }\n",
                "size.shift: found 8",
            ),
            (PACKET, "sync = [1, 2]\nlength = 8\nendian = \"middle\"\n", "wire.endian: found \"middle\""),
            (PACKET, "sync = [1, 2]\nlength = 8\nchecksum = { kind = \"sum8\" }\n", "wire.checksum.at: found nothing"),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nchecksum = { kind = \"sum8\", at = 8 }\n",
                "wire.checksum.at: found byte 8",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nchecksum = { kind = \"sum8\", at = 7, to = 8 }\n",
                "found bytes 0 to 7 under the checksum at byte 7",
            ),
            (
                PACKET,
                "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u8\" }, lost = \"x\" }\n",
                "wire.left.lost: found \"x\"; expected a number",
            ),
            // Reports.
            (REPORT, "", "line 3, wire: found neither length nor least_length"),
            (REPORT, "length = 8\nleast_length = 8\n", "found length and least_length"),
            (REPORT, "id = 256\nlength = 8\n", "wire.id: found 256"),
            (
                REPORT,
                "id = 1\nlength = 8\nleft = { size = { at = 0, type = \"u8\" } }\n",
                "found bytes 0 to 0, which wire.id has",
            ),
        ];
        for (head, keys, told) in cases {
            let found = faults(head, keys);
            assert!(found.contains(told), "{keys}\n  does not tell {told}\n  but {found}");
        }
        // The canary: what is right has no fault.
        assert_eq!(faults(LINES, size), "");
        assert_eq!(faults(PACKET, &format!("{packet}{pupil}")), "");
        let eye = "eye = \"left\"
";
        assert!(faults(eye, &format!("{LINES}{size}")).contains("line 1, eye: found left; expected no eye here"));
    }

    #[test]
    fn every_fault_is_told_at_once_in_the_order_of_lines() {
        let text = "format = \"holod-tracker-1\"\nrate_hz = -1\n[serial]\nbaud = 0\n[wire]\nkind = \"delimited\"\n";
        let lines: Vec<_> = parse(text).unwrap_err().into_iter().map(|fault| fault.line).collect();
        assert_eq!(lines, [Some(2), Some(4), Some(5), None]);
    }

    #[test]
    fn every_key_of_a_line_format_is_read() {
        let text = r##"
            format = "holod-tracker-1"
            name = "x"
            about = "y"
            rate_hz = 50
            [size]
            kind = "area"
            unit = "pixels"
            mm_per_unit = 0.5
            [serial]
            baud = 9600
            usb = ["1209:0001", "0403:6001"]
            start = [{ send = "Go\r", expect = '\x06ok', within_ms = 20 }, { send = [0x80] }]
            stop = [{ send = "Stop" }]
            [network]
            port = 4242
            [wire]
            kind = "delimited"
            separator = "whitespace"
            decimal_comma = true
            prefix = "E"
            comment = "//"
            checksum = { kind = "crc16-ccitt", skip = 1, initial = 3, polynomial = 5, final_xor = 7, reflected = true }
            time = { column = 1, unit = "frames", wrap_bits = 16 }
            sequence = { column = "n", wrap_bits = 8 }
            eye = { column = 3, left = ["L", 0], right = "R" }
            [wire.pupil]
            size = { column = "d", scale = 2, offset = -1 }
            lost = [0, "n/a"]
            confidence = { column = 5, full = 100 }
            aperture = { column = 6, scale = 0.1 }
            valid = { column = 7, differs = "bad" }
        "##;
        let profile = parse(text).unwrap_or_else(|faults| panic!("{faults:?}"));
        assert_eq!((profile.name.as_str(), profile.about.as_str(), profile.unit.name()), ("x", "y", "mm"));
        assert_eq!(profile.serial.baud, 9600);
        assert_eq!(profile.serial.usb[1].to_string(), "0403:6001");
        let [first, second] = &profile.serial.start[..] else { panic!("{:?}", profile.serial.start) };
        assert_eq!((&first.send[..], first.expect.as_deref()), (&b"Go\r"[..], Some(&b"\x06ok"[..])));
        assert_eq!((first.within.as_millis(), second.within.as_millis()), (20, 1000));
        assert_eq!((&second.send[..], &profile.serial.stop[0].send[..]), (&[0x80][..], &b"Stop"[..]));
        assert_eq!(profile.network.port, Some(4242));
        let Format::Delimited(settings) = profile.format else { panic!() };
        assert_eq!((settings.separator, settings.decimal_comma), (Separator::Whitespace, true));
        assert_eq!((&settings.prefix[..], &settings.comment[..]), (&b"E"[..], &b"//"[..]));
        let crc = Crc { bits: 16, polynomial: 5, initial: 3, reflected: true, final_xor: 7 };
        assert_eq!(settings.checksum, Some((ChecksumKind::Crc(crc), 1)));
        let layout = settings.layout;
        let time = layout.time.unwrap();
        assert_eq!((time.at, time.ns_per_tick, time.wrap_bits), (Column::Number(1), 2e7, Some(16)));
        assert_eq!(layout.sequence, Some((Column::Name("n".into()), Some(8))));
        let (at, eyes) = layout.eye.unwrap();
        assert_eq!((at, eyes.len(), &eyes[1].0), (Column::Number(3), 3, &Literal::Number(0.0)));
        let pupil = &layout.pupils[0];
        assert_eq!((pupil.eye, pupil.size.scale, pupil.size.offset), (None, 2.0, -1.0));
        assert_eq!(pupil.lost, [Literal::Number(0.0), Literal::Text(b"n/a".to_vec())]);
        assert_eq!(pupil.confidence.as_ref().unwrap().scale, 0.01);
        assert_eq!(pupil.aperture.as_ref().unwrap().scale, 0.1);
        assert_eq!(pupil.valid, Some((Column::Number(7), Validity::Differs(Literal::Text(b"bad".to_vec())))));
        assert_eq!((layout.size.kind, layout.size.mm_per_unit), (SizeKind::Area, 0.5));
    }

    #[test]
    fn every_key_of_a_packet_is_read() {
        let keys = r#"
            sync = "\xFAS"
            endian = "big"
            length = { at = 2, type = "u8", adds = 4, least = 12, most = 40 }
            checksum = { kind = "crc16-modbus", at = -2, from = 2, endian = "little" }
            time = { at = 4, type = "u32", tick_ns = 100, mask = 0xFFFFFF }
            left = { size = { at = 8, type = "i16", shift = 2, endian = "little" }, valid = { at = 3, type = "u8", no_bits = 6 } }
        "#;
        let profile = parse(&format!("{PACKET}{keys}")).unwrap_or_else(|faults| panic!("{faults:?}"));
        let Format::Packet(settings) = profile.format else { panic!() };
        assert_eq!(settings.sync, b"\xFAS");
        let field = |at, kind, big_endian| Field { at, kind, big_endian, shift: 0, mask: None };
        let length = PacketLength::Told { field: field(2, NumberType::U8, true), adds: 4, least: 12, most: 40 };
        assert_eq!(settings.length, length);
        let checksum = settings.checksum.unwrap();
        assert_eq!((checksum.at, checksum.from, checksum.to, checksum.big_endian), (-2, 2, -2, false));
        let time = settings.layout.time.unwrap();
        assert_eq!((time.at.bits(), time.wrap_bits, time.ns_per_tick), (24, Some(24), 100.0));
        let pupil = &settings.layout.pupils[0];
        assert_eq!(pupil.size.at, Field { shift: 2, ..field(8, NumberType::I16, false) });
        assert_eq!(pupil.valid, Some((field(3, NumberType::U8, true), Validity::NoBits(6))));
    }
}
