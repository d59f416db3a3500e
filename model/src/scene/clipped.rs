//! Light that cannot be shown as it is, and how many pixels have some.

use std::ops::AddAssign;

use super::ROUNDING;

/// Pixels of a picture with light that cannot be shown as it is, each counted once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClippedColours {
    /// Some colour is above white, and was set to it.
    pub above_white_px: usize,
    /// None is above white, but some is below 0 or no number, and was set to 0.
    pub below_black_px: usize,
}

impl ClippedColours {
    /// Pixels that were clipped at either end.
    pub const fn in_all(self) -> usize {
        self.above_white_px + self.below_black_px
    }

    /// Counts a pixel of which some colour is above white, or some below 0.
    pub(super) fn count(&mut self, above_white: bool, below_black: bool) {
        self.above_white_px += usize::from(above_white);
        self.below_black_px += usize::from(below_black & !above_white);
    }
}

impl AddAssign for ClippedColours {
    fn add_assign(&mut self, other: Self) {
        self.above_white_px += other.above_white_px;
        self.below_black_px += other.below_black_px;
    }
}

/// The light that is shown of `light`, where white is 1; NaN is black.
pub(super) fn shown(light: f32) -> f32 {
    if light > 0.0 { light.min(1.0) } else { 0.0 }
}

/// Whether light is above white by more than rounding.
pub(super) fn is_above_white(light: f32) -> bool {
    light > 1.0 + ROUNDING
}

/// Whether it is below 0 by more than rounding, or no number.
pub(super) fn is_below_black(light: f32) -> bool {
    light < -ROUNDING || light.is_nan()
}

/// Whether any of three is so, without a branch.
pub(super) fn any([red, green, blue]: [bool; 3]) -> bool {
    red | green | blue
}
