//! The judgement of weights on folders of scenes, from opening them to means over all.

use std::collections::HashMap;
use std::path::Path;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, DisplayGeometry, PupilDiameter};
use holod_model::metrics::StackScore;
use holod_model::scene_shard::{Marks, SceneKind, SceneShard, SceneShardError};
use holod_model::{LinearImage, Weights};
use serde::Serialize;

use super::{EndViews, Estimate, Judge, JudgedScene, MarksLight, Refocus, lit_colours};
use crate::cli::Backend;
use crate::failure::{Exit, Failure};
use crate::made_with::MadeWith;
use crate::setup;

/// SSIM's window must fit between the borders.
const SMALLEST_JUDGED_PX: usize = 11;

/// What is judged, and how.
#[derive(Clone, Copy)]
pub struct EvaluationSettings<'a> {
    /// The rig, whose panel the levels are for, and whose weights are judged.
    pub rig: &'a Rig,
    /// Engine for the network.
    pub backend: Backend,
    /// Folder of held-out scenes.
    pub scenes: &'a Path,
    /// Folder of refocus cards.
    pub cards: Option<&'a Path>,
    /// Folder of bright marks on exact black.
    pub marks: Option<&'a Path>,
    /// Pupils to judge, among those of the scenes; all of these where there are none.
    pub pupils: &'a [PupilDiameter],
    /// Judge no more scenes than this.
    pub limit: Option<usize>,
    /// Pixels at each edge that are not judged.
    pub border_px: usize,
}

/// Weights and scenes that are known to fit each other.
pub struct EvaluationPlan<'a> {
    settings: EvaluationSettings<'a>,
    made_with: MadeWith,
    colours: Vec<Colour>,
    weights: Weights,
    shards: Vec<SceneShard>,
    cards: Vec<SceneShard>,
    marks: Vec<SceneShard>,
    pupils: Vec<PupilDiameter>,
}

/// The figures, and pictures to look at.
pub struct Evaluated {
    /// Every figure, as `holod evaluate --json` writes it.
    pub evaluation: Evaluation,
    /// The pupils that were judged.
    pub pupils: Vec<PupilDiameter>,
    /// What is seen of the first scenes.
    pub scene_views: Vec<SceneViews>,
    /// What each pupil sees of the first cards of each contrast, focused near and far.
    pub card_views: Vec<(Refocus, [LinearImage; 2])>,
    /// What is seen of the first scene of each kind of marks.
    pub marks_views: Vec<MarksViews>,
}

/// What is seen of one scene of marks.
pub struct MarksViews {
    /// Which marks are bright: dots, lines or stars.
    pub marks: Marks,
    /// One for each pupil.
    pub views: Vec<EndViews>,
}

/// What is seen of one scene.
pub struct SceneViews {
    /// The scene's number in its set.
    pub index: u64,
    /// One for each pupil.
    pub views: Vec<EndViews>,
}

/// `evaluation.json`. Means are over scenes, of figures in each figure's own unit: dB are averaged as dB.
#[derive(Serialize)]
pub struct Evaluation {
    /// Whose holograms were judged.
    #[serde(flatten)]
    pub made_with: MadeWith,
    /// How they were computed.
    pub engine: String,
    /// The colours that were judged: those that the panel shows and the lasers light.
    pub colours: Vec<Colour>,
    /// How many scenes were judged.
    pub scenes: usize,
    /// The ordinary scenes that were judged, by set.
    pub scene_sets: Vec<SceneSet>,
    /// Which cards were judged.
    pub card_sets: Vec<SceneSet>,
    /// Which scenes of marks were judged.
    pub mark_sets: Vec<SceneSet>,
    /// Width of the scenes.
    pub width_px: usize,
    /// Height of the scenes.
    pub height_px: usize,
    /// Where their stacks are focused.
    pub focus_dpt: Vec<f64>,
    /// Pixels at each edge that were not judged.
    pub border_px: usize,
    /// Bits of the panel's levels.
    pub panel_bit_depth: u8,
    /// Amplitude that double phase maps to 1.
    pub amplitude_constant: f32,
    /// What the intervals of the figures are.
    pub confidence: &'static str,
    /// One for each pupil.
    pub rows: Vec<Row>,
    /// Holograms made for one pupil and seen by another.
    pub matrix: Matrix,
    /// Refocus ratios of the cards.
    pub refocus: Vec<RefocusRow>,
    /// Light of bright marks on exact black.
    pub marks: Vec<MarksRow>,
}

