//! The layers that weights hold, and how a family stacks them.

use super::config::{Architecture, CONDITIONS, LIT, NetworkConfig, OUTPUT_CHANNELS};

/// Offsets that an adjustable layer predicts for each pixel: (dy, dx) of nine taps.
pub(crate) const OFFSET_CHANNELS: usize = 18;

/// The names of the tensors of [`Feedback`]; a `focal-stack` has the first alone.
pub(super) const FEEDBACK_SHARE: &str = "feedback_share";
pub(super) const SHARPNESS: &str = "sharpness";

/// The stacks of layers that a family has.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Family {
    Direct { layers: Vec<Layer> },
    ExpectedStack { lighting: Vec<Layer>, correction: Vec<Layer>, feedback: Feedback },
    FocalStack { lighting: Vec<Layer>, correction: Vec<Layer>, feedback_share: f32 },
}

/// How what is lacking is fed back to the field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Feedback {
    /// The share of the change that would give what is lacking which the field takes.
    pub(crate) share: f32,
    /// How much more a layer's change weighs where that layer is in focus.
    pub(crate) sharpness: f32,
}

impl Family {
    /// Every stack with the name that its tensors begin with, as `config` asks for it; `number` gives a tensor of one
    /// value.
    pub(super) fn read<E>(
        config: &NetworkConfig,
        mut layer: impl FnMut(&LayerShape) -> Result<Layer, E>,
        number: impl Fn(&str) -> Result<f32, E>,
    ) -> Result<Self, E> {
        let mut stack_of = |name, inputs, outputs, count, adjustable: &[usize]| {
            (0..count)
                .map(|index| {
                    layer(&LayerShape {
                        name: format!("{name}.{index}"),
                        in_channels: if index == 0 { inputs } else { config.channels },
                        out_channels: if index + 1 == count { outputs } else { config.channels },
                        modulation_hidden: adjustable.contains(&index).then_some(config.modulation_hidden),
                    })
                })
                .collect::<Result<Vec<_>, E>>()
        };
        let maps = config.map_channels();
        let adjustable = &config.adjustable_layers;
        Ok(match config.architecture {
            Architecture::Direct => {
                Self::Direct { layers: stack_of("layers", maps, OUTPUT_CHANNELS, config.layers, adjustable)? }
            }
            Architecture::ExpectedStack => {
                let stack = 3 * config.depth_layers;
                Self::ExpectedStack {
                    lighting: stack_of(
                        "lighting",
                        maps + stack,
                        config.lighting_channels(),
                        config.layers,
                        adjustable,
                    )?,
                    correction: stack_of(
                        "correction",
                        2 * OUTPUT_CHANNELS + maps + 2 * stack,
                        OUTPUT_CHANNELS,
                        config.correction_layers,
                        &[],
                    )?,
                    feedback: Feedback { share: number(FEEDBACK_SHARE)?, sharpness: number(SHARPNESS)? },
                }
            }
            Architecture::FocalStack => {
                let images = 3 * config.planes;
                // Each image four times after the unshuffle.
                let told = 4 * images + CONDITIONS;
                let (lights, corrects) = (LIT * config.planes, 2 * OUTPUT_CHANNELS + told + images);
                Self::FocalStack {
                    lighting: stack_of("lighting", told, lights, config.layers, adjustable)?,
                    correction: stack_of("correction", corrects, OUTPUT_CHANNELS, config.correction_layers, &[])?,
                    feedback_share: number(FEEDBACK_SHARE)?,
                }
            }
        })
    }
}

/// What the configuration says of one layer.
pub(super) struct LayerShape {
    /// What its tensors' names begin with.
    pub(super) name: String,
    pub(super) in_channels: usize,
    pub(super) out_channels: usize,
    /// Of an adjustable layer.
    pub(super) modulation_hidden: Option<usize>,
}

/// One layer of 3x3 convolutions.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Layer {
    pub(crate) out_channels: usize,
    pub(crate) in_channels: usize,
    /// [out, in, 3, 3]
    pub(crate) weight: Vec<f32>,
    /// Of each output channel, [out].
    pub(crate) bias: Vec<f32>,
    pub(crate) adjustable: Option<Adjustable>,
}

/// What an adjustable deformable layer has besides its own kernel.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Adjustable {
    /// W0, [18, in, 3, 3]
    pub(crate) offset_weight: Vec<f32>,
    /// b0, of each offset, [18].
    pub(crate) offset_bias: Vec<f32>,
    /// g_m: 2 → hidden → hidden → 18·in + 18
    pub(crate) modulation: [Dense; 3],
}

/// A fully connected layer.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Dense {
    pub(crate) inputs: usize,
    /// Of each input in each output, [outputs, inputs].
    pub(crate) weight: Vec<f32>,
    /// Of each output, [outputs].
    pub(crate) bias: Vec<f32>,
}
