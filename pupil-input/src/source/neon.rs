//! Pupil Labs Neon: the Companion app on its phone says over HTTP where its gaze stream is (`/api/status`), and sends
//! it by RTSP (RFC 2326).
//!
//! Datagrams come first, as in the maker's own client. Where none arrives, as behind a firewall, the next try
//! has the packets interleaved with RTSP's TCP connection; where that stays empty too, datagrams are tried again.
//! Nothing is sent back over TCP but a sign of life: Companions were seen to answer receiver reports there with errors
//! in the middle of a packet.
//!
//! Bytes are given as RTSP interleaves them, with the answer to `DESCRIBE` first, so that one decoder reads both.
//!
//! The phone's clock is asked four times a second by its Time Echo, and each answer given as a message of RTSP's form
//! ([`time_message`]), so that a recording holds it too: the samples alone do not tell how long the phone and the network
//! take for all of them. Between packets that come over TCP it would stand within one, so it is not asked there.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream, UdpSocket};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use serde_json::Value;

use super::server::{OPEN_WITHIN, Server, ServerError, wait};
use super::{ByteSource, Feed, READ_TIMEOUT, ReadEvent, SourceError};
use crate::spec::HostPort;
use crate::wire::neon::{MAX_TEXT_BYTES, gaze_media, header, time_message};

/// How long packets are waited for before the other transport is tried.
const FIRST_PACKET_WITHIN: Duration = Duration::from_secs(3);
/// A session's life without a sign of it, where the server does not say (RFC 2326, 12.37).
const SESSION_LASTS: Duration = Duration::from_secs(60);
/// After such a silence a Companion is asked whether it is there.
const SILENT_FOR: Duration = Duration::from_secs(2);
/// How long its answer, or a packet, is waited for then: a phone may leave the network without a word.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);
/// Bytes of the longest status that is read; a Companion's has about 3000.
const LONGEST_STATUS: usize = 1 << 18;
const ASK_TIME_EACH: Duration = Duration::from_millis(250);
/// The Time Echo is no need: a phone that does not open it soon is done without.
const ECHO_OPENS_WITHIN: Duration = Duration::from_millis(500);
/// Tries to find two free ports that follow each other.
const PORT_TRIES: usize = 20;

const COMPANION: &str = "Neon Companion";
const NOT_REACHED: &str = "open the Companion app, bring this machine into the phone's network, and take host and port \
                           from the app's menu, Streaming";
const NOT_UNDERSTOOD: &str = "update the Companion app, and check that this is its address";

/// A Companion by its address.
pub(crate) struct NeonFeed {
    address: HostPort,
    tries: Arc<Tries>,
}

/// What its sessions have come to.
#[derive(Default)]
struct Tries {
    /// Whether the packets are to come over TCP.
    interleaved: AtomicBool,
    /// Sessions in a row that no packet came of.
    unheard: AtomicU32,
}

impl NeonFeed {
    pub(crate) fn new(address: HostPort) -> Self {
        Self { address, tries: Arc::default() }
    }
}

impl Feed for NeonFeed {
    fn open(&mut self) -> Result<Box<dyn ByteSource>, SourceError> {
        let server = Server { name: COMPANION, address: &self.address, hint: NOT_REACHED, deadline: Instant::now() };
        let addresses = server.resolve()?;
        let server = Server { deadline: Instant::now() + OPEN_WITHIN, ..server };
        let stream = find_stream(&server, &addresses)?;
        let open = || NeonSource::open(&server, &stream, Arc::clone(&self.tries));
        let interleaved = || self.tries.interleaved.load(Ordering::Relaxed);
        let before = interleaved();
        // A Companion that refuses one transport is asked for the other at once.
        let refused = |_: &ServerError| interleaved() != before;
        let source = open().or_else(|error| if refused(&error) { open() } else { Err(error) })?;
        Ok(Box::new(source))
    }

    fn trouble(&self) -> Option<String> {
        // Both ways have been tried then.
        (self.tries.unheard.load(Ordering::Relaxed) >= 2).then(|| {
            format!(
                "{COMPANION} at {}: no packet of its gaze stream came within {} s by UDP, nor by TCP; put the glasses on, \
                 and look for a firewall between the phone and this machine",
                self.address,
                FIRST_PACKET_WITHIN.as_secs()
            )
        })
    }
}

