//! A rig as Python has it: its figures, and levels of its panel from files.

use std::path::{Path, PathBuf};

use holod_calibration::rig::{self as calibration, WeightsChoice};
use holod_calibration::{Colour, Dioptres, PerColour, Resolution};
use holod_daemon::failure::{Exit, Failure};
use holod_daemon::pictures::read_levels;
use holod_daemon::{renderer, setup};
use holod_slm_output::{LevelsFrame, PanelEncoder};
use pyo3::prelude::*;

use crate::arrays::{Given, array};
use crate::outcome::{Count, InputError, RigError, exception, optional_count, with_threads, without_lock};

/// More turns than this are no phase: the encoder's arithmetic is exact to it.
const MOST_TURNS: f32 = 50.0;

/// Everything that is true of one bench: panel, wavelengths, eyepiece and depth range.
///
/// `Rig.load(path)` reads a rig file, `Rig.builtin()` is the bench that holod uses without one.
#[pyclass(frozen, module = "holod")]
pub(crate) struct Rig {
    rig: calibration::Rig,
}

#[pymethods]
impl Rig {
    /// Reads a rig file (TOML), and the look-up tables and pictures that it names.
    ///
    /// Raises RigError, which tells every fault of the file with its line.
    #[staticmethod]
    fn load(path: PathBuf) -> PyResult<Self> {
        let rig = calibration::Rig::load(&path).map_err(|error| RigError::new_err(error.to_string()))?;
        Ok(Self { rig })
    }

    /// The built-in bench: 1920 x 1080 pixels of 8 um and 8 bits, 638, 520 and 450 nm, f = 40 mm, infinity to 35 cm.
    #[staticmethod]
    fn builtin() -> Self {
        Self { rig: calibration::Rig::default() }
    }

    /// The bench's name, for logs and reports.
    #[getter]
    fn name(&self) -> &str {
        &self.rig.name
    }

    /// Columns of the panel.
    #[getter]
    fn width_px(&self) -> usize {
        self.rig.resolution().width
    }

    /// Rows of the panel.
    #[getter]
    fn height_px(&self) -> usize {
        self.rig.resolution().height
    }

    /// Distance between the centres of neighbouring pixels, metres.
    #[getter]
    fn pixel_pitch_m(&self) -> f64 {
        self.rig.pixel_pitch().0
    }

    /// Wavelengths of red, green and blue, metres.
    #[getter]
    fn wavelengths_m(&self) -> (f64, f64, f64) {
        let [red, green, blue] = self.rig.geometry.wavelengths.0.map(|wavelength| wavelength.0);
        (red, green, blue)
    }

    /// Focal length of the eyepiece over the magnification of the relay before it, metres.
    #[getter]
    fn eyepiece_focal_length_m(&self) -> f64 {
        self.rig.geometry.eyepiece_focal_length.0
    }

    /// The farthest depth that the display shows, dioptres; 0 is infinity.
    #[getter]
    fn depth_far_dpt(&self) -> f64 {
        self.rig.geometry.depth_far.0
    }

    /// The nearest depth that the display shows, dioptres.
    #[getter]
    fn depth_near_dpt(&self) -> f64 {
        self.rig.geometry.depth_near.0
    }

    /// Bits of a level: 8, 10 or 16.
    #[getter]
    fn bit_depth(&self) -> u8 {
        self.rig.panel.bit_depth
    }

