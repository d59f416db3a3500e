//! Reads `frames.csv`: which frames a run made, of what, and how its fields were shown.
//!
//! By hand, since a report comes from others and may hold rows of any length, which the `csv` crate would take in
//! whole.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::str::FromStr;

use holod_calibration::{Colour, PupilDiameter, TimeNs};

use crate::failure::{Exit, Failure};
use crate::frame_record::FrameOrders;
use crate::frame_state::FrameState;

/// Longer than any row.
const LONGEST_ROW: u64 = 4096;

/// A frame of a record.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct RecordedFrame {
    pub(super) frame: u64,
    /// What it was made of; nothing where the record lacks it.
    pub(super) made: Option<Made>,
    /// Place and colour of each of its fields, as they were first shown.
    pub(super) fields: Vec<(u8, Colour)>,
}

/// What a frame was made of.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Made {
    pub(super) pupil: PupilDiameter,
    pub(super) pupil_state: FrameState,
    pub(super) t_wake: TimeNs,
    pub(super) picture: u64,
    /// Its picture came from a live feed.
    pub(super) is_live: bool,
    pub(super) orders: FrameOrders,
    pub(super) levels_xxh3: u64,
}

/// The frames of the record at `path`, by their numbers.
///
/// # Errors
/// The table cannot be read, lacks a column or has a row that is none; a last row that is cut off is none.
pub(super) fn read(path: &Path) -> Result<Vec<RecordedFrame>, Failure> {
    let wrong = |line: usize, what: &str| {
        Failure::new(Exit::Data, format!("frames.csv line {line}: {what}; ask for the report again"))
    };
    let file = File::open(path).map_err(|error| Failure::new(Exit::NoInput, format!("{}: {error}", path.display())))?;
    let mut lines = BufReader::new(file);
    let mut text = String::new();
    let mut next = |number: usize, text: &mut String| {
        text.clear();
        (&mut lines).take(LONGEST_ROW).read_line(text).map_err(|error| wrong(number, &error.to_string()))
    };
    next(1, &mut text)?;
    let columns: HashMap<String, usize> =
        text.trim_end().split(',').enumerate().map(|(index, name)| (name.to_owned(), index)).collect();
    let mut frames: BTreeMap<u64, RecordedFrame> = BTreeMap::new();
    let mut number = 1;
    while next(number + 1, &mut text)? > 0 {
        number += 1;
        if text.len() as u64 == LONGEST_ROW {
            return Err(wrong(number, "found a row of more than 4 KiB, expected one of holod's"));
        }
        // A run that broke off may have left half a row.
        let Some(row) = text.strip_suffix('\n') else { break };
        let row = Row { columns: &columns, cells: row.split(',').collect() };
        let (frame, field, colour, made) = row.read().map_err(|what| wrong(number, &what))?;
        // A panel that was lost may show an older frame again.
        let known = frames.entry(frame).or_insert_with(|| RecordedFrame { frame, made, fields: Vec::new() });
        if known.fields.iter().all(|(known, _)| *known != field) {
            known.fields.push((field, colour));
        }
    }
    Ok(frames.into_values().collect())
}

struct Row<'a> {
    columns: &'a HashMap<String, usize>,
    cells: Vec<&'a str>,
}

