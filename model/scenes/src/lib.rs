//! Scenes of our own making and their thin-lens images: what a network learns from, is judged by and is shown with.
//!
//! A [`Scene`] is a set of textured surfaces between infinity and the near end of the depth range. Its
//! [`picture`](Scene::picture) is what a pinhole sees; its [`focal_stack`](Scene::focal_stack) is what an eye with a
//! round pupil sees at each focus. Light is linear throughout. [`shard`] writes scenes as files, for the
//! trainer and for `holod evaluate`; so does the program `holod-scenes`, on the processor or on a graphics processor.
//! The daemon shows [`sample_scene`].

mod compose;
mod demo;
mod families;
mod generation;
mod glyphs;
#[cfg(feature = "gpu")]
mod gpu;
mod grid;
mod meshes;
mod noise;
mod points;
mod random;
mod rooms;
mod shadow;
pub mod shard;
mod stage;
mod surface;
#[cfg(test)]
mod tests;
mod texture;
mod thin_lens;
mod tracer;
mod view;

use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter, Resolution};
use holod_model::gpu::GpuError;
use holod_model::scene_shard::{Marks, SceneKind};

pub use generation::generator;
pub use noise::Noise;
use surface::Surface;
use thin_lens::PixelSamples;
pub use tracer::Tracer;

/// A pinhole picture with its depth.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Linear light, [3, height, width], 0..=1.
    pub image: Vec<f32>,
    /// Normalised depth, [height, width]: 0 far, 1 near, uniform in dioptres.
    pub depth: Vec<f32>,
}

/// What scenes are laid out for where nobody asks for more.
const USUAL_PUPIL: PupilDiameter = PupilDiameter::from_mm(8.0);

/// Textured surfaces between infinity and the near end of [`DisplayGeometry::DEFAULT`]'s depth range, laid out for one
/// resolution.
pub struct Scene {
    surfaces: Vec<Surface>,
    resolution: Resolution,
    ray_key: u64,
    pixel_samples: PixelSamples,
}

/// The built-in demonstration: text cards near on the left and far on the right, objects between them, a checkered
/// floor through all depths. It fills a picture of any resolution.
pub fn sample_scene(resolution: Resolution) -> Scene {
    Scene { surfaces: demo::surfaces(resolution), resolution, ray_key: 0, pixel_samples: PixelSamples::Grid }
}

impl Scene {
    /// A scene that depends on its arguments alone, for pupils of up to 8 mm.
    pub fn random(kind: SceneKind, seed: u64, index: u64, resolution: Resolution) -> Self {
        Self::random_for(kind, seed, index, resolution, USUAL_PUPIL)
    }

    /// The same for pupils of up to `widest`. A pupil wider than 8 mm meets gentler slopes and a larger background, for
    /// its rays reach farther.
    pub fn random_for(kind: SceneKind, seed: u64, index: u64, resolution: Resolution, widest: PupilDiameter) -> Self {
        let (surfaces, pixel_samples) = match kind {
            SceneKind::Cards => {
                let drawn = generation::drawn(kind, seed, index);
                let cards = compose::refocus_cards(index.is_multiple_of(2), drawn, resolution, widest);
                (cards, PixelSamples::Grid)
            }
            SceneKind::Marks => {
                let drawn = generation::drawn(kind, seed, index);
                let marks = compose::bright_marks(Marks::of_index(index), drawn, resolution, widest);
                (marks, PixelSamples::Grid)
            }
            SceneKind::Train | SceneKind::Test => {
                (compose::random_surfaces(kind, seed, index, resolution, widest), PixelSamples::Lattice)
            }
        };
        let ray_key = random::mix(random::mix(seed) ^ random::stream(kind) ^ index);
        Self { surfaces, resolution, ray_key, pixel_samples }
    }

    /// The refocus test: see [`SceneKind::Cards`].
    pub fn cards(dark_on_bright: bool, resolution: Resolution) -> Self {
        Self::random(SceneKind::Cards, 0, u64::from(!dark_on_bright), resolution)
    }

    /// The resolution that the scene was laid out for.
    pub fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// What a pinhole sees: each pixel's mean colour, and the depth along its central ray.
    pub fn picture(&self) -> Picture {
        let (image, depth_dpt) = thin_lens::pinhole(&self.surfaces, self.resolution, self.pixel_samples);
        let normalised = |depth: f32| DisplayGeometry::DEFAULT.normalised_depth(Dioptres(f64::from(depth))) as f32;
        Picture { image, depth: depth_dpt.into_iter().map(|depth| normalised(depth).clamp(0.0, 1.0)).collect() }
    }

    /// Thin-lens images, [planes, 3, height, width] in linear light, for one pupil and each focus, averaged over at
    /// least `rays` rays a pixel. Each point blurs to a disc of diameter [`DisplayGeometry::coc_px`].
    pub fn focal_stack(&self, pupil: PupilDiameter, focus: &[Dioptres], rays: usize) -> Vec<f32> {
        self.focal_stacks(&[pupil], focus, rays).swap_remove(0)
    }

    /// [`focal_stack`](Self::focal_stack) for several pupils at less than the cost of each alone: the rays of narrower
    /// pupils serve the wider ones too.
    pub fn focal_stacks(&self, pupils: &[PupilDiameter], focus: &[Dioptres], rays: usize) -> Vec<Vec<f32>> {
        let (stacks, _) =
            self.traced_focal_stacks(&Tracer::cpu(), pupils, focus, rays).expect("the processor has no errors");
        stacks
    }

    /// [`focal_stacks`](Self::focal_stacks) by a tracer, and the number of rays traced for them.
    ///
    /// # Errors
    /// The graphics processor fails, or has no room for the scene.
    pub fn traced_focal_stacks(
        &self,
        tracer: &Tracer,
        pupils: &[PupilDiameter],
        focus: &[Dioptres],
        rays: usize,
    ) -> Result<(Vec<Vec<f32>>, u64), GpuError> {
        let mut stacks = vec![Vec::new(); pupils.len()];
        let traced = tracer.trace(self, pupils, focus, rays, |pupil, sums, share| {
            stacks[pupil] = sums.iter().map(|sum| sum * share).collect();
        })?;
        Ok((stacks, traced))
    }
}