/// Scenes of one kind and seed, as `holod-scenes generate` makes them.
#[derive(Debug, PartialEq, Serialize)]
pub struct SceneSet {
    /// `test`, `cards` or `marks`.
    pub kind: String,
    /// The seed that all scenes of the set were generated from.
    pub seed: u64,
    /// The scenes' numbers, in the order in which they were judged.
    pub indices: Vec<u64>,
}

/// One contrast of cards and one pupil, which the hologram is made for and which looks: means over scenes.
#[derive(Debug, PartialEq, Serialize)]
pub struct RefocusRow {
    /// `dark on bright` or `bright on dark` ([`Refocus::contrast`]).
    pub contrast: &'static str,
    /// The pupil that the hologram is made for and seen with.
    pub pupil_mm: f32,
    /// How many scenes there are of this contrast.
    pub scenes: usize,
    /// Gradient energy of the near card in focus over that out of focus ([`Refocus::near_card`]).
    pub near_card: f64,
    /// The same of the far card ([`Refocus::far_card`]).
    pub far_card: f64,
}

/// One kind of marks and one pupil, which the hologram is made for and which looks: means over scenes.
#[derive(Serialize)]
pub struct MarksRow {
    /// `dots`, `lines` or `stars`.
    pub marks: &'static str,
    /// The pupil that the hologram is made for and seen with.
    pub pupil_mm: f32,
    /// How many scenes there are of this kind.
    pub scenes: usize,
    /// All light that is seen over what was put in: 1 is right ([`MarksLight::light_ratio`]).
    pub light_ratio: f64,
    /// Mean light of what is black, white = 1: 0 is right ([`MarksLight::dark_mean`]).
    pub dark_mean: f64,
}

/// One pupil: the hologram is made for it, and it looks. A figure that no scene has is `null`. [`StackScore`] says what
/// the figures are.
#[derive(Serialize)]
pub struct Row {
    /// The pupil that the hologram is made for and seen with.
    pub pupil_mm: f32,
    /// PSNR over all planes ([`StackScore::psnr_db`]).
    pub psnr_db: Option<Estimate>,
    /// PSNR where the target is sharp ([`StackScore::in_focus_psnr_db`]).
    pub psnr_in_focus_db: Option<Estimate>,
    /// PSNR where the target is blurred ([`StackScore::out_of_focus_psnr_db`]).
    pub psnr_out_of_focus_db: Option<Estimate>,
    /// How much of the target's refocus there is: 1 is all ([`StackScore::focus_slope`]).
    pub slope: Option<Estimate>,
    /// How well its refocus goes with the target's: 1 at best ([`StackScore::focus_correlation`]).
    pub correlation: Option<Estimate>,
    /// Structural similarity, mean over planes: 1 at best ([`StackScore::ssim`]).
    pub ssim: Option<Estimate>,
    /// Energy of structure in the blur that the target has not, white = 1 ([`StackScore::foam`]).
    pub foam: Option<Estimate>,
    /// PSNR of the target's mean at every plane ([`StackScore::flat_oracle_psnr_db`]).
    pub flat_oracle_psnr_db: Option<Estimate>,
    /// Share of amplitudes above the double phase's constant, 0..=1.
    pub clipped_share: Option<Estimate>,
}

