//! Whether levels get to the panel as they are, and light from the right box.

use holod_calibration::rig::{LaserDriver, PanelMode, Rig};
use holod_pupil_input::{adapter_delay_warning, host_now};
use holod_slm_output::laser::{BoxReport, LaserError, SerialBox, open_laser, takes};
use holod_slm_output::present::drm::Verdict;
use holod_slm_output::present::{PanelSetup, open_panel};
use holod_slm_output::schedule::FieldGate;
use holod_slm_output::{OutputSpec, PanelEncoder};

use super::{Check, present};

/// What no program can see, whatever the output.
const CABLE: &str = "adapters and the panel's own electronics are seen by nobody: look at `holod pattern checkerboard` and \
                     `holod pattern dots` through a camera";

/// The laser box: who it is, and whether it could be armed. It is not.
pub(super) fn lasers(rig: &Rig) -> Vec<Check> {
    let check = |passed, says| vec![Check { name: "lasers", passed, says }];
    let driver = &rig.lasers.driver;
    for path in driver.paths() {
        let (there, says) = present(path, "plug the laser box in or correct its port in [lasers]");
        if !there {
            return check(false, says);
        }
    }
    match driver {
        LaserDriver::Simulated => check(true, "simulated: no light leaves this bench".to_owned()),
        LaserDriver::Serial { path, sync_wire } => match SerialBox::inspect(path, host_now) {
            Err(error) => check(false, error.to_string()),
            Ok(found) if !found.state.interlock_closed => {
                let says = format!("{}: {}: its interlock is open: close it", path.display(), found.name);
                check(false, says)
            }
            Ok(found) if *sync_wire && found.state.sync.count == 0 => {
                let says = format!(
                    "{}: {}: no edge on its sync wire since it booted, and the rig says sync_wire: check the wire, and \
                     that the panel is on",
                    path.display(),
                    found.name
                );
                check(false, says)
            }
            Ok(found) => {
                let says = format!("{}: {}", path.display(), found.name);
                match can_do(rig, Some(&found)) {
                    Ok(()) => match unsure(rig, found.clock_error_ns, found.limits.jitter_us) {
                        Some((some_is_left, unsure)) => {
                            check(some_is_left, format!("{says}, dark, interlock closed; {unsure}"))
                        }
                        None => check(true, format!("{says}, dark, interlock closed")),
                    },
                    Err(error) => check(false, format!("{says}: {error}")),
                }
            }
        },
        driver => match open_laser(&rig.lasers, host_now) {
            Err(error) => check(false, error.to_string()),
            Ok(laser) => {
                drop(laser);
                let paths: Vec<_> = driver.paths().iter().map(|path| path.display().to_string()).collect();
                let says = "recognised and dark; it stays lit when holod is killed, and cannot time single fields";
                match can_do(rig, None) {
                    Ok(()) => check(true, format!("{}: {says}", paths.join(", "))),
                    Err(error) => check(false, format!("{}: {error}", paths.join(", "))),
                }
            }
        },
    }
}

/// Whether the lasers take what they are told at the start of a run.
fn can_do(rig: &Rig, found: Option<&BoxReport>) -> Result<(), LaserError> {
    let program = FieldGate::new(&rig.panel, &rig.lasers)?.program(&rig.panel, &rig.lasers)?;
    takes(&rig.lasers, &program, found)
}

/// Whether a run of `rig` is what it should be with a display of which that is found.
fn passes(rig: &Rig, found: Verdict) -> bool {
    match found {
        Verdict::Right | Verdict::Unverified => true,
        Verdict::Wrong | Verdict::Doubtful => false,
        Verdict::Dark => times_itself(rig) || matches!(rig.lasers.driver, LaserDriver::Simulated),
    }
}

/// Whether the box times its windows by the panel's sync output, and needs no report of it.
fn times_itself(rig: &Rig) -> bool {
    matches!(rig.lasers.driver, LaserDriver::Serial { sync_wire: true, .. })
        && rig.panel.mode == PanelMode::ChannelPacked
}

/// Where most of each window is cut off for what is not known of the box's clock over its line: whether something is
/// left, and what helps.
fn unsure(rig: &Rig, clock_error_ns: i64, jitter_us: u32) -> Option<(bool, String)> {
    let LaserDriver::Serial { path, .. } = &rig.lasers.driver else { return None };
    if times_itself(rig) {
        return None;
    }
    let window_ns = FieldGate::new(&rig.panel, &rig.lasers).ok()?.width().0;
    let cut_ns = clock_error_ns.saturating_mul(2).saturating_add(i64::from(jitter_us) * 1000);
    if 2 * cut_ns.min(window_ns) < window_ns {
        return None;
    }
    let [cut_ms, window_ms] = [cut_ns, window_ns].map(|time_ns| time_ns as f64 / 1e6);
    let wire = match rig.panel.mode {
        PanelMode::ChannelPacked => ", or a wire from the panel's sync output to the box (lasers.sync_wire)",
        PanelMode::FieldSequential | PanelMode::Monochrome(_) => "",
    };
    let adapter = adapter_delay_warning("laser", path).map_or(String::new(), |warning| format!("; {warning}"));
    let says = format!(
        "its line takes so long there and back that {cut_ms:.2} ms are cut off each window of {window_ms:.2} ms, for \
         what is not known of its clock (clock-unsure): USB CDC or a quicker adapter{wire}{adapter}"
    );
    Some((cut_ns < window_ns, says))
}

