//! The network's weights: one safetensors file that says what it was trained for.

use std::collections::HashMap;
use std::fmt;
use std::path::{Path, PathBuf};

use holod_calibration::{DisplayGeometry, PupilDiameter};
use safetensors::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};

use crate::conditions::{BenchFit, TrainedRange};

/// The value of the metadata key `format` that this crate reads.
const FORMAT: &str = "holod-weights-2";
/// Its value in files for one bench, of networks that were told the pupil in millimetres.
const OLD_FORMAT: &str = "holod-weights-1";
/// The version of the families that this crate runs.
const VERSION: u32 = 2;
/// Larger files are refused before they are read.
const LARGEST_FILE_BYTES: u64 = 256 << 20;

/// Weights that were checked as a whole: every tensor is there, finite, and of the shape that the configuration asks for.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    pub(crate) config: NetworkConfig,
    pub(crate) family: Family,
    metrics: serde_json::Value,
    provenance: serde_json::Value,
}

/// What network the weights are for and what they were trained for, as the file's `config` says it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// The family.
    pub architecture: Architecture,
    /// Version of the family; 2 is known.
    pub version: u32,
    /// The grid on which the network predicts.
    pub grid: Grid,
    /// 3x3 layers of `direct`'s net or of `expected-stack`'s first: the first, pairs of body layers, the last.
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
    /// `expected-stack`: 3x3 layers of the net that corrects what arrives at the SLM plane.
    #[serde(default = "default_correction_layers", skip_serializing_if = "is_default_correction_layers")]
    pub correction_layers: usize,
    /// `expected-stack`: whether the first net also corrects the expected images before they light the layers and are
    /// asked for by the feedback. Both nets are told them uncorrected.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub refined_stack: bool,
}

// The trainer leaves out what has its default, so that files of older networks stay as they are.
const fn default_depth_layers() -> usize {
    8
}

fn is_default_depth_layers(count: &usize) -> bool {
    *count == default_depth_layers()
}

const fn default_correction_layers() -> usize {
    10
}

fn is_default_correction_layers(count: &usize) -> bool {
    *count == default_correction_layers()
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
}

impl fmt::Display for Architecture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Direct => "direct",
            Self::ExpectedStack => "expected-stack",
        })
    }
}

/// The grid on which a network predicts the field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Grid {
    /// Half the resolution in each direction; the field is Fourier-upsampled by 2 afterwards.
    HalfBand,
    /// The panel's own.
    Full,
}

/// The stacks of layers that a family has.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Family {
    Direct { layers: Vec<Layer> },
    ExpectedStack { lighting: Vec<Layer>, correction: Vec<Layer>, feedback: Feedback },
}

/// How what is lacking is fed back to the field of `expected-stack`.
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
    fn read<E>(
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
        })
    }
}

/// What the configuration says of one layer.
struct LayerShape {
    /// What its tensors' names begin with.
    name: String,
    in_channels: usize,
    out_channels: usize,
    /// Of an adjustable layer.
    modulation_hidden: Option<usize>,
}

/// One 3x3 layer.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Layer {
    pub(crate) out_channels: usize,
    pub(crate) in_channels: usize,
    /// [out, in, 3, 3]
    pub(crate) weight: Vec<f32>,
    /// [out]
    pub(crate) bias: Vec<f32>,
    pub(crate) adjustable: Option<Adjustable>,
}

/// What an adjustable deformable layer has besides its own kernel.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Adjustable {
    /// W0, [18, in, 3, 3]
    pub(crate) offset_weight: Vec<f32>,
    /// b0, [18]
    pub(crate) offset_bias: Vec<f32>,
    /// g_m: 2 → hidden → hidden → 18·in + 18
    pub(crate) modulation: [Dense; 3],
}

/// A fully connected layer.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Dense {
    pub(crate) inputs: usize,
    /// [outputs, inputs]
    pub(crate) weight: Vec<f32>,
    /// [outputs]
    pub(crate) bias: Vec<f32>,
}

/// Offsets that an adjustable layer predicts for each pixel: (dy, dx) of nine taps.
pub(crate) const OFFSET_CHANNELS: usize = 18;

