//! Depths of a feed's pictures that cannot be shown as they are: how many, of what kind, and what is most likely wrong.

use holod_model::scene::{LiveDepth, LiveReport, MissingDepths};
use serde::{Deserialize, Serialize};

/// Depths that cannot be shown as they are, in pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BadDepths {
    /// NaN, which floating-point depths alone can have.
    pub nan: u64,
    /// 0, where that is no depth.
    pub zero: u64,
    /// Below 0, minus infinity included.
    pub negative: u64,
    /// Infinite, where that is no depth.
    pub infinite: u64,
    /// Farther than the display shows.
    pub beyond_far: u64,
    /// Nearer than the display shows.
    pub beyond_near: u64,
}

impl From<MissingDepths> for BadDepths {
    fn from(missing: MissingDepths) -> Self {
        let MissingDepths { nan, zero, negative, infinite } = missing;
        Self {
            nan: nan as u64,
            zero: zero as u64,
            negative: negative as u64,
            infinite: infinite as u64,
            beyond_far: 0,
            beyond_near: 0,
        }
    }
}

impl From<&LiveReport> for BadDepths {
    fn from(report: &LiveReport) -> Self {
        Self {
            beyond_far: report.frame.depth_clamped_far_px as u64,
            beyond_near: report.frame.depth_clamped_near_px as u64,
            ..Self::from(report.missing)
        }
    }
}

impl BadDepths {
    /// Each kind by its name.
    pub const fn entries(&self) -> [(&'static str, u64); 6] {
        let Self { nan, zero, negative, infinite, beyond_far, beyond_near } = *self;
        [
            ("nan", nan),
            ("zero", zero),
            ("negative", negative),
            ("infinite", infinite),
            ("beyond_far", beyond_far),
            ("beyond_near", beyond_near),
        ]
    }

    /// Pixels of all kinds; none is counted twice.
    pub fn in_all(&self) -> u64 {
        self.entries().into_iter().map(|(_, pixels)| pixels).sum()
    }

    /// Those of pixels that have none.
    pub(super) const fn missing(&self) -> u64 {
        self.nan + self.zero + self.negative + self.infinite
    }

    /// Those beyond the display's range.
    pub(super) const fn beyond(&self) -> u64 {
        self.beyond_far + self.beyond_near
    }

    /// Counts those of one more picture.
    pub(super) fn add(&mut self, other: &Self) {
        self.nan += other.nan;
        self.zero += other.zero;
        self.negative += other.negative;
        self.infinite += other.infinite;
        self.beyond_far += other.beyond_far;
        self.beyond_near += other.beyond_near;
    }

    /// Those that there are, in words.
    pub fn text(&self) -> String {
        let words = ["NaN", "zero", "negative", "infinite", "farther than the display", "nearer than the display"];
        let counts = self.entries().into_iter().zip(words).filter(|((_, pixels), _)| *pixels > 0);
        counts.map(|((_, pixels), word)| format!("{pixels} {word}")).collect::<Vec<_>>().join(", ")
    }

    /// What is most likely wrong with depths of which most are bad.
    pub(super) fn likely_cure(&self, depth: LiveDepth) -> &'static str {
        let most = self.entries().into_iter().max_by_key(|(_, pixels)| *pixels).map_or("", |(kind, _)| kind);
        match (depth, most) {
            (_, "negative") => "do they lie along -z, as a view space of OpenGL does? Send their absolute value",
            (_, "nan") => "is nothing drawn there? Send infinity in metres, 0 in dioptres",
            (LiveDepth::DioptresF16 | LiveDepth::DioptresF32, "infinite") => {
                "0 m has no dioptres: is nothing drawn there? Send 0"
            }
            (LiveDepth::DioptresF16 | LiveDepth::DioptresF32, _) => {
                "are they metres or millimetres? This client said that it sends dioptres"
            }
            (LiveDepth::MillimetresU16, "beyond_near" | "zero") => {
                "are they metres, or a picture without depth? This client said that it sends millimetres"
            }
            (LiveDepth::MillimetresU16, _) => {
                "are they a camera's units of less than 1 mm? This client said that it sends millimetres"
            }
            (LiveDepth::MetresF16 | LiveDepth::MetresF32, "beyond_near" | "zero") => {
                "are they dioptres, or a depth buffer's figures from 0 to 1? This client said that it sends metres"
            }
            (LiveDepth::MetresF16 | LiveDepth::MetresF32, _) => {
                "are they millimetres? This client said that it sends metres"
            }
            (LiveDepth::Plane(_), _) => "plane_dpt is outside the display's depth range",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_counted_named_and_added() {
        let one = BadDepths { nan: 1, zero: 2, negative: 3, infinite: 4, beyond_far: 5, beyond_near: 6 };
        let mut sum = BadDepths::default();
        assert_eq!((sum.in_all(), sum.text()), (0, String::new()));
        sum.add(&one);
        sum.add(&BadDepths { zero: 10, ..BadDepths::default() });
        assert_eq!(sum, BadDepths { zero: 12, ..one });
        assert_eq!(sum.in_all(), 31);
        assert_eq!(
            sum.text(),
            "1 NaN, 12 zero, 3 negative, 4 infinite, 5 farther than the display, 6 nearer than the display"
        );
    }

    #[test]
    fn the_cure_is_that_of_the_kind_that_most_are_of() {
        let near = BadDepths { beyond_near: 9, zero: 1, ..BadDepths::default() };
        let negative = BadDepths { negative: 9, beyond_near: 1, ..BadDepths::default() };
        for (depth, bad, said) in [
            (LiveDepth::MillimetresU16, near, "are they metres"),
            (LiveDepth::MetresF32, near, "are they dioptres"),
            (LiveDepth::DioptresF16, near, "are they metres or millimetres"),
            (LiveDepth::MetresF16, BadDepths { beyond_far: 9, ..near }, "sends metres"),
            (LiveDepth::MetresF32, negative, "along -z"),
            (LiveDepth::DioptresF32, BadDepths { infinite: 99, ..near }, "is nothing drawn there"),
        ] {
            assert!(bad.likely_cure(depth).contains(said), "{depth:?}: {}", bad.likely_cure(depth));
        }
    }
}
