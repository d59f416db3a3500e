//! Judges weights by what an eye sees of the levels that the panel would be sent, on scenes whose thin-lens pictures
//! are known.
//!
//! Each hologram goes network → double phase → levels of the rig's panel → the phases that these show → 4f stop, pupil
//! and focus of a simulated eye. The scenes are pieces cut out of a wider view, so the eye takes the pattern as going
//! on beyond its edges ([`SimulatedEye::repeating`]), as the trainer's own evaluation does. Colours that the panel never
//! shows, or the lasers never light, are black in pictures and in targets, and no figure counts them.

mod plan;
mod statistics;

use std::sync::Arc;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, Dioptres, DisplayGeometry, PerColour, PupilDiameter, Resolution};
use holod_model::marks::{self, DarkArea};
use holod_model::metrics::{self, Part, StackScore};
use holod_model::optics::{Eye, PhasePattern, SimulatedEye};
use holod_model::refocus::{self, CardArea, FAR_CARD, NEAR_CARD};
use holod_model::scene_shard::{Marks, SceneKind, SceneShard};
use holod_model::{LinearImage, RgbdFrame, Weights};
use holod_slm_output::{LevelsFrame, PanelEncoder};

pub use plan::{
    Evaluated, Evaluation, EvaluationPlan, EvaluationSettings, MarksRow, MarksViews, Matrix, RefocusRow, Row, SceneSet,
    SceneViews,
};
pub use statistics::Estimate;

use crate::cli::Backend;
use crate::failure::{Exit, Failure};
use crate::pictures::shown_pattern;
use crate::renderer::{self, Renderer, Use};

/// PSNR of a picture that is exactly right, so that means over scenes stay finite.
const HIGHEST_PSNR_DB: f64 = 120.0;

/// Looks at scenes of one size through one bench.
pub struct Judge {
    geometry: DisplayGeometry,
    light: PerColour<f32>,
    /// The colours that the rig lights.
    colours: Vec<Colour>,
    amplitude_constant: f32,
    border_px: usize,
    renderer: Box<dyn Renderer>,
    encoder: Arc<PanelEncoder>,
    levels: LevelsFrame,
    eye: SimulatedEye,
}

/// One scene: its figures, and pictures to look at.
pub struct JudgedScene {
    /// For each pupil, how the stack made for it compares with the target for it.
    pub scores: Vec<StackScore>,
    /// PSNR of what is made for the pupil of the row and seen by the pupil of the column.
    pub matrix_psnr_db: Vec<Vec<f64>>,
    /// For each pupil, the share of amplitudes above the double phase's constant, in the colours that are judged.
    pub clipped_share: Vec<f32>,
    /// For each pupil, the pictures at the farthest and at the nearest focus.
    pub views: Vec<EndViews>,
}

/// Target and what the eye sees at both ends of a stack.
pub struct EndViews {
    /// The target focused at the first plane.
    pub target_far: LinearImage,
    /// What the eye sees there.
    pub seen_far: LinearImage,
    /// The target focused at the last plane.
    pub target_near: LinearImage,
    /// What the eye sees there.
    pub seen_near: LinearImage,
}

/// The refocus ratios of one card scene for one pupil: gradient energy in focus over out of focus.
#[derive(Clone, Debug)]
pub struct Refocus {
    /// `dark on bright` or `bright on dark`.
    pub contrast: &'static str,
    /// The pupil, which the hologram is made for and which looks.
    pub pupil_mm: f32,
    /// Ratio of the near card.
    pub near_card: f64,
    /// Ratio of the far card.
    pub far_card: f64,
}

/// The light of one scene of bright marks on exact black for one pupil, which the hologram is made for and which looks.
pub struct MarksLight {
    /// Which marks are bright: dots, lines or stars.
    pub marks: Marks,
    /// All light that is seen over what was put in.
    pub light_ratio: f64,
    /// Mean light where all is black, more than 16 px from any mark at every focus; white is 1.
    pub dark_mean: f64,
}

impl EndViews {
    /// The ends of two stacks.
    fn of(target: &[LinearImage], seen: &[LinearImage]) -> Self {
        let ends = |stack: &[LinearImage]| (stack[0].clone(), stack[stack.len() - 1].clone());
        let ((target_far, target_near), (seen_far, seen_near)) = (ends(target), ends(seen));
        Self { target_far, seen_far, target_near, seen_near }
    }
}

impl Judge {
    /// A judge of `weights` on `rig` for scenes of `resolution`, of which `border_px` at each edge are not judged.
    ///
    /// # Errors
    /// Where the rig lights no colour, the engine cannot be had, or the scenes do not fit on the panel.
    pub fn new(
        rig: &Rig,
        weights: &Weights,
        backend: Backend,
        resolution: Resolution,
        border_px: usize,
    ) -> Result<Self, Failure> {
        let colours = lit_colours(rig)?;
        let encoder = renderer::panel_encoder(rig, resolution)?;
        let renderer = renderer::open(backend, weights, rig, &encoder, &Use::Command)?;
        tracing::info!("holograms are computed by {}", renderer.description());
        Ok(Self {
            geometry: rig.geometry,
            light: rig.light(),
            colours,
            amplitude_constant: weights.config().amplitude_constant,
            border_px,
            renderer,
            levels: LevelsFrame::new(encoder.layout()),
            encoder,
            eye: SimulatedEye::repeating(&rig.geometry, resolution),
        })
    }

