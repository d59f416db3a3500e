//! What the configurable decoders share: where the figures of a message stand, and how they become samples.
//!
//! `P` is a place in a message: a [`Column`](super::delimited::Column) of a line, a [`Field`] of a binary message.

use std::cmp::Ordering;
use std::f64::consts::PI;

use holod_calibration::TimeNs;

use super::{WireEvent, WireFault, WireSample};
use crate::SampleEye;

/// Where everything stands in a message.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout<P> {
    /// The time, if there is one.
    pub time: Option<TimeAt<P>>,
    /// The running number, if there is one, and after how many bits it begins again.
    pub sequence: Option<(P, Option<u32>)>,
    /// What tells the eye of pupils whose eye is [`None`], with the figures that stand for each eye.
    pub eye: Option<(P, Vec<(Literal, SampleEye)>)>,
    /// The pupils, at least one.
    pub pupils: Vec<PupilAt<P>>,
    /// What the sizes are.
    pub size: SizeRule,
}

/// Where a message has its time, and how that is read.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeAt<P> {
    /// The place of the time in the message.
    pub at: P,
    /// Nanoseconds of one of its units: of a second, a microsecond, a frame.
    pub ns_per_tick: f64,
    /// After how many bits it begins again at 0.
    pub wrap_bits: Option<u32>,
}

/// Where a message has a pupil, and how that is read.
#[derive(Clone, Debug, PartialEq)]
pub struct PupilAt<P> {
    /// Its eye; None where the message tells it.
    pub eye: Option<SampleEye>,
    /// Diameter, radius or area, as [`Layout::size`] says.
    pub size: Figure<P>,
    /// What stands in place of the size of a lost pupil.
    pub lost: Vec<Literal>,
    /// The confidence, 0..=1 after its scale.
    pub confidence: Option<Figure<P>>,
    /// The distance of the lids, millimetres after its scale.
    pub aperture: Option<Figure<P>>,
    /// What tells whether the pupil is seen.
    pub valid: Option<(P, Validity)>,
}

/// A figure: what stands there, times `scale`, plus `offset`.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure<P> {
    /// Where the raw number stands.
    pub at: P,
    /// What the raw number is multiplied by; the unit of the product is the figure's.
    pub scale: f64,
    /// What is added then, in the unit of the figure.
    pub offset: f64,
}

/// Something that may stand in a place.
#[derive(Clone, Debug, PartialEq)]
pub enum Literal {
    /// A number, however it is written; NaN stands for NaN.
    Number(f64),
    /// A text; in a line only.
    Text(Vec<u8>),
}

/// When what stands in a place says that the pupil is seen.
#[derive(Clone, Debug, PartialEq)]
pub enum Validity {
    /// It is exactly this.
    Equals(Literal),
    /// It is anything but this.
    Differs(Literal),
    /// It is this or more.
    AtLeast(f64),
    /// It is this or less.
    AtMost(f64),
    /// All of these bits are set.
    AllBits(u64),
    /// None of these bits is set.
    NoBits(u64),
}

/// What a size is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SizeKind {
    /// The diameter of the pupil.
    Diameter,
    /// The radius, half the diameter.
    Radius,
    /// The area, which is taken for that of a disc.
    Area,
}

/// From a size to a diameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SizeRule {
    /// What the size is of.
    pub kind: SizeKind,
    /// Millimetres of one unit of the diameter; 1 where only the rig's scale knows.
    pub mm_per_unit: f64,
}

impl<P> Layout<P> {
    /// The same with places of another kind.
    pub(super) fn map<Q>(&self, place: &mut impl FnMut(&P) -> Q) -> Layout<Q> {
        Layout {
            time: self.time.as_ref().map(|time| TimeAt {
                at: place(&time.at),
                ns_per_tick: time.ns_per_tick,
                wrap_bits: time.wrap_bits,
            }),
            sequence: self.sequence.as_ref().map(|(at, bits)| (place(at), *bits)),
            eye: self.eye.as_ref().map(|(at, eyes)| (place(at), eyes.clone())),
            pupils: self.pupils.iter().map(|pupil| pupil.map(place)).collect(),
            size: self.size,
        }
    }
}

