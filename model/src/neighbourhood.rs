//! What is near what in a picture.

use holod_calibration::Resolution;

/// For each pixel of a mask [height, width], whether any pixel of it is set within `reach_px` along x and along y.
pub(crate) fn any_within(mask: &[bool], resolution: Resolution, reach_px: usize) -> Vec<bool> {
    let Resolution { width, height } = resolution;
    assert_eq!(mask.len(), resolution.pixels(), "the mask has the resolution's size");
    let around = |at: usize, end: usize| at.saturating_sub(reach_px)..(at + reach_px + 1).min(end);
    let along_x: Vec<bool> = (0..resolution.pixels())
        .map(|index| around(index % width, width).any(|x| mask[index / width * width + x]))
        .collect();
    (0..resolution.pixels())
        .map(|index| around(index / width, height).any(|y| along_x[y * width + index % width]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_pixel_reaches_a_square_and_stops_at_the_edge() {
        let resolution = Resolution { width: 9, height: 7 };
        let mut mask = vec![false; resolution.pixels()];
        mask[resolution.width + 7] = true;
        let reached = any_within(&mask, resolution, 2);
        for (index, reached) in reached.into_iter().enumerate() {
            let (x, y) = (index % resolution.width, index / resolution.width);
            assert_eq!(reached, (5..=9).contains(&x) && y <= 3, "({x}, {y})");
        }
        assert_eq!(any_within(&mask, resolution, 0), mask);
    }
}