    /// How holograms are computed.
    pub fn engine(&self) -> &str {
        self.renderer.description()
    }

    /// Judges a scene with the stacks `pupil_indices` of the shard, each made for its pupil and seen by every one.
    ///
    /// # Errors
    /// Where the shard cannot be read.
    pub fn scene(&mut self, shard: &SceneShard, pupil_indices: &[usize]) -> Result<JudgedScene, Failure> {
        let frame = Arc::new(shard.frame().map_err(Failure::because(Exit::Data))?);
        let pupils: Vec<PupilDiameter> = pupil_indices.iter().map(|&index| shard.pupils()[index]).collect();
        let mut shown = Vec::new();
        for &pupil in &pupils {
            shown.push(self.shown(&frame, pupil)?);
        }
        let mut judged = JudgedScene {
            scores: Vec::new(),
            matrix_psnr_db: vec![Vec::new(); pupils.len()],
            clipped_share: shown.iter().map(|(_, clipped_share)| *clipped_share).collect(),
            views: Vec::new(),
        };
        for (column, (&pupil, &index)) in pupils.iter().zip(pupil_indices).enumerate() {
            let target = self.target(shard, index)?;
            for (row, (pattern, _)) in shown.iter().enumerate() {
                let seen = self.look(pattern, pupil, shard.focuses());
                let psnr_db = metrics::stack_psnr_db(&seen, &target, self.part()).min(HIGHEST_PSNR_DB);
                judged.matrix_psnr_db[row].push(psnr_db);
                if row == column {
                    judged.scores.push(self.score(&seen, &target, shard, &frame, pupil));
                    judged.views.push(EndViews::of(&target, &seen));
                }
            }
        }
        Ok(judged)
    }

    /// Judges how a scene of [`SceneKind::Cards`] refocuses, and returns what each pupil sees of it, focused near and
    /// far.
    ///
    /// # Errors
    /// Where the shard cannot be read, is of another kind or too small for cards.
    pub fn cards(
        &mut self,
        shard: &SceneShard,
        pupils: &[PupilDiameter],
    ) -> Result<Vec<(Refocus, [LinearImage; 2])>, Failure> {
        require_kind(shard, SceneKind::Cards)?;
        let frame = Arc::new(shard.frame().map_err(Failure::because(Exit::Data))?);
        let depth_on_bench = |card: Dioptres| refocus::depth_on(&self.geometry, card);
        let area = |name: &str, card: Dioptres| {
            CardArea::find(&frame.depth_normalised, shard.resolution(), card, self.border_px).ok_or_else(|| {
                let found = format!("no {name} card at {:.2} dpt in {}", depth_on_bench(card).0, shard.resolution());
                wrong(shard, SceneKind::Cards, &found, "a larger scene")
            })
        };
        let (near, far) = (area("near", NEAR_CARD)?, area("far", FAR_CARD)?);
        let focuses = [NEAR_CARD, FAR_CARD].map(depth_on_bench);
        let contrast = if shard.index().is_multiple_of(2) { "dark on bright" } else { "bright on dark" };
        let mut found = Vec::new();
        for &pupil in pupils {
            let (pattern, _) = self.shown(&frame, pupil)?;
            let views = focuses.map(|focus| self.view(&pattern, Eye { pupil, focus }));
            let [near_focus, far_focus] = &views;
            let ratio = |area: &CardArea, sharp, soft| area.gradient_energy(sharp) / area.gradient_energy(soft);
            let ratios = Refocus {
                contrast,
                pupil_mm: pupil.mm(),
                near_card: ratio(&near, near_focus, far_focus),
                far_card: ratio(&far, far_focus, near_focus),
            };
            found.push((ratios, views));
        }
        Ok(found)
    }

    /// Judges how much light a scene of [`SceneKind::Marks`] shows, and where, with the stacks `pupil_indices` of the
    /// shard, each made for its pupil and seen by it, and returns what each pupil sees. No border is left out.
    ///
    /// # Errors
    /// Where the shard cannot be read, is of another kind or too small for marks and black.
    pub fn marks(
        &mut self,
        shard: &SceneShard,
        pupil_indices: &[usize],
    ) -> Result<Vec<(MarksLight, EndViews)>, Failure> {
        require_kind(shard, SceneKind::Marks)?;
        let wrong = |found: &str, expected: &str| wrong(shard, SceneKind::Marks, found, expected);
        let frame = Arc::new(shard.frame().map_err(Failure::because(Exit::Data))?);
        let mut found = Vec::new();
        for &index in pupil_indices {
            let target = self.target(shard, index)?;
            if !marks::is_lit(&target) {
                return Err(wrong(&format!("no mark in {}", shard.resolution()), "a scene of 96x120 pixels or more"));
            }
            let dark = DarkArea::find(&target).ok_or_else(|| {
                wrong(&format!("nothing that stays black in {}", shard.resolution()), "a larger scene")
            })?;
            let pupil = shard.pupils()[index];
            let (pattern, _) = self.shown(&frame, pupil)?;
            let seen = self.look(&pattern, pupil, shard.focuses());
            let light = MarksLight {
                marks: Marks::of_index(shard.index()),
                light_ratio: marks::light_ratio(&seen, &target),
                dark_mean: dark.mean_light(&seen, &self.colours),
            };
            found.push((light, EndViews::of(&target, &seen)));
        }
        Ok(found)
    }

