//! From a request to an order: files are read and engines opened here, while the loop goes on.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use holod_calibration::rig::{Rig, WeightsChoice};
use holod_calibration::{PupilDiameter, Resolution, TimeNs};
use holod_model::scene::Fit;
use holod_model::{RgbdFrame, Weights};
use holod_pupil_input::host_now;
use holod_slm_output::output::DarkSwitch;
use holod_slm_output::patterns::{PatternError, Placement};
use holod_slm_output::{LevelsFrame, PanelEncoder};

use super::{NewPattern, NewRig, Order, Request};
use crate::cli::{self, Backend, SceneArgs};
use crate::dark_note::DarkNote;
use crate::failure::Failure;
use crate::renderer::{self, Renderer, Use};
use crate::scheduling;
use crate::setup;
use crate::source::scene;

/// Lasers go dark where frames come so much slower.
const FRAMES_BEFORE_STALL: i64 = 3;

/// What of a rig can change while holod runs, by the keys of the rig file: all that the tracker's thread, the frame loop
/// and the engine take without anything being opened anew.
pub(crate) const CHANGEABLE: [&str; 7] = [
    "name",
    "tracker.eye",
    "tracker.scale_mm_per_unit",
    "tracker.fallback_mm",
    "tracker.hold_ms",
    "model.network",
    "model.pupil_step_mm",
];

/// Reads the rig again, as at the start.
pub type RigReader = Arc<dyn Fn() -> Result<Rig, Failure> + Send + Sync>;

/// What a request is made ready with.
pub(crate) struct Preparer {
    /// As it was at the start.
    pub(crate) rig: Rig,
    /// Where there is a file to read it from again.
    pub(crate) rig_again: Option<RigReader>,
    /// The weights that are in use.
    pub(crate) weights: Arc<Mutex<WeightsChoice>>,
    pub(crate) resolution: Resolution,
    /// What engines are tried out with. It lives as long as the run: an engine keeps the last frame that it has seen.
    pub(crate) frame: Arc<RgbdFrame>,
    pub(crate) backend: Backend,
    pub(crate) used_for: Use,
    pub(crate) encoder: Arc<PanelEncoder>,
    pub(crate) has_feed: bool,
    /// Frames of a record are made again, with what they were made of.
    pub(crate) plays: bool,
    pub(crate) stall_timeout: TimeNs,
    /// Puts the lasers out, whatever the control thread does.
    pub(crate) lasers: DarkSwitch,
    pub(crate) dark_note: DarkNote,
}

/// An engine that has made a frame.
pub(crate) struct NewEngine {
    pub(crate) renderer: Box<dyn Renderer>,
    /// The pupils that its network was trained for, on this bench.
    pub(crate) trained: [PupilDiameter; 2],
    pub(crate) weights: WeightsChoice,
}

#[cfg(any(test, fuzzing))]
impl Preparer {
    /// One for a small panel, whose lasers and notes are nowhere.
    pub(super) fn of_a_small_rig() -> Self {
        let resolution = Resolution { width: 64, height: 48 };
        let mut rig = Rig::default();
        rig.geometry.resolution = resolution;
        let encoder = renderer::panel_encoder(&rig, resolution).expect("the built-in panel has levels");
        Self {
            dark_note: DarkNote::on(&rig.lasers.driver),
            weights: Arc::new(Mutex::new(rig.model.weights.clone())),
            rig,
            rig_again: None,
            resolution,
            frame: Arc::new(RgbdFrame::black(resolution)),
            backend: Backend::Cpu,
            used_for: Use::Command,
            encoder,
            has_feed: true,
            plays: false,
            stall_timeout: TimeNs(2_000_000_000),
            lasers: DarkSwitch::of_no_output(),
        }
    }
}

impl Preparer {
    /// Makes a request ready.
    ///
    /// # Errors
    /// Why it cannot be done: in words, for whoever asked.
    pub(crate) fn prepare(&self, request: &Request) -> Result<Order, String> {
        if self.plays && request.changes_levels() {
            return Err(
                "a report is shown again, with what its frames were made of: `status`, `lasers` and `stop` are \
                        obeyed"
                    .into(),
            );
        }
        match request {
            Request::Status {} => Ok(Order::Status),
            Request::Pause {} => Ok(Order::Pause(true)),
            Request::Resume {} => Ok(Order::Pause(false)),
            Request::LasersDark {} => {
                let wish = self.lasers.wish_dark();
                // Here, too: a control thread that hangs is ended by the watchdog.
                let _left = self.dark_note.leave();
                Ok(Order::LasersDark(wish))
            }
            Request::LasersArm {} => Ok(Order::LasersArm),
            Request::Stop {} => Ok(Order::Stop),
            Request::Pupil { mm: None } => Ok(Order::Pupil(None)),
            Request::Pupil { mm: Some(mm) } => cli::human_pupil(*mm).map(|pupil| Order::Pupil(Some(pupil))),
            Request::Flat {} => self.pattern("flat".into(), |encoder, levels| {
                encoder.encode_flat(levels);
                Ok(())
            }),
            Request::Pattern { pattern, axis_px, colours } => {
                let placement = Placement::new(*axis_px, colours);
                let draw = |encoder: &PanelEncoder, levels: &mut LevelsFrame| {
                    pattern.draw(&placement, encoder, &self.rig.geometry, levels)
                };
                self.pattern(pattern.to_string(), draw)
            }
            Request::Hologram {} => Ok(Order::Pattern(None)),
            Request::Scene { scene, depth_encoding, .. } if scene == "feed" => self.feed(depth_encoding.is_some()),
            Request::Scene { scene, depth_encoding, fit } => self.scene(scene, depth_encoding.as_ref(), *fit),
            Request::Weights { weights } => self.weights(weights).map(Order::Engine),
            Request::Eye { eye } => Ok(Order::Eye(*eye)),
            Request::Reload { .. } => self.reload(),
        }
    }

