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

use holod_calibration::{Colour, TimeNs};
use holod_slm_output::FieldEvent;

use crate::failure::{Exit, Failure};

pub(crate) use self::folder::{EARLIER, RecordFolder};
pub(crate) use self::frame_log::FrameLog;
pub(crate) use self::health::RecordHealth;
pub(crate) use self::recorder::{LOG, ORDER_FILES, OrderSource, RUN, Recorder, RunFacts};
pub(crate) use self::sources::{
    BENCH, Hashed, RIG, SCENE, SceneSource, SourceFile, content_xxh3, hash_text, is_of_bench, is_weights,
};

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
    pub timestamp_source: &'static str,
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
            timestamp_source: event.timestamp_source.name(),
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
