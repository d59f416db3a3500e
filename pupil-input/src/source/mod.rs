//! Where samples come from: a serial port, a log, or a made-up eye.

pub mod mock;
pub mod replay;
pub(crate) mod serial;
