//! Bringing a picture to the wanted size.

use holod_calibration::Resolution;

use super::Fit;

/// Where a picture lands in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Placement {
    /// Frame pixels to a picture pixel.
    scale: f64,
    /// Position in the frame of the picture's corner, along x and y.
    corner: [f64; 2],
    source: Resolution,
    target: Resolution,
}

impl Placement {
    /// `None` where `fit` does not allow the picture in the frame.
    pub(super) fn new(source: Resolution, target: Resolution, fit: Fit) -> Option<Self> {
        let ratios = [target.width as f64 / source.width as f64, target.height as f64 / source.height as f64];
        let larger = source.width > target.width || source.height > target.height;
        let scale = match fit {
            Fit::Native if larger => return None,
            Fit::Native | Fit::Crop => 1.0,
            Fit::Contain => ratios[0].min(ratios[1]),
            Fit::Cover => ratios[0].max(ratios[1]),
        };
        let corner = |target: usize, source: usize| {
            let free = (target as f64 - scale * source as f64) / 2.0;
            if scale == 1.0 { free.floor() } else { free }
        };
        let corner = [corner(target.width, source.width), corner(target.height, source.height)];
        Some(Self { scale, corner, source, target })
    }

    /// Frame pixels to a picture pixel.
    pub(super) const fn scale(&self) -> f64 {
        self.scale
    }

    /// The picture position that is shown at the centre of frame pixel `position` along `axis`, if any is.
    fn source_position(&self, axis: usize, position: usize) -> Option<f64> {
        let size = [self.source.width, self.source.height][axis] as f64;
        let source = (position as f64 + 0.5 - self.corner[axis]) / self.scale;
        (0.0..size).contains(&source).then_some(source)
    }

    /// Whether each pixel of the frame shows one of the picture, or none.
    pub(super) fn is_unscaled(&self) -> bool {
        self.scale == 1.0
    }

    /// Whether the frame is the picture.
    pub(super) fn is_identity(&self) -> bool {
        self.is_unscaled() && self.source == self.target
    }

    /// Frame pixels that the picture does not reach.
    pub(super) fn padded_px(&self) -> usize {
        let reached = |axis, size| (0..size).filter(|&position| self.source_position(axis, position).is_some()).count();
        self.target.pixels() - reached(0, self.target.width) * reached(1, self.target.height)
    }

    /// One plane of linear light at the frame's size: averages where the picture shrinks, linear interpolation where
    /// it grows; 0 outside.
    pub(super) fn light(&self, plane: &[f32]) -> Vec<f32> {
        let columns = self.taps(0, self.source.width, self.target.width);
        let rows = self.taps(1, self.source.height, self.target.height);
        let narrowed: Vec<f32> = plane
            .chunks_exact(self.source.width)
            .flat_map(|row| columns.iter().map(|tap| tap.sum(|index| row[index])))
            .collect();
        let width = self.target.width;
        rows.iter()
            .flat_map(|tap| (0..width).map(|x| tap.sum(|y| narrowed[y * width + x])).collect::<Vec<_>>())
            .collect()
    }

    /// One plane of values that must not be mixed across edges, such as depth: the nearest one; `outside` outside.
    pub(super) fn nearest(&self, plane: &[f32], outside: f32) -> Vec<f32> {
        let along = |axis, size| -> Vec<Option<usize>> {
            (0..size).map(|position| self.source_position(axis, position).map(|source| source as usize)).collect()
        };
        let (columns, rows) = (along(0, self.target.width), along(1, self.target.height));
        rows.iter()
            .flat_map(|row| {
                columns.iter().map(move |column| match (row, column) {
                    (Some(y), Some(x)) => plane[y * self.source.width + x],
                    _ => outside,
                })
            })
            .collect()
    }

