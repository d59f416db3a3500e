//! A reader and a judge of `frames.csv`.

use std::collections::HashMap;
use std::fs;
use std::path::Path;

/// A row: one colour field that the panel showed. Empty cells are `None`.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs, reason = "the fields are the columns of frames.csv, defined by the daemon's record module")]
pub struct FieldRow {
    pub frame: u64,
    pub field: u8,
    pub colour: String,
    pub t_sample_ns: Option<i64>,
    pub pupil_raw_mm: Option<f64>,
    pub pupil_mm: f64,
    pub pupil_estimate_mm: Option<f64>,
    pub pupil_state: String,
    pub t_wake_ns: i64,
    pub t_render_begin_ns: i64,
    pub t_render_end_ns: i64,
    pub t_submit_ns: i64,
    pub t_present_ns: i64,
    pub present_provenance: String,
    pub laser_on_ns: Option<i64>,
    pub laser_off_ns: Option<i64>,
    pub deadline_missed: bool,
    pub picture: u64,
    pub t_picture_ns: Option<i64>,
    pub picture_focus_dpt: Option<f64>,
    pub picture_fov_x_deg: Option<f64>,
    pub picture_fov_y_deg: Option<f64>,
    pub levels_xxh3: String,
    pub computed: bool,
}

/// Reads every row of a record.
///
/// # Errors
/// What is wrong with the file, with its line.
pub fn read(path: &Path) -> Result<Vec<FieldRow>, String> {
    let text = fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().ok_or("the record is empty")?.split(',').collect();
    lines
        .enumerate()
        .map(|(index, line)| {
            let cells: HashMap<&str, &str> = header.iter().copied().zip(line.split(',')).collect();
            row(&cells).map_err(|what| format!("{} line {}: {what}", path.display(), index + 2))
        })
        .collect()
}

fn row(cells: &HashMap<&str, &str>) -> Result<FieldRow, String> {
    fn cell<T: std::str::FromStr>(cells: &HashMap<&str, &str>, name: &str) -> Result<Option<T>, String> {
        let text = *cells.get(name).ok_or_else(|| format!("no column {name}"))?;
        match text {
            "" => Ok(None),
            _ => text.parse().map(Some).map_err(|_| format!("{name} is '{text}'")),
        }
    }
    fn needed<T: std::str::FromStr>(cells: &HashMap<&str, &str>, name: &str) -> Result<T, String> {
        cell(cells, name)?.ok_or_else(|| format!("{name} is empty"))
    }
    Ok(FieldRow {
        frame: needed(cells, "frame")?,
        field: needed(cells, "field")?,
        colour: needed(cells, "colour")?,
        t_sample_ns: cell(cells, "t_sample_ns")?,
        pupil_raw_mm: cell(cells, "pupil_raw_mm")?,
        pupil_mm: needed(cells, "pupil_mm")?,
        pupil_estimate_mm: cell(cells, "pupil_estimate_mm")?,
        pupil_state: needed(cells, "pupil_state")?,
        t_wake_ns: needed(cells, "t_wake_ns")?,
        t_render_begin_ns: needed(cells, "t_render_begin_ns")?,
        t_render_end_ns: needed(cells, "t_render_end_ns")?,
        t_submit_ns: needed(cells, "t_submit_ns")?,
        t_present_ns: needed(cells, "t_present_ns")?,
        present_provenance: needed(cells, "present_provenance")?,
        laser_on_ns: cell(cells, "laser_on_ns")?,
        laser_off_ns: cell(cells, "laser_off_ns")?,
        deadline_missed: needed::<u8>(cells, "deadline_missed")? == 1,
        picture: needed(cells, "picture")?,
        t_picture_ns: cell(cells, "t_picture_ns")?,
        picture_focus_dpt: cell(cells, "picture_focus_dpt")?,
        picture_fov_x_deg: cell(cells, "picture_fov_x_deg")?,
        picture_fov_y_deg: cell(cells, "picture_fov_y_deg")?,
        levels_xxh3: cell(cells, "levels_xxh3")?.unwrap_or_default(),
        computed: needed::<u8>(cells, "computed")? == 1,
    })
}

