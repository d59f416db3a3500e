//! Reads and checks the metadata of a weights file.

use std::collections::HashMap;

use super::config::{Architecture, Grid, MOST_DEPTH_LAYERS, NetworkConfig};
use super::error::{FORMAT, OLD_FORMAT, WeightsError};
use crate::conditions::TrainedRange;

/// The version of the families that this crate runs.
pub(super) const VERSION: u32 = 2;

/// The file's metadata with the name that errors give it.
pub(super) struct Metadata<'a> {
    pub(super) name: &'a str,
    pub(super) entries: HashMap<String, String>,
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
    pub(super) fn remark(&self, key: &str) -> serde_json::Value {
        let Some(text) = self.entries.get(key) else { return serde_json::Value::Null };
        serde_json::from_str(text).unwrap_or_else(|_| serde_json::Value::String(text.clone()))
    }

    pub(super) fn config(&self) -> Result<NetworkConfig, WeightsError> {
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
        let NetworkConfig { version, layers, channels, correction_layers, depth_layers, planes, .. } = config;
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
        require(
            (2..=MOST_DEPTH_LAYERS).contains(planes),
            "planes",
            planes.to_string(),
            &format!("2 to {MOST_DEPTH_LAYERS}"),
        )?;
        let is_focal_stack = config.architecture == Architecture::FocalStack;
        require(
            config.feedback == is_focal_stack,
            "feedback",
            config.feedback.to_string(),
            if is_focal_stack {
                "true: a `focal-stack` without it is not run; train `--variant focal-stack-feedback`"
            } else {
                "false; only `focal-stack` can have it"
            },
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
        let is_usable = constant > 0.0 && constant.is_finite() && (1.0 / constant).is_finite();
        require(is_usable, "amplitude_constant", constant.to_string(), "a positive number above 1e-38")
    }
}
