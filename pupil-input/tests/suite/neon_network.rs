//! Pupil Labs Neon over its network interface: a Companion of our own tells its status by HTTP and streams by RTSP, as
//! datagrams or interleaved, loses and swaps packets, restarts, falls silent and sends rubbish.

use std::io::{self, BufRead, BufReader, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::network::{eventually, refused, start, tracks};
use holod_pupil_input::wire::WireFault;
use holod_pupil_input::{Counter, Link, LogFault, Rejection, TrackerHandle};

const SOURCE: u32 = 0x1234_5678;
/// RTP ticks a second.
const RATE: u64 = 90_000;
/// 2026-11-21, in Unix seconds; NTP begins in 1900.
const UNIX_S: u64 = 1_795_219_200;
const UNIX_IN_NTP_S: u64 = 2_208_988_800;
/// RTP time at that instant, close to its wrap.
const TICKS: u32 = u32::MAX - 50_000;
/// Running number of the first packet, close to its wrap.
const NUMBER: u16 = 65_500;

/// From the image of an eye until its packet is sent.
const PHONE_TAKES_MS: u64 = 60;

/// A Companion: its status page, its RTSP server and its clock.
struct Companion {
    status_port: u16,
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
    next: u64,
}

struct Shared {
    stop: AtomicBool,
    /// Whether datagrams get through.
    datagrams: AtomicBool,
    rtsp_port: u16,
    echo_port: u16,
    /// What the phone's clock shows, in Unix milliseconds.
    time_ms: AtomicU64,
    /// No packet comes by itself, behind the answer to PLAY.
    mute: AtomicBool,
    /// As a phone that has left the network: nothing is answered any more.
    gone: AtomicBool,
    /// Signs of life.
    options: AtomicU64,
    teardowns: AtomicU64,
    open: Mutex<Vec<TcpStream>>,
    playing: Mutex<Vec<Playing>>,
}

/// Where a session's packets go.
enum Playing {
    Datagrams { socket: UdpSocket, ports: [u16; 2] },
    Interleaved(TcpStream),
}

impl Companion {
    fn start(status_port: u16) -> Self {
        let status = TcpListener::bind(("127.0.0.1", status_port)).expect("the port is free");
        let rtsp = TcpListener::bind("127.0.0.1:0").expect("a port");
        let echo = TcpListener::bind("127.0.0.1:0").expect("a port");
        let shared = Arc::new(Shared {
            stop: AtomicBool::new(false),
            datagrams: AtomicBool::new(true),
            mute: AtomicBool::new(false),
            gone: AtomicBool::new(false),
            rtsp_port: rtsp.local_addr().expect("bound").port(),
            echo_port: echo.local_addr().expect("bound").port(),
            time_ms: AtomicU64::new(UNIX_S * 1000 + PHONE_TAKES_MS),
            options: AtomicU64::new(0),
            teardowns: AtomicU64::new(0),
            open: Mutex::default(),
            playing: Mutex::default(),
        });
        let status_port = status.local_addr().expect("bound").port();
        let threads = vec![
            serve(status, Arc::clone(&shared), tell_status),
            serve(rtsp, Arc::clone(&shared), stream),
            serve(echo, Arc::clone(&shared), echo_time),
        ];
        Self { status_port, shared, threads, next: 0 }
    }

    fn spec(&self) -> String {
        format!("neon:127.0.0.1:{}", self.status_port)
    }

    fn send(&self, channel: u8, packet: &[u8]) {
        let framed = framed(channel, packet);
        self.shared.playing.lock().expect("no panic").retain_mut(|playing| match playing {
            Playing::Datagrams { socket, ports } => {
                let port = ports[usize::from(channel)];
                let passes = self.shared.datagrams.load(Ordering::Acquire);
                !passes || socket.send_to(packet, ("127.0.0.1", port)).is_ok()
            }
            Playing::Interleaved(stream) => stream.write_all(&framed).is_ok(),
        });
    }

    /// Bytes that are no packet, into the interleaved sessions.
    fn throw_in(&self, bytes: &[u8]) {
        for playing in self.shared.playing.lock().expect("no panic").iter_mut() {
            if let Playing::Interleaved(stream) = playing {
                stream.write_all(bytes).expect("writes");
            }
        }
    }

    /// The next datum, of `payload`, 5 ms after its predecessor.
    fn packet(&mut self, payload: &[u8]) -> Vec<u8> {
        let mut packet = vec![0x80, 96];
        packet.extend(NUMBER.wrapping_add(self.next as u16).to_be_bytes());
        packet.extend(TICKS.wrapping_add((self.next * RATE / 200) as u32).to_be_bytes());
        packet.extend(SOURCE.to_be_bytes());
        packet.extend(payload);
        self.next += 1;
        self.shared.time_ms.store(UNIX_S * 1000 + self.next * 5 + PHONE_TAKES_MS, Ordering::Relaxed);
        packet
    }

    fn send_datum(&mut self, payload: &[u8]) {
        let packet = self.packet(payload);
        self.send(0, &packet);
    }

    /// A sender report about the newest datum.
    fn send_report(&self) {
        let ms = self.next * 5;
        let seconds = (UNIX_S + UNIX_IN_NTP_S + ms / 1000) as u32;
        let fraction = (((ms % 1000) << 32) / 1000) as u32;
        let ticks = TICKS.wrapping_add((self.next * RATE / 200) as u32);
        let mut packet = vec![0x80, 200, 0, 6];
        for word in [SOURCE, seconds, fraction, ticks, self.next as u32, 89 * self.next as u32] {
            packet.extend(word.to_be_bytes());
        }
        self.send(1, &packet);
    }

    /// Sends steady data at about 200 Hz, with a report now and then, until `holds`.
    fn stream_until(&mut self, what: &str, mut holds: impl FnMut() -> bool) {
        eventually(what, || {
            if self.next.is_multiple_of(50) {
                self.send_report();
            }
            self.send_datum(&payload(89, 255));
            holds()
        });
    }
}

impl Drop for Companion {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        for stream in self.shared.open.lock().expect("no panic").iter() {
            let _ = stream.shutdown(Shutdown::Both);
        }
        self.threads.drain(..).for_each(|thread| thread.join().expect("a server ends"));
    }
}

