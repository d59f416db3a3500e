//! XDF, the recordings of the Lab Streaming Layer (<https://github.com/sccn/xdf/wiki/Specifications>).
//!
//! After the four bytes `XDF:` come chunks: the number of bytes of their length (1, 4 or 8), the length, a tag of two
//! bytes, the content; all little-endian. The file is read twice: once for the streams, how many samples each has and
//! their clock offsets, which come all along it, once for the samples.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::io::{self, BufRead, Read};

use holod_calibration::{Sorted, TimeNs};
use roxmltree::{Document, Node, ParsingOptions};

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use super::size::{ARBITRARY, MILLIMETRES, Measure, PIXELS, Said, Unit};
use super::table::ns_of;
use super::text::share;
use crate::SampleEye;
use crate::size_unit::SizeUnit;
use crate::wire::WireFault;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Xdf, recognises, read };

const MAGIC: &[u8] = b"XDF:";
const STREAM_HEADER: u16 = 2;
const SAMPLES: u16 = 3;
const CLOCK_OFFSET: u16 = 4;
const TAGS: std::ops::RangeInclusive<u16> = 1..=6;
/// What a boundary chunk holds, for readers that have lost their step.
const BOUNDARY: [u8; 16] =
    [0x43, 0xA5, 0x46, 0xDC, 0xCB, 0xF5, 0x41, 0x0F, 0xB3, 0x0E, 0xD5, 0x46, 0x73, 0x83, 0xCB, 0xE4];
/// Bounds of what is kept in memory.
const MAX_XML_BYTES: u64 = 1 << 22;
const MAX_XML_NODES: u32 = 200_000;
const MAX_STREAMS: usize = 1024;
const MAX_CHANNELS: usize = 1 << 14;
const MAX_OFFSETS: usize = 1 << 18;

fn recognises(input: &LogInput<'_>) -> bool {
    input.head.starts_with(MAGIC)
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let mut streams = BTreeMap::new();
    let damage = for_chunks(input, |chunk| match chunk.tag {
        STREAM_HEADER => take_header(chunk, &mut streams, log),
        SAMPLES => survey(chunk, &mut streams),
        CLOCK_OFFSET => take_offset(chunk, &mut streams),
        _ => Ok(()),
    })?;
    (0..damage.out_of_step).for_each(|_| log.count(LogFault::Wire(WireFault::OutOfStep)));
    (0..damage.too_short).for_each(|_| log.count(LogFault::Wire(WireFault::TooShort)));
    choose(&mut streams, log).map_err(|found| ReplayError::Content {
        path: input.path.into(),
        at: String::new(),
        found,
        expected: "a stream with samples and a channel whose label or type tells of a pupil's diameter".into(),
    })?;
    for stream in streams.values_mut() {
        stream.clock = Clocks::of(&std::mem::take(&mut stream.offsets));
        let resets = stream.clock.spans.len().saturating_sub(1);
        if resets > 0 && !stream.taken.is_empty() {
            let times = if resets == 1 { "once".to_owned() } else { format!("{resets} times") };
            log.warn(format!(
                "the clock of the stream `{}` was set or started again {times} in the recording: each part was put on the \
                 recorder's clock by its own offsets",
                stream.name.escape_debug()
            ));
        }
    }
    let mut record = 0;
    let damage = for_chunks(input, |chunk| match chunk.tag {
        SAMPLES => take_samples(chunk, &mut streams, log, &mut record),
        _ => Ok(()),
    })?;
    (0..damage.too_short).for_each(|_| log.count(LogFault::Wire(WireFault::TooShort)));
    for stream in streams.values().filter(|stream| stream.moved > 0) {
        log.note(format!(
            "{} samples of {} have stamps before those of the samples ahead of them, as where a busy machine pushes them late: \
             each was put 0.1 ms behind the one before it",
            stream.moved,
            stream.described()
        ));
    }
    Ok(())
}

/// A chunk whose content has not been read yet.
struct Chunk<'a> {
    tag: u16,
    content: io::Take<&'a mut dyn BufRead>,
}

impl Chunk<'_> {
    fn bytes<const N: usize>(&mut self) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.content.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// A number that is preceded by how many bytes it has.
    fn variable_length(&mut self) -> io::Result<u64> {
        variable_length(&mut self.content)?.ok_or_else(|| io::Error::from(io::ErrorKind::InvalidData))
    }
}

/// None if the number of bytes is none of 1, 4 and 8.
fn variable_length(reader: &mut dyn Read) -> io::Result<Option<u64>> {
    let mut count = [0];
    reader.read_exact(&mut count)?;
    let mut bytes = [0; 8];
    let Some(used) = bytes.get_mut(..usize::from(count[0])).filter(|used| matches!(used.len(), 1 | 4 | 8)) else {
        return Ok(None);
    };
    reader.read_exact(used)?;
    Ok(Some(u64::from_le_bytes(bytes)))
}

