//! Checksums of messages: sums, exclusive ors and cyclic redundancy checks of up to 16 bits.
//!
//! A profile gives the parameters when it is read, and the crate `crc` takes only those that are there for good, so the
//! table is made here.

/// How bytes are summed up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChecksumKind {
    /// The sum of all bytes, its lowest 8 bits.
    Sum8,
    /// The exclusive or of all bytes.
    Xor8,
    /// A cyclic redundancy check.
    Crc(Crc),
}

/// The parameters of a cyclic redundancy check, named as in the catalogue of parametrised CRC algorithms (reveng).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crc {
    /// Width of the register and of the sum, 8 or 16 bits.
    pub bits: u32,
    /// The polynomial without its highest term, not reflected.
    pub polynomial: u16,
    /// The register's initial value.
    pub initial: u16,
    /// Bytes enter and the register leaves with its lowest bit first.
    pub reflected: bool,
    /// What the register is combined with at the end, by exclusive or.
    pub final_xor: u16,
}

impl ChecksumKind {
    /// Bytes of the sum.
    pub const fn width(self) -> usize {
        match self {
            Self::Sum8 | Self::Xor8 => 1,
            Self::Crc(crc) => (crc.bits / 8) as usize,
        }
    }
}

/// A checksum that is ready to be reckoned.
#[derive(Clone, Debug)]
pub(super) enum Checksum {
    Sum8,
    Xor8,
    Crc { crc: Crc, table: Box<[u16; 256]> },
}

impl Checksum {
    pub(super) fn new(kind: ChecksumKind) -> Self {
        match kind {
            ChecksumKind::Sum8 => Self::Sum8,
            ChecksumKind::Xor8 => Self::Xor8,
            ChecksumKind::Crc(crc) => {
                Self::Crc { crc, table: Box::new(std::array::from_fn(|index| entry(crc, index as u16))) }
            }
        }
    }

    pub(super) fn of(&self, bytes: &[u8]) -> u16 {
        match self {
            Self::Sum8 => u16::from(bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte))),
            Self::Xor8 => u16::from(bytes.iter().fold(0, |sum, byte| sum ^ byte)),
            Self::Crc { crc, table } => {
                let initial = if crc.reflected { reflect(crc.initial, crc.bits) } else { crc.initial };
                // The register of a wide, plain check is shifted to the left; every other one to the right or out.
                let register = bytes.iter().fold(initial, |register, &byte| {
                    if crc.reflected {
                        (register >> 8) ^ table[usize::from((register as u8) ^ byte)]
                    } else if crc.bits == 8 {
                        table[usize::from((register as u8) ^ byte)]
                    } else {
                        (register << 8) ^ table[usize::from(((register >> 8) as u8) ^ byte)]
                    }
                });
                register ^ crc.final_xor
            }
        }
    }
}

/// What one byte makes of an empty register.
fn entry(crc: Crc, byte: u16) -> u16 {
    if crc.reflected {
        let polynomial = reflect(crc.polynomial, crc.bits);
        return (0..8).fold(byte, |value, _| (value >> 1) ^ if value & 1 == 1 { polynomial } else { 0 });
    }
    let top = 1 << (crc.bits - 1);
    let mask = ((1_u32 << crc.bits) - 1) as u16;
    (0..8).fold(byte << (crc.bits - 8), |value, _| (value << 1) ^ if value & top == 0 { 0 } else { crc.polynomial })
        & mask
}

const fn reflect(value: u16, bits: u32) -> u16 {
    value.reverse_bits() >> (16 - bits)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_check_gives_its_published_value() {
        // Check values of "123456789" in the catalogue of parametrised CRC algorithms.
        let crc = |bits, polynomial, initial, reflected, final_xor| {
            ChecksumKind::Crc(Crc { bits, polynomial, initial, reflected, final_xor })
        };
        let cases = [
            ("CRC-8/SMBUS", crc(8, 0x07, 0, false, 0), 0xF4),
            ("CRC-8/MAXIM-DOW", crc(8, 0x31, 0, true, 0), 0xA1),
            ("CRC-8/ROHC", crc(8, 0x07, 0xFF, true, 0), 0xD0),
            ("CRC-8/CDMA2000", crc(8, 0x9B, 0xFF, false, 0), 0xDA),
            ("CRC-16/IBM-3740", crc(16, 0x1021, 0xFFFF, false, 0), 0x29B1),
            ("CRC-16/XMODEM", crc(16, 0x1021, 0, false, 0), 0x31C3),
            ("CRC-16/KERMIT", crc(16, 0x1021, 0, true, 0), 0x2189),
            ("CRC-16/IBM-SDLC", crc(16, 0x1021, 0xFFFF, true, 0xFFFF), 0x906E),
            ("CRC-16/MODBUS", crc(16, 0x8005, 0xFFFF, true, 0), 0x4B37),
            ("sum", ChecksumKind::Sum8, 0xDD),
            ("exclusive or", ChecksumKind::Xor8, 0x31),
        ];
        for (name, kind, check) in cases {
            assert_eq!(Checksum::new(kind).of(b"123456789"), check, "{name}");
        }
    }
}
