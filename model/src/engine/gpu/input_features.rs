//! How a frame and fields become the map that both nets of `expected-stack` read, for `input_features.wgsl` and its
//! users.

use holod_calibration::{DisplayGeometry, Metres, Resolution};

use super::map::{Format, GROUP, Map};
use super::plan::{Constant, Plan};
use super::shared::Shared;
use crate::weights::{CONDITIONS, OUTPUT_CHANNELS};

/// Amplitude and two depth maps, each four times.
const FRAME_MAPS: usize = 4 * 5;

/// Which channels of the map are what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct InputChannels {
    /// From here on the expected amplitudes less 0.4, [layers, 3], in whole groups with what follows; before them the
    /// frame's maps.
    pub(crate) stack: usize,
    /// From here on what is told of bench and pupil.
    pub(crate) told: usize,
    /// From here on what the second net alone reads, in whole blocks: three real parts of the field, then three
    /// imaginary ones. Channels between what is told and this are zero.
    pub(crate) field: usize,
    /// The same of the field's change.
    pub(crate) change: usize,
    /// From here on what is lacking of the expected amplitudes, [layers, 3].
    pub(crate) lack: usize,
    depth_layers: usize,
    format: Format,
}

impl InputChannels {
    /// Of a map in `format`.
    pub(crate) fn new(depth_layers: usize, format: Format) -> Self {
        let told = FRAME_MAPS + 3 * depth_layers;
        let field = (told + CONDITIONS).next_multiple_of(GROUP * format.block_groups());
        let change = field + OUTPUT_CHANNELS;
        Self { stack: FRAME_MAPS, told, field, change, lack: change + OUTPUT_CHANNELS, depth_layers, format }
    }

    /// Channels of the map.
    fn count(self) -> usize {
        self.lack + 3 * self.depth_layers
    }

    /// The channel of each input of the first net, in its weights' order.
    pub(crate) fn lighting(self) -> Vec<usize> {
        (0..FRAME_MAPS).chain(self.told..self.told + CONDITIONS).chain(self.stack..self.told).collect()
    }

    /// The same of the second net.
    pub(crate) fn correction(self) -> Vec<usize> {
        (self.field..self.change).chain(self.lighting()).chain(self.change..self.count()).collect()
    }

    /// The map that both nets read, on the network's grid.
    pub(crate) fn map(self, plan: &mut Plan, size: Resolution) -> Map {
        Map::with(self.format, plan, "what the nets read", (size.width, size.height), self.count())
    }
}

/// The distance between the centres of neighbouring samples of the half-band grid.
pub(super) fn sample_pitch(bench: &DisplayGeometry) -> Metres {
    Metres(2.0 * bench.pixel_pitch.0)
}

/// Layers that a workgroup takes together of rows: as many as fill whole groups of the map, or all.
pub(super) fn layers_together(depth_layers: usize) -> usize {
    if depth_layers.is_multiple_of(GROUP) { GROUP } else { depth_layers }
}

/// Bytes of one plane on the network's grid.
pub(super) struct PlaneBytes {
    /// A byte a pixel.
    pub(super) byte: u64,
    /// Of complex numbers as they are stored.
    pub(super) complex: u64,
    /// Of real numbers in the precision of the map that both nets read, and a group of that map.
    pub(super) real: u64,
    pub(super) group: u64,
}

impl PlaneBytes {
    pub(super) fn new(shared: &Shared, inputs: Format) -> Self {
        let byte = shared.size.pixels() as u64;
        let real = byte * inputs.precision().bytes() as u64;
        Self { byte, complex: 2 * byte * shared.stored.bytes() as u64, real, group: GROUP as u64 * real }
    }
}

/// The constants of a grid and the frame on it.
pub(super) fn grid_constants(frame: Resolution, size: Resolution) -> [(&'static str, Constant); 4] {
    [
        ("FRAME_WIDTH", frame.width.into()),
        ("FRAME_HEIGHT", frame.height.into()),
        ("WIDTH", size.width.into()),
        ("HEIGHT", size.height.into()),
    ]
}
