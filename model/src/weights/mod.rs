//! The network's weights: one safetensors file that says what it was trained for.

mod config;
mod error;
mod judged;
mod layers;
mod metadata;
mod tensors;
#[cfg(test)]
pub(crate) mod tests;

use std::path::Path;

use holod_calibration::{DisplayGeometry, PupilDiameter};
use safetensors::SafeTensors;
use twox_hash::XxHash3_64;

use self::metadata::Metadata;
use self::tensors::TensorReader;
use crate::conditions::BenchFit;
use crate::whole_file::{self, Unread};

pub use self::config::{Architecture, Grid, NetworkConfig};
pub(crate) use self::config::{CONDITIONS, LIT, MOST_DEPTH_LAYERS, OUTPUT_CHANNELS, REFINED};
pub use self::error::WeightsError;
pub use self::judged::{Judged, JudgedBench};
pub(crate) use self::layers::{Adjustable, Dense, Family, Feedback, Layer, OFFSET_CHANNELS};

/// Larger files are refused before they are read.
const LARGEST_FILE_BYTES: u64 = 256 << 20;

/// Weights that were checked as a whole: every tensor is there, finite, and of the shape that the configuration asks
/// for.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    pub(crate) config: NetworkConfig,
    pub(crate) family: Family,
    metrics: serde_json::Value,
    provenance: serde_json::Value,
    file_xxh3: Option<u64>,
}

impl Weights {
    /// The weights that ship with holod, of the best quality.
    pub fn builtin() -> Self {
        Self::from_bytes(include_bytes!("../../weights/standard.safetensors"), "standard")
            .expect("the built-in weights are valid: a test loads them")
    }

    /// The weights that ship with holod for weak machines: little more than a third of the operations.
    pub fn builtin_small() -> Self {
        Self::from_bytes(include_bytes!("../../weights/small.safetensors"), "small")
            .expect("the built-in weights are valid: a test loads them")
    }

    /// The weights that ship with holod for processors: less than a sixth of the operations.
    pub fn builtin_fast() -> Self {
        Self::from_bytes(include_bytes!("../../weights/fast.safetensors"), "fast")
            .expect("the built-in weights are valid: a test loads them")
    }

    /// Reads and checks a weights file.
    pub fn load(path: &Path) -> Result<Self, WeightsError> {
        let bytes = whole_file::read(path, LARGEST_FILE_BYTES).map_err(|unread| match unread {
            Unread::NoFile { found } => WeightsError::NotAFile { path: path.to_owned(), found },
            Unread::System(source) => WeightsError::Read { path: path.to_owned(), source },
        })?;
        let weights = Self::from_bytes(&bytes, &path.display().to_string())?;
        Ok(Self { file_xxh3: Some(XxHash3_64::oneshot(&bytes)), ..weights })
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
        let (metrics, provenance) = (metadata.remark("metrics"), metadata.remark("provenance"));
        Ok(Self { config, family, metrics, provenance, file_xxh3: None })
    }

    /// XXH3 of 64 bits of the file's bytes as [`Self::load`] read them; none of weights in memory.
    pub fn file_xxh3(&self) -> Option<u64> {
        self.file_xxh3
    }

    /// What network this is and what it was trained for.
    pub fn config(&self) -> &NetworkConfig {
        &self.config
    }

    /// What the weights reached, when they were judged on several benches, on the one that is most like `bench` in its
    /// diffraction, at the blur there that is most like that of `pupil` on `bench`. Nothing where the file does not
    /// say.
    pub fn judged_on_the_like_of(&self, bench: &DisplayGeometry, pupil: PupilDiameter) -> Option<JudgedBench> {
        JudgedBench::nearest(&self.metrics, bench, pupil)
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