    /// How three colour fields reach the panel: "channel-packed", "field-sequential" or "monochrome".
    #[getter]
    fn mode(&self) -> &'static str {
        self.rig.panel.mode.name()
    }

    /// The order in which the panel shows the colours, such as ("red", "green", "blue").
    #[getter]
    fn field_order(&self) -> (&'static str, &'static str, &'static str) {
        let [first, second, third] = self.rig.panel.field_order.map(Colour::name);
        (first, second, third)
    }

    /// Video frames a second.
    #[getter]
    fn refresh_hz(&self) -> f64 {
        self.rig.panel.refresh_hz
    }

    /// Phase at the top level of red, green and blue, radians.
    #[getter]
    fn stroke_rad(&self) -> (f64, f64, f64) {
        let [red, green, blue] = self.rig.panel.stroke_rad.0;
        (red, green, blue)
    }

    /// The name of the weights that the rig names.
    #[getter]
    fn weights(&self) -> String {
        setup::weights_name(&self.rig.model.weights)
    }

    /// Distance from the panel to the image plane that an eye sees at `depth_dpt` dioptres, metres: f² · depth.
    ///
    /// Raises InputError for what is no finite number.
    fn image_distance_m(&self, depth_dpt: f64) -> PyResult<f64> {
        if !depth_dpt.is_finite() {
            return Err(InputError::new_err(format!("depth_dpt: found {depth_dpt}, expected dioptres")));
        }
        Ok(self.rig.geometry.image_distance(Dioptres(depth_dpt)).0)
    }

    /// The levels that the panel is sent for phases of any origin.
    ///
    /// `phase_rad` is float32 (3, rows, columns) in radians: red, green, blue. Smaller patterns than the panel are
    /// centred on it, and dark around, which is ±π/2 in turn; they lie as the rig's `panel.orientation` says. Each phase
    /// becomes the level whose phase is nearest on the circle, by the rig's look-up tables, stroke, sign and flatness.
    ///
    /// Returns (3, height_px, width_px) of uint8 for a panel of 8 bits, else uint16. Raises InputError for phases that
    /// are not finite or beyond 50 turns, and for patterns larger than the panel.
    fn levels_of<'py>(&self, py: Python<'py>, phase_rad: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let (phases, resolution) = phases_of("phase_rad", phase_rad)?;
        let encoder = self.encoder(resolution)?;
        let levels = with_threads(py, || {
            let planes = PerColour([0, 1, 2].map(|colour| plane(&phases, colour)));
            let mut levels = LevelsFrame::new(encoder.layout());
            encoder.encode(planes, &mut levels);
            Ok(levels)
        })?;
        levels_array(py, &levels, self.rig.panel.bit_depth)
    }

    /// The phases that the panel shows for levels: (3, height_px, width_px), as `levels_of` returns them.
    ///
    /// `width_px` and `height_px` are the size of the pattern in the middle of the panel, the whole panel where they
    /// are left out. Returns float32 (3, rows, columns), radians from 0 to 2π. Raises InputError for another shape or
    /// type, and for levels that the panel does not have.
    #[pyo3(signature = (levels, *, width_px=None, height_px=None))]
    fn phase_of<'py>(
        &self,
        py: Python<'py>,
        levels: &Bound<'py, PyAny>,
        width_px: Option<Count>,
        height_px: Option<Count>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let panel = self.rig.resolution();
        let given =
            Given::new("levels", levels)?.of_shape(&[3, panel.height, panel.width], "(colours, rows, columns)", "")?;
        let levels: Vec<u16> = if self.rig.panel.bit_depth == 8 {
            given.values::<u8>()?.as_slice()?.iter().map(|&level| u16::from(level)).collect()
        } else {
            given.values::<u16>()?.as_slice()?.to_vec()
        };
        let resolution = self.pattern_resolution(width_px, height_px)?;
        let encoder = self.encoder(resolution)?;
        for (colour, field) in Colour::ALL.into_iter().zip(levels.chunks_exact(panel.pixels())) {
            if let Some(pixel) = encoder.unknown_level(colour, field) {
                let (level, row, column) = (field[pixel], pixel / panel.width, pixel % panel.width);
                let bits = self.rig.panel.bit_depth;
                return Err(given.refusal(
                    format!("level {level} ({colour}, row {row}, column {column})"),
                    &format!("levels of the panel's {bits} bits that its look-up table has"),
                ));
            }
        }
        let phases = without_lock(py, || {
            let fields = Colour::ALL.into_iter().zip(levels.chunks_exact(panel.pixels()));
            Ok(fields.flat_map(|(colour, field)| encoder.decode_pattern(colour, field)).collect::<Vec<f32>>())
        })?;
        array(py, phases, [3, resolution.height, resolution.width])
    }

    /// The levels of a picture in a record, `shown_pupil_*.png`, of a run of this rig: (3, height_px, width_px), as
    /// `levels_of` returns them and `phase_of` takes them.
    ///
    /// Raises InputError for what is no such picture of this rig's panel.
    fn read_levels<'py>(&self, py: Python<'py>, path: PathBuf) -> PyResult<Bound<'py, PyAny>> {
        let panel = self.rig.resolution();
        let fields = without_lock(py, || read_levels(&path, &self.rig.panel, panel))?;
        let levels = fields.0.into_iter().flatten();
        if self.rig.panel.bit_depth == 8 {
            array(py, levels.map(|level| level as u8).collect(), levels_shape(panel))
        } else {
            array(py, levels.collect(), levels_shape(panel))
        }
    }

    fn __repr__(&self) -> String {
        let rig = &self.rig;
        let [red, green, blue] = rig.geometry.wavelengths.0.map(|wavelength| wavelength.0 * 1e9);
        format!(
            "<holod.Rig {:?}: {} at {} um, {red:.0}/{green:.0}/{blue:.0} nm, f = {} mm, {} to {:.3} dpt>",
            rig.name,
            rig.resolution(),
            rig.pixel_pitch().0 * 1e6,
            rig.geometry.eyepiece_focal_length.0 * rig.relay_magnification * 1e3,
            rig.geometry.depth_far.0,
            rig.geometry.depth_near.0
        )
    }
}

