//! The part of a profile that says how bytes are read: a file for each kind of message, and a line for it in [`KINDS`].

mod checksum;
mod context;
mod delimited;
mod fields;
mod layout;
mod packet;
mod report;
#[cfg(test)]
mod tests;
mod usages;
mod vendor;

pub(super) use context::{Context, EYES};
use delimited::read_delimited;
use packet::read_packet;
use report::read_report;
use usages::read_usages;
use vendor::{read_iscan, read_livetrack, read_open_gaze, read_pupilext};

use holod_calibration::toml_reader::Section;

use crate::size_unit::SizeUnit;
use crate::wire::Format;

/// A kind of message, as `kind` names it.
struct Kind {
    name: &'static str,
    /// Whether `[size]` says what its sizes are; those of the others are known.
    takes_size: bool,
    read: ReadKind,
}

/// The format that the keys of `[wire]` describe, and what its sizes are before the rig's scale.
type ReadKind = for<'a> fn(&Section<'a>, &Context<'_>) -> Option<(Format, SizeUnit)>;

static KINDS: [Kind; 11] = [
    known("holod", |_, _| Some((Format::Lines, SizeUnit::Millimetres))),
    sized("delimited", |wire, context| Some((Format::Delimited(read_delimited(wire, context)?), context.unit))),
    sized("packet", |wire, context| Some((Format::Packet(read_packet(wire, context)?), context.unit))),
    sized("report", |wire, context| Some((Format::Report(read_report(wire, context)?), context.unit))),
    sized("usages", |wire, context| Some((Format::Usages(read_usages(wire, context)?), context.unit))),
    sized("iscan", |wire, context| Some((Format::Iscan(read_iscan(wire, context)?), context.unit))),
    known("livetrack", read_livetrack),
    known("open-gaze", |wire, context| Some(read_open_gaze(wire, context))),
    known("pupilext", |wire, context| Some(read_pupilext(wire, context))),
    known("core", |_, _| Some((Format::CoreMsgpack, SizeUnit::Millimetres))),
    known("neon", |_, _| Some((Format::NeonRtp, SizeUnit::Millimetres))),
];

const fn sized(name: &'static str, read: ReadKind) -> Kind {
    Kind { name, takes_size: true, read }
}

const fn known(name: &'static str, read: ReadKind) -> Kind {
    Kind { name, takes_size: false, read }
}

/// The format, and what its sizes are before the rig's scale.
pub(super) fn read_wire<'a>(wire: &Section<'a>, context: &Context<'_>) -> Option<(Format, SizeUnit)> {
    let kinds = KINDS.each_ref().map(|kind| (kind.name, kind));
    let kind = wire.choice("kind", &kinds, true)?.value;
    let read = (kind.read)(wire, context);
    if let Some(size) = context.size_at.as_ref().filter(|_| !kind.takes_size) {
        let advice = "take it out; the rig's tracker.scale_mm_per_unit is for sizes that are no millimetres";
        size.fault("a table", &format!("none for \"{}\": its sizes are known", kind.name), advice);
    }
    // Where it is none, keys may not have been asked for.
    if read.is_some() {
        wire.finish();
    }
    read
}
