//! The spectrum of the disc of confusion, for the blur of depth layers.

use std::f64::consts::{PI, SQRT_2};

use holod_calibration::DisplayGeometry;

use crate::conditions::WIDEST_PUPIL;

/// Entries of the table to a unit of its argument: linear interpolation is then within 5e-7.
const DENSITY: f64 = 256.0;
/// The largest argument of the table: beyond it a disc's spectrum is below 1e-5, and taken as 0.
const LARGEST_ARGUMENT: f64 = 4096.0;

/// 2·J1(x)/x as a table, for every blur between layers of one bench that a pupil may make.
pub(super) struct DiscTable {
    /// The value at `x` is the entry `x * DENSITY`.
    pub(super) values: Vec<f32>,
    /// Entries to a millimetre of pupil, for the blur of a layer's neighbour at a cycle a sample.
    pub(super) entries_per_mm: f64,
}

impl DiscTable {
    /// For `layers` of the depth range of `bench`, on a grid of `sample_rad` from one sample to the next.
    ///
    /// The largest argument is that of the whole range at the widest pupil, of the highest frequency, half a cycle a
    /// sample each way: 1.11 to a panel pixel of blur on the half-band grid, so a bench of 250 px at 8 mm has 180
    /// thousand entries. A frame reads only those up to its own pupil's.
    pub(super) fn new(bench: &DisplayGeometry, layers: usize, sample_rad: f64) -> Self {
        let argument_per_mm = PI * (bench.volume().0 / layers as f64) * 1e-3 / sample_rad;
        let largest = argument_per_mm * f64::from(WIDEST_PUPIL.mm()) * layers as f64 / SQRT_2;
        let value = |entry: usize| match entry as f64 / DENSITY {
            0.0 => 1.0,
            x => (2.0 * libm::j1(x) / x) as f32,
        };
        let entries = (largest.min(LARGEST_ARGUMENT) * DENSITY) as usize + 2;
        Self { values: (0..entries).map(value).collect(), entries_per_mm: argument_per_mm * DENSITY }
    }
}
