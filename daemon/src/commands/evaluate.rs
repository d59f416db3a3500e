//! `holod evaluate`: how good weights are, judged by what an eye sees of the panel's levels on held-out scenes.

use holod_calibration::{PupilDiameter, Resolution};
use holod_model::LinearImage;
use indicatif::{ProgressBar, ProgressStyle};

use crate::cli::EvaluateArgs;
use crate::evaluation::{
    Estimate, Evaluated, Evaluation, EvaluationPlan, EvaluationSettings, MarksRow, MarksViews, Matrix, RefocusRow, Row,
    SceneViews,
};
use crate::failure::Failure;
use crate::made_with::MadeWith;
use crate::pictures::{Sheet, Tile, screen_picture};
use crate::staging::Staging;
use crate::{results, setup};

/// Scenes on the sheet.
const SHEET_SCENES: usize = 2;
/// Pupils on the sheet, where they were judged; the narrowest and the widest otherwise.
const SHEET_PUPILS_MM: [f32; 2] = [2.0, 4.0];

pub(super) fn evaluate(args: &EvaluateArgs) -> Result<(), Failure> {
    let rig = setup::rig_to_show(&args.rig, &args.network)?;
    let plan = EvaluationPlan::new(EvaluationSettings {
        rig: &rig,
        backend: args.backend,
        scenes: &args.scenes,
        cards: args.cards.as_deref(),
        marks: args.marks.as_deref(),
        pupils: &args.pupil,
        limit: args.limit,
        border_px: args.border_px,
    })?;
    let staging =
        args.out.as_deref().map(|out| Staging::new(out, &["evaluation.json", "sheet.png"], args.force)).transpose()?;

    let progress = progress_bar(plan.steps());
    let evaluated = plan.judge(SHEET_SCENES, || {
        progress.inc(1);
        Ok(())
    })?;
    let evaluation = &evaluated.evaluation;
    progress.finish_and_clear();
    if let Some(staging) = staging {
        results::save_json(evaluation, &staging.path("evaluation.json"))?;
        results::save_png(sheet(&evaluated).draw(), &staging.path("sheet.png"))?;
        staging.commit()?;
    }
    if args.json { results::print_json(evaluation) } else { results::print(&table(evaluation)) }
}

fn progress_bar(scenes: usize) -> ProgressBar {
    let style =
        ProgressStyle::with_template("{bar:40} {pos}/{len} scenes, {eta} left").expect("the template is constant");
    ProgressBar::new(scenes as u64).with_style(style)
}

/// The pupils that the sheet shows.
fn sheet_pupils(pupils: &[PupilDiameter]) -> Vec<usize> {
    let of = |wanted_mm: &f32| pupils.iter().position(|pupil| (pupil.mm() - wanted_mm).abs() < 1e-4);
    match SHEET_PUPILS_MM.iter().map(of).collect::<Option<Vec<_>>>() {
        Some(found) => found,
        None => {
            let by_size = |a: &usize, b: &usize| pupils[*a].mm().total_cmp(&pupils[*b].mm());
            let [narrowest, widest] = [(0..pupils.len()).min_by(by_size), (0..pupils.len()).max_by(by_size)];
            let mut ends: Vec<_> = narrowest.into_iter().chain(widest).collect();
            ends.dedup();
            ends
        }
    }
}

fn sheet(evaluated: &Evaluated) -> Sheet {
    let Evaluated { evaluation, pupils, scene_views, card_views, marks_views } = evaluated;
    let chosen = sheet_pupils(pupils);
    let tile = |caption: String, picture: &LinearImage| Tile { caption, picture: screen_picture(picture) };
    let mut rows = Vec::new();
    let of_scenes = scene_views.iter().map(|SceneViews { index, views }| (format!("scene {index}"), views));
    let of_marks = marks_views.iter().map(|MarksViews { marks, views }| (marks.name().to_owned(), views));
    for (what, views) in of_scenes.chain(of_marks) {
        for &number in &chosen {
            let (view, pupil_mm) = (&views[number], pupils[number].mm());
            rows.push(vec![
                tile(format!("{what}, {pupil_mm} mm: target far"), &view.target_far),
                tile("holod far".into(), &view.seen_far),
                tile("target near".into(), &view.target_near),
                tile("holod near".into(), &view.seen_near),
            ]);
        }
    }
    let shown: Vec<f32> = chosen.iter().map(|&number| pupils[number].mm()).collect();
    for (refocus, [near, far]) in card_views.iter().filter(|(refocus, _)| shown.contains(&refocus.pupil_mm)) {
        rows.push(vec![
            tile(format!("cards, {}, {} mm: holod near", refocus.contrast, refocus.pupil_mm), near),
            tile("holod far".into(), far),
        ]);
    }
    Sheet {
        title: format!("What an eye sees of the panel's levels: weights {}", evaluation.made_with.weights),
        rows,
        footer: vec!["Far and near: focused at the first and the last plane of the stack, or at the cards.".into()],
    }
}

