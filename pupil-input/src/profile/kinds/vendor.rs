//! The `[wire]` of trackers whose formats are their makers'.

use holod_calibration::toml_reader::{Found, Section};

use super::context::{Context, PUPILS};
use crate::SampleEye;
use crate::size_unit::SizeUnit;
use crate::wire::Format;
use crate::wire::field::SizeKind;
use crate::wire::iscan::{IscanPupil, IscanSettings};
use crate::wire::livetrack::{LiveTrackSettings, LiveTrackSize};
use crate::wire::open_gaze::{OpenGazeSettings, OpenGazeSize};
use crate::wire::pupilext::{PupilExtContainer, PupilExtEyes, PupilExtSettings, PupilExtSize};

/// Words of the longest ISCAN packet.
const ISCAN_WORDS_MAX: i64 = 64;
/// A word is in tenths of the tracker's unit.
const ISCAN_SCALE: f64 = 0.1;
/// Columns of the longest LiveTrack row.
const LIVETRACK_COLUMNS_MAX: i64 = 32;

pub(super) fn read_iscan(wire: &Section<'_>, context: &Context<'_>) -> Option<IscanSettings> {
    let words = wire.require("words", "how many words a packet has: the outputs ticked on the tracker");
    let words = words.and_then(|words| words.integer(1..=ISCAN_WORDS_MAX))?;
    let zero_is_lost = wire.flag("zero_is_lost", true);
    let diameters = match context.size.kind {
        SizeKind::Diameter => 1.0,
        SizeKind::Radius => 2.0,
        SizeKind::Area => {
            wire.fault("areas", "diameters or radii, which is what an ISCAN gives", "correct [size] kind");
            return None;
        }
    };
    let mut pupils: Vec<IscanPupil> = Vec::new();
    for (key, own_eye) in PUPILS {
        let table = wire.section(key);
        if !table.is_there() {
            continue;
        }
        let word = table.require("word", "which word is the pupil's diameter, from 1");
        let word = word.and_then(|word| word.integer(1..=words));
        let scale = table.positive("scale").unwrap_or(ISCAN_SCALE);
        table.finish();
        let eye = own_eye.or(context.eye.as_ref().map(|eye| eye.value));
        let Some(eye) = eye else {
            let advice = "or name the table after its eye, as [wire.left]";
            table.fault("no word on its eye", "an eye: `eye = \"left\"` at the top of the file", advice);
            continue;
        };
        let Some(word) = word else { continue };
        let word = word as usize - 1;
        if pupils.iter().any(|other| other.word == word) {
            table.fault("the word of another pupil", "one word for one pupil", "give each pupil a word of its own");
        }
        let mm_per_count = (scale * diameters * context.size.mm_per_unit) as f32;
        pupils.push(IscanPupil { eye, word, mm_per_count });
    }
    if !PUPILS.iter().any(|(key, _)| wire.has(key)) {
        let advice = "add for example left = { word = 3 }";
        wire.fault("no pupil", "at least one of left, right, both and pupil", advice);
    }
    Some(IscanSettings { words: words as usize, pupils, zero_is_lost })
}

pub(super) fn read_livetrack(wire: &Section<'_>, context: &Context<'_>) -> Option<(Format, SizeUnit)> {
    const EXPECTED: &str = "one of { area = 7 }, { diameter = 7 }, { axes = [7, 8] }, columns from 1, the label's";
    let usual = LiveTrackSettings::default();
    let table = wire.section("size");
    let columns = 4..=LIVETRACK_COLUMNS_MAX;
    let place = |column: i64| column as usize - 1;
    let mut sizes = Vec::new();
    sizes.extend(table.integer("area", columns.clone()).map(|column| LiveTrackSize::Area(place(column))));
    sizes.extend(table.integer("diameter", columns.clone()).map(|column| LiveTrackSize::Diameter(place(column))));
    if let Some(axes) = table.get("axes") {
        let items = axes.items(EXPECTED);
        let axis = |item: &Found<'_, _>| item.with(&item.value).integer(columns.clone());
        match items.iter().map(axis).collect::<Option<Vec<_>>>().as_deref() {
            Some([width, height]) => sizes.push(LiveTrackSize::Axes(place(*width), place(*height))),
            Some(other) => axes.fault(format!("{} columns", other.len()), EXPECTED, "name width and height"),
            None => {}
        }
    }
    table.finish();
    if table.is_there() && sizes.len() != 1 {
        table.fault(&format!("{} sizes", sizes.len()), EXPECTED, "name one");
        return None;
    }
    let counter_bits = wire.integer("counter_bits", 1..=63).map_or(usual.counter_bits, |bits| bits as u32);
    let settings = LiveTrackSettings {
        size: sizes.pop().unwrap_or(usual.size),
        frames_per_second: context.frames_per_second(),
        counter_bits,
        mono_eye: context.eye.as_ref().map_or(usual.mono_eye, |eye| eye.value),
    };
    Some((Format::LiveTrack(settings), SizeUnit::Pixels))
}

