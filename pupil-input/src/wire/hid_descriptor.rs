//! HID report descriptors: which bits of which report mean what.
//!
//! A tracker may move its fields from one firmware to the next, but its descriptor says where they are: each field of
//! an input report has a usage (a page and a number; vendors' own pages begin at 0xFF00), and this finds it by that.
//! The grammar is that of the *Device Class Definition for Human Interface Devices* 1.11, section 6.2.2.
//!
//! A descriptor comes from a device, so nothing in it is believed: any bytes give fields or an error, and its counts
//! make no more than [`MAX_FIELDS`] of them.

use std::fmt;
use std::str::FromStr;

use crate::usb_ids::hexadecimal_pair;

/// Bytes of the longest descriptor: Linux takes no longer one.
pub const MAX_DESCRIPTOR_BYTES: usize = 4096;
/// Input fields of one descriptor at most.
pub const MAX_FIELDS: usize = 12_288;
/// Bits of the longest report, 16 KiB as in Linux.
const MAX_REPORT_BITS: u32 = 16_384 * 8;
/// Bits of the widest field that can be read.
const MAX_FIELD_BITS: u32 = 64;

/// The report descriptor of holod's own HID format, for microcontrollers (profile `holod-hid`): report 1 holds the
/// device's clock in microseconds, a running number, and for the left and then the right eye the diameter in
/// micrometres, the confidence in 255ths and flags.
pub const HOLOD_HID_DESCRIPTOR: &[u8] = &[
    0x06, 0x00, 0xFF, // usage page: vendor
    0x09, 0x01, // usage: eye tracker
    0xA1, 0x01, // collection: application
    0x85, 0x01, //   report id 1
    0x09, 0x20, //   usage: device time
    0x15, 0x00, 0x27, 0xFF, 0xFF, 0xFF, 0xFF, //   0 to 2^32 - 1
    0x66, 0x01, 0x10, 0x55, 0x0A, //   seconds, 10^-6
    0x75, 0x20, 0x95, 0x01, 0x81, 0x02, //   one variable of 32 bits
    0x09, 0x21, //   usage: running number
    0x27, 0xFF, 0xFF, 0x00, 0x00, //   0 to 65535
    0x65, 0x00, 0x55, 0x00, //   no unit
    0x75, 0x10, 0x81, 0x02, //   one variable of 16 bits
    0x09, 0x10, 0xA1, 0x02, //   usage: left eye; collection: logical
    0x09, 0x30, //     usage: pupil diameter
    0x65, 0x11, 0x55, 0x0C, //     centimetres, 10^-4
    0x81, 0x02, //     one variable of 16 bits
    0x09, 0x31, //     usage: confidence
    0x26, 0xFF, 0x00, 0x45, 0x64, //     0 to 255 stand for 0 to 100
    0x65, 0x00, 0x55, 0x0E, //     no unit, 10^-2
    0x75, 0x08, 0x81, 0x02, //     one variable of 8 bits
    0x09, 0x32, //     usage: flags
    0x45, 0x00, 0x55, 0x00, //     as they are
    0x81, 0x02, //     one variable of 8 bits
    0xC0, //   end
    0x09, 0x11, 0xA1, 0x02, //   usage: right eye; collection: logical
    0x09, 0x30, //     usage: pupil diameter
    0x27, 0xFF, 0xFF, 0x00, 0x00, //     0 to 65535
    0x65, 0x11, 0x55, 0x0C, //     centimetres, 10^-4
    0x75, 0x10, 0x81, 0x02, //     one variable of 16 bits
    0x09, 0x31, //     usage: confidence
    0x26, 0xFF, 0x00, 0x45, 0x64, //     0 to 255 stand for 0 to 100
    0x65, 0x00, 0x55, 0x0E, //     no unit, 10^-2
    0x75, 0x08, 0x81, 0x02, //     one variable of 8 bits
    0x09, 0x32, //     usage: flags
    0x45, 0x00, 0x55, 0x00, //     as they are
    0x81, 0x02, //     one variable of 8 bits
    0xC0, //   end
    0xC0, // end
];

/// What a field or a collection of fields is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Usage {
    /// The page that gives the number its meaning.
    pub page: u16,
    /// The number on that page.
    pub id: u16,
}

impl FromStr for Usage {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (page, id) = hexadecimal_pair(text)
            .ok_or_else(|| format!("`{text}` is no page and number in hexadecimals, such as ff00:0030"))?;
        Ok(Self { page, id })
    }
}

