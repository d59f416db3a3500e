//! Makes the frames of a report again, in the loop that made them, and compares.

use std::collections::{BTreeMap, HashMap};
use std::ffi::OsStr;
use std::fs;
use std::path::Path;
use std::sync::{Arc, Mutex};

use holod_calibration::rig::{LaserDriver, Rig, WeightsChoice};
use holod_calibration::{Colour, Resolution, TimeNs};
use holod_model::RgbdFrame;
use holod_model::scene::Scene;
use holod_slm_output::output::DarkSwitch;
use holod_slm_output::{FieldEvent, LevelsFrame};
use serde::Serialize;
use serde_json::Value;
use toml_edit::DocumentMut;

use super::recorded::{self, Made, RecordedFrame};
use super::{SCENE_FOLDER, Unpacked, order_folder};
use crate::cli::{Backend, SceneArgs};
use crate::control::{Order, Preparer, Request};
use crate::dark_note::DarkNote;
use crate::failure::{Exit, Failure};
use crate::record::{
    BENCH, FRAMES, FrameRecord, ORDER_FILES, ORDERS, OrderSource, RIG, RUN, RunFacts, SCENE, SceneSource, SourceFile,
    content_xxh3, hash_text,
};
use crate::renderer::{self, Use};
use crate::session::{Cue, Observer, Playback};
use crate::source::Pictures;
use crate::source::scene::{self, Frames};

/// Engines that are held beside the first: each has the memory of a run's own.
const MOST_ENGINES: usize = 4;
/// Patterns that are held, each as large as the panel, and scenes beside the first.
const MOST_PATTERNS: usize = 64;
const MOST_SCENES: usize = 16;
/// Differences that are told one by one.
const TOLD: usize = 10;

/// A report that is ready to be shown again.
pub struct Played {
    /// Its bench, with simulated lasers.
    pub rig: Rig,
    /// The pictures with which the run began.
    pub pictures: Pictures,
    /// Which engine to take.
    pub backend: Backend,
    /// What the frames are.
    pub(crate) playback: Playback,
    /// What they are compared with.
    pub comparison: Comparison,
}

/// The backend that computes as the engine of that description did, or `Auto` where it was a GPU and there is none.
fn like(engine: &str, there_is_a_gpu: impl FnOnce() -> bool) -> Backend {
    let half = engine.contains("half precision");
    if engine.starts_with("cpu") {
        if half { Backend::CpuHalf } else { Backend::Cpu }
    } else if !there_is_a_gpu() {
        Backend::Auto
    } else if half {
        Backend::GpuHalf
    } else {
        Backend::Gpu
    }
}

