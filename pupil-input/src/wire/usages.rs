//! HID reports whose fields are named by usage: the device's own descriptor says where they stand and what they
//! measure.

use super::field::{Field, Figure, Layout, NumberType, PupilAt, TimeAt, Validity};
use super::hid_descriptor::{DescriptorError, FieldUnit, ReportField, Usage, find_field, input_fields};
use super::report::ReportSettings;
use super::{Decoder, WireEvent, WireFault};

/// A field by what it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UsageAt {
    /// What it is for, by page and number.
    pub usage: Usage,
    /// What the innermost collection around it is; None where the usage alone tells the field.
    pub collection: Option<Usage>,
}

/// The fields of a tracker, by what they are.
///
/// Where the descriptor gives a unit, figures are in it: a length in millimetres, a time in nanoseconds, whatever the
/// profile says of the time's unit. The profile's scales and offsets are applied to what the descriptor makes of a
/// figure, its rules for validity to the raw one.
#[derive(Clone, Debug, PartialEq)]
pub struct UsageSettings {
    /// Which usages are time, eye and pupils.
    pub layout: Layout<UsageAt>,
}

impl UsageSettings {
    /// How reports of the device with this descriptor are read.
    ///
    /// # Errors
    /// The descriptor is faulty, or a field of the layout is not in it, is there twice, stands in another report than
    /// the rest, or has bits that cannot be read as one number.
    pub fn resolve(&self, descriptor: &[u8]) -> Result<ReportSettings, DescriptorError> {
        let fields = input_fields(descriptor)?;
        let mut resolver = Resolver { fields: &fields, report: None, least: 0 };
        let Layout { time, sequence, eye, pupils, size } = &self.layout;
        let layout = Layout {
            time: time.as_ref().map(|time| resolver.time(time)).transpose()?,
            sequence: match sequence {
                None => None,
                Some((at, wrap_bits)) => {
                    let (at, field) = resolver.place(at)?;
                    Some((at, wrap_bits.or_else(|| counter_bits(field))))
                }
            },
            eye: match eye {
                None => None,
                Some((at, eyes)) => Some((resolver.place(at)?.0, eyes.clone())),
            },
            pupils: pupils.iter().map(|pupil| resolver.pupil(pupil)).collect::<Result<_, _>>()?,
            size: *size,
        };
        let id = resolver.report.and_then(|(id, _)| id);
        Ok(ReportSettings { id, least: resolver.least, most: None, layout })
    }
}

struct Resolver<'a> {
    fields: &'a [ReportField],
    /// The report that the first field is in, with that field.
    report: Option<(Option<u8>, Usage)>,
    /// Bytes up to the end of the last field.
    least: usize,
}

impl<'a> Resolver<'a> {
    fn place(&mut self, at: &UsageAt) -> Result<(Field, &'a ReportField), DescriptorError> {
        let field = find_field(self.fields, at.usage, at.collection)?;
        let (report, first) = *self.report.get_or_insert((field.report_id, field.usage));
        if report != field.report_id {
            return Err(DescriptorError::OtherReport { one: first, other: field.usage });
        }
        let place = place(field).ok_or(DescriptorError::Unreadable {
            usage: field.usage,
            bits: field.bits,
            bit_offset: field.bit_offset,
        })?;
        self.least = self.least.max(place.at as usize + place.kind.bytes());
        Ok((place, field))
    }

    fn time(&mut self, time: &TimeAt<UsageAt>) -> Result<TimeAt<Field>, DescriptorError> {
        let (at, field) = self.place(&time.at)?;
        let ns_per_tick = match field.kind() {
            FieldUnit::Time => field.linear().ok_or(DescriptorError::NoRange { usage: field.usage })?.factor * 1e9,
            _ => time.ns_per_tick,
        };
        Ok(TimeAt { at, ns_per_tick, wrap_bits: time.wrap_bits.or_else(|| counter_bits(field)) })
    }

