//! Messages of a fixed layout that come whole: a HID report, a datagram.

use super::field::{Bytes, Field, Fields, Layout};
use super::{Decoder, WireEvent, WireFault};

/// How reports are read. Every offset counts from the message's first byte, which is the report's id where it has one.
#[derive(Clone, Debug, PartialEq)]
pub struct ReportSettings {
    /// The first byte; a message that begins otherwise is another report's.
    pub id: Option<u8>,
    /// The fewest bytes of a report.
    pub least: usize,
    /// The most bytes; None where any number may follow.
    pub most: Option<usize>,
    /// At which bytes time, eye and pupils stand.
    pub layout: Layout<Field>,
}

/// Messages in, samples out; each push is one message.
#[derive(Clone, Debug)]
pub struct ReportDecoder {
    id: Option<u8>,
    least: usize,
    most: usize,
    fields: Fields<Field>,
}

impl ReportDecoder {
    /// A decoder of messages as these settings describe them.
    pub fn new(settings: &ReportSettings) -> Self {
        Self {
            id: settings.id,
            least: settings.least,
            most: settings.most.unwrap_or(usize::MAX),
            fields: Fields::new(settings.layout.clone()),
        }
    }
}

impl Decoder for ReportDecoder {
    fn push(&mut self, report: &[u8], on_event: &mut dyn FnMut(WireEvent)) {
        if report.is_empty() {
            return;
        }
        if self.id.is_some_and(|id| report[0] != id) {
            return on_event(WireEvent::Note);
        }
        let read = if report.len() < self.least {
            Err(WireFault::TooShort)
        } else if report.len() > self.most {
            Err(WireFault::TooLong)
        } else {
            self.fields.read(&Bytes(report), on_event)
        };
        if let Err(fault) = read {
            on_event(WireEvent::Rejected(fault));
        }
    }

    fn finish(&mut self, _: &mut dyn FnMut(WireEvent)) {}
}

#[cfg(test)]
mod tests {
    use holod_calibration::TimeNs;
    use proptest::prelude::*;

    use super::*;
    use crate::SampleEye;
    use crate::profile::Profile;
    use crate::wire::testing::events_of;
    use crate::wire::{Format, WireSample};

    /// Report 1 of `holod-hid`: 1 s, number 65535, left 3.25 mm seen, right not.
    const REPORT: [u8; 15] = [1, 0x40, 0x42, 0x0F, 0, 0xFF, 0xFF, 0xB2, 0x0C, 255, 1, 0, 0, 0, 0xFE];

    fn decode(reports: &[&[u8]]) -> Vec<WireEvent> {
        let mut decoder = Profile::find("holod-hid").unwrap().decoder();
        let mut events = Vec::new();
        reports.iter().for_each(|report| decoder.push(report, &mut |event| events.push(event)));
        decoder.finish(&mut |event| events.push(event));
        events
    }

    #[test]
    fn the_reference_report_reads_as_its_fields() {
        let left = WireSample {
            t_device: Some(TimeNs(1_000_000_000)),
            eye: SampleEye::Left,
            diameter_mm: 3.25,
            confidence: 1.0,
            aperture_mm: None,
            sequence: Some(65535),
            valid: true,
        };
        let right = WireSample { eye: SampleEye::Right, diameter_mm: 0.0, confidence: 0.0, valid: false, ..left };
        let both = [WireEvent::Sample(left), WireEvent::Sample(right)];
        assert_eq!(decode(&[&REPORT]), both);
        // A report is as long as the device's longest one.
        let padded = [&REPORT[..], &[0; 49]].concat();
        assert_eq!(decode(&[&padded]), both);
        // The running number goes on where its 16 bits begin again.
        let mut next = REPORT;
        (next[5], next[6]) = (0, 0);
        let events = decode(&[&REPORT, &next]);
        assert!(matches!(events[2], WireEvent::Sample(WireSample { sequence: Some(65536), .. })), "{events:?}");
    }

    #[test]
    fn other_reports_are_notes_and_wrong_lengths_are_faults() {
        assert_eq!(decode(&[&[2, 0, 0], &[]]), [WireEvent::Note]);
        assert_eq!(decode(&[&REPORT[..14]]), [WireEvent::Rejected(WireFault::TooShort)]);
        let Format::Report(settings) = Profile::find("holod-hid").unwrap().format else { panic!() };
        let exact = ReportSettings { most: Some(15), ..settings };
        let long = [&REPORT[..], &[0]].concat();
        let events = events_of(&mut ReportDecoder::new(&exact), &long);
        assert_eq!(events, [WireEvent::Rejected(WireFault::TooLong)]);
    }

    proptest! {
        #[test]
        fn no_report_panics(bytes in prop::collection::vec(any::<u8>(), 0..80)) {
            let mut bytes = bytes;
            decode(&[&bytes]);
            bytes.insert(0, 1);
            decode(&[&bytes]);
        }
    }
}
