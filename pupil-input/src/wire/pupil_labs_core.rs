//! Pupil Labs Core: one MessagePack map a message, as Pupil Capture publishes it under the topics `pupil.N.3d` and
//! `pupil.N.2d`.
//!
//! Of the map these keys are read: `id` (0 the right eye, 1 the left), `timestamp` (Pupil's clock, seconds; may be
//! negative), `confidence` (0..=1) and `diameter_3d` (millimetres). The 2-D detector's map has no `diameter_3d`, just a
//! `diameter` in pixels of the eye camera, and is a [`WireEvent::Note`]: both detectors run on each image, so that its
//! eye has a 3-D map too. Sizes no pupil has (a bad eyeball model gives 15 mm with good confidence) are handed on: they
//! are the gate's to judge.
//!
//! Confidence 0 is Pupil's word for "no pupil found".
//!
//! A map with `pupil_time` (seconds) is none of Pupil's: the link puts it between them where Pupil Remote has told the
//! time, [`time_message`], so that a recording holds it too. The times of samples are those of their images, some tens
//! of milliseconds before they are published; that alone tells how many.

use holod_calibration::TimeNs;
use rmp::Marker;

use super::{Decoder, WireEvent, WireFault, WireSample};
use crate::SampleEye;

/// Bytes of the longest message that is read; Pupil's are about 1000.
pub(crate) const MAX_MESSAGE_BYTES: usize = 4000;
/// Maps and arrays in each other; Pupil's are three.
const DEEPEST: usize = 16;

/// What Pupil Remote said is Pupil's time, as a message of its own.
pub(crate) fn time_message(t_s: f64) -> [u8; 21] {
    let mut message = *b"\x81\xaapupil_time\xcb\0\0\0\0\0\0\0\0";
    message[13..].copy_from_slice(&t_s.to_be_bytes());
    message
}

/// One message a push; what a message lacks is not looked for in the next one.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct CoreDecoder;

impl Decoder for CoreDecoder {
    fn push(&mut self, bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        on_event(read_message(bytes).unwrap_or_else(WireEvent::Rejected));
    }

    fn finish(&mut self, _on_event: &mut dyn FnMut(WireEvent)) {}
}

fn read_message(message: &[u8]) -> Result<WireEvent, WireFault> {
    if message.len() > MAX_MESSAGE_BYTES {
        return Err(WireFault::TooLong);
    }
    let mut rest = Cursor { rest: message };
    let (mut id, mut timestamp_s, mut confidence, mut diameter_mm, mut time_s) = (None, None, None, None, None);
    for _ in 0..rest.map_len()? {
        let slot = match rest.key()? {
            b"id" => &mut id,
            b"timestamp" => &mut timestamp_s,
            b"confidence" => &mut confidence,
            b"diameter_3d" => &mut diameter_mm,
            b"pupil_time" => &mut time_s,
            _ => {
                rest.skip()?;
                continue;
            }
        };
        *slot = Some(rest.number()?);
    }
    if !rest.rest.is_empty() {
        return Err(WireFault::Malformed);
    }
    if let Some(time_s) = time_s {
        return Ok(WireEvent::Clock(device_time(time_s)?));
    }
    let Some(diameter_mm) = diameter_mm else {
        return Ok(WireEvent::Note);
    };
    let (Some(id), Some(timestamp_s), Some(confidence)) = (id, timestamp_s, confidence) else {
        return Err(WireFault::MissingField);
    };
    let eye = match id {
        0.0 => SampleEye::Right,
        1.0 => SampleEye::Left,
        _ => return Err(WireFault::BadEye),
    };
    let t_device = device_time(timestamp_s)?;
    if !(0.0..=1.0).contains(&confidence) {
        return Err(WireFault::BadConfidence);
    }
    // The narrower type makes infinities and zeros of its own.
    let diameter_mm = diameter_mm as f32;
    let seen = confidence > 0.0 && diameter_mm.is_finite() && diameter_mm > 0.0;
    Ok(WireEvent::Sample(WireSample {
        t_device: Some(t_device),
        eye,
        diameter_mm,
        confidence: confidence as f32,
        aperture_mm: None,
        sequence: None,
        valid: seen,
    }))
}

