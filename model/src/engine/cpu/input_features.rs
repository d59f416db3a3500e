//! How a frame and fields become the map that both nets of a network read, and maps a field again.

use std::array::from_fn;
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
    /// How many of them, the first ones, are told to both nets.
    pub(super) told: usize,
    /// From here on what the second net alone reads: the field, three real parts and three imaginary ones, its change
    /// likewise, and three colours of each plane of what is lacking. Nothing but zeros lies between what is told and
    /// this.
    pub(super) field: usize,
    /// The number of all channels.
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
    let told = conditions.told().map(|value| [value as f32; MOST_LANES]);
    let blur_scale = conditions.blur_scale() as f32;
    map.write_channels(0..MAPS + stack.planes(), set, |block, y| Samples { frame, stack, told, blur_scale, block, y });
}

/// What is written to the channels of the pixels in rows of a block of columns.
trait Channels {
    /// One channel of all of them.
    fn source(&self, channel: usize) -> Source<'_>;
}

/// Where the values of a channel lie, and what becomes of them: (value − less)·factor.
struct Source<'a> {
    /// From the first row on.
    values: &'a [f32],
    /// From one row to the next.
    pitch: usize,
    less: f32,
    factor: f32,
}

/// What nets are told of the samples of a block from row `y` on.
struct Samples<'a> {
    frame: &'a FrameBlocks,
    stack: &'a ColumnBlocks,
    /// A vector of each, whichever length vectors have.
    told: [[f32; MOST_LANES]; CONDITIONS],
    blur_scale: f32,
    block: usize,
    y: usize,
}

impl Channels for Samples<'_> {
    fn source(&self, channel: usize) -> Source<'_> {
        const AGAIN: usize = DEPTH + 1;
        let Self { frame, stack, told, blur_scale, block, y } = self;
        // The frame's planes, the depth once more, what is told, and the stack.
        let (planes, plane, less, factor) = match channel / PIXELS_PER_SAMPLE {
            0..DEPTH => (&frame.planes, channel, 0.4, 1.0),
            DEPTH => (&frame.planes, channel, 0.5, 2.0),
            AGAIN => (&frame.planes, channel - PIXELS_PER_SAMPLE, 0.5, *blur_scale),
            _ if channel < MAPS => {
                let values = &told[channel - 5 * PIXELS_PER_SAMPLE];
                return Source { values, pitch: 0, less: 0.0, factor: 1.0 };
            }
            _ => (*stack, channel - MAPS, 0.4, 1.0),
        };
        Source { values: planes.rows_of_block(*block, plane, *y), pitch: planes.row_len(), less, factor }
    }
}

/// Planes beside one another, of complex ones first all real parts, in a block from row `y` on.
struct Planes<'a> {
    blocks: &'a [&'a ColumnBlocks],
    block: usize,
    y: usize,
}

impl Channels for Planes<'_> {
    fn source(&self, channel: usize) -> Source<'_> {
        let mut plane = channel;
        for blocks in self.blocks {
            let count = blocks.planes() * blocks.parts();
            if plane < count {
                let (part, plane) = (plane / blocks.planes(), plane % blocks.planes());
                let pitch = blocks.row_len();
                let values = &blocks.rows_of_block(self.block, plane, self.y)[part * pitch / blocks.parts()..];
                return Source { values, pitch, less: 0.0, factor: 1.0 };
            }
            plane -= count;
        }
        unreachable!("there are so many channels")
    }
}

/// Writes channels to the pixels in rows of a block of columns. As many channels as a vector has lanes go through all
/// rows before the next ones do: what lies beside one another in memory is read together.
struct WriteChannels<'a, C> {
    count: usize,
    channels: C,
    rows: &'a mut [f32],
    row_len: usize,
    /// Where in a row the first channel of the first pixel lies.
    first: usize,
    pixels: usize,
    /// From one pixel to the next.
    stride: usize,
}

