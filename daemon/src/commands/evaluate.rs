//! `holod evaluate`: how good weights are, judged by what an eye sees of the panel's levels on held-out scenes.

use std::path::Path;

use holod_calibration::rig::Rig;
use holod_calibration::{DisplayGeometry, PupilDiameter, Resolution};
use holod_model::metrics::StackScore;
use holod_model::scene_shard::{SceneShard, SceneShardError};
use holod_model::{LinearImage, Weights};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use crate::cli::EvaluateArgs;
use crate::evaluation::{EndViews, Estimate, Judge, JudgedScene, Refocus};
use crate::failure::{Exit, Failure};
use crate::pictures::{Sheet, Tile, screen_picture};
use crate::staging::Staging;
use crate::{report, setup};

/// Scenes on the sheet.
const SHEET_SCENES: usize = 2;
/// Pupils on the sheet, where they were judged; the narrowest and the widest otherwise.
const SHEET_PUPILS_MM: [f32; 2] = [2.0, 4.0];
/// SSIM's window must fit between the borders.
const SMALLEST_JUDGED_PX: usize = 11;

/// `evaluation.json`. Means are over scenes, of figures in each figure's own unit: dB are averaged as dB.
#[derive(Serialize)]
struct Evaluation {
    weights: String,
    scenes: usize,
    width_px: usize,
    height_px: usize,
    focus_dpt: Vec<f64>,
    border_px: usize,
    panel_bit_depth: u8,
    amplitude_constant: f32,
    confidence: &'static str,
    rows: Vec<Row>,
    matrix: Matrix,
    refocus: Vec<Refocus>,
}

/// One pupil: the hologram is made for it, and it looks. A figure that no scene has is `null`.
#[derive(Serialize)]
struct Row {
    pupil_mm: f32,
    psnr_db: Option<Estimate>,
    psnr_in_focus_db: Option<Estimate>,
    psnr_out_of_focus_db: Option<Estimate>,
    slope: Option<Estimate>,
    correlation: Option<Estimate>,
    ssim: Option<Estimate>,
    flat_oracle_psnr_db: Option<Estimate>,
    clipped_share: Option<Estimate>,
}

/// Mean PSNR of what is made for the pupil of a row and seen by the pupil of a column.
#[derive(Serialize)]
struct Matrix {
    given_pupil_mm: Vec<f32>,
    judged_pupil_mm: Vec<f32>,
    psnr_db: Vec<Vec<f64>>,
}

pub(super) fn evaluate(args: &EvaluateArgs) -> Result<(), Failure> {
    let rig = setup::rig_with_network(&args.rig, &args.network)?;
    let weights = setup::weights(&rig)?;
    let shards = open(&args.scenes, args.limit, &rig)?;
    let cards = args.cards.as_deref().map(|folder| open(folder, None, &rig)).transpose()?.unwrap_or_default();
    let pupils = judged_pupils(&shards, &args.pupil)?;
    warn_of_untrained_pupils(&weights, &rig.geometry, &pupils);
    let staging =
        args.out.as_deref().map(|out| Staging::new(out, &["evaluation.json", "sheet.png"], args.force)).transpose()?;

    let progress = progress_bar(shards.len() + cards.len());
    // Cards first: they are few, and what is wrong with them is told before the long work.
    let mut refocus = Vec::new();
    let mut card_views = Vec::new();
    if let Some(first) = cards.first() {
        let mut judge = self::judge(&rig, &weights, args, first)?;
        for shard in &cards {
            for (found, seen) in judge.cards(shard, &pupils)? {
                card_views.push((found.clone(), seen));
                refocus.push(found);
            }
            progress.inc(1);
        }
    }
    let mut judge = judge(&rig, &weights, args, &shards[0])?;
    let mut judged = Vec::new();
    let mut views = Vec::new();
    for shard in &shards {
        let mut scene = judge.scene(shard, &pupil_indices(shard, &pupils)?)?;
        if views.len() < SHEET_SCENES {
            views.push((shard, std::mem::take(&mut scene.views)));
        }
        scene.views.clear();
        judged.push(scene);
        progress.inc(1);
    }
    progress.finish_and_clear();

    let evaluation = Evaluation {
        weights: setup::weights_name(&rig.model.weights),
        scenes: shards.len(),
        width_px: shards[0].resolution().width,
        height_px: shards[0].resolution().height,
        focus_dpt: shards[0].focuses().iter().map(|focus| focus.0).collect(),
        border_px: args.border_px,
        panel_bit_depth: rig.panel.bit_depth,
        amplitude_constant: weights.config().amplitude_constant,
        confidence: "95 %, Student's t over scenes",
        rows: pupils.iter().enumerate().map(|(number, &pupil)| row(pupil, number, &judged)).collect(),
        matrix: matrix(&pupils, &judged),
        refocus,
    };
    if let Some(staging) = staging {
        report::save_json(&evaluation, &staging.path("evaluation.json"))?;
        let sheet = sheet(&evaluation, &pupils, &views, &card_views);
        report::save_png(&sheet.draw(), &staging.path("sheet.png"))?;
        staging.commit()?;
    }
    if args.json { report::print_json(&evaluation) } else { report::print(&table(&evaluation)) }
}

