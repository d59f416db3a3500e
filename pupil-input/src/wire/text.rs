//! What the formats of text lines share: lines gathered in constant memory, and figures.

use holod_calibration::TimeNs;

use super::{WireEvent, WireFault};

/// Lines of at most `MAX` bytes, however their bytes are split.
#[derive(Clone, Debug)]
pub(super) struct LineBuffer<const MAX: usize> {
    bytes: [u8; MAX],
    used: usize,
    overlong: bool,
    /// The next line may have lost its beginning.
    first: bool,
}

/// A line that has something in it, without the blanks and control characters at its ends.
#[derive(Clone, Copy, Debug)]
pub(super) struct Line<'a> {
    pub(super) bytes: &'a [u8],
    /// It was longer than is kept; `bytes` is its beginning.
    pub(super) overlong: bool,
    first: bool,
}

impl Line<'_> {
    /// The event for a line that cannot be read; where reading began in its middle, that is no fault.
    pub(super) fn rejected(&self, fault: WireFault) -> WireEvent {
        if self.first { WireEvent::Partial } else { WireEvent::Rejected(fault) }
    }
}

impl<const MAX: usize> LineBuffer<MAX> {
    /// A buffer for a stream that may be joined in the middle of a line.
    pub(super) const fn joining() -> Self {
        Self { bytes: [0; MAX], used: 0, overlong: false, first: true }
    }

    /// Takes bytes and hands on each line that they end.
    pub(super) fn push(&mut self, mut bytes: &[u8], mut on_line: impl FnMut(Line<'_>)) {
        while let Some(end) = bytes.iter().position(|&byte| byte == b'\n') {
            self.keep(&bytes[..end]);
            bytes = &bytes[end + 1..];
            self.end_line(&mut on_line);
        }
        self.keep(bytes);
    }

    /// Hands on the line that has no ending.
    pub(super) fn finish(&mut self, mut on_line: impl FnMut(Line<'_>)) {
        self.end_line(&mut on_line);
    }

    fn keep(&mut self, bytes: &[u8]) {
        let room = &mut self.bytes[self.used..];
        let kept = bytes.len().min(room.len());
        room[..kept].copy_from_slice(&bytes[..kept]);
        self.used += kept;
        self.overlong |= kept < bytes.len();
    }

    fn end_line(&mut self, on_line: &mut impl FnMut(Line<'_>)) {
        let overlong = std::mem::take(&mut self.overlong);
        let bytes = trimmed(&self.bytes[..std::mem::take(&mut self.used)]);
        if !bytes.is_empty() || overlong {
            on_line(Line { bytes, overlong, first: std::mem::take(&mut self.first) });
        }
    }
}

/// `bytes` without blanks and control characters at its ends.
pub(super) fn trimmed(bytes: &[u8]) -> &[u8] {
    let is_ink = |byte: &u8| *byte > b' ' && *byte != 0x7F;
    let start = bytes.iter().position(is_ink).unwrap_or(bytes.len());
    let end = bytes.iter().rposition(is_ink).map_or(start, |last| last + 1);
    &bytes[start..end]
}

/// A finite number with a decimal point.
pub(super) fn number(text: &[u8]) -> Result<f64, WireFault> {
    let text = std::str::from_utf8(trimmed(text)).map_err(|_| WireFault::BadNumber)?;
    let number: f64 = text.parse().map_err(|_| WireFault::BadNumber)?;
    if number.is_finite() { Ok(number) } else { Err(WireFault::NotFinite) }
}

/// A whole number, not negative.
pub(super) fn whole(text: &[u8]) -> Result<u64, WireFault> {
    let text = std::str::from_utf8(trimmed(text)).map_err(|_| WireFault::BadNumber)?;
    text.parse().map_err(|_| WireFault::BadNumber)
}

/// A time in units of `ns_per_unit`; whole units are read exactly.
pub(super) fn time(text: &[u8], ns_per_unit: u32) -> Result<TimeNs, WireFault> {
    match whole(text).ok().and_then(|units| i64::try_from(units).ok()) {
        Some(units) => Ok(TimeNs(units.saturating_mul(ns_per_unit.into()))),
        // The cast saturates.
        None => number(text).map(|units| TimeNs((units * f64::from(ns_per_unit)).round() as i64)),
    }
}

/// A size as a figure that a sample can hold.
pub(super) fn size(figure: f64) -> Result<f32, WireFault> {
    let figure = figure as f32;
    if figure.is_finite() { Ok(figure) } else { Err(WireFault::NotFinite) }
}

/// Diameter of the disc of this area.
pub(super) fn disc_diameter(area: f64) -> f64 {
    2.0 * (area / std::f64::consts::PI).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_read_or_told_apart() {
        assert_eq!(number(b" 3.5 "), Ok(3.5));
        assert_eq!(number(b"1e+06"), Ok(1e6));
        assert_eq!(number(b""), Err(WireFault::BadNumber));
        assert_eq!(number(b"3,5"), Err(WireFault::BadNumber));
        assert_eq!(number(b"\xFF"), Err(WireFault::BadNumber));
        assert_eq!(number(b"nan"), Err(WireFault::NotFinite));
        assert_eq!(size(1e300), Err(WireFault::NotFinite));
        assert_eq!(whole(b"18446744073709551615"), Ok(u64::MAX));
        assert_eq!(whole(b"-1"), Err(WireFault::BadNumber));
    }

    #[test]
    fn times_are_exact_where_they_are_whole() {
        assert_eq!(time(b"1700000000123", 1_000_000), Ok(TimeNs(1_700_000_000_123_000_000)));
        assert_eq!(time(b"4.99716", 1_000_000_000), Ok(TimeNs(4_997_160_000)));
        assert_eq!(time(b"-0.5", 1000), Ok(TimeNs(-500)));
        assert_eq!(time(b"99999999999999999999", 1_000_000), Ok(TimeNs(i64::MAX)));
        assert_eq!(time(b"soon", 1), Err(WireFault::BadNumber));
    }

    #[test]
    fn a_disc_has_the_area_that_was_given() {
        assert!((disc_diameter(std::f64::consts::PI * 4.0) - 4.0).abs() < 1e-12);
    }
}
