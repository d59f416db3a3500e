//! The places of a binary message: bytes, as numbers of a type.

use std::cell::RefCell;

use holod_calibration::toml_reader::{Found, Section};
use toml_edit::Item;

use super::layout::Places;
use crate::wire::field::{Field, NumberType};
use crate::wire::packet::MAX_PACKET_BYTES;

/// The places of a binary message, with what has been found to stand where.
pub(super) struct FieldPlaces {
    pub(super) big_endian: bool,
    /// Bytes that every message has.
    pub(super) least: usize,
    pub(super) taken: RefCell<Vec<Taken>>,
}

/// Bytes of a message that mean something.
#[derive(Clone)]
pub(super) struct Taken {
    from: usize,
    to: usize,
    /// None for what is no field of the layout: nothing may share its bytes.
    field: Option<Field>,
    what: String,
}

impl FieldPlaces {
    /// Takes the bytes from `at` for `what`; a fault where they lie outside the message or are taken already. Two
    /// fields may be the same number, of which each has its bits.
    pub(super) fn take(&self, found: &Found<'_, impl Sized>, at: i32, bytes: usize, field: Option<&Field>) {
        let from = if at < 0 { self.least as i64 + i64::from(at) } else { i64::from(at) };
        let to = from + bytes as i64;
        if from < 0 || to > self.least as i64 {
            let expected = format!("all of its {bytes} bytes within the {} of a message", self.least);
            found.fault(format!("byte {at}"), &expected, "correct the place, the type or the length");
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
            found.fault(there, "bytes of its own", "correct the place or the type of one of them");
        }
        taken.push(Taken { from, to, field: field.cloned(), what: found.key.clone() });
    }

    pub(super) fn field(&self, table: &Section<'_>) -> Option<Field> {
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
        let found = table.require("at", "the field's first byte, from 0; negative from the message's end");
        let most = MAX_PACKET_BYTES as i64;
        let at = found.as_ref().and_then(|found| found.integer(-most..=most));
        let kind = table.require("type", "the field's type, such as \"u16\"");
        let kind = kind.and_then(|kind| kind.choose(&TYPES));
        let big_endian = read_endian(table).unwrap_or(self.big_endian);
        let shift = table.get("shift");
        let mask = table.get("mask");
        let (found, at, kind) = (found?, at? as i32, kind?);
        let bits = kind.bytes() as i64 * 8;
        for item in [&shift, &mask].into_iter().flatten().filter(|_| kind.is_float()) {
            item.fault("bits of a number with a fraction", "a whole number's type", "take it out");
        }
        let shift = shift.and_then(|shift| shift.integer(0..=bits - 1)).unwrap_or(0) as u32;
        let widest = if bits < 63 { (1 << bits) - 1 } else { i64::MAX };
        let mask = mask.and_then(|mask| mask.integer(1..=widest)).map(|mask| mask as u64);
        let field = Field { at, kind, big_endian, shift, mask };
        self.take(&found, at, kind.bytes(), Some(&field));
        Some(field)
    }
}

pub(super) fn read_endian(table: &Section<'_>) -> Option<bool> {
    Some(table.choice("endian", &[("little", false), ("big", true)], false)?.value)
}

impl<'a> Places<'a> for FieldPlaces {
    type Place = Field;

    fn bare(&self, _: &Found<'a, &'a Item>) -> Option<Option<Field>> {
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
