//! Pictures for people: labelled contact sheets (PNG) and plots (SVG).

mod area;
mod panel;
mod plots;
mod sheet;

pub use area::Area;
pub use panel::{levels_picture, phase_picture, read_levels, screen_picture, shown_pattern, video_pictures};
pub use plots::{LatencyPlot, PupilPlot, PupilSampleMark};
pub use sheet::{Sheet, Tile};
