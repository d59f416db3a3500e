//! Writes down a run as it goes, with what it was made of. A thread of its own writes: whoever records waits for no
//! disk.

use std::collections::VecDeque;
use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use holod_calibration::rig::{Rig, WeightsChoice};
use holod_calibration::{DisplayGeometry, Resolution, TimeNs, host_now};
use holod_slm_output::FieldEvent;
use serde::{Deserialize, Serialize};

use super::place::Place;
use super::sources::{self, SceneSource, SourceFile, weights_file};
use super::{FieldRecord, FrameLog, RecordFolder, RecordHealth};
use crate::aside::{Queue, Taking, join_within};
use crate::cli::{self, Backend, NetworkArgs, RigArgs, RunArgs, SceneArgs};
use crate::control::Request;
use crate::failure::{Exit, Failure};
use crate::frame_record::FrameRecord;
use crate::logging::LogFile;
use crate::machine::Machine;
use crate::observer::{Began, Observer};
use crate::results;
use crate::{setup, source};

/// What a run was started with; `run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct RunFacts {
    /// What `holod --version` says.
    pub holod: String,
    /// When it began, by the wall clock: milliseconds since 1970.
    pub started_unix_ms: u64,
    /// The same by the host's monotonic clock.
    pub t_origin_ns: i64,
    pub scene: SceneSource,
    /// Size of the hologram, pixels.
    pub hologram: [usize; 2],
    pub tracker: String,
    /// Millimetres for one unit of the tracker's figure.
    pub scale_mm_per_unit: Option<f64>,
    pub panel: String,
    /// The engine that was asked for.
    pub backend: Backend,
    /// How holograms are computed.
    pub engine: String,
    pub machine: Machine,
}

/// The files of what an order brought; a line of `order-files.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct OrderSource {
    /// Its line in `orders.jsonl`.
    pub order: u32,
    /// The scene that it brought.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene: Option<SceneSource>,
    /// The file of the weights that it brought.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<SourceFile>,
}

/// Name of [`RunFacts`] in a record.
pub(crate) const RUN: &str = "run.json";
/// Name of the log in a record.
pub(crate) const LOG: &str = "log.txt";
/// Name of the lines of [`OrderSource`] in a record.
pub(crate) const ORDER_FILES: &str = "order-files.jsonl";

/// What tells which files an order brings.
#[derive(Clone)]
struct Named {
    rig: RigArgs,
    network: NetworkArgs,
    geometry: DisplayGeometry,
    resolution: Resolution,
}

/// Rows that may wait for the disk: a minute of 60 frames a second in three colours.
const ROWS: usize = 1 << 14;
/// Orders that may wait for it beside them. None may be missing: each is known by its number.
const ORDERS_ROOM: usize = 1 << 12;
/// How often what has come is handed to the operating system.
const WRITE_INTERVAL: Duration = Duration::from_millis(100);
/// How long the end of a run waits for the disk to take what is left.
const FINISH: Duration = Duration::from_secs(5);

/// What the thread that writes is handed.
enum Entry {
    Began(Box<RunFacts>),
    Frame(FrameRecord),
    Field(FieldRecord),
    Order(TimeNs, Box<Request>),
}

/// What that thread has in hand.
struct Writing {
    frames: FrameLog,
    folder: RecordFolder,
}

/// Writes down a run as it goes.
pub(crate) struct Recorder {
    place: Arc<Place>,
    log: LogFile,
    facts: RunFacts,
    named: Named,
    orders: u32,
    /// Reads the files of what an order brought.
    reading: Option<JoinHandle<()>>,
    entries: Arc<Queue<Entry>>,
    writer: Option<JoinHandle<Writing>>,
    /// What it had in hand at its end.
    written: Option<Writing>,
    health: Arc<RecordHealth>,
    slowness: Slowness,
}

/// What was said of rows that the disk was too slow for.
#[derive(Default)]
struct Slowness {
    /// Rows that were lost at the last look.
    seen: u64,
    /// Of those, rows of which it was said.
    told: u64,
}

