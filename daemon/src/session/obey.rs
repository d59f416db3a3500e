//! A person's orders, obeyed by the control thread: what they change is handed over to the other threads.

use std::collections::BTreeMap;
use std::sync::{Arc, PoisonError};

use holod_calibration::rig::{Eye, LaserDriver, Rig};
use holod_calibration::{PupilDiameter, TimeNs, rig};
use holod_slm_output::OutputControl;
use holod_slm_output::output::DarkWish;
use serde_json::Value;

use super::clock::host_now;
use super::desk::Desk;
use super::frame_loop::Change;
use super::inputs::TrainedPupils;
use super::watch::Watch;
use crate::control::{Answer, NewEngine, NewPattern, NewRig, Order, Ordered, Request};
use crate::failure::Failure;
use crate::setup;

/// Orders between two looks at everything else.
const ORDERS_AT_ONCE: usize = 4;

const BUSY: &str = "the frame loop has not taken the last change yet: ask again";

/// Of a note that lies in the runtime folder alone.
const UNSEEN: &str = "; the service, or a run of another user, does not see that, because no note can be left in a folder \
                      that they share: end the service by `systemctl stop holod`, and ask other users to light none";

impl Watch<'_> {
    /// Obeys what has been asked for; whether that is to end.
    pub(super) fn obey(&mut self, output: &OutputControl) -> Result<bool, Failure> {
        for _ in 0..ORDERS_AT_ONCE {
            self.desk.give_back();
            let Some(Ordered { order, request, answer }) = self.desk.next() else { break };
            let ends = matches!(order, Order::Stop);
            let is_urgent = ends || matches!(order, Order::LasersDark(_));
            let is_of_lasers = matches!(order, Order::LasersDark(_) | Order::LasersArm);
            // Whoever asked was told that it is not done.
            if answer.is_closed() && !is_urgent {
                continue;
            }
            let now = host_now();
            let request = match &order {
                Order::Reload(new) => Request::Reload { changed: changed_keys(new, &self.rig) },
                _ => request,
            };
            let done = self.carry_out(order, output, now);
            // Before the frame loop can have brought back a picture that is not to be lit any more.
            if !is_of_lasers {
                self.judge_feed(output, host_now());
            }
            // Lasers are kept dark even where the box did not acknowledge it.
            if (done.is_ok() || is_urgent) && request.changes_something() {
                let request_text = serde_json::to_string(&request).unwrap_or_default();
                tracing::info!("asked for: {request_text}");
                self.desk.orders += 1;
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
        let number = self.desk.next_order();
        match order {
            Order::Status => {
                let snapshot = self.snapshot(&output.counts(), now);
                serde_json::to_value(snapshot).map_err(|error| error.to_string())
            }
            Order::Scene(frames) => {
                self.names.scene.clone_from(&frames.name);
                self.names.scene_figures = Some(frames.figures());
                let later = if self.desk.is_paused() { " once the picture goes on: `holod ctl resume`" } else { "" };
                let said = format!("{} is shown{later}", frames.name);
                sink(&self.desk).lock().unwrap_or_else(PoisonError::into_inner).show_scene(frames, now, number);
                Ok(said.into())
            }
            Order::Feed => {
                self.names.scene = "the live feed".into();
                self.names.scene_figures = None;
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
            Order::Eye(eye) => {
                self.follow(rig::Tracker { eye, ..self.rig.tracker.clone() })?;
                Ok(format!("the pupil is that of {}", eye_in_words(eye)).into())
            }
            Order::Reload(new) => self.reload(*new),
            Order::Pattern(pattern) => self.change_pattern(pattern, output),
            Order::LasersDark(wish) => self.lasers_dark(wish, output),
            Order::LasersArm => Ok(self.lasers_arm(output)),
            Order::Stop => Ok("holod ends".into()),
        }
    }

    fn change_engine(&mut self, engine: NewEngine) -> Result<Value, String> {
        let NewEngine { renderer, trained, weights } = engine;
        let description = renderer.description().to_owned();
        self.change(Change::Engine(renderer, TrainedPupils::of(trained)))?;
        self.announced.clipped = false;
        let said = format!("holograms are computed with the weights {}, {description}", setup::weights_name(&weights));
        *self.names.engine.lock().unwrap_or_else(PoisonError::into_inner) = description;
        self.desk.changes.weights.lock().unwrap_or_else(PoisonError::into_inner).clone_from(&weights);
        self.rig.model.weights = weights;
        Ok(said.into())
    }

    /// Follows the same tracker with other settings.
    fn follow(&mut self, settings: rig::Tracker) -> Result<(), String> {
        if let Some(warning) = self.tracker.change(&settings).map_err(|error| error.to_string())? {
            tracing::warn!("{warning}");
        }
        self.tracker_watch.change(&settings, &self.tracker);
        self.rig.tracker = settings;
        Ok(())
    }

    /// Takes all of a rig that was read again, or nothing.
    fn reload(&mut self, new: NewRig) -> Result<Value, String> {
        let changed = changed_keys(&new, &self.rig);
        let NewRig { rig, engine } = new;
        if engine.is_none() && rig.model.weights != self.rig.model.weights {
            return Err("the weights were changed meanwhile: ask again".into());
        }
        if engine.is_some() && self.desk.changes.places.is_full() {
            return Err(BUSY.into());
        }
        if rig.tracker != self.rig.tracker {
            self.follow(rig.tracker.clone())?;
        }
        if let Some(engine) = engine {
            self.change_engine(engine)?;
        }
        self.desk.changes.steering.follow_in_steps_of(rig.pupil_step());
        self.rig = rig;
        let said: Vec<_> = changed
            .iter()
            .map(|(key, value)| match value {
                Value::Null => format!("{key} is not given any more"),
                value => format!("{key} is {value}"),
            })
            .collect();
        let said = if said.is_empty() { "nothing that is in force has changed".to_owned() } else { said.join(", ") };
        Ok(format!("{} is read again: {said}", self.rig.provenance.origin).into())
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
        let number = self.desk.next_order();
        self.desk.changes.places.push((number, change)).map_err(|_| BUSY.to_owned())
    }

    fn lasers_dark(&mut self, wish: DarkWish, output: &OutputControl) -> Result<Value, String> {
        // Before the note, which a disk may make wait.
        let acknowledged = output.keep_dark_as_wished(wish);
        let left = self.desk.keep_dark();
        if acknowledged {
            let said = if left.is_there {
                "the lasers are dark, and stay so until `holod ctl lasers arm`, also where holod fails, or as a service is \
                 restarted; a run by hand that was ended in order lights them when it is started again"
            } else {
                "the lasers are dark, and stay so until `holod ctl lasers arm` or a new start of holod"
            };
            let who = if left.is_there && !left.is_for_all { UNSEEN } else { "" };
            return Ok(format!("{said}{who}").into());
        }
        Err("the laser box did not acknowledge darkness: look at the lasers, and switch them off by hand. holod lights \
             none until `holod ctl lasers arm`"
            .into())
    }

    fn lasers_arm(&mut self, output: &OutputControl) -> Value {
        let stays = self.desk.arm().map_or(String::new(), |stays| {
            format!("; a holod that is started anew keeps them dark all the same: {stays}")
        });
        output.keep_dark(self.dark_wish());
        if self.sleep.keeps_dark().is_some() {
            return format!("lasers are lit again by the rules, once the machine has slept{stays}").into();
        }
        if self.feed_watch.keeps_dark() {
            return format!("lasers are lit again by the rules, once the live feed gives a picture{stays}").into();
        }
        let trouble =
            self.laser_box.trouble().map_or(String::new(), |trouble| format!(" once this is over: {trouble}"));
        format!("lasers are lit again by the rules{trouble}{}{stays}", self.pattern_warning()).into()
    }
}

/// What `new` says of the keys that it changes, in the rig file's own units. A weights file that is read anew is a
/// change.
fn changed_keys(new: &NewRig, old: &Rig) -> BTreeMap<&'static str, Value> {
    let NewRig { rig: new, engine } = new;
    let value = |key| match key {
        "name" => new.name.clone().into(),
        "tracker.eye" => new.tracker.eye.name().into(),
        "tracker.scale_mm_per_unit" => new.tracker.scale.into(),
        "tracker.fallback_mm" => (f64::from(new.tracker.fallback.mm() * 1e4).round() / 1e4).into(),
        "tracker.hold_ms" => (new.tracker.hold.0 as f64 / 1e6).into(),
        "model.network" => setup::weights_name(&new.model.weights).into(),
        "model.pupil_step_mm" => new.model.pupil_step.map(|step| (step.0 * 1e7).round() / 1e4).into(),
        // The preparer refuses all others.
        _ => Value::Null,
    };
    let weights = engine.as_ref().map(|_| "model.network");
    new.differences(old).into_iter().chain(weights).map(|key| (key, value(key))).collect()
}

const fn eye_in_words(eye: Eye) -> &'static str {
    match eye {
        Eye::Left => "the left eye",
        Eye::Right => "the right eye",
        Eye::Both => "both eyes, their mean",
        Eye::Better => "the eye of which the tracker is surer",
    }
}