/// Where the gaze stream is, and the phone's Time Echo if it has one.
struct GazeStream {
    address: SocketAddr,
    url: String,
    time_echo: Option<SocketAddr>,
}

/// Asks for the Companion's status: a list of components, one of them the sensor `gaze` that is streamed directly.
fn find_stream(server: &Server<'_>, addresses: &[SocketAddr]) -> Result<GazeStream, ServerError> {
    const EXPECTED: &str = "the status of a Companion, JSON with a list `result` of sensors";
    let stream = server.connect(addresses)?;
    let host = stream.peer_addr().map_err(|error| server.broken(error))?.ip();
    let answer = get_status(stream, server.address, server.deadline).map_err(|error| server.broken(error))?;
    let unexpected = |found: &[u8]| server.unexpected(found, EXPECTED, NOT_UNDERSTOOD);
    let body = http_body(&answer).ok_or_else(|| unexpected(&answer))?;
    let status: Value = serde_json::from_slice(&body).map_err(|_| unexpected(&body))?;
    let components = status["result"].as_array().ok_or_else(|| unexpected(&body))?;
    let mut sensors =
        components.iter().filter(|component| component["model"] == "Sensor").map(|sensor| &sensor["data"]);
    let gaze = sensors
        .find(|sensor| sensor["sensor"] == "gaze" && sensor["conn_type"] == "DIRECT")
        .filter(|gaze| gaze["connected"] == true)
        .ok_or_else(|| {
            let expected = "a connected sensor `gaze` with conn_type DIRECT";
            server.unexpected(b"a status without", expected, "connect the glasses to the phone")
        })?;
    let port = gaze["port"].as_u64().and_then(|port| u16::try_from(port).ok());
    let port = port
        .ok_or_else(|| server.unexpected(gaze.to_string().as_bytes(), "a port of the gaze stream", NOT_UNDERSTOOD))?;
    // The address that the phone knows itself by, or the one that it answers at.
    let host = gaze["ip"].as_str().and_then(|ip| ip.parse().ok()).unwrap_or(host);
    let address = SocketAddr::new(host, port);
    let params = gaze["params"].as_str().unwrap_or_default();
    if params.bytes().any(|byte| !byte.is_ascii_graphic()) {
        return Err(server.unexpected(params.as_bytes(), "parameters that fit into a URL", NOT_UNDERSTOOD));
    }
    let echo_port = components.iter().find_map(|component| component["data"]["time_echo_port"].as_u64());
    let echo_port = echo_port.and_then(|port| u16::try_from(port).ok()).filter(|port| *port > 0);
    let time_echo = echo_port.map(|port| SocketAddr::new(host, port));
    Ok(GazeStream { address, url: format!("rtsp://{address}/?{params}"), time_echo })
}

/// The whole answer to one HTTP request; the connection is closed behind it.
fn get_status(mut stream: TcpStream, address: &HostPort, deadline: Instant) -> io::Result<Vec<u8>> {
    write!(
        stream,
        "GET /api/status HTTP/1.1\r\nHost: {address}\r\nAccept: application/json\r\nConnection: close\r\n\r\n"
    )?;
    let mut answer = Vec::new();
    let mut piece = [0; 4096];
    loop {
        let count = read_by(&mut stream, &mut piece, deadline)?;
        answer.extend_from_slice(&piece[..count]);
        if count == 0 || http_complete(&answer) {
            return Ok(answer);
        }
        if answer.len() > LONGEST_STATUS {
            return Err(io::Error::new(
                ErrorKind::InvalidData,
                format!("its status is longer than {LONGEST_STATUS} bytes"),
            ));
        }
    }
}

fn split_head(message: &[u8]) -> Option<(&[u8], &[u8])> {
    let end = message.windows(4).position(|window| window == b"\r\n\r\n")?;
    Some(message.split_at(end + 4))
}

/// Whether an answer says itself that it ends here.
fn http_complete(answer: &[u8]) -> bool {
    split_head(answer).is_some_and(|(head, body)| {
        header(head, "content-length")
            .and_then(|length| length.parse::<usize>().ok())
            .is_some_and(|length| body.len() >= length)
            || is_chunked(head) && body.ends_with(b"0\r\n\r\n")
    })
}