/// What was wrong with the chunks.
#[derive(Clone, Copy, Debug, Default)]
struct Damage {
    /// Times at which no chunk began where one should have.
    out_of_step: u64,
    /// Chunks that end before what they hold.
    too_short: u64,
}

/// Goes through the chunks. From where no chunk begins, reading goes on behind the next boundary; a file that is cut
/// off ends where it is cut off.
fn for_chunks(
    input: &LogInput<'_>,
    mut take: impl FnMut(&mut Chunk<'_>) -> io::Result<()>,
) -> Result<Damage, ReplayError> {
    let mut reader = input.open()?;
    let mut damage = Damage::default();
    io::copy(&mut (&mut reader).take(MAGIC.len() as u64), &mut io::sink()).map_err(|source| input.io(source))?;
    loop {
        match reader.fill_buf() {
            Ok([]) => return Ok(damage),
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(source) => return Err(input.io(source)),
        }
        let header = match chunk_header(&mut *reader) {
            Err(error) if is_of_content(&error) => None,
            header => header.map_err(|source| input.io(source))?,
        };
        let Some((tag, length)) = header else {
            damage.out_of_step += 1;
            if !seek_boundary(&mut *reader).map_err(|source| input.io(source))? {
                return Ok(damage);
            }
            continue;
        };
        let mut chunk = Chunk { tag, content: (&mut *reader as &mut dyn BufRead).take(length) };
        match take(&mut chunk) {
            Ok(()) => {}
            Err(error) if is_of_content(&error) => damage.too_short += 1,
            Err(source) => return Err(input.io(source)),
        }
        io::copy(&mut chunk.content, &mut io::sink()).map_err(|source| input.io(source))?;
    }
}

/// Tag and length of the content; None where no chunk begins.
fn chunk_header(reader: &mut dyn BufRead) -> io::Result<Option<(u16, u64)>> {
    let Some(length) = variable_length(reader)? else { return Ok(None) };
    let mut tag = [0; 2];
    reader.read_exact(&mut tag)?;
    let tag = u16::from_le_bytes(tag);
    Ok(length.checked_sub(2).filter(|_| TAGS.contains(&tag)).map(|length| (tag, length)))
}

/// Whether the bytes are at fault rather than the reading of them.
fn is_of_content(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::UnexpectedEof | io::ErrorKind::InvalidData)
}

/// Reads past the next boundary; false if there is none.
fn seek_boundary(reader: &mut dyn BufRead) -> io::Result<bool> {
    let mut window = [0; BOUNDARY.len()];
    loop {
        let bytes = reader.fill_buf()?;
        if bytes.is_empty() {
            return Ok(false);
        }
        for (index, &byte) in bytes.iter().enumerate() {
            window.copy_within(1.., 0);
            window[BOUNDARY.len() - 1] = byte;
            if window == BOUNDARY {
                reader.consume(index + 1);
                return Ok(true);
            }
        }
        let count = bytes.len();
        reader.consume(count);
    }
}

/// The type of a stream's figures.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Figure {
    F32,
    F64,
    I8,
    I16,
    I32,
    I64,
    Text,
}

impl Figure {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "float32" => Self::F32,
            "double64" => Self::F64,
            "int8" => Self::I8,
            "int16" => Self::I16,
            "int32" => Self::I32,
            "int64" => Self::I64,
            "string" => Self::Text,
            _ => return None,
        })
    }

    const fn bytes(self) -> usize {
        match self {
            Self::I8 => 1,
            Self::I16 => 2,
            Self::F32 | Self::I32 => 4,
            Self::F64 | Self::I64 => 8,
            Self::Text => 0,
        }
    }

    fn read(self, bytes: &[u8]) -> f64 {
        let mut eight = [0; 8];
        eight[..bytes.len()].copy_from_slice(bytes);
        let four = [eight[0], eight[1], eight[2], eight[3]];
        match self {
            Self::F32 => f64::from(f32::from_le_bytes(four)),
            Self::F64 => f64::from_le_bytes(eight),
            Self::I8 => f64::from(i8::from_le_bytes([eight[0]])),
            Self::I16 => f64::from(i16::from_le_bytes([eight[0], eight[1]])),
            Self::I32 => f64::from(i32::from_le_bytes(four)),
            Self::I64 => i64::from_le_bytes(eight) as f64,
            Self::Text => f64::NAN,
        }
    }
}

