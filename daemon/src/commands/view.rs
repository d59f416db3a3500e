//! `holod view`: what an eye sees of a hologram.
//!
//! The hologram goes the whole way to the panel's levels and back to phase, so the picture is that of the pattern that
//! the panel would show.

use std::path::Path;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, PerColour};
use holod_model::files::{self, StoredHologram};
use holod_model::optics::{DoublePhase, Eye, PhasePattern, SimulatedEye};
use holod_slm_output::fields::FrameLayout;
use holod_slm_output::{LevelsFrame, PanelEncoder};
use serde::Serialize;

use super::render;
use crate::cli::ViewArgs;
use crate::destination::Destination;
use crate::failure::{Exit, Failure};
use crate::pictures::shown_pattern;
use crate::{progress, report, setup};

#[derive(Serialize)]
struct Report<'a> {
    out: &'a Path,
    hologram_pupil_mm: f32,
    eye_pupil_mm: f32,
    focus_dpt: f64,
    focus_u_mm: f64,
}

pub(super) fn view(args: &ViewArgs) -> Result<(), Failure> {
    let out = Destination::new(&args.out, "--out", args.force)?;
    if out.is_stdout() && args.json {
        return Err(Failure::new(
            Exit::Usage,
            "--out - and --json would both write to standard output: give one of them",
        ));
    }
    let rig = setup::rig_with_network(&args.rig, &args.network)?;
    let hologram = match (&args.hologram, args.pupil) {
        (Some(folder), _) => load(folder)?,
        (None, Some(pupil)) => render::hologram(&rig, &args.scene, pupil, args.backend)?,
        (None, None) => {
            return Err(Failure::new(
                Exit::Usage,
                "name what to look at: --hologram DIR that `holod render` wrote, or --pupil MM with --scene PATH (the \
                 built-in scene when left out)",
            ));
        }
    };
    let resolution = hologram.hologram.resolution;
    let geometry = hologram.optics.geometry(resolution);
    let eye = Eye { pupil: args.eye_pupil.unwrap_or(hologram.pupil), focus: args.focus };
    let pattern = progress::during("computing the panel's levels", || through_the_panel(&rig, &hologram))?;
    let seen = progress::during("computing what the eye sees", || {
        SimulatedEye::new(&geometry, resolution).view(&pattern, hologram.amplitude_constant, eye)
    });
    out.write(|path| files::save_picture(&seen, path).map_err(Failure::because(Exit::CannotCreate)))?;
    if out.is_stdout() {
        return Ok(());
    }
    let said = Report {
        out: &args.out,
        hologram_pupil_mm: hologram.pupil.mm(),
        eye_pupil_mm: eye.pupil.mm(),
        focus_dpt: eye.focus.0,
        focus_u_mm: geometry.image_distance(eye.focus).0 * 1e3,
    };
    if args.json {
        return report::print_json(&said);
    }
    report::print(&format!(
        "{}: hologram for {} mm, seen by a pupil of {} mm focused at {} dpt (u = {:.3} mm)",
        args.out.display(),
        said.hologram_pupil_mm,
        said.eye_pupil_mm,
        said.focus_dpt,
        said.focus_u_mm
    ))
}

fn load(folder: &Path) -> Result<StoredHologram, Failure> {
    let path = folder.join("field.safetensors");
    if !path.is_file() {
        return Err(Failure::new(
            Exit::NoInput,
            format!(
                "--hologram {}: there is no field.safetensors in it; make one with `holod render --out {}`",
                folder.display(),
                folder.display()
            ),
        ));
    }
    StoredHologram::load(&path).map_err(Failure::because(Exit::Data))
}

/// Double phase, the panel's levels, and what those levels show.
fn through_the_panel(rig: &Rig, hologram: &StoredHologram) -> Result<PhasePattern, Failure> {
    let resolution = hologram.hologram.resolution;
    let mut pattern = PhasePattern::flat(resolution);
    DoublePhase::new(resolution, hologram.amplitude_constant).encode(&hologram.hologram, &mut pattern);
    let encoder =
        PanelEncoder::new(&rig.panel, rig.resolution(), resolution).map_err(Failure::because(Exit::Config))?;
    let mut levels = LevelsFrame::new(FrameLayout::new(&rig.panel, rig.resolution()));
    encoder.encode(PerColour(Colour::ALL.map(|colour| pattern.plane(colour))), &mut levels);
    Ok(shown_pattern(&encoder, &levels))
}