impl<P> PupilAt<P> {
    fn map<Q>(&self, place: &mut impl FnMut(&P) -> Q) -> PupilAt<Q> {
        let mut figure =
            |figure: &Figure<P>| Figure { at: place(&figure.at), scale: figure.scale, offset: figure.offset };
        PupilAt {
            eye: self.eye,
            size: figure(&self.size),
            lost: self.lost.clone(),
            confidence: self.confidence.as_ref().map(&mut figure),
            aperture: self.aperture.as_ref().map(&mut figure),
            valid: self.valid.as_ref().map(|(at, validity)| (place(at), validity.clone())),
        }
    }
}

/// Type of a number in a binary message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NumberType {
    /// One byte: 0 to 255.
    U8,
    /// One byte, two's complement.
    I8,
    /// Two bytes: 0 to 65535.
    U16,
    /// Two bytes, two's complement.
    I16,
    /// Four bytes: 0 to 2³² − 1.
    U32,
    /// Four bytes, two's complement.
    I32,
    /// Eight bytes: 0 to 2⁶⁴ − 1.
    U64,
    /// Four bytes, IEEE 754.
    F32,
    /// Eight bytes, IEEE 754.
    F64,
}

impl NumberType {
    /// How many bytes it takes in a message.
    pub const fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::F64 => 8,
        }
    }

    /// Whether it has a fraction.
    pub const fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }
}

/// A number in a binary message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Field {
    /// Bytes before it; negative where it is counted from the message's end.
    pub at: i32,
    /// How its bytes make a number.
    pub kind: NumberType,
    /// Whether its highest byte comes first.
    pub big_endian: bool,
    /// Bits of a whole number that are shifted out below...
    pub shift: u32,
    /// ... and those that are kept after that.
    pub mask: Option<u64>,
}

impl Field {
    /// How many bits it has.
    pub const fn bits(&self) -> u32 {
        let bits = self.kind.bytes() as u32 * 8 - self.shift;
        match self.mask {
            Some(mask) if 64 - mask.leading_zeros() < bits => 64 - mask.leading_zeros(),
            _ => bits,
        }
    }
}

/// A number as it stands in a message.
#[derive(Clone, Copy, Debug)]
pub(super) enum Raw {
    /// `mantissa` / 10^`decimals`, no more than 18 of them.
    Decimal {
        mantissa: i64,
        decimals: u32,
    },
    Single(f32),
    Float(f64),
}

const POWERS_OF_TEN: [f64; 19] =
    [1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18];

impl Raw {
    pub(super) const fn whole(mantissa: i64) -> Self {
        Self::Decimal { mantissa, decimals: 0 }
    }

    pub(super) fn number(self) -> f64 {
        match self {
            Self::Decimal { mantissa, decimals: 0 } => mantissa as f64,
            Self::Decimal { mantissa, decimals } => mantissa as f64 / POWERS_OF_TEN[decimals as usize],
            Self::Single(number) => f64::from(number),
            Self::Float(number) => number,
        }
    }

    /// How it compares with a figure of the profile, in the precision that it was sent in.
    fn compared_with(self, figure: f64) -> Option<Ordering> {
        match self {
            Self::Single(number) => number.partial_cmp(&(figure as f32)),
            _ => self.number().partial_cmp(&figure),
        }
    }

    /// It as a whole number.
    fn whole_number(self) -> Result<i64, WireFault> {
        match self {
            Self::Decimal { mantissa, decimals: 0 } => Ok(mantissa),
            _ => Err(WireFault::BadNumber),
        }
    }
}

/// A message whose places can be read.
pub(super) trait Message<P> {
    fn raw(&self, at: &P) -> Result<Raw, WireFault>;

    /// Whether this text stands there.
    fn has_text(&self, at: &P, text: &[u8]) -> bool;
}

/// The bytes of a binary message.
pub(super) struct Bytes<'a>(pub(super) &'a [u8]);

