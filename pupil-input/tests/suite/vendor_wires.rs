//! What holds for the decoders of all named vendors: the split of the bytes does not matter, two messages after rubbish
//! are enough to be in step, no bytes make them panic or grow, and no sample costs an allocation.

use holod_pupil_input::SampleEye;
use holod_pupil_input::wire::iscan::{IscanDecoder, IscanPupil, IscanSettings};
use holod_pupil_input::wire::livetrack::{LiveTrackDecoder, LiveTrackSettings};
use holod_pupil_input::wire::open_gaze::{OpenGazeDecoder, OpenGazeSettings};
use holod_pupil_input::wire::pupilext::{
    PupilExtContainer, PupilExtDecoder, PupilExtEyes, PupilExtSettings, PupilExtSize,
};
use holod_pupil_input::wire::{Decoder, WireEvent, WireSample};
use holod_tests::counting::{self, Counting};
use proptest::prelude::*;

#[global_allocator]
static COUNTING: Counting = Counting;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Vendor {
    Iscan,
    PupilExtCsv,
    PupilExtJson,
    LiveTrack,
    OpenGaze,
}

impl Vendor {
    const ALL: [Self; 5] = [Self::Iscan, Self::PupilExtCsv, Self::PupilExtJson, Self::LiveTrack, Self::OpenGaze];

    fn decoder(self) -> Box<dyn Decoder> {
        let pupilext = |container| {
            let eyes = PupilExtEyes::One(SampleEye::Left);
            Box::new(PupilExtDecoder::new(PupilExtSettings {
                container,
                eyes,
                stereo: false,
                size: PupilExtSize::Millimetres,
            }))
        };
        match self {
            Self::Iscan => Box::new(IscanDecoder::new(IscanSettings {
                words: 3,
                pupils: vec![IscanPupil { eye: SampleEye::Left, word: 2, mm_per_count: 0.001 }],
                zero_is_lost: true,
            })),
            Self::PupilExtCsv => pupilext(PupilExtContainer::Csv { delimiter: b',' }),
            Self::PupilExtJson => pupilext(PupilExtContainer::Json),
            Self::LiveTrack => Box::new(LiveTrackDecoder::new(LiveTrackSettings {
                frames_per_second: Some(500.0),
                ..LiveTrackSettings::default()
            })),
            Self::OpenGaze => Box::new(OpenGazeDecoder::new(OpenGazeSettings::default())),
        }
    }

    /// A message about the left eye, `index` ms after the tracker's start.
    fn message(self, index: u64, micrometres: u16) -> Vec<u8> {
        let mm = f64::from(micrometres) / 1000.0;
        match self {
            Self::Iscan => {
                let words = [index as u16 & 0x3FFF, 512, micrometres];
                [0x44, 0x44].into_iter().chain(words.into_iter().flat_map(u16::to_le_bytes)).collect()
            }
            Self::PupilExtCsv => {
                format!("{index},PuRe,41.2,41.5,{mm},41.2,39.8,1.04,321,240,12.5,127,0.9,0.8,3,,36.5\n").into()
            }
            Self::PupilExtJson => format!(
                "{{\n  \"EyeData\": {{\n    \"A\": {{\n      \"Main\": {{\n        \"confidence\": \"0.9\",\n        \
                 \"message\": \"\\\"{{\",\n        \"physicalDiameter_mm\": \"{mm}\",\n        \
                 \"timestamp_ms\": \"{index}\"\n      }}\n    }}\n  }}\n}}\n\n"
            )
            .into(),
            Self::LiveTrack => {
                let area = std::f64::consts::PI * mm * mm / 4.0;
                format!("leftEye; {index:8}; 0;  12.50;  3.25; 600.00; {area:.6};\n\r").into()
            }
            Self::OpenGaze => format!(
                "<REC CNT=\"{index}\" TIME=\"{}\" BKID=\"0\" LPMM=\"{mm}\" LPMMV=\"1\" USER=\"a&gt;b\" />\r\n",
                index as f64 / 1000.0
            )
            .into(),
        }
    }
}

fn events_of(decoder: &mut dyn Decoder, bytes: &[u8]) -> Vec<WireEvent> {
    let mut events = Vec::new();
    decoder.push(bytes, &mut |event| events.push(event));
    events
}

fn diameters_mm(events: &[WireEvent]) -> Vec<f32> {
    let diameter_mm = |event: &WireEvent| match event {
        WireEvent::Sample(WireSample { eye: SampleEye::Left, diameter_mm, valid: true, .. }) => Some(*diameter_mm),
        _ => None,
    };
    events.iter().filter_map(diameter_mm).collect()
}

fn near(found_mm: &[f32], expected_micrometres: &[u16]) -> bool {
    let expected = expected_micrometres.iter().map(|&size| f32::from(size) / 1000.0);
    found_mm.len() == expected_micrometres.len() && found_mm.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-4)
}

