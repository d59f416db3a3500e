//! What can be said of a run at one moment: the one thing from which status, summary and answers are made.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::source::feed::FeedStatus;
use crate::source::scene::SceneFigures;
use crate::spread::Spread;

/// What holds of a run that goes on and of one that is over alike.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    pub rig: String,
    pub scene: String,
    /// The scene in figures, where it is no feed.
    #[serde(default)]
    pub scene_figures: Option<SceneFigures>,
    pub tracker: String,
    /// How holograms are computed.
    pub engine: String,
    /// Hologram size in pixels.
    pub hologram: String,
    /// Frames that were made.
    pub frames_made: u64,
    /// Of those, frames whose levels were computed: the buffers did not have them already.
    #[serde(default)]
    pub frames_computed: u64,
    /// Of those, frames that came on the panel.
    pub frames_shown: u64,
    /// Frames that came on the panel later than planned.
    pub deadline_misses: u64,
    /// Frames of all colours that the panel could show in a second.
    pub panel_frames_hz: f64,
    /// Refreshes of the panel a second, as it reports them; 0 where it has reported none.
    pub panel_refresh_hz: f64,
    /// What would bring the frames shown nearer to those that the panel could show, where that is needed.
    pub speed_advice: Option<String>,
    /// From waking to the submitted levels, of frames that were computed.
    pub frame_time: Option<Spread>,
    /// From the newest believed tracker sample behind a frame that was computed to the middle of its first light.
    pub sample_to_photon: Option<Spread>,
    /// From when a feed's client took a picture to the middle of its first light.
    pub picture_to_photon: Option<Spread>,
    /// How the tracker's link is.
    pub tracker_link: String,
    /// What the weights are called.
    pub weights: String,
    /// Why a lost link does not come back, or why nothing that the tracker sends is believed.
    pub tracker_trouble: Option<String>,
    /// Counters of the tracker: samples, connections, rejections by reason.
    pub tracker_counts: BTreeMap<String, u64>,
    /// The live feed, where there is one.
    pub feed: Option<FeedStatus>,
    /// The record, where there is one.
    pub record: Option<RecordState>,
}

/// A run as far as it is known now.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct SnapshotNow<'a> {
    #[serde(flatten)]
    pub(crate) snapshot: &'a Snapshot,
    /// How old that is, where the loop does not turn any more.
    pub(crate) stale_s: Option<f64>,
}

/// A run at one moment.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    pub pid: u32,
    /// Dark, running or degraded.
    pub state: String,
    /// How long it has run.
    pub uptime_s: f64,
    /// Where `holod ctl` may ask it.
    #[serde(serialize_with = "crate::results::optional_path_text")]
    pub control: Option<PathBuf>,
    /// Orders that were refused, by reason.
    #[serde(default)]
    pub orders_refused: BTreeMap<String, u64>,
    /// The eye that is followed: left, right, both or better.
    #[serde(default)]
    pub eye: String,
    /// The picture stands still.
    pub paused: bool,
    /// A person keeps the lasers dark.
    pub lasers_kept_dark: bool,
    /// The test pattern that is shown in place of holograms.
    #[serde(default)]
    pub pattern: Option<String>,
    /// What holds at the end, too.
    #[serde(flatten)]
    pub figures: Figures,
    /// Frames that came on the panel in the last second; in the first two seconds of a run that is not known yet.
    pub frames_shown_hz: Option<f64>,
    /// What the pupil's estimate rests on.
    pub pupil_state: String,
    /// The pupil that the newest frame was made for.
    pub pupil_mm: Option<f32>,
    pub panel: String,
    /// Why the panel is lost, where it is.
    pub panel_trouble: Option<String>,
    /// Whether lasers may be lit: armed or dark.
    pub lasers: String,
    /// What is wrong with the laser box, where something is.
    pub lasers_trouble: Option<String>,
    /// Why no field is lit though lasers may be, where that is so.
    #[serde(default)]
    pub unlit: Option<String>,
    /// Why the live feed keeps lasers dark, where it does.
    #[serde(default)]
    pub feed_trouble: Option<String>,
}

impl Snapshot {
    /// The frames, the pupil and the lasers in one line.
    pub(crate) fn in_short(&self) -> String {
        let rate = self.frames_shown_hz.map_or(String::new(), |hz| format!(", {hz:.1} a second"));
        let pupil = self.pupil_mm.map_or("not known yet".to_owned(), |mm| format!("{mm:.2} mm, {}", self.pupil_state));
        let Figures { frames_made, frames_shown, .. } = self.figures;
        let (state, lasers) = (&self.state, &self.lasers);
        format!("{state}: {frames_made} frames made, {frames_shown} shown{rate}; pupil {pupil}; lasers {lasers}")
    }
}

/// How the record of a run is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RecordCondition {
    /// It goes on, though rows may be left out.
    #[default]
    Written,
    /// It was given up.
    Lost,
}

/// How the record of a run is, as its status says it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RecordState {
    #[serde(serialize_with = "crate::results::path_text")]
    pub folder: PathBuf,
    /// Whether it goes on.
    pub state: RecordCondition,
    /// Why it was given up.
    pub reason: Option<String>,
    /// Rows that were left out because the disk was too slow.
    pub rows_lost: u64,
}

impl RecordState {
    /// The same in words.
    pub fn text(&self) -> String {
        let rows = match self.rows_lost {
            0 => String::new(),
            rows => format!("; {rows} rows are left out: the disk is too slow"),
        };
        match &self.reason {
            Some(reason) => format!("lost: {reason}{rows}"),
            None => format!("{}{rows}", self.folder.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_in_short_has_figures_as_far_as_they_are_known() {
        let mut snapshot = Snapshot { state: "dark".into(), lasers: "dark".into(), ..Snapshot::default() };
        assert_eq!(snapshot.in_short(), "dark: 0 frames made, 0 shown; pupil not known yet; lasers dark");
        (snapshot.figures.frames_made, snapshot.figures.frames_shown) = (12, 10);
        (snapshot.frames_shown_hz, snapshot.pupil_mm) = (Some(4.98), Some(4.981_247_4));
        snapshot.pupil_state = "tracking".into();
        assert_eq!(
            snapshot.in_short(),
            "dark: 12 frames made, 10 shown, 5.0 a second; pupil 4.98 mm, tracking; lasers dark"
        );
    }
}
