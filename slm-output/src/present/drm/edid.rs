//! The few things that are read from a monitor's EDID: who it is, how large it is, and which colour models it takes.

use holod_calibration::Resolution;

const BLOCK_BYTES: usize = 128;
const HEADER: [u8; 8] = [0, 255, 255, 255, 255, 255, 255, 0];
/// The base block's four descriptors of 18 bytes.
const DESCRIPTORS: std::ops::Range<usize> = 54..126;
const DESCRIPTOR_BYTES: usize = 18;

/// What a monitor says of itself, from the base block of its EDID (VESA E-EDID 1.4) and its CTA-861 extensions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Edid {
    /// The maker's three letters.
    pub maker: String,
    /// The maker's code of the product.
    pub product: u16,
    /// The serial number as a number; 0 where there is none.
    pub serial_number: u32,
    /// The product's name, where the monitor tells one.
    pub name: Option<String>,
    /// The serial number as text, where the monitor tells one.
    pub serial: Option<String>,
    /// Pixels of the first detailed timing, which is the panel's own where a panel has pixels.
    pub native: Option<Resolution>,
    /// Whether the monitor takes YCbCr 4:4:4, too, which some drivers send then in place of RGB.
    pub takes_ycbcr_444: bool,
}

impl Edid {
    /// Reads the base block and the extensions behind it that are whole; `None` where the former is none or its check
    /// sum is wrong.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let mut blocks = bytes.chunks_exact(BLOCK_BYTES);
        let block = blocks.next()?;
        if block[..8] != HEADER || !sums_to_zero(block) {
            return None;
        }
        let maker = u16::from_be_bytes([block[8], block[9]]);
        let letter = |shift: u16| char::from(b'@' + ((maker >> shift) & 31) as u8);
        let descriptors = || block[DESCRIPTORS].chunks_exact(DESCRIPTOR_BYTES);
        let text = |tag: u8| {
            let found = descriptors().find(|descriptor| descriptor[..3] == [0, 0, 0] && descriptor[3] == tag)?;
            let text = String::from_utf8_lossy(&found[5..]);
            let text = text.split('\n').next().unwrap_or_default().trim();
            (!text.is_empty()).then(|| text.to_owned())
        };
        let timing = &block[DESCRIPTORS][..DESCRIPTOR_BYTES];
        let native = (timing[..2] != [0, 0]).then(|| Resolution {
            width: usize::from(timing[2]) | usize::from(timing[4] >> 4) << 8,
            height: usize::from(timing[5]) | usize::from(timing[7] >> 4) << 8,
        });
        Some(Self {
            maker: [10, 5, 0].map(letter).iter().collect(),
            product: u16::from_le_bytes([block[10], block[11]]),
            serial_number: u32::from_le_bytes([block[12], block[13], block[14], block[15]]),
            name: text(0xfc),
            serial: text(0xff),
            native,
            takes_ycbcr_444: base_takes_ycbcr_444(block) || blocks.any(extension_takes_ycbcr_444),
        })
    }

    /// Whether `asked` is the monitor's name, its serial number, or both with a space between them.
    pub fn is(&self, asked: &str) -> bool {
        let serial = self.serial.clone().or((self.serial_number != 0).then(|| self.serial_number.to_string()));
        let same = |text: &str| text.eq_ignore_ascii_case(asked.trim());
        let both = self.name.iter().zip(&serial).any(|(name, serial)| same(&format!("{name} {serial}")));
        both || self.name.as_deref().is_some_and(same)
            || serial.as_deref().is_some_and(same)
            || (self.serial_number != 0 && same(&self.serial_number.to_string()))
    }
}

fn sums_to_zero(block: &[u8]) -> bool {
    block.iter().fold(0u8, |sum, &byte| sum.wrapping_add(byte)) == 0
}

/// Bit 3 of the features, of which a digital input's are colour models since revision 4 (VESA E-EDID 1.4, 3.6.4).
fn base_takes_ycbcr_444(block: &[u8]) -> bool {
    let (revision, is_digital, features) = (block[19], block[20] & 0x80 != 0, block[24]);
    revision >= 4 && is_digital && features & 0x08 != 0
}

/// Bit 5 of byte 3, since version 2 of the extension (CTA-861-H, 7.5).
fn extension_takes_ycbcr_444(block: &[u8]) -> bool {
    const CTA_861: u8 = 2;
    sums_to_zero(block) && block[0] == CTA_861 && block[1] >= 2 && block[3] & 0x20 != 0
}

