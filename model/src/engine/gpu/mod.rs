//! The network on the GPU: a plan of shaders, and the engine that runs it.

mod map;
mod network;
mod plan;
