//! Makes the frames of a report again, in the loop that made them.

use std::collections::{BTreeMap, HashMap};
use std::ffi::OsStr;
use std::fs;
use std::path::Path;
use std::sync::{Arc, Mutex};

use holod_calibration::rig::{LaserDriver, Rig, WeightsChoice};
use holod_calibration::{Resolution, TimeNs};
use holod_model::RgbdFrame;
use holod_model::gpu::{self, Adapters};
use holod_model::scene::Scene;
use holod_slm_output::LevelsFrame;
use holod_slm_output::output::DarkSwitch;
use serde_json::Value;
use toml_edit::DocumentMut;

use super::comparison::Comparison;
use super::recorded::{self, Made, RecordedFrame};
use super::{SCENE_FOLDER, Unpacked, order_folder};
use crate::cli::{Backend, SceneArgs};
use crate::control::{Order, Preparer, Request};
use crate::dark_note::DarkNote;
use crate::failure::{Exit, Failure};
use crate::record::{
    BENCH, FRAMES, ORDER_FILES, ORDERS, OrderSource, RIG, RUN, RunFacts, SCENE, SceneSource, SourceFile, content_xxh3,
};
use crate::renderer::{self, PLAYS_A_GPU, Use};
use crate::session::{Cue, Playback};
use crate::source::Pictures;
use crate::source::scene::{self, Frames};

/// Engines that are held beside the first: each has the memory of a run's own.
const MOST_ENGINES: usize = 4;
/// Patterns that are held, each as large as the panel, and scenes beside the first.
const MOST_PATTERNS: usize = 64;
const MOST_SCENES: usize = 16;

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

/// The backend that computes as the engine of that description did, in its precision: on the processor where it was a
/// GPU of which there is none here. `there_are` says whether one of such devices can be opened.
fn like(engine: &str, there_are: impl Fn(Adapters) -> bool) -> Backend {
    let on_gpu = !engine.starts_with("cpu")
        && (there_are(Adapters::Hardware) || engine.contains(PLAYS_A_GPU) && there_are(Adapters::Software));
    match (on_gpu, engine.contains("half precision")) {
        (false, false) => Backend::Cpu,
        (false, true) => Backend::CpuHalf,
        (true, false) => Backend::Gpu,
        (true, true) => Backend::GpuHalf,
    }
}

/// Reads everything that the frames of a report need. `backend` is the engine that is wanted; `Auto` is that of the
/// run.
///
/// # Errors
/// The report lacks what every frame needs, or none of its frames can be made again.
pub fn prepare(report: &Unpacked, backend: Backend) -> Result<Played, Failure> {
    let facts = facts(report)?;
    let (rig, resolution) = bench(report, &facts)?;
    let backend = match backend {
        Backend::Auto => like(&facts.engine, |adapters| gpu::find(adapters).is_ok()),
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
        return Err(unfit(format!("no frame of the report can be shown again: {why}")));
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

fn unfit(what: String) -> Failure {
    Failure::new(Exit::Data, what)
}

/// What the report says of its run.
fn facts(report: &Unpacked) -> Result<RunFacts, Failure> {
    let facts = report.text(RUN)?.ok_or_else(|| {
        unfit(
            "the report holds no run: its frames cannot be shown again; `holod report DIR` packs a record of one"
                .into(),
        )
    })?;
    serde_json::from_str(&facts).map_err(|error| {
        unfit(format!("{RUN}: {error}; show it with the holod that made it, or ask for the report again"))
    })
}

/// The rig of the report, with simulated lasers, and the size of its holograms.
fn bench(report: &Unpacked, facts: &RunFacts) -> Result<(Rig, Resolution), Failure> {
    refuse_foreign_files(report)?;
    let mut rig = Rig::load(&report.path(BENCH).join(RIG)).map_err(Failure::because(Exit::Data))?;
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
        return Err(unfit(format!(
            "{RUN}: found a hologram of {resolution}, expected one that fits on the panel of {panel}"
        )));
    }
    Ok((rig, resolution))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_made_again_as_they_were_made_where_that_can_be() {
        let [with, software, without] = [&[Adapters::Hardware, Adapters::Software][..], &[Adapters::Software], &[]]
            .map(|there| move |engine| like(engine, |adapters| there.contains(&adapters)));
        assert_eq!([with("cpu, avx2, 2 threads"), without("cpu, avx2, 2 threads")], [Backend::Cpu; 2]);
        assert_eq!(with("cpu, avx512 in half precision, 2 threads"), Backend::CpuHalf);
        assert_eq!(with("gpu, X, single precision"), Backend::Gpu);
        assert_eq!(with("gpu, X, matrix units, half precision"), Backend::GpuHalf);
        for there in [software, without] {
            assert_eq!(there("gpu, X, single precision"), Backend::Cpu);
            assert_eq!(there("gpu, X, matrix units, half precision"), Backend::CpuHalf);
        }
        let played = format!("gpu, Y, single precision, {PLAYS_A_GPU}");
        assert_eq!([software(&played), without(&played)], [Backend::Gpu, Backend::Cpu]);
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