fn is_chunked(head: &[u8]) -> bool {
    header(head, "transfer-encoding").is_some_and(|coding| coding.eq_ignore_ascii_case("chunked"))
}

/// The body of an HTTP answer of status 200.
fn http_body(answer: &[u8]) -> Option<Vec<u8>> {
    let (head, mut body) = split_head(answer)?;
    if status_code(head) != Some(200) {
        return None;
    }
    if !is_chunked(head) {
        return Some(body.to_vec());
    }
    let mut whole = Vec::new();
    loop {
        let end = body.windows(2).position(|window| window == b"\r\n")?;
        let size = std::str::from_utf8(&body[..end]).ok()?;
        let size = usize::from_str_radix(size.split(';').next()?.trim(), 16).ok()?;
        if size == 0 {
            return Some(whole);
        }
        let (chunk, rest) = body[end + 2..].split_at_checked(size)?;
        whole.extend_from_slice(chunk);
        body = rest.strip_prefix(b"\r\n")?;
    }
}

/// The number behind `HTTP/1.1 ` or `RTSP/1.0 `.
fn status_code(head: &[u8]) -> Option<u16> {
    let line = std::str::from_utf8(head.split(|byte| *byte == b'\r').next()?).ok()?;
    line.split(' ').nth(1)?.parse().ok()
}

/// Waits for bytes; 0 is the end of the stream.
fn read_by(stream: &mut TcpStream, buffer: &mut [u8], deadline: Instant) -> io::Result<usize> {
    loop {
        match stream.read(buffer) {
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            outcome => return outcome,
        }
        if Instant::now() >= deadline {
            return Err(ErrorKind::TimedOut.into());
        }
        wait([stream.as_fd()], deadline)?;
    }
}

/// A session's control connection.
struct Rtsp {
    stream: TcpStream,
    /// Bytes read behind the last answer.
    rest: Vec<u8>,
    number: u32,
    session: Option<String>,
}

impl Rtsp {
    fn send(&mut self, method: &str, url: &str, headers: &str) -> io::Result<()> {
        self.number += 1;
        let session = self.session.iter().map(|session| format!("Session: {session}\r\n")).collect::<String>();
        let request = format!("{method} {url} RTSP/1.0\r\nCSeq: {}\r\n{session}{headers}\r\n", self.number);
        self.stream.write_all(request.as_bytes())
    }

    /// Sends a request and gives its answer, head and body.
    fn ask(&mut self, server: &Server<'_>, method: &str, url: &str, headers: &str) -> Result<Vec<u8>, ServerError> {
        let answer = self
            .send(method, url, headers)
            .and_then(|()| self.receive(server.deadline))
            .map_err(|error| server.broken(error))?;
        if status_code(&answer) != Some(200) {
            let hint = "close other programs that stream from this phone, or restart the Companion app";
            return Err(server.unexpected(&answer, "RTSP/1.0 200 OK", hint));
        }
        Ok(answer)
    }

    fn receive(&mut self, deadline: Instant) -> io::Result<Vec<u8>> {
        loop {
            if let Some((head, _)) = split_head(&self.rest) {
                let length = header(head, "content-length").map_or(Ok(0), str::parse::<usize>);
                let whole = length.ok().and_then(|length| length.checked_add(head.len()));
                match whole.filter(|whole| *whole <= MAX_TEXT_BYTES) {
                    Some(whole) if whole <= self.rest.len() => {
                        let rest = self.rest.split_off(whole);
                        return Ok(std::mem::replace(&mut self.rest, rest));
                    }
                    Some(_) => {}
                    None => return Err(io::Error::new(ErrorKind::InvalidData, "its answer is too long")),
                }
            }
            if self.rest.len() > MAX_TEXT_BYTES {
                return Err(io::Error::new(ErrorKind::InvalidData, "its answer is none of RTSP"));
            }
            let mut piece = [0; 1024];
            match read_by(&mut self.stream, &mut piece, deadline)? {
                0 => return Err(ErrorKind::UnexpectedEof.into()),
                count => self.rest.extend_from_slice(&piece[..count]),
            }
        }
    }
}

/// The phone's Time Echo: eight bytes, milliseconds big-endian, are answered with themselves and the phone's own.
struct TimeEcho {
    stream: TcpStream,
    asked: Instant,
    /// What it was asked with.
    question: [u8; 8],
    /// What has come of the answer, and how much.
    answer: [u8; 16],
    used: usize,
}

