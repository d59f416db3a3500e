//! `frames.csv`: a row for each colour field that the panel showed, with what is known of its frame.

use std::collections::HashMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use holod_calibration::TimeNs;

use super::health::lost;
use super::place::judge_file;
use super::sources::hash_text;
use super::{FRAMES, FieldRecord, ORDERS};
use crate::control::Request;
use crate::failure::{Exit, Failure};
use crate::frame_record::FrameRecord;

use self::Cell::{Field, Frame};

/// What is in a cell. That of a frame is empty where the frame is not known.
#[derive(Clone, Copy)]
enum Cell {
    Field(fn(&FieldRecord) -> String),
    Frame(fn(&FrameRecord) -> Option<String>),
}

const COLUMNS: [(&str, Cell); 27] = [
    ("frame", Field(|field| field.frame.to_string())),
    ("field", Field(|field| field.field.to_string())),
    ("colour", Field(|field| field.colour.to_string())),
    ("t_sample_ns", Frame(|frame| frame.t_sample.map(nanoseconds))),
    ("pupil_raw_mm", Frame(|frame| frame.pupil_raw_mm.map(|mm| format!("{mm:.4}")))),
    // The shortest text that reads back as the same bits.
    ("pupil_mm", Frame(|frame| Some(frame.pupil.mm().to_string()))),
    ("pupil_state", Frame(|frame| Some(frame.pupil_state.name().into()))),
    ("t_wake_ns", Frame(|frame| Some(nanoseconds(frame.t_wake)))),
    ("t_render_begin_ns", Frame(|frame| Some(nanoseconds(frame.t_render_begin)))),
    ("t_render_end_ns", Frame(|frame| Some(nanoseconds(frame.t_render_end)))),
    ("t_submit_ns", Frame(|frame| Some(nanoseconds(frame.t_submit)))),
    ("t_present_ns", Field(|field| nanoseconds(field.t_present))),
    ("present_provenance", Field(|field| field.timestamp_source.into())),
    ("laser_on_ns", Field(|field| field.laser_window.map_or_else(String::new, |(on, _)| nanoseconds(on)))),
    ("laser_off_ns", Field(|field| field.laser_window.map_or_else(String::new, |(_, off)| nanoseconds(off)))),
    ("deadline_missed", Field(|field| u8::from(field.deadline_missed).to_string())),
    ("picture", Frame(|frame| Some(frame.picture.number.to_string()))),
    ("t_picture_ns", Frame(|frame| frame.picture.t_taken.map(nanoseconds))),
    ("levels_xxh3", Frame(|frame| frame.levels_xxh3.map(hash_text))),
    ("scene_order", Frame(|frame| Some(frame.orders.scene.to_string()))),
    ("weights_order", Frame(|frame| Some(frame.orders.weights.to_string()))),
    ("pattern_order", Frame(|frame| Some(frame.orders.pattern.to_string()))),
    ("picture_focus_dpt", Frame(|frame| frame.picture.view.focus_dpt.map(|dpt| dpt.to_string()))),
    ("picture_fov_x_deg", Frame(|frame| frame.picture.view.field_of_view_deg.map(|[across, _]| across.to_string()))),
    ("picture_fov_y_deg", Frame(|frame| frame.picture.view.field_of_view_deg.map(|[_, up]| up.to_string()))),
    ("pupil_estimate_mm", Frame(|frame| frame.pupil_estimate.map(|pupil| pupil.mm().to_string()))),
    ("computed", Frame(|frame| Some(u8::from(frame.is_computed).to_string()))),
];

fn nanoseconds(t: TimeNs) -> String {
    t.0.to_string()
}

/// Writes `frames.csv` as the run goes; what a crash can cost is what came since the last [`FrameLog::flush`].
pub(crate) struct FrameLog {
    rows: csv::Writer<UntilRefused>,
    path: PathBuf,
    frames: HashMap<u64, FrameRecord>,
    /// The frame of the last row.
    newest: Option<u64>,
    /// `orders.jsonl`, once there is something in it.
    orders: Option<File>,
}

/// A file that takes nothing more once it has refused something: csv's writer keeps what was refused, of which the
/// disk may have taken a part, and writes it again when it is dropped.
struct UntilRefused {
    file: File,
    has_refused: bool,
}

