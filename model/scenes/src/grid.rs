//! The regular grid of samples on which views are drawn.

/// Sample (column, row) is at (left + column·step, top + row·step), in pixels from the middle of the picture.
#[derive(Clone, Copy)]
pub(super) struct Grid {
    pub(super) left: f32,
    pub(super) top: f32,
    pub(super) step: f32,
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl Grid {
    pub(super) fn x(&self, column: usize) -> f32 {
        self.left + column as f32 * self.step
    }

    pub(super) fn y(&self, row: usize) -> f32 {
        self.top + row as f32 * self.step
    }

    /// Columns and rows of samples within a rectangle; at most one too many on each side.
    pub(super) fn within(
        &self,
        left: f32,
        right: f32,
        top: f32,
        bottom: f32,
    ) -> (std::ops::Range<usize>, std::ops::Range<usize>) {
        let range = |low: f32, high: f32, origin: f32, count: usize| {
            let first = ((low - origin) / self.step).max(0.0) as usize;
            let end = ((high - origin) / self.step + 2.0).clamp(0.0, count as f32) as usize;
            first.min(end)..end
        };
        (range(left, right, self.left, self.columns), range(top, bottom, self.top, self.rows))
    }
}
