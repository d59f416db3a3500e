//! Which monitor the panel is, and whether it shows the panel's own pixels. No input or output: a display server's
//! description goes in.

use std::fmt;

use holod_calibration::Resolution;
use holod_calibration::rig::Panel;

use crate::present::drm::{ConnectorList, Edid};
use crate::present::{AlterationKind, PanelFault, WindowSpec};

/// How far a mode's refresh rate may be from the rig's, as a share of it: 59.94 and 59.95 Hz are "60 Hz" to those who
/// sell monitors, and the next rate that is sold, 59.7, is another one.
const REFRESH_TOLERANCE: f64 = 0.004;

/// A lit monitor, as its display server describes it.
#[derive(Clone, Debug, PartialEq)]
pub struct Monitor {
    /// The connector's name, such as `DP-2`; display servers and the kernel do not always agree on it.
    pub connector: String,
    /// What its EDID says.
    pub edid: Option<Edid>,
    /// The desktop's main monitor, where the server knows of such a thing.
    pub primary: bool,
    /// Where its picture begins on the desktop, pixels, from the left.
    pub left_px: i32,
    /// The same from the top.
    pub top_px: i32,
    /// Pixels of the video mode.
    pub mode: Resolution,
    /// Refreshes a second of that mode, where the server knows them.
    pub refresh_hz: Option<f64>,
    /// Whatever keeps the window's pixels from reaching the monitor as they are.
    pub alterations: Vec<Alteration>,
}

/// What changes pixels on their way to a monitor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Alteration {
    /// The server draws in another size, and scales.
    Scaled,
    /// It rotates, reflects or warps.
    Transformed,
    /// It shows one half of the lines at a time, or each twice.
    Interlaced,
    /// It bends the levels by a gamma ramp, as night-light and calibration tools set one.
    GammaRamp,
    /// The monitor of the other connector shows the same part of the desktop.
    Mirrored(String),
    /// It is in power-saving.
    Asleep,
}

impl Alteration {
    const fn kind(&self) -> AlterationKind {
        match self {
            Self::Scaled => AlterationKind::Scaled,
            Self::Transformed => AlterationKind::Transformed,
            Self::Interlaced => AlterationKind::Interlaced,
            Self::GammaRamp => AlterationKind::GammaRamp,
            Self::Mirrored(_) => AlterationKind::Mirrored,
            Self::Asleep => AlterationKind::Asleep,
        }
    }
}

impl fmt::Display for Alteration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mirrored(other) => write!(f, "{other} shows the same part of the desktop; move one of them"),
            other => other.kind().fmt(f),
        }
    }
}

impl Monitor {
    /// Whether somebody who says `name` means this monitor: by its connector or by what its EDID says.
    fn is_called(&self, name: &str) -> bool {
        self.connector.eq_ignore_ascii_case(name) || self.edid.as_ref().is_some_and(|edid| edid.is(name))
    }

    fn has_mode_of(&self, panel: &PanelMonitor) -> bool {
        let rate_fits = |hz: f64| (hz - panel.refresh_hz).abs() <= panel.refresh_hz * REFRESH_TOLERANCE;
        self.mode == panel.resolution && self.refresh_hz.is_none_or(rate_fits)
    }

    /// Whether YCbCr 4:4:4 is sent to it in place of RGB, by the connectors that are there: it is found among them by its
    /// EDID, since display servers name connectors in their own ways.
    pub fn gets_ycbcr_444(&self, there: &ConnectorList) -> bool {
        self.edid.is_some() && there.0.iter().any(|seen| seen.edid == self.edid && seen.sends_ycbcr_444())
    }
}

impl fmt::Display for Monitor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.connector)?;
        if let Some(edid) = &self.edid {
            write!(f, " ({edid})")?;
        }
        write!(f, " {}x{}", self.mode.width, self.mode.height)?;
        if let Some(hz) = self.refresh_hz {
            write!(f, " at {hz:.2} Hz")?;
        }
        f.write_str(if self.primary { ", primary" } else { "" })
    }
}

