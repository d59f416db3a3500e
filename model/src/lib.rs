//! From an RGB-D frame to a phase pattern, and to the picture that an eye sees of it.
//!
//! The data's way: [`scene`] loads a frame, [`engine`] runs the pupil-adaptive network of [`weights`] on it and gives a
//! [`ComplexHologram`], [`optics::DoublePhase`] turns that into a [`PhasePattern`], and [`optics::SimulatedEye`] shows
//! what an eye sees of it. [`metrics`], [`refocus`] and [`marks`] judge pictures against those of [`scene_shard`], and
//! [`files`] keeps holograms and pictures on disk. [`gpu`] is what opens a graphics processor.

pub mod conditions;
pub mod engine;
pub mod files;
pub mod gpu;
pub mod marks;
pub mod metrics;
mod neighbourhood;
pub mod optics;
mod phase_math;
mod picture;
pub mod refocus;
pub mod safetensors_file;
pub mod scene;
pub mod scene_shard;
mod simd;
pub mod weights;
mod whole_file;
mod worker_pool;
#[cfg(test)]
mod worst;

pub use engine::CpuEngine;
pub use optics::{ComplexHologram, PhasePattern};
pub use picture::{LinearImage, srgb8};
pub use scene::RgbdFrame;
pub use weights::Weights;
pub use worker_pool::{WorkerPool, WorkerPoolError};