impl TimeEcho {
    fn open(address: SocketAddr) -> io::Result<Self> {
        let stream = TcpStream::connect_timeout(&address, ECHO_OPENS_WITHIN)?;
        stream.set_nodelay(true)?;
        stream.set_nonblocking(true)?;
        let mut echo = Self { stream, asked: Instant::now(), question: [0; 8], answer: [0; 16], used: 0 };
        echo.ask(echo.asked)?;
        Ok(echo)
    }

    fn ask(&mut self, now: Instant) -> io::Result<()> {
        let question = u64::from_be_bytes(self.question) + 1;
        (self.question, self.asked, self.used) = (question.to_be_bytes(), now, 0);
        self.stream.write_all(&self.question)
    }

    /// The phone's time in milliseconds, once for each question.
    fn receive(&mut self, now: Instant) -> io::Result<Option<u64>> {
        if self.used == self.answer.len() {
            if now - self.asked >= ASK_TIME_EACH {
                self.ask(now)?;
            }
            return Ok(None);
        }
        while self.used < self.answer.len() {
            match receive(&mut self.stream, &mut self.answer[self.used..])? {
                Some(count) => self.used += count,
                None if now - self.asked >= ANSWER_WITHIN => return Err(ErrorKind::TimedOut.into()),
                None => return Ok(None),
            }
        }
        let [echoed, time] = [0, 8].map(|at| std::array::from_fn(|index| self.answer[at + index]));
        Ok((echoed == self.question).then(|| u64::from_be_bytes(time)))
    }
}

/// How the packets come.
enum Transport {
    Datagrams { rtp: UdpSocket, rtcp: UdpSocket, sender: IpAddr },
    Interleaved,
}

/// What is known of the phone's clock.
struct PhoneTime {
    echo: Option<TimeEcho>,
    /// A packet has come since a time was last given: times alone are no sign of a tracker that tracks.
    heard: bool,
}

impl PhoneTime {
    fn receive(&mut self, buffer: &mut [u8]) -> Option<usize> {
        let outcome = self.echo.as_mut()?.receive(Instant::now());
        if outcome.is_err() {
            // The gaze stream does without it.
            self.echo = None;
        }
        let time_ms = outcome.ok().flatten().filter(|_| self.heard)?;
        self.heard = false;
        time_message(time_ms, buffer)
    }
}

struct NeonSource {
    rtsp: Rtsp,
    url: String,
    transport: Transport,
    time: PhoneTime,
    /// What has been read and is to be given first.
    first: Vec<u8>,
    began: Instant,
    heard: bool,
    alive_each: Duration,
    /// When it was last asked for a sign of life.
    alive_last: Instant,
    /// When anything came last.
    came: Instant,
    tries: Arc<Tries>,
}