impl fmt::Display for Usage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:04x}:{:04x}", self.page, self.id)
    }
}

/// One figure of an input report, as the descriptor describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReportField {
    /// What it is for, by page and number.
    pub usage: Usage,
    /// The usage of the innermost collection around it that has one.
    pub collection: Option<Usage>,
    /// The report that it is in; None for a device whose reports have no ids.
    pub report_id: Option<u8>,
    /// Its lowest bit, counted from the lowest bit of the report's first byte, which is the report id where there are
    /// ids.
    pub bit_offset: u32,
    /// Its width, 1 to 64 bits, little-endian.
    pub bits: u32,
    /// Whether it is in two's complement: its logical minimum is negative.
    pub signed: bool,
    /// Least figure that means anything.
    pub logical_minimum: i64,
    /// Greatest figure that means anything.
    pub logical_maximum: i64,
    /// What `logical_minimum` stands for, in the unit.
    pub physical_minimum: i64,
    /// What `logical_maximum` stands for, in the unit.
    pub physical_maximum: i64,
    /// Power of ten by which physical figures are to be multiplied.
    pub unit_exponent: i32,
    /// The unit's code, section 6.2.2.7; 0 where there is none.
    pub unit: u32,
    /// Whether a figure outside the logical range says that there is no figure now.
    pub nullable: bool,
}

/// A figure of a report to one in a unit: `factor * raw + offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Linear {
    /// Units for one raw step.
    pub factor: f64,
    /// Units at raw zero.
    pub offset: f64,
}

/// What the unit's code stands for, as far as trackers need it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FieldUnit {
    /// None is given: a ratio, a count, or the vendor's own.
    None,
    /// A length; [`ReportField::linear`] is in millimetres.
    Length,
    /// A time; [`ReportField::linear`] is in seconds.
    Time,
    /// Something else, in the unit of its code.
    Other,
}

impl ReportField {
    /// The kind of its unit.
    pub const fn kind(&self) -> FieldUnit {
        match self.unit {
            0 => FieldUnit::None,
            0x11 | 0x13 => FieldUnit::Length,
            0x1001..=0x1004 => FieldUnit::Time,
            _ => FieldUnit::Other,
        }
    }

    /// Raw figures to physical ones, in the unit that [`Self::kind`] names; None where the descriptor's ranges say
    /// nothing.
    ///
    /// Section 6.2.2.7: physical = (raw - logical minimum) * (physical range / logical range) + physical minimum, times
    /// ten to the unit exponent; a physical range that is not given, or 0 to 0, is the logical one.
    pub fn linear(&self) -> Option<Linear> {
        let millimetres_or_seconds = match self.unit {
            0x11 => 10.0,
            0x13 => 25.4,
            _ => 1.0,
        };
        let unit = millimetres_or_seconds * 10_f64.powi(self.unit_exponent);
        let logical = self.logical_maximum - self.logical_minimum;
        let physical = self.physical_maximum - self.physical_minimum;
        let ratio = physical as f64 / logical as f64;
        let offset = (self.physical_minimum as f64 - ratio * self.logical_minimum as f64) * unit;
        let factor = ratio * unit;
        (factor.is_finite() && factor != 0.0 && offset.is_finite()).then_some(Linear { factor, offset })
    }
}

