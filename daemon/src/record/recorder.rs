//! Writes down a run as it goes, with what it was made of.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{SystemTime, UNIX_EPOCH};

use holod_calibration::rig::{Rig, WeightsChoice};
use holod_calibration::{DisplayGeometry, Resolution, TimeNs};
use holod_slm_output::FieldEvent;
use serde::{Deserialize, Serialize};

use super::sources::{self, SceneSource, SourceFile};
use super::{FieldRecord, FrameLog, FrameRecord};
use crate::cli::{self, Backend, NetworkArgs, RigArgs, RunArgs, SceneArgs};
use crate::control::Request;
use crate::destination::refuse_existing;
use crate::failure::{Exit, Failure};
use crate::logging::LogFile;
use crate::machine::Machine;
use crate::report;
use crate::session::{Began, Observer};
use crate::{setup, source};

/// What a run was started with; `run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunFacts {
    /// What `holod --version` says.
    pub holod: String,
    /// When it began, by the wall clock: milliseconds since 1970.
    pub started_unix_ms: u64,
    /// The same by the host's monotonic clock.
    pub t_origin_ns: i64,
    /// The scene.
    pub scene: SceneSource,
    /// Size of the hologram, pixels.
    pub hologram: [usize; 2],
    /// The tracker's spec.
    pub tracker: String,
    /// Millimetres for one unit of the tracker's figure.
    pub scale_mm_per_unit: Option<f64>,
    /// The panel's spec.
    pub panel: String,
    /// The engine that was asked for.
    pub backend: Backend,
    /// How holograms are computed.
    pub engine: String,
    /// The machine.
    pub machine: Machine,
}

/// The files of what an order brought; a line of `order-files.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OrderSource {
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
pub const RUN: &str = "run.json";
/// Name of the log in a record.
pub const LOG: &str = "log.txt";
/// Name of the lines of [`OrderSource`] in a record.
pub const ORDER_FILES: &str = "order-files.jsonl";

/// What tells which files an order brings.
#[derive(Clone)]
struct Named {
    rig: RigArgs,
    network: NetworkArgs,
    geometry: DisplayGeometry,
    resolution: Resolution,
}

/// Writes down a run as it goes.
pub struct Recorder {
    folder: PathBuf,
    frames: FrameLog,
    log: LogFile,
    facts: RunFacts,
    named: Named,
    orders: u32,
    /// Reads the files of what an order brought.
    reading: Option<JoinHandle<()>>,
    failed: Option<Failure>,
}

impl Recorder {
    /// Starts the record that `args` ask for in `folder`, of a run of `rig` with holograms of `resolution`.
    ///
    /// # Errors
    /// An earlier record is there, a file cannot be read or written.
    pub fn create(folder: &Path, args: &RunArgs, rig: &Rig, resolution: Resolution) -> Result<Self, Failure> {
        let own = [LOG, RUN, ORDER_FILES, sources::BENCH].map(|name| folder.join(name));
        refuse_existing(own, "--record", false)?;
        let frames = FrameLog::create(folder)?;
        let started = Self::start(folder, args, rig, resolution);
        match started {
            Ok((log, facts)) => Ok(Self {
                folder: folder.to_owned(),
                frames,
                log,
                facts,
                named: Named {
                    rig: args.rig.clone(),
                    network: args.network.clone(),
                    geometry: rig.geometry,
                    resolution,
                },
                orders: 0,
                reading: None,
                failed: None,
            }),
            Err(failure) => {
                discard(folder);
                frames.discard_if_empty();
                Err(failure)
            }
        }
    }

    fn start(folder: &Path, args: &RunArgs, rig: &Rig, resolution: Resolution) -> Result<(LogFile, RunFacts), Failure> {
        let log = LogFile::begin(&folder.join(LOG)).map_err(|error| {
            Failure::new(Exit::CannotCreate, format!("cannot record into {}: {error}", folder.display()))
        })?;
        sources::keep_bench(folder, args.rig.config.as_deref(), rig)?;
        let facts = RunFacts {
            holod: env!("HOLOD_VERSION").into(),
            started_unix_ms: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64),
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
    pub fn with_tracker(mut self, spec: String) -> Self {
        self.facts.tracker = spec;
        self
    }

    /// Hands everything to the operating system and ends the log.
    ///
    /// # Errors
    /// The disk's, with the file's name.
    pub fn finish(&mut self) -> Result<(), Failure> {
        self.wait_for_reading();
        self.log.end();
        self.frames.flush()
    }

    /// Ends the record of a run that failed. Where no frame was ever made it is taken away again, so that the same directory
    /// may be named again.
    pub fn fail(mut self, failure: &Failure) {
        self.wait_for_reading();
        self.log.ended_by(failure);
        self.log.end();
        if self.frames.is_empty() {
            discard(&self.folder);
        }
        self.frames.discard_if_empty();
    }

    fn wait_for_reading(&mut self) {
        if let Some(reading) = self.reading.take() {
            // A panic over there was told; the line is missing then.
            let _ = reading.join();
        }
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
        let path = self.folder.join(ORDER_FILES);
        let read = move || {
            // One after another, so that lines are whole.
            if let Some(before) = before {
                let _ = before.join();
            }
            let noted = order_source(order, &request, &named).and_then(|source| append(&path, &source));
            if let Err(failure) = noted {
                tracing::warn!("the record lacks the files of order {order}: {failure}");
            }
        };
        match std::thread::Builder::new().name("holod-record".into()).spawn(read) {
            Ok(reading) => self.reading = Some(reading),
            Err(error) => tracing::warn!("the record lacks the files of order {order}: {error}"),
        }
    }
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

/// The file that holds weights, where they are in a file.
fn weights_file(weights: &WeightsChoice) -> Result<Option<SourceFile>, Failure> {
    let WeightsChoice::File(path) = weights else { return Ok(None) };
    SourceFile::of(path, sources::WEIGHTS.into()).map(Some).map_err(Failure::because(Exit::NoInput))
}

fn append(path: &Path, source: &OrderSource) -> Result<(), Failure> {
    let line = serde_json::to_string(source).map_err(Failure::because(Exit::Software))?;
    let file = OpenOptions::new().create(true).append(true).open(path);
    file.and_then(|mut file| writeln!(file, "{line}")).map_err(Failure::because(Exit::CannotCreate))
}

/// Takes away what was written before the first frame.
fn discard(folder: &Path) {
    for name in [LOG, RUN, ORDER_FILES] {
        let _ = fs::remove_file(folder.join(name));
    }
    let _ = sources::remove_bench(folder);
}

impl Observer for Recorder {
    fn began(&mut self, bench: &mut Began) {
        self.facts.t_origin_ns = bench.t_origin.0;
        self.facts.engine.clone_from(&bench.engine);
        self.failed = report::save_json(&self.facts, &self.folder.join(RUN)).err();
    }

    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        self.frames.frame(*record);
        Ok(())
    }

    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        self.frames.field(&FieldRecord::of(event))
    }

    fn order(&mut self, t: TimeNs, request: &Request) -> Result<(), Failure> {
        self.orders += 1;
        self.note_files(request);
        self.frames.order(t, request)
    }

    fn tick(&mut self) -> Result<(), Failure> {
        match self.failed.take() {
            Some(failure) => Err(failure),
            None => self.frames.flush(),
        }
    }
}