    /// For each frame pixel along `axis` the picture pixels that it shows.
    fn taps(&self, axis: usize, source_size: usize, target_size: usize) -> Vec<Taps> {
        // A triangle of the width of a frame pixel or of a picture pixel, whichever is wider.
        let radius = (1.0 / self.scale).max(1.0);
        (0..target_size)
            .map(|position| {
                let Some(centre) = self.source_position(axis, position) else {
                    return Taps { first: 0, weights: Vec::new() };
                };
                if self.scale == 1.0 {
                    return Taps { first: centre as usize, weights: vec![1.0] };
                }
                let first = (centre - 0.5 - radius).ceil().max(0.0) as usize;
                let last = ((centre - 0.5 + radius).floor() as usize).min(source_size - 1);
                let weights: Vec<f64> =
                    (first..=last).map(|index| (1.0 - (index as f64 + 0.5 - centre).abs() / radius).max(0.0)).collect();
                let sum: f64 = weights.iter().sum();
                Taps { first, weights: weights.into_iter().map(|weight| (weight / sum) as f32).collect() }
            })
            .collect()
    }
}

/// A weighted sum of neighbouring pixels; the weights add up to 1, or there are none.
struct Taps {
    first: usize,
    weights: Vec<f32>,
}

impl Taps {
    fn sum(&self, value: impl Fn(usize) -> f32) -> f32 {
        self.weights.iter().enumerate().map(|(index, weight)| weight * value(self.first + index)).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const fn size(width: usize, height: usize) -> Resolution {
        Resolution { width, height }
    }

    #[test]
    fn native_centres_and_refuses_what_is_larger() {
        let placement = Placement::new(size(2, 1), size(4, 3), Fit::Native).unwrap();
        let expected = [0.0, 0.0, 0.0, 0.0, 0.0, 7.0, 8.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(placement.light(&[7.0, 8.0]), expected);
        assert_eq!(placement.nearest(&[7.0, 8.0], 0.0), expected);
        assert_eq!(placement.padded_px(), 10);
        assert_eq!(Placement::new(size(5, 1), size(4, 3), Fit::Native), None);
    }

    #[test]
    fn crop_cuts_evenly_contain_pads_and_cover_fills() {
        let row = [1.0, 2.0, 3.0, 4.0];
        assert_eq!(Placement::new(size(4, 1), size(2, 1), Fit::Crop).unwrap().light(&row), [2.0, 3.0]);
        let contain = Placement::new(size(4, 2), size(4, 4), Fit::Contain).unwrap();
        assert_eq!((contain.padded_px(), contain.nearest(&[5.0; 8], 0.0)[3..5].to_vec()), (8, vec![0.0, 5.0]));
        let cover = Placement::new(size(4, 2), size(4, 4), Fit::Cover).unwrap();
        assert_eq!(
            (cover.padded_px(), cover.nearest(&[1., 2., 3., 4., 5., 6., 7., 8.], 0.0)[..4].to_vec()),
            (0, vec![2., 2., 3., 3.])
        );
    }

    #[test]
    fn shrinking_averages_light_but_never_depth() {
        let placement = Placement::new(size(4, 4), size(2, 2), Fit::Contain).unwrap();
        let checks: Vec<f32> = (0..16).map(|index| ((index + index / 4) % 2) as f32).collect();
        assert!(placement.light(&checks).iter().all(|value| (value - 0.5).abs() < 0.13));
        assert!(placement.nearest(&checks, 9.0).iter().all(|&value| value == 0.0 || value == 1.0));
    }

    proptest! {
        #[test]
        fn a_constant_stays_constant_where_the_picture_reaches(
            source_width in 1usize..40, source_height in 1usize..40,
            width in 1usize..40, height in 1usize..40, fit in 0usize..3,
        ) {
            let fit = [Fit::Contain, Fit::Cover, Fit::Crop][fit];
            let source = size(source_width, source_height);
            let placement = Placement::new(source, size(width, height), fit).unwrap();
            let light = placement.light(&vec![0.75; source.pixels()]);
            let depth = placement.nearest(&vec![0.75; source.pixels()], 0.0);
            prop_assert_eq!(light.len(), width * height);
            for (light, depth) in light.iter().zip(&depth) {
                prop_assert!((light - depth).abs() < 1e-5, "{light} and {depth}");
            }
            prop_assert_eq!(depth.iter().filter(|&&value| value == 0.0).count(), placement.padded_px());
            if fit == Fit::Cover {
                prop_assert_eq!(placement.padded_px(), 0);
            }
        }
    }
}
