//! A run before it begins: bench, network, pictures, tracker, panel, record and limits.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use holod_calibration::PupilDiameter;
use holod_calibration::rig::Rig;
use holod_model::Weights;
use holod_pupil_input::{RecordFiles, TrackerSpec};
use holod_slm_output::OutputSpec;

use super::service::Hangups;
use crate::cli::Backend;
use crate::control::RigReader;
use crate::record::RecordHealth;
use crate::source::Pictures;

/// A run before anything of it is opened: the bench, what is shown on it, and when that is over.
pub struct SessionPlan {
    /// The bench, with what options change of its file.
    pub rig: Rig,
    /// Reads it again, where there is a file to read it from.
    pub rig_again: Option<RigReader>,
    /// What asks for that; where there is nothing, SIGHUP ends the run.
    pub hangups: Option<Hangups>,
    /// The network that computes the holograms, loaded.
    pub weights: Weights,
    /// Which engine runs it.
    pub backend: Backend,
    /// The pictures that holograms are made of.
    pub pictures: Pictures,
    /// Where to show it.
    pub output: OutputSpec,
    /// The pupil that holograms are made for, where it is not the tracker's.
    pub pupil: Option<PupilDiameter>,
    /// Where samples come from; nothing is opened where a record is played.
    pub tracker: TrackerSpec,
    /// Serial ports that it must not open, whichever it is.
    pub ports_of_others: Vec<PathBuf>,
    /// Where the tracker's bytes and samples are written down.
    pub record_tracker: Option<RecordFiles>,
    /// Whether the run's record goes on.
    pub record: Option<Arc<RecordHealth>>,
    /// Stop once this many frames have been made.
    pub frame_limit: Option<u64>,
    /// Stop after this time, from the run's beginning on.
    pub duration: Option<Duration>,
    /// Keep the levels that the panel showed, the newest for each half millimetre of pupil.
    pub keep_levels: bool,
    /// Tell the levels of each frame by their hash.
    pub hash_levels: bool,
}
