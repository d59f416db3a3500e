//! Where a person's orders are obeyed, by the control thread: what they change is handed over to the other threads.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError, mpsc};

use holod_calibration::rig::LaserDriver;
use holod_calibration::{PupilDiameter, TimeNs};
use holod_slm_output::OutputControl;
use serde_json::Value;

use super::frame_loop::{Change, TrainedPupils};
use super::host_now;
use super::watch::Watch;
use crate::control::{Answer, ControlServer, NewEngine, NewPattern, Order, Ordered, Preparer, Steering};
use crate::failure::Failure;
use crate::memory;
use crate::runtime_folder;
use crate::setup;
use crate::source::PictureSink;

/// Orders between two looks at everything else.
const ORDERS_AT_ONCE: usize = 4;

/// The ways into the other threads.
pub(super) struct Changes {
    pub(super) steering: Arc<Steering>,
    pub(super) sink: Arc<Mutex<PictureSink>>,
    pub(super) places: rtrb::Producer<Change>,
    pub(super) retired: rtrb::Consumer<Change>,
}

/// The control socket, and what it may change.
pub(super) struct Desk {
    server: Option<(ControlServer, mpsc::Receiver<Ordered>)>,
    changes: Changes,
    keeps_dark: bool,
    /// What is shown in place of holograms.
    pattern: Option<String>,
}

impl Desk {
    /// A run goes on without one where it cannot be had, and says so.
    pub(super) fn open(preparer: Preparer, changes: Changes) -> Self {
        let server = runtime_folder::own()
            .ok_or_else(|| "no folder for it".into())
            .and_then(|folder| ControlServer::listen(folder.join(format!("control-{}", std::process::id())), preparer));
        let server = match server {
            Ok(server) => Some(server),
            Err(error) => {
                tracing::warn!("`holod ctl` cannot reach this run: {error}");
                None
            }
        };
        Self { server, changes, keeps_dark: false, pattern: None }
    }

    pub(super) fn socket(&self) -> Option<PathBuf> {
        self.server.as_ref().map(|(server, _)| server.socket().to_owned())
    }

    pub(super) fn is_paused(&self) -> bool {
        self.changes.steering.is_paused()
    }

    pub(super) fn keeps_dark(&self) -> bool {
        self.keeps_dark
    }

    pub(super) fn pattern(&self) -> Option<&str> {
        self.pattern.as_deref()
    }

    /// Gives back what nobody needs any more.
    pub(super) fn tidy(&mut self) {
        self.give_back();
        self.changes.sink.lock().unwrap_or_else(PoisonError::into_inner).tidy();
    }

    /// An engine's buffers are most of what holod has.
    fn give_back(&mut self) {
        while let Ok(retired) = self.changes.retired.pop() {
            let is_large = matches!(retired, Change::Engine(..));
            drop(retired);
            if is_large {
                memory::give_back();
            }
        }
    }

    fn next(&self) -> Option<Ordered> {
        self.server.as_ref()?.1.try_recv().ok()
    }
}

