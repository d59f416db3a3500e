//! Reference firmware of a laser box that speaks holod's laser protocol.
//!
//! The protocol is specified in `slm-output/doc/laser-protocol.md`. This crate is all of a box but its pins:
//! [`mod@line`] cuts and checks lines, [`command`] gives them their meaning, [`machine`] is the state machine that
//! decides which laser is lit, and [`controller`] joins them over the [`Hardware`] of a board. holod itself uses the
//! same types to talk to a box and as its model of one.
//!
//! It needs no operating system, no heap and no `unsafe`. It is no safety device: lasers that can reach an eye need an
//! interlock that works without any software.

#![no_std]
#![forbid(unsafe_code)]

pub mod command;
pub mod controller;
pub mod line;
pub mod machine;
pub mod types;

pub use command::{Command, Refusal};
pub use controller::{Controller, Hardware};
pub use line::{Line, LineBuffer};
pub use machine::{Event, Machine};
pub use types::{DarkReason, FIELDS_MAX, Laser, Limits, Sequence, State, SyncSeen, TimeUs, Trigger, Window};

/// The version of the protocol that a box names and a host asks for.
pub const PROTOCOL_VERSION: u32 = 3;
