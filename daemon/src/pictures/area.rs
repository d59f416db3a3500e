//! Where a surface of one depth lies in a picture.

use std::ops::Range;

use holod_calibration::{Dioptres, DisplayGeometry, Resolution};

/// A rectangle of pixels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Area {
    /// Columns from the left, the end left out.
    pub columns: Range<usize>,
    /// Rows from the top, the end left out.
    pub rows: Range<usize>,
}

/// How far a pixel's normalised depth may be from the wanted one.
const TOLERANCE: f32 = 0.01;

impl Area {
    /// The card at `depth`, less `inset_px` on each side: the columns with at least half as many pixels of that depth
    /// as the fullest one has, and the rows with at least half of these columns, the longest run of each. Slanted
    /// surfaces that only pass through the depth do not count. Nothing where too little is left. `depth_normalised` is
    /// [height, width].
    pub fn at_depth(
        depth_normalised: &[f32],
        resolution: Resolution,
        geometry: &DisplayGeometry,
        depth: Dioptres,
        inset_px: usize,
    ) -> Option<Self> {
        let wanted = geometry.normalised_depth(depth) as f32;
        let is_there = |x: usize, y: usize| (depth_normalised[y * resolution.width + x] - wanted).abs() < TOLERANCE;
        let in_column = |x: usize| (0..resolution.height).filter(|&y| is_there(x, y)).count();
        let columns: Vec<usize> = (0..resolution.width).map(in_column).collect();
        let fullest = columns.iter().copied().max().filter(|&count| count > 0)?;
        let columns = longest_run(resolution.width, |x| 2 * columns[x] >= fullest)?;
        let in_row = |y: usize| columns.clone().filter(|&x| is_there(x, y)).count();
        let rows = longest_run(resolution.height, |y| 2 * in_row(y) >= columns.len())?;
        let inset = |range: Range<usize>| range.start + inset_px..range.end.saturating_sub(inset_px);
        let area = Self { columns: inset(columns), rows: inset(rows) };
        (area.columns.len() > 1 && area.rows.len() > 1).then_some(area)
    }
}

/// The longest run of consecutive indices below `end` that are `wanted`.
fn longest_run(end: usize, wanted: impl Fn(usize) -> bool) -> Option<Range<usize>> {
    let mut longest = 0..0;
    let mut start = 0;
    for index in 0..end {
        if !wanted(index) {
            start = index + 1;
        } else if index + 1 - start > longest.len() {
            longest = start..index + 1;
        }
    }
    (!longest.is_empty()).then_some(longest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_card_less_its_inset_without_the_floor() {
        let resolution = Resolution { width: 20, height: 10 };
        let geometry = DisplayGeometry::DEFAULT;
        let near = geometry.normalised_depth(Dioptres(2.5)) as f32;
        // A floor passes through the card's depth in the lowest row.
        let is_near = |x, y| (4..12).contains(&x) && (2..8).contains(&y) || y == 9;
        let depth: Vec<f32> = (0..200).map(|i| if is_near(i % 20, i / 20) { near } else { 0.1 }).collect();
        let area = |dpt, inset| Area::at_depth(&depth, resolution, &geometry, Dioptres(dpt), inset);
        assert_eq!(area(2.5, 1), Some(Area { columns: 5..11, rows: 3..7 }));
        assert_eq!(area(2.5, 4), None);
        assert_eq!(area(1.0, 0), None);
    }
}
