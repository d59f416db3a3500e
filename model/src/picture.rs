//! Pictures in linear light.

use holod_calibration::{Colour, Resolution};

/// A picture in linear light: pixels [3, height, width], white = 1, colours in the order red, green, blue.
#[derive(Clone, Debug, PartialEq)]
pub struct LinearImage {
    /// Columns and rows of one colour.
    pub resolution: Resolution,
    /// Intensities, row-major within each colour.
    pub pixels: Vec<f32>,
}

impl LinearImage {
    /// A picture without light: 0 in every colour.
    pub fn black(resolution: Resolution) -> Self {
        Self { resolution, pixels: vec![0.0; 3 * resolution.pixels()] }
    }

    /// One colour, row-major [height, width].
    pub fn plane(&self, colour: Colour) -> &[f32] {
        let pixels = self.resolution.pixels();
        &self.pixels[colour.index() * pixels..][..pixels]
    }

    /// The picture as 8-bit sRGB, [height, width, 3]; intensities outside 0..=1 are clipped.
    pub fn to_srgb8(&self) -> Vec<u8> {
        let pixels = self.resolution.pixels();
        (0..pixels).flat_map(|pixel| [0, 1, 2].map(|c| srgb8(self.pixels[c * pixels + pixel]))).collect()
    }

    /// One colour, row-major [height, width], to write to.
    pub fn plane_mut(&mut self, colour: Colour) -> &mut [f32] {
        let pixels = self.resolution.pixels();
        &mut self.pixels[colour.index() * pixels..][..pixels]
    }
}

/// Linear light of an sRGB value, both 0..=1 (IEC 61966-2-1).
pub(crate) fn srgb_to_linear(encoded: f32) -> f32 {
    if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

/// Linear light, of which what lies outside 0..=1 is clipped, as 8-bit sRGB: the one place where light is encoded.
pub fn srgb8(linear: f32) -> u8 {
    (linear_to_srgb(linear.clamp(0.0, 1.0)) * 255.0).round() as u8
}

/// sRGB value of linear light, both 0..=1 (IEC 61966-2-1).
fn linear_to_srgb(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_round_trips_and_matches_the_standard_at_mid_grey() {
        for step in 0..=255u8 {
            let encoded = f32::from(step) / 255.0;
            assert!((linear_to_srgb(srgb_to_linear(encoded)) - encoded).abs() < 1e-5);
        }
        assert!((srgb_to_linear(0.5) - 0.214_041).abs() < 1e-5);
    }
}
