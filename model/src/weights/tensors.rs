//! Reads the tensors of a weights file.

use safetensors::{Dtype, SafeTensors};

use super::config::CONDITIONS;
use super::error::WeightsError;
use super::layers::{Adjustable, Dense, Layer, LayerShape, OFFSET_CHANNELS};

/// Reads tensors of known shape.
pub(super) struct TensorReader<'a> {
    pub(super) name: &'a str,
    pub(super) tensors: SafeTensors<'a>,
}

impl TensorReader<'_> {
    pub(super) fn layer(&self, shape: &LayerShape) -> Result<Layer, WeightsError> {
        let LayerShape { name, in_channels, out_channels, modulation_hidden } = shape;
        Ok(Layer {
            out_channels: *out_channels,
            in_channels: *in_channels,
            weight: self.tensor(&format!("{name}.weight"), &[*out_channels, *in_channels, 3, 3])?,
            bias: self.tensor(&format!("{name}.bias"), &[*out_channels])?,
            adjustable: modulation_hidden.map(|hidden| self.adjustable(name, *in_channels, hidden)).transpose()?,
        })
    }

    fn adjustable(&self, prefix: &str, channels: usize, hidden: usize) -> Result<Adjustable, WeightsError> {
        let outputs = OFFSET_CHANNELS * channels + OFFSET_CHANNELS;
        let dense = |index: usize, inputs: usize, outputs: usize| -> Result<Dense, WeightsError> {
            Ok(Dense {
                inputs,
                weight: self.tensor(&format!("{prefix}.modulation.{index}.weight"), &[outputs, inputs])?,
                bias: self.tensor(&format!("{prefix}.modulation.{index}.bias"), &[outputs])?,
            })
        };
        Ok(Adjustable {
            offset_weight: self.tensor(&format!("{prefix}.offset.weight"), &[OFFSET_CHANNELS, channels, 3, 3])?,
            offset_bias: self.tensor(&format!("{prefix}.offset.bias"), &[OFFSET_CHANNELS])?,
            modulation: [dense(0, CONDITIONS, hidden)?, dense(1, hidden, hidden)?, dense(2, hidden, outputs)?],
        })
    }

    pub(super) fn tensor(&self, tensor: &str, shape: &[usize]) -> Result<Vec<f32>, WeightsError> {
        let error = |found: String| WeightsError::Tensor {
            name: self.name.into(),
            tensor: tensor.into(),
            found,
            expected: format!("F32 of shape {shape:?} with finite values"),
        };
        let view = self.tensors.tensor(tensor).map_err(|_| error("absent".into()))?;
        if view.dtype() != Dtype::F32 || view.shape() != shape {
            return Err(error(format!("{:?} of shape {:?}", view.dtype(), view.shape())));
        }
        let values: Vec<f32> = view.data().as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect();
        match values.iter().position(|value| !value.is_finite()) {
            Some(index) => Err(error(format!("{} at index {index}", values[index]))),
            None => Ok(values),
        }
    }
}