/// Mean PSNR of what is made for the pupil of a row and seen by the pupil of a column.
#[derive(Serialize)]
pub struct Matrix {
    /// The pupils of the rows.
    pub given_pupil_mm: Vec<f32>,
    /// The pupils of the columns.
    pub judged_pupil_mm: Vec<f32>,
    /// One row for each pupil of `given_pupil_mm`, one figure in it for each of `judged_pupil_mm`.
    pub psnr_db: Vec<Vec<f64>>,
}

impl<'a> EvaluationPlan<'a> {
    /// Opens weights and scenes.
    ///
    /// # Errors
    /// They cannot be read, do not fit each other or the panel, or lack a pupil that is asked for; or the rig lights no
    /// colour.
    pub fn new(settings: EvaluationSettings<'a>) -> Result<Self, Failure> {
        let EvaluationSettings { rig, scenes, cards, marks, limit, .. } = settings;
        let colours = lit_colours(rig)?;
        let weights = setup::weights(rig)?;
        let made_with = MadeWith::of(rig, &weights);
        let shards = open(scenes, limit, rig)?;
        shards.iter().try_for_each(refuse_special)?;
        let cards = cards.map(|folder| open(folder, None, rig)).transpose()?.unwrap_or_default();
        let marks = marks.map(|folder| open(folder, None, rig)).transpose()?.unwrap_or_default();
        let pupils = judged_pupils(&shards, settings.pupils)?;
        marks.iter().try_for_each(|shard| pupil_indices(shard, &pupils).map(drop))?;
        warn_of_untrained_pupils(&weights, &rig.geometry, &pupils);
        for shard in [shards.first(), cards.first()].into_iter().flatten() {
            check_border(settings.border_px, shard)?;
        }
        Ok(Self { settings, made_with, colours, weights, shards, cards, marks, pupils })
    }

    /// How often [`Self::judge`] reports a step.
    pub fn steps(&self) -> usize {
        self.shards.len() + self.cards.len() + self.marks.len()
    }

    /// Judges, with the views of the first `views_kept` scenes and, unless that is 0, of one scene of each kind of
    /// marks. `after_step` is called after each scene, and ends it all where it fails.
    ///
    /// # Errors
    /// The engine is not to be had, a scene cannot be read, or `after_step` failed.
    pub fn judge(
        self,
        views_kept: usize,
        mut after_step: impl FnMut() -> Result<(), Failure>,
    ) -> Result<Evaluated, Failure> {
        let Self { settings, made_with, colours, weights, shards, cards, marks, pupils } = self;
        let EvaluationSettings { rig, backend, border_px, .. } = settings;
        let judge_of = |shard: &SceneShard| Judge::new(rig, &weights, backend, shard.resolution(), border_px);
        // Cards and marks first: they are few, and what is wrong with them is told before the long work.
        let (mut of_cards, mut card_views) = (Vec::new(), Vec::<(Refocus, [LinearImage; 2])>::new());
        if let Some(first) = cards.first() {
            let mut judge = judge_of(first)?;
            for shard in &cards {
                let found = judge.cards(shard, &pupils)?;
                of_cards.extend(found.iter().map(|(refocus, _)| refocus.clone()));
                if card_views.iter().all(|(refocus, _)| refocus.contrast != found[0].0.contrast) {
                    card_views.extend(found);
                }
                after_step()?;
            }
        }
        let (mut of_marks, mut marks_views) = (Vec::new(), Vec::<MarksViews>::new());
        if let Some(first) = marks.first() {
            let mut judge = judge_of(first)?;
            for shard in &marks {
                let found = judge.marks(shard, &pupil_indices(shard, &pupils)?)?;
                let (light, views): (Vec<MarksLight>, Vec<EndViews>) = found.into_iter().unzip();
                let kind = light[0].marks;
                if views_kept > 0 && marks_views.iter().all(|views| views.marks != kind) {
                    marks_views.push(MarksViews { marks: kind, views });
                }
                of_marks.push(light);
                after_step()?;
            }
        }
        let mut judge = judge_of(&shards[0])?;
        let mut judged = Vec::new();
        let mut scene_views = Vec::new();
        for shard in &shards {
            let mut scene = judge.scene(shard, &pupil_indices(shard, &pupils)?)?;
            let views = std::mem::take(&mut scene.views);
            if scene_views.len() < views_kept {
                scene_views.push(SceneViews { index: shard.index(), views });
            }
            judged.push(scene);
            after_step()?;
        }
        let evaluation = Evaluation {
            made_with,
            engine: judge.engine().to_owned(),
            colours,
            scenes: shards.len(),
            scene_sets: scene_sets(&shards),
            card_sets: scene_sets(&cards),
            mark_sets: scene_sets(&marks),
            width_px: shards[0].resolution().width,
            height_px: shards[0].resolution().height,
            focus_dpt: shards[0].focuses().iter().map(|focus| focus.0).collect(),
            border_px,
            panel_bit_depth: rig.panel.bit_depth,
            amplitude_constant: weights.config().amplitude_constant,
            confidence: "95 %, Student's t over scenes",
            rows: pupils.iter().enumerate().map(|(number, &pupil)| row(pupil, number, &judged)).collect(),
            matrix: matrix(&pupils, &judged),
            refocus: refocus_rows(&of_cards),
            marks: marks_rows(&pupils, &of_marks),
        };
        Ok(Evaluated { evaluation, pupils, scene_views, card_views, marks_views })
    }
}

