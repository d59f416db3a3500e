//! `holod render`: one hologram and its phase patterns.

use std::sync::Arc;
use std::time::Instant;

use holod_calibration::rig::Rig;
use holod_calibration::{DisplayGeometry, PupilDiameter};
use holod_model::files::{self, BenchOptics, RigHash, StoredHologram};
use holod_model::refocus::{self, FAR_CARD, NEAR_CARD};
use holod_slm_output::{LevelsFrame, PanelEncoder};
use serde::Serialize;

use super::focal_stack;
use super::hologram_files::{FILES, save};
use crate::cli::{Backend, RenderArgs, SceneArgs};
use crate::failure::{Exit, Failure};
use crate::made_with::MadeWith;
use crate::progress;
use crate::renderer::{self, Renderer, Use};
use crate::source::scene;
use crate::staging::Staging;
use crate::{results, setup};

/// What was done, and what the reader should know of it; `report.json`.
#[derive(Serialize)]
pub(super) struct Report {
    #[serde(flatten)]
    made_with: MadeWith,
    /// What 2π would be in the PNGs of phases.
    phase_png_2pi: u32,
    scene: String,
    pupil_mm: f32,
    pub(super) width_px: usize,
    pub(super) height_px: usize,
    pub(super) amplitude_constant: f32,
    /// Of colours that are lit.
    clipped_share: f32,
    /// Of the lit colour that has most, the share of phases that the panel has no level near.
    unreachable_share: f32,
    depth_missing_px: usize,
    depth_clamped_far_px: usize,
    depth_clamped_near_px: usize,
    colour_clipped_px: usize,
    /// Those of them that were brighter than white.
    colour_above_white_px: usize,
    padded_px: usize,
    /// Of the scene, not of what was padded.
    depth_least_dpt: f64,
    depth_greatest_dpt: f64,
    /// How the hologram was computed.
    engine: String,
    /// From picture to panel levels.
    frame_ms: f64,
    /// From the command's beginning until everything but this report was written.
    total_ms: f64,
    files: [&'static str; 5],
}

pub(super) fn render(args: &RenderArgs) -> Result<(), Failure> {
    let rig = setup::rig_to_show(&args.rig, &args.network)?;
    let began = Instant::now();
    let pupil = match (&args.focal_stack, args.pupil) {
        (Some(directory), _) => return focal_stack::render(args, &rig, directory, began),
        (None, Some(pupil)) => pupil,
        (None, None) => return Err(Failure::new(Exit::Usage, "--pupil MM is missing")),
    };
    let staging = Staging::new(&args.out, &FILES, args.force)?;
    let Computed { mut renderer, mut report, optics, .. } = compute(&rig, &args.scene, pupil, args.backend)?;
    let hologram = StoredHologram {
        hologram: renderer.hologram().map_err(Failure::because(Exit::Unavailable))?.clone(),
        pupil,
        optics,
        amplitude_constant: report.amplitude_constant,
        rig: Some(RigHash::of(&rig.provenance)),
    };
    save(&hologram, renderer.pattern().map_err(Failure::because(Exit::Unavailable))?, &staging)?;
    report.total_ms = began.elapsed().as_secs_f64() * 1e3;
    results::save_json(&report, &staging.path(FILES[4]))?;
    staging.commit()?;
    if args.json {
        return results::print_json(&report);
    }
    let cards = args.scene.scene.is_none().then(|| {
        let [near, far] = [NEAR_CARD, FAR_CARD].map(|card| refocus::depth_on(&rig.geometry, card).0);
        format!("; its cards stand at {near:.2} and {far:.2} dpt")
    });
    results::print(&format!(
        "{}: hologram of {}x{} for a pupil of {} mm in {:.0} ms, {:.1} s with all else; {:.3} % of amplitudes clipped\n\
         depth {:.2} to {:.2} dpt{}; pixels filled {}, clamped to the far end {}, to the near end {}, with colours \
         clipped {}, padded {}\n\
         in {}: {}",
        report.scene,
        report.width_px,
        report.height_px,
        report.pupil_mm,
        report.frame_ms,
        report.total_ms / 1e3,
        report.clipped_share * 100.0,
        report.depth_least_dpt,
        report.depth_greatest_dpt,
        cards.unwrap_or_default(),
        report.depth_missing_px,
        report.depth_clamped_far_px,
        report.depth_clamped_near_px,
        report.colour_clipped_px,
        report.padded_px,
        args.out.display(),
        FILES.join(", ")
    ))
}

/// A scene's first frame on its way to the panel.
pub(super) struct Computed {
    /// Holds the hologram and its phases.
    renderer: Box<dyn Renderer>,
    pub(super) encoder: Arc<PanelEncoder>,
    pub(super) levels: LevelsFrame,
    pub(super) optics: BenchOptics,
    pub(super) report: Report,
}

/// Computes the scene's first frame, for other commands too.
pub(super) fn compute(
    rig: &Rig,
    named: &SceneArgs,
    pupil: PupilDiameter,
    backend: Backend,
) -> Result<Computed, Failure> {
    let weights = progress::during("loading the network", || setup::weights_for_one_pupil(rig))?;
    setup::check_pupil(&weights, &rig.geometry, pupil)
        .map_err(|why| Failure::new(Exit::Usage, format!("--pupil: {why}")))?;
    let frames = progress::during("loading the scene", || scene::first_frame(named, &rig.geometry))?;
    let resolution = frames.resolution();
    let encoder = renderer::panel_encoder(rig, resolution)?;
    let mut renderer = progress::during(&format!("preparing the network for {resolution}"), || {
        renderer::open(backend, &weights, rig, &encoder, &Use::Command)
    })?;
    tracing::info!("holograms are computed by {}", renderer.description());
    let mut levels = LevelsFrame::new(encoder.layout());
    let began = Instant::now();
    let rendered = progress::during(&format!("computing the hologram of {resolution}"), || {
        renderer.render(&frames.frames[0], pupil, &mut levels).map_err(Failure::because(Exit::Unavailable))
    })?;
    let frame_ms = began.elapsed().as_secs_f64() * 1e3;
    let clipped_share = rendered.clipped_where_lit(rig.light());
    if let Some(fault) = renderer::clipping_fault(clipped_share) {
        tracing::warn!("{fault}");
    }
    renderer::check_last_hologram(&mut *renderer)?;
    let done = &frames.reports[0];
    let [depth_least_dpt, depth_greatest_dpt] = done.depth_range.map(|depth| rig.geometry.depth_at(f64::from(depth)).0);
    let report = Report {
        made_with: MadeWith::of(rig, &weights),
        phase_png_2pi: files::PHASE_LEVELS,
        scene: frames.name.clone(),
        pupil_mm: pupil.mm(),
        width_px: resolution.width,
        height_px: resolution.height,
        amplitude_constant: weights.config().amplitude_constant,
        clipped_share,
        unreachable_share: rendered.unreachable_where_lit(rig.light()),
        depth_missing_px: done.depth_missing_px,
        depth_clamped_far_px: done.depth_clamped_far_px,
        depth_clamped_near_px: done.depth_clamped_near_px,
        colour_clipped_px: done.colour_clipped.in_all(),
        colour_above_white_px: done.colour_clipped.above_white_px,
        padded_px: done.padded_px,
        depth_least_dpt,
        depth_greatest_dpt,
        engine: renderer.description().to_owned(),
        frame_ms,
        total_ms: 0.0,
        files: FILES,
    };
    let optics = BenchOptics::of(&DisplayGeometry { resolution, ..rig.geometry });
    Ok(Computed { renderer, encoder, levels, optics, report })
}