/// What a channel holds of a pupil.
#[derive(Clone, Debug, PartialEq)]
enum Channel {
    Size {
        eye: SampleEye,
        measure: Measure,
        unit: Unit,
        /// The channel's label as the log has it, for messages.
        label: String,
        /// Why it may be another measure.
        doubt: Option<&'static str>,
    },
    Confidence {
        eye: SampleEye,
        /// What makes a share of one of it.
        factor: f64,
    },
    /// Whether the tracker found the pupil.
    Validity {
        eye: SampleEye,
        label: String,
        held: Bits,
    },
    /// The distance of the lids.
    Aperture {
        eye: SampleEye,
        mm_per_unit: f64,
    },
    /// A length that is said to be in units of area.
    Contradiction {
        label: String,
    },
    Other,
}

impl Channel {
    const fn confidence_of(&self) -> Option<SampleEye> {
        if let Self::Confidence { eye, .. } = self { Some(*eye) } else { None }
    }

    fn validity_of(&self) -> Option<SampleEye> {
        match self {
            Self::Validity { eye, held, .. } if held.fault().is_none() => Some(*eye),
            _ => None,
        }
    }

    const fn aperture_of(&self) -> Option<SampleEye> {
        if let Self::Aperture { eye, .. } = self { Some(*eye) } else { None }
    }
}

/// What a channel that should hold 0 and 1 holds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Bits {
    has_one: bool,
    other: Option<f64>,
}

impl Bits {
    /// NaN is what recorders write where there is no figure.
    fn take(&mut self, figure: f64) {
        if figure == 1.0 {
            self.has_one = true;
        } else if figure != 0.0 && !figure.is_nan() {
            self.other.get_or_insert(figure);
        }
    }

    /// Why it cannot be believed, if it cannot: it may be a code in which 0 is valid.
    fn fault(self) -> Option<String> {
        match self.other {
            Some(figure) => Some(format!("it holds {figure}")),
            None => (!self.has_one).then(|| "it is 0 throughout".into()),
        }
    }
}

/// Where a stream's rows hold one eye's figures.
#[derive(Clone, Copy, Debug)]
struct Taken {
    eye: SampleEye,
    size: usize,
    confidence: Option<usize>,
    validity: Option<usize>,
    aperture: Option<usize>,
}

#[derive(Debug)]
struct Stream {
    name: String,
    kind: String,
    rate_hz: f64,
    figure: Figure,
    channels: Vec<Channel>,
    /// Of Pupil Capture's relay: a sample is of one eye, and the other eye's figures are NaN in it.
    one_eye_a_sample: bool,
    offsets: Vec<(f64, f64)>,
    clock: Clocks,
    /// How many there are in the file.
    samples: u64,
    /// The eyes that are taken from this stream.
    taken: Vec<Taken>,
    /// Time of the sample before, on the stream's own clock, seconds.
    latest_s: f64,
    /// The latest time of a sample, as it was handed on.
    latest: Option<TimeNs>,
    /// Samples that were put behind it.
    moved: u64,
    row: Vec<u8>,
}

fn take_header(chunk: &mut Chunk<'_>, streams: &mut BTreeMap<u32, Stream>, log: &mut LogBuilder) -> io::Result<()> {
    let id = u32::from_le_bytes(chunk.bytes()?);
    let mut xml = Vec::new();
    (&mut chunk.content).take(MAX_XML_BYTES).read_to_end(&mut xml)?;
    let stream = match std::str::from_utf8(&xml).map_err(|error| error.to_string()).and_then(Stream::parse) {
        Ok(stream) => stream,
        Err(error) => {
            log.count(LogFault::Malformed);
            log.warn(format!("stream {id} was left out: its header cannot be read ({error})"));
            return Ok(());
        }
    };
    if streams.len() < MAX_STREAMS {
        streams.entry(id).or_insert(stream);
    }
    Ok(())
}