impl<C: Channels> Task for WriteChannels<'_, C> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        const { assert!(S::LANES <= MOST_LANES) };
        let Self { count: all, channels, rows, row_len, first: place, pixels, stride } = self;
        let (mut by_channel, mut by_pixel) = ([[0.0; MOST_LANES]; MOST_LANES], [[0.0; MOST_LANES]; MOST_LANES]);
        let count = S::LANES.min(all);
        for first in (0..all).step_by(S::LANES) {
            // The last ones begin early enough to be whole vectors, too.
            let first = first.min(all - count);
            let sources: [_; MOST_LANES] = from_fn(|channel| channels.source(first + channel.min(count - 1)));
            for (y, row) in rows.chunks_exact_mut(row_len).enumerate() {
                for (source, values) in sources.iter().zip(&mut by_channel).take(count) {
                    let less = simd.sub(simd.read(&source.values[y * source.pitch..]), simd.splat(source.less));
                    simd.write(values, simd.mul(less, simd.splat(source.factor)));
                }
                let (from, to) = (by_channel.as_flattened().as_ptr(), &mut row[place + first..]);
                if [pixels, count] == [S::LANES; 2] {
                    assert!(to.len() >= (S::LANES - 1) * stride + S::LANES);
                    // SAFETY: LANES rows of so many values lie in `by_channel`, and in `to` as asserted.
                    unsafe { simd.transpose(from, to.as_mut_ptr(), [MOST_LANES, stride]) };
                    continue;
                }
                // SAFETY: both have MOST_LANES rows of so many values, of which LANES, no more, are read and written.
                unsafe { simd.transpose(from, by_pixel.as_flattened_mut().as_mut_ptr(), [MOST_LANES; 2]) };
                for (pixel, values) in to.chunks_mut(stride).zip(&by_pixel).take(pixels) {
                    pixel.iter_mut().zip(&values[..count]).for_each(|(to, from)| *to = *from);
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

    /// Writes what `channels(block, y)` has from row y on to the channels in `range`.
    fn write_channels<C: Channels>(
        &mut self,
        range: Range<usize>,
        set: InstructionSet,
        channels: impl Fn(usize, usize) -> C + Sync,
    ) {
        let (width, stride, row_len, lanes) = (self.width, self.stride, self.row_len, set.lanes());
        let count = range.len();
        self.bands_mut().enumerate().for_each(|(band, rows)| {
            for (block, x) in (0..width).step_by(lanes).enumerate() {
                let (first, pixels) = ((x + 1) * stride + range.start, lanes.min(width - x));
                let channels = channels(block, band * BAND);
                set.run(WriteChannels { count, channels, rows, row_len, first, pixels, stride });
            }
        });
    }

    /// Writes `base` and a share of this correction of one colour to `field` [height, width]; the map's channels are
    /// three real parts and three imaginary ones.
    pub(super) fn correct(&self, base: &ColumnBlocks, colour: Colour, field: &mut [Complex32]) {
        assert_eq!(base.parts(), 2, "a field is complex");
        let (width, lanes) = (self.width, base.row_len() / base.parts());
        // As in `write_channels`, a block of columns after another.
        field.par_chunks_mut(BAND * width).enumerate().for_each(|(band, rows)| {
            for (block, x) in (0..width).step_by(lanes).enumerate() {
                let cells = base.rows_of_block(block, colour.index(), band * BAND).chunks_exact(base.row_len());
                for (y, (row, cell)) in (band * BAND..).zip(rows.chunks_exact_mut(width).zip(cells)) {
                    let (re, im) = cell.split_at(lanes);
                    for ((x, value), (re, im)) in (x..).zip(&mut row[x..]).zip(re.iter().zip(im)) {
                        let residual = self.pixel(x, y);
                        let residual = Complex32::new(residual[colour.index()], residual[3 + colour.index()]);
                        *value = Complex32::new(*re, *im) + residual * CORRECTION_SHARE;
                    }
                }
            }
        });
    }
}