/// Reads everything that the frames of a report need. `backend` is the engine that is wanted; `Auto` is that of the
/// run.
///
/// # Errors
/// The report lacks what every frame needs, or none of its frames can be made again.
pub fn prepare(report: &Unpacked, backend: Backend) -> Result<Played, Failure> {
    let data = |what: String| Failure::new(Exit::Data, what);
    let facts = report.text(RUN)?.ok_or_else(|| {
        data(
            "the report holds no run: its frames cannot be shown again; `holod report DIR` packs a record of one"
                .into(),
        )
    })?;
    let facts: RunFacts = serde_json::from_str(&facts).map_err(|error| {
        data(format!("{RUN}: {error}; show it with the holod that made it, or ask for the report again"))
    })?;
    let config = report.path(BENCH).join(RIG);
    refuse_foreign_files(report)?;
    let mut rig = Rig::load(&config).map_err(Failure::because(Exit::Data))?;
    // Nothing that a report says lights a laser.
    rig.lasers.driver = LaserDriver::Simulated;
    // Nor does it name this machine's GPU.
    rig.model.gpu = None;
    if let Some(scale) = facts.scale_mm_per_unit {
        rig.tracker.scale = Some(scale);
    }
    let [width, height] = facts.hologram;
    let resolution = Resolution { width, height };
    let panel = rig.resolution();
    if width.min(height) == 0 || width > panel.width || height > panel.height {
        return Err(data(format!(
            "{RUN}: found a hologram of {resolution}, expected one that fits on the panel of {panel}"
        )));
    }
    let backend = match backend {
        Backend::Auto => like(&facts.engine, || holod_model::gpu::find().is_ok()),
        asked => asked,
    };
    if facts.holod != env!("HOLOD_VERSION") {
        tracing::warn!(
            "holod {} made the frames, and this is {}: levels may differ",
            facts.holod,
            env!("HOLOD_VERSION")
        );
    }
    let frames = recorded::read(&report.path(FRAMES))?;
    let orders = Orders::read(report)?;
    let mut material = Material {
        report,
        rig: &rig,
        resolution,
        backend,
        orders: &orders,
        scenes: HashMap::new(),
        opened_scenes: Vec::new(),
        engines: Vec::new(),
        opened_engines: Vec::new(),
        engine_places: HashMap::new(),
        patterns: Vec::new(),
        drawn: Vec::new(),
        pattern_places: HashMap::new(),
        pictures: Vec::new(),
        picture_places: HashMap::new(),
        preparer: None,
    };
    let (mut cues, mut not_again) = (Vec::new(), BTreeMap::new());
    let first_scene = material.first_scene(&facts.scene);
    material.opened_scenes.push((facts.scene.clone(), first_scene.clone()));
    material.scenes.insert(0, first_scene);
    for RecordedFrame { frame, made, .. } in &frames {
        let cue = made.as_ref().ok_or_else(|| "the record lacks what they were made for".to_owned());
        match cue.and_then(|made| material.cue(*frame, made)) {
            Ok(cue) => cues.push(cue),
            Err(why) => *not_again.entry(why).or_insert(0) += 1,
        }
    }
    if cues.is_empty() {
        let why: Vec<_> = not_again.iter().map(|(why, count)| format!("{count} frames: {why}")).collect();
        let why = if why.is_empty() { "the panel showed none".into() } else { why.join("; ") };
        return Err(data(format!("no frame of the report can be shown again: {why}")));
    }
    let Material { engines, patterns, pictures, scenes, .. } = material;
    let first = match scenes.into_iter().find(|(order, _)| *order == 0) {
        Some((_, Ok(scene))) => scene,
        // What cannot be shown again is black until an order brings something else.
        _ => black(resolution),
    };
    let comparison = Comparison::new(frames, &cues, not_again, &facts);
    let playback = Playback { cues, pictures, engines, patterns, at: 0, engine: 0 };
    Ok(Played { rig, pictures: Pictures::Scene(first), backend, playback, comparison })
}

/// Refuses a rig that names files outside of the report, before any of them is opened.
fn refuse_foreign_files(report: &Unpacked) -> Result<(), Failure> {
    // A text that is no TOML is told with its line when it is loaded.
    let Some(Ok(rig)) = report.text(&format!("{BENCH}/{RIG}"))?.map(|text| text.parse::<DocumentMut>()) else {
        return Ok(());
    };
    let keys =
        [("panel", "lut_file"), ("panel", "flatness_file"), ("lasers", "profile_file"), ("model", "weights_file")];
    for (table, key) in keys {
        let Some(found) = rig.get(table).and_then(|table| table.get(key)) else { continue };
        let of_colours = found.as_table_like().into_iter().flat_map(|files| files.iter().map(|(_, file)| file));
        for name in of_colours.chain([found]).filter_map(|file| file.as_str()) {
            let is_plain = Path::new(name).file_name() == Some(OsStr::new(name));
            if !is_plain || !report.holds(&report.path(BENCH).join(name)) {
                let what = format!("{BENCH}/{RIG}: {table}.{key} names `{name}`, which is not in the report");
                return Err(Failure::new(Exit::Data, what));
            }
        }
    }
    Ok(())
}

fn black(resolution: Resolution) -> Arc<Frames> {
    Arc::new(Frames {
        frames: vec![Arc::new(RgbdFrame::black(resolution))],
        fps: None,
        reports: Vec::new(),
        name: "black".into(),
    })
}

/// Reads the orders of a report whose rig names no file elsewhere.
#[cfg(fuzzing)]
pub(super) fn read_orders(report: &Unpacked) -> Result<(), Failure> {
    refuse_foreign_files(report)?;
    let orders = Orders::read(report)?;
    for order in 0..=orders.requests.len() as u32 + 1 {
        let _ = std::hint::black_box((orders.request(order), orders.built_in_weights(order)));
    }
    Ok(())
}