#[test]
fn every_message_is_read() {
    for vendor in Vendor::ALL {
        let sizes: Vec<u16> = (0..200).map(|index| 2000 + 25 * index).collect();
        let bytes: Vec<_> = (0..).zip(&sizes).flat_map(|(index, &size)| vendor.message(index, size)).collect();
        let mut decoder = vendor.decoder();
        let events = events_of(&mut *decoder, &bytes);
        assert_eq!(events.len(), sizes.len(), "{vendor:?}");
        let found = diameters_mm(&events);
        assert!(near(&found, &sizes), "{vendor:?} {found:?}");
        // The comparison itself can fail.
        let mut wrong = sizes;
        wrong[77] += 1;
        assert!(!near(&found, &wrong));
    }
}

#[test]
fn samples_cost_no_allocation() {
    for vendor in Vendor::ALL {
        let bytes: Vec<_> = (0..500)
            .flat_map(|index| {
                let mut message = vendor.message(index, 3000);
                if index % 7 == 0 {
                    message.extend_from_slice(b"rubbish\n");
                }
                message
            })
            .collect();
        let mut decoder = vendor.decoder();
        let mut samples = 0;
        let before = counting::here();
        for chunk in bytes.chunks(61) {
            decoder.push(chunk, &mut |event| samples += u32::from(matches!(event, WireEvent::Sample(_))));
        }
        assert_eq!(counting::here() - before, 0, "{vendor:?}");
        assert!(samples > 350, "{vendor:?} {samples}");
    }
    let before = counting::here();
    drop(std::hint::black_box(Box::new(1)));
    assert_eq!(counting::here() - before, 1, "the count sees an allocation");
}

fn any_vendor() -> impl Strategy<Value = Vendor> {
    (0..Vendor::ALL.len()).prop_map(|index| Vendor::ALL[index])
}

/// Rubbish that has some of what messages begin and end with.
fn rubbish() -> impl Strategy<Value = Vec<u8>> {
    let words: [&[u8]; 14] =
        [b"\n", b"\r\n", b"{", b"}", b"\"", b"\\", b"[", b",", b"<REC ", b"/>", b"leftEye;", b"DD", b"D", b"\n{"];
    let piece = prop_oneof![
        prop::collection::vec(any::<u8>(), 0..30),
        (0..words.len()).prop_map(move |word| words[word].to_vec()),
    ];
    prop::collection::vec(piece, 0..40).prop_map(|pieces| pieces.concat())
}

/// Messages, whole and cut, with rubbish between.
fn stream(vendor: Vendor) -> impl Strategy<Value = Vec<u8>> {
    let piece = prop_oneof![
        4 => (0..10_000_u64, 0..9000_u16).prop_map(move |(index, size)| vendor.message(index, size)),
        1 => (0..10_000_u64, 0..9000_u16, any::<prop::sample::Index>()).prop_map(move |(index, size, cut)| {
            let mut message = vendor.message(index, size);
            message.truncate(cut.index(message.len()));
            message
        }),
        1 => rubbish(),
        1 => (0..6000_usize).prop_map(|length| vec![b'1'; length]),
    ];
    prop::collection::vec(piece, 0..12).prop_map(|pieces| pieces.concat())
}

proptest! {
    #[test]
    fn the_split_of_the_bytes_does_not_matter(
        (vendor, bytes) in any_vendor().prop_flat_map(|vendor| (Just(vendor), stream(vendor))),
        cuts in prop::collection::vec(1..70_usize, 1..20),
    ) {
        let mut whole = vendor.decoder();
        let mut expected = events_of(&mut *whole, &bytes);
        whole.finish(&mut |event| expected.push(event));
        let mut split = vendor.decoder();
        let mut events = Vec::new();
        let mut rest = &bytes[..];
        for &cut in cuts.iter().cycle() {
            if rest.is_empty() {
                break;
            }
            let (now, later) = rest.split_at(cut.min(rest.len()));
            split.push(now, &mut |event| events.push(event));
            rest = later;
        }
        split.finish(&mut |event| events.push(event));
        prop_assert_eq!(events, expected);
    }

    #[test]
    fn two_messages_after_rubbish_are_enough(
        vendor in any_vendor(),
        before in 0..5_u64,
        rubbish in rubbish(),
    ) {
        let mut bytes: Vec<_> = (0..before).flat_map(|index| vendor.message(index, 3000)).collect();
        bytes.extend(rubbish);
        let mut decoder = vendor.decoder();
        events_of(&mut *decoder, &bytes);
        // Sizes that rubbish does not hold.
        for (index, size) in [(1000, 4111), (1001, 4222)] {
            events_of(&mut *decoder, &vendor.message(index, size));
        }
        let later: Vec<_> = [(1002, 4333), (1003, 4444)]
            .into_iter()
            .flat_map(|(index, size)| events_of(&mut *decoder, &vendor.message(index, size)))
            .collect();
        prop_assert!(near(&diameters_mm(&later), &[4333, 4444]), "{:?}", later);
    }

    #[test]
    fn no_bytes_make_more_events_than_they_are(
        vendor in any_vendor(),
        bytes in prop_oneof![prop::collection::vec(any::<u8>(), 0..2000), rubbish()],
    ) {
        let mut decoder = vendor.decoder();
        let mut events = events_of(&mut *decoder, &bytes);
        decoder.finish(&mut |event| events.push(event));
        prop_assert!(events.len() <= bytes.len());
    }
}