impl Stream {
    fn parse(xml: &str) -> Result<Self, String> {
        let options = ParsingOptions { nodes_limit: MAX_XML_NODES, ..ParsingOptions::default() };
        let document =
            Document::parse_with_options(xml.trim_end_matches('\0'), options).map_err(|error| error.to_string())?;
        let info = document.root_element();
        let text = |name| child_text(info, name).unwrap_or_default();
        let count: usize = text("channel_count").parse().map_err(|_| "no channel_count".to_owned())?;
        if count == 0 || count > MAX_CHANNELS {
            return Err(format!("{count} channels"));
        }
        let format = text("channel_format");
        let figure = Figure::named(format).ok_or_else(|| format!("channel_format `{}`", format.escape_debug()))?;
        let kind = text("type").to_owned();
        let labels = info.children().find(|node| node.has_tag_name("desc"));
        let labels = labels.and_then(|desc| desc.children().find(|node| node.has_tag_name("channels")));
        let described = labels.into_iter().flat_map(|labels| labels.children());
        let described = described.filter(|node| node.has_tag_name("channel"));
        let mut channels: Vec<_> = described.take(count).map(channel).collect();
        channels.resize(count, Channel::Other);
        let is_relay = |label: &str| label.starts_with("diameter0_") || label.starts_with("diameter1_");
        let one_eye_a_sample =
            document.descendants().any(|node| node.has_tag_name("label") && node.text().is_some_and(is_relay));
        Ok(Self {
            name: text("name").to_owned(),
            kind,
            rate_hz: text("nominal_srate").parse().ok().filter(|rate: &f64| rate.is_finite()).unwrap_or(0.0),
            figure,
            channels,
            one_eye_a_sample,
            offsets: Vec::new(),
            clock: Clocks::default(),
            samples: 0,
            taken: Vec::new(),
            latest_s: 0.0,
            latest: None,
            moved: 0,
            row: Vec::new(),
        })
    }

    /// Its name and type, for notes.
    fn described(&self) -> String {
        format!("`{}` of type `{}`", self.name.escape_debug(), self.kind.escape_debug())
    }

    fn has_pupils(&self, is_wanted: impl Fn(SizeUnit) -> bool) -> bool {
        let is_pupil = |channel: &Channel| matches!(channel, Channel::Size { unit, .. } if is_wanted(unit.unit));
        self.figure != Figure::Text && self.channels.iter().any(is_pupil)
    }

    const fn row_bytes(&self) -> usize {
        self.channels.len() * self.figure.bytes()
    }

    /// Takes the first size in `unit` of each eye that is not `known`: the eyes taken so far, each with its stream.
    fn take_sizes(&mut self, id: u32, unit: SizeUnit, known: &mut Vec<(SampleEye, u32)>, log: &mut LogBuilder) {
        let sizes = self.channels.iter().enumerate().filter_map(|(index, channel)| match channel {
            Channel::Size { eye, unit: of, .. } if of.unit == unit && self.figure != Figure::Text => {
                Some((*eye, index))
            }
            _ => None,
        });
        let (mut doubts, mut doubles) = (Vec::new(), Vec::new());
        for (eye, size) in sizes {
            let Channel::Size { label, measure, doubt, .. } = &self.channels[size] else { continue };
            let label = label.escape_debug().to_string();
            // Both eyes in one figure add nothing to an eye's own, and the other way round.
            let again = known
                .iter()
                .any(|&(of, by)| of == eye || by != id && (of == SampleEye::Both || eye == SampleEye::Both));
            if again {
                if known.contains(&(eye, id)) {
                    doubles.push((eye, label));
                }
                continue;
            }
            if let Some(doubt) = doubt {
                doubts.push((label, measure.plural(), *doubt));
            }
            known.push((eye, id));
            let find = |eye_of: fn(&Channel) -> Option<SampleEye>| {
                let of = |wanted| self.channels.iter().position(|channel| eye_of(channel) == Some(wanted));
                of(eye).or_else(|| of(SampleEye::Both))
            };
            let (confidence, validity) = (find(Channel::confidence_of), find(Channel::validity_of));
            self.taken.push(Taken { eye, size, confidence, validity, aperture: find(Channel::aperture_of) });
        }
        self.tell_validity(log);
        for (label, what, doubt) in doubts {
            log.warn(format!(
                "the channel `{label}` of {} is taken for {what}, though {doubt}; where it is not, let its sender give it a \
                 label that says diameter or area, or a unit such as mm^2",
                self.described()
            ));
        }
        for (eye, label) in doubles {
            let found = format!("the channel `{label}` of {} was left out: another one is of the", self.described());
            match eye {
                // Which of the two eyes each is, no label says.
                SampleEye::Both => log.warn(format!("{found} pupil, too, and neither says of which eye it is")),
                eye => log.note(format!("{found} {eye} eye, too")),
            }
        }
    }

    /// Warns of channels of validity that are not used.
    fn tell_validity(&self, log: &mut LogBuilder) {
        for channel in self.channels.iter().filter(|_| !self.taken.is_empty()) {
            if let Channel::Validity { label, held, .. } = channel
                && let Some(fault) = held.fault()
            {
                log.warn(format!(
                    "the channel `{}` of {} is not used: {fault}; expected 1 where the pupil was found and 0 where it was not",
                    label.escape_debug(),
                    self.described()
                ));
            }
        }
    }

    /// Streams of pupils alone come before those of gaze, which pair eyes and repeat pupils.
    fn rank(&self) -> usize {
        let name = self.name.to_lowercase();
        usize::from(!name.contains("pupillometry"))
    }
}

