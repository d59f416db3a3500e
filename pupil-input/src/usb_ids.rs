//! What a USB device is known by.

use std::fmt;
use std::str::FromStr;

/// USB vendor and product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UsbIds {
    /// Vendor.
    pub vendor: u16,
    /// Product.
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
        let number = |part: &str| (part.len() <= 4).then(|| u16::from_str_radix(part, 16).ok()).flatten();
        let ids = text.split_once(':').and_then(|(vendor, product)| number(vendor).zip(number(product)));
        let (vendor, product) =
            ids.ok_or_else(|| format!("`{text}` is no USB VID:PID, two hexadecimal numbers such as 1209:0001"))?;
        Ok(Self { vendor, product })
    }
}
