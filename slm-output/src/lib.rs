//! From phase patterns to light: panel levels, colour fields, pacing, presentation and lasers.
//!
//! A frame's way: [`levels`] turns three phase patterns into levels inside a [`fields`] frame; [`pacing`] says for
//! which refresh it is made; [`present`] puts it on the panel, its bits laid out by [`packing`], and reports what was
//! really shown and when; [`schedule`] works out from that which laser may be lit; [`laser`] lights it. [`output`] runs
//! all of it on its threads.
//!
//! holod is no safety device: lasers that can reach an eye need an interlock of their own.

pub mod fields;
pub mod laser;
pub mod levels;
pub mod output;
pub mod pacing;
pub mod packing;
pub mod patterns;
pub mod present;
pub mod schedule;

pub use fields::{ColourField, FrameLayout, LevelsFrame};
pub use levels::{EncodeReport, PanelEncoder};
pub use output::{FieldEvent, FramePort, Output, OutputControl, OutputOptions, PanelEvent};
pub use pacing::{FramePlan, Pacer};
pub use present::{OutputSpec, Presenter, TimestampSource};
