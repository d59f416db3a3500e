//! The rule: no laser is lit over a pattern of another colour, or over one that is not known to be on the panel.
//!
//! A pure object. It is told of each field that came on the panel and of the time going by; it answers with what the
//! laser box shall do. Heartbeats come only out of fields that are known to be shown, never out of a timer, so that
//! whatever stops the fields stops the heartbeats and the box goes dark even if nobody here can say so any more.

use holod_calibration::TimeNs;

use super::{FieldGate, ShownField};
use crate::laser::{DarkReason, LitWindow, Trigger};
use crate::present::TimestampSource;

/// Panel refreshes without a present report after which lasers go dark.
const MISSING_REFRESHES: i64 = 2;

/// The weakest knowledge of a refresh's time over which a laser may be lit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// The display stamped it, or a sync input saw it.
    Stamped,
    /// Software saw the frame go by: enough of a virtual panel with virtual lasers, and where the laser box times its
    /// windows by a wire of its own to the panel.
    Seen,
}

impl Evidence {
    fn accepts(self, timestamp_source: TimestampSource) -> bool {
        match timestamp_source {
            TimestampSource::Hardware | TimestampSource::Driver | TimestampSource::External => true,
            TimestampSource::Software => self == Self::Seen,
            TimestampSource::Estimated => false,
        }
    }
}

/// What the laser box shall do now, in this order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Orders {
    /// Go dark; nothing else is ordered then.
    pub dark: Option<DarkReason>,
    /// Be armed, which lights nothing yet.
    pub arm: bool,
    /// Take a heartbeat: one that stays out for the box's timeout makes it dark.
    pub heartbeat: bool,
    /// A colour frame began.
    pub sync: Option<TimeNs>,
    /// Light this window of host time.
    pub light: Option<LitWindow>,
}

/// Decides from the panel's reports whether lasers may be lit.
#[derive(Clone, Debug)]
pub(super) struct Interlock {
    gate: FieldGate,
    trigger: Trigger,
    evidence: Evidence,
    stall_timeout: TimeNs,
    armed: bool,
    /// Why it is not armed where nothing else forbids light: it is armed again at the next colour frame's start.
    why_unarmed: DarkReason,
    /// Set for good by shutdown and panic.
    latched: Option<DarkReason>,
    /// Why darkness is asked for, until that is taken back.
    held: Option<DarkReason>,
    /// The last refresh known to be shown.
    t_known: Option<TimeNs>,
    /// When the frame that is shown was new.
    t_new_frame: TimeNs,
}

impl Interlock {
    /// An interlock that begins dark.
    pub(super) fn new(gate: FieldGate, trigger: Trigger, evidence: Evidence, stall_timeout: TimeNs) -> Self {
        Self {
            gate,
            trigger,
            evidence,
            stall_timeout,
            armed: false,
            why_unarmed: DarkReason::Late,
            latched: None,
            held: None,
            t_known: None,
            t_new_frame: TimeNs(i64::MIN),
        }
    }

    /// Whether the box was last told that it may light lasers.
    pub(super) fn is_armed(&self) -> bool {
        self.armed
    }

    /// A field came on the panel; `verdict` says whether its refresh is believed. Says what the box shall do, and why
    /// the field's laser must stay dark if it must.
    pub(super) fn on_field(
        &mut self,
        field: &ShownField,
        verdict: Result<(), DarkReason>,
        now: TimeNs,
    ) -> (Orders, Option<DarkReason>) {
        if let Err(reason) = self.known_to_be_shown(field, verdict, now) {
            return (self.dark(reason), Some(reason));
        }
        // As good as no report. Where none comes in time [`Self::watch`] makes dark: a box that must be waited for
        // would else be told to go dark, for the reports that waited meanwhile, and be armed again without an end.
        if now.0 - field.t_present.0 > MISSING_REFRESHES * self.gate.timing().refresh_period.0 {
            return (Orders::default(), Some(DarkReason::Late));
        }
        if field.reported {
            self.t_known = Some(field.t_present);
        }
        // In the panel's own sequence a field may be lit only from the colour frame's start on, which arms.
        let starts_frame = field.field == 0;
        if !self.armed && self.trigger == Trigger::PanelSync && !starts_frame {
            return (Orders::default(), Some(self.why_unarmed));
        }
        let window = self.gate.window(field);
        let gone_by = now >= window.t_off;
        let mut orders = Orders { arm: !self.armed, heartbeat: true, ..Orders::default() };
        match self.trigger {
            Trigger::PanelSync => orders.sync = starts_frame.then_some(field.t_present),
            Trigger::Host => orders.light = (!gone_by).then_some(window),
        }
        self.armed = true;
        let dark = (gone_by && (orders.arm || self.trigger == Trigger::Host)).then_some(DarkReason::Late);
        (orders, dark)
    }