/// Weights that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file cannot be read.
    #[error("weights {path}: {source}; expected a safetensors file that holod's trainer exported", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The path is a directory or the file is far too large.
    #[error("weights {path}: found {found}; expected a safetensors file of at most 256 MiB", path = path.display())]
    NotAFile {
        /// The path.
        path: PathBuf,
        /// What is there.
        found: String,
    },
    /// The bytes are no safetensors file.
    #[error(
        "weights {name}: not a valid safetensors file ({detail}); the file is damaged or of another kind: export or copy it again"
    )]
    Damaged {
        /// Which weights.
        name: String,
        /// What the parser said.
        detail: String,
    },
    /// The metadata does not describe a network that this version runs.
    #[error(
        "weights {name}: metadata `{key}` is {found}; expected {expected}; export the weights with this version's trainer"
    )]
    Metadata {
        /// Which weights.
        name: String,
        /// The metadata key, with a path inside it where it is structured.
        key: String,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The file is of a format that this version no longer runs.
    #[error(
        "weights {name}: found format \"{OLD_FORMAT}\", of a network for one bench that is told the pupil in millimetres; \
         expected \"{FORMAT}\"; convert it with `python -m holod_training export --source FILE --out NEW`; it then needs a \
         short training: model/training/README.md"
    )]
    OldFormat {
        /// Which weights.
        name: String,
    },
    /// One tensor is missing or cannot be used.
    #[error("weights {name}: tensor `{tensor}` is {found}; expected {expected}")]
    Tensor {
        /// Which weights.
        name: String,
        /// The tensor's name.
        tensor: String,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
}

/// What weights reached on a bench that they were judged on.
#[derive(Clone, Debug, PartialEq)]
pub struct JudgedBench {
    /// The bench's name in the evaluation.
    pub name: String,
    /// At one pupil.
    pub judged: Judged,
}

/// Means over held-out scenes, after double phase and rounding to levels.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct Judged {
    /// Blur over the depth range for the pupil at which this was judged.
    pub volume_blur_px: f64,
    /// Over all focuses and pixels.
    pub psnr_db: f64,
    /// Where the circle of confusion is less than 2 px.
    pub psnr_in_focus_db: f64,
    /// 1 for the full refocus of the true images, 0 for one picture at every focus.
    pub slope: f64,
    /// PSNR over that of a hologram of smooth phase.
    pub over_smooth_phase_db: f64,
}

#[derive(Deserialize)]
struct BenchMetrics {
    bench: String,
    volume_fresnel_px2: [f64; 3],
    rows: Vec<Judged>,
}

impl Weights {
    /// The weights that ship with holod, of the best quality.
    pub fn builtin() -> Self {
        Self::from_bytes(include_bytes!("../weights/standard.safetensors"), "standard")
            .expect("the built-in weights are valid: a test loads them")
    }

    /// The weights that ship with holod for weak machines: little more than a third of the operations.
    pub fn builtin_small() -> Self {
        Self::from_bytes(include_bytes!("../weights/small.safetensors"), "small")
            .expect("the built-in weights are valid: a test loads them")
    }

    /// The weights that ship with holod for processors: less than a sixth of the operations.
    pub fn builtin_fast() -> Self {
        Self::from_bytes(include_bytes!("../weights/fast.safetensors"), "fast")
            .expect("the built-in weights are valid: a test loads them")
    }

    /// Reads and checks a weights file.
    pub fn load(path: &Path) -> Result<Self, WeightsError> {
        let read_error = |source| WeightsError::Read { path: path.to_owned(), source };
        let metadata = std::fs::metadata(path).map_err(read_error)?;
        if !metadata.is_file() || metadata.len() > LARGEST_FILE_BYTES {
            let found = if metadata.is_file() { format!("{} bytes", metadata.len()) } else { "no regular file".into() };
            return Err(WeightsError::NotAFile { path: path.to_owned(), found });
        }
        Self::from_bytes(&std::fs::read(path).map_err(read_error)?, &path.display().to_string())
    }

