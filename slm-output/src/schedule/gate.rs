//! The lit window of each field.

use holod_calibration::rig::{Lasers, Panel, PanelMode, RATE_TOLERANCE, REPORT_TOLERANCE_MIN};
use holod_calibration::{PerColour, TimeNs};

use super::ShownField;
use crate::fields::FIELDS;
use crate::laser::{Capability, FieldWindow, LaserError, LaserProgram, LitWindow, Trigger};
use crate::present::PanelTiming;

/// What a window's place on the panel depends on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WindowClock {
    /// The reports: the box is told of each window, or of each colour frame's start, by them.
    Reports,
    /// Nothing that holod is told: the panel itself, by a wire from its sync output to the box or by hardware of its own
    /// that gates the lasers, or no window at all, of lasers that are on while they are armed. The reports only say that
    /// the panel runs.
    Panel,
}

impl WindowClock {
    /// That of a box which can do `capability` over `panel`.
    pub fn of(panel: &Panel, capability: Capability) -> Self {
        match FieldGate::trigger(panel) {
            _ if !capability.gates_fields => Self::Panel,
            Trigger::PanelSync if capability.sync_wire => Self::Panel,
            Trigger::PanelSync | Trigger::Host => Self::Reports,
        }
    }
}

/// Cuts a window out of each colour field: after the panel's settle time and the laser's on delay, and never past the
/// field's end, also where the panel is as fast as it may be and its reports as late.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldGate {
    timing: PanelTiming,
    /// From a field's start to its on edge.
    delay: TimeNs,
    /// From the on edge to the off edge.
    width: TimeNs,
    settle: TimeNs,
}

impl FieldGate {
    /// The gate for one bench; a window that is longer than its field has room for is cut
    /// ([`PanelMode::window_slack`]).
    ///
    /// # Errors
    /// [`LaserError::NoRoom`] where the field has room for none; [`LaserError::Figure`] for a
    /// negative time or a width of 0.
    pub fn new(panel: &Panel, lasers: &Lasers) -> Result<Self, LaserError> {
        let timing = PanelTiming::new(panel);
        for (what, time) in [("panel.settle", panel.settle), ("on_delay", lasers.on_delay)] {
            if time < TimeNs(0) {
                let found = format!("{} ns", time.0);
                return Err(LaserError::Figure { what, found, expected: "0 or more" });
            }
        }
        if lasers.width <= TimeNs(0) {
            let found = format!("{} ns", lasers.width.0);
            return Err(LaserError::Figure { what: "width", found, expected: "more than 0" });
        }
        let delay = panel.settle + lasers.on_delay;
        let slack = panel.mode.window_slack(timing.field_period);
        let room = timing.field_period - delay - slack;
        if room <= TimeNs(0) {
            let [field_us, delay_us, slack_us] = [timing.field_period, delay, slack].map(|time| time.0 / 1000);
            return Err(LaserError::NoRoom { field_us, delay_us, slack_us });
        }
        Ok(Self { timing, delay, width: lasers.width.min(room), settle: panel.settle })
    }

    /// What starts the windows: a colour frame's start where the panel's own sequencer shows the colours of a refresh,
    /// else the host, one by one. Who tells the box of that start, a wire or the host, is [`WindowClock`]'s matter.
    pub fn trigger(panel: &Panel) -> Trigger {
        match panel.mode {
            PanelMode::ChannelPacked => Trigger::PanelSync,
            PanelMode::FieldSequential | PanelMode::Monochrome(_) => Trigger::Host,
        }
    }

    /// How far the reported time of a refresh may be wrong without light where it must not be.
    ///
    /// Where windows follow the reports that is half of the time that the rig leaves free at both ends of a window, on
    /// delay and the rest of the field; the other half is for what the rhythm itself is off by. What the panel's fields
    /// may be longer or shorter than the rig's comes off before: at the end of a window that of its own field, and
    /// where a whole colour frame follows one report, that of the fields before it at both ends.
    pub fn time_tolerance(&self, trigger: Trigger, clock: WindowClock) -> TimeNs {
        let fields_later = match (clock, trigger) {
            (WindowClock::Panel, _) => return TimeNs(self.timing.refresh_period.0 / 16),
            (WindowClock::Reports, Trigger::PanelSync) => FIELDS - 1,
            (WindowClock::Reports, Trigger::Host) => 0,
        };
        let drift_ns = |fields: usize| (self.timing.field_period.0 as f64 * RATE_TOLERANCE) as i64 * fields as i64;
        let before_ns = (self.delay - self.settle).0 - drift_ns(fields_later);
        let after_ns = (self.timing.field_period - self.delay - self.width).0 - drift_ns(fields_later + 1);
        TimeNs(before_ns.min(after_ns) / 2).max(REPORT_TOLERANCE_MIN)
    }

    /// Length of a window.
    pub fn width(&self) -> TimeNs {
        self.width
    }

