//! From refreshes of the panel to what the lasers may do.
//!
//! A [`FieldScheduler`] is told of every refresh that a panel reports and says, field by field, what the laser box
//! shall do: `refreshes` decides whether the reports can be believed, `gate` cuts the window out of each field,
//! `interlock` decides whether it may be lit, `balance` keeps the colours equal. All of it is pure: times come in as
//! arguments.
//!
//! What it knows of the panel is a report for each refresh. What it does not know, it leaves dark: a refresh without a
//! report, one that contradicts the others, one whose time is a guess.

mod balance;
mod gate;
mod interlock;
mod refreshes;

pub use gate::{FieldGate, WindowClock};
pub use interlock::{Evidence, Orders};

use holod_calibration::rig::{Lasers, Panel};
use holod_calibration::{Colour, TimeNs};

use self::balance::{Balance, LIGHT_MIN};
use self::interlock::Interlock;
use self::refreshes::RefreshJudge;
use crate::fields::{FrameLayout, FrameTag};
use crate::laser::{DarkReason, LaserError, LaserProgram};
use crate::present::{PresentedRefresh, TimestampSource};

/// One colour field that is on the panel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ShownField {
    /// The frame whose pattern is shown; `None` for the flat pattern.
    pub frame: Option<FrameTag>,
    /// Position in the colour frame.
    pub field: usize,
    /// The colour whose pattern is shown.
    pub colour: Colour,
    /// When the pattern came on the panel.
    pub t_present: TimeNs,
    /// Where `t_present` comes from.
    pub timestamp_source: TimestampSource,
    /// Whether the frame had been shown before, because no newer one was there in time.
    pub repeated: bool,
    /// Whether the panel reported this field itself; the panel's sequencer shows the others after it.
    pub reported: bool,
}

/// What is to be done about a field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldDecision {
    /// The field that is on the panel.
    pub shown: ShownField,
    /// What the laser box shall do now.
    pub orders: Orders,
    /// Why its laser stays dark, if it does.
    pub dark: Option<DarkReason>,
}

/// Decides over the lasers, refresh by refresh.
#[derive(Clone, Debug)]
pub struct FieldScheduler {
    layout: FrameLayout,
    gate: FieldGate,
    judge: RefreshJudge,
    interlock: Interlock,
    balance: Balance,
    current: Option<Current>,
}

/// The refresh that is on the panel, as far as its fields have not been decided yet.
#[derive(Clone, Copy, Debug)]
struct Current {
    refresh: PresentedRefresh,
    verdict: Result<(), DarkReason>,
    /// Fields of this refresh that have been decided.
    decided: usize,
}

impl FieldScheduler {
    /// A scheduler that begins dark.
    ///
    /// `evidence` is the weakest that is accepted for the time of a refresh, `clock` what the windows' places depend
    /// on, `stall_timeout` the longest time for which one frame may stay lit without a newer one.
    ///
    /// # Errors
    /// As [`FieldGate::new`].
    pub fn new(
        panel: &Panel,
        layout: FrameLayout,
        lasers: &Lasers,
        evidence: Evidence,
        clock: WindowClock,
        stall_timeout: TimeNs,
    ) -> Result<Self, LaserError> {
        let gate = FieldGate::new(panel, lasers)?;
        let trigger = FieldGate::trigger(panel);
        let tolerance = gate.time_tolerance(trigger, clock);
        Ok(Self {
            layout,
            gate,
            judge: RefreshJudge::new(gate.timing().refresh_period, tolerance, layout.refreshes(), clock),
            interlock: Interlock::new(gate, trigger, evidence, stall_timeout),
            balance: Balance::new(&layout, gate.width()),
            current: None,
        })
    }

    /// What the laser box must be told before it is armed.
    ///
    /// # Errors
    /// As [`FieldGate::program`].
    pub fn program(&self, panel: &Panel, lasers: &Lasers) -> Result<LaserProgram, LaserError> {
        self.gate.program(panel, lasers)
    }

    /// The windows and the panel's periods.
    pub fn gate(&self) -> FieldGate {
        self.gate
    }

    /// Whether the box was last told that it may light lasers.
    pub fn is_armed(&self) -> bool {
        self.interlock.is_armed()
    }

