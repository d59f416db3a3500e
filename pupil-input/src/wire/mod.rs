//! Bytes to samples: pure, incremental, in bounded memory.

pub mod line;
