//! What is said of the laser box: what went wrong with it, that it is lost, that it is back, and for how long it was
//! not there.

use holod_calibration::TimeNs;
use holod_slm_output::laser::{LaserError, LaserWatch};
use serde::Serialize;

/// Follows the laser box, and says in the log what changes.
pub(crate) struct LaserBoxWatch {
    faults: rtrb::Consumer<LaserError>,
    link: Option<LaserWatch>,
    /// Why the box is lost, as it was said last.
    lost: Option<String>,
    /// The last fault of a box that is there.
    fault: Option<String>,
    losses: Losses,
}

/// That the laser box was lost in a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BoxLost {
    /// How often it was lost, one that came back and was lost again included.
    pub times: u32,
    /// For how long in all, each time until it was found again or the run ended; to a tenth of a second.
    pub seconds: f64,
    /// Whether it was there at the end.
    pub is_back: bool,
}

impl BoxLost {
    /// The same in words.
    pub(crate) fn text(&self) -> String {
        let Self { times, seconds, is_back } = self;
        let often = if *times > 1 { format!(" {times} times") } else { String::new() };
        let in_all = if *times > 1 { " in all" } else { "" };
        format!("lasers lost{often} for {seconds:.1} s{in_all}, {}", if *is_back { "back" } else { "not back" })
    }
}

/// When the box was lost.
#[derive(Default)]
struct Losses {
    times: u32,
    /// For how long in all it was lost, but for the loss that has not ended.
    ended: TimeNs,
    /// Since when it is lost, where it is.
    t_lost: Option<TimeNs>,
}

impl Losses {
    fn note(&mut self, is_lost: bool, now: TimeNs) {
        match (self.t_lost, is_lost) {
            (None, true) => (self.times, self.t_lost) = (self.times + 1, Some(now)),
            (Some(t_lost), false) => (self.ended, self.t_lost) = (self.ended + (now - t_lost), None),
            _ => {}
        }
    }

    fn at(&self, now: TimeNs) -> Option<BoxLost> {
        let lasts = self.t_lost.map_or(TimeNs(0), |t_lost| now - t_lost);
        let seconds = ((self.ended + lasts).seconds() * 10.0).round() / 10.0;
        (self.times > 0).then_some(BoxLost { times: self.times, seconds, is_back: self.t_lost.is_none() })
    }
}

impl LaserBoxWatch {
    pub(crate) const fn new(faults: rtrb::Consumer<LaserError>, link: Option<LaserWatch>) -> Self {
        let losses = Losses { times: 0, ended: TimeNs(0), t_lost: None };
        Self { faults, link, lost: None, fault: None, losses }
    }

    /// Takes note of everything that the laser thread has said. `armed`: lasers may be lit, so whatever was wrong is
    /// over.
    pub(crate) fn drain(&mut self, armed: bool, now: TimeNs) {
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
        self.losses.note(lost.is_some(), now);
        self.lost = lost;
    }

    /// That the box was lost up to `now`, where it was.
    pub(crate) fn box_lost(&self, now: TimeNs) -> Option<BoxLost> {
        self.losses.at(now)
    }

    /// What is wrong with the box now, if anything is.
    pub(crate) fn trouble(&self) -> Option<&str> {
        self.lost.as_deref().or(self.fault.as_deref())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_lasts_until_the_box_is_back_or_the_run_ends() {
        let second = |s: f64| TimeNs::from_seconds(s);
        let mut losses = Losses::default();
        losses.note(false, second(1.0));
        assert_eq!(losses.at(second(2.0)), None);
        losses.note(true, second(3.0));
        losses.note(true, second(3.1));
        let lost = losses.at(second(3.5)).unwrap();
        assert_eq!(lost, BoxLost { times: 1, seconds: 0.5, is_back: false });
        assert_eq!(lost.text(), "lasers lost for 0.5 s, not back");
        losses.note(false, second(6.0));
        let lost = losses.at(second(60.0)).unwrap();
        assert_eq!(lost, BoxLost { times: 1, seconds: 3.0, is_back: true });
        assert_eq!(lost.text(), "lasers lost for 3.0 s, back");
        losses.note(true, second(61.0));
        losses.note(false, second(62.25));
        let lost = losses.at(second(70.0)).unwrap();
        assert_eq!(lost, BoxLost { times: 2, seconds: 4.3, is_back: true });
        assert_eq!(lost.text(), "lasers lost 2 times for 4.3 s in all, back");
    }
}