    /// From a field's presentation to the middle of its lit window.
    pub fn middle(&self) -> TimeNs {
        TimeNs(self.delay.0 + self.width.0 / 2)
    }

    /// Time that the panel needs before a field may be lit.
    pub fn settle(&self) -> TimeNs {
        self.settle
    }

    /// Periods and fields of the panel for which the windows were laid out.
    pub fn timing(&self) -> PanelTiming {
        self.timing
    }

    /// When `field` makes way for the next one.
    pub fn t_end(&self, field: &ShownField) -> TimeNs {
        field.t_present + self.timing.field_period
    }

    /// The window in which `field`'s own laser may be lit.
    pub fn window(&self, field: &ShownField) -> LitWindow {
        let t_on = field.t_present + self.delay;
        LitWindow { colour: field.colour, t_on, t_off: t_on + self.width }
    }

    /// What a box must be told for `panel` and `lasers`, the ones that this gate was made for.
    ///
    /// # Errors
    /// [`LaserError::Figure`] for a power that is negative, not finite or above 4 W, or a heartbeat timeout of 0.
    pub fn program(&self, panel: &Panel, lasers: &Lasers) -> Result<LaserProgram, LaserError> {
        let mut power_uw = PerColour([0; 3]);
        for (colour, &power_mw) in lasers.power_mw.iter() {
            if !(0.0..=4000.0).contains(&power_mw) {
                let found = format!("{power_mw} mW");
                return Err(LaserError::Figure { what: "power_mw", found, expected: "0 to 4000" });
            }
            power_uw[colour] = Lasers::whole_uw(power_mw);
        }
        if lasers.heartbeat_timeout <= TimeNs(0) {
            let found = format!("{} ns", lasers.heartbeat_timeout.0);
            return Err(LaserError::Figure { what: "heartbeat_timeout", found, expected: "more than 0" });
        }
        let window = |field: i64| FieldWindow {
            delay: TimeNs(field * self.timing.field_period.0 + self.delay.0),
            width: self.width,
        };
        Ok(LaserProgram {
            trigger: Self::trigger(panel),
            sequence: match panel.mode {
                PanelMode::ChannelPacked | PanelMode::FieldSequential => panel.field_order,
                PanelMode::Monochrome(colour) => [colour; 3],
            },
            windows: [window(0), window(1), window(2)],
            frame_period: TimeNs(3 * self.timing.field_period.0),
            power_uw,
            heartbeat_timeout: lasers.heartbeat_timeout,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::present::TimestampSource;
    use holod_calibration::Colour;
    use holod_calibration::rig::Rig;

    const MS: i64 = 1_000_000;

    #[test]
    fn windows_lie_after_settling_and_end_with_their_field() {
        let rig = Rig::default();
        let long = Lasers { width: TimeNs(50 * MS), ..rig.lasers.clone() };
        // Of the panel's 0.5 % in three fields 83.3 µs, and 20 µs each for a report and the rhythm.
        for (lasers, t_off) in [(&rig.lasers, TimeNs(105_100_000)), (&long, TimeNs(105_432_222))] {
            let gate = FieldGate::new(&rig.panel, lasers).unwrap();
            let field = ShownField {
                frame: None,
                field: 1,
                colour: Colour::Blue,
                t_present: TimeNs(100 * MS),
                timestamp_source: TimestampSource::Hardware,
                repeated: false,
                reported: true,
            };
            let window = LitWindow { colour: Colour::Blue, t_on: TimeNs(102_100_000), t_off };
            assert_eq!(gate.window(&field), window);
            let program = gate.program(&rig.panel, lasers).unwrap();
            for (index, programmed) in program.windows.iter().enumerate() {
                let t_field = TimeNs(index as i64 * gate.timing().field_period.0);
                assert_eq!(programmed.delay, t_field + window.t_on - field.t_present);
                assert_eq!(programmed.width, window.t_off - window.t_on);
                assert!(programmed.delay + programmed.width <= t_field + gate.timing().field_period);
            }
        }
    }

    #[test]
    fn reports_may_be_as_wrong_as_the_rig_leaves_room_for_unless_the_panel_starts_the_windows() {
        let rig = Rig::default();
        let roomy = Lasers { on_delay: TimeNs(400_000), width: TimeNs(2_700_000), ..rig.lasers.clone() };
        let tolerance = |lasers: &Lasers, trigger, clock| {
            FieldGate::new(&rig.panel, lasers).unwrap().time_tolerance(trigger, clock)
        };
        assert_eq!(tolerance(&roomy, Trigger::Host, WindowClock::Reports), TimeNs(200_000));
        // 0.5 % of two fields of 5.56 ms less.
        assert_eq!(tolerance(&roomy, Trigger::PanelSync, WindowClock::Reports), TimeNs(172_223));
        let tight = Lasers { on_delay: TimeNs(0), ..rig.lasers.clone() };
        assert_eq!(tolerance(&tight, Trigger::PanelSync, WindowClock::Reports), REPORT_TOLERANCE_MIN);
        assert_eq!(
            tolerance(&tight, Trigger::PanelSync, WindowClock::Panel),
            TimeNs(rig.panel.field_period().0 * 3 / 16)
        );
    }

    /// The panel as fast as is believed, its report as late as is believed and the rhythm as far off: the last window
    /// that follows the report ends with its field.
    #[test]
    fn the_longest_window_ends_with_its_field_on_the_fastest_panel_that_is_believed() {
        for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential, PanelMode::Monochrome(Colour::Red)] {
            for refresh_hz in [24.0, 60.0, 240.0] {
                let rig = Rig::default();
                let panel = Panel { mode, refresh_hz, settle: TimeNs(100_000), ..rig.panel };
                let lasers = Lasers { width: TimeNs(50 * MS), on_delay: TimeNs(100_000), ..rig.lasers };
                let gate = FieldGate::new(&panel, &lasers).unwrap();
                let tolerance = gate.time_tolerance(FieldGate::trigger(&panel), WindowClock::Reports);
                let field_ns = gate.timing().field_period.0;
                let fields = if mode == PanelMode::ChannelPacked { 3 } else { 1 };
                let t_end = fields as f64 * field_ns as f64 * (1.0 - RATE_TOLERANCE);
                let t_off = (fields - 1) * field_ns + gate.delay.0 + gate.width.0 + 2 * tolerance.0;
                assert!((t_off as f64) <= t_end + 4.0, "{mode:?} {refresh_hz} Hz: {t_off} {t_end}");
            }
        }
    }

    #[test]
    fn powers_are_whole_microwatts_and_never_more_than_the_rig_says() {
        let rig = Rig::default();
        for (power_mw, power_uw) in [(1.001, 1001), (1.0006, 1000), (0.0015, 1), (0.1236, 123), (0.001, 1), (0.0, 0)] {
            let lasers = Lasers {
                power_mw: PerColour([power_mw; 3]),
                power_limit_mw: PerColour([Some(power_mw); 3]),
                ..rig.lasers.clone()
            };
            let gate = FieldGate::new(&rig.panel, &lasers).unwrap();
            let program = gate.program(&rig.panel, &lasers).unwrap();
            assert_eq!(program.power_uw, PerColour([power_uw; 3]), "{power_mw} mW");
            assert_eq!(lasers.greatest_power_mw().map(Lasers::whole_uw), program.power_uw, "a limit takes itself");
        }
    }

    #[test]
    fn reports_place_no_window_that_a_wire_or_the_panel_starts_and_none_of_lasers_that_have_none() {
        let packed = Rig::default().panel;
        let sequential = Panel { mode: PanelMode::FieldSequential, ..packed.clone() };
        let gates = Capability { simulated: false, gates_fields: true, has_heartbeat: true, sync_wire: false };
        let wired = Capability { sync_wire: true, ..gates };
        let always_on = Capability { gates_fields: false, ..gates };
        assert_eq!(WindowClock::of(&packed, gates), WindowClock::Reports);
        assert_eq!(WindowClock::of(&packed, wired), WindowClock::Panel);
        assert_eq!(WindowClock::of(&packed, always_on), WindowClock::Panel);
        assert_eq!(WindowClock::of(&sequential, wired), WindowClock::Reports);
        let green = Panel { mode: PanelMode::Monochrome(Colour::Green), ..packed };
        assert_eq!(WindowClock::of(&green, gates), WindowClock::Reports);
        assert_eq!(WindowClock::of(&green, always_on), WindowClock::Panel);
    }

    #[test]
    fn figures_that_leave_no_light_are_refused() {
        let rig = Rig::default();
        let slow = Panel { settle: TimeNs(6 * MS), ..rig.panel.clone() };
        assert!(matches!(
            FieldGate::new(&slow, &rig.lasers),
            Err(LaserError::NoRoom { field_us: 5555, delay_us: 6100, slack_us: 123 })
        ));
        let backwards = Panel { settle: TimeNs(-1), ..rig.panel.clone() };
        assert!(matches!(
            FieldGate::new(&backwards, &rig.lasers),
            Err(LaserError::Figure { what: "panel.settle", .. })
        ));
        let never = Lasers { width: TimeNs(0), ..rig.lasers.clone() };
        assert!(matches!(FieldGate::new(&rig.panel, &never), Err(LaserError::Figure { what: "width", .. })));
        let gate = FieldGate::new(&rig.panel, &rig.lasers).unwrap();
        for power_mw in [-1.0, f64::NAN, 5000.0] {
            let lasers = Lasers { power_mw: PerColour([1.0, power_mw, 1.0]), ..rig.lasers.clone() };
            assert!(matches!(gate.program(&rig.panel, &lasers), Err(LaserError::Figure { what: "power_mw", .. })));
        }
    }
}
