//! The checksum of a line or a packet.

use holod_calibration::toml_reader::{Found, Section};
use toml_edit::Item;

use crate::wire::{ChecksumKind, Crc};

/// The kind that `found` names, with the parameters of a cyclic redundancy check from `table`.
pub(super) fn read_checksum_kind<'a>(table: &Section<'a>, found: &Found<'a, &'a Item>) -> Option<ChecksumKind> {
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
    let ChecksumKind::Crc(crc) = found.choose(&kinds)? else {
        return found.choose(&kinds);
    };
    let register = 0..=(1_i64 << crc.bits) - 1;
    let [polynomial, initial, final_xor] = ["polynomial", "initial", "final_xor"]
        .map(|key| table.integer(key, register.clone()).map(|value| value as u16));
    Some(ChecksumKind::Crc(Crc {
        bits: crc.bits,
        polynomial: polynomial.unwrap_or(crc.polynomial),
        initial: initial.unwrap_or(crc.initial),
        reflected: table.flag("reflected", crc.reflected),
        final_xor: final_xor.unwrap_or(0),
    }))
}