/// The orders of a record.
struct Orders {
    /// By their lines, as they were written down.
    requests: Vec<Value>,
    sources: HashMap<u32, OrderSource>,
    /// The first that changed something that is not carried out again, and what is said of it.
    foreign: Option<(TimeNs, String)>,
}

impl Orders {
    fn read(report: &Unpacked) -> Result<Self, Failure> {
        let lines = |name: &str| Ok::<_, Failure>(report.text(name)?.unwrap_or_default());
        let mut orders = Self { requests: Vec::new(), sources: HashMap::new(), foreign: None };
        let text = lines(ORDERS)?;
        // A run that broke off may have left half a line.
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        for (index, line) in whole.lines().enumerate() {
            let number = index + 1;
            let wrong = |what: String| Failure::new(Exit::Data, format!("{ORDERS} line {number}: {what}"));
            let mut order: Value = serde_json::from_str(line).map_err(|error| wrong(error.to_string()))?;
            let t = order["t_ns"].as_i64().ok_or_else(|| {
                wrong("found no t_ns, expected the time of the order in nanoseconds; ask for the report again".into())
            })?;
            let request = order["request"].take();
            if parsed(&request).is_err() && orders.foreign.is_none() {
                let what = request["do"].as_str().unwrap_or("something");
                let why = format!("order {number}, `{what}`, is not carried out again");
                orders.foreign = Some((TimeNs(t), why));
            }
            orders.requests.push(request);
        }
        for line in lines(ORDER_FILES)?.lines() {
            // A line that was cut off with the run is none.
            if let Ok(source) = serde_json::from_str::<OrderSource>(line) {
                orders.sources.insert(source.order, source);
            }
        }
        Ok(orders)
    }

    fn request(&self, order: u32) -> Result<&Value, String> {
        let request = (order as usize).checked_sub(1).and_then(|index| self.requests.get(index));
        request.ok_or_else(|| format!("order {order}, which brought what they show, is not in the report"))
    }

    /// The built-in weights that an order brought, by name or because the rig file was read again.
    fn built_in_weights(&self, order: u32) -> Result<&str, String> {
        let request = self.request(order)?;
        let named = [&request["weights"], &request["changed"]["model.network"]].into_iter().find_map(Value::as_str);
        let is_built_in = |named: &&str| WeightsChoice::BUILT_IN.iter().any(|(name, _)| name == named);
        named.filter(is_built_in).ok_or_else(|| format!("the weights of order {order} are not in the report"))
    }
}

/// A request out of a record, which also tells what of the rig file it changed.
fn parsed(request: &Value) -> Result<Request, String> {
    let mut request = request.clone();
    if let Some(request) = request.as_object_mut() {
        request.remove("changed");
    }
    serde_json::from_value(request).map_err(|error| error.to_string())
}

/// What frames are made of, read when the first frame needs it.
struct Material<'a> {
    report: &'a Unpacked,
    rig: &'a Rig,
    resolution: Resolution,
    backend: Backend,
    orders: &'a Orders,
    /// By the order that brought them.
    scenes: HashMap<u32, Result<Arc<Frames>, String>>,
    /// By what they are made of: several orders may have brought the same.
    opened_scenes: Vec<(SceneSource, Result<Arc<Frames>, String>)>,
    engines: Vec<crate::control::NewEngine>,
    /// Which weights each of them has: the name of built-in ones, or a file's hash.
    opened_engines: Vec<String>,
    engine_places: HashMap<u32, Result<usize, String>>,
    patterns: Vec<LevelsFrame>,
    /// What each of them was asked for with.
    drawn: Vec<Request>,
    pattern_places: HashMap<u32, Result<Option<usize>, String>>,
    pictures: Vec<Arc<RgbdFrame>>,
    picture_places: HashMap<(u32, u64), usize>,
    preparer: Option<Preparer>,
}

