//! Pupil logs as arrays.

use std::path::PathBuf;

use holod_calibration::rig::Tracker;
use holod_daemon::failure::{Exit, Failure};
use holod_pupil_input::{LogInfo, Recording};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::evaluation::from_json;
use crate::outcome::{InputError, without_lock};

/// A log's samples, a column each.
#[derive(Default)]
struct Columns {
    t_ns: Vec<i64>,
    eye: Vec<u8>,
    diameter: Vec<f32>,
    confidence: Vec<f32>,
    aperture_mm: Vec<f32>,
    valid: Vec<bool>,
}

/// `holod.read_log` without its class: columns and what is known of the log, by name.
#[pyfunction]
pub(crate) fn read_samples<'py>(
    py: Python<'py>,
    path: PathBuf,
    scale_mm_per_unit: Option<f64>,
) -> PyResult<Bound<'py, PyDict>> {
    if let Some(scale) = scale_mm_per_unit
        && let Some(fault) = Tracker::scale_fault(scale)
    {
        return Err(InputError::new_err(format!("scale_mm_per_unit: found {scale}, {fault}")));
    }
    let (columns, info, blinks, unit, scale) = without_lock(py, || {
        let recording = Recording::read(&path).map_err(Failure::because(Exit::Data))?;
        let mut columns = Columns::default();
        for sample in recording.samples() {
            columns.t_ns.push(sample.t_sample.0);
            columns.eye.push(sample.eye.index() as u8);
            columns.diameter.push(sample.diameter_mm);
            columns.confidence.push(sample.confidence);
            columns.aperture_mm.push(sample.aperture_mm.unwrap_or(f32::NAN));
            columns.valid.push(sample.valid);
        }
        let scale = scale_mm_per_unit.or(recording.recorded_scale());
        let info = serde_json::to_string(&LogInfo::of(&recording, scale)).map_err(Failure::because(Exit::Software))?;
        let blinks: Vec<(String, i64, i64)> =
            recording.blinks().iter().map(|blink| (blink.eye.to_string(), blink.begins.0, blink.ends.0)).collect();
        Ok((columns, info, blinks, recording.unit().name(), scale))
    })?;
    let read = PyDict::new(py);
    read.set_item("unit", unit)?;
    read.set_item("scale_mm_per_unit", scale)?;
    read.set_item("t_ns", PyArray1::from_vec(py, columns.t_ns))?;
    read.set_item("eye", PyArray1::from_vec(py, columns.eye))?;
    read.set_item("diameter", PyArray1::from_vec(py, columns.diameter))?;
    read.set_item("confidence", PyArray1::from_vec(py, columns.confidence))?;
    read.set_item("aperture_mm", PyArray1::from_vec(py, columns.aperture_mm))?;
    read.set_item("valid", PyArray1::from_vec(py, columns.valid))?;
    read.set_item("blinks", blinks)?;
    read.set_item("info", from_json(py, &info)?)?;
    Ok(read)
}
