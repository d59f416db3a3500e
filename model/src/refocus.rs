//! The refocus test: is a card with fine marks sharper where the eye is focused at it than where it is not?
//!
//! Looked at on the scenes of [`SceneKind::Cards`](crate::scene_shard::SceneKind::Cards), for each card alone.

use holod_calibration::{Colour, Dioptres, DisplayGeometry, Resolution};

use crate::LinearImage;
use crate::neighbourhood::any_within;

/// Where the near card stands on the default bench, for which scenes are laid out; on another: [`depth_on`].
pub const NEAR_CARD: Dioptres = Dioptres(2.5);
/// Where the far card stands, likewise.
pub const FAR_CARD: Dioptres = Dioptres(0.25);

/// How far a pixel of a card may lie from it on the default bench.
const TOLERANCE_DPT: f64 = 0.05;
/// Pixels this near to anything else, each way, are left out: in front of and behind a card's rim other things blur.
const SEAM_PX: usize = 16;
/// Fewer pixels tell nothing.
const FEWEST_PX: usize = 256;

/// Where a card stands on `bench`, whose depth range takes the place of the default bench's, end by end.
pub fn depth_on(bench: &DisplayGeometry, card: Dioptres) -> Dioptres {
    bench.depth_at(DisplayGeometry::DEFAULT.normalised_depth(card))
}

/// The inner part of one card.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CardArea {
    /// Whether each pixel is in it, [height, width].
    inside: Vec<bool>,
}

impl CardArea {
    /// The card that stands at `card` on the default bench, in a scene of any bench with `depth_normalised` [height,
    /// width]: without 16 px along its edges and without `border_px` at each edge of the picture; nothing where fewer
    /// than 256 pixels are left.
    pub fn find(depth_normalised: &[f32], resolution: Resolution, card: Dioptres, border_px: usize) -> Option<Self> {
        let Resolution { width, height } = resolution;
        assert_eq!(depth_normalised.len(), resolution.pixels(), "depth has the resolution's size");
        let outside: Vec<bool> = depth_normalised
            .iter()
            .map(|&depth| (DisplayGeometry::DEFAULT.depth_at(depth.into()).0 - card.0).abs() > TOLERANCE_DPT)
            .collect();
        let near_outside = any_within(&outside, resolution, SEAM_PX);
        let in_picture = |at: usize, end: usize| at >= border_px && at + border_px < end;
        let inside: Vec<bool> = (0..resolution.pixels())
            .map(|index| {
                let (x, y) = (index % width, index / width);
                in_picture(x, width) && in_picture(y, height) && !near_outside[index]
            })
            .collect();
        (inside.iter().filter(|&&inside| inside).count() >= FEWEST_PX).then_some(Self { inside })
    }

    /// Gradient energy: the mean squared difference of neighbouring pixels, along x and y and over all colours, where
    /// both lie in the area. `image` has the size that the area was found in.
    pub fn gradient_energy(&self, image: &LinearImage) -> f64 {
        let Resolution { width, .. } = image.resolution;
        assert_eq!(self.inside.len(), image.resolution.pixels(), "the area was found in a picture of this size");
        let pairs = |step: usize| {
            (0..self.inside.len().saturating_sub(step)).filter(move |&index| {
                self.inside[index] && self.inside[index + step] && (step == width || index % width + 1 < width)
            })
        };
        let (mut sum, mut count) = (0.0, 0usize);
        for (index, step) in pairs(1).map(|index| (index, 1)).chain(pairs(width).map(|index| (index, width))) {
            for colour in Colour::ALL {
                let plane = image.plane(colour);
                sum += (f64::from(plane[index + step]) - f64::from(plane[index])).powi(2);
            }
            count += 3;
        }
        sum / count.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;

    #[test]
    fn a_card_without_its_rim_and_the_pictures_border() {
        let resolution = Resolution { width: 100, height: 70 };
        let near = BENCH.normalised_depth(NEAR_CARD) as f32;
        let depth: Vec<f32> = (0..7000).map(|index| if index % 100 < 60 { near } else { 0.0 }).collect();
        let area = CardArea::find(&depth, resolution, NEAR_CARD, 10).unwrap();
        for index in 0..7000 {
            let (x, y) = (index % 100, index / 100);
            assert_eq!(area.inside[index], (10..44).contains(&x) && (10..60).contains(&y), "{x}, {y}");
        }
        assert_eq!(CardArea::find(&depth, resolution, FAR_CARD, 10), None);
        assert_eq!(CardArea::find(&depth, resolution, NEAR_CARD, 34), None, "too little is left");
    }

    #[test]
    fn gradient_energy_counts_pairs_inside_only() {
        let resolution = Resolution { width: 20, height: 20 };
        let area = CardArea::find(&[0.0; 400], resolution, Dioptres(0.0), 2).unwrap();
        let image = |value: fn(usize, usize) -> f32| LinearImage {
            resolution,
            pixels: (0..1200).map(|index| value(index % 20, index / 20 % 20)).collect(),
        };
        // Of 16·15 pairs each way, 16 along x step by a half.
        let step = image(|x, _| if x < 10 { 0.0 } else { 0.5 });
        assert!((area.gradient_energy(&step) - 16.0 * 0.25 / 480.0).abs() < 1e-12);
        let at_the_border = image(|x, y| if x == 1 || y == 18 { 5.0 } else { 0.25 });
        assert_eq!(area.gradient_energy(&at_the_border), 0.0);
    }

    #[test]
    fn cards_of_another_bench_stand_at_the_same_place_of_its_depth_range() {
        let bench = DisplayGeometry { depth_far: Dioptres(0.5), depth_near: Dioptres(1.5), ..BENCH };
        for (card, expected_dpt) in [(NEAR_CARD, 0.5 + 2.5 * 0.35), (FAR_CARD, 0.5 + 0.25 * 0.35)] {
            assert!((depth_on(&bench, card).0 - expected_dpt).abs() < 1e-9);
            assert!((depth_on(&BENCH, card).0 - card.0).abs() < 1e-9);
        }
    }
}
