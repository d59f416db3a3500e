//! The holod daemon.

fn main() {}