impl Material<'_> {
    fn cue(&mut self, frame: u64, made: &Made) -> Result<Cue, String> {
        // What an order changes comes after it is written down.
        if let Some((_, why)) = self.orders.foreign.as_ref().filter(|(t, _)| made.t_wake >= *t) {
            return Err(why.clone());
        }
        let FrameMaterial { picture, engine, pattern } = self.of(made)?;
        Ok(Cue {
            frame,
            pupil: made.pupil,
            pupil_state: made.pupil_state,
            picture,
            number: made.picture,
            engine,
            pattern,
            orders: made.orders,
        })
    }

    fn of(&mut self, made: &Made) -> Result<FrameMaterial, String> {
        let pattern = self.pattern(made.orders.pattern)?;
        if pattern.is_some() {
            // It rests on no picture and no engine; whichever is at work may stay.
            let picture = self.black_picture();
            return Ok(FrameMaterial { picture, engine: 0, pattern });
        }
        if made.is_live {
            return Err("pictures of a live feed are not recorded".into());
        }
        let engine = self.engine(made.orders.weights)?;
        let picture = self.picture(made.orders.scene, made.picture)?;
        Ok(FrameMaterial { picture, engine, pattern: None })
    }

    fn black_picture(&mut self) -> usize {
        let resolution = self.resolution;
        let pictures = &mut self.pictures;
        *self.picture_places.entry((u32::MAX, 0)).or_insert_with(|| {
            pictures.push(Arc::new(RgbdFrame::black(resolution)));
            pictures.len() - 1
        })
    }

    fn first_scene(&self, source: &SceneSource) -> Result<Arc<Frames>, String> {
        match source {
            // Until a client has handed something over.
            SceneSource::Feed => Ok(black(self.resolution)),
            source => self.load(SCENE_FOLDER, source),
        }
    }

    /// A scene in the report, which must be the one that was shown.
    fn load(&self, folder: &str, source: &SceneSource) -> Result<Arc<Frames>, String> {
        let missing = || "the scene is not in the report".to_owned();
        let mut named = SceneArgs { resolution: Some(self.resolution), ..SceneArgs::default() };
        if let SceneSource::Files { fit, files, .. } = source {
            let path = self.report.path(folder);
            for file in files {
                if !self.is_whole(folder, file) {
                    return Err(missing());
                }
            }
            named.fit = (*fit).into();
            let spec = path.to_str().ok_or_else(missing)?;
            let scene = Scene::open(spec, None).map_err(|error| error.to_string())?;
            if (0..scene.frames()).flat_map(|index| scene.pictures(index)).any(|path| !self.report.holds(&path)) {
                return Err(format!("{folder}/{SCENE} names pictures that are not in the report"));
            }
            named.scene = Some(spec.to_owned());
        }
        let mut loaded = scene::frames(&named, &self.rig.geometry).map_err(|failure| failure.to_string())?;
        if named.scene.is_some() {
            loaded.name = format!("{folder}/ of the report");
        }
        Ok(Arc::new(loaded))
    }

    /// Whether a file that the run read is in the report as it was.
    fn is_whole(&self, folder: &str, file: &SourceFile) -> bool {
        let path = self.report.path(folder).join(&file.name);
        // Asked first: a name may lead anywhere.
        self.report.holds(&path)
            && fs::File::open(&path)
                .and_then(|mut file| content_xxh3(&mut file))
                .is_ok_and(|found| found == (file.bytes, file.xxh3.clone()))
    }

    fn scene(&mut self, order: u32) -> Result<&Frames, String> {
        if !self.scenes.contains_key(&order) {
            let source = self.orders.sources.get(&order).and_then(|source| source.scene.as_ref());
            let scene = match source {
                Some(source) => self.open_scene(order, source),
                None => Err(format!("the scene of order {order} is not in the report")),
            };
            self.scenes.insert(order, scene);
        }
        self.scenes[&order].as_deref().map_err(Clone::clone)
    }

    fn open_scene(&mut self, order: u32, source: &SceneSource) -> Result<Arc<Frames>, String> {
        if let Some((_, scene)) = self.opened_scenes.iter().find(|(opened, _)| opened == source) {
            return scene.clone();
        }
        if self.opened_scenes.len() > MOST_SCENES {
            return Err(format!("more than {MOST_SCENES} scenes"));
        }
        let scene = self.load(&order_folder(order), source);
        self.opened_scenes.push((source.clone(), scene.clone()));
        scene
    }

    fn picture(&mut self, order: u32, number: u64) -> Result<usize, String> {
        if let Some(place) = self.picture_places.get(&(order, number)) {
            return Ok(*place);
        }
        let frame = usize::try_from(number)
            .ok()
            .and_then(|number| self.scene(order).map(|s| s.frames.get(number).cloned()).transpose());
        let frame = frame.unwrap_or_else(|| Err(format!("the scene has no picture {number}")))?;
        self.pictures.push(frame);
        self.picture_places.insert((order, number), self.pictures.len() - 1);
        Ok(self.pictures.len() - 1)
    }

    fn engine(&mut self, order: u32) -> Result<usize, String> {
        if order == 0 {
            return Ok(0);
        }
        if let Some(place) = self.engine_places.get(&order) {
            return place.clone();
        }
        let place = self.open_engine(order);
        self.engine_places.insert(order, place.clone());
        place
    }

    fn open_engine(&mut self, order: u32) -> Result<usize, String> {
        let (weights, known_by) = match self.orders.sources.get(&order).and_then(|source| source.weights.as_ref()) {
            Some(file) => {
                if !self.is_whole(&order_folder(order), file) {
                    return Err(format!("the weights of order {order} are not in the report"));
                }
                let path = self.report.path(&order_folder(order)).join(&file.name);
                (path.to_string_lossy().into_owned(), file.xxh3.clone())
            }
            None => {
                let name = self.orders.built_in_weights(order)?;
                (name.to_owned(), name.to_owned())
            }
        };
        if let Some(place) = self.opened_engines.iter().position(|opened| *opened == known_by) {
            return Ok(place + 1);
        }
        if self.engines.len() == MOST_ENGINES {
            return Err(format!("more than {MOST_ENGINES} weights beside the first"));
        }
        match self.carry_out(&Request::Weights { weights })? {
            Order::Engine(engine) => self.engines.push(engine),
            _ => return Err(format!("order {order} brought no weights")),
        }
        self.opened_engines.push(known_by);
        Ok(self.engines.len())
    }

    fn pattern(&mut self, order: u32) -> Result<Option<usize>, String> {
        if order == 0 {
            return Ok(None);
        }
        if let Some(place) = self.pattern_places.get(&order) {
            return place.clone();
        }
        let place = match parsed(self.orders.request(order)?) {
            Ok(request) => self.draw(request).map_err(|why| format!("order {order}: {why}")),
            Err(why) => Err(format!("order {order}: {why}")),
        };
        self.pattern_places.insert(order, place.clone());
        place
    }

    /// The place of what a request for a pattern shows; nothing where that is holograms.
    fn draw(&mut self, request: Request) -> Result<Option<usize>, String> {
        if !matches!(request, Request::Flat {} | Request::Pattern { .. } | Request::Hologram {}) {
            return Err("it brought no pattern".into());
        }
        if let Some(place) = self.drawn.iter().position(|drawn| *drawn == request) {
            return Ok(Some(place));
        }
        if self.patterns.len() == MOST_PATTERNS {
            return Err(format!("more than {MOST_PATTERNS} patterns"));
        }
        let Order::Pattern(Some(pattern)) = self.carry_out(&request)? else { return Ok(None) };
        self.patterns.push(*pattern.levels);
        self.drawn.push(request);
        Ok(Some(self.patterns.len() - 1))
    }

    fn carry_out(&mut self, request: &Request) -> Result<Order, String> {
        if self.preparer.is_none() {
            let encoder = renderer::panel_encoder(self.rig, self.resolution).map_err(|failure| failure.to_string())?;
            self.preparer = Some(Preparer {
                dark_note: DarkNote::on(&self.rig.lasers.driver),
                rig: self.rig.clone(),
                rig_again: None,
                weights: Arc::new(Mutex::new(self.rig.model.weights.clone())),
                resolution: self.resolution,
                frame: Arc::new(RgbdFrame::black(self.resolution)),
                backend: self.backend,
                used_for: Use::Command,
                encoder,
                has_feed: false,
                plays: false,
                stall_timeout: TimeNs(i64::MAX),
                lasers: DarkSwitch::of_no_output(),
            });
        }
        self.preparer.as_ref().ok_or("no preparer")?.prepare(request)
    }
}

