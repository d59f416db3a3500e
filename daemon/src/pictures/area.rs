//! Where a surface of one depth lies in a picture.

use std::ops::Range;

use holod_calibration::{Dioptres, DisplayGeometry, Resolution};

/// A rectangle of pixels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Area {
    /// Columns.
    pub columns: Range<usize>,
    /// Rows.
    pub rows: Range<usize>,
}

/// How far a pixel's normalised depth may be from the wanted one.
const TOLERANCE: f32 = 0.01;

impl Area {
    /// The bounds of the pixels at `depth`, less `inset_px` on each side; nothing where too few are there.
    /// `depth_normalised` is [height, width].
    pub fn at_depth(
        depth_normalised: &[f32],
        resolution: Resolution,
        geometry: &DisplayGeometry,
        depth: Dioptres,
        inset_px: usize,
    ) -> Option<Self> {
        let wanted = geometry.normalised_depth(depth) as f32;
        let mut bounds: Option<[usize; 4]> = None;
        for (pixel, _) in depth_normalised.iter().enumerate().filter(|(_, at)| (**at - wanted).abs() < TOLERANCE) {
            let (x, y) = (pixel % resolution.width, pixel / resolution.width);
            let [left, right, top, bottom] = bounds.unwrap_or([x, x, y, y]);
            bounds = Some([left.min(x), right.max(x), top.min(y), bottom.max(y)]);
        }
        let [left, right, top, bottom] = bounds?;
        let area = Self {
            columns: left + inset_px..(right + 1).saturating_sub(inset_px),
            rows: top + inset_px..(bottom + 1).saturating_sub(inset_px),
        };
        (area.columns.len() > 1 && area.rows.len() > 1).then_some(area)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_of_a_card_less_its_inset() {
        let resolution = Resolution { width: 20, height: 10 };
        let geometry = DisplayGeometry::DEFAULT;
        let near = geometry.normalised_depth(Dioptres(2.5)) as f32;
        let depth: Vec<f32> = (0..200)
            .map(|i| if (4..12).contains(&(i % 20)) && (2..9).contains(&(i / 20)) { near } else { 0.1 })
            .collect();
        let area = |dpt, inset| Area::at_depth(&depth, resolution, &geometry, Dioptres(dpt), inset);
        assert_eq!(area(2.5, 1), Some(Area { columns: 5..11, rows: 3..8 }));
        assert_eq!(area(2.5, 4), None);
        assert_eq!(area(1.0, 0), None);
    }
}
