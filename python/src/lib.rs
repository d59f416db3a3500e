//! holod as a Python module: the same way from picture, depth and pupil to panel levels as in the daemon, its simulated
//! eye, its judge and its log reader, on numpy arrays.
//!
//! What Python's users read are the docstrings, which are the comments of functions and classes here; the package
//! around this module is in `python/`.

mod arrays;
mod evaluation;
mod log;
mod outcome;
mod renderer;
mod rig;
mod scene;
mod view;

/// The part of the package `holod` that is written in Rust.
#[pyo3::pymodule]
mod _holod {
    #[pymodule_export]
    use super::evaluation::evaluate;
    #[pymodule_export]
    use super::log::read_samples;
    #[pymodule_export]
    use super::renderer::{Hologram, Renderer};
    #[pymodule_export]
    use super::rig::Rig;
    #[pymodule_export]
    use super::scene::{read_scene, render_builtin_scene};
    #[pymodule_export]
    use super::view::{to_srgb8, view};
}
