//! How a frame and fields become the map that both nets of a network read, and maps a field again.

use std::ops::Range;

use holod_calibration::{Colour, DisplayGeometry, Metres};
use num_complex::Complex32;
use rayon::prelude::*;

use super::blocks::{PIXELS_PER_SAMPLE, SCALE};
use super::column_blocks::ColumnBlocks;
use super::feature_map::{BAND, FeatureMap};
use super::frame_blocks::{DEPTH, FrameBlocks};
use crate::conditions::Conditions;
use crate::simd::{InstructionSet, MOST_LANES, Simd, Task};
use crate::weights::{CONDITIONS, OUTPUT_CHANNELS};

/// Amplitude and two depth maps, each four times, and what is told of bench and pupil.
pub(super) const MAPS: usize = 5 * PIXELS_PER_SAMPLE + CONDITIONS;
/// The share of the second net's output that is added to the field.
const CORRECTION_SHARE: f32 = 0.3;

/// The distance between the centres of neighbouring samples of the grid.
pub(super) fn sample_pitch(bench: &DisplayGeometry) -> Metres {
    Metres(SCALE as f64 * bench.pixel_pitch.0)
}

/// Which channels of the map that both nets read are what.
#[derive(Clone, Copy)]
pub(super) struct InputChannels {
    /// So many, the first ones, are told to both nets.
    pub(super) told: usize,
    /// From here on what the second net alone reads: the field, three real parts and three imaginary ones, its change
    /// likewise, and three colours of each plane of what is lacking. Nothing but zeros lies between what is told and
    /// this.
    pub(super) field: usize,
    /// All of them.
    pub(super) count: usize,
}

impl InputChannels {
    /// Of `planes` that are lit, in whole vectors of `set`.
    pub(super) fn new(told: usize, planes: usize, set: InstructionSet) -> Self {
        let field = told.next_multiple_of(set.lanes());
        Self { told, field, count: field + 2 * OUTPUT_CHANNELS + 3 * planes }
    }

    /// The channel of each input of the first net, in its weights' order.
    pub(super) fn lighting(self) -> Vec<usize> {
        (0..self.told).collect()
    }

    /// The same of the second net.
    pub(super) fn correction(self) -> Vec<usize> {
        let change = self.field + OUTPUT_CHANNELS;
        (self.field..change).chain(0..self.told).chain(change..self.count).collect()
    }
}

/// Writes what both nets are told of a frame, bench and pupil, and the amplitudes `stack` that an eye should see.
pub(super) fn write_inputs(
    map: &mut FeatureMap,
    frame: &FrameBlocks,
    conditions: Conditions,
    stack: &ColumnBlocks,
    set: InstructionSet,
) {
    let (told, blur_scale) = (conditions.told().map(|value| value as f32), conditions.blur_scale() as f32);
    map.write_channels(0..MAPS + stack.planes(), set, |block, y| Samples { frame, stack, told, blur_scale, block, y });
}

/// What is written to the channels of the pixels in one row of a block of columns.
trait Channels {
    /// One channel of each pixel.
    fn channel<S: Simd>(&self, simd: S, channel: usize) -> S::Vector;
}

/// What nets are told of the samples of a block.
struct Samples<'a> {
    frame: &'a FrameBlocks,
    stack: &'a ColumnBlocks,
    told: [f32; CONDITIONS],
    blur_scale: f32,
    block: usize,
    y: usize,
}

impl Channels for Samples<'_> {
    #[inline(always)]
    fn channel<S: Simd>(&self, simd: S, channel: usize) -> S::Vector {
        const AGAIN: usize = DEPTH + 1;
        let Self { frame, stack, told, blur_scale, block, y } = self;
        // The frame's planes, the depth once more, what is told, and the stack.
        let (planes, plane, less, factor) = match channel / PIXELS_PER_SAMPLE {
            0..DEPTH => (&frame.planes, channel, 0.4, 1.0),
            DEPTH => (&frame.planes, channel, 0.5, 2.0),
            AGAIN => (&frame.planes, channel - PIXELS_PER_SAMPLE, 0.5, *blur_scale),
            _ if channel < MAPS => return simd.splat(told[channel - 5 * PIXELS_PER_SAMPLE]),
            _ => (*stack, channel - MAPS, 0.4, 1.0),
        };
        let values = simd.read(planes.row_of_block(*block, plane, *y));
        simd.mul(simd.sub(values, simd.splat(less)), simd.splat(factor))
    }
}

