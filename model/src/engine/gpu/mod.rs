//! The network on the GPU: a plan of shaders, and the engine that runs it.

mod fft;
mod map;
mod network;
mod plan;
#[cfg(test)]
mod run;