pub(super) fn read_open_gaze(wire: &Section<'_>, context: &Context<'_>) -> (Format, SizeUnit) {
    refuse_eye(context);
    let sizes = [
        ("mm", (OpenGazeSize::Millimetres, SizeUnit::Millimetres)),
        ("pixels", (OpenGazeSize::Pixels, SizeUnit::Pixels)),
    ];
    let (size, unit) = wire.choice("size", &sizes, false).map_or(sizes[0].1, |size| size.value);
    let ticks_per_second = wire.positive("ticks_per_second");
    (Format::OpenGaze(OpenGazeSettings { size, ticks_per_second }), unit)
}

pub(super) fn read_pupilext(wire: &Section<'_>, context: &Context<'_>) -> (Format, SizeUnit) {
    const DELIMITER: &str = "one character such as \",\"";
    let json = wire.choice("container", &[("csv", false), ("json", true)], false).is_some_and(|json| json.value);
    let delimiter = wire.get("delimiter").and_then(|found| match *found.raw_text(DELIMITER)?.as_bytes() {
        [byte] if byte.is_ascii() && !json => Some(byte),
        _ => {
            found.fault(found.value.to_string().trim(), DELIMITER, "and only for container = \"csv\"");
            None
        }
    });
    let container =
        if json { PupilExtContainer::Json } else { PupilExtContainer::Csv { delimiter: delimiter.unwrap_or(b',') } };
    let two = wire.choice("eyes", &[("one", false), ("two", true)], false).is_some_and(|two| two.value);
    let eyes = if two {
        refuse_eye(context);
        PupilExtEyes::Two
    } else {
        PupilExtEyes::One(context.eye.as_ref().map_or(SampleEye::Both, |eye| eye.value))
    };
    let sizes = [
        ("mm", (PupilExtSize::Millimetres, SizeUnit::Millimetres)),
        ("pixels", (PupilExtSize::Pixels, SizeUnit::Pixels)),
        ("undistorted-pixels", (PupilExtSize::UndistortedPixels, SizeUnit::Pixels)),
    ];
    let (size, unit) = wire.choice("size", &sizes, false).map_or(sizes[0].1, |size| size.value);
    (Format::PupilExt(PupilExtSettings { container, eyes, stereo: wire.flag("stereo", false), size }), unit)
}

fn refuse_eye(context: &Context<'_>) {
    if let Some(found) = &context.eye {
        found.fault(found.value, "no eye here: the wire tells it", "take it out");
    }
}

#[cfg(test)]
mod tests {
    use crate::SampleEye;
    use crate::profile::Profile;
    use crate::profile::parse::parse;
    use crate::size_unit::SizeUnit;
    use crate::wire::testing::events_of;
    use crate::wire::{WireEvent, WireSample};

    /// What is wrong with `keys` behind a `[wire]` of that kind.
    fn faults(kind: &str, keys: &str) -> String {
        let head = format!("format = \"holod-tracker-1\"\nname = \"x\"\n[wire]\nkind = \"{kind}\"\n");
        let faults = parse(&format!("{head}{keys}")).err().unwrap_or_default();
        faults.iter().map(|fault| format!("{fault}\n")).collect()
    }