    fn figure(&mut self, figure: &Figure<UsageAt>) -> Result<(Figure<Field>, &'a ReportField), DescriptorError> {
        let (at, field) = self.place(&figure.at)?;
        let (factor, offset) = match field.linear() {
            Some(linear) => (linear.factor, linear.offset),
            None if field.kind() == FieldUnit::None => (1.0, 0.0),
            None => return Err(DescriptorError::NoRange { usage: field.usage }),
        };
        let scale = factor * figure.scale;
        Ok((Figure { at, scale, offset: offset * figure.scale + figure.offset }, field))
    }

    fn pupil(&mut self, pupil: &PupilAt<UsageAt>) -> Result<PupilAt<Field>, DescriptorError> {
        let (size, field) = self.figure(&pupil.size)?;
        let optional = |resolver: &mut Self, figure: &Option<Figure<UsageAt>>| match figure {
            None => Ok(None),
            Some(figure) => resolver.figure(figure).map(|(figure, _)| Some(figure)),
        };
        let valid = match &pupil.valid {
            Some((at, validity)) => Some((self.place(at)?.0, validity.clone())),
            None => null_state(field).map(|validity| (size.at.clone(), validity)),
        };
        Ok(PupilAt {
            eye: pupil.eye,
            lost: pupil.lost.clone(),
            confidence: optional(self, &pupil.confidence)?,
            aperture: optional(self, &pupil.aperture)?,
            valid,
            size,
        })
    }
}

/// After how many bits a counter begins again.
fn counter_bits(field: &ReportField) -> Option<u32> {
    (!field.signed && field.bits <= 62).then_some(field.bits)
}

/// A field with a null state says by a figure outside its range that there is none: above it where its bits have room
/// there, else below it.
fn null_state(field: &ReportField) -> Option<Validity> {
    let greatest = if field.signed { (1_i128 << (field.bits - 1)) - 1 } else { (1_i128 << field.bits) - 1 };
    if !field.nullable {
        None
    } else if i128::from(field.logical_maximum) < greatest {
        Some(Validity::AtMost(field.logical_maximum as f64))
    } else {
        Some(Validity::AtLeast(field.logical_minimum as f64))
    }
}

/// The number of 1, 2, 4 or 8 bytes that holds a field's bits; None where no such number does.
///
/// It ends with the field's last byte if the report has as many bytes before that, so that nothing behind a report's
/// last field is asked for; a field of 3, 5, 6 or 7 bytes at the very beginning needs bytes behind it. A signed field
/// must end with a byte: its sign is then the number's.
fn place(field: &ReportField) -> Option<Field> {
    let end = field.bit_offset + field.bits;
    let (first, last) = (field.bit_offset / 8, end.div_ceil(8));
    let kinds = match field.signed {
        true => &[NumberType::I8, NumberType::I16, NumberType::I32][..],
        false => &[NumberType::U8, NumberType::U16, NumberType::U32, NumberType::U64],
    };
    let kind = *kinds.iter().find(|kind| kind.bytes() as u32 >= last - first)?;
    let at = last.saturating_sub(kind.bytes() as u32).min(first);
    let shift = field.bit_offset - 8 * at;
    let whole_bits = 8 * kind.bytes() as u32;
    let fills = shift + field.bits == whole_bits;
    if field.signed && !fills {
        return None;
    }
    let mask = if fills { None } else { Some((1 << field.bits) - 1) };
    Some(Field { at: at as i32, kind, big_endian: false, shift, mask })
}

/// Stands in where a profile goes by usage and the link has no descriptor: no message can be read.
#[derive(Debug)]
pub(super) struct Undescribed;

impl Decoder for Undescribed {
    fn push(&mut self, bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        if !bytes.is_empty() {
            on_event(WireEvent::Rejected(WireFault::MissingField));
        }
    }

    fn finish(&mut self, _: &mut dyn FnMut(WireEvent)) {}
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::profile::Profile;
    use crate::wire::hid_descriptor::HOLOD_HID_DESCRIPTOR;
    use crate::wire::testing::events_of;
    use crate::wire::{Format, WireSample};

    /// The shipped HID profile's fields by their usages.
    const BY_USAGE: &str = include_str!("../../profiles/example-usages.toml");

