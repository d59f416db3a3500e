//! From picture, depth and pupil to levels.

use std::sync::{Arc, Mutex};
use std::time::Instant;

use holod_calibration::rig as calibration;
use holod_calibration::{Colour, Resolution};
use holod_daemon::cli::Backend;
use holod_daemon::failure::{Exit, Failure};
use holod_daemon::pictures::shown_pattern;
use holod_daemon::renderer::{self, Rendered, Use};
use holod_daemon::setup;
use holod_daemon::source::scene::warn_of_oddities;
use holod_model::scene::{ArrayColours, ArrayDepths, ArrayError, ArrayPicture, FrameReport};
use holod_model::{RgbdFrame, Weights};
use holod_slm_output::{LevelsFrame, PanelEncoder};
use numpy::Complex32;
use pyo3::prelude::*;

use crate::arrays::{Given, Out, array};
use crate::outcome::{Count, HolodError, InputError, with_threads, without_lock};
use crate::rig::{Rig, levels_of, levels_shape, pattern_resolution};
use crate::view::{eye, pupil, see};

/// Makes holograms of pictures with depth, as the daemon does: the same levels.
///
/// `rig` is the bench, the built-in one without. `weights` are "standard", "small", "fast" or a file that the trainer
/// exported; without, those that the rig names. `width_px` and `height_px` are the size of the pictures, which are
/// centred on the panel; without, the panel's. `backend` is "auto" (a GPU where there is one that will do, in half
/// precision if it multiplies matrices so, else the processor, in half precision where that is faster), "cpu" or "gpu"
/// (in single precision), "cpu-half" or "gpu-half".
///
/// Making one takes seconds and much memory: keep it and render with it again and again. Several threads may use one;
/// they take turns.
///
/// Raises InputError, RigError, and UnavailableError where the backend is not to be had. Warns (HolodWarning) of what
/// the weights were not trained for.
#[pyclass(frozen, module = "holod")]
pub(crate) struct Renderer {
    rig: Arc<calibration::Rig>,
    resolution: Resolution,
    encoder: Arc<PanelEncoder>,
    amplitude_constant: f32,
    /// The narrowest and the widest, millimetres.
    trained_pupils_mm: [f32; 2],
    state: Mutex<State>,
}

struct State {
    renderer: Box<dyn renderer::Renderer>,
    /// Cannot be seen through the mutex while a frame is computed, so it is kept beside.
    description: String,
}

/// What a frame left in the renderer.
struct Made {
    levels: LevelsFrame,
    rendered: Rendered,
    phase_rad: Vec<f32>,
    field: Option<Vec<Complex32>>,
    engine: String,
    frame_ms: f64,
}

#[pymethods]
impl Renderer {
    #[new]
    #[pyo3(signature = (rig=None, weights=None, *, width_px=None, height_px=None, backend="auto"))]
    fn new(
        py: Python<'_>,
        rig: Option<&Bound<'_, Rig>>,
        weights: Option<std::path::PathBuf>,
        width_px: Option<Count>,
        height_px: Option<Count>,
        backend: &str,
    ) -> PyResult<Self> {
        let backend = backend_named(backend)?;
        let rig = Rig::with_weights(rig, weights.as_deref())?;
        let resolution = pattern_resolution(&rig, width_px, height_px)?;
        with_threads(py, || {
            let weights: Weights = setup::weights(&rig)?;
            let encoder = renderer::panel_encoder(&rig, resolution)?;
            let renderer = renderer::open(backend, &weights, &rig, &encoder, &Use::Command)?;
            Ok(Self {
                resolution,
                amplitude_constant: weights.config().amplitude_constant,
                trained_pupils_mm: weights.trained_pupils(&rig.geometry).map(|pupil| pupil.mm()),
                state: Mutex::new(State { description: renderer.description().to_owned(), renderer }),
                encoder,
                rig: Arc::new(rig),
            })
        })
    }