    #[test]
    fn each_mistake_is_told_with_its_line_and_key() {
        let cases = [
            ("iscan", "", "line 3, wire.words: found nothing"),
            ("iscan", "words = 0", "line 5, wire.words: found 0"),
            ("iscan", "words = 3", "line 3, wire: found no pupil"),
            ("iscan", "words = 3\nleft = {}", "line 6, wire.left.word: found nothing"),
            (
                "iscan",
                "words = 3\nleft = { word = 4 }",
                "line 6, wire.left.word: found 4; expected a whole number from 1 to 3",
            ),
            ("iscan", "words = 3\nleft = { word = 1, scale = 0 }", "wire.left.scale: found 0"),
            ("iscan", "words = 3\npupil = { word = 1 }", "line 6, wire.pupil: found no word on its eye"),
            (
                "iscan",
                "words = 3\nleft = { word = 1 }\nright = { word = 1 }",
                "line 7, wire.right: found the word of another",
            ),
            ("iscan", "words = 3\nleft = { word = 1 }\nzero = true", "wire.zero: found an unknown key"),
            ("iscan", "words = 3\nleft = { word = 1 }\n[size]\nkind = \"area\"", "wire: found areas"),
            ("livetrack", "size = { area = 3 }", "line 5, wire.size.area: found 3; expected a whole number from 4"),
            ("livetrack", "size = { axes = [7] }", "line 5, wire.size.axes: found 1 columns"),
            ("livetrack", "size = { area = 7, diameter = 8 }", "line 5, wire.size: found 2 sizes"),
            ("livetrack", "counter_bits = 64", "line 5, wire.counter_bits: found 64"),
            ("livetrack", "[size]\nkind = \"area\"", "line 5, size: found a table; expected none for \"livetrack\""),
            (
                "open-gaze",
                "size = \"metres\"",
                "line 5, wire.size: found \"metres\"; expected one of \"mm\", \"pixels\"",
            ),
            ("open-gaze", "ticks_per_second = -1", "line 5, wire.ticks_per_second: found -1"),
            (
                "pupilext",
                "container = \"xml\"",
                "line 5, wire.container: found \"xml\"; expected one of \"csv\", \"json\"",
            ),
            ("pupilext", "delimiter = \"ab\"", "line 5, wire.delimiter: found \"ab\""),
            ("pupilext", "container = \"json\"\ndelimiter = \",\"", "line 6, wire.delimiter: found \",\""),
            ("pupilext", "eyes = \"three\"", "line 5, wire.eyes: found \"three\""),
            ("pupilext", "stereo = 1", "line 5, wire.stereo: found an integer 1"),
            ("holod", "[size]\nmm_per_unit = 2", "line 5, size: found a table; expected none for \"holod\""),
        ];
        for (kind, keys, told) in cases {
            let found = faults(kind, keys);
            assert!(found.contains(told), "{kind} {keys}\n  does not tell {told}\n  but {found}");
        }
        let right =
            [("iscan", "words = 3\nleft = { word = 1 }"), ("livetrack", ""), ("open-gaze", ""), ("pupilext", "")];
        right.into_iter().for_each(|(kind, keys)| assert_eq!(faults(kind, keys), "", "{kind}"));
    }

    /// The last sample of `bytes` by the shipped profile, and what its sizes are.
    fn decoded(name: &str, bytes: &[u8]) -> (WireSample, SizeUnit) {
        let profile = Profile::find(name).unwrap();
        let events = events_of(&mut *profile.decoder(), bytes);
        match events.last() {
            Some(WireEvent::Sample(sample)) => (*sample, profile.unit),
            _ => panic!("{name}: {events:?}"),
        }
    }

    #[test]
    fn each_shipped_profile_reads_its_trackers_bytes() {
        let packet = [0x44, 0x44, 10, 0, 20, 0, 0x2C, 0x01];
        let (sample, unit) = decoded("iscan-etl", &[packet; 4].concat());
        assert_eq!((sample.eye, sample.diameter_mm, unit), (SampleEye::Both, 30.0, SizeUnit::Arbitrary));

        let row = b"leftEye; 1500; 0; 12.50; 3.25; 600.00; 1256.637;\r\n";
        let (sample, unit) = decoded("livetrack", &[&row[..], row].concat());
        assert_eq!((sample.eye, sample.diameter_mm.round(), unit), (SampleEye::Left, 40.0, SizeUnit::Pixels));

        let record = b"<REC CNT=\"7\" TIME=\"5.5\" LPMM=\"4.80\" LPMMV=\"1\" RPMM=\"5.00\" RPMMV=\"1\" />\r\n";
        let (sample, unit) = decoded("open-gaze", &[&record[..], record].concat());
        assert_eq!((sample.eye, sample.diameter_mm, unit), (SampleEye::Right, 5.0, SizeUnit::Millimetres));

        let row = b"1700000000123,PuRe,41.2,41.5,3.25,41.2,39.8,1.03518,321.5,240.25,12.5,127.3,0.95,0.875,3,no message,36.5\n";
        let (sample, _) = decoded("pupilext-csv", &[&row[..], row].concat());
        assert_eq!((sample.eye, sample.diameter_mm), (SampleEye::Both, 3.25));

        let object = b"{\"EyeData\":{\"A\":{\"Main\":{\"diameter_px\":\"41.2\",\"physicalDiameter_mm\":\"3.25\",\
                       \"timestamp_ms\":\"1700000000123\",\"confidence\":\"0.95\",\"outlineConfidence\":\"0.875\"}}}}\n";
        let (sample, _) = decoded("pupilext-json", &[&object[..], object].concat());
        assert_eq!((sample.eye, sample.diameter_mm), (SampleEye::Both, 3.25));
    }
}