/// What the monitor must be, from the rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PanelMonitor {
    /// Pixels of the video frame that the panel takes.
    pub resolution: Resolution,
    /// Its own refreshes a second.
    pub refresh_hz: f64,
}

impl PanelMonitor {
    /// What `panel` asks for, whose video frames have `resolution` pixels.
    pub fn new(panel: &Panel, resolution: Resolution) -> Self {
        Self { resolution, refresh_hz: panel.refresh_hz }
    }
}

impl fmt::Display for PanelMonitor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{} at {:.2} Hz", self.resolution.width, self.resolution.height, self.refresh_hz)
    }
}

/// Why no monitor can be the panel.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages say what the fields are")]
pub enum MonitorError {
    /// No monitor is lit.
    #[error("the display server has no lit monitor; connect the panel and switch it on in the monitor settings")]
    NoneThere,
    /// No monitor has that name.
    #[error("no monitor is called \"{wanted}\"; there is {}", list(there))]
    NotThere { wanted: String, there: Vec<Monitor> },
    /// Several monitors are called so.
    #[error("\"{wanted}\" is more than one monitor: {}; name it by its connector or serial number", list(called))]
    Ambiguous {
        wanted: String,
        /// Those that are called so.
        called: Vec<Monitor>,
    },
    /// No name was given, and not exactly one monitor fits.
    #[error(
        "{} could be a panel of {panel}; name it: window:MONITOR. There is {}",
        if *fitting == 0 { "no monitor but the primary one".to_owned() } else { format!("{fitting} monitors") }, list(there)
    )]
    NotNamed {
        fitting: usize,
        /// What was looked for.
        panel: PanelMonitor,
        there: Vec<Monitor>,
    },
    /// It is where the desktop is.
    #[error(
        "{monitor} is the {} monitor, where the desktop is; name another one, or add ,allow_primary. There is {}",
        if there.len() == 1 { "only" } else { "primary" }, list(there)
    )]
    Primary {
        /// The one that was meant.
        monitor: Box<Monitor>,
        there: Vec<Monitor>,
    },
    /// It shows another size or rate.
    #[error("{monitor}: the rig's panel is {panel}; set this mode in the monitor settings, or correct the rig file")]
    Mode {
        /// The one that was meant.
        monitor: Box<Monitor>,
        /// What it must be.
        panel: PanelMonitor,
    },
    /// It would not show the pixels as they are.
    #[error("{monitor}: {}", .monitor.alterations.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    Altered {
        /// The one that was meant.
        monitor: Box<Monitor>,
    },
}

impl MonitorError {
    /// What it is for a panel that was there.
    pub(super) fn as_fault(&self) -> PanelFault {
        match self {
            Self::NoneThere | Self::NotThere { .. } | Self::NotNamed { fitting: 0, .. } => PanelFault::Unplugged,
            Self::Primary { .. } => PanelFault::Primary,
            Self::Ambiguous { .. } | Self::NotNamed { .. } => PanelFault::Ambiguous,
            Self::Mode { .. } => PanelFault::ModeRefused,
            Self::Altered { monitor } => {
                monitor.alterations.first().map_or(PanelFault::ModeRefused, |first| PanelFault::Altered(first.kind()))
            }
        }
    }
}

fn list(monitors: &[Monitor]) -> String {
    if monitors.is_empty() {
        return "none".to_owned();
    }
    monitors.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ")
}

