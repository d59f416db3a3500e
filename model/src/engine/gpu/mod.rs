//! The network on the GPU: a plan of shaders, and the engine that runs it.

mod conv;
#[cfg(feature = "gpu-cost")]
pub mod cost;
mod deformable;
mod direct;
mod double_phase;
mod fft;
mod levels;
mod loaded_plan;
mod map;
mod network;
mod plan;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod trial;
