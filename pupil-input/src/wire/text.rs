//! What the formats of text lines share: lines gathered in constant memory, and figures.

use holod_calibration::TimeNs;

use super::buffer::Beginning;
use super::{WireEvent, WireFault};

/// Lines, however their bytes are split.
#[derive(Clone, Debug)]
pub(super) struct LineBuffer {
    line: Beginning,
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

impl LineBuffer {
    /// A buffer for lines of at most `most_bytes`, of a stream that may be joined in the middle of one.
    pub(super) fn joining(most_bytes: usize) -> Self {
        Self { line: Beginning::new(most_bytes), first: true }
    }

    /// Takes bytes and hands on each line that they end.
    pub(super) fn push(&mut self, mut bytes: &[u8], mut on_line: impl FnMut(Line<'_>)) {
        while let Some(end) = bytes.iter().position(|&byte| byte == b'\n') {
            self.line.push(&bytes[..end]);
            bytes = &bytes[end + 1..];
            self.end_line(&mut on_line);
        }
        self.line.push(bytes);
    }

    /// Hands on the line that has no ending.
    pub(super) fn finish(&mut self, mut on_line: impl FnMut(Line<'_>)) {
        self.end_line(&mut on_line);
    }

    fn end_line(&mut self, on_line: &mut impl FnMut(Line<'_>)) {
        let (bytes, overlong) = (trimmed(self.line.bytes()), self.line.overlong);
        if !bytes.is_empty() || overlong {
            on_line(Line { bytes, overlong, first: std::mem::take(&mut self.first) });
        }
        self.line.clear();
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
    let text = trimmed(text);
    if let Some(number) = short_number(text) {
        return Ok(number);
    }
    let text = std::str::from_utf8(text).map_err(|_| WireFault::BadNumber)?;
    let number: f64 = text.parse().map_err(|_| WireFault::BadNumber)?;
    if number.is_finite() { Ok(number) } else { Err(WireFault::NotFinite) }
}

/// A number of at most 15 digits and no exponent, as most are. Its digits and the power of ten are exact, so that one
/// division rounds as it should (Clinger's fast path).
fn short_number(text: &[u8]) -> Option<f64> {
    const POWERS: [f64; 16] = [1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15];
    let (is_negative, text) = text.strip_prefix(b"-").map_or((false, text), |digits| (true, digits));
    if text.len() > 16 {
        return None;
    }
    let (mut digits, mut count, mut behind_point) = (0_u64, 0, None);
    for &byte in text {
        match byte {
            b'0'..=b'9' => digits = digits * 10 + u64::from(byte - b'0'),
            b'.' if behind_point.is_none() => {
                behind_point = Some(count);
                continue;
            }
            _ => return None,
        }
        count += 1;
    }
    let power = POWERS.get(count - behind_point.unwrap_or(count))?;
    let number = digits as f64 / power;
    (1..=15).contains(&count).then_some(if is_negative { -number } else { number })
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
    fn the_short_way_gives_the_same_numbers() {
        for text in
            ["0", "-0", "3.25", "41.2", "-1", ".5", "5.", "999999999999999", "0.00000000000001", "123456.789012345"]
        {
            assert_eq!(short_number(text.as_bytes()).map(f64::to_bits), text.parse().ok().map(f64::to_bits), "{text}");
        }
        for text in ["", "-", ".", "-.", "1e3", "1.2.3", "+1", "0.0000000000000001", "9999999999999999", "--1", "1-"] {
            assert_eq!(short_number(text.as_bytes()), None, "{text}");
        }
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
