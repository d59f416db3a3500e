//! A run written down: `frames.csv`, one row per colour field that the panel showed; with what it was made of, so that its
//! frames can be made again.

mod health;
mod recorder;
mod sources;

use std::collections::HashMap;
use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use holod_calibration::{Colour, PupilDiameter, TimeNs};
use holod_slm_output::{FieldEvent, LevelsFrame};
use twox_hash::XxHash3_64;

use crate::control::Request;
use crate::failure::{Exit, Failure};
use crate::source::PictureTag;

use self::health::lost;
pub use self::health::{RecordCondition, RecordHealth, RecordState};
pub use self::recorder::{LOG, ORDER_FILES, OrderSource, RUN, Recorder, RunFacts};
pub use self::sources::{
    BENCH, Hashed, RIG, SCENE, SceneSource, SourceFile, content_xxh3, hash_text, is_of_bench, is_weights,
};

/// What the frame loop did for one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameRecord {
    /// Number of the frame.
    pub frame: u64,
    /// Host time of the newest tracker sample behind the estimate, where there is one.
    pub t_sample: Option<TimeNs>,
    /// That sample's diameter as the tracker gave it.
    pub pupil_raw_mm: Option<f32>,
    /// The estimate for the time at which the frame's light arrives, for which the hologram was computed.
    pub pupil: PupilDiameter,
    /// Name of the estimator's state.
    pub pupil_state: &'static str,
    /// The loop woke for this frame.
    pub t_wake: TimeNs,
    /// The network began.
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
}

/// The orders that brought what a frame shows: their lines in `orders.jsonl`, from 1; 0 for what the run began with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameOrders {
    /// The scene.
    pub scene: u32,
    /// The weights.
    pub weights: u32,
    /// The pattern, or holograms again.
    pub pattern: u32,
}

/// XXH3 of 64 bits of a frame's levels: of its samples, each as two bytes, the low one first.
pub fn levels_xxh3(levels: &LevelsFrame) -> u64 {
    XxHash3_64::oneshot(bytemuck::cast_slice(levels.samples()))
}

/// One colour field that the panel showed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldRecord {
    /// Number of the frame that the field belongs to.
    pub frame: u64,
    /// Place of the field in the panel's order.
    pub field: u8,
    /// Its colour.
    pub colour: Colour,
    /// When the field appeared on the panel.
    pub t_present: TimeNs,
    /// Who says so.
    pub provenance: &'static str,
    /// The laser's lit window, where it was lit.
    pub laser_window: Option<(TimeNs, TimeNs)>,
    /// This is the first time that the panel shows this frame, and it is later than planned.
    pub deadline_missed: bool,
}

impl FieldRecord {
    /// The row of a field that was shown.
    pub fn of(event: &FieldEvent) -> Self {
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

/// The columns of `frames.csv`.
pub const HEADER: &str = "frame,field,colour,t_sample_ns,pupil_raw_mm,pupil_mm,pupil_state,t_wake_ns,t_render_begin_ns,\
t_render_end_ns,t_submit_ns,t_present_ns,present_provenance,laser_on_ns,laser_off_ns,deadline_missed,picture,t_picture_ns,\
levels_xxh3,scene_order,weights_order,pattern_order,picture_focus_dpt,picture_fov_x_deg,picture_fov_y_deg";

/// Name of the table of fields in a record.
pub const FRAMES: &str = "frames.csv";
/// Name of the lines of orders in a record.
pub const ORDERS: &str = "orders.jsonl";
/// The files of a record whose names are always the same.
const FILES: [&str; 8] = [FRAMES, ORDERS, "summary.json", "samples.csv", "tracker.holodraw", RUN, LOG, ORDER_FILES];
/// How the names of the levels that were shown begin and end.
const SHOWN: (&str, &str) = ("shown_pupil_", ".png");

/// Takes an earlier record out of `folder`, for a run that is to overwrite it; other files stay.
///
/// # Errors
/// One of them cannot be removed.
pub fn remove_earlier(folder: &Path) -> Result<(), Failure> {
    let cannot = |error: std::io::Error| {
        Failure::new(Exit::CannotCreate, format!("cannot overwrite the record in {}: {error}", folder.display()))
    };
    let Ok(entries) = fs::read_dir(folder) else { return Ok(()) };
    sources::remove_bench(folder).map_err(cannot)?;
    for entry in entries {
        let entry = entry.map_err(cannot)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if FILES.contains(&name.as_str()) || is_shown_levels(&name) {
            fs::remove_file(entry.path()).map_err(cannot)?;
        }
    }
    Ok(())
}

fn is_shown_levels(name: &str) -> bool {
    name.starts_with(SHOWN.0) && name.ends_with(SHOWN.1)
}

/// The names of the levels that were shown, in a record, in order.
///
/// # Errors
/// The folder cannot be read.
pub fn shown_levels(folder: &Path) -> std::io::Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder)? {
        names.extend(entry?.file_name().into_string().ok().filter(|name| is_shown_levels(name)));
    }
    names.sort();
    Ok(names)
}

