//! Bright marks on exact black: how much light is seen of what was put in, and how much where there is none.
//!
//! Looked at on the scenes of [`SceneKind::Marks`](crate::scene_shard::SceneKind::Marks).

use holod_calibration::Colour;

use crate::LinearImage;
use crate::neighbourhood::any_within;

/// Marks are faint at the edges of their discs; black is exactly 0.
const LEAST_LIGHT: f32 = 1e-6;
/// Light within this many pixels, each way, is that of a mark.
const AWAY_PX: usize = 16;
/// Fewer pixels tell nothing.
const FEWEST_PX: usize = 256;

/// Where a stack of pictures is black at every focus, and so is all within 16 px each way.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DarkArea {
    /// Whether each pixel is in it, [height, width].
    inside: Vec<bool>,
}

impl DarkArea {
    /// That of a stack of at least one picture; nothing where fewer than 256 pixels are left.
    pub fn find(stack: &[LinearImage]) -> Option<Self> {
        let resolution = stack[0].resolution;
        let mut lit = vec![false; resolution.pixels()];
        for plane in stack.iter().flat_map(|picture| picture.pixels.chunks_exact(resolution.pixels())) {
            lit.iter_mut().zip(plane).for_each(|(lit, &light)| *lit |= light > LEAST_LIGHT);
        }
        let inside: Vec<bool> =
            any_within(&lit, resolution, AWAY_PX).into_iter().map(|near_light| !near_light).collect();
        (inside.iter().filter(|&&inside| inside).count() >= FEWEST_PX).then_some(Self { inside })
    }

    /// Mean light in it, over the pictures of a stack of the size that it was found in and over `colours`; white is 1.
    pub fn mean_light(&self, stack: &[LinearImage], colours: &[Colour]) -> f64 {
        let (mut sum, mut count) = (0.0, 0usize);
        for plane in stack.iter().flat_map(|picture| colours.iter().map(|&colour| picture.plane(colour))) {
            for (&light, _) in plane.iter().zip(&self.inside).filter(|(_, inside)| **inside) {
                sum += f64::from(light);
                count += 1;
            }
        }
        sum / count as f64
    }
}

/// Whether anything is lit in a stack.
pub fn is_lit(stack: &[LinearImage]) -> bool {
    stack.iter().flat_map(|picture| &picture.pixels).any(|&light| light > LEAST_LIGHT)
}

/// All light of a stack over that of its target.
pub fn light_ratio(seen: &[LinearImage], target: &[LinearImage]) -> f64 {
    let light =
        |stack: &[LinearImage]| stack.iter().flat_map(|picture| &picture.pixels).map(|&v| f64::from(v)).sum::<f64>();
    light(seen) / light(target)
}

#[cfg(test)]
mod tests {
    use holod_calibration::Resolution;

    use super::*;

    const SIZE: Resolution = Resolution { width: 80, height: 60 };

    /// Two pictures, black but for one lit pixel each.
    fn stack(light: f32) -> Vec<LinearImage> {
        [(20, 30), (22, 30)]
            .map(|(x, y)| {
                let mut picture = LinearImage::black(SIZE);
                picture.pixels[SIZE.pixels() + y * SIZE.width + x] = light;
                picture
            })
            .to_vec()
    }

    #[test]
    fn the_dark_area_keeps_away_from_the_light_of_every_focus() {
        let target = stack(0.5);
        let area = DarkArea::find(&target).unwrap();
        for (index, inside) in area.inside.iter().enumerate() {
            let (x, y) = (index % SIZE.width, index / SIZE.width);
            assert_eq!(*inside, !((4..=38).contains(&x) && (14..=46).contains(&y)), "({x}, {y})");
        }
        assert_eq!(area.mean_light(&target, &Colour::ALL), 0.0);
        let mut seen = target.clone();
        seen[1].pixels[0] = 0.3;
        let dark_px = area.inside.iter().filter(|inside| **inside).count();
        let mean = area.mean_light(&seen, &Colour::ALL);
        assert!((mean - 0.3 / (6 * dark_px) as f64).abs() < 1e-9, "{mean}");
        let red = area.mean_light(&seen, &[Colour::Red]);
        assert!((red - 3.0 * mean).abs() < 1e-9 && area.mean_light(&seen, &[Colour::Blue]) == 0.0, "{red}");
        // What is beside a mark is none of it.
        seen[1].pixels[SIZE.pixels() + 30 * SIZE.width + 25] = 1.0;
        assert_eq!(area.mean_light(&seen, &Colour::ALL), mean);
    }

    #[test]
    fn light_is_counted_wherever_it_is_seen() {
        let target = stack(0.5);
        let mut seen = target.clone();
        assert_eq!(light_ratio(&seen, &target), 1.0);
        seen[0].pixels[0] = 0.25;
        assert_eq!(light_ratio(&seen, &target), 1.25);
    }

    #[test]
    fn pictures_without_marks_or_without_black_are_none() {
        assert!(!is_lit(&[LinearImage::black(SIZE)]) && is_lit(&stack(0.5)));
        let mut grey = LinearImage::black(SIZE);
        grey.pixels.fill(0.1);
        assert_eq!(DarkArea::find(&[grey]), None);
    }
}
