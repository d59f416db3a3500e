//! Figures of the networks that the engines have in common.

/// The least share of a white scene's light by which what is seen is divided.
pub(super) const LEAST_COVER: f32 = 0.02;
/// Of the first net's changes, in the amplitudes.
pub(super) const REFINED_SHARE: f32 = 0.3;
/// Keeps the phase of what is dark defined where an eye's view is fed back: |a| = sqrt(re² + im² + this).
pub(super) const FEEDBACK_DARK_POWER: f32 = 1e-6;
/// By how much of a layer's depth the four pixels behind a sample are moved before they are placed in one, as torch's
/// `pixel_unshuffle` orders them: samples near the border of two layers are shared by both, and on a slanted plane
/// sharpness goes over from one to the next.
pub(super) const LAYER_SHIFTS: [f32; 4] = [-0.375, 0.125, 0.375, -0.125];
/// White with red, and green with blue: real pictures, two to a complex transform.
pub(super) const PAIRS: usize = 2;