/// The shards of a folder, which must have one size and the same planes.
fn open(folder: &Path, limit: Option<usize>, rig: &Rig) -> Result<Vec<SceneShard>, Failure> {
    let shards = SceneShard::open_folder(folder, limit, &rig.geometry).map_err(|error| {
        let exit = match error {
            SceneShardError::Read { .. } | SceneShardError::Empty { .. } => Exit::NoInput,
            SceneShardError::Damaged { .. } | SceneShardError::Content { .. } => Exit::Data,
        };
        Failure::because(exit)(error)
    })?;
    let first = &shards[0];
    let panel = rig.resolution();
    for shard in &shards {
        let wrong = |what: &str, found: String, expected: String| {
            let path = shard.path().display();
            Failure::new(Exit::Data, format!("{path}: {what} is {found}; expected {expected}"))
        };
        let size = shard.resolution();
        if size != first.resolution() || shard.focuses() != first.focuses() {
            let of = |shard: &SceneShard| {
                let focus_dpt: Vec<f64> = shard.focuses().iter().map(|focus| focus.0).collect();
                format!("{} at {focus_dpt:?} dpt", shard.resolution())
            };
            let expected = format!(
                "{} as in {}: keep scenes of one kind in a folder, rendered with `--planes N` or `auto`",
                of(first),
                first.path().display()
            );
            return Err(wrong("the stacks' size", of(shard), expected));
        }
        if size.width > panel.width || size.height > panel.height {
            return Err(wrong("the scene", size.to_string(), format!("at most the panel's {panel}")));
        }
    }
    Ok(shards)
}

/// The pupils that were asked for, or those of the first scene.
fn judged_pupils(shards: &[SceneShard], asked: &[PupilDiameter]) -> Result<Vec<PupilDiameter>, Failure> {
    let pupils = if asked.is_empty() { shards[0].pupils().to_vec() } else { asked.to_vec() };
    shards.iter().try_for_each(|shard| pupil_indices(shard, &pupils).map(drop))?;
    Ok(pupils)
}

/// Where a scene's stacks for `pupils` are.
fn pupil_indices(shard: &SceneShard, pupils: &[PupilDiameter]) -> Result<Vec<usize>, Failure> {
    let there = shard.pupils();
    let position = |wanted: &PupilDiameter| {
        there.iter().position(|pupil| (pupil.mm() - wanted.mm()).abs() < 1e-4).ok_or_else(|| {
            let there_mm: Vec<f32> = there.iter().map(|pupil| pupil.mm()).collect();
            let said = format!(
                "{}: found stacks for pupils of {there_mm:?} mm; expected one for {} mm in every scene: write the \
                 scenes with `holod-scenes generate --pupils 1,2,3,4,5`, or choose among theirs with --pupil",
                shard.path().display(),
                wanted.mm()
            );
            Failure::new(Exit::Data, said)
        })
    };
    pupils.iter().map(position).collect()
}

