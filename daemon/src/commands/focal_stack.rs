//! `holod render --focal-stack`: the hologram of images that are focused at several depths.

use std::path::Path;
use std::time::Instant;

use holod_calibration::rig::Rig;
use holod_calibration::{Dioptres, DisplayGeometry};
use holod_model::engine::{EngineError, FocalStackEngine, Precision};
use holod_model::files::{self, BenchOptics, RigHash, StoredHologram};
use holod_model::optics::{DoublePhase, PhasePattern};
use holod_model::scene::{FocalStack, FocalStackFiles, FocalStackReport};
use holod_model::{ComplexHologram, Weights};
use serde::Serialize;

use super::hologram_files::{FILES, save};
use crate::cli::{Backend, RenderArgs};
use crate::failure::{Exit, Failure};
use crate::made_with::MadeWith;
use crate::source::scene;
use crate::staging::Staging;
use crate::{progress, renderer, results, setup};

/// What was done, and what the reader should know of it; `report.json`.
#[derive(Serialize)]
struct Report {
    #[serde(flatten)]
    made_with: MadeWith,
    /// What 2π would be in the PNGs of phases.
    phase_png_2pi: u32,
    focal_stack: String,
    pupil_mm: f32,
    focus_dpt: Vec<f64>,
    width_px: usize,
    height_px: usize,
    amplitude_constant: f32,
    /// Of colours that are lit.
    clipped_share: f32,
    /// Pixels of all images together.
    colour_clipped_px: usize,
    /// Those of them that were brighter than white.
    colour_above_white_px: usize,
    /// Pixels of each image that the picture does not reach.
    padded_px: usize,
    /// How the hologram was computed.
    engine: String,
    /// From images to phases.
    frame_ms: f64,
    /// From the command's beginning until everything but this report was written.
    total_ms: f64,
    files: [&'static str; 5],
}

/// Renders the focal stack in `directory`; the command `began`.
pub(super) fn render(args: &RenderArgs, rig: &Rig, directory: &Path, began: Instant) -> Result<(), Failure> {
    if args.backend.takes_a_gpu() && args.backend != Backend::Auto {
        let only = "--backend: focal stacks are computed by the processor alone; leave it out, or name `cpu`";
        return Err(Failure::new(Exit::Usage, only));
    }
    let staging = Staging::new(&args.out, &FILES, args.force)?;
    let weights = progress::during("loading the network", || setup::weights_for_one_pupil(rig))?;
    let name = directory.display().to_string();
    let (stack, done) = load(args, rig, &weights, directory)?;
    let resolution = stack.resolution;
    let mut engine = progress::during(&format!("preparing the network for {resolution}"), || {
        let precision = if args.backend == Backend::Cpu { Precision::Single } else { Precision::Half };
        FocalStackEngine::new(&weights, &rig.geometry, resolution, precision).map_err(|error| at_fault(&name, error))
    })?;
    let amplitude_constant = weights.config().amplitude_constant;
    let mut double_phase = DoublePhase::new(resolution, amplitude_constant);
    let (mut hologram, mut pattern) = (ComplexHologram::dark(resolution), PhasePattern::flat(resolution));
    let computing = Instant::now();
    let clipped_share = progress::during(&format!("computing the hologram of {resolution}"), || {
        engine.render(&stack, &mut hologram).map_err(|error| at_fault(&name, error))?;
        renderer::check_numbers(&hologram)?;
        Ok::<_, Failure>(double_phase.encode(&hologram, &mut pattern).clipped_share)
    })?;
    let clipped_share = renderer::mean_where_lit(clipped_share, rig.light());
    if let Some(fault) = renderer::clipping_fault(clipped_share) {
        tracing::warn!("{fault}");
    }
    let frame_ms = computing.elapsed().as_secs_f64() * 1e3;
    let optics = BenchOptics::of(&DisplayGeometry { resolution, ..rig.geometry });
    let made_for = Some(RigHash::of(&rig.provenance));
    let stored = StoredHologram { hologram, pupil: stack.pupil, optics, amplitude_constant, rig: made_for };
    save(&stored, &pattern, &staging)?;
    let report = Report {
        made_with: MadeWith::of(rig, &weights),
        phase_png_2pi: files::PHASE_LEVELS,
        pupil_mm: stack.pupil.mm(),
        focus_dpt: stack.focuses.iter().map(|&Dioptres(focus_dpt)| focus_dpt).collect(),
        width_px: resolution.width,
        height_px: resolution.height,
        amplitude_constant,
        clipped_share,
        colour_clipped_px: done.colour_clipped.in_all(),
        colour_above_white_px: done.colour_clipped.above_white_px,
        padded_px: done.padded_px,
        engine: format!("cpu, {}", engine.instruction_set()),
        frame_ms,
        total_ms: began.elapsed().as_secs_f64() * 1e3,
        files: FILES,
        focal_stack: name,
    };
    results::save_json(&report, &staging.path(FILES[4]))?;
    staging.commit()?;
    if args.json {
        return results::print_json(&report);
    }
    results::print(&in_words(&report, &args.out))
}

/// The stack in `directory`, as far as it suits the rig and the network.
fn load(
    args: &RenderArgs,
    rig: &Rig,
    weights: &Weights,
    directory: &Path,
) -> Result<(FocalStack, FocalStackReport), Failure> {
    let name = directory.display().to_string();
    let files = FocalStackFiles::open(directory).map_err(scene::failure)?;
    FocalStackEngine::check(weights, &rig.geometry, files.focuses()).map_err(|error| at_fault(&name, error))?;
    setup::check_pupil(weights, &rig.geometry, files.pupil())
        .map_err(|why| Failure::new(Exit::Data, format!("{name}/stack.toml: `pupil_mm`: {why}")))?;
    let (stack, done) = progress::during("loading the focal stack", || {
        files.load(args.scene.resolution, args.scene.fit.into()).map_err(scene::failure)
    })?;
    scene::warn_of_clipped_colours(&name, done.colour_clipped, done.source_px);
    if done.has_foreign_primaries {
        scene::warn_of_foreign_primaries(&name);
    }
    scene::check_fits(stack.resolution, &rig.geometry, &name)?;
    Ok((stack, done))
}

fn at_fault(name: &str, error: EngineError) -> Failure {
    match error {
        EngineError::Focuses { .. } => Failure::new(Exit::Data, format!("{name}/stack.toml: {error}")),
        other => renderer::failure(other),
    }
}

fn in_words(report: &Report, out: &Path) -> String {
    let [width_px, height_px] = [report.width_px, report.height_px];
    format!(
        "{}: hologram of {width_px}x{height_px} from {} images for a pupil of {} mm in {:.0} ms, {:.1} s with all else; \
         {:.3} % of amplitudes clipped\nfocused from {:.2} to {:.2} dpt; pixels clipped {}, padded {}\nin {}: {}",
        report.focal_stack,
        report.focus_dpt.len(),
        report.pupil_mm,
        report.frame_ms,
        report.total_ms / 1e3,
        report.clipped_share * 100.0,
        report.focus_dpt[0],
        report.focus_dpt[report.focus_dpt.len() - 1],
        report.colour_clipped_px,
        report.padded_px,
        out.display(),
        FILES.join(", ")
    )
}
