//! What to run.

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

/// What to run.
pub struct SessionPlan {
    /// The bench.
    pub rig: Rig,
    /// Reads it again, where there is a file to read it from.
    pub rig_again: Option<RigReader>,
    /// What asks for that; where there is nothing, SIGHUP ends the run.
    pub hangups: Option<Hangups>,
    /// The network.
    pub weights: Weights,
    /// Which engine runs it.
    pub backend: Backend,
    /// What to show.
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
    /// Stop after so many frames.
    pub frame_limit: Option<u64>,
    /// Stop after so long.
    pub duration: Option<Duration>,
    /// Keep the levels that the panel showed, the newest for each half millimetre of pupil.
    pub keep_levels: bool,
    /// Tell the levels of each frame by their hash.
    pub hash_levels: bool,
}
