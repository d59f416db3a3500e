//! How good weights are.

use std::path::PathBuf;

use holod_calibration::PupilDiameter;
use holod_daemon::evaluation::{EvaluationPlan, EvaluationSettings};
use holod_daemon::failure::{Exit, Failure};
use pyo3::prelude::*;

use crate::outcome::{Count, HolodError, InputError, optional_count, with_threads};
use crate::renderer::backend_named;
use crate::rig::Rig;

/// Judges weights by what an eye sees of the panel's levels on held-out scenes, as `holod evaluate` does.
///
/// `scenes` is a folder that `holod-scenes generate --kind test` wrote, `cards` one of `--kind cards`, `marks` one of
/// `--kind marks`. `rig` and `weights` are as those of `Renderer`. `pupils_mm` are among the scenes' own, all of these
/// where it is left out; `limit` is the number of scenes to judge, `border_px` the pixels at each edge that are not
/// judged.
///
/// Returns the dict that `holod evaluate --json` prints: "rows" (PSNR, slope, correlation, SSIM for each pupil, each
/// with its "mean" and "ci95_half_width"), "matrix", "refocus", "marks"; "colours" are those that were judged, which the
/// rig's panel shows and its lasers light. Takes minutes; other threads of Python run meanwhile, and Ctrl-C ends it
/// after a scene.
///
/// Raises InputError, RigError, UnavailableError; warns (HolodWarning) of what the weights were not trained for.
#[pyfunction]
#[pyo3(signature = (
    scenes, weights=None, *, rig=None, cards=None, marks=None, pupils_mm=None, limit=None, border_px=24, backend="auto"
))]
#[allow(clippy::too_many_arguments, reason = "keywords in Python")]
pub(crate) fn evaluate<'py>(
    py: Python<'py>,
    scenes: PathBuf,
    weights: Option<PathBuf>,
    rig: Option<&Bound<'py, Rig>>,
    cards: Option<PathBuf>,
    marks: Option<PathBuf>,
    pupils_mm: Option<Vec<f32>>,
    limit: Option<Count>,
    #[pyo3(from_py_with = border_px)] border_px: usize,
    backend: &str,
) -> PyResult<Bound<'py, PyAny>> {
    let rig = Rig::with_weights(rig, weights.as_deref())?;
    let backend = backend_named(backend)?;
    if pupils_mm.as_ref().is_some_and(Vec::is_empty) {
        return Err(InputError::new_err(
            "pupils_mm: found none, expected some of the scenes' own; leave it out for all",
        ));
    }
    let limit = optional_count(limit, "limit")?;
    if limit == Some(0) {
        return Err(InputError::new_err("limit: found 0, expected at least 1"));
    }
    let pupils: Vec<_> = pupils_mm.unwrap_or_default().into_iter().map(scene_pupil).collect::<PyResult<_>>()?;
    let settings = EvaluationSettings {
        rig: &rig,
        backend,
        scenes: &scenes,
        cards: cards.as_deref(),
        marks: marks.as_deref(),
        pupils: &pupils,
        limit,
        border_px,
    };
    let mut interrupt = None;
    let judged = with_threads(py, || {
        let evaluated = EvaluationPlan::new(settings)?.judge(0, || {
            Python::attach(|py| py.check_signals()).map_err(|error| {
                interrupt = Some(error);
                Failure::new(Exit::Software, "interrupted")
            })
        })?;
        serde_json::to_string(&evaluated.evaluation).map_err(Failure::because(Exit::Software))
    });
    match interrupt {
        Some(interrupt) => Err(interrupt),
        None => from_json(py, &judged?),
    }
}

/// A pupil of scenes, which may be wider than a human one for benches of little blur.
fn scene_pupil(mm: f32) -> PyResult<PupilDiameter> {
    if mm > 0.0 && mm.is_finite() {
        Ok(PupilDiameter::from_mm(mm))
    } else {
        Err(InputError::new_err(format!("pupils_mm: found {mm} mm, expected diameters above 0 mm")))
    }
}

/// The Python value of a JSON text.
pub(crate) fn from_json<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("json")?.call_method1("loads", (text,)).map_err(|error| HolodError::new_err(error.to_string()))
}

fn border_px(given: &Bound<'_, PyAny>) -> PyResult<usize> {
    given.extract::<Count>()?.of("border_px")
}