impl std::fmt::Display for Edid {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.name {
            Some(name) => write!(f, "{name:?}")?,
            None => write!(f, "{} {:04x}", self.maker, self.product)?,
        }
        match (&self.serial, self.serial_number) {
            (Some(serial), _) => write!(f, " serial {serial:?}"),
            (None, 0) => Ok(()),
            (None, number) => write!(f, " serial {number}"),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A base block with one detailed timing, a name and a serial number.
    pub(crate) fn block(resolution: Resolution, name: &str, serial: &str, serial_number: u32) -> Vec<u8> {
        let mut block = vec![0; BLOCK_BYTES];
        block[..8].copy_from_slice(&HEADER);
        // "HLD", product 0x0102
        block[8..12].copy_from_slice(&[0x21, 0x84, 2, 1]);
        block[12..16].copy_from_slice(&serial_number.to_le_bytes());
        let (width, height) = (resolution.width as u16, resolution.height as u16);
        block[54..56].copy_from_slice(&14850u16.to_le_bytes());
        block[56] = width as u8;
        block[58] = (width >> 8 << 4) as u8;
        block[59] = height as u8;
        block[61] = (height >> 8 << 4) as u8;
        for (place, tag, text) in [(72, 0xfc, name), (90, 0xff, serial)] {
            block[place + 3] = tag;
            let mut bytes = format!("{text}\n").into_bytes();
            bytes.resize(13, b' ');
            block[place + 5..place + 18].copy_from_slice(&bytes);
        }
        sealed(block)
    }

    /// A block with its check sum set right.
    fn sealed(mut block: Vec<u8>) -> Vec<u8> {
        block[127] = 0;
        let sum = block.iter().fold(0u8, |sum, &byte| sum.wrapping_add(byte));
        block[127] = sum.wrapping_neg();
        block
    }

    /// A base block like [`block`]'s, followed by a CTA-861 extension with these features.
    pub(crate) fn block_with_extension(resolution: Resolution, features: u8) -> Vec<u8> {
        let mut extension = vec![0; BLOCK_BYTES];
        extension[..4].copy_from_slice(&[2, 3, 4, features]);
        [block(resolution, "HOLOEYE", "1", 0), sealed(extension)].concat()
    }

    const FULL_HD: Resolution = Resolution { width: 1920, height: 1080 };

    #[test]
    fn identity_and_size_are_read() {
        let edid = Edid::parse(&block(FULL_HD, "PLUTO-2.1", "6001-0815", 4711)).unwrap();
        let expected = Edid {
            maker: "HLD".into(),
            product: 0x0102,
            serial_number: 4711,
            name: Some("PLUTO-2.1".into()),
            serial: Some("6001-0815".into()),
            native: Some(FULL_HD),
            takes_ycbcr_444: false,
        };
        assert_eq!(edid, expected);
        assert_eq!(edid.to_string(), r#""PLUTO-2.1" serial "6001-0815""#);
        for asked in ["PLUTO-2.1", "pluto-2.1", "6001-0815", "4711", "PLUTO-2.1 6001-0815"] {
            assert!(edid.is(asked), "{asked}");
        }
        for asked in ["PLUTO", "", "0", "6001", "HLD"] {
            assert!(!edid.is(asked), "{asked}");
        }
    }

    #[test]
    fn what_is_no_edid_is_none() {
        let good = block(FULL_HD, "A", "B", 1);
        assert_eq!(Edid::parse(&[]), None);
        assert_eq!(Edid::parse(&good[..127]), None);
        for place in [0, 20, 127] {
            let mut changed = good.clone();
            changed[place] ^= 1;
            assert_eq!(Edid::parse(&changed), None, "byte {place}");
        }
    }

    #[test]
    fn a_monitor_without_texts_is_known_by_its_numbers() {
        let edid = Edid::parse(&block(FULL_HD, "", "", 0)).unwrap();
        assert_eq!((&edid.name, &edid.serial), (&None, &None));
        assert_eq!(edid.to_string(), "HLD 0102");
        assert!(!edid.is("") && !edid.is("0"));
    }

    #[test]
    fn colour_models_are_read_from_both_places() {
        let takes = |bytes: &[u8]| Edid::parse(bytes).unwrap().takes_ycbcr_444;
        assert!(takes(&block_with_extension(FULL_HD, 0x20)));
        assert!(takes(&block_with_extension(FULL_HD, 0xf0)));
        for none in [0x00, 0x10, 0xc0] {
            assert!(!takes(&block_with_extension(FULL_HD, none)), "features {none:#x}");
        }
        let mut torn = block_with_extension(FULL_HD, 0x20);
        torn[BLOCK_BYTES + 50] ^= 1;
        assert!(!takes(&torn));
        assert!(!takes(&block_with_extension(FULL_HD, 0x20)[..255]));

        let base = |revision: u8, input: u8, features: u8| {
            let mut block = block(FULL_HD, "A", "B", 1);
            (block[18], block[19], block[20], block[24]) = (1, revision, input, features);
            takes(&sealed(block))
        };
        assert!(base(4, 0xa5, 0x08));
        assert!(!base(3, 0xa5, 0x08), "revision 3 means a kind of display by it");
        assert!(!base(4, 0x25, 0x08), "an analogue input, too");
        assert!(!base(4, 0xa5, 0x10));
    }
}
