//! How noisy the thin-lens images are: what is left of two renderings of one scene that differ in their rays alone.

use holod_calibration::{Dioptres, DisplayGeometry, PupilDiameter};

use super::Scene;

/// Pixels whose circle of confusion is below this count as in focus.
const IN_FOCUS_PX: f64 = 2.0;
/// Pixels whose circle of confusion is above this count as out of focus.
const OUT_OF_FOCUS_PX: f64 = 8.0;

/// Variance of the rendering noise of one pupil's stack in dB below the peak of 1; NaN where no pixel counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// The pupil that the stack is rendered for.
    pub pupil: PupilDiameter,
    /// Over every pixel of every plane.
    pub all_db: f64,
    /// Where the circle of confusion is below 2 px.
    pub in_focus_db: f64,
    /// Where the circle of confusion is above 8 px.
    pub out_of_focus_db: f64,
}

/// Mean of squares, in dB.
#[derive(Default)]
struct Power {
    sum: f64,
    count: u64,
}

impl Power {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1;
    }

    fn db(&self) -> f64 {
        10.0 * (self.sum / self.count as f64).log10()
    }
}

impl Scene {
    /// The noise of [`focal_stacks`](Scene::focal_stacks) for the same arguments: half the mean squared difference of
    /// two renderings with unrelated rays.
    pub fn noise(&mut self, pupils: &[PupilDiameter], focus: &[Dioptres], rays: usize) -> Vec<Noise> {
        let first = self.focal_stacks(pupils, focus, rays);
        self.ray_key = !self.ray_key;
        let second = self.focal_stacks(pupils, focus, rays);
        self.ray_key = !self.ray_key;
        let depth = self.picture().depth;
        let between = |pupil, (a, b): (&Vec<f32>, &Vec<f32>)| noise_between(&depth, pupil, focus, a, b);
        pupils.iter().zip(first.iter().zip(&second)).map(|(&pupil, stacks)| between(pupil, stacks)).collect()
    }
}

/// The noise of each of two stacks [planes, 3, height, width] that are alike but for it; `depth` is normalised.
pub(super) fn noise_between(
    depth: &[f32],
    pupil: PupilDiameter,
    focus: &[Dioptres],
    first: &[f32],
    second: &[f32],
) -> Noise {
    let geometry = DisplayGeometry::DEFAULT;
    let pixels = depth.len();
    let (mut all, mut sharp, mut soft) = (Power::default(), Power::default(), Power::default());
    for (plane, &focus) in focus.iter().enumerate() {
        for (pixel, &depth) in depth.iter().enumerate() {
            let coc_px = geometry.coc_px(pupil, geometry.depth_at(f64::from(depth)), focus);
            for channel in 0..3 {
                let at = (plane * 3 + channel) * pixels + pixel;
                let power = 0.5 * f64::from(first[at] - second[at]).powi(2);
                all.add(power);
                if coc_px < IN_FOCUS_PX {
                    sharp.add(power);
                } else if coc_px > OUT_OF_FOCUS_PX {
                    soft.add(power);
                }
            }
        }
    }
    Noise { pupil, all_db: all.db(), in_focus_db: sharp.db(), out_of_focus_db: soft.db() }
}