impl Message<Field> for Bytes<'_> {
    fn raw(&self, field: &Field) -> Result<Raw, WireFault> {
        let start = place(field.at, self.0.len()).ok_or(WireFault::TooShort)?;
        let rest = self.0.get(start..).ok_or(WireFault::TooShort)?;
        macro_rules! number {
            ($type:ty) => {{
                let bytes = *rest.first_chunk().ok_or(WireFault::TooShort)?;
                if field.big_endian { <$type>::from_be_bytes(bytes) } else { <$type>::from_le_bytes(bytes) }
            }};
        }
        let whole = match field.kind {
            NumberType::U8 => i64::from(number!(u8)),
            NumberType::I8 => i64::from(number!(i8)),
            NumberType::U16 => i64::from(number!(u16)),
            NumberType::I16 => i64::from(number!(i16)),
            NumberType::U32 => i64::from(number!(u32)),
            NumberType::I32 => i64::from(number!(i32)),
            NumberType::U64 => {
                let number = (number!(u64) >> field.shift) & field.mask.unwrap_or(u64::MAX);
                return Ok(i64::try_from(number).map_or(Raw::Float(number as f64), Raw::whole));
            }
            NumberType::F32 => return Ok(Raw::Single(number!(f32))),
            NumberType::F64 => return Ok(Raw::Float(number!(f64))),
        };
        Ok(Raw::whole((whole >> field.shift) & field.mask.map_or(-1, |mask| mask as i64)))
    }

    fn has_text(&self, _: &Field, _: &[u8]) -> bool {
        false
    }
}

/// The byte that `at` means in a message of `length` bytes.
pub(super) fn place(at: i32, length: usize) -> Option<usize> {
    if at < 0 { length.checked_sub(at.unsigned_abs() as usize) } else { Some(at as usize) }
}

/// A counter that begins again at 0, as one that does not. A step of more than half of its range is one backwards.
#[derive(Clone, Copy, Debug, Default)]
struct Unwrapped {
    last: Option<(u64, i64)>,
}

/// The greatest number of a counter of `bits` bits; none of one that never begins again.
fn wrap_mask(bits: Option<u32>) -> Option<u64> {
    bits.filter(|bits| *bits < 63).map(|bits| (1_u64 << bits) - 1)
}

impl Unwrapped {
    fn next(&mut self, raw: i64, bits: Option<u32>) -> i64 {
        let Some(mask) = wrap_mask(bits) else { return raw };
        let raw = raw as u64 & mask;
        let total = match self.last {
            None => raw as i64,
            Some((last, total)) => {
                let step = raw.wrapping_sub(last) & mask;
                let step = if step > mask / 2 { step as i64 - mask as i64 - 1 } else { step as i64 };
                // Before its own beginning: the tracker has begun anew.
                total.checked_add(step).filter(|total| *total >= 0).unwrap_or(raw as i64)
            }
        };
        self.last = Some((raw, total));
        total
    }
}

/// Running numbers that begin again at 0, as ones that do not. A step forwards through 0 may be that of a tracker that
/// has begun anew. It is taken for that where the time of its message falls, or where it is longer than
/// [`LONGEST_WRAP`].
#[derive(Clone, Copy, Debug, Default)]
struct Numbering {
    counter: Unwrapped,
    t_device: Option<TimeNs>,
}

/// Numbers of 16 s at 250 Hz, of 4 s at 1 kHz, and a sixteenth of the range of 16 bits; of wider counters the same share
/// counts. Few silences of a link last longer, and fewer of them pass 0. No step forwards of 13 bits or fewer is longer:
/// of 8 bits half a second of samples may be lost, and a restart cannot be told from that by the numbers alone.
const LONGEST_WRAP: u64 = 4096;

impl Numbering {
    fn next(&mut self, raw: i64, bits: Option<u32>, t_device: Option<TimeNs>) -> i64 {
        let time_falls = self.t_device.zip(t_device).is_some_and(|(before, t)| t < before);
        self.t_device = t_device.or(self.t_device);
        if let Some((last, _)) = self.counter.last
            && let Some(mask) = wrap_mask(bits)
        {
            let raw = raw as u64 & mask;
            let step = raw.wrapping_sub(last) & mask;
            // A clock that is set back, too, falls, and its numbers go on one by one.
            let is_new = step > 1 && time_falls || step > LONGEST_WRAP.max(mask >> 4);
            if raw < last && step <= mask / 2 && is_new {
                self.counter = Unwrapped::default();
            }
        }
        self.counter.next(raw, bits)
    }
}