/// The places of what a frame is made of.
struct FrameMaterial {
    picture: usize,
    engine: usize,
    pattern: Option<usize>,
}

/// Compares frames as they are made again with those of a report.
pub struct Comparison {
    /// By their numbers: those that are made again and have not come yet.
    awaited: HashMap<u64, u64>,
    fields: HashMap<u64, Vec<(u8, Colour)>>,
    shown: HashMap<u64, Vec<(u8, Colour)>>,
    outcome: Outcome,
}

/// How the frames of a report came out.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Outcome {
    /// Frames that the report has.
    pub frames_recorded: u64,
    /// Frames whose levels are the same to the byte.
    pub frames_same: u64,
    /// Frames whose levels are others.
    pub frames_different: u64,
    /// The numbers of the first of those.
    pub first_different: Vec<u64>,
    /// Frames that were not reached before the end.
    pub frames_not_reached: u64,
    /// Frames that cannot be made again, by the reason.
    pub frames_not_shown_again: BTreeMap<String, u64>,
    /// Frames that were shown with the same colour fields in the same order.
    pub fields_same: u64,
    /// Frames that were shown with others.
    pub fields_different: u64,
    /// The numbers of the first of those.
    pub first_fields_different: Vec<u64>,
    /// The holod and the engine that made them first.
    pub made_by: [String; 2],
    /// The holod and the engine that made them again.
    pub made_again_by: [String; 2],
}

