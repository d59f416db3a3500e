//! The rings between the reader and the disk, and the thread that empties them.

use std::fs::{File, OpenOptions};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use holod_calibration::TimeNs;

use super::container::{Header, Kind, MAX_PAYLOAD_BYTES, RECORD_HEAD_BYTES, RecordHead, encode_record};
use super::samples::{SAMPLES_HEADER, write_sample};
use super::{RecordError, RecordFiles, RecordStatus};
use crate::estimator::Decision;

/// Bytes on their way to the disk: ten seconds of a link of 3 Mbit/s.
const RING_BYTES: usize = 1 << 22;
/// Decisions on their way to the disk: 16 s at 1 kHz.
const RING_DECISIONS: usize = 1 << 14;
/// Decisions that one piece of a log may bring: the samples of one read of a link, and those that waited for them.
pub(crate) const ROOM: usize = 1 << 13;
/// How often the rings are emptied and what they held is handed to the system.
const WRITE_INTERVAL: Duration = Duration::from_millis(100);
/// How often it is forced to the disk; with the time that takes, a second at most.
const SYNC_INTERVAL: Duration = Duration::from_millis(500);
/// How long the end waits for the disk, and how often it looks whether that has come.
const FINISH: Duration = Duration::from_secs(5);
const FINISH_POLL: Duration = Duration::from_millis(5);

/// The reader thread's part: wait-free, without allocation.
pub(crate) struct Taps {
    raw: Option<rtrb::Producer<u8>>,
    decisions: Option<rtrb::Producer<Decision>>,
    connection: u32,
    /// Pieces lost that the file does not count yet.
    lost: u64,
    /// Of the last record that was put in.
    t_last: TimeNs,
    shared: Arc<Shared>,
}

/// The control thread's part.
#[derive(Debug)]
pub(crate) struct Recorder {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    chunks_lost: AtomicU64,
    decisions_lost: AtomicU64,
    failure: Mutex<Option<String>>,
}

/// Makes the files and starts the thread that writes them; it ends when the taps are dropped. `header` is none where
/// there is no link whose bytes could be written.
pub(crate) fn start(files: &RecordFiles, header: Option<&Header>) -> Result<(Taps, Recorder), RecordError> {
    let shared = Arc::new(Shared::default());
    let mut taps = Taps {
        raw: None,
        decisions: None,
        connection: 0,
        lost: 0,
        t_last: header.map_or(TimeNs(0), |header| header.t_started),
        shared: Arc::clone(&shared),
    };
    let mut writer = Writer { raw: None, decisions: None, shared: Arc::clone(&shared) };
    let raw = files.raw.as_ref().zip(header);
    let raw = raw.map(|(path, header)| Ok((header, Output::create(path, &header.encode())?))).transpose()?;
    if let Some(path) = &files.samples {
        let begin = format!("{SAMPLES_HEADER}\n");
        let out = Output::create(path, begin.as_bytes()).inspect_err(|_| {
            // A recording without its samples was not asked for.
            if let Some((_, raw)) = &raw {
                let _ = std::fs::remove_file(&raw.path);
            }
        })?;
        let (producer, ring) = rtrb::RingBuffer::new(RING_DECISIONS);
        writer.decisions = Some((ring, out));
        taps.decisions = Some(producer);
    }
    if let Some((header, out)) = raw {
        let (producer, ring) = rtrb::RingBuffer::new(RING_BYTES);
        writer.raw = Some(RawWriter::new(ring, header.t_started, out));
        taps.raw = Some(producer);
    }
    let thread = thread::Builder::new()
        .name("pupil-recorder".into())
        .spawn(move || writer.run())
        .map_err(RecordError::Thread)?;
    Ok((taps, Recorder { shared, thread: Some(thread) }))
}

impl Taps {
    pub(crate) fn connected(&mut self, t: TimeNs) {
        self.connection = self.connection.wrapping_add(1);
        self.put(Kind::Connected, t, &[]);
    }

    pub(crate) fn bytes(&mut self, arrival: TimeNs, bytes: &[u8]) {
        for piece in bytes.chunks(MAX_PAYLOAD_BYTES) {
            self.put(Kind::Bytes, arrival, piece);
        }
    }

    pub(crate) fn disconnected(&mut self, t: TimeNs) {
        self.put(Kind::Disconnected, t, &[]);
    }

