//! A panel's levels as plain data.

use crate::{Colour, PerColour, Resolution};

/// What turns phases into a panel's samples, for whoever does it elsewhere than the encoder that made it: on a GPU.
///
/// The sample of a pixel is entry ⌊φ/2π·n + flatness⌋ mod n of its colour's table of n entries, without
/// [`UNREACHABLE`](Self::UNREACHABLE). Pixels around the pattern have π/2 where x + y, counted from its first pixel, is
/// odd and −π/2 where it is even: double phase's darkness.
#[derive(Clone, Debug, PartialEq)]
pub struct LevelTables {
    /// Pixels of the panel.
    pub panel: Resolution,
    /// Pixels of the patterns, which are no larger.
    pub pattern: Resolution,
    /// Where the panel has a pattern's first pixel: column and row.
    pub origin: [usize; 2],
    /// Whether a pattern's columns run the other way on the panel, and whether its rows do.
    pub mirrors: [bool; 2],
    /// Whether samples are `[height, width, 3]`; else they are `[3, height, width]`. The 3 are `field_order`.
    pub interleaved: bool,
    /// The order in which colours are shown.
    pub field_order: [Colour; 3],
    /// The level of each range of phases; a power of two of them, as many for each colour.
    pub levels: PerColour<Vec<u32>>,
    /// What is added at each panel pixel, `[height, width]`, in entries of the table; 0 everywhere where it is absent.
    pub flatness: PerColour<Option<Vec<f32>>>,
}

impl LevelTables {
    /// Marks entries whose phase no level reaches.
    pub const UNREACHABLE: u32 = 1 << 16;
}
