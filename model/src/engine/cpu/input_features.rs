//! How a frame and fields become maps for the nets of `expected-stack`, and maps a field again.

use holod_calibration::{Colour, DisplayGeometry, Metres};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::{Blocks, scale_of};
use super::feature_map::FeatureMap;
use crate::RgbdFrame;
use crate::conditions::Conditions;
use crate::weights::{CONDITIONS, Grid, OUTPUT_CHANNELS};

pub(super) const SCALE: usize = scale_of(Grid::HalfBand);
/// Panel pixels to a sample of the grid.
pub(super) const BLOCK: usize = SCALE * SCALE;
/// Amplitude and two depth maps, each four times, and what is told of bench and pupil.
pub(super) const MAPS: usize = 5 * BLOCK + CONDITIONS;
/// Where the second net's input has the maps: after the field.
pub(super) const FIRST_MAP: usize = OUTPUT_CHANNELS;
/// Pixels whose channels stay in the first-level cache while one plane after another is read or written.
pub(super) const RUN_PX: usize = 16;
/// The share of the second net's output that is added to the field.
const CORRECTION_SHARE: f32 = 0.3;

/// The distance between the centres of neighbouring samples of the grid.
pub(super) fn sample_pitch(bench: &DisplayGeometry) -> Metres {
    Metres(SCALE as f64 * bench.pixel_pitch.0)
}

/// Writes what a net is told of a frame, bench and pupil to the channels of `map` from `first` on.
pub(super) fn write_maps(map: &mut FeatureMap, first: usize, frame: &RgbdFrame, conditions: Conditions) {
    let blocks = Blocks { frame: frame.resolution, scale: SCALE };
    let (columns, stride, pixels) = (map.width, map.stride, frame.resolution.pixels());
    let (told, blur_scale) = (conditions.told().map(|value| value as f32), conditions.blur_scale() as f32);
    map.rows_mut().enumerate().for_each(|(y, row)| {
        for (x, channels) in row[stride..][..columns * stride].chunks_exact_mut(stride).enumerate() {
            let maps = &mut channels[first..][..MAPS];
            for corner in 0..BLOCK {
                let source = blocks.index(x, y, corner);
                for colour in 0..3 {
                    maps[colour * BLOCK + corner] = frame.amplitude[colour * pixels + source] - 0.4;
                }
                let centred = frame.depth_normalised[source] - 0.5;
                maps[3 * BLOCK + corner] = 2.0 * centred;
                maps[4 * BLOCK + corner] = centred * blur_scale;
            }
            maps[5 * BLOCK..].copy_from_slice(&told);
        }
    });
}

impl FeatureMap {
    /// Writes planes [height, width] to the channels from `first` on, each value through `change`.
    pub(super) fn write_planes<'a>(
        &mut self,
        first: usize,
        planes: impl Iterator<Item = &'a [f32]> + Clone + Sync,
        change: impl Fn(f32) -> f32 + Sync,
    ) {
        let (width, stride) = (self.width, self.stride);
        self.rows_mut().enumerate().for_each(|(y, row)| {
            let runs = row[stride..][..width * stride].chunks_mut(RUN_PX * stride);
            for (x, pixels) in (0..width).step_by(RUN_PX).zip(runs) {
                for (channel, plane) in planes.clone().enumerate() {
                    let pixels = pixels[first + channel..].iter_mut().step_by(stride);
                    for (to, from) in pixels.zip(&plane[y * width + x..]) {
                        *to = change(*from);
                    }
                }
            }
        });
    }

    /// Writes fields [3, height, width] to six channels from `first` on, the real parts first.
    pub(super) fn write_fields(&mut self, first: usize, fields: &[Complex32]) {
        let (width, height, stride) = (self.width, self.height, self.stride);
        self.rows_mut().enumerate().for_each(|(y, row)| {
            for (colour, field) in fields.chunks_exact(width * height).enumerate() {
                let pixels = row[stride + first..].chunks_mut(stride);
                for (to, from) in pixels.zip(&field[y * width..][..width]) {
                    to[colour] = from.re;
                    to[3 + colour] = from.im;
                }
            }
        });
    }

    /// Writes `base` and a share of this correction of one colour to `field`, both [height, width]; the map's channels
    /// are three real parts and three imaginary ones.
    pub(super) fn correct(&self, base: &[Complex32], colour: Colour, field: &mut [Complex32]) {
        let rows = field.par_chunks_exact_mut(self.width).zip(base.par_chunks_exact(self.width));
        rows.enumerate().for_each(|(y, (row, base))| {
            for (x, (value, base)) in row.iter_mut().zip(base).enumerate() {
                let residual = self.pixel(x, y);
                let residual = Complex32::new(residual[colour.index()], residual[3 + colour.index()]);
                *value = base + residual * CORRECTION_SHARE;
            }
        });
    }
}
