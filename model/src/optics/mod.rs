//! Wave optics: holograms, how light propagates, how a field becomes a phase pattern, and what an eye sees.

pub(crate) mod double_phase;
mod eye;
mod fft;
mod propagation;
mod upsample;

use holod_calibration::{Colour, Resolution};
use num_complex::Complex32;

pub use double_phase::{DoublePhase, DoublePhaseReport};
pub use eye::{Eye, SimulatedEye};
#[cfg(test)]
pub(crate) use fft::TransposedFft2d;
pub(crate) use fft::signed_bin;
pub use propagation::Propagator;
pub(crate) use propagation::transfer_table;
pub(crate) use upsample::FourierUpsampler;

/// Amplitude and phase of each colour at the SLM plane, [3, height, width]. |value|² is linear light with white = 1.
#[derive(Clone, Debug, PartialEq)]
pub struct ComplexHologram {
    /// Columns and rows of one colour, in panel pixels.
    pub resolution: Resolution,
    /// Values, row-major within each colour, colours in the order red, green, blue.
    pub field: Vec<Complex32>,
}

impl ComplexHologram {
    /// A hologram without light: amplitude 0 everywhere.
    pub fn dark(resolution: Resolution) -> Self {
        Self { resolution, field: vec![Complex32::ZERO; 3 * resolution.pixels()] }
    }

    /// One colour, row-major [height, width].
    pub fn plane(&self, colour: Colour) -> &[Complex32] {
        let pixels = self.resolution.pixels();
        &self.field[colour.index() * pixels..][..pixels]
    }

    /// One colour, row-major [height, width], to write to.
    pub fn plane_mut(&mut self, colour: Colour) -> &mut [Complex32] {
        let pixels = self.resolution.pixels();
        &mut self.field[colour.index() * pixels..][..pixels]
    }
}

/// Phase of each colour at the SLM plane in radians, in [0, 2π), [3, height, width].
#[derive(Clone, Debug, PartialEq)]
pub struct PhasePattern {
    /// Columns and rows of one colour, in panel pixels.
    pub resolution: Resolution,
    /// Values, row-major within each colour, colours in the order red, green, blue.
    pub phase_rad: Vec<f32>,
}

impl PhasePattern {
    /// A pattern of phase 0 everywhere, which leaves light as it is.
    pub fn flat(resolution: Resolution) -> Self {
        Self { resolution, phase_rad: vec![0.0; 3 * resolution.pixels()] }
    }

    /// One colour, row-major [height, width].
    pub fn plane(&self, colour: Colour) -> &[f32] {
        let pixels = self.resolution.pixels();
        &self.phase_rad[colour.index() * pixels..][..pixels]
    }

    /// One colour, row-major [height, width], to write to.
    pub fn plane_mut(&mut self, colour: Colour) -> &mut [f32] {
        let pixels = self.resolution.pixels();
        &mut self.phase_rad[colour.index() * pixels..][..pixels]
    }
}
