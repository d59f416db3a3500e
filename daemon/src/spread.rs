//! Median and tail of what is measured again and again.

use serde::{Deserialize, Serialize};

/// Median and tail of a quantity, milliseconds: of its newest values, and the largest of all.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Half of the values are smaller.
    pub median_ms: f32,
    /// 99 of 100 values are smaller.
    pub p99_ms: f32,
    /// The largest of all.
    pub max_ms: f32,
    /// How many there were in all.
    #[serde(default)]
    pub values: u64,
}

impl Spread {
    /// Of how many values median and tail are, at most.
    pub const NEWEST: usize = 1 << 14;
}