/// Why there are no fields to be had from a descriptor.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum DescriptorError {
    /// There are no bytes.
    #[error("the report descriptor is empty; the device is no HID tracker")]
    Empty,
    /// There are more bytes than a descriptor may have.
    #[error("the report descriptor has {0} bytes, at most {MAX_DESCRIPTOR_BYTES} are allowed")]
    TooLong(usize),
    /// It breaks off, or its parts do not fit together.
    #[error("the report descriptor is faulty at byte {at}: {problem}")]
    Malformed {
        /// Offset of the item.
        at: usize,
        problem: &'static str,
    },
    /// It describes more fields than any tracker has.
    #[error("the report descriptor has more than {MAX_FIELDS} input fields, too many for a tracker")]
    TooManyFields,
    /// No input field has the usage.
    #[error("the device has no input field of usage {wanted}; it has {found}; correct the profile's usages")]
    NoUsage {
        /// What the profile names.
        wanted: String,
        /// The usages there are, in words.
        found: String,
    },
    /// Several have it, and the profile does not say which.
    #[error("the device has {count} input fields of usage {wanted}, in {found}; name the collection in the profile")]
    Ambiguous {
        count: usize,
        /// What the profile names.
        wanted: String,
        /// Where they are, in words.
        found: String,
    },
    /// Two fields of a sample are in different reports.
    #[error(
        "the fields of usages {one} and {other} are in different reports; a sample must be in one: correct the profile's usages"
    )]
    OtherReport {
        /// The usage of the sample's first field.
        one: Usage,
        /// The field in another report.
        other: Usage,
    },
    /// Its bits are no number that can be read.
    #[error(
        "the field of usage {usage}, {bits} bits from bit {bit_offset}, spans more than 8 bytes, or is signed and ends within a byte"
    )]
    Unreadable {
        usage: Usage,
        /// The width of the field.
        bits: u32,
        bit_offset: u32,
    },
    /// It has a unit, and no range to convert by.
    #[error(
        "the field of usage {usage} has a unit and no range; name its offset, type and scale in a profile of kind `report`"
    )]
    NoRange { usage: Usage },
}

/// Global items: they hold until they are set again.
#[derive(Clone, Copy, Debug, Default)]
struct Globals {
    usage_page: u16,
    logical_minimum: i64,
    logical_maximum: Item,
    physical_minimum: i64,
    physical_maximum: Item,
    unit_exponent: i32,
    unit: u32,
    report_size: u32,
    report_count: u32,
    report_id: Option<u8>,
}

/// The data of an item, with its size, on which its sign depends.
#[derive(Clone, Copy, Debug, Default)]
struct Item {
    value: u32,
    bytes: usize,
}

impl Item {
    const fn signed(self) -> i64 {
        match self.bytes {
            0 | 1 => self.value as u8 as i8 as i64,
            2 => self.value as u16 as i16 as i64,
            _ => self.value as i32 as i64,
        }
    }

    /// A maximum is signed where its minimum is negative.
    const fn maximum(self, minimum: i64) -> i64 {
        if minimum < 0 { self.signed() } else { self.value as i64 }
    }

    /// Four bytes hold page and number; fewer hold a number on the page that holds when the list is used.
    const fn usage(self) -> LocalUsage {
        let page = if self.bytes == 4 { Some((self.value >> 16) as u16) } else { None };
        LocalUsage { page, id: self.value as u16 }
    }
}

#[derive(Clone, Copy, Debug)]
struct LocalUsage {
    page: Option<u16>,
    id: u16,
}

impl LocalUsage {
    fn on(self, page: u16) -> Usage {
        Usage { page: self.page.unwrap_or(page), id: self.id }
    }
}

/// Local items: they hold until the next main item.
#[derive(Debug, Default)]
struct Locals {
    /// First and last number of each entry, in order.
    usages: Vec<(LocalUsage, u16)>,
    minimum: Option<LocalUsage>,
    /// Of the usages between two delimiters only the first, which is the preferred one, counts.
    delimited: bool,
    delimited_taken: bool,
}

impl Locals {
    fn add(&mut self, usage: LocalUsage, last: u16) {
        if !(self.delimited && std::mem::replace(&mut self.delimited_taken, true)) {
            self.usages.push((usage, last));
        }
    }

    /// The usage of field `index`; the last one stands for all that follow.
    fn usage(&self, index: u32, page: u16) -> Option<Usage> {
        let mut left = index;
        for &(usage, last) in &self.usages {
            let count = u32::from(last.saturating_sub(usage.id)) + 1;
            if left < count {
                return Some(LocalUsage { id: usage.id + left as u16, ..usage }.on(page));
            }
            left -= count;
        }
        self.usages.last().map(|&(usage, last)| LocalUsage { id: last.max(usage.id), ..usage }.on(page))
    }
}

/// Every input field of a descriptor that is a figure of its own (a *variable*), in the descriptor's order. Constants,
/// which are padding, arrays, such as a keyboard's keys, and fields without a usage or wider than 64 bits are passed
/// over.
///
/// # Errors
/// The bytes are no descriptor, or describe more than [`MAX_FIELDS`] fields.
pub fn input_fields(descriptor: &[u8]) -> Result<Vec<ReportField>, DescriptorError> {
    match descriptor.len() {
        0 => return Err(DescriptorError::Empty),
        length if length > MAX_DESCRIPTOR_BYTES => return Err(DescriptorError::TooLong(length)),
        _ => {}
    }
    let mut parser = Parser::default();
    let mut at = 0;
    while at < descriptor.len() {
        at = parser.take(descriptor, at)?;
    }
    if parser.collections.is_empty() {
        Ok(parser.fields)
    } else {
        Err(DescriptorError::Malformed { at, problem: "a collection is not closed" })
    }
}