fn child_text<'a>(node: Node<'a, '_>, name: &str) -> Option<&'a str> {
    node.children().find(|child| child.has_tag_name(name))?.text().map(str::trim)
}

/// What a channel holds, by its label, type, eye and unit
/// (<https://github.com/sccn/xdf/wiki/Gaze-Meta-Data>, and what recorders write in fact).
fn channel(node: Node<'_, '_>) -> Channel {
    let written = child_text(node, "label").unwrap_or_default();
    let text = |name| child_text(node, name).unwrap_or_default().to_lowercase();
    let (label, kind, eye, unit) = (text("label"), text("type"), text("eye"), text("unit"));
    let says = |word: &str| label.contains(word) || kind.contains(word);
    let words: Vec<&str> = label.split(|letter: char| !letter.is_alphanumeric()).collect();
    let has_word = |word: &str| words.contains(&word);
    // `PupilDiameterL`.
    let ends_in = |letter: char| {
        let before = written.strip_suffix(letter).and_then(|rest| rest.chars().next_back());
        before.is_some_and(|before| before.is_lowercase() || before.is_ascii_digit())
    };
    let eye = match SampleEye::named(eye.as_bytes()) {
        Some(eye) => eye,
        _ if label.contains("left") || has_word("l") || has_word("diameter1") || ends_in('L') => SampleEye::Left,
        _ if label.contains("right") || has_word("r") || has_word("diameter0") || ends_in('R') => SampleEye::Right,
        _ => SampleEye::Both,
    };
    if says("confidence") {
        let factor = if matches!(unit.as_str(), "%" | "percent" | "per cent") { 0.01 } else { 1.0 };
        return Channel::Confidence { eye, factor };
    }
    if says("valid") && says("pupil") && !says("invalid") {
        return Channel::Validity { eye, label: written.to_owned(), held: Bits::default() };
    }
    if says("aperture") && !says("pupil") {
        let length = Unit::named(&unit).filter(|unit| unit.unit == SizeUnit::Millimetres && !unit.is_squared);
        return length.map_or(Channel::Other, |unit| Channel::Aperture { eye, mm_per_unit: unit.factor });
    }
    // The width and height of the pupil's picture.
    if matches!(kind.as_str(), "diameterx" | "diametery") {
        return Channel::Other;
    }
    let said = Said {
        diameter: says("diam"),
        radius: !says("diam") && says("radius") && !says("sphere") && !says("eyeball"),
        area: !says("diam") && !says("radius") && says("area") && says("pupil"),
    };
    let is_size = says("pupilsize") || says("pupil_size") || says("pupil size") || label == "pupil" || kind == "pupil";
    if said.only().is_none() && !is_size {
        return Channel::Other;
    }
    // A diameter of something else: the eyeball's, a fixation's circle.
    if !says("pupil") && !matches!(kind.as_str(), "diameter" | "radius") && !label.starts_with("diameter") {
        return Channel::Other;
    }
    let unit = match (Unit::named(&unit), unit.as_str()) {
        (Some(unit), _) => unit,
        (None, "") if label.ends_with("_3d") || has_word("mm") => MILLIMETRES,
        (None, "") if label.ends_with("_2d") || has_word("px") => PIXELS,
        _ => ARBITRARY,
    };
    let label = written.to_owned();
    if unit.is_squared && (said.diameter || said.radius) {
        return Channel::Contradiction { label };
    }
    let (measure, doubt) = unit.measure(said, Said::default());
    Channel::Size { eye, measure, unit, label, doubt }
}