/// Makes samples of messages by a layout, with what it remembers of earlier ones.
#[derive(Clone, Debug)]
pub(super) struct Fields<P> {
    layout: Layout<P>,
    time: Unwrapped,
    sequence: Numbering,
}

impl<P> Fields<P> {
    pub(super) fn new(layout: Layout<P>) -> Self {
        Self { layout, time: Unwrapped::default(), sequence: Numbering::default() }
    }

    /// Reads a message. A fault of one pupil is an event of its own, with a lost sample behind it where a figure is no
    /// size; one of the whole message is returned before any event was told.
    pub(super) fn read(
        &mut self,
        message: &impl Message<P>,
        on_event: &mut dyn FnMut(WireEvent),
    ) -> Result<(), WireFault> {
        let Self { layout, time, sequence } = self;
        let eye_in_message = match &layout.eye {
            None => None,
            Some((at, eyes)) => {
                let raw = message.raw(at);
                let eye = eyes.iter().find(|(literal, _)| stands(message, at, raw, literal));
                Some(eye.ok_or(WireFault::BadEye)?.1)
            }
        };
        let t_device = match &layout.time {
            None => None,
            Some(at) => Some(nanoseconds(message.raw(&at.at)?, at.ns_per_tick, at.wrap_bits, time)?),
        };
        let sequence = match &layout.sequence {
            None => None,
            Some((at, bits)) => {
                let number = sequence.next(message.raw(at)?.whole_number()?, *bits, t_device);
                Some(u64::try_from(number).map_err(|_| WireFault::BadNumber)?)
            }
        };
        for pupil in &layout.pupils {
            let eye = pupil.eye.or(eye_in_message).unwrap_or(SampleEye::Both);
            let PupilFigures { diameter_mm, confidence, aperture_mm, valid } =
                match read_pupil(message, pupil, layout.size) {
                    Ok(figures) => figures,
                    Err(fault) => {
                        on_event(WireEvent::Rejected(fault));
                        if !fault.is_of_a_figure() {
                            continue;
                        }
                        PupilFigures::LOST
                    }
                };
            on_event(WireEvent::Sample(WireSample {
                t_device,
                eye,
                diameter_mm,
                confidence,
                aperture_mm,
                sequence,
                valid,
            }));
        }
        Ok(())
    }
}

struct PupilFigures {
    diameter_mm: f32,
    confidence: f32,
    aperture_mm: Option<f32>,
    valid: bool,
}

impl PupilFigures {
    const LOST: Self = Self { diameter_mm: 0.0, confidence: 0.0, aperture_mm: None, valid: false };
}

fn read_pupil<P>(message: &impl Message<P>, pupil: &PupilAt<P>, rule: SizeRule) -> Result<PupilFigures, WireFault> {
    let size = message.raw(&pupil.size.at);
    let lost = pupil.lost.iter().any(|literal| stands(message, &pupil.size.at, size, literal));
    let valid = !lost
        && match &pupil.valid {
            None => true,
            Some((at, validity)) => validity.holds(message, at)?,
        };
    let confidence = match &pupil.confidence {
        None => Ok(1.0),
        Some(figure) => figure.read(message).and_then(|number| {
            let confidence = number as f32;
            if (0.0..=1.0).contains(&confidence) { Ok(confidence) } else { Err(WireFault::BadConfidence) }
        }),
    };
    if !valid {
        return Ok(PupilFigures {
            diameter_mm: 0.0,
            confidence: confidence.unwrap_or(0.0),
            aperture_mm: pupil.aperture.as_ref().and_then(|figure| aperture(figure, message).ok().flatten()),
            valid,
        });
    }
    let diameter_mm = rule.diameter(pupil.size.of(size?))?;
    let aperture_mm = pupil.aperture.as_ref().map_or(Ok(None), |figure| aperture(figure, message))?;
    Ok(PupilFigures { diameter_mm, confidence: confidence?, aperture_mm, valid })
}