    /// Computes the hologram of a picture for an eye whose pupil is `pupil_mm` millimetres wide.
    ///
    /// `rgb` is (height_px, width_px, 3), red first, the top row first: uint8 is sRGB; float32 from 0 to 1 needs
    /// `colour`, "srgb" or "linear" (light).
    ///
    /// `depth` is (height_px, width_px) of float32, or of uint16 with "millimetres". `depth_unit` must be said:
    /// "metres" or "millimetres" (along the axis of view, as cameras and renderers give it; infinity is one),
    /// "dioptres" (1/metres), or "normalised_dioptres" (0 the far end of the rig's depth range, 1 the near end, uniform
    /// in dioptres). NaN, lengths that are not above 0, negative or infinite dioptres, and infinite normalised depths are
    /// no depths: they are an error, or with `fill_missing` are filled from their surroundings as the daemon does. Depths
    /// outside the rig's range are clamped to it and counted.
    ///
    /// Of a pupil outside `trained_pupils_mm` the network is told the nearest, as in a run; blur and stop are its own.
    ///
    /// Arrays that are C-contiguous are read where they lie, others are copied; none is changed. `out_levels` and
    /// `out_phase_rad` are arrays to write to in place of new ones; they are in the hologram that is returned, and the
    /// next call overwrites them. With `field`, the hologram has the complex field too.
    ///
    /// Other threads of Python run meanwhile. Raises InputError; warns (HolodWarning) of depth that looks like a wrong
    /// unit.
    #[pyo3(signature = (
        rgb, depth, pupil_mm, *, depth_unit, colour=None, fill_missing=false, field=false, out_levels=None,
        out_phase_rad=None
    ))]
    #[allow(clippy::too_many_arguments, reason = "keywords in Python")]
    fn render<'py>(
        &self,
        py: Python<'py>,
        rgb: &Bound<'py, PyAny>,
        depth: &Bound<'py, PyAny>,
        pupil_mm: f32,
        depth_unit: &str,
        colour: Option<&str>,
        fill_missing: bool,
        field: bool,
        out_levels: Option<&Bound<'py, PyAny>>,
        out_phase_rad: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Hologram> {
        let pupil = pupil(pupil_mm)?;
        let panel = self.encoder.panel_resolution();
        let Resolution { width, height } = self.resolution;
        let bit_depth = self.rig.panel.bit_depth;
        let levels_to = match bit_depth {
            8 => Out::new::<u8>("out_levels", out_levels, levels_shape(panel))?,
            _ => Out::new::<u16>("out_levels", out_levels, levels_shape(panel))?,
        };
        let phase_to = Out::new::<f32>("out_phase_rad", out_phase_rad, [3, height, width])?;
        let (frame, report) = self.frame(rgb, colour, depth, depth_unit, fill_missing)?;
        let frame = Arc::new(frame);
        let made = with_threads(py, || {
            warn_of_oddities("the picture", &report, &self.rig.geometry, false);
            let mut state = self
                .state
                .lock()
                .map_err(|_| Failure::new(Exit::Software, "this renderer failed before: make another one"))?;
            let began = Instant::now();
            let mut levels = LevelsFrame::new(self.encoder.layout());
            let unavailable = Failure::because(Exit::Unavailable);
            let rendered = state.renderer.render(&frame, pupil, &mut levels).map_err(&unavailable)?;
            if rendered.engine_changed {
                state.description = state.renderer.description().to_owned();
                tracing::warn!("holograms are computed by {} from now on", state.description);
            }
            let frame_ms = began.elapsed().as_secs_f64() * 1e3;
            if rendered.clipped_share.0.into_iter().any(|share| share > 0.0) {
                renderer::check_last_hologram(&mut *state.renderer)?;
            }
            if let Some(fault) = renderer::clipping_fault(rendered.clipped_where_lit(self.rig.light())) {
                tracing::warn!("{fault}");
            }
            let phase_rad = state.renderer.pattern().map_err(&unavailable)?.phase_rad.clone();
            let field = if field { Some(state.renderer.hologram().map_err(&unavailable)?.field.clone()) } else { None };
            Ok(Made { levels, rendered, phase_rad, field, engine: state.description.clone(), frame_ms })
        })?;
        let levels = match bit_depth {
            8 => levels_to.put(py, levels_of(&made.levels, |level| level as u8), levels_shape(panel))?,
            _ => levels_to.put(py, levels_of(&made.levels, |level| level), levels_shape(panel))?,
        };
        Ok(Hologram {
            rig: Arc::clone(&self.rig),
            encoder: Arc::clone(&self.encoder),
            sent: made.levels,
            levels: levels.unbind(),
            phase_rad: phase_to.put(py, made.phase_rad, [3, height, width])?.unbind(),
            field: made.field.map(|field| array(py, field, [3, height, width]).map(Bound::unbind)).transpose()?,
            rendered: made.rendered,
            report,
            pupil_mm,
            amplitude_constant: self.amplitude_constant,
            engine: made.engine,
            frame_ms: made.frame_ms,
        })
    }

    /// Columns of the pictures.
    #[getter]
    fn width_px(&self) -> usize {
        self.resolution.width
    }

    /// Rows of the pictures.
    #[getter]
    fn height_px(&self) -> usize {
        self.resolution.height
    }

    /// The narrowest and the widest pupil that the weights were trained for on this bench, millimetres.
    #[getter]
    fn trained_pupils_mm(&self) -> (f32, f32) {
        let [narrowest, widest] = self.trained_pupils_mm;
        (narrowest, widest)
    }

    /// Amplitude that the double phase maps to full modulation; above it is clipped.
    #[getter]
    fn amplitude_constant(&self) -> f32 {
        self.amplitude_constant
    }

    /// How holograms are computed, such as "cpu, avx512, 2 threads". Waits for a frame that another thread renders.
    #[getter]
    fn engine(&self, py: Python<'_>) -> PyResult<String> {
        py.detach(|| self.state.lock().map(|state| state.description.clone()).ok())
            .ok_or_else(|| HolodError::new_err("this renderer failed before: make another one"))
    }

    fn __repr__(&self) -> String {
        format!("<holod.Renderer {} on {:?}>", self.resolution, self.rig.name)
    }
}