impl Comparison {
    fn new(frames: Vec<RecordedFrame>, cues: &[Cue], not_again: BTreeMap<String, u64>, facts: &RunFacts) -> Self {
        let is_cued = |frame: u64| cues.binary_search_by_key(&frame, |cue| cue.frame).is_ok();
        let outcome = Outcome {
            frames_recorded: frames.len() as u64,
            frames_not_shown_again: not_again,
            made_by: [facts.holod.clone(), facts.engine.clone()],
            ..Outcome::default()
        };
        let (mut awaited, mut fields) = (HashMap::new(), HashMap::new());
        for frame in frames.into_iter().filter(|frame| is_cued(frame.frame)) {
            awaited.extend(frame.made.map(|made| (frame.frame, made.levels_xxh3)));
            fields.insert(frame.frame, frame.fields);
        }
        Self { awaited, fields, shown: HashMap::new(), outcome }
    }

    /// What has come out, of a run with this engine.
    pub fn finish(mut self, engine: &str) -> Outcome {
        self.outcome.frames_not_reached = self.awaited.len() as u64;
        self.outcome.made_again_by = [env!("HOLOD_VERSION").into(), engine.to_owned()];
        let mut shown: Vec<_> = self.shown.into_iter().collect();
        shown.sort_unstable_by_key(|(frame, _)| *frame);
        // A run that ends in the middle of a frame has shown some of its fields.
        let cut_off = [shown.last().map(|(frame, _)| *frame), self.fields.keys().max().copied()];
        for (frame, shown) in shown {
            let Some(recorded) = self.fields.get(&frame) else { continue };
            let is_cut = cut_off.contains(&Some(frame)) && !shown.is_empty() && !recorded.is_empty();
            let same = shown == *recorded || is_cut && (shown.starts_with(recorded) || recorded.starts_with(&shown));
            if same {
                self.outcome.fields_same += 1;
            } else {
                self.outcome.fields_different += 1;
                note(&mut self.outcome.first_fields_different, frame);
            }
        }
        self.outcome
    }
}

fn note(told: &mut Vec<u64>, frame: u64) {
    if told.len() < TOLD {
        told.push(frame);
    }
}

impl Observer for Comparison {
    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        let Some(expected) = self.awaited.remove(&record.frame) else { return Ok(()) };
        // A frame without a hash is not the same.
        let found = record.levels_xxh3;
        if found == Some(expected) {
            self.outcome.frames_same += 1;
            return Ok(());
        }
        self.outcome.frames_different += 1;
        if self.outcome.first_different.len() < TOLD {
            let (frame, pupil_mm) = (record.frame, record.pupil.mm());
            let (expected, found) = (hash_text(expected), found.map_or("none".into(), hash_text));
            tracing::warn!(
                "frame {frame}, for a pupil of {pupil_mm} mm, has other levels: {found}, recorded {expected}"
            );
        }
        note(&mut self.outcome.first_different, record.frame);
        Ok(())
    }

    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        if !event.repeated {
            let shown = self.shown.entry(event.frame_id).or_default();
            let field = event.field as u8;
            if shown.iter().all(|(known, _)| *known != field) {
                shown.push((field, event.colour));
            }
        }
        Ok(())
    }
}