#[cfg(test)]
mod tests {
    use holod_calibration::Metres;
    use holod_calibration::rig::WeightsChoice;

    use super::*;
    use crate::control::CHANGEABLE;

    #[test]
    fn every_key_that_can_change_is_recorded_with_its_value() {
        let old = Rig::default();
        let mut rig = Rig { name: "other".into(), ..Rig::default() };
        rig.tracker = rig::Tracker {
            spec: None,
            eye: Eye::Left,
            scale: Some(0.0125),
            fallback: PupilDiameter::from_mm(3.3),
            hold: TimeNs(400_000_000),
        };
        rig.model.weights = WeightsChoice::File("/a/mine.safetensors".into());
        rig.model.pupil_step = Some(Metres(0.000_15));
        let changed = serde_json::to_value(changed_keys(&NewRig { rig, engine: None }, &old)).unwrap();
        let expected = serde_json::json!({
            "name": "other", "tracker.eye": "left", "tracker.scale_mm_per_unit": 0.0125, "tracker.fallback_mm": 3.3,
            "tracker.hold_ms": 400.0, "model.network": "mine.safetensors",
            "model.pupil_step_mm": 0.15,
        });
        assert_eq!(changed, expected);
        let mut keys: Vec<_> = expected.as_object().unwrap().keys().collect();
        let mut changeable = CHANGEABLE.to_vec();
        keys.sort();
        changeable.sort_unstable();
        assert_eq!(keys, changeable);
    }
}
