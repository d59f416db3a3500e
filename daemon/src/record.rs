//! A run written down: `frames.csv`, one row per colour field that the panel showed; with what it was made of, so that
//! its frames can be made again.

mod folder;
mod frame_log;
mod health;
mod place;
mod recorder;
mod sources;

use std::fs;
use std::path::{Path, PathBuf};

use holod_calibration::{Colour, PupilDiameter, TimeNs};
use holod_slm_output::{FieldEvent, LevelsFrame};
use twox_hash::XxHash3_64;

use crate::failure::{Exit, Failure};
use crate::frame_state::FrameState;
use crate::source::PictureTag;

pub(crate) use self::folder::{EARLIER, RecordFolder};
pub(crate) use self::frame_log::FrameLog;
pub(crate) use self::health::{RecordCondition, RecordHealth, RecordState};
pub(crate) use self::recorder::{LOG, ORDER_FILES, OrderSource, RUN, Recorder, RunFacts};
pub(crate) use self::sources::{
    BENCH, Hashed, RIG, SCENE, SceneSource, SourceFile, content_xxh3, hash_text, is_of_bench, is_weights,
};

/// What the frame loop did for one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameRecord {
    /// Number of the frame.
    pub frame: u64,
    /// Host time of the newest tracker sample that the estimate rests on, a believed one, where there is one.
    pub t_sample: Option<TimeNs>,
    /// That sample's diameter as measured, scaled to millimetres.
    pub pupil_raw_mm: Option<f32>,
    /// The pupil that the hologram was computed for.
    pub pupil: PupilDiameter,
    /// The tracker's estimate for the time at which the frame's light arrives, where that is followed.
    pub pupil_estimate: Option<PupilDiameter>,
    /// What `pupil` rests on.
    pub pupil_state: FrameState,
    /// The loop woke for this frame.
    pub t_wake: TimeNs,
    pub t_render_begin: TimeNs,
    /// The levels were ready.
    pub t_render_end: TimeNs,
    /// The levels were handed to the presenter.
    pub t_submit: TimeNs,
    /// The refresh that the pacing aimed at.
    pub t_desired_present: TimeNs,
    /// The picture that was shown.
    pub picture: PictureTag,
    /// The memory slot for its levels, where they are kept.
    pub keep: Option<usize>,
    /// The amplitude that double phase took as 1.
    pub amplitude_constant: f32,
    /// The orders that brought what it shows.
    pub orders: FrameOrders,
    /// [`levels_xxh3`] of its levels, where that is wanted.
    pub levels_xxh3: Option<u64>,
    /// They were made for it: the buffer did not have them already.
    pub is_computed: bool,
}

#[cfg(test)]
impl FrameRecord {
    /// A frame for `pupil` of which nothing else is known, made at time 0.
    pub(crate) fn of_pupil(frame: u64, pupil: PupilDiameter) -> Self {
        let t = TimeNs(0);
        Self {
            frame,
            t_sample: None,
            pupil_raw_mm: None,
            pupil,
            pupil_estimate: Some(pupil),
            pupil_state: FrameState::Estimated(holod_pupil_input::PupilState::Tracking),
            t_wake: t,
            t_render_begin: t,
            t_render_end: t,
            t_submit: t,
            t_desired_present: t,
            picture: PictureTag::default(),
            keep: None,
            amplitude_constant: 1.0,
            orders: FrameOrders::default(),
            levels_xxh3: None,
            is_computed: true,
        }
    }
}

/// The orders that brought what a frame shows: their lines in `orders.jsonl`, from 1; 0 for what the run began with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameOrders {
    pub scene: u32,
    pub weights: u32,
    /// The pattern, or holograms again.
    pub pattern: u32,
}

/// XXH3 of 64 bits of a frame's levels: of its samples as [`LevelsFrame`] has them, each as two bytes, the low one first.
pub(crate) fn levels_xxh3(levels: &LevelsFrame) -> u64 {
    XxHash3_64::oneshot(bytemuck::cast_slice(levels.samples()))
}

