//! Trackers at the other end of a TCP connection or that send datagrams.

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use holod_calibration::rig;
use holod_pupil_input::wire::WireFault;
use holod_pupil_input::wire::line::{LineSample, encode_line};
use holod_pupil_input::{
    Counter, Link, LogFault, PupilState, RecordFiles, Recording, SampleEye, Tracker, TrackerHandle, TrackerOptions,
    host_now,
};
use tempfile::TempDir;

fn start_with(spec: &str, options: impl Into<TrackerOptions>) -> TrackerHandle {
    let settings = rig::Tracker { eye: rig::Eye::Left, ..rig::Rig::default().tracker };
    Tracker::start(&spec.parse().expect("a spec"), &settings, options).expect("starts")
}

fn start(spec: &str) -> TrackerHandle {
    start_with(spec, host_now())
}

fn refused(spec: &str) -> String {
    let settings = rig::Rig::default().tracker;
    Tracker::start(&spec.parse().expect("a spec"), &settings, host_now()).expect_err("is refused").to_string()
}

fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < Duration::from_secs(20), "never came: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn line(sequence: u64) -> String {
    let mut text = String::new();
    let (eye, device_us) = (SampleEye::Left, sequence as i64 * 5000);
    encode_line(&LineSample { sequence, device_us, eye, diameter_mm: 4.0, confidence: 1.0 }, &mut text);
    text
}

/// A profile for holod's lines with commands.
fn profile_with_commands(folder: &TempDir) -> String {
    let path = folder.path().join("talks.toml");
    let text = r#"
format = "holod-tracker-1"
name = "talks"
about = "Holod's lines from a server that must be asked."

[wire]
kind = "holod"

[network]
start = [{ send = "ON\n", expect = "ON OK\n", within_ms = 500 }]
stop = [{ send = "OFF\n" }]
"#;
    fs::write(&path, text).expect("writes");
    path.display().to_string()
}

fn follow(handle: &mut TrackerHandle, mut send: impl FnMut(&str)) {
    let mut sequence = 0;
    eventually("tracking", || {
        send(&line(sequence));
        sequence += 1;
        handle.estimate.pupil_at(host_now()).state == PupilState::Tracking
    });
}

fn read_line(stream: &mut TcpStream) -> String {
    let mut text = String::new();
    let mut byte = [0];
    while stream.read(&mut byte).expect("reads") == 1 {
        text.push(char::from(byte[0]));
        if byte[0] == b'\n' {
            break;
        }
    }
    text
}

#[test]
fn a_server_is_followed_over_a_loss() {
    let server = TcpListener::bind("127.0.0.1:0").expect("listens");
    let mut handle = start(&format!("tcp:{},profile=holod", server.local_addr().expect("bound")));
    let (mut stream, _) = server.accept().expect("accepts");
    follow(&mut handle, |text| stream.write_all(text.as_bytes()).expect("sends"));
    drop(stream);
    eventually("the loss", || handle.control.link() == Link::Down);
    let (mut stream, _) = server.accept().expect("accepts again");
    eventually("the return", || handle.control.link() == Link::Up);
    follow(&mut handle, |text| stream.write_all(text.as_bytes()).expect("sends"));
    let counters = handle.control.counters();
    assert_eq!((counters.of(Counter::Connects), counters.of(Counter::Disconnects)), (2, 1));
}

#[test]
fn a_server_is_told_to_start_and_to_stop() {
    let folder = TempDir::new().expect("a folder");
    let server = TcpListener::bind("127.0.0.1:0").expect("listens");
    let spec = format!("tcp:{},profile={}", server.local_addr().expect("bound"), profile_with_commands(&folder));
    let peer = std::thread::spawn(move || {
        let (mut stream, _) = server.accept().expect("accepts");
        assert_eq!(read_line(&mut stream), "ON\n");
        // The stream begins in the packet of the answer.
        stream.write_all(format!("ON OK\n{}", line(0)).as_bytes()).expect("answers");
        let stopped = read_line(&mut stream);
        let (mut stream, _) = server.accept().expect("accepts");
        stream.write_all(b"what?\n").expect("answers");
        let mut rest = Vec::new();
        let _ = stream.read_to_end(&mut rest);
        stopped
    });
    let mut handle = start(&spec);
    eventually("the first sample", || handle.control.counters().of(Counter::Samples) == 1);
    handle.control.stop();
    let error = refused(&spec);
    assert!(error.contains("`ON\\n` was sent 3 times and answered by `what?\\n`; expected `ON OK\\n`"), "{error}");
    assert_eq!(peer.join().expect("no panic"), "OFF\n");
}