impl Watch<'_> {
    /// Obeys what has been asked for; whether that is to end.
    pub(super) fn obey(&mut self, output: &OutputControl) -> Result<bool, Failure> {
        for _ in 0..ORDERS_AT_ONCE {
            self.desk.give_back();
            let Some(Ordered { order, request, answer }) = self.desk.next() else { break };
            let ends = matches!(order, Order::Stop);
            let is_urgent = ends || matches!(order, Order::KeepDark(true));
            // Whoever asked was told that it is not done.
            if answer.is_closed() && !is_urgent {
                continue;
            }
            let now = host_now();
            let done = self.carry_out(order, output, now);
            // Lasers are kept dark even where the box did not acknowledge it.
            if (done.is_ok() || is_urgent) && request.changes_something() {
                let request_text = serde_json::to_string(&request).unwrap_or_default();
                tracing::info!("asked by holod ctl: {request_text}");
                self.observer.order(now, &request)?;
                self.write_status(&output.counts(), now);
            }
            let done = done.map_or_else(Answer::Error, Answer::Ok);
            // Whoever asked may have gone.
            let _gone = answer.send(done);
            if ends {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn carry_out(&mut self, order: Order, output: &OutputControl, now: TimeNs) -> Result<Value, String> {
        let sink = |desk: &Desk| Arc::clone(&desk.changes.sink);
        match order {
            Order::Status => {
                let snapshot = self.snapshot(&output.counts(), now);
                serde_json::to_value(snapshot).map_err(|error| error.to_string())
            }
            Order::Scene(frames) => {
                self.names.scene.clone_from(&frames.name);
                let later = if self.desk.is_paused() { " once the picture goes on: `holod ctl resume`" } else { "" };
                let said = format!("{} is shown{later}", frames.name);
                sink(&self.desk).lock().unwrap_or_else(PoisonError::into_inner).show_scene(frames, now);
                Ok(said.into())
            }
            Order::Feed => {
                self.names.scene = "the live feed".into();
                sink(&self.desk).lock().unwrap_or_else(PoisonError::into_inner).go_live();
                Ok("the live feed is shown from its next picture on".into())
            }
            Order::Engine(engine) => self.change_engine(engine),
            Order::Pause(paused) => {
                self.desk.changes.steering.pause(paused);
                Ok(if paused { "the picture stands still" } else { "the picture goes on" }.into())
            }
            Order::Pupil(pupil) => {
                self.desk.changes.steering.fix_pupil(pupil);
                Ok(match pupil.map(PupilDiameter::mm) {
                    Some(mm) => format!("the pupil is {mm} mm until further notice").into(),
                    None => "the tracker is followed".into(),
                })
            }
            Order::Pattern(pattern) => self.change_pattern(pattern, output),
            Order::KeepDark(dark) => self.keep_dark(dark, output),
            Order::Stop => Ok("holod ends".into()),
        }
    }

    fn change_engine(&mut self, engine: NewEngine) -> Result<Value, String> {
        let NewEngine { renderer, trained, weights } = engine;
        let description = renderer.description().to_owned();
        self.change(Change::Engine(renderer, TrainedPupils::of(trained)))?;
        let said = format!("holograms are computed with the weights {}, {description}", setup::weights_name(&weights));
        *self.names.engine.lock().unwrap_or_else(PoisonError::into_inner) = description;
        self.rig.model.weights = weights;
        Ok(said.into())
    }

    fn change_pattern(&mut self, pattern: Option<NewPattern>, output: &OutputControl) -> Result<Value, String> {
        let (name, levels) = pattern.map(|NewPattern { name, levels }| (name, levels)).unzip();
        self.change(Change::Pattern(levels))?;
        let said = name.as_ref().map(|name| format!("shown until `holod ctl hologram`: {name}"));
        self.desk.pattern = name;
        let Some(said) = said else { return Ok("holograms are shown".into()) };
        let warning = if output.counts().armed { self.pattern_warning() } else { "" };
        Ok(format!("{said}{warning}").into())
    }

    /// What whoever lights a pattern must know.
    fn pattern_warning(&self) -> &'static str {
        if self.desk.pattern.is_none() || self.rig.lasers.driver == LaserDriver::Simulated {
            return "";
        }
        "; lasers are lit over a pattern: an eye in the display may get all of their light in one spot, use a camera"
    }

    fn change(&mut self, change: Change) -> Result<(), String> {
        let busy = |_| "the frame loop has not taken the last change yet: ask again".to_owned();
        self.desk.changes.places.push(change).map_err(busy)
    }

    fn keep_dark(&mut self, dark: bool, output: &OutputControl) -> Result<Value, String> {
        self.desk.keeps_dark = dark;
        match (output.keep_dark(dark), dark) {
            (_, false) => Ok(format!("lasers are lit again by the rules{}", self.pattern_warning()).into()),
            (true, true) => Ok("the lasers are dark, and stay so until `holod ctl lasers arm`".into()),
            (false, true) => {
                Err("the laser box did not acknowledge darkness: look at the lasers, and switch them off by \
                                  hand. holod lights none until `holod ctl lasers arm`"
                    .into())
            }
        }
    }
}
