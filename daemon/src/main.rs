//! holod: drives a holographic near-eye display in real time.

fn main() {}
