//! A program without the feature `seat` knows of no seat: none of these values exists.

use std::io;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::path::Path;

#[expect(dead_code, reason = "no seat says any of it")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Standing {
    Behind,
    Leaving,
    InFront,
    Gone,
}

#[derive(Debug)]
pub(crate) enum Seat {}

#[derive(Debug)]
pub(crate) enum SeatLease {}

impl Seat {
    pub(crate) fn open() -> Option<Self> {
        None
    }

    pub(crate) fn standing(&self) -> Standing {
        match *self {}
    }

    pub(crate) fn bell(&self) -> BorrowedFd<'_> {
        match *self {}
    }

    pub(crate) fn open_card(&self, _: &Path) -> io::Result<(OwnedFd, SeatLease)> {
        match *self {}
    }

    pub(crate) fn leave(&self) {
        match *self {}
    }
}

impl SeatLease {
    pub(crate) fn seat(&self) -> &str {
        match *self {}
    }
}
