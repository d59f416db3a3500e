//! MeCom frames, as FISBA and Meerstetter devices take them: ASCII, a CRC-16 at the end of each. No I/O.
//!
//! `#` and an address, a sequence number, a payload, the CRC of all that, and CR; an answer begins with `!`. A device
//! acknowledges what it was told to set with the CRC of the request itself.

use std::fmt::Write as _;

use crc::{CRC_16_XMODEM, Crc};

/// Polynomial 0x1021, initial value 0, not reflected.
const CRC: Crc<u16> = Crc::<u16>::new(&CRC_16_XMODEM);

/// A device whatever its address is.
const ANY_ADDRESS: u8 = 0;

/// What is asked of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Request {
    /// The value of a parameter.
    Read {
        parameter: u16,
        /// Of which part of the device, from 1.
        instance: u8,
    },
    /// That a parameter be set.
    Write {
        parameter: u16,
        /// Of which part of the device, from 1.
        instance: u8,
        /// 32 bits: a whole number, or a floating-point number's.
        value: u32,
    },
}

/// What a device answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reply {
    /// A parameter's value as its 32 bits; of a floating-point one those of an `f32`.
    Value(u32),
    /// It has been set.
    Done,
    /// It could not; the device's own code.
    Error(u8),
}

/// The frame of `request`, with CR.
pub(super) fn frame(sequence: u16, request: Request) -> String {
    let mut frame = format!("#{ANY_ADDRESS:02X}{sequence:04X}");
    // Writing to a String cannot fail.
    let _always = match request {
        Request::Read { parameter, instance } => write!(frame, "?VR{parameter:04X}{instance:02X}"),
        Request::Write { parameter, instance, value } => write!(frame, "VS{parameter:04X}{instance:02X}{value:08X}"),
    };
    let crc = CRC.checksum(frame.as_bytes());
    let _always = write!(frame, "{crc:04X}\r");
    frame
}

/// The device's reply in `answer` (without CR) to the frame `request`; nothing where it is damaged or answers another.
pub(super) fn reply(request: &str, answer: &[u8]) -> Option<Reply> {
    let request = request.strip_suffix('\r').unwrap_or(request);
    let answer = std::str::from_utf8(answer).ok().filter(|answer| answer.is_ascii())?;
    let (text, crc) = answer.split_at_checked(answer.len().checked_sub(4)?)?;
    let rest = text.strip_prefix('!')?;
    // A device may give its own address in place of the one that any device hears.
    let (_address, rest) = rest.split_at_checked(2)?;
    let payload = rest.strip_prefix(&request[3..7])?;
    let own = format!("{:04X}", CRC.checksum(text.as_bytes()));
    let sound = crc.eq_ignore_ascii_case(&own);
    if payload.is_empty() {
        return (sound || crc.eq_ignore_ascii_case(&request[request.len() - 4..])).then_some(Reply::Done);
    }
    if !sound {
        return None;
    }
    if let Some(code) = payload.strip_prefix('+') {
        return u8::from_str_radix(code, 16).ok().map(Reply::Error);
    }
    let hex = payload.len() == 8 && payload.bytes().all(|byte| byte.is_ascii_hexdigit());
    u32::from_str_radix(payload, 16).ok().filter(|_| hex).map(Reply::Value)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(text: &str) -> Vec<u8> {
        format!("{text}{:04X}", CRC.checksum(text.as_bytes())).into_bytes()
    }

    #[test]
    fn frames_are_those_of_the_protocol() {
        assert_eq!(CRC.checksum(b"123456789"), 0x31C3);
        let read = frame(0x00A7, Request::Read { parameter: 100, instance: 1 });
        assert!(read.starts_with("#0000A7?VR006401") && read.ends_with('\r') && read.len() == 21, "{read}");
        let write = frame(1, Request::Write { parameter: 7013, instance: 2, value: 12.5f32.to_bits() });
        assert!(write.starts_with("#000001VS1B650241480000") && write.len() == 28, "{write}");
    }

    #[test]
    fn replies_are_taken_and_whatever_is_damaged_or_of_another_request_is_not() {
        let read = frame(7, Request::Read { parameter: 100, instance: 1 });
        let write = frame(8, Request::Write { parameter: 7006, instance: 1, value: 1 });
        let value = answer("!00000700000493");
        assert_eq!(reply(&read, &value), Some(Reply::Value(1171)));
        assert_eq!(reply(&read, &answer("!00000800000493")), None, "another sequence number");
        assert_eq!(reply(&write, &answer("!000008")), Some(Reply::Done));
        let crc_of_request = write.trim_end().as_bytes().last_chunk::<4>().unwrap();
        assert_eq!(reply(&write, &[b"!000008".as_slice(), crc_of_request].concat()), Some(Reply::Done));
        assert_eq!(reply(&write, b"!0000080000"), None);
        assert_eq!(reply(&read, &answer("!000007+06")), Some(Reply::Error(6)));
        for at in 0..value.len() {
            for bit in 0..7 {
                let mut damaged = value.clone();
                damaged[at] ^= 1 << bit;
                let same = damaged.eq_ignore_ascii_case(&value) && at + 4 >= value.len();
                assert_eq!(reply(&read, &damaged).is_some(), same, "byte {at} bit {bit}");
            }
        }
        for odd in [&b""[..], b"!", b"!00", b"\xff\xff\xff\xff\xff\xff", b"P1,1,1000,L,3.1,0.9*00"] {
            assert_eq!(reply(&read, odd), None);
        }
    }
}
