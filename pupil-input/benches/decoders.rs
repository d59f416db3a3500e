//! How fast each decoder is, beside the plainest program that reads the same bytes in the same run.
//!
//! `cargo bench -p holod-pupil-input --bench decoders [-- NAME...]`. Every figure is the median of the runs and counts
//! the thread's own time on a core; bytes are pushed 4096 at a time, as the tracker's thread does.
#![allow(clippy::print_stdout)]

use std::hint::black_box;

use holod_calibration::Sorted;
use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_pupil_input::wire::{Decoder, WireEvent};
use holod_pupil_input::{Profile, SampleEye};
use rustix::time::{ClockId, clock_gettime};

const BYTES: usize = 4 << 20;
const PUSH: usize = 4096;
const RUNS: usize = 9;

/// A decoder's bytes, and who else reads them.
struct Case {
    profile: &'static str,
    /// The bytes of instant `k`; one message for a decoder of messages.
    message: fn(u32) -> Vec<u8>,
    /// Messages are pushed one by one.
    whole: bool,
    peer: Peer,
}

/// A plain program for the same bytes.
#[derive(Clone, Copy)]
enum Peer {
    /// The `csv` crate's records of bytes, no field parsed.
    CsvRecords,
    /// The standard library: lines, fields by `split`, each figure by `parse`.
    SplitAndParse,
    /// `chunks_exact` of this length, all its words of 16 bits summed.
    Chunks(usize),
}

const CASES: &[Case] = &[
    Case { profile: "holod", message: holod_line, whole: false, peer: Peer::SplitAndParse },
    Case { profile: "example-lines", message: example_line, whole: false, peer: Peer::CsvRecords },
    Case { profile: "example-lines", message: example_line, whole: false, peer: Peer::SplitAndParse },
    Case { profile: "example-packet", message: example_packet, whole: false, peer: Peer::Chunks(16) },
    Case { profile: "asl-eye-trac", message: asl_frame, whole: false, peer: Peer::Chunks(12) },
    Case { profile: "iscan-etl", message: iscan_packet, whole: false, peer: Peer::Chunks(8) },
    Case { profile: "livetrack", message: livetrack_row, whole: false, peer: Peer::SplitAndParse },
    Case { profile: "open-gaze", message: open_gaze_record, whole: false, peer: Peer::SplitAndParse },
    Case { profile: "pupilext-csv", message: pupilext_row, whole: false, peer: Peer::SplitAndParse },
    Case { profile: "pupilext-json", message: pupilext_object, whole: false, peer: Peer::SplitAndParse },
    Case { profile: "holod-hid", message: hid_report, whole: true, peer: Peer::Chunks(15) },
];

fn main() {
    let wanted: Vec<String> = std::env::args().skip(1).filter(|name| !name.starts_with('-')).collect();
    println!("{:16} {:>9} {:>10}  {:>7}  peer", "decoder", "MB/s", "samples/ms", "ratio");
    for case in CASES.iter().filter(|case| wanted.is_empty() || wanted.iter().any(|name| name == case.profile)) {
        measure(case);
    }
}

fn measure(case: &Case) {
    let profile = Profile::find(case.profile).expect("a shipped profile");
    let first = (case.message)(0).len();
    let messages: Vec<_> = (0..(BYTES / first) as u32).map(case.message).collect();
    let bytes = messages.concat();
    let pushes: Vec<&[u8]> =
        if case.whole { messages.iter().map(Vec::as_slice).collect() } else { bytes.chunks(PUSH).collect() };
    let mut samples = 0;
    // The two take turns, so that what else the machine does hits both.
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    for _ in 0..RUNS {
        let mut decoder = profile.decoder();
        let begin_s = cpu_s();
        samples = decode(&mut *decoder, &pushes);
        ours.push(cpu_s() - begin_s);
        let begin_s = cpu_s();
        black_box(case.peer.read(black_box(&bytes)));
        theirs.push(cpu_s() - begin_s);
    }
    assert!(samples * 10 >= messages.len() as u64 * 9, "{}: {samples} of {}", case.profile, messages.len());
    let [ours, theirs] = [ours, theirs].map(|seconds| Sorted::new(seconds).expect("at least one run").median());
    let megabytes = bytes.len() as f64 / 1e6;
    println!(
        "{:16} {:9.0} {:10.0} {:7.2}x  {} at {:.0} MB/s",
        case.profile,
        megabytes / ours,
        samples as f64 / ours / 1e3,
        theirs / ours,
        case.peer.name(),
        megabytes / theirs
    );
}

/// Seconds that this thread has had a core: what else the machine does counts little.
fn cpu_s() -> f64 {
    let now = clock_gettime(ClockId::ThreadCPUTime);
    now.tv_sec as f64 + now.tv_nsec as f64 / 1e9
}

fn decode(decoder: &mut dyn Decoder, pushes: &[&[u8]]) -> u64 {
    let mut samples = 0;
    for push in pushes {
        decoder.push(push, &mut |event| {
            if let WireEvent::Sample(sample) = event {
                black_box(sample);
                samples += 1;
            }
        });
    }
    samples
}

