//! ISCAN eye trackers (ETL series): binary packets over a serial port, 115200 8N1.
//!
//! The host sends 0x80 to start and 0x81 to stop. A packet is the two bytes 0x44 0x44 and then as many little-endian
//! 16-bit words as the operator has ticked outputs, in the order of the tracker's list; one of them may be a pupil
//! diameter. Words are tenths of the tracker's unit. There is no time, no checksum and no length, and the two bytes may
//! stand in the data as well. All words are 0 while no pupil is seen. (Layout: the ISCAN drivers of MWorks and of
//! pype.)

use super::buffer::Buffer;
use super::{Decoder, WireEvent, WireFault, WireSample};
use crate::SampleEye;

/// What begins a packet.
const SYNC: [u8; 2] = [0x44, 0x44];

/// A pupil among the words of a packet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IscanPupil {
    /// Which eye its samples are of.
    pub eye: SampleEye,
    /// Which word is its diameter, counted from 0.
    pub word: usize,
    /// Millimetres (or the tracker's unit, where the rig knows the scale) for a count of 1.
    pub mm_per_count: f32,
}

/// How the operator has set the tracker up.
#[derive(Clone, Debug, PartialEq)]
pub struct IscanSettings {
    /// Words of a packet, at least 1.
    pub words: usize,
    /// The pupils among them; one that is not among them is a fault in every packet.
    pub pupils: Vec<IscanPupil>,
    /// A pupil whose word is 0 is lost. Else 0 is a diameter.
    pub zero_is_lost: bool,
}

/// Bytes in, a sample for each pupil of each packet out.
///
/// It is in step when two packets' beginnings have been found a packet's length apart, and falls out of step at the
/// first packet that does not begin where it should; then it searches again from the packet before.
#[derive(Clone, Debug)]
pub struct IscanDecoder {
    settings: IscanSettings,
    packet_bytes: usize,
    /// What is kept: in step, the packet before and what has come of this one; else what is searched.
    kept: Buffer,
    /// Where in `kept` this packet begins, or what is not searched yet.
    at: usize,
    step: Step,
    /// Bytes that may still be skipped before that is a fault.
    patience: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// Nothing has been told yet.
    Joining,
    Lost,
    In,
}

impl IscanDecoder {
    /// A decoder for a stream that may be joined in the middle of a packet.
    pub fn new(settings: IscanSettings) -> Self {
        let packet_bytes = SYNC.len() + 2 * settings.words.max(1);
        Self {
            settings,
            packet_bytes,
            kept: Buffer::new(4 * packet_bytes),
            at: 0,
            step: Step::Joining,
            patience: packet_bytes,
        }
    }

    /// Reads what has come, as far as it is enough.
    fn advance(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        let length = self.packet_bytes;
        loop {
            let come = self.kept.held().len() - self.at;
            if self.step != Step::In {
                if come < length + SYNC.len() {
                    return;
                }
                if self.begins_at(self.at) && self.begins_at(self.at + length) {
                    if self.step == Step::Joining && self.patience < length {
                        on_event(WireEvent::Partial);
                    }
                    self.step = Step::In;
                } else {
                    self.skip(on_event);
                }
            } else if come < SYNC.len() {
                return;
            } else if !self.begins_at(self.at) {
                on_event(WireEvent::Rejected(WireFault::OutOfStep));
                self.step = Step::Lost;
                self.patience = 2 * length;
                // The packet before may have lost bytes, and this one begun in it.
                self.at = self.at.saturating_sub(length) + 1;
            } else if come < length {
                return;
            } else {
                tell(&self.settings, &self.kept.held()[self.at + SYNC.len()..self.at + length], on_event);
                self.kept.drop_front(self.at);
                self.at = length;
            }
        }
    }

    fn begins_at(&self, at: usize) -> bool {
        self.kept.held()[at..].starts_with(&SYNC)
    }

    fn skip(&mut self, on_event: &mut dyn FnMut(WireEvent)) {
        self.at += 1;
        self.patience -= 1;
        if self.patience == 0 {
            on_event(WireEvent::Rejected(WireFault::OutOfStep));
            self.step = Step::Lost;
            self.patience = self.packet_bytes;
        }
        if self.at == self.packet_bytes {
            self.kept.drop_front(self.at);
            self.at = 0;
        }
    }
}

impl Decoder for IscanDecoder {
    fn push(&mut self, mut bytes: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        while !bytes.is_empty() {
            bytes = self.kept.fill(bytes);
            self.advance(on_event);
        }
    }

    fn finish(&mut self, _on_event: &mut dyn FnMut(WireEvent)) {
        self.kept.clear();
        self.at = 0;
        self.step = Step::Joining;
        self.patience = self.packet_bytes;
    }
}

