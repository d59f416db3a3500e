//! Feature maps on the GPU.

use super::plan::{BufferId, Constant, ENABLE_F16, Plan};
use crate::engine::Precision;
use crate::gpu::MatrixUnits;

/// Channels of a group: what one vector of a shader holds.
pub(crate) const GROUP: usize = 4;
/// Rows that one thread of a convolution makes, at most.
pub(crate) const ROWS: usize = 4;
/// Pixels of a row, and channels, of a matrix of [`Format::HalfTiles`].
pub(crate) const TILE: usize = 16;

/// How the numbers of a map lie on the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    /// [row, group of four channels, column, 4] in single precision.
    Single,
    /// The same in half precision.
    Half,
    /// [row, block of 16 channels, column, 16] in half precision, so that 16 neighbouring pixels of a block are a
    /// matrix. The layers that read such a map multiply on these units.
    HalfTiles(MatrixUnits),
}

impl Format {
    /// Of a network's features in `precision`, on a device with these units.
    pub(crate) fn of(precision: Precision, units: Option<MatrixUnits>) -> Self {
        match (precision, units) {
            (Precision::Single, _) => Self::Single,
            (Precision::Half, None) => Self::Half,
            (Precision::Half, Some(units)) => Self::HalfTiles(units),
        }
    }

    /// Of what a net with features in this format gives: sums of matrices that are no features leave it in single
    /// precision, but where bytes are what counts.
    pub(crate) fn of_outputs(self) -> Self {
        match self {
            Self::HalfTiles(units) if units.of_any_subgroups() => Self::Half,
            Self::HalfTiles(_) => Self::Single,
            _ => self,
        }
    }

    pub(crate) fn precision(self) -> Precision {
        match self {
            Self::Single => Precision::Single,
            Self::Half | Self::HalfTiles(_) => Precision::Half,
        }
    }

    /// Groups of channels that lie together for each pixel.
    pub(crate) fn block_groups(self) -> usize {
        if let Self::HalfTiles(_) = self { TILE / GROUP } else { 1 }
    }
}

/// A feature map with a border of zeros, one pixel wide, and below and beside it as much as fills the last matrix or
/// the last [`ROWS`]. Nothing but zeros is ever written there.
///
/// Channels are padded to whole blocks; what is read of the padding is multiplied by zero, so it has to be finite.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Map {
    pub(crate) buffer: BufferId,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Groups of channels in each row.
    pub(crate) groups: usize,
    pub(crate) format: Format,
}

impl Map {
    /// A map of single precision.
    pub(crate) fn new(plan: &mut Plan, what: &'static str, size: (usize, usize), channels: usize) -> Self {
        Self::with(Format::Single, plan, what, size, channels)
    }

    pub(crate) fn with(
        format: Format,
        plan: &mut Plan,
        what: &'static str,
        (width, height): (usize, usize),
        channels: usize,
    ) -> Self {
        let groups = channels.div_ceil(GROUP).next_multiple_of(format.block_groups());
        let mut map = Self { buffer: BufferId(0), width, height, groups, format };
        let vectors = map.rows() * groups * map.pitch();
        map.buffer = match format.precision() {
            Precision::Single => plan.buffer::<[f32; GROUP]>(what, vectors),
            Precision::Half => plan.buffer::<[u16; GROUP]>(what, vectors),
        };
        map
    }

    /// Bytes of the numbers inside the border.
    pub(crate) fn inner_bytes(&self) -> u64 {
        (self.groups * GROUP * self.width * self.height * self.format.precision().bytes()) as u64
    }

    /// Rows with those of the border, and those that are read beside the map's where [`ROWS`] end below it.
    pub(super) fn rows(&self) -> usize {
        self.height + ROWS + 1
    }

    /// Pixels from one block of a row to the next.
    pub(crate) fn pitch(&self) -> usize {
        match self.format {
            Format::Single | Format::Half => self.width + 2,
            Format::HalfTiles(_) => self.width.next_multiple_of(TILE) + 2,
        }
    }

    /// WGSL for a shader that writes or reads groups of this map: the type `{name}_vector` of its buffer's elements,
    /// and `{name}_place`, where the buffer has a group of a pixel.
    pub(crate) fn declaration(&self, name: &str) -> String {
        let directive = if self.format.precision() == Precision::Half { ENABLE_F16 } else { "" };
        let (vector, groups) = (self.format.precision().vector(), self.groups);
        let (pitch, block) = (self.pitch(), self.format.block_groups());
        format!(
            "{directive}alias {name}_vector = {vector};\n\n\
             fn {name}_place(group: u32, x: u32, y: u32) -> u32 {{\n    \
             let first = group / {block}u * {block}u;\n    \
             return ((y + 1u) * {groups}u + first) * {pitch}u + (x + 1u) * {block}u + group % {block}u;\n}}\n\n"
        )
    }

    /// The constants `{prefix}_GROUPS` and `{prefix}_PITCH` of a shader.
    pub(crate) fn constants<'a>(&self, [groups, pitch]: [&'a str; 2]) -> [(&'a str, Constant); 2] {
        [(groups, self.groups.into()), (pitch, self.pitch().into())]
    }

    /// The constant `{prefix}_BLOCK`, the groups of a block.
    pub(crate) fn block<'a>(&self, name: &'a str) -> (&'a str, Constant) {
        (name, self.format.block_groups().into())
    }
}

impl Precision {
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::Single => 4,
            Self::Half => 2,
        }
    }

    /// A group of channels in a shader.
    pub(crate) fn vector(self) -> &'static str {
        match self {
            Self::Single => "vec4<f32>",
            Self::Half => "vec4<f16>",
        }
    }
}