fn warn_of_untrained_pupils(weights: &Weights, bench: &DisplayGeometry, pupils: &[PupilDiameter]) {
    let [narrowest, widest] = weights.trained_pupils(bench).map(PupilDiameter::mm);
    for pupil in pupils.iter().filter(|pupil| !(narrowest..=widest).contains(&pupil.mm())) {
        tracing::warn!(
            "on this bench the weights were trained for pupils of {narrowest:.2} to {widest:.2} mm: of {} mm the network \
             is told the nearest of these, as it would be on the display",
            pupil.mm()
        );
    }
}

fn judge(rig: &Rig, weights: &Weights, args: &EvaluateArgs, shard: &SceneShard) -> Result<Judge, Failure> {
    let size = shard.resolution();
    let most = size.width.min(size.height).saturating_sub(SMALLEST_JUDGED_PX) / 2;
    if args.border_px > most {
        let said = format!("--border-px: found {}, expected at most {most} for scenes of {size}", args.border_px);
        return Err(Failure::new(Exit::Usage, said));
    }
    Judge::new(rig, weights, args.backend, size, args.border_px)
}

fn progress_bar(scenes: usize) -> ProgressBar {
    let style =
        ProgressStyle::with_template("{bar:40} {pos}/{len} scenes, {eta} left").expect("the template is constant");
    ProgressBar::new(scenes as u64).with_style(style)
}

fn row(pupil: PupilDiameter, number: usize, judged: &[JudgedScene]) -> Row {
    let over_scenes = |figure: &dyn Fn(&StackScore) -> Option<f64>| {
        let figures: Vec<f64> = judged.iter().filter_map(|scene| figure(&scene.scores[number])).collect();
        Estimate::of(&figures)
    };
    let clipped: Vec<f64> = judged.iter().map(|scene| f64::from(scene.clipped_share[number])).collect();
    Row {
        pupil_mm: pupil.mm(),
        psnr_db: over_scenes(&|score| Some(score.psnr_db)),
        psnr_in_focus_db: over_scenes(&|score| score.in_focus_psnr_db),
        psnr_out_of_focus_db: over_scenes(&|score| score.out_of_focus_psnr_db),
        slope: over_scenes(&|score| score.focus_slope),
        correlation: over_scenes(&|score| score.focus_correlation),
        ssim: over_scenes(&|score| score.ssim),
        flat_oracle_psnr_db: over_scenes(&|score| Some(score.flat_oracle_psnr_db)),
        clipped_share: Estimate::of(&clipped),
    }
}

fn matrix(pupils: &[PupilDiameter], judged: &[JudgedScene]) -> Matrix {
    let mean = |row: usize, column: usize| {
        judged.iter().map(|scene| scene.matrix_psnr_db[row][column]).sum::<f64>() / judged.len() as f64
    };
    let pupils_mm: Vec<f32> = pupils.iter().map(|pupil| pupil.mm()).collect();
    let all = 0..pupils.len();
    Matrix {
        given_pupil_mm: pupils_mm.clone(),
        judged_pupil_mm: pupils_mm,
        psnr_db: all.clone().map(|row| all.clone().map(|column| mean(row, column)).collect()).collect(),
    }
}

/// The pupils that the sheet shows.
fn sheet_pupils(pupils: &[PupilDiameter]) -> Vec<usize> {
    let of = |wanted_mm: &f32| pupils.iter().position(|pupil| (pupil.mm() - wanted_mm).abs() < 1e-4);
    match SHEET_PUPILS_MM.iter().map(of).collect::<Option<Vec<_>>>() {
        Some(found) => found,
        None => {
            if pupils.len() > 1 {
                vec![0, pupils.len() - 1]
            } else {
                vec![0]
            }
        }
    }
}

