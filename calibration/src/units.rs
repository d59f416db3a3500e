//! Newtypes whose name or accessor carries the unit.

use std::fmt;
use std::ops::{Add, Index, IndexMut, Sub};

use serde::{Deserialize, Serialize};

/// A length in metres.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Metres(pub f64);

/// A vergence in dioptres (1/metre): the depth of a point or the focus of an eye. 0 is infinity.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct Dioptres(pub f64);

impl Sub for Dioptres {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0 - other.0)
    }
}

/// Entrance pupil diameter of an eye, in millimetres.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct PupilDiameter(f32);

impl PupilDiameter {
    /// A diameter given in millimetres.
    pub const fn from_mm(pupil_mm: f32) -> Self {
        Self(pupil_mm)
    }

    /// The diameter in millimetres.
    pub const fn mm(self) -> f32 {
        self.0
    }

    /// The diameter in metres.
    pub fn metres(self) -> Metres {
        Metres(f64::from(self.0) * 1e-3)
    }
}

/// A point on the host's monotonic clock, or a span between two, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TimeNs(pub i64);

impl TimeNs {
    /// A span given in seconds, rounded to the nearest nanosecond.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * 1e9).round() as i64)
    }

    /// The span in seconds.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }
}

impl Add for TimeNs {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0 + other.0)
    }
}

impl Sub for TimeNs {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0 - other.0)
    }
}

/// Width and height in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Resolution {
    /// Pixels in a row.
    pub width: usize,
    /// Pixels in a column.
    pub height: usize,
}

impl Resolution {
    /// The number of pixels, width times height.
    pub const fn pixels(self) -> usize {
        self.width * self.height
    }
}

impl fmt::Display for Resolution {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

/// One of the three laser colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Colour {
    /// The colour of the longest wavelength; the first in arrays of three.
    Red,
    /// The colour of the middle wavelength.
    Green,
    /// The colour of the shortest wavelength.
    Blue,
}

impl Colour {
    /// Red, green, blue: the order of every array of three in holod.
    pub const ALL: [Self; 3] = [Self::Red, Self::Green, Self::Blue];

    /// 0 for red, 1 for green, 2 for blue.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The lower-case English name, as in files and logs.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Red => "red",
            Self::Green => "green",
            Self::Blue => "blue",
        }
    }
}

impl fmt::Display for Colour {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One value for each colour, in the order red, green, blue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PerColour<T>(pub [T; 3]);

impl<T> PerColour<T> {
    /// Applies `f` to each value.
    pub fn map<U>(self, f: impl FnMut(T) -> U) -> PerColour<U> {
        PerColour(self.0.map(f))
    }

    /// Each colour with its value, red first.
    pub fn iter(&self) -> impl Iterator<Item = (Colour, &T)> {
        Colour::ALL.into_iter().zip(&self.0)
    }
}

impl<T> Index<Colour> for PerColour<T> {
    type Output = T;
    fn index(&self, colour: Colour) -> &T {
        &self.0[colour.index()]
    }
}

impl<T> IndexMut<Colour> for PerColour<T> {
    fn index_mut(&mut self, colour: Colour) -> &mut T {
        &mut self.0[colour.index()]
    }
}
