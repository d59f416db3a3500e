//! The bridge of `doc/lab-streaming-layer.md`: the page's own script, with a stub in the place of LSL.

use std::net::UdpSocket;
use std::process::Command;
use std::time::Duration;

use holod_pupil_input::SampleEye::{Both, Left, Right};
use holod_pupil_input::wire::line::LineDecoder;
use holod_pupil_input::wire::{Decoder, WireEvent, WireSample};
use tempfile::TempDir;

const PAGE: &str = include_str!("../../doc/lab-streaming-layer.md");

/// As much of `pylsl` as the bridge uses: `CHANNELS` (label, eye, type, unit), then `SAMPLES`, then the end.
const STUB: &str = r#"
import sys

nan = float("nan")


class Channel:
    def __init__(self, index):
        self.index = index

    def child(self, _name):
        return self

    def empty(self):
        return self.index == len(CHANNELS)

    def child_value(self, key):
        return CHANNELS[self.index][("label", "eye", "type", "unit").index(key)]

    def next_sibling(self):
        return Channel(self.index + 1)


class StreamInlet:
    def __init__(self, _info, max_buflen):
        self.samples = iter(enumerate(SAMPLES))

    def info(self):
        return self

    def desc(self):
        return Channel(0)

    def pull_sample(self):
        index, values = next(self.samples, (0, None))
        if values is None:
            sys.exit()
        return values, 16731.0 + index / 200


def resolve_byprop(_property, _value):
    return [None]
"#;

/// What the bridge sends of `samples`.
fn bridged(channels: &str, samples: &str) -> Vec<WireSample> {
    let script = PAGE.split("```python\n").nth(1).and_then(|rest| rest.split("```").next()).expect("a script");
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a port");
    socket.set_read_timeout(Some(Duration::from_secs(10))).expect("a time limit");
    let port = socket.local_addr().expect("an address").port().to_string();
    let dir = TempDir::new().expect("a folder");
    let write = |name: &str, text: String| std::fs::write(dir.path().join(name), text).expect("writes");
    assert!(script.contains("6901"));
    write("lsl_bridge.py", script.replace("6901", &port));
    write("pylsl.py", format!("{STUB}\nCHANNELS = {channels}\nSAMPLES = {samples}\n"));
    let run = Command::new("python3").arg("lsl_bridge.py").current_dir(dir.path()).output().expect("python3 runs");
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    // The end, by a line that the bridge does not send.
    let end = UdpSocket::bind("127.0.0.1:0").expect("a port");
    end.send_to(b"end", socket.local_addr().expect("an address")).expect("sends");
    let (mut decoder, mut samples) = (LineDecoder::new(), Vec::new());
    let mut bytes = [0; 256];
    loop {
        let count = socket.recv(&mut bytes).expect("a datagram");
        if !bytes[..count].ends_with(b"\n") {
            return samples;
        }
        decoder.push(&bytes[..count], &mut |event| match event {
            WireEvent::Sample(sample) => samples.push(sample),
            other => panic!("{other:?} for a line of the protocol"),
        });
    }
}

/// Eye, diameter and confidence of each; none of a lost one.
fn told(samples: &[WireSample]) -> Vec<(holod_pupil_input::SampleEye, Option<(f32, f32)>)> {
    samples.iter().map(|sample| (sample.eye, sample.valid.then_some((sample.diameter_mm, sample.confidence)))).collect()
}

#[test]
fn each_eye_is_sent_with_its_own_confidence_and_a_lost_one_as_lost() {
    let channels = r#"[("l", "left", "Diameter", "mm"), ("r", "right", "Diameter", "mm"),
        ("cl", "left", "Confidence", ""), ("cr", "right", "Confidence", "")]"#;
    let sent = bridged(channels, "[[3.5, 3.25, 0.9, 0.5], [nan, 0.0, 0.9, 0.5], [3.5, 3.25, 1.5, 0.5]]");
    let expected = [
        (Left, Some((3.5, 0.9))),
        (Right, Some((3.25, 0.5))),
        (Left, None),
        (Right, None),
        (Left, None),
        (Right, Some((3.25, 0.5))),
    ];
    assert_eq!(told(&sent), expected);
    assert_eq!(sent[2].t_device.map(|t| t.0), Some(16_731_005_000_000));
    // A stream of both eyes together, without confidence.
    assert_eq!(told(&bridged(r#"[("pupil", "both", "Diameter", "mm")]"#, "[[3.5]]")), [(Both, Some((3.5, 1.0)))]);
}

/// Channels as Pupil Capture's relay names them: one confidence, and figures of one eye in each sample.
const RELAY: &str = r#"[("confidence", "both", "Confidence", "normalized"), ("diameter0_2d", "right", "Diameter", "pixels"),
    ("diameter0_3d", "right", "Diameter", "mm"), ("diameter1_3d", "left", "Diameter", "mm")]"#;

#[test]
fn of_pupil_captures_relay_the_one_confidence_is_sent_and_the_other_eye_is_not() {
    let sent = bridged(RELAY, "[[0.2, 40.0, 3.25, nan], [0.9, nan, nan, 3.5], [0.0, 40.0, 0.0, nan]]");
    assert_eq!(told(&sent), [(Right, Some((3.25, 0.2))), (Left, Some((3.5, 0.9))), (Right, None)]);
}
