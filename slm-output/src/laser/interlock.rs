//! The rule: no laser is lit over a pattern of another colour, or over one that is not known to be on the panel.
//!
//! A pure object. It is told of each field that came on the panel and of the time going by; it answers with what the
//! laser box shall do. Heartbeats come only out of fields that are known to be shown, never out of a timer, so that
//! whatever stops the fields stops the heartbeats and the box goes dark even if nobody here can say so any more.

use holod_calibration::{Colour, TimeNs};

use super::gate::Gate;
use super::{DarkReason, LitWindow, Trigger};
use crate::fields::FIELDS;
use crate::present::{PresentedField, Provenance};

/// Panel refreshes without a present report after which lasers go dark.
const MISSING_REFRESHES: i64 = 2;

/// What the laser box shall do now, in this order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Orders {
    /// Go dark; nothing else is ordered then.
    pub dark: Option<DarkReason>,
    /// Be armed.
    pub arm: bool,
    /// Hear a heartbeat.
    pub heartbeat: bool,
    /// A colour frame began.
    pub sync: Option<TimeNs>,
    /// Light this window.
    pub light: Option<LitWindow>,
}

/// Decides from the panel's reports whether lasers may be lit.
#[derive(Clone, Debug)]
pub struct Interlock {
    gate: Gate,
    trigger: Trigger,
    field_order: [Colour; FIELDS],
    /// The panel is virtual: its software times are the truth.
    virtual_panel: bool,
    stall_timeout: TimeNs,
    refresh: TimeNs,
    armed: bool,
    /// Set for good by shutdown and panic.
    latched: Option<DarkReason>,
    /// The last field known to be shown.
    t_known: Option<TimeNs>,
    /// When the frame that is shown was new.
    t_new_frame: TimeNs,
}

impl Interlock {
    /// An interlock that begins dark.
    ///
    /// `virtual_panel`: accept software times, which are exact there; only where the lasers are no more real than the
    /// panel. `stall_timeout`: longest time for which one frame
    /// may stay lit without a newer one.
    pub fn new(
        gate: Gate,
        trigger: Trigger,
        field_order: [Colour; FIELDS],
        virtual_panel: bool,
        stall_timeout: TimeNs,
    ) -> Self {
        let timing = gate.timing();
        let refresh = match trigger {
            Trigger::PanelSync => timing.frame_period,
            Trigger::Host => timing.field_period,
        };
        Self {
            gate,
            trigger,
            field_order,
            virtual_panel,
            stall_timeout,
            refresh,
            armed: false,
            latched: None,
            t_known: None,
            t_new_frame: TimeNs(i64::MIN),
        }
    }

    /// Whether the box was last told that it may light lasers.
    pub fn is_armed(&self) -> bool {
        self.armed
    }

    /// A field came on the panel. Says what the box shall do, and why the field's laser must stay dark if it must.
    pub fn on_field(&mut self, field: &PresentedField, now: TimeNs) -> (Orders, Option<DarkReason>) {
        if let Err(reason) = self.known_to_be_shown(field, now) {
            return (self.dark(reason), Some(reason));
        }
        self.t_known = Some(field.t_present);
        // In the panel's own sequence a field may be lit only from the colour frame's start on, which arms.
        let starts_frame = field.field == 0;
        if !self.armed && self.trigger == Trigger::PanelSync && !starts_frame {
            return (Orders::default(), Some(DarkReason::Late));
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
    pub fn watch(&mut self, now: TimeNs) -> Orders {
        if !self.armed {
            return Orders::default();
        }
        let missing = match self.t_known {
            Some(t_known) => now.0 - t_known.0 > (MISSING_REFRESHES + 1) * self.refresh.0,
            None => true,
        };
        if missing { self.dark(DarkReason::MissingReport) } else { Orders::default() }
    }

    /// When [`Self::watch`] should next be asked, if lasers are armed.
    pub fn t_watch(&self) -> Option<TimeNs> {
        let t_known = self.t_known.filter(|_| self.armed)?;
        Some(TimeNs(t_known.0 + (MISSING_REFRESHES + 1) * self.refresh.0 + 1))
    }

    /// The box went dark by itself; it is armed again when fields are known to be shown again.
    pub fn box_went_dark(&mut self) {
        self.armed = false;
    }

    /// Dark for good: shutdown, panic.
    pub fn latch(&mut self, reason: DarkReason) -> Orders {
        self.latched.get_or_insert(reason);
        self.armed = false;
        Orders { dark: Some(reason), ..Orders::default() }
    }

    fn dark(&mut self, reason: DarkReason) -> Orders {
        let was_armed = std::mem::replace(&mut self.armed, false);
        Orders { dark: was_armed.then_some(reason), ..Orders::default() }
    }

    fn known_to_be_shown(&mut self, field: &PresentedField, now: TimeNs) -> Result<(), DarkReason> {
        if let Some(reason) = self.latched {
            return Err(reason);
        }
        if field.frame.is_none() {
            return Err(DarkReason::Flat);
        }
        match field.provenance {
            Provenance::Hardware | Provenance::External => {}
            Provenance::Software if self.virtual_panel => {}
            Provenance::Software | Provenance::Estimated => return Err(DarkReason::Untrusted),
        }
        if field.field >= FIELDS || self.field_order[field.field] != field.colour {
            return Err(DarkReason::WrongColour);
        }
        let age_ns = now.0 - field.t_present.0;
        if age_ns > MISSING_REFRESHES * self.refresh.0 || self.t_known.is_some_and(|before| field.t_present <= before) {
            return Err(DarkReason::Late);
        }
        // A field that is reported before it is shown is a guess.
        if age_ns < 0 {
            return Err(DarkReason::Untrusted);
        }
        if !field.repeated {
            self.t_new_frame = field.t_present;
        }
        if field.t_present.0.saturating_sub(self.t_new_frame.0) > self.stall_timeout.0 {
            return Err(DarkReason::Stall);
        }
        Ok(())
    }
}
