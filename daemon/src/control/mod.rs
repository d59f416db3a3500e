//! What a person or a program may ask of a running holod: one line of JSON for each request, one for each answer, over
//! a Unix socket. The page is `daemon/doc/control.md`.
//!
//! Everything here is on the control side. A request is made ready by ordinary threads, which may take their time; what
//! then changes in the loop is handed over by the control thread, wait-free. Darkness is asked of the laser thread at
//! once: it must not wait for a control thread that hangs.

mod client;
#[cfg(fuzzing)]
pub mod fuzzing;
mod prepare;
mod server;
mod steering;

use std::collections::BTreeMap;

use holod_calibration::rig::{Eye, Rig};
use holod_calibration::{Colour, PupilDiameter};
use holod_model::scene::Fit;
use holod_slm_output::LevelsFrame;
use holod_slm_output::output::DarkWish;
use holod_slm_output::patterns::Pattern;
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use self::client::ask;
#[cfg(test)]
pub(crate) use self::prepare::CHANGEABLE;
pub use self::prepare::RigReader;
pub(crate) use self::prepare::{NewEngine, Preparer};
pub(crate) use self::server::{ControlServer, panic_is_caught};
pub(crate) use self::steering::Steering;

use crate::source::scene::Frames;

/// A request. Those without fields have braces all the same: serde lets a variant without pass with fields that are not
/// known, and who wrote `"armed": false` beside `lasers-arm` meant something.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "kebab-case", deny_unknown_fields)]
#[allow(missing_docs, reason = "the variants say what their fields are")]
pub enum Request {
    /// Say how the run is: the same as `holod status --json`, at this moment.
    Status {},
    /// Show a scene from files, or the live feed again.
    Scene {
        /// As after `--scene`, with absolute paths; `feed` for the live feed.
        scene: String,
        /// What the depth file's numbers are, as after `--depth-encoding`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        depth_encoding: Option<String>,
        /// How another size is brought to the hologram's, as after `--fit`.
        #[serde(default)]
        fit: Fit,
    },
    /// Compute with other weights.
    Weights {
        /// As after `--weights`, a file with its absolute path.
        weights: String,
    },
    /// Show the picture that is shown until further notice; the pupil is followed.
    Pause {},
    /// End a pause: show what the scene or the feed has now.
    Resume {},
    /// Compute for one pupil, whatever the tracker says.
    Pupil {
        /// Its diameter; nothing follows the tracker again.
        #[serde(default)]
        mm: Option<f32>,
    },
    /// Follow another eye, as `tracker.eye` of a rig file names it.
    Eye { eye: Eye },
    /// Read the rig file again, and go on with what it says now.
    Reload {
        /// In a record: the keys of the rig file that say something else now, and what.
        #[serde(default, skip_deserializing, skip_serializing_if = "BTreeMap::is_empty")]
        changed: BTreeMap<&'static str, Value>,
    },
    /// Show a test pattern in place of holograms.
    Pattern {
        pattern: Pattern,
        /// The optical axis in pixels from the panel's centre, right and up.
        #[serde(default)]
        axis_px: [f64; 2],
        /// Colours that have it, the others are flat; all of them when left out.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        colours: Vec<Colour>,
    },
    /// Show one phase everywhere in place of holograms.
    Flat {},
    /// Show holograms in place of a pattern.
    Hologram {},
    /// Keep the lasers dark.
    LasersDark {},
    /// Take that back: lasers are lit again by the rules.
    LasersArm {},
    /// End the run in order.
    Stop {},
}

impl Request {
    /// The request that a line of JSON is.
    ///
    /// # Errors
    /// It is none, in words.
    pub(crate) fn from_line(line: &[u8]) -> Result<Self, String> {
        // Of an array serde would make a request, too, with its fields in their order.
        if !line.trim_ascii_start().starts_with(b"{") {
            return Err("expected an object, such as {\"do\": \"status\"}".into());
        }
        serde_json::from_slice(line).map_err(|error| error.to_string())
    }

    /// Whether the run is another one after it.
    pub(crate) fn changes_something(&self) -> bool {
        *self != Self::Status {}
    }

    /// Whether frames may have other levels after it.
    fn changes_levels(&self) -> bool {
        !matches!(self, Self::Status {} | Self::LasersDark {} | Self::LasersArm {} | Self::Stop {})
    }

    /// Whether files must be read or an engine opened for it, which takes a while.
    pub(crate) fn takes_long(&self) -> bool {
        matches!(
            self,
            Self::Scene { .. } | Self::Weights { .. } | Self::Reload { .. } | Self::Pattern { .. } | Self::Flat {}
        )
    }
}

/// An answer on the control socket, one line of JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(into = "AnswerLine", try_from = "AnswerLine")]
pub enum Answer {
    /// It is done; with what was asked for.
    Ok(Value),
    /// It is not, and nothing has changed, but that lasers which do not acknowledge darkness are kept dark all the
    /// same: what was found, what was expected, what to do.
    Error(String),
    /// Whether it is done, or still will be, is not known: what is, and what to do.
    Unanswered(String),
}