impl Peer {
    const fn name(self) -> &'static str {
        match self {
            Self::CsvRecords => "csv::ByteRecord, no field parsed,",
            Self::SplitAndParse => "str::lines, split and parse",
            Self::Chunks(_) => "chunks_exact and from_le_bytes",
        }
    }

    fn read(self, bytes: &[u8]) -> f64 {
        match self {
            Self::CsvRecords => {
                let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(bytes);
                let mut record = csv::ByteRecord::new();
                let mut fields = 0;
                while reader.read_byte_record(&mut record).expect("bytes in memory") {
                    fields += record.len();
                }
                fields as f64
            }
            Self::SplitAndParse => {
                let text = std::str::from_utf8(bytes).expect("ASCII");
                text.lines()
                    .flat_map(|line| line.split([',', ';', '*']))
                    .filter_map(|cell| cell.parse::<f64>().ok())
                    .sum()
            }
            Self::Chunks(length) => {
                let word = |pair: &[u8]| f64::from(u16::from_le_bytes([pair[0], pair[1]]));
                bytes.chunks_exact(length).flat_map(|packet| packet.chunks_exact(2)).map(word).sum()
            }
        }
    }
}

/// A pupil that breathes, micrometres.
fn micrometres(k: u32) -> u16 {
    (3500.0 + 400.0 * (f64::from(k) * 0.01).sin()) as u16
}

fn millimetres(k: u32) -> f32 {
    f32::from(micrometres(k)) / 1000.0
}

fn holod_line(k: u32) -> Vec<u8> {
    let mut line = String::new();
    let (sequence, device_us, diameter_mm) = (k.into(), 1_000_000 + 1000 * i64::from(k), millimetres(k));
    encode_line(&LineSample { sequence, device_us, eye: SampleEye::Left, diameter_mm, confidence: 0.98 }, &mut line);
    line.into_bytes()
}

fn example_line(k: u32) -> Vec<u8> {
    format!("{},{:.3},{:.3}\r\n", 100_000 + k, millimetres(k), millimetres(k + 20)).into_bytes()
}

fn example_packet(k: u32) -> Vec<u8> {
    let mut packet = vec![0xAA, 0x55];
    packet.extend((k as u16).to_le_bytes());
    packet.extend((k * 1000).to_le_bytes());
    packet.extend(micrometres(k).to_le_bytes());
    packet.extend(micrometres(k + 20).to_le_bytes());
    packet.extend([250, 251]);
    let crc = packet.iter().fold(0xFFFF_u16, |crc, byte| {
        (0..8).fold(crc ^ (u16::from(*byte) << 8), |crc, _| (crc << 1) ^ if crc & 0x8000 == 0 { 0 } else { 0x1021 })
    });
    packet.extend(crc.to_le_bytes());
    packet
}

fn asl_frame(k: u32) -> Vec<u8> {
    let [number, size] = [k as u16, micrometres(k)].map(u16::to_be_bytes);
    [&[0xFA, 0, 0, 0][..], &number, &size, &[1, 2, 3, 4]].concat()
}

fn iscan_packet(k: u32) -> Vec<u8> {
    [0x4444, 700, 400, micrometres(k)].into_iter().flat_map(u16::to_le_bytes).collect()
}

fn livetrack_row(k: u32) -> Vec<u8> {
    format!("leftEye; {k}; 0; 12.50; 3.25; 600.00; {:.3};\r\n", 300.0 * millimetres(k)).into_bytes()
}

fn open_gaze_record(k: u32) -> Vec<u8> {
    let (left, right) = (millimetres(k), millimetres(k + 20));
    let time_s = f64::from(k) / 150.0;
    format!(
        "<REC CNT=\"{k}\" TIME=\"{time_s:.5}\" LPMM=\"{left:.5}\" LPMMV=\"1\" RPMM=\"{right:.5}\" RPMMV=\"1\" />\r\n"
    )
    .into_bytes()
}

fn pupilext_row(k: u32) -> Vec<u8> {
    let mm = millimetres(k);
    let time_ms = 1_700_000_000_000 + 8 * u64::from(k);
    let rest = "41.2,39.8,1.03518,321.5,240.25,12.5,127.3,0.95,0.875,3,none,36.5";
    format!("{time_ms},PuRe,{:.3},{:.3},{mm:.3},{rest}\n", mm * 12.0, mm * 12.1).into_bytes()
}

fn pupilext_object(k: u32) -> Vec<u8> {
    let mm = millimetres(k);
    let time_ms = 1_700_000_000_000 + 8 * u64::from(k);
    let figures = format!("\"diameter_px\":\"{:.3}\",\"physicalDiameter_mm\":\"{mm:.3}\"", mm * 12.0);
    let rest = format!("\"timestamp_ms\":\"{time_ms}\",\"confidence\":\"0.95\",\"outlineConfidence\":\"0.875\"");
    format!("{{\"EyeData\":{{\"A\":{{\"Main\":{{{figures},{rest}}}}}}}}}\n").into_bytes()
}

fn hid_report(k: u32) -> Vec<u8> {
    let mut report = vec![1];
    report.extend((k * 1000).to_le_bytes());
    report.extend((k as u16).to_le_bytes());
    for micrometres in [micrometres(k), micrometres(k + 20)] {
        report.extend(micrometres.to_le_bytes());
        report.extend([250, 1]);
    }
    report
}
