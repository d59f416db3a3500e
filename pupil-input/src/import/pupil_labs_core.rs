//! Pupil Labs Core: `pupil_positions.csv` of its player.
//!
//! Both eyes and two kinds of rows interleave: 2-D detection with a diameter in camera pixels, and the 3-D model with
//! `diameter_3d` in millimetres besides. Where there are 3-D rows the 2-D ones tell nothing more and are left out. Eye
//! 0 is the right one.

use super::fault::{LogFault, ReplayError};
use super::format::LogFormat;
use super::importer::Importer;
use super::input::LogInput;
use super::recording::{LogBuilder, LogSample};
use super::table::separator;
use super::text::{Header, Picker, number, size, time};
use crate::SampleEye;
use crate::size_unit::SizeUnit;

pub(super) const IMPORTER: Importer = Importer { format: LogFormat::Core, recognises, read };

/// Newest names first.
const TIME: [&str; 2] = ["pupil_timestamp", "timestamp"];
const EYE: [&str; 2] = ["eye_id", "id"];

fn recognises(input: &LogInput<'_>) -> bool {
    let Some(line) = input.head_lines().next() else { return false };
    let header = Header::of(line, separator(line));
    header.first_of(&TIME).is_some()
        && header.first_of(&EYE).is_some()
        && ["confidence", "norm_pos_x", "diameter"].iter().all(|name| header.has(name))
}

/// What made a row, in the order of trust.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Method {
    /// Camera pixels.
    TwoD,
    /// Millimetres, by the model as it was while recording.
    LiveModel,
    /// Millimetres, by a model that was fitted to the whole recording afterwards.
    PostHocModel,
}

fn method(name: Option<&[u8]>, diameter_mm: Option<&[u8]>) -> Method {
    let name = name.unwrap_or_default();
    let has = |part: &[u8]| memchr::memmem::find(name, part).is_some();
    // The oldest files do not name the method.
    let modelled = has(b"3d") || name.is_empty() && diameter_mm.is_some_and(|cell| !cell.is_empty());
    match (modelled, has(b"post-hoc")) {
        (false, _) => Method::TwoD,
        (true, false) => Method::LiveModel,
        (true, true) => Method::PostHocModel,
    }
}

fn read(input: &LogInput<'_>, log: &mut LogBuilder) -> Result<(), ReplayError> {
    let mut lines = input.lines()?;
    let Some(header) = lines.header(log) else { return Ok(()) };
    let columns = [
        header.first_of(&TIME),
        header.first_of(&EYE),
        header.column("confidence"),
        header.column("diameter"),
        header.column("method"),
        header.column("diameter_3d"),
    ];
    let picker = Picker::new(header.separator, columns);

    // Of each method; only the best is kept.
    let mut kept: [LogBuilder; 3] = Default::default();
    let mut counts = [0_u64; 3];
    let mut best = Method::TwoD;
    while let Some(line) = lines.next(log) {
        if line.bytes.is_empty() {
            continue;
        }
        let [t, eye, confidence, diameter_px, name, diameter_mm] = picker.pick(line.bytes);
        let (Some(t), Some(eye), Some(confidence), Some(diameter_px)) = (t, eye, confidence, diameter_px) else {
            log.count(LogFault::Malformed);
            continue;
        };
        // Whatever it is, a row that ends before its columns do is none.
        let cut_off = |column: usize, cell: Option<&[u8]>| columns[column].is_some() && cell.is_none();
        if cut_off(4, name) || cut_off(5, diameter_mm) {
            log.count(LogFault::Malformed);
            continue;
        }
        let method = method(name, diameter_mm);
        counts[method as usize] += 1;
        if (method as usize) < best as usize {
            continue;
        }
        best = method;
        let cell = if method == Method::TwoD { Some(diameter_px) } else { diameter_mm };
        match sample(t, eye, confidence, cell) {
            Err(fault) => log.count(fault),
            Ok(sample) => kept[method as usize].push(sample, line.number),
        }
    }

    let [two_d, live, post_hoc] = counts;
    log.take_samples_of(std::mem::take(&mut kept[best as usize]));
    match best {
        Method::TwoD => {
            log.unit = SizeUnit::Pixels;
            log.note(
                "there are only rows of 2-D detection: diameters are in pixels of the eye cameras; to have millimetres, \
                 run the 3-D detector after the fact in Pupil Player, or give the rig a scale",
            );
        }
        Method::LiveModel if two_d > 0 => log.note(format!(
            "diameters are those of the 3-D model, {live} rows; {two_d} rows of 2-D detection are left out"
        )),
        Method::PostHocModel if two_d + live > 0 => log.note(format!(
            "diameters are those of the 3-D model that was fitted after the fact, {post_hoc} rows; {live} rows of the \
             live model and {two_d} of 2-D detection are left out"
        )),
        Method::LiveModel | Method::PostHocModel => {}
    }
    Ok(())
}

/// A model that was not fitted says 0, a negative diameter, NaN or nothing, and confidence 0 says that there is no pupil:
/// such samples are lost. A model fitted badly says 16 mm; that is handed on for the gate to judge.
fn sample(t: &[u8], eye: &[u8], confidence: &[u8], diameter: Option<&[u8]>) -> Result<LogSample, LogFault> {
    let t = time(t, 0).ok_or(LogFault::BadNumber)?;
    let eye = match eye {
        b"0" => SampleEye::Right,
        b"1" => SampleEye::Left,
        _ => return Err(LogFault::BadEye),
    };
    let confidence = number(confidence).filter(|confidence| confidence.is_finite()).ok_or(LogFault::BadNumber)?;
    let diameter = size(diameter.ok_or(LogFault::Malformed)?)?;
    let valid = diameter > 0.0 && confidence > 0.0;
    let confidence = confidence.clamp(0.0, 1.0) as f32;
    Ok(LogSample { t, eye, diameter: diameter as f32, confidence, aperture_mm: None, valid })
}
