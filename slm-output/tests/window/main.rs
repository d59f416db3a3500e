//! The panel's window under real display servers, which each test starts for itself: Xorg with dummy monitors, Xvfb,
//! and a headless compositor. `tests/all` installs them.

#![cfg(feature = "window")]

mod bench;
mod compositor;
mod fails_dark;
mod stamped;
mod stamping_compositor;
mod wayland;
mod x11;
mod x11_server;