/// Saturates: a time is untrusted, and its origin means nothing.
fn device_time(time_s: f64) -> Result<TimeNs, WireFault> {
    if time_s.is_finite() { Ok(TimeNs((time_s * 1e9).round() as i64)) } else { Err(WireFault::NotFinite) }
}

/// MessagePack, read in place.
struct Cursor<'a> {
    rest: &'a [u8],
}

impl<'a> Cursor<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], WireFault> {
        let (taken, rest) = self.rest.split_at_checked(count).ok_or(WireFault::TooShort)?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], WireFault> {
        Ok(self.take(N)?.try_into().expect("takes as many as asked"))
    }

    fn marker(&mut self) -> Result<Marker, WireFault> {
        let [byte] = self.array()?;
        Ok(Marker::from_u8(byte))
    }

    /// A length of `width` bytes, big-endian.
    fn length(&mut self, width: usize) -> Result<usize, WireFault> {
        Ok(self.take(width)?.iter().fold(0, |length, &byte| length << 8 | usize::from(byte)))
    }

    fn map_len(&mut self) -> Result<usize, WireFault> {
        match self.marker()? {
            Marker::FixMap(length) => Ok(usize::from(length)),
            Marker::Map16 => self.length(2),
            Marker::Map32 => self.length(4),
            _ => Err(WireFault::Malformed),
        }
    }

    /// A map's key. Old senders pack text as what is now bytes.
    fn key(&mut self) -> Result<&'a [u8], WireFault> {
        let length = match self.marker()? {
            Marker::FixStr(length) => usize::from(length),
            Marker::Str8 | Marker::Bin8 => self.length(1)?,
            Marker::Str16 | Marker::Bin16 => self.length(2)?,
            Marker::Str32 | Marker::Bin32 => self.length(4)?,
            _ => return Err(WireFault::Malformed),
        };
        self.take(length)
    }

    fn number(&mut self) -> Result<f64, WireFault> {
        Ok(match self.marker()? {
            Marker::FixPos(value) => f64::from(value),
            Marker::FixNeg(value) => f64::from(value),
            Marker::U8 => f64::from(u8::from_be_bytes(self.array()?)),
            Marker::U16 => f64::from(u16::from_be_bytes(self.array()?)),
            Marker::U32 => f64::from(u32::from_be_bytes(self.array()?)),
            Marker::U64 => u64::from_be_bytes(self.array()?) as f64,
            Marker::I8 => f64::from(i8::from_be_bytes(self.array()?)),
            Marker::I16 => f64::from(i16::from_be_bytes(self.array()?)),
            Marker::I32 => f64::from(i32::from_be_bytes(self.array()?)),
            Marker::I64 => i64::from_be_bytes(self.array()?) as f64,
            Marker::F32 => f64::from(f32::from_be_bytes(self.array()?)),
            Marker::F64 => f64::from_be_bytes(self.array()?),
            _ => return Err(WireFault::BadNumber),
        })
    }

    /// Passes over one value of any kind.
    fn skip(&mut self) -> Result<(), WireFault> {
        // Values still to pass over, one count for each map or array entered.
        let mut left = [0_usize; DEEPEST];
        left[0] = 1;
        let mut depth = 0;
        loop {
            while left[depth] == 0 {
                if depth == 0 {
                    return Ok(());
                }
                depth -= 1;
            }
            left[depth] -= 1;
            let values = match self.marker()? {
                Marker::FixPos(_) | Marker::FixNeg(_) | Marker::Null | Marker::True | Marker::False => 0,
                Marker::U8 | Marker::I8 => self.pass(1)?,
                Marker::U16 | Marker::I16 | Marker::FixExt1 => self.pass(2)?,
                Marker::FixExt2 => self.pass(3)?,
                Marker::U32 | Marker::I32 | Marker::F32 => self.pass(4)?,
                Marker::FixExt4 => self.pass(5)?,
                Marker::U64 | Marker::I64 | Marker::F64 => self.pass(8)?,
                Marker::FixExt8 => self.pass(9)?,
                Marker::FixExt16 => self.pass(17)?,
                Marker::FixStr(length) => self.pass(usize::from(length))?,
                Marker::Str8 | Marker::Bin8 => self.pass_counted(1, 0)?,
                Marker::Str16 | Marker::Bin16 => self.pass_counted(2, 0)?,
                Marker::Str32 | Marker::Bin32 => self.pass_counted(4, 0)?,
                Marker::Ext8 => self.pass_counted(1, 1)?,
                Marker::Ext16 => self.pass_counted(2, 1)?,
                Marker::Ext32 => self.pass_counted(4, 1)?,
                Marker::FixArray(length) => usize::from(length),
                Marker::Array16 => self.length(2)?,
                Marker::Array32 => self.length(4)?,
                Marker::FixMap(length) => 2 * usize::from(length),
                Marker::Map16 => 2 * self.length(2)?,
                Marker::Map32 => 2 * self.length(4)?,
                Marker::Reserved => return Err(WireFault::Malformed),
            };
            if values > 0 {
                depth += 1;
                *left.get_mut(depth).ok_or(WireFault::Malformed)? = values;
            }
        }
    }

    /// Passes over bytes that hold no further value.
    fn pass(&mut self, count: usize) -> Result<usize, WireFault> {
        self.take(count).map(|_| 0)
    }

    /// Passes over a length of `width` bytes, `more` bytes and as many as the length says.
    fn pass_counted(&mut self, width: usize, more: usize) -> Result<usize, WireFault> {
        let length = self.length(width)?;
        self.pass(length.saturating_add(more))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rmp::encode;

    use super::*;

    /// A value as Pupil packs it.
    #[derive(Clone, Debug)]
    enum Value {
        Null,
        Bool(bool),
        Int(i64),
        Single(f32),
        Double(f64),
        Text(String),
        Bytes(Vec<u8>),
        List(Vec<Value>),
        Map(Vec<(String, Value)>),
    }

    fn pack(value: &Value, out: &mut Vec<u8>) {
        match value {
            Value::Null => encode::write_nil(out).expect("packs"),
            Value::Bool(value) => encode::write_bool(out, *value).expect("packs"),
            Value::Int(value) => {
                encode::write_sint(out, *value).expect("packs");
            }
            Value::Single(value) => encode::write_f32(out, *value).expect("packs"),
            Value::Double(value) => encode::write_f64(out, *value).expect("packs"),
            Value::Text(text) => encode::write_str(out, text).expect("packs"),
            Value::Bytes(bytes) => encode::write_bin(out, bytes).expect("packs"),
            Value::List(values) => {
                encode::write_array_len(out, values.len() as u32).expect("packs");
                values.iter().for_each(|value| pack(value, out));
            }
            Value::Map(entries) => {
                encode::write_map_len(out, entries.len() as u32).expect("packs");
                for (key, value) in entries {
                    encode::write_str(out, key).expect("packs");
                    pack(value, out);
                }
            }
        }
    }

    fn doubles(values: &[f64]) -> Value {
        Value::List(values.iter().copied().map(Value::Double).collect())
    }

    fn map(entries: &[(&str, Value)]) -> Value {
        Value::Map(entries.iter().map(|(key, value)| ((*key).into(), value.clone())).collect())
    }

    /// All that pye3d's plugin publishes, in its order.
    fn datum(id: i64, t_s: f64, confidence: f64, diameter_mm: Value) -> Vec<(&'static str, Value)> {
        let ellipse = |x| {
            map(&[("center", doubles(&[x, 90.2])), ("axes", doubles(&[38.1, 40.4])), ("angle", Value::Double(-12.5))])
        };
        vec![
            ("sphere", map(&[("center", doubles(&[1.1, -2.2, 43.0])), ("radius", Value::Double(10.392))])),
            ("projected_sphere", ellipse(99.0)),
            (
                "circle_3d",
                map(&[
                    ("center", doubles(&[-0.5, 0.25, 34.0])),
                    ("normal", doubles(&[-0.1, 0.2, -0.97])),
                    ("radius", Value::Double(1.9)),
                ]),
            ),
            ("diameter_3d", diameter_mm),
            ("ellipse", ellipse(101.5)),
            ("location", doubles(&[101.5, 90.2])),
            ("diameter", Value::Double(40.4)),
            ("confidence", Value::Double(confidence)),
            ("model_confidence", Value::Double(1.0)),
            ("theta", Value::Double(1.7)),
            ("phi", Value::Double(-1.5)),
            ("norm_pos", doubles(&[0.53, 0.53])),
            ("topic", Value::Text(format!("pupil.{id}.3d"))),
            ("id", Value::Int(id)),
            ("method", Value::Text("pye3d 0.3.0 real-time".into())),
            ("timestamp", Value::Double(t_s)),
        ]
    }

    fn packed(entries: &[(&str, Value)]) -> Vec<u8> {
        let mut bytes = Vec::new();
        pack(&map(entries), &mut bytes);
        bytes
    }

    fn decode(bytes: &[u8]) -> WireEvent {
        let mut events = Vec::new();
        CoreDecoder.push(bytes, &mut |event| events.push(event));
        assert_eq!(events.len(), 1);
        events[0]
    }

    fn sample() -> WireSample {
        WireSample {
            t_device: Some(TimeNs(-323_801_612_345_000)),
            eye: SampleEye::Right,
            diameter_mm: 3.75,
            confidence: 0.875,
            aperture_mm: None,
            sequence: None,
            valid: true,
        }
    }

    fn message() -> Vec<(&'static str, Value)> {
        datum(0, -323_801.612_345, 0.875, Value::Double(3.75))
    }

    #[test]
    fn a_published_message_reads_as_its_fields() {
        let bytes = packed(&message());
        assert!((500..1500).contains(&bytes.len()), "{} bytes", bytes.len());
        assert_eq!(decode(&bytes), WireEvent::Sample(sample()));
        let other = packed(&datum(1, -323_801.612_345, 0.875, Value::Double(3.75)));
        assert_eq!(decode(&other), WireEvent::Sample(WireSample { eye: SampleEye::Left, ..sample() }));
        assert_ne!(decode(&other), WireEvent::Sample(sample()));
    }

    #[test]
    fn the_two_dimensional_detector_is_no_fault() {
        let mut entries = message();
        entries.retain(|(key, _)| !matches!(*key, "diameter_3d" | "sphere" | "circle_3d"));
        assert_eq!(decode(&packed(&entries)), WireEvent::Note);
    }

    #[test]
    fn pupil_remotes_time_is_a_reading_of_the_clock() {
        assert_eq!(decode(&time_message(-1.25)), WireEvent::Clock(TimeNs(-1_250_000_000)));
        assert_eq!(decode(&time_message(f64::NAN)), WireEvent::Rejected(WireFault::NotFinite));
    }

    #[test]
    fn what_pupil_did_not_see_is_handed_on_as_lost() {
        let lost = |confidence, diameter_mm| match decode(&packed(&datum(0, 1.0, confidence, diameter_mm))) {
            WireEvent::Sample(sample) => !sample.valid,
            event => panic!("{event:?}"),
        };
        assert!(lost(0.0, Value::Double(3.75)));
        assert!(lost(0.9, Value::Double(0.0)));
        assert!(lost(0.1, Value::Double(-0.11)));
        assert!(lost(0.9, Value::Double(f64::NAN)));
        // Too great and too small for the narrower type of a sample.
        assert!(lost(0.9, Value::Double(1e300)));
        assert!(lost(0.9, Value::Double(1e-300)));
        // A bad eyeball model is not for the decoder to judge.
        assert!(!lost(0.9, Value::Double(22.0)));
        assert!(!lost(0.1, Value::Single(3.0)));
        assert!(!lost(1.0, Value::Int(4)));
    }

    #[test]
    fn each_fault_has_its_reason() {
        let with = |key: &str, value: Value| {
            let mut entries = message();
            entries.iter_mut().filter(|(name, _)| *name == key).for_each(|(_, old)| *old = value.clone());
            packed(&entries)
        };
        let without = |key: &str| packed(&message().into_iter().filter(|(name, _)| *name != key).collect::<Vec<_>>());
        let mut longer = packed(&message());
        longer.push(0);
        let mut deep = vec![0x81, 0xa1, b'x'];
        deep.extend([0x91; 100]);
        deep.push(0);
        let cases = [
            (with("location", Value::Bytes(vec![0; 5000])), WireFault::TooLong),
            (packed(&message())[..400].to_vec(), WireFault::TooShort),
            (Vec::new(), WireFault::TooShort),
            (b"hello".to_vec(), WireFault::Malformed),
            (vec![0x81, 0x01, 0x01], WireFault::Malformed),
            (vec![0x81, 0xa1, b'x', 0xc1], WireFault::Malformed),
            // A map of 2^32 - 1 entries that are not there.
            (vec![0xdf, 0xff, 0xff, 0xff, 0xff], WireFault::TooShort),
            (vec![0x81, 0xa1, b'x', 0xdf, 0xff, 0xff, 0xff, 0xff], WireFault::TooShort),
            (deep, WireFault::Malformed),
            (longer, WireFault::Malformed),
            (without("id"), WireFault::MissingField),
            (without("timestamp"), WireFault::MissingField),
            (without("confidence"), WireFault::MissingField),
            (with("id", Value::Int(2)), WireFault::BadEye),
            (with("id", Value::Text("0".into())), WireFault::BadNumber),
            (with("diameter_3d", Value::Null), WireFault::BadNumber),
            (with("timestamp", Value::Double(f64::INFINITY)), WireFault::NotFinite),
            (with("confidence", Value::Double(1.01)), WireFault::BadConfidence),
            (with("confidence", Value::Double(f64::NAN)), WireFault::BadConfidence),
        ];
        for (bytes, fault) in cases {
            assert_eq!(decode(&bytes), WireEvent::Rejected(fault), "{bytes:02x?}");
        }
    }

    fn any_value() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::Bool),
            any::<i64>().prop_map(Value::Int),
            any::<f32>().prop_map(Value::Single),
            any::<f64>().prop_map(Value::Double),
            "[a-z]{0,40}".prop_map(Value::Text),
            prop::collection::vec(any::<u8>(), 0..300).prop_map(Value::Bytes),
        ];
        leaf.prop_recursive(4, 24, 5, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..20).prop_map(Value::List),
                prop::collection::vec(("[a-z]{1,5}", inner), 0..5).prop_map(Value::Map),
            ]
        })
    }

    proptest! {
        #[test]
        fn other_fields_do_not_matter(
            extra in prop::collection::vec(("x[a-z]{0,5}", any_value()), 0..4),
            at in 0..16_usize,
        ) {
            let mut entries: Vec<_> = message().into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
            for entry in extra {
                entries.insert(at, entry);
            }
            let mut bytes = Vec::new();
            pack(&Value::Map(entries), &mut bytes);
            prop_assume!(bytes.len() <= MAX_MESSAGE_BYTES);
            prop_assert_eq!(decode(&bytes), WireEvent::Sample(sample()));
        }

        #[test]
        fn a_cut_message_is_never_a_sample(keep in any::<prop::sample::Index>()) {
            let bytes = packed(&message());
            let cut = &bytes[..keep.index(bytes.len())];
            prop_assert_eq!(decode(cut), WireEvent::Rejected(WireFault::TooShort));
        }

        #[test]
        fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
            decode(&bytes);
        }

        #[test]
        fn no_wrong_byte_panics_or_yields_what_is_no_figure(at in any::<prop::sample::Index>(), byte in any::<u8>()) {
            let mut bytes = packed(&message());
            let at = at.index(bytes.len());
            bytes[at] = byte;
            if let WireEvent::Sample(sample) = decode(&bytes) {
                prop_assert!((0.0..=1.0).contains(&sample.confidence));
                prop_assert!(!sample.valid || sample.diameter_mm >= 0.0);
            }
        }
    }
}