fn serve(listener: TcpListener, shared: Arc<Shared>, talk: fn(TcpStream, &Shared) -> io::Result<()>) -> JoinHandle<()> {
    listener.set_nonblocking(true).expect("sets");
    thread::spawn(move || {
        let mut talks = Vec::new();
        while !shared.stop.load(Ordering::Acquire) {
            match listener.accept() {
                Ok((stream, _)) => {
                    stream.set_nonblocking(false).expect("sets");
                    shared.open.lock().expect("no panic").push(stream.try_clone().expect("clones"));
                    let shared = Arc::clone(&shared);
                    // Its peer may leave at any time.
                    talks.push(thread::spawn(move || {
                        let closing = stream.try_clone().expect("clones");
                        drop(talk(stream, &shared));
                        let _ = closing.shutdown(Shutdown::Both);
                    }));
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

/// The lines of one request's head, without their endings.
fn read_head(reader: &mut impl BufRead) -> io::Result<Vec<String>> {
    let mut lines = Vec::new();
    loop {
        let mut line = String::new();
        if reader.read_line(&mut line)? == 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        match line.trim_end() {
            "" => return Ok(lines),
            line => lines.push(line.to_owned()),
        }
    }
}

fn status(rtsp_port: u16, echo_port: u16, gaze_connected: bool) -> String {
    let sensor = |sensor: &str, conn_type: &str, port: u16, connected: bool| {
        format!(
            r#"{{"data":{{"conn_type":"{conn_type}","connected":{connected},"ip":"127.0.0.1","params":"camera={sensor}","port":{port},"protocol":"rtsp","sensor":"{sensor}","stream_error":false}},"model":"Sensor"}}"#
        )
    };
    let components = [
        r#"{"data":{"battery_level":81,"battery_state":"OK","device_id":"d55a336264ad73d7","device_name":"Neon","ip":"127.0.0.1","memory":123456789,"memory_state":"OK","time_echo_port":ECHO},"model":"Phone"}"#
            .replace("ECHO", &echo_port.to_string()),
        r#"{"data":{"glasses_serial":"123","module_serial":"654321","version":"2.0","world_camera_serial":"x"},"model":"Hardware"}"#.into(),
        sensor("world", "DIRECT", rtsp_port, true),
        sensor("gaze", "WEBSOCKET", 8081, true),
        sensor("gaze", "DIRECT", rtsp_port, gaze_connected),
    ];
    format!(r#"{{"message":"Success","result":[{}]}}"#, components.join(","))
}

fn tell_status(stream: TcpStream, shared: &Shared) -> io::Result<()> {
    let mut reader = BufReader::new(stream.try_clone()?);
    let head = read_head(&mut reader)?;
    assert!(head[0].starts_with("GET /api/status HTTP/1."), "{head:?}");
    answer_http(stream, "200 OK", &status(shared.rtsp_port, shared.echo_port, true))
}

/// Answers each eight bytes with themselves and its own time.
fn echo_time(mut stream: TcpStream, shared: &Shared) -> io::Result<()> {
    let mut asked = [0; 8];
    loop {
        stream.read_exact(&mut asked)?;
        if !shared.gone.load(Ordering::Acquire) {
            let time_ms = shared.time_ms.load(Ordering::Relaxed);
            stream.write_all(&[asked, time_ms.to_be_bytes()].concat())?;
        }
    }
}

fn answer_http(mut stream: TcpStream, outcome: &str, body: &str) -> io::Result<()> {
    write!(
        stream,
        "HTTP/1.1 {outcome}\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    )
}

fn stream(mut stream: TcpStream, shared: &Shared) -> io::Result<()> {
    let mut reader = BufReader::new(stream.try_clone()?);
    let base = format!("rtsp://127.0.0.1:{}/", shared.rtsp_port);
    let mut playing = None;
    loop {
        let head = read_head(&mut reader)?;
        let mut words = head[0].split(' ');
        let (method, url) = (words.next().expect("a method"), words.next().expect("a URL"));
        assert_eq!(words.next(), Some("RTSP/1.0"));
        let header = |name: &str| head.iter().find_map(|line| line.strip_prefix(&format!("{name}: ")));
        let number = header("CSeq").expect("a number");
        let (headers, body) = match method {
            "OPTIONS" => {
                shared.options.fetch_add(1, Ordering::Relaxed);
                ("Public: DESCRIBE,SETUP,TEARDOWN,PLAY,PAUSE\r\n".into(), String::new())
            }
            "DESCRIBE" => {
                assert_eq!(url, format!("{base}?camera=gaze"));
                let sdp = format!(
                    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=Unnamed\r\ni=N/A\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\na=recvonly\r\n\
                     m=application 5006 RTP/AVP 96\r\na=rtpmap:96 com.pupillabs.gaze1/{RATE}\r\na=control:trackID=0\r\n"
                );
                (format!("Content-Base: {base}\r\nContent-Type: application/sdp\r\n"), sdp)
            }
            "SETUP" => {
                assert_eq!(url, format!("{base}trackID=0"));
                let transport = header("Transport").expect("a transport");
                let echoed = match transport.strip_prefix("RTP/AVP;unicast;client_port=") {
                    Some(ports) => {
                        let (rtp, rtcp) = ports.split_once('-').expect("two ports");
                        let ports = [rtp, rtcp].map(|port| port.parse().expect("a port"));
                        assert_eq!((ports[0] % 2, ports[1]), (0, ports[0] + 1));
                        let socket = UdpSocket::bind("127.0.0.1:0")?;
                        let port = socket.local_addr()?.port();
                        playing = Some(Playing::Datagrams { socket, ports });
                        format!("Transport: {transport};server_port={port}-{port}\r\n")
                    }
                    None => {
                        assert_eq!(transport, "RTP/AVP/TCP;unicast;interleaved=0-1");
                        playing = Some(Playing::Interleaved(stream.try_clone()?));
                        // A Companion does not echo it.
                        "Transport: RTP/AVP/TCP;unicast\r\n".into()
                    }
                };
                (format!("Session: 1185d20035702ca;timeout=2\r\n{echoed}"), String::new())
            }
            _ => {
                assert_eq!(header("Session"), Some("1185d20035702ca"));
                (String::new(), String::new())
            }
        };
        let length = body.len();
        let answer = format!("RTSP/1.0 200 OK\r\nCSeq: {number}\r\nContent-Length: {length}\r\n{headers}\r\n{body}");
        if shared.gone.load(Ordering::Acquire) {
            continue;
        }
        if method == "PLAY" {
            assert_eq!(url, base);
            // The first packet may be right behind the answer.
            let first = framed(0, &[&[0x80, 96, 0, 1][..], &[0; 8], &payload(9, 255)].concat());
            let interleaved = matches!(playing, Some(Playing::Interleaved(_)));
            let behind = if interleaved && !shared.mute.load(Ordering::Acquire) { first } else { Vec::new() };
            stream.write_all(&[answer.as_bytes(), &behind].concat())?;
            shared.playing.lock().expect("no panic").extend(playing.take());
        } else {
            stream.write_all(answer.as_bytes())?;
        }
        if method == "TEARDOWN" {
            shared.teardowns.fetch_add(1, Ordering::Relaxed);
            return Ok(());
        }
    }
}

fn framed(channel: u8, packet: &[u8]) -> Vec<u8> {
    let [high, low] = (packet.len() as u16).to_be_bytes();
    [&[b'$', channel, high, low], packet].concat()
}

/// The first `length` bytes of a datum: 4 mm left, 7 mm right.
fn payload(length: usize, worn: u8) -> Vec<u8> {
    let mut bytes = Vec::new();
    bytes.extend(800.0_f32.to_be_bytes());
    bytes.extend(600.0_f32.to_be_bytes());
    bytes.push(worn);
    let eye = |diameter_mm| [diameter_mm, 30.0, 10.0, -40.0, 0.0, 0.0, 1.0];
    let lids = [0.6, -0.4, 10.0];
    for value in [&eye(4.0_f32)[..], &eye(7.0), &lids, &lids].concat() {
        bytes.extend(value.to_be_bytes());
    }
    bytes.truncate(length);
    bytes
}

/// Times of the samples, seconds after the first packet in Unix time, where the wire told any.
fn unix_times_s(handle: &mut TrackerHandle) -> Vec<f64> {
    let mut times = Vec::new();
    while let Some(decision) = handle.decisions.pop() {
        times.push((decision.sample.t_device.0 - UNIX_S as i64 * 1_000_000_000) as f64 * 1e-9);
    }
    times
}

#[test]
fn datagrams_are_followed_and_what_is_wrong_with_them_is_counted() {
    let mut companion = Companion::start(0);
    let mut handle = start(&companion.spec());
    // Over the wrap of numbers and RTP times.
    companion.stream_until("tracking", || tracks(&mut handle));
    let begun = companion.next;
    companion.stream_until("500 samples", || handle.control.counters().of(Counter::Samples) > 500);
    let counters = handle.control.counters();
    assert_eq!(counters.faults_in_all(), 0);
    assert_eq!(counters.of(Counter::SequenceGaps), 0);
    assert_eq!(counters.of(Counter::SequenceRestarts), 0);
    assert!(counters.rejected(Rejection::OtherEye) > 100);
    let sent_s = companion.next as f64 / 200.0;
    let times = unix_times_s(&mut handle);
    assert!(times.iter().filter(|time_s| (0.0..=sent_s).contains(*time_s)).count() > 300, "Unix times");
    assert!(begun < companion.next);

    // Three lost, two swapped, one twice.
    companion.next += 3;
    let [first, second, third] = [0, 1, 2].map(|_| companion.packet(&payload(89, 255)));
    for packet in [&first, &third, &second, &third] {
        companion.send(0, packet);
    }
    let notes = handle.control.counters().of(Counter::Notes);
    for (length, worn) in [(9, 255), (17, 255), (40, 255), (70, 255), (65, 255), (89, 0)] {
        companion.send_datum(&payload(length, worn));
    }
    companion.send(0, b"no packet at all");
    companion.send(0, b"");
    let before = handle.control.counters().of(Counter::Samples);
    companion.stream_until("tracking through rubbish", || {
        handle.control.counters().of(Counter::Samples) > before + 40 && tracks(&mut handle)
    });
    let counters = handle.control.counters();
    let fault = |fault| counters.fault(LogFault::Wire(fault));
    assert_eq!(counters.of(Counter::SequenceGaps), 3, "3 lost, 1 late, 4 without a readable pupil");
    assert_eq!(counters.of(Counter::SequenceMissing), 8);
    assert_eq!(counters.of(Counter::SequenceRestarts), 0);
    assert_eq!(fault(WireFault::TooShort), 1);
    assert_eq!(fault(WireFault::UnknownVersion), 1);
    assert_eq!(fault(WireFault::OutOfStep), 1);
    assert_eq!(counters.rejected(Rejection::Lost), 1);
    assert!(counters.of(Counter::Notes) >= notes + 2);
    assert_eq!(counters.of(Counter::Disconnects), 0);

    // Glasses that are put down are silent, and the session is kept.
    eventually("silence", || handle.control.link() == Link::Silent);
    let options = companion.shared.options.load(Ordering::Relaxed);
    eventually("signs of life", || companion.shared.options.load(Ordering::Relaxed) >= options + 2);
    companion.stream_until("tracking again", || tracks(&mut handle));
    assert_eq!(handle.control.link(), Link::Up);
    assert_eq!(handle.control.counters().of(Counter::Disconnects), 0);
    handle.control.stop();
    eventually("the end of the session", || companion.shared.teardowns.load(Ordering::Relaxed) == 1);
}

#[test]
fn samples_are_put_to_the_time_of_their_images() {
    let mut companion = Companion::start(0);
    let mut handle = start(&companion.spec());
    let mut delays_s = Vec::new();
    let mut pop = || {
        while let Some(decision) = handle.decisions.pop() {
            delays_s.push((decision.sample.t_arrival - decision.sample.t_sample).seconds());
        }
        // Arrival times alone would show no delay that all samples have.
        let newest = &delays_s[delays_s.len().saturating_sub(50)..];
        newest.iter().filter(|delay_s| **delay_s > PHONE_TAKES_MS as f64 * 0.5e-3).count() >= 40
    };
    companion.stream_until("delays of the phone", &mut pop);
    assert_eq!(handle.control.counters().of(Counter::ClockResets), 0);
}

#[test]
fn packets_come_over_tcp_where_datagrams_do_not() {
    let mut companion = Companion::start(0);
    companion.shared.datagrams.store(false, Ordering::Release);
    let mut handle = start(&companion.spec());
    companion.stream_until("tracking", || tracks(&mut handle));
    let counters = handle.control.counters();
    assert_eq!((counters.of(Counter::Connects), counters.of(Counter::Disconnects)), (2, 1));
    assert_eq!(counters.faults_in_all(), 0);

    // An answer between a frame's header and its packet, and a connection joined in the middle.
    let packet = companion.packet(&payload(89, 255));
    let [head, body] = [&framed(0, &packet)[..4], &packet[..]].map(<[u8]>::to_vec);
    companion.throw_in(&[&head[..], b"RTSP/1.0 400 Bad Request\r\nCSeq: 9\r\n\r\n", &body].concat());
    companion.throw_in(&[0; 1000]);
    let before = handle.control.counters().of(Counter::Samples);
    companion.stream_until("tracking through rubbish", || {
        handle.control.counters().of(Counter::Samples) > before + 40 && tracks(&mut handle)
    });
    let counters = handle.control.counters();
    assert!((2..=3).contains(&counters.fault(LogFault::Wire(WireFault::OutOfStep))), "{}", counters.faults_in_all());
    assert_eq!(counters.of(Counter::Disconnects), 1);
    let options = companion.shared.options.load(Ordering::Relaxed);
    let shared = Arc::clone(&companion.shared);
    companion.stream_until("signs of life", || shared.options.load(Ordering::Relaxed) > options);

    // Answers alone are silence, and the session is kept.
    eventually("silence", || handle.control.link() == Link::Silent);
    let (options, bytes) = (shared.options.load(Ordering::Relaxed), handle.control.counters().of(Counter::Bytes));
    eventually("signs of life", || shared.options.load(Ordering::Relaxed) > options + 2);
    assert_eq!(handle.control.counters().of(Counter::Bytes), bytes);
    assert_eq!((handle.control.link(), handle.control.counters().of(Counter::Disconnects)), (Link::Silent, 1));
}

#[test]
fn a_companion_that_restarts_is_found_at_its_new_port() {
    let mut companion = Companion::start(0);
    let (status_port, rtsp_port) = (companion.status_port, companion.shared.rtsp_port);
    let mut handle = start(&companion.spec());
    companion.stream_until("tracking", || tracks(&mut handle));
    drop(companion);
    eventually("the loss", || handle.control.link() == Link::Down);
    eventually("tries", || handle.control.counters().of(Counter::ReconnectAttempts) >= 2);
    let mut companion = Companion::start(status_port);
    assert_ne!(companion.shared.rtsp_port, rtsp_port);
    let samples = handle.control.counters().of(Counter::Samples);
    companion.stream_until("samples again", || {
        handle.control.counters().of(Counter::Samples) > samples + 50 && tracks(&mut handle)
    });
    assert_eq!(handle.control.counters().of(Counter::Disconnects), 1);
}

#[test]
fn a_stream_without_packets_is_told_until_one_comes() {
    let mut companion = Companion::start(0);
    companion.shared.mute.store(true, Ordering::Release);
    let mut handle = start(&companion.spec());
    eventually("the reason", || handle.control.trouble().is_some());
    let told = handle.control.trouble().expect("told").to_owned();
    assert!(told.contains("no packet of its gaze stream came within 3 s by UDP, nor by TCP"), "{told}");
    let counters = handle.control.counters();
    assert_eq!((counters.of(Counter::Notes), counters.of(Counter::Disconnects)), (0, 2), "answers are no messages");
    companion.stream_until("tracking", || tracks(&mut handle));
    assert_eq!(handle.control.trouble(), None);
}

#[test]
fn a_phone_that_leaves_the_network_is_looked_for_again() {
    let mut companion = Companion::start(0);
    let mut handle = start(&companion.spec());
    companion.stream_until("tracking", || tracks(&mut handle));
    // Silent, and it answers: it stays.
    let asked = companion.shared.options.load(Ordering::Relaxed);
    eventually("signs of life", || companion.shared.options.load(Ordering::Relaxed) > asked + 8);
    assert_eq!(handle.control.counters().of(Counter::Disconnects), 0);
    companion.shared.gone.store(true, Ordering::Release);
    eventually("the loss", || handle.control.counters().of(Counter::Disconnects) == 1);
    companion.shared.gone.store(false, Ordering::Release);
    eventually("the session", || handle.control.counters().of(Counter::Connects) == 2);
    companion.stream_until("tracking again", || tracks(&mut handle));
}

/// What is said where a status page answers so.
fn refused_with(answer: impl FnOnce(TcpStream) -> io::Result<()> + Send + 'static) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = listener.local_addr().expect("bound").port();
    let server = thread::spawn(move || {
        let (stream, _) = listener.accept().expect("a connection");
        read_head(&mut BufReader::new(stream.try_clone().expect("clones"))).expect("a request");
        // The other side may have had enough.
        let _ = answer(stream);
    });
    let message = refused(&format!("neon:127.0.0.1:{port}"));
    server.join().expect("ends");
    assert!(message.contains(&format!("Neon Companion at 127.0.0.1:{port}")), "{message}");
    message
}

#[test]
fn what_is_no_companion_is_refused_with_what_to_do() {
    let port = TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound").port();
    let message = refused(&format!("neon:127.0.0.1:{port}"));
    assert!(message.contains("cannot be talked to") && message.contains("Companion app"), "{message}");
    let message = refused("neon:no-such-host.invalid");
    assert!(message.contains("is not found") && message.contains("nss-mdns"), "{message}");

    let message = refused_with(|stream| answer_http(stream, "404 Not Found", "gone"));
    assert!(message.contains("`HTTP/1.1 404 Not Found"), "{message}");
    let message = refused_with(|stream| answer_http(stream, "200 OK", "<html>"));
    assert!(message.contains("`<html>`; expected the status of a Companion"), "{message}");
    let message = refused_with(|stream| answer_http(stream, "200 OK", r#"{"result":[{"model":"Phone"}]}"#));
    assert!(message.contains("expected a connected sensor `gaze`"), "{message}");
    let message = refused_with(move |stream| answer_http(stream, "200 OK", &status(port, 0, false)));
    assert!(message.contains("connect the glasses to the phone"), "{message}");
    let message = refused_with(|mut stream| {
        stream.write_all(b"HTTP/1.1 200 OK\r\n\r\n")?;
        loop {
            stream.write_all(&[b' '; 4096])?;
        }
    });
    assert!(message.contains("its status is longer than"), "{message}");
    let message = refused_with(|mut stream| stream.read_to_end(&mut Vec::new()).map(drop));
    assert!(message.contains("timed out"), "{message}");
    // No stream at the port that the status names.
    let message = refused_with(move |stream| answer_http(stream, "200 OK", &status(port, 0, true)));
    assert!(message.contains("cannot be talked to"), "{message}");
}

#[test]
fn a_status_in_chunks_is_read_and_a_refused_session_is_told() {
    let rtsp = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = rtsp.local_addr().expect("bound").port();
    let server = thread::spawn(move || {
        let (mut stream, _) = rtsp.accept().expect("a connection");
        let mut reader = BufReader::new(stream.try_clone().expect("clones"));
        read_head(&mut reader).expect("a request");
        stream.write_all(b"RTSP/1.0 500 Internal Server Error\r\nCSeq: 1\r\n\r\n").expect("writes");
    });
    let message = refused_with(move |mut stream| {
        let body = status(port, 0, true);
        let (first, second) = body.split_at(100);
        write!(stream, "HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n{:x}\r\n{first}\r\n", first.len())?;
        write!(stream, "{:X};x=y\r\n{second}\r\n0\r\n\r\n", second.len())?;
        stream.read_to_end(&mut Vec::new()).map(drop)
    });
    assert!(message.contains("`RTSP/1.0 500 Internal Server Error"), "{message}");
    assert!(message.contains("expected RTSP/1.0 200 OK"), "{message}");
    server.join().expect("ends");
}
