//! What a person should hear of the panel and the lasers while the loop runs.

use holod_calibration::TimeNs;
use holod_slm_output::PanelEvent;
use holod_slm_output::laser::DarkReason;
use holod_slm_output::output::{FieldEvent, OutputCounts};
use holod_slm_output::present::{PanelFault, TimestampSource};

/// A panel whose rate differs from the rig's by more than this share is not the one that the rig describes.
const RATE_TOLERANCE: f64 = 0.005;
/// How long the panel's rate is watched before it is judged.
const RATE_WATCHED: TimeNs = TimeNs(1_000_000_000);
/// How long no report may be believed before that is said.
const UNBELIEVED: TimeNs = TimeNs(3_000_000_000);
/// At most one line in this time says that lasers went dark: lasers that flicker must not flood the log.
const DARK_EVERY: TimeNs = TimeNs(1_000_000_000);

/// Follows panel and lasers, and says in the log what changes.
pub(super) struct OutputWatch {
    events: rtrb::Consumer<PanelEvent>,
    /// Refreshes a second that the rig names.
    nominal_hz: f64,
    lost: Option<PanelFault>,
    /// Since when the rate has been off, and whether that has been said.
    off_rate: Option<(TimeNs, bool)>,
    /// Since when fields have been dark for nothing but reports that are not believed.
    unbelieved_since: Option<TimeNs>,
    has_said_unbelieved: bool,
    t_next_dark_line: TimeNs,
}

impl OutputWatch {
    pub(super) fn new(events: rtrb::Consumer<PanelEvent>, nominal_hz: f64) -> Self {
        Self {
            events,
            nominal_hz,
            lost: None,
            off_rate: None,
            unbelieved_since: None,
            has_said_unbelieved: false,
            t_next_dark_line: TimeNs(i64::MIN),
        }
    }

    /// Why the panel is lost now, if it is.
    pub(super) fn lost(&self) -> Option<PanelFault> {
        self.lost
    }

    /// Takes note of everything that the panel's thread has said.
    pub(super) fn drain(&mut self) {
        while let Ok(event) = self.events.pop() {
            match event {
                PanelEvent::Lost { fault, .. } => {
                    tracing::error!("the panel is lost, lasers dark: {fault}");
                    self.lost = Some(fault);
                }
                PanelEvent::Back { .. } => {
                    tracing::info!("the panel is back");
                    self.lost = None;
                    (self.off_rate, self.unbelieved_since, self.has_said_unbelieved) = (None, None, false);
                }
            }
        }
    }

    /// Warns once where the panel's rate is not the rig's.
    pub(super) fn judge_rate(&mut self, counts: &OutputCounts, now: TimeNs) {
        let off = counts.refresh_hz > 0.0 && (counts.refresh_hz / self.nominal_hz - 1.0).abs() > RATE_TOLERANCE;
        if !off || self.lost.is_some() {
            self.off_rate = None;
            return;
        }
        let (since, said) = self.off_rate.get_or_insert((now, false));
        if !*said && now - *since >= RATE_WATCHED {
            *said = true;
            tracing::warn!(
                "the panel refreshes at {:.2} Hz, the rig says {} Hz: its fields are not as long as the lasers' windows \
                 suppose, so lasers stay dark; set the panel's mode to the rig's rate, or correct panel.refresh_hz",
                counts.refresh_hz,
                self.nominal_hz
            );
        }
    }

    /// Warns once, until the panel is lost and back, where reports of a panel of the rig's rate are not believed.
    pub(super) fn judge_reports(&mut self, field: &FieldEvent) {
        if field.dark != Some(DarkReason::Untrusted) {
            self.unbelieved_since = None;
            return;
        }
        let since = *self.unbelieved_since.get_or_insert(field.t_present);
        if self.has_said_unbelieved || self.off_rate.is_some() || field.t_present - since < UNBELIEVED {
            return;
        }
        self.has_said_unbelieved = true;
        let why = match field.provenance {
            TimestampSource::Hardware | TimestampSource::Driver | TimestampSource::External => {
                "their times scatter by more than the rig leaves room for; a longer lasers.on_delay_ms and a shorter \
                 lit_ms leave more, and a wire from the panel's sync output to the laser box (lasers.sync_wire) needs \
                 none"
            }
            TimestampSource::Software | TimestampSource::Estimated => {
                "their times are software's, not the display's, or scatter; `holod check` says what an output is good \
                 for"
            }
        };
        tracing::warn!("no report of the panel's refreshes is believed, so lasers stay dark: {why}");
    }

    /// The laser box went dark.
    pub(super) fn went_dark(&mut self, t: TimeNs, reason: DarkReason) {
        if t >= self.t_next_dark_line {
            tracing::info!("lasers dark: {reason} ({})", reason.meaning());
            self.t_next_dark_line = t + DARK_EVERY;
        }
    }
}