#[derive(Debug, Default)]
struct Parser {
    globals: Globals,
    pushed: Vec<Globals>,
    locals: Locals,
    collections: Vec<Option<Usage>>,
    /// Bits of each input report so far, by id.
    report_bits: Vec<(Option<u8>, u32)>,
    fields: Vec<ReportField>,
}

impl Parser {
    /// Takes the item at `at`; gives where the next one begins.
    fn take(&mut self, descriptor: &[u8], at: usize) -> Result<usize, DescriptorError> {
        let faulty = |problem| DescriptorError::Malformed { at, problem };
        let cut = faulty("an item is cut off");
        let prefix = descriptor[at];
        if prefix == 0xFE {
            let length = descriptor.get(at + 1).ok_or(cut.clone())?;
            let end = at + 3 + usize::from(*length);
            return if end <= descriptor.len() { Ok(end) } else { Err(cut) };
        }
        let bytes = [0, 1, 2, 4][usize::from(prefix & 3)];
        let end = at + 1 + bytes;
        let data = descriptor.get(at + 1..end).ok_or(cut)?;
        let value = data.iter().rev().fold(0, |value, &byte| value << 8 | u32::from(byte));
        let item = Item { value, bytes };
        let (kind, tag) = (prefix >> 2 & 3, prefix >> 4);
        match kind {
            0 => self.main(tag, item).map_err(|fault| match fault {
                Fault::Problem(problem) => faulty(problem),
                Fault::TooManyFields => DescriptorError::TooManyFields,
            })?,
            1 => self.global(tag, item).map_err(faulty)?,
            2 => self.local(tag, item),
            _ => {}
        }
        Ok(end)
    }

    fn main(&mut self, tag: u8, item: Item) -> Result<(), Fault> {
        let locals = std::mem::take(&mut self.locals);
        match tag {
            0x8 => self.input(item, &locals),
            0xA => {
                self.collections.push(locals.usage(0, self.globals.usage_page));
                Ok(())
            }
            0xC => self.collections.pop().map(drop).ok_or(Fault::Problem("a collection ends that did not begin")),
            _ => Ok(()),
        }
    }

    fn input(&mut self, flags: Item, locals: &Locals) -> Result<(), Fault> {
        let globals = &self.globals;
        let (size, count) = (globals.report_size, globals.report_count);
        let place = match self.report_bits.iter().position(|(id, _)| *id == globals.report_id) {
            Some(place) => place,
            None => {
                self.report_bits.push((globals.report_id, if globals.report_id.is_some() { 8 } else { 0 }));
                self.report_bits.len() - 1
            }
        };
        let begin = self.report_bits[place].1;
        let end =
            size.checked_mul(count).and_then(|bits| bits.checked_add(begin)).filter(|end| *end <= MAX_REPORT_BITS);
        self.report_bits[place].1 = end.ok_or(Fault::Problem("a report is longer than 16 KiB"))?;
        let (constant, variable) = (flags.value & 1 != 0, flags.value & 2 != 0);
        if constant || !variable || !(1..=MAX_FIELD_BITS).contains(&size) || locals.usages.is_empty() {
            return Ok(());
        }
        if self.fields.len() + count as usize > MAX_FIELDS {
            return Err(Fault::TooManyFields);
        }
        let logical_minimum = globals.logical_minimum;
        let logical_maximum = globals.logical_maximum.maximum(logical_minimum);
        let physical_minimum = globals.physical_minimum;
        let physical_maximum = globals.physical_maximum.maximum(physical_minimum);
        let (physical_minimum, physical_maximum) = match (physical_minimum, physical_maximum) {
            (0, 0) => (logical_minimum, logical_maximum),
            given => given,
        };
        let collection = self.collections.iter().rev().find_map(|usage| *usage);
        let fields = (0..count).filter_map(|index| {
            Some(ReportField {
                usage: locals.usage(index, globals.usage_page)?,
                collection,
                report_id: globals.report_id,
                bit_offset: begin + index * size,
                bits: size,
                signed: logical_minimum < 0,
                logical_minimum,
                logical_maximum,
                physical_minimum,
                physical_maximum,
                unit_exponent: globals.unit_exponent,
                unit: globals.unit,
                nullable: flags.value & 0x40 != 0,
            })
        });
        self.fields.extend(fields);
        Ok(())
    }

