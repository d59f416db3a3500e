//! Pupil Labs Core over its network interface: a Pupil Capture of our own speaks ZMTP 3.1 as libzmq does, restarts,
//! falls silent and sends rubbish.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::network::{eventually, refused, start, tracks};
use holod_calibration::TimeNs;
use holod_pupil_input::wire::WireFault;
use holod_pupil_input::{Counter, Link, LogFault, PupilState, Rejection, host_now};

/// What Capture needs from an image to its pupil.
const PIPELINE_S: f64 = 0.04;

/// A Pupil Capture: its Pupil Remote and its publisher.
struct Capture {
    remote_port: u16,
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

struct Shared {
    stop: AtomicBool,
    /// Whether Pupil Remote answers.
    answers: AtomicBool,
    /// How often it was asked for the time.
    asked: AtomicU64,
    publish_port: u16,
    begun: TimeNs,
    open: Mutex<Vec<TcpStream>>,
    subscribers: Mutex<Vec<TcpStream>>,
}

impl Shared {
    /// Pupil's time, which may begin anywhere.
    fn pupil_time_s(&self) -> f64 {
        (host_now() - self.begun).seconds() - 300_000.0
    }
}

impl Capture {
    /// Starts one at `remote_port`, or at any port if that is 0.
    fn start(remote_port: u16) -> Self {
        let remote = TcpListener::bind(("127.0.0.1", remote_port)).expect("the port is free");
        let publisher = TcpListener::bind("127.0.0.1:0").expect("a port");
        let shared = Arc::new(Shared {
            stop: AtomicBool::new(false),
            answers: AtomicBool::new(true),
            asked: AtomicU64::new(0),
            publish_port: publisher.local_addr().expect("bound").port(),
            begun: host_now(),
            open: Mutex::default(),
            subscribers: Mutex::default(),
        });
        let remote_port = remote.local_addr().expect("bound").port();
        let threads =
            vec![serve(remote, Arc::clone(&shared), answer_requests), serve(publisher, Arc::clone(&shared), subscribe)];
        Self { remote_port, shared, threads }
    }

    fn spec(&self) -> String {
        format!("core:127.0.0.1:{}", self.remote_port)
    }

    fn publish(&self, topic: &str, payload: &[u8]) {
        let message = [frame(1, topic.as_bytes()), frame(0, payload)].concat();
        self.publish_raw(&message);
    }

    fn publish_raw(&self, bytes: &[u8]) {
        // One that is gone is no fault of the publisher's.
        self.shared.subscribers.lock().expect("no panic").retain_mut(|stream| stream.write_all(bytes).is_ok());
    }
}

impl Drop for Capture {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        for stream in self.shared.open.lock().expect("no panic").iter() {
            let _ = stream.shutdown(Shutdown::Both);
        }
        self.threads.drain(..).for_each(|thread| thread.join().expect("a server ends"));
    }
}

