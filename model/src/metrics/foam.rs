//! Foam: fine structure that a picture shows out of focus and its target does not.
//!
//! Coherent light that is out of focus interferes: text and dots turn into cell walls and rings. Three octaves of
//! structure count, which blocks of 4, 8 and 16 px hold; what a block of 2 px holds is beyond what an eye makes out. In
//! regions of 32x32 px each octave's energy over that of the target counts, of blocks all of which is out of focus.
//!
//! Blocks stand still, so a regular pattern that is shifted against its target's may have all of its energy counted.
//! The trainer's `foam.py` measures the same.

use std::ops::{Add, AddAssign};

use holod_calibration::Resolution;

use super::Part;
use crate::LinearImage;

const FINEST_PX: usize = 2;
const OCTAVES: usize = 3;
const REGION_PX: usize = 32;

/// Energy of foam, white = 1, and over how many pixels and colours it may stand.
#[derive(Clone, Copy, Default)]
pub(super) struct Foam {
    energy: f64,
    pixels: f64,
}

impl Foam {
    /// The foam of `shown` against `wanted` in `part`, where `out_of_focus` says so of an index into [height, width].
    /// What is left of a region at the right and the bottom is left out.
    pub(super) fn of(
        shown: &LinearImage,
        wanted: &LinearImage,
        part: Part<'_>,
        out_of_focus: impl Fn(usize) -> bool,
    ) -> Self {
        let Part { colours, border_px } = part;
        let Resolution { width, height } = shown.resolution;
        let whole_regions = |size: usize| size.saturating_sub(2 * border_px) / REGION_PX * REGION_PX;
        let inner = Resolution { width: whole_regions(width), height: whole_regions(height) };
        let pixels = move |index: usize| {
            let (x, y) = (index % inner.width, index / inner.width);
            (border_px + y) * width + border_px + x
        };
        let blurred = Grid::new(inner, |index| out_of_focus(pixels(index)));
        let mut foam = Self::default();
        for &colour in colours {
            let light = |image: &LinearImage| {
                let plane = image.plane(colour);
                Grid::new(inner, |index| f64::from(plane[pixels(index)])).halved(mean)
            };
            foam += Self::of_plane(light(shown), light(wanted), blurred.halved(all));
        }
        foam
    }

    /// The same of one colour, from means of [`FINEST_PX`].
    fn of_plane(mut shown: Grid<f64>, mut wanted: Grid<f64>, mut blurred: Grid<bool>) -> Self {
        let mut foam = Self::default();
        for octave in 0..OCTAVES {
            let sample_px = FINEST_PX << octave;
            let (coarse_shown, coarse_wanted) = (shown.halved(mean), wanted.halved(mean));
            blurred = blurred.halved(all);
            let samples = REGION_PX / sample_px;
            let regions = shown.size.width / samples;
            let mut excess = vec![0.0; regions * (shown.size.height / samples)];
            for y in 0..shown.size.height {
                for x in (0..shown.size.width).filter(|x| *blurred.at(x / 2, y / 2)) {
                    let structure = |fine: &Grid<f64>, coarse: &Grid<f64>| fine.at(x, y) - coarse.at(x / 2, y / 2);
                    excess[y / samples * regions + x / samples] +=
                        structure(&shown, &coarse_shown).powi(2) - structure(&wanted, &coarse_wanted).powi(2);
                }
            }
            let sample_area = (sample_px * sample_px) as f64;
            let blocks = blurred.values.iter().filter(|blurred| **blurred).count();
            foam.energy += sample_area * excess.into_iter().map(|excess: f64| excess.max(0.0)).sum::<f64>();
            foam.pixels += 4.0 * sample_area * blocks as f64 / OCTAVES as f64;
            (shown, wanted) = (coarse_shown, coarse_wanted);
        }
        foam
    }

    /// Mean energy; `None` where no block of a region is out of focus.
    pub(super) fn mean(self) -> Option<f64> {
        (self.pixels > 0.0).then(|| self.energy / self.pixels)
    }
}

impl Add for Foam {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { energy: self.energy + other.energy, pixels: self.pixels + other.pixels }
    }
}

