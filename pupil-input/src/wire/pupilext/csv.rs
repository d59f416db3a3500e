//! Rows: no header, no quotes; the delimiter is PupilEXT's setting, `,` by default. Versions up to 0.1.2:
//!
//! ```text
//! [filename,]timestamp_ms,algorithm,diameter_px…,undistortedDiameter_px…,physicalDiameter_mm…,
//!   (width_px,height_px,axisRatio)…,(center_x,center_y)…,angle_deg…,circumference_px…,
//!   (confidence,outlineConfidence)…[,trial,message,temperature_c…]
//! ```
//!
//! where `…` is once for each view, A before B and Main before Sec (`physicalDiameter_mm` once for each eye).
//! `filename` is only in rows as 0.1.1 records them, without `trial` and what follows. Later versions have no
//! algorithm, and the figures stand view by view, right before left:
//!
//! ```text
//! timestamp_ms,(diameter_px,undistortedDiameter_px,physicalDiameter_mm,width_px,height_px,axisRatio,
//!   centerX_px,centerY_px,angle_deg,circumference_px,confidence,outlineConfidence)…,trial,message,temperature_c,temperature_c
//! ```
//!
//! Rows of the two kinds are told apart by the algorithm, which is no number.

use super::{NS_PER_MS, PupilExtEyes, PupilExtSettings, PupilExtSize, View, on_fault};
use crate::SampleEye;
use crate::wire::text::{Line, number, time};
use crate::wire::{WireEvent, WireFault};

/// Columns of the longest row that is known.
const MAX_COLUMNS: usize = 53;

/// Where a row has an eye's figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Columns {
    diameter: usize,
    undistorted: usize,
    physical: usize,
    /// And behind it the outline's confidence.
    confidence: usize,
}

/// The columns of eye `eye` (0 or 1) up to version 0.1.2, without a file name.
fn old_columns(settings: &PupilExtSettings, eye: usize) -> Columns {
    let [diameter, undistorted, physical, confidence] = match (settings.eyes, settings.stereo) {
        (PupilExtEyes::One(_), false) => [2, 3, 4, 12],
        (PupilExtEyes::Two, false) => [2 + eye, 4 + eye, 6 + eye, 22 + 2 * eye],
        (PupilExtEyes::One(_), true) => [2, 4, 6, 21],
        (PupilExtEyes::Two, true) => [2 + 2 * eye, 6 + 2 * eye, 10 + eye, 40 + 4 * eye],
    };
    Columns { diameter, undistorted, physical, confidence }
}

/// The columns of eye `eye` of later versions.
fn new_columns(settings: &PupilExtSettings, eye: usize) -> Columns {
    let first = 1 + VIEW_COLUMNS * if settings.stereo { 2 * eye } else { eye };
    Columns { diameter: first, undistorted: first + 1, physical: first + 2, confidence: first + 10 }
}

/// Columns of a view in later versions.
const VIEW_COLUMNS: usize = 12;

/// Columns up to and with the last confidence.
#[derive(Clone, Copy, Debug)]
struct Widths {
    old: usize,
    new: usize,
}

fn widths(settings: &PupilExtSettings) -> Widths {
    match (settings.eyes, settings.stereo) {
        (PupilExtEyes::One(_), false) => Widths { old: 14, new: 1 + VIEW_COLUMNS },
        (PupilExtEyes::Two, false) => Widths { old: 26, new: 1 + 2 * VIEW_COLUMNS },
        (PupilExtEyes::One(_), true) => Widths { old: 25, new: 1 + 2 * VIEW_COLUMNS },
        (PupilExtEyes::Two, true) => Widths { old: 48, new: 1 + 4 * VIEW_COLUMNS },
    }
}

