//! Whether levels get to the panel as they are, and light from the right box.

use holod_calibration::rig::{LaserDriver, Rig};
use holod_pupil_input::host_now;
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
                    Ok(()) => check(true, format!("{says}, dark, interlock closed")),
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

/// The way to the panel: opened as a run would, with the flat pattern on it, looked at, and closed.
pub(super) fn panel(rig: &Rig, output: Option<&OutputSpec>) -> Vec<Check> {
    let check = |passed, says| Check { name: "panel", passed, says };
    let described = format!("{} at {} Hz", rig.resolution(), rig.panel.refresh_hz);
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
    let passes = |verdict| match verdict {
        Verdict::Right | Verdict::Unverified => true,
        Verdict::Wrong => false,
        Verdict::Dark => !matches!(rig.lasers.driver, LaserDriver::Serial { sync_wire: false, .. }),
    };
    for found in panel.checks() {
        checks.push(check(passes(found.verdict), found.to_string()));
    }
    checks.push(check(true, CABLE.to_owned()));
    checks
}