/// Says of which channels the samples are taken: the best unit that there are samples of, and of each eye the first of
/// it in the stream of most samples. On error, what streams there are.
fn choose(streams: &mut BTreeMap<u32, Stream>, log: &mut LogBuilder) -> Result<(), String> {
    let units = [SizeUnit::Millimetres, SizeUnit::Pixels, SizeUnit::Arbitrary];
    for stream in streams.values() {
        for channel in &stream.channels {
            if let Channel::Contradiction { label } = channel {
                log.warn(format!(
                    "the channel `{}` of the stream {} is left out: by its label it is a length, and its unit is one of area",
                    label.escape_debug(),
                    stream.described()
                ));
            }
        }
    }
    let has = |wanted: &SizeUnit| {
        streams.values().any(|stream| stream.samples > 0 && stream.has_pupils(|unit| unit == *wanted))
    };
    let Some(unit) = units.into_iter().find(has) else {
        let names = |streams: &mut dyn Iterator<Item = &Stream>| {
            streams.take(20).map(Stream::described).collect::<Vec<_>>().join(", ")
        };
        let of_pupils = names(&mut streams.values().filter(|stream| stream.has_pupils(|_| true)));
        return Err(if of_pupils.is_empty() {
            format!("no pupil among {} streams ({})", streams.len(), names(&mut streams.values()))
        } else {
            format!("no sample in the streams that have pupils ({of_pupils})")
        });
    };
    log.unit = unit;
    let mut order: Vec<u32> = streams.keys().copied().collect();
    order.retain(|id| streams[id].samples > 0 || !streams[id].has_pupils(|_| true));
    order.sort_by_key(|id| (streams[id].rank(), Reverse(streams[id].samples)));
    let empty = streams.values().filter(|stream| stream.samples == 0 && stream.has_pupils(|_| true));
    let mut left_out: Vec<_> = empty.map(|stream| format!("{} without a sample", stream.described())).collect();
    let (mut known, mut has_pupils_alone) = (Vec::new(), false);
    for id in order {
        let Some(stream) = streams.get_mut(&id) else { continue };
        stream.take_sizes(id, unit, &mut known, log);
        if stream.taken.is_empty() {
            // The relay's stream of gaze.
            let repeats = has_pupils_alone && stream.one_eye_a_sample && stream.rank() > 0;
            if stream.has_pupils(|_| true) && !repeats {
                log.warn(format!(
                    "the stream {} with pupils in {} samples is left out: pupils are read from another one, which is in a \
                     better unit, has more samples or comes first; to read this one, record it without the other",
                    stream.described(),
                    stream.samples
                ));
            } else {
                left_out.push(stream.described());
            }
        } else {
            has_pupils_alone |= stream.rank() == 0;
            let eyes: Vec<_> = stream.taken.iter().map(|taken| taken.eye.to_string()).collect();
            log.note(format!("read from the stream {}: {}", stream.described(), eyes.join(", ")));
            if stream.rate_hz > 0.0 {
                log.stated_rate_hz.get_or_insert(stream.rate_hz);
            }
        }
    }
    if !left_out.is_empty() {
        let more = left_out.len().saturating_sub(20);
        left_out.truncate(20);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        log.note(format!("other streams: {}{more}", left_out.join(", ")));
    }
    Ok(())
}

fn take_offset(chunk: &mut Chunk<'_>, streams: &mut BTreeMap<u32, Stream>) -> io::Result<()> {
    let id = u32::from_le_bytes(chunk.bytes()?);
    let (at_s, offset_s) = (f64::from_le_bytes(chunk.bytes()?), f64::from_le_bytes(chunk.bytes()?));
    if let Some(stream) = streams.get_mut(&id)
        && at_s.is_finite()
        && offset_s.is_finite()
        && stream.offsets.len() < MAX_OFFSETS
    {
        stream.offsets.push((at_s, offset_s));
    }
    Ok(())
}

/// An offset that lies this far from those before it, and jitter besides, is of a clock that was set; pyxdf has 1 s.
const RESET_S: f64 = 0.25;
/// How many times the usual difference of neighbouring offsets a jump is beyond their jitter.
const RESET_JITTERS: f64 = 20.0;
/// So many usual intervals of the offsets a clock may have run before the first and behind the last one of it.
const RESET_INTERVALS: f64 = 2.0;

/// A stream's clock over a recording in which it may have been set or started again: a line for each span of it.
#[derive(Clone, Debug, Default, PartialEq)]
struct Clocks {
    spans: Vec<Span>,
    /// The usual interval of the offsets.
    interval_s: f64,
    /// The span of the sample before, and the latest time in it.
    current: usize,
    latest_s: Option<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Span {
    /// Times of its first and last offset, on the stream's clock.
    first_s: f64,
    last_s: f64,
    line: Clock,
}

impl Span {
    fn of(offsets: &[(f64, f64)]) -> Option<Self> {
        let (first, last) = (offsets.first()?, offsets.last()?);
        Some(Self { first_s: first.0, last_s: last.0, line: Clock::fit(offsets) })
    }