fn table(evaluation: &Evaluation) -> String {
    let mut text = head(evaluation);
    evaluation.rows.iter().for_each(|row| text.push_str(&pupil_row(row)));
    text.push_str(&matrix(&evaluation.matrix));
    text.push_str(&refocus(&evaluation.refocus));
    text.push_str(&marks(&evaluation.marks));
    text
}

/// What was judged, and the columns' names and units.
fn head(evaluation: &Evaluation) -> String {
    let Evaluation { scenes, border_px, panel_bit_depth, made_with, engine, .. } = evaluation;
    let MadeWith { weights, rig, .. } = made_with;
    let colours: Vec<&str> = evaluation.colours.iter().map(|colour| colour.name()).collect();
    let size = Resolution { width: evaluation.width_px, height: evaluation.height_px };
    let focus = &evaluation.focus_dpt;
    format!(
        "weights {weights} on {scenes} scenes of {size}, {} planes from {:.2} to {:.2} dpt, {panel_bit_depth}-bit levels; \
         a border of {border_px} px is left out\n\
         rig {rig}, judged in {}; computed by {engine}\n\
         mean over scenes ± half of its confidence interval ({})\n\n\
         {:>8} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>11}\n\
         {:>8} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>11}\n",
        focus.len(),
        focus.iter().copied().fold(f64::INFINITY, f64::min),
        focus.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        colours.join(", "),
        evaluation.confidence,
        "pupil",
        "PSNR",
        "in focus",
        "out of focus",
        "slope",
        "correlation",
        "SSIM",
        "foam",
        "flat oracle",
        "clipped",
        "mm",
        "dB",
        "dB",
        "dB",
        "",
        "",
        "",
        "0.001",
        "dB",
        "%",
    )
}

fn pupil_row(row: &Row) -> String {
    let scaled = |estimate: Option<Estimate>, scale: f64, decimals: usize| {
        estimate.map_or("none".to_owned(), |Estimate { mean, ci95_half_width, .. }| {
            let mean = scale * mean;
            match ci95_half_width {
                Some(half_width) => format!("{mean:.decimals$} ± {:.decimals$}", scale * half_width),
                None => format!("{mean:.decimals$}"),
            }
        })
    };
    let figure = |estimate, decimals| scaled(estimate, 1.0, decimals);
    let clipped = row.clipped_share.map_or("none".to_owned(), |share| format!("{:.3}", 100.0 * share.mean));
    format!(
        "{:>8} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {clipped:>11}\n",
        row.pupil_mm,
        figure(row.psnr_db, 2),
        figure(row.psnr_in_focus_db, 2),
        figure(row.psnr_out_of_focus_db, 2),
        figure(row.slope, 3),
        figure(row.correlation, 3),
        figure(row.ssim, 3),
        scaled(row.foam, 1e3, 2),
        figure(row.flat_oracle_psnr_db, 2),
    )
}

fn matrix(Matrix { given_pupil_mm, judged_pupil_mm, psnr_db }: &Matrix) -> String {
    let mut text =
        "\nPSNR / dB of what is made for one pupil (rows) and seen by another (columns)\n        ".to_owned();
    text.extend(judged_pupil_mm.iter().map(|pupil_mm| format!("{:>10}", format!("{pupil_mm} mm"))));
    for (given_mm, line) in given_pupil_mm.iter().zip(psnr_db) {
        text.push_str(&format!("\n{:>8}", format!("{given_mm} mm")));
        text.extend(line.iter().map(|psnr_db| format!("{psnr_db:>10.2}")));
    }
    text
}

/// Nothing where no cards were judged.
fn refocus(rows: &[RefocusRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut text = "\n\nrefocus ratio: a card's gradient energy in focus over out of focus\n".to_owned();
    text.push_str(&format!("{:>8}{:>18}{:>12}{:>12}", "pupil mm", "marks", "near card", "far card"));
    for RefocusRow { contrast, pupil_mm, near_card, far_card, .. } in rows {
        text.push_str(&format!("\n{pupil_mm:>8}{contrast:>18}{near_card:>12.2}{far_card:>12.2}"));
    }
    text
}

/// Nothing where no marks were judged.
fn marks(rows: &[MarksRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut text = "\n\nbright marks on exact black: all light seen over what was put in, and mean light of what is \
                    black, in thousandths of white\n"
        .to_owned();
    text.push_str(&format!("{:>8}{:>18}{:>12}{:>12}", "pupil mm", "marks", "light", "black"));
    for MarksRow { marks, pupil_mm, light_ratio, dark_mean, .. } in rows {
        text.push_str(&format!("\n{pupil_mm:>8}{marks:>18}{light_ratio:>12.3}{:>12.4}", 1e3 * dark_mean));
    }
    text
}