/// The lids' distance; none where nothing stands in its place, or a figure that says so.
fn aperture<P>(figure: &Figure<P>, message: &impl Message<P>) -> Result<Option<f32>, WireFault> {
    match figure.read(message) {
        Ok(number) => Ok((number >= 0.0).then_some(number as f32)),
        Err(WireFault::MissingField | WireFault::NotFinite) => Ok(None),
        Err(fault) => Err(fault),
    }
}

impl<P> Figure<P> {
    fn of(&self, raw: Raw) -> f64 {
        raw.number() * self.scale + self.offset
    }

    fn read(&self, message: &impl Message<P>) -> Result<f64, WireFault> {
        let number = self.of(message.raw(&self.at)?);
        if number.is_finite() { Ok(number) } else { Err(WireFault::NotFinite) }
    }
}

/// Whether `literal` stands at `at`, where `raw` was read.
fn stands<P>(message: &impl Message<P>, at: &P, raw: Result<Raw, WireFault>, literal: &Literal) -> bool {
    match literal {
        Literal::Number(number) => raw.is_ok_and(|raw| {
            raw.compared_with(*number) == Some(Ordering::Equal) || (number.is_nan() && raw.number().is_nan())
        }),
        Literal::Text(text) => message.has_text(at, text),
    }
}

impl Validity {
    fn holds<P>(&self, message: &impl Message<P>, at: &P) -> Result<bool, WireFault> {
        let raw = message.raw(at);
        Ok(match self {
            Self::Equals(literal) => stands(message, at, raw, literal),
            Self::Differs(literal) => !stands(message, at, raw, literal),
            Self::AtLeast(least) => raw?.compared_with(*least).is_some_and(Ordering::is_ge),
            Self::AtMost(most) => raw?.compared_with(*most).is_some_and(Ordering::is_le),
            Self::AllBits(bits) => raw?.whole_number()? as u64 & bits == *bits,
            Self::NoBits(bits) => raw?.whole_number()? as u64 & bits == 0,
        })
    }
}

impl SizeRule {
    /// The diameter of a pupil of this size; of an area A it is 2·√(A/π).
    ///
    /// # Errors
    /// The size is negative, NaN or infinite.
    pub fn diameter(self, size: f64) -> Result<f32, WireFault> {
        let diameter = match self.kind {
            SizeKind::Diameter => size,
            SizeKind::Radius => 2.0 * size,
            SizeKind::Area => 2.0 * (size.max(0.0) / PI).sqrt(),
        };
        let diameter = (diameter * self.mm_per_unit) as f32;
        if size < 0.0 {
            Err(WireFault::Negative)
        } else if size.is_finite() && diameter.is_finite() {
            Ok(diameter)
        } else {
            Err(WireFault::NotFinite)
        }
    }
}

