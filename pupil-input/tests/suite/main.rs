//! The tests of this crate in one program, which is linked once. Those that count allocations have their own.

mod clock;
mod core_network;
mod day;
mod export;
mod eye;
mod filters;
mod gate;
mod hid;
mod logs;
mod logs_more;
mod lsl_bridge;
mod made_up_logs;
mod neon_network;
mod network;
mod network_links;
mod pty;
mod record;
mod scenarios;
mod support;
mod vendor_wires;