/// One colour field that the panel showed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct FieldRecord {
    /// Number of the frame that the field belongs to.
    pub frame: u64,
    /// Place of the field in the panel's order.
    pub field: u8,
    pub colour: Colour,
    /// When the field appeared on the panel.
    pub t_present: TimeNs,
    pub provenance: &'static str,
    /// The laser's lit window, where it was lit.
    pub laser_window: Option<(TimeNs, TimeNs)>,
    /// This is the first time that the panel shows this frame, and it is later than planned.
    pub deadline_missed: bool,
}

impl FieldRecord {
    /// The row of a field that was shown.
    pub(crate) fn of(event: &FieldEvent) -> Self {
        Self {
            frame: event.frame_id,
            field: event.field as u8,
            colour: event.colour,
            t_present: event.t_present,
            provenance: event.provenance.name(),
            laser_window: event.laser_on.zip(event.laser_off),
            deadline_missed: event.deadline_missed && !event.repeated,
        }
    }
}

/// Name of the table of fields in a record.
pub(crate) const FRAMES: &str = "frames.csv";
/// Name of the lines of orders in a record.
pub(crate) const ORDERS: &str = "orders.jsonl";
/// The files of a record whose names are always the same.
const FILES: [&str; 8] = [FRAMES, ORDERS, "summary.json", "samples.csv", "tracker.holodraw", RUN, LOG, ORDER_FILES];
/// The name in a record of levels that were shown: those of a frame that was made for a pupil.
pub(crate) fn shown_name(pupil_mm: f32, frame: u64) -> String {
    format!("shown_pupil_{pupil_mm:.2}mm_frame_{frame:06}.png")
}

/// Whether a run has given this name, and nobody else.
fn is_shown_levels(name: &str) -> bool {
    let parts = || {
        let (pupil, frame) = name.strip_prefix("shown_pupil_")?.strip_suffix(".png")?.split_once("mm_frame_")?;
        Some(shown_name(pupil.parse().ok()?, frame.parse().ok()?))
    };
    parts().is_some_and(|given| given == name)
}

/// The names of the levels that were shown, in a record, in order.
///
/// # Errors
/// The folder cannot be read.
pub(crate) fn shown_levels(folder: &Path) -> std::io::Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder)? {
        names.extend(entry?.file_name().into_string().ok().filter(|name| is_shown_levels(name)));
    }
    names.sort();
    Ok(names)
}

/// Refuses a record that lacks what a run writes once and reads never again.
///
/// # Errors
/// Something is missing in `folder`.
pub(crate) fn judge_parts(folder: &Path) -> Result<(), Failure> {
    let is_missing = |path: &PathBuf| !path.try_exists().unwrap_or(true);
    let parts = [RUN.into(), LOG.into(), Path::new(BENCH).join(RIG)].map(|part: PathBuf| folder.join(part));
    let missing: Vec<_> = parts.iter().filter(|path| is_missing(path)).map(|path| path.display().to_string()).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let what = format!("it lacks {}; leave a record as it is until its run is over", missing.join(", "));
    Err(Failure::new(Exit::CannotCreate, what))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_that_are_missing_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let at = |part: &str| folder.path().join(part);
        fs::create_dir(at(BENCH)).unwrap();
        let parts = ["run.json", "log.txt", "bench/rig.toml"];
        for part in parts {
            fs::write(at(part), "").unwrap();
        }
        judge_parts(folder.path()).unwrap();
        for part in parts {
            fs::remove_file(at(part)).unwrap();
            let failure = judge_parts(folder.path()).unwrap_err().to_string();
            assert!(failure.contains(&format!("lacks {}; leave", at(part).display())), "{failure}");
            fs::write(at(part), "").unwrap();
        }
    }

    #[test]
    fn levels_are_known_by_the_whole_of_their_name() {
        for (pupil_mm, frame) in [(2.0, 1), (6.995, 123_456), (1.004, 1_234_567)] {
            assert!(is_shown_levels(&shown_name(pupil_mm, frame)), "{pupil_mm} {frame}");
        }
        let others = [
            "shown_pupil_overview.png",
            "shown_pupil_3.00mm_frame_000001 (copy).png",
            "shown_pupil_3.00mm_frame_1.png",
            "shown_pupil_3mm_frame_000001.png",
            "shown_pupil_3.00mm_frame_000001.jpg",
        ];
        assert!(others.iter().all(|name| !is_shown_levels(name)));
    }
}
