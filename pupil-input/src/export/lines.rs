//! A recording as holod's line protocol.

use std::path::Path;

use super::{ExportError, atomically};
use crate::wire::line::{LineSample, encode_line};
use crate::{Recording, SizeUnit};

/// Writes `recording` as [lines of the protocol](crate::wire::line), numbered from 0, their diameters times
/// `scale_mm_per_unit` (1 for a recording in millimetres where there is none).
///
/// # Errors
/// The recording is not in millimetres and there is no scale, the scale is no positive number, or the file cannot be
/// written.
pub fn write_lines(recording: &Recording, scale_mm_per_unit: Option<f64>, path: &Path) -> Result<(), ExportError> {
    let scale = match scale_mm_per_unit {
        Some(scale) if scale.is_finite() && scale > 0.0 => scale,
        Some(scale) => return Err(ExportError::BadScale { path: path.into(), scale }),
        None if recording.unit() == SizeUnit::Millimetres => 1.0,
        None => return Err(ExportError::NoScale { path: path.into(), unit: recording.unit().name() }),
    };
    atomically(path, |out| {
        out.write_all(b"# holod recording, times in microseconds\n")?;
        let mut line = String::new();
        for (sequence, sample) in (0..).zip(recording.samples()) {
            let diameter_mm = (f64::from(sample.diameter_mm) * scale) as f32;
            let is_figure = diameter_mm.is_finite() && diameter_mm >= 0.0;
            let believed = sample.valid && is_figure && sample.confidence > 0.0;
            line.clear();
            let fields = LineSample {
                sequence,
                device_us: sample.t_sample.0.saturating_add(500).div_euclid(1000),
                eye: sample.eye,
                diameter_mm: if is_figure { diameter_mm } else { 0.0 },
                confidence: if believed { sample.confidence.min(1.0) } else { 0.0 },
            };
            encode_line(&fields, &mut line);
            out.write_all(line.as_bytes())?;
        }
        Ok(())
    })
}