/// Writes `frames.csv` as the run goes; what a crash can cost is what came since the last [`FrameLog::flush`].
pub struct FrameLog {
    file: BufWriter<File>,
    path: PathBuf,
    frames: HashMap<u64, FrameRecord>,
}

/// Frames remembered for fields that are still to be shown: more than can wait for a control thread that is late.
const KEPT_FRAMES: u64 = 2048;

impl FrameLog {
    /// Starts `frames.csv` in `folder`, which is created; a record that is already there is never overwritten.
    pub fn create(folder: &Path) -> Result<Self, Failure> {
        let cannot = |error: std::io::Error| {
            Failure::new(
                Exit::CannotCreate,
                format!("cannot record into {}: {error}; name another directory with --record", folder.display()),
            )
        };
        fs::create_dir_all(folder).map_err(cannot)?;
        let path = folder.join(FRAMES);
        let file = OpenOptions::new().write(true).create_new(true).open(&path).map_err(|error| match error.kind() {
            std::io::ErrorKind::AlreadyExists => Failure::new(
                Exit::CannotCreate,
                format!(
                    "{} holds an earlier record; name another directory with --record, or overwrite it with --force",
                    path.display()
                ),
            ),
            _ => cannot(error),
        })?;
        let mut file = BufWriter::new(file);
        writeln!(file, "{HEADER}").map_err(cannot)?;
        Ok(Self { file, path, frames: HashMap::new() })
    }

    /// Takes note of a rendered frame; its rows are written when its fields are shown.
    pub fn frame(&mut self, record: FrameRecord) {
        self.frames.insert(record.frame, record);
        if self.frames.len() as u64 > 2 * KEPT_FRAMES {
            self.frames.retain(|&frame, _| frame + KEPT_FRAMES >= record.frame);
        }
    }

    /// Writes the row of a field that was shown.
    ///
    /// # Errors
    /// The disk's, with the file's name.
    pub fn field(&mut self, field: &FieldRecord) -> Result<(), Failure> {
        let frame = self.frames.get(&field.frame);
        let time = |t: Option<TimeNs>| t.map(|t| t.0.to_string()).unwrap_or_default();
        let order = |order: Option<u32>| order.map(|order| order.to_string()).unwrap_or_default();
        let figure = |figure: Option<f32>| figure.map(|figure| figure.to_string()).unwrap_or_default();
        let view = frame.map(|f| f.picture.view).unwrap_or_default();
        let (on, off) = (field.laser_window.map(|w| w.0), field.laser_window.map(|w| w.1));
        writeln!(
            self.file,
            "{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
            field.frame,
            field.field,
            field.colour,
            time(frame.and_then(|f| f.t_sample)),
            frame.and_then(|f| f.pupil_raw_mm).map(|mm| format!("{mm:.4}")).unwrap_or_default(),
            // The shortest text that reads back as the same bits.
            frame.map(|f| f.pupil.mm().to_string()).unwrap_or_default(),
            frame.map_or("", |f| f.pupil_state),
            time(frame.map(|f| f.t_wake)),
            time(frame.map(|f| f.t_render_begin)),
            time(frame.map(|f| f.t_render_end)),
            time(frame.map(|f| f.t_submit)),
            field.t_present.0,
            field.provenance,
            time(on),
            time(off),
            u8::from(field.deadline_missed),
            frame.map(|f| f.picture.number.to_string()).unwrap_or_default(),
            time(frame.and_then(|f| f.picture.t_taken)),
            frame.and_then(|f| f.levels_xxh3).map(hash_text).unwrap_or_default(),
            order(frame.map(|f| f.orders.scene)),
            order(frame.map(|f| f.orders.weights)),
            order(frame.map(|f| f.orders.pattern)),
            figure(view.focus_dpt),
            figure(view.field_of_view_deg.map(|[across, _]| across)),
            figure(view.field_of_view_deg.map(|[_, up]| up)),
        )
        .map_err(|error| self.lost(&error))
    }

    /// Writes down beside it, in `orders.jsonl`, that a person changed something at host time `t`. The file is there once
    /// there is something in it.
    ///
    /// # Errors
    /// The disk's, with the file's name.
    pub fn order(&self, t: TimeNs, request: &Request) -> Result<(), Failure> {
        let path = self.path.with_file_name(ORDERS);
        let line = serde_json::json!({ "t_ns": t.0, "request": request });
        let file = OpenOptions::new().create(true).append(true).open(&path);
        file.and_then(|mut file| writeln!(file, "{line}")).map_err(|error| lost(&path, &error))
    }

    /// Hands everything to the operating system.
    ///
    /// # Errors
    /// The disk's, with the file's name.
    pub fn flush(&mut self) -> Result<(), Failure> {
        let links = self.file.flush().and_then(|()| self.file.get_ref().metadata()).map(|metadata| metadata.nlink());
        match links {
            // What is written into a file without a name is lost when it is closed.
            Ok(0) => Err(self.lost(&std::io::Error::new(std::io::ErrorKind::NotFound, "the file was deleted"))),
            Ok(_) => Ok(()),
            Err(error) => Err(self.lost(&error)),
        }
    }