    fn profile(text: &str) -> Profile {
        Profile::from_toml(text, "test").unwrap_or_else(|error| panic!("{error}"))
    }

    fn refused(text: &str, descriptor: &[u8]) -> String {
        profile(text).described(descriptor).expect_err("is refused").to_string()
    }

    /// The judge: whether two lists of events tell the same.
    fn same(one: &[WireEvent], other: &[WireEvent]) -> bool {
        let near = |one: f32, other: f32| (one - other).abs() <= 1e-6 * one.abs();
        one.len() == other.len()
            && one.iter().zip(other).all(|pair| match pair {
                (WireEvent::Sample(one), WireEvent::Sample(other)) => {
                    let rest = WireSample { diameter_mm: one.diameter_mm, confidence: one.confidence, ..*other };
                    near(one.diameter_mm, other.diameter_mm) && near(one.confidence, other.confidence) && *one == rest
                }
                (one, other) => one == other,
            })
    }

    fn report(device_us: u32, sequence: u16, eyes: [(u16, u8, u8); 2]) -> Vec<u8> {
        let mut report = vec![1];
        report.extend(device_us.to_le_bytes());
        report.extend(sequence.to_le_bytes());
        for (diameter_um, confidence, flags) in eyes {
            report.extend(diameter_um.to_le_bytes());
            report.extend([confidence, flags]);
        }
        report
    }

    proptest! {
        #[test]
        fn by_usage_and_by_place_read_the_same(
            reports in prop::collection::vec(
                any::<(u32, u16, [(u16, u8, u8); 2])>().prop_map(|(at, sequence, eyes)| report(at, sequence, eyes)),
                1..20,
            ),
        ) {
            let mut by_place = Profile::find("holod-hid").expect("is shipped").decoder();
            let mut by_usage = profile(BY_USAGE).described(HOLOD_HID_DESCRIPTOR).expect("has all").decoder();
            for report in &reports {
                let (mut one, mut other) = (Vec::new(), Vec::new());
                by_place.push(report, &mut |event| one.push(event));
                by_usage.push(report, &mut |event| other.push(event));
                prop_assert_eq!(one.len(), 2);
                prop_assert!(same(&one, &other), "{:?} {:?}", one, other);
            }
        }

        /// Each field of 1 to 31 bits from the fourth byte on gives back the number that was put there.
        #[test]
        fn any_bits_are_read_as_they_were_written(
            offset in 24..100_u32,
            bits in 1..=31_u32,
            number: u32,
            noise in prop::collection::vec(any::<u8>(), 17),
            behind in 0..3_usize,
        ) {
            let number = number >> (32 - bits);
            let length = (offset + bits).div_ceil(8) as usize + behind;
            let mut report = noise[..length.min(17)].to_vec();
            report.resize(length, 0xA5);
            for bit in 0..bits {
                let (byte, mask) = (((offset + bit) / 8) as usize, 1 << ((offset + bit) % 8));
                report[byte] = report[byte] & !mask | if number >> bit & 1 == 1 { mask } else { 0 };
            }
            let descriptor = descriptor_of(offset, bits, &[0x15, 0, 0x27, 0xFF, 0xFF, 0xFF, 0x7F]);
            let Format::Report(settings) = profile(ONE_PUPIL).described(&descriptor).expect("has it").format else {
                panic!("is resolved")
            };
            let events = events_of(&mut crate::wire::report::ReportDecoder::new(&settings), &report);
            let [WireEvent::Sample(sample)] = events[..] else { panic!("{events:?}") };
            prop_assert_eq!(sample.diameter_mm, number as f32);
        }
    }

    const ONE_PUPIL: &str =
        "format = \"holod-tracker-1\"\nname = \"x\"\n[wire]\nkind = \"usages\"\nboth = { size = \"12:30\" }";

