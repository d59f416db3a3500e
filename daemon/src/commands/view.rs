//! `holod view`: what an eye sees of a hologram.
//!
//! The hologram goes the whole way to the panel's levels and back to phase, so the picture is that of the pattern that
//! the panel would show.

use std::path::Path;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, PerColour, PupilDiameter};
use holod_model::files::{self, BenchOptics, RigHash, StoredHologram};
use holod_model::optics::{DoublePhase, Eye, PhasePattern, SimulatedEye};
use holod_slm_output::LevelsFrame;
use serde::Serialize;

use super::render::{self, Computed};
use super::service_facts::files_of;
use crate::cli::{Backend, SceneArgs, ViewArgs};
use crate::destination::Destination;
use crate::failure::{Exit, Failure, is_file};
use crate::pictures::shown_pattern;
use crate::source::scene;
use crate::staging::folder_of;
use crate::{progress, renderer, results, setup};

/// What `holod render` wrote, in its folder.
const HOLOGRAM: &str = "field.safetensors";

#[derive(Serialize)]
struct Report<'a> {
    #[serde(serialize_with = "results::path_text")]
    out: &'a Path,
    hologram_pupil_mm: f32,
    eye_pupil_mm: f32,
    focus_dpt: f64,
    focus_u_mm: f64,
}

/// Phases on a panel, and what they are a hologram of.
struct LookedAt {
    pattern: PhasePattern,
    /// The pupil that it was made for.
    pupil: PupilDiameter,
    optics: BenchOptics,
    amplitude_constant: f32,
}

pub(super) fn view(args: &ViewArgs) -> Result<(), Failure> {
    if let Some(found) = args.out.extension().filter(|extension| !extension.eq_ignore_ascii_case("png")) {
        let found = found.display();
        return Err(Failure::new(
            Exit::Usage,
            format!("--out: found a file of kind .{found}; expected FILE.png, or -"),
        ));
    }
    let out = Destination::new(&args.out, "--out", args.force)?;
    out.refuse_json("--out", args.json)?;
    let rig = setup::rig_to_show(&args.rig, &args.network)?;
    let hologram = args.hologram.iter().map(|folder| folder.join(HOLOGRAM));
    out.refuse_inputs("--out", hologram.chain(scene::files(&args.scene, &rig.geometry)).chain(files_of(&rig)))?;
    let looked_at = match (&args.hologram, args.pupil) {
        (Some(folder), _) => {
            let hologram = load(folder)?;
            check_fits(folder, &hologram, &rig)?;
            check_made_for(folder, &hologram, &rig, args.rig.config.is_some())?;
            progress::during("computing the panel's levels", || of_hologram(&rig, hologram))?
        }
        (None, Some(pupil)) => of_scene(&rig, &args.scene, pupil, args.backend)?,
        (None, None) => {
            return Err(Failure::new(
                Exit::Usage,
                "name what to look at: --hologram DIR that `holod render` wrote, or --pupil MM with --scene PATH (the \
                 built-in scene when left out)",
            ));
        }
    };
    if rig.light() == PerColour([0.0; 3]) {
        tracing::warn!(
            "the picture is black: the rig lights no colour that its panel shows; give lasers.power_mw of one more than 0"
        );
    }
    let LookedAt { pattern, pupil, optics, amplitude_constant } = looked_at;
    let resolution = pattern.resolution;
    let geometry = optics.geometry(resolution);
    let eye = Eye { pupil: args.eye_pupil.unwrap_or(pupil), focus: args.focus };
    let seen = progress::during("computing what the eye sees", || {
        SimulatedEye::new(&geometry, resolution).view_weighted(&pattern, amplitude_constant, eye, rig.light())
    });
    out.write(|path| files::save_picture(&seen, path).map_err(Failure::because(Exit::CannotCreate)))?;
    if out.is_stdout() {
        return Ok(());
    }
    let said = Report {
        out: &args.out,
        hologram_pupil_mm: pupil.mm(),
        eye_pupil_mm: eye.pupil.mm(),
        focus_dpt: eye.focus.0,
        focus_u_mm: geometry.image_distance(eye.focus).0 * 1e3,
    };
    if args.json {
        return results::print_json(&said);
    }
    results::print(&format!(
        "{}: hologram for {} mm, seen by a pupil of {} mm focused at {} dpt (u = {:.3} mm)",
        args.out.display(),
        said.hologram_pupil_mm,
        said.eye_pupil_mm,
        said.focus_dpt,
        said.focus_u_mm
    ))
}

