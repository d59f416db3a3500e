//! What an eye sees.

use holod_calibration::rig as calibration;
use holod_calibration::{PupilDiameter, Resolution};
use holod_daemon::cli::{focus_of_an_eye, human_pupil};
use holod_daemon::failure::Failure;
use holod_model::LinearImage;
use holod_model::optics::{Eye, PhasePattern, SimulatedEye};
use pyo3::prelude::*;

use crate::arrays::{Given, array, interleaved};
use crate::outcome::{InputError, with_threads};
use crate::rig::{Rig, phases_of};

/// What an eye sees of phases on the rig's panel, which pass its 4f stop, the eye's pupil and its focus.
///
/// `phase_rad` is float32 (3, rows, columns) in radians: red, green, blue; of holod, another program, or what
/// `Rig.phase_of` says that the panel shows. `focus_dpt` is where the eye is focused: 0 is infinity, 2 is 50 cm.
/// `amplitude_constant` is the amplitude that full modulation stands for, `Hologram.amplitude_constant` of holod's own
/// phases; light is multiplied by its square. Darkness is around the pattern. Colours that the rig's panel never shows,
/// or its lasers never light, are black.
///
/// Returns float32 (rows, columns, 3), linear light, 1 is white. Raises InputError.
#[pyfunction]
#[pyo3(signature = (phase_rad, *, pupil_mm, focus_dpt, rig=None, amplitude_constant=1.0))]
pub(crate) fn view<'py>(
    py: Python<'py>,
    phase_rad: &Bound<'py, PyAny>,
    pupil_mm: f32,
    focus_dpt: f64,
    rig: Option<&Bound<'py, Rig>>,
    amplitude_constant: f32,
) -> PyResult<Bound<'py, PyAny>> {
    let (phase_rad, resolution) = phases_of("phase_rad", phase_rad)?;
    if resolution.pixels() == 0 {
        return Err(InputError::new_err(format!(
            "phase_rad: found a pattern of {resolution}, expected a pixel or more"
        )));
    }
    if !(amplitude_constant > 0.0 && amplitude_constant.is_finite()) {
        return Err(InputError::new_err(format!(
            "amplitude_constant: found {amplitude_constant}, expected a number above 0"
        )));
    }
    let (rig, eye) = (Rig::given(rig), eye(pupil_mm, focus_dpt)?);
    see(py, &rig, eye, amplitude_constant, || Ok(PhasePattern { resolution, phase_rad }))
}

/// A picture of linear light as a monitor shows it: uint8 sRGB, for PNG files and the like.
///
/// `rgb` is float32 (rows, columns, 3), such as `view` returns. Beyond 0 to 1 it is clipped; NaN becomes black.
#[pyfunction]
pub(crate) fn to_srgb8<'py>(py: Python<'py>, rgb: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let given = Given::new("rgb", rgb)?;
    let &[height, width, 3] = given.shape() else {
        return Err(given.refusal(format!("an array of shape {:?}", given.shape()), "(rows, columns, 3)"));
    };
    let values = given.values::<f32>()?;
    let values = values.as_slice()?;
    let pixels = [0, 1, 2].into_iter().flat_map(|colour| values.iter().copied().skip(colour).step_by(3)).collect();
    let picture = LinearImage { resolution: Resolution { width, height }, pixels };
    array(py, picture.to_srgb8(), [height, width, 3])
}

/// An eye of figures that can be one's.
pub(crate) fn eye(pupil_mm: f32, focus_dpt: f64) -> PyResult<Eye> {
    let pupil = pupil(pupil_mm)?;
    let focus = focus_of_an_eye(focus_dpt).map_err(|why| InputError::new_err(format!("focus_dpt: {why}")))?;
    Ok(Eye { pupil, focus })
}

pub(crate) fn pupil(pupil_mm: f32) -> PyResult<PupilDiameter> {
    human_pupil(pupil_mm).map_err(|why| InputError::new_err(format!("pupil_mm: {why}")))
}

/// What `eye` sees of a pattern on the bench of `rig`, as an array.
pub(crate) fn see<'py>(
    py: Python<'py>,
    rig: &calibration::Rig,
    eye: Eye,
    amplitude_constant: f32,
    pattern: impl FnOnce() -> Result<PhasePattern, Failure> + Send,
) -> PyResult<Bound<'py, PyAny>> {
    let (pixels, size) = with_threads(py, || {
        let pattern = pattern()?;
        let mut simulated = SimulatedEye::new(&rig.geometry, pattern.resolution);
        let seen = simulated.view_weighted(&pattern, amplitude_constant, eye, rig.light());
        Ok((interleaved(&seen.pixels), pattern.resolution))
    })?;
    array(py, pixels, [size.height, size.width, 3])
}