    /// The phases that the panel's levels show of the hologram of `frame` for `pupil`, and the share that was clipped.
    fn shown(&mut self, frame: &Arc<RgbdFrame>, pupil: PupilDiameter) -> Result<(PhasePattern, f32), Failure> {
        let unavailable = Failure::because(Exit::Unavailable);
        self.renderer.render(frame, pupil, &mut self.levels).map_err(&unavailable)?;
        let hologram = self.renderer.hologram().map_err(&unavailable)?;
        renderer::check_numbers(hologram)?;
        let largest = self.amplitude_constant * self.amplitude_constant;
        let clipped = |&colour: &Colour| hologram.plane(colour).iter().filter(|a| a.norm_sqr() > largest).count();
        let clipped = self.colours.iter().map(clipped).sum::<usize>();
        let clipped_share = clipped as f32 / (self.colours.len() * hologram.resolution.pixels()) as f32;
        Ok((shown_pattern(&self.encoder, &self.levels), clipped_share))
    }

    /// Stack number `index` of a shard, black in colours without light.
    fn target(&self, shard: &SceneShard, index: usize) -> Result<Vec<LinearImage>, Failure> {
        let mut stack = shard.stack(index).map_err(Failure::because(Exit::Data))?;
        for colour in Colour::ALL.into_iter().filter(|colour| !self.colours.contains(colour)) {
            stack.iter_mut().for_each(|picture| picture.plane_mut(colour).fill(0.0));
        }
        Ok(stack)
    }

    fn part(&self) -> Part<'_> {
        Part { colours: &self.colours, border_px: self.border_px }
    }

    fn look(&mut self, pattern: &PhasePattern, pupil: PupilDiameter, focuses: &[Dioptres]) -> Vec<LinearImage> {
        focuses.iter().map(|&focus| self.view(pattern, Eye { pupil, focus })).collect()
    }

    fn view(&mut self, pattern: &PhasePattern, eye: Eye) -> LinearImage {
        self.eye.view_weighted(pattern, self.amplitude_constant, eye, self.light)
    }

    fn score(
        &self,
        seen: &[LinearImage],
        target: &[LinearImage],
        shard: &SceneShard,
        frame: &RgbdFrame,
        pupil: PupilDiameter,
    ) -> StackScore {
        let score = metrics::score_stack(
            seen,
            target,
            shard.focuses(),
            &frame.depth_normalised,
            &self.geometry,
            pupil,
            self.part(),
        );
        StackScore {
            psnr_db: score.psnr_db.min(HIGHEST_PSNR_DB),
            in_focus_psnr_db: score.in_focus_psnr_db.map(|psnr_db| psnr_db.min(HIGHEST_PSNR_DB)),
            out_of_focus_psnr_db: score.out_of_focus_psnr_db.map(|psnr_db| psnr_db.min(HIGHEST_PSNR_DB)),
            flat_oracle_psnr_db: score.flat_oracle_psnr_db.min(HIGHEST_PSNR_DB),
            ..score
        }
    }
}

/// The colours that the panel shows and the lasers light.
fn lit_colours(rig: &Rig) -> Result<Vec<Colour>, Failure> {
    let colours: Vec<Colour> =
        rig.light().iter().filter(|(_, light)| **light > 0.0).map(|(colour, _)| colour).collect();
    if colours.is_empty() {
        let said = "found no colour that the panel shows and the lasers light, expected at least one to judge: in the \
                    rig, give lasers.power_mw of a colour that the panel shows more than 0";
        return Err(Failure::new(Exit::Config, said));
    }
    Ok(colours)
}

fn require_kind(shard: &SceneShard, kind: SceneKind) -> Result<(), Failure> {
    if shard.kind() == kind.name() {
        return Ok(());
    }
    Err(wrong(shard, kind, &format!("a scene of the kind `{}`", shard.kind()), "one"))
}

/// What is said of a shard that should hold a scene of `kind`.
fn wrong(shard: &SceneShard, kind: SceneKind, found: &str, expected: &str) -> Failure {
    let (path, kind) = (shard.path().display(), kind.name());
    Failure::new(
        Exit::Data,
        format!("{path}: found {found}; expected {expected} of `holod-scenes generate --kind {kind}`"),
    )
}