    /// How far a time lies outside it, where it is longer by `slack_s` at both ends.
    fn distance_s(&self, t_s: f64, slack_s: f64) -> f64 {
        (self.first_s - slack_s - t_s).max(t_s - self.last_s - slack_s).max(0.0)
    }
}

impl Clocks {
    /// Cuts the offsets, each with the time at which it was taken, where one jumps while time falls or the next one stays
    /// there. One that is alone is of a packet that was late.
    fn of(offsets: &[(f64, f64)]) -> Self {
        let differences = |of: &dyn Fn(&(f64, f64)) -> f64| {
            let differences = offsets.windows(2).map(|pair| (of(&pair[1]) - of(&pair[0])).abs());
            Sorted::new(differences).map_or(0.0, |differences| differences.median())
        };
        let limit_s = RESET_S.max(RESET_JITTERS * differences(&|at| at.1));
        let mut spans = Vec::new();
        let mut begin = 0;
        // The newest offset that is no late packet's.
        let mut before = offsets.first();
        for (index, this) in offsets.iter().enumerate().skip(1) {
            let Some(reference) = before else { break };
            let falls = this.0 < offsets[index - 1].0;
            let jumps = (this.1 - reference.1).abs() > limit_s;
            let stays = offsets.get(index + 1).is_some_and(|next| (next.1 - this.1).abs() <= limit_s);
            if jumps && (falls || stays && index > begin + 1) {
                spans.extend(Span::of(&offsets[begin..index]));
                begin = index;
            }
            if !jumps || falls || stays {
                before = Some(this);
            }
        }
        spans.extend(Span::of(&offsets[begin..]));
        Self { spans, interval_s: differences(&|at| at.0), current: 0, latest_s: None }
    }

    /// What is to be added to the time of the next sample to get the recorder's. A span ends where the samples' times
    /// fall into the next one, or lie nearer to it.
    fn offset_s(&mut self, t_s: f64) -> f64 {
        while let Some([this, next]) = self.spans.get(self.current..self.current + 2) {
            let falls = self.latest_s.is_some_and(|latest_s| t_s < latest_s - RESET_S);
            // Of a clock that was set forward, what lies between its spans is of the nearer one.
            let is_forward = next.line.at(next.first_s) < this.line.at(this.last_s);
            let slack_s = if is_forward { 0.0 } else { RESET_INTERVALS * self.interval_s };
            let [of_this_s, of_next_s] = [this, next].map(|span| span.distance_s(t_s, slack_s));
            let is_next = if falls { of_next_s <= of_this_s } else { t_s > this.last_s && of_next_s < of_this_s };
            if !is_next {
                break;
            }
            self.current += 1;
            self.latest_s = None;
        }
        self.latest_s = Some(self.latest_s.map_or(t_s, |latest_s| latest_s.max(t_s)));
        self.spans.get(self.current).map_or(0.0, |span| span.line.at(t_s))
    }
}

/// A straight line through a stream's clock offsets: what is to be added to its times to get the recorder's.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Clock {
    origin_s: f64,
    offset_s: f64,
    drift: f64,
}

impl Clock {
    /// Least squares, twice over without what lies three deviations off: an offset is too large when a packet was late.
    fn fit(offsets: &[(f64, f64)]) -> Self {
        let mut kept = offsets.to_vec();
        let mut clock = Self::line(&kept);
        for _ in 0..2 {
            let Some(errors_s) = Sorted::new(kept.iter().map(|at| (at.1 - clock.at(at.0)).abs())) else { break };
            // 1.4826 times the median is the deviation of a normal distribution.
            let limit_s = (3.0 * 1.4826 * errors_s.median()).max(1e-6);
            kept.retain(|at| (at.1 - clock.at(at.0)).abs() <= limit_s);
            clock = Self::line(&kept);
        }
        clock
    }

    fn line(offsets: &[(f64, f64)]) -> Self {
        if offsets.is_empty() {
            return Self::default();
        }
        let count = offsets.len() as f64;
        let mean = |of: &dyn Fn(&(f64, f64)) -> f64| offsets.iter().map(of).sum::<f64>() / count;
        let (origin_s, offset_s) = (mean(&|at| at.0), mean(&|at| at.1));
        let spread = mean(&|at| (at.0 - origin_s).powi(2));
        let common = mean(&|at| (at.0 - origin_s) * (at.1 - offset_s));
        let drift = if spread > 0.0 { common / spread } else { 0.0 };
        Self { origin_s, offset_s, drift: if drift.is_finite() { drift } else { 0.0 } }
    }

    fn at(&self, t_s: f64) -> f64 {
        self.offset_s + self.drift * (t_s - self.origin_s)
    }
}

/// Hands out the stamps, where there are any, and the figures of a chunk's samples.
fn for_rows(chunk: &mut Chunk<'_>, row: &mut [u8], mut take: impl FnMut(Option<f64>, &[u8])) -> io::Result<()> {
    let count = chunk.variable_length()?;
    for _ in 0..count {
        let stamp_s = match chunk.bytes()? {
            [0] => None,
            [8] => Some(f64::from_le_bytes(chunk.bytes()?)),
            _ => return Err(io::ErrorKind::InvalidData.into()),
        };
        chunk.content.read_exact(row)?;
        take(stamp_s, row);
    }
    Ok(())
}

