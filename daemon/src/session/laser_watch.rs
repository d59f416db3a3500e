//! What a person should hear of the laser box: what went wrong with it, that it is lost, that it is back.

use holod_slm_output::laser::{LaserError, LaserWatch};

/// Follows the laser box, and says in the log what changes.
pub(crate) struct LaserBoxWatch {
    faults: rtrb::Consumer<LaserError>,
    link: Option<LaserWatch>,
    /// Why the box is lost, as it was said last.
    lost: Option<String>,
    /// The last fault of a box that is there.
    fault: Option<String>,
}

impl LaserBoxWatch {
    pub(crate) const fn new(faults: rtrb::Consumer<LaserError>, link: Option<LaserWatch>) -> Self {
        Self { faults, link, lost: None, fault: None }
    }

    /// Takes note of everything that the laser thread has said. `armed`: lasers may be lit, so whatever was wrong is
    /// over.
    pub(crate) fn drain(&mut self, armed: bool) {
        while let Ok(fault) = self.faults.pop() {
            // Why it is lost is said below, once.
            if matches!(fault, LaserError::Lost) {
                continue;
            }
            let fault = fault.to_string();
            if self.fault.as_ref() != Some(&fault) {
                tracing::warn!("lasers dark: {fault}");
                self.fault = Some(fault);
            }
        }
        if armed {
            self.fault = None;
        }
        let lost = self.link.as_ref().and_then(LaserWatch::trouble);
        match (&self.lost, &lost) {
            (None, Some(why)) => tracing::error!("the laser box is lost, lasers dark: {why}"),
            (Some(before), Some(why)) if before != why => tracing::warn!("the laser box is not found again: {why}"),
            (Some(_), None) => tracing::info!("the laser box is back"),
            _ => {}
        }
        self.lost = lost;
    }

    /// What is wrong with the box now, if anything is.
    pub(crate) fn trouble(&self) -> Option<&str> {
        self.lost.as_deref().or(self.fault.as_deref())
    }
}