/// Which scenes shards hold.
fn scene_sets(shards: &[SceneShard]) -> Vec<SceneSet> {
    let mut sets: Vec<SceneSet> = Vec::new();
    for shard in shards {
        match sets.iter_mut().find(|set| set.kind == shard.kind() && set.seed == shard.seed()) {
            Some(set) => set.indices.push(shard.index()),
            None => {
                sets.push(SceneSet { kind: shard.kind().to_owned(), seed: shard.seed(), indices: vec![shard.index()] });
            }
        }
    }
    sets
}

/// The shards of a folder, which must be held out, each scene once, and have one size and the same planes.
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
    let mut known = HashMap::new();
    for shard in &shards {
        let wrong = |what: &str, found: String, expected: String| {
            let path = shard.path().display();
            Failure::new(Exit::Data, format!("{path}: {what} is {found}; expected {expected}"))
        };
        if shard.kind() == SceneKind::Train.name() {
            let expected = "held-out scenes: networks are not judged on what they learn from; write others with \
                            `holod-scenes generate --kind test`";
            return Err(wrong("metadata `kind`", format!("`{}`", shard.kind()), expected.into()));
        }
        if let Some(same) = known.insert((shard.kind(), shard.seed(), shard.index()), shard.path()) {
            let found = format!("number {} of seed {}, as in {}", shard.index(), shard.seed(), same.display());
            let expected = "each scene once, for intervals take scenes for independent: delete one of the two";
            return Err(wrong("the scene", found, expected.into()));
        }
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

/// An error for cards and marks, of which PSNR and slope tell nothing.
fn refuse_special(shard: &SceneShard) -> Result<(), Failure> {
    match [SceneKind::Cards, SceneKind::Marks].into_iter().find(|kind| kind.name() == shard.kind()) {
        None => Ok(()),
        Some(kind) => {
            let (path, kind) = (shard.path().display(), kind.name());
            let said = format!(
                "{path}: metadata `kind` is `{kind}`; expected scenes of `holod-scenes generate --kind test`: name a \
                 folder of {kind} with --{kind}"
            );
            Err(Failure::new(Exit::Data, said))
        }
    }
}

/// The pupils that were asked for, or those of the first scene, each once.
fn judged_pupils(shards: &[SceneShard], asked: &[PupilDiameter]) -> Result<Vec<PupilDiameter>, Failure> {
    let mut pupils = Vec::<PupilDiameter>::new();
    for &pupil in if asked.is_empty() { shards[0].pupils() } else { asked } {
        if pupils.iter().all(|known| !is_same(*known, pupil)) {
            pupils.push(pupil);
        }
    }
    shards.iter().try_for_each(|shard| pupil_indices(shard, &pupils).map(drop))?;
    Ok(pupils)
}

fn is_same(one: PupilDiameter, other: PupilDiameter) -> bool {
    (one.mm() - other.mm()).abs() < 1e-4
}

/// Where a scene's stacks for `pupils` are.
fn pupil_indices(shard: &SceneShard, pupils: &[PupilDiameter]) -> Result<Vec<usize>, Failure> {
    let there = shard.pupils();
    let position = |wanted: &PupilDiameter| {
        there.iter().position(|pupil| is_same(*pupil, *wanted)).ok_or_else(|| {
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

fn check_border(border_px: usize, shard: &SceneShard) -> Result<(), Failure> {
    let size = shard.resolution();
    let most = size.width.min(size.height).saturating_sub(SMALLEST_JUDGED_PX) / 2;
    if border_px > most {
        let said = format!("--border-px: found {border_px}, expected at most {most} for scenes of {size}");
        return Err(Failure::new(Exit::Usage, said));
    }
    Ok(())
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
        foam: over_scenes(&|score| score.foam),
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

/// Means over the scenes of each kind of marks; of each scene there is one for each pupil.
fn marks_rows(pupils: &[PupilDiameter], scenes: &[Vec<MarksLight>]) -> Vec<MarksRow> {
    let mut rows = Vec::new();
    for kind in Marks::ALL {
        let of_kind: Vec<_> = scenes.iter().filter(|scene| scene[0].marks == kind).collect();
        if of_kind.is_empty() {
            continue;
        }
        for (number, pupil) in pupils.iter().enumerate() {
            let mean = |figure: &dyn Fn(&MarksLight) -> f64| {
                of_kind.iter().map(|scene| figure(&scene[number])).sum::<f64>() / of_kind.len() as f64
            };
            rows.push(MarksRow {
                marks: kind.name(),
                pupil_mm: pupil.mm(),
                scenes: of_kind.len(),
                light_ratio: mean(&|light| light.light_ratio),
                dark_mean: mean(&|light| light.dark_mean),
            });
        }
    }
    rows
}

/// Means over the scenes of each contrast, for each pupil.
fn refocus_rows(scenes: &[Refocus]) -> Vec<RefocusRow> {
    let mut rows: Vec<RefocusRow> = Vec::new();
    for &Refocus { contrast, pupil_mm, near_card, far_card } in scenes {
        match rows.iter_mut().find(|row| row.contrast == contrast && row.pupil_mm == pupil_mm) {
            Some(row) => {
                row.scenes += 1;
                let share = 1.0 / row.scenes as f64;
                row.near_card += share * (near_card - row.near_card);
                row.far_card += share * (far_card - row.far_card);
            }
            None => rows.push(RefocusRow { contrast, pupil_mm, scenes: 1, near_card, far_card }),
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cards_of_one_contrast_have_one_row_for_each_pupil() {
        let refocus = |contrast, pupil_mm, near_card, far_card| Refocus { contrast, pupil_mm, near_card, far_card };
        let rows = refocus_rows(&[
            refocus("dark on bright", 2.0, 1.0, 4.0),
            refocus("dark on bright", 4.0, 2.0, 5.0),
            refocus("bright on dark", 2.0, 3.0, 6.0),
            refocus("dark on bright", 2.0, 5.0, 8.0),
            refocus("dark on bright", 2.0, 6.0, 9.0),
        ]);
        let row = |contrast, pupil_mm, scenes, near_card, far_card| RefocusRow {
            contrast,
            pupil_mm,
            scenes,
            near_card,
            far_card,
        };
        let expected = [
            row("dark on bright", 2.0, 3, 4.0, 7.0),
            row("dark on bright", 4.0, 1, 2.0, 5.0),
            row("bright on dark", 2.0, 1, 3.0, 6.0),
        ];
        assert_eq!(rows, expected);
    }
}