/// What breaks the rules that hold for every record, empty for a good one.
///
/// A field has one window or none; the window begins after the field appeared and ends before the next one does; no two
/// windows overlap; the time points of a frame are in order; fields follow one another in the panel's order.
pub fn faults(rows: &[FieldRow], field_order: [&str; 3]) -> Vec<String> {
    let mut found = Vec::new();
    let mut last_off_ns = i64::MIN;
    for (index, row) in rows.iter().enumerate() {
        let name = format!("row {index} (frame {} {})", row.frame, row.colour);
        let times = [row.t_wake_ns, row.t_render_begin_ns, row.t_render_end_ns, row.t_submit_ns, row.t_present_ns];
        if !times.is_sorted() {
            found.push(format!("{name}: time points out of order: {times:?}"));
        }
        if row.colour != field_order[usize::from(row.field) % 3] {
            found.push(format!("{name}: field {} is not {} in the panel's order", row.field, row.colour));
        }
        if let Some(next) = rows.get(index + 1)
            && next.field != (row.field + 1) % 3
        {
            found.push(format!("{name}: field {} follows field {}", next.field, row.field));
        }
        let next_ns = rows.get(index + 1).map_or(i64::MAX, |next| next.t_present_ns);
        if next_ns <= row.t_present_ns {
            found.push(format!("{name}: the next field is not later"));
        }
        match (row.laser_on_ns, row.laser_off_ns) {
            (Some(on_ns), Some(off_ns)) => {
                if on_ns <= row.t_present_ns || off_ns <= on_ns || off_ns > next_ns {
                    found.push(format!(
                        "{name}: window {on_ns}..{off_ns} is not within {}..{next_ns}",
                        row.t_present_ns
                    ));
                }
                if on_ns < last_off_ns {
                    found.push(format!("{name}: lit before the last laser went out"));
                }
                last_off_ns = off_ns;
            }
            (None, None) => {}
            _ => found.push(format!("{name}: half a laser window")),
        }
    }
    found
}

/// Windows in which a laser was lit at some time from `from_ns` until `until_ns`, of the host's clock.
pub fn lit_windows(rows: &[FieldRow], from_ns: i64, until_ns: i64) -> usize {
    let windows = rows.iter().filter_map(|row| row.laser_on_ns.zip(row.laser_off_ns));
    windows.filter(|(on_ns, off_ns)| *on_ns < until_ns && *off_ns > from_ns).count()
}

/// Fields that were not lit, between the first and the last one that was: lasers arm at the beginning and are out
/// before the end.
pub fn unlit(rows: &[FieldRow]) -> usize {
    let is_lit = |row: &FieldRow| row.laser_on_ns.is_some();
    let (Some(first), Some(last)) = (rows.iter().position(is_lit), rows.iter().rposition(is_lit)) else {
        return rows.len();
    };
    rows[first..=last].iter().filter(|row| !is_lit(row)).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> Vec<FieldRow> {
        (0..6)
            .map(|index| {
                let t_ns = 1_000 + index * 100;
                FieldRow {
                    frame: index as u64 / 3,
                    field: (index % 3) as u8,
                    colour: ["red", "green", "blue"][index as usize % 3].into(),
                    t_sample_ns: Some(1),
                    pupil_raw_mm: Some(3.0),
                    pupil_mm: 3.0,
                    pupil_estimate_mm: Some(3.0),
                    pupil_state: "tracking".into(),
                    t_wake_ns: 10,
                    t_render_begin_ns: 20,
                    t_render_end_ns: 30,
                    t_submit_ns: 40,
                    t_present_ns: t_ns,
                    present_provenance: "software".into(),
                    laser_on_ns: Some(t_ns + 20),
                    laser_off_ns: Some(t_ns + 90),
                    deadline_missed: false,
                    picture: 0,
                    t_picture_ns: None,
                    picture_focus_dpt: None,
                    picture_fov_x_deg: None,
                    picture_fov_y_deg: None,
                    levels_xxh3: String::new(),
                    computed: true,
                }
            })
            .collect()
    }

    #[test]
    fn the_judge_objects_to_each_wrong_value() {
        const RGB: [&str; 3] = ["red", "green", "blue"];
        assert_eq!(faults(&good(), RGB), Vec::<String>::new());
        assert_eq!(unlit(&good()), 0);
        let mut rows = good();
        (rows[2].laser_on_ns, rows[2].laser_off_ns) = (None, None);
        assert_eq!(unlit(&rows), 1);
        let canaries: [fn(&mut FieldRow); 7] = [
            |row| row.colour = "blue".into(),
            |row| row.laser_on_ns = None,
            |row| row.laser_on_ns = Some(row.t_present_ns - 1),
            |row| row.laser_off_ns = Some(row.t_present_ns + 150),
            |row| row.t_present_ns += 100,
            |row| row.t_submit_ns = 2_000,
            |row| row.t_wake_ns = 25,
        ];
        // The second window is 1120 to 1190.
        assert_eq!(lit_windows(&good(), 1_090, 1_220), 1);
        assert_eq!([(1_090, 1_120), (1_190, 1_220)].map(|(from, until)| lit_windows(&good(), from, until)), [0, 0]);
        assert_eq!([(1_090, 1_121), (1_189, 1_220)].map(|(from, until)| lit_windows(&good(), from, until)), [1, 1]);
        let mut gap = good();
        gap.remove(2);
        assert!(!faults(&gap, RGB).is_empty(), "a field that is not there");
        for (number, canary) in canaries.iter().enumerate() {
            let mut rows = good();
            canary(&mut rows[1]);
            assert!(!faults(&rows, RGB).is_empty(), "canary {number}");
        }
    }
}