#[test]
fn what_is_wrong_is_told() {
    let server = TcpListener::bind("127.0.0.1:0").expect("listens");
    let address = server.local_addr().expect("bound");
    drop(server);
    let message = refused(&format!("tcp:{address},profile=holod"));
    assert!(message.contains(&address.to_string()) && message.contains("start the tracker's server"), "{message}");
    let message = refused("tcp:host.invalid:4242,profile=holod");
    assert!(message.contains("the host `host.invalid` is not found"), "{message}");
    let message = refused("udp:192.0.2.1:6900,profile=holod");
    assert!(message.contains("give an address of this machine"), "{message}");
    let taken = UdpSocket::bind("127.0.0.1:0").expect("binds");
    let message = refused(&format!("udp:{},profile=holod", taken.local_addr().expect("bound")));
    assert!(message.contains("another program listens"), "{message}");
    let folder = TempDir::new().expect("a folder");
    let message =
        refused(&format!("udp:127.0.0.1:0,profile={}", profile_with_commands(&folder)).replace(":0,", ":6901,"));
    assert!(message.contains("nobody is there to send them to"), "{message}");
}

#[test]
fn a_sender_without_samples_locks_out_no_tracker() {
    let port = UdpSocket::bind("127.0.0.1:0").expect("binds").local_addr().expect("bound").port();
    let mut handle = start(&format!("udp:127.0.0.1:{port},profile=holod"));
    let [stranger, tracker] = ["127.0.0.2:0", "127.0.0.3:0"].map(|from| UdpSocket::bind(from).expect("binds"));
    let send = |socket: &UdpSocket, text: &str| {
        socket.send_to(text.as_bytes(), ("127.0.0.1", port)).expect("sends");
    };
    // A first half line would be no fault.
    send(&stranger, "noise\nnoise\n");
    eventually("the noise", || handle.control.counters().faults_in_all() > 0);
    follow(&mut handle, |text| {
        send(&stranger, "noise\n");
        send(&tracker, text);
    });
    // The last one that was sent may be on its way.
    std::thread::sleep(Duration::from_millis(200));
    let counters = handle.control.counters();
    assert!(counters.of(Counter::Strangers) > 0 && counters.faults_in_all() <= 2, "counted, and no fault of the link");
    // Another tracker is left out, too, as long as the first one speaks.
    let (samples, strangers) = (counters.of(Counter::Samples), counters.of(Counter::Strangers));
    send(&stranger, &line(1_000_000));
    eventually("it is counted", || handle.control.counters().of(Counter::Strangers) > strangers);
    assert_eq!(handle.control.counters().of(Counter::Samples), samples);
}

#[test]
fn a_datagram_that_is_overtaken_or_doubled_is_not_missing() {
    let port = UdpSocket::bind("127.0.0.1:0").expect("binds").local_addr().expect("bound").port();
    let handle = start(&format!("udp:127.0.0.1:{port},profile=holod"));
    let tracker = UdpSocket::bind("127.0.0.1:0").expect("binds");
    for (numbers, expected) in
        [(&[0, 2, 4][..], [2, 2, 0, 0, 0]), (&[1], [1, 1, 1, 0, 0]), (&[3, 5, 9, 7, 5, 10], [2, 2, 3, 1, 0])]
    {
        for number in numbers {
            tracker.send_to(line(*number).as_bytes(), ("127.0.0.1", port)).expect("sends");
        }
        let counted = [
            Counter::SequenceGaps,
            Counter::SequenceMissing,
            Counter::SequenceOvertaken,
            Counter::SequenceRepeats,
            Counter::SequenceRestarts,
        ];
        eventually("the counts", || counted.map(|counter| handle.control.counters().of(counter)) == expected);
    }
}

#[test]
fn datagrams_stand_for_themselves_live_and_played_again() {
    let folder = TempDir::new().expect("a folder");
    let port = UdpSocket::bind("127.0.0.1:0").expect("binds").local_addr().expect("bound").port();
    let record = Some(RecordFiles::in_folder(folder.path()));
    let options = TrackerOptions { record, ..TrackerOptions::from(host_now()) };
    let mut handle = start_with(&format!("udp:127.0.0.1:{port},profile=holod"), options);
    let tracker = UdpSocket::bind("127.0.0.1:0").expect("binds");
    let send = |text: &str| {
        tracker.send_to(text.as_bytes(), ("127.0.0.1", port)).expect("sends");
    };
    // Without its ending a line is read at the end of its datagram; a torn one does not spoil the next; an empty one is
    // not the end.
    send(line(0).trim_end());
    send("");
    send(&line(1)[..9]);
    send(&line(2));
    send(&format!("{}{}", line(3), line(4)));
    eventually("four samples", || handle.control.counters().of(Counter::Samples) == 4);
    handle.control.stop();
    assert_eq!(handle.control.counters().fault(LogFault::Wire(WireFault::BadChecksum)), 1);
    assert_eq!(handle.control.counters().of(Counter::Disconnects), 0);
    let log = Recording::read(&folder.path().join("tracker.holodraw")).expect("reads");
    assert_eq!((log.len(), log.faults().of(LogFault::Wire(WireFault::BadChecksum))), (4, 1));
}
