//! `holod render`: one hologram and its phase patterns.

use std::time::Instant;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, DisplayGeometry, PupilDiameter};
use holod_model::files::{self, StoredHologram};
use holod_model::optics::{DoublePhase, PhasePattern};
use holod_model::weights::TrainedOptics;
use holod_model::{ComplexHologram, Weights};
use serde::Serialize;

use crate::cli::{Backend, RenderArgs, SceneArgs};
use crate::failure::{Exit, Failure};
use crate::progress;
use crate::staging::Staging;
use crate::{report, setup};

/// What was done, and what the reader should know of it; `report.json`.
#[derive(Serialize)]
struct Report {
    scene: String,
    pupil_mm: f32,
    width_px: usize,
    height_px: usize,
    amplitude_constant: f32,
    clipped_share: f32,
    depth_missing_px: usize,
    depth_clamped_far_px: usize,
    depth_clamped_near_px: usize,
    colour_clipped_px: usize,
    padded_px: usize,
    depth_least_dpt: f64,
    depth_greatest_dpt: f64,
    network_ms: f64,
    /// From the command's beginning until everything but this report was written.
    total_ms: f64,
    files: [&'static str; 5],
}

const FILES: [&str; 5] = ["field.safetensors", "phase_red.png", "phase_green.png", "phase_blue.png", "report.json"];

pub(super) fn render(args: &RenderArgs) -> Result<(), Failure> {
    let rig = setup::rig_with_network(&args.rig, &args.network)?;
    let began = Instant::now();
    let staging = Staging::new(&args.out, &FILES, args.force)?;
    let (hologram, mut report) = compute(&rig, &args.scene, args.pupil, args.backend)?;
    let mut double_phase = DoublePhase::new(hologram.hologram.resolution, hologram.amplitude_constant);
    let mut pattern = PhasePattern::flat(hologram.hologram.resolution);
    report.clipped_share = double_phase.encode(&hologram.hologram, &mut pattern).clipped_share;
    progress::during("writing the hologram", || {
        let cannot = Failure::because(Exit::CannotCreate);
        hologram.save(&staging.path(FILES[0])).map_err(&cannot)?;
        for (colour, name) in Colour::ALL.into_iter().zip(&FILES[1..4]) {
            files::save_phase(&pattern, colour, &staging.path(name)).map_err(&cannot)?;
        }
        Ok::<_, Failure>(())
    })?;
    report.total_ms = began.elapsed().as_secs_f64() * 1e3;
    report::save_json(&report, &staging.path(FILES[4]))?;
    staging.commit()?;
    if args.json {
        return report::print_json(&report);
    }
    report::print(&format!(
        "{}: hologram of {}x{} for a pupil of {} mm in {:.0} ms, {:.1} s with all else; {:.3} % of amplitudes clipped\n\
         depth {:.2} to {:.2} dpt; pixels filled {}, clamped to the far end {}, to the near end {}, padded {}\n\
         in {}: {}",
        report.scene,
        report.width_px,
        report.height_px,
        report.pupil_mm,
        report.network_ms,
        report.total_ms / 1e3,
        report.clipped_share * 100.0,
        report.depth_least_dpt,
        report.depth_greatest_dpt,
        report.depth_missing_px,
        report.depth_clamped_far_px,
        report.depth_clamped_near_px,
        report.padded_px,
        args.out.display(),
        FILES.join(", ")
    ))
}

/// The hologram of the scene's first frame.
fn compute(
    rig: &Rig,
    scene: &SceneArgs,
    pupil: PupilDiameter,
    backend: Backend,
) -> Result<(StoredHologram, Report), Failure> {
    let weights = progress::during("loading the network", || setup::weights(rig))?;
    check_pupil(&weights, pupil)?;
    let frames = progress::during("loading the scene", || setup::frames(scene, &rig.geometry))?;
    let resolution = frames.resolution();
    let mut engine = progress::during(&format!("preparing the network for {resolution}"), || {
        setup::engine(backend, &weights, resolution)
    })?;
    let mut hologram = ComplexHologram::dark(resolution);
    let began = Instant::now();
    progress::during(&format!("computing the hologram of {resolution}"), || {
        engine.render(&frames.frames[0], pupil, &mut hologram).map_err(Failure::because(Exit::Software))
    })?;
    let network_ms = began.elapsed().as_secs_f64() * 1e3;
    let amplitude_constant = weights.config().amplitude_constant;
    let done = &frames.reports[0];
    let depths = &frames.frames[0].depth_normalised;
    let depth_at = |start: f32, pick: fn(f32, f32) -> f32| {
        rig.geometry.depth_at(f64::from(depths.iter().copied().fold(start, pick))).0
    };
    let report = Report {
        scene: frames.name.clone(),
        pupil_mm: pupil.mm(),
        width_px: resolution.width,
        height_px: resolution.height,
        amplitude_constant,
        clipped_share: 0.0,
        depth_missing_px: done.depth_missing_px,
        depth_clamped_far_px: done.depth_clamped_far_px,
        depth_clamped_near_px: done.depth_clamped_near_px,
        colour_clipped_px: done.colour_clipped_px,
        padded_px: done.padded_px,
        depth_least_dpt: depth_at(f32::MAX, f32::min),
        depth_greatest_dpt: depth_at(f32::MIN, f32::max),
        network_ms,
        total_ms: 0.0,
        files: FILES,
    };
    let geometry = DisplayGeometry { resolution, ..rig.geometry };
    Ok((StoredHologram { hologram, pupil, optics: TrainedOptics::of(&geometry), amplitude_constant }, report))
}

/// The hologram of the scene's first frame, for other commands.
pub(super) fn hologram(
    rig: &Rig,
    scene: &SceneArgs,
    pupil: PupilDiameter,
    backend: Backend,
) -> Result<StoredHologram, Failure> {
    compute(rig, scene, pupil, backend).map(|(hologram, _)| hologram)
}

fn check_pupil(weights: &Weights, pupil: PupilDiameter) -> Result<(), Failure> {
    let [narrowest, widest] = weights.config().pupil_range_mm;
    if (narrowest..=widest).contains(&pupil.mm()) {
        return Ok(());
    }
    Err(Failure::new(
        Exit::Usage,
        format!(
            "--pupil: found {} mm, expected {narrowest} to {widest} mm, the pupils that these weights were trained for",
            pupil.mm()
        ),
    ))
}