impl Renderer {
    /// The arrays as the network reads them.
    fn frame(
        &self,
        rgb: &Bound<'_, PyAny>,
        colour: Option<&str>,
        depth: &Bound<'_, PyAny>,
        depth_unit: &str,
        fills_missing: bool,
    ) -> PyResult<(RgbdFrame, FrameReport)> {
        let Resolution { width, height } = self.resolution;
        let rgb = Given::new("rgb", rgb)?.of_shape(
            &[height, width, 3],
            "(height_px, width_px, 3)",
            ": make a renderer of another width_px and height_px, fit the picture, or move its axes",
        )?;
        let depth = Given::new("depth", depth)?.of_shape(
            &[height, width],
            "(height_px, width_px)",
            ": make a renderer of another width_px and height_px, or fit the picture",
        )?;
        let (bytes, floats);
        let colours = if rgb.is::<u8>() {
            if colour.is_some_and(|colour| colour != "srgb") {
                return Err(InputError::new_err(format!(
                    "colour: found {:?} for uint8, expected \"srgb\": 8 bits are too few for linear light; use float32",
                    colour.unwrap_or_default()
                )));
            }
            bytes = rgb.values::<u8>()?;
            ArrayColours::Srgb8(bytes.as_slice()?)
        } else if rgb.is::<f32>() {
            floats = rgb.values::<f32>()?;
            match colour {
                Some("srgb") => ArrayColours::SrgbF32(floats.as_slice()?),
                Some("linear") => ArrayColours::LinearF32(floats.as_slice()?),
                other => {
                    let found = other.map_or("none".to_owned(), |name| format!("{name:?}"));
                    return Err(InputError::new_err(format!(
                        "colour: found {found} for float32, expected \"srgb\" (as on a monitor) or \"linear\" (light)"
                    )));
                }
            }
        } else {
            let found = format!("an array of {}", rgb.type_name());
            return Err(
                rgb.refusal(found, "uint8 (sRGB, 0 to 255) or float32 (0 to 1, with colour=\"srgb\" or \"linear\")")
            );
        };
        let (integers, numbers);
        let depths = if depth.is::<u16>() && depth_unit == "millimetres" {
            integers = depth.values::<u16>()?;
            ArrayDepths::MillimetresU16(integers.as_slice()?)
        } else {
            let of = depths_in(depth_unit)?;
            if !depth.is::<f32>() {
                let found = format!("an array of {}", depth.type_name());
                return Err(depth.refusal(found, "float32, or uint16 with depth_unit=\"millimetres\""));
            }
            numbers = depth.values::<f32>()?;
            of(numbers.as_slice()?)
        };
        let picture = ArrayPicture { resolution: self.resolution, colours, depths, fills_missing };
        picture.frame(&self.rig.geometry).map_err(|error| {
            let (name, advice) = match error {
                ArrayError::Colours { .. } => ("rgb", ""),
                ArrayError::Missing { .. } => ("depth", " (fill_missing=True)"),
                ArrayError::NoDepth { .. } | ArrayError::Length { .. } => ("depth", ""),
            };
            InputError::new_err(format!("{name}: {error}{advice}"))
        })
    }
}

