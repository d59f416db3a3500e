//! What is said of the tracker while the loop runs.

use holod_calibration::{TimeNs, rig};
use holod_pupil_input::{ClockWatch, Counter, Decision, Figures, RefusalChange, RefusalWatch, TrackerControl};

/// What is said of [`Counter::Strangers`].
const STRANGERS: &str = "datagrams of another sender than the tracker's come to its port, and are left out: \
                         let each tracker and program send to a port of its own";

/// Follows the tracker, and says in the log what changes.
pub(super) struct TrackerWatch {
    refusals: RefusalWatch,
    /// Settings that the tracker's thread may not have taken yet.
    changing: Option<rig::Tracker>,
    clock: ClockWatch,
    /// Why a lost link does not come back.
    lost: Option<String>,
    /// It was said that datagrams of others are left out.
    strangers_told: bool,
}

impl TrackerWatch {
    pub(super) fn new(settings: &rig::Tracker, figures: Figures, began: TimeNs) -> Self {
        Self {
            refusals: RefusalWatch::new(settings, figures, began),
            changing: None,
            clock: ClockWatch::default(),
            lost: None,
            strangers_told: false,
        }
    }

    /// The tracker goes on with other settings.
    pub(super) fn change(&mut self, settings: &rig::Tracker, tracker: &TrackerControl) {
        self.refusals.change(settings, &tracker.counters());
        self.changing = Some(settings.clone());
    }

    /// The gate decided on a sample.
    pub(super) fn note(&mut self, decision: &Decision) {
        self.refusals.note(decision);
    }

    /// Looks at the tracker, ten times a second.
    pub(super) fn look(&mut self, tracker: &mut TrackerControl, now: TimeNs) {
        let lost = tracker.trouble();
        if lost != self.lost.as_deref() {
            self.lost = lost.map(str::to_owned);
            match &self.lost {
                Some(lost) => tracing::warn!("nothing comes of the tracker: {lost}"),
                None => tracing::info!("the tracker is there again"),
            }
        }
        if !self.strangers_told && tracker.counters().of(Counter::Strangers) > 0 {
            self.strangers_told = true;
            tracing::warn!("{STRANGERS}");
        }
        if let Some(wrong) = self.clock.judge(now, tracker.clock(), &tracker.counters()) {
            tracing::warn!("{wrong}");
        }
        self.judge(tracker, now);
    }

    /// Finds out whether everything that has come is refused.
    pub(super) fn judge(&mut self, tracker: &TrackerControl, now: TimeNs) {
        if let Some(settings) = &self.changing {
            if tracker.is_changing() {
                return;
            }
            // Samples that were believed by the settings before say nothing of these.
            self.refusals.change(settings, &tracker.counters());
            self.changing = None;
        }
        match self.refusals.judge(now, &tracker.counters(), tracker.finished()) {
            Some(RefusalChange::Refused(refusal)) => tracing::warn!("the tracker: {refusal}"),
            Some(RefusalChange::Believed) => tracing::info!("the tracker: samples are believed"),
            None => {}
        }
    }

    /// What is wrong now, for the status and the summary.
    pub(super) fn trouble(&self) -> Option<String> {
        self.lost.clone().or_else(|| self.refusals.current().map(ToString::to_string))
    }
}