    fn global(&mut self, tag: u8, item: Item) -> Result<(), &'static str> {
        let globals = &mut self.globals;
        match tag {
            0x0 => globals.usage_page = item.value as u16,
            0x1 => globals.logical_minimum = item.signed(),
            0x2 => globals.logical_maximum = item,
            0x3 => globals.physical_minimum = item.signed(),
            0x4 => globals.physical_maximum = item,
            // A nibble in two's complement by the letter; devices also send a whole number.
            0x5 => {
                globals.unit_exponent = match item.value {
                    nibble @ 0..=7 => nibble as i32,
                    nibble @ 8..=15 => nibble as i32 - 16,
                    _ => item.signed() as i32,
                }
            }
            0x6 => globals.unit = item.value,
            0x7 => globals.report_size = item.value,
            0x8 => match u8::try_from(item.value) {
                Ok(id) if id > 0 => globals.report_id = Some(id),
                _ => return Err("a report id is not 1 to 255"),
            },
            0x9 => globals.report_count = item.value,
            0xA => self.pushed.push(*globals),
            0xB => *globals = self.pushed.pop().ok_or("globals are popped that were not pushed")?,
            _ => {}
        }
        Ok(())
    }

    fn local(&mut self, tag: u8, item: Item) {
        let locals = &mut self.locals;
        match tag {
            0x0 => locals.add(item.usage(), item.value as u16),
            0x1 => locals.minimum = Some(item.usage()),
            0x2 => {
                if let Some(minimum) = locals.minimum.take() {
                    locals.add(minimum, item.value as u16);
                }
            }
            0xA => {
                locals.delimited = item.value == 1;
                locals.delimited_taken = false;
            }
            _ => {}
        }
    }
}

enum Fault {
    Problem(&'static str),
    TooManyFields,
}

/// The field of `usage`, within a collection of that usage where one is named.
///
/// # Errors
/// None has it, or several have.
pub fn find_field(
    fields: &[ReportField],
    usage: Usage,
    collection: Option<Usage>,
) -> Result<&ReportField, DescriptorError> {
    let fits = |field: &&ReportField| field.usage == usage && (collection.is_none() || field.collection == collection);
    let fitting: Vec<_> = fields.iter().filter(fits).collect();
    let wanted = || match collection {
        Some(collection) => format!("{usage} in a collection {collection}"),
        None => usage.to_string(),
    };
    match fitting[..] {
        [only] => Ok(only),
        [] => Err(DescriptorError::NoUsage { wanted: wanted(), found: usages_in_words(fields) }),
        _ => {
            let count = fitting.len();
            let found = distinct(fitting.iter().map(|field| match field.collection {
                Some(collection) => format!("collection {collection}"),
                None => "no collection".into(),
            }));
            Err(DescriptorError::Ambiguous { count, wanted: wanted(), found })
        }
    }
}

fn usages_in_words(fields: &[ReportField]) -> String {
    if fields.is_empty() { "none".into() } else { distinct(fields.iter().map(|field| field.usage.to_string())) }
}

/// The names in order, each once, at most sixteen.
fn distinct(names: impl Iterator<Item = String>) -> String {
    let mut known: Vec<String> = Vec::new();
    for name in names {
        if known.len() == 16 {
            known.push("and more".into());
            break;
        }
        if !known.contains(&name) {
            known.push(name);
        }
    }
    known.join(", ")
}

#[cfg(test)]
mod tests {
    use hidreport::{Field, Report as _, ReportDescriptor};
    use proptest::prelude::*;

    use super::*;

    const fn vendor(id: u16) -> Usage {
        Usage { page: 0xFF00, id }
    }