impl Write for UntilRefused {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.has_refused {
            return Err(io::Error::other("it refused a write before"));
        }
        let written = self.file.write(bytes);
        self.has_refused = matches!(&written, Err(error) if error.kind() != io::ErrorKind::Interrupted);
        written
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Frames remembered for fields that are still to be shown: more than can wait for a control thread that is late.
const KEPT_FRAMES: u64 = 2048;

impl FrameLog {
    /// Starts `frames.csv` in `folder`, which is created; a record that is already there is never overwritten.
    pub(crate) fn create(folder: &Path) -> Result<Self, Failure> {
        let cannot = |error: io::Error| {
            Failure::new(
                Exit::CannotCreate,
                format!("cannot record into {}: {error}; name another directory with --record", folder.display()),
            )
        };
        fs::create_dir_all(folder).map_err(cannot)?;
        let path = folder.join(FRAMES);
        let file = OpenOptions::new().write(true).create_new(true).open(&path).map_err(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => Failure::new(
                Exit::CannotCreate,
                format!(
                    "{} holds an earlier record; name another directory with --record, or overwrite it with --force",
                    path.display()
                ),
            ),
            _ => cannot(error),
        })?;
        let mut log = Self::of(file, path);
        log.rows.write_record(COLUMNS.map(|(name, _)| name)).map_err(|error| cannot(error.into()))?;
        Ok(log)
    }

    fn of(file: File, path: PathBuf) -> Self {
        let rows = csv::Writer::from_writer(UntilRefused { file, has_refused: false });
        Self { rows, path, frames: HashMap::new(), newest: None, orders: None }
    }

    /// Takes note of a rendered frame; its rows are written when its fields are shown.
    pub(crate) fn frame(&mut self, record: FrameRecord) {
        self.frames.insert(record.frame, record);
        if self.frames.len() as u64 > 2 * KEPT_FRAMES {
            self.frames.retain(|&frame, _| frame + KEPT_FRAMES >= record.frame);
        }
    }

    /// Writes the row of a field that was shown.
    ///
    /// # Errors
    /// The disk's, with the file's name.
    pub(crate) fn field(&mut self, field: &FieldRecord) -> Result<(), Failure> {
        let is_first = self.newest.replace(field.frame) != Some(field.frame);
        let field = &FieldRecord { deadline_missed: field.deadline_missed && is_first, ..*field };
        let frame = self.frames.get(&field.frame);
        let row = COLUMNS.map(|(_, cell)| match cell {
            Field(cell) => cell(field),
            Frame(cell) => frame.and_then(cell).unwrap_or_default(),
        });
        self.rows.write_record(row).map_err(|error| self.lost(&error.into()))
    }

    /// Writes down beside it, in `orders.jsonl`, that a person changed something at host time `t`. The file is there
    /// once there is something in it.
    ///
    /// # Errors
    /// The disk's, with the file's name.
    pub(crate) fn order(&mut self, t: TimeNs, request: &Request) -> Result<(), Failure> {
        let path = self.orders_path();
        let line = serde_json::json!({ "t_ns": t.0, "request": request });
        let write = |orders: &mut Option<File>| {
            let file = match orders.take() {
                Some(file) => file,
                None => OpenOptions::new().create_new(true).append(true).open(&path)?,
            };
            writeln!(orders.insert(file), "{line}")
        };
        write(&mut self.orders).map_err(|error| lost(&path, &error))
    }

    /// Hands everything to the operating system.
    ///
    /// # Errors
    /// The disk's, with the file's name; a file that is not in its place any more.
    pub(crate) fn flush(&mut self) -> Result<(), Failure> {
        let flushed = self.rows.flush().and_then(|()| judge_file(&self.rows.get_ref().file, &self.path));
        flushed.map_err(|error| self.lost(&error))?;
        let path = self.orders_path();
        self.orders.as_ref().map_or(Ok(()), |orders| judge_file(orders, &path)).map_err(|error| lost(&path, &error))
    }

    fn orders_path(&self) -> PathBuf {
        self.path.with_file_name(ORDERS)
    }

    /// Whether no frame was ever made.
    pub(crate) fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    fn lost(&self, error: &io::Error) -> Failure {
        lost(&self.path, error)
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::OwnedFd;

    use holod_calibration::{Colour, PupilDiameter};
    use holod_pupil_input::PupilState;

    use super::*;
    use crate::frame_record::FrameOrders;
    use crate::frame_state::FrameState;
    use crate::source::{PictureTag, PictureView};

    fn frame(number: u64) -> FrameRecord {
        FrameRecord {
            frame: number,
            t_sample: Some(TimeNs(5)),
            pupil_raw_mm: Some(3.25),
            pupil: PupilDiameter::from_mm(3.3),
            pupil_estimate: Some(PupilDiameter::from_mm(3.25)),
            pupil_state: FrameState::Estimated(PupilState::Tracking),
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
            is_computed: true,
        }
    }

    fn field(number: u64) -> FieldRecord {
        FieldRecord {
            frame: number,
            field: 1,
            colour: Colour::Green,
            t_present: TimeNs(30),
            timestamp_source: "software",
            laser_window: Some((TimeNs(33), TimeNs(36))),
            deadline_missed: false,
        }
    }

    #[test]
    fn each_column_is_explained_on_the_page_about_records() {
        let page = include_str!("../../doc/record.md");
        let missing = |columns: &[&str]| -> Vec<String> {
            columns.iter().map(|name| format!("`{name}`")).filter(|name| !page.contains(name)).collect()
        };
        assert_eq!(missing(&COLUMNS.map(|(name, _)| name)), Vec::<String>::new());
        assert_eq!(missing(&["no_such_column"]).len(), 1);
    }

    #[test]
    fn a_row_has_one_cell_per_column_and_holds_both_halves() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = FrameLog::create(folder.path()).unwrap();
        log.frame(frame(7));
        log.field(&field(7)).unwrap();
        log.field(&field(999)).unwrap();
        log.frame(FrameRecord { is_computed: false, ..frame(8) });
        log.field(&field(8)).unwrap();
        log.flush().unwrap();
        let text = fs::read_to_string(folder.path().join("frames.csv")).unwrap();
        let rows: Vec<&str> = text.lines().collect();
        assert_eq!(
            rows[1],
            "7,1,green,5,3.2500,3.3,tracking,10,11,20,21,30,software,33,36,0,4,3,00000000000000ab,2,0,1,1.25,60,45.5,3.25,1"
        );
        assert_eq!(rows[2], "999,1,green,,,,,,,,,30,software,33,36,0,,,,,,,,,,,");
        assert!(rows[3].starts_with("8,1,green,5,") && rows[3].ends_with(",3.25,0"), "{}", rows[3]);
        assert!(rows.iter().all(|row| row.split(',').count() == COLUMNS.len()));
    }