    /// Checks weights in memory; `name` says in errors which they are.
    pub fn from_bytes(bytes: &[u8], name: &str) -> Result<Self, WeightsError> {
        let damaged = |error: safetensors::SafeTensorError| WeightsError::Damaged {
            name: name.into(),
            detail: error.to_string(),
        };
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(damaged)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(damaged)?;
        let metadata = Metadata { name, entries: header.metadata().clone().unwrap_or_default() };

        let config = metadata.config()?;
        let file = TensorReader { name, tensors };
        let number = |tensor: &str| Ok(file.tensor(tensor, &[1])?[0]);
        let family = Family::read(&config, |shape| file.layer(shape), number)?;
        Ok(Self { config, family, metrics: metadata.remark("metrics"), provenance: metadata.remark("provenance") })
    }

    /// What network this is and what it was trained for.
    pub fn config(&self) -> &NetworkConfig {
        &self.config
    }

    /// What the weights reached, when they were judged on several benches, on the one that is most like `bench` in its
    /// diffraction, at the blur there that is most like that of `pupil` on `bench`. Nothing where the file does not say.
    pub fn judged_on_the_like_of(&self, bench: &DisplayGeometry, pupil: PupilDiameter) -> Option<JudgedBench> {
        let apart = |found: f64, wanted: f64| (found / wanted).ln().abs();
        let mean = |fresnel_px2: &[f64; 3]| fresnel_px2.iter().sum::<f64>() / 3.0;
        let (fresnel_px2, blur_px) = (mean(&bench.volume_fresnel_px2().0), bench.largest_coc_px(pupil));
        let benches: Vec<BenchMetrics> = serde_json::from_value(self.metrics.get("benches")?.clone()).ok()?;
        let distance = |of: &BenchMetrics| apart(mean(&of.volume_fresnel_px2), fresnel_px2);
        let nearest = benches.into_iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        let distance = |of: &Judged| apart(of.volume_blur_px, blur_px);
        let judged = nearest.rows.into_iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        Some(JudgedBench { name: nearest.bench, judged })
    }

    /// What the weights reached when they were evaluated, as the trainer wrote it.
    pub fn metrics(&self) -> &serde_json::Value {
        &self.metrics
    }

    /// Script, seed, steps and date of the training.
    pub fn provenance(&self) -> &serde_json::Value {
        &self.provenance
    }

    /// Where `bench` lies in what the weights were trained for. Its resolution is free.
    pub fn fit(&self, bench: &DisplayGeometry) -> BenchFit {
        self.config.trained.fit(bench)
    }

    /// The narrowest and the widest pupil that the weights were trained for, on `bench`.
    pub fn trained_pupils(&self, bench: &DisplayGeometry) -> [PupilDiameter; 2] {
        self.config.trained.pupils(bench)
    }
}

/// The file's metadata with the name that errors give it.
struct Metadata<'a> {
    name: &'a str,
    entries: HashMap<String, String>,
}