    #[test]
    fn the_fields_of_the_shipped_descriptor_are_where_the_profile_says() {
        let fields = input_fields(HOLOD_HID_DESCRIPTOR).expect("reads");
        let (left, right) = (Some(vendor(0x10)), Some(vendor(0x11)));
        let found: Vec<_> =
            fields.iter().map(|field| (field.usage.id, field.collection, field.bit_offset / 8, field.bits)).collect();
        let top = Some(vendor(1));
        let expected = [
            (0x20, top, 1, 32),
            (0x21, top, 5, 16),
            (0x30, left, 7, 16),
            (0x31, left, 9, 8),
            (0x32, left, 10, 8),
            (0x30, right, 11, 16),
            (0x31, right, 13, 8),
            (0x32, right, 14, 8),
        ];
        assert_eq!(found, expected);
        assert!(fields.iter().all(|field| field.report_id == Some(1) && !field.signed && !field.nullable));

        let linear = |id, collection| {
            let field = find_field(&fields, vendor(id), collection).expect("is there");
            (field.kind(), field.linear().expect("has a range"))
        };
        let near = |(kind, linear): (FieldUnit, Linear), expected, factor: f64| {
            assert_eq!(kind, expected);
            assert!((linear.factor / factor - 1.0).abs() < 1e-12 && linear.offset == 0.0, "{linear:?}");
        };
        near(linear(0x20, None), FieldUnit::Time, 1e-6);
        near(linear(0x30, left), FieldUnit::Length, 1e-3);
        near(linear(0x31, right), FieldUnit::None, 1.0 / 255.0);
        near(linear(0x32, right), FieldUnit::None, 1.0);
    }

    #[test]
    fn a_usage_that_is_not_there_or_there_twice_is_told() {
        let fields = input_fields(HOLOD_HID_DESCRIPTOR).expect("reads");
        let told = |usage, collection| find_field(&fields, usage, collection).expect_err("is refused").to_string();
        let message = told(vendor(0x40), None);
        assert!(
            message.contains("no input field of usage ff00:0040; it has ff00:0020, ff00:0021, ff00:0030"),
            "{message}"
        );
        let message = told(vendor(0x30), Some(vendor(0x12)));
        assert!(message.contains("usage ff00:0030 in a collection ff00:0012"), "{message}");
        let message = told(vendor(0x30), None);
        assert!(message.contains("2 input fields of usage ff00:0030, in collection ff00:0010, collection ff00:0011"));
    }

    /// Signs, offsets, inches, padding, arrays, ranges of usages, push and pop, delimiters, four-byte usages, no ids.
    #[test]
    fn each_part_of_the_grammar_is_understood() {
        #[rustfmt::skip]
        let fields = input_fields(&[
            0x05, 0x12, 0x09, 0x01, 0xA1, 0x01,
            0xA4,                                                       // push
            0x75, 0x03, 0x95, 0x01, 0x81, 0x03,                         // 3 bits of padding
            0x16, 0x00, 0xFC, 0x26, 0xFF, 0x03,                         // -1024 to 1023
            0x36, 0x00, 0x80, 0x46, 0xFF, 0x7F, 0x65, 0x13, 0x55, 0xFD, // -32768 to 32767, 10^-3 inches
            0x19, 0x20, 0x29, 0x21, 0x75, 0x0B, 0x95, 0x03, 0x81, 0x42, // usages 0x20, 0x21, 0x21; nullable
            0xB4,                                                       // pop
            0x09, 0x05, 0x75, 0x08, 0x95, 0x02, 0x81, 0x00,             // an array of two bytes
            0xFE, 0x02, 0x55, 0xAA, 0xBB,                               // a long item
            0xA9, 0x01, 0x09, 0x40, 0x09, 0x41, 0xA9, 0x00,             // 0x40, or else 0x41
            0x0B, 0x31, 0x00, 0x00, 0xFF,                               // 0xFF00:0x0031
            0x25, 0x7F, 0x81, 0x02,                                     // two variables of a byte
            0x95, 0x01, 0x81, 0x02,                                     // a byte without a usage
            0x09, 0x50, 0x75, 0x48, 0x81, 0x02,                         // 72 bits, too wide
            0x09, 0x51, 0x75, 0x08, 0x91, 0x02, 0x09, 0x51, 0xB1, 0x02, // output and feature reports have places of their own
            0x09, 0x52, 0x81, 0x02,
            0xC0,
        ])
        .expect("reads");
        let found: Vec<_> = fields
            .iter()
            .map(|field| (field.usage.to_string(), field.bit_offset, field.bits, field.nullable))
            .collect();
        let expected = [
            ("0012:0020", 3, 11, true),
            ("0012:0021", 14, 11, true),
            ("0012:0021", 25, 11, true),
            ("0012:0040", 52, 8, false),
            ("ff00:0031", 60, 8, false),
            ("0012:0052", 148, 8, false),
        ];
        assert_eq!(found, expected.map(|(usage, at, bits, nullable)| (usage.to_owned(), at, bits, nullable)));
        let field = &fields[0];
        assert_eq!((field.signed, field.logical_minimum, field.logical_maximum), (true, -1024, 1023));
        assert_eq!((field.physical_minimum, field.physical_maximum), (-32768, 32767));
        assert_eq!((field.kind(), field.unit_exponent, field.report_id), (FieldUnit::Length, -3, None));
        let linear = field.linear().expect("has a range");
        let mm = |raw: f64| linear.factor * raw + linear.offset;
        assert!((mm(-1024.0) + 32.768 * 25.4).abs() < 1e-9 && (mm(1023.0) - 32.767 * 25.4).abs() < 1e-9);
        assert_eq!((fields[3].signed, fields[3].logical_maximum, fields[3].physical_maximum), (false, 127, 127));
        assert_eq!(fields[3].kind(), FieldUnit::None);
    }

