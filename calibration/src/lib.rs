//! What is true of one bench: units, display geometry and the rig file.
//!
//! Every other crate of the workspace takes its words and units from here. Lengths are metres, angles radians, times
//! seconds (`f64`) or nanoseconds (`i64`); a pupil is the one quantity kept in millimetres, as trackers and the
//! literature give it.

mod atomic_write;
mod clock;
mod device;
mod geometry;
mod hangup;
mod level_tables;
pub mod lut_fit;
mod png_bits;
mod quantile;
pub mod rig;
pub mod toml_reader;
mod units;

pub use atomic_write::{folder_of, special_file, write_atomically};
pub use clock::host_now;
pub use device::{KEPT_BY_UNIT, is_kept_by_unit, unit_keeps};
pub use geometry::DisplayGeometry;
pub use hangup::hangup_is_ignored;
pub use level_tables::LevelTables;
pub use png_bits::png_grey_bits;
pub use quantile::Sorted;
pub use units::{Colour, Dioptres, Metres, PerColour, PupilDiameter, Resolution, TimeNs};