impl Row<'_> {
    fn read(&self) -> Result<(u64, u8, Colour, Option<Made>), String> {
        let name = self.text("colour")?;
        let colour = Colour::ALL.into_iter().find(|colour| colour.name() == name);
        let colour = colour.ok_or_else(|| format!("found the colour `{name}`, expected red, green or blue"))?;
        Ok((self.needed("frame")?, self.needed("field")?, colour, self.made()?))
    }

    fn made(&self) -> Result<Option<Made>, String> {
        let (Some(pupil_mm), Some(t_wake_ns)) = (self.cell::<f32>("pupil_mm")?, self.cell("t_wake_ns")?) else {
            return Ok(None);
        };
        if !(0.1..=20.0).contains(&pupil_mm) {
            return Err(format!("found a pupil of {pupil_mm} mm, expected one of an eye"));
        }
        let hash = self.text("levels_xxh3")?;
        if hash.is_empty() {
            return Ok(None);
        }
        let levels_xxh3 = u64::from_str_radix(hash, 16)
            .map_err(|_| format!("levels_xxh3: found `{hash}`, expected hexadecimal digits"))?;
        Ok(Some(Made {
            pupil: PupilDiameter::from_mm(pupil_mm),
            pupil_state: FrameState::named(self.text("pupil_state")?),
            t_wake: TimeNs(t_wake_ns),
            picture: self.needed("picture")?,
            is_live: !self.text("t_picture_ns")?.is_empty(),
            orders: FrameOrders {
                scene: self.needed("scene_order")?,
                weights: self.needed("weights_order")?,
                pattern: self.needed("pattern_order")?,
            },
            levels_xxh3,
        }))
    }

    fn text(&self, name: &str) -> Result<&str, String> {
        let index = self.columns.get(name).ok_or_else(|| {
            format!("found no column {name}: an earlier holod recorded it, whose frames cannot be made again")
        })?;
        self.cells.get(*index).copied().ok_or_else(|| {
            format!("found {} cells, expected the {} that the first line names", self.cells.len(), self.columns.len())
        })
    }

    fn cell<T: FromStr>(&self, name: &str) -> Result<Option<T>, String> {
        match self.text(name)? {
            "" => Ok(None),
            text => text.parse().map(Some).map_err(|_| format!("{name}: found `{text}`, expected a number")),
        }
    }

    fn needed<T: FromStr>(&self, name: &str) -> Result<T, String> {
        self.cell(name)?.ok_or_else(|| format!("{name}: found nothing, expected a number"))
    }
}

#[cfg(test)]
mod tests {
    use std::fs::OpenOptions;
    use std::io::Write;

    use super::*;
    use crate::record::FrameLog;

    fn table(rows: &str) -> Result<Vec<RecordedFrame>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frames.csv");
        FrameLog::create(folder.path()).and_then(|mut log| log.flush()).unwrap();
        OpenOptions::new().append(true).open(&path).and_then(|mut file| file.write_all(rows.as_bytes())).unwrap();
        read(&path).map_err(|failure| failure.to_string())
    }

    const ROW: &str =
        "7,1,green,5,3.25,3.3000002,tracking,10,11,20,21,30,software,33,36,0,4,,00000000000000ab,2,0,1,,,,,1\n";

    #[test]
    fn frames_are_read_with_all_that_they_were_made_of() {
        let lost = "8,1,green,,,,,,,,,30,software,33,36,0,,,,,,,,,,,\n";
        let rows = [ROW, &ROW.replace("7,1,green", "7,2,red"), ROW, lost, &ROW[..40]].concat();
        let frames = table(&rows).unwrap();
        assert_eq!(frames.len(), 2, "half a row is none");
        assert_eq!(frames[0].fields, [(1, Colour::Green), (2, Colour::Red)], "a repetition is no other field");
        let made = frames[0].made.as_ref().unwrap();
        assert_eq!(made.pupil.mm().to_bits(), 3.300_000_2_f32.to_bits());
        assert_eq!((made.levels_xxh3, made.picture, made.is_live), (0xab, 4, false));
        assert_eq!(made.orders, FrameOrders { scene: 2, weights: 0, pattern: 1 });
        assert_eq!(frames[1].made, None);
        let older = table(&[ROW, &ROW.replace("7,1", "6,1"), &ROW.replace("7,1,green", "6,2,red")].concat()).unwrap();
        assert_eq!(older.iter().map(|frame| (frame.frame, frame.fields.len())).collect::<Vec<_>>(), [(6, 2), (7, 1)]);
        assert!(table(&ROW.replace(",4,,", ",4,9,")).unwrap()[0].made.as_ref().unwrap().is_live);
    }

    #[test]
    fn faults_name_their_line() {
        for (rows, says) in [
            (ROW.replace("green", "mauve"), "line 2: found the colour `mauve`"),
            (ROW.replace("00000000000000ab", "xyz"), "levels_xxh3: found `xyz`, expected hexadecimal digits; ask"),
            (ROW.replace("3.3000002", "wide"), "pupil_mm: found `wide`, expected a number"),
            ("7,1,green\n".to_owned(), "found 3 cells, expected the 27 that"),
        ] {
            let said = table(&rows).unwrap_err();
            assert!(said.contains(says), "{said}");
        }
    }
}
