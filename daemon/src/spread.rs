//! Median and tail of what is measured again and again.

use serde::{Deserialize, Serialize};

/// Median and tail of a quantity, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Half of the values are smaller.
    pub median_ms: f32,
    /// 99 of 100 values are smaller.
    pub p99_ms: f32,
    /// The largest.
    pub max_ms: f32,
}