    #[test]
    fn each_fault_is_told_with_its_place() {
        let cases: [(&[u8], &str); 9] = [
            (&[], "is empty"),
            (&[0; 4097], "has 4097 bytes"),
            (&[0x05, 0x12, 0x26, 0xFF], "at byte 2: an item is cut off"),
            (&[0xFE, 0x09, 0x00], "at byte 0: an item is cut off"),
            (&[0xA1, 0x01], "a collection is not closed"),
            (&[0xC0], "at byte 0: a collection ends that did not begin"),
            (&[0xB4], "popped that were not pushed"),
            (&[0x85, 0x00], "a report id is not 1 to 255"),
            (&[0x77, 0xFF, 0xFF, 0xFF, 0xFF, 0x97, 0xFF, 0xFF, 0xFF, 0xFF, 0x81, 0x02], "longer than 16 KiB"),
        ];
        for (descriptor, told) in cases {
            let error = input_fields(descriptor).expect_err(told).to_string();
            assert!(error.contains(told), "{error}");
        }
        let many = [0x09, 0x01, 0x75, 0x01, 0x97, 0x01, 0x30, 0x00, 0x00, 0x81, 0x02];
        assert_eq!(input_fields(&many), Err(DescriptorError::TooManyFields));
        // No range, or none that is finite: no conversion, and no panic.
        let fields = input_fields(&[0x09, 0x01, 0x75, 0x08, 0x95, 0x01, 0x81, 0x02]).expect("reads");
        assert_eq!(fields[0].linear(), None);
        let wild =
            ReportField { logical_maximum: 255, physical_maximum: 255, unit_exponent: i32::MAX, ..fields[0].clone() };
        assert_eq!(wild.linear(), None);
    }

    /// A field as both parsers see it: usage, report, first bit, width, signed, logical range.
    type Seen = ((u16, u16), Option<u8>, usize, usize, bool, (i64, i64));

    fn seen(descriptor: &[u8]) -> Vec<Seen> {
        let mut seen: Vec<_> = input_fields(descriptor)
            .expect("reads")
            .into_iter()
            .map(|field| {
                (
                    (field.usage.page, field.usage.id),
                    field.report_id,
                    field.bit_offset as usize,
                    field.bits as usize,
                    field.signed,
                    (field.logical_minimum, field.logical_maximum),
                )
            })
            .collect();
        seen.sort_unstable();
        seen
    }

    /// The same by another's parser, which trusts its input.
    fn judged(descriptor: &[u8]) -> Vec<Seen> {
        let parsed = ReportDescriptor::try_from(descriptor).expect("reads");
        let mut judged = Vec::new();
        for report in parsed.input_reports() {
            for field in report.fields() {
                let Field::Variable(field) = field else { continue };
                let minimum = i32::from(field.logical_minimum);
                let maximum = i32::from(field.logical_maximum);
                judged.push((
                    (u16::from(field.usage.usage_page), u16::from(field.usage.usage_id)),
                    report.report_id().as_ref().map(|id| u8::from(*id)),
                    field.bits.start,
                    field.bits.len(),
                    minimum < 0,
                    (minimum.into(), if minimum < 0 { maximum.into() } else { i64::from(maximum as u32) }),
                ));
            }
        }
        judged.sort_unstable();
        judged
    }