    /// Whether no frame was ever made.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Takes the file away again where no frame was ever made, so that the same directory may be named again.
    pub fn discard_if_empty(self) {
        if self.is_empty() {
            let _gone = fs::remove_file(&self.path);
            if let Some(folder) = self.path.parent() {
                // Fails where something else is in it, which then stays.
                let _gone = fs::remove_dir(folder);
            }
        }
    }

    fn lost(&self, error: &std::io::Error) -> Failure {
        lost(&self.path, error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::PictureView;

    fn frame(number: u64) -> FrameRecord {
        FrameRecord {
            frame: number,
            t_sample: Some(TimeNs(5)),
            pupil_raw_mm: Some(3.25),
            pupil: PupilDiameter::from_mm(3.3),
            pupil_state: "tracking",
            t_wake: TimeNs(10),
            t_render_begin: TimeNs(11),
            t_render_end: TimeNs(20),
            t_submit: TimeNs(21),
            t_desired_present: TimeNs(30),
            picture: PictureTag {
                number: 4,
                t_taken: Some(TimeNs(3)),
                t_came: Some(TimeNs(4)),
                view: PictureView { focus_dpt: Some(1.25), field_of_view_deg: Some([60.0, 45.5]) },
                order: 2,
            },
            keep: None,
            amplitude_constant: 1.0,
            orders: FrameOrders { scene: 2, weights: 0, pattern: 1 },
            levels_xxh3: Some(0xab),
        }
    }

    fn field(number: u64) -> FieldRecord {
        FieldRecord {
            frame: number,
            field: 1,
            colour: Colour::Green,
            t_present: TimeNs(30),
            provenance: "software",
            laser_window: Some((TimeNs(33), TimeNs(36))),
            deadline_missed: false,
        }
    }

    #[test]
    fn a_row_has_one_cell_per_column_and_holds_both_halves() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = FrameLog::create(folder.path()).unwrap();
        log.frame(frame(7));
        log.field(&field(7)).unwrap();
        log.field(&field(999)).unwrap();
        log.flush().unwrap();
        let text = fs::read_to_string(folder.path().join("frames.csv")).unwrap();
        let rows: Vec<&str> = text.lines().collect();
        assert_eq!(
            rows[1],
            "7,1,green,5,3.2500,3.3,tracking,10,11,20,21,30,software,33,36,0,4,3,00000000000000ab,2,0,1,1.25,60,45.5"
        );
        assert_eq!(rows[2], "999,1,green,,,,,,,,,30,software,33,36,0,,,,,,,,,");
        assert!(rows.iter().all(|row| row.split(',').count() == HEADER.split(',').count()));
    }

    #[test]
    fn an_earlier_record_is_never_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("frames.csv"), "precious").unwrap();
        assert_eq!(FrameLog::create(folder.path()).err().unwrap().exit, Exit::CannotCreate);
        assert_eq!(fs::read_to_string(folder.path().join("frames.csv")).unwrap(), "precious");
    }

    #[test]
    fn orders_stand_beside_the_frames_one_to_a_line() {
        let folder = tempfile::tempdir().unwrap();
        let log = FrameLog::create(folder.path()).unwrap();
        log.order(TimeNs(5), &Request::Pupil { mm: Some(3.5) }).unwrap();
        log.order(TimeNs(6), &Request::LasersDark).unwrap();
        let text = fs::read_to_string(folder.path().join("orders.jsonl")).unwrap();
        let expected =
            [r#"{"request":{"do":"pupil","mm":3.5},"t_ns":5}"#, r#"{"request":{"do":"lasers-dark"},"t_ns":6}"#];
        assert_eq!(text.lines().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn a_record_that_is_deleted_is_noticed_when_it_is_flushed() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = FrameLog::create(&folder.path().join("record")).unwrap();
        log.flush().unwrap();
        fs::remove_dir_all(folder.path().join("record")).unwrap();
        let failure = log.flush().unwrap_err();
        assert_eq!(failure.exit, Exit::CannotCreate);
        assert!(failure.to_string().contains("frames.csv: the file was deleted"), "{failure}");
    }

    #[test]
    fn force_takes_an_earlier_record_away_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let names = [
            "frames.csv",
            "orders.jsonl",
            "summary.json",
            "samples.csv",
            "tracker.holodraw",
            "shown_pupil_3.00mm_frame_000001.png",
        ];
        for name in names.into_iter().chain(["notes.txt", "shown.png"]) {
            fs::write(folder.path().join(name), "old").unwrap();
        }
        remove_earlier(folder.path()).unwrap();
        let mut left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["notes.txt", "shown.png"]);
        remove_earlier(&folder.path().join("absent")).unwrap();
    }

    #[test]
    fn a_day_of_frames_does_not_grow_the_log() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = FrameLog::create(folder.path()).unwrap();
        for number in 0..10_000 {
            log.frame(frame(number));
        }
        assert!(log.frames.len() as u64 <= 2 * KEPT_FRAMES + 1);
    }
}