/// How depths of floats in a unit are read.
fn depths_in(unit: &str) -> PyResult<fn(&[f32]) -> ArrayDepths<'_>> {
    let of: fn(&[f32]) -> ArrayDepths<'_> = match unit {
        "metres" => |numbers| ArrayDepths::MetresF32(numbers),
        "millimetres" => |numbers| ArrayDepths::MillimetresF32(numbers),
        "dioptres" => |numbers| ArrayDepths::DioptresF32(numbers),
        "normalised_dioptres" => |numbers| ArrayDepths::NormalisedDioptresF32(numbers),
        other => {
            return Err(InputError::new_err(format!(
                "depth_unit: found {other:?}, expected \"metres\", \"millimetres\", \"dioptres\" or \
                 \"normalised_dioptres\" (0 the far end of the rig's depth range, 1 the near end)"
            )));
        }
    };
    Ok(of)
}

pub(crate) fn backend_named(name: &str) -> PyResult<Backend> {
    serde_json::from_value(name.into()).map_err(|_| {
        InputError::new_err(format!(
            "backend: found {name:?}, expected \"auto\", \"cpu\", \"cpu-half\", \"gpu\" or \"gpu-half\""
        ))
    })
}

/// The hologram of one picture for one pupil. Arrays of three are red, green, blue.
#[pyclass(frozen, module = "holod")]
pub(crate) struct Hologram {
    rig: Arc<calibration::Rig>,
    encoder: Arc<PanelEncoder>,
    /// The levels again, where nobody else writes.
    sent: LevelsFrame,
    levels: Py<PyAny>,
    phase_rad: Py<PyAny>,
    field: Option<Py<PyAny>>,
    rendered: Rendered,
    report: FrameReport,
    pupil_mm: f32,
    amplitude_constant: f32,
    engine: String,
    frame_ms: f64,
}

#[pymethods]
impl Hologram {
    /// What the panel is sent: each colour's levels, (3, rows, columns) of the rig's panel, uint8 for a panel of 8
    /// bits, else uint16.
    #[getter]
    fn levels(&self, py: Python<'_>) -> Py<PyAny> {
        self.levels.clone_ref(py)
    }

