//! From an RGB-D frame to a phase pattern, and to the picture that an eye sees of it.
//!
//! The data's way: [`scene`] loads a frame, [`engine`] runs the pupil-adaptive network of [`weights`] on it and gives a
//! [`ComplexHologram`], [`optics::DoublePhase`] turns that into a [`PhasePattern`], and [`optics::SimulatedEye`] shows
//! what an eye sees of it. [`metrics`] judges pictures and [`files`] keeps holograms and pictures on disk.

pub mod engine;
pub mod files;
pub mod metrics;
pub mod optics;
mod picture;
mod resident;
pub mod scene;
pub mod scene_renderer;
pub mod weights;

pub use engine::CpuEngine;
pub use optics::{ComplexHologram, PhasePattern};
pub use picture::LinearImage;
pub use scene::RgbdFrame;
pub use weights::Weights;