/// An answer as it is written: what is not known has an `error`, too, for those who know of nothing else.
#[derive(Default, Serialize, Deserialize)]
#[serde(default)]
struct AnswerLine {
    #[serde(skip_serializing_if = "Option::is_none")]
    ok: Option<Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    unanswered: bool,
}

impl From<Answer> for AnswerLine {
    fn from(answer: Answer) -> Self {
        match answer {
            Answer::Ok(value) => Self { ok: Some(value), ..Self::default() },
            Answer::Error(why) => Self { error: Some(why), ..Self::default() },
            Answer::Unanswered(why) => Self { error: Some(why), unanswered: true, ..Self::default() },
        }
    }
}

impl TryFrom<AnswerLine> for Answer {
    type Error = &'static str;

    fn try_from(line: AnswerLine) -> Result<Self, &'static str> {
        match line {
            AnswerLine { ok: Some(value), error: None, .. } => Ok(Self::Ok(value)),
            AnswerLine { ok: None, error: Some(why), unanswered } => {
                Ok(if unanswered { Self::Unanswered(why) } else { Self::Error(why) })
            }
            _ => Err("expected `ok` or `error`"),
        }
    }
}

/// A request that is ready to be obeyed by the control thread.
pub(crate) enum Order {
    Status,
    Scene(std::sync::Arc<Frames>),
    Feed,
    Engine(NewEngine),
    Pause(bool),
    Pupil(Option<PupilDiameter>),
    Eye(Eye),
    Reload(Box<NewRig>),
    Pattern(Option<NewPattern>),
    /// The lasers are on their way to darkness.
    LasersDark(DarkWish),
    LasersArm,
    Stop,
}

/// A rig file that was read again, and can be obeyed.
pub(crate) struct NewRig {
    pub(crate) rig: Rig,
    /// Where it names other weights than those that were in use when it was read.
    pub(crate) engine: Option<NewEngine>,
}

/// Levels that take the place of holograms.
pub(crate) struct NewPattern {
    /// What it is called, in words.
    pub(crate) name: String,
    pub(crate) levels: Box<LevelsFrame>,
}

/// An order, the request that it was made of, and where the answer goes.
pub(crate) struct Ordered {
    pub(crate) order: Order,
    pub(crate) request: Request,
    pub(crate) answer: tokio::sync::oneshot::Sender<Answer>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_lines_of_json() {
        for (line, request) in [
            (r#"{"do":"status"}"#, Request::Status {}),
            (r#"{"do":"pupil","mm":3.5}"#, Request::Pupil { mm: Some(3.5) }),
            (r#"{"do":"pupil"}"#, Request::Pupil { mm: None }),
            (r#"{"do":"lasers-dark"}"#, Request::LasersDark {}),
            (r#"{"do":"eye","eye":"better"}"#, Request::Eye { eye: Eye::Better }),
            (r#"{"do":"reload"}"#, Request::Reload { changed: BTreeMap::new() }),
            (
                r#"{"do":"pattern","pattern":{"kind":"cross-hair","line_px":4},"colours":["green"]}"#,
                Request::Pattern {
                    pattern: Pattern::CrossHair { line_px: 4 },
                    axis_px: [0.0, 0.0],
                    colours: vec![Colour::Green],
                },
            ),
            (
                r#"{"do":"scene","scene":"/a,/b","depth_encoding":"metres","fit":"cover"}"#,
                Request::Scene { scene: "/a,/b".into(), depth_encoding: Some("metres".into()), fit: Fit::Cover },
            ),
        ] {
            assert_eq!(Request::from_line(line.as_bytes()).unwrap(), request);
        }
        for wrong in [r#"{"do":"pupil","cm":1}"#, r#"{"do":"dance"}"#, r#"{}"#, "[]", "status", r#"["pupil",3.5]"#] {
            assert!(Request::from_line(wrong.as_bytes()).is_err(), "{wrong}");
        }
        for (answer, line) in [
            (Answer::Ok("done".into()), r#"{"ok":"done"}"#),
            (Answer::Error("no".into()), r#"{"error":"no"}"#),
            (Answer::Unanswered("who knows".into()), r#"{"error":"who knows","unanswered":true}"#),
        ] {
            assert_eq!(serde_json::to_string(&answer).unwrap(), line);
            assert_eq!(serde_json::from_str::<Answer>(line).unwrap(), answer);
        }
        assert!(serde_json::from_str::<Answer>("{}").is_err());
    }

    #[test]
    fn a_request_with_a_field_that_it_does_not_have_is_none() {
        for name in ["status", "pause", "resume", "reload", "flat", "hologram", "lasers-dark", "lasers-arm", "stop"] {
            assert!(Request::from_line(format!(r#" {{"do":"{name}"}}"#).as_bytes()).is_ok(), "{name}");
            let with_more = format!(r#"{{"do":"{name}","armed":false}}"#);
            let refused = Request::from_line(with_more.as_bytes()).unwrap_err();
            assert!(refused.contains("unknown field `armed`"), "{name}: {refused}");
            assert!(Request::from_line(format!(r#"["{name}"]"#).as_bytes()).is_err(), "{name}");
        }
    }
}
