//! The network on the GPU: a plan of shaders, and the engine that runs it.

mod conv;
#[cfg(feature = "gpu-cost")]
pub mod cost;
mod defocus;
mod deformable;
mod depth_layers;
mod direct;
mod double_phase;
mod engine;
mod expected_stack;
mod feedback;
mod fft;
mod grid_transforms;
mod input_features;
mod levels;
mod loaded_plan;
mod map;
mod matrix;
mod network;
mod plan;
mod shared;
#[cfg(test)]
pub(in crate::engine) mod tests;
#[cfg(test)]
mod trial;
mod trunk;
mod upsample;
mod winograd;

pub use self::engine::{EncodedCounts, GpuEngine};