impl Outcome {
    /// Whether anything is another one.
    pub const fn differs(&self) -> bool {
        self.frames_different + self.fields_different > 0
    }

    /// A few lines for people.
    pub fn text(&self) -> String {
        let not_again: u64 = self.frames_not_shown_again.values().sum();
        let first = |frames: &[u64]| {
            let numbers: Vec<_> = frames.iter().map(u64::to_string).collect();
            if numbers.is_empty() { String::new() } else { format!(" (first: {})", numbers.join(", ")) }
        };
        let mut text = format!(
            "report    {} frames: {} the same to the byte, {} different{}, {not_again} not shown again, {} not reached",
            self.frames_recorded,
            self.frames_same,
            self.frames_different,
            first(&self.first_different),
            self.frames_not_reached,
        );
        for (why, count) in &self.frames_not_shown_again {
            text.push_str(&format!("\n          {count} not shown again: {why}"));
        }
        text.push_str(&format!(
            "\n          fields: of {} frames in the same order and colours, of {} in others{}",
            self.fields_same,
            self.fields_different,
            first(&self.first_fields_different)
        ));
        let [[holod, engine], [holod_now, engine_now]] = [&self.made_by, &self.made_again_by];
        // Why it is not a GPU may follow.
        let same_engine = engine.starts_with(engine_now.as_str()) || engine_now.starts_with(engine.as_str());
        if holod != holod_now || !same_engine {
            let hint = if self.differs() { ": another version or engine may round in another way" } else { "" };
            text.push_str(&format!(
                "\n          made by holod {holod}, {engine}; made again by holod {holod_now}, {engine_now}{hint}"
            ));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::PupilDiameter;
    use holod_slm_output::TimestampSource;

    use super::*;
    use crate::record::FrameOrders;

    const COLOURS: [(u8, Colour); 3] = [(0, Colour::Green), (1, Colour::Red), (2, Colour::Blue)];

    fn made(levels_xxh3: u64) -> Made {
        Made {
            pupil: PupilDiameter::from_mm(3.0),
            pupil_state: "tracking",
            t_wake: TimeNs(1),
            picture: 0,
            is_live: false,
            orders: FrameOrders::default(),
            levels_xxh3,
        }
    }

    fn comparison() -> Comparison {
        let frame = |frame| RecordedFrame { frame, made: Some(made(100 + frame)), fields: COLOURS.to_vec() };
        let frames: Vec<_> = [2, 3, 5].map(frame).into();
        let cue = |recorded: &RecordedFrame| Cue {
            frame: recorded.frame,
            pupil: PupilDiameter::from_mm(3.0),
            pupil_state: "tracking",
            picture: 0,
            number: 0,
            engine: 0,
            pattern: None,
            orders: FrameOrders::default(),
        };
        let cues: Vec<_> = frames.iter().map(cue).collect();
        let facts = RunFacts {
            holod: env!("HOLOD_VERSION").into(),
            started_unix_ms: 0,
            t_origin_ns: 0,
            scene: SceneSource::BuiltIn,
            hologram: [64, 64],
            tracker: String::new(),
            scale_mm_per_unit: None,
            panel: String::new(),
            backend: Backend::Auto,
            engine: "cpu, 2 threads, as there is no GPU".into(),
            machine: crate::machine::Machine::default(),
        };
        Comparison::new(frames, &cues, BTreeMap::from([("a reason".to_owned(), 4)]), &facts)
    }

    fn record(frame: u64, levels_xxh3: Option<u64>) -> FrameRecord {
        FrameRecord { levels_xxh3, ..FrameRecord::of_pupil(frame, PupilDiameter::from_mm(3.0)) }
    }

    fn field(frame_id: u64, (field, colour): (u8, Colour)) -> FieldEvent {
        FieldEvent {
            frame_id,
            field: field.into(),
            colour,
            t_submit: TimeNs(0),
            t_desired_present: TimeNs(0),
            t_present: TimeNs(1),
            t_settled: TimeNs(2),
            t_end: TimeNs(3),
            provenance: TimestampSource::Software,
            laser_on: None,
            laser_off: None,
            dark: None,
            repeated: false,
            deadline_missed: false,
        }
    }

    fn outcome(frames: &[(u64, Option<u64>)], fields: &[(u64, (u8, Colour))]) -> Outcome {
        let mut comparison = comparison();
        for (frame, hash) in frames {
            comparison.frame(&record(*frame, *hash)).unwrap();
        }
        for (frame, shown) in fields {
            comparison.field(&field(*frame, *shown)).unwrap();
        }
        comparison.finish("cpu, 2 threads")
    }

    #[test]
    fn frames_are_made_again_as_they_were_made_where_that_can_be() {
        let [with, without] = [true, false].map(|there| move |engine| like(engine, || there));
        assert_eq!([with("cpu, avx2, 2 threads"), without("cpu, avx2, 2 threads")], [Backend::Cpu; 2]);
        assert_eq!(with("cpu, avx512 in half precision, 2 threads"), Backend::CpuHalf);
        assert_eq!(with("gpu, X, single precision"), Backend::Gpu);
        assert_eq!(with("gpu, X, matrix units, half precision"), Backend::GpuHalf);
        assert_eq!(without("gpu, X, single precision"), Backend::Auto);
    }

    #[test]
    fn frames_that_are_the_same_are_counted_and_no_others() {
        let fields: Vec<_> = [2, 3].into_iter().flat_map(|frame| COLOURS.map(|shown| (frame, shown))).collect();
        let same = outcome(&[(2, Some(102)), (3, Some(103))], &fields);
        assert_eq!((same.frames_same, same.frames_different, same.frames_not_reached), (2, 0, 1));
        assert_eq!((same.fields_same, same.fields_different, same.differs()), (2, 0, false));
        assert!(!same.text().contains("made again by"), "why it is no GPU makes no other engine: {}", same.text());
        assert!(same.text().contains("4 not shown again: a reason"));

        let one = outcome(&[(2, Some(102)), (3, Some(104)), (9, Some(1))], &[]);
        assert_eq!((one.frames_same, one.frames_different, one.first_different), (1, 1, vec![3]));
        let unknown = outcome(&[(2, None)], &[]);
        assert_eq!((unknown.frames_same, unknown.frames_different), (0, 1));
    }

    #[test]
    fn fields_in_another_order_or_colour_are_found() {
        let [green, red, blue] = COLOURS;
        let differs = |fields: [(u8, Colour); 3]| outcome(&[], &fields.map(|shown| (5, shown))).first_fields_different;
        assert_eq!(differs([green, red, blue]), [0_u64; 0]);
        assert_eq!(differs([green, blue, red]), [5]);
        assert_eq!(differs([green, red, (2, Colour::Red)]), [5]);
        let cut_off = outcome(&[], &[(5, green), (5, red)]);
        assert_eq!((cut_off.fields_same, cut_off.fields_different), (1, 0));
        let nothing_in_common = outcome(&[], &[(5, (7, Colour::Red))]);
        assert_eq!((nothing_in_common.fields_same, nothing_in_common.fields_different), (0, 1));
    }

    #[test]
    fn orders_say_which_weights_they_brought() {
        let order = |text: &str| serde_json::from_str::<Value>(text).unwrap();
        let orders = Orders {
            requests: vec![
                order(r#"{"do":"weights","weights":"small"}"#),
                order(r#"{"do":"reload","changed":{"tracker.eye":"left","model.network":"fast"}}"#),
                order(r#"{"do":"reload","changed":{"model.network":"mine.safetensors"}}"#),
                order(r#"{"do":"weights","weights":"/home/x/mine.safetensors"}"#),
            ],
            sources: HashMap::new(),
            foreign: None,
        };
        assert_eq!([1, 2].map(|number| orders.built_in_weights(number)), [Ok("small"), Ok("fast")]);
        for number in [0, 3, 4, 5] {
            assert!(orders.built_in_weights(number).unwrap_err().contains("not in the report"), "{number}");
        }
        assert_eq!(parsed(&orders.requests[0]), Ok(Request::Weights { weights: "small".into() }));
        assert!(parsed(&orders.requests[1]).is_ok() && parsed(&order(r#"{"do":"dance"}"#)).is_err());
    }
}
