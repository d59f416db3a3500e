//! Plans of one-dimensional Fourier transforms, made by `rustfft`.
//!
//! Its code is generic, so that each crate, and each crate's unit tests, that plan a transform would compile all of it
//! again: 2 of the 5 MB of `model`. Here that is done once.

use std::sync::Arc;

use rustfft::{FftNum, FftPlanner, FftPlannerScalar};

pub use rustfft::{Fft, FftDirection, num_complex};

/// The real and imaginary parts of samples: single or double precision.
pub trait Real: FftNum {
    /// Plans the transform, not normalised, of `length` samples.
    fn plan(length: usize, direction: FftDirection) -> Arc<dyn Fft<Self>>;
}

impl Real for f32 {
    fn plan(length: usize, direction: FftDirection) -> Arc<dyn Fft<Self>> {
        FftPlanner::new().plan_fft(length, direction)
    }
}

/// Tables and references are made in double precision, and no frames: with kernels of its own for each kind of processor
/// this crate would be compiled for two thirds longer.
impl Real for f64 {
    fn plan(length: usize, direction: FftDirection) -> Arc<dyn Fft<Self>> {
        FftPlannerScalar::new().plan_fft(length, direction)
    }
}