impl Metadata<'_> {
    fn error(&self, key: &str, found: impl Into<String>, expected: impl Into<String>) -> WeightsError {
        WeightsError::Metadata {
            name: self.name.into(),
            key: key.into(),
            found: found.into(),
            expected: expected.into(),
        }
    }

    /// An entry that only people read: `null` where it is absent, plain text where it is not JSON.
    fn remark(&self, key: &str) -> serde_json::Value {
        let Some(text) = self.entries.get(key) else { return serde_json::Value::Null };
        serde_json::from_str(text).unwrap_or_else(|_| serde_json::Value::String(text.clone()))
    }

    fn config(&self) -> Result<NetworkConfig, WeightsError> {
        match self.entries.get("format").map(String::as_str) {
            Some(FORMAT) => {}
            Some(OLD_FORMAT) => return Err(WeightsError::OldFormat { name: self.name.into() }),
            Some(other) => return Err(self.error("format", format!("\"{other}\""), format!("\"{FORMAT}\""))),
            None => return Err(self.error("format", "absent", format!("\"{FORMAT}\""))),
        }
        let text =
            self.entries.get("config").ok_or_else(|| self.error("config", "absent", "a network configuration"))?;
        let config: NetworkConfig = serde_json::from_str(text)
            .map_err(|error| self.error("config", format!("unusable ({error})"), "a network configuration"))?;
        self.check(&config)?;
        Ok(config)
    }

    fn check(&self, config: &NetworkConfig) -> Result<(), WeightsError> {
        let require = |holds: bool, key: &str, found: String, expected: &str| {
            if holds { Ok(()) } else { Err(self.error(&format!("config.{key}"), found, expected)) }
        };
        let NetworkConfig { version, layers, channels, correction_layers, depth_layers, .. } = config;
        require(*version == VERSION, "version", version.to_string(), &VERSION.to_string())?;
        for (key, layers) in [("layers", layers), ("correction_layers", correction_layers)] {
            require(
                (4..=64).contains(layers) && layers % 2 == 0,
                key,
                layers.to_string(),
                "an even number from 4 to 64 (a first, a last and pairs between)",
            )?;
        }
        require(
            (2..=MOST_DEPTH_LAYERS).contains(depth_layers),
            "depth_layers",
            depth_layers.to_string(),
            &format!("2 to {MOST_DEPTH_LAYERS}"),
        )?;
        require(
            config.architecture == Architecture::Direct || config.grid == Grid::HalfBand,
            "grid",
            "\"full\"".into(),
            &format!("\"half-band\" for `{}`", config.architecture),
        )?;
        require(
            config.architecture == Architecture::ExpectedStack || !config.refined_stack,
            "refined_stack",
            "true".into(),
            "false; only `expected-stack` can have it",
        )?;
        require((1..=256).contains(channels), "channels", channels.to_string(), "1 to 256")?;
        let adjustable = &config.adjustable_layers;
        require(
            adjustable.iter().all(|index| (1..layers - 1).contains(index))
                && adjustable.windows(2).all(|pair| pair[0] < pair[1]),
            "adjustable_layers",
            format!("{adjustable:?}"),
            "ascending numbers of body layers",
        )?;
        let hidden = config.modulation_hidden;
        require((1..=1024).contains(&hidden), "modulation_hidden", hidden.to_string(), "1 to 1024")?;
        let slope = config.leaky_slope;
        require((0.0..1.0).contains(&slope), "leaky_slope", slope.to_string(), "at least 0 and below 1")?;
        let TrainedRange { volume_blur_px, volume_fresnel_px2 } = config.trained;
        for (key, [least, most]) in [("volume_blur_px", volume_blur_px), ("volume_fresnel_px2", volume_fresnel_px2)] {
            require(
                least > 0.0 && most >= least && most.is_finite(),
                &format!("trained.{key}"),
                format!("[{least}, {most}]"),
                "two numbers above 0, in ascending order",
            )?;
        }
        let constant = config.amplitude_constant;
        require(constant > 0.0 && constant.is_finite(), "amplitude_constant", constant.to_string(), "a positive number")
    }
}

/// Reads tensors of known shape.
struct TensorReader<'a> {
    name: &'a str,
    tensors: SafeTensors<'a>,
}