    pub(crate) fn decision(&mut self, decision: Decision) {
        let Some(ring) = &mut self.decisions else { return };
        if ring.push(decision).is_err() {
            self.shared.decisions_lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Whether what one piece of a log brings will find room; always where nothing is written any more.
    pub(crate) fn has_room(&self) -> bool {
        self.decisions.as_ref().is_none_or(|ring| ring.slots() >= ROOM || ring.is_abandoned())
    }

    fn put(&mut self, kind: Kind, t: TimeNs, payload: &[u8]) {
        let Some(ring) = &mut self.raw else { return };
        let connection = self.connection;
        if self.lost > 0 {
            let head = RecordHead { kind: Kind::Lost, t: self.t_last, connection };
            if push(ring, &head, &self.lost.to_le_bytes()) {
                self.lost = 0;
            }
        }
        if self.lost == 0 && push(ring, &RecordHead { kind, t, connection }, payload) {
            self.t_last = t;
        } else {
            self.lost += 1;
            self.shared.chunks_lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Puts a record in, if there is room for all of it.
fn push(ring: &mut rtrb::Producer<u8>, head: &RecordHead, payload: &[u8]) -> bool {
    ring.slots() >= RECORD_HEAD_BYTES + payload.len()
        && ring.push_entire_slice(&head.encode(payload.len())).is_ok()
        && ring.push_entire_slice(payload).is_ok()
}

impl Recorder {
    pub(crate) fn status(&self) -> RecordStatus {
        let shared = &self.shared;
        RecordStatus {
            chunks_lost: shared.chunks_lost.load(Ordering::Relaxed),
            decisions_lost: shared.decisions_lost.load(Ordering::Relaxed),
            failure: shared.failure.lock().unwrap_or_else(PoisonError::into_inner).clone(),
        }
    }

    /// Waits until all is on the disk, some seconds at most: a disk that takes longer has lost the recording. The taps
    /// must have been dropped.
    pub(crate) fn finish(&mut self) {
        self.finish_within(FINISH);
    }

    fn finish_within(&mut self, patience: Duration) {
        let Some(thread) = self.thread.take() else { return };
        thread.thread().unpark();
        let t_end = Instant::now() + patience;
        while !thread.is_finished() {
            if Instant::now() >= t_end {
                self.shared.fail(format!("recording: the disk does not take the end of it within {patience:?}"));
                return;
            }
            thread::sleep(FINISH_POLL);
        }
        // A panic over there has been reported by the panic hook; here it only means that it has ended.
        let _ = thread.join();
    }
}

/// A file that is written in pieces and synced.
struct Output {
    path: PathBuf,
    file: BufWriter<File>,
}

impl Output {
    fn create(path: &Path, begin: &[u8]) -> Result<Self, RecordError> {
        let open = || {
            let mut file = OpenOptions::new().write(true).create_new(true).open(path)?;
            file.write_all(begin)?;
            file.sync_all()?;
            // The file's name is on the disk once its folder is.
            if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
                File::open(folder)?.sync_all()?;
            }
            Ok(file)
        };
        let file = open().map_err(|source: io::Error| {
            let hint = match source.kind() {
                ErrorKind::AlreadyExists => "nothing is overwritten; name another file",
                ErrorKind::NotFound => "make the folder first",
                ErrorKind::PermissionDenied => "name a folder in which you may write",
                _ => "name a file on a disk with room",
            };
            RecordError::Create { path: path.into(), source, hint }
        })?;
        Ok(Self { path: path.into(), file: BufWriter::with_capacity(1 << 16, file) })
    }

    fn failed(&self, error: &io::Error) -> String {
        let cure = match error.kind() {
            ErrorKind::NotFound => "leave it where it is until the run is over",
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
                "make room on its disk; what was written before is kept"
            }
            ErrorKind::FileTooLarge => "raise the limit on a file's size (ulimit -f); what was written before is kept",
            _ => "look after its disk; what was written before is kept",
        };
        format!("recording {}: {error}; {cure}", self.path.display())
    }
}

/// The thread's own state.
struct Writer {
    raw: Option<RawWriter>,
    decisions: Option<(rtrb::Consumer<Decision>, Output)>,
    shared: Arc<Shared>,
}

struct RawWriter {
    ring: rtrb::Consumer<u8>,
    /// A record whose payload is not in the ring yet.
    head: Option<(RecordHead, usize)>,
    payload: Vec<u8>,
    bytes: Vec<u8>,
    /// The last record that was written.
    last: RecordHead,
    /// Lost pieces that the file counts.
    lost_in_file: u64,
    out: Output,
}

impl Writer {
    fn run(mut self) {
        let mut synced = Instant::now();
        loop {
            // Asked before the rings are emptied: what was put in before the taps were dropped is written.
            let over = self.raw.as_ref().is_none_or(|raw| raw.ring.is_abandoned())
                && self.decisions.as_ref().is_none_or(|(ring, _)| ring.is_abandoned());
            let sync = over || synced.elapsed() >= SYNC_INTERVAL;
            if sync {
                synced = Instant::now();
            }
            self.write(over, sync);
            if over {
                return;
            }
            // A log that is played as fast as it can be read fills the ring in less.
            let busy = self.decisions.as_ref().is_some_and(|(ring, _)| ring.slots() > RING_DECISIONS / 8);
            if !busy {
                thread::park_timeout(WRITE_INTERVAL);
            }
        }
    }

    /// Writes what has come. A file that fails is given up, and the other one goes on.
    fn write(&mut self, over: bool, sync: bool) {
        let end_with_lost = over.then(|| self.shared.chunks_lost.load(Ordering::Relaxed));
        if let Some(raw) = &mut self.raw
            && let Err(error) = raw.write(end_with_lost).and_then(|()| hand_over(&mut raw.out, sync))
        {
            self.shared.fail(raw.out.failed(&error));
            self.raw = None;
        }
        if let Some((ring, out)) = &mut self.decisions {
            let mut write = || {
                while let Ok(decision) = ring.pop() {
                    write_sample(&decision, &mut out.file)?;
                }
                hand_over(out, sync)
            };
            if let Err(error) = write() {
                self.shared.fail(out.failed(&error));
                self.decisions = None;
            }
        }
    }
}

/// Hands what is buffered to the system, and forces it to the disk if asked.
fn hand_over(out: &mut Output, sync: bool) -> io::Result<()> {
    out.file.flush()?;
    // What is written into a file without a name is lost when it is closed.
    if out.file.get_ref().metadata()?.nlink() == 0 {
        return Err(io::Error::new(ErrorKind::NotFound, "the file was deleted while it was written"));
    }
    if sync { out.file.get_ref().sync_data() } else { Ok(()) }
}

impl RawWriter {
    fn new(ring: rtrb::Consumer<u8>, t_started: TimeNs, out: Output) -> Self {
        let payload = Vec::with_capacity(MAX_PAYLOAD_BYTES);
        let bytes = Vec::with_capacity(RECORD_HEAD_BYTES + MAX_PAYLOAD_BYTES + 4);
        let last = RecordHead { kind: Kind::Connected, t: t_started, connection: 0 };
        Self { ring, head: None, payload, bytes, last, lost_in_file: 0, out }
    }

    /// Writes every whole record that is in the ring; at the end of a run also that it ended, and of how many pieces
    /// the file does not tell yet that they were lost.
    fn write(&mut self, end_with_lost: Option<u64>) -> io::Result<()> {
        while let Some((head, length)) = self.head.take().or_else(|| self.next_head()) {
            self.payload.resize(length, 0);
            if self.ring.pop_entire_slice(&mut self.payload).is_err() {
                self.head = Some((head, length));
                break;
            }
            self.write_record(&head)?;
            self.last = head;
            if head.kind == Kind::Lost {
                self.lost_in_file += self.payload.first_chunk().map_or(0, |count| u64::from_le_bytes(*count));
            }
        }
        let Some(lost) = end_with_lost else { return Ok(()) };
        if lost > self.lost_in_file {
            self.payload.clear();
            self.payload.extend((lost - self.lost_in_file).to_le_bytes());
            self.write_record(&RecordHead { kind: Kind::Lost, ..self.last })?;
        }
        self.payload.clear();
        self.write_record(&RecordHead { kind: Kind::End, ..self.last })
    }

    fn next_head(&mut self) -> Option<(RecordHead, usize)> {
        let mut head = [0; RECORD_HEAD_BYTES];
        self.ring.pop_entire_slice(&mut head).ok()?;
        RecordHead::decode(&head)
    }

    fn write_record(&mut self, head: &RecordHead) -> io::Result<()> {
        self.bytes.clear();
        encode_record(head, &self.payload, &mut self.bytes);
        self.out.file.write_all(&self.bytes)
    }
}

impl Shared {
    fn fail(&self, failure: String) {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(failure);
    }
}

#[cfg(test)]
mod tests {
    use std::io::BufReader;

    use tempfile::TempDir;

    use super::super::container::RawReader;
    use super::*;

    fn header() -> Header {
        Header {
            spec: "serial:/dev/x".into(),
            profile: "holod".into(),
            profile_toml: None,
            hid_descriptor: None,
            datagrams: false,
            scale_mm_per_unit: None,
            t_started: TimeNs(7),
            started_unix_ns: 0,
        }
    }

    /// Taps whose rings nobody empties yet, and what will.
    fn parts(ring_bytes: usize, path: &Path) -> (Taps, Writer) {
        let shared = Arc::new(Shared::default());
        let (producer, ring) = rtrb::RingBuffer::new(ring_bytes);
        let out = Output::create(path, &header().encode()).expect("makes");
        let writer =
            Writer { raw: Some(RawWriter::new(ring, TimeNs(7), out)), decisions: None, shared: Arc::clone(&shared) };
        let taps = Taps { raw: Some(producer), decisions: None, connection: 0, lost: 0, t_last: TimeNs(7), shared };
        (taps, writer)
    }

    /// What a file holds, and what is wrong with it.
    fn records(path: &Path) -> (Vec<(RecordHead, Vec<u8>)>, Vec<String>) {
        let mut reader = RawReader::new(BufReader::new(File::open(path).expect("opens"))).expect("a header");
        let mut records = Vec::new();
        while let Some((head, payload)) = reader.next().expect("reads") {
            records.push((head, payload.to_vec()));
        }
        let flaws = reader.flaws().collect();
        (records, flaws)
    }

    #[test]
    fn what_finds_no_room_is_counted_and_the_file_tells_of_it() {
        let folder = TempDir::new().expect("a folder");
        let path = folder.path().join("raw");
        let (mut taps, mut writer) = parts(100, &path);
        let bytes = |t: i64| (RecordHead { kind: Kind::Bytes, t: TimeNs(t), connection: 0 }, vec![1; 30]);
        let lost = |t: i64, count: u64| {
            (RecordHead { kind: Kind::Lost, t: TimeNs(t), connection: 0 }, count.to_le_bytes().to_vec())
        };
        for t in 1..=4 {
            taps.bytes(TimeNs(t), &[1; 30]);
        }
        writer.write(false, false);
        taps.bytes(TimeNs(5), &[1; 30]);
        for t in 6..=8 {
            taps.bytes(TimeNs(t), &[1; 30]);
        }
        writer.write(true, true);
        let (read, flaws) = records(&path);
        assert_eq!(read, [bytes(1), bytes(2), lost(2, 2), bytes(5), lost(5, 1), lost(5, 2)]);
        assert_eq!(flaws, [""; 0]);
        assert_eq!(taps.shared.chunks_lost.load(Ordering::Relaxed), 5);
    }

    #[test]
    fn a_record_that_is_half_in_the_ring_is_waited_for() {
        let folder = TempDir::new().expect("a folder");
        let path = folder.path().join("raw");
        let (mut taps, mut writer) = parts(100, &path);
        let head = RecordHead { kind: Kind::Bytes, t: TimeNs(1), connection: 1 };
        let ring = taps.raw.as_mut().expect("a ring");
        ring.push_entire_slice(&head.encode(3)).expect("room");
        writer.write(false, true);
        ring.push_entire_slice(b"abc").expect("room");
        writer.write(true, true);
        assert_eq!(records(&path), (vec![(head, b"abc".to_vec())], vec![]));
    }

    #[test]
    fn a_disk_that_is_full_is_told_and_nothing_waits_for_it() {
        let folder = TempDir::new().expect("a folder");
        let (mut taps, mut writer) = parts(1 << 12, &folder.path().join("raw"));
        let full = OpenOptions::new().write(true).open("/dev/full").expect("opens");
        writer.raw.as_mut().expect("a file").out.file = BufWriter::new(full);
        taps.bytes(TimeNs(1), b"abc");
        writer.write(false, true);
        assert!(writer.raw.is_none());
        let failure = writer.shared.failure.lock().expect("no panic").clone().expect("a failure");
        assert!(failure.contains("No space left") && failure.contains("make room on its disk"), "{failure}");
        for t in 0..1000 {
            taps.bytes(TimeNs(t), b"abc");
        }
        assert!(taps.shared.chunks_lost.load(Ordering::Relaxed) > 500);
    }

    #[test]
    fn a_disk_that_stands_still_at_the_end_is_not_waited_for() {
        let shared = Arc::new(Shared::default());
        let thread = thread::spawn(|| thread::sleep(Duration::from_secs(3600)));
        let mut recorder = Recorder { shared, thread: Some(thread) };
        recorder.finish_within(Duration::from_millis(20));
        assert!(recorder.status().failure.expect("a failure").contains("within 20ms"));
    }
}