/// Chooses the panel's monitor among `there`.
///
/// Without a name it is the only one that is not the primary one and shows what the panel needs; where the server knows
/// no primary monitor, or more than one fits, it must be named. The primary monitor and the only one are refused
/// unless `spec` allows them, by whatever name.
///
/// # Errors
/// [`MonitorError`].
pub fn choose<'a>(there: &'a [Monitor], spec: &WindowSpec, panel: &PanelMonitor) -> Result<&'a Monitor, MonitorError> {
    if there.is_empty() {
        return Err(MonitorError::NoneThere);
    }
    let has_primary = there.iter().any(|monitor| monitor.primary);
    let monitor = match &spec.monitor {
        Some(wanted) => {
            let called: Vec<_> = there.iter().filter(|monitor| monitor.is_called(wanted)).collect();
            match called[..] {
                [] => return Err(MonitorError::NotThere { wanted: wanted.clone(), there: there.to_vec() }),
                [monitor] => monitor,
                _ => {
                    let called = called.into_iter().cloned().collect();
                    return Err(MonitorError::Ambiguous { wanted: wanted.clone(), called });
                }
            }
        }
        None => {
            let fits = |monitor: &&Monitor| {
                monitor.has_mode_of(panel) && (spec.allow_primary || (has_primary && !monitor.primary))
            };
            let fitting: Vec<_> = there.iter().filter(fits).collect();
            match fitting[..] {
                [monitor] => monitor,
                _ if there.len() == 1 => &there[0],
                _ => {
                    return Err(MonitorError::NotNamed {
                        fitting: fitting.len(),
                        panel: *panel,
                        there: there.to_vec(),
                    });
                }
            }
        }
    };
    if (monitor.primary || there.len() == 1) && !spec.allow_primary {
        return Err(MonitorError::Primary { monitor: Box::new(monitor.clone()), there: there.to_vec() });
    }
    if !monitor.has_mode_of(panel) {
        return Err(MonitorError::Mode { monitor: Box::new(monitor.clone()), panel: *panel });
    }
    if !monitor.alterations.is_empty() {
        return Err(MonitorError::Altered { monitor: Box::new(monitor.clone()) });
    }
    Ok(monitor)
}

