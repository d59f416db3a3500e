//! Where a message holds its time, its eye and its pupils, whatever its places are: columns, bytes or usages.

use holod_calibration::toml_reader::{Found, Section};
use toml_edit::Item;

use super::context::{Context, EYES, PUPILS};
use crate::SampleEye;
use crate::wire::field::{Figure, Layout, Literal, PupilAt, TimeAt, Validity};

/// How the places of a kind of message are written.
pub(super) trait Places<'a> {
    type Place: Clone;

    /// The place that an item is in itself; None where it is a table that tells it.
    fn bare(&self, found: &Found<'a, &'a Item>) -> Option<Option<Self::Place>>;

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
    if let Some(place) = places.bare(&found) {
        return more(&Section::empty(&found), place?);
    }
    let table = found.table();
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

pub(super) fn read_layout<'a, P: Places<'a>>(
    places: &P,
    wire: &Section<'a>,
    context: &Context<'_>,
) -> Option<Layout<P::Place>> {
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
    for (key, own_eye) in PUPILS {
        let table = wire.section(key);
        if !table.is_there() {
            continue;
        }
        let eye_on_wire = wire.has("eye");
        if own_eye.is_none() && !eye_on_wire && context.eye.is_none() {
            const EXPECTED: &str = "an eye: `eye = \"left\"` at the top of the file, or [wire.eye]";
            table.fault("no word on its eye", EXPECTED, "or name the table after its eye, as [wire.left]");
        }
        let eye = own_eye.or(context.eye.as_ref().filter(|_| !eye_on_wire).map(|eye| eye.value));
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
    if !PUPILS.iter().any(|(key, _)| wire.has(key)) {
        let expected = "at least one of [wire.left], [wire.right], [wire.both], [wire.pupil]";
        wire.fault("no pupil", expected, "add for example [wire.left] with the place of its size");
    }
    if let Some(found) = context.eye.as_ref().filter(|_| !wire.has("pupil") || wire.has("eye")) {
        found.fault(found.value, "no eye here: the wire tells it", "take it out");
    }
    Some(Layout { time, sequence, eye, pupils, size: context.size })
}

/// Nanoseconds of one unit of a time.
fn read_tick(table: &Section<'_>, context: &Context<'_>) -> Option<f64> {
    const UNITS: [(&str, Option<f64>); 5] =
        [("s", Some(1e9)), ("ms", Some(1e6)), ("us", Some(1e3)), ("ns", Some(1.0)), ("frames", None)];
    if let Some(tick_ns) = table.positive("tick_ns") {
        if table.has("unit") {
            table.fault("unit and tick_ns", "one of the two", "take one out");
        }
        return Some(tick_ns);
    }
    let unit = table.require("unit", "the time's unit, or tick_ns")?;
    if let Some(ns) = unit.choose(&UNITS)? {
        return Some(ns);
    }
    let frames_per_second = context.frames_per_second();
    if frames_per_second.is_none() {
        unit.fault(
            "\"frames\" and no rate_hz",
            "how many frames a second has",
            "add rate_hz = 60.0 to the top of the file",
        );
    }
    Some(1e9 / frames_per_second?)
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
            if let Some(literal) = table.get(key).and_then(|found| read_literal(places, &found)) {
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
    if found.value.is_array() {
        let items = found.items("figures in brackets");
        items.iter().filter_map(|item| read_literal(places, &item.with(&item.value))).collect()
    } else {
        read_literal(places, &found).into_iter().collect()
    }
}

fn read_literal<'a, P: Places<'a>>(places: &P, found: &Found<'_, &Item>) -> Option<Literal> {
    match found.value.as_str() {
        Some(text) if places.texts() => Some(Literal::Text(text.as_bytes().to_vec())),
        Some(text) => {
            found.fault(format!("{text:?}"), "a number: this wire has no texts", "take the quotes away");
            None
        }
        None => found.number("a number or a text").map(Literal::Number),
    }
}