    #[test]
    fn a_late_frame_is_counted_once() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = FrameLog::create(folder.path()).unwrap();
        for (number, deadline_missed) in [(7, true), (7, true), (7, true), (8, false), (8, false), (9, true), (9, true)]
        {
            log.field(&FieldRecord { deadline_missed, ..field(number) }).unwrap();
        }
        log.flush().unwrap();
        let text = fs::read_to_string(folder.path().join("frames.csv")).unwrap();
        let column = COLUMNS.iter().position(|(name, _)| *name == "deadline_missed").unwrap();
        let cells: Vec<&str> = text.lines().skip(1).map(|row| row.split(',').nth(column).unwrap()).collect();
        assert_eq!(cells, ["1", "0", "0", "0", "0", "1", "0"]);
    }

    #[test]
    fn what_a_full_disk_refused_is_not_written_later_behind_the_part_that_it_took() {
        let (mut reader, writer) = io::pipe().unwrap();
        rustix::io::ioctl_fionbio(&writer, true).unwrap();
        let mut log = FrameLog::of(File::from(OwnedFd::from(writer)), PathBuf::from(FRAMES));
        let row = (0..).find(|&number| log.field(&field(number)).is_err()).unwrap();
        assert!(log.flush().is_err());
        // There is room again when the run ends.
        let reading = std::thread::spawn(move || io::read_to_string(&mut reader).unwrap());
        drop(log);
        let text = reading.join().unwrap();
        let rows: Vec<&str> = text.lines().collect();
        let (last, whole) = rows.split_last().unwrap();
        assert!((100..row).contains(&(whole.len() as u64)), "{} of {row}", whole.len());
        let expected = |number: usize| format!("{number},1,green,,,,,,,,,30,software,33,36,0,,,,,,,,,,,");
        assert!(whole.iter().enumerate().all(|(number, row)| **row == expected(number)), "{text}");
        assert!(expected(whole.len()).starts_with(last), "{last}");
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
        let mut log = FrameLog::create(folder.path()).unwrap();
        log.order(TimeNs(5), &Request::Pupil { mm: Some(3.5) }).unwrap();
        log.order(TimeNs(6), &Request::LasersDark {}).unwrap();
        let text = fs::read_to_string(folder.path().join("orders.jsonl")).unwrap();
        let expected =
            [r#"{"request":{"do":"pupil","mm":3.5},"t_ns":5}"#, r#"{"request":{"do":"lasers-dark"},"t_ns":6}"#];
        assert_eq!(text.lines().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn a_file_that_is_deleted_or_moved_is_noticed_when_it_is_flushed() {
        for missing in [FRAMES, ORDERS] {
            for is_deleted in [true, false] {
                let folder = tempfile::tempdir().unwrap();
                let mut log = FrameLog::create(folder.path()).unwrap();
                log.order(TimeNs(5), &Request::LasersDark {}).unwrap();
                log.flush().unwrap();
                let path = folder.path().join(missing);
                if is_deleted { fs::remove_file(&path) } else { fs::rename(&path, folder.path().join("old")) }.unwrap();
                // No file is made anew, whose first line would be another order's.
                log.order(TimeNs(6), &Request::LasersArm {}).unwrap();
                assert!(!path.exists());
                let failure = log.flush().unwrap_err();
                assert_eq!(failure.exit, Exit::CannotCreate);
                let expected = format!("{missing}: the file was deleted or moved; leave a record where it is");
                assert!(failure.to_string().contains(&expected), "{failure}");
            }
        }
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
