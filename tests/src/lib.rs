//! A simulated bench: a tracker on a pseudo-terminal and a judge of `frames.csv`.

pub mod frames;
pub mod tracker;
