//! Colours of a feed's pictures that were clipped.

use holod_model::scene::ClippedColours;
use serde::{Deserialize, Serialize};

/// Pixels with colours that were clipped, each counted once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClippedPixels {
    /// Some colour was above white.
    pub above_white: u64,
    /// None was above white, but some was below 0 or no number.
    pub below_black: u64,
}

impl From<ClippedColours> for ClippedPixels {
    fn from(clipped: ClippedColours) -> Self {
        let ClippedColours { above_white_px, below_black_px } = clipped;
        Self { above_white: above_white_px as u64, below_black: below_black_px as u64 }
    }
}

impl ClippedPixels {
    /// Each kind by its name.
    pub const fn entries(&self) -> [(&'static str, u64); 2] {
        [("above_white", self.above_white), ("below_black", self.below_black)]
    }

    /// Pixels of both kinds.
    pub const fn in_all(&self) -> u64 {
        self.above_white + self.below_black
    }

    /// Counts those of one more picture.
    pub(super) fn add(&mut self, other: &Self) {
        self.above_white += other.above_white;
        self.below_black += other.below_black;
    }

    /// Those that there are, in words.
    pub fn text(&self) -> String {
        let words = [(self.above_white, "above white"), (self.below_black, "below black")];
        let counts = words.into_iter().filter(|(pixels, _)| *pixels > 0);
        counts.map(|(pixels, word)| format!("{pixels} {word}")).collect::<Vec<_>>().join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_counted_named_and_added() {
        let mut sum = ClippedPixels::default();
        assert_eq!((sum.in_all(), sum.text()), (0, String::new()));
        sum.add(&ClippedColours { above_white_px: 0, below_black_px: 3 }.into());
        assert_eq!(sum.text(), "3 below black");
        sum.add(&ClippedColours { above_white_px: 4, below_black_px: 1 }.into());
        assert_eq!((sum.in_all(), sum.text().as_str()), (8, "4 above white, 4 below black"));
    }
}