    /// One main item with what it needs, or a change of the globals around it. Unsigned maxima keep their top bit
    /// clear: the other parser takes it for a sign.
    fn any_part() -> impl Strategy<Value = Vec<u8>> {
        let usages = prop_oneof![
            prop::collection::vec((any::<u8>(), any::<bool>()), 1..4).prop_map(|usages| {
                let short = |id: u8| vec![0x09, id];
                let long = |id: u8| vec![0x0B, id, 0x01, 0x07, 0xFF];
                usages.into_iter().flat_map(|(id, with_page)| if with_page { long(id) } else { short(id) }).collect()
            }),
            (0..200_u8, 0..9_u8).prop_map(|(first, more)| vec![0x19, first, 0x29, first + more]),
        ];
        let field = (usages, 1..33_u8, 1..6_u8, 0..8_u8, any::<[u8; 2]>(), any::<bool>()).prop_map(
            |(usages, size, count, flags, limits, signed)| {
                let [low, high] = limits;
                let mut part =
                    if signed { vec![0x15, low | 0x80, 0x25, high] } else { vec![0x15, 0, 0x26, low, high & 0x7F] };
                part.extend(usages);
                part.extend([0x75, size, 0x95, count, 0x81, flags]);
                part
            },
        );
        prop_oneof![
            6 => field,
            1 => any::<u16>().prop_map(|page| vec![0x06, page as u8, (page >> 8) as u8]),
            1 => (1..5_u8).prop_map(|id| vec![0x85, id]),
        ]
    }

    fn any_descriptor() -> impl Strategy<Value = Vec<u8>> {
        prop::collection::vec((any_part(), any::<bool>()), 1..20).prop_map(|parts| {
            let mut descriptor = vec![0x05, 0x12, 0x09, 0x01, 0xA1, 0x01, 0x85, 0x07];
            for (part, pushed) in parts {
                let around: (&[u8], &[u8]) = if pushed { (&[0xA4], &[0xB4]) } else { (&[], &[]) };
                descriptor.extend_from_slice(around.0);
                descriptor.extend(part);
                descriptor.extend_from_slice(around.1);
            }
            descriptor.push(0xC0);
            descriptor
        })
    }

    #[test]
    fn another_parser_sees_a_moved_field() {
        assert_eq!(seen(HOLOD_HID_DESCRIPTOR), judged(HOLOD_HID_DESCRIPTOR));
        let mut moved = HOLOD_HID_DESCRIPTOR.to_vec();
        let at = moved.windows(2).position(|item| item == [0x75, 0x20]).expect("is there");
        moved[at + 1] = 0x18;
        assert_ne!(seen(HOLOD_HID_DESCRIPTOR), judged(&moved));
    }

    proptest! {
        #[test]
        fn another_parser_sees_the_same_fields(descriptor in any_descriptor()) {
            prop_assert_eq!(seen(&descriptor), judged(&descriptor));
        }

        #[test]
        fn any_bytes_give_fields_that_can_be_read_or_an_error(
            begin in prop::sample::select(vec![Vec::new(), HOLOD_HID_DESCRIPTOR[..40].to_vec()]),
            bytes in prop::collection::vec(prop_oneof![any::<u8>(), prop::sample::select(vec![0x09, 0x75, 0x95, 0x81, 0x02, 0xC0])], 0..300),
        ) {
            let Ok(fields) = input_fields(&[begin, bytes].concat()) else { return Ok(()) };
            prop_assert!(fields.len() <= MAX_FIELDS);
            for field in fields {
                prop_assert!((1..=64).contains(&field.bits) && field.bit_offset + field.bits <= MAX_REPORT_BITS);
                prop_assert!(field.linear().is_none_or(|linear| linear.factor.is_finite() && linear.offset.is_finite()));
            }
        }

        #[test]
        fn a_descriptor_with_a_wrong_byte_is_read_or_refused(at in any::<prop::sample::Index>(), byte: u8) {
            let mut descriptor = HOLOD_HID_DESCRIPTOR.to_vec();
            let at = at.index(descriptor.len());
            descriptor[at] = byte;
            if let Ok(fields) = input_fields(&descriptor) {
                let _ = find_field(&fields, vendor(0x30), None);
            }
        }
    }
}