fn load(folder: &Path) -> Result<StoredHologram, Failure> {
    let path = folder.join(HOLOGRAM);
    if is_file(folder)? {
        let what = format!(
            "--hologram {}: found a file, expected the folder that `holod render` wrote; name the folder, such as {}",
            folder.display(),
            folder_of(folder).display()
        );
        return Err(Failure::new(Exit::NoInput, what));
    }
    if !is_file(&path)? {
        return Err(Failure::new(
            Exit::NoInput,
            format!(
                "--hologram {}: there is no {HOLOGRAM} in it; make one with `holod render --out {}`",
                folder.display(),
                folder.display()
            ),
        ));
    }
    StoredHologram::load(&path).map_err(Failure::because(Exit::Data))
}

/// Refuses a hologram that is larger than the rig's panel: it was made with another rig.
fn check_fits(folder: &Path, stored: &StoredHologram, rig: &Rig) -> Result<(), Failure> {
    let (hologram, panel) = (stored.hologram.resolution, rig.resolution());
    if hologram.width <= panel.width && hologram.height <= panel.height {
        return Ok(());
    }
    Err(Failure::new(
        Exit::Usage,
        format!(
            "--hologram {}: found a hologram of {hologram}, larger than this rig's panel of {panel}; name the rig that \
             it was made with by --config FILE",
            folder.display()
        ),
    ))
}

/// Refuses a hologram that was made for other optics than those of the rig file that was named, and warns of another
/// rig. Without one its own optics hold, and only the panel is the built-in bench's.
fn check_made_for(folder: &Path, stored: &StoredHologram, rig: &Rig, is_named: bool) -> Result<(), Failure> {
    let (made_for, bench) = (&stored.optics, BenchOptics::of(&rig.geometry));
    let folder = folder.display();
    if made_for.shows_alike(&bench) {
        let this = RigHash::of(&rig.provenance);
        if let Some(made_with) = stored.rig.as_ref().filter(|made_with| **made_with != this) {
            let remedy = match made_with {
                RigHash::BuiltIn => "leave --config out",
                RigHash::File(_) => "name the rig that it was made with by --config FILE",
            };
            tracing::warn!(
                "--hologram {folder}: it was made with {made_with}, but is looked at with panel and lasers of {this}, \
                 which may show it otherwise; {remedy}"
            );
        }
        return Ok(());
    }
    if is_named {
        return Err(Failure::new(
            Exit::Usage,
            format!(
                "--hologram {folder}: found a hologram for {made_for}, expected one for this rig's {bench}; name the \
                 rig that it was made with by --config FILE, or render it again with this one"
            ),
        ));
    }
    tracing::warn!(
        "--hologram {folder}: it is looked at with its own optics, {made_for}, but with the levels of the built-in \
         bench's panel; name the rig that it was made with by --config FILE"
    );
    Ok(())
}

/// The phases that the panel shows of a scene's first frame.
fn of_scene(rig: &Rig, scene: &SceneArgs, pupil: PupilDiameter, backend: Backend) -> Result<LookedAt, Failure> {
    let Computed { encoder, levels, optics, report, .. } = render::compute(rig, scene, pupil, backend)?;
    let pattern = shown_pattern(&encoder, &levels);
    Ok(LookedAt { pattern, pupil, optics, amplitude_constant: report.amplitude_constant })
}

/// The phases that the panel shows of a hologram: double phase, the panel's levels, and what those levels show.
fn of_hologram(rig: &Rig, stored: StoredHologram) -> Result<LookedAt, Failure> {
    let StoredHologram { hologram, pupil, optics, amplitude_constant, .. } = stored;
    let mut pattern = PhasePattern::flat(hologram.resolution);
    DoublePhase::new(hologram.resolution, amplitude_constant).encode(&hologram, &mut pattern);
    let encoder = renderer::panel_encoder(rig, hologram.resolution)?;
    let mut levels = LevelsFrame::new(encoder.layout());
    encoder.encode(PerColour(Colour::ALL.map(|colour| pattern.plane(colour))), &mut levels);
    Ok(LookedAt { pattern: shown_pattern(&encoder, &levels), pupil, optics, amplitude_constant })
}
