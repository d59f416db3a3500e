//! Scenes from files and the built-in one, as arrays.

use holod_calibration::Resolution;
use holod_daemon::failure::{Exit, Failure};
use holod_daemon::source::scene::{SAMPLE_RESOLUTION, warn_of_oddities};
use holod_model::scene::{DepthEncoding, Fit, FrameReport, MOST_PIXELS, Scene};
use numpy::PyArrayMethods;
use pyo3::prelude::*;

use crate::arrays::{array, interleaved};
use crate::outcome::{Count, InputError, optional_count, without_lock};
use crate::rig::Rig;

/// rgb, depth, frames, frames a second, pixels without a depth, pixels that were clipped.
type Read<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>, usize, Option<f64>, usize, usize);

/// `holod.load_scene` without its class: linear float32 (rows, columns, 3), float32 (rows, columns) of dioptres, and
/// counts.
#[pyfunction]
#[allow(clippy::too_many_arguments, reason = "keywords in Python")]
pub(crate) fn read_scene<'py>(
    py: Python<'py>,
    path: &str,
    rig: Option<&Bound<'py, Rig>>,
    depth_encoding: Option<&str>,
    frame: Count,
    width_px: Option<Count>,
    height_px: Option<Count>,
    fit: &str,
) -> PyResult<Read<'py>> {
    let geometry = Rig::given(rig).geometry;
    let fit: Fit = serde_json::from_value(fit.into()).map_err(|why| InputError::new_err(format!("fit: {why}")))?;
    let frame = frame.of("frame")?;
    let size = match (optional_count(width_px, "width_px")?, optional_count(height_px, "height_px")?) {
        (None, None) => None,
        (Some(width), Some(height)) => Some(checked(Resolution { width, height })?),
        _ => {
            return Err(InputError::new_err(
                "width_px and height_px: found one of them, expected both, or none for the picture's own size",
            ));
        }
    };
    let (scene, picture) = without_lock(py, || {
        let data = Failure::because(Exit::Data);
        let encoding = depth_encoding.map(|text| DepthEncoding::parse(text, &geometry)).transpose().map_err(&data)?;
        let scene = Scene::open(path, encoding).map_err(&data)?;
        let mut picture = scene.picture(frame, &geometry, size, fit).map_err(&data)?;
        // Depths are as they are, in and out of the display's range: `render` clamps them, and warns of it.
        let report = FrameReport { depth_clamped_far_px: 0, depth_clamped_near_px: 0, ..picture.report };
        warn_of_oddities(path, &report, &geometry, true);
        picture.linear = interleaved(&picture.linear);
        Ok((scene, picture))
    })?;
    let Resolution { width, height } = picture.resolution;
    Ok((
        array(py, picture.linear, [height, width, 3])?,
        numpy::PyArray1::from_vec(py, picture.depth_dpt).reshape([height, width])?.into_any(),
        scene.frames(),
        scene.fps(),
        picture.report.depth_missing_px,
        picture.report.colour_clipped.in_all(),
    ))
}

/// `holod.builtin_scene` without its class: linear float32 (rows, columns, 3), float32 (rows, columns) of normalised
/// dioptres.
#[pyfunction]
pub(crate) fn render_builtin_scene(
    py: Python<'_>,
    width_px: Option<Count>,
    height_px: Option<Count>,
) -> PyResult<(Bound<'_, PyAny>, Bound<'_, PyAny>)> {
    let width = optional_count(width_px, "width_px")?.unwrap_or(SAMPLE_RESOLUTION.width);
    let height = optional_count(height_px, "height_px")?.unwrap_or(SAMPLE_RESOLUTION.height);
    let size = checked(Resolution { width, height })?;
    let (pixels, depth) = without_lock(py, || {
        let picture = holod_scenes::sample_scene(size).picture();
        Ok((interleaved(&picture.image), picture.depth))
    })?;
    Ok((
        array(py, pixels, [height, width, 3])?,
        numpy::PyArray1::from_vec(py, depth).reshape([height, width])?.into_any(),
    ))
}

/// A size that a picture may have, of files as well.
fn checked(size: Resolution) -> PyResult<Resolution> {
    if size.width == 0 || size.height == 0 || size.width.saturating_mul(size.height) > MOST_PIXELS {
        return Err(InputError::new_err(format!(
            "width_px and height_px: found {size}, expected at least one pixel and at most {MOST_PIXELS}"
        )));
    }
    Ok(size)
}
