//! Pictures for people: labelled contact sheets (PNG) and plots (SVG).

mod plots;
mod sheet;

pub use plots::{LatencyPlot, PupilPlot, PupilSampleMark};
pub use sheet::{Sheet, Tile};