impl AddAssign for Foam {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

/// A value for each pixel, [height, width].
struct Grid<T> {
    size: Resolution,
    values: Vec<T>,
}

impl<T: Copy> Grid<T> {
    fn new(size: Resolution, value: impl FnMut(usize) -> T) -> Self {
        Self { size, values: (0..size.pixels()).map(value).collect() }
    }

    fn at(&self, x: usize, y: usize) -> &T {
        &self.values[y * self.size.width + x]
    }

    /// Each block of 2x2 made one.
    fn halved(&self, one: impl Fn([T; 4]) -> T) -> Self {
        let size = Resolution { width: self.size.width / 2, height: self.size.height / 2 };
        Self::new(size, |index| {
            let (x, y) = (2 * (index % size.width), 2 * (index / size.width));
            one([(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)].map(|(x, y)| *self.at(x, y)))
        })
    }
}

fn mean(block: [f64; 4]) -> f64 {
    block.iter().sum::<f64>() / 4.0
}

fn all(block: [bool; 4]) -> bool {
    block.into_iter().all(|one| one)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Resolution = Resolution { width: 96, height: 64 };

    /// Square stripes of `swing` about grey, half of which is each of two levels, moved to the right.
    fn stripes(period_px: usize, swing: f32, moved_px: usize) -> LinearImage {
        let pixels = (0..3 * SIZE.pixels()).map(|index| {
            let x = index % SIZE.width + SIZE.width - moved_px;
            if x % period_px < period_px / 2 { 0.4 + swing } else { 0.4 - swing }
        });
        LinearImage { resolution: SIZE, pixels: pixels.collect() }
    }

    fn grey() -> LinearImage {
        stripes(2, 0.0, 0)
    }

    fn foam(shown: &LinearImage, wanted: &LinearImage) -> f64 {
        Foam::of(shown, wanted, Part::inside(0), |_| true).mean().unwrap()
    }

    fn assert_near(found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-6, "{found} for {expected}");
    }

    #[test]
    fn structure_that_a_target_lacks_is_foam_with_all_its_energy() {
        for period_px in [4, 8, 16] {
            assert_near(foam(&stripes(period_px, 0.1, 0), &grey()), 0.01);
        }
    }

    #[test]
    fn what_is_finer_or_coarser_than_an_eye_sees_as_foam_does_not_count() {
        assert_near(foam(&stripes(2, 0.1, 0), &grey()), 0.0);
        assert_near(foam(&stripes(32, 0.1, 0), &grey()), 0.0);
    }

    #[test]
    fn only_what_exceeds_the_targets_own_structure_is_foam() {
        let target = stripes(8, 0.1, 0);
        assert_near(foam(&target, &target), 0.0);
        assert_near(foam(&grey(), &target), 0.0);
        assert_near(foam(&target, &stripes(8, 0.1, 3)), 0.0075);
        assert_near(foam(&stripes(8, 0.2, 0), &target), 0.03);
    }

    #[test]
    fn only_what_is_out_of_focus_and_inside_the_border_counts() {
        let mut spoilt = grey();
        let ticks = stripes(8, 0.1, 0);
        for (index, value) in spoilt.pixels.iter_mut().enumerate().filter(|(index, _)| index % SIZE.width < 32) {
            *value = ticks.pixels[index];
        }
        assert_near(Foam::of(&spoilt, &grey(), Part::inside(0), |index| index % SIZE.width >= 32).mean().unwrap(), 0.0);
        assert_near(Foam::of(&ticks, &grey(), Part::inside(0), |index| index % SIZE.width >= 32).mean().unwrap(), 0.01);
        assert_near(foam(&spoilt, &grey()), 0.01 / 3.0);
        assert!(Foam::of(&ticks, &grey(), Part::inside(0), |_| false).mean().is_none());
        // 56 x 24 pixels hold no region; 88 x 56 hold two.
        assert!(Foam::of(&ticks, &grey(), Part::inside(20), |_| true).mean().is_none());
        assert_near(Foam::of(&ticks, &grey(), Part::inside(4), |_| true).mean().unwrap(), 0.01);
    }
}