/// Planes beside one another, of complex ones first all real parts.
struct Planes<'a> {
    blocks: &'a [&'a ColumnBlocks],
    block: usize,
    y: usize,
}

impl Channels for Planes<'_> {
    #[inline(always)]
    fn channel<S: Simd>(&self, simd: S, channel: usize) -> S::Vector {
        let mut plane = channel;
        for blocks in self.blocks {
            let count = blocks.planes() * blocks.parts();
            if plane < count {
                let (part, plane) = (plane / blocks.planes(), plane % blocks.planes());
                return simd.read(&blocks.row_of_block(self.block, plane, self.y)[part * S::LANES..]);
            }
            plane -= count;
        }
        unreachable!("there are so many channels")
    }
}

/// Writes channels to pixels.
struct WriteChannels<'a, C> {
    count: usize,
    channels: C,
    /// From the first channel that is written on.
    to: &'a mut [f32],
    /// From one pixel to the next.
    stride: usize,
}

impl<C: Channels> Task for WriteChannels<'_, C> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        const { assert!(S::LANES <= MOST_LANES) };
        let (mut rows, mut columns) = ([[0.0; MOST_LANES]; MOST_LANES], [[0.0; MOST_LANES]; MOST_LANES]);
        let count = S::LANES.min(self.count);
        for first in (0..self.count).step_by(S::LANES) {
            // The last ones begin early enough to be whole vectors, too.
            let first = first.min(self.count - count);
            for (channel, row) in rows.iter_mut().enumerate().take(count) {
                simd.write(row, self.channels.channel(simd, first + channel));
            }
            // SAFETY: both have MOST_LANES rows of so many values, of which LANES, no more, are read and written.
            unsafe {
                let (rows, columns) = (rows.as_flattened().as_ptr(), columns.as_flattened_mut().as_mut_ptr());
                simd.transpose(rows, columns, [MOST_LANES; 2]);
            }
            for (pixel, channels) in self.to.chunks_mut(self.stride).zip(&columns) {
                let pixel = &mut pixel[first..][..count];
                if count == S::LANES {
                    simd.write(pixel, simd.read(channels));
                } else {
                    pixel.iter_mut().zip(channels).for_each(|(to, from)| *to = *from);
                }
            }
        }
    }
}

impl FeatureMap {
    /// Writes planes to the channels from `first` on, those of one [`ColumnBlocks`] after another; of complex ones
    /// first all real parts.
    pub(super) fn write_planes(&mut self, first: usize, blocks: &[&ColumnBlocks], set: InstructionSet) {
        let count = blocks.iter().map(|blocks| blocks.planes() * blocks.parts()).sum::<usize>();
        self.write_channels(first..first + count, set, |block, y| Planes { blocks, block, y });
    }

    /// Writes what `channels(block, y)` has to the channels in `range`.
    fn write_channels<C: Channels>(
        &mut self,
        range: Range<usize>,
        set: InstructionSet,
        channels: impl Fn(usize, usize) -> C + Sync,
    ) {
        let (width, stride, row_len, lanes) = (self.width, self.stride, self.row_len, set.lanes());
        let Range { start: first, end } = range;
        self.bands_mut().enumerate().for_each(|(band, rows)| {
            for (block, x) in (0..width).step_by(lanes).enumerate() {
                let pixels = lanes.min(width - x);
                for (y, row) in (band * BAND..).zip(rows.chunks_exact_mut(row_len)) {
                    let to = &mut row[(x + 1) * stride + first..][..pixels * stride - first];
                    set.run(WriteChannels { count: end - first, channels: channels(block, y), to, stride });
                }
            }
        });
    }

    /// Writes `base` and a share of this correction of one colour to `field` [height, width]; the map's channels are
    /// three real parts and three imaginary ones.
    pub(super) fn correct(&self, base: &ColumnBlocks, colour: Colour, field: &mut [Complex32]) {
        field.par_chunks_exact_mut(self.width).enumerate().for_each(|(y, row)| {
            for (x, (value, base)) in row.iter_mut().zip(base.row_of_cells(colour.index(), y)).enumerate() {
                let residual = self.pixel(x, y);
                let residual = Complex32::new(residual[colour.index()], residual[3 + colour.index()]);
                *value = base + residual * CORRECTION_SHARE;
            }
        });
    }
}