impl Recorder {
    /// Starts the record of a run of `rig` in `folder`, with holograms of `resolution`, as `args` ask for it.
    ///
    /// # Errors
    /// A file cannot be read or written.
    pub(crate) fn create(
        folder: RecordFolder,
        args: &RunArgs,
        rig: &Rig,
        resolution: Resolution,
    ) -> Result<Self, Failure> {
        let place = folder.place();
        let itself = place.itself();
        let told = |failure| place.told(&failure);
        let frames = FrameLog::create(&itself).map_err(told)?;
        let (log, facts) = Self::start(&itself, args, rig, resolution).map_err(told)?;
        let entries = Arc::new(Queue::default());
        let health = Arc::new(RecordHealth::new(Arc::clone(&place)));
        let write = {
            let (entries, health, run) = (Arc::clone(&entries), Arc::clone(&health), itself.join(RUN));
            move || write_entries(&entries, Writing { frames, folder }, &run, &health)
        };
        let writer = thread::Builder::new()
            .name("holod-record".into())
            .spawn(write)
            .map_err(Failure::because(Exit::Unavailable))?;
        Ok(Self {
            place,
            log,
            facts,
            named: Named { rig: args.rig.clone(), network: args.network.clone(), geometry: rig.geometry, resolution },
            orders: 0,
            reading: None,
            entries,
            writer: Some(writer),
            written: None,
            health,
            slowness: Slowness::default(),
        })
    }

    /// A path to the record's folder, wherever that is moved, for as long as this lives or its health.
    pub(crate) fn folder(&self) -> PathBuf {
        self.place.itself()
    }

    /// Whether the record goes on, for others who write into its folder, and who ask.
    pub(crate) fn health(&self) -> Arc<RecordHealth> {
        Arc::clone(&self.health)
    }

    fn start(folder: &Path, args: &RunArgs, rig: &Rig, resolution: Resolution) -> Result<(LogFile, RunFacts), Failure> {
        let log = LogFile::begin(&folder.join(LOG)).map_err(|error| {
            Failure::new(Exit::CannotCreate, format!("cannot record into {}: {error}", folder.display()))
        })?;
        sources::keep_bench(folder, args.rig.config.as_deref(), rig)?;
        let facts = RunFacts {
            holod: env!("HOLOD_VERSION").into(),
            started_unix_ms: 0,
            t_origin_ns: 0,
            scene: SceneSource::of(&args.scene, &rig.geometry)?,
            hologram: [resolution.width, resolution.height],
            tracker: String::new(),
            scale_mm_per_unit: args.scale,
            panel: args.output.clone(),
            backend: args.backend,
            engine: String::new(),
            machine: Machine::this(),
        };
        Ok((log, facts))
    }

    /// Says what the tracker's spec is.
    #[must_use]
    pub(crate) fn with_tracker(mut self, spec: String) -> Self {
        self.facts.tracker = spec;
        self
    }

    /// Hands everything to the operating system. A disk that does not take it within seconds has lost the record.
    /// Whether there is one: where no frame was written, an earlier record is put back when this is dropped, with which
    /// the log ends, too.
    pub(crate) fn finish(&mut self) -> bool {
        self.written = self.end_writing();
        self.log.flush();
        self.note_log();
        let Some(Writing { folder, .. }) = &mut self.written else { return false };
        if folder.earlier_waits() {
            tracing::warn!("no frame was recorded: the earlier record in {} stays", self.place.path().display());
            return false;
        }
        if let Err(failure) = folder.keep() {
            self.health.give_up(&failure.to_string());
        }
        true
    }

    /// Ends the record of a run that failed. Where no frame was ever made it is taken away again, so that the same
    /// directory may be named again. The failure as it is to be told.
    pub(crate) fn fail(mut self, failure: &Failure) -> Failure {
        let failure = self.place.told(failure);
        let writing = self.end_writing();
        self.log.ended_by(&failure);
        self.log.end();
        drop(writing);
        failure
    }

    fn end_writing(&mut self) -> Option<Writing> {
        self.entries.close();
        let reading = self.reading.take().map(|reading| join_within(reading, FINISH));
        if reading == Some(None) {
            tracing::warn!("the record lacks the files of the last order: they are not read yet");
        }
        let writing = join_within(self.writer.take()?, FINISH);
        if writing.is_none() {
            let folder = self.place.path().display();
            self.health.give_up(&format!("the disk of {folder} does not take what was left within {FINISH:?}"));
        }
        writing
    }