    /// Refreshes a second as the panel reports them; 0 until two have come.
    pub fn refresh_hz(&self) -> f64 {
        self.judge.refresh_hz()
    }

    /// The panel reports a refresh. Its fields, and those that are left of the refresh before it, come out of
    /// [`Self::next_field`].
    pub fn on_refresh(&mut self, refresh: &PresentedRefresh) {
        let verdict = self.judge.judge(refresh);
        self.current = Some(Current { refresh: *refresh, verdict, decided: 0 });
    }

    /// Decides over the next field that has begun by `now`, in order.
    pub fn next_field(&mut self, now: TimeNs) -> Option<FieldDecision> {
        let (shown, verdict) = self.next_shown()?;
        // A report may come before its own time; that it does is judged, too.
        if !shown.reported && shown.t_present > now {
            return None;
        }
        if let Some(current) = &mut self.current {
            current.decided += 1;
        }
        let (mut orders, mut dark) = self.interlock.on_field(&shown, verdict, now);
        if orders.arm {
            self.balance = Balance::new(&self.layout, self.gate.width());
        }
        if let Some(window) = &mut orders.light {
            let t_begin = window.t_on.max(now);
            let left = window.t_off - t_begin;
            let taken = self.balance.take(shown.field, left);
            // What is cut off is its beginning, which a box that is told late would miss anyway.
            window.t_on = window.t_off - taken;
            if taken == TimeNs(0) {
                orders.light = None;
                dark = Some(if left < LIGHT_MIN { DarkReason::Late } else { DarkReason::Balance });
            }
        }
        Some(FieldDecision { shown, orders, dark })
    }

    /// The panel was lost: nothing is known of it any more.
    pub fn panel_lost(&mut self) -> Orders {
        self.current = None;
        self.judge.forget();
        self.interlock.dark(DarkReason::PanelLost)
    }

    /// Time goes by without a field.
    pub fn watch(&mut self, now: TimeNs) -> Orders {
        self.interlock.watch(now)
    }

    /// When [`Self::next_field`] or [`Self::watch`] should next be asked, if nothing is reported until then.
    pub fn t_next(&self) -> Option<TimeNs> {
        let field = self.next_shown().map(|(shown, _)| shown.t_present);
        field.into_iter().chain(self.interlock.t_watch()).min()
    }

    /// The box went dark by itself; it is armed again when fields are known to be shown again.
    pub fn box_went_dark(&mut self, reason: DarkReason) {
        self.interlock.box_went_dark(reason);
    }

    /// The box was not armed as the last field wanted it. Why it is dark.
    pub fn not_armed(&mut self) -> DarkReason {
        self.interlock.not_armed()
    }

    /// The window that was ordered last stayed dark at the box.
    pub fn stayed_dark(&mut self) {
        self.balance.give_back();
    }

    /// Of the windows ordered for `colour`, `time` stayed dark at the box.
    pub fn missed(&mut self, colour: Colour, time: TimeNs) {
        self.balance.give_back_of(colour, time);
    }

    /// Darkness is asked for and why, or that is taken back.
    pub fn hold(&mut self, held: Option<DarkReason>) -> Orders {
        self.interlock.hold(held)
    }

    /// Dark for good: shutdown, panic.
    pub fn latch(&mut self, reason: DarkReason) -> Orders {
        self.interlock.latch(reason)
    }

    fn next_shown(&self) -> Option<(ShownField, Result<(), DarkReason>)> {
        let Current { refresh, verdict, decided } = self.current?;
        if decided == self.layout.fields_per_refresh() {
            return None;
        }
        let field = refresh.field + decided;
        // A field that the colour frame does not have has no colour that could be lit.
        let known = field < self.layout.fields();
        let colour = if known { self.layout.colour_of_field(field) } else { self.layout.field_order[0] };
        let shown = ShownField {
            frame: refresh.frame,
            field,
            colour,
            t_present: TimeNs(refresh.t_present.0 + decided as i64 * self.gate.timing().field_period.0),
            timestamp_source: refresh.timestamp_source,
            repeated: refresh.repeated,
            reported: decided == 0,
        };
        Some((shown, if known { verdict } else { Err(DarkReason::WrongColour) }))
    }
}

#[cfg(test)]
mod tests;