    /// Phases of the double-phase hologram before they become levels: float32 (3, rows, columns) of the picture's size,
    /// radians from 0 to 2π. For a panel that something else than holod drives.
    #[getter]
    fn phase_rad(&self, py: Python<'_>) -> Py<PyAny> {
        self.phase_rad.clone_ref(py)
    }

    /// The complex hologram before double phase: complex64 (3, rows, columns), |value|² is linear light with white = 1.
    /// None unless it was asked for (`field=True`).
    #[getter]
    fn field(&self, py: Python<'_>) -> Option<Py<PyAny>> {
        self.field.as_ref().map(|field| field.clone_ref(py))
    }

    /// The phases that the panel shows for the levels: float32 (3, rows, columns) of the picture's size, radians from 0
    /// to
    /// 2π. Computed when it is called.
    fn shown_phase_rad<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let Resolution { width, height } = self.encoder.pattern_resolution();
        let shown = without_lock(py, || Ok(shown_pattern(&self.encoder, &self.sent).phase_rad))?;
        array(py, shown, [3, height, width])
    }

    /// What an eye sees of the levels, as `holod view` shows it: float32 (rows, columns, 3), linear light, 1 is white.
    ///
    /// `focus_dpt` is where the eye is focused: 0 is infinity, 2 is 50 cm. `pupil_mm` is the pupil that looks, the one
    /// that the hologram was made for where it is left out. Other threads of Python run meanwhile.
    #[pyo3(signature = (focus_dpt, pupil_mm=None))]
    fn view<'py>(&self, py: Python<'py>, focus_dpt: f64, pupil_mm: Option<f32>) -> PyResult<Bound<'py, PyAny>> {
        let eye = eye(pupil_mm.unwrap_or(self.pupil_mm), focus_dpt)?;
        see(py, &self.rig, eye, self.amplitude_constant, || Ok(shown_pattern(&self.encoder, &self.sent)))
    }

    /// The pupil that the hologram was made for, millimetres.
    #[getter]
    fn pupil_mm(&self) -> f32 {
        self.pupil_mm
    }

    /// Share of samples whose amplitude exceeded the double phase's constant, 0 to 1, of the colours that are lit.
    #[getter]
    fn clipped_share(&self) -> f32 {
        self.rendered.clipped_where_lit(self.rig.light())
    }

    /// Share of each colour's pixels whose phase the panel cannot reach, 0 to 1.
    #[getter]
    fn unreachable_share(&self) -> (f32, f32, f32) {
        let [red, green, blue] = Colour::ALL.map(|colour| self.rendered.unreachable_share[colour]);
        (red, green, blue)
    }

    /// Amplitude that the double phase maps to full modulation, for `holod.view`.
    #[getter]
    fn amplitude_constant(&self) -> f32 {
        self.amplitude_constant
    }

    /// Pixels without a depth, which were filled from their surroundings.
    #[getter]
    fn depth_missing_px(&self) -> usize {
        self.report.depth_missing_px
    }

    /// Pixels farther than the display shows, set to its far end.
    #[getter]
    fn depth_clamped_far_px(&self) -> usize {
        self.report.depth_clamped_far_px
    }

    /// Pixels nearer than the display shows, set to its near end.
    #[getter]
    fn depth_clamped_near_px(&self) -> usize {
        self.report.depth_clamped_near_px
    }

    /// How it was computed, such as "cpu, avx512, 2 threads".
    #[getter]
    fn engine(&self) -> &str {
        &self.engine
    }

    /// Time from picture to levels, milliseconds, without the conversion of arrays.
    #[getter]
    fn frame_ms(&self) -> f64 {
        self.frame_ms
    }

    fn __repr__(&self) -> String {
        format!(
            "<holod.Hologram {} for {} mm, {:.3} % clipped, {:.0} ms by {}>",
            self.encoder.pattern_resolution(),
            self.pupil_mm,
            self.clipped_share() * 100.0,
            self.frame_ms,
            self.engine
        )
    }
}