    /// Hands an entry over; one that finds no room is a row less.
    fn put(&mut self, entry: Entry) {
        if !self.health.is_lost() && !self.entries.put(entry, ROWS) {
            self.health.lose_row();
        }
    }

    /// What was written into the log's file is lost, too, where nobody can write there.
    fn note_log(&self) {
        if let Some(trouble) = self.log.trouble() {
            self.health.give_up(&trouble);
        }
    }

    /// Says that rows were left out: when it begins, and how many they were once there is room again.
    fn tell_slowness(&mut self) {
        let lost = self.health.rows_lost();
        let Slowness { seen, told } = &mut self.slowness;
        let folder = self.place.path().display();
        if lost > *seen && *seen == *told {
            tracing::warn!("the disk of {folder} is too slow for the record: rows are left out until it has caught up");
        } else if lost == *seen && *seen > *told {
            tracing::warn!("the record in {folder} goes on; {} rows were left out", lost - *told);
            *told = lost;
        }
        *seen = lost;
    }

    /// Reads the files of what an order brought, beside the run: the control thread waits for no disk.
    fn note_files(&mut self, request: &Request) {
        let order = self.orders;
        let named = self.named.clone();
        let request = request.clone();
        let reads_files = match &request {
            Request::Scene { scene, .. } => !source::is_feed(scene),
            Request::Weights { weights } => matches!(cli::parse_weights(weights), Ok(WeightsChoice::File(_))),
            Request::Reload { .. } => true,
            _ => false,
        };
        if !reads_files {
            return;
        }
        let before = self.reading.take();
        let place = Arc::clone(&self.place);
        let read = move || {
            // One after another, so that lines are whole.
            if let Some(before) = before {
                let _ = before.join();
            }
            let noted = order_source(order, &request, &named)
                .and_then(|source| append(&place.itself().join(ORDER_FILES), &source));
            if let Err(failure) = noted {
                tracing::warn!("the record lacks the files of order {order}: {failure}");
            }
        };
        match thread::Builder::new().name("holod-order".into()).spawn(read) {
            Ok(reading) => self.reading = Some(reading),
            Err(error) => tracing::warn!("the record lacks the files of order {order}: {error}"),
        }
    }
}

/// What the wall clock showed at host time `t`, as it goes now.
fn unix_ms_at(t: TimeNs) -> u64 {
    let unix_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as i64);
    ((unix_ns - (host_now() - t).0).max(0) / 1_000_000) as u64
}

fn order_source(order: u32, request: &Request, named: &Named) -> Result<OrderSource, Failure> {
    let (mut scene, mut weights) = (None, None);
    match request {
        Request::Scene { scene: spec, depth_encoding, fit } => {
            let args = SceneArgs {
                scene: Some(spec.clone()),
                depth_encoding: depth_encoding.clone(),
                fit: (*fit).into(),
                resolution: Some(named.resolution),
            };
            scene = Some(SceneSource::of(&args, &named.geometry)?);
        }
        Request::Weights { weights: weights_named } => {
            weights = weights_file(&cli::parse_weights(weights_named).map_err(|why| Failure::new(Exit::Usage, why))?)?;
        }
        Request::Reload { .. } => {
            weights = weights_file(&setup::rig_with_network(&named.rig, &named.network)?.model.weights)?;
        }
        _ => {}
    }
    Ok(OrderSource { order, scene, weights })
}

fn append(path: &Path, source: &OrderSource) -> Result<(), Failure> {
    let line = serde_json::to_string(source).map_err(Failure::because(Exit::Software))?;
    let file = OpenOptions::new().create(true).append(true).open(path);
    file.and_then(|mut file| writeln!(file, "{line}")).map_err(Failure::because(Exit::CannotCreate))
}

