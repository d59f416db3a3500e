//! Feature maps on the GPU.

use super::plan::{BufferId, Constant, Plan};
use crate::gpu::Precision;

/// Channels of a group: what one vector of a shader holds.
pub(crate) const GROUP: usize = 4;
/// Rows that one thread of a convolution makes.
pub(crate) const ROWS: usize = 4;

/// A feature map [row, group of channels, column, 4] with a border of zeros, one pixel wide, and below it as many rows
/// as fill the last [`ROWS`]. Nothing but zeros is ever written there.
///
/// Channels are padded to whole groups; what is read of the padding is multiplied by zero, so it has to be finite.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Map {
    pub(crate) buffer: BufferId,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Groups of channels in each row.
    pub(crate) groups: usize,
    pub(crate) precision: Precision,
}

impl Map {
    /// A map of single precision.
    pub(crate) fn new(plan: &mut Plan, what: &'static str, size: (usize, usize), channels: usize) -> Self {
        Self::with(Precision::Single, plan, what, size, channels)
    }

    pub(crate) fn with(
        precision: Precision,
        plan: &mut Plan,
        what: &'static str,
        (width, height): (usize, usize),
        channels: usize,
    ) -> Self {
        let groups = channels.div_ceil(GROUP);
        let vectors = (height.next_multiple_of(ROWS) + 2) * groups * (width + 2);
        let buffer = match precision {
            Precision::Single => plan.buffer::<[f32; GROUP]>(what, vectors),
            Precision::Half => plan.buffer::<[u16; GROUP]>(what, vectors),
        };
        Self { buffer, width, height, groups, precision }
    }

    /// Bytes of the numbers inside the border.
    pub(crate) fn inner_bytes(&self) -> u64 {
        (self.groups * GROUP * self.width * self.height * self.precision.bytes()) as u64
    }

    /// Vectors from one group of a row to the next: that of channel group g of pixel (x, y) is
    /// ((y + 1)·groups + g)·pitch + x + 1.
    pub(crate) fn pitch(&self) -> usize {
        self.width + 2
    }

    /// The constants `{prefix}_GROUPS` and `{prefix}_PITCH` of a shader.
    pub(crate) fn constants<'a>(&self, [groups, pitch]: [&'a str; 2]) -> [(&'a str, Constant); 2] {
        [(groups, self.groups.into()), (pitch, self.pitch().into())]
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
