//! What is left of a run: its figures as `summary.json` has them, and the levels that were kept of it.

use std::collections::BTreeMap;
use std::sync::Arc;

use holod_calibration::{PupilDiameter, TimeNs};
use holod_slm_output::{LevelsFrame, PanelEncoder};
use serde::Serialize;

use super::ledger::LaserSummary;
use crate::snapshot::Figures;

/// What the run came to.
pub struct SessionReport {
    /// Everything that can be said in numbers.
    pub summary: Summary,
    /// When the run began.
    pub t_origin: TimeNs,
    /// Levels that the panel showed, narrowest pupil first.
    pub shown: Vec<ShownLevels>,
    /// Turns levels back into phase.
    pub encoder: Arc<PanelEncoder>,
}

/// Levels that the panel showed, and what their frame was made for.
pub struct ShownLevels {
    /// The pupil that the hologram was computed for.
    pub pupil: PupilDiameter,
    /// The amplitude that double phase took as 1.
    pub amplitude_constant: f32,
    /// What all fields of the frame sent to the panel.
    pub levels: LevelsFrame,
}

/// The numbers of a run; `summary.json`.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Why the run ended.
    pub ended_by: String,
    /// How long it ran.
    pub duration_s: f64,
    /// What was true of it while it ran, too.
    #[serde(flatten)]
    pub figures: Figures,
    /// Colour fields that the panel showed, repetitions included.
    pub fields_shown: u64,
    /// Fields of a frame that had been shown before.
    pub fields_repeated: u64,
    /// Frames that came on the panel a second, over the whole run.
    pub frames_shown_hz: f64,
    /// Frames by the pupil estimator's state.
    pub frames_by_pupil_state: BTreeMap<&'static str, u64>,
    /// The narrowest and the widest pupil that a frame was made for.
    pub pupil_range_mm: Option<[f32; 2]>,
    /// Frames whose pupil lay outside those that the network was trained for on this bench: it was told the nearest.
    pub frames_beyond_trained_pupils: u64,
    /// Samples and log rows that were not believed, for any reason.
    pub samples_rejected: u64,
    /// How much slower the tracker's clock ran than the host's, parts per million.
    pub tracker_clock_drift_ppm: Option<f64>,
    /// Pieces of the tracker's bytes and decisions on its samples that the recording lost.
    pub tracker_records_lost: u64,
    /// Largest share of a frame's amplitudes that the double phase clipped.
    pub clipped_share_max: f32,
    /// Largest share of a frame's phases that the panel cannot reach.
    pub unreachable_share_max: f32,
    /// What the lasers did.
    pub lasers: LaserSummary,
    /// The lasers acknowledged darkness before the end.
    pub lasers_dark_at_end: bool,
    /// Why they did not, where they did not: they are left to the box's own heartbeat timeout, if it has one.
    pub lasers_not_dark: Option<String>,
    /// A flat pattern was on the panel at the end.
    pub flat_at_end: bool,
    /// Records that were lost because the control thread was late.
    pub records_lost: u64,
}