impl TensorReader<'_> {
    fn layer(&self, shape: &LayerShape) -> Result<Layer, WeightsError> {
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

    fn tensor(&self, tensor: &str, shape: &[usize]) -> Result<Vec<f32>, WeightsError> {
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

/// What networks are told of a bench and a pupil, as maps and as inputs: [`Conditions`](crate::conditions::Conditions).
pub(crate) const CONDITIONS: usize = 2;

/// Real and imaginary residual of three colours.
pub(crate) const OUTPUT_CHANNELS: usize = 6;

/// The names of the tensors of [`Feedback`].
const FEEDBACK_SHARE: &str = "feedback_share";
const SHARPNESS: &str = "sharpness";

/// Outputs of the first net of `expected-stack` for each depth layer: the phases of three colours and a mask; then, after
/// those of all layers, changes of three colours' amplitudes if it refines the stack.
pub(crate) const LIT: usize = 4;
pub(crate) const REFINED: usize = 3;

/// Depth layers that a network may have.
pub(crate) const MOST_DEPTH_LAYERS: usize = 64;

impl NetworkConfig {
    /// 3x3 layers of all its nets.
    pub fn layer_count(&self) -> usize {
        match self.architecture {
            Architecture::Direct => self.layers,
            Architecture::ExpectedStack => self.layers + self.correction_layers,
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

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use holod_calibration::Metres;
    use rand::RngExt;
    use safetensors::tensor::TensorView;

    /// A network with random weights of such a size that its features keep their scale and its offsets reach a few
    /// pixels.
    pub(crate) fn random_weights(config: NetworkConfig, seed: u64) -> Weights {
        let mut random = rand_pcg::Pcg32::new(seed, 1);
        let mut tensor = |count: usize, scale: f32| -> Vec<f32> {
            (0..count).map(|_| random.random_range(-1.0f32..1.0) * scale).collect()
        };
        let layer = |shape: &LayerShape| {
            let &LayerShape { in_channels, out_channels, .. } = shape;
            let scale = (3.0 / (9 * in_channels) as f32).sqrt();
            let modulated = OFFSET_CHANNELS * in_channels + OFFSET_CHANNELS;
            let adjustable = shape.modulation_hidden.map(|hidden| Adjustable {
                offset_weight: tensor(OFFSET_CHANNELS * in_channels * 9, 4.0 * scale),
                offset_bias: tensor(OFFSET_CHANNELS, 1.0),
                modulation: [(CONDITIONS, hidden), (hidden, hidden), (hidden, modulated)].map(|(inputs, outputs)| {
                    Dense {
                        inputs,
                        weight: tensor(inputs * outputs, (1.0 / inputs as f32).sqrt()),
                        bias: tensor(outputs, 0.1),
                    }
                }),
            });
            Ok::<_, std::convert::Infallible>(Layer {
                out_channels,
                in_channels,
                weight: tensor(out_channels * in_channels * 9, scale),
                bias: tensor(out_channels, 0.1),
                adjustable,
            })
        };
        let number = |name: &str| Ok(if name == SHARPNESS { 1.3 } else { 0.6 });
        let family = Family::read(&config, layer, number).unwrap();
        Weights { config, family, metrics: serde_json::Value::Null, provenance: serde_json::Value::Null }
    }

    /// The tensors of `weights` under the names and shapes of the file format.
    fn tensors(weights: &Weights) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let stacks = match &weights.family {
            Family::Direct { layers } => vec![("layers", layers)],
            Family::ExpectedStack { lighting, correction, .. } => {
                vec![("lighting", lighting), ("correction", correction)]
            }
        };
        let layers = stacks.into_iter().flat_map(|(stack, layers)| {
            layers.iter().enumerate().map(move |(index, layer)| (format!("{stack}.{index}"), layer))
        });
        let mut tensors = Vec::new();
        for (prefix, layer) in layers {
            let Layer { out_channels, in_channels, weight, bias, adjustable } = layer;
            let mut add = |name: &str, shape: Vec<usize>, values: &Vec<f32>| {
                tensors.push((format!("{prefix}.{name}"), shape, values.clone()));
            };
            add("weight", vec![*out_channels, *in_channels, 3, 3], weight);
            add("bias", vec![*out_channels], bias);
            if let Some(Adjustable { offset_weight, offset_bias, modulation }) = adjustable {
                add("offset.weight", vec![18, *in_channels, 3, 3], offset_weight);
                add("offset.bias", vec![18], offset_bias);
                for (step, Dense { inputs, weight, bias }) in modulation.iter().enumerate() {
                    add(&format!("modulation.{step}.weight"), vec![bias.len(), *inputs], weight);
                    add(&format!("modulation.{step}.bias"), vec![bias.len()], bias);
                }
            }
        }
        if let Family::ExpectedStack { feedback: Feedback { share, sharpness }, .. } = weights.family {
            tensors.push((FEEDBACK_SHARE.into(), vec![1], vec![share]));
            tensors.push((SHARPNESS.into(), vec![1], vec![sharpness]));
        }
        tensors
    }

    type Tensors = Vec<(String, Vec<usize>, Vec<f32>)>;
    type Entries = HashMap<String, String>;

    pub(crate) fn config() -> NetworkConfig {
        NetworkConfig {
            architecture: Architecture::Direct,
            version: VERSION,
            grid: Grid::HalfBand,
            layers: 4,
            channels: 5,
            adjustable_layers: vec![2],
            modulation_hidden: 3,
            leaky_slope: 0.1,
            // On the default bench pupils of 1 to 5 mm.
            trained: TrainedRange { volume_blur_px: [100.0 / 7.0, 500.0 / 7.0], volume_fresnel_px2: [32.0, 46.0] },
            amplitude_constant: 1.4,
            depth_layers: default_depth_layers(),
            correction_layers: default_correction_layers(),
            refined_stack: false,
        }
    }

    pub(crate) fn expected_stack_config() -> NetworkConfig {
        NetworkConfig { architecture: Architecture::ExpectedStack, depth_layers: 5, correction_layers: 4, ..config() }
    }

    /// A file with small random weights, after `change` has changed it.
    fn file(change: impl FnOnce(&mut Tensors, &mut Entries)) -> Vec<u8> {
        file_of(config(), change)
    }

    fn file_of(config: NetworkConfig, change: impl FnOnce(&mut Tensors, &mut Entries)) -> Vec<u8> {
        let weights = random_weights(config, 1);
        let mut tensors = tensors(&weights);
        let mut entries = Entries::from([
            ("format".into(), FORMAT.into()),
            ("config".into(), serde_json::to_string(&weights.config).unwrap()),
            ("metrics".into(), r#"{"psnr_db": 29.0}"#.into()),
        ]);
        change(&mut tensors, &mut entries);
        let bytes: Vec<(String, Vec<usize>, Vec<u8>)> = tensors
            .into_iter()
            .map(|(name, shape, values)| (name, shape, values.into_iter().flat_map(f32::to_le_bytes).collect()))
            .collect();
        let views =
            bytes.iter().map(|(name, shape, bytes)| (name, TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap()));
        safetensors::serialize(views, Some(entries)).unwrap()
    }

    fn error_of(change: impl FnOnce(&mut Tensors, &mut Entries)) -> String {
        Weights::from_bytes(&file(change), "test.safetensors").unwrap_err().to_string()
    }

    fn assert_mentions(message: &str, parts: &[&str]) {
        for part in parts {
            assert!(message.contains(part), "`{part}` is not in: {message}");
        }
    }

    #[test]
    fn a_file_round_trips() {
        let weights = Weights::from_bytes(&file(|_, _| {}), "test").unwrap();
        let expected = random_weights(config(), 1);
        assert_eq!((&weights.config, &weights.family), (&expected.config, &expected.family));
        let refined = NetworkConfig { refined_stack: true, ..expected_stack_config() };
        for other in [expected_stack_config(), refined] {
            let read = Weights::from_bytes(&file_of(other.clone(), |_, _| {}), "test").unwrap();
            assert_eq!((&read.config, &read.family), (&other, &random_weights(other.clone(), 1).family));
        }
        let written = |config: NetworkConfig| serde_json::to_string(&config).unwrap();
        assert!(!written(config()).contains("depth_layers") && !written(config()).contains("refined_stack"));
        assert!(written(expected_stack_config()).contains("\"depth_layers\":5,\"correction_layers\":4"));
        assert_eq!(weights.metrics()["psnr_db"], 29.0);
        assert!(weights.provenance().is_null());

        let remarked = file(|_, entries| drop(entries.insert("metrics".into(), "{\"psnr_db\": NaN}".into())));
        assert_eq!(Weights::from_bytes(&remarked, "test").unwrap().metrics(), "{\"psnr_db\": NaN}");
    }

    #[test]
    fn the_built_in_weights_are_valid_and_fit_the_built_in_bench() {
        let weights = Weights::builtin();
        assert_eq!((weights.config().layer_count(), weights.config().channels), (18, 32));
        let small = Weights::builtin_small();
        assert_eq!((small.config().layer_count(), small.config().channels), (10, 24));
        let fast = Weights::builtin_fast();
        assert_eq!((fast.config().layer_count(), fast.config().channels), (8, 16));
        // 3.74 µm with 40 mm has the most diffraction of the benches that networks are judged on, 12.5 µm with 50 mm the
        // least.
        let gaea = DisplayGeometry { pixel_pitch: Metres(3.74e-6), ..DisplayGeometry::DEFAULT };
        let x15213 = DisplayGeometry {
            pixel_pitch: Metres(12.5e-6),
            eyepiece_focal_length: Metres(50e-3),
            ..DisplayGeometry::DEFAULT
        };
        for weights in [weights, small, fast] {
            for bench in [DisplayGeometry::DEFAULT, gaea, x15213] {
                assert_eq!(weights.fit(&bench), BenchFit::Inside);
            }
            let [narrowest, widest] = weights.trained_pupils(&DisplayGeometry::DEFAULT).map(PupilDiameter::mm);
            assert!(narrowest <= 1.0 && widest >= 8.0, "{narrowest} to {widest} mm");
        }
    }

    #[test]
    fn the_bench_that_is_most_alike_is_quoted() {
        let bench = |name: &str, fresnel: f64, blurs: [f64; 2]| {
            let row = |blur: f64| {
                serde_json::json!({"volume_blur_px": blur, "psnr_db": fresnel + blur, "psnr_in_focus_db": 24.0,
                    "slope": 0.5, "over_smooth_phase_db": 4.0})
            };
            serde_json::json!({"bench": name, "volume_fresnel_px2": [fresnel, fresnel, fresnel], "rows": blurs.map(row)})
        };
        let metrics = serde_json::json!({"benches": [
            bench("coarse", 20.0, [10.0, 30.0]), bench("alike", 36.0, [28.0, 57.0]), bench("fine", 170.0, [60.0, 90.0]),
        ]});
        let told = file(|_, entries| drop(entries.insert("metrics".into(), metrics.to_string())));
        let weights = Weights::from_bytes(&told, "test").unwrap();
        let quoted = |bench: &DisplayGeometry, pupil_mm| {
            weights
                .judged_on_the_like_of(bench, PupilDiameter::from_mm(pupil_mm))
                .map(|of| (of.name, of.judged.psnr_db))
        };
        assert_eq!(quoted(&DisplayGeometry::DEFAULT, 2.0), Some(("alike".into(), 64.0)));
        assert_eq!(quoted(&DisplayGeometry::DEFAULT, 5.0), Some(("alike".into(), 93.0)));
        let gaea = DisplayGeometry { pixel_pitch: Metres(3.74e-6), ..DisplayGeometry::DEFAULT };
        assert_eq!(quoted(&gaea, 3.0), Some(("fine".into(), 260.0)));
        for silent in ["{}", "{\"benches\": 3}", "{\"benches\": []}"] {
            let silent = file(|_, entries| drop(entries.insert("metrics".into(), silent.into())));
            let weights = Weights::from_bytes(&silent, "test").unwrap();
            assert_eq!(weights.judged_on_the_like_of(&gaea, PupilDiameter::from_mm(3.0)), None);
        }
    }

    #[test]
    fn faulty_tensors_are_named() {
        let missing = error_of(|tensors, _| tensors.retain(|(name, ..)| name != "layers.2.offset.bias"));
        assert_mentions(&missing, &["test.safetensors", "`layers.2.offset.bias`", "absent", "[18]"]);
        let reshaped = error_of(|tensors, _| tensors[2].1 = vec![5, 5, 9, 1]);
        assert_mentions(&reshaped, &["`layers.1.weight`", "[5, 5, 9, 1]", "[5, 5, 3, 3]"]);
        let fed_back = |change: &dyn Fn(&mut Tensors)| {
            let file = file_of(expected_stack_config(), |tensors, _| change(tensors));
            Weights::from_bytes(&file, "test").unwrap_err().to_string()
        };
        for number in [FEEDBACK_SHARE, SHARPNESS] {
            let absent = fed_back(&|tensors| tensors.retain(|(name, ..)| name != number));
            assert_mentions(&absent, &[&format!("`{number}`"), "absent", "[1]"]);
        }
        let two = fed_back(&|tensors| *tensors.last_mut().unwrap() = (SHARPNESS.into(), vec![2], vec![1.0; 2]));
        assert_mentions(&two, &["`sharpness`", "[2]", "[1]"]);
        let nan = error_of(|tensors, _| tensors[1].2[3] = f32::NAN);
        assert_mentions(&nan, &["`layers.0.bias`", "NaN at index 3", "finite"]);
    }

    #[test]
    fn faulty_metadata_is_named() {
        let set = |key: &'static str, value: &'static str| {
            error_of(move |_, entries| drop(entries.insert(key.into(), value.into())))
        };
        assert_mentions(&set("format", "holod-weights-9"), &["`format`", "holod-weights-9", "holod-weights-2"]);
        assert_mentions(&error_of(|_, entries| entries.clear()), &["`format`", "absent"]);
        assert_mentions(&set("config", "{}"), &["`config`", "missing field"]);
        let configured = |change: &dyn Fn(&mut NetworkConfig)| {
            error_of(|_, entries| {
                let mut changed = config();
                change(&mut changed);
                entries.insert("config".into(), serde_json::to_string(&changed).unwrap());
            })
        };
        // `layered` is a family that the trainer knows and no engine runs.
        for family in ["diffusion", "layered"] {
            let unknown = error_of(|_, entries| {
                let config = entries["config"].replace("\"direct\"", &format!("\"{family}\""));
                entries.insert("config".into(), config);
            });
            assert_mentions(&unknown, &["`config`", family, "`direct`", "`expected-stack`"]);
        }
        let full = file_of(NetworkConfig { grid: Grid::Full, ..expected_stack_config() }, |_, _| {});
        let full = Weights::from_bytes(&full, "test").unwrap_err().to_string();
        assert_mentions(&full, &["config.grid", "\"full\"", "half-band", "`expected-stack`"]);
        assert_mentions(&configured(&|c| c.correction_layers = 3), &["config.correction_layers", "3", "even"]);
        assert_mentions(&configured(&|c| c.depth_layers = 1), &["config.depth_layers", "1"]);
        assert_mentions(&configured(&|c| c.depth_layers = 65), &["config.depth_layers", "65", "2 to 64"]);
        assert_mentions(
            &configured(&|c| c.refined_stack = true),
            &["config.refined_stack", "true", "`expected-stack`"],
        );
        assert_mentions(&configured(&|c| c.version = 7), &["config.version", "7"]);
        assert_mentions(&configured(&|c| c.layers = 5), &["config.layers", "5", "even"]);
        assert_mentions(&configured(&|c| c.channels = 100_000), &["config.channels", "100000"]);
        assert_mentions(&configured(&|c| c.adjustable_layers = vec![3]), &["config.adjustable_layers", "[3]"]);
        for unusable in [[5.0, 1.0], [0.0, 5.0], [-1.0, 5.0]] {
            let blur = configured(&|c| c.trained.volume_blur_px = unusable);
            assert_mentions(&blur, &["config.trained.volume_blur_px", "ascending"]);
            let fresnel = configured(&|c| c.trained.volume_fresnel_px2 = unusable);
            assert_mentions(&fresnel, &["config.trained.volume_fresnel_px2", "ascending"]);
        }
        assert_mentions(&configured(&|c| c.amplitude_constant = 0.0), &["config.amplitude_constant"]);
    }

    #[test]
    fn truncated_and_foreign_files_are_refused() {
        let whole = file(|_, _| {});
        for length in [0, 4, 9, whole.len() / 2, whole.len() - 1] {
            assert!(
                matches!(Weights::from_bytes(&whole[..length], "test"), Err(WeightsError::Damaged { .. })),
                "{length}"
            );
        }
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(Weights::load(folder.path()), Err(WeightsError::NotAFile { .. })));
        assert!(matches!(Weights::load(&folder.path().join("absent")), Err(WeightsError::Read { .. })));
    }

    #[test]
    fn a_file_of_the_old_format_is_told_what_it_is_and_what_to_do() {
        let old = set_format(OLD_FORMAT);
        assert_mentions(
            &old,
            &[
                "test.safetensors",
                "holod-weights-1",
                "one bench",
                "holod-weights-2",
                "`python -m holod_training export --source FILE --out NEW`",
                "short training",
                "model/training/README.md",
            ],
        );
        assert!(!set_format("holod-weights-9").contains("holod_training export"));
    }

    fn set_format(format: &str) -> String {
        error_of(|_, entries| drop(entries.insert("format".into(), format.into())))
    }
}