    fn feed(&self, says_encoding: bool) -> Result<Order, String> {
        match (self.has_feed, says_encoding) {
            (false, _) => Err("this holod has no live feed: start it with --scene feed".into()),
            (true, true) => Err("depth_encoding is for files: a feed's clients say what their depths are".into()),
            (true, false) => Ok(Order::Feed),
        }
    }

    fn scene(&self, scene: &str, depth_encoding: Option<&String>, fit: Fit) -> Result<Order, String> {
        let is_absolute = Path::new(scene).exists() || scene.split(',').all(|part| part.starts_with('/'));
        if !scene.starts_with('/') || !is_absolute {
            return Err(format!("scene \"{scene}\" was found, expected an absolute path, two with a comma, or feed"));
        }
        let named = SceneArgs {
            scene: Some(scene.to_owned()),
            depth_encoding: depth_encoding.cloned(),
            fit: fit.into(),
            resolution: Some(self.resolution),
        };
        let frames = scene::frames(&named, &self.rig.geometry).map_err(in_words)?;
        Ok(Order::Scene(Arc::new(frames)))
    }

    /// What `draw` draws on the whole panel, as `holod pattern` does.
    fn pattern(
        &self,
        name: String,
        draw: impl FnOnce(&PanelEncoder, &mut LevelsFrame) -> Result<(), PatternError>,
    ) -> Result<Order, String> {
        let encoder = renderer::panel_encoder(&self.rig, self.rig.resolution()).map_err(in_words)?;
        let mut levels = Box::new(LevelsFrame::new(encoder.layout()));
        draw(&encoder, &mut levels).map_err(|error| error.to_string())?;
        Ok(Order::Pattern(Some(NewPattern { name, levels })))
    }

    fn reload(&self) -> Result<Order, String> {
        let Some(rig_again) = &self.rig_again else {
            return Err("this holod was started without --config, so there is no rig file to read again".into());
        };
        let rig = rig_again().map_err(|failure| format!("{failure}\nnothing has changed"))?;
        let mut fixed = rig.differences(&self.rig);
        fixed.retain(|key| !CHANGEABLE.contains(key));
        if !fixed.is_empty() {
            return Err(format!(
                "the rig file has other figures for {} than this run was started with, which is a restart: panel, lasers, \
                 tracker or GPU must be opened anew. Nothing has changed. While holod runs, these can: {}",
                fixed.join(", "),
                CHANGEABLE.join(", ")
            ));
        }
        let same_weights = *self.weights.lock().unwrap_or_else(PoisonError::into_inner) == rig.model.weights;
        // A file may hold others than when it was read last.
        let stays = same_weights && !matches!(rig.model.weights, WeightsChoice::File(_));
        let engine = if stays { None } else { Some(self.engine(rig.model.weights.clone())?) };
        Ok(Order::Reload(Box::new(NewRig { rig, engine })))
    }

    fn weights(&self, weights: &str) -> Result<NewEngine, String> {
        let choice = cli::parse_weights(weights)?;
        if matches!(&choice, WeightsChoice::File(path) if path.is_relative()) {
            return Err(format!("weights \"{weights}\" were found, expected a name or an absolute path"));
        }
        self.engine(choice)
    }

    fn engine(&self, choice: WeightsChoice) -> Result<NewEngine, String> {
        let mut rig = self.rig.clone();
        rig.model.weights = choice.clone();
        let weights = setup::weights(&rig).map_err(in_words)?;
        let renderer =
            scheduling::patient(|| renderer::open(self.backend, &weights, &rig, &self.encoder, &self.used_for));
        let mut renderer = renderer.map_err(in_words)?;
        let frame_time = self.warm_up(&mut *renderer, &weights)?;
        if FRAMES_BEFORE_STALL * frame_time.0 > self.stall_timeout.0 {
            return Err(format!(
                "a frame with these weights takes {:.1} s, and lasers go dark after {:.1} s of one same frame: start \
                 holod with them",
                frame_time.seconds(),
                self.stall_timeout.seconds()
            ));
        }
        Ok(NewEngine { renderer, trained: weights.trained_pupils(&rig.geometry), weights: choice })
    }

    /// Makes two frames, of which the first may be slow, beside those of the loop; how long the second took. A hologram
    /// that is no numbers is refused.
    fn warm_up(&self, renderer: &mut dyn Renderer, weights: &Weights) -> Result<TimeNs, String> {
        let mut levels = LevelsFrame::new(self.encoder.layout());
        let [pupil, _] = weights.trained_pupils(&self.rig.geometry);
        let mut began = host_now();
        for _ in 0..2 {
            began = host_now();
            renderer.render(&self.frame, pupil, &mut levels).map_err(|error| error.to_string())?;
        }
        let taken = host_now() - began;
        renderer::check_last_hologram(renderer).map_err(in_words)?;
        Ok(taken)
    }
}

fn in_words(failure: Failure) -> String {
    failure.to_string()
}