    /// Time goes by without a field.
    pub(super) fn watch(&mut self, now: TimeNs) -> Orders {
        if !self.armed {
            return Orders::default();
        }
        let missing = match self.t_known {
            Some(t_known) => now.0 - t_known.0 > (MISSING_REFRESHES + 1) * self.gate.timing().refresh_period.0,
            None => true,
        };
        if missing { self.dark(DarkReason::MissingReport) } else { Orders::default() }
    }

    /// When [`Self::watch`] should next be asked, if lasers are armed.
    pub(super) fn t_watch(&self) -> Option<TimeNs> {
        let t_known = self.t_known.filter(|_| self.armed)?;
        Some(TimeNs(t_known.0 + (MISSING_REFRESHES + 1) * self.gate.timing().refresh_period.0 + 1))
    }

    /// The box went dark by itself; it is armed again when fields are known to be shown again.
    pub(super) fn box_went_dark(&mut self, reason: DarkReason) {
        (self.armed, self.why_unarmed) = (false, reason);
    }

    /// The box was not armed after all. Why it is dark.
    pub(super) fn not_armed(&mut self) -> DarkReason {
        self.armed = false;
        self.why_unarmed
    }

    /// Dark for good: shutdown, panic.
    pub(super) fn latch(&mut self, reason: DarkReason) -> Orders {
        self.latched.get_or_insert(reason);
        self.armed = false;
        Orders { dark: Some(reason), ..Orders::default() }
    }

    /// Darkness is asked for and why, or that is taken back: lasers are lit again by the rules then.
    /// The box is told even where it should be dark already, so that its answer says that it is.
    pub(super) fn hold(&mut self, held: Option<DarkReason>) -> Orders {
        self.held = held;
        if held.is_some() {
            self.armed = false;
        }
        Orders { dark: held, ..Orders::default() }
    }

    /// Puts the lasers out for `reason` if they are armed.
    pub(super) fn dark(&mut self, reason: DarkReason) -> Orders {
        let was_armed = std::mem::replace(&mut self.armed, false);
        if was_armed {
            self.why_unarmed = reason;
        }
        Orders { dark: was_armed.then_some(reason), ..Orders::default() }
    }

    fn known_to_be_shown(
        &mut self,
        field: &ShownField,
        verdict: Result<(), DarkReason>,
        now: TimeNs,
    ) -> Result<(), DarkReason> {
        if let Some(reason) = self.latched {
            return Err(reason);
        }
        if field.frame.is_none() {
            return Err(DarkReason::Flat);
        }
        // A frame is new when it is new, whether or not its first refresh is believed.
        if !field.repeated && field.reported {
            self.t_new_frame = field.t_present.min(now);
        }
        if let Some(reason) = self.held {
            return Err(reason);
        }
        if !self.evidence.accepts(field.timestamp_source) {
            return Err(DarkReason::Untrusted);
        }
        verdict?;
        if field.reported && self.t_known.is_some_and(|before| field.t_present <= before) {
            return Err(DarkReason::Late);
        }
        // A field that is reported before it is shown is a guess.
        if field.t_present > now {
            return Err(DarkReason::Untrusted);
        }
        if field.t_present.0.saturating_sub(self.t_new_frame.0) > self.stall_timeout.0 {
            return Err(DarkReason::Stall);
        }
        Ok(())
    }
}
