//! What network weights are for: the `config` of a weights file.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::conditions::TrainedRange;

/// What networks are told of a bench and a pupil, as maps and as inputs: [`Conditions`](crate::conditions::Conditions).
pub(crate) const CONDITIONS: usize = 2;

/// Real and imaginary residual of three colours.
pub(crate) const OUTPUT_CHANNELS: usize = 6;

/// Outputs of the first net of `expected-stack` for each depth layer: the phases of three colours and a mask; then,
/// after those of all layers, changes of three colours' amplitudes if it refines the stack.
pub(crate) const LIT: usize = 4;
pub(crate) const REFINED: usize = 3;

/// Depth layers that a network may have.
pub(crate) const MOST_DEPTH_LAYERS: usize = 64;

/// What network the weights are for and what they were trained for, as the file's `config` says it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// The family of networks that it is of, which says what its input and its layers are.
    pub architecture: Architecture,
    /// Version of the family; 2 is known.
    pub version: u32,
    /// The grid on which the network predicts.
    pub grid: Grid,
    /// 3x3 layers of `direct`'s net or of the other families' first: the first, pairs of body layers, the last.
    pub layers: usize,
    /// Feature channels of the body.
    pub channels: usize,
    /// Which body layers are adjustable deformable ones.
    pub adjustable_layers: Vec<usize>,
    /// Width of the hidden layers of the network that turns what is told of bench and pupil into a modulation.
    pub modulation_hidden: usize,
    /// Slope of the leaky rectifier below zero.
    pub leaky_slope: f32,
    /// Benches and pupils trained for.
    pub trained: TrainedRange,
    /// Amplitude that double phase maps to 1.
    pub amplitude_constant: f32,
    /// `expected-stack`: into how many layers, equal in dioptres, the depth volume is divided.
    #[serde(default = "default_depth_layers", skip_serializing_if = "is_default_depth_layers")]
    pub depth_layers: usize,
    /// 3x3 layers of the net that corrects what arrives at the SLM plane, where there is one.
    #[serde(default = "default_correction_layers", skip_serializing_if = "is_default_correction_layers")]
    pub correction_layers: usize,
    /// `expected-stack`: whether the first net also corrects the expected images before they light the layers and are
    /// asked for by the feedback. Both nets are told them uncorrected.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub refined_stack: bool,
    /// `focal-stack`: how many images, equally far apart in dioptres from one end of the depth range to the other.
    #[serde(default = "default_planes", skip_serializing_if = "is_default_planes")]
    pub planes: usize,
    /// `focal-stack`: whether what the field lacks of the images is fed back and corrected; only such networks are run.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub feedback: bool,
}

// The trainer leaves out what has its default, so that files of older networks stay as they are.
pub(super) const fn default_depth_layers() -> usize {
    8
}

fn is_default_depth_layers(count: &usize) -> bool {
    *count == default_depth_layers()
}

pub(super) const fn default_correction_layers() -> usize {
    10
}

fn is_default_correction_layers(count: &usize) -> bool {
    *count == default_correction_layers()
}

pub(super) const fn default_planes() -> usize {
    6
}

fn is_default_planes(count: &usize) -> bool {
    *count == default_planes()
}

/// How a network comes to the field at the SLM plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Architecture {
    /// The field is a residual to the amplitude.
    Direct,
    /// Light on every depth layer for what an eye should see there, carried by physics, what that lacks fed back, and a
    /// residual.
    ExpectedStack,
    /// The same with true images, each focused at its plane, in place of what is expected, and without depth.
    FocalStack,
}

impl fmt::Display for Architecture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Direct => "direct",
            Self::ExpectedStack => "expected-stack",
            Self::FocalStack => "focal-stack",
        })
    }
}

/// The grid on which a network predicts the field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Grid {
    /// Half the resolution in each direction; the field is Fourier-upsampled by 2 afterwards.
    HalfBand,
    /// The grid of the panel itself, so that nothing is upsampled.
    Full,
}

impl NetworkConfig {
    /// 3x3 layers of all its nets.
    pub fn layer_count(&self) -> usize {
        match self.architecture {
            Architecture::Direct => self.layers,
            Architecture::ExpectedStack | Architecture::FocalStack => self.layers + self.correction_layers,
        }
    }

    /// Channels that describe the frame: amplitude and two depth channels, each four times after the unshuffle on the
    /// half-band grid, and what is told of bench and pupil.
    pub(crate) fn map_channels(&self) -> usize {
        match self.grid {
            Grid::HalfBand => 4 * 5 + CONDITIONS,
            Grid::Full => 5 + CONDITIONS,
        }
    }

    /// Channels of what the first net of `expected-stack` gives.
    pub(crate) fn lighting_channels(&self) -> usize {
        (LIT + usize::from(self.refined_stack) * REFINED) * self.depth_layers
    }
}
