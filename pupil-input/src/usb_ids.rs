//! What a USB device is known by.

use std::fmt;
use std::str::FromStr;

/// USB vendor and product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UsbIds {
    /// The number of the vendor, `idVendor`.
    pub vendor: u16,
    /// The vendor's number of the product, `idProduct`.
    pub product: u16,
}

impl fmt::Display for UsbIds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:04x}:{:04x}", self.vendor, self.product)
    }
}

impl FromStr for UsbIds {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (vendor, product) = hexadecimal_pair(text)
            .ok_or_else(|| format!("`{text}` is no USB VID:PID, two hexadecimal numbers such as 1209:0001"))?;
        Ok(Self { vendor, product })
    }
}

/// The two numbers of `1209:0001`, of up to four digits each.
pub(crate) fn hexadecimal_pair(text: &str) -> Option<(u16, u16)> {
    let number = |part: &str| (part.len() <= 4).then(|| u16::from_str_radix(part, 16).ok()).flatten();
    let (first, second) = text.split_once(':')?;
    number(first).zip(number(second))
}
