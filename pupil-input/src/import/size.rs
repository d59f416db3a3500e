//! What the figures of a pupil's size are, and how they become diameters.

use std::f64::consts::PI;

use crate::size_unit::SizeUnit;

/// What a figure is of a pupil.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Measure {
    Diameter,
    Radius,
    Area,
}

impl Measure {
    pub(super) fn diameter(self, figure: f64) -> f64 {
        match self {
            Self::Diameter => figure,
            Self::Radius => 2.0 * figure,
            Self::Area => 2.0 * (figure / PI).sqrt(),
        }
    }

    pub(super) const fn plural(self) -> &'static str {
        match self {
            Self::Diameter => "diameters",
            Self::Radius => "radii",
            Self::Area => "areas",
        }
    }
}

/// What a name or a text says of a size.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Said {
    pub(super) area: bool,
    pub(super) diameter: bool,
    pub(super) radius: bool,
}

impl Said {
    /// By the words in texts of small letters.
    pub(super) fn by(texts: &[&str]) -> Self {
        let has = |word: &str| texts.iter().any(|text| text.contains(word));
        Self { area: has("area"), diameter: has("diam"), radius: has("radius") }
    }

    /// The one measure that it says.
    pub(super) const fn only(self) -> Option<Measure> {
        match (self.area, self.diameter, self.radius) {
            (true, false, false) => Some(Measure::Area),
            (false, true, false) => Some(Measure::Diameter),
            (false, false, true) => Some(Measure::Radius),
            _ => None,
        }
    }
}

/// The unit of a size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Unit {
    pub(super) unit: SizeUnit,
    /// Millimetres or pixels of a length of one.
    pub(super) factor: f64,
    /// It is the square of that, so that figures are areas.
    pub(super) is_squared: bool,
}

impl Unit {
    /// The unit that `text` of small letters names, if it is one of size.
    pub(super) fn named(text: &str) -> Option<Self> {
        let text = text.replace(' ', "");
        let length = |text: &str, is_squared| length(text).map(|(unit, factor)| Self { unit, factor, is_squared });
        let squared = |power: &&str| length(text.strip_suffix(*power)?, true);
        ["^2", "**2", "\u{b2}", "2"].iter().find_map(squared).or_else(|| length(&text, false))
    }

    /// What the figures are by what is said of them, and why they may be something else.
    pub(super) fn measure(self, name: Said, about: Said) -> (Measure, Option<&'static str>) {
        // Pixels count areas as well as lengths.
        let is_length = !self.is_squared && self.unit == SizeUnit::Millimetres;
        match (name.only(), about.only()) {
            (Some(Measure::Diameter | Measure::Radius), _) if self.is_squared => {
                (Measure::Area, Some("its name says a length and its unit is one of area"))
            }
            _ if self.is_squared => (Measure::Area, None),
            (Some(Measure::Area), _) if is_length => {
                (Measure::Area, Some("its name says area and its unit is one of length"))
            }
            (Some(Measure::Diameter), Some(Measure::Radius)) => {
                (Measure::Diameter, Some("its name says diameter and its description radius"))
            }
            (Some(Measure::Radius), Some(Measure::Diameter)) => {
                (Measure::Radius, Some("its name says radius and its description diameter"))
            }
            (Some(measure), _) => (measure, None),
            (None, Some(Measure::Area)) if is_length => {
                (Measure::Diameter, Some("its description says area and its unit is one of length"))
            }
            (None, Some(measure)) => (measure, None),
            (None, None) if is_length => (Measure::Diameter, None),
            (None, None) => (Measure::Diameter, Some("neither its unit nor its description says which it is")),
        }
    }
}

pub(super) const MILLIMETRES: Unit = Unit { unit: SizeUnit::Millimetres, factor: 1.0, is_squared: false };
pub(super) const PIXELS: Unit = Unit { unit: SizeUnit::Pixels, factor: 1.0, is_squared: false };
/// Of figures in an unknown unit.
pub(super) const ARBITRARY: Unit = Unit { unit: SizeUnit::Arbitrary, factor: 1.0, is_squared: false };

/// A unit of length and its factor to millimetres or pixels.
fn length(unit: &str) -> Option<(SizeUnit, f64)> {
    Some(match unit {
        "mm" | "millimetre" | "millimetres" | "millimeter" | "millimeters" => (SizeUnit::Millimetres, 1.0),
        "cm" | "centimetre" | "centimetres" | "centimeter" | "centimeters" => (SizeUnit::Millimetres, 10.0),
        "m" | "metre" | "metres" | "meter" | "meters" => (SizeUnit::Millimetres, 1e3),
        // The micro sign and the Greek letter.
        "um" | "\u{b5}m" | "\u{3bc}m" | "micrometre" | "micrometres" | "micrometer" | "micrometers" => {
            (SizeUnit::Millimetres, 1e-3)
        }
        "px" | "pixel" | "pixels" => (SizeUnit::Pixels, 1.0),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_is_one_of_a_unit_that_is_known() {
        for squared in ["mm^2", "mm\u{b2}", "mm2", "mm ** 2", "px^2", "\u{3bc}m\u{b2}"] {
            assert!(Unit::named(squared).is_some_and(|unit| unit.is_squared), "{squared}");
        }
        assert_eq!(Unit::named("cm"), Some(Unit { unit: SizeUnit::Millimetres, factor: 10.0, is_squared: false }));
        assert_eq!(["", "volts", "^2", "2"].map(Unit::named), [None; 4]);
        // A disc of 3 mm.
        assert!((Measure::Area.diameter(7.0686) - 3.0).abs() < 1e-4);
    }
}