/// What is wrong where the window is to be on `monitor`, which was chosen before, and the monitors `there` are lit now;
/// nothing where the same one would be chosen again, in the same place.
pub(super) fn fault_of(
    monitor: &Monitor,
    there: &[Monitor],
    spec: &WindowSpec,
    panel: &PanelMonitor,
) -> Option<PanelFault> {
    if !there.iter().any(|other| other.connector == monitor.connector) {
        return Some(PanelFault::Unplugged);
    }
    match choose(there, spec, panel) {
        Ok(chosen) if chosen == monitor => None,
        // It is the same one, but elsewhere on the desktop.
        Ok(chosen) if chosen.connector == monitor.connector && chosen.edid == monitor.edid => {
            Some(PanelFault::WindowLost)
        }
        Ok(_) => Some(PanelFault::Unplugged),
        Err(why) => Some(why.as_fault()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::present::drm::SeenConnector;
    use proptest::prelude::*;

    const PANEL: PanelMonitor = PanelMonitor { resolution: Resolution { width: 1920, height: 1080 }, refresh_hz: 60.0 };

    fn edid(name: &str, serial: &str) -> Option<Edid> {
        Some(Edid {
            maker: "HOL".to_owned(),
            product: 1,
            serial_number: 0,
            name: Some(name.to_owned()),
            serial: Some(serial.to_owned()),
            native: None,
            takes_ycbcr_444: false,
        })
    }

    fn monitor(connector: &str) -> Monitor {
        Monitor {
            connector: connector.to_owned(),
            edid: None,
            primary: false,
            left_px: 0,
            top_px: 0,
            mode: PANEL.resolution,
            refresh_hz: Some(59.94),
            alterations: Vec::new(),
        }
    }

    /// The desktop's monitor and a panel.
    fn desk() -> Vec<Monitor> {
        let office = Monitor { primary: true, edid: edid("OFFICE 24", "7"), ..monitor("DP-1") };
        vec![office, Monitor { left_px: 1920, edid: edid("PLUTO-2", "SN 0042"), ..monitor("HDMI-1") }]
    }

    fn by(name: &str) -> WindowSpec {
        WindowSpec { monitor: Some(name.to_owned()), allow_primary: false }
    }

    fn chosen(there: &[Monitor], spec: &WindowSpec) -> Result<String, String> {
        choose(there, spec, &PANEL).map(|monitor| monitor.connector.clone()).map_err(|why| why.to_string())
    }

    /// Whether the refusal contains all of `parts`.
    fn refused(there: &[Monitor], spec: &WindowSpec, parts: &[&str]) {
        let why = chosen(there, spec).unwrap_err();
        assert!(parts.iter().all(|part| why.contains(part)), "{why}");
    }

    #[test]
    fn a_monitor_is_known_by_connector_model_and_serial_number() {
        for name in ["HDMI-1", "hdmi-1", "PLUTO-2", "sn 0042"] {
            assert_eq!(chosen(&desk(), &by(name)), Ok("HDMI-1".to_owned()), "{name}");
        }
        assert_eq!(chosen(&desk(), &WindowSpec::default()), Ok("HDMI-1".to_owned()));
        refused(
            &desk(),
            &by("LETO"),
            &["\"LETO\"", "DP-1", "HDMI-1 (\"PLUTO-2\" serial \"SN 0042\") 1920x1080 at 59.94 Hz"],
        );
        refused(&[], &by("LETO"), &["no lit monitor"]);
    }

    #[test]
    fn a_panel_that_is_moved_changed_or_gone_is_a_fault_and_one_that_stays_is_none() {
        let spec = by("HDMI-1");
        let panel = desk().remove(1);
        let fault = |there: &[Monitor]| fault_of(&panel, there, &spec, &PANEL);
        assert_eq!(fault(&desk()), None);
        let with = |changed: Monitor| [desk().remove(0), changed];
        assert_eq!(fault(&with(Monitor { left_px: 0, ..panel.clone() })), Some(PanelFault::WindowLost));
        assert_eq!(fault(&with(Monitor { edid: None, ..panel.clone() })), Some(PanelFault::Unplugged), "another one");
        assert_eq!(fault(&desk()[..1]), Some(PanelFault::Unplugged));
        assert_eq!(fault(&with(Monitor { primary: true, ..panel.clone() })), Some(PanelFault::Primary));
        assert_eq!(fault(&with(Monitor { refresh_hz: Some(50.0), ..panel.clone() })), Some(PanelFault::ModeRefused));
    }

    #[test]
    fn two_panels_of_one_model_are_told_apart_by_number() {
        let mut there = desk();
        there.push(Monitor { edid: edid("PLUTO-2", "SN 0043"), ..monitor("HDMI-2") });
        refused(&there, &by("PLUTO-2"), &["more than one", "SN 0042", "SN 0043"]);
        refused(&there, &WindowSpec::default(), &["2 monitors could be a panel", "window:MONITOR"]);
        assert_eq!(chosen(&there, &by("SN 0043")), Ok("HDMI-2".to_owned()));
    }

    #[test]
    fn the_primary_monitor_is_refused_by_every_name() {
        for name in ["DP-1", "OFFICE 24", "7"] {
            refused(&desk(), &by(name), &["is the primary monitor", "allow_primary", "HDMI-1"]);
        }
        let alone = &desk()[1..];
        refused(alone, &by("PLUTO-2"), &["is the only monitor"]);
        refused(alone, &WindowSpec::default(), &["is the only monitor"]);
        let allowed = WindowSpec { allow_primary: true, ..WindowSpec::default() };
        assert_eq!(chosen(alone, &allowed), Ok("HDMI-1".to_owned()));
        // A server that knows no primary monitor could mean either.
        let nobody_knows: Vec<_> = desk().into_iter().map(|monitor| Monitor { primary: false, ..monitor }).collect();
        refused(&nobody_knows, &WindowSpec::default(), &["name it"]);
        assert_eq!(chosen(&nobody_knows, &by("PLUTO-2")), Ok("HDMI-1".to_owned()));
    }

    #[test]
    fn another_mode_and_changed_pixels_are_refused_with_what_was_found() {
        let with = |change: fn(&mut Monitor)| {
            let mut there = desk();
            change(&mut there[1]);
            there
        };
        let both = "1920x1080 at 60.00 Hz";
        refused(&with(|panel| panel.mode.width = 1280), &by("HDMI-1"), &["1280x1080", both]);
        for hz in [59.7, 60.3, 50.0, 120.0] {
            let mut there = desk();
            there[1].refresh_hz = Some(hz);
            refused(&there, &by("HDMI-1"), &[&format!("{hz:.2} Hz"), both]);
        }
        for hz in [59.94, 59.95, 60.0, 60.02] {
            let mut there = desk();
            there[1].refresh_hz = Some(hz);
            assert!(chosen(&there, &by("HDMI-1")).is_ok(), "{hz}");
        }
        let bent =
            with(|panel| panel.alterations = vec![Alteration::GammaRamp, Alteration::Mirrored("DP-1".to_owned())]);
        refused(&bent, &by("HDMI-1"), &["gamma ramp", "DP-1 shows the same part"]);
    }

    fn monitors() -> impl Strategy<Value = Vec<Monitor>> {
        let one = (
            any::<bool>(),
            0..3usize,
            prop::option::of(prop_oneof![Just(60.0), Just(59.94), Just(75.0)]),
            any::<bool>(),
        );
        prop::collection::vec(one, 0..4).prop_map(|rows| {
            let monitor =
                |(index, (primary, size, refresh_hz, scaled)): (usize, (bool, usize, Option<f64>, bool))| Monitor {
                    primary: primary && index == 0,
                    edid: edid(["PLUTO-2", "OFFICE"][index % 2], &index.to_string()),
                    mode: Resolution { width: [1920, 1280, 1920][size], ..PANEL.resolution },
                    refresh_hz,
                    alterations: if scaled && size == 2 { vec![Alteration::Scaled] } else { Vec::new() },
                    ..monitor(&format!("DP-{index}"))
                };
            rows.into_iter().enumerate().map(monitor).collect()
        })
    }

    proptest! {
        /// Whatever is there and whatever is asked for.
        #[test]
        fn only_a_monitor_that_shows_the_panels_pixels_is_chosen(
            there in monitors(),
            name in prop::option::of(prop_oneof![Just("DP-0"), Just("DP-1"), Just("PLUTO-2"), Just("OFFICE"), Just("2")]),
            allow_primary in any::<bool>(),
        ) {
            let spec = WindowSpec { monitor: name.map(str::to_owned), allow_primary };
            if let Ok(monitor) = choose(&there, &spec, &PANEL) {
                prop_assert!(allow_primary || (!monitor.primary && there.len() > 1));
                prop_assert_eq!(monitor.mode, PANEL.resolution);
                prop_assert!(monitor.refresh_hz.is_none_or(|hz| (hz - 60.0).abs() < 0.3));
                prop_assert!(monitor.alterations.is_empty());
                if let Some(name) = name {
                    prop_assert_eq!(there.iter().filter(|monitor| monitor.is_called(name)).count(), 1);
                    prop_assert!(monitor.is_called(name));
                }
            }
        }
    }

    #[test]
    fn a_monitor_that_gets_ycbcr_is_found_by_its_edid() {
        let takes_it = |serial: &str| edid("PLUTO-2", serial).map(|edid| Edid { takes_ycbcr_444: true, ..edid });
        let seen = |serial: &str| SeenConnector {
            card: "/dev/dri/card0".into(),
            driver: Some("amdgpu".to_owned()),
            name: "HDMI-A-1".to_owned(),
            connected: Some(true),
            edid: takes_it(serial),
        };
        let there = ConnectorList(vec![seen("1"), seen("2")]);
        assert!(Monitor { edid: takes_it("2"), ..monitor("HDMI-A-0") }.gets_ycbcr_444(&there));
        assert!(!Monitor { edid: takes_it("3"), ..monitor("HDMI-A-1") }.gets_ycbcr_444(&there));
        let nobody = ConnectorList(vec![SeenConnector { edid: None, ..seen("1") }]);
        assert!(!Monitor { edid: None, ..monitor("HDMI-A-1") }.gets_ycbcr_444(&nobody));
    }
}