fn nanoseconds(raw: Raw, ns_per_tick: f64, bits: Option<u32>, unwrapped: &mut Unwrapped) -> Result<TimeNs, WireFault> {
    let raw = match raw {
        Raw::Decimal { mantissa, decimals: 0 } => Raw::whole(unwrapped.next(mantissa, bits)),
        raw => raw,
    };
    let whole_ns = ns_per_tick as i64;
    match raw {
        Raw::Decimal { mantissa, decimals } if whole_ns as f64 == ns_per_tick => {
            let ns = i128::from(mantissa) * i128::from(whole_ns) / 10_i128.pow(decimals);
            i64::try_from(ns).map(TimeNs).map_err(|_| WireFault::BadNumber)
        }
        raw => {
            let ns = (raw.number() * ns_per_tick).round();
            if !ns.is_finite() {
                Err(WireFault::NotFinite)
            } else if ns.abs() >= i64::MAX as f64 {
                Err(WireFault::BadNumber)
            } else {
                Ok(TimeNs(ns as i64))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sequence::{SequenceEvent, SequenceTracker};

    fn field(at: i32, kind: NumberType) -> Field {
        Field { at, kind, big_endian: false, shift: 0, mask: None }
    }

    #[test]
    fn each_type_reads_in_both_byte_orders() {
        let bytes = [0x80, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07];
        let cases = [
            (NumberType::U8, 128.0, 128.0),
            (NumberType::I8, -128.0, -128.0),
            (NumberType::U16, 384.0, 32769.0),
            (NumberType::I16, 384.0, -32767.0),
            (NumberType::U32, 50_463_104.0, 2_147_549_699.0),
            (NumberType::I32, 50_463_104.0, -2_147_417_597.0),
            (NumberType::U64, 0x0706_0504_0302_0180_u64 as f64, 0x8001_0203_0405_0607_u64 as f64),
            (NumberType::F32, f64::from(f32::from_bits(0x0302_0180)), f64::from(f32::from_bits(0x8001_0203))),
            (NumberType::F64, f64::from_bits(0x0706_0504_0302_0180), f64::from_bits(0x8001_0203_0405_0607)),
        ];
        for (kind, little, big) in cases {
            assert_eq!(Bytes(&bytes).raw(&field(0, kind)).unwrap().number(), little, "{kind:?}");
            let field = Field { big_endian: true, ..field(0, kind) };
            assert_eq!(Bytes(&bytes).raw(&field).unwrap().number(), big, "{kind:?}");
            assert!(matches!(Bytes(&bytes[..kind.bytes() - 1]).raw(&field), Err(WireFault::TooShort)));
        }
    }

    #[test]
    fn bits_are_shifted_and_masked_and_offsets_count_from_the_end() {
        let bits = Field { shift: 4, mask: Some(0x3F), ..field(-2, NumberType::U16) };
        assert_eq!(Bytes(&[9, 9, 0b1010_1111, 0b1111_1110]).raw(&bits).unwrap().number(), f64::from(0b10_1010));
        assert_eq!(bits.bits(), 6);
        assert!(matches!(Bytes(&[1]).raw(&bits), Err(WireFault::TooShort)));
    }

    #[test]
    fn a_figure_of_the_profile_is_compared_in_the_precision_that_was_sent() {
        let single = |number: f32| Raw::Single(number);
        let literal = |number| Literal::Number(number);
        let bytes = (-0.1_f32).to_le_bytes();
        let at = field(0, NumberType::F32);
        let holds = |validity: Validity| validity.holds(&Bytes(&bytes), &at).expect("reads");
        assert!(holds(Validity::Equals(literal(-0.1))) && !holds(Validity::Equals(literal(-0.1001))));
        assert!(holds(Validity::AtLeast(-0.1)) && holds(Validity::AtMost(-0.1)));
        assert_eq!(single(f32::NAN).compared_with(f64::NAN), None);
        let bytes = (-0.1_f64).to_le_bytes();
        let at = field(0, NumberType::F64);
        let near = Validity::Equals(literal(-0.100_000_000_1));
        assert!(!near.holds(&Bytes(&bytes), &at).expect("reads"), "a double is compared as one");
    }

    #[test]
    fn a_counter_that_wraps_goes_on() {
        let mut counter = Unwrapped::default();
        let read = [65534, 65535, 0, 1, 65535, 2].map(|raw| counter.next(raw, Some(16)));
        assert_eq!(read, [65534, 65535, 65536, 65537, 65535, 65538]);
        let mut counter = Unwrapped::default();
        assert_eq!([5, 0, 65535].map(|raw| counter.next(raw, Some(16))), [5, 0, 65535]);
        let mut counter = Unwrapped::default();
        assert_eq!([i64::MAX, -1].map(|raw| counter.next(raw, None)), [i64::MAX, -1]);
    }

    /// What running numbers of some bits, with times in seconds, tell after the first.
    fn told(bits: u32, numbers: &[(i64, Option<i64>)]) -> Vec<SequenceEvent> {
        let (mut numbering, mut tracker) = (Numbering::default(), SequenceTracker::new());
        let event = |&(raw, t_s): &(i64, Option<i64>)| {
            let number = numbering.next(raw, Some(bits), t_s.map(|t_s| TimeNs(t_s * 1_000_000_000)));
            tracker.next(number as u64, SampleEye::Both)
        };
        numbers.iter().map(event).skip(1).collect()
    }

    #[test]
    fn a_tracker_that_begins_anew_has_lost_no_numbers() {
        use SequenceEvent::{Gap, InOrder, Repeat, Restart};
        let timeless = |bits, numbers: &[i64]| told(bits, &numbers.iter().map(|raw| (*raw, None)).collect::<Vec<_>>());
        assert_eq!(timeless(16, &[39_999, 40_000, 0, 1]), [InOrder, Restart, InOrder]);
        assert_eq!(timeless(16, &[20_000, 0, 1]), [Restart, InOrder], "a step backwards");
        assert_eq!(timeless(16, &[65_535, 0, 20_000, 40_000, 2, 3])[1..], [Gap(19_999), Gap(19_999), Restart, InOrder]);
        assert_eq!(timeless(24, &[(1 << 24) - 1_048_575, 0]), [Gap(1_048_574)]);
        assert_eq!(timeless(24, &[(1 << 24) - 1_048_576, 0]), [Restart]);
        // Long silences, with 0 in them and without.
        assert_eq!(timeless(16, &[64_000, 2_559, 2_560]), [Gap(4_094), InOrder]);
        assert_eq!(timeless(16, &[64_000, 2_561, 2_562]), [Restart, InOrder]);
        assert_eq!(timeless(16, &[10, 30_000]), [Gap(29_989)]);
        assert_eq!(timeless(8, &[200, 70, 71]), [Gap(125), InOrder]);
        // Where there is a time, it tells.
        let timed = |bits, numbers: &[(i64, i64)]| {
            told(bits, &numbers.iter().map(|(raw, t_s)| (*raw, Some(*t_s))).collect::<Vec<_>>())
        };
        assert_eq!(timed(16, &[(64_000, 500), (0, 0), (1, 0)]), [Restart, InOrder]);
        assert_eq!(
            timed(8, &[(100, 500), (200, 501), (0, 502), (100, 503), (200, 504), (0, 0)]).last(),
            Some(&Restart)
        );
        assert_eq!(timed(16, &[(64_000, 500), (0, 506), (1, 506)]), [Gap(1_535), InOrder]);
        // A datagram that is overtaken, and a clock that is set back by a second.
        assert_eq!(
            timed(16, &[(65_534, 500), (1, 503), (65_535, 501), (2, 504)])[1..],
            [SequenceEvent::Overtaken { gaps: 0 }, InOrder]
        );
        assert_eq!(timed(16, &[(65_535, 500), (0, 499), (0, 499), (1, 499)]), [InOrder, Repeat, InOrder]);
    }

    #[test]
    fn areas_and_radii_become_diameters() {
        let rule = |kind, mm_per_unit| SizeRule { kind, mm_per_unit };
        assert_eq!(rule(SizeKind::Diameter, 0.5).diameter(8.0), Ok(4.0));
        assert_eq!(rule(SizeKind::Radius, 1.0).diameter(2.0), Ok(4.0));
        assert_eq!(rule(SizeKind::Area, 1.0).diameter(4.0 * PI), Ok(4.0));
        assert_eq!(rule(SizeKind::Area, 1.0).diameter(-1.0), Err(WireFault::Negative));
        assert_eq!(rule(SizeKind::Diameter, 1.0).diameter(f64::NAN), Err(WireFault::NotFinite));
        assert_eq!(rule(SizeKind::Diameter, 1e300).diameter(1e300), Err(WireFault::NotFinite));
    }

    #[test]
    fn times_keep_their_nanoseconds() {
        let ns = |mantissa, decimals, ns_per_tick| {
            nanoseconds(Raw::Decimal { mantissa, decimals }, ns_per_tick, None, &mut Unwrapped::default())
        };
        assert_eq!(ns(1_718_000_000_123_456_789, 9, 1e9), Ok(TimeNs(1_718_000_000_123_456_789)));
        assert_eq!(ns(1_718_000_000_123_457, 0, 1e3), Ok(TimeNs(1_718_000_000_123_457_000)));
        assert_eq!(ns(-15, 1, 1e6), Ok(TimeNs(-1_500_000)));
        assert_eq!(ns(3, 0, 1e9 / 60.0), Ok(TimeNs(50_000_000)));
        assert_eq!(ns(i64::MAX, 0, 1e9), Err(WireFault::BadNumber));
    }
}