/// Writes what comes until nothing more does; a record with a frame is kept. Where the disk refuses, the record is
/// given up, and the rest dropped.
fn write_entries(entries: &Queue<Entry>, mut writing: Writing, run: &Path, health: &RecordHealth) -> Writing {
    let mut taken = VecDeque::new();
    while entries.take(&mut taken, Taking::Every(WRITE_INTERVAL)) {
        if health.is_lost() {
            continue;
        }
        let Writing { frames, folder } = &mut writing;
        let mut write = |entry| match entry {
            Entry::Began(facts) => results::save_json(&facts, run),
            Entry::Frame(record) => {
                frames.frame(record);
                Ok(())
            }
            Entry::Field(field) => frames.field(&field),
            Entry::Order(t, request) => frames.order(t, &request),
        };
        let written = taken.drain(..).try_for_each(&mut write).and_then(|()| frames.flush());
        let kept = written.and_then(|()| if frames.is_empty() { Ok(()) } else { folder.keep() });
        match kept {
            Ok(()) => health.look_for_folder(),
            Err(failure) => health.give_up(&failure.to_string()),
        }
    }
    writing
}

impl Observer for Recorder {
    fn began(&mut self, bench: &mut Began) {
        self.facts.t_origin_ns = bench.t_origin.0;
        self.facts.started_unix_ms = unix_ms_at(bench.t_origin);
        self.facts.engine.clone_from(&bench.engine);
        self.put(Entry::Began(Box::new(self.facts.clone())));
    }

    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        self.put(Entry::Frame(*record));
        Ok(())
    }

    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        self.put(Entry::Field(FieldRecord::of(event)));
        Ok(())
    }

    fn order(&mut self, t: TimeNs, request: &Request) -> Result<(), Failure> {
        self.orders += 1;
        if self.health.is_lost() {
            return Ok(());
        }
        self.note_files(request);
        if !self.entries.put(Entry::Order(t, Box::new(request.clone())), ROWS + ORDERS_ROOM) {
            self.health.give_up(&format!("the disk of {} is too slow for its orders", self.place.path().display()));
        }
        Ok(())
    }

    fn tick(&mut self) -> Result<(), Failure> {
        self.note_log();
        self.tell_slowness();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::io::Read;

    use clap::Parser;

    use super::*;
    use crate::cli::Cli;
    use crate::record::{FRAMES, ORDERS};
    use crate::snapshot::RecordCondition;
    use holod_calibration::PupilDiameter;
    use holod_slm_output::PanelEncoder;

    fn recorder(folder: &Path) -> Recorder {
        recorder_in(RecordFolder::claim(folder, false).unwrap())
    }

    fn forced_recorder(folder: &Path) -> Recorder {
        recorder_in(RecordFolder::claim(folder, true).unwrap())
    }

    fn recorder_in(folder: RecordFolder) -> Recorder {
        let args = Cli::try_parse_from(["holod", "--record", "elsewhere"]).unwrap().run;
        Recorder::create(folder, &args, &Rig::default(), Resolution { width: 64, height: 64 }).unwrap()
    }

    fn frame(number: u64) -> FrameRecord {
        FrameRecord {
            pupil_estimate: None,
            t_wake: TimeNs(1),
            t_render_begin: TimeNs(2),
            t_render_end: TimeNs(3),
            t_submit: TimeNs(4),
            t_desired_present: TimeNs(5),
            ..FrameRecord::of_pupil(number, PupilDiameter::from_mm(3.0))
        }
    }

    #[test]
    fn whoever_records_waits_for_no_disk_and_rows_beyond_a_minute_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&folder.path().join("record"));
        // A disk that stands still: the writer ends, and nobody takes what comes.
        recorder.entries.close();
        let writing = join_within(recorder.writer.take().unwrap(), FINISH).unwrap();
        recorder.entries = Arc::new(Queue::default());
        for number in 0..ROWS as u64 + 100 {
            recorder.frame(&frame(number)).unwrap();
        }
        recorder.order(TimeNs(6), &Request::LasersDark {}).unwrap();
        let rows_lost = || recorder.health.state().rows_lost;
        assert_eq!((rows_lost(), recorder.health.is_lost()), (100, false), "an order finds room yet");
        recorder.tell_slowness();
        assert_eq!((recorder.slowness.seen, recorder.slowness.told), (100, 0));

        // It goes on.
        let (entries, health, run) = (Arc::clone(&recorder.entries), recorder.health(), folder.path().join("run.json"));
        recorder.writer = Some(thread::spawn(move || write_entries(&entries, writing, &run, &health)));
        recorder.tell_slowness();
        assert_eq!(recorder.slowness.told, 100);
        recorder.finish();
        assert!(!recorder.health.is_lost());
        assert_eq!(fs::read_to_string(folder.path().join("record").join(ORDERS)).unwrap().lines().count(), 1);
    }

    #[test]
    fn the_two_times_at_which_a_run_began_are_one_moment() {
        const HOUR: TimeNs = TimeNs(3_600_000_000_000);
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = recorder(folder.path());
        let rig = Rig::default();
        let encoder = PanelEncoder::new(&rig.panel, rig.resolution(), Resolution { width: 64, height: 64 });
        let mut began = Began {
            t_origin: host_now() - HOUR,
            encoder: Arc::new(encoder.unwrap()),
            rig,
            engine: String::new(),
            look: None,
        };
        recorder.began(&mut began);
        recorder.frame(&frame(1)).unwrap();
        assert!(recorder.finish());
        let run: RunFacts = serde_json::from_slice(&fs::read(folder.path().join(RUN)).unwrap()).unwrap();
        assert_eq!(run.t_origin_ns, began.t_origin.0);
        let since = SystemTime::now().duration_since(UNIX_EPOCH + Duration::from_millis(run.started_unix_ms)).unwrap();
        let off_s = since.as_secs_f64() - (host_now() - began.t_origin).seconds();
        assert!(off_s.abs() < 60.0, "{off_s}");
    }

    #[test]
    fn an_earlier_record_goes_with_the_first_frame() {
        let folder = tempfile::tempdir().unwrap();
        let frames_csv = || fs::read_to_string(folder.path().join(FRAMES)).unwrap();
        fs::write(folder.path().join(FRAMES), "old").unwrap();
        let mut without_frame = forced_recorder(folder.path());
        assert!(!without_frame.finish());
        drop(without_frame);
        assert_eq!(frames_csv(), "old");

        forced_recorder(folder.path()).fail(&Failure::new(Exit::Unavailable, "no panel"));
        assert_eq!(frames_csv(), "old");

        let mut recorder = forced_recorder(folder.path());
        recorder.frame(&frame(1)).unwrap();
        assert!(recorder.finish());
        drop(recorder);
        assert!(frames_csv().starts_with("frame,field,"));
    }

    #[test]
    fn a_disk_that_never_takes_the_rest_loses_the_record_and_holds_nobody_up() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = recorder(folder.path());
        recorder.entries.close();
        let _written = join_within(recorder.writer.take().unwrap(), FINISH);
        let (mut pipe, _nobody_writes) = std::io::pipe().unwrap();
        recorder.writer = Some(thread::spawn(move || {
            let _stuck = pipe.read(&mut [0; 1]);
            unreachable!("nobody writes")
        }));
        recorder.finish();
        let state = recorder.health.state();
        assert_eq!(state.state, RecordCondition::Lost);
        assert!(state.reason.unwrap().contains("within 5s"));
    }

    #[test]
    fn a_record_that_is_deleted_is_given_up_and_what_comes_is_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let record = folder.path().join("record");
        let mut recorder = recorder(&record);
        recorder.frame(&frame(1)).unwrap();
        assert!(record.join(FRAMES).exists());
        fs::remove_dir_all(&record).unwrap();
        let t_end = std::time::Instant::now() + Duration::from_secs(20);
        while !recorder.health.is_lost() && std::time::Instant::now() < t_end {
            thread::sleep(WRITE_INTERVAL);
        }
        let reason = recorder.health.state().reason.expect("it is noticed");
        assert!(reason.contains("frames.csv: the file was deleted or moved; leave a record where it is"), "{reason}");
        for number in 0..3 * ROWS as u64 {
            recorder.frame(&frame(number)).unwrap();
        }
        assert_eq!(recorder.health.rows_lost(), 0, "they are not wanted any more");
        recorder.finish();
    }
}