impl NeonSource {
    fn open(server: &Server<'_>, gaze: &GazeStream, tries: Arc<Tries>) -> Result<Self, ServerError> {
        let broken = |error| server.broken(error);
        let stream = server.connect(&[gaze.address])?;
        let mut rtsp = Rtsp { stream, rest: Vec::new(), number: 0, session: None };
        rtsp.ask(server, "OPTIONS", &gaze.url, "")?;
        let description = rtsp.ask(server, "DESCRIBE", &gaze.url, "Accept: application/sdp\r\n")?;
        let (head, sdp) = split_head(&description).unwrap_or((&description, b""));
        let base = header(head, "content-base").unwrap_or(&gaze.url).to_owned();
        let track = track_url(&base, sdp);

        let (transport, asked) = if tries.interleaved.load(Ordering::Relaxed) {
            (Transport::Interleaved, "RTP/AVP/TCP;unicast;interleaved=0-1".into())
        } else {
            let (rtp, rtcp) = datagram_sockets(&rtsp.stream).map_err(broken)?;
            let port = rtp.local_addr().map_err(broken)?.port();
            let sender = gaze.address.ip();
            (Transport::Datagrams { rtp, rtcp, sender }, format!("RTP/AVP;unicast;client_port={port}-{}", port + 1))
        };
        let answer = rtsp.ask(server, "SETUP", &track, &format!("Transport: {asked}\r\n"));
        if answer.is_err() {
            // One that does not know this transport may know the other.
            tries.interleaved.fetch_xor(true, Ordering::Relaxed);
        }
        let answer = answer?;
        let session = header(&answer, "session").unwrap_or_default();
        let (session, options) = session.split_once(';').unwrap_or((session, ""));
        rtsp.session = Some(session.trim().to_owned()).filter(|session| !session.is_empty());
        let lasts = options.split(';').find_map(|option| option.trim().strip_prefix("timeout=")?.parse().ok());
        let lasts = lasts.map_or(SESSION_LASTS, Duration::from_secs);
        if let Transport::Datagrams { rtp, rtcp, sender } = &transport {
            let ports = header(&answer, "transport").and_then(server_ports);
            for (socket, port) in [rtp, rtcp].into_iter().zip(ports.into_iter().flatten()) {
                // An empty receiver report: firewalls let pass what seems to answer it. What fails here is lost there.
                let _ = socket.send_to(&[0x80, 201, 0, 1, 0, 0, 0, 0], SocketAddr::new(*sender, port));
            }
        }
        rtsp.ask(server, "PLAY", &base, "Range: npt=now-\r\n")?;
        let mut first = description;
        if matches!(transport, Transport::Interleaved) {
            first.append(&mut rtsp.rest);
        }
        let is_framed = matches!(transport, Transport::Datagrams { .. });
        let echo = gaze.time_echo.filter(|_| is_framed).and_then(|address| TimeEcho::open(address).ok());
        let now = Instant::now();
        Ok(Self {
            rtsp,
            url: base,
            transport,
            time: PhoneTime { echo, heard: false },
            first,
            began: now,
            heard: false,
            alive_each: (lasts / 2).clamp(Duration::from_secs(1), SESSION_LASTS),
            alive_last: now,
            came: now,
            tries,
        })
    }