pub(super) fn take_row(settings: &PupilExtSettings, delimiter: u8, row: Line<'_>, on_event: &mut dyn FnMut(WireEvent)) {
    if row.bytes.starts_with(b"timestamp_ms") || row.bytes.starts_with(b"filename") {
        return on_event(WireEvent::Note);
    }
    if row.overlong {
        return on_event(row.rejected(WireFault::TooLong));
    }
    let mut columns = [&[][..]; MAX_COLUMNS];
    let mut count = 0;
    for column in row.bytes.split(|&byte| byte == delimiter) {
        if let Some(place) = columns.get_mut(count) {
            *place = column;
        }
        count += 1;
    }
    let columns = &columns[..count.min(MAX_COLUMNS)];
    let is_new = columns.get(1).is_some_and(|second| number(second) != Err(WireFault::BadNumber));
    let Widths { old, new } = widths(settings);
    // A row as 0.1.1 records it is the shortest, and its columns are one later.
    let is_recorded = count == old + 1 && number(columns[2]) == Err(WireFault::BadNumber);
    let (all, first_figure, width) = match (is_recorded, is_new) {
        (true, _) => (&columns[1..], 2, old),
        (false, true) => (columns, 1, new),
        (false, false) => (columns, 2, old),
    };
    let Some(columns) = all.get(..width) else {
        return on_event(row.rejected(WireFault::TooShort));
    };
    let are_figures =
        |columns: &[&[u8]]| columns[first_figure..].iter().all(|figure| number(figure) != Err(WireFault::BadNumber));
    // A half row with another behind it has the other's algorithm among its figures.
    if !are_figures(columns) {
        return on_event(row.rejected(WireFault::BadNumber));
    }
    // Which view would be whose is not known then. A message of the user's may have delimiters, and is no figure.
    let twice = widths(&PupilExtSettings { eyes: PupilExtEyes::Two, ..*settings });
    let twice = if first_figure == 1 { twice.new } else { twice.old };
    if settings.eyes != PupilExtEyes::Two && all.get(..twice).is_some_and(are_figures) {
        return on_event(row.rejected(WireFault::MoreViews));
    }
    let eyes: &[SampleEye] = match settings.eyes {
        PupilExtEyes::One(ref eye) => std::slice::from_ref(eye),
        PupilExtEyes::Two => &[SampleEye::Right, SampleEye::Left],
    };
    for (index, &eye) in eyes.iter().enumerate() {
        let places = if first_figure == 1 { new_columns(settings, index) } else { old_columns(settings, index) };
        match view_of(settings, columns, places).and_then(|view| view.sample(eye)) {
            Ok((sample, fault)) => {
                on_fault(fault, on_event);
                on_event(WireEvent::Sample(sample));
            }
            Err(fault) => on_event(row.rejected(fault)),
        }
    }
}

fn view_of(settings: &PupilExtSettings, columns: &[&[u8]], places: Columns) -> Result<View, WireFault> {
    let diameter = match settings.size {
        PupilExtSize::Millimetres => places.physical,
        PupilExtSize::Pixels => places.diameter,
        PupilExtSize::UndistortedPixels => places.undistorted,
    };
    Ok(View {
        t_device: Some(time(columns[0], NS_PER_MS)?),
        diameter: Some(number(columns[diameter])?),
        diameter_px: match settings.size {
            PupilExtSize::Millimetres => Some(number(columns[places.diameter])?),
            PupilExtSize::Pixels | PupilExtSize::UndistortedPixels => None,
        },
        confidence: Some(number(columns[places.confidence])?),
        outline_confidence: Some(number(columns[places.confidence + 1])?),
        fault: None,
        known: true,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const MODES: [(PupilExtEyes, bool); 4] = [
        (PupilExtEyes::One(SampleEye::Left), false),
        (PupilExtEyes::Two, false),
        (PupilExtEyes::One(SampleEye::Left), true),
        (PupilExtEyes::Two, true),
    ];

    /// Names of the columns up to version 0.1.2, built as the format is described.
    fn old_header(views: &[&str], eyes: &[&str]) -> Vec<String> {
        let mut header = vec!["timestamp_ms".to_owned(), "algorithm".to_owned()];
        header.extend(views.iter().map(|view| format!("diameter{view}_px")));
        header.extend(views.iter().map(|view| format!("undistortedDiameter{view}_px")));
        header.extend(eyes.iter().map(|eye| format!("physicalDiameter{eye}_mm")));
        for view in views {
            header.extend([format!("width{view}_px"), format!("height{view}_px"), format!("axisRatio{view}")]);
        }
        header.extend(views.iter().flat_map(|view| [format!("center{view}_x"), format!("center{view}_y")]));
        header.extend(views.iter().map(|view| format!("angle{view}_deg")));
        header.extend(views.iter().map(|view| format!("circumference{view}_px")));
        header.extend(views.iter().flat_map(|view| [format!("confidence{view}"), format!("outlineConfidence{view}")]));
        header
    }

    #[test]
    fn columns_stand_where_the_headers_have_them() {
        let views: [&[&str]; 4] = [&[""], &["A", "B"], &["Main", "Sec"], &["AMain", "ASec", "BMain", "BSec"]];
        let eyes: [&[&str]; 4] = [&[""], &["A", "B"], &[""], &["A", "B"]];
        for (((mode, stereo), views), eyes) in MODES.into_iter().zip(views).zip(eyes) {
            let settings = PupilExtSettings { eyes: mode, stereo, ..PupilExtSettings::default() };
            let header = old_header(views, eyes);
            assert_eq!(widths(&settings).old, header.len());
            let place = |name: String| header.iter().position(|column| *column == name).expect(&name);
            for (index, eye) in eyes.iter().enumerate() {
                let view = if stereo { format!("{eye}Main") } else { (*eye).to_owned() };
                let expected = Columns {
                    diameter: place(format!("diameter{view}_px")),
                    undistorted: place(format!("undistortedDiameter{view}_px")),
                    physical: place(format!("physicalDiameter{eye}_mm")),
                    confidence: place(format!("confidence{view}")),
                };
                assert_eq!(old_columns(&settings, index), expected, "{mode:?} {stereo}");
                assert_eq!(place(format!("outlineConfidence{view}")), expected.confidence + 1);
                assert!(new_columns(&settings, index).confidence + 1 < widths(&settings).new);
            }
        }
    }
}