fn sheet(
    evaluation: &Evaluation,
    pupils: &[PupilDiameter],
    scenes: &[(&SceneShard, Vec<EndViews>)],
    cards: &[(Refocus, [LinearImage; 2])],
) -> Sheet {
    let chosen = sheet_pupils(pupils);
    let tile = |caption: String, picture: &LinearImage| Tile { caption, picture: screen_picture(picture) };
    let mut rows = Vec::new();
    for (shard, views) in scenes {
        for &number in &chosen {
            let (view, pupil_mm) = (&views[number], pupils[number].mm());
            rows.push(vec![
                tile(format!("scene {}, {pupil_mm} mm: target far", shard.index()), &view.target_far),
                tile("holod far".into(), &view.seen_far),
                tile("target near".into(), &view.target_near),
                tile("holod near".into(), &view.seen_near),
            ]);
        }
    }
    let shown: Vec<f32> = chosen.iter().map(|&number| pupils[number].mm()).collect();
    for (refocus, [near, far]) in cards.iter().filter(|(refocus, _)| shown.contains(&refocus.pupil_mm)) {
        rows.push(vec![
            tile(format!("cards, {}, {} mm: holod near", refocus.contrast, refocus.pupil_mm), near),
            tile("holod far".into(), far),
        ]);
    }
    Sheet {
        title: format!("What an eye sees of the panel's levels: weights {}", evaluation.weights),
        rows,
        footer: vec!["Far and near: focused at the first and the last plane of the stack, or at the cards.".into()],
    }
}

fn table(evaluation: &Evaluation) -> String {
    let Evaluation { scenes, border_px, panel_bit_depth, weights, .. } = evaluation;
    let size = Resolution { width: evaluation.width_px, height: evaluation.height_px };
    let focus = &evaluation.focus_dpt;
    let mut text = format!(
        "weights {weights} on {scenes} scenes of {size}, {} planes from {:.2} to {:.2} dpt, {panel_bit_depth}-bit levels; \
         a border of {border_px} px is left out\n\
         mean over scenes ± half of its confidence interval ({})\n\n\
         {:>8}{:>14}{:>14}{:>14}{:>14}{:>14}{:>14}{:>14}{:>11}\n\
         {:>8}{:>14}{:>14}{:>14}{:>14}{:>14}{:>14}{:>14}{:>11}\n",
        focus.len(),
        focus.iter().copied().fold(f64::INFINITY, f64::min),
        focus.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        evaluation.confidence,
        "pupil",
        "PSNR",
        "in focus",
        "out of focus",
        "slope",
        "correlation",
        "SSIM",
        "flat oracle",
        "clipped",
        "mm",
        "dB",
        "dB",
        "dB",
        "",
        "",
        "",
        "dB",
        "%",
    );
    for row in &evaluation.rows {
        let figure = |estimate: Option<Estimate>, decimals: usize| {
            estimate.map_or("none".to_owned(), |Estimate { mean, ci95_half_width, .. }| match ci95_half_width {
                Some(half_width) => format!("{mean:.decimals$} ± {half_width:.decimals$}"),
                None => format!("{mean:.decimals$}"),
            })
        };
        let clipped = row.clipped_share.map_or("none".to_owned(), |share| format!("{:.3}", 100.0 * share.mean));
        text.push_str(&format!(
            "{:>8}{:>14}{:>14}{:>14}{:>14}{:>14}{:>14}{:>14}{clipped:>11}\n",
            row.pupil_mm,
            figure(row.psnr_db, 2),
            figure(row.psnr_in_focus_db, 2),
            figure(row.psnr_out_of_focus_db, 2),
            figure(row.slope, 3),
            figure(row.correlation, 3),
            figure(row.ssim, 3),
            figure(row.flat_oracle_psnr_db, 2),
        ));
    }
    text.push_str("\nPSNR / dB of what is made for one pupil (rows) and seen by another (columns)\n        ");
    let Matrix { given_pupil_mm, judged_pupil_mm, psnr_db } = &evaluation.matrix;
    text.extend(judged_pupil_mm.iter().map(|pupil_mm| format!("{:>10}", format!("{pupil_mm} mm"))));
    for (given_mm, line) in given_pupil_mm.iter().zip(psnr_db) {
        text.push_str(&format!("\n{:>8}", format!("{given_mm} mm")));
        text.extend(line.iter().map(|psnr_db| format!("{psnr_db:>10.2}")));
    }
    if !evaluation.refocus.is_empty() {
        text.push_str("\n\nrefocus ratio: a card's gradient energy in focus over out of focus\n");
        text.push_str(&format!("{:>8}{:>18}{:>12}{:>12}", "pupil mm", "marks", "near card", "far card"));
        for Refocus { contrast, pupil_mm, near_card, far_card } in &evaluation.refocus {
            text.push_str(&format!("\n{pupil_mm:>8}{contrast:>18}{near_card:>12.2}{far_card:>12.2}"));
        }
    }
    text
}