fn tell(settings: &IscanSettings, words: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
    if settings.pupils.is_empty() {
        return on_event(WireEvent::Note);
    }
    for pupil in &settings.pupils {
        on_event(match words.chunks_exact(2).nth(pupil.word) {
            Some(word) => {
                let count = u16::from_le_bytes([word[0], word[1]]);
                WireEvent::Sample(WireSample {
                    t_device: None,
                    eye: pupil.eye,
                    diameter_mm: f32::from(count) * pupil.mm_per_count,
                    confidence: 1.0,
                    aperture_mm: None,
                    sequence: None,
                    valid: count != 0 || !settings.zero_is_lost,
                })
            }
            None => WireEvent::Rejected(WireFault::MissingField),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> IscanSettings {
        IscanSettings {
            words: 4,
            pupils: vec![
                IscanPupil { eye: SampleEye::Left, word: 2, mm_per_count: 0.1 },
                IscanPupil { eye: SampleEye::Right, word: 3, mm_per_count: 0.01 },
            ],
            zero_is_lost: true,
        }
    }

    fn decode(bytes: &[u8]) -> Vec<WireEvent> {
        let mut events = Vec::new();
        IscanDecoder::new(settings()).push(bytes, &mut |event| events.push(event));
        events
    }

    fn packet(words: [u16; 4]) -> [u8; 10] {
        let mut packet = [0x44; 10];
        packet[2..].iter_mut().zip(words.into_iter().flat_map(u16::to_le_bytes)).for_each(|(to, from)| *to = from);
        packet
    }

    fn sample(eye: SampleEye, diameter_mm: f32) -> WireEvent {
        WireEvent::Sample(WireSample {
            t_device: None,
            eye,
            diameter_mm,
            confidence: 1.0,
            aperture_mm: None,
            sequence: None,
            valid: diameter_mm != 0.0,
        })
    }

    fn samples(left_count: u16, right_count: u16) -> [WireEvent; 2] {
        [sample(SampleEye::Left, f32::from(left_count) * 0.1), sample(SampleEye::Right, f32::from(right_count) * 0.01)]
    }

    const OUT_OF_STEP: WireEvent = WireEvent::Rejected(WireFault::OutOfStep);

    #[test]
    fn known_packets_read_as_their_words() {
        let bytes = [
            0x44, 0x44, 0x01, 0x00, 0x02, 0x00, 0x28, 0x00, 0x2C, 0x01, //
            0x44, 0x44, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
        ];
        assert_eq!(decode(&bytes), [samples(40, 300), samples(0, 0)].concat());
        let figure = |event| if let WireEvent::Sample(sample) = event { sample.diameter_mm } else { f32::NAN };
        assert_eq!(decode(&bytes).into_iter().map(figure).collect::<Vec<_>>(), [4.0, 3.0, 0.0, 0.0]);
    }

    #[test]
    fn a_word_that_the_packet_lacks_is_a_fault_and_zero_may_be_a_size() {
        let pupils = vec![IscanPupil { eye: SampleEye::Both, word: 4, mm_per_count: 1.0 }];
        let mut decoder = IscanDecoder::new(IscanSettings { pupils, zero_is_lost: false, ..settings() });
        let mut events = Vec::new();
        decoder.push(&[packet([0; 4]); 2].concat(), &mut |event| events.push(event));
        assert_eq!(events, [WireEvent::Rejected(WireFault::MissingField); 2]);
        decoder.settings.pupils[0].word = 3;
        decoder.push(&packet([0; 4]), &mut |event| events.push(event));
        assert!(matches!(events[2], WireEvent::Sample(WireSample { valid: true, diameter_mm: 0.0, .. })));
    }

    #[test]
    fn joining_in_the_middle_of_a_packet_is_no_fault() {
        let bytes = [&packet([1; 4])[3..], &packet([2; 4]), &packet([3; 4])].concat();
        assert_eq!(decode(&bytes), [vec![WireEvent::Partial], samples(2, 2).into(), samples(3, 3).into()].concat());
    }

    #[test]
    fn one_beginning_is_not_enough() {
        // The data hold the sync where a packet might begin, but none stands a packet's length behind it.
        let bytes = [&packet([1, 0x4444, 7, 8])[3..], &packet([2; 4]), &packet([3; 4])].concat();
        assert_eq!(decode(&bytes)[0], WireEvent::Partial);
        assert_eq!(decode(&bytes)[1..], [samples(2, 2), samples(3, 3)].concat());
        assert_eq!(decode(&packet([1; 4])), []);
    }

    #[test]
    fn lost_and_added_bytes_cost_one_packet() {
        let (before, after) = ([packet([1; 4]); 3].concat(), [packet([2; 4]); 3].concat());
        let events = decode(&[&before, &packet([9; 4])[..7], &after].concat());
        // The cut packet is filled up with the next one's first bytes before that can be told.
        assert_eq!(events[..6], [samples(1, 1); 3].concat());
        assert_eq!(events[8..], [vec![OUT_OF_STEP], [samples(2, 2); 3].concat()].concat());
        let events = decode(&[&before[..], b"noise", &after].concat());
        assert_eq!(events, [[samples(1, 1); 3].concat(), vec![OUT_OF_STEP], [samples(2, 2); 3].concat()].concat());
    }

    #[test]
    fn rubbish_is_told_once_a_packets_length() {
        assert_eq!(decode(&[0; 1000]), [OUT_OF_STEP; 98]);
    }
}
