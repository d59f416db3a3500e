//! A recording as holod's own CSV.

use std::path::Path;

use super::{ExportError, atomically};
use crate::Recording;
use crate::import::csv::header;

/// Writes `recording` as CSV with the columns `t_ns`, `eye` (left, right, both), `diameter_mm` (or `diameter_px`,
/// `diameter_arbitrary`), `confidence`, `aperture_mm` (empty where there is none) and `valid` (1, 0). Figures are
/// written with as many digits as it takes to read the same ones.
///
/// # Errors
/// The file cannot be written.
pub fn write_csv(recording: &Recording, path: &Path) -> Result<(), ExportError> {
    atomically(path, |out| {
        writeln!(out, "{}", header(recording.unit()))?;
        for sample in recording.samples() {
            write!(out, "{},{},", sample.t_sample.0, sample.eye)?;
            if sample.diameter_mm.is_finite() {
                write!(out, "{}", sample.diameter_mm)?;
            }
            write!(out, ",{},", sample.confidence)?;
            if let Some(aperture_mm) = sample.aperture_mm.filter(|aperture_mm| aperture_mm.is_finite()) {
                write!(out, "{aperture_mm}")?;
            }
            writeln!(out, ",{}", u8::from(sample.valid))?;
        }
        Ok(())
    })
}