/// Looks at a chunk of samples before it is known of which streams they are taken. What is wrong with it is counted
/// when it is read.
fn survey(chunk: &mut Chunk<'_>, streams: &mut BTreeMap<u32, Stream>) -> io::Result<()> {
    let mut look = || {
        let id = u32::from_le_bytes(chunk.bytes()?);
        let Some(stream) = streams.get_mut(&id).filter(|stream| stream.has_pupils(|_| true)) else { return Ok(()) };
        let mut row = vec![0; stream.row_bytes()];
        for_rows(chunk, &mut row, |_, row| stream.survey(row))
    };
    match look() {
        Err(error) if is_of_content(&error) => Ok(()),
        looked => looked,
    }
}

fn take_samples(
    chunk: &mut Chunk<'_>,
    streams: &mut BTreeMap<u32, Stream>,
    log: &mut LogBuilder,
    record: &mut u64,
) -> io::Result<()> {
    let id = u32::from_le_bytes(chunk.bytes()?);
    let Some(stream) = streams.get_mut(&id).filter(|stream| !stream.taken.is_empty()) else { return Ok(()) };
    let mut row = std::mem::take(&mut stream.row);
    row.resize(stream.row_bytes(), 0);
    let whole = for_rows(chunk, &mut row, |stamp_s, row| {
        *record += 1;
        let interval_s = if stream.rate_hz > 0.0 { 1.0 / stream.rate_hz } else { 0.0 };
        let t_s = stamp_s.unwrap_or(stream.latest_s + interval_s);
        stream.latest_s = t_s;
        stream.push(t_s, row, log, *record);
    });
    stream.row = row;
    whole
}

/// By how much a sample is put behind the one whose stamp is later: less than any tracker's interval, so that stamps
/// soon lead again.
const BEHIND: TimeNs = TimeNs(100_000);
/// A stamp that is later than the next one by more is wrong itself, and no sample is put behind it.
const LATE_MOST: TimeNs = TimeNs(50_000_000);

impl Stream {
    fn survey(&mut self, row: &[u8]) {
        self.samples += 1;
        let bytes = self.figure.bytes();
        for (channel, figure) in self.channels.iter_mut().zip(row.chunks_exact(bytes)) {
            if let Channel::Validity { held, .. } = channel {
                held.take(self.figure.read(figure));
            }
        }
    }

    /// The time of a sample, which at a stated rate is not before the latest where that is late by a busy machine's
    /// delay: samples are pushed in their order. The relay of Pupil Capture interleaves two cameras, which run free of
    /// each other.
    fn in_order(&mut self, mut t: TimeNs) -> TimeNs {
        if let Some(latest) = self.latest
            && t < latest
            && self.rate_hz > 0.0
            && !self.one_eye_a_sample
            && (latest - t).0 <= LATE_MOST.0
        {
            self.moved += 1;
            t = latest + BEHIND;
        }
        self.latest = Some(t);
        t
    }

    fn push(&mut self, t_s: f64, row: &[u8], log: &mut LogBuilder, record: u64) {
        if !t_s.is_finite() {
            return log.count(LogFault::BadNumber);
        }
        let t = match ns_of(t_s + self.clock.offset_s(t_s), 1e9) {
            Ok(t) => self.in_order(TimeNs(t)),
            Err(fault) => return log.count(fault),
        };
        let bytes = self.figure.bytes();
        let figure = |index: usize| self.figure.read(&row[index * bytes..(index + 1) * bytes]);
        for &Taken { eye, size, confidence, validity, aperture } in &self.taken {
            let Channel::Size { measure, unit, .. } = &self.channels[size] else { continue };
            let raw = figure(size);
            if raw.is_nan() && self.one_eye_a_sample {
                continue;
            }
            let diameter = (unit.factor * measure.diameter(raw)) as f32;
            // NaN, 0 and -1 are what recorders write of a pupil that was not found.
            let valid = diameter.is_finite() && diameter > 0.0 && validity.is_none_or(|index| figure(index) == 1.0);
            let aperture_mm = aperture.and_then(|index| match self.channels[index] {
                Channel::Aperture { mm_per_unit, .. } => Some((mm_per_unit * figure(index)) as f32),
                _ => None,
            });
            let confidence = match confidence.map(|index| (&self.channels[index], figure(index))) {
                None => 1.0,
                Some((_, figure)) if figure.is_nan() => 0.0,
                Some((Channel::Confidence { factor, .. }, figure)) => match share(factor * figure) {
                    Ok(confidence) => confidence,
                    Err(fault) => {
                        log.push_sized(Err(fault), LogSample::lost(t, eye), record);
                        continue;
                    }
                },
                Some(_) => continue,
            };
            let diameter = if valid { diameter } else { 0.0 };
            log.push(LogSample { t, eye, diameter, confidence, aperture_mm, valid }, record);
        }
    }
}