    fn read_by(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<Option<usize>> {
        if !self.first.is_empty() {
            let count = self.first.len().min(buffer.len());
            buffer[..count].copy_from_slice(&self.first[..count]);
            self.first.drain(..count);
            return Ok(Some(count));
        }
        loop {
            if let Some(count) = self.time.receive(buffer) {
                return Ok(Some(count));
            }
            let count = match &self.transport {
                Transport::Interleaved => receive(&mut self.rtsp.stream, buffer)?,
                Transport::Datagrams { rtp, rtcp, sender } => {
                    // Answers to signs of life; the connection's end is the session's.
                    if receive(&mut self.rtsp.stream, &mut [0; 1024])?.is_some() {
                        self.came = Instant::now();
                    }
                    match receive_framed(rtp, 0, *sender, buffer)? {
                        None => receive_framed(rtcp, 1, *sender, buffer)?,
                        packet => packet,
                    }
                }
            };
            let now = Instant::now();
            if let Some(count) = count {
                self.came = now;
                // An answer shows that the Companion is there, and not that the tracker speaks.
                if is_answer(&buffer[..count]) {
                    continue;
                }
                (self.heard, self.time.heard) = (true, true);
                self.tries.unheard.store(0, Ordering::Relaxed);
                return Ok(Some(count));
            }
            if !self.heard && now - self.began >= FIRST_PACKET_WITHIN {
                self.tries.interleaved.fetch_xor(true, Ordering::Relaxed);
                self.tries.unheard.fetch_add(1, Ordering::Relaxed);
                return Err(ErrorKind::TimedOut.into());
            }
            let silent_for = now - self.came;
            if silent_for >= SILENT_FOR + ANSWER_WITHIN {
                return Err(ErrorKind::TimedOut.into());
            }
            let asks = silent_for >= SILENT_FOR && self.alive_last <= self.came;
            if asks || now - self.alive_last >= self.alive_each {
                self.alive_last = now;
                let url = std::mem::take(&mut self.url);
                let sent = self.rtsp.send("OPTIONS", &url, "");
                self.url = url;
                sent?;
            }
            if now >= deadline {
                return Ok(None);
            }
            let rtsp = self.rtsp.stream.as_fd();
            match &self.transport {
                Transport::Interleaved => wait([rtsp], deadline)?,
                Transport::Datagrams { rtp, rtcp, .. } => {
                    // Without a Time Echo, one of the others stands in its place.
                    let echo = self.time.echo.as_ref().map_or(rtsp, |echo| echo.stream.as_fd());
                    wait([rtsp, rtp.as_fd(), rtcp.as_fd(), echo], deadline)?;
                }
            }
        }
    }
}

impl ByteSource for NeonSource {
    fn read(&mut self, buffer: &mut [u8]) -> ReadEvent {
        match self.read_by(buffer, Instant::now() + READ_TIMEOUT) {
            Ok(Some(count)) => ReadEvent::Bytes(count),
            Ok(None) => ReadEvent::Silence,
            Err(_) => ReadEvent::Gone,
        }
    }
}

impl Drop for NeonSource {
    fn drop(&mut self) {
        // Where it does not get through, the session ends with its connection.
        let _ = self.rtsp.send("TEARDOWN", &self.url, "");
    }
}

/// Where the media is set up: its `a=control:` in the SDP, absolute or behind the base.
fn track_url(base: &str, sdp: &[u8]) -> String {
    let control = gaze_media(sdp).split(|byte| *byte == b'\n').find_map(|line| line.strip_prefix(b"a=control:"));
    match control.and_then(|control| std::str::from_utf8(control).ok()).map(str::trim) {
        None | Some("" | "*") => base.into(),
        Some(control) if control.starts_with("rtsp://") => control.into(),
        Some(control) if base.ends_with('/') || control.starts_with('/') => format!("{base}{control}"),
        Some(control) => format!("{base}/{control}"),
    }
}

/// The ports that the server sends from: `server_port=5000-5001`, or just the first.
fn server_ports(transport: &str) -> Option<[u16; 2]> {
    let ports = transport.split(';').find_map(|option| option.trim().strip_prefix("server_port="))?;
    let (rtp, rtcp) = ports.split_once('-').unwrap_or((ports, ""));
    let rtp: u16 = rtp.parse().ok()?;
    Some([rtp, rtcp.parse().unwrap_or(rtp.saturating_add(1))])
}

/// An even port for RTP and the next one for RTCP, at which `control`'s peer can reach this machine.
fn datagram_sockets(control: &TcpStream) -> io::Result<(UdpSocket, UdpSocket)> {
    let any: IpAddr = match control.peer_addr()?.ip() {
        IpAddr::V4(_) => Ipv4Addr::UNSPECIFIED.into(),
        IpAddr::V6(_) => Ipv6Addr::UNSPECIFIED.into(),
    };
    let mut outcome = Err(io::Error::from(ErrorKind::AddrInUse));
    for _ in 0..PORT_TRIES {
        let rtp = UdpSocket::bind((any, 0))?;
        let port = rtp.local_addr()?.port();
        if port % 2 == 1 {
            continue;
        }
        match UdpSocket::bind((any, port + 1)) {
            Ok(rtcp) => {
                rtp.set_nonblocking(true)?;
                rtcp.set_nonblocking(true)?;
                return Ok((rtp, rtcp));
            }
            Err(error) => outcome = Err(error),
        }
    }
    outcome
}

/// Whether an answer to a sign of life, and nothing else, has come between interleaved packets.
fn is_answer(bytes: &[u8]) -> bool {
    bytes.starts_with(b"RTSP/1.") && split_head(bytes).is_some_and(|(_, behind)| behind.is_empty())
}

/// What has come by TCP.
fn receive(stream: &mut TcpStream, buffer: &mut [u8]) -> io::Result<Option<usize>> {
    match stream.read(buffer) {
        Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
        Ok(count) => Ok(Some(count)),
        Err(error) => nothing_yet(error),
    }
}

/// A datagram of `sender`'s, in RTSP's frame.
fn receive_framed(socket: &UdpSocket, channel: u8, sender: IpAddr, buffer: &mut [u8]) -> io::Result<Option<usize>> {
    let Some((frame, packet)) = buffer.split_first_chunk_mut::<4>() else {
        return Ok(None);
    };
    match socket.recv_from(packet) {
        Ok((count, from)) if from.ip() == sender => {
            let [high, low] = (count as u16).to_be_bytes();
            *frame = [b'$', channel, high, low];
            Ok(Some(frame.len() + count))
        }
        Ok(_) => Ok(None),
        Err(error) => nothing_yet(error),
    }
}

fn nothing_yet(error: io::Error) -> io::Result<Option<usize>> {
    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) { Ok(None) } else { Err(error) }
}