    /// A descriptor with `offset` bits of padding and one field of usage 0012:0030 without a unit.
    fn descriptor_of(offset: u32, bits: u32, range: &[u8]) -> Vec<u8> {
        let mut descriptor = vec![0x05, 0x12, 0x09, 0x01, 0xA1, 0x01];
        descriptor.extend([0x75, 0x01, 0x95, offset as u8, 0x81, 0x03]);
        descriptor.extend(range);
        descriptor.extend([0x09, 0x30, 0x75, bits as u8, 0x95, 0x01, 0x81, 0x42, 0xC0]);
        descriptor
    }

    #[test]
    fn the_judge_refuses_a_figure_that_differs() {
        let profile = Profile::find("holod-hid").expect("is shipped");
        let events =
            |diameter_um| events_of(&mut *profile.decoder(), &report(5, 6, [(diameter_um, 255, 1), (3000, 255, 1)]));
        assert!(same(&events(4000), &events(4000)));
        assert!(!same(&events(4000), &events(4001)));
    }

    #[test]
    fn signed_fields_units_and_null_states_are_understood() {
        let read = |descriptor: &[u8], report: &[u8]| {
            let mut decoder = profile(ONE_PUPIL).described(descriptor).expect("has it").decoder();
            let mut events = Vec::new();
            decoder.push(report, &mut |event| events.push(event));
            let [WireEvent::Sample(sample)] = events[..] else { panic!("{events:?}") };
            (sample.diameter_mm, sample.valid)
        };
        // -2048 to 2047 stand for 0 to 4095 hundredths of a millimetre, in the upper 12 of 16 bits.
        let range = [0x16, 0x00, 0xF8, 0x26, 0xFF, 0x07, 0x35, 0x00, 0x46, 0xFF, 0x0F, 0x65, 0x11, 0x55, 0x0D];
        let descriptor = descriptor_of(4, 12, &range);
        let (diameter_mm, valid) = read(&descriptor, &[0x0F, 0x80]);
        assert!(valid && diameter_mm.abs() < 1e-4, "{diameter_mm}");
        let (diameter_mm, _) = read(&descriptor, &[0xF0, 0xFF]);
        assert!((diameter_mm - 20.47).abs() < 1e-4, "{diameter_mm}");
        // Up to 1000; a figure above says that there is none.
        let descriptor = descriptor_of(0, 16, &[0x15, 0x00, 0x26, 0xE8, 0x03]);
        assert_eq!(read(&descriptor, &[0xE8, 0x03]), (1000.0, true));
        assert!(!read(&descriptor, &[0xE9, 0x03]).1);
        // From 1 to 255: so does 0.
        let descriptor = descriptor_of(0, 8, &[0x15, 0x01, 0x26, 0xFF, 0x00]);
        assert_eq!(read(&descriptor, &[1]), (1.0, true));
        assert!(!read(&descriptor, &[0]).1);
    }

    #[test]
    fn what_the_descriptor_lacks_is_told() {
        let message = refused(&BY_USAGE.replace("ff00:0030", "ff00:0033"), HOLOD_HID_DESCRIPTOR);
        assert!(message.contains("no input field of usage ff00:0033 in a collection ff00:0010"), "{message}");
        let message = refused(ONE_PUPIL, &descriptor_of(3, 12, &[0x16, 0x00, 0xF8, 0x26, 0xFF, 0x07]));
        assert!(message.contains("usage 0012:0030, 12 bits from bit 3"), "{message}");
        let message = refused(ONE_PUPIL, &descriptor_of(0, 8, &[0x65, 0x11]));
        assert!(message.contains("has a unit and no range"), "{message}");
        let mut two = HOLOD_HID_DESCRIPTOR.to_vec();
        let right = two.windows(4).position(|item| item == [0x09, 0x11, 0xA1, 0x02]).expect("is there");
        two.splice(right..right, [0x85, 0x02]);
        let message = refused(BY_USAGE, &two);
        assert!(message.contains("usages ff00:0020 and ff00:0030 are in different reports"), "{message}");
        assert!(refused(BY_USAGE, &[]).contains("is empty"));
        // Without a descriptor nothing can be read, which is counted.
        let events = events_of(&mut *profile(BY_USAGE).decoder(), &[1; 15]);
        assert_eq!(events, [WireEvent::Rejected(WireFault::MissingField)]);
    }
}