fn serve(
    listener: TcpListener,
    shared: Arc<Shared>,
    talk: fn(&mut TcpStream, &Shared) -> io::Result<()>,
) -> JoinHandle<()> {
    listener.set_nonblocking(true).expect("sets");
    thread::spawn(move || {
        let mut talks = Vec::new();
        while !shared.stop.load(Ordering::Acquire) {
            match listener.accept() {
                Ok((mut stream, _)) => {
                    stream.set_nonblocking(false).expect("sets");
                    shared.open.lock().expect("no panic").push(stream.try_clone().expect("clones"));
                    let shared = Arc::clone(&shared);
                    // Its peer may leave at any time.
                    talks.push(thread::spawn(move || drop(talk(&mut stream, &shared))));
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => thread::sleep(Duration::from_millis(2)),
                Err(error) => panic!("{error}"),
            }
        }
        for stream in shared.open.lock().expect("no panic").iter() {
            let _ = stream.shutdown(Shutdown::Both);
        }
        talks.into_iter().for_each(|talk| talk.join().expect("a talk ends"));
    })
}

fn frame(flags: u8, body: &[u8]) -> Vec<u8> {
    let mut bytes = match u8::try_from(body.len()) {
        Ok(length) => vec![flags, length],
        Err(_) => [&[flags | 2][..], &(body.len() as u64).to_be_bytes()].concat(),
    };
    bytes.extend(body);
    bytes
}

fn read_frame(stream: &mut TcpStream) -> io::Result<(u8, Vec<u8>)> {
    let mut head = [0; 2];
    stream.read_exact(&mut head)?;
    let mut body = vec![0; head[1].into()];
    stream.read_exact(&mut body)?;
    Ok((head[0], body))
}

/// As libzmq 4.3 does it: the signature first, the rest when the peer has shown its own.
fn greet(stream: &mut TcpStream, own_type: &str, peer_type: &str) -> io::Result<()> {
    stream.write_all(&[0xff, 0, 0, 0, 0, 0, 0, 0, 1, 0x7f])?;
    let mut peer = [0; 64];
    stream.read_exact(&mut peer[..11])?;
    assert_eq!((peer[0], peer[9], peer[10]), (0xff, 0x7f, 3));
    let mut rest = [0; 54];
    rest[..2].copy_from_slice(&[3, 1]);
    rest[2..6].copy_from_slice(b"NULL");
    stream.write_all(&rest)?;
    stream.read_exact(&mut peer[11..])?;
    assert_eq!(&peer[12..32], b"NULL\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0");
    let ready = |own: &str| [b"\x05READY\x0bSocket-Type\0\0\0", &[own.len() as u8][..], own.as_bytes()].concat();
    stream.write_all(&frame(4, &[&ready(own_type)[..], b"\x08Identity\0\0\0\0"].concat()))?;
    let (flags, body) = read_frame(stream)?;
    if (flags, body) == (4, ready(peer_type)) { Ok(()) } else { Err(ErrorKind::InvalidData.into()) }
}

fn answer_requests(stream: &mut TcpStream, shared: &Shared) -> io::Result<()> {
    greet(stream, "REP", "REQ")?;
    loop {
        assert_eq!(read_frame(stream)?, (1, vec![]), "a request begins with an empty part");
        let (_, request) = read_frame(stream)?;
        let answer = match &request[..] {
            b"SUB_PORT" => shared.publish_port.to_string(),
            b"t" => {
                shared.asked.fetch_add(1, Ordering::Relaxed);
                shared.pupil_time_s().to_string()
            }
            _ => "Unknown command.".into(),
        };
        if shared.answers.load(Ordering::Acquire) {
            stream.write_all(&[frame(1, b""), frame(0, answer.as_bytes())].concat())?;
        }
    }
}

fn subscribe(stream: &mut TcpStream, shared: &Shared) -> io::Result<()> {
    greet(stream, "PUB", "SUB")?;
    assert_eq!(read_frame(stream)?, (0, b"\x01pupil.".to_vec()));
    shared.subscribers.lock().expect("no panic").push(stream.try_clone()?);
    read_frame(stream).map(|_| ())
}

/// A map as pye3d's plugin publishes it, without what only a camera knows.
fn datum(eye: u8, t_s: f64, diameter_mm: Option<f64>, confidence: f64) -> Vec<u8> {
    let mut bytes = Vec::new();
    let key = |bytes: &mut Vec<u8>, name: &str| rmp::encode::write_str(bytes, name).expect("packs");
    rmp::encode::write_map_len(&mut bytes, 7 + u32::from(diameter_mm.is_some())).expect("packs");
    key(&mut bytes, "id");
    rmp::encode::write_uint(&mut bytes, eye.into()).expect("packs");
    key(&mut bytes, "topic");
    rmp::encode::write_str(&mut bytes, if diameter_mm.is_some() { "pupil.1.3d" } else { "pupil.1.2d" }).expect("packs");
    key(&mut bytes, "method");
    rmp::encode::write_str(&mut bytes, "pye3d 0.3.0 real-time").expect("packs");
    key(&mut bytes, "norm_pos");
    rmp::encode::write_array_len(&mut bytes, 2).expect("packs");
    [0.5, 0.25].into_iter().for_each(|value| rmp::encode::write_f64(&mut bytes, value).expect("packs"));
    for (name, value) in [("diameter", 40.5), ("timestamp", t_s), ("confidence", confidence)] {
        key(&mut bytes, name);
        rmp::encode::write_f64(&mut bytes, value).expect("packs");
    }
    if let Some(diameter_mm) = diameter_mm {
        key(&mut bytes, "diameter_3d");
        rmp::encode::write_f64(&mut bytes, diameter_mm).expect("packs");
    }
    bytes
}

/// Publishes steady samples of the left eye at about 200 Hz, and those of the 2-D detector, until `holds`. Their images
/// were taken [`PIPELINE_S`] before.
fn publish_until(capture: &Capture, what: &str, mut holds: impl FnMut() -> bool) {
    eventually(what, || {
        let t_s = capture.shared.pupil_time_s() - PIPELINE_S;
        capture.publish("pupil.1.2d", &datum(1, t_s, None, 0.9));
        capture.publish("pupil.1.3d", &datum(1, t_s, Some(4.0), 0.9));
        capture.publish("pupil.0.3d", &datum(0, t_s - 0.002, Some(7.0), 0.9));
        holds()
    });
}

#[test]
fn published_pupils_are_followed_and_rubbish_is_counted() {
    let capture = Capture::start(0);
    let mut handle = start(&capture.spec());
    publish_until(&capture, "tracking", || tracks(&mut handle));
    let counters = handle.control.counters();
    assert!(counters.of(Counter::Notes) > 5, "2-D maps are notes");
    assert!(counters.rejected(Rejection::OtherEye) > 5);
    assert_eq!(counters.faults_in_all(), 0);
    assert_eq!(counters.of(Counter::ClockResets), 0);

    let good = datum(1, -1.0, Some(4.0), 0.9);
    capture.publish("pupil.1.3d", &good[..good.len() - 3]);
    capture.publish("pupil.1.3d", b"");
    capture.publish("pupil.1.3d", b"no map");
    capture.publish("pupil.1.3d", &datum(7, -1.0, Some(4.0), 0.9));
    capture.publish("pupil.1.3d", &datum(1, f64::NAN, Some(4.0), 0.9));
    capture.publish("pupil.1.3d", &[&good[..], &[0xc0; 5000]].concat());
    // A message of one part, and one of four.
    capture.publish_raw(&frame(0, b"alone"));
    capture.publish_raw(&[frame(1, b"pupil."), frame(1, b"second"), frame(1, b"third"), frame(0, &good)].concat());
    // Commands in between are of no concern.
    capture.publish_raw(&frame(4, b"\x04PING\0\0"));
    publish_until(&capture, "tracking through rubbish", || {
        let counters = handle.control.counters();
        counters.faults_in_all() >= 8 && tracks(&mut handle)
    });
    let counters = handle.control.counters();
    let fault = |fault| counters.fault(LogFault::Wire(fault));
    assert_eq!(fault(WireFault::TooShort), 2);
    assert_eq!(fault(WireFault::Malformed), 3);
    assert_eq!(fault(WireFault::BadEye), 1);
    assert_eq!(fault(WireFault::NotFinite), 1);
    assert_eq!(fault(WireFault::TooLong), 1);
    assert_eq!(counters.of(Counter::Disconnects), 0);

    // Half a message, and its rest later.
    let whole = [frame(1, b"pupil.1.3d"), frame(0, &datum(1, 1.0, Some(4.0), 0.0))].concat();
    let lost = handle.control.counters().rejected(Rejection::Lost);
    capture.publish_raw(&whole[..40]);
    thread::sleep(Duration::from_millis(120));
    capture.publish_raw(&whole[40..]);
    eventually("a lost pupil", || handle.control.counters().rejected(Rejection::Lost) > lost);
    assert_eq!(handle.control.counters().faults_in_all(), 8);
}

#[test]
fn samples_are_put_to_the_time_of_their_images() {
    let capture = Capture::start(0);
    let mut handle = start(&capture.spec());
    let mut delays_s = Vec::new();
    publish_until(&capture, "delays of the pipeline", || {
        while let Some(decision) = handle.decisions.pop() {
            delays_s.push((decision.sample.t_arrival - decision.sample.t_sample).seconds());
        }
        // Arrival times alone would show no delay that all samples have.
        let newest = &delays_s[delays_s.len().saturating_sub(50)..];
        newest.iter().filter(|delay_s| **delay_s > PIPELINE_S / 2.0).count() >= 40
    });
    assert_eq!(handle.control.counters().of(Counter::ClockResets), 0);
}

#[test]
fn a_capture_that_restarts_is_found_at_its_new_port() {
    let capture = Capture::start(0);
    let (remote_port, publish_port) = (capture.remote_port, capture.shared.publish_port);
    let mut handle = start(&capture.spec());
    publish_until(&capture, "tracking", || tracks(&mut handle));
    drop(capture);
    eventually("the loss", || handle.control.link() == Link::Down);
    eventually("tries", || handle.control.counters().of(Counter::ReconnectAttempts) >= 2);
    eventually("holding", || handle.estimate.pupil_at(host_now()).state != PupilState::Tracking);

    let capture = Capture::start(remote_port);
    assert_ne!(capture.shared.publish_port, publish_port);
    publish_until(&capture, "tracking again", || tracks(&mut handle));
    assert_eq!(handle.control.counters().of(Counter::Disconnects), 1);
    assert_eq!(handle.control.counters().of(Counter::Connects), 2);
}

#[test]
fn a_capture_without_pupils_is_silent_and_not_gone() {
    let capture = Capture::start(0);
    let mut handle = start(&capture.spec());
    publish_until(&capture, "tracking", || tracks(&mut handle));
    eventually("silence", || handle.control.link() == Link::Silent);
    let asked = capture.shared.asked.load(Ordering::Relaxed);
    eventually("signs of life", || capture.shared.asked.load(Ordering::Relaxed) >= asked + 3);
    assert_eq!(handle.control.link(), Link::Silent);
    publish_until(&capture, "tracking again", || tracks(&mut handle));
    assert_eq!(handle.control.link(), Link::Up);
    assert_eq!(handle.control.counters().of(Counter::Disconnects), 0);
    handle.control.stop();
    assert!(handle.control.finished());
}

#[test]
fn a_capture_that_hangs_is_given_up() {
    let capture = Capture::start(0);
    let mut handle = start(&capture.spec());
    publish_until(&capture, "tracking", || tracks(&mut handle));
    capture.shared.answers.store(false, Ordering::Release);
    eventually("the loss", || handle.control.counters().of(Counter::Disconnects) == 1);
    capture.shared.answers.store(true, Ordering::Release);
    let samples = handle.control.counters().of(Counter::Samples);
    publish_until(&capture, "samples again", || handle.control.counters().of(Counter::Samples) > samples);
}

#[test]
fn a_frame_without_end_costs_the_connection_and_not_the_memory() {
    let capture = Capture::start(0);
    let mut handle = start(&capture.spec());
    publish_until(&capture, "tracking", || tracks(&mut handle));
    for (disconnects, length) in [(1, 1_u64 << 46), (2, u64::MAX)] {
        capture.publish_raw(&[&[2][..], &length.to_be_bytes()].concat());
        eventually("the loss", || handle.control.counters().of(Counter::Disconnects) == disconnects);
        let samples = handle.control.counters().of(Counter::Samples);
        publish_until(&capture, "samples again", || handle.control.counters().of(Counter::Samples) > samples);
    }
}

#[test]
fn what_is_no_pupil_remote_is_refused_with_what_to_do() {
    let port = TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound").port();
    let message = refused(&format!("core:127.0.0.1:{port}"));
    assert!(message.contains(&format!("Pupil Remote at 127.0.0.1:{port} cannot be talked to")), "{message}");
    assert!(message.contains("start Pupil Capture"), "{message}");
    let message = refused("core:no-such-host.invalid");
    assert!(message.contains("the host `no-such-host.invalid` is not found"), "{message}");
    assert!(message.contains(".local"), "{message}");

    // The port that it publishes at instead of the one it answers at.
    let capture = Capture::start(0);
    let message = refused(&format!("core:127.0.0.1:{}", capture.shared.publish_port));
    assert!(message.contains("a ZeroMQ socket of type `PUB`, not REP"), "{message}");
    drop(capture);

    let answers: [(&[u8], &str); 2] =
        [(b"HTTP/1.1 400 Bad Request\r\n\r\n", "no ZeroMQ socket: it begins with `HTTP/1.1 4`"), (b"", "timed out")];
    for (answer, told) in answers {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = listener.local_addr().expect("bound").port();
        let server = thread::spawn(move || {
            let (mut stream, _) = listener.accept().expect("a connection");
            stream.write_all(answer).expect("writes");
            // Until the other side has had enough.
            let _ = stream.read_to_end(&mut Vec::new());
        });
        let message = refused(&format!("core:127.0.0.1:{port}"));
        assert!(message.contains(told), "{message}");
        server.join().expect("ends");
    }
}