/// The way to the panel: opened as a run would, with the flat pattern on it, looked at, and closed.
pub(super) fn panel(rig: &Rig, output: Option<&OutputSpec>) -> Vec<Check> {
    let check = |passed, says| Check { name: "panel", passed, says };
    let video = rig.meaning().video.map_or(String::new(), |video| format!(" {video},"));
    let described = format!("{}{video} at {} Hz", rig.resolution(), rig.panel.refresh_hz);
    let spec = match output {
        None | Some(OutputSpec::Headless(_)) => {
            let says = format!(
                "{described}: virtual, real lasers stay dark; name the real one with --output drm:CONNECTOR or \
                 window:MONITOR"
            );
            return vec![check(true, says)];
        }
        Some(spec) => spec,
    };
    let encoder = match PanelEncoder::new(&rig.panel, rig.resolution(), rig.resolution()) {
        Ok(encoder) => encoder,
        Err(error) => return vec![check(false, error.to_string())],
    };
    let panel = match open_panel(spec, &PanelSetup::new(&rig.panel, &encoder), host_now()) {
        Ok(panel) => panel,
        Err(error) => return vec![check(false, error.to_string())],
    };
    let mut checks = vec![check(true, format!("{spec}: {described}, as the rig says; the flat pattern came on it"))];
    for found in panel.checks() {
        checks.push(check(passes(rig, found.verdict), found.to_string()));
    }
    checks.push(check(true, CABLE.to_owned()));
    checks
}

#[cfg(test)]
mod tests {
    use holod_calibration::PerColour;

    use super::*;

    #[test]
    fn a_line_that_leaves_nothing_of_a_window_fails_and_one_that_leaves_little_is_said() {
        let mut rig = Rig::default();
        rig.panel.mode = PanelMode::FieldSequential;
        rig.panel.refresh_hz = 180.0;
        let over_line = |rig: &Rig, clock_error_ns| unsure(rig, clock_error_ns, 0);
        rig.lasers.driver = LaserDriver::Serial { path: "/dev/none".into(), sync_wire: false };
        let (some_is_left, says) = over_line(&rig, 2_161_000).unwrap();
        assert!(!some_is_left && says.contains("4.32 ms are cut off each window of 3.00 ms"), "{says}");
        assert!(!says.contains("sync_wire"), "not in this mode: {says}");
        assert!(over_line(&rig, i64::MAX).is_some_and(|(some_is_left, _)| !some_is_left));
        assert!(over_line(&rig, 1_000_000).is_some_and(|(some_is_left, _)| some_is_left));
        assert_eq!(over_line(&rig, 500_000), None);
        rig.panel.mode = PanelMode::ChannelPacked;
        rig.panel.refresh_hz = 60.0;
        assert!(over_line(&rig, 1_000_000).unwrap().1.contains("sync_wire"));
        rig.lasers.driver = LaserDriver::Serial { path: "/dev/none".into(), sync_wire: true };
        assert_eq!(over_line(&rig, 2_161_000), None);
    }

    #[test]
    fn a_display_whose_times_are_softwares_fails_for_lasers_that_it_leaves_dark() {
        let serial = |sync_wire| LaserDriver::Serial { path: "/dev/none".into(), sync_wire };
        let ready_beam = LaserDriver::ReadyBeam { path: "/dev/none".into(), full_power_uw: PerColour([1000; 3]) };
        for (driver, mode, fits) in [
            (LaserDriver::Simulated, PanelMode::ChannelPacked, true),
            (serial(true), PanelMode::ChannelPacked, true),
            (serial(true), PanelMode::FieldSequential, false),
            (serial(false), PanelMode::ChannelPacked, false),
            (ready_beam, PanelMode::ChannelPacked, false),
        ] {
            let mut rig = Rig::default();
            (rig.lasers.driver, rig.panel.mode) = (driver, mode);
            assert_eq!(passes(&rig, Verdict::Dark), fits, "{:?}", rig.lasers.driver);
            assert!(passes(&rig, Verdict::Right) && passes(&rig, Verdict::Unverified) && !passes(&rig, Verdict::Wrong));
            assert!(!passes(&rig, Verdict::Doubtful));
        }
    }
}