impl Rig {
    /// The rig that was given, or the built-in one.
    pub(crate) fn given(rig: Option<&Bound<'_, Self>>) -> calibration::Rig {
        rig.map_or_else(calibration::Rig::default, |rig| rig.get().rig.clone())
    }

    /// The same with other weights.
    pub(crate) fn with_weights(rig: Option<&Bound<'_, Self>>, weights: Option<&Path>) -> PyResult<calibration::Rig> {
        let mut rig = Self::given(rig);
        if let Some(weights) = weights {
            rig.model.weights = weights_choice(weights)?;
        }
        Ok(rig)
    }

    fn encoder(&self, resolution: Resolution) -> PyResult<PanelEncoder> {
        check_size(resolution, &self.rig)?;
        renderer::panel_encoder(&self.rig, resolution)
            .map(|encoder| encoder.as_ref().clone())
            .map_err(|failure| exception(&failure))
    }

    fn pattern_resolution(&self, width_px: Option<Count>, height_px: Option<Count>) -> PyResult<Resolution> {
        pattern_resolution(&self.rig, width_px, height_px)
    }
}

/// The size of a pattern on the panel of `rig`, which is the panel's where nothing is said.
pub(crate) fn pattern_resolution(
    rig: &calibration::Rig,
    width_px: Option<Count>,
    height_px: Option<Count>,
) -> PyResult<Resolution> {
    let panel = rig.resolution();
    let resolution = Resolution {
        width: optional_count(width_px, "width_px")?.unwrap_or(panel.width),
        height: optional_count(height_px, "height_px")?.unwrap_or(panel.height),
    };
    check_size(resolution, rig)?;
    Ok(resolution)
}

fn check_size(resolution: Resolution, rig: &calibration::Rig) -> PyResult<()> {
    let panel = rig.resolution();
    if (1..=panel.width).contains(&resolution.width) && (1..=panel.height).contains(&resolution.height) {
        return Ok(());
    }
    Err(InputError::new_err(format!(
        "width_px and height_px: found a pattern of {resolution}, expected 1x1 to the panel's {panel}"
    )))
}

/// Phases of three colours, [3, height, width], that are known to be some.
pub(crate) fn phases_of(name: &'static str, given: &Bound<'_, PyAny>) -> PyResult<(Vec<f32>, Resolution)> {
    let given = Given::new(name, given)?;
    let &[3, height, width] = given.shape() else {
        let found = given.shape().to_vec();
        return Err(given.refusal(format!("an array of shape {found:?}"), "(3, rows, columns): red, green, blue"));
    };
    let resolution = Resolution { width, height };
    let phases = given.values::<f32>()?.as_slice()?.to_vec();
    let most = MOST_TURNS * std::f32::consts::TAU;
    if let Some(index) = phases.iter().position(|phase| phase.is_nan() || phase.abs() > most) {
        let (colour, pixel) = (index / resolution.pixels(), index % resolution.pixels());
        let found =
            format!("{} ({}, row {}, column {})", phases[index], Colour::ALL[colour], pixel / width, pixel % width);
        return Err(given.refusal(found, "radians within 50 turns of 0"));
    }
    Ok((phases, resolution))
}

fn plane(phases: &[f32], colour: usize) -> &[f32] {
    let pixels = phases.len() / 3;
    &phases[colour * pixels..][..pixels]
}

/// Each colour's levels in turn, of the panel's type.
pub(crate) fn levels_array<'py>(py: Python<'py>, levels: &LevelsFrame, bit_depth: u8) -> PyResult<Bound<'py, PyAny>> {
    let shape = levels_shape(levels.layout().resolution);
    if bit_depth == 8 {
        array(py, levels_of(levels, |level| level as u8), shape)
    } else {
        array(py, levels_of(levels, |level| level), shape)
    }
}

pub(crate) fn levels_shape(panel: Resolution) -> [usize; 3] {
    [3, panel.height, panel.width]
}

/// Each colour's levels in turn.
pub(crate) fn levels_of<T>(levels: &LevelsFrame, as_type: impl Fn(u16) -> T) -> Vec<T> {
    Colour::ALL.into_iter().flat_map(|colour| levels.unpack_colour(colour).levels).map(as_type).collect()
}

/// Weights by name or by file, as on the command line.
fn weights_choice(weights: &Path) -> PyResult<WeightsChoice> {
    let built_in = WeightsChoice::BUILT_IN.into_iter().find(|(name, _)| Path::new(name) == weights);
    if let Some((_, choice)) = built_in {
        return Ok(choice);
    }
    if weights.is_file() {
        return Ok(WeightsChoice::File(weights.to_path_buf()));
    }
    let names = WeightsChoice::BUILT_IN.map(|(name, _)| name).join(", ");
    Err(exception(&Failure::new(
        Exit::NoInput,
        format!("weights: found {:?}, expected one of {names}, or a file that the trainer exported", weights.display()),
    )))
}
